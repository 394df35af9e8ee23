"""Ephemeris of sun and moon: apparent topocentric positions, atmospheric refraction, rise, set and twilights.

Positions are computed from JPL's DE421 with skyfield, without network access. *Apparent* positions are corrected for
light time, aberration, parallax and refraction.

Refraction follows Saemundsson (1986), the formula of NREL's Solar Position Algorithm (Reda & Andreas 2004, eq. 42),
which maps true to apparent elevation. SPA sets it to zero, with a step, where the upper limb sets. A step in the sun's
direction would be a step in illumination, so here refraction applies in full down to a true elevation of -1° and fades
smoothly to zero at -6°, the end of civil twilight, below which sunlight does not reach the air near the observer.
Apparent elevation is a continuous and strictly increasing function of true elevation.

Time: Earth rotation follows UT1. UTC differs from it by less than 0.9 s since 1972, and the difference is taken from
the IERS table included in skyfield. Before 1972, and after the end of that table, civil UTC is taken *as* UT1, because
an assumption about future leap seconds would rotate the sky by up to 0.01°.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from datetime import UTC, datetime, timedelta, tzinfo
from datetime import date as Date
from functools import lru_cache
from typing import Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.declaration import InputError
from seasonscapes.frames import direction_from_angles

SUN_RADIUS_KM = 695_700.0  # IAU 2015 resolution B3, nominal
MOON_RADIUS_KM = 1737.4  # IAU WGCCRE 2015, mean
_AU_KM = 149_597_870.7

# Elevation of the sun's centre when its upper limb touches a sea-level horizon: 34' refraction + 16' radius.
SUNRISE_ELEVATION_DEG = -50.0 / 60.0
CIVIL_DEG, NAUTICAL_DEG, ASTRONOMICAL_DEG = -6.0, -12.0, -18.0

_FADE_FROM_DEG, _FADE_TO_DEG = -1.0, -6.0
# Below its turning point Saemundsson's formula tends to a pole at -5.11°; its argument is clamped there.
_TURNING_POINT_DEG = np.sqrt(10.3) - 5.11

# skyfield's annotations lose the types of `reify` properties, of sums of vectors and of scalar against array results.
_Skyfield: TypeAlias = Any


@dataclass(frozen=True)
class SolarPosition:
    """Position of the sun; scalars for one instant, arrays ``(T,)`` for many.

    Parameters
    ----------
    azimuth_deg
        Azimuth clockwise from true north [deg].
    elevation_deg
        Apparent (refracted) elevation [deg].
    true_elevation_deg
        Topocentric elevation without refraction [deg].
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
        """Angular radius of the disc without flattening by refraction [deg]."""
        return _unwrapped(np.degrees(np.arcsin(SUN_RADIUS_KM / (np.asarray(self.distance_au) * _AU_KM))))


@dataclass(frozen=True)
class LunarPosition:
    """Position and phase of the moon; scalars for one instant, arrays ``(T,)`` for many.

    Parameters
    ----------
    azimuth_deg, elevation_deg, true_elevation_deg
        As in `SolarPosition` [deg].
    distance_km
        Distance from the observer (not from the geocentre) [km].
    sun_distance_au
        Distance between moon and sun [au].
    phase_angle_deg
        Angle sun-moon-observer, 0 at full and 180 at new moon [deg].
    illuminated_fraction
        Sunlit fraction of the disc in [0, 1].
    waxing
        True from new to full moon.
    shadow_angle_deg
        Angle between the moon's centre and the axis of the Earth's shadow, seen from the geocentre [deg].
    geocentric_km
        Distance from the geocentre [km].
    """

    azimuth_deg: float
    elevation_deg: float
    true_elevation_deg: float
    distance_km: float
    sun_distance_au: float
    phase_angle_deg: float
    illuminated_fraction: float
    waxing: bool
    shadow_angle_deg: float = 180.0
    geocentric_km: float = 384_400.0

    @property
    def direction(self) -> np.ndarray:
        """Unit vector towards the apparent moon, ``(..., 3)`` east-north-up."""
        return direction_from_angles(self.azimuth_deg, self.elevation_deg)

    @property
    def angular_radius_deg(self) -> float:
        """Angular radius of the disc [deg]."""
        return _unwrapped(np.degrees(np.arcsin(MOON_RADIUS_KM / np.asarray(self.distance_km))))


Position = TypeVar("Position", SolarPosition, LunarPosition)


