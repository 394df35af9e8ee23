"""Reading of textured meshes (glTF, GLB, OBJ with MTL, PLY) through trimesh.

Files that a mesh refers to are read here and nowhere else: trimesh is given geometry and names of materials alone, so
that no mesh file can make it open something outside its folder, and textures of 16 bits keep them.
"""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.images import linear_from_srgb
from seasonscapes.terrain.mesh_images import decode_texture, image_size, require_memory
from seasonscapes.terrain.textured_mesh import MeshPart, MeshTexture

SUFFIXES = (".glb", ".gltf", ".obj", ".ply")


@dataclass
class MeshFile:
    """What a mesh file holds, in its own axes.

    Parameters
    ----------
    parts, textures
        See `textured_mesh`.
    images
        Contents of the image files behind the textures.
    """

    parts: list[MeshPart] = field(default_factory=list)
    textures: list[MeshTexture] = field(default_factory=list)
    images: dict[str, bytes] = field(default_factory=dict)


def read_mesh_file(path: Path, *, allow_outside: bool, memory_bytes: int) -> MeshFile:
    """Read the parts and textures of a mesh file.

    Parameters
    ----------
    path
        ``.glb``, ``.gltf``, ``.obj`` or ``.ply``.
    allow_outside
        Let the file refer to files outside its folder.
    memory_bytes
        Memory that work on the textures may take.

    Raises
    ------
    InputError
        For files that are missing or broken, refer to files that are missing or outside the folder, have neither
        textures nor vertex colours, or textures that are too large.
    """
    if not path.is_file():
        raise InputError(path, "no such file")
    readers: dict[str, Callable[[Path, bool], MeshFile]] = {
        ".glb": _read_gltf,
        ".gltf": _read_gltf,
        ".obj": _read_obj,
        ".ply": _read_ply,
    }
    if path.suffix.lower() not in readers:
        raise InputError(path, "unknown kind of mesh", got=path.suffix, expected=", ".join(SUFFIXES))
    file = readers[path.suffix.lower()](path, allow_outside)
    if not any(len(part.faces) for part in file.parts):
        raise InputError(path, "no faces in it", expected="a mesh of triangles; point clouds have none")
    where = [f"{path}: texture {name}" for name in file.images]
    texels = sum(int(np.prod(image_size(data, at))) for data, at in zip(file.images.values(), where, strict=True))
    require_memory(texels, str(path), memory_bytes)
    images = [decode_texture(data, name, at) for (name, data), at in zip(file.images.items(), where, strict=True)]
    # Images come first in the list of textures, in the order in which the parts number them.
    file.textures = images + file.textures
    _check(path, file)
    return file


def _check(path: Path, file: MeshFile) -> None:
    """`InputError` for meshes without colours, with textures but no coordinates, or with positions that are none."""
    if not any(part.texture >= 0 for part in file.parts):
        raise InputError(path, "neither textures nor vertex colours in it", cure="export the mesh with its textures")
    for part in file.parts:
        broken = int((~np.isfinite(part.vertices)).any(axis=1).sum())
        if broken:
            cure = "remove them in the program that made the mesh"
            raise InputError(path, f"{broken} vertices of part {part.name} are no numbers", got="NaN", cure=cure)
        if len(part.faces) and (part.faces.min() < 0 or part.faces.max() >= len(part.vertices)):
            raise InputError(path, f"faces of part {part.name} name vertices that do not exist")
        if part.texture < 0 or file.textures[part.texture].of_vertices or not len(part.faces):
            continue
        if part.uv is None or not np.isfinite(part.uv[np.unique(part.faces)]).all():
            cure = "unwrap the mesh and bake its texture, or give it vertex colours"
            raise InputError(path, f"part {part.name} has a texture but no texture coordinates", cure=cure)
        if np.ptp(part.uv[np.unique(part.faces)], axis=0).max() == 0.0:
            raise InputError(path, f"all texture coordinates of part {part.name} are the same point")


def _referenced(path: Path, name: str, allow_outside: bool, what: str) -> bytes:
    """Contents of a file that a mesh refers to."""
    target = _allowed(path, name, allow_outside, what)
    if not target.is_file():
        raise InputError(f"{path}: {what}", "no such file", got=name, expected=f"a file in {path.parent.resolve()}")
    return target.read_bytes()


