"""A truth-known day of webcam pictures for the albedo benchmark: massif, low cameras, hours, path-traced radiance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime

import numpy as np

from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.frames import LocalFrame
from seasonscapes.sky.illumination import Illumination
from seasonscapes.sky.models import SkyModel
from seasonscapes.terrain.surface import Raster, Terrain
from seasonscapes.workflows.illumination import illumination_at, sun_moon_position
from seasonscapes.workspace import Workspace

LATITUDE_DEG, LONGITUDE_DEG = 46.55, 7.98
GROUND_HEIGHT_M = 2000.0


@dataclass(frozen=True)
class Truth:
    """A massif whose albedo is known, and the cameras that look at it."""

    seed: int
    terrain: Terrain
    albedo: np.ndarray
    cameras: list[Camera]
    spacing_m: float
    place: object

    @property
    def shape(self) -> tuple[int, int]:
        """Of the texture."""
        return self.albedo.shape[:2]


def make_truth(
    seed: int,
    *,
    size_m: float,
    spacing_m: float,
    texel_m: float,
    cameras: int,
    size_px: tuple[int, int],
    day_of_year: int = 254,
) -> Truth:
    """The massif of a seed with its albedo of a day, and cameras that together see much of it."""
    from seasonscapes.terrain.synthetic import alpine_massif

    place = alpine_massif(seed=seed, size_m=size_m, spacing_m=spacing_m)
    terrain, albedo = terrain_and_albedo(place, spacing_m, texel_m, day_of_year)
    return Truth(seed, terrain, albedo, low_cameras(terrain, cameras, size_px, seed), spacing_m, place)


def terrain_and_albedo(place, spacing_m: float, texel_m: float, day_of_year: int) -> tuple[Terrain, np.ndarray]:
    """The mesh with its atlas, and the true albedo of a day in it."""
    from affine import Affine

    from seasonscapes.terrain.imagery import bake_imagery
    from seasonscapes.terrain.mesh import build_mesh
    from seasonscapes.terrain.synthetic import alpine_albedo
    from seasonscapes.terrain.unwrap import unwrap

    frame = LocalFrame(LATITUDE_DEG, LONGITUDE_DEG)
    terrain, atlas = unwrap(build_mesh(place.elevation, frame, mesher="grid"), texel_m=texel_m)
    image = Raster(
        alpine_albedo(place, day_of_year, upsample=2),
        place.elevation.transform * Affine.scale(0.5),
        place.elevation.crs,
    )
    return terrain, bake_imagery(terrain, atlas, image).values


def low_cameras(terrain: Terrain, count: int, size_px: tuple[int, int], seed: int) -> list[Camera]:
    """Webcams on masts around the massif: of a few dozen places those that together see the most, each with some sky."""
    from seasonscapes.rendering.gbuffer import trace_gbuffer
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh

    bare = ray_scene(mi_mesh(terrain, np.full(3, 0.3)))
    scene = RenderScene(bare.mi_scene, bare.mi_terrain)
    rng = np.random.default_rng(seed)
    reach = float(np.abs(terrain.vertices[:, :2]).max())
    candidates, views = [], []
    for _ in range(60):
        azimuth, radius = rng.uniform(0.0, 360.0), rng.uniform(0.35, 0.9) * reach
        place = radius * np.array([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))])
        nearest = terrain.vertices[np.argmin(((terrain.vertices[:, :2] - place) ** 2).sum(axis=1))]
        position = np.append(place, nearest[2] + rng.uniform(40.0, 250.0))
        heading = azimuth + 180.0 + rng.uniform(-35.0, 35.0)
        camera = _camera(position, heading, rng.uniform(-10.0, 4.0), 62.0, (96, 64))
        buffer = trace_gbuffer(scene, camera)
        hit = np.isfinite(buffer.depth)
        if 0.5 < hit.mean() < 0.93 and np.percentile(buffer.depth[hit], 5) > 60.0:
            cells = np.unique((buffer.uv[hit] * 64).astype(int) @ np.array([1, 64]))
            candidates.append(camera)
            views.append(cells)
    chosen, covered = [], np.zeros(0, int)
    for _ in range(count):
        gain = [len(np.setdiff1d(cells, covered)) for cells in views]
        best = int(np.argmax(gain))
        covered = np.union1d(covered, views[best])
        chosen.append(_resized(candidates[best], size_px))
    return chosen


def _camera(
    position: np.ndarray, heading_deg: float, pitch_deg: float, fov_deg: float, size: tuple[int, int]
) -> Camera:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_angles(heading_deg, pitch_deg), position
    focal = 0.5 * size[0] / np.tan(np.radians(fov_deg) / 2.0)
    return Camera(*size, focal, focal, size[0] / 2.0, size[1] / 2.0, pose)


def _resized(camera: Camera, size: tuple[int, int]) -> Camera:
    scale = size[0] / camera.width_px
    return Camera(*size, camera.fx * scale, camera.fy * scale, size[0] / 2.0, size[1] / 2.0, camera.world_from_camera)


def lights_for(
    times: Sequence[datetime], cameras: Sequence[Camera], model: SkyModel, workspace: Workspace
) -> list[list[Illumination]]:
    """Light of each time as each camera sees it ``[time][camera]``: on the land that of its median height."""
    result = []
    for time in times:
        moment = sun_moon_position(time, LATITUDE_DEG, LONGITUDE_DEG, GROUND_HEIGHT_M)
        on_land = illumination_at(model, moment, GROUND_HEIGHT_M, workspace=workspace)
        row = []
        for camera in cameras:
            here = illumination_at(model, moment, float(camera.position_m[2]), workspace=workspace, map_height=64)
            row.append(replace(on_land, aerial_perspective=here.aerial_perspective, visible_sky=here.sky_radiance))
        result.append(row)
    return result


def hours(date: str, *clock: float) -> list[datetime]:
    """Aware times of a date at hours UTC."""
    day = datetime.fromisoformat(date).replace(tzinfo=UTC)
    return [day.replace(hour=int(h), minute=round(60 * (h % 1.0))) for h in clock]


def path_traced(
    truth: Truth,
    albedo: np.ndarray,
    lights: list[list[Illumination]],
    *,
    spp: int,
    seed: int,
    cameras: Sequence[int] | None = None,
) -> list[list[np.ndarray]]:
    """Radiance ``(H, W, 3)`` at each camera of each time, ``[time][camera]``."""
    from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight
    from seasonscapes.rendering.radiance import render_view

    mesh = mi_mesh(truth.terrain, albedo)
    chosen = range(len(truth.cameras)) if cameras is None else cameras
    return [
        [render_view(relight(mesh, row[c]), truth.cameras[c], spp=spp, seed=seed + 97 * t + c).radiance for c in chosen]
        for t, row in enumerate(lights)
    ]
