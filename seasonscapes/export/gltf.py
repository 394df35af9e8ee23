"""A textured terrain with sun and moon as glTF 2.0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.export.axes import lamp_quaternion, y_up
from seasonscapes.export.gltf_file import GltfFile
from seasonscapes.images import png8_bytes
from seasonscapes.sky.illumination import Luminary
from seasonscapes.terrain.attributes import vertex_normals
from seasonscapes.terrain.surface import Terrain

# What the files' metadata say about pixels.
ALBEDO_COLOURS = "sRGB (IEC 61966-2-1) encoding of linear Rec.709 albedo in [0, 1]"
LIT_COLOURS = "sRGB (IEC 61966-2-1), display-referred: exposed and tone-mapped, no light is to be added"


@dataclass(frozen=True)
class TexturedTerrain:
    """A terrain with an 8-bit texture, and what is known about both.

    Parameters
    ----------
    terrain
        Surface with UV coordinates, in the lifted east-north-up frame of its ``frame``.
    picture
        ``(R, S, 3)`` uint8 sRGB, row 0 at v = 1.
    lit
        Whether the texture already contains the light (display-referred) or is albedo.
    about
        Plain values for the metadata of files.
    lamps
        Sun and moon by name, where viewers are to light the albedo.
    """

    terrain: Terrain
    picture: np.ndarray
    lit: bool
    about: dict[str, Any] = field(default_factory=dict)
    lamps: dict[str, Luminary] = field(default_factory=dict)


def shading_normals(terrain: Terrain) -> np.ndarray:
    """Unit normals ``(V, 3)`` float32 at the vertices: of the smooth surface where the terrain has one."""
    if terrain.surface is None:
        return vertex_normals(terrain)
    return terrain.surface.sample(terrain.vertices)[1]


def write_gltf(path: Path, model: TexturedTerrain) -> list[Path]:
    """Write a textured terrain as ``.glb``, or as ``.gltf`` with its files beside it.

    Axes are x east, y up, z south [m]. Sun and moon are directional lights (``KHR_lights_punctual``) in lux, colours in
    photometric linear Rec.709: colour × intensity is the illuminance of a plane that faces the light. The ground is
    Lambertian (no specular reflection). A lit texture gets ``KHR_materials_unlit``.

    Parameters
    ----------
    path
        File to write; ``.gltf`` for text, otherwise binary.
    model
        What to write.

    Returns
    -------
    list of Path
        The files.
    """
    axes = {"up_axis": "y", "axes": "x east, y up, z south", "unit": "metre"}
    file = GltfFile({**axes, "colour_space": LIT_COLOURS if model.lit else ALBEDO_COLOURS, **model.about})
    terrain = model.terrain
    normals = None if model.lit else shading_normals(terrain)
    texture = file.add_image("lit" if model.lit else "albedo", png8_bytes(model.picture), "image/png")
    mesh = add_mesh(file, (terrain.vertices, normals, terrain.uv, terrain.faces), lambertian(file, texture, model.lit))
    nodes = [file.add("nodes", {"name": "terrain", "mesh": mesh})]
    nodes += [_add_lamp(file, name, lamp) for name, lamp in model.lamps.items()]
    file.table |= {"scene": 0, "scenes": [{"nodes": nodes}]}
    if path.suffix.lower() == ".gltf":
        return file.write_gltf(path)
    file.write_glb(path)
    return [path]


def add_mesh(file: GltfFile, arrays: Sequence[np.ndarray | None], material: int) -> int:
    """Append a triangle mesh and return its index.

    Parameters
    ----------
    file
        The document.
    arrays
        Vertices ``(V, 3)`` and normals ``(V, 3)`` or ``None``, east-north-up; UV ``(V, 2)``, v upwards; faces ``(F, 3)``.
    material
        Index of the material.
    """
    vertices, normals, uv, faces = arrays
    assert vertices is not None
    assert uv is not None
    assert faces is not None
    attributes = {"POSITION": file.add_array(y_up(vertices), bounds=True)}
    if normals is not None:
        attributes["NORMAL"] = file.add_array(y_up(normals))
    # glTF counts v from the upper edge of the image.
    attributes["TEXCOORD_0"] = file.add_array(np.stack([uv[:, 0], 1.0 - uv[:, 1]], axis=1))
    primitive = {"attributes": attributes, "indices": file.add_faces(faces), "material": material, "mode": 4}
    return file.add("meshes", {"primitives": [primitive]})


def lambertian(file: GltfFile, texture: int, lit: bool) -> int:
    """Append a material that reflects diffusely alone, or one that viewers show as it is; return its index."""
    surface = {"baseColorTexture": {"index": texture}, "metallicFactor": 0.0, "roughnessFactor": 1.0}
    name, value = ("KHR_materials_unlit", {}) if lit else ("KHR_materials_specular", {"specularFactor": 0.0})
    file.use(name)
    return file.add("materials", {"name": "ground", "pbrMetallicRoughness": surface, "extensions": {name: value}})


def _add_lamp(file: GltfFile, name: str, lamp: Luminary) -> int:
    extension = "KHR_lights_punctual"
    file.use(extension)
    colour, lux = lamp_colour(lamp)
    lights = file.table.setdefault("extensions", {}).setdefault(extension, {"lights": []})["lights"]
    about = {"azimuth_deg": lamp.azimuth_deg, "elevation_deg": lamp.elevation_deg}
    about |= {"angular_diameter_deg": 2.0 * lamp.angular_radius_deg}
    lights.append({"name": name, "type": "directional", "color": colour, "intensity": lux, "extras": about})
    reference = {"light": len(lights) - 1}
    rotation = lamp_quaternion(y_up(lamp.direction))
    return file.add("nodes", {"name": name, "rotation": rotation, "extensions": {extension: reference}})


def lamp_colour(lamp: Luminary) -> tuple[list[float], float]:
    """Colour, whose largest component is 1, and intensity [lx]; their product is the normal illuminance."""
    rgb = np.maximum(np.asarray(lamp.normal_illuminance_lx, float), 0.0)
    largest = float(rgb.max())
    return (rgb / largest).tolist() if largest > 0.0 else [1.0, 1.0, 1.0], largest
