"""Doubts about a calibration that contradicts what is known besides: the stated position, and heights of the terrain."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from seasonscapes.calibration.evidence import Correspondences
from seasonscapes.calibration.resection import Calibration
from seasonscapes.calibration.terrain_horizon import terrain_height
from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.frames import LocalFrame, geodetic_from_enu
from seasonscapes.terrain.surface import Raster

# A stated fact is contradicted where the solution lies further from it than this many of its standard deviations.
_MOST_SIGMAS = 3.0
# Summits are lower in a raster than they are, by tens of metres; geoid undulations of mountains are larger.
_LEAST_DATUM_OFFSET_M = 15.0


def position_doubts(stated: Camera | Panorama, solution: Calibration, axes: np.ndarray, sigma_m: float) -> list[str]:
    """Doubts where a solved position lies more than 3 σ from the stated one.

    Parameters
    ----------
    stated
        The view that the scene file describes.
    solution
        The calibrated view in the same frame.
    axes
        East, north and up at the camera, rows ``(3, 3)``.
    sigma_m
        Standard deviation of the stated position [m].

    Returns
    -------
    list of str
        One line for each direction; empty where the positions agree.
    """
    offset = np.asarray(axes) @ (solution.view.position_m - stated.position_m)
    names = (("east", "west"), ("north", "south"), ("above", "below"))
    return [
        f"the camera comes to stand {abs(step):.0f} m {positive if step > 0.0 else negative} "
        f"{'of ' if negative != 'below' else ''}its stated position, {abs(step) / sigma_m:.1f} times its standard "
        f"deviation of {sigma_m:g} m"
        for step, (positive, negative) in zip(offset, names, strict=True)
        if abs(step) > _MOST_SIGMAS * sigma_m
    ]


def datum_doubts(points: Correspondences, frame: LocalFrame, rasters: Sequence[Raster]) -> list[str]:
    """A doubt where the heights of matched points differ from the terrain's by one and the same amount.

    Parameters
    ----------
    points
        Matched points in ``frame``.
    frame
        Local frame.
    rasters
        Elevation rasters in order of precedence.

    Returns
    -------
    list of str
        At most one line.
    """
    latitude, longitude, height = geodetic_from_enu(frame, points.position_m)
    above = height - terrain_height(rasters, latitude, longitude)
    above = above[np.isfinite(above)]
    if len(above) < 3:
        return []
    middle = float(np.median(above))
    scatter = 1.4826 * float(np.median(np.abs(above - middle)))
    if abs(middle) < max(_LEAST_DATUM_OFFSET_M, 3.0 * scatter):
        return []
    return [
        f"the points' heights lie {abs(middle):.0f} m {'above' if middle > 0.0 else 'below'} the terrain, all alike "
        f"(scatter {scatter:.0f} m): they are probably in another vertical datum, such as ellipsoidal heights of GNSS"
    ]
