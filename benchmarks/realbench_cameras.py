"""The fixed cameras of realbench: poses, pictures and masks, from the folders of real data."""

from __future__ import annotations

import csv
import json
import re
import tempfile
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.frames import enu_from_geodetic, local_axes
from seasonscapes.images import read_image_srgb8
from seasonscapes.terrain.crs import geodetic_from_map
from seasonscapes.workflows.camera_import import map_axes
from seasonscapes.workflows.place import Place, load_place
from seasonscapes.workspace import Workspace

MASKS = Path(__file__).with_name("realbench_masks.json")
# Pixels at the skyline mix terrain and sky, and poses are right to a pixel or two.
SKYLINE_PX = 2


@dataclass(frozen=True)
class Picture:
    """One picture: encoded values (H, W, 3), what may be judged, and what was seen by eye."""

    name: str
    time: datetime
    image: np.ndarray
    usable: np.ndarray
    sun_visible: bool | None
    season: str


@dataclass(frozen=True)
class FixedCase:
    """One camera with its place and its pictures; ``shadows`` are polygons of sunlit and shaded ground by picture."""

    name: str
    place: Place
    camera: Camera
    pictures: list[Picture]
    shadows: dict[str, dict[str, list]]
    full_width_px: int


def polygons_mask(polygons: list, size: tuple[int, int], scale: float) -> np.ndarray:
    """Pixels ``(H, W)`` inside any of the polygons, drawn at the pictures' full size."""
    mask = np.zeros(size, np.uint8)
    for polygon in polygons:
        cv2.fillPoly(mask, [np.round(np.array(polygon, float) * scale).astype(np.int32)], 1)
    return mask.astype(bool)


def scaled(image: np.ndarray, size_px: tuple[int, int]) -> np.ndarray:
    if image.shape[1::-1] == size_px:
        return image
    return cv2.resize(image, size_px, interpolation=cv2.INTER_AREA)


def scene_of(name: str, latitude_deg: float, longitude_deg: float, elevation: Path, workspace: Workspace) -> Place:
    """A place from one elevation raster."""
    text = (
        f'name = "{name}"\ntitle = "{name}"\nattribution = "see the data folder"\n\n'
        f"[origin]\nlatitude_deg = {latitude_deg}\nlongitude_deg = {longitude_deg}\n\n"
        f'[elevation]\nfile = "{elevation}"\n'
    )
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / f"{name}.toml"
        scene.write_text(text, encoding="utf-8")
        return load_place(scene, workspace, allow_outside=True)


# Fitted to 18 points of the skyline and 12 of the near slope's edge in the picture of 2013-08-01; rms 2.4 and 4.9 px.
# The data folder's own pose (``refined_pose=False``) has the skyline, and the near slope 45 px beside its place.
CHAMONIX_POSE = {
    "east_m": -35.9,
    "north_m": -366.8,
    "height_m": 1065.3,
    "heading_deg": 191.634,
    "pitch_deg": 3.147,
    "roll_deg": -1.647,
    "focal_px": 795.56,
}


def chamonix(
    data: Path, workspace: Workspace, width_px: int, *, refined_pose: bool = True, pictures: Path | None = None
) -> FixedCase:
    """The webcam of Chamonix; ``pictures`` is another folder of the same form (hours kept back)."""
    folder = data / "chamonix-2013"
    known = json.loads((folder / "camera.json").read_text())
    masks = json.loads(MASKS.read_text())["chamonix-2013"]
    place = scene_of("chamonix", 45.87, 6.874, folder / "dem_montblanc_93m_wgs84.tif", workspace)
    latitude, longitude = known["camera_lat_lon"]
    pose = {
        "east_m": 0.0,
        "north_m": 0.0,
        "height_m": known["camera_height_m"],
        "heading_deg": known["view_azimuth_deg"],
        "pitch_deg": known["pitch_deg"],
        "roll_deg": -known["roll_deg"],
        "focal_px": known["focal_px"],
    }
    if refined_pose:
        pose = CHAMONIX_POSE
    latitude += pose["north_m"] / 111_100.0
    longitude += pose["east_m"] / 77_500.0
    width, height = known["size"]
    scale = width_px / width
    size = (width_px, round(height * scale))
    rows_columns = (size[1], size[0])
    world = np.eye(4)
    world[:3, :3] = local_axes(place.frame, latitude, longitude).T @ rotation_from_angles(
        pose["heading_deg"], pose["pitch_deg"], pose["roll_deg"]
    )
    world[:3, 3] = enu_from_geodetic(place.frame, latitude, longitude, pose["height_m"])
    centre = np.array(known["principal_point_px"]) * scale
    focal = pose["focal_px"] * scale
    camera = Camera(*size, focal, focal, float(centre[0]), float(centre[1]), world, place.frame)
    near = polygons_mask(masks["near_ground"], rows_columns, scale)
    folder = pictures or folder
    found = []
    for row in csv.DictReader((folder / "pictures.csv").open()):
        name = Path(row["file"]).stem
        image = scaled(read_image_srgb8(folder / row["file"]).astype(np.float32) / 255.0, size)
        usable = ~near & ~polygons_mask(masks["hidden"].get(name, []), rows_columns, scale)
        time = datetime.fromisoformat(row["time_utc"].replace("Z", "+00:00"))
        season = "snow" if time.month < 6 else "summer"
        found.append(Picture(name, time, image, usable, masks["sun_visible"].get(name), season))
    return FixedCase("chamonix-2013", place, camera, found, masks["shadows"], width)


