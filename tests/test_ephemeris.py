"""Sun and moon against NREL SPA (pvlib), published almanac values, and the rules for civil time."""

from datetime import UTC, date, datetime, timedelta, timezone
from zoneinfo import ZoneInfo

import numpy as np
import pytest

from seasonscapes.civil_time import resolve_time, zone_at
from seasonscapes.declaration import InputError
from seasonscapes.frames import direction_from_angles
from seasonscapes.sky.ephemeris import (
    at_index,
    moon_position,
    refraction_deg,
    standard_pressure_hpa,
    sun_events,
    sun_position,
)

JUNGFRAU = (46.55, 7.98)


def test_spa_published_example():
    # Reda & Andreas (2004), NREL/TP-560-34302, table A5.1.
    time = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    sun = sun_position(time, 39.742476, -105.1786, 1830.14, pressure_hpa=820.0, temperature_c=11.0, delta_t_s=67.0)
    assert f"{sun.azimuth_deg:.3f}" == "194.340"
    assert f"{90.0 - sun.elevation_deg:.3f}" == "50.112"
    assert sun.distance_au == pytest.approx(0.9965422974, abs=5e-5)  # geocentric there, topocentric here


@pytest.fixture(scope="module")
def against_spa():
    """1,000 random times 1950-2050 at 25 random places: our sun and pvlib's SPA, as unit vectors and elevations."""
    from pvlib import spa

    rng = np.random.default_rng(20240901)
    ours, theirs = [], []
    for _ in range(25):
        latitude, longitude, height = (
            np.degrees(np.arcsin(rng.uniform(-1, 1))),
            rng.uniform(-180, 180),
            rng.uniform(0, 4500),
        )
        pressure, temperature = standard_pressure_hpa(height), rng.uniform(-20, 30)
        seconds = np.sort(rng.uniform(-631152000, 2524608000, 40)).round(3)
        times = [datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=s) for s in seconds]
        sun = sun_position(times, latitude, longitude, height, pressure_hpa=pressure, temperature_c=temperature)
        delta_t = spa.calculate_deltat(np.array([t.year for t in times]), np.array([t.month for t in times]))
        spa_rows = [
            spa.solar_position(np.array([s]), latitude, longitude, height, pressure, temperature, dt, 0.5667)[:, 0]
            for s, dt in zip(seconds, delta_t, strict=True)
        ]
        ours.append(np.stack([sun.elevation_deg, sun.true_elevation_deg, sun.azimuth_deg], 1))
        theirs.append(np.array(spa_rows)[:, [2, 3, 4]])
    return np.concatenate(ours), np.concatenate(theirs)


def _separation_deg(a, b):
    return 2.0 * np.degrees(np.arcsin(0.5 * np.linalg.norm(a - b, axis=-1)))


def test_sun_agrees_with_spa_everywhere(against_spa):
    ours, theirs = against_spa
    assert len(ours) == 1000
    geometric = _separation_deg(
        direction_from_angles(ours[:, 2], ours[:, 1]), direction_from_angles(theirs[:, 2], theirs[:, 1])
    )
    assert geometric.max() < 0.01
    up = theirs[:, 1] > -0.8  # where SPA refracts
    assert 300 < up.sum() < 700
    apparent = _separation_deg(
        direction_from_angles(ours[up, 2], ours[up, 0]), direction_from_angles(theirs[up, 2], theirs[up, 0])
    )
    assert apparent.max() < 0.01


def test_refraction_is_continuous_and_elevation_strictly_rises():
    true = np.arange(-90.0, 90.0, 0.002)
    lift = refraction_deg(true)
    assert np.abs(np.diff(lift)).max() < 0.002 * 0.3  # no step: under 0.3° per degree
    assert np.diff(true + lift).min() > 0.002 * 0.5
    assert np.all(lift[true < -6.0] == 0.0)
    # Textbook values (Explanatory Supplement): about 29' at the true horizon, 5.3' at 10°, 1' at 45°.
    assert refraction_deg(0.0) * 60 == pytest.approx(28.98, abs=0.3)
    assert refraction_deg(10.0) * 60 == pytest.approx(5.4, abs=0.1)
    assert refraction_deg(45.0) * 60 == pytest.approx(1.01, abs=0.02)
    assert refraction_deg(20.0, pressure_hpa=505.0) == pytest.approx(0.5 * refraction_deg(20.0, pressure_hpa=1010.0))


