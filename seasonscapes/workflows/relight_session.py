"""A view of a place under any light: daylight coefficients traced once, then one cheap evaluation per instant.

A `RenderJob` states everything by plain values, so that another process, or another machine with the same workspace,
opens the same session and renders the same frame to the digit. `open_session` turns a job into a `RelightSession`.
"""

from __future__ import annotations

import logging
import operator
from contextlib import nullcontext
from dataclasses import asdict, dataclass, field
from datetime import date, datetime
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.albedo.seasons import (
    AlbedoSeries,
    DatedAlbedo,
    day_number,
    interpolate_albedo,
    season_weights,
    snowline_fraction,
)
from seasonscapes.cameras.pinhole import Camera, view_in_frame
from seasonscapes.errors import DamagedFile, InputError
from seasonscapes.progress import Progress, task_progress
from seasonscapes.scene import NamedCamera
from seasonscapes.sky.illumination import Illumination
from seasonscapes.sky.models import SkyModel
from seasonscapes.terrain.surface import Texture
from seasonscapes.workflows.albedo_sources import (
    AlbedoFile,
    AlbedoSource,
    dated_albedos,
    keep_synthetic_albedos,
    snow_transition_between,
)
from seasonscapes.workflows.illumination import SunMoonPosition, illumination_for_camera, sky_model
from seasonscapes.workflows.place import MeshOptions, Place, load_place, utc_at
from seasonscapes.workflows.views import camera_for, camera_values, tilted_terrain, view_with_terrain
from seasonscapes.workspace import Workspace, artefact_key, build_once

if TYPE_CHECKING:
    from seasonscapes.cameras.panorama import Panorama
    from seasonscapes.rendering.coefficients import SamplingOptions, ViewCoefficients
    from seasonscapes.rendering.hemisphere_rays import RayScene
    from seasonscapes.rendering.radiance import RenderedView
    from seasonscapes.rendering.relit_view import RelightableView

log = logging.getLogger(__name__)

_TRACED_CODE = ("rendering.transport", "workflows.amplified_terrain")
_COEFFICIENTS_CODE = (*_TRACED_CODE, "rendering.coefficients_file")
_VIEW_ALBEDO_CODE = (*_TRACED_CODE, "rendering.relit_view")
FRAME_CODE = ("workflows.relight_session", "relighting.frame_file")
# Rows of the sky maps. Without clouds half as many as usual hardly change an image: the
# coefficients average over patches of 7°, and the sky behind the terrain is evaluated by the atmosphere model itself.
_CLOUDY_ROWS, _CLEAR_ROWS = 128, 64
_MIDSUMMER = date(2024, 7, 1)


@dataclass(frozen=True)
class RenderJob:
    """What to render, by plain values that can be sent to another process.

    Parameters
    ----------
    scene, workspace
        Paths; every worker must reach both.
    mesh
        How the terrain is built.
    view
        Position, angles and field of view of the camera.
    size_px
        Width and height [px].
    sky
        The sky model.
    albedo
        Recovered albedos that replace the scene's own; empty: the scene's own.
    season
        How to interpolate between dated albedos, see `albedo.seasons.season_weights`.
    base_day
        Date of the albedo that the coefficients are traced with: near the film's, since the weights of a pixel's
        samples depend on it a little.
    seed
        Of the coefficients.
    device
        ``"auto"``, ``"cuda"`` or ``"llvm"``.
    allow_outside
        Let the scene file name rasters outside its folder.
    amplify
        Add relief and albedo below the resolution of the data.
    """

    scene: Path
    workspace: Path
    mesh: MeshOptions
    view: NamedCamera
    size_px: tuple[int, int]
    sky: SkyModel
    albedo: tuple[AlbedoFile, ...] = ()
    season: str = "blended"
    base_day: date = _MIDSUMMER
    seed: int = 0
    device: str = "auto"
    allow_outside: bool = False
    amplify: bool = False


@dataclass
class RelightSession:
    """Daylight coefficients of one camera of a place, ready for any instant; made by `relight_session`.

    Parameters
    ----------
    place, camera
        The place and the camera, whose pose is in the place's frame.
    sky
        The sky model.
    albedo
        Dated albedos with their interpolation.
    seed
        Of the coefficients.
    traced_from
        All that determines the coefficients, for keys of what is made of them.
    coefficients, ray_scene, relightable
        The traced transport and its copy on the device.
    by_elevation
        Whether diffuse light is interpolated between solar elevations, which pays for many instants.
    """

    place: Place
    camera: Camera | Panorama
    sky: SkyModel
    albedo: AlbedoSeries
    seed: int
    traced_from: dict[str, Any]
    coefficients: ViewCoefficients
    ray_scene: RayScene
    relightable: RelightableView
    by_elevation: bool = False
    _albedos: dict[int, tuple[np.ndarray, ...]] = field(default_factory=dict, repr=False)
    _transitions: dict[str, tuple[np.ndarray, ...]] = field(default_factory=dict, repr=False)
    _current: tuple[list[tuple[int, float]], RelightableView] | None = field(default=None, repr=False)


