"""Which pixels count: land at a distance that can be judged, by metric depth; and the reference evaluation's own rule."""

from __future__ import annotations

import numpy as np

# What is nearer than this is rather a roof or a tree than the terrain model's ground; painting leaves it out, too.
NEAR_M = 60.0


def land_mask(depth_m: np.ndarray, *, near_m: float = NEAR_M, far_m: float = np.inf) -> np.ndarray:
    """Pixels ``(H, W)`` bool that show land between two distances; infinite depth is sky.

    Raises
    ------
    ValueError
        Depth is NaN or negative somewhere, or the distances are not in order.
    """
    depth_m = np.asarray(depth_m)
    if not (depth_m >= 0.0).all():
        raise ValueError("land_mask: depth is negative or NaN")
    if not 0.0 <= near_m < far_m:
        raise ValueError(f"land_mask: near_m = {near_m}, far_m = {far_m}, expected 0 ≤ near_m < far_m")
    return np.isfinite(depth_m) & (depth_m >= near_m) & (depth_m <= far_m)


def reference_mask(depth_m: np.ndarray, *, share: float = 0.45) -> np.ndarray:
    """The mask of the reference evaluation: without the sky, and without about the nearest share of the land.

    Depth along the view is normalised to 0.5 (near) … 1 (far), sky 0; a histogram of 256 bins over [0, 1] loses its
    first bin; the mask is what lies beyond the bin where the cumulated histogram reaches the share. The bin's index is
    used as a level without the bin that was dropped, so that the cut lies one bin too near. All of that is kept.
    """
    depth_m = np.asarray(depth_m, np.float64)
    land = np.isfinite(depth_m)
    if not land.any():
        return land
    near, far = depth_m[land].min(), depth_m[land].max()
    level = np.where(land, 0.5 + 0.5 * (np.where(land, depth_m, near) - near) / max(far - near, 1e-9), 0.0)
    counts = np.histogram(level, bins=256, range=(0.0, 1.0))[0][1:]
    cumulated = np.cumsum(counts) / counts.sum()
    return level > np.searchsorted(cumulated, share) / 255.0
