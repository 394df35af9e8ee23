"""Completion by regression: colour of unpainted texels from terrain attributes and imagery, trained on painted texels.

Tree ensembles on satellite colour, height, slope, aspect, curvature, sky view factor and sun predict the unpainted
texels. Where an image among the predictors (satellite, relit albedo) leaves the range of the training texels, a linear
term extrapolates: trees alone are constant there, so that unobserved snow would take the colour of the brightest
observed ground. The residual of the prediction at painted texels is then propagated a few texels into the holes, which
removes the seam.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.texturing.completion_error import ErrorModel, Predict, fit_error_model, spatial_folds
from seasonscapes.texturing.predictors import Predictors
from seasonscapes.texturing.smooth_fill import propagate
from seasonscapes.texturing.top_down_grid import from_grid, to_grid

if TYPE_CHECKING:
    from sklearn.ensemble import ExtraTreesRegressor, HistGradientBoostingRegressor

Progress = Callable[[float], None]

SAMPLES, FAST_SAMPLES = 40_000, 20_000
# Decay length of propagated residuals [texels].
REACH_PX = 12.0
# Weight of the boosted trees in their mean with the randomised trees. Boosting is more accurate, the randomised trees
# have less variance; the mean is better than either where the predictors explain little.
MIX = 0.65
# Texels predicted at once.
BLOCK = 200_000
# Prefixes of the names of predictors that are images of the terrain, to which its colour is nearly proportional.
IMAGES = ("satellite", "relit")
# Stands for NaN: not every version of the randomised trees accepts missing values. No predictor has this value.
_MISSING = np.float32(-1.0e5)
# Ridge penalty of the linear term in variances of its inputs, and the limit of the training range beyond which it
# applies [standard deviations]. Chosen on synthetic massifs of seeds 5 to 7 with two cameras, and such that textures
# with large painted areas do not become worse (seed 99, Landsat).
_RIDGE, _RANGE = 0.1, 1.0


@dataclass(frozen=True)
class LinearExtrapolation:
    """Linear map from image predictors to encoded colour, applied to the excess over the training range only.

    Parameters
    ----------
    columns
        Indices of the predictors that are images; their cube roots are used.
    mean, scale
        ``(C,)`` mean and standard deviation of the cube roots over the training texels.
    slope
        ``(C, 3)`` encoded colour per standard deviation.
    """

    columns: np.ndarray
    mean: np.ndarray
    scale: np.ndarray
    slope: np.ndarray

    def __call__(self, predictor: np.ndarray) -> np.ndarray:
        """Return the term to add to encoded colours ``(n, 3)``; 0 within the training range or without an image.

        Parameters
        ----------
        predictor
            ``(n, G)``.
        """
        image = (np.cbrt(predictor[:, self.columns]) - self.mean) / self.scale
        return np.nan_to_num(image - np.clip(image, -_RANGE, _RANGE)) @ self.slope


def fit_extrapolation(predictor: np.ndarray, encoded: np.ndarray, images: np.ndarray) -> LinearExtrapolation:
    """Fit encoded colours to the image predictors by ridge regression.

    Parameters
    ----------
    predictor
        ``(n, G)``.
    encoded
        ``(n, 3)`` colours, cube roots.
    images
        ``(G,)`` bool: predictors that are images.

    Returns
    -------
    LinearExtrapolation
        Zero without images or where none has a value.
    """
    columns = np.flatnonzero(images)
    image = np.cbrt(predictor[:, columns].astype(np.float64))
    known = np.isfinite(image).all(axis=1)
    if len(columns) == 0 or not known.any():
        return LinearExtrapolation(columns, np.zeros(len(columns)), np.ones(len(columns)), np.zeros((len(columns), 3)))
    mean, scale = image[known].mean(axis=0), image[known].std(axis=0) + 1e-6
    image, colour = (image[known] - mean) / scale, encoded[known] - encoded[known].mean(axis=0)
    normal = image.T @ image + _RIDGE * len(image) * np.eye(len(columns))
    return LinearExtrapolation(columns, mean, scale, np.linalg.solve(normal, image.T @ colour))


@dataclass(frozen=True)
class Regression:
    """A fitted regression from predictors to encoded colour.

    Parameters
    ----------
    extrapolation
        Linear term outside the training range of the images; the trees are fitted to the remainder.
    boosted
        Gradient-boosted trees of lightness and two colour differences, or ``None`` in the fast variant.
    forest
        Extremely randomised trees of all channels; the spread between them enters the error model.
    """

    extrapolation: LinearExtrapolation
    boosted: tuple[HistGradientBoostingRegressor, ...] | None
    forest: ExtraTreesRegressor


def to_opponent_colour(encoded: np.ndarray) -> np.ndarray:
    """Convert RGB to lightness and two colour differences, which are nearly uncorrelated.

    Parameters
    ----------
    encoded
        ``(..., 3)`` colours R, G, B.

    Returns
    -------
    ndarray
        ``(..., 3)``: (R + G + B) / 3, R − G, B − G.
    """
    r, g, b = np.moveaxis(encoded, -1, 0)
    return np.stack([(r + g + b) / 3.0, r - g, b - g], -1)


def from_opponent_colour(opponent: np.ndarray) -> np.ndarray:
    """Invert `to_opponent_colour`.

    Parameters
    ----------
    opponent
        ``(..., 3)``: lightness and colour differences.

    Returns
    -------
    ndarray
        ``(..., 3)`` colours R, G, B.
    """
    lightness, rg, bg = np.moveaxis(opponent, -1, 0)
    g = lightness - (rg + bg) / 3.0
    return np.stack([rg + g, g, bg + g], -1)


def fit_regression(
    predictor: np.ndarray, encoded: np.ndarray, images: np.ndarray | None = None, *, fast: bool = False, seed: int = 0
) -> Regression:
    """Fit a regression from predictors to encoded colours.

    Parameters
    ----------
    predictor
        ``(n, G)``, NaN where unknown.
    encoded
        ``(n, 3)`` colours, cube roots.
    images
        ``(G,)`` bool: predictors that are images; ``None`` for none.
    fast
        Fit randomised trees only.
    seed
        Of the trees.

    Returns
    -------
    Regression
        For `predict`.
    """
    from sklearn.ensemble import HistGradientBoostingRegressor

    extrapolation = fit_extrapolation(
        predictor, encoded, np.zeros(predictor.shape[1], bool) if images is None else images
    )
    remainder = encoded - extrapolation(predictor)
    forest = fit_forest(predictor, remainder, seed, trees=20 if fast else 12)
    if fast:
        return Regression(extrapolation, None, forest)
    boosted = []
    for channel, (target, rounds) in enumerate(zip(to_opponent_colour(remainder).T, (100, 40, 40), strict=True)):
        model = HistGradientBoostingRegressor(
            max_iter=rounds,
            learning_rate=0.1,
            max_leaf_nodes=31,
            max_features=0.5,
            min_samples_leaf=20,
            l2_regularization=1.0,
            early_stopping=False,  # pyright: ignore[reportArgumentType]
            random_state=seed + channel,
        )
        boosted.append(model.fit(predictor, target))
    return Regression(extrapolation, tuple(boosted), forest)


def fit_forest(
    predictor: np.ndarray,
    encoded: np.ndarray,
    seed: int,
    *,
    trees: int,
    leaf: int = 5,
    weight: np.ndarray | None = None,
) -> ExtraTreesRegressor:
    """Fit extremely randomised trees from predictors to colours.

    Parameters
    ----------
    predictor
        ``(n, G)``, NaN where unknown.
    encoded
        ``(n, 3)`` colours.
    seed
        Of the trees.
    trees
        Number of trees.
    leaf
        Least number of samples in a leaf.
    weight
        ``(n,)`` sample weights; ``None`` for equal ones.

    Returns
    -------
    ExtraTreesRegressor
        For `forest_mean_spread`.
    """
    from sklearn.ensemble import ExtraTreesRegressor

    forest = ExtraTreesRegressor(trees, min_samples_leaf=leaf, max_features=0.5, n_jobs=1, random_state=seed)
    return forest.fit(_replace_missing(predictor), encoded, sample_weight=weight)


def _replace_missing(predictor: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.where(np.isfinite(predictor), predictor, _MISSING), np.float32)


def forest_mean_spread(forest: ExtraTreesRegressor, predictor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute mean and standard deviation of the predictions of the single trees.

    Parameters
    ----------
    forest
        From `fit_forest`.
    predictor
        ``(n, G)``, NaN where unknown.

    Returns
    -------
    mean
        ``(n, 3)`` over the trees.
    spread
        ``(n,)`` standard deviation between the trees, RMS over the channels.
    """
    finite = _replace_missing(predictor)
    total, square = np.zeros((len(finite), 3)), np.zeros((len(finite), 3))
    for tree in forest.estimators_:
        value = tree.tree_.predict(finite).reshape(len(finite), 3)
        total += value
        square += value**2
    mean = total / len(forest.estimators_)
    variance = np.maximum(square / len(forest.estimators_) - mean**2, 0.0)
    return mean, np.sqrt(variance.mean(axis=1))