def relight_session(
    place: Place,
    camera: Camera | Panorama,
    *,
    sky: str | Path | SkyModel = "clear",
    albedo: AlbedoSource = None,
    base_day: date = _MIDSUMMER,
    seed: int = 0,
    sampling: SamplingOptions | None = None,
    amplify: bool = False,
    progress: Progress | None = None,
) -> RelightSession:
    """Trace the light transport of a view once, so that every instant costs a fraction of a second.

    Coefficients are kept in the place's workspace and loaded from there the next time.

    Parameters
    ----------
    place
        The place.
    camera
        A camera or panorama; one calibrated in another frame is converted to the place's.
    sky
        A sky model, its name or its file.
    albedo
        A texture of the place's atlas, a dated albedo, an `AlbedoSeries`, or ``None`` for the scene's own.
    base_day
        Date of the albedo that the transport is traced with; best one of those that are to be rendered.
    seed
        Equal seeds give equal results.
    sampling
        Number of samples and rays; the default suits films, whose frames share the coefficients.
    amplify
        Add relief and albedo below the resolution of the data: for pictures, not for measurements. A camera near the
        ground keeps its height above it.
    progress
        Called with a task and its finished share.

    Returns
    -------
    RelightSession
        Give it to `relight`.

    Raises
    ------
    NoTerrainInView
        Where the camera sees no terrain.
    FrameMismatch, AtlasMismatch
        For a camera without a frame, or a texture of another atlas.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> camera = ss.camera(place, "aerial", size_px=(48, 32))
    >>> session = ss.relight_session(place, camera, sky="hosek")
    >>> views = [ss.relight(session, f"2024-07-20T{hour}:00") for hour in (10, 16)]
    >>> views[0].radiance.shape
    (32, 48, 3)
    """
    session = still_session(
        place,
        camera,
        sky=sky,
        albedo=albedo,
        base_day=base_day,
        seed=seed,
        sampling=sampling,
        amplify=amplify,
        progress=progress,
    )
    session.by_elevation = True
    return session


def still_session(
    place: Place,
    camera: Camera | Panorama,
    *,
    sky: str | Path | SkyModel = "clear",
    albedo: AlbedoSource = None,
    base_day: date = _MIDSUMMER,
    seed: int = 0,
    sampling: SamplingOptions | None = None,
    lambertian: bool = False,
    amplify: bool = False,
    progress: Progress | None = None,
) -> RelightSession:
    """`relight_session` for few instants: the light of each is computed, and no tables are built for it first.

    ``lambertian``: without surfaces that are not matt. ``amplify``: with detail below the resolution of the data.
    """
    from seasonscapes.rendering.coefficients import SamplingOptions
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.rendering.relit_view import relightable_view

    if isinstance(albedo, Texture):
        albedo = _undated(place, albedo)
    if albedo is None:
        albedo = AlbedoSeries(tuple(dated_albedos(place, progress=progress)))
    elif isinstance(albedo, DatedAlbedo):
        albedo = AlbedoSeries((albedo,))
    camera, model = view_in_frame(camera, place.frame), sky_model(sky)
    base = nearest_albedo(albedo, base_day)
    camera, terrain = view_with_terrain(place, camera, lambertian=lambertian, amplify=amplify)
    texture = base.load()
    # Normals are traced with, and belong to the ground: those of the base serve all dates.
    scene = ray_scene(mi_mesh(tilted_terrain(terrain, texture, amplify=amplify), texture.values))
    sampling = sampling or SamplingOptions()
    inputs = {
        "place": place.key,
        "camera": camera_values(camera),
        "base": _identity(base),
        "seed": seed,
        "sampling": asdict(sampling),
        "lambertian": lambertian,
        "amplified": amplify,
    }
    if terrain.images:
        # How finer images are read is in their tables alone.
        inputs["images"] = place.scene.image_keys
    coefficients = _coefficients(place, camera, scene, inputs, seed, sampling, progress)
    relightable = relightable_view(scene, coefficients)
    return RelightSession(place, camera, model, albedo, seed, inputs, coefficients, scene, relightable)


