"""Sky maps for other programs: equirectangular OpenEXR in the layouts that they expect."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.images import write_exr

# What the columns of a map are, left to right; rows run from zenith to nadir in both.
EAST_CENTRED = "equirectangular; left edge west, then north, east (centre), south; row 0 zenith (three.js, Blender)"
NORTH_EDGED = "equirectangular; left edge north, then east, south (centre), west; row 0 zenith (OpenEXR latlong, USD)"


def write_sky(path: Path, sky_radiance: np.ndarray, about: dict[str, Any], *, layout: str) -> None:
    """Write the sky without sun and moon as float32 OpenEXR, scene-linear Rec.709 [cd/m²], atomically.

    Parameters
    ----------
    path
        File to write.
    sky_radiance
        Map as in `sky.illumination.Illumination`.
    about
        Plain values for the header.
    layout
        `EAST_CENTRED` or `NORTH_EDGED`.
    """
    header = {"seasonscapes:provenance": about, "seasonscapes:units": "cd/m2", "seasonscapes:layout": layout}
    write_exr(path, {"": sky_in_layout(sky_radiance, layout)}, header=header)


def sky_in_layout(sky_radiance: np.ndarray, layout: str) -> np.ndarray:
    """A sky map with its columns in another program's order."""
    width = sky_radiance.shape[1]
    if layout == NORTH_EDGED:
        return sky_radiance
    if layout != EAST_CENTRED or width % 4:
        raise ValueError(
            f"sky_in_layout: got {layout!r} of {width} columns, expected a known layout and a multiple of 4"
        )
    return np.roll(sky_radiance, width // 4, axis=1)
