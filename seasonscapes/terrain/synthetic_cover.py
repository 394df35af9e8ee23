"""What grows and lies on the synthetic massif: ground cover from height, slope, aspect, ice and water."""

from __future__ import annotations

from enum import IntEnum

import cv2
import numpy as np

from seasonscapes.terrain.noise import fractal_noise
from seasonscapes.terrain.synthetic_relief import Relief


class Cover(IntEnum):
    """Ground cover classes; the value is what the cover map holds."""

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


def slope_and_northness(elevation: np.ndarray, spacing_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Slope [deg] and the northward component of the unit normal, ``(H, W)`` float32; row 0 is in the north."""
    down, right = np.gradient(elevation.astype(np.float64), spacing_m)
    up = 1.0 / np.sqrt(1.0 + down**2 + right**2)
    return np.degrees(np.arccos(up)).astype(np.float32), (down * up).astype(np.float32)


def ground_cover(relief: Relief, spacing_m: float, seed: int, east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
    """Cover classes ``(H, W)`` uint8."""
    z = relief.elevation
    slope, north = slope_and_northness(cv2.GaussianBlur(z, (0, 0), 20.0 / spacing_m + 0.3), spacing_m)
    large = fractal_noise(seed + 201, 1500.0, east_m, north_m, octaves=6, gain=0.6)
    small = fractal_noise(seed + 231, 240.0, east_m, north_m, octaves=4, gain=0.65)
    relative = cv2.GaussianBlur(z, (0, 0), 120.0 / spacing_m) - z  # positive in hollows [m]
    cover = np.full(z.shape, Cover.MEADOW, np.uint8)
    tree_line = 1930.0 - 60.0 * north + 90.0 * large
    dense = 1.1 * large + 0.7 * small + (slope - 21.0) / 9.0 + 0.9 * north - (z - 1200.0) / 1400.0
    forest = (dense > 0.0) & (z < tree_line) & (slope < 50.0)
    cover[forest] = Cover.CONIFER
    cover[forest & (z < 1150.0 + 150.0 * large) & (small + 0.5 * large - north > 0.1)] = Cover.BROADLEAF
    cover[forest & (z > tree_line - 330.0 - 80.0 * small) & (small - 0.3 * large > -0.2)] = Cover.LARCH
    cover[(z > tree_line - 60.0) & (z < tree_line + 230.0) & (dense + 0.4 * small > 0.4)] = Cover.SHRUB
    flat = (slope < 5.0) & (z < 1100.0) & (relief.floor.shore_m > 40.0)
    cover[flat & (large + 0.4 * small > -0.5)] = Cover.FIELD
    bare = (z - 2380.0 - 170.0 * large - 110.0 * small + 120.0 * north) / 250.0 + np.maximum(slope - 33.0, 0.0) / 6.0
    loose = (bare > 0.0) & (z > 1750.0)
    cover[loose] = Cover.SCREE
    rocky = (
        (slope - 42.0 - 3.5 * small) / 4.0 - np.clip(relative, -30.0, 30.0) / 25.0 + np.maximum(z - 2700.0, 0.0) / 900.0
    )
    cover[(rocky > 0.0) & (loose | (slope > 46.0 + 3.0 * small))] = Cover.ROCK
    firn = (z > 3080.0 - 260.0 * north + 70.0 * large + 60.0 * small) & (slope < 47.0 + 4.0 * small)
    cover[relief.ice_m > 0.0] = Cover.ICE
    cover[firn & ((relief.ice_m > 0.0) | (z > 3200.0))] = Cover.FIRN
    cover[relief.floor.shore_m < 0.0] = Cover.WATER
    return cover
