"""A chain of stages in one folder, in which each stage is rebuilt only where its inputs or its code changed.

The record ``run.json`` holds, for each stage, a key of its arguments, of the hashes of the files it read and of the
source code that made it, and the hashes of the files it wrote. A stage whose key and files match is kept; otherwise it
and every stage that reads its files are built again. The record is written after each stage, atomically: a run that is
killed continues with the stage that was in progress.

Files of an unfinished stage are kept in its own folder for it to continue from, but only where it would be built from
the same inputs (a file in the folder states them); otherwise the folder is emptied first, so that no file made from
other inputs is reused.
"""

from __future__ import annotations

import json
import logging
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from seasonscapes import __version__
from seasonscapes.errors import InputError
from seasonscapes.images import atomic_path
from seasonscapes.workspace import artefact_key, file_hash

log = logging.getLogger(__name__)

_RECORD, _MARK = "run.json", ".made-from.json"


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
        For unknown stages, stages before ``first`` that are not up to date, and folders that no run has made.
    """
    start, end = stage_range(stages, first, last)
    path = folder / _RECORD
    record: dict = json.loads(path.read_text()) if path.is_file() else {}
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
        clock = time.perf_counter()
        _begin(folder, stage, key, record)
        log.info("run: %s: …", stage.name)
        files = stage.build(folder)
        record[stage.name] = {
            "key": key,
            "inputs": stage.inputs,
            "version": __version__,
            "seconds": round(time.perf_counter() - clock, 2),
            "files": {str(file.relative_to(folder)): file_hash(file) for file in files},
        }
        _write(folder, record)
        log.info("run: %s: built in %s s", stage.name, record[stage.name]["seconds"])
    return record


def _write(folder: Path, record: dict) -> None:
    with atomic_path(folder / _RECORD) as temporary:
        temporary.write_text(json.dumps(record, indent=1, default=str) + "\n")


def _begin(folder: Path, stage: Stage, key: str, record: dict) -> None:
    """Prepare a stage's folder: continue with the files of an interrupted build, or start with an empty folder.

    The steps are ordered so that a process killed between any two of them never leaves old files that count as new ones.
    `InputError` where the folder holds files that no run has made.
    """
    finished = stage.name in record
    if stage.own is not None:
        own, mark, aside = folder / stage.own, folder / stage.own / _MARK, folder / f".{stage.own}.old"
        shutil.rmtree(aside, ignore_errors=True)
        # Remove partial files of interrupted processes.
        for part in (*folder.glob(".*.part*"), *own.rglob(".*.part*")):
            part.unlink()
        left = json.loads(mark.read_text()) if mark.is_file() else None
        if left is None and not finished and own.is_dir() and any(own.iterdir()):
            raise InputError(
                "--output",
                f"holds a folder '{stage.own}' that no run has made",
                got=str(folder),
                cure="choose another folder",
            )
        if finished or left != {"stage": stage.name, "key": key}:
            if own.is_dir():
                own.replace(aside)
                shutil.rmtree(aside)
            with atomic_path(mark) as temporary:
                temporary.write_text(json.dumps({"stage": stage.name, "key": key}) + "\n")
    if finished:
        del record[stage.name]
        _write(folder, record)


def _fresh(folder: Path, entry: dict | None, key: str) -> bool:
    if entry is None or entry["key"] != key:
        return False
    return all(
        (folder / name).is_file() and file_hash(folder / name) == digest for name, digest in entry["files"].items()
    )
