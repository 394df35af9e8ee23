"""Rendering against closed forms: Lambert, the furnace, shadows, projection, orientation."""

from dataclasses import replace

import numpy as np
import pytest

from seasonscapes.cameras.pinhole import Camera, project, ray_directions, rotation_from_angles
from seasonscapes.declaration import InputError
from seasonscapes.frames import LocalFrame, direction_from_angles, equirectangular_directions
from seasonscapes.rendering import backend
from seasonscapes.rendering.gbuffer import occluded, trace_gbuffer
from seasonscapes.rendering.hosek import hosek_illumination
from seasonscapes.rendering.mitsuba_scene import build_scene, mi_mesh, relight, set_albedo
from seasonscapes.rendering.radiance import path_trace, render_view
from seasonscapes.sky.illumination import (
    Illumination,
    Luminary,
    diffuse_horizontal_illuminance,
    global_horizontal_illuminance,
    luminance,
    uniform_sky,
)
from seasonscapes.terrain.attributes import vertex_normals
from seasonscapes.terrain.surface import Terrain

FRAME = LocalFrame(46.55, 7.98)


def heightfield(height_m, *, side_m=1000.0, count=101) -> Terrain:
    """A grid terrain of a function of (east, north)."""
    axis = np.linspace(-side_m / 2, side_m / 2, count)
    east, north = np.meshgrid(axis, axis)
    vertices = np.stack([east, north, height_m(east, north)], -1).reshape(-1, 3)
    index = np.arange(count * count).reshape(count, count)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]
    faces = np.concatenate([np.stack(t, -1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    uv = vertices[:, :2] / side_m + 0.5
    return Terrain(vertices.astype(np.float32), faces.astype(np.uint32), uv.astype(np.float32), FRAME)


def looking_down(height_m=1000.0, *, size=200, view_m=1000.0) -> Camera:
    """A camera above the origin; the picture's top is north and its width shows ``view_m`` of the plane z = 0."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(0.0, -90.0)
    pose[:3, 3] = [0.0, 0.0, height_m]
    focal = size * height_m / view_m
    return Camera(size, size, focal, focal, size / 2, size / 2, pose)


def sun_at(azimuth_deg, elevation_deg, illuminance_lx=1.0e5, radius_deg=0.2666) -> Illumination:
    luminary = Luminary(direction_from_angles(azimuth_deg, elevation_deg), np.full(3, illuminance_lx), radius_deg)
    return Illumination(np.zeros((16, 32, 3), np.float32), luminary)


PLANE = heightfield(lambda e, n: 0.0 * e, count=3)


def test_a_mesh_has_the_normals_that_it_was_given():
    """Mitsuba would sum its own, in an order that varies between runs."""
    import mitsuba as mi

    land = heightfield(lambda east, north: 40.0 * np.sin(east / 60.0) * np.cos(north / 45.0))
    given = np.random.default_rng(4).normal(size=land.vertices.shape).astype(np.float32)
    given /= np.linalg.norm(given, axis=1, keepdims=True)
    for terrain, expected in ((land, vertex_normals(land)), (replace(land, normals=given), given)):
        normals = mi.traverse(mi_mesh(terrain, np.full(3, 0.3)))["vertex_normals"]
        assert np.array(normals).reshape(-1, 3).tobytes() == expected.astype(np.float32).tobytes()


def test_lambert_under_the_sun():
    light = sun_at(140.0, 35.0)
    image, coverage = path_trace(build_scene(PLANE, np.array([0.3, 0.2, 0.1]), light), looking_down(size=16), spp=16)
    assert coverage.min() == 1.0
    expected = np.array([0.3, 0.2, 0.1]) / np.pi * 1.0e5 * np.sin(np.radians(35.0))
    np.testing.assert_allclose(image.reshape(-1, 3).mean(0), expected, rtol=2e-3)


def test_white_furnace_in_a_bowl():
    bowl = heightfield(lambda e, n: 0.004 * (e**2 + n**2), count=61)
    scene = build_scene(bowl, np.ones(3), uniform_sky(1.0), smooth=False)
    image, _ = path_trace(scene, looking_down(200.0, size=24, view_m=200.0), spp=64, max_depth=200)
    assert abs(image.mean() - 1.0) < 0.005


def test_map_energy_arrives():
    """The environment map's illuminance on a plane is the integral of our map, though the grids differ."""
    direction = equirectangular_directions(64, 128)
    sky = np.where(direction[..., 2:] > 0, 500.0 + 3000.0 * direction[..., 2:] + 2000.0 * direction[..., :1], 0.0)
    light = Illumination((np.ones(3) * sky).astype(np.float32))
    image, _ = path_trace(build_scene(PLANE, np.ones(3), light), looking_down(size=16), spp=256, max_depth=2)
    expected = diffuse_horizontal_illuminance(light.sky_radiance)[1] / np.pi
    assert abs(image.mean() / expected - 1.0) < 0.01


@pytest.mark.parametrize("azimuth_deg", [0.0, 90.0, 200.0, 275.0])
def test_environment_map_is_not_mirrored(azimuth_deg):
    """Rays that leave the scene bring back the map's own value of their direction."""
    import drjit as dr
    import mitsuba as mi

    direction = equirectangular_directions(32, 64)
    sky = (2.0 + direction).astype(np.float32)
    scene = build_scene(PLANE, np.ones(3), Illumination(sky)).mi_scene
    towards = direction_from_angles([azimuth_deg] * 3, [5.0, 40.0, 80.0])
    interaction = dr.zeros(mi.SurfaceInteraction3f, 3)
    interaction.wi = -mi.Vector3f(backend.point3(towards))
    found = backend.to_numpy(scene.environment().eval(interaction))
    np.testing.assert_allclose(found, 2.0 + towards, atol=0.02)


LETTER_F = np.array([[1, 1, 1, 0], [1, 0, 0, 0], [1, 1, 0, 0], [1, 0, 0, 0]], np.float32)


def test_letter_f_is_upright():
    texture = np.repeat(0.1 + 0.8 * LETTER_F[..., None], 3, axis=2)
    texture = texture.repeat(16, axis=0).repeat(16, axis=1)
    scene = build_scene(PLANE, texture, uniform_sky(1.0))
    image, _ = path_trace(scene, looking_down(size=64), spp=64, max_depth=2)
    picture = image[..., 0].reshape(4, 16, 4, 16)[:, 6:10, :, 6:10].mean(axis=(1, 3))
    np.testing.assert_allclose(picture, 0.1 + 0.8 * LETTER_F, atol=0.02)
    set_albedo(scene, texture[:, ::-1])
    mirrored, _ = path_trace(scene, looking_down(size=64), spp=64, max_depth=2)
    assert np.abs(mirrored[:, ::-1] - image).mean() < 0.02


def pyramid(east, north, height_m=100.0, half_m=100.0):
    return height_m * np.clip(1.0 - np.maximum(np.abs(east), np.abs(north)) / half_m, 0.0, None)


SUNS = [(90.0, 20.0), (270.0, 30.0), (180.0, 25.0), (0.0, 20.0), (135.0, 30.0), (300.0, 15.0)]


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), SUNS)
def test_shadow_of_a_pyramid(azimuth_deg, elevation_deg):
    """The shadow on the plane is the closed form's, pixel by pixel, and points away from the sun."""
    size, pixel_m = 250, 4.0
    scene = build_scene(
        heightfield(pyramid, count=201),
        np.full(3, 0.5),
        sun_at(azimuth_deg, elevation_deg, radius_deg=0.001),
        smooth=False,
    )
    image, _ = path_trace(scene, looking_down(5000.0, size=size), spp=16, max_depth=2)
    shade = 1.0 - image[..., 1] / np.median(image[..., 1])
    # Closed form on 2 × 2 points of each pixel: shaded iff the ray to the sun passes below the pyramid.
    axis = (np.arange(2 * size) + 0.5) * pixel_m / 2 - size * pixel_m / 2
    east, north = np.meshgrid(axis, -axis)
    east_away, north_away, _ = -direction_from_angles(azimuth_deg, 0.0)
    slope = np.tan(np.radians(elevation_deg))
    shaded = np.zeros(east.shape, bool)
    for t in np.linspace(0.0, 100.0 / slope, 200):
        shaded |= pyramid(east - t * east_away, north - t * north_away) > t * slope + 1e-9
    expected = shaded.reshape(size, 2, size, 2).mean(axis=(1, 3))
    flat = np.maximum(np.abs(east), np.abs(north)).reshape(size, 2, size, 2).min(axis=(1, 3)) > 104.0
    from scipy.ndimage import maximum_filter, minimum_filter

    wide, narrow = maximum_filter(expected, 3), minimum_filter(expected, 3)
    assert np.all((shade <= wide + 0.3)[flat]), "shadow more than a pixel too wide"
    assert np.all((shade >= narrow - 0.3)[flat]), "shadow more than a pixel too narrow"
    away = (east * east_away + north * north_away).reshape(size, 2, size, 2).mean(axis=(1, 3))
    tip_m = np.where(flat & (shade > 0.25), away, -np.inf).max()
    assert abs(tip_m - np.where(flat & (expected > 0.25), away, -np.inf).max()) <= pixel_m
    assert tip_m == pytest.approx(100.0 / slope, abs=3 * pixel_m), "height / tan(elevation)"


def test_projection_agrees_with_the_picture():
    """Bright squares in a dark texture are found, by their centroids, where `project` puts their centres."""

    def hill_m(east, north):
        return 60.0 * np.sin(east / 130.0) * np.cos(north / 90.0)

    cells = np.array([[40, 60], [100, 100], [90, 150], [150, 40], [160, 130]])
    texture = np.zeros((200, 200, 3), np.float32)
    texture[cells[:, 0], cells[:, 1]] = 1.0
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(25.0, -42.0, 4.0)
    pose[:3, 3] = [-260.0, -520.0, 620.0]
    camera = Camera(300, 240, 300.0, 285.0, 155.0, 112.0, pose)
    scene = build_scene(heightfield(hill_m, count=201), texture, uniform_sky(1.0))
    image = path_trace(scene, camera, spp=64, max_depth=2, seed=1)[0][..., 0]
    gbuffer = trace_gbuffer(scene, camera)
    y, x = np.mgrid[:240, :300] + 0.5
    found = 0
    for row, column in cells:
        east, north = column * 5.0 + 2.5 - 500.0, 500.0 - row * 5.0 - 2.5
        point = np.array([east, north, hill_m(east, north)])
        pixel, depth = project(camera, point)
        if not (10 < pixel[0] < 290 and 10 < pixel[1] < 230):
            continue
        if abs(gbuffer.depth[int(pixel[1]), int(pixel[0])] - np.linalg.norm(point - camera.position_m)) > 8.0:
            continue  # behind the hill
        near = np.where(np.hypot(x - pixel[0], y - pixel[1]) < 9.0, image, 0.0)
        centroid = np.array([(x * near).sum(), (y * near).sum()]) / near.sum()
        assert depth > 0
        assert np.linalg.norm(centroid - pixel) < 0.5
        found += 1
    assert found >= 3


def test_gbuffer_of_a_plane():
    camera = looking_down(700.0, size=20)
    scene = build_scene(PLANE, np.ones(3), uniform_sky(1.0))
    gbuffer = trace_gbuffer(scene, camera)
    direction = ray_directions(camera)
    np.testing.assert_allclose(gbuffer.depth, 700.0 / -direction[..., 2], rtol=1e-5)
    np.testing.assert_allclose(gbuffer.position[..., :2] / 1000.0 + 0.5, gbuffer.uv, atol=1e-5)
    np.testing.assert_allclose(gbuffer.normal, np.broadcast_to([0, 0, 1.0], gbuffer.normal.shape), atol=1e-6)
    assert gbuffer.uv[0, 0, 1] > gbuffer.uv[-1, 0, 1], "v runs upwards: north is on top"
    pose = camera.world_from_camera.copy()
    pose[:3, :3] = rotation_from_angles(0.0, 45.0)
    up = trace_gbuffer(scene, Camera(8, 8, 8.0, 8.0, 4.0, 4.0, pose))
    assert np.isinf(up.depth).all()
    assert np.isnan(up.position).all()


def test_sun_and_moon_polygons_do_not_occlude_or_show_in_the_gbuffer():
    scene = build_scene(PLANE, np.ones(3), sun_at(180.0, 30.0))
    assert not occluded(scene, np.array([[0.0, 0.0, 1.0]]), direction_from_angles([180.0], [30.0])).any()


def test_equal_seeds_equal_pictures_and_other_seeds_others():
    scene = build_scene(heightfield(pyramid), np.full(3, 0.5), relight_light())
    camera = looking_down(600.0, size=48)
    first, _ = path_trace(scene, camera, spp=4, seed=5)
    again, _ = path_trace(scene, camera, spp=4, seed=5)
    other, _ = path_trace(scene, camera, spp=4, seed=6)
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.0


def relight_light() -> Illumination:
    return Illumination(uniform_sky(1000.0).sky_radiance, sun_at(120.0, 40.0).sun)


def test_blocks_do_not_change_the_expectation(monkeypatch):
    """Rendering in many small blocks and passes is the same estimate as in one."""
    from seasonscapes.rendering import radiance

    scene = build_scene(heightfield(pyramid), np.full(3, 0.5), relight_light())
    camera = looking_down(600.0, size=32)
    whole, _ = path_trace(scene, camera, spp=64)
    monkeypatch.setattr(radiance, "LANES", 32 * 20)
    seen = []
    blocks, _ = path_trace(scene, camera, spp=64, progress=seen.append)
    assert seen[-1] == 1.0
    assert sorted(seen) == seen
    assert abs(blocks.mean() / whole.mean() - 1.0) < 0.01


def test_relight_keeps_the_terrain():
    scene = build_scene(PLANE, np.full(3, 0.5), sun_at(90.0, 30.0))
    other = relight(scene.mi_terrain, sun_at(90.0, 60.0))
    low = path_trace(scene, looking_down(size=8), spp=4)[0].mean()
    high = path_trace(other, looking_down(size=8), spp=4)[0].mean()
    assert high / low == pytest.approx(np.sin(np.radians(60.0)) / np.sin(np.radians(30.0)), rel=1e-3)


def test_no_light_is_said():
    dark = Illumination(np.zeros((4, 8, 3), np.float32))
    with pytest.raises(ValueError, match="no light at all"):
        build_scene(PLANE, np.ones(3), dark)


def test_sky_behind_the_terrain_and_the_disc_of_the_sun():
    light = Illumination(uniform_sky(3000.0).sky_radiance, sun_at(0.0, 20.0).sun)
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(0.0, 20.0)
    pose[:3, 3] = [0.0, 0.0, 100.0]
    camera = Camera(101, 101, 2000.0, 2000.0, 50.5, 50.5, pose)
    view = render_view(build_scene(PLANE, np.ones(3), light), camera, spp=1)
    assert view.coverage.max() == 0.0
    assert view.radiance[0, 0, 0] == pytest.approx(3000.0, rel=1e-5)
    excess = view.radiance[..., 0] - 3000.0
    pixel_solid_angle = 1.0 / 2000.0**2
    assert excess.sum() * pixel_solid_angle == pytest.approx(1.0e5, rel=0.02)
    y, x = np.nonzero(excess > 1.0)
    assert abs(x.mean() - 50.0) < 0.2
    assert abs(y.mean() - 50.0) < 0.2


def test_air_is_applied_to_terrain_by_distance():
    class Fog:
        """Koschmieder's homogeneous fog of 3 km visibility."""

        def __call__(self, depth_m, direction):
            transmittance = np.exp(-3.912 / 3000.0 * np.asarray(depth_m))[..., None] * np.ones(3)
            return transmittance, 5000.0 * (1.0 - transmittance)

    light = Illumination(uniform_sky(1000.0).sky_radiance, aerial_perspective=Fog())
    view = render_view(build_scene(PLANE, np.full(3, 0.5), light), looking_down(1500.0, size=8, view_m=10.0), spp=16)
    transmittance = np.exp(-3.912 * 0.5)
    assert view.radiance.mean() == pytest.approx(500.0 * transmittance + 5000.0 * (1.0 - transmittance), rel=0.01)


def test_hosek_is_photometric_and_turned_the_right_way():
    light = hosek_illumination(direction_from_angles(120.0, 60.0))
    assert 0.8e5 < luminance(global_horizontal_illuminance(light)) < 1.3e5
    row = light.sky_radiance[40, :, 1]
    assert abs((np.argmax(row) + 0.5) * 360.0 / 256 - 120.0) < 3.0
    low = hosek_illumination(direction_from_angles(250.0, 3.0))
    red, _, blue = low.sun.normal_illuminance_lx
    assert red > 2.0 * blue, "a low sun is red"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"sun_direction": direction_from_angles(90.0, -3.0)}, "below the horizon"),
        ({"sun_direction": direction_from_angles(90.0, 30.0), "turbidity": 12.0}, "expected 1 to 10"),
        ({"sun_direction": direction_from_angles(90.0, 30.0), "ground_albedo": 1.2}, "expected 0 to 1"),
    ],
)
def test_hosek_refuses_what_it_cannot_do(arguments, message):
    with pytest.raises(InputError, match=message):
        hosek_illumination(**arguments)


