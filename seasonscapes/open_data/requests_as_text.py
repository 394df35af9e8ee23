"""Extents and intervals as people write them."""

from __future__ import annotations

import re
from calendar import monthrange
from datetime import date

from seasonscapes.errors import InputError


def parse_extent(text: str, *, flag: str = "--size") -> tuple[float, float]:
    """``20km``, ``800m`` or ``30x20km`` as west-east and south-north extent [m]."""
    match = re.fullmatch(r"([\d.]+)(?:\s*[x×]\s*([\d.]+))?\s*(km|m)", text.strip())
    try:
        sides = [float(side) for side in (match[1], match[2] or match[1])] if match else []
    except ValueError:
        sides = []
    if not match or not sides:
        raise InputError(flag, "not an extent", got=text, expected="such as 20km, 800m or 30x20km")
    unit = 1000.0 if match[3] == "km" else 1.0
    return sides[0] * unit, sides[1] * unit


def parse_interval(text: str, *, flag: str = "--date") -> str:
    """``2024-07..2024-09``, ``2024-07``, ``2024-07-14`` or ``2024`` as an ISO 8601 interval of whole days in UTC."""

    def days(part: str) -> tuple[date, date]:
        numbers = re.fullmatch(r"(\d{4})(?:-(\d{2}))?(?:-(\d{2}))?", part.strip())
        if not numbers:
            raise ValueError
        year, month, day = (None if number is None else int(number) for number in numbers.groups())
        assert year is not None
        last_month = month or 12
        return date(year, month or 1, day or 1), date(year, last_month, day or monthrange(year, last_month)[1])

    first, _, last = text.partition("..")
    try:
        start, end = days(first)[0], days(last or first)[1]
    except ValueError:
        expected = "2024-07..2024-09, 2024-07, 2024-07-14 or 2024"
        raise InputError(flag, "not a time", got=text, expected=expected) from None
    if start > end:
        raise InputError(flag, "ends before it begins", got=text)
    return f"{start}T00:00:00Z/{end}T23:59:59Z"
