"""Regression from predictors to encoded colour: tree ensembles, and a linear term where an image leaves the training range."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    from sklearn.ensemble import ExtraTreesRegressor, HistGradientBoostingRegressor

# Weight of the boosted trees in their mean with the randomised trees. Boosting is more accurate, the randomised trees
# have less variance; the mean is better than either where the predictors explain little.
MIX = 0.65
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


def fit_on_one_thread(
    model: HistGradientBoostingRegressor, predictor: np.ndarray, target: np.ndarray
) -> HistGradientBoostingRegressor:
    """Fit boosted trees to ``(n, G)`` and ``(n,)``: on some ten thousand rows threads wait for each other longer than they work."""
    with threadpool_limits(1, "openmp"):
        return model.fit(predictor, target)


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
        boosted.append(fit_on_one_thread(model, predictor, target))
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
