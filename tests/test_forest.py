"""Forest with a hot spot: kernels, energy, reciprocity, both engines, and the scene file."""

from dataclasses import replace

import numpy as np
import pytest
from test_rendering import heightfield, sun_at
from test_snow import over_a_slope, trace

from seasonscapes.rendering.forest_scattering import ForestOptics, diffuse_means, kernels, relative_reflectance
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight
from seasonscapes.rendering.radiance import path_trace
from seasonscapes.rendering.relit_view import relight_view, relightable_view
from seasonscapes.sky.illumination import Illumination, uniform_sky
from seasonscapes.terrain.surface import load_terrain, save_terrain

CANOPY = np.array([0.035, 0.055, 0.025])


def kernels_by_angles(view_deg: float, sun_deg: float, azimuth_deg: float) -> tuple[float, float]:
    """The kernels as the algorithm document of the MODIS product writes them, in angles (h/b = 2, b/r = 1)."""
    view, sun, azimuth = np.radians([view_deg, sun_deg, azimuth_deg])
    phase = np.arccos(np.cos(view) * np.cos(sun) + np.sin(view) * np.sin(sun) * np.cos(azimuth))
    ross = ((np.pi / 2 - phase) * np.cos(phase) + np.sin(phase)) / (np.cos(view) + np.cos(sun))
    ross = ross * (1.0 + 1.0 / (1.0 + np.degrees(phase) / 1.5)) - np.pi / 4
    distance = np.tan(view) ** 2 + np.tan(sun) ** 2 - 2.0 * np.tan(view) * np.tan(sun) * np.cos(azimuth)
    secants = 1.0 / np.cos(view) + 1.0 / np.cos(sun)
    across = (np.tan(view) * np.tan(sun) * np.sin(azimuth)) ** 2
    turn = np.arccos(min(2.0 * np.sqrt(max(distance, 0.0) + across) / secants, 1.0))
    overlap = (turn - np.sin(turn) * np.cos(turn)) * secants / np.pi
    return ross, overlap - secants + 0.5 * (1.0 + np.cos(phase)) / np.cos(view) / np.cos(sun)


@pytest.mark.parametrize(
    ("view", "sun", "azimuth"), [(0, 0, 0), (30, 45, 0), (30, 45, 70), (60, 20, 180), (65, 70, 130)]
)
def test_kernels_are_the_published_ones(view, sun, azimuth):
    between = np.cos(np.radians(view)) * np.cos(np.radians(sun))
    between += np.sin(np.radians(view)) * np.sin(np.radians(sun)) * np.cos(np.radians(azimuth))
    ours = kernels(np.cos(np.radians(view)), np.cos(np.radians(sun)), between)
    np.testing.assert_allclose(ours, kernels_by_angles(view, sun, azimuth), atol=2e-7)


def test_light_is_neither_lost_nor_made():
    """Over all directions of light and viewer, by other nodes than those of the scaling, each channel keeps its albedo."""
    rng = np.random.default_rng(4)
    count = 400_000
    # Cosines whose density is that of cosine-weighted directions.
    out, into = np.sqrt(rng.uniform(0.0, 1.0, (2, count)))
    sines = np.sqrt(1.0 - out**2) * np.sqrt(1.0 - into**2)
    relative = relative_reflectance(out, into, out * into + sines * np.cos(rng.uniform(0.0, np.pi, count)))
    np.testing.assert_allclose([channel.mean() for channel in relative], 1.0, atol=0.004)
    # Towards one viewer, light from everywhere is what `relative_diffuse` says.
    out = np.full(count, 0.6)
    sines = 0.8 * np.sqrt(1.0 - into**2)
    relative = relative_reflectance(out, into, out * into + sines * np.cos(rng.uniform(0.0, np.pi, count)))
    diffuse = ForestOptics().relative_diffuse(list(CANOPY), np.array(0.6))
    np.testing.assert_allclose([channel.mean() for channel in relative], diffuse, atol=0.004)
    assert all(0.85 < mean < 1.0 for mean in diffuse_means())


def test_light_and_viewer_may_change_places():
    rng = np.random.default_rng(2)
    one, other = rng.uniform(0.03, 1.0, (2, 500))
    between = one * other + np.sqrt(1 - one**2) * np.sqrt(1 - other**2) * np.cos(rng.uniform(0.0, np.pi, 500))
    np.testing.assert_allclose(
        relative_reflectance(one, other, between), relative_reflectance(other, one, between), rtol=1e-9
    )


