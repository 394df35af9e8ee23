"""A few numbers instead of hundreds of sky patches."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from seasonscapes.rendering.sky_patches import SkyPatches, sky_covariance, sky_patches


@dataclass(frozen=True)
class DirectionBasis:
    """Weighted sums over P patches that stand for all of them.

    Light arriving per patch ``(N, P)`` times ``into`` gives coefficients; their product with ``from_sky.T @ sky`` is,
    nearly, the sum over patches of arriving light times sky radiance.

    Parameters
    ----------
    into, from_sky
        ``(P, r)`` float32.
    error
        Root mean square relative error of that sum over the skies it was made for, on the examples it was made from.
    """

    into: np.ndarray
    from_sky: np.ndarray
    error: float


@cache
def _roots(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Square root of the skies' covariance and its inverse ``(P, P)``."""
    values, vectors = np.linalg.eigh(sky_covariance(sky_patches(name)))
    root = np.sqrt(np.maximum(values, 1e-9))
    return (vectors * root) @ vectors.T, (vectors / root) @ vectors.T


def direction_basis(rows: np.ndarray, patches: SkyPatches, rank: int) -> DirectionBasis:
    """Principal components of light arriving per patch, weighted by how skies vary.

    With C the skies' covariance, the first singular vectors of ``rows C^½`` leave the smallest mean square error of
    ``rows · sky`` over those skies (Sloan, Hall, Hart & Snyder 2003, doi:10.1145/882262.882281, with one cluster).

    Parameters
    ----------
    rows
        Examples ``(N, P)``, N several times ``rank``.
    rank
        r; P or more keeps all.
    """
    half, inverse = _roots(patches.name)
    weighted = np.asarray(rows, np.float64) @ half
    power, components = np.linalg.eigh(weighted.T @ weighted)
    power, components = np.maximum(power[::-1], 0.0), components[:, ::-1][:, :rank]
    into = half @ components
    # Coefficients of about 1 are where half precision is at its best.
    scale = 1.0 / np.maximum(np.asarray(rows @ into).std(axis=0), 1e-12)
    error = float(np.sqrt(power[rank:].sum() / max(power.sum(), 1e-300)))
    return DirectionBasis((into * scale).astype(np.float32), (inverse @ components / scale).astype(np.float32), error)
