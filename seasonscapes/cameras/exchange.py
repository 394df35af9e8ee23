"""Import and export of cameras: nerfstudio's ``transforms.json``, OpenCV; COLMAP text models, which `camera_models` reads.

Poses are written in the scene's local east-north-up frame [m]; ``transforms.json`` also stores the frame's origin and
refraction coefficient and the time of each image, so that views remain georeferenced.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path, PurePosixPath
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from seasonscapes import text_files
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.declaration import InputError
from seasonscapes.frames import LocalFrame, frame_record
from seasonscapes.images import atomic_path

# OpenCV (x right, y down, z forward) to OpenGL (x right, y up, z backward), and back.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_UNMOVED = np.eye(4)[:3].tolist()


@dataclass(frozen=True)
class NamedView:
    """A camera with the image it belongs to.

    Parameters
    ----------
    name
        Name of the view.
    camera
        The camera.
    file
        Image file; empty if there is none.
    time
        Time of exposure, aware UTC; ``None`` if unknown.
    """

    name: str
    camera: Camera
    file: str = ""
    time: datetime | None = None


def write_colmap(folder: Path, views: Sequence[NamedView], *, image_folder: str = "") -> None:
    """Write a COLMAP text model: ``cameras.txt``, ``images.txt`` and an empty ``points3D.txt``.

    Each view gets its own PINHOLE camera. COLMAP stores ``camera_from_world`` as a quaternion (w first) and a
    translation; pixel centres lie at +0.5.

    Parameters
    ----------
    folder
        Folder of the model.
    views
        Views to write.
    image_folder
        The folder that readers are told to look for images in (``colmap --image_path``), as it begins the views' files;
        the model names files relative to it.

    Raises
    ------
    ValueError
        A file name contains white space, which the format does not support, or lies outside ``image_folder``.
    """
    from scipy.spatial.transform import Rotation

    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, FX, FY, CX, CY"]
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
    for number, view in enumerate(views, 1):
        camera = view.camera
        name = PurePosixPath(view.file or view.name).relative_to(image_folder).as_posix()
        if any(character.isspace() for character in name):
            raise ValueError(f"write_colmap: got file name {name!r}, expected one without white space")
        rotation = camera.world_from_camera[:3, :3].T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True)
        cameras.append(
            f"{number} PINHOLE {camera.width_px} {camera.height_px} "
            + " ".join(repr(float(v)) for v in (camera.fx, camera.fy, camera.cx, camera.cy))
        )
        pose = (w, x, y, z, *(-rotation @ camera.position_m))
        images += [f"{number} {' '.join(repr(float(v)) for v in pose)} {number} {name}", ""]
    for name, lines in (("cameras.txt", cameras), ("images.txt", images), ("points3D.txt", ["# empty"])):
        _write_text(folder / name, "\n".join(lines) + "\n")


def write_transforms(path: Path, views: Sequence[NamedView], frame: LocalFrame) -> None:
    """Write nerfstudio's ``transforms.json`` with intrinsics per view, the local frame and the times.

    Parameters
    ----------
    path
        File to write.
    views
        Views to write.
    frame
        Local frame of their poses.
    """
    frames = []
    for view in views:
        camera = view.camera
        record = {
            "file_path": view.file or view.name,
            "name": view.name,
            "w": camera.width_px,
            "h": camera.height_px,
            "fl_x": camera.fx,
            "fl_y": camera.fy,
            "cx": camera.cx,
            "cy": camera.cy,
            "transform_matrix": (camera.world_from_camera @ _FLIP).tolist(),
        }
        if view.time is not None:
            record["time_utc"] = view.time.astimezone(UTC).isoformat().replace("+00:00", "Z")
        frames.append(record)
    world = frame_record(frame)
    _write_text(path, json.dumps({"camera_model": "PINHOLE", "world": world, "frames": frames}, indent=1) + "\n")


def read_transforms(path: Path) -> tuple[list[NamedView], LocalFrame | None]:
    """Read the views of a ``transforms.json``, with intrinsics per view or shared by all.

    Parameters
    ----------
    path
        File to read.

    Returns
    -------
    views
        The views.
    frame
        Local frame of the poses; ``None`` if the file does not state one.

    Raises
    ------
    InputError
        Invalid JSON, a missing key, non-zero distortion, poses that nerfstudio moved (``applied_transform``), or a time
        (``time_utc``, or ``time`` with an offset) that is not ISO 8601.
    """
    table = read_json(path)
    if table.get("applied_transform", _UNMOVED) != _UNMOVED or table.get("applied_scale", 1.0) != 1.0:
        cure = "export them as they were (ns-process-data moves them; COLMAP's own model has them)"
        raise InputError(path, "its poses were moved (applied_transform, applied_scale)", cure=cure)
    shared = {key: value for key, value in table.items() if key != "frames"}
    try:
        origin = (table.get("world") or {}).get("origin")
        frame = LocalFrame(**origin) if origin else None
        records = list(table["frames"])
    except text_files.MALFORMED as error:
        raise InputError(path, f"not a list of views: {error!r}") from None
    views = []
    for index, record in enumerate(records):
        where = f"{path}: frames[{index}]"
        try:
            views.append(_view_of_record({**shared, **record}, record, frame, where))
        except text_files.MALFORMED as error:
            problem = f"key {error} is missing" if isinstance(error, KeyError) else f"not a view: {error}"
            raise InputError(where, problem) from None
    return views, frame


def _view_of_record(values: dict[str, Any], record: dict[str, Any], frame: LocalFrame | None, where: str) -> NamedView:
    """The view of one record; its intrinsics may be shared by all and are among ``values``."""
    fx, fy, cx, cy = (float(values[key]) for key in ("fl_x", "fl_y" if "fl_y" in values else "fl_x", "cx", "cy"))
    distortion = [key for key in ("k1", "k2", "k3", "k4", "p1", "p2") if values.get(key)]
    if distortion:
        raise InputError(where, f"distortion {distortion[0]} is not zero", cure="undistort the images first")
    pose = np.array(record["transform_matrix"], float) @ _FLIP
    file = str(record["file_path"])
    camera = Camera(int(values["w"]), int(values["h"]), fx, fy, cx, cy, pose, frame)
    key = "time_utc" if record.get("time_utc") is not None else "time"
    stamp = record.get(key)
    time = None if stamp is None else parse_stamp(stamp, f"{where}: {key}", utc=key == "time_utc")
    return NamedView(str(record.get("name", file)), camera, file, time)


def parse_stamp(stamp: object, where: str, *, utc: bool = False) -> datetime:
    """Time in UTC of an ISO 8601 text in a file.

    Parameters
    ----------
    stamp
        The text.
    where
        What a message begins with.
    utc
        Whether a text without offset is in UTC; else it is refused.

    Raises
    ------
    InputError
        For anything else, such as the numbers between 0 and 1 of films without clock.

    Examples
    --------
    >>> from seasonscapes.cameras.exchange import parse_stamp
    >>> parse_stamp("2024-09-01T12:00+02:00", "a file").isoformat()
    '2024-09-01T10:00:00+00:00'
    """
    expected = "ISO 8601 with an offset, such as 2024-09-01T10:00Z"
    try:
        time = datetime.fromisoformat(stamp)  # pyright: ignore[reportArgumentType]
        if time.tzinfo is None and not utc:
            raise ValueError("it has no offset from UTC")
        return time.replace(tzinfo=time.tzinfo or UTC).astimezone(UTC)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(where, f"not an instant: {error}", got=stamp, expected=expected) from None


def opencv_from_camera(camera: Camera, k1: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Convert a camera to the arguments of ``cv2.projectPoints``.

    OpenCV's pixel coordinates have their origin at the centre of the first pixel: its principal point is smaller by
    half a pixel.

    Parameters
    ----------
    camera
        The camera.
    k1
        Radial distortion coefficient; see `seasonscapes.cameras.lens`.

    Returns
    -------
    matrix
        Camera matrix ``(3, 3)``.
    distortion
        Distortion coefficients ``(5,)``.
    rvec, tvec
        Rotation vector and translation ``(3,)`` of ``camera_from_world``.
    """
    matrix = np.array([[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]])
    rotation = camera.world_from_camera[:3, :3].T
    return matrix, np.array([k1, 0.0, 0.0, 0.0, 0.0]), cv2.Rodrigues(rotation)[0].ravel(), -rotation @ camera.position_m


