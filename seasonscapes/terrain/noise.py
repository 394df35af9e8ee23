"""Seeded noise in metres: the same field whatever grid looks at it."""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse

# Variance of a cubic B-spline sum of unit white noise, averaged over position: (∫ B3²)² in two dimensions.
_SPLINE_DEVIATION = 151.0 / 315.0
_LATTICE_MARGIN = 4


def spline_noise(seed: int, wavelength_m: float, east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
    """Smooth noise of unit variance over the grid ``north_m (H,) × east_m (W,)``, ``(H, W)`` float32.

    White noise on a lattice of half the wavelength, interpolated with cubic B-splines. The lattice hangs on the world,
    not on the grid: grids of other spacing sample the same field.
    """
    step = 0.5 * wavelength_m
    rows, columns = _spline_basis(north_m / step), _spline_basis(east_m / step)
    lattice = (_lattice(seed, rows[1], columns[1]) / _SPLINE_DEVIATION).astype(np.float32)
    across = np.ascontiguousarray((columns[0] @ lattice.T).T)
    return rows[0] @ across


def warped_noise(seed: int, wavelength_m: float, east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
    """`spline_noise` at arbitrary positions (arrays of one shape)."""
    step = 0.5 * wavelength_m
    row, column = north_m / step, east_m / step
    first_row, first_column = int(np.floor(row.min())) - _LATTICE_MARGIN, int(np.floor(column.min())) - _LATTICE_MARGIN
    lattice = _lattice(
        seed,
        range(first_row, int(row.max()) + _LATTICE_MARGIN),
        range(first_column, int(column.max()) + _LATTICE_MARGIN),
    )
    coordinates = np.stack([row - first_row, column - first_column])
    return ndimage.map_coordinates(lattice, coordinates, order=3, prefilter=False, mode="nearest") / _SPLINE_DEVIATION


def fractal_noise(
    seed: int, wavelength_m: float, east_m: np.ndarray, north_m: np.ndarray, *, octaves: int, gain: float = 0.5
) -> np.ndarray:
    """Sum of octaves of `spline_noise`, ``(H, W)`` float32; unit variance when the grid holds them all.

    Octaves finer than the grid are left out: within a cell they average to nothing, sampled they would alias.
    """
    weights = (gain ** np.arange(octaves)).astype(np.float32)
    finest = 1.4 * abs(float(east_m[1] - east_m[0]))
    total = np.zeros((len(north_m), len(east_m)), np.float32)
    for k, weight in enumerate(weights):
        if wavelength_m / 2**k >= finest:
            total += weight * spline_noise(seed + 101 * k, wavelength_m / 2**k, east_m, north_m)
    return total / np.float32(np.sqrt(np.sum(weights**2)))


def _spline_basis(position: np.ndarray) -> tuple[sparse.csr_array, range]:
    """Cubic B-spline weights ``(len(position), lattice)`` and the lattice indices they refer to."""
    position = np.asarray(position, float)
    cell = np.floor(position).astype(int)
    first = int(cell.min()) - 1
    t = position - cell
    weights = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], -1) / 6.0
    columns = (cell - 1 - first)[:, None] + np.arange(4)
    rows = np.repeat(np.arange(len(position)), 4)
    count = int(cell.max()) + 3 - first
    basis = sparse.csr_array(
        (weights.ravel().astype(np.float32), (rows, columns.ravel())), shape=(len(position), count)
    )
    return basis, range(first, first + count)


def _lattice(seed: int, rows: range, columns: range) -> np.ndarray:
    """White noise at integer lattice points, uniform with unit variance: a hash, so any window of it can be had.

    The finaliser of MurmurHash3 (Appleby, public domain) over seed, row and column.
    """
    row = np.asarray(rows, np.int64).astype(np.uint32)[:, None]
    column = np.asarray(columns, np.int64).astype(np.uint32)[None, :]
    mixed = row * np.uint32(0x9E3779B1) ^ _murmur(column * np.uint32(0x85EBCA77) + np.uint32(seed & 0xFFFFFFFF))
    return (_murmur(mixed).astype(np.float64) / 2.0**31 - 1.0) * np.sqrt(3.0)


def _murmur(h: np.ndarray) -> np.ndarray:
    h = h ^ (h >> np.uint32(16))
    h = h * np.uint32(0x85EBCA6B)
    h = h ^ (h >> np.uint32(13))
    h = h * np.uint32(0xC2B2AE35)
    return h ^ (h >> np.uint32(16))
