"""Irradiance of surface points (such as texels) under any illumination, separated into sun, sky and interreflection."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from seasonscapes.rendering.backend import aligned, point3
from seasonscapes.rendering.coefficients import PointCoefficients, SamplingOptions
from seasonscapes.rendering.hemisphere_rays import RayScene, SurfacePoints, surface_points
from seasonscapes.rendering.receivers import (
    ClusterLight,
    DeviceClusters,
    DeviceReceivers,
    incident_light,
    light_clusters,
    luminaries,
    upload_clusters,
    upload_receivers,
)
from seasonscapes.rendering.sun_visibility import SunRays, hashed_disc_offset, sun_rays, visible_cosine
from seasonscapes.rendering.transport import SharedTransport, prepare_transport, trace_points
from seasonscapes.sky.illumination import Illumination

# Points per block: their coefficients take about 300 bytes each.
BLOCK = 1 << 19
# Horizontal offset of the second attempt to find the surface below a point.
_RETRY_OFFSET_M = np.array([0.05, 0.03, 0.0])
Progress = Callable[[float], None]


@dataclass(frozen=True)
class Irradiance:
    """Illuminance of N surface points [lx], photometric linear Rec.709, ``(N, 3)`` float32 each.

    Parameters
    ----------
    sun
        Direct light from sun and moon.
    sky
        Direct light from the sky.
    bounce
        Light reflected by other terrain.
    """

    sun: np.ndarray
    sky: np.ndarray
    bounce: np.ndarray

    @property
    def total(self) -> np.ndarray:
        """Sum of the three components ``(N, 3)`` [lx]."""
        return self.sun + self.sky + self.bounce


@dataclass(frozen=True)
class DevicePoints:
    """`PointCoefficients` on the Dr.Jit device.

    Parameters
    ----------
    rays
        Shadow rays from the points.
    receivers
        Light transport coefficients of the points.
    clusters
        Clusters of faces that reflect light to the points.
    """

    rays: SunRays
    receivers: DeviceReceivers
    clusters: DeviceClusters


def surface_at(terrain: RayScene, position_m: np.ndarray, *, search_m: float = 2.0) -> tuple[SurfacePoints, np.ndarray]:
    """Find the surface points of the terrain mesh at given positions, by vertical rays.

    Normals and albedo are those of the mesh, as in rendering.

    Parameters
    ----------
    terrain
        The terrain.
    position_m
        ``(N, 3)`` positions on the terrain, ENU [m], for example from `terrain.texels.texel_positions`; NaN for none.
    search_m
        The ray starts this far above the position and ends as far below it [m].

    Returns
    -------
    points
        K surface points.
    index
        ``(K,)`` indices of these points among the N positions. Positions that are NaN, or not within ``search_m`` of
        the surface as on vertical faces, are missing.
    """
    valid = np.asarray(np.isfinite(position_m).all(axis=1))
    start_m = np.where(valid[:, None], position_m, 0.0) + np.array([0.0, 0.0, search_m])
    points, found = _surface_below(terrain, start_m, search_m)
    found &= valid
    # A ray exactly through a vertex or an edge of the mesh may miss both faces; it is repeated a few centimetres away.
    missed = np.flatnonzero(valid & ~found)
    if len(missed):
        retried, hit = _surface_below(terrain, start_m[missed] + _RETRY_OFFSET_M, search_m)
        for name in SurfacePoints.__dataclass_fields__:
            getattr(points, name)[missed[hit]] = getattr(retried, name)[hit]
        found[missed[hit]] = True
    index = np.flatnonzero(found)
    return points[index], index


def _surface_below(terrain: RayScene, start_m: np.ndarray, search_m: float) -> tuple[SurfacePoints, np.ndarray]:
    import drjit as dr
    import mitsuba as mi

    ray = mi.Ray3f(point3(start_m.astype(np.float32)), mi.Vector3f(0.0, 0.0, -1.0))
    interaction = terrain.mi_scene.ray_intersect(ray)
    found: Any = interaction.is_valid() & (interaction.t < 2.0 * search_m)
    # Evaluated with the points: by itself it would trace all rays again.
    dr.schedule(found)
    return surface_points(terrain, interaction, found), np.array(found)


def points_on_faces(terrain: RayScene, face: np.ndarray, weights: np.ndarray) -> SurfacePoints:
    """Find surface points by face and barycentric coordinates, also on overhangs and vertical walls.

    Parameters
    ----------
    terrain
        The mesh.
    face
        ``(N,)`` face of each point.
    weights
        ``(N, 3)`` barycentric coordinates in the face.

    Returns
    -------
    SurfacePoints
        The front of the surface at N points.
    """
    import drjit as dr
    import mitsuba as mi

    mi_face, mi_mesh = mi.UInt32(aligned(face, np.uint32)), terrain.mi_terrain
    corner = mi_mesh.face_indices(mi_face)
    a, b, c = (mi_mesh.vertex_position(index) for index in (corner.x, corner.y, corner.z))
    preliminary: Any = dr.zeros(mi.PreliminaryIntersection3f, len(face))
    preliminary.t, preliminary.prim_index = 1.0, mi_face
    preliminary.prim_uv = mi.Point2f(*(aligned(weights[:, k]) for k in (1, 2)))
    # Seen from the front.
    ray = mi.Ray3f(a, -dr.normalize(dr.cross(b - a, c - a)))
    active = mi.Bool(aligned(np.ones(len(face)), bool))
    interaction = mi_mesh.compute_surface_interaction(ray, preliminary, mi.RayFlags.All, active)
    return surface_points(terrain, interaction, active)


def upload_points(terrain: RayScene, coefficients: PointCoefficients) -> DevicePoints:
    """Copy coefficients to the device.

    Parameters
    ----------
    terrain
        The terrain that occludes shadow rays.
    coefficients
        Coefficients of N points, possibly memory-mapped.

    Returns
    -------
    DevicePoints
        The device copy, for `irradiance`.
    """
    clusters = upload_clusters(terrain, coefficients.clusters)
    return DevicePoints(
        shadow_rays(terrain, coefficients.points, np.arange(len(coefficients.points.origin))),
        upload_receivers(coefficients.receivers),
        clusters,
    )


def shadow_rays(terrain: RayScene, points: SurfacePoints, number: np.ndarray) -> SunRays:
    """Shadow rays from surface points, each of whose ``number`` decides where on the sun's disc its rays end."""
    samples = points.reshape(-1, 1)
    weight = np.ones(samples.origin.shape[:2], np.float32)
    return sun_rays(
        terrain, samples.origin, samples.normal, samples.geometric_normal, weight, hashed_disc_offset(number)
    )


