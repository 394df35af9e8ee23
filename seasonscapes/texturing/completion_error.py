"""How far off a completion is likely to be: learned from its own errors on blocks of land that were held out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

FOLDS = 4
_TINY = 1e-8


@dataclass(frozen=True)
class ErrorModel:
    """A fitted model of the error's size.

    Parameters
    ----------
    model
        From guides, predicted colour and the trees' spread to the squared error, as a share of ``size``.
    size
        Mean squared error.
    """

    model: object
    size: float

    def sigma(self, predictor: np.ndarray, colour: np.ndarray, between: np.ndarray) -> np.ndarray:
        """Standard error ``(n,)`` of the cubes of colours ``(n, 3)``, RMS over the channels."""
        return np.sqrt(self.size * self.model.predict(_features(predictor, colour, between))).astype(np.float32)


def _features(predictor: np.ndarray, colour: np.ndarray, between: np.ndarray) -> np.ndarray:
    return np.column_stack([predictor, colour, between]).astype(np.float32)


def spatial_folds(place: np.ndarray, painted: np.ndarray, hole: np.ndarray, seed: int) -> np.ndarray:
    """Fold number ``(n,)`` of texels at ``place`` ``(n, 2)`` (column, row): whole square blocks share one.

    Blocks are as wide as holes are: neighbours of a hidden texel are hidden too, and so those of a held-out texel
    must be. Random folds would flatter.
    """
    distance = cv2.distanceTransform((~painted).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    depth = float(np.percentile(distance[hole], 75.0)) if hole.any() else 8.0
    extent = float(np.ptp(place, axis=0).max()) + 1.0
    side = float(np.clip(4.0 * depth, min(16.0, extent / 4.0), max(extent / 8.0, 16.0)))
    cell = np.floor((place - place.min(axis=0)) / side).astype(np.int64)
    number = cell[:, 1] * (cell[:, 0].max() + 1) + cell[:, 0]
    _, block = np.unique(number, return_inverse=True)
    turn = np.random.default_rng(seed).permutation(block.max() + 1)
    return turn[block] % FOLDS


def fit_error_model(
    predictor: np.ndarray, encoded: np.ndarray, fold: np.ndarray, fit: Callable, *, seed: int = 0
) -> ErrorModel:
    """Errors of models fitted without each fold, as a function of everything known beforehand.

    Parameters
    ----------
    predictor, encoded
        ``(n, G)`` and ``(n, 3)``, cube roots. Errors are those of the cubes: what is predicted dark and lies in the
        sun after all is rare, and no error of cube roots would tell how far off it is.
    fold
        ``(n,)`` from `spatial_folds`.
    fit
        Takes rows ``(n,)`` bool; gives a function from guides to predicted colours ``(k, 3)`` and spread ``(k,)``.
    """
    from sklearn.ensemble import HistGradientBoostingRegressor

    colour, between = np.empty_like(encoded), np.empty(len(encoded))
    for number in np.unique(fold):
        out = fold == number
        if out.all():
            # One block alone cannot be held out of itself: the error may be as large as the value.
            colour[out], between[out] = 0.0, 0.0
            continue
        colour[out], between[out] = fit(~out)(predictor[out])
    square = np.mean((np.maximum(colour, 0.0) ** 3 - encoded**3) ** 2, axis=1) + _TINY
    # Of the losses with a logarithmic link this one is steady where a few squares outweigh all others.
    size = float(square.mean())
    model = HistGradientBoostingRegressor(
        loss="poisson",
        max_iter=40,
        learning_rate=0.12,
        max_leaf_nodes=6,
        min_samples_leaf=200,
        l2_regularization=1.0,
        max_features=0.5,
        early_stopping=False,
        random_state=seed,
    )
    return ErrorModel(model.fit(_features(predictor, colour, between), square / size), size)


def sigma_by_distance(fill: Callable, values: np.ndarray, known: np.ndarray, *, seed: int = 0) -> np.ndarray:
    """σ ``(H, W)`` of a method that knows pictures only, from its own errors as they grow with the distance inwards.

    Discs of known texels are hidden, as deep as the holes are, filled by ``fill(values, known)``, and the squared
    error is averaged by distance to the nearest texel left; it may only grow.

    Parameters
    ----------
    values, known
        Cube roots ``(H, W, C)``, and ``(H, W)``. σ is that of the cubes.
    """
    if known.all():
        return np.zeros(known.shape, np.float32)
    depth = cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    row, column = np.nonzero(known)
    rng, left = np.random.default_rng(seed), known.astype(np.uint8)
    # A third of the known texels at most: the rest must still fill.
    most = max(2.0, min(float(depth.max()), 0.25 * min(known.shape)))
    while left.sum() > 0.67 * known.sum():
        centre = rng.integers(len(row))
        radius = int(np.ceil(rng.uniform(1.0, most)))
        cv2.circle(left, (int(column[centre]), int(row[centre])), radius, 0, -1)
    if not left.any():
        left[row[0], column[0]] = 1
    left = (left > 0) & known
    hidden = known & ~left
    if not hidden.any():
        # Too little is known to hide any of it: the error may be as large as the values.
        return np.where(known, 0.0, np.sqrt(np.mean(values[known] ** 6))).astype(np.float32)
    inner = cv2.distanceTransform((~left).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    error = np.mean((np.maximum(fill(values, left)[hidden], 0.0) ** 3 - values[hidden] ** 3) ** 2, axis=1)
    edges = np.unique(np.geomspace(1.0, most + 1.0, 12).round(1))
    bins = np.clip(np.searchsorted(edges, inner[hidden], side="right"), 0, len(edges) - 1)
    count = np.bincount(bins, minlength=len(edges))
    met = count > 0
    mean = np.maximum.accumulate(np.bincount(bins, weights=error, minlength=len(edges))[met] / count[met])
    sigma = np.sqrt(np.maximum(np.interp(depth, edges[met], mean), _TINY))
    return np.where(known, 0.0, sigma).astype(np.float32)
