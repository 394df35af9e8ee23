"""What a scene folder says is not trusted: no file outside it is read or written, no server is asked."""

import shutil
import threading
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import places
import pytest
import rasterio

from seasonscapes.declaration import InputError, checked_name
from seasonscapes.scene import read_scene
from seasonscapes.terrain.raster import read_elevation, read_raster
from seasonscapes.terrain.raster_files import Confinement, open_raster, raster_hash, raster_members

CAMERA = places.SCENE[places.SCENE.index("[[camera]]") :]


@contextmanager
def server():
    """A server on this machine that remembers what it was asked for."""
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET

        def log_message(self, *_):
            pass

    running = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=running.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{running.server_port}", asked
    finally:
        running.shutdown()


def vrt(source: str, *, relative: int = 1, more: str = "", band: str = "") -> str:
    return f"""<VRTDataset rasterXSize="61" rasterYSize="61"><SRS>EPSG:32632</SRS>
<GeoTransform>420265, 50, 0, 5157275, 0, -50</GeoTransform>{more}
<VRTRasterBand dataType="Float32" band="1"{band}><SimpleSource>
<SourceFilename relativeToVRT="{relative}">{source}</SourceFilename><SourceBand>1</SourceBand>
<SrcRect xOff="0" yOff="0" xSize="61" ySize="61"/><DstRect xOff="0" yOff="0" xSize="61" ySize="61"/>
</SimpleSource></VRTRasterBand></VRTDataset>"""


def wms(url: str) -> str:
    return f"""<GDAL_WMS><Service name="TMS"><ServerUrl>{url}/${{z}}/${{x}}/${{y}}.png</ServerUrl></Service>
<DataWindow><UpperLeftX>420265</UpperLeftX><UpperLeftY>5157275</UpperLeftY><LowerRightX>423315</LowerRightX>
<LowerRightY>5154225</LowerRightY><TileLevel>2</TileLevel><TileCountX>1</TileCountX><TileCountY>1</TileCountY>
</DataWindow><Projection>EPSG:32632</Projection><BlockSizeX>64</BlockSizeX><BlockSizeY>64</BlockSizeY>
<BandsCount>1</BandsCount><DataType>Float32</DataType></GDAL_WMS>"""


@pytest.fixture
def outside(tmp_path) -> Path:
    """A place in ``scene/``, with a raster beside that folder that nobody may read."""
    path = places.write_place(tmp_path / "scene")
    places.write_raster(tmp_path / "secret.tif", places.hill_heights() + 7.0, spacing_m=50.0)
    return path


# ------------------------------------------------------------------------------------------------- rasters


