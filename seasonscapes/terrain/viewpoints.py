"""Cameras that show a place, found from its heights: on a summit, in a valley, in the air."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter

from seasonscapes.frames import LocalFrame, enu_from_geodetic
from seasonscapes.terrain.mosaic import MapGrid

_AZIMUTHS = 72
_MOST_CELLS = 240
_EARTH_RADIUS_M = 6_371_000.0
_REFRACTION_K = 0.13
_VALLEY_CANDIDATES = 300
# Ground that rises by more than 5° should stand at least so far before a camera in a valley, in shares of the land's side.
_VALLEY_DISTANCE, _RISING = 0.15, float(np.tan(np.deg2rad(5.0)))


@dataclass(frozen=True)
class View:
    """Where a camera stands and looks.

    Parameters
    ----------
    name
        ``summit``, ``valley`` or ``air``.
    latitude_deg, longitude_deg
        WGS 84 position [deg].
    above_ground_m
        Height above the terrain [m].
    heading_deg, pitch_deg, fov_deg
        Azimuth from true north, elevation of the viewing direction, horizontal field of view [deg].
    """

    name: str
    latitude_deg: float
    longitude_deg: float
    above_ground_m: float
    heading_deg: float
    pitch_deg: float
    fov_deg: float


def find_views(heights: np.ndarray, grid: MapGrid) -> list[View]:
    """Find three views of a terrain.

    The first stands on the highest summit away from the border and looks where most land is to be seen. The second
    stands on flat, low ground under the highest skyline. The third hovers over low ground and looks at the summits.

    Parameters
    ----------
    heights
        ``(H, W)`` [m] without NaN.
    grid
        Their grid.

    Returns
    -------
    list of View
        ``summit``, ``valley``, ``air``.
    """
    step = max(1, int(np.ceil(max(grid.shape) / _MOST_CELLS)))
    rows, columns = grid.height // step, grid.width // step
    blocks = heights[: rows * step, : columns * step].reshape(rows, step, columns, step)
    highest, mean = blocks.max(axis=(1, 3)), blocks.mean(axis=(1, 3))
    land = _Land(mean, highest, grid, step)
    return [_summit(land, heights), _valley(land), _air(land)]


class _Land:
    """Heights on a coarse grid, with what is seen from its cells along `_AZIMUTHS` rays of the map."""

    def __init__(self, mean: np.ndarray, highest: np.ndarray, grid: MapGrid, step: int):
        self.mean, self.highest, self.grid, self.step = mean, highest, grid, step
        self.cell_m = grid.spacing_m * step
        self.distance = np.arange(1, int(np.hypot(*mean.shape)) + 1, dtype=np.float64)
        angle = np.arange(_AZIMUTHS) * 2.0 * np.pi / _AZIMUTHS
        self.d_row, self.d_column = -np.cos(angle)[:, None] * self.distance, np.sin(angle)[:, None] * self.distance
        metres = self.distance * self.cell_m
        self.drop_m = metres**2 * (1.0 - _REFRACTION_K) / (2.0 * _EARTH_RADIUS_M)

    def inner(self, share: float) -> np.ndarray:
        """Cells of the middle part of the grid ``(H, W)``."""
        rows, columns = self.mean.shape
        row, column = np.abs(np.arange(rows) - rows / 2.0), np.abs(np.arange(columns) - columns / 2.0)
        return (row[:, None] <= share * rows / 2.0) & (column <= share * columns / 2.0)

    def rays(self, row: int, column: int, eye_m: float) -> np.ndarray:
        """Tangents of elevation ``(azimuth, distance)`` of the land around a cell, −inf beyond the border."""
        r, c = np.rint(row + self.d_row).astype(int), np.rint(column + self.d_column).astype(int)
        inside = (r >= 0) & (r < self.mean.shape[0]) & (c >= 0) & (c < self.mean.shape[1])
        height = self.mean[np.clip(r, 0, self.mean.shape[0] - 1), np.clip(c, 0, self.mean.shape[1] - 1)]
        return np.asarray(np.where(inside, (height - self.drop_m - eye_m) / (self.distance * self.cell_m), -np.inf))

    def geodetic(self, row: float, column: float) -> tuple[float, float]:
        """Latitude and longitude [deg] of a cell's centre."""
        u, v = np.array((column + 0.5) * self.step), np.array((row + 0.5) * self.step)
        latitude, longitude = self.grid.geodetic(u, v)
        return float(latitude), float(longitude)

    def true_heading_deg(self, row: float, column: float, azimuth: float) -> float:
        """Azimuth from true north of a direction of the map [rad]."""
        there = self.geodetic(row - np.cos(azimuth), column + np.sin(azimuth))
        east, north, _ = enu_from_geodetic(LocalFrame(*self.geodetic(row, column)), *there, 0.0)
        return float(np.rad2deg(np.arctan2(east, north)) % 360.0)


def _sectors(values: np.ndarray, half_deg: float) -> np.ndarray:
    """Means over ± ``half_deg`` about each azimuth ``(A,)``."""
    half = int(half_deg / 360.0 * _AZIMUTHS)
    return np.mean([np.roll(values, shift) for shift in range(-half, half + 1)], axis=0)


