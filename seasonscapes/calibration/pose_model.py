"""A camera as nine numbers and back: the unknowns that every kind of evidence speaks about."""

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
    """Heading in [0, 360), pitch and roll [deg] of a ``world_from_camera`` rotation: undoes `rotation_from_angles`."""
    forward = rotation[:, 2]
    heading, pitch = np.degrees(np.arctan2(forward[0], forward[1])), np.degrees(np.arcsin(np.clip(forward[2], -1, 1)))
    level = rotation_from_angles(heading, pitch)
    roll = np.degrees(np.arctan2(rotation[:, 0] @ level[:, 1], rotation[:, 0] @ level[:, 0]))
    return float(heading % 360.0), float(pitch), float(roll)


def values_of(view: View, axes: np.ndarray, k1: float = 0.0) -> np.ndarray:
    """The unknowns ``(9,)`` of a view, in the order of `PARAMETERS`, with a field-of-view scale of one.

    ``axes`` ``(3, 3)`` are the rows east, north, up of the camera's own horizon (`frames.local_axes`).
    """
    angles = angles_from_rotation(axes @ view.world_from_camera[:3, :3])
    return np.array([*angles, *view.position_m, 0.0, k1, 0.0])


def _rotation(axes: np.ndarray, values: np.ndarray) -> np.ndarray:
    """``world_from_camera``: as `rotation_from_angles` about ``axes``, without array ceremony (solvers live here)."""
    sin_h, cos_h = math.sin(math.radians(values[0])), math.cos(math.radians(values[0]))
    sin_p, cos_p = math.sin(math.radians(values[1])), math.cos(math.radians(values[1]))
    sin_r, cos_r = math.sin(math.radians(values[2])), math.cos(math.radians(values[2]))
    right, down = (cos_h, -sin_h, 0.0), (sin_p * sin_h, sin_p * cos_h, -cos_p)
    turned = [(cos_r * r + sin_r * d, cos_r * d - sin_r * r) for r, d in zip(right, down, strict=True)]
    forward = (sin_h * cos_p, cos_h * cos_p, sin_p)
    return axes.T @ np.array([[*pair, ahead] for pair, ahead in zip(turned, forward, strict=True)])


def _scales(start: View, log_scale: float) -> tuple[float, float]:
    """Factors of ``fx`` and ``fy``. A full circle keeps its width, and no panorama grows beyond one."""
    scale = math.exp(log_scale)
    if not isinstance(start, Panorama):
        return scale, scale
    return (1.0 if start.full_circle else max(scale, start.width_px / (2.0 * math.pi * start.fx))), scale


def view_from_values(start: View, axes: np.ndarray, values: np.ndarray) -> View:
    """The view at given unknowns, as an ideal pinhole or a panorama; ``values[7]`` (k1) is kept by the caller."""
    pose = np.eye(4)
    pose[:3, :3] = _rotation(axes, values)
    pose[:3, 3] = values[3:6]
    wide, high = _scales(start, values[6])
    return replace(start, fx=start.fx * wide, fy=start.fy * high, cy=start.cy + values[8], world_from_camera=pose)


def project_values(start: View, axes: np.ndarray, values: np.ndarray, position_m: np.ndarray):
    """Lens pixels ``(N, 2)`` at given unknowns and whether each point ``(N, 3)`` lies in front.

    Finite everywhere and smooth across the camera plane, as a solver needs: points behind get far-away pixels.
    """
    local = (position_m - values[3:6]) @ _rotation(axes, values)
    wide, high = _scales(start, values[6])
    centre = np.array([start.cx, start.cy])
    if isinstance(start, Panorama):
        pixel, distance = project_local(start, local)
        return (pixel - centre) * [wide, high] + centre + [0.0, values[8]], distance > 0
    depth = local[:, 2]
    normal = local[:, :2] / np.maximum(depth, 0.02 * np.sqrt(np.sum(local**2, axis=1)))[:, None]
    if values[7]:
        normal = normal * _bend(np.sqrt(np.sum(normal**2, axis=1, keepdims=True)), values[7])
    return normal * [start.fx * wide, start.fy * high] + centre + [0.0, values[8]], depth > 0


def _bend(radius: np.ndarray, k1: float) -> np.ndarray:
    """Distorted over ideal radius. Beyond the fold of a barrel the polynomial comes back; it is continued straight."""
    edge = np.minimum(radius, math.sqrt(0.98 / (-3.0 * k1)) if k1 < 0 else np.inf)
    bent = edge * (1.0 + k1 * edge**2) + (1.0 + 3.0 * k1 * edge**2) * (radius - edge)
    return np.divide(bent, radius, out=np.ones_like(radius), where=radius > 1e-12)


def pixel_error(start: View, axes: np.ndarray, values: np.ndarray, points: Correspondences):
    """Projected minus observed ``(N, 2)`` [px], columns the short way round; and whether each lies in front."""
    pixel, front = project_values(start, axes, values, points.position_m)
    error = pixel - points.pixel
    if isinstance(start, Panorama):
        circle = 2.0 * np.pi * start.fx
        error[:, 0] -= circle * np.round(error[:, 0] / circle)
    return error, front


def bearings(view: View, k1: float, pixel: np.ndarray) -> np.ndarray:
    """Unit world directions ``(N, 3)`` of lens pixels ``(N, 2)``; NaN where the lens has no ray."""
    if isinstance(view, Panorama):
        return panorama_directions(view, pixel)
    return ray_directions(view, undistort(pixel, view, k1) if k1 else pixel)
