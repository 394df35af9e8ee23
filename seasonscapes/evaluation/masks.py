"""Evaluation masks: terrain within a range of distances, and the mask of the reference evaluation."""

from __future__ import annotations

import numpy as np

# Nearer pixels often show roofs or trees that the terrain model lacks; painting excludes them as well.
NEAR_M = 60.0


def terrain_mask(depth_m: np.ndarray, *, near_m: float = NEAR_M, far_m: float = np.inf) -> np.ndarray:
    """Return the mask of pixels that show terrain between two distances.

    Parameters
    ----------
    depth_m
        Distance ``(H, W)`` along the ray [m]; infinite in the sky.
    near_m, far_m
        Minimum and maximum distance [m].

    Returns
    -------
    ndarray
        ``(H, W)`` bool.

    Raises
    ------
    ValueError
        If a depth is NaN or negative, or the distances are not in order.

    Examples
    --------
    >>> terrain_mask(np.array([[10.0, 500.0, np.inf]]))
    array([[False,  True, False]])
    """
    depth_m = np.asarray(depth_m)
    if not (depth_m >= 0.0).all():
        raise ValueError("terrain_mask: depth is negative or NaN")
    if not 0.0 <= near_m < far_m:
        raise ValueError(f"terrain_mask: got near_m = {near_m}, far_m = {far_m}, expected 0 ≤ near_m < far_m")
    return np.isfinite(depth_m) & (depth_m >= near_m) & (depth_m <= far_m)


def reference_mask(depth_m: np.ndarray, *, share: float = 0.45) -> np.ndarray:
    """Return the mask of the reference evaluation: no sky, and not the nearest fraction of the terrain.

    The depth is normalised to 0.5 (nearest) … 1 (farthest), sky 0. A histogram of 256 bins over [0, 1], without its
    first bin, is cumulated; the mask contains the pixels beyond the bin at which it reaches ``share``. As in the
    reference code, the index of that bin is not corrected for the removed first bin, so the threshold is one bin too
    near.

    Parameters
    ----------
    depth_m
        Distance ``(H, W)`` along the ray [m]; infinite in the sky.
    share
        Fraction of the terrain pixels to exclude.

    Returns
    -------
    ndarray
        ``(H, W)`` bool.
    """
    depth_m = np.asarray(depth_m, np.float64)
    terrain = np.isfinite(depth_m)
    if not terrain.any():
        return terrain
    near, far = depth_m[terrain].min(), depth_m[terrain].max()
    level = np.where(terrain, 0.5 + 0.5 * (np.where(terrain, depth_m, near) - near) / max(far - near, 1e-9), 0.0)
    counts = np.histogram(level, bins=256, range=(0.0, 1.0))[0][1:]
    cumulated = np.cumsum(counts) / counts.sum()
    return level > np.searchsorted(cumulated, share) / 255.0
