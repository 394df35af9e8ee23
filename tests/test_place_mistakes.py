"""Rasters and cameras at places that cannot be meant are refused with the likely cause; longitudes are equal modulo 360°."""

import logging
import re

import numpy as np
import pytest
from affine import Affine
from pyproj import Transformer
from terrain_cases import write_tiff

from seasonscapes.cli import main
from seasonscapes.errors import InputError
from seasonscapes.scene import NamedCamera, Viewpoint, read_scene
from seasonscapes.terrain.placement import check_area, distance_km, likely_cause
from seasonscapes.terrain.raster import bounds_geographic, centre_frame, raster_grid, read_elevation, sample_raster
from seasonscapes.terrain.surface import Raster
from seasonscapes.workflows.albedo_sources import scene_albedo
from seasonscapes.workflows.place import MeshOptions, load_place
from seasonscapes.workflows.received_light import irradiance_map
from seasonscapes.workflows.views import camera_for
from seasonscapes.workspace import Workspace

UTM = Affine(30, 0, 420000, 0, -30, 5160000)
HERE = (46.576, 7.968)


def slope(rows=40, columns=40):
    y, x = np.mgrid[0:rows, 0:columns]
    return (500.0 + 4.0 * x + 9.0 * y).astype(np.float32)


@pytest.fixture
def place(tmp_path):
    def load(crs="EPSG:32632", transform=UTM, at=HERE, text="", values=None, options=None):
        write_tiff(tmp_path / "dem.tif", slope() if values is None else values, transform, crs)
        camera = f'[[camera]]\nname = "c"\nlatitude_deg = {at[0]}\nlongitude_deg = {at[1]}\nheight_m = 3000.0\nheading_deg = 0.0\n'
        head = 'name = "s"\nvertical_datum = "local"\n'
        (tmp_path / "s.toml").write_text(f'{head}[elevation]\nfile = "dem.tif"\n{text}{camera if at else ""}')
        return load_place(tmp_path / "s.toml", Workspace(tmp_path / "work"), options=options)

    return load


# ---------------------------------------------------------------------------------------------- rasters


@pytest.mark.parametrize(
    ("crs", "transform", "cause"),
    [
        # Latitude as x and longitude as y: the land lies in Ethiopia.
        ("EPSG:4326", Affine(0.0003, 0, 46.57, 0, -0.0003, 7.975), "latitude and longitude are probably swapped"),
        ("EPSG:32732", UTM, r"UTM zone 32 north \(EPSG:32632\), of the other hemisphere"),
        ("EPSG:32633", UTM, r"the CRS is probably UTM zone 32 north \(EPSG:32632\)"),
        ("EPSG:4326", Affine(0.0003, 0, -7.975, 0, -0.0003, 46.58), "the longitude probably has the wrong sign"),
    ],
)
def test_a_raster_far_from_all_cameras_is_refused_with_the_likely_cause(place, crs, transform, cause):
    with pytest.raises(InputError, match=rf"elevation.file: lies \d+ km from the nearest camera, 'c'.*{cause}"):
        place(crs, transform)


@pytest.mark.parametrize(
    ("crs", "x", "y", "cause"),
    [
        ("EPSG:32632", 5160000, 420000, "easting and northing are probably swapped"),
        ("EPSG:2056", 1160000, 2640000, "easting and northing are probably swapped"),
        ("EPSG:2056", 9640000, 9160000, "the CRS is probably another one"),
    ],
)
def test_a_raster_far_outside_the_area_of_its_grid_is_refused(tmp_path, crs, x, y, cause):
    path = write_tiff(tmp_path / "dem.tif", slope(), Affine(30, 0, x, 0, -30, y), crs)
    with pytest.raises(InputError, match=f"far outside the area of its CRS.*{cause}"):
        read_elevation(path)


def test_degrees_with_latitude_first_are_named(tmp_path):
    path = write_tiff(tmp_path / "dem.tif", slope(), Affine(0.01, 0, 46.0, 0, -0.01, 146.0), "EPSG:4326")
    with pytest.raises(InputError, match=r"beyond ±180°/±90°.*latitude and longitude are probably swapped"):
        read_elevation(path)


