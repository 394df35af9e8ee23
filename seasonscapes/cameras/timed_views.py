"""Folders of pictures with poses and times: a ``transforms.json``, or a COLMAP model beside its pictures.

Neither format says where on Earth it lies. A ``transforms.json`` of ours states the origin of its local frame under ``world``;
beside a COLMAP model, ``georeference.json`` does:

.. code-block:: json

    {"world": {"origin": {"latitude_deg": 46.5, "longitude_deg": 8.0, "height_m": 2000.0}},
     "times": {"a.jpg": "2024-09-01T10:00Z"}}

Poses are in metres east, north and up of that origin. Without ``times``, the names of COLMAP's pictures state them.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC
from pathlib import Path, PurePosixPath

import numpy as np

from seasonscapes import text_files
from seasonscapes.cameras.camera_models import CameraModel, read_camera_models
from seasonscapes.cameras.exchange import NamedView, parse_stamp, read_json, read_transforms
from seasonscapes.cameras.picture_names import times_of_names
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.cameras.webcam import Webcam
from seasonscapes.errors import InputError
from seasonscapes.frames import LocalFrame, frame_record
from seasonscapes.images import atomic_path

GEOREFERENCE = "georeference.json"
_MODELS = (".", "sparse/0", "sparse")
_ORIGIN = '"world": {"origin": {"latitude_deg": …, "longitude_deg": …, "height_m": …}}'


def write_georeference(path: Path, views: Sequence[NamedView], frame: LocalFrame, *, image_folder: str = "") -> None:
    """Write what a COLMAP model of `seasonscapes.cameras.exchange.write_colmap` cannot state: origin and times.

    Parameters
    ----------
    path
        ``georeference.json`` in the model's folder.
    views
        The model's views.
    frame
        Local frame of their poses.
    image_folder
        As the model was written with.
    """
    times = {
        PurePosixPath(view.file or view.name).relative_to(image_folder).as_posix(): view.time.astimezone(
            UTC
        ).isoformat()
        for view in views
        if view.time is not None
    }
    with atomic_path(path) as temporary:
        temporary.write_text(
            json.dumps({"world": frame_record(frame), "times": times}, indent=1) + "\n", encoding="utf-8"
        )


def read_timed_views(folder: Path, *, webcams: Sequence[Webcam] = (), time_zone: str = "UTC") -> list[NamedView]:
    """Read views with pictures and times.

    Parameters
    ----------
    folder
        With ``transforms.json`` (ours, nerfstudio's or instant-ngp's); or, where there is none, a COLMAP model (text or
        binary) in it or its ``sparse/0``, and pictures in its ``images``, or in it where there is no ``images``.
    webcams
        Known webcams; see `seasonscapes.cameras.picture_names.times_of_names`.
    time_zone
        IANA name of the zone of names without ``Z`` of other pictures.

    Returns
    -------
    list of NamedView
        Each with a local frame, a time, and its file relative to the folder.

    Raises
    ------
    InputError
        Where the folder holds neither, no origin on Earth is stated, a view has a distorting lens, no time or no picture,
        or a picture lies outside the folder.
    """
    file = folder / "transforms.json"
    if file.is_file():
        views, frame = read_transforms(file)
        if frame is None:
            raise InputError(file, "states no origin on Earth", expected=_ORIGIN)
    else:
        model = next((folder / name for name in _MODELS if _is_model(folder / name)), None)
        if model is None:
            raise InputError("--frames", "holds neither transforms.json nor a COLMAP model", got=str(folder))
        file, views = model, _colmap_views(folder, model, webcams, time_zone)
    for view in views:
        if view.time is None:
            cure = (
                "state time_utc of each frame"
                if file.name == "transforms.json"
                else f"name them, or add times to {GEOREFERENCE}"
            )
            raise InputError(file, "states no time of a picture", got=view.file, cure=cure)
        try:
            inside = (folder / view.file).resolve().is_relative_to(folder.resolve())
            is_file = (folder / view.file).is_file()
        except (ValueError, OSError) as error:  # a zero byte, or too long
            raise InputError(file, f"not a name of a picture: {error}", got=view.file) from None
        if not inside:
            raise InputError(file, "names a picture outside its folder", got=view.file)
        if not is_file:
            raise InputError(file, "no such picture", got=view.file)
    if not views:
        raise InputError(file, "names no frame")
    return views


def _is_model(folder: Path) -> bool:
    return any((folder / f"images.{kind}").is_file() for kind in ("txt", "bin"))


def _colmap_views(folder: Path, model: Path, webcams: Sequence[Webcam], time_zone: str) -> list[NamedView]:
    """Views of a COLMAP model with what ``georeference.json`` in its folder, or in the pictures', says of them."""
    file = next((place / GEOREFERENCE for place in (model, folder) if (place / GEOREFERENCE).is_file()), None)
    if file is None:
        cure = f"write {GEOREFERENCE} beside it with {_ORIGIN}"
        raise InputError(model, "a COLMAP model states no origin on Earth", cure=cure)
    table = read_json(file)
    try:
        frame = LocalFrame(**table["world"]["origin"])
        stated = None if table.get("times") is None else dict(table["times"])
    except text_files.MALFORMED as error:
        raise InputError(file, f"not an origin and times: {error!r}", expected=_ORIGIN) from None
    models = read_camera_models(model, "colmap")
    if stated is None:
        times = times_of_names([each.name for each in models], webcams, time_zone)
    else:
        times = {name: parse_stamp(stamp, f"{file}: {name}") for name, stamp in stated.items()}
    inside = "images/" if (folder / "images").is_dir() else ""
    return [
        NamedView(each.name, _camera(each, frame, model), inside + each.name, times.get(each.name)) for each in models
    ]


def _camera(model: CameraModel, frame: LocalFrame, where: Path) -> Camera:
    """The pinhole camera of a COLMAP view."""
    if not model.lens.is_ideal:
        cure = "undistort the images first (colmap image_undistorter)"
        raise InputError(where, "its lens has distortion", got=model.name, cure=cure)
    assert model.size_px is not None, "COLMAP states it"
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = model.rotation, model.position
    try:
        return Camera(*model.size_px, model.fx, model.fy, model.cx, model.cy, pose, frame)
    except ValueError as error:
        raise InputError(where, f"not a view: {error}", got=model.name) from None
