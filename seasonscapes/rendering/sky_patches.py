"""The sphere of directions in patches: where a ray that leaves the terrain is counted.

The upper half is the subdivision of daylight coefficients: 145 patches (Tregenza 1987, "Subdivision of the sky hemisphere
for luminance measurements", doi:10.1177/096032718701900103) or 577 (Reinhart & Walkenhorst 2001, each divided by two both
ways, doi:10.1016/S0378-7788(00)00119-2). Mountains also see *below* the horizontal, so the lower half has patches too.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from seasonscapes.frames import angles_from_direction, direction_from_angles

_TREGENZA_ROWS = (30, 30, 24, 24, 18, 12, 6)
# Below the horizon light changes fast near the horizon and little further down: (lower edge [deg], patches).
_LOWER_ROWS = ((-2.0, 30), (-5.0, 30), (-10.0, 30), (-20.0, 24), (-40.0, 12), (-90.0, 6))
SUBDIVISIONS = {"tregenza": 1, "reinhart": 2}


@dataclass(frozen=True)
class SkyPatches:
    """Rows of equal elevation, each cut into equal azimuths, the first patch of a row beginning at north, clockwise.

    Parameters
    ----------
    name
        A key of `SUBDIVISIONS`.
    edges_deg
        Elevations ``(rows + 1,)`` of the rows' edges, from 90 down to -90 [deg].
    counts
        Patches in each row ``(rows,)``.
    """

    name: str
    edges_deg: np.ndarray
    counts: np.ndarray

    @property
    def size(self) -> int:
        """P, the number of patches on the whole sphere."""
        return int(self.counts.sum())

    @property
    def offsets(self) -> np.ndarray:
        """Index of each row's first patch ``(rows,)``."""
        return np.cumsum(self.counts) - self.counts

    @property
    def solid_angle_sr(self) -> np.ndarray:
        """Solid angle of each patch ``(P,)`` [sr]."""
        row = 2.0 * np.pi * -np.diff(np.sin(np.radians(self.edges_deg))) / self.counts
        return np.repeat(row, self.counts)

    @property
    def directions(self) -> np.ndarray:
        """Unit vectors to the patches' centres ``(P, 3)``."""
        row = np.repeat(np.arange(len(self.counts)), self.counts)
        middle = 0.5 * (self.edges_deg[:-1] + self.edges_deg[1:])
        middle[0] = 90.0 if self.counts[0] == 1 else middle[0]
        azimuth = (np.arange(self.size) - self.offsets[row] + 0.5) * 360.0 / self.counts[row]
        return direction_from_angles(azimuth, middle[row])


@cache
def sky_patches(name: str = "reinhart") -> SkyPatches:
    """The whole sphere in patches; the upper half is Tregenza's 145 or Reinhart's 577.

    Raises
    ------
    ValueError
        For an unknown name.
    """
    if name not in SUBDIVISIONS:
        raise ValueError(f"sky patches: got {name!r}, expected one of {', '.join(SUBDIVISIONS)}")
    m = SUBDIVISIONS[name]
    # Rows of equal height up to a round cap of half that height (Bourgeois, Reinhart & Ward 2008).
    step = 90.0 / (len(_TREGENZA_ROWS) * m + 0.5)
    counts = np.repeat(np.array(_TREGENZA_ROWS) * m, m)
    upper = np.append(90.0, np.arange(len(counts), -1, -1) * step)
    edges = np.concatenate([upper, [edge for edge, _ in _LOWER_ROWS]])
    return SkyPatches(name, edges, np.concatenate([[1], counts[::-1], [count for _, count in _LOWER_ROWS]]))


def patch_of(patches: SkyPatches, direction: np.ndarray) -> np.ndarray:
    """Index of the patch of each direction ``(..., 3)``, ``(...)`` int."""
    azimuth_deg, elevation_deg = angles_from_direction(direction)
    row = np.searchsorted(-patches.edges_deg, -elevation_deg, side="right") - 1
    row = np.clip(row, 0, len(patches.counts) - 1)
    count = patches.counts[row]
    return patches.offsets[row] + np.minimum((azimuth_deg * count / 360.0).astype(int), count - 1)


