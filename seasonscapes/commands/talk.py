"""How verbs talk to people and to programs: one record on stdout, everything else on stderr."""

from __future__ import annotations

import json
import re
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from seasonscapes.errors import InputError


def say(line: str) -> None:
    """A line for people, on stderr."""
    print(line, file=sys.stderr, flush=True)


def finish(record: dict[str, Any], lines: list[str], *, as_json: bool) -> None:
    """The verb's result on stdout: one JSON record, or lines for people."""
    print(json.dumps(record, default=float) if as_json else "\n".join(lines), flush=True)


@contextmanager
def progress_bar(title: str) -> Iterator[Callable[[float], None]]:
    """A progress bar with the time left on stderr; silent where stderr is no terminal."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bar:
        task = bar.add_task(title, total=1.0)

        def update(share: float) -> None:
            if _interrupted.is_set():
                raise KeyboardInterrupt
            bar.update(task, completed=share)

        yield update


# Native code may swallow a KeyboardInterrupt that is raised while it calls back into Python; this remembers it.
_interrupted = threading.Event()


@contextmanager
def interruptible() -> Iterator[None]:
    """Ctrl-C ends what is done in this block: at once, or where the exception got lost, when progress is next told."""
    _interrupted.clear()
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: Any) -> None:
        _interrupted.set()
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def check_range(flag: str, value: float, low: float, high: float) -> None:
    """`InputError` about a flag whose value is not within [low, high]."""
    if not low <= value <= high:
        raise InputError(flag, "out of range", got=value, expected=f"{low:g} to {high:g}")


def check_suffix(output: Path, suffixes: tuple[str, ...]) -> None:
    """`InputError` about ``--output`` where its name does not end in one of the suffixes."""
    if output.suffix.lower() not in suffixes:
        raise InputError(
            "--output", "unknown kind of file", got=str(output), expected="a name that ends in " + " or ".join(suffixes)
        )


def parse_size(text: str) -> tuple[int, int]:
    """``1536x1024`` as width and height [px]."""
    match = re.fullmatch(r"(\d{1,5})[x×](\d{1,5})", text.strip())
    if not match or not (1 <= int(match[1]) <= 32768 and 1 <= int(match[2]) <= 32768):
        raise InputError("--size", "not a picture size", got=text, expected="WIDTHxHEIGHT in pixels, such as 1536x1024")
    return int(match[1]), int(match[2])


def parse_at(text: str) -> tuple[float, float, float | None, float | None]:
    """``LAT,LON``, ``LAT,LON,HEIGHT`` or ``LAT,LON,+ABOVE``: latitude, longitude, height [m], above ground [m].

    Without a third number the camera stands 2 m above the ground.
    """
    expected = "LAT,LON or LAT,LON,HEIGHT or LAT,LON,+ABOVE_GROUND, such as 46.57,7.96,+50"
    parts = [part.strip() for part in text.split(",")]
    try:
        numbers = [float(part) for part in parts]
    except ValueError:
        numbers = []
    if len(numbers) not in (2, 3):
        raise InputError("--at", "not a place", got=text, expected=expected)
    if not (-90.0 <= numbers[0] <= 90.0 and -180.0 <= numbers[1] <= 180.0):
        raise InputError(
            "--at",
            "latitude or longitude out of range",
            got=text,
            expected=expected,
            cure="is the order latitude, longitude, in degrees?",
        )
    if len(numbers) == 2:
        return numbers[0], numbers[1], None, 2.0
    if parts[2].startswith("+"):
        if numbers[2] <= 0.0:
            raise InputError("--at", "the height above ground must be positive", got=text)
        return numbers[0], numbers[1], None, numbers[2]
    return numbers[0], numbers[1], numbers[2], None