def relight(session: RelightSession, time: str | datetime) -> RenderedView:
    """Render a session's view at an instant from its daylight coefficients.

    Equals path tracing with the same number of bounces in expectation, without its noise.

    Parameters
    ----------
    session
        Of `relight_session`.
    time
        An aware datetime, or ISO 8601 text; without offset it is civil time at the place.

    Returns
    -------
    RenderedView
        Radiance ``(H, W, 3)`` [cd/m²], coverage and G-buffer.

    Raises
    ------
    InputError
        For a time that is none.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> session = ss.relight_session(place, ss.camera(place, "aerial", size_px=(48, 32)), sky="hosek")
    >>> morning, noon = (ss.relight(session, f"2024-07-20T{hour}:00") for hour in ("07", "13"))
    >>> bool(morning.radiance.mean() < noon.radiance.mean())
    True
    """
    return view_at(session, utc_at(session.place, time))[0]


def open_session(job: RenderJob, *, progress: Progress | None = None) -> RelightSession:
    """Load a job's place and its daylight coefficients, or trace them where the workspace has none.

    Raises
    ------
    InputError
        For mistakes in the scene or the view.
    NoTerrainInView
        Where the camera sees no terrain.
    """
    place = load_place(
        job.scene, Workspace(job.workspace), options=job.mesh, allow_outside=job.allow_outside, progress=progress
    )
    return session_of(job, place, progress=progress)


def session_of(job: RenderJob, place: Place, *, progress: Progress | None = None) -> RelightSession:
    """The session of a job whose place is loaded already; see `open_session`."""
    from seasonscapes.rendering.backend import use_backend

    use_backend(job.device)
    albedo = AlbedoSeries(tuple(dated_albedos(place, job.albedo, progress=progress)), job.season)
    if not job.albedo:
        # The first frame needs the dates before and after the base's.
        days = [dated.day for dated in albedo.dated]
        keep_synthetic_albedos(place, [days[k] for k, _ in season_weights(days, job.base_day, season=job.season)])
    return relight_session(
        place,
        camera_for(place, job.view, size_px=job.size_px),
        sky=job.sky,
        albedo=albedo,
        base_day=job.base_day,
        seed=job.seed,
        amplify=job.amplify,
        progress=progress,
    )


def _coefficients(
    place: Place,
    camera: Camera | Panorama,
    scene: RayScene,
    inputs: dict,
    seed: int,
    sampling: SamplingOptions,
    progress: Progress | None,
) -> ViewCoefficients:
    from seasonscapes.rendering.coefficients import ViewCoefficients
    from seasonscapes.rendering.coefficients_file import load_coefficients, save_coefficients
    from seasonscapes.rendering.transport import trace_view

    key = artefact_key(inputs, _COEFFICIENTS_CODE)
    folder = place.workspace.folder / f"{place.scene.name}/coefficients-{key}"
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "a file stands where a built folder belongs", cure="remove it")
    coefficients = None
    if (folder / "coefficients.json").is_file():
        try:
            coefficients = load_coefficients(folder, key=key)
        except DamagedFile as error:
            log.info("%s; light transport is traced again", error)
    if coefficients is None:
        report = task_progress(progress, "light transport")
        save_coefficients(folder, trace_view(scene, camera, sampling, seed=seed, progress=report), key=key)
        coefficients = load_coefficients(folder, key=key)
    assert isinstance(coefficients, ViewCoefficients)
    return coefficients


def _undated(place: Place, texture: Texture) -> DatedAlbedo:
    place.require_texture(texture, what="albedo")
    return DatedAlbedo(_MIDSUMMER, texture.content, lambda: texture)


def _identity(dated: DatedAlbedo) -> dict:
    return {"date": dated.day.isoformat(), "content": dated.content}


def nearest_albedo(albedo: AlbedoSeries, day: date) -> DatedAlbedo:
    """The dated albedo nearest to a day of the year."""
    return albedo.dated[season_weights([each.day for each in albedo.dated], day, season="nearest")[0][0]]


def session_key(session: RelightSession) -> str:
    """Name of everything that determines a session's frames but their times."""
    shown = {
        "sky": session.sky,
        "albedo": [_identity(dated) for dated in session.albedo.dated],
        "season": session.albedo.season,
    }
    return artefact_key(session.traced_from | shown, FRAME_CODE)


def view_at(session: RelightSession, time: datetime) -> tuple[RenderedView, Illumination, SunMoonPosition]:
    """The view at an aware instant, its illumination, and the positions of sun and moon."""
    from seasonscapes.rendering.relit_view import relight_view

    rows = _CLOUDY_ROWS if session.sky.cloudiness > 0.0 else _CLEAR_ROWS
    light, position = illumination_for_camera(
        session.place, session.camera, session.sky, time, map_height=rows, by_elevation=session.by_elevation
    )
    return relight_view(view_of_day(session, time.date()), light), light, position


