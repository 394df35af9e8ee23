"""Diffuse light as angular moments by height and sun elevation, and the source of scattering that they make."""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np

from seasonscapes.sky.air import TOP_HEIGHT_M, Atmosphere, Optics, gas_moments
from seasonscapes.sky.cells import Samples, local_sun, scattering_per_m

# Delta-M takes aerosol's scattering within some 180°/L for unscattered. Along the horizon that is right only for
# narrow peaks: with L = 4 the sky beside a setting sun comes out a fifth too bright, with 10 within a path tracer's
# noise.
HARMONIC_ORDER, LATER_ORDER = 10, 4
_HEIGHTS = 14
# Close through twilight, where light falls by a factor of three a degree.
SUN_ELEVATION_KNOTS_DEG = np.concatenate([
    np.arange(-30.0, -18.0, 3.0), np.arange(-18.0, -12.0, 1.5), np.arange(-12.0, 3.0, 0.75),
    [3.0, 4.5, 6.0, 8.0, 11.0, 15.0, 20.0, 27.0, 36.0, 47.0, 60.0, 74.0, 90.0],
])  # fmt: skip
DARK = 1e-30


@dataclass(frozen=True)
class Moments:
    """Angular moments of diffuse light by height and sun elevation.

    Parameters
    ----------
    log_mean
        ``(P, J, B)`` logarithm of Φ_00.
    ratio
        ``(P, J, L, L, B)`` all moments over Φ_00, by l and m.
    ground_irradiance
        ``(J, B)`` diffuse irradiance of the ground, a transfer.
    """

    log_mean: np.ndarray
    ratio: np.ndarray
    ground_irradiance: np.ndarray


def azimuthal(x: np.ndarray, z: np.ndarray, order: int = HARMONIC_ORDER) -> np.ndarray:
    """``Re (x + iy)^m = sin^m θ cos mφ`` of unit vectors for m up to ``order``, ``(..., order + 1)``."""
    cosines = [np.ones_like(x), x]
    for _ in range(2, order + 1):
        cosines.append(2.0 * x * cosines[-1] - (1.0 - z**2) * cosines[-2])
    return np.stack(cosines, axis=-1)


def zonal(z: np.ndarray, order: int = HARMONIC_ORDER) -> np.ndarray:
    """Orthonormal associated Legendre functions over ``sin^m θ``, ``(..., order + 1, order + 1)`` by l and m.

    ``zonal(z)[..., l, m] * azimuthal(x, z)[..., m]`` are the real spherical harmonics that are even in y.
    """
    values = np.zeros((*np.shape(z), order + 1, order + 1))
    for m in range(order + 1):
        values[..., m, m] = float(np.prod(np.arange(1, 2 * m, 2)))
        for degree in range(m + 1, order + 1):
            before = values[..., degree - 2, m] if degree > m + 1 else 0.0
            values[..., degree, m] = ((2 * degree - 1) * z * values[..., degree - 1, m] - (degree + m - 1) * before) / (
                degree - m
            )
    for degree in range(order + 1):
        for m in range(degree + 1):
            square = (2 * degree + 1) / (4 * np.pi) * factorial(degree - m) / factorial(degree + m) * (2 if m else 1)
            values[..., degree, m] *= np.sqrt(square)
    return values


def diffuse_source(atmosphere: Atmosphere, scaled: Optics, moments: Moments, samples: Samples,
                   geometry: tuple) -> np.ndarray:  # fmt: skip
    """Source of scattered diffuse light ``J`` at samples under many suns and azimuths ``(K, S, Q, B)`` [1/(m sr)].

    ``geometry`` is what `sun_geometry` gives for the samples.
    """
    index, share, cosines = geometry
    orders, bands = moments.ratio.shape[2], moments.ratio.shape[-1]
    cells = samples.height_m.size
    # Interpolation, in height and in the sun's elevation, as products with matrices of hat functions; of the sun's
    # knots only those that the samples need.
    first, last = int(index.min()), int(index.max()) + 2
    row, share_of_row = height_index(atmosphere, samples.height_m)
    heights = _hats(row.ravel(), share_of_row.ravel(), len(moments.log_mean))
    chi = np.stack([gas_moments(orders - 1), scaled.aerosol_moments[:orders]])
    sigma = scattering_per_m(atmosphere, scaled, samples.height_m).reshape(2, cells, bands)
    weight = np.einsum("axb,al->xlb", sigma, chi)
    legendre = zonal(np.sin(samples.elevation_rad).ravel(), orders - 1)
    columns = [(heights @ moments.log_mean[:, first:last].reshape(len(moments.log_mean), -1)).reshape(cells, -1, bands)]
    for m in range(orders):
        # A sample's height and elevation fix all but the azimuth: sum over l here, once for all suns.
        block = moments.ratio[:, first:last, m:, m]
        block = (heights @ block.reshape(len(block), -1)).reshape(cells, last - first, orders - m, bands)
        factor = (weight[:, m:] * legendre[:, m:, m, None]).astype(np.float32)
        columns.append(np.einsum("xlb,xjlb->xjb", factor, block))
    suns = _hats(index.reshape(cells, -1) - first, share.reshape(cells, -1), last - first)
    mixed = suns @ np.concatenate(columns, axis=-1)
    mixed = mixed.reshape(*index.shape, orders + 1, bands)
    shape = np.einsum("ksqm,ksqmb->ksqb", cosines[..., :orders], mixed[..., 1:, :])
    return np.maximum(shape, 0.0) * np.exp(mixed[..., 0, :])


