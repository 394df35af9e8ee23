"""Poses of all pictures of a webcam from one that is calibrated: each turned a little by wind, thaw or stabilisation."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.errors import NotEnoughEvidence, NoUsablePixels
from seasonscapes.progress import Progress, each_reported
from seasonscapes.workflows.webcam_calibration import WebcamCalibration, station_picture, straight_picture

if TYPE_CHECKING:
    from seasonscapes.calibration.resection import Calibration
    from seasonscapes.cameras.observation import ManifestRow

# How far a picture may be turned from the calibrated one where its skyline is looked for [deg].
_TURN_DEG = 3.0


@dataclass(frozen=True)
class PicturePose:
    """The pose of one picture of a series.

    Parameters
    ----------
    row
        The picture.
    record
        Its calibration record.
    turn_deg
        Angle to the calibrated picture [deg]; NaN where it could not be found.
    evidence
        What it was found by: ``"edges"``, ``"skyline"``, or nothing.
    heading_sigma_deg
        Standard deviation of the heading [deg].
    doubts
        Why the pose is not reliable; empty where it is.
    """

    row: ManifestRow
    record: Path
    turn_deg: float
    evidence: str
    heading_sigma_deg: float
    doubts: tuple[str, ...] = ()


def follow_series(
    found: WebcamCalibration,
    rows: Sequence[ManifestRow],
    pictures: Path,
    output: Path,
    *,
    mask: np.ndarray | None = None,
    progress: Progress | None = None,
) -> list[PicturePose]:
    """Find how far each picture of a webcam is turned from the calibrated one, and write a record for each.

    Edges of the land are compared with those of the calibrated picture; where too few agree, the terrain's skyline is looked
    for. A picture that neither explains gets a record with doubts, so that nothing uses it with another picture's pose.

    Parameters
    ----------
    found
        The calibration of one picture.
    rows, pictures
        Pictures of the webcam, and the folder that their paths are relative to.
    output
        Folder for the records.
    mask
        ``(H, W)`` bool, False where something stands before the landscape.
    progress
        Called with a task and its finished share.

    Returns
    -------
    list of PicturePose
        In the order of ``rows``.

    Raises
    ------
    InputError
        Where a picture is missing, damaged or of another size.
    """
    from seasonscapes.calibration.calibration_file import record_name, write_calibration

    solution, station = found.solution, found.station
    reference = found.picture
    if station.lens.is_ideal:
        reference, _ = straight_picture(found.picture, solution.view, solution.distortion)
    open_pixels = _open_pixels(found, reference, mask)
    poses = []
    for row in each_reported(rows, len(rows), progress, "poses of the pictures"):
        picture = station_picture(pictures / row.path, station, "--series")
        straight, inside = straight_picture(picture, solution.view, solution.distortion)
        posed, turn_deg, evidence, doubts = _pose(found, reference, straight, open_pixels, inside)
        path = output / record_name(station.webcam.id, row.time)
        write_calibration(path, station.webcam.id, posed, station.frame, doubts=doubts, time=row.time)
        poses.append(PicturePose(row, path, turn_deg, evidence, posed.sigma["heading_deg"], doubts))
    return poses


def rows_of_webcam(manifest: Path, webcam: str, *, allow_outside: bool = False) -> list[ManifestRow]:
    """The pictures of a webcam that a manifest lists; `InputError` where there is none."""
    from seasonscapes.cameras.observation import read_manifest
    from seasonscapes.errors import InputError

    rows = [row for row in read_manifest(manifest, allow_outside=allow_outside) if row.webcam == webcam]
    if not rows:
        raise InputError(manifest, f"lists no picture of {webcam}", cure="seasonscapes webcams --pictures --manifest")
    return rows


def _open_pixels(found: WebcamCalibration, reference: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """``(H, W)`` bool: land in the calibrated picture, without what stands before it and without a black frame."""
    from seasonscapes.calibration.picture_motion import open_ground
    from seasonscapes.cameras.pinhole import Camera

    usable = _content(reference)
    if mask is not None:
        usable &= mask
    view = found.solution.view
    if found.horizon is not None and isinstance(view, Camera):
        usable &= open_ground(view, found.horizon, usable.shape)
    return usable


def _content(picture: np.ndarray) -> np.ndarray:
    from seasonscapes.cameras.picture_content import picture_content
    from seasonscapes.images import linear_from_srgb

    return picture_content(linear_from_srgb(picture.astype(np.float32) / 255.0))


def _pose(
    found: WebcamCalibration, reference: np.ndarray, picture: np.ndarray, open_pixels: np.ndarray, inside: np.ndarray
) -> tuple[Calibration, float, str, tuple[str, ...]]:
    from seasonscapes.calibration.picture_motion import follow_picture

    usable = (open_pixels & inside, _content(picture) & inside)
    try:
        motion = follow_picture(reference, picture, found.solution, found.station.axes, usable=usable)
    except NotEnoughEvidence as error:
        return _by_its_skyline(found, picture, inside, str(error))
    return motion.calibration, motion.turn_deg, "edges", found.doubts


def _by_its_skyline(
    found: WebcamCalibration, picture: np.ndarray, inside: np.ndarray, reason: str
) -> tuple[Calibration, float, str, tuple[str, ...]]:
    """The pose by the skyline; where it is not reliable, the calibrated picture's with doubts."""
    from seasonscapes.calibration.evidence import Priors
    from seasonscapes.calibration.skyline import SearchRange, align_to_skyline

    station, solution = found.station, found.solution
    priors = Priors(tilt_deg=_TURN_DEG, roll_deg=_TURN_DEG, horizontal_m=0.0, vertical_m=0.0, focal=0.0)
    search = SearchRange(heading_deg=_TURN_DEG, tilt_deg=_TURN_DEG, roll_deg=_TURN_DEG, priors=priors)
    try:
        fit = align_to_skyline(picture, solution.view, station.rasters, station.frame, mask=inside, search=search)
    except (NotEnoughEvidence, NoUsablePixels) as error:
        return solution, float("nan"), "", (reason, str(error))
    if fit.calibration is None or not fit.reliable:
        return solution, float("nan"), "", (reason, *fit.doubts)
    relative = fit.calibration.view.world_from_camera[:3, :3].T @ solution.view.world_from_camera[:3, :3]
    turn_deg = float(np.degrees(np.arccos(np.clip(0.5 * (np.trace(relative) - 1.0), -1.0, 1.0))))
    lens = solution.distortion
    return replace(fit.calibration, lens=lens), turn_deg, "skyline", ()
