"""``seasonscapes paint``: the pictures of one time, painted into the texture of their place."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.talk import check_range, finish, parse_size, progress_bar, say
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from seasonscapes.commands.webcam_shots import Sources
    from seasonscapes.pipeline import Place
    from seasonscapes.sky.models import SkyModel
    from seasonscapes.texturing.painting import Painting, PaintOptions

# Raised when equal inputs give another painting, or other synthetic pictures.
_REVISION, _WEBCAMS_REVISION = 3, 1


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class PictureOptions:
    """Where the pictures and their poses are."""

    manifest: Path | None = None
    """The .csv that `seasonscapes webcams --manifest` wrote."""
    calibrations: Path = Path("out/calibration")
    """Folder of the records that `seasonscapes calibrate` wrote."""
    masks: Path | None = None
    """Folder of WEBCAM.png, black where something stands before the landscape."""
    within_min: float = 30.0
    """Take each webcam's picture that is nearest to --time, within so many minutes."""
    synthetic_webcams: bool = False
    """Photograph a synthetic scene from its own cameras first (some seconds each) instead of reading pictures."""
    leave_out: str | None = None
    """Of --synthetic-webcams: cameras that take no picture, with commas between."""
    size: str = "720x480"
    """Of --synthetic-webcams: WIDTHxHEIGHT."""


def paint(
    scene: str,
    *,
    time: str,
    pictures: PictureOptions | None = None,
    mode: str = "weighted",
    near_m: float = 60.0,
    harmonise: bool = True,
    albedo: Path | None = None,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/paint"),
    sky: SkyOptions | None = None,
    place: PlaceOptions | None = None,
    json: bool = False,
) -> None:
    """Paint calibrated pictures of one time into the place's texture, as radiance of the land, the air removed.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    time
        ISO 8601, such as 2024-09-01T12:00. Without an offset it is civil time at the place.
    mode
        weighted (the best picture decides, others soften its rim) or first (the first one that sees a place has it).
    near_m
        Leave out what is nearer than this in metres: roofs and trees rather than terrain.
    harmonise
        Make the cameras agree in exposure, white balance, contrast and haze.
    albedo
        What ``seasonscapes albedo`` wrote for this scene: relit at this hour it tells exposures and haze more surely than
        the skies do.
    output
        Folder for painted.npz, painted.exr and pictures of texture, coverage and which camera.
    json
        Print one machine-readable record.
    """
    from seasonscapes.commands.expected import RELIT_SIGMA
    from seasonscapes.texturing.painting import MODES, PaintOptions
    from seasonscapes.texturing.painting_file import save_painting, write_figures

    pictures, sky, place = pictures or PictureOptions(), sky or SkyOptions(), place or PlaceOptions()
    start = clock.perf_counter()
    if mode not in MODES:
        raise InputError("--mode", "unknown mode", got=mode, expected=" or ".join(MODES))
    check_range("--near-m", near_m, 0.0, 1e5)
    check_range("--within-min", pictures.within_min, 0.0, 1e6)
    from seasonscapes.civil_time import resolve_time
    from seasonscapes.images import atomic_path

    model, size_px = sky.model(), parse_size(pictures.size)
    land = place.load(scene)
    moment = resolve_time(time, land.frame.latitude_deg, land.frame.longitude_deg)
    say(moment.reading)
    # First of all: a wrong file is refused before any picture is taken.
    predicted = None if albedo is None else _predicted(land, albedo, moment.utc, model)
    sources = _sources(land, pictures, moment.utc, model, size_px)
    options = PaintOptions(
        mode=mode,
        fit_gains=harmonise,
        fit_haze=harmonise,
        near_m=near_m,
        predicted_sigma=1.0 if albedo is None else RELIT_SIGMA,
    )
    painting, without = painting_for(
        land, sources, moment.utc, model, options, within_min=pictures.within_min, predicted=predicted
    )
    for line in (*painting.skipped, *(f"{name}: no calibration" for name in without)):
        say(f"left out: {line}")
    with atomic_path(output / "painted.npz") as temporary:
        save_painting(painting, temporary)
    figures = write_figures(painting, output)
    record = painting_record(painting) | {
        "time_utc": moment.utc.astimezone(UTC).isoformat(),
        "time_reading": moment.reading,
        "scene": land.scene.name,
        "mode": mode,
        "uncalibrated": without,
        "painted": str(output / "painted.npz"),
        "figures": figures,
        "attribution": land.scene.attribution,
        "seconds": round(clock.perf_counter() - start, 1),
    }
    lines = [
        f"{name:<16} gain {g[0]:.3g} {g[1]:.3g} {g[2]:.3g}  contrast {c:.2f}  paints {s:.1%}"
        for name, g, c, s in zip(record["webcams"], record["gains"], record["contrasts"], record["shares"], strict=True)
    ]
    lines.append(
        f"{record['painted_share']:.1%} of the texture painted; haze {record['haze']:.2f} of the sky model's; "
        f"cameras agree within {record['scatter_after']:.2f} (log) at {record['overlaps']} places"
    )
    finish(record, [*lines, str(output / "painted.npz"), *figures.values()], as_json=json)


def painting_record(painting: Painting) -> dict:
    """Plain numbers about a painting: gains [1 / (cd/m²)], haze, and the share of the texture that each webcam paints best."""
    import numpy as np

    radiometry, size = painting.radiometry, painting.best.size
    shares = np.bincount(painting.best[painting.best >= 0].ravel(), minlength=len(painting.webcams)) / size
    return {
        "webcams": list(painting.webcams),
        "skipped": list(painting.skipped),
        "gains": np.exp(radiometry.log_gain).tolist(),
        "contrasts": radiometry.contrast.tolist(),
        "haze": radiometry.haze,
        "overlaps": radiometry.overlaps,
        "scatter_before": radiometry.scatter_before,
        "scatter_after": radiometry.scatter_after,
        "shares": shares.tolist(),
        "painted_share": float(np.mean(painting.texture.weight > 0.0)),
    }


