"""Numbers of an image file become the colours that its tags say, or the image is refused in one line."""

import logging

import numpy as np
import pytest
import rasterio
from affine import Affine
from rasterio.enums import ColorInterp as Kind
from terrain_cases import write_tiff

from seasonscapes.errors import InputError
from seasonscapes.images import linear_from_srgb
from seasonscapes.terrain.image_bands import image_facts
from seasonscapes.terrain.imagery import read_imagery
from seasonscapes.terrain.raster import raster_grid
from seasonscapes.workflows.albedo_sources import scene_albedo
from seasonscapes.workflows.place import MeshOptions, load_place
from seasonscapes.workspace import Workspace

GRID = Affine(30, 0, 420000, 0, -30, 5160000)
MEADOW = (90, 140, 60)
LINEAR_MEADOW = linear_from_srgb(np.array(MEADOW) / 255.0)
REFLECTANCE = (0.09, 0.11, 0.07)


def bands(colours, dtype=np.uint8, shape=(8, 8)):
    return np.stack([np.full(shape, value, dtype) for value in colours])


def written(folder, values, kinds=None, scales=None, offsets=None, **profile):
    path = write_tiff(folder / "image.tif", values, GRID, "EPSG:32632", **profile)
    with rasterio.open(path, "r+") as file:
        if kinds is not None:
            file.colorinterp = kinds
        if scales is not None:
            file.scales, file.offsets = (scales,) * file.count, (offsets,) * file.count
    return path


def colour(path, **options):
    return np.nanmedian(read_imagery(path, **options).values.reshape(-1, 3), axis=0)


# ---------------------------------------------------------------------------------------------- which bands


@pytest.mark.parametrize(
    "kinds", [[Kind.blue, Kind.green, Kind.red], [Kind.blue, Kind.green, Kind.red, Kind.undefined]]
)
def test_bands_are_the_colours_that_the_file_marks(tmp_path, kinds):
    values = bands([*MEADOW[::-1], 200][: len(kinds)])
    path = written(tmp_path, values, kinds)
    np.testing.assert_allclose(colour(path), LINEAR_MEADOW, rtol=1e-5)
    assert "bands 3, 2, 1" in image_facts(path).told[0]
    np.testing.assert_allclose(colour(path, bands=(1, 2, 3)), LINEAR_MEADOW[::-1], rtol=1e-5)


def test_a_colour_table_is_expanded_before_pixels_are_averaged(tmp_path):
    index = np.ones((8, 8), np.uint8)
    index[:, 1::2] = 200
    index[0, 0] = 9
    path = written(tmp_path, index, nodata=9)
    with rasterio.open(path, "r+") as file:
        file.write_colormap(1, {1: (255, 0, 0, 255), 200: (0, 0, 255, 255), 9: (0, 255, 0, 255)})
    fine = read_imagery(path).values
    assert np.isnan(fine[0, 0]).all()
    np.testing.assert_allclose([fine[1, 0], fine[1, 1]], [[1, 0, 0], [0, 0, 1]])
    np.testing.assert_allclose(read_imagery(path, finest_m=61.0).values[2, 2], [0.5, 0.0, 0.5])
    assert "colour table" in image_facts(path).told[0]


def test_printing_inks_and_complex_numbers_are_refused(tmp_path):
    inks = [Kind.cyan, Kind.magenta, Kind.yellow, Kind.black]
    with pytest.raises(InputError, match=r"printing inks \(CMYK\).*convert it to sRGB"):
        read_imagery(written(tmp_path, bands((90, 140, 60, 0)), inks))
    with pytest.raises(InputError, match="complex numbers"):
        read_imagery(written(tmp_path, bands(MEADOW, np.complex64)))


# ---------------------------------------------------------------------------------------------- missing or dark


def test_dark_water_is_a_colour_and_only_a_pixel_without_any_is_missing(tmp_path):
    values = bands(MEADOW)
    values[:, :, 4:] = np.array([0, 80, 60])[:, None, None]
    values[:, 0, 0] = 0
    image = read_imagery(written(tmp_path, values, nodata=0)).values
    np.testing.assert_allclose(image[4, 6], linear_from_srgb(np.array([0, 80, 60]) / 255.0), rtol=1e-5)
    assert np.isnan(image[0, 0]).all()
    assert np.isnan(image).sum() == 3


def test_a_missing_value_that_is_no_colour_is_missing_in_one_band_too(tmp_path):
    values = bands(REFLECTANCE, np.float32)
    values[1, 2, 3] = -9999.0
    image = read_imagery(written(tmp_path, values, nodata=-9999.0), encoding="linear").values
    assert np.isnan(image[2, 3]).all()
    assert np.isnan(image).sum() == 3


def test_near_infrared_marked_as_alpha_masks_nothing_and_true_alpha_does(tmp_path):
    values = bands((*MEADOW, 120))
    values[3, :, 4:] = 0
    kinds = [Kind.red, Kind.green, Kind.blue, Kind.alpha]
    path = written(tmp_path, values, kinds)
    assert np.isfinite(read_imagery(path).values).all()
    assert "band 4 is marked as alpha but holds measured values" in image_facts(path).told[0]
    values[3, :, :4] = 255
    path = written(tmp_path, values, kinds)
    assert np.isnan(read_imagery(path).values[:, 4:]).all()
    assert np.isfinite(read_imagery(path).values[:, :4]).all()
    assert not image_facts(path).told


# ---------------------------------------------------------------------------------------------- which value is white


