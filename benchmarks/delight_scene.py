"""Truth-known photographs from above for the delighting benchmark: massif, coarse heights, orthophoto, relit pictures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.albedo.forward_model import TexelTransport, ambient_on_texels, sun_on_texels, trace_texel_transport
from seasonscapes.albedo.sun_search import Relief
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.frames import LocalFrame, direction_from_angles
from seasonscapes.images import linear_from_srgb, srgb_from_linear
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.sky.illumination import Illumination, global_horizontal_illuminance
from seasonscapes.terrain.surface import Raster, Terrain

LATITUDE_DEG = 46.55
FRAME = LocalFrame(LATITUDE_DEG, 7.98)
DAY_OF_YEAR = 254
# Share of the photograph that is exposed to white.
CLIPPED_SHARE = 0.01
SAMPLING = SamplingOptions(shadow_samples=1, rays=128, clusters_per_receiver=64, clusters=4096, rank=24)
PHOTOGRAPH_HEIGHT_M = 1.0e5


@dataclass(frozen=True)
class Truth:
    """A massif with its albedo, and the terrain of heights of half the resolution in the same atlas."""

    seed: int
    terrain: Terrain
    coarse: Terrain
    albedo: np.ndarray
    texel_m: float

    @property
    def shape(self) -> tuple[int, int]:
        """Of the texture."""
        return self.albedo.shape[0], self.albedo.shape[1]


def make_truth(seed: int, *, size_m: float, spacing_m: float, day_of_year: int = DAY_OF_YEAR) -> Truth:
    """The massif of a seed; the texture has a texel for each of its samples."""
    from seasonscapes.terrain.imagery import bake_imagery
    from seasonscapes.terrain.mesh import build_mesh
    from seasonscapes.terrain.synthetic import alpine_albedo, alpine_massif
    from seasonscapes.terrain.unwrap import unwrap

    massif = alpine_massif(seed=seed, size_m=size_m, spacing_m=spacing_m)
    heights = massif.elevation
    terrain, atlas = unwrap(build_mesh(heights, FRAME, mesher="grid"), texel_m=spacing_m)
    image = Raster(alpine_albedo(massif, day_of_year), heights.transform, heights.crs)
    albedo = bake_imagery(terrain, atlas, image).values
    return Truth(seed, terrain, coarse_terrain(heights, terrain), albedo, spacing_m)


def coarse_terrain(heights: Raster, terrain: Terrain) -> Terrain:
    """Terrain of the means of 2 × 2 heights, interpolated as a place's are, with the UV coordinates of the fine one."""
    from affine import Affine

    from seasonscapes.terrain.mesh import build_mesh
    from seasonscapes.terrain.refine import refine_raster
    from seasonscapes.terrain.surface_grid import surface_grid

    z = heights.values[..., 0]
    rows, columns = z.shape[0] // 2, z.shape[1] // 2
    means = z[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).mean(axis=(1, 3))
    raster = Raster(means[..., None].astype(np.float32), heights.transform * Affine.scale(2.0), heights.crs)
    refined = refine_raster(raster, 2)
    mesh = replace(build_mesh(refined, FRAME, mesher="grid"), surface=surface_grid(refined, FRAME))

    def plan(vertices: np.ndarray) -> np.ndarray:
        return np.c_[vertices[:, :2].astype(float), np.ones(len(vertices))]

    affine = np.linalg.lstsq(plan(terrain.vertices), terrain.uv.astype(float), rcond=None)[0]
    return replace(mesh, uv=(plan(mesh.vertices) @ affine).astype(np.float32))


def orthophoto(
    truth: Truth,
    light: Illumination,
    *,
    shift_texels: tuple[float, float] = (0.0, 0.0),
    samples: int = 3,
    spp: int = 16,
    seed: int = 0,
) -> np.ndarray:
    """Radiance ``(R, S, 3)`` [cd/m²] of the texels in a path-traced photograph from high above, rectified.

    ``samples`` × ``samples`` points of each texel are looked up in a photograph of as many times finer pixels;
    ``shift_texels`` (rows, columns) is how much farther the picture lies than the ground.
    """
    from scipy.ndimage import map_coordinates

    from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight
    from seasonscapes.rendering.radiance import render_view
    from seasonscapes.terrain.texels import texel_positions

    rows, columns = truth.shape
    width, height = int(columns * samples * 1.06), int(rows * samples * 1.06)
    pose = np.eye(4)
    pose[:3, :3], pose[2, 3] = np.diag([1.0, -1.0, -1.0]), PHOTOGRAPH_HEIGHT_M
    focal = (PHOTOGRAPH_HEIGHT_M - np.median(truth.terrain.vertices[:, 2])) / truth.texel_m * samples
    camera = Camera(width, height, focal, focal, width / 2.0, height / 2.0, pose)
    picture = render_view(relight(mi_mesh(truth.terrain, truth.albedo), light), camera, spp=spp, seed=seed).radiance
    position, _ = texel_positions(truth.terrain, columns * samples, rows * samples)
    depth = PHOTOGRAPH_HEIGHT_M - position[..., 2]
    column = focal * position[..., 0] / depth + width / 2.0 - 0.5 - shift_texels[1] * samples
    row = -focal * position[..., 1] / depth + height / 2.0 - 0.5 - shift_texels[0] * samples
    known = np.isfinite(column)
    at = [np.nan_to_num(row), np.nan_to_num(column)]
    looked_up = np.stack([map_coordinates(picture[..., k], at, order=1, mode="nearest") for k in range(3)], axis=2)

    def box(values: np.ndarray) -> np.ndarray:
        return values.reshape(rows, samples, columns, samples, *values.shape[2:]).sum(axis=(1, 3))

    count = box(known.astype(float))
    mean = box(np.where(known[..., None], looked_up, 0.0)) / np.maximum(count, 1.0)[..., None]
    return np.where((count > 0.0)[..., None], mean, np.nan)