@dataclass(frozen=True)
class SunEvents:
    """Sun events of one solar day, from midnight to midnight about the culmination; aware UTC datetimes.

    A dusk after civil midnight therefore belongs to the solar day that it ends. Events are ``None`` if the sun does not
    cross the elevation, as in polar day, polar night and white nights.

    Parameters
    ----------
    solar_noon
        Culmination of the sun.
    sunrise, sunset
        Elevation `SUNRISE_ELEVATION_DEG`.
    civil_dawn, civil_dusk, nautical_dawn, nautical_dusk, astronomical_dawn, astronomical_dusk
        Elevations of -6°, -12° and -18°.
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


def standard_pressure_hpa(height_m: ArrayLike) -> float:
    """Compute the pressure of the ICAO standard atmosphere below 11 km.

    Parameters
    ----------
    height_m
        Height above sea level ``(...)`` [m].

    Returns
    -------
    float
        Pressure [hPa]; an array ``(...)`` for an array of heights.
    """
    return 1013.25 * _unwrapped(1.0 - 2.25577e-5 * np.asarray(height_m, float)) ** 5.25588


def refraction_deg(
    true_elevation_deg: ArrayLike, *, pressure_hpa: float = 1013.25, temperature_c: float = 10.0
) -> np.ndarray:
    """Compute the refraction of a body observed from the ground, apparent minus true elevation.

    Saemundsson, Sky & Telescope 72 (1986) 70, scaled as in Reda & Andreas (2004), eq. 42. It fades to zero between true
    elevations of -1° and -6°, see the module's documentation.

    Parameters
    ----------
    true_elevation_deg
        True elevation ``(...)`` [deg].
    pressure_hpa, temperature_c
        Pressure [hPa] and temperature [°C] of the air at the observer.

    Returns
    -------
    ndarray
        Refraction ``(...)`` [deg]; a scalar for a scalar elevation.
    """
    true = np.asarray(true_elevation_deg, float)
    clamped = np.maximum(true, _TURNING_POINT_DEG)
    lift = (pressure_hpa / 1010.0) * (283.0 / (273.0 + temperature_c)) * 1.02 / 60.0
    lift = lift / np.tan(np.radians(clamped + 10.3 / (clamped + 5.11)))
    fade = np.clip((true - _FADE_TO_DEG) / (_FADE_FROM_DEG - _FADE_TO_DEG), 0.0, 1.0)
    return _unwrapped(lift * fade**2 * (3.0 - 2.0 * fade))


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
    """Compute the apparent topocentric position of the sun.

    Parameters
    ----------
    time
        Aware datetime, or a sequence of T aware datetimes.
    latitude_deg, longitude_deg
        WGS 84 position of the observer [deg].
    height_m
        Height of the observer [m].
    pressure_hpa, temperature_c
        Pressure [hPa] and temperature [°C] of the air at the observer, for refraction. Without a pressure that of the
        standard atmosphere at the observer's height is used.
    delta_t_s
        TT - UT1 [s]. If given, ``time`` is taken as UT1, as in NREL SPA.

    Returns
    -------
    SolarPosition
        Scalars for one datetime, arrays ``(T,)`` for a sequence.

    Raises
    ------
    ValueError
        If a datetime is naive, or the position is out of range.
    InputError
        If a time is outside the ephemeris (1899-07-29 to 2053-10-07).
    """
    when = _skyfield_time(time, delta_t_s)
    kernel, observer = _kernel(), _observer(latitude_deg, longitude_deg, height_m)
    elevation, azimuth, distance = observer.at(when).observe(kernel["sun"]).apparent().altaz()
    lift = _lift(elevation.degrees, height_m, pressure_hpa, temperature_c)
    return SolarPosition(
        azimuth_deg=_scalar_or_array(azimuth.degrees, time),
        elevation_deg=_scalar_or_array(elevation.degrees + lift, time),
        true_elevation_deg=_scalar_or_array(elevation.degrees, time),
        distance_au=_scalar_or_array(distance.au, time),
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
    """Compute the apparent topocentric position, distance and phase of the moon.

    Parameters
    ----------
    time, latitude_deg, longitude_deg, height_m, pressure_hpa, temperature_c
        As in `sun_position`.

    Returns
    -------
    LunarPosition
        Scalars for one datetime, arrays ``(T,)`` for a sequence.

    Raises
    ------
    ValueError, InputError
        As in `sun_position`.
    """
    when = _skyfield_time(time, None)
    kernel, observer = _kernel(), _observer(latitude_deg, longitude_deg, height_m).at(when)
    moon = observer.observe(kernel["moon"])
    apparent = moon.apparent()
    elevation, azimuth, distance = apparent.altaz()
    lift = _lift(elevation.degrees, height_m, pressure_hpa, temperature_c)
    sun = observer.observe(kernel["sun"])
    # Both astrometric positions are corrected for light time to the observer, which suffices for the phase.
    to_sun = sun.position.km - moon.position.km
    to_observer = -moon.position.km
    cosine = np.sum(to_sun * to_observer, axis=0) / np.linalg.norm(to_sun, axis=0) / np.linalg.norm(to_observer, axis=0)
    cosine = np.clip(cosine, -1.0, 1.0)
    geocentric = observer.position.km - kernel["earth"].at(when).position.km
    from_earth = [values + geocentric for values in (moon.position.km, to_sun + moon.position.km)]
    shadow = _angle_deg(from_earth[0], -from_earth[1])
    # The moon is waxing while it is east of the sun in ecliptic longitude.
    longitudes = [body.ecliptic_latlon("date")[1].degrees for body in (apparent, sun.apparent())]
    return LunarPosition(
        azimuth_deg=_scalar_or_array(azimuth.degrees, time),
        elevation_deg=_scalar_or_array(elevation.degrees + lift, time),
        true_elevation_deg=_scalar_or_array(elevation.degrees, time),
        distance_km=_scalar_or_array(distance.km, time),
        sun_distance_au=_scalar_or_array(np.linalg.norm(to_sun, axis=0) / _AU_KM, time),
        phase_angle_deg=_scalar_or_array(np.degrees(np.arccos(cosine)), time),
        illuminated_fraction=_scalar_or_array(0.5 * (1.0 + cosine), time),
        waxing=_scalar_or_array((longitudes[0] - longitudes[1]) % 360.0 < 180.0, time),
        shadow_angle_deg=_scalar_or_array(shadow, time),
        geocentric_km=_scalar_or_array(np.linalg.norm(from_earth[0], axis=0), time),
    )


def _angle_deg(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Angle [deg] between vectors ``(3, ...)``, accurate for small ones too."""
    a, b = (vector / np.linalg.norm(vector, axis=0) for vector in (first, second))
    return np.degrees(2.0 * np.arctan2(np.linalg.norm(a - b, axis=0), np.linalg.norm(a + b, axis=0)))


