"""How far texels of a weight lie from a prediction: those seen at grazing angles, from afar or in the shade scatter more."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Quantiles of weight that are told apart; mistaken texels (houses, clouds) must not rule a whole one.
_BINS, _OUTLIER = 12, 6.0
_TINY = 1e-12


@dataclass(frozen=True)
class VarianceByWeight:
    """Mean square of residuals as a function of weight that only falls.

    Parameters
    ----------
    log_weight, square
        ``(n,)`` its nodes.
    """

    log_weight: np.ndarray
    square: np.ndarray

    def __call__(self, weight: np.ndarray) -> np.ndarray:
        """Mean square ``(...)`` float32 at weights ``(...)`` > 0."""
        return np.interp(np.log(weight), self.log_weight, self.square).astype(np.float32)

    def share(self, weight: np.ndarray) -> np.ndarray:
        """How much of a residual is the texel's own and not its noise, ``(...)`` in (0, 1].

        The mean square is the prediction's plus the noise's. The best-seen quarter is taken to have the former alone; the
        ratio of the two is the share that a posterior mean gives to the texel. Where all weights are equal it is 1.
        """
        best = self.square[-max(1, len(self.square) // 4) :].mean()
        return np.minimum(best / self(weight), 1.0)


def fit_variance_by_weight(residual: np.ndarray, weight: np.ndarray) -> VarianceByWeight:
    """From residuals ``(n, 3)`` about a prediction, and weights ``(n,)`` > 0 of which only the order counts."""
    square = (residual**2).mean(axis=1)
    square = np.minimum(square, _OUTLIER**2 * float(np.median(square))) + _TINY
    log_weight = np.log(weight).astype(float)
    edges = np.quantile(log_weight, np.linspace(0.0, 1.0, _BINS + 1))
    number = np.clip(np.searchsorted(edges, log_weight, side="right") - 1, 0, _BINS - 1)
    count = np.bincount(number, minlength=_BINS)
    met = count > 0
    mean = np.bincount(number, square, _BINS)[met] / count[met]
    return VarianceByWeight(np.bincount(number, log_weight, _BINS)[met] / count[met], np.minimum.accumulate(mean))
