"""``seasonscapes distill``."""

from __future__ import annotations

import time as clock
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_choice, check_range, parse_albedo
from seasonscapes.commands.console import print_result, progress_bars
from seasonscapes.commands.distill_options import DistilOptionsOfLight, Frames, distil_frames
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_output, check_output_folder
from seasonscapes.commands.refusals import refuse_given, refuse_without
from seasonscapes.errors import InputError


def distill_command(
    scene: str,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/gaussians.safetensors"),
    appearance: str = "physical",
    frames: Path | None = None,
    discs: int = 320,
    steps: int = 2500,
    light: DistilOptionsOfLight | None = None,
    export_views: Path | None = None,
    albedo: list[str] | None = None,
    seed: int = 0,
    sky: SkyOptions | None = None,
    place: PlaceOptions | None = None,
    json: bool = False,
) -> None:
    """Distil a Gaussian model of a place, which renders any date and hour in a fraction of a second.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    output
        The model, a .safetensors file. A checkpoint beside it lets an interrupted training continue.
    appearance
        physical (relit for any sun and date), paper (learned from --frames alone: viewing direction and a free embedding
        of each timestamp), or embedding (the same without viewing direction).
    frames
        Of paper and embedding: folder of pictures with transforms.json and times, as a run films them; or with a COLMAP
        model and georeference.json (origin on Earth, times; else the pictures' names tell times).
    discs
        Gaussians along the longer side of the terrain.
    steps
        Training steps: on the surface, or on the frames.
    export_views
        Also write the training images for other trainers (nerfstudio, COLMAP) into this folder.
    albedo
        DATE=FILE, may be repeated: albedos instead of the scene's own (.npz; or .png, .exr, .glb of this atlas).
    seed
        Equal seeds give equal models.
    json
        Print one machine-readable record.
    """
    start = clock.perf_counter()
    check_output(output, (".safetensors",))
    check_choice("--appearance", appearance, ("physical", "paper", "embedding"))
    for flag, value, high in (("--discs", discs, 4096), ("--steps", steps, 1e6), ("--seed", seed, 2**32)):
        check_range(flag, value, {"--discs": 8, "--steps": 1, "--seed": 0}[flag], high)
    own, options, physical = light or DistilOptionsOfLight(), place or PlaceOptions(), appearance == "physical"
    refuse_without("--appearance paper or embedding", not physical, frames=frames)
    refuse_without("--appearance physical", physical, export_views=export_views, albedo=albedo, **asdict(own))
    if not physical:
        refuse_given("--appearance physical", sky or SkyOptions(), SkyOptions())
        distil_frames(scene, options, frames, output, Frames(appearance == "paper", discs, steps, seed), as_json=json)
        return
    sky, how = sky or SkyOptions(), own.values(discs, steps)
    if export_views is not None:
        check_output_folder(export_views, flag="--export-views")
    if export_views is not None and how.views == 0:
        raise InputError("--export-views", "there are no views to export", cure="ask for some with --views")
    from seasonscapes.workflows import distillation
    from seasonscapes.workflows.albedo_sources import dated_albedos

    distillation.require_torch()
    from seasonscapes.gaussians.model import save_model

    model, files = sky.model(), [parse_albedo(text) for text in albedo or ()]
    checkpoint = output.with_suffix(".checkpoint.safetensors")
    with progress_bars() as progress:
        loaded = options.load(scene, progress, albedo=[each.path for each in files])
        if own.dates is not None and (files or loaded.synthetic is None):
            whose = "--albedo names them" if files else "the scene's images have them"
            raise InputError("--dates", f"does nothing here: {whose}", got=own.dates)
        if own.disc_px and not (loaded.scene.cameras or loaded.scene.webcams):
            raise InputError("--disc-px", "the scene has no camera or webcam that discs could follow", got=own.disc_px)
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
    apart = " to ".join(f"{each}" for each in sorted({record["least_spacing_m"], record["spacing_m"]}))
    size = f"{record['gaussians']:,} Gaussians {apart} m apart"
    line = f"{output}  ({size}, {record['bytes_per_gaussian']} bytes each, {record['seconds']} s)"
    print_result(record, [line], as_json=json)
