"""Photographs and poses of a run: keyed by content, copied into the run, or made and calibrated for synthetic scenes."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from seasonscapes.errors import InputError, NotEnoughEvidence
from seasonscapes.images import atomic_path
from seasonscapes.progress import Progress
from seasonscapes.sky.models import SkyModel
from seasonscapes.workflows.photograph_files import PhotographSources, rows_at
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.synthetic_photographs import photograph_series
from seasonscapes.workflows.views import scene_cameras
from seasonscapes.workflows.webcam_calibration import calibrate_by_skylines
from seasonscapes.workspace import file_hash

if TYPE_CHECKING:
    from seasonscapes.cameras.observation import ManifestRow
    from seasonscapes.cameras.panorama import Panorama
    from seasonscapes.cameras.pinhole import Camera

log = logging.getLogger(__name__)

PHOTO_SIZES = {"panorama": (2048, 384), "perspective": (720, 480)}


@dataclass(frozen=True)
class RunPhotographs:
    """Where a run's photographs come from.

    Parameters
    ----------
    sources
        Manifest, calibrations and masks of real photographs; ``None`` photographs a synthetic scene from its cameras.
    masks
        Of a synthetic scene: folder of ``WEBCAM.png``.
    within_min
        Largest difference in time of a real photograph [min].
    leave_out
        Cameras of a synthetic scene that take no photograph.
    kind, size_px
        Of a synthetic scene's photographs: ``"panorama"`` (a full circle, cylindrical) or ``"perspective"``, and size [px].
    """

    sources: PhotographSources | None = None
    masks: Path | None = None
    within_min: float = 30.0
    leave_out: frozenset[str] = frozenset()
    kind: str = "panorama"
    size_px: tuple[int, int] = PHOTO_SIZES["panorama"]

    def __post_init__(self) -> None:
        if self.kind not in PHOTO_SIZES:
            raise InputError("--photo-kind", "unknown kind", got=self.kind, expected=" or ".join(PHOTO_SIZES))

    @property
    def mask_folder(self) -> Path | None:
        """The folder of masks, of real and of synthetic photographs."""
        return self.masks if self.sources is None else self.sources.masks


def photograph_facts(photographs: RunPhotographs, place: Place, times: Sequence[datetime]) -> dict:
    """Plain values that determine a run's photographs: contents of files rather than their names."""
    if photographs.sources is None:
        if place.synthetic is None:
            raise InputError("--manifest", "missing", expected="the .csv of seasonscapes webcams --manifest")
        cameras = [camera.model_dump(mode="json") for camera in place.scene.cameras]
        return {
            "cameras": cameras,
            "leave_out": sorted(photographs.leave_out),
            "kind": photographs.kind,
            "size": photographs.size_px,
            "masks": _mask_hashes(photographs, [camera["name"] for camera in cameras]),
        }
    rows = _chosen_rows(photographs, photographs.sources, times)
    return {
        "pictures": [[row.webcam, row.time.isoformat(), row.sha256] for row in rows],
        "masks": _mask_hashes(photographs, [row.webcam for row in rows]),
    }


def record_facts(photographs: RunPhotographs, times: Sequence[datetime]) -> dict:
    """Content hashes of the calibration records of real photographs; empty for a synthetic scene."""
    if photographs.sources is None:
        return {}
    rows = _chosen_rows(photographs, photographs.sources, times)
    records = {path.name: file_hash(path) for path in _chosen_records(photographs.sources, rows)}
    return {"accept_doubtful": True, **records} if photographs.sources.accept_doubtful else records


def bring_photographs(
    photographs: RunPhotographs,
    place: Place,
    times: Sequence[datetime],
    model: SkyModel,
    own: Path,
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Path]:
    """Photograph a synthetic scene into a folder, or copy real photographs there, so that they stay as they are.

    Parameters
    ----------
    photographs, place, times
        What to bring; UTC times.
    model
        Sky model of a synthetic scene.
    own
        The folder.
    seed
        Of a synthetic scene.
    progress
        Called with a task and its finished share.

    Returns
    -------
    list of pathlib.Path
        Manifest, photographs, records and masks.
    """
    from seasonscapes.cameras.observation import read_manifest, write_manifest
    from seasonscapes.cameras.panorama import level_panorama
    from seasonscapes.relighting.frame_file import time_stamp

    if photographs.sources is not None:
        rows = _chosen_rows(photographs, photographs.sources, times)
        names = [f"{row.webcam}_{time_stamp(row.time)}{Path(row.path).suffix}" for row in rows]
        copies = [_copy(Path(row.path), own / name) for row, name in zip(rows, names, strict=True)]
        write_manifest(own / "manifest.csv", [replace(row, path=name) for row, name in zip(rows, names, strict=True)])
        return [own / "manifest.csv", *copies, *_copy_masks(photographs, [row.webcam for row in rows], own)]
    size_px = photographs.size_px
    cameras = scene_cameras(place, leave_out=set(photographs.leave_out), size_px=size_px)
    webcams: dict[str, Camera | Panorama] = dict(cameras)
    if photographs.kind == "panorama":
        webcams = {name: level_panorama(camera, place.frame, size_px) for name, camera in cameras.items()}
    photograph_series(place, times, model, own, cameras=webcams, seed=seed, progress=progress)
    taken = [own / row.path for row in read_manifest(own / "manifest.csv")]
    records = [own / f"{name}_calibration.json" for name in webcams]
    return [own / "manifest.csv", *taken, *records, *_copy_masks(photographs, list(webcams), own)]


