"""Export of a textured terrain as binary glTF 2.0 (``.glb``)."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.images import atomic_path
from seasonscapes.terrain.surface import Terrain


def write_glb(
    path: str | os.PathLike[str],
    terrain: Terrain,
    picture: np.ndarray,
    *,
    unlit: bool,
    extras: dict[str, Any] | None = None,
) -> None:
    """Write a terrain with its texture to one ``.glb`` file, atomically.

    The file's axes are x east, y up, z south.

    Parameters
    ----------
    path
        File to write.
    terrain
        Surface with UV coordinates.
    picture
        Texture ``(R, S, 3)`` uint8 sRGB.
    unlit
        Whether the texture already contains the illumination; viewers then add none (``KHR_materials_unlit``).
    extras
        JSON-serialisable values for the file's ``asset.extras``, such as location, time and licence.
    """
    import pygltflib
    import trimesh
    from PIL import Image
    from trimesh.visual.material import PBRMaterial
    from trimesh.visual.texture import TextureVisuals

    east, north, up = terrain.vertices.astype(np.float32).T
    material = PBRMaterial(
        baseColorTexture=Image.fromarray(np.ascontiguousarray(picture)), metallicFactor=0.0, roughnessFactor=1.0
    )
    # Vertices along chart borders coincide but differ in UV: `process=False` keeps them separate.
    mesh = trimesh.Trimesh(
        np.stack([east, up, -north], axis=-1),
        terrain.faces,
        process=False,
        visual=TextureVisuals(uv=terrain.uv, material=material),
    )
    document = pygltflib.GLTF2.load_from_bytes(mesh.export(file_type="glb", include_normals=not unlit))
    assert document is not None
    document.asset.extras = extras or {}
    if unlit:
        extensions: set[str] = {*(document.extensionsUsed or []), "KHR_materials_unlit"}
        document.extensionsUsed = sorted(extensions)
        for gltf_material in document.materials:
            gltf_material.extensions = {**(gltf_material.extensions or {}), "KHR_materials_unlit": {}}
    with atomic_path(Path(path)) as temporary:
        temporary.write_bytes(b"".join(document.save_to_bytes()))
