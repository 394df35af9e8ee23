"""Factor on a sky model's skylight that an image asks for: near texels in different light have about equal albedo."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

# Standard deviation of the logarithm of the sky factor before an image is seen. Neighbouring pairs err alike, and land
# that differs with its aspect (snow in the shade) misleads all of them: they never count as more than a few observations.
_SKY_SIGMA, _PAIRS_PER_INDEPENDENT, _MOST_INDEPENDENT = 0.2, 50.0, 25.0
# Distance of paired texels, across which land is about alike and shadow borders are past [texels].
_PAIR_TEXELS = 4
# The same across borders of cast shadows: images blur them, which brightens the shade beside them.
_ACROSS_TEXELS = 9
_LEAST_PAIRS = 500
# Standard deviation for the colour of the sky factor, which pairs across shadows tell well and the blue of a display image may exceed by far.
_SKY_COLOUR_SIGMA = 0.5
# A slope faces the sun with more than this share of the largest illuminance.
_FACING_SHARE = 0.2


def fitted_sky_factor(
    radiance: np.ndarray,
    sun: np.ndarray,
    visibility: np.ndarray,
    sky: np.ndarray,
    bounce: np.ndarray,
    chart: np.ndarray,
) -> np.ndarray:
    """Estimate the factor on skylight under which near texels in different light have most alike albedos.

    Its mean comes from all such pairs. Its colour comes from those across borders of cast shadows, where there are enough:
    land on both sides of them has the same colours, while land on different slopes may differ with its aspect.

    Parameters
    ----------
    radiance
        ``(R, S, 3)`` [cd/m²] that leaves the surface.
    sun, sky, bounce
        ``(R, S, 3)`` illuminance by the sun without cast shadows, by sky and by other terrain [lx].
    visibility
        ``(R, S)`` visibility of the sun.
    chart
        ``(R, S)`` integers as in `TexelIrradiance`; −1 where a texel is not to be used.

    Returns
    -------
    numpy.ndarray
        ``(3,)``; 1 where the image has too few pairs to tell.
    """
    sunlight = visibility[..., None] * sun
    ambient = (sky + bounce).mean(axis=2)
    total = np.log(np.maximum(sunlight.mean(axis=2) + ambient, 1e-3))
    share = sunlight.mean(axis=2) / np.exp(total)
    pairs = _pairs(
        chart, lambda one, other: (np.abs(total[one] - total[other]) > 0.3) & (np.abs(share[one] - share[other]) > 0.15)
    )
    if len(pairs) < _LEAST_PAIRS:
        return np.ones(3)
    factor = _sky_factor(pairs, (radiance, sunlight, sky, bounce), _SKY_SIGMA)
    # A texel that the sun would light well, and that is hidden from it, stands in a cast shadow.
    facing = sun.mean(axis=2) > _FACING_SHARE * sun.mean(axis=2).max()
    side = np.where(facing & (visibility > 0.95), 1.0, np.where(facing & (visibility < 0.05), 0.0, np.nan))
    pairs = _pairs(chart, lambda one, other: np.abs(side[one] - side[other]) == 1.0, apart=_ACROSS_TEXELS)
    if len(pairs) < _LEAST_PAIRS:
        return factor
    across = _sky_factor(pairs, (radiance, sunlight, sky, bounce), _SKY_COLOUR_SIGMA)
    return across * np.exp(np.mean(np.log(factor) - np.log(across)))


def _sky_factor(pairs: np.ndarray, textures: tuple[np.ndarray, ...], sigma: float) -> np.ndarray:
    """Factor ``(3,)`` of least robust cost over pairs of texels ``(N, 2)``, beside its prior of a standard deviation.

    ``textures`` are radiance, sunlight, skylight and light from other terrain, ``(R, S, 3)`` each.
    """
    one, other = pairs.T
    trials = np.linspace(-1.5, 1.5, 61)
    independent = min(len(pairs) / _PAIRS_PER_INDEPENDENT, _MOST_INDEPENDENT)
    result = np.ones(3)
    for channel in range(3):
        # At the texels of the pairs alone, which are far fewer than all.
        ends = [[texture[..., channel].ravel()[end].astype(np.float64) for texture in textures] for end in (one, other)]
        contrast = np.log(np.maximum(ends[0][0], 1e-3) / np.maximum(ends[1][0], 1e-3))
        residuals = []
        for trial in trials:
            first, second = (
                np.maximum(direct + np.exp(trial) * from_sky + rest, 1e-3) for _, direct, from_sky, rest in ends
            )
            residuals.append(contrast - np.log(first / second))
        spread = max(1.4826 * float(np.median(np.abs(residuals[len(trials) // 2]))), 0.05)
        cost = [
            independent * float(np.mean(np.log1p((residual / (2.385 * spread)) ** 2))) * 0.5 * 2.385**2
            + 0.5 * (trial / sigma) ** 2
            for trial, residual in zip(trials, residuals, strict=True)
        ]
        best = int(np.clip(np.argmin(cost), 1, len(trials) - 2))
        curve = np.polyfit(trials[best - 1 : best + 2], cost[best - 1 : best + 2], 2)
        result[channel] = np.exp(np.clip(-0.5 * curve[1] / curve[0], trials[0], trials[-1]))
    return result


def _pairs(
    chart: np.ndarray,
    chosen: Callable[[tuple[slice, slice], tuple[slice, slice]], np.ndarray],
    *,
    apart: int = _PAIR_TEXELS,
    most: int = 40_000,
) -> np.ndarray:
    """Flat indices ``(N, 2)`` of texels so many apart in the same chart, of which ``chosen`` (by their slices) is true."""
    index = np.arange(chart.size).reshape(chart.shape)
    found = []
    whole, ahead, behind = slice(None), slice(None, -apart), slice(apart, None)
    for one, other in (((whole, ahead), (whole, behind)), ((ahead, whole), (behind, whole))):
        keep = (chart[one] >= 0) & (chart[one] == chart[other]) & chosen(one, other)
        found.append(np.stack([index[one][keep], index[other][keep]], axis=1))
    pairs = np.concatenate(found)
    if len(pairs) > most:
        pairs = pairs[np.random.default_rng(0).choice(len(pairs), most, replace=False)]
    return pairs
