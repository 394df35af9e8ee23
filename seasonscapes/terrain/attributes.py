"""What the weather meets on the ground: how high places lie, how they face, and whether they are hollow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.terrain.surface import Terrain
from seasonscapes.terrain.texels import barycentric, texel_coordinates, texel_positions

# Hollows are seen against land this far around; a plan finer than this shows them no better [m].
_HOLLOW_M, _FINEST_M = 90.0, 15.0


@dataclass(frozen=True)
class TerrainAttributes:
    """N places on the land.

    Parameters
    ----------
    height_m
        ``(N,)`` [m].
    normal
        ``(N, 3)`` unit normals, ENU.
    concavity_m
        ``(N,)`` depth below the land around [m].
    """

    height_m: np.ndarray
    normal: np.ndarray
    concavity_m: np.ndarray


def attributes_at(position_m: np.ndarray, normal: np.ndarray, spacing_m: float) -> TerrainAttributes:
    """The ground at places ``(N, 3)`` ENU [m] about ``spacing_m`` apart, with normals ``(N, 3)`` of any length."""
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    height = position_m[:, 2:].astype(np.float32)
    around = plan_blur(position_m, height, max(spacing_m, _FINEST_M), _HOLLOW_M)
    return TerrainAttributes(height[:, 0], unit.astype(np.float32), (around - height)[:, 0])


def texel_attributes(terrain: Terrain, shape: tuple[int, int]) -> tuple[TerrainAttributes, np.ndarray]:
    """The ground under the texels of a texture of ``shape``, and the flat index ``(N,)`` of those that lie on it."""
    height, width = shape
    position, face_id = texel_positions(terrain, width, height)
    texel = np.flatnonzero(face_id >= 0)
    corners = terrain.faces[face_id.ravel()[texel]]
    centre = np.stack([texel % width, texel // width], axis=-1) + 0.5
    share = barycentric(texel_coordinates(terrain.uv, width, height)[corners], centre)
    normal = np.einsum("nk,nkc->nc", share, vertex_normals(terrain)[corners])
    area_m2 = float(np.prod(np.ptp(terrain.vertices[:, :2].astype(np.float64), axis=0)))
    return attributes_at(position.reshape(-1, 3)[texel], normal, np.sqrt(area_m2 / max(len(texel), 1))), texel


def vertex_normals(terrain: Terrain) -> np.ndarray:
    """Unit normals ``(V, 3)``: means of the faces around, weighted by their angles (Thürmer & Wüthrich 1998)."""
    corner = terrain.vertices[terrain.faces].astype(np.float64)
    face = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    face /= np.maximum(np.linalg.norm(face, axis=1, keepdims=True), 1e-30)
    total = np.zeros((len(terrain.vertices), 3))
    for k in range(3):
        a, b = corner[:, (k + 1) % 3] - corner[:, k], corner[:, (k + 2) % 3] - corner[:, k]
        cosine = np.einsum("nc,nc->n", a, b) / np.maximum(np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1), 1e-30)
        angle = np.arccos(np.clip(cosine, -1.0, 1.0))
        for axis in range(3):
            total[:, axis] += np.bincount(terrain.faces[:, k], angle * face[:, axis], minlength=len(total))
    return (total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)).astype(np.float32)


def plan_blur(position_m: np.ndarray, values: np.ndarray, spacing_m: float, sigma_m: float) -> np.ndarray:
    """Values ``(N, C)`` at places ``(N, 3)`` averaged in plan, weighted by a Gaussian of ``sigma_m``."""
    import cv2

    cell = np.floor((position_m[:, :2] - position_m[:, :2].min(axis=0)) / spacing_m + 0.5).astype(int)
    shape = cell.max(axis=0)[::-1] + 1
    grid, count = np.zeros((*shape, values.shape[1]), np.float32), np.zeros(shape, np.float32)
    np.add.at(grid, (cell[:, 1], cell[:, 0]), values)
    np.add.at(count, (cell[:, 1], cell[:, 0]), 1.0)
    sigma = sigma_m / spacing_m
    wide = cv2.GaussianBlur(grid, (0, 0), sigma).reshape(grid.shape)
    mean = wide / np.maximum(cv2.GaussianBlur(count, (0, 0), sigma), 1e-6)[..., None]
    return mean[cell[:, 1], cell[:, 0]]
