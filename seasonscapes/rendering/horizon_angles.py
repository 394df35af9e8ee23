"""How high the terrain stands around places on it: one angle for each azimuth, found by bisection with shadow rays."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from seasonscapes.rendering.backend import point3
from seasonscapes.rendering.hemisphere_rays import RayScene, SurfacePoints

# Rays in one launch, and halvings of the range of angles: 11 of 75° leave 0.04°.
LANES, HALVINGS = 1 << 22, 11


def horizon_angles(
    terrain: RayScene,
    points: SurfacePoints,
    *,
    azimuths: int = 64,
    low_rad: float = -0.02,
    high_rad: float = 1.29,
    progress: Callable[[float], None] | None = None,
) -> np.ndarray:
    """Elevation ``(N, azimuths)`` float32 [rad] above which places see the sky; column 0 looks north, clockwise.

    On a height field what is above a free direction is free, so that halving finds the edge (Max 1988, "Horizon
    mapping: shadows for bump-mapped surfaces", doi:10.1007/BF01905562). ``low_rad`` where nothing stands above that.
    """
    import drjit as dr
    import mitsuba as mi

    count = len(points.origin)
    result = np.empty((count, azimuths), np.float32)
    step = max(1, LANES // azimuths)
    for start in range(0, count, step):
        origin = points.origin[start : start + step]
        lane = dr.arange(mi.UInt32, len(origin) * azimuths)
        place = lane // dr.opaque(mi.UInt32, azimuths)
        turn = mi.Float(lane - place * dr.opaque(mi.UInt32, azimuths)) * dr.opaque(mi.Float, 2.0 * np.pi / azimuths)
        east, north = dr.sincos(turn)
        at = dr.gather(mi.Point3f, point3(origin), place)
        lower = dr.full(mi.Float, low_rad, len(origin) * azimuths)
        upper = dr.full(mi.Float, high_rad, len(origin) * azimuths)
        for _ in range(HALVINGS):
            middle = 0.5 * (lower + upper)
            up, flat = dr.sincos(middle)
            blocked = terrain.mi_scene.ray_test(mi.Ray3f(at, mi.Vector3f(east * flat, north * flat, up)))
            lower, upper = dr.select(blocked, middle, lower), dr.select(blocked, upper, middle)
        edge = 0.5 * (lower + upper)
        dr.eval(edge)
        result[start : start + step] = np.array(edge).reshape(-1, azimuths)
        if progress is not None:
            progress(min(1.0, (start + step) / count))
    return result
