"""A textured terrain as binary glTF, for viewers, game engines and globes."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from seasonscapes.images import atomic_path
from seasonscapes.terrain.surface import Terrain


def write_glb(
    path: str | os.PathLike, terrain: Terrain, picture: np.ndarray, *, unlit: bool, extras: dict | None = None
) -> None:
    """Write a terrain and its sRGB texture ``(R, S, 3)`` uint8 to one ``.glb`` file, atomically.

    glTF's y is up and its z points south. ``unlit`` says that the light is in the texture already
    (``KHR_materials_unlit``), so that viewers add none of their own.

    Parameters
    ----------
    extras
        Plain values for the file's ``asset.extras``, such as place, time and licence.
    """
    import pygltflib
    import trimesh
    from PIL import Image

    east, north, up = terrain.vertices.astype(np.float32).T
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.fromarray(np.ascontiguousarray(picture)), metallicFactor=0.0, roughnessFactor=1.0
    )
    # `process=False`: merging vertices would tear the texture at chart borders.
    mesh = trimesh.Trimesh(
        np.stack([east, up, -north], axis=-1),
        terrain.faces,
        process=False,
        visual=trimesh.visual.TextureVisuals(uv=terrain.uv, material=material),
    )
    document = pygltflib.GLTF2.load_from_bytes(mesh.export(file_type="glb", include_normals=not unlit))
    document.asset.extras = extras or {}
    if unlit:
        document.extensionsUsed = sorted({*(document.extensionsUsed or []), "KHR_materials_unlit"})
        for each in document.materials:
            each.extensions = {**(each.extensions or {}), "KHR_materials_unlit": {}}
    with atomic_path(Path(path)) as temporary:
        temporary.write_bytes(b"".join(document.save_to_bytes()))
