"""Albedos recovered from photographs of several dates: which of them share a season, and what does not change between them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from datetime import date

import numpy as np

from seasonscapes.albedo.seasons import day_number, snow_share
from seasonscapes.albedo.standard_error import KnownAlbedo

# Two dates belong to one season where fewer texels than this changed their snow, and fewer than that their colour.
_SNOW_CHANGED, _COLOUR_CHANGED = 0.04, 0.12


def group_dates(days: Sequence[date], known: Sequence[KnownAlbedo]) -> list[list[int]]:
    """Dates that share a season, as lists of indices: consecutive in the year, with the same snow and the same colours.

    Only texels measured on both dates are compared.
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
    # The year is a circle: December may go on in January.
    if len(groups) > 1 and _same_season(known[groups[-1][-1]], known[groups[0][0]]):
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


def share_unchanged(dated: Sequence[KnownAlbedo]) -> list[KnownAlbedo]:
    """Albedos of several dates with what did not change between them shared: its evidence is joined.

    A texel measured on several dates, on all of which it agrees within twice its standard deviation, gets one mean
    everywhere, weighted by information; and dates on which it was not measured get it where all others agree and the snow
    that the completion expects is the same.
    """
    if len(dated) < 2:
        return list(dated)
    values = np.stack([one.albedo for one in dated])
    sigma = np.stack([one.sigma for one in dated])
    measured = np.stack([one.source == 1 for one in dated])
    weight = np.where(measured, 1.0 / np.maximum(sigma, 1e-4) ** 2, 0.0)
    total = weight.sum(axis=0)
    mean = (weight[..., None] * values).sum(axis=0) / np.maximum(total, 1e-12)[..., None]
    apart = np.where(measured, np.abs(values[..., 1] - mean[..., 1]) / np.maximum(sigma, 1e-4), 0.0).max(axis=0)
    static = (measured.sum(axis=0) >= 2) & (apart < 2.0)
    joined_sigma = 1.0 / np.sqrt(np.maximum(total, 1e-12))
    result = []
    for one, was in zip(dated, measured, strict=True):
        same_snow = np.abs(snow_share(one.albedo) - snow_share(mean)) < 0.5
        use = static & (was | same_snow)
        result.append(
            replace(
                one,
                albedo=np.where(use[..., None], mean, one.albedo).astype(np.float32),
                sigma=np.where(use, joined_sigma, one.sigma).astype(np.float32),
                source=np.where(use, 1, one.source).astype(np.uint8),
            )
        )
    return result
