"""Textured meshes: every format is read alike, lies where it should, and keeps all but its textures when written."""

import json
import struct
import sys
import zlib
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pygltflib
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial
from trimesh.visual.texture import TextureVisuals

import seasonscapes as ss
from seasonscapes.cli import main
from seasonscapes.errors import InputError, NotEnoughEvidence
from seasonscapes.frames import enu_from_geodetic
from seasonscapes.images import linear_from_srgb, srgb_from_linear
from seasonscapes.terrain.crs import geodetic_from_map
from seasonscapes.terrain.mesh_atlas import mesh_atlas
from seasonscapes.terrain.textured_mesh import creased_normals
from seasonscapes.workflows.mesh_ground import require_above, scene_ground
from seasonscapes.workflows.mesh_views import camera_between, mesh_camera, mesh_view, relit_mesh_view
from seasonscapes.workflows.meshes import mesh_light, mesh_transport
from seasonscapes.workflows.place import ground_height_m

SUN = (135.0, 40.0)
AROUND = ss.MeshSurroundings(sky="hosek", rays=64)


def box_faces() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A box without bottom, 2 × 2 × 1 m, z up, each side with a cell of its own in a 3 × 2 texture."""
    sides = [
        [(-1, -1, 1), (1, -1, 1), (1, 1, 1), (-1, 1, 1)],
        [(-1, -1, 0), (1, -1, 0), (1, -1, 1), (-1, -1, 1)],
        [(1, -1, 0), (1, 1, 0), (1, 1, 1), (1, -1, 1)],
        [(1, 1, 0), (-1, 1, 0), (-1, 1, 1), (1, 1, 1)],
        [(-1, 1, 0), (-1, -1, 0), (-1, -1, 1), (-1, 1, 1)],
    ]
    vertices = np.array(sides, float).reshape(-1, 3)
    uv = np.concatenate(
        [np.array([[0, 0], [1, 0], [1, 1], [0, 1]]) * 0.8 + 0.1 + [side % 3, side // 3] for side in range(5)]
    ) / np.array([3.0, 2.0])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * side for side in range(5)])
    return vertices, faces, uv


def levels(seed: int, *, rows: int = 24, bits: int = 8) -> np.ndarray:
    """Smooth coloured levels ``(rows, 36, 3)``."""
    noise = cv2.resize(np.random.default_rng(seed).uniform(0.3, 0.75, (4, 6, 3)), (36, rows))
    return np.rint(noise * (2**bits - 1)).astype(np.uint8 if bits == 8 else np.uint16)


def scene_of_two(shift: tuple[float, float, float] = (0.0, 0.0, 0.0), *, up: str = "y") -> trimesh.Scene:
    """Two boxes with a texture each, the second one three metres east."""
    scene = trimesh.Scene()
    vertices, faces, uv = box_faces()
    for number in range(2):
        position = vertices + np.array([3.0 * number, 0.0, 0.0])
        if up == "y":
            position = np.stack([position[:, 0], position[:, 2], -position[:, 1]], axis=1)
        material = PBRMaterial(
            name=f"wall{number}", baseColorTexture=Image.fromarray(levels(number)), metallicFactor=0.0
        )
        mesh = trimesh.Trimesh(
            position + np.array(shift), faces, process=False, visual=TextureVisuals(uv=uv, material=material)
        )
        scene.add_geometry(mesh, node_name=f"box{number}", geom_name=f"box{number}")
    return scene


def write_glb(folder: Path, **options) -> Path:
    path = folder / "boxes.glb"
    path.write_bytes(scene_of_two(**options).export(file_type="glb"))
    return path


def write_gltf(folder: Path) -> Path:
    """A .gltf with its buffer and its textures beside it."""
    document = pygltflib.GLTF2.load_from_bytes(scene_of_two().export(file_type="glb"))
    assert document is not None
    blob = document.binary_blob()
    (folder / "boxes.bin").write_bytes(blob)
    for number, image in enumerate(document.images):
        Image.fromarray(levels(number)).save(folder / f"wall {number}.png")
        image.uri, image.bufferView, image.mimeType = f"wall%20{number}.png", None, None
    document.buffers[0].uri = "boxes.bin"
    document.set_binary_blob(None)
    (folder / "boxes.gltf").write_text(document.to_json())
    return folder / "boxes.gltf"


def write_obj(folder: Path, *, library: str = "boxes.mtl", texture: str = "wall%d.png") -> Path:
    vertices, faces, uv = box_faces()
    lines, materials = [f"mtllib {library}"], []
    for number in range(2):
        lines += [f"v {x + 3.0 * number:.6f} {y:.6f} {z:.6f}" for x, y, z in vertices]
        lines += [f"vt {u:.8f} {v:.8f}" for u, v in uv]
        lines += [f"usemtl wall{number}"]
        lines += ["f " + " ".join(f"{k}/{k}" for k in face + 1 + len(vertices) * number) for face in faces]
        materials += [f"newmtl wall{number}", "Kd 0.8 0.8 0.8", "map_Kd -s 1 1 1 " + (texture % number)]
        Image.fromarray(levels(number)).save(folder / f"wall{number}.png")
    (folder / "boxes.mtl").write_text("\n".join(materials))
    (folder / "boxes.obj").write_text("\n".join(lines) + "\n")
    return folder / "boxes.obj"


def write_ply(folder: Path, *, texture: str = "wall0.png") -> Path:
    """One box with its texture, coordinates at the faces as photogrammetry writes them."""
    vertices, faces, uv = box_faces()
    header = ["ply", "format ascii 1.0", f"comment TextureFile {texture}", f"element vertex {len(vertices)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    header += [
        f"element face {len(faces)}",
        "property list uchar int vertex_indices",
        "property list uchar float texcoord",
    ]
    rows = [" ".join(f"{x:g}" for x in vertex) for vertex in vertices]
    rows += [" ".join(["3", *map(str, face), "6", *(f"{value:.8f}" for value in uv[face].ravel())]) for face in faces]
    (folder / "box.ply").write_text("\n".join([*header, "end_header", *rows]) + "\n")
    Image.fromarray(levels(0)).save(folder / "wall0.png")
    return folder / "box.ply"


def coloured_ball(folder: Path, name: str = "ball.ply") -> Path:
    ball = trimesh.creation.icosphere(subdivisions=3)
    colours = np.rint(255.0 * (0.5 + 0.2 * np.sin(3.0 * ball.vertices))).astype(np.uint8)
    ball.visual.vertex_colors = np.c_[colours, np.full(len(colours), 255, np.uint8)]
    ball.export(folder / name)
    return folder / name


class TestReading:
    def test_all_kinds_of_file_hold_the_same_boxes(self, tmp_path):
        for path, up in ((write_glb(tmp_path), "y"), (write_gltf(tmp_path), "y"), (write_obj(tmp_path), "z")):
            mesh = ss.load_mesh(path)
            assert mesh.up == up
            low, high = mesh.bounds_m
            np.testing.assert_allclose(high - low, [5.0, 2.0, 1.0], atol=1e-6)
            assert len(mesh.textures) == 2
            for number, texture in enumerate(mesh.textures):
                np.testing.assert_array_equal(texture.values, linear_from_srgb(levels(number) / 255.0))
            # The texel at a point of the surface is the same one in every file.
            atlas = mesh_atlas(mesh, ground=None)
            points = surface_positions(atlas)[atlas.tiles[1].window]
            np.testing.assert_allclose(points[20, 6], EXPECTED_POINT, atol=2e-6)

    def test_ply_texture_and_coordinates_of_faces(self, tmp_path):
        mesh = ss.load_mesh(write_ply(tmp_path))
        np.testing.assert_array_equal(mesh.textures[0].values, linear_from_srgb(levels(0) / 255.0))
        _, faces, uv = box_faces()
        corners = uv[faces]
        sides = corners[:, 1:] - corners[:, :1]
        uv_area = 0.5 * np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]).sum()
        texels = int((mesh_atlas(mesh, ground=None).face >= 0).sum())
        assert texels == pytest.approx(uv_area * levels(0).shape[0] * levels(0).shape[1], rel=0.1), (
            "borders count whole texels"
        )

    def test_textures_of_16_bits_keep_them(self, tmp_path):
        path = write_obj(tmp_path)
        assert cv2.imwrite(str(tmp_path / "wall0.png"), levels(0, bits=16)[..., ::-1])
        first, second = ss.load_mesh(path).textures
        assert (first.bits, second.bits) == (16, 8)
        np.testing.assert_allclose(first.values, linear_from_srgb(levels(0, bits=16) / 65535.0), rtol=1e-6)

    def test_vertex_colours_are_srgb_in_ply_and_linear_in_gltf(self, tmp_path):
        colours = trimesh.load(coloured_ball(tmp_path), process=False).visual.vertex_colors[:, :3] / 255.0
        ply = ss.load_mesh(tmp_path / "ball.ply").textures[0]
        np.testing.assert_allclose(ply.values[:, 0], linear_from_srgb(colours), atol=1e-6)
        glb = ss.load_mesh(coloured_ball(tmp_path, "ball.glb")).textures[0]
        np.testing.assert_allclose(glb.values[:, 0], colours, atol=1e-6)

    def test_node_transforms_place_parts(self, tmp_path):
        scene = scene_of_two()
        turned = trimesh.transformations.rotation_matrix(np.pi / 2.0, [0.0, 1.0, 0.0])
        scene.graph.update("box1", matrix=trimesh.transformations.translation_matrix([0.0, 5.0, 0.0]) @ turned)
        (tmp_path / "turned.glb").write_bytes(scene.export(file_type="glb"))
        mesh = ss.load_mesh(tmp_path / "turned.glb")
        low, high = mesh.bounds_m
        # The second box, 2 to 4 m east, is turned to 2 to 4 m north (−z in glTF) and lifted by 5 m.
        np.testing.assert_allclose(high - low, [2.0, 5.0, 6.0], atol=1e-6)


# The texel in row 20, column 6 of the second box lies on its top, whose cell is the lower left third of the texture.
ALONG, ACROSS = ((3.0 * 6.5 / 36.0 - 0.1) / 0.8, (2.0 * (1.0 - 20.5 / 24.0) - 0.1) / 0.8)
EXPECTED_POINT = [3.0 - 1.0 + 2.0 * ALONG - 1.5, -1.0 + 2.0 * ACROSS, 0.5]


def surface_positions(atlas) -> np.ndarray:
    """Positions ``(R, S, 3)`` of the texels of an atlas; NaN off the surface."""
    result = np.full((*atlas.shape, 3), np.nan)
    known = atlas.face >= 0
    parts = [position[part.faces] for part, position in zip(atlas.mesh.parts, atlas.mesh.positions, strict=True)]
    result[known] = np.einsum("nk,nkc->nc", atlas.weights[known], np.concatenate(parts)[atlas.face[known]])
    return result


class TestWriting:
    def repainted(self, mesh, value: float = 0.25):
        return replace(mesh, textures=tuple(replace(t, values=np.full_like(t.values, value)) for t in mesh.textures))

    @pytest.mark.parametrize("bits", [8, 16])
    def test_glb_keeps_its_coordinates_to_the_byte(self, tmp_path, bits):
        source = write_glb(tmp_path)
        before = source.read_bytes()
        mesh = ss.load_mesh(source)
        ss.save_mesh(tmp_path / "out" / "boxes.glb", self.repainted(mesh), bits=bits, facts={"made": "here"})
        assert source.read_bytes() == before
        written = tmp_path / "out" / "boxes.glb"
        one, other = (trimesh.load_scene(path, process=False) for path in (source, written))
        assert list(one.geometry) == list(other.geometry)
        for name in one.geometry:
            np.testing.assert_array_equal(one.geometry[name].visual.uv, other.geometry[name].visual.uv)
            np.testing.assert_array_equal(one.geometry[name].vertices, other.geometry[name].vertices)
        assert gltf_coordinates(source) == gltf_coordinates(written)
        document = pygltflib.GLTF2.load_binary(str(written))
        assert document is not None
        assert document.asset.extras == {"seasonscapes": {"made": "here"}}
        for texture in ss.load_mesh(written).textures:
            assert texture.bits == bits
            assert texture.values.shape == (24, 36, 3)
            np.testing.assert_allclose(texture.values, 0.25, atol=0.003 if bits == 8 else 2e-5)

    def test_colour_factors_of_materials_survive(self, tmp_path):
        document = pygltflib.GLTF2.load_binary(str(write_glb(tmp_path)))
        assert document is not None
        document.materials[1].pbrMetallicRoughness.baseColorFactor = [0.5, 0.25, 1.0, 1.0]
        document.save_binary(str(tmp_path / "tinted.glb"))
        mesh = ss.load_mesh(tmp_path / "tinted.glb")
        assert mesh.parts[1].colour == (0.5, 0.25, 1.0)
        ss.save_mesh(tmp_path / "copy.glb", mesh)
        assert ss.load_mesh(tmp_path / "copy.glb").parts[1].colour == (0.5, 0.25, 1.0)

    def test_gltf_keeps_names_of_its_files(self, tmp_path):
        mesh = ss.load_mesh(write_gltf(tmp_path))
        files = ss.save_mesh(tmp_path / "out" / "copy.gltf", self.repainted(mesh))
        assert sorted(path.name for path in files) == ["copy.bin", "copy.gltf", "wall 0.png", "wall 1.png"]
        again = ss.load_mesh(tmp_path / "out" / "copy.gltf")
        assert [texture.name for texture in again.textures] == [texture.name for texture in mesh.textures]
        np.testing.assert_allclose(again.textures[1].values, 0.25, atol=0.003)

    def test_obj_keeps_its_lines(self, tmp_path):
        source = write_obj(tmp_path)
        ss.save_mesh(tmp_path / "out" / "copy.obj", self.repainted(ss.load_mesh(source)))
        lines, copied = (path.read_text().splitlines() for path in (source, tmp_path / "out" / "copy.obj"))
        assert copied == ["mtllib copy.mtl", *lines[1:]]
        assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
            "copy.mtl",
            "copy.obj",
            "wall0.png",
            "wall1.png",
        ]
        np.testing.assert_allclose(ss.load_mesh(tmp_path / "out" / "copy.obj").textures[1].values, 0.25, atol=0.003)

    def test_ply_keeps_all_but_colours(self, tmp_path):
        import plyfile

        mesh = ss.load_mesh(coloured_ball(tmp_path))
        ss.save_mesh(tmp_path / "copy.ply", self.repainted(mesh))
        one, other = (plyfile.PlyData.read(str(tmp_path / name)) for name in ("ball.ply", "copy.ply"))
        np.testing.assert_array_equal(one["vertex"]["x"], other["vertex"]["x"])
        np.testing.assert_array_equal(one["vertex"]["alpha"], other["vertex"]["alpha"])
        assert set(other["vertex"]["red"]) == {round(255 * float(srgb_from_linear(np.array(0.25))))}
        textured = ss.save_mesh(tmp_path / "out" / "box.ply", self.repainted(ss.load_mesh(write_ply(tmp_path))))
        assert [path.name for path in textured] == ["box.ply", "wall0.png"]

    @pytest.mark.parametrize("make", [write_obj, write_ply, coloured_ball])
    def test_every_kind_becomes_glb(self, tmp_path, make):
        mesh = ss.load_mesh(make(tmp_path), ss.MeshPlacing(up="z"))
        ss.save_mesh(tmp_path / "new.glb", mesh)
        again = ss.load_mesh(tmp_path / "new.glb")
        assert len(again.textures) == len(mesh.textures)
        for one, other in zip(mesh.textures, again.textures, strict=True):
            assert one.values.shape == other.values.shape
            np.testing.assert_allclose(one.values, other.values, atol=0.003)
        np.testing.assert_allclose(again.bounds_m, mesh.bounds_m, atol=1e-6)

    def test_lit_textures_are_marked_unlit(self, tmp_path):
        mesh = ss.load_mesh(write_glb(tmp_path))
        ss.save_mesh(tmp_path / "lit.glb", mesh, unlit=True)
        document = pygltflib.GLTF2.load_binary(str(tmp_path / "lit.glb"))
        assert document is not None
        assert document.extensionsUsed == ["KHR_materials_unlit"]
        assert all("KHR_materials_unlit" in material.extensions for material in document.materials)

    def test_the_mesh_itself_is_never_replaced(self, tmp_path):
        for make, name in ((write_obj, "other.obj"), (write_glb, "boxes.glb"), (write_gltf, "other.gltf")):
            mesh = ss.load_mesh(make(tmp_path))
            with pytest.raises(InputError, match="would replace a file of the mesh itself"):
                ss.save_mesh(tmp_path / name, mesh)


def gltf_coordinates(path: Path) -> list[bytes]:
    """Texture coordinates of all primitives as pygltflib finds them."""
    document = pygltflib.GLTF2.load_binary(str(path))
    assert document is not None
    blob, found = document.binary_blob(), []
    for mesh in document.meshes:
        for primitive in mesh.primitives:
            accessor = document.accessors[primitive.attributes.TEXCOORD_0]
            start = (document.bufferViews[accessor.bufferView].byteOffset or 0) + (accessor.byteOffset or 0)
            found.append(blob[start : start + 8 * accessor.count])
    return found


class TestPlacing:
    def test_shifted_map_coordinates_reach_their_place_on_earth(self, tmp_path):
        shift = (12.0, 3.0, -7.0)
        path = write_glb(tmp_path, shift=shift)
        offset = (2_641_000.0, 1_158_000.0, 1_200.0)
        mesh = ss.load_mesh(path, ss.MeshPlacing(crs="EPSG:2056", offset=offset))
        part, position = mesh.parts[1], mesh.positions[1]
        # East x, north −z, height y of the file.
        east, north, height = (
            part.vertices[:, k] * s + o for k, s, o in zip((0, 2, 1), (1, -1, 1), offset, strict=True)
        )
        expected = enu_from_geodetic(mesh.frame, *geodetic_from_map("EPSG:2056", east, north), height)
        np.testing.assert_allclose(position, expected, atol=1e-6)
        # Directions turn with the grid's convergence, 0.4° here.
        turned = mesh.turn @ (part.vertices[2] - part.vertices[0])
        np.testing.assert_allclose(turned, position[2] - position[0], rtol=2e-4, atol=1e-5)

    def test_own_north_turns_the_mesh(self, tmp_path):
        mesh = ss.load_mesh(write_glb(tmp_path), ss.MeshPlacing(at=(46.5, 8.0, 900.0), north_deg=90.0))
        low, high = mesh.bounds_m
        # What lies five metres along the file's x lies along the south.
        np.testing.assert_allclose(high - low, [2.0, 5.0, 1.0], atol=1e-6)
        assert mesh.positions[1][:, 1].mean() < mesh.positions[0][:, 1].mean()
        assert (mesh.frame.latitude_deg, mesh.frame.height_m) == (46.5, 900.0)


def broken_file(kind: str, folder: Path) -> tuple[Path, ss.MeshPlacing | None]:
    """A mesh file with one fault."""
    vertices, faces, _ = box_faces()
    if kind == "no coordinates":
        path = write_obj(folder)
        path.write_text("\n".join(_without_uv(line) for line in path.read_text().splitlines()))
        return path, None
    if kind == "missing texture":
        path = write_obj(folder)
        (folder / "wall1.png").unlink()
        return path, None
    if kind == "missing library":
        return write_obj(folder, library="nowhere.mtl"), None
    if kind == "library outside":
        return write_obj(folder, library="../boxes.mtl"), None
    if kind == "texture outside":
        return write_obj(folder, texture="../wall%d.png"), None
    if kind == "absolute texture":
        return write_obj(folder, texture="/etc/wall%d.png"), None
    if kind == "texture on the network":
        return write_obj(folder, texture="https://example.org/wall%d.png"), None
    if kind == "buffer outside":
        path = write_gltf(folder)
        path.write_text(path.read_text().replace('"boxes.bin"', '"../boxes.bin"'))
        return path, None
    if kind == "normal map outside":
        path = write_gltf(folder)
        document = json.loads(path.read_text())
        document["images"].append({"uri": "../secret.png"})
        path.write_text(json.dumps(document))
        return path, None
    if kind == "broken colour":
        path = write_obj(folder)
        (folder / "boxes.mtl").write_text("newmtl wall0\nKd red green blue\n")
        return path, None
    if kind == "ply texture outside":
        return write_ply(folder, texture="../wall0.png"), None
    if kind == "cmyk":
        path = write_obj(folder, texture="wall%d.jpg")
        for number in range(2):
            Image.fromarray(levels(number)).convert("CMYK").save(folder / f"wall{number}.jpg")
        return path, None
    if kind == "no image":
        path = write_obj(folder)
        (folder / "wall0.png").write_bytes(b"no picture at all")
        return path, None
    if kind == "degrees":
        (folder / "deg.ply").write_bytes(
            _coloured(vertices * np.array([1e-3, 1e-3, 200.0]) + np.array([8.0, 46.5, 0.0]), faces)
        )
        return folder / "deg.ply", None
    if kind == "outside the system":
        (folder / "far.ply").write_bytes(_coloured(vertices, faces))
        return folder / "far.ply", ss.MeshPlacing(crs="EPSG:2056")
    if kind == "nan":
        vertices[3, 1] = np.nan
        (folder / "nan.ply").write_bytes(_coloured(vertices, faces))
        return folder / "nan.ply", None
    if kind == "no faces":
        (folder / "points.ply").write_bytes(trimesh.PointCloud(vertices).export(file_type="ply"))
        return folder / "points.ply", None
    if kind == "no colours":
        (folder / "bare.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
        return folder / "bare.obj", None
    if kind == "cut short":
        path = write_glb(folder)
        path.write_bytes(path.read_bytes()[:-900])
        return path, None
    if kind == "garbage":
        (folder / "x.glb").write_bytes(b"glTF\2\0\0\0 and nothing more")
        return folder / "x.glb", None
    if kind == "unknown suffix":
        (folder / "x.stl").write_bytes(b"solid")
        return folder / "x.stl", None
    raise AssertionError(kind)


def _without_uv(line: str) -> str:
    if line.startswith("f "):
        return "f " + " ".join(word.split("/")[0] for word in line.split()[1:])
    return "" if line.startswith("vt ") else line


def _coloured(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    mesh.visual.vertex_colors = np.full((len(vertices), 4), 128, np.uint8)
    return mesh.export(file_type="ply")


BROKEN = {
    "no coordinates": "has a texture but no texture coordinates",
    "missing texture": r"map_Kd: no such file; got 'wall1.png'",
    "missing library": r"mtllib: no such file; got 'nowhere.mtl'",
    "library outside": "mtllib: outside the mesh's folder; got '../boxes.mtl'; --allow-outside",
    "texture outside": "map_Kd: outside the mesh's folder; got '../wall0.png'",
    "absolute texture": "map_Kd: outside the mesh's folder; got '/etc/wall0.png'",
    "texture on the network": "map_Kd: a file on the network; got 'https://example.org/wall0.png'",
    "buffer outside": r"buffer 0: outside the mesh's folder; got '../boxes.bin'",
    "normal map outside": r"texture 2: outside the mesh's folder; got '../secret.png'",
    "broken colour": "a colour that is no three numbers; got 'red green blue'",
    "ply texture outside": "TextureFile: outside the mesh's folder; got '../wall0.png'",
    "cmyk": "texture wall0.jpg: a texture in CMYK; got 'CMYK'; expected RGB",
    "no image": "texture wall0.png: not a readable image",
    "degrees": "horizontal coordinates look like degrees.*--crs EPSG:4326",
    "outside the system": "coordinates outside the area of EPSG:2056.*--offset",
    "nan": "1 vertices of part nan are no numbers",
    "no faces": "no faces in it",
    "no colours": "neither textures nor vertex colours in it",
    "cut short": "cut short|not a readable glTF file",
    "garbage": "not a readable glTF file",
    "unknown suffix": "unknown kind of mesh; got '.stl'",
}


class TestMistakes:
    @pytest.mark.parametrize("kind", BROKEN)
    def test_a_broken_file_gets_one_line(self, tmp_path, kind):
        folder = tmp_path / "mesh"
        folder.mkdir()
        path, placing = broken_file(kind, folder)
        with pytest.raises(InputError, match=BROKEN[kind]) as caught:
            ss.load_mesh(path, placing)
        assert "\n" not in str(caught.value)
        assert path.stem in str(caught.value)

    def test_outside_files_are_read_when_allowed(self, tmp_path):
        folder = tmp_path / "mesh"
        folder.mkdir()
        path = write_obj(folder, texture="../wall%d.png")
        for number in range(2):
            (folder / f"wall{number}.png").rename(tmp_path / f"wall{number}.png")
        assert len(ss.load_mesh(path, allow_outside=True).textures) == 2

    def test_large_textures_are_refused_by_their_memory_before_they_are_decoded(self, tmp_path):
        path = write_obj(tmp_path)
        # The header of a picture of 65,536 × 32,768; nothing of it is decoded.
        header = b"IHDR" + struct.pack(">IIBBBBB", 65536, 32768, 8, 2, 0, 0, 0)
        chunks = [header, b"IDAT", b"IEND"]
        data = [struct.pack(">I", len(c) - 4) + c + struct.pack(">I", zlib.crc32(c)) for c in chunks]
        for number in range(2):
            (tmp_path / f"wall{number}.png").write_bytes(b"\x89PNG\r\n\x1a\n" + b"".join(data))
        with pytest.raises(InputError, match=r"textures of 4295 million texels need about 4295 GB of memory.*reduce"):
            ss.load_mesh(path)

    def test_a_texture_that_repeats_is_refused(self, tmp_path):
        path = write_obj(tmp_path)
        path.write_text(path.read_text().replace("vt 0.03333333 0.05000000", "vt 2.03333333 0.05000000"))
        with pytest.raises(InputError, match="its texture repeats over"):
            mesh_atlas(ss.load_mesh(path), ground=None)

    def test_whole_tiles_and_edges_are_taken_back(self, tmp_path):
        path = write_obj(tmp_path)
        plain = mesh_atlas(ss.load_mesh(path), ground=None)
        text = path.read_text().splitlines()
        moved = [
            f"vt {float(w[1]) + 3:.8f} {float(w[2]) - 1:.8f}" if (w := line.split())[0] == "vt" else line
            for line in text
        ]
        path.write_text("\n".join(moved))
        np.testing.assert_array_equal(mesh_atlas(ss.load_mesh(path), ground=None).face, plain.face)

    def test_what_may_not_be_meant_is_told(self, tmp_path):
        vertices, faces, _ = box_faces()
        flat = np.concatenate([faces, [[0, 0, 1]]])
        (tmp_path / "odd.ply").write_bytes(_coloured(vertices, flat))
        notes = mesh_atlas(ss.load_mesh(tmp_path / "odd.ply"), ground=None).notes
        assert any("1 of 11 faces are degenerate" in note for note in notes)
        fin = np.concatenate([vertices, [[0.0, 0.0, 3.0]]])
        extra = np.concatenate([faces, [[0, 2, 20], [2, 0, 20]]])
        (tmp_path / "fin.ply").write_bytes(_coloured(fin, extra))
        notes = mesh_atlas(ss.load_mesh(tmp_path / "fin.ply"), ground=None).notes
        assert any("not manifold" in note for note in notes)
        (tmp_path / "under.ply").write_bytes(_coloured(vertices, faces[:, ::-1]))
        notes = mesh_atlas(ss.load_mesh(tmp_path / "under.ply"), ground=None).notes
        assert any("most faces look down" in note for note in notes)
        overlapping = write_obj(tmp_path)
        overlapping.write_text(overlapping.read_text().replace("usemtl wall1", "usemtl wall0"))
        notes = mesh_atlas(ss.load_mesh(overlapping), ground=None).notes
        assert any("texels are used by several faces" in note for note in notes)


@pytest.fixture(scope="module")
def boxes(tmp_path_factory):
    """Two boxes on the ground, with the light transport of their texels."""
    folder = tmp_path_factory.mktemp("boxes")
    mesh = ss.load_mesh(write_glb(folder), ss.MeshPlacing(at=(46.5, 8.0, 1000.0)))
    return mesh, mesh_transport(mesh, AROUND)


class TestLight:
    def test_a_wall_is_lit_by_the_sun_it_faces(self, boxes):
        from seasonscapes.albedo.forward_model import sun_on_texels

        mesh, transport = boxes
        light, _ = mesh_light(mesh, (90.0, 30.0), AROUND)
        inside = transport.atlas.tiles[1].window
        direct = sun_on_texels(transport.texels, light).reshape(*transport.atlas.shape, 3)[inside]
        positions = surface_positions(transport.atlas)[inside]
        # The second box stands free towards the east; rays from above would miss its vertical walls.
        for wall, cosine in (
            (np.isclose(positions[..., 0], 2.5, atol=1e-4), np.cos(np.radians(30.0))),
            (np.isclose(positions[..., 2], 0.5, atol=1e-4), np.sin(np.radians(30.0))),
            (np.isclose(positions[..., 0], 0.5, atol=1e-4), 0.0),
        ):
            assert wall.sum() > 30
            expected = np.broadcast_to(cosine * np.asarray(light.sun.normal_illuminance_lx), direct[wall].shape)
            np.testing.assert_allclose(direct[wall], expected, rtol=1e-3, atol=1e-3)

    def test_the_neighbour_casts_a_shadow(self, boxes):
        mesh, transport = boxes
        positions = surface_positions(transport.atlas)[transport.atlas.tiles[1].window]
        west = np.isclose(positions[..., 0], 0.5, atol=1e-4)
        lit = ss.light_mesh(mesh, (270.0, 20.0), surroundings=AROUND, transport=transport).illuminance[1]
        # The first box is 1 m high and ends 1 m west: its shadow reaches 1 - tan 20° = 0.64 m up this wall.
        height = positions[..., 2] + 0.5
        assert np.median(lit[west & (height < 0.6)][:, 1]) < 0.5 * np.median(lit[west & (height > 0.68)][:, 1])

    def test_light_taken_out_is_the_light_put_in(self, boxes):
        from seasonscapes.albedo.delighting import DelightOptions

        mesh, transport = boxes
        lit = ss.light_mesh(mesh, SUN, surroundings=AROUND, transport=transport)
        level = mesh_light(mesh, SUN, AROUND)[0].global_horizontal_lx
        textures = tuple(
            replace(t, values=np.clip(r * np.pi / (0.8 * level), 0.0, 1.0))
            for t, r in zip(mesh.textures, lit.radiance, strict=True)
        )
        photographed = replace(mesh, textures=textures)
        known = [transport.atlas.face[tile.window] >= 0 for tile in transport.atlas.tiles[:2]]
        options = DelightOptions(white_reflectance=0.8)
        delit = ss.delight_mesh(photographed, SUN, surroundings=AROUND, transport=transport, options=options)
        for number, on in enumerate(known):
            ratio = delit.mesh.textures[number].values[on] / mesh.textures[number].values[on]
            np.testing.assert_allclose(np.percentile(ratio, [2, 98]), 1.0, atol=0.01)
            assert np.isfinite(delit.sigma[number][on]).all()
            assert np.isinf(delit.sigma[number][~on]).all()
        # Without the exposure all is off by one factor, and by what reflections of darker walls change.
        scaled = ss.delight_mesh(photographed, SUN, surroundings=AROUND, transport=transport).mesh.textures[0].values
        ratio = scaled[known[0]] / mesh.textures[0].values[known[0]]
        np.testing.assert_allclose(np.percentile(ratio, [10, 50, 90]), 0.5 / 0.8, rtol=0.05)
        # As they were lit, the walls differ by far more.
        plain = textures[0].values[known[0]] / mesh.textures[0].values[known[0]]
        assert np.ptp(np.log(np.percentile(plain, [5, 95]))) > 1.0

    def test_vertex_colours_are_delit_vertex_by_vertex(self, tmp_path):
        mesh = ss.load_mesh(coloured_ball(tmp_path), ss.MeshPlacing(at=(46.5, 8.0, 1000.0)))
        transport = mesh_transport(mesh, AROUND)
        lit = ss.light_mesh(mesh, SUN, surroundings=AROUND, transport=transport)
        white = 1.2 * mesh_light(mesh, SUN, AROUND)[0].global_horizontal_lx / np.pi
        photographed = replace(mesh, textures=(replace(mesh.textures[0], values=lit.radiance[0] / white),))
        after = ss.delight_mesh(photographed, SUN, surroundings=AROUND, transport=transport).mesh.textures[0].values
        ratio = after / mesh.textures[0].values
        seen = lit.illuminance[0][..., 1] > 0.02 * lit.illuminance[0][..., 1].max()
        np.testing.assert_allclose(np.percentile(ratio[seen], [5, 95]) / np.median(ratio[seen]), 1.0, atol=0.05)

    def test_night_is_told(self, tmp_path):
        mesh = ss.load_mesh(coloured_ball(tmp_path), ss.MeshPlacing(at=(46.5, 8.0, 1000.0)))
        with pytest.raises(InputError, match="the solar elevation is -17"):
            ss.delight_mesh(mesh, "2024-07-20T23:30", surroundings=AROUND)

    def test_a_picture_shows_the_lit_texture(self, boxes):
        mesh, transport = boxes
        camera = mesh_camera(mesh, azimuth_deg=150.0, elevation_deg=35.0, size_px=(96, 64))
        view = relit_mesh_view(mesh_view(mesh, camera, surroundings=AROUND), SUN)
        lit = ss.light_mesh(mesh, SUN, surroundings=AROUND, transport=transport)
        on_mesh = view.gbuffer.position[..., 2] > 0.45
        assert on_mesh.sum() > 200
        expected = atlas_lookup(transport.atlas.image(list(lit.radiance)), view.gbuffer.uv[on_mesh])
        shown = view.surface[on_mesh]
        assert np.median(np.abs(shown / expected - 1.0)) < 0.04

    def test_the_own_view_frames_the_mesh(self, tmp_path):
        from seasonscapes.cameras.pinhole import project

        mesh = ss.load_mesh(write_glb(tmp_path))
        for azimuth in (0.0, 80.0, 200.0):
            camera = mesh_camera(mesh, azimuth_deg=azimuth, size_px=(120, 60))
            pixel, depth = project(camera, np.concatenate(mesh.positions))
            assert (depth > 0.0).all()
            assert (pixel >= 0.0).all()
            assert (pixel <= [120, 60]).all()
            # It fills the picture in one direction.
            assert (np.ptp(pixel, axis=0) / [120, 60]).max() > 0.7

    def test_a_camera_in_the_files_own_coordinates(self, tmp_path):
        from seasonscapes.cameras.pinhole import project

        mesh = ss.load_mesh(
            write_glb(tmp_path, shift=(5.0, 2.0, 1.0)), ss.MeshPlacing(at=(46.5, 8.0, 0.0), north_deg=30.0)
        )
        corner = mesh.parts[0].vertices[3]
        camera = camera_between(mesh, corner + np.array([1.0, 4.0, 8.0]), corner, size_px=(80, 60))
        pixel, depth = project(camera, mesh.positions[0][3])
        np.testing.assert_allclose(pixel, [40.0, 30.0], atol=1e-6)
        np.testing.assert_allclose(depth, 9.0, atol=1e-9)


def atlas_lookup(image: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Values ``(N, 3)`` of an image at texture coordinates, bilinear."""
    from scipy.ndimage import map_coordinates

    at = [(1.0 - uv[:, 1]) * image.shape[0] - 0.5, uv[:, 0] * image.shape[1] - 0.5]
    return np.stack([map_coordinates(image[..., k], at, order=1, mode="nearest") for k in range(3)], axis=1)


