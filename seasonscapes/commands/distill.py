"""``seasonscapes distill``."""

from __future__ import annotations

import time as clock
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_choice, check_range, parse_albedo
from seasonscapes.commands.console import print_result, progress_bars
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_output, check_output_folder
from seasonscapes.errors import InputError


def distill_command(
    scene: str,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/gaussians.safetensors"),
    discs: int = 320,
    suns: int = 32,
    dates: int = 4,
    views: int = 3,
    view_px: int = 256,
    steps: int = 2500,
    picture_steps: int = 240,
    kind: str = "full",
    export_views: Path | None = None,
    albedo: list[str] | None = None,
    seed: int = 0,
    sky: SkyOptions | None = None,
    place: PlaceOptions | None = None,
    json: bool = False,
) -> None:
    """Distil a Gaussian model of a place, which renders any date and hour in milliseconds.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    output
        The model, a .safetensors file. A checkpoint beside it lets an interrupted training continue.
    discs
        Gaussians along the longer side of the terrain.
    suns
        Instants to train on, at random hours of the dates' days.
    dates
        Dates of the year whose albedo is stored; with --albedo, these. Between them the snow line moves.
    views
        Cameras around the terrain for training images; 0 trains on the surface alone.
    view_px
        Their size.
    steps
        Training steps on the surface.
    picture_steps
        Training steps on images.
    kind
        full (physics and a network), physical (no network), or sun (a network alone, for comparison).
    export_views
        Also write the training images for other trainers (nerfstudio, COLMAP) into this folder.
    albedo
        DATE=FILE, may be repeated: albedos instead of the scene's own (.npz; or .png, .exr, .glb of this atlas).
    seed
        Equal seeds give equal models.
    json
        Print one machine-readable record.
    """
    sky, options = sky or SkyOptions(), place or PlaceOptions()
    start = clock.perf_counter()
    check_output(output, (".safetensors",))
    for flag, value, low, high in (
        ("--discs", discs, 8, 4096),
        ("--suns", suns, 1, 512),
        ("--dates", dates, 1, 24),
        ("--views", views, 0, 64),
        ("--view-px", view_px, 16, 4096),
        ("--steps", steps, 1, 1e6),
        ("--picture-steps", picture_steps, 0, 1e6),
        ("--seed", seed, 0, 2**32),
    ):
        check_range(flag, value, low, high)
    if export_views is not None:
        check_output_folder(export_views, flag="--export-views")
    if export_views is not None and views == 0:
        raise InputError("--export-views", "there are no views to export", cure="ask for some with --views")
    from seasonscapes.workflows import distillation
    from seasonscapes.workflows.albedo_sources import dated_albedos

    check_choice("--kind", kind, distillation.KINDS)
    distillation.require_torch()
    from seasonscapes.gaussians.model import save_model

    model, files = sky.model(), [parse_albedo(text) for text in albedo or ()]
    checkpoint = output.with_suffix(".checkpoint.safetensors")
    how = distillation.DistilOptions(discs, suns, dates, views, view_px, steps, picture_steps, kind)
    with progress_bars() as progress:
        loaded = options.load(scene, progress, albedo=[each.path for each in files])
        dated = dated_albedos(loaded, files) if files else ()
        distilled = distillation.distil_with_data(
            loaded, sky=model, albedo=dated, options=how, seed=seed, checkpoint=checkpoint, progress=progress
        )
    save_model(distilled.model, output)
    checkpoint.unlink(missing_ok=True)
    record: dict[str, Any] = {"output": str(output), **distillation.distillation_record(loaded, distilled)}
    if export_views is not None:
        distillation.export_training_views(export_views, loaded, distilled.data)
        record["views"] = str(export_views)
    record["seconds"] = round(clock.perf_counter() - start, 1)
    size = f"{record['gaussians']:,} Gaussians {record['spacing_m']} m apart"
    line = f"{output}  ({size}, {record['bytes_per_gaussian']} bytes each, {record['seconds']} s)"
    print_result(record, [line], as_json=json)
