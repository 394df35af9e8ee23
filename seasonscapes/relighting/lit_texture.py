"""What the ground receives and sends back, texel by texel and cell by cell: lit textures, insolation maps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.relighting.luminous_efficacy import efficacies_lm_w
from seasonscapes.rendering.irradiance import irradiance_blocks
from seasonscapes.rendering.transport import SamplingOptions
from seasonscapes.sky.illumination import Illumination, diffuse_horizontal_illuminance, luminance

Progress = Callable[[float], None]


@dataclass(frozen=True)
class LitTexture:
    """A texture under one light.

    Parameters
    ----------
    sun, sky, bounce
        ``(R, S, 3)`` float32 illuminance on the surface, from sun and moon, from the sky, by way of other terrain [lx];
        NaN where no surface has the texel.
    albedo
        ``(R, S, 3)`` what it was multiplied with.
    """

    sun: np.ndarray
    sky: np.ndarray
    bounce: np.ndarray
    albedo: np.ndarray

    @property
    def radiance(self) -> np.ndarray:
        """Radiance ``(R, S, 3)`` that leaves the surface [cd/m²]; zero where there is none."""
        return np.nan_to_num((self.sun + self.sky + self.bounce) * self.albedo / np.float32(np.pi))


def lit_texture(
    terrain: Any,
    positions: np.ndarray,
    albedo: np.ndarray,
    light: Illumination,
    *,
    sampling: SamplingOptions | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> LitTexture:
    """Bake the light of an instant into a texture.

    Parameters
    ----------
    terrain
        From `rendering.hemisphere_rays.ray_scene`.
    positions
        ``(R, S, 3)`` of the texels' centres, ENU [m], NaN where there is no surface; see `terrain.texels`.
    albedo
        ``(R, S, 3)``.
    """
    parts = [np.full((*positions.shape[:2], 3), np.nan, np.float32) for _ in range(3)]
    flat = [part.reshape(-1, 3) for part in parts]
    blocks = irradiance_blocks(terrain, positions.reshape(-1, 3), [light], sampling, seed=seed, progress=progress)
    for index, _, results in blocks:
        for received in results:
            for part, values in zip(flat, (received.sun, received.sky, received.bounce), strict=True):
                part[index] = values
    return LitTexture(*parts, albedo)


@dataclass(frozen=True)
class IntegratedIrradiance:
    """What a surface receives over a time, or at an instant where the weights say so.

    Parameters
    ----------
    direct_w, sky_w, reflected_w
        ``(N,)`` float32 weighted sums of irradiance on the surface [W/m² × the weights' unit]; NaN without a surface.
    total_lx
        ``(N,)`` of illuminance [lx × the weights' unit].
    sunlit
        ``(N,)`` sum of the weights while more than half of the sun's disc is in sight of the surface.
    """

    direct_w: np.ndarray
    sky_w: np.ndarray
    reflected_w: np.ndarray
    total_lx: np.ndarray
    sunlit: np.ndarray


def integrate_irradiance(
    terrain: Any,
    positions: np.ndarray,
    lights: Sequence[Illumination],
    weights: np.ndarray,
    *,
    sampling: SamplingOptions | None = None,
    search_m: float = 2.0,
    seed: int = 0,
    progress: Progress | None = None,
) -> IntegratedIrradiance:
    """Sum what places receive under many lights.

    Parameters
    ----------
    positions
        ``(N, 3)`` ENU [m]; NaN where there is none.
    lights
        Of the instants.
    weights
        ``(T,)`` of each: hours for an insolation in Wh/m², 1 for a single instant.
    search_m
        See `rendering.irradiance.surface_at`.
    """
    efficacy = [_efficacies(light) for light in lights]
    sums = np.full((len(positions), 5), np.nan, np.float32)
    blocks = irradiance_blocks(terrain, positions, lights, sampling, seed=seed, search_m=search_m, progress=progress)
    for index, points, results in blocks:
        total = np.zeros((len(index), 5), np.float64)
        for light, weight, (direct, diffuse), received in zip(lights, weights, efficacy, results, strict=True):
            sun, sky, bounce = (luminance(part) for part in (received.sun, received.sky, received.bounce))
            total[:, 0] += weight * sun / direct
            total[:, 1] += weight * sky / diffuse
            # What comes by way of the ground is sunlight for the most part while the sun is up.
            total[:, 2] += weight * bounce / (direct if light.sun is not None else diffuse)
            total[:, 3] += weight * (sun + sky + bounce)
            total[:, 4] += weight * _in_sun(light, points.normal, sun)
        sums[index] = total
    return IntegratedIrradiance(*sums.T)


def _efficacies(light: Illumination) -> tuple[float, float]:
    sky = float(luminance(diffuse_horizontal_illuminance(light.sky_radiance)))
    if light.sun is None:
        return efficacies_lm_w(0.0, sky, 1.0)
    elevation = float(np.degrees(np.arcsin(np.clip(light.sun.direction[2], -1.0, 1.0))))
    return efficacies_lm_w(float(luminance(light.sun.normal_illuminance_lx)), sky, elevation)


def _in_sun(light: Illumination, normal: np.ndarray, sun_lx: np.ndarray) -> np.ndarray:
    if light.sun is None:
        return np.zeros(len(sun_lx), bool)
    facing = np.maximum(normal @ np.asarray(light.sun.direction, np.float32), 1e-6)
    return sun_lx > 0.5 * facing * float(luminance(light.sun.normal_illuminance_lx))
