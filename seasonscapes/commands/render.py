"""``seasonscapes render``."""

from __future__ import annotations

import time as clock
from dataclasses import replace
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_range, parse_albedo, parse_time
from seasonscapes.commands.console import print_result, progress_bars
from seasonscapes.commands.look_options import LookOptions
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_output
from seasonscapes.commands.url_options import at_address, given_address
from seasonscapes.commands.view_options import ViewOptions
from seasonscapes.errors import InputError


def render_command(
    scene: str,
    *,
    time: str | None = None,
    at_url: str | None = None,
    view: ViewOptions | None = None,
    sky: SkyOptions | None = None,
    look: LookOptions | None = None,
    albedo: list[str] | None = None,
    season: str | None = None,
    engine: str = "auto",
    spp: int | None = None,
    max_depth: int | None = None,
    seed: int = 0,
    lambertian: bool = False,
    amplify: bool = False,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/render.png"),
    place: PlaceOptions | None = None,
    device: str = "auto",
    json: bool = False,
) -> None:
    """Render a view of a place at a date and hour.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    time
        ISO 8601, such as 2024-09-01T12:00. Without an offset it is civil time at the camera.
    at_url
        Instead of --time, --camera and --at: the address of a view in the page of `seasonscapes view`, whose time, camera,
        exposure and haze it states.
    albedo
        DATE=FILE, may be repeated: albedos of a date instead of the scene's own (.npz; or .png, .exr, .glb of this atlas).
    season
        How to interpolate between dated albedos: blended (default), nearest or snow-line, as of timelapse.
    engine
        transport (light transport of the view, kept for its next picture, no grain), path (path tracing, the reference),
        or auto: path where --spp or --max-depth is given, else transport.
    spp
        Of path tracing: samples per pixel, default 32; powers of two are best.
    max_depth
        Of path tracing: longest light path, default 6; 2 is direct light only.
    seed
        Equal seeds give equal pictures.
    lambertian
        All ground is matt, also water, snow and forest: for comparison.
    amplify
        Add relief and albedo below the resolution of the data: for pictures, not for measurements.
    output
        A .png picture, or an .exr with all layers.
    device
        auto, cuda, llvm or scalar.
    json
        Print one machine-readable record.
    """
    start = clock.perf_counter()
    view, sky, look, options = (
        view or ViewOptions(),
        sky or SkyOptions(),
        look or LookOptions(),
        place or PlaceOptions(),
    )
    address = given_address(at_url, time, view, look)
    if address is not None:
        view, look = replace(view, **at_address(address)), replace(look, exposure=address.exposure)
    check_output(output, (".png", ".exr"))
    if spp is not None:
        check_range("--spp", spp, 1, 1 << 20)
    if max_depth is not None:
        check_range("--max-depth", max_depth, 2, 1000)
    check_range("--seed", seed, 0, 2**32)
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.workflows.albedo_sources import albedo_series, chosen_albedo, require_season
    from seasonscapes.workflows.pictures import png_metadata, save_exr, save_png
    from seasonscapes.workflows.view_address import hazy_sky
    from seasonscapes.workflows.view_rendering import render

    look.metering()
    size_px, model = view.size_px(), sky.model() if address is None else hazy_sky(sky.model(), address.haze)
    require_season(season or "blended", where="--season")
    files = [parse_albedo(text) for text in albedo or ()]
    use_backend(device)
    with progress_bars() as progress:
        loaded = options.load(scene, progress, albedo=[each.path for each in files], output=output)
        chosen, camera = view.chosen(loaded.scene), view.pinhole(loaded)
        utc = address.time if address else parse_time(str(time), chosen.latitude_deg, chosen.longitude_deg)
        series = albedo_series(loaded, files, season or "blended", progress=progress)
        if season is not None and (series is None or len(series.dated) < 2):
            raise InputError("--season", "does nothing without albedos of two dates", got=season, cure="add --albedo")
        texture = chosen_albedo(loaded, utc.date(), series, progress=progress)
        picture = render(
            loaded,
            camera,
            utc,
            sky=model,
            albedo=texture,
            engine=engine,
            spp=spp,
            max_depth=max_depth,
            seed=seed,
            lambertian=lambertian,
            amplify=amplify,
            progress=progress,
        )
    record = picture.provenance
    ev100 = look.ev100(picture.radiance)
    record |= {
        "camera": chosen.name,
        "albedo": [
            {"date": each.day.isoformat(), "content": each.content} for each in (series.dated if series else ())
        ],
        # Between fewer than two dates nothing is blended.
        "season": (season or "blended") if series is not None and len(series.dated) > 1 else None,
        "exposure_ev100": round(ev100, 3),
    }
    if output.suffix.lower() == ".png":
        save_png(output, look.develop(picture.radiance, ev100, record["white_rgb"]), metadata=png_metadata(record))
    else:
        save_exr(output, picture, albedo=texture, header={"seasonscapes:view": chosen.model_dump()})
    record["seconds"] = round(clock.perf_counter() - start, 2)
    how = "light transport" if record["engine"] == "transport" else f"{record['spp']} samples per pixel"
    facts = f"{how}, EV {ev100:.1f}, {record['seconds']} s, {record['variant']}"
    print_result({"output": str(output), **record}, [f"{output}  ({size_px[0]} × {size_px[1]}, {facts})"], as_json=json)
