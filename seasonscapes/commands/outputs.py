"""Outputs on the command line, checked before long work begins."""

from __future__ import annotations

import errno
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from seasonscapes.errors import InputError, shortened

# Of one part of a path, on all common file systems.
_MOST_NAME_BYTES = 255
# A folder of such a name was meant to be a file.
_FILE_SUFFIXES = (".json", ".csv", ".toml", ".npz", ".png", ".jpg", ".jpeg", ".exr", ".mp4", ".tif")


def check_output(output: Path, suffixes: tuple[str, ...], *, flag: str = "--output") -> None:
    """`InputError` about a file whose name does not end in one of the suffixes, or that cannot be written; asked before
    long work begins."""
    if output.suffix.lower() not in suffixes:
        expected = "a name that ends in " + " or ".join(suffixes)
        raise InputError(flag, "unknown kind of file", got=str(output), expected=expected)
    with _writable_below(output.parent, output, flag):
        if output.is_dir():
            raise InputError(flag, "this is a folder", got=str(output), expected="the name of a file")


def check_output_folder(folder: Path, *, flag: str = "--output") -> None:
    """`InputError` about a folder that cannot be made or written to, or has the name of a file; asked before long work
    begins."""
    if folder.suffix.lower() in _FILE_SUFFIXES and not folder.is_dir():
        cure = f"give the folder alone: {folder.parent}"
        raise InputError(flag, "several files are written, into a folder", got=str(folder), cure=cure)
    with _writable_below(folder, folder, flag):
        pass


def check_file_or_folder(output: Path, *, flag: str = "--output") -> None:
    """`InputError` about an output that cannot be written: a file where its name has a suffix, else a folder."""
    if output.suffix:
        check_output(output, (output.suffix.lower(),), flag=flag)
    else:
        check_output_folder(output, flag=flag)


def refuse_own_input(output: Path, inputs: Iterable[Path], *, flag: str = "--output") -> None:
    """`InputError` about an output that would replace one of the files that it is made of."""
    for path in inputs:
        if output.resolve() == path.resolve():
            cure = "choose another name"
            raise InputError(flag, "would replace a file that the scene is made of", got=str(output), cure=cure)


@contextmanager
def _writable_below(folder: Path, output: Path, flag: str) -> Iterator[None]:
    """`InputError` where no file can be made in a folder, or in the nearest one above it that exists."""
    try:
        yield
        nearest = next((each for each in (folder, *folder.parents) if each.exists()), Path())
        if not nearest.is_dir():
            cure = f"{nearest} is a file; choose another place"
            raise InputError(flag, "lies under a file", got=str(output), cure=cure)
        longest = max((os.fsencode(part) for part in output.parts), key=len, default=b"")
        if len(longest) > _MOST_NAME_BYTES:
            raise OSError(errno.ENAMETOOLONG, os.strerror(errno.ENAMETOOLONG))
        with tempfile.TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        said = (error.strerror or str(error)).lower()
        raise InputError(
            flag, f"cannot be written: {said}", got=shortened(str(output)), cure="choose another place"
        ) from None
