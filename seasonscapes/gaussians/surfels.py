"""Discs on the terrain: where the Gaussians lie, how they are turned, how large they are, and what colour is under them.

The geometry is known, so it is not learned: one disc for each cell of a square plan, lying on the surface, stretched
along the slope so that steep faces have no holes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.terrain.attributes import vertex_normals
from seasonscapes.terrain.surface import Terrain, sample_texture
from seasonscapes.terrain.texels import barycentric, texel_coordinates, texel_positions

# Standard deviations along the surface over the discs' distance. Below 0.5 holes open; above 0.55 the picture blurs.
SIGMA = 0.52
# Thickness over the distance: 3DGS readers refuse a zero, and a thick disc smears along grazing views.
THICKNESS = 0.03
OPACITY = 0.995
# Cliffs steeper than about 80° would need discs longer than the plan can tell.
_MAX_STRETCH = 5.0
# Places in each cell, a square, that albedo, normal and light are averaged over.
SUBCELLS = 4


@dataclass(frozen=True)
class SurfelGrid:
    """The grid of cells that discs stand for: north-west corner and size of a cell [m], columns and rows."""

    west_m: float
    north_m: float
    east_step_m: float
    north_step_m: float
    columns: int
    rows: int

    @property
    def spacing_m(self) -> float:
        """Mean distance of neighbours."""
        return 0.5 * (self.east_step_m + self.north_step_m)


@dataclass(frozen=True)
class Surfels:
    """N discs on a terrain.

    Parameters
    ----------
    plan, cell
        The grid, and each disc's flat index in it ``(N,)`` int32, rows from the north.
    means
        ``(N, 3)`` float32 ENU [m].
    quaternions
        ``(N, 4)`` float32 wxyz; turn the disc's own axes (down the slope, across it, normal) into ENU.
    log_scales
        ``(N, 3)`` float32, natural logarithms of standard deviations [m] along these axes.
    opacity_logits
        ``(N,)`` float32.
    normals
        ``(N, 3)`` float32 mean of the surface's shading normals over the cell; its length is below 1 where it is rough.
    places
        ``(N, S, 3)`` float32 points of each cell on the surface [m].
    uv
        ``(N, S, 2)`` float32 atlas coordinates of the places.
    """

    plan: SurfelGrid
    cell: np.ndarray
    means: np.ndarray
    quaternions: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    normals: np.ndarray
    places: np.ndarray
    uv: np.ndarray


def terrain_surfels(
    terrain: Terrain,
    spacing_m: float,
    *,
    bounds_m: tuple[float, float, float, float] | None = None,
    normals: np.ndarray | None = None,
) -> Surfels:
    """One disc for each cell of a square plan that the terrain covers entirely.

    Parameters
    ----------
    spacing_m
        Side of a cell [m]; about one pixel on the ground is where the picture stops gaining.
    bounds_m
        West, south, east and north end of the plan; the terrain's own when left out.
    normals
        ``(V, 3)`` from `vertex_normals`, where many plans of one terrain are made.

    Raises
    ------
    ValueError
        A spacing that is not positive, or a plan that holds no cell on the terrain.
    """
    if not spacing_m > 0.0:
        raise ValueError(f"spacing_m: got {spacing_m}, expected a positive distance")
    corners = terrain.vertices[:, :2].astype(np.float64)
    west, south, east, north = bounds_m or (*corners.min(axis=0), *corners.max(axis=0))
    columns, rows = round(float(east - west) / spacing_m), round(float(north - south) / spacing_m)
    if min(columns, rows) < 1:
        raise ValueError(f"spacing_m: got {spacing_m}, but the plan is {min(east - west, north - south):.0f} m wide")
    plan = SurfelGrid(
        float(west), float(north), float(east - west) / columns, float(north - south) / rows, columns, rows
    )
    normals = vertex_normals(terrain) if normals is None else normals
    positions, normals, uv = _cells(_within(terrain, (west, south, east, north)), plan, normals)
    whole = np.isfinite(positions).all(axis=(1, 2))
    if not whole.any():
        raise ValueError("terrain_surfels: the terrain covers no cell")
    positions, normals, uv = positions[whole], normals[whole], uv[whole]
    means = positions.mean(axis=1, dtype=np.float64).astype(np.float32)
    mean_normal = normals.mean(axis=1)
    shape = disc_shapes(mean_normal, plan.spacing_m)
    return Surfels(
        plan, np.flatnonzero(whole).astype(np.int32), means, *shape, mean_normal.astype(np.float32), positions, uv
    )


def _within(terrain: Terrain, bounds_m: tuple[float, float, float, float]) -> Terrain:
    """The faces of a terrain whose boxes meet a rectangle, with all vertices (so that their normals stay)."""
    west, south, east, north = bounds_m
    x, y = terrain.vertices[:, 0][terrain.faces], terrain.vertices[:, 1][terrain.faces]
    meet = (x.max(1) >= west) & (x.min(1) <= east) & (y.max(1) >= south) & (y.min(1) <= north)
    return terrain if meet.all() else replace(terrain, faces=terrain.faces[meet])


def disc_shapes(normals: np.ndarray, spacing_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Quaternions, logarithms of scales and opacity logits of discs that lie on a surface with normals ``(N, 3)``."""
    axes, stretch = _disc_axes(normals)
    scales = np.stack([SIGMA * stretch, np.full(len(stretch), SIGMA), np.full(len(stretch), THICKNESS)], axis=1)
    logit = np.log(OPACITY / (1.0 - OPACITY))
    return (
        quaternions_from_axes(axes).astype(np.float32),
        np.log(scales * spacing_m).astype(np.float32),
        np.full(len(stretch), logit, np.float32),
    )


