"""Detail about a camera: a finer part of the surface, and noise of the albedo that keeps its means."""

from dataclasses import replace

import numpy as np
import places
import pytest

from seasonscapes.rendering.albedo_detail import DeviceDetail, finest_detail_m
from seasonscapes.rendering.backend import use_backend
from seasonscapes.terrain.surface_classes import AlbedoDetail
from seasonscapes.workflows import amplified_terrain
from seasonscapes.workflows.place import load_place
from seasonscapes.workflows.views import camera, view_with_terrain
from seasonscapes.workspace import Workspace

NEAR = AlbedoDetail((0.0, 0.0, 2.0), 1e-3, 4.0, seed=3)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hill")
    return load_place(places.write_place(folder), Workspace(folder / "workspace"))


def test_the_surface_is_finest_about_the_camera(place, monkeypatch):
    monkeypatch.setattr(amplified_terrain, "_MOST_NEAR_NODES", 300_000)
    monkeypatch.setattr(amplified_terrain, "_MOST_NODES", 100_000)
    view = camera(place, "south", size_px=(96, 64))
    plain, fine = view_with_terrain(place, view)[1], view_with_terrain(place, view, amplify=True)[1]
    assert place.terrain.surface is not None
    assert fine.surface is not None
    (inner,) = fine.surface.parts
    assert inner.spacing_m < 0.5 * fine.surface.spacing_m < place.terrain.surface.spacing_m
    assert len(fine.faces) != len(plain.faces)
    assert fine.detail is not None
    # Within, the finer part counts alone; at its rim it has ended; in between nothing jumps.
    eye = view.position_m
    across = eye + np.stack([np.linspace(-700.0, 700.0, 2801), np.zeros(2801), np.zeros(2801)], axis=1)
    share = inner.share_at(across)
    assert share[1400] == 1.0
    assert share[0] == share[-1] == 0.0
    alone = replace(fine.surface, parts=())
    np.testing.assert_allclose(fine.surface.up_at(across)[1400], inner.up_at(across)[1400])
    np.testing.assert_allclose(fine.surface.up_at(across)[0], alone.up_at(across)[0])
    steps = np.abs(np.diff(fine.surface.up_at(across)))
    assert steps.max() < 0.5 * 0.6, "0.5 m on, no more than a steep slope"
    # Both are the same ground: they differ by less than the detail of the coarser one.
    assert np.abs(inner.up_at(across)[1000:1800] - alone.up_at(across)[1000:1800]).max() < 2.0


def detailed(albedo, x, y, z=0.0):
    use_backend()
    import mitsuba as mi

    position = mi.Point3f(mi.Float(x.ravel().astype(np.float32)), mi.Float(y.ravel().astype(np.float32)), z)
    values = np.array(DeviceDetail(NEAR).applied(mi.Color3f(*albedo), position)).T
    return values.reshape(*x.shape, 3)


@pytest.mark.parametrize(
    ("albedo", "least", "most"),
    [
        ((0.10, 0.14, 0.05), 0.05, 0.5),
        ((0.3, 0.29, 0.28), 0.05, 0.5),
        ((0.9, 0.9, 0.9), 0.0, 0.03),
        ((0.01, 0.03, 0.035), 0.0, 0.01),
    ],
)
def test_noise_of_the_albedo_keeps_its_mean(albedo, least, most):
    """Grass and rock vary, snow hardly, water not; the mean over an area of many texels stays within 1 %."""
    x, y = np.meshgrid(np.arange(-200.0, 200.0, 0.5), np.arange(-200.0, 200.0, 0.5))
    values = detailed(albedo, x, y)
    np.testing.assert_allclose(values.mean(axis=(0, 1)), albedo, rtol=0.01)
    assert least <= values[..., 1].std() / albedo[1] <= most
    np.testing.assert_array_equal(values, detailed(albedo, x, y))


def test_octaves_end_at_the_pixels():
    """Near the camera neighbouring points of a few millimetres differ as they do not far away."""
    x, y = np.meshgrid(np.arange(0.0, 1.0, 0.004), np.arange(0.0, 0.2, 0.004))
    near, far = (detailed((0.3, 0.29, 0.28), x + offset, y)[..., 1] for offset in (1.0, 400.0))
    assert np.abs(np.diff(near)).mean() > 5.0 * np.abs(np.diff(far)).mean()
    distance = np.array([2.0, 6.0, 50.0, 300.0])
    assert (finest_detail_m(NEAR, 4.0, distance) <= 1.0 * distance * NEAR.pixel_angle_rad + 2.0**-9).all()
    assert (finest_detail_m(None, 4.0, distance) == 4.0).all()


def test_a_camera_near_the_ground_keeps_its_height_above_it(monkeypatch):
    """Detail may raise the ground by more than a camera stands above it: it would look at the ground from below."""
    monkeypatch.setattr(amplified_terrain, "_MOST_NEAR_NODES", 300_000)
    monkeypatch.setattr(amplified_terrain, "_MOST_NODES", 100_000)
    place = load_place("alpine_small")
    south = camera(place, "meadow", size_px=(96, 64))
    assert place.terrain.surface is not None
    changes = []
    for step in range(6):
        pose = south.world_from_camera.copy()
        pose[0, 3] += 160.0 * step
        ground = float(place.terrain.surface.up_at(pose[None, :3, 3])[0])
        pose[2, 3] = ground + 2.0
        moved, terrain = view_with_terrain(place, replace(south, world_from_camera=pose), amplify=True)
        below = terrain.surface
        assert below is not None
        height = moved.position_m[2] - float(below.up_at(moved.position_m[None])[0])
        assert height == pytest.approx(2.0, abs=0.4)
        changes.append(moved.position_m[2] - pose[2, 3])
    pose[2, 3] = ground + 150.0
    free = replace(south, world_from_camera=pose)
    assert view_with_terrain(place, free, amplify=True)[0] is free
    assert max(np.abs(changes)) > 0.3


def test_the_ground_of_the_next_frame_of_a_film_is_the_same(place, monkeypatch):
    """The finer part moves along with the camera, cell by cell: within what its pixels can tell, nothing pops up."""
    monkeypatch.setattr(amplified_terrain, "_MOST_NEAR_NODES", 300_000)
    monkeypatch.setattr(amplified_terrain, "_MOST_NODES", 100_000)
    view = camera(place, "south", size_px=(96, 64))
    grid = np.stack(np.meshgrid(np.linspace(-800.0, 800.0, 161), np.linspace(-800.0, 800.0, 161)), axis=-1).reshape(
        -1, 2
    )
    points = np.c_[view.position_m[:2] + grid, np.zeros(len(grid))]

    def ground(forward_m: float) -> tuple[np.ndarray, np.ndarray]:
        pose = view.world_from_camera.copy()
        pose[:3, 3] += forward_m * pose[:3, 2]
        surface = view_with_terrain(place, replace(view, world_from_camera=pose), amplify=True)[1].surface
        assert surface is not None
        return surface.sample(points)

    heights, normals = ground(0.0)
    changed = 0
    for step_m in (5.0, 20.0, 50.0):
        other, turned = ground(step_m)
        distance = np.linalg.norm(grid, axis=1)
        pixels = np.abs(other - heights) / np.maximum(distance, 2.0) * view.fx
        assert np.quantile(pixels, 0.999) < 0.5
        assert pixels.max() < 2.0
        assert np.degrees(np.arccos(np.clip((turned * normals).sum(axis=1), -1.0, 1.0))).mean() < 0.5
        changed += int((other != heights).any())
    assert changed, "the finer part was never moved"
