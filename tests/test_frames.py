"""Geodesy against PROJ, closed forms and round trips."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pyproj import Transformer

from seasonscapes.cameras.pinhole import Camera, camera_at, project, ray_directions, rotation_from_angles
from seasonscapes.frames import (
    MEAN_RADIUS_M,
    LocalFrame,
    angles_from_direction,
    direction_from_angles,
    enu_from_geodetic,
    equirectangular_directions,
    geodetic_from_enu,
    local_axes,
    sample_equirectangular,
)

FRAME = LocalFrame(46.55, 7.98, 1200.0)


def test_enu_agrees_with_proj():
    pipeline = (
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84 "
        "+step +proj=topocentric +ellps=WGS84 +lon_0=7.98 +lat_0=46.55 +h_0=1200"
    )
    rng = np.random.default_rng(0)
    latitude, longitude = 46.55 + rng.uniform(-0.9, 0.9, 500), 7.98 + rng.uniform(-1.2, 1.2, 500)
    height = rng.uniform(-100, 8000, 500)
    expected = np.stack(Transformer.from_pipeline(pipeline).transform(longitude, latitude, height), -1)
    np.testing.assert_allclose(enu_from_geodetic(FRAME, latitude, longitude, height), expected, atol=1e-6)


@pytest.mark.parametrize("k", [0.0, 0.13])
def test_round_trip_below_a_millimetre_within_100_km(k):
    frame = LocalFrame(46.55, 7.98, 0.0, k)
    position = np.random.default_rng(1).uniform(-1, 1, (2000, 3)) * [1e5, 1e5, 8e3]
    back = enu_from_geodetic(frame, *geodetic_from_enu(frame, position))
    assert np.abs(back - position).max() < 1e-3


@given(st.floats(-89.9, 89.9), st.floats(-179.9, 179.9), st.floats(-400, 9000))
def test_round_trip_anywhere(latitude, longitude, height):
    frame = LocalFrame(latitude, longitude)
    back = geodetic_from_enu(frame, enu_from_geodetic(frame, latitude, longitude, height))
    np.testing.assert_allclose([float(v) for v in back], [latitude, longitude, height], atol=1e-7)


def test_the_earth_drops_away_and_refraction_lifts():
    """71 m at 30 km, d²/2R; with k = 0.13 the drop is 13 % less."""
    degrees = np.degrees(30_000.0 / MEAN_RADIUS_M)
    drop = -enu_from_geodetic(LocalFrame(46.5, 8.0), 46.5 + degrees, 8.0, 0.0)[2]
    assert drop == pytest.approx(30_000.0**2 / (2 * MEAN_RADIUS_M), rel=0.005)
    refracted = -enu_from_geodetic(LocalFrame(46.5, 8.0, 0.0, 0.13), 46.5 + degrees, 8.0, 0.0)[2]
    assert refracted == pytest.approx(0.87 * drop, rel=1e-3)


def test_refraction_straightens_rays_for_every_camera():
    """Dip of the sea horizon from 1,000 m, seen from far off the origin: sqrt(2h(1-k)/R)."""
    frame = LocalFrame(0.0, 0.0, 0.0, 0.13)
    camera = enu_from_geodetic(frame, 0.1, 0.2, 1000.0)
    up = local_axes(frame, 0.1, 0.2)[2]
    sea = enu_from_geodetic(frame, 0.1, 0.2 + np.linspace(0.3, 2.0, 4000), 0.0) - camera
    elevation = np.degrees(np.arcsin((sea @ up) / np.linalg.norm(sea, axis=1)))
    assert -elevation.max() == pytest.approx(np.degrees(np.sqrt(2 * 1000.0 * 0.87 / MEAN_RADIUS_M)), rel=0.01)


def test_axes_of_another_place_are_orthonormal_and_its_own():
    axes = local_axes(FRAME, 46.8, 8.3)
    np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    here = enu_from_geodetic(FRAME, 46.8, 8.3, 0.0)
    for step, axis in (((0, 1e-6, 0), 0), ((1e-6, 0, 0), 1), ((0, 0, 10.0), 2)):
        there = enu_from_geodetic(FRAME, 46.8 + step[0], 8.3 + step[1], step[2]) - here
        np.testing.assert_allclose(there / np.linalg.norm(there), axes[axis], atol=1e-6)


def test_angles():
    np.testing.assert_allclose(direction_from_angles(90.0, 0.0), [1, 0, 0], atol=1e-15)
    np.testing.assert_allclose(direction_from_angles(0.0, 90.0), [0, 0, 1], atol=1e-15)
    azimuth, elevation = angles_from_direction(3.0 * direction_from_angles(215.0, -12.0))
    assert float(azimuth) == pytest.approx(215.0)
    assert float(elevation) == pytest.approx(-12.0)


def test_equirectangular_map_round_trip():
    direction = equirectangular_directions(90, 180)
    assert direction[0, 0, 2] > 0.99
    assert angles_from_direction(direction[45, 45])[0] == pytest.approx(91.0)
    found = sample_equirectangular(direction, direction_from_angles([0.0, 359.9, 77.0], [3.0, -40.0, 60.0]))
    np.testing.assert_allclose(found, direction_from_angles([0.0, 359.9, 77.0], [3.0, -40.0, 60.0]), atol=1e-3)


@pytest.mark.parametrize(
    ("angles", "pixel_of_forward"), [((30.0, -10.0, 0.0), (300, 200)), ((200.0, 45.0, 20.0), (300, 200))]
)
def test_camera_looks_where_it_is_told(angles, pixel_of_forward):
    camera = camera_at(
        LocalFrame(46.55, 7.98),
        46.55,
        7.98,
        100.0,
        heading_deg=angles[0],
        pitch_deg=angles[1],
        roll_deg=angles[2],
        fov_deg=60.0,
        size_px=(600, 400),
    )
    point = camera.position_m + 500.0 * direction_from_angles(angles[0], angles[1])
    pixel, depth = project(camera, point)
    np.testing.assert_allclose(pixel, pixel_of_forward, atol=1e-6)
    assert depth == pytest.approx(500.0)


def test_projection_inverts_rays_and_knows_left_from_right():
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(0.0, 0.0)
    camera = Camera(400, 300, 500.0, 480.0, 210.0, 140.0, pose)
    rng = np.random.default_rng(2)
    pixel = rng.uniform(0, 300, (50, 2))
    found, _ = project(camera, 1234.0 * ray_directions(camera, pixel))
    np.testing.assert_allclose(found, pixel, atol=1e-8)
    east, _ = project(camera, np.array([10.0, 100.0, 0.0]))
    above, _ = project(camera, np.array([0.0, 100.0, 10.0]))
    assert east[0] > 210.0, "looking north, east is on the right"
    assert above[1] < 140.0, "up is on top"
    behind, depth = project(camera, np.array([0.0, -5.0, 0.0]))
    assert np.isnan(behind).all()
    assert depth < 0
    assert ray_directions(camera).shape == (300, 400, 3)


def test_positive_roll_lowers_the_right_side_of_the_camera():
    assert rotation_from_angles(0.0, 0.0, 10.0)[2, 0] < 0.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"world_from_camera": np.diag([1.0, 1.0, -1.0, 1.0])}, "mirrored"),
        ({"world_from_camera": np.full((4, 4), np.nan)}, "finite"),
        ({"fx": 0.0}, "positive"),
    ],
)
def test_impossible_cameras_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        Camera(
            **{
                "width_px": 4,
                "height_px": 3,
                "fx": 5.0,
                "fy": 5.0,
                "cx": 2.0,
                "cy": 1.5,
                "world_from_camera": np.eye(4),
                **change,
            }
        )
