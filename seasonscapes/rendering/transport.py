"""Daylight coefficients: light transport traced once per view or set of points, for any illumination afterwards.

Light transport is linear. For each receiver (pixel or texel) the daylight coefficients of all sky patches (Tregenza &
Waters 1983, "Daylight coefficients", doi:10.1177/096032718301500201) are stored in a low-rank directional basis,
together with the clusters of terrain faces that its hemisphere rays hit. Sun and moon are exact: shadow rays to points
of their discs are traced for each illumination, from the receivers and from the clusters (`light_clusters`).

The radiance of a pixel is albedo / π · E. The albedo of the pixels and of the clusters is stored separately, so that it
can be replaced, for example by that of another season.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.errors import NoTerrainInView
from seasonscapes.rendering.backend import aligned
from seasonscapes.rendering.coefficients import MirrorCoefficients, PointCoefficients, SamplingOptions, ViewCoefficients
from seasonscapes.rendering.direction_basis import DirectionBasis, direction_basis
from seasonscapes.rendering.hemisphere_rays import (
    ESCAPED,
    RayScene,
    SurfacePoints,
    concatenate_points,
    gather_hemisphere,
)
from seasonscapes.rendering.horizons import SkyAbove, is_height_field, sky_above, trace_horizons
from seasonscapes.rendering.light_clusters import (
    POINTS_PER_CLUSTER,
    LightClusters,
    ReceiverCoefficients,
    cluster_faces,
    cluster_lists,
    face_geometry,
    trace_path_hits,
)
from seasonscapes.rendering.mirror_samples import (
    body_albedo,
    mirror_coefficients,
    mirror_samples,
    mirror_weights,
    water_samples,
)
from seasonscapes.rendering.morton import morton_order
from seasonscapes.rendering.sky_patches import patch_sums, sky_patches
from seasonscapes.rendering.smoothing import Neighbours, edge_aware_neighbours, smoothed
from seasonscapes.rendering.sobol import hash_to_unit
from seasonscapes.rendering.view_samples import (
    TILE,
    camera_points,
    pixel_albedo,
    pixel_moments,
    pixel_tiles,
    sample_moments,
    sample_weights,
    view_samples,
)

# Hemisphere rays per block of receivers: their hits and weights take about 20 bytes each.
BLOCK_RAYS = 1 << 23
# Exponent of the normals' cosine for smoothing direct skylight: the aureole is about 20° wide.
_DIRECT_SHARPNESS = 64.0
# Paths that are traced to place the clusters.
_PILOTS = 1 << 18
# Rays below the horizon of a receiver on a height field, per azimuth in the mean.
_LAND_RAYS = 1
# Distinguishes the random numbers of what a pixel mirrors from its own.
_MIRRORED = np.uint32(1 << 31)
# Number of receivers, and rays of each, from which the directional basis is computed. Twice as many receivers leave 0.62 % of
# the light of other receivers, these 0.64 %, half of the rays 0.69 % (root mean square over skies; `alpine`).
_EXAMPLES, _EXAMPLE_RAYS = 2048, 512
Progress = Callable[[float], None]


@dataclass(frozen=True)
class SharedTransport:
    """Basis and clusters that all receivers of a terrain share.

    Parameters
    ----------
    mi_face_cluster
        ``mi.UInt32`` cluster of each face.
    basis
        Directional basis of the sky.
    clusters
        The clusters and their own coefficients.
    above
        Integrals of the basis above horizons, for terrains that are height fields; ``None`` for others.
    """

    mi_face_cluster: Any
    basis: DirectionBasis
    clusters: LightClusters
    above: SkyAbove | None


@dataclass(frozen=True)
class _PixelArrays:
    """The arrays of `ViewCoefficients` for a block of image rows."""

    pixel: np.ndarray
    coverage: np.ndarray
    albedo: np.ndarray
    normal: np.ndarray
    sample_origin: np.ndarray
    sample_normal: np.ndarray
    sample_outward: np.ndarray
    sample_weight: np.ndarray


def trace_view(
    terrain: RayScene,
    camera: Camera | Panorama,
    sampling: SamplingOptions | None = None,
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> ViewCoefficients:
    """Trace the daylight coefficients of a view.

    Memory beyond the result does not grow with the size of the view.

    Parameters
    ----------
    terrain
        From `hemisphere_rays.ray_scene`, with its current albedo.
    camera
        The view.
    sampling
        Sampling options; defaults if ``None``.
    seed
        Of the sampling.
    progress
        Called with the completed fraction.

    Returns
    -------
    ViewCoefficients
        For `relit_view.relightable_view`.

    Raises
    ------
    NoTerrainInView
        If no pixel shows terrain.
    """
    sampling = sampling or SamplingOptions()
    report = progress or (lambda fraction: None)
    pilot, hit = camera_points(terrain, camera, range(camera.height_px), 1, seed)
    if not hit.any():
        raise NoTerrainInView("trace_view: the camera sees no terrain; check its position and orientation")
    shared = prepare_transport(terrain, pilot[hit], sampling, seed=seed)
    report(0.1)
    rows = max(1, BLOCK_RAYS // (camera.width_px * sampling.rays))
    blocks, receivers, mirrors = [], [], []
    for top in range(0, camera.height_px, rows):
        block_rows = range(top, min(top + rows, camera.height_px))
        block = _view_rows(terrain, shared, camera, block_rows, sampling, seed)
        if block is not None:
            if block[2] is not None:
                pixels = sum(len(before.pixel) for before in blocks)
                mirrors.append(replace(block[2], pixel=block[2].pixel + np.int32(pixels)))
            blocks.append(block[0])
            receivers.append(block[1])
        report(0.1 + 0.9 * min(1.0, (top + rows) / camera.height_px))
    names = [each.name for each in fields(_PixelArrays)]
    arrays = {name: np.concatenate([getattr(block, name) for block in blocks]) for name in names}
    view = ViewCoefficients(
        camera=camera,
        receivers=_concatenate_receivers(receivers),
        clusters=shared.clusters,
        seed=seed,
        sampling=sampling,
        mirror=_concatenate_mirrors(mirrors) if mirrors else None,
        **arrays,
    )
    direct = smoothed(view.receivers.direct, view_neighbours(view, stride=1, sharpness=_DIRECT_SHARPNESS))
    return replace(view, receivers=replace(view.receivers, direct=direct.astype(np.float16)))


def view_neighbours(view: ViewCoefficients, *, stride: int, sharpness: float) -> Neighbours:
    """Find the neighbouring pixels that lie on the same surface, for the n terrain pixels of a view.

    Parameters
    ----------
    view
        The view.
    stride, sharpness
        See `smoothing.edge_aware_neighbours`.

    Returns
    -------
    Neighbours
        Indices among the n pixels, and weights.
    """
    camera = view.camera
    position = view.sample_origin.mean(axis=1)
    normal = view.normal / np.maximum(np.linalg.norm(view.normal, axis=1, keepdims=True), 1e-6)
    pixel_width_m = np.linalg.norm(position - camera.position_m.astype(np.float32), axis=1) / np.float32(camera.fx)
    return edge_aware_neighbours(
        (camera.height_px, camera.width_px),
        view.pixel,
        position,
        normal,
        pixel_width_m,
        stride=stride,
        sharpness=sharpness,
    )


def trace_points(
    terrain: RayScene,
    points: SurfacePoints,
    sampling: SamplingOptions | None = None,
    *,
    shared: SharedTransport | None = None,
    seed: int = 0,
    number: np.ndarray | None = None,
    progress: Progress | None = None,
) -> PointCoefficients:
    """Trace the daylight coefficients of surface points, such as texels.

    Parameters
    ----------
    terrain
        From `hemisphere_rays.ray_scene`, with its current albedo.
    points
        N surface points, for example from `irradiance.surface_at`.
    sampling
        Sampling options; defaults if ``None``.
    shared
        From `prepare_transport`, if several blocks of points of one terrain are traced; computed from ``points`` if
        ``None``.
    seed
        Of the sampling.
    number
        ``(N,)`` index of each point among the points of all blocks, which makes the result independent of the division
        into blocks; 0, 1, … if ``None``.
    progress
        Called with the completed fraction.

    Returns
    -------
    PointCoefficients
        For `irradiance.upload_points`.
    """
    sampling = sampling or SamplingOptions()
    report = progress or (lambda fraction: None)
    shared = shared or prepare_transport(terrain, points, sampling, seed=seed)
    number = np.arange(len(points.origin)) if number is None else number
    step = max(1, BLOCK_RAYS // sampling.rays)
    blocks = []
    for start in range(0, len(points.origin), step):
        block = points[start : start + step]
        identity = number[start : start + step].astype(np.uint32)
        weight = np.ones((len(block.origin), 1), np.float32)
        blocks.append(_trace_receivers(terrain, shared, block.reshape(-1, 1), weight, identity, sampling, seed))
        report(min(1.0, (start + step) / len(points.origin)))
    return PointCoefficients(points, _concatenate_receivers(blocks), shared.clusters)


def prepare_transport(
    terrain: RayScene, pilot: SurfacePoints, sampling: SamplingOptions, *, seed: int = 0
) -> SharedTransport:
    """Compute the directional basis and the clusters that all receivers share.

    Parameters
    ----------
    terrain
        The terrain.
    pilot
        A representative sample of the receivers' surface points.
    sampling
        Sampling options.
    seed
        Of the sampling.

    Returns
    -------
    SharedTransport
        For `trace_points`.
    """
    import mitsuba as mi

    patches = sky_patches(sampling.patches)
    faces = face_geometry(terrain.mi_terrain)
    permutation = np.random.default_rng(seed).permutation(len(pilot.origin))
    pilot = pilot[np.resize(permutation, _PILOTS)]
    unclustered = mi.UInt32(aligned(np.zeros(len(faces.centroid)), np.uint32))
    hits = trace_path_hits(terrain, pilot, max(sampling.bounces, 1), seed)
    hit_count = len(hits.face)
    # Receivers and clusters share one basis, so that both serve as examples.
    half = _EXAMPLES // 2
    examples = concatenate_points(
        [pilot[:half], hits.points[np.resize(np.arange(hit_count), half)] if hit_count else pilot[half:_EXAMPLES]]
    )
    patch, hit = gather_hemisphere(
        terrain,
        patches,
        examples,
        rays=_EXAMPLE_RAYS,
        first=np.zeros(_EXAMPLES, np.uint32),
        scramble=np.arange(_EXAMPLES, dtype=np.uint32),
        mi_face_cluster=unclustered,
    )
    rows = patch_sums(patch, np.where(hit == ESCAPED, np.float32(1.0 / _EXAMPLE_RAYS), 0.0), np.eye(patches.size))
    basis = direction_basis(rows, patches, sampling.rank)
    above = sky_above(patches, basis.projection) if is_height_field(terrain) else None
    if sampling.bounces == 0 or hit_count == 0:
        unlit = LightClusters(
            pilot[:1].reshape(1, 1),
            _zero_receivers(basis, listed_clusters(sampling, above)),
            basis.from_sky,
            sampling.patches,
            0,
        )
        return SharedTransport(unclustered, basis, unlit, above)
    points, face_cluster = cluster_faces(hits, faces, sampling.clusters, seed=seed)
    size = len(points.origin)
    clusters = LightClusters(
        points,
        _zero_receivers(basis, listed_clusters(sampling, above)),
        basis.from_sky,
        sampling.patches,
        sampling.bounces,
    )
    shared = SharedTransport(mi.UInt32(aligned(face_cluster, np.uint32)), basis, clusters, above)
    step = max(1, BLOCK_RAYS // sampling.rays)
    uniform = np.full((size, POINTS_PER_CLUSTER), 1.0 / POINTS_PER_CLUSTER, np.float32)
    blocks = [
        _trace_receivers(
            terrain,
            shared,
            points[i : i + step],
            uniform[i : i + step],
            np.arange(i, min(i + step, size), dtype=np.uint32),
            sampling,
            seed,
        )
        for i in range(0, size, step)
    ]
    return replace(shared, clusters=replace(clusters, receivers=_concatenate_receivers(blocks)))


def listed_clusters(sampling: SamplingOptions, above: SkyAbove | None) -> int:
    """Length of a receiver's list of clusters: on a height field no longer than the rays of equal weight that find them."""
    if above is None:
        return sampling.clusters_per_receiver
    return min(sampling.clusters_per_receiver, sampling.horizon_azimuths * _LAND_RAYS)


