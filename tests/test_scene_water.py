"""Where the water of a scene lies: drawn, given as a raster, or found; and that it is level."""

import json
from dataclasses import replace

import numpy as np
import places
import pytest
from terrain_cases import hill_lv95

from seasonscapes.errors import InputError
from seasonscapes.scene import read_scene
from seasonscapes.terrain.crs import geodetic_from_map
from seasonscapes.terrain.raster_files import OWN_FOLDER
from seasonscapes.terrain.surface import Raster, load_terrain, save_terrain
from seasonscapes.terrain.synthetic import alpine_albedo, alpine_massif
from seasonscapes.terrain.water import find_water, levelled, polygon_water, raster_water
from seasonscapes.workflows.place import load_place
from seasonscapes.workspace import Workspace


@pytest.fixture(scope="module")
def massif():
    return alpine_massif(seed=1912, size_m=12000.0, spacing_m=60.0)


def test_the_lake_of_the_massif_is_found(massif):
    """By relief and image, against the shore that the massif knows: nine tenths of the lake, and hardly anything else."""
    image = Raster(alpine_albedo(massif, 205), massif.elevation.transform, massif.elevation.crs)
    found = find_water(massif.elevation, image, least_area_m2=50_000.0).values[..., 0] > 0.5
    lake = massif.shore_m < 0.0
    assert (found & lake).sum() > 0.9 * lake.sum()
    assert (found & (massif.shore_m > 60.0)).sum() < 0.05 * lake.sum()
    # A meadow as level as a lake is none.
    green = np.where(lake[..., None], [0.05, 0.12, 0.03], image.values).astype(np.float32)
    assert not find_water(massif.elevation, replace(image, values=green), least_area_m2=50_000.0).values.any()


def ring_of(raster, rows, columns):
    """Corners of a rectangle of cells in WGS 84, closed."""
    corners = [(columns[0], rows[0]), (columns[1], rows[0]), (columns[1], rows[1]), (columns[0], rows[1])]
    x, y = np.array([raster.transform * corner for corner in [*corners, corners[0]]]).T
    latitude, longitude = geodetic_from_map(raster.crs, x, y)
    return np.stack([longitude, latitude], axis=1).tolist()


def write_polygons(path, rings):
    features = [
        {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [r]}} for r in rings
    ]
    path.write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    return path


def test_polygons_are_drawn_to_a_fraction_of_a_cell(tmp_path):
    raster = hill_lv95()
    path = write_polygons(tmp_path / "lakes.geojson", [ring_of(raster, (10, 20.5), (30, 50))])
    drawn = polygon_water(path, raster).values[..., 0]
    assert drawn[10:20, 30:50].min() == 1.0
    assert drawn.sum() == pytest.approx(10.5 * 20.0, rel=0.01)
    np.testing.assert_allclose(drawn[20, 31:49], 0.5)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{}", "not GeoJSON of polygons"),
        ('{"type": "FeatureCollection"}', "not GeoJSON of polygons"),
        ('{"type": "Point", "coordinates": [8.0, 46.0]}', "Polygon or MultiPolygon"),
        ('{"type": "Polygon", "coordinates": [[[8.0, 46.0], [8.1, 46.0], [8.0, 46.1]]]}', "fewer than four corners"),
        ('{"type": "Polygon", "coordinates": [["a", "b", "c", "d"]]}', "no pairs"),
        ('{"type": "Polygon", "coordinates": [[[0, 0], [1, 0], [1, 1], [0, 0]]]}', "no polygon of water lies on"),
    ],
)
def test_mistakes_in_polygons_are_told(tmp_path, text, said):
    path = tmp_path / "lakes.geojson"
    path.write_text(text)
    with pytest.raises(InputError, match=said):
        polygon_water(path, hill_lv95(20, 20))


