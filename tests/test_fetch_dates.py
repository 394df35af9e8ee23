"""Places of several images: of several intervals of a catalogue, and of files that tell their own times."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import places
import pytest
import rasterio
from affine import Affine
from command_line import command
from open_data_world import World, reflectance

import seasonscapes as ss
from seasonscapes.errors import InputError
from seasonscapes.open_data import remote
from seasonscapes.open_data.local_files import local_rasters
from seasonscapes.terrain.crs import geodetic_from_map
from seasonscapes.workflows.albedo_sources import dated_albedos

ALPS = (46.55, 7.999)
AT = "46.55,7.999"
WINTER, SUMMER = "2024-02-10T10:25:31Z", "2024-07-14T10:25:31Z"


def snow(latitude: np.ndarray, longitude: np.ndarray) -> np.ndarray:
    return 0.6 + 0.5 * reflectance(latitude, longitude)


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    world = World(tmp_path_factory.mktemp("dates") / "world")
    for west in (7.85, 8.0):
        world.dem_tile(west, 46.475)
    for when, colours in ((WINTER, snow), (SUMMER, reflectance), ("2023-07-14T10:25:31Z", reflectance)):
        world.sentinel_tile(when, "EPSG:32632", *ALPS, size_m=5000.0, colours=colours)
    yield world
    world.stop()


@pytest.fixture(scope="module")
def fetch(world, tmp_path_factory):
    url, cache = world.start(), tmp_path_factory.mktemp("cache")

    def run(output: Path, **flags) -> Path:
        command("fetch", output=output, **({"at": AT, "size": "2km", "stac": url, "workspace": cache} | flags))
        return output

    return run


def declared(scene: Path) -> dict:
    return tomllib.loads(scene.read_text())


def test_each_date_is_an_image_with_its_own_time(fetch, tmp_path):
    scene = fetch(tmp_path / "p.toml", date=["2024-07", "2024-02"])
    images = declared(scene)["imagery"]
    assert [image["time"] for image in images] == [SUMMER, WINTER]
    assert [image["file"] for image in images] == ["p.2024-07-14.ortho.tif", "p.2024-02-10.ortho.tif"]
    told = json.loads((tmp_path / "p.sources.json").read_text())
    suns = [part["sun"]["elevation_deg"] for part in told["imagery"]]
    assert suns[0] > 55.0
    assert suns[1] < 30.0
    assert set(told["files"]) == {"p.toml", "p.dem.tif", *(image["file"] for image in images)}
    means = []
    for image in images:
        with rasterio.open(tmp_path / image["file"]) as file:
            means.append(file.read(1, masked=True).mean() / 1e4)
    assert 0.1 < means[0] < 0.2
    assert 0.6 < means[1] < 0.7
    place = ss.load_place(scene, ss.Workspace(tmp_path / "work"))
    assert [each.day.isoformat() for each in dated_albedos(place)] == ["2024-02-10", "2024-07-14"]


def test_a_plan_lists_each_date(fetch, tmp_path, capsys):
    fetch(tmp_path / "p.toml", date=["2024-07", "2024-02"], plan=True, json=True)
    told = json.loads(capsys.readouterr().out)
    assert [[day["time"] for day in part["days"]] for part in told["imagery"]] == [[SUMMER], [WINTER]]
    assert not (tmp_path / "p.toml").exists()


def test_the_recorded_plan_of_grindelwald_is_what_the_local_catalogue_gives(tmp_path, capsys):
    """The plan on the how-to page: items called as the real ones are, of a catalogue on this machine."""
    world = World(tmp_path / "grindelwald")
    for name, west in (("E007", 7.9), ("E008", 8.0)):
        world.dem_tile(west, 46.54, size_deg=0.16, name=f"Copernicus_DSM_COG_10_N46_00_{name}_00_DEM")
    for when, clouds in (("2024-07-19T10:25:31Z", 14.2), ("2024-08-08T10:25:32Z", 6.4), ("2024-09-17T10:25:30Z", 2.1)):
        name = f"S2B_T32TMS_{when[:19].replace('-', '').replace(':', '')}_L2A"
        world.sentinel_tile(when, "EPSG:32632", 46.62, 8.03, size_m=13_000.0, cloud_percent=clouds, name=name)
    flags = {"at": "46.62,8.03", "size": "12km", "date": "2024-07..2024-09", "workspace": tmp_path / "cache"}
    try:
        command("fetch", stac=world.start(), plan=True, output=tmp_path / "grindelwald.toml", **flags)
    finally:
        world.stop()
    page = (Path(__file__).parents[1] / "docs" / "howto" / "fetch.md").read_text(encoding="utf-8")
    assert f"```text\n{capsys.readouterr().out.rstrip()}\n```" in page


def test_a_median_of_several_dates_states_days_whose_light_stays_in(fetch, tmp_path):
    scene = fetch(tmp_path / "p.toml", date=["2024-07", "2024-02"], composite="median")
    images = declared(scene)["imagery"]
    assert [image["date"] for image in images] == ["2024-07-14", "2024-02-10"]
    assert not any("time" in image for image in images)


def test_two_images_of_one_day_of_the_year_are_refused(fetch, tmp_path):
    line = "--date: two images show one day of the year; got '2023-07-14 and 2024-07-14'; choose times of the year"
    with pytest.raises(InputError, match=line):
        fetch(tmp_path / "p.toml", date=["2023-07", "2024-07"])
    assert list(tmp_path.iterdir()) == []


def test_a_date_without_an_image_is_told_with_its_time(fetch, tmp_path):
    with pytest.raises(InputError, match=r"no image in this time .* got '2024-11-01T00:00:00Z/2024-11-30"):
        fetch(tmp_path / "p.toml", date=["2024-07", "2024-11"])
    assert list(tmp_path.iterdir()) == []


# ---------------------------------------------------------------------------------------------- files of one's own


def picture(path: Path, *, level: int = 100, east_m: float = 0.0, width: int = 60, tags: dict | None = None) -> Path:
    """An 8-bit image of the test place, 3 km wide unless said otherwise; ``tags`` are acquisition metadata."""
    path.parent.mkdir(parents=True, exist_ok=True)
    transform = Affine(50.0, 0.0, places.EAST_M - 1500.0 + east_m, 0.0, -50.0, places.NORTH_M + 1500.0)
    profile = {"driver": "GTiff", "width": width, "height": 60, "count": 3, "dtype": "uint8", "crs": "EPSG:32632"}
    with rasterio.open(path, "w", **profile, transform=transform, photometric="RGB") as file:
        file.write(np.full((3, 60, width), level, np.uint8))
        if tags:
            file.update_tags(ns="IMAGERY", **tags)
    return path


@pytest.fixture
def own(tmp_path):
    """Heights and a function that fetches images of one's own."""
    dem = places.write_raster(tmp_path / "dem.tif", places.hill_heights(), spacing_m=50.0)

    def run(pattern: str = "images/*.tif") -> Path:
        command(
            "fetch", elevation=dem, imagery=tmp_path / pattern, output=tmp_path / "p.toml", workspace=tmp_path / "w"
        )
        return tmp_path / "p.toml"

    return run


