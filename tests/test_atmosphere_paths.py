"""Light along rays: against a brute-force path tracer of the atmosphere, closed forms and fine quadrature."""

import numpy as np
import pytest
from atmosphere_cases import against_oracle, chromaticity, dense_airlight, homogeneous, tables_of

from seasonscapes.frames import direction_from_angles
from seasonscapes.sky.aerial_perspective import airlight
from seasonscapes.sky.atmosphere import Atmosphere
from seasonscapes.sky.clear_sky import illumination_from_atmosphere, sky_radiance_map
from seasonscapes.sky.curved_rays import horizon_elevation_rad, trace_curved_rays
from seasonscapes.sky.illumination import luminance
from seasonscapes.sky.observer_radiance import observed_sky, observer_view, sky_radiance


@pytest.mark.parametrize("sun_elevation_deg", [60.0, 10.0, 3.0, 0.0, -4.0])
@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(20.0, 3.0), (90.0, 30.0), (180.0, 80.0)])
def test_sky_radiance_is_the_path_tracers(sun_elevation_deg, azimuth_deg, elevation_deg):
    direction = direction_from_angles(azimuth_deg, elevation_deg)
    deviation, noise = against_oracle(tables_of(refraction=False), sun_elevation_deg, direction, paths=6144, seed=7)
    assert noise < 0.03
    assert abs(deviation) < 0.05 + 2.0 * noise


@pytest.mark.parametrize(("distance_m", "elevation_deg"), [(5e3, -2.0), (40e3, 1.0)])
def test_airlight_is_the_path_tracers(distance_m, elevation_deg):
    direction = direction_from_angles(70.0, elevation_deg)
    deviation, noise = against_oracle(
        tables_of(refraction=False), 30.0, direction, paths=6144, seed=3, height_m=1500.0, distance_m=distance_m
    )
    assert noise < 0.02
    assert abs(deviation) < 0.03 + 2.0 * noise


def test_transmittance_of_homogeneous_air_is_koschmieders():
    visibility_m = 50e3
    tables = tables_of(**vars(homogeneous(visibility_m)), max_orders=1)
    air = illumination_from_atmosphere(tables, direction_from_angles(0, 40), 300.0, shape=(8, 16)).aerial_perspective
    distance = np.array([100.0, 1e3, 5e3, 2e4, 6e4, 1e5])
    directions = direction_from_angles(np.linspace(0, 300, 6), np.array([0.0, 1.0, 5.0, 10.0, 20.0, 40.0]))
    transmittance, _ = air(distance, directions)
    expected = np.exp(-3.912 * distance / visibility_m)
    np.testing.assert_allclose(transmittance, np.repeat(expected[:, None], 3, 1), rtol=2e-3)
    # A black ridge at the meteorological range stands out by 2 %.
    assert air(np.array(visibility_m), directions[0])[0][1] == pytest.approx(0.02, rel=2e-3)


@pytest.mark.parametrize("sun_elevation_deg", [50.0, 8.0, 0.5, -4.0])
def test_airlight_is_what_fine_quadrature_finds(sun_elevation_deg):
    tables, height, sun = tables_of(), 1800.0, direction_from_angles(0.0, sun_elevation_deg)
    air = illumination_from_atmosphere(tables, sun, height, shape=(8, 16)).aerial_perspective
    for distance in (500.0, 5e3, 3e4, 1e5):
        for azimuth, elevation in ((5.0, 1.0), (60.0, -1.0), (180.0, 4.0)):
            direction = direction_from_angles(azimuth, elevation)
            _, found = air(np.array(distance), direction)
            expected = luminance(dense_airlight(tables, sun, height, direction, distance))
            assert luminance(found) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("sun_elevation_deg", [60.0, 10.0, -3.0])
def test_a_horizontal_ray_without_end_is_the_horizons_sky(sun_elevation_deg):
    tables, sun = tables_of(), direction_from_angles(0.0, sun_elevation_deg)
    light = illumination_from_atmosphere(tables, sun, 500.0)
    for azimuth in (10.0, 100.0, 180.0):
        direction = direction_from_angles(azimuth, 0.0)
        far = light.aerial_perspective(np.array(1.25e6), direction)[1]
        endless = light.aerial_perspective(np.array(np.inf), direction)[1]
        np.testing.assert_allclose(luminance(far), luminance(endless), rtol=0.02)
    # And the map's first row above the horizon, a mean over 1.4°, is what rays without end see there.
    rows = [light.aerial_perspective(np.array(np.inf), direction_from_angles(100.0, e))[1] for e in (0.35, 1.05)]
    column = int(100.0 / 360.0 * 256)
    np.testing.assert_allclose(luminance(light.sky_radiance[63, column]), luminance(np.mean(rows, 0)), rtol=0.02)


