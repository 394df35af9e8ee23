"""Parsing of ISO 8601 times; a time without UTC offset is civil time at a given place."""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from seasonscapes.declaration import InputError

# What is taken for a date and time, and the beginning of it after which a point or comma stands. Python's own parser drops
# what follows such a point: half past six, written 18.30, would be six.
_DATE = r"[0-9]{4}(?:-[0-9]{2}-[0-9]{2}|[0-9]{4}|-?W[0-9]{2}(?:-?[0-9])?)"
_CLOCK = r"[0-9]{2}(?::?[0-9]{2}(?::?[0-9]{2}(?:[.,][0-9]+)?)?)?"
_OFFSET = r"(?:[Zz]|[+-][0-9]{2}(?::?[0-9]{2}(?::?[0-9]{2})?)?)?"
_ISO_8601 = re.compile(rf"{_DATE}(?:[Tt ]{_CLOCK}{_OFFSET})?")
_FRACTION = re.compile(rf"{_DATE}[Tt ][0-9]{{2}}(?::?[0-9]{{2}})?[.,][0-9]")


@dataclass(frozen=True)
class ResolvedTime:
    """A parsed time and its interpretation.

    Parameters
    ----------
    utc
        Aware UTC datetime.
    zone
        IANA name of the civil time zone that was assumed, or ``None`` if the text gave its own offset.
    reading
        One human-readable line with the text, the time zone and the UTC time.
    """

    utc: datetime
    zone: str | None
    reading: str


def zone_at(latitude_deg: float, longitude_deg: float) -> str:
    """Look up the civil time zone at a place.

    Parameters
    ----------
    latitude_deg, longitude_deg
        WGS 84 position [deg].

    Returns
    -------
    str
        IANA name of the zone; ``Etc/GMT±h`` at sea.

    Raises
    ------
    InputError
        If no zone is known there.
    """
    from tzfpy import get_tz

    name = get_tz(longitude_deg, latitude_deg) if abs(latitude_deg) <= 90.0 and abs(longitude_deg) <= 180.0 else ""
    try:
        ZoneInfo(name)
    except (ZoneInfoNotFoundError, ValueError):
        raise InputError(
            "time",
            f"no civil time zone is known at latitude {latitude_deg}, longitude {longitude_deg}",
            cure="give the time with an offset, e.g. 2024-09-01T12:00Z",
        ) from None
    return name


def parse_time_text(text: str) -> datetime:
    """Parse an ISO 8601 date and time as it is written, with or without UTC offset.

    Raises
    ------
    InputError
        If the text is not a date with a time, or its hour or minute has a fraction.
    """
    text = text.strip()
    if _FRACTION.match(text):
        expected = "hours, minutes and seconds with colons between"
        cure = "write half past six in the evening as T18:30"
        raise InputError("time", "an hour or minute with a fraction", got=text, expected=expected, cure=cure)
    try:
        if not _ISO_8601.fullmatch(text):
            raise ValueError("another form than those above")
        parsed = datetime.fromisoformat(text.upper())
    except ValueError:
        raise InputError(
            "time",
            "not an ISO 8601 date and time",
            got=text,
            expected="e.g. 2024-09-01T12:00, 2024-09-01T12:00+02:00 or 2024-09-01T10:00Z",
        ) from None
    if not any(separator in text for separator in "Tt "):
        raise InputError(
            "time", "the hour is missing", got=text, expected="a date and time", cure=f"write {text}T12:00"
        )
    return parsed


def resolve_time(text: str, latitude_deg: float, longitude_deg: float) -> ResolvedTime:
    """Parse an ISO 8601 date and time; without UTC offset it is civil time at the place.

    Parameters
    ----------
    text
        Date and time, such as ``2024-09-01T12:00`` or ``2024-09-01T10:00Z``.
    latitude_deg, longitude_deg
        WGS 84 position [deg], used for a time without offset.

    Returns
    -------
    ResolvedTime
        The UTC time with its interpretation.

    Raises
    ------
    InputError
        If the text is not a date with a time, if its hour or minute has a fraction (18.30 may be half past six or
        18:18), or if daylight saving skips or repeats the time there. A wrong guess of the offset would displace the
        sun by 15°.

    Examples
    --------
    >>> resolve_time("2024-09-01T12:00+02:00", 46.6, 8.0).reading
    '2024-09-01T12:00+02:00 = 2024-09-01T10:00:00Z'
    """
    parsed = parse_time_text(text)
    text = text.strip()
    try:
        if parsed.utcoffset() is not None:
            utc = parsed.astimezone(UTC)
            return ResolvedTime(utc, None, f"{text} = {_utc_text(utc)}")
        name = zone_at(latitude_deg, longitude_deg)
        early, late = (parsed.replace(tzinfo=ZoneInfo(name), fold=fold) for fold in (0, 1))
        if early.utcoffset() != late.utcoffset():
            raise _ambiguous_time_error(text, name, early, late)
        utc = early.astimezone(UTC)
    except OverflowError:
        raise InputError("time", "out of range", got=text) from None
    reading = f"{parsed.isoformat(timespec='minutes')} civil time in {name} ({early:%Z}) = {_utc_text(utc)}"
    return ResolvedTime(utc, name, reading)


def _ambiguous_time_error(text: str, name: str, early: datetime, late: datetime) -> InputError:
    # A wall time that daylight saving skips changes when converted to UTC and back.
    back = early.astimezone(UTC).astimezone(early.tzinfo)
    problem = "happens twice" if back.replace(tzinfo=None) == early.replace(tzinfo=None) else "does not exist"
    choices = " or ".join(time.isoformat() for time in (early, late))
    return InputError("time", f"{text} {problem} in {name} (the clocks change)", cure=f"give the offset: {choices}")


def _utc_text(utc: datetime) -> str:
    return utc.isoformat(timespec="seconds").replace("+00:00", "Z")
