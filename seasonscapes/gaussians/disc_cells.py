"""Cells of discs: a horizontal grid whose cells may be quartered again and again, and its packed form."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from seasonscapes.gaussians.surfels import SurfelGrid

# Cells are quartered so often at most: 1/64 of the grid's spacing.
MOST_LEVELS = 6


def cell_centres_m(grid: SurfelGrid, level: np.ndarray, cell: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Compute the centres of cells.

    Parameters
    ----------
    grid, level, cell
        As of `surfels.Surfels`, N cells.

    Returns
    -------
    tuple of numpy.ndarray
        East and north ``(N,)`` float64 [m].
    """
    parts = np.ldexp(1.0, level.astype(np.int32))
    row, column = np.divmod(cell, (grid.columns * parts).astype(np.int64))
    east_m = grid.west_m + (column + 0.5) * (grid.east_step_m / parts)
    return east_m, grid.north_m - (row + 0.5) * (grid.north_step_m / parts)


def quarters(cell: np.ndarray, columns: int) -> np.ndarray:
    """Flat indices ``(N, 4)`` of the quarters of cells ``(N,)`` of a grid with so many columns."""
    row, column = np.divmod(cell.astype(np.int64), columns)
    first = 2 * row * 2 * columns + 2 * column
    return first[:, None] + np.array([0, 1, 2 * columns, 2 * columns + 1])


def _ancestors(grid: SurfelGrid, level: np.ndarray, cell: np.ndarray, of_level: int) -> np.ndarray:
    """Distinct cells of a level that contain cells of the same or finer levels, rising."""
    finer = level >= of_level
    up = level[finer].astype(np.int64) - of_level
    row, column = np.divmod(cell[finer], grid.columns << level[finer].astype(np.int64))
    return np.unique((row >> up) * (grid.columns << of_level) + (column >> up))


def packed_cells(grid: SurfelGrid, level: np.ndarray, cell: np.ndarray) -> dict[str, np.ndarray]:
    """Pack cells as bits.

    Parameters
    ----------
    grid, level, cell
        As of `surfels.Surfels`, in rising order of level and then of cell, none within another.

    Returns
    -------
    dict of numpy.ndarray
        ``taken``: for each cell of the grid whether it has discs; ``split``: level by level, for each cell with discs whether it is
        quartered, then for each quarter of these whether it has discs. Both uint8, eight bits a byte.
    """
    nodes = _ancestors(grid, level, cell, 0)
    occupied = np.zeros(grid.columns * grid.rows, bool)
    occupied[nodes] = True
    bits = []
    for number in range(int(level.max(initial=0))):
        below = _ancestors(grid, level, cell, number + 1)
        kids = quarters(nodes, grid.columns << number)
        kept = np.isin(kids, below)
        split = kept.any(axis=1)
        bits += [split, kept[split].ravel()]
        nodes = np.sort(kids[split][kept[split]])
    packed = np.packbits(np.concatenate(bits)) if bits else np.zeros(0, np.uint8)
    return {"taken": np.packbits(occupied), "split": packed}


def unpacked_cells(grid: SurfelGrid, tensors: Mapping[str, np.ndarray], levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Restore the cells of `packed_cells`.

    Parameters
    ----------
    grid
        The grid.
    tensors
        ``taken`` and ``split``.
    levels
        The finest level, at most `MOST_LEVELS`.

    Returns
    -------
    tuple of numpy.ndarray
        Level ``(N,)`` uint8 and flat index ``(N,)`` int64.

    Raises
    ------
    ValueError
        If there are fewer bits than cells, or there cannot be so many levels.
    """
    if levels not in range(MOST_LEVELS + 1):
        raise ValueError(f"cells quartered {levels} times, expected 0 to {MOST_LEVELS}")
    count = grid.columns * grid.rows
    if not 0 < count <= 8 * len(tensors["taken"]):
        raise ValueError(
            f"a grid of {grid.columns} × {grid.rows} cells, {8 * len(tensors['taken'])} of which are stored"
        )
    nodes = np.flatnonzero(np.unpackbits(tensors["taken"])[:count])
    bits, at = np.unpackbits(tensors["split"]).astype(bool), 0

    def taken(wanted: int) -> np.ndarray:
        nonlocal at
        at += wanted
        if at > len(bits):
            raise ValueError(f"{at} bits of quartered cells, {len(bits)} of which are stored")
        return bits[at - wanted : at]

    found = []
    for number in range(levels):
        split = taken(len(nodes))
        found.append(nodes[~split])
        kids = quarters(nodes[split], grid.columns << number)
        nodes = np.sort(kids[taken(kids.size).reshape(kids.shape)])
    found.append(nodes)
    level = np.repeat(np.arange(len(found), dtype=np.uint8), [len(each) for each in found])
    return level, np.concatenate(found).astype(np.int64)
