"""Confidence of pixels near silhouettes from the pose uncertainty, and the mask of pixels that show usable terrain."""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from seasonscapes.cameras.pinhole import Camera

# Neighbouring pixels whose distances differ by more than this ratio belong to different surfaces.
JUMP_RATIO = 1.1
# Upper limit of the displacement [px]; beyond it the pose needs calibration, not a wider guard band.
_MAX_SIGMA_PX = 64.0


def depth_jumps(depth_m: np.ndarray, *, ratio: float = JUMP_RATIO) -> np.ndarray:
    """Return the pixels on either side of a depth discontinuity.

    Parameters
    ----------
    depth_m
        ``(H, W)`` distance along the rays [m]; infinite is sky.
    ratio
        Least ratio of the distances of two neighbouring pixels.

    Returns
    -------
    ndarray
        ``(H, W)`` bool.
    """
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
    """Return the standard deviation of the image position of terrain that follows from the pose uncertainty.

    Parameters
    ----------
    camera
        The view.
    sigma
        Standard deviations by the names of a calibration record: ``heading_deg, tilt_deg, roll_deg, east_m, north_m,
        up_m, focal``. Missing names count as exact.
    depth_m
        ``(H, W)`` distance of the terrain [m].

    Returns
    -------
    ndarray
        ``(H, W)`` [px].
    """
    focal = 0.5 * (camera.fx + camera.fy)
    radius = 0.25 * np.hypot(camera.width_px, camera.height_px)  # typical distance from the image centre
    rotation = np.radians([sigma.get("heading_deg", 0.0), sigma.get("tilt_deg", 0.0)]) * focal
    off_axis = np.array([np.radians(sigma.get("roll_deg", 0.0)), sigma.get("focal", 0.0)]) * radius
    shift_m = max(sigma.get(name, 0.0) for name in ("east_m", "north_m", "up_m"))
    angular = np.sqrt(np.sum(rotation**2) / 2.0 + np.sum(off_axis**2))
    return np.hypot(angular, focal * shift_m / np.maximum(depth_m, 1.0))


def silhouette_guard(
    depth_m: np.ndarray, sigma_px: np.ndarray | float = 0.0, *, ratio: float = JUMP_RATIO
) -> np.ndarray:
    """Return a confidence that rises from 0 at depth discontinuities to 1 at a distance of ``1 + 1.5 sigma_px`` pixels.

    Parameters
    ----------
    depth_m
        ``(H, W)`` distance along the rays [m]; infinite is sky, where the confidence is 0.
    sigma_px
        Scalar or ``(H, W)`` from `pose_sigma_px` [px]. At a silhouette the value of its nearer side applies.
    ratio
        As in `depth_jumps`.

    Returns
    -------
    ndarray
        ``(H, W)`` float32 in [0, 1].
    """
    jump = depth_jumps(depth_m, ratio=ratio)
    confidence = np.isfinite(depth_m).astype(np.float32)
    if not jump.any():
        return confidence
    sigma = np.broadcast_to(np.asarray(sigma_px, np.float32), depth_m.shape)
    # The image position of a silhouette is that of its nearer side, which has the larger sigma.
    jump_sigma = cv2.dilate(
        np.where(jump, np.minimum(sigma, _MAX_SIGMA_PX), 0.0).astype(np.float32), np.ones((3, 3), np.uint8)
    )
    distance_px, label = cv2.distanceTransformWithLabels(
        (~jump).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    label = label.astype(np.intp)
    sigma_of_label = np.zeros(int(label.max()) + 1, np.float32)
    sigma_of_label[label[jump]] = jump_sigma[jump]
    ramp = np.clip(distance_px / (1.0 + 1.5 * sigma_of_label[label]), 0.0, 1.0)
    return confidence * (ramp * ramp * (3.0 - 2.0 * ramp)).astype(np.float32)


def picture_mask(image: np.ndarray, mask: np.ndarray, depth_m: np.ndarray, *, near_m: float) -> np.ndarray:
    """Return the usable pixels: unmasked, finite, on terrain and not nearer than the near limit.

    Parameters
    ----------
    image
        ``(H, W, 3)``.
    mask
        ``(H, W)`` bool, True = usable.
    depth_m
        ``(H, W)`` distance along the rays [m]; infinite is sky.
    near_m
        Near limit [m].

    Returns
    -------
    ndarray
        ``(H, W)`` bool.
    """
    return mask & np.isfinite(image).all(axis=2) & np.isfinite(depth_m) & (depth_m >= near_m)
