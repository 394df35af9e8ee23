"""One term of radial lens distortion: between what a lens draws and what the ideal pinhole would.

``x_d = x (1 + k1 r²)`` on normalised image coordinates (Brown 1966; the first term of OpenCV's model). A negative
``k1`` is barrel distortion. `Camera` stays an ideal pinhole: pictures are rectified once, when they come in.
"""

from __future__ import annotations

import cv2
import numpy as np

from seasonscapes.cameras.pinhole import Camera


def distort(pixel, camera: Camera, k1: float) -> np.ndarray:
    """Pixels of the lens ``(..., 2)`` from pixels of the ideal pinhole.

    Beyond the radius where the polynomial turns back (``k1 < 0``) there is no such pixel: NaN.
    """
    normal = (np.asarray(pixel, float) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    squared = np.sum(normal**2, axis=-1, keepdims=True)
    bent = normal * (1.0 + k1 * squared)
    return np.where(1.0 + 3.0 * k1 * squared > 0.0, bent, np.nan) * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def undistort(pixel, camera: Camera, k1: float) -> np.ndarray:
    """Pixels of the ideal pinhole ``(..., 2)`` from pixels of the lens; the exact inverse of `distort` (Newton).

    Pixels that no ray reaches (``k1 < 0``, beyond the fold) are NaN.
    """
    normal = (np.asarray(pixel, float) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    bent = np.linalg.norm(normal, axis=-1, keepdims=True)
    fold = 1.0 / np.sqrt(-3.0 * k1) if k1 < 0 else np.inf
    radius = np.minimum(bent, 0.999 * fold)
    for _ in range(12):
        radius = np.minimum(radius - (radius + k1 * radius**3 - bent) / (1.0 + 3.0 * k1 * radius**2), 0.9999 * fold)
    radius = np.where(np.abs(radius + k1 * radius**3 - bent) < 1e-9 * (1.0 + bent), radius, np.nan)
    scale = np.divide(radius, bent, out=np.ones_like(bent), where=bent > 1e-12)
    return normal * scale * [camera.fx, camera.fy] + [camera.cx, camera.cy]


def rectify(image: np.ndarray, camera: Camera, k1: float) -> tuple[np.ndarray, np.ndarray]:
    """A linear picture ``(H, W, 3)`` of the lens as the ideal pinhole ``camera`` sees it, and where it is covered."""
    x, y = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    source = distort(np.stack([x, y], axis=-1), camera, k1)
    size = np.array([image.shape[1], image.shape[0]])
    inside = (np.isfinite(source) & (source >= 0.0) & (source <= size)).all(axis=-1)
    source = np.nan_to_num(source, nan=-1e4).astype(np.float32) - np.float32(0.5)
    values = np.ascontiguousarray(image, np.float32)
    bent = cv2.remap(values, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.maximum(bent, 0.0) * inside[..., None], inside
