"""Reading rasters: every way in, every way it can be wrong, and what fills the holes."""

import numpy as np
import pytest
from affine import Affine
from hypothesis import given, settings
from hypothesis import strategies as st
from terrain_cases import hill, hill_lv95, raster_of, write_tiff

from seasonscapes.declaration import InputError
from seasonscapes.frames import LocalFrame
from seasonscapes.terrain.crs import geodetic_from_map, map_from_geodetic
from seasonscapes.terrain.hole_filling import harmonic_fill
from seasonscapes.terrain.raster import (
    bounds_geographic,
    centre_frame,
    fill_nodata,
    read_elevation,
    read_raster,
    require_overlap,
    sample_raster,
)
from seasonscapes.terrain.surface import Raster

LV95 = Affine(100, 0, 2640000, 0, -100, 1160000)


# ---------------------------------------------------------------------------------------------- reading


def test_geotiff_keeps_values_transform_and_crs(tmp_path):
    heights = np.arange(12, dtype=np.int16).reshape(3, 4) * 100
    raster = read_elevation(write_tiff(tmp_path / "a.tif", heights, LV95, "EPSG:2056"))
    np.testing.assert_array_equal(raster.values[..., 0], heights)
    assert raster.values.dtype == np.float32
    assert (raster.transform, raster.crs) == (LV95, "EPSG:2056")


def test_nodata_mask_alpha_and_scale_become_what_they_mean(tmp_path):
    heights = np.array([[100, 200], [-9999, 400]], np.int16)
    path = write_tiff(tmp_path / "a.tif", heights, LV95, "EPSG:2056", nodata=-9999)
    import rasterio

    with rasterio.open(path, "r+") as file:
        file.scales, file.offsets = (0.5,), (10.0,)
    np.testing.assert_array_equal(read_elevation(path).values[..., 0], [[60, 110], [np.nan, 210]])

    rgba = np.full((4, 2, 2), 200, np.uint8)
    rgba[3] = [[255, 0], [255, 255]]
    for name, profile in (("rgba.tif", {"photometric": "RGB", "alpha": "YES"}), ("described.tif", {})):
        path = write_tiff(tmp_path / name, rgba, LV95, "EPSG:2056", **profile)
        if name == "described.tif":
            with rasterio.open(path, "r+") as file:
                file.set_band_description(4, "alpha (0 = no image)")
        image = read_raster(path)
        assert image.values.shape == (2, 2, 3), name
        assert np.isnan(image.values[0, 1]).all(), name
        assert np.isfinite(image.values).sum() == 9, name


def test_srtm_tile_is_read_at_its_published_place_with_voids(tmp_path):
    """An .hgt file is bare big-endian int16 from the north-west; its name places the south-west sample's centre."""
    samples = np.full((1201, 1201), 500, ">i2")
    samples[0, 0], samples[1200, 0], samples[600, 1200], samples[7, 9] = 1111, 2222, 3333, -32768
    samples.tofile(tmp_path / "N46E007.hgt")
    raster = read_elevation(tmp_path / "N46E007.hgt")
    assert raster.crs == "EPSG:4326"
    at = lambda longitude, latitude: float(sample_raster(raster, longitude, latitude)[0])  # noqa: E731
    np.testing.assert_allclose((at(7.0, 47.0), at(7.0, 46.0), at(8.0, 46.5)), (1111, 2222, 3333), atol=1e-3)
    assert np.isnan(raster.values[7, 9, 0])
    assert np.isnan(raster.values).sum() == 1


def test_vrt_mosaic_joins_its_tiles_without_a_seam(tmp_path):
    whole = hill_lv95(40, 60).values[..., 0]
    transform = Affine(60, 0, 2637800, 0, -60, 1159300)
    sources = []
    for index, first in enumerate((0, 30)):
        tile = Affine(60, 0, 2637800 + first * 60, 0, -60, 1159300)
        write_tiff(tmp_path / f"tile{index}.tif", whole[:, first : first + 30], tile, "EPSG:2056")
        sources.append(
            f'<SimpleSource><SourceFilename relativeToVRT="1">tile{index}.tif</SourceFilename>'
            f'<SourceBand>1</SourceBand><SrcRect xOff="0" yOff="0" xSize="30" ySize="40"/>'
            f'<DstRect xOff="{first}" yOff="0" xSize="30" ySize="40"/></SimpleSource>'
        )
    (tmp_path / "mosaic.vrt").write_text(
        '<VRTDataset rasterXSize="60" rasterYSize="40"><SRS>EPSG:2056</SRS>'
        "<GeoTransform>2637800, 60, 0, 1159300, 0, -60</GeoTransform>"
        f'<VRTRasterBand dataType="Float32" band="1">{"".join(sources)}</VRTRasterBand></VRTDataset>'
    )
    raster = read_elevation(tmp_path / "mosaic.vrt")
    np.testing.assert_array_equal(raster.values[..., 0], whole)
    assert raster.transform == transform
    (tmp_path / "tile1.tif").unlink()
    with pytest.raises(InputError, match=r"mosaic.vrt: SourceFilename: no such file.*tile1.tif"):
        read_elevation(tmp_path / "mosaic.vrt")


