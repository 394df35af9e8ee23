"""Places from open data: right heights and colours whatever the catalogue's traps, and one line where it fails.

A catalogue and its files stand on loopback, in a process of their own, shaped as the real ones are (`open_data_world`).
Several places on Earth hold one trap each. No test leaves the machine, but the one marked `network`.
"""

from __future__ import annotations

import json
import os
import re
import shutil
import socket
import tomllib
from datetime import datetime
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import rasterio
from affine import Affine
from command_line import command
from open_data_world import World, height_m, reflectance, swisstopo_tiles
from places import hill_heights, write_raster
from pvlib.solarposition import get_solarposition

import seasonscapes as ss
from seasonscapes.errors import InputError
from seasonscapes.images import linear_from_srgb
from seasonscapes.open_data import remote
from seasonscapes.open_data.catalogue import Item
from seasonscapes.open_data.elevation import tiles_of
from seasonscapes.open_data.requests_as_text import parse_extent, parse_interval
from seasonscapes.open_data.sources import read_source
from seasonscapes.terrain.crs import geodetic_from_map, map_from_geodetic
from seasonscapes.terrain.raster import sample_raster
from seasonscapes.terrain.surface import Raster
from seasonscapes.terrain.synthetic import CRS, alpine_albedo, alpine_massif

ALPS = (46.55, 7.999)  # the border between two tiles runs through it
ZONES = (46.5, 5.999)  # on both sides of the border of two UTM zones
DATE_LINE = (-16.8, 179.999)
COAST = (10.0, 20.075)  # no tile east of 20.075° E
WITHHELD = (40.1, 45.0)  # GLO-30 has no tile, GLO-90 has
VOIDS = (30.0, 80.0)
LIAR = (20.0, 100.0)  # an item states twice the land that its file shows
SNOW = (46.0, 12.0)
BERN = (46.9555, 7.4452)  # the middle of kilometre 2600-1200 of the Swiss grid
WRONG = (50.0, 20.0)  # items that state an offset which was applied before
RANGE = "2024-07..2024-09"


def sky(where):
    """SCL of a day over SNOW: cloud where it is, a bright patch that is taken for cloud on every day, snow in the east."""

    def classes(latitude, longitude):
        north, east = latitude - SNOW[0], longitude - SNOW[1]
        kind = np.where(east > 0.004, 11, 4)
        kind = np.where((np.abs(north + 0.009) < 0.003) & (np.abs(east - 0.009) < 0.004), 8, kind)
        return np.where(where(north, east), 9, kind)

    return classes


DAYS_OVER_SNOW = {
    "2024-07-14T10:15:31Z": sky(lambda north, east: (np.abs(north) < 0.006) & (np.abs(east + 0.006) < 0.006)),
    "2024-07-19T10:15:31Z": sky(lambda north, east: north > 0.0065),
    "2024-07-24T10:15:31Z": sky(lambda north, east: north > 0.0075),
}


