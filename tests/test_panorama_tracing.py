"""Panoramas are traced and relit natively: views cut out of them equal views traced directly."""

from datetime import UTC, datetime

import numpy as np
import pytest
from test_rendering import heightfield, sun_at
from test_transport import gradient_sky

from seasonscapes.cameras.panorama import cut_view, panorama_from_angles, project_panorama, split_panorama
from seasonscapes.cameras.pinhole import rotation_from_angles
from seasonscapes.evaluation.synthetic_webcams import WebcamInstant, WebcamOptions, webcam_series
from seasonscapes.evaluation.webcam_faults import CLEAN, PoseSigmas, perturb_pose
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.coefficients_file import load_coefficients, save_coefficients
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight
from seasonscapes.rendering.radiance import render_view
from seasonscapes.rendering.relit_view import relight_view, relightable_view
from seasonscapes.rendering.sightlines import visible_faces
from seasonscapes.rendering.transport import trace_view
from seasonscapes.sky.illumination import Illumination

EFFORT = SamplingOptions(shadow_samples=16, albedo_samples=64, rays=128, clusters=1024)
TERRAIN = heightfield(lambda e, n: 0.0006 * (e**2 + n**2) + 25.0 * np.sin(e / 55.0) * np.cos(n / 40.0 + e / 90.0))


class Haze:
    """Koschmieder's homogeneous haze of 5 km visibility."""

    def __call__(self, depth_m, direction):
        transmittance = np.exp(-3.912 / 5000.0 * np.asarray(depth_m))[..., None] * np.ones(3)
        return transmittance, 5000.0 * (1.0 - transmittance)


LIGHT = Illumination(gradient_sky(), sun_at(140.0, 35.0).sun, aerial_perspective=Haze())


def colours() -> np.ndarray:
    """Smooth, and different in every direction."""
    y, x = np.mgrid[0:64, 0:64] / 63.0
    return np.stack([0.2 + 0.6 * x, 0.2 + 0.6 * y, 0.5 + 0.3 * np.sin(9.0 * x)], axis=-1).astype(np.float32)


def panorama_at(heading_deg: float, projection="cylindrical", size_px=(720, 160), tilt_deg=0.0):
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(heading_deg, tilt_deg)
    pose[:3, 3] = [20.0, -30.0, 70.0]
    fov = 2.0 * np.degrees(np.arctan(size_px[1] * np.pi / size_px[0]))
    return panorama_from_angles(projection, size_px, horizontal_fov_deg=360.0, vertical_fov_deg=fov, pose=pose)


@pytest.fixture(scope="module")
def land():
    return mi_mesh(TERRAIN, colours())


@pytest.mark.parametrize(("projection", "tilt_deg"), [("cylindrical", 0.0), ("equirectangular", 5.0)])
def test_a_view_cut_out_of_a_relit_panorama_equals_one_traced_directly(land, projection, tilt_deg):
    panorama = panorama_at(25.0, projection, size_px=(450, 100), tilt_deg=tilt_deg)
    bare = ray_scene(land)
    whole = relight_view(relightable_view(bare, trace_view(bare, panorama, EFFORT)), LIGHT)
    assert 0.2 < whole.coverage.mean() < 0.95
    cameras = split_panorama(panorama, fov_deg=80.0)
    # The first one looks across the seam, which is at the back of the heading.
    for camera in cameras[0:3:2] if tilt_deg == 0.0 else cameras[:1]:
        cut, inside = cut_view(whole.radiance, panorama, camera)
        direct = relight_view(relightable_view(bare, trace_view(bare, camera, EFFORT)), LIGHT)
        error = np.abs(cut - direct.radiance) / direct.radiance.mean(axis=2, keepdims=True)
        ground = inside & (direct.coverage > 0.0)
        assert ground.mean() > 0.2
        assert np.median(error[ground]) < 0.02
        assert np.median(error[inside]) < 0.02
        mirrored = np.abs(cut[:, ::-1] - direct.radiance) / direct.radiance.mean(axis=2, keepdims=True)
        assert np.median(mirrored[ground]) > 0.1


def test_a_panorama_is_path_traced_to_the_same_picture(land):
    panorama = panorama_at(300.0, size_px=(360, 80))
    bare = ray_scene(land)
    relit = relight_view(relightable_view(bare, trace_view(bare, panorama, EFFORT)), LIGHT).radiance
    traced = render_view(relight(land, LIGHT), panorama, spp=128).radiance
    assert relit.mean() / traced.mean() == pytest.approx(1.0, abs=0.01)
    assert np.median(np.abs(relit - traced) / traced.mean(axis=2, keepdims=True)) < 0.02


