"""Whether a raster fits into memory, asked before it is read: a few bytes of a file can declare any size."""

from __future__ import annotations

import os
from pathlib import Path

from seasonscapes.errors import InputError

# Measured peak of reading, checking and meshing heights, per sample.
_BYTES_PER_SAMPLE = 120


def available_bytes() -> int:
    """Memory that this process may still take: the least of what is free, its own limit and its container's."""
    found = [os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")] if hasattr(os, "sysconf") else []
    meminfo = Path("/proc/meminfo")
    if meminfo.is_file():
        fields = dict(line.split(":", 1) for line in meminfo.read_text().splitlines() if ":" in line)
        # Without caches, which the system gives up on demand, SC_AVPHYS_PAGES is far too low.
        found = [int(fields["MemAvailable"].split()[0]) * 1024] if "MemAvailable" in fields else found
    limit = _address_space_left()
    if limit is not None:
        found.append(limit)
    group = Path("/sys/fs/cgroup/memory.max")
    if group.is_file() and (text := group.read_text().strip()) != "max":
        used = int(Path("/sys/fs/cgroup/memory.current").read_text())
        stat = dict(line.split() for line in Path("/sys/fs/cgroup/memory.stat").read_text().splitlines())
        # Cached files count as used, but are dropped when memory is needed.
        found.append(int(text) - used + int(stat.get("inactive_file", 0)) + int(stat.get("active_file", 0)))
    return max(0, min(found)) if found else 1 << 62


def _address_space_left() -> int | None:
    try:
        import resource
    except ImportError:  # not on Windows
        return None
    soft = resource.getrlimit(resource.RLIMIT_AS)[0]
    if soft == resource.RLIM_INFINITY:
        return None
    status = Path("/proc/self/statm")
    used = int(status.read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE") if status.is_file() else 0
    return soft - used


def require_bytes(needed: float, *, where: str, got: str, cure: str) -> None:
    """Raise `InputError` where a piece of work would need more memory than this process may still take."""
    free = available_bytes()
    if needed > free:
        raise InputError(
            where,
            "too large for this machine's memory",
            got=f"{got}, at least {needed / 1e9:.1f} GB",
            expected=f"at most {free / 1e9:.1f} GB",
            cure=cure,
        )


def check_memory(shape: tuple[int, ...], where: str | os.PathLike[str]) -> None:
    """Raise `InputError` where a grid of heights, with all that is computed of it, would not fit into memory.

    Parameters
    ----------
    shape
        Rows and columns, first of all.
    where
        File or argument, for the message.
    """
    height, width = shape[:2]
    require_bytes(
        height * width * _BYTES_PER_SAMPLE,
        where=os.fspath(where),
        got=f"{width} × {height}",
        cure="use a part with a table [area], or a coarser raster: gdal_translate -outsize 10% 10%",
    )
