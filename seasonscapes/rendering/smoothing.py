"""Neighbouring pixels of one surface share what their rays found: an edge-aware mean over a grid of taps.

Irradiance of a diffuse surface varies slowly where its normal does; albedo, which does not, is kept out of it. The
weights know geometry alone, so they are the same for every light, and light stays linear. Widening strides after
Dammertz, Sewtz, Hanika & Lensch 2010, "Edge-avoiding À-Trous wavelet transform", doi:10.2312/EGGH/HPG10/067-075.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

_TAPS = [(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1) if (row, column) != (0, 0)]
# A neighbour counts for 1/e where it lies off the pixel's tangent plane by this many pixel widths per pixel of stride.
_PLANE_PX = 0.7


@dataclass(frozen=True)
class Neighbours:
    """Eight neighbours of each of n receivers at one stride.

    Parameters
    ----------
    index
        ``(8, n)`` int32 numbers among the n; their own where there is no neighbour.
    weight
        ``(9, n)`` float32, the receiver's own weight first, sum 1.
    """

    index: np.ndarray
    weight: np.ndarray


def edge_aware_neighbours(
    grid: tuple[int, int],
    pixel: np.ndarray,
    surface: tuple[np.ndarray, np.ndarray, np.ndarray],
    *,
    stride: int,
    sharpness: float,
) -> Neighbours:
    """Which receivers to share with, and how much.

    Parameters
    ----------
    grid
        Height and width of the image.
    pixel
        ``(n,)`` flat index of each receiver in it.
    surface
        Positions ``(n, 3)`` [m], unit normals ``(n, 3)`` and width of a pixel on them ``(n,)`` [m].
    sharpness
        Exponent of the cosine between normals.
    """
    height, width = grid
    position, normal, size = surface
    number = np.full((height, width), -1, np.int32)
    number.reshape(-1)[pixel] = np.arange(len(pixel), dtype=np.int32)
    row, column = np.divmod(pixel, width)
    index = np.empty((len(_TAPS), len(pixel)), np.int32)
    weight = np.empty((len(_TAPS) + 1, len(pixel)), np.float32)
    weight[0] = 1.0
    own = np.arange(len(pixel), dtype=np.int32)
    for k, (down, across) in enumerate(_TAPS):
        r, c = row + down * stride, column + across * stride
        inside = (r >= 0) & (r < height) & (c >= 0) & (c < width)
        found = np.where(inside, number[np.clip(r, 0, height - 1), np.clip(c, 0, width - 1)], -1)
        other = np.where(found >= 0, found, own)
        cosine = np.clip(np.einsum("nc,nc->n", normal, normal[other]), 0.0, 1.0)
        off_plane = np.abs(np.einsum("nc,nc->n", normal, position[other] - position))
        nearness = np.exp(-off_plane / (_PLANE_PX * stride * np.maximum(size, size[other])))
        kernel = (0.5 if down and across else 0.75) * (found >= 0)
        index[k], weight[k + 1] = other, kernel * cosine**sharpness * nearness
    return Neighbours(index, weight / weight.sum(axis=0))


def smoothed(values: np.ndarray, around: Neighbours) -> np.ndarray:
    """Weighted means ``(n, r)`` float32 of ``values (n, r)`` over each receiver and its neighbours."""
    result = around.weight[0][:, None] * values.astype(np.float32)
    for k, index in enumerate(around.index):
        result += around.weight[k + 1][:, None] * values[index].astype(np.float32)
    return result


def mi_smoothed(channels: list[Any], mi_around: tuple[list[Any], list[Any]]) -> list[Any]:
    """The same on the device: lanes of n receivers; ``mi_around`` from `mi_neighbours`."""
    import drjit as dr
    import mitsuba as mi

    index, weight = mi_around
    dr.eval(channels)
    result = [channel * mi.Float(weight[0]) for channel in channels]
    for k, other in enumerate(index):
        share = mi.Float(weight[k + 1])
        result = [
            dr.fma(share, dr.gather(mi.Float, channel, other), sum_)
            for channel, sum_ in zip(channels, result, strict=True)
        ]
    return result


def mi_neighbours(around: Neighbours) -> tuple[list[Any], list[Any]]:
    """Copy to the device."""
    import drjit as dr
    import mitsuba as mi

    index = [mi.UInt32(column.astype(np.uint32)) for column in around.index]
    weight = [mi.Float16(column.astype(np.float16)) for column in around.weight]
    dr.eval(index, weight)
    return index, weight
