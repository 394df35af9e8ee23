"""Photographs of a synthetic place, rendered with full transport and degraded as webcams degrade theirs."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.errors import InputError, NoTerrainInView
from seasonscapes.images import atomic_path
from seasonscapes.progress import Progress, task_progress
from seasonscapes.sky.models import SkyModel
from seasonscapes.text_files import read_json
from seasonscapes.workflows.albedo_sources import scene_albedo
from seasonscapes.workflows.illumination import illumination_for_camera, sky_model
from seasonscapes.workflows.photograph_files import PhotographSources
from seasonscapes.workflows.place import Place, utc_at
from seasonscapes.workflows.views import scene_cameras
from seasonscapes.workspace import artefact_key, file_hash

if TYPE_CHECKING:
    from seasonscapes.cameras.observation import Observation
    from seasonscapes.cameras.panorama import Panorama
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.evaluation.synthetic_webcams import SyntheticPicture
    from seasonscapes.evaluation.webcam_faults import PoseSigmas
    from seasonscapes.frames import LocalFrame
    from seasonscapes.sky.illumination import Illumination

log = logging.getLogger(__name__)

_SIZE_PX = (720, 480)
_SUMS = "checksums.json"
PHOTOGRAPHS_CODE = ("workflows.synthetic_photographs",)


def synthetic_photographs(
    place: Place,
    times: Sequence[str | datetime],
    folder: str | Path,
    *,
    sky: str | Path | SkyModel = "clear",
    cameras: Mapping[str, Camera | Panorama] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> PhotographSources:
    """Photograph a synthetic place from its cameras, into files as real webcams leave them.

    Photographs have 8 bits, JPEG artefacts, unknown exposure and white balance. Poses are off by what a good
    calibration leaves (0.01° and 0.5 m), and the records state it. Files that exist already are kept.

    Parameters
    ----------
    place
        A synthetic place.
    times
        Aware datetimes, or ISO 8601 text; without offset it is civil time at the place.
    folder
        For the photographs, ``manifest.csv`` and calibration records.
    sky
        A sky model, its name or its file.
    cameras
        Webcams by name; default: all cameras of the scene file, 720 × 480 px.
    seed
        Equal seeds give equal photographs.
    progress
        Called with a task and its finished share.

    Returns
    -------
    PhotographSources
        Paths of the manifest and the calibration records, for `open_photographs`.

    Raises
    ------
    InputError
        Where the place is a real one, or a camera sees no terrain.

    Examples
    --------
    >>> import tempfile
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> camera = ss.camera(place, "aerial", size_px=(48, 32))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     sources = ss.synthetic_photographs(place, ["2024-07-20T13:30"], folder, cameras={"aerial": camera})
    ...     sources.manifest.name, sources.calibration_of("aerial").is_file()
    ('manifest.csv', True)
    """
    require_synthetic(place)
    chosen = scene_cameras(place, size_px=_SIZE_PX) if cameras is None else cameras
    utc = [utc_at(place, time) for time in times]
    return photograph_series(place, utc, sky_model(sky), Path(folder), cameras=chosen, seed=seed, progress=progress)


def require_synthetic(place: Place) -> None:
    """`InputError` where a place is a real one."""
    if place.synthetic is None:
        cure = "give its pictures with --manifest"
        raise InputError("--synthetic-webcams", f"the scene '{place.scene.name}' is a real place", cure=cure)


def photograph_series(
    place: Place,
    times: Sequence[datetime],
    model: SkyModel,
    folder: Path,
    *,
    cameras: Mapping[str, Camera | Panorama],
    seed: int = 0,
    progress: Progress | None = None,
) -> PhotographSources:
    """`synthetic_photographs` of given cameras at UTC times; the light transport of each camera is traced once.

    Photographs of a single time are named by the webcam alone, those of several by webcam and time.
    """
    from seasonscapes.cameras.observation import ManifestRow, write_manifest
    from seasonscapes.evaluation.webcam_faults import PoseSigmas
    from seasonscapes.images import write_png8
    from seasonscapes.relighting.frame_file import time_stamp

    sources = PhotographSources(folder / "manifest.csv", folder)

    def names(webcam: str) -> list[str]:
        return [f"{webcam}.png" if len(times) == 1 else f"{webcam}_{time_stamp(time)}.png" for time in times]

    missing = {
        webcam: camera
        for webcam, camera in cameras.items()
        if not all(path.is_file() for path in (sources.calibration_of(webcam), *(folder / n for n in names(webcam))))
    }
    sigmas = PoseSigmas(0.5, 0.5, 0.01, 0.01, 0.01)
    for webcam, pictures in photograph_each(place, times, model, missing, poses=sigmas, seed=seed, progress=progress):
        for name, picture in zip(names(webcam), pictures, strict=True):
            write_png8(folder / name, picture.encoded)
        write_pose(sources.calibration_of(webcam), webcam, pictures[0].observation.camera, sigmas, place.frame)
    rows = [ManifestRow(cam, time, name) for cam in cameras for time, name in zip(times, names(cam), strict=True)]
    write_manifest(sources.manifest, rows)
    return sources


def photograph_each(
    place: Place,
    times: Sequence[datetime],
    model: SkyModel,
    cameras: Mapping[str, Camera | Panorama],
    *,
    poses: PoseSigmas | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Iterator[tuple[str, list[SyntheticPicture]]]:
    """Each webcam of a synthetic place and its pictures, with the albedo of each day; see `webcam_series`.

    Raises
    ------
    InputError
        Where a camera sees no terrain.
    """
    from seasonscapes.evaluation.synthetic_webcams import WebcamInstant, WebcamOptions, webcam_series

    albedos: dict[int, np.ndarray] = {}
    lights: dict[datetime, Illumination] = {}
    options = WebcamOptions(poses=poses)
    task = f"photographing from {len(cameras)} webcams"
    for number, (name, camera) in enumerate(cameras.items()):
        instants = []
        for time in times:
            day = time.timetuple().tm_yday
            if day not in albedos:
                albedos[day] = scene_albedo(place, time).values
            light = illumination_for_camera(place, camera, model, time, of_another_camera=lights.get(time))[0]
            # What it has of its camera alone takes ten times as much memory, and is not shared.
            lights.setdefault(time, replace(light, aerial_perspective=None, visible_sky=None))
            instants.append(WebcamInstant(time, light, albedos[day]))
        report = task_progress(progress, task, start=number / len(cameras), end=(number + 1) / len(cameras))
        try:
            pictures = webcam_series(place.terrain, name, camera, instants, options=options, seed=seed, progress=report)
        except NoTerrainInView:
            raise InputError(f"camera '{name}'", "sees no terrain", cure=f"--leave-out {name}") from None
        yield name, pictures


def write_pose(path: Path, name: str, camera: Camera | Panorama, sigmas: PoseSigmas, frame: LocalFrame) -> None:
    """Write a synthetic webcam's pose as a calibration record with the stated standard deviations."""
    from seasonscapes.calibration.calibration_file import write_calibration
    from seasonscapes.calibration.pose_model import parameters_of_view
    from seasonscapes.calibration.resection import Calibration

    deviations = [
        sigmas.heading_deg,
        sigmas.pitch_deg,
        sigmas.roll_deg,
        sigmas.horizontal_m,
        sigmas.horizontal_m,
        sigmas.vertical_m,
        sigmas.log_focal,
        0.0,
        0.0,
    ]
    solved = Calibration(
        camera,
        0.0,
        parameters_of_view(camera, np.eye(3)),
        np.diag(np.square(deviations)),
        (),
        np.zeros((0, 2)),
        np.zeros(0, bool),
        0.0,
    )
    write_calibration(path, name, solved, frame)