def bring_poses(
    photographs: RunPhotographs, place: Place, times: Sequence[datetime], taken: Path, own: Path, *, seed: int = 0
) -> list[Path]:
    """Copy the calibration records of real webcams into a folder, or calibrate synthetic ones by their skylines.

    Parameters
    ----------
    photographs, place, times
        As of `bring_photographs`.
    taken
        Folder of the photographs.
    own
        Folder for the records.
    seed
        Of the compass errors of synthetic webcams.

    Returns
    -------
    list of pathlib.Path
        The records; webcams that could not be calibrated reliably are logged.

    Raises
    ------
    NotEnoughEvidence
        Where no webcam could be calibrated.
    """
    from seasonscapes.cameras.observation import read_manifest

    if photographs.sources is not None:
        rows = _chosen_rows(photographs, photographs.sources, times)
        return [_copy(path, own / path.name) for path in _trusted_records(photographs.sources, rows)]
    time = times[len(times) // 2]
    pictures = {row.webcam: taken / row.path for row in read_manifest(taken / "manifest.csv") if row.time == time}
    files, doubts = calibrate_by_skylines(place, pictures, taken, own, seed=seed)
    for name, doubt in doubts.items():
        log.info("run: calibrate: %s is left out: %s", name, doubt)
    if not files:
        reasons = "; ".join(sorted(set(doubts.values())))
        raise NotEnoughEvidence(f"run: no webcam could be calibrated: {reasons}; choose --times with a clear skyline")
    log.info("run: calibrate: %d of %d webcams found by their skylines", len(files), len(files) + len(doubts))
    return files


def _chosen_rows(
    photographs: RunPhotographs, sources: PhotographSources, times: Sequence[datetime]
) -> list[ManifestRow]:
    """The photographs nearest to the times, with absolute paths and the checksums that they have now."""
    from seasonscapes.cameras.observation import file_sha256

    within = photographs.within_min
    rows = {row.path: row for time in times for row in rows_at(sources, time, within_min=within, where="--times")}
    found, folder = [], sources.manifest.parent.resolve()
    for row in rows.values():
        path = folder / row.path
        if not path.is_file():
            raise InputError(path, "no such picture", cure="fetch it again, or take it out of the manifest")
        found.append(replace(row, path=str(path), bytes=path.stat().st_size, sha256=file_sha256(path)))
    return found


def _chosen_records(sources: PhotographSources, rows: Sequence[ManifestRow]) -> list[Path]:
    paths = sorted({sources.calibration_of(row.webcam, row.time) for row in rows})
    found = [path for path in paths if path.is_file()]
    if not found:
        raise InputError(
            "--calibrations",
            "holds no record of a webcam with a picture at these times",
            got=str(sources.calibrations),
            cure="seasonscapes calibrate SCENE --webcam ... -o FOLDER",
        )
    return found


def _trusted_records(sources: PhotographSources, rows: Sequence[ManifestRow]) -> list[Path]:
    """The records whose poses are reliable, or all where doubtful ones are accepted; `NotEnoughEvidence` for none."""
    from seasonscapes.calibration.calibration_file import read_calibration

    paths = _chosen_records(sources, rows)
    doubts = {path: read_calibration(path).doubts for path in paths}
    trusted = [path for path in paths if sources.accept_doubtful or not doubts[path]]
    for path in paths:
        if path not in trusted:
            log.warning("run: left out, the pose is not reliable: %s: %s", path.name, "; ".join(doubts[path]))
    if not trusted:
        told = " | ".join(f"{path.name}: {'; '.join(doubts[path])}" for path in paths)
        cure = "calibrate from points (seasonscapes annotate), or pass --doubtful-poses"
        raise NotEnoughEvidence(f"run: no pose is reliable: {told}; {cure}")
    return trusted


def _mask_hashes(photographs: RunPhotographs, webcams: Sequence[str]) -> dict[str, str]:
    return {path.name: file_hash(path) for path in _masks(photographs, webcams)}


def _masks(photographs: RunPhotographs, webcams: Sequence[str]) -> list[Path]:
    folder = photographs.mask_folder
    if folder is None:
        return []
    if not folder.is_dir():
        raise InputError("--masks", "no such folder", got=str(folder))
    return [path for path in (folder / f"{name}.png" for name in sorted(set(webcams))) if path.is_file()]


def _copy_masks(photographs: RunPhotographs, webcams: Sequence[str], own: Path) -> list[Path]:
    return [_copy(path, own / "masks" / path.name) for path in _masks(photographs, webcams)]


def _copy(file: Path, copy: Path) -> Path:
    with atomic_path(copy) as temporary:
        shutil.copyfile(file, temporary)
    return copy
