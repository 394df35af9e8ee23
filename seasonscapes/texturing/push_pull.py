"""Push–pull: fill a picture from ever coarser means of itself, and let what was measured fade with distance."""

from __future__ import annotations

import cv2
import numpy as np


def push_pull(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Fill texels without weight from the next coarser level of a weighted mean pyramid.

    After Gortler et al. 1996, "The Lumigraph", section 3.4.3 (doi:10.1145/237170.237200).

    Parameters
    ----------
    values
        ``(H, W, C)``; ignored where the weight is 0.
    weight
        ``(H, W)`` in [0, 1]: 1 keeps the value.

    Returns
    -------
    ndarray
        ``(H, W, C)`` float32, finite everywhere if any weight is positive, 0 if none is.
    """
    weight = np.clip(np.asarray(weight, np.float32), 0.0, 1.0)
    return _filled(np.where(weight[..., None] > 0.0, values, 0.0).astype(np.float32), weight)


def _filled(values: np.ndarray, weight: np.ndarray) -> np.ndarray:
    if weight.min() >= 1.0 or max(weight.shape) <= 1:
        return values
    height, width = weight.shape
    edge = ((0, height % 2), (0, width % 2))
    padded, total = np.pad(values * weight[..., None], (*edge, (0, 0))), np.pad(weight, edge)
    shape = (padded.shape[0] // 2, 2, padded.shape[1] // 2, 2)
    sums, share = padded.reshape(*shape, -1).sum(axis=(1, 3)), total.reshape(shape).sum(axis=(1, 3))
    coarse = sums / np.maximum(share, 1e-6)[..., None]
    coarse = _filled(coarse, np.minimum(share, 1.0))
    up = cv2.resize(coarse, (2 * coarse.shape[1], 2 * coarse.shape[0]), interpolation=cv2.INTER_LINEAR)
    up = up.reshape(*padded.shape)[:height, :width]
    return values * weight[..., None] + up * (1.0 - weight[..., None])


def propagate(residual: np.ndarray, known: np.ndarray, *, reach_px: float = 12.0) -> np.ndarray:
    """A residual ``(H, W, C)`` carried from where it is known into the holes, fading as exp(−distance / reach).

    Where a model's prediction meets what was seen, this takes away the seam; far inside a hole the model stands alone.
    """
    if known.all() or not known.any():
        return np.where(known[..., None], residual, 0.0).astype(np.float32)
    distance = cv2.distanceTransform((~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5)
    fade = np.exp(-np.maximum(distance - 1.0, 0.0) / reach_px)
    return push_pull(residual, known.astype(np.float32)) * fade[..., None]
