"""Interruption by Ctrl-C, also where native code swallows the exception."""

from __future__ import annotations

import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

# Native code may swallow a KeyboardInterrupt that is raised while it calls back into Python; this event keeps it.
_interrupted = threading.Event()


def raise_if_interrupted() -> None:
    """Raise `KeyboardInterrupt` after Ctrl-C."""
    if _interrupted.is_set():
        raise KeyboardInterrupt


@contextmanager
def interruptible() -> Iterator[None]:
    """End the block on Ctrl-C: at once, or at the next progress report where native code swallowed the exception."""
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
