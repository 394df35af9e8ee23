"""The one error that is the user's: a wrong file or flag. It imports nothing, so that the front door opens quickly."""

from __future__ import annotations

from pathlib import Path
from typing import Any


class InputError(Exception):
    """The user's file or flag is wrong. One line: where, what was got, what was expected, and the likely cure.

    Parameters
    ----------
    where
        File, file and key, or flag.
    problem
        What is wrong.
    got, expected, cure
        What stood there, what should have stood there, and what to do about it.
    """

    def __init__(
        self, where: str | Path, problem: str, *, got: Any = None, expected: str | None = None, cure: str | None = None
    ):
        parts = [f"{where}: {problem}"]
        if got is not None:
            parts.append(f"got {got!r}" if isinstance(got, str) else f"got {got}")
        if expected:
            parts.append(f"expected {expected}")
        if cure:
            parts.append(cure)
        super().__init__("; ".join(" ".join(part.split()) for part in parts))
        self.where, self.problem, self.got, self.expected, self.cure = str(where), problem, got, expected, cure
