"""Snow: energy, reciprocity, published albedos, and both engines."""

from dataclasses import replace

import numpy as np
import pytest
from oracles_snow import wiscombe_warren_albedo
from test_rendering import heightfield, looking_down, sun_at

from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight
from seasonscapes.rendering.radiance import path_trace
from seasonscapes.rendering.relit_view import relight_view, relightable_view
from seasonscapes.rendering.snow_scattering import ICE_ABSORPTION, SnowOptics, escape_function, reflectance, snow_albedo
from seasonscapes.sky.illumination import Illumination, uniform_sky
from seasonscapes.terrain.surface_classes import Snow


def directions():
    """Gauss-Legendre nodes of the cosine with weights of cosine-weighted integrals, and azimuths."""
    node, weight = np.polynomial.legendre.leggauss(40)
    return 0.5 * (node + 1.0), 0.5 * weight * (node + 1.0), (np.arange(720) + 0.5) * np.pi / 720


def plane_albedo(cosine_in, albedo):
    """Reflected share of light from one direction, by summing over all viewers."""
    cosine, weight, azimuth = directions()
    sines = np.sqrt(1.0 - cosine**2) * np.sqrt(1.0 - cosine_in**2)
    between = cosine[:, None] * cosine_in + sines[:, None] * np.cos(azimuth)
    return float(weight @ reflectance(cosine[:, None], cosine_in, between, albedo).mean(axis=1))


@pytest.mark.parametrize("cosine", [0.08, 0.3, 0.6, 1.0])
def test_white_snow_is_a_furnace(cosine):
    assert plane_albedo(cosine, 1.0) == pytest.approx(1.0, abs=0.005)


@pytest.mark.parametrize("albedo", [0.98, 0.9, 0.8])
def test_albedo_is_that_of_the_theory(albedo):
    """Integrated over viewers, what is left is exp(−α K); over the sun's directions too, the spherical albedo."""
    cosine, weight, _ = directions()
    planes = np.array([plane_albedo(each, albedo) for each in cosine])
    np.testing.assert_allclose(planes[cosine > 0.05], albedo ** escape_function(cosine[cosine > 0.05]), atol=0.006)
    assert float(weight @ planes) == pytest.approx(albedo, abs=0.003)


def test_light_and_viewer_may_change_places():
    rng = np.random.default_rng(2)
    one, other = rng.uniform(0.03, 1.0, (2, 500))
    between = np.clip(one * other + np.sqrt(1 - one**2) * np.sqrt(1 - other**2) * rng.uniform(-1, 1, 500), -1, 1)
    np.testing.assert_allclose(
        reflectance(one, other, between, 0.85), reflectance(other, one, between, 0.85), rtol=1e-12
    )
    # Forwards it is brighter than back, the more the lower the sun.
    low = np.cos(np.radians(75.0))
    forward, back = (low**2 + np.sin(np.radians(75.0)) ** 2 * sign for sign in (-1.0, 1.0))
    assert reflectance(low, low, forward, 0.9) > 1.5 * reflectance(low, low, back, 0.9)


@pytest.mark.parametrize("radius_um", [50.0, 200.0, 1000.0])
def test_albedo_agrees_with_wiscombe_and_warren(radius_um):
    """Within 0.03 from blue to the near infrared, for high and low suns; the visible one of pure snow is 96 to 99 %."""
    for wavelength, index in ICE_ABSORPTION.items():
        for cosine in (0.3, 0.5, 0.8):
            published = wiscombe_warren_albedo(radius_um * 1e-6, wavelength, index, cosine)
            ours = snow_albedo(2.0 * radius_um * 1e-3, np.array(cosine), (wavelength,))[0]
            assert ours == pytest.approx(published, abs=0.03)
    assert snow_albedo(0.4).min() > 0.96
    assert snow_albedo(0.2)[2] < 1.0


def test_snow_is_told_by_its_colour():
    red, green, blue = np.array(
        [[0.85, 0.86, 0.88], [0.6, 0.62, 0.65], [0.3, 0.3, 0.3], [0.6, 0.5, 0.35], [0.03, 0.05, 0.06]]
    ).T
    share = SnowOptics.share(red, green, blue)
    assert share[0] == share[1] == 1.0
    assert (share[2:] == 0.0).all()


def over_a_slope(size=32) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(0.0, -42.0)
    pose[:3, 3] = [0.0, -420.0, 330.0]
    return Camera(size, size, 60.0 * size / 24, 60.0 * size / 24, size / 2, size / 2, pose)


@pytest.mark.parametrize("sun", [(180.0, 50.0), (340.0, 25.0)])
def test_both_engines_agree_on_snow(sun):
    hill = heightfield(lambda e, n: 60.0 * np.cos(e / 120.0) * np.cos(n / 150.0), side_m=2000.0, count=101)
    hill = replace(hill, snow=Snow())
    mesh, camera = mi_mesh(hill, np.array([0.80, 0.82, 0.85])), over_a_slope()
    light = Illumination(uniform_sky(3000.0).sky_radiance, sun_at(*sun).sun)
    reference, coverage = path_trace(relight(mesh, light), camera, spp=1024)
    view = trace(mesh, camera)
    relit = relight_view(relightable_view(ray_scene(mesh), view), light).surface
    assert coverage.min() > 0.99
    assert relit.mean() == pytest.approx(reference.mean(), rel=0.02)
    assert np.abs(relit - reference).mean() < 0.03 * reference.mean()
    matt = mi_mesh(replace(hill, snow=None), np.array([0.80, 0.82, 0.85]))
    plain = relight_view(relightable_view(ray_scene(matt), trace(matt, camera)), light).surface
    # The test would not tell the models apart otherwise.
    assert np.abs(plain - reference).mean() > 0.02 * reference.mean()


def test_rims_of_snow_have_no_sparks():
    """A pixel on a rim whose mean normal faces away from a low sun is no brighter than its sunlit part can be."""
    ridges = heightfield(lambda e, n: 40.0 * np.abs(np.sin(e / 90.0 + n / 140.0)), side_m=2000.0, count=161)
    mesh, camera = mi_mesh(replace(ridges, snow=Snow()), np.array([0.80, 0.82, 0.85])), over_a_slope()
    light = Illumination(uniform_sky(300.0).sky_radiance, sun_at(250.0, 6.0).sun)
    relit = relight_view(relightable_view(ray_scene(mesh), trace(mesh, camera)), light).surface
    reference, _ = path_trace(relight(mesh, light), camera, spp=256)
    assert relit.max() < 1.3 * reference.max()


def trace(mesh, camera):
    from seasonscapes.rendering.transport import trace_view

    options = SamplingOptions(rays=128, clusters=512, clusters_per_receiver=32)
    return trace_view(ray_scene(mesh), camera, options)


def test_clean_snow_takes_the_place_of_the_texture():
    """Seen from above under an even sky, snow of stated grains has their albedo for light that leaves upwards."""
    plane = heightfield(lambda e, n: 0.0 * e, count=3)
    mesh = mi_mesh(replace(plane, snow=Snow(1.0)), np.array([0.7, 0.72, 0.75]))
    image, _ = path_trace(relight(mesh, uniform_sky(1.0)), looking_down(size=8, view_m=10.0), spp=512)
    expected = snow_albedo(1.0) ** escape_function(1.0)
    np.testing.assert_allclose(image.reshape(-1, 3).mean(axis=0), expected, atol=0.006)
