"""Textured meshes read from files and placed on Earth."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from seasonscapes.terrain.mesh_placing import MeshPlacing, placed
from seasonscapes.terrain.textured_mesh import TexturedMesh


def load_mesh(path: str | Path, placing: MeshPlacing | None = None, *, allow_outside: bool = False) -> TexturedMesh:
    """Read a textured mesh and place it on Earth.

    Parameters
    ----------
    path
        ``.glb``, ``.gltf``, ``.obj`` with MTL, or ``.ply``, with textures or vertex colours.
    placing
        Which axis is up, and where the mesh lies; in metres about latitude 0, longitude 0 if left out.
    allow_outside
        Let the file refer to files outside its folder.

    Returns
    -------
    TexturedMesh
        Its parts, textures and positions.

    Raises
    ------
    InputError
        For files that are missing or broken, that refer to files that are missing or outside the folder, without
        texture coordinates and colours, in degrees, or with textures larger than the memory.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np, trimesh
    >>> import seasonscapes as ss
    >>> ball = trimesh.creation.icosphere(subdivisions=2)
    >>> ball.visual.vertex_colors = np.full((len(ball.vertices), 4), (120, 110, 90, 255), np.uint8)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = ball.export(f"{folder}/ball.ply")
    ...     mesh = ss.load_mesh(f"{folder}/ball.ply")
    >>> len(mesh.textures), mesh.bounds_m[1].round(1).tolist()
    (1, [1.0, 1.0, 1.0])
    """
    from seasonscapes.terrain.mesh_reading import read_mesh_file

    path = Path(path)
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    file = read_mesh_file(path, allow_outside=allow_outside, memory_bytes=memory)
    parts = []
    for part in file.parts:
        if len(part.faces):
            used, faces = np.unique(part.faces, return_inverse=True)
            kept = (None if values is None else values[used] for values in (part.vertices, part.uv, part.normals))
            # Vertices that no face uses must not move or stretch the mesh; those of vertex colours stay numbered.
            if part.texture >= 0 and file.textures[part.texture].of_vertices:
                parts.append(replace(part, vertices=_without_unused(part.vertices, used)))
                continue
            vertices, uv, normals = kept
            assert vertices is not None
            parts.append(replace(part, vertices=vertices, faces=faces.reshape(-1, 3), uv=uv, normals=normals))
    positions, turn, frame, up = placed(
        [part.vertices for part in parts], placing or MeshPlacing(), suffix=path.suffix.lower(), where=str(path)
    )
    return TexturedMesh(path, tuple(parts), tuple(file.textures), tuple(positions), turn, frame, up)


def _without_unused(vertices: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Vertices whose unused ones lie at the first used one."""
    result = np.broadcast_to(vertices[used[0]], vertices.shape).copy()
    result[used] = vertices[used]
    return result
