"""Water: Fresnel's equations, energy, the geometry of mirror images, and both engines."""

from dataclasses import replace

import numpy as np
import pytest
from test_rendering import FRAME, heightfield, looking_down, sun_at

from seasonscapes.cameras.pinhole import Camera, ray_directions, rotation_from_angles
from seasonscapes.frames import MEAN_RADIUS_M, equirectangular_directions
from seasonscapes.rendering.backend import use_backend
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.coefficients_file import load_coefficients, save_coefficients
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mirrored_light import WaveBlur
from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight, set_albedo
from seasonscapes.rendering.morton import morton_order
from seasonscapes.rendering.radiance import path_trace
from seasonscapes.rendering.relit_view import (
    cluster_albedo,
    mirrored_albedo,
    relight_view,
    relightable_view,
    with_albedo,
)
from seasonscapes.rendering.transport import trace_view, view_albedo
from seasonscapes.rendering.water_surface import (
    REFRACTIVE_INDEX,
    DeviceWater,
    diffuse_reflectance,
    fresnel_reflectance,
    slope_variance,
)
from seasonscapes.sky.illumination import Illumination, uniform_sky
from seasonscapes.terrain.surface_classes import Water

ALBEDO = np.array([0.35, 0.3, 0.2])
CURVATURE = (1.0 - FRAME.refraction_k) / MEAN_RADIUS_M
SIDE_M = 2400.0


def ridge_m(east, north):
    """A crest of varying height north of a lake at height 0."""
    return (260.0 + 60.0 * np.sin(east / 130.0)) * np.exp(-(((north - 750.0) / 160.0) ** 2)) - 12.0


def lakeside(wind_m_s, *, count=241):
    """The ridge beside a lake that follows the curvature of the Earth."""
    terrain = heightfield(
        lambda e, n: np.maximum(ridge_m(e, n), 0.0) - 0.5 * CURVATURE * (e**2 + n**2), side_m=SIDE_M, count=count
    )
    axis = (np.arange(1024) + 0.5) / 1024 * SIDE_M - SIDE_M / 2
    mask = (ridge_m(axis[None, :], -axis[:, None]) < 0.0).astype(np.float32)
    return replace(terrain, water=Water(mask, wind_m_s))


def at_the_shore(width=192, height=144, up_m=12.0) -> Camera:
    """A camera over the south of the lake that sees the ridge and its image."""
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(4.0, -2.0)
    pose[:3, 3] = [0.0, -900.0, up_m]
    return Camera(width, height, 210.0, 210.0, width / 2, height / 2, pose)


def bright_south() -> np.ndarray:
    """A sky that is brighter towards the zenith and the north, dark below the horizon."""
    direction = equirectangular_directions(64, 128)
    sky = np.where(direction[..., 2:] > 0, 2500.0 + 1500.0 * direction[..., 1:2] + 2000.0 * direction[..., 2:], 0.0)
    return (sky * [0.8, 1.0, 1.3]).astype(np.float32)


def test_fresnel_is_the_closed_form():
    """Against Fresnel's equations in sines and tangents of the angles, and the device against both."""
    use_backend()
    import mitsuba as mi

    angle = np.radians(np.linspace(1.0, 89.5, 60))
    inside = np.arcsin(np.sin(angle) / REFRACTIVE_INDEX)
    closed = 0.5 * (
        (np.sin(angle - inside) / np.sin(angle + inside)) ** 2 + (np.tan(angle - inside) / np.tan(angle + inside)) ** 2
    )
    np.testing.assert_allclose(fresnel_reflectance(np.cos(angle)), closed, rtol=1e-9)
    water = DeviceWater(Water(np.ones((2, 2), np.float32), 0.0), FRAME)
    viewer = mi.Vector3f(mi.Float(np.sin(angle)), 0.0, mi.Float(np.cos(angle)))
    direction, reflectance = water.mirrored(mi.Normal3f(0.0, 0.0, 1.0), viewer, mi.Point2f(0.5, 0.5))
    np.testing.assert_allclose(np.array(reflectance), closed, atol=2e-6)
    expected = np.stack([-np.sin(angle), 0.0 * angle, np.cos(angle)])
    np.testing.assert_allclose(np.array(direction), expected, atol=1e-6)
    # Jerlov's 6.6 % for diffuse light on flat water.
    assert diffuse_reflectance() == pytest.approx(0.066, abs=0.001)


