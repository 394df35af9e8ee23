"""Light scattered more than once: its angular moments at every height and sun elevation, order by order.

Bruneton & Neyret (2008), doi:10.1111/j.1467-8659.2008.01245.x, compute scattering order by order: the source
``J[L](x, ω) = σ_s ∫ p(ω, ω') L(x, ω') dω'`` (their eq. 7) and the radiance it makes along rays, ``S[L]`` (their eq. 8),
with light from the ground ``R[L]`` (eq. 6), so that ``L = L0 + (R + S)[L0] + (R + S)²[L0] + …`` (eq. 4). They tabulate
``ΔJ`` and ``ΔS`` in four dimensions (their algorithm 4.1). Here only ``L``'s moments in real spherical harmonics about
the local vertical are kept, ``Φ_lm(height, sun elevation)``: a phase function with Legendre moments χ_l turns them into
the source exactly, ``J = σ_s Σ χ_l Φ_lm Y_lm``, and gas needs l ≤ 2 alone. Aerosol's forward peak is dealt with by
delta-M scaling; the sun's first scattering keeps the full phase function elsewhere (Nakajima & Tanaka's 1988 TMS).

All radiances are transfers: over the sun's spectral irradiance above the air [1/sr], in nine bands.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from math import factorial

import numpy as np

from seasonscapes.sky.air import (
    TOP_HEIGHT_M,
    Atmosphere,
    Optics,
    constituent_densities,
    delta_scaled,
    gas_moments,
    optics,
)
from seasonscapes.sky.paths import (
    Paths,
    SunColumns,
    equal_cells,
    horizon_elevation_rad,
    resampled,
    sun_columns,
    sun_transfer,
    trace_rays,
)
from seasonscapes.sky.spectrum import WAVELENGTHS_NM

# Delta-M takes aerosol's scattering within some 180°/L for unscattered. Along the horizon that is right only for
# narrow peaks: with L = 4 the sky beside a setting sun comes out a fifth too bright, with 10 within a path tracer's
# noise.
HARMONIC_ORDER, LATER_ORDER = 10, 4
_HEIGHTS, _AZIMUTHS, _CELLS = 14, 11, 24
# Close through twilight, where light falls by a factor of three a degree.
SUN_ELEVATION_KNOTS_DEG = np.concatenate([
    np.arange(-30.0, -18.0, 3.0), np.arange(-18.0, -12.0, 1.5), np.arange(-12.0, 3.0, 0.75),
    [3.0, 4.5, 6.0, 8.0, 11.0, 15.0, 20.0, 27.0, 36.0, 47.0, 60.0, 74.0, 90.0],
])  # fmt: skip
_DARK = 1e-30
_THREADS = 4


@dataclass(frozen=True)
class Samples:
    """Cells of rays that start at one height: everything about them that does not know the sun.

    Parameters
    ----------
    height_m, turn_rad, elevation_rad
        Of the cells' middles ``(K, S)``.
    weight
        ``(K, S, B)``: ∫ transmittance ds over each cell, as seen from the start [m].
    aerosol_column
        ``(K, S)`` from the start to the cells' middles, in vertical columns.
    end_transmittance
        ``(K, B)`` to the end of the ray.
    paths
        The rays at the cells' edges.
    """

    height_m: np.ndarray
    turn_rad: np.ndarray
    elevation_rad: np.ndarray
    weight: np.ndarray
    aerosol_column: np.ndarray
    end_transmittance: np.ndarray
    paths: Paths


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


@dataclass(frozen=True)
class AtmosphereTables:
    """All of an atmosphere that does not depend on time: columns towards the sun and multiply scattered light.

    Parameters
    ----------
    atmosphere
        What it was computed for.
    sun_columns
        See `SunColumns`.
    moments
        Light scattered at least once, summed over all orders.
    """

    atmosphere: Atmosphere
    sun_columns: SunColumns
    moments: Moments


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


def sample_cells(atmosphere: Atmosphere, scaled: Optics, paths: Paths, edges_m: np.ndarray) -> Samples:
    """Cells between edges ``(K, S + 1)`` [m] along rays, with the transmittance-weighted length of each."""
    middles = resampled(paths, 0.5 * (edges_m[:, 1:] + edges_m[:, :-1]))
    ends = resampled(paths, edges_m)
    length = np.diff(ends.distance_m, axis=1)
    column = cell_columns(atmosphere, ends, middles)
    depth = np.einsum("cks,cb->ksb", column, scaled.extinction)
    total = np.concatenate([np.zeros_like(depth[:, :1]), np.cumsum(depth, axis=1)], axis=1)
    transmittance = np.exp(-total)
    length = np.diff(ends.distance_m, axis=1)[..., None]
    weight = transmittance[:, :-1] * -np.expm1(-depth) / np.maximum(depth, 1e-9) * length
    aerosol = np.cumsum(column[1], axis=1) - 0.5 * column[1]
    return Samples(
        middles.height_m, middles.turn_rad, middles.elevation_rad, weight, aerosol, transmittance[:, -1], ends
    )


def cell_columns(atmosphere: Atmosphere, ends: Paths, middles: Paths) -> np.ndarray:
    """Columns ``(3, K, S)`` of the constituents in each cell, by Simpson's rule."""
    density = constituent_densities(atmosphere, ends.height_m)
    mean = (density[..., 1:] + density[..., :-1] + 4.0 * constituent_densities(atmosphere, middles.height_m)) / 6.0
    return mean * np.diff(ends.distance_m, axis=1)


