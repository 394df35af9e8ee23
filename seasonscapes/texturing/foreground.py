"""Foreground masks: objects missing in the terrain model (houses, masts), detected as coherent outliers.

A regression on terrain attributes and light, fitted to texels of other blocks, predicts the radiance of each texel.
Pixels whose deviation from the prediction exceeds the robust scatter of the whole image, in coherent patches, show
something other than terrain.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from seasonscapes.cameras.pinhole import ray_directions
from seasonscapes.terrain.surface import Texture, sample_texture
from seasonscapes.texturing.inputs import PreparedInput, transmittance_and_airlight
from seasonscapes.texturing.radiometric_fit import RadiometricFit, radiance_at_surface

# A regression: called with predictors (n, G) and log radiance (n, 3), it returns a function from predictors to log
# radiance.
Fit = Callable[[np.ndarray, np.ndarray], Callable[[np.ndarray], np.ndarray]]
# Threshold of the deviation [robust standard deviations], and the least fraction of outliers in the window around.
_OUTLIER, _COHERENT = 3.2, 0.5
# Side of that window [px].
_PATCH = 5
# Width of the gaps that are closed as a fraction of the image width; least area of a patch as a fraction of the image.
_CLOSED, _MIN_AREA = 0.03, 5e-4
# Fewer comparable pixels give no mask.
_MIN_PIXELS = 100
_DEPTH_BINS = 8
# Least number of training texels per fold, and texels that are predicted at once.
_MIN_TRAINING, _CHUNK = 50, 1 << 18


def foreground_mask(
    prepared: PreparedInput,
    number: int,
    radiometry: RadiometricFit,
    predicted: np.ndarray,
    uv: np.ndarray,
    *,
    outlier: float = _OUTLIER,
) -> np.ndarray:
    """Return the pixels that show something other than terrain.

    Parameters
    ----------
    prepared
        A painting input.
    number
        Its index in ``radiometry``.
    radiometry
        Gains, contrasts and haze.
    predicted
        ``(R, S, 3)`` radiance [cd/m²] of the terrain, predicted without the texels of the same block
        (`cross_validated_prediction`); NaN where unknown.
    uv
        ``(H, W, 2)`` texture coordinates of the input's G-buffer.
    outlier
        Threshold of the deviation [robust standard deviations].

    Returns
    -------
    ndarray
        ``(H, W)`` bool.
    """
    log_ratio, known = _log_ratio(prepared, number, radiometry, predicted, uv)
    if np.count_nonzero(known) < _MIN_PIXELS:
        return np.zeros(known.shape, bool)
    score = np.zeros(known.shape, np.float32)
    score[known] = np.sqrt(np.mean(_standardised(log_ratio[known], np.log(prepared.depth_m[known])) ** 2, axis=1))
    outliers = (score > outlier).astype(np.float32)
    patch = (_PATCH, _PATCH)
    fraction = cv2.blur(outliers, patch) / np.maximum(cv2.blur(known.astype(np.float32), patch), 1e-3)
    return _clean_mask((fraction > _COHERENT) & known)


def _clean_mask(mask: np.ndarray) -> np.ndarray:
    """Close gaps, drop small patches and dilate by one pixel."""
    side = 2 * round(0.5 * _CLOSED * mask.shape[1]) + 1
    closed = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((side, side), np.uint8))
    _, label, statistics, _ = cv2.connectedComponentsWithStats(closed)
    large = statistics[:, cv2.CC_STAT_AREA] >= _MIN_AREA * mask.size
    large[0] = False
    return cv2.dilate(large[label.astype(np.intp)].astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)


def _log_ratio(
    prepared: PreparedInput, number: int, radiometry: RadiometricFit, predicted: np.ndarray, uv: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Logarithm of observed over predicted radiance ``(H, W, 3)``, and where both are known ``(H, W)`` bool."""
    camera = prepared.painting_input.camera
    # Pixels at silhouettes mix two surfaces; their confidence is 0.
    usable = (prepared.levels[0][..., 3] > 0.0) & (prepared.confidence > 0.0)
    expected = sample_texture(predicted, uv)
    with np.errstate(invalid="ignore"):
        known = usable & (expected > 0.0).all(axis=2)
    log_ratio = np.zeros((*usable.shape, 3), np.float32)
    position = camera.position_m + ray_directions(camera)[known] * prepared.depth_m[known][:, None]
    coverage = cv2.blur(usable.astype(np.float32), (3, 3))
    value = cv2.blur(prepared.levels[0][..., :3] * usable[..., None], (3, 3))[known] / coverage[known][:, None]
    observed, _ = radiance_at_surface(value, number, transmittance_and_airlight(prepared, position), radiometry)
    log_ratio[known] = np.log(np.maximum(observed, 1e-6)) - np.log(expected[known])
    return log_ratio, known


def _standardised(log_ratio: np.ndarray, log_depth: np.ndarray) -> np.ndarray:
    """Deviations ``(N, 3)`` from the median in units of the robust scatter, per bin of distance."""
    edges = np.quantile(log_depth, np.linspace(0.0, 1.0, _DEPTH_BINS + 1)[1:-1])
    bin_index = np.searchsorted(edges, log_depth)
    result = np.empty_like(log_ratio)
    overall = np.median(np.abs(log_ratio - np.median(log_ratio, axis=0)), axis=0)
    for number in np.unique(bin_index):
        selected = bin_index == number
        centred = log_ratio[selected] - np.median(log_ratio[selected], axis=0)
        scatter = np.maximum(np.median(np.abs(centred), axis=0), 0.5 * overall)
        result[selected] = centred / np.maximum(1.4826 * scatter, 1e-3)
    return result


def cross_validated_prediction(
    texture: Texture, predictors: np.ndarray, fit: Fit, *, folds: int = 4, samples: int = 20_000, seed: int = 0
) -> np.ndarray:
    """Predict the radiance of every texel by regression, each fold from the texels of the other folds.

    Parameters
    ----------
    texture
        Painted radiance; ``weight`` is 0 where unpainted.
    predictors
        ``(R, S, G)``, NaN where unknown.
    fit
        ``fit(predictors (n, G), log radiance (n, 3))`` returns a function from predictors to log radiance.
    folds
        Number of spatial cross-validation folds; square blocks of texels are assigned to them at random.
    samples
        Training texels per fold.
    seed
        Of the assignment to folds and of the training texels.

    Returns
    -------
    ndarray
        ``(R, S, 3)`` float32; NaN where no predictor is known, or where fewer than 50 texels are left to train on.
    """
    height, width = texture.weight.shape
    row, column = np.divmod(np.arange(height * width), width)
    side = max(8, max(height, width) // 12)
    block = (row // side) * 1009 + column // side
    fold = np.random.default_rng(seed).permutation(int(block.max()) + 1)[block] % folds
    table = predictors.reshape(-1, predictors.shape[2])
    values = texture.values.reshape(-1, 3)
    finite = np.isfinite(table).any(axis=1)
    painted = (texture.weight.ravel() > 0.0) & finite & (values > 0.0).all(axis=1)
    expected = np.full((height * width, 3), np.nan, np.float32)
    for number in range(folds):
        training = np.flatnonzero(painted & (fold != number))
        if len(training) < _MIN_TRAINING:
            continue
        training = np.random.default_rng([seed, number]).permutation(training)[:samples]
        model = fit(table[training], np.log(values[training]))
        target = np.flatnonzero(finite & (fold == number))
        for start in range(0, len(target), _CHUNK):
            part = target[start : start + _CHUNK]
            expected[part] = np.exp(model(table[part]))
    return expected.reshape(height, width, 3)
