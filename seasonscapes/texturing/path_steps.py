"""Result of inpainting one view of a path, and its storage: images for inspection and a record to resume from."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from seasonscapes.array_files import read_arrays
from seasonscapes.errors import InputError
from seasonscapes.images import atomic_path, write_png8

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PathStep:
    """Result of inpainting one view.

    Parameters
    ----------
    index
        Number of the view in the path.
    hole_share
        Fraction of the view's terrain pixels that were a hole.
    texels
        ``(N,)`` flat indices of the texels that received a value.
    values
        ``(N, 3)`` float32 their radiance [cd/m²].
    frame
        ``(H, W, 3)`` uint8 sRGB, the composed image.
    skipped
        Whether the image model was not run.
    """

    index: int
    hole_share: float
    texels: np.ndarray
    values: np.ndarray
    frame: np.ndarray
    skipped: bool


def to_uint8(picture: np.ndarray) -> np.ndarray:
    """Quantise an image to 8 bits.

    Parameters
    ----------
    picture
        ``(...)``, clipped to [0, 1].

    Returns
    -------
    ndarray
        ``(...)`` uint8.
    """
    return np.round(np.clip(picture, 0.0, 1.0) * 255.0).astype(np.uint8)


def _record_path(folder: Path, index: int) -> Path:
    return folder / f"view_{index:04d}.npz"


def _picture_path(folder: Path, index: int, name: str) -> Path:
    return folder / f"view_{index:04d}_{name}.png"


def save_step(folder: Path, step: PathStep, pictures: dict[str, np.ndarray]) -> None:
    """Write a step: first its images, then its record, so that a record implies complete images.

    Parameters
    ----------
    folder
        Folder to write to.
    step
        The result.
    pictures
        Further images by name, ``(H, W)`` or ``(H, W, 3)``, in [0, 1] or uint8.
    """
    for name, picture in {**pictures, "result": step.frame}.items():
        levels = picture if picture.dtype == np.uint8 else to_uint8(picture)
        write_png8(_picture_path(folder, step.index, name), levels)
    with atomic_path(_record_path(folder, step.index)) as temporary:
        np.savez(temporary, texels=step.texels, values=step.values, hole_share=step.hole_share, skipped=step.skipped)


def load_step(folder: Path | None, index: int) -> PathStep | None:
    """Read a step that `save_step` wrote.

    Parameters
    ----------
    folder
        Folder of the steps, or ``None`` for none.
    index
        Number of the view in the path.

    Returns
    -------
    PathStep or None
        ``None`` where no complete step is stored, or a damaged one, which is told.
    """
    if folder is None or not _record_path(folder, index).is_file():
        return None
    from PIL import Image

    names = ("hole_share", "texels", "values", "skipped")
    try:
        stored = read_arrays(_record_path(folder, index), names, what="a step of a path")
        with Image.open(_picture_path(folder, index, "result")) as file:
            frame = np.array(file)
    except (InputError, OSError, SyntaxError) as error:
        log.info("%s; the view is painted again", error)
        return None
    return PathStep(
        index, float(stored["hole_share"]), stored["texels"], stored["values"], frame, bool(stored["skipped"])
    )