def test_creases_keep_edges_sharp_and_smooth_the_rest():
    ball = trimesh.creation.icosphere(subdivisions=3)
    smooth = creased_normals(ball.vertices[ball.faces])
    np.testing.assert_allclose((smooth * ball.vertices[ball.faces]).sum(axis=2), 1.0, atol=2e-3)
    box = trimesh.creation.box()
    sharp = creased_normals(box.vertices[box.faces])
    np.testing.assert_allclose(sharp, np.repeat(box.face_normals[:, None], 3, axis=1), atol=1e-6)


class TestCommands:
    @pytest.fixture
    def run(self, tmp_path, monkeypatch, capsys):
        """Run one command in an empty folder; exit code, stdout and stderr."""
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("SEASONSCAPES_WORKSPACE", str(tmp_path / "workspace"))

        def run(*arguments: str) -> tuple[int, str, str]:
            code = main(list(arguments))
            return code, *capsys.readouterr()

        return run

    def test_delight_then_relight(self, tmp_path, run):
        write_glb(tmp_path)
        light = ["--at", "46.5,8,1000", "--time", "2024-07-20T13:00", "--sky", "hosek", "--rays", "16"]
        code, out, err = run("delight", "boxes.glb", *light, "-o", "albedo.glb", "--json")
        assert code == 0, err
        record = json.loads(out)
        assert record["sun"]["elevation_deg"] > 50.0
        assert str(tmp_path) not in (tmp_path / "albedo.glb").read_bytes().decode("latin-1")
        assert len(ss.load_mesh(tmp_path / "albedo.glb").textures) == 2
        span = ["--from", "2024-07-20T09:00", "--to", "2024-07-20T17:00", "--every", "4h", "--at", "46.5,8,1000"]
        code, _, err = run(
            "relight", "albedo.glb", *span, "--sky", "hosek", "--rays", "16", "--size", "32x24", "-o", "film"
        )
        assert code == 0, err
        assert len(list((tmp_path / "film").glob("*.png"))) == 3

    def test_lit_textures_and_turntable(self, tmp_path, run):
        write_obj(tmp_path)
        sun = ["--sun", "120,35", "--sky", "hosek", "--rays", "16"]
        code, _, err = run("relight", "boxes.obj", *sun, "--textures", "exr", "-o", "lit")
        assert code == 0, err
        from seasonscapes.images import read_exr

        layers, _ = read_exr(tmp_path / "lit" / "wall1.exr")
        assert layers[""].shape == (24, 36, 3)
        assert layers["illuminance"].max() > 30_000.0
        code, _, err = run("relight", "boxes.obj", *sun, "--turntable", "2", "--size", "32x24", "-o", "round")
        assert code == 0, err
        first, second = (np.asarray(Image.open(path)) for path in sorted((tmp_path / "round").glob("*.png")))
        assert np.abs(first.astype(float) - second).mean() > 2.0

    @pytest.mark.parametrize(
        ("arguments", "line"),
        [
            (["relight", "boxes.glb", "--time", "2024-07-20T12:00"], "--at: missing"),
            (["relight", "boxes.glb"], "--time: give an hour or the sun's angles; got 'neither'"),
            (["relight", "boxes.glb", "--sun", "100,40", "--turntable", "3"], "--output: unknown kind of file"),
            (["relight", "boxes.glb", "--sun", "100,40", "-o", "x.obj"], "x.obj: this mesh cannot be written so"),
            (["delight", "boxes.glb", "--sun", "100,40", "-o", "boxes.glb"], "would replace a file of the mesh itself"),
            (["delight", "boxes.glb", "--time", "unknown", "-o", "x.glb"], "boxes.glb: its sun cannot be told"),
            (
                ["delight", "boxes.glb", "--sun", "1,40", "--image", "x.tif", "-o", "x.glb"],
                "flags of scenes beside a mesh",
            ),
            (["delight", "alpine_small", "--sun", "100,40", "--up", "y"], "flags of meshes beside a scene"),
        ],
    )
    def test_mistakes_on_the_command_line_get_one_line(self, tmp_path, run, arguments, line):
        write_glb(tmp_path)
        extra = ["--sky", "hosek", "--rays", "16"] if "alpine_small" not in arguments else []
        code, _, err = run(*arguments, *extra)
        assert code == 2, err
        assert line in err
        assert len(err.strip().splitlines()[-1]) > 10


