"""Textures of a mesh as files of their own, and lit textures as pictures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.images import atomic_path, write_exr
from seasonscapes.terrain.mesh_images import encode_texture
from seasonscapes.terrain.mesh_writing import save_mesh
from seasonscapes.terrain.textured_mesh import TexturedMesh
from seasonscapes.workflows.meshes import DelitMesh, LitMesh, with_textures
from seasonscapes.workflows.pictures import balance_rgb
from seasonscapes.workflows.timelapse import FilmLook


def write_lit(
    lit: LitMesh, output: Path, *, look: FilmLook, textures: str | None, bits: int | None
) -> tuple[list[Path], dict[str, Any]]:
    """Write a lit mesh, or its textures alone into a folder.

    Parameters
    ----------
    lit
        The mesh with its light.
    output
        A mesh, or a folder.
    look
        How radiance becomes a picture.
    textures
        ``png`` or ``exr``: the textures alone; ``None``: the mesh.
    bits
        Of the textures; as in the mesh's file if ``None``.

    Returns
    -------
    files
        The files written.
    record
        Plain values about light and exposure.
    """
    from seasonscapes.exposure import exposure_ev100

    all_texels = np.concatenate([radiance.reshape(-1, 3) for radiance in lit.radiance])[None]
    ev100 = exposure_ev100(all_texels, look.exposure, look=look.look)
    record = lit.facts | {"textures": "lit", "exposure_ev100": round(ev100, 3)}
    white = balance_rgb(look.white_balance, lit.facts["white_rgb"])
    pictures = lit_pictures(lit, ev100, white=white, look=look)
    if textures is None:
        return save_mesh(output, pictures, bits=bits, unlit=True, facts=record), record
    return save_lit_textures(output, lit, pictures, kind=textures, bits=bits or 16), record


def lit_pictures(
    lit: LitMesh, ev100: float, *, white: tuple[float, float, float] | None, look: FilmLook
) -> TexturedMesh:
    """A mesh whose textures are pictures of their light: exposed together and developed."""
    from seasonscapes.exposure import develop

    pictures = [
        develop(radiance, ev100, eye=look.exposure == "eye", look=look.look, white=white) for radiance in lit.radiance
    ]
    textures = [replace(t, values=np.clip(p, 0.0, 1.0)) for t, p in zip(lit.mesh.textures, pictures, strict=True)]
    return with_textures(lit.mesh, textures)


def save_lit_textures(folder: Path, lit: LitMesh, pictures: TexturedMesh, *, kind: str, bits: int) -> list[Path]:
    """Write the lit textures of a mesh into a folder under their own names.

    Parameters
    ----------
    folder
        Made if it is missing.
    lit
        Radiance and illuminance, for ``exr``.
    pictures
        Of `lit_pictures`, for ``png``.
    kind
        ``png``, or ``exr``: radiance [cd/m²], illuminance [lx] and albedo.
    bits
        Of ``png``.
    """
    layers = [
        {"": radiance, "illuminance": illuminance, "albedo": texture.values}
        for radiance, illuminance, texture in zip(lit.radiance, lit.illuminance, lit.mesh.textures, strict=True)
    ]
    units = "radiance in cd/m2; illuminance in lux; albedo 0 to 1"
    return _save(folder, pictures, layers, kind=kind, bits=bits, header=(lit.facts, units))


def save_delit_textures(folder: Path, delit: DelitMesh, *, kind: str, bits: int) -> list[Path]:
    """Write the albedo textures of a mesh into a folder under their own names; ``exr`` has their standard errors too."""
    layers = [{"": t.values, "sigma": s} for t, s in zip(delit.mesh.textures, delit.sigma, strict=True)]
    return _save(folder, delit.mesh, layers, kind=kind, bits=bits, header=(delit.facts, "reflectance 0 to 1"))


def _save(
    folder: Path,
    mesh: TexturedMesh,
    layers: list[dict[str, np.ndarray]],
    *,
    kind: str,
    bits: int,
    header: tuple[dict[str, Any], str],
) -> list[Path]:
    if any(texture.of_vertices for texture in mesh.textures):
        cure = "write the mesh itself, as .glb or .ply"
        raise InputError("--textures", "vertex colours are no image", got=mesh.path.name, cure=cure)
    paths = []
    for texture, values in zip(mesh.textures, layers, strict=True):
        path = folder / Path(texture.name).with_suffix(f".{kind}").name
        if path.resolve() == (mesh.path.parent / texture.name).resolve():
            raise InputError(path, "would replace a texture of the mesh itself", cure="choose another folder")
        paths.append(path)
        if kind == "exr":
            facts = {"seasonscapes:provenance": header[0], "seasonscapes:units": header[1]}
            write_exr(path, values, header=facts)
            continue
        data = encode_texture(texture.values, texture.alpha, ".png", bits, str(path))
        with atomic_path(path) as temporary:
            temporary.write_bytes(data)
    return paths
