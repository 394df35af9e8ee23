"""Exceptions of the package. This module imports nothing heavy, so that the command line starts quickly.

Every exception here describes a mistake in the user's input that the program recognises. The command line prints its
message as one line and exits with code 2, as it does for the system's own errors of files and memory (`OSError`,
`MemoryError`). Any other exception is a fault of the program.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

MOST_SHOWN_CHARACTERS = 300


def shortened(text: str) -> str:
    """A text of any length as a message can show it: the middle of a long one is left out."""
    if len(text) <= MOST_SHOWN_CHARACTERS:
        return text
    half = MOST_SHOWN_CHARACTERS // 2
    return f"{text[:half]} … {text[-half:]} ({len(text)} characters)"


class SeasonscapesError(Exception):
    """Base class of all exceptions that report a problem with the user's input."""


class InputError(SeasonscapesError):
    """A file, key or argument is wrong. The message is one line: where, what was got, what was expected, the cure.

    Parameters
    ----------
    where
        File, file and key, or argument.
    problem
        What is wrong.
    got, expected, cure
        The value found, the value expected, and how to correct it.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> try:
    ...     ss.load_place("nowhere.toml")
    ... except ss.InputError as error:
    ...     print(error.problem)
    no such file
    """

    def __init__(
        self, where: str | Path, problem: str, *, got: Any = None, expected: str | None = None, cure: str | None = None
    ):
        parts = [f"{where}: {problem}"]
        if got is not None:
            parts.append(f"got {shortened(got)!r}" if isinstance(got, str) else f"got {got}")
        if expected:
            parts.append(f"expected {expected}")
        if cure:
            parts.append(cure)
        super().__init__("; ".join(" ".join(part.split()) for part in parts))
        self.where, self.problem, self.got, self.expected, self.cure = str(where), problem, got, expected, cure


class NoTerrainInView(SeasonscapesError, ValueError):
    """A camera's image shows no part of the terrain."""


class CameraBelowGround(SeasonscapesError, ValueError):
    """A camera lies below the terrain surface."""


class NoUsablePixels(SeasonscapesError, ValueError):
    """No pixel of the given photographs can be used: all are masked, clipped, too near or show no terrain."""


class NotEnoughEvidence(SeasonscapesError, ValueError):
    """The given points, skyline or overlaps do not determine the unknowns."""


class UnreadableImage(SeasonscapesError, ValueError):
    """A file is not an image that can be decoded."""


class DamagedFile(SeasonscapesError, ValueError):
    """A stored file is not what was written: cut short, changed, exchanged, or of another version."""


class ImageSizeMismatch(SeasonscapesError, ValueError):
    """An image has another size than the view that it is used with."""


class InvalidPath(SeasonscapesError, ValueError):
    """Waypoints do not define a camera path."""


class FrameMismatch(SeasonscapesError, ValueError):
    """A camera, light or terrain belongs to another local frame than the one it is used with, or states none."""


class AtlasMismatch(SeasonscapesError, ValueError):
    """A texture belongs to another UV atlas than the terrain it is used with."""