def test_names_with_hours_become_dated_images(own, tmp_path):
    picture(tmp_path / "images" / "T32TMS_20240210T102531_TCI.tif", level=200)
    picture(tmp_path / "images" / "T32TMS_20240714T102531_TCI.tif", level=90)
    images = declared(own())["imagery"]
    assert [image["time"] for image in images] == [WINTER, SUMMER]
    with rasterio.open(tmp_path / images[0]["file"]) as file:
        assert file.read(1).max() == 200


def test_tiles_of_one_pass_are_one_image(own, tmp_path):
    picture(tmp_path / "images" / "a_20240714T102531.tif", width=30)
    picture(tmp_path / "images" / "b_20240714T102545.tif", width=30, east_m=1500.0)
    image = declared(own())["imagery"]
    assert image["time"].startswith("2024-07-14T10:25:")
    assert image["file"] == "p.ortho.tif"


def test_metadata_tell_the_hour(own, tmp_path):
    picture(tmp_path / "images" / "summer.tif", tags={"ACQUISITIONDATETIME": "2024-07-14 10:25:31"})
    assert declared(own())["imagery"]["time"] == SUMMER


def test_days_without_hours_become_dated_images_whose_light_stays_in(own, tmp_path):
    picture(tmp_path / "images" / "flight_2024-02-10.tif")
    picture(tmp_path / "images" / "flight_20240714_tile.tif")
    images = declared(own())["imagery"]
    assert [image["date"] for image in images] == ["2024-02-10", "2024-07-14"]
    assert not any("time" in image for image in images)


