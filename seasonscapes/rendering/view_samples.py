"""What lies under the pixels of a view: places for shadow rays, and mean albedo and normal of many more samples."""

from __future__ import annotations

from typing import Any

import numpy as np

from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.gbuffer import mi_rays
from seasonscapes.rendering.hemisphere_rays import LANES, RayScene, SurfacePoints, front_side, surface_points
from seasonscapes.rendering.sobol import hashed, sobol_pair
from seasonscapes.sky.illumination import LUMINANCE_WEIGHTS

# Name of what random numbers are for, as a word for their hashes.
_PIXEL = 103


def view_samples(
    terrain: RayScene, camera: Camera | Panorama, rows: tuple[int, int], count: int, seed: int
) -> tuple[SurfacePoints, np.ndarray, np.ndarray]:
    """Surfaces ``(n, S)`` under the samples of a block of rows, which are terrain ``(n, S)``, and the pixels ``(n,)``.

    Only pixels that show terrain. Terrain comes first among the samples of a pixel; sky is black and repeats the place
    of the first.
    """
    flat, hit = camera_points(terrain, camera, rows, count, seed)
    hit = hit.reshape(-1, count)
    shown = hit.any(axis=1)
    pixel = (np.flatnonzero(shown) + rows[0] * camera.width_px).astype(np.int32)
    hit = hit[shown]
    # The first one stands for the pixel where a single ray must do: any of them, by lot.
    lot = np.random.default_rng((seed, rows[0])).random(hit.shape, np.float32)
    order = np.argsort(np.where(hit, lot, 2.0), axis=1)
    hit = np.take_along_axis(hit, order, axis=1)
    columns = {}
    for name in SurfacePoints.__dataclass_fields__:
        values = getattr(flat, name).reshape(*shown.shape, count, -1)[shown]
        values = np.take_along_axis(values, order[..., None], axis=1)
        columns[name] = np.where(hit[..., None], values, 0.0 if name == "albedo" else values[:, :1])
    return SurfacePoints(**columns), hit, pixel


def sample_weights(albedo: np.ndarray, hit: np.ndarray) -> np.ndarray:
    """Each sample's share of its pixel's albedo ``(n, S)``, by luminance; equal shares where all are black."""
    shade = albedo @ LUMINANCE_WEIGHTS.astype(np.float32)
    shade = np.where((shade.sum(axis=1) > 0.0)[:, None], shade, hit)
    return (shade / shade.sum(axis=1, keepdims=True)).astype(np.float32)


def camera_points(
    terrain: RayScene, camera: Camera | Panorama, rows: tuple[int, int], count: int, seed: int
) -> tuple[SurfacePoints, np.ndarray]:
    """Surfaces under stratified samples of rows of pixels, samples of a pixel side by side, and which met terrain."""
    interaction = _mi_camera_rays(terrain, camera, rows, count, seed)
    valid = interaction.is_valid()
    return surface_points(interaction, valid), np.array(valid)


def _mi_camera_rays(terrain: RayScene, camera: Camera | Panorama, rows: tuple[int, int], count: int, seed: int) -> Any:
    """What stratified rays through a block of rows meet, ``count`` to a pixel side by side, and the number of pixels."""
    import drjit as dr
    import mitsuba as mi

    top, height = rows
    pixels = camera.width_px * height
    lane = dr.arange(mi.UInt32, pixels * count)
    width = dr.opaque(mi.UInt32, camera.width_px)
    index = lane // dr.opaque(mi.UInt32, count)
    pixel = index + dr.opaque(mi.UInt32, top) * width
    row = pixel // width
    key = hashed(hashed(pixel, dr.opaque(mi.UInt32, seed)), _PIXEL)
    place = sobol_pair(key, lane - index * dr.opaque(mi.UInt32, count))
    x, y = mi.Float(pixel - row * width) + place.x, mi.Float(row) + place.y
    return terrain.mi_scene.ray_intersect(mi_rays(camera, x, y))


def pixel_moments(
    terrain: RayScene, camera: Camera | Panorama, rows: tuple[int, int], count: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean albedo ``(N, 3)``, mean normal weighted by luminous albedo ``(N, 3)`` and coverage ``(N,)`` of all pixels.

    Nothing but these sums leaves the device, so that many samples may be taken.
    """
    import drjit as dr
    import mitsuba as mi

    step = max(1, LANES // (camera.width_px * count))
    parts = []
    for top in range(rows[0], rows[0] + rows[1], step):
        block = (top, min(step, rows[0] + rows[1] - top))
        interaction = _mi_camera_rays(terrain, camera, block, count, seed)
        valid = interaction.is_valid()
        front = front_side(interaction, valid)
        albedo = interaction.bsdf().eval_diffuse_reflectance(interaction, front)
        albedo = dr.select(front, albedo, mi.Color3f(0.0))
        # A little of every terrain sample's normal, so that black pixels have one too.
        shade = dr.dot(albedo, mi.Color3f(*LUMINANCE_WEIGHTS.tolist())) + dr.select(valid, mi.Float(1e-6), 0.0)
        lanes = [*albedo, *(shade * interaction.sh_frame.n), shade, dr.select(valid, mi.Float(1.0), 0.0)]
        sums = [dr.block_sum(values, count) for values in lanes]
        dr.eval(sums)
        parts.append(np.stack([np.array(values) for values in sums], axis=-1))
    total = np.concatenate(parts)
    normal = total[:, 3:6] / np.maximum(total[:, 6:7], 1e-20)
    return total[:, :3] / count, normal, total[:, 7] / count