def test_old_llvm_is_named_not_loaded(monkeypatch):
    old = backend.Library("/usr/lib/libLLVM-14.so.1", (0, 0, 0))
    monkeypatch.setattr(backend, "find_llvm", lambda: old)
    monkeypatch.setattr(backend, "cuda_devices", lambda: 0)
    assert backend.choose_backend().device == "scalar"
    assert "libLLVM-14" in backend.choose_backend().reason
    with pytest.raises(InputError, match=r"libLLVM-14.*install one"):
        backend.choose_backend("llvm")
    with pytest.raises(InputError, match="no CUDA device"):
        backend.choose_backend("cuda")
    with pytest.raises(InputError, match="unknown device"):
        backend.choose_backend("tpu")
    monkeypatch.setattr(backend, "cuda_devices", lambda: 2)
    assert backend.choose_backend().variant == "cuda_ad_rgb"


@pytest.mark.parametrize("device", ["auto", "scalar"])
def test_probe_in_a_child(device):
    works, line = backend.probe_in_child(device)
    assert works, line
    assert "rendered the test plane" in line


def test_scalar_and_llvm_agree():
    """The variant without LLVM renders the same picture, statistically (in a child process: one variant each)."""
    import json
    import subprocess
    import sys

    code = (
        "import sys, json; sys.path.insert(0, 'tests')\n"
        "import test_rendering as t\n"
        "from seasonscapes.rendering.backend import use_backend\n"
        "use_backend(sys.argv[1])\n"
        "scene = t.build_scene(t.heightfield(t.pyramid, count=21), t.np.array([.5, .4, .3]), t.relight_light())\n"
        "view = t.render_view(scene, t.looking_down(600.0, size=24), spp=64)\n"
        "print(json.dumps([view.radiance.mean((0, 1)).tolist(), float(view.gbuffer.depth.mean())]))\n"
    )
    results = [
        json.loads(
            subprocess.run([sys.executable, "-c", code, device], capture_output=True, text=True, check=True).stdout
        )
        for device in ("scalar", "auto")
    ]
    np.testing.assert_allclose(results[0][0], results[1][0], rtol=0.01)
    assert results[0][1] == pytest.approx(results[1][1], rel=1e-4)