def test_tiles_of_several_days_beside_each_other_are_one_image_without_a_time(own, tmp_path):
    picture(tmp_path / "images" / "west_20240714.tif", width=30)
    picture(tmp_path / "images" / "east_20240715.tif", width=30, east_m=1500.0)
    image = declared(own())["imagery"]
    assert "time" not in image
    assert "date" not in image


@pytest.mark.parametrize(
    ("files", "line"),
    [
        (
            {"a_20240714T102531.tif": {}, "b_20240714T142531.tif": {}},
            "--imagery: the files show one day of the year at several times; got '2024-07-14T10:25Z and 2024-07-14T14:25Z'",
        ),
        (
            {"a_20240714T102531.tif": {}, "b.tif": {}},
            "--imagery: some files tell their hour, others do not; got 'a_20240714T102531.tif and b.tif'",
        ),
        (
            {"a_20240714T102531.tif": {"width": 20}, "b_20240801T102531.tif": {"width": 40, "east_m": 1000.0}},
            "--imagery: the files of one hour show only a part of the area",
        ),
        ({"a_20230714.tif": {}, "b_20240714.tif": {}}, "the files show one day of the year at several times"),
        ({"a.tif": {"tags": {"ACQUISITIONDATETIME": "noon"}}}, "not a time in its metadata ACQUISITIONDATETIME"),
    ],
)
def test_files_without_one_sun_are_refused_in_a_line(own, tmp_path, files, line):
    for name, options in files.items():
        picture(tmp_path / "images" / name, **options)
    with pytest.raises(InputError) as caught:
        own()
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)
    assert {path.name for path in tmp_path.iterdir()} == {"dem.tif", "images"}


def lidar_tile(path: Path, level: float = 900.0) -> Path:
    """A kilometre about Chamonix as IGN names and places it: half a pixel beyond the kilometre, without declared nodata."""
    transform = Affine(10.0, 0.0, 999_995.0, 0.0, -10.0, 6_543_005.0)
    path.parent.mkdir(parents=True, exist_ok=True)
    values = level + np.add.outer(np.arange(100.0), np.arange(100.0))
    profile = {"driver": "GTiff", "width": 100, "height": 100, "count": 1, "dtype": "float32", "crs": "EPSG:2154"}
    with rasterio.open(path, "w", **profile, transform=transform) as file:
        file.write(values.astype(np.float32)[None])
    return path


def test_lidar_hd_tiles_bring_datum_and_credit(tmp_path):
    lidar_tile(tmp_path / "tiles" / "LHD_FXX_1000_6543_MNT_O_0M50_LAMB93_IGN69.tif")
    command("fetch", elevation=tmp_path / "tiles" / "*", imagery="none", output=tmp_path / "p.toml")
    scene = declared(tmp_path / "p.toml")
    assert scene["vertical_datum"] == "IGN69"
    assert scene["attribution"] == "© IGN, LiDAR HD"
    with rasterio.open(tmp_path / "p.dem.tif") as file:
        x, y = (float(value) for value in file.xy(file.height // 2, file.width // 2))
        latitude, longitude = geodetic_from_map(file.crs.to_string(), x, y)
        assert abs(float(latitude) - 45.9) < 0.2
        assert abs(float(longitude) - 6.87) < 0.2
    (raster,) = local_rasters(str(tmp_path / "tiles" / "*"), "elevation", flag="--elevation")
    assert raster.year is None


def test_heights_above_ground_are_refused(tmp_path):
    lidar_tile(tmp_path / "LHD_FXX_1000_6543_MNH_O_0M50_LAMB93_IGN69.tif", 10.0)
    with pytest.raises(InputError, match="heights above the ground, not above the sea; choose the tiles MNT"):
        command("fetch", elevation=tmp_path / "LHD_FXX*.tif", imagery="none", output=tmp_path / "p.toml")


def test_heights_that_no_land_has_are_refused(tmp_path):
    path = lidar_tile(tmp_path / "LHD_FXX_1000_6543_MNT_O_0M50_LAMB93_IGN69.tif")
    with rasterio.open(path, "r+") as file:
        values = file.read(1)
        values[:20] = -9999.0
        file.write(values, 1)
    with pytest.raises(InputError, match=r"heights outside the range of land elevations.*declares its nodata value"):
        command("fetch", elevation=path, imagery="none", output=tmp_path / "p.toml")


@pytest.fixture(autouse=True)
def _quick(monkeypatch):
    monkeypatch.setattr(remote, "FIRST_WAIT_S", 0.02)
