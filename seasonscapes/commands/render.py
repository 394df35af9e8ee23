"""``seasonscapes render``."""

from __future__ import annotations

import json as json_module
import time as clock
from datetime import UTC
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from seasonscapes import __version__
from seasonscapes.commands.options import PlaceOptions, SkyOptions, ViewOptions
from seasonscapes.commands.talk import check_range, check_suffix, finish, progress_bar, say
from seasonscapes.commands.timelapse import check_season, parse_dated
from seasonscapes.scene import NamedCamera


def render(
    scene: str,
    *,
    time: str,
    view: ViewOptions | None = None,
    sky: SkyOptions | None = None,
    albedo: list[str] | None = None,
    season: str = "blended",
    spp: int = 32,
    max_depth: int = 6,
    exposure: str = "auto",
    seed: int = 0,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/render.png"),
    place: PlaceOptions | None = None,
    device: str = "auto",
    json: bool = False,
) -> None:
    """Render a view of a place at a date and hour, with the sun where it truly stood.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    time
        ISO 8601, such as 2024-09-01T12:00. Without an offset it is civil time at the camera.
    albedo
        DATE=FILE.npz, may be repeated: recovered albedos of a date instead of the scene's own colours.
    season
        Which of them clothe the time: blended, nearest or snow-line, as of timelapse.
    spp
        Samples per pixel; powers of two are best.
    max_depth
        Longest light path; 2 is direct light only.
    exposure
        auto (a camera), eye (a person who has adapted), or an exposure value EV100 (15 is a sunny day).
    seed
        Equal seeds give equal pictures.
    output
        A .png picture, or an .exr with all layers.
    device
        auto, cuda, llvm or scalar.
    json
        Print one machine-readable record.
    """
    view, sky, place = view or ViewOptions(), sky or SkyOptions(), place or PlaceOptions()
    start = clock.perf_counter()
    check_suffix(output, (".png", ".exr"))
    check_range("--spp", spp, 1, 1 << 20)
    check_range("--max-depth", max_depth, 2, 1000)
    check_range("--seed", seed, 0, 2**32)
    from seasonscapes.civil_time import resolve_time
    from seasonscapes.daylight import light_for
    from seasonscapes.exposure import develop, exposure_ev100, parse_exposure
    from seasonscapes.images import write_png
    from seasonscapes.pipeline import albedo_for, albedo_of_day, dated_albedos
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.rendering.mitsuba_scene import build_scene
    from seasonscapes.rendering.radiance import render_view
    from seasonscapes.workspace import content_key

    metering, size_px, model = parse_exposure(exposure), view.size_px(), sky.model()
    check_season(season)
    given = [parse_dated(text) for text in albedo or ()]
    backend = use_backend(device)
    land = place.load(scene)
    chosen = view.chosen(land.scene)
    camera = view.pinhole(land)
    moment = resolve_time(time, chosen.latitude_deg, chosen.longitude_deg)
    say(moment.reading)
    light, instant = light_for(land, camera, model, moment.utc)
    sun = {"azimuth_deg": float(instant.sun.azimuth_deg), "elevation_deg": float(instant.sun.elevation_deg)}
    say(f"sun at azimuth {sun['azimuth_deg']:.2f}°, elevation {sun['elevation_deg']:.2f}° (refracted)")
    dated = dated_albedos(land, given) if given else []
    colours = albedo_of_day(land, dated, moment.utc.date(), season=season) if dated else albedo_for(land, moment.utc)
    with progress_bar("path tracing") as progress:
        picture = render_view(
            build_scene(land.terrain, colours.values, light),
            camera,
            spp=spp,
            seed=seed,
            max_depth=max_depth,
            progress=progress,
        )
    ev100 = exposure_ev100(picture.radiance, metering)
    record: dict[str, Any] = {
        "output": str(output),
        "scene": land.scene.name,
        "camera": chosen.name,
        "time_utc": moment.utc.astimezone(UTC).isoformat(),
        "time_reading": moment.reading,
        "sun": sun,
        "sky": light.model,
        "albedo": [{"date": each.day.isoformat(), "content": each.content} for each in dated],
        "season": season,
        "exposure_ev100": round(ev100, 3),
        "size_px": list(size_px),
        "spp": spp,
        "max_depth": max_depth,
        "seed": seed,
        "variant": backend.variant,
        "attribution": land.scene.attribution,
        "scene_key": content_key(land.key),
        "seasonscapes": __version__,
    }
    if output.suffix.lower() == ".png":
        metadata = {"seasonscapes": json_module.dumps(record), "Copyright": land.scene.attribution}
        write_png(output, develop(picture.radiance, ev100, eye=metering == "eye"), metadata=metadata)
    else:
        save_layers(output, land, camera, chosen, picture, colours, record)
    record["seconds"] = round(clock.perf_counter() - start, 2)
    finish(
        record,
        [
            f"{output}  ({size_px[0]} × {size_px[1]}, {spp} samples per pixel, EV {ev100:.1f}, "
            f"{record['seconds']} s, {backend.variant})"
        ],
        as_json=json,
    )


def save_layers(path: Path, place, pinhole, view: NamedCamera, picture, albedo, record: dict) -> None:
    """One OpenEXR file: beauty, surface, coverage, depth, position, normal, UV and albedo, with everything about them."""
    import numpy as np

    from seasonscapes.images import write_exr
    from seasonscapes.pipeline import camera_geodetic
    from seasonscapes.terrain.surface import sample_texture

    gbuffer = picture.gbuffer
    latitude, longitude, height = camera_geodetic(place, pinhole)
    intrinsics = [[pinhole.fx, 0.0, pinhole.cx], [0.0, pinhole.fy, pinhole.cy], [0.0, 0.0, 1.0]]
    header = {
        "capDate": record["time_utc"][:19].replace("-", ":").replace("T", " "),
        "utcOffset": 0.0,
        "latitude": latitude,
        "longitude": longitude,
        "altitude": height,
        "seasonscapes:provenance": record,
        "seasonscapes:gps": {"latitude_deg": latitude, "longitude_deg": longitude, "height_m": height},
        "seasonscapes:frame": place.frame.__dict__,
        "seasonscapes:world_from_camera": pinhole.world_from_camera.tolist(),
        "seasonscapes:intrinsics": intrinsics,
        "seasonscapes:view": view.model_dump(),
        "seasonscapes:units": "cd/m2, photometric linear Rec.709; depth is distance along the ray in m",
    }
    layers = {
        "": picture.radiance,
        "surface": picture.surface,
        "alpha": picture.coverage,
        "depth": gbuffer.depth,
        "position": gbuffer.position,
        "normal": gbuffer.normal,
        "uv": np.nan_to_num(gbuffer.uv, nan=-1.0),
        "albedo": sample_texture(albedo.values, gbuffer.uv),
    }
    write_exr(path, layers, header=header)
