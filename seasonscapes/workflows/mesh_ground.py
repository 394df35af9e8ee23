"""Terrain of a scene as the ground of a user's mesh: it shades the mesh, and the mesh shades it."""

from __future__ import annotations

from datetime import date

import cv2
import numpy as np

from seasonscapes.frames import enu_from_geodetic, geodetic_from_enu
from seasonscapes.progress import Progress
from seasonscapes.terrain.mesh_atlas import MeshGround
from seasonscapes.terrain.textured_mesh import TexturedMesh
from seasonscapes.workflows.albedo_sources import scene_albedo
from seasonscapes.workflows.place import Place, ground_height_m

# The texture of the terrain is reduced to so many texels on a side at most.
_MOST_TEXELS = 2048


def scene_ground(
    place: Place, mesh: TexturedMesh, day: date | None = None, *, progress: Progress | None = None
) -> MeshGround:
    """Terrain and albedo of a place in the frame of a mesh that stands on it.

    Parameters
    ----------
    place
        The place.
    mesh
        The mesh, whose heights are in the place's vertical datum.
    day
        Date of the albedo; the first of July if left out.
    progress
        Called with a task and its finished share.

    Returns
    -------
    MeshGround
        For `MeshSurroundings`.

    Raises
    ------
    InputError
        For a mesh outside the place.

    Examples
    --------
    >>> import tempfile, trimesh
    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> at = (place.frame.latitude_deg, place.frame.longitude_deg, place.frame.height_m)
    >>> ball = trimesh.creation.icosphere(subdivisions=2)
    >>> ball.visual.vertex_colors = np.full((len(ball.vertices), 4), (120, 110, 90, 255), np.uint8)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = ball.export(f"{folder}/ball.ply")
    ...     mesh = ss.load_mesh(f"{folder}/ball.ply", ss.MeshPlacing(at=at))
    >>> ground = scene_ground(place, mesh)
    >>> ground.position.shape[0] == len(place.terrain.faces)
    True
    """
    ground_height_m(place, mesh.frame.latitude_deg, mesh.frame.longitude_deg, where=str(mesh.path))
    terrain = place.terrain
    vertices = enu_from_geodetic(mesh.frame, *geodetic_from_enu(place.frame, terrain.vertices.astype(float)))
    corners = vertices[terrain.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normal, terrain.faces[:, corner], across)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-30)
    albedo = scene_albedo(place, day or date(2024, 7, 1), progress=progress).values
    side = max(albedo.shape[:2])
    if side > _MOST_TEXELS:
        size = tuple(max(1, round(extent * _MOST_TEXELS / side)) for extent in albedo.shape[1::-1])
        albedo = cv2.resize(albedo, size, interpolation=cv2.INTER_AREA)
    uv = terrain.uv[terrain.faces]
    return MeshGround(corners, normal[terrain.faces], uv, albedo.astype(np.float32), place.scene.name)
