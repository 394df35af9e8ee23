"""``seasonscapes run``: from photographs to pictures of any hour, unattended."""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from seasonscapes.commands.options import PlaceOptions, SkyOptions, ViewOptions
from seasonscapes.commands.talk import finish, progress_bar, say
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from datetime import datetime

    from seasonscapes.ledger import Stage
    from seasonscapes.pipeline import Place

# Webcams resolve no finer where they look farther than some kilometres.
_TEXEL_M = 20.0
# By how much a compass turns the first guess of a synthetic webcam's heading, at most [deg].
_COMPASS_DEG = 3.0


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
    leave_out: str | None = None
    """Of a synthetic scene: cameras that take no picture, with commas between."""
    photo_size: str = "720x480"
    """Of a synthetic scene's webcams."""


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class RunEffort:
    """How hard to try."""

    discs: int = 160
    """Gaussians along the longer side of the terrain."""
    steps: int = 1500
    """Of training on the surface."""
    picture_steps: int = 120
    """Of training through pictures."""
    suns: int = 24
    """Instants that the Gaussians learn from."""


@dataclass(frozen=True)
class Job:
    """What all stages know."""

    scene: str
    times: tuple[str, ...]
    hours: tuple[str, ...]
    pictures: RunPictures
    effort: RunEffort
    view: ViewOptions
    sky: SkyOptions
    place: PlaceOptions
    seed: int


def run(
    scene: str,
    *,
    times: str,
    at_hours: str,
    pictures: RunPictures | None = None,
    view: ViewOptions | None = None,
    sky: SkyOptions | None = None,
    effort: RunEffort | None = None,
    start: Annotated[str | None, Parameter(name="--from")] = None,
    until: str | None = None,
    seed: int = 0,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/run"),
    place: PlaceOptions | None = None,
    json: bool = False,
) -> None:
    """Take a scene from photographs to pictures of other hours and to Gaussians; goes on where it was.

    Stages: pictures, calibrate, paint, inpaint, albedo, relight, distil, splat. Each is made again only where its
    arguments, what it reads or this program have changed; run.json in the folder keeps the account.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    times
        When the photographs were taken: ISO 8601, commas between; of one season.
    at_hours
        When to picture the place: ISO 8601, commas between.
    start
        Make this stage and all after it again.
    until
        Stop after this stage.
    seed
        Equal seeds give equal results.
    output
        Folder for everything.
    json
        Print one machine-readable record.
    """
    from seasonscapes.civil_time import resolve_time
    from seasonscapes.ledger import run_stages, stage_range

    pictures, effort = pictures or RunPictures(), effort or RunEffort()
    options = place or PlaceOptions()
    if options.texel_m is None:
        options = replace(options, texel_m=_TEXEL_M)
    view, sky = view or ViewOptions(size="768x512"), sky or SkyOptions()
    sky.model()
    view.size_px()
    land = options.load(scene)
    view.chosen(land.scene)
    if pictures.manifest is None and land.synthetic is None:
        raise InputError("--manifest", "missing", expected="the .csv of seasonscapes webcams --manifest")

    def read(text: str, flag: str) -> tuple[str, ...]:
        parts = [part.strip() for part in text.split(",") if part.strip()]
        if not parts:
            raise InputError(flag, "no time in it", got=text)
        frame = land.frame
        return tuple(resolve_time(part, frame.latitude_deg, frame.longitude_deg).utc.isoformat() for part in parts)

    job = Job(scene, read(times, "--times"), read(at_hours, "--at-hours"), pictures, effort, view, sky, options, seed)
    stages = stages_of(job, land)
    stage_range(stages, start, until)
    ledger = run_stages(output, stages, first=start, last=until, tell=lambda line: say(f"run: {line}"))
    record = {"output": str(output), "scene": land.scene.name, "stages": {
        name: {"seconds": entry["seconds"], "files": len(entry["files"])} for name, entry in ledger.items()}}  # fmt: skip
    lines = [f"{name:<10} {entry['seconds']:8.1f} s  {len(entry['files'])} files" for name, entry in ledger.items()]
    finish(record, [*lines, str(output)], as_json=json)


