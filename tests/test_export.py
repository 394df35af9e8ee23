"""Places for other programs, read back by readers that are not the package's own."""

import json
import re
import subprocess
import sys
from datetime import UTC, date, datetime, timedelta
from pathlib import Path

import numpy as np
import places
import pygltflib
import pytest
import trimesh
from affine import Affine
from PIL import Image

import seasonscapes as ss
from seasonscapes.cameras.pinhole import Camera, project, rotation_from_angles
from seasonscapes.cli import main
from seasonscapes.errors import InputError
from seasonscapes.export.axes import lamp_quaternion, y_up
from seasonscapes.export.blender import blender_scene, blender_script, exposure_scale
from seasonscapes.export.gltf import TexturedTerrain
from seasonscapes.export.sky_map import EAST_CENTRED, NORTH_EDGED, sky_in_layout
from seasonscapes.export.tiles import TileSource, write_tileset
from seasonscapes.export.usd import Instant, write_usd
from seasonscapes.frames import (
    axes_at,
    direction_from_angles,
    ecef_from_geodetic,
    equirectangular_directions,
    sample_equirectangular,
)
from seasonscapes.images import read_exr
from seasonscapes.sky.illumination import Luminary
from seasonscapes.terrain.geoid import egm96_m, geoid_of
from seasonscapes.terrain.surface import Raster
from seasonscapes.workflows.export_scene import day_instants

NOON = "2024-06-21T11:00Z"


@pytest.fixture(scope="module")
def hill(tmp_path_factory):
    """A hill of 3 km, 50 m between samples, with texels of 2.5 m."""
    folder = tmp_path_factory.mktemp("export")
    workspace = ss.Workspace(folder / "work")
    return ss.load_place(places.write_place(folder), workspace, options=ss.MeshOptions(texel_m=2.5))


def rotated(quaternion_xyzw, vector) -> np.ndarray:
    x, y, z, w = quaternion_xyzw
    q = np.array([x, y, z])
    return vector + 2.0 * np.cross(q, np.cross(q, vector) + w * np.asarray(vector))


def content_of(folder: Path) -> bytes:
    return b"".join(path.read_bytes() for path in folder.rglob("*") if path.is_file())


def accessor(document: pygltflib.GLTF2, index: int, blob: bytes) -> np.ndarray:
    """The values of an accessor, decoded by hand."""
    entry = document.accessors[index]
    view = document.bufferViews[entry.bufferView]
    kind = {5126: "<f4", 5125: "<u4", 5123: "<u2"}[entry.componentType]
    columns = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}[entry.type]
    return np.frombuffer(blob, kind, entry.count * columns, view.byteOffset or 0).reshape(entry.count, columns)


# ------------------------------------------------------------------------------------------------ glTF


def test_bare_glb_holds_the_mesh_and_its_albedo(hill, tmp_path):
    """In trimesh and pygltflib: the same vertices, faces and UVs; the albedo as sRGB; no light."""
    ss.export_scene(hill, tmp_path / "hill.glb", "glb")
    scene = trimesh.load(tmp_path / "hill.glb", process=False)
    (mesh,) = scene.geometry.values()
    east, north, up = hill.terrain.vertices.T
    np.testing.assert_array_equal(mesh.vertices, np.stack([east, up, -north], axis=1))
    np.testing.assert_array_equal(mesh.faces, hill.terrain.faces)
    np.testing.assert_allclose(mesh.visual.uv, hill.terrain.uv, atol=1e-7)
    document = pygltflib.GLTF2.load(str(tmp_path / "hill.glb"))
    attributes = document.meshes[0].primitives[0].attributes
    uv = accessor(document, attributes.TEXCOORD_0, document.binary_blob())
    np.testing.assert_allclose(uv, np.stack([hill.terrain.uv[:, 0], 1.0 - hill.terrain.uv[:, 1]], axis=1), atol=1e-7)
    normals = accessor(document, attributes.NORMAL, document.binary_blob())
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
    assert normals[:, 1].min() > 0.5, "upwards is y"
    picture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"), float) / 255.0
    albedo = ss.scene_albedo(hill, date(2024, 7, 23)).values
    np.testing.assert_allclose(picture, ss.srgb_from_linear(albedo), atol=0.51 / 255.0)
    assert not document.extensions
    assert "KHR_lights_punctual" not in document.extensionsUsed
    about = document.asset.extras
    assert document.asset.copyright == about["attribution"] == "made by a test"
    assert about["origin"]["latitude_deg"] == pytest.approx(hill.frame.latitude_deg)
    assert about["origin"]["vertical_datum"] == "local"
    assert (about["source_crs"], about["up_axis"]) == ("EPSG:32632", "y")
    assert "time_utc" not in about


