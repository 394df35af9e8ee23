"""What one observer sees of the sky: scattered light along whole rays, under any luminary.

For each ray three sums are kept apart, light scattered once by gas, once by aerosol, and everything else. Without their
phase functions the first two are smooth in azimuth (Bruneton & Neyret 2008, § 4), so few azimuths do, and the aureole
is as sharp as its phase function wherever it is looked up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from seasonscapes.frames import angles_from_direction, direction_from_angles
from seasonscapes.sky.along_rays import AZIMUTHS, AZIMUTHS_RAD, diffuse_along, ground_along, parts_along
from seasonscapes.sky.atmosphere import TOP_HEIGHT_M, Atmosphere, delta_scaled, gas_phase, optics
from seasonscapes.sky.aureole import spread_aerosol_phase
from seasonscapes.sky.curved_rays import equal_cells, horizon_elevation_rad, resampled, trace_curved_rays
from seasonscapes.sky.elevation_table import at_elevation, by_elevation
from seasonscapes.sky.ray_cells import CellSamples, cell_columns, sample_cells
from seasonscapes.sky.scattering import AtmosphereTables
from seasonscapes.sky.sh_moments import HARMONIC_ORDER
from seasonscapes.sky.spectrum import WAVELENGTHS_NM, rgb_from_transfer

_ABOVE, _BELOW, _AZIMUTHS_OUT, _CELLS = 44, 20, 49, 36
_SPACING_ABOVE, _SPACING_BELOW = 2.5, 3.0
# Aerial perspective is tabulated up to these distances, and down to this far below the model's ground.
DISTANCE_EDGES_M = np.concatenate([400e3 * np.linspace(0.0, 1.0, 41) ** 3, [520e3, 700e3, 950e3, 1300e3]])
_CELLAR_M = 2000.0


@dataclass(frozen=True)
class ObserverView:
    """The rays of an observer at one height, which do not know the time.

    Parameters
    ----------
    height_m
        Of the observer, at least a metre above the model's ground [m].
    horizon_rad
        Apparent elevation of the ground's horizon.
    elevation_rad
        ``(K,)``: from the nadir up to just below the horizon, then from just above it to the zenith.
    sky
        Cells along whole rays.
    near
        Cells between fixed distances, for aerial perspective.
    near_depth
        Optical depth ``(K, M, B)`` up to those distances, without any scaling.
    """

    height_m: float
    horizon_rad: float
    elevation_rad: np.ndarray
    sky: CellSamples
    near: CellSamples
    near_depth: np.ndarray


@dataclass(frozen=True)
class ScatteredRadiance:
    """Light of one luminary scattered towards an observer, ready to be looked up in any direction.

    Parameters
    ----------
    luminary_direction
        Apparent unit vector towards the source ``(3,)``.
    aerosol_depth
        Vertical scattering depth of the aerosol for red, green and blue ``(3,)``.
    asymmetry
        Of the aerosol.
    horizon_rad
        As in `ObserverView`.
    parts
        ``(K, A, 10)``: by elevation and azimuth from the source, what gas and aerosol scatter once, over their phase
        functions, and all else, as photometric RGB [cd/m²]; and the mean column of aerosol on the light's way.
    """

    luminary_direction: np.ndarray
    aerosol_depth: np.ndarray
    asymmetry: float
    horizon_rad: float
    parts: np.ndarray


@lru_cache(maxsize=8)
def _view(atmosphere, height_m: float) -> ObserverView:
    horizon = float(horizon_elevation_rad(atmosphere, height_m))
    up = np.linspace(0.0, 1.0, _ABOVE) ** _SPACING_ABOVE
    down = np.linspace(1.0, 0.0, _BELOW) ** _SPACING_BELOW
    gap = 1e-5
    below, above = horizon - gap - (np.pi / 2 + horizon - gap) * down, horizon + gap + (np.pi / 2 - horizon - gap) * up
    elevation = np.concatenate([below, above])
    paths = trace_curved_rays(atmosphere, height_m, elevation)
    plain = optics(atmosphere)
    scaled = delta_scaled(plain, HARMONIC_ORDER)
    sky = sample_cells(atmosphere, scaled, paths, equal_cells(atmosphere, paths, _CELLS))
    # A mountain may stand a little below the model's ground, as it does where that is a mean of hills and valleys.
    deeper = trace_curved_rays(atmosphere, height_m, elevation, floor_m=atmosphere.ground_height_m - _CELLAR_M)
    edges = np.minimum(DISTANCE_EDGES_M, deeper.distance_m[:, -1:])
    near = sample_cells(atmosphere, scaled, deeper, edges)
    middles = resampled(deeper, 0.5 * (edges[:, 1:] + edges[:, :-1]))
    depth = np.einsum("cks,cb->ksb", cell_columns(atmosphere, near.paths, middles), plain.extinction)
    depth = np.concatenate([np.zeros_like(depth[:, :1]), np.cumsum(depth, axis=1)], axis=1)
    return ObserverView(height_m, horizon, elevation, sky, near, depth)


def observer_view(tables: AtmosphereTables, height_m: float) -> ObserverView:
    """The rays of an observer at a height [m]; kept for the next call.

    Raises
    ------
    ValueError
        Above the top of the air.
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
) -> ScatteredRadiance:
    """Sky of a luminary for an observer.

    Parameters
    ----------
    luminary_direction
        Apparent unit vector ``(3,)`` towards it.
    true_elevation_rad
        Its elevation without refraction.
    irradiance
        Spectral irradiance above the air over that of the sun at 1 au ``(B,)``.
    """
    colours = rgb_from_transfer() * irradiance
    parts = parts_along(
        tables, view.sky, true_elevation_rad, colours, diffuse_at_observer(tables, view, true_elevation_rad)
    )
    parts = parts[:, :, 0]
    parts[:, :, 6:9] += (ground_along(tables, view.sky, true_elevation_rad) @ colours.T).astype(np.float32)
    return ScatteredRadiance(
        np.asarray(luminary_direction, float),
        _rgb_aerosol_depth(tables.atmosphere),
        tables.atmosphere.asymmetry,
        view.horizon_rad,
        azimuths_filled(parts),
    )


