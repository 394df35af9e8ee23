"""Numbers of an elevation file are heights in metres, or are doubted or refused in one line that names the cause."""

import json
import logging

import numpy as np
import pytest
import rasterio
from affine import Affine
from terrain_cases import write_tiff

from seasonscapes.cli import main
from seasonscapes.errors import InputError
from seasonscapes.terrain.memory import check_memory
from seasonscapes.terrain.raster import read_elevation

GRID = Affine(30, 0, 420000, 0, -30, 5160000)
FOOT = 1200.0 / 3937.0


def hill(rows=64, columns=64, base=500.0, peak=800.0):
    """A smooth hill [m]."""
    y, x = np.mgrid[0:rows, 0:columns]
    shape = ((x - 0.6 * columns) ** 2 + (y - 0.4 * rows) ** 2) / (2.0 * (0.22 * columns) ** 2)
    return (base + peak * np.exp(-shape)).astype(np.float32)


def written(folder, values, crs="EPSG:32632", transform=GRID, units=None, scales=None, offsets=None, **profile):
    path = write_tiff(folder / "dem.tif", values, transform, crs, **profile)
    with rasterio.open(path, "r+") as file:
        if units is not None:
            file.units = (units,)
        if scales is not None:
            file.scales, file.offsets = (scales,), (offsets,)
    return path


def told(caplog):
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


# ---------------------------------------------------------------------------------------------- units


@pytest.mark.parametrize(
    ("units", "crs", "metres"),
    [
        ("US survey foot", "EPSG:32632", FOOT),
        ("ft", "EPSG:32632", 0.3048),
        ("dm", "EPSG:32632", 0.1),
        ("Centimeters", "EPSG:32632", 0.01),
        (None, "EPSG:32632+6360", FOOT),  # NAVD88 height (ftUS)
        (None, "EPSG:32632+8228", 0.3048),  # NAVD88 height (ft)
    ],
)
def test_a_declared_unit_is_converted_to_metres_and_told(tmp_path, caplog, units, crs, metres):
    path = written(tmp_path, hill() / metres, crs, units=units)
    np.testing.assert_allclose(read_elevation(path).values[..., 0], hill(), rtol=1e-6)
    assert len(told(caplog)) == 1
    assert "converted to metres" in told(caplog)[0]


def test_scale_and_offset_count_before_the_unit(tmp_path, caplog):
    path = written(tmp_path, np.full((4, 4), 100, np.int16), units="foot", scales=2.0, offsets=50.0)
    np.testing.assert_allclose(read_elevation(path).values, 250.0 * 0.3048, rtol=1e-6)
    assert len(told(caplog)) == 1


@pytest.mark.parametrize(("units", "crs"), [(None, "EPSG:32632"), ("m", "EPSG:32632"), (None, "EPSG:32632+5773")])
def test_metres_are_taken_without_a_word(tmp_path, caplog, units, crs):
    np.testing.assert_array_equal(read_elevation(written(tmp_path, hill(), crs, units=units)).values[..., 0], hill())
    assert not told(caplog)


def test_units_that_are_no_length_or_contradict_each_other_are_refused_unless_the_scene_states_one(tmp_path):
    path = written(tmp_path, hill(), units="dBZ")
    with pytest.raises(InputError, match=r"unknown unit; got 'dBZ'.*\[elevation\] unit"):
        read_elevation(path)
    np.testing.assert_array_equal(read_elevation(path, unit="metre").values[..., 0], hill())
    with pytest.raises(InputError, match="different units of height; got 'decimetre and US survey foot'"):
        read_elevation(written(tmp_path, hill(), "EPSG:32632+6360", units="dm"))
    with pytest.raises(InputError, match="counts depths, downwards"):
        read_elevation(written(tmp_path, hill(), "EPSG:32632+5715"))


