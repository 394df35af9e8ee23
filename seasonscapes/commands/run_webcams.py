"""The photographs and poses of ``seasonscapes run``: what they are made from, and the two stages that bring them."""

from __future__ import annotations

import shutil
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from seasonscapes.commands.talk import parse_size, progress_bar, say
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.cameras.observation import ManifestRow
    from seasonscapes.cameras.panorama import Panorama
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.pipeline import Place
    from seasonscapes.sky.models import SkyModel

# By how much a compass turns the first guess of a synthetic webcam's heading, at most [deg].
_COMPASS_DEG = 3.0
_PHOTO_SIZES = {"panorama": "2048x384", "perspective": "720x480"}


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RunPictures:
    """The photographs."""

    manifest: Path | None = None
    """The .csv of `seasonscapes webcams --manifest`; left out, a synthetic scene is photographed from its cameras."""
    calibrations: Path = Path("out/calibration")
    """Of a real scene: folder of the records of `seasonscapes calibrate`."""
    masks: Path | None = None
    """Folder of WEBCAM.png, black where something stands before the landscape."""
    within_min: float = 30.0
    """Of a real scene: take each webcam's picture that is nearest to a time, within so many minutes."""
    leave_out: str | None = None
    """Of a synthetic scene: cameras that take no picture, with commas between."""
    photo_kind: str = "panorama"
    """Of a synthetic scene's webcams: panorama (a full circle, cylindrical) or perspective."""
    photo_size: str | None = None
    """Of a synthetic scene's webcams; default 2048x384, in perspective 720x480."""

    def size_px(self) -> tuple[int, int]:
        """Width and height of a synthetic webcam's pictures."""
        if self.photo_kind not in _PHOTO_SIZES:
            raise InputError("--photo-kind", "unknown kind", got=self.photo_kind, expected=" or ".join(_PHOTO_SIZES))
        return parse_size(self.photo_size or _PHOTO_SIZES[self.photo_kind])


def picture_facts(pictures: RunPictures, land: Place, times: Sequence[datetime]) -> dict:
    """All that decides the photographs: contents of files rather than their names."""
    if pictures.manifest is None:
        if land.synthetic is None:
            raise InputError("--manifest", "missing", expected="the .csv of seasonscapes webcams --manifest")
        cameras = [camera.model_dump(mode="json") for camera in land.scene.cameras]
        return {
            "cameras": cameras,
            "leave_out": pictures.leave_out,
            "kind": pictures.photo_kind,
            "size": pictures.size_px(),
            "masks": _mask_hashes(pictures, [each["name"] for each in cameras]),
        }
    rows = _chosen_rows(pictures, times)
    return {
        "pictures": [[row.webcam, row.time.isoformat(), row.sha256] for row in rows],
        "masks": _mask_hashes(pictures, [row.webcam for row in rows]),
    }


def record_facts(pictures: RunPictures, times: Sequence[datetime]) -> dict:
    """Content of each calibration record of a real scene that will be used, by webcam."""
    from seasonscapes.workspace import file_hash

    if pictures.manifest is None:
        return {}
    return {path.name: file_hash(path) for path in _chosen_records(pictures, _chosen_rows(pictures, times))}


def _chosen_rows(pictures: RunPictures, times: Sequence[datetime]) -> list[ManifestRow]:
    """The pictures nearest to the times, with absolute paths and the checksums that they have now."""
    from seasonscapes.cameras.observation import file_sha256
    from seasonscapes.commands.webcam_shots import Sources, rows_at

    sources = Sources(pictures.manifest, pictures.calibrations, pictures.masks)
    rows = {
        row.path: row
        for time in times
        for row in rows_at(sources, time, within_min=pictures.within_min, flag="--times")
    }
    found, folder = [], pictures.manifest.parent.resolve()
    for row in rows.values():
        path = folder / row.path
        if not path.is_file():
            raise InputError(path, "no such picture", cure="fetch it again, or take it out of the manifest")
        found.append(replace(row, path=str(path), bytes=path.stat().st_size, sha256=file_sha256(path)))
    return found


def _chosen_records(pictures: RunPictures, rows: Sequence[ManifestRow]) -> list[Path]:
    paths = [pictures.calibrations / f"{webcam}_calibration.json" for webcam in sorted({row.webcam for row in rows})]
    found = [path for path in paths if path.is_file()]
    if not found:
        raise InputError(
            "--calibrations",
            "holds no record of a webcam with a picture at these times",
            got=str(pictures.calibrations),
            cure="seasonscapes calibrate SCENE --webcam ... -o FOLDER",
        )
    return found


def _mask_hashes(pictures: RunPictures, webcams: Sequence[str]) -> dict:
    from seasonscapes.workspace import file_hash

    return {path.name: file_hash(path) for path in _masks(pictures, webcams)}


def _masks(pictures: RunPictures, webcams: Sequence[str]) -> list[Path]:
    if pictures.masks is None:
        return []
    if not pictures.masks.is_dir():
        raise InputError("--masks", "no such folder", got=str(pictures.masks))
    return [path for path in (pictures.masks / f"{name}.png" for name in sorted(set(webcams))) if path.is_file()]


