"""Light of surrounding land that the air scatters into an image from above (adjacency effect).

Over a dark forest between bright fields, much of what a satellite sees comes from the fields. Molecules and haze send it
up from far and near; the share within a distance is that of the environment functions of 6S (Vermote et al. 1997,
doi:10.1109/36.581987).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

# Sums of a · exp(-b · distance): the share of light from beyond a distance [km], seen from space.
_MOLECULES = ((0.930, 0.08), (0.070, 1.10))
_HAZE = ((0.375, 0.2), (0.625, 1.83))
# Shares of scattered light that go on upwards.
_UP_BY_MOLECULES, _UP_BY_HAZE = 0.5, 0.75
# Each round leaves about the share of the scattered in the straight light of its error, a half in hazy blue.
_ROUNDS = 4
# Land is averaged in so many cells on a side at most; beyond this distance nothing is added [km].
_CELLS, _REACH_KM = 200, 15.0


@dataclass(frozen=True)
class Surroundings:
    """Light from surrounding land in the air between surface and sensor.

    Parameters
    ----------
    by_molecules, by_haze
        ``(3,)`` diffuse transmittance: the share of the mean radiance of the surroundings that each adds.
    texel_m
        Size of a texel on the ground [m]; neighbouring texels adjoin.
    """

    by_molecules: np.ndarray
    by_haze: np.ndarray
    texel_m: float


def scattered_upwards(molecules: np.ndarray, haze: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the diffuse transmittance of air straight up: half of what molecules scatter, three quarters of haze's.

    Parameters
    ----------
    molecules, haze
        Optical depths ``(3,)`` between surface and sensor.

    Returns
    -------
    tuple of numpy.ndarray
        Diffuse transmittances ``(3,)`` by molecules and by haze.

    Examples
    --------
    >>> by_molecules, by_haze = scattered_upwards(np.array([0.06, 0.1, 0.2]), np.array([0.1, 0.12, 0.15]))
    >>> by_haze.round(3)
    array([0.067, 0.078, 0.088])
    """
    molecules, haze = np.asarray(molecules, float), np.asarray(haze, float)
    up = _UP_BY_MOLECULES * molecules + _UP_BY_HAZE * haze
    scattered = np.exp(-(molecules + haze)) * np.expm1(up)
    share = _UP_BY_MOLECULES * molecules / np.maximum(up, 1e-9)
    return scattered * share, scattered * (1.0 - share)


def without_surroundings(
    radiance: np.ndarray, transmittance: np.ndarray, surroundings: Surroundings, known: np.ndarray
) -> np.ndarray:
    """Estimate the radiance at the surface, without what the air adds from the land around.

    Parameters
    ----------
    radiance
        ``(R, S, 3)`` at the sensor, without the air's own airlight.
    transmittance
        ``(3,)`` or ``(R, S, 3)`` share that passes the air straight.
    surroundings
        What the air adds.
    known
        ``(R, S)`` bool: texels with a value.

    Returns
    -------
    numpy.ndarray
        ``(R, S, 3)`` radiance that leaves the surface; nothing changes but for one factor where all land is alike.

    Examples
    --------
    >>> import numpy as np
    >>> around = Surroundings(np.full(3, 0.05), np.full(3, 0.05), 30.0)
    >>> level = without_surroundings(np.full((32, 32, 3), 0.9), np.full(3, 0.8), around, np.ones((32, 32), bool))
    >>> bool(np.allclose(level, 1.0))
    True
    """
    molecules, haze = (np.asarray(share, float) for share in (surroundings.by_molecules, surroundings.by_haze))
    added_share = (molecules + haze).astype(np.float32)
    mean_around = _mean_around(known, molecules, haze, surroundings.texel_m)
    # The mean over surroundings is of the surface's radiance, which is what is sought.
    surface = radiance / (transmittance + added_share)
    for _ in range(_ROUNDS):
        surface = (radiance - added_share * mean_around(surface)) / transmittance
    return surface.astype(np.float32)


def _mean_around(
    known: np.ndarray, molecules: np.ndarray, haze: np.ndarray, texel_m: float
) -> Callable[[np.ndarray], np.ndarray]:
    """Mean of the known land's values ``(R, S, 3)`` around each texel, as molecules and haze of these shares weigh it."""
    # It loads all of scipy.stats, and most images are delit without the light of the land around.
    from scipy.signal import fftconvolve

    rows, columns = known.shape
    every = max(1, -(-max(rows, columns) // _CELLS))
    size = (-(-columns // every), -(-rows // every))

    def coarse(values: np.ndarray) -> np.ndarray:
        return values if every == 1 else cv2.resize(values, size, interpolation=cv2.INTER_AREA)

    far, near = (_kernel(parts, texel_m * every / 1000.0, max(size)) for parts in (_MOLECULES, _HAZE))
    kernels = [far * one + near * other for one, other in zip(molecules, haze, strict=True)]
    weight = coarse(known.astype(np.float32))
    totals = [np.maximum(fftconvolve(weight, kernel, mode="same"), 1e-9) for kernel in kernels]

    def mean(values: np.ndarray) -> np.ndarray:
        land = coarse(np.where(known[..., None], values, 0.0).astype(np.float32))
        blurred = [
            fftconvolve(land[..., channel], kernel, mode="same") / total
            for channel, (kernel, total) in enumerate(zip(kernels, totals, strict=True))
        ]
        around = np.stack(blurred, axis=2).astype(np.float32)
        return cv2.resize(around, (columns, rows), interpolation=cv2.INTER_LINEAR)

    return mean


def _kernel(parts: tuple[tuple[float, float], ...], cell_km: float, most: int) -> np.ndarray:
    """Weights of cells around one ``(2N + 1, 2N + 1)``, from the derivative of an environment function by area."""
    reach = max(1, min(most, int(_REACH_KM / cell_km)))
    offset = np.arange(-reach, reach + 1) * cell_km
    distance = np.hypot(offset[:, None], offset)
    distance[reach, reach] = np.inf
    kernel = sum(a * b * np.exp(-b * distance) for a, b in parts) / (2.0 * np.pi * distance) * cell_km**2
    # The cell itself is a disc of equal area.
    kernel[reach, reach] = sum(a * (1.0 - np.exp(-b * cell_km / np.sqrt(np.pi))) for a, b in parts)
    return kernel / kernel.sum()
