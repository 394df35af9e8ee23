"""Evaluation of picture files: pairing by name, development at a common exposure, masking and metrics."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.errors import InputError, UnreadableImage
from seasonscapes.evaluation.figures import comparison_figure
from seasonscapes.evaluation.lpips import Lpips
from seasonscapes.evaluation.masks import NEAR_M, reference_mask, terrain_mask
from seasonscapes.evaluation.metrics import Score, score
from seasonscapes.evaluation.splits import file_content_hash
from seasonscapes.evaluation.tables import table_lines
from seasonscapes.exposure import develop, exposure_ev100
from seasonscapes.images import atomic_path, read_exr, read_image_linear, srgb_from_linear, write_png8

_ENCODED, _LINEAR = (".png", ".jpg", ".jpeg"), (".exr",)
MATCHES = ("none", "gain")
# A common gain within a factor of 400, first in steps of a fifth; then each colour within a factor of 7.
_MOST_LOG_GAIN, _GAIN_STEPS = 6.0, 30
_COLOUR_LOG_GAIN = 2.0


@dataclass(frozen=True)
class MaskOptions:
    """Pixels that are scored.

    Parameters
    ----------
    mask
        PNG file whose white pixels are scored, or a folder of such files by name; ``None`` for no mask.
    near_m, far_m
        Minimum and maximum distance [m], applied if the file of the truth contains depth.
    """

    mask: Path | None = None
    near_m: float = NEAR_M
    far_m: float = float("inf")


@dataclass(frozen=True)
class ScoreOptions:
    """How a pair of pictures is compared.

    Parameters
    ----------
    masks
        Pixels that are scored.
    mode
        Mode of `metrics.score`.
    match
        One of `MATCHES`: ``"none"``, or ``"gain"`` to scale each colour of the picture to the truth first.
    lpips
        LPIPS function (`lpips.load_lpips`), or ``None`` to omit that metric.
    """

    masks: MaskOptions = MaskOptions()
    mode: str = "valid"
    match: str = "none"
    lpips: Lpips | None = None


@dataclass(frozen=True)
class PicturePair:
    """A picture and its ground truth.

    Parameters
    ----------
    truth, picture
        Images ``(H, W, 3)``, sRGB-encoded in [0, 1].
    depth_m
        Distance ``(H, W)`` of the truth [m], or ``None`` if its file contains no depth.
    linear
        The picture before it was developed: radiance, or linear values of an encoded picture.
    ev100
        Exposure of radiance; ``None`` for encoded pictures.
    """

    truth: np.ndarray
    picture: np.ndarray
    depth_m: np.ndarray | None
    linear: np.ndarray
    ev100: float | None = None


def paired(truth: Path, pictures: Path) -> dict[str, tuple[Path, Path]]:
    """Match true and estimated pictures by file name without extension.

    Parameters
    ----------
    truth, pictures
        Two files, or two folders.

    Returns
    -------
    dict
        Paths of truth and picture by name.

    Raises
    ------
    InputError
        If a truth has no picture, a name occurs twice, or a file or folder is missing or empty.
    """
    for flag, path in (("--truth", truth), ("--pictures", pictures)):
        if not path.exists():
            raise InputError(flag, "no such file or folder", got=str(path))
    if truth.is_file() and pictures.is_file():
        return {pictures.stem: (truth, pictures)}
    if truth.is_file() or pictures.is_file():
        raise InputError("--pictures", "a file and a folder", expected="two files, or two folders")
    true, made = (_by_stem(flag, path) for flag, path in (("--truth", truth), ("--pictures", pictures)))
    missing = sorted(set(true) - set(made))
    if missing:
        cure = "every truth is scored, so that none can be left out silently"
        problem = f"no picture for {len(missing)} of {len(true)} truths, the first"
        raise InputError("--pictures", problem, got=missing[0], cure=cure)
    return {name: (true[name], made[name]) for name in sorted(true)}


def _by_stem(flag: str, folder: Path) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in _ENCODED + _LINEAR:
            continue
        if path.stem in found:
            raise InputError(flag, "two pictures of one name", got=f"{found[path.stem].name}, {path.name}")
        found[path.stem] = path
    if not found:
        expected = "names that end in .png, .jpg or .exr"
        raise InputError(flag, "no pictures in the folder", got=str(folder), expected=expected)
    return found


def read_pair(true_path: Path, path: Path) -> PicturePair:
    """Read a picture and its truth; radiance is developed with the exposure of the truth.

    Parameters
    ----------
    true_path, path
        Files of truth and picture: both ``.exr``, or both ``.png`` or ``.jpg``; of equal size.

    Returns
    -------
    PicturePair
        Encoded images and the depth of the truth.

    Raises
    ------
    InputError
        If the files cannot be read or compared.
    """
    is_linear = [file.suffix.lower() in _LINEAR for file in (true_path, path)]
    if is_linear[0] != is_linear[1]:
        got, expected = f"{true_path.name}, {path.name}", "two .exr, or two of .png and .jpg"
        raise InputError(path, "radiance and a developed picture cannot be compared", got=got, expected=expected)
    (truth, depth), (picture, _) = _read(true_path), _read(path)
    if truth.shape != picture.shape:
        got, expected = (f"{image.shape[1]}x{image.shape[0]}" for image in (picture, truth))
        raise InputError(path, "another size than the truth", got=got, expected=expected)
    ev100 = exposure_ev100(truth) if is_linear[0] else None
    return PicturePair(encoded(truth, ev100), encoded(picture, ev100), depth, picture, ev100)


def encoded(linear: np.ndarray, ev100: float | None = None) -> np.ndarray:
    """Linear values ``(..., 3)`` as sRGB in [0, 1]; radiance is developed with an exposure first."""
    shown = linear if ev100 is None else develop(linear, ev100)
    return srgb_from_linear(np.clip(shown, 0.0, 1.0))


def _read(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    try:
        if path.suffix.lower() not in _LINEAR:
            return read_image_linear(path), None
        layers, _ = read_exr(path)
    except (UnreadableImage, RuntimeError, OSError) as error:
        raise InputError(path, f"not a readable picture: {error}") from None
    if "" not in layers or layers[""].ndim != 3:
        raise InputError(path, "holds no colours", got=", ".join(map(repr, layers)), expected="channels R, G and B")
    return layers[""], layers.get("depth")


def matched(pair: PicturePair, mask: np.ndarray | None) -> PicturePair:
    """Return the pair with each colour of the picture scaled by its `matching_gain`, fitted on the pixels scored."""
    use = np.ones(pair.truth.shape[:2], bool) if mask is None else mask
    gain = matching_gain(pair.truth[use], pair.linear[use], pair.ev100)
    return replace(pair, picture=encoded(pair.linear * gain, pair.ev100))


def matching_gain(truth: np.ndarray, picture: np.ndarray, ev100: float | None = None) -> np.ndarray:
    """Compute the gains of a linear picture that bring its encoded values nearest to a truth, by least squares.

    What is minimised is what PSNR measures, and 1 is among the candidates: a match never lowers a PSNR.

    Parameters
    ----------
    truth
        Pixels ``(N, 3)``, sRGB-encoded in [0, 1].
    picture
        The same pixels ``(N, 3)``, linear.
    ev100
        Exposure that develops the picture where it is radiance.

    Returns
    -------
    ndarray
        One gain per colour ``(3,)``; 1 without pixels.
    """
    from scipy.optimize import minimize_scalar

    gains = np.ones(3)
    if not len(truth):
        return gains

    def error(trial: np.ndarray) -> float:
        return float(np.mean((truth - encoded(picture * trial, ev100)) ** 2))

    coarse = np.exp(np.linspace(-_MOST_LOG_GAIN, _MOST_LOG_GAIN, 2 * _GAIN_STEPS + 1))
    gains = gains * min(coarse, key=lambda gain: error(np.full(3, gain)))
    # The development mixes colours a little in highlights, so each colour is fitted again after the others.
    for channel in (0, 1, 2, 0, 1, 2):
        axis, start = np.eye(3)[channel], gains.copy()
        found = minimize_scalar(
            lambda change, start=start, axis=axis: error(start * np.exp(change * axis)),
            bounds=(-_COLOUR_LOG_GAIN, _COLOUR_LOG_GAIN),
            method="bounded",
            options={"xatol": 1e-4},
        )
        gains = start * np.exp(float(found.x) * axis)
    return gains if error(gains) <= error(np.ones(3)) else np.ones(3)


def mask_of(name: str, pair: PicturePair, options: MaskOptions, mode: str = "valid") -> np.ndarray | None:
    """Return the mask of scored pixels: white in the mask file and, with depth, terrain within the distances.

    In mode ``paper`` depth gives the mask of the reference evaluation (`masks.reference_mask`) instead.

    Parameters
    ----------
    name
        Name of the pair, which selects its file in a folder of masks.
    pair
        Picture and truth.
    options
        Mask files and range of distances.
    mode
        Mode of `metrics.score`.

    Returns
    -------
    ndarray or None
        ``(H, W)`` bool; ``None`` if there is neither a mask nor depth.

    Raises
    ------
    InputError
        If the mask is missing or of another size.
    """
    terrain = None
    if pair.depth_m is not None:
        depth = np.where(np.isnan(pair.depth_m), np.inf, pair.depth_m)
        within = {"near_m": options.near_m, "far_m": options.far_m}
        terrain = reference_mask(depth) if mode == "paper" else terrain_mask(depth, **within)
    if options.mask is None:
        return terrain
    path = options.mask / f"{name}.png" if options.mask.is_dir() else options.mask
    if not path.is_file():
        raise InputError("--mask", "no such mask", got=str(path))
    white = _read(path)[0].max(axis=2) > 0.5
    if white.shape != pair.truth.shape[:2]:
        got, expected = (f"{shape[1]}x{shape[0]}" for shape in (white.shape, pair.truth.shape))
        raise InputError(path, "another size than the truth", got=got, expected=expected)
    return white if terrain is None else white & terrain


def check_files_held_out(truths: Sequence[Path], used: Sequence[Path]) -> None:
    """Check that no truth has the pixels of a picture that was used as an input, under whatever name.

    Parameters
    ----------
    truths
        Files to be scored.
    used
        Files, or folders of files, used for painting, guidance or training.

    Raises
    ------
    InputError
        If a truth was used, or a used file is missing or unreadable.
    """
    files = []
    for path in used:
        if not path.exists():
            raise InputError("--used", "no such file or folder", got=str(path))
        files += sorted(path.rglob("*")) if path.is_dir() else [path]
    try:
        known = {file_content_hash(path): path for path in files if path.suffix.lower() in _ENCODED}
        for path in truths:
            if path.suffix.lower() in _ENCODED and (match := known.get(file_content_hash(path))) is not None:
                problem = "this truth is not held out: it has the pixels of a picture that was used"
                raise InputError(path, problem, got=str(match))
    except UnreadableImage as error:
        raise InputError("--used", str(error)) from None


def score_pair(
    true_path: Path, path: Path, name: str, *, options: ScoreOptions | None = None, figure: Path | None = None
) -> Score:
    """Compute the metrics of one pair of files and optionally write a comparison figure.

    Parameters
    ----------
    true_path, path
        Files of truth and picture.
    name
        Name of the pair, which selects its mask in a folder of masks.
    options
        Mask, mode, exposure matching and LPIPS; `ScoreOptions()` if omitted.
    figure
        PNG file to write, or ``None``.

    Returns
    -------
    Score
        Metrics of the picture.

    Raises
    ------
    InputError
        If the pair cannot be compared, or no pixel is left to score.
    """
    options = options or ScoreOptions()
    pair = read_pair(true_path, path)
    mask = mask_of(name, pair, options.masks, options.mode)
    if options.match == "gain":
        pair = matched(pair, mask)
    if mask is not None and not mask.any():
        raise InputError(path, "no pixel is left to score", cure="check --mask, --near-m and --far-m")
    result = score(pair.truth, pair.picture, mask, mode=options.mode, lpips=options.lpips, colour_difference=True)
    if figure is not None:
        sheet = comparison_figure({"truth": pair.truth, "picture": pair.picture}, mask=mask)
        write_png8(figure, np.round(255.0 * sheet).astype(np.uint8))
    return result


def write_table(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write scores to a table; the file appears atomically.

    Parameters
    ----------
    path
        File to write: Markdown if it ends in ``.md``, otherwise CSV.
    rows
        Values by column name, at least one row; all rows have the columns of the first.
    """
    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        if path.suffix.lower() == ".md":
            file.write("\n".join(table_lines(rows, markdown=True)) + "\n")
            return
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
