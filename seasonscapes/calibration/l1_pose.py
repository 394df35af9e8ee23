"""Heading and focal lengths of a plane view from 2D–3D points under an L1 loss, as in the SeasonScapes paper.

Position, tilt, roll and principal point are known; heading, ``fx`` and ``fy`` minimise the sum of the absolute errors of
columns and rows. At a given heading columns depend on ``fx`` alone and rows on ``fy`` alone, and the best focal length is a
weighted median, exactly. What remains is a search along the circle, which no start can mislead.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from seasonscapes.calibration.evidence import Correspondences
from seasonscapes.calibration.pose_model import angles_from_rotation
from seasonscapes.calibration.resection import Calibration
from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.errors import NotEnoughEvidence

_FEWEST = _UNKNOWNS = 3
# Focal lengths within this factor of the stated ones.
_MOST_FOCAL_FACTOR = 2.0
# Steps of the search along the circle, and those about the best one [deg].
_STEPS_DEG = (0.25, 0.01, 4e-4, 2e-5)
# A point this near to the camera's plane, relative to its distance, counts as behind it.
_LEAST_DEPTH = 0.02


def l1_pose(start: Camera, points: Correspondences) -> Calibration:
    """Solve heading, ``fx`` and ``fy`` of a camera under an L1 loss.

    Parameters
    ----------
    start
        Camera with known position, tilt, roll and principal point; its heading is arbitrary, its focal lengths are within
        a factor of two.
    points
        Correspondences of N ≥ 3 points in its pixels, without lens distortion.

    Returns
    -------
    Calibration
        No point is set aside: outliers pull an L1 fit little. The covariance is that of an L1 fit to Gaussian errors, π/2
        of a least-squares fit's; their standard deviation ``noise_px`` follows from the mean absolute error. The parameter
        ``focal`` is the geometric mean of both focal lengths over the stated ones.

    Raises
    ------
    NotEnoughEvidence
        If there are fewer than three points, the points have no heading in common, or leave an unknown undetermined.

    Examples
    --------
    >>> import numpy as np
    >>> from seasonscapes.calibration.evidence import Correspondences
    >>> from seasonscapes.calibration.l1_pose import l1_pose
    >>> from seasonscapes.cameras.pinhole import Camera, project, rotation_from_angles
    >>> pose = np.eye(4)
    >>> pose[:3, :3] = rotation_from_angles(30.0, 0.0)
    >>> true = Camera(600, 400, 500.0, 510.0, 300.0, 200.0, pose)
    >>> position = np.array([[900.0, 2100.0, 100.0], [1500.0, 1800.0, -200.0], [200.0, 3000.0, 400.0]])
    >>> seen = Correspondences(project(true, position)[0], position)
    >>> turned = np.eye(4)
    >>> turned[:3, :3] = rotation_from_angles(210.0, 0.0)
    >>> found = l1_pose(Camera(600, 400, 400.0, 400.0, 300.0, 200.0, turned), seen)
    >>> [round(float(value), 3) for value in (found.parameters[0], found.view.fx, found.view.fy)]
    [30.0, 500.0, 510.0]
    """
    if len(points) < _FEWEST:
        raise NotEnoughEvidence(f"{len(points)} points for heading, fx and fy: at least {_FEWEST} are needed")
    _, tilt_deg, roll_deg = angles_from_rotation(start.world_from_camera[:3, :3])
    heading_deg, half_deg = 180.0, 180.0
    for step_deg in _STEPS_DEG:
        trials = heading_deg + np.arange(-half_deg, half_deg + step_deg / 2.0, step_deg)
        loss = _losses(start, points, trials, tilt_deg, roll_deg)[0]
        heading_deg, half_deg = float(trials[np.argmin(loss)]), 2.0 * step_deg
    (loss,), (fx,), (fy,) = _losses(start, points, np.array([heading_deg]), tilt_deg, roll_deg)
    pose = start.world_from_camera.copy()
    pose[:3, :3] = rotation_from_angles(heading_deg, tilt_deg, roll_deg)
    view = replace(start, fx=float(fx), fy=float(fy), world_from_camera=pose)
    error, depth = _errors(view, points)
    limit = 0.04 * start.width_px
    if not (depth > 0.0).all() or np.median(np.abs(error)) > limit:
        raise NotEnoughEvidence(
            "the correspondences have no heading in common: median error "
            f"{np.median(np.abs(error)):.0f} px; check their pairing and the camera's position"
        )
    noise_px = max(float(loss) / max(error.size - _UNKNOWNS, 1), 1e-6) * np.sqrt(np.pi / 2.0)
    covariance, focal = np.zeros((9, 9)), np.sqrt(fx * fy / (start.fx * start.fy))
    covariance[np.ix_([0, 6], [0, 6])] = _covariance(view, points, noise_px)
    parameters = np.array([heading_deg % 360.0, tilt_deg, roll_deg, *start.position_m, np.log(focal), 0.0, 0.0])
    none = np.zeros(len(points), bool)
    return Calibration(view, 0.0, parameters, covariance, points.names, error, none, noise_px)


def _losses(
    start: Camera, points: Correspondences, heading_deg: np.ndarray, tilt_deg: float, roll_deg: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least sum of absolute errors [px] at each heading ``(H,)``, and the ``fx`` and ``fy`` [px] of it."""
    sin, cos = np.sin(np.radians(heading_deg)), np.cos(np.radians(heading_deg))
    zero, one = np.zeros_like(sin), np.ones_like(sin)
    about_up = np.stack([cos, sin, zero, -sin, cos, zero, zero, zero, one], axis=-1).reshape(-1, 3, 3)
    rotations = about_up @ rotation_from_angles(0.0, tilt_deg, roll_deg)
    local = np.einsum("ni,hij->hnj", points.position_m - start.position_m, rotations)
    depth, distance = local[..., 2], np.linalg.norm(local, axis=-1)
    in_front = depth > _LEAST_DEPTH * distance
    ratio = local[..., :2] / np.where(in_front, depth, np.inf)[..., None]
    offset = points.pixel - [start.cx, start.cy]
    total, focal = np.zeros(len(heading_deg)), []
    for axis, stated in enumerate((start.fx, start.fy)):
        best = _weighted_medians(offset[:, axis], ratio[..., axis])
        best = np.clip(best, stated / _MOST_FOCAL_FACTOR, stated * _MOST_FOCAL_FACTOR)
        focal.append(best)
        errors = np.abs(best[:, None] * ratio[..., axis] - offset[:, axis])
        # Nothing is farther off than what lies behind.
        total += np.where(in_front, errors, start.width_px + np.abs(offset[:, axis])).sum(axis=1)
    return total, focal[0], focal[1]


