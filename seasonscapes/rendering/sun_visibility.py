"""Visibility of the sun's (or moon's) disc from surface points, by shadow rays to points of the disc."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from seasonscapes.rendering.backend import aligned, point3
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.rendering.terrain_material import shadow_ray_start
from seasonscapes.sky.illumination import Luminary

# Rays in one kernel launch; bounds the memory, and more are not faster.
LANES = 1 << 22
_BAYER = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]])


@dataclass(frozen=True)
class _Disc:
    """Points of a luminary's disc on the device: their directions and number, and the direction to the centre."""

    mi_directions: Any
    count: int
    mi_centre: Any


@dataclass(frozen=True)
class SunRays:
    """Origins and normals of shadow rays on the Dr.Jit device: S sample points for each of N receivers.

    Parameters
    ----------
    terrain
        The occluding terrain.
    mi_origin
        ``mi.Point3f`` of N · S lanes, the samples of a receiver side by side.
    mi_normal, mi_geometric_normal
        Shading and geometric normals, three ``mi.Float16`` arrays each.
    mi_weight
        ``mi.Float16``: weight of each sample in its receiver.
    mi_disc_offset
        ``mi.UInt32`` of N lanes: index of the disc point that the first sample of each receiver uses.
    samples
        Number S of samples per receiver.
    disc_points
        Number of points of the disc, of which those of a receiver's samples are some.
    """

    terrain: RayScene
    mi_origin: Any
    mi_normal: list[Any]
    mi_geometric_normal: list[Any]
    mi_weight: Any
    mi_disc_offset: Any
    samples: int
    disc_points: int

    @property
    def receivers(self) -> int:
        """Number N of receivers."""
        import drjit as dr

        return dr.width(self.mi_weight) // self.samples

    @cached_property
    def first(self) -> SunRays:
        """Rays of the first sample of each receiver, side by side: among the others each takes cache lines of its own."""
        import drjit as dr
        import mitsuba as mi

        lane = dr.arange(mi.UInt32, self.receivers) * dr.opaque(mi.UInt32, self.samples)
        origin = dr.gather(mi.Point3f, self.mi_origin, lane)
        normal, geometric_normal = (
            [dr.gather(mi.Float16, column, lane) for column in columns]
            for columns in (self.mi_normal, self.mi_geometric_normal)
        )
        weight = dr.gather(mi.Float16, self.mi_weight, lane)
        dr.eval(origin, normal, geometric_normal, weight)
        return replace(
            self, mi_origin=origin, mi_normal=normal, mi_geometric_normal=geometric_normal, mi_weight=weight, samples=1
        )


def sun_rays(
    terrain: RayScene,
    origin_m: np.ndarray,
    normal: np.ndarray,
    geometric_normal: np.ndarray,
    weight: np.ndarray,
    disc_offset: np.ndarray,
) -> SunRays:
    """Copy the origins and normals of shadow rays to the device.

    Parameters
    ----------
    terrain
        The occluding terrain.
    origin_m
        ``(N, S, 3)`` origins of the rays, off the surface, ENU [m].
    normal, geometric_normal
        ``(N, S, 3)`` unit shading normals and unit geometric normals.
    weight
        ``(N, S)`` weight of each sample in its receiver, 0 for samples that are not on the terrain.
    disc_offset
        ``(N,)`` integers. The samples of a receiver use successive points of the disc, beginning with this one;
        different offsets of neighbouring receivers dither penumbrae, see `bayer_disc_offset`.

    Returns
    -------
    SunRays
        The device copy, for any position of the luminary.
    """
    import drjit as dr
    import mitsuba as mi

    mi_origin = point3(np.asarray(origin_m).reshape(-1, 3))

    def columns(values: np.ndarray) -> list[Any]:
        return [mi.Float16(aligned(column, np.float16)) for column in np.asarray(values).reshape(-1, 3).T]

    mi_normal = columns(normal)
    mi_geometric_normal = mi_normal if geometric_normal is normal else columns(geometric_normal)
    mi_weight = mi.Float16(aligned(weight, np.float16).ravel())
    mi_disc_offset = mi.UInt32(aligned(np.asarray(disc_offset, np.int64) % 256, np.uint32))
    dr.eval(mi_origin, mi_normal, mi_geometric_normal, mi_weight, mi_disc_offset)
    samples = weight.shape[1]
    return SunRays(terrain, mi_origin, mi_normal, mi_geometric_normal, mi_weight, mi_disc_offset, samples, samples)


