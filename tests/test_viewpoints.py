"""Cameras that are found from heights: on the summit, in the valley before its mountains, in the air above."""

from __future__ import annotations

import numpy as np
import pytest

from seasonscapes.terrain.crs import map_from_geodetic
from seasonscapes.terrain.mosaic import MapGrid
from seasonscapes.terrain.viewpoints import View, find_views

GRID = MapGrid("EPSG:32632", 400_000.0, 5_160_000.0, 30.0, 200, 200)


def position(view: View) -> tuple[float, float]:
    """Metres east and north of the grid's south-western corner."""
    x, y = map_from_geodetic(GRID.crs, view.latitude_deg, view.longitude_deg)
    return float(x) - GRID.west, float(y) - (GRID.north - GRID.height * GRID.spacing_m)


def metres() -> tuple[np.ndarray, np.ndarray]:
    column, row = np.meshgrid(np.arange(200) + 0.5, np.arange(200) + 0.5)
    return column * 30.0, (200.0 - row) * 30.0


@pytest.fixture(scope="module")
def valley_views() -> dict[str, View]:
    """A floor 3 km wide between a wall in the west and a higher range in the east, whose summit stands in the north."""
    east, north = metres()
    wall = 900.0 * np.clip((1200.0 - east) / 500.0, 0.0, 1.0)
    range_ = (
        1400.0 * np.clip((east - 4000.0) / 1200.0, 0.0, 1.0) * (0.7 + 0.3 * np.exp(-(((north - 4200.0) / 900.0) ** 2)))
    )
    return {view.name: view for view in find_views(500.0 + wall + range_ + 0.01 * north, GRID)}


def test_the_summit_is_the_highest_ground_away_from_the_border(valley_views):
    east, north = position(valley_views["summit"])
    assert east > 4500.0
    assert north == pytest.approx(4200.0, abs=400.0)
    assert 3.0 < valley_views["summit"].above_ground_m < 12.0


def test_the_camera_in_the_valley_has_its_mountains_before_it_and_no_slope_at_its_feet(valley_views):
    view = valley_views["valley"]
    east, north = position(view)
    assert 1200.0 < east < 4000.0
    heading = np.deg2rad(view.heading_deg)
    eye_m = 500.0 + 0.01 * north + view.above_ground_m
    for distance_m in np.arange(100.0, 800.0, 100.0):
        x, y = east + distance_m * np.sin(heading), north + distance_m * np.cos(heading)
        height_m = 500.0 + 900.0 * np.clip((1200.0 - x) / 500.0, 0.0, 1.0) + 0.01 * y
        height_m += 980.0 * np.clip((x - 4000.0) / 1200.0, 0.0, 1.0)
        assert np.rad2deg(np.arctan2(height_m - eye_m, distance_m)) < 6.0
    assert view.pitch_deg > 4.0


def test_the_camera_in_the_air_is_above_all_and_looks_down(valley_views):
    view = valley_views["air"]
    assert view.pitch_deg < -5.0
    _, north = position(view)
    assert 500.0 + 0.01 * north + view.above_ground_m > 1900.0


def test_a_plain_has_cameras_too():
    views = find_views(np.full(GRID.shape, 10.0, np.float32), GRID)
    assert [view.name for view in views] == ["summit", "valley", "air"]
    assert all(np.isfinite([view.heading_deg, view.pitch_deg, view.above_ground_m]).all() for view in views)
