"""Light on real ground: normals from the heights, no black slivers, and a mesh that is fine where the camera is near."""

from dataclasses import replace

import numpy as np
import pytest
import rasterio
from affine import Affine

import seasonscapes as ss
from seasonscapes.rendering.gbuffer import trace_gbuffer
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.irradiance import surface_at
from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh
from seasonscapes.terrain.mesh import sample_positions
from seasonscapes.terrain.raster import centre_frame
from seasonscapes.terrain.surface import Raster, mesh_up_m
from seasonscapes.terrain.surface_grid import grid_positions, surface_grid
from seasonscapes.terrain.view_refinement import _unique_edges, refined_for_view
from seasonscapes.workflows.views import view_with_terrain

NOON = "2024-12-21T11:22:17Z"


def place_of(folder, heights, *, spacing_m=30.0, crs="EPSG:32632", **options):
    """A place whose raster holds these heights."""
    rows, columns = heights.shape
    transform = Affine(spacing_m, 0, 500_000 - 0.5 * spacing_m * columns, 0, -spacing_m, 5_160_000)
    profile = {"driver": "GTiff", "count": 1, "height": rows, "width": columns, "dtype": "float32"}
    with rasterio.open(folder / "dem.tif", "w", **profile, crs=crs, transform=transform) as file:
        file.write(heights.astype(np.float32), 1)
    (folder / "scene.toml").write_text('name = "case"\n[elevation]\nfile = "dem.tif"\n')
    return ss.load_place(folder / "scene.toml", ss.Workspace(folder / "work"), options=ss.MeshOptions(**options))


