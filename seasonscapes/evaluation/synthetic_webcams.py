"""Synthetic webcam images with ground truth: rendered radiance, degraded by pose errors, foreground, exposure and noise."""

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
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.gbuffer import GBuffer
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import mi_mesh, set_albedo
from seasonscapes.rendering.relit_view import relight_view, relightable_view
from seasonscapes.rendering.transport import trace_view, view_albedo
from seasonscapes.sky.illumination import Illumination
from seasonscapes.terrain.surface import Terrain

Progress = Callable[[float], None]
# Sampling for images of 720 x 480 px in a few seconds each, with noise well below the quantisation of 8 bits.
QUICK = SamplingOptions(shadow_samples=4, albedo_samples=16, rays=128, clusters=2048, clusters_per_receiver=32, rank=24)


@dataclass(frozen=True)
class WebcamInstant:
    """Light and surface of one image.

    Parameters
    ----------
    time
        Time with a UTC offset.
    illumination
        Sun, sky and atmosphere at the position of the webcam.
    albedo
        Albedo texture ``(R, S, 3)`` of the terrain.
    """

    time: datetime
    illumination: Illumination
    albedo: np.ndarray


@dataclass(frozen=True)
class SyntheticPicture:
    """Synthetic webcam image with its ground truth.

    Parameters
    ----------
    observation
        Input of a stage: decoded sRGB in [0, 1] with the erroneous pose.
    encoded
        Image ``(H, W, 3)`` uint8 sRGB.
    camera
        Camera or panorama at the true pose.
    radiance
        Radiance at the camera ``(H, W, 3)`` [cd/m²], foreground included.
    surface
        Radiance leaving the terrain ``(H, W, 3)`` [cd/m²], before aerial perspective.
    foreground
        ``(H, W)`` bool, True on houses and masts.
    development
        Exposure, white balance and tone curve of the image.
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


@dataclass(frozen=True)
class WebcamOptions:
    """How the images of a synthetic webcam are rendered and degraded.

    Parameters
    ----------
    faults
        Exposure, white balance, tone curve, noise and compression of the webcam.
    poses
        Standard deviations of the pose error of the observations; exact poses if ``None``.
    foreground
        Whether to add houses and a mast.
    sampling
        Sampling of the light transport; `QUICK` if ``None``.
    """

    faults: WebcamFaults = TYPICAL
    poses: PoseSigmas | None = None
    foreground: bool = False
    sampling: SamplingOptions | None = None


def webcam_series(
    terrain: Terrain,
    webcam: str,
    camera: Camera | Panorama,
    instants: Sequence[WebcamInstant],
    *,
    options: WebcamOptions | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[SyntheticPicture]:
    """Simulate the images of one webcam at several instants, with the same pose error and foreground in all images.

    Parameters
    ----------
    terrain
        Terrain mesh with its UV atlas.
    webcam
        Id of the webcam. Together with ``seed`` it determines all random numbers, so that the images of a webcam do not
        depend on other webcams.
    camera
        Camera or panorama at the true pose.
    instants
        Light and albedo of each image.
    options
        Faults, pose errors, foreground and sampling; `WebcamOptions()` if omitted.
    seed
        Seed of the random numbers.
    progress
        Callback with the completed fraction, 0 to 1.

    Returns
    -------
    list of SyntheticPicture
        One image per instant.

    Raises
    ------
    NoTerrainInView
        If no terrain is visible from the camera (raised by `trace_view`).
    """
    options, report = options or WebcamOptions(), progress or (lambda fraction: None)
    rng = np.random.default_rng([seed, zlib.crc32(webcam.encode())])
    perturbed, _ = perturb_pose(camera, options.poses or PoseSigmas(), rng)
    foreground_seed = int(rng.integers(2**32))
    mesh = mi_mesh(terrain, instants[0].albedo)
    unlit = ray_scene(mesh)
    sampling = options.sampling or QUICK
    coefficients = trace_view(unlit, camera, sampling, seed=seed, progress=lambda f: report(0.7 * f))
    pictures, current_albedo = [], instants[0].albedo
    for index, instant in enumerate(instants):
        if instant.albedo is not current_albedo:
            set_albedo(unlit, instant.albedo)
            coefficients = replace(coefficients, albedo=view_albedo(unlit, coefficients))
            current_albedo = instant.albedo
        view = relight_view(relightable_view(unlit, coefficients), instant.illumination)
        radiance, in_foreground = np.maximum(view.radiance, 0.0), np.zeros(view.coverage.shape, bool)
        if options.foreground:
            radiance, in_foreground = add_foreground(radiance, np.random.default_rng(foreground_seed))
        encoded, development = degrade(radiance, options.faults, rng)
        observation = Observation(
            linear_from_srgb(encoded / np.float32(255.0)),
            np.ones(in_foreground.shape, bool),
            perturbed,
            instant.time,
            webcam,
        )
        pictures.append(
            SyntheticPicture(
                observation, encoded, camera, radiance, view.surface, in_foreground, development, view.gbuffer
            )
        )
        report(0.7 + 0.3 * (index + 1) / len(instants))
    return pictures
