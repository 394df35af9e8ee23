"""Closed and broken skies: closed forms of the CIE distributions, absolute levels, monotone mixing."""

from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest

from seasonscapes.frames import LocalFrame, direction_from_angles, equirectangular_directions
from seasonscapes.sky.clouds import with_clouds
from seasonscapes.sky.ephemeris import LunarPosition, SolarPosition
from seasonscapes.sky.illumination import (
    Illumination,
    Luminary,
    diffuse_horizontal_illuminance,
    direct_horizontal_illuminance,
    global_horizontal_illuminance,
    luminance,
)
from seasonscapes.sky.overcast import (
    clear_illuminance_lx,
    cloud_transmission,
    daylight_rgb,
    general_sky,
    grey_air,
    overcast,
    overcast_illuminance_lx,
    overcast_rgb,
    overcast_sky_radiance,
    standard_overcast,
)


def sun_at(elevation_deg, azimuth_deg=135.0) -> SolarPosition:
    return SolarPosition(azimuth_deg, elevation_deg, elevation_deg, 1.0)


def test_standard_overcast_is_three_times_brighter_at_the_zenith_and_integrates_to_one():
    assert standard_overcast(90.0) / standard_overcast(0.0) == pytest.approx(3.0)
    assert standard_overcast(42.0) == pytest.approx(
        np.interp(np.sin(np.radians(42.0)), [0, 1], [3 / 7 / np.pi, 9 / 7 / np.pi])
    )
    elevation = np.radians(np.linspace(0.0, 90.0, 20001))
    integrand = 2 * np.pi * standard_overcast(np.degrees(elevation)) * np.sin(elevation) * np.cos(elevation)
    assert np.trapezoid(integrand, elevation) == pytest.approx(1.0, rel=1e-6)


@pytest.mark.parametrize("intermediate", [False, True])
def test_map_holds_the_illuminance_it_was_given(intermediate):
    wanted = np.array([9000.0, 10000.0, 11000.0])
    source = direction_from_angles(200.0, 35.0) if intermediate else None
    sky = overcast_sky_radiance(wanted, 64, ground_albedo=0.3, source_direction=source)
    assert np.allclose(diffuse_horizontal_illuminance(sky), wanted, rtol=1e-9)
    assert np.allclose(sky[-1], 0.3 / np.pi * wanted)


def test_intermediate_sky_is_brightest_about_the_sun():
    direction = equirectangular_directions(90, 180)
    towards = direction_from_angles(120.0, 40.0)
    relative = np.where(direction[..., 2] > 0, general_sky(direction, towards), 0.0)
    brightest = direction.reshape(-1, 3)[np.argmax(relative)]
    assert brightest @ towards > np.cos(np.radians(2.0))
    # Published shape, type 8: f(0) / f(90°) = 1 + 10 (1 - exp(-3π/2)) + 0.45.
    away = np.cross(towards, [0.0, 0.0, 1.0])
    away = away / np.linalg.norm(away) * 0.999 + np.array([0, 0, 0.0447])
    ratio = general_sky(towards, towards) / general_sky(away / np.linalg.norm(away), towards)
    assert ratio == pytest.approx(1 + 10 * (1 - np.exp(-1.5 * np.pi)) + 0.45, rel=0.08)


def test_overcast_illuminance_is_documented_smooth_and_rising():
    for elevation in (15.0, 30.0, 60.0, 90.0):
        expected = 300.0 + 21000.0 * np.sin(np.radians(elevation))
        assert overcast_illuminance_lx(elevation) == pytest.approx(expected, rel=1e-9)
    assert overcast_illuminance_lx(0.0) == pytest.approx(300.0, rel=0.02)
    fine = overcast_illuminance_lx(np.arange(-18.0, 90.0, 0.1))
    steps = fine[1:] / fine[:-1]
    assert steps.min() > 1.0
    # Twilight itself changes by up to 15 % in 0.1°; no step may stand out of that trend.
    assert np.abs(np.diff(np.log(steps)))[40:].max() < 0.03
    assert 0.15 < cloud_transmission(90.0) < 0.2
    assert np.all(cloud_transmission(np.arange(-20.0, 90.0)) < 0.5)


def test_clear_reference_is_the_published_one():
    import oracles_usno as usno

    for elevation in (-6.0, -3.0, 0.0, 10.0, 45.0):
        assert clear_illuminance_lx(elevation) == pytest.approx(usno.supplement_sun_lx(elevation), rel=0.01)


