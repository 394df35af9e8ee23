"""Radial lens distortion with one coefficient: distortion, its exact inverse, and rectification of images.

``x_d = x (1 + k1 r²)`` on normalised image coordinates (Brown 1966; the first term of OpenCV's model). A negative
``k1`` is barrel distortion. `Camera` has no distortion: images are rectified once, when they are read.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.cameras.pinhole import Camera


def distort(pixel: ArrayLike, camera: Camera, k1: float) -> np.ndarray:
    """Map pixels of the ideal pinhole to pixels of the distorted image.

    Parameters
    ----------
    pixel
        Undistorted pixel coordinates ``(..., 2)``.
    camera
        Intrinsics.
    k1
        Radial distortion coefficient.

    Returns
    -------
    numpy.ndarray
        Distorted pixel coordinates ``(..., 2)``; NaN beyond the radius where the polynomial is no longer monotone
        (``k1 < 0``).
    """
    normal = (np.asarray(pixel, float) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    squared = np.sum(normal**2, axis=-1, keepdims=True)
    distorted = normal * (1.0 + k1 * squared)
    return np.where(1.0 + 3.0 * k1 * squared > 0.0, distorted, np.nan) * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def undistort(pixel: ArrayLike, camera: Camera, k1: float) -> np.ndarray:
    """Map pixels of the distorted image to pixels of the ideal pinhole; the inverse of `distort` by Newton's method.

    Parameters
    ----------
    pixel
        Distorted pixel coordinates ``(..., 2)``.
    camera
        Intrinsics.
    k1
        Radial distortion coefficient.

    Returns
    -------
    numpy.ndarray
        Undistorted pixel coordinates ``(..., 2)``; NaN outside the range of `distort` (``k1 < 0``).
    """
    normal = (np.asarray(pixel, float) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    distorted_radius = np.linalg.norm(normal, axis=-1, keepdims=True)
    fold = 1.0 / np.sqrt(-3.0 * k1) if k1 < 0 else np.inf
    radius = np.minimum(distorted_radius, 0.999 * fold)
    for _ in range(12):
        radius = np.minimum(
            radius - (radius + k1 * radius**3 - distorted_radius) / (1.0 + 3.0 * k1 * radius**2), 0.9999 * fold
        )
    radius = np.where(
        np.abs(radius + k1 * radius**3 - distorted_radius) < 1e-9 * (1.0 + distorted_radius), radius, np.nan
    )
    scale = np.divide(radius, distorted_radius, out=np.ones_like(distorted_radius), where=distorted_radius > 1e-12)
    return normal * scale * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def rectify(image: np.ndarray, camera: Camera, k1: float) -> tuple[np.ndarray, np.ndarray]:
    """Resample a distorted image to the ideal pinhole camera (bicubic).

    Parameters
    ----------
    image
        Scene-linear image ``(H, W, 3)`` with distortion.
    camera
        Pinhole camera of the result.
    k1
        Radial distortion coefficient.

    Returns
    -------
    image
        Rectified image ``(H, W, 3)`` float32, 0 outside the source image.
    inside
        ``(H, W)`` bool, True where the source image covers the pixel.
    """
    x, y = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    source = distort(np.stack([x, y], axis=-1), camera, k1)
    size = np.array([image.shape[1], image.shape[0]])
    inside = np.all(np.isfinite(source) & (source >= 0.0) & (source <= size), axis=-1)
    source = np.nan_to_num(source, nan=-1e4).astype(np.float32) - np.float32(0.5)
    values = np.ascontiguousarray(image, np.float32)
    rectified = cv2.remap(values, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.maximum(rectified, 0.0) * inside[..., None], inside
