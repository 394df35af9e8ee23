"""The full run: from photographs of a place to pictures of other hours and to Gaussians, stage by stage."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path

from seasonscapes.albedo.seasons import warn_of_unseen_seasons
from seasonscapes.exposure import exposure_ev100
from seasonscapes.images import atomic_path, write_png
from seasonscapes.progress import Progress
from seasonscapes.relighting.frame_file import time_stamp
from seasonscapes.texturing.painting import PaintOptions
from seasonscapes.workflows import completion, timelapse
from seasonscapes.workflows.albedo_sources import dated_albedos
from seasonscapes.workflows.disc_cameras import calibrated_disc_cameras
from seasonscapes.workflows.distillation import distil_with_data, distillation_record
from seasonscapes.workflows.gaussian_views import render_gaussians
from seasonscapes.workflows.inpainting import InpaintOptions, cloudiness_of, inpaint
from seasonscapes.workflows.painting import painting_of, painting_record
from seasonscapes.workflows.path_stages import (
    distil_frames,
    film_path,
    frame_view,
    load_frame_model,
    make_path,
    model_facts,
    path_completion,
    path_facts,
    point_hashes,
)
from seasonscapes.workflows.pictures import develop
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.plane_views import cut_plane_views, pose_panoramas, pose_plane_views
from seasonscapes.workflows.point_cloud import write_point_cloud
from seasonscapes.workflows.predicted_radiance import RELATIVE_SIGMA, measured_radiance
from seasonscapes.workflows.relight_session import RenderJob
from seasonscapes.workflows.run_albedo import albedo_at, final_albedos, recover_albedos, refine_albedos, sky_at
from seasonscapes.workflows.run_job import RunJob, sources_of, write_record
from seasonscapes.workflows.run_photographs import bring_photographs, bring_poses, photograph_facts, record_facts
from seasonscapes.workflows.stage_runner import Stage, run_stages, stage_range
from seasonscapes.workflows.views import camera_for

__all__ = ["AS_THE_PAPER", "STAGES", "RunJob", "run", "stages_of"]

STAGES = (
    *(
        "cloud",
        "pictures",
        "calibrate",
        "views",
        "albedo",
        "paint",
        "path",
        "inpaint",
        "refine",
        "film",
        "relight",
        "distil",
    ),
    "splat",
)

# The first photograph in order wins, as it is: no fitted exposures, no haze, no doubt about silhouettes.
AS_THE_PAPER = PaintOptions(mode="first", fit_gains=False, fit_haze=False, guard=False)


def run(
    job: RunJob, folder: Path, *, first: str | None = None, last: str | None = None, progress: Progress | None = None
) -> dict:
    """Run the stages of the job's method that are not up to date; see `STAGES` for their order.

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
        # A stated clear sky (0) and one whose clouds the photographs tell have equal values.
        "sky": {**job.sky.model_dump(mode="json"), "states_clouds": job.sky.states_clouds},
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

    method, along = job.method, job.along
    known = ("views",) if method.poses == "points" else ("pictures", "calibrate")
    albedo = ("albedo",) if method.needs_albedo else ()
    path = ("path",) if method.needs_path else ()
    model = {**common, "discs": job.distil.discs, "steps": along.paper_steps}
    final = ("albedo", "refine") if method.refines else ("albedo",)
    painted = {**common, "painting": method.painting, "foreground": method.foreground}
    refined = {**common, "recovery": method.recovery, "painted": method.painted, "inpainted": method.inpainted}
    filled = {**common, "completion": method.completion, "model": model_facts(along, method)}
    surface = {"place": place.key, "imagery": common["imagery"], "day": job.times[0].date().isoformat()}
    stages = [
        stage("cloud", surface, (), ("point_cloud",), _cloud),
        stage("pictures", pictures, (), ("run_photographs",), _pictures),
        stage(
            "calibrate",
            {**records, "poses": method.poses, "points": point_hashes(along)},
            ("pictures",),
            ("run_photographs", "plane_views"),
            _calibrate,
            "calibration",
        ),
        stage("views", {**common, "grade": method.grade}, ("pictures", "calibrate"), ("plane_views",), _views),
        stage(
            "albedo",
            {**common, "recovery": method.recovery},
            known,
            ("season_recovery", "photograph_files", "run_albedo"),
            recover_albedos,
        ),
        stage("paint", painted, (*known, *albedo), ("painting", "predicted_radiance", "run_albedo"), _paint),
        stage(
            "path",
            {"place": place.key, "size": job.size_px, **path_facts(along)},
            (),
            ("path_stages", "camera_paths"),
            _path,
        ),
        stage(
            "inpaint",
            filled,
            ("paint", *known[:1], *albedo, *path),
            ("inpainting", "completion", "run_albedo"),
            _inpaint,
        ),
        stage(
            "refine",
            refined,
            (*known, "albedo", "paint", "inpaint"),
            ("season_recovery", "run_albedo"),
            refine_albedos,
            "refined",
        ),
        stage("film", {**common, "fps": along.fps}, ("inpaint", *albedo, "path"), ("path_stages", "run_albedo"), _film),
        stage("relight", {**looks, "season": job.season}, final, ("timelapse",), _relight),
    ]
    if method.appearance == "paper":
        stages.append(stage("distil", model, ("film",), ("path_stages",), _distil_frames, "gaussians"))
        stages.append(stage("splat", looks, ("distil",), ("path_stages",), _splat_frames))
    else:
        # Discs of one size do not follow the view.
        followed = {"view": looks["view"], "size": job.size_px} if job.distil.disc_px > 0.0 else {}
        distil = {**common, "distil": job.distil, **followed}
        code = ("distillation", "disc_cameras")
        stages.append(stage("distil", distil, (*known, *final), code, _distil, "gaussians"))
        stages.append(stage("splat", looks, ("distil",), ("gaussian_views",), _splat))
    left_out = set() if method.poses == "points" else {"views"}
    left_out |= set() if place.options.mesher == "poisson" else {"cloud"}
    left_out |= set() if method.needs_albedo else {"albedo", "relight"}
    left_out |= set() if method.refines else {"refine"}
    left_out |= set() if method.needs_path else {"path", "film"}
    return [each for each in stages if each.name not in left_out]


