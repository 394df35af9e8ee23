"""Refinement of a terrain mesh near a viewpoint, until its error is a fraction of a pixel.

An error of a metre is nothing on a far slope, but many pixels on the crest that the camera stands on. Edges near the
camera are split at their midpoints wherever the smooth surface deviates from them visibly. Whether an edge is split
depends on the edge alone, so that both of its faces agree and the mesh stays without cracks.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from seasonscapes.terrain.surface import SurfaceGrid, Terrain

log = logging.getLogger(__name__)

# Points along an edge at which its distance from the surface is measured.
_ALONG = (0.25, 0.5, 0.75)
# Edges are not split below this length in spacings of the surface's nodes: between the nodes it is bilinear.
_LEAST_NODES = 0.3
_MOST_ROUNDS = 14
# New faces at which refinement ends; each round at most doubles them.
_MOST_FACES = 4_000_000
_CHUNK = 500_000


def refined_for_view(
    terrain: Terrain, eye_m: np.ndarray, pixel_angle_rad: float, *, tolerance_px: float = 0.25, reach_m: float = 4000.0
) -> Terrain:
    """Refine a mesh near a camera towards its smooth surface.

    Parameters
    ----------
    terrain
        The mesh; without ``surface`` it is returned unchanged.
    eye_m
        ``(3,)`` position of the camera, east-north-up [m].
    pixel_angle_rad
        Angular size of a pixel [rad].
    tolerance_px
        Largest vertical error of an edge that is kept [px].
    reach_m
        Farther faces are kept as they are [m].

    Returns
    -------
    Terrain
        With the same atlas: texture coordinates of new vertices are interpolated, which is exact within a chart.
    """
    if terrain.surface is None:
        return terrain
    visible_error = tolerance_px * pixel_angle_rad

    def tolerance_m(position_m: np.ndarray) -> np.ndarray:
        return visible_error * np.linalg.norm(position_m - eye_m, axis=-1)

    return _refined(terrain, terrain.surface, _near_faces(terrain, eye_m, reach_m), tolerance_m)


def moved_to(terrain: Terrain, surface: SurfaceGrid) -> Terrain:
    """Move the vertices of a mesh up or down by what another surface of its ground differs from its own.

    Parameters
    ----------
    terrain
        The mesh, with a surface.
    surface
        Takes its place.

    Returns
    -------
    Terrain
        As near to its new surface as it was to its old one, between whose nodes alone it may be coarse: see `refined_for_view`.
    """
    assert terrain.surface is not None
    vertices = terrain.vertices.copy()
    for start in range(0, len(vertices), _CHUNK):
        part = vertices[start : start + _CHUNK]
        part[:, 2] += surface.up_at(part) - terrain.surface.up_at(part)
    return replace(terrain, vertices=vertices, surface=surface)


def refined_in_parts(terrain: Terrain) -> Terrain:
    """Refine a mesh where its surface has finer parts, until it is as near to each as its ``mesh_error_m`` says.

    Parameters
    ----------
    terrain
        The mesh; without parts it is returned unchanged.

    Returns
    -------
    Terrain
        Texture coordinates of new vertices are interpolated.
    """
    surface = terrain.surface
    if surface is None or not surface.parts:
        return terrain
    low, high = (side(terrain.vertices[terrain.faces, :2], axis=1) for side in (np.min, np.max))
    near = np.zeros(len(terrain.faces), bool)
    for part in surface.parts:
        # A face of a plain may hold a whole part within its corners.
        (east, north), reach = part.domain[:2], part.domain[2]
        near |= (low < (east + reach, north + reach)).all(axis=1) & (high > (east - reach, north - reach)).all(axis=1)

    def tolerance_m(position_m: np.ndarray) -> np.ndarray:
        # Elsewhere the mesh stays as it is.
        result = np.full(len(position_m), np.inf)
        for part in surface.parts:
            result[part.share_at(position_m) > 0.0] = part.mesh_error_m
        return result

    return _refined(terrain, surface, near, tolerance_m)


def _refined(
    terrain: Terrain, surface: SurfaceGrid, near: np.ndarray, tolerance_m: Callable[[np.ndarray], np.ndarray]
) -> Terrain:
    """Split edges of the ``near`` faces until the surface deviates from them by no more than is tolerated there."""
    settled, faces = [terrain.faces[~near]], terrain.faces[near]
    vertices, uv = terrain.vertices, terrain.uv
    for _ in range(_MOST_ROUNDS):
        edges, of_face = _unique_edges(faces)
        split = _visible(surface, vertices, edges, tolerance_m)
        # Faces whose middle deviates although no edge does.
        unsplit = ~split[of_face].any(axis=1)
        middle = vertices[faces[unsplit]].mean(axis=1, dtype=np.float64)
        deviating = _deviation(surface, middle) > tolerance_m(middle)
        corners = vertices[faces[unsplit][deviating]].astype(np.float64)
        lengths = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2)
        longest = of_face[np.flatnonzero(unsplit)[deviating], lengths.argmax(axis=1)]
        spacing = surface.spacing_at(middle[deviating])
        split[longest[lengths.max(axis=1) > _LEAST_NODES * spacing]] = True
        # An edge that only one near face has belongs to a far face too, or to the rim.
        split &= np.bincount(of_face.ravel(), minlength=len(edges)) == 2
        # Faces without a visible error are settled; the others' decisions about shared edges do not change any more.
        divided = split[of_face].any(axis=1)
        settled.append(faces[~divided])
        faces, of_face = faces[divided], of_face[divided]
        if len(faces) > _MOST_FACES:
            log.warning(
                "the mesh stays coarser than its surface there: more than %d faces would be needed", _MOST_FACES
            )
        if not len(faces) or len(faces) > _MOST_FACES:
            break
        ends = edges[split]
        middle = vertices[ends].mean(axis=1, dtype=np.float64)
        middle[:, 2] = surface.up_at(middle)
        number = np.full(len(edges), -1, np.int64)
        number[split] = len(vertices) + np.arange(len(ends))
        vertices = np.concatenate([vertices, middle.astype(np.float32)])
        uv = np.concatenate([uv, uv[ends].mean(axis=1, dtype=np.float32)])
        faces = _divided(faces, number[of_face])
    return replace(terrain, vertices=vertices, faces=np.concatenate([*settled, faces]).astype(np.uint32), uv=uv)


def _near_faces(terrain: Terrain, eye_m: np.ndarray, reach_m: float) -> np.ndarray:
    inside = np.linalg.norm(terrain.vertices[:, :2] - np.asarray(eye_m)[:2], axis=1) < reach_m
    return inside[terrain.faces].any(axis=1)


def _unique_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Edges ``(E, 2)``, and the edges from each corner to the next ``(F, 3)``."""
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2).astype(np.int64), axis=1)
    keys, inverse = np.unique(pairs[:, 0] << 32 | pairs[:, 1], return_inverse=True)
    return np.stack([keys >> 32, keys & 0xFFFFFFFF], axis=1), inverse.reshape(-1, 3)


