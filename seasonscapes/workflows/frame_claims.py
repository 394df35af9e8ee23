"""Which processes are using the frames of a film, so that none removes frames that another still needs."""

from __future__ import annotations

import json
import secrets
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from filelock import FileLock, Timeout

from seasonscapes.images import atomic_path

_CLAIMS = ".claims"


@dataclass(frozen=True)
class FrameClaim:
    """The frames that a process is rendering and developing; of `frames_claimed`.

    Parameters
    ----------
    folder
        Of the frames.
    names
        File names of the frames.
    path
        The file that states the claim; a lock beside it is held while the process lives.
    """

    folder: Path
    names: frozenset[str]
    path: Path

    def sweep(self) -> None:
        """End the claim and remove its frames, except those that a living process claims too: it removes them later."""
        with _mutex(self.folder):
            _state(self.path, ())
            others = [path for path in self.path.parent.glob("*.json") if path != self.path]
            for name in self.names - {name for path in others for name in _living_names(path)}:
                (self.folder / name).unlink(missing_ok=True)


@contextmanager
def frames_claimed(folder: Path, names: Sequence[str]) -> Iterator[FrameClaim]:
    """Context manager: nobody else's `FrameClaim.sweep` removes these frames meanwhile.

    Parameters
    ----------
    folder
        Of the frames; created.
    names
        File names of the frames that will be read or written.
    """
    claims = folder / _CLAIMS
    path = claims / f"{secrets.token_hex(8)}.json"
    lock = FileLock(path.with_suffix(".lock"))
    with _mutex(folder):
        claims.mkdir(parents=True, exist_ok=True)
        lock.acquire(timeout=0)
        _state(path, names)
    try:
        yield FrameClaim(folder, frozenset(names), path)
    finally:
        with _mutex(folder):
            lock.release()
            _forget(path)
            if not any(claims.iterdir()):
                claims.rmdir()
                if not any(folder.iterdir()):
                    folder.rmdir()


def _state(path: Path, names: Sequence[str]) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(list(names)), encoding="utf-8")


def _mutex(folder: Path) -> FileLock:
    """Held while claims are read or written; beside the folder, so that the folder can be removed under it."""
    folder.parent.mkdir(parents=True, exist_ok=True)
    return FileLock(folder.with_name(f".{folder.name}.lock"))


def _living_names(path: Path) -> list[str]:
    """The frames of another claim; none where its process is gone, whose claim is then removed."""
    lock = FileLock(path.with_suffix(".lock"))
    try:
        lock.acquire(timeout=0)
    except Timeout:
        return json.loads(path.read_text(encoding="utf-8"))
    lock.release()
    _forget(path)
    return []


def _forget(path: Path) -> None:
    path.unlink(missing_ok=True)
    path.with_suffix(".lock").unlink(missing_ok=True)
