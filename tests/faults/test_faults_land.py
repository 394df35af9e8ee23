"""Rasters, scene files and manifests of a hostile or careless hand: refused, doubted in words, or read as they say."""

import os
import threading
from http.server import BaseHTTPRequestHandler, HTTPServer

import numpy as np
import places
import pytest
import rasterio
from fault_harness import TIME, judge, run_in
from rasterio.transform import Affine

HILL = places.hill_heights(21, 50.0)


def write(path, values, *, crs="EPSG:32632", transform=None, **more):
    """A GeoTIFF as it comes, without any care."""
    values = np.atleast_2d(np.asarray(values))
    bands = values if values.ndim == 3 else values[None]
    place = transform or Affine(50, 0, places.EAST_M - 525, 0, -50, places.NORTH_M + 525)
    colours = more.pop("colormap", None)
    units, scales = more.pop("units", None), more.pop("scales", None)
    profile = {"driver": "GTiff", "height": bands.shape[1], "width": bands.shape[2], "count": bands.shape[0]}
    with rasterio.open(path, "w", **profile, dtype=bands.dtype, crs=crs, transform=place, **more) as file:
        file.write(bands)
        if colours:
            file.write_colormap(1, colours)
        if units:
            file.units = units
        if scales:
            file.scales = scales


def shifted(east_m=0.0, north_m=0.0, side_m=50.0):
    return Affine(side_m, 0, places.EAST_M - 525 + east_m, 0, -side_m, places.NORTH_M + 525 + north_m)


NAN = float("nan")
# Heights: what is written, and whether it must be refused.
HEIGHTS = {
    "one sample": ({"values": HILL[:1, :1]}, "refuse"),
    "one row": ({"values": HILL[:1]}, "refuse"),
    "one column": ({"values": HILL[:, :1]}, "refuse"),
    "all missing": ({"values": np.full((21, 21), -9999.0), "nodata": -9999.0}, "refuse"),
    "all NaN": ({"values": np.full((21, 21), NAN)}, "refuse"),
    "all infinite": ({"values": np.full((21, 21), np.inf)}, "refuse"),
    "huge": ({"values": np.full((21, 21), 1e30)}, "refuse"),
    "centimetres": ({"values": HILL * 100.0}, "refuse"),
    "complex": ({"values": HILL.astype(np.complex64)}, "refuse"),
    "palette": ({"values": (HILL / 10).astype(np.uint8), "colormap": {0: (0, 0, 0)}}, "refuse"),
    "no coordinate system": ({"values": HILL, "crs": None}, "refuse"),
    "NaN in the place": ({"values": HILL, "transform": Affine(NAN, 0, 0, 0, NAN, 0)}, "refuse"),
    "huge place": ({"values": HILL, "transform": shifted(1e30)}, "refuse"),
    "infinite place": ({"values": HILL, "transform": Affine(50, 0, np.inf, 0, -50, 0)}, "refuse"),
    "cells without size": ({"values": HILL, "transform": Affine(1e-320, 0, 421000, 0, -1e-320, 5155000)}, "refuse"),
    "cells of a millimetre": ({"values": HILL, "transform": shifted(525, -525, 0.001)}, "refuse"),
    "cells of 100 km": ({"values": HILL, "transform": shifted(0, 0, 1e5)}, "refuse"),
    "easting and northing swapped": (
        {"values": HILL, "transform": Affine(50, 0, places.NORTH_M, 0, -50, places.EAST_M)},
        "refuse",
    ),
    "the other hemisphere": ({"values": HILL, "crs": "EPSG:32732"}, "refuse"),
    "five degrees": ({"values": HILL, "crs": "EPSG:4326", "transform": Affine(0.25, 0, 5.0, 0, -0.25, 49.0)}, "refuse"),
    "feet by unit": ({"values": HILL * 3.28084, "units": ["ft"]}, "accept"),
    "scaled": ({"values": (HILL * 10).astype(np.int16), "scales": [0.1]}, "accept"),
    "south up": (
        {"values": HILL, "transform": Affine(50, 0, places.EAST_M - 525, 0, 50, places.NORTH_M - 525)},
        "either",
    ),
    "turned": ({"values": HILL, "transform": Affine(35, 35, places.EAST_M, 35, -35, places.NORTH_M)}, "either"),
    "two bands": ({"values": np.stack([HILL, HILL])}, "refuse"),
    "flat": ({"values": np.full((21, 21), 500.0)}, "either"),
    "one spike": (
        {"values": np.where(np.eye(21, k=30) + (np.arange(441).reshape(21, 21) == 220), 9000.0, HILL)},
        "refuse",
    ),
    "noise": ({"values": np.random.default_rng(0).uniform(0, 8000, (21, 21))}, "refuse"),
    "zeros among mountains": ({"values": np.where(np.arange(21) > 12, 0.0, HILL + 1000.0)}, "refuse"),
}


@pytest.mark.parametrize("kind", HEIGHTS)
def test_heights(own_land, record_property, kind):
    given, expected = HEIGHTS[kind]
    write(own_land / "inside" / "dem.tif", **{**given, "values": np.asarray(given["values"])})
    outcome = run_in(own_land, ["terrain", "s.toml", "--json"])
    judge(record_property, outcome, expected)


