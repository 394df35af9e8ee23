"""The record of a benchmark: its figures, and everything that is needed to measure them again.

A record is a JSON file ``benchmarks/results/NAME[-SIZE].json`` as written by ``--json``; ``make tables`` makes tables of
it (`tables.py`). Its keys are the figures, and ``record``: their ``command``, ``seed``, ``commit`` (with ``+changes`` where
the tree differed from it), ``date`` (UTC), ``machine`` and ``versions``.
"""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
_PACKAGES = ("seasonscapes", "mitsuba", "drjit", "numpy", "scipy", "scikit-learn", "opencv-python-headless", "torch")


def write_record(path: Path | None, figures: dict[str, Any], *, seed: int | None) -> None:
    """Write the figures of the running benchmark with their circumstances; nothing without a path.

    Parameters
    ----------
    path
        File to write, the argument of ``--json``.
    figures
        Name to number; the unit is the end of the name.
    seed
        Seed of everything that was drawn; ``None`` where nothing is.
    """
    if path is None:
        return
    # Each run of a command is told by its seed, whether it was given or drawn; where folders lie is the machine's own.
    arguments = _without_options(
        sys.argv[1:], ("--json", "--seed", "--data", "--sheets", "--plot", "--workspace", "--bpy-python")
    )
    command = ["python", f"benchmarks/{Path(sys.argv[0]).name}", *arguments]
    if seed is not None:
        command += ["--seed", str(seed)]
    circumstances = {
        "command": shlex.join(command),
        "seed": seed,
        "commit": _commit(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "machine": _machine(),
        "versions": {"python": platform.python_version()} | _versions(),
    }
    record = {key: _plain(value) for key, value in figures.items() if key != "seed"}
    record["record"] = circumstances
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f"{path.name}.part")
    temporary.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    temporary.replace(path)


def read_record(path: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the figures of a record, and their circumstances."""
    figures = json.loads(path.read_text(encoding="utf-8"))
    circumstances = figures.pop("record")
    return figures, circumstances


def _plain(value: Any) -> Any:
    """The value as JSON holds it: numpy's numbers as numbers, sequences as lists; ``None`` is not measured."""
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return value if value is None or isinstance(value, int | str) else float(value)


def _without_options(arguments: list[str], options: tuple[str, ...]) -> list[str]:
    kept, skip = [], False
    for argument in arguments:
        if skip:
            skip = False
        elif argument in options:
            skip = True
        elif not argument.startswith(tuple(f"{option}=" for option in options)):
            kept.append(argument)
    return kept


def _commit() -> str | None:
    def git(*arguments: str) -> str:
        done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
        return done.stdout.strip()

    try:
        # Records themselves do not change what is measured.
        changed = git("status", "--porcelain", "--untracked-files=no", "--", "seasonscapes", "benchmarks", "tests")
        return git("rev-parse", "--short=12", "HEAD") + ("+changes" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return None  # not a checkout


def _machine() -> dict[str, Any]:
    """Processor, cores, memory, system, and the load when the benchmark ended."""
    processor = platform.processor()
    memory_gb = None
    if Path("/proc/cpuinfo").is_file():
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        processor = next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), processor)
        memory_gb = round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 1e9, 1)
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    record = {"processor": processor, "cores": cores, "memory_gb": memory_gb, "system": platform.platform(terse=True)}
    if hasattr(os, "getloadavg"):
        record["load_5min"] = round(os.getloadavg()[1], 1)
    if "seasonscapes.rendering.backend" in sys.modules:
        from seasonscapes.rendering.backend import use_backend

        record["variant"] = use_backend().variant
    return record


def _versions() -> dict[str, str]:
    versions = {}
    for package in _PACKAGES:
        try:
            versions[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions
