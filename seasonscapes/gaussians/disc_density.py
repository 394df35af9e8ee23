"""Discs as fine as cameras see the ground: cells are quartered until a disc is no larger than some pixels.

A disc is no finer than its size, and pixels of a near slope show far less ground than those of a far one. So the spacing of the
discs follows the pixels' footprints where a camera looks, and stays that of the grid where none does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.gaussians.disc_cells import MOST_LEVELS, quarters
from seasonscapes.gaussians.surfels import SurfelGrid, Surfels, cell_samples, surfels_from_cells
from seasonscapes.rendering.gbuffer import trace_gbuffer
from seasonscapes.rendering.mitsuba_scene import RenderScene
from seasonscapes.terrain.attributes import vertex_normals
from seasonscapes.terrain.surface import Terrain

# Rays along a pixel's side that find what a camera sees.
_SUBPIXELS = 2
# Ground seen at a sharper angle than this cosine to its normal counts as seen at it: its normals are not known so well.
_LEAST_COSINE = 0.02
# Pixels along a side of the views around a camera's place, and the largest disc there: a sixth of its distance on the views' axes.
_CUBE_PX, SURROUNDING_PX = 72, 6.0
# Factor between spacings that are tried.
_STEP = 2.0**0.25
# Side of the blocks of cells that are sampled together.
_BLOCK = 48


def footprints(
    scene: RenderScene, cameras: Sequence[Camera], *, grazing: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Trace what cameras see, and how much ground one pixel shows there.

    Parameters
    ----------
    scene
        The terrain.
    cameras
        The views.
    grazing
        Measure on the ground, where a pixel covers more than across the line of sight.

    Returns
    -------
    tuple of numpy.ndarray
        Horizontal positions ``(K, 2)`` ENU [m], and the side ``(K,)`` of a pixel there [m]: at their distance, across the line of
        sight, or with ``grazing`` that of a square as large as the ground in the pixel.
    """
    places, sides = [np.zeros((0, 2))], [np.zeros(0)]
    for camera in cameras:
        across, down = (
            (np.arange(_SUBPIXELS * size) + 0.5) / _SUBPIXELS for size in (camera.width_px, camera.height_px)
        )
        seen = trace_gbuffer(scene, camera, np.stack(np.meshgrid(across, down), axis=-1))
        position = seen.position[np.isfinite(seen.depth)].astype(np.float64)
        sight = position - camera.position_m
        side = sight @ camera.world_from_camera[:3, 2] / min(camera.fx, camera.fy)
        if grazing:
            cosine = np.abs(np.einsum("kc,kc->k", sight, seen.normal[np.isfinite(seen.depth)]))
            side /= np.sqrt(np.maximum(cosine / np.linalg.norm(sight, axis=1), _LEAST_COSINE))
        places.append(position[:, :2])
        sides.append(side)
    return np.concatenate(places), np.concatenate(sides)


def surfels_for(
    terrain: Terrain, surfels: Surfels, scene: RenderScene, cameras: Sequence[Camera], disc_px: float, most: int = 0
) -> Surfels:
    """Quarter cells where cameras look, and around the cameras.

    Parameters
    ----------
    terrain, surfels
        As of `refined_surfels`.
    scene
        The terrain.
    cameras
        The views.
    disc_px
        Largest side of a disc in the views [px].
    most
        Largest number of discs that ``disc_px`` leads to, beyond which all are larger; 0: no bound. What the surroundings of the
        cameras need is not counted.

    Returns
    -------
    Surfels
        Discs of several sizes.
    """
    place_m, side_m = footprints(scene, cameras, grazing=most > 0)
    wanted_m = disc_px * side_m
    if most:
        wanted_m = coarsening(surfels, place_m, wanted_m, most) * wanted_m
    around_m, around_side_m = footprints(scene, surroundings(cameras))
    wanted_m = np.concatenate([wanted_m, SURROUNDING_PX * around_side_m])
    return refined_surfels(terrain, surfels, np.concatenate([place_m, around_m]), wanted_m)


def surroundings(cameras: Sequence[Camera]) -> list[Camera]:
    """Views all around the place of each camera: the six faces of a cube, 90° wide.

    Discs that are large for their distance blend over much of a picture, also from beside it: `SURROUNDING_PX` pixels of these views
    are as large as discs may be there.

    Parameters
    ----------
    cameras
        The views; those from one place count once.

    Returns
    -------
    list of Camera
        Six views of each place.
    """
    found, half = [], 0.5 * _CUBE_PX
    for position_m in np.unique([np.round(camera.position_m, 3) for camera in cameras], axis=0):
        for heading_deg, pitch_deg in ((0.0, 0.0), (90.0, 0.0), (180.0, 0.0), (270.0, 0.0), (0.0, 90.0), (0.0, -90.0)):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = rotation_from_angles(heading_deg, pitch_deg), position_m
            found.append(Camera(_CUBE_PX, _CUBE_PX, half, half, half, half, pose))
    return found


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
    levels = _levels(grid, wanted_m)
    for number in range(MOST_LEVELS):
        near = _with_neighbours(grid.quartered(number), place_m[levels > number])
        split = np.isin(current.cell, near)
        if not len(near):
            break
        finished.append(_chosen(current, ~split))
        # Cells that terrain covers in part have no disc, but some of their quarters may: skylines often lie at its border.
        kids = np.sort(quarters(near, grid.columns << number).ravel())
        current = _sampled(terrain, normals, grid, number + 1, kids)
    return _joined([*finished, current])


def coarsening(surfels: Surfels, place_m: np.ndarray, wanted_m: np.ndarray, most: int) -> float:
    """Factor of wanted spacings that leaves at most so many discs.

    Parameters
    ----------
    surfels, place_m, wanted_m
        As of `refined_surfels`.
    most
        Largest number of discs; where there are as many without any quartering, none is quartered.

    Returns
    -------
    float
        The smallest of 1, 2^¼, 2^½ … with which `refined_surfels` makes no more discs even if terrain covers all cells.
    """
    if not len(wanted_m):
        return 1.0
    # The last one leaves nothing to quarter.
    coarsest = max(surfels.grid.spacing_m / max(float(np.min(wanted_m)), 1e-6), 1.0)
    factors = _STEP ** np.arange(1 + int(np.ceil(np.log(coarsest) / np.log(_STEP))))
    low, high = 0, len(factors) - 1
    while low < high:
        middle = (low + high) // 2
        if _count(surfels, place_m, factors[middle] * wanted_m) <= most:
            high = middle
        else:
            low = middle + 1
    return float(factors[low])


def _levels(grid: SurfelGrid, wanted_m: np.ndarray) -> np.ndarray:
    """How often the cells at places are to be quartered."""
    with np.errstate(divide="ignore"):
        return np.ceil(np.log2(grid.spacing_m / np.maximum(wanted_m, 0.0)) - 1e-6)


def _count(surfels: Surfels, place_m: np.ndarray, wanted_m: np.ndarray) -> int:
    """Number of discs that `refined_surfels` makes at most: where terrain covers all quarters."""
    grid, levels, current, count = surfels.grid, _levels(surfels.grid, wanted_m), surfels.cell, len(surfels.cell)
    for number in range(MOST_LEVELS):
        near = _with_neighbours(grid.quartered(number), place_m[levels > number])
        count += 4 * len(near) - int(np.isin(near, current).sum())
        current = quarters(near, grid.columns << number).ravel()
    return count


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
