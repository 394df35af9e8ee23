"""``seasonscapes paint``."""

from __future__ import annotations

import time as clock
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_choice, check_range, parse_size, parse_time
from seasonscapes.commands.console import message, print_result, progress_bars
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_output_folder
from seasonscapes.commands.picture_options import PictureOptions


def paint_command(
    scene: str,
    *,
    time: str,
    pictures: PictureOptions | None = None,
    mode: str = "weighted",
    near_m: float = 60.0,
    harmonise: bool = True,
    find_foreground: bool = False,
    albedo: Path | None = None,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/paint"),
    sky: SkyOptions | None = None,
    place: PlaceOptions | None = None,
    json: bool = False,
) -> None:
    """Paint calibrated pictures of one time into the place's texture, as radiance of the surface, the air removed.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    time
        ISO 8601, such as 2024-09-01T12:00. Without an offset it is civil time at the place.
    mode
        weighted (the best picture dominates, others blend at its rim) or first (the first picture that covers a texel).
    near_m
        Leave out what is nearer than this in metres: roofs and trees rather than terrain.
    harmonise
        Fit exposure, white balance, contrast and haze of all cameras together.
    find_foreground
        Look for houses and masts, which the terrain lacks, and leave them out; what is known already belongs into --masks.
    albedo
        What `seasonscapes albedo` wrote for this scene: relit at this hour it determines exposures and haze better than
        the skies do.
    output
        Folder for painted.npz, painted.exr and pictures of texture, coverage and which camera.
    json
        Print one machine-readable record.
    """
    from seasonscapes.images import atomic_path
    from seasonscapes.texturing.painting import PAINT_MODES, PaintOptions
    from seasonscapes.texturing.painting_file import save_painting, write_figures
    from seasonscapes.texturing.radiometric_fit import RadiometricReference
    from seasonscapes.workflows.painting import painting_of, painting_record
    from seasonscapes.workflows.photograph_files import rows_at, uncalibrated
    from seasonscapes.workflows.predicted_radiance import RELATIVE_SIGMA, measured_radiance

    pictures, sky, options = pictures or PictureOptions(), sky or SkyOptions(), place or PlaceOptions()
    start = clock.perf_counter()
    check_choice("--mode", mode, PAINT_MODES)
    check_range("--near-m", near_m, 0.0, 1e5)
    check_range("--within-min", pictures.within_min, 0.0, 1e6)
    check_output_folder(output)
    model, _ = sky.model(), parse_size(pictures.size)
    with progress_bars() as progress:
        loaded = options.load(scene, progress, albedo=() if albedo is None else (albedo,))
        utc = parse_time(time, loaded.frame.latitude_deg, loaded.frame.longitude_deg)
        # First of all: a wrong albedo file is refused before any picture is opened.
        predicted = None if albedo is None else measured_radiance(loaded, albedo, utc, model, progress=progress)
        sources = pictures.sources(loaded, utc, model, progress)
        reference = None if predicted is None else RadiometricReference(predicted, RELATIVE_SIGMA)
        how = PaintOptions(mode, harmonise, harmonise, near_m=near_m, foreground=find_foreground)
        within = pictures.within_min
        painting = painting_of(
            loaded, sources, utc, model, how, within_min=within, reference=reference, progress=progress
        )
    for line in painting.skipped:
        message(f"left out: {line}")
    with atomic_path(output / "painted.npz") as temporary:
        save_painting(painting, temporary)
    figures = write_figures(painting, output)
    record = painting_record(painting) | {
        "time_utc": utc.isoformat(),
        "scene": loaded.scene.name,
        "mode": mode,
        "foreground": find_foreground,
        "uncalibrated": uncalibrated(rows_at(sources, utc, within_min=within), sources),
        "painted": str(output / "painted.npz"),
        "figures": figures,
        "attribution": loaded.scene.attribution,
        "seconds": round(clock.perf_counter() - start, 1),
    }
    print_result(record, [*_lines(record), str(output / "painted.npz"), *figures.values()], as_json=json)


def _lines(record: dict) -> list[str]:
    columns = zip(record["webcams"], record["gains"], record["contrasts"], record["shares"], strict=True)
    lines = [
        f"{name:<16} gain {g[0]:.3g} {g[1]:.3g} {g[2]:.3g}  contrast {contrast:.2f}  paints {share:.1%}"
        for name, g, contrast, share in columns
    ]
    haze, scatter, overlaps = record["haze"], record["scatter_after"], record["overlaps"]
    agreement = (
        f"cameras agree within {scatter:.2f} (log) at {overlaps} places" if overlaps else "no overlap of cameras"
    )
    return [
        *lines,
        f"{record['painted_share']:.1%} of the texture painted; haze {haze:.2f} of the sky model's; {agreement}",
    ]