def sun_events(date: Date, latitude_deg: float, longitude_deg: float, tz: tzinfo = UTC) -> SunEvents:
    """Compute sunrise, sunset, solar noon and twilights of the solar day that culminates on a civil date.

    Parameters
    ----------
    date
        Civil date at the place.
    latitude_deg, longitude_deg
        WGS 84 position [deg].
    tz
        Time zone of the civil date.

    Returns
    -------
    SunEvents
        Aware UTC datetimes, or ``None`` for events that do not occur.

    Raises
    ------
    ValueError
        If the position is out of range.
    InputError
        If the date is outside the ephemeris.

    Notes
    -----
    By convention for a flat horizon at sea level: centre of the sun at -50', -6°, -12° and -18°. The horizon of the
    terrain is not taken into account.
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
    events = [
        None if np.isnan(days) else _utc_datetime(scale.tt_jd(noon.whole, noon.tt_fraction + days))
        for days in _crossings(elevation_deg, levels).ravel()
    ]
    return SunEvents(_utc_datetime(noon), *events)


def _crossings(elevation_deg: Callable[[np.ndarray], np.ndarray], levels: np.ndarray) -> np.ndarray:
    """Days from noon ``(L, 2)`` of the last upward crossing of each level before noon and the first downward one after.

    NaN where there is no crossing. skyfield's own search divides by zero when the culmination only just fails to reach
    a level; a coarse scan followed by the secant method is robust there.
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


def at_index(position: Position, index: int) -> Position:
    """Extract the position at one instant from positions at many instants.

    Parameters
    ----------
    position
        `SolarPosition` or `LunarPosition` of arrays ``(T,)``.
    index
        Index of the instant.

    Returns
    -------
    SolarPosition or LunarPosition
        Position of scalars.
    """
    values = {field.name: getattr(position, field.name)[index] for field in fields(position)}
    return type(position)(**{name: value.item() for name, value in values.items()})


def _lift(
    true_elevation_deg: ArrayLike, height_m: float, pressure_hpa: float | None, temperature_c: float
) -> np.ndarray:
    pressure = standard_pressure_hpa(height_m) if pressure_hpa is None else pressure_hpa
    return refraction_deg(true_elevation_deg, pressure_hpa=pressure, temperature_c=temperature_c)


