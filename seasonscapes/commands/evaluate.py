"""``seasonscapes evaluate``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from seasonscapes.commands.talk import check_range, finish, progress_bar, say
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from seasonscapes.evaluation.metrics import Score

_ENCODED, _LINEAR = (".png", ".jpg", ".jpeg"), (".exr",)


def evaluate(
    *,
    truth: Path,
    pictures: Path,
    mask: Path | None = None,
    mode: str = "valid",
    near_m: float = 60.0,
    far_m: float = float("inf"),
    match: str = "none",
    used: Annotated[tuple[Path, ...], Parameter(consume_multiple=True)] = (),
    lpips: Path | None = None,
    table: Path | None = None,
    figures: Path | None = None,
    json: bool = False,
) -> None:
    """Score pictures against the truth: PSNR, SSIM, FLIP, colour angle and, where its weights are at hand, LPIPS.

    Parameters
    ----------
    truth
        A picture (.png, .jpg, .exr), or a folder of them.
    pictures
        What is to be scored: a picture, or a folder whose files have the names of the truth's (endings may differ).
    mask
        A .png that is white where pixels count, or a folder of them. Truths in .exr that hold depth need none: sky and
        what is nearer than --near-m are left out.
    mode
        valid (pixels of the mask alone) or paper (multiplied by the mask and scored over the frame, which flatters).
    near_m
        Least distance in metres, where the truth holds depth.
    far_m
        Greatest distance in metres, where the truth holds depth.
    match
        none, or gain: fit one factor for each colour first, for pictures of unknown exposure and white balance.
    used
        Folders or files that were used for painting, guidance or training: if a truth is among them, nothing is scored.
    lpips
        Folder of LPIPS's weights; left out, what SEASONSCAPES_LPIPS names.
    table
        Also write all scores to this .csv or .md.
    figures
        Also write a comparison picture of each pair into this folder.
    json
        Print one machine-readable record.
    """
    from seasonscapes.evaluation.metrics import MODES, score
    from seasonscapes.evaluation.tables import summary, table_lines

    if mode not in MODES:
        raise InputError("--mode", "unknown mode", got=mode, expected=" or ".join(MODES))
    if match not in ("none", "gain"):
        raise InputError("--match", "unknown way to match", got=match, expected="none or gain")
    check_range("--near-m", near_m, 0.0, 1e6)
    if not far_m > near_m:
        raise InputError("--far-m", "not beyond --near-m", got=far_m, expected=f"more than {near_m:g}")
    if table is not None and table.suffix.lower() not in (".csv", ".md"):
        raise InputError("--table", "unknown kind of file", got=str(table), expected="a name that ends in .csv or .md")
    pairs = paired(truth, pictures)
    refuse_used([true_path for true_path, _ in pairs.values()], used)
    measure, why = _lpips(lpips)
    records, heads = [], []
    with progress_bar(f"scoring {len(pairs)} pictures") as progress:
        for number, (name, (true_path, path)) in enumerate(pairs.items()):
            pair = read_pair(true_path, path, match=match)
            chosen = mask_of(name, mask, pair, near_m=near_m, far_m=far_m)
            try:
                found: Score = score(pair.truth, pair.picture, chosen, mode=mode, lpips=measure)
            except ValueError as error:
                raise InputError(path, str(error).removeprefix("score: ")) from None
            records.append(found.record())
            heads.append(name)
            if figures is not None:
                _save_figure(figures / f"{name}_comparison.png", pair, chosen)
            progress((number + 1) / len(pairs))
    rows = [{"picture": name} | record for name, record in zip(heads, records, strict=True)]
    told = summary(records)
    if table is not None:
        write_table(table, rows)
    if why is not None:
        say(f"LPIPS is left out: {why}")
    mean = {"picture": "mean"} | {name: value["mean"] for name, value in told.items()}
    record = {"mode": mode, "match": match, "pictures": rows, "summary": told, "lpips_skipped": why}
    finish(record, [f"mode {mode}, {len(rows)} pictures", *table_lines([*rows, mean])], as_json=json)


def paired(truth: Path, pictures: Path) -> dict[str, tuple[Path, Path]]:
    """Truth and picture by name; `InputError` where one is missing or nothing is there."""
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
        raise InputError(
            "--pictures",
            f"no picture for {len(missing)} of {len(true)} truths, the first",
            got=missing[0],
            cure="every truth is scored, so that none can be left out silently",
        )
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
        raise InputError(
            flag, "no pictures in the folder", got=str(folder), expected="names that end in .png, .jpg or .exr"
        )
    return found


@dataclass(frozen=True)
class Pair:
    """Truth and picture ``(H, W, 3)``, sRGB-encoded, and the truth's depth ``(H, W)`` [m] where its file holds it."""

    truth: np.ndarray
    picture: np.ndarray
    depth_m: np.ndarray | None