def kronebreen(data: Path, workspace: Workspace, width_px: int) -> FixedCase:
    """Camera KR1 above the front of Kronebreen: four overcast hours of one day; fjord and near slope are masked."""
    folder = data / "kronebreen-kr1"
    known = json.loads((folder / "camera.json").read_text())
    masks = json.loads(MASKS.read_text())["kronebreen-kr1"]
    crs, position = f"EPSG:{known['epsg']}", known["camera_position_utm33n_m"]
    latitude, longitude = (float(each) for each in geodetic_from_map(crs, *position[:2]))
    place = scene_of("kronebreen", latitude, longitude, folder / "dem_kongsfjorden_20m_utm33n.tif", workspace)
    world = np.eye(4)
    axes = local_axes(place.frame, latitude, longitude)
    world[:3, :3] = map_axes(crs, tuple(position), place.frame, axes) @ np.array(known["R_world_to_camera"]).T
    world[:3, 3] = enu_from_geodetic(place.frame, latitude, longitude, position[2])
    width, height = known["size"]
    scale = width_px / width
    size = (width_px, round(height * scale))
    (fx, _, cx), (_, fy, cy), _ = np.array(known["K_px"]) * scale
    camera = Camera(*size, fx, fy, cx, cy, world, place.frame)
    usable = ~polygons_mask(masks["near_ground"], size[::-1], scale)
    found = []
    for path in sorted((folder / "pictures").glob("*.jpg")):
        image = scaled(read_image_srgb8(path).astype(np.float32) / 255.0, size)
        found.append(Picture(path.stem, _time_in(path.stem), image, usable, masks["sun_visible"][path.stem], "summer"))
    return FixedCase("kronebreen-kr1", place, camera, found, {}, width)


# Leaving one picture out, the ground is fitted to at least two others.
LEAST_PICTURES, _SEASON_DAYS = 3, 45


def _time_in(name: str) -> datetime:
    """The instant in a picture's name, taken as UTC: year, month, day, hour and minute from the first year on."""
    start = re.search(r"(?:19|20)\d\d", name)
    assert start is not None, name
    digits = re.sub(r"\D", "", name[start.start() :])
    return datetime.strptime(digits[:12], "%Y%m%d%H%M").replace(tzinfo=UTC)


def most_of_one_season(times: list[datetime]) -> int:
    """The most pictures that lie within 45 days."""
    days = np.sort([each.timestamp() / 86_400.0 for each in times])
    return int(max((np.searchsorted(days, day + _SEASON_DAYS, "right") - k for k, day in enumerate(days)), default=0))


def cameras_not_scored(data: Path) -> list[dict[str, Any]]:
    """Fixed cameras of the data folder that leaving one picture out cannot score, and why."""
    cameras: dict[str, list[datetime]] = {}
    glacier = data / "columbia-glacier" / "pictures.json"
    for picture in json.loads(glacier.read_text()) if glacier.is_file() else []:
        time = datetime.fromisoformat(picture["time_utc"].replace("Z", "+00:00"))
        cameras.setdefault(f"columbia-glacier {picture['station']}", []).append(time)
    for name, pattern in (
        ("finse-webcam", "*.jpg"),
        ("bolternosa-timelapse", "*.jpg"),
        ("pineta-2024-06-13", "pictures/*.jpg"),
    ):
        times = [_time_in(path.stem) for path in sorted((data / name).glob(pattern))]
        if times:
            cameras[name] = times
    rows = []
    for name, times in sorted(cameras.items()):
        most = most_of_one_season(times)
        if not list((data / name.split()[0]).glob("*.tif")):
            reason = "no heights of the place in the data folder"
        elif most < LEAST_PICTURES:
            reason = (
                f"at most {most} of its pictures within {_SEASON_DAYS} days; leaving one out needs {LEAST_PICTURES}"
            )
        else:
            reason = "no reader of this camera"
        rows.append({"camera": name, "pictures": len(times), "reason": reason})
    return rows
