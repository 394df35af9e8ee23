"""Finer heights and images of a part of a place: read, blended at their border, meshed, seen."""

from dataclasses import replace

import numpy as np
import places
import pytest
from affine import Affine

from seasonscapes.errors import InputError
from seasonscapes.frames import geodetic_from_enu
from seasonscapes.terrain.crs import apply_affine, geodetic_from_map, map_from_geodetic
from seasonscapes.terrain.nested_heights import nested_heights
from seasonscapes.terrain.surface import Raster, mesh_up_m
from seasonscapes.workflows import nested_heights as heights_workflow
from seasonscapes.workflows import nested_images
from seasonscapes.workflows.albedo_sources import scene_albedo
from seasonscapes.workflows.place import load_place
from seasonscapes.workflows.views import camera, view_with_terrain
from seasonscapes.workspace import Workspace

CRS = "EPSG:32632"
# Half the side of the finer data [m]; coarse cells have 50 m.
HALF_M = 750.0


def coarse_m(x, y):
    """The hill of the test place, as a function of map coordinates."""
    east, north = x - places.EAST_M, y - places.NORTH_M
    return 1000.0 + 500.0 * np.exp(-(east**2 + (north - 200.0) ** 2) / 600.0**2)


def fine_m(x, y):
    """The same ground with ripples 63 m long that the coarse raster does not show."""
    return coarse_m(x, y) + 2.0 * np.sin(2.0 * np.pi * x / 63.0)


def square(function, spacing_m, *, crs=CRS, half_m=HALF_M):
    """A raster ``(H, W, 1)`` of a function of UTM coordinates about the middle of the test place, in any CRS."""
    latitude, longitude = geodetic_from_map(CRS, places.EAST_M, places.NORTH_M)
    x, y = (float(each) for each in map_from_geodetic(crs, latitude, longitude))
    count = round(2.0 * half_m / spacing_m)
    transform = Affine(spacing_m, 0.0, x - half_m, 0.0, -spacing_m, y + half_m)
    row, column = np.mgrid[0:count, 0:count] + 0.5
    place = map_from_geodetic(CRS, *geodetic_from_map(crs, *apply_affine(transform, column, row)))
    return Raster(function(*place)[..., None].astype(np.float32), transform, crs)


def base():
    transform = Affine(50.0, 0.0, places.EAST_M - 1525.0, 0.0, -50.0, places.NORTH_M + 1525.0)
    return Raster(places.hill_heights()[..., None].astype(np.float32), transform, CRS)


def write(path, raster):
    import rasterio

    height, width, count = raster.values.shape
    profile = {"driver": "GTiff", "height": height, "width": width, "count": count, "dtype": "float32"}
    with rasterio.open(path, "w", crs=raster.crs, transform=raster.transform, nodata=-9999.0, **profile) as file:
        file.write(np.where(np.isnan(raster.values), -9999.0, raster.values).transpose(2, 0, 1))


@pytest.mark.parametrize("crs", [CRS, "EPSG:2056"])
def test_heights_are_the_fine_ones_inside_and_the_coarse_ones_at_the_border(crs):
    fine = square(lambda x, y: fine_m(x, y) + 1.5, 10.0, crs=crs)
    heights, offset = nested_heights(fine, [base()], where="fine.tif")
    assert offset.median_m == pytest.approx(1.5, abs=0.3)
    inside = heights.values[40:110, 40:110]
    np.testing.assert_array_equal(inside, fine.values[40:110, 40:110])
    truth = square(coarse_m, 10.0, crs=crs).values
    rim = np.ones(truth.shape, bool)
    rim[8:-8, 8:-8] = False
    # Cubic interpolation of 50 m cells of a smooth hill.
    assert np.abs(heights.values - truth)[rim].max() < 0.5
    # No wall of 1.5 m anywhere: the added slope is that of the ripples and of 1.5 m over 200 m.
    added = np.abs(np.diff(heights.values[..., 0] - truth[..., 0], axis=1))
    assert added.max() < 10.0 * (2.0 * 2.0 * np.pi / 63.0 + 3.5 * 1.5 / 200.0) + 0.05