def bring_pictures(
    pictures: RunPictures, land: Place, times: Sequence[datetime], sky: tuple[SkyModel, int], own: Path
) -> list[Path]:
    """The stage that photographs a synthetic scene, or copies the pictures of a real one, so that they stay what they are.

    ``sky`` is its model and the seed.
    """
    from seasonscapes.cameras.observation import read_manifest, write_manifest
    from seasonscapes.relighting.frame_file import time_stamp

    if pictures.manifest is not None:
        rows = _chosen_rows(pictures, times)
        names = [f"{row.webcam}_{time_stamp(row.time)}{Path(row.path).suffix}" for row in rows]
        copies = [_copied(Path(row.path), own / name) for row, name in zip(rows, names, strict=True)]
        write_manifest(own / "manifest.csv", [replace(row, path=name) for row, name in zip(rows, names, strict=True)])
        return [own / "manifest.csv", *copies, *_copied_masks(pictures, [row.webcam for row in rows], own)]
    from seasonscapes.commands.paint import chosen_cameras
    from seasonscapes.commands.webcam_shots import make_webcam_series

    size_px = pictures.size_px()
    webcams: dict[str, Camera | Panorama] = dict(chosen_cameras(land, pictures.leave_out, size_px))
    if pictures.photo_kind == "panorama":
        from seasonscapes.cameras.panorama import level_panorama

        webcams = {name: level_panorama(camera, land.frame, size_px) for name, camera in webcams.items()}
    with progress_bar(f"photographing from {len(webcams)} webcams") as progress:
        make_webcam_series(land, times, sky[0], own, cameras=webcams, seed=sky[1], progress=progress)
    taken = [own / row.path for row in read_manifest(own / "manifest.csv")]
    records = [own / f"{name}_calibration.json" for name in webcams]
    return [own / "manifest.csv", *taken, *records, *_copied_masks(pictures, list(webcams), own)]


def bring_poses(
    pictures: RunPictures, land: Place, times: Sequence[datetime], seed: int, folders: tuple[Path, Path]
) -> list[Path]:
    """The stage that copies the records of real webcams, or finds synthetic ones by their skylines.

    ``folders`` are that of the photographs and this stage's own.
    """
    taken, own = folders
    if pictures.manifest is not None:
        return [_copied(path, own / path.name) for path in _chosen_records(pictures, _chosen_rows(pictures, times))]
    files, doubts = _found_by_skyline(land, times[len(times) // 2], seed, taken, own)
    for name, doubt in doubts.items():
        say(f"run: calibrate: {name} is left out: {doubt}")
    if not files:
        raise InputError(
            "run",
            "no webcam could be calibrated: " + "; ".join(sorted(set(doubts.values()))),
            cure="choose --times with a clear skyline",
        )
    say(f"run: calibrate: {len(files)} of {len(files) + len(doubts)} webcams found by their skylines")
    return files


def _copied(file: Path, copy: Path) -> Path:
    from seasonscapes.images import atomic_path

    with atomic_path(copy) as temporary:
        shutil.copyfile(file, temporary)
    return copy


def _copied_masks(pictures: RunPictures, webcams: Sequence[str], own: Path) -> list[Path]:
    return [_copied(path, own / "masks" / path.name) for path in _masks(pictures, webcams)]


def _found_by_skyline(
    land: Place, time: datetime, seed: int, taken: Path, own: Path
) -> tuple[list[Path], dict[str, str]]:
    """Records of the webcams whose skyline at a time can be trusted, and why others are not; from a compass's guess."""
    import numpy as np

    from seasonscapes.calibration.calibration_file import read_calibration, write_calibration
    from seasonscapes.calibration.pose_model import values_of, view_from_values
    from seasonscapes.calibration.skyline import align_to_skyline, encoded_from_file
    from seasonscapes.cameras.observation import read_manifest

    photograph = {row.webcam: taken / row.path for row in read_manifest(taken / "manifest.csv") if row.time == time}
    files, doubts = [], {}
    for record in sorted(taken.glob("*_calibration.json")):
        if not (own / record.name).is_file():
            pose = read_calibration(record)
            rng = np.random.default_rng([seed, zlib.crc32(pose.webcam.encode())])
            values = values_of(pose.view, np.eye(3))
            values[0] += rng.uniform(-_COMPASS_DEG, _COMPASS_DEG)
            guess = view_from_values(pose.view, np.eye(3), values)
            try:
                fit = align_to_skyline(encoded_from_file(photograph[pose.webcam]), guess, [land.elevation], pose.frame)
            except ValueError as error:
                doubts[pose.webcam] = str(error)
                continue
            if fit.calibration is None or fit.doubts:
                doubts[pose.webcam] = ", ".join(fit.doubts)
                continue
            write_calibration(own / record.name, pose.webcam, fit.calibration, pose.frame)
        files.append(own / record.name)
    return files, doubts
