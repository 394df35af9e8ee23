"""The albedos of a run: one for each season that its photographs show, and what paintings and completions add to them."""

from __future__ import annotations

import json
import shutil
from datetime import date, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.array_files import read_arrays
from seasonscapes.images import atomic_path
from seasonscapes.progress import Progress
from seasonscapes.relighting.frame_file import time_stamp
from seasonscapes.sky.models import SkyModel
from seasonscapes.terrain.surface import load_texture
from seasonscapes.workflows import completion
from seasonscapes.workflows.albedo_recovery import RecoveryOptions, save_albedo_figures, texel_transport
from seasonscapes.workflows.albedo_sources import AlbedoFile
from seasonscapes.workflows.illumination import illumination
from seasonscapes.workflows.photograph_files import photographs_at
from seasonscapes.workflows.recovery_methods import PaintedTexture
from seasonscapes.workflows.recovery_plan import MOST_PIXELS
from seasonscapes.workflows.run_job import RunJob, sources_of, write_record
from seasonscapes.workflows.season_recovery import SeasonAlbedo, group_of, recover_seasons

if TYPE_CHECKING:
    from seasonscapes.albedo.forward_model import TexelTransport

SEASONS_FILE = "seasons.json"


def recovery_options(job: RunJob) -> RecoveryOptions:
    """How a run recovers albedo: the webcams' tone curve is searched for before either method."""
    return RecoveryOptions(fit_curve=True, method=job.method.recovery)