def _hats(index: np.ndarray, share: np.ndarray, count: int) -> np.ndarray:
    """Matrix ``(..., count)`` of linear interpolation: ``1 - share`` at ``index`` and ``share`` at the next."""
    matrix = np.zeros((*index.shape, count), np.float32)
    np.put_along_axis(matrix, index[..., None], 1.0 - share[..., None], axis=-1)
    np.put_along_axis(matrix, index[..., None] + 1, share[..., None], axis=-1)
    return matrix


def sun_geometry(samples: Samples, start_elevation_rad: np.ndarray, sun_elevation_rad: np.ndarray,
                 azimuth_rad: np.ndarray) -> tuple[np.ndarray, tuple]:  # fmt: skip
    """Where the sun stands at each sample ``(K, S, Q)`` for Q pairs of sun elevation and azimuth from the sun.

    Returns
    -------
    sun_sine
        Sine of the sun's elevation at the samples ``(K, S, Q)``.
    geometry
        Knot index and share in the sun's elevation, and `azimuthal` of the ray's direction in the local frame.
    """
    sun, cos_azimuth = np.asarray(sun_elevation_rad), np.cos(azimuth_rad)
    sine = local_sun(samples.turn_rad[..., None], sun, cos_azimuth)
    # Cosine between ray and sun, constant along the ray.
    start = start_elevation_rad[:, None]
    nu = np.sin(start) * np.sin(sun) + np.cos(start) * np.cos(sun) * cos_azimuth
    z = np.sin(samples.elevation_rad)[..., None]
    x = (nu[:, None, :] - z * sine) / np.sqrt(np.maximum(1.0 - sine**2, 1e-8))
    bound = np.sqrt(np.maximum(1.0 - z**2, 0.0))
    x = np.clip(x, -bound, bound)
    return sine, (*sun_index(sine), azimuthal(x, np.broadcast_to(z, x.shape)).astype(np.float32))


def sun_index(sine: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Knot below and share towards the next, in `SUN_ELEVATION_KNOTS_DEG`, for sines of the sun's elevation."""
    knots = np.sin(np.radians(SUN_ELEVATION_KNOTS_DEG))
    position = np.interp(sine, knots, np.arange(len(knots)))
    index = np.minimum(position.astype(np.int32), len(knots) - 2)
    return index, (position - index).astype(np.float32)


def height_index(atmosphere: Atmosphere, height_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Table row below and share towards the next, for heights [m]."""
    share = (height_m - atmosphere.ground_height_m) / (TOP_HEIGHT_M - atmosphere.ground_height_m)
    position = np.clip(share, 0.0, 1.0) ** (1.0 / 2.5) * (_HEIGHTS - 1)
    index = np.minimum(position.astype(np.int32), _HEIGHTS - 2)
    return index, position - index


def table_heights_m(atmosphere: Atmosphere) -> np.ndarray:
    """Heights of the table's rows ``(P,)`` [m]."""
    thickness = TOP_HEIGHT_M - atmosphere.ground_height_m
    return atmosphere.ground_height_m + thickness * np.linspace(0.0, 1.0, _HEIGHTS) ** 2.5


def as_moments(values: np.ndarray, ground_irradiance: np.ndarray) -> Moments:
    """Pack plain moments ``(P, J, L, L, B)`` so that they interpolate well."""
    mean = np.maximum(values[:, :, 0, 0], DARK)
    ratio = values / mean[:, :, None, None]
    return Moments(np.log(mean).astype(np.float32), ratio.astype(np.float32), ground_irradiance)
