"""Webcams of a place whose truth is known: pictures at full physics, then treated as webcams treat theirs."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from datetime import datetime

import numpy as np

from seasonscapes.cameras.observation import Observation
from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.evaluation.webcam_faults import (
    TYPICAL,
    Development,
    PoseSigmas,
    WebcamFaults,
    add_foreground,
    degrade,
    perturb_pose,
)
from seasonscapes.images import linear_from_srgb
from seasonscapes.rendering.gbuffer import GBuffer
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh, set_albedo
from seasonscapes.rendering.relit_view import relight_view, relightable_view
from seasonscapes.rendering.transport import SamplingOptions, trace_view, view_albedo
from seasonscapes.sky.illumination import Illumination
from seasonscapes.terrain.surface import Terrain

Progress = Callable[[float], None]
# Pictures of 720 x 480 in a few seconds each, with noise well below that of 8 bits.
QUICK = SamplingOptions(subpixels=4, shades=16, rays=128, clusters=2048, listed=32, rank=24)


@dataclass(frozen=True)
class WebcamInstant:
    """An instant as a webcam sees it: its light (of the webcam's own place) and the land's albedo ``(R, S, 3)``."""

    time: datetime
    illumination: Illumination
    albedo: np.ndarray


@dataclass(frozen=True)
class SyntheticPicture:
    """A webcam's picture and its truth.

    Parameters
    ----------
    observation
        What a stage gets: decoded sRGB in [0, 1], and the pose that it believes.
    encoded
        ``(H, W, 3)`` uint8, the file's bytes.
    camera
        The true pose.
    radiance
        ``(H, W, 3)`` [cd/m²] at the camera, with what stands before the land.
    surface
        ``(H, W, 3)`` [cd/m²] leaving the land, before the air.
    foreground
        ``(H, W)`` bool: houses and masts.
    development
        What the webcam did.
    gbuffer
        First surfaces at the true pose.
    """

    observation: Observation
    encoded: np.ndarray
    camera: Camera | Panorama
    radiance: np.ndarray
    surface: np.ndarray
    foreground: np.ndarray
    development: Development
    gbuffer: GBuffer


def webcam_series(
    terrain: Terrain,
    webcam: str,
    camera: Camera | Panorama,
    hours: Sequence[WebcamInstant],
    *,
    faults: WebcamFaults = TYPICAL,
    poses: PoseSigmas | None = None,
    foreground: bool = False,
    sampling: SamplingOptions = QUICK,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[SyntheticPicture]:
    """Pictures of one webcam at several hours. Its pose error and its foreground are the same in all of them.

    Parameters
    ----------
    webcam
        Its id; with ``seed`` it decides what is random, so that a webcam keeps its faults whichever others there are.
    camera
        Where it truly is; a panorama is traced as one picture.
    poses
        How far off the pose is that the observations carry; left out, it is exact.
    sampling
        Of the light transport.

    Raises
    ------
    ValueError
        The webcam sees no terrain.
    """
    tell = progress or (lambda share: None)
    rng = np.random.default_rng([seed, zlib.crc32(webcam.encode())])
    believed, _ = perturb_pose(camera, poses or PoseSigmas(), rng)
    stand = int(rng.integers(2**32))
    mesh = mi_mesh(terrain, hours[0].albedo)
    bare = ray_scene(mesh)
    coefficients = trace_view(bare, camera, sampling, seed=seed, progress=lambda share: tell(0.7 * share))
    pictures, shown = [], hours[0].albedo
    for index, hour in enumerate(hours):
        if hour.albedo is not shown:
            set_albedo(RenderScene(bare.mi_scene, bare.mi_terrain, hour.illumination, 0.0), hour.albedo)
            coefficients = replace(coefficients, albedo=view_albedo(bare, coefficients))
            shown = hour.albedo
        view = relight_view(relightable_view(bare, coefficients), hour.illumination)
        radiance, front = np.maximum(view.radiance, 0.0), np.zeros(view.coverage.shape, bool)
        if foreground:
            radiance, front = add_foreground(radiance, np.random.default_rng(stand))
        encoded, done = degrade(radiance, faults, rng)
        observation = Observation(
            linear_from_srgb(encoded / np.float32(255.0)), np.ones(front.shape, bool), believed, hour.time, webcam
        )
        pictures.append(
            SyntheticPicture(observation, encoded, camera, radiance, view.surface, front, done, view.gbuffer)
        )
        tell(0.7 + 0.3 * (index + 1) / len(hours))
    return pictures
