"""The ground below a camera of a place: how deep the camera lies in it, and cameras lifted out of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.calibration.ground_clearance import LEAST_ABOVE_GROUND_M, ground_tolerance_m
from seasonscapes.frames import geodetic_from_enu
from seasonscapes.terrain.surface import mesh_up_m

if TYPE_CHECKING:
    from seasonscapes.terrain.surface import Terrain
    from seasonscapes.workflows.place import Place

# A camera that was placed a metre above ground and read from a file again is not told of as lifted [m].
_LEAST_LIFT_M = 0.01


@dataclass(frozen=True)
class GroundBelow:
    """The ground at a camera's horizontal position.

    Parameters
    ----------
    up_m
        Up coordinate of the ground that is rendered, in the place's frame [m]; NaN beside the mesh.
    depth_m
        How far the camera lies below it [m]; negative above it, NaN beside the mesh.
    too_deep_m
        How far it lies below the heights of the rasters, as `calibrate` measures it, where that is more than they are known to
        [m]; else 0.
    tolerance_m
        What they are known to: half a cell, at least 5 m.
    """

    up_m: float
    depth_m: float
    too_deep_m: float
    tolerance_m: float

    @property
    def lifts(self) -> bool:
        """Whether the camera stands less than a metre above ground, or in it."""
        return self.depth_m + LEAST_ABOVE_GROUND_M > _LEAST_LIFT_M

    def __str__(self) -> str:
        where = "below" if self.depth_m > 0.0 else "above"
        return f"{abs(self.depth_m):.1f} m {where} the ground of the terrain, whose heights are known to {self.tolerance_m:.0f} m"


def ground_below(place: Place, position_m: np.ndarray) -> GroundBelow:
    """The ground below a camera at ``(3,)`` in a place's frame [m].

    Examples
    --------
    >>> import seasonscapes as ss
    >>> from seasonscapes.workflows.camera_ground import ground_below
    >>> place = ss.load_place("alpine_small")
    >>> view = ss.Viewpoint(latitude_deg=46.556, longitude_deg=7.98, above_ground_m=30.0, heading_deg=180.0)
    >>> below = ground_below(place, ss.camera(place, view).position_m)
    >>> round(below.depth_m, 1), below.lifts
    (-30.0, False)
    """
    from seasonscapes.calibration.terrain_horizon import terrain_height

    latitude, longitude, height = (float(each) for each in geodetic_from_enu(place.frame, position_m))
    in_heights_m = float(terrain_height(place.height_rasters, [latitude], [longitude])[0]) - height
    tolerance_m = ground_tolerance_m(place.height_rasters, latitude, longitude)
    up_m = rendered_up_m(place.terrain, position_m)
    too_deep_m = in_heights_m if in_heights_m > tolerance_m else 0.0
    return GroundBelow(up_m, up_m - float(position_m[2]), too_deep_m, tolerance_m)


def rendered_up_m(terrain: Terrain, position_m: np.ndarray) -> float:
    """Up coordinate of the highest ground that may be rendered below a camera at ``(3,)`` [m]; NaN beside the mesh."""
    up_m = mesh_up_m(terrain, position_m)
    if terrain.surface is not None and np.isfinite(up_m):
        # Near a camera the mesh is refined towards this surface.
        up_m = max(up_m, float(terrain.surface.up_at(np.asarray(position_m)[None])[0]))
    return up_m
