"""Light scattered more than once: its angular moments at every height and sun elevation, order by order.

After Bruneton & Neyret (2008), doi:10.1111/j.1467-8659.2008.01245.x, whose symbols are used: transmittance ``T``
(their eq. 5), light that the ground sends back ``I[L]`` (eq. 6), the source of scattering
``J[L](x, ω) = Σ β_s ∫ P(ω·ω') L(x, ω') dω'`` (eq. 7), and the equation to solve ``L = L0 + R[L] + S[L]`` (eq. 8) with
``R[L] = T I[L]`` (eq. 10) and ``S[L] = ∫ T J[L]`` (eq. 11). It is solved as they do, by the series
``L0 + (R + S)[L0] + (R + S)²[L0] + …`` (§ 4), one order of scattering after the other.

They tabulate ``J`` and ``S`` in four dimensions. Here only the moments of ``L`` in real spherical harmonics about the
local vertical are kept, ``Φ_lm(height, sun elevation)``: a phase function with Legendre moments χ_l turns them into
the source exactly, ``J = β_s Σ χ_l Φ_lm Y_lm``, and gas needs l ≤ 2 alone. Aerosol's forward peak is dealt with by
delta-M scaling; what the eye sees of light scattered once keeps the full phase function (see `aureole`).

All radiances are transfers: over the sun's spectral irradiance above the air [1/sr], in nine bands.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import numpy as np

from seasonscapes.sky.atmosphere import Atmosphere, Optics, delta_scaled, gas_moments, optics
from seasonscapes.sky.curved_rays import (
    SunColumns,
    equal_cells,
    horizon_elevation_rad,
    sun_columns,
    sun_transfer,
    trace_curved_rays,
)
from seasonscapes.sky.ray_cells import CellSamples, local_sun, sample_cells, scattering_per_m
from seasonscapes.sky.sh_moments import (
    DARK,
    HARMONIC_ORDER,
    LATER_ORDER,
    SUN_ELEVATION_KNOTS_DEG,
    ShMoments,
    as_sh_moments,
    azimuthal,
    diffuse_source,
    sun_geometry,
    sun_index,
    table_heights_m,
    zonal,
)
from seasonscapes.sky.spectrum import WAVELENGTHS_NM

_AZIMUTHS, _CELLS, _THREADS = 11, 24, 4


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
    diffuse_of
        Gives, for an observer's height and whether near distances are meant, `observer_radiance.diffuse_by_elevation`: quick for
        many suns. Without, diffuse light is worked out for each sun.
    """

    atmosphere: Atmosphere
    sun_columns: SunColumns
    moments: ShMoments
    diffuse_of: Callable[[float, bool], np.ndarray] | None = None


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

    samples: CellSamples
    sines: np.ndarray  # of the rays' elevations (K,)
    weights: np.ndarray  # solid angle (K, A)
    basis: np.ndarray  # harmonics of the rays' directions (K, A, L, L)
    geometry: tuple
    sun_sine: np.ndarray
    ground_index: tuple


def _level(atmosphere: Atmosphere, scaled: Optics, height_m: float) -> _Level:
    elevation, weight = _directions(float(horizon_elevation_rad(atmosphere, height_m)))
    paths = trace_curved_rays(atmosphere, height_m, elevation)
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
            before, moments, leaving = values[:, :, 0, 0], as_sh_moments(source, ground), ground * albedo
            next_order = partial(_received_next, atmosphere, scaled, moments, leaving)
            values, ground = _gathered(pool.map(next_order, levels))
            total, total_ground = total + values, total_ground + ground
            # Later orders keep their shape and fall geometrically, band by band.
            decay = np.clip(values[:, :, 0, 0] / np.maximum(before, DARK), 0.0, 0.98)
            rest = decay / (1.0 - decay)
            if (rest * values[:, :, 0, 0] < tolerance * total[:, :, 0, 0] + DARK).all():
                break
    total = total + rest[:, :, None, None] * values
    return AtmosphereTables(atmosphere, columns, as_sh_moments(total, total_ground + rest[0] * ground))


def _gathered(received) -> tuple[np.ndarray, np.ndarray]:
    """Moments ``(P, J, L, L, B)`` of all levels, and the lowest level's irradiance ``(J, B)``."""
    moments, irradiance = zip(*received, strict=True)
    return np.stack(moments), irradiance[0]


def _received(level: _Level, radiance: np.ndarray, leaving: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Moments ``(J, L, L, B)`` and irradiance ``(J, B)`` of radiance along a level's rays, the ground's light added."""
    radiance = radiance + _from_ground(level, leaving)
    return _project(level, radiance), _irradiance(level, radiance)


def _received_next(atmosphere: Atmosphere, scaled: Optics, moments: ShMoments, leaving: np.ndarray, level: _Level):
    """The same for light of one more order."""
    return _received(level, _next_radiance(atmosphere, scaled, moments, level), leaving)


def _next_radiance(atmosphere: Atmosphere, scaled: Optics, moments: ShMoments, level: _Level) -> np.ndarray:
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
