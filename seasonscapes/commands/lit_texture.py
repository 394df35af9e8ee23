"""``seasonscapes lit-texture``."""

from __future__ import annotations

import time as clock
from datetime import UTC
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from seasonscapes.commands.arguments import parse_time
from seasonscapes.commands.console import print_result, progress_bars
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_output

if TYPE_CHECKING:
    import numpy as np

    from seasonscapes.workflows.place import Place


def lit_texture_command(
    scene: str,
    *,
    time: str,
    sky: SkyOptions | None = None,
    albedo: Path | None = None,
    exposure: str = "auto",
    rays: int = 128,
    seed: int = 0,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/lit.png"),
    place: PlaceOptions | None = None,
    device: str = "auto",
    json: bool = False,
) -> None:
    """Export a place's texture as lit at an hour: baked sun, sky and interreflection times the albedo.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    time
        ISO 8601. Without an offset it is civil time at the place.
    albedo
        An albedo texture to use instead of the scene's: .npz, or an edited .png, .exr or .glb of this scene's atlas.
    exposure
        auto (a camera), eye (an adapted observer), or an exposure value EV100; of .png and .glb.
    rays
        Over the sky of each texel, a power of two.
    seed
        Equal seeds give equal textures.
    output
        .png, the exposed texture; .glb, the textured terrain; .exr, illuminances [lx], albedo and radiance [cd/m²].
    device
        auto, cuda or llvm.
    json
        Print one machine-readable record.
    """
    start = clock.perf_counter()
    sky, options = sky or SkyOptions(), place or PlaceOptions()
    check_output(output, (".png", ".glb", ".exr"))
    from seasonscapes.exposure import develop, exposure_ev100, parse_exposure
    from seasonscapes.images import write_exr
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.workflows.albedo_sources import load_albedo
    from seasonscapes.workflows.edited_textures import texture_facts
    from seasonscapes.workflows.illumination import illumination_on_terrain
    from seasonscapes.workflows.pictures import png_metadata, save_png
    from seasonscapes.workflows.received_light import lit_texture, require_rays
    from seasonscapes.workflows.view_rendering import sun_angles

    require_rays(rays, where="--rays")
    metering, model = parse_exposure(exposure), sky.model()
    use_backend(device)
    with progress_bars() as progress:
        loaded = options.load(scene, progress, albedo=() if albedo is None else (albedo,), output=output)
        utc = parse_time(time, loaded.frame.latitude_deg, loaded.frame.longitude_deg)
        given = None if albedo is None else load_albedo(loaded, albedo, utc.date())
        lit = lit_texture(loaded, utc, sky=model, albedo=given, rays=rays, seed=seed, progress=progress)
    light, position = illumination_on_terrain(loaded, model, utc)
    record: dict[str, Any] = {
        "scene": loaded.scene.name,
        "time_utc": utc.astimezone(UTC).isoformat(),
        "sun": sun_angles(position),
        "sky": light.model,
        "attribution": loaded.scene.attribution,
        "rays": rays,
        "seed": seed,
        "texture": texture_facts(loaded, "lit", utc=utc, sky=model, rays=rays, seed=seed, tilted=lit.tilted),
    }
    if output.suffix.lower() == ".exr":
        layers = {"": lit.radiance, "sun": lit.sun, "sky": lit.sky, "bounce": lit.bounce, "albedo": lit.albedo}
        units = "radiance in cd/m2; sun, sky and bounce in lux"
        write_exr(output, layers, header={"seasonscapes:provenance": record, "seasonscapes:units": units})
    else:
        record["exposure_ev100"] = exposure_ev100(lit.radiance, metering)
        record["texture"] |= {"exposure_ev100": record["exposure_ev100"], "eye": metering == "eye"}
        picture = develop(lit.radiance, record["exposure_ev100"], eye=metering == "eye")
        if output.suffix.lower() == ".png":
            save_png(output, picture, metadata=png_metadata(record))
        else:
            _write_model(output, loaded, picture, record)
    record["seconds"] = round(clock.perf_counter() - start, 2)
    size = f"{loaded.atlas.width_px} × {loaded.atlas.height_px} texels"
    print_result({"output": str(output), **record}, [f"{output}  ({size}, {record['seconds']} s)"], as_json=json)


def _write_model(output: Path, place: Place, picture: np.ndarray, record: dict) -> None:
    from seasonscapes.export.gltf import TexturedTerrain, write_gltf
    from seasonscapes.images import srgb8_from_linear

    about = {**place.about, **record}
    write_gltf(output, TexturedTerrain(place.terrain, srgb8_from_linear(picture), lit=True, about=about))