def test_arrays_and_scalars_agree():
    times = [
        datetime(1955, 7, 1, 9, tzinfo=UTC),
        datetime(2010, 1, 2, 3, 4, 5, 600000, tzinfo=UTC),
        datetime(2049, 1, 1, tzinfo=UTC),
    ]
    for find in (sun_position, moon_position):
        many = find(times, *JUNGFRAU, 3500.0)
        assert many.direction.shape == (3, 3)
        for index, time in enumerate(times):
            one = find(time, *JUNGFRAU, 3500.0)
            assert isinstance(one.azimuth_deg, float)
            same = at_index(many, index)
            assert type(same) is type(one)
            assert np.allclose(same.direction, one.direction, rtol=0, atol=1e-12)
            assert same.true_elevation_deg == pytest.approx(one.true_elevation_deg, abs=1e-9)


def test_time_zone_of_the_datetime_does_not_matter():
    utc = datetime(2024, 9, 1, 10, tzinfo=UTC)
    assert sun_position(utc, *JUNGFRAU) == sun_position(utc.astimezone(ZoneInfo("Asia/Tokyo")), *JUNGFRAU)


def test_moon_of_known_eclipses_and_phases():
    # Total solar eclipse of 2024-04-08, greatest eclipse 18:17:20 UT at 25.29° N, 104.14° W (NASA): discs concentric.
    time, place = datetime(2024, 4, 8, 18, 17, 20, tzinfo=UTC), (25.2867, -104.1383)
    sun, moon = sun_position(time, *place), moon_position(time, *place)
    assert _separation_deg(sun.direction, moon.direction) < 0.01
    assert moon.angular_radius_deg / sun.angular_radius_deg == pytest.approx(
        1.0566, abs=0.003
    )  # the eclipse's magnitude
    assert moon.illuminated_fraction < 1e-4
    # First quarter 2024-09-11 06:06 UT, full moon 2024-09-18 02:34 UT, last quarter 2024-09-24 18:50 UT (USNO).
    first = moon_position(datetime(2024, 9, 11, 6, 6, tzinfo=UTC), *JUNGFRAU)
    full = moon_position(datetime(2024, 9, 18, 2, 34, tzinfo=UTC), *JUNGFRAU)
    last = moon_position(datetime(2024, 9, 24, 18, 50, tzinfo=UTC), *JUNGFRAU)
    assert first.illuminated_fraction == pytest.approx(0.5, abs=0.015)
    assert first.waxing
    assert full.illuminated_fraction > 0.998
    assert full.phase_angle_deg < 3.0
    assert last.illuminated_fraction == pytest.approx(0.5, abs=0.015)
    assert not last.waxing
    # Perigee 2024-09-18 13:23 UT at 357,286 km from the geocentre; the observer is within an Earth radius of that.
    assert abs(full.distance_km - 357_500) < 7000


def test_moon_parallax_lowers_it():
    time = datetime(2024, 9, 18, 20, tzinfo=UTC)
    here, antipode = moon_position(time, *JUNGFRAU), moon_position(time, -JUNGFRAU[0], JUNGFRAU[1] - 180.0)
    # Opposite places see elevations of opposite sign, but both lower by the parallax of about 57' cos(elevation).
    parallax_deg = -0.5 * (here.true_elevation_deg + antipode.true_elevation_deg)
    expected = np.degrees(6371.0 / 384400.0 * np.cos(np.radians(here.true_elevation_deg)))
    assert parallax_deg == pytest.approx(expected, rel=0.1)


