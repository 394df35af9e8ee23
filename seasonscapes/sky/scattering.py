"""Multiple scattering in the atmosphere: moments of diffuse radiance by height and solar elevation.

After Bruneton & Neyret (2008), doi:10.1111/j.1467-8659.2008.01245.x, in their notation: transmittance ``T`` (eq. 5),
radiance reflected by the ground ``I[L]`` (eq. 6), the source function
``J[L](x, ω) = Σ β_s ∫ P(ω·ω') L(x, ω') dω'`` (eq. 7), and the equation to solve ``L = L0 + R[L] + S[L]`` (eq. 8) with
``R[L] = T I[L]`` (eq. 10) and ``S[L] = ∫ T J[L]`` (eq. 11). As in the paper it is solved by the series
``L0 + (R + S)[L0] + (R + S)²[L0] + …`` (§ 4), in successive orders of scattering.

The paper tabulates ``J`` and ``S`` in four dimensions. Here only the moments of ``L`` in real spherical harmonics about
the local vertical are stored, ``Φ_lm(height, solar elevation)``. For a phase function with Legendre moments χ_l the
source follows exactly, ``J = β_s Σ χ_l Φ_lm Y_lm``; gas needs l ≤ 2 only. The forward peak of aerosol is treated by
delta-M scaling; single scattering towards the observer uses the full phase function (see `aureole`).

All radiances are transfers, relative to the extraterrestrial solar spectral irradiance [1/sr], in nine bands.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields

import numpy as np
from threadpoolctl import threadpool_limits

from seasonscapes.sky.atmosphere import Atmosphere, Optics, delta_scaled, gas_moments, optics
from seasonscapes.sky.curved_rays import (
    CurvedRays,
    SunColumns,
    cell_edges_m,
    horizon_elevation_rad,
    sun_columns,
    sun_transfer,
    trace_curved_rays,
)
from seasonscapes.sky.elevation_table import PartedTable
from seasonscapes.sky.ray_cells import CellSamples, local_sun_sine, sample_cells, scattering_per_m
from seasonscapes.sky.sh_moments import (
    HARMONIC_ORDER,
    LATER_ORDER,
    MIN_MEAN,
    SUN_ELEVATION_KNOTS_DEG,
    ShMoments,
    SunGeometry,
    as_sh_moments,
    azimuthal,
    diffuse_source,
    sun_geometry,
    sun_index,
    table_heights_m,
    zonal,
)
from seasonscapes.sky.spectrum import WAVELENGTHS_NM

# Azimuths of the first two orders, and of the later ones, which have harmonics up to `LATER_ORDER` only.
_AZIMUTHS, _LATER_AZIMUTHS, _CELLS = 11, 6, 24


@dataclass(frozen=True)
class AtmosphereTables:
    """Precomputed tables of an atmosphere for all solar positions: slant columns and multiply scattered light.

    Parameters
    ----------
    atmosphere
        Atmosphere of the tables.
    sun_columns
        Slant columns to the sun.
    moments
        Moments of the radiance scattered at least once, summed over all orders.
    diffuse_of
        Function ``(height_m, near)`` that returns the table `tables_by_elevation.diffuse_by_elevation` of an observer's
        height, which is fast for many solar positions. Without it diffuse light is computed for each solar position.
    day_of
        Likewise of `tables_by_elevation.day_by_elevation`.
    moon_of
        Likewise of `tables_by_elevation.moon_by_elevation`.
    """

    atmosphere: Atmosphere
    sun_columns: SunColumns
    moments: ShMoments
    diffuse_of: Callable[[float, bool], np.ndarray | PartedTable] | None = None
    day_of: Callable[[float, bool], np.ndarray | PartedTable] | None = None
    moon_of: Callable[[float, bool], np.ndarray | PartedTable] | None = None


def _directions(horizon_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Elevations [rad] and weights in sin(elevation) ``(K,)`` of Gauss-Legendre panels separated at the horizon."""
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
    """Rays from one table height for all solar elevations; shared by all orders of scattering."""

    samples: CellSamples
    azimuths: np.ndarray  # between ray and sun (A,) [rad]
    sines: np.ndarray  # of the rays' elevations (K,)
    weights: np.ndarray  # solid angle (K, A) [sr]
    basis: np.ndarray  # spherical harmonics of the rays' directions (K, A, L, L)
    geometry: SunGeometry
    # Interpolation index and fraction in solar elevation at the ends of the rays (K, Q).
    end_index: np.ndarray
    end_fraction: np.ndarray


