"""Exposure that follows the light of a film as a patient photographer's would: without flicker, without lag."""

from __future__ import annotations

import numpy as np

# Smoothing takes flicker out; it may not darken a dusk that falls faster than the window is wide.
_MOST_STOPS = 0.5


def smoothed_ev100(seconds: np.ndarray, metered_ev100: np.ndarray, *, window_s: float) -> np.ndarray:
    """EV100 of every frame from what each was metered at, smoothed over time.

    A line is fitted around each frame with Gaussian weights (local linear regression, Cleveland 1979,
    doi:10.1080/01621459.1979.10481038, without its robustness steps), so that a steady dusk is followed at its own
    pace: a plain running mean would lag behind at both ends of a film.

    Parameters
    ----------
    seconds
        Times ``(T,)`` of the frames [s], in any order.
    metered_ev100
        ``(T,)``.
    window_s
        Standard deviation of the weights [s]; frames much further apart than this keep their own exposure. 0: no
        smoothing.
    """
    seconds, metered = np.asarray(seconds, float), np.asarray(metered_ev100, float)
    if window_s <= 0.0 or len(metered) < 3:
        return metered.copy()
    result = np.empty_like(metered)
    order = np.argsort(seconds)
    at = seconds[order]
    for index in range(len(metered)):
        near = order[
            np.searchsorted(at, seconds[index] - 4.0 * window_s) : np.searchsorted(
                at, seconds[index] + 4.0 * window_s, "right"
            )
        ]
        offset = (seconds[near] - seconds[index]) / window_s
        weight = np.exp(-0.5 * offset**2)
        mean = weight @ offset / weight.sum()
        value = weight @ metered[near] / weight.sum()
        spread = weight @ (offset - mean) ** 2
        slope = (weight @ ((offset - mean) * metered[near])) / spread if spread > 1e-9 else 0.0
        result[index] = value - slope * mean
    return np.clip(result, metered - _MOST_STOPS, metered + _MOST_STOPS)
