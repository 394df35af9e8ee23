"""A chain of stages in one folder, in which each stage is rebuilt only where its inputs or its code changed.

The record ``run.json`` holds, for each stage, a key of its arguments, of the hashes of the files it read and of the
source code that made it, and the hashes of the files it wrote. A stage whose key and files match is kept; otherwise it
and every stage that reads its files are built again. The record is written after each stage, atomically: a run that is
killed continues with the stage that was in progress.

Files of an unfinished stage are kept in its own folder for it to continue from, but only where it would be built from
the same inputs (a file in the folder states them); otherwise they are removed first, so that no file made from
other inputs is reused. A stage's own folder lists every file that the run is about to write there, before it exists:
only these are ever removed. A run does not build in a folder that holds other files, since it might read them.

One run at a time works in a folder; the others end with an error.
"""

from __future__ import annotations

import json
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

from filelock import FileLock, Timeout

from seasonscapes import __version__
from seasonscapes.errors import InputError
from seasonscapes.images import writes_noted
from seasonscapes.workspace import artefact_key, file_hash

log = logging.getLogger(__name__)

_RECORD, _MARK, _LIST, _LOCK = "run.json", ".made-from.json", ".written.jsonl", ".seasonscapes-run.lock"
# The ledgers of a stage's own folder, and what they are written to before they are renamed.
_LEDGERS = frozenset({_MARK, _LIST, f"{_MARK}.new", f"{_LIST}.new"})


@dataclass(frozen=True)
class Stage:
    """One stage of a run.

    Parameters
    ----------
    name
        Its name for ``--from`` and ``--until``.
    inputs
        Plain values that determine its result.
    needs
        Stages whose files it reads.
    build
        Builds it in the run's folder and returns the files that it wrote there.
    own
        Name of its own folder in the run's folder.
    code
        Modules below ``seasonscapes`` whose source determines its result.
    """

    name: str
    inputs: dict
    needs: tuple[str, ...]
    build: Callable[[Path], list[Path]] = field(compare=False)
    own: str | None = None
    code: tuple[str, ...] = ()


def stage_range(stages: Sequence[Stage], first: str | None, last: str | None) -> tuple[int, int]:
    """Indices of the stages ``first`` and ``last``; `InputError` for unknown names, or names in the wrong order."""
    names = [stage.name for stage in stages]
    for flag, name in (("--from", first), ("--until", last)):
        if name is not None and name not in names:
            raise InputError(flag, "no such stage", got=name, expected=", ".join(names))
    start, end = names.index(first) if first else 0, names.index(last) if last else len(names) - 1
    if end < start:
        raise InputError("--until", f"comes before --from {first}", got=last)
    return start, end


def run_stages(folder: Path, stages: Sequence[Stage], *, first: str | None = None, last: str | None = None) -> dict:
    """Build the stages that are not up to date, and log a line about each.

    Parameters
    ----------
    folder
        Of the run.
    stages
        In order.
    first
        Build this stage and all after it again, whether up to date or not; those before it must be up to date.
    last
        Stop after this stage.

    Returns
    -------
    dict
        The record by stage: ``key``, ``inputs``, ``seconds`` and ``files``.

    Raises
    ------
    InputError
        For unknown stages, stages before ``first`` that are not up to date, files in a stage's own folder that no run
        has made, a record that is none, and a folder in which another run is at work.
    """
    start, end = stage_range(stages, first, last)
    with _alone(folder):
        record = _read_record(folder)
        own_of = {stage.name: stage.own for stage in stages}
        for index, stage in enumerate(stages[: end + 1]):
            upstream = {name: record[name]["files"] for name in stage.needs}
            key = artefact_key({"inputs": stage.inputs, "upstream": upstream}, stage.code)
            fresh = _fresh(folder, record.get(stage.name), key)
            if fresh and (first is None or index < start):
                log.info("run: %s: up to date", stage.name)
                continue
            if first is not None and index < start:
                raise InputError(
                    "--from",
                    f"stage '{stage.name}' before it is not fresh",
                    got=first,
                    cure=f"start with --from {stage.name}, or without --from",
                )
            for own in (stage.own, *(own_of.get(name) for name in stage.needs)):
                _require_no_strangers(folder, own)
            _build(folder, stage, key, record)
    return record


