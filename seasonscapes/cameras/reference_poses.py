"""Poses and trajectories of the SeasonScapes reference repository, brought back to metres.

Its world is a grid of pixels, x south, y east, z up, in which one step is 59.8 m north-south, 41.2 m east-west and
60 m upwards: stretched 1.45 times. Poses that were refined in it are right only there; their focal lengths and angles
absorb the stretch. With ``D`` the steps per metre, ``K R D = K' R'`` (RQ) gives the metric camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from seasonscapes.cameras.exchange import read_json
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.declaration import InputError
from seasonscapes.frames import (
    ECCENTRICITY_SQUARED,
    SEMI_MAJOR_AXIS_M,
    LocalFrame,
    enu_from_geodetic,
    geodetic_from_enu,
    local_axes,
)

# The grid: north-west corner, extent in degrees, rows and columns, metres of one step upwards.
_NORTH_DEG, _WEST_DEG, _EXTENT_DEG, _GRID, _STEP_UP_M = 46.85, 7.6, (0.45, 0.75), (836, 1393), 60.0
# South, east, up from east, north, up.
_SEU_FROM_ENU = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

Kind = Literal["refined", "unrefined"]


@dataclass(frozen=True)
class ReferenceView:
    """One imported frame.

    Parameters
    ----------
    name, webcam, index
        As in the file: ``65_15-GRINDKIRCH_1`` is frame 1 of ``15-GRINDKIRCH``; a trajectory's have no webcam.
    camera
        Metric camera in the local frame, without the skew.
    skew_px
        What undoing the stretch leaves of skew (about 0.6 % of ``fx``).
    file
        Picture the frame belongs to.
    """

    name: str
    webcam: str
    index: int
    camera: Camera
    skew_px: float
    file: str


def read_reference_poses(path: Path, frame: LocalFrame, *, kind: Kind = "refined") -> list[ReferenceView]:
    """Frames of a transforms file, geographic or in grid pixels (found by their magnitude).

    Parameters
    ----------
    kind
        ``"refined"``: angles and focal lengths belong to the stretched grid and are converted. ``"unrefined"``: they
        come straight from the camera table and are true.

    Raises
    ------
    InputError
        Missing keys, matrices that are no rotation to 0.05, a file without frames.
    """
    views = []
    for name, record in read_json(path).items():
        if name == "meta":
            continue
        where = f"{path}: {name}"
        try:
            # Keys come with stray blanks ("k3 ").
            values = {key.strip(): value for key, value in record.items()}
            matrix = np.array(values["transform_matrix"], float)
            intrinsics = [float(values[key]) for key in ("fx", "fy", "cx", "cy")]
            size = int(values["wid"]), int(values["hei"])
        except (KeyError, AttributeError, TypeError, ValueError) as error:
            raise InputError(where, f"not a camera record: {error!r}") from None
        views.append(_view(name, matrix, intrinsics, size, values.get("file_path", ""), frame, kind, where))
    if not views:
        raise InputError(path, "no frames in it")
    return views


def _view(name, matrix, intrinsics, size, file, frame, kind, where) -> ReferenceView:
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(where, "transform_matrix is not a finite 4 x 4 matrix")
    u, s, vt = np.linalg.svd(matrix[:3, :3])
    if np.abs(s - 1.0).max() > 0.05 or np.linalg.det(u @ vt) < 0:
        raise InputError(where, "transform_matrix holds no rotation", got=f"singular values {np.round(s, 3).tolist()}")
    latitude, longitude, height = geodetic_of_translation(matrix[:3, 3])
    # OpenGL to OpenCV axes.
    rotation = (u @ vt) @ np.diag([1.0, -1.0, -1.0])
    fx, fy, cx, cy = intrinsics
    k = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if kind == "refined":
        k, rotation = unstretch(k, rotation, latitude)
    pose = np.eye(4)
    pose[:3, :3] = local_axes(frame, latitude, longitude).T @ _SEU_FROM_ENU.T @ rotation
    pose[:3, 3] = enu_from_geodetic(frame, latitude, longitude, height)
    webcam, index = _identity(name)
    camera = Camera(*size, k[0, 0], k[1, 1], k[0, 2], k[1, 2], pose, frame)
    return ReferenceView(name, webcam, index, camera, float(k[0, 1]), file)


def _identity(name: str) -> tuple[str, int]:
    """``65_15-GRINDKIRCH_1`` → (``15-GRINDKIRCH``, 1)."""
    parts = name.split("_")
    if len(parts) == 3 and parts[0].isdigit() and parts[2].isdigit():
        return parts[1], int(parts[2])
    return "", int(parts[-1]) if parts[-1].isdigit() else 0


def geodetic_of_translation(translation) -> tuple[float, float, float]:
    """WGS 84 latitude, longitude [deg] and height [m] of a pose's translation: degrees, or pixels of the grid."""
    x, y, z = (float(v) for v in translation)
    if abs(x - _WEST_DEG) < 2.0 and abs(y - _NORTH_DEG) < 2.0:
        return y, x, z
    return _NORTH_DEG - x / _GRID[0] * _EXTENT_DEG[0], _WEST_DEG + y / _GRID[1] * _EXTENT_DEG[1], z * _STEP_UP_M