def mi_patch_of(patches: SkyPatches, direction: Any) -> Any:
    """The same for lanes of Mitsuba vectors: ``mi.UInt32``."""
    import drjit as dr
    import mitsuba as mi

    row = mi.UInt32(0)
    for sine in np.sin(np.radians(patches.edges_deg[1:-1])):
        row += dr.select(direction.z < float(sine), mi.UInt32(1), mi.UInt32(0))
    count = dr.gather(mi.UInt32, mi.UInt32(patches.counts.astype(np.uint32)), row)
    first = dr.gather(mi.UInt32, mi.UInt32(patches.offsets.astype(np.uint32)), row)
    turn = dr.atan2(direction.x, direction.y) * (0.5 / np.pi)
    turn = dr.select(turn < 0.0, turn + 1.0, turn)
    return first + dr.minimum(mi.UInt32(turn * mi.Float(count)), count - 1)


@cache
def _averaging(name: str, height: int, width: int) -> Any:
    """Sparse ``(P, H W)``: mean over each patch of a map whose pixels are constant, by exact overlap."""
    from scipy import sparse

    patches = sky_patches(name)
    map_edges = 90.0 - np.arange(height + 1) * (180.0 / height)
    blocks = []
    for row, count in enumerate(patches.counts):
        top = np.minimum(map_edges[:-1], patches.edges_deg[row])
        bottom = np.maximum(map_edges[1:], patches.edges_deg[row + 1])
        weight = np.maximum(np.sin(np.radians(top)) - np.sin(np.radians(bottom)), 0.0) * (top > bottom)
        left, right = np.arange(count)[:, None] / count, np.arange(1, count + 1)[:, None] / count
        column = np.arange(width) / width
        across = np.clip(np.minimum(right, column + 1.0 / width) - np.maximum(left, column), 0.0, None)
        blocks.append(
            sparse.csr_array(np.einsum("h,aw->ahw", weight / weight.sum(), across * count).reshape(count, -1))
        )
    return sparse.vstack(blocks).tocsr()


def patch_radiance(patches: SkyPatches, sky_radiance: np.ndarray) -> np.ndarray:
    """Mean radiance ``(P, 3)`` over each patch of an equirectangular map ``(H, W, 3)``."""
    height, width = sky_radiance.shape[:2]
    return _averaging(patches.name, height, width) @ np.asarray(sky_radiance, np.float64).reshape(height * width, -1)


def direction_weights(patches: SkyPatches, direction: np.ndarray) -> np.ndarray:
    """Piecewise linear weights ``(P,)``, sum 1, of the patches around one direction ``(3,)``.

    Linear between the centres of rows, and between centres within each row: a quantity known per patch moves without
    steps when a direction does.
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


def sky_covariance(patches: SkyPatches, *, unrest: float = 0.15) -> np.ndarray:
    """How the radiances of patches vary together over likely skies ``(P, P)``, each sky of mean radiance 1.

    Skies of the CIE general family (ISO 15469:2004; Kittler, Perez & Darula 1998) for suns all over the upper half,
    with narrower aureoles added, twilight arches, and ground of any brightness; ``unrest`` is the relative deviation
    of each single patch on its own (clouds), which keeps every sky representable.
    """
    direction = patches.directions
    elevation = np.arcsin(np.clip(direction[:, 2], -1.0, 1.0))
    zenith_cosine = np.maximum(np.sin(elevation), 0.01)
    above = direction[:, 2] > 0.0
    share = patches.solid_angle_sr / (4.0 * np.pi)
    suns = direction[above & (elevation < np.radians(75.0))][::2]
    angle = np.arccos(np.clip(direction @ suns.T, -1.0, 1.0))
    skies = []
    # (a, b) gradation, (c, d, e) indicatrix of CIE types 1, 5, 12, 13 and 14, then a narrow aureole, then dusk.
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
    return covariance + 0.3 * np.outer(below, below) + np.diag(unrest**2 * np.ones(patches.size))
