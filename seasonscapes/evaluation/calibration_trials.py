"""Synthetic trials of camera resection: correspondences with noise and outliers from a known camera, and their scores."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.calibration.evidence import Correspondences, Priors
from seasonscapes.calibration.pose_model import (
    View,
    bearings,
    parameters_of_view,
    project_with_parameters,
    view_from_parameters,
)
from seasonscapes.calibration.resection import Calibration, Loss, ResectionOptions, resect
from seasonscapes.cameras.panorama import panorama_from_angles
from seasonscapes.cameras.pinhole import Camera, rotation_from_angles

# Position error of the start, and the standard deviation per axis of an error of that length in a random direction [m].
START_OFFSET_M = 30.0
START_SIGMA_M = START_OFFSET_M / np.sqrt(3.0)


@dataclass(frozen=True)
class PointTrial:
    """Correspondences of a known camera and an inaccurate start.

    Parameters
    ----------
    truth
        True view.
    start
        Approximate view, the start of a resection.
    points
        N correspondences with noise and outliers.
    outlier
        ``(N,)`` bool, True for outliers.
    """

    truth: View
    start: View
    points: Correspondences
    outlier: np.ndarray


def point_trial(
    rng: np.random.Generator,
    *,
    panoramic: bool = True,
    count: int = 12,
    noise_px: float = 1.0,
    outlier_share: float = 0.2,
    heading_error_deg: float = 5.0,
) -> PointTrial:
    """Generate correspondences at distances of 200 m to 15 km, spread over the image.

    Parameters
    ----------
    rng
        Random generator.
    panoramic
        Whether the view is a full-circle panorama (of a 35 mm rotating camera, 0.023° per pixel) or a photograph with a
        field of view of 65°.
    count
        Number of correspondences.
    noise_px
        Standard deviation of a pixel coordinate [px].
    outlier_share
        Fraction of outliers, which are displaced by 20 to 400 px.
    heading_error_deg
        Absolute heading error of the start [deg].

    Returns
    -------
    PointTrial
        True view, start, correspondences and outliers.
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
    observed = pixel + rng.normal(0, noise_px, (count, 2))
    outlier = np.zeros(count, bool)
    outlier[rng.permutation(count)[: round(outlier_share * count)]] = True
    angle = rng.uniform(0, 2 * np.pi, outlier.sum())
    observed[outlier] += rng.uniform(20, 400, (outlier.sum(), 1)) * np.stack([np.cos(angle), np.sin(angle)], -1)
    parameters = parameters_of_view(truth, np.eye(3))
    parameters[0] += rng.choice([-1.0, 1.0]) * heading_error_deg
    parameters[1:3] += rng.normal(0, 1.0, 2)
    offset = rng.normal(size=3)
    parameters[3:6] += START_OFFSET_M * offset / np.linalg.norm(offset)
    parameters[6] += rng.normal(0, 0.02)
    return PointTrial(
        truth, view_from_parameters(truth, np.eye(3), parameters), Correspondences(observed, position), outlier
    )


@dataclass(frozen=True)
class PointScore:
    """Errors of a resection against the ground truth.

    Parameters
    ----------
    heading_error_deg
        Absolute heading error [deg].
    focal_error
        Absolute relative error of the focal length.
    position_error_m
        Error ``(3,)`` of east, north and up [m].
    within_two_sigma
        ``(3,)`` bool, whether the error of each coordinate is within two standard deviations.
    outliers_found
        Whether all outliers were rejected.
    """

    heading_error_deg: float
    focal_error: float
    position_error_m: np.ndarray
    within_two_sigma: np.ndarray
    outliers_found: bool


def score_points(trial: PointTrial, *, noise_px: float | None = None, loss: Loss = "cauchy") -> PointScore:
    """Calibrate a trial and compare the result with the ground truth.

    Parameters
    ----------
    trial
        Synthetic trial.
    noise_px
        Standard deviation of a pixel coordinate [px]; estimated if ``None``.
    loss
        Robust loss, as in `ResectionOptions`.

    Returns
    -------
    PointScore
        Errors of the result.

    Raises
    ------
    NotEnoughEvidence
        As `resect`.
    """
    priors = Priors(horizontal_m=START_SIGMA_M, vertical_m=START_SIGMA_M)
    options = ResectionOptions(loss=loss, noise_px=noise_px)
    solved: Calibration = resect(trial.start, trial.points, priors=priors, options=options)
    truth = parameters_of_view(trial.truth, np.eye(3))
    error = solved.parameters - truth
    sigma = np.array([solved.sigma[name] for name in ("east_m", "north_m", "up_m")])
    return PointScore(
        abs((error[0] + 180.0) % 360.0 - 180.0),
        abs(solved.view.fy / trial.truth.fy - 1.0),
        error[3:6],
        np.abs(error[3:6]) <= 2.0 * sigma,
        bool(solved.outlier[trial.outlier].all()),
    )


def reproject(trial: PointTrial) -> np.ndarray:
    """Project the points of a trial with its true view, for tests of the trial itself.

    Parameters
    ----------
    trial
        Synthetic trial of N points.

    Returns
    -------
    ndarray
        True pixels ``(N, 2)``.
    """
    axes = np.eye(3)
    return project_with_parameters(trial.truth, axes, parameters_of_view(trial.truth, axes), trial.points.position_m)[0]
