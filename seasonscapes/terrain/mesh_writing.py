"""Writing of textured meshes: the file that was read with other textures, or a new GLB.

A file of the kind that was read keeps everything but its textures to the byte: vertices, texture coordinates, nodes,
names. Any mesh can also be written as GLB.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.images import atomic_path, srgb_from_linear
from seasonscapes.terrain.mesh_images import encode_texture, file_suffix
from seasonscapes.terrain.mesh_reading import (
    base_image,
    image_name,
    load_document,
    material_files,
    ply_textures,
    read_materials,
    texture_of_line,
)
from seasonscapes.terrain.textured_mesh import MeshTexture, TexturedMesh

_GLTF = (".glb", ".gltf")
_UNLIT = "KHR_materials_unlit"
_IMAGE_EXTENSIONS = ("EXT_texture_webp", "KHR_texture_basisu", "EXT_texture_avif")


def save_mesh(
    path: str | Path,
    mesh: TexturedMesh,
    *,
    bits: int | None = None,
    unlit: bool = False,
    facts: dict[str, Any] | None = None,
) -> list[Path]:
    """Write a mesh with its textures, atomically.

    Parameters
    ----------
    path
        ``.glb``, or the kind of file that the mesh was read from: that keeps all but the textures. The textures of
        ``.obj``, ``.ply`` and ``.gltf`` are written beside it under their own names.
    mesh
        The mesh; its textures are written as sRGB.
    bits
        8 or 16 bits per channel; as in the file that was read if left out.
    unlit
        Whether the textures contain the light; viewers of glTF then add none.
    facts
        JSON-serialisable values for ``asset.extras`` of glTF.

    Returns
    -------
    list of pathlib.Path
        The files written, the mesh first.

    Raises
    ------
    InputError
        For another kind of file, or one that would replace a file of the mesh that was read.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np, trimesh
    >>> import seasonscapes as ss
    >>> ball = trimesh.creation.icosphere(subdivisions=2)
    >>> ball.visual.vertex_colors = np.full((len(ball.vertices), 4), (120, 110, 90, 255), np.uint8)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     _ = ball.export(f"{folder}/ball.ply")
    ...     [file.name for file in ss.save_mesh(f"{folder}/copy.glb", ss.load_mesh(f"{folder}/ball.ply"))]
    ['copy.glb']
    """
    path = Path(path)
    if bits not in (None, 8, 16):
        raise InputError("--bits", "unknown depth", got=bits, expected="8 or 16")
    textures = [replace(t, bits=bits or t.bits) for t in mesh.textures]
    if not require_writable(path, mesh):
        document, blob = _new_document(mesh)
        return _write_document(path, mesh, document, blob, [t for t in textures if not t.of_vertices], unlit, facts)
    if path.suffix.lower() in _GLTF:
        document, blob = load_document(mesh.path, allow_outside=True)
        return _write_document(path, mesh, document, blob, textures, unlit, facts)
    writers: dict[str, Callable[[Path, TexturedMesh, list[MeshTexture]], list[Path]]]
    writers = {".obj": _write_obj, ".ply": _write_ply}
    return writers[path.suffix.lower()](path, mesh, textures)


def require_writable(path: Path, mesh: TexturedMesh) -> bool:
    """Whether a file keeps all but the textures of the one that was read; otherwise it is a new GLB.

    Raises
    ------
    InputError
        For a kind of file that this mesh cannot be written as, or the file that it was read from.
    """
    _require_new(path, mesh, [])
    suffix, source = path.suffix.lower(), mesh.path.suffix.lower()
    of_vertices = any(texture.of_vertices for texture in mesh.textures)
    same = suffix == source or (suffix in _GLTF and source in _GLTF)
    if same and (suffix == ".ply" or not of_vertices):
        return True
    if suffix != ".glb":
        expected = ".glb or, of a .ply, .ply" if of_vertices else f".glb or {source}"
        raise InputError(path, "this mesh cannot be written so", got=suffix, expected=expected)
    return False


def _require_new(path: Path, mesh: TexturedMesh, sources: Sequence[Path]) -> None:
    """`InputError` for a file that is one of those which the mesh was read from."""
    if any(path.resolve() == source.resolve() for source in [mesh.path, *sources]):
        raise InputError(path, "would replace a file of the mesh itself", cure="choose another folder for --output")


# --- glTF -------------------------------------------------------------------------------------------------------------


def _write_document(
    path: Path,
    mesh: TexturedMesh,
    document: Any,
    blob: bytes,
    textures: list[MeshTexture],
    unlit: bool,
    facts: dict[str, Any] | None,
) -> list[Path]:
    """Write a glTF document with other images."""
    import pygltflib

    order: dict[int, int] = {}
    for material in document.materials:
        index = base_image(document, material)
        if index is not None:
            order.setdefault(index, len(order))
            material.pbrMetallicRoughness.baseColorFactor = [1.0, 1.0, 1.0, _alpha(material)]
    beside: list[tuple[Path, bytes]] = []
    views: dict[int, bytes] = {}
    for index, number in order.items():
        image, texture, where = document.images[index], textures[number], f"{path}: texture {index}"
        name = image_name(document, index)
        if path.suffix.lower() == ".gltf" and image.uri is not None and not image.uri.startswith("data:"):
            target = path.parent / Path(name).with_suffix(file_suffix(name, texture.bits))
            _require_new(target, mesh, [mesh.path.parent / unquote(image.uri)])
            data = encode_texture(texture.values, texture.alpha, target.suffix, texture.bits, where)
            beside.append((target, data))
            image.uri, image.mimeType = quote(target.name), _mime(target.suffix)
            continue
        if image.bufferView is None:
            document.bufferViews.append(pygltflib.BufferView(buffer=0, byteOffset=0, byteLength=0))
            image.bufferView = len(document.bufferViews) - 1
        views[image.bufferView] = encode_texture(texture.values, texture.alpha, ".png", texture.bits, where)
        image.name, image.uri, image.mimeType = image.name or name, None, "image/png"
    _plain_sources(document)
    _embed_rest(mesh, document, views, set(order))
    data = _joined(document, blob, views)
    _mark_unlit(document, unlit)
    document.asset.extras = {**(document.asset.extras or {}), "seasonscapes": _plain(facts or {})}
    document.buffers = [pygltflib.Buffer(byteLength=len(data))]
    if path.suffix.lower() == ".gltf":
        binary = path.with_suffix(".bin")
        _require_new(binary, mesh, [])
        document.buffers[0].uri = binary.name
        beside.append((binary, data))
        document.set_binary_blob(None)
        content = document.to_json(indent=1).encode()
    else:
        document.set_binary_blob(data)
        content = b"".join(document.save_to_bytes())
    for target, values in [*beside, (path, content)]:
        _write(target, values)
    return [path, *(target for target, _ in beside)]


def _alpha(material: Any) -> float:
    factor = material.pbrMetallicRoughness.baseColorFactor
    return 1.0 if factor is None or len(factor) < 4 else float(factor[3])


def _mime(suffix: str) -> str:
    return "image/jpeg" if suffix.lower() in (".jpg", ".jpeg") else "image/png"


def _plain(facts: dict[str, Any]) -> dict[str, Any]:
    return json.loads(json.dumps(facts, default=float))


def _plain_sources(document: Any) -> None:
    """Let textures name their images as glTF itself does: the new ones are PNG or JPEG."""
    for texture in document.textures:
        extensions = texture.extensions or {}
        for name in _IMAGE_EXTENSIONS:
            if name in extensions:
                texture.source = int(extensions.pop(name)["source"])
    for listed in (document.extensionsUsed, document.extensionsRequired):
        for name in _IMAGE_EXTENSIONS:
            if listed and name in listed:
                listed.remove(name)


def _embed_rest(mesh: TexturedMesh, document: Any, views: dict[int, bytes], written: set[int]) -> None:
    """Carry images that are no colour (normal maps and such) along in the file."""
    import pygltflib

    for index, image in enumerate(document.images):
        if index in written or image.uri is None or image.uri.startswith("data:"):
            continue
        source = mesh.path.parent / unquote(image.uri)
        if not source.is_file():
            raise InputError(f"{mesh.path}: texture {index}", "no such file", got=image.uri)
        document.bufferViews.append(pygltflib.BufferView(buffer=0, byteOffset=0, byteLength=0))
        image.bufferView = len(document.bufferViews) - 1
        views[image.bufferView] = source.read_bytes()
        image.mimeType, image.name, image.uri = _mime(source.suffix), image.name or source.name, None


def _joined(document: Any, blob: bytes, views: dict[int, bytes]) -> bytes:
    """All buffer views one after another, some of them with other contents."""
    joined = bytearray()
    for index, view in enumerate(document.bufferViews):
        start = view.byteOffset or 0
        data = views.get(index, blob[start : start + view.byteLength])
        view.buffer, view.byteOffset, view.byteLength = 0, len(joined), len(data)
        joined += data + b"\0" * (-len(data) % 4)
    return bytes(joined)


def _mark_unlit(document: Any, unlit: bool) -> None:
    for material in document.materials:
        extensions = dict(material.extensions or {})
        extensions.pop(_UNLIT, None)
        if unlit:
            extensions[_UNLIT] = {}
        material.extensions = extensions
    used = [name for name in document.extensionsUsed or [] if name != _UNLIT]
    document.extensionsUsed = [*used, _UNLIT] if unlit and document.materials else used
    required = document.extensionsRequired or []
    document.extensionsRequired = [name for name in required if name != _UNLIT]


def _new_document(mesh: TexturedMesh) -> tuple[Any, bytes]:
    """A glTF document of a mesh from another kind of file, with images of one pixel."""
    import pygltflib
    import trimesh
    from PIL import Image
    from trimesh.visual.color import ColorVisuals
    from trimesh.visual.material import PBRMaterial
    from trimesh.visual.texture import TextureVisuals

    turn = np.eye(4)
    if mesh.up == "z":
        turn[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    used = [part.vertices[np.unique(part.faces)] for part in mesh.parts]
    # Single precision holds metres of map coordinates to a decimetre: the shift is a node's.
    middle = np.round(np.mean([points.mean(axis=0) for points in used], axis=0))
    shift = np.eye(4)
    shift[:3, 3] = middle if np.abs(middle).max() > 1e4 else 0.0
    scene, materials = trimesh.Scene(), {}
    for index, texture in enumerate(mesh.textures):
        # A distinct pixel for each, or trimesh would merge equal images.
        pixel = Image.new("RGB", (1, 1), (index % 256, index // 256 % 256, 7))
        materials[index] = PBRMaterial(
            name=texture.name, baseColorTexture=pixel, metallicFactor=0.0, roughnessFactor=1.0
        )
    for number, part in enumerate(mesh.parts):
        geometry = trimesh.Trimesh(part.vertices - shift[:3, 3], part.faces, process=False)
        if part.texture < 0:
            colour = [*(round(255.0 * float(srgb_from_linear(np.array(c)))) for c in part.colour), 255]
            geometry.visual = TextureVisuals(
                uv=np.zeros((len(part.vertices), 2)),
                material=PBRMaterial(baseColorFactor=colour, metallicFactor=0.0, roughnessFactor=1.0),
            )
        elif mesh.textures[part.texture].of_vertices:
            # Vertex colours of glTF are linear.
            levels = np.rint(np.clip(mesh.textures[part.texture].values[:, 0], 0.0, 1.0) * 255.0).astype(np.uint8)
            geometry.visual = ColorVisuals(geometry, vertex_colors=np.c_[levels, np.full(len(levels), 255, np.uint8)])
        else:
            geometry.visual = TextureVisuals(uv=part.uv, material=materials[part.texture])
        scene.add_geometry(
            geometry, node_name=f"{part.name}-{number}", geom_name=f"{part.name}-{number}", transform=turn @ shift
        )
    exported = scene.export(file_type="glb")
    document = pygltflib.GLTF2.load_from_bytes(exported)
    assert document is not None
    _in_order(document, mesh)
    return document, document.binary_blob() or b""


def _in_order(document: Any, mesh: TexturedMesh) -> None:
    """Sort the materials' first use of images as the mesh's textures are numbered, and name the images."""
    names = [texture.name for texture in mesh.textures if not texture.of_vertices]
    rank = {name: number for number, name in enumerate(names)}
    order = sorted(range(len(document.materials)), key=lambda k: rank.get(document.materials[k].name, len(rank)))
    place = {old: new for new, old in enumerate(order)}
    document.materials = [document.materials[k] for k in order]
    for gltf_mesh in document.meshes:
        for primitive in gltf_mesh.primitives:
            if primitive.material is not None:
                primitive.material = place[primitive.material]
    for material in document.materials:
        index = base_image(document, material)
        if index is not None:
            document.images[index].name = material.name


# --- OBJ and PLY ------------------------------------------------------------------------------------------------------


def _write(path: Path, data: bytes) -> None:
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def _write_obj(path: Path, mesh: TexturedMesh, textures: list[MeshTexture]) -> list[Path]:
    """Write an OBJ with its MTL and textures; lines about faces and vertices stay as they are."""
    materials = read_materials(mesh.path, allow_outside=True)
    names = list(dict.fromkeys(m.texture for m in materials.values() if m.texture is not None))
    libraries = [mesh.path.parent / name for name in material_files(mesh.path)]
    sources = [mesh.path.parent / name.replace("\\", "/") for name in names]
    targets = {}
    for name, texture in zip(names, textures, strict=True):
        target = path.parent / Path(texture.name).with_suffix(file_suffix(texture.name, texture.bits))
        _require_new(target, mesh, [*sources, *libraries])
        targets[name] = (target, texture)
    library = path.with_suffix(".mtl")
    _require_new(library, mesh, [*sources, *libraries])
    lines = []
    for source in libraries:
        for line in source.read_text(encoding="utf-8", errors="replace").splitlines():
            word = line.strip().partition(" ")[0]
            if word == "map_Kd":
                name = texture_of_line(line.strip().partition(" ")[2])
                lines.append(line[: line.rindex(name)] + targets[name][0].name)
            elif not word.startswith(("map_", "bump", "norm", "disp", "decal", "refl")):
                lines.append(line)
    for target, texture in targets.values():
        _write(target, encode_texture(texture.values, texture.alpha, target.suffix, texture.bits, str(target)))
    _write(library, ("\n".join(lines) + "\n").encode())
    with mesh.path.open(encoding="utf-8", errors="surrogateescape", newline="") as stream:
        named, text = False, []
        for line in stream:
            if line.startswith("mtllib "):
                if not named:
                    text.append(f"mtllib {library.name}\n")
                named = True
                continue
            text.append(line)
    _write(path, "".join(text).encode("utf-8", "surrogateescape"))
    return [path, library, *(target for target, _ in targets.values())]


def _write_ply(path: Path, mesh: TexturedMesh, textures: list[MeshTexture]) -> list[Path]:
    """Write a PLY with its texture beside it, or with other vertex colours."""
    names = ply_textures(mesh.path)
    if names:
        texture = textures[0]
        target = path.parent / Path(texture.name).with_suffix(file_suffix(texture.name, texture.bits))
        _require_new(target, mesh, [mesh.path.parent / names[0]])
        header, end, body = mesh.path.read_bytes().partition(b"end_header")
        old, new = f"TextureFile {names[0]}".encode(), f"TextureFile {target.name}".encode()
        _write(target, encode_texture(texture.values, texture.alpha, target.suffix, texture.bits, str(target)))
        _write(path, header.replace(old, new) + end + body)
        return [path, target]
    import plyfile

    data = plyfile.PlyData.read(str(mesh.path))
    vertices = data["vertex"].data
    encoded = srgb_from_linear(textures[0].values[:, 0])
    for column, name in enumerate(("red", "green", "blue")):
        kind = vertices[name].dtype
        if kind.kind in "iu":
            vertices[name] = np.rint(encoded[:, column] * np.iinfo(kind).max).astype(kind)
        else:
            vertices[name] = encoded[:, column]
    with atomic_path(path) as temporary:
        data.write(str(temporary))
    return [path]
