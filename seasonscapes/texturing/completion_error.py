"""Standard error of completed texels, estimated from cross-validation errors on spatial folds of painted texels."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from seasonscapes.texturing.colour_regression import fit_on_one_thread
from seasonscapes.texturing.small_trees import SmallTrees, small_trees

FOLDS = 4
# Side of the blocks that share a fold, in multiples of the depth of the holes, and its lower limit [px].
_BLOCK_DEPTHS, _MIN_BLOCK_PX = 4.0, 16.0
_TINY = 1e-8

# Returns predicted colours (k, 3) and their spread (k,) for predictors (k, G).
Predict = Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]
# Fits a model to the selected rows (n,) bool of the training data.
Fit = Callable[[np.ndarray], Predict]
# Fills values (H, W, C) where known (H, W) is False.
Fill = Callable[[np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class ErrorModel:
    """Regression model of the squared error of a completion.

    Parameters
    ----------
    trees
        Logarithm of the squared error, in units of ``size``, from predictors, predicted colour and spread.
    size
        Mean squared error.
    """

    trees: SmallTrees
    size: float

    def sigma(self, predictor: np.ndarray, colour: np.ndarray, spread: np.ndarray) -> np.ndarray:
        """Return the standard error of the cubes of predicted colours, RMS over the channels.

        Parameters
        ----------
        predictor
            ``(n, G)``.
        colour
            ``(n, 3)`` predicted colours, cube roots.
        spread
            ``(n,)`` standard deviation between the trees.

        Returns
        -------
        ndarray
            ``(n,)`` float32.
        """
        square = self.size * np.exp(self.trees(_features(predictor, colour, spread)))
        return np.sqrt(square).astype(np.float32)


def _features(predictor: np.ndarray, colour: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """``(G + 4, n)`` float32, each feature contiguous."""
    features = np.empty((predictor.shape[1] + colour.shape[1] + 1, len(predictor)), np.float32)
    features[: predictor.shape[1]] = predictor.T
    features[predictor.shape[1] : -1] = colour.T
    features[-1] = spread
    return features


def spatial_folds(position: np.ndarray, painted: np.ndarray, hole: np.ndarray, seed: int) -> np.ndarray:
    """Assign texels to spatial cross-validation folds by square blocks.

    Parameters
    ----------
    position
        ``(n, 2)`` column and row of the texels.
    painted, hole
        ``(R, S)`` bool; the depth of the holes determines the size of the blocks.
    seed
        Of the assignment of blocks to folds.

    Returns
    -------
    ndarray
        ``(n,)`` fold number.

    Notes
    -----
    Blocks are as wide as the holes: the neighbours of a hidden texel are hidden too, so those of a held-out texel must
    be held out. Random folds would underestimate the error.
    """
    distance = cv2.distanceTransform((~painted).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    depth = float(np.percentile(distance[hole], 75.0)) if hole.any() else 8.0
    extent = float(np.ptp(position, axis=0).max()) + 1.0
    side = float(np.clip(_BLOCK_DEPTHS * depth, min(_MIN_BLOCK_PX, extent / 4.0), max(extent / 8.0, _MIN_BLOCK_PX)))
    cell = np.floor((position - position.min(axis=0)) / side).astype(np.int64)
    number = cell[:, 1] * (cell[:, 0].max() + 1) + cell[:, 0]
    _, block = np.unique(number, return_inverse=True)
    shuffled = np.random.default_rng(seed).permutation(block.max() + 1)
    return shuffled[block] % FOLDS


def fit_error_model(
    predictor: np.ndarray, encoded: np.ndarray, fold: np.ndarray, fit: Fit, *, seed: int = 0
) -> ErrorModel:
    """Fit the squared cross-validation error as a function of predictors, predicted colour and spread.

    Parameters
    ----------
    predictor
        ``(n, G)``.
    encoded
        ``(n, 3)`` colours, cube roots. Errors are those of the cubes: dark predictions of sunlit texels are rare, and
        errors of cube roots would not represent their size.
    fold
        ``(n,)`` from `spatial_folds`.
    fit
        Called with rows ``(n,)`` bool; returns a function from predictors to predicted colours ``(k, 3)`` and spread
        ``(k,)``.
    seed
        Of the regression.

    Returns
    -------
    ErrorModel
        The fitted model.
    """
    from sklearn.ensemble import HistGradientBoostingRegressor

    colour, spread = np.empty_like(encoded), np.empty(len(encoded))
    for number in np.unique(fold):
        held_out = fold == number
        if held_out.all():
            # A single block leaves nothing to train on: take the error to be as large as the value.
            colour[held_out], spread[held_out] = 0.0, 0.0
            continue
        colour[held_out], spread[held_out] = fit(~held_out)(predictor[held_out])
    square = np.mean((np.maximum(colour, 0.0) ** 3 - encoded**3) ** 2, axis=1) + _TINY
    # The Poisson loss is the most robust of the losses with a logarithmic link where a few squares dominate.
    size = float(square.mean())
    model = HistGradientBoostingRegressor(
        loss="poisson",
        max_iter=40,
        learning_rate=0.12,
        max_leaf_nodes=6,
        min_samples_leaf=200,
        l2_regularization=1.0,
        max_features=0.5,
        early_stopping=False,  # pyright: ignore[reportArgumentType]
        random_state=seed,
    )
    fit_on_one_thread(model, _features(predictor, colour, spread).T, square / size)
    return ErrorModel(small_trees(model), size)


def sigma_by_distance(fill: Fill, values: np.ndarray, known: np.ndarray, *, seed: int = 0) -> np.ndarray:
    """Estimate the standard error of an image filling method as a non-decreasing function of distance to known pixels.

    Known pixels in discs as deep as the holes are hidden and filled, and their squared error is averaged in bins of
    distance to the nearest remaining pixel.

    Parameters
    ----------
    fill
        The method, called with values and known pixels.
    values
        ``(H, W, C)`` colours, cube roots.
    known
        ``(H, W)`` bool.
    seed
        Of the discs.

    Returns
    -------
    ndarray
        ``(H, W)`` float32 standard error of the cubes, RMS over the channels; 0 where known.
    """
    if known.all():
        return np.zeros(known.shape, np.float32)
    depth = cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    row, column = np.nonzero(known)
    rng, kept = np.random.default_rng(seed), known.astype(np.uint8)
    # At most a third of the known pixels is hidden, so that enough is left to fill from.
    max_radius = max(2.0, min(float(depth.max()), 0.25 * min(known.shape)))
    while kept.sum() > 0.67 * known.sum():
        centre = rng.integers(len(row))
        radius = int(np.ceil(rng.uniform(1.0, max_radius)))
        cv2.circle(kept, (int(column[centre]), int(row[centre])), radius, 0, -1)
    if not kept.any():
        kept[row[0], column[0]] = 1
    kept = (kept > 0) & known
    hidden = known & ~kept
    if not hidden.any():
        # Too few pixels are known to hide any: take the error to be as large as the values.
        return np.where(known, 0.0, np.sqrt(np.mean(values[known] ** 6))).astype(np.float32)
    distance = cv2.distanceTransform((~kept).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    error = np.mean((np.maximum(fill(values, kept)[hidden], 0.0) ** 3 - values[hidden] ** 3) ** 2, axis=1)
    edges = np.unique(np.geomspace(1.0, max_radius + 1.0, 12).round(1))
    bin_index = np.clip(np.searchsorted(edges, distance[hidden], side="right"), 0, len(edges) - 1)
    count = np.bincount(bin_index, minlength=len(edges))
    occupied = count > 0
    mean = np.maximum.accumulate(
        np.bincount(bin_index, weights=error, minlength=len(edges))[occupied] / count[occupied]
    )
    sigma = np.sqrt(np.maximum(np.interp(depth, edges[occupied], mean), _TINY))
    return np.where(known, 0.0, sigma).astype(np.float32)