def _weighted_medians(offset: np.ndarray, ratio: np.ndarray) -> np.ndarray:
    """The ``f`` ``(H,)`` that minimise ``Σ |f ratio − offset|`` for ratios ``(H, N)`` and offsets ``(N,)``."""
    weight = np.abs(ratio)
    slope = np.where(weight > 1e-12, offset / np.where(weight > 1e-12, ratio, 1.0), 0.0)
    order = np.argsort(slope, axis=1)
    cumulated = np.cumsum(np.take_along_axis(weight, order, axis=1), axis=1)
    middle = np.argmax(cumulated >= 0.5 * cumulated[:, -1:], axis=1)
    return np.take_along_axis(slope, np.take_along_axis(order, middle[:, None], axis=1), axis=1)[:, 0]


def _errors(view: Camera, points: Correspondences) -> tuple[np.ndarray, np.ndarray]:
    """Projected minus observed pixels ``(N, 2)``, and depths ``(N,)`` [m]."""
    local = (points.position_m - view.position_m) @ view.world_from_camera[:3, :3]
    pixel = local[:, :2] / local[:, 2:] * [view.fx, view.fy] + [view.cx, view.cy]
    return pixel - points.pixel, local[:, 2]


def _covariance(view: Camera, points: Correspondences, noise_px: float) -> np.ndarray:
    """Covariance ``(2, 2)`` of heading [deg] and the logarithm of the mean focal length."""
    step_deg, angles = 1e-4, angles_from_rotation(view.world_from_camera[:3, :3])
    turned = view.world_from_camera.copy()
    turned[:3, :3] = rotation_from_angles(angles[0] + step_deg, *angles[1:])
    error, _ = _errors(view, points)
    by_heading = (_errors(replace(view, world_from_camera=turned), points)[0] - error) / step_deg
    seen = error + points.pixel - [view.cx, view.cy]
    # Columns: heading, log fx, log fy; rows: columns and rows of all points.
    jacobian = np.zeros((*error.shape, 3))
    jacobian[..., 0], jacobian[:, 0, 1], jacobian[:, 1, 2] = by_heading, seen[:, 0], seen[:, 1]
    information = np.einsum("nai,naj->ij", jacobian, jacobian) / noise_px**2
    size = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    if np.linalg.eigvalsh(information * np.outer(size, size))[0] < 1e-9:
        raise NotEnoughEvidence("the points leave heading, fx or fy undetermined; add points elsewhere in the picture")
    mean = np.array([[1.0, 0.0, 0.0], [0.0, 0.5, 0.5]])
    return 0.5 * np.pi * mean @ np.linalg.inv(information) @ mean.T
