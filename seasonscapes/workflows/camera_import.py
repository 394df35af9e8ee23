"""Cameras that other programs calibrated, placed into the local frame of a webcam's station."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.cameras.camera_models import CameraModel, ModelFormat, read_camera_model
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame, enu_from_geodetic, local_axes

if TYPE_CHECKING:
    from seasonscapes.workflows.webcam_calibration import WebcamStation

log = logging.getLogger(__name__)

# Pictures that differ more in shape than this were cut, and not only resized.
_SHAPE_TOLERANCE = 0.01


@dataclass(frozen=True)
class ModelSource:
    """A file of a camera model and what it does not say about itself.

    Parameters
    ----------
    path
        The file, or COLMAP's folder.
    kind
        Its format; ``None`` recognises it.
    view
        Name of a view in files of several.
    crs
        Coordinates of its position, such as ``"EPSG:32606"``; ``None`` where it states WGS 84, or no pose.
    ellipsoidal
        Whether its height is above the WGS 84 ellipsoid; else it is in the scene's vertical datum.
    """

    path: Path
    kind: ModelFormat | None = None
    view: str | None = None
    crs: str | None = None
    ellipsoidal: bool = False


def station_of_model(station: WebcamStation, source: ModelSource) -> WebcamStation:
    """Return a station with the camera of a model instead of the one that the scene file states.

    Parameters
    ----------
    station
        A webcam at its stated position.
    source
        The model. Without a pose it gives focal lengths, principal point and distortion alone.

    Raises
    ------
    InputError
        The model cannot be read, has another shape than the webcam's pictures, or states a position in unnamed coordinates.
    """
    view = station.view
    if not isinstance(view, Camera):
        raise InputError(source.path, f"webcam {station.webcam.id} is a panorama", expected="a perspective webcam")
    model = read_camera_model(source.path, source.kind, view=source.view)
    size = (view.width_px, view.height_px)
    model = _resized(model, size, source.path)
    pose, known = view.world_from_camera.copy(), False
    axes = station.axes
    if model.position is not None:
        pose, axes = _placed(model, source, station)
        known = True
    camera = Camera(*size, model.fx, model.fy, model.cx, model.cy, pose, station.frame)
    return replace(station, view=camera, axes=axes, lens=model.lens, pose_is_known=known)


def _resized(model: CameraModel, size: tuple[int, int], path: Path) -> CameraModel:
    """The model for pictures of a size, which may be a resized version of the model's own."""
    if model.size_px is None or model.size_px == size:
        return model
    across, along = size[0] / model.size_px[0], size[1] / model.size_px[1]
    if abs(across / along - 1.0) > _SHAPE_TOLERANCE:
        got, expected = "{} x {} px".format(*model.size_px), "{} x {} px, or in proportion".format(*size)
        raise InputError(
            path, "the model is of pictures of another shape than the webcam's", got=got, expected=expected
        )
    log.warning("%s: the model of %d x %d px is scaled to pictures of %d x %d px", path, *model.size_px, *size)
    scaled = {"fx": model.fx * across, "cx": model.cx * across, "fy": model.fy * along, "cy": model.cy * along}
    return replace(model, size_px=size, **scaled)


def _placed(model: CameraModel, source: ModelSource, station: WebcamStation) -> tuple[np.ndarray, np.ndarray]:
    """Pose ``(4, 4)`` in the station's frame, and east, north and up there as rows ``(3, 3)``."""
    from seasonscapes.terrain.geoid import geoid_of

    assert model.position is not None
    x, y, height = (float(value) for value in model.position)
    if model.geographic:
        longitude, latitude = x, y
    else:
        if source.crs is None:
            cure = "name them with --model-crs, such as EPSG:32633"
            raise InputError(source.path, "states a position in coordinates of a map", got=f"{x:g}, {y:g}", cure=cure)
        latitude, longitude = _geodetic(source.crs, x, y, source.path)
    if source.ellipsoidal and station.vertical_datum != "ellipsoidal":
        geoid = geoid_of(station.vertical_datum, latitude, longitude)
        undulation = float(geoid.undulation_m(np.array(latitude), np.array(longitude)))
        log.warning(
            "%s: ellipsoid height %.1f m is %.1f m in the scene's datum (%s)",
            source.path,
            height,
            height - undulation,
            geoid.source,
        )
        height -= undulation
    frame = station.frame
    axes = local_axes(frame, latitude, longitude)
    pose = np.eye(4)
    pose[:3, 3] = enu_from_geodetic(frame, latitude, longitude, height)
    if model.rotation is None:
        pose[:3, :3] = station.view.world_from_camera[:3, :3]
        return pose, axes
    from_map = axes.T if model.geographic else map_axes(str(source.crs), (x, y, height), frame, axes)
    pose[:3, :3] = from_map @ model.rotation
    return pose, axes


def _geodetic(crs: str, x: float, y: float, path: Path) -> tuple[float, float]:
    from seasonscapes.terrain.crs import geodetic_from_map

    latitude, longitude = (float(value) for value in geodetic_from_map(crs, x, y))
    if not np.isfinite([latitude, longitude]).all():
        raise InputError(path, f"its position lies outside {crs}", got=f"{x:g}, {y:g}")
    return latitude, longitude


def map_axes(crs: str, position: tuple[float, float, float], frame: LocalFrame, axes: np.ndarray) -> np.ndarray:
    """Rotation ``(3, 3)`` from a map's axes (grid east, grid north, up) to the frame: grid north is not true north."""
    from seasonscapes.terrain.crs import geodetic_from_map, horizontal_crs

    x, y, height = position
    step = 50.0 / (111_195.0 if horizontal_crs(crs).is_geographic else 1.0)
    latitude, longitude = geodetic_from_map(crs, [x, x], [y - step, y + step])
    south, north = enu_from_geodetic(
        LocalFrame(frame.latitude_deg, frame.longitude_deg, frame.height_m), latitude, longitude, height
    )
    up = axes[2]
    grid_north = (north - south) - up * ((north - south) @ up)
    grid_north /= np.linalg.norm(grid_north)
    return np.stack([np.cross(grid_north, up), grid_north, up], axis=1)
