"""Light transport of discs on the terrain: horizon, sky coefficients and interreflection, traced once for any light.

* sun and moon: elevation of the horizon in 128 azimuths, one byte each; a soft edge accounts for the disc's extent;
* sky: coefficients in a small basis of directions (`rendering.direction_basis`), one byte each;
* bounce: light reflected by terrain of unit albedo, as a linear polynomial in the sun's direction and for a grey sky;
  it is multiplied by the mean albedo of the surroundings.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.frames import direction_from_angles
from seasonscapes.gaussians.surfels import Surfels
from seasonscapes.sky.illumination import Illumination, Luminary, global_horizontal_illuminance, uniform_sky
from seasonscapes.terrain.attributes import horizontal_gaussian_mean

if TYPE_CHECKING:
    from seasonscapes.rendering.coefficients import PointCoefficients
    from seasonscapes.rendering.hemisphere_rays import RayScene

AZIMUTHS = 128
# Sun and moon; other bodies of a light are dropped.
BODIES = 2
HORIZON_RANGE_RAD = (-0.02, 1.29)
# Number of sky coefficients per disc.
SKY_RANK = 8
# Standard deviation of the Gaussian that averages albedo around a disc, for the colour of interreflection [m].
NEIGHBOURHOOD_SIGMA_M = 300.0
# Initial softness of the horizon [rad]: the sun's radius. Softer edges blur the shadows of fine discs.
SOFTNESS_RAD = 0.004
# Light clusters of the terrain; few suffice, because interreflection is smooth.
LIGHT_CLUSTERS = 4096
Progress = Callable[[float], None]


@dataclass(frozen=True)
class DiscTransport:
    """Light transport of N discs on a terrain.

    Parameters
    ----------
    normals
        ``(N, 3)`` float32 mean shading normals; their length is below 1 where the surface is rough.
    horizon
        ``(N, 128)`` uint8 over `HORIZON_RANGE_RAD`, column 0 north, clockwise.
    sky, sky_scale
        ``(N, r)`` int8 sky coefficients and their scale ``(r,)`` float32.
    from_sky
        ``(P, r)`` float32 matrix from patch radiances of a sky to the light of each coefficient.
    patches
        Subdivision of the sky, a name in `sky_patches.SUBDIVISIONS`.
    bounce, bounce_scale
        ``(N, 5)`` int8 bounce coefficients and their scale ``(5,)`` float32.
    """

    normals: np.ndarray
    horizon: np.ndarray
    sky: np.ndarray
    sky_scale: np.ndarray
    from_sky: np.ndarray
    patches: str
    bounce: np.ndarray
    bounce_scale: np.ndarray

    @property
    def open_sky(self) -> np.ndarray:
        """Sky-view factor ``(N,)`` float32: irradiance under a sky of unit radiance over π."""
        from seasonscapes.rendering.sky_patches import sky_patches

        unit_sky = np.where(sky_patches(self.patches).directions[:, 2] > 0.0, 1.0, 0.0)
        weights = (self.sky_scale * (self.from_sky.T @ unit_sky)).astype(np.float32)
        return np.clip(self.sky @ weights, 0.0, 1.0).astype(np.float32)


def quantised_horizon(angle_rad: np.ndarray) -> np.ndarray:
    """Quantise horizon angles to bytes.

    Parameters
    ----------
    angle_rad
        ``(N, A)`` elevations [rad]; clipped to `HORIZON_RANGE_RAD`.

    Returns
    -------
    numpy.ndarray
        ``(N, A)`` uint8 over `HORIZON_RANGE_RAD`.
    """
    low, high = HORIZON_RANGE_RAD
    return np.clip(np.rint((angle_rad - low) * (255.0 / (high - low))), 0, 255).astype(np.uint8)


def signed_bytes(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Quantise the columns of a matrix to signed bytes.

    Parameters
    ----------
    values
        ``(N, k)``.

    Returns
    -------
    tuple of numpy.ndarray
        ``(N, k)`` int8, and the scale ``(k,)`` float32 of each column.
    """
    scale = np.maximum(np.abs(values).max(axis=0), 1e-9) / 127.0
    return np.rint(values / scale).astype(np.int8), scale.astype(np.float32)


def bounce_terms(direction: np.ndarray) -> np.ndarray:
    """Linear basis of interreflection in the sun's direction, which varies smoothly: one and its components.

    Parameters
    ----------
    direction
        ``(..., 3)`` unit vectors, ENU.

    Returns
    -------
    numpy.ndarray
        ``(..., 4)``.
    """
    direction = np.asarray(direction, np.float64)
    return np.concatenate([np.ones((*direction.shape[:-1], 1)), direction], axis=-1)