def test_holes_are_filled_from_below_without_a_step():
    fine = square(lambda x, y: fine_m(x, y) - 3.0, 10.0)
    fine.values[60:75, 60:75] = np.nan
    heights, _ = nested_heights(fine, [base()], where="fine.tif")
    truth = square(coarse_m, 10.0).values
    assert np.isfinite(heights.values).all()
    np.testing.assert_allclose(heights.values[60:75, 60:75], truth[60:75, 60:75], atol=0.5)
    assert np.abs(np.diff(heights.values[..., 0] - truth[..., 0], axis=0)).max() < 0.5


def test_a_window_of_a_larger_raster_has_no_border_where_it_was_cut():
    fine = square(fine_m, 10.0, half_m=400.0)
    latitude, longitude = geodetic_from_map(CRS, places.EAST_M, places.NORTH_M)
    bounds = longitude - 0.0051, latitude - 0.0035, longitude + 0.0051, latitude + 0.0035
    cut, _ = nested_heights(fine, [base()], bounds_deg=tuple(float(each) for each in bounds), where="fine.tif")
    np.testing.assert_array_equal(cut.values, fine.values)
    whole, _ = nested_heights(fine, [base()], where="fine.tif")
    assert np.abs(whole.values - fine.values).max() > 1.0


@pytest.mark.parametrize(
    ("fine", "words"),
    [
        (square(lambda x, y: fine_m(x, y) + 48.0, 10.0), ("+48.0 m in the median", "offset_m = -48.0")),
        (square(fine_m, 10.0, half_m=250.0), ("too small", "6 cells")),
        (replace(square(fine_m, 10.0), transform=Affine(10, 0, 5e5, 0, -10, 5.2e6)), ("does not overlap",)),
    ],
)
def test_heights_that_do_not_fit_are_refused_in_one_line(fine, words):
    with pytest.raises(InputError) as refused:
        nested_heights(fine, [base()], where="fine.tif")
    assert "\n" not in str(refused.value)
    assert all(word in str(refused.value) for word in ("fine.tif", *words)), str(refused.value)


FINER = places.SCENE.replace(
    'file = "dem.tif"', 'file = "dem.tif"\n[[elevation.finer]]\nfile = "fine.tif"\n{heights}'
).replace(
    "reflectance_scale = 1.0",
    'reflectance_scale = 1.0\ndelit = true\n[[imagery.finer]]\nfile = "fine_image.tif"\nencoding = "linear"\nfull_scale = 1.0',
)


def stripes(x, y):
    """An image twice as bright as the coarse one in stripes of 20 m, and as dark between them."""
    return np.where(np.floor((x - places.EAST_M) / 10.0) % 2 == 0, 0.6, 0.2)


def write_nested(folder, *, heights="", above_m=0.0):
    path = places.write_place(folder, FINER.replace("{heights}", heights))
    write(folder / "fine.tif", square(lambda x, y: fine_m(x, y) + above_m, 2.5))
    image = square(stripes, 2.5, half_m=600.0)
    write(folder / "fine_image.tif", replace(image, values=np.repeat(image.values, 3, axis=2)))
    return path


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("nested")
    return load_place(write_nested(folder), Workspace(folder / "workspace"))


def map_of(place, position):
    latitude, longitude, height = geodetic_from_enu(place.frame, position)
    return *map_from_geodetic(CRS, latitude, longitude), height


def test_the_mesh_follows_the_finer_heights(place):
    (part,) = place.terrain.surface.parts
    rng = np.random.default_rng(5)
    points = np.zeros((40, 3))
    points[:, :2] = rng.uniform(-400.0, 400.0, (40, 2))
    for _ in range(3):
        points[:, 2] = place.terrain.surface.up_at(points)
    x, y, height = map_of(place, points)
    assert np.abs(height - fine_m(x, y)).max() < 0.15, "nodes 2.5 m apart on ripples of 63 m"
    meshed = np.array([mesh_up_m(place.terrain, point) for point in points])
    # The bound holds at the nodes; the mesh of the coarse raster alone would be 2 m off.
    assert np.abs(meshed - points[:, 2]).max() < 2.0 * part.mesh_error_m
    assert part.mesh_error_m < place.terrain.surface.mesh_error_m < 3.0
    far = np.array([[1300.0, 0.0, 0.0]])
    assert place.terrain.surface.spacing_at(far)[0] > 2.0 * place.terrain.surface.spacing_at(points[:1])[0]


def test_terrain_with_parts_is_kept(place, tmp_path):
    from seasonscapes.terrain.surface import load_terrain, save_terrain

    save_terrain(place.terrain, tmp_path / "terrain.npz")
    again, _ = load_terrain(tmp_path / "terrain.npz")
    points = np.stack([np.linspace(-1400.0, 1400.0, 200), np.full(200, 30.0), np.full(200, 1000.0)], axis=1)
    for first, second in zip(again.surface.sample(points), place.terrain.surface.sample(points), strict=True):
        np.testing.assert_array_equal(first, second)


def test_data_finer_than_what_is_kept_are_read_about_the_camera(tmp_path, monkeypatch):
    monkeypatch.setattr(heights_workflow, "_MOST_SAMPLES", 20_000)
    place = load_place(write_nested(tmp_path), Workspace(tmp_path / "workspace"))
    (kept,) = place.finer_heights
    assert kept.values.size <= 20_000
    eye = np.array([40.0, -60.0, 1500.0])
    number, near = heights_workflow.finest_near(place, eye, 150.0, most_samples=5_000_000)
    assert number == 0
    assert near.transform.a == 2.5
    less = heights_workflow.finest_near(place, eye, 150.0, most_samples=3_000)[1]
    assert less.values.size < 2.0 * 3_000 < near.values.size
    view = replace(
        camera(place, "south", size_px=(48, 32)), world_from_camera=np.block([[np.eye(3), eye[:, None]], [0, 0, 0, 1]])
    )
    terrain = view_with_terrain(place, view)[1]
    assert terrain.surface.spacing_at(eye[None])[0] == pytest.approx(2.5, rel=0.01)
    points = eye + np.stack([np.linspace(-60.0, 60.0, 50), np.zeros(50), np.zeros(50)], axis=1)
    for _ in range(3):
        points[:, 2] = terrain.surface.up_at(points)
    x, y, height = map_of(place, points)
    assert np.abs(height - fine_m(x, y)).max() < 0.15
    assert np.abs(place.terrain.surface.up_at(points) - points[:, 2]).max() > 0.3, "what is kept is coarser"


def test_a_camera_may_stand_in_a_hole_of_the_finer_data_and_where_the_ground_has_changed(tmp_path, monkeypatch):
    """What is read about a camera was judged as a whole: a window without data, or 40 m lower, is no mistake."""
    monkeypatch.setattr(heights_workflow, "_MOST_SAMPLES", 20_000)
    path = write_nested(tmp_path)
    raster = square(fine_m, 2.5)
    raster.values[270:330, 270:330] = np.nan
    raster.values[380:, 380:] -= 40.0
    write(tmp_path / "fine.tif", raster)
    place = load_place(path, Workspace(tmp_path / "workspace"))
    for east, north, below_m in ((0.0, 0.0, 0.0), (430.0, -430.0, 40.0)):
        eye = np.array([east, north, 1500.0])
        _, near = heights_workflow.finest_near(place, eye, 60.0, most_samples=5_000_000)
        assert np.isfinite(near.values).all()
        count = near.values.shape[0] // 2
        row, column = np.mgrid[0 : near.values.shape[0], 0 : near.values.shape[1]] + 0.5
        truth = coarse_m(*apply_affine(near.transform, column, row)) - below_m
        middle = (slice(count - 4, count + 4),) * 2
        assert np.abs(near.values[..., 0] - truth)[middle].max() < 3.0


def test_another_vertical_datum_is_doubted_refused_and_stated(tmp_path, caplog):
    path = write_nested(tmp_path, above_m=9.0)
    with caplog.at_level("WARNING"):
        load_place(path, Workspace(tmp_path / "workspace"))
        load_place(path, Workspace(tmp_path / "workspace"))
    assert sum("+9.1 m in the median" in each.message for each in caplog.records) == 2
    write_nested(tmp_path, above_m=49.0)
    with pytest.raises(InputError, match=r"offset_m = -49\.1"):
        load_place(path, Workspace(tmp_path / "workspace"))
    caplog.clear()
    stated = load_place(
        write_nested(tmp_path, heights="offset_m = -49.0", above_m=49.0), Workspace(tmp_path / "workspace")
    )
    assert not [each for each in caplog.records if each.levelname == "WARNING" and "median" in each.message]
    assert stated.finer_heights[0].values.max() < 1510.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (('file = "fine.tif"', 'file = "none.tif"'), "elevation.finer[0].file"),
        (('file = "fine.tif"', 'file = "../fine.tif"'), "elevation.finer[0].file"),
        (('file = "fine.tif"', 'file = "fine.tif"\noffset = 1.0'), "offset_m"),
        (('file = "fine_image.tif"', 'file = "fine_image.tif"\ntime = "2024-07-01T12:00"'), "imagery.finer[0].time"),
        (('file = "fine.tif"', "nodata = 0.0"), "give either 'file'"),
    ],
)
def test_mistakes_in_the_tables_are_told_in_one_line(tmp_path, change, words):
    path = write_nested(tmp_path)
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(InputError) as refused:
        load_place(path, Workspace(tmp_path / "workspace"))
    assert words in str(refused.value)


def albedo_along(place, terrain, positions):
    from seasonscapes.rendering.hemisphere_rays import albedo_at, ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.terrain.atlas import planar_uv

    scene = ray_scene(mi_mesh(terrain, scene_albedo(place, "2024-07-01").values))
    corners = np.concatenate([place.terrain.vertices[:, :2].min(0)[None], place.terrain.vertices[:, :2].max(0)[None]])
    uv = planar_uv(np.concatenate([np.column_stack([corners, [0.0, 0.0]]), positions]).astype(np.float32))[2:]
    return albedo_at(scene, uv, positions)


def test_the_albedo_shows_the_finer_image_and_keeps_its_mean(place):
    """The coarse image, two colours, says how bright each texel is; the fine one how this is spread over stripes of 10 m."""
    terrain = view_with_terrain(place, camera(place, "south", size_px=(48, 32)))[1]
    east = np.arange(-395.0, 395.0, 0.5)
    points = np.stack([east, np.full_like(east, 12.0), np.zeros_like(east)], axis=1)
    for _ in range(3):
        points[:, 2] = place.terrain.surface.up_at(points)
    seen = albedo_along(place, terrain, points)
    plain = albedo_along(place, place.terrain, points)
    x, y, _ = map_of(place, points)
    bright = stripes(x, y) > 0.4
    offset = np.abs((x - places.EAST_M) % 10.0 - 5.0) < 3.0
    ratio = seen / plain
    np.testing.assert_allclose(ratio[bright & offset], 1.5, rtol=0.03)
    np.testing.assert_allclose(ratio[~bright & offset], 0.5, rtol=0.03)
    away = np.abs(x - (places.EAST_M - 25.0)) > 80.0
    assert seen[away].mean() == pytest.approx(plain[away].mean(), rel=0.02)
    # Beyond the border of the image there is no trace of it.
    outside = points + np.array([0.0, 800.0, 0.0])
    np.testing.assert_array_equal(albedo_along(place, terrain, outside), albedo_along(place, place.terrain, outside))


def test_images_finer_than_what_is_kept_are_read_about_the_camera(tmp_path, monkeypatch):
    monkeypatch.setattr(nested_images, "_MOST_SIDE", 200)
    monkeypatch.setattr(nested_images, "_LEVEL_RIM_PX", 10.0)
    place = load_place(write_nested(tmp_path), Workspace(tmp_path / "workspace"))
    (detail,) = nested_images.image_details(place, np.array([0.0, 0.0, 1500.0]))
    sizes = [level.texel_m for level in detail.levels]
    assert sizes == sorted(sizes, reverse=True)
    assert sizes[-1] == pytest.approx(2.5, rel=0.01)
    assert sizes[0] > 5.0
    assert max(max(level.values.shape[:2]) for level in detail.levels) < 230
    (elsewhere,) = nested_images.image_details(place, np.array([1450.0, 0.0, 1500.0]))
    assert len(elsewhere.levels) < len(detail.levels)


def test_paths_keep_clear_of_finer_heights(tmp_path):
    from seasonscapes.workflows.views import local_ground

    place = load_place(write_nested(tmp_path, above_m=4.0), Workspace(tmp_path / "workspace"))
    points = np.array([[20.0, 40.0], [1300.0, 0.0]])
    ground = local_ground(place)(points)
    surface = place.terrain.surface
    assert surface is not None
    assert ground[0] == pytest.approx(surface.up_at(np.array([[20.0, 40.0, ground[0]]]))[0], abs=0.1)
    assert np.isnan(local_ground(place)(np.array([[5000.0, 0.0]]))).all()


