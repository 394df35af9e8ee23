"""Detail for the eye: grain of the seen land quilted onto the smooth prediction of the unseen."""

from __future__ import annotations

import numpy as np

from seasonscapes.texturing.predictors import Predictors

PATCH_PX = 16
# A patch whose grain is taken may have a few holes itself.
_SEEN_SHARE = 0.95


def add_detail(
    filled: np.ndarray, painted: np.ndarray, predictors: Predictors, *, strength: float, seed: int = 0
) -> np.ndarray:
    """Fine structure of painted patches added to the filled texels, after Efros & Freeman 2001
    (doi:10.1145/383259.383296) with blended instead of cut borders.

    A patch's grain is its painted colour less that colour's local mean. Each patch of the hole takes the grain of a
    painted patch that the guides call alike. Two overlapping grids of patches are joined with weights whose squares
    sum to 1, which keeps the variance.

    Parameters
    ----------
    filled, painted
        Encoded colours ``(R, S, 3)``, complete, and which of them were seen.
    strength
        1 gives the hole the grain of the seen land; 0 none.
    """
    from scipy.spatial import cKDTree

    half = PATCH_PX // 2
    height, width = painted.shape
    if strength <= 0.0 or min(height, width) < 2 * PATCH_PX:
        return filled
    starts = [(r, c) for r in range(0, height - PATCH_PX + 1, half) for c in range(0, width - PATCH_PX + 1, half)]
    starts = np.array(starts)
    whole = _patch_sums((painted & predictors.surface).astype(np.float32), starts) > _SEEN_SHARE * PATCH_PX**2
    touched = _patch_sums((predictors.surface & ~painted).astype(np.float32), starts) > 0.5
    if whole.sum() < 8 or not touched.any():
        return filled
    features = _patch_features(filled, predictors, starts)
    grain = filled - _local_mean(filled)
    tree = cKDTree(features[whole])
    _, near = tree.query(features[touched], k=min(5, int(whole.sum())))
    rng = np.random.default_rng(seed)
    chosen = np.take_along_axis(near, rng.integers(0, near.shape[1], (len(near), 1)), 1)[:, 0]
    window = np.sin((np.arange(PATCH_PX) + 0.5) * np.pi / PATCH_PX)
    window = (window[:, None] * window[None, :])[..., None].astype(np.float32)
    total, square = np.zeros_like(filled), np.zeros((height, width, 1), np.float32)
    # The prediction has some grain of its own: only what it lacks is added.
    power = _patch_sums((grain**2).mean(axis=2), starts)
    lack = np.sqrt(np.clip(1.0 - power[touched] / np.maximum(power[whole][chosen], 1e-12), 0.0, 1.0))
    for (row, column), source, share in zip(starts[touched], starts[whole][chosen], lack, strict=True):
        here = np.s_[row : row + PATCH_PX, column : column + PATCH_PX]
        there = np.s_[source[0] : source[0] + PATCH_PX, source[1] : source[1] + PATCH_PX]
        total[here] += np.float32(share) * window * grain[there]
        square[here] += window**2
    added = total / np.sqrt(np.maximum(square, 0.25))
    return np.where((predictors.surface & ~painted)[..., None], filled + np.float32(strength) * added, filled)


def _local_mean(values: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.GaussianBlur(values, (0, 0), PATCH_PX / 4.0, borderType=cv2.BORDER_REFLECT)


def _patch_sums(values: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Sum over each patch ``(n, ...)`` by an integral image."""
    total = np.pad(values.astype(np.float64), ((1, 0), (1, 0), *((0, 0),) * (values.ndim - 2))).cumsum(0).cumsum(1)
    row, column = starts.T
    end_row, end_column = row + PATCH_PX, column + PATCH_PX
    return total[end_row, end_column] - total[row, end_column] - total[end_row, column] + total[row, column]


def _patch_features(filled: np.ndarray, predictors: Predictors, starts: np.ndarray) -> np.ndarray:
    """Mean guides and mean colour of each patch, scaled to unit deviation; the colour counts as much as all guides."""
    known = np.nan_to_num(
        predictors.values[..., [k for k, n in enumerate(predictors.names) if not n.startswith("satellite")]]
    )
    means = _patch_sums(np.concatenate([filled, known], -1), starts) / PATCH_PX**2
    means = (means - means.mean(0)) / np.maximum(means.std(0), 1e-6)
    means[:, :3] *= np.sqrt(known.shape[2] / 3.0)
    return means