def irradiance(
    device: DevicePoints, illumination: Illumination, light: ClusterLight | None = None, *, sun_rays_per_point: int = 4
) -> Irradiance:
    """Compute the illuminance of surface points under an illumination.

    Parameters
    ----------
    device
        N points, from `upload_points`.
    illumination
        Sky, sun and moon.
    light
        From `receivers.light_clusters` for the same illumination, if it is reused for several blocks of points.
    sun_rays_per_point
        Shadow rays per point, to different points of the disc.

    Returns
    -------
    Irradiance
        ``(N, 3)`` illuminances [lx].
    """
    sky, bounce = incident_light(device.receivers, light or light_clusters(device.clusters, illumination))
    sun = np.zeros_like(sky)
    for body in luminaries(illumination):
        sun += visible_cosine(device.rays, body, rays_per_sample=sun_rays_per_point) * np.asarray(
            body.normal_illuminance_lx, np.float32
        )
    return Irradiance(sun, np.float32(np.pi) * sky, np.float32(np.pi) * bounce)


def point_coefficients(
    terrain: RayScene,
    position_m: np.ndarray,
    sampling: SamplingOptions | None = None,
    *,
    seed: int = 0,
    search_m: float = 2.0,
    progress: Progress | None = None,
) -> PointCoefficients:
    """Trace the daylight coefficients of at most `BLOCK` surface points, for keeping; see `irradiance_blocks`.

    Parameters
    ----------
    terrain, position_m, sampling, seed, search_m, progress
        As in `irradiance_blocks`, with which the result agrees to the digit.

    Returns
    -------
    PointCoefficients
        Of the positions with a surface, for `kept_irradiance`.

    Raises
    ------
    ValueError
        If none of the positions lies on the terrain.
    """
    sampling = sampling or SamplingOptions()
    shared = _shared(terrain, position_m, sampling, seed=seed, search_m=search_m)
    points, index = surface_at(terrain, position_m, search_m=search_m)
    return trace_points(terrain, points, sampling, shared=shared, seed=seed, number=index, progress=progress)