def bell(peak_m=600.0, width_m=60.0, side=65):
    y, x = np.mgrid[0:side, 0:side] * 30.0
    middle = 30.0 * (side // 2)
    return 1500.0 + peak_m * np.exp(-((x - middle) ** 2 + (y - middle) ** 2) / (2.0 * width_m**2))


@pytest.fixture(scope="module")
def walled(tmp_path_factory):
    """A level plain on both sides of a wall of 300 m."""
    heights = np.full((81, 81), 500.0)
    heights[52:55] = 800.0
    return place_of(tmp_path_factory.mktemp("walled"), heights)


@pytest.fixture(scope="module")
def summit(tmp_path_factory):
    return place_of(tmp_path_factory.mktemp("summit"), bell())


@pytest.fixture(scope="module")
def alpine():
    return ss.load_place("alpine_small")


@pytest.mark.parametrize("kind", ["irradiance_map", "lit_texture", "render"])
def test_a_plain_before_a_wall_gets_its_sunlight_everywhere(walled, kind):
    light = ss.illumination(walled, NOON, sky="hosek")
    right = float(light.sun.normal_illuminance_lx[1] * light.sun.direction[2])
    rows, columns = np.mgrid[58:78, 3:78]
    if kind == "irradiance_map":
        band = ss.irradiance_map(walled, NOON, sky="hosek", rays=16).bands["direct W/m2"]
        assert np.isfinite(band).all(), "no ragged cells at the rim"
        values = np.concatenate([band[3:20, 3:-3].ravel(), band[58:78, 3:-3].ravel()])
        right = float(np.median(values))
    elif kind == "lit_texture":
        lit = ss.lit_texture(walled, NOON, sky="hosek", rays=16).sun[..., 1]
        share = (np.arange(lit.shape[0]) + 0.5) / lit.shape[0]
        values = lit[(share > 0.72) & (share < 0.97)][:, 5:-5].ravel()
        values = values[np.isfinite(values)]
    else:
        place, scene = walled, ray_scene(mi_mesh(walled.terrain, np.full(3, 0.3)))
        positions = sample_positions(place.elevation, place.frame, rows.ravel(), columns.ravel(), 500.0)
        normals = surface_at(scene, positions)[0].normal
        values = light.sun.normal_illuminance_lx[1] * (normals @ light.sun.direction)
    assert len(values) > 1000
    np.testing.assert_allclose(values, right, rtol=0.01)


def test_a_low_sun_leaves_no_streaks_on_almost_flat_ground(tmp_path):
    y, x = np.mgrid[0:90, 0:90] * 20.0
    heights = 100.0 + 1.5 * np.sin(x / 60.0) * np.cos(y / 75.0)
    place = place_of(tmp_path, heights, spacing_m=20.0)
    # The sun of the midnight hours in summer at 78° N stands as low as this one in the morning.
    band = ss.irradiance_map(place, "2024-06-21T06:50", sky="hosek", rays=16).bands["direct W/m2"]
    slope = np.hypot(*np.gradient(heights, 20.0)).max()
    sun = ss.illumination(place, "2024-06-21T06:50", sky="hosek").sun
    assert np.tan(np.radians(sun.elevation_deg)) > 1.5 * slope, "no ground faces away from the sun"
    assert band.min() > 0.2 * band.mean(), "so none of it may lie in shadow"


@pytest.mark.parametrize("crs", ["EPSG:32632", "EPSG:4326"])
def test_the_surface_passes_through_the_samples(tmp_path, crs):
    rng = np.random.default_rng(4)
    heights = 1000.0 + 300.0 * rng.random((40, 50))
    if crs == "EPSG:4326":
        profile = {"driver": "GTiff", "count": 1, "height": 40, "width": 50, "dtype": "float32", "crs": crs}
        with rasterio.open(
            tmp_path / "dem.tif", "w", **profile, transform=Affine(2 / 3600, 0, 8.0, 0, -2 / 3600, 46.6)
        ) as file:
            file.write(heights.astype(np.float32), 1)
        (tmp_path / "scene.toml").write_text('name = "case"\n[elevation]\nfile = "dem.tif"\n')
        place = ss.load_place(tmp_path / "scene.toml", ss.Workspace(tmp_path / "work"))
    else:
        place = place_of(tmp_path, heights)
    row, column = np.mgrid[0:40, 0:50]
    raster = place.elevation
    position = sample_positions(raster, place.frame, row, column, raster.values[row, column, 0]).reshape(-1, 3)
    up, normal = place.terrain.surface.sample(position)
    np.testing.assert_allclose(up, position[:, 2], atol=0.05)
    np.testing.assert_allclose(np.linalg.norm(normal, axis=1), 1.0, atol=1e-5)
    assert (normal[:, 2] > 0.0).all()


@pytest.mark.parametrize(
    ("crs", "corner", "step", "shape"),
    [
        ("EPSG:32632", (4e5, 5.18e6), 30.0, (2000, 1667)),
        ("EPSG:4326", (7.5, 47.0), 1 / 3600, (900, 1100)),
        ("EPSG:3413", (-9e5, 7e5), 2000.0, (700, 900)),
    ],
    ids=["projected", "geographic", "polar and wide"],
)
def test_positions_of_samples_are_those_of_the_transformation_within_a_millimetre(crs, corner, step, shape):
    """They are interpolated for any valley, and transformed sample by sample where a raster is too wide for that."""
    rng = np.random.default_rng(4)
    raster = Raster(np.zeros((*shape, 1), np.float32), Affine(step, 0, corner[0], 0, -step, corner[1]), crs)
    frame = replace(centre_frame(raster), refraction_k=0.13)
    rows, columns = (np.sort(rng.integers(0, extent, 17)) for extent in shape)
    heights = rng.uniform(-400.0, 8800.0, (17, 17))
    exact = sample_positions(raster, frame, *np.meshgrid(rows, columns, indexing="ij"), heights)
    np.testing.assert_allclose(grid_positions(raster, frame)(rows, columns, heights), exact, atol=1e-3)


@pytest.mark.parametrize(
    ("crs", "corner", "step"),
    [("EPSG:4326", (5.0, 50.0), 5.0 / 300), ("EPSG:4326", (15.0, 80.0), 2.0 / 300), ("EPSG:3857", (9e5, 6e6), 200.0)],
)
def test_the_surface_of_wide_and_polar_rasters(crs, corner, step):
    heights = np.random.default_rng(2).uniform(0.0, 4000.0, (300, 300, 1)).astype(np.float32)
    raster = Raster(heights, Affine(step, 0, corner[0], 0, -step, corner[1]), crs)
    frame = centre_frame(raster)
    row, column = np.mgrid[0:300:7, 0:300:7]
    position = sample_positions(raster, frame, row, column, heights[row, column, 0]).reshape(-1, 3)
    node = surface_grid(raster, frame).nodes_at(position)
    np.testing.assert_allclose(node, np.stack([column.ravel(), row.ravel()], axis=1), atol=0.03)


def test_the_device_and_the_host_agree_on_the_surface(alpine):
    from seasonscapes.rendering.backend import point3
    from seasonscapes.rendering.terrain_material import DeviceSurface

    rng = np.random.default_rng(1)
    positions = alpine.terrain.vertices[rng.integers(0, len(alpine.terrain.vertices), 2000)]
    up, normal = alpine.terrain.surface.sample(positions)
    mi_normal, mi_up = DeviceSurface(alpine.terrain.surface).sample(point3(positions))
    np.testing.assert_allclose(np.array(mi_up), up, atol=0.05)
    np.testing.assert_allclose(np.array(mi_normal).T, normal, atol=2e-3)


def test_the_normal_of_a_slope(tmp_path):
    x = np.arange(60) * 30.0
    place = place_of(tmp_path, np.broadcast_to(1000.0 + 0.4 * x, (60, 60)))
    middle = place.terrain.vertices.mean(axis=0, keepdims=True)
    expected = np.array([-0.4, 0.0, 1.0]) / np.hypot(0.4, 1.0)
    # Grid north is not true north there, by a hundredth.
    np.testing.assert_allclose(place.terrain.surface.sample(middle)[1][0], expected, atol=0.01)


def test_no_black_pixel_on_a_summit_by_day(summit):
    above = ss.Viewpoint(latitude_deg=46.59, longitude_deg=9.0, above_ground_m=2.0, heading_deg=0.0)
    latitude, longitude = centre(summit)
    for heading in (0.0, 120.0, 240.0):
        view = above.model_copy(
            update={"latitude_deg": latitude, "longitude_deg": longitude, "heading_deg": heading, "pitch_deg": -30.0}
        )
        seen = ss.render(summit, ss.camera(summit, view, size_px=(64, 48)), "2024-06-20T15:30", sky="hosek", spp=8)
        land = seen.coverage > 0.99
        assert land.any()
        assert seen.surface[land][:, 1].min() > 50.0


def centre(place):
    from seasonscapes.frames import geodetic_from_enu

    top = place.terrain.vertices[place.terrain.vertices[:, 2].argmax()].astype(float)
    latitude, longitude, _ = geodetic_from_enu(place.frame, top)
    return float(latitude), float(longitude)


def test_above_ground_is_above_what_is_rendered(summit):
    latitude, longitude = centre(summit)
    eye = ss.Viewpoint(
        latitude_deg=latitude + 0.00013, longitude_deg=longitude, above_ground_m=1.7, heading_deg=90.0, pitch_deg=-89.0
    )
    camera = ss.camera(summit, eye, size_px=(9, 9))
    scene = ray_scene(mi_mesh(view_with_terrain(summit, camera)[1], np.full(3, 0.3)))
    depth = trace_gbuffer(RenderScene(scene.mi_scene, scene.mi_terrain), camera).depth[4, 4]
    assert depth == pytest.approx(1.7, abs=0.3)
    ground = mesh_up_m(summit.terrain, camera.position_m)
    inside = camera.position_m[2] - ground
    assert inside > 1.6


def test_a_camera_below_the_rendered_surface_is_refused(summit):
    latitude, longitude = centre(summit)
    low = ss.Viewpoint(latitude_deg=latitude, longitude_deg=longitude, height_m=1800.0, heading_deg=0.0)
    with pytest.raises(ss.InputError, match="stands below the ground"):
        ss.camera(summit, low)


def test_refinement_near_the_camera_has_no_cracks_and_keeps_the_atlas(alpine):
    camera = ss.camera(alpine, "meadow", size_px=(768, 512))
    plain, fine = alpine.terrain, view_with_terrain(alpine, camera)[1]
    assert len(plain.faces) < len(fine.faces) < 3 * len(plain.faces)

    def rims(terrain):
        edges, of_face = _unique_edges(terrain.faces)
        return int((np.bincount(of_face.ravel(), minlength=len(edges)) == 1).sum())

    assert rims(fine) == rims(plain), "every inner edge has two faces"

    def area(terrain):
        a, b, c = (terrain.vertices[terrain.faces[:, k], :2].astype(float) for k in range(3))
        return 0.5 * ((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])

    assert area(fine).min() > 0.0
    assert area(fine).sum() == pytest.approx(area(plain).sum(), rel=1e-5)
    added = fine.vertices[len(plain.vertices) :]
    np.testing.assert_allclose(added[:, 2], plain.surface.sample(added)[0], atol=1e-2)
    corner = plain.vertices[:, :2].min(axis=0).astype(float)
    extent = np.ptp(plain.vertices[:, :2].astype(float), axis=0)
    scale, offset = np.polyfit((plain.vertices[:, 0] - corner[0]) / extent[0], plain.uv[:, 0], 1)
    np.testing.assert_allclose(
        fine.uv[len(plain.uv) :, 0], scale * (added[:, 0] - corner[0]) / extent[0] + offset, atol=1e-4
    )


def test_refinement_leaves_a_mesh_without_surface_alone(alpine):
    bare = replace(alpine.terrain, surface=None)
    assert refined_for_view(bare, np.zeros(3), 1e-3) is bare


def test_the_engine_is_chosen_by_what_is_asked_for(alpine):
    camera = ss.camera(alpine, "aerial", size_px=(48, 32))
    still = ss.render(alpine, camera, "2024-07-20T13:30", sky="hosek")
    traced = ss.render(alpine, camera, "2024-07-20T13:30", sky="hosek", spp=256)
    assert still.provenance["engine"] == "transport"
    assert traced.provenance["engine"] == "path"
    land = still.coverage > 0.99
    # Both see the albedo of the day. Pixels of such a small picture hold much texture, of which each takes its samples.
    first, second = (view.radiance[land][:, 1].astype(float) for view in (still, traced))
    assert first.mean() == pytest.approx(second.mean(), rel=0.01)
    assert np.median(np.abs(first - second) / second) < 0.05
    with pytest.raises(ss.InputError, match="--engine path"):
        ss.render(alpine, camera, "2024-07-20T13:30", sky="hosek", engine="transport", spp=4)
    with pytest.raises(ss.InputError, match="unknown engine"):
        ss.render(alpine, camera, "2024-07-20T13:30", sky="hosek", engine="guess")


def test_another_hour_of_a_map_uses_the_coefficients_that_the_first_one_kept(monkeypatch, tmp_path):
    """And a map that is too large for keeping them has the same values."""
    from seasonscapes.rendering import irradiance as rendering

    place = ss.load_place("alpine_small", ss.Workspace(tmp_path))

    def mapped(hour):
        return ss.irradiance_map(place, f"2024-06-21T{hour}:00", sky="hosek", rays=16, spacing_m=300.0).bands

    morning = mapped("09")
    traced = rendering.trace_points

    def refused(*arguments, **options):
        raise AssertionError("light transport is traced again")

    monkeypatch.setattr(rendering, "trace_points", refused)
    again, noon = mapped("09"), mapped("12")
    monkeypatch.setattr(rendering, "trace_points", traced)
    monkeypatch.setattr(rendering, "BLOCK", 100)
    in_blocks = mapped("12")
    for name in morning:
        np.testing.assert_array_equal(again[name], morning[name])
        np.testing.assert_allclose(noon[name], in_blocks[name], rtol=2e-3, atol=2e-3)
    assert np.nanmean(noon["total W/m2"]) > np.nanmean(morning["total W/m2"])
