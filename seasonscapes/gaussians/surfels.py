"""Surfels (discs) on the terrain: positions, rotations and sizes of the Gaussians, and the albedo of their cells.

The geometry is known: one disc per cell of a horizontal grid, in the plane of the mesh within the cell and elongated along the
slope so that steep faces have no holes. Cells may be quartered where a camera sees them near (`disc_density`). Training may
change the discs a little (`disc_geometry`, `CHANGES`).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.terrain.attributes import vertex_normals
from seasonscapes.terrain.surface import Terrain, sample_texture
from seasonscapes.terrain.texels import barycentric, texel_coordinates, texel_positions

# Standard deviation along the surface, relative to the grid spacing. Below 0.5 holes open; above 0.55 the picture
# blurs.
SIGMA = 0.52
# Standard deviation along the normal, relative to the spacing: 3DGS readers reject zero, and thick discs smear at
# grazing angles.
THICKNESS = 0.03
OPACITY = 0.995
# Limit of the elongation, reached on cliffs steeper than about 80°.
_MAX_STRETCH = 5.0
# Changes that training may make to a disc: number of columns, and limit. Place along the disc's axes [spacing of the discs],
# logarithm of the two standard deviations in its plane, angle about its normal [rad], logit of its opacity.
CHANGES = {"offset": (3, 0.5), "stretch": (2, 1.0), "twist": (1, 1.0), "opacity": (1, 6.0)}
# Sample points along a cell's side, over which albedo, normal and light are averaged.
SUBCELLS = 4


@dataclass(frozen=True)
class SurfelGrid:
    """Horizontal grid of the cells of discs.

    Parameters
    ----------
    west_m, north_m
        North-west corner, ENU [m].
    east_step_m, north_step_m
        Size of a cell [m].
    columns, rows
        Number of cells.
    """

    west_m: float
    north_m: float
    east_step_m: float
    north_step_m: float
    columns: int
    rows: int

    @property
    def spacing_m(self) -> float:
        """Mean distance of neighbouring discs [m]."""
        return 0.5 * (self.east_step_m + self.north_step_m)

    def quartered(self, level: int) -> SurfelGrid:
        """The grid whose cells were quartered so many times."""
        parts = 2**level
        steps = (self.east_step_m / parts, self.north_step_m / parts)
        return SurfelGrid(self.west_m, self.north_m, *steps, self.columns * parts, self.rows * parts)

    def spacings_m(self, level: np.ndarray) -> np.ndarray:
        """Mean distance ``(N,)`` of discs from their neighbours of the same level ``(N,)`` [m]."""
        return np.ldexp(np.float32(self.spacing_m), -level.astype(np.int32)).astype(np.float32)


@dataclass(frozen=True)
class Surfels:
    """N discs on a terrain.

    Parameters
    ----------
    grid, level, cell
        The grid, how often each disc's cell was quartered ``(N,)`` uint8, and its flat index in the grid of that level
        (`SurfelGrid.quartered`) ``(N,)`` int64, rows from the north.
    means
        ``(N, 3)`` float32 ENU [m].
    quaternions
        ``(N, 4)`` float32 wxyz; rotate the axes of the disc (down the slope, across it, normal) to ENU.
    log_scales
        ``(N, 3)`` float32, natural logarithms of standard deviations [m] along these axes.
    opacity_logits
        ``(N,)`` float32.
    facing
        ``(N, 3)`` float32 unit normal of the plane through the mesh in the cell, in which the disc lies.
    normals
        ``(N, 3)`` float32 mean shading normal over the cell; its length is below 1 where the surface is rough.
    sample_points
        ``(N, S, 3)`` float32 sample points of each cell on the surface, ENU [m].
    uv
        ``(N, S, 2)`` float32 atlas coordinates of the sample points.
    """

    grid: SurfelGrid
    level: np.ndarray
    cell: np.ndarray
    means: np.ndarray
    quaternions: np.ndarray
    log_scales: np.ndarray
    opacity_logits: np.ndarray
    facing: np.ndarray
    normals: np.ndarray
    sample_points: np.ndarray
    uv: np.ndarray

    @property
    def spacing_m(self) -> np.ndarray:
        """Distance ``(N,)`` of each disc from its neighbours [m]."""
        return self.grid.spacings_m(self.level)


def terrain_surfels(
    terrain: Terrain,
    spacing_m: float,
    *,
    bounds_m: tuple[float, float, float, float] | None = None,
    normals: np.ndarray | None = None,
) -> Surfels:
    """Make one disc for each cell of a horizontal grid that is completely covered by terrain.

    Parameters
    ----------
    terrain
        Mesh with texture coordinates.
    spacing_m
        Side of a cell [m]; below about the size of one pixel on the ground the picture does not improve.
    bounds_m
        West, south, east and north end of the grid [m]; the extent of the terrain if omitted.
    normals
        ``(V, 3)`` from `vertex_normals`, if several grids are made on one terrain.

    Returns
    -------
    Surfels
        N discs.

    Raises
    ------
    ValueError
        If the spacing is not positive or exceeds the grid, or the terrain covers no cell.
    """
    if not spacing_m > 0.0:
        raise ValueError(f"spacing_m: got {spacing_m}, expected a positive distance")
    corners = terrain.vertices[:, :2].astype(np.float64)
    west, south, east, north = bounds_m or (*corners.min(axis=0), *corners.max(axis=0))
    columns, rows = round(float(east - west) / spacing_m), round(float(north - south) / spacing_m)
    if min(columns, rows) < 1:
        raise ValueError(
            f"spacing_m: got {spacing_m}, expected at most the grid's width of {min(east - west, north - south):.0f} m"
        )
    grid = SurfelGrid(
        float(west), float(north), float(east - west) / columns, float(north - south) / rows, columns, rows
    )
    normals = vertex_normals(terrain) if normals is None else normals
    samples = cell_samples(terrain, grid, normals)
    whole = np.isfinite(samples[0]).all(axis=(1, 2))
    if not whole.any():
        raise ValueError(
            "terrain_surfels: the terrain covers no cell completely; use a smaller spacing or other bounds"
        )
    level = np.zeros(int(whole.sum()), np.uint8)
    return surfels_from_cells(grid, level, np.flatnonzero(whole), *(values[whole] for values in samples))


def surfels_from_cells(
    grid: SurfelGrid, level: np.ndarray, cell: np.ndarray, positions: np.ndarray, normals: np.ndarray, uv: np.ndarray
) -> Surfels:
    """Make the discs of cells.

    Parameters
    ----------
    grid, level, cell
        As of `Surfels`.
    positions, normals, uv
        ``(N, S, 3)``, ``(N, S, 3)`` and ``(N, S, 2)`` of the cells' sample points, from `cell_samples`.

    Returns
    -------
    Surfels
        N discs.
    """
    means = positions.mean(axis=1, dtype=np.float64).astype(np.float32)
    facing, mean_normal = plane_normals(positions), normals.mean(axis=1)
    shape = disc_shapes(facing, grid.spacings_m(level))
    return Surfels(
        grid, level, cell.astype(np.int64), means, *shape, facing, mean_normal.astype(np.float32), positions, uv
    )


def plane_normals(positions: np.ndarray) -> np.ndarray:
    """Upward unit normals of the planes that fit heights best.

    Discs in these planes leave no holes. Shading normals, which are smooth from face to face, lean away from the mesh by some
    degrees: seen at grazing angles, discs that follow them turn their backs, or let the land behind shine through.

    Parameters
    ----------
    positions
        ``(N, S, 3)`` points, not all in one vertical plane, ENU [m].

    Returns
    -------
    numpy.ndarray
        ``(N, 3)`` float32.
    """
    x, y, z = np.moveaxis(positions - positions.mean(axis=1, keepdims=True, dtype=np.float64), 2, 0)
    xx, xy, yy = (x * x).sum(1), (x * y).sum(1), (y * y).sum(1)
    xz, yz = (x * z).sum(1), (y * z).sum(1)
    determinant = xx * yy - xy * xy
    east, north = (xz * yy - yz * xy) / determinant, (yz * xx - xz * xy) / determinant
    normal = np.stack([-east, -north, np.ones(len(east))], axis=1)
    return (normal / np.linalg.norm(normal, axis=1, keepdims=True)).astype(np.float32)


def _within(terrain: Terrain, bounds_m: tuple[float, float, float, float]) -> Terrain:
    """Restrict a terrain to faces whose bounding boxes intersect a rectangle; vertices and their order are kept."""
    west, south, east, north = bounds_m
    x, y = terrain.vertices[:, 0][terrain.faces], terrain.vertices[:, 1][terrain.faces]
    inside = (x.max(1) >= west) & (x.min(1) <= east) & (y.max(1) >= south) & (y.min(1) <= north)
    return terrain if inside.all() else replace(terrain, faces=terrain.faces[inside])


def disc_shapes(normals: np.ndarray, spacing_m: float | np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the shapes of discs tangent to a surface.

    Parameters
    ----------
    normals
        ``(N, 3)`` of any length, ENU.
    spacing_m
        Mean distance of neighbouring discs [m], ``(N,)`` or one for all.

    Returns
    -------
    tuple of numpy.ndarray
        Quaternions ``(N, 4)`` wxyz, log scales ``(N, 3)`` and opacity logits ``(N,)``, float32.
    """
    axes, stretch = _disc_axes(normals)
    scales = np.stack([SIGMA * stretch, np.full(len(stretch), SIGMA), np.full(len(stretch), THICKNESS)], axis=1)
    logit = np.log(OPACITY / (1.0 - OPACITY))
    return (
        quaternions_from_axes(axes).astype(np.float32),
        np.log(scales * np.reshape(spacing_m, (-1, 1))).astype(np.float32),
        np.full(len(stretch), logit, np.float32),
    )


