"""Initial camera rotation from pairs of correspondences, robust to outliers and independent of the start rotation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from seasonscapes.calibration.evidence import Correspondences
from seasonscapes.calibration.pose_model import View, bearings
from seasonscapes.errors import NotEnoughEvidence

_MAX_PAIRS = 1500


def rotation_among_pairs(view: View, k1: float, points: Correspondences) -> np.ndarray:
    """Estimate the rotation that most correspondences agree on, at the position and focal length of a view.

    Every pair of points yields one rotation hypothesis (Kabsch 1976). The hypothesis with the smallest truncated sum of
    angles is refined by iteratively reweighted least squares towards the smallest sum of angles.

    Parameters
    ----------
    view
        Camera or panorama; its rotation is not used.
    k1
        Radial distortion coefficient.
    points
        Correspondences of at least two points.

    Returns
    -------
    ndarray
        ``world_from_camera`` rotation ``(3, 3)``.

    Raises
    ------
    NotEnoughEvidence
        If a pixel lies outside the lens model, or a point coincides with the camera.
    """
    camera_rays, world_rays = _camera_rays(view, k1, points), _world_rays(view, points)
    return _best_rotation(camera_rays, world_rays)[0]


def check_orientation(view: View, k1: float, points: Correspondences, rotation: np.ndarray, axes: np.ndarray) -> None:
    """Check that the correspondences are not mirrored, upside down or in reverse order.

    Parameters
    ----------
    view
        Camera or panorama at its start pose.
    k1
        Radial distortion coefficient.
    points
        Correspondences.
    rotation
        ``world_from_camera`` rotation ``(3, 3)`` estimated from them (`rotation_among_pairs`).
    axes
        East, north and up at the camera, rows ``(3, 3)``.

    Raises
    ------
    NotEnoughEvidence
        If mirrored or reversed correspondences fit clearly better, or the rotation turns the camera upside down.
    """
    camera_rays, world_rays = _camera_rays(view, k1, points), _world_rays(view, points)
    cost = _cost(camera_rays @ rotation.T, world_rays)
    if len(points) >= 4:
        for altered_rays, message in (
            (
                camera_rays * [-1.0, 1.0, 1.0],
                "mirrored left to right or top to bottom (x_px from the left, y_px from the top)",
            ),
            (camera_rays[::-1], "in reverse order (the first pixel belongs to the last position)"),
        ):
            altered, altered_cost = _best_rotation(altered_rays, world_rays)
            if altered_cost < 0.35 * cost and cost > 0.01 and _is_upright(view, altered, axes, either_sign=True):
                raise NotEnoughEvidence(f"the correspondences fit only {message}")
    if not _is_upright(view, rotation, axes):
        raise NotEnoughEvidence(
            "the correspondences turn the camera upside down: pixel coordinates are rotated or mirrored"
        )


def _is_upright(view: View, rotation: np.ndarray, axes: np.ndarray, *, either_sign: bool = False) -> bool:
    down_estimated, down_start = rotation[:, 1] @ axes[2], view.world_from_camera[:3, 1] @ axes[2]
    agreement = down_estimated * down_start
    return abs(agreement) > 0.25 if either_sign else agreement > 0.25


def _camera_rays(view: View, k1: float, points: Correspondences) -> np.ndarray:
    pose = np.eye(4)
    rays = bearings(replace(view, world_from_camera=pose), k1, points.pixel)
    invalid = ~np.isfinite(rays).all(axis=1)
    if invalid.any():
        name = points.names[int(np.argmax(invalid))]
        raise NotEnoughEvidence(f"point {name}: its pixel lies outside the valid range of the lens model")
    return rays


def _world_rays(view: View, points: Correspondences) -> np.ndarray:
    offset = points.position_m - view.position_m
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    if (length < 0.1).any():
        raise NotEnoughEvidence(f"point {points.names[int(np.argmin(length))]} coincides with the camera position")
    return offset / length


def _cost(rotated: np.ndarray, world_rays: np.ndarray) -> np.ndarray:
    """Mean angle between rays ``(..., N, 3)`` [rad], each truncated at 6°."""
    angle = np.arccos(np.clip(np.sum(rotated * world_rays, axis=-1), -1.0, 1.0))
    return np.minimum(angle, 0.105).mean(axis=-1)


def _best_rotation(camera_rays: np.ndarray, world_rays: np.ndarray) -> tuple[np.ndarray, float]:
    """Rotation ``(3, 3)`` of the smallest cost and its cost [rad]."""
    first, second = np.triu_indices(len(camera_rays), 1)
    if len(first) > _MAX_PAIRS:
        chosen = np.random.default_rng(0).choice(len(first), _MAX_PAIRS, replace=False)
        first, second = first[chosen], second[chosen]
    moment = np.einsum("pi,pj->pij", world_rays[first], camera_rays[first]) + np.einsum(
        "pi,pj->pij", world_rays[second], camera_rays[second]
    )
    rotation = nearest_rotations(moment)
    costs = _cost(np.einsum("pij,nj->pni", rotation, camera_rays), world_rays)
    best, cost = rotation[np.argmin(costs)], float(costs.min())
    for _ in range(20):
        angle = np.arccos(np.clip(np.sum(camera_rays @ best.T * world_rays, axis=1), -1.0, 1.0))
        weight = 1.0 / np.maximum(angle, 1e-4)
        refined = nearest_rotations(np.einsum("n,ni,nj->ij", weight, world_rays, camera_rays)[None])[0]
        refined_cost = float(_cost(camera_rays @ refined.T, world_rays))
        if refined_cost >= cost - 1e-9:
            break
        best, cost = refined, refined_cost
    return best, cost


def nearest_rotations(moment: np.ndarray) -> np.ndarray:
    """Rotations ``(P, 3, 3)`` that maximise the trace with moment matrices ``(P, 3, 3)`` (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(moment)
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt
