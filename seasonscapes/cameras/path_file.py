"""Camera path files: views by WGS 84 position, height and angles in JSON, and the reference repository's files.

Paths are independent of a local frame, so that one file can be used with every scene file of the same region.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.cameras.exchange import read_json
from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.cameras.reference_poses import Kind, read_reference_poses
from seasonscapes.cameras.trajectory import roll_of
from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame, angles_from_direction, enu_from_geodetic, geodetic_from_enu, local_axes
from seasonscapes.images import atomic_path
from seasonscapes.text_files import MALFORMED

KIND = "seasonscapes path"
_INTRINSICS = ("fx", "fy", "cx", "cy")
_POSE = ("latitude_deg", "longitude_deg", "height_m", "heading_deg", "pitch_deg", "roll_deg")


def view_record(camera: Camera, frame: LocalFrame) -> dict[str, float]:
    """Convert a camera to a frame-independent record.

    Parameters
    ----------
    camera
        The camera.
    frame
        Local frame of its pose.

    Returns
    -------
    dict
        WGS 84 latitude and longitude [deg], height [m], heading, pitch and roll against true north and the horizon at
        the camera [deg], and intrinsics [px].
    """
    latitude, longitude, height = (float(value) for value in geodetic_from_enu(frame, camera.position_m))
    rotation = local_axes(frame, latitude, longitude) @ camera.world_from_camera[:3, :3]
    heading, pitch = (float(value) for value in angles_from_direction(rotation[:, 2]))
    roll = float(np.degrees(roll_of(rotation)))
    if np.hypot(*rotation[:2, 2]) < 1e-6:
        # For vertical optical axes, heading and roll are degenerate: the heading follows from the image's x axis.
        heading, roll = float(np.degrees(np.arctan2(-rotation[1, 0], rotation[0, 0]))) % 360.0, 0.0
    numbers = (latitude, longitude, height, heading, pitch, roll)
    return dict(zip(_POSE, numbers, strict=True)) | {name: float(getattr(camera, name)) for name in _INTRINSICS}


def camera_from_record(record: Mapping[str, float], frame: LocalFrame, size_px: tuple[int, int]) -> Camera:
    """Create a camera from a record; the inverse of `view_record`.

    Parameters
    ----------
    record
        A record of `view_record`.
    frame
        Local frame of the camera.
    size_px
        Width and height [px].

    Returns
    -------
    Camera
        The camera.

    Raises
    ------
    KeyError, TypeError, ValueError
        A missing, non-numeric or invalid entry.
    """
    latitude, longitude, height, heading, pitch, roll = (float(record[name]) for name in _POSE)
    pose = np.eye(4)
    pose[:3, :3] = local_axes(frame, latitude, longitude).T @ rotation_from_angles(heading, pitch, roll)
    pose[:3, 3] = enu_from_geodetic(frame, latitude, longitude, height)
    fx, fy, cx, cy = (float(record[name]) for name in _INTRINSICS)
    return Camera(*size_px, fx, fy, cx, cy, pose, frame)


def save_path(path: Path, cameras: Sequence[Camera], frame: LocalFrame, *, note: dict[str, Any] | None = None) -> None:
    """Write a camera path to a JSON file, atomically.

    Parameters
    ----------
    path
        File to write.
    cameras
        Views in order, all of the same image size.
    frame
        Local frame of the views.
    note
        JSON-serialisable metadata for human readers.

    Raises
    ------
    ValueError
        The views differ in size.
    """
    sizes = {(camera.width_px, camera.height_px) for camera in cameras}
    if len(sizes) != 1:
        raise ValueError(f"save_path: views of {len(sizes)} sizes, expected one")
    views = [view_record(camera, frame) for camera in cameras]
    table = {"kind": KIND, "version": 1, "size_px": list(sizes.pop()), "note": note or {}, "views": views}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(table, indent=1) + "\n")


def load_path(path: Path, frame: LocalFrame) -> list[Camera]:
    """Read a camera path from a file of `save_path`.

    Parameters
    ----------
    path
        File to read.
    frame
        Local frame of the cameras.

    Returns
    -------
    list of Camera
        Views in order.

    Raises
    ------
    InputError
        The file is missing, is not a camera path, or has no views.
    """
    table = read_json(path)
    if table.get("kind") != KIND:
        raise InputError(
            path,
            "is not a camera path file",
            expected=f'"kind": "{KIND}"',
            cure="create one with `seasonscapes path`, which also reads the reference's files",
        )
    try:
        size = int(table["size_px"][0]), int(table["size_px"][1])
        cameras = [camera_from_record(record, frame, size) for record in table["views"]]
    except MALFORMED as error:
        raise InputError(path, f"not a valid camera path: {error!r}") from None
    if not cameras:
        raise InputError(path, "the camera path has no views")
    return cameras


def resize_camera(camera: Camera, size_px: tuple[int, int]) -> Camera:
    """Change the image size of a camera at constant field of view; the pixel aspect ratio may change.

    Parameters
    ----------
    camera
        The camera.
    size_px
        New width and height [px].

    Returns
    -------
    Camera
        The camera with scaled intrinsics.
    """
    x, y = size_px[0] / camera.width_px, size_px[1] / camera.height_px
    return replace(
        camera,
        width_px=size_px[0],
        height_px=size_px[1],
        fx=camera.fx * x,
        cx=camera.cx * x,
        fy=camera.fy * y,
        cy=camera.cy * y,
    )


@dataclass(frozen=True)
class ReferencePath:
    """A trajectory file of the reference repository.

    Parameters
    ----------
    cameras
        Waypoints in order, or all views if the file is already interpolated.
    count
        Number of views to interpolate; ``None`` if ``cameras`` are the views.
    curve
        ``spline`` or ``linear``.
    """

    cameras: list[Camera]
    count: int | None
    curve: str


def read_reference_path(path: Path, frame: LocalFrame, *, kind: Kind = "refined") -> ReferencePath:
    """Read a trajectory file of the reference repository: waypoints with ``meta``, or interpolated views.

    The reference's interpolation repeats the view at each waypoint of linear paths and uses the same number of views
    between all waypoints; `cameras_along_path` keeps the total number of views at constant speed.

    Parameters
    ----------
    path
        File to read.
    frame
        Local frame of the cameras.
    kind
        As in `read_reference_poses`.

    Returns
    -------
    ReferencePath
        Waypoints or views, number of views and type of curve.

    Raises
    ------
    InputError
        As `read_reference_poses`; invalid ``meta``.
    """
    views = {view.name: view.camera for view in read_reference_poses(path, frame, kind=kind)}
    meta = read_json(path).get("meta")
    if meta is None:
        return ReferencePath(list(views.values()), None, "linear")
    try:
        names, number = list(meta["waypoints"]), meta["nbr_points"]
        count = int(number) if isinstance(number, int) else sum(int(part) for part in number)
        curve = {"smooth": "spline", "linear": "linear"}[meta["interpolation"]]
        cameras = [views[name] for name in names]
    except MALFORMED as error:
        raise InputError(f"{path}: meta", f"not a list of waypoints: {error!r}") from None
    return ReferencePath(cameras, count, curve)
