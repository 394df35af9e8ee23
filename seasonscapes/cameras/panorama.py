"""Cylindrical and equirectangular panorama models, and resampling of perspective views from panoramas.

The columns of a panorama are linear in azimuth. Its rows are linear in the *tangent* of elevation for line sensors and
stitched strips (cylindrical), or in elevation for images stitched on a sphere (equirectangular). The two models differ
by up to 42 px of 2048 at 63° of vertical field. A tilted mount rotates the rays and does not shift rows; the horizon
row of a level camera is `Panorama.cy`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.cameras.pinhole import Camera, ray_directions, rotation_from_angles
from seasonscapes.frames import LocalFrame, geodetic_from_enu, local_axes
from seasonscapes.images import linear_from_srgb

Projection = Literal["cylindrical", "equirectangular"]
PROJECTIONS: tuple[Projection, ...] = ("cylindrical", "equirectangular")
# Largest image side of cv2.remap (signed 16-bit coordinates).
_REMAP_LIMIT = 32766


@dataclass(frozen=True)
class Panorama:
    """A calibrated panorama with a single projection centre.

    Parameters
    ----------
    projection
        ``"cylindrical"``: ``row = cy - fy tan(elevation)``; ``"equirectangular"``: ``row = cy - fy elevation``.
        Both: ``column = cx + fx azimuth``. Angles [rad] refer to the panorama's own axis and heading.
    width_px, height_px
        Image size; pixel centres lie at +0.5.
    fx, fy
        Pixels per radian of azimuth, and per unit of tangent (cylindrical) or radian (equirectangular) of elevation.
    cx, cy
        Column of the heading and row of the panorama's own horizon [px].
    world_from_camera
        Rigid transform ``(4, 4)`` with OpenCV axes at the column ``cx``: x right, y down along the axis of rotation, z
        forward. The y axis of a level camera is vertical.
    frame
        Local frame of ``world_from_camera``; ``None`` if unknown. See `pinhole.view_in_frame`.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> pose = ss.camera(place, "aerial").world_from_camera
    >>> panorama = ss.Panorama("cylindrical", 360, 60, 57.3, 57.3, 180.0, 30.0, pose, frame=place.frame)
    >>> view = ss.render(place, panorama, "2024-07-20T13:30", sky="hosek", spp=1)
    >>> view.radiance.shape
    (60, 360, 3)
    """

    projection: Projection
    width_px: int
    height_px: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_from_camera: np.ndarray
    frame: LocalFrame | None = None

    def __post_init__(self):
        if self.projection not in PROJECTIONS:
            raise ValueError(f"Panorama: projection {self.projection!r}, expected one of {', '.join(PROJECTIONS)}")
        pose = np.asarray(self.world_from_camera, float)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError(f"world_from_camera: got shape {pose.shape}, expected a finite (4, 4) matrix")
        if not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6) or np.linalg.det(pose[:3, :3]) < 0:
            raise ValueError("world_from_camera: expected a right-handed rotation; the axes may be mirrored")
        if not np.isfinite([self.fx, self.fy, self.cx, self.cy, self.width_px, self.height_px]).all():
            raise ValueError("Panorama: image size, focal lengths and principal point must be finite")
        if min(self.width_px, self.height_px) < 1 or min(self.fx, self.fy) <= 0:
            raise ValueError("Panorama: image size and focal lengths must be positive")
        if self.span_deg > 360.0 + 360.0 * 2.0 / self.width_px:
            raise ValueError(f"Panorama: {self.width_px} px at fx = {self.fx:.1f} span {self.span_deg:.1f}°, over 360°")
        object.__setattr__(self, "world_from_camera", pose)

    @property
    def position_m(self) -> np.ndarray:
        """Projection centre ``(3,)`` east-north-up [m]."""
        return self.world_from_camera[:3, 3]

    @property
    def span_deg(self) -> float:
        """Horizontal field of view [deg]."""
        return float(np.degrees(self.width_px / self.fx))

    @property
    def full_circle(self) -> bool:
        """Whether the field of view is 360° within two pixels."""
        return abs(self.span_deg - 360.0) * self.width_px <= 2.0 * 360.0


def panorama_from_angles(
    projection: Projection,
    size_px: tuple[int, int],
    *,
    horizontal_fov_deg: float,
    vertical_fov_deg: float,
    pose: np.ndarray,
    horizon_row_px: float | None = None,
    frame: LocalFrame | None = None,
) -> Panorama:
    """Create a panorama from its fields of view, with the heading at the middle column.

    Parameters
    ----------
    projection
        ``"cylindrical"`` or ``"equirectangular"``.
    size_px
        Width and height [px].
    horizontal_fov_deg
        Horizontal field of view [deg].
    vertical_fov_deg
        Vertical field of view of a lens centred on the horizon, as stated by manufacturers [deg].
    pose
        ``world_from_camera`` ``(4, 4)``.
    horizon_row_px
        Row of the horizon [px]; ``None`` for the middle row.
    frame
        Local frame of the pose.

    Returns
    -------
    Panorama
        The panorama.

    Raises
    ------
    ValueError
        Horizontal field of view outside (0°, 360°], or vertical outside (0°, 180°).
    """
    width, height = size_px
    if not 0.0 < horizontal_fov_deg <= 360.0:
        raise ValueError(f"horizontal_fov_deg: got {horizontal_fov_deg}, expected 0 < fov <= 360")
    if not 0.0 < vertical_fov_deg < 180.0:
        raise ValueError(f"vertical_fov_deg: got {vertical_fov_deg}, expected 0 < fov < 180")
    half = np.radians(vertical_fov_deg) / 2.0
    fy = 0.5 * height / (np.tan(half) if projection == "cylindrical" else half)
    row = 0.5 * height if horizon_row_px is None else horizon_row_px
    fx = width / np.radians(horizontal_fov_deg)
    return Panorama(projection, width, height, fx, fy, 0.5 * width, row, pose, frame)


def level_panorama(camera: Camera, frame: LocalFrame, size_px: tuple[int, int]) -> Panorama:
    """Create a full-circle cylindrical panorama at a camera's position, level and with the camera's heading.

    Parameters
    ----------
    camera
        Supplies position and heading (middle column).
    frame
        Local frame of the camera.
    size_px
        Width and height [px]; pixels are square.

    Returns
    -------
    Panorama
        The panorama.
    """
    latitude, longitude, _ = geodetic_from_enu(frame, camera.position_m)
    axes = local_axes(frame, float(latitude), float(longitude))
    east, north, _ = axes @ camera.world_from_camera[:3, 2]
    pose = camera.world_from_camera.copy()
    pose[:3, :3] = axes.T @ rotation_from_angles(float(np.degrees(np.arctan2(east, north))), 0.0)
    width, height = size_px
    focal = width / (2.0 * np.pi)
    return Panorama("cylindrical", width, height, focal, focal, 0.5 * width, 0.5 * height, pose, frame)


def project_panorama(panorama: Panorama, position_m: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Project world points to the panorama.

    Parameters
    ----------
    panorama
        The panorama.
    position_m
        World points ``(..., 3)`` [m].

    Returns
    -------
    pixel
        Pixel coordinates ``(..., 2)`` (x, y). Columns of a full circle lie in [0, width); otherwise they extend beyond
        both edges up to the direction opposite to the middle column. NaN for the projection centre.
    distance
        Distance from the projection centre ``(...)`` [m].
    """
    pose = panorama.world_from_camera
    return project_local(panorama, (np.asarray(position_m, float) - pose[:3, 3]) @ pose[:3, :3])