def _allowed(path: Path, name: str, allow_outside: bool, what: str) -> Path:
    """Path of a file that a mesh refers to; `InputError` where it is on the network or outside the mesh's folder."""
    where = f"{path}: {what}"
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:", name):
        raise InputError(
            where, "a file on the network", got=name, cure="download it beside the mesh, and name it there"
        )
    folder = path.parent.resolve()
    target = (folder / name.replace("\\", "/")).resolve()
    if not allow_outside and not target.is_relative_to(folder):
        raise InputError(where, "outside the mesh's folder", got=name, cure="--allow-outside, if the file is trusted")
    return target


# --- glTF -------------------------------------------------------------------------------------------------------------


def load_document(path: Path, allow_outside: bool) -> tuple[Any, bytes]:
    """A glTF document, and the contents of all its buffers as one; its buffer views are those of that one buffer.

    Raises
    ------
    InputError
        For files that are not glTF, or buffers that are missing, on the network or outside the folder.
    """
    import pygltflib

    try:
        if path.suffix.lower() == ".glb":
            document = pygltflib.GLTF2.load_binary(str(path))
        else:
            document = pygltflib.GLTF2.load_json(str(path))
        assert document is not None
    except Exception as error:  # pygltflib raises whatever struct, json and dataclasses raise
        text = f"not a readable glTF file ({type(error).__name__})"
        raise InputError(path, text, expected="glTF 2.0") from None
    blob, offsets = b"", []
    for index, buffer in enumerate(document.buffers):
        offsets.append(len(blob))
        if buffer.uri is None:
            data = document.binary_blob() or b""
        elif buffer.uri.startswith("data:"):
            data = _data_uri(buffer.uri, f"{path}: buffer {index}")
        else:
            data = _referenced(path, unquote(buffer.uri), allow_outside, f"buffer {index}")
        if len(data) < buffer.byteLength:
            raise InputError(path, f"buffer {index} is cut short", got=len(data), expected=f"{buffer.byteLength} bytes")
        blob += data[: buffer.byteLength] + b"\0" * (-buffer.byteLength % 4)
    for view in document.bufferViews:
        view.byteOffset, view.buffer = (view.byteOffset or 0) + offsets[view.buffer], 0
    document.buffers = [pygltflib.Buffer(byteLength=len(blob))] if blob else []
    document.set_binary_blob(blob)
    return document, blob


def _data_uri(uri: str, where: str) -> bytes:
    try:
        return base64.b64decode(uri.partition(",")[2], validate=False)
    except ValueError:
        raise InputError(where, "a broken data URI") from None


def base_image(document: Any, material: Any) -> int | None:
    """Index of the image that a material takes its colour from."""
    pbr = material.pbrMetallicRoughness
    if pbr is None or pbr.baseColorTexture is None:
        return None
    texture = document.textures[pbr.baseColorTexture.index]
    extensions = texture.extensions or {}
    for name in ("EXT_texture_webp", "KHR_texture_basisu", "EXT_texture_avif"):
        if name in extensions:
            return int(extensions[name]["source"])
    return texture.source


def image_name(document: Any, index: int) -> str:
    """Name of an image of a glTF document: its file, its name, or its number."""
    image = document.images[index]
    if image.uri is not None and not image.uri.startswith("data:"):
        return Path(unquote(image.uri)).name
    return image.name or f"texture{index}"