def raised_rays(rays: SunRays, height_m: float) -> SunRays:
    """Shadow rays that start higher by a height [m]: what an error of the heights does to shadows."""
    import drjit as dr
    import mitsuba as mi

    origin = rays.mi_origin
    raised = mi.Point3f(origin.x, origin.y, origin.z + height_m)
    dr.eval(raised)
    return replace(rays, mi_origin=raised)


def bayer_disc_offset(pixel: np.ndarray, width_px: int, samples: int) -> np.ndarray:
    """Compute the disc offsets of pixels: the 16 pixels of each 4 × 4 block have different ones (Bayer's matrix).

    Parameters
    ----------
    pixel
        ``(N,)`` flat pixel indices.
    width_px
        Width of the image [px].
    samples
        Number S of samples per pixel.

    Returns
    -------
    numpy.ndarray
        ``(N,)`` integers, for `sun_rays`.
    """
    row, column = np.divmod(pixel, width_px)
    return _BAYER[row % 4, column % 4] * max(samples // 16, 1)


def hashed_disc_offset(number: np.ndarray) -> np.ndarray:
    """Compute the disc offsets of receivers that are no pixels, by Knuth's multiplicative hash.

    Parameters
    ----------
    number
        ``(N,)`` index of each receiver.

    Returns
    -------
    numpy.ndarray
        ``(N,)`` int64, for `sun_rays`.
    """
    return (np.asarray(number, np.uint64) * np.uint64(2654435761) % np.uint64(1 << 32) >> np.uint64(16)).astype(
        np.int64
    )


def disc_directions(luminary: Luminary, count: int) -> np.ndarray:
    """Compute directions to points evenly distributed over the disc of a luminary (Vogel 1979's sunflower).

    Parameters
    ----------
    luminary
        Sun or moon.
    count
        Number of points.

    Returns
    -------
    numpy.ndarray
        ``(count, 3)`` unit directions, ENU.
    """
    axis = np.asarray(luminary.direction, float)
    side = np.cross(axis, [0.0, 0.0, 1.0] if abs(axis[2]) < 0.9 else [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    other = np.cross(axis, side)
    index = np.arange(count)
    radius = np.tan(np.radians(luminary.angular_radius_deg)) * np.sqrt((index + 0.5) / count)
    angle = index * np.pi * (3.0 - np.sqrt(5.0))
    direction = axis + radius[:, None] * (np.cos(angle)[:, None] * side + np.sin(angle)[:, None] * other)
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)


def start_first_samples(rays: SunRays, luminary: Luminary) -> Callable[[], np.ndarray]:
    """Start testing whether the luminary is visible from the first sample of each receiver.

    Other threads trace while the caller computes something else; between kernels that are read one by one they would wait,
    which takes the processor's time as much as work does.

    Parameters
    ----------
    rays
        Shadow rays of N receivers.
    luminary
        Sun or moon.

    Returns
    -------
    Callable
        Reader of ``(N,)`` bool: the sample faces the luminary, and its point of the disc is not occluded.
    """
    import drjit as dr
    import mitsuba as mi

    parts = []
    disc = _mi_disc(luminary, rays.disc_points)
    for start in range(0, rays.receivers, LANES):
        count = min(LANES, rays.receivers - start)
        receiver = None if count == rays.receivers else dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, start)
        visible, _, _ = _visible(rays.first, disc, receiver, receiver)
        dr.eval(visible)
        parts.append(visible)
    return lambda: np.concatenate([np.empty(0, bool), *(np.array(part) for part in parts)])


def start_sum_facing(rays: SunRays, luminary: Luminary, receiver: np.ndarray) -> Callable[[], np.ndarray]:
    """Start summing the cosine of incidence over those samples of receivers that face the luminary, without shadow rays.

    Parameters
    ----------
    rays, luminary, receiver
        As in `sum_incidence`.

    Returns
    -------
    Callable
        Reader of ``(K,)`` float32 weighted sums of the cosine: `sum_incidence` where nothing occludes the luminary; see
        `start_first_samples`.
    """
    read = _start_sums(rays, luminary, receiver, traced=False)
    return lambda: read()[0]


def sum_incidence(rays: SunRays, luminary: Luminary, receiver: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sum the cosine of incidence over the samples of receivers, with and without occlusion.

    Parameters
    ----------
    rays
        Shadow rays of N receivers.
    luminary
        Sun or moon.
    receiver
        ``(K,)`` indices of the receivers to evaluate.

    Returns
    -------
    visible
        ``(K,)`` float32 weighted sums of cosine × visibility.
    unoccluded
        ``(K,)`` float32 weighted sums of the cosine.
    """
    return start_sum_incidence(rays, luminary, receiver)()


def start_sum_incidence(
    rays: SunRays, luminary: Luminary, receiver: np.ndarray
) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """Start `sum_incidence`, and return the function that gives its result; see `start_first_samples`."""
    read = _start_sums(rays, luminary, receiver, traced=True)

    def visible_and_unoccluded() -> tuple[np.ndarray, np.ndarray]:
        visible, unoccluded = read()
        return visible, unoccluded

    return visible_and_unoccluded


def _start_sums(rays: SunRays, luminary: Luminary, receiver: np.ndarray, *, traced: bool) -> Callable[[], np.ndarray]:
    """Reader of what `sum_incidence` returns, ``(2, K)``; without shadow rays of `start_sum_facing`, ``(1, K)``."""
    import drjit as dr
    import mitsuba as mi

    parts = []
    disc = _mi_disc(luminary, rays.disc_points)
    step = max(1, LANES // rays.samples)
    for start in range(0, len(receiver), step):
        chosen = mi.UInt32(aligned(receiver[start : start + step], np.uint32))
        index = dr.arange(mi.UInt32, dr.width(chosen) * rays.samples)
        number, sample = _quotient_and_remainder(index, rays.samples)
        each = dr.gather(mi.UInt32, chosen, number)
        lane = each * dr.opaque(mi.UInt32, rays.samples) + sample
        if traced:
            visible, cosine, weight = _visible(rays, disc, lane, each, sample, coherent=True)
        else:
            visible, cosine, _, weight = _facing(rays, disc, lane)
        weighted = dr.fmax(cosine, 0.0) * weight
        lanes = [dr.select(visible, weighted, 0.0), *([weighted] if traced else [])]
        dr.eval(lanes)
        blocks = [dr.block_sum(values, rays.samples) for values in lanes]
        dr.eval(blocks)
        parts.append(blocks)
    nothing = np.empty((1 + traced, 0), np.float32)
    return lambda: np.concatenate([nothing, *([np.array(values) for values in blocks] for blocks in parts)], axis=1)


def visible_cosine(rays: SunRays, luminary: Luminary, *, rays_per_sample: int = 1) -> np.ndarray:
    """Compute cosine of incidence × visibility of the luminary for all samples.

    Parameters
    ----------
    rays
        Shadow rays of N receivers with S samples each.
    luminary
        Sun or moon.
    rays_per_sample
        Shadow rays per sample, to different points of the disc.

    Returns
    -------
    numpy.ndarray
        ``(N, S)`` float32, zero where the luminary is not visible.
    """
    return _read_cosines(rays, _cosines(rays, luminary, rays_per_sample))


def start_visible_cosine(rays: SunRays, luminary: Luminary, *, coherent: bool = True) -> Callable[[], np.ndarray]:
    """Start `visible_cosine`, and return the function that gives its result; see `start_first_samples`.

    ``coherent``: the samples of a receiver lie so close together that tracing them in packets pays.
    """
    parts = list(_cosines(rays, luminary, 1, coherent=coherent))
    return lambda: _read_cosines(rays, parts)


def _read_cosines(rays: SunRays, parts: Iterable[Any]) -> np.ndarray:
    """Join what `_cosines` gives: ``(N, S)``."""
    result, start = np.empty(rays.receivers * rays.samples, np.float32), 0
    for part in parts:
        values = np.array(part)
        result[start : start + len(values)] = values
        start += len(values)
    return result.reshape(-1, rays.samples)


def _cosines(rays: SunRays, luminary: Luminary, rays_per_sample: int, *, coherent: bool = True) -> Iterator[Any]:
    """What `visible_cosine` computes, launched part by part: ``mi.Float`` of some successive samples."""
    import drjit as dr
    import mitsuba as mi

    disc = _mi_disc(luminary, rays.disc_points * rays_per_sample)
    total = rays.receivers * rays.samples
    # A receiver's points of the disc are counted from its first sample on.
    step = max(1, LANES // (rays.samples * rays_per_sample)) * rays.samples
    for start in range(0, total, step):
        count = min(step, total - start)
        lane, ray = _quotient_and_remainder(dr.arange(mi.UInt32, count * rays_per_sample), rays_per_sample)
        receiver, sample = _quotient_and_remainder(lane, rays.samples)
        whole = rays_per_sample == 1 and count == total
        lane = None if whole else lane + dr.opaque(mi.UInt32, start)
        receiver += dr.opaque(mi.UInt32, start // rays.samples)
        disc_point = sample + ray * dr.opaque(mi.UInt32, rays.samples)
        visible, cosine, _ = _visible(rays, disc, lane, receiver, disc_point, coherent=coherent)
        lanes = dr.select(visible, cosine, 0.0)
        dr.eval(lanes)
        if rays_per_sample > 1:
            lanes = dr.block_sum(lanes, rays_per_sample) / dr.opaque(mi.Float, rays_per_sample)
        yield lanes


def _mi_disc(luminary: Luminary, points: int) -> _Disc:
    import drjit as dr
    import mitsuba as mi

    centre = mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in luminary.direction))
    count = max(points, 16)
    return _Disc(mi.Vector3f(point3(disc_directions(luminary, count))), count, centre)


def _quotient_and_remainder(number: Any, divisor: int) -> tuple[Any, Any]:
    """Quotient and remainder of ``mi.UInt32`` below `LANES` and an integer that kernels need not be compiled for.

    Processors divide no vectors of integers, and four divisions took as long as all else before a shadow ray. Granlund and
    Montgomery 1994's multiplication by a reciprocal is exact while the product of both numbers is below 2³².
    """
    import drjit as dr
    import mitsuba as mi

    if divisor == 1:
        return number, mi.UInt32(0)
    by = dr.opaque(mi.UInt32, divisor)
    quotient: Any
    if divisor * LANES > 1 << 32:
        quotient = number // by
    else:
        quotient = dr.mul_hi(number, dr.opaque(mi.UInt32, -(-(1 << 32) // divisor)))
    return quotient, number - quotient * by


def _visible(
    rays: SunRays, disc: _Disc, lane: Any, receiver: Any, point: Any = 0, *, coherent: bool = False
) -> tuple[Any, Any, Any]:
    """Visibility of the luminary from samples (``lane`` of `SunRays`), cosine of incidence of its centre, and weight.

    Without ``lane`` from all samples, and without ``receiver`` each is one of its own.

    ``point`` counts the points of the disc from the first of the receiver on; ``coherent`` traces packets, which pays where
    all samples of a receiver lie side by side. Samples whose facet faces away from the luminary are dark, as in a path
    tracer, whose shadow ray would start inside the terrain.
    """
    import drjit as dr
    import mitsuba as mi

    active, cosine, geometric_cosine, weight = _facing(rays, disc, lane)
    _, disc_point = _quotient_and_remainder(_chosen(mi.UInt32, rays.mi_disc_offset, receiver) + point, disc.count)
    direction = dr.gather(mi.Vector3f, disc.mi_directions, disc_point)
    origin = _chosen(mi.Point3f, rays.mi_origin, lane)
    material = rays.terrain.mi_terrain.bsdf()
    ray = mi.Ray3f(origin + direction * shadow_ray_start(material, geometric_cosine, origin), direction)
    return active & ~rays.terrain.mi_scene.ray_test(ray, coherent=coherent, active=active), cosine, weight


def _chosen(kind: Any, values: Any, lane: Any) -> Any:
    """Lanes of an array; the array itself without ``lane``: kernels read it in order, several times quicker than by index."""
    import drjit as dr

    return values if lane is None else dr.gather(kind, values, lane)


def _facing(rays: SunRays, disc: _Disc, lane: Any) -> tuple[Any, Any, Any, Any]:
    """Whether samples face the centre of the luminary, the cosines of their shading and geometric normals, and weight."""
    import mitsuba as mi

    cosine, geometric_cosine = (
        sum(
            mi.Float(_chosen(mi.Float16, column, lane)) * axis
            for column, axis in zip(columns, disc.mi_centre, strict=True)
        )
        for columns in (rays.mi_normal, rays.mi_geometric_normal)
    )
    weight = mi.Float(_chosen(mi.Float16, rays.mi_weight, lane))
    return (cosine > 0.0) & (geometric_cosine > 0.0) & (weight > 0.0), cosine, geometric_cosine, weight
