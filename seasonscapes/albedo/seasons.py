"""Dated albedo: which photographs share a season, what snow is, and how a snow line moves between dates.

A cross-fade between a bare and a snowy date makes the whole mountain half white. In truth the line moves: each place turns
at its own day. So the line's height at both dates is fitted (it depends on aspect), each texel is given the height at which
it would be crossed, and on a day between a texel is white or bare by where the line stands then.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import date

import numpy as np

from seasonscapes.albedo.closed_form import HIGHEST
from seasonscapes.albedo.forward import Land
from seasonscapes.albedo.uncertainty import KnownAlbedo

# Snow is bright in blue as in red; rock, soil and leaves are not. Shares between these values of the test are mixtures.
_SNOW_DARKEST, _SNOW_BRIGHTEST = 0.32, 0.60
# Two dates belong to one season where fewer texels than this changed their snow, and fewer than that their colour.
_SNOW_CHANGED, _COLOUR_CHANGED = 0.04, 0.12
_YEAR_DAYS = 365.2422


def snow_share(albedo: np.ndarray) -> np.ndarray:
    """Share of snow ``(...)`` in [0, 1] that an albedo ``(..., 3)`` looks like.

    The least of blue and red decides: bare ground of the visible is darker in blue than in red and never bright in it, and
    glacier ice is darker in red.
    """
    albedo = np.asarray(albedo, np.float32)
    least = np.minimum(albedo[..., 2], albedo[..., 0])
    return np.clip((least - _SNOW_DARKEST) / (_SNOW_BRIGHTEST - _SNOW_DARKEST), 0.0, 1.0)


@dataclass(frozen=True)
class DatedAlbedo:
    """The albedo of a date."""

    day: date
    known: KnownAlbedo


def group_dates(dated: Sequence[DatedAlbedo]) -> list[list[int]]:
    """Dates that share a season, as lists of indices: consecutive in the year, with the same snow and the same colours.

    Only texels measured on both dates are compared.
    """
    if not dated:
        return []
    order = sorted(range(len(dated)), key=lambda i: dated[i].day.timetuple().tm_yday)
    groups = [[order[0]]]
    for index in order[1:]:
        if _same_season(dated[groups[-1][-1]].known, dated[index].known):
            groups[-1].append(index)
        else:
            groups.append([index])
    # The year is a circle: December may go on in January.
    if len(groups) > 1 and _same_season(dated[groups[-1][-1]].known, dated[groups[0][0]].known):
        groups[0] = groups.pop() + groups[0]
    return groups


def _same_season(a: KnownAlbedo, b: KnownAlbedo) -> bool:
    both = (a.source == 1) & (b.source == 1)
    if both.sum() < 20:
        return False
    snow = np.abs(snow_share(a.albedo[both]) - snow_share(b.albedo[both])) > 0.5
    tolerance = 3.0 * np.hypot(a.sigma[both], b.sigma[both]) + 0.10 * a.albedo[both][:, 1]
    colour = np.abs(a.albedo[both][:, 1] - b.albedo[both][:, 1]) > tolerance
    return bool(snow.mean() < _SNOW_CHANGED and colour.mean() < _COLOUR_CHANGED)


def share_static(dated: Sequence[DatedAlbedo]) -> list[DatedAlbedo]:
    """Albedos of several dates with what did not change between them shared: its evidence is joined.

    A texel measured on several dates, on all of which it agrees within twice its standard deviation, gets one mean
    everywhere, weighted by information; and dates on which it was not measured get it where all others agree and the snow
    that the completion expects is the same.
    """
    from dataclasses import replace

    if len(dated) < 2:
        return list(dated)
    values = np.stack([one.known.albedo for one in dated])
    sigma = np.stack([one.known.sigma for one in dated])
    measured = np.stack([one.known.source == 1 for one in dated])
    weight = np.where(measured, 1.0 / np.maximum(sigma, 1e-4) ** 2, 0.0)
    total = weight.sum(axis=0)
    mean = (weight[..., None] * values).sum(axis=0) / np.maximum(total, 1e-12)[..., None]
    apart = np.where(measured, np.abs(values[..., 1] - mean[..., 1]) / np.maximum(sigma, 1e-4), 0.0).max(axis=0)
    static = (measured.sum(axis=0) >= 2) & (apart < 2.0)
    joined_sigma = 1.0 / np.sqrt(np.maximum(total, 1e-12))
    result = []
    for one, was in zip(dated, measured, strict=True):
        same_snow = np.abs(snow_share(one.known.albedo) - snow_share(mean)) < 0.5
        use = static & (was | same_snow)
        known = replace(one.known, albedo=np.where(use[..., None], mean, one.known.albedo).astype(np.float32),
                        sigma=np.where(use, joined_sigma, one.known.sigma).astype(np.float32),
                        source=np.where(use, 1, one.known.source).astype(np.uint8))  # fmt: skip
        result.append(replace(one, known=known))
    return result


@dataclass(frozen=True)
class SnowLine:
    """Where snow begins: at ``height_m + by_north_m · northness + by_slope_m · sin(slope)``, within ``width_m``.

    ``rms`` is what the share of snow differs by from this. A date without snow has a line above the terrain, one that is
    white all over a line below it.
    """

    height_m: float
    by_north_m: float
    by_slope_m: float
    width_m: float
    rms: float


def fit_snow_line(height_m: np.ndarray, normal: np.ndarray, snow: np.ndarray) -> SnowLine:
    """The snow line of texels ``(N,)`` with unit normals ``(N, 3)`` and snow shares ``(N,)``, by logistic regression.

    Iteratively re-weighted least squares with a weak pull on the terms of aspect and slope.
    """
    low, high = float(height_m.min()), float(height_m.max())
    share = float(snow.mean())
    if share < 0.01 or share > 0.99:
        edge = high + 500.0 if share < 0.5 else low - 500.0
        return SnowLine(edge, 0.0, 0.0, 50.0, float(np.sqrt(np.mean((snow - (share > 0.5)) ** 2))))
    unit = 200.0
    x = np.stack([np.ones(len(snow)), (height_m - height_m.mean()) / unit, normal[:, 1], _sine(normal)], axis=1)
    beta = np.array([np.log(share / (1.0 - share)), 1.0, 0.0, 0.0])
    pull = np.diag([0.0, 0.01, 1.0, 1.0]) * len(snow) * 1e-3
    for _ in range(30):
        p = _logistic(x @ beta)
        w = np.maximum(p * (1.0 - p), 1e-4)
        step = np.linalg.solve(x.T @ (w[:, None] * x) + pull, x.T @ (snow - p) - pull @ beta)
        beta = beta + np.clip(step, -2.0, 2.0)
        if np.abs(step).max() < 1e-6:
            break
    rise = max(beta[1], 0.05) / unit
    p = _logistic(x @ beta)
    return SnowLine(float(height_m.mean() - beta[0] / rise), float(-beta[2] / rise), float(-beta[3] / rise),
                    float(1.0 / rise), float(np.sqrt(np.mean((snow - p) ** 2))))  # fmt: skip


def _sine(normal: np.ndarray) -> np.ndarray:
    return np.sqrt(np.maximum(1.0 - normal[:, 2] ** 2, 0.0))


@dataclass(frozen=True)
class SeasonPair:
    """Two dated albedos ready for any day between them, over the N texels of a `Land`.

    Parameters
    ----------
    first, second
        The dates.
    values
        ``(2, N, 3)`` their albedos.
    bare, white
        ``(2, N, 3)`` each date's albedo of the texel without and with snow.
    snow
        ``(2, N)`` share of snow on each date.
    above_m
        ``(2, N)`` height of each texel above the line of each date [m].
    width_m
        Of the belt in which each date's snow thins out [m].
    """

    first: date
    second: date
    values: np.ndarray
    bare: np.ndarray
    white: np.ndarray
    snow: np.ndarray
    above_m: np.ndarray
    width_m: tuple[float, float]


def prepare_pair(land: Land, first: DatedAlbedo, second: DatedAlbedo) -> SeasonPair:
    """What is needed to tell the albedo of days between two dates."""
    values = np.stack([one.known.albedo.reshape(-1, 3)[land.texel] for one in (first, second)])
    snow = np.stack([snow_share(v) for v in values])
    height, normal = land.position_m[:, 2], land.normal
    lines = [fit_snow_line(height, normal, s) for s in snow]
    bare, white = _bare_and_white(list(values), snow, height)
    above = [
        height - line.height_m - line.by_north_m * normal[:, 1] - line.by_slope_m * _sine(normal) for line in lines
    ]
    width = (lines[0].width_m, lines[1].width_m)
    above = np.stack(above) + _own_offset_m(np.stack(above), snow, width)
    return SeasonPair(first.day, second.day, values, bare, white, snow, above.astype(np.float32), width)


def _own_offset_m(above_m: np.ndarray, snow: np.ndarray, width_m: tuple[float, float]) -> np.ndarray:
    """By how much each texel ``(N,)`` lies higher for the snow than its height says (hollows, sheltered slopes) [m].

    The least offset under which the line explains the snow that the texel had on both dates.
    """
    low, high = np.full(snow.shape, -np.inf), np.full(snow.shape, np.inf)
    for k in (0, 1):
        logit = np.log(np.clip(snow[k], 0.02, 0.98) / (1.0 - np.clip(snow[k], 0.02, 0.98)))
        exact = width_m[k] * logit - above_m[k]
        low[k] = np.where(snow[k] > 0.1, np.where(snow[k] > 0.9, 2.0 * width_m[k] - above_m[k], exact), -np.inf)
        high[k] = np.where(snow[k] < 0.9, np.where(snow[k] < 0.1, -2.0 * width_m[k] - above_m[k], exact), np.inf)
    least, most = low.max(axis=0), high.min(axis=0)
    torn = least > most
    middle = 0.5 * (np.where(torn, least, 0.0) + np.where(torn, most, 0.0))
    return np.where(torn, middle, np.clip(0.0, least, np.maximum(least, most)))


def _bare_and_white(values: list[np.ndarray], snow: np.ndarray, height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Albedo without and with snow of each texel on each date; what a date does not show comes from the other one, else
    from the date's own texels of like height."""
    bare, white = (np.empty((2, len(height), 3), np.float32) for _ in range(2))
    for own, other in ((0, 1), (1, 0)):
        for result, is_it in ((bare, snow < 0.3), (white, snow > 0.7)):
            typical = _typical(values[own], is_it[own], values[other], is_it[other])
            result[own] = np.where(is_it[own][:, None], values[own],
                                   np.where(is_it[other][:, None], values[other], typical))  # fmt: skip
    return bare, white