def _read_gltf(path: Path, allow_outside: bool) -> MeshFile:
    import trimesh

    document, blob = load_document(path, allow_outside)
    for index, image in enumerate(document.images):
        # Normal maps and such are not read here, but are copied when the mesh is written.
        if image.uri is not None and not image.uri.startswith("data:"):
            _allowed(path, unquote(image.uri), allow_outside, f"texture {index}")
    file, number = MeshFile(), {}
    materials = document.materials
    for material in materials:
        index = base_image(document, material)
        if index is not None and index not in number:
            number[index] = len(number)
            name = _unique(image_name(document, index), file.images)
            file.images[name] = _image_bytes(path, document, blob, index, allow_outside)
    choice = [(base_image(document, material), _factor(material), _uv_transform(material)) for material in materials]
    for index, material in enumerate(materials):
        # Geometry alone goes to trimesh; its materials are recognised by these names.
        material.name, material.extensions = str(index), {}
        material.normalTexture = material.occlusionTexture = material.emissiveTexture = None
        if material.pbrMetallicRoughness is not None:
            if (texture := material.pbrMetallicRoughness.baseColorTexture) is not None and texture.texCoord:
                cure = "export it with the colour's texture in the first set of coordinates"
                raise InputError(path, "a colour texture in the second set of coordinates", cure=cure)
            material.pbrMetallicRoughness.baseColorTexture = None
            material.pbrMetallicRoughness.metallicRoughnessTexture = None
    document.images, document.textures, document.samplers = [], [], []
    document.animations, document.skins, document.cameras = [], [], []
    for mesh in document.meshes:
        mesh.name = None
    try:
        scene = trimesh.load_scene(
            io.BytesIO(b"".join(document.save_to_bytes())), file_type="glb", process=False, ignore_broken=False
        )
    except Exception as error:  # trimesh lets errors of numpy and json through
        raise InputError(path, f"not a readable glTF file ({type(error).__name__}: {error})") from None
    for node in sorted(scene.graph.nodes_geometry):
        transform, name = scene.graph[node]
        geometry = scene.geometry[name]
        if not hasattr(geometry, "faces"):
            continue
        label = getattr(getattr(geometry.visual, "material", None), "name", None)
        plain = (None, (1.0, 1.0, 1.0), None)
        image, factor, uv_transform = choice[int(label)] if label and label.isdigit() else plain
        uv = getattr(geometry.visual, "uv", None)
        if uv is not None and uv_transform is not None:
            uv = np.c_[uv[:, 0], 1.0 - uv[:, 1], np.ones(len(uv))] @ uv_transform.T
            uv = np.c_[uv[:, 0], 1.0 - uv[:, 1]]
        colours = None
        if image is None and geometry.visual.kind == "vertex":
            colours = _unit(geometry.visual.vertex_colors)
        elif image is None and "color" in getattr(geometry.visual, "vertex_attributes", {}):
            colours = _unit(geometry.visual.vertex_attributes["color"])
        normals = geometry._cache.get("vertex_normals") if "vertex_normals" in geometry._cache else None
        _add_part(
            file,
            str(node),
            np.asarray(geometry.vertices, float) @ transform[:3, :3].T + transform[:3, 3],
            _wound(np.asarray(geometry.faces), transform),
            texture=None if image is None else number[image],
            uv=uv,
            normals=None if normals is None else np.asarray(normals, float) @ np.linalg.inv(transform[:3, :3]),
            look=(factor, colours),
        )
    return file


def _wound(faces: np.ndarray, transform: np.ndarray) -> np.ndarray:
    """Faces whose winding a mirroring transform has not turned."""
    return faces[:, ::-1] if np.linalg.det(transform[:3, :3]) < 0.0 else faces


def _factor(material: Any) -> tuple[float, float, float]:
    pbr = material.pbrMetallicRoughness
    red, green, blue = (pbr.baseColorFactor or (1.0, 1.0, 1.0, 1.0))[:3] if pbr is not None else (1.0, 1.0, 1.0)
    return float(red), float(green), float(blue)


def _uv_transform(material: Any) -> np.ndarray | None:
    """``(2, 3)`` of KHR_texture_transform, v downwards."""
    pbr = material.pbrMetallicRoughness
    texture = None if pbr is None else pbr.baseColorTexture
    given = None if texture is None else (texture.extensions or {}).get("KHR_texture_transform")
    if given is None:
        return None
    (u, v), (su, sv) = given.get("offset", (0.0, 0.0)), given.get("scale", (1.0, 1.0))
    cosine, sine = np.cos(given.get("rotation", 0.0)), np.sin(given.get("rotation", 0.0))
    return np.array([[cosine * su, sine * sv, u], [-sine * su, cosine * sv, v]])


