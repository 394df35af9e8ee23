"""Where a picture must not be trusted: beside silhouettes, in the sky, before the near limit, where it is clipped."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from seasonscapes.cameras.pinhole import Camera

# Neighbouring pixels whose distances differ by more than this ratio show two surfaces.
JUMP_RATIO = 1.1
# Displacements beyond this are no matter of a guard; the pose wants calibrating.
_WIDEST_PX = 64.0


def depth_jumps(depth_m: np.ndarray, *, ratio: float = JUMP_RATIO) -> np.ndarray:
    """Pixels ``(H, W)`` bool on either side of a jump of distance ``depth_m`` ``(H, W)`` [m]; infinite is sky."""
    distance = np.log(np.clip(depth_m, 1e-3, 1e9))
    jump = np.zeros(depth_m.shape, bool)
    across = np.abs(np.diff(distance, axis=1)) > np.log(ratio)
    down = np.abs(np.diff(distance, axis=0)) > np.log(ratio)
    jump[:, :-1] |= across
    jump[:, 1:] |= across
    jump[:-1] |= down
    jump[1:] |= down
    return jump


def pose_sigma_px(camera: Camera, sigma: Mapping[str, float], depth_m: np.ndarray) -> np.ndarray:
    """By how many pixels a pose's uncertainty moves what is seen at distances ``(H, W)`` [m], one standard deviation.

    Parameters
    ----------
    sigma
        Standard deviations with the names of a calibration record: ``heading_deg, tilt_deg, roll_deg, east_m, north_m,
        up_m, focal``. Names that are missing count as exact.
    """
    focal = 0.5 * (camera.fx + camera.fy)
    reach = 0.25 * np.hypot(camera.width_px, camera.height_px)  # of a typical pixel from the middle
    turn = np.radians([sigma.get("heading_deg", 0.0), sigma.get("tilt_deg", 0.0)]) * focal
    about = np.array([np.radians(sigma.get("roll_deg", 0.0)), sigma.get("focal", 0.0)]) * reach
    shift_m = max(sigma.get(name, 0.0) for name in ("east_m", "north_m", "up_m"))
    angular = np.sqrt(np.sum(turn**2) / 2.0 + np.sum(about**2))
    return np.hypot(angular, focal * shift_m / np.maximum(depth_m, 1.0))


def silhouette_guard(
    depth_m: np.ndarray, sigma_px: np.ndarray | float = 0.0, *, ratio: float = JUMP_RATIO
) -> np.ndarray:
    """Trust ``(H, W)`` float32 in [0, 1]: 0 beside a jump of distance, 1 from ``1 + 1.5 sigma_px`` pixels away on.

    Parameters
    ----------
    depth_m
        ``(H, W)`` distance along the rays [m]; infinite is sky, where trust is 0.
    sigma_px
        Scalar or ``(H, W)`` from `pose_sigma_px`: at a silhouette that of its nearer side decides.
    """
    jump = depth_jumps(depth_m, ratio=ratio)
    confidence = np.isfinite(depth_m).astype(np.float32)
    if not jump.any():
        return confidence
    sigma = np.broadcast_to(np.asarray(sigma_px, np.float32), depth_m.shape)
    # A silhouette moves as its nearer side does.
    worst = cv2.dilate(np.where(jump, np.minimum(sigma, _WIDEST_PX), 0.0).astype(np.float32), np.ones((3, 3), np.uint8))
    away, label = cv2.distanceTransformWithLabels(
        (~jump).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    at_jump = np.zeros(int(label.max()) + 1, np.float32)
    at_jump[label[jump]] = worst[jump]
    share = np.clip(away / (1.0 + 1.5 * at_jump[label]), 0.0, 1.0)
    return confidence * (share * share * (3.0 - 2.0 * share)).astype(np.float32)


def picture_mask(image: np.ndarray, mask: np.ndarray, depth_m: np.ndarray, *, near_m: float) -> np.ndarray:
    """Usable pixels ``(H, W)`` bool: masked in, finite, on terrain and not nearer than ``near_m`` [m]."""
    return mask & np.isfinite(image).all(axis=2) & np.isfinite(depth_m) & (depth_m >= near_m)