def camera_from_opencv(
    size_px: tuple[int, int], matrix: ArrayLike, distortion: ArrayLike, rvec: ArrayLike, tvec: ArrayLike
) -> tuple[Camera, float]:
    """Convert OpenCV's camera parameters to a camera; the inverse of `opencv_from_camera`.

    Parameters
    ----------
    size_px
        Width and height of the image [px].
    matrix
        Camera matrix ``(3, 3)`` without skew.
    distortion
        Distortion coefficients, of which only ``k1`` may differ from 0.
    rvec, tvec
        Rotation vector and translation ``(3,)`` of ``camera_from_world``.

    Returns
    -------
    camera
        The camera, without local frame.
    k1
        Radial distortion coefficient.

    Raises
    ------
    ValueError
        Skew, or a distortion coefficient other than ``k1`` is not 0.
    """
    k, coefficients = np.asarray(matrix, float), np.atleast_1d(np.asarray(distortion, float).ravel())
    if abs(k[0, 1]) > 1e-9 or np.any(coefficients[1:]):
        raise ValueError("camera_from_opencv: only k1 is supported; undistort the image first")
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.asarray(rvec, float).reshape(3, 1))[0].T
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(tvec, float).ravel()
    camera = Camera(*size_px, k[0, 0], k[1, 1], k[0, 2] + 0.5, k[1, 2] + 0.5, pose)
    return camera, float(coefficients[0]) if len(coefficients) else 0.0