def _summit(land: _Land, heights: np.ndarray) -> View:
    row, column = divmod(int(np.argmax(np.where(land.inner(0.7), land.highest, -np.inf))), land.mean.shape[1])
    slopes = land.rays(row, column, float(land.highest[row, column]) + 3.0)
    horizon = np.asarray(np.maximum.accumulate(np.asarray(slopes), axis=1))
    seen = np.isfinite(slopes) & (slopes >= horizon - 1e-9)
    # A cell of a ray stands for an area that grows with the distance.
    area = np.where(seen, land.distance, 0.0)
    best = int(np.argmax(_sectors(area.sum(axis=1), 30.0)))
    sector = [(best + shift) % _AZIMUTHS for shift in range(-6, 7)]
    weight = area[sector]
    looked = np.where(seen[sector], slopes[sector], 0.0)
    pitch = np.rad2deg(np.arctan((looked * weight).sum() / max(weight.sum(), 1e-9)))
    # The exact top, within the coarse cell.
    part = heights[row * land.step : (row + 1) * land.step, column * land.step : (column + 1) * land.step]
    r, c = divmod(int(np.argmax(part)), part.shape[1])
    exact = row + (r + 0.5) / land.step - 0.5, column + (c + 0.5) / land.step - 0.5
    heading = land.true_heading_deg(*exact, best * 2.0 * np.pi / _AZIMUTHS)
    lift = max(4.0, land.grid.spacing_m / 3.0)
    return _view("summit", land.geodetic(*exact), lift, heading, float(np.clip(pitch, -25.0, 5.0)), 65.0)


def _valley(land: _Land) -> View:
    smooth = gaussian_filter(land.mean, 1.0)
    down, across = np.gradient(smooth, land.cell_m)
    slope = np.hypot(down, across)
    inner = land.inner(0.8)
    low = land.mean <= np.percentile(land.mean[inner], 35.0)
    fit = np.argwhere(inner & low & (slope < np.tan(np.deg2rad(12.0))))
    if not len(fit):
        fit = np.argwhere(inner & (land.mean == land.mean[inner].min()))
    fit = fit[:: max(1, len(fit) // _VALLEY_CANDIDATES)]
    far_m = _VALLEY_DISTANCE * min(land.mean.shape) * land.cell_m
    best = (-np.inf, 0, 0, 0, 0.0)
    for row, column in fit.tolist():
        slopes = land.rays(row, column, float(land.mean[row, column]) + 20.0)
        skyline = np.clip(np.rad2deg(np.arctan(slopes.max(axis=1))), 0.0, 25.0)
        # A slope that rises right before the camera hides the mountains; what rises beyond the border is none.
        rising = slopes > _RISING
        wall_m = np.where(rising.any(axis=1), (rising.argmax(axis=1) + 1) * land.cell_m, far_m)
        sectors = _sectors(skyline * np.minimum(wall_m / far_m, 1.0), 25.0)
        azimuth = int(np.argmax(sectors))
        if sectors[azimuth] > best[0]:
            best = (float(sectors[azimuth]), int(row), int(column), azimuth, float(_sectors(skyline, 25.0)[azimuth]))
    _, row, column, azimuth, skyline_deg = best
    heading = land.true_heading_deg(row, column, azimuth * 2.0 * np.pi / _AZIMUTHS)
    lift = max(15.0, land.grid.spacing_m / 2.0)
    return _view(
        "valley", land.geodetic(row, column), lift, heading, float(np.clip(skyline_deg * 0.6, 0.0, 15.0)), 65.0
    )


def _air(land: _Land) -> View:
    inner = land.inner(0.8)
    rows, columns = np.nonzero(inner & (land.highest >= np.percentile(land.highest[inner], 97.0)))
    target = rows.mean(), columns.mean()
    top_m, floor_m = float(land.highest[inner].max()), float(np.percentile(land.mean, 10.0))
    side = min(land.mean.shape)
    best: tuple[float, int, int, float] | None = None
    for azimuth in np.arange(0.0, 2.0 * np.pi, np.pi / 8.0):
        row = round(target[0] + 0.5 * side * np.cos(azimuth))
        column = round(target[1] - 0.5 * side * np.sin(azimuth))
        row, column = (int(np.clip(v, 0.05 * n, 0.95 * n)) for v, n in zip((row, column), land.mean.shape, strict=True))
        away = float(np.hypot(row - target[0], column - target[1])) / side
        score = (top_m - land.mean[row, column]) / max(top_m - floor_m, 1.0) + away
        if best is None or score > best[0]:
            best = (score, row, column, away * side * land.cell_m)
    assert best is not None
    _, row, column, distance_m = best
    altitude_m = top_m + 0.1 * distance_m
    look_at_m = floor_m + 0.6 * (top_m - floor_m)
    pitch = float(np.rad2deg(np.arctan2(look_at_m - altitude_m, distance_m)))
    heading = land.true_heading_deg(row, column, float(np.arctan2(target[1] - column, row - target[0])))
    above_m = float(altitude_m - land.mean[row, column])
    return _view("air", land.geodetic(row, column), above_m, heading, max(pitch, -40.0), 55.0)


def _view(name: str, place: tuple[float, float], above_m: float, heading: float, pitch: float, fov: float) -> View:
    return View(
        name, round(place[0], 6), round(place[1], 6), round(above_m, 1), round(heading, 1), round(pitch, 1), fov
    )
