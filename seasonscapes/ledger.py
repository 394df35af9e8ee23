"""A chain of stages in one folder: what was made, from what, and whether it still is what it would be.

The ledger (``run.json``) holds, for each stage, a key of its arguments, the hashes of what it read and this program's
version, and the hashes of what it wrote. A stage whose key and files are as the ledger says is fresh; it and everything
after the first one that is not are made again. The ledger is written after each stage, atomically: a run that is killed
goes on with the stage in which it was.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from seasonscapes import __version__
from seasonscapes.errors import InputError
from seasonscapes.images import atomic_path
from seasonscapes.workspace import content_key, file_hash


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
    """

    name: str
    inputs: dict
    needs: tuple[str, ...]
    build: Callable[[Path], list[Path]] = field(compare=False)


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


def run_stages(folder: Path, stages: Sequence[Stage], *, first: str | None = None, last: str | None = None,
               tell: Callable[[str], None] = lambda line: None) -> dict:  # fmt: skip
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
    path = folder / "run.json"
    ledger: dict = json.loads(path.read_text()) if path.is_file() else {}
    for index, stage in enumerate(stages[: end + 1]):
        upstream = {name: ledger[name]["files"] for name in stage.needs}
        key = content_key({"inputs": stage.inputs, "upstream": upstream, "version": __version__})
        fresh = _fresh(folder, ledger.get(stage.name), key)
        if fresh and (first is None or index < start):
            tell(f"{stage.name}: fresh")
            continue
        if first is not None and index < start:
            raise InputError("--from", f"stage '{stage.name}' before it is not fresh", got=first,
                             cure=f"start with --from {stage.name}, or without --from")  # fmt: skip
        clock = time.perf_counter()
        tell(f"{stage.name}: …")
        files = stage.build(folder)
        ledger[stage.name] = {
            "key": key,
            "inputs": stage.inputs,
            "version": __version__,
            "seconds": round(time.perf_counter() - clock, 2),
            "files": {str(file.relative_to(folder)): file_hash(file) for file in files},
        }
        with atomic_path(path) as temporary:
            temporary.write_text(json.dumps(ledger, indent=1, default=str) + "\n")
        tell(f"{stage.name}: made in {ledger[stage.name]['seconds']} s")
    return ledger


def _fresh(folder: Path, entry: dict | None, key: str) -> bool:
    if entry is None or entry["key"] != key:
        return False
    return all(
        (folder / name).is_file() and file_hash(folder / name) == digest for name, digest in entry["files"].items()
    )