def test_sun_events_of_zurich_and_of_the_poles():
    zurich = sun_events(date(2024, 6, 20), 47.3769, 8.5417, ZoneInfo("Europe/Zurich"))
    # USNO (aa.usno.navy.mil) rounds to the minute: sunrise 05:29, sunset 21:26 CEST.
    assert abs(zurich.sunrise - datetime(2024, 6, 20, 3, 29, tzinfo=UTC)) < timedelta(minutes=1)
    assert abs(zurich.sunset - datetime(2024, 6, 20, 19, 26, tzinfo=UTC)) < timedelta(minutes=1)
    order = [
        zurich.astronomical_dawn,
        zurich.nautical_dawn,
        zurich.civil_dawn,
        zurich.sunrise,
        zurich.solar_noon,
        zurich.sunset,
        zurich.civil_dusk,
        zurich.nautical_dusk,
        zurich.astronomical_dusk,
    ]
    assert order == sorted(order)
    # The dusk that ends this day comes after civil midnight.
    assert zurich.astronomical_dusk.astimezone(ZoneInfo("Europe/Zurich")).date() == date(2024, 6, 21)

    day = sun_events(date(2024, 6, 21), 70.0, 20.0)
    assert day.sunrise is day.sunset is day.civil_dawn is None
    night = sun_events(date(2040, 12, 21), 70.0, 20.0)
    assert night.sunrise is night.sunset is None
    assert night.civil_dawn < night.solar_noon < night.civil_dusk


@pytest.mark.parametrize("place", [(0.0, 0.0), (46.55, 7.98), (-54.8, -68.3), (66.4, 25.0)])
def test_sun_stands_at_the_horizon_when_it_rises(place):
    for day in (date(1960, 3, 20), date(2024, 12, 21), date(2045, 6, 1)):
        events = sun_events(day, *place)
        for time, level in ((events.sunrise, -50 / 60), (events.sunset, -50 / 60), (events.nautical_dusk, -12.0)):
            if time is not None:
                assert sun_position(time, *place).true_elevation_deg == pytest.approx(level, abs=0.002)
        assert events.solar_noon is not None


def test_refusals():
    with pytest.raises(ValueError, match="aware"):
        sun_position(datetime(2024, 9, 1, 12), *JUNGFRAU)
    with pytest.raises(ValueError, match="aware"):
        moon_position([datetime(2024, 9, 1, 12)], *JUNGFRAU)
    with pytest.raises(ValueError, match="degrees"):
        sun_position(datetime(2024, 9, 1, 12, tzinfo=UTC), 91.0, 0.0)
    for year in (1880, 2060):
        with pytest.raises(InputError, match=f"^time: outside the ephemeris.*{year}.*1899-07-29 to 2053-10-07$"):
            sun_position(datetime(year, 1, 1, tzinfo=UTC), *JUNGFRAU)


@pytest.mark.parametrize(
    ("text", "utc", "zone"),
    [
        ("2024-09-01T12:00", "2024-09-01T10:00:00+00:00", "Europe/Zurich"),
        ("2024-01-01 12:00", "2024-01-01T11:00:00+00:00", "Europe/Zurich"),
        ("20240901T1200", "2024-09-01T10:00:00+00:00", "Europe/Zurich"),
        ("2024-09-01T12:00:30.5+05:30", "2024-09-01T06:30:30.500000+00:00", None),
        ("2024-09-01T12:00Z", "2024-09-01T12:00:00+00:00", None),
        ("2024-10-27T02:30+01:00", "2024-10-27T01:30:00+00:00", None),
    ],
)
def test_resolve_time(text, utc, zone):
    resolved = resolve_time(text, *JUNGFRAU)
    assert resolved.utc.isoformat() == utc
    assert resolved.zone == zone
    assert text[:4] in resolved.reading
    assert "\n" not in resolved.reading


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "2024-03-31T02:30",
            r"does not exist in Europe/Zurich.*2024-03-31T02:30:00\+01:00 or 2024-03-31T02:30:00\+02:00",
        ),
        (
            "2024-10-27T02:30",
            r"happens twice in Europe/Zurich.*2024-10-27T02:30:00\+02:00 or 2024-10-27T02:30:00\+01:00",
        ),
        ("2024-09-01", "the hour is missing"),
        ("noonish", "not an ISO 8601 date and time; got 'noonish'"),
        ("2024-02-30T12:00", "not an ISO 8601 date and time"),
        ("0001-01-01T00:00+05:00", "out of range"),
        ("", "not an ISO 8601"),
    ],
)
def test_resolve_time_refuses(text, message):
    with pytest.raises(InputError, match=message) as caught:
        resolve_time(text, *JUNGFRAU)
    assert "\n" not in str(caught.value)


def test_zones():
    assert zone_at(46.55, 7.98) == "Europe/Zurich"
    assert zone_at(0.0, -140.0).startswith("Etc/GMT")
    with pytest.raises(InputError, match="no civil time zone"):
        zone_at(120.0, 0.0)