def _sources(
    land: Place, pictures: PictureOptions, utc: datetime, model: SkyModel, size_px: tuple[int, int]
) -> Sources:
    from seasonscapes.commands.webcam_shots import Sources, make_webcams
    from seasonscapes.workspace import content_key

    if not pictures.synthetic_webcams:
        if pictures.manifest is None:
            raise InputError(
                "--manifest",
                "missing",
                expected="the .csv of seasonscapes webcams --manifest",
                cure="for a synthetic scene: --synthetic-webcams",
            )
        return Sources(pictures.manifest, pictures.calibrations, pictures.masks)
    if land.synthetic is None:
        raise InputError(
            "--synthetic-webcams",
            f"the scene '{land.scene.name}' is a real place",
            cure="give its pictures with --manifest",
        )
    cameras = chosen_cameras(land, pictures.leave_out, size_px)
    key = content_key(
        {"place": land.key, "time": utc.isoformat(), "sky": model, "size": size_px, "revision": _WEBCAMS_REVISION}
    )
    folder = land.workspace.folder / land.scene.name / f"webcams-{key}"
    with progress_bar(f"photographing from {len(cameras)} webcams") as progress:
        return make_webcams(land, utc, model, folder, cameras=cameras, progress=progress)


def chosen_cameras(land: Place, leave_out: str | None, size_px: tuple[int, int]) -> dict:
    """The scene's cameras by name, without those left out (names with commas between)."""
    from seasonscapes.pipeline import camera_for

    names = {name.strip() for name in (leave_out or "").split(",")} - {""}
    known = [camera.name for camera in land.scene.cameras]
    for name in sorted(names - set(known)):
        raise InputError("--leave-out", "no such camera", got=name, expected="of " + ", ".join(known))
    chosen = {
        view.name: camera_for(land, view, size_px=size_px) for view in land.scene.cameras if view.name not in names
    }
    if not chosen:
        raise InputError("--leave-out", "leaves no camera", got=leave_out)
    return chosen


def painting_for(
    land: Place,
    sources: Sources,
    utc: datetime,
    model: SkyModel,
    options: PaintOptions,
    *,
    within_min: float = 30.0,
    predicted: np.ndarray | None = None,
) -> tuple[Painting, list[str]]:
    """The painting of a time, from the workspace where equal files were painted before; and webcams without calibration.

    An interrupted painting goes on from its finished tiles.
    """
    import hashlib
    import shutil

    from seasonscapes.commands.webcam_shots import rows_at
    from seasonscapes.texturing.painting_file import load_painting, save_painting
    from seasonscapes.workspace import build_once, content_key

    rows = rows_at(sources, utc, within_min=within_min)
    inputs = {
        "revision": _REVISION,
        "place": land.key,
        "sky": model,
        "options": options,
        "files": _hashes(sources, rows),
    }
    if predicted is not None:
        inputs["predicted"] = hashlib.sha256(predicted.tobytes()).hexdigest()
    tiles = land.workspace.folder / land.scene.name / f"tiles-{content_key(inputs)}"
    painting = build_once(
        land.workspace,
        f"{land.scene.name}/painting",
        inputs,
        suffix=".npz",
        save=save_painting,
        load=load_painting,
        build=lambda: _painted(land, sources, rows, model, options, tiles, predicted),
    )
    shutil.rmtree(tiles, ignore_errors=True)
    without = [row.webcam for row in rows if not (sources.calibrations / f"{row.webcam}_calibration.json").is_file()]
    return painting, without


def _hashes(sources: Sources, rows) -> list:
    from seasonscapes.workspace import file_hash

    found = []
    for row in rows:
        files = [sources.manifest.parent / row.path, sources.calibrations / f"{row.webcam}_calibration.json"]
        if sources.masks is not None:
            files.append(sources.masks / f"{row.webcam}.png")
        found.append(
            [row.webcam, row.time.isoformat(), *(file_hash(path) if path.is_file() else None for path in files)]
        )
    return found


def _predicted(land: Place, albedo: Path, utc: datetime, model: SkyModel) -> np.ndarray:
    """Radiance of the texels whose albedo was measured, NaN elsewhere."""
    import numpy as np

    from seasonscapes.commands.expected import expected_radiance

    expected = expected_radiance(land, albedo, utc, model)
    return np.where((expected.weight > 0.0)[..., None], expected.values, np.float32(np.nan))


def _painted(
    land: Place,
    sources: Sources,
    rows,
    model: SkyModel,
    options: PaintOptions,
    tiles: Path,
    predicted: np.ndarray | None,
) -> Painting:
    import numpy as np

    from seasonscapes.commands.webcam_shots import shots_of
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.texturing.painting import paint_atlas as paint_shots

    with progress_bar("opening pictures") as progress:
        shots, _ = shots_of(land, rows, sources, model, progress=progress)
    terrain = ray_scene(mi_mesh(land.terrain, np.full(3, 0.2)))
    try:
        with progress_bar("painting") as progress:
            return paint_shots(
                shots,
                land.terrain,
                land.atlas,
                terrain,
                options=options,
                predicted=predicted,
                resume=tiles,
                progress=progress,
            )
    except ValueError as error:
        raise InputError(sources.manifest, str(error).removeprefix("paint: ")) from None