def trace_disc_transport(
    ray_scene: RayScene,
    surfels: Surfels,
    albedo: np.ndarray,
    *,
    rays: int = 128,
    seed: int = 0,
    progress: Progress | None = None,
) -> DiscTransport:
    """Trace the light transport of discs.

    Parameters
    ----------
    ray_scene
        Terrain with its texture, from `rendering.hemisphere_rays.ray_scene`.
    surfels
        N discs on this terrain.
    albedo
        ``(N, 3)`` of the discs under the same texture; interreflection is divided by its mean over the surroundings.
    rays
        Over each disc's hemisphere, a power of two.
    seed
        Seed of the random numbers.
    progress
        Called with the finished fraction.

    Returns
    -------
    DiscTransport
        Horizon, sky and bounce coefficients of all discs.

    Raises
    ------
    ValueError
        If a disc has no terrain below it.
    """
    from seasonscapes.rendering.horizon_angles import horizon_angles
    from seasonscapes.rendering.irradiance import irradiance, upload_points

    report = progress or (lambda fraction: None)
    traced = centre_coefficients(ray_scene, surfels, rays=rays, rank=SKY_RANK, seed=seed)
    report(0.4)
    low, high = HORIZON_RANGE_RAD
    angle = horizon_angles(
        ray_scene,
        traced.points,
        azimuths=AZIMUTHS,
        low_rad=low,
        high_rad=high,
        progress=lambda fraction: report(0.4 + 0.4 * fraction),
    )
    device_points = upload_points(ray_scene, traced)
    surroundings = neighbourhood_mean(surfels.means, albedo, surfels.spacing_m).mean(axis=1)

    def reflected(light: Illumination) -> np.ndarray:
        return irradiance(device_points, light, sun_rays_per_point=1).bounce.mean(axis=1)

    bounce = _bounce_coefficients(reflected) / surroundings
    report(1.0)
    return DiscTransport(
        surfels.normals,
        quantised_horizon(angle),
        *signed_bytes(traced.receivers.direct.astype(np.float32)),
        np.asarray(traced.clusters.from_sky, np.float32),
        traced.clusters.patches,
        *signed_bytes(bounce.T),
    )


