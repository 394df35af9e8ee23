"""One frame on disk before it is developed: half-precision OpenEXR, scaled by its own metered exposure.

Night is ten orders of magnitude darker than the sun's disc and half precision spans nine; scaled so that 1 is what
saturates a sensor at the metered exposure, every frame uses its range where the picture is.
"""

from __future__ import annotations

import os
from datetime import datetime
from pathlib import Path

import numpy as np

from seasonscapes.images import SATURATION_LUMINANCE, read_exr, write_exr

_LARGEST = 60000.0


def save_frame(path: Path, radiance: np.ndarray, *, metered_ev100: float, record: dict) -> None:
    """Write scene-linear radiance ``(H, W, 3)`` [cd/m²], atomically."""
    scale = SATURATION_LUMINANCE * 2.0**metered_ev100
    header = {"seasonscapes:metered_ev100": float(metered_ev100), "seasonscapes:provenance": record}
    write_exr(path, {"": np.minimum(radiance / scale, _LARGEST)}, header=header, half=True)


def load_frame(path: Path) -> tuple[np.ndarray, float]:
    """Radiance ``(H, W, 3)`` float32 [cd/m²] and metered EV100 of a frame."""
    layers, header = read_exr(path)
    metered = float(header["seasonscapes:metered_ev100"])
    return layers[""].astype(np.float32) * np.float32(SATURATION_LUMINANCE * 2.0**metered), metered


def frame_ev100(path: Path) -> float:
    """The metered EV100 of a frame, without reading its pixels."""
    import OpenEXR

    with OpenEXR.File(os.fspath(path), header_only=True) as file:
        return float(file.header()["seasonscapes:metered_ev100"])


def time_stamp(time: datetime) -> str:
    """An aware UTC time as a file's stem: sorts by time, and does not depend on which other frames a film has."""
    return f"{time:%Y%m%dT%H%M%S}Z"


def frame_name(time: datetime) -> str:
    """The file of an aware UTC time's frame."""
    return f"{time_stamp(time)}.exr"
