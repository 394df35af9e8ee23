"""Reading of text and JSON files that others may have written: bounded, and with one-line error messages."""

from __future__ import annotations

import json
import math
import os
import stat
from pathlib import Path
from typing import Any

from seasonscapes.errors import InputError

MOST_BYTES = 64 * 2**20
# What a value of another kind or shape than expected raises where it is taken apart: the file's mistake, not a fault.
MALFORMED = (KeyError, IndexError, TypeError, ValueError, AttributeError, OverflowError)


def read_bounded(path: str | os.PathLike, *, where: str | Path | None = None, most_bytes: int = MOST_BYTES) -> bytes:
    """Read a whole file of bounded size; never waits for a pipe and never reads a device.

    Parameters
    ----------
    path
        File.
    where
        What an error message begins with; the path if omitted.
    most_bytes
        Largest size.

    Raises
    ------
    InputError
        If there is no such file, if it is a folder, a pipe or a device, or if it is too large.
    OSError
        If the system does not let it be read.
    """
    got = None if where is None else os.fspath(path)
    place = _place(path, where)
    try:
        # A pipe would wait for its writer; it is opened without waiting and refused.
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0))
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(place, "no such file", got=got) from None
    except ValueError:
        raise InputError(place, "not a name of a file", got=os.fspath(path)) from None
    if stat.S_ISDIR(os.fstat(handle).st_mode):
        os.close(handle)
        raise InputError(place, "this is a folder", got=got, expected="a file")
    with open(handle, "rb") as file:
        facts = os.fstat(handle)
        if not stat.S_ISREG(facts.st_mode):
            raise InputError(place, "this is a pipe or a device", got=got, expected="a file")
        content = file.read(most_bytes + 1)
    if len(content) > most_bytes:
        raise InputError(place, "too large", got=got, expected=f"at most {most_bytes / 2**20:g} MB of text")
    return content


def read_text(path: str | os.PathLike, *, where: str | Path | None = None, most_bytes: int = MOST_BYTES) -> str:
    """Read a whole UTF-8 text file; a byte order mark is left out, line ends become ``\\n``.

    Raises
    ------
    InputError
        As `read_bounded`, and if the file is not UTF-8.
    """
    content = read_bounded(path, where=where, most_bytes=most_bytes)
    try:
        text = content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(_place(path, where), f"not UTF-8 text (byte {error.start})") from None
    return text.replace("\r\n", "\n").replace("\r", "\n")


def parse_json(text: str | bytes, *, where: str | Path) -> Any:
    """Parse one JSON value; unlike `json.loads` without NaN, infinity, endless nesting and endless numbers.

    Raises
    ------
    InputError
        If the text is not such a value.
    """

    def refuse(name: str) -> None:
        raise ValueError(f"{name} is no number of JSON")

    try:
        return json.loads(text, parse_constant=refuse)
    except RecursionError:
        raise InputError(where, "not readable as JSON: nested too deeply") from None
    except ValueError as error:  # JSONDecodeError and UnicodeDecodeError among them, and integers of too many digits
        raise InputError(where, f"not readable as JSON: {error}") from None


def read_json(path: str | os.PathLike, *, where: str | Path | None = None) -> Any:
    """Read a JSON file.

    Raises
    ------
    InputError
        As `read_text` and `parse_json`.
    """
    return parse_json(read_text(path, where=where), where=_place(path, where))


def json_line(value: Any) -> str:
    """A value as one line of JSON; numbers that JSON cannot hold (NaN, infinity) are ``null``, numpy's become floats.

    Examples
    --------
    >>> from seasonscapes.text_files import json_line
    >>> json_line({"rms_px": float("nan")})
    '{"rms_px": null}'
    """
    return json.dumps(_finite(value), allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    if value is None or isinstance(value, (str, bool, int)):
        return value
    number = float(value)
    return number if math.isfinite(number) else None


def _place(path: str | os.PathLike, where: str | Path | None) -> str:
    """What an error message begins with."""
    return os.fspath(path) if where is None else str(where)