def test_an_image_elsewhere_is_refused_with_the_likely_cause(place, tmp_path):
    image = np.full((3, 40, 40), 90, np.uint8)
    write_tiff(tmp_path / "image.tif", image, UTM, "EPSG:32732")
    with pytest.raises(
        InputError, match=r"image.tif: the raster does not overlap.*UTM zone 32 north.*other hemisphere"
    ):
        scene_albedo(place(text='[imagery]\nfile = "image.tif"\n'), "2024-07-01")


def test_areas_beyond_three_degrees_are_refused_wherever_they_are_stated(place, tmp_path):
    wide = Affine(0.08, 0, 6.0, 0, -0.08, 48.0)
    with pytest.raises(InputError, match=r"elevation.file: spans more than 3°.*got .*3.20°.*\[area\]"):
        place("EPSG:4326", wide, at=(46.5, 7.9))
    check_area((14.0, 77.0, 22.0, 78.5), "svalbard.tif")  # 8° of longitude, but 1.7° of a great circle
    with pytest.raises(InputError, match="west_deg < east_deg"):
        place(text="[area]\nwest_deg = 8.0\neast_deg = 7.0\nsouth_deg = 46.0\nnorth_deg = 47.0\n")


def test_a_correct_raster_has_no_likely_cause():
    raster = Raster(slope()[..., None], UTM, "EPSG:32632")
    assert likely_cause(raster, *HERE) is None
    assert distance_km(46.585, 7.965, bounds_geographic(raster)) == 0.0
    # A degree of latitude is 111.2 km of a sphere of the Earth's mean radius.
    assert abs(distance_km(48.0, 7.9, (7.0, 46.0, 8.0, 47.0)) - 111.2) < 0.6


# ---------------------------------------------------------------------------------------------- cameras


def test_a_camera_far_from_the_terrain_is_refused_and_one_among_others_is_told(place, tmp_path, caplog):
    far = (
        '[[camera]]\nname = "far"\nlatitude_deg = 7.968\nlongitude_deg = 46.576\nheight_m = 3000.0\nheading_deg = 0.0\n'
    )
    loaded = place(text=far)
    told = [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]
    assert any("camera 'far' stands" in line and "swapped" in line for line in told)
    with pytest.raises(InputError, match=r"--at: stands \d+ km from the terrain.*swapped"):
        camera_for(loaded, loaded.scene.camera("far"), size_px=(8, 8), where="--at")
    high = Viewpoint(latitude_deg=46.0, longitude_deg=8.5, height_m=9000.0, heading_deg=0.0)
    assert camera_for(loaded, high, size_px=(8, 8)).width_px == 8


@pytest.mark.parametrize(
    "text", ["46,8,nan", "46,8,inf", "46,8,1e12", "46,8,+1e12", "46,8,-501", "nan,8", "46,361", "46,8,+nan"]
)
def test_positions_of_no_place_are_one_line_at_their_flag(text, capsys):
    assert main(["sky", f"--at={text}", "--time", "2024-06-20T12:00Z"]) == 2
    assert re.match(r"seasonscapes: --at: .*range.*\n\Z", capsys.readouterr().err)


# ---------------------------------------------------------------------------------------------- the antimeridian


