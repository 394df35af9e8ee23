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


def group_dates(days: Sequence[date], estimates: Sequence[AlbedoEstimate]) -> list[list[int]]:
    """Group dates that are consecutive in the year and have the same snow cover and colours.

    Only texels measured on both of two dates are compared.

    Parameters
    ----------
    days
        Dates, in any order and of any years.
    estimates
        Albedo of each date.

    Returns
    -------
    list of list of int
        Indices of the dates of each season.
    """
    if not days:
        return []
    order = sorted(range(len(days)), key=lambda i: day_number(days[i]))
    groups = [[order[0]]]
    for index in order[1:]:
        if _same_season(estimates[groups[-1][-1]], estimates[index]):
            groups[-1].append(index)
        else:
            groups.append([index])
    # The year is cyclic: a season may contain December and January.
    if len(groups) > 1 and _same_season(estimates[groups[-1][-1]], estimates[groups[0][0]]):
        groups[0] = groups.pop() + groups[0]
    return groups


def _same_season(a: AlbedoEstimate, b: AlbedoEstimate) -> bool:
    both = (a.source == 1) & (b.source == 1)
    if both.sum() < 20:
        return False
    snow = np.abs(snow_share(a.albedo[both]) - snow_share(b.albedo[both])) > 0.5
    tolerance = 3.0 * np.hypot(a.sigma[both], b.sigma[both]) + 0.10 * a.albedo[both][:, 1]
    colour = np.abs(a.albedo[both][:, 1] - b.albedo[both][:, 1]) > tolerance
    return bool(snow.mean() < _SNOW_CHANGED and colour.mean() < _COLOUR_CHANGED)
