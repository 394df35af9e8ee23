"""The year between dated albedos: which of them clothe a day, and how snow goes from one to the next.

A cross-fade between a snowy and a bare date makes the whole mountain half white. In truth the snow line moves: each
place turns at its own day. Which places hold snow longest is told by the dates themselves, as a linear function of
height, aspect, steepness and hollowness that best parts white places from bare ones on both; from one date to the other
places that change much change in that order, each in a short part of the time. Small changes follow time.

Everything is told of N places of any kind: texels, pixels of a view, Gaussians.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np

from seasonscapes.terrain.attributes import TerrainAttributes
from seasonscapes.terrain.surface import Texture

SEASONS = ("blended", "nearest", "snow-line")
# A tropical year [days]; dates are compared by their place within it, whatever the year of the photograph.
YEAR_DAYS = 365.2422
# The snow line lies lowest some seven weeks after the shortest day.
_LOWEST_LINE_DAY = 39.0
# Snow is bright in blue as in red; rock, soil and leaves are not. Shares between these values of the test are mixtures.
_SNOW_DARKEST, _SNOW_BRIGHTEST = 0.32, 0.60
# A change of albedo that only snow makes, and from what share of snow on both dates on it is snow that merely aged.
_SNOW_CHANGE, _STILL_WHITE = 0.12, 0.75
# Below this upward component of the normal snow slides off, whatever the date: such places tell nothing of the line.
_STEEP_UP = 0.72
# What is thought of height [km], normal (east, north, up) and hollowness [hm] before the dates are asked: one logit is
# 30 m, and snow lies 300 m lower in the shade. It decides where they say nothing, as between all white and all bare.
_THOUGHT = np.array([33.0, 0.0, 10.0, 0.0, 0.0])
_TRUST = 1e-4
# A place turns while the line crosses so many logits about it.
_EDGE_LOGITS, _EDGE_LEAST, _EDGE_MOST = 6.0, 0.05, 1.0
# Places that the line is fitted on: thousands tell seven numbers as well as millions.
_MOST_PLACES = 10_000


@dataclass(frozen=True)
class DatedAlbedo:
    """An albedo texture, the day it is of, and a name of its content."""

    day: date
    content: str
    load: Callable[[], Texture]


def snow_share(albedo: np.ndarray) -> np.ndarray:
    """Share of snow ``(...)`` in [0, 1] that an albedo ``(..., 3)`` looks like.

    The least of blue and red decides: bare ground of the visible is darker in blue than in red and never bright in it, and
    glacier ice is darker in red.
    """
    albedo = np.asarray(albedo, np.float32)
    least = np.minimum(albedo[..., 2], albedo[..., 0])
    return np.clip((least - _SNOW_DARKEST) / (_SNOW_BRIGHTEST - _SNOW_DARKEST), 0.0, 1.0)


def day_number(day: date) -> float:
    """Of the year, the first of January is 1."""
    return float(day.timetuple().tm_yday)


def season_weights(dates: Sequence[date], day: date, *, season: str = "blended") -> list[tuple[int, float]]:
    """Which dated albedos to use on a day, and how much of each.

    Parameters
    ----------
    dates
        Of the albedos, in any order and of any years: the year is a circle.
    day
        The date to clothe.
    season
        ``nearest``; or ``blended`` and ``snow-line``, the neighbours before and after, in proportion to how near they are.

    Returns
    -------
    list of (index, weight)
        One or two of them, the earlier first; weights have sum 1.

    Raises
    ------
    ValueError
        Without any date, or for an unknown season.
    """
    if not dates:
        raise ValueError("season_weights: no dated albedo")
    if season not in SEASONS:
        raise ValueError(f"season: got {season!r}, expected one of {', '.join(SEASONS)}")
    preceding, following, way = neighbouring_dates([day_number(each) for each in dates], day_number(day))
    if season == "nearest":
        return [(following if way >= 0.5 else preceding, 1.0)]
    return [(index, weight) for index, weight in ((preceding, 1.0 - way), (following, way)) if weight > 0.0]


def neighbouring_dates(days: Sequence[float], day: float) -> tuple[int, int, float]:
    """The last of some days of the year before a day, the first after it, and the share of the time between them.

    Both are the same, and the share 0, where the day is one of them or there is only one.
    """
    after = [(each - day) % YEAR_DAYS for each in days]
    following = min(range(len(days)), key=lambda i: after[i])
    before = [(day - each) % YEAR_DAYS for each in days]
    preceding = min(range(len(days)), key=lambda i: before[i])
    if following == preceding or before[preceding] == 0.0:
        return preceding, preceding, 0.0
    if after[following] == 0.0:
        return following, following, 0.0
    return preceding, following, before[preceding] / (after[following] + before[preceding])


def snowline_fraction(first: float, second: float, day: float) -> float:
    """How much of its way between two days of the year the snow line has gone on a day between them, by the climate.

    Its height follows the year as a cosine whose least and greatest lie in the middle of February and of August (in the
    south it is the other way round, which changes no share). Dates on which the cosine is about the same tell no
    direction: between these it follows time.
    """
    way = ((day - first) % YEAR_DAYS) / max((second - first) % YEAR_DAYS, 1e-9)
    start, end, now = (-np.cos(2.0 * np.pi * (each - _LOWEST_LINE_DAY) / YEAR_DAYS) for each in (first, second, day))
    known = float(np.clip((abs(end - start) - 0.1) / 0.3, 0.0, 1.0))
    if known == 0.0:
        return float(way)
    return float((1.0 - known) * way + known * np.clip((now - start) / (end - start), 0.0, 1.0))


def snow_transition(ground: TerrainAttributes, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """When each place changes between two dates, for `interpolate_albedo`.

    Parameters
    ----------
    ground
        N places.
    first, second
        ``(N, 3)`` albedo on the dates.

    Returns
    -------
    numpy.ndarray
        ``(N, 3)`` float32: whether the place turns with the snow (1 or 0), and that times the shares of the time at which
        its turn begins and that it takes. Sums of places may be averaged, over a pixel or a footprint.
    """
    gains = _gains(first, second)
    turning = np.zeros((len(gains), 3), np.float32)
    if not gains.any():
        return turning
    holds = _features(ground) @ _holding(ground, (first, second), gains)
    # Melting begins where snow holds least, snowfall where it holds best.
    for sign in (-1, 1):
        these = np.flatnonzero(gains == sign)
        if len(these) == 0:
            continue
        low, high = np.percentile(holds[these], [3.0, 97.0])
        span = max(float(high - low), 1e-9)
        order = np.clip((holds[these] - low) / span, 0.0, 1.0)
        edge = float(np.clip(_EDGE_LOGITS / span, _EDGE_LEAST, _EDGE_MOST))
        turning[these, 0] = 1.0
        turning[these, 1] = (order if sign < 0 else 1.0 - order) / (1.0 + edge)
        turning[these, 2] = edge / (1.0 + edge)
    return turning


def _gains(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Whether places ``(N,)`` gain snow (1) or lose it (−1) between two dates, or neither (0)."""
    change = second.mean(axis=1) - first.mean(axis=1)
    white = np.minimum(snow_share(first), snow_share(second)) > _STILL_WHITE
    return np.where((np.abs(change) > _SNOW_CHANGE) & ~white, np.sign(change), 0.0).astype(np.int8)


