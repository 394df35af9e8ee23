"""``seasonscapes albedo``: the light taken out of a place's photographs."""

from __future__ import annotations

import time as clock
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.talk import check_range, check_suffix, finish, parse_size, progress_bar, say
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from seasonscapes.albedo.closed_form import AlbedoFit
    from seasonscapes.albedo.forward_model import TexelTransport
    from seasonscapes.albedo.photographs import AlbedoPhotograph
    from seasonscapes.albedo.standard_error import KnownAlbedo
    from seasonscapes.cameras.observation import Observation
    from seasonscapes.pipeline import Place
    from seasonscapes.sky.models import SkyModel

# Webcams resolve no finer where they look farther than some kilometres; coefficients of finer atlases take long.
_TEXEL_M = 20.0


def albedo(
    scene: str,
    *,
    times: str,
    manifest: Path | None = None,
    calibrations: Path = Path("out/calibration"),
    masks: Path | None = None,
    within_min: float = 30.0,
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
    """Find the albedo of a place from photographs of several hours, whose light is known.

    Where no photograph shows the land, and as far as one shows it badly, it is the scene's image corrected by what the
    photographs show elsewhere; without an image it is learned from relief.

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
        Take each webcam's picture that is nearest to a time, within so many minutes.
    synthetic_webcams
        Photograph a synthetic scene from its own cameras instead of reading pictures; the error is then known and told.
    size
        Of --synthetic-webcams: WIDTHxHEIGHT.
    fit_haze
        Find the visibility that explains the pictures best (takes minutes the first time).
    fit_curve
        Find the webcams' tone curve.
    iterations
        Iterations of differentiable rendering after the closed form.
    output
        A .npz with albedo, standard deviation, times sunlit and source of each texel; pictures go beside it.
    json
        Print one machine-readable record.
    """
    sky, place = sky or SkyOptions(), place or PlaceOptions()
    start = clock.perf_counter()
    check_suffix(output, (".npz",))
    check_range("--within-min", within_min, 0.0, 1e6)
    check_range("--iterations", iterations, 0, 100_000)
    if place.texel_m is None:
        place = replace(place, texel_m=_TEXEL_M)
    from seasonscapes.rendering.backend import use_backend

    model, size_px = sky.model(), parse_size(size)
    use_backend(gradients=iterations > 0)
    land = place.load(scene)
    moments = _moments(times, land)
    if synthetic_webcams:
        observations = _photographed(land, moments, model, size_px)
    else:
        observations = _opened(land, moments, (manifest, calibrations, masks), within_min)
    traced, photographs, facts = _prepared(land, observations, model, fit_haze=fit_haze, fit_curve=fit_curve)
    fit, known = _solved(land, traced, photographs, iterations)
    _save(output, land, known, fit)
    figures = _figures(output, known)
    record: dict[str, Any] = {
        "output": str(output),
        "scene": land.scene.name,
        "photographs": len(photographs),
        "times_utc": [moment.astimezone(UTC).isoformat() for moment in moments],
        "measured_share": float((known.source == 1).mean()),
        "completed_share": float((known.source == 2).mean()),
        "residual": [round(float(value), 4) for value in fit.residual],
        "gains": fit.gains.tolist(),
        **facts,
        "figures": figures,
        "attribution": land.scene.attribution,
        "seconds": round(clock.perf_counter() - start, 1),
    }
    if land.synthetic is not None:
        record |= _truth(land, known, moments[0])
    finish(record, _lines(record, photographs), as_json=json)


def _moments(times: str, land: Place) -> list[datetime]:
    from seasonscapes.civil_time import resolve_time

    path = Path(times)
    texts = path.read_text(encoding="utf-8").split("\n") if path.is_file() else times.split(",")
    texts = [text.strip() for text in texts if text.strip()]
    if not texts:
        raise InputError("--times", "no time in it", got=times)
    readings = [resolve_time(text, land.frame.latitude_deg, land.frame.longitude_deg) for text in texts]
    say(f"{len(readings)} times, the first one {readings[0].reading}")
    return sorted({reading.utc for reading in readings})


def _photographed(land: Place, moments: list[datetime], model: SkyModel, size_px: tuple[int, int]) -> list[Observation]:
    """Pictures of the synthetic webcams, as they deliver them: 8 bits, JPEG, unknown exposure and white balance."""
    from seasonscapes.commands.paint import chosen_cameras
    from seasonscapes.commands.webcam_shots import photographs

    if land.synthetic is None:
        raise InputError(
            "--synthetic-webcams",
            f"the scene '{land.scene.name}' is a real place",
            cure="give its pictures with --manifest",
        )
    cameras = chosen_cameras(land, None, size_px)
    with progress_bar(f"photographing from {len(cameras)} webcams") as progress:
        made = photographs(land, moments, model, cameras, progress=progress)
        return [picture.observation for _, pictures in made for picture in pictures]


def _opened(land: Place, moments: list[datetime], folders: tuple, within_min: float) -> list[Observation]:
    from seasonscapes.commands.webcam_shots import Sources, calibrated_views, rows_at

    if folders[0] is None:
        raise InputError(
            "--manifest",
            "missing",
            expected="the .csv of seasonscapes webcams --manifest",
            cure="for a synthetic scene: --synthetic-webcams",
        )
    sources = Sources(*folders)
    near = [rows_at(sources, moment, within_min=within_min, flag="--times") for moment in moments]
    rows = {row.path: row for each in near for row in each}
    opened, without = calibrated_views(list(rows.values()), sources, land.frame)
    for name in sorted(without):
        say(f"left out: {name}: no calibration")
    return [view for _, views in opened for view in views]


def _lights(land: Place, observations: Sequence[Observation], model: SkyModel) -> list:
    """The light of each observation, as seen from its camera; cameras of one place and instant share it."""
    from seasonscapes.daylight import light_for

    held: dict = {}
    for one in observations:
        key = (one.time, one.camera.position_m.tobytes())
        if key not in held:
            held[key] = light_for(land, one.camera, model, one.time)[0]
    return [held[one.time, one.camera.position_m.tobytes()] for one in observations]


def _with_terrain(traced: TexelTransport, observations: list[Observation]) -> list[Observation]:
    """Those that show any terrain: parts of a panorama may be all sky."""
    from seasonscapes.rendering.sightlines import faces_met

    held: dict[bytes, np.ndarray] = {}
    kept, empty = [], set()
    for one in observations:
        key = repr((one.webcam, one.camera.width_px, one.camera.height_px, one.camera.fx)).encode()
        key += one.camera.world_from_camera.tobytes()
        if key not in held:
            held[key] = faces_met(traced.ray_scene, one.camera) >= 0
        if (held[key] & one.mask).any():
            kept.append(one)
        else:
            empty.add(one.webcam)
    for name in sorted(empty):
        say(f"left out: {name}: it sees none of the terrain")
    if not kept:
        raise InputError("albedo", "no photograph shows any of the terrain")
    return kept


def _prepared(
    land: Place, observations: list[Observation], model: SkyModel, *, fit_haze: bool, fit_curve: bool
) -> tuple[TexelTransport, list[AlbedoPhotograph], dict[str, Any]]:
    from seasonscapes.albedo.forward_model import trace_texel_transport
    from seasonscapes.albedo.haze import fit_visibility
    from seasonscapes.albedo.photographs import EIGHT_BIT, prepare_photographs
    from seasonscapes.albedo.tone_curve import fit_tone_curve, with_tone_curve
    from seasonscapes.sky.models import with_overrides

    facts: dict[str, Any] = {}
    with progress_bar("daylight of the atlas") as progress:
        traced = trace_texel_transport(land.terrain, (land.atlas.height_px, land.atlas.width_px), progress=progress)
    observations = _with_terrain(traced, observations)
    with progress_bar("footprints of the photographs") as progress:
        try:
            photographs = prepare_photographs(
                traced, observations, _lights(land, observations, model), progress=progress
            )
        except ValueError as error:
            raise InputError("albedo", str(error)) from None
    if fit_curve:
        with progress_bar("tone curve") as progress:
            curve = fit_tone_curve(traced, photographs, progress=progress)
        photographs = with_tone_curve(photographs, curve.strength)
        facts["curve_strength"] = round(curve.strength, 3)
        say(f"tone curve: strength {curve.strength:.2f}")
    if fit_haze:

        def lights_of(visibility_km: float) -> list:
            return _lights(land, observations, with_overrides(model, visibility_km=visibility_km))

        with progress_bar("visibility") as progress:
            found = fit_visibility(traced, photographs, lights_of, noise_model=EIGHT_BIT, progress=progress)
        facts["visibility_km"] = round(found.visibility_km, 1)
        say(f"visibility {found.visibility_km:.0f} km")
        photographs = [
            replace(photograph, light=light)
            for photograph, light in zip(photographs, lights_of(found.visibility_km), strict=True)
        ]
    return traced, photographs, facts


def _solved(
    land: Place, traced: TexelTransport, photographs: list[AlbedoPhotograph], iterations: int
) -> tuple[AlbedoFit, KnownAlbedo]:
    import numpy as np

    from seasonscapes.albedo.closed_form import solve_albedo
    from seasonscapes.albedo.inverse import InverseOptions, refine_albedo
    from seasonscapes.albedo.photographs import EIGHT_BIT
    from seasonscapes.albedo.standard_error import known_albedo
    from seasonscapes.commands.corrected_albedo import complete_known
    from seasonscapes.pipeline import image_from_above
    from seasonscapes.texturing.predictors import predictors_for

    try:
        with progress_bar("albedo") as progress:
            fit = solve_albedo(traced, photographs, noise_model=EIGHT_BIT, progress=progress)
        if iterations:
            options = InverseOptions(iterations=iterations, levels=(1,))
            with progress_bar("differentiable rendering") as progress:
                fit = refine_albedo(
                    land.terrain,
                    traced,
                    photographs,
                    fit,
                    noise_model=EIGHT_BIT,
                    options=options,
                    callbacks=[lambda state: progress(state.iteration / iterations)],
                ).fit
        known = known_albedo(traced, photographs, fit)
        image = image_from_above(land, photographs[0].observation.time)
        base = None if image is None else np.where(image.weight[..., None] > 0.0, image.values, np.float32(np.nan))
        with progress_bar("completing") as progress:
            return fit, complete_known(known, fit, base, predictors_for(land.terrain, land.atlas), progress=progress)
    except ValueError as error:
        raise InputError("albedo", str(error).split(": ", 1)[-1]) from None


def _save(output: Path, land: Place, known: KnownAlbedo, fit: AlbedoFit) -> None:
    """Readable by `terrain.surface.load_texture`: ``values`` and ``weight`` (0 where nothing was measured)."""
    import numpy as np

    from seasonscapes.images import atomic_path

    weight = np.where(known.source == 1, 1.0 / np.maximum(known.sigma, 1e-4) ** 2, 0.0).astype(np.float32)
    with atomic_path(output) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(
            file,
            values=known.albedo,
            weight=weight,
            sigma=known.sigma,
            sunlit=known.sunlit,
            source=known.source,
            gains=fit.gains,
            residual=fit.residual,
        )


def _figures(output: Path, known: KnownAlbedo) -> dict[str, str]:
    """Pictures of the albedo, of what was measured and of how well."""
    import numpy as np

    from seasonscapes.images import write_png

    sigma = np.clip(np.nan_to_num(known.sigma, posinf=1.0) / 0.1, 0.0, 1.0)
    measured = (known.source == 1)[..., None] * known.albedo
    pictures: dict[str, np.ndarray] = {
        "albedo": known.albedo,
        "measured": measured,
        "sigma": np.repeat(sigma[..., None], 3, 2),
    }
    names = {}
    for name, image in pictures.items():
        path = output.with_name(f"{output.stem}_{name}.png")
        write_png(path, np.clip(image, 0.0, 1.0))
        names[name] = str(path)
    return names


def _truth(land: Place, known: KnownAlbedo, moment: datetime) -> dict[str, float]:
    """How far off it is, where the truth is known: over measured texels."""
    import numpy as np

    from seasonscapes.pipeline import albedo_for

    truth, measured = albedo_for(land, moment).values, known.source == 1
    error = known.albedo[measured] - truth[measured]
    return {
        "true_psnr_db": round(float(-10.0 * np.log10(np.mean(error**2))), 2),
        "true_relative_error": round(float(np.abs(error).sum() / truth[measured].sum()), 4),
    }


def _lines(record: dict[str, Any], photographs: list[AlbedoPhotograph]) -> list[str]:
    lines = [
        f"{photograph.observation.webcam:<16} {photograph.observation.time:%Y-%m-%d %H:%M} UTC  residual {residual:.1%}"
        for photograph, residual in zip(photographs, record["residual"], strict=True)
    ]
    lines.append(f"{record['measured_share']:.1%} of the texture measured, {record['completed_share']:.1%} completed")
    if "true_psnr_db" in record:
        lines.append(
            f"against the truth, where measured: {record['true_psnr_db']} dB, relative error "
            f"{record['true_relative_error']:.1%}"
        )
    return [*lines, record["output"], *record["figures"].values()]
