"""Freed memory stays with the process, in place of a new page fault for each page of each array."""

from __future__ import annotations

import ctypes
import sys

# Of glibc's malloc.h.
_TRIM_THRESHOLD, _MMAP_THRESHOLD = -1, -3
# Most arrays of blocks of rays and of textures are smaller than the first [bytes].
_LARGEST_KEPT = 1 << 27
_MOST_KEPT = 1 << 28


def keep_freed_memory() -> bool:
    """Let glibc keep freed memory for the arrays that come next.

    By default each array above 32 MB, and each end of the heap above 64 MB, goes back to the system when it is freed, and
    the next one of its size takes a page fault for each of its pages again: some 7 % of the processor time of a first
    picture.

    Returns
    -------
    bool
        Whether the C library of this process can do so: glibc can, others keep their own ways.

    Examples
    --------
    >>> import sys
    >>> from seasonscapes.freed_memory import keep_freed_memory
    >>> keep_freed_memory() or sys.platform != "linux"
    True
    """
    if sys.platform != "linux":
        return False
    library = ctypes.CDLL(None)
    if not hasattr(library, "gnu_get_libc_version"):
        return False
    return bool(library.mallopt(_MMAP_THRESHOLD, _LARGEST_KEPT) and library.mallopt(_TRIM_THRESHOLD, _MOST_KEPT))