def test_the_hot_spot_lies_behind_the_viewer():
    cosine = np.cos(np.radians(50.0))
    phases = np.radians([0.0, 1.5, 5.0, 20.0, 60.0, 100.0])
    values = relative_reflectance(cosine, cosine, np.cos(phases))
    for channel in values:
        assert (np.diff(channel) < 0.0).all()
        assert channel[0] > 2.0 * channel[-1]


def test_forest_is_told_by_its_colour():
    red, green, blue = np.array(
        [[0.035, 0.055, 0.025], [0.10, 0.18, 0.06], [0.03, 0.05, 0.06], [0.05, 0.05, 0.05], [0.3, 0.28, 0.2]]
    ).T
    share = ForestOptics.share(red, green, blue)
    assert share[0] == 1.0
    assert (share[1:] == 0.0).all()


@pytest.mark.parametrize("sun", [(180.0, 45.0), (340.0, 30.0)])
def test_both_engines_agree_on_forest(sun):
    hill = heightfield(lambda e, n: 60.0 * np.cos(e / 120.0) * np.cos(n / 150.0), side_m=2000.0, count=101)
    mesh, camera = mi_mesh(replace(hill, forest=True), CANOPY), over_a_slope()
    light = Illumination(uniform_sky(3000.0).sky_radiance, sun_at(*sun).sun)
    reference, coverage = path_trace(relight(mesh, light), camera, spp=512)
    relit = relight_view(relightable_view(ray_scene(mesh), trace(mesh, camera)), light).surface
    assert coverage.min() > 0.99
    assert relit.mean() == pytest.approx(reference.mean(), rel=0.02)
    assert np.abs(relit - reference).mean() < 0.03 * reference.mean()
    matt = mi_mesh(hill, CANOPY)
    plain = relight_view(relightable_view(ray_scene(matt), trace(matt, camera)), light).surface
    # The sun stands behind the viewer at first, and then before it: brighter, then darker than matt ground.
    ratio = reference.mean() / plain.mean()
    assert ratio > 1.15 if sun[0] == 180.0 else ratio < 0.95


def test_snow_and_forest_lie_side_by_side():
    from seasonscapes.rendering.ground_optics import NUMPY, optics_of
    from seasonscapes.terrain.surface_classes import Snow

    hill = heightfield(lambda e, n: 0.0 * e, count=3)
    assert optics_of(hill) is None
    both, forest = optics_of(replace(hill, snow=Snow(), forest=True)), optics_of(replace(hill, forest=True))
    assert both is not None
    assert forest is not None
    cosines = (np.array(0.5), np.array(0.4), np.array(0.9))
    np.testing.assert_allclose(
        both.relative(list(CANOPY), cosines, NUMPY), forest.relative(list(CANOPY), cosines, NUMPY)
    )
    snowy = [0.8, 0.82, 0.85]
    np.testing.assert_allclose(forest.relative(snowy, cosines, NUMPY), 1.0)
    assert both.relative(snowy, cosines, NUMPY)[0] != pytest.approx(1.0, abs=0.01)


def test_the_terrain_keeps_its_forest_in_files(tmp_path):
    hill = replace(heightfield(lambda e, n: 0.0 * e, count=3), forest=True)
    save_terrain(hill, tmp_path / "hill.npz")
    assert load_terrain(tmp_path / "hill.npz")[0].forest
    save_terrain(replace(hill, forest=False), tmp_path / "matt.npz")
    assert not load_terrain(tmp_path / "matt.npz")[0].forest


def test_a_scene_file_asks_for_it_and_lambertian_leaves_it_out(tmp_path):
    import seasonscapes as ss

    text = '[elevation.synthetic]\nspacing_m = 60.0\ndetail_m = 60.0\n[[camera]]\nname = "air"\nlatitude_deg = 46.55\n'
    text += "longitude_deg = 7.98\nheight_m = 4800.0\nheading_deg = 180.0\npitch_deg = -30.0\n"
    head = 'name = "woods"\nvertical_datum = "local"\n[origin]\nlatitude_deg = 46.55\nlongitude_deg = 7.98\n'
    (tmp_path / "woods.toml").write_text(head + text + "[forest]\n")
    place = ss.load_place(tmp_path / "woods.toml")
    assert place.terrain.forest
    view = ss.camera(place, "air", size_px=(48, 32))
    light = {"time": "2024-07-20T13:00", "sky": "hosek"}
    forest, matt = (ss.render(place, view, lambertian=flat, **light).surface for flat in (False, True))
    changed = np.abs(forest / np.maximum(matt, 1e-6) - 1.0).max(axis=2) > 0.02
    assert 0.02 < changed.mean() < 0.9
