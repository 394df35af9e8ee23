"""Partition of a texture atlas into tiles: surface points under the texels of a tile, and a coarse viewshed in texels.

Each texel is painted independently of its neighbours, so tiles need no halo, and neither their size nor their order
changes the result.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from seasonscapes.terrain.atlas import Atlas
from seasonscapes.terrain.surface import Terrain
from seasonscapes.terrain.texels import barycentric, covering_faces, texel_coordinates

TILE_PX = 1024
# Side of the blocks of texels in which the coarse viewshed is stored.
BLOCK_PX = 32
# Neighbouring pixels farther apart than this in the atlas lie on two sides of a silhouette [blocks].
_SILHOUETTE_BLOCKS = 8.0
_CHUNK_FACES = 1_000_000


@dataclass(frozen=True)
class AtlasTile:
    """A rectangle of texels.

    Parameters
    ----------
    row, column
        Of its first texel in the atlas.
    height, width
        Its size [texels].
    """

    row: int
    column: int
    height: int
    width: int

    @property
    def window(self) -> tuple[slice, slice]:
        """Row and column slices of the tile in the atlas."""
        return slice(self.row, self.row + self.height), slice(self.column, self.column + self.width)

    @property
    def name(self) -> str:
        """Stem of a file that stores the tile."""
        return f"tile-{self.row:06d}-{self.column:06d}"


@dataclass(frozen=True)
class TexelSurface:
    """Surface points under the N texels of a tile that a face covers.

    Parameters
    ----------
    texel
        ``(N,)`` flat index in the tile.
    face
        ``(N,)`` int32 index of the face that covers the texel's centre.
    position_m
        ``(N, 3)`` float64 ENU of the centre on that face.
    normal
        ``(N, 3)`` float32 unit normal of the face.
    texel_m
        ``(N,)`` float32 side of a square with the texel's area on the surface [m].
    """

    texel: np.ndarray
    face: np.ndarray
    position_m: np.ndarray
    normal: np.ndarray
    texel_m: np.ndarray

    def __getitem__(self, key: np.ndarray | slice) -> TexelSurface:
        """Return the texels selected by an index array, mask or slice."""
        return TexelSurface(*(getattr(self, name)[key] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class AtlasTiling:
    """Partition of an atlas into square tiles, with the tiles that each face touches.

    Parameters
    ----------
    terrain
        The surface that the atlas belongs to.
    width_px, height_px
        Size of the atlas [texels].
    tile_px
        Side of a tile [texels].
    reach
        ``(F, 4)`` int16: first and last row, first and last column of the tiles that each face touches.
    """

    terrain: Terrain
    width_px: int
    height_px: int
    tile_px: int
    reach: np.ndarray


def tiling(terrain: Terrain, atlas: Atlas, *, tile_px: int = TILE_PX) -> AtlasTiling:
    """Partition an atlas into tiles. Takes 8 bytes of memory per face.

    Parameters
    ----------
    terrain
        The surface with its texture coordinates.
    atlas
        Size of the atlas.
    tile_px
        Side of a tile [texels].

    Returns
    -------
    AtlasTiling
        The tiles and the faces that touch them.

    Raises
    ------
    ValueError
        ``tile_px`` is less than 1.
    """
    if tile_px < 1:
        raise ValueError(f"tile_px: got {tile_px}, expected at least 1")
    reach = np.empty((len(terrain.faces), 4), np.int16)
    for start in range(0, len(reach), _CHUNK_FACES):
        faces = terrain.faces[start : start + _CHUNK_FACES]
        corners = texel_coordinates(terrain.uv[faces], atlas.width_px, atlas.height_px) / tile_px
        low, high = np.floor(corners.min(axis=1)), np.floor(corners.max(axis=1))
        reach[start : start + len(faces)] = np.stack([low[:, 1], high[:, 1], low[:, 0], high[:, 0]], axis=1)
    return AtlasTiling(terrain, atlas.width_px, atlas.height_px, tile_px, reach)


def tiles_of(atlas_tiling: AtlasTiling) -> Iterator[AtlasTile]:
    """Yield the tiles row by row.

    Parameters
    ----------
    atlas_tiling
        From `tiling`.

    Yields
    ------
    AtlasTile
        Tiles at the right and lower border may be smaller.
    """
    for row in range(0, atlas_tiling.height_px, atlas_tiling.tile_px):
        for column in range(0, atlas_tiling.width_px, atlas_tiling.tile_px):
            yield AtlasTile(
                row,
                column,
                min(atlas_tiling.tile_px, atlas_tiling.height_px - row),
                min(atlas_tiling.tile_px, atlas_tiling.width_px - column),
            )


def tile_surface(atlas_tiling: AtlasTiling, tile: AtlasTile) -> TexelSurface:
    """Return the surface points under a tile's texels.

    Positions are float64: rounding to float32 displaces a point 30 km from the origin by 2 mm.

    Parameters
    ----------
    atlas_tiling
        From `tiling`.
    tile
        One of its tiles.

    Returns
    -------
    TexelSurface
        The texels whose centre a face covers.
    """
    i, j = tile.row // atlas_tiling.tile_px, tile.column // atlas_tiling.tile_px
    reach, terrain = atlas_tiling.reach, atlas_tiling.terrain
    candidate = np.flatnonzero((reach[:, 0] <= i) & (reach[:, 1] >= i) & (reach[:, 2] <= j) & (reach[:, 3] >= j))
    faces = terrain.faces[candidate]
    vertex, local = np.unique(faces, return_inverse=True)
    local = local.reshape(faces.shape)
    xy = texel_coordinates(terrain.uv[vertex], atlas_tiling.width_px, atlas_tiling.height_px) - [tile.column, tile.row]
    covering = covering_faces(xy, local, tile.width, tile.height).ravel()
    texel = np.flatnonzero(covering >= 0)
    face = covering[texel]
    corners_m = terrain.vertices[vertex].astype(np.float64)[local]
    area_normal = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    double_area_m2 = np.linalg.norm(area_normal, axis=1)
    a, b = xy[local[:, 1]] - xy[local[:, 0]], xy[local[:, 2]] - xy[local[:, 0]]
    double_area_px = np.maximum(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), 1e-12)
    normal = (area_normal / np.maximum(double_area_m2, 1e-30)[:, None]).astype(np.float32)
    side_m = np.sqrt(double_area_m2 / double_area_px).astype(np.float32)
    centre = np.stack([texel % tile.width, texel // tile.width], axis=-1) + 0.5
    coordinates = barycentric(xy[local[face]], centre)
    position = np.einsum("nk,nkc->nc", coordinates, corners_m[face])
    return TexelSurface(texel.astype(np.int64), candidate[face].astype(np.int32), position, normal[face], side_m[face])


def visible_blocks(uv: np.ndarray, atlas_tiling: AtlasTiling) -> np.ndarray:
    """Compute the coarse viewshed of a camera: the blocks of texels that may be visible from it.

    Parameters
    ----------
    uv
        ``(H, W, 2)`` texture coordinates of the camera's G-buffer, NaN in the sky.
    atlas_tiling
        From `tiling`.

    Returns
    -------
    ndarray
        ``(rows, columns)`` bool, one element per block of `BLOCK_PX` × `BLOCK_PX` texels.

    Notes
    -----
    On slopes at grazing incidence, neighbouring pixels may lie several blocks apart; the blocks between two such pixels
    are marked too. Pixels more than eight blocks apart are taken to be separated by a silhouette.
    """
    shape = (-(-atlas_tiling.height_px // BLOCK_PX), -(-atlas_tiling.width_px // BLOCK_PX))
    blocks = np.zeros(shape, np.uint8)
    xy = texel_coordinates(uv, atlas_tiling.width_px, atlas_tiling.height_px) / BLOCK_PX
    finite = np.asarray(np.isfinite(xy).all(axis=-1))
    connected = finite[:-1] & finite[1:] & (np.abs(xy[1:] - xy[:-1]).max(axis=-1) < _SILHOUETTE_BLOCKS)
    for fraction in np.linspace(0.0, 1.0, 9):
        between = (1.0 - fraction) * xy[:-1][connected] + fraction * xy[1:][connected]
        _mark(blocks, between)
    _mark(blocks, xy[finite])
    return cv2.dilate(blocks, np.ones((3, 3), np.uint8)).astype(bool)


def _mark(blocks: np.ndarray, xy: np.ndarray) -> None:
    column, row = xy.astype(np.int64).T
    blocks[np.clip(row, 0, blocks.shape[0] - 1), np.clip(column, 0, blocks.shape[1] - 1)] = 1


def tile_blocks(blocks: np.ndarray, tile: AtlasTile, texel: np.ndarray) -> np.ndarray:
    """Return whether each texel lies in a visible block.

    Parameters
    ----------
    blocks
        ``(rows, columns)`` bool from `visible_blocks`.
    tile
        The tile that the indices refer to.
    texel
        ``(N,)`` flat indices in the tile.

    Returns
    -------
    ndarray
        ``(N,)`` bool.
    """
    row, column = tile.row + texel // tile.width, tile.column + texel % tile.width
    return blocks[row // BLOCK_PX, column // BLOCK_PX]


def is_tile_visible(blocks: np.ndarray, tile: AtlasTile) -> bool:
    """Return whether any block of a tile is visible.

    Parameters
    ----------
    blocks
        ``(rows, columns)`` bool from `visible_blocks`.
    tile
        The tile.

    Returns
    -------
    bool
        True if at least one block is marked.
    """
    last_row, last_column = tile.row + tile.height - 1, tile.column + tile.width - 1
    return bool(
        blocks[
            tile.row // BLOCK_PX : last_row // BLOCK_PX + 1, tile.column // BLOCK_PX : last_column // BLOCK_PX + 1
        ].any()
    )
