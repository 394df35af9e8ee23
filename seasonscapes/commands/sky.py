"""``seasonscapes sky``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.talk import check_suffix, finish, parse_at, say
from seasonscapes.errors import InputError


def sky(
    scene: str | None = None,
    *,
    time: str,
    at: str | None = None,
    sky: SkyOptions | None = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    place: PlaceOptions | None = None,
    json: bool = False,
) -> None:
    """Tell the light of a place at an instant: sun, moon, twilight, illuminance, colour; and picture the dome.

    Parameters
    ----------
    scene
        A scene file or the name of a bundled scene; or give --at.
    time
        ISO 8601. Without an offset it is civil time at the place.
    at
        LAT,LON,HEIGHT instead of a scene; sea level when the height is left out.
    output
        A .png of the dome (a map of the sky: north up, east right), or an .exr of the whole sphere.
    json
        Print one machine-readable record.
    """
    from seasonscapes.civil_time import resolve_time
    from seasonscapes.daylight import light_at, moment_at
    from seasonscapes.images import write_exr, write_png
    from seasonscapes.sky.report import dome_picture, record_lines, sky_record

    place = place or PlaceOptions()
    if (scene is None) == (at is None):
        raise InputError("sky", "give either a scene or --at LAT,LON,HEIGHT", got="both" if at else "neither")
    if output is not None:
        check_suffix(output, (".png", ".exr"))
    model = (sky or SkyOptions()).model()
    latitude, longitude, height_m = _standpoint(scene, at, place)
    resolved = resolve_time(time, latitude, longitude)
    say(resolved.reading)
    moment = moment_at(resolved.utc, latitude, longitude, height_m)
    light = light_at(model, moment, height_m, workspace=place.folder())
    record = sky_record(light, resolved.utc, moment.sun, moment.moon, latitude, longitude, zone=resolved.zone)
    record["place"] = {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height_m}
    if output is not None:
        if output.suffix.lower() == ".png":
            write_png(output, dome_picture(light))
        else:
            write_exr(output, {"": light.sky_radiance}, header={"seasonscapes:sky": record})
        record["output"] = str(output)
    finish(record, record_lines(record), as_json=json)


def _standpoint(scene: str | None, at: str | None, place: PlaceOptions) -> tuple[float, float, float]:
    """Latitude, longitude [deg] and the height [m] at which one stands."""
    if at is None:
        from seasonscapes.daylight import median_height_m

        land = place.load(str(scene))
        return land.frame.latitude_deg, land.frame.longitude_deg, median_height_m(land)
    latitude, longitude, height, _ = parse_at(at)
    if height is None and "+" in at:
        raise InputError("--at", "without a scene there is no ground to stand above", got=at, expected="LAT,LON,HEIGHT")
    return latitude, longitude, 0.0 if height is None else height
