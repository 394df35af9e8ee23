"""Calibrated photographs of a place: chosen by time from a manifest, opened with their poses, masked and rectified."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.calibration.ground_clearance import LEAST_ABOVE_GROUND_M, clear_of_ground
from seasonscapes.cameras.pinhole import view_in_frame
from seasonscapes.errors import InputError, UnreadableImage
from seasonscapes.progress import Progress, each_reported
from seasonscapes.terrain.raster_files import real_path
from seasonscapes.workflows.camera_ground import GroundBelow, ground_below
from seasonscapes.workflows.place import Place, utc_at

if TYPE_CHECKING:
    from seasonscapes.calibration.calibration_file import CalibratedWebcam
    from seasonscapes.cameras.observation import ManifestRow, Observation
    from seasonscapes.frames import LocalFrame

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class PhotographSources:
    """Where photographs and their poses lie.

    Parameters
    ----------
    manifest
        The ``.csv`` that ``seasonscapes webcams --manifest`` wrote.
    calibrations
        Folder of ``WEBCAM_calibration.json``, as ``seasonscapes calibrate`` writes them.
    masks
        Folder of ``WEBCAM.png``, black where something stands before the landscape; optional.
    allow_outside
        Let the manifest name pictures outside its folder.
    accept_doubtful
        Use poses that their calibration called not reliable.
    """

    manifest: Path
    calibrations: Path
    masks: Path | None = None
    allow_outside: bool = False
    accept_doubtful: bool = False

    def picture_of(self, row: ManifestRow) -> Path:
        """The picture of a row of the manifest; `InputError` where a link leads out of the manifest's folder."""
        path, folder = self.manifest.parent / row.path, real_path(self.manifest.parent)
        if not self.allow_outside and not real_path(path).is_relative_to(folder):
            cure = "copy the picture itself, or pass --allow-outside"
            raise InputError(path, "leads outside the manifest's folder", got=str(real_path(path)), cure=cure)
        return path

    def calibration_of(self, webcam: str, time: datetime | None = None) -> Path:
        """The record of a webcam's picture of that time where there is one, else that of the webcam, which may be none."""
        from seasonscapes.calibration.calibration_file import record_name

        own = self.calibrations / record_name(webcam, time)
        return own if own.is_file() else self.calibrations / record_name(webcam)


def open_photographs(
    place: Place,
    manifest: str | Path,
    calibrations: str | Path,
    times: str | datetime | Sequence[str | datetime],
    *,
    masks: str | Path | None = None,
    within_min: float = 30.0,
    progress: Progress | None = None,
) -> list[Observation]:
    """Open the photographs nearest to some times, with their calibrated poses, in a place's frame.

    Parameters
    ----------
    place
        The place.
    manifest
        A ``.csv`` of ``seasonscapes webcams --manifest``.
    calibrations
        Folder of ``WEBCAM_calibration.json``, as ``seasonscapes calibrate`` writes them.
    times
        Aware datetimes, or ISO 8601 text; without offset it is civil time at the place.
    masks
        Folder of ``WEBCAM.png``, black where something stands before the landscape.
    within_min
        Use each webcam's photograph nearest to a time, within so many minutes.
    progress
        Called with a task and its finished share.

    Returns
    -------
    list of Observation
        Linear images ``(H, W, 3)`` with masks, cameras in the place's frame and pose uncertainties. A panorama gives
        several perspective views. Webcams without a calibration are left out and logged.

    Raises
    ------
    InputError
        Where no photograph is near enough, none is calibrated, or a file is damaged.

    Examples
    --------
    >>> import tempfile
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> camera = ss.camera(place, "aerial", size_px=(48, 32))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     sources = ss.synthetic_photographs(place, ["2024-07-20T13:30"], folder, sky="hosek", cameras={"aerial": camera})
    ...     photographs = ss.open_photographs(place, sources.manifest, sources.calibrations, "2024-07-20T13:30")
    >>> len(photographs), photographs[0].image.shape
    (1, (32, 48, 3))
    """
    wanted = [times] if isinstance(times, (str, datetime)) else list(times)
    sources = PhotographSources(Path(manifest), Path(calibrations), None if masks is None else Path(masks))
    utc = [utc_at(place, time) for time in wanted]
    return photographs_at(place, sources, utc, within_min=within_min, where="times", progress=progress)


