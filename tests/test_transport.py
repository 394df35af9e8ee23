"""Daylight coefficients light views and places as path tracing does, and as closed forms say."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
from test_rendering import PLANE, heightfield, looking_down, sun_at

from seasonscapes.albedo.view_light import view_raised
from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.frames import direction_from_angles, equirectangular_directions
from seasonscapes.rendering import sun_visibility
from seasonscapes.rendering.backend import use_backend
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.coefficients_file import load_coefficients, save_coefficients
from seasonscapes.rendering.direction_basis import direction_basis
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.irradiance import irradiance, irradiance_blocks, surface_at, upload_points
from seasonscapes.rendering.light_clusters import cluster_lists
from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight, set_albedo
from seasonscapes.rendering.radiance import path_trace, render_view
from seasonscapes.rendering.relit_view import relight_view, relightable_view, sun_cosine, terrain_image
from seasonscapes.rendering.sky_patches import (
    SUBDIVISIONS,
    direction_weights,
    mi_patch_of,
    patch_of,
    patch_radiance,
    sky_patches,
    sky_second_moments,
)
from seasonscapes.rendering.sun_visibility import start_first_samples, start_sum_facing, sum_incidence, visible_cosine
from seasonscapes.rendering.transport import trace_points, trace_view, view_albedo
from seasonscapes.rendering.view_samples import pixel_moments, sample_moments, view_samples
from seasonscapes.sky.illumination import Illumination, uniform_sky

QUICK = SamplingOptions(rays=128, clusters=1024, clusters_per_receiver=32)
ALBEDO = np.array([0.55, 0.45, 0.35])


def gradient_sky() -> np.ndarray:
    """Brighter towards the east and the zenith, dark below the horizon."""
    direction = equirectangular_directions(64, 128)
    sky = np.where(direction[..., 2:] > 0, 3000.0 + 2000.0 * direction[..., :1] + 2000.0 * direction[..., 2:], 0.0)
    return (sky * [0.8, 1.0, 1.3]).astype(np.float32)


@pytest.fixture(scope="module")
def valley():
    terrain = heightfield(lambda e, n: 120.0 * np.cos(e / 90.0) + 60.0 * np.sin(n / 70.0), count=101)
    mesh = mi_mesh(terrain, ALBEDO)
    camera = looking_down(900.0, size=64, view_m=700.0)
    view = trace_view(ray_scene(mesh), camera, SamplingOptions(clusters=4096), seed=3)
    return mesh, camera, relightable_view(ray_scene(mesh), view)


LIGHTS = {
    "uniform sky": uniform_sky(4000.0),
    "gradient sky": Illumination(gradient_sky()),
    "sun": Illumination(0.2 * gradient_sky(), sun_at(110.0, 35.0).sun),
    "low sun": Illumination(gradient_sky(), sun_at(250.0, 12.0).sun),
    "moon": Illumination(1e-6 * gradient_sky(), moon=sun_at(200.0, 30.0, illuminance_lx=0.2).sun),
    "sun and moon": Illumination(1e-3 * gradient_sky(), sun_at(90.0, 3.0, 10.0).sun, sun_at(270.0, 40.0, 5.0).sun),
}


@pytest.mark.parametrize("name", LIGHTS)
def test_relit_view_equals_path_tracing(valley, name):
    """In the mean within 1 %, and pixel by pixel within 4 % of the picture's mean (noise of both included)."""
    mesh, camera, ready = valley
    reference, _ = path_trace(relight(mesh, LIGHTS[name]), camera, spp=512, max_depth=6)
    relit = relight_view(ready, LIGHTS[name]).surface
    assert relit.mean() / reference.mean() == pytest.approx(1.0, abs=0.01)
    assert np.sqrt(np.mean((relit - reference) ** 2)) < 0.04 * reference.mean()


