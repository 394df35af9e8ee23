"""Diffuse light as angular moments by height and sun elevation, and the source of scattering that they make."""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np

from seasonscapes.sky.atmosphere import TOP_HEIGHT_M, Atmosphere, Optics, gas_moments
from seasonscapes.sky.ray_cells import CellSamples, local_sun, scattering_per_m

# Delta-M takes aerosol's scattering within some 180°/L for unscattered. Along the horizon that is right only for
# narrow peaks: with L = 4 the sky beside a setting sun comes out a fifth too bright, with 10 within a path tracer's
# noise.
HARMONIC_ORDER, LATER_ORDER = 10, 4
_HEIGHTS = 14
# Close through twilight, where light falls by a factor of three a degree.
SUN_ELEVATION_KNOTS_DEG = np.concatenate(
    [
        np.arange(-30.0, -18.0, 3.0),
        np.arange(-18.0, -12.0, 1.5),
        np.arange(-12.0, 3.0, 0.75),
        [3.0, 4.5, 6.0, 8.0, 11.0, 15.0, 20.0, 27.0, 36.0, 47.0, 60.0, 74.0, 90.0],
    ]
)
DARK = 1e-30


@dataclass(frozen=True)
class ShMoments:
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


def diffuse_source(
    atmosphere: Atmosphere, scaled: Optics, moments: ShMoments, samples: CellSamples, geometry: tuple
) -> np.ndarray:
    """Source of scattered diffuse light ``J`` at samples under many suns and azimuths ``(K, S, Q, B)`` [1/(m sr)].

    ``geometry`` is what `sun_geometry` gives for the samples.
    """
    index, share, cosines = geometry
    orders, bands = moments.ratio.shape[2], moments.ratio.shape[-1]
    cells = samples.height_m.size
    # Of the sun's knots only those that the samples need.
    first, last = int(index.min()), int(index.max()) + 2
    order, columns = _by_cell(atmosphere, scaled, moments, samples, (first, last))
    suns = _hats(index.reshape(cells, -1)[order] - first, share.reshape(cells, -1)[order], last - first)
    mixed = (suns @ columns.swapaxes(1, 2)).reshape(*suns.shape[:2], orders + 1, bands)
    cosines = cosines.reshape(cells, -1, cosines.shape[-1])[order, :, :orders]
    shape = (cosines[..., None, :] @ mixed[..., 1:, :])[..., 0, :]
    source = np.empty_like(shape)
    source[order] = np.maximum(shape, 0.0) * np.exp(mixed[..., 0, :])
    return source.reshape(*index.shape, bands)


def _by_cell(
    atmosphere: Atmosphere, scaled: Optics, moments: ShMoments, samples: CellSamples, knots: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """For cells in order of height, numbers ``(X,)`` and what they scatter under a range of the sun's knots.

    The second array ``(X, (1 + L) B, J)`` holds the logarithm of Φ_00 and then, for each m, the sum over l of all that
    a cell's height and the ray's elevation there fix: all but the azimuth.
    """
    first, last = knots
    orders, bands, cells = moments.ratio.shape[2], moments.ratio.shape[-1], samples.height_m.size
    chi = np.stack([gas_moments(orders - 1), scaled.aerosol_moments[:orders]])
    sigma = scattering_per_m(atmosphere, scaled, samples.height_m).reshape(2, cells, bands)
    weight = np.einsum("axb,al->bxl", sigma, chi).astype(np.float32)
    legendre = zonal(np.sin(samples.elevation_rad).ravel(), orders - 1).astype(np.float32)
    row, share = (part.ravel() for part in height_index(atmosphere, samples.height_m))
    order = np.argsort(row, kind="stable")
    hats = np.stack([1.0 - share, share], axis=-1).astype(np.float32)[order]
    weight, legendre = weight[:, order], legendre[order]
    columns = np.empty((cells, (orders + 1) * bands, last - first), np.float32)
    ends = np.searchsorted(row[order], np.arange(len(moments.log_mean)))
    # Cells between the same two heights of the table make one product of matrices for each m, all bands beside
    # each other.
    for p in np.flatnonzero(ends[1:] > ends[:-1]):
        start, stop = ends[p], ends[p + 1]
        part = slice(start, stop)
        block = columns[part].reshape(stop - start, orders + 1, bands, -1)
        np.einsum("xp,pjb->xbj", hats[part], moments.log_mean[p : p + 2, first:last], out=block[:, 0])
        for m in range(orders):
            factor = weight[:, part, None, m:] * legendre[part, None, m:, m] * hats[part, :, None]
            table = moments.ratio[p : p + 2, first:last, m:, m].transpose(3, 0, 2, 1)
            np.matmul(
                factor.reshape(bands, stop - start, -1),
                table.reshape(bands, -1, last - first),
                out=block[:, 1 + m].swapaxes(0, 1),
            )
    return order, columns


def _hats(index: np.ndarray, share: np.ndarray, count: int) -> np.ndarray:
    """Matrix ``(..., count)`` of linear interpolation: ``1 - share`` at ``index`` and ``share`` at the next."""
    matrix = np.zeros((*index.shape, count), np.float32)
    np.put_along_axis(matrix, index[..., None], 1.0 - share[..., None], axis=-1)
    np.put_along_axis(matrix, index[..., None] + 1, share[..., None], axis=-1)
    return matrix


def sun_geometry(
    samples: CellSamples, start_elevation_rad: np.ndarray, sun_elevation_rad: np.ndarray, azimuth_rad: np.ndarray
) -> tuple[np.ndarray, tuple]:
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


def as_sh_moments(values: np.ndarray, ground_irradiance: np.ndarray) -> ShMoments:
    """Pack plain moments ``(P, J, L, L, B)`` so that they interpolate well."""
    mean = np.maximum(values[:, :, 0, 0], DARK)
    ratio = values / mean[:, :, None, None]
    return ShMoments(np.log(mean).astype(np.float32), ratio.astype(np.float32), ground_irradiance)
