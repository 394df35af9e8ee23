"""What stands before the land and no elevation model knows: houses and masts, found because the picture disagrees.

A regression, told where each texel lies and how it is lit but not what was painted near it, says what the land should look
like. Where a picture differs from that by more than the picture as a whole does, in a patch, something else is seen.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from seasonscapes.cameras.pinhole import ray_directions
from seasonscapes.terrain.surface import Texture, sample_texture
from seasonscapes.texturing.inputs import PreparedInput, air_to
from seasonscapes.texturing.radiometric_fit import RadiometricFit, radiance_at_surface

# Deviations that count, and the share of the 5 x 5 pixels around that must have them too.
_OUTLIER, _COHERENT = 3.2, 0.5
_PATCH = 5
# Gaps of this share of the picture's width are closed; patches below this share of its area are chance.
_CLOSED, _LEAST_AREA = 0.03, 5e-4
_DEPTH_BINS = 8


def foreground_mask(
    ready: PreparedInput,
    number: int,
    radiometry: RadiometricFit,
    predicted: np.ndarray,
    uv: np.ndarray,
    *,
    outlier: float = _OUTLIER,
) -> np.ndarray:
    """Pixels ``(H, W)`` bool that show something else than the land.

    Parameters
    ----------
    ready, number
        A shot and its index in ``radiometry``.
    predicted
        ``(R, S, 3)`` radiance [cd/m²] of the land that owes nothing to this picture's own pixels there (`predict_in_folds`);
        NaN where unknown.
    uv
        ``(H, W, 2)`` of the shot's G-buffer.
    outlier
        Robust standard deviations.
    """
    apart, known = _disagreement(ready, number, radiometry, predicted, uv)
    if np.count_nonzero(known) < 100:
        return np.zeros(known.shape, bool)
    score = np.zeros(known.shape, np.float32)
    score[known] = np.sqrt(np.mean(_standardised(apart[known], np.log(ready.depth_m[known])) ** 2, axis=1))
    far_off = (score > outlier).astype(np.float32)
    patch = (_PATCH, _PATCH)
    share = cv2.blur(far_off, patch) / np.maximum(cv2.blur(known.astype(np.float32), patch), 1e-3)
    return _solid((share > _COHERENT) & known)


def _solid(found: np.ndarray) -> np.ndarray:
    """What was found, its windows closed and its specks dropped, and a pixel wider."""
    side = 2 * round(0.5 * _CLOSED * found.shape[1]) + 1
    closed = cv2.morphologyEx(found.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((side, side), np.uint8))
    _, label, statistics, _ = cv2.connectedComponentsWithStats(closed)
    large = statistics[:, cv2.CC_STAT_AREA] >= _LEAST_AREA * found.size
    large[0] = False
    return cv2.dilate(large[label].astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)


def _disagreement(
    ready: PreparedInput, number: int, radiometry: RadiometricFit, predicted: np.ndarray, uv: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Logarithm of seen over predicted ``(H, W, 3)``, and where both are known."""
    camera = ready.item.observation.camera
    # Beside silhouettes a pixel shows two surfaces; the guard looks after those.
    usable = (ready.levels[0][..., 3] > 0.0) & (ready.confidence > 0.0)
    expected = sample_texture(predicted, uv)
    with np.errstate(invalid="ignore"):
        known = usable & (expected > 0.0).all(axis=2)
    apart = np.zeros((*usable.shape, 3), np.float32)
    place = camera.position_m + ray_directions(camera)[known] * ready.depth_m[known][:, None]
    share = cv2.blur(usable.astype(np.float32), (3, 3))
    value = cv2.blur(ready.levels[0][..., :3] * usable[..., None], (3, 3))[known] / share[known][:, None]
    seen, _ = radiance_at_surface(value, number, air_to(ready, place), radiometry)
    apart[known] = np.log(np.maximum(seen, 1e-6)) - np.log(expected[known])
    return apart, known


def _standardised(apart: np.ndarray, log_depth: np.ndarray) -> np.ndarray:
    """Errors ``(N, 3)`` over their robust scatter, about their median, at like distances."""
    edges = np.quantile(log_depth, np.linspace(0.0, 1.0, _DEPTH_BINS + 1)[1:-1])
    group = np.searchsorted(edges, log_depth)
    result = np.empty_like(apart)
    overall = np.median(np.abs(apart - np.median(apart, axis=0)), axis=0)
    for number in np.unique(group):
        part = group == number
        centred = apart[part] - np.median(apart[part], axis=0)
        scatter = np.maximum(np.median(np.abs(centred), axis=0), 0.5 * overall)
        result[part] = centred / np.maximum(1.4826 * scatter, 1e-3)
    return result


def predict_in_folds(
    texture: Texture, predictors: np.ndarray, fit: Callable, *, folds: int = 4, samples: int = 20_000, seed: int = 0
) -> np.ndarray:
    """Radiance ``(R, S, 3)`` that a regression expects, each texel's from land elsewhere.

    Parameters
    ----------
    texture
        Painted radiance; ``weight`` 0 where nothing was.
    predictors
        ``(R, S, G)``, NaN where unknown.
    fit
        ``fit(guides (n, G), log radiance (n, 3))`` gives a function from guides to log radiance.
    folds
        The land is cut into blocks, whose colours are predicted from those of other folds.

    Returns
    -------
    numpy.ndarray
        NaN where no guide is known.
    """
    height, width = texture.weight.shape
    row, column = np.divmod(np.arange(height * width), width)
    side = max(8, max(height, width) // 12)
    block = (row // side) * 1009 + column // side
    fold = np.random.default_rng(seed).permutation(int(block.max()) + 1)[block] % folds
    table = predictors.reshape(-1, predictors.shape[2])
    values = texture.values.reshape(-1, 3)
    sound = np.isfinite(table).any(axis=1)
    painted = (texture.weight.ravel() > 0.0) & sound & (values > 0.0).all(axis=1)
    expected = np.full((height * width, 3), np.nan, np.float32)
    for number in range(folds):
        train = np.flatnonzero(painted & (fold != number))
        if len(train) < 50:
            continue
        train = np.random.default_rng([seed, number]).permutation(train)[:samples]
        model = fit(table[train], np.log(values[train]))
        apply = np.flatnonzero(sound & (fold == number))
        for start in range(0, len(apply), 1 << 18):
            part = apply[start : start + (1 << 18)]
            expected[part] = np.exp(model(table[part]))
    return expected.reshape(height, width, 3)
