"""Conversion of poses and matches of the SeasonScapes reference repository to metric cameras, and back.

The reference's world is a pixel grid with x south, y east, z up, in which one step is 59.8 m north-south, 41.2 m
east-west and 60 m upwards: an anisotropic scale of up to 1.45. Focal lengths and angles of poses refined in this grid
compensate for the scale. With ``D`` the steps per metre, the RQ decomposition ``K R D = K' R'`` gives the metric camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

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
from seasonscapes.text_files import MALFORMED

# The grid: north-west corner, extent (latitude, longitude) [deg], rows and columns, height of one vertical step [m].
_NORTH_DEG, _WEST_DEG, _EXTENT_DEG, _GRID, _STEP_UP_M = 46.85, 7.6, (0.45, 0.75), (836, 1393), 60.0
# Rotation from east-north-up to south-east-up.
_SEU_FROM_ENU = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

Kind = Literal["refined", "unrefined"]


@dataclass(frozen=True)
class ReferenceView:
    """One view of the reference repository.

    Parameters
    ----------
    name, webcam, index
        From the file: ``65_15-GRINDKIRCH_1`` is view 1 of webcam ``15-GRINDKIRCH``; empty webcam for trajectories.
    camera
        Metric camera in the local frame, without skew.
    skew_px
        Skew of the metric intrinsics (about 0.6 % of ``fx``) [px].
    file
        Image file of the view.
    """

    name: str
    webcam: str
    index: int
    camera: Camera
    skew_px: float
    file: str


@dataclass(frozen=True)
class _Record:
    """One entry of a transforms file: ``transform_matrix``, (fx, fy, cx, cy), (width, height), image file."""

    name: str
    matrix: np.ndarray
    intrinsics: tuple[float, float, float, float]
    size_px: tuple[int, int]
    file: str


def read_reference_poses(path: Path, frame: LocalFrame, *, kind: Kind = "refined") -> list[ReferenceView]:
    """Read the views of a transforms file; positions are in degrees or grid pixels, distinguished by magnitude.

    Parameters
    ----------
    path
        File to read.
    frame
        Local frame of the cameras.
    kind
        ``"refined"``: angles and focal lengths refer to the anisotropic grid and are converted. ``"unrefined"``: they
        are metric values from the camera table.

    Returns
    -------
    list of ReferenceView
        Views in the order of the file.

    Raises
    ------
    InputError
        Missing keys, matrices whose singular values deviate from 1 by more than 0.05, or a file without views.
    """
    views = []
    for name, record in read_json(path).items():
        if name == "meta":
            continue
        where = f"{path}: {name}"
        try:
            # Keys may have trailing white space ("k3 ").
            values = {key.strip(): value for key, value in record.items()}
            matrix = np.array(values["transform_matrix"], float)
            fx, fy, cx, cy = (float(values[key]) for key in ("fx", "fy", "cx", "cy"))
            size = int(values["wid"]), int(values["hei"])
        except MALFORMED as error:
            raise InputError(where, f"not a camera record: {error!r}") from None
        entry = _Record(name, matrix, (fx, fy, cx, cy), size, values.get("file_path", ""))
        views.append(_view(entry, frame, kind, where))
    if not views:
        raise InputError(path, "the file has no frames")
    return views


def _view(record: _Record, frame: LocalFrame, kind: Kind, where: str) -> ReferenceView:
    matrix = record.matrix
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(where, "transform_matrix is not a finite 4 x 4 matrix")
    u, s, vt = np.linalg.svd(matrix[:3, :3])
    if np.abs(s - 1.0).max() > 0.05 or np.linalg.det(u @ vt) < 0:
        raise InputError(where, "transform_matrix is not a rotation", got=f"singular values {np.round(s, 3).tolist()}")
    latitude, longitude, height = geodetic_of_translation(matrix[:3, 3])
    # OpenGL to OpenCV axes.
    rotation = (u @ vt) @ np.diag([1.0, -1.0, -1.0])
    fx, fy, cx, cy = record.intrinsics
    k = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    if kind == "refined":
        k, rotation = metric_from_grid(k, rotation, latitude)
    pose = np.eye(4)
    pose[:3, :3] = local_axes(frame, latitude, longitude).T @ _SEU_FROM_ENU.T @ rotation
    pose[:3, 3] = enu_from_geodetic(frame, latitude, longitude, height)
    webcam, index = _webcam_and_index(record.name)
    camera = Camera(*record.size_px, k[0, 0], k[1, 1], k[0, 2], k[1, 2], pose, frame)
    return ReferenceView(record.name, webcam, index, camera, float(k[0, 1]), record.file)


def _webcam_and_index(name: str) -> tuple[str, int]:
    """``65_15-GRINDKIRCH_1`` → (``15-GRINDKIRCH``, 1)."""
    parts = name.split("_")
    if len(parts) == 3 and parts[0].isdigit() and parts[2].isdigit():
        return parts[1], int(parts[2])
    return "", int(parts[-1]) if parts[-1].isdigit() else 0


def geodetic_of_translation(translation: ArrayLike) -> tuple[float, float, float]:
    """Convert the translation of a reference pose to geodetic coordinates.

    Parameters
    ----------
    translation
        ``(3,)`` longitude, latitude [deg] and height [m], or grid pixels (south, east, up); distinguished by magnitude.

    Returns
    -------
    latitude_deg, longitude_deg, height_m
        WGS 84 position [deg, deg, m].
    """
    x, y, z = (float(v) for v in np.asarray(translation))
    if abs(x - _WEST_DEG) < 2.0 and abs(y - _NORTH_DEG) < 2.0:
        return y, x, z
    return _NORTH_DEG - x / _GRID[0] * _EXTENT_DEG[0], _WEST_DEG + y / _GRID[1] * _EXTENT_DEG[1], z * _STEP_UP_M


def steps_per_metre(latitude_deg: float) -> np.ndarray:
    """Compute the scale of the reference grid at a latitude on the WGS 84 ellipsoid.

    Parameters
    ----------
    latitude_deg
        Latitude [deg].

    Returns
    -------
    numpy.ndarray
        ``(3,)`` grid steps per metre to the south, to the east and upwards [1/m].
    """
    sine = np.sin(np.radians(latitude_deg))
    w_squared = 1.0 - ECCENTRICITY_SQUARED * sine**2
    meridian = SEMI_MAJOR_AXIS_M * (1.0 - ECCENTRICITY_SQUARED) / w_squared**1.5
    parallel = SEMI_MAJOR_AXIS_M / np.sqrt(w_squared) * np.cos(np.radians(latitude_deg))
    degree = np.pi / 180.0
    return np.array(
        [
            _GRID[0] / (_EXTENT_DEG[0] * degree * meridian),
            _GRID[1] / (_EXTENT_DEG[1] * degree * parallel),
            1.0 / _STEP_UP_M,
        ]
    )


def metric_from_grid(k: np.ndarray, grid_from_camera: np.ndarray, latitude_deg: float) -> tuple[np.ndarray, np.ndarray]:
    """Convert a camera from the anisotropic reference grid to metric space.

    Parameters
    ----------
    k
        Intrinsics ``(3, 3)`` in the grid.
    grid_from_camera
        Rotation ``(3, 3)`` in the grid.
    latitude_deg
        Latitude of the camera [deg].

    Returns
    -------
    k
        Metric intrinsics ``(3, 3)``, with skew.
    world_from_camera
        Metric rotation ``(3, 3)``, south-east-up.
    """
    return _rq_decomposition(k @ grid_from_camera.T @ np.diag(steps_per_metre(latitude_deg)))


def grid_from_metric(
    k: np.ndarray, world_from_camera: np.ndarray, latitude_deg: float
) -> tuple[np.ndarray, np.ndarray]:
    """Convert a camera from metric space to the anisotropic reference grid; the inverse of `metric_from_grid`.

    Parameters
    ----------
    k
        Metric intrinsics ``(3, 3)``.
    world_from_camera
        Metric rotation ``(3, 3)``, south-east-up.
    latitude_deg
        Latitude of the camera [deg].

    Returns
    -------
    k
        Intrinsics ``(3, 3)`` in the grid, with skew.
    grid_from_camera
        Rotation ``(3, 3)`` in the grid.
    """
    return _rq_decomposition(k @ world_from_camera.T @ np.diag(1.0 / steps_per_metre(latitude_deg)))


def _rq_decomposition(product: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """RQ decomposition ``product ~ K Rᵀ``: ``K`` upper triangular with positive diagonal and ``K[2, 2] = 1``."""
    # RQ by QR of the row-reversed, transposed matrix.
    q, r = np.linalg.qr(product[::-1].T)
    k, rotation = r.T[::-1, ::-1], q.T[::-1]
    sign = np.diag(np.sign(np.diag(k)))
    k, rotation = k @ sign, sign @ rotation
    if np.linalg.det(rotation) < 0:
        rotation = -rotation
    return k / k[2, 2], rotation.T


def reference_records(
    views: Sequence[ReferenceView], frame: LocalFrame, *, kind: Kind = "refined"
) -> dict[str, dict[str, Any]]:
    """Convert views to the reference's transforms file; the inverse of `read_reference_poses`.

    Parameters
    ----------
    views
        Views to convert.
    frame
        Local frame of their cameras.
    kind
        As in `read_reference_poses`.

    Returns
    -------
    dict
        JSON-serialisable records by view name.
    """
    table = {}
    for view in views:
        camera = view.camera
        latitude, longitude, height = (float(v) for v in geodetic_from_enu(frame, camera.position_m))
        rotation = _SEU_FROM_ENU @ local_axes(frame, latitude, longitude) @ camera.world_from_camera[:3, :3]
        k = np.array([[camera.fx, view.skew_px, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        if kind == "refined":
            k, rotation = grid_from_metric(k, rotation, latitude)
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
    """Read the 2-D–3-D correspondences of the reference's annotation tool.

    Parameters
    ----------
    path
        File to read.
    frame
        Local frame of the positions.

    Returns
    -------
    dict
        Pixels ``(N, 2)`` and positions ``(N, 3)`` east-north-up [m], by view name.

    Raises
    ------
    InputError
        Missing or invalid entries, or different numbers of pixels and positions.
    """
    matches = {}
    for name, record in read_json(path).items():
        try:
            grid, pixel = np.array(record["match3D"], float).reshape(-1, 3), np.array(record["match2D"], float)
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(f"{path}: {name}", f"not a list of matches: {error!r}") from None
        if len(grid) != len(pixel.reshape(-1, 2)):
            raise InputError(f"{path}: {name}", f"{len(grid)} positions for {len(pixel)} pixels")
        geodetic = np.array([geodetic_of_translation(row) for row in grid]).reshape(-1, 3)
        matches[name] = pixel.reshape(-1, 2), enu_from_geodetic(frame, geodetic[:, 0], geodetic[:, 1], geodetic[:, 2])
    return matches
