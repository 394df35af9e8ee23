"""Completion by regression: colour of unpainted texels from terrain attributes and imagery, trained on painted texels.

Tree ensembles on satellite colour, height, slope, aspect, curvature, sky view factor and sun predict the unpainted
texels. Where an image among the predictors (satellite, relit albedo) leaves the range of the training texels, a linear
term extrapolates: trees alone are constant there, so that unobserved snow would take the colour of the brightest
observed ground. The residual of the prediction at painted texels is then propagated a few texels into the holes, which
removes the seam.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from seasonscapes.texturing.colour_regression import Regression, fit_extrapolation, fit_forest, fit_regression, predict
from seasonscapes.texturing.completion_error import ErrorModel, Predict, fit_error_model, spatial_folds
from seasonscapes.texturing.predictors import Predictors
from seasonscapes.texturing.smooth_fill import propagate
from seasonscapes.texturing.tiled_predictors import WindowPredictors
from seasonscapes.texturing.top_down_grid import from_grid, to_grid

Progress = Callable[[float], None]

SAMPLES, FAST_SAMPLES = 40_000, 20_000
# Decay length of propagated residuals [texels].
REACH_PX = 12.0
# Texels predicted at once.
BLOCK = 200_000
# Prefixes of the names of predictors that are images of the terrain, to which its colour is nearly proportional.
IMAGES = ("satellite", "relit")


def regression_fill(
    values: np.ndarray,
    painted: np.ndarray,
    predictors: Predictors,
    *,
    fast: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Fill unpainted texels by regression and residual propagation.

    Parameters
    ----------
    values
        ``(R, S, 3)`` encoded colours (cube roots); ignored where not painted.
    painted
        ``(R, S)`` bool.
    predictors
        Of the same size.
    fast
        Use fewer training texels and randomised trees only.
    seed
        Equal seeds give equal results.
    progress
        Called with the finished fraction.

    Returns
    -------
    filled
        ``(R, S, 3)`` float32 encoded colours; painted texels are unchanged.
    sigma
        ``(R, S)`` float32 standard error of the decoded colours in the holes, 0 elsewhere.
    """
    report = progress or (lambda fraction: None)
    rng = np.random.default_rng(seed)
    known = np.flatnonzero(painted & predictors.surface)
    sample = rng.choice(known, min(FAST_SAMPLES if fast else SAMPLES, len(known)), replace=False)
    predictor = mask_imagery(predictors.at(sample), predictors, painted, rng)
    encoded = values.reshape(-1, 3)[sample].astype(np.float64)
    fold = texel_folds(sample, painted, predictors, seed)
    fitted = fit_completion(
        predictor, encoded, predictors.names, fold, fast=fast, seed=seed, progress=lambda done: report(0.35 * done)
    )
    hole = predictors.surface & ~painted
    rim = rim_of(hole, painted & predictors.surface, predictors)
    return completion_of(fitted, values, hole, rim, predictors, progress=lambda done: report(0.35 + 0.6 * done))


@dataclass(frozen=True)
class FittedCompletion:
    """A regression with the model of its error, fitted to painted texels."""

    regression: Regression
    error_model: ErrorModel


