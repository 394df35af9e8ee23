"""Declarations of webcams in scene files (position, projection, orientation, clock), checks and an overview map.

Two kinds of tilt are distinguished. ``lens_tilt_deg``, as stated by manufacturers, is the pitch of the lens on a level
axis of rotation: it shifts the horizon from the middle row by the same angle in all directions. ``tilt_deg`` and
``roll_deg`` tilt the axis of rotation itself and rotate the rays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

import numpy as np
from pydantic import Field, ModelWrapValidatorHandler, field_validator, model_validator

from seasonscapes.cameras.panorama import Panorama, panorama_from_angles
from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.declaration import Declaration, InputError, Name, Text, all_at_once, read_toml, validate
from seasonscapes.frames import Latitude, LocalFrame, Longitude, enu_from_geodetic, local_axes


class Webcam(Declaration):
    """Declaration of one webcam in a scene file.

    Exactly one of each pair is given: ``height_m`` or ``above_ground_m``, ``north_column_px`` or ``heading_deg``.

    Parameters
    ----------
    id, name
        Identifier (see `declaration.checked_name`), and name for human readers.
    latitude_deg, longitude_deg
        WGS 84 position [deg].
    height_m, above_ground_m
        Height in ``vertical_datum`` or above the terrain [m].
    vertical_datum
        Vertical datum of ``height_m``.
    position_sigma_m
        Standard deviation of the position [m].
    projection
        ``cylindrical``, ``equirectangular`` or ``perspective``.
    width_px, height_px
        Image size [px].
    horizontal_fov_deg, vertical_fov_deg
        Fields of view [deg]; ``vertical_fov_deg`` is required for panoramas.
    north_column_px, heading_deg
        Column that is directed to true north [px], or azimuth of the middle column [deg].
    lens_tilt_deg
        Pitch of the lens on a level axis of rotation [deg].
    tilt_deg, roll_deg
        Pitch and roll of the axis of rotation, or of a perspective camera [deg].
    radial_k1
        Radial distortion coefficient of a perspective camera; see `seasonscapes.cameras.lens`.
    principal_point_px
        Column and row of the optical axis of a perspective camera [px]; the middle if omitted. ``heading_deg`` is then the
        azimuth of that axis.
    distortion
        Coefficients ``k1`` … ``k6``, ``p1``, ``p2`` of a perspective camera instead of ``radial_k1``; they are taken as known.
    time_zone
        IANA name of the time zone of the camera's clock.
    """

    id: Name
    name: Text = ""
    latitude_deg: Latitude
    longitude_deg: Longitude
    height_m: float | None = Field(default=None, ge=-500.0, le=100_000.0)
    above_ground_m: float | None = Field(default=None, ge=0.0, le=100_000.0)
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
    principal_point_px: tuple[float, float] | None = Field(default=None, strict=False)
    distortion: dict[Literal["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"], float] = Field(default_factory=dict)
    time_zone: str

    @field_validator("time_zone")
    @classmethod
    def _known_zone(cls, value: str) -> str:
        try:
            ZoneInfo(value)
        except (ZoneInfoNotFoundError, ValueError):
            raise ValueError(f"unknown time zone {value!r}; expected an IANA name such as 'Europe/Zurich'") from None
        return value

    @model_validator(mode="wrap")
    @classmethod
    def _one_of_each(cls, data: Any, validated: ModelWrapValidatorHandler[Self]) -> Self:
        return all_at_once(data, validated, cls._pairs)

    @staticmethod
    def _pairs(data: Mapping[str, Any]) -> list[str]:
        """What is wrong with keys that exclude or need each other."""
        webcam, given = data.get("id"), {key for key, value in data.items() if value is not None}
        problems = []
        if len(given & {"height_m", "above_ground_m"}) != 1:
            problems.append(f"webcam {webcam}: give exactly one of height_m and above_ground_m")
        if len(given & {"north_column_px", "heading_deg"}) != 1:
            problems.append(f"webcam {webcam}: give exactly one of north_column_px and heading_deg")
        fov = data.get("horizontal_fov_deg")
        if data.get("projection") == "perspective":
            if "north_column_px" in given or (isinstance(fov, (int, float)) and fov >= 180.0):
                problems.append(
                    f"webcam {webcam}: a perspective camera needs heading_deg and a field of view below 180°"
                )
        elif "projection" in given and "vertical_fov_deg" not in given:
            problems.append(f"webcam {webcam}: a panorama needs vertical_fov_deg")
        if {"radial_k1", "distortion"} <= given:
            problems.append(f"webcam {webcam}: radial_k1 and distortion state the same twice")
        if data.get("projection") != "perspective" and given & {"distortion", "principal_point_px"}:
            problems.append(f"webcam {webcam}: distortion and principal_point_px are a perspective camera's")
        return problems


class WebcamFile(Declaration):
    """A TOML file of ``[[webcam]]`` tables."""

    webcam: list[Webcam] = Field(min_length=1)

    @model_validator(mode="after")
    def _unique(self) -> Self:
        ids: set[str] = set()
        for webcam in self.webcam:
            if webcam.id.casefold() in ids:
                raise ValueError(f"two webcams have the id {webcam.id}")
            ids.add(webcam.id.casefold())
        return self


def read_webcams(path: Path) -> tuple[Webcam, ...]:
    """Read and validate the ``[[webcam]]`` tables of a TOML file.

    Parameters
    ----------
    path
        A file of webcams, or a scene file, whose other tables are ignored here.

    Returns
    -------
    tuple of Webcam
        Webcams in the order of the file.

    Raises
    ------
    InputError
        The file is missing, or an entry is invalid; the message describes the first problem.
    """
    tables = {key: value for key, value in read_toml(path).items() if key == "webcam"}
    return tuple(validate(tables, WebcamFile, where=path).webcam)


def find_webcam(webcams: Sequence[Webcam], webcam_id: str) -> Webcam:
    """Find a webcam by its id.

    Parameters
    ----------
    webcams
        Known webcams.
    webcam_id
        Id to find.

    Returns
    -------
    Webcam
        The webcam.

    Raises
    ------
    InputError
        Unknown id; the message suggests the most similar one.
    """
    import difflib

    known = {webcam.id: webcam for webcam in webcams}
    if webcam_id in known:
        return known[webcam_id]
    similar = difflib.get_close_matches(webcam_id, known, n=1, cutoff=0.4)
    raise InputError(
        "--webcam",
        "no such webcam",
        got=webcam_id,
        cure=f"did you mean '{similar[0]}'?" if similar else f"known: {', '.join(sorted(known))}",
    )


def webcam_heading_deg(webcam: Webcam) -> float:
    """Compute the azimuth of the middle column from ``heading_deg`` or ``north_column_px``.

    Parameters
    ----------
    webcam
        The webcam.

    Returns
    -------
    float
        Azimuth in [0, 360) [deg].
    """
    if webcam.heading_deg is not None:
        return webcam.heading_deg % 360.0
    assert webcam.north_column_px is not None  # checked by the validator
    return (0.5 * webcam.width_px - webcam.north_column_px) * webcam.horizontal_fov_deg / webcam.width_px % 360.0


def webcam_model(webcam: Webcam, frame: LocalFrame, *, ground_m: float | None = None) -> Panorama | Camera:
    """Create the uncalibrated camera model of a webcam.

    Parameters
    ----------
    webcam
        The webcam.
    frame
        Local frame of the model.
    ground_m
        Height of the terrain at the webcam [m]; required if the webcam's height is given above ground.

    Returns
    -------
    Panorama or Camera
        The model; a perspective camera without its radial distortion (see `seasonscapes.cameras.lens`).

    Raises
    ------
    ValueError
        ``ground_m`` is required and missing.
    """
    height = webcam.height_m
    if height is None:
        if ground_m is None:
            raise ValueError(
                f"webcam {webcam.id}: height given as above_ground_m = {webcam.above_ground_m}; ground_m is needed"
            )
        assert webcam.above_ground_m is not None  # checked by the validator
        height = ground_m + webcam.above_ground_m
    perspective = webcam.projection == "perspective"
    pitch = webcam.tilt_deg + webcam.lens_tilt_deg if perspective else webcam.tilt_deg
    pose = np.eye(4)
    pose[:3, :3] = local_axes(frame, webcam.latitude_deg, webcam.longitude_deg).T @ rotation_from_angles(
        webcam_heading_deg(webcam), pitch, webcam.roll_deg
    )
    pose[:3, 3] = enu_from_geodetic(frame, webcam.latitude_deg, webcam.longitude_deg, height)
    width, rows = webcam.width_px, webcam.height_px
    if webcam.projection == "perspective":
        fx = 0.5 * width / np.tan(np.radians(webcam.horizontal_fov_deg) / 2.0)
        fov = webcam.vertical_fov_deg
        fy = fx if fov is None else 0.5 * rows / np.tan(np.radians(fov) / 2.0)
        cx, cy = webcam.principal_point_px or (0.5 * width, 0.5 * rows)
        return Camera(width, rows, fx, fy, cx, cy, pose, frame)
    assert webcam.vertical_fov_deg is not None  # checked by the validator
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
    """Result of the height check of one webcam.

    Parameters
    ----------
    webcam_id
        Id of the webcam.
    above_ground_m
        Height above the terrain [m]; NaN outside the terrain.
    plausible
        Whether the height is within the tolerances.
    verdict
        Description for human readers.
    """

    webcam_id: str
    above_ground_m: float
    plausible: bool
    verdict: str


def check_heights(
    webcams: Sequence[Webcam], ground_m: Sequence[float], *, mast_m: float = 60.0, terrain_error_m: float = 10.0
) -> list[HeightCheck]:
    """Compare the stated heights of webcams with the terrain.

    Parameters
    ----------
    webcams
        N webcams.
    ground_m
        Height of the terrain at each webcam, ``(N,)`` in the same vertical datum [m]; NaN outside the terrain.
    mast_m
        Largest plausible height above the terrain [m].
    terrain_error_m
        Largest plausible depth below the (smoothed) terrain [m].

    Returns
    -------
    list of HeightCheck
        One result per webcam.
    """
    checks = []
    for webcam, ground in zip(webcams, ground_m, strict=True):
        above = webcam.above_ground_m if webcam.height_m is None else webcam.height_m - float(ground)
        assert above is not None  # checked by the validator
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
    """Draw a north-up map of webcam positions and horizontal fields of view, with scale bar and ids.

    A sector shows each field of view (a full circle for 360° panoramas); a bold line shows the heading of the middle
    column.

    Parameters
    ----------
    webcams
        Webcams to draw.
    width_px
        Width of the map [px].
    reach_m
        Radius of the sectors [m].

    Returns
    -------
    numpy.ndarray
        Map ``(H, W, 3)`` uint8 sRGB.
    """
    import cv2

    middle = LocalFrame(
        float(np.mean([w.latitude_deg for w in webcams])), float(np.mean([w.longitude_deg for w in webcams]))
    )
    positions = np.array([enu_from_geodetic(middle, w.latitude_deg, w.longitude_deg, 0.0)[:2] for w in webcams])
    low, high = positions.min(0) - 2.0 * reach_m, positions.max(0) + 2.0 * reach_m
    scale = width_px / (high[0] - low[0])
    picture = np.full((int(np.ceil((high[1] - low[1]) * scale)), width_px, 3), 250, np.uint8)

    def pixel(point_m: Sequence[float] | np.ndarray) -> tuple[int, int]:
        return round((point_m[0] - low[0]) * scale), round((high[1] - point_m[1]) * scale)

    shade = picture.copy()
    for webcam, position in zip(webcams, positions, strict=True):
        heading, half = webcam_heading_deg(webcam), webcam.horizontal_fov_deg / 2.0
        angles = np.radians(np.linspace(heading - half, heading + half, 64))
        rim = position + reach_m * np.stack([np.sin(angles), np.cos(angles)], -1)
        outline = rim if half >= 180.0 else np.vstack([position, rim])
        cv2.fillPoly(shade, [np.array([pixel(p) for p in outline])], (150, 190, 235), cv2.LINE_AA)
    picture = cv2.addWeighted(shade, 0.5, picture, 0.5, 0.0)
    label_positions: list[tuple[int, int]] = []
    for webcam, position in zip(webcams, positions, strict=True):
        heading = np.radians(webcam_heading_deg(webcam))
        cv2.line(
            picture,
            pixel(position),
            pixel(position + reach_m * np.array([np.sin(heading), np.cos(heading)])),
            (30, 80, 170),
            2,
            cv2.LINE_AA,
        )
        cv2.circle(picture, pixel(position), 4, (190, 40, 30), -1, cv2.LINE_AA)
        x, y = pixel(position)
        while any(abs(x - other[0]) < 110 and abs(y - other[1]) < 13 for other in label_positions):
            y += 6
        label_positions.append((x, y))
        cv2.putText(picture, webcam.id, (x + 6, y - 6), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (20, 20, 20), 1, cv2.LINE_AA)
    bar = 5000.0 if high[0] - low[0] > 20000.0 else 1000.0
    left = (low[0] + 0.03 * (high[0] - low[0]), low[1] + 0.03 * (high[1] - low[1]))
    cv2.line(picture, pixel(left), pixel((left[0] + bar, left[1])), (20, 20, 20), 3)
    x, y = pixel(left)
    cv2.putText(
        picture, f"{bar / 1000:.0f} km", (x, y - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (20, 20, 20), 1, cv2.LINE_AA
    )
    return picture