def _image_bytes(path: Path, document: Any, blob: bytes, index: int, allow_outside: bool) -> bytes:
    image = document.images[index]
    if image.bufferView is not None:
        view = document.bufferViews[image.bufferView]
        return blob[view.byteOffset : view.byteOffset + view.byteLength]
    if image.uri is None:
        raise InputError(f"{path}: texture {index}", "neither a file nor data in it")
    if image.uri.startswith("data:"):
        return _data_uri(image.uri, f"{path}: texture {index}")
    return _referenced(path, unquote(image.uri), allow_outside, f"texture {index}")


# --- OBJ --------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ObjMaterial:
    """A material of an MTL file: its colour's texture, the line that names it, and the diffuse colour."""

    texture: str | None
    colour: tuple[float, float, float]


def read_materials(path: Path, allow_outside: bool) -> dict[str, ObjMaterial]:
    """Materials of the MTL files that an OBJ file names.

    Raises
    ------
    InputError
        For MTL files that are missing, on the network or outside the folder.
    """
    found: dict[str, ObjMaterial] = {}
    for library in material_files(path):
        name = None
        for line in _referenced(path, library, allow_outside, "mtllib").decode("utf-8", "replace").splitlines():
            key, _, rest = line.strip().partition(" ")
            if key == "newmtl":
                name = rest.strip()
                found[name] = ObjMaterial(None, (0.8, 0.8, 0.8))
            elif name is not None and key == "Kd" and len(rest.split()) >= 3:
                red, green, blue = _colour(f"{path.parent / library}: {name}", rest)
                found[name] = ObjMaterial(found[name].texture, (red, green, blue))
            elif name is not None and key == "map_Kd":
                found[name] = ObjMaterial(texture_of_line(rest), found[name].colour)
    return found


def _colour(where: str, text: str) -> tuple[float, float, float]:
    try:
        red, green, blue = (float(value) for value in text.split()[:3])
    except ValueError:
        raise InputError(where, "a colour that is no three numbers", got=text, expected="Kd R G B") from None
    return red, green, blue


def material_files(path: Path) -> list[str]:
    """Names of the MTL files of an OBJ file."""
    with path.open(encoding="utf-8", errors="replace") as lines:
        return [line.split(maxsplit=1)[1].strip() for line in lines if line.startswith("mtllib ")]


def texture_of_line(text: str) -> str:
    """File of a ``map_Kd`` line, whose options (``-s 1 1 1``, ``-clamp on`` …) come first."""
    words = text.strip()
    option = re.compile(r"-(?:blendu|blendv|clamp|cc|imfchan|texres|bm|boost|type)\s+\S+\s+")
    numbers = re.compile(r"-(?:s|o|t|mm)(?:\s+[-+0-9.eE]+){1,3}\s+")
    while match := option.match(words) or numbers.match(words):
        words = words[match.end() :]
    return words


def _read_obj(path: Path, allow_outside: bool) -> MeshFile:
    from trimesh.exchange.obj import load_obj

    materials, file, number = read_materials(path, allow_outside), MeshFile(), {}
    for material in materials.values():
        if material.texture is not None and material.texture not in number:
            number[material.texture] = len(number)
            name = _unique(Path(material.texture.replace("\\", "/")).name, file.images)
            file.images[name] = _referenced(path, material.texture, allow_outside, "map_Kd")
    stub = "".join(f"newmtl {name}\nKd 1 1 1\n" for name in materials).encode()
    try:
        with path.open("rb") as stream:
            # The first library holds all materials here; trimesh reads no other.
            loaded = load_obj(stream, resolver=dict.fromkeys(material_files(path), stub), maintain_order=False)  # pyright: ignore[reportArgumentType]
    except Exception as error:  # trimesh lets errors of numpy through
        raise InputError(path, f"not a readable OBJ file ({type(error).__name__}: {error})") from None
    for name, geometry in loaded.get("geometry", {}).items():
        visual = geometry.get("visual")
        material = materials.get(str(getattr(getattr(visual, "material", None), "name", "")))
        texture = None if material is None or material.texture is None else number[material.texture]
        colours = geometry.get("vertex_colors") if texture is None else None
        _add_part(
            file,
            name,
            np.asarray(geometry["vertices"], float),
            np.asarray(geometry["faces"]),
            texture=texture,
            uv=getattr(visual, "uv", None),
            normals=geometry.get("vertex_normals"),
            look=(
                # Many programs write Kd 0 or 0.8 beside a texture and ignore it.
                (1.0, 1.0, 1.0) if texture is not None or material is None else material.colour,
                None if colours is None else linear_from_srgb(_unit(colours)),
            ),
        )
    return file


