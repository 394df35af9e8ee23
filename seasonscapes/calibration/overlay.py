"""The figure that a calibration is judged by: photograph, projected ridge lines, matched points with their residuals."""

from __future__ import annotations

import os

import cv2
import numpy as np

from seasonscapes.calibration.evidence import Correspondences
from seasonscapes.calibration.pose_model import project_values, values_of
from seasonscapes.calibration.resection import Calibration
from seasonscapes.calibration.terrain_horizon import Horizon
from seasonscapes.cameras.panorama import Panorama
from seasonscapes.images import write_png8

# sRGB.
_SKYLINE, _RIDGE, _SEEN, _PROJECTED, _ARROW, _OUT = (
    (230, 40, 40),
    (255, 200, 0),
    (255, 140, 0),
    (40, 200, 70),
    (255, 255, 255),
    (200, 60, 220),
)


def draw_overlay(
    image: np.ndarray,
    calibration: Calibration,
    *,
    points: Correspondences | None = None,
    horizon: Horizon | None = None,
    title: str = "",
) -> np.ndarray:
    """Draw a calibration over its photograph.

    Parameters
    ----------
    image
        ``(H, W, 3)`` uint8 sRGB of the lens (not rectified).
    points
        The matched points: an orange ring where one was picked, a green dot where the solution puts it, a white arrow
        between them; magenta where it was set aside.
    horizon
        Terrain lines: the skyline red, ridges before farther ones yellow.
    title
        First words of the caption; the RMS follows.

    Returns
    -------
    ndarray
        ``(H, W, 3)`` uint8 sRGB.
    """
    view = calibration.view
    if image.shape[:2] != (view.height_px, view.width_px):
        raise ValueError(
            f"draw_overlay: the picture is {image.shape[1]} x {image.shape[0]} px, the view "
            f"{view.width_px} x {view.height_px}"
        )
    canvas = np.ascontiguousarray(image[..., :3]).copy()
    thick = max(1, round(view.height_px / 700))
    axes = np.eye(3) if horizon is None else horizon.axes
    values = values_of(view, axes, calibration.k1)
    if horizon is not None:
        for position, colour in ((horizon.edges_m, _RIDGE), (horizon.skyline_m, _SKYLINE)):
            position = position[np.isfinite(position).all(axis=1)]
            if len(position):
                pixel, front = project_values(view, axes, values, position)
                _dots(canvas, pixel[front], colour, thick)
    if points is not None and len(points):
        _draw_points(canvas, calibration, points, thick)
    caption = [title] if title else []
    if len(calibration.names):
        caption.append(f"RMS {calibration.rms_px:.1f} px of {len(calibration.names)} points")
    if np.isfinite(calibration.skyline_rms_px):
        caption.append(f"heading {calibration.values[0]:.2f} +- {calibration.sigma['heading_deg']:.2f} deg")
    if caption:
        _caption(canvas, ", ".join(caption))
    return canvas


def save_overlay(path: str | os.PathLike, image: np.ndarray, calibration: Calibration, **what) -> None:
    """Write `draw_overlay` as PNG."""
    write_png8(path, draw_overlay(image, calibration, **what))


def _dots(canvas: np.ndarray, pixel: np.ndarray, colour, thick: int) -> None:
    height, width = canvas.shape[:2]
    inside = (pixel[:, 0] >= 0) & (pixel[:, 0] < width) & (pixel[:, 1] >= 0) & (pixel[:, 1] < height)
    for x, y in np.unique(np.floor(pixel[inside]).astype(int), axis=0):
        cv2.circle(canvas, (int(x), int(y)), thick, colour, -1, cv2.LINE_AA)


def _draw_points(canvas: np.ndarray, calibration: Calibration, points: Correspondences, thick: int) -> None:
    projected = points.pixel + calibration.residual_px
    if isinstance(calibration.view, Panorama):
        projected[:, 0] %= 2.0 * np.pi * calibration.view.fx
    for name, seen, put, out in zip(points.names, points.pixel, projected, calibration.outlier, strict=True):
        a, b = (tuple(round(float(v)) for v in place) for place in (seen, put))
        colour = _OUT if out else _SEEN
        cv2.circle(canvas, a, 5 * thick, colour, thick, cv2.LINE_AA)
        cv2.arrowedLine(canvas, a, b, _ARROW, thick, cv2.LINE_AA, tipLength=0.25)
        cv2.circle(canvas, b, 2 * thick, _PROJECTED, -1, cv2.LINE_AA)
        corner = (a[0] + 6 * thick, a[1] - 6 * thick)
        cv2.putText(canvas, name, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.4 * thick, colour, thick, cv2.LINE_AA)


def _caption(canvas: np.ndarray, text: str) -> None:
    scale = canvas.shape[0] / 1000.0
    (width, height), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, scale, max(1, round(scale * 1.5)))
    bottom = canvas.shape[0]
    canvas[bottom - 2 * height :, : width + 2 * height] //= 3
    cv2.putText(
        canvas,
        text,
        (height, bottom - height // 2),
        cv2.FONT_HERSHEY_SIMPLEX,
        scale,
        (255, 255, 255),
        max(1, round(scale * 1.5)),
        cv2.LINE_AA,
    )