def view_of_day(session: RelightSession, day: date) -> RelightableView:
    """The relightable view with the albedo of a day; the last one is kept."""
    from seasonscapes.rendering.relit_view import with_albedo

    dated = session.albedo.dated
    if len(dated) == 1:
        return session.relightable
    weights = season_weights([each.day for each in dated], day, season=session.albedo.season)
    if session._current is None or session._current[0] != weights:
        for index, _ in weights:
            if index not in session._albedos:
                session._albedos[index] = _view_albedo(session, dated[index])
        session._current = (weights, with_albedo(session.relightable, *_interpolated(session, weights, day)))
    return session._current[1]


def _interpolated(session: RelightSession, weights: list[tuple[int, float]], day: date) -> list[np.ndarray]:
    """Albedos as `_view_albedo` gives them, interpolated between the dated albedos nearest to a day."""
    parts = [session._albedos[index] for index, _ in weights]
    if len(parts) == 1 or session.albedo.season != "snow-line":
        scaled = [
            [weight * part[k] for part, (_, weight) in zip(parts, weights, strict=True)] for k in range(len(parts[0]))
        ]
        return [reduce(operator.add, terms) for terms in scaled]
    pair = [session.albedo.dated[index] for index, _ in weights]
    name = f"turning:{pair[0].content}:{pair[1].content}"
    if name not in session._transitions:
        # The time of transition is a texture like any other, and averaged over pixels like an albedo.
        transition = DatedAlbedo(pair[0].day, name, lambda: snow_transition_between(session.place, *pair))
        pixels, clusters, *mirrored = _view_albedo(session, transition, colours=False)
        coverage = np.maximum(session.coefficients.coverage[:, None], 1e-3)
        mirror = session.coefficients.mirror
        if mirror is not None:
            mirrored = [mirrored[0] / np.maximum(mirror.sample_share.sum(axis=1, dtype=np.float32)[:, None], 1e-3)]
        session._transitions = {name: (pixels / coverage, clusters, *mirrored)}
    snowline = snowline_fraction(*(day_number(each) for each in (pair[0].day, pair[1].day, day)))
    return [
        interpolate_albedo((parts[0][k], parts[1][k]), transition, weights[1][1], snowline)
        for k, transition in enumerate(session._transitions[name])
    ]


def _view_albedo(session: RelightSession, dated: DatedAlbedo, *, colours: bool = True) -> tuple[np.ndarray, ...]:
    """Mean albedo of the view's pixels, of its light clusters and, with water, of what it mirrors, for a dated texture.

    Without ``colours`` the texture holds something else, which is averaged as it is: detail belongs to colours. Kept in the workspace. The coefficients hold those of the texture that they were traced with.
    """
    from seasonscapes.rendering.mitsuba_scene import set_albedo
    from seasonscapes.rendering.relit_view import cluster_albedo, mirrored_albedo
    from seasonscapes.rendering.terrain_material import bare_texture
    from seasonscapes.rendering.transport import view_albedo

    place, traced = session.place, session.coefficients
    if _identity(dated) == session.traced_from["base"]:
        mirrored = [] if traced.mirror is None else [traced.mirror.albedo]
        return (traced.albedo, traced.clusters.points.albedo, *mirrored)

    def build() -> tuple[np.ndarray, ...]:
        set_albedo(session.ray_scene, dated.load().values)
        of_view = (view_albedo, cluster_albedo, mirrored_albedo)
        material = session.ray_scene.mi_terrain.bsdf()
        with nullcontext() if colours else bare_texture(material):
            albedos = [albedo(session.ray_scene, session.coefficients) for albedo in of_view]
        return tuple(albedo.astype(np.float16) for albedo in albedos if albedo is not None)

    albedos = build_once(
        place.workspace,
        f"{place.scene.name}/view-albedo",
        session.traced_from | {"albedo": _identity(dated)},
        code=_VIEW_ALBEDO_CODE,
        suffix=".npz",
        build=build,
        save=_save_view_albedo,
        load=_load_view_albedo,
    )
    return tuple(albedo.astype(np.float32) for albedo in albedos)


def _save_view_albedo(albedos: tuple[np.ndarray, ...], path: Path) -> None:
    np.savez(path, *albedos)


def _load_view_albedo(path: Path) -> tuple[np.ndarray, ...]:
    with np.load(path) as file:
        return tuple(file[f"arr_{number}"] for number in range(len(file.files)))
