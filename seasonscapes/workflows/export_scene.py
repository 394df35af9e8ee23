"""Export of a place for other programs: bare, with the lights of an hour, or with the light baked into its texture."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.export.gltf import TexturedTerrain
from seasonscapes.images import srgb8_from_linear
from seasonscapes.progress import Progress, each_reported, task_progress
from seasonscapes.sky.models import SkyModel
from seasonscapes.workflows.albedo_sources import AlbedoSource, chosen_albedo
from seasonscapes.workflows.illumination import illumination_at, illumination_on_terrain, position_at, sky_model
from seasonscapes.workflows.place import Place, utc_at
from seasonscapes.workflows.view_rendering import sun_angles

if TYPE_CHECKING:
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.sky.illumination import Illumination, Luminary

# Kind to the suffixes of its file; none: a folder.
KINDS: dict[str, tuple[str, ...]] = {
    "glb": (".glb",),
    "gltf": (".gltf",),
    "usd": (".usdc", ".usda", ".usd"),
    "3dtiles": (),
    "blender": (),
}
# The day of the bare albedo where none is asked for.
_SUMMER = date(2024, 7, 23)
_MOST_INSTANTS = 1441


@dataclass(frozen=True)
class ExportOptions:
    """How to export.

    Parameters
    ----------
    unlit
        Bake the light of the hour into the texture, for viewers that add none. 3D Tiles of an hour are always baked.
    exposure
        Of a baked texture: ``"auto"``, ``"eye"`` or EV100.
    rays, seed
        Of baking; see `received_light.lit_texture`.
    geoid_m
        Of 3D Tiles: height of the vertical datum's zero above the ellipsoid [m], in place of a geoid's.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> ss.ExportOptions(unlit=True, rays=32).exposure
    'auto'
    """

    unlit: bool = False
    exposure: str | float = "auto"
    rays: int = 128
    seed: int = 0
    geoid_m: float | None = None


def export_scene(
    place: Place,
    output: str | Path,
    to: str,
    time: str | datetime | date | Sequence[datetime] | None = None,
    *,
    sky: str | Path | SkyModel = "clear",
    albedo: AlbedoSource = None,
    camera: Camera | None = None,
    options: ExportOptions | None = None,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Write a place for other programs.

    Parameters
    ----------
    place
        The place.
    output
        A file, or for ``"3dtiles"`` and ``"blender"`` a folder that is new or empty.
    to
        ``"glb"``, ``"gltf"``, ``"usd"`` (an extra), ``"3dtiles"`` or ``"blender"``.
    time
        ``None`` for the bare albedo of summer, a date for that day's; an instant (an aware datetime, or ISO 8601 text;
        without offset it is civil time at the place) adds its sun, moon and sky. For ``"usd"`` also several instants.
    sky
        A sky model, its name or its file.
    albedo
        A texture of the place's atlas, a dated albedo, an `AlbedoSeries`, or ``None`` for the scene's own.
    camera
        Of ``"blender"``: the view.
    options
        See `ExportOptions`.
    progress
        Called with a task and its finished share.

    Returns
    -------
    dict
        Plain values: the files, origin, time, and for 3D Tiles the geoid's height.

    Raises
    ------
    InputError
        For a kind that does not exist, a folder that is not empty, or options that do not go together.

    Examples
    --------
    >>> import tempfile
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     record = ss.export_scene(place, f"{folder}/noon.glb", "glb", "2024-07-20T13:30", sky="hosek")
    >>> record["files"], record["origin"]["latitude_deg"]
    (['noon.glb', 'noon.sky.exr'], 46.55)
    """
    options, output = options or ExportOptions(), Path(output)
    require_consistent(to, time, options, camera)
    if to == "usd":
        from seasonscapes.export.usd import require_usd

        require_usd()
    instants = _instants(place, time)
    day = instants[len(instants) // 2].date() if instants else time if isinstance(time, date) else _SUMMER
    lights = _lights(place, sky_model(sky), instants, progress)
    job = _Job(place, output, lights, sky_model(sky), albedo, day, camera, options, progress)
    baked = options.unlit or (to == "3dtiles" and bool(instants))
    model, facts = job.textured(baked)
    record = {**model.about, **facts, **_WRITERS[to](job, model)}
    return json.loads(json.dumps(record, default=float))


def require_consistent(to: str, time: Any, options: ExportOptions, camera: Camera | None = None) -> None:
    """`InputError` for a kind of export that does not exist, or options that do not go together."""
    if to not in KINDS:
        raise InputError("--to", "unknown", got=to, expected=", ".join(KINDS))
    is_instant = time is not None and not (isinstance(time, date) and not isinstance(time, datetime))
    if options.unlit and not is_instant:
        raise InputError("--unlit", "bakes the light of an hour", cure="give --time")
    if to == "blender" and (options.unlit or not is_instant):
        raise InputError("--to blender", "sets the sun and sky of an hour", cure="give --time, without --unlit")
    if isinstance(time, Sequence) and not isinstance(time, str) and (to != "usd" or options.unlit):
        raise InputError("--to", "several instants go with lights in usd", got=to, expected="usd, without --unlit")
    if camera is not None and to != "blender":
        raise InputError("--camera", "goes with --to blender", got=to)
    if options.geoid_m is not None and to != "3dtiles":
        raise InputError("--geoid-m", "goes with --to 3dtiles", got=to)
    if options.geoid_m is not None:
        from seasonscapes.terrain.geoid import require_undulation

        require_undulation(options.geoid_m)


def day_instants(place: Place, day: date, every: timedelta) -> list[datetime]:
    """Instants of a civil day at a place, from its midnight to the next, a step apart; aware UTC.

    Raises
    ------
    InputError
        For too many.
    """
    start, end = (utc_at(place, datetime.combine(each, datetime.min.time())) for each in (day, day + timedelta(days=1)))
    count = int((end - start) / every) + 1
    if not 2 <= count <= _MOST_INSTANTS:
        raise InputError("--every", "instants of a day", got=count, expected=f"2 to {_MOST_INSTANTS}")
    return [start + index * every for index in range(count)]


def _instants(place: Place, time: Any) -> list[datetime]:
    if time is None or (isinstance(time, date) and not isinstance(time, datetime)):
        return []
    return [utc_at(place, each) for each in ([time] if isinstance(time, (str, datetime)) else time)]


def _lights(
    place: Place, model: SkyModel, instants: Sequence[datetime], progress: Progress | None
) -> list[Illumination]:
    if len(instants) < 2:
        return [illumination_on_terrain(place, model, utc)[0] for utc in instants]
    return [
        illumination_at(
            model,
            position_at(place, utc),
            place.median_height_m,
            workspace=place.workspace,
            with_aerial_perspective=False,
            by_elevation=True,
        )
        for utc in each_reported(instants, len(instants), progress, "skies")
    ]


def _lamps(light: Illumination) -> dict[str, Luminary]:
    return {name: lamp for name, lamp in (("sun", light.sun), ("moon", light.moon)) if lamp is not None}


def _card_ev100(light: Illumination) -> float:
    """The EV100 of a grey card in the open."""
    from seasonscapes.exposure import exposure_ev100

    return exposure_ev100(np.full((1, 1, 3), 0.18) * light.global_horizontal_lx / np.pi)


@dataclass(frozen=True)
class _Job:
    """One export: what it is made of."""

    place: Place
    output: Path
    lights: list[Illumination]
    sky: SkyModel
    albedo: AlbedoSource
    day: date
    camera: Camera | None
    options: ExportOptions
    progress: Progress | None

    def about(self) -> dict[str, Any]:
        """Metadata of every file: the place, and the hour where there is one."""
        about: dict[str, Any] = {**self.place.about, "albedo_date": self.day.isoformat()}
        if self.lights:
            light = self.lights[0]
            assert light.time is not None
            about |= {"time_utc": light.time.astimezone(UTC).isoformat(), "sky": light.model}
            about["sun"] = sun_angles(position_at(self.place, light.time))
        if len(self.lights) > 1:
            last = self.lights[-1].time
            assert last is not None
            about |= {"to_utc": last.astimezone(UTC).isoformat(), "instants": len(self.lights)}
        return about

    def textured(self, baked: bool) -> tuple[TexturedTerrain, dict[str, Any]]:
        """The terrain with its albedo and lamps, or with its light baked in."""
        place, about = self.place, self.about()
        if baked:
            from seasonscapes.exposure import develop, exposure_ev100
            from seasonscapes.workflows.received_light import lit_texture

            light, how = self.lights[0], self.options
            assert light.time is not None
            lit = lit_texture(
                place,
                light.time,
                sky=self.sky,
                albedo=self.albedo,
                rays=how.rays,
                seed=how.seed,
                progress=self.progress,
            )
            about["exposure_ev100"] = exposure_ev100(lit.radiance, how.exposure)
            picture = develop(lit.radiance, about["exposure_ev100"], eye=how.exposure == "eye")
            return TexturedTerrain(place.terrain, srgb8_from_linear(picture), True, about), {"rays": how.rays}
        albedo = chosen_albedo(place, self.day, self.albedo)
        lamps = {}
        if self.lights:
            # Lights are absolute; this is how to expose for them, at the brightest instant of several.
            about["exposure_ev100"] = max(_card_ev100(light) for light in self.lights)
            lamps = _lamps(self.lights[0])
        return TexturedTerrain(place.terrain, srgb8_from_linear(albedo.values), False, about, lamps), {}


def _write_gltf(job: _Job, model: TexturedTerrain) -> dict[str, Any]:
    from seasonscapes.export.gltf import write_gltf
    from seasonscapes.export.sky_map import EAST_CENTRED, write_sky

    files = []
    if job.lights and not model.lit:
        path = job.output.with_suffix(".sky.exr")
        write_sky(path, job.lights[0].sky_radiance, model.about, layout=EAST_CENTRED)
        files.append(path)
    return {"files": [path.name for path in [*write_gltf(job.output, model), *files]]}


def _write_usd(job: _Job, model: TexturedTerrain) -> dict[str, Any]:
    from seasonscapes.export.usd import Instant, write_usd

    instants = [Instant(light.time, _lamps(light), light.sky_radiance) for light in job.lights if light.time]
    return {"files": [path.name for path in write_usd(job.output, model, [] if model.lit else instants)]}


def _write_blender(job: _Job, model: TexturedTerrain) -> dict[str, Any]:
    from dataclasses import replace

    from seasonscapes.export import blender
    from seasonscapes.export.gltf import write_gltf
    from seasonscapes.export.sky_map import EAST_CENTRED, write_sky

    light, ev100 = job.lights[0], model.about["exposure_ev100"]
    with new_folder(job.output) as folder:
        write_gltf(folder / blender.GROUND_FILE, replace(model, lamps={}))
        write_sky(folder / blender.SKY_FILE, light.sky_radiance, model.about, layout=EAST_CENTRED)
        scene = blender.blender_scene(model.lamps, job.camera, ev100, model.about)
        blender.write_blender_script(folder, scene)
    return {"files": [blender.GROUND_FILE, blender.SKY_FILE, blender.SCRIPT_FILE]}


def _write_tiles(job: _Job, model: TexturedTerrain) -> dict[str, Any]:
    from seasonscapes.export.tiles import TILESET_FILE, TileSource, write_tileset
    from seasonscapes.terrain.geoid import geoid_of
    from seasonscapes.workflows.terrain_building import sample_spacing_m

    place = job.place
    source = TileSource(
        place.elevation,
        place.frame,
        geoid_of(
            place.scene.vertical_datum, place.frame.latitude_deg, place.frame.longitude_deg, given_m=job.options.geoid_m
        ),
        colours_from_above(place, model.picture),
        sample_spacing_m(place.elevation),
        place.atlas.texel_p50_m,
        model.lit,
        model.about,
    )
    with new_folder(job.output) as folder:
        facts = write_tileset(folder, source, progress=task_progress(job.progress, "tiles"))
    return {"files": [TILESET_FILE], **facts}


_WRITERS: dict[str, Callable[[_Job, TexturedTerrain], dict[str, Any]]] = {
    "glb": _write_gltf,
    "gltf": _write_gltf,
    "usd": _write_usd,
    "3dtiles": _write_tiles,
    "blender": _write_blender,
}


def colours_from_above(place: Place, picture: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """A function that gives the levels ``(N, 3)`` of a texture of a place at positions ``(N, 3)``, by vertical rays."""
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.irradiance import surface_at
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.terrain.surface import sample_texture

    if use_backend().device == "scalar":
        raise InputError(
            "--to 3dtiles", "needs a vectorised renderer", cure="install a libLLVM; see seasonscapes doctor"
        )
    rays = ray_scene(mi_mesh(place.terrain, np.full((2, 2, 3), 0.5, np.float32)))

    def colours(position_m: np.ndarray) -> np.ndarray:
        points, index = surface_at(rays, position_m, search_m=_SEARCH_M)
        if len(index) == 0:
            raise ValueError("colours_from_above: no position lies on the terrain")
        found = np.empty((len(position_m), 3), np.float32)
        found[index] = sample_texture(picture, points.uv)
        # The mesh's rim is a chord of the raster's: what lies beyond it takes the nearest colour.
        outside = np.ones(len(position_m), bool)
        outside[index] = False
        if outside.any():
            from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

            _, nearest = cKDTree(position_m[index, :2]).query(position_m[outside, :2])
            found[outside] = found[index[nearest]]
        return np.rint(found).astype(np.uint8)

    return colours


# The mesh lies within some metres of the raster; on a cliff a cell's height may be far from it.
_SEARCH_M = 1000.0


@contextmanager
def new_folder(path: Path) -> Iterator[Path]:
    """A temporary folder that becomes ``path`` when the block succeeds, and is removed when it fails.

    Raises
    ------
    InputError
        Where there is a file, or a folder that is not empty: nothing of it is touched.
    """
    if path.is_file() or (path.is_dir() and any(path.iterdir())):
        raise InputError("--output", "is there already", got=str(path), expected="a new or empty folder")
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}-", suffix=".part", dir=path.parent))
    try:
        yield temporary
        temporary.chmod(0o755)
        # Replaces an empty folder.
        temporary.replace(path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
