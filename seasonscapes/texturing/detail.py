"""Synthesis of fine detail: texture quilting of the grain of painted patches onto smoothly completed texels."""

from __future__ import annotations

import numpy as np

from seasonscapes.texturing.predictors import Predictors

PATCH_PX = 16
# Least fraction of painted texels in a source patch.
_MIN_PAINTED = 0.95
# Least number of source patches, and number of similar patches from which one is drawn.
_MIN_SOURCES, _CANDIDATES = 8, 5


def add_detail(
    filled: np.ndarray, painted: np.ndarray, predictors: Predictors, *, strength: float, seed: int = 0
) -> np.ndarray:
    """Add the grain of painted patches to the filled texels by texture quilting.

    After Efros & Freeman 2001 (doi:10.1145/383259.383296), with blended instead of cut borders. The grain of a patch is
    its painted colour minus the local mean. Each patch of a hole receives the grain of a painted patch with similar
    predictors. Overlapping patches are blended with weights whose squares sum to 1, which preserves the variance.

    Parameters
    ----------
    filled
        ``(R, S, 3)`` encoded colours, complete.
    painted
        ``(R, S)`` bool.
    predictors
        Of the same size.
    strength
        1 adds grain of the same variance as that of painted texels; 0 none.
    seed
        Of the choice among similar patches.

    Returns
    -------
    ndarray
        ``(R, S, 3)`` encoded colours; painted texels are unchanged.
    """
    from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

    half = PATCH_PX // 2
    height, width = painted.shape
    if strength <= 0.0 or min(height, width) < 2 * PATCH_PX:
        return filled
    starts = [(r, c) for r in range(0, height - PATCH_PX + 1, half) for c in range(0, width - PATCH_PX + 1, half)]
    starts = np.array(starts)
    source = _patch_sums((painted & predictors.surface).astype(np.float32), starts) > _MIN_PAINTED * PATCH_PX**2
    target = _patch_sums((predictors.surface & ~painted).astype(np.float32), starts) > 0.5
    if source.sum() < _MIN_SOURCES or not target.any():
        return filled
    features = _patch_features(filled, predictors, starts)
    grain = filled - _local_mean(filled)
    tree = cKDTree(features[source])
    _, near = tree.query(features[target], k=min(_CANDIDATES, int(source.sum())))
    rng = np.random.default_rng(seed)
    chosen = np.take_along_axis(near, rng.integers(0, near.shape[1], (len(near), 1)), 1)[:, 0]
    window = np.sin((np.arange(PATCH_PX) + 0.5) * np.pi / PATCH_PX)
    window = (window[:, None] * window[None, :])[..., None].astype(np.float32)
    total, square = np.zeros_like(filled), np.zeros((height, width, 1), np.float32)
    # The prediction has some grain already; only the missing part of its variance is added.
    power = _patch_sums((grain**2).mean(axis=2), starts)
    missing = np.sqrt(np.clip(1.0 - power[target] / np.maximum(power[source][chosen], 1e-12), 0.0, 1.0))
    for (row, column), (source_row, source_column), amplitude in zip(
        starts[target], starts[source][chosen], missing, strict=True
    ):
        at_target = np.s_[row : row + PATCH_PX, column : column + PATCH_PX]
        at_source = np.s_[source_row : source_row + PATCH_PX, source_column : source_column + PATCH_PX]
        total[at_target] += np.float32(amplitude) * window * grain[at_source]
        square[at_target] += window**2
    added = total / np.sqrt(np.maximum(square, 0.25))
    return np.where((predictors.surface & ~painted)[..., None], filled + np.float32(strength) * added, filled)


def _local_mean(values: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.GaussianBlur(values, (0, 0), PATCH_PX / 4.0, borderType=cv2.BORDER_REFLECT)


def _patch_sums(values: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Sums over patches ``(n, ...)`` by an integral image."""
    total = np.pad(values.astype(np.float64), ((1, 0), (1, 0), *((0, 0),) * (values.ndim - 2))).cumsum(0).cumsum(1)
    row, column = starts.T
    end_row, end_column = row + PATCH_PX, column + PATCH_PX
    return total[end_row, end_column] - total[row, end_column] - total[end_row, column] + total[row, column]


def _patch_features(filled: np.ndarray, predictors: Predictors, starts: np.ndarray) -> np.ndarray:
    """Standardised mean colour and predictors of each patch; the colour has the total weight of the predictors."""
    known = np.nan_to_num(
        predictors.values[..., [k for k, n in enumerate(predictors.names) if not n.startswith("satellite")]]
    )
    means = _patch_sums(np.concatenate([filled, known], -1), starts) / PATCH_PX**2
    means = (means - means.mean(0)) / np.maximum(means.std(0), 1e-6)
    means[:, :3] *= np.sqrt(known.shape[2] / 3.0)
    return means
