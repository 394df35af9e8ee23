"""Discs as fine as cameras see the ground: cells are quartered until a disc is no larger than some pixels.

A disc is no finer than its size, and pixels of a near slope show far less ground than those of a far one. So the spacing of the
discs follows the pixels' footprints where a camera looks, and stays that of the grid where none does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.gaussians.disc_cells import MOST_LEVELS, quarters
from seasonscapes.gaussians.surfels import SurfelGrid, Surfels, cell_samples, surfels_from_cells
from seasonscapes.rendering.gbuffer import trace_gbuffer
from seasonscapes.rendering.mitsuba_scene import RenderScene
from seasonscapes.terrain.attributes import vertex_normals
from seasonscapes.terrain.surface import Terrain

# Rays along a pixel's side that find what a camera sees.
_SUBPIXELS = 2
# Side of the blocks of cells that are sampled together.
_BLOCK = 48


def footprints(scene: RenderScene, cameras: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Trace what cameras see, and how much ground one pixel shows there.

    Parameters
    ----------
    scene
        The terrain.
    cameras
        The views.

    Returns
    -------
    tuple of numpy.ndarray
        Horizontal positions ``(K, 2)`` ENU [m], and the side ``(K,)`` of a pixel at their distance [m], across the line of sight.
    """
    places, sides = [np.zeros((0, 2))], [np.zeros(0)]
    for camera in cameras:
        across, down = (
            (np.arange(_SUBPIXELS * size) + 0.5) / _SUBPIXELS for size in (camera.width_px, camera.height_px)
        )
        seen = trace_gbuffer(scene, camera, np.stack(np.meshgrid(across, down), axis=-1))
        position = seen.position[np.isfinite(seen.depth)].astype(np.float64)
        along = (position - camera.position_m) @ camera.world_from_camera[:3, 2]
        places.append(position[:, :2])
        sides.append(along / min(camera.fx, camera.fy))
    return np.concatenate(places), np.concatenate(sides)


def refined_surfels(terrain: Terrain, surfels: Surfels, place_m: np.ndarray, wanted_m: np.ndarray) -> Surfels:
    """Quarter the cells of discs, `MOST_LEVELS` times at most, until none at given places is larger than wanted there.

    Parameters
    ----------
    terrain
        The mesh that the discs were made on.
    surfels
        Discs of `surfels.terrain_surfels`.
    place_m
        ``(K, 2)`` horizontal positions, ENU [m].
    wanted_m
        ``(K,)`` largest spacing of discs around them [m].

    Returns
    -------
    Surfels
        Discs of several sizes; the neighbours of a cell that is quartered are quartered too, so that large discs do not reach into it.
    """
    normals, grid, current, finished = vertex_normals(terrain), surfels.grid, surfels, []
    with np.errstate(divide="ignore"):
        levels = np.ceil(np.log2(grid.spacing_m / np.maximum(wanted_m, 0.0)) - 1e-6)
    for number in range(MOST_LEVELS):
        near = _with_neighbours(grid.quartered(number), place_m[levels > number])
        split = np.isin(current.cell, near)
        if not split.any():
            break
        finished.append(_chosen(current, ~split))
        kids = np.sort(quarters(current.cell[split], grid.columns << number).ravel())
        current = _sampled(terrain, normals, grid, number + 1, kids)
    return _joined([*finished, current])


def _with_neighbours(grid: SurfelGrid, place_m: np.ndarray) -> np.ndarray:
    """Distinct cells that contain a place, and the eight around each."""
    column = np.floor((place_m[:, 0] - grid.west_m) / grid.east_step_m).astype(np.int64)
    row = np.floor((grid.north_m - place_m[:, 1]) / grid.north_step_m).astype(np.int64)
    inside = (column >= 0) & (column < grid.columns) & (row >= 0) & (row < grid.rows)
    middle = np.unique(row[inside] * grid.columns + column[inside])
    row, column = np.divmod(middle, grid.columns)
    around = []
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            r, c = row + down, column + right
            kept = (r >= 0) & (r < grid.rows) & (c >= 0) & (c < grid.columns)
            around.append(r[kept] * grid.columns + c[kept])
    return np.unique(np.concatenate(around))


def _sampled(terrain: Terrain, normals: np.ndarray, grid: SurfelGrid, level: int, cell: np.ndarray) -> Surfels:
    """Discs of cells of a level, block by block."""
    fine = grid.quartered(level)
    row, column = np.divmod(cell, fine.columns)
    wide = -(-fine.columns // _BLOCK)
    block = (row // _BLOCK) * wide + column // _BLOCK
    order = np.argsort(block, kind="stable")
    parts = []
    for own in np.split(order, np.flatnonzero(np.diff(block[order])) + 1):
        first_row, first_column = (int(values[own[0]]) // _BLOCK * _BLOCK for values in (row, column))
        columns, rows = min(_BLOCK, fine.columns - first_column), min(_BLOCK, fine.rows - first_row)
        corner = (fine.west_m + first_column * fine.east_step_m, fine.north_m - first_row * fine.north_step_m)
        here = SurfelGrid(*corner, fine.east_step_m, fine.north_step_m, columns, rows)
        within = (row[own] - first_row) * columns + column[own] - first_column
        parts.append([values[within] for values in cell_samples(terrain, here, normals)])
    samples = [np.concatenate(column)[np.argsort(order, kind="stable")] for column in zip(*parts, strict=True)]
    whole = np.isfinite(samples[0]).all(axis=(1, 2))
    levels = np.full(int(whole.sum()), level, np.uint8)
    return surfels_from_cells(grid, levels, cell[whole], *(values[whole] for values in samples))


def _chosen(surfels: Surfels, which: np.ndarray) -> Surfels:
    arrays = {item.name: getattr(surfels, item.name) for item in fields(Surfels)}
    return Surfels(**{name: values if name == "grid" else values[which] for name, values in arrays.items()})


def _joined(parts: Sequence[Surfels]) -> Surfels:
    names = [item.name for item in fields(Surfels) if item.name != "grid"]
    return Surfels(parts[0].grid, **{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})
