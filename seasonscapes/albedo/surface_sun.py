"""Where the sun stood when a mesh was photographed: `sun_search` on samples of any surface, overhangs and walls too.

The image's gradients are differences between samples that lie side by side in space, so that neither the layout of the
textures nor their seams matter. Cast shadows come from shadow rays in place of horizons.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from seasonscapes.albedo.sun_search import BLOCKS, FoundSun, SunSearch, search_sun

# Each sample is compared with so many of its nearest; farther than so many typical distances is another surface.
_NEIGHBOURS, _FARTHEST = 3, 4.0
# Fewer pairs of samples decide nothing.
LEAST_PAIRS = 300


@dataclass(frozen=True)
class SurfaceSamples:
    """N samples of a surface and its photographed brightness.

    Parameters
    ----------
    brightness
        ``(N,)`` linear, positive.
    position_m
        ``(N, 3)``, east-north-up [m].
    open_sky
        ``(N,)`` illuminance from a uniform sky over that of open level ground.
    from_ground
        ``(N,)`` light that the ground sends to the sample, over the illuminance of the ground.
    sunlight
        Cosine of incidence × visibility ``(N,)`` of a sun with azimuth and elevation [deg].
    """

    brightness: np.ndarray
    position_m: np.ndarray
    open_sky: np.ndarray
    from_ground: np.ndarray
    sunlight: Callable[[float, float], np.ndarray]


def neighbouring_pairs(position_m: np.ndarray) -> np.ndarray:
    """Pairs ``(P, 2)`` of samples ``(N, 3)`` that lie side by side."""
    if len(position_m) <= _NEIGHBOURS:
        return np.zeros((0, 2), int)
    distance, other = cKDTree(position_m).query(position_m, k=_NEIGHBOURS + 1)
    distance, other = distance[:, 1:], other[:, 1:]
    first = np.broadcast_to(np.arange(len(position_m))[:, None], other.shape)
    near = (distance < _FARTHEST * np.median(distance)) & (first != other)
    return np.unique(np.sort(np.stack([first[near], other[near]], axis=1), axis=1), axis=0)


def find_surface_sun(
    samples: SurfaceSamples,
    pairs: np.ndarray,
    *,
    latitude_deg: float | None = None,
    progress: Callable[[float], None] | None = None,
) -> FoundSun:
    """Estimate azimuth and elevation of the sun from the brightness of a surface.

    Parameters
    ----------
    samples
        Samples of the surface.
    pairs
        ``(P, 2)``, of `neighbouring_pairs`.
    latitude_deg, progress
        See `sun_search.find_sun`.

    Returns
    -------
    FoundSun
        With standard errors, and whether it can be trusted.
    """

    def differences(values: np.ndarray) -> np.ndarray:
        logarithm = np.log(values)
        return (logarithm[pairs[:, 1]] - logarithm[pairs[:, 0]])[None]

    def predicted(azimuth_deg: float, elevation_deg: float) -> Callable[[float], np.ndarray]:
        direct = samples.sunlight(azimuth_deg, elevation_deg)
        level = np.sin(np.radians(elevation_deg))
        return lambda share: differences(
            direct + share * samples.open_sky + samples.from_ground * (level + share) + np.float32(1e-3)
        )

    search = SunSearch(differences(samples.brightness), _blocks(samples.position_m)[pairs[:, 0]], predicted)
    return search_sun(search, latitude_deg=latitude_deg, progress=progress)


def _blocks(position_m: np.ndarray) -> np.ndarray:
    """Block ``(N,)`` of each sample, as many samples in each: stripes from west to east, cut from south to north."""

    def part(values: np.ndarray) -> np.ndarray:
        rank = np.empty(len(values), int)
        rank[np.argsort(values, kind="stable")] = np.arange(len(values))
        return rank * BLOCKS // max(len(values), 1)

    column = part(position_m[:, 0])
    block = np.zeros(len(position_m), int)
    for number in range(BLOCKS):
        here = column == number
        block[here] = part(position_m[here, 1]) * BLOCKS + number
    return block
