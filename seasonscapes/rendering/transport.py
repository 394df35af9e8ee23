"""Daylight coefficients: light transport traced once, so that each hour costs a few shadow rays and small products.

Light is linear. For every receiver, a pixel or a texel, this keeps how much of each sky patch's radiance arrives
(Tregenza & Waters 1983, "Daylight coefficients", doi:10.1177/096032718301500201) in a compact basis of directions, and
which parts of the terrain it sees. Sun and moon are exact: shadow rays to points of their discs each time, from the
receivers and from the terrain that sends light on to them (`clusters`).

Radiance of a pixel = albedo / π · E, with the albedo of its visible surface kept apart: another season's may be put in
its place, and in the senders'.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.direction_basis import DirectionBasis, direction_basis
from seasonscapes.rendering.hemisphere_rays import OPEN, RayScene, SurfacePoints, concatenate_points, gather_hemisphere
from seasonscapes.rendering.light_clusters import (
    PLACES,
    LightClusters,
    ReceiverCoefficients,
    cluster_faces,
    cluster_lists,
    face_geometry,
    pilot_hits,
)
from seasonscapes.rendering.sky_patches import sky_patches
from seasonscapes.rendering.smoothing import Neighbours, edge_aware_neighbours, smoothed
from seasonscapes.rendering.view_samples import camera_points, pixel_moments, sample_weights, view_samples

# Receivers' rays in work at a time: their labels and weights take about 20 bytes each.
BLOCK_RAYS = 1 << 23
# How much direct skylight depends on the normal when pixels share it: a sky's aureole is some 20° wide.
_DIRECT_SHARPNESS = 64.0
_PILOTS = 1 << 18
# Receivers, and rays from each, that the basis of directions is found from.
_EXAMPLES, _EXAMPLE_RAYS = 4096, 512
Progress = Callable[[float], None]


@dataclass(frozen=True)
class SamplingOptions:
    """How hard to try.

    Parameters
    ----------
    subpixels
        S, samples in each pixel, a square; shadow rays start from them.
    shades
        Samples in each pixel for its mean albedo and normal, a square.
    rays
        Rays over the hemisphere of each receiver, a power of two.
    bounces
        Surfaces between receiver and light: 4 equals ``max_depth=6`` of the path tracer.
    clusters
        M, parts of the terrain that pass light on, a power of two up to 65,536.
    listed
        K, senders kept for each receiver, even.
    rank
        r, coefficients kept per receiver for the sky.
    patches
        Subdivision of the sky, a name in `sky_patches.SUBDIVISIONS`.
    """

    subpixels: int = 16
    shades: int = 64
    rays: int = 512
    bounces: int = 4
    clusters: int = 16384
    listed: int = 64
    rank: int = 32
    patches: str = "reinhart"

    def __post_init__(self):
        if round(self.subpixels**0.5) ** 2 != self.subpixels or self.rays & (self.rays - 1) or self.bounces < 0:
            raise ValueError("SamplingOptions: subpixels must be a square, rays a power of two, bounces not negative")
        if self.rays % self.subpixels:
            raise ValueError(
                f"SamplingOptions: {self.rays} rays cannot be shared evenly among {self.subpixels} subpixels"
            )
        if self.listed % 2 or not 0 < self.clusters <= 65536:
            raise ValueError("SamplingOptions: listed must be even and clusters at most 65536")


@dataclass(frozen=True)
class ViewCoefficients:
    """All that a view needs to be lit anew. n of its pixels show terrain; S samples lie in each.

    Parameters
    ----------
    camera
        The view.
    pixel
        ``(n,)`` int32 flat index of pixels that show any terrain.
    coverage
        ``(n,)`` float32 share of the pixel that is terrain.
    albedo
        ``(n, 3)`` float32 mean albedo over the pixel; sky counts as black.
    normal
        ``(n, 3)`` float32 mean of the samples' normals, weighted by ``sample_weight``.
    sample_origin
        ``(n, S, 3)`` float32, where shadow rays begin [m]; samples on terrain come first.
    sample_normal, sample_outward
        ``(n, S, 3)`` float16 shading and geometric normals.
    sample_weight
        ``(n, S)`` float16 share of each sample in the pixel's reflected light, sum 1; 0 in the sky.
    receivers, senders
        What arrives.
    seed, effort
        How they were made.
    """

    camera: Camera | Panorama
    pixel: np.ndarray
    coverage: np.ndarray
    albedo: np.ndarray
    normal: np.ndarray
    sample_origin: np.ndarray
    sample_normal: np.ndarray
    sample_outward: np.ndarray
    sample_weight: np.ndarray
    receivers: ReceiverCoefficients
    clusters: LightClusters
    seed: int
    sampling: SamplingOptions


@dataclass(frozen=True)
class PointCoefficients:
    """All that N places on the terrain (texels) need to be lit anew.

    Parameters
    ----------
    points
        The places, ``(N, ...)``.
    receivers, senders
        What arrives.
    """

    points: SurfacePoints
    receivers: ReceiverCoefficients
    clusters: LightClusters


@dataclass(frozen=True)
class SharedTransport:
    """What all receivers of a terrain share while they are traced."""

    mi_label: Any
    basis: DirectionBasis
    clusters: LightClusters


def trace_view(
    terrain: RayScene,
    camera: Camera | Panorama,
    sampling: SamplingOptions | None = None,
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> ViewCoefficients:
    """Daylight coefficients of a view. Memory beyond the result does not grow with the view.

    Parameters
    ----------
    terrain
        From `hemisphere_rays.ray_scene`; its albedo at this moment is used.
    progress
        Called with the share that is done.

    Raises
    ------
    ValueError
        Where no pixel shows terrain.
    """
    sampling = sampling or SamplingOptions()
    tell = progress or (lambda share: None)
    pilot, hit = camera_points(terrain, camera, (0, camera.height_px), 1, seed)
    if not hit.any():
        raise ValueError("the camera sees no terrain")
    prepared = prepare_transport(terrain, pilot[hit], sampling, seed=seed)
    tell(0.1)
    rows = max(1, BLOCK_RAYS // (camera.width_px * sampling.rays))
    parts = []
    for top in range(0, camera.height_px, rows):
        parts += _view_rows(terrain, prepared, camera, (top, min(rows, camera.height_px - top)), sampling, seed)
        tell(0.1 + 0.9 * min(1.0, (top + rows) / camera.height_px))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    view = ViewCoefficients(camera, *columns[:8], ReceiverCoefficients(*columns[8:]), prepared.clusters, seed, sampling)
    direct = smoothed(view.receivers.direct, view_neighbours(view, stride=1, sharpness=_DIRECT_SHARPNESS))
    return replace(view, receivers=replace(view.receivers, direct=direct.astype(np.float16)))


def view_neighbours(view: ViewCoefficients, *, stride: int, sharpness: float) -> Neighbours:
    """Pixels of one surface around each of the n pixels; see `smoothing.edge_aware_neighbours`."""
    camera = view.camera
    position = view.sample_origin.mean(axis=1)
    normal = view.normal / np.maximum(np.linalg.norm(view.normal, axis=1, keepdims=True), 1e-6)
    size = np.linalg.norm(position - camera.position_m.astype(np.float32), axis=1) / np.float32(camera.fx)
    return edge_aware_neighbours(
        (camera.height_px, camera.width_px), view.pixel, (position, normal, size), stride=stride, sharpness=sharpness
    )


def trace_points(
    terrain: RayScene,
    points: SurfacePoints,
    sampling: SamplingOptions | None = None,
    *,
    prepared: SharedTransport | None = None,
    seed: int = 0,
    number: np.ndarray | None = None,
    progress: Progress | None = None,
) -> PointCoefficients:
    """Daylight coefficients of places on the terrain, such as texels.

    Parameters
    ----------
    points
        N places, as from `surface_at`.
    prepared
        From `prepare_transport`, where many blocks of places of one terrain are traced one after the other.
    number
        ``(N,)`` each place's number among all of them: blocks then give what all at once would. Left out: 0, 1, ….
    """
    sampling = sampling or SamplingOptions()
    tell = progress or (lambda share: None)
    prepared = prepared or prepare_transport(terrain, points, sampling, seed=seed)
    number = np.arange(len(points.origin)) if number is None else number
    step = max(1, BLOCK_RAYS // sampling.rays)
    parts = []
    for start in range(0, len(points.origin), step):
        block = points[start : start + step]
        identity = number[start : start + step].astype(np.uint32)
        weight = np.ones((len(block.origin), 1), np.float32)
        parts.append(_receive(terrain, prepared, block.reshape(-1, 1), (weight, identity), sampling, seed))
        tell(min(1.0, (start + step) / len(points.origin)))
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    return PointCoefficients(points, ReceiverCoefficients(*columns), prepared.clusters)


def prepare_transport(
    terrain: RayScene, pilot: SurfacePoints, sampling: SamplingOptions, *, seed: int = 0
) -> SharedTransport:
    """The basis of directions and the senders for receivers that are like ``pilot``, a sample of them."""
    import mitsuba as mi

    patches = sky_patches(sampling.patches)
    faces = face_geometry(terrain.mi_terrain)
    choice = np.random.default_rng(seed).permutation(len(pilot.origin))
    pilot = pilot[np.resize(choice, _PILOTS)]
    none = mi.UInt32(np.zeros(len(faces[0]), np.uint32))
    hits = pilot_hits(terrain, pilot, max(sampling.bounces, 1), seed)
    # Receivers and senders share one basis, so both serve as its examples.
    half = _EXAMPLES // 2
    some = concatenate_points(
        [pilot[:half], hits[0][np.resize(np.arange(len(hits[1])), half)] if len(hits[1]) else pilot[half:_EXAMPLES]]
    )
    patch, met = gather_hemisphere(
        terrain,
        patches,
        some,
        rays=_EXAMPLE_RAYS,
        first=np.zeros(_EXAMPLES, np.uint32),
        scramble=np.arange(_EXAMPLES, dtype=np.uint32),
        mi_label=none,
    )
    rows = patch_sums(patch, np.where(met == OPEN, np.float32(1.0 / _EXAMPLE_RAYS), 0.0), np.eye(patches.size))
    basis = direction_basis(rows, patches, sampling.rank)
    if sampling.bounces == 0 or len(hits[1]) == 0:
        nothing = LightClusters(pilot[:1].reshape(1, 1), _nothing(basis, sampling), basis.from_sky, sampling.patches, 0)
        return SharedTransport(none, basis, nothing)
    points, label = cluster_faces(hits, faces, sampling.clusters, seed=seed)
    size = len(points.origin)
    clusters = LightClusters(points, _nothing(basis, sampling), basis.from_sky, sampling.patches, sampling.bounces)
    prepared = SharedTransport(mi.UInt32(label), basis, clusters)
    step = max(1, BLOCK_RAYS // sampling.rays)
    even = np.full((size, PLACES), 1.0 / PLACES, np.float32)
    parts = [
        _receive(
            terrain,
            prepared,
            points[i : i + step],
            (even[i : i + step], np.arange(i, min(i + step, size), dtype=np.uint32)),
            sampling,
            seed,
        )
        for i in range(0, size, step)
    ]
    receivers = ReceiverCoefficients(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    return replace(prepared, clusters=replace(clusters, receivers=receivers))


def _nothing(basis: DirectionBasis, sampling: SamplingOptions) -> ReceiverCoefficients:
    return ReceiverCoefficients(
        np.zeros((1, basis.into.shape[1]), np.float16),
        np.zeros((1, sampling.listed), np.uint16),
        np.zeros(1, np.float16),
    )


def _view_rows(
    terrain: RayScene,
    prepared: SharedTransport,
    camera: Camera | Panorama,
    rows: tuple[int, int],
    sampling: SamplingOptions,
    seed: int,
) -> list[tuple]:
    """The columns of `ViewCoefficients` and of its `ReceiverCoefficients` for a block of rows; empty where they show no terrain."""
    points, hit, pixel = view_samples(terrain, camera, rows, sampling.subpixels, seed)
    if len(pixel) == 0:
        return []
    weight = sample_weights(points.albedo, hit)
    shown = pixel - rows[0] * camera.width_px
    albedo, normal, coverage = pixel_moments(terrain, camera, rows, sampling.shades, seed)
    received = _receive(terrain, prepared, points, (weight, pixel.astype(np.uint32)), sampling, seed)
    return [
        (
            pixel,
            coverage[shown],
            albedo[shown],
            normal[shown],
            points.origin,
            points.normal.astype(np.float16),
            points.outward.astype(np.float16),
            weight.astype(np.float16),
            *received,
        )
    ]


def view_albedo(terrain: RayScene, coefficients: ViewCoefficients) -> np.ndarray:
    """Mean albedo ``(n, 3)`` of the pixels for the albedo that the terrain has now (another season's)."""
    camera, sampling = coefficients.camera, coefficients.sampling
    return pixel_moments(terrain, camera, (0, camera.height_px), sampling.shades, coefficients.seed)[0][
        coefficients.pixel
    ]


def _receive(
    terrain: RayScene,
    prepared: SharedTransport,
    points: SurfacePoints,
    shares: tuple[np.ndarray, np.ndarray],
    sampling: SamplingOptions,
    seed: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Columns of `ReceiverCoefficients` for N receivers with S places each.

    ``shares`` are the weights of places ``(N, S)`` and a number ``(N,)`` that makes each receiver's rays its own.
    """
    weight, identity = shares
    count, places = weight.shape
    each = sampling.rays // places
    # Ray i of a receiver starts at place i · S / rays, so that each place has an aligned run of the sequence.
    first = np.tile(np.arange(places, dtype=np.uint32) * np.uint32(each), count)
    scramble = np.repeat(identity + np.uint32((seed * 747796405 + 1) % 2**32), places)
    patch, met = gather_hemisphere(
        terrain,
        sky_patches(sampling.patches),
        points.reshape(-1),
        rays=each,
        first=first,
        scramble=scramble,
        mi_label=prepared.mi_label,
    )
    patch, met = patch.reshape(count, -1), met.reshape(count, -1)
    ray_weight = np.repeat(weight / np.float32(each), each, axis=1)
    direct = patch_sums(patch, np.where(met == OPEN, ray_weight, 0.0), prepared.basis.into)
    cluster, share = cluster_lists(met, ray_weight, sampling.listed, start=hash_to_unit(identity, seed))
    return direct.astype(np.float16), cluster, share.astype(np.float16)


def hash_to_unit(identity: np.ndarray, seed: int) -> np.ndarray:
    """One number in [0, 1) for each receiver ``(N,)`` float32, whatever block it is in (Wellons' *lowbias32*)."""
    bits = identity.astype(np.uint32) ^ np.uint32((seed * 2891336453 + 0x9E3779B9) % 2**32)
    for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
        bits = (bits ^ (bits >> np.uint32(shift))) * np.uint32(factor)
    return ((bits ^ (bits >> np.uint32(16))) >> np.uint32(8)).astype(np.float32) * np.float32(2.0**-24)


def patch_sums(index: np.ndarray, weight: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Weighted sums ``(N, r)`` of rows of ``table (P, r)``, those that ``index (N, K)`` names with ``weight (N, K)``."""
    from scipy import sparse

    count, each = index.shape
    start = np.arange(0, count * each + 1, each, dtype=np.int32)
    matrix = sparse.csr_array((weight.ravel(), index.ravel(), start), shape=(count, len(table)))
    return matrix @ table