def diffuse_at_observer(
    tables: AtmosphereTables, view: ObserverView, true_elevation_rad: float, *, near: bool = False
) -> np.ndarray:
    """Transfers of diffuse light along whole rays ``(K, A, 1, B)``, or up to each of the fixed distances but the first.

    They are worked out for this sun, or looked up where the tables came with diffuse light by the sun's elevation.
    """
    if tables.diffuse_of is not None:
        return at_elevation(tables.diffuse_of(view.height_m, near), true_elevation_rad)
    samples = view.near if near else view.sky
    return diffuse_along(tables, samples, view.elevation_rad, np.array([true_elevation_rad]), cumulative=near)[0]


def diffuse_by_elevation(
    tables: AtmosphereTables, height_m: float, near: bool, *, progress: Callable[[float], None] | None = None
) -> np.ndarray:
    """`diffuse_at_observer` of every sun, as a table of `elevation_table`; some seconds."""
    view = observer_view(tables, height_m)
    samples = view.near if near else view.sky
    return by_elevation(
        lambda suns: diffuse_along(tables, samples, view.elevation_rad, suns, cumulative=near), progress=progress
    )


def sky_radiance(light: ScatteredRadiance, direction: np.ndarray) -> np.ndarray:
    """Radiance ``(..., 3)`` [cd/m²] of the sky, or of the ground through the air, in directions ``(..., 3)``."""
    azimuth_deg, elevation_deg = angles_from_direction(direction)
    row, column = row_of(np.radians(elevation_deg), light.horizon_rad), column_of(azimuth_deg, light.luminary_direction)
    places = tuple((index.ravel(), share.ravel()) for index, share in (row, column))
    parts = interpolated(light.parts, places).reshape(*direction.shape[:-1], light.parts.shape[-1])
    return with_phases(light, parts, direction @ light.luminary_direction)


def sky_radiance_grid(light: ScatteredRadiance, elevation_deg: np.ndarray, azimuth_deg: np.ndarray) -> np.ndarray:
    """`sky_radiance` ``(R, C, 3)`` of R elevations crossed with C azimuths [deg]: each axis is interpolated once."""
    row, fr = row_of(np.radians(elevation_deg), light.horizon_rad)
    column, fa = column_of(azimuth_deg, light.luminary_direction)
    fr, fa = fr[:, None, None].astype(np.float32), fa[:, None].astype(np.float32)
    rows = light.parts[row] * (1.0 - fr) + light.parts[row + 1] * fr
    parts = rows[:, column] * (1.0 - fa) + rows[:, column + 1] * fa
    direction = direction_from_angles(azimuth_deg[None, :], elevation_deg[:, None])
    return with_phases(light, parts, direction @ light.luminary_direction)


