"""Scenes of many raster files: tiles as one raster, and images of several dates as dated albedos."""

from __future__ import annotations

import json
from datetime import date
from pathlib import Path

import numpy as np
import places
import pytest
import rasterio
from affine import Affine
from command_line import command

import seasonscapes as ss
from seasonscapes.errors import InputError
from seasonscapes.scene import read_scene
from seasonscapes.terrain.crs import apply_affine, geodetic_from_map, map_from_geodetic
from seasonscapes.terrain.imagery import read_imagery
from seasonscapes.terrain.raster import raster_grid
from seasonscapes.terrain.tile_files import newest_first, read_elevation_tiles
from seasonscapes.workflows.albedo_sources import dated_albedos, scene_albedo
from seasonscapes.workspace import Workspace

TILES = places.SCENE.replace('file = "dem.tif"', 'files = ["dem/*.tif"]').replace(
    'file = "image.tif"', 'files = ["images/**/*.tif"]'
)
DATED = """
[[imagery]]
file = "{file}"
encoding = "linear"
full_scale = 1.0
reflectance_scale = 1.0
{when}
"""


def heights(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
    """Smooth relief about the test place."""
    return 1200.0 + 200.0 * np.sin(900.0 * np.deg2rad(latitude)) * np.cos(700.0 * np.deg2rad(longitude))


def colours(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
    a, b = np.sin(2e3 * np.deg2rad(latitude)), np.cos(3e3 * np.deg2rad(longitude))
    return np.stack([0.2 + 0.1 * a, 0.2 + 0.1 * b, 0.2 + 0.05 * a * b], axis=-1)


def tile(path: Path, crs: str, west: float, north: float, spacing: float, count: int, field, **changes) -> Path:
    """A square tile of a field of latitude and longitude."""
    path.parent.mkdir(parents=True, exist_ok=True)
    transform = Affine(spacing, 0.0, west, 0.0, -spacing, north)
    x, y = apply_affine(transform, *np.meshgrid(np.arange(count) + 0.5, np.arange(count) + 0.5))
    values = np.asarray(field(*geodetic_from_map(crs, x, y)), np.float32)
    bands = values[None] if values.ndim == 2 else values.transpose(2, 0, 1)
    profile = {"driver": "GTiff", "width": count, "height": count, "count": len(bands), "dtype": "float32"}
    with rasterio.open(path, "w", **profile, crs=crs, transform=transform, **changes) as file:
        file.write(bands)
    return path


def corner(crs: str, step: float) -> tuple[float, float]:
    """Map coordinates 1.5 km north-west of the test place, on whole steps."""
    latitude, longitude = geodetic_from_map("EPSG:32632", places.EAST_M, places.NORTH_M)
    x, y = map_from_geodetic(crs, latitude, longitude)
    return round((float(x) - 1500.0) / step) * step, round((float(y) + 1500.0) / step) * step


def errors(raster, field) -> np.ndarray:
    """Absolute difference of a raster and a field at the raster's pixels, NaN where it has none."""
    rows, columns = raster.values.shape[:2]
    x, y = apply_affine(raster.transform, *np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5))
    truth = field(*geodetic_from_map(raster.crs, x, y))
    return np.abs(raster.values - (truth if truth.ndim == 3 else truth[..., None])).max(axis=2)


def test_tiles_of_one_grid_are_joined_as_they_are_and_a_missing_one_is_a_hole(tmp_path):
    west, north = corner("EPSG:2056", 50.0)
    for row in range(3):
        for column in range(3):
            if (row, column) != (1, 2):
                place = (west + 1000.0 * column, north - 1000.0 * row)
                tile(tmp_path / f"t_{row}_{column}.tif", "EPSG:2056", *place, 20.0, 50, heights)
    raster = read_elevation_tiles(sorted(map(str, tmp_path.glob("*.tif"))))
    assert raster.values.shape == (150, 150, 1)
    hole = np.isnan(raster.values[..., 0])
    assert hole[50:100, 100:].all()
    assert hole.sum() == 2500
    assert np.nanmax(errors(raster, heights)) < 1e-3
    part = read_elevation_tiles(sorted(map(str, tmp_path.glob("*.tif"))), bounds_deg=(7.97, 46.545, 7.975, 46.549))
    assert part.values.shape[0] < 40
    assert np.nanmax(errors(part, heights)) < 1e-3


def test_tiles_of_other_crs_and_spacing_meet_without_a_step(tmp_path):
    """20 m in the Swiss grid beside 25 m in UTM, on a grid of 20 m; cells of the rim lie half a sample beyond the data."""
    west, north = corner("EPSG:2056", 50.0)
    tile(tmp_path / "swiss.tif", "EPSG:2056", west, north, 20.0, 90, heights)
    west, north = corner("EPSG:32632", 50.0)
    tile(tmp_path / "utm.tif", "EPSG:32632", west + 1500.0, north, 25.0, 70, heights)
    raster = read_elevation_tiles([str(tmp_path / "swiss.tif"), str(tmp_path / "utm.tif")])
    assert raster.crs == "EPSG:32632"
    assert abs(raster.transform.a) == pytest.approx(20.0, rel=0.01)
    here = errors(raster, heights)
    assert np.nanmax(here[4:80, 4:150]) < 0.02
    assert np.nanmax(here) < 0.4
    assert np.isfinite(here[10:80]).mean() > 0.97


def test_the_newest_tile_counts_and_patterns_say_what_is_wrong(tmp_path):
    west, north = corner("EPSG:2056", 50.0)
    for year, shift in (("2019", 50.0), ("2023", 0.0)):
        name = f"swissalti3d_{year}_2600-1156_2_2056_5728.tif"
        tile(tmp_path / name, "EPSG:2056", west, north, 20.0, 150, lambda *at, shift=shift: heights(*at) + shift)
    paths = newest_first(sorted(map(str, tmp_path.glob("*.tif"))))
    assert "2023" in paths[0]
    assert errors(read_elevation_tiles(paths), heights).max() < 1e-3
    with pytest.raises(InputError, match=r"elevation\.files\[0\]: no file fits the pattern; got 'dem/\*\.tif'"):
        read_scene(places.write_place(tmp_path / "none", TILES))


@pytest.mark.parametrize("pattern", ["../*.tif", "/etc/*", "dem/*/../../../*.tif"])
def test_patterns_do_not_lead_outside(tmp_path, pattern):
    path = places.write_place(tmp_path / "scene", TILES.replace("dem/*.tif", pattern))
    places.write_raster(tmp_path / "dem.tif", places.hill_heights(), spacing_m=50.0)
    with pytest.raises(InputError, match=r"elevation\.files\[0\]: leads outside its folder"):
        read_scene(path)


def test_a_scene_of_tiles_is_the_scene_of_one_file(tmp_path):
    """Terrain and albedo of tiles, some of them in sub-folders, are those of the whole raster, averaged alike."""
    whole = places.write_place(tmp_path / "whole")
    parts = places.write_place(tmp_path / "parts", TILES)
    for name, folder in (("dem.tif", "dem"), ("image.tif", "images/deep")):
        with rasterio.open(tmp_path / "whole" / name) as file:
            values, transform = file.read(), file.transform
        for row in (0, 30):
            for column in (0, 30):
                # Neighbouring tiles share a line of samples.
                part = values[:, row : row + 31, column : column + 31].transpose(1, 2, 0)
                origin = transform * (column, row)
                path = tmp_path / "parts" / folder / f"{row}_{column}.tif"
                path.parent.mkdir(parents=True, exist_ok=True)
                places.write_raster(path, part, spacing_m=50.0, origin=origin)
    workspace = Workspace(tmp_path / "work")
    one, many = (ss.load_place(path, workspace) for path in (whole, parts))
    assert np.array_equal(one.terrain.vertices, many.terrain.vertices)
    assert np.array_equal(one.elevation.values, many.elevation.values)
    day = date(2024, 7, 1)
    assert np.allclose(scene_albedo(one, day).values, scene_albedo(many, day).values, atol=1e-4)


def test_imagery_is_averaged_in_blocks_that_neighbours_share(tmp_path):
    west, north = corner("EPSG:2056", 50.0)
    for column in range(2):
        tile(tmp_path / f"{column}.tif", "EPSG:2056", west + 1000.0 * column, north, 10.0, 100, colours)
    paths = [str(tmp_path / f"{column}.tif") for column in range(2)]
    image = read_imagery(paths, finest_m=35.0, encoding="linear", full_scale=1.0)
    assert abs(image.transform.a) == pytest.approx(20.0)
    assert image.values.shape == (50, 100, 3)
    assert np.isfinite(image.values).all()
    assert errors(image, colours).max() < 2e-3


def test_tiles_on_both_sides_of_the_antimeridian_are_neighbours(tmp_path):
    for name, west in (("a.tif", 179.98), ("b.tif", -180.0)):
        path = tmp_path / name
        transform = Affine(0.001, 0.0, west, 0.0, -0.001, -16.8)
        with rasterio.open(
            path,
            "w",
            driver="GTiff",
            width=20,
            height=30,
            count=1,
            dtype="float32",
            crs="EPSG:4326",
            transform=transform,
        ) as file:
            file.write(np.full((1, 30, 20), 10.0 + west % 360.0, np.float32))
    raster = read_elevation_tiles([str(tmp_path / "a.tif"), str(tmp_path / "b.tif")])
    assert raster.values.shape == (30, 40, 1)
    assert np.array_equal(raster.values[0, :, 0], np.repeat(np.array([189.98, 190.0], np.float32), 20))


# ---------------------------------------------------------------------------------------------- several dates


def dated(tmp_path: Path, *images: tuple[str, str]) -> Path:
    """A scene of several images (file, what says when)."""
    head, camera = places.SCENE.split("[imagery]")[0], places.SCENE[places.SCENE.index("[[camera]]") :]
    tables = "".join(DATED.format(file=file, when=when) for file, when in images)
    return places.write_place(tmp_path, head + tables + camera)


def test_images_of_several_dates_are_dated_albedos(tmp_path, capsys):
    """Each is the albedo of its day; between them the albedo is interpolated, as between files given with --albedo."""
    path = dated(
        tmp_path, ("image.tif", 'delit = true\ndate = "2024-07-20"'), ("winter.tif", "delit = true\ndate = 2024-01-20")
    )
    places.write_raster(tmp_path / "winter.tif", np.full((61, 61, 3), 0.7), spacing_m=50.0)
    place = ss.load_place(path, Workspace(tmp_path / "work"))
    found = dated_albedos(place)
    assert [each.day.isoformat() for each in found] == ["2024-01-20", "2024-07-20"]
    known = found[0].load().weight > 0.99
    winter, summer, spring = (scene_albedo(place, date(2024, month, 20)).values[known].mean() for month in (1, 7, 4))
    assert winter == pytest.approx(0.7, abs=0.01)
    assert 0.2 < summer < 0.24
    assert 0.4 < spring < 0.5
    flags = {"size": "24x16", "sky": "hosek", "workspace": tmp_path / "work", "json": True}
    command("render", path, time="2024-02-20T12:00", season="nearest", output=tmp_path / "a.png", **flags)
    told = json.loads(capsys.readouterr().out)
    assert [each["date"] for each in told["albedo"]] == ["2024-01-20", "2024-07-20"]
    assert told["season"] == "nearest"


def test_the_light_of_each_dated_image_is_its_own(tmp_path):
    """Two images of one albedo, lit by the morning and by the afternoon sun: without their light they agree."""
    truth = places.write_place(
        tmp_path / "truth", places.SCENE.replace("reflectance_scale = 1.0", "reflectance_scale = 1.0\ndelit = true")
    )
    workspace = Workspace(tmp_path / "work")
    place = ss.load_place(truth, workspace)
    times = ("2024-06-20T07:30Z", "2024-09-20T14:30Z")
    names = []
    for time in times:
        lit = ss.lit_texture(place, time, sky="hosek", rays=64)
        level = np.pi / 100_000.0
        values = np.nan_to_num(np.asarray(lit.radiance)) * level
        names.append(resampled(tmp_path / "dated", f"{time[:10]}.tif", place, values))
    path = dated(
        tmp_path / "dated",
        *((name, f'time = "{time}"\nsky = "hosek"') for name, time in zip(names, times, strict=True)),
    )
    delit = [each.load() for each in dated_albedos(ss.load_place(path, workspace))]
    lit = [
        read_imagery(tmp_path / "dated" / name, encoding="linear", full_scale=1.0).values[8:-8, 8:-8] for name in names
    ]
    before = np.abs(np.log(lit[0] / lit[1]) - np.median(np.log(lit[0] / lit[1]))).mean()
    known = (delit[0].weight > 0.99) & (delit[1].weight > 0.99)
    ratio = np.log(delit[0].values[known] / delit[1].values[known])
    after = np.abs(ratio - np.median(ratio)).mean()
    assert after < 0.35 * before


def resampled(folder: Path, name: str, place, values: np.ndarray) -> str:
    """Values ``(R, S, 3)`` of a place's planar texture as an image on the grid of the scene's own."""
    from seasonscapes.frames import enu_from_geodetic
    from seasonscapes.rendering.hemisphere_rays import texture_at

    folder.mkdir(parents=True, exist_ok=True)
    grid = raster_grid(place.scene.images[0].paths[0])
    rows, columns = grid.values.shape[:2]
    x, y = apply_affine(grid.transform, *np.meshgrid(np.arange(columns) + 0.5, np.arange(rows) + 0.5))
    latitude, longitude = geodetic_from_map(grid.crs, x, y)
    enu = enu_from_geodetic(place.frame, latitude, longitude, 1000.0).reshape(-1, 3)
    design = np.c_[place.terrain.vertices[:, :2].astype(float), np.ones(len(place.terrain.vertices))]
    affine = np.linalg.lstsq(design, place.terrain.uv.astype(float), rcond=None)[0]
    uv = np.c_[enu[:, :2], np.ones(len(enu))] @ affine
    image = texture_at(values, uv.astype(np.float32)).reshape(rows, columns, 3)
    places.write_raster(folder / name, image, spacing_m=50.0)
    return name


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (
            (("image.tif", ""), ("image.tif", "")),
            r"imagery\[0\], imagery\[1\]: of several images each needs 'time', or 'date'",
        ),
        (
            (("image.tif", 'time = "2023-07-20T12:00"'), ("image.tif", 'date = "2024-07-20"')),
            r"imagery\[0\] and imagery\[1\] show the same day of the year, 07-20",
        ),
        (
            (("image.tif", 'date = "20. July"'), ("image.tif", 'time = "2024-07-20"\nfull_scal = 1.0')),
            r"3 problems: imagery\[1\]\.full_scal: .*imagery\[0\]\.date: not a date.*imagery\[1\]\.time: the hour is missing",
        ),
        ((("none.tif", "date = 2024-01-20"), ("image.tif", "date = 2024-07-20")), r"imagery\[0\]\.file: no such file"),
        ((("image.tif", 'files = ["*.tif"]\ndate = 2024-01-20'),), "give either 'file', or the tiles of an image"),
        ((("image.tif", 'time = "2023-07-20T12:00"\ndate = "2023-07-20"'),), "'time' says the date already"),
    ],
)
def test_mistakes_about_images_are_one_line(tmp_path, images, message):
    with pytest.raises(InputError, match=message) as error:
        read_scene(dated(tmp_path, *images))
    assert "\n" not in str(error.value)


def test_one_image_of_several_is_delit_by_name_alone(tmp_path):
    path = dated(tmp_path, ("image.tif", "date = 2024-01-20"), ("image.tif", "date = 2024-07-20"))
    with pytest.raises(
        InputError, match=r"the scene has several images; got 'image\.tif, image\.tif'; name one with --image"
    ):
        command("delight", path, time="2024-07-20T12:00", output=tmp_path / "a.npz", workspace=tmp_path / "work")
