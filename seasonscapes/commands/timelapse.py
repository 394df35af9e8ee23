"""``seasonscapes timelapse``: the light of a place moves, the place stays."""

from __future__ import annotations

import json as json_module
import re
import time as clock
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from seasonscapes.commands.options import PlaceOptions, SkyOptions, ViewOptions
from seasonscapes.commands.talk import check_range, finish, progress_bar, say
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from seasonscapes.studio import Assignment

_MOST_FRAMES = 200_000


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class WhenOptions:
    """Which instants."""

    start: Annotated[str | None, Parameter(name="--from")] = None
    """First frame, ISO 8601; without an offset it is civil time at the camera."""
    to: str | None = None
    """Last frame."""
    every: str = "10min"
    """Time between frames: a number and s, min, h or d."""
    times: str | None = None
    """Instants of your own instead: separated by commas, or a file with one in each line."""

    def instants(self, latitude_deg: float, longitude_deg: float) -> list[datetime]:
        """Aware UTC times, in order."""
        from seasonscapes.civil_time import resolve_time

        if self.times is not None:
            if self.start is not None or self.to is not None:
                raise InputError("--times", "and --from … --to name two sets of frames", cure="drop one of them")
            read = sorted({resolve_time(text, latitude_deg, longitude_deg).utc for text in _listed(self.times)})
            if not read:
                raise InputError("--times", "no time in it", got=self.times)
            return read
        if self.start is None or self.to is None:
            raise InputError("--from", "and --to are needed", cure="give both, or --times")
        first, last = (resolve_time(text, latitude_deg, longitude_deg) for text in (self.start, self.to))
        say(f"from {first.reading}")
        say(f"to {last.reading}")
        if last.utc < first.utc:
            raise InputError("--to", "lies before --from", got=self.to)
        step = parse_duration("--every", self.every)
        count = int((last.utc - first.utc) / step) + 1
        check_range("--every", count, 1, _MOST_FRAMES)
        return [first.utc + index * step for index in range(count)]


def _listed(text: str) -> list[str]:
    path = Path(text)
    if path.is_file():
        lines = (line.split("#")[0].strip() for line in path.read_text().splitlines())
        return [line for line in lines if line]
    return [part.strip() for part in text.split(",") if part.strip()]


def parse_duration(flag: str, text: str) -> timedelta:
    """``90s``, ``10min``, ``1h``, ``1d`` as a length of time."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*(s|min|m|h|d)", text.strip())
    unit = {"s": 1.0, "min": 60.0, "m": 60.0, "h": 3600.0, "d": 86400.0}
    if not match or float(match[1]) * unit[match[2]] < 1.0:
        raise InputError(
            flag,
            "not a length of time of at least a second",
            got=text,
            expected="a number and s, min, h or d, such as 10min",
        )
    return timedelta(seconds=float(match[1]) * unit[match[2]])


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class WorkOptions:
    """Who renders."""

    cluster: str | None = None
    """local:N worker processes, tcp://HOST:PORT of a Dask scheduler, or slurm:FILE."""
    shard: str | None = None
    """Only the part i/N of the frames, with no film made; any number of machines share a workspace."""


