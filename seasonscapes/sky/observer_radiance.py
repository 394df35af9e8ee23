"""Sky radiance for one observer: scattered light along whole rays, for any luminary.

Three components are tabulated separately for each ray: light scattered once by gas, once by aerosol, and all other
light. Divided by their phase functions the first two are smooth in azimuth (Bruneton & Neyret 2008, § 4). A few
azimuths are therefore sufficient, and the phase functions are evaluated at the exact scattering angle of each
direction.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from seasonscapes.frames import angles_from_direction, direction_from_angles
from seasonscapes.sky.along_rays import AZIMUTHS, AZIMUTHS_RAD, diffuse_along, ground_along, radiance_components
from seasonscapes.sky.atmosphere import TOP_HEIGHT_M, Atmosphere, delta_scaled, gas_phase, optics
from seasonscapes.sky.aureole import spread_aerosol_phase
from seasonscapes.sky.curved_rays import cell_edges_m, horizon_elevation_rad, resample_rays, trace_curved_rays
from seasonscapes.sky.elevation_table import interpolate_at_elevation
from seasonscapes.sky.night import moonlight_spectrum
from seasonscapes.sky.ray_cells import CellSamples, cell_columns, sample_cells
from seasonscapes.sky.scattering import AtmosphereTables
from seasonscapes.sky.sh_moments import HARMONIC_ORDER
from seasonscapes.sky.spectrum import WAVELENGTHS_NM, rgb_from_transfer

_ROWS_ABOVE, _ROWS_BELOW, _TABLE_AZIMUTHS, _CELLS = 44, 20, 49, 36
# Exponents of the row spacing in elevation above and below the horizon.
_EXPONENT_ABOVE, _EXPONENT_BELOW = 2.5, 3.0
# From this true elevation of the sun on, its light scattered once is as smooth between the knots of `elevation_table`
# as all other light: below, the Earth's shadow rises through the air.
LOWEST_DAY_DEG = 0.0
# Aerial perspective is tabulated at these distances, and down to this depth below the model's ground.
DISTANCE_EDGES_M = np.concatenate([400e3 * np.linspace(0.0, 1.0, 41) ** 3, [520e3, 700e3, 950e3, 1300e3]])
_DEPTH_BELOW_GROUND_M = 2000.0


@dataclass(frozen=True)
class ObserverView:
    """Rays of an observer at one height, independent of the luminary.

    Parameters
    ----------
    height_m
        Height of the observer, at least one metre above the model's ground [m].
    horizon_rad
        Apparent elevation of the ground's horizon [rad].
    elevation_rad
        Apparent elevations of the rays ``(K,)`` [rad]: from the nadir to just below the horizon, then from just above
        it to the zenith.
    sky
        Cells along whole rays.
    near
        Cells between the distances `DISTANCE_EDGES_M`, for aerial perspective.
    near_depth
        Unscaled optical depth up to these distances ``(K, M, B)``.
    """

    height_m: float
    horizon_rad: float
    elevation_rad: np.ndarray
    sky: CellSamples
    near: CellSamples
    near_depth: np.ndarray


@dataclass(frozen=True)
class ScatteredRadiance:
    """Table of the radiance of one luminary scattered towards an observer; evaluate it with `sky_radiance`.

    Parameters
    ----------
    luminary_direction
        Apparent unit vector towards the luminary ``(3,)``.
    aerosol_depth
        Vertical aerosol scattering depth for red, green and blue ``(3,)``.
    asymmetry
        Mean cosine of aerosol scattering.
    horizon_rad
        As in `ObserverView`.
    components
        ``(K, A, 10)`` by elevation and by azimuth from the luminary, as in `along_rays.radiance_components`:
        photometric RGB scattered once by gas and once by aerosol, divided by their phase functions [cd/m² sr]; RGB of
        all other light [cd/m²]; and the mean aerosol column along the light path.
    """

    luminary_direction: np.ndarray
    aerosol_depth: np.ndarray
    asymmetry: float
    horizon_rad: float
    components: np.ndarray


@lru_cache(maxsize=8)
def _view(atmosphere: Atmosphere, height_m: float) -> ObserverView:
    horizon = float(horizon_elevation_rad(atmosphere, height_m))
    elevation = row_elevations_rad(horizon, _ROWS_BELOW, _ROWS_ABOVE)
    rays = trace_curved_rays(atmosphere, height_m, elevation)
    unscaled = optics(atmosphere)
    scaled = delta_scaled(unscaled, HARMONIC_ORDER)
    sky = sample_cells(atmosphere, scaled, rays, cell_edges_m(atmosphere, rays, _CELLS))
    # Terrain may lie below the model's ground, which is a mean of hills and valleys.
    floor_m = atmosphere.ground_height_m - _DEPTH_BELOW_GROUND_M
    deeper = trace_curved_rays(atmosphere, height_m, elevation, floor_m=floor_m)
    edges = np.minimum(DISTANCE_EDGES_M, deeper.distance_m[:, -1:])
    near = sample_cells(atmosphere, scaled, deeper, edges)
    midpoints = resample_rays(deeper, 0.5 * (edges[:, 1:] + edges[:, :-1]))
    depth = np.einsum("cks,cb->ksb", cell_columns(atmosphere, near.edges, midpoints), unscaled.extinction)
    depth = np.concatenate([np.zeros_like(depth[:, :1]), np.cumsum(depth, axis=1)], axis=1)
    return ObserverView(height_m, horizon, elevation, sky, near, depth)


def row_elevations_rad(horizon_rad: float, below: int, above: int) -> np.ndarray:
    """Elevations of the rows of a table [rad]: from the nadir to just below the horizon, then from just above it up.

    Parameters
    ----------
    horizon_rad
        Apparent elevation of the horizon [rad].
    below, above
        Number of rows below and above the horizon.
    """
    up = np.linspace(0.0, 1.0, above) ** _EXPONENT_ABOVE
    down = np.linspace(1.0, 0.0, below) ** _EXPONENT_BELOW
    gap = 1e-5
    lower = horizon_rad - gap - (np.pi / 2 + horizon_rad - gap) * down
    return np.concatenate([lower, horizon_rad + gap + (np.pi / 2 - horizon_rad - gap) * up])


def observer_view(tables: AtmosphereTables, height_m: float) -> ObserverView:
    """Return the rays of an observer; the results of the last calls are cached.

    Parameters
    ----------
    tables
        Tables of the atmosphere.
    height_m
        Height of the observer [m]; raised to one metre above the model's ground.

    Returns
    -------
    ObserverView
        Rays of the observer.

    Raises
    ------
    ValueError
        If the observer is not below the top of the atmosphere.
    """
    if not height_m < TOP_HEIGHT_M:
        raise ValueError(f"observer_height_m: got {height_m}, expected less than {TOP_HEIGHT_M:g}")
    return _view(tables.atmosphere, float(max(height_m, tables.atmosphere.ground_height_m + 1.0)))


def observed_sky(
    tables: AtmosphereTables,
    view: ObserverView,
    luminary_direction: np.ndarray,
    true_elevation_rad: float,
    irradiance: np.ndarray,
    diffuse: np.ndarray | None = None,
) -> ScatteredRadiance:
    """Tabulate the sky radiance of one luminary for an observer.

    Parameters
    ----------
    tables
        Tables of the atmosphere.
    view
        Rays of the observer.
    luminary_direction
        Apparent unit vector towards the luminary ``(3,)``.
    true_elevation_rad
        True (unrefracted) elevation of the luminary [rad].
    irradiance
        Extraterrestrial spectral irradiance over that of the sun at 1 au ``(B,)``.
    diffuse
        What `diffuse_at_observer` gives, where it is known already.

    Returns
    -------
    ScatteredRadiance
        Table for `sky_radiance`.
    """
    components = components_at_observer(tables, view, true_elevation_rad, irradiance, diffuse)[:, :, 0]
    return ScatteredRadiance(
        np.asarray(luminary_direction, float),
        _rgb_aerosol_depth(tables.atmosphere),
        tables.atmosphere.asymmetry,
        view.horizon_rad,
        interpolate_azimuths(components),
    )


def components_at_observer(
    tables: AtmosphereTables,
    view: ObserverView,
    true_elevation_rad: float,
    irradiance: np.ndarray,
    diffuse: np.ndarray | None = None,
    *,
    near: bool = False,
) -> np.ndarray:
    """Compute the components of a luminary's radiance along an observer's rays, or interpolate those of a sun or moon that is up.

    Parameters
    ----------
    tables
        Tables of the atmosphere.
    view
        Rays of the observer.
    true_elevation_rad
        True elevation of the luminary [rad].
    irradiance
        Extraterrestrial spectral irradiance over that of the sun at 1 au ``(B,)``.
    diffuse
        What `diffuse_at_observer` gives, where it is known already; nothing is interpolated then.
    near
        As in `diffuse_at_observer`; without it the ground at the end of the rays is included.

    Returns
    -------
    ndarray
        ``(K, A, M or 1, 10)`` float32, as of `along_rays.radiance_components`.
    """
    if diffuse is None and true_elevation_rad >= np.radians(LOWEST_DAY_DEG):
        # Light of another colour, as of an eclipsed moon, has other components.
        for table_of, spectrum in (
            (tables.day_of, np.ones_like(irradiance)),
            (tables.moon_of, moonlight_spectrum(WAVELENGTHS_NM)),
        ):
            ratio = irradiance / spectrum
            if table_of is not None and np.ptp(ratio) <= 1e-9 * ratio[0]:
                components = interpolate_at_elevation(table_of(view.height_m, near), true_elevation_rad, positive=False)
                components[..., :9] *= np.float32(ratio[0])
                return components
    if diffuse is None:
        diffuse = diffuse_at_observer(tables, view, true_elevation_rad, near=near)
    rgb_matrix = rgb_from_transfer() * irradiance
    samples = view.near if near else view.sky
    components = radiance_components(tables, samples, true_elevation_rad, rgb_matrix, diffuse, cumulative=near)
    if not near:
        ground = ground_along(tables, samples, true_elevation_rad) @ rgb_matrix.T
        components[:, :, 0, 6:9] += ground.astype(np.float32)
    return components


def diffuse_at_observer(
    tables: AtmosphereTables, view: ObserverView, true_elevation_rad: float, *, near: bool = False
) -> np.ndarray:
    """Compute diffuse light along the rays of an observer, or interpolate it if the tables have ``diffuse_of``.

    Parameters
    ----------
    tables
        Tables of the atmosphere.
    view
        Rays of the observer.
    true_elevation_rad
        True elevation of the luminary [rad].
    near
        Integrate up to each of the distances `DISTANCE_EDGES_M` after the first, in place of whole rays.

    Returns
    -------
    ndarray
        Transfers ``(K, A, M or 1, B)`` [1/sr].
    """
    if tables.diffuse_of is not None:
        return interpolate_at_elevation(tables.diffuse_of(view.height_m, near), true_elevation_rad)
    samples = view.near if near else view.sky
    return diffuse_along(tables, samples, view.elevation_rad, np.array([true_elevation_rad]), cumulative=near)[0]


def sky_radiance(light: ScatteredRadiance, direction: np.ndarray) -> np.ndarray:
    """Evaluate the radiance of the sky, or of the ground through the air, without the luminary's disc.

    Parameters
    ----------
    light
        Table of `observed_sky`.
    direction
        Unit vectors ``(..., 3)``.

    Returns
    -------
    ndarray
        Radiance ``(..., 3)`` [cd/m²].
    """
    azimuth_deg, elevation_deg = angles_from_direction(direction)
    row = elevation_index(np.radians(elevation_deg), light.horizon_rad)
    column = azimuth_index(azimuth_deg, light.luminary_direction)
    coordinates = tuple((index.ravel(), fraction.ravel()) for index, fraction in (row, column))
    components = interpolate_multilinear(light.components, coordinates)
    components = components.reshape(*direction.shape[:-1], light.components.shape[-1])
    return apply_phase_functions(light, components, direction @ light.luminary_direction)


def sky_radiance_grid(light: ScatteredRadiance, elevation_deg: np.ndarray, azimuth_deg: np.ndarray) -> np.ndarray:
    """Evaluate `sky_radiance` on a grid of elevations and azimuths, interpolating each axis once.

    Parameters
    ----------
    light
        Table of `observed_sky`.
    elevation_deg
        Elevations ``(R,)`` [deg].
    azimuth_deg
        Azimuths clockwise from north ``(C,)`` [deg].

    Returns
    -------
    ndarray
        Radiance ``(R, C, 3)`` [cd/m²].
    """
    row, fr = elevation_index(np.radians(elevation_deg), light.horizon_rad)
    column, fa = azimuth_index(azimuth_deg, light.luminary_direction)
    fr, fa = fr[:, None, None].astype(np.float32), fa[:, None].astype(np.float32)
    rows = light.components[row] * (1.0 - fr) + light.components[row + 1] * fr
    components = rows[:, column] * (1.0 - fa) + rows[:, column + 1] * fa
    direction = direction_from_angles(azimuth_deg[None, :], elevation_deg[:, None])
    return apply_phase_functions(light, components, direction @ light.luminary_direction)


def interpolate_multilinear(table: np.ndarray, coordinates: tuple[tuple[np.ndarray, np.ndarray], ...]) -> np.ndarray:
    """Interpolate a table multilinearly in its leading axes.

    Parameters
    ----------
    table
        Values with one leading axis for each pair of ``coordinates``.
    coordinates
        Index ``(N,)`` and fraction towards the next index ``(N,)`` for each interpolated axis.

    Returns
    -------
    ndarray
        Interpolated values ``(N, ...)``, float32.
    """
    axes = len(coordinates)
    rows = table.reshape(int(np.prod(table.shape[:axes])), -1)
    strides = np.cumprod((1, *table.shape[axes - 1 : 0 : -1]))[::-1]
    base = np.asarray(sum(index * stride for (index, _), stride in zip(coordinates, strides, strict=True)))
    out = np.zeros((len(base), rows.shape[1]), np.float32)
    for corner in np.ndindex(*(2,) * axes):
        factors = [
            fraction if upper else 1.0 - fraction for upper, (_, fraction) in zip(corner, coordinates, strict=True)
        ]
        weight = np.prod(factors, axis=0)
        out += np.take(rows, base + int(np.dot(corner, strides)), axis=0) * weight.astype(np.float32)[:, None]
    return out.reshape(len(base), *table.shape[axes:])


def apply_phase_functions(light: ScatteredRadiance, components: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Sum interpolated components to radiance, with single scattering multiplied by its phase functions.

    Parameters
    ----------
    light
        Table of the components.
    components
        Interpolated components ``(..., 10)``.
    cosine
        Cosine of the angle from the luminary, of a shape that broadcasts to ``(...)``.

    Returns
    -------
    ndarray
        Radiance ``(..., 3)`` [cd/m²].
    """
    cosine = np.clip(cosine, -1.0, 1.0)
    depth = np.multiply.outer(light.aerosol_depth.astype(np.float32), components[..., 9])
    aerosol = spread_aerosol_phase(cosine, np.moveaxis(depth, 0, -1), light.asymmetry, HARMONIC_ORDER)
    gas = gas_phase(cosine).astype(np.float32)
    radiance = np.empty((*components.shape[:-1], 3), np.result_type(components, aerosol))
    for channel in range(3):
        once_by_gas, once_by_aerosol, other = (components[..., k + channel] for k in (0, 3, 6))
        radiance[..., channel] = once_by_gas * gas + once_by_aerosol * aerosol[..., channel] + other
    return radiance