def interpolated(table: np.ndarray, places: tuple[tuple[np.ndarray, np.ndarray], ...]) -> np.ndarray:
    """Multilinear interpolation ``(N, ...)`` in a table's first axes, at pairs of index ``(N,)`` and share ``(N,)``."""
    axes = len(places)
    rows = table.reshape(int(np.prod(table.shape[:axes])), -1)
    strides = np.cumprod((1, *table.shape[axes - 1 : 0 : -1]))[::-1]
    base = sum(index * stride for (index, _), stride in zip(places, strides, strict=True))
    out = np.zeros((len(base), rows.shape[1]), np.float32)
    for corner in np.ndindex(*(2,) * axes):
        weight = np.prod([share if up else 1.0 - share for up, (_, share) in zip(corner, places, strict=True)], axis=0)
        out += np.take(rows, base + int(np.dot(corner, strides)), axis=0) * weight.astype(np.float32)[:, None]
    return out.reshape(len(base), *table.shape[axes:])


def with_phases(light: ScatteredRadiance, parts: np.ndarray, cosine: np.ndarray) -> np.ndarray:
    """Radiance ``(..., 3)`` [cd/m²] of parts ``(..., 10)`` at angles ``(...)`` from the source, given by their cosines."""
    cosine = np.clip(cosine, -1.0, 1.0)
    depth = parts[..., 9:] * light.aerosol_depth.astype(np.float32)
    aerosol = spread_aerosol_phase(cosine, depth, light.asymmetry, HARMONIC_ORDER)
    gas = gas_phase(cosine)[..., None].astype(np.float32)
    return parts[..., :3] * gas + parts[..., 3:6] * aerosol + parts[..., 6:9]


def _rgb_aerosol_depth(atmosphere: Atmosphere) -> np.ndarray:
    """Scattering depth ``(3,)`` at the middles of the three primaries."""
    return np.interp([610.0, 550.0, 465.0], WAVELENGTHS_NM, optics(atmosphere).scattering[1])


def azimuths_filled(parts: np.ndarray) -> np.ndarray:
    """Cosine series through the computed azimuths, at an even grid from 0 to π: ``(K, A, ...)`` → ``(K, A', ...)``."""
    outer = np.linspace(0.0, np.pi, _AZIMUTHS_OUT)
    order = np.arange(AZIMUTHS)
    forward = np.cos(np.outer(order, AZIMUTHS_RAD)) * (2.0 / AZIMUTHS)
    forward[0] *= 0.5
    series = (np.cos(np.outer(outer, order)) @ forward).astype(np.float32)
    filled = series @ parts.reshape(len(parts), AZIMUTHS, -1)
    return filled.reshape(len(parts), _AZIMUTHS_OUT, *parts.shape[2:])


def row_of(elevation_rad: np.ndarray, horizon_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Row below and share towards the next in the tables of a `ObserverView`, never across the horizon."""
    up = np.maximum(elevation_rad - horizon_rad, 0.0) / (np.pi / 2 - horizon_rad)
    down = np.maximum(horizon_rad - elevation_rad, 0.0) / (np.pi / 2 + horizon_rad)
    above = elevation_rad >= horizon_rad
    high = np.minimum(up, 1.0) ** (1.0 / _SPACING_ABOVE) * (_ABOVE - 1)
    low = (1.0 - np.minimum(down, 1.0) ** (1.0 / _SPACING_BELOW)) * (_BELOW - 1)
    first, last = np.where(above, _BELOW, 0), np.where(above, _BELOW + _ABOVE - 2, _BELOW - 2)
    position = np.where(above, _BELOW + high, low)
    row = np.clip(position.astype(int), first, last)
    return row, position - row


def column_of(azimuth_deg: np.ndarray, luminary_direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    luminary_azimuth, _ = angles_from_direction(luminary_direction)
    turn = np.abs((azimuth_deg - luminary_azimuth + 180.0) % 360.0 - 180.0)
    position = turn * ((_AZIMUTHS_OUT - 1) / 180.0)
    column = np.minimum(position.astype(int), _AZIMUTHS_OUT - 2)
    return column, position - column
