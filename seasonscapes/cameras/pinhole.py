"""Pinhole camera model: intrinsics in pixels, metric pose, projection and ray directions."""

from __future__ import annotations

from dataclasses import Field, dataclass, replace
from typing import Any, ClassVar, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.errors import FrameMismatch
from seasonscapes.frames import LocalFrame, enu_from_geodetic, geodetic_from_enu, local_axes


class _Posed(Protocol):
    """A dataclass with a pose in a local frame: `Camera` or `Panorama`."""

    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]

    @property
    def world_from_camera(self) -> np.ndarray: ...

    @property
    def frame(self) -> LocalFrame | None: ...


View = TypeVar("View", bound=_Posed)


@dataclass(frozen=True)
class Camera:
    """A calibrated pinhole camera.

    Parameters
    ----------
    width_px, height_px
        Image size [px]. Pixel centres lie at +0.5; row 0 is on top.
    fx, fy, cx, cy
        Focal lengths and principal point [px].
    world_from_camera
        Rigid transform ``(4, 4)`` float64 with OpenCV axes: x right, y down, z forward. World is east-north-up [m].
    frame
        Local frame of ``world_from_camera``; ``None`` if unknown. See `view_in_frame`.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> camera = ss.camera(place, "aerial", size_px=(96, 64))
    >>> camera.width_px, camera.world_from_camera.shape
    (96, (4, 4))
    """

    width_px: int
    height_px: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_from_camera: np.ndarray
    frame: LocalFrame | None = None

    def __post_init__(self):
        pose = np.asarray(self.world_from_camera, float)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError(f"world_from_camera: got shape {pose.shape}, expected a finite (4, 4) matrix")
        rotation = pose[:3, :3]
        if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6) or np.linalg.det(rotation) < 0:
            raise ValueError("world_from_camera: expected a right-handed rotation; the axes may be mirrored")
        if not np.isfinite([self.fx, self.fy, self.cx, self.cy, self.width_px, self.height_px]).all():
            raise ValueError("Camera: image size, focal lengths and principal point must be finite")
        if min(self.width_px, self.height_px) < 1 or min(self.fx, self.fy) <= 0:
            raise ValueError("Camera: image size and focal lengths must be positive")
        object.__setattr__(self, "world_from_camera", pose)

    @property
    def position_m(self) -> np.ndarray:
        """Projection centre ``(3,)`` east-north-up [m]."""
        return self.world_from_camera[:3, 3]


def pose_in_frame(world_from_camera: np.ndarray, own: LocalFrame, other: LocalFrame) -> np.ndarray:
    """Transform a pose to another local frame: same geodetic position, same angles to the horizon at the camera.

    Parameters
    ----------
    world_from_camera
        Rigid transform ``(4, 4)`` in the frame ``own``.
    own, other
        Source and target frame.

    Returns
    -------
    numpy.ndarray
        Rigid transform ``(4, 4)`` float64 in the frame ``other``.
    """
    latitude, longitude, height = (float(v) for v in geodetic_from_enu(own, world_from_camera[:3, 3]))
    pose = np.eye(4)
    rotation = local_axes(other, latitude, longitude).T @ local_axes(own, latitude, longitude)
    pose[:3, :3] = rotation @ world_from_camera[:3, :3]
    pose[:3, 3] = enu_from_geodetic(other, latitude, longitude, height)
    return pose


def view_in_frame(view: View, frame: LocalFrame) -> View:
    """Return a camera or panorama with its pose transformed to another local frame.

    Parameters
    ----------
    view
        `Camera` or `Panorama` with ``frame``.
    frame
        Target frame.

    Returns
    -------
    Camera or Panorama
        The view in ``frame``; the same object if it is already in ``frame``.

    Raises
    ------
    FrameMismatch
        The view does not state the frame of its pose.

    Examples
    --------
    >>> from seasonscapes.cameras.pinhole import camera_at, view_in_frame
    >>> from seasonscapes.frames import LocalFrame
    >>> here, there = LocalFrame(46.55, 7.98), LocalFrame(46.60, 7.90)
    >>> camera = camera_at(here, 46.56, 7.99, 1500.0, heading_deg=90.0, pitch_deg=0.0, size_px=(90, 60))
    >>> moved = view_in_frame(camera, there)
    >>> moved.frame == there, bool(abs(moved.position_m - camera.position_m).max() > 1000.0)
    (True, True)
    """
    if view.frame is None:
        raise FrameMismatch(
            "the camera does not state the local frame of its pose; build it with frame=..., "
            "for example dataclasses.replace(camera, frame=place.frame)"
        )
    if view.frame == frame:
        return view
    pose = pose_in_frame(view.world_from_camera, view.frame, frame)
    return replace(view, world_from_camera=pose, frame=frame)


