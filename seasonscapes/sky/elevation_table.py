"""Values that change with the sun's elevation alone, tabulated: a film asks for thousands of suns, a table for 177.

Knots divide the intervals of `sh_moments.SUN_ELEVATION_KNOTS_DEG`, so that they are close through twilight and lie
on the kinks of what is tabulated. In between the cubic through the four nearest knots holds. Values are kept in half
precision (3e-4 of each value) over a scale for each knot, since they fall by nine orders of magnitude into the night.
"""

from __future__ import annotations

from collections.abc import Callable
from os import PathLike

import numpy as np

from seasonscapes.images import atomic_path
from seasonscapes.sky.sh_moments import SUN_ELEVATION_KNOTS_DEG

# Raised whenever an equal atmosphere and observer give other tables.
TABLE_REVISION = 2
_AT_ONCE = 4


def _knots_deg() -> np.ndarray:
    """Four parts to an interval, and eight where dusk ends in the night: there light falls most steeply."""
    low, high = SUN_ELEVATION_KNOTS_DEG[:-1], SUN_ELEVATION_KNOTS_DEG[1:]
    parts = np.where((low >= -18.0) & (low < -12.0), 8, 4)
    each = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(low, high, parts, strict=True)]
    return np.concatenate([*each, high[-1:]])


KNOTS_DEG = _knots_deg()
# Half precision is exact to 11 bits from 2^-14 to 65504.
_LARGEST = 32768.0

Progress = Callable[[float], None]


def by_elevation(values_of: Callable[[np.ndarray], np.ndarray], *, progress: Progress | None = None) -> np.ndarray:
    """Tabulate positive values ``(N, ...)`` of N true elevations [rad].

    Returns
    -------
    ndarray
        Records ``(J,)``, one a knot, of ``scale`` and ``values`` ``(...)``.
    """
    table = None
    for start in range(0, len(KNOTS_DEG), _AT_ONCE):
        values = values_of(np.radians(KNOTS_DEG[start : start + _AT_ONCE]))
        if table is None:
            shape = values.shape[1:]
            table = np.empty(len(KNOTS_DEG), [("scale", np.float32), ("values", np.float16, shape)])
        scale = np.maximum(values.reshape(len(values), -1).max(axis=1), 1e-30) / _LARGEST
        part = table[start : start + len(values)]
        part["scale"] = scale
        part["values"] = values / scale.reshape(-1, *(1,) * len(shape))
        if progress is not None:
            progress((start + len(values)) / len(KNOTS_DEG))
    return table


def at_elevation(table: np.ndarray, elevation_rad: float) -> np.ndarray:
    """Values ``(...)`` float32 of a table at a true elevation [rad], held below its lowest knot."""
    first, weights = _cubic(float(np.degrees(elevation_rad)))
    values = np.zeros(table.dtype["values"].shape, np.float32)
    for record, weight in zip(table[first : first + len(weights)], weights, strict=True):
        if weight != 0.0:
            values += record["values"].astype(np.float32) * np.float32(weight * record["scale"])
    # Where values set in steeply the cubic swings below zero.
    return np.maximum(values, 0.0, out=values)


def _cubic(elevation_deg: float) -> tuple[int, np.ndarray]:
    """First of four knots around an elevation and their weights: Lagrange's formula."""
    x = min(max(elevation_deg, KNOTS_DEG[0]), KNOTS_DEG[-1])
    first = int(np.clip(np.searchsorted(KNOTS_DEG, x, side="right") - 2, 0, len(KNOTS_DEG) - 4))
    knots = KNOTS_DEG[first : first + 4]
    others = [np.delete(knots, i) for i in range(4)]
    return first, np.array([np.prod((x - rest) / (knot - rest)) for knot, rest in zip(knots, others, strict=True)])


def save_table(table: np.ndarray, path: str | PathLike) -> None:
    """Write a table to one ``.npy`` file, atomically."""
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.save(file, table)


def load_table(path: str | PathLike) -> np.ndarray:
    """A table of `save_table`, mapped into memory: processes on one machine share it, and read what they need."""
    return np.load(path, mmap_mode="r", allow_pickle=False)