def timelapse(
    scene: str,
    *,
    when: WhenOptions | None = None,
    view: ViewOptions | None = None,
    sky: SkyOptions | None = None,
    season: str = "blended",
    albedo: list[str] | None = None,
    exposure: str = "auto",
    smooth: str = "15min",
    fps: float = 24.0,
    exr: bool = False,
    keep_frames: bool = False,
    seed: int = 0,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/timelapse.mp4"),
    work: WorkOptions | None = None,
    place: PlaceOptions | None = None,
    device: str = "auto",
    json: bool = False,
) -> None:
    """Film a view through hours or seasons: light is traced once, then every frame takes a fraction of a second.

    Frames that are there already are kept: an interrupted film goes on where it was, and a longer one starts from it.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    season
        Between dated albedos: blended (one into the next), nearest, or snow-line (snow goes place by place, by height).
    albedo
        DATE=FILE.npz, may be repeated: recovered albedos of a date instead of the scene's own colours.
    exposure
        auto (a camera), eye (a person who has adapted), or an exposure value EV100.
    smooth
        How slowly the exposure follows the light; 0s for each frame on its own.
    fps
        Frames in a second of film.
    exr
        Also write every frame as OpenEXR, absolute and in full precision, into the output folder.
    keep_frames
        Leave the undeveloped frames in the workspace when the film is done.
    seed
        Equal seeds give equal pictures.
    output
        A .mp4 film, or a folder for .png frames.
    device
        auto, cuda or llvm.
    json
        Print one machine-readable record.
    """
    start = clock.perf_counter()
    when, view, sky = when or WhenOptions(), view or ViewOptions(), sky or SkyOptions()
    work, place = work or WorkOptions(), place or PlaceOptions()
    from seasonscapes.exposure import parse_exposure
    from seasonscapes.pipeline import find_scene
    from seasonscapes.scene import read_scene
    from seasonscapes.studio import Assignment, shard

    metering, window_s = (
        parse_exposure(exposure),
        0.0 if smooth in ("0", "0s") else parse_duration("--smooth", smooth).total_seconds(),
    )
    check_season(season)
    film = output.suffix.lower() == ".mp4"
    if not film and output.suffix:
        raise InputError(
            "--output", "unknown kind of film", got=str(output), expected="a name that ends in .mp4, or a folder"
        )
    if film and exr:
        raise InputError("--exr", "wants a folder to write to", cure="give a folder as --output")
    check_range("--fps", fps, 0.1, 240.0)
    check_range("--seed", seed, 0, 2**32)
    path = find_scene(scene)
    chosen = view.chosen(read_scene(path, allow_outside=place.allow_outside))
    times = when.instants(chosen.latitude_deg, chosen.longitude_deg)
    assignment = Assignment(
        str(path.resolve()),
        str(place.folder().folder.resolve()),
        place.mesh(),
        chosen,
        view.size_px(),
        sky.model(),
        albedo=tuple(parse_dated(text) for text in albedo or ()),
        season=season,
        base_day=_base_day(times),
        seed=seed,
        device=device,
        allow_outside=place.allow_outside,
    )
    mine = times if work.shard is None else shard(times, work.shard)
    done = render_frames(assignment, mine, work, str(output.resolve()) if exr else None)
    record = {"scene": scene, "camera": chosen.name, "frames": len(mine), "rendered": done["rendered"]}
    if work.shard is None:
        develop_film(assignment, times, output, (metering, window_s, fps))
        record["output"] = str(output)
        if not keep_frames:
            _sweep(assignment, times)
    record["seconds"] = round(clock.perf_counter() - start, 2)
    finish(
        record,
        [
            f"{record.get('output', 'shard ' + str(work.shard))}  ({len(mine)} frames, {done['rendered']} rendered now, "
            f"{record['seconds']} s)"
        ],
        as_json=json,
    )


def check_season(season: str) -> None:
    """`InputError` for a way to change colours with the date that there is none of."""
    from seasonscapes.albedo.seasons import SEASONS

    if season not in SEASONS:
        raise InputError("--season", "unknown", got=season, expected=", ".join(SEASONS))


def parse_dated(text: str) -> tuple[str, str]:
    """``DATE=FILE`` as a pair."""
    day, equals, name = text.partition("=")
    if not equals or not name:
        raise InputError(
            "--albedo", "not a dated texture", got=text, expected="DATE=FILE.npz, such as 2024-07-20=summer.npz"
        )
    return day.strip(), str(Path(name.strip()).resolve())


def _base_day(times: list[datetime]) -> str:
    """The season that coefficients are traced in: that of the film's first day; midsummer for a film of half a year."""
    return "2024-07-01" if times[-1] - times[0] > timedelta(days=180) else times[0].date().isoformat()