def changed_discs(
    means: np.ndarray, normals: np.ndarray, spacing_m: float | np.ndarray, changes: Mapping[str, np.ndarray]
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Apply learned changes to the discs of a surface.

    Parameters
    ----------
    means
        ``(N, 3)`` centres of the cells on the surface, ENU [m].
    normals
        ``(N, 3)`` of the discs' planes, of any length, ENU.
    spacing_m
        Mean distance of neighbouring discs [m], ``(N,)`` or one for all.
    changes
        By the names of `CHANGES`: ``offset (N, 3)``, ``stretch (N, 2)``, ``twist (N, 1)``, ``opacity (N, 1)``; or empty.

    Returns
    -------
    tuple of numpy.ndarray
        Means ``(N, 3)``, quaternions ``(N, 4)`` wxyz, log scales ``(N, 3)`` and opacity logits ``(N,)``, float32.
    """
    quaternions, log_scales, logits = disc_shapes(normals, spacing_m)
    if not changes:
        return means, quaternions, log_scales, logits
    moved = means + disc_offsets_m(quaternions, spacing_m, changes)
    half = 0.5 * changes["twist"]
    w, x, y, z = np.split(quaternions, 4, axis=1)
    c, s = np.cos(half), np.sin(half)
    turned = np.concatenate([w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s], axis=1)
    log_scales[:, :2] += changes["stretch"]
    columns = (moved, turned, log_scales, logits + changes["opacity"][:, 0])
    return tuple(values.astype(np.float32) for values in columns)  # pyright: ignore[reportReturnType]


def disc_offsets_m(
    quaternions: np.ndarray, spacing_m: float | np.ndarray, changes: Mapping[str, np.ndarray]
) -> np.ndarray:
    """Shift of discs from the centres of their cells, of unturned ``quaternions (N, 4)``: ``(N, 3)`` ENU [m]."""
    return np.reshape(spacing_m, (-1, 1)) * np.einsum(
        "nij,nj->ni", axes_from_quaternions(quaternions), changes["offset"]
    )


def cell_samples(
    terrain: Terrain, grid: SurfelGrid, at_vertices: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sample a terrain within all cells of a grid.

    Parameters
    ----------
    terrain
        Mesh with texture coordinates.
    grid
        The cells, K of them.
    at_vertices
        ``(V, 3)`` from `vertex_normals`.

    Returns
    -------
    tuple of numpy.ndarray
        Positions ``(K, S, 3)`` ENU [m], shading normals ``(K, S, 3)`` and atlas coordinates ``(K, S, 2)`` of sample points;
        NaN off the terrain.
    """
    width, height = grid.columns, grid.rows
    east_m, south_m = grid.west_m + width * grid.east_step_m, grid.north_m - height * grid.north_step_m
    terrain = _within(terrain, (grid.west_m, south_m, east_m, grid.north_m))
    low = np.array([grid.west_m, grid.north_m - height * grid.north_step_m])
    flat = (terrain.vertices[:, :2] - low) / [width * grid.east_step_m, height * grid.north_step_m]
    top_down = replace(terrain, uv=flat)
    columns, rows = width * SUBCELLS, height * SUBCELLS
    positions, face_id = texel_positions(top_down, columns, rows)
    normals, uv = np.zeros((rows * columns, 3), np.float32), np.zeros((rows * columns, 2), np.float32)
    covered = np.flatnonzero(face_id >= 0)
    corners = terrain.faces[face_id.ravel()[covered]]
    centre = np.stack([covered % columns, covered // columns], axis=-1) + 0.5
    weights = barycentric(texel_coordinates(flat, columns, rows)[corners], centre)
    if terrain.surface is None:
        normal = np.einsum("nk,nkc->nc", weights, at_vertices[corners])
        normals[covered] = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    else:
        normals[covered] = terrain.surface.sample(positions.reshape(-1, 3)[covered])[1]
    uv[covered] = np.einsum("nk,nkc->nc", weights, terrain.uv[corners])

    def by_cell(values: np.ndarray) -> np.ndarray:
        split = values.reshape(height, SUBCELLS, width, SUBCELLS, -1).swapaxes(1, 2)
        return split.reshape(height * width, SUBCELLS**2, -1)

    return by_cell(positions), by_cell(normals), by_cell(uv)


def _disc_axes(normal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Axes of discs as columns ``(N, 3, 3)`` (down the slope, across it, normal) and elongation ``(N,)``."""
    up = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    across = np.stack([-up[:, 1], up[:, 0], np.zeros(len(up))], axis=1)
    length = np.linalg.norm(across, axis=1, keepdims=True)
    across = np.where(length > 1e-6, across / np.maximum(length, 1e-6), [0.0, 1.0, 0.0])
    down = np.cross(across, up)
    return np.stack([down, across, up], axis=2), np.minimum(1.0 / np.maximum(up[:, 2], 1e-3), _MAX_STRETCH)


def quaternions_from_axes(axes: np.ndarray) -> np.ndarray:
    """Convert rotation matrices to unit quaternions.

    Parameters
    ----------
    axes
        ``(N, 3, 3)``.

    Returns
    -------
    numpy.ndarray
        ``(N, 4)`` wxyz, w not negative.
    """
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(axes).as_quat(canonical=True), 1, axis=1)


def axes_from_quaternions(quaternions: np.ndarray) -> np.ndarray:
    """Convert quaternions to rotation matrices.

    Parameters
    ----------
    quaternions
        ``(N, 4)`` wxyz, of any length.

    Returns
    -------
    numpy.ndarray
        ``(N, 3, 3)``.
    """
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
    """Average an albedo texture over the cell of each disc.

    Parameters
    ----------
    surfels
        N discs.
    albedo
        ``(R, S, 3)`` texture.

    Returns
    -------
    numpy.ndarray
        ``(N, 3)`` float32 in [0, 1].

    Raises
    ------
    ValueError
        If the texture is not finite at a disc.
    """
    total = np.zeros((len(surfels.means), 3))
    for sample in range(surfels.uv.shape[1]):
        total += sample_texture(albedo, surfels.uv[:, sample])
    mean = total / surfels.uv.shape[1]
    if not np.isfinite(mean).all():
        raise ValueError("surfel_albedo: the albedo has values that are not finite; complete the texture first")
    return np.clip(mean, 0.0, 1.0).astype(np.float32)
