"""How much of the sun (or moon) the samples of a view see: exact shadow rays, many only where one is not enough."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.rendering.backend import point3
from seasonscapes.rendering.gather import Occluder
from seasonscapes.sky.illumination import Luminary

# Lanes in one launch: more do not run faster, and memory stays bounded.
LANES = 1 << 22


@dataclass(frozen=True)
class SunRays:
    """Origins of shadow rays, on the device, ready to be sent anywhere.

    Parameters
    ----------
    terrain
        What is in the way.
    mi_origin
        ``mi.Point3f`` of N lanes.
    disc
        Number of points on the disc among which neighbouring lanes are shared out.
    """

    terrain: Occluder
    mi_origin: Any
    disc: int


def sun_rays(terrain: Occluder, origin: np.ndarray, *, disc: int = 16) -> SunRays:
    """Shadow rays from places ``(N, 3)``; every ``disc`` neighbours together cover the whole disc of sun or moon."""
    import drjit as dr

    mi_origin = point3(origin.reshape(-1, 3))
    dr.eval(mi_origin)
    return SunRays(terrain, mi_origin, disc)


def disc_directions(luminary: Luminary, count: int) -> np.ndarray:
    """Unit directions ``(count, 3)`` to points spread evenly over a luminary's disc (Vogel 1979's sunflower)."""
    axis = np.asarray(luminary.direction, float)
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    number = np.arange(count)
    radius = np.tan(np.radians(luminary.angular_radius_deg)) * np.sqrt((number + 0.5) / count)
    turn = number * np.pi * (3.0 - np.sqrt(5.0))
    direction = axis + radius[:, None] * (np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * other)
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def sees(rays: SunRays, luminary: Luminary, lane: np.ndarray) -> np.ndarray:
    """Whether the lanes ``(K,)`` of `SunRays` see their point of the disc, ``(K,)`` bool.

    Which point a lane looks at is fixed: its number, scrambled so that neighbouring pixels differ.
    """
    import mitsuba as mi

    disc = mi.Vector3f(point3(disc_directions(luminary, rays.disc)))
    lane = np.asarray(lane, np.uint32)
    seen = np.empty(len(lane), bool)
    for start in range(0, len(lane), LANES):
        part = lane[start : start + LANES]
        seen[start : start + len(part)] = _sees_block(rays, disc, mi.UInt32(part))
    return seen


def _sees_block(rays: SunRays, disc: Any, lane: Any) -> np.ndarray:
    import drjit as dr
    import mitsuba as mi

    count = dr.opaque(mi.UInt32, rays.disc)
    # Cells of neighbours get the points in the same order, but each cell begins at another.
    turn, _ = mi.sample_tea_32(lane // count, mi.UInt32(0x51ED270B))
    direction = dr.gather(mi.Vector3f, disc, (lane + turn) % count)
    ray = mi.Ray3f(dr.gather(mi.Point3f, rays.mi_origin, lane), direction)
    blocked = rays.terrain.mi_scene.ray_test(ray)
    dr.eval(blocked)
    return ~np.array(blocked)
