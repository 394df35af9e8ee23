"""Calibration records: read and write the pose, field of view and uncertainty of a webcam as JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from seasonscapes.calibration.evidence import PARAMETERS
from seasonscapes.calibration.pose_model import View
from seasonscapes.calibration.resection import Calibration
from seasonscapes.cameras.exchange import read_json
from seasonscapes.cameras.panorama import PROJECTIONS, Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.declaration import checked_name
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
    k1
        Radial distortion coefficient.
    sigma
        Standard deviation of each parameter, by the names `PARAMETERS`; 0 where it was fixed.
    frame
        Local frame of the pose.
    """

    webcam: str
    view: View
    k1: float
    sigma: dict[str, float]
    frame: LocalFrame


def write_calibration(path: Path, webcam: str, calibration: Calibration, frame: LocalFrame) -> None:
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
        "k1": calibration.k1,
        "world_from_camera": view.world_from_camera.tolist(),
        "latitude_deg": latitude,
        "longitude_deg": longitude,
        "height_m": height,
        "angles_deg": dict(zip(("heading", "tilt", "roll"), calibration.parameters[:3].tolist(), strict=True)),
        "sigma": calibration.sigma,
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
        View, distortion, standard deviations and frame.

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
        return CalibratedWebcam(checked_name(str(record["webcam"])), view, float(record["k1"]), sigma, frame)
    except MALFORMED as error:
        raise InputError(path, f"not a calibration record: {error!r}") from None