def read_pair(true_path: Path, path: Path, *, match: str = "none") -> Pair:
    """Read two pictures; radiances are developed with the truth's exposure."""
    import numpy as np

    from seasonscapes.exposure import develop, exposure_ev100
    from seasonscapes.images import srgb_from_linear

    linear = [each.suffix.lower() in _LINEAR for each in (true_path, path)]
    if linear[0] != linear[1]:
        raise InputError(
            path,
            "radiance and a developed picture cannot be compared",
            got=f"{true_path.name}, {path.name}",
            expected="two .exr, or two of .png and .jpg",
        )
    (true, depth), (made, _) = _read(true_path), _read(path)
    if true.shape != made.shape:
        raise InputError(
            path,
            "another size than the truth",
            got=f"{made.shape[1]}x{made.shape[0]}",
            expected=f"{true.shape[1]}x{true.shape[0]}",
        )
    if match == "gain":
        made = made * matching_gain(true, made)
    if linear[0]:
        ev100 = exposure_ev100(true)
        true, made = develop(true, ev100), develop(made, ev100)
    return Pair(*(srgb_from_linear(np.clip(each, 0.0, 1.0)) for each in (true, made)), depth)


def _read(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    from seasonscapes.images import read_exr, read_image_linear

    try:
        if path.suffix.lower() not in _LINEAR:
            return read_image_linear(path), None
        layers, _ = read_exr(path)
    except (ValueError, RuntimeError, OSError) as error:
        raise InputError(path, f"not a readable picture: {error}") from None
    if "" not in layers or layers[""].ndim != 3:
        raise InputError(path, "holds no colours", got=", ".join(map(repr, layers)), expected="channels R, G and B")
    return layers[""], layers.get("depth")


def matching_gain(truth: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """Factors ``(3,)`` that bring a linear picture to the truth: medians of the ratios of pixels that are not black."""
    import numpy as np

    gains = np.ones(3)
    for channel in range(3):
        a, b = truth[..., channel], picture[..., channel]
        kept = (
            np.isfinite(a)
            & np.isfinite(b)
            & (a > 1e-3 * np.nanmax(a))
            & (b > 1e-3 * np.nanmax(b))
            & (a < 0.98 * np.nanmax(a))
        )
        if kept.any():
            gains[channel] = np.exp(np.median(np.log(a[kept] / b[kept])))
    return gains


def mask_of(name: str, mask: Path | None, pair: Pair, *, near_m: float, far_m: float) -> np.ndarray | None:
    """Pixels that count: a mask's white ones, and where depth is known, land at the right distance."""
    import numpy as np

    from seasonscapes.evaluation.masks import land_mask

    chosen = (
        None
        if pair.depth_m is None
        else land_mask(np.where(np.isnan(pair.depth_m), np.inf, pair.depth_m), near_m=near_m, far_m=far_m)
    )
    if mask is None:
        return chosen
    path = mask / f"{name}.png" if mask.is_dir() else mask
    if not path.is_file():
        raise InputError("--mask", "no such mask", got=str(path))
    white = _read(path)[0].max(axis=2) > 0.5
    if white.shape != pair.truth.shape[:2]:
        raise InputError(
            path,
            "another size than the truth",
            got=f"{white.shape[1]}x{white.shape[0]}",
            expected=f"{pair.truth.shape[1]}x{pair.truth.shape[0]}",
        )
    return white if chosen is None else white & chosen


def refuse_used(truths: Sequence[Path], used: Sequence[Path]) -> None:
    """`InputError` where a truth's pixels are among those that were used; copies and other names do not hide them."""
    from seasonscapes.evaluation.splits import file_content_hash

    files = []
    for path in used:
        if not path.exists():
            raise InputError("--used", "no such file or folder", got=str(path))
        files += sorted(path.rglob("*")) if path.is_dir() else [path]
    try:
        known = {file_content_hash(path): path for path in files if path.suffix.lower() in _ENCODED}
        for path in truths:
            if path.suffix.lower() in _ENCODED and (held := known.get(file_content_hash(path))) is not None:
                raise InputError(
                    path, "this truth is not held out: it has the pixels of a picture that was used", got=str(held)
                )
    except ValueError as error:
        raise InputError("--used", str(error)) from None


def _lpips(folder: Path | None):
    """The function that measures LPIPS, or why there is none; `InputError` where a folder was named in vain."""
    from seasonscapes.evaluation.lpips import missing_lpips

    why = missing_lpips(folder)
    if why is not None:
        if folder is not None:
            raise InputError("--lpips", why)
        return None, why
    from seasonscapes.evaluation.lpips import load_lpips

    return load_lpips(folder), None


def write_table(path: Path, rows: Sequence[dict]) -> None:
    """Scores as .csv or Markdown."""
    import csv

    from seasonscapes.evaluation.tables import table_lines
    from seasonscapes.images import atomic_path

    with atomic_path(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        if path.suffix.lower() == ".md":
            file.write("\n".join(table_lines(rows, markdown=True)) + "\n")
            return
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _save_figure(path: Path, pair: Pair, mask: np.ndarray | None) -> None:
    import numpy as np

    from seasonscapes.evaluation.figures import comparison
    from seasonscapes.images import write_png8

    sheet = comparison({"truth": pair.truth, "picture": pair.picture}, mask=mask)
    write_png8(path, np.round(255.0 * sheet).astype(np.uint8))
