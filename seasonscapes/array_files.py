"""Reading of ``.npz`` files that may be damaged, cut short or something else, without ever unpickling anything."""

from __future__ import annotations

import os
import zlib
from collections.abc import Iterable
from pathlib import Path
from zipfile import BadZipFile

import numpy as np

from seasonscapes.errors import InputError

# How an archive begins.
_ARCHIVE = b"PK"
# What numpy and zipfile raise for files that are cut short, changed, pickled, or no .npz file at all.
_DAMAGE = (BadZipFile, ValueError, EOFError, KeyError, AttributeError, NotImplementedError, RuntimeError, zlib.error)


def read_arrays(
    path: str | os.PathLike[str],
    names: Iterable[str] | None = None,
    *,
    optional: Iterable[str] = (),
    what: str,
    cure: str | None = None,
) -> dict[str, np.ndarray]:
    """Read arrays of a ``.npz`` file, with their checksums compared.

    Parameters
    ----------
    path
        File to read.
    names
        Arrays that it must hold; ``None`` for all that it holds.
    optional
        Arrays that are read where it holds them.
    what
        What the file should be, for the error message, such as ``an albedo texture``.
    cure
        How to get a good one.

    Returns
    -------
    dict
        Arrays by name.

    Raises
    ------
    InputError
        Where the file is missing, damaged, lacks an array or holds pickled objects.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> from seasonscapes.array_files import read_arrays
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     np.savez(f"{folder}/a.npz", values=np.zeros(3))
    ...     read_arrays(f"{folder}/a.npz", ["values"], what="a test")["values"].shape
    (3,)
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(path, "no such file", expected=what, cure=cure)
    with open(path, "rb") as file:
        # numpy takes whatever is no archive for a pickle.
        if file.read(len(_ARCHIVE)) != _ARCHIVE:
            raise InputError(path, f"not {what}: no .npz file", cure=cure)
    try:
        with np.load(path, allow_pickle=False) as stored:
            if names is None:
                return {name: stored[name] for name in stored.files}
            wanted = list(names)
            missing = [name for name in wanted if name not in stored.files]
            if not missing:
                return {name: stored[name] for name in (*wanted, *(each for each in optional if each in stored.files))}
            holds = ", ".join(sorted(stored.files)[:8])
    except MemoryError:
        raise InputError(path, f"not {what}: an array is larger than the memory", cure=cure) from None
    except _DAMAGE as error:
        raise InputError(path, f"not {what}, or damaged: {_first_line(error)}", cure=cure) from None
    raise InputError(path, f"not {what}: it lacks {', '.join(missing)}", got=holds or "no arrays", cure=cure)


def _first_line(error: Exception) -> str:
    if "pickle" in str(error):
        return "it holds pickled objects, which are never loaded"
    return str(error).strip("'\"").partition("\n")[0] or type(error).__name__
