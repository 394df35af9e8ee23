"""Guided completion: what a texel looks like, learned from the texels that cameras saw and what the land tells of all.

Trees on satellite colour, height, slope, aspect, curvature, sky in view and sun predict the hidden texels; where an image
among the guides (satellite, relit albedo) leaves the range that most seen texels have, a straight line goes on from there:
trees alone know no snow where the cameras saw none, however white the image. The error that the prediction makes on seen
texels is then carried a few texels into the holes, so that no seam is left.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from seasonscapes.texturing.completion_error import ErrorModel, fit_error_model, spatial_folds
from seasonscapes.texturing.predictors import Predictors
from seasonscapes.texturing.smooth_fill import propagate
from seasonscapes.texturing.top_down_grid import from_grid, to_grid

Progress = Callable[[float], None]

SAMPLES, FAST_SAMPLES = 40_000, 20_000
REACH_PX = 12.0
# Boosting is sharper, the forest steadier; their mean beats both where the guides tell little.
MIX = 0.65
BLOCK = 200_000
# Guides whose names begin so are pictures of the land: its colour is likely to follow theirs.
IMAGES = ("satellite", "relit")
# Trees cannot ask "is it missing?" in every library version; a value that no guide takes says so.
_MISSING = np.float32(-1.0e5)


# Shrinkage of the line, in variances of its inputs, and where it takes over [standard deviations]; chosen on massifs of
# seeds 5 to 7 seen by two cameras, and such that textures of which much was seen stay as good (seed 99, Landsat).
_SHRINKAGE, _MOST_SEEN = 0.1, 1.0


@dataclass(frozen=True)
class LinearExtrapolation:
    """A linear map from image guides to encoded colour, of which only what lies beyond the usual range is used.

    Parameters
    ----------
    columns
        Which guides are images; their cube roots are taken.
    middle, scale
        ``(C,)`` means and standard deviations of these among the texels that it was fitted to.
    slope
        ``(C, 3)`` encoded colour per standard deviation.
    """

    columns: np.ndarray
    middle: np.ndarray
    scale: np.ndarray
    slope: np.ndarray

    def __call__(self, predictor: np.ndarray) -> np.ndarray:
        """What it adds to encoded colours ``(n, 3)`` at guides ``(n, G)``: nothing within the usual range or without image."""
        said = (np.cbrt(predictor[:, self.columns]) - self.middle) / self.scale
        return np.nan_to_num(said - np.clip(said, -_MOST_SEEN, _MOST_SEEN)) @ self.slope


def fit_extrapolation(predictor: np.ndarray, encoded: np.ndarray, images: np.ndarray) -> LinearExtrapolation:
    """Ridge regression of encoded colours ``(n, 3)`` on the image guides, ``images`` ``(G,)`` bool."""
    columns = np.flatnonzero(images)
    said = np.cbrt(predictor[:, columns].astype(np.float64))
    known = np.isfinite(said).all(axis=1)
    if len(columns) == 0 or not known.any():
        return LinearExtrapolation(columns, np.zeros(len(columns)), np.ones(len(columns)), np.zeros((len(columns), 3)))
    middle, scale = said[known].mean(axis=0), said[known].std(axis=0) + 1e-6
    said, colour = (said[known] - middle) / scale, encoded[known] - encoded[known].mean(axis=0)
    normal = said.T @ said + _SHRINKAGE * len(said) * np.eye(len(columns))
    return LinearExtrapolation(columns, middle, scale, np.linalg.solve(normal, said.T @ colour))


@dataclass(frozen=True)
class Regression:
    """A fitted regression from guides to encoded colour.

    Parameters
    ----------
    beyond
        What images add where they leave the usual range; trees learn the rest.
    boosted
        Three boosted models of lightness and two colour differences, or ``None`` for the fast kind.
    forest
        Extremely randomised trees of all channels; their disagreement is part of σ.
    """

    beyond: LinearExtrapolation
    boosted: tuple | None
    forest: object


def to_opponent_colour(encoded: np.ndarray) -> np.ndarray:
    """Lightness and two colour differences ``(..., 3)``: three nearly independent targets."""
    r, g, b = np.moveaxis(encoded, -1, 0)
    return np.stack([(r + g + b) / 3.0, r - g, b - g], -1)


def from_opponent_colour(parts: np.ndarray) -> np.ndarray:
    """Inverse of `to_opponent_colour`."""
    lightness, rg, bg = np.moveaxis(parts, -1, 0)
    g = lightness - (rg + bg) / 3.0
    return np.stack([rg + g, g, bg + g], -1)


def fit_regression(
    predictor: np.ndarray, encoded: np.ndarray, images: np.ndarray | None = None, *, fast: bool = False, seed: int = 0
) -> Regression:
    """Fit guides ``(n, G)``, of which ``images`` ``(G,)`` bool are such, to encoded colours ``(n, 3)``."""
    from sklearn.ensemble import HistGradientBoostingRegressor

    beyond = fit_extrapolation(predictor, encoded, np.zeros(predictor.shape[1], bool) if images is None else images)
    left = encoded - beyond(predictor)
    forest = fit_forest(predictor, left, seed, trees=20 if fast else 12)
    if fast:
        return Regression(beyond, None, forest)
    boosted = []
    for channel, (target, rounds) in enumerate(zip(to_opponent_colour(left).T, (100, 40, 40), strict=True)):
        model = HistGradientBoostingRegressor(
            max_iter=rounds,
            learning_rate=0.1,
            max_leaf_nodes=31,
            max_features=0.5,
            min_samples_leaf=20,
            l2_regularization=1.0,
            early_stopping=False,
            random_state=seed + channel,
        )
        boosted.append(model.fit(predictor, target))
    return Regression(beyond, tuple(boosted), forest)


def fit_forest(
    predictor: np.ndarray,
    encoded: np.ndarray,
    seed: int,
    *,
    trees: int,
    leaf: int = 5,
    weight: np.ndarray | None = None,
):
    """Extremely randomised trees from guides ``(n, G)`` to colours ``(n, 3)``, of at least ``leaf`` samples each leaf."""
    from sklearn.ensemble import ExtraTreesRegressor

    forest = ExtraTreesRegressor(trees, min_samples_leaf=leaf, max_features=0.5, n_jobs=1, random_state=seed)
    return forest.fit(_said(predictor), encoded, sample_weight=weight)


def _said(predictor: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(np.where(np.isfinite(predictor), predictor, _MISSING), np.float32)


def forest_mean_spread(forest, predictor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean ``(n, 3)`` over the trees and the standard deviation between them ``(n,)``, RMS over the channels."""
    said = _said(predictor)
    total, square = np.zeros((len(said), 3)), np.zeros((len(said), 3))
    for tree in forest.estimators_:
        value = tree.tree_.predict(said).reshape(len(said), 3)
        total += value
        square += value**2
    mean = total / len(forest.estimators_)
    variance = np.maximum(square / len(forest.estimators_) - mean**2, 0.0)
    return mean, np.sqrt(variance.mean(axis=1))


