"""Spherical-harmonic moments of diffuse radiance by height and solar elevation, and the scattering source from them."""

from __future__ import annotations

from dataclasses import dataclass
from math import factorial

import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.sky.atmosphere import TOP_HEIGHT_M, Atmosphere, Optics, gas_moments
from seasonscapes.sky.ray_cells import CellSamples, local_sun_sine, scattering_per_m

# Delta-M treats aerosol scattering within about 180°/L as unscattered. Along the horizon this is valid for narrow peaks
# only: with L = 4 the sky beside a setting sun is too bright, with L = 10 it agrees with path tracing within
# noise.
HARMONIC_ORDER, LATER_ORDER = 10, 4
_HEIGHTS = 14
# Dense in twilight, where irradiance decreases by a factor of three per degree.
SUN_ELEVATION_KNOTS_DEG = np.concatenate(
    [
        np.arange(-30.0, -18.0, 3.0),
        np.arange(-18.0, -12.0, 1.5),
        np.arange(-12.0, 3.0, 0.75),
        [3.0, 4.5, 6.0, 8.0, 11.0, 15.0, 20.0, 27.0, 36.0, 47.0, 60.0, 74.0, 90.0],
    ]
)
# Numbers that are interpolated at once: a processor's cache holds them.
_BLOCK = 1 << 19
MIN_MEAN = 1e-30  # lower bound of Φ_00, for its logarithm


@dataclass(frozen=True)
class ShMoments:
    """Moments of diffuse radiance in real spherical harmonics about the local vertical.

    Parameters
    ----------
    log_mean
        Logarithm of Φ_00 by height, solar elevation and band ``(P, J, B)``.
    ratio
        All moments over Φ_00, by l and m ``(P, J, L, L, B)``.
    ground_irradiance
        Diffuse irradiance on the ground as a transfer ``(J, B)``.
    """

    log_mean: np.ndarray
    ratio: np.ndarray
    ground_irradiance: np.ndarray


@dataclass(frozen=True)
class SunGeometry:
    """Position of the sun relative to samples on rays, for Q pairs of solar elevation and azimuth.

    Parameters
    ----------
    sun_sine
        Sine of the true solar elevation at the samples ``(K, S, Q)``.
    knot_index, knot_fraction
        Interpolation index and fraction in `SUN_ELEVATION_KNOTS_DEG` ``(K, S, Q)``, from `sun_index`.
    azimuthal
        Azimuthal factors, from the function `azimuthal`, of the ray's direction in the local frame whose x axis points
        to the sun's azimuth ``(K, S, Q, L)``.
    """

    sun_sine: np.ndarray
    knot_index: np.ndarray
    knot_fraction: np.ndarray
    azimuthal: np.ndarray


def azimuthal(x: np.ndarray, z: np.ndarray, order: int = HARMONIC_ORDER) -> np.ndarray:
    """Evaluate the azimuthal factors ``Re (x + iy)^m = sin^m θ cos mφ`` of real spherical harmonics.

    Parameters
    ----------
    x, z
        Components of unit vectors ``(...)``.
    order
        Highest m.

    Returns
    -------
    ndarray
        Values for m from 0 to ``order`` ``(..., order + 1)``.
    """
    cosines = [np.ones_like(x), x]
    for _ in range(2, order + 1):
        cosines.append(2.0 * x * cosines[-1] - (1.0 - z**2) * cosines[-2])
    return np.stack(cosines, axis=-1)


def zonal(z: np.ndarray, order: int = HARMONIC_ORDER) -> np.ndarray:
    """Evaluate the orthonormal associated Legendre functions divided by ``sin^m θ``.

    ``zonal(z)[..., l, m] * azimuthal(x, z)[..., m]`` are the real spherical harmonics that are even in y.

    Parameters
    ----------
    z
        Vertical component of unit vectors, cos θ ``(...)``.
    order
        Highest l.

    Returns
    -------
    ndarray
        Values by l and m ``(..., order + 1, order + 1)``; 0 for m > l.
    """
    values = np.zeros((*np.shape(z), order + 1, order + 1))
    for m in range(order + 1):
        values[..., m, m] = float(np.prod(np.arange(1, 2 * m, 2)))
        for degree in range(m + 1, order + 1):
            previous = values[..., degree - 2, m] if degree > m + 1 else 0.0
            values[..., degree, m] = (
                (2 * degree - 1) * z * values[..., degree - 1, m] - (degree + m - 1) * previous
            ) / (degree - m)
    for degree in range(order + 1):
        for m in range(degree + 1):
            norm2 = (2 * degree + 1) / (4 * np.pi) * factorial(degree - m) / factorial(degree + m) * (2 if m else 1)
            values[..., degree, m] *= np.sqrt(norm2)
    return values