def fit_completion(
    predictor: np.ndarray,
    encoded: np.ndarray,
    names: Sequence[str],
    fold: np.ndarray,
    *,
    fast: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> FittedCompletion:
    """Fit a regression and the model of its error to a sample of painted texels.

    Parameters
    ----------
    predictor
        ``(n, G)``, NaN where unknown.
    encoded
        ``(n, 3)`` float64 colours, cube roots.
    names
        Of the G predictors.
    fold
        ``(n,)`` from `texel_folds`.
    fast, seed, progress
        As in `regression_fill`.
    """
    report = progress or (lambda fraction: None)
    images = np.array([name.startswith(IMAGES) for name in names])
    regression = fit_regression(predictor, encoded, images, fast=fast, seed=seed)
    report(0.6)
    error_model = _fit_error(predictor, encoded, images, fold, seed)
    report(1.0)
    return FittedCompletion(regression, error_model)


def completion_of(
    fitted: FittedCompletion,
    values: np.ndarray,
    hole: np.ndarray,
    rim: np.ndarray,
    predictors: Predictors | WindowPredictors,
    *,
    progress: Progress | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Fill texels by a fitted regression, and propagate its residual at painted texels into them.

    Parameters
    ----------
    fitted
        From `fit_completion`.
    values, predictors, progress
        As in `regression_fill`.
    hole
        ``(R, S)`` bool: texels to fill.
    rim
        ``(R, S)`` bool: painted texels whose residual is propagated, from `rim_of`.

    Returns
    -------
    filled, sigma
        As `regression_fill`.
    """
    report = progress or (lambda fraction: None)
    filled, residual = values.astype(np.float32), np.zeros(values.shape, np.float32)
    sigma = np.zeros(hole.shape, np.float32)
    colours, residuals = filled.reshape(-1, 3), residual.reshape(-1, 3)
    target = np.flatnonzero(hole | rim)
    for start in range(0, len(target), BLOCK):
        part = target[start : start + BLOCK]
        rows = predictors.at(part)
        colour, spread = predict(fitted.regression, rows)
        wanted = hole.ravel()[part]
        open_, seen = part[wanted], part[~wanted]
        residuals[seen] = colours[seen] - colour[~wanted]
        colours[open_] = colour[wanted]
        sigma.ravel()[open_] = fitted.error_model.sigma(rows[wanted], colour[wanted], spread[wanted])
        report(min(1.0, (start + BLOCK) / len(target)))
    spread_residual = propagate_residual(residual, rim, predictors)
    texel = np.flatnonzero(hole)
    colours[texel] += spread_residual.reshape(-1, 3)[texel]
    return filled, sigma


def mask_imagery(
    predictor: np.ndarray, predictors: Predictors, painted: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Remove satellite colours from training texels at random, so that the trees learn to predict without them.

    As many training texels lack an image afterwards as unpainted texels do, but at most half.

    Parameters
    ----------
    predictor
        ``(n, G)`` of the training texels.
    predictors
        Of all texels.
    painted
        ``(R, S)`` bool.
    rng
        Random generator.

    Returns
    -------
    ndarray
        ``(n, G)`` with NaN where removed.
    """
    image = np.array([name.startswith("satellite") for name in predictors.names])
    if not image.any():
        return predictor
    finite = np.isfinite(predictors.values[..., image][predictors.surface & ~painted])
    missing = np.asarray(~finite.all(axis=1))
    return without_images(predictor, image, float(missing.mean()) if len(missing) else 0.0, rng)


def without_images(
    predictor: np.ndarray, image: np.ndarray, missing_share: float, rng: np.random.Generator
) -> np.ndarray:
    """Remove images from training texels at random, until a share of them (at most half) has none; see `mask_imagery`.

    Parameters
    ----------
    predictor
        ``(n, G)`` of the training texels.
    image
        ``(G,)`` bool: predictors that are images which may be missing.
    missing_share
        Share of the unpainted texels without an image.
    rng
        Random generator.
    """
    training_missing = ~np.isfinite(predictor[:, image]).all(axis=1)
    # The border of the image is not random: texels without it are rare among painted texels and frequent in the holes.
    extra = min(0.5, missing_share) - float(training_missing.mean())
    if extra <= 0.0:
        return predictor
    removed = rng.random(len(predictor)) < extra
    return np.where(removed[:, None] & image, np.float32(np.nan), predictor)


def _fit_error(
    predictor: np.ndarray, encoded: np.ndarray, images: np.ndarray, fold: np.ndarray, seed: int
) -> ErrorModel:
    def fit(rows: np.ndarray) -> Predict:
        extrapolation = fit_extrapolation(predictor[rows], encoded[rows], images)
        remainder = encoded[rows] - extrapolation(predictor[rows])
        regression = Regression(extrapolation, None, fit_forest(predictor[rows], remainder, seed, trees=10))
        return lambda other: predict(regression, other)

    return fit_error_model(predictor, encoded, fold, fit, seed=seed)


def texel_folds(texel: np.ndarray, painted: np.ndarray, predictors: Predictors, seed: int) -> np.ndarray:
    """Assign texels to spatial cross-validation folds by their position on the terrain; see `spatial_folds`.

    Parameters
    ----------
    texel
        ``(n,)`` flat indices.
    painted
        ``(R, S)`` bool.
    predictors
        Surface and, with several charts, the top-down grid.
    seed
        As in `spatial_folds`.

    Returns
    -------
    ndarray
        ``(n,)`` fold number.
    """
    row, column = np.unravel_index(texel, painted.shape)
    position = np.stack([column, row], -1) if predictors.grid is None else predictors.grid.pixel.reshape(-1, 2)[texel]
    return spatial_folds(position, painted, predictors.surface & ~painted, seed)


def rim_of(hole: np.ndarray, known: np.ndarray, predictors: Predictors | WindowPredictors) -> np.ndarray:
    """Find the known texels whose residual reaches into a hole.

    Parameters
    ----------
    hole, known
        ``(R, S)`` bool.
    predictors
        With the top-down grid, if any.

    Returns
    -------
    ndarray
        ``(R, S)`` bool: known texels within `REACH_PX` of a hole; with several charts, all known texels.
    """
    import cv2

    if predictors.grid is not None or not hole.any():
        return known
    side = 2 * int(REACH_PX) + 1
    return known & (cv2.dilate(hole.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def propagate_residual(
    residual: np.ndarray, known: np.ndarray, predictors: Predictors | WindowPredictors
) -> np.ndarray:
    """Propagate a residual into the holes, with several charts on the top-down grid; see `smooth_fill.propagate`.

    Parameters
    ----------
    residual
        ``(R, S, C)``.
    known
        ``(R, S)`` bool: texels with a residual.
    predictors
        With the top-down grid, if any.

    Returns
    -------
    ndarray
        ``(R, S, C)`` float32, decaying with the distance from known texels.
    """
    if predictors.grid is None:
        # Painted texels outside the rim count as unknown here; they are too far from the holes to matter.
        return propagate(residual, known, reach_px=REACH_PX)
    mean, count = to_grid(predictors.grid, residual, known)
    return np.nan_to_num(from_grid(predictors.grid, propagate(mean, count > 0, reach_px=REACH_PX)))