@pytest.mark.parametrize("elevation_deg", [75.0, 20.0, 4.0])
def test_waves_reflect_what_their_facets_do(elevation_deg):
    """Glitter, integrated over all lights, is the mean reflectance of the facets that are seen: within 0.5 %."""
    use_backend()
    import drjit as dr
    import mitsuba as mi

    from seasonscapes.rendering.sobol import sobol_pair

    water = DeviceWater(Water(np.ones((2, 2), np.float32), 6.0), FRAME)
    angle = float(np.radians(elevation_deg))
    viewer, up = mi.Vector3f(float(np.cos(angle)), 0.0, float(np.sin(angle))), mi.Normal3f(0.0, 0.0, 1.0)
    square = sobol_pair(mi.UInt32(5), dr.arange(mi.UInt32, 1 << 20))
    direction, reflectance = water.mirrored(up, viewer, square)
    light = mi.warp.square_to_uniform_hemisphere(square)
    integral = 2.0 * np.pi * float(np.array(water.glitter(up, viewer, light)).mean())
    assert integral == pytest.approx(float(np.array(reflectance).mean()), rel=0.005)
    assert float(np.array(direction)[2].min()) >= 0.0
    # Seen from above, the facets' slopes are those of Cox & Munk.
    down = mi.Vector3f(0.0, 0.0, 1.0)
    reflected = np.array(water.mirrored(up, down, square)[0])
    slope2 = np.tan(0.5 * np.arccos(np.clip(reflected[2], -1.0, 1.0))) ** 2
    assert slope2.mean() == pytest.approx(slope_variance(6.0), rel=0.02)


@pytest.mark.parametrize("wind_m_s", [0.0, 6.0])
def test_a_furnace_hides_water(wind_m_s):
    """Water over a white body, under a white sky, cannot be seen: what is not mirrored comes out of the body."""
    plane = heightfield(lambda e, n: -0.5 * CURVATURE * (e**2 + n**2), side_m=4000.0, count=3)
    plane = replace(plane, water=Water(np.ones((4, 4), np.float32), wind_m_s))
    camera = Camera(48, 32, 60.0, 60.0, 24.0, 16.0, at_the_shore().world_from_camera)
    camera.world_from_camera[:3, :3] = rotation_from_angles(0.0, -35.0)
    mesh = mi_mesh(plane, np.ones(3))
    image, coverage = path_trace(relight(mesh, uniform_sky(1.0)), camera, spp=64)
    np.testing.assert_allclose(image, coverage[..., None] * np.ones(3), atol=1e-4)
    view = trace_view(ray_scene(mesh), camera, SamplingOptions(rays=128, clusters=64, bounces=1))
    relit = relight_view(relightable_view(ray_scene(mesh), view), uniform_sky(1.0)).surface
    assert relit.mean() == pytest.approx(1.0, abs=0.005)


LIGHTS = {
    "sky": Illumination(bright_south()),
    "sun in the south": Illumination(0.3 * bright_south(), sun_at(170.0, 40.0).sun),
    "sun over the ridge": Illumination(bright_south(), sun_at(5.0, 24.0, 3.0e4).sun),
}


@pytest.mark.parametrize("wind_m_s", [0.0, 5.0])
@pytest.mark.parametrize("light", LIGHTS)
def test_both_engines_agree_on_water(light, wind_m_s):
    mesh, camera = mi_mesh(lakeside(wind_m_s, count=121), ALBEDO), at_the_shore(96, 72)
    camera = replace(camera, fx=105.0, fy=105.0)
    reference, _ = path_trace(relight(mesh, LIGHTS[light]), camera, spp=512)
    view = trace_view(
        ray_scene(mesh), camera, SamplingOptions(rays=128, clusters=1024, clusters_per_receiver=32), seed=2
    )
    relit = relight_view(relightable_view(ray_scene(mesh), view), LIGHTS[light]).surface
    lake = np.zeros(72 * 96, bool)
    assert view.mirror is not None
    lake[view.pixel[view.mirror.pixel[view.mirror.water_weight.sum(axis=1) == 1.0]]] = True
    lake = lake.reshape(72, 96)
    assert 0.2 < lake.mean() < 0.7
    assert relit[lake].mean() == pytest.approx(reference[lake].mean(), rel=0.02)
    assert relit[~lake].mean() == pytest.approx(reference[~lake].mean(), rel=0.02)
    # Pixel by pixel, but for the sun's image.
    dim = lake & (reference.max(axis=2) < 4.0 * np.median(reference[lake]))
    assert np.abs(relit - reference)[dim].mean() < 0.06 * reference[dim].mean()


def test_the_ridge_is_mirrored_where_geometry_says():
    """The crest's image in the lake, to 0.5 pixel, against rays that are followed over the formula of the heights."""
    mesh, camera = mi_mesh(lakeside(0.0), np.zeros(3)), at_the_shore()
    image, _ = path_trace(relight(mesh, uniform_sky(1.0)), camera, spp=64)
    view = trace_view(ray_scene(mesh), camera, SamplingOptions(rays=64, shadow_samples=16, clusters=64, bounces=1))
    relit = relight_view(relightable_view(ray_scene(mesh), view), uniform_sky(1.0)).surface
    for picture in (image, relit):
        rows = []
        for column in range(8, camera.width_px, 12):
            # Black ground: water is as bright as the sky that it mirrors, times its reflectance.
            fine = np.arange(80.0, camera.height_px, 0.1) + 0.05
            expected = mirrored_sky(camera, column + 0.5, fine)
            profile = picture[:, column, 1]
            below = np.flatnonzero(expected)[0]
            full = fresnel_reflectance(np.sin(np.arctan(-slope_of(camera, column + 0.5, fine[below]))))
            row = int(fine[below])
            # Sub-pixel position: the share of the pixel rows about it that mirrors sky.
            found = row + 2 - float(profile[row - 1 : row + 2].sum() / full)
            rows.append(found - fine[below])
        assert np.abs(rows).max() < 0.5
        assert abs(np.mean(rows)) < 0.2


