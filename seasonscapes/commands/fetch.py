"""``seasonscapes fetch``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from seasonscapes.commands.arguments import parse_at
from seasonscapes.commands.console import print_result, progress_bars
from seasonscapes.commands.outputs import check_output
from seasonscapes.errors import InputError
from seasonscapes.open_data.requests_as_text import parse_extent, parse_interval


def fetch_command(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    at: str | None = None,
    size: str | None = None,
    elevation: str = "auto",
    imagery: str = "sentinel-2",
    date: list[str] | None = None,
    cloud: float | None = None,
    composite: str | None = None,
    stac: str | None = None,
    resolution: float | None = None,
    plan: bool = False,
    offline: bool = False,
    workspace: Path | None = None,
    json: bool = False,
) -> None:
    """Make the scene of a place from open data: heights, images, three cameras, and where all of it comes from.

    Parameters
    ----------
    output
        The scene file to write, such as scenes/place.toml; the rasters lie beside it.
    at
        LAT,LON of the centre. Files of your own tell it themselves.
    size
        Extent, such as 20km or 30x20km.
    elevation
        auto (cop-dem-glo-30), cop-dem-glo-30, cop-dem-glo-90, swissalti3d, nasadem, 3dep, or files: 'tiles/*.tif'.
    imagery
        sentinel-2, swissimage, none, or files of 8-bit colours.
    date
        Of the image: 2024-07..2024-09, a month, a day or a year; default the last whole summer. Repeated, an image for each:
        the ground at several dates.
    cloud
        Largest cloud cover of an image in percent; default 20.
    composite
        clearest (one day, whose time is kept; the default) or median (of many days, without a time).
    stac
        Another catalogue with the same collections.
    resolution
        Finest spacing of heights and pixels in metres; default as fine as the source, at most 4,096 a side.
    plan
        Print what would be loaded, and load nothing.
    offline
        Use only what was loaded before.
    workspace
        Folder in which loaded data is kept; default SEASONSCAPES_WORKSPACE or the user's cache.
    json
        Print one machine-readable record.
    """
    from seasonscapes.workflows.fetching import FetchRequest, described, fetch_place, open_data_store, plan_place
    from seasonscapes.workspace import Workspace

    check_output(output, (".toml",))
    request = FetchRequest(
        output,
        None if at is None else _centre(at),
        None if size is None else parse_extent(size),
        elevation,
        imagery,
        [parse_interval(each) for each in date or []],
        cloud,
        composite,
        stac,
        resolution,
    )
    store = open_data_store(None if workspace is None else Workspace(workspace), offline=offline)
    if plan:
        record = described(plan_place(request, store))
        print_result(record, _plan_lines(record), as_json=json)
        return
    with progress_bars() as progress:
        fetched = fetch_place(request, store, progress=progress)
    record = fetched.record | {"scene": str(fetched.scene), "loaded_bytes": fetched.loaded_bytes}
    print_result(record, _lines(record), as_json=json)


def _centre(text: str) -> tuple[float, float]:
    latitude, longitude, height_m, _ = parse_at(text)
    if height_m is not None or text.count(",") != 1:
        raise InputError("--at", "the centre of an area has no height", got=text, expected="LAT,LON")
    return latitude, longitude


def _plan_lines(record: dict[str, Any]) -> list[str]:
    lines = []
    for part, found in [("elevation", record["elevation"]), *(("imagery", each) for each in record["imagery"])]:
        days = found.get("days", [])
        count = f"{len(days)} days to choose from" if days else f"{len(found['items'])} items"
        megabytes = found["about_bytes"] / 1e6
        lines.append(f"{part:10} {found['source']}, {count}, about {megabytes:.1f} MB, every {found['spacing_m']:g} m")
        when = found.get("time") or found.get("day")
        lines += [f"{'':10} {when}"] * bool(when) + [f"{'':10} {item}" for item in found["items"]]
        lines += [
            f"{'':10} {day['time']}  {day['cloud_percent']:g} % clouds  {', '.join(day['items'])}" for day in days
        ]
        lines += [f"{'':10} {each['licence']}: {each['attribution']}" for each in found["licences"]]
    return [*lines, "nothing was loaded"]


def _lines(record: dict[str, Any]) -> list[str]:
    from seasonscapes.workflows.fetched_files import attributions

    heights = record["elevation"]
    shares = ", ".join(f"{100.0 * share:.4g} % {name}" for name, share in heights["shares"].items())
    lines = [
        f"scene      {record['scene']}",
        f"heights    {shares}; every {heights['grid']['spacing_m']:g} m, {heights['vertical_datum']}",
    ]
    for image in record["imagery"]:
        known = 100.0 * image["report"]["known_share"]
        when = image["time"] or f"{image['day'] or 'no single time'}: its light stays in"
        lines.append(f"image      {image['source']}, {when}; {known:.4g} % known")
        for other in image["report"].get("filled_from", []):
            lines.append(f"{'':10} {100.0 * other['share']:.2g} % hidden by clouds are of {other['time']}")
    return [
        *lines,
        *(f"credit     {credit}" for credit in attributions(record)),
        f"loaded     {record['loaded_bytes'] / 1e6:.1f} MB",
    ]
