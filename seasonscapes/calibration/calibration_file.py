"""Calibration records: read and write the pose, field of view and uncertainty of a webcam as JSON."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from seasonscapes.calibration.evidence import PARAMETERS
from seasonscapes.calibration.pose_model import View
from seasonscapes.calibration.resection import Calibration
from seasonscapes.cameras.exchange import read_json
from seasonscapes.cameras.lens import Lens
from seasonscapes.cameras.panorama import PROJECTIONS, Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.declaration import checked_name, checked_text
from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame, geodetic_from_enu
from seasonscapes.images import atomic_path
from seasonscapes.text_files import MALFORMED


@dataclass(frozen=True)
class CalibratedWebcam:
    """Contents of a calibration record.

    Parameters
    ----------
    webcam
        Id of the webcam.
    view
        Camera or panorama with its pose in ``frame``.
    lens
        Distortion of the pictures.
    sigma
        Standard deviation of each parameter, by the names `PARAMETERS`; 0 where it was fixed.
    frame
        Local frame of the pose.
    doubts
        Why the pose is not reliable; empty where it is.
    """

    webcam: str
    view: View
    lens: Lens
    sigma: dict[str, float]
    frame: LocalFrame
    doubts: tuple[str, ...] = ()


def record_name(webcam: str, time: datetime | None = None) -> str:
    """The file name of a webcam's record, or of that of its picture of one time."""
    stamp = "" if time is None else f"_{time.astimezone(UTC):%Y%m%dT%H%M%SZ}"
    return f"{webcam}{stamp}_calibration.json"


def write_calibration(
    path: Path,
    webcam: str,
    calibration: Calibration,
    frame: LocalFrame,
    *,
    doubts: Sequence[str] = (),
    time: datetime | None = None,
) -> None:
    """Write a calibration record; the file appears atomically.

    Parameters
    ----------
    path
        JSON file to write.
    webcam
        Id of the webcam.
    calibration
        Result of a resection.
    frame
        Local frame of the pose. The record holds the position in WGS 84 as well.
    doubts
        Why the pose is not reliable; a record with doubts is refused by what uses poses.
    time
        Of the picture that the pose belongs to, aware; ``None`` for all pictures of the webcam.
    """
    view = calibration.view
    latitude, longitude, height = (float(v) for v in geodetic_from_enu(frame, view.position_m))
    record = {
        "webcam": webcam,
        "projection": view.projection if isinstance(view, Panorama) else "perspective",
        "size_px": [view.width_px, view.height_px],
        "fx": view.fx,
        "fy": view.fy,
        "cx": view.cx,
        "cy": view.cy,
        "k1": calibration.distortion.k1,
        "distortion": asdict(calibration.distortion),
        "world_from_camera": view.world_from_camera.tolist(),
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "height_m": height,
        "angles_deg": dict(zip(("heading", "tilt", "roll"), calibration.parameters[:3].tolist(), strict=True)),
        "sigma": calibration.sigma,
        "covariance": calibration.covariance.tolist(),
        "reliable": not doubts,
        "doubts": list(doubts),
        "picture_time_utc": None if time is None else time.astimezone(UTC).isoformat(),
        "frame": {
            "latitude_deg": frame.latitude_deg,
            "longitude_deg": frame.longitude_deg,
            "height_m": frame.height_m,
            "refraction_k": frame.refraction_k,
        },
        "points": [
            {"name": name, "residual_px": error.tolist(), "set_aside": bool(is_outlier)}
            for name, error, is_outlier in zip(
                calibration.names, calibration.residual_px, calibration.outlier, strict=True
            )
        ],
    }
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


def read_calibration(path: Path) -> CalibratedWebcam:
    """Read a calibration record.

    Parameters
    ----------
    path
        JSON file written by `write_calibration`.

    Returns
    -------
    CalibratedWebcam
        View, distortion, standard deviations, frame and doubts.

    Raises
    ------
    InputError
        If the file is missing or is no calibration record.
    """
    record = read_json(path)
    try:
        fx, fy, cx, cy = (float(record[key]) for key in ("fx", "fy", "cx", "cy"))
        pose = np.array(record["world_from_camera"], float)
        width, height = (int(v) for v in record["size_px"])
        projection = record["projection"]
        sigma = {name: float(record["sigma"][name]) for name in PARAMETERS}
        frame = LocalFrame(**record["frame"])
        if projection == "perspective":
            view: View = Camera(width, height, fx, fy, cx, cy, pose, frame)
        elif projection in PROJECTIONS:
            view = Panorama(projection, width, height, fx, fy, cx, cy, pose, frame)
        else:
            raise ValueError(f"projection {projection!r}")
        lens = Lens(**record["distortion"]) if "distortion" in record else Lens(k1=float(record["k1"]))
        doubts = tuple(checked_text(str(doubt)) for doubt in record.get("doubts", []))
        return CalibratedWebcam(checked_name(str(record["webcam"])), view, lens, sigma, frame, doubts)
    except MALFORMED as error:
        raise InputError(path, f"not a calibration record: {error!r}") from None