def _build(folder: Path, stage: Stage, key: str, record: dict) -> None:
    clock = time.perf_counter()
    _begin(folder, stage, key, record)
    log.info("run: %s: …", stage.name)
    with _listed(folder, stage.own) as note:
        files = stage.build(folder)
        for file in files:
            note(file)
    record[stage.name] = {
        "key": key,
        "inputs": stage.inputs,
        "version": __version__,
        "seconds": round(time.perf_counter() - clock, 2),
        "files": {str(file.relative_to(folder)): file_hash(file) for file in files},
    }
    _write(folder, record)
    log.info("run: %s: built in %s s", stage.name, record[stage.name]["seconds"])


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Context manager: no other process runs stages in the folder meanwhile; `InputError` where one does already."""
    if folder.exists() and not folder.is_dir():
        raise InputError("--output", "this is a file", got=str(folder), expected="a folder")
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / _LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        cure = "wait for its end, or choose another folder"
        raise InputError("--output", "another run is at work in this folder", got=str(folder), cure=cure) from None
    try:
        yield
    finally:
        lock.release()


def _read_record(folder: Path) -> dict:
    """The record of a folder, empty where there is none; `InputError` for a file that is no record."""
    path = folder / _RECORD
    try:
        record = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return {}
    except (ValueError, RecursionError, IsADirectoryError):
        record = None
    if not isinstance(record, dict) or not all(_is_entry(entry) for entry in record.values()):
        raise InputError(
            path,
            "not the record of a run",
            cure="choose another folder, or remove this file: what is whole is then built again",
        )
    return record


def _is_entry(entry: Any) -> bool:
    if not isinstance(entry, dict) or not isinstance(entry.get("key"), str) or not isinstance(entry.get("files"), dict):
        return False
    seconds = entry.get("seconds")
    return isinstance(seconds, (int, float)) and all(isinstance(digest, str) for digest in entry["files"].values())


def _write(folder: Path, record: dict) -> None:
    _put(folder / _RECORD, json.dumps(record, indent=1, default=str) + "\n")


def _put(path: Path, text: str) -> None:
    """Write a ledger atomically, by way of a name that belongs to it: an interrupted write leaves no unknown file."""
    new = path.with_name(("" if path.name.startswith(".") else ".") + f"{path.name}.new")
    new.write_text(text, encoding="utf-8")
    os.replace(new, path)


def _begin(folder: Path, stage: Stage, key: str, record: dict) -> None:
    """Prepare a stage's folder: continue with the files of an interrupted build, or remove what the run wrote there.

    The steps are ordered so that a process killed between any two of them never leaves old files that count as new ones.
    """
    finished = stage.name in record
    if stage.own is not None:
        own = folder / stage.own
        mark, wanted = own / _MARK, {"stage": stage.name, "key": key}
        own.mkdir(exist_ok=True)
        if finished or _read_mark(mark) != wanted:
            # Without a key nothing in the folder counts, whatever happens next.
            _put(mark, json.dumps({"stage": stage.name, "key": None}) + "\n")
            _remove(own, _written(own))
            _put(own / _LIST, "")
            if finished:
                del record[stage.name]
                _write(folder, record)
            _put(mark, json.dumps(wanted) + "\n")
        else:
            # What the killed process had not finished writing.
            _remove(own, [name for name in _written(own) if PurePath(name).match(".*.part*")])
    elif finished:
        del record[stage.name]
        _write(folder, record)


def _read_mark(mark: Path) -> Any:
    try:
        return json.loads(mark.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return None


def _written(own: Path) -> list[str]:
    """What the run has begun to write in a stage's own folder: relative paths; lines that lead elsewhere do not count."""
    try:
        lines = (own / _LIST).read_text(encoding="utf-8", errors="replace").splitlines()
    except FileNotFoundError:
        return []
    names, root = [], own.resolve()
    for line in lines:
        try:
            name = json.loads(line)
        except (ValueError, RecursionError):
            # The last line of a process that was killed while it wrote it: its file does not exist yet.
            continue
        if isinstance(name, str) and "\0" not in name and (own / name).parent.resolve().is_relative_to(root):
            names.append(name)
    return names


def _remove(own: Path, names: Sequence[str]) -> None:
    """Remove files that the run wrote, and the folders that become empty by it."""
    for name in names:
        path = own / name
        if path.is_symlink() or path.is_file():
            path.unlink()
        for parent in path.parents:
            if parent == own or not parent.is_relative_to(own) or not parent.is_dir() or any(parent.iterdir()):
                break
            parent.rmdir()


@contextmanager
def _listed(folder: Path, own_name: str | None) -> Iterator[Callable[[Path], None]]:
    """Context manager: every file written into a stage's own folder is listed there before it exists.

    Yields the function that lists a file, for those that were not written by `images.atomic_path`.
    """
    if own_name is None:
        yield lambda path: None
        return
    own = (folder / own_name).absolute()
    known = set(_written(own))
    with open(own / _LIST, "a", encoding="utf-8") as file:
        # A process killed within a line left no end of it.
        file.write("\n")

        def note(path: Path) -> None:
            path = path.absolute()
            if path.is_relative_to(own) and (name := str(path.relative_to(own))) not in known:
                known.add(name)
                file.write(json.dumps(name) + "\n")
                file.flush()

        with writes_noted(note):
            yield note


def _require_no_strangers(folder: Path, own_name: str | None) -> None:
    """`InputError` where a stage's own folder holds files that the run has not written."""
    if own_name is None:
        return
    own = folder / own_name
    if own.exists() and not own.is_dir():
        raise InputError("--output", f"a file is named as the run's folder '{own_name}'", got=str(folder))
    known = set(_written(own)) | _LEDGERS
    for path in sorted(own.rglob("*")) if own.is_dir() else ():
        name = str(path.relative_to(own))
        if name not in known and (path.is_symlink() or not path.is_dir()):
            raise InputError(
                "--output",
                f"'{own_name}/{name}' is a file that no run has made",
                got=str(folder),
                cure="move it elsewhere, or choose another folder",
            )


def _fresh(folder: Path, entry: dict | None, key: str) -> bool:
    if entry is None or entry["key"] != key:
        return False
    return all(
        (folder / name).is_file() and file_hash(folder / name) == digest for name, digest in entry["files"].items()
    )
