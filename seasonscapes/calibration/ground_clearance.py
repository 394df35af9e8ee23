"""How well the ground under a camera is known, and how far in it a solved camera may lie: one rule for all stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from seasonscapes.calibration.terrain_horizon import cell_size_m, terrain_height
from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera

if TYPE_CHECKING:
    from seasonscapes.terrain.surface import Raster

AnyView = TypeVar("AnyView", bound=Camera | Panorama)
# No camera lies on the ground: the lowest ones stand on posts and sills.
LEAST_ABOVE_GROUND_M = 1.0
# Standard deviation of interpolated heights of mountains: a share of a cell's side, and at least so much [m].
_SIGMA_PER_CELL, _LEAST_SIGMA_M = 0.1, 1.0
# So many standard deviations of the heights a camera may lie in the ground.
TOLERANCE_SIGMAS = 5.0


def height_sigma_m(rasters: Sequence[Raster], latitude_deg: float, longitude_deg: float) -> float:
    """Standard deviation of the heights at a position: a tenth of a cell's side, at least 1 m.

    Parameters
    ----------
    rasters
        Elevation rasters in order of precedence; the first that has a height there counts, or else the first.
    latitude_deg, longitude_deg
        WGS 84 position [deg].

    Returns
    -------
    float
        [m].

    Examples
    --------
    >>> import seasonscapes as ss
    >>> from seasonscapes.calibration.ground_clearance import height_sigma_m
    >>> place = ss.load_place("alpine_small")
    >>> round(height_sigma_m([place.elevation], 46.556, 7.98), 1)
    6.0
    """
    at = [latitude_deg], [longitude_deg]
    covering = [each for each in rasters if np.isfinite(terrain_height([each], *at)[0])]
    return max(_SIGMA_PER_CELL * cell_size_m((covering or rasters)[0]), _LEAST_SIGMA_M)


def ground_tolerance_m(rasters: Sequence[Raster], latitude_deg: float, longitude_deg: float) -> float:
    """How far below the ground a solved camera may lie, since heights are known no better [m]: half a cell, at least 5 m.

    `resection.resect` accepts solutions as far down when it is given `height_sigma_m`, and what uses calibrated cameras lifts
    them out of the ground. Parameters are those of `height_sigma_m`.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> from seasonscapes.calibration.ground_clearance import ground_tolerance_m
    >>> place = ss.load_place("alpine_small")
    >>> round(ground_tolerance_m([place.elevation], 46.556, 7.98))
    30
    """
    return TOLERANCE_SIGMAS * height_sigma_m(rasters, latitude_deg, longitude_deg)


def clear_of_ground(view: AnyView, ground_up_m: float) -> AnyView:
    """A view at least a metre above ground: raised to that where it stands lower, and the view itself elsewhere.

    Parameters
    ----------
    view
        Camera or panorama.
    ground_up_m
        Up coordinate of the ground below it, in its frame [m]; NaN where it is unknown.

    Returns
    -------
    Camera or Panorama
        With the same rotation.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> from seasonscapes.calibration.ground_clearance import clear_of_ground
    >>> place = ss.load_place("alpine_small")
    >>> view = ss.camera(place, "meadow", size_px=(96, 64))
    >>> up_m = float(view.position_m[2])
    >>> float(clear_of_ground(view, up_m + 3.0).position_m[2]) - up_m
    4.0
    """
    lowest_m = ground_up_m + LEAST_ABOVE_GROUND_M
    if not view.position_m[2] < lowest_m:
        return view
    pose = view.world_from_camera.copy()
    pose[2, 3] = lowest_m
    return replace(view, world_from_camera=pose)
