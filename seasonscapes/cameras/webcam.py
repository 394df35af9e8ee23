"""A webcam's facts: where it stands, how its picture maps to directions, and which clock it keeps.

Two tilts are kept apart because they do different things. ``lens_tilt_deg`` is what makers state: a lens pitched on a
level axis of rotation, which lifts the middle row by the same angle all round and so moves the horizon off it.
``tilt_deg`` and ``roll_deg`` lean the axis itself and turn the rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
from pydantic import Field, field_validator, model_validator

from seasonscapes.cameras.panorama import Panorama, panorama_from_angles
from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.declaration import Declaration, InputError, read_toml, validate
from seasonscapes.frames import LocalFrame, enu_from_geodetic, local_axes


class Webcam(Declaration):
    """One camera of a scene file. Exactly one of each pair is given: ``height_m`` or ``above_ground_m``,
    ``north_column_px`` or ``heading_deg``."""

    id: str = Field(min_length=1, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")
    name: str = ""
    latitude_deg: float = Field(ge=-90.0, le=90.0)
    longitude_deg: float = Field(ge=-180.0, le=180.0)
    height_m: float | None = None
    above_ground_m: float | None = Field(default=None, ge=0.0)
    vertical_datum: str = "unknown"
    position_sigma_m: float = Field(default=10.0, gt=0.0)
    projection: Literal["cylindrical", "equirectangular", "perspective"]
    width_px: int = Field(ge=1)
    height_px: int = Field(ge=1)
    horizontal_fov_deg: float = Field(gt=0.0, le=360.0)
    vertical_fov_deg: float | None = Field(default=None, gt=0.0, lt=180.0)
    north_column_px: float | None = None
    heading_deg: float | None = None
    lens_tilt_deg: float = Field(default=0.0, gt=-90.0, lt=90.0)
    tilt_deg: float = Field(default=0.0, gt=-90.0, lt=90.0)
    roll_deg: float = Field(default=0.0, ge=-180.0, le=180.0)
    radial_k1: float = 0.0
    time_zone: str

    @field_validator("time_zone")
    @classmethod
    def _known_zone(cls, value: str) -> str:
        try:
            ZoneInfo(value)
        except (ZoneInfoNotFoundError, ValueError):
            raise ValueError(f"unknown time zone {value!r}; expected an IANA name such as 'Europe/Zurich'") from None
        return value

    @model_validator(mode="after")
    def _one_of_each(self):
        if (self.height_m is None) == (self.above_ground_m is None):
            raise ValueError(f"webcam {self.id}: give exactly one of height_m and above_ground_m")
        if (self.north_column_px is None) == (self.heading_deg is None):
            raise ValueError(f"webcam {self.id}: give exactly one of north_column_px and heading_deg")
        perspective = self.projection == "perspective"
        if perspective and (self.horizontal_fov_deg >= 180.0 or self.north_column_px is not None):
            raise ValueError(f"webcam {self.id}: a perspective camera needs heading_deg and a field of view below 180°")
        if not perspective and self.vertical_fov_deg is None:
            raise ValueError(f"webcam {self.id}: a panorama needs vertical_fov_deg")
        return self


class WebcamFile(Declaration):
    """A file of nothing but ``[[webcam]]`` tables."""

    webcam: list[Webcam] = Field(min_length=1)

    @model_validator(mode="after")
    def _unique(self):
        seen: set[str] = set()
        for webcam in self.webcam:
            if webcam.id in seen:
                raise ValueError(f"two webcams are called {webcam.id}")
            seen.add(webcam.id)
        return self


def read_webcams(path: Path) -> tuple[Webcam, ...]:
    """The ``[[webcam]]`` tables of a TOML file; `InputError` in one line for the first thing that is wrong.

    The file may be a scene file: its other tables are `seasonscapes.scene`'s to judge.
    """
    tables = {key: value for key, value in read_toml(path).items() if key == "webcam"}
    return tuple(validate(tables, WebcamFile, where=path).webcam)


def find_webcam(webcams: Sequence[Webcam], webcam_id: str) -> Webcam:
    """The webcam of that id; `InputError` that suggests the nearest known one."""
    import difflib

    known = {webcam.id: webcam for webcam in webcams}
    if webcam_id in known:
        return known[webcam_id]
    close = difflib.get_close_matches(webcam_id, known, n=1, cutoff=0.4)
    raise InputError(
        "--webcam",
        "no such webcam",
        got=webcam_id,
        cure=f"did you mean '{close[0]}'?" if close else f"known: {', '.join(sorted(known))}",
    )


def webcam_heading_deg(webcam: Webcam) -> float:
    """Azimuth of the middle column [deg], from the heading or from the column that faces north."""
    if webcam.heading_deg is not None:
        return webcam.heading_deg % 360.0
    return (0.5 * webcam.width_px - webcam.north_column_px) * webcam.horizontal_fov_deg / webcam.width_px % 360.0


def webcam_model(webcam: Webcam, frame: LocalFrame, *, ground_m: float | None = None) -> Panorama | Camera:
    """The uncalibrated camera that a webcam's facts describe.

    ``ground_m`` is the height of the terrain under it, needed where its height is stated above ground (`ValueError`).
    A perspective camera comes as its ideal pinhole; ``radial_k1`` goes to `seasonscapes.cameras.lens`.
    """
    height = webcam.height_m
    if height is None:
        if ground_m is None:
            raise ValueError(f"webcam {webcam.id} stands above_ground_m = {webcam.above_ground_m}: ground_m is needed")
        height = ground_m + webcam.above_ground_m
    panoramic = webcam.projection != "perspective"
    pitch = webcam.tilt_deg if panoramic else webcam.tilt_deg + webcam.lens_tilt_deg
    pose = np.eye(4)
    pose[:3, :3] = local_axes(frame, webcam.latitude_deg, webcam.longitude_deg).T @ rotation_from_angles(
        webcam_heading_deg(webcam), pitch, webcam.roll_deg
    )
    pose[:3, 3] = enu_from_geodetic(frame, webcam.latitude_deg, webcam.longitude_deg, height)
    width, rows = webcam.width_px, webcam.height_px
    if not panoramic:
        fx = 0.5 * width / np.tan(np.radians(webcam.horizontal_fov_deg) / 2.0)
        fov = webcam.vertical_fov_deg
        fy = fx if fov is None else 0.5 * rows / np.tan(np.radians(fov) / 2.0)
        return Camera(width, rows, fx, fy, 0.5 * width, 0.5 * rows, pose, frame)
    level = panorama_from_angles(
        webcam.projection,
        (width, rows),
        horizontal_fov_deg=webcam.horizontal_fov_deg,
        vertical_fov_deg=webcam.vertical_fov_deg,
        pose=pose,
    )
    tilt = np.radians(webcam.lens_tilt_deg)
    rise = np.tan(tilt) if level.projection == "cylindrical" else tilt
    horizon_row = 0.5 * rows + level.fy * rise
    return Panorama(level.projection, width, rows, level.fx, level.fy, level.cx, horizon_row, pose, frame)


@dataclass(frozen=True)
class HeightCheck:
    """A webcam's height against the terrain: ``above_ground_m`` is NaN outside it; ``verdict`` is for people."""

    webcam_id: str
    above_ground_m: float
    plausible: bool
    verdict: str