def predict(regression: Regression, predictor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Encoded colours ``(n, 3)`` and the trees' spread ``(n,)`` of guides ``(n, G)``."""
    mean, spread = forest_mean_spread(regression.forest, predictor)
    if regression.boosted is not None:
        boosted = from_opponent_colour(np.stack([model.predict(predictor) for model in regression.boosted], -1))
        mean = MIX * boosted + (1.0 - MIX) * mean
    return regression.beyond(predictor) + mean, spread


def regression_fill(
    values: np.ndarray,
    painted: np.ndarray,
    predictors: Predictors,
    *,
    fast: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Fill by regression and propagated residual; see `completion.complete` for arguments and result."""
    tell = progress or (lambda share: None)
    rng = np.random.default_rng(seed)
    known = np.flatnonzero(painted & predictors.surface)
    table, flat = predictors.values.reshape(-1, predictors.values.shape[2]), values.reshape(-1, 3)
    sample = rng.choice(known, min(FAST_SAMPLES if fast else SAMPLES, len(known)), replace=False)
    predictor, encoded = mask_imagery(table[sample], predictors, painted, rng), flat[sample].astype(np.float64)
    images = np.array([name.startswith(IMAGES) for name in predictors.names])
    regression = fit_regression(predictor, encoded, images, fast=fast, seed=seed)
    tell(0.2)
    spread = _spread_of(predictors, painted, (sample, predictor, encoded, images), seed)
    tell(0.35)
    hole = predictors.surface & ~painted
    rim = _near(hole, painted & predictors.surface, int(REACH_PX), predictors)
    predicted = np.zeros_like(values, dtype=np.float32)
    sigma = np.zeros(painted.shape, np.float32)
    wanted = np.flatnonzero(hole | rim)
    for start in range(0, len(wanted), BLOCK):
        part = wanted[start : start + BLOCK]
        colour, between = predict(regression, table[part])
        predicted.reshape(-1, 3)[part] = colour
        inside = hole.ravel()[part]
        sigma.ravel()[part[inside]] = spread.sigma(table[part[inside]], colour[inside], between[inside])
        tell(0.35 + 0.6 * min(1.0, (start + BLOCK) / len(wanted)))
    residual = np.where(rim[..., None], values - predicted, 0.0)
    filled = np.where(hole[..., None], predicted + propagate_residual(residual, rim, predictors), values)
    return filled.astype(np.float32), sigma


def mask_imagery(
    predictor: np.ndarray, predictors: Predictors, painted: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Training guides, of which as many lose their satellite colours as hidden texels lack theirs.

    Trees only learn what to do without an image if some of their samples are without it.
    """
    image = np.array([name.startswith("satellite") for name in predictors.names])
    if not image.any():
        return predictor
    missing = ~np.isfinite(predictors.values[..., image][predictors.surface & ~painted]).all(axis=1)
    share = float(missing.mean()) if len(missing) else 0.0
    lacking = ~np.isfinite(predictor[:, image]).all(axis=1)
    # Where the image ends is no chance: texels without it are few among the seen ones, many among the hidden.
    extra = min(0.5, share) - float(lacking.mean())
    if extra <= 0.0:
        return predictor
    blind = rng.random(len(predictor)) < extra
    return np.where(blind[:, None] & image, np.float32(np.nan), predictor)


def _spread_of(predictors: Predictors, painted: np.ndarray, sampled: tuple, seed: int) -> ErrorModel:
    sample, predictor, encoded, images = sampled

    def fit(rows):
        beyond = fit_extrapolation(predictor[rows], encoded[rows], images)
        held_out = Regression(
            beyond, None, fit_forest(predictor[rows], encoded[rows] - beyond(predictor[rows]), seed, trees=10)
        )
        return lambda other: predict(held_out, other)

    return fit_error_model(predictor, encoded, folds_of(sample, painted, predictors, seed), fit, seed=seed)


def folds_of(sample: np.ndarray, painted: np.ndarray, predictors: Predictors, seed: int) -> np.ndarray:
    """Fold number ``(n,)`` of flat texels, by where they lie on the land: see `spatial_folds`."""
    row, column = np.unravel_index(sample, painted.shape)
    place = np.stack([column, row], -1) if predictors.plan is None else predictors.plan.pixel.reshape(-1, 2)[sample]
    return spatial_folds(place, painted, predictors.surface & ~painted, seed)


def _near(hole: np.ndarray, known: np.ndarray, reach_px: int, predictors: Predictors) -> np.ndarray:
    """Known texels within reach of a hole; all of them where charts lie apart."""
    import cv2

    if predictors.plan is not None or not hole.any():
        return known
    side = 2 * reach_px + 1
    return known & (cv2.dilate(hole.astype(np.uint8), np.ones((side, side), np.uint8)) > 0)


def propagate_residual(residual: np.ndarray, known: np.ndarray, predictors: Predictors) -> np.ndarray:
    """The residual in the holes; by way of the plan where the atlas has several charts."""
    if predictors.plan is None:
        # Painted texels far from any hole have no residual, but they are nobody's neighbours either.
        return propagate(residual, known, reach_px=REACH_PX)
    mean, count = to_grid(predictors.plan, residual, known)
    return np.nan_to_num(from_grid(predictors.plan, propagate(mean, count > 0, reach_px=REACH_PX)))
