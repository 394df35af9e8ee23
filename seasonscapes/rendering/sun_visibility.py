"""How much of the sun (or moon) places on the terrain see: exact shadow rays to points of its disc."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.rendering.backend import point3
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.sky.illumination import Luminary

# Lanes in one launch: more do not run faster, and memory stays bounded.
LANES = 1 << 22
_BAYER = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]])


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
    mi_turn
        ``mi.UInt32`` of N lanes: the disc's point that each receiver begins with.
    places
        S.
    """

    terrain: RayScene
    mi_origin: Any
    mi_normal: list[Any]
    mi_outward: list[Any]
    mi_weight: Any
    mi_turn: Any
    places: int

    @property
    def receivers(self) -> int:
        """N."""
        import drjit as dr

        return dr.width(self.mi_weight) // self.places


def sun_rays(
    terrain: RayScene, places: tuple[np.ndarray, np.ndarray, np.ndarray], weight: np.ndarray, turn: np.ndarray
) -> SunRays:
    """Shadow rays from places.

    Parameters
    ----------
    places
        Origins, shading normals and geometric normals, ``(N, S, 3)`` each.
    weight
        ``(N, S)``, 0 where there is no place.
    turn
        ``(N,)`` any whole numbers. Places of a receiver take points of the disc in turn, beginning with this one:
            neighbours that begin with different ones soon disagree in a penumbra, see `pixel_turn`.
    """
    import drjit as dr
    import mitsuba as mi

    origin, *normals = places
    mi_origin = point3(np.asarray(origin).reshape(-1, 3))
    halves = [
        [mi.Float16(np.ascontiguousarray(column, np.float16)) for column in np.asarray(values).reshape(-1, 3).T]
        for values in normals
    ]
    mi_weight = mi.Float16(np.ascontiguousarray(weight, np.float16).ravel())
    mi_turn = mi.UInt32((np.asarray(turn, np.int64) % 256).astype(np.uint32))
    dr.eval(mi_origin, halves, mi_weight, mi_turn)
    return SunRays(terrain, mi_origin, *halves, mi_weight, mi_turn, weight.shape[1])


def pixel_turn(pixel: np.ndarray, width_px: int, places: int) -> np.ndarray:
    """Point of the disc that each pixel begins with: every 4 × 4 pixels have sixteen different ones (Bayer's matrix)."""
    row, column = np.divmod(pixel, width_px)
    return _BAYER[row % 4, column % 4] * max(places // 16, 1)


def numbered_turn(number: np.ndarray) -> np.ndarray:
    """Points of the disc for receivers that have numbers instead of neighbours (Knuth's multiplicative hash)."""
    return (np.asarray(number, np.uint64) * np.uint64(2654435761) % np.uint64(1 << 32) >> np.uint64(16)).astype(
        np.int64
    )


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
        lanes = [dr.select(visible, share, 0.0), share]
        dr.eval(lanes)
        blocks = [dr.block_sum(values, rays.places) for values in lanes]
        dr.eval(blocks)
        sums[:, start : start + dr.width(chosen)] = [np.array(values) for values in blocks]
    return sums[0], sums[1]


def cosine_seen(rays: SunRays, luminary: Luminary, *, each: int = 1) -> np.ndarray:
    """Cosine of incidence × visibility of every place ``(N, S)``, from ``each`` points of the disc."""
    import drjit as dr
    import mitsuba as mi

    disc = _mi_disc(luminary, rays.places * each)
    result = np.empty(rays.receivers * rays.places, np.float32)
    step = max(1, LANES // each)
    for start in range(0, len(result), step):
        count = min(step, len(result) - start)
        number = dr.arange(mi.UInt32, count * each)
        place = number // dr.opaque(mi.UInt32, each)
        again = (number - place * dr.opaque(mi.UInt32, each)) * dr.opaque(mi.UInt32, rays.places)
        visible, cosine, _ = _visible(rays, disc, place + dr.opaque(mi.UInt32, start), again)
        seen = dr.select(visible, cosine, 0.0)
        dr.eval(seen)
        result[start : start + count] = np.array(dr.block_sum(seen, each)) / each
    return result.reshape(-1, rays.places)


def _mi_disc(luminary: Luminary, places: int) -> tuple[Any, Any, Any]:
    """Directions to points of the disc and their number, and the direction to its centre."""
    import drjit as dr
    import mitsuba as mi

    count = max(places, 16)
    centre = mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in luminary.direction))
    return mi.Vector3f(point3(disc_directions(luminary, count))), dr.opaque(mi.UInt32, count), centre


def _visible(rays: SunRays, disc: tuple[Any, Any, Any], lane: Any, again: Any = 0) -> tuple[Any, Any, Any]:
    """Whether lanes of `SunRays` see the luminary, the cosine of incidence of its centre, and their weight.

    ``again`` moves on to other points of the disc.

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
    places = dr.opaque(mi.UInt32, rays.places)
    receiver = lane // places
    turn = lane - receiver * places + dr.gather(mi.UInt32, rays.mi_turn, receiver) + again
    direction = dr.gather(mi.Vector3f, points, turn % count)
    ray = mi.Ray3f(dr.gather(mi.Point3f, rays.mi_origin, lane, active), direction)
    return active & ~rays.terrain.mi_scene.ray_test(ray, active), cosine, weight