def snowy(latitude, longitude):
    snow = (longitude > SNOW[1] + 0.004)[..., None]
    return np.where(snow, 0.7, reflectance(latitude, longitude))


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    world = World(tmp_path_factory.mktemp("open_data") / "world")
    for west in (7.85, 8.0):
        world.dem_tile(west, 46.475)
    for when, options in (
        ("2024-07-14T10:25:31Z", {}),
        ("2018-07-14T10:25:31Z", {"baseline": "02.08"}),
        ("2022-07-14T10:25:31Z", {"baseline": "04.00", "declared": False}),
        ("2019-07-14T10:25:31Z", {"baseline": "02.13", "declared": False}),
    ):
        world.sentinel_tile(when, "EPSG:32632", *ALPS, size_m=5000.0, **options)

    world.dem_tile(5.925, 46.425)
    world.sentinel_tile("2024-07-14T10:25:31Z", "EPSG:32631", ZONES[0], ZONES[1] - 0.02, size_m=4500.0)
    world.sentinel_tile("2024-07-14T10:25:45Z", "EPSG:32632", ZONES[0], ZONES[1] + 0.02, size_m=4500.0)

    world.dem_tile(179.85, -16.875)
    world.dem_tile(-180.0, -16.875)
    world.sentinel_tile("2024-07-14T22:19:36Z", "EPSG:32760", *DATE_LINE, size_m=5000.0)

    world.dem_tile(19.925, 9.925)
    world.dem_tile(44.85, 39.9, size_deg=0.3, samples_per_deg=1200, collection="cop-dem-glo-90")
    world.dem_tile(79.925, 29.925, void=lambda lat, lon: np.hypot(lat - VOIDS[0], lon - VOIDS[1]) < 0.004)
    world.dem_tile(79.85, 29.85, size_deg=0.3, samples_per_deg=1200, collection="cop-dem-glo-90")
    liar = world.dem_tile(99.85, 19.925, size_deg=0.15)
    stated = world.folder / "items" / "cop-dem-glo-30" / f"{liar.stem}.json"
    item = json.loads(stated.read_text())
    item["bbox"][2] += 0.15
    stated.write_text(json.dumps(item))

    world.dem_tile(11.925, 45.925)
    for when, classes in DAYS_OVER_SNOW.items():
        world.sentinel_tile(when, "EPSG:32633", *SNOW, size_m=4000.0, classes=classes, colours=snowy)

    swisstopo_tiles(world, east_km=2600, north_km=1200)

    world.dem_tile(19.925, 49.925)
    world.sentinel_tile("2024-07-14T09:50:31Z", "EPSG:32634", *WRONG, size_m=4000.0, stored_offset=False)
    yield world
    world.stop()


@pytest.fixture(scope="module")
def url(world):
    return world.start()


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    """A cache that the tests share; those of the cache itself have their own."""
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def fetch(url, cache, world, tmp_path, monkeypatch):
    monkeypatch.setattr(remote, "FIRST_WAIT_S", 0.02)
    world.faults()
    world.requests()

    def run(place, **flags) -> Path:
        output = flags.pop("output", tmp_path / "place.toml")
        undated = flags.get("imagery") in ("none", "swissimage")
        flags = {"stac": url, "size": "3km", "date": None if undated else RANGE, "workspace": cache} | flags
        # A blank before a negative number is a blank like any other.
        command("fetch", at=",".join(map(str, place)), output=output, **flags)
        return output

    return run