@pytest.mark.parametrize(("azimuth_deg", "elevation_deg"), [(110.0, 35.0), (250.0, 12.0), (20.0, 4.0)])
def test_few_shadow_rays_say_what_all_do(valley, azimuth_deg, elevation_deg):
    """Slopes that the sun grazes are lit without rays: within 3 % of the mean of rays from every sample, and unbiased."""
    _, _, ready = valley
    sun, every = sun_at(azimuth_deg, elevation_deg).sun, np.arange(ready.rays.receivers)
    all_rays, unoccluded = sum_incidence(ready.rays, sun, every)
    quick = sun_cosine(ready, sun)
    assert np.sqrt(np.mean((quick - all_rays) ** 2)) < 0.03 * all_rays.mean()
    assert quick.mean() == pytest.approx(all_rays.mean(), rel=0.005)
    # Without rays samples are dark where they face away alone, so that there is no less light.
    facing = start_sum_facing(ready.rays, sun, every)()
    assert (facing >= all_rays).all()
    assert (facing <= unoccluded).all()
    assert facing.mean() > all_rays.mean()
    weight = np.array(ready.rays.mi_weight, np.float32).reshape(len(every), -1)
    by_sample = visible_cosine(ready.rays, sun)
    np.testing.assert_allclose(all_rays, (by_sample * weight).sum(axis=1), atol=1e-5)
    # First samples by themselves meet the same points of the disc as among the others.
    np.testing.assert_array_equal(start_first_samples(ready.rays, sun)(), (by_sample * weight)[:, 0] > 0.0)
    # Ground that is raised below the same ridges is raised for all of its rays.
    raised = view_raised(ready, 20.0)
    again = start_first_samples(raised.rays, sun)()
    np.testing.assert_array_equal(again, (visible_cosine(raised.rays, sun).reshape(weight.shape) * weight)[:, 0] > 0.0)
    assert again.sum() > start_first_samples(ready.rays, sun)().sum()


