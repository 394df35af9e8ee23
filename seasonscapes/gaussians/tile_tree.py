"""Level of detail for large terrains: a quadtree of tiles of discs, refined to the resolution of the picture.

Every tile has the same number of discs; the four children of a tile halve the distance of its discs. The discs of a
tile are generated from the terrain on demand. Each tile has its own origin, so that float32 positions are accurate to a
millimetre whatever the extent of the terrain.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.gaussians.surfels import Surfels, terrain_surfels
from seasonscapes.terrain.surface import Terrain


@dataclass(frozen=True)
class TileTree:
    """Quadtree over a square that contains the terrain.

    Parameters
    ----------
    west_m, north_m, side_m
        North-west corner and side of the square, ENU [m].
    discs
        Discs along a tile's side.
    levels
        Number of levels: level 0 is one tile; level l has 4ˡ, with discs ``side_m / discs / 2**l`` apart.
    low_m, high_m
        Lowest and highest point of the terrain [m].
    """

    west_m: float
    north_m: float
    side_m: float
    discs: int
    levels: int
    low_m: float
    high_m: float

    def spacing_m(self, level: int) -> float:
        """Return the distance of the discs of a level [m]."""
        return self.side_m / self.discs / 2.0**level


@dataclass(frozen=True, order=True)
class TreeTile:
    """Index of a tile: its level, and row (from the north) and column within the level."""

    level: int
    row: int
    column: int


@dataclass(frozen=True)
class TileDiscs:
    """Discs of a tile.

    Parameters
    ----------
    tile
        Index of the tile.
    origin_m
        ``(3,)`` float64 origin of the tile, ENU [m].
    surfels
        Discs; ``surfels.means`` are relative to ``origin_m``.
    """

    tile: TreeTile
    origin_m: np.ndarray
    surfels: Surfels


def tile_tree(terrain: Terrain, *, finest_m: float, discs: int = 256) -> TileTree:
    """Build the quadtree over a terrain.

    Parameters
    ----------
    terrain
        Mesh, ENU [m].
    finest_m
        Largest distance of discs on the last level [m].
    discs
        Discs along a tile's side.

    Returns
    -------
    TileTree
        Extent and number of levels.

    Raises
    ------
    ValueError
        If ``finest_m`` or ``discs`` is not positive.
    """
    if not finest_m > 0.0 or discs < 1:
        raise ValueError(f"tile_tree: got {finest_m} m and {discs} discs, expected positive numbers")
    low, high = terrain.vertices.min(axis=0).astype(float), terrain.vertices.max(axis=0).astype(float)
    side = float((high - low)[:2].max())
    levels = 1 + max(0, int(np.ceil(np.log2(side / discs / finest_m))))
    return TileTree(float(low[0]), float(high[1]), side, discs, levels, float(low[2]), float(high[2]))


def tile_bounds(tree: TileTree, tile: TreeTile) -> tuple[float, float, float, float]:
    """Return the horizontal bounds of a tile.

    Parameters
    ----------
    tree
        Quadtree of the tile.
    tile
        Index of the tile.

    Returns
    -------
    tuple of float
        West, south, east and north end, ENU [m].
    """
    side = tree.side_m / 2.0**tile.level
    west, north = tree.west_m + tile.column * side, tree.north_m - tile.row * side
    return west, north - side, west + side, north


def select_tiles(tree: TileTree, camera: Camera, *, disc_px: float = 1.0) -> list[TreeTile]:
    """Select the coarsest visible tiles that are fine enough for a picture.

    Parameters
    ----------
    tree
        Quadtree over the terrain.
    camera
        The view.
    disc_px
        Largest distance of a tile's nearest discs in the picture [px]; tiles of the last level may exceed it.

    Returns
    -------
    list of TreeTile
        Disjoint tiles in the view frustum, sorted.

    Raises
    ------
    ValueError
        If ``disc_px`` is not positive.
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
    """Whether a box lies completely outside one of the five planes of the view frustum."""
    corner = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
    x, y, z = ((corner - camera.position_m) @ camera.world_from_camera[:3, :3]).T
    left, right = -camera.cx / camera.fx, (camera.width_px - camera.cx) / camera.fx
    top, bottom = -camera.cy / camera.fy, (camera.height_px - camera.cy) / camera.fy
    outside = (z <= 0.0, x < left * z, x > right * z, y < top * z, y > bottom * z)
    return any(bool(side.all()) for side in outside)


def tile_discs(terrain: Terrain, tree: TileTree, tile: TreeTile, *, normals: np.ndarray | None = None) -> TileDiscs:
    """Make the discs of a tile.

    Parameters
    ----------
    terrain
        Mesh with texture coordinates.
    tree
        Quadtree over the terrain.
    tile
        Index of the tile.
    normals
        ``(V, 3)`` from `terrain.attributes.vertex_normals`, if several tiles are made.

    Returns
    -------
    TileDiscs
        Discs relative to the tile's origin.

    Raises
    ------
    ValueError
        If the terrain covers no cell of the tile; see `surfels.terrain_surfels`.
    """
    bounds = tile_bounds(tree, tile)
    surfels = terrain_surfels(terrain, tree.spacing_m(tile.level), bounds_m=bounds, normals=normals)
    origin = np.array([0.5 * (bounds[0] + bounds[2]), 0.5 * (bounds[1] + bounds[3]), tree.low_m])
    means = surfels.sample_points.mean(axis=1, dtype=np.float64) - origin
    return TileDiscs(tile, origin, replace(surfels, means=means.astype(np.float32)))


def concatenate_tiles(tiles: list[TileDiscs], camera: Camera) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Concatenate the discs of tiles, relative to a camera.

    They are to be rendered by the same camera moved to the origin, so that near discs have small coordinates.

    Parameters
    ----------
    tiles
        At least one tile with its discs.
    camera
        The view.

    Returns
    -------
    tuple of numpy.ndarray
        Means **relative to the camera** ``(N, 3)`` [m], quaternions ``(N, 4)``, log scales ``(N, 3)`` and opacity
        logits ``(N,)``.
    """
    means = [part.surfels.means + (part.origin_m - camera.position_m).astype(np.float32) for part in tiles]
    shapes = [(part.surfels.quaternions, part.surfels.log_scales, part.surfels.opacity_logits) for part in tiles]
    quaternions, log_scales, opacity_logits = (np.concatenate(column) for column in zip(*shapes, strict=True))
    return np.concatenate(means), quaternions, log_scales, opacity_logits
