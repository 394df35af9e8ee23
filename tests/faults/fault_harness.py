"""Runs commands in this process and judges them: no traceback, one line, whole JSON, nothing half, nothing outside.

A case runs in ``<folder>/inside``; beside it lies what a hostile file may want to reach. The folder is compared before and
after. Each judged case leaves its verdict among the test's user properties, which `conftest` sums up.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import resource
import warnings
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

from PIL import Image

from seasonscapes.cli import main
from seasonscapes.images import read_exr

TIME = "2024-09-18T10:00Z"
VERDICTS = ("traceback", "not one line", "no JSON", "half file", "escape", "silent", "refused")


@dataclass
class Outcome:
    """What a command did: exit code, output, and the files of its folder that are new, changed or gone."""

    tokens: list[str]
    code: int
    out: str
    err: str
    new: set[str] = field(default_factory=set)
    changed: set[str] = field(default_factory=set)


def call(tokens: Iterable[str]) -> Outcome:
    """Run a command in this process and catch what it prints."""
    out, err = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
    tokens = list(tokens)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # as Python does with deprecations
        for shown in (RuntimeWarning, UserWarning):
            warnings.simplefilter("always", shown)
        warnings.showwarning = lambda message, category, filename, lineno, file=None, line=None: print(
            f"{filename}:{lineno}: {category.__name__}: {message}", file=err
        )
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(tokens)
    said = [stream.buffer.getvalue().decode("utf-8", "replace") for stream in (out, err)]
    return Outcome(tokens, code, *said)


def snapshot(folder: Path) -> dict[str, tuple]:
    """Size, time and kind of everything below a folder."""
    found = {}
    for base, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(base) / name
            facts = path.lstat()
            is_folder = path.is_dir() and not path.is_symlink()
            found[str(path.relative_to(folder))] = (
                ("folder",) if is_folder else (facts.st_size, facts.st_mtime_ns, facts.st_ino)
            )
    return found


def run_in(folder: Path, tokens: Iterable[str]) -> Outcome:
    """Run a command in ``folder/inside`` and note what it did to the folder."""
    before = snapshot(folder)
    with contextlib.chdir(folder / "inside"):
        outcome = call(tokens)
    after = snapshot(folder)
    outcome.new = set(after) - set(before)
    outcome.changed = {name for name in before if after.get(name) != before[name]}
    return outcome


def complaints(outcome: Outcome) -> list[str]:
    """The lines of a refusal."""
    return [line for line in outcome.err.splitlines() if line.startswith("seasonscapes: ")]


def verdicts(outcome: Outcome, expected: str, names: str = "") -> list[str]:
    """What is wrong with an outcome: some of `VERDICTS`.

    Parameters
    ----------
    outcome
        What a command did.
    expected
        ``refuse``, ``accept`` or ``either``.
    names
        A regular expression that the refusal's line must hold.
    """
    wrong = []
    if outcome.code not in (0, 2) or "Traceback" in outcome.err:
        wrong.append("traceback")
    if (
        "Warning" in outcome.err
        or (outcome.code and len(complaints(outcome)) != 1)
        or (outcome.code and not re.search(names, complaints(outcome)[0]))
    ):
        wrong.append("not one line")
    if "--json" in outcome.tokens and not _is_one_record(outcome.out, failed=outcome.code != 0):
        wrong.append("no JSON")
    outside = [name for name in outcome.new | outcome.changed if not re.match(r"(inside|workspace)(/|$)", name)]
    if outside:
        wrong.append("escape")
    files = [name for name in outcome.new | outcome.changed if name.startswith("inside/")]
    if any(".part" in name or name.endswith(".old") for name in outcome.new) or (outcome.code and files):
        wrong.append("half file")
    if expected == "refuse" and outcome.code == 0:
        wrong.append("silent")
    if expected == "accept" and outcome.code:
        wrong.append("refused")
    return wrong


def _is_one_record(text: str, *, failed: bool) -> bool:
    def refuse(name: str) -> None:
        raise ValueError(name)

    try:
        record = json.loads(text, parse_constant=refuse)
    except ValueError:
        return False
    return isinstance(record, dict) and ("error" in record if failed else True)


def half_files(folder: Path) -> list[str]:
    """Files below a folder that cannot be read by their kind."""
    readers: dict[str, Callable] = {
        ".png": lambda path: Image.open(path).load(),
        ".exr": read_exr,
        ".json": lambda path: json.loads(path.read_text()),
    }
    broken = []
    for path in folder.rglob("*"):
        reader = readers.get(path.suffix)
        if reader is None or not path.is_file():
            continue
        try:
            reader(path)
        except Exception as error:
            broken.append(f"{path.name}: {error}")
    return broken


def judge(
    record_property: Callable, outcome: Outcome, expected: str = "refuse", names: str = "", *, cases: int = 1
) -> None:
    """Note the verdict of a case for the summary, and fail the test where it is bad."""
    wrong = verdicts(outcome, expected, names)
    record_property("fault", {"cases": cases, "wrong": wrong})
    shown = " ".join(token if len(token) < 80 else f"{token[:40]}…" for token in outcome.tokens)
    assert not wrong, (
        f"{', '.join(wrong)}: seasonscapes {shown}\n{outcome.code}\n{outcome.out[-600:]}\n{outcome.err[-1500:]}"
    )


def with_flag(tokens: list[str], flag: str, value: str | None) -> list[str]:
    """The tokens with another value of a flag; without it for ``None``."""
    kept, skip = [], False
    for token in tokens:
        if skip:
            skip = False
        elif token == flag:
            skip = True
        else:
            kept.append(token)
    return kept if value is None else [*kept, f"{flag}={value}"]


@contextlib.contextmanager
def disk_with(byte_count):
    """No file may grow beyond a size, as on a full disk; programs that are started have the same limit."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (byte_count, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
