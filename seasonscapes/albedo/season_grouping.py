"""Grouping of dated albedos by season."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import date

import numpy as np

from seasonscapes.albedo.seasons import day_number, snow_share
from seasonscapes.albedo.standard_error import AlbedoEstimate

# Two dates belong to one season if the fraction of texels whose snow changed is below the first limit, and the fraction
# whose colour changed is below the second.
_SNOW_CHANGED, _COLOUR_CHANGED = 0.04, 0.12


def group_dates(
    days: Sequence[date], estimates: Sequence[AlbedoEstimate], scale_sigma: Sequence[float] | None = None
) -> list[list[int]]:
    """Group dates that are consecutive in the year and have the same snow cover and colours.

    Only texels measured on both of two dates are compared.

    Parameters
    ----------
    days
        Dates, in any order and of any years.
    estimates
        Albedo of each date.
    scale_sigma
        Relative standard deviation of each date's scale, a factor that all its texels share; 0 if ``None``.

    Returns
    -------
    list of list of int
        Indices of the dates of each season.
    """
    if not days:
        return []
    sigma = [0.0] * len(days) if scale_sigma is None else scale_sigma

    def same(i: int, j: int) -> bool:
        return _same_season(estimates[i], estimates[j], float(np.hypot(sigma[i], sigma[j])))

    order = sorted(range(len(days)), key=lambda i: day_number(days[i]))
    groups = [[order[0]]]
    for index in order[1:]:
        if same(groups[-1][-1], index):
            groups[-1].append(index)
        else:
            groups.append([index])
    # The year is cyclic: a season may contain December and January.
    if len(groups) > 1 and same(groups[-1][-1], groups[0][0]):
        groups[0] = groups.pop() + groups[0]
    return groups


def _same_season(a: AlbedoEstimate, b: AlbedoEstimate, scale_sigma: float) -> bool:
    both = (a.source == 1) & (b.source == 1)
    if both.sum() < 20:
        return False
    first, second = a.albedo[both], b.albedo[both]
    # What an unknown scale explains is no change of season: up to twice its standard deviation the two are made equal.
    ratio = np.log(np.median(first[:, 1] / np.maximum(second[:, 1], 1e-4)))
    scale = float(np.exp(np.clip(ratio, -2.0 * scale_sigma, 2.0 * scale_sigma)))
    second, second_sigma = scale * second, scale * b.sigma[both]
    snow = np.abs(snow_share(first) - snow_share(second)) > 0.5
    tolerance = 3.0 * np.hypot(a.sigma[both], second_sigma) + 0.10 * first[:, 1]
    colour = np.abs(first[:, 1] - second[:, 1]) > tolerance
    return bool(snow.mean() < _SNOW_CHANGED and colour.mean() < _COLOUR_CHANGED)