def diffuse_source(
    atmosphere: Atmosphere, scaled: Optics, moments: ShMoments, samples: CellSamples, geometry: SunGeometry
) -> np.ndarray:
    """Compute the source function of scattered diffuse light, ``J = Σ β_s χ_l Φ_lm Y_lm``, at samples on rays.

    Parameters
    ----------
    atmosphere, scaled
        Atmosphere and its delta-M-scaled optics.
    moments
        Moments of the radiance that is scattered.
    samples
        S cells on each of K rays.
    geometry
        Positions of Q suns relative to the samples, from `sun_geometry`.

    Returns
    -------
    ndarray
        Source function ``(K, S, Q, B)`` [1/(m sr)], float32.
    """
    index, cosines = geometry.knot_index, geometry.azimuthal
    orders, bands = moments.ratio.shape[2], moments.ratio.shape[-1]
    cells = samples.height_m.size
    # Restrict the table to the range of solar elevations of the samples.
    first, last = int(index.min()), int(index.max()) + 2
    knots = last - first
    order, columns = _source_by_cell(atmosphere, scaled, moments, samples, (first, last))
    columns = columns.reshape(cells * knots, -1)
    below = index.reshape(cells, -1)[order] - first + (np.arange(cells, dtype=np.intp) * knots)[:, None]
    fraction = geometry.knot_fraction.reshape(cells, -1)[order]
    cosines = cosines.reshape(cells, -1, cosines.shape[-1])[order, :, :orders]
    source = np.empty((*below.shape, bands), np.float32)
    step = max(1, _BLOCK // (below.shape[1] * columns.shape[1]))
    for start in range(0, cells, step):
        part = slice(start, start + step)
        rows = below[part].ravel()
        by_order = np.take(columns, rows, axis=0)
        above = np.take(columns, rows + 1, axis=0)
        above -= by_order
        above *= fraction[part].reshape(-1, 1)
        by_order += above
        by_order = by_order.reshape(*below[part].shape, orders + 1, bands)
        relative = np.einsum("xqm,xqmb->xqb", cosines[part], by_order[:, :, 1:])
        source[order[part]] = np.maximum(relative, 0.0) * np.exp(by_order[:, :, 0])
    return source.reshape(*index.shape, bands)


def _source_by_cell(
    atmosphere: Atmosphere, scaled: Optics, moments: ShMoments, samples: CellSamples, knots: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the cells sorted by height ``(X,)`` and their azimuth-independent source terms ``(X, J, 1 + L, B)``.

    The terms, for a range of solar-elevation knots, are the logarithm of Φ_00 and, for each m, the sum over l of the
    source relative to Φ_00.
    """
    first, last = knots
    orders, bands, cells = moments.ratio.shape[2], moments.ratio.shape[-1], samples.height_m.size
    chi = np.stack([gas_moments(orders - 1), scaled.aerosol_moments[:orders]])
    sigma = scattering_per_m(atmosphere, scaled, samples.height_m).reshape(2, cells, bands)
    weight = np.einsum("axb,al->bxl", sigma, chi).astype(np.float32)
    legendre = zonal(np.sin(samples.elevation_rad).ravel(), orders - 1).astype(np.float32)
    row, fraction = (array.ravel() for array in height_index(atmosphere, samples.height_m))
    order = np.argsort(row, kind="stable")
    height_weights = np.stack([1.0 - fraction, fraction], axis=-1).astype(np.float32)[order]
    weight, legendre = weight[:, order], legendre[order]
    columns = np.empty((cells, last - first, orders + 1, bands), np.float32)
    ends = np.searchsorted(row[order], np.arange(len(moments.log_mean)))
    # Cells between the same two table heights share one batched matrix product for each m, with the bands as batch.
    for p in np.flatnonzero(ends[1:] > ends[:-1]):
        start, stop = ends[p], ends[p + 1]
        group = slice(start, stop)
        block = columns[group]
        np.einsum("xp,pjb->xjb", height_weights[group], moments.log_mean[p : p + 2, first:last], out=block[:, :, 0])
        for m in range(orders):
            factor = weight[:, group, None, m:] * legendre[group, None, m:, m] * height_weights[group, :, None]
            table = moments.ratio[p : p + 2, first:last, m:, m].transpose(3, 0, 2, 1)
            product = factor.reshape(bands, stop - start, -1) @ table.reshape(bands, -1, last - first)
            block[:, :, 1 + m] = product.transpose(1, 2, 0)
    return order, columns


def sun_geometry(
    samples: CellSamples, start_elevation_rad: np.ndarray, sun_elevation_rad: np.ndarray, azimuth_rad: np.ndarray
) -> SunGeometry:
    """Compute the position of the sun relative to each sample.

    Parameters
    ----------
    samples
        S cells on each of K rays.
    start_elevation_rad
        Elevation of the rays at their origin ``(K,)`` [rad].
    sun_elevation_rad
        True solar elevation at the origin ``(Q,)`` [rad].
    azimuth_rad
        Azimuth between rays and sun ``(Q,)`` [rad].

    Returns
    -------
    SunGeometry
        Arrays ``(K, S, Q)``.
    """
    sun, cos_azimuth = np.asarray(sun_elevation_rad), np.cos(azimuth_rad)
    sine = local_sun_sine(samples.central_angle_rad[..., None], sun, cos_azimuth)
    # The cosine of the angle between ray and sun is constant along the ray.
    start = start_elevation_rad[:, None]
    nu = np.sin(start) * np.sin(sun) + np.cos(start) * np.cos(sun) * cos_azimuth
    z = np.sin(samples.elevation_rad)[..., None]
    x = (nu[:, None, :] - z * sine) / np.sqrt(np.maximum(1.0 - sine**2, 1e-8))
    bound = np.sqrt(np.maximum(1.0 - z**2, 0.0))
    x = np.clip(x, -bound, bound)
    return SunGeometry(sine, *sun_index(sine), azimuthal(x, np.broadcast_to(z, x.shape)).astype(np.float32))


def sun_index(sine: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return the interpolation index and fraction of solar elevations in `SUN_ELEVATION_KNOTS_DEG`.

    Interpolation is linear in the sine of the elevation.

    Parameters
    ----------
    sine
        Sine of the solar elevation ``(...)``.

    Returns
    -------
    index
        Index of the knot below ``(...)``, int32.
    fraction
        Position between that knot and the next in [0, 1] ``(...)``, float32.
    """
    knots = np.sin(np.radians(SUN_ELEVATION_KNOTS_DEG))
    position = np.interp(np.asarray(sine, float), knots, np.arange(len(knots)))
    index = np.minimum(position.astype(np.int32), len(knots) - 2)
    return index, (position - index).astype(np.float32)


def height_index(atmosphere: Atmosphere, height_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the interpolation index and fraction of heights in `table_heights_m`.

    Parameters
    ----------
    atmosphere
        Atmosphere.
    height_m
        Height ``(...)`` [m].

    Returns
    -------
    index
        Index of the table height below ``(...)``, int32.
    fraction
        Position between that height and the next in [0, 1] ``(...)``.
    """
    relative = (height_m - atmosphere.ground_height_m) / (TOP_HEIGHT_M - atmosphere.ground_height_m)
    position = np.clip(relative, 0.0, 1.0) ** (1.0 / 2.5) * (_HEIGHTS - 1)
    index = np.minimum(position.astype(np.int32), _HEIGHTS - 2)
    return index, position - index


def table_heights_m(atmosphere: Atmosphere) -> np.ndarray:
    """Return the heights at which moments are tabulated.

    Parameters
    ----------
    atmosphere
        Atmosphere.

    Returns
    -------
    ndarray
        Heights from the ground to the top of the atmosphere ``(P,)`` [m].
    """
    thickness = TOP_HEIGHT_M - atmosphere.ground_height_m
    return atmosphere.ground_height_m + thickness * np.linspace(0.0, 1.0, _HEIGHTS) ** 2.5


def as_sh_moments(values: np.ndarray, ground_irradiance: np.ndarray) -> ShMoments:
    """Convert moments to the logarithmic form that is interpolated.

    Parameters
    ----------
    values
        Moments Φ_lm ``(P, J, L, L, B)``.
    ground_irradiance
        Diffuse irradiance on the ground ``(J, B)``.

    Returns
    -------
    ShMoments
        Moments in single precision.
    """
    mean = np.maximum(values[:, :, 0, 0], MIN_MEAN)
    ratio = values / mean[:, :, None, None]
    return ShMoments(np.log(mean).astype(np.float32), ratio.astype(np.float32), ground_irradiance)
