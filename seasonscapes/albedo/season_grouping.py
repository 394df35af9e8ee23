"""Grouping of dated albedos by season, and averaging of texels that do not change between the dates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import date

import numpy as np

from seasonscapes.albedo.seasons import day_number, snow_share
from seasonscapes.albedo.standard_error import AlbedoEstimate

# Two dates belong to one season if the fraction of texels whose snow changed is below the first limit, and the fraction
# whose colour changed is below the second.
_SNOW_CHANGED, _COLOUR_CHANGED = 0.04, 0.12


def group_dates(days: Sequence[date], known: Sequence[AlbedoEstimate]) -> list[list[int]]:
    """Group dates that are consecutive in the year and have the same snow cover and colours.

    Only texels measured on both of two dates are compared.

    Parameters
    ----------
    days
        Dates, in any order and of any years.
    known
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
        if _same_season(known[groups[-1][-1]], known[index]):
            groups[-1].append(index)
        else:
            groups.append([index])
    # The year is cyclic: a season may contain December and January.
    if len(groups) > 1 and _same_season(known[groups[-1][-1]], known[groups[0][0]]):
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


def share_unchanged(dated: Sequence[AlbedoEstimate]) -> list[AlbedoEstimate]:
    """Replace texels that did not change between dates by their inverse-variance weighted mean.

    A texel is unchanged if it is measured on at least two dates and agrees with the mean within two standard deviations
    on all of them. Dates on which it was not measured receive the mean too, if the snow cover of their completed value
    equals that of the mean.

    Parameters
    ----------
    dated
        Albedos of several dates.

    Returns
    -------
    list of AlbedoEstimate
        Albedos in the same order, with joint means and standard deviations.
    """
    if len(dated) < 2:
        return list(dated)
    values = np.stack([known.albedo for known in dated])
    sigma = np.stack([known.sigma for known in dated])
    measured = np.stack([known.source == 1 for known in dated])
    weight = np.where(measured, 1.0 / np.maximum(sigma, 1e-4) ** 2, 0.0)
    total = weight.sum(axis=0)
    mean = (weight[..., None] * values).sum(axis=0) / np.maximum(total, 1e-12)[..., None]
    deviation = np.where(measured, np.abs(values[..., 1] - mean[..., 1]) / np.maximum(sigma, 1e-4), 0.0).max(axis=0)
    unchanged = (measured.sum(axis=0) >= 2) & (deviation < 2.0)
    joint_sigma = 1.0 / np.sqrt(np.maximum(total, 1e-12))
    result = []
    for known, was_measured in zip(dated, measured, strict=True):
        same_snow = np.abs(snow_share(known.albedo) - snow_share(mean)) < 0.5
        use = unchanged & (was_measured | same_snow)
        result.append(
            replace(
                known,
                albedo=np.where(use[..., None], mean, known.albedo).astype(np.float32),
                sigma=np.where(use, joint_sigma, known.sigma).astype(np.float32),
                source=np.where(use, 1, known.source).astype(np.uint8),
            )
        )
    return result
