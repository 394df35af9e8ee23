"""How far the clock of a fixed camera was off in one picture, from the cast shadows that the picture shows.

Within a window of time the predicted shadows sweep over part of the ground. The rest, always in the sun or always in the
shade, tells weather, haze and response of the picture whatever the clock says; its reflectance is known from the camera's
other pictures. Each swept pixel is then compared with what it would look like for each tried offset. Only the sun's
visibility changes between offsets: shading, which depends on slopes and barely on minutes, is left out. The offset of the
least robust cost is taken, and blocks of the picture are drawn again and again for its standard deviation, which thereby holds
what the heights contribute where their errors differ from shadow to shadow.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from seasonscapes.albedo.fixed_camera import SUN_SHONE, FixedCamera, conditions_of, direct_share
from seasonscapes.albedo.picture_conditions import RESIDUAL_SCALE, ViewLight, picture_under

# Share of the sun that must come or go within the window; ground that loses less is steady.
_SWEPT, _STEADY = 0.5, 0.1
# Where the sun grazes the ground [cosine], its own slope decides between sun and shade, and not a shadow that is cast.
_GRAZING = 0.1
_LEAST_PIXELS, _LEAST_BLOCKS = 60, 6
# Shade must have this share of the steady ground: where all of it is lit, sunlight and skylight are told apart by guess.
_LEAST_SHARE = 0.02
# Draws of blocks; and the error [min] that all blocks share, as synthetic pictures with known times have it: coarse shadow edges.
_DRAWS, _COMMON_SIGMA_MIN = 300, 0.7
# An offset less certain than this [min] is not told.
LARGEST_SIGMA_MIN = 5.0


@dataclass(frozen=True)
class ClockOffset:
    """The offset of a clock, as one picture's shadows tell it.

    Parameters
    ----------
    offset_min
        Minutes to add to the stated time; NaN where no shadow was compared.
    sigma_min
        Standard deviation [min].
    trusted
        Whether the picture decides.
    reason
        What it was found from, or why it is not to be trusted.
    swept_pixels
        Number of pixels that shadows sweep over within the window.
    """

    offset_min: float
    sigma_min: float
    trusted: bool
    reason: str
    swept_pixels: int


def swept_and_steady(lights: Sequence[ViewLight], normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pixels that cast shadows sweep over, and those whose visibility of the sun stays.

    Parameters
    ----------
    lights
        Light at successive instants.
    normal
        ``(n, 3)`` unit normals of the heights, east-north-up.

    Returns
    -------
    swept, steady : numpy.ndarray
        ``(n,)`` bool each.
    """
    visible = np.stack([each.sun_visible for each in lights])
    least, most, change = visible.min(axis=0), visible.max(axis=0), np.abs(np.diff(visible, axis=0))
    direction = np.stack([each.sun_direction for each in lights])[1:][change.argmax(axis=0)]
    cast = (direction * normal).sum(axis=1) > _GRAZING
    return (most - least > _SWEPT) & cast, most - least < _STEADY


def clock_offset(
    camera: FixedCamera,
    picture: np.ndarray,
    usable: np.ndarray,
    lights: Sequence[ViewLight],
    offsets_min: np.ndarray,
    *,
    normal: np.ndarray,
    block: np.ndarray,
    seed: int = 0,
) -> ClockOffset:
    """Find the offset of a picture's clock from the shadows on n pixels.

    Parameters
    ----------
    camera
        Ground of the pixels, from other pictures of the camera.
    picture
        ``(n, 3)`` sRGB-encoded values in [0, 1].
    usable
        ``(n,)`` bool: False where something stands before the terrain.
    lights
        M, at the stated time and each of the offsets.
    offsets_min
        ``(M,)`` equally spaced, increasing, 0 among them [min].
    normal
        ``(n, 3)`` unit normals of the heights, east-north-up.
    block
        ``(n,)`` integers: pixels of one block err together.
    seed
        Of the resampling.

    Returns
    -------
    ClockOffset
        With standard deviation, and whether it can be trusted.
    """
    swept, steady = (mask & usable for mask in swept_and_steady(lights, normal))
    pixels, blocks = np.flatnonzero(swept), np.unique(block[swept])
    stated = int(np.argmin(np.abs(offsets_min)))
    if len(pixels) < _LEAST_PIXELS or len(blocks) < _LEAST_BLOCKS:
        reason = f"shadows sweep over {len(pixels)} pixels in {len(blocks)} parts of the picture: too few"
        return ClockOffset(np.nan, np.inf, False, reason, len(pixels))
    in_sun = float((lights[stated].sun_visible[steady] > _SWEPT).mean()) if steady.any() else 0.0
    if not steady.any() or in_sun > 1.0 - _LEAST_SHARE:
        reason = "no ground stays in the shade: how dark shade is in this picture cannot be told"
        return ClockOffset(np.nan, np.inf, False, reason, len(pixels))
    best, curve = stated, np.empty((len(lights), 0))
    for _ in range(2):
        conditions = conditions_of(camera, picture, steady, lights[best], seed=seed)
        if direct_share(camera.ground, lights[best], conditions) < SUN_SHONE:
            return ClockOffset(np.nan, np.inf, False, "no sunlight throws shadows in it", len(pixels))
        curve = _costs(camera, picture, lights, pixels, (best, conditions.values))
        best = int(np.argmin(curve.sum(axis=1)))
    by_block = np.stack([curve[:, block[pixels] == each].sum(axis=1) for each in blocks], axis=1)
    rng = np.random.default_rng(seed)
    drawn = [
        _minimum(by_block[:, rng.integers(0, len(blocks), len(blocks))].sum(axis=1), offsets_min) for _ in range(_DRAWS)
    ]
    found, sigma = _minimum(by_block.sum(axis=1), offsets_min), float(np.hypot(np.std(drawn), _COMMON_SIGMA_MIN))
    inside, certain = 0 < best < len(lights) - 1, sigma <= LARGEST_SIGMA_MIN
    reason = f"from {len(pixels)} pixels in {len(blocks)} parts of the picture that shadows sweep over"
    if not inside:
        reason = "the best offset lies at the end of the window"
    elif not certain:
        reason = f"parts of the picture differ by more than {LARGEST_SIGMA_MIN:.0f} min"
    return ClockOffset(found, sigma, inside and certain, reason, len(pixels))