def test_colours():
    assert np.allclose(daylight_rgb(6504.0), 1.0, atol=0.01)  # D65 is Rec.709's white
    warm, cold = daylight_rgb(5000.0), daylight_rgb(10000.0)
    assert warm[0] > warm[2]
    assert cold[2] > cold[0]
    assert luminance(cold) == pytest.approx(1.0)
    assert overcast_rgb(-6.0)[2] > overcast_rgb(30.0)[2]
    assert np.allclose(overcast_rgb(30.0), 1.0, atol=0.02)


def test_overcast_at_noon_twilight_and_night():
    noon = overcast(sun_at(60.0), map_height=64)
    assert noon.sun is noon.moon is None
    assert luminance(global_horizontal_illuminance(noon)) == pytest.approx(
        300 + 21000 * np.sin(np.radians(60)), rel=0.01
    )
    zenith, horizon = luminance(noon.sky_radiance[0, 0]), luminance(noon.sky_radiance[31, 0])
    assert zenith / horizon == pytest.approx(3.0, rel=0.06)
    assert np.ptp(noon.sky_radiance[10], axis=0).max() == 0.0

    dusk = overcast(sun_at(-6.0), map_height=32)
    assert luminance(global_horizontal_illuminance(dusk)) == pytest.approx(0.4 * 3.4, rel=0.02)
    night = overcast(sun_at(-30.0), map_height=32)
    assert 1e-4 < luminance(global_horizontal_illuminance(night)) < 6e-4
    moonlit = overcast(sun_at(-30.0), LunarPosition(0.0, 45.0, 45.0, 384400.0, 1.0, 4.0, 0.998, True), map_height=32)
    assert 0.02 < luminance(global_horizontal_illuminance(moonlit)) < 0.08  # a fifth of 0.2 lx


def test_grey_air_is_opaque_at_infinity_downwards():
    elevation = np.array([-90.0, -60.0, -30.0, -5.0, -1e-6, 0.0])
    air = grey_air(20.0, np.array([800.0, 900.0, 1000.0]))
    transmittance, airlight = air(np.full(6, np.inf), direction_from_angles(0.0, elevation))
    assert np.all(transmittance == 0.0)
    assert np.all(airlight == air.airlight)


def test_clouds_keep_frame_and_time_and_cover_the_visible_sky():
    towards = direction_from_angles(135.0, 40.0)
    below = np.full((32, 64, 3), 2000.0, np.float32)
    frame, time = LocalFrame(46.5, 7.9, 1000.0), datetime(2024, 7, 20, 12, tzinfo=UTC)
    clear = Illumination(below, Luminary(towards, np.full(3, 80e3), 0.267), frame=frame, time=time)
    assert with_clouds(clear, 0.6, towards).visible_sky is None
    cloudy = with_clouds(replace(clear, visible_sky=0.5 * below), 0.6, towards)
    assert (cloudy.frame, cloudy.time) == (frame, time)
    assert cloudy.visible_sky.dtype == np.float32
    # The clouds are the same; the clear part of the sky is half as bright at the height of the camera.
    np.testing.assert_allclose((cloudy.sky_radiance - cloudy.visible_sky)[:16], 0.4 * 1000.0, rtol=1e-4)


def test_grey_air_is_koschmieder_along_the_horizon_and_thins_upwards():
    air = grey_air(20.0, np.array([800.0, 900.0, 1000.0]))
    depth = np.array([0.0, 5_000.0, 20_000.0, np.inf])
    transmittance, airlight = air(depth, np.broadcast_to([1.0, 0.0, 0.0], (4, 3)))
    assert np.allclose(transmittance[:3, 1], np.exp(-3.912 * depth[:3] / 20_000.0), rtol=1e-3)
    assert np.allclose(transmittance[2, 1], 0.02, atol=1e-4)
    assert np.allclose(airlight[3], [800.0, 900.0, 1000.0])
    assert np.all(transmittance[1:3, 0] > transmittance[1:3, 2])  # red goes further
    up, _ = air(np.array([10_000.0, np.inf]), np.array([[0.0, 0.6, 0.8], [0.0, 0.6, 0.8]]))
    down, _ = air(np.array([10_000.0, np.inf]), np.array([[0.0, 0.6, -0.8], [0.0, 0.6, -0.8]]))
    assert up[0, 1] > np.exp(-3.912 * 10 / 20) > down[0, 1]
    assert np.all((up[1] > 0) & (down[1] == 0.0))
    # Against the slow sum along the ray.
    s = (np.arange(200_000) + 0.5) * (10_000.0 / 200_000)
    haze, rayleigh = air.extinction_per_m[:, 1]
    optical = np.sum(haze * np.exp(-s * 0.8 / 1500.0) + rayleigh * np.exp(-s * 0.8 / 8000.0)) * 0.05
    assert up[0, 1] == pytest.approx(np.exp(-optical), rel=1e-6)


