"""Pack and unpack the nine calibration parameters shared by all residuals, and project points with them.

The parameters (`evidence.PARAMETERS`) are heading, tilt and roll [deg], position [m], logarithm of the field-of-view
scale, radial distortion coefficient ``k1`` and offset of the horizon row [px].
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from seasonscapes.calibration.evidence import Correspondences
from seasonscapes.cameras.lens import undistort
from seasonscapes.cameras.panorama import Panorama, panorama_directions, project_local
from seasonscapes.cameras.pinhole import Camera, ray_directions, rotation_from_angles

View = Camera | Panorama


def angles_from_rotation(rotation: np.ndarray) -> tuple[float, float, float]:
    """Compute heading, pitch and roll of a rotation; the inverse of `rotation_from_angles`.

    Parameters
    ----------
    rotation
        ``world_from_camera`` rotation ``(3, 3)``.

    Returns
    -------
    heading, pitch, roll : float
        Angles [deg]; the heading lies in [0, 360).

    Examples
    --------
    >>> [round(angle, 6) for angle in angles_from_rotation(rotation_from_angles(30.0, -5.0, 2.0))]
    [30.0, -5.0, 2.0]
    """
    forward = rotation[:, 2]
    heading, pitch = np.degrees(np.arctan2(forward[0], forward[1])), np.degrees(np.arcsin(np.clip(forward[2], -1, 1)))
    level = rotation_from_angles(heading, pitch)
    roll = np.degrees(np.arctan2(rotation[:, 0] @ level[:, 1], rotation[:, 0] @ level[:, 0]))
    return float(heading % 360.0), float(pitch), float(roll)


def parameters_of_view(view: View, axes: np.ndarray, k1: float = 0.0) -> np.ndarray:
    """Return the calibration parameters of a view.

    Parameters
    ----------
    view
        Camera or panorama.
    axes
        East, north and up at the camera, rows ``(3, 3)`` (`frames.local_axes`).
    k1
        Radial distortion coefficient.

    Returns
    -------
    ndarray
        Parameters ``(9,)`` in the order of `PARAMETERS`; field-of-view scale 1 (logarithm 0), horizon offset 0.
    """
    angles = angles_from_rotation(axes @ view.world_from_camera[:3, :3])
    return np.array([*angles, *view.position_m, 0.0, k1, 0.0])


def _rotation(axes: np.ndarray, parameters: np.ndarray) -> np.ndarray:
    """``world_from_camera`` rotation ``(..., 3, 3)`` of parameters ``(..., 9)``: as `rotation_from_angles` about ``axes``."""
    angle = np.radians(parameters[..., :3])
    (sin_h, sin_p, sin_r), (cos_h, cos_p, cos_r) = np.moveaxis(np.sin(angle), -1, 0), np.moveaxis(np.cos(angle), -1, 0)
    right, down = (cos_h, -sin_h, 0.0), (sin_p * sin_h, sin_p * cos_h, -cos_p)
    rotation = np.empty((*parameters.shape[:-1], 3, 3))
    rotation[..., 2] = np.stack([sin_h * cos_p, cos_h * cos_p, sin_p], axis=-1)
    for row in range(3):
        rotation[..., row, 0] = cos_r * right[row] + sin_r * down[row]
        rotation[..., row, 1] = cos_r * down[row] - sin_r * right[row]
    return axes.T @ rotation


def focal_scales(start: View, parameters: np.ndarray) -> np.ndarray:
    """Return the factors of the focal lengths; a full circle keeps its width, and no panorama exceeds a full circle.

    Parameters
    ----------
    start
        View that the field-of-view scale refers to.
    parameters
        Parameters ``(..., 9)``.

    Returns
    -------
    ndarray
        Factors ``(..., 2)`` of ``fx`` and ``fy``.
    """
    scale = np.exp(parameters[..., 6])
    across = scale
    if isinstance(start, Panorama):
        least = start.width_px / (2.0 * math.pi * start.fx)
        across = np.ones_like(scale) if start.full_circle else np.maximum(scale, least)
    return np.stack([across, scale], axis=-1)


def view_from_parameters(start: View, axes: np.ndarray, parameters: np.ndarray) -> View:
    """Return the ideal pinhole camera or panorama with given calibration parameters.

    Parameters
    ----------
    start
        View that the field-of-view scale and the horizon offset refer to.
    axes
        East, north and up at the camera, rows ``(3, 3)``.
    parameters
        Parameters ``(9,)``; ``parameters[7]`` (``k1``) is not part of a view and is left to the caller.

    Returns
    -------
    Camera or Panorama
        As ``start``, with the pose, focal lengths and horizon row of ``parameters``.
    """
    pose = np.eye(4)
    pose[:3, :3] = _rotation(axes, parameters)
    pose[:3, 3] = parameters[3:6]
    scale_x, scale_y = focal_scales(start, parameters).tolist()
    return replace(
        start, fx=start.fx * scale_x, fy=start.fy * scale_y, cy=start.cy + parameters[8], world_from_camera=pose
    )


def project_with_parameters(
    start: View, axes: np.ndarray, parameters: np.ndarray, position_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Project world points to lens pixels with given calibration parameters.

    The projection is finite everywhere and smooth across the camera plane, as a solver requires: points behind the
    camera are mapped to distant pixels.

    Parameters
    ----------
    start
        View that the field-of-view scale and the horizon offset refer to.
    axes
        East, north and up at the camera, rows ``(3, 3)``.
    parameters
        Parameters ``(9,)``, or ``(P, 9)`` for P poses at once.
    position_m
        World points ``(N, 3)`` [m].

    Returns
    -------
    pixel : ndarray
        Lens pixels ``(N, 2)`` or ``(P, N, 2)`` (with radial distortion).
    in_front : ndarray
        ``(N,)`` or ``(P, N)`` bool, True where the point lies in front of the camera.
    """
    local = (position_m - parameters[..., None, 3:6]) @ _rotation(axes, parameters)
    scale = focal_scales(start, parameters)[..., None, :]
    centre = np.array([start.cx, start.cy])
    moved = centre + np.stack([np.zeros_like(parameters[..., 8]), parameters[..., 8]], axis=-1)[..., None, :]
    if isinstance(start, Panorama):
        pixel, distance = project_local(start, local)
        return (pixel - centre) * scale + moved, distance > 0
    depth = local[..., 2]
    normalised = local[..., :2] / np.maximum(depth, 0.02 * np.sqrt(np.einsum("...i,...i", local, local)))[..., None]
    if np.any(parameters[..., 7]):
        radius = np.sqrt(np.sum(normalised**2, axis=-1, keepdims=True))
        normalised = normalised * _distortion_factor(radius, parameters[..., None, None, 7])
    return normalised * (scale * [start.fx, start.fy]) + moved, depth > 0