def test_parts_of_shadow_rays_say_what_all_at_once_do(valley, monkeypatch):
    """Parts of any length, one of which may hold as many rays as there are samples in all."""
    _, _, ready = valley
    sun, every = sun_at(110.0, 35.0).sun, np.arange(ready.rays.receivers)
    samples = ready.rays.receivers * ready.rays.samples
    whole = {rays: visible_cosine(ready.rays, sun, rays_per_sample=rays) for rays in (1, 4)}
    sums, first = sum_incidence(ready.rays, sun, every), start_first_samples(ready.rays, sun)()
    assert np.abs(whole[1] - whole[4]).max() > 0.0
    for lanes in (samples, samples // 3 + 1):
        monkeypatch.setattr(sun_visibility, "LANES", lanes)
        for rays, values in whole.items():
            np.testing.assert_array_equal(visible_cosine(ready.rays, sun, rays_per_sample=rays), values)
        np.testing.assert_allclose(sum_incidence(ready.rays, sun, every), sums, atol=1e-5)
        np.testing.assert_array_equal(start_first_samples(ready.rays, sun)(), first)


@pytest.mark.parametrize("divisor", [1, 3, 16, 255, 1024, 4099])
def test_quotients_by_multiplication_are_exact(divisor):
    use_backend()
    import mitsuba as mi

    ends = [np.arange(3000), divisor * np.arange(900), sun_visibility.LANES - 1 - np.arange(3000)]
    number = np.concatenate(ends).astype(np.uint32)
    quotient, remainder = sun_visibility._quotient_and_remainder(mi.UInt32(number), divisor)
    np.testing.assert_array_equal(np.array(quotient), number // divisor)
    np.testing.assert_array_equal(np.array(remainder) + np.zeros_like(number), number % divisor)


def test_an_image_of_terrain_pixels_in_runs_or_one_by_one(valley):
    _, _, ready = valley
    random = np.random.default_rng(5)
    count = len(ready.coefficients.pixel)
    for kept in (np.arange(count), np.flatnonzero(random.random(count) < 0.5)):
        part = replace(
            ready, coefficients=replace(ready.coefficients, pixel=np.asarray(ready.coefficients.pixel)[kept])
        )
        values = random.random((len(kept), 3), np.float32)
        expected = np.zeros((ready.coverage.size, 3), np.float32)
        expected[part.coefficients.pixel] = values
        np.testing.assert_array_equal(terrain_image(part, values).reshape(-1, 3), expected)


def test_moments_of_traced_samples_are_those_of_their_pixels(valley):
    """A still takes albedo, normal and coverage from its shadow samples, in place of rays of their own."""
    mesh, camera, _ = valley
    points, hit, pixel = view_samples(ray_scene(mesh), camera, range(10, 40), 16, 3)
    traced = pixel_moments(ray_scene(mesh), camera, range(10, 40), 16, 3)
    for known, own in zip(sample_moments(points, hit), traced, strict=True):
        np.testing.assert_allclose(known, own[pixel - 10 * camera.width_px], atol=1e-6)


def test_directions_are_principal_components():
    """Of coefficients that lie in few dimensions nothing is lost; of others, no more than any projection must lose."""
    patches, random = sky_patches("reinhart"), np.random.default_rng(5)
    flat = random.normal(size=(512, 8)) @ random.random((8, patches.size))
    basis = direction_basis(flat, patches, rank=8)
    skies = np.linalg.cholesky(sky_second_moments(patches)) @ random.normal(size=(patches.size, 64))
    approximation = (flat @ basis.projection) @ (basis.from_sky.T @ skies)
    np.testing.assert_allclose(approximation, flat @ skies, atol=1e-4 * np.abs(flat @ skies).max())
    assert basis.error < 1e-6
    rows = random.random((2048, patches.size)) ** 4
    half = direction_basis(rows, patches, rank=32)
    missed = (rows @ half.projection) @ (half.from_sky.T @ skies) - rows @ skies
    measured = np.sqrt((missed**2).sum() / ((rows @ skies) ** 2).sum())
    # 64 random skies tell the error of all within a tenth.
    assert measured == pytest.approx(half.error, rel=0.1)


@pytest.mark.parametrize(("bounces", "max_depth"), [(0, 2), (1, 3), (2, 4)])
def test_bounces_are_as_many_as_asked_for(bounces, max_depth):
    """Measured in a bowl of bright walls, where each bounce adds a tenth and more."""
    bowl = heightfield(lambda e, n: 0.002 * (e**2 + n**2), count=61)
    mesh, camera, light = mi_mesh(bowl, np.full(3, 0.9)), looking_down(300.0, size=16, view_m=300.0), LIGHTS["sun"]
    view = trace_view(ray_scene(mesh), camera, SamplingOptions(rays=256, clusters=1024, bounces=bounces))
    relit = relight_view(relightable_view(ray_scene(mesh), view), light).surface.mean()
    reference = path_trace(relight(mesh, light), camera, spp=1024, max_depth=max_depth)[0].mean()
    deeper = path_trace(relight(mesh, light), camera, spp=1024, max_depth=max_depth + 1)[0].mean()
    assert relit == pytest.approx(reference, rel=0.01)
    assert deeper > 1.03 * reference, "the bowl must tell the depths apart"


def test_lambert_and_an_open_sky_are_closed_forms():
    """A plane sees the whole upper sky and no terrain."""
    view = trace_view(ray_scene(mi_mesh(PLANE, ALBEDO)), looking_down(size=12), QUICK)
    ready = relightable_view(ray_scene(mi_mesh(PLANE, ALBEDO)), view)
    sky = uniform_sky(1000.0)
    light = Illumination(sky.sky_radiance, sun_at(140.0, 35.0).sun)
    expected = ALBEDO / np.pi * 1.0e5 * np.sin(np.radians(35.0)) + ALBEDO * 1000.0
    np.testing.assert_allclose(
        relight_view(ready, light).surface.reshape(-1, 3), np.tile(expected, (144, 1)), rtol=3e-3
    )


def test_white_furnace_in_a_bowl():
    """With white walls and a white sky nothing can be seen; what four bounces leave out is under a hundredth."""
    bowl = heightfield(lambda e, n: 0.0005 * (e**2 + n**2), count=61)
    mesh = mi_mesh(bowl, np.ones(3), smooth=False)
    view = trace_view(
        ray_scene(mesh), looking_down(300.0, size=24, view_m=300.0), SamplingOptions(rays=256, bounces=12, clusters=512)
    )
    image = relight_view(relightable_view(ray_scene(mesh), view), uniform_sky(1.0)).surface
    assert np.abs(image - 1.0).max() < 0.02
    assert image.mean() == pytest.approx(1.0, abs=0.003)


def test_penumbra_is_as_wide_as_the_disc():
    """Behind the edge of a cliff 200 m high, the sun's disc sets over its own width on the plane."""
    terrain = heightfield(lambda e, n: np.where(e > 0.0, 200.0, 0.0), side_m=4000.0, count=4001 // 8)
    mesh = mi_mesh(terrain, np.ones(3), smooth=False)
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(0.0, -90.0)
    pose[:3, 3] = [-200.0, 0.0, 1500.0]
    camera = Camera(256, 8, 256 * 15.0, 256 * 15.0, 128.0, 4.0, pose)  # 100 m wide
    light = sun_at(90.0, 45.0, radius_deg=2.0)
    view = trace_view(ray_scene(mesh), camera, SamplingOptions(rays=64, shadow_samples=64, bounces=0, clusters=1))
    profile = relight_view(relightable_view(ray_scene(mesh), view), light).surface[..., 1].mean(axis=0)
    profile /= 1.0e5 / np.pi * np.sin(np.radians(45.0))
    edge_m = terrain.vertices[terrain.vertices[:, 2] > 100.0][:, 0].min()
    east_m = -200.0 + (np.arange(256) + 0.5 - 128.0) * 100.0 / 256
    # Share of a disc above the chord at angle a below its centre.
    a = np.clip((np.degrees(np.arctan2(200.0, edge_m - east_m)) - 45.0) / 2.0, -1.0, 1.0)
    visible = (np.arccos(a) - a * np.sqrt(1.0 - a**2)) / np.pi
    assert 0.1 < visible.mean() < 0.9
    assert np.abs(profile - visible).mean() < 0.01
    assert np.abs(profile - visible).max() < 0.08


def test_air_and_background_are_those_of_render_view():
    class Fog:
        """Koschmieder's homogeneous fog of 3 km visibility."""

        def __call__(self, depth_m, direction):
            transmittance = np.exp(-3.912 / 3000.0 * np.asarray(depth_m))[..., None] * np.ones(3)
            return transmittance, 5000.0 * (1.0 - transmittance)

    light = Illumination(gradient_sky(), sun_at(20.0, 12.0).sun, aerial_perspective=Fog())
    mesh = mi_mesh(heightfield(lambda e, n: 80.0 * np.cos(e / 60.0) * np.cos(n / 60.0)), ALBEDO)
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(20.0, 0.0)
    pose[:3, 3] = [-100.0, -450.0, 120.0]
    camera = Camera(96, 64, 90.0, 90.0, 48.0, 32.0, pose)
    reference = render_view(relight(mesh, light), camera, spp=256)
    view = relight_view(
        relightable_view(ray_scene(mesh), trace_view(ray_scene(mesh), camera, SamplingOptions(clusters=2048))), light
    )
    assert np.abs(view.coverage - reference.coverage).max() < 0.2
    open_sky = (view.coverage == 0.0) & (reference.coverage == 0.0)
    assert 0.2 < open_sky.mean() < 0.8
    np.testing.assert_allclose(view.radiance[open_sky], reference.radiance[open_sky], rtol=2e-3)
    hidden = (view.coverage == 1.0) & (reference.coverage == 1.0)
    error = np.abs(view.radiance - reference.radiance)[hidden]
    assert np.sqrt((error**2).mean()) < 0.03 * reference.radiance[hidden].mean()
    edge = ~open_sky & ~hidden
    assert np.abs(view.radiance - reference.radiance)[edge].mean() < 0.05 * reference.radiance[edge].mean()


def test_another_albedo_in_place_of_the_first():
    """A season's change of colour is a product, and exact where albedo does not vary within the pixel."""
    texture = np.full((8, 8, 3), 0.2, np.float32)
    mesh = mi_mesh(PLANE, texture)
    terrain, camera = ray_scene(mesh), looking_down(size=8)
    view = trace_view(terrain, camera, QUICK)
    scene = relight(mesh, uniform_sky(1.0))
    set_albedo(scene, 3.0 * texture)
    np.testing.assert_allclose(view_albedo(terrain, view), 3.0 * view.albedo, rtol=1e-5)


def test_irradiance_of_places():
    """Sun, sky and bounce of texels on a ridge against path tracing of a white surface there."""
    mesh = mi_mesh(heightfield(lambda e, n: 100.0 * np.cos(e / 90.0), count=201), ALBEDO, smooth=False)
    terrain, light = ray_scene(mesh), LIGHTS["sun"]
    east = np.linspace(-251.3, 248.9, 41)
    place = np.stack([east, np.full(41, 7.0), 100.0 * np.cos(east / 90.0)], axis=-1)
    place[3] = np.nan
    points, index = surface_at(terrain, place)
    assert sorted(set(range(41)) - set(index)) == [3]
    coefficients = trace_points(terrain, points, SamplingOptions(rays=1024, clusters=2048, clusters_per_receiver=128))
    received = irradiance(upload_points(terrain, coefficients), light, sun_rays_per_point=64)
    # Looking straight down with pixels of a millimetre: radiance = albedo / π · E.
    scene = relight(mesh, light)
    total, direct = np.empty((40, 3)), np.empty((40, 3))
    for k in range(40):
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_angles(0.0, -90.0)
        pose[:3, 3] = place[index[k]] + [0.0, 0.0, 10.0]
        camera = Camera(1, 1, 1e4, 1e4, 0.5, 0.5, pose)
        total[k] = path_trace(scene, camera, spp=1 << 15)[0][0, 0] * np.pi / ALBEDO
        direct[k] = path_trace(scene, camera, spp=1 << 14, max_depth=2)[0][0, 0] * np.pi / ALBEDO
    np.testing.assert_allclose(received.sun + received.sky, direct, rtol=0.03, atol=200.0)
    np.testing.assert_allclose(received.total, total, rtol=0.08)
    # 128 listed senders leave some 15 % of noise in each bounce, 2.3 % in the mean of 40: twice that is allowed.
    np.testing.assert_allclose(received.bounce.mean(axis=0), (total - direct).mean(axis=0), rtol=0.05)


def test_blocks_of_places_equal_all_at_once(monkeypatch):
    from seasonscapes.rendering import irradiance as module

    mesh = mi_mesh(heightfield(lambda e, n: 100.0 * np.cos(e / 90.0)), ALBEDO)
    grid = np.linspace(-300.0, 300.0, 40)
    place = np.array([(e, n, 100.0 * np.cos(e / 90.0)) for e, n in itertools.product(grid, grid)])
    place[::7] = np.nan
    lights = [LIGHTS["sun"], LIGHTS["uniform sky"]]

    def run() -> np.ndarray:
        total = np.full((2, len(place), 3), np.nan, np.float32)
        for index, _, results in irradiance_blocks(ray_scene(mesh), place, lights, QUICK):
            for k, result in enumerate(results):
                total[k, index] = result.total
        return total

    whole = run()
    monkeypatch.setattr(module, "BLOCK", 333)
    np.testing.assert_array_equal(np.isnan(whole[0, :, 0]), np.isnan(place[:, 0]))
    np.testing.assert_allclose(run(), whole, rtol=1e-5)


def test_saved_coefficients_light_the_same_picture(valley, tmp_path):
    mesh, _, ready = valley
    key = "its inputs"
    save_coefficients(tmp_path / "view", ready.coefficients, key=key)
    save_coefficients(tmp_path / "view", ready.coefficients, key=key)  # replaces
    assert [path.name for path in tmp_path.iterdir()] == ["view"], "nothing is left beside it"
    again = load_coefficients(tmp_path / "view", key=key)
    assert isinstance(again.sample_origin, np.memmap), "mapped, not read"
    light = LIGHTS["low sun"]
    np.testing.assert_array_equal(
        relight_view(relightable_view(ray_scene(mesh), again), light).radiance, relight_view(ready, light).radiance
    )
    with pytest.raises(ValueError, match="expected other"):
        load_coefficients(tmp_path / "view", key="other")
    with pytest.raises(FileNotFoundError):
        load_coefficients(tmp_path / "nothing")


def test_interrupted_save_leaves_the_old_one(valley, tmp_path, monkeypatch):
    _, _, ready = valley
    save_coefficients(tmp_path / "view", ready.coefficients, key="first")
    calls = iter([None, None])

    def fail(path, array):
        next(calls)  # the third one raises StopIteration, as a full disk would raise something else

    monkeypatch.setattr(np, "save", fail)
    with pytest.raises(StopIteration):
        save_coefficients(tmp_path / "view", ready.coefficients, key="second")
    assert [path.name for path in tmp_path.iterdir()] == ["view"]
    load_coefficients(tmp_path / "view", key="first")


@pytest.mark.parametrize("name", SUBDIVISIONS)
def test_patches_tile_the_sphere(name):
    patches = sky_patches(name)
    assert (patches.directions[:, 2] > 0.0).sum() == {"tregenza": 145, "reinhart": 577}[name]
    assert patches.solid_angle_sr.sum() == pytest.approx(4.0 * np.pi)
    rng = np.random.default_rng(5)
    direction = rng.normal(size=(200_000, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    patch = patch_of(patches, direction)
    share = np.bincount(patch, minlength=patches.size) / len(patch)
    expected = patches.solid_angle_sr / (4.0 * np.pi)
    assert np.all(np.abs(share - expected) < 6.0 * np.sqrt(expected / len(patch)))
    np.testing.assert_array_equal(patch_of(patches, patches.directions), np.arange(patches.size))
    from seasonscapes.rendering.backend import point3

    import mitsuba as mi  # isort: skip

    lanes = np.array(mi_patch_of(patches, mi.Vector3f(point3(direction))))
    assert np.mean(lanes == patch) > 0.9999, "float32 decides otherwise on an edge at most"


def test_patch_means_keep_energy():
    patches = sky_patches("reinhart")
    rng = np.random.default_rng(1)
    sky = rng.random((50, 100, 3))
    edges = np.sin(np.radians(90.0 - np.arange(51) * 3.6))
    total = np.einsum("h,hwc->c", -np.diff(edges) * 2.0 * np.pi / 100, sky)
    mean = patch_radiance(patches, sky)
    np.testing.assert_allclose(patches.solid_angle_sr @ mean, total, rtol=1e-6)


def test_direction_weights_have_no_steps():
    patches = sky_patches("tregenza")
    path = direction_from_angles(np.linspace(0.0, 359.0, 4000), np.linspace(-5.0, 80.0, 4000))
    weights = np.array([direction_weights(patches, direction) for direction in path])
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    assert np.abs(np.diff(weights, axis=0)).max() < 0.05


def test_sender_lists_are_in_proportion():
    rng = np.random.default_rng(2)
    met = rng.integers(-2, 6, (400, 64)).astype(np.int32)
    weight = rng.random((400, 64)).astype(np.float32)
    weight /= weight.sum(axis=1, keepdims=True)
    listed, share = cluster_lists(met, weight, 32, start=rng.random(400, np.float32))
    np.testing.assert_allclose(share, np.where(met >= 0, weight, 0.0).sum(axis=1), rtol=1e-5)
    for cluster in range(6):
        exact = np.where(met == cluster, weight, 0.0).sum(axis=1)
        estimate = (listed == cluster).mean(axis=1) * share
        assert estimate.mean() == pytest.approx(exact.mean(), rel=0.02)
    met[0] = -1
    listed, share = cluster_lists(met, weight, 32, start=rng.random(400, np.float32))
    assert share[0] == 0.0
    assert listed[0].max() == 0


@pytest.mark.parametrize(
    "wrong", [{"shadow_samples": 15}, {"rays": 100}, {"rays": 8}, {"clusters_per_receiver": 3}, {"clusters": 1 << 17}]
)
def test_sampling_options_refuse(wrong):
    with pytest.raises(ValueError, match="SamplingOptions"):
        SamplingOptions(**wrong)


def test_a_camera_that_sees_no_terrain_is_told():
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(0.0, 60.0)
    pose[:3, 3] = [0.0, 0.0, 100.0]
    with pytest.raises(ValueError, match="sees no terrain"):
        trace_view(ray_scene(mi_mesh(PLANE, ALBEDO)), Camera(8, 8, 8.0, 8.0, 4.0, 4.0, pose), QUICK)
