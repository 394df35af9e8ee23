"""The atlas cut into tiles: what surface lies under the texels of each, and which tiles a camera sees at all.

A texel is painted by itself, from its own place on the surface and the pictures: tiles need no halo, and neither their
size nor their order changes a bit of the result.
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
# Side of the blocks of texels by which a camera's view is known to be seen or hidden.
BLOCK_PX = 32
_CHUNK_FACES = 1_000_000


@dataclass(frozen=True)
class AtlasTile:
    """A rectangle of texels: its first row and column, and its size."""

    row: int
    column: int
    height: int
    width: int

    @property
    def window(self) -> tuple[slice, slice]:
        """Its rows and columns in the atlas."""
        return slice(self.row, self.row + self.height), slice(self.column, self.column + self.width)

    @property
    def name(self) -> str:
        """Of a file that keeps it."""
        return f"tile-{self.row:06d}-{self.column:06d}"


@dataclass(frozen=True)
class TexelSurface:
    """The surface under the N used texels of a tile.

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

    def __getitem__(self, key) -> TexelSurface:
        return TexelSurface(*(getattr(self, name)[key] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class AtlasTiling:
    """The tiles of an atlas and, for each face, the first and last row and column of tiles that it touches."""

    terrain: Terrain
    width_px: int
    height_px: int
    tile_px: int
    reach: np.ndarray  # (F, 4) int16


def tiling(terrain: Terrain, atlas: Atlas, *, tile_px: int = TILE_PX) -> AtlasTiling:
    """Cut an atlas into tiles; memory beyond the terrain is 8 bytes a face."""
    if tile_px < 1:
        raise ValueError(f"tile_px: got {tile_px}, expected at least 1")
    reach = np.empty((len(terrain.faces), 4), np.int16)
    for start in range(0, len(reach), _CHUNK_FACES):
        faces = terrain.faces[start : start + _CHUNK_FACES]
        corners = texel_coordinates(terrain.uv[faces], atlas.width_px, atlas.height_px) / tile_px
        low, high = np.floor(corners.min(axis=1)), np.floor(corners.max(axis=1))
        reach[start : start + len(faces)] = np.stack([low[:, 1], high[:, 1], low[:, 0], high[:, 0]], axis=1)
    return AtlasTiling(terrain, atlas.width_px, atlas.height_px, tile_px, reach)


def tiles_of(cut: AtlasTiling) -> Iterator[AtlasTile]:
    """The tiles, row by row."""
    for row in range(0, cut.height_px, cut.tile_px):
        for column in range(0, cut.width_px, cut.tile_px):
            yield AtlasTile(row, column, min(cut.tile_px, cut.height_px - row), min(cut.tile_px, cut.width_px - column))


def tile_surface(cut: AtlasTiling, tile: AtlasTile) -> TexelSurface:
    """The surface under a tile's texels. Positions are float64: in float32 a texel 30 km away is 2 mm off."""
    i, j = tile.row // cut.tile_px, tile.column // cut.tile_px
    reach, terrain = cut.reach, cut.terrain
    touched = np.flatnonzero((reach[:, 0] <= i) & (reach[:, 1] >= i) & (reach[:, 2] <= j) & (reach[:, 3] >= j))
    faces = terrain.faces[touched]
    vertex, local = np.unique(faces, return_inverse=True)
    local = local.reshape(faces.shape)
    xy = texel_coordinates(terrain.uv[vertex], cut.width_px, cut.height_px) - [tile.column, tile.row]
    covering = covering_faces(xy, local, tile.width, tile.height).ravel()
    texel = np.flatnonzero(covering >= 0)
    own = covering[texel]
    corners_m = terrain.vertices[vertex].astype(np.float64)[local]
    across = np.cross(corners_m[:, 1] - corners_m[:, 0], corners_m[:, 2] - corners_m[:, 0])
    doubled = np.linalg.norm(across, axis=1)
    a, b = xy[local[:, 1]] - xy[local[:, 0]], xy[local[:, 2]] - xy[local[:, 0]]
    in_texels = np.maximum(np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), 1e-12)
    normal = (across / np.maximum(doubled, 1e-30)[:, None]).astype(np.float32)
    side_m = np.sqrt(doubled / in_texels).astype(np.float32)
    centre = np.stack([texel % tile.width, texel // tile.width], axis=-1) + 0.5
    share = barycentric(xy[local[own]], centre)
    position = np.einsum("nk,nkc->nc", share, corners_m[own])
    return TexelSurface(texel.astype(np.int64), touched[own].astype(np.int32), position, normal[own], side_m[own])


def seen_blocks(uv: np.ndarray, cut: AtlasTiling) -> np.ndarray:
    """Blocks of texels that a camera may see, ``(rows, columns)`` bool: the coarse viewshed.

    Parameters
    ----------
    uv
        ``(H, W, 2)`` of the camera's G-buffer, NaN in the sky.

    Notes
    -----
    Neighbouring pixels may lie several blocks apart on slopes that are seen at a grazing angle; the blocks between two
    pixels are seen too, unless a silhouette parts them (they are then beyond eight blocks).
    """
    shape = (-(-cut.height_px // BLOCK_PX), -(-cut.width_px // BLOCK_PX))
    blocks = np.zeros(shape, np.uint8)
    xy = texel_coordinates(uv, cut.width_px, cut.height_px) / BLOCK_PX
    known = np.isfinite(xy).all(axis=-1)
    below = known[:-1] & known[1:] & (np.abs(xy[1:] - xy[:-1]).max(axis=-1) < 8.0)
    for share in np.linspace(0.0, 1.0, 9):
        between = (1.0 - share) * xy[:-1][below] + share * xy[1:][below]
        _mark(blocks, between)
    _mark(blocks, xy[known])
    return cv2.dilate(blocks, np.ones((3, 3), np.uint8)).astype(bool)


def _mark(blocks: np.ndarray, xy: np.ndarray) -> None:
    column, row = xy.astype(np.int64).T
    blocks[np.clip(row, 0, blocks.shape[0] - 1), np.clip(column, 0, blocks.shape[1] - 1)] = 1


def tile_blocks(blocks: np.ndarray, tile: AtlasTile, texel: np.ndarray) -> np.ndarray:
    """Whether each texel (flat indices in the tile) lies in a seen block, ``(N,)`` bool."""
    row, column = tile.row + texel // tile.width, tile.column + texel % tile.width
    return blocks[row // BLOCK_PX, column // BLOCK_PX]


def sees_tile(blocks: np.ndarray, tile: AtlasTile) -> bool:
    """Whether any block of a tile is seen."""
    last_row, last_column = tile.row + tile.height - 1, tile.column + tile.width - 1
    return bool(
        blocks[
            tile.row // BLOCK_PX : last_row // BLOCK_PX + 1, tile.column // BLOCK_PX : last_column // BLOCK_PX + 1
        ].any()
    )
