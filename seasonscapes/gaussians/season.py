"""Albedo between two dates: snow does not fade, its edge climbs.

Between dated albedos a plain mean would show half-melted snow everywhere. Snow comes and goes by height first, so discs
that change much change in the order of their heights, and only what changes little is mixed in proportion to time.
"""

from __future__ import annotations

import numpy as np

YEAR_DAYS = 365.2425
# A change of albedo that only snow makes, and how much of the way to the next date the edge is wide.
_SNOW, _EDGE = 0.15, 0.25


def albedo_at(albedo: np.ndarray, days: np.ndarray, day: float, height_m: np.ndarray) -> np.ndarray:
    """Albedo ``(N, 3)`` on a day of the year from dated ones.

    Parameters
    ----------
    albedo
        ``(M, N, 3)``.
    days
        ``(M,)`` days of the year of these, rising; the year closes on itself.
    height_m
        ``(N,)`` of the places.

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
    span = (days[second] - days[first]) % YEAR_DAYS
    share = ((day - days[first]) % YEAR_DAYS) / span
    before, then = albedo[first], albedo[second]
    change = then.mean(axis=1) - before.mean(axis=1)
    own = np.full(len(change), share, np.float32)
    for sign in (-1.0, 1.0):  # melting climbs, snowfall comes down
        moving = np.flatnonzero(sign * change > _SNOW)
        if len(moving):
            rank = np.empty(len(moving))
            rank[np.argsort(-sign * height_m[moving], kind="stable")] = (np.arange(len(moving)) + 0.5) / len(moving)
            own[moving] = np.clip((share * (1.0 + _EDGE) - rank) / _EDGE, 0.0, 1.0)
    return (before + own[:, None] * (then - before)).astype(np.float32)