def write_opencv(path: Path, camera: Camera, k1: float = 0.0) -> None:
    """Write one camera as JSON with OpenCV's parameters: matrix, distortion, rvec, tvec.

    Parameters
    ----------
    path
        File to write.
    camera
        The camera.
    k1
        Radial distortion coefficient.
    """
    matrix, distortion, rvec, tvec = opencv_from_camera(camera, k1)
    record = {
        "image_width": camera.width_px,
        "image_height": camera.height_px,
        "camera_matrix": matrix.tolist(),
        "distortion_coefficients": distortion.tolist(),
        "rvec": rvec.tolist(),
        "tvec": tvec.tolist(),
    }
    _write_text(path, json.dumps(record, indent=1) + "\n")


def read_opencv(path: Path) -> tuple[Camera, float]:
    """Read a camera from a file of `write_opencv`.

    Parameters
    ----------
    path
        File to read.

    Returns
    -------
    camera
        The camera, without local frame.
    k1
        Radial distortion coefficient.

    Raises
    ------
    InputError
        Invalid JSON or a missing key.
    """
    record = read_json(path)
    try:
        return camera_from_opencv(
            (record["image_width"], record["image_height"]),
            record["camera_matrix"],
            record["distortion_coefficients"],
            record["rvec"],
            record["tvec"],
        )
    except text_files.MALFORMED as error:
        problem = f"key {error} is missing" if isinstance(error, KeyError) else f"not a camera: {error}"
        raise InputError(path, problem) from None


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON object.

    Parameters
    ----------
    path
        File to read, UTF-8 with or without byte order mark.

    Returns
    -------
    dict
        The object.

    Raises
    ------
    InputError
        The file is missing, is not valid JSON, or does not contain an object.
    """
    table = text_files.read_json(path)
    if not isinstance(table, dict):
        raise InputError(path, "not a JSON object", got=type(table).__name__)
    return table


def _write_text(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