def render_frames(assignment: Assignment, times: list[datetime], work: WorkOptions, exr_folder: str | None) -> dict:
    """Render those frames into the workspace that are missing there, here or on a cluster; how many were."""
    from seasonscapes.studio import held_studio, render_frame

    with progress_bar("light transport") as progress:
        try:
            studio = held_studio(assignment, progress=progress)
        except ValueError as error:
            if "sees no terrain" not in str(error):
                raise
            raise InputError("--camera", "sees no terrain", cure="turn it, or choose another one") from None
    say(f"light transport ready: {len(studio.coefficients.pixel)} pixels of terrain")
    rendered = 0
    with progress_bar("frames") as progress:
        if work.cluster is None:
            results: Iterator[dict] = (render_frame(assignment, time, exr_folder=exr_folder) for time in times)
        else:
            from seasonscapes.cluster import frames_on_cluster

            results = frames_on_cluster(work.cluster, assignment, times, exr_folder=exr_folder)
        for index, record in enumerate(results):
            rendered += record["rendered"]
            progress((index + 1) / len(times))
    return {"rendered": rendered}


def develop_film(assignment: Assignment, times: list[datetime], output: Path, look: tuple) -> None:
    """Expose rendered frames as one film and write it, or its pictures; ``look`` is metering, window [s] and fps."""
    from seasonscapes.images import write_png
    from seasonscapes.relighting.film import write_film
    from seasonscapes.relighting.frame_file import time_stamp

    metering, window_s, fps = look
    pictures = developed(assignment, times, metering=metering, window_s=window_s)
    with progress_bar("developing") as progress:

        def told() -> Iterator[np.ndarray]:
            for index, picture in enumerate(pictures):
                yield picture
                progress((index + 1) / len(times))

        if output.suffix.lower() == ".mp4":
            about = film_record(assignment) | {"from_utc": times[0].isoformat(), "to_utc": times[-1].isoformat()}
            write_film(output, told(), fps=fps, note=json_module.dumps(about))
            return
        for time, picture in zip(times, told(), strict=True):
            about = film_record(assignment) | {"time_utc": time.isoformat()}
            write_png(output / f"{time_stamp(time)}.png", picture, metadata={"seasonscapes": json_module.dumps(about)})


def film_record(assignment: Assignment) -> dict:
    """What a film's file says of it."""
    from seasonscapes import __version__
    from seasonscapes.studio import held_studio

    scene = held_studio(assignment).place.scene
    return {
        "scene": scene.name,
        "camera": assignment.view.name,
        "sky": assignment.model.name,
        "season": assignment.season,
        "seed": assignment.seed,
        "attribution": scene.attribution,
        "seasonscapes": __version__,
    }


def developed(
    assignment: Assignment, times: list[datetime], *, metering: str | float, window_s: float
) -> Iterator[np.ndarray]:
    """Display-linear pictures of frames that have been rendered, one at a time."""
    import numpy as np

    from seasonscapes.exposure import develop, exposure_ev100
    from seasonscapes.relighting.exposure_smoothing import smoothed_ev100
    from seasonscapes.relighting.frame_file import frame_ev100, frame_name, load_frame
    from seasonscapes.studio import held_studio

    folder = held_studio(assignment).frames
    paths = [folder / frame_name(time) for time in times]
    seconds = np.array([time.timestamp() for time in times])
    if metering == "auto":
        wanted = np.array([frame_ev100(path) for path in paths])
    elif metering == "eye":
        wanted = np.array([exposure_ev100(load_frame(path)[0], "eye") for path in paths])
    else:
        wanted, window_s = np.full(len(paths), float(metering)), 0.0
    for path, ev100 in zip(paths, smoothed_ev100(seconds, wanted, window_s=window_s), strict=True):
        yield develop(load_frame(path)[0], float(ev100), eye=metering == "eye")


def _sweep(assignment: Assignment, times: list[datetime]) -> None:
    """Remove the undeveloped frames of a film that is done."""
    from seasonscapes.relighting.frame_file import frame_name
    from seasonscapes.studio import held_studio

    folder = held_studio(assignment).frames
    for time in times:
        (folder / frame_name(time)).unlink(missing_ok=True)
    if not any(folder.iterdir()):
        folder.rmdir()
