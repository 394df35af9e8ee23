"""Small tables of the light of a clear or hazy sky over the elevation of its luminary and the height of the observer.

A program without the atmosphere model (a page in a browser) evaluates sky, air, sun and moon from them at any instant.
What the model tabulates for one luminary is smooth in azimuth: a cosine series (`along_rays.AZIMUTHS` terms) holds all of
it. Over the luminary's elevation components are interpolated about their geometric mean size, by cubics, since twilight
falls by a factor of a million within 18°.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.progress import TaskProgress
from seasonscapes.sky import observer_radiance as radiance
from seasonscapes.sky.aerial_perspective import airlight, tabulate_aerial_perspective
from seasonscapes.sky.along_rays import AZIMUTHS, diffuse_along
from seasonscapes.sky.aureole import spread_aerosol_phase
from seasonscapes.sky.clear_sky import sun_luminary, surface_transfer, true_elevation_deg
from seasonscapes.sky.night import night_sky_radiance
from seasonscapes.sky.scattering import AtmosphereTables
from seasonscapes.sky.sh_moments import HARMONIC_ORDER
from seasonscapes.sky.spectrum import WAVELENGTHS_NM, angstrom_ratio, rayleigh_optical_depth

# Apparent elevations of the luminary [deg]; dense where twilight and the reddening of the sun change fast.
_TWILIGHT_DEG = (-18, -16.5, -15, -13.5, -12, -10, -8.5, -7, -6, -5, -4, -3.2, -2.5, -1.8, -1.2, -0.6)
_DAY_DEG = (0, 0.6, 1.2, 2, 3, 4, 5.5, 7, 9, 12, 16, 21, 27, 34, 42, 51, 60, 70, 80, 90)
KNOTS_DEG = np.array([*_TWILIGHT_DEG, *_DAY_DEG], float)
# Apparent elevations of the luminary for the direct light [deg].
DIRECT_DEG = np.concatenate([np.linspace(-3.0, 5.0, 161), np.linspace(5.5, 20.0, 30), np.linspace(21.0, 90.0, 70)])
# Rows of the air's table below and above the horizon, and distances of its columns as indices of `DISTANCE_EDGES_M`.
AIR_ROWS_BELOW, AIR_ROWS_ABOVE = 8, 9
_COLUMNS = (0, 3, 5, 7, 9, 11, 13, 15, 18, 22, 27)
PHASE_ANGLES, PHASE_DEPTHS, PHASE_MOST_DEPTH = 128, 16, 6.0
NIGHT_ROWS = 64
_SUNS_AT_ONCE = 7


@dataclass(frozen=True)
class LightTables:
    """Tables of the light of one atmosphere; made by `light_tables`.

    S elevations of the luminary, H heights of the observer, K rows of view elevations in the layout of
    `observer_radiance.elevation_index`, C terms of a cosine series in azimuth from the luminary, M distances. The
    components are those of `along_rays.radiance_components` for the sun at 1 au.

    Parameters
    ----------
    elevation_deg
        ``(S,)`` apparent elevations of the luminary [deg].
    height_m
        ``(H,)`` heights of the observer [m].
    horizon_rad
        ``(H,)`` apparent elevation of the horizon [rad].
    sky
        ``(S, H, K, C, 10)`` components of the sky's radiance.
    air
        ``(S, H, K', M, C, 10)`` components of the airlight up to ``distance_m``.
    depth
        ``(S, H, K', M, 3)`` optical depth up to these distances.
    distance_m
        ``(M,)`` [m], the first 0.
    direct_deg, direct_lx
        ``(D,)`` apparent elevations [deg], and normal illuminance ``(D, 3)`` of the sun at 1 au at ``surface_m`` [lx].
    surface_m
        Height of the lit surface [m], one of ``height_m``.
    aerosol_depth, asymmetry
        As in `ScatteredRadiance`.
    phase
        ``(PHASE_DEPTHS, PHASE_ANGLES)`` phase function of the aerosol, over the square roots of depth and angle.
    night
        ``(H, NIGHT_ROWS, 3)`` radiance of the moonless night sky by elevation, from the zenith to the nadir [cd/m²].
    """

    elevation_deg: np.ndarray
    height_m: np.ndarray
    horizon_rad: np.ndarray
    sky: np.ndarray
    air: np.ndarray
    depth: np.ndarray
    distance_m: np.ndarray
    direct_deg: np.ndarray
    direct_lx: np.ndarray
    surface_m: float
    aerosol_depth: np.ndarray
    asymmetry: float
    phase: np.ndarray
    night: np.ndarray


def light_tables(
    tables: AtmosphereTables,
    heights_m: np.ndarray,
    surface_m: float,
    *,
    highest_deg: float = 90.0,
    farthest_m: float = 60_000.0,
    progress: TaskProgress | None = None,
) -> LightTables:
    """Tabulate the light of an atmosphere.

    Parameters
    ----------
    tables
        Tables of the atmosphere.
    heights_m
        ``(H,)`` heights of the observer [m], increasing; one of them is ``surface_m``.
    surface_m
        Height of the lit surface [m].
    highest_deg
        Highest elevation of sun and moon that is needed [deg].
    farthest_m
        Greatest distance of a surface that is needed [m].
    progress
        Called with the completed fraction.

    Returns
    -------
    LightTables
        The tables.
    """
    knots = KNOTS_DEG[: int(np.searchsorted(KNOTS_DEG, highest_deg)) + 1]
    distances = radiance.DISTANCE_EDGES_M
    columns = np.array([k for k in _COLUMNS if k == 0 or distances[k - 1] < farthest_m])
    unit = np.ones(len(WAVELENGTHS_NM))
    sky, air, depth, horizon, night = [], [], [], [], []
    for index, height in enumerate(heights_m):
        view = radiance.observer_view(tables, float(height))
        horizon.append(view.horizon_rad)
        rows = air_rows_rad(view.horizon_rad)
        # What an observer sees at the same apparent elevation: refraction depends on the height.
        suns = np.radians(true_elevation_deg(tables.atmosphere, knots, float(height)))
        diffuse, diffuse_near = (_diffuse(tables, view, suns, near) for near in (False, True))
        parts = [[], [], []]
        for k, (knot, sun) in enumerate(zip(knots, suns, strict=True)):
            direction = np.array([0.0, np.cos(np.radians(knot)), np.sin(np.radians(knot))])
            whole = radiance.observed_sky(tables, view, direction, float(sun), unit, diffuse[k])
            near = airlight(tables, view, float(sun), unit, diffuse_near[k])
            illuminant = surface_transfer(tables, direction, float(height), float(sun)) + 1e-12
            aerial = tabulate_aerial_perspective(view, ((whole, near),), illuminant)
            row, fraction = radiance.elevation_index(rows, view.horizon_rad)
            weight = fraction[:, None, None].astype(np.float32)
            parts[0].append(cosine_series(whole.components, 1))
            chosen = near[:, :, columns]
            between = chosen[row] * (1.0 - weight[..., None]) + chosen[row + 1] * weight[..., None]
            parts[1].append(cosine_series(between, 1).swapaxes(1, 2))
            optical = aerial.depth_rgb[:, columns]
            parts[2].append(optical[row] * (1.0 - weight) + optical[row + 1] * weight)
        for target, values in zip((sky, air, depth), parts, strict=True):
            target.append(np.stack(values))
        night.append(_night(tables, float(height)))
        if progress is not None:
            progress((index + 1) / len(heights_m))
    return LightTables(
        knots,
        np.asarray(heights_m, float),
        np.array(horizon),
        np.stack(sky, axis=1),
        np.stack(air, axis=1),
        np.stack(depth, axis=1),
        distances[columns],
        DIRECT_DEG,
        _direct(tables, surface_m),
        surface_m,
        whole.aerosol_depth,
        whole.asymmetry,
        _phase(whole.asymmetry),
        np.stack(night),
    )


def air_rows_rad(horizon_rad: float) -> np.ndarray:
    """Elevations ``(K',)`` of the rows of the air's table [rad], in the layout of `observer_radiance.elevation_index`."""
    return radiance.row_elevations_rad(horizon_rad, AIR_ROWS_BELOW, AIR_ROWS_ABOVE)


def cosine_series(values: np.ndarray, axis: int) -> np.ndarray:
    """Coefficients of the cosine series of values on a uniform grid of azimuths from 0 to π, along an axis.

    `observer_radiance.interpolate_azimuths` makes such grids from `along_rays.AZIMUTHS` terms, so that as many
    coefficients hold them exactly.
    """
    values = np.moveaxis(values, axis, -1)
    count = values.shape[-1]
    angle = np.linspace(0.0, np.pi, count)
    weight = np.full(count, 2.0 / (count - 1))
    weight[[0, -1]] *= 0.5
    basis = np.cos(np.outer(angle, np.arange(AZIMUTHS))) * weight[:, None]
    basis[:, 0] *= 0.5
    return np.moveaxis(values @ basis.astype(np.float32), -1, axis)


def _diffuse(
    tables: AtmosphereTables, view: radiance.ObserverView, suns_rad: np.ndarray, near: bool
) -> list[np.ndarray]:
    """`observer_radiance.diffuse_at_observer` for several elevations at once, exact at each."""
    samples = view.near if near else view.sky
    blocks = np.array_split(suns_rad, int(np.ceil(len(suns_rad) / _SUNS_AT_ONCE)))
    return [
        each for suns in blocks for each in diffuse_along(tables, samples, view.elevation_rad, suns, cumulative=near)
    ]


def _direct(tables: AtmosphereTables, surface_m: float) -> np.ndarray:
    result = np.zeros((len(DIRECT_DEG), 3))
    for index, knot in enumerate(np.radians(DIRECT_DEG)):
        lamp = sun_luminary(tables, np.array([0.0, np.cos(knot), np.sin(knot)]), surface_m)
        if lamp is not None:
            result[index] = lamp.normal_illuminance_lx
    return result


def _phase(asymmetry: float) -> np.ndarray:
    cosine = np.cos(np.pi * np.linspace(0.0, 1.0, PHASE_ANGLES) ** 2)
    depth = PHASE_MOST_DEPTH * np.linspace(0.0, 1.0, PHASE_DEPTHS) ** 2
    return spread_aerosol_phase(
        np.broadcast_to(cosine, (PHASE_DEPTHS, PHASE_ANGLES)),
        np.broadcast_to(depth[:, None, None], (PHASE_DEPTHS, PHASE_ANGLES, 3)),
        asymmetry,
        HARMONIC_ORDER,
    )[..., 0]


def _night(tables: AtmosphereTables, height_m: float) -> np.ndarray:
    air = tables.atmosphere
    haze = air.aerosol_optical_depth_500nm * float(angstrom_ratio(air.angstrom_exponent, 500.0, 550.0))
    optical = haze + float(rayleigh_optical_depth(550.0))
    ground = float(np.mean(air.ground_albedo))
    return night_sky_radiance(NIGHT_ROWS, 1, height_m=height_m, optical_depth=optical, ground_albedo=ground)[:, 0]