def test_lit_delit_relit_against_an_independent_path_tracer(tmp_path):
    """A small version of the benchmark's row: three textures, y up, shifted origin, another integrator for the truth."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
    try:
        from mesh_scene import mesh_relit
    finally:
        sys.path.pop(0)
    scores = mesh_relit(5, tmp_path, texels=48, spp=32, rays=64)
    assert scores["mesh_uv_equal"] == 1.0
    assert scores["mesh_relit_psnr_db"] > 26.0
    assert scores["mesh_relit_psnr_db"] > scores["mesh_as_lit_psnr_db"] + 6.0


def test_suns_of_unknown_hours_are_found_and_overcast_ones_refused(tmp_path):
    """A small version of the benchmark's row: two meshes in the sun, one below an even sky."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))
    try:
        from mesh_scene import mesh_suns
    finally:
        sys.path.pop(0)
    scores = mesh_suns(6, tmp_path, scenes=3, texels=72, spp=32)
    assert scores["mesh_sun_found_rate"] == 1.0
    assert scores["mesh_sun_wrong_trusted"] == scores["mesh_overcast_trusted"] == 0.0
    # The last mesh stands below the even sky: the command says so, and writes nothing.
    mesh = ss.load_mesh(tmp_path / "unknown_hour.glb", ss.MeshPlacing(up="y"))
    with pytest.raises(NotEnoughEvidence, match=r"its sun cannot be told: .*; state the time or the sun"):
        ss.delight_mesh(mesh, "unknown", surroundings=AROUND)