@pytest.mark.parametrize(
    ("values", "crs", "transform"),
    [
        (hill(base=1500.0) / 0.3048, "EPSG:32632", GRID),  # 7,500 m in the Alps
        (hill(peak=700.0) / 0.3048, "EPSG:32632", Affine(10, 0, 420000, 0, -10, 5160000)),  # slopes of 75°
        (hill(peak=90.0) / FOOT, "EPSG:2232", Affine(100, 0, 3000000, 0, -100, 1700000)),  # a map in feet
    ],
)
def test_heights_that_look_like_feet_are_doubted_until_the_unit_is_stated(tmp_path, caplog, values, crs, transform):
    path = written(tmp_path, values, crs, transform)
    read_elevation(path)
    assert len(told(caplog)) == 1
    assert "look like feet" in told(caplog)[0]
    caplog.clear()
    read_elevation(path, unit="metre")
    assert not told(caplog)
    np.testing.assert_allclose(read_elevation(path, unit="foot").values[..., 0], values * 0.3048, rtol=1e-6)


@pytest.mark.parametrize(("zone", "y"), [(32645, 3_090_000), (32719, 6_390_000), (32605, 6_990_000)])
def test_the_highest_mountains_of_the_world_are_not_doubted(tmp_path, caplog, zone, y):
    """Himalaya, Aconcagua, Denali."""
    read_elevation(written(tmp_path, hill(base=5300.0), f"EPSG:{zone}", Affine(90, 0, 480000, 0, -90, y)))
    assert not told(caplog)


# ---------------------------------------------------------------------------------------------- impossible heights


def test_zeros_among_mountains_are_missing_data_and_a_sea_is_not(tmp_path):
    holes = hill(base=1200.0)
    holes[20:30, 10:22] = 0.0
    path = written(tmp_path, holes)
    with pytest.raises(InputError, match=r"exactly 0 among mountains.*got '120 samples.*nodata = 0"):
        read_elevation(path)
    assert np.isnan(read_elevation(path, nodata=0.0).values).sum() == 120
    assert read_elevation(path, nodata=-9999.0).values.min() == 0.0
    shore = np.maximum(hill(base=-300.0), 0.0)
    assert (read_elevation(written(tmp_path, shore)).values == 0.0).sum() > 100


def test_a_single_spike_is_doubted_with_its_place_and_a_steep_summit_is_not(tmp_path, caplog):
    spiked = hill()
    spiked[10, 20] = 4000.0
    read_elevation(written(tmp_path, spiked))
    assert len(told(caplog)) == 1
    assert "1 single samples stand out" in told(caplog)[0]
    assert "46.58" in told(caplog)[0]
    caplog.clear()
    y, x = np.mgrid[0:64, 0:64]
    needle = (500.0 + np.maximum(0.0, 2000.0 - 60.0 * np.hypot(x - 30, y - 30))).astype(np.float32)
    read_elevation(written(tmp_path, needle))
    assert not any("stand out" in line for line in told(caplog))


def test_noise_is_refused_and_rough_ground_doubted(tmp_path, caplog):
    noise = np.random.default_rng(1).uniform(0.0, 8000.0, (64, 64)).astype(np.float32)
    with pytest.raises(InputError, match=r"noise, not heights.*byte order"):
        read_elevation(written(tmp_path, noise))
    read_elevation(written(tmp_path, 500.0 + noise / 100.0))
    assert [line for line in told(caplog) if "noise, not heights" in line]


def test_pictures_and_radar_products_are_no_heights(tmp_path):
    path = write_tiff(tmp_path / "palette.tif", np.full((4, 4), 7, np.uint8), GRID, "EPSG:32632")
    with rasterio.open(path, "r+") as file:
        file.write_colormap(1, {7: (90, 140, 60, 255)})
    with pytest.raises(InputError, match="a colour table, not heights"):
        read_elevation(path)
    with pytest.raises(InputError, match="complex numbers; got 'complex64'"):
        read_elevation(written(tmp_path, np.full((4, 4), 700.0, np.complex64)))


# ---------------------------------------------------------------------------------------------- shapes and sizes


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (1, 40), (40, 1)])
def test_a_raster_of_one_row_or_column_is_refused(tmp_path, rows, columns):
    with pytest.raises(InputError, match=f"too few samples; got '{columns} × {rows}'; expected at least 2 × 2"):
        read_elevation(written(tmp_path, np.full((rows, columns), 700.0, np.float32)))


