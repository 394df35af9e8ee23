"""Noise on a lattice that depends on coordinates and seed alone, isotropic or along a direction."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

# Of what grids of unit spacing hold, and those of twice the spacing do not, before they are scaled to 1.
_ISOTROPIC_RMS, _DRAWN_RMS = 0.488, 0.636


def lattice_hash(column: np.ndarray, row: np.ndarray, seed: int) -> np.ndarray:
    """Hash lattice points to 32 bits (Wellons' *lowbias32*), the same on every machine.

    Parameters
    ----------
    column, row
        ``(...)`` integers.
    seed
        Any integer.

    Returns
    -------
    numpy.ndarray
        ``(...)`` uint32.
    """
    with np.errstate(over="ignore"):
        bits = np.asarray(column, np.int64).astype(np.uint32) * np.uint32(0x9E3779B9)
        bits = bits ^ np.asarray(row, np.int64).astype(np.uint32) * np.uint32(0x85EBCA6B)
        bits = bits ^ np.uint32((seed * 0xC2B2AE35 + 0x27D4EB2F) % 2**32)
        for shift, factor in ((16, 0x7FEB352D), (15, 0x846CA68B)):
            bits = (bits ^ (bits >> np.uint32(shift))) * np.uint32(factor)
        return bits ^ (bits >> np.uint32(16))


def gradient_noise(x: np.ndarray, y: np.ndarray, seed: int) -> np.ndarray:
    """Gradient noise after Perlin 2002 (doi:10.1145/566654.566636): zero at the lattice points, smooth to the second derivative.

    Parameters
    ----------
    x, y
        ``(...)`` coordinates in cells of the lattice.
    seed
        Any integer.

    Returns
    -------
    numpy.ndarray
        ``(...)`` float32, of mean 0 and standard deviation about 0.25.
    """
    column, row = np.floor(x), np.floor(y)
    # Coordinates on a map need double precision, places within a cell do not.
    fx, fy = (x - column).astype(np.float32), (y - row).astype(np.float32)
    u, v = (f * f * f * (f * (6.0 * f - 15.0) + 10.0) for f in (fx, fy))
    gradient, corners = _gradients(column, row, seed), []
    for k in range(4):
        east, north = gradient(k)
        corners.append(east * (fx - k % 2) + north * (fy - k // 2))
    return (corners[0] * (1 - u) + corners[1] * u) * (1 - v) + (corners[2] * (1 - u) + corners[3] * u) * v


def _gradients(column: np.ndarray, row: np.ndarray, seed: int) -> Callable[[int], tuple[np.ndarray, np.ndarray]]:
    """East and north components of the gradients at a corner, 0 to 3, of lattice cells ``(...)``.

    Where there are fewer cells than points they are looked up in a table: drawing them is what noise costs.
    """

    def drawn(column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = lattice_hash(column, row, seed) * (2.0 * np.pi / 2.0**32)
        return np.cos(angle).astype(np.float32), np.sin(angle).astype(np.float32)

    if column.size:
        first = int(column.min()), int(row.min())
        width, height = int(column.max()) - first[0] + 2, int(row.max()) - first[1] + 2
        if width * height < column.size:
            rows, columns = np.mgrid[first[1] : first[1] + height, first[0] : first[0] + width]
            east, north = (each.ravel() for each in drawn(columns, rows))
            cell = (row - first[1]).astype(np.int64) * width + (column - first[0]).astype(np.int64)

            def looked_up(corner: int) -> tuple[np.ndarray, np.ndarray]:
                at = cell + (corner // 2 * width + corner % 2)
                return east[at], north[at]

            return looked_up
    return lambda corner: drawn(column + corner % 2, row + corner // 2)


def oriented_noise(
    x: np.ndarray, y: np.ndarray, *, angle: np.ndarray, aligned: np.ndarray, seed: int, orientations: int = 8
) -> np.ndarray:
    """Noise of wavelengths of two to four units, drawn out along a direction, and ridged there.

    Parameters
    ----------
    x, y
        Coordinates that broadcast to ``(...)``, such as ``(W,)`` and ``(H, 1)``.
    angle
        ``(...)`` direction along which it is drawn out [rad], where ``aligned`` is 1.
    aligned
        ``(...)`` 0 to 1: how much it is.
    seed
        Any integer.
    orientations
        Directions between which it is interpolated.

    Returns
    -------
    numpy.ndarray
        ``(...)``, of mean about 0. What a grid of unit spacing holds of it, and one of twice the spacing does not, has a
        root mean square of about 1.
    """
    x, y = np.broadcast_arrays(x, y)
    isotropic = gradient_noise(x * 0.37, y * 0.37, seed) * 4.0
    # What is aligned, in rows of its own.
    some = aligned > 0.0
    x, y, twice = x[some], y[some], 2.0 * angle[some]
    cosine, sine = np.cos(twice), np.sin(twice)
    total, weights = np.zeros_like(cosine), np.zeros_like(cosine)
    for k in range(orientations):
        direction = np.pi * k / orientations
        weight = np.cos(2.0 * direction) * cosine + np.sin(2.0 * direction) * sine
        chosen = np.flatnonzero(weight > 0.0)
        weight = weight[chosen]
        weight *= weight
        weight *= weight
        here_x, here_y = x[chosen], y[chosen]
        along = (np.cos(direction) * here_x + np.sin(direction) * here_y) * 0.16
        across = (-np.sin(direction) * here_x + np.cos(direction) * here_y) * 0.40
        noise = gradient_noise(along, across, seed + 101 + k)
        # Ridges: crests where the noise changes its sign.
        total[chosen] += weight * (4.0 * noise + 3.0 * (0.2 - np.abs(noise)) * 2.0)
        weights[chosen] += weight * weight
    result = np.sqrt(1.0 - aligned) * isotropic / _ISOTROPIC_RMS
    result[some] += np.sqrt(aligned[some]) * total / np.sqrt(np.maximum(weights, 1e-6)) / _DRAWN_RMS
    return result
