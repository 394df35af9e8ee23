"""Temporal smoothing of per-frame exposure (local linear regression)."""

from __future__ import annotations

import numpy as np

# Largest deviation from the metered exposure [EV], for light that changes faster than the window.
_MOST_STOPS = 0.5


def smoothed_ev100(seconds: np.ndarray, metered_ev100: np.ndarray, *, window_s: float) -> np.ndarray:
    """Smooth the metered exposures of frames over time.

    A line is fitted around each frame with Gaussian weights (local linear regression, Cleveland 1979,
    doi:10.1080/01621459.1979.10481038, without its robustness steps). Unlike a running mean it follows a steady change
    without lag, also at the first and last frames.

    Parameters
    ----------
    seconds
        ``(T,)`` times of the frames [s], in any order.
    metered_ev100
        ``(T,)`` metered exposures [EV100].
    window_s
        Standard deviation of the weights [s]; frames much further apart keep their own exposure. 0 disables smoothing.

    Returns
    -------
    numpy.ndarray
        ``(T,)`` smoothed exposures [EV100], at most half a stop from the metered ones.

    Examples
    --------
    >>> smoothed_ev100(np.array([0.0, 60.0, 120.0]), np.array([10.0, 9.0, 8.0]), window_s=60.0).round(6).tolist()
    [10.0, 9.0, 8.0]
    """
    seconds, metered = np.asarray(seconds, float), np.asarray(metered_ev100, float)
    if window_s <= 0.0 or len(metered) < 3:
        return metered.copy()
    result = np.empty_like(metered)
    order = np.argsort(seconds)
    sorted_s = seconds[order]
    for index in range(len(metered)):
        first = np.searchsorted(sorted_s, seconds[index] - 4.0 * window_s)
        end = np.searchsorted(sorted_s, seconds[index] + 4.0 * window_s, "right")
        near = order[first:end]
        offset = (seconds[near] - seconds[index]) / window_s
        weight = np.exp(-0.5 * offset**2)
        mean = weight @ offset / weight.sum()
        value = weight @ metered[near] / weight.sum()
        variance = weight @ (offset - mean) ** 2
        slope = (weight @ ((offset - mean) * metered[near])) / variance if variance > 1e-9 else 0.0
        result[index] = value - slope * mean
    return np.clip(result, metered - _MOST_STOPS, metered + _MOST_STOPS)
