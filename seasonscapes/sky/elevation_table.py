"""Tables of arrays by solar elevation, with piecewise cubic interpolation, for sequences of many solar positions.

The knots subdivide the intervals of `sh_moments.SUN_ELEVATION_KNOTS_DEG`, so that they are dense in twilight and
include the kinks of the tabulated functions. Interpolation uses the cubic polynomial through the four nearest knots.
Values are stored in half precision (relative error 3e-4) with one scale per knot, because they decrease by nine orders
of magnitude from day to night.
"""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike

import numpy as np

from seasonscapes.images import atomic_path
from seasonscapes.sky.sh_moments import SUN_ELEVATION_KNOTS_DEG

_BATCH = 4


def _knots_deg() -> np.ndarray:
    """Knots [deg]: three per interval, and six in astronomical twilight, where radiance decreases most steeply."""
    low, high = SUN_ELEVATION_KNOTS_DEG[:-1], SUN_ELEVATION_KNOTS_DEG[1:]
    counts = np.where((low >= -18.0) & (low < -12.0), 6, 3)
    intervals = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(low, high, counts, strict=True)]
    return np.concatenate([*intervals, high[-1:]])


KNOTS_DEG = _knots_deg()
# Half precision has 11 significant bits from 2^-14 to 65504.
_MAX_STORED = 32768.0

Progress = Callable[[float], None]


# Knots of one part of a table that is built as it is needed.
PART_KNOTS = 8
PARTS = -(-len(KNOTS_DEG) // PART_KNOTS)


class PartedTable:
    """A table of `tabulate_by_elevation` whose parts are made when they are first needed: a day needs few of them.

    Parameters
    ----------
    part_of
        Function from the number of a part, below `PARTS`, to its `PART_KNOTS` records (the last has fewer).
    """

    def __init__(self, part_of: Callable[[int], np.ndarray]) -> None:
        self._part_of = part_of
        self._parts: dict[int, np.ndarray] = {}

    def part(self, number: int) -> np.ndarray:
        """The records of a part."""
        if number not in self._parts:
            self._parts[number] = self._part_of(number)
        return self._parts[number]

    def __getitem__(self, knots: slice) -> np.ndarray:
        """Records of consecutive knots."""
        first, last, _ = knots.indices(len(KNOTS_DEG))
        records = []
        for number in _parts_between(first, last):
            start = number * PART_KNOTS
            records.append(self.part(number)[max(first - start, 0) : last - start])
        return np.concatenate(records)


def parts_at(elevation_rad: float) -> range:
    """Numbers of the parts of a `PartedTable` that interpolation at a true solar elevation [rad] reads."""
    first, weights = _lagrange_weights(float(np.degrees(elevation_rad)))
    return _parts_between(first, first + len(weights))


def _parts_between(first: int, last: int) -> range:
    return range(first // PART_KNOTS, (last - 1) // PART_KNOTS + 1)


def tabulate_by_elevation(
    values_of: Callable[[np.ndarray], np.ndarray], *, part: int | None = None, progress: Progress | None = None
) -> np.ndarray:
    """Tabulate an array-valued function of solar elevation.

    Parameters
    ----------
    values_of
        Function from true elevations ``(N,)`` [rad] to values ``(N, ...)``, of which the largest are positive.
    part
        Only the knots of this part, see `PartedTable`.
    progress
        Called with the completed fraction.

    Returns
    -------
    ndarray
        Structured array ``(J,)`` with one record per knot: ``scale`` and ``values`` ``(...)``.
    """
    table = None
    knots_deg = KNOTS_DEG if part is None else KNOTS_DEG[part * PART_KNOTS : (part + 1) * PART_KNOTS]
    for start in range(0, len(knots_deg), _BATCH):
        values = values_of(np.radians(knots_deg[start : start + _BATCH]))
        shape = values.shape[1:]
        if table is None:
            table = np.empty(len(knots_deg), [("scale", np.float32), ("values", np.float16, shape)])
        scale = np.maximum(values.reshape(len(values), -1).max(axis=1), 1e-30) / _MAX_STORED
        records = table[start : start + len(values)]
        records["scale"] = scale
        records["values"] = values / scale.reshape(-1, *(1,) * len(shape))
        if progress is not None:
            progress((start + len(values)) / len(knots_deg))
    assert table is not None  # no part is empty
    return table


def interpolate_at_elevation(
    table: np.ndarray | PartedTable, elevation_rad: float, *, positive: bool = True
) -> np.ndarray:
    """Interpolate a table at a solar elevation.

    Parameters
    ----------
    table
        Table of `tabulate_by_elevation`.
    elevation_rad
        True elevation [rad]; clamped to the range of the knots.
    positive
        Whether what is tabulated has no negative values.

    Returns
    -------
    ndarray
        Values ``(...)``, float32.
    """
    first, weights = _lagrange_weights(float(np.degrees(elevation_rad)))
    records = table[first : first + len(weights)]
    values = np.zeros(records.dtype["values"].shape, np.float32)
    for record, weight in zip(records, weights, strict=True):
        if weight != 0.0:
            values += record["values"].astype(np.float32) * np.float32(weight * record["scale"])
    # The cubic undershoots zero beside steep onsets.
    return np.maximum(values, 0.0, out=values) if positive else values


def _lagrange_weights(elevation_deg: float) -> tuple[int, np.ndarray]:
    """Index of the first of the four nearest knots, and the weights ``(4,)`` of cubic Lagrange interpolation."""
    x = min(max(elevation_deg, KNOTS_DEG[0]), KNOTS_DEG[-1])
    first = int(np.clip(np.searchsorted(KNOTS_DEG, x, side="right") - 2, 0, len(KNOTS_DEG) - 4))
    knots = KNOTS_DEG[first : first + 4]
    others = [np.delete(knots, i) for i in range(4)]
    return first, np.array([np.prod((x - other) / (knot - other)) for knot, other in zip(knots, others, strict=True)])


def save_table(table: np.ndarray, path: str | PathLike[str]) -> None:
    """Write a table to one ``.npy`` file, atomically.

    Parameters
    ----------
    table
        Table of `tabulate_by_elevation`.
    path
        Destination.
    """
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.save(file, table)


def load_table(path: str | PathLike[str]) -> np.ndarray:
    """Open a table of `save_table` as a read-only memory map.

    Processes on one machine share the mapped pages, and only the records in use are read.

    Parameters
    ----------
    path
        ``.npy`` file.

    Returns
    -------
    ndarray
        Table of `tabulate_by_elevation`.
    """
    return np.load(path, mmap_mode="r", allow_pickle=False)
