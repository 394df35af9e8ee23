"""Camera paths of a place: through waypoints at constant speed, kept above the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.cameras.pinhole import Camera, camera_at, view_in_frame
from seasonscapes.errors import InputError
from seasonscapes.frames import angles_from_direction, local_axes
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.views import camera_geodetic, local_ground

if TYPE_CHECKING:
    from seasonscapes.cameras.reference_poses import Kind
    from seasonscapes.cameras.trajectory import Curve

# A camera that looks towards the next waypoint is not pitched by more than this [deg].
_STEEPEST_DEG = 30.0


@dataclass(frozen=True)
class CameraPath:
    """Views along a path.

    Parameters
    ----------
    cameras
        The views, in order, with poses in the place's frame.
    waypoints
        The waypoints that they interpolate; empty for views read from a file.
    curve
        The curve by arc length; ``None`` for views read from a file.
    lifted_m
        By how much the curve was lifted to clear the ground [m].
    """

    cameras: list[Camera]
    waypoints: list[Camera]
    curve: Curve | None = None
    lifted_m: float = 0.0


def camera_path(
    place: Place,
    waypoints: Sequence[Camera],
    count: int,
    *,
    curve: str = "spline",
    turn: str = "smooth",
    look_at: np.ndarray | None = None,
    closed: bool = False,
    clearance_m: float = 30.0,
) -> CameraPath:
    """Interpolate views between waypoints at constant speed along the path.

    Parameters
    ----------
    place
        The place; waypoints are converted to its frame.
    waypoints
        Two cameras or more.
    count
        Number of views.
    curve
        ``"spline"`` (C² cubic) or ``"linear"``.
    turn
        ``"smooth"`` (C² rotation spline) or ``"slerp"``.
    look_at
        A position ``(3,)`` [m, east-north-up] that all views look at.
    closed
        Whether the path returns to its first waypoint.
    clearance_m
        Least height above the ground [m]; 0 follows the waypoints alone.

    Returns
    -------
    CameraPath
        ``count`` views.

    Raises
    ------
    InvalidPath
        For fewer than two distinct waypoints.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> waypoints = [ss.camera(place, name, size_px=(48, 32)) for name in ("aerial", "meadow")]
    >>> path = ss.camera_path(place, waypoints, 5)
    >>> len(path.cameras)
    5
    """
    from seasonscapes.cameras.trajectory import curve_through, lift_above_ground, views_along

    poses = [view_in_frame(camera, place.frame) for camera in waypoints]
    knots = [*poses, poses[0]] if closed else poses
    line = curve_through(np.array([camera.position_m for camera in knots]), curve=curve, closed=closed)
    lifted_m = 0.0
    if clearance_m > 0.0:
        line, lifted_m = lift_above_ground(line, local_ground(place), clearance_m)
    cameras = views_along(line, knots, count, turn=turn, look_at_m=look_at, closed=closed)
    return CameraPath(cameras, list(poses), line, lifted_m)


def reference_path(place: Place, file: Path, *, kind: Kind, size_px: tuple[int, int] | None) -> tuple[CameraPath, dict]:
    """Read a trajectory file of the SeasonScapes repository: views, or waypoints still to be interpolated.

    Returns
    -------
    CameraPath, dict
        Views (or waypoints, with ``count`` and ``curve`` in the second value, where the file holds waypoints).
    """
    from seasonscapes.cameras.path_file import read_reference_path, resize_camera

    read = read_reference_path(file, place.frame, kind=kind)
    first = read.cameras[0]
    size = size_px or (first.width_px // 2, first.height_px // 2)
    cameras = [resize_camera(camera, size) for camera in read.cameras]
    return CameraPath(cameras, []), {"count": read.count, "curve": read.curve}


@dataclass(frozen=True)
class Waypoint:
    """A waypoint by position: WGS 84 [deg], height in the scene's datum [m], and angles [deg] where they are stated."""

    latitude_deg: float
    longitude_deg: float
    height_m: float
    heading_deg: float | None = None
    pitch_deg: float = 0.0


def waypoint_cameras(
    place: Place,
    waypoints: Sequence[Camera | Waypoint],
    *,
    fov_deg: float = 60.0,
    size_px: tuple[int, int] = (1536, 1024),
) -> list[Camera]:
    """Cameras of waypoints; those without a heading look towards the next waypoint, the last one looks on.

    Parameters
    ----------
    place
        The place.
    waypoints
        Cameras, or positions.
    fov_deg, size_px
        Horizontal field of view [deg] and image size [px] of the positions' cameras.
    """
    if len(waypoints) < 2:
        raise InputError("waypoints", "a path needs at least two", got=len(waypoints))
    cameras, free = [], []
    for index, waypoint in enumerate(waypoints):
        if isinstance(waypoint, Camera):
            cameras.append(view_in_frame(waypoint, place.frame))
            continue
        if waypoint.heading_deg is None:
            free.append(index)
        cameras.append(_camera_of(place, waypoint, fov_deg, size_px))
    for index in free:
        start = min(index, len(cameras) - 2)
        latitude, longitude, height = camera_geodetic(place, cameras[index])
        step = cameras[start + 1].position_m - cameras[start].position_m
        heading, pitch = angles_from_direction(local_axes(place.frame, latitude, longitude) @ step)
        pitch = float(np.clip(pitch, -_STEEPEST_DEG, _STEEPEST_DEG))
        towards = Waypoint(latitude, longitude, height, float(heading), pitch)
        cameras[index] = _camera_of(place, towards, fov_deg, size_px)
    return cameras


def _camera_of(place: Place, waypoint: Waypoint, fov_deg: float, size_px: tuple[int, int]) -> Camera:
    return camera_at(
        place.frame,
        waypoint.latitude_deg,
        waypoint.longitude_deg,
        waypoint.height_m,
        heading_deg=waypoint.heading_deg or 0.0,
        pitch_deg=waypoint.pitch_deg,
        fov_deg=fov_deg,
        size_px=size_px,
    )


def path_record(place: Place, path: CameraPath) -> dict:
    """Plain values about a path: number of views, length, lift, and the least height above the ground [m]."""
    from seasonscapes.cameras.trajectory import height_above_ground

    positions = np.array([camera.position_m for camera in path.cameras])
    above = height_above_ground(positions, local_ground(place), 0.0)
    return {
        "scene": place.scene.name,
        "views": len(path.cameras),
        "length_m": path.curve.length_m if path.curve is not None else None,
        "lifted_m": path.lifted_m,
        "lowest_above_ground_m": float(np.nanmin(above)) if np.isfinite(above).any() else None,
    }
