"""One camera of a place under any light: coefficients built once, then a frame for every instant.

An `Assignment` is all of it as plain values, so that another process, or another machine with the same workspace, can
open the same studio and render the same frame to the digit.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from datetime import UTC, date, datetime
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.albedo.seasons import DatedAlbedo, day_number, interpolate_albedo, season_weights, snowline_fraction
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.daylight import light_for, tabulate_light
from seasonscapes.exposure import exposure_ev100
from seasonscapes.pipeline import MeshOptions, Place, camera_for, dated_albedos, load_place, turning_between
from seasonscapes.relighting.frame_file import frame_ev100, frame_name, save_frame
from seasonscapes.scene import NamedCamera
from seasonscapes.sky.elevation_table import TABLE_REVISION
from seasonscapes.sky.models import SkyModel
from seasonscapes.workspace import Workspace, build_once, content_key

REVISION = 1
# Rows of the sky's maps. Without clouds half as many as usual change no picture by more than about 0.1 % in the mean:
# the coefficients average over patches of 7°, and behind the terrain the air itself is asked.
_CLOUDY_ROWS, _CLEAR_ROWS = 128, 64
Progress = Callable[[float], None]


@dataclass(frozen=True)
class Assignment:
    """What to film, as plain values.

    Parameters
    ----------
    scene, workspace
        Files; the workspace must be one that every worker reaches.
    options, view, size_px, model
        How the terrain is built, from where one looks, and under which sky.
    albedo
        Pairs of date (ISO 8601) and texture file that replace the scene's own colours; empty: the scene's own.
    season
        See `albedo.seasons`.
    base_day
        The season (ISO 8601) in whose colours the coefficients are traced: near the film's, since what a pixel's
        samples weigh depends a little on it.
    seed
        Of the coefficients.
    device
        auto, cuda or llvm.
    allow_outside
        See `pipeline.load_place`.
    """

    scene: str
    workspace: str
    options: MeshOptions
    view: NamedCamera
    size_px: tuple[int, int]
    model: SkyModel
    albedo: tuple[tuple[str, str], ...] = ()
    season: str = "blended"
    base_day: str = "2024-07-01"
    seed: int = 0
    device: str = "auto"
    allow_outside: bool = False


@dataclass
class Studio:
    """An opened assignment.

    Parameters
    ----------
    dated, base
        The place's dated albedos, and the one that the coefficients were traced with.
    frames
        Folder of its frames.
    colours
        Of the dated albedos that were worn so far, by number.
    turnings
        When pixels, and what lights them, turn between the two dated albedos worn last, by their names.
    dressed
        The view in the colours it wore last, and which those were.
    """

    assignment: Assignment
    place: Place
    camera: Camera
    coefficients: Any
    terrain: Any
    ready: Any
    dated: list[DatedAlbedo]
    base: DatedAlbedo
    frames: Path
    colours: dict[int, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    turnings: dict[str, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    dressed: tuple[list, Any] | None = None


def assignment_key(assignment: Assignment, place: Place, dated: list[DatedAlbedo]) -> str:
    """Name of all that decides a frame but its time; ``dated`` are the assignment's albedos."""
    inputs = {
        "revision": [REVISION, TABLE_REVISION],
        "place": place.key,
        "view": assignment.view,
        "size": assignment.size_px,
        "model": assignment.model,
        "albedo": [_named(each) for each in dated],
        "base": _named(_base(assignment, dated)),
        "season": assignment.season,
        "seed": assignment.seed,
    }
    return content_key(inputs)


def _named(dated: DatedAlbedo) -> dict:
    return {"date": dated.day.isoformat(), "content": dated.content}


def _base(assignment: Assignment, dated: list[DatedAlbedo]) -> DatedAlbedo:
    """The dated albedo that the coefficients are traced with."""
    day = date.fromisoformat(assignment.base_day)
    return dated[season_weights([each.day for each in dated], day, season="nearest")[0][0]]