def _build_levels(atmosphere: Atmosphere, scaled: Optics) -> tuple[list[_Level], list[_Level]]:
    """Rays from all table heights with the azimuths of the first two orders, and with those of the later orders."""
    heights = table_heights_m(atmosphere)
    directions = [_directions(float(horizon_elevation_rad(atmosphere, height))) for height in heights]
    elevations = np.stack([elevation for elevation, _ in directions])
    count = elevations.shape[1]
    # All of them at once: each step along the rays is many operations on short arrays.
    rays = trace_curved_rays(atmosphere, np.repeat(heights, count), elevations.ravel())
    levels, later_levels = [], []
    for number, (elevation, weight) in enumerate(directions):
        part = slice(number * count, (number + 1) * count)
        of_height = CurvedRays(*(getattr(rays, field.name)[part] for field in fields(CurvedRays)))
        samples = sample_cells(atmosphere, scaled, of_height, cell_edges_m(atmosphere, of_height, _CELLS))
        levels.append(_level(samples, elevation, weight, _AZIMUTHS))
        later_levels.append(_level(samples, elevation, weight, _LATER_AZIMUTHS))
    return levels, later_levels


def _level(samples: CellSamples, elevation: np.ndarray, weight: np.ndarray, azimuth_count: int) -> _Level:
    azimuth = (np.arange(azimuth_count) + 0.5) * np.pi / azimuth_count
    sun = np.radians(SUN_ELEVATION_KNOTS_DEG)
    suns, azimuths = (grid.ravel() for grid in np.meshgrid(sun, azimuth, indexing="ij"))
    geometry = sun_geometry(samples, elevation, suns, azimuths)
    x = np.cos(elevation)[:, None] * np.cos(azimuth)
    z = np.broadcast_to(np.sin(elevation)[:, None], x.shape)
    basis = zonal(z) * azimuthal(x, z)[..., None, :]
    # Higher m would alias on this many azimuths.
    basis[..., azimuth_count:] = 0.0
    end_sine = local_sun_sine(samples.edges.central_angle_rad[:, -1, None], suns, np.cos(azimuths))
    weights = np.repeat(weight[:, None] * (2.0 * np.pi / azimuth_count), azimuth_count, axis=1)
    return _Level(samples, azimuth, np.sin(elevation), weights, basis, geometry, *sun_index(end_sine))


def _first_radiance(atmosphere: Atmosphere, scaled: Optics, columns: SunColumns, level: _Level) -> np.ndarray:
    """Singly scattered radiance ``(K, Q, B)`` [1/sr] of a level's rays, with the truncated phase function."""
    samples = level.samples
    arriving = sun_transfer(
        atmosphere, columns, scaled, samples.height_m[..., None], np.arcsin(level.geometry.sun_sine)
    )
    sun = np.radians(SUN_ELEVATION_KNOTS_DEG)
    nu = level.sines[:, None, None] * np.sin(sun)[:, None] + np.sqrt(1.0 - level.sines**2)[:, None, None] * np.cos(sun)[
        :, None
    ] * np.cos(level.azimuths)
    nu = nu.reshape(len(level.sines), -1)
    degrees = np.arange(HARMONIC_ORDER + 1)
    phases = [
        np.polynomial.legendre.legval(nu, (2 * degrees + 1) / (4 * np.pi) * moments)
        for moments in (gas_moments(HARMONIC_ORDER), scaled.aerosol_moments[: HARMONIC_ORDER + 1])
    ]
    sigma = scattering_per_m(atmosphere, scaled, samples.height_m) * samples.weight
    contributions = (
        np.einsum("ksb,ksqb->kqb", coefficient, arriving) * phase[..., None]
        for coefficient, phase in zip(sigma, phases, strict=True)
    )
    return np.asarray(sum(contributions))


def _project(level: _Level, radiance: np.ndarray) -> np.ndarray:
    """Moments ``(J, L, L, B)`` of the radiance ``(K, Q, B)`` of a level's rays."""
    k, a = level.weights.shape
    by_sun = radiance.reshape(k, -1, a, radiance.shape[-1])
    return np.einsum("ka,kalm,kjab->jlmb", level.weights, level.basis, by_sun, optimize=True)


def _irradiance(level: _Level, radiance: np.ndarray) -> np.ndarray:
    """Downward irradiance ``(J, B)`` from the radiance ``(K, Q, B)`` of a level's rays."""
    k, a = level.weights.shape
    by_sun = radiance.reshape(k, -1, a, radiance.shape[-1])
    return np.einsum("ka,k,kjab->jb", level.weights, np.maximum(level.sines, 0.0), by_sun, optimize=True)


