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


def share_unchanged(estimates: Sequence[AlbedoEstimate]) -> list[AlbedoEstimate]:
    """Replace texels that did not change between dates by their inverse-variance weighted mean.

    A texel is unchanged if it is measured on at least two dates and agrees with the mean within two standard deviations
    on all of them. Dates on which it was not measured receive the mean too, if the snow cover of their completed value
    equals that of the mean.

    Parameters
    ----------
    estimates
        Albedos of several dates.

    Returns
    -------
    list of AlbedoEstimate
        Albedos in the same order, with joint means and standard deviations.
    """
    if len(estimates) < 2:
        return list(estimates)
    values = np.stack([estimate.albedo for estimate in estimates])
    sigma = np.stack([estimate.sigma for estimate in estimates])
    measured = np.stack([estimate.source == 1 for estimate in estimates])
    weight = np.where(measured, 1.0 / np.maximum(sigma, 1e-4) ** 2, 0.0)
    total = weight.sum(axis=0)
    mean = (weight[..., None] * values).sum(axis=0) / np.maximum(total, 1e-12)[..., None]
    deviation = np.where(measured, np.abs(values[..., 1] - mean[..., 1]) / np.maximum(sigma, 1e-4), 0.0).max(axis=0)
    unchanged = (measured.sum(axis=0) >= 2) & (deviation < 2.0)
    joint_sigma = 1.0 / np.sqrt(np.maximum(total, 1e-12))
    result = []
    for estimate, was_measured in zip(estimates, measured, strict=True):
        same_snow = np.abs(snow_share(estimate.albedo) - snow_share(mean)) < 0.5
        use = unchanged & (was_measured | same_snow)
        result.append(
            replace(
                estimate,
                albedo=np.where(use[..., None], mean, estimate.albedo).astype(np.float32),
                sigma=np.where(use, joint_sigma, estimate.sigma).astype(np.float32),
                source=np.where(use, 1, estimate.source).astype(np.uint8),
            )
        )
    return result
