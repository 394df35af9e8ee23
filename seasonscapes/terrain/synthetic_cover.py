"""Ground cover classes of the synthetic massif from height, slope, aspect, concavity, ice and drainage."""

from __future__ import annotations

from enum import IntEnum
from typing import TYPE_CHECKING

import cv2
import numpy as np

from seasonscapes.terrain.noise import fractal_noise
from seasonscapes.terrain.synthetic_massif import slope_and_northness

if TYPE_CHECKING:
    # Its erosion and flow import a third of scipy, which the albedo of a massif does not need.
    from seasonscapes.terrain.synthetic_relief import Relief


class Cover(IntEnum):
    """Ground cover classes, with their values in the cover map."""

    WATER = 0
    MEADOW = 1
    CONIFER = 2
    LARCH = 3
    BROADLEAF = 4
    SHRUB = 5
    SCREE = 6
    ROCK = 7
    ICE = 8
    FIRN = 9
    FIELD = 10


FOREST = (Cover.CONIFER, Cover.LARCH, Cover.BROADLEAF)


def ground_cover(relief: Relief, spacing_m: float, seed: int, east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
    """Classify the ground cover by thresholds on terrain attributes, perturbed by noise.

    Parameters
    ----------
    relief
        Elevation, ice, catchments and valley floor.
    spacing_m
        Cell size [m].
    seed
        Seed of the noise.
    east_m, north_m
        Axes ``(W,)`` and ``(H,)`` of the grid about its centre [m].

    Returns
    -------
    numpy.ndarray
        `Cover` classes ``(H, W)`` uint8.
    """
    z = relief.elevation
    slope, north = slope_and_northness(cv2.GaussianBlur(z, (0, 0), 12.0 / spacing_m + 0.2), spacing_m)
    large = fractal_noise(seed + 201, 1500.0, east_m, north_m, octaves=6, gain=0.6)
    small = fractal_noise(seed + 231, 240.0, east_m, north_m, octaves=4, gain=0.7)
    concavity = cv2.GaussianBlur(z, (0, 0), 75.0 / spacing_m) - z  # positive in gullies [m]
    cover = np.full(z.shape, Cover.MEADOW, np.uint8)
    tree_line = 1930.0 - 70.0 * north + 80.0 * large + 25.0 * small
    # Forest grows on slopes too steep for mowing; above 1250 m it is sparse in gullies (avalanche tracks).
    forest_index = 1.0 * large + 0.55 * small + (slope - 22.0) / 9.0 + 0.8 * north - (z - 1300.0) / 1300.0
    forest_index -= np.where(z > 1250.0, np.clip(concavity - 9.0, 0.0, 12.0) / 8.0, 0.0)
    forest = (forest_index > 0.0) & (z < tree_line)
    cover[forest] = Cover.CONIFER
    cover[forest & (z < 1130.0 + 140.0 * large) & (small + 0.5 * large - 0.8 * north > 0.2)] = Cover.BROADLEAF
    cover[forest & (z > tree_line - 380.0 - 90.0 * small) & (small - 0.3 * large > -0.1)] = Cover.LARCH
    shrub = (z > tree_line - 80.0) & (z < tree_line + 260.0) & (forest_index + 0.6 * small > 0.8)
    shrub |= forest & (concavity > 12.0) & (slope > 36.0) & (z > 1250.0)
    cover[shrub] = Cover.SHRUB
    arable = (slope < 6.0) & (z < 1100.0) & (relief.floor.shore_m > 40.0)
    cover[arable & (large + 0.4 * small > -0.5)] = Cover.FIELD
    # Soil depth decreases with height and slope; below the tree line, vegetation stabilises slopes up to about 47°.
    bare_index = (z - 2330.0 - 150.0 * large - 120.0 * small + 120.0 * north) / 230.0 + (slope - 36.0) / 7.0
    bare_index = np.where(z < tree_line, np.minimum(bare_index, (slope - 47.0 - 3.0 * small) / 4.0), bare_index)
    cover[bare_index > 0.0] = Cover.SCREE
    rock_index = (
        (slope - 38.5 - 3.0 * small) / 4.0 - np.clip(concavity, -12.0, 12.0) / 9.0 + np.maximum(z - 2700.0, 0.0) / 900.0
    )
    cover[(bare_index > 0.0) & ((rock_index > 0.0) | (slope > 47.0))] = Cover.ROCK
    # Glacier forefields, deglaciated since about 1850, are unvegetated.
    forefield = cv2.GaussianBlur((relief.ice_m > 0.0).astype(np.float32), (0, 0), 130.0 / spacing_m)
    deglaciated = (forefield + 0.05 * small > 0.13) & (cover != Cover.ROCK) & (z > 1300.0)
    cover[deglaciated] = Cover.SCREE
    cover[relief.ice_m > 0.0] = Cover.ICE
    firn = z > 3060.0 - 260.0 * north + 70.0 * large + 60.0 * small - 6.0 * np.clip(concavity, -15.0, 15.0)
    firn &= slope < 41.0 + 4.0 * small + 0.3 * np.clip(concavity, -10.0, 15.0)
    # Crests are kept free of firn by wind erosion.
    firn &= concavity > -11.0 - 4.0 * small
    cover[firn] = Cover.FIRN
    river = (relief.catchment_m2 > 9e6) & (relief.ice_m <= 0.0) & (z < 1400.0)
    cover[river | (relief.floor.shore_m < 0.0)] = Cover.WATER
    return cover