def _typical(own: np.ndarray, own_is: np.ndarray, other: np.ndarray, other_is: np.ndarray) -> np.ndarray:
    for values, kind in ((own, own_is), (other, other_is)):
        if kind.any():
            return np.median(values[kind], axis=0)
    return np.median(own, axis=0)


def albedo_between(land: Land, pair: SeasonPair, day: date, *, line_share: float | None = None) -> np.ndarray:
    """The albedo texture ``(R, S, 3)`` of a day between a pair's dates.

    Bare ground and snow each change evenly (leaves turn, snow ages); which of the two shows is decided by the snow line.

    Parameters
    ----------
    line_share
        How much of its way from the first date's height to the second's the line has gone on that day, where it is known
        (from a snow station, or a picture); left out, as much as of the time has passed.

    Raises
    ------
    ValueError
        For a day that is not between the dates.
    """
    way = _way(pair.first, pair.second, day)
    texture = np.zeros((land.shape[0] * land.shape[1], 3), np.float32)
    # What the model of two colours and a line does not explain of each date fades over.
    rest = [pair.values[k] - _clothed(pair, float(k), float(k)) for k in (0, 1)]
    line = way if line_share is None else float(np.clip(line_share, 0.0, 1.0))
    texture[land.texel] = _clothed(pair, way, line) + (1.0 - way) * rest[0] + way * rest[1]
    return np.clip(texture, 0.0, HIGHEST).reshape(*land.shape, 3)