def _costs(
    camera: FixedCamera,
    picture: np.ndarray,
    lights: Sequence[ViewLight],
    pixels: np.ndarray,
    kept: tuple[int, np.ndarray],
) -> np.ndarray:
    """Robust cost ``(M, S)`` of S pixels at each offset; all but the sun's visibility stays that of offset ``kept[0]``."""
    ground, light = camera.ground.at(pixels), lights[kept[0]].at(pixels)
    costs = []
    for each in lights:
        shown = ViewLight(light.sun, each.sun_visible[pixels], light.sun_direction, light.sky, light.clouds, light.day)
        misfit = (picture_under(ground, shown, kept[1]) - picture[pixels]) / RESIDUAL_SCALE
        costs.append(np.log1p((misfit**2).mean(axis=1)))
    return np.stack(costs)


def _minimum(cost: np.ndarray, offsets_min: np.ndarray) -> float:
    """Where the parabola through the least cost and its neighbours is least [min]."""
    k = int(np.clip(np.argmin(cost), 1, len(cost) - 2))
    before, at, after = cost[k - 1 : k + 2]
    curvature, step = before - 2.0 * at + after, offsets_min[1] - offsets_min[0]
    shift = 0.5 * (before - after) / curvature if curvature > 0.0 else 0.0
    return float(offsets_min[k] + np.clip(shift, -1.0, 1.0) * step)


def crossing_min(visible: np.ndarray, offsets_min: np.ndarray) -> np.ndarray:
    """When a shadow's edge passes over each pixel.

    Parameters
    ----------
    visible
        ``(M, n)`` share of the ground that sees the sun.
    offsets_min
        ``(M,)`` [min].

    Returns
    -------
    numpy.ndarray
        ``(n,)`` [min]; NaN where the sun does not come or go for good within the window.
    """
    first, last = visible[0], visible[-1]
    passed = np.abs(first - last) > _SWEPT
    share = ((visible[1:] + visible[:-1]) / 2.0 - last).mean(axis=0) / np.where(passed, first - last, 1.0)
    return np.where(passed, offsets_min[0] + share * (offsets_min[-1] - offsets_min[0]), np.nan)


def edge_speed_m_per_min(time_min: np.ndarray, position_m: np.ndarray) -> float:
    """Median speed at which shadow edges run over the ground.

    Parameters
    ----------
    time_min
        ``(H, W)`` when the edge passes; NaN where it does not [min].
    position_m
        ``(H, W, 3)`` of the ground [m].

    Returns
    -------
    float
        [m/min]; NaN where no edge passes three neighbouring pixels.
    """
    # The gradient of the time within the plane of two neighbours: g = Σ c_i e_i with g · e_i = Δt_i.
    right, down = position_m[:-1, 1:] - position_m[:-1, :-1], position_m[1:, :-1] - position_m[:-1, :-1]
    later = np.stack([time_min[:-1, 1:], time_min[1:, :-1]], axis=-1) - time_min[:-1, :-1, None]
    edges = np.stack([right, down], axis=-2)
    gram = edges @ np.swapaxes(edges, -1, -2)
    determinant = gram[..., 0, 0] * gram[..., 1, 1] - gram[..., 0, 1] ** 2
    known = np.isfinite(later).all(axis=-1) & np.isfinite(determinant) & (determinant > 1e-9)
    if not known.any():
        return float("nan")
    gram, later = gram[known], later[known]
    slowness = np.sqrt(np.maximum((later * np.linalg.solve(gram, later[..., None])[..., 0]).sum(axis=1), 1e-12))
    return float(1.0 / np.median(slowness))
