"""Paths on disk: views by GPS, height and angles in one JSON file, and the reference repository's own files.

A path says nothing of a frame: the same file serves every scene file of its place.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from seasonscapes.cameras.exchange import read_json
from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.cameras.reference_poses import Kind, read_reference_poses
from seasonscapes.cameras.trajectory import roll_of
from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame, angles_from_direction, enu_from_geodetic, geodetic_from_enu, local_axes
from seasonscapes.images import atomic_path

KIND = "seasonscapes path"
_LENS = ("fx", "fy", "cx", "cy")
_PLACE = ("latitude_deg", "longitude_deg", "height_m", "heading_deg", "pitch_deg", "roll_deg")


def view_record(camera: Camera, frame: LocalFrame) -> dict[str, float]:
    """A camera as plain numbers: WGS 84 place, angles against true north and the horizon there, lens in pixels."""
    latitude, longitude, height = (float(value) for value in geodetic_from_enu(frame, camera.position_m))
    rotation = local_axes(frame, latitude, longitude) @ camera.world_from_camera[:3, :3]
    heading, pitch = (float(value) for value in angles_from_direction(rotation[:, 2]))
    roll = float(np.degrees(roll_of(rotation)))
    if np.hypot(*rotation[:2, 2]) < 1e-6:
        # Straight up or down only the side still tells where the camera is turned.
        heading, roll = float(np.degrees(np.arctan2(-rotation[1, 0], rotation[0, 0]))) % 360.0, 0.0
    numbers = (latitude, longitude, height, heading, pitch, roll)
    return dict(zip(_PLACE, numbers, strict=True)) | {name: float(getattr(camera, name)) for name in _LENS}


def camera_of(record: dict, frame: LocalFrame, size_px: tuple[int, int]) -> Camera:
    """The camera of a `view_record`; `KeyError`, `TypeError` or `ValueError` where it is none."""
    latitude, longitude, height, heading, pitch, roll = (float(record[name]) for name in _PLACE)
    pose = np.eye(4)
    pose[:3, :3] = local_axes(frame, latitude, longitude).T @ rotation_from_angles(heading, pitch, roll)
    pose[:3, 3] = enu_from_geodetic(frame, latitude, longitude, height)
    return Camera(*size_px, *(float(record[name]) for name in _LENS), pose, frame)


def save_path(path: Path, cameras: Sequence[Camera], frame: LocalFrame, *, note: dict | None = None) -> None:
    """Write cameras of one size, in order, atomically; ``note`` holds plain values for people."""
    sizes = {(camera.width_px, camera.height_px) for camera in cameras}
    if len(sizes) != 1:
        raise ValueError(f"save_path: views of {len(sizes)} sizes, expected one")
    views = [view_record(camera, frame) for camera in cameras]
    table = {"kind": KIND, "version": 1, "size_px": list(sizes.pop()), "note": note or {}, "views": views}
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(table, indent=1) + "\n")


def load_path(path: Path, frame: LocalFrame) -> list[Camera]:
    """The cameras of a path file; `InputError` where it is none."""
    table = read_json(path)
    if table.get("kind") != KIND:
        raise InputError(
            path,
            "is no path",
            expected=f'"kind": "{KIND}"',
            cure="make one with `seasonscapes path`, which reads the reference's files too",
        )
    try:
        size = int(table["size_px"][0]), int(table["size_px"][1])
        cameras = [camera_of(record, frame, size) for record in table["views"]]
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(path, f"not a path: {error!r}") from None
    if not cameras:
        raise InputError(path, "holds no view")
    return cameras


def resize_camera(camera: Camera, size_px: tuple[int, int]) -> Camera:
    """The same view in a picture of another size; its field of view stays, pixels may change shape."""
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
        Its waypoints in their order, or all views of a file that holds them all.
    count
        Views that it asks for; ``None`` where ``cameras`` are the views.
    curve
        ``spline`` or ``linear``.
    """

    cameras: list[Camera]
    count: int | None
    curve: str


def read_reference_path(path: Path, frame: LocalFrame, *, kind: Kind = "refined") -> ReferencePath:
    """Waypoints (with their ``meta``) or views of the reference's trajectory files; see `read_reference_poses`.

    Its own interpolation repeats the view at every joint of linear paths and takes each pair of waypoints for equally
    far apart; ours keeps its number of views and evens out the speed.
    """
    views = {view.name: view.camera for view in read_reference_poses(path, frame, kind=kind)}
    meta = read_json(path).get("meta")
    if meta is None:
        return ReferencePath(list(views.values()), None, "linear")
    try:
        names, wanted = list(meta["waypoints"]), meta["nbr_points"]
        count = int(wanted) if isinstance(wanted, int) else sum(int(number) for number in wanted)
        curve = {"smooth": "spline", "linear": "linear"}[meta["interpolation"]]
        cameras = [views[name] for name in names]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: meta", f"not a list of waypoints: {error!r}") from None
    return ReferencePath(cameras, count, curve)
