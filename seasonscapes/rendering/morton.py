"""Order of things in a plane along a curve that keeps neighbours together, so that neighbouring rays visit the same nodes of the tree."""

from __future__ import annotations

import numpy as np

# Side of the cells of ground whose order is that of their contents [m].
_CELL_M = 4.0


def morton_order(column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Number ``(n,)`` int64 of cells along a Morton curve, which goes through aligned squares one after the other.

    Parameters
    ----------
    column, row
        ``(n,)`` whole numbers in [0, 2³²): pixels of an image or cells of the ground.

    Returns
    -------
    numpy.ndarray
        ``(n,)`` int64.

    Examples
    --------
    >>> import numpy as np
    >>> from seasonscapes.rendering.morton import morton_order
    >>> row, column = np.divmod(np.arange(8), 4)
    >>> morton_order(column, row).tolist()
    [0, 1, 4, 5, 2, 3, 6, 7]
    """

    def spread(bits: np.ndarray) -> np.ndarray:
        bits = np.asarray(bits, np.int64)
        for shift, mask in (
            (16, 0x0000FFFF0000FFFF),
            (8, 0x00FF00FF00FF00FF),
            (4, 0x0F0F0F0F0F0F0F0F),
            (2, 0x3333333333333333),
        ):
            bits = (bits | bits << shift) & mask
        return (bits | bits << 1) & 0x5555555555555555

    return spread(column) | spread(row) << 1


def ground_order(position_m: np.ndarray) -> np.ndarray:
    """Indices ``(n,)`` of positions ``(n, 3)`` [m] along a Morton curve over the ground, in cells of a few metres."""
    if not len(position_m):
        return np.empty(0, np.int64)
    cell = ((position_m[:, :2] - position_m[:, :2].min(axis=0)) / _CELL_M).astype(np.int64)
    return np.argsort(morton_order(cell[:, 0], cell[:, 1]), kind="stable")