def kept_irradiance(
    terrain: RayScene,
    position_m: np.ndarray,
    coefficients: PointCoefficients,
    lights: Sequence[Illumination],
    *,
    search_m: float = 2.0,
) -> tuple[np.ndarray, SurfacePoints, Iterator[Irradiance]]:
    """Compute the irradiance of surface points whose coefficients are known, as one block of `irradiance_blocks`.

    Parameters
    ----------
    terrain, position_m, search_m
        As `point_coefficients` was given them.
    coefficients
        What it returned.
    lights
        The illuminations.

    Returns
    -------
    index, points, irradiances
        As `irradiance_blocks` yields them.
    """
    _, index = surface_at(terrain, position_m, search_m=search_m)
    device = DevicePoints(
        shadow_rays(terrain, coefficients.points, index),
        upload_receivers(coefficients.receivers),
        upload_clusters(terrain, coefficients.clusters),
    )
    return index, coefficients.points, map(partial(irradiance, device), lights)


def irradiance_blocks(
    terrain: RayScene,
    position_m: np.ndarray,
    lights: Sequence[Illumination],
    sampling: SamplingOptions | None = None,
    *,
    seed: int = 0,
    search_m: float = 2.0,
    progress: Progress | None = None,
) -> Iterator[tuple[np.ndarray, SurfacePoints, Iterator[Irradiance]]]:
    """Compute the irradiance of many surface points under many illuminations, in blocks of bounded memory.

    Parameters
    ----------
    terrain
        The terrain.
    position_m
        ``(N, 3)`` positions on the terrain, ENU [m]; NaN for none.
    lights
        The illuminations. All are kept in memory; omit their aerial perspective if there are many.
    sampling
        Sampling options; defaults if ``None``.
    seed
        Of the sampling.
    search_m
        See `surface_at`.
    progress
        Called with the completed fraction.

    Yields
    ------
    index
        ``(K,)`` indices of the block's points among the N positions; positions without a surface are missing.
    points
        The K surface points.
    irradiances
        Iterator of one `Irradiance` per light, computed when it is advanced.

    Raises
    ------
    ValueError
        If none of the positions lies on the terrain.
    """
    sampling = sampling or SamplingOptions()
    report = progress or (lambda fraction: None)
    valid = np.flatnonzero(np.isfinite(position_m).all(axis=1))
    shared = _shared(terrain, position_m, sampling, seed=seed, search_m=search_m)
    clusters = upload_clusters(terrain, shared.clusters)
    cluster_lights = [light_clusters(clusters, light) for light in lights]
    for start in range(0, len(valid), BLOCK):
        block = valid[start : start + BLOCK]
        points, found = surface_at(terrain, position_m[block], search_m=search_m)
        if len(found):
            index = block[found]
            coefficients = trace_points(terrain, points, sampling, shared=shared, seed=seed, number=index)
            device = DevicePoints(
                shadow_rays(terrain, points, index), upload_receivers(coefficients.receivers), clusters
            )
            yield index, points, map(partial(irradiance, device), lights, cluster_lights)
        report(min(1.0, (start + BLOCK) / len(valid)))


def _shared(
    terrain: RayScene, position_m: np.ndarray, sampling: SamplingOptions, *, seed: int, search_m: float
) -> SharedTransport:
    """What all points share, from a sample of them."""
    valid = np.flatnonzero(np.isfinite(position_m).all(axis=1))
    chosen = np.random.default_rng(seed).permutation(valid)[: 1 << 18]
    pilot, found = surface_at(terrain, position_m[chosen], search_m=search_m)
    if len(found) == 0:
        raise ValueError("irradiance: no position lies on the terrain; check that positions and terrain share a frame")
    return prepare_transport(terrain, pilot, sampling, seed=seed)