def test_the_days_of_melting_are_no_colours(place):
    """Detail and finer images multiply colours; a texture of times is seen as it is."""
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.rendering.terrain_material import bare_texture

    terrain = view_with_terrain(place, camera(place, "south", size_px=(48, 32)), amplify=True)[1]
    material = ray_scene(mi_mesh(terrain, np.full(3, 0.3))).mi_terrain.bsdf()
    assert material.detail is not None
    assert material.images is not None
    with bare_texture(material):
        assert material.detail is material.images is None
    assert material.detail is not None
    assert material.images is not None


def test_both_engines_show_the_same(place):
    from seasonscapes.workflows.view_rendering import render

    view = camera(place, "south", size_px=(48, 32))
    path, transport = (
        render(place, view, "2024-07-01T12:00", sky="hosek", engine=engine, **options)
        for engine, options in (("path", {"spp": 64}), ("transport", {}))
    )
    on_ground = path.coverage == 1.0
    relative = transport.surface[on_ground].mean() / path.surface[on_ground].mean()
    assert relative == pytest.approx(1.0, abs=0.02)
    blocks = [each.surface[24:].reshape(2, 4, 12, 4, 3).mean(axis=(1, 3)) for each in (path, transport)]
    np.testing.assert_allclose(blocks[1], blocks[0], rtol=0.08)


def test_ground_without_a_coarse_image_takes_the_finer_one(tmp_path):
    path = write_nested(tmp_path)
    import rasterio

    with rasterio.open(tmp_path / "image.tif", "r+") as file:
        values = file.read()
        values[:, 28:33, 28:33] = np.nan
        file.write(values)
    place = load_place(path, Workspace(tmp_path / "workspace"))
    texture = scene_albedo(place, "2024-07-01")
    middle = tuple(size // 2 for size in place.texture_shape)
    np.testing.assert_allclose(texture.values[middle], 0.4, rtol=0.25)
    assert texture.weight[middle] > 0.9


AREA = "[area]\nwest_deg = 7.974\neast_deg = 7.987\nsouth_deg = 46.547\nnorth_deg = 46.556\n"
WEBCAM = """
[[webcam]]
id = "hill"
latitude_deg = 46.5505
longitude_deg = 7.981
above_ground_m = 20.0
projection = "perspective"
width_px = 320
height_px = 200
horizontal_fov_deg = 60.0
heading_deg = 2.0
time_zone = "Europe/Zurich"
"""


@pytest.mark.parametrize("first", ["place", "calibration"])
def test_a_calibration_and_the_place_keep_the_same_finer_heights_in_either_order(first, tmp_path, monkeypatch):
    from seasonscapes.workflows.webcam_calibration import webcam_station

    path = write_nested(tmp_path)
    path.write_text(path.read_text().replace("[elevation]", AREA + "[elevation]", 1) + WEBCAM)
    monkeypatch.setenv("SEASONSCAPES_WORKSPACE", str(tmp_path / "workspace"))
    loaded = load_place(path) if first == "place" else None
    finer, whole = webcam_station(str(path)).rasters
    loaded = loaded or load_place(path)
    (kept,) = loaded.finer_heights
    np.testing.assert_array_equal(finer.values, kept.values)
    assert kept.transform == finer.transform
    # Cut to the area, 1.0 km by 1.0 km and a margin, out of 1.5 km by 1.5 km; what lies beyond it may still be on the skyline.
    assert kept.values.shape[1] * 2.5 < 1400.0
    assert whole.values.shape == base().values.shape
    assert loaded.elevation.values.shape < whole.values.shape


def test_finer_heights_of_other_bounds_are_other_ones(tmp_path):
    from seasonscapes.scene import read_scene

    path, workspace = write_nested(tmp_path), Workspace(tmp_path / "workspace")
    scene, elevation = read_scene(path), base()
    (whole,) = heights_workflow.finer_heights(scene, elevation, None, workspace, {})
    cut = replace(elevation, values=elevation.values[20:41], transform=elevation.transform @ Affine.translation(0, 20))
    (part,) = heights_workflow.finer_heights(scene, cut, None, workspace, {})
    assert part.values.shape[0] < 0.8 * whole.values.shape[0]
