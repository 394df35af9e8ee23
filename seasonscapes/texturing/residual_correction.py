"""Completion with a base: a picture of the same land from elsewhere, corrected by what cameras saw.

An image from above with its light taken out is nearly the albedo of another day. What is learned is how the painted texels
differ from such a base, by relief: a small and smooth thing, so that land unlike any that was seen keeps the base's look
instead of that of the nearest thing in sight. Trees of large leaves do not learn the noise of single texels.

Painted texels are not taken as they are. Those that were seen badly (at grazing angles, from far off, in the shade) scatter
more about the corrected base than those that were seen well; each gives way to it as far as texels of its weight do. What
is left of the difference is carried a few texels into the holes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from seasonscapes.texturing.completion_error import ErrorModel, fit_error_model
from seasonscapes.texturing.predictors import Predictors
from seasonscapes.texturing.regression_fill import (
    BLOCK,
    FAST_SAMPLES,
    SAMPLES,
    fit_forest,
    folds_of,
    forest_mean_spread,
    propagate_residual,
    regression_fill,
)
from seasonscapes.texturing.texel_weights import fit_variance_by_weight

Progress = Callable[[float], None]
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
    """All texels of the surface by correcting a base; see `completion.complete` for arguments and result.

    Parameters
    ----------
    values, base
        Encoded colours ``(R, S, 3)``; a base that is not finite somewhere is first completed by what was painted.
    weight
        ``(R, S)``, 0 where not painted. Only its order counts.
    """
    tell = progress or (lambda share: None)
    painted = (weight > 0.0) & predictors.surface
    base = _whole(base, values, painted, predictors, fast=fast, seed=seed)
    rng = np.random.default_rng(seed)
    known = np.flatnonzero(painted)
    sample = np.sort(rng.choice(known, min(FAST_SAMPLES if fast else SAMPLES, len(known)), replace=False))
    predictor, encoded = _rows(predictors, base, sample), values.reshape(-1, 3)[sample].astype(np.float64)
    weights, trees = weight.ravel()[sample], 20 if fast else 40
    first = _fit(predictor, encoded, None, seed, trees=trees)
    share = fit_variance_by_weight(encoded - first(predictor)[0], weights).share(weights)
    forest = _fit(predictor, encoded, share, seed, trees=trees)
    scatter = fit_variance_by_weight(encoded - forest(predictor)[0], weights)
    tell(0.3)
    spread = _spread_of(predictors, painted, sample, (predictor, encoded, share), seed)
    tell(0.4)
    corrected, sigma = base.copy(), np.zeros(painted.shape, np.float32)
    wanted = np.flatnonzero(predictors.surface)
    for start in range(0, len(wanted), BLOCK):
        part = wanted[start : start + BLOCK]
        rows = _rows(predictors, base, part)
        colour, between = forest(rows)
        corrected.reshape(-1, 3)[part] = colour
        sigma.ravel()[part] = spread.sigma(rows, colour, between)
        tell(0.4 + 0.55 * min(1.0, (start + BLOCK) / len(wanted)))
    believed = np.where(painted, scatter.share(np.where(painted, weight, 1.0)), 0.0)[..., None]
    residual = (believed * (values - corrected)).astype(np.float32)
    return corrected + np.where(painted[..., None], residual, propagate_residual(residual, painted, predictors)), sigma


def _whole(base: np.ndarray, values: np.ndarray, painted: np.ndarray, predictors: Predictors, *, fast: bool, seed: int):
    """A base without gaps on the surface."""
    gap = predictors.surface & ~np.isfinite(base).all(axis=2)
    whole = np.where(np.isfinite(base), base, 0.0).astype(np.float32)
    if gap.any():
        learned, _ = regression_fill(values, painted, predictors, fast=fast, seed=seed)
        whole[gap] = learned[gap]
    return whole


def _rows(predictors: Predictors, base: np.ndarray, texel: np.ndarray) -> np.ndarray:
    """Guides and, last, the base ``(n, G + 3)`` of flat texels."""
    table = predictors.values.reshape(-1, predictors.values.shape[2])[texel]
    return np.concatenate([table, base.reshape(-1, 3)[texel]], axis=1)


def _fit(predictor: np.ndarray, encoded: np.ndarray, weight: np.ndarray | None, seed: int, *, trees: int) -> Callable:
    """A function from rows to encoded colours ``(n, 3)`` and the trees' spread ``(n,)``."""
    forest = fit_forest(predictor, encoded - predictor[:, -3:], seed, trees=trees, leaf=_LEAF, weight=weight)

    def predict(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        mean, between = forest_mean_spread(forest, rows)
        return rows[:, -3:] + mean, between

    return predict


def _spread_of(predictors: Predictors, painted: np.ndarray, sample: np.ndarray, known: tuple, seed: int) -> ErrorModel:
    predictor, encoded, share = known
    return fit_error_model(
        predictor,
        encoded,
        folds_of(sample, painted, predictors, seed),
        lambda rows: _fit(predictor[rows], encoded[rows], share[rows], seed, trees=10),
        seed=seed,
    )
