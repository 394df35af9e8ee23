"""``seasonscapes sky``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from seasonscapes.commands.arguments import parse_at
from seasonscapes.commands.console import message, print_result, progress_bars
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_output
from seasonscapes.errors import InputError


def sky_command(
    scene: str | None = None,
    *,
    time: str,
    at: str | None = None,
    sky: SkyOptions | None = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    place: PlaceOptions | None = None,
    json: bool = False,
) -> None:
    """Report the light of a place at an instant: sun, moon, twilight, illuminance, colour; and picture the sky dome.

    Parameters
    ----------
    scene
        A scene file or the name of a bundled scene; or give --at.
    time
        ISO 8601. Without an offset it is civil time at the place.
    at
        LAT,LON,HEIGHT instead of a scene; sea level when the height is left out.
    output
        A .png of the dome (north up, east right), or an .exr of the whole sphere.
    json
        Print one machine-readable record.
    """
    from seasonscapes.civil_time import resolve_time
    from seasonscapes.sky.report import record_lines, sky_record
    from seasonscapes.workflows.illumination import illumination_at, sun_moon_position

    options = place or PlaceOptions()
    if (scene is None) == (at is None):
        raise InputError("sky", "give either a scene or --at LAT,LON,HEIGHT", got="both" if at else "neither")
    if output is not None:
        check_output(output, (".png", ".exr"))
    model = (sky or SkyOptions()).model()
    latitude, longitude, height_m = _standpoint(scene, at, options)
    resolved = resolve_time(time, latitude, longitude)
    message(resolved.reading)
    position = sun_moon_position(resolved.utc, latitude, longitude, height_m)
    light = illumination_at(model, position, height_m, workspace=options.folder())
    record = sky_record(light, resolved.utc, position.sun, position.moon, latitude, longitude, zone=resolved.zone)
    record["place"] = {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height_m}
    if output is not None:
        from seasonscapes.images import write_exr, write_png
        from seasonscapes.sky.report import dome_picture

        if output.suffix.lower() == ".png":
            write_png(output, dome_picture(light))
        else:
            write_exr(output, {"": light.sky_radiance}, header={"seasonscapes:sky": record})
        record["output"] = str(output)
    print_result(record, record_lines(record), as_json=json)


def _standpoint(scene: str | None, at: str | None, options: PlaceOptions) -> tuple[float, float, float]:
    """Latitude, longitude [deg] and height [m] of the observer."""
    if at is None:
        with progress_bars() as progress:
            place = options.load(str(scene), progress)
        return place.frame.latitude_deg, place.frame.longitude_deg, place.median_height_m
    latitude, longitude, height, _ = parse_at(at)
    if height is None and "+" in at:
        raise InputError("--at", "without a scene there is no ground to stand above", got=at, expected="LAT,LON,HEIGHT")
    return latitude, longitude, 0.0 if height is None else height
