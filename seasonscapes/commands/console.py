"""Console output: one result on stdout, progress bars and log messages on stderr."""

from __future__ import annotations

import json
import logging
import sys
import time as clock
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from seasonscapes.commands.interruption import raise_if_interrupted
from seasonscapes.progress import Progress

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
        print(line, file=sys.stderr, flush=True)


_handler = _StderrHandler()


def show_messages() -> None:
    """Show the package's log messages of level INFO and above on stderr, and begin a new list of warnings."""
    logger = logging.getLogger("seasonscapes")
    if _handler not in logger.handlers:
        logger.addHandler(_handler)
    logger.setLevel(logging.INFO)
    _handler.warnings.clear()


def message(line: str) -> None:
    """Print a line for people on stderr."""
    print(line, file=sys.stderr, flush=True)


def print_result(record: dict[str, Any], lines: list[str], *, as_json: bool) -> None:
    """Print a command's result on stdout: one JSON record with the command's warnings, or lines for people."""
    record = {**record, "warnings": list(_handler.warnings)}
    print(json.dumps(record, default=float) if as_json else "\n".join(lines), flush=True)


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
