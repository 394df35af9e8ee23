"""Interruption by Ctrl-C, also where native code swallows the exception, and never in a half-done import."""

from __future__ import annotations

import _thread
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

# Native code may swallow a KeyboardInterrupt that is raised while it calls back into Python; this event keeps it.
_interrupted = threading.Event()
# A module whose import is cut short can fail in ways of its own: the interruption waits for it, and asks this often.
_SECONDS_UNTIL_ASKED_AGAIN = 0.05


def interrupted() -> bool:
    """Whether Ctrl-C was pressed since `interruptible` began; other exceptions may be its consequence."""
    return _interrupted.is_set()


def raise_if_interrupted() -> None:
    """Raise `KeyboardInterrupt` after Ctrl-C."""
    if _interrupted.is_set():
        raise KeyboardInterrupt


@contextmanager
def interruptible(*, afterwards: signal.Handlers | None = None) -> Iterator[None]:
    """End the block on Ctrl-C: at once, after the present import, or where native code swallowed the exception at the
    next progress report. The handler ``afterwards`` answers when the block is left; the one before it if omitted."""
    _interrupted.clear()
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(number: int, frame: FrameType | None) -> None:
        _interrupted.set()
        if _importing(frame):
            again = threading.Timer(_SECONDS_UNTIL_ASKED_AGAIN, _thread.interrupt_main)
            again.daemon = True
            again.start()
            return
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before if afterwards is None else afterwards)


def ignore_further_interruptions() -> None:
    """Let the present interruption be told to its end."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def _importing(frame: FrameType | None) -> bool:
    """Whether a frame runs below an import."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib."):
            return True
        frame = frame.f_back
    return False
