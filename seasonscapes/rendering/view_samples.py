"""Stratified samples of the terrain in the pixels of a view: surface points, and mean albedo and normal per pixel."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.images import REC709_LUMINANCE
from seasonscapes.rendering.gbuffer import mi_rays
from seasonscapes.rendering.hemisphere_rays import LANES, RayScene, SurfacePoints, front_side, surface_points
from seasonscapes.rendering.sobol import hashed, sobol_pair
from seasonscapes.rendering.terrain_material import device_water, shading_normal

# Key of the random number stream, mixed into its hashes.
_PIXEL, _WAVE = 103, 105
# Pixels of a square tile, which share stratified random numbers.
TILE = 16
_BAYER = np.array([[0, 8, 2, 10], [12, 4, 14, 6], [3, 11, 1, 9], [15, 7, 13, 5]], np.uint32)


def pixel_tiles(pixel: np.ndarray, width_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Divide pixels into tiles of 4 × 4, whose pixels have complementary random numbers: any 3 × 3 of them have nine.

    Parameters
    ----------
    pixel
        ``(n,)`` flat pixel indices.
    width_px
        Width of the image [px].

    Returns
    -------
    key
        ``(n,)`` uint32 key of each pixel's tile.
    number
        ``(n,)`` uint32 number of the pixel in its tile, by Bayer's matrix.
    """
    row, column = np.divmod(pixel, width_px)
    return ((row // 4) * width_px + column // 4).astype(np.uint32), _BAYER[row % 4, column % 4]


def view_samples(
    terrain: RayScene, camera: Camera | Panorama, rows: range, count: int, seed: int
) -> tuple[SurfacePoints, np.ndarray, np.ndarray]:
    """Sample the terrain in the pixels of some image rows.

    The samples of a pixel are ordered at random, those on terrain first. Samples of the sky are black and repeat the
    surface of the first sample.

    Parameters
    ----------
    terrain
        The terrain.
    camera
        The view.
    rows
        Consecutive image rows.
    count
        Number S of samples per pixel, a square.
    seed
        Of the sample positions.

    Returns
    -------
    points
        ``(n, S)`` surface points in the n pixels that show terrain.
    hit
        ``(n, S)`` bool: samples on terrain.
    pixel
        ``(n,)`` int32 flat indices of these pixels in the image.
    """
    flat, hit = camera_points(terrain, camera, rows, count, seed)
    hit = hit.reshape(-1, count)
    on_terrain = hit.any(axis=1)
    pixel = (np.flatnonzero(on_terrain) + rows.start * camera.width_px).astype(np.int32)
    hit = hit[on_terrain]
    # The first sample represents the pixel where a single ray is traced, so the order must not depend on position.
    sort_key = np.random.default_rng((seed, rows.start)).random(hit.shape, np.float32)
    order = np.argsort(np.where(hit, sort_key, 2.0), axis=1)
    hit = np.take_along_axis(hit, order, axis=1)
    # Samples of the sky repeat the first one.
    sample = np.flatnonzero(on_terrain)[:, None] * count + order
    sample = np.where(hit, sample, sample[:, :1])
    columns = {name: np.take(getattr(flat, name), sample, axis=0) for name in SurfacePoints.__dataclass_fields__}
    columns["albedo"][~hit] = 0.0
    return SurfacePoints(**columns), hit, pixel


def sample_weights(albedo: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Compute the weight of each sample in its pixel's reflected light, proportional to luminous albedo.

    Parameters
    ----------
    albedo
        ``(n, S, 3)`` albedo of the samples.
    hit
        ``(n, S)`` bool: samples on terrain.

    Returns
    -------
    numpy.ndarray
        ``(n, S)`` float32, sum 1 per pixel; uniform over the terrain samples of pixels whose albedo is zero.
    """
    luminous = albedo @ REC709_LUMINANCE.astype(np.float32)
    luminous = np.where((luminous.sum(axis=1) > 0.0)[:, None], luminous, hit)
    return (luminous / luminous.sum(axis=1, keepdims=True)).astype(np.float32)


def sample_moments(points: SurfacePoints, hit: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Average albedo, normal and terrain coverage over samples that are traced already; see `pixel_moments`.

    Parameters
    ----------
    points, hit
        ``(n, S)`` samples of n pixels, of `view_samples`.

    Returns
    -------
    albedo, normal, coverage
        Of the n pixels: ``(n, 3)``, ``(n, 3)`` and ``(n,)`` float32, as of `pixel_moments` with S samples.
    """
    # A small constant weight defines the normal of black pixels too.
    weight = (points.albedo @ REC709_LUMINANCE.astype(np.float32) + np.float32(1e-6)) * hit
    normal = np.einsum("ns,nsc->nc", weight, points.normal) / np.maximum(weight.sum(axis=1), 1e-20)[:, None]
    return points.albedo.mean(axis=1), normal, hit.mean(axis=1, dtype=np.float32)


def camera_points(
    terrain: RayScene, camera: Camera | Panorama, rows: range, count: int, seed: int
) -> tuple[SurfacePoints, np.ndarray]:
    """Trace stratified camera rays through the pixels of some image rows.

    Parameters
    ----------
    terrain
        The terrain.
    camera
        The view.
    rows
        Consecutive image rows.
    count
        Rays per pixel.
    seed
        Of the sample positions.

    Returns
    -------
    points
        ``(len(rows) W count,)`` surface points, the samples of a pixel side by side; undefined where not ``hit``.
    hit
        ``(len(rows) W count,)`` bool: rays that hit terrain.
    """
    import drjit as dr

    interaction, _ = _mi_camera_rays(terrain, camera, rows, count, seed)
    valid = interaction.is_valid()
    # Evaluated with the points: by itself it would trace all rays again.
    dr.schedule(valid)
    return surface_points(terrain, interaction, valid), np.array(valid)


def _mi_camera_rays(
    terrain: RayScene, camera: Camera | Panorama, rows: range, count: int, seed: int
) -> tuple[Any, Any]:
    """Surface interactions of ``count`` stratified rays per pixel, side by side, and points that choose a facet of each."""
    import drjit as dr
    import mitsuba as mi

    pixels = camera.width_px * len(rows)
    lane = dr.arange(mi.UInt32, pixels * count)
    width = dr.opaque(mi.UInt32, camera.width_px)
    index = lane // dr.opaque(mi.UInt32, count)
    pixel = index + dr.opaque(mi.UInt32, rows.start) * width
    row = pixel // width
    key = hashed(hashed(pixel, dr.opaque(mi.UInt32, seed)), _PIXEL)
    sample = lane - index * dr.opaque(mi.UInt32, count)
    offset = sobol_pair(key, sample)
    x, y = mi.Float(pixel - row * width) + offset.x, mi.Float(row) + offset.y
    # Neighbouring rays visit the same nodes of the tree: Embree traces packets of them in a third of the time.
    interaction = terrain.mi_scene.ray_intersect(
        mi_rays(camera, x, y), ray_flags=mi.RayFlags.All, coherent=True, active=mi.Bool(True)
    )
    return interaction, sobol_pair(hashed(key, _WAVE), sample)


def pixel_moments(
    terrain: RayScene, camera: Camera | Panorama, rows: range, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Average albedo, normal and terrain coverage over the pixels of some image rows.

    The averages are computed on the device, so that many samples per pixel are affordable.

    Parameters
    ----------
    terrain
        The terrain.
    camera
        The view.
    rows
        Consecutive image rows.
    count
        Samples per pixel.
    seed
        Of the sample positions.

    Returns
    -------
    albedo
        ``(N, 3)`` mean albedo of the N pixels of these rows, zero for the sky; of water that of its body, without what it
        mirrors.
    normal
        ``(N, 3)`` mean shading normal, weighted by luminous albedo.
    coverage
        ``(N,)`` fraction of the pixel that terrain covers.
    """
    import drjit as dr
    import mitsuba as mi

    def moments(interaction: Any, facet: Any) -> list[Any]:
        valid = interaction.is_valid()
        albedo = _seen_albedo(terrain, interaction, facet)
        # A small constant weight defines the normal of black pixels too.
        weight = dr.dot(albedo, mi.Color3f(*REC709_LUMINANCE.tolist())) + dr.select(valid, mi.Float(1e-6), 0.0)
        normal = shading_normal(terrain.mi_terrain.bsdf(), interaction, valid)
        return [*albedo, *(weight * normal), weight, dr.select(valid, mi.Float(1.0), 0.0)]

    total = _pixel_sums(terrain, camera, rows, count, seed, moments)
    normal = total[:, 3:6] / np.maximum(total[:, 6:7], 1e-20)
    return total[:, :3] / count, normal, total[:, 7] / count


def pixel_albedo(terrain: RayScene, camera: Camera | Panorama, rows: range, count: int, seed: int) -> np.ndarray:
    """The albedo ``(N, 3)`` of `pixel_moments` alone, without the normals, which cost as much as the rays."""

    def albedo(interaction: Any, facet: Any) -> list[Any]:
        return [*_seen_albedo(terrain, interaction, facet)]

    return _pixel_sums(terrain, camera, rows, count, seed, albedo) / count


def _seen_albedo(terrain: RayScene, interaction: Any, facet: Any) -> Any:
    """Albedo ``mi.Color3f`` of what camera rays hit; see `_mi_camera_rays` and `pixel_moments`."""
    import drjit as dr
    import mitsuba as mi

    front = front_side(interaction, interaction.is_valid())
    material = terrain.mi_terrain.bsdf()
    albedo = material.eval_diffuse_reflectance(interaction, front)
    water = device_water(material)
    if water is not None:
        # Of water, the body is seen through facets that do not mirror.
        viewer = interaction.to_world(interaction.wi)
        _, mirrored = water.mirrored(water.vertical(interaction.p), viewer, facet)
        body = material.body(interaction, front) * (1.0 - mirrored)
        albedo = dr.select(water.covers(interaction.uv, front), body, albedo)
    return dr.select(front, albedo, mi.Color3f(0.0))


def _pixel_sums(
    terrain: RayScene,
    camera: Camera | Panorama,
    rows: range,
    count: int,
    seed: int,
    lanes_of: Callable[[Any, Any], list[Any]],
) -> np.ndarray:
    """Sums ``(N, C)`` over the samples of each pixel of what ``lanes_of`` returns for the results of `_mi_camera_rays`."""
    import drjit as dr

    step = max(1, LANES // (camera.width_px * count))
    parts = []
    for top in range(rows.start, rows.stop, step):
        block = range(top, min(top + step, rows.stop))
        lanes = lanes_of(*_mi_camera_rays(terrain, camera, block, count, seed))
        # Evaluated together: summing an unevaluated channel would trace all rays again for each of the channels.
        dr.eval(lanes)
        sums = [dr.block_sum(values, count) for values in lanes]
        dr.eval(sums)
        parts.append(np.stack([np.array(values) for values in sums], axis=-1))
    return np.concatenate(parts)