def photographed_in_workspace(
    place: Place,
    utc: datetime,
    model: SkyModel,
    *,
    leave_out: set[str] | None = None,
    size_px: tuple[int, int] = (720, 480),
    progress: Progress | None = None,
) -> PhotographSources:
    """Photographs of a synthetic place at one time, kept in its workspace; see `synthetic_photographs`."""
    require_synthetic(place)
    cameras = scene_cameras(place, leave_out=leave_out, size_px=size_px)
    inputs = {"place": place.key, "time": utc, "sky": model, "size": size_px}
    key = artefact_key(inputs, PHOTOGRAPHS_CODE)
    folder = place.workspace.folder / place.scene.name / f"webcams-{key}"
    _remove_changed(folder)
    sources = photograph_series(place, [utc], model, folder, cameras=cameras, progress=progress)
    files = sorted(path for path in folder.iterdir() if path.suffix in (".png", ".json", ".csv") and path.name != _SUMS)
    with atomic_path(folder / _SUMS) as temporary:
        temporary.write_text(json.dumps({path.name: file_hash(path) for path in files}, indent=1), encoding="utf-8")
    return sources


def _remove_changed(folder: Path) -> None:
    """Remove photographs and records of the workspace that are not what was written, which is told."""
    if not (folder / _SUMS).is_file():
        return
    try:
        sums = read_json(folder / _SUMS)
    except InputError:
        sums = None
    for path in sorted(path for path in folder.iterdir() if path.is_file() and path.name != _SUMS):
        known = sums.get(path.name) if isinstance(sums, dict) else "unknown"
        # What is not listed was written after the list, by a process that was killed before it wrote another.
        if known is not None and file_hash(path) != known:
            log.info("%s: its content is not what was written; it is made again", path)
            path.unlink()


def synthetic_observations(
    place: Place,
    times: Sequence[datetime],
    model: SkyModel,
    *,
    size_px: tuple[int, int],
    progress: Progress | None = None,
) -> list[Observation]:
    """Photographs of a synthetic place by all its cameras, as observations with the true poses."""
    require_synthetic(place)
    cameras = scene_cameras(place, size_px=size_px)
    each = photograph_each(place, times, model, cameras, progress=progress)
    return [picture.observation for _, pictures in each for picture in pictures]