@pytest.mark.parametrize("projection", ["cylindrical", "equirectangular"])
def test_each_pixel_shows_the_place_that_projects_to_it(land, projection):
    """Neither mirrored nor turned; and the sampled rays of the renderer are those of the camera model."""
    panorama = panorama_at(100.0, projection, tilt_deg=3.0)
    bare = ray_scene(land)
    coefficients = trace_view(
        bare, panorama, SamplingOptions(shadow_samples=4, albedo_samples=4, rays=16, clusters=64, bounces=0)
    )
    ready = relightable_view(bare, coefficients)
    seen = np.isfinite(ready.gbuffer.depth)
    row, column = np.nonzero(seen)
    pixel, _ = project_panorama(panorama, ready.gbuffer.position[seen])
    assert np.abs(pixel - np.stack([column, row], axis=-1) - 0.5).max() < 0.02
    full = np.asarray(coefficients.sample_weight).min(axis=1) > 0.0
    pixel, _ = project_panorama(panorama, np.asarray(coefficients.sample_origin)[full])
    row, column = np.divmod(coefficients.pixel[full], panorama.width_px)
    within = pixel - np.stack([column, row], axis=-1)[:, None]
    within[..., 0] -= 720.0 * np.round((within[..., 0] - 0.5) / 720.0)
    assert within.min() > -0.05
    assert within.max() < 1.05
    # A place in the east (column 80 of 360 from a heading of 100°) is left of the middle by ten degrees.
    east, _ = project_panorama(panorama, panorama.position_m + np.array([500.0, 0.0, 0.0]))
    assert east[0] == pytest.approx(720 * (170.0 / 360.0), abs=2.0)
    assert (visible_faces(bare, panorama) >= 0).mean() == pytest.approx(seen.mean(), abs=0.01)


def test_the_last_column_meets_the_first(land):
    """Turned by half a circle, the seam is in the middle and nothing is seen of it."""
    bare = ray_scene(land)
    pictures = [
        relight_view(
            relightable_view(bare, trace_view(bare, panorama_at(heading, size_px=(360, 80)), EFFORT)), LIGHT
        ).radiance
        for heading in (10.0, 190.0)
    ]
    turned = np.roll(pictures[1], 180, axis=1)
    error = np.abs(turned - pictures[0]) / pictures[0].mean(axis=2, keepdims=True)
    assert np.median(error) < 0.01
    for column in (0, 1, 178, 179, 180, 181, 358, 359):
        assert np.median(error[:, column]) < 0.03, column


def test_a_webcam_series_of_panoramas(tmp_path):
    panorama = panorama_at(80.0, size_px=(300, 66))
    time = datetime(2024, 7, 20, 10, tzinfo=UTC)
    sampling = SamplingOptions(shadow_samples=4, albedo_samples=16, rays=64, clusters=256)
    poses = PoseSigmas(1.0, 1.0, 0.5, 0.2, 0.2, 0.05)
    options = WebcamOptions(CLEAN, poses, foreground=True, sampling=sampling)
    made = webcam_series(TERRAIN, "round", panorama, [WebcamInstant(time, LIGHT, colours())], options=options)[0]
    assert made.encoded.shape == made.radiance.shape == (66, 300, 3)
    assert made.camera is panorama
    believed = made.observation.camera
    assert believed.full_circle
    assert believed.fx == panorama.fx
    assert believed.fy != panorama.fy
    assert not np.array_equal(believed.world_from_camera, panorama.world_from_camera)
    # Three houses of a webcam's picture each, not of a panorama's width.
    assert 0.01 < made.foreground.mean() < 0.15
    wide, error = perturb_pose(panorama_at(0.0), PoseSigmas(log_focal=0.1), np.random.default_rng(1))
    assert wide.fy == pytest.approx(panorama_at(0.0).fy * np.exp(error["log_focal"]))


def test_coefficients_of_a_panorama_are_kept_in_files(land, tmp_path):
    bare = ray_scene(land)
    made = trace_view(
        bare,
        panorama_at(0.0, size_px=(90, 20)),
        SamplingOptions(shadow_samples=4, albedo_samples=4, rays=16, clusters=64),
    )
    save_coefficients(tmp_path / "view", made)
    again = load_coefficients(tmp_path / "view")
    assert again.camera.projection == "cylindrical"
    assert np.array_equal(again.camera.world_from_camera, made.camera.world_from_camera)