def stages_of(job: Job, land: Place) -> list[Stage]:
    """The chain for a job, first stage first."""
    from seasonscapes.ledger import Stage

    common = {"place": land.key, "sky": job.sky.model().model_dump(mode="json"), "seed": job.seed}
    photos = {**common, "times": job.times, "pictures": _plain(job.pictures)}
    looks = {**common, "hours": job.hours, "view": _plain(job.view)}

    def stage(name: str, inputs: dict, needs: tuple[str, ...], build: Callable[..., list[Path]]) -> Stage:
        return Stage(name, inputs, needs, lambda folder: build(job, land, folder))

    return [
        stage("pictures", photos, (), _pictures),
        stage("calibrate", common, ("pictures",), _calibrate),
        stage("paint", common, ("pictures", "calibrate"), _paint),
        stage("inpaint", common, ("paint",), _inpaint),
        stage("albedo", common, ("pictures", "calibrate"), _albedo),
        stage("relight", looks, ("albedo",), _relight),
        stage("distil", {**common, "effort": _plain(job.effort)}, ("albedo",), _distil),
        stage("splat", looks, ("distil",), _splat),
    ]


def _plain(options: Any) -> dict:
    return {key: str(value) if isinstance(value, Path) else value for key, value in asdict(options).items()}


@contextlib.contextmanager
def _logged(folder: Path, name: str):
    """What a verb says on stdout goes to the stage's log."""
    folder.mkdir(parents=True, exist_ok=True)
    with open(folder / f"{name}.log", "w", encoding="utf-8") as log, contextlib.redirect_stdout(log):
        yield


def _stamp(time: str) -> str:
    from seasonscapes.relighting.frame_file import time_stamp

    return time_stamp(_moment(time))


def _moment(time: str) -> datetime:
    from datetime import datetime

    return datetime.fromisoformat(time)


def _pictures(job: Job, land: Place, folder: Path) -> list[Path]:
    """A synthetic scene's photographs, or a copy of a real one's list that does not change while we work."""
    from seasonscapes.cameras.observation import read_manifest, write_manifest
    from seasonscapes.commands.paint import chosen_cameras
    from seasonscapes.commands.talk import parse_size
    from seasonscapes.commands.webcam_shots import make_webcam_series

    own = folder / "pictures"
    if job.pictures.manifest is not None:
        base = job.pictures.manifest.parent.resolve()
        rows = [replace(row, path=str(base / row.path)) for row in read_manifest(job.pictures.manifest)]
        write_manifest(own / "manifest.csv", rows)
        return [own / "manifest.csv"]
    cameras = chosen_cameras(land, job.pictures.leave_out, parse_size(job.pictures.photo_size))
    with progress_bar(f"photographing from {len(cameras)} webcams") as progress:
        moments = [_moment(time) for time in job.times]
        make_webcam_series(land, moments, job.sky.model(), own, cameras=cameras, seed=job.seed, progress=progress)
    pictures = [own / row.path for row in read_manifest(own / "manifest.csv")]
    return [own / "manifest.csv", *pictures, *(own / f"{name}_calibration.json" for name in cameras)]


def _calibrate(job: Job, land: Place, folder: Path) -> list[Path]:
    """Real webcams bring their records. Synthetic ones are found by their skylines from a compass's guess."""
    own = folder / "calibration"
    if job.pictures.manifest is not None:
        return _copied_records(job.pictures.calibrations, own)
    files = _found_by_skyline(job, land, folder / "pictures", own)
    if not files:
        raise InputError("run", "no webcam could be calibrated", cure="choose --times with a clear skyline")
    return files


def _copied_records(source: Path, own: Path) -> list[Path]:
    from seasonscapes.images import atomic_path

    copies = []
    for record in sorted(source.glob("*_calibration.json")):
        with atomic_path(own / record.name) as temporary:
            temporary.write_bytes(record.read_bytes())
        copies.append(own / record.name)
    if not copies:
        raise InputError("--calibrations", "holds no record", got=str(source),
                         cure="seasonscapes calibrate SCENE --webcam ... -o FOLDER")  # fmt: skip
    return copies


