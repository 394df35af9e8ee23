"""Rasterisation of a mesh in UV space: covering face, surface position and barycentric coordinates of texels."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from seasonscapes.terrain.surface import Terrain

_CHUNK_FACES = 1_000_000
_CHUNK_TEXELS = 1_000_000


def _spans(x: np.ndarray, y: np.ndarray, width: int, height: int) -> tuple[np.ndarray, ...]:
    """Scanline spans of texel centres inside triangles ``(N, 3)``: triangle, row, first column, end column.

    Coordinates are shifted so that texel centres are integers. Both triangles of an edge compute its intersection with
    a row from the same end points in the same order, and spans are half open: every texel centre inside a mesh belongs
    to exactly one of its triangles.
    """
    (x0, y0), (x1, y1), (x2, y2) = _upwards(x, y)
    first = np.clip(np.ceil(y0), 0, height).astype(np.int64)
    end = np.clip(np.ceil(y2), 0, height).astype(np.int64)
    count = np.maximum(end - first, 0)
    triangle = np.repeat(np.arange(len(x)), count)
    row = np.arange(len(triangle)) + np.repeat(first - (np.cumsum(count) - count), count)
    # Of the two short edges a row meets the one on its side of the middle corner.
    second = (row >= y1[triangle]) * np.intp(len(x)) + triangle

    def crossing(ends: Sequence[np.ndarray], edge: np.ndarray) -> np.ndarray:
        # Rows intersect only edges with y_i <= row < y_j: results of a division by zero are never used.
        xi, yi, xj, yj = (each[edge] for each in ends)
        with np.errstate(divide="ignore", invalid="ignore"):
            return xi + (row - yi) / (yj - yi) * (xj - xi)

    short = crossing([np.concatenate(ends) for ends in ((x0, x1), (y0, y1), (x1, x2), (y1, y2))], second)
    long = crossing((x0, y0, x2, y2), triangle)
    left = np.clip(np.ceil(np.minimum(short, long)), 0, width).astype(np.int64)
    right = np.clip(np.ceil(np.maximum(short, long)), 0, width).astype(np.int64)
    keep = right > left
    return triangle[keep], row[keep], left[keep], right[keep]


def _upwards(x: np.ndarray, y: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """The corners of triangles ``(N, 3)`` by increasing y, those of equal y by x: three pairs ``(N,)``."""
    corners = [(np.ascontiguousarray(x[:, k]), np.ascontiguousarray(y[:, k])) for k in range(3)]
    for i, j in ((0, 1), (1, 2), (0, 1)):
        (xi, yi), (xj, yj) = corners[i], corners[j]
        swap = (yi > yj) | ((yi == yj) & (xi > xj))
        corners[i] = np.where(swap, xj, xi), np.where(swap, yj, yi)
        corners[j] = np.where(swap, xi, xj), np.where(swap, yi, yj)
    return corners


def _covered(xy: np.ndarray, faces: np.ndarray, width: int, height: int) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield pairs of flat texel index and covering face index, in chunks."""
    for start in range(0, len(faces), _CHUNK_FACES):
        corners = np.asarray(xy[faces[start : start + _CHUNK_FACES]], np.float64) - 0.5
        triangle, row, left, right = _spans(corners[..., 0], corners[..., 1], width, height)
        length = right - left
        ends = np.cumsum(length)
        # A few large triangles can cover all texels: split the list of spans to bound the memory.
        cuts = np.searchsorted(ends, np.arange(0, ends[-1] if len(ends) else 0, 4 * _CHUNK_TEXELS)[1:])
        for part in np.split(np.arange(len(length)), np.unique(cuts)):
            n = length[part]
            offset = np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n)
            yield np.repeat(row[part] * width + left[part], n) + offset, np.repeat(triangle[part] + start, n)


def covering_faces(xy: np.ndarray, faces: np.ndarray, width: int, height: int) -> np.ndarray:
    """Find the face that covers each texel centre.

    Parameters
    ----------
    xy
        ``(V, 2)`` column and row of the vertices [texels]; the first texel's centre is (0.5, 0.5).
    faces
        ``(F, 3)`` vertex indices. Where faces overlap, the one with the largest index is returned.
    width, height
        Size of the texture [texels].

    Returns
    -------
    numpy.ndarray
        ``(height, width)`` int32 face index, −1 for uncovered texels.
    """
    face_id = np.full(width * height, -1, np.int32)
    for texel, face in _covered(xy, faces, width, height):
        face_id[texel] = face
    return face_id.reshape(height, width)


def coverage_count(xy: np.ndarray, faces: np.ndarray, width: int, height: int) -> np.ndarray:
    """Count the faces that cover each texel centre; 0 or 1 everywhere for an injective atlas.

    Parameters
    ----------
    xy, faces, width, height
        As in `covering_faces`.

    Returns
    -------
    numpy.ndarray
        ``(height, width)`` int32 number of faces.
    """
    count = np.zeros(width * height, np.int32)
    for texel, _ in _covered(xy, faces, width, height):
        np.add.at(count, texel, 1)
    return count.reshape(height, width)