def _imagery(place: Place) -> list[dict]:
    """What the scene file states about its images, and the hashes of their contents."""
    return [{**image.model_dump(mode="json"), "hash": content} for image, content in place.scene.image_keys]


def _cloud(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    return write_point_cloud(job.place, job.times[0].date(), folder / "cloud")


def _pictures(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    return bring_photographs(
        job.photographs, job.place, job.times, job.sky, folder / "pictures", seed=job.seed, progress=progress
    )


def _calibrate(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    taken, own = folder / "pictures", folder / "calibration"
    if job.method.poses == "points":
        stated = _stated_records(job, folder)
        kept = [] if job.photographs.sources is None else stated
        return [*kept, *pose_plane_views(job.place, stated, own, points=job.along.points, seed=job.seed)[0]]
    if job.method.poses == "joint":
        stated = _stated_records(job, folder)
        kept = [] if job.photographs.sources is None else stated
        return [*kept, *pose_panoramas(job.place, stated, own, points=job.along.points, seed=job.seed)[0]]
    return bring_poses(job.photographs, job.place, job.times, taken, own, seed=job.seed)


def _stated_records(job: RunJob, folder: Path) -> list[Path]:
    """Records of whole webcams from which plane views start: those of synthetic photographs, or copies of real ones."""
    if job.photographs.sources is None:
        return sorted((folder / "pictures").glob("*_calibration.json"))
    own = folder / "calibration" / "whole"
    copies = sorted(own.glob("*_calibration.json"))
    return copies or bring_poses(job.photographs, job.place, job.times, folder / "pictures", own, seed=job.seed)


def _views(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    stated = _stated_records(job, folder)
    return cut_plane_views(folder / "pictures", stated, folder / "views", grade=job.method.grade)


def _paint(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    from seasonscapes.texturing.painting_file import save_painting, write_figures
    from seasonscapes.texturing.radiometric_fit import RadiometricReference

    files = []
    options = PaintOptions() if job.method.painting == "weighted" else AS_THE_PAPER
    options = replace(options, foreground=job.method.foreground)
    for time in job.times:
        own = folder / "paint" / time_stamp(time)
        reference = None
        sky = sky_at(job, folder, time)
        if job.method.needs_albedo and job.method.painting == "weighted":
            predicted = measured_radiance(job.place, albedo_at(folder, time), time, sky, progress=progress)
            reference = RadiometricReference(predicted, RELATIVE_SIGMA)
        painting = painting_of(
            job.place,
            sources_of(job, folder),
            time,
            sky,
            options,
            within_min=job.photographs.within_min,
            reference=reference,
            progress=progress,
        )
        with atomic_path(own / "painted.npz") as temporary:
            save_painting(painting, temporary)
        write_figures(painting, own)
        write_record(own / "painting.json", painting_record(painting))
        files.append(own / "painted.npz")
    return files


def _path(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    return make_path(job.place, job.along, folder / "path", size_px=job.size_px)


def _inpaint_options(job: RunJob, folder: Path, time: datetime) -> InpaintOptions:
    method = job.method.completion
    albedo = albedo_at(folder, time) if job.method.needs_albedo and method in ("guided", "diffusion") else None
    if method != "diffusion":
        return InpaintOptions(method, albedo, fast=method == "guided" and albedo is None, seed=job.seed)
    along = path_completion(job.along, folder, time, sources_of(job, folder).manifest)
    # What no view of the path shows is filled from the rims, as the paper does after its loop.
    rest = "guided" if albedo is not None else "telea"
    return InpaintOptions(method, albedo, seed=job.seed, diffusion=along, rest=rest)


def _inpaint(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    files = []
    for time in job.times:
        options = _inpaint_options(job, folder, time)
        own = folder / "inpaint" / time_stamp(time)
        painted = completion.read_painted(folder / "paint" / time_stamp(time) / "painted.npz", job.place)
        sky = sky_at(job, folder, time)
        result = inpaint(job.place, painted, time, sky, options, progress=progress)
        with atomic_path(own / "completed.npz") as temporary:
            completion.save_completed(result.completed, painted, temporary)
        completion.save_texture_figures(own, job.place, result.completed, time, sky)
        write_record(own / "completion.json", result.record)
        files.append(own / "completed.npz")
    return files


def _film(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    from seasonscapes.terrain.surface import load_texture

    textures, cloudiness = [], []
    for time in sorted(set(job.times)):
        painted = completion.read_painted(folder / "paint" / time_stamp(time) / "painted.npz", job.place)
        completed = load_texture(folder / "inpaint" / time_stamp(time) / "completed.npz")
        textures.append((time, completed.values, painted.weight > 0.0))
        cloudiness.append(cloudiness_of(sky_at(job, folder, time)))
    return film_path(
        job.place, folder, textures, folder / "film", cloudiness=cloudiness, fps=job.along.fps, progress=progress
    )


def _relight(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    place = job.place
    hours = list(job.hours)
    warn_of_unseen_seasons([each.date() for each in hours], [each.date() for each in job.times])
    render_job = RenderJob(
        place.path.resolve(),
        place.workspace.folder.resolve(),
        place.options,
        job.view,
        job.size_px,
        job.sky,
        albedo=final_albedos(job, folder),
        season=job.season,
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
    # What the pictures show is as fine as they are, and what the webcams saw as fine as in pictures of that size.
    near = {"the view": camera_for(job.place, job.view, size_px=job.size_px)}
    records = sorted(sources_of(job, folder).calibrations.glob("*_calibration.json"))
    near |= calibrated_disc_cameras(job.place, records, job.size_px[0] * job.size_px[1])
    distilled = distil_with_data(
        job.place,
        sky=job.sky,
        albedo=dated_albedos(job.place, final_albedos(job, folder)),
        options=job.distil,
        near=near,
        seed=job.seed,
        checkpoint=checkpoint,
        progress=progress,
    )
    save_model(distilled.model, own / "model.safetensors")
    checkpoint.unlink(missing_ok=True)
    write_record(own / "distillation.json", distillation_record(job.place, distilled))
    return [own / "model.safetensors"]


def _distil_frames(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    from seasonscapes.gaussians.frame_appearance import save_frame_gaussians

    file = folder / "gaussians" / "frames.safetensors"
    model, losses = distil_frames(
        job.place,
        folder / "film",
        discs=job.distil.discs,
        steps=job.along.paper_steps,
        seed=job.seed,
        progress=progress,
    )
    save_frame_gaussians(model, file)
    facts = {**model.note, "gaussians": len(model.surfels.means), "times": [time.isoformat() for time in model.times]}
    # Each step sees one frame, and frames differ: means of the first and of the last tenth of the steps.
    tenth = max(len(losses) // 10, 1)
    first, last = (sum(part) / tenth for part in (losses[:tenth], losses[-tenth:]))
    record = write_record(file.with_name("distillation.json"), facts | {"loss_first": first, "loss": last})
    return [file, record]


def _splat_frames(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    model = load_frame_model(job.place, folder / "gaussians" / "frames.safetensors")
    camera, paths = camera_for(job.place, job.view, size_px=job.size_px), []
    for hour in _unique(job.hours):
        picture = frame_view(job.place, model, camera, hour, cloudiness=cloudiness_of(job.sky))
        record = {"scene": job.place.scene.name, "camera": job.view.name, "time_utc": hour.isoformat()}
        record["attribution"] = job.place.scene.attribution
        paths.append(folder / "splat" / f"{time_stamp(hour)}.png")
        write_png(paths[-1], picture, metadata={"seasonscapes": json.dumps(record)})
    return paths


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
