"""Subdivision of the sphere of directions into patches, for daylight coefficients.

The upper half has the usual subdivision of the sky: 145 patches (Tregenza 1987, "Subdivision of the sky hemisphere for
luminance measurements", doi:10.1177/096032718701900103) or 577 (Reinhart & Walkenhorst 2001, each divided by two both
ways, doi:10.1016/S0378-7788(01)00058-5). On mountains rays also escape *below* the horizontal, so that the lower half
is subdivided too.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from seasonscapes.frames import angles_from_direction, direction_from_angles
from seasonscapes.rendering.backend import aligned

_TREGENZA_ROWS = (30, 30, 24, 24, 18, 12, 6)
# Rows below the horizon, finer near it, where radiance varies most: (lower edge [deg], patches).
_LOWER_ROWS = ((-2.0, 30), (-5.0, 30), (-10.0, 30), (-20.0, 24), (-40.0, 12), (-90.0, 6))
# Divisions of Tregenza's patches per axis.
SUBDIVISIONS = {"tregenza": 1, "reinhart": 2}


@dataclass(frozen=True)
class SkyPatches:
    """Rows of patches of equal elevation and equal width in azimuth, clockwise, the first patch starting at north.

    Parameters
    ----------
    name
        A key of `SUBDIVISIONS`.
    edges_deg
        ``(rows + 1,)`` elevations of the edges of the rows, from 90 down to -90 [deg].
    counts
        ``(rows,)`` number of patches in each row.
    """

    name: str
    edges_deg: np.ndarray
    counts: np.ndarray

    @property
    def size(self) -> int:
        """Number P of patches on the whole sphere."""
        return int(self.counts.sum())

    @property
    def offsets(self) -> np.ndarray:
        """Index of the first patch of each row ``(rows,)``."""
        return np.cumsum(self.counts) - self.counts

    @property
    def solid_angle_sr(self) -> np.ndarray:
        """Solid angle of each patch ``(P,)`` [sr]."""
        row = 2.0 * np.pi * -np.diff(np.sin(np.radians(self.edges_deg))) / self.counts
        return np.repeat(row, self.counts)

    @property
    def directions(self) -> np.ndarray:
        """Unit vectors to the centres of the patches ``(P, 3)``."""
        row = np.repeat(np.arange(len(self.counts)), self.counts)
        middle = 0.5 * (self.edges_deg[:-1] + self.edges_deg[1:])
        middle[0] = 90.0 if self.counts[0] == 1 else middle[0]
        azimuth = (np.arange(self.size) - self.offsets[row] + 0.5) * 360.0 / self.counts[row]
        return direction_from_angles(azimuth, middle[row])


@cache
def sky_patches(name: str = "reinhart") -> SkyPatches:
    """Return the subdivision of the whole sphere whose upper half has Tregenza's 145 or Reinhart's 577 patches.

    Parameters
    ----------
    name
        ``tregenza`` or ``reinhart``.

    Returns
    -------
    SkyPatches
        The subdivision.

    Raises
    ------
    ValueError
        If the name is unknown.

    Examples
    --------
    >>> patches = sky_patches("tregenza")
    >>> int((patches.directions[:, 2] > 0.0).sum())
    145
    """
    if name not in SUBDIVISIONS:
        raise ValueError(f"sky patches: got {name!r}, expected one of {', '.join(SUBDIVISIONS)}")
    m = SUBDIVISIONS[name]
    # Rows of equal height and a circular cap of half that height (Bourgeois, Reinhart & Ward 2008).
    step = 90.0 / (len(_TREGENZA_ROWS) * m + 0.5)
    counts = np.repeat(np.array(_TREGENZA_ROWS) * m, m)
    upper = np.append(90.0, np.arange(len(counts), -1, -1) * step)
    edges = np.concatenate([upper, [edge for edge, _ in _LOWER_ROWS]])
    return SkyPatches(name, edges, np.concatenate([[1], counts[::-1], [count for _, count in _LOWER_ROWS]]))


def patch_of(patches: SkyPatches, direction: np.ndarray) -> np.ndarray:
    """Find the patch of each direction.

    Parameters
    ----------
    patches
        The subdivision.
    direction
        ``(..., 3)`` unit directions, ENU.

    Returns
    -------
    numpy.ndarray
        ``(...)`` int patch indices.
    """
    azimuth_deg, elevation_deg = angles_from_direction(direction)
    row = np.searchsorted(-patches.edges_deg, -elevation_deg, side="right") - 1
    row = np.clip(row, 0, len(patches.counts) - 1)
    count = patches.counts[row]
    return patches.offsets[row] + np.minimum((azimuth_deg * count / 360.0).astype(int), count - 1)


def mi_patch_of(patches: SkyPatches, direction: Any) -> Any:
    """Find the patch of each direction on the device.

    Parameters
    ----------
    patches
        The subdivision.
    direction
        ``mi.Vector3f`` unit directions, ENU.

    Returns
    -------
    mi.UInt32
        Patch indices.
    """
    import drjit as dr
    import mitsuba as mi

    row = mi.UInt32(0)
    for sine in np.sin(np.radians(patches.edges_deg[1:-1])):
        row += dr.select(direction.z < float(sine), mi.UInt32(1), mi.UInt32(0))
    count = dr.gather(mi.UInt32, mi.UInt32(aligned(patches.counts, np.uint32)), row)
    first = dr.gather(mi.UInt32, mi.UInt32(aligned(patches.offsets, np.uint32)), row)
    revolution = dr.atan2(direction.x, direction.y) * (0.5 / np.pi)
    revolution = dr.select(revolution < 0.0, revolution + 1.0, revolution)
    return first + dr.minimum(mi.UInt32(revolution * mi.Float(count)), count - 1)


@cache
def _averaging(name: str, height: int, width: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Weights ``(H,)`` and ``(count, W)`` that average a map of constant pixels over each row of patches, by exact overlap."""
    patches = sky_patches(name)
    map_edges = 90.0 - np.arange(height + 1) * (180.0 / height)
    column = np.arange(width) / width
    weights = []
    for row, count in enumerate(patches.counts):
        top = np.minimum(map_edges[:-1], patches.edges_deg[row])
        bottom = np.maximum(map_edges[1:], patches.edges_deg[row + 1])
        down = np.maximum(np.sin(np.radians(top)) - np.sin(np.radians(bottom)), 0.0) * (top > bottom)
        left, right = np.arange(count)[:, None] / count, np.arange(1, count + 1)[:, None] / count
        across = np.clip(np.minimum(right, column + 1.0 / width) - np.maximum(left, column), 0.0, None)
        weights.append((down / down.sum(), across * count))
    return weights


