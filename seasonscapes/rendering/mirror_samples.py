"""Rays that water mirrors: what the samples of a view's pixels see in the water."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from seasonscapes.images import REC709_LUMINANCE
from seasonscapes.rendering.backend import aligned, point3, to_numpy
from seasonscapes.rendering.coefficients import MirrorCoefficients
from seasonscapes.rendering.hemisphere_rays import RayScene, SurfacePoints, concatenate_points, surface_points
from seasonscapes.rendering.light_clusters import ReceiverCoefficients
from seasonscapes.rendering.sobol import hashed, sobol_pair
from seasonscapes.rendering.terrain_material import device_water

# Key of the random number stream, mixed into its hashes.
_WAVE = 104


@dataclass(frozen=True)
class MirrorSamples:
    """What the S samples of m pixels see in water.

    Parameters
    ----------
    pixel
        ``(m,)`` int32 numbers of the pixels among those that were given.
    on_water
        ``(m, S)`` bool: samples on water.
    reflectance
        ``(m, S)`` float32 reflectance of the facet of the waves; 0 off the water.
    direction
        ``(m, S, 3)`` float32 unit directions of the mirrored rays; those of samples off the water are undefined.
    points
        ``(m, S)`` points of the ground that the rays hit; where they hit none, that of another sample of the pixel.
    hit
        ``(m, S)`` bool: samples that mirror ground. Others on water mirror the sky.
    """

    pixel: np.ndarray
    on_water: np.ndarray
    reflectance: np.ndarray
    direction: np.ndarray
    points: SurfacePoints
    hit: np.ndarray


def water_samples(terrain: RayScene, points: SurfacePoints, hit: np.ndarray) -> np.ndarray:
    """Which samples of pixels lie on water.

    Parameters
    ----------
    terrain
        The terrain.
    points, hit
        ``(n, S)`` surface points of the samples, and whether they are on terrain.

    Returns
    -------
    numpy.ndarray
        ``(n, S)`` bool.
    """
    import mitsuba as mi

    water = device_water(terrain.mi_terrain.bsdf())
    if water is None:
        return np.zeros(hit.shape, bool)
    u, v = (np.ascontiguousarray(points.uv[..., k].ravel(), np.float32) for k in range(2))
    covered = np.array(water.covers(mi.Point2f(mi.Float(aligned(u)), mi.Float(aligned(1.0 - v))))).reshape(hit.shape)
    # The back of a facet, seen from below the terrain's border, is black.
    return covered & hit & (points.albedo.max(axis=-1) > 0.0)


def mirror_samples(
    terrain: RayScene, eye_m: np.ndarray, points: SurfacePoints, on_water: np.ndarray, order: np.ndarray, seed: int
) -> MirrorSamples:
    """Follow the rays that the water in the samples of pixels mirrors.

    Parameters
    ----------
    terrain
        The terrain, with water.
    eye_m
        ``(3,)`` position of the camera [m].
    points, on_water
        ``(n, S)`` surface points of the samples, and whether they are on water.
    order
        ``(n,)`` number of each pixel along a Morton curve, see `morton_order`. All pixels share one sequence of facets, whose
        aligned runs are stratified: the means over 2 × 2, 4 × 4 … pixels too, so that little grain is seen.
    seed
        Of the facets.

    Returns
    -------
    MirrorSamples
        Of the pixels with samples on water.
    """
    import drjit as dr
    import mitsuba as mi

    pixel = np.flatnonzero(on_water.any(axis=1)).astype(np.int32)
    on_water = on_water[pixel]
    row, sample = np.nonzero(on_water)
    from_water = points[pixel][row, sample]
    viewer = np.asarray(eye_m) - from_water.origin
    viewer = (viewer / np.linalg.norm(viewer, axis=1, keepdims=True)).astype(np.float32)
    water = device_water(terrain.mi_terrain.bsdf())
    assert water is not None
    key, number = hashed(dr.opaque(mi.UInt32, seed), _WAVE), order[pixel][row] * on_water.shape[1] + sample
    # The stubs reject normals as vectors.
    normal, mi_viewer = cast(Any, mi.Normal3f(point3(from_water.normal))), mi.Vector3f(point3(viewer))
    direction, reflectance = water.mirrored(normal, mi_viewer, sobol_pair(key, mi.UInt32(aligned(number, np.uint32))))
    interaction = terrain.mi_scene.ray_intersect(mi.Ray3f(point3(from_water.origin), direction))
    valid = interaction.is_valid()
    # Evaluated with the points: by themselves they would trace all rays again.
    dr.schedule(valid, reflectance, direction)
    found = surface_points(terrain, interaction, valid)
    hit = np.zeros(on_water.shape, bool)
    hit[on_water] = np.array(valid)
    # Samples without ground repeat the surface of one that has it, as in `view_samples`; without any, the water's own.
    own = np.zeros(len(pixel), np.int64)
    own[row] = len(row) + np.arange(len(row))
    number = np.full(on_water.shape, -1, np.int64)
    number[on_water] = np.where(np.array(valid), np.arange(len(row)), -1)
    number = np.where(number < 0, number.max(axis=1, keepdims=True), number)
    number = np.where(number < 0, own[:, None], number)
    repeated = concatenate_points([found, from_water])[number]
    repeated.albedo[~hit] = 0.0
    shares, directions = np.zeros(on_water.shape, np.float32), np.zeros((*on_water.shape, 3), np.float32)
    shares[on_water], directions[on_water] = np.array(reflectance), to_numpy(direction)
    return MirrorSamples(pixel, on_water, shares, directions, repeated, hit)


def mirror_weights(samples: MirrorSamples) -> np.ndarray:
    """Weight of each sample in the light that its pixel mirrors from ground: ``(m, S)``, sum 1, or 0 without ground."""
    luminous = samples.reflectance * (samples.points.albedo @ REC709_LUMINANCE.astype(np.float32))
    luminous = np.where((luminous.sum(axis=1) > 0.0)[:, None], luminous, samples.hit)
    return (luminous / np.maximum(luminous.sum(axis=1, keepdims=True), 1e-20)).astype(np.float32)


def mirror_coefficients(
    samples: MirrorSamples, weight: np.ndarray, receivers: ReceiverCoefficients
) -> MirrorCoefficients:
    """Coefficients of what a view's water mirrors.

    Parameters
    ----------
    samples
        From `mirror_samples`.
    weight
        From `mirror_weights`.
    receivers
        Coefficients of the mirrored ground with these weights.

    Returns
    -------
    MirrorCoefficients
        ``pixel`` counts among the pixels that were given to `mirror_samples`.
    """
    count = samples.hit.shape[1]
    ground = np.where(samples.hit, samples.reflectance, 0.0) / count
    return MirrorCoefficients(
        samples.pixel,
        np.einsum("ms,msc->mc", ground, samples.points.albedo).astype(np.float32),
        samples.points.uv,
        ground.astype(np.float16),
        samples.points.origin,
        samples.points.normal.astype(np.float16),
        samples.points.geometric_normal.astype(np.float16),
        weight.astype(np.float16),
        receivers,
        samples.direction,
        (np.where(samples.on_water & ~samples.hit, samples.reflectance, 0.0) / count).astype(np.float16),
        (samples.on_water / count).astype(np.float16),
    )


def body_albedo(terrain: RayScene, albedo: np.ndarray, samples: MirrorSamples) -> np.ndarray:
    """Albedo ``(m, S, 3)`` of the samples of pixels, on water that of its body as it is seen through the facets.

    Parameters
    ----------
    terrain
        The terrain, with water.
    albedo
        ``(m, S, 3)`` reflectance of the samples for diffuse light; see `DeviceWater.hemispherical`.
    samples
        From `mirror_samples`.
    """
    water = device_water(terrain.mi_terrain.bsdf())
    assert water is not None
    body = (albedo - water.diffuse_reflectance) / (1.0 - water.diffuse_reflectance)
    body = np.maximum(body, 0.0) * (1.0 - samples.reflectance[..., None])
    return np.where(samples.on_water[..., None], body, albedo).astype(np.float32)
