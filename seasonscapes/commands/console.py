"""Console output: one result on stdout, progress bars and log messages on stderr."""

from __future__ import annotations

import logging
import os
import sys
import time as clock
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TextIO

from seasonscapes.commands.interruption import raise_if_interrupted
from seasonscapes.progress import Progress
from seasonscapes.text_files import json_line

# Long work tells how far it is this often where there is no terminal for a bar.
_SECONDS_BETWEEN_LINES = 10.0


class _StderrHandler(logging.Handler):
    """Prints log messages as plain lines on the present stderr, and keeps the warnings of the present command."""

    def __init__(self) -> None:
        super().__init__()
        self.warnings: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        line = self.format(record)
        if record.levelno >= logging.WARNING:
            # A film reads its image for every date; one command says a thing once.
            if line in self.warnings:
                return
            self.warnings.append(line)
        message(line)


_handler = _StderrHandler()


class ReaderGone(Exception):
    """The reader of our output went away (``| head``); that is not an error."""


def show_messages() -> None:
    """Show the package's log messages of level INFO and above on stderr, and begin a new list of warnings."""
    logger = logging.getLogger("seasonscapes")
    if _handler not in logger.handlers:
        logger.addHandler(_handler)
    logger.setLevel(logging.INFO)
    _handler.warnings.clear()


def plain_line(text: str) -> str:
    """The text as one line that a terminal shows as it is: control characters are written as escapes.

    Examples
    --------
    >>> from seasonscapes.commands.console import plain_line
    >>> plain_line("a\\x1b[31m\\nb")
    'a\\\\x1b[31m b'
    """
    line = " ".join(text.split())
    return line if line.isprintable() else "".join(c if c.isprintable() else ascii(c)[1:-1] for c in line)


def message(line: str) -> None:
    """Print a line for people on stderr."""
    _write_line(plain_line(line), sys.stderr)


def print_record(record: Any) -> None:
    """Print one JSON value on stdout; see `text_files.json_line`."""
    _write_line(json_line(record), sys.stdout)


def print_result(record: dict[str, Any], lines: list[str], *, as_json: bool) -> None:
    """Print a command's result on stdout: one JSON record with the command's warnings, or lines for people."""
    if as_json:
        print_record({**record, "warnings": list(_handler.warnings)})
    else:
        _write_line("\n".join(lines), sys.stdout)


def _write_line(line: str, stream: TextIO) -> None:
    try:
        # A file's name may hold bytes that are no text, and the terminal may know fewer characters than we print.
        encoding = stream.encoding or "utf-8"
        print(line.encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)
    except OSError as error:
        # What remains in the buffer would fail again when the process ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        if isinstance(error, BrokenPipeError):
            raise ReaderGone from None
        raise OSError(error.errno, error.strerror, stream.name) from None


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """Show a bar with the remaining time for each task on stderr; where that is no terminal, a line now and then."""
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
    with Progress(*columns, console=console, disable=not console.is_terminal, transient=True) as bars:
        tasks: dict[str, Any] = {}
        told_s = clock.monotonic()

        def report(task: str, fraction: float) -> None:
            nonlocal told_s
            raise_if_interrupted()
            if not console.is_terminal and clock.monotonic() - told_s > _SECONDS_BETWEEN_LINES:
                message(f"{task}: {fraction:.0%}")
                told_s = clock.monotonic()
            if task not in tasks:
                tasks[task] = bars.add_task(task, total=1.0)
            bars.update(tasks[task], completed=fraction)

        yield report


def found_sun_text(found: dict[str, Any]) -> str:
    """A sun that was found in an image, in words."""
    return (
        f"sun found: azimuth {found['azimuth_deg']:.1f}° ± {found['azimuth_sigma_deg']:.1f}°, elevation "
        f"{found['elevation_deg']:.1f}° ± {found['elevation_sigma_deg']:.1f}° ({found['reason']})"
    )
