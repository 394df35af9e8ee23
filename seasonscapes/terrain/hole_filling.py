"""Harmonic interpolation over raster cells without data."""

from __future__ import annotations

import numpy as np


def harmonic_fill(values: np.ndarray, hole: np.ndarray) -> np.ndarray:
    """Replace missing cells by the discrete solution of Laplace's equation ∇²z = 0.

    Jacobi-preconditioned conjugate gradients on the missing cells, started from a coarse-to-fine (push-pull) estimate.
    Known cells are Dirichlet conditions; the raster's edge has zero normal derivative.

    Parameters
    ----------
    values
        ``(H, W)`` grid; values in ``hole`` are not used.
    hole
        ``(H, W)`` bool, True where data are missing.

    Returns
    -------
    numpy.ndarray
        ``(H, W)`` with the cells of ``hole`` filled.

    Raises
    ------
    ValueError
        The conjugate gradients did not converge.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.linalg import LinearOperator, cg

    height, width = values.shape
    guess = _push_pull(np.where(hole, np.nan, values))
    index = np.full(values.shape, -1, np.int64)
    count = int(hole.sum())
    index[hole] = np.arange(count)
    row, column = np.nonzero(hole)
    degree, known = np.zeros(count), np.zeros(count)
    pairs = []
    for d_row, d_column in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        r, c = row + d_row, column + d_column
        inside = (r >= 0) & (r < height) & (c >= 0) & (c < width)
        degree += inside
        r, c = np.clip(r, 0, height - 1), np.clip(c, 0, width - 1)
        neighbour = index[r, c]
        known += np.where(inside & (neighbour < 0), np.where(hole[r, c], 0.0, values[r, c]), 0.0)
        linked = np.nonzero(inside & (neighbour >= 0))[0]
        pairs.append((linked, neighbour[linked]))
    i, j = (np.concatenate(part) for part in zip(*pairs, strict=True))
    laplacian = coo_array((-np.ones(len(i)), (i, j)), shape=(count, count)).tocsr()
    laplacian.setdiag(degree)
    jacobi = LinearOperator((count, count), matvec=lambda v: v / degree)  # pyright: ignore[reportCallIssue]
    # A residual of 1 mm is far below the error of any elevation raster (float32 resolves 0.2 mm at 4,000 m).
    limit = 20 * (height + width)
    solution, failed = cg(laplacian, known, x0=guess[hole], rtol=0.0, atol=1e-3, maxiter=limit, M=jacobi)
    if failed:
        raise ValueError(f"harmonic_fill: conjugate gradients did not converge in {failed} steps")
    filled = values.copy()
    filled[hole] = solution
    return filled


def _push_pull(values: np.ndarray) -> np.ndarray:
    """Fill NaN from the next coarser level of a mean pyramid (push-pull, Grossman & Dally 1998)."""
    if np.isfinite(values).all():
        return values
    height, width = values.shape
    padded = np.pad(values, ((0, height % 2), (0, width % 2)), constant_values=np.nan)
    coarse = _push_pull(nan_mean(padded.reshape(padded.shape[0] // 2, 2, padded.shape[1] // 2, 2), axes=(1, 3)))
    return np.where(np.isfinite(values), values, np.repeat(np.repeat(coarse, 2, 0), 2, 1)[:height, :width])


def nan_mean(values: np.ndarray, axes: int | tuple[int, ...]) -> np.ndarray:
    """Compute the mean over axes, ignoring non-finite values.

    Parameters
    ----------
    values
        Array of any shape.
    axes
        Axes to average over.

    Returns
    -------
    numpy.ndarray
        Mean of the finite values; NaN where there are none.
    """
    known = np.isfinite(values)
    count = known.sum(axis=axes)
    total = np.where(known, values, 0.0).sum(axis=axes)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