def test_the_files_own_scale_and_offset_give_reflectance(tmp_path):
    """Sentinel-2 collection 1: (DN − 1000) / 10,000."""
    path = written(tmp_path, bands((1900, 2100, 1700), np.uint16), scales=1e-4, offsets=-0.1)
    np.testing.assert_allclose(colour(path, encoding="linear"), REFLECTANCE, rtol=1e-5)
    assert "× 0.0001 -0.1" in image_facts(path).told[0]


def test_fractions_have_a_full_scale_of_one_unless_another_is_stated(tmp_path):
    path = written(tmp_path, bands(REFLECTANCE, np.float32))
    np.testing.assert_allclose(colour(path, encoding="linear"), REFLECTANCE, rtol=1e-6)
    assert "1 is white" in image_facts(path).told[0]
    np.testing.assert_allclose(colour(path, encoding="linear", full_scale=0.5), np.array(REFLECTANCE) * 2, rtol=1e-6)
    np.testing.assert_allclose(
        colour(written(tmp_path, bands(MEADOW, np.float32)), full_scale=255.0), LINEAR_MEADOW, rtol=1e-5
    )


@pytest.mark.parametrize(
    ("values", "options", "problem"),
    [
        (bands((900, 1100, 700), np.uint16), {"encoding": "linear"}, "brighter than full scale nearly everywhere"),
        (bands((900, 1100, 700), np.uint16), {}, "brighter than full scale; got '1100'; expected at most 255"),
        (bands(REFLECTANCE, np.float32), {"full_scale": 255.0}, "black everywhere; got '0.11'"),
        (bands(REFLECTANCE, np.float32), {"full_scale": 255.0, "encoding": "linear"}, "black everywhere"),
        (bands(MEADOW, np.float32), {}, "brighter than full scale; got '140'; expected at most 1"),
        (bands((-90, 140, 60), np.int16), {}, "negative colours; got '-90'"),
        (bands((-0.3, 0.1, 0.1), np.float32), {"encoding": "linear"}, "negative colours.*means no data"),
    ],
)
def test_numbers_that_cannot_be_what_was_stated_are_refused_with_the_cure(tmp_path, values, options, problem):
    with pytest.raises(InputError, match=problem + r".*\[imagery\] full_scale"):
        read_imagery(written(tmp_path, values), **options)


def test_reflectances_a_little_out_of_range_are_kept_and_negative_ones_are_black(tmp_path):
    values = bands(REFLECTANCE, np.float32, (64, 64))
    values[:, 0, 0], values[0, 1, 1] = 1.4, -0.1
    image = read_imagery(written(tmp_path, values), encoding="linear").values
    np.testing.assert_allclose([image[0, 0, 0], image[1, 1, 0]], [1.4, 0.0], rtol=1e-6)


# ---------------------------------------------------------------------------------------------- what is told


@pytest.fixture
def scene(tmp_path):
    y, x = np.mgrid[0:40, 0:40]
    write_tiff(tmp_path / "dem.tif", (500.0 + 4.0 * x + 9.0 * y).astype(np.float32), GRID, "EPSG:32632")

    def write(text=""):
        path = tmp_path / "scene.toml"
        path.write_text(f'name = "s"\nvertical_datum = "local"\n[elevation]\nfile = "dem.tif"\n{text}')
        return path

    return write


def told_of(scene, caplog, workspace, options=None):
    caplog.clear()
    scene_albedo(load_place(scene, Workspace(workspace), options=options), "2024-07-01")
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def test_land_without_an_image_is_told_each_time_also_from_the_workspace(tmp_path, scene, caplog):
    part = bands(MEADOW, shape=(40, 12))
    image = '[imagery]\nfile = "image.tif"\n'
    for _ in range(2):
        assert any("the land is grey" in line for line in told_of(scene(), caplog, tmp_path / "w"))
        written(tmp_path, part)
        told = told_of(scene(image), caplog, tmp_path / "w")
        assert len(told) == 1
        share = float(told[0].partition("covers ")[2].partition(" %")[0])
        # 12 of 40 columns, and half a cell less of land on either side.
        assert abs(share - 29.5) < 2.0
    written(tmp_path, bands(MEADOW, shape=(40, 40)))
    assert told_of(scene(image), caplog, tmp_path / "w") == []


def test_wishes_for_texels_that_cannot_be_met_are_told(tmp_path, scene, caplog):
    options = MeshOptions(texel_m=5.0, max_side_px=64)
    assert any("--texel-m: texels of 5 m" in line for line in told_of(scene(), caplog, tmp_path / "w", options))
    write_tiff(
        tmp_path / "image.tif", bands(MEADOW, shape=(400, 400)), Affine(3, 0, 420000, 0, -3, 5160000), "EPSG:32632"
    )
    text = '[imagery]\nfile = "image.tif"\n'
    options = MeshOptions(max_side_px=64)
    assert any("its pixels of 3 m are finer" in line for line in told_of(scene(text), caplog, tmp_path / "w", options))
    assert told_of(scene(text), caplog, tmp_path / "w", MeshOptions()) == []


def test_an_image_placed_by_a_world_file_alone_is_one_line(tmp_path):
    import cv2

    cv2.imwrite(str(tmp_path / "image.jpg"), np.full((20, 20, 3), 90, np.uint8))
    (tmp_path / "image.jgw").write_text("30\n0\n0\n-30\n420015\n5159985\n")
    for read in (raster_grid, read_imagery):
        with pytest.raises(InputError, match=r"image.jpg: the raster has no CRS; assign one with: gdal_edit"):
            read(tmp_path / "image.jpg")