def test_window_covers_what_was_asked_and_touches_nothing_else(tmp_path):
    """Tiles outside the window are destroyed on disk: only a read that never touches them can succeed."""
    full = hill_lv95(256, 256, 30.0)
    path = write_tiff(
        tmp_path / "tiled.tif",
        full.values[..., 0],
        full.transform,
        full.crs,
        tiled=True,
        blockxsize=64,
        blockysize=64,
        compress="deflate",
    )
    whole = read_elevation(path)
    # A box well within tile column 1, row 2.
    latitude, longitude = geodetic_from_map(full.crs, *_centre(full, np.array([72, 120]), np.array([184, 136])))
    bounds = (longitude[0], latitude[0], longitude[1], latitude[1])
    _destroy_all_tiles_but(path, 2 * 4 + 1)
    with pytest.raises(InputError, match="not readable as a raster"):
        read_elevation(path)
    part = read_elevation(path, bounds_deg=bounds)
    west, south, east, north = bounds_geographic(part)
    assert west <= bounds[0]
    assert south <= bounds[1]
    assert east >= bounds[2]
    assert north >= bounds[3]
    column = round((part.transform.c - full.transform.c) / 30.0)
    row = round((full.transform.f - part.transform.f) / 30.0)
    height, width = part.values.shape[:2]
    np.testing.assert_array_equal(part.values, whole.values[row : row + height, column : column + width])
    assert height <= 64
    assert width <= 64


def _centre(raster, column, row):
    return raster.transform.c + raster.transform.a * (column + 0.5), raster.transform.f + raster.transform.e * (
        row + 0.5
    )


def _destroy_all_tiles_but(path, kept):
    import tifffile

    with tifffile.TiffFile(path) as file:
        page = file.pages[0]
        ranges = list(zip(page.dataoffsets, page.databytecounts, strict=True))
    with open(path, "r+b") as file:
        for index, (offset, count) in enumerate(ranges):
            if index != kept:
                file.seek(offset)
                file.write(b"\xff" * count)


def test_shrinking_while_reading_is_the_mean_of_blocks(tmp_path):
    rng = np.random.default_rng(3)
    values = rng.uniform(0, 100, (9, 11)).astype(np.float32)
    values[:3, :3] = -1
    path = write_tiff(tmp_path / "a.tif", values, LV95, "EPSG:2056", nodata=-1)
    raster = read_raster(path, finest_m=399.0)
    assert raster.values.shape == (3, 3, 1)
    assert np.isnan(raster.values[0, 0, 0])
    np.testing.assert_allclose(raster.values[2, 1, 0], values[6:9, 3:6].mean(), rtol=1e-6)
    assert raster.transform == Affine(300, 0, 2640000, 0, -300, 1160000)


