"""Storage of undeveloped frames: half-precision OpenEXR, scaled by the metered exposure of the frame.

A night scene is ten orders of magnitude darker than the disc of the sun, and half precision spans nine. Each frame is
scaled so that 1 is the saturation luminance at its metered exposure, which places the image in the range of half
precision.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.images import SATURATION_LUMINANCE, read_exr, write_exr

log = logging.getLogger(__name__)

# Just below the largest finite half-precision number, 65504.
_LARGEST = 60000.0


def save_frame(path: Path, radiance: np.ndarray, *, metered_ev100: float, provenance: dict[str, Any]) -> None:
    """Write a frame, atomically.

    Parameters
    ----------
    path
        Output file.
    radiance
        ``(H, W, 3)`` scene-linear radiance [cd/m²].
    metered_ev100
        Metered exposure of the frame [EV100].
    provenance
        Provenance: plain values, stored in the header of the file.
    """
    scale = SATURATION_LUMINANCE * 2.0**metered_ev100
    pixels = np.minimum(radiance / scale, _LARGEST).astype(np.float16)
    header = {
        "seasonscapes:metered_ev100": float(metered_ev100),
        "seasonscapes:provenance": provenance,
        "seasonscapes:sha256": _digest(pixels),
    }
    write_exr(path, {"": pixels}, header=header, half=True, quick=True)


def load_frame(path: Path) -> tuple[np.ndarray, float]:
    """Read a frame.

    Parameters
    ----------
    path
        File of `save_frame`.

    Returns
    -------
    radiance
        ``(H, W, 3)`` float32 scene-linear radiance [cd/m²].
    metered_ev100
        Metered exposure of the frame [EV100].
    """
    layers, header = read_exr(path)
    metered = float(header["seasonscapes:metered_ev100"])
    return layers[""].astype(np.float32) * np.float32(SATURATION_LUMINANCE * 2.0**metered), metered


def is_whole_frame(path: Path) -> bool:
    """Whether a file is a frame of `save_frame` whose pixels are those that were written."""
    if not path.is_file():
        return False
    try:
        layers, header = read_exr(path)
        frame_header(path)
        return header["seasonscapes:sha256"] == _digest(layers[""])
    except (RuntimeError, OSError, ValueError, KeyError, TypeError):
        # What OpenEXR and its readers raise for damaged files; the frame is rendered again.
        log.info("%s: a damaged frame is rendered again", path.name)
        return False


def _digest(pixels: np.ndarray) -> str:
    return hashlib.sha256(np.ascontiguousarray(pixels, np.float16).tobytes()).hexdigest()


def frame_header(path: Path) -> tuple[float, dict[str, Any]]:
    """Read the metered exposure and the provenance of a frame, without its pixels.

    Parameters
    ----------
    path
        File of `save_frame`.

    Returns
    -------
    metered_ev100
        Metered exposure [EV100].
    provenance
        As given to `save_frame`.
    """
    import OpenEXR

    with OpenEXR.File(os.fspath(path), header_only=True) as file:
        header = file.header()
        provenance = header["seasonscapes:provenance"]
        provenance = json.loads(provenance) if isinstance(provenance, str) else provenance
        return float(header["seasonscapes:metered_ev100"]), provenance


def time_stamp(time: datetime) -> str:
    """Format a time as the stem of a file name that sorts by time.

    Parameters
    ----------
    time
        Aware datetime in UTC.

    Returns
    -------
    str
        Such as ``20240901T080000Z``.
    """
    return f"{time:%Y%m%dT%H%M%S}Z"


def frame_name(time: datetime) -> str:
    """Return the file name of a frame.

    Parameters
    ----------
    time
        Aware datetime in UTC.

    Returns
    -------
    str
        Such as ``20240901T080000Z.exr``.
    """
    return f"{time_stamp(time)}.exr"
