"""``seasonscapes inpaint``."""

from __future__ import annotations

import time as clock
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_range, parse_time
from seasonscapes.commands.console import print_result, progress_bars
from seasonscapes.commands.diffusion_options import DiffusionOptions
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_output, check_output_folder
from seasonscapes.commands.view_options import ViewOptions


def inpaint_command(
    scene: str,
    *,
    time: str,
    texture: Path = Path("out/paint/painted.npz"),
    method: str = "guided",
    albedo: Path | None = None,
    detail: float = 0.0,
    fast: bool = False,
    seed: int = 0,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/completed.npz"),
    figures: Path | None = None,
    view: ViewOptions | None = None,
    sky: SkyOptions | None = None,
    place: PlaceOptions | None = None,
    diffusion: DiffusionOptions | None = None,
    json: bool = False,
) -> None:
    """Complete a painted texture: give every texel that no camera painted a value and a standard error.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    time
        When the pictures were taken, ISO 8601. Without an offset it is civil time at the scene's origin.
    texture
        What `seasonscapes paint` wrote for this scene, with the same --atlas and --texel-m.
    method
        guided (regression on satellite colour, relief and sun), membrane (smooth), telea (from the rims inwards) or
        diffusion (an image model along --path, then guided; needs weights and, for real use, a GPU).
    albedo
        What `seasonscapes albedo` wrote for this scene. With guided, painted texels are fused with the radiance that it
        predicts at this hour, each by its error, and hidden texels take the prediction. With diffusion it is a predictor.
    detail
        Strength of synthesised grain: 0 for albedo recovery, about 0.6 for pictures.
    fast
        A little less accurate, about three times as fast.
    seed
        Equal seeds give equal textures.
    output
        A .npz texture with its σ.
    figures
        Folder for pictures: texture before and after, σ, and with --camera or --at the view before and after.
    json
        Print one machine-readable record.
    """
    view, options, sky = view or ViewOptions(), place or PlaceOptions(), sky or SkyOptions()
    start = clock.perf_counter()
    check_output(output, (".npz",))
    if figures is not None:
        check_output_folder(figures, flag="--figures")
    check_range("--detail", detail, 0.0, 1.0)
    check_range("--seed", seed, 0, 2**32 - 1)
    from seasonscapes.images import atomic_path
    from seasonscapes.workflows import completion
    from seasonscapes.workflows.inpainting import InpaintOptions, inpaint

    diffuse = (diffusion or DiffusionOptions()).values() if method == "diffusion" else None
    how, model = InpaintOptions(method, albedo, detail, fast, seed, diffuse), sky.model()
    with progress_bars() as progress:
        loaded = options.load(scene, progress, albedo=() if albedo is None else (albedo,))
        utc = parse_time(time, loaded.frame.latitude_deg, loaded.frame.longitude_deg)
        painted = completion.read_painted(texture, loaded)
        result = inpaint(loaded, painted, utc, model, how, progress=progress)
    with atomic_path(output) as temporary:
        completion.save_completed(result.completed, painted, temporary)
    pictures: list[Path] = []
    if figures is not None:
        pictures = completion.save_texture_figures(figures, loaded, result.completed, utc, model)
        if view.camera is not None or view.at is not None:
            camera, name = view.pinhole(loaded), view.chosen(loaded.scene).name
            pictures += completion.save_view_figures(figures, loaded, result.completed, camera, model, utc, name=name)
    record: dict[str, Any] = {
        "output": str(output),
        "scene": loaded.scene.name,
        "time_utc": utc.isoformat(),
        **result.record,
        "figures": [str(path) for path in pictures],
        "seconds": round(clock.perf_counter() - start, 2),
    }
    filled = f"{100 * record['filled_share']:.1f} % of {record['texels']:,} texels filled by {record['method']}"
    error = f"median σ {record['sigma_median']:.3g} on {record['value_median']:.3g}"
    line = f"{output}  ({filled}, {error}, {record['seconds']} s)"
    print_result(record, [line, *record["figures"]], as_json=json)
