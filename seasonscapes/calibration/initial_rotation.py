"""The first rotation: from pairs of matched points, whatever the start and however many matches are wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from seasonscapes.calibration.evidence import Correspondences
from seasonscapes.calibration.pose_model import View, bearings

_MOST_PAIRS = 1500


def rotation_among_pairs(view: View, k1: float, points: Correspondences) -> np.ndarray:
    """``world_from_camera`` rotation ``(3, 3)`` that most points agree on, from the start's position and lens.

    Every pair of points gives one rotation (Kabsch 1976). That of the least truncated sum of angles wins and is refined
    by reweighted least squares towards the least sum of angles.
    """
    seen, towards = _camera_rays(view, k1, points), _world_rays(view, points)
    return _best_rotation(seen, towards)[0]


def check_orientation(view: View, k1: float, points: Correspondences, rotation: np.ndarray, axes: np.ndarray) -> None:
    """`ValueError` where the matches only make sense mirrored, upside down or in reverse order."""
    seen, towards = _camera_rays(view, k1, points), _world_rays(view, points)
    cost = _cost(seen @ rotation.T, towards)
    if len(points) >= 4:
        for flipped, message in (
            (
                seen * [-1.0, 1.0, 1.0],
                "mirrored left to right or top to bottom (x_px from the left, y_px from the top)",
            ),
            (seen[::-1], "in reverse order (the first pixel belongs to the last position)"),
        ):
            other, other_cost = _best_rotation(flipped, towards)
            if other_cost < 0.35 * cost and cost > 0.01 and _upright(view, other, axes, sign_free=True):
                raise ValueError(f"the matches fit only {message}")
    if not _upright(view, rotation, axes):
        raise ValueError("the matches put the camera on its head: pixel coordinates are turned or mirrored")


def _upright(view: View, rotation: np.ndarray, axes: np.ndarray, *, sign_free: bool = False) -> bool:
    down_now, down_then = rotation[:, 1] @ axes[2], view.world_from_camera[:3, 1] @ axes[2]
    agreement = down_now * down_then
    return abs(agreement) > 0.25 if sign_free else agreement > 0.25


def _camera_rays(view: View, k1: float, points: Correspondences) -> np.ndarray:
    pose = np.eye(4)
    rays = bearings(replace(view, world_from_camera=pose), k1, points.pixel)
    bad = ~np.isfinite(rays).all(axis=1)
    if bad.any():
        raise ValueError(f"point {points.names[int(np.argmax(bad))]}: the lens has no ray at that pixel")
    return rays


def _world_rays(view: View, points: Correspondences) -> np.ndarray:
    offset = points.position_m - view.position_m
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    if (length < 0.1).any():
        raise ValueError(f"point {points.names[int(np.argmin(length))]} is at the camera itself")
    return offset / length


def _cost(turned: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Mean angle [rad], each truncated at 6°."""
    angle = np.arccos(np.clip(np.sum(turned * towards, axis=-1), -1.0, 1.0))
    return np.minimum(angle, 0.105).mean(axis=-1)


def _best_rotation(seen: np.ndarray, towards: np.ndarray) -> tuple[np.ndarray, float]:
    first, second = np.triu_indices(len(seen), 1)
    if len(first) > _MOST_PAIRS:
        chosen = np.random.default_rng(0).choice(len(first), _MOST_PAIRS, replace=False)
        first, second = first[chosen], second[chosen]
    moment = np.einsum("pi,pj->pij", towards[first], seen[first]) + np.einsum(
        "pi,pj->pij", towards[second], seen[second]
    )
    rotation = _nearest_rotation(moment)
    costs = _cost(np.einsum("pij,nj->pni", rotation, seen), towards)
    best, cost = rotation[np.argmin(costs)], float(costs.min())
    for _ in range(20):
        angle = np.arccos(np.clip(np.sum(seen @ best.T * towards, axis=1), -1.0, 1.0))
        weight = 1.0 / np.maximum(angle, 1e-4)
        refined = _nearest_rotation(np.einsum("n,ni,nj->ij", weight, towards, seen)[None])[0]
        refined_cost = float(_cost(seen @ refined.T, towards))
        if refined_cost >= cost - 1e-9:
            break
        best, cost = refined, refined_cost
    return best, cost


def _nearest_rotation(moment: np.ndarray) -> np.ndarray:
    u, _, vt = np.linalg.svd(moment)
    u[..., :, 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt
