"""Lit textures (illuminance and reflected radiance per texel) and irradiance integrated over time (insolation)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from seasonscapes.relighting.luminous_efficacy import efficacies_lm_w
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.hemisphere_rays import RayScene, SurfacePoints
from seasonscapes.rendering.irradiance import Irradiance, irradiance_blocks
from seasonscapes.sky.illumination import Illumination, diffuse_horizontal_illuminance, luminance

Progress = Callable[[float], None]


@dataclass(frozen=True)
class LitTexture:
    """Illuminance and albedo of the texels of a texture under one illumination.

    Parameters
    ----------
    sun, sky, bounce
        ``(R, S, 3)`` float32 illuminance of the surface by sun and moon, by the sky, and by light that other terrain
        reflects [lx]; NaN for texels without a surface.
    albedo
        ``(R, S, 3)`` albedo of the texels.
    tilted
        Whether sun, sky and bounce are those of normals from photographs, and not of the heights' own.
    """

    sun: np.ndarray
    sky: np.ndarray
    bounce: np.ndarray
    albedo: np.ndarray
    tilted: bool = False

    @property
    def radiance(self) -> np.ndarray:
        """Radiance ``(R, S, 3)`` that leaves the surface [cd/m²]; zero for texels without a surface."""
        return np.nan_to_num((self.sun + self.sky + self.bounce) * self.albedo / np.float32(np.pi))


def bake_lit_texture(
    terrain: RayScene,
    positions: np.ndarray,
    albedo: np.ndarray,
    light: Illumination,
    *,
    sampling: SamplingOptions | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> LitTexture:
    """Compute the illuminance of all texels of a texture under an illumination.

    Parameters
    ----------
    terrain
        From `rendering.hemisphere_rays.ray_scene`.
    positions
        ``(R, S, 3)`` positions of the texel centres, ENU [m], from `terrain.texels`; NaN for texels without a surface.
    albedo
        ``(R, S, 3)`` albedo of the texels.
    light
        Sky, sun and moon.
    sampling
        Sampling options; defaults if ``None``.
    seed
        Of the sampling.
    progress
        Called with the completed fraction.

    Returns
    -------
    LitTexture
        Illuminance by component, and the albedo.

    Raises
    ------
    ValueError
        If no texel has a surface.
    """
    sun, sky, bounce = (np.full((*positions.shape[:2], 3), np.nan, np.float32) for _ in range(3))
    flat = [component.reshape(-1, 3) for component in (sun, sky, bounce)]
    blocks = irradiance_blocks(terrain, positions.reshape(-1, 3), [light], sampling, seed=seed, progress=progress)
    for index, _, results in blocks:
        for received in results:
            for component, values in zip(flat, (received.sun, received.sky, received.bounce), strict=True):
                component[index] = values
    return LitTexture(sun, sky, bounce, albedo)


@dataclass(frozen=True)
class IntegratedIrradiance:
    """Weighted sums over time of the irradiance of N points; values of a single instant for one weight of 1.

    Parameters
    ----------
    direct_w, sky_w, reflected_w
        ``(N,)`` float32 irradiance of the surface by sun and moon, by the sky, and by light that other terrain reflects
        [W/m² × unit of the weights]; NaN for points without a surface.
    total_lx
        ``(N,)`` total illuminance [lx × unit of the weights].
    sunlit
        ``(N,)`` sum of the weights of the instants at which more than half of the sun's disc is visible.
    """

    direct_w: np.ndarray
    sky_w: np.ndarray
    reflected_w: np.ndarray
    total_lx: np.ndarray
    sunlit: np.ndarray


@dataclass(frozen=True)
class IlluminationSeries:
    """Illuminations at T instants, with the weights of a sum over time.

    Parameters
    ----------
    lights
        Illuminations at the instants.
    weights
        ``(T,)`` weight of each instant: hours for an insolation in Wh/m², 1 for a single instant.
    """

    lights: Sequence[Illumination]
    weights: np.ndarray

    def __post_init__(self):
        if len(self.lights) != len(self.weights):
            raise ValueError(f"IlluminationSeries: got {len(self.lights)} lights and {len(self.weights)} weights")


def integrate_irradiance(
    blocks: Iterable[tuple[np.ndarray, SurfacePoints, Iterator[Irradiance]]], count: int, series: IlluminationSeries
) -> IntegratedIrradiance:
    """Sum the irradiance of N surface points over several instants.

    Parameters
    ----------
    blocks
        From `rendering.irradiance.irradiance_blocks` or `kept_irradiance`, for the illuminations of ``series``.
    count
        Number N of the points.
    series
        Illuminations at the instants and their weights.

    Returns
    -------
    IntegratedIrradiance
        Weighted sums of irradiance, illuminance and sunshine.
    """
    efficacies = [_efficacies(light) for light in series.lights]
    sums = np.full((count, 5), np.nan, np.float32)
    for index, points, results in blocks:
        total = np.zeros((len(index), 5), np.float64)
        for light, weight, (direct, diffuse), received in zip(
            series.lights, series.weights, efficacies, results, strict=True
        ):
            sun, sky, bounce = (luminance(values) for values in (received.sun, received.sky, received.bounce))
            total[:, 0] += weight * sun / direct
            total[:, 1] += weight * sky / diffuse
            # By day most reflected light is sunlight.
            total[:, 2] += weight * bounce / (direct if light.sun is not None else diffuse)
            total[:, 3] += weight * (sun + sky + bounce)
            total[:, 4] += weight * _sunlit(light, points.normal, sun)
        sums[index] = total
    return IntegratedIrradiance(*sums.T)


def _efficacies(light: Illumination) -> tuple[float, float]:
    """Luminous efficacy of sunlight and of skylight [lm/W]."""
    if light.efficacy_lm_w is not None:
        return light.efficacy_lm_w
    sky = float(luminance(diffuse_horizontal_illuminance(light.sky_radiance)))
    if light.sun is None:
        return efficacies_lm_w(0.0, sky, 1.0)
    elevation = float(np.degrees(np.arcsin(np.clip(light.sun.direction[2], -1.0, 1.0))))
    return efficacies_lm_w(float(luminance(light.sun.normal_illuminance_lx)), sky, elevation)


def _sunlit(light: Illumination, normal: np.ndarray, sun_lx: np.ndarray) -> np.ndarray:
    """Points ``(N,)`` from which more than half of the sun's disc is visible."""
    if light.sun is None:
        return np.zeros(len(sun_lx), bool)
    facing = np.maximum(normal @ np.asarray(light.sun.direction, np.float32), 1e-6)
    return sun_lx > 0.5 * facing * float(luminance(light.sun.normal_illuminance_lx))