def open_studio(assignment: Assignment, *, progress: Progress | None = None) -> Studio:
    """Load the place and the view's daylight coefficients, or trace them where the workspace has none.

    Raises
    ------
    InputError
        For what is wrong with the scene or the view.
    ValueError
        Where the camera sees no terrain.
    """
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.rendering.relit_view import relightable_view

    use_backend(assignment.device)
    place = load_place(
        Path(assignment.scene),
        Workspace(Path(assignment.workspace)),
        options=assignment.options,
        allow_outside=assignment.allow_outside,
    )
    camera = camera_for(place, assignment.view, size_px=assignment.size_px)
    dated = dated_albedos(place, assignment.albedo)
    base = _base(assignment, dated)
    terrain = ray_scene(mi_mesh(place.terrain, base.load().values))
    tell = progress or (lambda _: None)
    tabulate_light(place, camera, assignment.model, progress=lambda share: tell(0.1 * share))
    coefficients = _coefficients(assignment, place, camera, (terrain, base), lambda share: tell(0.1 + 0.9 * share))
    return Studio(
        assignment,
        place,
        camera,
        coefficients,
        terrain,
        relightable_view(terrain, coefficients),
        dated,
        base,
        frames_folder(assignment, place, dated),
    )


def _coefficients(
    assignment: Assignment, place: Place, camera: Camera, clothed: tuple[Any, DatedAlbedo], progress: Progress
) -> Any:
    from seasonscapes.rendering.coefficients_file import load_coefficients, save_coefficients
    from seasonscapes.rendering.transport import SamplingOptions, trace_view

    terrain, base = clothed
    inputs = {
        "revision": REVISION,
        "place": place.key,
        "view": assignment.view,
        "size": assignment.size_px,
        "albedo": _named(base),
        "effort": asdict(SamplingOptions()),
        "seed": assignment.seed,
    }
    key = content_key(inputs)
    folder = place.workspace.folder / f"{place.scene.name}/coefficients-{key}"
    if (folder / "coefficients.json").is_file():
        return load_coefficients(folder, key=key)
    save_coefficients(
        folder, trace_view(terrain, camera, SamplingOptions(), seed=assignment.seed, progress=progress), key=key
    )
    return load_coefficients(folder, key=key)


_held: dict[str, Studio] = {}


def held_studio(assignment: Assignment, *, progress: Progress | None = None) -> Studio:
    """`open_studio`, kept warm in this process; only the last one, since a terrain is large."""
    name = content_key({"assignment": assignment})
    if name not in _held:
        _held.clear()
        _held[name] = open_studio(assignment, progress=progress)
    return _held[name]


def dressed_view(studio: Studio, day: date) -> Any:
    """The view in the colours of a day."""
    from seasonscapes.rendering.relit_view import with_albedo

    weights = season_weights([each.day for each in studio.dated], day, season=studio.assignment.season)
    if len(studio.dated) == 1:
        return studio.ready
    if studio.dressed is None or studio.dressed[0] != weights:
        for index, _ in weights:
            if index not in studio.colours:
                studio.colours[index] = _colours(studio, studio.dated[index])
        studio.dressed = (weights, with_albedo(studio.ready, *_worn(studio, weights, day)))
    return studio.dressed[1]


def _worn(studio: Studio, weights: list[tuple[int, float]], day: date) -> list[np.ndarray]:
    """Albedo of the view's pixels and of what lights them, from the dated ones that clothe a day."""
    parts = [studio.colours[index] for index, _ in weights]
    if len(parts) == 1 or studio.assignment.season != "snow-line":
        return [sum(weight * part[k] for part, (_, weight) in zip(parts, weights, strict=True)) for k in range(2)]
    pair = [studio.dated[index] for index, _ in weights]
    name = f"turning:{pair[0].content}:{pair[1].content}"
    if name not in studio.turnings:
        # When a place turns is a texture like any other, and averaged over pixels as colours are.
        pixels, clusters = _colours(
            studio, DatedAlbedo(pair[0].day, name, lambda: turning_between(studio.place, *pair))
        )
        cover = np.maximum(studio.coefficients.coverage[:, None], 1e-3)
        studio.turnings = {name: (pixels / cover, clusters)}
    line = snowline_fraction(*(day_number(each) for each in (pair[0].day, pair[1].day, day)))
    return [
        interpolate_albedo((parts[0][k], parts[1][k]), turning, weights[1][1], line)
        for k, turning in enumerate(studio.turnings[name])
    ]