def test_airlight_before_a_far_dark_ridge_is_blue_by_day():
    air = illumination_from_atmosphere(tables_of(), direction_from_angles(0.0, 45.0), 2000.0).aerial_perspective
    for azimuth in (60.0, 120.0, 180.0):
        _, light = air(np.array(3e4), direction_from_angles(azimuth, 0.0))
        x, y = chromaticity(light)
        assert x < 0.29 < 0.3127
        assert y < 0.30 < 0.3290


def test_airlight_grows_and_transmittance_falls_with_distance():
    air = illumination_from_atmosphere(tables_of(), direction_from_angles(0.0, 20.0), 1500.0).aerial_perspective
    depth = np.geomspace(10.0, 3e5, 60)
    transmittance, light = air(depth, np.broadcast_to(direction_from_angles(130.0, 0.3), (60, 3)))
    assert (np.diff(transmittance, axis=0) < 0.0).all()
    assert (transmittance > 0.0).all()
    # The last that is added is so red that it takes from Rec.709's blue: only the luminance must grow.
    assert (np.diff(luminance(light)) > 0.0).all()
    # Blue goes first.
    assert (transmittance[1:, 2] < transmittance[1:, 1]).all()
    assert (transmittance[1:, 1] < transmittance[1:, 0]).all()


def test_pieces_of_a_picture_do_not_matter():
    air = illumination_from_atmosphere(tables_of(), direction_from_angles(0.0, 20.0), 1500.0).aerial_perspective
    random = np.random.default_rng(5)
    direction = direction_from_angles(random.uniform(0, 360, (300, 300)), random.uniform(-20, 20, (300, 300)))
    depth = random.uniform(10.0, 1e5, (300, 300))
    depth[0] = np.inf
    whole = air(depth, direction)
    assert whole[0].shape == whole[1].shape == (300, 300, 3)
    for row in (0, 299):
        np.testing.assert_allclose(air(depth[row], direction[row])[1], whole[1][row], rtol=1e-6)


def test_rays_without_refraction_are_straight_and_with_it_bend_as_surveyors_know():
    straight = Atmosphere(refraction=False)
    paths = trace_curved_rays(straight, 1000.0, np.radians([0.0, 3.0, 40.0]))
    radius = straight.ground_radius_m + 1000.0
    slope = np.sin(np.radians([0.0, 3.0, 40.0]))[:, None]
    exact = np.sqrt(radius**2 + paths.distance_m**2 + 2 * radius * paths.distance_m * slope) - straight.ground_radius_m
    np.testing.assert_allclose(paths.height_m, exact, atol=5.0)
    bent = trace_curved_rays(Atmosphere(), 500.0, np.array([0.0]))
    drop = np.interp(3e4, bent.distance_m[0], bent.height_m[0]) - 500.0
    # A level line of sight: (1 - k) d² / 2R. Standard air has k = 0.16 at sea level; surveyors take 0.13 for warm days.
    assert 1.0 - drop / (3e4**2 / (2 * 6371e3)) == pytest.approx(0.15, abs=0.03)
    assert np.degrees(horizon_elevation_rad(straight, 3500.0)) == pytest.approx(-1.899, abs=2e-3)


def test_sky_and_airlight_share_one_view():
    tables, sun = tables_of(), direction_from_angles(0.0, 15.0)
    view = observer_view(tables, 700.0)
    assert observer_view(tables, 700.0) is view
    light = observed_sky(tables, view, sun, np.radians(15.0), np.ones(9))
    parts = airlight(tables, view, np.radians(15.0), np.ones(9))
    assert parts.shape == (*light.components.shape[:2], view.near_depth.shape[1], 10)
    above = view.elevation_rad > view.horizon_rad
    np.testing.assert_allclose(parts[above, :, -1, :9], light.components[above, :, :9], rtol=0.05, atol=1.0)
    sky = sky_radiance_map(tables, sun, 700.0, shape=(4, 8))
    assert np.isfinite(sky).all()
    assert (sky_radiance(light, direction_from_angles(np.arange(0.0, 360.0, 30.0), 60.0)) > 0.0).all()
