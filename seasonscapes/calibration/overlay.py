"""Overlay of a calibration on its photograph: projected skyline and ridges, correspondences and their residuals."""

from __future__ import annotations

import os

import cv2
import numpy as np

from seasonscapes.calibration.evidence import Correspondences
from seasonscapes.calibration.pose_model import parameters_of_view, project_with_parameters
from seasonscapes.calibration.resection import Calibration
from seasonscapes.calibration.terrain_horizon import Horizon
from seasonscapes.cameras.panorama import Panorama
from seasonscapes.errors import ImageSizeMismatch
from seasonscapes.images import write_png8

# Colours, sRGB.
_SKYLINE, _RIDGE, _OBSERVED, _PROJECTED, _ARROW, _OUTLIER = (
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
        Photograph ``(H, W, 3)`` uint8 sRGB, not rectified.
    calibration
        Result of a resection of that photograph.
    points
        Correspondences of the calibration: an orange ring at the observed pixel (magenta for an outlier), a green dot
        at the projected pixel, and a white arrow between the two.
    horizon
        Terrain horizon: the skyline is drawn in red, ridge edges in yellow.
    title
        First part of the caption, followed by the RMS reprojection error or the heading.

    Returns
    -------
    ndarray
        Image ``(H, W, 3)`` uint8 sRGB.

    Raises
    ------
    ImageSizeMismatch
        If the photograph and the calibrated view differ in size.
    """
    view = calibration.view
    if image.shape[:2] != (view.height_px, view.width_px):
        raise ImageSizeMismatch(
            f"draw_overlay: the image is {image.shape[1]} x {image.shape[0]} px, expected "
            f"{view.width_px} x {view.height_px} as the view"
        )
    canvas = np.ascontiguousarray(image[..., :3]).copy()
    thickness = max(1, round(view.height_px / 700))
    if horizon is not None:
        axes = np.eye(3)
        parameters = parameters_of_view(view, axes, calibration.k1)
        for position, colour in ((horizon.edges_m, _RIDGE), (horizon.skyline_m, _SKYLINE)):
            position = position[np.isfinite(position).all(axis=1)]
            if len(position):
                pixel, in_front = project_with_parameters(view, axes, parameters, position)
                _draw_dots(canvas, pixel[in_front], colour, thickness)
    if points is not None and len(points):
        _draw_points(canvas, calibration, points, thickness)
    caption = [title] if title else []
    if len(calibration.names):
        caption.append(f"RMS {calibration.rms_px:.1f} px of {len(calibration.names)} points")
    if np.isfinite(calibration.skyline_rms_px):
        caption.append(f"heading {calibration.parameters[0]:.2f} +- {calibration.sigma['heading_deg']:.2f} deg")
    if caption:
        _draw_caption(canvas, ", ".join(caption))
    return canvas


def save_overlay(
    path: str | os.PathLike[str],
    image: np.ndarray,
    calibration: Calibration,
    *,
    points: Correspondences | None = None,
    horizon: Horizon | None = None,
    title: str = "",
) -> None:
    """Write the result of `draw_overlay` to a PNG file.

    Parameters
    ----------
    path
        File to write.
    image, calibration, points, horizon, title
        As in `draw_overlay`.
    """
    write_png8(path, draw_overlay(image, calibration, points=points, horizon=horizon, title=title))


def _draw_dots(canvas: np.ndarray, pixel: np.ndarray, colour: tuple[int, int, int], radius: int) -> None:
    height, width = canvas.shape[:2]
    inside = (pixel[:, 0] >= 0) & (pixel[:, 0] < width) & (pixel[:, 1] >= 0) & (pixel[:, 1] < height)
    for x, y in np.unique(np.floor(pixel[inside]).astype(int), axis=0):
        cv2.circle(canvas, (int(x), int(y)), radius, colour, -1, cv2.LINE_AA)


def _draw_points(canvas: np.ndarray, calibration: Calibration, points: Correspondences, thickness: int) -> None:
    projected = points.pixel + calibration.residual_px
    if isinstance(calibration.view, Panorama):
        projected[:, 0] %= 2.0 * np.pi * calibration.view.fx
    for name, observed_px, projected_px, is_outlier in zip(
        points.names, points.pixel, projected, calibration.outlier, strict=True
    ):
        a, b = ((round(float(x)), round(float(y))) for x, y in (observed_px, projected_px))
        colour = _OUTLIER if is_outlier else _OBSERVED
        cv2.circle(canvas, a, 5 * thickness, colour, thickness, cv2.LINE_AA)
        cv2.arrowedLine(canvas, a, b, _ARROW, thickness, cv2.LINE_AA, tipLength=0.25)
        cv2.circle(canvas, b, 2 * thickness, _PROJECTED, -1, cv2.LINE_AA)
        corner = (a[0] + 6 * thickness, a[1] - 6 * thickness)
        cv2.putText(canvas, name, corner, cv2.FONT_HERSHEY_SIMPLEX, 0.4 * thickness, colour, thickness, cv2.LINE_AA)


def _draw_caption(canvas: np.ndarray, text: str) -> None:
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