def _clothed(pair: SeasonPair, way: float, line: float) -> np.ndarray:
    """Albedo ``(N, 3)`` of ground and snow after a share ``way`` of the time, the line a share ``line`` of its way on."""
    ground = (1.0 - way) * pair.bare[0] + way * pair.bare[1]
    snowy = (1.0 - way) * pair.white[0] + way * pair.white[1]
    ends = [_logistic(above / width) for above, width in zip(pair.above_m, pair.width_m, strict=True)]
    above = (1.0 - line) * pair.above_m[0] + line * pair.above_m[1]
    modelled = _logistic(above / ((1.0 - line) * pair.width_m[0] + line * pair.width_m[1]))
    apart = [pair.snow[k] - ends[k] for k in (0, 1)]
    snow = np.clip(modelled + (1.0 - line) * apart[0] + line * apart[1], 0.0, 1.0)
    return ground + snow[:, None] * (snowy - ground)


def _logistic(x: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-np.clip(x, -40.0, 40.0)))


def _way(first: date, second: date, day: date) -> float:
    start, span = _turn(first), (_turn(second) - _turn(first)) % _YEAR_DAYS
    done = (_turn(day) - start) % _YEAR_DAYS
    if span == 0.0 or done > span + 1e-9:
        raise ValueError(f"albedo_between: {day} is not between {first} and {second}")
    return float(done / span)


def _turn(day: date) -> float:
    return float(day.timetuple().tm_yday - 1)


def albedo_of_day(land: Land, dated: Sequence[DatedAlbedo], day: date) -> np.ndarray:
    """The albedo texture ``(R, S, 3)`` of any day from dated ones: between its two neighbours in the circle of the year."""
    if not dated:
        raise ValueError("albedo_of_day: no dated albedo")
    after = min(dated, key=lambda one: (_turn(one.day) - _turn(day)) % _YEAR_DAYS)
    before = min(dated, key=lambda one: (_turn(day) - _turn(one.day)) % _YEAR_DAYS)
    if after is before:
        return after.known.albedo
    return albedo_between(land, prepare_pair(land, before, after), day)