def check_heights(
    webcams: Sequence[Webcam], ground_m: Sequence[float], *, mast_m: float = 60.0, terrain_error_m: float = 10.0
) -> list[HeightCheck]:
    """Compare stated heights with the terrain under each camera, ``ground_m`` ``(N,)`` [m] in the same datum.

    A camera is plausible from ``terrain_error_m`` below the (smoothed) terrain up to ``mast_m`` above it.
    """
    checks = []
    for webcam, ground in zip(webcams, ground_m, strict=True):
        above = webcam.above_ground_m if webcam.height_m is None else webcam.height_m - float(ground)
        if not np.isfinite(ground):
            verdict, plausible = "outside the terrain", False
        elif above < -terrain_error_m:
            verdict, plausible = f"{-above:.0f} m below ground", False
        elif above > mast_m:
            verdict, plausible = f"{above:.0f} m above ground, more than a mast", False
        else:
            verdict, plausible = f"{above:.0f} m above ground", True
        checks.append(HeightCheck(webcam.id, above if np.isfinite(ground) else float("nan"), plausible, verdict))
    return checks


def draw_webcam_map(webcams: Sequence[Webcam], *, width_px: int = 1200, reach_m: float = 3000.0) -> np.ndarray:
    """A plan ``(H, W, 3)`` uint8 sRGB of where the webcams stand and what they cover, north up.

    A wedge of ``reach_m`` shows each field of view; its bold line is the heading of the middle column. Circles all
    round are full panoramas. A scale bar and the ids are drawn in.
    """
    import cv2

    middle = LocalFrame(
        float(np.mean([w.latitude_deg for w in webcams])), float(np.mean([w.longitude_deg for w in webcams]))
    )
    plan = np.array([enu_from_geodetic(middle, w.latitude_deg, w.longitude_deg, 0.0)[:2] for w in webcams])
    low, high = plan.min(0) - 2.0 * reach_m, plan.max(0) + 2.0 * reach_m
    scale = width_px / (high[0] - low[0])
    picture = np.full((int(np.ceil((high[1] - low[1]) * scale)), width_px, 3), 250, np.uint8)

    def at(point_m):
        return tuple(round(v) for v in ((point_m[0] - low[0]) * scale, (high[1] - point_m[1]) * scale))

    shade = picture.copy()
    for webcam, place in zip(webcams, plan, strict=True):
        heading, half = webcam_heading_deg(webcam), webcam.horizontal_fov_deg / 2.0
        angles = np.radians(np.linspace(heading - half, heading + half, 64))
        rim = place + reach_m * np.stack([np.sin(angles), np.cos(angles)], -1)
        outline = rim if half >= 180.0 else np.vstack([place, rim])
        cv2.fillPoly(shade, [np.array([at(p) for p in outline])], (150, 190, 235), cv2.LINE_AA)
    picture = cv2.addWeighted(shade, 0.5, picture, 0.5, 0.0)
    written: list[tuple[int, int]] = []
    for webcam, place in zip(webcams, plan, strict=True):
        heading = np.radians(webcam_heading_deg(webcam))
        cv2.line(
            picture,
            at(place),
            at(place + reach_m * np.array([np.sin(heading), np.cos(heading)])),
            (30, 80, 170),
            2,
            cv2.LINE_AA,
        )
        cv2.circle(picture, at(place), 4, (190, 40, 30), -1, cv2.LINE_AA)
        x, y = at(place)
        while any(abs(x - other[0]) < 110 and abs(y - other[1]) < 13 for other in written):
            y += 6
        written.append((x, y))
        cv2.putText(picture, webcam.id, (x + 6, y - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (20, 20, 20), 1, cv2.LINE_AA)
    bar = 5000.0 if high[0] - low[0] > 20000.0 else 1000.0
    left = (low[0] + 0.03 * (high[0] - low[0]), low[1] + 0.03 * (high[1] - low[1]))
    cv2.line(picture, at(left), at((left[0] + bar, left[1])), (20, 20, 20), 3)
    x, y = at(left)
    cv2.putText(
        picture, f"{bar / 1000:.0f} km", (x, y - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (20, 20, 20), 1, cv2.LINE_AA
    )
    return picture