def raster(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Values ``(H, W, C)`` with NaN, latitude and longitude of the pixels' centres."""
    with rasterio.open(path) as file:
        values = np.ma.filled(file.read(masked=True).astype(float), np.nan).transpose(1, 2, 0)
        u, v = np.meshgrid(np.arange(file.width) + 0.5, np.arange(file.height) + 0.5)
        latitude, longitude = geodetic_from_map(file.crs.to_string(), *(file.transform * (u, v)))
    return values, latitude, longitude


def height_error(scene: Path) -> np.ndarray:
    values, latitude, longitude = raster(scene.with_name(f"{scene.stem}.dem.tif"))
    return np.abs(values[..., 0] - height_m(latitude, longitude))


def colour_error(scene: Path, colours=reflectance) -> np.ndarray:
    values, latitude, longitude = raster(scene.with_name(f"{scene.stem}.ortho.tif"))
    return np.abs(values / 1e4 - colours(latitude, longitude)).max(axis=2)


def sources(scene: Path) -> dict:
    return json.loads(scene.with_name(f"{scene.stem}.sources.json").read_text())


# ---------------------------------------------------------------------------------------------- right by construction


def test_a_place_appears_from_its_coordinates(fetch, url):
    """Heights across the border of two tiles to 0.3 m: pixel is point, or slopes of 30° would be off by 8 m."""
    scene = fetch(ALPS)
    declared = tomllib.loads(scene.read_text())
    assert declared["vertical_datum"] == "EGM2008"
    assert "WorldDEM-30 © DLR" in declared["attribution"]
    assert "Copernicus Sentinel data 2024" in declared["attribution"]
    assert [camera["name"] for camera in declared["camera"]] == ["summit", "valley", "air"]
    assert height_error(scene).max() < 0.3
    assert colour_error(scene).max() < 2e-3
    told = sources(scene)
    assert declared["imagery"]["time"] == told["imagery"][0]["time"] == "2024-07-14T10:25:31Z"
    sun = get_solarposition(pd.DatetimeIndex(["2024-07-14T10:25:31Z"]), *ALPS)
    assert told["imagery"][0]["sun"]["azimuth_deg"] == pytest.approx(float(sun["azimuth"].iloc[0]), abs=0.1)
    assert told["imagery"][0]["sun"]["elevation_deg"] == pytest.approx(
        float(sun["apparent_elevation"].iloc[0]), abs=0.1
    )
    assert told["imagery"][0]["sun"]["stated_azimuth_deg"] == 160.0
    assert {item["address"].startswith(url) for item in told["elevation"]["items"]} == {True}
    assert len(told["elevation"]["items"]) == 2
    assert all(item["etag"] for item in told["imagery"][0]["items"])


@pytest.mark.parametrize("year", [2018, 2019, 2022])
def test_the_offset_is_that_of_the_baseline(fetch, year):
    """Baselines before 04.00 have none, later ones have it whether the item says so or not."""
    scene = fetch(ALPS, date=str(year), size="2km")
    assert colour_error(scene).max() < 2e-3


def test_two_utm_zones_join_without_a_seam(fetch):
    scene = fetch(ZONES)
    assert height_error(scene).max() < 0.3
    assert colour_error(scene).max() < 3e-3
    assert len({item["id"] for item in sources(scene)["imagery"][0]["items"]}) == 2


def test_the_antimeridian_is_a_place_like_any_other(fetch):
    scene = fetch(DATE_LINE)
    assert height_error(scene).max() < 0.3
    assert colour_error(scene).max() < 2e-3
    assert len(sources(scene)["elevation"]["items"]) == 2


def test_sea_without_tiles_is_at_zero(fetch):
    scene = fetch(COAST, imagery="none")
    values, _, longitude = raster(scene.with_name("place.dem.tif"))
    east = longitude > COAST[1] + 0.001
    assert east.mean() == pytest.approx(0.45, abs=0.1)
    assert (values[..., 0][east] == 0.0).all()
    assert height_error(scene)[longitude < COAST[1] - 0.001].max() < 0.3
    assert sources(scene)["elevation"]["shares"]["sea"] == pytest.approx(east.mean(), abs=0.05)


def test_withheld_tiles_come_from_the_coarser_product_and_it_is_told(fetch):
    scene = fetch(WITHHELD, imagery="none")
    assert height_error(scene).max() < 3.0
    told = sources(scene)["elevation"]
    assert told["shares"] == {"cop-dem-glo-90": 1.0}
    assert "WorldDEM-90" in tomllib.loads(scene.read_text())["attribution"]


def test_the_finest_items_of_a_collection_count():
    """3DEP has items of 10 m and, partly with a later date, of 30 m above each other in one collection."""
    declared = read_source("3dep")
    items = [
        Item(
            name,
            (-106.0, 40.0, -105.0, 41.0),
            datetime.fromisoformat(day),
            {"gsd": gsd},
            {"data": {"href": "https://a/b"}},
        )
        for name, day, gsd in (
            ("n41w106-1", "2021-01-01T00:00:00+00:00", 30),
            ("n41w106-13", "2019-01-01T00:00:00+00:00", 10),
            ("n41w106-13b", "2020-01-01T00:00:00+00:00", 10),
        )
    ]
    tiles = tiles_of(items, "3dep", declared, finest_m=10.0)
    assert [tile.item.id for tile in tiles] == ["n41w106-13b", "n41w106-13", "n41w106-1"]


def test_voids_are_filled_from_the_coarser_product(fetch):
    scene = fetch(VOIDS, imagery="none")
    assert height_error(scene).max() < 3.0
    shares = sources(scene)["elevation"]["shares"]
    assert 0.02 < shares["cop-dem-glo-90"] < 0.2
    assert sum(shares.values()) == pytest.approx(1.0)


def test_a_cloud_over_snow_is_filled_and_snow_taken_for_cloud_is_kept(fetch):
    """The clearest day lights the image; what its cloud hides is of the next days, and told with its share."""
    scene = fetch(SNOW)
    assert colour_error(scene, snowy).max() < 0.01
    told = sources(scene)["imagery"][0]
    assert told["time"] == "2024-07-14T10:15:31Z"
    assert told["report"]["known_share"] == 1.0
    assert 0.13 < told["report"]["filled_from"][0]["share"] < 0.22
    assert told["report"]["snow_share"] > 0.3


def test_a_median_has_no_time(fetch):
    scene = fetch(SNOW, composite="median")
    told = sources(scene)["imagery"][0]
    assert told["time"] is None
    assert len(told["report"]["times"]) == 3
    assert "time" not in tomllib.loads(scene.read_text())["imagery"]


def test_an_offset_that_was_applied_before_is_noticed(fetch):
    with pytest.raises(InputError, match="no image make sense as reflectance"):
        fetch(WRONG)


def test_swiss_tiles_are_the_newest_of_the_spacing_that_is_needed(fetch, url):
    """Only files of 2 m are there, and the tile of 2019 is 50 m too high; the catalogue does not say that it searches."""
    flags = {"elevation": "swissalti3d", "imagery": "swissimage", "size": "1.6km", "resolution": 2}
    scene = fetch(BERN, stac=url + "swisstopo/", **flags)
    assert height_error(scene).max() < 0.05
    declared = tomllib.loads(scene.read_text())
    assert declared["vertical_datum"] == "LN02"
    assert declared["attribution"] == "© swisstopo"
    assert declared["imagery"]["encoding"] == "srgb"
    values, latitude, longitude = raster(scene.with_name("place.ortho.tif"))
    assert (values[..., 3] == 255).all()
    shown = linear_from_srgb(values[..., :3] / 255.0)
    assert np.abs(shown - 2.0 * reflectance(latitude, longitude)).max() < 0.01
    told = sources(scene)["imagery"][0]
    assert told["time"] is None
    assert told["report"]["years"] == [2023]
    assert len(sources(scene)["elevation"]["items"]) == 9
    assert any(item["checksum_verified"] for item in sources(scene)["elevation"]["items"])


def test_a_folder_of_tiles_is_a_place_too(world, tmp_path):
    """No network, no coordinates: extent, datum and credit come from the files."""
    files = world.folder / "files"
    scene = tmp_path / "bern.toml"
    flags = {"elevation": files / "ch.swisstopo.swissalti3d" / "*_2023_*.tif", "resolution": 4}
    command("fetch", imagery=files / "ch.swisstopo.swissimage-dop10" / "*.tif", output=scene, **flags)
    values, _, _ = raster(scene.with_name("bern.dem.tif"))
    assert 740 <= values.shape[0] <= 780
    assert np.nanmax(height_error(scene)) < 0.2
    assert np.isfinite(values).mean() > 0.97
    declared = tomllib.loads(scene.read_text())
    assert declared["vertical_datum"] == "LN02"
    assert declared["attribution"] == "© swisstopo"
    told = sources(scene)
    assert "address" not in told["elevation"]["items"][0]
    assert str(files) not in json.dumps(told)
    assert told["imagery"][0]["report"]["years"] == [2023]


def test_heights_in_feet_become_metres(tmp_path):
    values = hill_heights() / 0.3048
    path = write_raster(tmp_path / "feet.tif", values, spacing_m=50.0)
    with rasterio.open(path, "r+") as file:
        file.units = ["ft"]
    command("fetch", elevation=path, imagery="none", output=tmp_path / "hill.toml")
    shown, _, _ = raster(tmp_path / "hill.dem.tif")
    assert np.nanmax(shown) == pytest.approx(1500.0, abs=10.0)


def test_tokens_that_are_freely_given_are_added_to_addresses(world, url, tmp_path):
    (world.folder / "files" / "token").write_text('{"token": "sig=abc"}')
    path = next((world.folder / "files" / "cop-dem-glo-90").glob("*.tif"))
    address = f"{url}files/cop-dem-glo-90/{path.name}"
    world.requests()
    store = remote.RemoteStore(tmp_path)
    assert store.read(address, lambda dataset: dataset.count, token_url=f"{url}files/token") == 1
    asked = world.requests()
    assert asked[0].startswith("GET /files/token")
    assert all("?sig=abc" in line for line in asked[1:])


# ---------------------------------------------------------------------------------------------- networks


def test_plan_loads_nothing(fetch, world, tmp_path, capsys):
    fetch(ALPS, plan=True, json=True)
    told = json.loads(capsys.readouterr().out)
    assert len(told["elevation"]["items"]) == 2
    assert told["imagery"][0]["days"][0]["time"] == "2024-07-14T10:25:31Z"
    assert told["elevation"]["about_bytes"] > 1000
    assert "WorldDEM-30" in told["elevation"]["licences"][0]["attribution"]
    assert not [line for line in world.requests() if "/files/" in line]
    assert not list(tmp_path.iterdir())


def test_what_is_cached_is_not_asked_again_and_serves_offline(fetch, world, tmp_path):
    scene = fetch(ALPS, workspace=tmp_path / "cache")
    first = {path.name: path.read_bytes() for path in tmp_path.glob("place.*.tif")}
    assert world.requests()
    fetch(ALPS, workspace=tmp_path / "cache")
    fetch(ALPS, workspace=tmp_path / "cache", offline=True)
    assert world.requests() == []
    assert {path.name: path.read_bytes() for path in tmp_path.glob("place.*.tif")} == first
    assert scene.is_file()
    with pytest.raises(InputError, match="not asked about this area before; leave out --offline once"):
        fetch((46.56, 7.99), workspace=tmp_path / "cache", offline=True)


def test_bad_networks_are_survived(fetch, world, tmp_path):
    """Busy servers, cut answers and cut files: asked again, same result."""
    world.faults(
        ("/search", 502, 2), ("/search", "cut", 1), ("DEM.tif", 503, 2), ("B04", "cut", 2), ("SCL", "whole", 1)
    )
    scene = fetch(ALPS, workspace=tmp_path / "cache")
    assert height_error(scene).max() < 0.3
    assert colour_error(scene).max() < 2e-3


@pytest.mark.parametrize(
    ("part", "what", "line"),
    [
        ("/search", "cut", "the catalogue does not answer"),
        (
            "DEM.tif",
            "cut",
            "no connection, or it broke (ChunkedEncodingError), 5 times; run the same command again later",
        ),
        ("SCL", 502, "the server answers 502 Bad Gateway, 5 times; run the same command again later"),
        ("B04", 500, "the server answers 500 Internal Server Error, 5 times"),
        ("B04", 401, "the server answers 401 Unauthorized; choose another source"),
    ],
)
def test_what_stays_broken_is_told(fetch, world, tmp_path, part, what, line):
    world.faults((part, what, 99))
    assert line in failure(fetch, ALPS, tmp_path)


def test_a_machine_without_network_is_told(fetch, tmp_path, monkeypatch):
    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    line = failure(fetch, ALPS, tmp_path, stac="http://catalogue.invalid/")
    assert "the catalogue does not answer (its name is unknown here: is there a network?); try again later" in line


def test_a_catalogue_that_stays_busy_is_told(fetch, world, tmp_path):
    world.faults(("/search", 503, 99))
    line = failure(fetch, ALPS, tmp_path)
    assert "the catalogue does not answer (too many 503 error responses); try again later" in line


def test_an_interrupted_download_resumes(fetch, world, tmp_path):
    world.faults(("B02", 503, 99))
    with pytest.raises(InputError, match=r"503 .*, 5 times; run the same command again later: what is loaded is kept"):
        fetch(ALPS, workspace=tmp_path / "cache")
    assert [path.name for path in tmp_path.iterdir()] == ["cache"]
    world.faults()
    loaded = {line for line in world.requests() if "B02" not in line}
    assert colour_error(fetch(ALPS, workspace=tmp_path / "cache")).max() < 2e-3
    assert not loaded & set(world.requests())


def test_an_expired_cache_asks_again_and_a_changed_file_is_loaded_anew(fetch, world, tmp_path, caplog):
    cache = tmp_path / "cache"
    scene = fetch(ALPS, imagery="none", workspace=cache)
    for state in (cache / "open_data").rglob("state.json"):
        state.write_text(state.read_text().replace('"asked": "20', '"asked": "19'))
    for search in (cache / "open_data" / "searches").iterdir():
        search.write_text(search.read_text().replace('"asked": "20', '"asked": "19'))
    changed = next((world.folder / "files" / "cop-dem-glo-30").glob("*+46.48_+8.00*"))
    before = changed.read_bytes()
    world.requests()
    try:
        world.dem_tile(8.0, 46.475, heights=lambda lat, lon: height_m(lat, lon) + 100.0)
        fetch(ALPS, imagery="none", workspace=cache)
        values, latitude, longitude = raster(scene.with_name("place.dem.tif"))
        east = longitude > 8.001
        assert np.abs(values[..., 0] - height_m(latitude, longitude) - 100.0)[east].max() < 0.3
    finally:
        changed.write_bytes(before)
    assert any("/search" in line for line in world.requests())


def test_a_silent_catalogue_is_replaced_by_its_last_answer(fetch, world, tmp_path, caplog):
    cache = tmp_path / "cache"
    fetch(ALPS, imagery="none", workspace=cache)
    for search in (cache / "open_data" / "searches").iterdir():
        search.write_text(search.read_text().replace('"asked": "20', '"asked": "19'))
    world.faults(("/search", 503, 99))
    fetch(ALPS, imagery="none", workspace=cache)
    assert "its answer of 19" in caplog.text


def test_damage_in_the_cache_is_loaded_again(fetch, tmp_path):
    cache = tmp_path / "cache"
    fetch(ALPS, imagery="none", workspace=cache)
    for blocks in (cache / "open_data").rglob("*.blocks"):
        content = bytearray(blocks.read_bytes())
        content[1000:1010] = b"x" * 10
        blocks.write_bytes(bytes(content))
    for index in list((cache / "open_data").rglob("*.index.npy"))[:1]:
        index.write_bytes(b"no index")
    assert height_error(fetch(ALPS, imagery="none", workspace=cache)).max() < 0.3


# ---------------------------------------------------------------------------------------------- failures


def failure(fetch, place, tmp_path: Path, **flags) -> str:
    """The one line of a failure; nothing is left beside the cache."""
    with pytest.raises(InputError) as caught:
        fetch(place, workspace=tmp_path / "cache", **flags)
    assert [path.name for path in tmp_path.iterdir() if path.name != "cache"] == []
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_a_catalogue_that_lies_about_its_extent_is_told(fetch, tmp_path):
    line = failure(fetch, LIAR, tmp_path, imagery="none")
    assert re.search(
        "a part of the area has no heights, though the catalogue states that it covers it; got '5[01] %'", line
    )


def test_a_truncated_file_is_told(fetch, world, tmp_path):
    path = next((world.folder / "files" / "cop-dem-glo-30").glob("*+45.92_+11.93*"))
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    try:
        line = failure(fetch, SNOW, tmp_path, imagery="none")
    finally:
        path.write_bytes(whole)
    assert path.name in line
    assert "damaged, cut short or no GeoTIFF" in line


def test_a_file_of_another_checksum_is_told(fetch, world, tmp_path):
    stated = world.folder / "items" / "ch.swisstopo.swissalti3d" / "swissalti3d_2023_2600-1200.json"
    right = stated.read_text()
    stated.write_text(right.replace('"1220', '"1220ff'))
    try:
        line = failure(fetch, BERN, tmp_path, elevation="swissalti3d", imagery="none", size="1.6km", resolution=2)
    finally:
        stated.write_text(right)
    assert "not the file whose checksum the catalogue states" in line


def test_a_missing_file_is_told(fetch, world, tmp_path):
    world.faults(("B03", 404, 99))
    line = failure(fetch, ALPS, tmp_path)
    assert "B03.tif: the server answers 404" in line
    assert "choose another --date or source" in line


def test_a_missing_tile_is_replaced_by_the_coarser_product(fetch, world, tmp_path):
    world.faults(("cop-dem-glo-30/", 404, 99))
    scene = fetch(VOIDS, imagery="none", workspace=tmp_path / "cache")
    assert sources(scene)["elevation"]["shares"] == {"cop-dem-glo-90": 1.0}
    assert len(sources(scene)["elevation"]["missing_items"]) == 1


@pytest.mark.parametrize(
    ("place", "flags", "line"),
    [
        ((0.0, -150.0), {"imagery": "none"}, "is the place on land"),
        (ALPS, {"date": "2011"}, "no image in this time with so few clouds"),
        (ALPS, {"stac": "file:///etc"}, "--stac: not an address"),
        (ALPS, {"stac": "http://127.0.0.1:9/"}, "the catalogue does not answer (no connection)"),
        (
            ALPS,
            {"stac": "http://catalogue.invalid/"},
            "does not answer (its name is unknown here: is there a network?)",
        ),
        (ALPS, {"elevation": "srtm"}, "--elevation: unknown source of elevation; got 'srtm'; expected one of"),
        (ALPS, {"elevation": "sentinel-2"}, "unknown source of elevation"),
        (ALPS, {"imagery": "nothing/*.tif", "date": None}, "--imagery: no such file"),
        ((10.0, 10.0), {"elevation": "swissalti3d"}, "swissALTI3D has nothing here"),
        (ALPS, {"size": "20"}, "--size: not an extent"),
        (ALPS, {"size": "2000km"}, "--size: out of range"),
        ((*ALPS, 1200), {}, "--at: the centre of an area has no height"),
        (ALPS, {"composite": "mean"}, "--composite: unknown composite"),
        (ALPS, {"cloud": 120}, "--cloud: out of range"),
        (ALPS, {"date": "2024-13"}, "--date: not a time"),
        (ALPS, {"imagery": "none", "date": "2024"}, "--date: with files of one's own, or without imagery"),
        (ALPS, {"imagery": "none", "cloud": 5}, "--cloud: with files of one's own, or without imagery"),
        (BERN, {"imagery": "swissimage", "composite": "median"}, "--composite: swissimage has one image"),
        (BERN, {"imagery": "swissimage", "date": ["2023", "2019"]}, "--date: swissimage tells the year alone"),
        (BERN, {"imagery": "swissimage", "date": "2011"}, "the catalogue has no image here; choose another --date"),
        (ALPS, {"elevation": "lidar-hd"}, "--elevation: LiDAR HD has no catalogue that can be asked"),
    ],
)
def test_mistakes_are_one_line(fetch, tmp_path, place, flags, line):
    assert line in failure(fetch, place, tmp_path, **flags)


def test_an_edited_scene_is_not_overwritten(fetch):
    scene = fetch(COAST, imagery="none")
    fetch(COAST, imagery="none")
    scene.write_text(scene.read_text() + "# mine\n")
    with pytest.raises(InputError, match="exists, and is not as fetch wrote it"):
        fetch(COAST, imagery="none")


def test_intervals_and_extents():
    assert parse_interval("2024-07..2024-09") == "2024-07-01T00:00:00Z/2024-09-30T23:59:59Z"
    assert parse_interval("2024-02") == "2024-02-01T00:00:00Z/2024-02-29T23:59:59Z"
    assert parse_interval("2024-02-03") == "2024-02-03T00:00:00Z/2024-02-03T23:59:59Z"
    assert parse_extent("30x20km") == (30_000.0, 20_000.0)
    assert parse_extent("800 m") == (800.0, 800.0)


@pytest.mark.network
@pytest.mark.skipif("SEASONSCAPES_NETWORK" not in os.environ, reason="asks real catalogues")
def test_the_real_catalogues_answer(tmp_path):
    command("fetch", at="46.62,8.03", size="3km", date="2024-07..2024-09", output=tmp_path / "grindelwald.toml")
    swiss = {"elevation": "swissalti3d", "imagery": "swissimage", "resolution": 2}
    command("fetch", at="46.62,8.03", size="2km", output=tmp_path / "swiss.toml", **swiss)
    assert sources(tmp_path / "swiss.toml")["elevation"]["shares"]["swissalti3d"] > 0.99
    assert sources(tmp_path / "grindelwald.toml")["imagery"][0]["report"]["known_share"] > 0.9


# ---------------------------------------------------------------------------------------------- a picture


def psnr_db(first: np.ndarray, second: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.mean((first - second) ** 2)))


