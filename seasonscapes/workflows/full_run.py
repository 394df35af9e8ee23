"""The full run: from photographs of a place to pictures of other hours and to Gaussians, stage by stage."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

from seasonscapes.exposure import exposure_ev100
from seasonscapes.images import atomic_path, write_png
from seasonscapes.progress import Progress
from seasonscapes.relighting.frame_file import time_stamp
from seasonscapes.scene import NamedCamera
from seasonscapes.sky.models import SkyModel
from seasonscapes.texturing.painting import PaintOptions
from seasonscapes.workflows import completion, timelapse
from seasonscapes.workflows.albedo_recovery import RecoveryOptions, recover_albedo, save_albedo_figures
from seasonscapes.workflows.albedo_sources import AlbedoFile, dated_albedos
from seasonscapes.workflows.distillation import DistilOptions, distil_with_data, distillation_record
from seasonscapes.workflows.edited_textures import albedo_date
from seasonscapes.workflows.gaussian_views import render_gaussians
from seasonscapes.workflows.inpainting import InpaintOptions, inpaint
from seasonscapes.workflows.painting import painting_of, painting_record
from seasonscapes.workflows.photograph_files import PhotographSources, photographs_at
from seasonscapes.workflows.pictures import develop
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.predicted_radiance import RELATIVE_SIGMA, measured_radiance
from seasonscapes.workflows.relight_session import RenderJob
from seasonscapes.workflows.run_photographs import (
    RunPhotographs,
    bring_photographs,
    bring_poses,
    photograph_facts,
    record_facts,
)
from seasonscapes.workflows.stage_runner import Stage, run_stages, stage_range
from seasonscapes.workflows.views import camera_for

STAGES = ("pictures", "calibrate", "albedo", "paint", "inpaint", "relight", "distil", "splat")


@dataclass(frozen=True)
class RunJob:
    """What a run is to make.

    Parameters
    ----------
    place
        The place.
    times
        Of the photographs, aware UTC, of one season.
    hours
        Of the pictures, aware UTC.
    view, size_px
        Camera of the pictures, and their size [px].
    sky
        The sky model.
    photographs
        Where photographs and poses come from.
    distil
        Size and effort of the Gaussian model.
    seed
        Equal seeds give equal results.
    allow_outside
        Let the scene file name rasters outside its folder.
    """

    place: Place
    times: tuple[datetime, ...]
    hours: tuple[datetime, ...]
    view: NamedCamera
    size_px: tuple[int, int]
    sky: SkyModel
    photographs: RunPhotographs = field(default_factory=RunPhotographs)
    distil: DistilOptions = field(default_factory=DistilOptions)
    seed: int = 0
    allow_outside: bool = False


def run(
    job: RunJob, folder: Path, *, first: str | None = None, last: str | None = None, progress: Progress | None = None
) -> dict:
    """Run the stages that are not up to date: pictures, calibrate, albedo, paint, inpaint, relight, distil, splat.

    Parameters
    ----------
    job
        What to make.
    folder
        For everything; an interrupted run continues in it.
    first, last
        Build ``first`` and all stages after it again; stop after ``last``.
    progress
        Called with a task and its finished share.

    Returns
    -------
    dict
        The record by stage: seconds, and files with their hashes.

    Raises
    ------
    SeasonscapesError
        For mistakes in the scene, the photographs or the arguments.
    """
    stages = stages_of(job, progress)
    stage_range(stages, first, last)
    return run_stages(folder, stages, first=first, last=last)


def stages_of(job: RunJob, progress: Progress | None = None) -> list[Stage]:
    """The stages of a job in order, each with the values and the code that determine its result."""
    place = job.place
    common = {
        "place": place.key,
        "imagery": _imagery(place),
        "sky": job.sky.model_dump(mode="json"),
        "seed": job.seed,
        "times": [time.isoformat() for time in job.times],
    }
    looks = {
        **common,
        "hours": [hour.isoformat() for hour in job.hours],
        "view": job.view.model_dump(mode="json"),
        "size": job.size_px,
    }
    pictures = {**common, "pictures": photograph_facts(job.photographs, place, job.times)}
    records = {**common, "records": record_facts(job.photographs, job.times)}

    def stage(
        name: str,
        inputs: dict,
        needs: tuple[str, ...],
        code: tuple[str, ...],
        build: Callable[[RunJob, Path, Progress | None], list[Path]],
        own: str | None = None,
    ) -> Stage:
        modules = tuple(f"workflows.{module}" for module in code)
        return Stage(name, inputs, needs, lambda folder: build(job, folder, progress), own or name, modules)

    return [
        stage("pictures", pictures, (), ("run_photographs",), _pictures),
        stage("calibrate", records, ("pictures",), ("run_photographs",), _calibrate, "calibration"),
        stage("albedo", common, ("pictures", "calibrate"), ("albedo_recovery", "photograph_files"), _albedo),
        stage("paint", common, ("pictures", "calibrate", "albedo"), ("painting", "predicted_radiance"), _paint),
        stage("inpaint", common, ("paint", "albedo"), ("inpainting", "completion"), _inpaint),
        stage("relight", looks, ("albedo",), ("timelapse",), _relight),
        stage("distil", {**common, "distil": job.distil}, ("albedo",), ("distillation",), _distil, "gaussians"),
        stage("splat", looks, ("distil",), ("gaussian_views",), _splat),
    ]


def _imagery(place: Place) -> list[dict]:
    """What the scene file states about its images, and the hashes of their contents."""
    return [{**image.model_dump(mode="json"), "hash": content} for image, content in place.scene.image_keys]


def _sources(folder: Path) -> PhotographSources:
    masks = folder / "pictures" / "masks"
    return PhotographSources(
        folder / "pictures" / "manifest.csv",
        folder / "calibration",
        masks if masks.is_dir() else None,
        accept_doubtful=True,  # decided where the records were brought
    )


def _albedo_path(folder: Path) -> Path:
    return folder / "albedo" / "albedo.npz"


def _albedo_files(folder: Path) -> tuple[AlbedoFile, ...]:
    path = _albedo_path(folder).resolve()
    day = albedo_date(path)
    assert day is not None, "the albedo stage states the date"
    return (AlbedoFile(day, path),)


def _write_record(path: Path, record: dict[str, Any]) -> Path:
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(record, indent=1, default=float) + "\n", encoding="utf-8")
    return path


def _pictures(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    return bring_photographs(
        job.photographs, job.place, job.times, job.sky, folder / "pictures", seed=job.seed, progress=progress
    )


def _calibrate(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    taken, own = folder / "pictures", folder / "calibration"
    return bring_poses(job.photographs, job.place, job.times, taken, own, seed=job.seed)


def _albedo(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    within = job.photographs.within_min
    photographs = photographs_at(job.place, _sources(folder), job.times, within_min=within, progress=progress)
    options = RecoveryOptions(fit_curve=True)
    recovered = recover_albedo(job.place, photographs, sky=job.sky, options=options, progress=progress)
    path = _albedo_path(folder)
    recovered.save(path)
    save_albedo_figures(job.place, recovered, path)
    observations = [photograph.observation for photograph in recovered.photographs]
    residuals = [
        {"webcam": each.webcam, "time_utc": each.time.isoformat(), "residual": round(float(residual), 4)}
        for each, residual in zip(observations, recovered.fit.residual, strict=True)
    ]
    facts = {"measured_share": float((recovered.estimate.source == 1).mean()), **recovered.facts}
    _write_record(path.with_suffix(".json"), facts | {"photographs": residuals})
    return [path]


def _paint(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    from seasonscapes.texturing.painting_file import save_painting, write_figures
    from seasonscapes.texturing.radiometric_fit import RadiometricReference

    files = []
    for time in job.times:
        own = folder / "paint" / time_stamp(time)
        predicted = measured_radiance(job.place, _albedo_path(folder), time, job.sky, progress=progress)
        painting = painting_of(
            job.place,
            _sources(folder),
            time,
            job.sky,
            PaintOptions(),
            within_min=job.photographs.within_min,
            reference=RadiometricReference(predicted, RELATIVE_SIGMA),
            progress=progress,
        )
        with atomic_path(own / "painted.npz") as temporary:
            save_painting(painting, temporary)
        write_figures(painting, own)
        _write_record(own / "painting.json", painting_record(painting))
        files.append(own / "painted.npz")
    return files


def _inpaint(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    files = []
    options = InpaintOptions(albedo=_albedo_path(folder), fast=True, seed=job.seed)
    for time in job.times:
        own = folder / "inpaint" / time_stamp(time)
        painted = completion.read_painted(folder / "paint" / time_stamp(time) / "painted.npz", job.place)
        result = inpaint(job.place, painted, time, job.sky, options, progress=progress)
        with atomic_path(own / "completed.npz") as temporary:
            completion.save_completed(result.completed, painted, temporary)
        completion.save_texture_figures(own, job.place, result.completed, time, job.sky)
        _write_record(own / "completion.json", result.record)
        files.append(own / "completed.npz")
    return files


def _relight(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    place = job.place
    hours = list(job.hours)
    render_job = RenderJob(
        place.path.resolve(),
        place.workspace.folder.resolve(),
        place.options,
        job.view,
        job.size_px,
        job.sky,
        albedo=_albedo_files(folder),
        base_day=timelapse.base_day_of(hours),
        seed=job.seed,
        allow_outside=job.allow_outside,
    )
    look = timelapse.FilmLook(smooth_s=0.0)
    return timelapse.make_film(render_job, hours, folder / "relight", look, place=place, progress=progress)[0]


def _distil(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    from seasonscapes.gaussians.model import save_model

    own = folder / "gaussians"
    own.mkdir(parents=True, exist_ok=True)
    checkpoint = own / "model.checkpoint.safetensors"
    distilled = distil_with_data(
        job.place,
        sky=job.sky,
        albedo=dated_albedos(job.place, _albedo_files(folder)),
        options=job.distil,
        seed=job.seed,
        checkpoint=checkpoint,
        progress=progress,
    )
    save_model(distilled.model, own / "model.safetensors")
    checkpoint.unlink(missing_ok=True)
    _write_record(own / "distillation.json", distillation_record(job.place, distilled))
    return [own / "model.safetensors"]


def _splat(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    from seasonscapes.gaussians.model import load_model

    own, paths = folder / "splat", []
    model = load_model(folder / "gaussians" / "model.safetensors")
    camera = camera_for(job.place, job.view, size_px=job.size_px)
    for hour in _unique(job.hours):
        view = render_gaussians(model, job.place, camera, hour, sky=job.sky)
        ev100 = exposure_ev100(view.radiance, look="photo")
        record = {
            "scene": job.place.scene.name,
            "camera": job.view.name,
            "time_utc": hour.isoformat(),
            "exposure_ev100": round(float(ev100), 3),
            "attribution": job.place.scene.attribution,
        }
        paths.append(own / f"{time_stamp(hour)}.png")
        write_png(paths[-1], develop(view, exposure=ev100), metadata={"seasonscapes": json.dumps(record)})
    return paths


def _unique(times: Sequence[datetime]) -> list[datetime]:
    return sorted(set(times))