def steps_per_metre(latitude_deg: float) -> np.ndarray:
    """``(3,)`` grid steps per metre south, east and up at a latitude (ellipsoidal)."""
    sine = np.sin(np.radians(latitude_deg))
    squeeze = 1.0 - ECCENTRICITY_SQUARED * sine**2
    meridian = SEMI_MAJOR_AXIS_M * (1.0 - ECCENTRICITY_SQUARED) / squeeze**1.5
    parallel = SEMI_MAJOR_AXIS_M / np.sqrt(squeeze) * np.cos(np.radians(latitude_deg))
    degree = np.pi / 180.0
    return np.array(
        [
            _GRID[0] / (_EXTENT_DEG[0] * degree * meridian),
            _GRID[1] / (_EXTENT_DEG[1] * degree * parallel),
            1.0 / _STEP_UP_M,
        ]
    )


def unstretch(k: np.ndarray, grid_from_camera: np.ndarray, latitude_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Metric intrinsics (with skew) and rotation of a camera that was fitted in the stretched grid."""
    return _split(k @ grid_from_camera.T @ np.diag(steps_per_metre(latitude_deg)))


def stretch(k: np.ndarray, world_from_camera: np.ndarray, latitude_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """The way back: intrinsics and rotation in the stretched grid of a metric camera."""
    return _split(k @ world_from_camera.T @ np.diag(1.0 / steps_per_metre(latitude_deg)))


def _split(product: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``product ~ K Rᵀ``: upper triangular with a positive diagonal, ``K[2, 2] = 1``, and the rotation ``R``."""
    # RQ from QR of the matrix turned about its anti-diagonal.
    q, r = np.linalg.qr(product[::-1].T)
    k, rotation = r.T[::-1, ::-1], q.T[::-1]
    sign = np.diag(np.sign(np.diag(k)))
    k, rotation = k @ sign, sign @ rotation
    if np.linalg.det(rotation) < 0:
        rotation = -rotation
    return k / k[2, 2], rotation.T


def reference_records(views: Sequence[ReferenceView], frame: LocalFrame, *, kind: Kind = "refined") -> dict:
    """Views as the reference's own table of frames, the inverse of `read_reference_poses`."""
    table = {}
    for view in views:
        camera = view.camera
        latitude, longitude, height = (float(v) for v in geodetic_from_enu(frame, camera.position_m))
        rotation = _SEU_FROM_ENU @ local_axes(frame, latitude, longitude) @ camera.world_from_camera[:3, :3]
        k = np.array([[camera.fx, view.skew_px, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        if kind == "refined":
            k, rotation = stretch(k, rotation, latitude)
        matrix = np.eye(4)
        matrix[:3, :3] = rotation @ np.diag([1.0, -1.0, -1.0])
        matrix[:3, 3] = longitude, latitude, height
        table[view.name] = {
            "file_path": view.file,
            "wid": camera.width_px,
            "hei": camera.height_px,
            "fx": k[0, 0],
            "fy": k[1, 1],
            "cx": k[0, 2],
            "cy": k[1, 2],
            "transform_matrix": matrix.tolist(),
            **dict.fromkeys(("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"), 0.0),
        }
    return table


def read_reference_matches(path: Path, frame: LocalFrame) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Matched points of the reference's picking tool: frame name to pixels ``(N, 2)`` and positions ``(N, 3)`` [m]."""
    matches = {}
    for name, record in read_json(path).items():
        try:
            grid, pixel = np.array(record["match3D"], float).reshape(-1, 3), np.array(record["match2D"], float)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: {name}", f"not a list of matches: {error!r}") from None
        if len(grid) != len(pixel.reshape(-1, 2)):
            raise InputError(f"{path}: {name}", f"{len(grid)} positions for {len(pixel)} pixels")
        place = np.array([geodetic_of_translation(row) for row in grid]).reshape(-1, 3)
        matches[name] = pixel.reshape(-1, 2), enu_from_geodetic(frame, place[:, 0], place[:, 1], place[:, 2])
    return matches
