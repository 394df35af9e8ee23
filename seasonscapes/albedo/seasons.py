"""Interpolation of dated albedos over the year, with a snow line that moves between two dates.

Linear blending of a snowy and a bare date makes the whole mountain half white. In reality the snow line moves, and each
place changes within a few days. The order in which places lose or gain snow is estimated from the dates themselves: a
logistic regression of snow cover on height, normal and concavity, fitted to both dates. Places whose albedo changes
strongly change in that order, each in a short part of the interval; small changes follow time linearly.

All functions apply to N points of any kind: texels, pixels of a view, Gaussians.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np

from seasonscapes.terrain.attributes import TerrainAttributes
from seasonscapes.terrain.surface import Texture

log = logging.getLogger(__name__)

# Photographs of another time of the year show other snow and leaves [days].
SEASON_DAYS = 45
SEASONS = ("blended", "nearest", "snow-line")
# A tropical year [days]; dates are compared by their position within it, whatever the year of the photograph.
YEAR_DAYS = 365.2422
# Day of the year with the lowest snow line, about seven weeks after the winter solstice.
_LOWEST_SNOWLINE_DAY = 39.0
# Snow has equal albedo in blue and red; rock, soil and leaves are darker in one of them. The lesser of the two below
# the first value means no snow, above the second full snow cover.
_SNOW_DARKEST, _SNOW_BRIGHTEST = 0.32, 0.60
# Least albedo change attributed to snow, and snow share on both dates from which on a change is attributed to ageing.
_SNOW_CHANGE, _SNOW_COVERED = 0.12, 0.75
# Below this upward component of the normal snow slides off whatever the date, so such points do not constrain the fit.
_LEAST_UP = 0.72
# Prior logistic coefficients for height [km], normal (east, north, up) and concavity [hm]: one logit is 30 m of height,
# and the snow line is 300 m lower in shade. Only relevant where the dates do not constrain them, such as between
# completely snow-covered and completely bare.
_PRIOR_COEFFICIENTS = np.array([33.0, 0.0, 10.0, 0.0, 0.0])
_PRIOR_WEIGHT = 1e-4
# Width of a point's transition in logits, and its shortest and longest duration relative to that of the snow line.
_TRANSITION_LOGITS, _SHORTEST_TRANSITION, _LONGEST_TRANSITION = 6.0, 0.05, 1.0
# Largest number of points in the regression: thousands determine its seven coefficients.
_MOST_POINTS = 10_000


@dataclass(frozen=True)
class DatedAlbedo:
    """An albedo texture of a date.

    Parameters
    ----------
    day
        The date.
    content
        Identifier of the texture's content, for caching.
    load
        Returns the texture.
    """

    day: date
    content: str
    load: Callable[[], Texture]


@dataclass(frozen=True)
class AlbedoSeries:
    """Dated albedos of a place and how to interpolate between them.

    Parameters
    ----------
    dated
        Albedo textures, at least one; sorted by date on construction.
    season
        Interpolation between the dates, a name in `SEASONS`: ``blended`` linearly in time, ``nearest`` not at all,
        ``snow-line`` with a moving snow line (`interpolate_albedo`).

    Raises
    ------
    ValueError
        If there is no date, or the season is unknown.

    Examples
    --------
    >>> from datetime import date
    >>> from seasonscapes.albedo.seasons import AlbedoSeries, DatedAlbedo
    >>> days = date(2024, 8, 1), date(2024, 2, 1)
    >>> series = AlbedoSeries(tuple(DatedAlbedo(day, "", lambda: None) for day in days), "snow-line")
    >>> [dated.day.month for dated in series.dated]
    [2, 8]
    """

    dated: tuple[DatedAlbedo, ...]
    season: str = "blended"

    def __post_init__(self) -> None:
        if not self.dated:
            raise ValueError("AlbedoSeries: no dated albedo, expected at least one")
        if self.season not in SEASONS:
            raise ValueError(f"AlbedoSeries: season: got {self.season!r}, expected one of {', '.join(SEASONS)}")
        object.__setattr__(self, "dated", tuple(sorted(self.dated, key=lambda dated: dated.day)))


def snow_share(albedo: np.ndarray) -> np.ndarray:
    """Estimate the snow-covered fraction of surfaces from their albedo.

    The lesser of blue and red decides: bare ground is darker in blue than in red and never bright in blue, and glacier
    ice is darker in red.

    Parameters
    ----------
    albedo
        ``(..., 3)``.

    Returns
    -------
    numpy.ndarray
        ``(...)`` float32 in [0, 1].

    Examples
    --------
    >>> snow_share([[0.8, 0.8, 0.8], [0.2, 0.15, 0.1]])
    array([1., 0.], dtype=float32)
    """
    albedo = np.asarray(albedo, np.float32)
    darker = np.minimum(albedo[..., 2], albedo[..., 0])
    return np.clip((darker - _SNOW_DARKEST) / (_SNOW_BRIGHTEST - _SNOW_DARKEST), 0.0, 1.0)


def day_number(day: date) -> float:
    """Return the day of the year of a date; 1 January is 1.

    Parameters
    ----------
    day
        Any date.

    Returns
    -------
    float
        Day number, from 1 to 366.
    """
    return float(day.timetuple().tm_yday)


def circular_days(difference: float | np.ndarray) -> np.ndarray:
    """Days between two days of the year that differ by ``(...)`` in their numbers; the year is a circle.

    Examples
    --------
    >>> circular_days(360.0).round()
    np.float64(5.0)
    """
    apart = np.abs(difference) % YEAR_DAYS
    return np.minimum(apart, YEAR_DAYS - apart)


def days_apart(first: date, second: date) -> float:
    """Days between two dates within the year, which is a circle: 20 December and 10 January are three weeks apart.

    Examples
    --------
    >>> from datetime import date
    >>> round(days_apart(date(2023, 12, 20), date(2025, 1, 10)))
    21
    """
    return float(circular_days(day_number(first) - day_number(second)))


def warn_of_unseen_seasons(days: Collection[date], photographed: Collection[date]) -> None:
    """Warn of days that are too far in the year from every photographed one to show the same snow and leaves.

    Parameters
    ----------
    days
        Days that are asked for.
    photographed
        Days of the photographs, of any year; at least one.

    Examples
    --------
    >>> from datetime import date
    >>> warn_of_unseen_seasons([date(2024, 7, 1)], [date(2019, 6, 20)])
    """
    for day in sorted(set(days)):
        away = round(min(days_apart(day, each) for each in photographed))
        if away > SEASON_DAYS:
            log.warning(
                "%s lies %d days of the year from every picture: snow and leaves of that season were never seen",
                day,
                away,
            )


def season_weights(dates: Sequence[date], day: date, *, season: str = "blended") -> list[tuple[int, float]]:
    """Compute the weights of dated albedos on a day.

    Parameters
    ----------
    dates
        Dates of the albedos, in any order and of any years: the year is cyclic.
    day
        The date to interpolate at.
    season
        ``nearest`` for the nearest date alone; ``blended`` and ``snow-line`` for the dates before and after, weighted
        linearly in time.

    Returns
    -------
    list of (index, weight)
        One or two of them, the earlier first; the weights sum to 1.

    Raises
    ------
    ValueError
        If there is no date, or the season is unknown.
    """
    if not dates:
        raise ValueError("season_weights: no dated albedo")
    if season not in SEASONS:
        raise ValueError(f"season: got {season!r}, expected one of {', '.join(SEASONS)}")
    preceding, following, fraction = neighbouring_dates([day_number(other) for other in dates], day_number(day))
    if season == "nearest":
        return [(following if fraction >= 0.5 else preceding, 1.0)]
    return [(index, weight) for index, weight in ((preceding, 1.0 - fraction), (following, fraction)) if weight > 0.0]


def neighbouring_dates(days: Sequence[float] | np.ndarray, day: float) -> tuple[int, int, float]:
    """Find the days of the year next before and next after a day.

    Parameters
    ----------
    days
        Days of the year, in any order; the year is cyclic.
    day
        Day of the year.

    Returns
    -------
    tuple of (int, int, float)
        Index of the preceding day, index of the following day, and the elapsed fraction of the interval between them.
        Both indices are equal, and the fraction is 0, if ``day`` is one of the days or there is only one.

    Examples
    --------
    >>> neighbouring_dates([100.0, 200.0], 150.0)
    (0, 1, 0.5)
    """
    after = [(other - day) % YEAR_DAYS for other in days]
    following = min(range(len(days)), key=lambda i: after[i])
    before = [(day - other) % YEAR_DAYS for other in days]
    preceding = min(range(len(days)), key=lambda i: before[i])
    if following == preceding or before[preceding] == 0.0:
        return preceding, preceding, 0.0
    if after[following] == 0.0:
        return following, following, 0.0
    return preceding, following, before[preceding] / (after[following] + before[preceding])


def snowline_fraction(first: float, second: float, day: float) -> float:
    """Climatological position of the snow line between its heights on two days of the year.

    The height of the snow line is modelled as a cosine of the day of the year, with its minimum in the middle of
    February and its maximum in the middle of August (reversed in the southern hemisphere, which changes no fraction).
    Between dates on which the cosine is almost equal the fraction follows time.

    Parameters
    ----------
    first, second
        Days of the year of the two dates.
    day
        Day of the year between them.

    Returns
    -------
    float
        0 at the first date's height, 1 at the second's.
    """
    elapsed = ((day - first) % YEAR_DAYS) / max((second - first) % YEAR_DAYS, 1e-9)
    start, end, now = (
        -np.cos(2.0 * np.pi * (any_day - _LOWEST_SNOWLINE_DAY) / YEAR_DAYS) for any_day in (first, second, day)
    )
    confidence = float(np.clip((abs(end - start) - 0.1) / 0.3, 0.0, 1.0))
    if confidence == 0.0:
        return float(elapsed)
    return float((1.0 - confidence) * elapsed + confidence * np.clip((now - start) / (end - start), 0.0, 1.0))


def snow_transition(attributes: TerrainAttributes, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Compute when each point gains or loses snow between two dates.

    Parameters
    ----------
    attributes
        Height, normal and concavity of N points.
    first, second
        ``(N, 3)`` albedo on the two dates.

    Returns
    -------
    numpy.ndarray
        ``(N, 3)`` float32, input of `interpolate_albedo`: whether the point changes with the snow (1 or 0), and that
        factor times the start and the duration of its transition, both as fractions of the snow line's motion. Rows may
        be averaged over a pixel or footprint.
    """
    change = _snow_change(first, second)
    transition = np.zeros((len(change), 3), np.float32)
    if not change.any():
        return transition
    persistence = _features(attributes) @ _persistence_coefficients(attributes, (first, second), change)
    # Melting begins at the points of least persistence, snowfall at those of greatest.
    for sign in (-1, 1):
        points = np.flatnonzero(change == sign)
        if len(points) == 0:
            continue
        low, high = np.percentile(persistence[points], [3.0, 97.0])
        span = max(float(high - low), 1e-9)
        order = np.clip((persistence[points] - low) / span, 0.0, 1.0)
        duration = float(np.clip(_TRANSITION_LOGITS / span, _SHORTEST_TRANSITION, _LONGEST_TRANSITION))
        transition[points, 0] = 1.0
        transition[points, 1] = (order if sign < 0 else 1.0 - order) / (1.0 + duration)
        transition[points, 2] = duration / (1.0 + duration)
    return transition


