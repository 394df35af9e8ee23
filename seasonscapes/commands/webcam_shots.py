"""From what ``webcams`` and ``calibrate`` leave in folders to shots that can be painted; and the same for the embedded scene."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.calibration.calibration_file import CalibratedWebcam
    from seasonscapes.cameras.observation import ManifestRow, Observation
    from seasonscapes.cameras.panorama import Panorama
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.evaluation.synthetic_webcams import SyntheticPicture
    from seasonscapes.evaluation.webcam_faults import PoseSigmas
    from seasonscapes.frames import LocalFrame
    from seasonscapes.pipeline import Place
    from seasonscapes.sky.models import SkyModel
    from seasonscapes.texturing.inputs import PaintingInput

Progress = Callable[[float], None]


@dataclass(frozen=True)
class Sources:
    """Where pictures and poses lie.

    Parameters
    ----------
    manifest
        The ``.csv`` that ``seasonscapes webcams --manifest`` wrote.
    calibrations
        Folder of ``WEBCAM_calibration.json``, as ``seasonscapes calibrate`` writes them.
    masks
        Folder of ``WEBCAM.png``, black where something stands before the landscape; optional.
    """

    manifest: Path
    calibrations: Path
    masks: Path | None = None


def rows_at(sources: Sources, time: datetime, *, within_min: float, flag: str = "--time") -> list[ManifestRow]:
    """The picture of each webcam that is nearest to a time; `InputError` where there is none within so many minutes.

    ``flag`` is what the message calls the time.
    """
    from seasonscapes.cameras.observation import read_manifest

    nearest: dict[str, ManifestRow] = {}
    rows = read_manifest(sources.manifest)
    for row in sorted(rows, key=lambda row: (abs(row.time - time), row.path)):
        if abs(row.time - time) <= timedelta(minutes=within_min):
            nearest.setdefault(row.webcam, row)
    if not nearest:
        told = "the manifest is empty"
        if rows:
            closest = min(rows, key=lambda row: abs(row.time - time))
            told = f"the nearest is {closest.webcam} at {closest.time.isoformat()}"
        raise InputError(flag, f"no picture within {within_min:g} minutes", got=time.isoformat(), expected=told)
    return [nearest[name] for name in sorted(nearest)]


def calibrated_views(
    rows: Sequence[ManifestRow], sources: Sources, frame: LocalFrame, *, progress: Progress | None = None
) -> tuple[list[tuple[CalibratedWebcam, list[Observation]]], list[str]]:
    """The views of each picture, with its webcam's calibration; and the webcams that have none yet.

    `InputError` where no webcam has one.
    """
    from seasonscapes.calibration.calibration_file import read_calibration

    opened, without = [], []
    for number, row in enumerate(rows):
        record = sources.calibrations / f"{row.webcam}_calibration.json"
        if record.is_file():
            pose = read_calibration(record)
            opened.append((pose, observations_of(row, sources, pose, frame)))
        elif row.webcam not in without:
            without.append(row.webcam)
        if progress is not None:
            progress((number + 1) / len(rows))
    if not opened:
        raise InputError(
            sources.calibrations,
            "holds no calibration of a webcam with a picture at that time",
            got=", ".join(without),
            cure="seasonscapes calibrate SCENE --webcam ... -o FOLDER",
        )
    return opened, without


def shots_of(
    place: Place, rows: Sequence[ManifestRow], sources: Sources, model: SkyModel, *, progress: Progress | None = None
) -> tuple[list[PaintingInput], list[str]]:
    """A shot for each perspective picture, several for each panorama; and the webcams that have no calibration yet."""
    from seasonscapes.daylight import light_for
    from seasonscapes.texturing.inputs import PaintingInput

    opened, without = calibrated_views(rows, sources, place.frame, progress=progress)
    shots = []
    for pose, views in opened:
        # The views of a panorama share a place, and so the air.
        air = light_for(place, views[0].camera, model, views[0].time)[0].aerial_perspective
        shots += [PaintingInput(view, air, pose.sigma) for view in views]
    return shots, without


def observations_of(row: ManifestRow, sources: Sources, pose: CalibratedWebcam, frame: LocalFrame) -> list[Observation]:
    """A picture as pinhole observations in a scene's frame: rectified, or cut out of its panorama."""
    from seasonscapes.cameras.lens import rectify
    from seasonscapes.cameras.observation import Observation, open_observation
    from seasonscapes.cameras.panorama import Panorama, cut_view, split_panorama

    folder = sources.manifest.parent
    view = replace(pose.view, world_from_camera=pose_in_frame(pose.view.world_from_camera, pose.frame, frame))
    picture = open_observation(row, folder, view)
    mask = _mask(sources, row.webcam, picture.mask.shape)
    if not isinstance(view, Panorama):
        if not pose.k1:
            return [replace(picture, mask=mask)]
        image, inside = rectify(picture.image, view, pose.k1)
        kept = rectify(np.repeat(mask[..., None], 3, axis=2).astype(np.float32), view, pose.k1)[0][..., 0] > 0.99
        return [Observation(image.astype(np.float32), inside & kept, view, row.time, row.webcam)]
    views = []
    for number, camera in enumerate(split_panorama(view)):
        image, inside = cut_view(picture.image, view, camera)
        kept = cut_view(np.repeat(mask[..., None], 3, axis=2).astype(np.float32), view, camera)[0][..., 0] > 0.99
        views.append(Observation(image, inside & kept, camera, row.time, f"{row.webcam}/{number}"))
    return views