def rotation_from_angles(heading_deg: float, pitch_deg: float, roll_deg: float = 0.0) -> np.ndarray:
    """Compute the ``world_from_camera`` rotation of a camera with OpenCV axes.

    Parameters
    ----------
    heading_deg
        Azimuth of the optical axis, clockwise from true north [deg].
    pitch_deg
        Elevation of the optical axis, up positive [deg].
    roll_deg
        Rotation about the optical axis; positive lowers the right-hand side of the camera [deg].

    Returns
    -------
    numpy.ndarray
        Rotation ``(3, 3)``.
    """
    heading, pitch, roll = np.radians([heading_deg, pitch_deg, roll_deg])
    forward = np.array([np.sin(heading) * np.cos(pitch), np.cos(heading) * np.cos(pitch), np.sin(pitch)])
    right = np.array([np.cos(heading), -np.sin(heading), 0.0])
    down = np.cross(forward, right)
    right, down = np.cos(roll) * right + np.sin(roll) * down, -np.sin(roll) * right + np.cos(roll) * down
    return np.stack([right, down, forward], axis=1)


def camera_at(
    frame: LocalFrame,
    latitude_deg: float,
    longitude_deg: float,
    height_m: float,
    *,
    heading_deg: float,
    pitch_deg: float = 0.0,
    roll_deg: float = 0.0,
    fov_deg: float = 60.0,
    size_px: tuple[int, int] = (1536, 1024),
) -> Camera:
    """Create a camera with square pixels and a centred principal point at a WGS 84 position.

    Parameters
    ----------
    frame
        Local frame of the pose.
    latitude_deg, longitude_deg
        Position of the projection centre [deg].
    height_m
        Height of the projection centre in the scene's vertical datum [m].
    heading_deg, pitch_deg, roll_deg
        Angles against true north and the horizon **at the camera** (not at the frame's origin) [deg].
    fov_deg
        Horizontal field of view [deg].
    size_px
        Width and height [px].

    Returns
    -------
    Camera
        The camera, with ``frame``.

    Raises
    ------
    ValueError
        Field of view outside (0°, 180°).
    """
    if not 0.0 < fov_deg < 180.0:
        raise ValueError(f"fov_deg: got {fov_deg}, expected 0 < fov < 180")
    pose = np.eye(4)
    pose[:3, :3] = local_axes(frame, latitude_deg, longitude_deg).T @ rotation_from_angles(
        heading_deg, pitch_deg, roll_deg
    )
    pose[:3, 3] = enu_from_geodetic(frame, latitude_deg, longitude_deg, height_m)
    width, height = size_px
    focal = 0.5 * width / np.tan(np.radians(fov_deg) / 2.0)
    return Camera(width, height, focal, focal, width / 2.0, height / 2.0, pose, frame)


def project(camera: Camera, position_m: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Project world points to the image.

    Parameters
    ----------
    camera
        The camera.
    position_m
        World points ``(..., 3)`` [m].

    Returns
    -------
    pixel
        Pixel coordinates ``(..., 2)`` (x, y); NaN for points at or behind the camera plane.
    depth
        Depth along the optical axis ``(...)`` [m].
    """
    pose = camera.world_from_camera
    local = (np.asarray(position_m, float) - pose[:3, 3]) @ pose[:3, :3]
    depth = local[..., 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(depth > 0, 1.0 / depth, np.nan)
    pixel = np.stack([camera.fx * local[..., 0] * scale + camera.cx, camera.fy * local[..., 1] * scale + camera.cy], -1)
    return pixel, depth


def ray_directions(camera: Camera, pixel: ArrayLike | None = None) -> np.ndarray:
    """Compute the world directions of pixels.

    Parameters
    ----------
    camera
        The camera.
    pixel
        Pixel coordinates ``(..., 2)`` (x, y); ``None`` for all pixel centres ``(H, W, 2)``.

    Returns
    -------
    numpy.ndarray
        Unit vectors ``(..., 3)``.
    """
    if pixel is None:
        x, y = np.meshgrid(np.arange(camera.width_px) + 0.5, np.arange(camera.height_px) + 0.5)
    else:
        x, y = np.moveaxis(np.asarray(pixel, float), -1, 0)
    local = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1)
    world = local @ camera.world_from_camera[:3, :3].T
    return world / np.linalg.norm(world, axis=-1, keepdims=True)
