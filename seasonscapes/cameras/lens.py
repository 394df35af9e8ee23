"""Lens distortion of Brown's model: distortion, its inverse, and rectification of images.

On normalised image coordinates ``(x, y)`` with ``r² = x² + y²`` (Brown 1966; the rational model of OpenCV)::

    s  = (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)
    x' = s x + 2 p1 x y + p2 (r² + 2 x²)
    y' = s y + p1 (r² + 2 y²) + 2 p2 x y

A negative ``k1`` is barrel distortion. `Camera` has no distortion: images are rectified once, when they are read.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.cameras.pinhole import Camera


@dataclass(frozen=True)
class Lens:
    """Coefficients of the distortion of a perspective camera; all zero is an ideal pinhole.

    Parameters
    ----------
    k1, k2, k3
        Radial coefficients of the numerator.
    k4, k5, k6
        Radial coefficients of the denominator.
    p1, p2
        Tangential coefficients.

    Examples
    --------
    >>> from seasonscapes.cameras.lens import Lens
    >>> Lens(k1=-0.1).is_ideal, Lens().is_ideal
    (False, True)
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def __post_init__(self):
        if not np.isfinite(astuple(self)).all():
            raise ValueError(f"Lens: got {astuple(self)}, expected finite coefficients")

    @property
    def is_ideal(self) -> bool:
        """Whether all coefficients are zero."""
        return not any(astuple(self))

    @property
    def opencv(self) -> np.ndarray:
        """The coefficients ``(8,)`` in OpenCV's order k1, k2, p1, p2, k3, k4, k5, k6."""
        return np.array([self.k1, self.k2, self.p1, self.p2, self.k3, self.k4, self.k5, self.k6])

    @cached_property
    def fold(self) -> float:
        """Normalised radius up to which the radial distortion is monotone; infinite where it is so everywhere."""
        if not any((self.k2, self.k3, self.k4, self.k5, self.k6)):
            return 1.0 / math.sqrt(-3.0 * self.k1) if self.k1 < 0 else math.inf
        # In s = r²: the derivative of r N/D has the sign of (N + 2 s N') D - 2 s N D'; a root of D is a pole.
        above = np.polynomial.Polynomial([1.0, self.k1, self.k2, self.k3])
        below = np.polynomial.Polynomial([1.0, self.k4, self.k5, self.k6])
        s = np.polynomial.Polynomial([0.0, 1.0])
        slope = (above + 2.0 * s * above.deriv()) * below - 2.0 * s * above * below.deriv()
        roots = np.concatenate([slope.trim(1e-15).roots(), below.trim(1e-15).roots()])
        real = roots.real[(np.abs(roots.imag) < 1e-9 * (1.0 + np.abs(roots.real))) & (roots.real > 1e-12)]
        return float(np.sqrt(real.min())) if len(real) else math.inf

    def distorted(self, normal: np.ndarray) -> np.ndarray:
        """Distorted normalised coordinates ``(..., 2)`` of ideal ones; not meaningful beyond `fold`."""
        x, y = normal[..., 0], normal[..., 1]
        squared = x * x + y * y
        scale = 1.0 + squared * (self.k1 + squared * (self.k2 + squared * self.k3))
        if self.k4 or self.k5 or self.k6:
            scale = scale / (1.0 + squared * (self.k4 + squared * (self.k5 + squared * self.k6)))
        across = 2.0 * self.p1 * x * y + self.p2 * (squared + 2.0 * x * x)
        along = self.p1 * (squared + 2.0 * y * y) + 2.0 * self.p2 * x * y
        return np.stack([scale * x + across, scale * y + along], axis=-1)


def lens_of(lens: Lens | float) -> Lens:
    """The lens itself, or that of a single coefficient ``k1``."""
    return lens if isinstance(lens, Lens) else Lens(k1=float(lens))


