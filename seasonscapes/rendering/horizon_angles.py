"""Horizon angles of surface points: elevation of the terrain horizon per azimuth, by bisection with shadow rays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from seasonscapes.rendering.backend import point3
from seasonscapes.rendering.hemisphere_rays import RayScene, SurfacePoints

# Rays in one kernel launch, and bisection steps: 11 reduce a range of 75° to 0.04°.
LANES, BISECTIONS = 1 << 22, 11


def horizon_angles(
    terrain: RayScene,
    points: SurfacePoints,
    *,
    azimuths: int = 64,
    low_rad: float = -0.02,
    high_rad: float = 1.29,
    progress: Callable[[float], None] | None = None,
) -> np.ndarray:
    """Compute the elevation angle of the terrain horizon around surface points.

    On a height field all directions above an unoccluded direction are unoccluded as well, so that bisection finds the
    horizon (Max 1988, "Horizon mapping: shadows for bump-mapped surfaces", doi:10.1007/BF01905562).

    Parameters
    ----------
    terrain
        The occluding terrain.
    points
        N surface points.
    azimuths
        Number of azimuths, equally spaced, clockwise from north.
    low_rad, high_rad
        Range of elevations that is searched [rad].
    progress
        Called with the completed fraction.

    Returns
    -------
    numpy.ndarray
        ``(N, azimuths)`` float32 [rad]; about ``low_rad`` where no terrain rises above it.
    """
    import drjit as dr
    import mitsuba as mi

    count = len(points.origin)
    result = np.empty((count, azimuths), np.float32)
    step = max(1, LANES // azimuths)
    for start in range(0, count, step):
        origin = points.origin[start : start + step]
        lane = dr.arange(mi.UInt32, len(origin) * azimuths)
        point = lane // dr.opaque(mi.UInt32, azimuths)
        azimuth = mi.Float(lane - point * dr.opaque(mi.UInt32, azimuths)) * dr.opaque(mi.Float, 2.0 * np.pi / azimuths)
        east, north = dr.sincos(azimuth)
        mi_origin = dr.gather(mi.Point3f, point3(origin), point)
        lower = dr.full(mi.Float, low_rad, len(origin) * azimuths)
        upper = dr.full(mi.Float, high_rad, len(origin) * azimuths)
        for _ in range(BISECTIONS):
            middle = 0.5 * (lower + upper)
            sine, cosine = dr.sincos(middle)
            occluded = terrain.mi_scene.ray_test(mi.Ray3f(mi_origin, mi.Vector3f(east * cosine, north * cosine, sine)))
            lower, upper = dr.select(occluded, middle, lower), dr.select(occluded, upper, middle)
        horizon = 0.5 * (lower + upper)
        dr.eval(horizon)
        result[start : start + step] = np.array(horizon).reshape(-1, azimuths)
        if progress is not None:
            progress(min(1.0, (start + step) / count))
    return result
