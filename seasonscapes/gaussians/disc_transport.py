"""What each disc knows of the land around it: its horizon, the sky it sees, and the light that other slopes send it.

Traced once, for any light afterwards:

* sun and moon: elevation of the horizon in 64 azimuths, one byte each; a soft edge stands for the disc's own width;
* sky: coefficients in a small basis of directions (`rendering.direction_basis`), one byte each;
* bounce: the light that terrain of unit albedo would send, as a polynomial in the sun's direction and for a grey sky,
  times the albedo around, so that snow on the next slope brightens this one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from seasonscapes.frames import direction_from_angles
from seasonscapes.gaussians.surfels import Surfels
from seasonscapes.sky.illumination import Illumination, Luminary, global_horizontal_illuminance, uniform_sky
from seasonscapes.terrain.attributes import plan_blur

AZIMUTHS = 64
HORIZON_RANGE_RAD = (-0.02, 1.29)
# Coefficients of the sky for each disc.
SKY_RANK = 8
# Albedo is averaged over this distance around a disc to know the colour of what others send it [m].
AROUND_M = 300.0
# A fresh table's edge is this soft [rad]: the sun's radius and half a step of the table.
SOFTNESS_RAD = 0.012
# Parts of the terrain that pass light on: what discs receive from them is smooth.
SENDERS = 4096
Progress = Callable[[float], None]


@dataclass(frozen=True)
class DiscTransport:
    """Light transport of N discs, made once for a terrain.

    Parameters
    ----------
    normals
        ``(N, 3)`` float32 mean shading normals, shorter than 1 where the surface is rough.
    horizon
        ``(N, 64)`` uint8 over `HORIZON_RANGE_RAD`, column 0 north, clockwise.
    sky
        ``(N, r)`` int8; times ``sky_scale`` ``(r,)`` float32.
    from_sky
        ``(P, r)`` float32: patch radiances of a sky to the light of each coefficient.
    patches
        Subdivision of the sky, a name in `sky_patches.SUBDIVISIONS`.
    bounce
        ``(N, 5)`` int8; times ``bounce_scale`` ``(5,)`` float32.
    open_sky
        ``(N,)`` float32 sky-view factor.
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
        """Sky-view factor ``(N,)`` float32: irradiance under a white sky over π."""
        from seasonscapes.rendering.sky_patches import sky_patches

        white = np.where(sky_patches(self.patches).directions[:, 2] > 0.0, 1.0, 0.0)
        weights = (self.sky_scale * (self.from_sky.T @ white)).astype(np.float32)
        return np.clip(self.sky @ weights, 0.0, 1.0).astype(np.float32)


def quantised_horizon(angle_rad: np.ndarray) -> np.ndarray:
    """Angles ``(N, A)`` [rad] as uint8 over `HORIZON_RANGE_RAD`."""
    low, high = HORIZON_RANGE_RAD
    return np.clip(np.rint((angle_rad - low) * (255.0 / (high - low))), 0, 255).astype(np.uint8)


