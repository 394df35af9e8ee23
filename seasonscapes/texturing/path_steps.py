"""A finished view of a walk along a path, and the files that keep it: pictures for people, a record to go on from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from seasonscapes.images import atomic_path, write_png8


@dataclass(frozen=True)
class PathStep:
    """One view, done.

    Parameters
    ----------
    index
        In the path.
    hole_share
        Share of the view's land that was a hole.
    texels, values
        Flat indices ``(N,)`` and radiance ``(N, 3)`` float32 [cd/m²] of the texels that it gave a value.
    frame
        ``(H, W, 3)`` uint8, the composed picture.
    skipped
        There was nothing to paint.
    """

    index: int
    hole_share: float
    texels: np.ndarray
    values: np.ndarray
    frame: np.ndarray
    skipped: bool


def levels_of(picture: np.ndarray) -> np.ndarray:
    """Bytes of a picture in [0, 1]."""
    return np.round(np.clip(picture, 0.0, 1.0) * 255.0).astype(np.uint8)


def _record(folder: Path, index: int) -> Path:
    return folder / f"view_{index:04d}.npz"


def _picture(folder: Path, index: int, name: str) -> Path:
    return folder / f"view_{index:04d}_{name}.png"


def save_step(folder: Path, step: PathStep, pictures: dict[str, np.ndarray]) -> None:
    """Write a view, pictures first and the record last: what has a record is whole."""
    for name, picture in {**pictures, "result": step.frame}.items():
        levels = picture if picture.dtype == np.uint8 else levels_of(picture)
        write_png8(_picture(folder, step.index, name), levels)
    with atomic_path(_record(folder, step.index)) as temporary:
        np.savez(temporary, texels=step.texels, values=step.values, hole_share=step.hole_share, skipped=step.skipped)


def load_step(folder: Path | None, index: int) -> PathStep | None:
    """A view that was written before, or ``None``."""
    if folder is None or not _record(folder, index).is_file():
        return None
    from PIL import Image

    with Image.open(_picture(folder, index, "result")) as file:
        frame = np.array(file)
    with np.load(_record(folder, index), allow_pickle=False) as stored:
        return PathStep(
            index, float(stored["hole_share"]), stored["texels"], stored["values"], frame, bool(stored["skipped"])
        )
