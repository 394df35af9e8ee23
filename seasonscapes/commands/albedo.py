"""``seasonscapes albedo``."""

from __future__ import annotations

import time as clock
from datetime import UTC
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_range, parse_size, parse_times
from seasonscapes.commands.console import message, print_result, progress_bars
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_output
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.workflows.albedo_recovery import RecoveredAlbedo
    from seasonscapes.workflows.photograph_files import PhotographSources


def albedo_command(
    scene: str,
    *,
    times: str,
    manifest: Path | None = None,
    calibrations: Path = Path("out/calibration"),
    masks: Path | None = None,
    within_min: float = 30.0,
    doubtful_poses: bool = False,
    synthetic_webcams: bool = False,
    size: str = "384x256",
    fit_haze: bool = False,
    fit_curve: bool = False,
    iterations: int = 0,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/albedo.npz"),
    sky: SkyOptions | None = None,
    place: PlaceOptions | None = None,
    json: bool = False,
) -> None:
    """Recover the albedo of a place from photographs of several hours, whose light is known.

    Where no photograph shows the surface, and as far as one shows it badly, the albedo is the scene's image corrected by
    what the photographs show elsewhere; without an image it is predicted from relief.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    times
        Instants with commas between, or a file with one in each line; ISO 8601. One season at a time.
    manifest
        The .csv that `seasonscapes webcams --manifest` wrote.
    calibrations
        Folder of the records that `seasonscapes calibrate` wrote.
    masks
        Folder of WEBCAM.png, black where something stands before the landscape.
    within_min
        Use each webcam's picture that is nearest to a time, within so many minutes.
    doubtful_poses
        Use poses that their calibration called not reliable.
    synthetic_webcams
        Photograph a synthetic scene from its own cameras instead of reading pictures; the error is then known and printed.
    size
        Of --synthetic-webcams: WIDTHxHEIGHT.
    fit_haze
        Search the visibility that explains the pictures best (takes minutes the first time).
    fit_curve
        Search the webcams' tone curve.
    iterations
        Iterations of differentiable rendering after the closed form.
    output
        A .npz with albedo, standard error, times sunlit and source of each texel; pictures go beside it.
    json
        Print one machine-readable record.
    """
    sky, options = sky or SkyOptions(), place or PlaceOptions()
    start = clock.perf_counter()
    check_output(output, (".npz",))
    check_range("--within-min", within_min, 0.0, 1e6)
    check_range("--iterations", iterations, 0, 100_000)
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.workflows import albedo_recovery as recovery
    from seasonscapes.workflows.photograph_files import photographs_at
    from seasonscapes.workflows.recovery_plan import MOST_PIXELS, plan_recovery
    from seasonscapes.workflows.synthetic_photographs import synthetic_observations

    model, size_px = sky.model(), parse_size(size)
    use_backend(gradients=iterations > 0)
    with progress_bars() as progress:
        sources, texel_m = None, recovery.TEXEL_M
        if not synthetic_webcams:
            sources = _sources(manifest, calibrations, masks, options.allow_outside, doubtful_poses)
            plan = plan_recovery(scene, sources, texel_m=options.texel_m, allow_outside=options.allow_outside)
            message(f"plan: {plan}")
            texel_m = plan.texel_m
        loaded = options.load(scene, progress, texel_m=texel_m)
        utc = parse_times("--times", times, loaded.frame.latitude_deg, loaded.frame.longitude_deg)
        if sources is None:
            photographs = synthetic_observations(loaded, utc, model, size_px=size_px, progress=progress)
        else:
            photographs = photographs_at(
                loaded, sources, utc, within_min=within_min, most_pixels=MOST_PIXELS, progress=progress
            )
        how = recovery.RecoveryOptions(fit_haze, fit_curve, iterations)
        recovered = recovery.recover_albedo(loaded, photographs, sky=model, options=how, progress=progress)
    recovered.save(output)
    record: dict[str, Any] = {
        "output": str(output),
        "scene": loaded.scene.name,
        "photographs": len(recovered.photographs),
        "times_utc": [time.astimezone(UTC).isoformat() for time in utc],
        "measured_share": float((recovered.estimate.source == 1).mean()),
        "completed_share": float((recovered.estimate.source == 2).mean()),
        "residual": [round(float(value), 4) for value in recovered.fit.residual],
        "gains": recovered.fit.gains.tolist(),
        **recovered.facts,
        "figures": recovery.save_albedo_figures(loaded, recovered, output),
        "attribution": loaded.scene.attribution,
        "seconds": round(clock.perf_counter() - start, 1),
    }
    if loaded.synthetic is not None:
        record |= recovery.error_against_truth(loaded, recovered)
    print_result(record, _lines(record, recovered), as_json=json)


def _sources(
    manifest: Path | None, calibrations: Path, masks: Path | None, allow_outside: bool, doubtful_poses: bool
) -> PhotographSources:
    from seasonscapes.workflows.photograph_files import PhotographSources

    if manifest is None:
        expected, cure = "the .csv of seasonscapes webcams --manifest", "for a synthetic scene: --synthetic-webcams"
        raise InputError("--manifest", "missing", expected=expected, cure=cure)
    return PhotographSources(manifest, calibrations, masks, allow_outside, doubtful_poses)


def _lines(record: dict[str, Any], recovered: RecoveredAlbedo) -> list[str]:
    observations = [photograph.observation for photograph in recovered.photographs]
    lines = [
        f"{each.webcam:<16} {each.time:%Y-%m-%d %H:%M} UTC  residual {residual:.1%}"
        for each, residual in zip(observations, record["residual"], strict=True)
    ]
    lines.append(f"{record['measured_share']:.1%} of the texture measured, {record['completed_share']:.1%} completed")
    if "true_psnr_db" in record:
        error = f"{record['true_psnr_db']} dB, relative error {record['true_relative_error']:.1%}"
        lines.append(f"against the truth, where measured: {error}")
    return [*lines, record["output"], *record["figures"].values()]