def clear_day(elevation_deg=35.0) -> tuple[Illumination, np.ndarray]:
    """A blue dome with a white sun: 60,000 lx direct normal, about 12,000 lx from the sky."""
    towards = direction_from_angles(180.0, elevation_deg)
    direction = equirectangular_directions(48, 96)
    sky = np.where(direction[..., 2:] > 0, np.array([2500.0, 4000.0, 8000.0]), 2000.0) * np.ones((48, 96, 1))
    sun = Luminary(towards, np.array([66e3, 60e3, 50e3]), 0.267)
    air = grey_air(50.0, np.array([3000.0, 4000.0, 6000.0]))
    return Illumination(sky, sun=sun, aerial_perspective=air, model={"kind": "test"}), towards


def test_cloudiness_is_monotone_from_clear_to_overcast():
    clear, towards = clear_day()
    assert with_clouds(clear, 0.0, towards) is clear
    shares = np.linspace(0.0, 1.0, 21)
    skies = [with_clouds(clear, share, towards) for share in shares]
    total = np.array([luminance(global_horizontal_illuminance(sky)) for sky in skies])
    direct = np.array([luminance(direct_horizontal_illuminance(sky.sun)) for sky in skies])
    radius = np.array([sky.sun.angular_radius_deg for sky in skies[:-1]])
    assert np.all(np.diff(total) < 0)
    assert np.all(np.diff(direct) < 0)
    assert np.all(np.diff(radius) > 0)
    assert skies[-1].sun is None
    assert radius[0] == 0.267
    assert 2.0 < radius[-1] < 2.5
    # Kasten & Czeplak's forms, with our transmission at full cover.
    t = float(cloud_transmission(35.0))
    assert np.allclose(total, total[0] * (1.0 - (1.0 - t) * shares**3.4), rtol=1e-5)
    assert np.allclose(direct / total * total[0] / direct[0], 1.0 - shares**2, atol=1e-5)


def test_cloudiness_greys_the_sky_and_closes_into_the_overcast_distribution():
    clear, towards = clear_day()
    blueness = []
    for share in (0.0, 0.3, 0.6, 1.0):
        rgb = diffuse_horizontal_illuminance(with_clouds(clear, share, towards).sky_radiance)
        blueness.append(rgb[2] / rgb[0])
    assert np.all(np.diff(blueness) < 0)
    assert blueness[-1] == pytest.approx(1.0, abs=0.03)
    closed = with_clouds(clear, 1.0, towards).sky_radiance
    assert np.allclose(luminance(closed[0]) / luminance(closed[23]), 3.0, rtol=0.1)
    half = with_clouds(clear, 0.5, towards).sky_radiance
    assert luminance(half[int(48 * 55 / 180), 48]) > 1.5 * luminance(
        half[int(48 * 55 / 180), 0]
    )  # corona about the sun
    # The ground below follows the light on it.
    dim = luminance(closed[-1, 0]) / luminance(clear.sky_radiance[-1, 0])
    assert dim == pytest.approx(float(cloud_transmission(35.0)), rel=0.05)


def test_clouded_air_ends_in_the_horizon_and_dims():
    clear, towards = clear_day()
    ray = np.array([[1.0, 0.0, 0.0]])
    for share in (0.2, 1.0):
        clouded = with_clouds(clear, share, towards)
        transmittance, airlight = clouded.aerial_perspective(np.array([np.inf]), ray)
        assert np.allclose(transmittance, 0.0, atol=1e-6)
        assert luminance(airlight)[0] > 0.0
    near_clear = clear.aerial_perspective(np.array([8000.0]), ray)
    near_closed = with_clouds(clear, 1.0, towards).aerial_perspective(np.array([8000.0]), ray)
    assert np.allclose(near_clear[0], near_closed[0])
    horizon = with_clouds(clear, 1.0, towards).sky_radiance[23, 24]
    assert np.allclose(airlight[0], horizon, rtol=0.1)


@pytest.mark.parametrize("share", [-0.1, 1.1, np.nan])
def test_cloudiness_outside_its_range_is_refused(share):
    clear, towards = clear_day()
    with pytest.raises(ValueError, match="cloudiness"):
        with_clouds(clear, share, towards)
