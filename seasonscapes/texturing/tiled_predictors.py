"""Predictors of a large planar atlas, computed tile by tile: those of all its texels together would not fit into memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import cv2
import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.terrain.atlas import Atlas
from seasonscapes.terrain.surface import Terrain, Texture
from seasonscapes.terrain.texels import covering_faces, texel_coordinates
from seasonscapes.texturing.predictors import Predictors, require_atlas_size
from seasonscapes.texturing.terrain_features import terrain_features
from seasonscapes.texturing.top_down_grid import grid_heights

# Terrain attributes are computed on at most this many cells; finer texels interpolate between them.
MOST_CELLS = 12_000_000
_BLOCK_PX = 2048
# Texels of a window that are computed at once, in rows of some of them.
_BLOCK = 1_000_000
_ROW = 4096
Window = tuple[slice, slice]


@dataclass(frozen=True)
class TiledPredictors:
    """Predictors of a planar atlas whose texels are asked for by windows.

    Parameters
    ----------
    features
        Terrain attributes by name, ``(H, W)`` float32 on a top-down grid over the terrain, 0 where unknown.
    coverage
        ``(H, W)`` float32: 1 in cells with terrain, 0 elsewhere.
    layers
        Further layers of the atlas by name, ``(R, S)``.
    satellite
        As in `predictors.stack_predictors`.
    surface
        ``(R, S)`` bool: texels on the terrain.
    largest_uv
        Texture coordinates of the terrain's north-east corner: whole texels may reach beyond the terrain.
    """

    features: Mapping[str, np.ndarray]
    coverage: np.ndarray
    layers: Mapping[str, np.ndarray]
    satellite: Texture | None
    surface: np.ndarray
    largest_uv: tuple[float, float]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the layers; see `predictors.Predictors`."""
        channels = 0 if self._image is None else self._image.values.shape[2]
        return (*self.features, *self.layers, *(f"satellite_{channel + 1}" for channel in range(channels)))

    def whole(self) -> Predictors:
        """Predictors of all texels at once, in as much memory as they take."""
        rows, columns = self.surface.shape
        values = np.empty((rows, columns, len(self.names)), np.float32)
        # remap gives no more than 32,767 texels along a side.
        for top, left in product(range(0, rows, _BLOCK_PX), range(0, columns, _BLOCK_PX)):
            part = slice(top, min(top + _BLOCK_PX, rows)), slice(left, min(left + _BLOCK_PX, columns))
            values[part] = self.window(part).values
        return Predictors(values, self.names, self.surface)

    def window(self, window: Window) -> WindowPredictors:
        """Predictors of a rectangle of texels, each computed when it is asked for.

        Parameters
        ----------
        window
            Slices of rows and columns with their starts and stops.
        """
        return WindowPredictors(self, window)

    def at(self, row: np.ndarray, column: np.ndarray) -> np.ndarray:
        """Predictors of texels that lie within some thousand rows and columns.

        Parameters
        ----------
        row, column
            ``(n,)`` of the atlas.

        Returns
        -------
        ndarray
            ``(n, G)`` float32, the same numbers whichever other texels are asked for.
        """
        (rows, columns), (height, width), count = self.surface.shape, self.coverage.shape, len(row)
        if not count:
            return np.empty((0, len(self.names)), np.float32)
        # Rounded first: what depends on the other texels is then subtracted without an error.
        x = ((column + 0.5) / columns / self.largest_uv[0] * width - 0.5).astype(np.float32)
        y = ((1.0 - (1.0 - (row + 0.5) / rows) / self.largest_uv[1]) * height - 0.5).astype(np.float32)
        # Of the grid only what the texels need: remap takes no more than 32,767 cells along a side, nor texels.
        first = tuple(min(max(0, int(cell.min()) - 1), size - 1) for cell, size in ((y, height), (x, width)))
        part = np.s_[first[0] : int(y.max()) + 3, first[1] : int(x.max()) + 3]
        padded = np.zeros((2, -(-count // _ROW), _ROW), np.float32)
        padded.reshape(2, -1)[:, :count] = x - np.float32(first[1]), y - np.float32(first[0])
        map_x, map_y = padded

        def sampled(layer: np.ndarray) -> np.ndarray:
            found = cv2.remap(layer[part], map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            return found.ravel()[:count]

        values = np.empty((count, len(self.names)), np.float32)
        coverage = sampled(self.coverage)
        for number, layer in enumerate(self.features.values()):
            values[:, number] = sampled(layer)
        # At the border of the terrain, the mean is over cells with a height alone.
        border = np.flatnonzero(coverage < 1.0)
        share = np.where(coverage[border] > 0.0, np.maximum(coverage[border], 1e-6), np.nan)
        values[border, : len(self.features)] /= share[:, None]
        for number, layer in enumerate(self.layers.values(), len(self.features)):
            values[:, number] = layer[row, column]
        if self._image is not None:
            colour = self._image.values[row, column]
            imaged = (self._image.weight[row, column] > 0.0) & np.isfinite(colour).all(axis=1)
            values[:, -colour.shape[1] :] = np.where(imaged[:, None], colour, np.nan)
        return values

    @cached_property
    def _image(self) -> Texture | None:
        """The satellite image, if any texel has one."""
        image = self.satellite
        if image is None or not any((weights > 0.0).any() for weights in image.weight):
            return None
        return image


@dataclass(frozen=True)
class WindowPredictors:
    """Predictors of a rectangle of texels, computed where they are asked for; used as `predictors.Predictors` are.

    Parameters
    ----------
    tiled
        Those of the whole atlas.
    window
        Slices of rows and columns with their starts and stops.
    """

    tiled: TiledPredictors
    window: Window
    grid: None = None

    @property
    def names(self) -> tuple[str, ...]:
        """As in `predictors.Predictors`."""
        return self.tiled.names

    @property
    def surface(self) -> np.ndarray:
        """As in `predictors.Predictors`."""
        return self.tiled.surface[self.window]

    @property
    def values(self) -> np.ndarray:
        """As in `predictors.Predictors`; computed anew each time."""
        values = np.empty((*self.surface.shape, len(self.names)), np.float32)
        flat = values.reshape(-1, len(self.names))
        for start in range(0, len(flat), _BLOCK):
            flat[start : start + _BLOCK] = self.at(np.arange(start, min(start + _BLOCK, len(flat))))
        return values

    def at(self, texel: np.ndarray) -> np.ndarray:
        """Predictors ``(n, G)`` float32 of flat indices ``(n,)`` in the window."""
        rows, columns = self.window
        row, column = np.divmod(texel, columns.stop - columns.start)
        return self.tiled.at(row + rows.start, column + columns.start)


def tiled_predictors(
    terrain: Terrain,
    atlas: Atlas,
    *,
    satellite: Texture | None = None,
    layers: Mapping[str, np.ndarray] | None = None,
    sun_direction: ArrayLike | None = None,
    day_suns: ArrayLike | None = None,
    most_cells: int = MOST_CELLS,
) -> TiledPredictors:
    """Prepare the predictors of a planar atlas of any size.

    Parameters
    ----------
    terrain, atlas
        The surface, and size and kind of its atlas.
    satellite, sun_direction, day_suns
        As in `predictors.predictors_for`.
    layers
        Further layers of the atlas by name, ``(R, S)``.
    most_cells
        Most cells of the grid on which terrain attributes are computed.

    Raises
    ------
    ValueError
        An atlas that is not planar.
    AtlasMismatch
        A satellite image or a layer of another size than the atlas.
    """
    require_atlas_size((atlas.height_px, atlas.width_px), satellite, layers or {})
    if atlas.kind != "planar":
        raise ValueError(f"tiled_predictors: got an atlas {atlas.kind!r}, expected planar")
    cell_m = float((np.ptp(terrain.vertices[:, :2], axis=0) / [atlas.width_px, atlas.height_px]).max())
    cell_m *= max(1.0, float(np.sqrt(atlas.width_px * atlas.height_px / most_cells)))
    heights, spacing_m = grid_heights(terrain, cell_m)
    coverage = np.isfinite(heights).astype(np.float32)
    features = terrain_features(heights, spacing_m, sun_direction=sun_direction, day_suns=day_suns)
    for layer in features.values():
        np.nan_to_num(layer, copy=False)
    xy = texel_coordinates(terrain.uv, atlas.width_px, atlas.height_px)
    surface = covering_faces(xy, terrain.faces, atlas.width_px, atlas.height_px) >= 0
    largest = terrain.uv.max(axis=0).astype(float)
    return TiledPredictors(
        features, coverage, dict(layers or {}), satellite, surface, (float(largest[0]), float(largest[1]))
    )
