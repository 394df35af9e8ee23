"""Low-rank basis of sky patches: principal components of daylight coefficients, weighted by the covariance of skies."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from seasonscapes.rendering.sky_patches import SkyPatches, sky_patches, sky_second_moments


@dataclass(frozen=True)
class DirectionBasis:
    """Rank-r approximation of the sum over P patches of daylight coefficient × sky radiance.

    Daylight coefficients ``(N, P)`` times ``projection`` are N vectors of r coefficients. Their product with
    ``from_sky.T @ sky`` approximates the daylight coefficients times the patch radiances ``sky``.

    Parameters
    ----------
    projection, from_sky
        ``(P, r)`` float32.
    error
        Root mean square relative error of the approximation over the modelled skies, on the examples of
        `direction_basis`.
    """

    projection: np.ndarray
    from_sky: np.ndarray
    error: float


@cache
def _root(name: str) -> np.ndarray:
    """A root L of the covariance of skies, C = L Lᵀ, lower triangular ``(P, P)``."""
    return np.linalg.cholesky(sky_second_moments(sky_patches(name)))


def direction_basis(rows: np.ndarray, patches: SkyPatches, rank: int) -> DirectionBasis:
    """Compute the principal components of daylight coefficients, weighted by the covariance of skies.

    With C = L Lᵀ the covariance of sky patch radiances, the first singular vectors of ``rows L`` minimise the mean square
    error of ``rows · sky`` over these skies (Sloan, Hall, Hart & Snyder 2003, doi:10.1145/882262.882281, with one
    cluster).

    Parameters
    ----------
    rows
        ``(N, P)`` example daylight coefficients, N several times ``rank``.
    patches
        The P sky patches.
    rank
        Number r of components; P or more keeps all.

    Returns
    -------
    DirectionBasis
        Projection, reconstruction from the sky, and approximation error.
    """
    from threadpoolctl import threadpool_limits

    # On some hundred patches, threads of BLAS wait for each other longer than they work.
    with threadpool_limits(limits=1, user_api="blas"):
        root = _root(patches.name)
        weighted = np.asarray(rows, np.float64) @ root
        power, components = np.linalg.eigh(weighted.T @ weighted)
        power, components = np.maximum(power[::-1], 0.0), components[:, ::-1][:, :rank]
        projection = root @ components
        from_sky = np.linalg.solve(root.T, components)
    # Coefficients are scaled to a standard deviation of 1, where half precision is accurate.
    scale = 1.0 / np.maximum(np.asarray(rows @ projection).std(axis=0), 1e-12)
    error = float(np.sqrt(power[rank:].sum() / max(power.sum(), 1e-300)))
    return DirectionBasis((projection * scale).astype(np.float32), (from_sky / scale).astype(np.float32), error)