def texel_coordinates(uv: np.ndarray, width: int, height: int) -> np.ndarray:
    """Convert UV coordinates to texel coordinates.

    Parameters
    ----------
    uv
        ``(..., 2)`` in [0, 1]; v = 1 is the upper edge of row 0.
    width, height
        Size of the texture [texels].

    Returns
    -------
    numpy.ndarray
        Column and row ``(..., 2)`` float64; the first texel's centre is (0.5, 0.5).
    """
    uv = np.asarray(uv, np.float64)
    return np.stack([uv[..., 0] * width, (1.0 - uv[..., 1]) * height], axis=-1)


def texel_positions(terrain: Terrain, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute the surface position of each texel centre.

    Parameters
    ----------
    terrain
        Surface with UV coordinates.
    width, height
        Size of the texture [texels].

    Returns
    -------
    positions
        ``(height, width, 3)`` float32 east-north-up [m]; NaN for uncovered texels.
    face_id
        ``(height, width)`` int32 index of the covering face, −1 for uncovered texels.
    """
    xy = texel_coordinates(terrain.uv, width, height)
    face_id = covering_faces(xy, terrain.faces, width, height)
    start_m, across, down = face_gradients(terrain.vertices, terrain.faces, xy)
    positions = np.full((height, width, 3), np.nan, np.float32)
    flat, texel = positions.reshape(-1, 3), np.flatnonzero(face_id >= 0)
    for start in range(0, len(texel), _CHUNK_TEXELS):
        part = texel[start : start + _CHUNK_TEXELS]
        face, (row, column) = face_id.ravel()[part], np.divmod(part, width)
        flat[part] = start_m[face] + across[face] * (column + 0.5)[:, None] + down[face] * (row + 0.5)[:, None]
    return positions, face_id


def face_corners(faces: np.ndarray) -> list[np.ndarray]:
    """The columns ``(F,)`` of faces ``(F, 3)``, each contiguous: work on rows of two or three numbers costs several times as much."""
    return [np.ascontiguousarray(faces[:, k]) for k in range(3)]


def changes_on_faces(column: np.ndarray, corners: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A quantity ``(V,)`` of vertices at the first corners of faces, and its changes from there to the two others.

    Parameters
    ----------
    column
        ``(V,)``.
    corners
        From `face_corners`.

    Returns
    -------
    first, to_second, to_third
        ``(F,)`` float64 each.
    """
    first, second, third = (np.asarray(column[corner], np.float64) for corner in corners)
    return first, second - first, third - first


def face_gradients(values: np.ndarray, faces: np.ndarray, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Express a quantity that is linear over each face as a function of the texel.

    Parameters
    ----------
    values
        ``(V, C)`` at the vertices.
    faces
        ``(F, 3)`` vertex indices.
    xy
        ``(V, 2)`` column and row of the vertices [texels].

    Returns
    -------
    start, across, down
        ``(F, C)`` float64 each: the value at texel coordinates 0, and its change by column and by row.
    """
    corners = face_corners(faces)
    (x0, x1, x2), (y0, y1, y2) = (changes_on_faces(xy[:, axis], corners) for axis in (0, 1))
    determinant = x1 * y2 - y1 * x2
    # Faces of zero UV area cover no texel.
    determinant[determinant == 0.0] = np.inf
    start, across, down = (np.empty((len(faces), values.shape[1])) for _ in range(3))
    for channel in range(values.shape[1]):
        v0, v1, v2 = changes_on_faces(values[:, channel], corners)
        by_column, by_row = (v1 * y2 - v2 * y1) / determinant, (v2 * x1 - v1 * x2) / determinant
        across[:, channel], down[:, channel] = by_column, by_row
        start[:, channel] = v0 - by_column * x0 - by_row * y0
    return start, across, down


def covered_share(terrain: Terrain, weight: np.ndarray) -> float:
    """Share of a surface's texels that have a weight, counted on at most 512 × 512 of them.

    Parameters
    ----------
    terrain
        Surface with UV coordinates.
    weight
        ``(H, W)``; 0 where a texture does not reach.

    Returns
    -------
    float
        In [0, 1].
    """
    rows, columns = (min(side, 512) for side in weight.shape)
    on_surface = covering_faces(texel_coordinates(terrain.uv, columns, rows), terrain.faces, columns, rows) >= 0
    row = (np.arange(rows) + 0.5) * weight.shape[0] / rows
    column = (np.arange(columns) + 0.5) * weight.shape[1] / columns
    covered = weight[np.ix_(row.astype(int), column.astype(int))] > 0.0
    return float(covered[on_surface].mean()) if on_surface.any() else 1.0


def barycentric(corners: np.ndarray, point: np.ndarray) -> np.ndarray:
    """Compute barycentric coordinates, clipped to the triangle.

    Parameters
    ----------
    corners
        Triangles ``(N, 3, 2)``.
    point
        Points ``(N, 2)``.

    Returns
    -------
    numpy.ndarray
        ``(N, 3)`` weights that sum to 1; equal weights for degenerate triangles.
    """
    a, b, c = (corners[:, k] - point for k in range(3))
    weights = np.stack([_cross(b, c), _cross(c, a), _cross(a, b)], axis=-1)
    total = weights.sum(axis=1, keepdims=True)
    weights = np.clip(weights / np.where(total == 0.0, 1.0, total), 0.0, 1.0)
    weights[total[:, 0] == 0.0] = 1.0
    return weights / weights.sum(axis=1, keepdims=True)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]