@pytest.mark.parametrize(
    ("transform", "message"),
    [
        (Affine(np.nan, 0, 420000, 0, -30, 5160000), "no map from pixels to places"),
        (Affine(30, 0, 420000, 0, 0, 5160000), "no map from pixels to places"),
        (Affine(30, 0, 1e300, 0, -30, 1e300), "far outside the area of its CRS"),
        (Affine(0.001, 0, 420000, 0, -0.001, 5160000), r"cells of a size.*got '0.001 m × 0.001 m'.*kilometres\?"),
        (Affine(1e5, 0, 420000, 0, -1e5, 5160000), "cells of a size"),
    ],
)
def test_grids_that_are_no_grids_of_a_landscape_are_refused(tmp_path, transform, message):
    with pytest.raises(InputError, match=message):
        read_elevation(written(tmp_path, hill(4, 4), transform=transform))


@pytest.mark.parametrize("side", [30_000, 400_000])
def test_a_raster_that_declares_more_than_the_memory_holds_is_refused_before_it_is_read(tmp_path, monkeypatch, side):
    path = tmp_path / "bomb.tif"
    profile = {"driver": "GTiff", "width": side, "height": side, "count": 1, "dtype": "float32", "tiled": True}
    profile |= {"sparse_ok": True, "BIGTIFF": "YES", "blockxsize": 1024, "blockysize": 1024, "compress": "deflate"}
    with rasterio.open(path, "w", **profile, crs="EPSG:32632", transform=Affine(1, 0, 420000, 0, -1, 5160000)):
        pass
    assert path.stat().st_size < 3_000_000
    monkeypatch.setattr("seasonscapes.terrain.memory.available_bytes", lambda: 16_000_000_000)
    with pytest.raises(
        InputError, match=rf"too large for this machine's memory.*got '{side} × {side}.*at most 16.0 GB.*\[area\]"
    ):
        read_elevation(path)


def test_free_memory_is_asked_of_the_machine():
    check_memory((10, 10), "a.tif")
    with pytest.raises(InputError, match=r"a\.tif: too large for"):
        check_memory((10**8, 10**8), "a.tif")


# ---------------------------------------------------------------------------------------------- told


def test_what_is_doubted_stands_on_the_console_and_in_the_json(tmp_path, monkeypatch, capsys):
    spiked = hill(24, 24)
    spiked[10, 12] = 4000.0
    written(tmp_path, spiked / FOOT, units="US survey foot")
    scene = tmp_path / "s.toml"
    scene.write_text('name = "s"\nvertical_datum = "local"\n[elevation]\nfile = "dem.tif"\n')
    monkeypatch.setenv("SEASONSCAPES_WORKSPACE", str(tmp_path / "work"))
    # The second time the terrain comes from the workspace.
    for _ in range(2):
        assert main(["terrain", str(scene), "--json"]) == 0
        said = capsys.readouterr()
        warnings = json.loads(said.out.splitlines()[-1])["warnings"]
        assert [any(word in line for line in warnings) for word in ("US survey foot", "stand out")] == [True, True]
        assert all(line in said.err for line in warnings)


def test_a_mosaic_of_ones_own_tiles_keeps_their_unit_and_band_order(tmp_path):
    """What `fetch` joins of files that the user names."""
    from rasterio.enums import ColorInterp

    from seasonscapes.open_data.local_files import local_colours, local_heights, local_rasters
    from seasonscapes.terrain.mosaic import MapGrid

    grid = MapGrid("EPSG:32632", 420300.0, 5159700.0, 30.0, 20, 20)
    written(tmp_path, hill() / FOOT, units="US survey foot")
    heights = local_heights(local_rasters(str(tmp_path / "dem.tif"), "elevation", flag="--dem"), grid)
    np.testing.assert_allclose(heights, hill()[10:30, 10:30], rtol=1e-5)
    colours = np.stack([np.full((64, 64), value, np.uint8) for value in (10, 120, 240)])
    path = write_tiff(tmp_path / "image.tif", colours, GRID, "EPSG:32632")
    with rasterio.open(path, "r+") as file:
        file.colorinterp = [ColorInterp.blue, ColorInterp.green, ColorInterp.red]
    shown = local_colours(local_rasters(str(path), "imagery", flag="--imagery"), grid)
    assert (np.diff(shown, axis=2) < 0.0).all()
