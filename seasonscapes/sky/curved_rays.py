"""Refracted rays in a spherical atmosphere, and slant columns from any point to the sun."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.sky.atmosphere import TOP_HEIGHT_M, Atmosphere, Optics, constituent_densities, refractivity

SUN_RADIUS_DEG = 0.26656  # at 1 au
SUN_HEIGHTS, SUN_ELEVATIONS = 56, 160
_MIN_COLUMN = 1e-12
# What an atmosphere states that normalised density profiles and the refraction of rays do not depend on.
_NOT_IN_UNIT_COLUMNS = {
    *("aerosol_optical_depth_500nm", "angstrom_exponent", "single_scattering_albedo", "asymmetry"),
    *("ozone_du", "ground_albedo"),
}
# Share of points in sunlight above which those in shadow are not worth setting apart.
MANY_LIT = 0.5


@dataclass(frozen=True)
class CurvedRays:
    """Refracted rays, sampled from their origins to the top of the atmosphere or to the ground.

    All samples beyond the end of a ray repeat its last one.

    Parameters
    ----------
    distance_m
        Arc length from the origin ``(K, S + 1)`` [m].
    height_m
        Height ``(K, S + 1)`` [m].
    central_angle_rad
        Angle about the Earth's centre between sample and origin ``(K, S + 1)`` [rad].
    elevation_rad
        Elevation of the ray above the local horizontal plane ``(K, S + 1)`` [rad].
    ends_on_ground
        Whether the ray ends on the ground ``(K,)``.
    """

    distance_m: np.ndarray
    height_m: np.ndarray
    central_angle_rad: np.ndarray
    elevation_rad: np.ndarray
    ends_on_ground: np.ndarray


@dataclass(frozen=True)
class SunColumns:
    """Slant columns to the sun, tabulated by height and by true solar elevation above the local horizontal plane.

    The grid is uniform in the cube root of height, and in the cube root of the elevation above the lowest one whose
    ray clears the ground.

    Parameters
    ----------
    lowest_rad
        True elevation ``(P,)`` of a star whose refracted ray grazes the ground [rad].
    log_columns
        ``(P, Q, 4)``: logarithms of the columns of the three constituents in units of their vertical columns, and of
        the magnification by refraction, ``d apparent / d true`` elevation.
    """

    lowest_rad: np.ndarray
    log_columns: np.ndarray


def horizon_elevation_rad(atmosphere: Atmosphere, height_m: ArrayLike) -> np.ndarray:
    """Compute the apparent elevation of the horizon from Bouguer's invariant ``n r cos e``.

    Parameters
    ----------
    atmosphere
        Atmosphere.
    height_m
        Height of the observer ``(...)`` [m].

    Returns
    -------
    ndarray
        Apparent elevation of the ray that grazes the ground ``(...)`` [rad], at most 0.
    """
    ground, radius = atmosphere.ground_radius_m, atmosphere.ground_radius_m - atmosphere.ground_height_m
    index_ratio = (1.0 + refractivity(atmosphere, atmosphere.ground_height_m)[0]) / (
        1.0 + refractivity(atmosphere, height_m)[0]
    )
    return -np.arccos(np.minimum(index_ratio * ground / (radius + np.asarray(height_m, float)), 1.0))


def trace_curved_rays(
    atmosphere: Atmosphere, height_m: ArrayLike, elevation_rad: ArrayLike, *, floor_m: float | None = None
) -> CurvedRays:
    """Trace refracted rays by the midpoint rule.

    Ray equations in a spherical atmosphere, with arc length ``s``, central angle ``ψ`` and ``n' = dn/dr``:
    ``dr/ds = sin e``, ``dψ/ds = cos e / r``, ``de/ds = cos e (1/r + n'/n)``.

    Parameters
    ----------
    atmosphere
        Atmosphere.
    height_m, elevation_rad
        Height [m] and apparent elevation [rad] of the rays at their origins, broadcast to ``(K,)``.
    floor_m
        Height at which descending rays end [m]; the atmosphere's ground if omitted. Ascending rays end at the top
        of the atmosphere.

    Returns
    -------
    CurvedRays
        K rays.
    """
    height, elevation = (np.array(x, float) for x in np.broadcast_arrays(height_m, elevation_rad))
    centre = atmosphere.ground_radius_m - atmosphere.ground_height_m
    ground = atmosphere.ground_height_m if floor_m is None else floor_m
    distance, central_angle = np.zeros_like(height), np.zeros_like(height)
    states, on_ground = [(distance, height, central_angle, elevation)], np.zeros(height.shape, bool)
    active = np.ones(height.shape, bool)

    def derivatives(h: np.ndarray, e: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``dr/ds``, ``dψ/ds`` and ``de/ds``."""
        index, gradient = refractivity(atmosphere, h)
        angular = np.cos(e) / (centre + h)
        return np.sin(e), angular, angular + np.cos(e) * gradient / (1.0 + index)

    while active.any():
        above = np.maximum(height - atmosphere.ground_height_m, 0.0)
        step = np.minimum((40.0 + 0.04 * above) / (np.abs(np.sin(elevation)) + 0.02), 15e3)
        rise, _, bend = derivatives(height, elevation)
        rise, angular, bend = derivatives(height + 0.5 * step * rise, elevation + 0.5 * step * bend)
        new_height = height + step * rise
        hits, exits = new_height < ground, (new_height > TOP_HEIGHT_M) & (rise > 0.0)
        limit = np.where(hits, ground, TOP_HEIGHT_M)
        fraction = np.where(hits | exits, (limit - height) / np.where(rise == 0.0, 1.0, step * rise), 1.0)
        step = np.where(active, step * np.clip(fraction, 0.0, 1.0), 0.0)
        distance, height = distance + step, height + step * rise
        central_angle, elevation = central_angle + step * angular, elevation + step * bend
        on_ground |= active & hits
        active = active & ~(hits | exits)
        states.append((distance, height, central_angle, elevation))
    distances, heights, central_angles, elevations = (np.stack(arrays, axis=-1) for arrays in zip(*states, strict=True))
    return CurvedRays(distances, heights, central_angles, elevations, on_ground)


def resample_rays(rays: CurvedRays, distance_m: np.ndarray) -> CurvedRays:
    """Interpolate rays linearly at other distances.

    Parameters
    ----------
    rays
        K rays.
    distance_m
        Arc lengths ``(K, M)`` [m]; clamped to the ends of the rays.

    Returns
    -------
    CurvedRays
        The rays with M samples each.
    """
    quantities = (rays.height_m, rays.central_angle_rad, rays.elevation_rad)
    height, central_angle, elevation = (np.empty(distance_m.shape) for _ in quantities)
    for k, distances in enumerate(distance_m):
        # Samples beyond the end of a ray repeat its last distance; exclude them from the interpolation.
        distinct = np.r_[True, np.diff(rays.distance_m[k]) > 0.0]
        for target, source in zip((height, central_angle, elevation), quantities, strict=True):
            target[k] = np.interp(distances, rays.distance_m[k][distinct], source[k][distinct])
    clamped = np.minimum(distance_m, rays.distance_m[:, -1:])
    return CurvedRays(clamped, height, central_angle, elevation, rays.ends_on_ground)


def cell_edges_m(atmosphere: Atmosphere, rays: CurvedRays, cells: int) -> np.ndarray:
    """Divide rays into cells of equal weight, where the weight follows the densities along the ray.

    The weight is a sum of the densities of aerosol, gas and ozone and of plain distance, so that every part of a ray is
    sampled.

    Parameters
    ----------
    atmosphere
        Atmosphere.
    rays
        K rays.
    cells
        Number of cells per ray.

    Returns
    -------
    ndarray
        Arc lengths of the cell edges ``(K, cells + 1)`` [m].
    """
    centre = 0.5 * (rays.height_m[:, 1:] + rays.height_m[:, :-1])
    length = np.diff(rays.distance_m, axis=1)
    above = np.maximum(centre - atmosphere.ground_height_m, 0.0)
    scale = min(atmosphere.aerosol_scale_height_m, 8e3)
    weight = np.exp(-above / scale) / scale + np.exp(-above / 8e3) / 8e3 + np.exp(-above / 25e3) / 25e3
    # The small terms keep rays of zero length, upwards from the top, well defined.
    weight = (weight * length + 1e-9) / np.sum(weight * length + 1e-9, axis=1, keepdims=True)
    # A fifth of the weight is uniform in distance, for distant limbs observed from above and for the thin upper air.
    weight = 0.8 * weight + 0.2 * (length + 1e-3) / np.sum(length + 1e-3, axis=1, keepdims=True)
    total = np.concatenate([np.zeros((len(weight), 1)), np.cumsum(weight, axis=1)], axis=1)
    targets = np.linspace(0.0, 1.0, cells + 1)
    edges = [np.interp(targets, t, d) for t, d in zip(total, rays.distance_m, strict=True)]
    return np.array(edges)


def sun_columns(atmosphere: Atmosphere) -> SunColumns:
    """Tabulate the slant columns to the sun along refracted rays.

    Parameters
    ----------
    atmosphere
        Atmosphere.

    Returns
    -------
    SunColumns
        Table of `SUN_HEIGHTS` heights and `SUN_ELEVATIONS` solar elevations; read-only, since atmospheres of one profile
        share it.
    """
    # In units of the vertical columns: how much of each constituent there is, and what it does to light, does not matter.
    unit = {field.name: field.default for field in fields(Atmosphere) if field.name in _NOT_IN_UNIT_COLUMNS}
    return _unit_sun_columns(replace(atmosphere, **unit))


@lru_cache(maxsize=16)
def _unit_sun_columns(atmosphere: Atmosphere) -> SunColumns:
    """`sun_columns`, once for each profile."""
    heights = atmosphere.ground_height_m + _thickness_m(atmosphere) * np.linspace(0.0, 1.0, SUN_HEIGHTS) ** 3
    fraction = np.linspace(0.0, 1.0, SUN_ELEVATIONS)
    horizon = horizon_elevation_rad(atmosphere, heights)
    apparent = horizon[:, None] + (np.pi / 2 - horizon[:, None]) * fraction**3
    rays = trace_curved_rays(atmosphere, np.repeat(heights, len(fraction)), apparent.ravel(), floor_m=-np.inf)
    columns = np.zeros((3, rays.distance_m.shape[0]))
    for s in range(rays.distance_m.shape[1] - 1):
        step = rays.distance_m[:, s + 1] - rays.distance_m[:, s]
        columns += constituent_densities(atmosphere, 0.5 * (rays.height_m[:, s] + rays.height_m[:, s + 1])) * step
    columns = columns.reshape(3, *apparent.shape)
    true = (rays.elevation_rad[:, -1] - rays.central_angle_rad[:, -1]).reshape(apparent.shape)
    true[:, -1] = np.pi / 2
    magnification = np.gradient(apparent, axis=1) / np.gradient(true, axis=1)
    table = np.empty((*apparent.shape, 4))
    for p, (e, low) in enumerate(zip(true, true[:, 0], strict=True)):
        grid = low + (np.pi / 2 - low) * fraction**3
        for q, values in enumerate((*columns[:, p], magnification[p])):
            table[p, :, q] = np.interp(grid, e, np.log(np.maximum(values, _MIN_COLUMN)))
    found = SunColumns(true[:, 0].copy(), table)
    found.lowest_rad.flags.writeable = found.log_columns.flags.writeable = False
    return found


def slant_columns_to_sun(
    atmosphere: Atmosphere,
    columns: SunColumns,
    height_m: ArrayLike,
    elevation_rad: ArrayLike,
    *,
    radius_deg: float = SUN_RADIUS_DEG,
) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate the slant columns to the sun and compute the visible fraction of its disc.

    Parameters
    ----------
    atmosphere, columns
        Atmosphere and its table from `sun_columns`.
    height_m
        Heights of the points ``(...)`` [m].
    elevation_rad
        True (unrefracted) elevation of the disc's centre above the points' horizontal plane ``(...)`` [rad].
    radius_deg
        Angular radius of the disc [deg].

    Returns
    -------
    columns
        Columns along the refracted ray to the centroid of the disc's visible part, in units of the vertical columns
        ``(..., 3)``.
    visible_fraction
        Fraction of the disc above the horizon of the ground, times the magnification by refraction ``(...)``.
    """
    heights = columns.log_columns.shape[0]
    above = np.clip((np.asarray(height_m) - atmosphere.ground_height_m) / _thickness_m(atmosphere), 0.0, 1.0)
    row = np.cbrt(above) * (heights - 1)
    row0 = np.minimum(row.astype(np.int32), heights - 2)
    fr = row - row0
    lowest = columns.lowest_rad[row0] * (1.0 - fr) + columns.lowest_rad[row0 + 1] * fr
    radius_rad, above_lowest = np.radians(radius_deg), np.asarray(elevation_rad) - lowest
    lit = above_lowest > -radius_rad
    if np.count_nonzero(lit) >= MANY_LIT * lit.size:
        return _columns_above(columns, row0, fr, lowest, above_lowest, radius_rad)
    # In the Earth's shadow the columns are those of the lowest ray at the height, whatever the azimuth is.
    dark, _ = _columns_above(columns, row0, fr, lowest, np.full(row0.shape, -np.inf), radius_rad)
    column = np.broadcast_to(dark, (*lit.shape, 3)).copy()
    visible = np.zeros(lit.shape)
    rows, fractions, lows = (np.broadcast_to(each, lit.shape)[lit] for each in (row0, fr, lowest))
    column[lit], visible[lit] = _columns_above(columns, rows, fractions, lows, above_lowest[lit], radius_rad)
    return column, visible


def _columns_above(
    columns: SunColumns,
    row0: np.ndarray,
    fr: np.ndarray,
    lowest_rad: np.ndarray,
    above_lowest_rad: np.ndarray,
    radius_rad: float,
) -> tuple[np.ndarray, np.ndarray]:
    """`slant_columns_to_sun` by rows of the table of columns and the elevation above the lowest ray [rad]."""
    elevations = columns.log_columns.shape[1]
    visible, centre = _disc_above(above_lowest_rad, radius_rad)
    column = np.cbrt(np.clip(centre / (np.pi / 2 - lowest_rad), 0.0, 1.0)) * (elevations - 1)
    column0 = np.minimum(column.astype(np.int32), elevations - 2)
    fc = (column - column0)[..., None]
    table, index = columns.log_columns.reshape(-1, 4), row0 * elevations + column0
    near = table[index] * (1.0 - fc) + table[index + 1] * fc
    far = table[index + elevations] * (1.0 - fc) + table[index + elevations + 1] * fc
    interpolated = np.exp(near * (1.0 - fr)[..., None] + far * fr[..., None])
    return interpolated[..., :3], interpolated[..., 3] * visible


def sun_transfer(
    atmosphere: Atmosphere,
    columns: SunColumns,
    optics: Optics,
    height_m: ArrayLike,
    elevation_rad: ArrayLike,
    *,
    radius_deg: float = SUN_RADIUS_DEG,
) -> np.ndarray:
    """Compute the transmittance of direct sunlight to points by Beer's law, including the visible fraction of the disc.

    Parameters
    ----------
    atmosphere, columns
        Atmosphere and its table from `sun_columns`.
    optics
        Vertical optical depths to use.
    height_m, elevation_rad, radius_deg
        As in `slant_columns_to_sun`.

    Returns
    -------
    ndarray
        Normal irradiance over the extraterrestrial one, per band ``(..., B)``.
    """
    column, visible = slant_columns_to_sun(atmosphere, columns, height_m, elevation_rad, radius_deg=radius_deg)
    return np.exp(-(column @ optics.extinction)) * visible[..., None]


def _thickness_m(atmosphere: Atmosphere) -> float:
    return TOP_HEIGHT_M - atmosphere.ground_height_m


def _disc_above(elevation_rad: np.ndarray, radius_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Fraction of a disc above a straight horizon, and the elevation of that part's centroid above it [rad]."""
    x = np.clip(elevation_rad / radius_rad, -1.0, 1.0)
    chord = np.sqrt(1.0 - x**2)
    fraction = (np.arccos(-x) + x * chord) / np.pi
    lift = 2.0 / (3.0 * np.pi) * chord**3 / np.maximum(fraction, 1e-9)
    return fraction, np.maximum(elevation_rad + radius_rad * lift, 0.0)
