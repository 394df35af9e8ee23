"""The explicit point cloud of a raster: samples with normals, which screened Poisson reconstruction reads, and colours."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from seasonscapes.frames import LocalFrame, enu_from_geodetic
from seasonscapes.images import atomic_path, srgb8_from_linear
from seasonscapes.terrain.crs import apply_affine, geodetic_from_map
from seasonscapes.terrain.imagery import image_pixels
from seasonscapes.terrain.placement import cell_sides_m
from seasonscapes.terrain.surface import Raster

_CHUNK = 1_000_000


@dataclass(frozen=True)
class OrientedPoints:
    """The samples of a raster as points with normals.

    Parameters
    ----------
    raster
        ``values`` ``(H, W, 1)`` heights [m] without holes.
    normals
        ``(H, W, 3)`` float32 unit vectors along columns, along rows and up.
    """

    raster: Raster
    normals: np.ndarray


@dataclass(frozen=True)
class PointCloud:
    """A coloured point cloud in a local frame.

    Parameters
    ----------
    position_m
        ``(N, 3)`` east, north, up [m].
    normal
        ``(N, 3)`` unit vectors, up.
    colour
        ``(N, 3)`` linear Rec.709 reflectance in [0, 1].
    """

    position_m: np.ndarray
    normal: np.ndarray
    colour: np.ndarray


def oriented_points(raster: Raster) -> OrientedPoints:
    """Give each sample of a raster the normal of its central differences.

    Parameters
    ----------
    raster
        ``values`` ``(H, W, 1)`` heights [m] without holes, at least 2 × 2.

    Examples
    --------
    >>> import numpy as np
    >>> from affine import Affine
    >>> slope = np.tile(5.0 * np.arange(4.0), (3, 1))[..., None].astype(np.float32)
    >>> points = oriented_points(Raster(slope, Affine(10.0, 0.0, 2.6e6, 0.0, -10.0, 1.1e6), "EPSG:2056"))
    >>> [round(float(value), 4) + 0.0 for value in points.normals[1, 1] / points.normals[1, 1, 2]]
    [-0.5, 0.0, 1.0]
    """
    along_rows, along_columns = np.gradient(raster.values[..., 0].astype(np.float64))
    dx, dy = cell_sides_m(raster)
    normals = np.stack([-along_columns / dx, -along_rows / dy, np.ones_like(along_rows)], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    return OrientedPoints(raster, normals.astype(np.float32))


def coloured_cloud(points: OrientedPoints, frame: LocalFrame, image: Raster | None, *, grey: float = 0.2) -> PointCloud:
    """Place points in a local frame, and colour them by an image.

    Parameters
    ----------
    points
        Samples of a raster with normals.
    frame
        Local frame of the result.
    image
        ``values`` ``(H, W, 3)`` linear reflectance, NaN where it has none; ``None`` leaves the land ``grey``. Points beyond
        the image have its median colour.
    grey
        Reflectance without an image.
    """
    height, width = points.raster.values.shape[:2]
    positions = np.empty((height * width, 3))
    normals, colours = np.empty((height * width, 3), np.float32), np.full((height * width, 3), grey, np.float32)
    strip = max(2, _CHUNK // width)
    for first in range(0, height, strip):
        # One more row for the directions, which differences of level positions give.
        last = min(first + strip, height)
        low = max(min(first, last - 2), 0)
        row, column = np.mgrid[low:last, 0:width]
        placed = _placed(points.raster, frame, row, column, points.raster.values[low:last, :, 0])
        level = _placed(points.raster, frame, row, column, np.zeros(row.shape))
        along = [np.gradient(level, axis=axis) for axis in (1, 0)]
        along = [direction / np.linalg.norm(direction, axis=-1, keepdims=True) for direction in along]
        up = np.cross(*along)
        up *= np.where(up[..., 2:] < 0.0, -1.0, 1.0)
        parts = points.normals[low:last]
        normal = parts[..., :1] * along[0] + parts[..., 1:2] * along[1] + parts[..., 2:] * up
        normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
        into, own = slice(first * width, last * width), slice(first - low, None)
        positions[into], normals[into] = placed[own].reshape(-1, 3), normal[own].reshape(-1, 3)
        if image is not None:
            colours[into] = _colours(frame, image, positions[into])
    if image is not None:
        missing = ~np.isfinite(colours).all(axis=1)
        colours[missing] = np.nanmedian(image.values.reshape(-1, 3), axis=0)
    return PointCloud(positions, normals, np.clip(colours, 0.0, 1.0))


def _placed(raster: Raster, frame: LocalFrame, row: np.ndarray, column: np.ndarray, heights: np.ndarray) -> np.ndarray:
    x, y = apply_affine(raster.transform, column + 0.5, row + 0.5)
    return enu_from_geodetic(frame, *geodetic_from_map(raster.crs, x, y), heights)


def _colours(frame: LocalFrame, image: Raster, position_m: np.ndarray) -> np.ndarray:
    """Bilinear colours of an image at positions ``(N, 3)``; NaN beyond it."""
    import cv2

    pixel = image_pixels(frame, image, position_m).astype(np.float32) - np.float32(0.5)
    # As a picture, since OpenCV limits both sides of its maps to 32,767.
    columns = min(len(pixel), 16_384)
    padded = np.full((-(-len(pixel) // columns) * columns, 2), -10.0, np.float32)
    padded[: len(pixel)] = np.nan_to_num(pixel, nan=-10.0)
    column, row = (np.ascontiguousarray(padded[:, axis]).reshape(-1, columns) for axis in (0, 1))
    values = cv2.remap(
        np.ascontiguousarray(image.values, np.float32),
        column,
        row,
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=[float("nan")] * 4,
    )
    return values.reshape(-1, 3)[: len(pixel)]


def save_point_cloud(path: str | os.PathLike, cloud: PointCloud, *, comments: Sequence[str] = ()) -> None:
    """Write a binary PLY: ``x y z`` float64 [m], ``nx ny nz`` float32, ``red green blue`` 8-bit sRGB.

    Parameters
    ----------
    path
        ``.ply`` file; it appears atomically.
    cloud
        The points.
    comments
        Lines of ASCII for its header: place, frame, attribution.
    """
    from plyfile import PlyData, PlyElement

    vertex = np.empty(
        len(cloud.position_m),
        [(name, "f8") for name in "xyz"]
        + [(f"n{name}", "f4") for name in "xyz"]
        + [(name, "u1") for name in ("red", "green", "blue")],
    )
    for axis, name in enumerate("xyz"):
        vertex[name], vertex[f"n{name}"] = cloud.position_m[:, axis], cloud.normal[:, axis]
    encoded = srgb8_from_linear(cloud.colour)
    for channel, name in enumerate(("red", "green", "blue")):
        vertex[name] = encoded[:, channel]
    data = PlyData(
        [PlyElement.describe(vertex, "vertex")], byte_order="<", comments=[_ascii(line) for line in comments]
    )
    with atomic_path(path) as temporary:
        data.write(os.fspath(temporary))


def _ascii(line: str) -> str:
    return line.encode("ascii", "backslashreplace").decode("ascii").replace("\n", " ")
