"""Time-lapses: render frames into the workspace, here or on a cluster, then expose them together as a film."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from functools import partial
from pathlib import Path

import numpy as np

from seasonscapes import __version__
from seasonscapes.errors import InputError
from seasonscapes.exposure import develop, exposure_ev100, photo_ev100
from seasonscapes.progress import Progress, each_reported, task_progress
from seasonscapes.relighting.frame_file import (
    frame_header,
    frame_name,
    is_whole_frame,
    load_frame,
    save_frame,
    time_stamp,
)
from seasonscapes.workflows.frame_claims import frames_claimed
from seasonscapes.workflows.pictures import balance_rgb
from seasonscapes.workflows.place import Place, utc_at
from seasonscapes.workflows.relight_session import (
    RelightSession,
    RenderJob,
    open_session,
    session_key,
    session_of,
    view_at,
)
from seasonscapes.workflows.view_rendering import sun_angles
from seasonscapes.workspace import content_key

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class FilmLook:
    """How rendered frames become pictures.

    Parameters
    ----------
    exposure
        ``"auto"`` (a camera), ``"eye"`` (an adapted observer), or a fixed EV100.
    smooth_s
        Width of the temporal smoothing of the exposure [s]; 0 exposes each frame by itself.
    fps
        Frames per second of a film.
    look
        ``"photo"`` or ``"neutral"``; see `pictures.develop`.
    white_balance
        Of the look ``"photo"``: ``"sun"``, ``"daylight"`` or ``"none"``.
    """

    exposure: str | float = "auto"
    smooth_s: float = 900.0
    fps: float = 24.0
    look: str = "photo"
    white_balance: str = "sun"


def base_day_of(times: Sequence[datetime]) -> date:
    """Date of the albedo that a film's coefficients are traced with: its first day; midsummer for half a year or more."""
    return date(2024, 7, 1) if times[-1] - times[0] > timedelta(days=180) else times[0].date()


_sessions: dict[str, RelightSession] = {}


def cached_session(job: RenderJob, *, place: Place | None = None, progress: Progress | None = None) -> RelightSession:
    """Return the session of a job, kept in this process; only the last one, since a terrain is large.

    Parameters
    ----------
    job
        What to render.
    place
        The job's place, where it is loaded already.
    progress
        Called with a task and its finished share.
    """
    name = content_key({"job": job})
    if name not in _sessions:
        _sessions.clear()
        if place is None:
            _sessions[name] = open_session(job, progress=progress)
        else:
            _sessions[name] = session_of(job, place, progress=progress)
    return _sessions[name]


def frames_folder(session: RelightSession) -> Path:
    """The folder of a session's frames in the workspace; other sessions have other folders, so frames never mix."""
    place = session.place
    return place.workspace.folder / f"{place.scene.name}/frames-{session_key(session)}"


def render_frame(job: RenderJob, time: datetime, *, exr_folder: Path | None = None) -> dict:
    """Render one frame of a job into the workspace, unless it is there; see `session_frame`."""
    session = cached_session(job)
    folder = frames_folder(session)
    return session_frame(session, folder, time, camera_name=job.view.name, exr_folder=exr_folder)


def session_frame(
    session: RelightSession, folder: Path, time: datetime, *, camera_name: str = "", exr_folder: Path | None = None
) -> dict:
    """Render one frame of a session into a folder, unless it is there.

    Parameters
    ----------
    session
        The view.
    folder
        For undeveloped frames.
    time
        Aware, UTC.
    camera_name
        For the frame's record.
    exr_folder
        Also write absolute radiance in full precision there.

    Returns
    -------
    dict
        ``time_utc``, ``metered_ev100``, and ``rendered``: whether it was rendered by this call.
    """
    path = folder / frame_name(time)
    copy = None if exr_folder is None else exr_folder / frame_name(time)
    if is_whole_frame(path) and (copy is None or copy.is_file()):
        return {"time_utc": time.isoformat(), "metered_ev100": frame_header(path)[0], "rendered": False}
    view, light, position = view_at(session, time)
    metered = exposure_ev100(view.radiance, "auto")
    scene = session.place.scene
    record = {
        "time_utc": time.astimezone(UTC).isoformat(),
        "scene": scene.name,
        "camera": camera_name,
        "sun": sun_angles(position),
        "sky": light.model,
        "white_rgb": light.white_rgb,
        "photo_ev100": photo_ev100(view.radiance, metered),
        "attribution": scene.attribution,
    }
    if copy is not None:
        from seasonscapes.images import write_exr

        layers = {"": view.radiance, "alpha": view.coverage, "depth": view.gbuffer.depth}
        header = {"seasonscapes:provenance": record, "seasonscapes:units": "cd/m2"}
        write_exr(copy, layers, header=header)
    save_frame(path, view.radiance, metered_ev100=metered, provenance=record)
    return {"time_utc": time.isoformat(), "metered_ev100": metered, "rendered": True}