def _found_by_skyline(job: Job, land: Place, taken: Path, own: Path) -> list[Path]:
    """Records of the webcams whose skyline can be trusted, from the picture in the middle of the times."""
    import numpy as np

    from seasonscapes.calibration.pose_model import values_of, view_from_values
    from seasonscapes.calibration.record import read_calibration, write_calibration
    from seasonscapes.calibration.skyline import align_to_skyline, encoded_from_file
    from seasonscapes.cameras.observation import read_manifest

    middle = _moment(job.times[len(job.times) // 2])
    photograph = {row.webcam: taken / row.path for row in read_manifest(taken / "manifest.csv") if row.time == middle}
    files = []
    for record in sorted(taken.glob("*_calibration.json")):
        pose = read_calibration(record)
        rng = np.random.default_rng([job.seed, zlib.crc32(pose.webcam.encode())])
        values = values_of(pose.view, np.eye(3))
        values[0] += rng.uniform(-_COMPASS_DEG, _COMPASS_DEG)
        guess = view_from_values(pose.view, np.eye(3), values)
        fit = align_to_skyline(encoded_from_file(photograph[pose.webcam]), guess, [land.elevation], pose.frame)
        if fit.calibration is None or fit.doubts:
            say(f"run: calibrate: {pose.webcam} is left out: {'; '.join(fit.doubts)}")
            continue
        write_calibration(own / record.name, pose.webcam, fit.calibration, pose.frame)
        files.append(own / record.name)
    return files


def _sources(job: Job, folder: Path) -> dict:
    return {
        "manifest": folder / "pictures" / "manifest.csv",
        "calibrations": folder / "calibration",
        "masks": job.pictures.masks,
    }


def _paint(job: Job, land: Place, folder: Path) -> list[Path]:
    from seasonscapes.commands.paint import PictureOptions, paint

    files = []
    for time in job.times:
        own = folder / "paint" / _stamp(time)
        with _logged(own, "paint"):
            paint(
                job.scene,
                time=time,
                pictures=PictureOptions(**_sources(job, folder)),
                output=own,
                sky=job.sky,
                place=job.place,
            )
        files.append(own / "painted.npz")
    return files


def _inpaint(job: Job, land: Place, folder: Path) -> list[Path]:
    from seasonscapes.commands.inpaint import inpaint

    files = []
    for time in job.times:
        own = folder / "inpaint" / _stamp(time)
        with _logged(own, "inpaint"):
            inpaint(job.scene, time=time, texture=folder / "paint" / _stamp(time) / "painted.npz", output=own / "completed.npz",
                    figures=own, fast=True, seed=job.seed, sky=job.sky, place=job.place)  # fmt: skip
        files.append(own / "completed.npz")
    return files


def _albedo(job: Job, land: Place, folder: Path) -> list[Path]:
    from seasonscapes.commands.albedo import albedo

    own = folder / "albedo"
    with _logged(own, "albedo"):
        albedo(job.scene, times=",".join(job.times), **_sources(job, folder), output=own / "albedo.npz", sky=job.sky,
               place=job.place)  # fmt: skip
    return [own / "albedo.npz"]


def _dated(job: Job, folder: Path) -> list[str]:
    return [f"{_moment(job.times[0]).date().isoformat()}={folder / 'albedo' / 'albedo.npz'}"]


def _relight(job: Job, land: Place, folder: Path) -> list[Path]:
    from seasonscapes.commands.timelapse import WhenOptions, timelapse

    own = folder / "relight"
    with _logged(own, "relight"):
        timelapse(job.scene, when=WhenOptions(times=",".join(job.hours)), view=job.view, sky=job.sky, smooth="0s",
                  albedo=_dated(job, folder), seed=job.seed, output=own, place=job.place)  # fmt: skip
    return [own / f"{_stamp(hour)}.png" for hour in job.hours]


def _distil(job: Job, land: Place, folder: Path) -> list[Path]:
    from seasonscapes.commands.distill import distill

    own, effort = folder / "gaussians", job.effort
    with _logged(own, "distil"):
        distill(job.scene, output=own / "model.safetensors", albedo=_dated(job, folder), discs=effort.discs, suns=effort.suns,
                steps=effort.steps, picture_steps=effort.picture_steps, seed=job.seed, sky=job.sky, place=job.place)  # fmt: skip
    return [own / "model.safetensors"]


def _splat(job: Job, land: Place, folder: Path) -> list[Path]:
    from seasonscapes.commands.splat import splat

    own, files = folder / "splat", []
    for hour in job.hours:
        files.append(own / f"{_stamp(hour)}.png")
        with _logged(own, _stamp(hour)):
            splat(job.scene, time=hour, model=folder / "gaussians" / "model.safetensors", view=job.view, sky=job.sky,
                  output=files[-1], place=job.place)  # fmt: skip
    return files
