"""Weight of one camera's observation of a texel, and the empirical variance of texels as a function of that weight."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Image resolution beyond this many pixels per texel side does not raise the weight.
_SUFFICIENT_PX = 1.5
# Exponent of the blending weights: the best observation dominates, the others soften its border.
SHARPNESS = 4.0
# Confidence of pixels near either end of the tonal range: used only where no better observation exists. Clipped pixels
# get 0: snow of which only the blue channel is clipped would otherwise turn yellow.
_EXTREME_CONFIDENCE = 0.02
BRIGHTEST, DARKEST, _CLIPPED = 0.9, 0.002, 0.985
# Number of quantile bins of the weight, and the limit of squared residuals in squared multiples of their root median:
# wrongly painted texels (houses, clouds) must not dominate a bin.
_BINS, _OUTLIER = 12, 6.0
_TINY = 1e-12


def texel_weight(cosine: np.ndarray, px_per_texel: np.ndarray) -> np.ndarray:
    """Compute ``cos θ · min(pixels per texel, 1.5)²``, scaled to at most 1.

    Parameters
    ----------
    cosine
        ``(...)`` cosine of the angle between the face's normal and the direction to the camera; negative counts as 0.
    px_per_texel
        ``(...)`` pixels along a texel's side at normal incidence.

    Returns
    -------
    ndarray
        ``(...)`` float32 in [0, 1].

    Examples
    --------
    >>> import numpy as np
    >>> texel_weight(np.array([1.0, 0.5, -0.2]), np.array([1.5, 0.75, 3.0])).tolist()
    [1.0, 0.125, 0.0]
    """
    return (np.maximum(cosine, 0.0) * (np.minimum(px_per_texel, _SUFFICIENT_PX) / _SUFFICIENT_PX) ** 2).astype(
        np.float32
    )


def exposure_confidence(image: np.ndarray) -> np.ndarray:
    """Return the confidence of each pixel by its brightest channel: low near either end of the range, 0 where clipped.

    Parameters
    ----------
    image
        ``(H, W, 3)`` decoded values in [0, 1].

    Returns
    -------
    ndarray
        ``(H, W)`` float32 in [0, 1].
    """
    brightest = image.max(axis=2)
    confidence = np.where((brightest < BRIGHTEST) & (brightest > DARKEST), 1.0, _EXTREME_CONFIDENCE)
    return np.where(brightest < _CLIPPED, confidence, 0.0).astype(np.float32)


def sharpened(weight: np.ndarray) -> np.ndarray:
    """Return blending weights: texel weights to the power `SHARPNESS`.

    Parameters
    ----------
    weight
        ``(...)`` from `texel_weight`, times confidences.

    Returns
    -------
    ndarray
        ``(...)`` float64.
    """
    return np.asarray(weight, np.float64) ** SHARPNESS


@dataclass(frozen=True)
class VarianceByWeight:
    """Empirical residual variance as a non-increasing, piecewise linear function of the logarithm of weight.

    Parameters
    ----------
    log_weight
        ``(n,)`` nodes: mean logarithm of the weight in each bin, increasing.
    variance
        ``(n,)`` mean square of the residuals at the nodes.
    """

    log_weight: np.ndarray
    variance: np.ndarray

    def __call__(self, weight: np.ndarray) -> np.ndarray:
        """Return the residual variance ``(...)`` float32 at weights ``(...)`` > 0."""
        return np.interp(np.log(weight), self.log_weight, self.variance).astype(np.float32)

    def shrinkage(self, weight: np.ndarray) -> np.ndarray:
        """Return the shrinkage factor of a residual ``(...)`` in (0, 1]: signal variance over total variance.

        Parameters
        ----------
        weight
            ``(...)`` > 0.

        Notes
        -----
        The total variance is that of the prediction plus that of the observation noise. The quarter of nodes of the
        greatest weight is taken to be free of observation noise; the ratio of the two is the factor by which a
        posterior mean keeps the residual. It is 1 where all weights are equal.
        """
        best = self.variance[-max(1, len(self.variance) // 4) :].mean()
        return np.minimum(best / self(weight), 1.0)


def fit_variance_by_weight(residual: np.ndarray, weight: np.ndarray) -> VarianceByWeight:
    """Estimate the residual variance in quantile bins of weight, monotone by a running minimum.

    Parameters
    ----------
    residual
        ``(n, C)`` differences of texels from a prediction.
    weight
        ``(n,)`` > 0; only their order matters.

    Returns
    -------
    VarianceByWeight
        With one node per occupied bin.
    """
    square = (residual**2).mean(axis=1)
    square = np.minimum(square, _OUTLIER**2 * float(np.median(square))) + _TINY
    log_weight = np.log(weight).astype(float)
    edges = np.quantile(log_weight, np.linspace(0.0, 1.0, _BINS + 1))
    bin_index = np.clip(np.searchsorted(edges, log_weight, side="right") - 1, 0, _BINS - 1)
    count = np.bincount(bin_index, minlength=_BINS)
    occupied = count > 0
    mean = np.bincount(bin_index, square, _BINS)[occupied] / count[occupied]
    return VarianceByWeight(
        np.bincount(bin_index, log_weight, _BINS)[occupied] / count[occupied], np.minimum.accumulate(mean)
    )
