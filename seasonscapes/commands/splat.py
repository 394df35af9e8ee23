"""``seasonscapes splat``."""

from __future__ import annotations

import json as json_module
import time as clock
from datetime import UTC
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from seasonscapes import __version__
from seasonscapes.commands.distill import require_torch
from seasonscapes.commands.options import PlaceOptions, SkyOptions, ViewOptions
from seasonscapes.commands.talk import check_range, check_suffix, finish, say
from seasonscapes.errors import InputError


def splat(
    scene: str,
    *,
    time: str,
    model: Path = Path("out/gaussians.safetensors"),
    view: ViewOptions | None = None,
    sky: SkyOptions | None = None,
    exposure: str = "auto",
    subpixels: int = 2,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/splat.png"),
    place: PlaceOptions | None = None,
    device: str = "cpu",
    json: bool = False,
) -> None:
    """Render distilled Gaussians at any date and hour, or bake them for other programs.

    Parameters
    ----------
    scene
        The scene that the model was distilled from.
    time
        ISO 8601, such as 2024-09-01T12:00. Without an offset it is civil time at the camera.
    model
        From `seasonscapes distill`.
    exposure
        auto (a camera), eye (a person who has adapted), or an exposure value EV100 (15 is a sunny day).
    subpixels
        Samples along a pixel's side; 1 is four times as fast as 2.
    output
        A .png or .exr picture; or all Gaussians of that instant as .ply (3DGS) or .glb (KHR_gaussian_splatting).
    device
        cpu, or cuda (needs gsplat).
    json
        Print one machine-readable record.
    """
    view, sky, place = view or ViewOptions(), sky or SkyOptions(), place or PlaceOptions()
    start = clock.perf_counter()
    check_suffix(output, (".png", ".exr", ".ply", ".glb"))
    check_range("--subpixels", subpixels, 1, 4)
    if device not in ("cpu", "cuda"):
        raise InputError("--device", "unknown device", got=device, expected="cpu or cuda")
    require_torch()
    from seasonscapes.civil_time import resolve_time
    from seasonscapes.daylight import light_for
    from seasonscapes.exposure import parse_exposure
    from seasonscapes.gaussians.model import load_model
    from seasonscapes.gaussians.rasterise import choose_threads

    choose_threads(1)
    metering, size_px, declared = parse_exposure(exposure), view.size_px(), sky.model()
    splats = load_model(model)
    land = place.load(scene)
    if splats.note.get("scene") != land.scene.name:
        raise InputError(
            "--model", "was distilled from another scene", got=str(splats.note.get("scene")), expected=land.scene.name
        )
    chosen, camera = view.chosen(land.scene), view.pinhole(land)
    moment = resolve_time(time, chosen.latitude_deg, chosen.longitude_deg)
    say(moment.reading)
    light, instant = light_for(land, camera, declared, moment.utc)
    day = moment.utc.timetuple().tm_yday + moment.utc.hour / 24.0
    record: dict[str, Any] = {
        "output": str(output),
        "scene": land.scene.name,
        "gaussians": len(splats.means),
        "time_utc": moment.utc.astimezone(UTC).isoformat(),
        "sun": {"azimuth_deg": float(instant.sun.azimuth_deg), "elevation_deg": float(instant.sun.elevation_deg)},
        "seasonscapes": __version__,
    }
    if output.suffix.lower() in (".ply", ".glb"):
        write_baked(output, splats, light, day, metering, record)
    else:
        record["camera"], record["size_px"] = chosen.name, list(size_px)
        write_picture(
            output, (splats, camera, light, day), (metering, subpixels, device), land.scene.attribution, record
        )
    record["seconds"] = round(clock.perf_counter() - start, 2)
    finish(
        record,
        [
            f"{output}  ({record['gaussians']:,} Gaussians, sun at {record['sun']['elevation_deg']:.1f}°, "
            f"{record['seconds']} s)"
        ],
        as_json=json,
    )


def write_picture(output: Path, scene: tuple, how: tuple, attribution: str, record: dict[str, Any]) -> None:
    """Render and write a picture; the record tells the exposure and the milliseconds of both halves."""
    from seasonscapes.exposure import develop, exposure_ev100
    from seasonscapes.gaussians.splat_view import model_colours, render_model
    from seasonscapes.images import write_exr, write_png

    (splats, camera, light, day), (metering, subpixels, device) = scene, how
    try:
        start = clock.perf_counter()
        colours = model_colours(splats, light, day)
        record["colours_ms"] = round(1e3 * (clock.perf_counter() - start), 1)
        start = clock.perf_counter()
        picture = render_model(splats, camera, light, day, colours=colours, subpixels=subpixels, device=device)
        record["render_ms"] = round(1e3 * (clock.perf_counter() - start), 1)
    except ValueError as error:
        raise InputError("--camera", str(error)) from None
    ev100 = exposure_ev100(picture.radiance, metering)
    record["exposure_ev100"] = round(ev100, 3)
    if output.suffix.lower() == ".png":
        metadata = {"seasonscapes": json_module.dumps(record), "Copyright": attribution}
        write_png(output, develop(picture.radiance, ev100, eye=metering == "eye"), metadata=metadata)
    else:
        layers = {"": picture.radiance, "surface": picture.surface, "alpha": picture.coverage, "depth": picture.depth}
        write_exr(output, layers, header={"seasonscapes:provenance": record})


def write_baked(output: Path, splats, light, day: float, metering: str | float, record: dict[str, Any]) -> None:
    """All Gaussians of one instant in display colours, exposed for a grey card in the open unless told otherwise."""
    from seasonscapes.exposure import develop, exposure_ev100
    from seasonscapes.gaussians.interchange import BakedSplats, write_gltf, write_ply
    from seasonscapes.gaussians.splat_view import model_colours
    from seasonscapes.images import srgb_from_linear

    colours, state = model_colours(splats, light, day)
    radiance = colours * np.float32(state.global_lx / np.pi)
    card = np.full((1, 1, 3), 0.18 * state.global_lx / np.pi)
    ev100 = exposure_ev100(card, metering)
    rgb = srgb_from_linear(develop(radiance[None], ev100, eye=metering == "eye"))[0]
    baked = BakedSplats(
        splats.means, splats.quaternions, splats.log_scales, splats.opacity_logits, rgb.astype(np.float32)
    )
    record["exposure_ev100"] = round(ev100, 3)
    if output.suffix.lower() == ".ply":
        write_ply(output, baked)
    else:
        write_gltf(output, baked, note=record)
