"""``seasonscapes hours``."""

from __future__ import annotations

import time as clock
from pathlib import Path
from typing import Annotated, Any, cast

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_choice, check_range, parse_times
from seasonscapes.commands.console import print_result, progress_bars
from seasonscapes.commands.options import PlaceOptions
from seasonscapes.commands.outputs import check_output_folder

_SKIES = {"any": "any", "sun": "sun", "no-sun": "no sun"}


def hours_command(
    scene: str,
    *,
    at_hours: str,
    manifest: Path,
    webcam: str | None = None,
    calibrations: Path = Path("out/calibration"),
    masks: Path | None = None,
    hold_out: str | None = None,
    sky: str = "any",
    most_pixels: int = 250_000,
    doubtful_poses: bool = False,
    check_clocks: float | None = None,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/hours"),
    place: PlaceOptions | None = None,
    json: bool = False,
) -> None:
    """Learn a fixed camera's view from all its pictures, and picture it at hours that it never took.

    Reflectance and slopes are found for each pixel, and for each picture the weather, haze, exposure and response; pictures
    that these do not explain are named and count little.

    Parameters
    ----------
    scene
        A scene file with the webcam's place.
    at_hours
        Instants with commas between, or a file with one in each line; ISO 8601, without offset civil time at the place.
    manifest
        The .csv that `seasonscapes webcams --manifest` wrote.
    webcam
        Whose pictures, where the manifest lists several webcams.
    calibrations
        Folder of the records that `seasonscapes calibrate` wrote.
    masks
        Folder of WEBCAM.png, black where something stands before the landscape.
    hold_out
        Times of pictures to leave out, within a minute: to compare the result with what the camera saw.
    sky
        sun, no-sun or any: which pictures are relit; those with sun on patches of the ground alone belong to any.
    most_pixels
        Reduce larger pictures to so many pixels.
    doubtful_poses
        Use poses that their calibration called not reliable.
    check_clocks
        Tell by how many minutes each picture's clock is off, from its cast shadows; within so many minutes, 10 to 180.
    output
        A folder for WEBCAM_TIME.png of each hour, and weather.json (and clocks.json) of each picture.
    json
        Print one machine-readable record.
    """
    start = clock.perf_counter()
    options = place or PlaceOptions()
    check_output_folder(output)
    check_choice("--sky", sky, tuple(_SKIES))
    check_range("--most-pixels", most_pixels, 1_000, 10_000_000)
    from seasonscapes.workflows.photograph_files import PhotographSources
    from seasonscapes.workflows.picture_clocks import WINDOW_MIN, checkable_camera, picture_clocks, save_clocks
    from seasonscapes.workflows.unseen_hours import Sky, camera_hours, save_hours, webcam_photographs

    if check_clocks is not None:
        check_range("--check-clocks", check_clocks, *WINDOW_MIN)
    with progress_bars() as progress:
        loaded = options.load(scene, progress)
        position = (loaded.frame.latitude_deg, loaded.frame.longitude_deg)
        times = parse_times("--at-hours", at_hours, *position)
        left_out = [] if hold_out is None else parse_times("--hold-out", hold_out, *position)
        sources = PhotographSources(manifest, calibrations, masks, options.allow_outside, doubtful_poses)
        photographs = webcam_photographs(
            loaded, sources, webcam, hold_out=left_out, most_pixels=most_pixels, progress=progress
        )
        if check_clocks is not None:
            checkable_camera(photographs)  # before the long work
        hours = camera_hours(loaded, photographs, progress=progress)
        record: dict[str, Any] = save_hours(hours, times, output, sky=cast(Sky, _SKIES[sky]))
        clocks = []
        if check_clocks is not None:
            clocks = picture_clocks(loaded, photographs, window_min=check_clocks, view=hours.view, progress=progress)
            record["clocks"] = save_clocks(clocks, output / "clocks.json")
            record["files"].append(str(output / "clocks.json"))
    record["seconds"] = round(clock.perf_counter() - start, 1)
    lines = [
        f"{each['time_utc']}  {_sun(each['sun_shone'])}  direct light {each['sun']:.2f} ± {each['sun_sigma']:.2f} of a "
        f"clear sky's, visibility {each['visibility_km']:.0f} km{'' if each['explained'] else '  NOT EXPLAINED'}"
        for each in record["weather"]
    ]
    print_result(record, [*lines, *(each.told() for each in clocks), *record["files"]], as_json=json)


def _sun(shone: bool | None) -> str:
    return {True: "sun     ", False: "no sun  ", None: "sun down"}[shone]