def render_frames(
    job: RenderJob,
    times: Sequence[datetime],
    *,
    cluster: str | None = None,
    exr_folder: Path | None = None,
    place: Place | None = None,
    progress: Progress | None = None,
) -> int:
    """Render the frames of a job that are missing in the workspace, in this process or on a cluster.

    Parameters
    ----------
    job
        What to render.
    times
        Aware UTC instants.
    cluster
        ``local:N``, ``tcp://HOST:PORT`` of a Dask scheduler, or ``slurm:FILE``; ``None`` renders in this process.
    exr_folder
        Also write every frame there in full precision.
    place
        The job's place, where it is loaded already.
    progress
        Called with a task and its finished share.

    Returns
    -------
    int
        How many frames were rendered now.

    Raises
    ------
    NoTerrainInView
        Where the camera sees no terrain.
    InputError
        For a cluster that cannot be reached.
    """
    session = cached_session(job, place=place, progress=progress)
    log.info("light transport ready: %d pixels of terrain", len(session.coefficients.pixel))
    task = partial(render_frame, job, exr_folder=exr_folder)
    if cluster is None:
        results = map(task, times)
    else:
        from seasonscapes.cluster import run_on_cluster
        from seasonscapes.workflows.illumination import tabulate_illumination

        # Once, before every worker needs them; what a damaged frame needs beside, its worker makes.
        folders = [frames_folder(session), *([] if exr_folder is None else [exr_folder])]
        missing = [time for time in times if not all((folder / frame_name(time)).is_file() for folder in folders)]
        told = task_progress(progress, "light of the sky")
        tabulate_illumination(session.place, session.camera, session.sky, missing, progress=told)
        to_render = set(missing)
        # Those that are there are checked last: every worker renders first, and no long task follows many short ones.
        results = run_on_cluster(cluster, task, [*missing, *(time for time in times if time not in to_render)])
    with _one_blas_thread():
        return sum(record["rendered"] for record in each_reported(results, len(times), progress, "frames"))


def make_film(
    job: RenderJob,
    times: Sequence[datetime],
    output: Path,
    look: FilmLook | None = None,
    *,
    cluster: str | None = None,
    exr_folder: Path | None = None,
    keep_frames: bool = False,
    place: Place | None = None,
    progress: Progress | None = None,
) -> tuple[list[Path], int]:
    """Render a job's missing frames, develop all, and remove them when the film is done; see `render_frames`.

    Frames are kept where rendering or encoding fails, and those that another process's film needs are left to it.

    Parameters
    ----------
    job, times, cluster, exr_folder, place, progress
        As in `render_frames`.
    output, look
        As in `develop_frames`.
    keep_frames
        Leave the undeveloped frames in the workspace.

    Returns
    -------
    paths, rendered
        The files written, and how many frames were rendered now.

    Raises
    ------
    NoTerrainInView, InputError
        As in `render_frames`; a film that cannot be encoded.
    """
    folder = frames_folder(cached_session(job, place=place, progress=progress))
    with frames_claimed(folder, [frame_name(time) for time in times]) as claim:
        rendered = render_frames(job, times, cluster=cluster, exr_folder=exr_folder, place=place, progress=progress)
        paths = develop_film(job, times, output, look, progress=progress)
        if not keep_frames:
            claim.sweep()
    return paths, rendered


def develop_film(
    job: RenderJob,
    times: Sequence[datetime],
    output: Path,
    look: FilmLook | None = None,
    *,
    progress: Progress | None = None,
) -> list[Path]:
    """Expose a job's rendered frames together and write them as a film or as pictures; see `develop_frames`."""
    session = cached_session(job)
    about = _about(session, job.view.name)
    return develop_frames(frames_folder(session), times, output, look or FilmLook(), about, progress=progress)


def _about(session: RelightSession, camera_name: str) -> dict:
    scene = session.place.scene
    return {
        "scene": scene.name,
        "camera": camera_name,
        "sky": session.sky.name,
        "season": session.albedo.season,
        "seed": session.seed,
        "attribution": scene.attribution,
        "seasonscapes": __version__,
    }


