"""Progress reports: how long computations tell a caller where they stand.

A workflow takes a `Progress`: a callable ``progress(task, fraction)`` with the name of the present task and the share of
it that is done, 0 to 1. Functions of single stages take a plain ``progress(fraction)``; `task_progress` makes one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

Progress = Callable[[str, float], None]
TaskProgress = Callable[[float], None]
Item = TypeVar("Item")


def no_progress(task: str, fraction: float) -> None:
    """A `Progress` that reports nothing."""


def task_progress(progress: Progress | None, task: str, *, start: float = 0.0, end: float = 1.0) -> TaskProgress:
    """A callable ``report(fraction)`` for one task, or for the part of it from ``start`` to ``end``.

    Examples
    --------
    >>> from seasonscapes.progress import task_progress
    >>> report = task_progress(lambda task, fraction: print(task, fraction), "frames", start=0.5)
    >>> report(0.5)
    frames 0.75
    """

    def report(fraction: float) -> None:
        if progress is not None:
            progress(task, start + (end - start) * fraction)

    return report


def each_reported(items: Iterable[Item], count: int, progress: Progress | None, task: str) -> Iterator[Item]:
    """The items, with a report after each one of ``count``."""
    report = task_progress(progress, task)
    for number, item in enumerate(items):
        yield item
        report((number + 1) / max(count, 1))
