"""A painting on disk, one file that `terrain.surface.load_texture` reads too; and the figures that show it."""

from __future__ import annotations

import json
import os
from dataclasses import asdict
from pathlib import Path

import cv2
import numpy as np

from seasonscapes.exposure import develop, exposure_ev100
from seasonscapes.images import srgb_from_linear, write_exr, write_png, write_png8
from seasonscapes.terrain.surface import Texture
from seasonscapes.texturing.painting import Painting
from seasonscapes.texturing.radiometric_fit import RadiometricFit

_UNPAINTED = np.array([38, 40, 46], np.uint8)
_MOST_FIGURE_PX = 2048


def save_painting(painting: Painting, path: str | os.PathLike) -> None:
    """Write a painting to one ``.npz`` file."""
    radiometry = {name: np.asarray(value).tolist() for name, value in asdict(painting.radiometry).items()}
    note = {"webcams": painting.webcams, "skipped": painting.skipped, "harmony": radiometry}
    np.savez(
        path,
        values=painting.texture.values,
        weight=painting.texture.weight,
        best=painting.best,
        coverage=painting.coverage,
        note=json.dumps(note),
    )


def load_painting(path: str | os.PathLike) -> Painting:
    """Read what `save_painting` wrote."""
    with np.load(path, allow_pickle=False) as stored:
        note = json.loads(str(stored["note"]))
        lists = {name: np.array(value) if isinstance(value, list) else value for name, value in note["harmony"].items()}
        return Painting(
            Texture(stored["values"], stored["weight"]),
            stored["best"],
            stored["coverage"],
            tuple(note["webcams"]),
            RadiometricFit(**lists),
            tuple(note["skipped"]),
        )


def write_figures(painting: Painting, folder: Path) -> dict[str, str]:
    """``painted.exr`` with all layers, and pictures of the texture, of how many cameras paint it and of which one best.

    Returns
    -------
    dict
        Kind of figure to its file.
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
    step = max(1, -(-max(painted.shape) // _MOST_FIGURE_PX))
    thin = (slice(None, None, step), slice(None, None, step))
    values, painted = texture.values[thin], painted[thin]
    picture = develop(values, exposure_ev100(values[painted][None]) if painted.any() else 0.0)
    picture[~painted] = (_UNPAINTED / 255.0) ** 2.2
    write_png(files["texture"], picture)
    write_png8(files["coverage"], _coverage_figure(painting.coverage[thin]))
    write_png8(files["cameras"], _camera_figure(painting.best[thin], painting.webcams))
    return {name: str(path) for name, path in files.items()}


def _coverage_figure(coverage: np.ndarray) -> np.ndarray:
    """Viridis from one camera to the most, with a scale."""
    most = max(int(coverage.max()), 1)
    scaled = np.where(coverage > 0, 40 + 215 * (coverage.astype(float) / most), 0).astype(np.uint8)
    picture = cv2.applyColorMap(scaled, cv2.COLORMAP_VIRIDIS)[..., ::-1].copy()
    picture[coverage == 0] = _UNPAINTED
    lines = [
        (str(n), cv2.applyColorMap(np.array([[int(40 + 215 * n / most)]], np.uint8), cv2.COLORMAP_VIRIDIS)[0, 0, ::-1])
        for n in range(1, most + 1)
    ]
    return _with_legend(picture, lines[:24])


def _camera_figure(best: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    colours = camera_colours(len(names))
    picture = np.concatenate([colours, _UNPAINTED[None]])[best]
    return _with_legend(picture, list(zip(names, colours, strict=True)))


def camera_colours(count: int) -> np.ndarray:
    """Colours ``(count, 3)`` uint8 that differ from their neighbours in the list: hues by the golden angle."""
    hue = (np.arange(count) * 0.381966) % 1.0
    level = np.array([0.95, 0.7, 0.85])[np.arange(count) % 3]
    wheel = np.clip(np.abs((hue[:, None] * 6.0 + np.array([0.0, 4.0, 2.0])) % 6.0 - 3.0) - 1.0, 0.0, 1.0)
    return np.round(255.0 * srgb_from_linear(level[:, None] * (0.25 + 0.75 * wheel))).astype(np.uint8)


def _with_legend(picture: np.ndarray, lines: list[tuple[str, np.ndarray]]) -> np.ndarray:
    """A strip to the right with a patch and a name a line."""
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
