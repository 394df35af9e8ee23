"""Relief atlas: a stretch-minimising, fold-free parametrisation of a height field onto a rectangle."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from seasonscapes.declaration import InputError
from seasonscapes.terrain.atlas import Atlas, measure_atlas, require_unfolded, singular_values, texel_grid
from seasonscapes.terrain.surface import Terrain

# Beyond it the memory of the direct factorisation, one unknown a vertex, exceeds that of usual machines.
MAX_FACES = 2_500_000


def relief_atlas(terrain: Terrain, texel_m: float | None, max_side_px: int) -> tuple[Terrain, Atlas]:
    """Parametrise a surface by a convex-combination map onto a rectangle, weighted for low stretch.

    The boundary is mapped to the rectangle's boundary by arc length on the surface. Every interior vertex is a weighted
    mean of its neighbours with positive weights: by Tutte's theorem (Floater 1997, doi:10.1016/S0167-8396(96)00031-3)
    the map does not fold for any such weights. The weights are the mean value coordinates of the surface (Floater 2003,
    doi:10.1016/S0167-8396(03)00002-5), which are nearly conformal, divided once by each neighbour's stretch, which
    increases the texel density on steep ground (Yoshizawa, Belyaev & Seidel 2004, doi:10.1109/SMI.2004.1314507).

    Parameters
    ----------
    terrain
        A surface of one connected component without holes; its UV coordinates are not used.
    texel_m
        Texel side in horizontal projection [m]; ``None`` for the smallest side that ``max_side_px`` allows.
    max_side_px
        Largest width or height of the atlas [texels].

    Returns
    -------
    terrain
        The surface with new UV coordinates.
    atlas
        Size and resolution of the atlas.

    Raises
    ------
    InputError
        More faces than `MAX_FACES`, holes or several components, a face that folds over by rounding, or an atlas larger
        than ``max_side_px``.
    """
    if len(terrain.faces) > MAX_FACES:
        raise InputError(
            "atlas relief",
            f"too many faces to solve for: {len(terrain.faces)}",
            expected=f"at most {MAX_FACES}",
            cure="use the adaptive mesher with a larger error bound, or the planar atlas",
        )
    _, _, width, height = texel_grid(terrain, texel_m, max_side_px)
    rim = boundary_loop(terrain.faces, len(terrain.vertices))
    uv = _rim_on_rectangle(terrain, rim)
    i, j, weight = _mean_value_weights(terrain)
    first = _solve_interior(terrain, uv, rim, i, j, weight)
    stretch, first_energy = _vertex_stretch(first, width, height)
    second = _solve_interior(terrain, uv, rim, i, j, weight / stretch[j])
    _, second_energy = _vertex_stretch(second, width, height)
    best = second if second_energy < first_energy else first
    require_unfolded(best, "relief", cure="use the planar atlas, or a larger error bound of the mesher")
    return best, measure_atlas(best, "relief", width, height)


def boundary_loop(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """Find the boundary loop of a surface with disc topology.

    Parameters
    ----------
    faces
        ``(F, 3)`` vertex indices.
    vertex_count
        Number of vertices.

    Returns
    -------
    numpy.ndarray
        Indices of the boundary vertices, counter-clockwise.

    Raises
    ------
    InputError
        The surface has no boundary, several boundary loops, or one that touches itself.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    forward, reverse = edges @ [vertex_count, 1], edges @ [1, vertex_count]
    rim = edges[np.isin(forward, reverse, assume_unique=True, invert=True)]
    successor = dict(rim.tolist())
    loop = [int(rim[0, 0])] if len(rim) else []
    while (
        loop and (following := successor.get(loop[-1])) is not None and following != loop[0] and len(loop) <= len(rim)
    ):
        loop.append(following)
    if not loop or len(loop) != len(rim):
        raise InputError("atlas relief", "the surface is not one piece without holes", cure="use the xatlas atlas")
    return np.array(loop)