@pytest.mark.slow
def test_the_fetched_scene_renders_as_one_made_by_hand(world, url, tmp_path):
    """Tiles of the catalogues → fetch → picture, against the same samples as files of a scene → picture: within 0.5 dB.

    Both are compared to the synthetic scene itself, whose heights stand every 15 m, from the same camera.
    """
    massif = alpine_massif(size_m=6000.0, spacing_m=15.0)
    colour = Raster(alpine_albedo(massif, 196.0, upsample=2), massif.elevation.transform * Affine.scale(0.5), CRS)
    # The catalogue's heights are means over 30 m.
    z = massif.elevation.values[..., 0]
    means = (z[:-1, :-1] + z[1:, :-1] + z[:-1, 1:] + z[1:, 1:])[..., None] / 4.0
    fine = Raster(means, massif.elevation.transform * Affine.translation(0.5, 0.5), CRS)

    def of(raster: Raster):
        def at(latitude, longitude):
            x, y = map_from_geodetic(CRS, latitude, longitude)
            height, width = raster.values.shape[:2]
            column, row = ~raster.transform * (x, y)
            inside = np.clip(column, 0.5, width - 0.5), np.clip(row, 0.5, height - 0.5)
            return sample_raster(raster, *(raster.transform * inside))

        return at

    def heights(latitude, longitude):
        return of(fine)(latitude, longitude)[..., 0]

    local = World(tmp_path / "massif")
    tile = local.dem_tile(7.92, 46.49, size_deg=0.12, heights=heights)
    local.sentinel_tile("2024-07-14T10:25:31Z", CRS, 46.55, 7.98, size_m=6400.0, colours=of(colour))
    address = local.start()
    try:
        fetched = tmp_path / "fetched.toml"
        flags = {"at": "46.55,7.98", "size": "6km", "date": "2024-07", "workspace": tmp_path / "cache"}
        command("fetch", stac=address, output=fetched, **flags)
    finally:
        local.stop()
    by_hand = tmp_path / "by_hand.toml"
    shutil.copy(tile, tmp_path / "dem.tif")
    west, north = (np.round(value / 10.0) * 10.0 for value in (colour.transform.c, colour.transform.f))
    ten_metres = Affine(10.0, 0.0, west, 0.0, -10.0, north)
    x, y = ten_metres * np.meshgrid(np.arange(602) + 0.5, np.arange(602) + 0.5)
    write_tiff(tmp_path / "ortho.tif", Raster(of(colour)(*geodetic_from_map(CRS, x, y)), ten_metres, CRS))
    camera = CAMERA.format(height_m=float(massif.elevation.values.max()) + 300.0)
    by_hand.write_text(BY_HAND + camera)
    text = fetched.read_text()
    # The light stays in for the comparison: the painted image has none.
    text = "\n".join(line for line in text.splitlines() if not line.startswith("time ="))
    fetched.write_text(text.split("[[camera]]")[0] + camera)
    synthetic = tmp_path / "synthetic.toml"
    synthetic.write_text(SYNTHETIC + camera)
    pictures = []
    for scene in (synthetic, by_hand, fetched):
        place = ss.load_place(scene, ss.Workspace(tmp_path / "workspace"))
        view = ss.render(place, ss.camera(place, "air", size_px=(96, 64)), "2024-07-14T10:25:31Z", sky="hosek", spp=16)
        pictures.append(np.clip(view.radiance / 20_000.0, 0.0, 1.0))
    direct, through = psnr_db(pictures[1], pictures[0]), psnr_db(pictures[2], pictures[0])
    print(f"by hand {direct:.2f} dB, fetched {through:.2f} dB, one against the other {psnr_db(*pictures[1:]):.2f} dB")
    assert through > direct - 0.5


def write_tiff(path: Path, values: Raster) -> None:
    bands = values.values.transpose(2, 0, 1).astype(np.float32)
    profile = {"driver": "GTiff", "count": len(bands), "height": bands.shape[1], "width": bands.shape[2]}
    with rasterio.open(path, "w", **profile, dtype="float32", crs=values.crs, transform=values.transform) as file:
        file.write(bands)


SYNTHETIC = """name = "synthetic"
[elevation.synthetic]
size_m = 6000.0
spacing_m = 15.0
detail_m = 7.5
"""
BY_HAND = """name = "by_hand"
[area]
west_deg = 7.9414
south_deg = 46.5233
east_deg = 8.0186
north_deg = 46.5767
[elevation]
file = "dem.tif"
[imagery]
file = "ortho.tif"
encoding = "linear"
full_scale = 1.0
reflectance_scale = 1.0
"""
CAMERA = """
[[camera]]
name = "air"
latitude_deg = 46.565
longitude_deg = 7.965
height_m = {height_m}
heading_deg = 145.0
pitch_deg = -38.0
fov_deg = 50.0
"""
