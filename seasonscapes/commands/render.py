"""``seasonscapes render``."""

from __future__ import annotations

import json as json_module
import time as clock
from datetime import UTC
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from seasonscapes import __version__
from seasonscapes.commands.talk import finish, parse_at, parse_size, progress_bar, say
from seasonscapes.declaration import InputError
from seasonscapes.scene import NamedCamera


def render(
    scene: str,
    *,
    time: str,
    camera: str | None = None,
    at: str | None = None,
    heading: float | None = None,
    pitch: float = 0.0,
    fov: float = 60.0,
    size: str = "1536x1024",
    spp: int = 64,
    max_depth: int = 6,
    sky: str = "clear",
    turbidity: float | None = None,
    visibility_km: float | None = None,
    ozone_du: float | None = None,
    cloudiness: float | None = None,
    exposure: str = "auto",
    seed: int = 0,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/render.png"),
    mesher: str = "adaptive",
    max_error_m: float | None = None,
    refine: int | None = None,
    atlas: str = "planar",
    texel_m: float | None = None,
    device: str = "auto",
    workspace: Path | None = None,
    allow_outside: bool = False,
    json: bool = False,
) -> None:
    """Render a view of a place at a date and hour, with the sun where it truly stood.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    time
        ISO 8601, such as 2024-09-01T12:00. Without an offset it is civil time at the camera.
    camera
        A camera that the scene names; the first one when left out.
    at
        A place of your own instead: LAT,LON or LAT,LON,HEIGHT or LAT,LON,+ABOVE_GROUND.
    heading, pitch, fov
        Of --at: azimuth clockwise from north, elevation, horizontal field of view, in degrees.
    size
        WIDTHxHEIGHT in pixels.
    spp
        Samples per pixel.
    max_depth
        Longest light path; 2 is direct light only.
    sky
        A sky model's name (clear, alpine_winter, hazy, saharan_dust, overcast, hosek) or file.
    turbidity, visibility_km, ozone_du
        Replace the model's haze (turbidity 1 is pure air, 3 clear, 6 hazy; or how far one sees) and ozone column.
    cloudiness
        Share of the sky that clouds cover, 0 to 1.
    exposure
        auto (a camera), eye (a person who has adapted), or an exposure value EV100 (15 is a sunny day).
    seed
        Equal seeds give equal pictures.
    output
        A .png picture, or an .exr with all layers.
    mesher, max_error_m, refine, atlas, texel_m
        How to build the terrain; see `seasonscapes terrain`.
    device
        auto, cuda, llvm or scalar.
    workspace
        Folder for built artefacts; default SEASONSCAPES_WORKSPACE or the user's cache.
    allow_outside
        Let the scene file name data outside its folder.
    json
        Print one machine-readable record.
    """
    start = clock.perf_counter()
    suffix = output.suffix.lower()
    if suffix not in (".png", ".exr"):
        raise InputError(
            "--output", "unknown kind of picture", got=str(output), expected="a name that ends in .png or .exr"
        )
    from seasonscapes.exposure import develop, exposure_ev100, parse_exposure

    metering = parse_exposure(exposure)
    size_px = parse_size(size)
    for name, value, low, high in (
        ("--spp", spp, 1, 1 << 20),
        ("--max-depth", max_depth, 2, 1000),
        ("--seed", seed, 0, 2**32),
    ):
        if not low <= value <= high:
            raise InputError(name, "out of range", got=value, expected=f"{low} to {high}")

    from seasonscapes.civil_time import resolve_time
    from seasonscapes.daylight import light_for
    from seasonscapes.images import write_png
    from seasonscapes.pipeline import MeshOptions, albedo_for, camera_for, find_scene, load_place
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.rendering.radiance import render_view
    from seasonscapes.rendering.scene import build_scene
    from seasonscapes.sky.models import read_sky_model, with_overrides
    from seasonscapes.workspace import Workspace, default_workspace

    model = with_overrides(read_sky_model(sky), turbidity=turbidity, visibility_km=visibility_km, ozone_du=ozone_du,
                           cloudiness=cloudiness)  # fmt: skip
    backend = use_backend(device)
    place = load_place(find_scene(scene), Workspace(workspace) if workspace else default_workspace(),
                       options=MeshOptions(mesher, max_error_m, refine, atlas, texel_m), allow_outside=allow_outside)  # fmt: skip
    view = chosen_view(place.scene, camera, at, heading, pitch, fov)
    moment = resolve_time(time, view.latitude_deg, view.longitude_deg)
    say(moment.reading)
    pinhole = camera_for(place, view, size_px=size_px, where="--at" if at else "--camera")
    light, instant = light_for(place, pinhole, model, moment.utc)
    sun = {"azimuth_deg": float(instant.sun.azimuth_deg), "elevation_deg": float(instant.sun.elevation_deg)}
    say(f"sun at azimuth {sun['azimuth_deg']:.2f}°, elevation {sun['elevation_deg']:.2f}° (refracted)")
    albedo = albedo_for(place, moment.utc)
    built = build_scene(place.terrain, albedo.values, light)
    with progress_bar("path tracing") as progress:
        picture = render_view(built, pinhole, spp=spp, seed=seed, max_depth=max_depth, progress=progress)
    chosen_ev = exposure_ev100(picture.radiance, metering)
    record: dict[str, Any] = {
        "output": str(output),
        "scene": place.scene.name,
        "camera": view.name,
        "time_utc": moment.utc.astimezone(UTC).isoformat(),
        "time_reading": moment.reading,
        "sun": sun,
        "sky": light.model,
        "exposure_ev100": round(chosen_ev, 3),
        "size_px": list(size_px),
        "spp": spp,
        "max_depth": max_depth,
        "seed": seed,
        "variant": backend.variant,
        "attribution": place.scene.attribution,
        "seasonscapes": __version__,
    }
    if suffix == ".png":
        metadata = {"seasonscapes": json_module.dumps(record), "Copyright": place.scene.attribution}
        write_png(output, develop(picture.radiance, chosen_ev, eye=metering == "eye"), metadata=metadata)
    else:
        save_layers(output, place, pinhole, view, picture, albedo, record)
    record["seconds"] = round(clock.perf_counter() - start, 2)
    finish(record, [f"{output}  ({size_px[0]} × {size_px[1]}, {spp} samples per pixel, EV {chosen_ev:.1f}, "
                    f"{record['seconds']} s, {backend.variant})"], as_json=json)  # fmt: skip


def chosen_view(
    scene, camera: str | None, at: str | None, heading: float | None, pitch: float, fov: float
) -> NamedCamera:
    """The scene's camera of that name, or the view that ``--at`` describes."""
    if at is None:
        if heading is not None:
            raise InputError("--heading", "goes with --at", cure="name a place with --at LAT,LON,+ABOVE_GROUND")
        return scene.camera(camera)
    if camera is not None:
        raise InputError("--camera", "and --at name two views", cure="drop one of them")
    if heading is None:
        raise InputError("--heading", "missing", expected="the azimuth to look at, clockwise from north, in degrees")
    for name, value, low, high in (
        ("--heading", heading, -360.0, 360.0),
        ("--pitch", pitch, -90.0, 90.0),
        ("--fov", fov, 1.0, 169.0),
    ):
        if not low <= value <= high:
            raise InputError(name, "out of range", got=value, expected=f"{low:g} to {high:g} degrees")
    latitude, longitude, height, above = parse_at(at)
    return NamedCamera(name="at", latitude_deg=latitude, longitude_deg=longitude, height_m=height, above_ground_m=above,
                       heading_deg=heading, pitch_deg=pitch, fov_deg=fov)  # fmt: skip


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
