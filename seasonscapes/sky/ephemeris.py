"""Where the sun and the moon stand: apparent topocentric places, refraction, and the events of a day.

Positions come from JPL's DE421 through skyfield, entirely offline. What is *apparent* here is what an eye or a camera
at the place sees: light time, aberration, parallax and refraction are all in it.

Refraction follows Saemundsson (1986), the formula of NREL's Solar Position Algorithm (Reda & Andreas 2004, eq. 42),
which maps true to apparent elevation. SPA switches it off with a step where the upper limb sets. A step in a sun's
direction is a step in a picture's light, so here it stays in full down to a true elevation of -1°, and fades smoothly
to nothing at -6°, the end of civil twilight; below that a ray from the sun no longer reaches the air near the
observer. Apparent elevation is continuous and rises strictly with true elevation everywhere.

Time: Earth rotation is UT1. UTC is within 0.9 s of it from 1972 on, where the difference is taken from the IERS table
that skyfield ships. Before 1972, and after that table ends, civil UTC is taken *as* UT1: a guess at future leap
seconds would otherwise turn the sky by up to 0.01°.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime, timedelta, tzinfo
from datetime import date as Date
from functools import lru_cache
from typing import Any

import numpy as np

from seasonscapes.declaration import InputError
from seasonscapes.frames import direction_from_angles

SUN_RADIUS_KM = 695_700.0  # IAU 2015 resolution B3, nominal
MOON_RADIUS_KM = 1737.4  # IAU WGCCRE 2015, mean
_AU_KM = 149_597_870.7

# Elevation of the sun's centre at which its upper limb stands on a sea-level horizon: 34' refraction + 16' radius.
SUNRISE_ELEVATION_DEG = -50.0 / 60.0
CIVIL_DEG, NAUTICAL_DEG, ASTRONOMICAL_DEG = -6.0, -12.0, -18.0

_FADE_FROM_DEG, _FADE_TO_DEG = -1.0, -6.0
# Below its turning point Saemundsson's formula runs towards a pole at -5.11°; it is held from there on.
_TURNING_POINT_DEG = np.sqrt(10.3) - 5.11


@dataclass(frozen=True)
class SolarPosition:
    """Where the sun stands; scalars for one instant, arrays ``(T,)`` for many.

    Parameters
    ----------
    azimuth_deg
        Clockwise from true north [deg].
    elevation_deg
        Apparent, refracted [deg].
    true_elevation_deg
        Topocentric without refraction [deg].
    distance_au
        Distance from the observer [au].
    """

    azimuth_deg: float
    elevation_deg: float
    true_elevation_deg: float
    distance_au: float

    @property
    def direction(self) -> np.ndarray:
        """Unit vector towards the apparent sun, ``(..., 3)`` east-north-up."""
        return direction_from_angles(self.azimuth_deg, self.elevation_deg)

    @property
    def angular_radius_deg(self) -> float:
        """Angular radius of the disc, before refraction flattens it [deg]."""
        return np.degrees(np.arcsin(SUN_RADIUS_KM / (np.asarray(self.distance_au) * _AU_KM)))[()]


@dataclass(frozen=True)
class LunarPosition:
    """Where the moon stands and how it is lit; scalars for one instant, arrays ``(T,)`` for many.

    Parameters
    ----------
    azimuth_deg, elevation_deg, true_elevation_deg
        As in `SolarPosition` [deg].
    distance_km
        Distance from the observer (not from the geocentre) [km].
    sun_distance_au
        Distance between moon and sun [au].
    phase_angle_deg
        Angle sun-moon-observer: 0 full, 180 new [deg].
    illuminated_fraction
        Share of the disc that is sunlit, in [0, 1].
    waxing
        True from new to full moon.
    """

    azimuth_deg: float
    elevation_deg: float
    true_elevation_deg: float
    distance_km: float
    sun_distance_au: float
    phase_angle_deg: float
    illuminated_fraction: float
    waxing: bool

    @property
    def direction(self) -> np.ndarray:
        """Unit vector towards the apparent moon, ``(..., 3)`` east-north-up."""
        return direction_from_angles(self.azimuth_deg, self.elevation_deg)

    @property
    def angular_radius_deg(self) -> float:
        """Angular radius of the disc [deg]."""
        return np.degrees(np.arcsin(MOON_RADIUS_KM / np.asarray(self.distance_km)))[()]


@dataclass(frozen=True)
class SunEvents:
    """The sun's events of one solar day, from midnight to midnight about its culmination; aware UTC datetimes.

    A dusk that falls after civil midnight therefore still belongs to the day it ends. ``None`` where the sun does not
    cross that elevation, which is never an error: it is polar day, polar night, or a white night.
    """

    solar_noon: datetime
    sunrise: datetime | None
    sunset: datetime | None
    civil_dawn: datetime | None
    civil_dusk: datetime | None
    nautical_dawn: datetime | None
    nautical_dusk: datetime | None
    astronomical_dawn: datetime | None
    astronomical_dusk: datetime | None


def standard_pressure_hpa(height_m) -> float:
    """Pressure of the ICAO standard atmosphere below 11 km [hPa]."""
    return 1013.25 * (1.0 - 2.25577e-5 * np.asarray(height_m, float))[()] ** 5.25588


def refraction_deg(true_elevation_deg, *, pressure_hpa: float = 1013.25, temperature_c: float = 10.0):
    """By how much the air lifts a body seen from the ground [deg]; see the module's text for what happens below 0°.

    Saemundsson, Sky & Telescope 72 (1986) 70, scaled as in Reda & Andreas (2004), eq. 42.
    """
    true = np.asarray(true_elevation_deg, float)
    held = np.maximum(true, _TURNING_POINT_DEG)
    lift = (pressure_hpa / 1010.0) * (283.0 / (273.0 + temperature_c)) * 1.02 / 60.0
    lift = lift / np.tan(np.radians(held + 10.3 / (held + 5.11)))
    share = np.clip((true - _FADE_TO_DEG) / (_FADE_FROM_DEG - _FADE_TO_DEG), 0.0, 1.0)
    return (lift * share**2 * (3.0 - 2.0 * share))[()]


def sun_position(
    time: datetime | Sequence[datetime],
    latitude_deg: float,
    longitude_deg: float,
    height_m: float = 0.0,
    *,
    pressure_hpa: float | None = None,
    temperature_c: float = 10.0,
    delta_t_s: float | None = None,
) -> SolarPosition:
    """Apparent topocentric place of the sun.

    Parameters
    ----------
    time
        Aware datetime, or a sequence of them ``(T,)``.
    latitude_deg, longitude_deg
        WGS 84 [deg].
    height_m
        Of the observer [m].
    pressure_hpa, temperature_c
        Air at the observer, for refraction [hPa], [°C]. Pressure follows from the height where left out.
    delta_t_s
        TT - UT1 [s]. Where given, ``time`` is taken as UT1, as NREL SPA does.

    Raises
    ------
    ValueError
        For a naive datetime or an impossible latitude.
    InputError
        For a time outside the ephemeris (1899-07-29 to 2053-10-07).
    """
    when = _skyfield_time(time, delta_t_s)
    kernel, observer = _kernel(), _observer(latitude_deg, longitude_deg, height_m)
    elevation, azimuth, distance = observer.at(when).observe(kernel["sun"]).apparent().altaz()
    lift = _lift(elevation.degrees, height_m, pressure_hpa, temperature_c)
    return SolarPosition(
        azimuth_deg=_shaped(azimuth.degrees, time),
        elevation_deg=_shaped(elevation.degrees + lift, time),
        true_elevation_deg=_shaped(elevation.degrees, time),
        distance_au=_shaped(distance.au, time),
    )


def moon_position(
    time: datetime | Sequence[datetime],
    latitude_deg: float,
    longitude_deg: float,
    height_m: float = 0.0,
    *,
    pressure_hpa: float | None = None,
    temperature_c: float = 10.0,
) -> LunarPosition:
    """Apparent topocentric place, distance and phase of the moon; parameters and errors as in `sun_position`."""
    when = _skyfield_time(time, None)
    kernel, place = _kernel(), _observer(latitude_deg, longitude_deg, height_m).at(when)
    seen = place.observe(kernel["moon"])
    elevation, azimuth, distance = seen.apparent().altaz()
    lift = _lift(elevation.degrees, height_m, pressure_hpa, temperature_c)
    # Light that reaches us now left the sun a moment before it met the moon: shift the sun's place alike.
    to_sun = place.observe(kernel["sun"]).position.km - seen.position.km
    to_observer = -seen.position.km
    cosine = np.sum(to_sun * to_observer, axis=0) / np.linalg.norm(to_sun, axis=0) / np.linalg.norm(to_observer, axis=0)
    cosine = np.clip(cosine, -1.0, 1.0)
    # The moon waxes while it stands east of the sun in ecliptic longitude.
    longitudes = [place.observe(kernel[body]).apparent().ecliptic_latlon("date")[1].degrees for body in ("moon", "sun")]
    return LunarPosition(
        azimuth_deg=_shaped(azimuth.degrees, time),
        elevation_deg=_shaped(elevation.degrees + lift, time),
        true_elevation_deg=_shaped(elevation.degrees, time),
        distance_km=_shaped(distance.km, time),
        sun_distance_au=_shaped(np.linalg.norm(to_sun, axis=0) / _AU_KM, time),
        phase_angle_deg=_shaped(np.degrees(np.arccos(cosine)), time),
        illuminated_fraction=_shaped(0.5 * (1.0 + cosine), time),
        waxing=_shaped((longitudes[0] - longitudes[1]) % 360.0 < 180.0, time),
    )


def sun_events(date: Date, latitude_deg: float, longitude_deg: float, tz: tzinfo = UTC) -> SunEvents:
    """Sunrise, sunset, solar noon and twilights of the solar day that culminates on a civil date.

    Parameters
    ----------
    date
        Civil date at the place.
    latitude_deg, longitude_deg
        WGS 84 [deg].
    tz
        Time zone of the civil date.

    Notes
    -----
    By convention for a flat horizon at sea level: centre of the sun at -50', -6°, -12° and -18°. A mountain's own
    horizon is the renderer's business.
    """
    from skyfield import almanac

    observer, sun, scale = _observer(latitude_deg, longitude_deg, 0.0), _kernel()["sun"], _timescale()
    midnight = datetime(date.year, date.month, date.day, 12, tzinfo=tz) - timedelta(hours=12)
    begin = _skyfield_time(midnight, None)
    noon = almanac.find_transits(observer, sun, begin, scale.tt_jd(begin.whole, begin.tt_fraction + 1.01))[0]

    def elevation_deg(days_from_noon: np.ndarray) -> np.ndarray:
        when = scale.tt_jd(noon.whole, noon.tt_fraction + days_from_noon)
        return observer.at(when).observe(sun).apparent().altaz()[0].degrees

    levels = np.array([SUNRISE_ELEVATION_DEG, CIVIL_DEG, NAUTICAL_DEG, ASTRONOMICAL_DEG])
    found = [
        None if np.isnan(days) else _civil(scale.tt_jd(noon.whole, noon.tt_fraction + days))
        for days in _crossings(elevation_deg, levels).ravel()
    ]
    return SunEvents(_civil(noon), *found)


def _crossings(elevation_deg: Callable[[np.ndarray], np.ndarray], levels: np.ndarray) -> np.ndarray:
    """Days from noon ``(L, 2)`` of the last rise through each level before noon and the first fall after it, or NaN.

    skyfield's own search divides by zero where a sun only just fails to rise; a coarse scan and a few rounds of the
    secant rule cannot.
    """
    grid = np.linspace(-0.5, 0.5, 145)
    above = elevation_deg(grid)[None, :] >= levels[:, None]
    left = np.full((len(levels), 2), -1)
    for index, row in enumerate(above):
        rises = np.flatnonzero(~row[:72] & row[1:73])
        falls = np.flatnonzero(row[72:-1] & ~row[73:]) + 72
        left[index] = rises[-1] if rises.size else -1, falls[0] if falls.size else -1
    missing = left < 0
    first, last, target = grid[left], grid[left + 1], np.broadcast_to(levels[:, None], left.shape)
    low, high = elevation_deg(first.ravel()).reshape(left.shape), elevation_deg(last.ravel()).reshape(left.shape)
    guess = first
    for _ in range(4):
        slope = np.where(high == low, np.inf, high - low) / np.where(last == first, 1.0, last - first)
        guess = np.clip(last + (target - high) / slope, grid[left], grid[left + 1])
        first, low, last, high = last, high, guess, elevation_deg(guess.ravel()).reshape(left.shape)
    return np.where(missing, np.nan, guess)


def at_index(position: Any, index: int) -> Any:
    """The scalar position of one instant out of a position of many."""
    values = {field.name: getattr(position, field.name)[index] for field in fields(position)}
    return type(position)(**{name: value.item() for name, value in values.items()})


def _lift(true_elevation_deg, height_m: float, pressure_hpa: float | None, temperature_c: float):
    pressure = standard_pressure_hpa(height_m) if pressure_hpa is None else pressure_hpa
    return refraction_deg(true_elevation_deg, pressure_hpa=pressure, temperature_c=temperature_c)


def _shaped(values, time):
    """Python scalars for one instant, arrays for a sequence."""
    return np.asarray(values).reshape(-1)[0].item() if isinstance(time, datetime) else np.asarray(values)


@lru_cache(maxsize=1)
def _kernel():
    from importlib.resources import as_file, files

    from skyfield.jpllib import SpiceKernel

    # Not through skyfield_data's own function: that one warns about the age of a file which is not used here.
    with as_file(files("skyfield_data") / "data" / "de421.bsp") as path:
        return SpiceKernel(str(path))


@lru_cache(maxsize=4)
def _timescale(delta_t_s: float | None = None):
    from skyfield.api import load
    from skyfield.timelib import Timescale

    scale = load.timescale(builtin=True)
    if delta_t_s is None:
        return scale
    return Timescale(lambda tt: np.full(np.shape(tt), delta_t_s)[()], scale.leap_dates, scale.leap_offsets)


def _observer(latitude_deg: float, longitude_deg: float, height_m: float):
    from skyfield.api import wgs84

    if not (-90.0 <= latitude_deg <= 90.0 and -360.0 <= longitude_deg <= 360.0):
        raise ValueError(f"place: got latitude {latitude_deg}, longitude {longitude_deg}; expected degrees")
    return _kernel()["earth"] + wgs84.latlon(latitude_deg, longitude_deg, elevation_m=height_m)


# Julian dates of 1972-01-01, and of the first and last whole day that the kernel covers.
_UTC_BEGINS_JD, _FIRST_JD, _LAST_JD = 2441317.5, 2414865.5, 2471182.5


def _skyfield_time(time: datetime | Sequence[datetime], delta_t_s: float | None):
    """A skyfield Time, scalar or ``(T,)``, by the rule for UT1 in the module's text."""
    times = [time] if isinstance(time, datetime) else list(time)
    for one in times:
        if not isinstance(one, datetime) or one.utcoffset() is None:
            raise ValueError(f"time: got {one!r}, expected aware datetimes (with a time zone)")
    epoch = datetime(2000, 1, 1, 12, tzinfo=UTC)
    seconds = np.array([(one - epoch) / timedelta(seconds=1) for one in times])
    whole, fraction = np.divmod(seconds, 86400.0)
    whole, fraction = whole + 2451545.0, fraction / 86400.0
    if np.any((whole + fraction < _FIRST_JD) | (whole + fraction > _LAST_JD)):
        wrong = times[int(np.argmax((whole + fraction < _FIRST_JD) | (whole + fraction > _LAST_JD)))]
        raise InputError(
            "time", "outside the ephemeris of sun and moon", got=wrong.isoformat(), expected="1899-07-29 to 2053-10-07"
        )
    scale = _timescale(delta_t_s)
    # ΔT varies by seconds a year, so that one look-up at UT1 instead of TT is exact enough (< 1 µs).
    terrestrial = fraction + scale.delta_t_function(whole + fraction) / 86400.0
    if delta_t_s is None:
        known = (whole + fraction >= _UTC_BEGINS_JD) & (whole + fraction < scale.delta_t_table[0][-1])
        from_utc = scale.from_datetimes([one.astimezone(UTC) for one in times])
        terrestrial = np.where(known, from_utc.tt_fraction + (from_utc.whole - whole), terrestrial)
    when = scale.tt_jd(whole, terrestrial)
    return when[0] if isinstance(time, datetime) else when


def _civil(when) -> datetime:
    """Aware UTC of a skyfield Time, the inverse of `_skyfield_time`, rounded to a millisecond."""
    if _UTC_BEGINS_JD <= when.tt < _timescale().delta_t_table[0][-1]:
        utc = when.utc_datetime()
    else:
        days = (when.whole - 2451545.0) + when.ut1_fraction
        utc = datetime(2000, 1, 1, 12, tzinfo=UTC) + timedelta(days=float(days))
    return utc.replace(microsecond=0) + timedelta(milliseconds=round(utc.microsecond / 1000))
