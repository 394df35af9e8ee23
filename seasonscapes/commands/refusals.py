"""Flags that would do nothing, and trouble with files and memory, told in one line each."""

from __future__ import annotations

import errno
import os
from dataclasses import fields
from typing import Any

from seasonscapes.errors import InputError

_CURES = {
    errno.ENOSPC: "free some space, or choose another place",
    errno.EDQUOT: "free some space, or choose another place",
    errno.EFBIG: "free some space, or choose another place",
    errno.EROFS: "choose a place that can be written",
    errno.EACCES: "change its permissions, or choose another place",
    errno.EPERM: "change its permissions, or choose another place",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.ENOTDIR: "a part of this path is a file; choose another place",
    errno.EISDIR: "this is a folder; name a file",
    errno.EEXIST: "a file lies where a folder is needed; choose another place",
    errno.EMFILE: "raise the limit of open files (ulimit -n)",
}


def told(error: OSError | MemoryError) -> str:
    """One line about an error of the operating system.

    Examples
    --------
    >>> from seasonscapes.commands.refusals import told
    >>> told(IsADirectoryError(21, "Is a directory", "out/a.png"))
    'out/a.png: is a directory; this is a folder; name a file'
    """
    if isinstance(error, MemoryError):
        what = f" ({error})" if str(error) else ""
        return f"memory: not enough of it{what}; choose a smaller --size, a coarser --texel-m or a smaller raster"
    # Of a renaming, the second name is the one that the user chose.
    name = error.filename2 or error.filename
    where = f"{os.fsdecode(name)}: " if isinstance(name, (str, bytes, os.PathLike)) else ""
    said = error.strerror or str(error) or type(error).__name__
    said = said if not where else said[:1].lower() + said[1:]
    cure = _CURES.get(error.errno or 0)
    return f"{where}{said}" + (f"; {cure}" if cure else "")


def refuse_without(condition: str, holds: bool, **given: object) -> None:
    """`InputError` about the first flag that was given although it does nothing without a condition.

    Examples
    --------
    >>> from seasonscapes.commands.refusals import refuse_without
    >>> refuse_without("--method diffusion", False, prompt=None, film=None)
    """
    for name, value in given.items():
        if not holds and value is not None and value is not False:
            raise InputError(f"--{name.replace('_', '-')}", f"does nothing without {condition}", got=str(value))


def refuse_given(condition: str, given: Any, untouched: Any) -> None:
    """`InputError` about the first field of a dataclass of flags that differs from its default and does nothing."""
    for field in fields(given):
        value = getattr(given, field.name)
        if value != getattr(untouched, field.name):
            refuse_without(condition, False, **{field.name: value})