GARBAGE = {
    "empty": b"",
    "text": b"these are no heights\n" * 20,
    "a header alone": b"II*\0\x08\0\0\0",
    "a loop of directories": b"II*\0\x08\0\0\0\0\0\x08\0\0\0",
    "random": np.random.default_rng(1).bytes(5000),
    "png": b"\x89PNG\r\n\x1a\n" + bytes(100),
    "zip": b"PK\x03\x04" + bytes(200),
}


@pytest.mark.parametrize("name", GARBAGE)
@pytest.mark.parametrize("part", ["dem.tif", "image.tif"])
def test_files_that_are_no_rasters(own_land, record_property, part, name):
    (own_land / "inside" / part).write_bytes(GARBAGE[name])
    verb = ["terrain", "s.toml"] if part == "dem.tif" else ["lit-texture", "s.toml", "--time", TIME, "--sky", "hosek"]
    judge(record_property, run_in(own_land, [*verb, "--json"]), "refuse")


@pytest.mark.parametrize("share", [0.05, 0.3, 0.6, 0.95])
def test_a_raster_cut_short(own_land, record_property, share):
    path = own_land / "inside" / "dem.tif"
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    judge(record_property, run_in(own_land, ["terrain", "s.toml", "--json"]), "refuse")


@pytest.mark.parametrize("side", [30_000, 400_000])
def test_a_few_bytes_that_declare_a_huge_raster(own_land, record_property, side):
    profile = {"driver": "GTiff", "height": side, "width": side, "count": 1, "dtype": "float32", "crs": "EPSG:32632"}
    place = Affine(0.5, 0, places.EAST_M, 0, -0.5, places.NORTH_M)
    path = own_land / "inside" / "dem.tif"
    with rasterio.open(path, "w", **profile, transform=place, tiled=True, sparse_ok=True, bigtiff="YES"):
        pass
    judge(record_property, run_in(own_land, ["terrain", "s.toml", "--json"]), "refuse")


VRT = """<VRTDataset rasterXSize="21" rasterYSize="21"><SRS>EPSG:32632</SRS>
<GeoTransform>421265, 50, 0, 5156275, 0, -50</GeoTransform>
<VRTRasterBand dataType="Float32" band="1"><SimpleSource><SourceFilename relativeToVRT="0">{}</SourceFilename>
<SourceBand>1</SourceBand></SimpleSource></VRTRasterBand></VRTDataset>"""
WMS = """<GDAL_WMS><Service name="TMS"><ServerUrl>{}/${{z}}/${{x}}/${{y}}.png</ServerUrl></Service><DataWindow>
<UpperLeftX>0</UpperLeftX><UpperLeftY>0</UpperLeftY><LowerRightX>9</LowerRightX><LowerRightY>9</LowerRightY>
<TileLevel>2</TileLevel></DataWindow><Projection>EPSG:3857</Projection></GDAL_WMS>"""


@pytest.fixture
def listener():
    """A server that counts who asks it for anything."""
    asked = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            asked.append(self.path)
            self.send_error(404)

        do_HEAD = do_GET

        def log_message(self, *args):
            pass

    server = HTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_address[1]}", asked
    server.shutdown()


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("dem.vrt", VRT.format("{outside}")),
        ("dem.vrt", VRT.format("../outside/secret.tif")),
        ("dem.vrt", VRT.format("/vsicurl/{url}/secret.tif")),
        ("dem.vrt", VRT.format("&lt;GDAL_WMS&gt;")),
        ("dem.tif", VRT.format("/vsicurl/{url}/secret.tif")),
        ("dem.tif", WMS.format("{url}")),
        ("dem.xml", WMS.format("{url}")),
        ("dem.tif", "<WCS_GDAL><ServiceURL>{url}/?</ServiceURL><CoverageName>a</CoverageName></WCS_GDAL>"),
        ("dem.tif", '{"url": "{url}"}'),
        ("/vsicurl/{url}/a.tif", None),
        ("/vsizip//vsicurl/{url}/a.zip/a.tif", None),
        ("/vsimem/a.tif", None),
        ("WMS:{url}", None),
        ("http://{host}/a.tif", None),
        ("../outside/secret.tif", None),
        ("{outside}", None),
        ("link.tif", None),
        ("..", None),
        (".", None),
        ("a\\u0000b.tif", None),
        ("x" * 5000, None),
        ("", None),
    ],
)
def test_rasters_that_lead_outside(own_land, record_property, listener, name, content):
    url, asked = listener
    inside, outside = own_land / "inside", own_land / "outside" / "secret.tif"
    places.write_raster(outside, HILL, spacing_m=50.0)
    (inside / "link.tif").symlink_to(outside)

    def filled(text):
        return text.replace("{url}", url).replace("{outside}", str(outside)).replace("{host}", url[7:])

    if content is not None:
        (inside / name).write_text(filled(content))
    scene = (inside / "s.toml").read_text().replace('file = "dem.tif"', f'file = "{filled(name)}"')
    (inside / "s.toml").write_text(scene)
    outcome = run_in(own_land, ["terrain", "s.toml", "--json"])
    if asked:
        outcome.new.add("network")
    judge(record_property, outcome, "refuse")


