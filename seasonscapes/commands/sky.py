"""``seasonscapes sky``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from seasonscapes.commands.talk import finish, parse_at, say
from seasonscapes.errors import InputError


def sky(
    scene: str | None = None,
    *,
    time: str,
    at: str | None = None,
    sky: str = "clear",
    turbidity: float | None = None,
    visibility_km: float | None = None,
    ozone_du: float | None = None,
    cloudiness: float | None = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    workspace: Path | None = None,
    allow_outside: bool = False,
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
    sky
        A sky model's name (clear, alpine_winter, hazy, saharan_dust, overcast, hosek) or file.
    turbidity, visibility_km, ozone_du, cloudiness
        Replace parts of the model.
    output
        A .png of the dome (a map of the sky: north up, east right), or an .exr of the whole sphere.
    workspace
        Folder for built artefacts; default SEASONSCAPES_WORKSPACE or the user's cache.
    allow_outside
        Let the scene file name data outside its folder.
    json
        Print one machine-readable record.
    """
    from seasonscapes.civil_time import resolve_time
    from seasonscapes.daylight import light_at, moment_at
    from seasonscapes.images import write_exr, write_png
    from seasonscapes.sky.models import read_sky_model, with_overrides
    from seasonscapes.sky.report import dome_picture, record_lines, sky_record
    from seasonscapes.workspace import Workspace, default_workspace

    if (scene is None) == (at is None):
        raise InputError("sky", "give either a scene or --at LAT,LON,HEIGHT", got="both" if at else "neither")
    if output is not None and output.suffix.lower() not in (".png", ".exr"):
        raise InputError(
            "--output", "unknown kind of picture", got=str(output), expected="a name that ends in .png or .exr"
        )
    model = with_overrides(read_sky_model(sky), turbidity=turbidity, visibility_km=visibility_km, ozone_du=ozone_du,
                           cloudiness=cloudiness)  # fmt: skip
    folder = Workspace(workspace) if workspace else default_workspace()
    latitude, longitude, height_m = _place(scene, at, folder, allow_outside)
    resolved = resolve_time(time, latitude, longitude)
    say(resolved.reading)
    moment = moment_at(resolved.utc, latitude, longitude, height_m)
    light = light_at(model, moment, height_m, workspace=folder)
    record = sky_record(light, resolved.utc, moment.sun, moment.moon, latitude, longitude, zone=resolved.zone)
    record["place"] = {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height_m}
    if output is not None:
        if output.suffix.lower() == ".png":
            write_png(output, dome_picture(light))
        else:
            write_exr(output, {"": light.sky_radiance}, header={"seasonscapes:sky": record})
        record["output"] = str(output)
    finish(record, record_lines(record), as_json=json)


def _place(scene: str | None, at: str | None, workspace, allow_outside: bool) -> tuple[float, float, float]:
    """Latitude, longitude [deg] and the height [m] at which one stands."""
    if at is not None:
        latitude, longitude, height, above = parse_at(at)
        if height is None and "+" in at:
            raise InputError(
                "--at", "without a scene there is no ground to stand above", got=at, expected="LAT,LON,HEIGHT"
            )
        return latitude, longitude, 0.0 if height is None else height
    import numpy as np

    from seasonscapes.pipeline import find_scene, load_place

    place = load_place(find_scene(scene), workspace, allow_outside=allow_outside)
    return place.frame.latitude_deg, place.frame.longitude_deg, float(np.median(place.elevation.values))
