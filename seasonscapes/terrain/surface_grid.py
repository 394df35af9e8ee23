"""Heights and slopes of the terrain on a regular horizontal grid: the smooth surface that a triangle mesh approximates.

A mesh within a few metres of the heights may have facets whose slope is off by many degrees, and normals interpolated
over its large facets carry the slope of a cliff far into a plain. Shading therefore uses the slopes of the heights
themselves, at the resolution of the elevation raster and independently of the triangulation.
"""

from __future__ import annotations

import numpy as np

from seasonscapes.frames import LocalFrame, geodetic_from_enu
from seasonscapes.terrain.crs import raster_pixels
from seasonscapes.terrain.refine import refine_raster
from seasonscapes.terrain.surface import Raster, SurfaceGrid

# Nodes of a grid: 12 bytes each on the device. Twice the raster's resolution as far as that allows.
MOST_NODES = 12_000_000
# Nodes between exact transformations of coordinates, and the heights between which they are interpolated [m].
_COARSE, _LOW_M, _HIGH_M = 64, 0.0, 4000.0
_ROUNDS = 3
_STRIP = 2_000_000


def surface_grid(raster: Raster, frame: LocalFrame, bounds_m: tuple[float, float, float, float]) -> SurfaceGrid:
    """Resample the heights of a raster to a regular grid in the local frame.

    Parameters
    ----------
    raster
        ``values`` ``(H, W, 1)`` heights [m] without holes.
    frame
        Local frame of the grid.
    bounds_m
        West, south, east and north end of the grid [m].

    Returns
    -------
    SurfaceGrid
        Up coordinates; beyond the raster those of its edge.

    Notes
    -----
    The transformation from the local frame to the raster is smooth: it is computed exactly at every 64th node and
    interpolated by cubic splines in between, linearly in height. Heights are interpolated by monotone cubics at twice
    the raster's resolution (see `refine_raster`), then bilinearly.
    """
    from scipy.ndimage import map_coordinates

    west, south, east, north = bounds_m
    height, width = raster.values.shape[:2]
    spacing = min((east - west) / max(width - 1, 1), (north - south) / max(height - 1, 1)) / 2.0
    spacing = max(spacing, np.sqrt((east - west) * (north - south) / MOST_NODES))
    columns, rows = (int(np.ceil(side / spacing)) + 1 for side in (east - west, north - south))
    step = ((east - west) / (columns - 1), (north - south) / (rows - 1))
    fine = refine_raster(raster, 2) if raster.values.size * 4 <= 4 * MOST_NODES else raster
    pixel_of, up_of = _transformations(fine, frame, (west, north), step, (rows, columns))
    heights = np.empty((rows, columns), np.float32)
    strip = max(1, _STRIP // columns)
    for first in range(0, rows, strip):
        part = np.s_[first : min(first + strip, rows)]
        height_m = np.full((part.stop - part.start, columns), np.float64(np.median(raster.values)))
        for _ in range(_ROUNDS):
            column, row = pixel_of(part, height_m)
            height_m = map_coordinates(fine.values[..., 0], [row, column], order=1, mode="nearest", output=np.float64)
        heights[part] = up_of(part, height_m)
    return SurfaceGrid((float(west), float(north)), (float(step[0]), float(step[1])), heights)


def _transformations(raster: Raster, frame: LocalFrame, corner_m: tuple, step_m: tuple, shape: tuple[int, int]):
    """Pixel coordinates, and the up coordinate, of the nodes of some rows as functions of their heights."""
    from scipy.interpolate import RectBivariateSpline

    columns = shape[1]
    row, column = (np.unique(np.r_[0 : count : max(1, min(_COARSE, (count - 1) // 4)), count - 1]) for count in shape)
    x, y = np.meshgrid(corner_m[0] + column * step_m[0], corner_m[1] - row * step_m[1])
    tables = []
    for height in (_LOW_M, _HIGH_M):
        up = np.full(x.shape, height)
        for _ in range(_ROUNDS):
            latitude, longitude, found = geodetic_from_enu(frame, np.stack([x, y, up], axis=-1))
            up = up + (height - found)
        pixel = raster_pixels(raster, latitude, longitude) - 0.5
        tables.append(
            [RectBivariateSpline(row, column, values, kx=3, ky=3) for values in (pixel[..., 0], pixel[..., 1], up)]
        )

    def blended(index: int, part: slice, height_m: np.ndarray) -> np.ndarray:
        low, high = (table[index](np.arange(part.start, part.stop), np.arange(columns)) for table in tables)
        return low + (high - low) * ((height_m - _LOW_M) / (_HIGH_M - _LOW_M))

    return (
        lambda part, height_m: (blended(0, part, height_m), blended(1, part, height_m)),
        lambda part, height_m: blended(2, part, height_m),
    )
