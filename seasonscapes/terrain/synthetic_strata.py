"""Strata of the synthetic massif, which shape its ledges and colour its rock."""

from __future__ import annotations

import numpy as np

from seasonscapes.terrain.noise import fractal_noise, spline_noise

LEDGES_M = (190.0, 92.0)  # vertical periods of the ledges along strata


def strata_level_m(z: np.ndarray, east_m: np.ndarray, north_m: np.ndarray, seed: int) -> np.ndarray:
    """Compute the stratigraphic height within folded, gently dipping strata, which ledges and rock bands follow.

    Parameters
    ----------
    z
        Heights ``(H, W)`` [m].
    east_m, north_m
        Axes ``(W,)`` and ``(H,)`` of the grid about its centre [m].
    seed
        Seed of the folds.

    Returns
    -------
    numpy.ndarray
        ``(H, W)`` [m]; constant within a stratum.
    """
    fold = 70.0 * spline_noise(seed + 51, 4000.0, east_m, north_m)
    fold += 26.0 * fractal_noise(seed + 52, 900.0, east_m, north_m, octaves=3)
    return z + fold + 0.13 * east_m[None, :] - 0.09 * north_m[:, None]