def project_local(panorama: Panorama, local_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project points given in camera axes; see `project_panorama`.

    Parameters
    ----------
    panorama
        The panorama.
    local_m
        Points ``(..., 3)`` in camera axes [m].

    Returns
    -------
    pixel, distance
        As in `project_panorama`.
    """
    x, y, z = np.moveaxis(np.asarray(local_m, float), -1, 0)
    horizontal, distance = np.hypot(x, z), np.sqrt(x * x + y * y + z * z)
    with np.errstate(divide="ignore", invalid="ignore"):
        rise = -y / horizontal if panorama.projection == "cylindrical" else np.arctan2(-y, horizontal)
    middle = (0.5 * panorama.width_px - panorama.cx) / panorama.fx
    azimuth = middle + np.remainder(np.arctan2(x, z) - middle + np.pi, 2.0 * np.pi) - np.pi
    column = panorama.cx + panorama.fx * azimuth
    pixel = np.stack([column, panorama.cy - panorama.fy * rise], axis=-1)
    return np.where((distance > 0)[..., None], pixel, np.nan), distance


def panorama_directions(panorama: Panorama, pixel: ArrayLike | None = None) -> np.ndarray:
    """Compute the world directions of pixels of a panorama.

    Parameters
    ----------
    panorama
        The panorama.
    pixel
        Pixel coordinates ``(..., 2)`` (x, y); ``None`` for all pixel centres ``(H, W, 2)``.

    Returns
    -------
    numpy.ndarray
        Unit vectors ``(..., 3)``.
    """
    if pixel is None:
        x, y = np.meshgrid(np.arange(panorama.width_px) + 0.5, np.arange(panorama.height_px) + 0.5)
    else:
        x, y = np.moveaxis(np.asarray(pixel, float), -1, 0)
    azimuth, rise = (x - panorama.cx) / panorama.fx, (panorama.cy - y) / panorama.fy
    elevation = np.arctan(rise) if panorama.projection == "cylindrical" else rise
    level = np.cos(elevation)
    local = np.stack([np.sin(azimuth) * level, -np.sin(elevation), np.cos(azimuth) * level], axis=-1)
    return local @ panorama.world_from_camera[:3, :3].T


def view_directions(view: Camera | Panorama, pixel: ArrayLike | None = None) -> np.ndarray:
    """Compute the world directions of pixels of a camera or panorama.

    Parameters
    ----------
    view
        Camera or panorama.
    pixel
        Pixel coordinates ``(..., 2)`` (x, y); ``None`` for all pixel centres ``(H, W, 2)``.

    Returns
    -------
    numpy.ndarray
        Unit vectors ``(..., 3)``.
    """
    return panorama_directions(view, pixel) if isinstance(view, Panorama) else ray_directions(view, pixel)


def split_panorama(
    panorama: Panorama,
    *,
    fov_deg: float = 85.0,
    overlap_deg: float = 10.0,
    size_px: tuple[int, int] | None = None,
    count: int | None = None,
) -> list[Camera]:
    """Create evenly spaced perspective cameras that cover a panorama, with its position and vertical axis.

    The optical axes lie on the panorama's horizon; pixels are square. The principal point is shifted vertically, as
    with a shift lens, so that the panorama's rows fill the image and vertical lines remain vertical.

    Parameters
    ----------
    panorama
        The panorama to cover.
    fov_deg
        Horizontal field of view of each camera [deg]; a narrower partial panorama gets one camera of its own span.
    overlap_deg
        Least overlap of neighbouring cameras [deg].
    size_px
        Width and height [px]; ``None`` for the panorama's height and the width of equal resolution on the optical axis.
    count
        Number of cameras; ``None`` for the smallest number with the given overlap.

    Returns
    -------
    list of Camera
        Cameras in order of increasing azimuth, in the panorama's local frame.

    Raises
    ------
    ValueError
        Field of view outside (0, 160], overlap not below it, or a ``count`` too small to cover the panorama.
    """
    span = min(panorama.span_deg, 360.0)
    if not 0.0 < fov_deg <= 160.0:
        raise ValueError(f"fov_deg: got {fov_deg}, expected 0 < fov <= 160")
    if not 0.0 <= overlap_deg < fov_deg:
        raise ValueError(f"overlap_deg: got {overlap_deg}, expected 0 <= overlap < fov_deg = {fov_deg}")
    fov = min(fov_deg, span)
    step = fov - overlap_deg
    least = (
        int(np.ceil(span / step - 1e-9))
        if panorama.full_circle
        else 1 + int(np.ceil(max(span - fov, 0.0) / step - 1e-9))
    )
    views = least if count is None else count
    if views < least:
        raise ValueError(f"count: {views} views of {fov:.1f}° leave gaps in {span:.1f}°; expected at least {least}")
    left_deg = -np.degrees(panorama.cx / panorama.fx)
    if panorama.full_circle:
        azimuth_deg = left_deg + (np.arange(views) + 0.5) * span / views
    else:
        azimuth_deg = left_deg + fov / 2.0 + np.arange(views) * (span - fov) / max(views - 1, 1)
    if size_px is None:
        size_px = (max(1, round(2.0 * panorama.fx * np.tan(np.radians(fov) / 2.0))), panorama.height_px)
    width, height = size_px
    focal = 0.5 * width / np.tan(np.radians(fov) / 2.0)
    rise = (panorama.cy - np.array([0.0, panorama.height_px])) / panorama.fy
    tangent = rise if panorama.projection == "cylindrical" else np.tan(np.clip(rise, -1.5, 1.5))
    cameras = []
    for azimuth in np.radians(azimuth_deg):
        pose = panorama.world_from_camera.copy()
        rotation = np.array(
            [[np.cos(azimuth), 0.0, np.sin(azimuth)], [0.0, 1.0, 0.0], [-np.sin(azimuth), 0.0, np.cos(azimuth)]]
        )
        pose[:3, :3] = pose[:3, :3] @ rotation
        centre_row = height / 2.0 + focal * tangent.mean()
        cameras.append(Camera(width, height, focal, focal, width / 2.0, centre_row, pose, panorama.frame))
    return cameras


def cut_view(
    image: np.ndarray, panorama: Panorama, camera: Camera, *, supersample: int | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Resample a perspective view from a panorama, with anti-aliasing in linear light.

    Every output pixel is the mean of ``supersample²`` bicubic samples.

    Parameters
    ----------
    image
        ``(H, W, 3)`` scene-linear float, or uint8 sRGB, which is linearised first.
    panorama
        Model of the image.
    camera
        Any camera at the panorama's position (parallax is not modelled).
    supersample
        Samples per pixel along each axis; ``None`` for at least the panorama's resolution on the optical axis.

    Returns
    -------
    view
        Scene-linear image ``(h, w, 3)`` float32.
    inside
        ``(h, w)`` bool, False outside the panorama.

    Raises
    ------
    ValueError
        The image size differs from the model's, or the source region exceeds the size limit of ``cv2.remap``.
    """
    if image.shape[:2] != (panorama.height_px, panorama.width_px):
        raise ValueError(
            f"cut_view: the image is {image.shape[1]} x {image.shape[0]} px, the panorama model "
            f"{panorama.width_px} x {panorama.height_px}"
        )
    if supersample is None:
        supersample = max(1, int(np.ceil(max(panorama.fx / camera.fx, panorama.fy / camera.fy) - 0.05)))
    height, width = camera.height_px, camera.width_px
    x = (np.arange(width * supersample) + 0.5) / supersample
    column_row = _source_coordinates(panorama, camera, x, (np.arange(height * supersample) + 0.5) / supersample)
    source, offset = _crop_linear(image, panorama, column_row[..., 0])
    # cv2's pixel coordinates have their origin at the centre of the first pixel.
    map_x = (column_row[..., 0] - offset - 0.5).astype(np.float32)
    map_y = (column_row[..., 1] - 0.5).astype(np.float32)
    sampled = cv2.remap(source, map_x, map_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    inside = (map_y >= -0.5) & (map_y <= panorama.height_px - 0.5)
    if not panorama.full_circle:
        inside &= (column_row[..., 0] >= 0.0) & (column_row[..., 0] <= panorama.width_px)
    shape = (height, supersample, width, supersample)
    view = np.maximum(sampled, 0.0).reshape(*shape, 3).mean(axis=(1, 3), dtype=np.float32)
    return view, np.all(inside.reshape(shape), axis=(1, 3))


def _source_coordinates(panorama: Panorama, camera: Camera, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Panorama pixels ``(len(y), len(x), 2)`` of a grid of view pixels, with unwrapped (continuous) columns."""
    direction = ray_directions(camera, np.stack(np.meshgrid(x, y), axis=-1))
    pixel, _ = project_local(panorama, direction @ panorama.world_from_camera[:3, :3])
    circle = 2.0 * np.pi * panorama.fx
    pixel[..., 0] -= circle * np.round((pixel[..., 0] - pixel[len(y) // 2, len(x) // 2, 0]) / circle)
    return pixel


def _crop_linear(image: np.ndarray, panorama: Panorama, column: np.ndarray) -> tuple[np.ndarray, int]:
    """Range of required columns, wrapped around for full circles, as linear float32; and index of the first column."""
    first, last = int(np.floor(column.min())) - 4, int(np.ceil(column.max())) + 4
    if panorama.full_circle:
        columns = np.mod(np.arange(first, last), panorama.width_px)
    else:
        columns = np.clip(np.arange(first, last), 0, panorama.width_px - 1)
    if max(len(columns), image.shape[0]) > _REMAP_LIMIT:
        raise ValueError(
            f"cut_view: {len(columns)} x {image.shape[0]} px exceed the limit of {_REMAP_LIMIT} px of cv2.remap"
        )
    crop = image[:, columns]
    if crop.dtype == np.uint8:
        crop = linear_from_srgb(np.arange(256, dtype=np.float32) / 255.0)[crop]
    return np.ascontiguousarray(crop, np.float32), first