def local_sun(turn_rad, sun_elevation_rad, cos_azimuth) -> np.ndarray:
    """Sine of the sun's elevation at points a turn about the Earth's centre away, towards an azimuth from the sun.

    All arguments broadcast; the last is the cosine of the azimuth between ray and sun.
    """
    return np.cos(turn_rad) * np.sin(sun_elevation_rad) + np.sin(turn_rad) * np.cos(sun_elevation_rad) * cos_azimuth


def scattering_per_m(atmosphere: Atmosphere, scaled: Optics, height_m: np.ndarray) -> np.ndarray:
    """Scattering coefficients of gas and aerosol ``(2, ..., B)`` [1/m] at heights."""
    density = constituent_densities(atmosphere, height_m)[:2]
    return density[..., None] * scaled.scattering[:2].reshape(2, *(1,) * np.ndim(height_m), -1)


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


def _directions(horizon_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Elevations [rad] and solid-angle weights over sin(elevation) ``(K,)``: Gauss panels that meet at the horizon."""
    edge = np.sin(horizon_rad)
    panels = [(-1.0, edge, 4), (edge, edge + 0.25 * (1.0 - edge), 6), (edge + 0.25 * (1.0 - edge), 1.0, 5)]
    sines, weights = [], []
    for low, high, count in panels:
        node, weight = np.polynomial.legendre.leggauss(count)
        sines.append(0.5 * (high - low) * node + 0.5 * (high + low))
        weights.append(0.5 * (high - low) * weight)
    return np.arcsin(np.concatenate(sines)), np.concatenate(weights)


@dataclass(frozen=True)
class _Level:
    """Rays from one table height under every sun: what every order reuses."""

    samples: Samples
    sines: np.ndarray  # of the rays' elevations (K,)
    weights: np.ndarray  # solid angle (K, A)
    basis: np.ndarray  # harmonics of the rays' directions (K, A, L, L)
    geometry: tuple
    sun_sine: np.ndarray
    ground_index: tuple


def _level(atmosphere: Atmosphere, scaled: Optics, height_m: float) -> _Level:
    elevation, weight = _directions(float(horizon_elevation_rad(atmosphere, height_m)))
    paths = trace_rays(atmosphere, height_m, elevation)
    samples = sample_cells(atmosphere, scaled, paths, equal_cells(atmosphere, paths, _CELLS))
    azimuth = (np.arange(_AZIMUTHS) + 0.5) * np.pi / _AZIMUTHS
    sun = np.radians(SUN_ELEVATION_KNOTS_DEG)
    suns, azimuths = (part.ravel() for part in np.meshgrid(sun, azimuth, indexing="ij"))
    sun_sine, geometry = sun_geometry(samples, elevation, suns, azimuths)
    x = np.cos(elevation)[:, None] * np.cos(azimuth)
    z = np.broadcast_to(np.sin(elevation)[:, None], x.shape)
    basis = zonal(z) * azimuthal(x, z)[..., None, :]
    end_sine = local_sun(samples.paths.turn_rad[:, -1, None], suns, np.cos(azimuths))
    weights = np.repeat(weight[:, None] * (2.0 * np.pi / _AZIMUTHS), _AZIMUTHS, axis=1)
    return _Level(samples, np.sin(elevation), weights, basis, geometry, sun_sine, (*sun_index(end_sine), end_sine))


def _first_radiance(atmosphere: Atmosphere, scaled: Optics, columns: SunColumns, level: _Level) -> np.ndarray:
    """Sunlight scattered once ``(K, Q, B)`` [1/sr] along a level's rays, with the truncated phase function."""
    samples = level.samples
    arriving = sun_transfer(atmosphere, columns, scaled, samples.height_m[..., None], np.arcsin(level.sun_sine))
    sun = np.radians(SUN_ELEVATION_KNOTS_DEG)
    azimuth = (np.arange(_AZIMUTHS) + 0.5) * np.pi / _AZIMUTHS
    nu = level.sines[:, None, None] * np.sin(sun)[:, None] + np.sqrt(1.0 - level.sines**2)[:, None, None] * np.cos(sun)[
        :, None
    ] * np.cos(azimuth)
    nu = nu.reshape(len(level.sines), -1)
    degrees = np.arange(HARMONIC_ORDER + 1)
    phases = [
        np.polynomial.legendre.legval(nu, (2 * degrees + 1) / (4 * np.pi) * moments)
        for moments in (gas_moments(HARMONIC_ORDER), scaled.aerosol_moments[: HARMONIC_ORDER + 1])
    ]
    sigma = scattering_per_m(atmosphere, scaled, samples.height_m) * samples.weight
    return sum(
        np.einsum("ksb,ksqb->kqb", part, arriving) * phase[..., None] for part, phase in zip(sigma, phases, strict=True)
    )


def _project(level: _Level, radiance: np.ndarray) -> np.ndarray:
    """Moments ``(J, L, L, B)`` of radiance ``(K, Q, B)`` along a level's rays."""
    k, a = level.weights.shape
    by_sun = radiance.reshape(k, -1, a, radiance.shape[-1])
    return np.einsum("ka,kalm,kjab->jlmb", level.weights, level.basis, by_sun, optimize=True)


def _irradiance(level: _Level, radiance: np.ndarray) -> np.ndarray:
    """Irradiance from above ``(J, B)`` of radiance ``(K, Q, B)``."""
    k, a = level.weights.shape
    by_sun = radiance.reshape(k, -1, a, radiance.shape[-1])
    return np.einsum("ka,k,kjab->jb", level.weights, np.maximum(level.sines, 0.0), by_sun, optimize=True)


def as_moments(values: np.ndarray, ground_irradiance: np.ndarray) -> Moments:
    """Pack plain moments ``(P, J, L, L, B)`` so that they interpolate well."""
    mean = np.maximum(values[:, :, 0, 0], _DARK)
    ratio = values / mean[:, :, None, None]
    return Moments(np.log(mean).astype(np.float32), ratio.astype(np.float32), ground_irradiance)


def atmosphere_tables(atmosphere: Atmosphere, *, tolerance: float = 0.1, max_orders: int = 40) -> AtmosphereTables:
    """Tabulate an atmosphere; some seconds, once for all times and places.

    Parameters
    ----------
    tolerance
        Orders are added until what is left of them, as a geometric series, falls below this share of the light
        everywhere; the series' rest is then added in closed form.
    max_orders
        Stop there in any case.
    """
    scaled = delta_scaled(optics(atmosphere), HARMONIC_ORDER)
    columns = sun_columns(atmosphere)
    albedo = np.broadcast_to(np.asarray(atmosphere.ground_albedo, float), WAVELENGTHS_NM.shape) / np.pi
    sun = np.radians(SUN_ELEVATION_KNOTS_DEG)
    direct = sun_transfer(atmosphere, columns, scaled, np.full(sun.shape, atmosphere.ground_height_m), sun)
    # Levels are independent within an order, and numpy lets go of the interpreter while it works.
    with ThreadPoolExecutor(_THREADS) as pool:
        levels = list(pool.map(lambda height: _level(atmosphere, scaled, height), table_heights_m(atmosphere)))
        leaving = direct * np.maximum(np.sin(sun), 0.0)[:, None] * albedo
        values, ground = _gathered(
            pool.map(
                lambda level: _received(level, _first_radiance(atmosphere, scaled, columns, level), leaving), levels
            )
        )
        total, total_ground = values, ground
        rest = np.zeros_like(values[:, :, 0, 0])
        for order in range(2, max_orders + 1):
            # Light that was scattered twice is smooth enough for a lower order.
            source = values if order == 2 else values[:, :, : LATER_ORDER + 1, : LATER_ORDER + 1]
            before, moments, leaving = values[:, :, 0, 0], as_moments(source, ground), ground * albedo
            next_order = partial(_received_next, atmosphere, scaled, moments, leaving)
            values, ground = _gathered(pool.map(next_order, levels))
            total, total_ground = total + values, total_ground + ground
            # Later orders keep their shape and fall geometrically, band by band.
            decay = np.clip(values[:, :, 0, 0] / np.maximum(before, _DARK), 0.0, 0.98)
            rest = decay / (1.0 - decay)
            if (rest * values[:, :, 0, 0] < tolerance * total[:, :, 0, 0] + _DARK).all():
                break
    total = total + rest[:, :, None, None] * values
    return AtmosphereTables(atmosphere, columns, as_moments(total, total_ground + rest[0] * ground))


def _gathered(received) -> tuple[np.ndarray, np.ndarray]:
    """Moments ``(P, J, L, L, B)`` of all levels, and the lowest level's irradiance ``(J, B)``."""
    moments, irradiance = zip(*received, strict=True)
    return np.stack(moments), irradiance[0]


def _received(level: _Level, radiance: np.ndarray, leaving: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Moments ``(J, L, L, B)`` and irradiance ``(J, B)`` of radiance along a level's rays, the ground's light added."""
    radiance = radiance + _from_ground(level, leaving)
    return _project(level, radiance), _irradiance(level, radiance)


def _received_next(atmosphere: Atmosphere, scaled: Optics, moments: Moments, leaving: np.ndarray, level: _Level):
    """The same for light of one more order."""
    return _received(level, _next_radiance(atmosphere, scaled, moments, level), leaving)


def _next_radiance(atmosphere: Atmosphere, scaled: Optics, moments: Moments, level: _Level) -> np.ndarray:
    """Light of one more order ``(K, Q, B)`` [1/sr] along a level's rays."""
    source = diffuse_source(atmosphere, scaled, moments, level.samples, level.geometry)
    return np.einsum("ksb,ksqb->kqb", level.samples.weight, source)


def _from_ground(level: _Level, leaving: np.ndarray) -> np.ndarray:
    """What the ground sends along a level's rays ``(K, Q, B)``, from its radiance by sun elevation ``(J, B)``."""
    index, share, _ = level.ground_index
    share = share[..., None]
    seen = leaving[index] * (1.0 - share) + leaving[index + 1] * share
    ends = np.where(level.samples.paths.ends_on_ground[:, None], level.samples.end_transmittance, 0.0)
    return ends[:, None, :] * seen
