"""Heights that the page in a browser draws: a regular grid over the place, and finer tiles of it near the viewer."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.workflows.place import Place

if TYPE_CHECKING:
    from seasonscapes.export.viewer_files import HeightTiles
    from seasonscapes.terrain.surface import SurfaceGrid

log = logging.getLogger(__name__)

# Cells along a side of a tile, a power of two and at least 64: the page draws chunks of 32 cells, two of which halve one.
# Larger ones load more than is seen, smaller ones are many files.
TILE_CELLS = 256
# 200 MB in a folder; levels that would exceed it are left out.
MOST_TILES = 1500


@dataclass(frozen=True)
class ViewerGrid:
    """A regular east-north grid over a terrain: node (c, r) lies at west + c · step, south + r · step."""

    west_m: float
    south_m: float
    step_m: float
    columns: int
    rows: int

    def positions(self, longest: int | None = None) -> tuple[np.ndarray, tuple[int, int]]:
        """East and north ``(N, 2)`` of texel centres that divide the grid's area, and their rows and columns."""
        width, height = (self.columns - 1) * self.step_m, (self.rows - 1) * self.step_m
        if longest is None:
            rows, columns = self.rows, self.columns
            east = self.west_m + np.arange(columns) * self.step_m
            north = self.south_m + np.arange(rows) * self.step_m
        else:
            columns, rows = (max(2, round(longest * side / max(width, height))) for side in (width, height))
            east = self.west_m + (np.arange(columns) + 0.5) / columns * width
            north = self.south_m + (np.arange(rows) + 0.5) / rows * height
        grid = np.stack(np.meshgrid(east, north), axis=-1)
        return grid.reshape(-1, 2), (rows, columns)


class _Heights:
    """Up coordinates of a place's smooth surface by east and north; the spline's coefficients are computed once."""

    def __init__(self, place: Place) -> None:
        from scipy.ndimage import spline_filter

        assert place.terrain.surface is not None
        self.surface: SurfaceGrid = place.terrain.surface
        nodes = self.surface.nodes[..., 2].astype(np.float64)
        self.middle, self.shape = float(np.median(nodes)), nodes.shape
        self.coefficients = spline_filter(nodes, order=3, mode="nearest")

    def at(self, flat: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Up ``(N,)`` at east and north ``(N, 2)`` [m], and where the raster knows it."""
        from scipy.ndimage import map_coordinates

        # The polynomials take the height into account a little: two rounds converge.
        position = np.column_stack([flat, np.full(len(flat), self.middle)])
        for _ in range(2):
            column, row = self.surface.nodes_at(position).T
            position[:, 2] = map_coordinates(self.coefficients, [row, column], order=3, mode="nearest", prefilter=False)
        margin = 0.51
        known = (column > -margin) & (column < self.shape[1] - 1 + margin)
        known &= (row > -margin) & (row < self.shape[0] - 1 + margin)
        return position[:, 2], known


def grid_heights(place: Place, most_nodes: int) -> tuple[ViewerGrid, np.ndarray, np.ndarray]:
    """The grid, up coordinates ``(R, C)`` of its nodes [m] with row 0 in the south, and which of them are known.

    Parameters
    ----------
    place
        A place with a grid of heights.
    most_nodes
        Largest number of nodes along a side; finer rasters are thinned.
    """
    surface = place.terrain.surface
    assert surface is not None
    low, high = place.terrain.vertices[:, :2].min(axis=0), place.terrain.vertices[:, :2].max(axis=0)
    step = max(surface.spacing_m, float((high - low).max()) / (most_nodes - 1))
    columns, rows = (int(np.ceil(side / step - 1e-6)) + 1 for side in high - low)
    grid = ViewerGrid(float(low[0]), float(low[1]), step, columns, rows)
    flat, shape = grid.positions()
    up, known = _Heights(place).at(flat)
    return grid, up.reshape(shape), known.reshape(shape)


def height_tiles(place: Place, grid: ViewerGrid, levels: int) -> HeightTiles | None:
    """Tiles of heights that halve the grid's step up to ``levels`` times, until it is that of the raster.

    A tile of level L covers `TILE_CELLS` cells of the step over 2^L, with one node more around; those without known
    heights are left out. ``None`` where the grid is as fine as the raster. What is left out is said in the log.
    """
    surface = place.terrain.surface
    assert surface is not None
    finest, wanted = surface.spacing_m, 0
    # A last halving that would interpolate more than it shows is none.
    while grid.step_m / 2**wanted > 1.34 * finest:
        wanted += 1
    keys: list[tuple[int, int, int]] = []
    shown = 0
    for level in range(1, min(wanted, levels) + 1):
        across, down = (-(-(nodes - 1) * 2**level // TILE_CELLS) for nodes in (grid.columns, grid.rows))
        if len(keys) + across * down > MOST_TILES:
            break
        keys += [(level, column, row) for row in range(down) for column in range(across)]
        shown = level
    if shown < wanted:
        log.warning(
            "%s: the page shows heights every %.3g m of the raster's %.3g m", place.path, grid.step_m / 2**shown, finest
        )
    return _tiles(_Heights(place), grid, keys) if keys else None


def _tiles(heights: _Heights, grid: ViewerGrid, keys: list[tuple[int, int, int]]) -> HeightTiles | None:
    from seasonscapes.export.viewer_files import HeightTiles

    nodes = TILE_CELLS + 3
    kept, stored, low_m, scale_m = [], [], [], []
    for level, column, row in keys:
        step = grid.step_m / 2**level
        east, north = (
            start + (np.arange(nodes) - 1 + index * TILE_CELLS) * step
            for start, index in ((grid.west_m, column), (grid.south_m, row))
        )
        # Beyond the grid its own last heights go on.
        east = np.clip(east, grid.west_m, grid.west_m + (grid.columns - 1) * grid.step_m)
        north = np.clip(north, grid.south_m, grid.south_m + (grid.rows - 1) * grid.step_m)
        up, known = heights.at(np.stack(np.meshgrid(east, north), axis=-1).reshape(-1, 2))
        if not known.any():
            continue
        low = float(up.min())
        scale = max(float(up.max()) - low, 1.0) / 65535.0
        kept.append((level, column, row))
        stored.append(np.rint((up - low) / scale).astype(np.uint16).reshape(nodes, nodes))
        low_m.append(low)
        scale_m.append(scale)
    if not kept:
        return None
    return HeightTiles(TILE_CELLS, np.array(kept, np.int32), np.stack(stored), np.array(low_m), np.array(scale_m))


def surface_positions(place: Place, grid: ViewerGrid, longest: int) -> tuple[np.ndarray, tuple[int, int]]:
    """Positions ``(N, 3)`` on the smooth surface at texel centres; NaN beyond the raster."""
    surface = place.terrain.surface
    assert surface is not None
    flat, shape = grid.positions(longest)
    position = np.column_stack([flat, np.full(len(flat), place.median_height_m)])
    position[:, 2] = surface.up_at(position)
    column, row = surface.nodes_at(position).T
    height, width = surface.nodes.shape[:2]
    inside = (column >= 0.01) & (column <= width - 1.01) & (row >= 0.01) & (row <= height - 1.01)
    return np.where(inside[:, None], position, np.nan), shape
