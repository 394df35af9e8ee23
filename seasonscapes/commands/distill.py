"""``seasonscapes distill``."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from cyclopts import Parameter

from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.talk import check_range, check_suffix, finish, progress_bar, say
from seasonscapes.commands.timelapse import parse_dated
from seasonscapes.errors import InputError

YEAR = 2024


def distill(
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
    """Teach Gaussians the light of a place, so that any date and hour is a matter of milliseconds.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    output
        The model, a .safetensors file. Beside it a checkpoint stands while training: started again, it goes on.
    discs
        Gaussians along the longer side of the terrain.
    suns
        Instants to learn from, spread at random over the dates' days.
    dates
        Dates of the year whose albedo is told apart; with --albedo, these. Between them the snow line moves.
    views
        Cameras around the terrain that pictures to learn from are made for; 0 learns on the surface alone.
    view_px
        Their size.
    steps
        Of training on the surface.
    picture_steps
        Of training through pictures.
    kind
        full (physics and a network), physical (no network), or sun (a network alone, for comparison).
    export_views
        Also write these pictures for other trainers (nerfstudio, COLMAP) into this folder.
    albedo
        DATE=FILE.npz, may be repeated: recovered albedos instead of the scene's own colours.
    seed
        Equal seeds give equal models.
    json
        Print one machine-readable record.
    """
    sky, place = sky or SkyOptions(), place or PlaceOptions()
    start = clock.perf_counter()
    check_suffix(output, (".safetensors",))
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
    if kind not in ("full", "physical", "sun"):
        raise InputError("--kind", "unknown kind", got=kind, expected="full, physical or sun")
    if export_views is not None and views == 0:
        raise InputError("--export-views", "there are no views to export", cure="ask for some with --views")
    require_torch()
    from seasonscapes.gaussians.appearance import Appearance, fourier_embedding
    from seasonscapes.gaussians.model import bytes_each, model_from, save_model
    from seasonscapes.gaussians.rasterise import choose_threads
    from seasonscapes.gaussians.splat_view import learned_numbers
    from seasonscapes.gaussians.training import Schedule, train

    choose_threads(1)
    model = sky.model()
    land = place.load(scene)
    dated = dated_textures(land, [parse_dated(text) for text in albedo or ()], dates)
    school = prepare_school(land, model, (discs, suns, views, view_px), dated, seed)
    surfels = school.surfels
    appearance = Appearance(
        kind,
        school.albedo,
        school.around,
        school.transport,
        fourier_embedding(surfels.means, seed=seed),
        times=suns,
        seed=seed,
    )
    checkpoint = output.with_suffix(".checkpoint.safetensors")
    with progress_bar("distilling") as progress:
        losses = train(
            appearance,
            school.targets,
            school.frames,
            Schedule(steps, picture_steps),
            seed=seed,
            checkpoint=checkpoint,
            progress=progress,
        )
    note = {"scene": land.scene.name, "seed": seed, "suns": suns, "attribution": land.scene.attribution}
    made = model_from(
        surfels,
        school.albedo,
        school.days,
        school.transport,
        kind=kind,
        frame=land.frame,
        appearance=learned_numbers(appearance),
        note=note,
    )
    save_model(made, output)
    checkpoint.unlink(missing_ok=True)
    record: dict[str, Any] = {
        "output": str(output),
        "scene": land.scene.name,
        "gaussians": len(surfels.means),
        "spacing_m": round(surfels.plan.spacing_m, 2),
        "bytes_per_gaussian": round(bytes_each(made), 1),
        "suns": suns,
        "dates": school.days,
        "loss": losses[-1] if losses else None,
    }
    if export_views is not None:
        export(export_views, land, school)
        record["views"] = str(export_views)
    record["seconds"] = round(clock.perf_counter() - start, 1)
    finish(
        record,
        [
            f"{output}  ({record['gaussians']:,} Gaussians {record['spacing_m']} m apart, "
            f"{record['bytes_per_gaussian']} bytes each, {record['seconds']} s)"
        ],
        as_json=json,
    )


def require_torch() -> None:
    """`InputError` where the extra that Gaussians need is missing."""
    from importlib.util import find_spec

    if find_spec("torch") is None or find_spec("safetensors") is None:
        raise InputError("gaussians", "PyTorch is not installed", cure="pip install 'seasonscapes[gaussians]'")


@dataclass(frozen=True)
class School:
    """Everything to learn from: discs, dated albedos, transport, lessons, frames with their cameras and times."""

    surfels: Any
    albedo: np.ndarray
    around: np.ndarray
    days: list[float]
    transport: Any
    targets: Any
    times: list[datetime]
    frames: list
    cameras: list


def dated_textures(land, given: list[tuple[str, str]], dates: int) -> list[tuple[float, np.ndarray]]:
    """Days of the year and the albedo textures ``(R, S, 3)`` of them: those given, or the scene's own."""
    from seasonscapes.albedo.seasons import day_number
    from seasonscapes.pipeline import albedo_for, dated_albedos

    if given:
        found = sorted(
            ((day_number(each.day), each.load().values) for each in dated_albedos(land, given)),
            key=lambda each: each[0],
        )
        if any(one[0] == other[0] for one, other in pairwise(found)):
            raise InputError("--albedo", "names a day of the year twice", cure="give one albedo for each")
        return found
    # A scene with one image has one albedo for the whole year.
    days = np.linspace(15.0, 366.0 + 15.0, dates + 1)[:-1].round().tolist() if land.synthetic else [200.0]
    return [
        (day, albedo_for(land, datetime(YEAR, 1, 1, 12, tzinfo=UTC) + timedelta(days=day - 1)).values) for day in days
    ]