def _deviation(surface: SurfaceGrid, position_m: np.ndarray) -> np.ndarray:
    return np.abs(surface.up_at(position_m) - position_m[:, 2])


def _visible(
    surface: SurfaceGrid, vertices: np.ndarray, edges: np.ndarray, tolerance_m: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Edges ``(E,)`` from which the surface deviates visibly."""
    start, end = (vertices[edges[:, k]].astype(np.float64) for k in range(2))
    spacing = surface.spacing_at(0.5 * (start + end))
    long = np.flatnonzero(np.linalg.norm((end - start)[:, :2], axis=1) > _LEAST_NODES * spacing)
    result = np.zeros(len(edges), bool)
    least = np.minimum(tolerance_m(start[long]), tolerance_m(end[long]))
    for share in _ALONG:
        point = start[long] + share * (end - start)[long]
        least = np.minimum(least, tolerance_m(point))
        result[long] |= _deviation(surface, point) > least
    return result


def _divided(faces: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Faces with some edges split: ``middle`` ``(F, 3)`` is the vertex on the edge from each corner to the next, or -1."""
    faces, count = faces.astype(np.int64), (middle >= 0).sum(axis=1)
    parts = [faces[count == 0]]
    # Turn faces with one split edge so that it is the first one, and with two so that the last one is whole.
    for splits in (1, 2):
        chosen = count == splits
        split = middle[chosen] >= 0
        turn = split.argmax(axis=1) if splits == 1 else (split.argmin(axis=1) + 1) % 3
        order = (turn[:, None] + np.arange(3)) % 3
        (a, b, c), (m, n, _) = (np.take_along_axis(values[chosen], order, axis=1).T for values in (faces, middle))
        if splits == 1:
            parts += [np.stack([a, m, c], axis=1), np.stack([m, b, c], axis=1)]
        else:
            parts += [np.stack(each, axis=1) for each in ((m, b, n), (a, m, n), (a, n, c))]
    (a, b, c), (m, n, o) = faces[count == 3].T, middle[count == 3].T
    parts += [np.stack(each, axis=1) for each in ((a, m, o), (m, b, n), (o, n, c), (m, n, o))]
    return np.concatenate(parts)
