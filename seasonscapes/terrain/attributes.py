"""Terrain attributes at surface points: height, unit normal and concavity."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.terrain.surface import Terrain
from seasonscapes.terrain.texels import barycentric, face_corners, texel_coordinates, texel_positions

# Standard deviation of the Gaussian mean height that concavity refers to, and smallest cell of its grid [m].
_CONCAVITY_SIGMA_M, _MIN_SPACING_M = 90.0, 15.0


@dataclass(frozen=True)
class TerrainAttributes:
    """Terrain attributes at N surface points.

    Parameters
    ----------
    height_m
        ``(N,)`` up coordinate [m].
    normal
        ``(N, 3)`` unit normals, east-north-up.
    concavity_m
        ``(N,)`` Gaussian-weighted mean height of the surroundings minus the point's own height [m]; positive in hollows.
    """

    height_m: np.ndarray
    normal: np.ndarray
    concavity_m: np.ndarray


def attributes_at(position_m: np.ndarray, normal: np.ndarray, spacing_m: float | np.ndarray) -> TerrainAttributes:
    """Compute terrain attributes at given surface points.

    Parameters
    ----------
    position_m
        ``(N, 3)`` points on the surface, east-north-up [m].
    normal
        ``(N, 3)`` surface normals of any length.
    spacing_m
        Typical distance between neighbouring points [m], ``(N,)`` or one for all.

    Returns
    -------
    TerrainAttributes
        Attributes of the N points, float32.
    """
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    height = position_m[:, 2:].astype(np.float32)
    spacing_m = spacing_m * max(1.0, _MIN_SPACING_M / float(np.max(spacing_m)))
    mean_height = horizontal_gaussian_mean(position_m, height, spacing_m, _CONCAVITY_SIGMA_M)
    return TerrainAttributes(height[:, 0], unit.astype(np.float32), (mean_height - height)[:, 0])


def texel_attributes(terrain: Terrain, shape: tuple[int, int]) -> tuple[TerrainAttributes, np.ndarray]:
    """Compute terrain attributes at the texel centres of a texture.

    Parameters
    ----------
    terrain
        Surface with UV coordinates.
    shape
        Rows and columns of the texture.

    Returns
    -------
    attributes
        Attributes of the N texels that a face covers.
    texel
        Flat index ``(N,)`` of these texels in a texture of ``shape``.
    """
    height, width = shape
    position, face_id = texel_positions(terrain, width, height)
    texel = np.flatnonzero(face_id >= 0)
    corners = terrain.faces[face_id.ravel()[texel]]
    centre = np.stack([texel % width, texel // width], axis=-1) + 0.5
    weights = barycentric(texel_coordinates(terrain.uv, width, height)[corners], centre)
    if terrain.surface is None:
        normal = np.einsum("nk,nkc->nc", weights, vertex_normals(terrain)[corners])
    else:
        normal = terrain.surface.sample(position.reshape(-1, 3)[texel])[1]
    area_m2 = float(np.prod(np.ptp(terrain.vertices[:, :2].astype(np.float64), axis=0)))
    return attributes_at(position.reshape(-1, 3)[texel], normal, np.sqrt(area_m2 / max(len(texel), 1))), texel


def vertex_normals(terrain: Terrain) -> np.ndarray:
    """Compute vertex normals as angle-weighted means of the adjacent face normals (Thürmer & Wüthrich 1998).

    Parameters
    ----------
    terrain
        The surface.

    Returns
    -------
    numpy.ndarray
        Unit normals ``(V, 3)`` float32, east-north-up.
    """
    corners = face_corners(terrain.faces)
    place = [[np.take(axis, corner) for axis in terrain.vertices.T.astype(np.float64)] for corner in corners]
    # Edge k leads from corner k to the next one.
    edges = [[b - a for a, b in zip(place[k], place[(k + 1) % 3], strict=True)] for k in range(3)]
    lengths = [np.sqrt(_dot(edge, edge)) for edge in edges]
    (x0, y0, z0), (x1, y1, z1) = edges[0], edges[1]
    face = [y0 * z1 - z0 * y1, z0 * x1 - x0 * z1, x0 * y1 - y0 * x1]
    length = np.maximum(np.sqrt(_dot(face, face)), 1e-30)
    face = [axis / length for axis in face]
    total = np.zeros((len(terrain.vertices), 3))
    for k in range(3):
        cosine = -_dot(edges[k], edges[k - 1]) / np.maximum(lengths[k] * lengths[k - 1], 1e-30)
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        for axis in range(3):
            total[:, axis] += np.bincount(corners[k], angle * face[axis], minlength=len(total))
    return (total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)).astype(np.float32)


def _dot(a: list[np.ndarray], b: list[np.ndarray]) -> np.ndarray:
    """Dot products ``(F,)`` of vectors given as three columns."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def horizontal_gaussian_mean(
    position_m: np.ndarray, values: np.ndarray, spacing_m: float | np.ndarray, sigma_m: float
) -> np.ndarray:
    """Smooth scattered values with a horizontal Gaussian kernel (normalised convolution on a grid).

    Values are binned into square cells; the Gaussian of the sums is divided by the Gaussian of the counts. Points weigh as the
    areas that they stand for.

    Parameters
    ----------
    position_m
        ``(N, 3)`` points, east-north-up [m]; heights are not used.
    values
        ``(N, C)`` values at the points.
    spacing_m
        Distance between neighbouring points [m], ``(N,)`` or one for all; the largest is the cell size of the grid.
    sigma_m
        Standard deviation of the Gaussian [m].

    Returns
    -------
    numpy.ndarray
        ``(N, C)`` float32 smoothed values at the same points.
    """
    import cv2

    cell_m = float(np.max(spacing_m))
    cell = np.floor((position_m[:, :2] - position_m[:, :2].min(axis=0)) / cell_m + 0.5).astype(int)
    shape = cell.max(axis=0)[::-1] + 1
    grid, count = np.zeros((*shape, values.shape[1]), np.float32), np.zeros(shape, np.float32)
    share = np.broadcast_to(np.square(spacing_m / cell_m), (len(values),))
    np.add.at(grid, (cell[:, 1], cell[:, 0]), share[:, None] * values)
    np.add.at(count, (cell[:, 1], cell[:, 0]), share)
    sigma = sigma_m / cell_m
    blurred = cv2.GaussianBlur(grid, (0, 0), sigma).reshape(grid.shape)
    mean = blurred / np.maximum(cv2.GaussianBlur(count, (0, 0), sigma), 1e-6)[..., None]
    return mean[cell[:, 1], cell[:, 0]]
