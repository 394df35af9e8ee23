"""Views to learn from: cameras all around a terrain, and what the path tracer's twin sees from them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.gaussians.disc_transport import SENDERS, LightState
from seasonscapes.gaussians.losses import TrainingFrame
from seasonscapes.gaussians.rasterise import splats_from, view_weights
from seasonscapes.gaussians.surfels import Surfels
from seasonscapes.sky.illumination import Illumination
from seasonscapes.terrain.surface import Terrain

_FOV_DEG = 46.0


def overview_cameras(terrain: Terrain, count: int, *, size_px: int = 256, first_deg: float = 0.0) -> list[Camera]:
    """Cameras on a circle around a terrain that look down on its middle; the whole of it is in view."""
    low, high = terrain.vertices.min(axis=0).astype(float), terrain.vertices.max(axis=0).astype(float)
    middle, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm((high - low)[:2]))
    distance = 1.1 * radius / np.tan(np.radians(_FOV_DEG / 2.0))
    focal = 0.5 * size_px / np.tan(np.radians(_FOV_DEG / 2.0))
    cameras = []
    for azimuth_deg in first_deg + np.arange(count) * (360.0 / max(count, 1)):
        azimuth, pitch_deg = np.radians(azimuth_deg), -35.0
        away = np.array([np.sin(azimuth), np.cos(azimuth)]) * np.cos(np.radians(pitch_deg))
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_angles(azimuth_deg + 180.0, pitch_deg)
        pose[:3, 3] = middle + distance * np.array([*away, -np.sin(np.radians(pitch_deg))])
        cameras.append(Camera(size_px, size_px, focal, focal, size_px / 2.0, size_px / 2.0, pose))
    return cameras


def relit_frames(
    ray_scene,
    surfels: Surfels,
    cameras: Sequence[Camera],
    lights: Sequence[tuple[int, Illumination, LightState]],
    *,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> list[TrainingFrame]:
    """Frames of every camera at every time, camera by camera, relit from daylight coefficients.

    Parameters
    ----------
    lights
        Number of the time among the lessons', its light and its state.
    """
    from seasonscapes.rendering.relit_view import relight_view, relightable_view
    from seasonscapes.rendering.transport import SamplingOptions, trace_view

    frames = []
    for number, camera in enumerate(cameras):
        ready = relightable_view(
            ray_scene, trace_view(ray_scene, camera, SamplingOptions(rays=256, clusters=SENDERS), seed=seed)
        )
        weights = view_weights(facing(surfels, camera), camera, subpixels=2)
        for time, light, state in lights:
            image = relight_view(ready, light).surface * np.float32(np.pi / state.global_lx)
            frames.append(TrainingFrame(weights, time, image, ready.coverage > 0.999))
        if progress is not None:
            progress((number + 1) / len(cameras))
    return frames


def facing(surfels: Surfels, camera: Camera):
    """Splats of the discs, those that show a camera their backs made transparent (as `splat_view.splats_of`)."""
    away = np.einsum("nc,nc->n", surfels.means - camera.position_m.astype(np.float32), surfels.normals) > 0.0
    logits = np.where(away, np.float32(-20.0), surfels.opacity_logits)
    return splats_from(surfels.means, surfels.quaternions, surfels.log_scales, logits)