def _zero_receivers(basis: DirectionBasis, listed: int) -> ReceiverCoefficients:
    """A single receiver that receives no light."""
    return ReceiverCoefficients(
        np.zeros((1, basis.projection.shape[1]), np.float16), np.zeros((1, listed), np.uint16), np.zeros(1, np.float16)
    )


def _concatenate_mirrors(blocks: Sequence[MirrorCoefficients]) -> MirrorCoefficients:
    joined = {
        field.name: np.concatenate([getattr(block, field.name) for block in blocks])
        for field in fields(MirrorCoefficients)
        if field.name != "receivers"
    }
    return MirrorCoefficients(receivers=_concatenate_receivers([block.receivers for block in blocks]), **joined)


def _concatenate_receivers(blocks: Sequence[ReceiverCoefficients]) -> ReceiverCoefficients:
    return ReceiverCoefficients(
        np.concatenate([block.direct for block in blocks]),
        np.concatenate([block.cluster for block in blocks]),
        np.concatenate([block.share for block in blocks]),
    )


def _view_rows(
    terrain: RayScene,
    shared: SharedTransport,
    camera: Camera | Panorama,
    rows: range,
    sampling: SamplingOptions,
    seed: int,
) -> tuple[_PixelArrays, ReceiverCoefficients, MirrorCoefficients | None] | None:
    """Coefficients of the terrain pixels in some image rows, and of what water mirrors in them.

    ``None`` if no pixel shows terrain, and for the latter where none shows water.
    """
    points, hit, pixel = view_samples(terrain, camera, rows, sampling.shadow_samples, seed)
    if len(pixel) == 0:
        return None
    on_water, mirror = water_samples(terrain, points, hit), None
    if on_water.any():
        eye_m = np.asarray(camera.position_m)
        order = morton_order(pixel % camera.width_px, pixel // camera.width_px)
        samples = mirror_samples(terrain, eye_m, points, on_water, order, seed)
        shares = mirror_weights(samples)
        identity = pixel[samples.pixel].astype(np.uint32) ^ _MIRRORED
        lit = _trace_receivers(terrain, shared, samples.points, shares, identity, sampling, seed)
        mirror = mirror_coefficients(samples, shares, lit)
        # What the body of the water sends through the facets that are seen.
        points.albedo[samples.pixel] = body_albedo(terrain, points.albedo[samples.pixel], samples)
    weight = sample_weights(points.albedo, hit)
    if sampling.albedo_samples == sampling.shadow_samples:
        albedo, normal, coverage = sample_moments(points, hit)
    else:
        row_pixel = pixel - rows.start * camera.width_px
        moments = pixel_moments(terrain, camera, rows, sampling.albedo_samples, seed)
        albedo, normal, coverage = (values[row_pixel] for values in moments)
    # Without horizons each pixel has random numbers of its own: neighbours would share their noise.
    tile = None if shared.above is None else pixel_tiles(pixel, camera.width_px)
    receivers = _trace_receivers(terrain, shared, points, weight, pixel.astype(np.uint32), sampling, seed, tile)
    arrays = _PixelArrays(
        pixel,
        coverage,
        albedo,
        normal,
        points.origin,
        points.normal.astype(np.float16),
        points.geometric_normal.astype(np.float16),
        weight.astype(np.float16),
    )
    return arrays, receivers, mirror


def view_albedo(terrain: RayScene, coefficients: ViewCoefficients) -> np.ndarray:
    """Average the current albedo of the terrain (such as another season's) over the terrain pixels of a view.

    Parameters
    ----------
    terrain
        The terrain with the albedo, see `mitsuba_scene.set_albedo`.
    coefficients
        Coefficients of the view.

    Returns
    -------
    numpy.ndarray
        ``(n, 3)`` float32; the sky counts as black.
    """
    camera, sampling, pixel = coefficients.camera, coefficients.sampling, coefficients.pixel
    top, bottom = (int(end) // camera.width_px for end in (pixel.min(), pixel.max()))
    albedo = pixel_albedo(terrain, camera, range(top, bottom + 1), sampling.albedo_samples, coefficients.seed)
    return albedo[pixel - top * camera.width_px]


def _trace_receivers(
    terrain: RayScene,
    shared: SharedTransport,
    points: SurfacePoints,
    weight: np.ndarray,
    identity: np.ndarray,
    sampling: SamplingOptions,
    seed: int,
    tile: tuple[np.ndarray, np.ndarray] | None = None,
) -> ReceiverCoefficients:
    """Coefficients of N receivers with S surface points ``(N, S)`` each.

    ``weight`` ``(N, S)`` are the weights of the points, ``identity`` ``(N,)`` the random number keys of the receivers,
    ``tile`` the key that up to 16 neighbours share and the number of each among them.
    """
    count, samples = weight.shape
    shared_key, number = (identity, np.zeros(count, np.uint32)) if tile is None else tile
    key = shared_key + np.uint32((seed * 747796405 + 1) % 2**32)
    start = hash_to_unit(identity, seed)
    if shared.above is not None:
        seen = trace_horizons(
            terrain,
            shared.above,
            points,
            weight,
            azimuths=sampling.horizon_azimuths,
            land_rays=_LAND_RAYS,
            turn=number * np.float32(1.0 / TILE) + hash_to_unit(key, seed),
            key=identity ^ key,
            mi_face_cluster=shared.mi_face_cluster,
        )
        cluster, hits = cluster_lists(seen.hit, seen.ray_weight, listed_clusters(sampling, shared.above), start=start)
        # The horizon tells better than the rays how much of the hemisphere is land.
        share = np.where(hits > 0.0, np.maximum(weight.sum(axis=1) - seen.sky_share, 0.0), 0.0)
        return ReceiverCoefficients(seen.coefficients.astype(np.float16), cluster, share.astype(np.float16))
    sample_rays = sampling.rays // samples
    patch, hit = gather_hemisphere(
        terrain,
        sky_patches(sampling.patches),
        points.reshape(-1),
        rays=sample_rays,
        # Sample i uses the Sobol points from i · rays / S on, so that each sample has an aligned run of the sequence.
        first=np.tile(np.arange(samples, dtype=np.uint32) * np.uint32(sample_rays), count),
        scramble=np.repeat(key, samples),
        mi_face_cluster=shared.mi_face_cluster,
    )
    patch, hit = patch.reshape(count, -1), hit.reshape(count, -1)
    ray_weight = np.repeat(weight / np.float32(sample_rays), sample_rays, axis=1)
    direct = patch_sums(patch, np.where(hit == ESCAPED, ray_weight, 0.0), shared.basis.projection)
    cluster, share = cluster_lists(hit, ray_weight, sampling.clusters_per_receiver, start=start)
    return ReceiverCoefficients(direct.astype(np.float16), cluster, share.astype(np.float16))