def test_rasters_of_water_are_read_in_their_own_grid(tmp_path):
    raster = Raster(places.hill_heights()[..., None].astype(np.float32), *grid_of_the_hill())
    mask = np.zeros((61, 61))
    mask[5:15, 20:40] = 1.0
    path = places.write_raster(tmp_path / "water.tif", mask, spacing_m=50.0)
    np.testing.assert_array_equal(raster_water(path, raster, OWN_FOLDER).values[..., 0] > 0.5, mask > 0.5)
    dry = places.write_raster(tmp_path / "dry.tif", np.zeros((61, 61)), spacing_m=50.0)
    with pytest.raises(InputError, match="shows no water"):
        raster_water(dry, raster, OWN_FOLDER)


def grid_of_the_hill():
    from affine import Affine

    half = 61 * 50.0 / 2
    return Affine(50.0, 0, places.EAST_M - half, 0, -50.0, places.NORTH_M + half), "EPSG:32632"


def test_lakes_are_level_and_rivers_are_not():
    raster = hill_lv95()
    heights = np.full(raster.values.shape[:2], 500.0, np.float32)
    heights[40:60, 40:60] += np.random.default_rng(1).normal(0.0, 0.3, (20, 20))
    heights[39, 45] = 498.0
    heights[80:84, :] = np.linspace(500.0, 480.0, heights.shape[1])
    water = np.zeros_like(heights)
    water[40:60, 40:60] = water[80:84, :] = 1.0
    raster = replace(raster, values=heights[..., None])
    flat = levelled(raster, replace(raster, values=water[..., None])).values[..., 0]
    assert np.ptp(flat[40:60, 40:60]) == 0.0
    assert flat[50, 50] == pytest.approx(500.0, abs=0.1)
    assert flat[39, 45] == flat[50, 50], "no ditch along the shore"
    np.testing.assert_array_equal(flat[80:84], heights[80:84])


WATER = '\n[water]\nfile = "lakes.geojson"\nwind_m_s = 0.0\n\n[snow]\ngrain_mm = 0.5\n'


def test_a_scene_with_water_and_snow(tmp_path):
    """From the file to the terrain, to its store and back; without the tables nothing changes."""
    path = places.write_place(tmp_path)
    plain = load_place(path, Workspace(tmp_path / "w"))
    assert plain.terrain.water is None
    assert plain.terrain.snow is None
    write_polygons(tmp_path / "lakes.geojson", [ring_of(plain.elevation, (52, 59), (2, 9))])
    path.write_text(places.SCENE + WATER)
    place = load_place(path, Workspace(tmp_path / "w"))
    water = place.terrain.water
    assert water is not None
    assert water.wind_m_s == 0.0
    assert place.key != plain.key
    assert np.ptp(place.elevation.values[52:59, 2:9]) < 1e-3
    # A plan of the place: rows from the north, columns from the west.
    rows, columns = water.mask.shape
    inside = water.mask[round(55.5 / 61 * rows), round(5.5 / 61 * columns)]
    assert inside == 1.0
    assert (water.mask > 0.5).mean() == pytest.approx(7 * 7 / 60.0**2, rel=0.1)
    assert place.terrain.snow is not None
    assert place.terrain.snow.grain_mm == 0.5
    save_terrain(place.terrain, tmp_path / "terrain.npz")
    again = load_terrain(tmp_path / "terrain.npz")[0]
    assert again.water is not None
    np.testing.assert_allclose(again.water.mask, water.mask, atol=0.5 / 255)
    assert again.snow == place.terrain.snow


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ('[water]\nfile = "none.geojson"\n', "no such file"),
        ('[water]\nfile = "../lakes.geojson"\n', "leads outside its folder"),
        ("[water]\nwind_m_s = -1.0\n", "water.wind_m_s"),
        ("[snow]\nscattering = false\ngrain_mm = 1.0\n", "grain_mm"),
    ],
)
def test_mistakes_in_the_tables_are_told(tmp_path, table, said):
    path = places.write_place(tmp_path, places.SCENE + "\n" + table)
    with pytest.raises(InputError, match=said):
        read_scene(path)
