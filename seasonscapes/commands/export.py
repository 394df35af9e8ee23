"""``seasonscapes export``."""

from __future__ import annotations

import time as clock
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from seasonscapes.commands.arguments import parse_duration, parse_time
from seasonscapes.commands.console import message, print_result, progress_bars
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_output, check_output_folder
from seasonscapes.commands.view_options import ViewOptions
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.workflows.place import Place


def export_command(
    scene: str,
    *,
    to: str,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    time: str | None = None,
    day: str | None = None,
    every: str = "30min",
    unlit: bool = False,
    albedo: Path | None = None,
    exposure: str = "auto",
    rays: int = 128,
    seed: int = 0,
    geoid_m: float | None = None,
    view: ViewOptions | None = None,
    sky: SkyOptions | None = None,
    place: PlaceOptions | None = None,
    json: bool = False,
) -> None:
    """Write a place for other programs: bare albedo, with sun and sky of an hour, or lit.

    Every file states its origin, datum, axes, colours, time and attribution.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    to
        glb, gltf, usd (an extra: pip install "seasonscapes[usd]"), 3dtiles (a folder; for Cesium), or blender (a folder
        with a script).
    output
        The file; of 3dtiles and blender a folder that is new or empty.
    time
        ISO 8601; without an offset it is civil time at the place. Adds sun, moon and sky of that instant; 3dtiles, which
        have no lights, are baked. Left out: bare albedo.
    day
        A date. Of usd: sun, moon and sky as time samples through this day. Otherwise the bare albedo of this date.
    every
        Of usd with --day: time between samples.
    unlit
        Bake the hour's light into the texture, exposed and tone-mapped, for viewers that add no light.
    albedo
        An albedo texture (.npz) to use instead of the scene's.
    exposure
        Of a baked texture: auto (a camera), eye (an adapted observer), or an exposure value EV100.
    rays
        Of baking: over the sky of each texel, a power of two.
    seed
        Of baking: equal seeds give equal textures.
    geoid_m
        Of 3dtiles: height of the vertical datum's zero above the ellipsoid in metres; default from the datum.
    json
        Print one machine-readable record.
    """
    start = clock.perf_counter()
    from seasonscapes.exposure import parse_exposure
    from seasonscapes.workflows import export_scene as exports
    from seasonscapes.workflows.albedo_sources import load_albedo
    from seasonscapes.workflows.received_light import require_rays

    require_rays(rays, where="--rays")
    how = exports.ExportOptions(unlit, parse_exposure(exposure), rays, seed, geoid_m)
    if time is not None and day is not None:
        raise InputError("--day", "and --time name two times", cure="drop one of them")
    date_of_day = None if day is None else _date(day)
    exports.require_consistent(to, time or date_of_day, how)
    if view is not None and to != "blender":
        raise InputError("--camera", "goes with --to blender", got=to)
    if exports.KINDS[to]:
        check_output(output, exports.KINDS[to])
    else:
        check_output_folder(output)
    model, options = (sky or SkyOptions()).model(), place or PlaceOptions()
    with progress_bars() as progress:
        loaded = options.load(scene, progress, albedo=() if albedo is None else (albedo,), output=output)
        when: Any = date_of_day
        if time is not None:
            when = parse_time(time, loaded.frame.latitude_deg, loaded.frame.longitude_deg)
        elif date_of_day is not None and to == "usd":
            when = exports.day_instants(loaded, date_of_day, parse_duration("--every", every))
        given = None if albedo is None else load_albedo(loaded, albedo, date_of_day or (when and when.date()))
        camera = _camera(loaded, view) if to == "blender" else None
        record = exports.export_scene(
            loaded, output, to, when, sky=model, albedo=given, camera=camera, options=how, progress=progress
        )
    record["seconds"] = round(clock.perf_counter() - start, 2)
    if to == "3dtiles":
        low, high = record["undulation_m"]
        message(f"heights + {low:.2f} to {high:.2f} m = above the ellipsoid ({record['geoid']})")
    lines = [f"{output}  ({to}, {record['seconds']} s)", *(f"  {name}" for name in record["files"][1:8])]
    print_result({"output": str(output), **record}, lines, as_json=json)


def _date(text: str) -> date:
    try:
        return date.fromisoformat(text.strip())
    except ValueError:
        raise InputError("--day", "not a date", got=text, expected="YYYY-MM-DD") from None


def _camera(place: Place, view: ViewOptions | None):
    """The view asked for; the scene's first camera, if it has one, where none is."""
    if view is None and not place.scene.cameras:
        return None
    return (view or ViewOptions()).pinhole(place)
