"""Flags about instants that several commands share."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Annotated

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_range, parse_duration, parse_times
from seasonscapes.commands.console import message
from seasonscapes.errors import InputError

_MOST_FRAMES = 200_000


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class WhenOptions:
    """Which instants."""

    start: Annotated[str | None, Parameter(name="--from")] = None
    """First frame, ISO 8601; without an offset it is civil time at the camera."""
    to: str | None = None
    """Last frame."""
    every: str = "10min"
    """Time between frames: a number and s, min, h or d."""
    times: str | None = None
    """Instants instead: separated by commas, or a file with one in each line."""

    def instants(self, latitude_deg: float, longitude_deg: float) -> list[datetime]:
        """Aware UTC times, in order."""
        from seasonscapes.civil_time import resolve_time

        if self.times is not None:
            if self.start is not None or self.to is not None:
                raise InputError("--times", "and --from … --to name two sets of frames", cure="drop one of them")
            return parse_times("--times", self.times, latitude_deg, longitude_deg)
        if self.start is None or self.to is None:
            raise InputError("--from", "and --to are needed", cure="give both, or --times")
        first, last = (resolve_time(text, latitude_deg, longitude_deg) for text in (self.start, self.to))
        message(f"from {first.reading}")
        message(f"to {last.reading}")
        if last.utc < first.utc:
            raise InputError("--to", "lies before --from", got=self.to)
        step = parse_duration("--every", self.every)
        count = int((last.utc - first.utc) / step) + 1
        check_range("--every", count, 1, _MOST_FRAMES)
        return [first.utc + index * step for index in range(count)]

    def ends(self, latitude_deg: float, longitude_deg: float) -> list[datetime]:
        """Aware UTC times: those of --times, or --from and --to alone."""
        from seasonscapes.civil_time import resolve_time

        if self.times is not None or self.start is None or self.to is None:
            return self.instants(latitude_deg, longitude_deg)
        return [resolve_time(text, latitude_deg, longitude_deg).utc for text in (self.start, self.to)]
