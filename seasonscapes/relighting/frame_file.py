"""Storage of undeveloped frames: half-precision OpenEXR, scaled by the metered exposure of the frame.

A night scene is ten orders of magnitude darker than the disc of the sun, and half precision spans nine. Each frame is
scaled so that 1 is the saturation luminance at its metered exposure, which places the image in the range of half
precision.

The files are uncompressed OpenEXR, written and read here as what they are, rows of numbers behind a header: through the
library each frame took ten times as long, of which a quarter was to read the file again, since it says nothing of a full disk.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import struct
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.errors import DamagedFile
from seasonscapes.images import SATURATION_LUMINANCE, atomic_path

log = logging.getLogger(__name__)

# Just below the largest finite half-precision number, 65504.
_LARGEST = 60000.0
# The first four bytes of every OpenEXR file.
_MAGIC = 20000630


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
    scaled = np.asarray(radiance, np.float32) * np.float32(1.0 / scale)
    pixels = np.minimum(scaled, np.float32(_LARGEST), out=scaled).astype(np.float16)
    header = {
        "seasonscapes:metered_ev100": float(metered_ev100),
        "seasonscapes:provenance": provenance,
        "seasonscapes:sha256": _digest(pixels),
    }
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        file.write(_exr_header(pixels.shape[0], pixels.shape[1], header))
        file.write(_exr_rows(pixels).data)


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
    pixels, header = _read(path)
    metered = float(header["seasonscapes:metered_ev100"])
    radiance = pixels.astype(np.float32)
    radiance *= np.float32(SATURATION_LUMINANCE * 2.0**metered)
    return radiance, metered


def is_whole_frame(path: Path) -> bool:
    """Whether a file is a frame of `save_frame` whose pixels are those that were written."""
    if not path.is_file():
        return False
    try:
        pixels, header = _read(path)
        _metering_and_provenance(header)
        return header["seasonscapes:sha256"] == _digest(pixels)
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
    return _metering_and_provenance(_header(path))


def _metering_and_provenance(header: Mapping[str, Any]) -> tuple[float, dict[str, Any]]:
    provenance = header["seasonscapes:provenance"]
    provenance = json.loads(provenance) if isinstance(provenance, str) else provenance
    return float(header["seasonscapes:metered_ev100"]), provenance


def _exr_header(height: int, width: int, attributes: Mapping[str, Any]) -> bytes:
    """Header and table of offsets of a single-part file of scan lines (OpenEXR file layout, versions 2 and 3).

    Strings and floats are stored as such, everything else as JSON text, as by `images.write_exr`.
    """

    def attribute(name: str, kind: str, value: bytes) -> bytes:
        return name.encode() + b"\0" + kind.encode() + b"\0" + struct.pack("<i", len(value)) + value

    # Half floats, not perceptually linear, of every pixel; channels in alphabetical order.
    channels = b"".join(name + b"\0" + struct.pack("<iB3xii", 1, 0, 1, 1) for name in (b"B", b"G", b"R")) + b"\0"
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    parts = [
        attribute("channels", "chlist", channels),
        attribute("compression", "compression", b"\0"),
        attribute("dataWindow", "box2i", window),
        attribute("displayWindow", "box2i", window),
        attribute("lineOrder", "lineOrder", b"\0"),
        attribute("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        attribute("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
        attribute("screenWindowWidth", "float", struct.pack("<f", 1.0)),
    ]
    for name, value in attributes.items():
        if isinstance(value, float):
            parts.append(attribute(name, "float", struct.pack("<f", value)))
        else:
            text = value if isinstance(value, str) else json.dumps(value)
            parts.append(attribute(name, "string", text.encode()))
    # Version 2, with names of more than 31 characters allowed.
    header = struct.pack("<ii", _MAGIC, 2 | 1 << 10) + b"".join(parts) + b"\0"
    offsets = len(header) + 8 * height + _row_type(width).itemsize * np.arange(height, dtype="<u8")
    return header + offsets.tobytes()


def _row_type(width: int) -> np.dtype:
    """A scan line: its number, its size [bytes], and its channels B, G and R one after another."""
    return np.dtype([("y", "<i4"), ("size", "<i4"), ("channels", "<f2", (3, width))])


def _exr_rows(pixels: np.ndarray) -> np.ndarray:
    height, width, _ = pixels.shape
    rows = np.empty(height, _row_type(width))
    rows["y"], rows["size"] = np.arange(height), 6 * width
    for k, channel in enumerate((2, 1, 0)):
        rows["channels"][:, k] = pixels[..., channel]
    return rows


def _read(path: Path) -> tuple[np.ndarray, dict[str, Any]]:
    """Pixels ``(H, W, 3)``, half precision, and header of a file of `save_frame`.

    Raises
    ------
    DamagedFile
        Where its rows are not what `save_frame` writes.
    """
    header = _header(path)
    low, high = header["dataWindow"]
    width, height = (int(high[k]) - int(low[k]) + 1 for k in range(2))
    kind = _row_type(width)
    start = path.stat().st_size - height * kind.itemsize
    rows = np.fromfile(path, kind, height, offset=start) if start > 0 else np.empty(0, kind)
    if not (len(rows) == height and np.array_equal(rows["y"], np.arange(height)) and (rows["size"] == 6 * width).all()):
        raise DamagedFile(f"{path}: not the rows of a frame of {width} x {height} pixels; render it again")
    pixels = np.empty((height, width, 3), np.float16)
    for k, channel in enumerate((2, 1, 0)):
        pixels[..., channel] = rows["channels"][:, k]
    return pixels, header


def _header(path: Path) -> dict[str, Any]:
    import OpenEXR

    with OpenEXR.File(os.fspath(path), header_only=True) as file:
        return dict(file.header())


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