def patch_radiance(patches: SkyPatches, sky_radiance: np.ndarray) -> np.ndarray:
    """Average an equirectangular radiance map over each patch.

    Parameters
    ----------
    patches
        The subdivision.
    sky_radiance
        ``(H, W, 3)`` equirectangular map.

    Returns
    -------
    numpy.ndarray
        ``(P, 3)`` float64, in the unit of the map.
    """
    height, width = sky_radiance.shape[:2]
    radiance = np.asarray(sky_radiance, np.float64)
    weights = _averaging(patches.name, height, width)
    return np.concatenate([across @ np.tensordot(down, radiance, 1) for down, across in weights])


def patch_sums(index: np.ndarray, weight: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Compute weighted sums of selected rows of a table.

    Parameters
    ----------
    index, weight
        ``(N, K)`` row indices and their weights.
    table
        ``(P, r)``.

    Returns
    -------
    numpy.ndarray
        ``(N, r)`` sums over K of weight × row.
    """
    from scipy import sparse

    count, terms = index.shape
    start = np.arange(0, count * terms + 1, terms, dtype=np.int32)
    matrix = sparse.csr_array((weight.ravel(), index.ravel(), start), shape=(count, len(table)))
    return matrix @ table


def direction_weights(patches: SkyPatches, direction: np.ndarray) -> np.ndarray:
    """Compute the weights for interpolating a quantity per patch at one direction.

    Interpolation is linear between the centres of rows and between the centres of patches within a row, and therefore
    continuous in the direction.

    Parameters
    ----------
    patches
        The subdivision.
    direction
        ``(3,)`` unit direction, ENU.

    Returns
    -------
    numpy.ndarray
        ``(P,)``, sum 1.
    """
    azimuth_deg, elevation_deg = (float(angle) for angle in angles_from_direction(direction))
    centre = 0.5 * (patches.edges_deg[:-1] + patches.edges_deg[1:])
    centre[0] = 90.0 if patches.counts[0] == 1 else centre[0]
    upper = int(np.clip(np.searchsorted(-centre, -elevation_deg) - 1, 0, len(centre) - 2))
    share = float(np.clip((centre[upper] - elevation_deg) / (centre[upper] - centre[upper + 1]), 0.0, 1.0))
    weights = np.zeros(patches.size)
    for row, row_weight in ((upper, 1.0 - share), (upper + 1, share)):
        count = patches.counts[row]
        position = azimuth_deg * count / 360.0 - 0.5
        first = int(np.floor(position))
        weights[patches.offsets[row] + first % count] += row_weight * (1.0 - (position - first))
        weights[patches.offsets[row] + (first + 1) % count] += row_weight * (position - first)
    return weights


def sky_second_moments(patches: SkyPatches, *, patch_sigma: float = 0.15) -> np.ndarray:
    """Compute the second moments of patch radiances over a family of likely skies, each of mean radiance 1.

    The family are CIE general skies (ISO 15469:2004; Kittler, Perez & Darula 1998) for sun positions over the upper
    half, skies with narrower aureoles and with twilight arches, and ground of varying brightness.

    Parameters
    ----------
    patches
        The subdivision.
    patch_sigma
        Relative standard deviation of the radiance of each patch, independent of all others (clouds). A positive value gives the
        matrix full rank, so that any sky can be represented.

    Returns
    -------
    numpy.ndarray
        ``(P, P)``.
    """
    direction = patches.directions
    elevation = np.arcsin(np.clip(direction[:, 2], -1.0, 1.0))
    zenith_cosine = np.maximum(np.sin(elevation), 0.01)
    above = direction[:, 2] > 0.0
    share = patches.solid_angle_sr / (4.0 * np.pi)
    suns = direction[above & (elevation < np.radians(75.0))][::2]
    angle = np.arccos(np.clip(direction @ suns.T, -1.0, 1.0))
    skies = []
    # (a, b) gradation, (c, d, e) indicatrix of CIE types 1, 5, 12, 13 and 14, of a narrow aureole, and of twilight.
    for a, b, c, d, e in (
        (4.0, -0.7, 0.0, -1.0, 0.0),
        (0.0, -1.0, 0.0, -1.0, 0.0),
        (-1.0, -0.32, 10.0, -3.0, 0.45),
        (-1.0, -0.32, 16.0, -3.0, 0.30),
        (-1.0, -0.15, 16.0, -3.0, 0.30),
        (-1.0, -0.32, 60.0, -12.0, 0.3),
        (-1.0, -1.2, 4.0, -2.0, 0.2),
    ):
        gradation = 1.0 + a * np.exp(b / zenith_cosine)
        indicatrix = 1.0 + c * (np.exp(d * angle) - np.exp(d * np.pi / 2.0)) + e * np.cos(angle) ** 2
        skies.append(np.where(above[:, None], gradation[:, None] * indicatrix, 0.0))
    values = np.concatenate(skies, axis=1)
    values /= share @ values
    covariance = values @ values.T / values.shape[1]
    below = (~above).astype(float)
    return covariance + 0.3 * np.outer(below, below) + np.diag(patch_sigma**2 * np.ones(patches.size))
