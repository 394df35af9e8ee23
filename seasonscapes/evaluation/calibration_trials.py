"""Calibrations whose truth is known: synthetic matches and pictures with the faults that real ones have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.calibration.evidence import Correspondences, Priors
from seasonscapes.calibration.pose_model import View, bearings, project_values, values_of, view_from_values
from seasonscapes.calibration.resection import Calibration, resect
from seasonscapes.cameras.panorama import panorama_from_angles
from seasonscapes.cameras.pinhole import Camera, rotation_from_angles

# A start 30 m off in a random direction is what this standard deviation of each axis describes.
START_OFFSET_M = 30.0
START_SIGMA_M = START_OFFSET_M / np.sqrt(3.0)


@dataclass(frozen=True)
class PointTrial:
    """A camera, matches of it with noise and outliers, and a start that is off."""

    truth: View
    start: View
    points: Correspondences
    wrong: np.ndarray


def point_trial(
    rng: np.random.Generator,
    *,
    panoramic: bool = True,
    count: int = 12,
    noise_px: float = 1.0,
    outlier_share: float = 0.2,
    heading_off_deg: float = 5.0,
) -> PointTrial:
    """Points of 200 m to 15 km distance all over the picture; wrong ones lie 20 to 400 px away from their place.

    The panorama is that of a 35 mm rotating camera (0.023° a pixel), the photograph a frame of 65°.
    """
    heading, tilt, roll = rng.uniform(0, 360), rng.normal(0, 3.0), rng.normal(0, 1.5)
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(heading, tilt, roll)
    pose[:3, 3] = rng.uniform(-1, 1, 3) * [5e3, 5e3, 300.0] + [0.0, 0.0, 2000.0]
    if panoramic:
        truth = panorama_from_angles(
            "cylindrical", (15680, 2048), horizontal_fov_deg=360.0, vertical_fov_deg=45.4, pose=pose
        )
    else:
        truth = Camera(3072, 2048, 2400.0, 2400.0, 1536.0, 1024.0, pose)
    size = np.array([truth.width_px, truth.height_px])
    pixel = rng.uniform(0.04 * size, [0.96, 0.8] * size, (count, 2))
    distance = np.exp(rng.uniform(np.log(200.0), np.log(15e3), count))
    position = truth.position_m + distance[:, None] * bearings(truth, 0.0, pixel)
    seen = pixel + rng.normal(0, noise_px, (count, 2))
    wrong = np.zeros(count, bool)
    wrong[rng.permutation(count)[: round(outlier_share * count)]] = True
    angle = rng.uniform(0, 2 * np.pi, wrong.sum())
    seen[wrong] += rng.uniform(20, 400, (wrong.sum(), 1)) * np.stack([np.cos(angle), np.sin(angle)], -1)
    values = values_of(truth, np.eye(3))
    values[0] += rng.choice([-1.0, 1.0]) * heading_off_deg
    values[1:3] += rng.normal(0, 1.0, 2)
    offset = rng.normal(size=3)
    values[3:6] += START_OFFSET_M * offset / np.linalg.norm(offset)
    values[6] += rng.normal(0, 0.02)
    return PointTrial(truth, view_from_values(truth, np.eye(3), values), Correspondences(seen, position), wrong)


@dataclass(frozen=True)
class PointScore:
    """How one trial ended; ``within_two_sigma`` ``(3,)`` of east, north and up."""

    heading_error_deg: float
    focal_error: float
    position_error_m: np.ndarray
    within_two_sigma: np.ndarray
    wrong_found: bool


def score_points(trial: PointTrial, *, noise_px: float | None = None, loss: str = "cauchy") -> PointScore:
    """Calibrate a trial and compare with its truth."""
    priors = Priors(horizontal_m=START_SIGMA_M, vertical_m=START_SIGMA_M)
    solved: Calibration = resect(trial.start, trial.points, priors=priors, noise_px=noise_px, loss=loss)
    truth = values_of(trial.truth, np.eye(3))
    error = solved.values - truth
    sigma = np.array([solved.sigma[name] for name in ("east_m", "north_m", "up_m")])
    return PointScore(
        abs((error[0] + 180.0) % 360.0 - 180.0),
        abs(solved.view.fy / trial.truth.fy - 1.0),
        error[3:6],
        np.abs(error[3:6]) <= 2.0 * sigma,
        bool(solved.outlier[trial.wrong].all()),
    )


def reproject(trial: PointTrial) -> np.ndarray:
    """True pixels ``(N, 2)`` of a trial's points, for tests of the trial itself."""
    axes = np.eye(3)
    return project_values(trial.truth, axes, values_of(trial.truth, axes), trial.points.position_m)[0]
