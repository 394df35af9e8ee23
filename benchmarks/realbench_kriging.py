"""What a model leaves in the pictures of a fixed camera, predicted for another instant by a Gaussian process (kriging).

Pictures taken under like conditions leave like residuals: shade of crowns and gullies below the raster, snow of the week,
the camera's sharpening. Each picture is one point in a space of conditions; all pixels share a squared exponential
covariance, whose range and noise are those with the smallest error when each picture in turn is left out. That error has
a closed form (Rasmussen & Williams 2006, "Gaussian Processes for Machine Learning", § 5.4.2), and needs the products of
the pictures with each other alone.
"""

from __future__ import annotations

import numpy as np

_RANGES = (0.7, 1.0, 1.5, 2.2, 3.2, 5.0, 8.0)
_NOISES = (0.03, 0.1, 0.3, 1.0, 3.0, 30.0)


def kriged(known: np.ndarray, asked: np.ndarray, residual: np.ndarray) -> np.ndarray:
    """Predict the residual of another picture.

    Parameters
    ----------
    known
        ``(K, f)`` conditions of the K pictures; each column is divided by its standard deviation.
    asked
        ``(f,)`` conditions of the other one.
    residual
        ``(K, ...)`` residuals, whose mean is taken to be zero.

    Returns
    -------
    numpy.ndarray
        ``(...)``: nearly zero for conditions unlike all of the pictures'.
    """
    weights = kriging_weights(known, asked, gram(residual))
    return np.tensordot(weights, residual, 1)


def gram(residual: np.ndarray) -> np.ndarray:
    """Mean products ``(K, K)`` of the pictures' residuals."""
    flat = residual.reshape(len(residual), -1)
    return flat @ flat.T / flat.shape[1]


def kriging_weights(known: np.ndarray, asked: np.ndarray, products: np.ndarray) -> np.ndarray:
    """Weights ``(K,)`` of the pictures for `kriged`, from the products of their residuals (`gram`)."""
    spread = known.std(axis=0) + 1e-6
    points, point = known / spread, asked / spread
    squared = ((points[:, None] - points[None]) ** 2).sum(axis=-1)
    best, chosen = np.inf, (_RANGES[-1], _NOISES[-1])
    for length in _RANGES:
        covariance = np.exp(-0.5 * squared / length**2)
        for noise in _NOISES:
            inverse = np.linalg.inv(covariance + noise * np.eye(len(known)))
            left_out = inverse / np.diag(inverse)[:, None]
            error = float(np.einsum("ij,jk,ik->", left_out, products, left_out))
            if error < best:
                best, chosen = error, (length, noise)
    length, noise = chosen
    covariance = np.exp(-0.5 * squared / length**2) + noise * np.eye(len(known))
    return np.linalg.solve(covariance, np.exp(-0.5 * ((points - point) ** 2).sum(axis=1) / length**2))
