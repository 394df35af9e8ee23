"""Eclipses: coverage of the sun by the moon, the moon in the Earth's shadow, and the light that is left."""

from dataclasses import replace

import numpy as np
import pytest

import seasonscapes as ss
from seasonscapes.sky.eclipses import eclipse_record, lunar_eclipse, solar_eclipse, visible_fraction
from seasonscapes.sky.illuminate import SkyEvaluators, illuminate
from seasonscapes.sky.models import read_sky_model

BURGOS = (42.34, -3.70, 860.0)


def at(time: str, place: tuple[float, float, float]):
    position = ss.sun_moon_position(time, *place)
    return position.sun, position.moon


@pytest.mark.parametrize(
    ("time", "place", "kind", "magnitude"),
    [
        # Published circumstances: path of totality 2024 (Mexico) and 2026 (Spain), annularity of 2023-10-14 in Texas
        # (magnitude 0.952 on the central line, San Antonio), the partial eclipse of 2025-03-29 in London (40.9 % of
        # the diameter covered at 11:03 UTC).
        ("2024-04-08T18:17:00Z", (25.28, -104.13, 1200.0), "total", 1.057),
        ("2026-08-12T18:29:30Z", BURGOS, "total", 1.034),
        ("2023-10-14T16:54:00Z", (29.6, -98.9, 300.0), "annular", 0.952),
        ("2025-03-29T11:03:00Z", (51.51, -0.13, 20.0), "partial", 0.41),
    ],
)
def test_solar_eclipses_of_the_almanac(time, place, kind, magnitude):
    eclipse = solar_eclipse(*at(time, place))
    assert eclipse is not None
    assert eclipse.kind == kind
    assert eclipse.magnitude == pytest.approx(magnitude, abs=0.012)


@pytest.mark.parametrize(
    ("time", "kind", "magnitude"),
    [
        ("2025-03-14T06:58:43Z", "total", 1.178),
        ("2024-09-18T02:44:18Z", "partial", 0.085),
        ("2024-03-25T07:12:51Z", "penumbral", -0.132),
    ],
)
def test_lunar_eclipses_of_the_almanac(time, kind, magnitude):
    eclipse = lunar_eclipse(at(time, (39.7, -105.0, 1600.0))[1])
    assert eclipse is not None
    assert eclipse.kind == kind
    assert eclipse.magnitude == pytest.approx(magnitude, abs=0.005)


def test_an_ordinary_day_and_an_ordinary_full_moon_have_none():
    sun, moon = at("2024-06-20T11:30Z", BURGOS)
    assert solar_eclipse(sun, moon) is None
    assert lunar_eclipse(moon) is None
    assert eclipse_record(sun, moon) is None
    assert lunar_eclipse(at("2024-06-22T01:00Z", BURGOS)[1]) is None


def test_visible_fraction_against_a_disc_of_points():
    rng = np.random.default_rng(3)
    radius = np.sqrt(rng.random(400_000))
    angle = rng.random(400_000) * 2.0 * np.pi
    x, y, mu = radius * np.cos(angle), radius * np.sin(angle), np.sqrt(1.0 - radius**2)
    for separation, moon in ((0.3, 1.02), (0.9, 0.97), (1.5, 1.05), (0.0, 0.9)):
        left = np.hypot(x - separation, y) > moon
        for channel, wavelength in enumerate((0.611, 0.549, 0.464)):
            brightness = mu ** (-0.023 + 0.292 / wavelength)
            expected = brightness[left].sum() / brightness.sum()
            assert visible_fraction(separation, moon)[channel] == pytest.approx(expected, abs=2e-3)
    assert np.all(visible_fraction(0.0, 1.03) == 0.0)
    assert np.all(visible_fraction(2.1, 1.05) == 1.0)
    # The limb is redder than the centre.
    red, green, blue = visible_fraction(0.0, 0.9)
    assert red > green > blue


@pytest.mark.parametrize("sky", ["overcast", "hosek"])
def test_light_follows_the_eclipse_without_a_step(sky):
    from seasonscapes.rendering.hosek import hosek_illumination

    model = read_sky_model(sky)
    sun, moon = at("2026-08-12T18:29:30Z", BURGOS)

    def lux(elevation_deg: float) -> float:
        covering = replace(moon, azimuth_deg=sun.azimuth_deg, elevation_deg=elevation_deg)
        light = illuminate(model, sun, covering, map_height=32, evaluators=SkyEvaluators(hosek=hosek_illumination))
        return float(light.global_horizontal_lx[1])

    whole = lux(sun.elevation_deg + 2.0)
    steps = [lux(sun.elevation_deg + 0.05 * k) / whole for k in range(14)]
    assert steps[0] < 0.002
    assert min(np.diff(steps)) > -1e-9
    assert steps[-1] == pytest.approx(1.0)
    assert max(np.diff(steps)) < 0.2


def test_totality_in_spain_and_its_record():
    sun, moon = at("2026-08-12T18:29:30Z", BURGOS)
    light = illuminate(read_sky_model("overcast"), sun, moon, map_height=32)
    assert light.model["eclipse"] == {"of": "sun", "kind": "total", "magnitude": pytest.approx(1.034, abs=0.005)}
    assert light.global_horizontal_lx[1] < 100.0