def prepare_school(
    land, model, counts: tuple[int, int, int, int], dated: list[tuple[float, np.ndarray]], seed: int
) -> School:
    """Trace what is to be learned. Each date has its own albedo, and with it its own light from other slopes."""
    from seasonscapes.gaussians.disc_transport import (
        light_state,
        neighbourhood_mean,
        surfel_irradiance,
        trace_disc_transport,
    )
    from seasonscapes.gaussians.surfels import surfel_albedo, terrain_surfels
    from seasonscapes.gaussians.training import surface_targets
    from seasonscapes.gaussians.training_views import overview_cameras, relit_frames
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh

    discs, suns, views, view_px = counts
    days, textures = [day for day, _ in dated], [texture for _, texture in dated]
    surfels = terrain_surfels(land.terrain, float(np.ptp(land.terrain.vertices[:, :2], axis=0).max()) / discs)
    albedo = np.stack([surfel_albedo(surfels, texture) for texture in textures])
    around = np.stack([neighbourhood_mean(surfels.means, one, surfels.plan.spacing_m) for one in albedo])
    seasons = [number % len(days) for number in range(suns)]
    with progress_bar("light") as progress:
        lights, times = draw_lights(land, model, [days[season] for season in seasons], seed, progress)
    received = np.empty((suns, len(surfels.means), 3), np.float32)
    transport, states, frames = None, [], []
    cameras = overview_cameras(land.terrain, views, size_px=view_px, first_deg=30.0)
    for season, texture in enumerate(textures):
        mine = [number for number in range(suns) if seasons[number] == season]
        bare = ray_scene(mi_mesh(land.terrain, texture))
        if transport is None:
            with progress_bar("transport") as progress:
                transport = trace_disc_transport(bare, surfels, albedo[season], rays=64, seed=seed, progress=progress)
            states = [
                light_state(transport, light, float(at.timetuple().tm_yday))
                for light, at in zip(lights, times, strict=True)
            ]
        if mine:
            with progress_bar(f"surface, date {season + 1} of {len(days)}") as progress:
                received[mine] = surfel_irradiance(
                    bare, surfels, [lights[n] for n in mine], rays=128, seed=seed, progress=progress
                )
        # Pictures of one date are enough: they teach the splats' width, not the season.
        if season == len(days) // 2 and views and mine:
            with progress_bar("pictures") as progress:
                frames = relit_frames(
                    bare, surfels, cameras, [(n, lights[n], states[n]) for n in mine], seed=seed, progress=progress
                )
    targets = surface_targets(states, seasons, albedo, received)
    return School(surfels, albedo, around, days, transport, targets, times, frames, cameras)


def draw_lights(land, model, days: list[float], seed: int, progress) -> tuple[list, list[datetime]]:
    """One light for each day, at a random hour with the sun above 2°, or the best of many where there is none."""
    from seasonscapes.daylight import light_at, median_height_m, moment_at

    rng, height_m = np.random.default_rng(seed), median_height_m(land)
    lights, times = [], []
    for number, day in enumerate(days):
        tried = []
        while len(tried) < 64 and not (tried and tried[-1].sun.elevation_deg > 2.0):
            at = datetime(YEAR, 1, 1, tzinfo=UTC) + timedelta(days=day - 1, hours=float(rng.uniform(0.0, 24.0)))
            tried.append(moment_at(at, land.frame.latitude_deg, land.frame.longitude_deg, height_m))
        best = max(
            tried[-1:] if tried[-1].sun.elevation_deg > 2.0 else tried, key=lambda moment: moment.sun.elevation_deg
        )
        lights.append(light_at(model, best, height_m, workspace=land.workspace))
        times.append(best.time)
        progress((number + 1) / len(days))
    say(f"{len(days)} instants, {min(times):%d %b %H:%M} to {max(times):%d %b %H:%M} UTC")
    return lights, times


def export(folder: Path, land, school: School) -> None:
    """The training pictures as PNG, with cameras, times and suns for other trainers."""
    from seasonscapes.cameras.exchange import NamedView
    from seasonscapes.gaussians.interchange import BakedSplats, TrainingView, write_training_views
    from seasonscapes.images import srgb_from_linear, write_png

    each, views = len(school.frames) // max(len(school.cameras), 1), []
    for number, frame in enumerate(school.frames):
        name = f"images/{number:04d}.png"
        write_png(folder / name, np.clip(frame.image, 0.0, 1.0))
        view = NamedView(f"{number:04d}", school.cameras[number // each], name, school.times[frame.time])
        views.append(TrainingView(view, school.targets.states[frame.time]))
    surfels = school.surfels
    rgb = srgb_from_linear(school.albedo[len(school.days) // 2]).astype(np.float32)
    splats = BakedSplats(surfels.means, surfels.quaternions, surfels.log_scales, surfels.opacity_logits, rgb)
    write_training_views(folder, views, splats, land.frame)
