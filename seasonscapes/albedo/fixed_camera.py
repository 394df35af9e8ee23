"""Ground of each pixel of a fixed camera, and the conditions of each of its pictures, solved together.

A camera that stands still sees the same ground in the same pixel. Its pictures then measure reflectance and slopes at
their own resolution, below that of the heights, once the light of each hour is known: the unknowns are seven numbers for
each pixel (`picture_conditions.Ground`) and `picture_conditions.COUNT` for each picture. They alternate: conditions from a
sample of the pixels, ground from all pictures, by damped Gauss-Newton steps on robust weights, with the slopes of the
heights as the prior of the normals. What a picture shows and the others do not (a cloud before the terrain, new snow) is
an outlier of that pixel and picture.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.albedo.picture_conditions import (
    CONTRAST,
    COUNT,
    GAIN,
    RESIDUAL_SCALE,
    START,
    SUN,
    Conditions,
    Ground,
    ViewLight,
    encoded,
    fit_conditions,
    incidence,
    linear_parts,
    picture_under,
)
from seasonscapes.albedo.seasons import circular_days
from seasonscapes.errors import NoUsablePixels
from seasonscapes.images import linear_from_srgb

# Far pixels tell haze, near ones the shade: both have equal shares of the sample.
SAMPLE = 2400
ITERATIONS, STEPS, LAST_STEPS = 5, 3, 10
# Direct light is kept for so many rounds, until the pixels' shading has been learnt from it.
_SUN_KEPT, _SUN_AT_FIRST = 2, 0.7
# Encoded values from which a pixel is clipped: it tells a lower bound.
_CLIPPED, _CLIPPED_WEIGHT, _CLIPPED_SLOPE = 0.98, 0.3, 0.02
_LARGEST_STEP, _DAMPING = 0.5, 1e-4
# Prior of normals: standard deviation of their difference from the heights', and that of a picture's encoded values.
SHADING_SIGMA, _PICTURE_SIGMA = 0.35, 0.03
_LARGEST_TURN = 0.3
# Ground barely turned away from the sun may turn back.
_BARELY_TURNED = -0.05
_MEAN_REFLECTANCE = 0.15
# A smaller share of direct light on the best lit fiftieth of the ground throws no shadow that a picture shows.
SUN_SHONE, _BEST_LIT = 0.25, 98.0
# Suns this far apart light slopes alike, and the ground looks alike over so many days: widths of the weights of pictures.
_ALIKE_DEG, _ALIKE_DAYS = 30.0, 30.0
# A picture is not explained where its residual is so many times the median of all pictures'.
_UNEXPLAINED = 3.0


@dataclass(frozen=True)
class FitOptions:
    """How `fit_fixed_camera` solves.

    Parameters
    ----------
    shading_sigma
        Standard deviation of the pixels' mean normals about those of the heights; 0 keeps the heights'.
    block
        Number of neighbouring pixels that err together, for the standard deviations.
    seed
        Of the sample of pixels.
    """

    shading_sigma: float = SHADING_SIGMA
    block: int = 64
    seed: int = 0


@dataclass(frozen=True)
class FixedCamera:
    """What the pictures of a fixed camera tell; from `fit_fixed_camera`.

    Parameters
    ----------
    ground
        Of its n terrain pixels.
    conditions
        Of each of the K pictures.
    sun_direction, day
        ``(K, 3)`` and ``(K,)`` of each picture, as in `picture_conditions.ViewLight`.
    misfit
        ``(K, n, 3)`` float32 picture - model, encoded values; 0 where something stood before the terrain.
    residual
        ``(K,)`` robust standard deviation of the misfit.
    direct
        ``(K,)`` share of direct light in the pictures (`direct_share`).
    block
        Number of neighbouring pixels that err together.
    """

    ground: Ground
    conditions: list[Conditions]
    sun_direction: np.ndarray
    day: np.ndarray
    misfit: np.ndarray
    residual: np.ndarray
    direct: np.ndarray
    block: int


def fit_fixed_camera(
    pictures: Sequence[np.ndarray],
    usable: Sequence[np.ndarray],
    lights: Sequence[ViewLight],
    distance_km: np.ndarray,
    normal: np.ndarray,
    *,
    options: FitOptions | None = None,
    progress: Callable[[float], None] | None = None,
) -> FixedCamera:
    """Solve the ground of all pixels and the conditions of all pictures.

    Parameters
    ----------
    pictures
        K arrays ``(n, 3)``: sRGB-encoded values in [0, 1] of the terrain pixels.
    usable
        K arrays ``(n,)`` bool: False where something stands before the terrain.
    lights
        Light of each picture.
    distance_km
        ``(n,)`` [km].
    normal
        ``(n, 3)`` unit normals of the heights, east-north-up.
    options
        How to solve.
    progress
        Called with the finished share.

    Returns
    -------
    FixedCamera
        For `conditions_of` and `relit_mean`.

    Raises
    ------
    NoUsablePixels
        Where fewer than two pictures are given, or one has no usable pixel.
    """
    if len(pictures) < 2 or any(not mask.any() for mask in usable):
        raise NoUsablePixels(f"a fixed camera needs two or more pictures with usable pixels; got {len(pictures)}")
    report, options = progress or (lambda share: None), options or FitOptions()
    ground = _first_ground(pictures, distance_km, normal)
    chosen = sampled_pixels(distance_km, SAMPLE, options.seed)
    whole = list(zip(pictures, usable, lights, strict=True))
    part = [(picture[chosen], mask[chosen], light.at(chosen)) for picture, mask, light in whole]
    sample, slopes = ground.at(chosen), normal[chosen]
    conditions = [Conditions(_first_values(light), np.full(COUNT, np.inf)) for light in lights]
    scale = np.zeros(3)
    for done in range(ITERATIONS):
        free = np.ones(COUNT, bool)
        free[SUN] = done >= _SUN_KEPT
        conditions = [
            fit_conditions(
                picture[mask], sample.at(mask), light.at(mask), start=each.values, free=free, block=options.block
            )
            if mask.any()
            else each
            for (picture, mask, light), each in zip(part, conditions, strict=True)
        ]
        # The common factor of all gains belongs to the reflectance.
        shift = np.mean([each.values[GAIN] for each in conditions], axis=0)
        for each in conditions:
            each.values[GAIN] -= shift
        scale = scale + shift
        sample = replace(sample, reflectance=sample.reflectance * np.exp(shift))
        trust = _trust(_residuals(sample, part, conditions))
        sample = _refined(sample, slopes, part, conditions, trust, STEPS, options.shading_sigma)
        report(0.8 * (done + 1) / ITERATIONS)
    ground = replace(ground, reflectance=ground.reflectance * np.exp(scale))
    trust = _trust(_residuals(sample, part, conditions))
    ground = _refined(ground, normal, whole, conditions, trust, LAST_STEPS, options.shading_sigma)
    misfit = np.stack(
        [
            ((picture - picture_under(ground, light, each.values)) * mask[:, None]).astype(np.float32)
            for (picture, mask, light), each in zip(whole, conditions, strict=True)
        ]
    )
    residual = _residuals(ground, whole, conditions)
    report(1.0)
    suns, days = np.stack([light.sun_direction for light in lights]), np.array([light.day for light in lights])
    direct = np.array([direct_share(ground, *each) for each in zip(lights, conditions, strict=True)])
    return FixedCamera(ground, conditions, suns, days, misfit, residual, direct, options.block)


def _first_ground(pictures: Sequence[np.ndarray], distance_km: np.ndarray, normal: np.ndarray) -> Ground:
    """The geometric mean of the pictures as reflectance, and the slopes of the heights."""
    logs = np.mean([np.log(np.maximum(linear_from_srgb(picture), 2e-3)) for picture in pictures], axis=0)
    reflectance = np.exp(logs)
    reflectance *= _MEAN_REFLECTANCE / reflectance.mean(axis=0)
    return Ground(reflectance, np.column_stack([normal, np.zeros(len(normal))]), distance_km)


def _first_values(light: ViewLight) -> np.ndarray:
    values = START.copy()
    values[SUN] = _SUN_AT_FIRST if light.sun.any() else 0.0
    return values


def sampled_pixels(distance_km: np.ndarray, count: int, seed: int) -> np.ndarray:
    """Indices of a random sample: half of it among the farther half of the range of distances, where there are as many."""
    rng = np.random.default_rng(seed)
    middle = np.sqrt(max(float(distance_km.min()), 1e-3) * float(distance_km.max()))
    groups = [np.flatnonzero(distance_km > middle), np.flatnonzero(distance_km <= middle)]
    drawn = [rng.choice(group, min(count // 2, len(group)), replace=False) for group in groups]
    return np.sort(np.concatenate(drawn))


def _refined(
    ground: Ground,
    normal: np.ndarray,
    pictures: Sequence[tuple[np.ndarray, np.ndarray, ViewLight]],
    conditions: Sequence[Conditions],
    trust: np.ndarray,
    steps: int,
    shading_sigma: float,
) -> Ground:
    """Ground after Gauss-Newton steps in log reflectance and shading, with Cauchy weights on encoded residuals."""
    expected = np.column_stack([normal, np.zeros(len(normal))])
    precision = (_PICTURE_SIGMA / max(shading_sigma, 1e-6)) ** 2 * np.eye(4)
    for _ in range(steps):
        gradient, curvature = np.zeros_like(ground.reflectance), np.full_like(ground.reflectance, _DAMPING)
        turn, stiffness = (expected - ground.shading) @ precision, np.tile(precision, (len(normal), 1, 1))
        for (picture, mask, light), each, share in zip(pictures, conditions, trust, strict=True):
            factor, for_unit, addend = linear_parts(light, ground, each.values)
            linear, contrast = np.maximum(ground.reflectance * factor + addend, 1e-6), np.exp(each.values[CONTRAST])
            curved = linear**contrast
            slope = 1.055 / 2.4 * np.clip(curved, 1e-4, 1.0) ** (1.0 / 2.4 - 1.0) * contrast * curved / linear
            slope = np.where(curved < 1.0, slope, _CLIPPED_SLOPE) * ground.reflectance
            misfit = picture - encoded(linear, float(contrast))
            weight = share * mask[:, None] / (1.0 + (misfit / RESIDUAL_SCALE) ** 2)
            weight = weight * np.where(picture > _CLIPPED, _CLIPPED_WEIGHT, 1.0)
            gradient += weight * slope * factor * misfit
            curvature += weight * (slope * factor) ** 2
            if light.sun.any():
                lit = slope * for_unit * (incidence(light, ground.shading) > _BARELY_TURNED)[:, None]
                direction = np.append(light.sun_direction, 1.0)
                turn += (weight * lit * misfit).sum(axis=1)[:, None] * direction
                stiffness += (weight * lit**2).sum(axis=1)[:, None, None] * np.outer(direction, direction)
        step = np.linalg.solve(stiffness, turn[..., None])[..., 0]
        ground = Ground(
            ground.reflectance * np.exp(np.clip(gradient / curvature, -_LARGEST_STEP, _LARGEST_STEP)),
            ground.shading + np.clip(step, -_LARGEST_TURN, _LARGEST_TURN),
            ground.distance_km,
        )
    return ground


def _residuals(
    ground: Ground, pictures: Sequence[tuple[np.ndarray, np.ndarray, ViewLight]], conditions: Sequence[Conditions]
) -> np.ndarray:
    """Robust standard deviation of each picture's misfit ``(K,)``; infinite where none of its pixels is usable."""
    return np.array(
        [
            1.4826 * np.median(np.abs(picture_under(ground, light, each.values) - picture)[mask])
            if mask.any()
            else np.inf
            for (picture, mask, light), each in zip(pictures, conditions, strict=True)
        ]
    )