def develop_frames(
    folder: Path,
    times: Sequence[datetime],
    output: Path,
    look: FilmLook,
    about: dict,
    *,
    progress: Progress | None = None,
) -> list[Path]:
    """Expose rendered frames together and write them as a film or as pictures.

    Parameters
    ----------
    folder
        Of the undeveloped frames.
    times
        Their times; all of them must have been rendered.
    output
        A ``.mp4`` file, or a folder for ``.png`` pictures.
    look
        Exposure, smoothing and frame rate.
    about
        Plain values for the files.
    progress
        Called with a task and its finished share.

    Returns
    -------
    list of pathlib.Path
        The files written.
    """
    from seasonscapes.images import write_png
    from seasonscapes.relighting.film import write_video

    pictures = each_reported(developed(folder, times, look), len(times), progress, "developing")
    with _one_blas_thread():
        if output.suffix.lower() == ".mp4":
            span = {"from_utc": times[0].isoformat(), "to_utc": times[-1].isoformat()}
            write_video(output, pictures, fps=look.fps, comment=json.dumps(about | span))
            return [output]
        paths = [output / f"{time_stamp(time)}.png" for time in times]
        for time, path, picture in zip(times, paths, pictures, strict=True):
            metadata = {"seasonscapes": json.dumps(about | {"time_utc": time.isoformat()})}
            write_png(path, picture, metadata=metadata)
        return paths


def _one_blas_thread() -> AbstractContextManager[object]:
    """A frame's matrix products are small: more threads wait for them, spinning, than work on them."""
    from threadpoolctl import threadpool_limits

    return threadpool_limits(1, "blas")


def developed(folder: Path, times: Sequence[datetime], look: FilmLook) -> Iterator[np.ndarray]:
    """Display-linear pictures ``(H, W, 3)`` of rendered frames, one at a time, with smoothed exposure."""
    from seasonscapes.relighting.exposure_smoothing import smoothed_ev100

    paths = [folder / frame_name(time) for time in times]
    seconds = np.array([time.timestamp() for time in times])
    smooth_s = look.smooth_s
    headers = [frame_header(path) for path in paths]
    whites = [balance_rgb(look.white_balance, record["white_rgb"]) for _, record in headers]
    if look.exposure == "auto":
        metered = np.array([record["photo_ev100"] if look.look == "photo" else ev for ev, record in headers])
    elif look.exposure == "eye":
        metered = np.array([exposure_ev100(load_frame(path)[0], "eye") for path in paths])
    else:
        metered, smooth_s = np.full(len(paths), float(look.exposure)), 0.0
    smoothed = smoothed_ev100(seconds, metered, window_s=smooth_s)
    for path, ev100, white in zip(paths, smoothed, whites, strict=True):
        yield develop(load_frame(path)[0], float(ev100), eye=look.exposure == "eye", look=look.look, white=white)


def timelapse(
    session: RelightSession,
    times: Sequence[str | datetime],
    output: str | Path,
    *,
    look: FilmLook | None = None,
    progress: Progress | None = None,
) -> list[Path]:
    """Film a view of a place through hours or seasons.

    Each frame takes a fraction of a second. Undeveloped frames are kept in the workspace: an interrupted film
    continues, and a longer one reuses them.

    Parameters
    ----------
    session
        The view with its light transport, of `relight_session`.
    times
        Aware datetimes, or ISO 8601 text; without offset it is civil time at the place.
    output
        A ``.mp4`` film, or a folder for ``.png`` pictures.
    look
        Exposure, its smoothing and the frame rate.
    progress
        Called with a task and its finished share.

    Returns
    -------
    list of pathlib.Path
        The film, or its pictures.

    Raises
    ------
    InputError
        Without any time, or for one that is none.

    Examples
    --------
    >>> import tempfile
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> camera = ss.camera(place, "aerial", size_px=(48, 32))
    >>> session = ss.relight_session(place, camera, sky="hosek")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     pictures = ss.timelapse(session, ["2024-07-20T10:00", "2024-07-20T16:00"], folder)
    >>> [path.suffix for path in pictures]
    ['.png', '.png']
    """
    utc = sorted({utc_at(session.place, time) for time in times})
    if not utc:
        raise InputError("times", "no time in it", got=str(times))
    folder = frames_folder(session)
    with frames_claimed(folder, [frame_name(time) for time in utc]):
        with _one_blas_thread():
            for time in each_reported(utc, len(utc), progress, "frames"):
                session_frame(session, folder, time)
        return develop_frames(folder, utc, Path(output), look or FilmLook(), _about(session, ""), progress=progress)


def shard(times: Sequence[datetime], part: int, parts: int) -> list[datetime]:
    """Part ``part`` of ``parts`` (1 ≤ part ≤ parts) of a list of times: every ``parts``-th one.

    Raises
    ------
    InputError
        Where ``part`` is out of range.
    """
    if not 1 <= part <= parts:
        raise InputError("shard", "no such part", got=f"{part}/{parts}", expected="1 ≤ part ≤ parts")
    return list(times[part - 1 :: parts])