def _mask(sources: Sources, webcam: str, shape: tuple[int, int]) -> np.ndarray:
    from seasonscapes.images import read_image_linear

    path = None if sources.masks is None else sources.masks / f"{webcam}.png"
    if path is None or not path.is_file():
        return np.ones(shape, bool)
    try:
        mask = read_image_linear(path).max(axis=2) > 0.5
    except ValueError:
        raise InputError(path, "not a readable picture") from None
    if mask.shape != shape:
        raise InputError(
            path,
            "the mask has another size than its webcam's pictures",
            got=f"{mask.shape[1]} x {mask.shape[0]}",
            expected=f"{shape[1]} x {shape[0]}",
        )
    return mask


def pose_in_frame(world_from_camera: np.ndarray, own: LocalFrame, other: LocalFrame) -> np.ndarray:
    """A pose ``(4, 4)`` of one local frame in another one: the same place, the same angles to its own horizon."""
    from seasonscapes.frames import enu_from_geodetic, geodetic_from_enu, local_axes

    latitude, longitude, height = (float(v) for v in geodetic_from_enu(own, world_from_camera[:3, 3]))
    pose = np.eye(4)
    turn = local_axes(other, latitude, longitude).T @ local_axes(own, latitude, longitude)
    pose[:3, :3] = turn @ world_from_camera[:3, :3]
    pose[:3, 3] = enu_from_geodetic(other, latitude, longitude, height)
    return pose


def make_webcams(
    place: Place,
    time: datetime,
    model: SkyModel,
    folder: Path,
    *,
    cameras: Mapping[str, Camera | Panorama],
    seed: int = 0,
    progress: Progress | None = None,
) -> Sources:
    """Photograph a synthetic place as webcams would, into files as real ones leave them. Finished pictures are kept.

    Poses are off by what a good calibration leaves (0.01° and 0.5 m), and the records say so.
    """
    return make_webcam_series(place, [time], model, folder, cameras=cameras, seed=seed, progress=progress)


def make_webcam_series(
    place: Place,
    times: Sequence[datetime],
    model: SkyModel,
    folder: Path,
    *,
    cameras: Mapping[str, Camera | Panorama],
    seed: int = 0,
    progress: Progress | None = None,
) -> Sources:
    """`make_webcams` at several times; each webcam's light transport is traced once for all of them.

    Pictures of a single time bear the webcam's name alone, those of several its name and time.
    """
    from seasonscapes.cameras.observation import ManifestRow, write_manifest
    from seasonscapes.evaluation.webcam_faults import PoseSigmas
    from seasonscapes.images import write_png8
    from seasonscapes.relighting.frame_file import time_stamp

    def names(webcam: str) -> list[str]:
        return [f"{webcam}.png" if len(times) == 1 else f"{webcam}_{time_stamp(time)}.png" for time in times]

    def record(webcam: str) -> Path:
        return folder / f"{webcam}_calibration.json"

    left = {
        webcam: camera
        for webcam, camera in cameras.items()
        if not all(path.is_file() for path in (record(webcam), *(folder / name for name in names(webcam))))
    }
    sigmas = PoseSigmas(0.5, 0.5, 0.01, 0.01, 0.01)
    for webcam, made in photographs(place, times, model, left, poses=sigmas, seed=seed, progress=progress):
        for name, picture in zip(names(webcam), made, strict=True):
            write_png8(folder / name, picture.encoded)
        _write_pose(record(webcam), webcam, made[0].observation.camera, sigmas, place.frame)
    rows = [
        ManifestRow(webcam, time, name) for webcam in cameras for time, name in zip(times, names(webcam), strict=True)
    ]
    write_manifest(folder / "manifest.csv", rows)
    return Sources(folder / "manifest.csv", folder)


def photographs(
    place: Place,
    times: Sequence[datetime],
    model: SkyModel,
    cameras: Mapping[str, Camera | Panorama],
    *,
    poses: PoseSigmas | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Iterator[tuple[str, list[SyntheticPicture]]]:
    """Each webcam of a synthetic place and its pictures, in the land's colours of each day; see `webcam_series`."""
    from seasonscapes.daylight import light_for
    from seasonscapes.evaluation.synthetic_webcams import WebcamInstant, webcam_series
    from seasonscapes.pipeline import albedo_for

    tell = progress or (lambda share: None)
    albedos: dict[int, np.ndarray] = {}
    for number, (name, camera) in enumerate(cameras.items()):
        hours = []
        for time in times:
            day = time.timetuple().tm_yday
            if day not in albedos:
                albedos[day] = albedo_for(place, time).values
            hours.append(WebcamInstant(time, light_for(place, camera, model, time)[0], albedos[day]))
        try:
            made = webcam_series(
                place.terrain,
                name,
                camera,
                hours,
                poses=poses,
                seed=seed,
                progress=lambda share, n=number: tell((n + share) / len(cameras)),
            )
        except ValueError as error:
            if "sees no terrain" not in str(error):
                raise
            raise InputError(f"camera '{name}'", "sees no terrain", cure=f"--leave-out {name}") from None
        yield name, made


def _write_pose(path: Path, name: str, camera: Camera | Panorama, sigmas, frame: LocalFrame) -> None:
    from seasonscapes.calibration.calibration_file import write_calibration
    from seasonscapes.calibration.pose_model import values_of
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
        values_of(camera, np.eye(3)),
        np.diag(np.square(deviations)),
        (),
        np.zeros((0, 2)),
        np.zeros(0, bool),
        0.0,
    )
    write_calibration(path, name, solved, frame)
