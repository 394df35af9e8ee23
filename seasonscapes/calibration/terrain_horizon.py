"""What the terrain draws against the sky from one place: its horizon, and the edges of nearer ridges before farther ones.

Rays march outwards over the elevation grid, all azimuths at once. Positions go through `frames` (ECEF, with the frame's
refraction), so that curvature and refraction need no formula here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from seasonscapes.frames import LocalFrame, enu_from_geodetic, geodetic_from_enu, local_axes
from seasonscapes.terrain.crs import map_from_geodetic, raster_pixels
from seasonscapes.terrain.raster import sample_raster
from seasonscapes.terrain.surface import Raster


@dataclass(frozen=True)
class Horizon:
    """The terrain as seen from ``position_m``.

    Parameters
    ----------
    position_m
        Place it was computed for, ``(3,)`` in the local frame [m].
    axes
        East, north and up there, rows ``(3, 3)``.
    azimuth_deg
        ``(A,)`` directions that were looked into, clockwise from north [deg].
    skyline_m
        ``(A, 3)`` the point of the horizon in each [m].
    skyline_elevation_deg
        ``(A,)`` its elevation [deg]; NaN where there is no terrain in that azimuth, or it ends still rising.
    edges_m
        ``(E, 3)`` points where a nearer ridge hides what lies behind it, the skyline excluded [m].
    edge_gap
        ``(E,)`` how much farther what is seen behind lies, as a share of the ridge's distance.
    """

    position_m: np.ndarray
    axes: np.ndarray
    azimuth_deg: np.ndarray
    skyline_m: np.ndarray
    skyline_elevation_deg: np.ndarray
    edges_m: np.ndarray
    edge_gap: np.ndarray


def terrain_height(rasters: Sequence[Raster], latitude_deg, longitude_deg) -> np.ndarray:
    """Heights [m] at places, from the first raster that knows them; NaN where none does."""
    latitude, longitude = np.asarray(latitude_deg, float), np.asarray(longitude_deg, float)
    height = np.full(latitude.shape, np.nan)
    for raster in rasters:
        open_ = np.isnan(height)
        if not open_.any():
            break
        x, y = map_from_geodetic(raster.crs, latitude[open_], longitude[open_])
        height[open_] = sample_raster(raster, x, y)[..., 0]
    return height


def terrain_profile(
    rasters: Sequence[Raster],
    frame: LocalFrame,
    position_m: np.ndarray,
    azimuth_deg: np.ndarray,
    distance_m: np.ndarray,
) -> np.ndarray:
    """Terrain points ``(A, R, 3)`` in the local frame along azimuths at distances from a place; NaN off the terrain.

    The map grid is met through a quartic of the plan position, fitted to the exact transforms (off by centimetres over
    tens of kilometres), since millions of exact ones would take minutes.
    """
    from scipy.ndimage import map_coordinates

    latitude, longitude, level_m = (float(v) for v in geodetic_from_enu(frame, position_m))
    axes = local_axes(frame, latitude, longitude)
    azimuth = np.radians(np.asarray(azimuth_deg, float))[:, None]
    sine, cosine = np.sin(azimuth), np.cos(azimuth)
    # Plan position in the frame; the small fall of the plane below the horizon matters to height alone.
    plan = [distance_m * (sine * axes[0, i] + cosine * axes[1, i]) + position_m[i] for i in (0, 1)]
    unit = [(plan[i] - position_m[i]) / distance_m[-1] for i in (0, 1)]
    reach = float(distance_m[-1])
    height = np.full(unit[0].shape, np.nan, np.float32)
    for raster in rasters:
        column, row = _on_plan(
            frame, position_m, reach, lambda la, lo, r=raster: raster_pixels(r, la, lo), unit, level_m
        )
        values = np.ascontiguousarray(raster.values[..., 0], np.float32)
        found = map_coordinates(values, [row - 0.5, column - 0.5], order=1, cval=np.nan, output=np.float32)
        height = np.where(np.isnan(height), found, height)
    # How the level of the camera rises over the frame's plane (it falls: curvature), refraction included.
    base = _on_plan(
        frame, position_m, reach, lambda la, lo: enu_from_geodetic(frame, la, lo, level_m)[..., 2:], unit, level_m
    )
    return np.stack([*plan, base[0] + (height - level_m)], axis=-1)


def _on_plan(
    frame: LocalFrame, position_m: np.ndarray, reach_m: float, function, unit: list[np.ndarray], level_m: float
) -> list:
    """Values of a smooth function of latitude and longitude at plan positions, by a quartic in units of the reach.

    A plan position means a place only with a height: that of the camera. (Where the ground is 1 km lower, 15 km away,
    verticals lean apart by 2.4 m.)
    """
    side = np.linspace(-1.0, 1.0, 9)
    grid = np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)
    ground = np.column_stack([position_m[:2] + reach_m * grid, np.zeros(len(grid))])
    # Points of the plane itself are off the ellipsoid by the curvature; bring them to the level first.
    for _ in range(3):
        _, _, height = geodetic_from_enu(frame, ground)
        ground[:, 2] -= height - level_m
    latitude, longitude, _ = geodetic_from_enu(frame, ground)
    values = function(latitude, longitude)
    terms = np.polynomial.polynomial.polyvander2d(grid[:, 0], grid[:, 1], [4, 4])
    # Total degree four at most.
    low = (np.arange(5)[:, None] + np.arange(5) <= 4).ravel()
    results = []
    for channel in range(values.shape[-1]):
        weights = np.zeros(25)
        weights[low] = np.linalg.lstsq(terms[:, low], values[:, channel], rcond=None)[0]
        c = weights.reshape(5, 5)
        rows = [_horner(c[i, : 5 - i], unit[1]) for i in range(5)]
        results.append(rows[0] + unit[0] * (rows[1] + unit[0] * (rows[2] + unit[0] * (rows[3] + unit[0] * rows[4]))))
    return results


def _horner(coefficients: np.ndarray, x: np.ndarray):
    total = coefficients[-1]
    for value in coefficients[-2::-1]:
        total = total * x + value
    return total


def horizon_from(
    rasters: Sequence[Raster],
    frame: LocalFrame,
    position_m,
    *,
    azimuth_deg: np.ndarray | None = None,
    nearest_m: float = 30.0,
    reach_m: float = 60e3,
    least_gap: float = 0.15,
    below_ground_m: float = 5.0,
) -> Horizon:
    """Compute the horizon of a place.

    Parameters
    ----------
    rasters
        Elevations, the most detailed first; where one ends the next goes on.
    position_m
        Where the camera is, in the local frame [m].
    azimuth_deg
        ``(A,)`` increasing [deg]; all round every 0.1° when left out.
    nearest_m
        Terrain nearer than this is left out: a mast's own hill would hide everything.
    reach_m
        How far to look.
    least_gap
        Ridges with less distance behind them, as a share of their own, are no edges.
    below_ground_m
        How far under the terrain the camera may be: what the heights are uncertain by.

    Raises
    ------
    ValueError
        Where no ray meets terrain, or the camera is too far under it.
    """
    position = np.asarray(position_m, float)
    latitude, longitude, height = (float(v) for v in geodetic_from_enu(frame, position))
    axes = local_axes(frame, latitude, longitude)
    under = float(terrain_height(rasters, [latitude], [longitude])[0]) - height
    if under > below_ground_m:
        raise ValueError(f"the camera is {under:.0f} m below ground; check its height and vertical datum")
    cell = _cell_m(rasters[0])
    distance = _distances(nearest_m, reach_m, 0.7 * cell)
    azimuth_deg = np.arange(3600) * 0.1 if azimuth_deg is None else np.asarray(azimuth_deg, float)
    skyline, elevation, edges, gaps = [], [], [], []
    # In slices, so that memory stays below some hundred megabytes.
    for part in np.array_split(azimuth_deg, max(1, len(azimuth_deg) * len(distance) // 1_000_000)):
        points = terrain_profile(rasters, frame, position, part, distance)
        local = (points - position) @ axes.T
        slope = local[..., 2] / np.hypot(local[..., 0], local[..., 1])
        top, found, ridge, gap = _visible_ridges(slope, distance, least_gap)
        rows = np.arange(len(part))
        skyline.append(np.where(found[:, None], points[rows, top], np.nan))
        elevation.append(np.where(found, np.degrees(np.arctan(slope[rows, top])), np.nan))
        edges.append(points[ridge])
        gaps.append(gap)
    elevation = np.concatenate(elevation)
    if not np.isfinite(elevation).any():
        raise ValueError("no terrain within reach of the camera")
    return Horizon(
        position, axes, azimuth_deg, np.concatenate(skyline), elevation, np.concatenate(edges), np.concatenate(gaps)
    )


def _cell_m(raster: Raster) -> float:
    size = float(np.sqrt(abs(raster.transform.determinant)))
    return size * 111_195.0 if abs(raster.transform.a) < 0.1 else size


def _distances(nearest_m: float, reach_m: float, step_m: float) -> np.ndarray:
    """Even steps first, then growing by 0.3 % of the distance: half a pixel of most cameras."""
    distance = [nearest_m]
    while distance[-1] < reach_m:
        distance.append(distance[-1] + max(step_m, 0.003 * distance[-1]))
    return np.array(distance)


def _visible_ridges(slope: np.ndarray, distance: np.ndarray, least_gap: float):
    """Index of the horizon, whether there is one, mask of ridge points and the gap behind each of those."""
    filled = np.where(np.isfinite(slope), slope, -np.inf)
    highest = np.maximum.accumulate(filled, axis=1)
    visible = (filled >= highest) & np.isfinite(slope)
    top = np.argmax(filled, axis=1)
    # Where the terrain ends still rising, the true horizon lies beyond it.
    last = slope.shape[1] - 1 - np.argmax(np.isfinite(slope)[:, ::-1], axis=1)
    found = np.isfinite(filled[np.arange(len(top)), top]) & (top < last)
    # Next visible sample after each: scan backwards.
    index = np.where(visible, np.arange(slope.shape[1]), slope.shape[1])
    following = np.minimum.accumulate(index[:, ::-1], axis=1)[:, ::-1]
    after = np.concatenate([following[:, 1:], np.full((len(slope), 1), slope.shape[1])], axis=1)
    behind = distance[np.minimum(after, slope.shape[1] - 1)]
    gap = np.where(after < slope.shape[1], behind / distance - 1.0, 0.0)
    # Something must be hidden in between; steps alone are no gap.
    ridge = visible & (gap > least_gap) & (after > np.arange(slope.shape[1]) + 1)
    return top, found, ridge, gap[ridge]