def slope_of(camera, column, row):
    direction = ray_directions(camera, np.array([[column, row]]))[0]
    return direction[2] / np.hypot(direction[0], direction[1])


def mirrored_sky(camera, column, rows):
    """Whether rays through a column of the picture reach the sky by way of still water."""
    pixel = np.stack([np.full_like(rows, column), rows], axis=-1)
    direction = ray_directions(camera, pixel)
    eye = camera.position_m
    result = np.zeros(len(rows), bool)
    for k, towards in enumerate(direction):
        if towards[2] >= 0.0:
            continue
        distance = -eye[2] / towards[2]
        for _ in range(20):
            point = eye + distance * towards
            distance -= (point[2] + 0.5 * CURVATURE * (point[0] ** 2 + point[1] ** 2)) / towards[2]
        point = eye + distance * towards
        if max(abs(point[0]), abs(point[1])) > SIDE_M / 2 or ridge_m(point[0], point[1]) > 0.0:
            continue
        normal = np.array([CURVATURE * point[0], CURVATURE * point[1], 1.0])
        normal /= np.linalg.norm(normal)
        up = towards - 2.0 * (towards @ normal) * normal
        along = point + np.arange(5.0, 3000.0, 1.0)[:, None] * up
        inside = (np.abs(along[:, :2]) < SIDE_M / 2).all(axis=1)
        ground = np.maximum(ridge_m(along[:, 0], along[:, 1]), 0.0)
        ground -= 0.5 * CURVATURE * (along[:, 0] ** 2 + along[:, 1] ** 2)
        result[k] = not (inside & (along[:, 2] < ground)).any()
    return result


def test_mirrored_ground_wears_the_albedo_of_the_day(tmp_path):
    """Another albedo over stored coefficients gives what tracing with it gives."""
    rng = np.random.default_rng(4)
    first, second = (rng.uniform(0.1, 0.6, (16, 16, 3)).astype(np.float32) for _ in range(2))
    terrain, camera = lakeside(3.0, count=121), replace(at_the_shore(96, 72), fx=105.0, fy=105.0)
    options = SamplingOptions(rays=64, clusters=256, clusters_per_receiver=32)
    scene = ray_scene(mi_mesh(terrain, first))
    save_coefficients(tmp_path / "view", trace_view(scene, camera, options))
    stored = load_coefficients(tmp_path / "view")
    assert stored.mirror is not None
    ready = relightable_view(scene, stored)
    set_albedo(scene, second)
    dressed = with_albedo(
        ready, view_albedo(scene, stored), cluster_albedo(scene, stored), mirrored_albedo(scene, stored)
    )
    other = ray_scene(mi_mesh(terrain, second))
    anew = relightable_view(other, trace_view(other, camera, options))
    light = LIGHTS["sun in the south"]
    images = [relight_view(view, light).surface for view in (ready, dressed, anew)]
    difference = [np.abs(image - images[2]).mean() / images[2].mean() for image in images]
    assert difference[1] < 0.03
    assert difference[0] > 4.0 * difference[1]


def test_views_without_water_are_as_before():
    mesh = mi_mesh(heightfield(lambda e, n: 0.0 * e, count=3), ALBEDO)
    view = trace_view(ray_scene(mesh), looking_down(size=8), SamplingOptions(rays=64, clusters=16))
    assert view.mirror is None
    assert relightable_view(ray_scene(mesh), view).mirror is None


def test_the_filter_of_rough_water_keeps_the_light_and_takes_the_grain():
    """On an L of water pixels, some of which hold a bit of shore: light only goes from one to the other."""
    row, column = np.nonzero(np.tri(40, 30) > 0.0)
    generator = np.random.default_rng(5)
    whole = (generator.random(len(row)) < 0.9).astype(np.float32)
    blur = WaveBlur(row, column, 2.0, whole, 0.5 * whole)
    grain = (1.0 + 0.3 * generator.standard_normal((len(row), 3))).astype(np.float32)
    filtered = blur.applied(grain)
    np.testing.assert_allclose(filtered.sum(axis=0), grain.sum(axis=0), rtol=1e-5)
    np.testing.assert_allclose(blur.applied(np.full_like(grain, 2.5)), 2.5, rtol=1e-5)
    np.testing.assert_array_equal(filtered[whole == 0.0], grain[whole == 0.0])
    assert filtered[whole > 0.0].std() < 0.5 * 0.3


def test_pixels_along_a_morton_curve_fill_aligned_squares():
    row, column = np.mgrid[0:8, 0:8]
    order = morton_order(column, row)
    assert sorted(order.ravel()) == list(range(64))
    for side in (2, 4):
        blocks = (order // side**2).reshape(8 // side, side, 8 // side, side)
        assert (blocks == blocks[:, :1, :, :1]).all()
