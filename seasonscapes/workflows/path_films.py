"""Films of a camera path under the sun of any hours: each view is path-traced and kept, then all are exposed together."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.exposure import develop, exposure_ev100, photo_ev100
from seasonscapes.progress import Progress, each_reported
from seasonscapes.relighting.frame_file import frame_header, is_whole_frame, load_frame, save_frame
from seasonscapes.sky.models import SkyModel
from seasonscapes.workflows.albedo_sources import AlbedoSource
from seasonscapes.workflows.pictures import balance_rgb
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.timelapse import FilmLook
from seasonscapes.workflows.view_rendering import render
from seasonscapes.workspace import artefact_key, file_hash

if TYPE_CHECKING:
    from seasonscapes.rendering.radiance import RenderedView

# Over so many seconds of the film the exposure follows, as a cameraman's would.
_FOLLOWS_S = 1.0


def hours_of_views(times: Sequence[datetime], count: int) -> list[datetime]:
    """The hour of each of ``count`` views: one for all, one for each, or spread evenly from the first of two to the second.

    Raises
    ------
    InputError
        For another number of hours.
    """
    if len(times) == count:
        return list(times)
    if len(times) == 1:
        return [times[0]] * count
    if len(times) == 2:
        span = times[1] - times[0]
        return [times[0] + span * (number / (count - 1)) for number in range(count)]
    raise InputError("--times", "does not fit the path", got=f"{len(times)} hours", expected=f"1, 2 or {count} hours")


def film_along(
    place: Place,
    path: Path,
    times: Sequence[datetime],
    output: Path,
    look: FilmLook,
    *,
    sky: SkyModel,
    albedo: AlbedoSource = None,
    albedo_key: Sequence[str] = (),
    spp: int = 32,
    seed: int = 0,
    amplify: bool = False,
    progress: Progress | None = None,
) -> tuple[int, int]:
    """Film a path of cameras; an interrupted film continues.

    Parameters
    ----------
    place
        The place.
    path
        A ``.json`` of ``seasonscapes path``.
    times
        Hours, see `hours_of_views`.
    output
        A ``.mp4``, or a folder for ``.png`` frames.
    look
        Exposure, white balance and frames per second; its smoothing is not used.
    sky, albedo
        As of `render`.
    albedo_key
        Contents of the albedo, for the name of the kept frames.
    spp
        Samples per pixel.
    seed
        Equal seeds give equal pictures.
    amplify
        As of `render`.
    progress
        Called with a task and its finished share.

    Returns
    -------
    frames, rendered
        How many frames the film has, and how many were rendered now.
    """
    from seasonscapes.cameras.path_file import load_path
    from seasonscapes.images import write_png
    from seasonscapes.relighting.film import write_video

    cameras = load_path(path, place.frame)
    hours = hours_of_views(times, len(cameras))
    inputs = {
        "place": place.key,
        "path": file_hash(path),
        "sky": sky,
        "albedo": list(albedo_key),
        "spp": spp,
        "seed": seed,
        "amplified": amplify,
    }
    inputs |= {"images": place.scene.image_keys}
    folder = place.workspace.folder / place.scene.name / f"path-{artefact_key(inputs, ('workflows.path_films',))}"
    files, rendered = [], 0
    views = list(zip(cameras, hours, strict=True))
    for number, (camera, hour) in enumerate(each_reported(views, len(views), progress, "frames")):
        files.append(folder / f"{number:05d}-{hour.timestamp():.0f}.exr")
        if not is_whole_frame(files[-1]):
            view = render(
                place, camera, hour, sky=sky, albedo=albedo, engine="path", spp=spp, seed=seed, amplify=amplify
            )
            _keep(view, files[-1])
            rendered += 1
    pictures = each_reported(_developed(files, look), len(files), progress, "developing")
    about = {"scene": place.scene.name, "attribution": place.scene.attribution, "sky": sky.name}
    if output.suffix.lower() == ".mp4":
        span = {"from_utc": hours[0].isoformat(), "to_utc": hours[-1].isoformat()}
        write_video(output, pictures, fps=look.fps, comment=json.dumps(about | span))
    else:
        for number, (hour, picture) in enumerate(zip(hours, pictures, strict=True)):
            record = json.dumps(about | {"time_utc": hour.isoformat()})
            write_png(output / f"{number:05d}.png", picture, metadata={"seasonscapes": record})
    return len(files), rendered


def _keep(view: RenderedView, file: Path) -> None:
    metered = exposure_ev100(view.radiance, "auto")
    record = {"white_rgb": view.provenance["white_rgb"], "photo_ev100": photo_ev100(view.radiance, metered)}
    save_frame(file, view.radiance, metered_ev100=metered, provenance=record)


def _developed(files: Sequence[Path], look: FilmLook) -> Iterator[np.ndarray]:
    """Display-linear pictures of kept frames, one at a time, whose exposure follows over a second of the film."""
    from seasonscapes.relighting.exposure_smoothing import smoothed_ev100

    headers = [frame_header(file) for file in files]
    if look.exposure == "auto":
        metered = np.array([record["photo_ev100"] if look.look == "photo" else ev for ev, record in headers])
    elif look.exposure == "eye":
        metered = np.array([exposure_ev100(load_frame(file)[0], "eye") for file in files])
    else:
        metered = np.full(len(files), float(look.exposure))
    followed = smoothed_ev100(np.arange(len(files)) / look.fps, metered, window_s=_FOLLOWS_S)
    for file, ev100, (_, record) in zip(files, followed, headers, strict=True):
        white = balance_rgb(look.white_balance, record["white_rgb"])
        yield develop(load_frame(file)[0], float(ev100), eye=look.exposure == "eye", look=look.look, white=white)
