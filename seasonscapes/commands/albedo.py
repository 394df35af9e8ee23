"""``seasonscapes albedo``."""

from __future__ import annotations

import time as clock
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from seasonscapes.commands.albedo_record import albedo_lines, albedo_record
from seasonscapes.commands.arguments import check_choice, check_range, parse_size, parse_times
from seasonscapes.commands.console import message, print_result, progress_bars
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_output
from seasonscapes.commands.picture_options import parse_painted
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.cameras.observation import Observation
    from seasonscapes.workflows.photograph_files import PhotographSources


def albedo_command(
    scene: str,
    *,
    times: str | None = None,
    manifest: Path | None = None,
    calibrations: Path = Path("out/calibration"),
    masks: Path | None = None,
    within_min: float = 30.0,
    doubtful_poses: bool = False,
    synthetic_webcams: bool = False,
    size: str = "384x256",
    method: str = "closed",
    painted: tuple[str, ...] = (),
    fit_haze: bool = False,
    fit_curve: bool = False,
    normals: bool = False,
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
        Of photographs: instants with commas between, or a file with one in each line; ISO 8601. One season at a time.
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
    method
        closed (light, air, response and poses are given), or differentiable (haze, exposures, response, clouds before
        the sun and poses are unknowns too; takes minutes the first time).
    painted
        TIME=FILE, may be repeated: what `seasonscapes paint` wrote for a time, as a further observation.
    fit_haze
        With closed: search the visibility that explains the pictures best (takes minutes the first time).
    fit_curve
        Search the webcams' tone curve first.
    normals
        With closed: find normals finer than the heights from the shading of three or more suns; `render` shades with them.
    output
        A .npz with albedo, standard error, times sunlit and source of each texel; pictures go beside it.
    json
        Print one machine-readable record.
    """
    sky, options = sky or SkyOptions(), place or PlaceOptions()
    start = clock.perf_counter()
    check_output(output, (".npz",))
    check_range("--within-min", within_min, 0.0, 1e6)
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.workflows import albedo_recovery as recovery
    from seasonscapes.workflows.recovery_methods import METHODS

    check_choice("--method", method, METHODS)
    model, size_px = sky.model(), parse_size(size)
    use_backend()
    with progress_bars() as progress:
        # Paintings have the atlas that `paint` chooses.
        sources, texel_m = None, None if painted else recovery.TEXEL_M
        if not synthetic_webcams and not (painted and manifest is None and times is None):
            sources = _sources(manifest, calibrations, masks, options.allow_outside, doubtful_poses)
            plan = options.plan(scene, sources)
            message(f"plan: {plan}")
            texel_m = None if painted else plan.texel_m
        loaded = options.load(scene, progress, texel_m=texel_m)
        at = (loaded.frame.latitude_deg, loaded.frame.longitude_deg)
        paintings = [parse_painted(text, *at) for text in painted]
        photographs = []
        if sources is not None or synthetic_webcams:
            if times is None:
                raise InputError("--times", "missing", expected="the instants of the photographs")
            utc = parse_times("--times", times, *at)
            photographs = _photographs(loaded, sources, utc, model, size_px, within_min, progress)
        how = recovery.RecoveryOptions(fit_haze, fit_curve, method, normals)
        recovered = recovery.recover_albedo(
            loaded, photographs, sky=model, options=how, painted=paintings, progress=progress
        )
    recovered.save(output)
    record = albedo_record(loaded, recovered, output) | {"seconds": round(clock.perf_counter() - start, 1)}
    print_result(record, albedo_lines(record, recovered), as_json=json)


def _photographs(loaded, sources, utc, model, size_px, within_min: float, progress) -> list[Observation]:
    from seasonscapes.workflows.photograph_files import photographs_at
    from seasonscapes.workflows.recovery_plan import MOST_PIXELS
    from seasonscapes.workflows.synthetic_photographs import synthetic_observations

    if sources is None:
        return synthetic_observations(loaded, utc, model, size_px=size_px, progress=progress)
    return photographs_at(loaded, sources, utc, within_min=within_min, most_pixels=MOST_PIXELS, progress=progress)


def _sources(
    manifest: Path | None, calibrations: Path, masks: Path | None, allow_outside: bool, doubtful_poses: bool
) -> PhotographSources:
    from seasonscapes.workflows.photograph_files import PhotographSources

    if manifest is None:
        expected, cure = "the .csv of seasonscapes webcams --manifest", "for a synthetic scene: --synthetic-webcams"
        raise InputError("--manifest", "missing", expected=expected, cure=cure)
    return PhotographSources(manifest, calibrations, masks, allow_outside, doubtful_poses)