def _trust(residual: np.ndarray) -> np.ndarray:
    """Weight of each picture: pictures that the model leaves unexplained count little."""
    return np.minimum(1.0, (np.median(residual) / np.maximum(residual, 1e-6)) ** 2)


def unexplained(camera: FixedCamera) -> np.ndarray:
    """Pictures ``(K,)`` bool that light, haze, exposure and response do not explain."""
    return camera.residual > _UNEXPLAINED * np.median(camera.residual)


def direct_share(ground: Ground, light: ViewLight, conditions: Conditions) -> float:
    """Share of direct sunlight in the light on the best lit fiftieth of the ground, 0 to 1.

    Unlike `Conditions.sun` it is small where the sun grazes the slopes or haze and clouds outshine it; above `SUN_SHONE`
    the sun is taken to have shone.
    """
    if not light.sun.any():
        return 0.0
    direct = conditions.sun * light.sun.mean() * light.sun_visible * np.maximum(incidence(light, ground.shading), 0.0)
    diffuse = ((1.0 - conditions.overcast) * light.sky + conditions.overcast * light.clouds).mean(axis=1)
    return float(np.percentile(direct / np.maximum(direct + diffuse, 1e-9), _BEST_LIT))


def conditions_of(
    camera: FixedCamera,
    picture: np.ndarray,
    usable: np.ndarray,
    light: ViewLight,
    *,
    sun: float | None = None,
    seed: int = 0,
) -> Conditions:
    """Conditions of another picture of the camera, from its own usable pixels.

    Parameters
    ----------
    camera
        From pictures that do not include this one.
    picture, usable, light
        As in `fit_fixed_camera`.
    sun
        Direct light as a share of that of a clear sky, where it is known.
    seed
        Of the sample of pixels.

    Raises
    ------
    NoUsablePixels
        Where the picture has none.
    """
    chosen = np.flatnonzero(usable)
    if len(chosen) == 0:
        raise NoUsablePixels("conditions_of: the picture has no usable pixel")
    chosen = chosen[sampled_pixels(camera.ground.distance_km[chosen], 2 * SAMPLE, seed)]
    found = Conditions(_first_values(light), np.full(COUNT, np.inf))
    free = np.ones(COUNT, bool)
    if sun is not None:
        free[SUN], found.values[SUN] = False, sun
    part = picture[chosen], camera.ground.at(chosen), light.at(chosen)
    for _ in range(2):
        found = fit_conditions(*part, start=found.values, free=free, block=camera.block)
    return found