@pytest.fixture(scope="module")
def place():
    return ss.load_place("alpine_small")


class TestOnTerrain:
    """A block on the terrain of a scene, in a valley and on open ground."""

    def block(self, folder, place, at, size_m=40.0):
        box = trimesh.creation.box((size_m, size_m, size_m))
        box.visual.vertex_colors = np.full((len(box.vertices), 4), (150, 150, 150, 255), np.uint8)
        box.export(folder / "block.ply")
        height = ground_height_m(place, *at, where="test")
        return ss.load_mesh(folder / "block.ply", ss.MeshPlacing(at=(*at, height + 0.5 * size_m)))

    def shaded_site(self, place, sun):
        """Latitude and longitude of terrain that faces the sun and lies in another mountain's shadow."""
        from seasonscapes.frames import direction_from_angles, geodetic_from_enu
        from seasonscapes.rendering.hemisphere_rays import ray_scene
        from seasonscapes.rendering.mitsuba_scene import mi_mesh

        direction = direction_from_angles(*sun)
        vertices = place.terrain.vertices[place.terrain.faces[::97]].mean(axis=1).astype(float)
        inside = np.abs(vertices[:, :2]).max(axis=1) < 4000.0
        start = vertices[inside] + np.array([0.0, 0.0, 5.0])
        import mitsuba as mi

        surface = ray_scene(mi_mesh(place.terrain, np.full(3, 0.3, np.float32)))
        rays = mi.Ray3f(mi.Point3f(start.T.astype(np.float32)), mi.Vector3f([float(part) for part in direction]))
        hidden = np.asarray(surface.mi_scene.ray_test(rays))
        lit = np.flatnonzero(~hidden)
        sites = [start[hidden][len(start[hidden]) // 2], start[lit[len(lit) // 2]]]
        return [tuple(float(x) for x in geodetic_from_enu(place.frame, site)[:2]) for site in sites]

    def test_a_mountain_shades_the_mesh(self, tmp_path, place):
        sun = (240.0, 15.0)
        hidden, open_ground = self.shaded_site(place, sun)
        around = replace(AROUND, rays=16)
        mesh = self.block(tmp_path, place, open_ground)
        lit = ss.light_mesh(mesh, sun, surroundings=around)
        assert "standing_on" not in lit.facts
        level = float(lit.illuminance[0][..., 1].max())
        brightest = []
        for at in (hidden, open_ground):
            mesh = self.block(tmp_path, place, at)
            lit = ss.light_mesh(mesh, sun, surroundings=replace(around, terrain=scene_ground(place, mesh)))
            assert lit.facts["standing_on"] == place.scene.name
            brightest.append(float(lit.illuminance[0][..., 1].max()))
        assert brightest[0] < 0.6 * brightest[1]
        assert brightest[1] > 0.8 * level

    def test_the_mesh_shades_the_terrain(self, tmp_path, place):
        sun = (240.0, 30.0)
        at = self.shaded_site(place, sun)[1]
        pictures = []
        for size_m in (120.0, 0.5):
            mesh = self.block(tmp_path, place, at, size_m)
            around = replace(AROUND, rays=16, terrain=scene_ground(place, mesh))
            camera = camera_between(mesh, (0.0, 0.0, 900.0), (1.0, 0.0, 0.0), fov_deg=40.0, size_px=(48, 48))
            pictures.append(ss.render_mesh(mesh, sun, camera, surroundings=around).radiance[..., 1])
        ratio = pictures[0] / pictures[1]
        # The shadow lies in the north-east of the block; the camera's up is north or so, its shadow is dark.
        assert (ratio < 0.5).mean() > 0.01
        assert np.median(ratio) == pytest.approx(1.0, abs=0.1)

    def test_a_mesh_far_from_the_place_is_refused(self, tmp_path, place):
        box = trimesh.creation.box()
        box.visual.vertex_colors = np.full((len(box.vertices), 4), 150, np.uint8)
        box.export(tmp_path / "far.ply")
        mesh = ss.load_mesh(tmp_path / "far.ply", ss.MeshPlacing(at=(10.0, 8.0, 0.0)))
        with pytest.raises(InputError, match="from the terrain"):
            scene_ground(place, mesh)

    def test_a_camera_inside_the_ground_is_refused(self, tmp_path, place):
        mesh = self.block(tmp_path, place, (46.55, 7.98))
        ground = scene_ground(place, mesh)
        require_above(ground, camera_between(mesh, (0.0, 0.0, 60.0), (1.0, 0.0, 0.0), fov_deg=40.0, size_px=(8, 8)))
        below = camera_between(mesh, (0.0, 0.0, -60.0), (1.0, 0.0, 0.0), fov_deg=40.0, size_px=(8, 8))
        with pytest.raises(InputError, match="inside the ground"):
            mesh_view(mesh, below, surroundings=replace(AROUND, terrain=ground))
