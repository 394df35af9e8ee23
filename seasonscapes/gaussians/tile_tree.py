"""Land too large for one set of discs: a quadtree of tiles, as fine as the picture needs.

Every tile has the same number of discs; a tile's four children halve their distance. Discs of a level are made from the
terrain when they are asked for, and nothing is stored twice. Each tile has its own origin, so that float32 keeps its
millimetres however large the land is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.gaussians.surfels import Surfels, terrain_surfels
from seasonscapes.terrain.surface import Terrain


@dataclass(frozen=True)
class TileTree:
    """A square of land in tiles.

    Parameters
    ----------
    west_m, north_m, side_m
        The square.
    discs
        Along a tile's side.
    levels
        Level 0 is one tile; level l has 4ˡ, with discs ``side_m / discs / 2**l`` apart.
    low_m, high_m
        Heights that the land lies between.
    """

    west_m: float
    north_m: float
    side_m: float
    discs: int
    levels: int
    low_m: float
    high_m: float

    def spacing_m(self, level: int) -> float:
        """Distance of the discs of a level."""
        return self.side_m / self.discs / 2.0**level


@dataclass(frozen=True, order=True)
class TreeTile:
    """A tile by its level and its place in it, rows from the north."""

    level: int
    row: int
    column: int


@dataclass(frozen=True)
class TileDiscs:
    """Discs of a tile: ``surfels.means`` are relative to ``origin_m (3,)`` float64."""

    tile: TreeTile
    origin_m: np.ndarray
    surfels: Surfels


def tile_tree(terrain: Terrain, *, finest_m: float, discs: int = 256) -> TileTree:
    """The quadtree over a terrain whose last level has discs at most ``finest_m`` apart."""
    if not finest_m > 0.0 or discs < 1:
        raise ValueError(f"tile_tree: got {finest_m} m and {discs} discs, expected positive numbers")
    low, high = terrain.vertices.min(axis=0).astype(float), terrain.vertices.max(axis=0).astype(float)
    side = float((high - low)[:2].max())
    levels = 1 + max(0, int(np.ceil(np.log2(side / discs / finest_m))))
    return TileTree(float(low[0]), float(high[1]), side, discs, levels, float(low[2]), float(high[2]))


def tile_bounds(tree: TileTree, tile: TreeTile) -> tuple[float, float, float, float]:
    """West, south, east and north end of a tile [m]."""
    side = tree.side_m / 2.0**tile.level
    west, north = tree.west_m + tile.column * side, tree.north_m - tile.row * side
    return west, north - side, west + side, north


def select_tiles(tree: TileTree, camera: Camera, *, disc_px: float = 1.0) -> list[TreeTile]:
    """The coarsest tiles whose nearest discs are at most ``disc_px`` apart in the picture, those out of view left out.

    A tile at the last level is taken as it is.
    """
    if not disc_px > 0.0:
        raise ValueError(f"disc_px: got {disc_px}, expected a positive number of pixels")
    chosen, open_tiles = [], [TreeTile(0, 0, 0)]
    focal = max(camera.fx, camera.fy)
    while open_tiles:
        tile = open_tiles.pop()
        west, south, east, north = tile_bounds(tree, tile)
        low, high = np.array([west, south, tree.low_m]), np.array([east, north, tree.high_m])
        if _out_of_view(camera, low, high):
            continue
        distance = float(np.linalg.norm(np.maximum(np.maximum(low - camera.position_m, camera.position_m - high), 0.0)))
        if tile.level + 1 == tree.levels or tree.spacing_m(tile.level) * focal <= disc_px * distance:
            chosen.append(tile)
        else:
            open_tiles += [
                TreeTile(tile.level + 1, 2 * tile.row + r, 2 * tile.column + c) for r in (0, 1) for c in (0, 1)
            ]
    return sorted(chosen)


def _out_of_view(camera: Camera, low: np.ndarray, high: np.ndarray) -> bool:
    """Whether a box lies wholly outside one of the five planes of a view."""
    corner = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
    x, y, z = ((corner - camera.position_m) @ camera.world_from_camera[:3, :3]).T
    left, right = -camera.cx / camera.fx, (camera.width_px - camera.cx) / camera.fx
    top, bottom = -camera.cy / camera.fy, (camera.height_px - camera.cy) / camera.fy
    outside = (z <= 0.0, x < left * z, x > right * z, y < top * z, y > bottom * z)
    return any(bool(side.all()) for side in outside)


def tile_discs(terrain: Terrain, tree: TileTree, tile: TreeTile, *, normals: np.ndarray | None = None) -> TileDiscs:
    """Make the discs of a tile; `ValueError` where the terrain covers none of its cells. See `terrain_surfels`."""
    bounds = tile_bounds(tree, tile)
    surfels = terrain_surfels(terrain, tree.spacing_m(tile.level), bounds_m=bounds, normals=normals)
    origin = np.array([0.5 * (bounds[0] + bounds[2]), 0.5 * (bounds[1] + bounds[3]), tree.low_m])
    means = surfels.places.mean(axis=1, dtype=np.float64) - origin
    return TileDiscs(tile, origin, replace(surfels, means=means.astype(np.float32)))


def joined_shapes(tiles: list[TileDiscs], camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Means **relative to the camera** ``(N, 3)``, quaternions, log scales and opacity logits of all tiles' discs.

    To be drawn by the same camera moved to the origin: what is near then has small numbers.
    """
    means = [each.surfels.means + (each.origin_m - camera.position_m).astype(np.float32) for each in tiles]
    rest = [(each.surfels.quaternions, each.surfels.log_scales, each.surfels.opacity_logits) for each in tiles]
    return np.concatenate(means), *(np.concatenate(column) for column in zip(*rest, strict=True))
