"""Discs of several sizes: where they lie, that they cover the land once, and that files keep them."""

import numpy as np
import pytest

pytest.importorskip("torch")

import places
from test_rendering import heightfield, looking_down

from seasonscapes.gaussians.disc_cells import cell_centres_m, packed_cells, unpacked_cells
from seasonscapes.gaussians.disc_density import footprints, refined_surfels
from seasonscapes.gaussians.surfels import plane_normals, terrain_surfels
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh
from seasonscapes.sky.models import read_sky_model
from seasonscapes.workflows.distillation import DistilOptions, distillation_data
from seasonscapes.workflows.place import load_place
from seasonscapes.workflows.views import scene_cameras
from seasonscapes.workspace import Workspace


@pytest.fixture(scope="module")
def slope():
    """1 km of a waving slope, with 20 × 20 discs."""
    terrain = heightfield(lambda e, n: 0.4 * e + 30.0 * np.sin(n / 90.0), count=61)
    return terrain, terrain_surfels(terrain, 50.0)


@pytest.fixture(scope="module")
def refined(slope):
    place_m = np.array([[-210.0, 130.0], [305.0, -240.0]])
    return refined_surfels(*slope, place_m, np.array([7.0, 20.0])), place_m


def test_discs_are_as_fine_as_wanted_and_cover_the_land_once(slope, refined):
    found, place_m = refined
    nearest = [int(np.argmin(np.linalg.norm(found.means[:, :2] - place, axis=1))) for place in place_m]
    assert (found.spacing_m[nearest] <= [7.0, 20.0]).all()
    # A quarter of the spacing more would do: no cell is quartered in vain.
    assert (found.spacing_m[nearest] > [3.5, 10.0]).all()
    assert len(found.means) < 2 * len(slope[1].means)
    area = (np.ldexp(1.0, -found.level.astype(int)) ** 2).sum()
    assert area == pytest.approx(len(slope[1].means))
    east_m, north_m = cell_centres_m(found.grid, found.level, found.cell)
    np.testing.assert_allclose(found.means[:, 0], east_m, atol=0.02)
    np.testing.assert_allclose(found.means[:, 1], north_m, atol=0.02)
    np.testing.assert_allclose(found.means[:, 2], 0.4 * east_m + 30.0 * np.sin(north_m / 90.0), atol=4.0)


def test_cells_survive_packing(refined):
    found, _ = refined
    packed = packed_cells(found.grid, found.level, found.cell)
    level, cell = unpacked_cells(found.grid, packed, int(found.level.max()))
    np.testing.assert_array_equal(level, found.level)
    np.testing.assert_array_equal(cell, found.cell)
    assert packed["split"].nbytes < 0.5 * len(found.cell)
    with pytest.raises(ValueError, match="bits of quartered cells"):
        unpacked_cells(found.grid, packed | {"split": packed["split"][:5]}, int(found.level.max()))
    # No cell is left to quarter: without a bound this loops on nothing.
    for levels in (10**6, -1, float("inf"), 1.5):
        with pytest.raises(ValueError, match="expected 0 to 6"):
            unpacked_cells(found.grid, {name: np.zeros_like(bits) for name, bits in packed.items()}, levels)


def test_planes_are_those_of_the_points():
    rng = np.random.default_rng(4)
    xy = rng.uniform(-5.0, 5.0, (30, 16, 2))
    slopes = rng.uniform(-2.0, 2.0, (30, 1, 2))
    points = np.concatenate([xy, (xy * slopes).sum(axis=2, keepdims=True) + 700.0], axis=2)
    expected = np.concatenate([-slopes[:, 0], np.ones((30, 1))], axis=1)
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(plane_normals(points), expected, atol=1e-5)


def test_footprints_are_the_pixels_of_the_camera(slope):
    terrain, _ = slope
    camera = looking_down(size=40, view_m=850.0)
    mesh = mi_mesh(terrain, np.full((8, 8, 3), 0.4, np.float32))
    place_m, side_m = footprints(RenderScene(ray_scene(mesh).mi_scene, mesh), [camera])
    assert place_m.shape == (len(side_m), 2)
    # Straight down, neighbouring rays are half a pixel apart.
    row = place_m[:80]
    gaps = np.linalg.norm(np.diff(row, axis=0), axis=1)
    np.testing.assert_allclose(np.median(gaps / side_m[:79]), 0.5, rtol=0.1)


def test_a_camera_that_sees_hardly_any_ground_is_told_and_left_out(tmp_path, caplog, few_rays):
    """Its picture has a few rays that meet the ground, and no pixel that they fill."""
    scene = places.SCENE.replace("pitch_deg = -8.0", "pitch_deg = 45.5")
    place = load_place(places.write_place(tmp_path / "scene", scene), Workspace(tmp_path / "work"))
    (camera,) = scene_cameras(place, size_px=(32, 32)).values()
    mesh = mi_mesh(place.terrain, np.full((8, 8, 3), 0.4, np.float32))
    assert len(footprints(RenderScene(ray_scene(mesh).mi_scene, mesh), [camera])[0])
    options = DistilOptions(discs=8, suns=1, dates=1, views=1, view_px=32)
    data = distillation_data(place, read_sky_model("hosek"), [], options)
    assert len(data.cameras) == len(data.frames) == 1
    assert "nothing is learned from camera south: TrainingFrame: no splat or no usable pixel" in caplog.text