def _features(ground: TerrainAttributes) -> np.ndarray:
    return np.concatenate(
        [ground.height_m[:, None] / 1000.0, ground.normal, ground.concavity_m[:, None] / 100.0], axis=1
    )


def _holding(ground: TerrainAttributes, dated: tuple[np.ndarray, np.ndarray], gains: np.ndarray) -> np.ndarray:
    """How well snow holds, as a weight ``(5,)`` of each of a place's features, in logits.

    Logistic regression of white or bare on both dates at once, which share all weights but have a line each
    (proportional odds, McCullagh 1980), by iteratively re-weighted least squares with a weak pull to what is thought.
    """
    told = np.flatnonzero((ground.normal[:, 2] > _STEEP_UP) | (gains != 0))
    told = told[:: max(1, len(told) // _MOST_PLACES)]
    part = TerrainAttributes(ground.height_m[told], ground.normal[told], ground.concavity_m[told])
    x = _features(part).astype(np.float64)
    x -= x.mean(axis=0)
    white = [
        np.where(gains[told] != 0, gains[told] == sign, snow_share(values[told]) > 0.5)
        for sign, values in zip((-1, 1), dated, strict=True)
    ]
    y = np.concatenate(white).astype(np.float64)
    ones, none = np.ones((len(x), 1)), np.zeros((len(x), 1))
    rows = np.concatenate([np.concatenate([x, ones, none], axis=1), np.concatenate([x, none, ones], axis=1)])
    thought = np.concatenate([_THOUGHT, np.zeros(2)])
    pull = _TRUST * len(x) * np.diag(np.concatenate([np.maximum(x.var(axis=0), 1e-6), np.ones(2)]))
    weight = np.zeros(7)

    def misfit(weight: np.ndarray) -> float:
        away, logit = weight - thought, rows @ weight
        return float(np.sum(np.logaddexp(0.0, logit) - y * logit) + 0.5 * away @ pull @ away)

    for _ in range(40):
        p = 1.0 / (1.0 + np.exp(-np.clip(rows @ weight, -40.0, 40.0)))
        slope = rows.T @ (y - p) - pull @ (weight - thought)
        step = np.linalg.solve(rows.T @ ((p * (1.0 - p))[:, None] * rows) + pull, slope)
        # Newton's step may overshoot where most places are sure; the sum to be least is convex.
        now = misfit(weight)
        while misfit(weight + step) > now and np.abs(step).max() > 1e-4:
            step = 0.5 * step
        weight = weight + step
        if np.abs(step).max() < 1e-4:
            break
    return weight[:5].astype(np.float32)


def interpolate_albedo(
    dated: tuple[np.ndarray, np.ndarray], turning: np.ndarray, way: float, line: float
) -> np.ndarray:
    """Albedo ``(..., 3)`` of a day between two dates.

    Parameters
    ----------
    dated
        ``(..., 3)`` each, on the two dates.
    turning
        ``(..., 3)`` from `snow_transition`.
    way
        Share of the time that has passed: small changes follow it.
    line
        How much of its way from the first date's height to the second's the snow line has gone: `snowline_fraction`, or what a
        snow station or a picture of the day says.

    Raises
    ------
    ValueError
        For a share that is not within 0 and 1.
    """
    if not (0.0 <= way <= 1.0 and 0.0 <= line <= 1.0):
        raise ValueError(f"albedo_between: got shares {way} of the time and {line} of the line's way, expected 0 to 1")
    first, second = dated
    if way == line and way in (0.0, 1.0):
        # To the bit, which weighted sums are not.
        return second if way else first
    moving, scale = np.clip(turning[..., 0], 0.0, 1.0), np.maximum(turning[..., 0], 1e-6)
    own = np.clip((line - turning[..., 1] / scale) / np.maximum(turning[..., 2] / scale, 1e-6), 0.0, 1.0)
    done = (moving * own + (1.0 - moving) * way)[..., None].astype(np.float32)
    return ((1.0 - done) * first + done * second).astype(np.float32)


def albedo_at(values: np.ndarray, days: Sequence[float], day: float, ground: TerrainAttributes) -> np.ndarray:
    """Albedo ``(N, 3)`` of places on a day of the year from dated ones, the snow line moving.

    Parameters
    ----------
    values
        ``(M, N, 3)``.
    days
        M days of the year of these; the year closes on itself.

    Raises
    ------
    ValueError
        No date, or a day that is not finite.
    """
    if len(days) == 0 or not np.isfinite(day):
        raise ValueError(f"albedo_at: got {len(days)} dates and day {day}")
    first, second, way = neighbouring_dates(days, day)
    if first == second:
        return values[first]
    pair = (values[first], values[second])
    return interpolate_albedo(
        pair, snow_transition(ground, *pair), way, snowline_fraction(days[first], days[second], day)
    )