def predict(regression: Regression, predictor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Predict encoded colours.

    Parameters
    ----------
    regression
        From `fit_regression`.
    predictor
        ``(n, G)``, NaN where unknown.

    Returns
    -------
    encoded
        ``(n, 3)`` colours, cube roots.
    spread
        ``(n,)`` standard deviation between the randomised trees.
    """
    mean, spread = forest_mean_spread(regression.forest, predictor)
    if regression.boosted is not None:
        boosted = from_opponent_colour(np.stack([model.predict(predictor) for model in regression.boosted], -1))
        mean = MIX * boosted + (1.0 - MIX) * mean
    return regression.extrapolation(predictor) + mean, spread


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
    table, flat = predictors.values.reshape(-1, predictors.values.shape[2]), values.reshape(-1, 3)
    sample = rng.choice(known, min(FAST_SAMPLES if fast else SAMPLES, len(known)), replace=False)
    predictor, encoded = mask_imagery(table[sample], predictors, painted, rng), flat[sample].astype(np.float64)
    images = np.array([name.startswith(IMAGES) for name in predictors.names])
    regression = fit_regression(predictor, encoded, images, fast=fast, seed=seed)
    report(0.2)
    fold = texel_folds(sample, painted, predictors, seed)
    error_model = _fit_error(predictor, encoded, images, fold, seed)
    report(0.35)
    hole = predictors.surface & ~painted
    rim = _rim(hole, painted & predictors.surface, int(REACH_PX), predictors)
    predicted = np.zeros_like(values, dtype=np.float32)
    sigma = np.zeros(painted.shape, np.float32)
    target = np.flatnonzero(hole | rim)
    for start in range(0, len(target), BLOCK):
        part = target[start : start + BLOCK]
        colour, spread = predict(regression, table[part])
        predicted.reshape(-1, 3)[part] = colour
        inside = hole.ravel()[part]
        sigma.ravel()[part[inside]] = error_model.sigma(table[part[inside]], colour[inside], spread[inside])
        report(0.35 + 0.6 * min(1.0, (start + BLOCK) / len(target)))
    residual = np.where(rim[..., None], values - predicted, 0.0)
    filled = np.where(hole[..., None], predicted + propagate_residual(residual, rim, predictors), values)
    return filled.astype(np.float32), sigma


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
    missing_share = float(missing.mean()) if len(missing) else 0.0
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


def _rim(hole: np.ndarray, known: np.ndarray, reach_px: int, predictors: Predictors) -> np.ndarray:
    """Known texels within reach of a hole; with several charts, all known texels."""
    import cv2

    if predictors.grid is not None or not hole.any():
        return known
    side = 2 * reach_px + 1
    return known & (cv2.dilate(hole.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def propagate_residual(residual: np.ndarray, known: np.ndarray, predictors: Predictors) -> np.ndarray:
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