def recover_albedos(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    """The stage ``albedo``: photographs grouped by season, an albedo of each group, and the record of the groups."""
    within = job.photographs.within_min
    photographs = photographs_at(
        job.place, sources_of(job, folder), job.times, within_min=within, most_pixels=MOST_PIXELS, progress=progress
    )
    seasons = recover_seasons(job.place, photographs, sky=job.sky, options=recovery_options(job), progress=progress)
    return save_seasons(job, seasons, folder / "albedo")


def save_seasons(job: RunJob, seasons: list[SeasonAlbedo], own: Path) -> list[Path]:
    """Write albedos with their figures and records, and which photographs belong to which.

    One season is written as ``albedo.npz``, several as ``albedo_DATE.npz``.
    """
    files, records = [], []
    for season in seasons:
        recovered = season.recovered
        name = "albedo.npz" if len(seasons) == 1 else f"albedo_{recovered.day.isoformat()}.npz"
        recovered.save(own / name)
        save_albedo_figures(job.place, recovered.estimate, recovered.day, own / name)
        residuals = [
            {
                "webcam": each.observation.webcam,
                "time_utc": each.observation.time.isoformat(),
                "residual": round(float(residual), 4),
                "cloudiness": each.light.cloudiness,
            }
            for each, residual in zip(recovered.photographs, recovered.fit.residual, strict=True)
        ]
        share = round(float((recovered.estimate.source == 1).mean()), 4)
        facts = {"measured_share": share, **recovered.facts, "photographs": residuals}
        records.append({"file": name, **season.record, "measured_share": share})
        files += [own / name, write_record((own / name).with_suffix(".json"), facts)]
    return [*files, write_record(own / SEASONS_FILE, records)]


def season_records(folder: Path) -> list[dict[str, Any]]:
    """The seasons that a run's albedo stage wrote down."""
    return json.loads((folder / "albedo" / SEASONS_FILE).read_text(encoding="utf-8"))


def albedo_at(folder: Path, time: datetime) -> Path:
    """The albedo of the season that the photographs of an instant belong to."""
    records = season_records(folder)
    return folder / "albedo" / records[group_of(records, time)]["file"]


def sky_at(job: RunJob, folder: Path, time: datetime) -> SkyModel:
    """The sky of an instant: the one asked for, with the clouds that the albedo stage found in each webcam's nearest photograph."""
    if job.sky.states_clouds or not job.method.needs_albedo:
        return job.sky
    file = albedo_at(folder, time).with_suffix(".json")
    photographs = json.loads(file.read_text(encoding="utf-8"))["photographs"]

    def apart(photograph: dict[str, Any]) -> float:
        return abs((datetime.fromisoformat(photograph["time_utc"]) - time).total_seconds())

    within_s = 60.0 * job.photographs.within_min
    nearest: dict[str, float] = {}
    for each in sorted(photographs, key=apart):
        if apart(each) <= within_s:
            nearest.setdefault(each["webcam"], each["cloudiness"])
    cloudiness = float(np.median(list(nearest.values()))) if nearest else 0.0
    return job.sky.model_copy(update={"cloudiness": cloudiness}) if cloudiness > 0.0 else job.sky


def refine_albedos(job: RunJob, folder: Path, progress: Progress | None) -> list[Path]:
    """The stage ``refine``: albedos with what the paintings and their completions tell, of the same seasons as before."""
    own = folder / "refined"
    records = season_records(folder)
    if job.method.painted:
        files = save_seasons(job, _recovered_again(job, folder, records, progress), own)
    else:
        files = [_copied(folder / "albedo" / record["file"], own / record["file"]) for record in records]
        files.append(write_record(own / SEASONS_FILE, records))
    if job.method.inpainted:
        transport = texel_transport(job.place, progress)
        for number, record in enumerate(records):
            times = [time for time in sorted(set(job.times)) if group_of(records, time) == number]
            _correct_unmeasured(job, folder, own / record["file"], transport, times)
    return files


def _recovered_again(
    job: RunJob, folder: Path, records: list[dict[str, Any]], progress: Progress | None
) -> list[SeasonAlbedo]:
    from seasonscapes.albedo.painted_textures import REPEATED

    within = job.photographs.within_min
    photographs = photographs_at(
        job.place, sources_of(job, folder), job.times, within_min=within, most_pixels=MOST_PIXELS, progress=progress
    )
    paintings = []
    for time in sorted(set(job.times)):
        texture = completion.read_painted(folder / "paint" / time_stamp(time) / "painted.npz", job.place)
        name, sky = f"painted {time_stamp(time)}", sky_at(job, folder, time)
        paintings.append(PaintedTexture(time, texture, name, confidence=REPEATED, sky=sky))
    return recover_seasons(
        job.place,
        photographs,
        sky=job.sky,
        options=recovery_options(job),
        painted=paintings,
        groups=[[date.fromisoformat(day) for day in record["days"]] for record in records],
        progress=progress,
    )


def _correct_unmeasured(
    job: RunJob, folder: Path, file: Path, transport: TexelTransport, times: list[datetime]
) -> None:
    """Correct the texels of an albedo file that no photograph measured by completed textures of its season, in place."""
    from seasonscapes.albedo.inpainted_albedo import ALONE, FUSED, corrected_by_inpainting
    from seasonscapes.albedo.standard_error import AlbedoEstimate

    stored = dict(read_arrays(file, what="an albedo texture"))
    completed = [load_texture(folder / "inpaint" / time_stamp(time) / "completed.npz").values for time in times]
    lights = [illumination(job.place, time, sky=sky_at(job, folder, time)) for time in times]
    # The guided method fuses with the albedo itself, so that what differs is what the paintings tell.
    share = FUSED if job.method.completion == "guided" else ALONE
    unmeasured = stored["source"] != 1
    stored["values"] = corrected_by_inpainting(transport, stored["values"], unmeasured, completed, lights, share=share)
    with atomic_path(file) as temporary, open(temporary, "wb") as output:
        np.savez_compressed(output, **stored)  # pyright: ignore[reportArgumentType]  # numpy's stub takes **arrays for allow_pickle
    known = AlbedoEstimate(stored["values"], stored["sigma"], stored["sunlit"], stored["source"])
    save_albedo_figures(job.place, known, date.fromisoformat(str(stored["date"])), file)


def _copied(file: Path, copy: Path) -> Path:
    with atomic_path(copy) as temporary:
        shutil.copyfile(file, temporary)
    return copy


def final_albedos(job: RunJob, folder: Path) -> tuple[AlbedoFile, ...]:
    """The albedos that later stages relight, with their dates: refined ones where the method refines."""
    own = folder / ("refined" if job.method.refines else "albedo")
    return tuple(
        AlbedoFile(date.fromisoformat(record["day"]), (own / record["file"]).resolve())
        for record in season_records(folder)
    )
