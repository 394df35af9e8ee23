"""Albedo between two dates: snow does not fade, its edge climbs.

Between dated albedos a plain mean would show half-melted snow everywhere. Which places lose their snow first is told by
the dates themselves: a linear function of height, aspect, steepness and hollowness that best parts the places that are
white at both dates, at one, and at none. Places that change much do so in its order; small changes follow time.
"""

from __future__ import annotations

import numpy as np

from seasonscapes.gaussians.transport import plan_blur

YEAR_DAYS = 365.2425
# A change of albedo that only snow makes, what is white, and how much of the way to the next date an edge is wide.
_SNOW, _WHITE, _EDGE = 0.12, 0.35, 0.5
# Steeper than this snow slides off, whatever the date; hollows are seen against land this far around [m].
_STEEP_COSINE, _HOLLOW_M = 0.72, 90.0


def albedo_at(albedo: np.ndarray, days: np.ndarray, day: float, places: np.ndarray) -> np.ndarray:
    """Albedo ``(N, 3)`` on a day of the year from dated ones.

    Parameters
    ----------
    albedo
        ``(M, N, 3)``.
    days
        ``(M,)`` days of the year of these, rising; the year closes on itself.
    places
        What may tell a place's snow ``(N, F)``, see `snow_places`.

    Raises
    ------
    ValueError
        No date, or a day that is not finite.
    """
    if len(days) == 0 or not np.isfinite(day):
        raise ValueError(f"albedo_at: got {len(days)} dates and day {day}")
    after = int(np.searchsorted(days, day, side="left"))
    if len(days) == 1 or (after < len(days) and days[after] == day):
        return albedo[min(after, len(days) - 1)]
    first, second = (after - 1) % len(days), after % len(days)
    share = ((day - days[first]) % YEAR_DAYS) / ((days[second] - days[first]) % YEAR_DAYS)
    before, then = albedo[first], albedo[second]
    change = then.mean(axis=1) - before.mean(axis=1)
    own = np.full(len(change), share, np.float32)
    for sign in (-1.0, 1.0):
        moving = sign * change > _SNOW
        if moving.any():
            # Melting begins where snow holds least, snowfall where it holds best.
            turn = _snow_order(before, then, moving, places)
            own[moving] = np.clip((share * (1.0 + _EDGE) - (turn if sign < 0.0 else 1.0 - turn)) / _EDGE, 0.0, 1.0)
    return (before + own[:, None] * (then - before)).astype(np.float32)


def snow_places(means: np.ndarray, normals: np.ndarray, spacing_m: float) -> np.ndarray:
    """Height, aspect, steepness and hollowness of discs ``(N, 5)`` float32, for `albedo_at`."""
    unit = normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    height = means[:, 2:]
    hollow = plan_blur(means, height, spacing_m, _HOLLOW_M) - height
    return np.concatenate([height / 1000.0, unit, hollow / 100.0], axis=1).astype(np.float32)


def _snow_order(before: np.ndarray, then: np.ndarray, moving: np.ndarray, places: np.ndarray) -> np.ndarray:
    """How well snow holds, 0 to 1 ``(K,)``, of the places that change between two dated albedos."""
    white = (before.mean(axis=1) > _WHITE).astype(float) + (then.mean(axis=1) > _WHITE)
    white[moving] = 1.0
    told = np.concatenate([places, np.ones((len(places), 1))], axis=1)
    # Far above and far below the line nothing is to be learned about it.
    band = np.percentile(places[moving, 0], [1.0, 99.0]) + np.array([-0.2, 0.2])
    near = (places[:, 0] > band[0]) & (places[:, 0] < band[1]) & ((places[:, 3] > _STEEP_COSINE) | moving)
    weight, *_ = np.linalg.lstsq(told[near], white[near] - 1.0, rcond=None)
    key = told[moving] @ weight
    low, high = np.percentile(key, [3.0, 97.0])
    return np.clip((key - low) / max(high - low, 1e-9), 0.0, 1.0)
