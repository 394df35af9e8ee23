"""``seasonscapes splat``."""

from __future__ import annotations

import time as clock
from datetime import UTC
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from seasonscapes import __version__
from seasonscapes.commands.arguments import check_choice, check_range, parse_time
from seasonscapes.commands.console import print_result, progress_bars
from seasonscapes.commands.look_options import LookOptions
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_output
from seasonscapes.commands.refusals import refuse_given, refuse_without
from seasonscapes.commands.view_options import ViewOptions
from seasonscapes.errors import InputError, NoTerrainInView


def splat_command(
    scene: str,
    *,
    time: str | None = None,
    like: Path | None = None,
    model: Path = Path("out/gaussians.safetensors"),
    view: ViewOptions | None = None,
    sky: SkyOptions | None = None,
    look: LookOptions | None = None,
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
    like
        Of models learned from frames, in place of --time: the look of this photograph from the camera. It is fitted to the
        left half of its terrain; the score is that of the right half.
    model
        From `seasonscapes distill`.
    subpixels
        Samples along a pixel's side; 1 is four times as fast as 2.
    output
        A .png or .exr picture; or all Gaussians of that instant as .ply (3DGS) or .glb (KHR_gaussian_splatting).
    device
        cpu, or cuda (needs the extra gsplat).
    json
        Print one machine-readable record.
    """
    view, sky, look, options = (
        view or ViewOptions(),
        sky or SkyOptions(),
        look or LookOptions(),
        place or PlaceOptions(),
    )
    start = clock.perf_counter()
    check_output(output, (".png", ".exr", ".ply", ".glb"))
    check_range("--subpixels", subpixels, 1, 4)
    check_choice("--device", device, ("cpu", "cuda"))
    from seasonscapes.workflows import gaussian_views as gaussians
    from seasonscapes.workflows.distillation import require_torch

    require_torch()
    from seasonscapes.commands.splat_frames import frame_picture
    from seasonscapes.gaussians.frame_appearance import is_frame_model
    from seasonscapes.gaussians.interchange import write_gltf, write_ply
    from seasonscapes.gaussians.model import load_model
    from seasonscapes.gaussians.rasterise import set_torch_threads
    from seasonscapes.images import write_exr
    from seasonscapes.workflows.illumination import illumination_for_camera
    from seasonscapes.workflows.pictures import png_metadata, save_png
    from seasonscapes.workflows.view_rendering import sun_angles

    set_torch_threads(1)
    if is_frame_model(model):
        relit = "a model that is relit (distill --appearance physical)"
        for given, untouched in ((sky, SkyOptions()), (look, LookOptions())):
            refuse_given(relit, given, untouched)
        refuse_without(relit, subpixels == 2, subpixels=subpixels)
        refuse_without(relit, device == "cpu", device=device)
        check_output(output, (".png",))
        if (time is None) == (like is None):
            raise InputError("--time", "name an hour, or a photograph with --like, and not both")
        frame_picture(scene, options, view, model, like or str(time), output, as_json=json)
        return
    refuse_without("a model learned from frames (distill --frames)", False, like=like)
    if time is None:
        raise InputError("--time", "missing", expected="an hour, such as 2024-09-01T12:00")
    metering, size_px, declared = look.metering(), view.size_px(), sky.model()
    splats = load_model(model)
    with progress_bars() as progress:
        loaded = options.load(scene, progress, output=output)
    gaussians.require_scene(splats, loaded)
    chosen, camera = view.chosen(loaded.scene), view.pinhole(loaded)
    utc = parse_time(time, chosen.latitude_deg, chosen.longitude_deg)
    light, position = illumination_for_camera(loaded, camera, declared, utc)
    day, suffix = gaussians.day_of_year(utc), output.suffix.lower()
    shadows = gaussians.cast_shadows(splats, loaded)
    record: dict[str, Any] = {
        "scene": loaded.scene.name,
        "gaussians": len(splats.means),
        "time_utc": utc.astimezone(UTC).isoformat(),
        "sun": sun_angles(position),
        "attribution": loaded.scene.attribution,
        "seasonscapes": __version__,
    }
    if suffix in (".ply", ".glb"):
        baked, ev100 = gaussians.bake_gaussians(splats, light, day, shadows=shadows, exposure=metering)
        record["exposure_ev100"] = round(ev100, 3)
        note = {**loaded.about, **record}
        write_ply(output, baked, note=note) if suffix == ".ply" else write_gltf(output, baked, note=note)
    else:
        try:
            picture, times_ms = gaussians.timed_view(
                splats, camera, light, day, shadows=shadows, subpixels=subpixels, device=device
            )
        except NoTerrainInView as error:
            raise InputError("--camera", str(error)) from None
        ev100 = look.ev100(picture.radiance)
        record |= {"camera": chosen.name, "size_px": list(size_px), **times_ms, "exposure_ev100": round(ev100, 3)}
        if suffix == ".png":
            save_png(output, look.develop(picture.radiance, ev100, light.white_rgb), metadata=png_metadata(record))
        else:
            layers = {"": picture.radiance, "surface": picture.surface, "alpha": picture.coverage}
            layers |= {"depth": picture.depth}
            write_exr(output, layers, header={"seasonscapes:provenance": record})
    record["seconds"] = round(clock.perf_counter() - start, 2)
    sun = f"sun at {record['sun']['elevation_deg']:.1f}°"
    line = f"{output}  ({record['gaussians']:,} Gaussians, {sun}, {record['seconds']} s)"
    print_result({"output": str(output), **record}, [line], as_json=json)
