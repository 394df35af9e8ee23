"""Heading, fx and fy under an L1 loss: the truth, outliers, the global minimum, and σ that says how far off it is."""

import numpy as np
import pytest
from scipy.optimize import minimize

from seasonscapes.calibration.evidence import Correspondences
from seasonscapes.calibration.l1_pose import l1_pose
from seasonscapes.cameras.pinhole import Camera, project, rotation_from_angles
from seasonscapes.errors import NotEnoughEvidence

WIDTH, HEIGHT = 3072, 2048


def camera(heading_deg: float, fx: float, fy: float) -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(heading_deg, -3.0, 0.8)
    pose[:3, 3] = 120.0, -80.0, 2050.0
    return Camera(WIDTH, HEIGHT, fx, fy, 1536.0, 1100.0, pose)


def clicked(true: Camera, rng, *, count=10, noise_px=1.0, outliers=0) -> Correspondences:
    """Points that a camera sees at 1 to 20 km, clicked with Gaussian errors; some of them anywhere."""
    pixel = rng.uniform([0.0, 0.0], [WIDTH, HEIGHT], (count, 2))
    local = np.concatenate([(pixel - [true.cx, true.cy]) / [true.fx, true.fy], np.ones((count, 1))], axis=1)
    position = true.position_m + (local * rng.uniform(1e3, 2e4, (count, 1))) @ true.world_from_camera[:3, :3].T
    np.testing.assert_allclose(project(true, position)[0], pixel, atol=1e-6)
    pixel = pixel + rng.normal(0.0, noise_px, pixel.shape)
    pixel[:outliers] = rng.uniform([0.0, 0.0], [WIDTH, HEIGHT], (outliers, 2))
    return Correspondences(pixel, position)


def turned_by(found, true_heading_deg):
    return (found.parameters[0] - true_heading_deg + 180.0) % 360.0 - 180.0


@pytest.mark.parametrize("heading_deg", [0.0, 91.3, 359.9])
def test_exact_points_give_the_truth_from_any_start(heading_deg):
    true = camera(heading_deg, 1229.0, 1678.0)
    points = clicked(true, np.random.default_rng(1), noise_px=0.0)
    for start in (camera(heading_deg + 3.0, 1400.0, 1400.0), camera(heading_deg + 170.0, 1000.0, 1500.0)):
        found = l1_pose(start, points)
        assert turned_by(found, heading_deg) == pytest.approx(0.0, abs=3e-5)
        assert (found.view.fx, found.view.fy) == pytest.approx((1229.0, 1678.0), rel=1e-6)
        np.testing.assert_array_equal(found.view.position_m, true.position_m)
        assert found.rms_px < 2e-3


def test_outliers_pull_little_and_sigma_tells_the_error():
    errors, scaled, focal = [], [], []
    for seed in range(120):
        true = camera(200.0, 1229.0, 1300.0)
        found = l1_pose(camera(203.0, 1250.0, 1250.0), clicked(true, np.random.default_rng(seed), outliers=2))
        errors.append(abs(turned_by(found, 200.0)))
        focal.append(abs(found.view.fx / 1229.0 - 1.0))
        clean = l1_pose(camera(203.0, 1250.0, 1250.0), clicked(true, np.random.default_rng(seed), count=20))
        scaled.append(turned_by(clean, 200.0) / clean.sigma["heading_deg"])
    # A pixel is 0.047°; a fifth of the points lie anywhere.
    assert np.median(errors) < 0.03
    assert np.median(focal) < 0.002
    assert 0.75 < np.sqrt(np.mean(np.square(scaled))) < 1.25


def test_no_other_pose_has_a_smaller_loss():
    rng = np.random.default_rng(3)
    for outliers in (0, 3):
        points = clicked(camera(40.0, 1229.0, 1300.0), rng, count=12, noise_px=4.0, outliers=outliers)
        found = l1_pose(camera(38.0, 1229.0, 1229.0), points)

        def loss(unknowns, points=points):
            pixel, _ = project(camera(*unknowns), points.position_m)
            return np.abs(pixel - points.pixel).sum()

        ours = loss((found.parameters[0], found.view.fx, found.view.fy))
        assert ours == pytest.approx(np.abs(found.residual_px).sum(), rel=1e-9)
        for offset in (-0.5, 0.0, 0.5):
            rival = minimize(loss, (40.0 + offset, 1229.0, 1300.0), method="Nelder-Mead", options={"maxiter": 4000})
            assert ours <= rival.fun * (1.0 + 1e-6)


def test_what_cannot_be_solved_is_said():
    true = camera(40.0, 1229.0, 1300.0)
    points = clicked(true, np.random.default_rng(0))
    with pytest.raises(NotEnoughEvidence, match="2 points"):
        l1_pose(true, Correspondences(points.pixel[:2], points.position_m[:2]))
    shuffled = Correspondences(points.pixel[np.random.default_rng(5).permutation(10)], points.position_m)
    with pytest.raises(NotEnoughEvidence, match="no heading in common"):
        l1_pose(true, shuffled)
    axis = true.position_m + np.array([2e3, 4e3, 8e3])[:, None] * true.world_from_camera[:3, 2]
    with pytest.raises(NotEnoughEvidence, match="undetermined"):
        l1_pose(true, Correspondences(project(true, axis)[0], axis))
