"""Cameras to and from other programs: COLMAP text, nerfstudio's ``transforms.json``, OpenCV.

All of them get the scene's own east-north-up metres; `transforms.json` also carries what those metres are about
(origin, refraction, WGS 84) and each picture's time, so that a view can come back to its place on Earth.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import cv2
import numpy as np

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.declaration import InputError
from seasonscapes.frames import LocalFrame
from seasonscapes.images import atomic_path

# OpenCV (x right, y down, z forward) to OpenGL (x right, y up, z backward), and back.
_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@dataclass(frozen=True)
class NamedView:
    """A camera with the picture it belongs to; ``time`` aware UTC or ``None``."""

    name: str
    camera: Camera
    file: str = ""
    time: datetime | None = None


def write_colmap(folder: Path, views: Sequence[NamedView]) -> None:
    """Write ``cameras.txt``, ``images.txt`` and an empty ``points3D.txt``; one PINHOLE camera for each view.

    COLMAP stores ``camera_from_world`` as a quaternion (w first) and a translation; pixel centres lie at +0.5.
    """
    from scipy.spatial.transform import Rotation

    cameras = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, FX, FY, CX, CY"]
    images = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
    for number, view in enumerate(views, 1):
        camera, name = view.camera, view.file or view.name
        if any(letter.isspace() for letter in name):
            raise ValueError(f"COLMAP's text format has no way to write the blank in {name!r}")
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


def read_colmap(folder: Path) -> list[NamedView]:
    """Views of a COLMAP text model with PINHOLE or SIMPLE_PINHOLE cameras; `InputError` for others."""
    from scipy.spatial.transform import Rotation

    intrinsics = {}
    for line in _lines(folder / "cameras.txt"):
        number, model, width, height, *values = line.split()
        numbers = [float(v) for v in values]
        if model == "SIMPLE_PINHOLE":
            numbers = [numbers[0], *numbers]
        elif model != "PINHOLE":
            raise InputError(
                folder / "cameras.txt",
                f"camera model {model} has distortion",
                expected="PINHOLE",
                cure="undistort the pictures first (colmap image_undistorter)",
            )
        intrinsics[number] = (int(width), int(height), *numbers)
    views = []
    # Every second line lists 2-D points; blank ones count, so they cannot be dropped before pairing.
    for line in _lines(folder / "images.txt", keep_blank=True)[::2]:
        if not line.strip():
            continue
        _, *values, number, name = line.split(maxsplit=9)
        w, x, y, z, *shift = (float(v) for v in values)
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix().T
        pose[:3, 3] = -pose[:3, :3] @ shift
        views.append(NamedView(name, Camera(*intrinsics[number], pose), name))
    return views


def write_transforms(path: Path, views: Sequence[NamedView], frame: LocalFrame) -> None:
    """Write nerfstudio's ``transforms.json`` with every view's own intrinsics, the place and the times."""
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
    place = {
        "crs": "local east-north-up [m] about the origin, through ECEF (EPSG:4978)",
        "geographic_crs": "EPSG:4979",
        "origin": {
            "latitude_deg": frame.latitude_deg,
            "longitude_deg": frame.longitude_deg,
            "height_m": frame.height_m,
            "refraction_k": frame.refraction_k,
        },
    }
    _write_text(path, json.dumps({"camera_model": "PINHOLE", "world": place, "frames": frames}, indent=1) + "\n")


def read_transforms(path: Path) -> tuple[list[NamedView], LocalFrame | None]:
    """Views of a ``transforms.json``, intrinsics per frame or for all, and the frame where it states one."""
    table = read_json(path)
    origin = table.get("world", {}).get("origin")
    frame = LocalFrame(**origin) if origin else None
    views = []
    for index, record in enumerate(table.get("frames", [])):
        values = {**{k: v for k, v in table.items() if k != "frames"}, **record}
        try:
            intrinsics = [values["fl_x"], values.get("fl_y", values["fl_x"]), values["cx"], values["cy"]]
            pose = np.array(record["transform_matrix"], float) @ _FLIP
            size = int(values["w"]), int(values["h"])
        except KeyError as error:
            raise InputError(f"{path}: frames[{index}]", f"key {error} is missing") from None
        bent = [key for key in ("k1", "k2", "k3", "k4", "p1", "p2") if values.get(key)]
        if bent:
            raise InputError(f"{path}: frames[{index}]", f"distortion {bent[0]} is not zero", cure="undistort first")
        stamp = record.get("time_utc")
        views.append(
            NamedView(
                record.get("name", record["file_path"]),
                Camera(*size, *intrinsics, pose, frame),
                record["file_path"],
                datetime.fromisoformat(stamp) if stamp else None,
            )
        )
    return views, frame


def opencv_from_camera(camera: Camera, k1: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Camera matrix ``(3, 3)``, distortion ``(5,)``, ``rvec`` ``(3,)`` and ``tvec`` ``(3,)`` for ``cv2.projectPoints``.

    OpenCV counts from the centre of the first pixel: its principal point is half a pixel less.
    """
    matrix = np.array([[camera.fx, 0.0, camera.cx - 0.5], [0.0, camera.fy, camera.cy - 0.5], [0.0, 0.0, 1.0]])
    rotation = camera.world_from_camera[:3, :3].T
    return matrix, np.array([k1, 0.0, 0.0, 0.0, 0.0]), cv2.Rodrigues(rotation)[0].ravel(), -rotation @ camera.position_m


def camera_from_opencv(size_px: tuple[int, int], matrix, distortion, rvec, tvec) -> tuple[Camera, float]:
    """The camera and its ``k1``; `ValueError` where there is skew or any other distortion than ``k1``."""
    matrix, distortion = np.asarray(matrix, float), np.atleast_1d(np.asarray(distortion, float).ravel())
    if abs(matrix[0, 1]) > 1e-9 or np.any(distortion[1:]):
        raise ValueError("camera_from_opencv: only k1 is supported; undistort the picture first")
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(np.asarray(rvec, float).reshape(3, 1))[0].T
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(tvec, float).ravel()
    camera = Camera(*size_px, matrix[0, 0], matrix[1, 1], matrix[0, 2] + 0.5, matrix[1, 2] + 0.5, pose)
    return camera, float(distortion[0]) if len(distortion) else 0.0


def write_opencv(path: Path, camera: Camera, k1: float = 0.0) -> None:
    """Write one camera as the JSON that ``cv2.FileStorage`` would hold: matrix, distortion, rvec, tvec."""
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
    """Read what `write_opencv` writes."""
    record = read_json(path)
    try:
        return camera_from_opencv(
            (record["image_width"], record["image_height"]),
            record["camera_matrix"],
            record["distortion_coefficients"],
            record["rvec"],
            record["tvec"],
        )
    except KeyError as error:
        raise InputError(path, f"key {error} is missing") from None


def read_json(path: Path) -> dict:
    """A JSON object; `InputError` where the file is missing or holds something else."""
    try:
        table = json.loads(Path(path).read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise InputError(path, "no such file") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(path, f"not valid JSON: {error}") from None
    if not isinstance(table, dict):
        raise InputError(path, "not a JSON object", got=type(table).__name__)
    return table


def _write_text(path: Path, text: str) -> None:
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _lines(path: Path, *, keep_blank: bool = False) -> list[str]:
    if not path.is_file():
        raise InputError(path, "no such file")
    rows = [row for row in path.read_text(encoding="utf-8").splitlines() if not row.startswith("#")]
    return rows if keep_blank else [row for row in rows if row.strip()]