@pytest.mark.parametrize(
    ("crs", "transform", "values", "message"),
    [
        (None, LV95, 500.0, "the raster has no CRS; assign one with: gdal_edit.py -a_srs EPSG:… FILE"),
        ("EPSG:2056", None, 500.0, "the raster has a CRS but no geotransform"),
        (
            "EPSG:2056",
            Affine(0.001, 0, 7.9, 0, -0.001, 46.6),
            500.0,
            "coordinates in degrees in the projected CRS EPSG:2056; got 'x 7.9 … 7.904, y 46.597 … 46.6'",
        ),
        ("EPSG:4326", LV95, 500.0, "coordinates beyond ±180°/±90° in the geographic CRS EPSG:4326"),
        (
            "EPSG:2056",
            LV95,
            90000.0,
            "heights outside the range of land elevations; got '90000 … 90000'; expected -500 … 9000 m",
        ),
        ("EPSG:2056", LV95, -32768.0, "cure"),
    ],
)
@pytest.mark.filterwarnings("ignore:Dataset has no geotransform")
def test_bad_elevation_rasters_are_named(tmp_path, crs, transform, values, message):
    path = write_tiff(tmp_path / "a.tif", np.full((3, 4), values, np.float32), transform, crs)
    if message == "cure":
        message = "check unit (metres), band, and that the file declares its nodata"
    with pytest.raises(InputError) as error:
        read_elevation(path)
    assert message in str(error.value)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_missing_and_unreadable_files_and_bands_are_named(tmp_path):
    with pytest.raises(InputError, match=r"none.tif: no such file$"):
        read_elevation(tmp_path / "none.tif")
    (tmp_path / "text.tif").write_text("not a raster")
    with pytest.raises(InputError, match=r"text.tif: not readable as a raster: "):
        read_elevation(tmp_path / "text.tif")
    path = write_tiff(tmp_path / "three.tif", np.full((3, 2, 2), 700, np.int16), LV95, "EPSG:2056")
    with pytest.raises(InputError, match=r"more than one band; got 3; expected one band of heights; name the band"):
        read_elevation(path)
    assert read_elevation(path, band=2).values.shape == (2, 2, 1)
    with pytest.raises(InputError, match=r"no such band; got 4; expected 1 … 3"):
        read_elevation(path, band=4)
    with pytest.raises(InputError, match=r"does not overlap the requested area; got 'W 7\.9"):
        read_elevation(path, band=1, bounds_deg=(9.0, 46.0, 9.1, 46.1))
    with pytest.raises(ValueError, match="west < east"):
        read_elevation(path, band=1, bounds_deg=(9.1, 46.0, 9.0, 46.1))
    with pytest.raises(ValueError, match="finest_m: got 0, expected a positive size"):
        read_raster(path, finest_m=0)


def test_rasters_that_share_no_ground_are_refused():
    here = hill_lv95(10, 10)
    there = Raster(here.values, Affine(60, 0, 2737800, 0, -60, 1159300), here.crs)
    require_overlap(here, here, where="image.tif")
    with pytest.raises(
        InputError, match=r"image.tif: does not overlap the elevation raster; got 'W 9\.\d+ .*check the CRS"
    ):
        require_overlap(there, here, where="image.tif")


# ---------------------------------------------------------------------------------------------- map and WGS 84


def test_swiss_grid_origin_lies_where_swisstopo_says():
    """Bern, the origin of LV95: 46°57'03.898" N, 7°26'19.077" E in CHTRS95 (swisstopo, Formulas and constants)."""
    latitude, longitude = geodetic_from_map("EPSG:2056", 2600000.0, 1200000.0)
    assert abs(latitude - (46 + 57 / 60 + 3.898 / 3600)) < 3e-7
    assert abs(longitude - (7 + 26 / 60 + 19.077 / 3600)) < 3e-7
    np.testing.assert_allclose(map_from_geodetic("EPSG:2056", latitude, longitude), (2600000, 1200000), atol=1e-3)


def test_vertical_part_of_a_crs_moves_nothing(tmp_path):
    """LV95 + LN02 heights: the position equals that of LV95 alone, and heights stay as they are."""
    compound = "EPSG:2056+5728"
    np.testing.assert_array_equal(
        geodetic_from_map(compound, 2640000.0, 1160000.0), geodetic_from_map("EPSG:2056", 2640000.0, 1160000.0)
    )
    path = write_tiff(tmp_path / "a.tif", np.full((2, 2), 1234.0, np.float32), LV95, compound)
    assert (read_elevation(path).values == 1234.0).all()


def test_unusable_coordinate_systems_are_named():
    with pytest.raises(InputError, match="EPSG:999999: not a coordinate reference system"):
        geodetic_from_map("EPSG:999999", 0.0, 0.0)
    local = 'LOCAL_CS["site grid",UNIT["metre",1],AXIS["x",EAST],AXIS["y",NORTH]]'
    with pytest.raises(InputError, match="neither geographic nor projected"):
        geodetic_from_map(local, 0.0, 0.0)


def test_centre_frame_and_bounds():
    raster = raster_of(hill, "EPSG:4326", Affine(0.001, 0, 7.9, 0, -0.002, 46.6), 20, 30)
    np.testing.assert_allclose(bounds_geographic(raster), (7.9, 46.56, 7.93, 46.6), atol=1e-9)
    frame = centre_frame(raster, height_m=5.0, refraction_k=0.13)
    assert isinstance(frame, LocalFrame)
    np.testing.assert_allclose((frame.longitude_deg, frame.latitude_deg, frame.height_m), (7.915, 46.58, 5.0))


# ---------------------------------------------------------------------------------------------- values