def relit_at(camera: FixedCamera, light: ViewLight, number: int) -> np.ndarray:
    """One of the camera's pictures ``(n, 3)`` in the light of another instant, under its own conditions and misfit."""
    relit = picture_under(camera.ground, light, camera.conditions[number].values)
    return np.clip(relit + camera.misfit[number], 0.0, 1.0)


def relit_mean(camera: FixedCamera, light: ViewLight, taken: Sequence[int]) -> np.ndarray:
    """Mean ``(n, 3)`` of some of the camera's pictures, relit to another instant: what is probable while its weather is unknown.

    Pictures of like suns and of near days of the year weigh most: slopes err alike, and snow and leaves are as they were.

    Parameters
    ----------
    camera
        From `fit_fixed_camera`.
    light
        Light of the instant.
    taken
        Numbers of the pictures, at least one.
    """
    chosen = np.asarray(taken)
    angle_deg = np.degrees(np.arccos(np.clip(camera.sun_direction[chosen] @ light.sun_direction, -1.0, 1.0)))
    days = circular_days(camera.day[chosen] - light.day)
    squared = (angle_deg / _ALIKE_DEG) ** 2 + (days / _ALIKE_DAYS) ** 2
    weight = np.exp(-0.5 * (squared - squared.min()))
    return np.tensordot(weight / weight.sum(), np.stack([relit_at(camera, light, number) for number in taken]), 1)