def distort(pixel: ArrayLike, camera: Camera, lens: Lens | float) -> np.ndarray:
    """Map pixels of the ideal pinhole to pixels of the distorted image.

    Parameters
    ----------
    pixel
        Undistorted pixel coordinates ``(..., 2)``.
    camera
        Intrinsics.
    lens
        Distortion, or its single coefficient ``k1``.

    Returns
    -------
    numpy.ndarray
        Distorted pixel coordinates ``(..., 2)``; NaN beyond the radius where the distortion is no longer monotone.
    """
    lens, focal, centre = lens_of(lens), np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    normal = (np.asarray(pixel, float) - centre) / focal
    within = np.sum(normal**2, axis=-1, keepdims=True) < lens.fold**2
    return np.where(within, lens.distorted(normal), np.nan) * focal + centre


def undistort(pixel: ArrayLike, camera: Camera, lens: Lens | float) -> np.ndarray:
    """Map pixels of the distorted image to pixels of the ideal pinhole; the inverse of `distort` by Newton's method.

    Parameters
    ----------
    pixel
        Distorted pixel coordinates ``(..., 2)``.
    camera
        Intrinsics.
    lens
        Distortion, or its single coefficient ``k1``.

    Returns
    -------
    numpy.ndarray
        Undistorted pixel coordinates ``(..., 2)``; NaN outside the range of `distort`.
    """
    lens, focal, centre = lens_of(lens), np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    target = (np.asarray(pixel, float) - centre) / focal
    ideal, step = _clipped(target, 0.98 * lens.fold), 1e-6
    for _ in range(30):
        error = lens.distorted(ideal) - target
        columns = [
            (lens.distorted(ideal + offset) - lens.distorted(ideal - offset)) / (2.0 * step)
            for offset in (np.array([step, 0.0]), np.array([0.0, step]))
        ]
        (a, c), (b, d) = (np.moveaxis(column, -1, 0) for column in columns)
        determinant = np.where(np.abs(a * d - b * c) > 1e-9, a * d - b * c, 1e-9)
        change = np.stack([d * error[..., 0] - b * error[..., 1], a * error[..., 1] - c * error[..., 0]], axis=-1)
        ideal = _clipped(ideal - change / determinant[..., None], 0.9999 * lens.fold)
    size = 1.0 + np.linalg.norm(target, axis=-1, keepdims=True)
    solved = np.linalg.norm(lens.distorted(ideal) - target, axis=-1, keepdims=True) < 1e-9 * size
    return np.where(solved, ideal, np.nan) * focal + centre


def _clipped(normal: np.ndarray, radius: float) -> np.ndarray:
    """Vectors ``(..., 2)`` no longer than a radius."""
    if not math.isfinite(radius):
        return normal
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return normal * np.minimum(1.0, radius / np.maximum(length, 1e-12))


def rectify(image: np.ndarray, camera: Camera, lens: Lens | float) -> tuple[np.ndarray, np.ndarray]:
    """Resample a distorted image to the ideal pinhole camera (bicubic).

    Parameters
    ----------
    image
        Scene-linear image ``(H, W, 3)`` with distortion.
    camera
        Pinhole camera of the result.
    lens
        Distortion, or its single coefficient ``k1``.

    Returns
    -------
    image
        Rectified image ``(H, W, 3)`` float32, 0 outside the source image.
    inside
        ``(H, W)`` bool, True where the source image covers the pixel.
    """
    x, y = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    source = distort(np.stack([x, y], axis=-1), camera, lens)
    size = np.array([image.shape[1], image.shape[0]])
    inside = np.all(np.isfinite(source) & (source >= 0.0) & (source <= size), axis=-1)
    source = np.nan_to_num(source, nan=-1e4).astype(np.float32) - np.float32(0.5)
    values = np.ascontiguousarray(image, np.float32)
    rectified = cv2.remap(values, source[..., 0], source[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.maximum(rectified, 0.0) * inside[..., None], inside
