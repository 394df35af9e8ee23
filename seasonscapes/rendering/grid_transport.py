"""Daylight coefficients over a regular grid of a terrain, compact enough to be lit by another program."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.rendering.irradiance import surface_at
from seasonscapes.rendering.light_clusters import LightClusters
from seasonscapes.rendering.transport import listed_clusters, prepare_transport, trace_points

_PILOTS = 1 << 17
_BLOCK = 1 << 17


@dataclass(frozen=True)
class GridTransport:
    """Light transport of N points for skylight and B points for reflected light; made by `grid_transport`.

    Parameters
    ----------
    sky
        ``(N, r)`` float32 daylight coefficients; irradiance / π from the sky is ``sky @ (from_sky.T @ patch radiances)``.
        Zero where there is no surface.
    cluster, share
        ``(B, K)`` uint16 clusters that a point's rays hit, and the fraction ``(B,)`` of its hemisphere that terrain covers.
    clusters
        The M clusters with their own coefficients; ``clusters.from_sky`` is the basis of all.
    """

    sky: np.ndarray
    cluster: np.ndarray
    share: np.ndarray
    clusters: LightClusters


def grid_transport(
    terrain: RayScene,
    sky_m: np.ndarray,
    bounce_m: np.ndarray,
    sampling: SamplingOptions,
    *,
    search_m: float,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> GridTransport:
    """Trace the light transport of grid points.

    Parameters
    ----------
    terrain
        From `hemisphere_rays.ray_scene`, with an albedo that decides where clusters lie.
    sky_m, bounce_m
        ``(N, 3)`` and ``(B, 3)`` positions near the surface, ENU [m]; NaN for none.
    sampling
        Rank, rays, clusters and bounces.
    search_m
        See `irradiance.surface_at`.
    seed
        Of the sampling.
    progress
        Called with the completed fraction.

    Returns
    -------
    GridTransport
        The coefficients.

    Raises
    ------
    ValueError
        If no position lies on the terrain.
    """
    report = progress or (lambda fraction: None)
    pilot, found = surface_at(terrain, _some(bounce_m, _PILOTS, seed), search_m=search_m)
    if len(found) == 0:
        raise ValueError("grid_transport: no position lies on the terrain")
    shared = prepare_transport(terrain, pilot, sampling, seed=seed)
    report(0.2)
    sky = np.zeros((len(sky_m), sampling.rank), np.float32)
    cluster = np.zeros((len(bounce_m), listed_clusters(sampling, shared.above)), np.uint16)
    share = np.zeros(len(bounce_m), np.float32)
    total = len(sky_m) + len(bounce_m)
    done = 0
    for positions, keep_sky in ((sky_m, True), (bounce_m, False)):
        for start in range(0, len(positions), _BLOCK):
            block = positions[start : start + _BLOCK]
            points, index = surface_at(terrain, block, search_m=search_m)
            if len(index):
                traced = trace_points(
                    terrain, points, sampling, shared=shared, seed=seed, number=index + start
                ).receivers
                if keep_sky:
                    sky[start + index] = traced.direct
                else:
                    cluster[start + index], share[start + index] = traced.cluster, traced.share
            done += len(block)
            report(0.2 + 0.8 * done / total)
    return GridTransport(sky, cluster, share, shared.clusters)


def _some(position_m: np.ndarray, count: int, seed: int) -> np.ndarray:
    valid = np.flatnonzero(np.isfinite(position_m).all(axis=1))
    return position_m[np.random.default_rng(seed).permutation(valid)[:count]]
