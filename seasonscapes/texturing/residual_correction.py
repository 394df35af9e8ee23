"""Completion with a base texture, corrected by a regression of the residuals of painted texels.

The base is an image of the same terrain from another source: an orthophoto without its illumination is close to the
albedo of another day. The regression predicts the difference between painted texels and base from terrain attributes.
This difference is small and smooth, so that terrain unlike any painted texel keeps the colour of the base. Large leaves
keep the trees from fitting the noise of single texels.

Painted texels observed at grazing incidence, from far away or in shade scatter more about the corrected base than
others. Each painted texel is shrunk towards the corrected base by the empirical variance of texels of equal weight. The
remaining residual is propagated a few texels into the holes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from seasonscapes.texturing.colour_regression import fit_forest, forest_mean_spread
from seasonscapes.texturing.completion_error import Predict, fit_error_model
from seasonscapes.texturing.predictors import Predictors
from seasonscapes.texturing.regression_fill import (
    BLOCK,
    FAST_SAMPLES,
    SAMPLES,
    propagate_residual,
    regression_fill,
    texel_folds,
)
from seasonscapes.texturing.texel_weights import fit_variance_by_weight

Progress = Callable[[float], None]
# Least number of samples in a leaf.
_LEAF = 20


def corrected_fill(
    values: np.ndarray,
    weight: np.ndarray,
    base: np.ndarray,
    predictors: Predictors,
    *,
    fast: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Compute all texels of the surface by correcting a base texture.

    Parameters
    ----------
    values
        ``(R, S, 3)`` encoded colours (cube roots); ignored where not painted.
    weight
        ``(R, S)``, 0 where not painted. Only the order of weights matters.
    base
        ``(R, S, 3)`` encoded colours. Where not finite, it is first completed by `regression_fill`.
    predictors
        Of the same size.
    fast
        Use fewer training texels and trees.
    seed
        Equal seeds give equal results.
    progress
        Called with the finished fraction.

    Returns
    -------
    filled
        ``(R, S, 3)`` encoded colours.
    sigma
        ``(R, S)`` float32 standard error of the decoded corrected base on the surface.
    """
    report = progress or (lambda fraction: None)
    painted = (weight > 0.0) & predictors.surface
    base = _fill_gaps(base, values, painted, predictors, fast=fast, seed=seed)
    rng = np.random.default_rng(seed)
    known = np.flatnonzero(painted)
    sample = np.sort(rng.choice(known, min(FAST_SAMPLES if fast else SAMPLES, len(known)), replace=False))
    predictor, encoded = _with_base(predictors, base, sample), values.reshape(-1, 3)[sample].astype(np.float64)
    weights, trees = weight.ravel()[sample], 20 if fast else 40
    unweighted = _fit_correction(predictor, encoded, None, seed, trees=trees)
    shrinkage = fit_variance_by_weight(encoded - unweighted(predictor)[0], weights).shrinkage(weights)
    correction = _fit_correction(predictor, encoded, shrinkage, seed, trees=trees)
    variance = fit_variance_by_weight(encoded - correction(predictor)[0], weights)
    report(0.3)
    error_model = fit_error_model(
        predictor,
        encoded,
        texel_folds(sample, painted, predictors, seed),
        lambda rows: _fit_correction(predictor[rows], encoded[rows], shrinkage[rows], seed, trees=10),
        seed=seed,
    )
    report(0.4)
    corrected, sigma = base.copy(), np.zeros(painted.shape, np.float32)
    surface = np.flatnonzero(predictors.surface)
    for start in range(0, len(surface), BLOCK):
        part = surface[start : start + BLOCK]
        rows = _with_base(predictors, base, part)
        colour, spread = correction(rows)
        corrected.reshape(-1, 3)[part] = colour
        sigma.ravel()[part] = error_model.sigma(rows, colour, spread)
        report(0.4 + 0.55 * min(1.0, (start + BLOCK) / len(surface)))
    factor = np.where(painted, variance.shrinkage(np.where(painted, weight, 1.0)), 0.0)[..., None]
    residual = (factor * (values - corrected)).astype(np.float32)
    return corrected + np.where(painted[..., None], residual, propagate_residual(residual, painted, predictors)), sigma


def _fill_gaps(
    base: np.ndarray, values: np.ndarray, painted: np.ndarray, predictors: Predictors, *, fast: bool, seed: int
) -> np.ndarray:
    """The base with gaps on the surface completed from the painted texels."""
    gap = predictors.surface & ~np.isfinite(base).all(axis=2)
    filled = np.where(np.isfinite(base), base, 0.0).astype(np.float32)
    if gap.any():
        predicted, _ = regression_fill(values, painted, predictors, fast=fast, seed=seed)
        filled[gap] = predicted[gap]
    return filled


def _with_base(predictors: Predictors, base: np.ndarray, texel: np.ndarray) -> np.ndarray:
    """Predictors of flat texels with the base in the last three columns, ``(n, G + 3)``."""
    return np.concatenate([predictors.at(texel), base.reshape(-1, 3)[texel]], axis=1)


def _fit_correction(
    predictor: np.ndarray, encoded: np.ndarray, weight: np.ndarray | None, seed: int, *, trees: int
) -> Predict:
    """Fit the difference from the base; returns a function that predicts the corrected base and its spread."""
    forest = fit_forest(predictor, encoded - predictor[:, -3:], seed, trees=trees, leaf=_LEAF, weight=weight)

    def predict(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mean, spread = forest_mean_spread(forest, rows)
        return rows[:, -3:] + mean, spread

    return predict
