"""Shift between a lit image and the light predicted for it, by cross-correlation of their gradients.

Brightness follows relief and shadows, so the gradients of log image and log predicted irradiance agree where image and
heights lie over each other; those of the land itself have no reason to. Both gradients are normalised by their local
energy, so that a few strong borders do not decide alone.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.ndimage import shift as spline_shift

# Farther than this an image is not misregistered but wrongly georeferenced [texels].
_FARTHEST = 6
# A peak that rises less than this above the scatter of the correlation elsewhere is chance.
_LEAST_PEAK = 5.0
_SMOOTHING = 0.8


def texture_shift(image: np.ndarray, prediction: np.ndarray, known: np.ndarray) -> tuple[float, float] | None:
    """Estimate by how many texels an image is displaced against a prediction of it.

    Parameters
    ----------
    image
        ``(R, S)`` positive brightness.
    prediction
        ``(R, S)`` positive predicted irradiance.
    known
        ``(R, S)`` bool: texels where both are valid.

    Returns
    -------
    tuple of float or None
        Rows and columns by which the image lies further than the prediction; ``None`` where the correlation has no
        distinct peak within 6 texels.
    """
    first, second = (_gradients(values, known) for values in (image, prediction))
    spectrum = sum(np.conj(np.fft.rfft2(other)) * np.fft.rfft2(one) for one, other in zip(first, second, strict=True))
    correlation = np.fft.irfft2(spectrum, s=known.shape)
    offsets = np.arange(-_FARTHEST, _FARTHEST + 1)
    near = correlation[np.ix_(offsets % known.shape[0], offsets % known.shape[1])]
    row, column = np.unravel_index(np.argmax(near), near.shape)
    far = correlation[_FARTHEST + 1 : -_FARTHEST, _FARTHEST + 1 : -_FARTHEST]
    distinct = far.size > 0 and near[row, column] > _LEAST_PEAK * float(np.std(far))
    if not distinct or not (0 < row < 2 * _FARTHEST and 0 < column < 2 * _FARTHEST):
        return None
    # The peak of the quadratic through three values along each axis.
    fine = []
    for values in (near[row - 1 : row + 2, column], near[row, column - 1 : column + 2]):
        curvature = values[0] - 2.0 * values[1] + values[2]
        fine.append(0.5 * (values[0] - values[2]) / curvature if curvature < 0.0 else 0.0)
    return float(offsets[row] + fine[0]), float(offsets[column] + fine[1])


def _gradients(values: np.ndarray, known: np.ndarray) -> list[np.ndarray]:
    """Gradients along rows and columns, normalised by their local energy; 0 beside unknown texels."""
    logarithm = np.log(np.where(known, np.maximum(values, 1e-6), 1.0))
    share = np.maximum(gaussian_filter(known.astype(float), _SMOOTHING), 1e-3)
    smooth = gaussian_filter(np.where(known, logarithm, 0.0), _SMOOTHING) / share
    inside = gaussian_filter((~known).astype(float), _SMOOTHING) < 1e-3
    gradients = [np.where(inside, np.gradient(smooth, axis=axis), 0.0) for axis in (0, 1)]
    energy = np.sqrt(gaussian_filter(gradients[0] ** 2 + gradients[1] ** 2, 4.0))
    return [gradient / (energy + np.median(energy) + 1e-9) for gradient in gradients]


def shifted_back(values: np.ndarray, shift: tuple[float, float], *, order: int = 3) -> np.ndarray:
    """Move an image back by a shift, by interpolation with splines.

    Parameters
    ----------
    values
        ``(R, S, C)``; NaN where unknown.
    shift
        Rows and columns by which the image lies too far.
    order
        Of the splines: 3, or 1 for what must not overshoot, or 0 for the nearest value.

    Returns
    -------
    numpy.ndarray
        ``(R, S, C)`` float32, within the range of the values; NaN where a source texel is unknown.
    """
    known = np.isfinite(values).all(axis=2)
    back = (-shift[0], -shift[1])
    result = np.empty(values.shape, np.float32)
    for channel in range(values.shape[2]):
        plane = np.where(known, values[..., channel], 0.0).astype(np.float64)
        moved = spline_shift(plane, back, order=order, mode="nearest")
        result[..., channel] = np.clip(moved, plane.min(), plane.max())
    valid = spline_shift(known.astype(np.float32), back, order=min(order, 1), mode="constant", cval=0.0) > 0.99
    return np.where(valid[..., None], result, np.float32(np.nan))