def eight_bit(radiance: np.ndarray, unit: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Linear values ``(R, S, 3)`` after storage in 8-bit sRGB, and which of them are clipped."""
    levels = np.rint(255.0 * srgb_from_linear(np.clip(np.nan_to_num(radiance) / unit, 0.0, 1.0)))
    return np.where(np.isfinite(radiance), linear_from_srgb(levels / 255.0), np.nan), levels >= 255.0


def unit_of(photograph: np.ndarray, light: Illumination) -> np.ndarray:
    """Radiance ``(3,)`` of the photograph's white [cd/m²]: white-balanced for the hour, a hundredth of it clipped."""
    level = np.asarray(global_horizontal_illuminance(light)) / np.pi
    return level * np.nanpercentile((photograph / level).max(axis=2), 100.0 * (1.0 - CLIPPED_SHARE))


def light_at(azimuth_deg: float, elevation_deg: float, turbidity: float = 3.0) -> Illumination:
    """Sun and Hosek sky."""
    from seasonscapes.rendering.hosek import hosek_illumination

    return hosek_illumination(direction_from_angles(azimuth_deg, elevation_deg), turbidity=turbidity, shape=(64, 128))


def transport_of(terrain: Terrain, shape: tuple[int, int], seed: int) -> TexelTransport:
    """Daylight coefficients of the texels."""
    return trace_texel_transport(terrain, shape, sampling=SAMPLING, seed=seed)


def lit_from_above(transport: TexelTransport, light: Illumination, albedo: np.ndarray) -> np.ndarray:
    """Radiance ``(R, S, 3)`` [cd/m²] of the texels under a light."""
    total = sun_on_texels(transport, light) + ambient_on_texels(transport, light, albedo)
    return total.reshape(albedo.shape) * albedo / np.float32(np.pi)


def possible_sun(rng: np.random.Generator) -> tuple[float, float]:
    """Azimuth and elevation [deg] of the sun on a random day and hour, 12 to 60° high."""
    latitude = np.radians(LATITUDE_DEG)
    while True:
        declination, hour = np.radians(rng.uniform(-23.4, 23.4)), np.radians(rng.uniform(-80.0, 80.0))
        sine = np.sin(latitude) * np.sin(declination) + np.cos(latitude) * np.cos(declination) * np.cos(hour)
        elevation = float(np.degrees(np.arcsin(sine)))
        if 12.0 < elevation < 60.0:
            north = (np.sin(declination) - np.sin(latitude) * sine) / np.cos(latitude)
            return float(np.degrees(np.arctan2(-np.cos(declination) * np.sin(hour), north)) % 360.0), elevation


def relief_of(terrain: Terrain, shape: tuple[int, int], *, azimuths: int = 48) -> Relief:
    """Normals and horizons under the texels."""
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.horizon_angles import horizon_angles
    from seasonscapes.rendering.irradiance import surface_at
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.terrain.texels import texel_positions

    surface = ray_scene(mi_mesh(terrain, np.full(3, 0.3, np.float32)))
    position, _ = texel_positions(terrain, shape[1], shape[0])
    points, index = surface_at(surface, position.reshape(-1, 3))
    normal = np.tile(np.array([0.0, 0.0, 1.0], np.float32), (shape[0] * shape[1], 1))
    horizon = np.zeros((len(normal), azimuths), np.float32)
    known = np.zeros(len(normal), bool)
    normal[index], known[index] = points.normal, True
    horizon[index] = horizon_angles(surface, points, azimuths=azimuths)
    return Relief(normal.reshape(*shape, 3), horizon.reshape(*shape, azimuths), known.reshape(shape))
