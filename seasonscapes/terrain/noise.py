"""Seeded, band-limited noise defined in world coordinates, independent of the sampling grid."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy import sparse

# Standard deviation of a cubic B-spline sum of unit white noise in two dimensions, averaged over position: ∫ B3².
_SPLINE_DEVIATION = 151.0 / 315.0
_LATTICE_MARGIN = 4


def spline_noise(seed: int, wavelength_m: float, east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
    """Evaluate smooth noise of unit variance on a grid.

    White noise on a lattice of half the wavelength, interpolated with cubic B-splines. The lattice is fixed in world
    coordinates, so that grids of different spacing sample the same field.

    Parameters
    ----------
    seed
        Selects the field.
    wavelength_m
        Twice the lattice spacing [m].
    east_m, north_m
        Axes ``(W,)`` and ``(H,)`` of the grid [m].

    Returns
    -------
    numpy.ndarray
        ``(H, W)`` float32.
    """
    step = 0.5 * wavelength_m
    rows, columns = (
        _spline_basis(north_m / step),
        _kept_basis((east_m / step).tobytes(), np.result_type(east_m, step).str),
    )
    lattice = (_lattice(seed, rows[1], columns[1]) / _SPLINE_DEVIATION).astype(np.float32)
    across = np.ascontiguousarray((columns[0] @ lattice.T).T)
    return rows[0] @ across


def warped_noise(seed: int, wavelength_m: float, east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
    """Evaluate the field of `spline_noise` at arbitrary positions.

    Parameters
    ----------
    seed
        Selects the field.
    wavelength_m
        Twice the lattice spacing [m].
    east_m, north_m
        Positions, arrays of one shape [m].

    Returns
    -------
    numpy.ndarray
        Noise of that shape, float64.
    """
    from scipy import ndimage

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
    """Evaluate fractal noise, a weighted sum of octaves of `spline_noise`, on a grid.

    Octaves with wavelengths below 1.4 grid spacings are omitted, because they would alias.

    Parameters
    ----------
    seed
        Selects the field.
    wavelength_m
        Wavelength of the first octave [m]; each further octave halves it.
    east_m, north_m
        Axes ``(W,)`` and ``(H,)`` of the grid [m].
    octaves
        Number of octaves.
    gain
        Amplitude ratio of successive octaves.

    Returns
    -------
    numpy.ndarray
        ``(H, W)`` float32, of unit variance if the grid resolves all octaves.
    """
    weights = (gain ** np.arange(octaves)).astype(np.float32)
    finest = 1.4 * abs(float(east_m[1] - east_m[0]))
    total = np.zeros((len(north_m), len(east_m)), np.float32)
    for k, weight in enumerate(weights):
        if wavelength_m / 2**k >= finest:
            octave = spline_noise(seed + 101 * k, wavelength_m / 2**k, east_m, north_m)
            octave *= weight
            total += octave
    total /= np.float32(np.sqrt(np.sum(weights**2)))
    return total


@lru_cache(maxsize=64)
def _kept_basis(position: bytes, dtype: str) -> tuple[sparse.csr_array, range]:
    """`_spline_basis` of the bytes of an array: strips of one map, and all its fields of a wavelength, share it."""
    return _spline_basis(np.frombuffer(position, dtype))


def _spline_basis(position: np.ndarray) -> tuple[sparse.csr_array, range]:
    """Cubic B-spline weights ``(len(position), lattice)`` and the range of lattice indices of their columns."""
    position = np.asarray(position, float)
    cell = np.floor(position).astype(int)
    first = int(cell.min()) - 1
    t = position - cell
    weights = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], -1) / 6.0
    columns = (cell - 1 - first)[:, None] + np.arange(4)
    count = int(cell.max()) + 3 - first
    basis = sparse.csr_array(
        (
            weights.ravel().astype(np.float32),
            columns.ravel().astype(np.int32),
            np.arange(0, 4 * len(position) + 1, 4, dtype=np.int32),
        ),
        shape=(len(position), count),
    )
    return basis, range(first, first + count)


def _lattice(seed: int, rows: range, columns: range) -> np.ndarray:
    """Uniform white noise of unit variance at integer lattice points, as a hash of seed, row and column.

    Uses the finaliser of MurmurHash3 (Appleby, public domain), so that any window can be evaluated independently.
    """
    row = np.asarray(rows, np.int64).astype(np.uint32)[:, None]
    column = np.asarray(columns, np.int64).astype(np.uint32)[None, :]
    mixed = row * np.uint32(0x9E3779B1) ^ _murmur(column * np.uint32(0x85EBCA77) + np.uint32(seed & 0xFFFFFFFF))
    return (_murmur(mixed).astype(np.float64) / 2.0**31 - 1.0) * np.sqrt(3.0)


def _murmur(h: np.ndarray) -> np.ndarray:
    """32-bit finaliser of MurmurHash3."""
    h = h ^ (h >> np.uint32(16))
    h = h * np.uint32(0x85EBCA6B)
    h = h ^ (h >> np.uint32(13))
    h = h * np.uint32(0xC2B2AE35)
    return h ^ (h >> np.uint32(16))