def _unwrapped(values: np.ndarray) -> Any:
    """Scalar of a zero-dimensional array, otherwise the array itself."""
    return values[()]


def _scalar_or_array(values: ArrayLike, time: datetime | Sequence[datetime]) -> Any:
    """Python scalar for one instant, array for a sequence."""
    return np.asarray(values).reshape(-1)[0].item() if isinstance(time, datetime) else np.asarray(values)


@lru_cache(maxsize=1)
def _kernel() -> _Skyfield:
    from importlib.resources import as_file, files

    from skyfield.jpllib import SpiceKernel

    # skyfield_data's own function would warn about the age of another file, which is not used here.
    with as_file(files("skyfield_data") / "data" / "de421.bsp") as path:
        return SpiceKernel(str(path))


@lru_cache(maxsize=4)
def _timescale(delta_t_s: float | None = None) -> _Skyfield:
    from skyfield.api import load
    from skyfield.timelib import Timescale

    scale = load.timescale(builtin=True)
    if delta_t_s is None:
        return scale
    return Timescale(lambda tt: np.full(np.shape(tt), delta_t_s)[()], scale.leap_dates, scale.leap_offsets)


def _observer(latitude_deg: float, longitude_deg: float, height_m: float) -> _Skyfield:
    from skyfield.api import wgs84

    if not (-90.0 <= latitude_deg <= 90.0 and -360.0 <= longitude_deg <= 360.0):
        raise ValueError(f"place: got latitude {latitude_deg}, longitude {longitude_deg}; expected degrees")
    return _kernel()["earth"] + wgs84.latlon(latitude_deg, longitude_deg, elevation_m=height_m)


# Julian dates of 1972-01-01, and of the first and last whole day of the kernel.
_UTC_BEGINS_JD, _FIRST_JD, _LAST_JD = 2441317.5, 2414865.5, 2471182.5


def _skyfield_time(time: datetime | Sequence[datetime], delta_t_s: float | None) -> _Skyfield:
    """A skyfield Time, scalar or ``(T,)``, by the rule for UT1 in the module's documentation."""
    times = [time] if isinstance(time, datetime) else list(time)
    for instant in times:
        if not isinstance(instant, datetime) or instant.utcoffset() is None:
            raise ValueError(f"time: got {instant!r}, expected aware datetimes (with a time zone)")
    epoch = datetime(2000, 1, 1, 12, tzinfo=UTC)
    seconds = np.array([(instant - epoch) / timedelta(seconds=1) for instant in times])
    whole, fraction = np.divmod(seconds, 86400.0)
    whole, fraction = whole + 2451545.0, fraction / 86400.0
    if np.any((whole + fraction < _FIRST_JD) | (whole + fraction > _LAST_JD)):
        wrong = times[int(np.argmax((whole + fraction < _FIRST_JD) | (whole + fraction > _LAST_JD)))]
        raise InputError(
            "time", "outside the ephemeris of sun and moon", got=wrong.isoformat(), expected="1899-07-29 to 2053-10-07"
        )
    scale = _timescale(delta_t_s)
    # ΔT changes by seconds per year, so that evaluating it at UT1 instead of TT is exact enough (< 1 µs).
    terrestrial = fraction + scale.delta_t_function(whole + fraction) / 86400.0
    if delta_t_s is None:
        in_table = (whole + fraction >= _UTC_BEGINS_JD) & (whole + fraction < scale.delta_t_table[0][-1])
        from_utc = scale.from_datetimes([instant.astimezone(UTC) for instant in times])
        terrestrial = np.where(in_table, from_utc.tt_fraction + (from_utc.whole - whole), terrestrial)
    when = scale.tt_jd(whole, terrestrial)
    return when[0] if isinstance(time, datetime) else when


def _utc_datetime(when: _Skyfield) -> datetime:
    """Aware UTC datetime of a skyfield Time rounded to a millisecond; the inverse of `_skyfield_time`."""
    if _UTC_BEGINS_JD <= when.tt < _timescale().delta_t_table[0][-1]:
        utc = when.utc_datetime()
    else:
        days = (when.whole - 2451545.0) + when.ut1_fraction
        utc = datetime(2000, 1, 1, 12, tzinfo=UTC) + timedelta(days=float(days))
    return utc.replace(microsecond=0) + timedelta(milliseconds=round(utc.microsecond / 1000))