def _distortion_factor(radius: np.ndarray, k1: np.ndarray) -> np.ndarray:
    """Distorted over ideal radius.

    The polynomial of a barrel distortion decreases beyond its maximum; it is extrapolated linearly from just before it.
    """
    barrel = np.where(k1 < 0.0, -k1, 1.0)
    limit = np.minimum(radius, np.where(k1 < 0.0, np.sqrt(0.98 / (3.0 * barrel)), np.inf))
    distorted = limit * (1.0 + k1 * limit**2) + (1.0 + 3.0 * k1 * limit**2) * (radius - limit)
    return np.divide(distorted, radius, out=np.ones_like(radius), where=radius > 1e-12)


def pixel_error(
    start: View, axes: np.ndarray, parameters: np.ndarray, points: Correspondences
) -> tuple[np.ndarray, np.ndarray]:
    """Compute reprojection errors of correspondences.

    Parameters
    ----------
    start, axes, parameters
        View, axes and parameters as in `project_with_parameters`.
    points
        Correspondences of N points.

    Returns
    -------
    error : ndarray
        Projected minus observed pixel ``(N, 2)`` or ``(P, N, 2)`` [px]; column differences of a panorama are wrapped to
        half a circle.
    in_front : ndarray
        ``(N,)`` or ``(P, N)`` bool, True where the point lies in front of the camera.
    """
    pixel, in_front = project_with_parameters(start, axes, parameters, points.position_m)
    error = pixel - points.pixel
    if isinstance(start, Panorama):
        circle = 2.0 * np.pi * start.fx
        error[..., 0] -= circle * np.round(error[..., 0] / circle)
    return error, in_front


def bearings(view: View, k1: float, pixel: np.ndarray) -> np.ndarray:
    """Compute the viewing directions of lens pixels.

    Parameters
    ----------
    view
        Camera or panorama.
    k1
        Radial distortion coefficient (perspective cameras only).
    pixel
        Lens pixels ``(N, 2)``.

    Returns
    -------
    ndarray
        Unit world directions ``(N, 3)``; NaN where the lens model has no ray.
    """
    if isinstance(view, Panorama):
        return panorama_directions(view, pixel)
    return ray_directions(view, undistort(pixel, view, k1) if k1 else pixel)
