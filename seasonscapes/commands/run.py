"""``seasonscapes run``: from photographs to pictures of any hour, unattended."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from seasonscapes.commands.options import PlaceOptions, SkyOptions, ViewOptions
from seasonscapes.commands.run_webcams import RunPictures, bring_pictures, bring_poses, picture_facts, record_facts
from seasonscapes.commands.talk import finish, say
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from datetime import datetime

    from seasonscapes.ledger import Stage
    from seasonscapes.pipeline import Place

# Webcams resolve no finer where they look farther than some kilometres.
_TEXEL_M = 20.0


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
    views: int = 3
    """Cameras around the terrain that pictures to learn from are made for; 0 learns on the surface alone."""


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

    Stages: pictures, calibrate, albedo, paint, inpaint, relight, distil, splat. Each is made again only where its
    arguments, the content of what it reads or this program have changed; run.json in the folder keeps the account.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    times
        When the photographs were taken: ISO 8601, commas between; of one season.
    at_hours
        When to picture the place: ISO 8601, commas between.
    start
        Make this stage (pictures, calibrate, albedo, paint, inpaint, relight, distil or splat) and all after it again.
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

    def read(text: str, flag: str) -> tuple[str, ...]:
        parts = [part.strip() for part in text.split(",") if part.strip()]
        if not parts:
            raise InputError(flag, "no time in it", got=text)
        frame = land.frame
        moments = {resolve_time(part, frame.latitude_deg, frame.longitude_deg).utc for part in parts}
        return tuple(moment.isoformat() for moment in sorted(moments))

    job = Job(scene, read(times, "--times"), read(at_hours, "--at-hours"), pictures, effort, view, sky, options, seed)
    stages = stages_of(job, land)
    stage_range(stages, start, until)
    ledger = run_stages(output, stages, first=start, last=until, tell=lambda line: say(f"run: {line}"))
    record = {
        "output": str(output),
        "scene": land.scene.name,
        "stages": {name: {"seconds": entry["seconds"], "files": len(entry["files"])} for name, entry in ledger.items()},
    }
    lines = [f"{name:<10} {entry['seconds']:8.1f} s  {len(entry['files'])} files" for name, entry in ledger.items()]
    finish(record, [*lines, str(output)], as_json=json)


def stages_of(job: Job, land: Place) -> list[Stage]:
    """The chain for a job, first stage first."""
    from seasonscapes.ledger import Stage

    moments = [_moment(time) for time in job.times]
    common = {
        "place": land.key,
        "imagery": _imagery(land),
        "sky": job.sky.model().model_dump(mode="json"),
        "seed": job.seed,
        "times": job.times,
    }
    view = job.view.chosen(land.scene).model_dump(mode="json")
    looks = {**common, "hours": job.hours, "view": view, "size": job.view.size_px()}

    def stage(
        name: str, inputs: dict, needs: tuple[str, ...], build: Callable[..., list[Path]], own: str = ""
    ) -> Stage:
        return Stage(name, inputs, needs, lambda folder: build(job, land, folder), own or name)

    return [
        stage("pictures", {**common, "pictures": picture_facts(job.pictures, land, moments)}, (), _pictures),
        stage(
            "calibrate",
            {**common, "records": record_facts(job.pictures, moments)},
            ("pictures",),
            _calibrate,
            "calibration",
        ),
        stage("albedo", common, ("pictures", "calibrate"), _albedo),
        stage("paint", common, ("pictures", "calibrate", "albedo"), _paint),
        stage("inpaint", common, ("paint", "albedo"), _inpaint),
        stage("relight", looks, ("albedo",), _relight),
        stage("distil", {**common, "effort": asdict(job.effort)}, ("albedo",), _distil, "gaussians"),
        stage("splat", looks, ("distil",), _splat),
    ]


def _imagery(land: Place) -> dict | None:
    """The scene's image: what the file says of it, and its content."""
    from seasonscapes.workspace import file_hash

    imagery = land.scene.imagery
    if imagery is None:
        return None
    return {**imagery.model_dump(mode="json", exclude={"file"}), "hash": file_hash(imagery.file)}


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
    moments = [_moment(time) for time in job.times]
    return bring_pictures(job.pictures, land, moments, (job.sky.model(), job.seed), folder / "pictures")


def _calibrate(job: Job, land: Place, folder: Path) -> list[Path]:
    moments = [_moment(time) for time in job.times]
    return bring_poses(job.pictures, land, moments, job.seed, (folder / "pictures", folder / "calibration"))


def _sources(job: Job, folder: Path) -> dict:
    return {
        "manifest": folder / "pictures" / "manifest.csv",
        "calibrations": folder / "calibration",
        "masks": folder / "pictures" / "masks",
        "within_min": job.pictures.within_min,
    }


def _albedo_file(folder: Path) -> Path:
    return folder / "albedo" / "albedo.npz"


def _albedo(job: Job, land: Place, folder: Path) -> list[Path]:
    from seasonscapes.commands.albedo import albedo

    with _logged(folder / "albedo", "albedo"):
        albedo(
            job.scene,
            times=",".join(job.times),
            **_sources(job, folder),
            fit_curve=True,
            output=_albedo_file(folder),
            sky=job.sky,
            place=job.place,
        )
    return [_albedo_file(folder)]


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
                albedo=_albedo_file(folder),
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
            inpaint(
                job.scene,
                time=time,
                texture=folder / "paint" / _stamp(time) / "painted.npz",
                output=own / "completed.npz",
                figures=own,
                albedo=_albedo_file(folder),
                fast=True,
                seed=job.seed,
                sky=job.sky,
                place=job.place,
            )
        files.append(own / "completed.npz")
    return files


def _dated(job: Job, folder: Path) -> list[str]:
    return [f"{_moment(job.times[0]).date().isoformat()}={_albedo_file(folder)}"]


def _relight(job: Job, land: Place, folder: Path) -> list[Path]:
    from seasonscapes.commands.timelapse import WhenOptions, timelapse

    own = folder / "relight"
    with _logged(own, "relight"):
        timelapse(
            job.scene,
            when=WhenOptions(times=",".join(job.hours)),
            view=job.view,
            sky=job.sky,
            smooth="0s",
            albedo=_dated(job, folder),
            seed=job.seed,
            output=own,
            place=job.place,
        )
    return [own / f"{_stamp(hour)}.png" for hour in job.hours]


def _distil(job: Job, land: Place, folder: Path) -> list[Path]:
    from seasonscapes.commands.distill import distill

    own, effort = folder / "gaussians", job.effort
    with _logged(own, "distil"):
        distill(
            job.scene,
            output=own / "model.safetensors",
            albedo=_dated(job, folder),
            discs=effort.discs,
            suns=effort.suns,
            views=effort.views,
            steps=effort.steps,
            picture_steps=effort.picture_steps,
            seed=job.seed,
            sky=job.sky,
            place=job.place,
        )
    return [own / "model.safetensors"]


def _splat(job: Job, land: Place, folder: Path) -> list[Path]:
    from seasonscapes.commands.splat import splat

    own, files = folder / "splat", []
    for hour in job.hours:
        files.append(own / f"{_stamp(hour)}.png")
        with _logged(own, _stamp(hour)):
            splat(
                job.scene,
                time=hour,
                model=folder / "gaussians" / "model.safetensors",
                view=job.view,
                sky=job.sky,
                output=files[-1],
                place=job.place,
            )
    return files