# --- PLY --------------------------------------------------------------------------------------------------------------


def ply_textures(path: Path) -> list[str]:
    """Texture files that the header of a PLY file names."""
    header = path.read_bytes()[:65536].partition(b"end_header")[0].decode("ascii", "replace")
    return [line.split("TextureFile", 1)[1].strip() for line in header.splitlines() if "TextureFile" in line]


def _read_ply(path: Path, allow_outside: bool) -> MeshFile:
    from trimesh.exchange.ply import load_ply

    file, names = MeshFile(), ply_textures(path)
    if len(names) > 1:
        raise InputError(path, f"{len(names)} textures in one PLY", cure="export the mesh as GLB or OBJ")
    stub = dict.fromkeys(names, _ONE_PIXEL)
    if names:
        file.images[Path(names[0].replace("\\", "/")).name] = _referenced(path, names[0], allow_outside, "TextureFile")
    try:
        with path.open("rb") as stream:
            loaded = load_ply(stream, resolver=stub, fix_texture=True, prefer_color="vertex")  # pyright: ignore[reportArgumentType]
    except Exception as error:  # trimesh lets errors of numpy and struct through
        raise InputError(path, f"not a readable PLY file ({type(error).__name__}: {error})") from None
    if "faces" not in loaded:
        raise InputError(path, "no faces in it", expected="a mesh of triangles; point clouds have none")
    colours = loaded.get("vertex_colors") if not names else None
    _add_part(
        file,
        path.stem,
        np.asarray(loaded["vertices"], float),
        np.asarray(loaded["faces"]),
        texture=0 if names else None,
        uv=getattr(loaded.get("visual"), "uv", None),
        normals=loaded.get("vertex_normals"),
        look=((1.0, 1.0, 1.0), None if colours is None else linear_from_srgb(_unit(colours))),
    )
    return file


_ONE_PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mP8z8BQDwAEhQGAhKmMIQAAAABJRU5ErkJggg=="
)


# --- common -----------------------------------------------------------------------------------------------------------


def _unit(colours: np.ndarray) -> np.ndarray:
    """Colours ``(V, 3)`` in [0, 1] of integers or floats."""
    values = np.asarray(colours)[:, :3]
    if values.dtype == np.uint16:
        return values.astype(np.float32) / np.float32(65535.0)
    integers = np.issubdtype(values.dtype, np.integer) or float(values.max(initial=0.0)) > 1.0
    return values.astype(np.float32) / np.float32(255.0 if integers else 1.0)


def _unique(name: str, taken: dict[str, bytes]) -> str:
    name = Path(name.replace("\\", "/")).name
    name = "texture" if name in ("", ".", "..") else name
    stem, suffix, number, result = Path(name).stem, Path(name).suffix, 1, name
    while result in taken:
        number += 1
        result = f"{stem}-{number}{suffix}"
    return result


def _add_part(
    file: MeshFile,
    name: str,
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    texture: int | None,
    uv: np.ndarray | None,
    normals: np.ndarray | None,
    look: tuple[tuple[float, float, float], np.ndarray | None],
) -> None:
    """Add faces, with their texture or vertex colours; ``look`` is the colour factor and the vertices' colours."""
    factor, colours = look
    index = -1 if texture is None else texture
    if colours is not None:
        index = len(file.images) + len(file.textures)
        values = np.ascontiguousarray(colours[:, None, :], np.float32)
        file.textures.append(MeshTexture(f"{name} vertices", values, of_vertices=True))
    if normals is not None:
        normals = np.asarray(normals, float)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        usable = len(normals) == len(vertices) and bool(np.isfinite(length).all() and (length > 0.0).all())
        normals = normals / length if usable else None
    uv = None if uv is None or len(uv) != len(vertices) else np.asarray(uv, float)[:, :2]
    file.parts.append(MeshPart(name, vertices, np.asarray(faces, np.int64), index, uv, normals, factor))