def atmosphere_tables(atmosphere: Atmosphere, *, tolerance: float = 0.1, max_orders: int = 40) -> AtmosphereTables:
    """Compute the tables of an atmosphere, valid for all solar positions and observers; takes some seconds.

    Parameters
    ----------
    atmosphere
        Atmosphere.
    tolerance
        Orders of scattering are added until the remainder of the series, estimated as geometric, is everywhere below
        this fraction of the sum. The estimated remainder is added.
    max_orders
        Highest order of scattering in any case.

    Returns
    -------
    AtmosphereTables
        Tables without ``diffuse_of`` and ``day_of``.
    """
    scaled = delta_scaled(optics(atmosphere), HARMONIC_ORDER)
    columns = sun_columns(atmosphere)
    albedo = np.broadcast_to(np.asarray(atmosphere.ground_albedo, float), WAVELENGTHS_NM.shape) / np.pi
    sun = np.radians(SUN_ELEVATION_KNOTS_DEG)
    direct = sun_transfer(atmosphere, columns, scaled, np.full(sun.shape, atmosphere.ground_height_m), sun)
    # The matrices are small: threads of BLAS within each would wait for one another most of the time, and threads that work
    # on several levels at once take half as much processor time again, for memory and the interpreter's lock.
    with threadpool_limits(1, "blas"):
        levels, later_levels = _build_levels(atmosphere, scaled)
        ground_radiance = direct * np.maximum(np.sin(sun), 0.0)[:, None] * albedo
        values, ground = _stack_levels(
            _moments_and_irradiance(level, _first_radiance(atmosphere, scaled, columns, level), ground_radiance)
            for level in levels
        )
        total, total_ground = values, ground
        remainder = np.zeros_like(values[:, :, 0, 0])
        for order in range(2, max_orders + 1):
            # Radiance scattered at least twice is smooth enough for fewer harmonics.
            source = values if order == 2 else values[:, :, : LATER_ORDER + 1, : LATER_ORDER + 1]
            previous, moments, ground_radiance = values[:, :, 0, 0], as_sh_moments(source, ground), ground * albedo
            values, ground = _stack_levels(
                _next_order(atmosphere, scaled, moments, ground_radiance, level)
                for level in (levels if order == 2 else later_levels)
            )
            total, total_ground = total + values, total_ground + ground
            # Higher orders keep their angular shape and decay geometrically in each band.
            decay = np.clip(values[:, :, 0, 0] / np.maximum(previous, MIN_MEAN), 0.0, 0.98)
            remainder = decay / (1.0 - decay)
            if (remainder * values[:, :, 0, 0] < tolerance * total[:, :, 0, 0] + MIN_MEAN).all():
                break
    total = total + remainder[:, :, None, None] * values
    return AtmosphereTables(atmosphere, columns, as_sh_moments(total, total_ground + remainder[0] * ground))


def _stack_levels(results: Iterable[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Moments ``(P, J, L, L, B)`` of all levels, and the irradiance ``(J, B)`` on the lowest level."""
    moments, irradiance = zip(*results, strict=True)
    return np.stack(moments), irradiance[0]


def _moments_and_irradiance(
    level: _Level, radiance: np.ndarray, ground_radiance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Moments ``(J, L, L, B)`` and irradiance ``(J, B)`` of scattered radiance plus attenuated ground radiance."""
    radiance = radiance + _from_ground(level, ground_radiance)
    return _project(level, radiance), _irradiance(level, radiance)


def _next_order(
    atmosphere: Atmosphere, scaled: Optics, moments: ShMoments, ground_radiance: np.ndarray, level: _Level
) -> tuple[np.ndarray, np.ndarray]:
    """`_moments_and_irradiance` of the next order of scattering."""
    return _moments_and_irradiance(level, _next_radiance(atmosphere, scaled, moments, level), ground_radiance)


def _next_radiance(atmosphere: Atmosphere, scaled: Optics, moments: ShMoments, level: _Level) -> np.ndarray:
    """Scattered radiance of the next order ``(K, Q, B)`` [1/sr] of a level's rays."""
    source = diffuse_source(atmosphere, scaled, moments, level.samples, level.geometry)
    return np.einsum("ksb,ksqb->kqb", level.samples.weight, source)


def _from_ground(level: _Level, ground_radiance: np.ndarray) -> np.ndarray:
    """Attenuated ground radiance along a level's rays ``(K, Q, B)``, from its table by solar elevation ``(J, B)``."""
    index, fraction = level.end_index, level.end_fraction[..., None]
    radiance = ground_radiance[index] * (1.0 - fraction) + ground_radiance[index + 1] * fraction
    transmittance = np.where(level.samples.edges.ends_on_ground[:, None], level.samples.end_transmittance, 0.0)
    return transmittance[:, None, :] * radiance
