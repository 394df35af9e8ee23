"""What a time on the command line means: ISO 8601, with civil time at the place where no offset is given."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime, timezone
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from seasonscapes.declaration import InputError


@dataclass(frozen=True)
class ResolvedTime:
    """A time as it was understood.

    Parameters
    ----------
    utc
        Aware UTC datetime.
    zone
        IANA name of the zone the text was read in, or ``None`` where it gave its own offset.
    reading
        One line for people: what the text was taken to mean.
    """

    utc: datetime
    zone: str | None
    reading: str


def zone_at(latitude_deg: float, longitude_deg: float) -> str:
    """IANA name of the civil time zone at a place; ``Etc/GMT±h`` at sea.

    Raises
    ------
    InputError
        Where no zone is known.
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


def resolve_time(text: str, latitude_deg: float, longitude_deg: float) -> ResolvedTime:
    """Read an ISO 8601 date and time; one without offset is civil time at the place.

    Raises
    ------
    InputError
        For text that is no date and time, and for a time that daylight saving skips or repeats: a guess would put the
        sun 15° off.
    """
    text = text.strip()
    try:
        parsed = datetime.fromisoformat(text)
        dated_only = not any(separator in text[1:] for separator in ("T", "t", " "))
        if dated_only:
            raise InputError(
                "time", "the hour is missing", got=text, expected="a date and time", cure=f"write {text}T12:00"
            )
        if parsed.utcoffset() is not None:
            utc = parsed.astimezone(UTC)
            return ResolvedTime(utc, None, f"{text} = {_utc_text(utc)}")
        name = zone_at(latitude_deg, longitude_deg)
        early, late = (parsed.replace(tzinfo=ZoneInfo(name), fold=fold) for fold in (0, 1))
        if early.utcoffset() != late.utcoffset():
            _refuse_ambiguous(text, name, early, late)
        utc = early.astimezone(UTC)
    except OverflowError:
        raise InputError("time", "out of range", got=text) from None
    except ValueError:
        raise InputError(
            "time",
            "not an ISO 8601 date and time",
            got=text,
            expected="e.g. 2024-09-01T12:00, 2024-09-01T12:00+02:00 or 2024-09-01T10:00Z",
        ) from None
    reading = f"{parsed.isoformat(timespec='minutes')} civil time in {name} ({early:%Z}) = {_utc_text(utc)}"
    return ResolvedTime(utc, name, reading)


def _refuse_ambiguous(text: str, name: str, early: datetime, late: datetime) -> None:
    # A skipped wall time does not survive the way to UTC and back.
    back = early.astimezone(UTC).astimezone(early.tzinfo)
    what = "happens twice" if back.replace(tzinfo=None) == early.replace(tzinfo=None) else "does not exist"
    offers = " or ".join(time.replace(tzinfo=timezone(time.utcoffset())).isoformat() for time in (early, late))
    raise InputError("time", f"{text} {what} in {name} (the clocks change)", cure=f"give the offset: {offers}")


def _utc_text(utc: datetime) -> str:
    return utc.isoformat(timespec="seconds").replace("+00:00", "Z")