@pytest.mark.parametrize("west", [180.0 - 32 / 3600, -180.0 - 32 / 3600])
def test_a_raster_across_the_antimeridian_is_whole(tmp_path, west):
    """The same land west and east of 180°, written past 180° or below −180°, with an image on the same grid."""
    grid = Affine(1 / 3600, 0, west, 0, -1 / 3600, -16.5)
    values = slope(64, 64)
    path = write_tiff(tmp_path / "dem.tif", values, grid, "EPSG:4326")
    colours = np.zeros((3, 64, 64), np.uint8)
    colours[0, :, :32], colours[2, :, 32:] = 200, 200
    write_tiff(tmp_path / "image.tif", colours, grid, "EPSG:4326")
    raster = read_elevation(path)
    bounds = bounds_geographic(raster)
    assert bounds[2] - bounds[0] == pytest.approx(64 / 3600)
    assert abs(centre_frame(raster).longitude_deg) == pytest.approx(180.0, abs=1e-6)
    (tmp_path / "s.toml").write_text(
        'name = "s"\nvertical_datum = "local"\n[elevation]\nfile = "dem.tif"\n[imagery]\nfile = "image.tif"\n'
    )
    place = load_place(tmp_path / "s.toml", Workspace(tmp_path / "work"))
    albedo = scene_albedo(place, "2024-07-01").values
    rows, columns = albedo.shape[:2]
    east = albedo[rows // 4 : -rows // 4, columns * 5 // 8 : -columns // 8].mean(axis=(0, 1))
    assert east[2] > 0.2 > 0.05 > east[0]
    for longitude in (179.995, -179.995, 180.005):
        view = Viewpoint(latitude_deg=-16.509, longitude_deg=longitude, above_ground_m=100.0, heading_deg=0.0)
        camera = camera_for(place, view, size_px=(8, 8))
        # A hundredth of a degree is 1,067 m at this latitude.
        assert abs(camera.position_m[0]) == pytest.approx(0.005 * 106_700, rel=0.01)


def test_longitudes_of_0_to_360_are_those_of_west(tmp_path):
    grid = Affine(1 / 3600, 0, 352.0, 0, -1 / 3600, 43.0)
    raster = read_elevation(write_tiff(tmp_path / "dem.tif", slope(), grid, "EPSG:4326"))
    frame = centre_frame(raster)
    assert frame.longitude_deg == pytest.approx(352.0 + 20 / 3600 - 360.0)
    view = {"name": "c", "latitude_deg": 43.0, "height_m": 900.0, "heading_deg": 0.0}
    assert NamedCamera(longitude_deg=352.5, **view).longitude_deg == -7.5
    part = read_elevation(tmp_path / "dem.tif", bounds_deg=(-7.999, 42.992, -7.995, 42.998))
    assert 10 < part.values.shape[1] < 20
    with pytest.raises(InputError, match=r"does not overlap"):
        read_elevation(tmp_path / "dem.tif", bounds_deg=(7.0, 42.992, 7.1, 42.998))


def test_an_area_may_cross_the_antimeridian(tmp_path):
    text = 'name = "s"\n[area]\nwest_deg = 179.5\neast_deg = -179.5\nsouth_deg = -17.0\nnorth_deg = -16.0\n'
    (tmp_path / "s.toml").write_text(text)
    area = read_scene(tmp_path / "s.toml").area
    assert area is not None
    assert area.bounds_deg == (179.5, -17.0, 180.5, -16.0)


def test_a_projected_grid_near_the_antimeridian_needs_no_shift(tmp_path):
    """UTM zone 1 from 180° W on."""
    to_map = Transformer.from_crs("EPSG:4326", "EPSG:32701", always_xy=True)
    x, y = to_map.transform(-179.9, -16.5)
    raster = Raster(slope()[..., None], Affine(30, 0, x - 600, 0, -30, y + 600), "EPSG:32701")
    found = sample_raster(raster, *to_map.transform(180.1, -16.5))
    # 600 m from the corner are 20 cells of 30 m: between the samples of columns and rows 19 and 20.
    assert float(np.squeeze(found)) == pytest.approx(500.0 + (4.0 + 9.0) * 19.5, rel=1e-6)


# ---------------------------------------------------------------------------------------------- parameters of meshing


@pytest.mark.parametrize(
    ("flag", "values"),
    [
        ("--max-error-m", ("0", "-3", "nan", "inf")),
        ("--texel-m", ("0", "-1", "nan", "inf", "1e9")),
        ("--refine", ("0", "-2", "100000")),
    ],
)
def test_meshing_parameters_out_of_range_are_one_line_at_their_flag(flag, values, capsys):
    for value in values:
        assert main(["terrain", "alpine_small", f"{flag}={value}"]) == 2
        said = capsys.readouterr().err
        assert re.match(rf"seasonscapes: {flag}: (out of range|not a finite number); got .*\n\Z", said)


def test_refining_beyond_the_memory_is_one_line(place, monkeypatch):
    monkeypatch.setattr("seasonscapes.terrain.memory.available_bytes", lambda: 500_000_000)
    with pytest.raises(InputError, match="--refine: too large for this machine's memory; got '2560 × 2560"):
        place(options=MeshOptions(refine=64))


@pytest.mark.parametrize("spacing_m", [0.0, -5.0, float("nan")])
def test_map_cells_of_no_size_are_one_line(place, spacing_m):
    with pytest.raises(InputError, match="--spacing-m: out of range"):
        irradiance_map(place(), "2024-06-20T12:00Z", spacing_m=spacing_m)


def test_a_grid_is_read_without_its_values(tmp_path):
    path = write_tiff(tmp_path / "dem.tif", slope(), UTM, "EPSG:32632")
    assert raster_grid(path).values.shape == (40, 40, 0)
