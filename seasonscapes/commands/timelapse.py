"""``seasonscapes timelapse``."""

from __future__ import annotations

import time as clock
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_range, parse_albedo, parse_duration
from seasonscapes.commands.console import print_result, progress_bars
from seasonscapes.commands.look_options import LookOptions
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_file_or_folder
from seasonscapes.commands.timelapse_path import film_path
from seasonscapes.commands.view_options import ViewOptions
from seasonscapes.commands.when_options import WhenOptions
from seasonscapes.commands.work_options import WorkOptions
from seasonscapes.errors import InputError


def timelapse_command(
    scene: str,
    *,
    when: WhenOptions | None = None,
    path: Path | None = None,
    view: ViewOptions | None = None,
    sky: SkyOptions | None = None,
    season: str | None = None,
    albedo: list[str] | None = None,
    look: LookOptions | None = None,
    smooth: str = "15min",
    fps: float = 24.0,
    exr: bool = False,
    keep_frames: bool = False,
    seed: int = 0,
    amplify: bool = False,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/timelapse.mp4"),
    work: WorkOptions | None = None,
    place: PlaceOptions | None = None,
    device: str = "auto",
    json: bool = False,
) -> None:
    """Film a view through hours or seasons: light transport is traced once, each frame then takes a fraction of a second.

    Frames that exist already are kept: an interrupted film continues, and a longer one reuses them.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    path
        A path of `seasonscapes path`: its views are path-traced, at one hour of --times, at one for each view, or from
        --from to --to.
    season
        Between dated albedos: blended (linear, default), nearest, or snow-line (the snow line moves place by place).
    albedo
        DATE=FILE, may be repeated: albedos of a date instead of the scene's own (.npz; or .png, .exr, .glb of this atlas).
    smooth
        Time constant of the exposure; 0s exposes each frame by itself.
    fps
        Frames per second of the film.
    exr
        Also write every frame as OpenEXR, absolute and in full precision, into the output folder.
    keep_frames
        Leave the undeveloped frames in the workspace when the film is done.
    seed
        Equal seeds give equal pictures.
    amplify
        Add relief and albedo below the resolution of the data, as of render.
    output
        A .mp4 film, or a folder for .png frames.
    device
        auto, cuda or llvm.
    json
        Print one machine-readable record.
    """
    start = clock.perf_counter()
    when, view, sky = when or WhenOptions(), view or ViewOptions(), sky or SkyOptions()
    work, place, look = work or WorkOptions(), place or PlaceOptions(), look or LookOptions()
    from seasonscapes.scene import read_scene
    from seasonscapes.workflows import timelapse as films
    from seasonscapes.workflows.albedo_sources import require_season
    from seasonscapes.workflows.place import find_scene
    from seasonscapes.workflows.relight_session import RenderJob

    smooth_s = 0.0 if smooth in ("0", "0s") else parse_duration("--smooth", smooth).total_seconds()
    film_look = films.FilmLook(look.metering(), smooth_s, fps, look.look, look.white_balance)
    require_season(season or "blended", where="--season")
    if output.suffix.lower() not in (".mp4", ""):
        expected = "a name that ends in .mp4, or a folder"
        raise InputError("--output", "unknown kind of film", got=str(output), expected=expected)
    if output.suffix and exr:
        raise InputError("--exr", "wants a folder to write to", cure="give a folder as --output")
    check_file_or_folder(output)
    check_range("--fps", fps, 0.1, 240.0)
    check_range("--seed", seed, 0, 2**32)
    work.check_cluster()
    part, file = work.part(), find_scene(scene)
    declared = read_scene(file, allow_outside=place.allow_outside)
    if season is not None and len(albedo or declared.images) < 2:
        raise InputError("--season", "does nothing without albedos of two dates", got=season, cure="add --albedo")
    if path is not None:
        how: dict[str, Any] = {
            "when": when,
            "place": place,
            "sky": sky.model(),
            "albedo": albedo,
            "season": season,
            "seed": seed,
            "amplify": amplify,
        }
        film_path(scene, path, output, film_look, **how, device=device, as_json=json)
        return
    chosen = view.chosen(declared)
    times = when.instants(chosen.latitude_deg, chosen.longitude_deg)
    files = tuple(parse_albedo(text) for text in albedo or ())
    job = RenderJob(
        file.resolve(),
        place.folder().folder.resolve(),
        place.mesh(albedo=[each.path for each in files]),
        chosen,
        view.size_px(),
        sky.model(),
        albedo=files,
        season=season or "blended",
        base_day=films.base_day_of(times),
        seed=seed,
        device=device,
        allow_outside=place.allow_outside,
        amplify=amplify,
    )
    chosen_times = times if part is None else films.shard(times, *part)
    where: dict[str, Any] = {"cluster": work.cluster, "exr_folder": output.resolve() if exr else None}
    with progress_bars() as progress:
        if part is not None:
            rendered = films.render_frames(job, chosen_times, **where, progress=progress)
        else:
            rendered = films.make_film(
                job, times, output, film_look, **where, keep_frames=keep_frames, progress=progress
            )[1]
    record = {"scene": scene, "camera": chosen.name, "frames": len(chosen_times), "rendered": rendered}
    record |= {"output": str(output)} if part is None else {}
    record["seconds"] = round(clock.perf_counter() - start, 2)
    facts = f"{len(chosen_times)} frames, {rendered} rendered now, {record['seconds']} s"
    print_result(record, [f"{record.get('output', f'shard {work.shard}')}  ({facts})"], as_json=json)
