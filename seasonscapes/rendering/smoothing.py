"""Edge-aware smoothing of irradiance over neighbouring pixels of one surface.

The irradiance of a diffuse surface varies as slowly as its normal; albedo varies faster and is not smoothed. The
weights depend on geometry alone. They are therefore equal for all illuminations, and the result stays linear in the
light. Increasing strides after Dammertz, Sewtz, Hanika & Lensch 2010, "Edge-avoiding À-Trous wavelet transform
for fast global illumination filtering", High Performance Graphics.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.rendering.backend import aligned

_TAPS = [(row, column) for row in (-1, 0, 1) for column in (-1, 0, 1) if (row, column) != (0, 0)]
# Distance from the tangent plane at which the weight of a neighbour falls to 1/e, in pixel widths per pixel of stride.
_PLANE_PX = 0.7


@dataclass(frozen=True)
class Neighbours:
    """Eight neighbours of each of n receivers at one stride, and their weights.

    Parameters
    ----------
    index
        ``(8, n)`` int32 indices of the neighbours among the n receivers; a receiver's own index if it has no neighbour.
    weight
        ``(9, n)`` float32 weights, the receiver's own first, sum 1.
    """

    index: np.ndarray
    weight: np.ndarray


@dataclass(frozen=True)
class DeviceNeighbours:
    """`Neighbours` on the Dr.Jit device: eight ``mi.UInt32`` and nine ``mi.Float16`` arrays of n lanes."""

    mi_index: list[Any]
    mi_weight: list[Any]


def edge_aware_neighbours(
    shape: tuple[int, int],
    pixel: np.ndarray,
    position_m: np.ndarray,
    normal: np.ndarray,
    pixel_width_m: np.ndarray,
    *,
    stride: int,
    sharpness: float,
) -> Neighbours:
    """Find the neighbouring pixels of each receiver that lie on the same surface, and their weights.

    The weight of a neighbour falls with its distance from the receiver's tangent plane and with the angle between both
    normals.

    Parameters
    ----------
    shape
        Height and width of the image [px].
    pixel
        ``(n,)`` flat index of each receiver in the image.
    position_m
        ``(n, 3)`` positions, ENU [m].
    normal
        ``(n, 3)`` unit normals.
    pixel_width_m
        ``(n,)`` width of a pixel at each position [m].
    stride
        Distance of the neighbours [px].
    sharpness
        Exponent of the cosine between normals.

    Returns
    -------
    Neighbours
        Indices and weights.
    """
    height, width = shape
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
        off_plane = np.abs(np.einsum("nc,nc->n", normal, position_m[other] - position_m))
        falloff = np.exp(-off_plane / (_PLANE_PX * stride * np.maximum(pixel_width_m, pixel_width_m[other])))
        kernel = (0.5 if down and across else 0.75) * (found >= 0)
        index[k], weight[k + 1] = other, kernel * cosine**sharpness * falloff
    return Neighbours(index, weight / weight.sum(axis=0))


def smoothed(values: np.ndarray, neighbours: Neighbours) -> np.ndarray:
    """Average values over each receiver and its neighbours.

    Parameters
    ----------
    values
        ``(n, r)``.
    neighbours
        From `edge_aware_neighbours`.

    Returns
    -------
    numpy.ndarray
        ``(n, r)`` float32 weighted means.
    """
    result = neighbours.weight[0][:, None] * values.astype(np.float32)
    for k, index in enumerate(neighbours.index):
        result += neighbours.weight[k + 1][:, None] * values[index].astype(np.float32)
    return result


def mi_smoothed(channels: list[Any], neighbours: DeviceNeighbours) -> list[Any]:
    """Average values over each receiver and its neighbours on the device.

    Parameters
    ----------
    channels
        ``mi.Float`` arrays of n lanes, one per channel.
    neighbours
        From `upload_neighbours`.

    Returns
    -------
    list of mi.Float
        Weighted means, one array per channel.
    """
    import drjit as dr
    import mitsuba as mi

    dr.eval(channels)
    result = [channel * mi.Float(neighbours.mi_weight[0]) for channel in channels]
    for k, index in enumerate(neighbours.mi_index):
        weight = mi.Float(neighbours.mi_weight[k + 1])
        result = [
            dr.fma(weight, dr.gather(mi.Float, channel, index), partial_sum)
            for channel, partial_sum in zip(channels, result, strict=True)
        ]
    return result


def upload_neighbours(neighbours: Neighbours) -> DeviceNeighbours:
    """Copy neighbours to the device, with weights in half precision.

    Parameters
    ----------
    neighbours
        From `edge_aware_neighbours`.

    Returns
    -------
    DeviceNeighbours
        The device copy, for `mi_smoothed`.
    """
    import drjit as dr
    import mitsuba as mi

    index = [mi.UInt32(aligned(row, np.uint32)) for row in neighbours.index]
    weight = [mi.Float16(aligned(row, np.float16)) for row in neighbours.weight]
    dr.eval(index, weight)
    return DeviceNeighbours(index, weight)