def _cells(terrain: Terrain, plan: SurfelGrid, at_vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Positions, normals and atlas coordinates ``(cells, S, ...)`` of places in a plan's cells; NaN off the terrain."""
    width, height = plan.columns, plan.rows
    low = np.array([plan.west_m, plan.north_m - height * plan.north_step_m])
    flat = (terrain.vertices[:, :2] - low) / [width * plan.east_step_m, height * plan.north_step_m]
    above = replace(terrain, uv=flat)
    columns, rows = width * SUBCELLS, height * SUBCELLS
    positions, face_id = texel_positions(above, columns, rows)
    normals, uv = np.zeros((rows * columns, 3), np.float32), np.zeros((rows * columns, 2), np.float32)
    covered = np.flatnonzero(face_id >= 0)
    corners = terrain.faces[face_id.ravel()[covered]]
    centre = np.stack([covered % columns, covered // columns], axis=-1) + 0.5
    share = barycentric(texel_coordinates(flat, columns, rows)[corners], centre)
    normal = np.einsum("nk,nkc->nc", share, at_vertices[corners])
    normals[covered] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    uv[covered] = np.einsum("nk,nkc->nc", share, terrain.uv[corners])

    def by_cell(values: np.ndarray) -> np.ndarray:
        split = values.reshape(height, SUBCELLS, width, SUBCELLS, -1).swapaxes(1, 2)
        return split.reshape(height * width, SUBCELLS**2, -1)

    return by_cell(positions), by_cell(normals), by_cell(uv)


def _disc_axes(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axes of discs as columns ``(N, 3, 3)`` (down the slope, across it, normal) and stretch along the slope ``(N,)``."""
    up = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    across = np.stack([-up[:, 1], up[:, 0], np.zeros(len(up))], axis=1)
    length = np.linalg.norm(across, axis=1, keepdims=True)
    across = np.where(length > 1e-6, across / np.maximum(length, 1e-6), [0.0, 1.0, 0.0])
    down = np.cross(across, up)
    return np.stack([down, across, up], axis=2), np.minimum(1.0 / np.maximum(up[:, 2], 1e-3), _MAX_STRETCH)


def quaternions_from_axes(axes: np.ndarray) -> np.ndarray:
    """Unit quaternions ``(N, 4)`` wxyz, w not negative, of rotations ``(N, 3, 3)``."""
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(axes).as_quat(canonical=True), 1, axis=1)


def axes_from_quaternions(quaternions: np.ndarray) -> np.ndarray:
    """Rotations ``(N, 3, 3)`` of quaternions ``(N, 4)`` wxyz of any length."""
    w, x, y, z = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    return np.stack(
        [
            1 - 2 * (y * y + z * z),
            2 * (x * y - w * z),
            2 * (x * z + w * y),
            2 * (x * y + w * z),
            1 - 2 * (x * x + z * z),
            2 * (y * z - w * x),
            2 * (x * z - w * y),
            2 * (y * z + w * x),
            1 - 2 * (x * x + y * y),
        ],
        axis=1,
    ).reshape(-1, 3, 3)


def surfel_albedo(surfels: Surfels, albedo: np.ndarray) -> np.ndarray:
    """Mean of an albedo texture ``(R, S, 3)`` over each disc's cell, ``(N, 3)`` float32 in [0, 1].

    Raises
    ------
    ValueError
        Where the texture is not finite under the discs.
    """
    total = np.zeros((len(surfels.means), 3))
    for place in range(surfels.uv.shape[1]):
        total += sample_texture(albedo, surfels.uv[:, place])
    mean = total / surfels.uv.shape[1]
    if not np.isfinite(mean).all():
        raise ValueError("surfel_albedo: the albedo has values that are not finite; fill its gaps first")
    return np.clip(mean, 0.0, 1.0).astype(np.float32)
