"""Storage of a painting in one ``.npz`` file, which `terrain.surface.load_texture` can read too, and its figures."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from seasonscapes.array_files import read_arrays
from seasonscapes.exposure import develop, exposure_ev100
from seasonscapes.images import srgb_from_linear, write_exr, write_png, write_png8
from seasonscapes.terrain.surface import Texture
from seasonscapes.texturing.painting import Painting
from seasonscapes.texturing.radiometric_fit import RadiometricFit

# sRGB of unpainted texels in figures.
_UNPAINTED = np.array([38, 40, 46], np.uint8)
_MAX_FIGURE_PX = 2048


def save_painting(painting: Painting, path: str | os.PathLike) -> None:
    """Write a painting to one ``.npz`` file.

    Parameters
    ----------
    painting
        The painting.
    path
        File to write.
    """
    radiometry = {name: np.asarray(value).tolist() for name, value in asdict(painting.radiometry).items()}
    note = {"webcams": painting.webcams, "skipped": painting.skipped, "radiometry": radiometry}
    identity: dict[str, Any] = {} if painting.texture.atlas_id is None else {"atlas_id": painting.texture.atlas_id}
    np.savez(
        path,
        values=painting.texture.values,
        weight=painting.texture.weight,
        best=painting.best,
        coverage=painting.coverage,
        note=json.dumps(note),
        **identity,
    )


def load_painting(path: str | os.PathLike) -> Painting:
    """Read a painting that `save_painting` wrote.

    Parameters
    ----------
    path
        File to read.

    Returns
    -------
    Painting
        Arrays equal those that were saved, bit for bit.

    Raises
    ------
    InputError
        Where the file is missing, damaged, or no painting.
    """
    stored = read_arrays(
        path, ["note", "values", "weight", "best", "coverage"], optional=["atlas_id"], what="a painting"
    )
    note = json.loads(str(stored["note"]))
    # Files of earlier versions use the second key.
    radiometry: dict[str, Any] = note["radiometry"] if "radiometry" in note else note["harmony"]
    arrays: dict[str, Any] = {
        name: np.array(value) if isinstance(value, list) else value for name, value in radiometry.items()
    }
    return Painting(
        Texture(stored["values"], stored["weight"], str(stored["atlas_id"]) if "atlas_id" in stored else None),
        stored["best"],
        # Files of earlier versions have 8 bits.
        stored["coverage"].astype(np.uint16),
        tuple(note["webcams"]),
        RadiometricFit(**arrays),
        tuple(note["skipped"]),
    )


def write_figures(painting: Painting, folder: Path) -> dict[str, str]:
    """Write ``painted.exr`` with all layers, and figures of the texture, the camera count and the best camera.

    Parameters
    ----------
    painting
        The painting.
    folder
        Folder to write to.

    Returns
    -------
    dict
        File by kind of figure: ``exr``, ``texture``, ``coverage`` and ``cameras``.
    """
    texture, names = painting.texture, ("exr", "texture", "coverage", "cameras")
    files = {name: folder / ("painted.exr" if name == "exr" else f"{name}.png") for name in names}
    painted = texture.weight > 0.0
    write_exr(
        files["exr"],
        {
            "": texture.values,
            "weight": texture.weight,
            "camera": painting.best.astype(np.float32),
            "coverage": painting.coverage.astype(np.float32),
        },
        header={"seasonscapes:webcams": list(painting.webcams)},
    )
    step = max(1, -(-max(painted.shape) // _MAX_FIGURE_PX))
    subsampled = (slice(None, None, step), slice(None, None, step))
    values, painted = texture.values[subsampled], painted[subsampled]
    picture = develop(values, exposure_ev100(values[painted][None]) if painted.any() else 0.0)
    picture[~painted] = (_UNPAINTED / 255.0) ** 2.2
    write_png(files["texture"], picture)
    write_png8(files["coverage"], _coverage_figure(painting.coverage[subsampled]))
    write_png8(files["cameras"], _camera_figure(painting.best[subsampled], painting.webcams))
    return {name: str(path) for name, path in files.items()}


def _coverage_figure(coverage: np.ndarray) -> np.ndarray:
    """Number of cameras per texel in the viridis colour map, with a legend."""
    maximum = max(int(coverage.max()), 1)
    scaled = np.where(coverage > 0, 40 + 215 * (coverage.astype(float) / maximum), 0).astype(np.uint8)
    picture = cv2.applyColorMap(scaled, cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()
    picture[coverage == 0] = _UNPAINTED
    lines = [
        (
            str(n),
            cv2.applyColorMap(np.array([[int(40 + 215 * n / maximum)]], np.uint8), cv2.COLORMAP_VIRIDIS)[0, 0, ::-1],
        )
        for n in range(1, maximum + 1)
    ]
    return _with_legend(picture, lines[:24])


def _camera_figure(best: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    colours = camera_colours(len(names))
    picture = np.concatenate([colours, _UNPAINTED[None]])[best]
    return _with_legend(picture, list(zip(names, colours, strict=True)))


def camera_colours(count: int) -> np.ndarray:
    """Return distinct colours, with hues spaced by the golden angle.

    Parameters
    ----------
    count
        Number of colours.

    Returns
    -------
    ndarray
        ``(count, 3)`` uint8 sRGB.
    """
    hue = (np.arange(count) * 0.381966) % 1.0
    brightness = np.array([0.95, 0.7, 0.85])[np.arange(count) % 3]
    rgb = np.clip(np.abs((hue[:, None] * 6.0 + np.array([0.0, 4.0, 2.0])) % 6.0 - 3.0) - 1.0, 0.0, 1.0)
    return np.round(255.0 * srgb_from_linear(brightness[:, None] * (0.25 + 0.75 * rgb))).astype(np.uint8)


def _with_legend(picture: np.ndarray, lines: list[tuple[str, np.ndarray]]) -> np.ndarray:
    """Append a legend on the right: one colour patch and label per line."""
    size = max(14, picture.shape[0] // 45)
    strip = np.full((max(picture.shape[0], size * (len(lines) + 1)), size * 14, 3), 24, np.uint8)
    for row, (name, colour) in enumerate(lines):
        top = size // 2 + row * size
        cv2.rectangle(strip, (size // 2, top), (size // 2 + size, top + size * 3 // 4), colour.tolist(), -1)
        cv2.putText(
            strip,
            name,
            (2 * size, top + size * 3 // 4),
            cv2.FONT_HERSHEY_SIMPLEX,
            size / 32.0,
            (235, 235, 235),
            1,
            cv2.LINE_AA,
        )
    padded = np.full((strip.shape[0], *picture.shape[1:]), 24, np.uint8)
    padded[: picture.shape[0]] = picture
    return np.concatenate([padded, strip], axis=1)