NO_NAMES = [
    *(
        "../out",
        "/etc/x",
        "a/b",
        "a\\\\b",
        "..",
        ".",
        "",
        " ",
        "a\\u0000b",
        "a\\nb",
        "x" * 300,
        "-o",
        "\\u001b[31m",
        "a ",
    ),
    *("con|", "a:b", "*", "~", "\\u202egpj", ".hidden", "$(id)", "%2e%2e"),
]


@pytest.mark.fast
@pytest.mark.parametrize("name", NO_NAMES, ids=ascii)
@pytest.mark.parametrize("kind", ["camera", "webcam"])
def test_names_that_files_cannot_have(own_land, record_property, kind, name):
    scene = own_land / "inside" / "w.toml"
    old = 'name = "south"' if kind == "camera" else 'id = "hut"'
    scene.write_text(scene.read_text().replace(old, f'{old.partition(" ")[0]} = "{name}"'))
    judge(record_property, run_in(own_land, ["webcams", "w.toml", "--json"]), "refuse")


@pytest.mark.fast
@pytest.mark.parametrize(
    "row",
    [
        "../hut,{t},p.png",
        "/hut,{t},p.png",
        "hut,{t},../outside/secret.txt",
        "hut,{t},/etc/passwd",
        "hut,{t},",
        "hut,,p.png",
        "hut,noon,p.png",
        "hut,2024-09-18T10.30,p.png",
        "hut,9999-99-99T00:00:00Z,p.png",
        "hut,{t}",
        "hut",
        ",,",
        '"hut,{t},p.png',
        "hut\0,{t},p.png",
        "x" * 200_000 + ",{t},p.png",
        "hut,{t},a\\nb.png",
    ],
    ids=lambda row: ascii(row)[:30],
)
@pytest.mark.parametrize("verb", ["webcams", "paint"])
def test_rows_of_a_manifest_that_are_none(own_land, record_property, verb, row):
    when = TIME.replace("Z", ":00Z")
    manifest = own_land / "inside" / "m.csv"
    manifest.write_text("webcam,time_utc,path\n" + row.replace("{t}", when) + "\n")
    if verb == "webcams":
        outcome = run_in(own_land, ["webcams", "w.toml", "--manifest", "m.csv", "--json"])
    else:
        more = ["--time", TIME, "--manifest", "m.csv", "--calibrations", "cal", "--sky", "hosek", "--json"]
        outcome = run_in(own_land, ["paint", "w.toml", *more])
    # `webcams` lists the pictures that are missing among its problems.
    judge(record_property, outcome, "either" if verb == "webcams" and "nb.png" in row else "refuse")


@pytest.mark.fast
@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("latitude_deg = 46.5405", "latitude_deg = 7.98"),
        ("latitude_deg = 46.5405", "latitude_deg = 1e400"),
        ("latitude_deg = 46.5405", "latitude_deg = nan"),
        ("latitude_deg = 46.5405", 'latitude_deg = "46"'),
        ("above_ground_m = 120.0", "above_ground_m = -1.0"),
        ("above_ground_m = 120.0", "above_ground_m = inf"),
        ("above_ground_m = 120.0", ""),
        ("heading_deg = 0.0", "heading_deg = 1e9"),
        ("pitch_deg = -8.0", "pitch_deg = 91.0"),
        ("[elevation]", "[elevation"),
        ("[elevation]", "[[elevation]]"),
        ("full_scale = 1.0", "full_scale = 0.0"),
        ("full_scale = 1.0", "full_scale = nan"),
        ('encoding = "linear"', 'encoding = "magic"'),
        ('name = "hill"', 'name = "../hill"'),
        ('name = "hill"', 'name = ""'),
        ('name = "hill"', "name = 7"),
        ('name = "hill"', 'name = "hill"\nname = "twice"'),
        ('name = "hill"', 'nmae = "hill"'),
        ('file = "dem.tif"', "file = 7"),
        ('file = "dem.tif"', 'files = "dem.tif"'),
        ('vertical_datum = "local"', 'vertical_datum = "moon"'),
    ],
    ids=lambda text: ascii(text)[:24],
)
@pytest.mark.parametrize("verb", ["terrain", "timelapse"])
def test_keys_of_a_scene_that_mean_nothing(own_land, record_property, verb, old, new):
    scene = own_land / "inside" / "s.toml"
    assert old in scene.read_text()
    scene.write_text(scene.read_text().replace(old, new, 1))
    more = [] if verb == "terrain" else ["--times", TIME, "--size", "16x12", "--sky", "hosek", "-o", "out/film"]
    judge(record_property, run_in(own_land, [verb, "s.toml", *more, "--json"]), "refuse")


def test_a_pipe_in_the_folder_is_not_waited_for(own_land, record_property):
    (own_land / "inside" / "dem.tif").unlink()
    os.mkfifo(own_land / "inside" / "dem.tif")
    judge(record_property, run_in(own_land, ["terrain", "s.toml", "--json"]), "refuse")
