"""A small truth-known place for the albedo tests: a corner of the massif, three cameras, four hours, path-traced pictures."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import cache

import numpy as np
from affine import Affine

from seasonscapes.albedo.forward_model import TexelTransport, trace_texel_transport
from seasonscapes.cameras.observation import Observation
from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.frames import LocalFrame, direction_from_angles
from seasonscapes.rendering.backend import use_backend
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.hosek import hosek_illumination
from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight
from seasonscapes.rendering.radiance import render_view
from seasonscapes.sky.illumination import Illumination
from seasonscapes.terrain.imagery import bake_imagery
from seasonscapes.terrain.mesh import build_mesh
from seasonscapes.terrain.surface import Raster, Terrain
from seasonscapes.terrain.synthetic import SyntheticMassif, alpine_albedo, alpine_massif
from seasonscapes.terrain.unwrap import unwrap

SUNS_DEG = ((110.0, 22.0), (150.0, 40.0), (200.0, 42.0), (250.0, 20.0))
# Azimuth of the mast as seen from the centre [deg], distance [m], height above ground [m], pitch [deg].
MASTS = ((60.0, 1500.0, 160.0, 0.0), (10.0, 1700.0, 200.0, 6.0), (290.0, 1500.0, 160.0, 0.0))
SIZE_PX = (108, 72)


@dataclass(frozen=True)
class Case:
    """The place, its truth, and pictures ``[time][camera]`` ``(H, W, 3)`` [cd/m²]."""

    place: SyntheticMassif
    terrain: Terrain
    albedo: np.ndarray
    cameras: list[Camera]
    lights: list[Illumination]
    pictures: list[list[np.ndarray]]
    transport: TexelTransport

    def observations(self, times=None, *, image_of=lambda image: image) -> tuple[list[Observation], list[Illumination]]:
        """Observations of some of the hours, and the light of each."""
        found, lights = [], []
        for t in range(len(self.lights)) if times is None else times:
            moment = datetime(2024, 9, 10, 7, tzinfo=UTC) + timedelta(hours=2 * t)
            for c, camera in enumerate(self.cameras):
                image = image_of(self.pictures[t][c])
                found.append(Observation(image, np.ones(image.shape[:2], bool), camera, moment, f"camera{c}"))
                lights.append(self.lights[t])
        return found, lights


@cache
def case() -> Case:
    """Made once a session, in some seconds."""
    use_backend()
    place = alpine_massif(seed=5, size_m=3960.0, spacing_m=60.0)
    terrain, atlas = unwrap(build_mesh(place.elevation, LocalFrame(46.55, 7.98), mesher="grid"), texel_m=60.0)
    image = Raster(alpine_albedo(place, 254), place.elevation.transform * Affine.scale(1.0), place.elevation.crs)
    albedo = bake_imagery(terrain, atlas, image).values
    cameras = [_camera(terrain, *mast) for mast in MASTS]
    lights = [hosek_illumination(direction_from_angles(*sun), shape=(64, 128)) for sun in SUNS_DEG]
    mesh = mi_mesh(terrain, albedo)
    pictures = [
        [
            render_view(relight(mesh, light), camera, spp=64, seed=10 * t + c).radiance
            for c, camera in enumerate(cameras)
        ]
        for t, light in enumerate(lights)
    ]
    transport = trace_texel_transport(
        terrain,
        albedo.shape[:2],
        sampling=SamplingOptions(shadow_samples=1, rays=128, clusters_per_receiver=64, clusters=1024, rank=24),
    )
    return Case(place, terrain, albedo, cameras, lights, pictures, transport)


def _camera(terrain: Terrain, azimuth_deg: float, distance_m: float, above_m: float, pitch_deg: float) -> Camera:
    place = distance_m * np.array([np.sin(np.radians(azimuth_deg)), np.cos(np.radians(azimuth_deg))])
    ground = terrain.vertices[np.argmin(((terrain.vertices[:, :2] - place) ** 2).sum(axis=1)), 2]
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(azimuth_deg + 180.0, pitch_deg)
    pose[:3, 3] = (*place, ground + above_m)
    focal = 0.5 * SIZE_PX[0] / np.tan(np.radians(66.0) / 2.0)
    return Camera(*SIZE_PX, focal, focal, SIZE_PX[0] / 2.0, SIZE_PX[1] / 2.0, pose)


def psnr(guess: np.ndarray, true: np.ndarray, mask: np.ndarray) -> float:
    """Over a mask of texels, peak 1 [dB]."""
    return float(-10.0 * np.log10(np.mean((guess[mask] - true[mask]) ** 2)))