def signed_bytes(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Columns ``(N, k)`` as int8, and the scale ``(k,)`` that brings them back."""
    scale = np.maximum(np.abs(values).max(axis=0), 1e-9) / 127.0
    return np.rint(values / scale).astype(np.int8), scale.astype(np.float32)


def bounce_terms(direction: np.ndarray) -> np.ndarray:
    """One and the components of unit directions ``(..., 3)``, ``(..., 4)``: light from all around varies no faster."""
    direction = np.asarray(direction, np.float64)
    return np.concatenate([np.ones((*direction.shape[:-1], 1)), direction], axis=-1)


def trace_disc_transport(
    ray_scene, surfels: Surfels, albedo: np.ndarray, *, rays: int = 128, seed: int = 0, progress: Progress | None = None
) -> DiscTransport:
    """Trace what `DiscTransport` holds.

    Parameters
    ----------
    ray_scene
        From `rendering.hemisphere_rays.ray_scene`.
    albedo
        ``(N, 3)`` of the discs while the terrain carries the albedo that it has now: bounced light is divided by it.
    rays
        Over each disc's hemisphere, a power of two.
    """
    from seasonscapes.rendering.horizon_angles import horizon_angles
    from seasonscapes.rendering.irradiance import irradiance, upload_points

    tell = progress or (lambda share: None)
    traced = centre_coefficients(ray_scene, surfels, rays=rays, rank=SKY_RANK, seed=seed)
    tell(0.4)
    low, high = HORIZON_RANGE_RAD
    angle = horizon_angles(
        ray_scene,
        traced.points,
        azimuths=AZIMUTHS,
        low_rad=low,
        high_rad=high,
        progress=lambda share: tell(0.4 + 0.4 * share),
    )
    ready = upload_points(ray_scene, traced)
    around = neighbourhood_mean(surfels.means, albedo, surfels.plan.spacing_m).mean(axis=1)
    bounce = _bounce_coefficients(lambda light: irradiance(ready, light, sun_rays_each=1).bounce.mean(axis=1)) / around
    tell(1.0)
    return DiscTransport(
        surfels.normals,
        quantised_horizon(angle),
        *signed_bytes(traced.receivers.direct.astype(np.float32)),
        np.asarray(traced.clusters.from_sky, np.float32),
        traced.clusters.patches,
        *signed_bytes(bounce.T),
    )


def centre_coefficients(ray_scene, surfels: Surfels, *, rays: int, rank: int, seed: int = 0):
    """Daylight coefficients at one place near each disc's centre; `ValueError` where the surface is not found."""
    from seasonscapes.rendering.irradiance import surface_at
    from seasonscapes.rendering.transport import SamplingOptions, trace_points

    points, found = surface_at(ray_scene, surfels.places[:, surfels.places.shape[1] // 2 - 3])
    if len(found) != len(surfels.means):
        raise ValueError(f"{len(surfels.means) - len(found)} discs have no surface under them; is it the same terrain?")
    return trace_points(ray_scene, points, SamplingOptions(rays=rays, rank=rank, clusters=SENDERS), seed=seed)


def _bounce_coefficients(bounced: Callable[[Illumination], np.ndarray]) -> np.ndarray:
    """Least squares ``(5, N)`` of light from other slopes for unit suns all over the sky, then for a unit grey sky."""
    directions = [
        direction_from_angles(360.0 * k / count + 7.0 * elevation, elevation)
        for elevation, count in ((4.0, 8), (14.0, 10), (28.0, 10), (45.0, 8), (68.0, 4))
        for k in range(count)
    ]
    dark = np.zeros((16, 32, 3), np.float32)
    seen = [bounced(Illumination(dark, Luminary(direction, np.ones(3), 0.27))) for direction in directions]
    coefficients = np.linalg.lstsq(bounce_terms(np.array(directions)), np.array(seen), rcond=None)[0]
    return np.concatenate([coefficients, bounced(uniform_sky(1.0 / np.pi))[None]])


def neighbourhood_mean(means: np.ndarray, albedo: np.ndarray, spacing_m: float) -> np.ndarray:
    """Albedo ``(N, 3)`` of discs averaged over the others within some `AROUND_M`, never quite black."""
    return np.maximum(plan_blur(means, albedo, spacing_m, AROUND_M), 1e-3)


@dataclass(frozen=True)
class LightState:
    """All that the discs are told of an instant's light. Plain numbers; a day's worth fits in a kilobyte.

    Parameters
    ----------
    bodies
        Directions ``(B, 3)`` and normal illuminances ``(B, 3)`` [lx] of sun and moon, brightest first.
    sky
        ``(r, 3)`` what the sky sends to each coefficient of `Transport.sky`, as radiance.
    sky_lx
        ``(3,)`` horizontal illuminance from the sky.
    global_lx
        Luminance part of the horizontal illuminance from everything: what pictures are exposed by.
    day
        Day of the year with its fraction, from 1.
    """

    bodies: tuple[np.ndarray, np.ndarray]
    sky: np.ndarray
    sky_lx: np.ndarray
    global_lx: float
    day: float


def light_state(transport: DiscTransport, illumination: Illumination, day: float) -> LightState:
    """What a light is to the discs; `ValueError` where it is dark or not finite."""
    from seasonscapes.rendering.sky_patches import patch_radiance, sky_patches
    from seasonscapes.sky.illumination import diffuse_horizontal_illuminance, luminance

    everything = float(luminance(global_horizontal_illuminance(illumination)))
    if not (np.isfinite(everything) and everything > 0.0):
        raise ValueError(f"illumination: horizontal illuminance is {everything} lx, expected light")
    bodies = [
        b
        for b in (illumination.sun, illumination.moon)
        if b is not None and luminance(b.normal_illuminance_lx) > 1e-4 * everything
    ]
    bodies.sort(key=lambda body: -luminance(body.normal_illuminance_lx))
    sky = transport.from_sky.T @ patch_radiance(sky_patches(transport.patches), illumination.sky_radiance)
    directions = np.array([body.direction for body in bodies], np.float32).reshape(-1, 3)
    illuminances = np.array([body.normal_illuminance_lx for body in bodies], np.float32).reshape(-1, 3)
    return LightState(
        (directions, illuminances),
        sky.astype(np.float32),
        diffuse_horizontal_illuminance(illumination.sky_radiance).astype(np.float32),
        everything,
        float(day),
    )


def surfel_irradiance(
    ray_scene,
    surfels: Surfels,
    lights: Sequence[Illumination],
    *,
    rays: int = 256,
    seed: int = 0,
    progress: Progress | None = None,
) -> np.ndarray:
    """Irradiance of every disc under every light, the truth that discs learn from: ``(T, N, 3)`` float32 [lx].

    Sun and moon are averaged over the places of each disc's cell by shadow rays; sky and other slopes are taken at
    its centre.
    """
    from seasonscapes.rendering.irradiance import irradiance, surface_at, upload_points
    from seasonscapes.rendering.receivers import luminaries
    from seasonscapes.rendering.sun_visibility import cosine_seen, numbered_turn, sun_rays

    tell = progress or (lambda share: None)
    ready = upload_points(ray_scene, centre_coefficients(ray_scene, surfels, rays=rays, rank=32, seed=seed))
    tell(0.3)
    count, each = surfels.places.shape[:2]
    points, found = surface_at(ray_scene, surfels.places.reshape(-1, 3))
    if len(found) != count * each:
        raise ValueError("places of discs have no surface under them; is it the same terrain?")
    points = points.reshape(count, each)
    sun = sun_rays(
        ray_scene,
        (points.origin, points.normal, points.outward),
        np.full((count, each), 1.0 / each, np.float32),
        numbered_turn(np.arange(count)),
    )
    result = np.empty((len(lights), count, 3), np.float32)
    for number, light in enumerate(lights):
        received = irradiance(ready, light, sun_rays_each=1)
        result[number] = received.sky + received.bounce
        for body in luminaries(light):
            result[number] += cosine_seen(sun, body).mean(axis=1)[:, None] * np.asarray(body.normal_illuminance_lx)
        tell(0.3 + 0.7 * (number + 1) / len(lights))
    return result
