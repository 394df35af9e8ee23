"""A chain of stages in one folder: what was made, from what, and whether it still is what it would be.

The ledger (``run.json``) holds, for each stage, a key of its arguments, the hashes of what it read and this program's
version, and the hashes of what it wrote. A stage whose key and files are as the ledger says is fresh; it and everything
that reads what it makes anew are made again. The ledger is written after each stage, atomically: a run that is killed
goes on with the stage in which it was.

What an unfinished stage left in its own folder is kept for it to go on from, but only where it would be made from the
same again (a file in it tells); otherwise the folder is emptied first, so that nothing of other inputs is taken over.
"""

from __future__ import annotations

import json
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from seasonscapes import __version__
from seasonscapes.errors import InputError
from seasonscapes.images import atomic_path
from seasonscapes.workspace import content_key, file_hash

_LEDGER, _MARK = "run.json", ".made-from.json"


@dataclass(frozen=True)
class Stage:
    """One step.

    Parameters
    ----------
    name
        What ``--from`` and ``--until`` call it.
    inputs
        Plain values that decide its result.
    needs
        Stages whose files it reads.
    build
        Makes it in the run's folder; returns the files that it wrote there.
    own
        Name of the folder in the run's folder that is this stage's alone.
    """

    name: str
    inputs: dict
    needs: tuple[str, ...]
    build: Callable[[Path], list[Path]] = field(compare=False)
    own: str | None = None


def stage_range(stages: Sequence[Stage], first: str | None, last: str | None) -> tuple[int, int]:
    """Indices of ``--from`` and ``--until``; `InputError` for names that are none, or in the wrong order."""
    names = [stage.name for stage in stages]
    for flag, name in (("--from", first), ("--until", last)):
        if name is not None and name not in names:
            raise InputError(flag, "no such stage", got=name, expected=", ".join(names))
    start, end = names.index(first) if first else 0, names.index(last) if last else len(names) - 1
    if end < start:
        raise InputError("--until", f"comes before --from {first}", got=last)
    return start, end


def run_stages(
    folder: Path,
    stages: Sequence[Stage],
    *,
    first: str | None = None,
    last: str | None = None,
    tell: Callable[[str], None] = lambda line: None,
) -> dict:
    """Make what is not fresh; the ledger as it stands then.

    Parameters
    ----------
    first
        Make this stage and all after it again, fresh or not; those before it must be fresh.
    last
        Stop after this one.
    tell
        Is given a line about each stage.
    """
    start, end = stage_range(stages, first, last)
    path = folder / _LEDGER
    ledger: dict = json.loads(path.read_text()) if path.is_file() else {}
    for index, stage in enumerate(stages[: end + 1]):
        upstream = {name: ledger[name]["files"] for name in stage.needs}
        key = content_key({"inputs": stage.inputs, "upstream": upstream, "version": __version__})
        fresh = _fresh(folder, ledger.get(stage.name), key)
        if fresh and (first is None or index < start):
            tell(f"{stage.name}: fresh")
            continue
        if first is not None and index < start:
            raise InputError(
                "--from",
                f"stage '{stage.name}' before it is not fresh",
                got=first,
                cure=f"start with --from {stage.name}, or without --from",
            )
        clock = time.perf_counter()
        _begin(folder, stage, key, ledger)
        tell(f"{stage.name}: …")
        files = stage.build(folder)
        ledger[stage.name] = {
            "key": key,
            "inputs": stage.inputs,
            "version": __version__,
            "seconds": round(time.perf_counter() - clock, 2),
            "files": {str(file.relative_to(folder)): file_hash(file) for file in files},
        }
        _write(folder, ledger)
        tell(f"{stage.name}: made in {ledger[stage.name]['seconds']} s")
    return ledger


def _write(folder: Path, ledger: dict) -> None:
    with atomic_path(folder / _LEDGER) as temporary:
        temporary.write_text(json.dumps(ledger, indent=1, default=str) + "\n")


def _begin(folder: Path, stage: Stage, key: str, ledger: dict) -> None:
    """Make room for a stage: go on with what a killed one left, or start with an empty folder.

    The order is such that a process killed between any two of these steps never lets old files pass for new ones.
    `InputError` where the folder holds what no run has made.
    """
    finished = stage.name in ledger
    if stage.own is not None:
        own, mark, aside = folder / stage.own, folder / stage.own / _MARK, folder / f".{stage.own}.old"
        shutil.rmtree(aside, ignore_errors=True)
        # What a killed process was writing is nobody's any more.
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
        del ledger[stage.name]
        _write(folder, ledger)


def _fresh(folder: Path, entry: dict | None, key: str) -> bool:
    if entry is None or entry["key"] != key:
        return False
    return all(
        (folder / name).is_file() and file_hash(folder / name) == digest for name, digest in entry["files"].items()
    )