def _rgb_aerosol_depth(atmosphere: Atmosphere) -> np.ndarray:
    """Vertical aerosol scattering depth ``(3,)`` at the central wavelengths of the three primaries."""
    return np.interp([610.0, 550.0, 465.0], WAVELENGTHS_NM, optics(atmosphere).scattering[1])


def interpolate_azimuths(components: np.ndarray) -> np.ndarray:
    """Interpolate components by a cosine series in azimuth on a uniform grid from 0 to π.

    Parameters
    ----------
    components
        Values at `along_rays.AZIMUTHS_RAD` ``(K, A, ...)``.

    Returns
    -------
    ndarray
        Values on the grid of the tables ``(K, A', ...)``.
    """
    azimuths = np.linspace(0.0, np.pi, _TABLE_AZIMUTHS)
    order = np.arange(AZIMUTHS)
    forward = np.cos(np.outer(order, AZIMUTHS_RAD)) * (2.0 / AZIMUTHS)
    forward[0] *= 0.5
    series = (np.cos(np.outer(azimuths, order)) @ forward).astype(np.float32)
    interpolated = series @ components.reshape(len(components), AZIMUTHS, -1)
    return interpolated.reshape(len(components), _TABLE_AZIMUTHS, *components.shape[2:])


def elevation_index(elevation_rad: np.ndarray, horizon_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the interpolation index and fraction of elevations in the rows of `ObserverView`.

    Rows above and below the horizon are never mixed.

    Parameters
    ----------
    elevation_rad
        Apparent elevation ``(...)`` [rad].
    horizon_rad
        Apparent elevation of the horizon [rad].

    Returns
    -------
    index, fraction
        Lower row and fraction towards the next ``(...)``.
    """
    up = np.maximum(elevation_rad - horizon_rad, 0.0) / (np.pi / 2 - horizon_rad)
    down = np.maximum(horizon_rad - elevation_rad, 0.0) / (np.pi / 2 + horizon_rad)
    above = elevation_rad >= horizon_rad
    high = np.minimum(up, 1.0) ** (1.0 / _EXPONENT_ABOVE) * (_ROWS_ABOVE - 1)
    low = (1.0 - np.minimum(down, 1.0) ** (1.0 / _EXPONENT_BELOW)) * (_ROWS_BELOW - 1)
    first = np.where(above, _ROWS_BELOW, 0)
    last = np.where(above, _ROWS_BELOW + _ROWS_ABOVE - 2, _ROWS_BELOW - 2)
    position = np.where(above, _ROWS_BELOW + high, low)
    row = np.clip(position.astype(int), first, last)
    return row, position - row


def azimuth_index(azimuth_deg: np.ndarray, luminary_direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the interpolation index and fraction of azimuths in the columns of `ScatteredRadiance`.

    Parameters
    ----------
    azimuth_deg
        Azimuth clockwise from north ``(...)`` [deg].
    luminary_direction
        Vector towards the luminary ``(3,)``.

    Returns
    -------
    index, fraction
        Lower column and fraction towards the next ``(...)``.
    """
    luminary_azimuth, _ = angles_from_direction(luminary_direction)
    difference = np.abs((azimuth_deg - luminary_azimuth + 180.0) % 360.0 - 180.0)
    position = difference * ((_TABLE_AZIMUTHS - 1) / 180.0)
    column = np.minimum(position.astype(int), _TABLE_AZIMUTHS - 2)
    return column, position - column
