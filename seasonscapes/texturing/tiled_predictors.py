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
from seasonscapes.texturing.predictors import Predictors, require_atlas_size, stack_predictors
from seasonscapes.texturing.terrain_features import terrain_features
from seasonscapes.texturing.top_down_grid import grid_heights

# Terrain attributes are computed on at most this many cells; finer texels interpolate between them.
MOST_CELLS = 12_000_000
_BLOCK_PX = 2048
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
        return self.window((slice(0, 1), slice(0, 1))).names

    def whole(self) -> Predictors:
        """Predictors of all texels at once, in as much memory as they take."""
        rows, columns = self.surface.shape
        values = np.empty((rows, columns, len(self.names)), np.float32)
        # remap gives no more than 32,767 texels along a side.
        for top, left in product(range(0, rows, _BLOCK_PX), range(0, columns, _BLOCK_PX)):
            part = slice(top, min(top + _BLOCK_PX, rows)), slice(left, min(left + _BLOCK_PX, columns))
            values[part] = self.window(part).values
        return Predictors(values, self.names, self.surface)

    def window(self, window: Window) -> Predictors:
        """Predictors of a rectangle of texels.

        Parameters
        ----------
        window
            Slices of rows and columns with their starts and stops.
        """
        (rows, columns), (height, width) = self.surface.shape, self.coverage.shape
        top, bottom, left, right = window[0].start, window[0].stop, window[1].start, window[1].stop
        u, v = (np.arange(left, right) + 0.5) / columns, 1.0 - (np.arange(top, bottom) + 0.5) / rows
        x = (u / self.largest_uv[0] * width - 0.5).astype(np.float32)
        y = ((1.0 - v / self.largest_uv[1]) * height - 0.5).astype(np.float32)
        # Of the grid only what the window needs: remap takes no more than 32,767 cells along a side.
        first = tuple(min(max(0, int(at[0]) - 1), size - 1) for at, size in ((y, height), (x, width)))
        part = np.s_[first[0] : int(y[-1]) + 3, first[1] : int(x[-1]) + 3]
        map_x, map_y = np.meshgrid(x - np.float32(first[1]), y - np.float32(first[0]))

        def sampled(layer: np.ndarray) -> np.ndarray:
            return cv2.remap(
                np.ascontiguousarray(layer[part]), map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
            )

        coverage = sampled(self.coverage)
        # At the border of the terrain, the mean is over cells with a height alone.
        found = {
            name: np.where(coverage > 0.0, sampled(layer) / np.maximum(coverage, 1e-6), np.nan)
            for name, layer in self.features.items()
        }
        found |= {name: layer[window] for name, layer in self.layers.items()}
        image = None if self._image is None else Texture(self._image.values[window], self._image.weight[window])
        return stack_predictors(found, image, surface=self.surface[window], empty_images=True)

    @cached_property
    def _image(self) -> Texture | None:
        """The satellite image, if any texel has one."""
        image = self.satellite
        if image is None or not any((weights > 0.0).any() for weights in image.weight):
            return None
        return image


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
