"""``seasonscapes run``."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from seasonscapes.commands.arguments import parse_times
from seasonscapes.commands.console import message, print_result, progress_bars
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_output_folder
from seasonscapes.commands.run_method_options import RunMethodOptions
from seasonscapes.commands.run_options import RunEffort, RunPictureOptions
from seasonscapes.commands.view_options import ViewOptions


def run_command(
    scene: str,
    *,
    times: str,
    at_hours: str,
    method: RunMethodOptions | None = None,
    pictures: RunPictureOptions | None = None,
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
    """Take a scene from photographs to pictures of other hours and to Gaussians; an interrupted run continues.

    Stages: pictures, calibrate, albedo, paint, inpaint, refine, relight, distil, splat; with --method paper cloud, pictures,
    calibrate, views, paint, path, inpaint, film, distil, splat. Each is built again only where its arguments, the content of what it
    reads or the program's code have changed; run.json in the folder records them.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    times
        When the photographs were taken: ISO 8601, commas between. Days that show the same snow and colours give one albedo;
        pictures of dates between two such seasons interpolate.
    at_hours
        When to picture the place: ISO 8601, commas between.
    start
        Build this stage and all after it again.
    until
        Stop after this stage.
    seed
        Equal seeds give equal results.
    output
        Folder for everything.
    json
        Print one machine-readable record.
    """
    check_output_folder(output)
    options, view, sky = place or PlaceOptions(), view or ViewOptions(size="768x512"), sky or SkyOptions()
    method = method or RunMethodOptions()
    stages_by, along = method.values()
    photographs, distil = (
        pictures or RunPictureOptions(),
        (effort or RunEffort()).values(appearance=stages_by.appearance),
    )
    if stages_by.name == "paper":
        # The paper's mesh and atlas, where flags name no others.
        options = replace(options, mesher=options.mesher or "poisson", atlas=options.atlas or "xatlas")
    found, model, size_px = photographs.values(allow_outside=options.allow_outside), sky.model(), view.size_px()
    from seasonscapes.workflows.albedo_recovery import TEXEL_M
    from seasonscapes.workflows.full_run import RunJob, run
    from seasonscapes.workflows.run_albedo import season_records

    with progress_bars() as progress:
        texel_m = TEXEL_M
        if found.sources is not None and stages_by.needs_albedo:
            plan = options.plan(scene, found.sources)
            message(f"plan: {plan}")
            texel_m = plan.texel_m
        loaded = options.load(scene, progress, texel_m=texel_m)
        at = (loaded.frame.latitude_deg, loaded.frame.longitude_deg)
        utc = tuple(parse_times("--times", times, *at))
        job = RunJob(
            loaded,
            utc,
            tuple(parse_times("--at-hours", at_hours, *at)),
            view.chosen(loaded.scene),
            size_px,
            model,
            found,
            distil,
            seed,
            options.allow_outside,
            stages_by,
            along,
            method.season_of(utc),
        )
        stages = run(job, output, first=start, last=until, progress=progress)
    record = {
        "output": str(output),
        "scene": loaded.scene.name,
        "stages": {name: {"seconds": entry["seconds"], "files": len(entry["files"])} for name, entry in stages.items()},
    }
    seasons = season_records(output) if "albedo" in stages else []
    if seasons:
        record["seasons"] = seasons
    lines = [f"{name:<10} {entry['seconds']:8.1f} s  {len(entry['files'])} files" for name, entry in stages.items()]
    if len(seasons) > 1:
        lines += [
            f"season     {each['day']}  {len(each['times_utc'])} instants on {', '.join(each['days'])}"
            for each in seasons
        ]
    print_result(record, [*lines, str(output)], as_json=json)
