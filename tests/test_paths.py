"""The path tracer over terrain: its random numbers, its agreement with Mitsuba's own, its bits and its kernels."""

import numpy as np
import pytest
from test_rendering import PLANE, heightfield, looking_down, pyramid, sun_at

from seasonscapes.frames import equirectangular_directions
from seasonscapes.rendering import backend, radiance
from seasonscapes.rendering.mitsuba_scene import RenderScene, build_scene
from seasonscapes.rendering.radiance import mi_path_integrator, path_trace
from seasonscapes.sky.illumination import Illumination

CAMERA = looking_down(600.0, size=48)


def points_of(key: int, count: int, first: int = 0) -> np.ndarray:
    backend.use_backend()
    import drjit as dr
    import mitsuba as mi

    from seasonscapes.rendering.sobol import sobol_pair

    return np.array(sobol_pair(mi.UInt32(key), dr.arange(mi.UInt32, first, first + count))).T


@pytest.mark.parametrize(("key", "first"), [(0, 0), (7, 0), (123456789, 64)])
def test_sobol_points_form_a_net(key, first):
    """Every elementary interval of area 1/64 holds exactly one of 64 successive points (a (0, 6, 2)-net)."""
    points = points_of(key, 64, first)
    assert points.min() >= 0.0
    assert points.max() < 1.0
    for bits in range(7):
        cells = np.floor(points * [2**bits, 2 ** (6 - bits)]).astype(int)
        assert len(np.unique(cells @ [64, 1])) == 64


def test_keys_are_independent():
    first, second = points_of(1, 4096), points_of(2, 4096)
    assert np.abs(np.corrcoef(np.hstack([first, second]).T)[:2, 2:]).max() < 0.06
    # Errors of an integral under many keys scatter about zero: each scramble is uniform.
    means = np.array([points_of(key, 4).prod(axis=1).mean() for key in range(200)])
    assert abs(means.mean() - 0.25) < 4.0 * means.std() / np.sqrt(len(means))


def full_light() -> Illumination:
    """A sky with a gradient, a low sun of its true size and a moon too bright to overlook."""
    direction = equirectangular_directions(32, 64)
    sky = 1500.0 + 1000.0 * direction[..., :1] * np.array([1.0, 0.5, -0.5])
    moon = sun_at(300.0, 50.0, illuminance_lx=3.0e3).sun
    return Illumination(sky.astype(np.float32), sun_at(100.0, 25.0, illuminance_lx=2.0e4).sun, moon)


def rough(east, north):
    return pyramid(east, north) + 40.0 * np.sin(east / 60.0) * np.cos(north / 45.0)


def scene_of(albedo=0.8, *, smooth=True) -> RenderScene:
    checker = albedo * (0.6 + 0.4 * (np.indices((16, 16)).sum(0) % 2))[..., None] * np.array([1.0, 0.9, 0.7])
    return build_scene(heightfield(rough), checker.astype(np.float32), full_light(), smooth=smooth)


def mitsuba_picture(scene: RenderScene, spp: int, max_depth: int, seed: int) -> np.ndarray:
    """`path_trace` by Mitsuba's own integrator and sensor, the slow twin."""
    import mitsuba as mi

    pose = CAMERA.world_from_camera @ np.diag([-1.0, -1.0, 1.0, 1.0])
    fov_deg = 2.0 * np.degrees(np.arctan(0.5 * CAMERA.width_px / CAMERA.fx))
    film = {
        "type": "hdrfilm",
        "width": CAMERA.width_px,
        "height": CAMERA.height_px,
        "component_format": "float32",
        "rfilter": {"type": "box"},
    }
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": fov_deg,
            "near_clip": 0.5,
            "far_clip": 1e7,
            "film": film,
            "to_world": mi.ScalarTransform4f(pose),
        }
    )
    picture = mi.render(scene.mi_scene, sensor=sensor, integrator=mi_path_integrator(max_depth), spp=spp, seed=seed)
    return np.array(picture)[..., :3]


@pytest.mark.parametrize(("max_depth", "smooth"), [(2, True), (3, False), (8, True)])
def test_same_expectation_as_mitsubas_path_and_less_noise(max_depth, smooth):
    """Pixel by pixel within the noise of both (z-test), and less of it for equal samples."""
    scene = scene_of(smooth=smooth)
    ours = [path_trace(scene, CAMERA, spp=64, seed=seed, max_depth=max_depth)[0] for seed in range(4)]
    theirs = [mitsuba_picture(scene, 256, max_depth, seed) for seed in range(4)]
    mean, mean_theirs = np.mean(ours, axis=0), np.mean(theirs, axis=0)
    assert mean.mean() == pytest.approx(mean_theirs.mean(), rel=2e-3)
    variance, variance_theirs = np.var(ours, axis=0, ddof=1), np.var(theirs, axis=0, ddof=1)
    assert variance.mean() * 64 < 0.5 * variance_theirs.mean() * 256
    # Blocks of 4 × 4 pixels, whose error is the mean of 16 independent ones.
    difference = (mean - mean_theirs).reshape(12, 4, 12, 4, 3).mean(axis=(1, 3))
    error = np.sqrt((variance + variance_theirs).reshape(12, 4, 12, 4, 3).mean(axis=(1, 3)) / 16 / 4)
    z = difference / error
    assert np.abs(z).max() < 5.5
    assert np.sqrt(np.mean(z**2)) < 1.3


def test_bits_depend_on_neither_threads_nor_blocks(monkeypatch):
    import drjit as dr

    scene, threads = scene_of(), dr.thread_count()
    whole = path_trace(scene, CAMERA, spp=8, seed=3)[0]
    try:
        dr.set_thread_count(1)
        np.testing.assert_array_equal(path_trace(scene, CAMERA, spp=8, seed=3)[0], whole)
    finally:
        dr.set_thread_count(threads)
    monkeypatch.setattr(radiance, "LANES", CAMERA.width_px * 8 * 5)
    np.testing.assert_array_equal(path_trace(scene, CAMERA, spp=8, seed=3)[0], whole)
    # Passes of samples continue one sequence; only the order of sums differs.
    monkeypatch.setattr(radiance, "LANES", CAMERA.width_px * 2)
    np.testing.assert_allclose(path_trace(scene, CAMERA, spp=8, seed=3)[0], whole, rtol=1e-5)


def test_paths_are_traced_once_by_one_kernel():
    """Another camera and seed compile nothing, and no channel traces the paths again."""
    import drjit as dr

    scene, other = scene_of(), looking_down(700.0, size=48)
    path_trace(scene, CAMERA, spp=8)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        path_trace(scene, other, spp=8, seed=9, max_depth=5)
        launched = [kernel for kernel in dr.kernel_history() if str(kernel["type"]).endswith("JIT")]
    heavy = [kernel for kernel in launched if kernel["size"] == 48 * 48 * 8]
    assert len(heavy) == 1
    assert heavy[0]["cache_hit"]
    assert not heavy[0]["cache_disk"]


def test_an_unknown_light_is_refused():
    """A light that would silently be missing from the picture."""
    import mitsuba as mi

    scene = build_scene(PLANE, np.ones(3), full_light())
    lamp = mi.load_dict({"type": "scene", "terrain": scene.mi_terrain, "lamp": {"type": "point"}})
    with pytest.raises(ValueError, match="got 1 emitters, expected 2"):
        path_trace(RenderScene(lamp, scene.mi_terrain, scene.illumination), CAMERA, spp=1)
