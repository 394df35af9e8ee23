"""A map of a camera path: shaded relief, the path, fields of view, and a height profile."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.cameras.trajectory import Ground
from seasonscapes.frames import geodetic_from_enu
from seasonscapes.terrain.crs import map_position
from seasonscapes.workflows.place import Place

_MAP_PX, _PROFILE_PX = 1200, 220


def draw_path_map(place: Place, cameras: Sequence[Camera], waypoints: Sequence[Camera], ground: Ground) -> np.ndarray:
    """Draw a camera path: a map with shaded relief above, a height profile below.

    Parameters
    ----------
    place
        The place that the path lies in.
    cameras
        The views.
    waypoints
        Drawn with their numbers.
    ground
        Heights of the ground in the local frame, as a function of east and north [m].

    Returns
    -------
    numpy.ndarray
        Picture ``(H, W, 3)`` uint8 sRGB.
    """
    relief, pixel = _relief(place)
    positions = np.array([camera.position_m for camera in cameras])
    picture = _drawn(relief, pixel, cameras, waypoints)
    return np.concatenate([picture, _profile(positions, ground(positions[:, :2]), picture.shape[1])])


def _relief(place: Place) -> tuple[np.ndarray, Callable[[np.ndarray], np.ndarray]]:
    """Shaded relief ``(H, W, 3)`` uint8, and a function from positions [m, east-north-up] to its pixels."""
    heights = place.elevation.values[..., 0]
    scale = _MAP_PX / max(heights.shape)
    shape = (max(2, round(heights.shape[1] * scale)), max(2, round(heights.shape[0] * scale)))
    small = cv2.resize(
        np.ascontiguousarray(heights), shape, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    )
    extent = np.ptp(place.terrain.vertices[:, :2].astype(float), axis=0)
    down, right = np.gradient(small, float(extent[1]) / shape[1], float(extent[0]) / shape[0])
    # Light from the north-west, the convention of maps.
    light = (0.5 * right + 0.5 * down + 0.7) / np.sqrt(1.0 + down**2 + right**2)
    height = (small - np.nanmin(small)) / max(float(np.nanmax(small) - np.nanmin(small)), 1.0)
    grey = np.clip(60.0 + 130.0 * np.clip(light, 0.0, 1.2) + 40.0 * height, 0.0, 255.0)
    inverse = ~place.elevation.transform

    def pixel(places_m: np.ndarray) -> np.ndarray:
        latitude, longitude, _ = geodetic_from_enu(place.frame, places_m)
        x, y = map_position(place.elevation, latitude, longitude)
        column, row = inverse.a * x + inverse.b * y + inverse.c, inverse.d * x + inverse.e * y + inverse.f
        return np.stack([np.asarray(column) * scale, np.asarray(row) * scale], axis=-1)

    return np.repeat(np.nan_to_num(grey).astype(np.uint8)[..., None], 3, axis=2), pixel


def _drawn(relief: np.ndarray, pixel: Callable, cameras: Sequence[Camera], waypoints: Sequence[Camera]) -> np.ndarray:
    """The path in red, fields of view in yellow, waypoints in blue."""
    picture = np.ascontiguousarray(relief)
    positions = np.array([camera.position_m for camera in cameras])
    line = pixel(positions)
    reach_m = 0.06 * float(np.linalg.norm(np.ptp(positions[:, :2], axis=0))) + 150.0
    for index in range(0, len(cameras), max(1, len(cameras) // 40)):
        camera = cameras[index]
        rotation = camera.world_from_camera[:3, :3]
        sides = [rotation @ [x / camera.fx, 0.0, 1.0] for x in (-camera.cx, camera.width_px - camera.cx)]
        for side in sides:
            flat = np.array([side[0], side[1], 0.0]) / max(np.hypot(*side[:2]), 1e-9)
            end = pixel((camera.position_m + reach_m * flat)[None])[0]
            cv2.line(picture, _point(line[index]), _point(end), (250, 200, 80), 1, cv2.LINE_AA, 3)
    cv2.polylines(picture, [np.round(line * 8).astype(np.int32)], False, (230, 60, 40), 2, cv2.LINE_AA, 3)
    for number, camera in enumerate(waypoints):
        place = pixel(camera.position_m[None])[0]
        cv2.circle(picture, _point(place), 6 * 8, (40, 90, 220), -1, cv2.LINE_AA, 3)
        cv2.putText(
            picture,
            str(number + 1),
            (int(place[0]) + 8, int(place[1]) - 8),
            cv2.FONT_HERSHEY_SIMPLEX,
            0.6,
            (20, 40, 120),
            2,
            cv2.LINE_AA,
        )
    return picture


def _point(place: np.ndarray) -> tuple[int, int]:
    return round(float(place[0]) * 8), round(float(place[1]) * 8)


def _profile(positions: np.ndarray, ground_m: np.ndarray, width_px: int) -> np.ndarray:
    """Heights of path and ground along the path, ``(h, width_px, 3)`` uint8."""
    picture = np.full((_PROFILE_PX, width_px, 3), 245, np.uint8)
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))])
    heights = np.concatenate([positions[:, 2], ground_m[np.isfinite(ground_m)]])
    low, high = float(heights.min()) - 50.0, float(heights.max()) + 50.0
    x = 10.0 + way / max(way[-1], 1.0) * (width_px - 20.0)

    def y(height_m: np.ndarray) -> np.ndarray:
        return (_PROFILE_PX - 12.0) - (np.asarray(height_m) - low) / (high - low) * (_PROFILE_PX - 24.0)

    solid = np.nan_to_num(ground_m, nan=low)
    area = np.concatenate([np.stack([x, y(solid)], 1), [[x[-1], _PROFILE_PX], [x[0], _PROFILE_PX]]])
    cv2.fillPoly(picture, [np.round(area * 8).astype(np.int32)], (170, 165, 155), cv2.LINE_AA, 3)
    cv2.polylines(
        picture,
        [np.round(np.stack([x, y(positions[:, 2])], 1) * 8).astype(np.int32)],
        False,
        (230, 60, 40),
        2,
        cv2.LINE_AA,
        3,
    )
    text = f"{way[-1] / 1000:.1f} km, {positions[:, 2].min():.0f} to {positions[:, 2].max():.0f} m"
    cv2.putText(picture, text, (14, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.55, (60, 60, 60), 1, cv2.LINE_AA)
    return picture