def test_gltf_of_an_hour_has_the_sun_in_lux_and_the_sky_beside_it(hill, tmp_path):
    record = ss.export_scene(hill, tmp_path / "noon.gltf", "gltf", NOON, sky="hosek")
    assert sorted(record["files"]) == sorted(path.name for path in tmp_path.iterdir())
    light = ss.illumination(hill, NOON, sky="hosek")
    document = pygltflib.GLTF2().load(str(tmp_path / "noon.gltf"))
    (lamp,) = document.extensions["KHR_lights_punctual"]["lights"]
    np.testing.assert_allclose(
        np.multiply(lamp["color"], lamp["intensity"]), light.sun.normal_illuminance_lx, rtol=1e-6
    )
    assert lamp["type"] == "directional"
    assert 80_000 < lamp["intensity"] < 130_000
    (node,) = (node for node in document.nodes if node.extensions)
    # The light shines along the node's -z; the file's y is up and its -z north.
    shines = rotated(node.rotation, [0.0, 0.0, -1.0])
    np.testing.assert_allclose(shines, -y_up(light.sun.direction), atol=1e-6)
    assert shines[1] < -0.8, "downwards at noon in June"
    assert shines[2] < 0.0, "from the south"
    with Image.open(tmp_path / "noon.albedo.png") as image:
        assert image.info["srgb"] == 0
    layers, header = read_exr(tmp_path / "noon.sky.exr")
    assert header["seasonscapes:layout"] == EAST_CENTRED
    np.testing.assert_allclose(np.roll(layers[""], -layers[""].shape[1] // 4, axis=1), light.sky_radiance, rtol=1e-6)
    assert str(tmp_path).encode() not in content_of(tmp_path)


def test_unlit_glb_shows_the_baked_light(hill, tmp_path):
    how = ss.ExportOptions(unlit=True, rays=16, exposure=15.0)
    coarse = ss.load_place(hill.path, hill.workspace, options=ss.MeshOptions(texel_m=50.0))
    record = ss.export_scene(coarse, tmp_path / "lit.glb", "glb", NOON, sky="hosek", options=how)
    document = pygltflib.GLTF2.load(str(tmp_path / "lit.glb"))
    assert document.extensionsUsed == ["KHR_materials_unlit"]
    assert "display-referred" in document.asset.extras["colour_space"]
    assert (record["exposure_ev100"], record["files"]) == (15.0, ["lit.glb"])
    (mesh,) = trimesh.load(tmp_path / "lit.glb", process=False).geometry.values()
    picture = np.asarray(mesh.visual.material.baseColorTexture.convert("RGB"), float)
    # Level ground of albedo 0.2 in the open, and the slopes towards the sun (66° high, in the south-south-east) and away
    # from it: the hill's top is 200 m north of the middle.
    height, width = picture.shape[:2]
    level = picture[5, -6].mean()
    south, north = (picture[round(height / 2 - y / 50.0), width // 2 + 3].mean() for y in (-200.0, 600.0))
    light = ss.illumination(coarse, NOON, sky="hosek")
    reflected = np.full((1, 1, 3), 0.2 / np.pi) * light.global_horizontal_lx
    expected = 255.0 * ss.srgb_from_linear(ss.develop(reflected, exposure=15.0, look="neutral")).mean()
    assert level == pytest.approx(expected, abs=5.0)
    assert south > north + 10.0


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(0.0, 90.0), (90.0, 0.0), (211.0, -3.0), (359.0, 45.0)])
def test_a_lamp_points_where_it_is_told(azimuth_deg, elevation_deg):
    towards = direction_from_angles(azimuth_deg, elevation_deg)
    np.testing.assert_allclose(rotated(lamp_quaternion(towards), [0.0, 0.0, 1.0]), towards, atol=1e-12)


def test_sky_maps_lie_as_each_program_reads_them():
    """The formulae of three.js (equirectUv), Blender (Cycles) and OpenEXR (latlong), over all directions."""
    sky = np.random.default_rng(3).random((32, 64, 3)).astype(np.float32)
    directions = equirectangular_directions(32, 64).reshape(-1, 3)
    expected = sample_equirectangular(sky, directions)
    east, north, up = directions.T
    x, y, z = y_up(directions).T

    def looked_up(layout, u, v):
        picture = sky_in_layout(sky, layout)
        # Texel centres, v from the lower edge.
        column, row = np.floor(u % 1.0 * 64).astype(int), np.floor((1.0 - v) * 32).astype(int)
        return picture[row, column]

    three = np.arctan2(z, x) / (2.0 * np.pi) + 0.5, np.arcsin(y) / np.pi + 0.5
    blender = 0.5 - np.arctan2(north, east) / (2.0 * np.pi), 1.0 - np.arccos(up) / np.pi
    # OpenEXR: longitude and latitude are +π and +π/2 at the first pixel; longitude 0 is +z, π/2 is +x, y is up.
    latlong = 0.5 - np.arctan2(x, z) / (2.0 * np.pi), np.arcsin(y) / np.pi + 0.5
    np.testing.assert_allclose(looked_up(EAST_CENTRED, *three), expected, atol=1e-5)
    np.testing.assert_allclose(looked_up(EAST_CENTRED, *blender), expected, atol=1e-5)
    np.testing.assert_allclose(looked_up(NORTH_EDGED, *latlong), expected, atol=1e-5)


_VALIDATE = """
const validator = require('gltf-validator'), fs = require('fs'), path = require('path');
(async () => {
  for (const file of process.argv.slice(1)) {
    const read = name => new Uint8Array(fs.readFileSync(name));
    const beside = name => Promise.resolve(read(path.join(path.dirname(file), decodeURIComponent(name))));
    const report = await validator.validateBytes(read(file), {uri: file, externalResourceFunction: beside});
    console.log(JSON.stringify({file, issues: report.issues}));
  }
})();
"""


def khronos_issues(files: list[Path]) -> list[dict]:
    """What Khronos' validator finds; skips where it is not installed (npm install gltf-validator; NODE_PATH)."""
    try:
        found = subprocess.run(["node", "-e", "require('gltf-validator')"], capture_output=True)
    except FileNotFoundError:
        pytest.skip("node is not installed")
    if found.returncode:
        pytest.skip("npm's gltf-validator is not installed where node finds it (NODE_PATH)")
    done = subprocess.run(["node", "-e", _VALIDATE, "--", *map(str, files)], capture_output=True, text=True, check=True)
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_khronos_validator_finds_no_error(hill, tmp_path):
    ss.export_scene(hill, tmp_path / "bare.glb", "glb")
    ss.export_scene(hill, tmp_path / "noon.gltf", "gltf", NOON, sky="hosek")
    ss.export_scene(hill, tmp_path / "tiles", "3dtiles")
    files = [tmp_path / "bare.glb", tmp_path / "noon.gltf", *sorted((tmp_path / "tiles").rglob("*.glb"))]
    reports = khronos_issues(files)
    assert len(reports) == len(files) > 6
    for report in reports:
        assert report["issues"]["numErrors"] == report["issues"]["numWarnings"] == 0, report


# ----------------------------------------------------------------------------------------------- OpenUSD


def test_usd_of_an_hour(hill, tmp_path):
    """Composed by OpenUSD itself: axes, units, mesh, lights and what its validators say."""
    from pxr import Gf, Usd, UsdGeom, UsdLux, UsdShade

    ss.export_scene(hill, tmp_path / "noon.usdc", "usd", NOON, sky="hosek")
    light = ss.illumination(hill, NOON, sky="hosek")
    stage = Usd.Stage.Open(str(tmp_path / "noon.usdc"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Ground"))
    np.testing.assert_array_equal(np.array(mesh.GetPointsAttr().Get()), hill.terrain.vertices)
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get()
    np.testing.assert_array_equal(np.array(st), hill.terrain.uv)
    material, _ = UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()
    surface, _, _ = material.ComputeSurfaceSource()
    assert surface.GetIdAttr().Get() == "UsdPreviewSurface"
    texture = UsdShade.Shader(stage.GetPrimAtPath("/World/GroundMaterial/Texture"))
    assert texture.GetInput("sourceColorSpace").Get() == "sRGB"
    assert Path(texture.GetInput("file").Get().resolvedPath).name == "noon.albedo.png"
    sun = UsdLux.DistantLight(stage.GetPrimAtPath("/World/Sun"))
    assert sun.GetAngleAttr().Get() == pytest.approx(0.53, abs=0.01)
    assert sun.GetNormalizeAttr().Get()
    lux = np.array(sun.GetColorAttr().Get()) * sun.GetIntensityAttr().Get()
    np.testing.assert_allclose(lux, light.sun.normal_illuminance_lx, rtol=1e-5)
    world = UsdGeom.Xformable(sun).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    np.testing.assert_allclose(world.TransformDir(Gf.Vec3d(0, 0, -1)), -light.sun.direction, atol=1e-5)
    dome = UsdLux.DomeLight(stage.GetPrimAtPath("/World/Sky"))
    sky, _ = read_exr(tmp_path / Path(dome.GetTextureFileAttr().Get().path).name)
    to_dome = UsdGeom.Xformable(dome).ComputeLocalToWorldTransform(Usd.TimeCode.Default()).GetInverse()
    for azimuth_deg, elevation_deg in ((10.0, 5.0), (95.0, 40.0), (200.0, 20.0), (300.0, 70.0)):
        direction = direction_from_angles(azimuth_deg, elevation_deg)
        x, y, z = to_dome.TransformDir(Gf.Vec3d(*direction))
        u, v = 0.5 - np.arctan2(x, z) / (2.0 * np.pi), np.arcsin(y) / np.pi + 0.5
        height, width = sky[""].shape[:2]
        seen = sky[""][int((1.0 - v) * height), int(u % 1.0 * width)]
        np.testing.assert_allclose(seen, sample_equirectangular(light.sky_radiance, direction), rtol=0.1)
    about = stage.GetRootLayer().customLayerData["seasonscapes"]
    assert about["origin"]["vertical_datum"] == "local"
    assert about["attribution"] == "made by a test"
    assert not usd_errors(stage)
    assert str(tmp_path).encode() not in content_of(tmp_path)


def usd_errors(stage) -> list[str]:
    """What all validators of OpenUSD (those of usdchecker) find."""
    from pxr import UsdValidation

    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert len(validators) > 20
    return [error.GetErrorAsString() for error in UsdValidation.ValidationContext(validators).Validate(stage)]


def test_usd_through_a_day(hill, tmp_path):
    """Sun and sky are samples in time; between two of them stands the sun of that minute."""
    from pxr import Gf, Usd, UsdGeom, UsdLux

    times = day_instants(hill, date(2024, 6, 21), timedelta(hours=2))
    assert (times[0], len(times)) == (datetime(2024, 6, 20, 22, tzinfo=UTC), 13)
    times = times[4:10]
    record = ss.export_scene(hill, tmp_path / "day.usda", "usd", times, sky="hosek")
    assert len(record["files"]) == 2 + 6
    stage = Usd.Stage.Open(str(tmp_path / "day.usda"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 600.0)
    sun = UsdLux.DistantLight(stage.GetPrimAtPath("/World/Sun"))
    for minutes, tolerance_deg in ((240.0, 0.01), (300.0, 5.0)):
        world = UsdGeom.Xformable(sun).ComputeLocalToWorldTransform(minutes)
        at = ss.sun_moon_position(times[0] + timedelta(minutes=minutes), *position_of(hill))
        towards = direction_from_angles(at.sun.azimuth_deg, at.sun.elevation_deg)
        cosine = np.dot(world.TransformDir(Gf.Vec3d(0, 0, 1)), towards)
        assert np.degrees(np.arccos(min(cosine, 1.0))) < tolerance_deg
    skies = UsdLux.DomeLight(stage.GetPrimAtPath("/World/Sky")).GetTextureFileAttr()
    assert len(skies.GetTimeSamples()) == 6
    assert (tmp_path / skies.Get(360.0).path).is_file()
    assert not usd_errors(stage)


def position_of(place) -> tuple[float, float, float]:
    return place.frame.latitude_deg, place.frame.longitude_deg, place.median_height_m


def test_the_sun_of_a_usd_film_is_dark_by_night_and_turns_past_north_without_a_jump(hill, tmp_path):
    from pxr import Gf, Usd, UsdGeom, UsdLux

    ground = TexturedTerrain(hill.terrain, np.full((2, 2, 3), 99, np.uint8), lit=False)
    sky = np.ones((4, 8, 3), np.float32)
    suns = [None, (350.0, 4.0), (10.0, 4.0)]
    lamps = [{} if at is None else {"sun": Luminary(direction_from_angles(*at), np.full(3, 9e4), 0.266)} for at in suns]
    start = datetime(2024, 6, 20, 22, tzinfo=UTC)
    write_usd(tmp_path / "n.usdc", ground, [Instant(start + i * timedelta(hours=1), lamps[i], sky) for i in range(3)])
    # Prims live as long as their stage.
    stage = Usd.Stage.Open(str(tmp_path / "n.usdc"))
    sun = UsdLux.DistantLight(stage.GetPrimAtPath("/World/Sun"))
    assert [sun.GetIntensityAttr().Get(code) for code in (0.0, 60.0)] == [0.0, pytest.approx(9e4)]
    world = UsdGeom.Xformable(sun).ComputeLocalToWorldTransform(90.0)
    np.testing.assert_allclose(world.TransformDir(Gf.Vec3d(0, 0, 1)), direction_from_angles(0.0, 4.0), atol=1e-5)


def test_a_lit_usd_shines_by_itself(hill, tmp_path):
    from pxr import Usd, UsdShade

    write_usd(tmp_path / "lit.usda", TexturedTerrain(hill.terrain, np.full((2, 2, 3), 99, np.uint8), lit=True), [])
    stage = Usd.Stage.Open(str(tmp_path / "lit.usda"))
    surface = UsdShade.Shader(stage.GetPrimAtPath("/World/GroundMaterial/Surface"))
    assert surface.GetInput("emissiveColor").HasConnectedSource()
    assert tuple(surface.GetInput("diffuseColor").Get()) == (0.0, 0.0, 0.0)
    assert not stage.GetPrimAtPath("/World/Sun")
    assert not usd_errors(stage)


def test_without_openusd_one_line_says_how_to_get_it(hill, tmp_path):
    code = "import sys; sys.modules['pxr'] = None\nfrom seasonscapes.cli import main; sys.exit(main(sys.argv[1:]))"
    arguments = ["export", str(hill.path), "--to", "usd", "-o", str(tmp_path / "a.usdc")]
    arguments += ["--workspace", str(hill.workspace.folder), "--texel-m", "2.5"]
    done = subprocess.run([sys.executable, "-c", code, *arguments], capture_output=True, text=True)
    assert done.returncode == 2
    assert 'pip install "seasonscapes[usd]"' in done.stderr.splitlines()[-1]
    assert not list(tmp_path.iterdir())


# ---------------------------------------------------------------------------------------------- 3D Tiles


def read_tiles(folder: Path) -> list[dict]:
    """A small reader as the specification has it: every tile with its vertices in ECEF, and its parent."""
    tileset = json.loads((folder / "tileset.json").read_text())
    assert tileset["asset"]["version"] == "1.1"
    assert tileset["geometricError"] >= tileset["root"]["geometricError"]
    found = []

    def visit(table, transform, parent):
        if "transform" in table:
            transform = transform @ np.reshape(table["transform"], (4, 4)).T
        document = pygltflib.GLTF2.load(str(folder / table["content"]["uri"]))
        primitive = document.meshes[0].primitives[0]
        position = accessor(document, primitive.attributes.POSITION, document.binary_blob()).astype(np.float64)
        x, y, z = position.T
        # glTF's y-up to the z-up of 3D Tiles, then the transform.
        ecef = np.stack([x, -z, y, np.ones_like(x)], axis=1) @ transform.T
        tile = {"table": table, "ecef": ecef[:, :3], "parent": parent, "document": document}
        found.append(tile)
        for child in table.get("children", []):
            visit(child, transform, tile)

    visit(tileset["root"], np.eye(4), None)
    return found


def geodetic(ecef: np.ndarray) -> tuple[np.ndarray, ...]:
    """By PROJ: longitude, latitude [deg], ellipsoidal height [m]."""
    from pyproj import Transformer

    return Transformer.from_crs("EPSG:4978", "EPSG:4979", always_xy=True).transform(*ecef.T)


def test_tiles_place_a_known_summit_within_a_metre(hill, tmp_path):
    """The sample that is the hill's top, by PROJ from its map coordinates, with EGM96's 50.42 m there."""
    from pyproj import Transformer

    record = ss.export_scene(hill, tmp_path / "tiles", "3dtiles")
    assert record["origin_undulation_m"] == pytest.approx(50.42, abs=0.05)
    tiles = read_tiles(tmp_path / "tiles")
    assert (len(tiles), record["levels"]) == (record["tiles"], 2)
    leaves = [tile for tile in tiles if "children" not in tile["table"]]
    longitude, latitude, height = geodetic(np.concatenate([tile["ecef"] for tile in leaves]))
    top = int(np.argmax(height))
    heights = hill.elevation.values[..., 0]
    row, column = np.unravel_index(np.argmax(heights), heights.shape)
    x, y = hill.elevation.transform * (column + 0.5, row + 0.5)
    east_of, north_of = Transformer.from_crs("EPSG:32632", "EPSG:4326", always_xy=True).transform(x, y)
    metres = 111_200.0 * np.array([np.cos(np.radians(north_of)), 1.0])
    offset = metres * [longitude[top] - east_of, latitude[top] - north_of]
    assert np.linalg.norm([*offset, height[top] - (heights[row, column] + 50.42)]) < 1.0
    # The constant stands in for the geoid where it is given.
    given = ss.export_scene(hill, tmp_path / "given", "3dtiles", options=ss.ExportOptions(geoid_m=-12.5))
    (_, _, lower) = geodetic(np.concatenate([tile["ecef"] for tile in read_tiles(tmp_path / "given")]))
    assert height[top] - lower.max() == pytest.approx(record["undulation_m"][1] + 12.5, abs=0.2)
    assert given["geoid"] == "-12.5 m everywhere, as given"


def test_tiles_are_a_sound_tree(hill, tmp_path):
    """Volumes hold their content and their children's, errors fall, leaves meet without gaps and wear the albedo."""
    ss.export_scene(hill, tmp_path / "tiles", "3dtiles")
    tiles = read_tiles(tmp_path / "tiles")
    for tile in tiles:
        longitude, latitude, height = geodetic(tile["ecef"])
        west, south, east, north, low, high = tile["table"]["boundingVolume"]["region"]
        assert west - 1e-9 <= np.radians(longitude.min()) <= np.radians(longitude.max()) <= east + 1e-9
        assert south - 1e-9 <= np.radians(latitude.min()) <= np.radians(latitude.max()) <= north + 1e-9
        assert low - 0.01 <= height.min() <= height.max() <= high + 0.01
        if tile["parent"] is not None:
            above = tile["parent"]["table"]
            outer = np.array(above["boundingVolume"]["region"])
            inner = np.array(tile["table"]["boundingVolume"]["region"])
            assert (outer[[0, 1, 4]] <= inner[[0, 1, 4]]).all()
            assert (outer[[2, 3, 5]] >= inner[[2, 3, 5]]).all()
            assert above["geometricError"] > tile["table"]["geometricError"]
        about = tile["document"].asset.extras
        assert about["origin"]["ellipsoidal_height_m"] == pytest.approx(50.42, abs=0.05)
        assert tile["document"].asset.copyright == "made by a test"
    leaves = [tile for tile in tiles if "children" not in tile["table"]]
    edges = [{tuple(np.round(point, 2)) for point in tile["ecef"]} for tile in leaves]
    assert all(len(first & second) >= 1 for first in edges for second in edges), "they share corners"
    area = sum(horizontal_area(tile, hill) for tile in leaves)
    assert area == pytest.approx(3000.0**2, rel=2e-3)
    # West is brown, east is grey: in the first leaf's picture, and at the border of the image in the whole.
    for tile in leaves:
        view = tile["document"].bufferViews[tile["document"].images[0].bufferView]
        blob = tile["document"].binary_blob()[view.byteOffset : view.byteOffset + view.byteLength]
        (tmp_path / "tile.jpg").write_bytes(blob)
        levels = np.asarray(Image.open(tmp_path / "tile.jpg"), float)
        column = int(re.search(r"_(\d+)\.glb", tile["table"]["content"]["uri"])[1])
        expected = 255.0 * ss.srgb_from_linear(np.array([[0.4, 0.2, 0.1], [0.2, 0.2, 0.2]][column]))
        np.testing.assert_allclose(levels[:, 200 if column == 0 else -200].mean(axis=0), expected, atol=3.0)
    assert str(tmp_path).encode() not in content_of(tmp_path)


def horizontal_area(tile: dict, place) -> float:
    """Map area of a tile's faces that look up; skirts are vertical."""
    document = tile["document"]
    faces = accessor(document, document.meshes[0].primitives[0].indices, document.binary_blob()).reshape(-1, 3)
    origin = place.frame
    corner = (tile["ecef"] @ axes_at(origin.latitude_deg, origin.longitude_deg).T)[faces]
    normal = 0.5 * np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    upwards = normal[:, 2] / np.linalg.norm(normal, axis=1)
    assert upwards.min() > -0.01, "no face looks down"
    return float(normal[upwards > 0.01, 2].sum())


@pytest.mark.parametrize("flipped", [False, True], ids=["north-up", "south-up"])
def test_tiles_wear_their_colours_the_right_way_round(hill, tmp_path, flipped):
    """Colours that tell east and north come back at the vertices' own places, for rasters stored either way."""
    raster = hill.elevation
    if flipped:
        height = raster.values.shape[0]
        turned = raster.transform * Affine.translation(0, height) * Affine.scale(1, -1)
        raster = Raster(raster.values[::-1].copy(), turned, raster.crs)

    def colours_at(position_m):
        share = np.clip(position_m[:, :2] / 3000.0 + 0.5, 0.0, 1.0)
        return np.column_stack([255.0 * share, np.full(len(share), 90.0)]).astype(np.uint8)

    geoid = geoid_of("ellipsoidal", 46.55, 7.98)
    write_tileset(tmp_path, TileSource(raster, hill.frame, geoid, colours_at, 50.0, 5.0, lit=True))
    axes = axes_at(hill.frame.latitude_deg, hill.frame.longitude_deg)
    origin = ecef_from_geodetic(hill.frame.latitude_deg, hill.frame.longitude_deg, hill.frame.height_m)
    for tile in read_tiles(tmp_path):
        document, blob = tile["document"], tile["document"].binary_blob()
        attributes = document.meshes[0].primitives[0].attributes
        assert attributes.NORMAL is None
        assert document.extensionsUsed == ["KHR_materials_unlit"]
        view = document.bufferViews[document.images[0].bufferView]
        (tmp_path / "tile.jpg").write_bytes(blob[view.byteOffset : view.byteOffset + view.byteLength])
        picture = np.asarray(Image.open(tmp_path / "tile.jpg"), float)
        uv = accessor(document, attributes.TEXCOORD_0, blob)
        height, width = picture.shape[:2]
        column, row = (np.clip((uv * [width, height]).astype(int), 0, [width - 1, height - 1])).T
        expected = colours_at((tile["ecef"] - origin) @ axes.T).astype(float)
        np.testing.assert_allclose(picture[row, column, :2], expected[:, :2], atol=6.0)
        assert horizontal_area(tile, hill) == pytest.approx(3000.0**2, rel=2e-3)


# ------------------------------------------------------------------------------------------------- geoid


def test_the_geoid_is_that_of_the_agencys_test_points():
    """NGA's published results of its own programme for EGM96 (OUTPUT.DAT of the 15-minute grid)."""
    latitude = [38.6281550, -14.6212170, 46.8743190, -23.6174460, 38.6254730, -0.4667440]
    longitude = [269.7791550, 305.0211140, 102.4487290, 133.8747120, 359.9995000, 0.0023000]
    undulation = [-31.628, -2.969, -43.575, 15.871, 50.066, 17.329]
    np.testing.assert_allclose(egm96_m(latitude, longitude), undulation, atol=0.1)
    assert egm96_m(90.0, 12.0) == pytest.approx(13.61, abs=0.02)
    assert egm96_m(46.0, -180.0) == pytest.approx(egm96_m(46.0, 180.0))


def test_a_grid_of_proj_goes_before_ours(tmp_path):
    """A grid of 77 m everywhere in the format and under the name that PROJ looks for; a process of its own."""
    header = np.array([-90.0, -180.0, 10.0, 10.0], ">f8").tobytes() + np.array([19, 37], ">i4").tobytes()
    (tmp_path / "egm96_15.gtx").write_bytes(header + np.full(19 * 37, 77.0, ">f4").tobytes())
    code = (
        "import sys, pyproj; pyproj.datadir.append_data_dir(sys.argv[1])\n"
        "from seasonscapes.terrain.geoid import geoid_of\n"
        "geoid = geoid_of('EGM96', 46.5, 8.0); print(geoid.source, geoid.undulation_m([46.5], [8.0])[0])"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["EGM96,", "a", "grid", "of", "PROJ", "77.0"]


def test_what_the_geoid_stands_on_is_said():
    assert float(geoid_of("ellipsoidal", 46.5, 8.0).undulation_m(46.5, 8.0)) == 0.0
    assert "may differ" in geoid_of("LN02", 46.5, 8.0).source
    assert "taken as above sea level" in geoid_of("unknown", 46.5, 8.0).source
    with pytest.raises(InputError, match="no place on Earth"):
        geoid_of("EGM96", 46.5, 8.0, given_m=4000.0)


# ----------------------------------------------------------------------------------------------- Blender


def test_blender_gets_the_sun_the_sky_and_the_camera(hill, tmp_path):
    """The script compiles; its camera projects as ours by Blender's rules; sun and exposure are those of the hour."""
    camera = ss.camera(hill, "south", size_px=(96, 64))
    record = ss.export_scene(hill, tmp_path / "scene", "blender", NOON, sky="hosek", camera=camera)
    assert sorted(record["files"]) == sorted(path.name for path in (tmp_path / "scene").iterdir())
    text = (tmp_path / "scene" / "open_in_blender.py").read_text()
    compile(text, "open_in_blender.py", "exec")
    scene = json.loads(re.search(r'json\.loads\(r"""\n(.*?)\n"""\)', text, re.DOTALL)[1])
    light = ss.illumination(hill, NOON, sky="hosek")
    sun = scene["lamps"]["sun"]
    np.testing.assert_allclose(rotated(sun["rotation_xyzw"], [0.0, 0.0, -1.0]), -light.sun.direction, atol=1e-9)
    lux = np.multiply(sun["colour"], sun["normal_illuminance_lx"])
    np.testing.assert_allclose(lux, light.sun.normal_illuminance_lx, rtol=1e-6)
    assert np.degrees(sun["angular_diameter_rad"]) == pytest.approx(0.53, abs=0.01)
    # A grey card in the open becomes what the package's own exposure makes of it.
    card = 0.18 * light.global_horizontal_lx / np.pi
    own = ss.develop(np.full((1, 1, 3), 1.0) * card, exposure=record["exposure_ev100"], look="neutral")[0, 0]
    np.testing.assert_allclose(scene["scale"] * card, own, rtol=0.05)
    assert (scene["ground"], scene["sky"]) == ("ground.glb", "sky.exr")
    document = pygltflib.GLTF2.load(str(tmp_path / "scene" / "ground.glb"))
    assert "KHR_lights_punctual" not in document.extensionsUsed, "the script sets the sun"
    assert str(tmp_path).encode() not in content_of(tmp_path)


def test_a_shifted_camera_projects_in_blender_as_here():
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_angles(130.0, -7.0, 3.0), [100.0, -50.0, 1500.0]
    camera = Camera(640, 400, 700.0, 650.0, 300.0, 222.0, pose)
    lamp = Luminary(np.array([0.0, -0.6, 0.8]), np.array([9e4, 9e4, 8e4]), 0.265)
    scene = blender_scene({"sun": lamp}, camera, 15.0, {})
    numbers = scene["camera"]
    assert scene["scale"] == pytest.approx(exposure_scale(15.0))
    compile(blender_script(scene), "script", "exec")
    points = np.array([[3000.0, -2500.0, 1300.0], [2500.0, -2900.0, 900.0], [4000.0, -3000.0, 1700.0]])
    local = np.linalg.inv(np.array(numbers["world_from_camera"])) @ np.c_[points, np.ones(3)].T
    x, y, z = local[:3]
    assert (z < 0.0).all(), "Blender's cameras look along -z"
    # Offsets in widths of the sensor, as Blender's manual defines lens, shift and pixel aspect.
    widths = numbers["focal_length_mm"] / numbers["sensor_width_mm"]
    wide, high = numbers["pixel_aspect"]
    column = 640 * (0.5 + widths * x / -z - numbers["shift"][0])
    row = 400 / 2 - 640 * (wide / high) * (widths * y / -z - numbers["shift"][1])
    np.testing.assert_allclose(np.stack([column, row], axis=1), project(camera, points)[0], atol=1e-6)


# ---------------------------------------------------------------------------------------- command, mistakes


def test_export_on_the_command_line(hill, tmp_path, capsys):
    common = ["--workspace", str(hill.workspace.folder), "--texel-m", "2.5", "--sky", "hosek"]
    arguments = ["export", str(hill.path), "--to", "3dtiles", "-o", str(tmp_path / "tiles"), "--json", *common]
    assert main(arguments) == 0
    said = capsys.readouterr()
    record = json.loads(said.out)
    assert record["output"] == str(tmp_path / "tiles")
    assert "heights + 50.3" in said.err
    before = content_of(tmp_path / "tiles")
    assert main(arguments) == 2
    assert "is there already" in capsys.readouterr().err
    assert content_of(tmp_path / "tiles") == before
    assert main(["export", str(hill.path), "--to", "glb", "-o", str(tmp_path / "a.glb"), *common]) == 0
    capsys.readouterr()
    assert main(["info", str(tmp_path / "a.glb"), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["extras"]["origin"]["vertical_datum"] == "local"
    assert [path.name for path in tmp_path.iterdir() if path.name.startswith(".")] == []


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--to", "fbx", "-o", "a.fbx"], "--to: unknown"),
        (["--to", "glb", "-o", "a.gltf"], "unknown kind of file"),
        (["--to", "glb", "-o", "a.glb", "--unlit"], "give --time"),
        (["--to", "blender", "-o", "b"], "give --time"),
        (["--to", "blender", "-o", "b", "--time", NOON, "--unlit"], "without --unlit"),
        (["--to", "glb", "-o", "a.glb", "--camera", "south"], "goes with --to blender"),
        (["--to", "glb", "-o", "a.glb", "--geoid-m", "50"], "goes with --to 3dtiles"),
        (["--to", "glb", "-o", "a.glb", "--day", "2024-06-31"], "not a date"),
        (["--to", "glb", "-o", "a.glb", "--day", "2024-06-21", "--time", NOON], "name two times"),
        (["--to", "usd", "-o", "a.usdc", "--day", "2024-06-21", "--every", "10s"], "instants of a day"),
        (["--to", "3dtiles", "-o", "b", "--geoid-m", "4000"], "no place on Earth"),
    ],
)
def test_what_does_not_go_together_is_one_line(hill, tmp_path, monkeypatch, capsys, flags, said):
    monkeypatch.chdir(tmp_path)
    common = ["--workspace", str(hill.workspace.folder), "--texel-m", "2.5", "--sky", "hosek"]
    assert main(["export", str(hill.path), *flags, *common]) == 2
    assert said in capsys.readouterr().err.splitlines()[-1]
    assert not list(tmp_path.iterdir())