def _colours(studio: Studio, dated: DatedAlbedo) -> tuple[np.ndarray, np.ndarray]:
    """Mean albedo of the view's pixels and of what lights them, for a dated texture; kept in the workspace."""
    from seasonscapes.rendering.mitsuba_scene import set_albedo
    from seasonscapes.rendering.relit_view import cluster_albedo
    from seasonscapes.rendering.transport import view_albedo

    assignment, place = studio.assignment, studio.place
    inputs = {
        "revision": REVISION,
        "place": place.key,
        "view": assignment.view,
        "size": assignment.size_px,
        "albedo": _named(dated),
        "base": _named(studio.base),
        "seed": assignment.seed,
    }

    def build() -> tuple[np.ndarray, np.ndarray]:
        texture = dated.load().values
        set_albedo(studio.terrain, texture)
        pixels = view_albedo(studio.terrain, studio.coefficients).astype(np.float16)
        return pixels, cluster_albedo(studio.coefficients, texture).astype(np.float16)

    pixels, clusters = build_once(
        place.workspace,
        f"{place.scene.name}/view-albedo",
        inputs,
        suffix=".npz",
        build=build,
        save=_save_colours,
        load=_load_colours,
    )
    return pixels.astype(np.float32), clusters.astype(np.float32)


def _save_colours(colours: tuple[np.ndarray, np.ndarray], path: Path) -> None:
    np.savez(path, pixels=colours[0], clusters=colours[1])


def _load_colours(path: Path) -> tuple[np.ndarray, np.ndarray]:
    with np.load(path) as file:
        return file["pixels"], file["clusters"]


def frames_folder(assignment: Assignment, place: Place, dated: list[DatedAlbedo]) -> Path:
    """Where the frames of an assignment lie; another assignment has another folder, so frames never mix.

    ``dated`` are its albedos, of `pipeline.dated_albedos`, which reads their files to name their content: ask once.
    """
    return place.workspace.folder / f"{place.scene.name}/frames-{assignment_key(assignment, place, dated)}"


def view_at(studio: Studio, time: datetime) -> tuple[Any, Any, Any]:
    """The lit view of an instant, its light, and where sun and moon stand."""
    from seasonscapes.rendering.relit_view import relight_view

    model = studio.assignment.model
    rows = _CLOUDY_ROWS if model.cloudiness > 0.0 else _CLEAR_ROWS
    light, moment = light_for(studio.place, studio.camera, model, time, map_height=rows, tabulated=True)
    return relight_view(dressed_view(studio, time.date()), light), light, moment


def render_frame(assignment: Assignment, time: datetime, *, exr_folder: str | None = None) -> dict:
    """Render one frame into the workspace, unless it is there; a small record of it.

    Parameters
    ----------
    time
        Aware, UTC.
    exr_folder
        Also write absolute radiance in full precision there.
    """
    studio = held_studio(assignment)
    path = studio.frames / frame_name(time)
    copy = None if exr_folder is None else Path(exr_folder) / frame_name(time)
    if path.is_file() and (copy is None or copy.is_file()):
        return {"time_utc": time.isoformat(), "metered_ev100": frame_ev100(path), "rendered": False}
    view, light, moment = view_at(studio, time)
    metered = exposure_ev100(view.radiance, "auto")
    record = {
        "time_utc": time.astimezone(UTC).isoformat(),
        "scene": studio.place.scene.name,
        "camera": assignment.view.name,
        "sun": {"azimuth_deg": float(moment.sun.azimuth_deg), "elevation_deg": float(moment.sun.elevation_deg)},
        "sky": light.model,
        "attribution": studio.place.scene.attribution,
    }
    if copy is not None:
        from seasonscapes.images import write_exr

        write_exr(
            copy,
            {"": view.radiance, "alpha": view.coverage, "depth": view.gbuffer.depth},
            header={"seasonscapes:provenance": record, "seasonscapes:units": "cd/m2"},
        )
    save_frame(path, view.radiance, metered_ev100=metered, record=record)
    return {"time_utc": time.isoformat(), "metered_ev100": metered, "rendered": True}


def shard(times: list[datetime], text: str) -> list[datetime]:
    """The part ``i/N`` of a list of times, 1 ≤ i ≤ N: every N-th one, so that nights are shared as evenly as days."""
    from seasonscapes.errors import InputError

    first, _, count = text.partition("/")
    if not (first.isdigit() and count.isdigit() and 1 <= int(first) <= int(count)):
        raise InputError("--shard", "not a part of the whole", got=text, expected="i/N with 1 ≤ i ≤ N, such as 3/8")
    return times[int(first) - 1 :: int(count)]
