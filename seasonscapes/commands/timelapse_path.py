"""``seasonscapes timelapse --path``: a film along a camera path."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from seasonscapes.commands.arguments import parse_albedo
from seasonscapes.commands.console import print_result, progress_bars
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.commands.options import PlaceOptions
    from seasonscapes.commands.when_options import WhenOptions
    from seasonscapes.sky.models import SkyModel
    from seasonscapes.workflows.timelapse import FilmLook


def film_path(
    scene: str,
    path: Path,
    output: Path,
    look: FilmLook,
    *,
    when: WhenOptions,
    place: PlaceOptions,
    sky: SkyModel,
    albedo: Sequence[str] | None,
    season: str | None,
    seed: int,
    amplify: bool,
    device: str,
    as_json: bool,
) -> None:
    """Film the path at one hour, at one hour for each view, or from one hour to another."""
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.workflows.albedo_sources import albedo_series
    from seasonscapes.workflows.path_films import film_along

    if not path.is_file():
        raise InputError("--path", "no such file", got=str(path), cure="make one with `seasonscapes path`")
    start = clock.perf_counter()
    files = [parse_albedo(text) for text in albedo or ()]
    use_backend(device)
    with progress_bars() as progress:
        loaded = place.load(scene, progress, albedo=[each.path for each in files], output=output)
        at = (loaded.frame.latitude_deg, loaded.frame.longitude_deg)
        times = when.ends(*at)
        series = albedo_series(loaded, files, season or "blended", progress=progress)
        keys = [season or "blended", *(each.content for each in (series.dated if series else ()))]
        how: dict[str, Any] = {"sky": sky, "albedo": series, "albedo_key": keys, "seed": seed, "amplify": amplify}
        frames, rendered = film_along(loaded, path, times, output, look, **how, progress=progress)
    record = {"scene": scene, "path": str(path), "frames": frames, "rendered": rendered, "output": str(output)}
    record["seconds"] = round(clock.perf_counter() - start, 2)
    print_result(
        record, [f"{output}  ({frames} frames, {rendered} rendered now, {record['seconds']} s)"], as_json=as_json
    )
