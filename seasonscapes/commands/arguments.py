"""Arguments as text on the command line, parsed into values; every mistake is one `InputError` that names the flag."""

from __future__ import annotations

import re
from datetime import date, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

from seasonscapes.commands.console import message
from seasonscapes.errors import InputError
from seasonscapes.frames import normal_longitude
from seasonscapes.text_files import read_text

if TYPE_CHECKING:
    from seasonscapes.workflows.albedo_sources import AlbedoFile

_LONGEST_SECONDS = 366 * 86400.0


def check_range(flag: str, value: float, low: float, high: float) -> None:
    """`InputError` about a flag whose value is not within [low, high]."""
    if not low <= value <= high:
        raise InputError(flag, "out of range", got=value, expected=f"{low:g} to {high:g}")


def check_choice(flag: str, value: str, choices: tuple[str, ...]) -> None:
    """`InputError` about a flag whose value is not one of the choices."""
    if value not in choices:
        expected = " or ".join([", ".join(choices[:-1]), choices[-1]])
        raise InputError(flag, f"unknown {flag.lstrip('-')}", got=value, expected=expected)


def parse_size(text: str, *, flag: str = "--size") -> tuple[int, int]:
    """``1536x1024`` as width and height [px]."""
    match = re.fullmatch(r"([0-9]{1,5})[x×]([0-9]{1,5})", text.strip())
    if not match or not (1 <= int(match[1]) <= 32768 and 1 <= int(match[2]) <= 32768):
        raise InputError(flag, "not a picture size", got=text, expected="WIDTHxHEIGHT in pixels, such as 1536x1024")
    return int(match[1]), int(match[2])


def parse_at(text: str, *, flag: str = "--at") -> tuple[float, float, float | None, float | None]:
    """``LAT,LON``, ``LAT,LON,HEIGHT`` or ``LAT,LON,+ABOVE``: latitude, longitude, height [m], above ground [m].

    Without a third number the position is 2 m above the ground.
    """
    expected = "LAT,LON or LAT,LON,HEIGHT or LAT,LON,+ABOVE_GROUND, such as 46.57,7.96,+50"
    parts = [part.strip() for part in text.split(",")]
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3):
        raise InputError(flag, "not a place", got=text, expected=expected)
    if not (-90.0 <= numbers[0] <= 90.0 and -180.0 <= numbers[1] <= 360.0):
        cure = "is the order latitude, longitude, in degrees?"
        raise InputError(flag, "latitude or longitude out of range", got=text, expected=expected, cure=cure)
    latitude, longitude = numbers[0], normal_longitude(numbers[1])
    if len(numbers) == 2:
        return latitude, longitude, None, 2.0
    if not -500.0 <= numbers[2] <= 100_000.0:
        raise InputError(flag, "height out of range", got=text, expected="-500 to 100000 metres")
    if parts[2].startswith("+"):
        if numbers[2] <= 0.0:
            raise InputError(flag, "the height above ground must be positive", got=text)
        return latitude, longitude, None, numbers[2]
    return latitude, longitude, numbers[2], None


def parse_sun(text: str, *, flag: str = "--sun") -> tuple[float, float]:
    """``AZIMUTH,ELEVATION`` of the sun [deg]."""
    expected = "AZIMUTH,ELEVATION in degrees, such as 172,38.5"
    try:
        azimuth_deg, elevation_deg = (float(part) for part in text.split(","))
    except ValueError:
        raise InputError(flag, "not a direction", got=text, expected=expected) from None
    check_range(flag, azimuth_deg, -360.0, 360.0)
    check_range(flag, elevation_deg, -18.0, 90.0)
    return azimuth_deg, elevation_deg


def parse_duration(flag: str, text: str) -> timedelta:
    """``90s``, ``10min``, ``1h``, ``1d`` as a length of time of at least a second."""
    match = re.fullmatch(r"([0-9]{1,12}(?:\.[0-9]{1,9})?)\s*(s|min|m|h|d)", text.strip())
    unit = {"s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
    seconds = float(match[1]) * unit[match[2]] if match else 0.0
    if not 1.0 <= seconds <= _LONGEST_SECONDS:
        expected = "a number and s, min, h or d, such as 10min, at most 366d"
        raise InputError(flag, "not a length of time of at least a second", got=text, expected=expected)
    return timedelta(seconds=seconds)


def parse_time(text: str, latitude_deg: float, longitude_deg: float) -> datetime:
    """An instant in UTC; what a civil time was taken to mean is printed."""
    from seasonscapes.civil_time import resolve_time

    resolved = resolve_time(text, latitude_deg, longitude_deg)
    message(resolved.reading)
    return resolved.utc


def listed(flag: str, text: str) -> list[str]:
    """Items separated by commas, or the lines of a file (comments after ``#``)."""
    try:
        is_file = Path(text).is_file()
    except OSError:  # a list of times can be longer than a file name
        is_file = False
    if is_file:
        lines = (line.split("#")[0].strip() for line in read_text(Path(text), where=flag).splitlines())
        return [line for line in lines if line]
    return [part.strip() for part in text.split(",") if part.strip()]


def parse_times(flag: str, text: str, latitude_deg: float, longitude_deg: float) -> list[datetime]:
    """Instants in UTC, in order, without repetition; see `listed`."""
    from seasonscapes.civil_time import resolve_time

    readings = [resolve_time(item, latitude_deg, longitude_deg) for item in listed(flag, text)]
    if not readings:
        raise InputError(flag, "no time in it", got=text)
    message(f"{len(readings)} times, the first one {readings[0].reading}")
    return sorted({reading.utc for reading in readings})


def parse_names(text: str | None) -> set[str]:
    """Names separated by commas."""
    return {name.strip() for name in (text or "").split(",")} - {""}


def parse_albedo(text: str) -> AlbedoFile:
    """``DATE=FILE`` as a dated albedo file."""
    from seasonscapes.workflows.albedo_sources import AlbedoFile

    expected = "DATE=FILE, such as 2024-07-20=summer.npz"
    day, equals, name = text.partition("=")
    if not equals or not name:
        raise InputError("--albedo", "not a dated texture", got=text, expected=expected)
    try:
        when = date.fromisoformat(day.strip())
    except ValueError:
        raise InputError("--albedo", "not a date", got=day, expected=expected) from None
    return AlbedoFile(when, Path(name.strip()).resolve())