@pytest.mark.parametrize(
    "text",
    [
        vrt("../secret.tif"),
        vrt("sub/../../secret.tif"),
        vrt("SECRET", relative=0),
        vrt("link.tif"),
        vrt("/vsicurl/URL/secret.tif", relative=0),
        vrt("/vsizip/secret.zip/secret.tif", relative=0),
        vrt("vrt://SECRET", relative=0),
        vrt("URL/secret.tif", relative=0),
        vrt("wms.xml"),
        vrt("inner.vrt"),
        vrt("dem.tif", band=' subClass="VRTDerivedRasterBand"'),
        vrt("dem.tif", more="<PixelFunctionCode>import os</PixelFunctionCode>"),
        vrt("dem.tif", more='<Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">../secret.tif</MDI></Metadata>'),
        vrt("dem.tif").replace("SimpleSource", "GDALWarpOptions"),
        '<!DOCTYPE x [<!ENTITY e "../secret.tif">]>' + vrt("&e;"),
        "  " + wms("URL"),
        '{"type": "FeatureCollection"}',
    ],
)
def test_a_raster_that_leads_elsewhere_is_refused_before_it_is_opened(outside, text):
    folder = outside.parent
    (folder / "sub").mkdir()
    (folder / "link.tif").symlink_to(folder.parent / "secret.tif")
    (folder / "inner.vrt").write_text(vrt("../secret.tif"))
    with server() as (url, asked):
        (folder / "wms.xml").write_text(wms(url))
        text = text.replace("URL", url).replace("SECRET", str(folder.parent / "secret.tif"))
        # GDAL looks at the content, whatever the name says.
        (folder / "dem.tif").replace(folder / "kept.tif")
        (folder / "dem.tif").write_text(text.replace("dem.tif", "kept.tif"))
        elevation = read_scene(outside).elevation
        with pytest.raises(InputError) as error:
            read_elevation(elevation.file, confinement=read_scene(outside).confinement)
        assert asked == []
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "name", ["loop.tif", "x" * 300 + ".tif", "a\\u0000.tif", "sub", "dem.tif/x", "pipe", "/dev/zero"]
)
def test_names_that_are_no_file_have_their_line(outside, name, capsys):
    import os

    from seasonscapes.cli import main

    (outside.parent / "loop.tif").symlink_to("loop.tif")
    (outside.parent / "sub").mkdir()
    os.mkfifo(outside.parent / "pipe")
    outside.write_text(places.SCENE.replace('file = "dem.tif"', f'file = "{name}"'))
    assert main(["terrain", str(outside), "--workspace", str(outside.parent / "work")]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1


def test_sidecars_are_confined_too(outside):
    folder, dem = outside.parent, outside.parent / "dem.tif"
    with server() as (url, asked):
        (folder / "dem.tif.msk").write_text(wms(url))
        with pytest.raises(InputError, match=r"mask or overview that is no TIFF"):
            read_elevation(dem)
        (folder / "dem.tif.msk").unlink()
        (folder / "dem.tif.aux.xml").write_text(
            f'<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">/vsicurl/{url}/o.tif</MDI></Metadata></PAMDataset>'
        )
        with pytest.raises(InputError, match="names a file of overviews"):
            read_elevation(dem)
        (folder / "dem.tif.aux.xml").unlink()
        assert asked == []
    shutil.copyfile(folder.parent / "secret.tif", folder.parent / "secret.msk")
    (folder / "dem.tif.msk").symlink_to(folder.parent / "secret.msk")
    with pytest.raises(InputError, match="made of a file outside its folder"):
        read_elevation(dem)


def test_a_trusted_raster_may_lie_and_lead_anywhere(outside):
    folder = outside.parent
    (folder / "far.vrt").write_text(vrt("../secret.tif"))
    values = read_raster(folder / "far.vrt", confinement=Confinement(allow_outside=True)).values
    assert np.isclose(values.max(), places.hill_heights().max() + 7.0)
    zipped = shutil.make_archive(str(folder / "dem"), "zip", folder, "dem.tif")
    name = f"/vsizip/{zipped}/dem.tif"
    with pytest.raises(InputError, match="virtual path"):
        read_raster(name)
    assert read_raster(name, confinement=Confinement(allow_outside=True)).values.shape == (61, 61, 1)


def test_plain_rasters_of_each_kind_are_read(tmp_path):
    from affine import Affine

    heights = places.hill_heights()
    tif = places.write_raster(tmp_path / "dem.tif", heights, spacing_m=50.0)
    (tmp_path / "mosaic.vrt").write_text(vrt("dem.tif"))
    (tmp_path / "nested.vrt").write_text(vrt("mosaic.vrt"))
    for name in ("dem.tif", "mosaic.vrt", "nested.vrt"):
        assert np.allclose(read_raster(tmp_path / name).values[..., 0], heights)
    assert {path.name for path in raster_members(tmp_path / "nested.vrt")} == {"nested.vrt", "mosaic.vrt", "dem.tif"}
    bytes8 = (heights / 10.0).astype(np.uint8)
    for name, driver in (("a.png", "PNG"), ("a.jpg", "JPEG"), ("a.img", "HFA"), ("a.webp", "WEBP")):
        count = 3 if driver in ("JPEG", "WEBP") else 1
        profile = {"driver": driver, "width": 61, "height": 61, "count": count, "dtype": "uint8"}
        with rasterio.open(
            tmp_path / name, "w", **profile, crs="EPSG:32632", transform=Affine(50, 0, 420265, 0, -50, 5157275)
        ) as f:
            f.write(np.repeat(bytes8[None], count, axis=0))
        with open_raster(tmp_path / name) as source:
            assert source.driver == driver
            assert source.read().shape == (count, 61, 61)
    assert tif.is_file()


def test_the_hash_of_a_raster_covers_all_that_it_is_made_of(tmp_path):
    places.write_raster(tmp_path / "dem.tif", places.hill_heights(), spacing_m=50.0)
    (tmp_path / "mosaic.vrt").write_text(vrt("dem.tif"))
    seen = [raster_hash(tmp_path / "mosaic.vrt")]
    places.write_raster(tmp_path / "dem.tif", places.hill_heights() + 1.0, spacing_m=50.0)
    seen.append(raster_hash(tmp_path / "mosaic.vrt"))
    (tmp_path / "dem.tif.aux.xml").write_text("<PAMDataset><Metadata><MDI key='a'>b</MDI></Metadata></PAMDataset>")
    seen.append(raster_hash(tmp_path / "mosaic.vrt"))
    from PIL import Image

    Image.new("RGB", (8, 8)).save(tmp_path / "image.jpg")
    for easting in (420265.0, 420865.0):
        (tmp_path / "image.jgw").write_text(f"50\n0\n0\n-50\n{easting}\n5157275\n")
        seen.append(raster_hash(tmp_path / "image.jpg"))
    assert len(set(seen)) == 5
    # The folder's own name does not count.
    shutil.copytree(tmp_path, tmp_path.with_name("moved"))
    assert raster_hash(tmp_path.with_name("moved") / "mosaic.vrt") == seen[2]


# --------------------------------------------------------------------------------------------------- names


@pytest.mark.parametrize("name", ["a", "3-NIEDH", "Jungfraujoch 2", "Säntis.west", "a_b-c.d", "x" * 64])
def test_names_that_files_may_be_called_after(name):
    assert checked_name(name) == name


@pytest.mark.parametrize(
    "name",
    [
        *("", ".", "..", "../x", "/etc/x", "a/b", "a\\b", ".hidden", "-o", " a", "a ", "a.", "a\0b", "a\nb", "a\n"),
        *("a,b", "a:b", "a*", "a\u202eb", "a\ud800", "x" * 65, "ü" * 64 + "ü", "雪" * 43, "a\tb", "a'b", "~"),
    ],
)
def test_names_that_lead_elsewhere_or_nowhere(name):
    with pytest.raises(ValueError, match="not a name"):
        checked_name(name)


@pytest.mark.parametrize("name", ["../evil", "/tmp/evil", "a/b", r"a\u0000b", "a" * 300, r"a\nb", "a,b"])
def test_a_camera_or_scene_of_such_a_name_is_refused(tmp_path, name):
    for text in (
        places.SCENE.replace('name = "south"', f'name = "{name}"'),
        places.SCENE.replace('name = "hill"', f'name = "{name}"'),
        places.SCENE
        + f'[[webcam]]\nid = "{name}"\nlatitude_deg = 46.5\nlongitude_deg = 8.0\nheight_m = 900.0\nprojection = '
        '"perspective"\nwidth_px = 8\nheight_px = 8\nhorizontal_fov_deg = 50.0\nheading_deg = 0.0\ntime_zone = "UTC"\n',
    ):
        with pytest.raises(InputError, match=r"name|id") as error:
            read_scene(places.write_place(tmp_path, text))
        assert "\n" not in str(error.value)
        assert len(str(error.value)) < 600


@pytest.mark.parametrize("text", [r"a\u001b[2Jb", r"a\u0000b", r"a\u0007b", "a" * 3000])
def test_texts_that_could_steer_a_terminal_are_refused(tmp_path, text):
    for key in ("title", "attribution"):
        scene = "\n".join(line for line in places.SCENE.splitlines() if not line.startswith(key))
        with pytest.raises(InputError, match=key) as error:
            read_scene(places.write_place(tmp_path, f'{key} = "{text}"\n{scene}'))
        assert str(error.value).isprintable()


def test_a_calibration_record_becomes_a_camera_only_where_a_scene_could_name_it(tmp_path):
    import json

    from seasonscapes.calibration.calibration_file import read_calibration, write_calibration
    from seasonscapes.calibration.pose_model import parameters_of_view
    from seasonscapes.calibration.resection import Calibration
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.frames import LocalFrame
    from seasonscapes.workflows.views import calibrated_viewpoint

    camera, path = Camera(12, 8, 10.0, 10.0, 6.0, 4.0, np.eye(4)), tmp_path / "w_calibration.json"
    parameters, nothing = parameters_of_view(camera, np.eye(3)), (np.zeros((0, 2)), np.zeros(0, bool))
    solved = Calibration(camera, 0.0, parameters, np.eye(9), (), *nothing, 0.0)
    write_calibration(path, "w", solved, LocalFrame(46.55, 7.98))
    assert calibrated_viewpoint(path)[0].name == "w"
    record = json.loads(path.read_text())
    path.write_text(json.dumps(record | {"webcam": "../evil"}))
    with pytest.raises(InputError, match="not a name"):
        read_calibration(path)
    high = np.array(record["world_from_camera"])
    high[2, 3] = 1e7
    path.write_text(json.dumps(record | {"world_from_camera": high.tolist()}))
    with pytest.raises(InputError, match="height_m") as error:
        calibrated_viewpoint(path)
    assert "\n" not in str(error.value)


def test_names_that_differ_in_case_alone_are_one_file(tmp_path):
    with pytest.raises(InputError, match="two cameras are named"):
        read_scene(places.write_place(tmp_path, places.SCENE + CAMERA.replace('"south"', '"South"')))


# ----------------------------------------------------------------------------------------------- manifests


@pytest.mark.parametrize(
    ("webcam", "path"),
    [
        *(("../evil", "a.jpg"), ("/tmp/evil", "a.jpg"), ("a/b", "a.jpg"), ("x" * 300, "a.jpg")),
        *(("w", "../secret.jpg"), ("w", "/etc/passwd"), ("w", "a/../../secret.jpg"), ("w", "link.jpg"), ("w", "a\0b")),
    ],
)
def test_a_manifest_names_no_file_outside_its_folder(tmp_path, webcam, path):
    from datetime import UTC, datetime

    from seasonscapes.workflows.photograph_files import PhotographSources, rows_at

    folder = tmp_path / "scene"
    folder.mkdir()
    (tmp_path / "secret.jpg").write_bytes(b"private")
    (folder / "link.jpg").symlink_to(tmp_path / "secret.jpg")
    manifest = folder / "m.csv"
    manifest.write_text(f"webcam,time_utc,path\n{webcam},2024-09-18T10:00:00Z,{path}\n")
    time = datetime(2024, 9, 18, 10, tzinfo=UTC)
    with pytest.raises(InputError, match=r"not a name|leads outside|NUL|line 2") as error:
        rows_at(PhotographSources(manifest, folder), time, within_min=5.0)
    assert "\n" not in str(error.value)
    if webcam == "w" and path == "../secret.jpg":
        trusted = PhotographSources(manifest, folder, allow_outside=True)
        assert rows_at(trusted, time, within_min=5.0)[0].path == path


def test_run_copies_nothing_from_outside(tmp_path, capsys):
    from seasonscapes.cli import main

    path = places.write_place(tmp_path / "scene")
    (tmp_path / "secret.txt").write_text("private")
    for webcam, name in (("w", "../secret.txt"), ("../../evil", "dem.tif"), (f"{tmp_path}/evil", "dem.tif")):
        (path.parent / "m.csv").write_text(f"webcam,time_utc,path\n{webcam},2024-09-18T10:00:00Z,{name}\n")
        arguments = ["run", str(path), "--times", "2024-09-18T10:00Z", "--at-hours", "2024-09-18T10:00Z"]
        arguments += ["--manifest", str(path.parent / "m.csv"), "--calibrations", str(path.parent)]
        arguments += ["-o", str(tmp_path / "out"), "--until", "pictures", "--workspace", str(tmp_path / "work")]
        assert main(arguments) == 2
        assert len(capsys.readouterr().err.strip().splitlines()[-1]) < 500
    assert {each.name for each in tmp_path.iterdir()} <= {"scene", "secret.txt", "work"}


# ------------------------------------------------------------------------------------------------- the code


def test_rasters_are_opened_and_arrays_unpickled_nowhere_else():
    """Rasters are opened for reading in `raster_files` alone, and on servers in `open_data.remote`; nothing is unpickled."""
    import ast

    import seasonscapes

    package, opened, unpickled = Path(seasonscapes.__file__).parent, set(), set()
    for path in package.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            name, options = ast.unparse(node.func), {word.arg: ast.unparse(word.value) for word in node.keywords}
            modes = [ast.unparse(value) for value in node.args[1:2]] + [options.get("mode")]
            if name in ("rasterio.open", "rasterio.io.DatasetReader") and "'w'" not in modes:
                opened.add(path.name)
                # A file of a server is nothing but a GeoTIFF, and read through bytes of this program's own.
                assert path.name != "remote.py" or (options.get("driver") == "'GTiff'" and "opener" in options)
            if name in ("pickle.load", "pickle.loads") or options.get("allow_pickle") == "True":
                unpickled.add(path.name)
            if name == "torch.load" and options.get("weights_only") != "True":
                unpickled.add(path.name)
    assert opened == {"raster_files.py", "remote.py"}
    assert unpickled == set()