def _rim_on_rectangle(terrain: Terrain, rim: np.ndarray) -> np.ndarray:
    """UV ``(V, 2)`` with the boundary on the unit square, by arc length on the surface, and zeros in the interior.

    The four boundary vertices of largest turning angle (the raster's corners) are mapped to the square's corners, the
    south-western one to (0, 0).
    """
    position = terrain.vertices[rim].astype(np.float64)
    step = np.roll(position, -1, axis=0) - position
    heading = np.unwrap(np.arctan2(step[:, 1], step[:, 0]))
    turn = (heading - np.roll(heading, 1) + np.pi) % (2.0 * np.pi) - np.pi
    corner = np.sort(np.argsort(turn)[-4:])
    south_west = corner[np.argmin(position[corner, 0] + position[corner, 1])]
    rim, step = np.roll(rim, -south_west), np.roll(step, -south_west, axis=0)
    ends = [*np.sort((corner - south_west) % len(rim)), len(rim)]
    length = np.linalg.norm(step, axis=1)
    square = np.array([(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0), (0.0, 0.0)])
    uv = np.zeros((len(terrain.vertices), 2))
    for side in range(4):
        part = slice(ends[side], ends[side + 1])
        fraction = (np.cumsum(length[part]) - length[part]) / length[part].sum()
        uv[rim[part]] = square[side] + fraction[:, None] * (square[side + 1] - square[side])
    return uv


def _mean_value_weights(terrain: Terrain) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Directed edges i → j and their mean value weights (tan α/2 + tan β/2) / |ij|, one entry per adjacent face."""
    i, j, weight = [], [], []
    for k in range(3):
        apex, left, right = (terrain.faces[:, (k + offset) % 3].astype(np.int64) for offset in range(3))
        a = terrain.vertices[left].astype(np.float64) - terrain.vertices[apex]
        b = terrain.vertices[right].astype(np.float64) - terrain.vertices[apex]
        length_a, length_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
        cosine = np.einsum("ij,ij->i", a, b) / (length_a * length_b)
        # tan(θ/2) = |a × b| / (|a| |b| (1 + cos θ)) avoids the cancellation in 1 − cos θ at small angles.
        half_tangent = np.linalg.norm(np.cross(a, b), axis=1) / (length_a * length_b * (1.0 + cosine))
        i += [apex, apex]
        j += [left, right]
        weight += [half_tangent / length_a, half_tangent / length_b]
    return np.concatenate(i), np.concatenate(j), np.concatenate(weight)


def _solve_interior(
    terrain: Terrain, uv: np.ndarray, rim: np.ndarray, i: np.ndarray, j: np.ndarray, weight: np.ndarray
) -> Terrain:
    """Solve for the UV of interior vertices as weighted means of their neighbours, with a fixed boundary."""
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.linalg import splu

    count = len(uv)
    inner = np.ones(count, bool)
    inner[rim] = False
    interior = np.flatnonzero(inner)
    if not len(interior):
        return replace(terrain, uv=uv.astype(np.float32))
    matrix = coo_array((weight, (i, j)), shape=(count, count)).tocsr()[interior]
    matrix = diags_array(1.0 / matrix.sum(axis=1)) @ matrix
    system = (diags_array(np.ones(len(interior))) - matrix[:, interior]).tocsc()
    # The matrix is diagonally dominant: no pivoting is needed, and the symmetric ordering keeps the factors sparse.
    factors = splu(system, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    solved = uv.copy()
    solved[interior] = factors.solve(matrix[:, rim] @ uv[rim])
    return replace(terrain, uv=solved.astype(np.float32))


def _vertex_stretch(terrain: Terrain, width: int, height: int) -> tuple[np.ndarray, float]:
    """Stretch at each vertex ``(V,)`` relative to the total L² stretch, and the total (Yoshizawa et al., eq. 2)."""
    longer, shorter, area = singular_values(terrain, width, height)
    square = (longer**2 + shorter**2) / 2.0
    corners, count = terrain.faces.ravel(), len(terrain.vertices)
    total = np.bincount(corners, np.repeat(area * square, 3), count)
    weight = np.bincount(corners, np.repeat(area, 3), count)
    energy = float(np.sqrt((area * square).sum() / area.sum()))
    return np.sqrt(total / np.maximum(weight, 1e-300)) / energy, energy
