"""How much of the sun (or moon) places on the terrain see: exact shadow rays to points of its disc."""

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
    """Places with normals on the device, S to a receiver, ready for a sun anywhere.

    Parameters
    ----------
    terrain
        What is in the way.
    mi_origin
        ``mi.Point3f`` of N · S lanes, receiver by receiver.
    mi_normal, mi_outward
        Shading and geometric normals, three ``mi.Float16`` each.
    mi_weight
        Share of each place in its receiver, ``mi.Float16``.
    places
        S.
    """

    terrain: Occluder
    mi_origin: Any
    mi_normal: list[Any]
    mi_outward: list[Any]
    mi_weight: Any
    places: int

    @property
    def receivers(self) -> int:
        """N."""
        import drjit as dr

        return dr.width(self.mi_weight) // self.places


def sun_rays(terrain: Occluder, origin: np.ndarray, normal: np.ndarray, outward: np.ndarray,
             weight: np.ndarray) -> SunRays:  # fmt: skip
    """Shadow rays from places: ``(N, S, 3)`` origins and normals, ``(N, S)`` weights, 0 where there is no place."""
    import drjit as dr
    import mitsuba as mi

    mi_origin = point3(np.asarray(origin).reshape(-1, 3))
    halves = [
        [mi.Float16(np.ascontiguousarray(column, np.float16)) for column in np.asarray(values).reshape(-1, 3).T]
        for values in (normal, outward)
    ]
    mi_weight = mi.Float16(np.ascontiguousarray(weight, np.float16).ravel())
    dr.eval(mi_origin, halves, mi_weight)
    return SunRays(terrain, mi_origin, *halves, mi_weight, weight.shape[1])


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


def first_place_sees(rays: SunRays, luminary: Luminary) -> np.ndarray:
    """Whether the first place of each receiver faces and sees its point of the disc, ``(N,)`` bool."""
    import drjit as dr
    import mitsuba as mi

    seen = np.empty(rays.receivers, bool)
    disc = _mi_disc(luminary, rays.places)
    for start in range(0, len(seen), LANES):
        count = min(LANES, len(seen) - start)
        lane = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, start)
        visible, _, _ = _visible(rays, disc, lane * dr.opaque(mi.UInt32, rays.places))
        dr.eval(visible)
        seen[start : start + count] = np.array(visible)
    return seen


def incidence(rays: SunRays, luminary: Luminary, receiver: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted sums over the places of some receivers ``(K,)``: of cosine × visibility, and of the cosine alone."""
    import drjit as dr
    import mitsuba as mi

    sums = np.empty((2, len(receiver)), np.float32)
    disc = _mi_disc(luminary, rays.places)
    step = max(1, LANES // rays.places)
    for start in range(0, len(receiver), step):
        chosen = mi.UInt32(receiver[start : start + step].astype(np.uint32))
        number = dr.arange(mi.UInt32, dr.width(chosen) * rays.places)
        places = dr.opaque(mi.UInt32, rays.places)
        lane = dr.gather(mi.UInt32, chosen, number // places) * places + number % places
        visible, cosine, weight = _visible(rays, disc, lane)
        share = dr.fmax(cosine, 0.0) * weight
        blocks = [dr.block_sum(values, rays.places) for values in (dr.select(visible, share, 0.0), share)]
        dr.eval(blocks)
        sums[:, start : start + dr.width(chosen)] = [np.array(values) for values in blocks]
    return sums[0], sums[1]


def cosine_seen(rays: SunRays, luminary: Luminary) -> np.ndarray:
    """Cosine of incidence × visibility of every place ``(N, S)``, its own point of the disc each."""
    import drjit as dr
    import mitsuba as mi

    lane = dr.arange(mi.UInt32, rays.receivers * rays.places)
    visible, cosine, _ = _visible(rays, _mi_disc(luminary, rays.places), lane)
    result = dr.select(visible, cosine, 0.0)
    dr.eval(result)
    return np.array(result).reshape(-1, rays.places)


def _mi_disc(luminary: Luminary, places: int) -> tuple[Any, Any, Any]:
    """Directions to points of the disc and their number, and the direction to its centre."""
    import drjit as dr
    import mitsuba as mi

    count = max(places, 16)
    centre = mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in luminary.direction))
    return mi.Vector3f(point3(disc_directions(luminary, count))), dr.opaque(mi.UInt32, count), centre


def _visible(rays: SunRays, disc: tuple[Any, Any, Any], lane: Any) -> tuple[Any, Any, Any]:
    """Whether lanes of `SunRays` see the luminary, the cosine of incidence of its centre, and their weight.

    Where the facet turns its back a path tracer's shadow ray starts inside the mountain, so that is dark here too.
    """
    import drjit as dr
    import mitsuba as mi

    points, count, centre = disc
    cosine, outward = (
        sum(mi.Float(dr.gather(mi.Float16, column, lane)) * axis for column, axis in zip(columns, centre, strict=True))
        for columns in (rays.mi_normal, rays.mi_outward)
    )
    weight = mi.Float(dr.gather(mi.Float16, rays.mi_weight, lane))
    active = (cosine > 0.0) & (outward > 0.0) & (weight > 0.0)
    # Places of a receiver take the disc's points in turn; each receiver begins with another one.
    turn, _ = mi.sample_tea_32(lane // dr.opaque(mi.UInt32, rays.places), mi.UInt32(0x51ED270B))
    direction = dr.gather(mi.Vector3f, points, (lane + turn) % count)
    ray = mi.Ray3f(dr.gather(mi.Point3f, rays.mi_origin, lane, active), direction)
    return active & ~rays.terrain.mi_scene.ray_test(ray, active), cosine, weight