@given(st.tuples(*[st.floats(-50, 50)] * 4), st.floats(0.5, 6.5), st.floats(0.5, 4.5))
@settings(max_examples=60, deadline=None)
def test_bilinear_sampling_reproduces_every_bilinear_function(coefficients, column, row):
    a, b, c, d = coefficients
    rows, columns = np.mgrid[0:5, 0:7] + 0.5
    # A rotated, sheared grid: sampling must go through the whole affine map.
    transform = Affine(30.0, 4.0, 2640000.0, 7.0, -25.0, 1160000.0)
    values = (a + b * columns + c * rows + d * columns * rows)[..., None].astype(np.float64)
    x, y = transform.c + 30.0 * column + 4.0 * row, transform.f + 7.0 * column - 25.0 * row
    got = sample_raster(Raster(values, transform, "EPSG:2056"), x, y)[0]
    assert abs(got - (a + b * column + c * row + d * column * row)) < 1e-5


def test_sampling_knows_the_edge_and_does_not_spread_holes():
    values = np.arange(12.0).reshape(3, 4)[..., None]
    values[1, 2] = np.nan
    raster = Raster(values, LV95, "EPSG:2056")
    centre = lambda column, row: (2640000 + 100 * (column + 0.5), 1160000 - 100 * (row + 0.5))  # noqa: E731
    assert sample_raster(raster, *centre(1, 1))[0] == 5.0
    assert sample_raster(raster, *centre(2, 0))[0] == 2.0
    assert np.isnan(sample_raster(raster, *centre(1.5, 1))[0])
    assert sample_raster(raster, *centre(-0.5, -0.5))[0] == 0.0
    for column, row in ((-0.51, 1), (3.51, 1), (1, -0.51), (1, 2.51)):
        assert np.isnan(sample_raster(raster, *centre(column, row))[0])


def _with_hole(values, hole):
    values = np.array(values, np.float32)
    values[hole] = np.nan
    return Raster(values[..., None], LV95, "EPSG:2056")


def test_filling_restores_planes_and_saddles_and_says_how_much():
    """xy and ax + by + c are harmonic, so the membrane through their rims is themselves."""
    row, column = np.mgrid[0:80, 0:90].astype(float)
    truth = 3.0 * column - 2.0 * row + 0.05 * (column - 40) * (row - 40) + 1000.0
    hole = ((column - 45) / 25) ** 2 + ((row - 40) / 18) ** 2 < 1
    hole[5, 5] = True
    filled, report = fill_nodata(_with_hole(truth, hole))
    np.testing.assert_allclose(filled.values[..., 0], truth, atol=0.02)
    assert (report.filled_cells, report.holes, report.largest_hole_cells) == (hole.sum(), 2, hole.sum() - 1)
    assert report.share == hole.mean()


@given(st.integers(0, 10_000))
@settings(max_examples=20, deadline=None)
def test_filling_never_overshoots_and_never_touches_data(seed):
    rng = np.random.default_rng(seed)
    truth = rng.normal(1500, 400, (17, 23)).astype(np.float32)
    hole = rng.random(truth.shape) < 0.2
    filled, _ = fill_nodata(_with_hole(truth, hole), max_share=0.5)
    np.testing.assert_array_equal(filled.values[~hole, 0], truth[~hole])
    assert truth[~hole].min() - 0.01 <= filled.values.min() <= filled.values.max() <= truth[~hole].max() + 0.01


def test_filling_refuses_emptiness():
    whole, report = fill_nodata(hill_lv95(5, 5))
    assert report.filled_cells == 0
    assert np.isfinite(whole.values).all()
    with pytest.raises(InputError, match=r"dem.tif: no data at all in the requested area"):
        fill_nodata(_with_hole(np.ones((4, 4)), np.ones((4, 4), bool)), where="dem.tif")
    half = np.zeros((4, 4), bool)
    half[:2] = True
    with pytest.raises(
        InputError, match=r"dem.tif: too much of the area has no data; got '50.0 %'; expected at most 25 %"
    ):
        fill_nodata(_with_hole(np.ones((4, 4)), half), where="dem.tif")


def test_a_fill_that_does_not_converge_names_its_function(monkeypatch):
    monkeypatch.setattr("scipy.sparse.linalg.cg", lambda _matrix, known, **_options: (known, 7))
    hole = np.zeros((4, 4), bool)
    hole[1, 1:3] = True
    with pytest.raises(ValueError, match="harmonic_fill: conjugate gradients did not converge in 7 steps"):
        harmonic_fill(np.ones((4, 4)), hole)
