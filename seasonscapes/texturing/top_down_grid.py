"""Resampling between a texture atlas and a top-down grid, for spatial operations across chart borders."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from seasonscapes.terrain.atlas import planar_uv
from seasonscapes.terrain.surface import Terrain
from seasonscapes.terrain.texels import texel_positions

# Cells whose heights are interpolated at once.
_BLOCK = 1_000_000


@dataclass(frozen=True)
class TopDownGrid:
    """A top-down grid over a terrain, row 0 in the north, and the positions of a texture's texels on it.

    Parameters
    ----------
    width_px, height_px
        Size of the grid [cells].
    pixel
        Column and row ``(R, S, 2)`` float32 of each texel (0.5 is the first cell's centre); NaN off the surface.
    """

    width_px: int
    height_px: int
    pixel: np.ndarray


def grid_heights(terrain: Terrain, spacing_m: float) -> tuple[np.ndarray, float]:
    """Sample the heights of a terrain on a top-down grid.

    They are those of the smooth surface that the triangles approximate, where the terrain has one: the slopes and curvatures of
    large triangles in a plain are the mesh's, and a regression on them would complete the plain in facets.

    Parameters
    ----------
    terrain
        The surface.
    spacing_m
        Greatest cell size [m]; the grid has a whole number of cells.

    Returns
    -------
    heights_m
        ``(H, W)`` [m], row 0 in the north; NaN outside the terrain.
    spacing_m
        Cell size from west to east [m].
    """
    extent = np.ptp(terrain.vertices[:, :2].astype(np.float64), axis=0)
    width, height = (max(2, int(np.ceil(side / spacing_m - 1e-6))) for side in extent)
    planar = Terrain(terrain.vertices, terrain.faces, planar_uv(terrain.vertices), terrain.frame)
    positions, _ = texel_positions(planar, width, height)
    heights_m = positions[..., 2].copy()
    if terrain.surface is not None:
        known = np.flatnonzero(np.isfinite(heights_m.ravel()))
        for start in range(0, len(known), _BLOCK):
            part = known[start : start + _BLOCK]
            heights_m.ravel()[part] = terrain.surface.up_at(positions.reshape(-1, 3)[part])
    return heights_m, float(extent[0] / width)


def top_down_grid(terrain: Terrain, positions: np.ndarray, width_px: int, height_px: int) -> TopDownGrid:
    """Locate the texels of a texture on a grid over the terrain's bounding box.

    Parameters
    ----------
    terrain
        The surface.
    positions
        ``(R, S, 3)`` texel positions ENU [m], NaN off the surface.
    width_px, height_px
        Size of the grid [cells].

    Returns
    -------
    TopDownGrid
        For `to_grid` and `from_grid`.
    """
    low = terrain.vertices[:, :2].min(0).astype(np.float64)
    extent = np.ptp(terrain.vertices[:, :2].astype(np.float64), axis=0)
    column = (positions[..., 0] - low[0]) / extent[0] * width_px
    row = (1.0 - (positions[..., 1] - low[1]) / extent[1]) * height_px
    return TopDownGrid(width_px, height_px, np.stack([column, row], -1).astype(np.float32))


def to_grid(grid: TopDownGrid, values: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Average texels in the cells of the grid.

    Parameters
    ----------
    grid
        Positions of the texels.
    values
        ``(R, S, C)``.
    mask
        ``(R, S)`` bool: texels to use.

    Returns
    -------
    mean
        ``(H, W, C)`` float32, 0 in cells without texels.
    count
        ``(H, W)`` number of texels in each cell.
    """
    used = mask & np.isfinite(grid.pixel).all(axis=2)
    pixel = grid.pixel[used]
    column = np.clip(pixel[:, 0].astype(int), 0, grid.width_px - 1)
    row = np.clip(pixel[:, 1].astype(int), 0, grid.height_px - 1)
    cell = row * grid.width_px + column
    size = grid.width_px * grid.height_px
    count = np.bincount(cell, minlength=size)
    sums = [np.bincount(cell, weights=channel, minlength=size) for channel in values[used].T]
    mean = np.stack(sums, -1) / np.maximum(count, 1)[:, None]
    shape = (grid.height_px, grid.width_px)
    return mean.reshape(*shape, -1).astype(np.float32), count.reshape(shape)


def from_grid(grid: TopDownGrid, values: np.ndarray) -> np.ndarray:
    """Sample gridded values bilinearly at the texels.

    Parameters
    ----------
    grid
        Positions of the texels.
    values
        ``(H, W, C)`` on the grid.

    Returns
    -------
    ndarray
        ``(R, S, C)`` float32; NaN off the surface.
    """
    x, y = grid.pixel[..., 0] - 0.5, grid.pixel[..., 1] - 0.5
    known = np.isfinite(x) & np.isfinite(y)
    map_x, map_y = np.where(known, x, 0.0).astype(np.float32), np.where(known, y, 0.0).astype(np.float32)
    picture = np.ascontiguousarray(values, np.float32)
    sampled = cv2.remap(picture, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    sampled = sampled.reshape(*known.shape, -1)
    sampled[~known] = np.nan
    return sampled