def centre_coefficients(
    ray_scene: RayScene, surfels: Surfels, *, rays: int, rank: int, seed: int = 0
) -> PointCoefficients:
    """Trace the daylight coefficients at one point near the centre of each disc.

    Parameters
    ----------
    ray_scene
        Terrain with its texture.
    surfels
        N discs on this terrain.
    rays
        Over each disc's hemisphere, a power of two.
    rank
        Number of sky coefficients.
    seed
        Seed of the random numbers.

    Returns
    -------
    rendering.transport.PointCoefficients
        Coefficients of N points.

    Raises
    ------
    ValueError
        If a disc has no terrain below it.
    """
    from seasonscapes.rendering.coefficients import SamplingOptions
    from seasonscapes.rendering.irradiance import surface_at
    from seasonscapes.rendering.transport import trace_points

    points, found = surface_at(ray_scene, surfels.sample_points[:, surfels.sample_points.shape[1] // 2 - 3])
    if len(found) != len(surfels.means):
        raise ValueError(
            f"{len(surfels.means) - len(found)} discs have no terrain below them; "
            "use the terrain that the discs were made from"
        )
    return trace_points(ray_scene, points, SamplingOptions(rays=rays, rank=rank, clusters=LIGHT_CLUSTERS), seed=seed)


def _bounce_coefficients(reflected: Callable[[Illumination], np.ndarray]) -> np.ndarray:
    """Coefficients ``(5, N)`` of interreflection, by least squares over 40 sun directions, and for a grey unit sky."""
    directions = [
        direction_from_angles(360.0 * k / count + 7.0 * elevation, elevation)
        for elevation, count in ((4.0, 8), (14.0, 10), (28.0, 10), (45.0, 8), (68.0, 4))
        for k in range(count)
    ]
    dark = np.zeros((16, 32, 3), np.float32)
    received = [reflected(Illumination(dark, Luminary(direction, np.ones(3), 0.27))) for direction in directions]
    coefficients = np.linalg.lstsq(bounce_terms(np.array(directions)), np.array(received), rcond=None)[0]
    return np.concatenate([coefficients, reflected(uniform_sky(1.0 / np.pi))[None]])


def neighbourhood_mean(means: np.ndarray, albedo: np.ndarray, spacing_m: float | np.ndarray) -> np.ndarray:
    """Average the albedo of discs over their surroundings, with a Gaussian of `NEIGHBOURHOOD_SIGMA_M`.

    Parameters
    ----------
    means
        ``(N, 3)`` centres of the discs [m].
    albedo
        ``(N, 3)``.
    spacing_m
        Distance of neighbouring discs [m], ``(N,)`` or one for all.

    Returns
    -------
    numpy.ndarray
        ``(N, 3)``, at least 0.001.
    """
    return np.maximum(horizontal_gaussian_mean(means, albedo, spacing_m, NEIGHBOURHOOD_SIGMA_M), 1e-3)


@dataclass(frozen=True)
class LightState:
    """Light of one instant in the basis of the discs' transport.

    Parameters
    ----------
    bodies
        Directions ``(B, 3)`` and normal illuminances ``(B, 3)`` [lx] of sun and moon, brightest first.
    sky
        ``(r, 3)`` radiance of the sky per coefficient of `DiscTransport.sky` [cd/m²].
    sky_lx
        ``(3,)`` horizontal illuminance from the sky [lx].
    global_lx
        Photopic horizontal illuminance from sun, moon and sky [lx]; the unit of colours.
    day
        Day of the year with its fraction, from 1.
    """

    bodies: tuple[np.ndarray, np.ndarray]
    sky: np.ndarray
    sky_lx: np.ndarray
    global_lx: float
    day: float


def light_state(transport: DiscTransport, illumination: Illumination, day: float) -> LightState:
    """Project a light onto the basis of the discs' transport.

    Parameters
    ----------
    transport
        Light transport of the discs.
    illumination
        Sun, moon and sky.
    day
        Day of the year with its fraction, from 1.

    Returns
    -------
    LightState
        Bodies and sky coefficients; bodies below 10⁻⁴ of the horizontal illuminance are left out.

    Raises
    ------
    ValueError
        If the horizontal illuminance is zero or not finite.
    """
    from seasonscapes.rendering.sky_patches import patch_radiance, sky_patches
    from seasonscapes.sky.illumination import diffuse_horizontal_illuminance, luminance

    global_lx = float(luminance(global_horizontal_illuminance(illumination)))
    if not (np.isfinite(global_lx) and global_lx > 0.0):
        raise ValueError(f"illumination: horizontal illuminance is {global_lx} lx, expected light")
    bodies = [
        body
        for body in (illumination.sun, illumination.moon)
        if body is not None and luminance(body.normal_illuminance_lx) > 1e-4 * global_lx
    ]
    bodies.sort(key=lambda body: -luminance(body.normal_illuminance_lx))
    sky = transport.from_sky.T @ patch_radiance(sky_patches(transport.patches), illumination.sky_radiance)
    directions = np.array([body.direction for body in bodies], np.float32).reshape(-1, 3)
    illuminances = np.array([body.normal_illuminance_lx for body in bodies], np.float32).reshape(-1, 3)
    return LightState(
        (directions, illuminances),
        sky.astype(np.float32),
        diffuse_horizontal_illuminance(illumination.sky_radiance).astype(np.float32),
        global_lx,
        float(day),
    )


def surfel_irradiance(
    ray_scene: RayScene,
    surfels: Surfels,
    lights: Sequence[Illumination],
    *,
    rays: int = 256,
    seed: int = 0,
    progress: Progress | None = None,
) -> np.ndarray:
    """Trace the irradiance of every disc under every light, as training targets.

    Sun and moon are averaged over the sample points of each disc's cell by shadow rays; sky and interreflection are
    evaluated at its centre.

    Parameters
    ----------
    ray_scene
        Terrain with its texture.
    surfels
        N discs on this terrain.
    lights
        T lights.
    rays
        Over each disc's hemisphere, a power of two.
    seed
        Seed of the random numbers.
    progress
        Called with the finished fraction.

    Returns
    -------
    numpy.ndarray
        ``(T, N, 3)`` float32 [lx].

    Raises
    ------
    ValueError
        If a disc has no terrain below it.
    """
    from seasonscapes.rendering.irradiance import irradiance, surface_at, upload_points
    from seasonscapes.rendering.receivers import luminaries
    from seasonscapes.rendering.sun_visibility import hashed_disc_offset, sun_rays, visible_cosine

    report = progress or (lambda fraction: None)
    device_points = upload_points(ray_scene, centre_coefficients(ray_scene, surfels, rays=rays, rank=32, seed=seed))
    report(0.3)
    count, samples = surfels.sample_points.shape[:2]
    points, found = surface_at(ray_scene, surfels.sample_points.reshape(-1, 3))
    if len(found) != count * samples:
        raise ValueError("sample points of discs have no terrain below them; use the terrain the discs were made from")
    points = points.reshape(count, samples)
    sun = sun_rays(
        ray_scene,
        points.origin,
        points.normal,
        points.geometric_normal,
        np.full((count, samples), 1.0 / samples, np.float32),
        hashed_disc_offset(np.arange(count)),
    )
    result = np.empty((len(lights), count, 3), np.float32)
    for number, light in enumerate(lights):
        received = irradiance(device_points, light, sun_rays_per_point=1)
        result[number] = received.sky + received.bounce
        for body in luminaries(light):
            result[number] += visible_cosine(sun, body).mean(axis=1)[:, None] * np.asarray(body.normal_illuminance_lx)
        report(0.3 + 0.7 * (number + 1) / len(lights))
    return result
