"""Training views: cameras around a terrain, and their frames relit from daylight coefficients."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.gaussians.disc_transport import LIGHT_CLUSTERS, LightState
from seasonscapes.gaussians.losses import TrainingFrame
from seasonscapes.gaussians.rasterise import Splats, splats_from, view_weights
from seasonscapes.gaussians.surfels import Surfels
from seasonscapes.sky.illumination import Illumination
from seasonscapes.terrain.surface import Terrain

if TYPE_CHECKING:
    from seasonscapes.rendering.hemisphere_rays import RayScene

_FOV_DEG = 46.0


def overview_cameras(terrain: Terrain, count: int, *, size_px: int = 256, first_deg: float = 0.0) -> list[Camera]:
    """Place cameras on a circle around a terrain, facing its centre from above, with all of it in view.

    Parameters
    ----------
    terrain
        Mesh, ENU [m].
    count
        Number of cameras.
    size_px
        Side of the square pictures [px].
    first_deg
        Azimuth of the first camera from the centre, clockwise from north [°].

    Returns
    -------
    list of Camera
        Cameras at equal angles.
    """
    low, high = terrain.vertices.min(axis=0).astype(float), terrain.vertices.max(axis=0).astype(float)
    centre, radius = 0.5 * (low + high), 0.5 * float(np.linalg.norm((high - low)[:2]))
    distance = 1.1 * radius / np.tan(np.radians(_FOV_DEG / 2.0))
    focal = 0.5 * size_px / np.tan(np.radians(_FOV_DEG / 2.0))
    cameras = []
    for azimuth_deg in first_deg + np.arange(count) * (360.0 / max(count, 1)):
        azimuth, pitch_deg = np.radians(azimuth_deg), -35.0
        horizontal = np.array([np.sin(azimuth), np.cos(azimuth)]) * np.cos(np.radians(pitch_deg))
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_angles(azimuth_deg + 180.0, pitch_deg)
        pose[:3, 3] = centre + distance * np.array([*horizontal, -np.sin(np.radians(pitch_deg))])
        cameras.append(Camera(size_px, size_px, focal, focal, size_px / 2.0, size_px / 2.0, pose))
    return cameras


def relit_frames(
    ray_scene: RayScene,
    surfels: Surfels,
    cameras: Sequence[Camera],
    lights: Sequence[tuple[int, Illumination, LightState]],
    *,
    seed: int = 0,
) -> list[TrainingFrame]:
    """Render the training frames of every camera at every time from daylight coefficients.

    Parameters
    ----------
    ray_scene
        Terrain with its texture.
    surfels
        N discs on this terrain.
    cameras
        The views.
    lights
        Index among the training targets' times, light and light state of each time.
    seed
        Seed of the random numbers.

    Returns
    -------
    list of TrainingFrame
        Camera by camera, in the order of the lights.

    Raises
    ------
    NoTerrainInView
        If a camera's view contains no terrain, no splat or no usable pixel.
    """
    from seasonscapes.rendering.coefficients import SamplingOptions
    from seasonscapes.rendering.relit_view import relight_view, relightable_view
    from seasonscapes.rendering.transport import trace_view

    frames = []
    for camera in cameras:
        view = relightable_view(
            ray_scene, trace_view(ray_scene, camera, SamplingOptions(rays=256, clusters=LIGHT_CLUSTERS), seed=seed)
        )
        weights = view_weights(front_facing_splats(surfels, camera), camera, subpixels=2)
        for time, light, state in lights:
            image = relight_view(view, light).surface * np.float32(np.pi / state.global_lx)
            frames.append(TrainingFrame(weights, time, image, view.coverage > 0.999, camera))
    return frames


def front_facing_splats(surfels: Surfels, camera: Camera) -> Splats:
    """Return discs as splats with back-face culling, as `splat_view.splats_of`.

    Parameters
    ----------
    surfels
        N discs.
    camera
        The view.

    Returns
    -------
    Splats
        N splats; those that face away from the camera are transparent.
    """
    facing_away = np.einsum("nc,nc->n", surfels.means - camera.position_m.astype(np.float32), surfels.facing) > 0.0
    logits = np.where(facing_away, np.float32(-20.0), surfels.opacity_logits)
    return splats_from(surfels.means, surfels.quaternions, surfels.log_scales, logits)