def _snow_change(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Whether points ``(N,)`` gain snow (1), lose it (−1) or neither (0) between two dates."""
    change = second.mean(axis=1) - first.mean(axis=1)
    covered = np.minimum(snow_share(first), snow_share(second)) > _SNOW_COVERED
    return np.where((np.abs(change) > _SNOW_CHANGE) & ~covered, np.sign(change), 0.0).astype(np.int8)


def _features(attributes: TerrainAttributes) -> np.ndarray:
    return np.concatenate(
        [attributes.height_m[:, None] / 1000.0, attributes.normal, attributes.concavity_m[:, None] / 100.0], axis=1
    )


def _persistence_coefficients(
    attributes: TerrainAttributes, dated: tuple[np.ndarray, np.ndarray], change: np.ndarray
) -> np.ndarray:
    """Coefficients ``(5,)`` of snow persistence, in logits per feature.

    Logistic regression of snow cover on both dates at once, with common coefficients and one intercept per date
    (proportional odds, McCullagh 1980), by iteratively reweighted least squares with a weak Gaussian prior.
    """
    informative = np.flatnonzero((attributes.normal[:, 2] > _LEAST_UP) | (change != 0))
    informative = informative[:: max(1, len(informative) // _MOST_POINTS)]
    part = TerrainAttributes(
        attributes.height_m[informative], attributes.normal[informative], attributes.concavity_m[informative]
    )
    x = _features(part).astype(np.float64)
    x -= x.mean(axis=0)
    snowy = [
        np.where(change[informative] != 0, change[informative] == sign, snow_share(values[informative]) > 0.5)
        for sign, values in zip((-1, 1), dated, strict=True)
    ]
    y = np.concatenate(snowy).astype(np.float64)
    ones, none = np.ones((len(x), 1)), np.zeros((len(x), 1))
    design = np.concatenate([np.concatenate([x, ones, none], axis=1), np.concatenate([x, none, ones], axis=1)])
    prior = np.concatenate([_PRIOR_COEFFICIENTS, np.zeros(2)])
    precision = _PRIOR_WEIGHT * len(x) * np.diag(np.concatenate([np.maximum(x.var(axis=0), 1e-6), np.ones(2)]))
    coefficients = np.zeros(7)

    def objective(coefficients: np.ndarray) -> float:
        deviation, logit = coefficients - prior, design @ coefficients
        return float(np.sum(np.logaddexp(0.0, logit) - y * logit) + 0.5 * deviation @ precision @ deviation)

    for _ in range(40):
        p = 1.0 / (1.0 + np.exp(-np.clip(design @ coefficients, -40.0, 40.0)))
        gradient = design.T @ (y - p) - precision @ (coefficients - prior)
        step = np.linalg.solve(design.T @ ((p * (1.0 - p))[:, None] * design) + precision, gradient)
        # A Newton step may overshoot where most probabilities are close to 0 or 1; the objective is convex.
        current = objective(coefficients)
        while objective(coefficients + step) > current and np.abs(step).max() > 1e-4:
            step = 0.5 * step
        coefficients = coefficients + step
        if np.abs(step).max() < 1e-4:
            break
    return coefficients[:5].astype(np.float32)


def interpolate_albedo(
    dated: tuple[np.ndarray, np.ndarray], transition: np.ndarray, elapsed: float, snowline: float
) -> np.ndarray:
    """Interpolate the albedo of a day between two dates.

    Parameters
    ----------
    dated
        ``(..., 3)`` albedo on each of the two dates.
    transition
        ``(..., 3)`` from `snow_transition`.
    elapsed
        Elapsed fraction of the time between the dates; small changes follow it.
    snowline
        Position of the snow line between its heights on the two dates: `snowline_fraction`, or a value derived from a
        snow station or a picture of the day.

    Returns
    -------
    numpy.ndarray
        ``(..., 3)`` float32; one of the inputs itself where both fractions are 0 or both are 1.

    Raises
    ------
    ValueError
        If a fraction is outside [0, 1].
    """
    if not (0.0 <= elapsed <= 1.0 and 0.0 <= snowline <= 1.0):
        raise ValueError(
            f"interpolate_albedo: got fractions {elapsed} of the time and {snowline} of the snow line, expected 0 to 1"
        )
    first, second = dated
    if elapsed == snowline and elapsed in (0.0, 1.0):
        # Exact, unlike weighted sums.
        return second if elapsed else first
    factor, scale = np.clip(transition[..., 0], 0.0, 1.0), np.maximum(transition[..., 0], 1e-6)
    progress = np.clip((snowline - transition[..., 1] / scale) / np.maximum(transition[..., 2] / scale, 1e-6), 0.0, 1.0)
    weight = (factor * progress + (1.0 - factor) * elapsed)[..., None].astype(np.float32)
    return ((1.0 - weight) * first + weight * second).astype(np.float32)


def albedo_at(
    values: np.ndarray, days: Sequence[float] | np.ndarray, day: float, attributes: TerrainAttributes
) -> np.ndarray:
    """Interpolate dated albedos to a day of the year, with a moving snow line.

    Parameters
    ----------
    values
        ``(M, N, 3)`` albedo of N points on M dates.
    days
        ``(M,)`` days of the year of these dates; the year is cyclic.
    day
        Day of the year to interpolate at.
    attributes
        Height, normal and concavity of the N points.

    Returns
    -------
    numpy.ndarray
        ``(N, 3)``.

    Raises
    ------
    ValueError
        If there is no date, or the day is not finite.
    """
    if len(days) == 0 or not np.isfinite(day):
        raise ValueError(f"albedo_at: got {len(days)} dates and day {day}, expected at least one date and a finite day")
    first, second, elapsed = neighbouring_dates(days, day)
    if first == second:
        return values[first]
    pair = (values[first], values[second])
    return interpolate_albedo(
        pair, snow_transition(attributes, *pair), elapsed, snowline_fraction(days[first], days[second], day)
    )