def photographs_at(
    place: Place,
    sources: PhotographSources,
    times: Sequence[datetime],
    *,
    within_min: float = 30.0,
    where: str = "--times",
    most_pixels: int | None = None,
    progress: Progress | None = None,
) -> list[Observation]:
    """`open_photographs` from given sources at UTC times; ``where`` is what an error message calls the times.

    Pictures of more than ``most_pixels`` are reduced to as many.
    """
    near = [rows_at(sources, time, within_min=within_min, where=where) for time in times]
    rows = {row.path: row for group in near for row in group}
    opened = observations(list(rows.values()), sources, place.frame, place=place, progress=progress)
    return opened if most_pixels is None else [reduced_observation(each, most_pixels) for each in opened]


def reduced_observation(observation: Observation, most_pixels: int) -> Observation:
    """A photograph averaged down to a number of pixels, in linear light; pixels that the mask touches stay masked."""
    import cv2

    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.workflows.recovery_plan import reduced_camera

    if not isinstance(observation.camera, Camera):
        return observation
    camera = reduced_camera(observation.camera, most_pixels)
    if camera is observation.camera:
        return observation
    size = (camera.width_px, camera.height_px)
    image = cv2.resize(observation.image, size, interpolation=cv2.INTER_AREA)
    mask = cv2.resize(observation.mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.99
    return replace(observation, image=image, mask=mask, camera=camera)


def rows_at(
    sources: PhotographSources, time: datetime, *, within_min: float, where: str = "--time"
) -> list[ManifestRow]:
    """Return each webcam's photograph nearest to a time.

    Parameters
    ----------
    sources
        Its manifest is read.
    time
        Aware.
    within_min
        Largest difference in time [min].
    where
        What an error message calls the time.

    Raises
    ------
    InputError
        Where no photograph is near enough (it names the nearest one), or one leads out of the manifest's folder.
    """
    from seasonscapes.cameras.observation import read_manifest

    nearest: dict[str, ManifestRow] = {}
    rows = read_manifest(sources.manifest, allow_outside=sources.allow_outside)
    for row in sorted(rows, key=lambda row: (abs(row.time - time), row.path)):
        if abs(row.time - time) <= timedelta(minutes=within_min):
            nearest.setdefault(row.webcam, row)
    if not nearest:
        expected = "the manifest is empty"
        if rows:
            closest = min(rows, key=lambda row: abs(row.time - time))
            expected = f"the nearest is {closest.webcam} at {closest.time.isoformat()}"
        raise InputError(where, f"no picture within {within_min:g} minutes", got=time.isoformat(), expected=expected)
    for row in nearest.values():
        sources.picture_of(row)
    return [nearest[name] for name in sorted(nearest)]


def uncalibrated(rows: Sequence[ManifestRow], sources: PhotographSources) -> list[str]:
    """Webcams of photographs that have no calibration record."""
    return sorted({row.webcam for row in rows if not sources.calibration_of(row.webcam, row.time).is_file()})


def observations(
    rows: Sequence[ManifestRow],
    sources: PhotographSources,
    frame: LocalFrame,
    *,
    place: Place | None = None,
    progress: Progress | None = None,
) -> list[Observation]:
    """Open photographs as pinhole observations in a frame.

    Webcams without a calibration, and pictures whose pose is doubtful, are left out with a warning. With a ``place``, so are cameras
    deeper in its ground than heights are known to (`calibration.ground_clearance.ground_tolerance_m`), while others that stand
    less than a metre above it are lifted to that.

    Raises
    ------
    InputError
        Where no photograph is left.
    """
    from seasonscapes.calibration.calibration_file import read_calibration

    opened: list[Observation] = []
    doubtful: list[str] = []
    lifter = None if place is None else _Lifter(place, accept_doubtful=sources.accept_doubtful)
    for row in each_reported(rows, len(rows), progress, "opening photographs"):
        record = sources.calibration_of(row.webcam, row.time)
        if not record.is_file():
            continue
        calibrated = read_calibration(record)
        if calibrated.doubts and not sources.accept_doubtful:
            doubtful.append(f"{record.name}: {'; '.join(calibrated.doubts)}")
            continue
        views = opened_views(row, sources, calibrated, frame)
        if lifter is not None:
            below = lifter.below(views, record.name)
            if below.too_deep_m and not sources.accept_doubtful:
                known = f"whose heights are known to {below.tolerance_m:.0f} m"
                deep = f"the camera stands {below.too_deep_m:.1f} m below the ground of the terrain, {known}"
                doubtful.append(f"{record.name}: {deep}")
                continue
            views = [replace(view, camera=clear_of_ground(view.camera, below.up_m)) for view in views]
        opened += views
    without, doubtful = uncalibrated(rows, sources), list(dict.fromkeys(doubtful))
    if not opened and doubtful:
        raise InputError(
            sources.calibrations,
            f"holds no reliable pose for these pictures: {' | '.join(doubtful)}",
            cure="calibrate from points (seasonscapes annotate, then calibrate --points), or pass --doubtful-poses",
        )
    if not opened:
        raise InputError(
            sources.calibrations,
            "holds no calibration of a webcam with a picture at that time",
            got=", ".join(without),
            cure="seasonscapes calibrate SCENE --webcam ... -o FOLDER",
        )
    for name in without:
        log.warning("left out: %s: no calibration", name)
    for name in doubtful:
        log.warning("left out, the pose is not reliable: %s", name)
    return opened


class _Lifter:
    """Lifts cameras that lie in the ground; looks, and tells, once for each position that photographs were taken from."""

    def __init__(self, place: Place, *, accept_doubtful: bool) -> None:
        self._place, self._accept_doubtful = place, accept_doubtful
        self._known: dict[tuple[float, ...], GroundBelow] = {}

    def below(self, views: list[Observation], name: str) -> GroundBelow:
        """The ground below one photograph's views, told of where these are to be lifted."""
        position_m = views[0].camera.position_m
        key = tuple(np.round(position_m, 3).tolist())
        if key not in self._known:
            self._known[key] = found = ground_below(self._place, position_m)
            if found.lifts and (self._accept_doubtful or not found.too_deep_m):
                log.warning("%s: the camera stands %s: lifted to %g m above", name, found, LEAST_ABOVE_GROUND_M)
        return self._known[key]


def opened_views(
    row: ManifestRow, sources: PhotographSources, calibrated: CalibratedWebcam, frame: LocalFrame
) -> list[Observation]:
    """Open one photograph as pinhole observations in a frame: rectified, or cut out of its panorama."""
    from seasonscapes.cameras.lens import rectify
    from seasonscapes.cameras.observation import Observation, open_observation
    from seasonscapes.cameras.panorama import Panorama, cut_view, split_panorama
    from seasonscapes.cameras.picture_content import picture_content

    view, sigma = view_in_frame(calibrated.view, frame), calibrated.sigma
    picture = open_observation(row, sources.manifest.parent, view)
    mask = _mask(sources, row.webcam, picture.mask.shape) & picture_content(picture.image)
    mask_image = np.repeat(mask[..., None], 3, axis=2).astype(np.float32)
    if not isinstance(view, Panorama):
        if calibrated.lens.is_ideal:
            return [replace(picture, mask=mask, pose_sigma=sigma)]
        image, inside = rectify(picture.image, view, calibrated.lens)
        kept = rectify(mask_image, view, calibrated.lens)[0][..., 0] > 0.99
        return [Observation(image.astype(np.float32), inside & kept, view, row.time, row.webcam, sigma)]
    views = []
    for number, camera in enumerate(split_panorama(view)):
        image, inside = cut_view(picture.image, view, camera)
        kept = cut_view(mask_image, view, camera)[0][..., 0] > 0.99
        views.append(Observation(image, inside & kept, camera, row.time, f"{row.webcam}/{number}", sigma))
    return views


def _mask(sources: PhotographSources, webcam: str, shape: tuple[int, ...]) -> np.ndarray:
    from seasonscapes.images import read_image_linear

    path = None if sources.masks is None else sources.masks / f"{webcam}.png"
    if path is None or not path.is_file():
        return np.ones(shape, bool)
    try:
        mask = read_image_linear(path).max(axis=2) > 0.5
    except UnreadableImage as error:
        raise InputError(path, str(error)) from None
    if mask.shape != shape:
        raise InputError(
            path,
            "the mask has another size than its webcam's pictures",
            got=f"{mask.shape[1]} x {mask.shape[0]}",
            expected=f"{shape[1]} x {shape[0]}",
        )
    return mask
