"""Distillation: a Gaussian model of a place trained on its path-traced light of many dates and hours."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from importlib.util import find_spec
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.albedo.seasons import DatedAlbedo, day_number
from seasonscapes.errors import InputError, NoTerrainInView
from seasonscapes.progress import Progress, each_reported, task_progress
from seasonscapes.sky.models import SkyModel
from seasonscapes.workflows.albedo_sources import dated_albedos, scene_albedo
from seasonscapes.workflows.illumination import illumination_at, sky_model, sun_moon_position
from seasonscapes.workflows.place import Place
from seasonscapes.workspace import artefact_key

if TYPE_CHECKING:
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.gaussians.disc_transport import DiscTransport, LightState
    from seasonscapes.gaussians.losses import TrainingFrame
    from seasonscapes.gaussians.model import GaussianModel
    from seasonscapes.gaussians.surfels import Surfels
    from seasonscapes.gaussians.training import SurfaceTargets
    from seasonscapes.sky.illumination import Illumination

log = logging.getLogger(__name__)

KINDS = ("full", "physical", "sun")
# Discs that a run makes where its cameras look; about 40 processor seconds.
RUN_DISCS = 50_000
_YEAR = 2024
# A scene with one image has one albedo for the whole year.
_ONE_DAY = 200.0


@dataclass(frozen=True)
class DistilOptions:
    """How to distil.

    Parameters
    ----------
    discs
        Gaussians along the longer side of the terrain.
    disc_px
        Largest side of a disc in pictures of ``view_px`` from the scene's cameras and webcams [px]: where they look, cells of discs
        are quartered until it holds. 0, or for the scene's own cameras no ``views``, leaves all discs of one size.
    most_discs
        Largest number of discs: where ``disc_px`` needs more, they are all as much larger as that takes. 0: as many as it needs.
    suns
        Instants to train on, at random hours of the dates' days.
    dates
        Dates of the year whose albedo is stored separately, for scenes that know their albedo of every day.
    views, view_px
        Cameras around the terrain for training images, and the size of these [px]; 0 trains on the surface alone.
    learn_near
        Whether the cameras that discs follow are learned from too, where there are ``views``. Otherwise discs that are fine
        because of them keep place, size, direction and opacity.
    steps, picture_steps
        Training steps on the surface, and on images.
    kind
        ``"full"`` (physics and a network), ``"physical"`` (no network) or ``"sun"`` (a network alone, for comparison).
    refine_discs
        Whether the images also refine place, size, direction and opacity of the discs.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> ss.DistilOptions(discs=80, suns=8).kind
    'full'
    """

    discs: int = 320
    disc_px: float = 2.0
    most_discs: int = 0
    suns: int = 32
    dates: int = 4
    views: int = 6
    view_px: int = 256
    learn_near: bool = True
    steps: int = 2500
    picture_steps: int = 240
    kind: str = "full"
    refine_discs: bool = True

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError("--kind", "unknown kind", got=self.kind, expected=", ".join(KINDS))


@dataclass(frozen=True)
class DistillationData:
    """Everything that a model is trained on.

    Parameters
    ----------
    surfels
        N discs on the terrain.
    albedo, around
        Of each date: albedo of the discs ``(M, N, 3)``, and its mean over their neighbourhoods.
    days
        Days of the year of the dates.
    transport
        Light transport of the discs.
    targets
        Light states and target colours of the discs.
    times
        Instants, aware UTC.
    frames, cameras
        Training images, camera by camera, and the cameras; none of those of the scene that see no disc.
    """

    surfels: Surfels
    albedo: np.ndarray
    around: np.ndarray
    days: list[float]
    transport: DiscTransport
    targets: SurfaceTargets
    times: list[datetime]
    frames: list[TrainingFrame]
    cameras: list[Camera]


@dataclass(frozen=True)
class Distilled:
    """A distilled model, what it was trained on, and the loss of every step."""

    model: GaussianModel
    data: DistillationData
    losses: list[float]


def require_torch() -> None:
    """`InputError` where the extra that Gaussians need is missing."""
    if find_spec("torch") is None or find_spec("safetensors") is None:
        raise InputError("gaussians", "PyTorch is not installed", cure="pip install 'seasonscapes[gaussians]'")


def distil(
    place: Place,
    *,
    sky: str | Path | SkyModel = "clear",
    albedo: Sequence[DatedAlbedo] | DatedAlbedo | None = None,
    options: DistilOptions | None = None,
    seed: int = 0,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
) -> GaussianModel:
    """Distil a Gaussian model of a place, which is then lit for any date and hour in a fraction of a second.

    Parameters
    ----------
    place
        The place.
    sky
        A sky model, its name or its file.
    albedo
        Dated albedos, or ``None`` for the scene's own.
    options
        Size of the model and effort of the training.
    seed
        Equal seeds give equal models.
    checkpoint
        A file that an interrupted training continues from; removed by the caller when the model is saved.
    progress
        Called with a task and its finished share.

    Returns
    -------
    GaussianModel
        For `render_gaussians`; `gaussians.model.save_model` writes it.

    Raises
    ------
    InputError
        Where PyTorch is missing, or two albedos have the same day of the year.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> quick = ss.DistilOptions(discs=12, suns=2, dates=1, views=0, steps=2, picture_steps=0)
    >>> model = ss.distil(place, sky="hosek", options=quick)
    >>> camera = ss.camera(place, "aerial", size_px=(48, 32))
    >>> ss.render_gaussians(model, place, camera, "2024-07-20T13:30", sky="hosek").radiance.shape
    (32, 48, 3)
    """
    return distil_with_data(
        place, sky=sky, albedo=albedo, options=options, seed=seed, checkpoint=checkpoint, progress=progress
    ).model


def distil_with_data(
    place: Place,
    *,
    sky: str | Path | SkyModel = "clear",
    albedo: Sequence[DatedAlbedo] | DatedAlbedo | None = None,
    options: DistilOptions | None = None,
    near: Mapping[str, Camera] | None = None,
    seed: int = 0,
    checkpoint: Path | None = None,
    progress: Progress | None = None,
) -> Distilled:
    """`distil`, with the training data and losses; ``near`` are the cameras that discs follow, by name, in place of the scene's."""
    require_torch()
    from seasonscapes.gaussians.appearance import Appearance, fourier_embedding
    from seasonscapes.gaussians.disc_geometry import DiscGeometry
    from seasonscapes.gaussians.model import model_from
    from seasonscapes.gaussians.rasterise import set_torch_threads
    from seasonscapes.gaussians.splat_view import learned_parameters
    from seasonscapes.gaussians.training import Checkpoint, Schedule, train

    options = options or DistilOptions()
    set_torch_threads(1)
    dated = [albedo] if isinstance(albedo, DatedAlbedo) else list(albedo or ())
    model = sky_model(sky)
    near = near_cameras(place, options) if near is None else near
    data = distillation_data(place, model, dated, options, near=near, seed=seed, progress=progress)
    appearance = Appearance(
        options.kind,
        data.albedo,
        data.around,
        data.transport,
        fourier_embedding(data.surfels.means, seed=seed),
        times=options.suns,
        seed=seed,
    )
    if options.refine_discs and data.frames:
        # Pictures from elsewhere show many discs at once that were made fine for a camera, and cannot tell their changes apart.
        fixed = None if options.learn_near else data.surfels.level > 0
        appearance.refine(DiscGeometry(data.surfels, fixed))
    losses = train(
        appearance,
        data.targets,
        data.frames,
        Schedule(options.steps, options.picture_steps),
        seed=seed,
        checkpoint=checkpoint and Checkpoint(checkpoint, _data_key(place, model, dated, options, near)),
        progress=task_progress(progress, "distilling"),
    )
    note = {"scene": place.scene.name, "seed": seed, "suns": options.suns, "attribution": place.scene.attribution}
    distilled = model_from(
        data.surfels,
        data.albedo,
        data.days,
        data.transport,
        learned_parameters(appearance),
        frame=place.frame,
        note=note,
    )
    return Distilled(distilled, data, losses)


def _data_key(
    place: Place, model: SkyModel, dated: Sequence[DatedAlbedo], options: DistilOptions, near: Mapping[str, Camera]
) -> str:
    """Identifier of everything that the training data are made from, except the seed."""
    from seasonscapes.workflows.views import camera_values

    inputs = {
        "place": place.key,
        "sky": model,
        "albedo": [[each.day, each.content] for each in dated],
        "images": None if dated else place.scene.image_keys,
        "options": options,
        "near": [camera_values(camera) for camera in near.values()],
    }
    return artefact_key(inputs, ("workflows.distillation",))


def dated_textures(place: Place, dated: Sequence[DatedAlbedo], dates: int) -> list[tuple[float, np.ndarray]]:
    """Days of the year and albedo textures ``(R, S, 3)``: the given ones, or the scene's own of so many dates.

    Raises
    ------
    InputError
        Where two given albedos have the same day of the year.
    """
    if dated:
        found = sorted(((day_number(each.day), each.load().values) for each in dated), key=lambda pair: pair[0])
        if any(first[0] == second[0] for first, second in pairwise(found)):
            raise InputError("--albedo", "names a day of the year twice", cure="give one albedo for each")
        return found
    if len(place.scene.images) > 1:
        return sorted(
            ((day_number(each.day), each.load().values) for each in dated_albedos(place)), key=lambda pair: pair[0]
        )
    days = [_ONE_DAY]
    if place.synthetic is not None:
        days = np.linspace(15.0, 366.0 + 15.0, dates + 1)[:-1].round().tolist()
    noon = datetime(_YEAR, 1, 1, 12, tzinfo=UTC)
    return [(day, scene_albedo(place, noon + timedelta(days=day - 1)).values) for day in days]


def distillation_data(
    place: Place,
    model: SkyModel,
    dated: Sequence[DatedAlbedo],
    options: DistilOptions,
    *,
    near: Mapping[str, Camera] | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> DistillationData:
    """Trace the training targets: each date has its own albedo, and with it its own interreflection.

    Parameters
    ----------
    place, model, dated
        The place, the sky model, and given albedos (empty: the scene's own).
    options, seed
        Size and randomness.
    near
        Cameras that discs follow, by name; those of `near_cameras` if omitted.
    progress
        Called with a task and its finished share.
    """
    from seasonscapes.gaussians.disc_density import surfels_for
    from seasonscapes.gaussians.disc_transport import (
        light_state,
        neighbourhood_mean,
        surfel_irradiance,
        trace_disc_transport,
    )
    from seasonscapes.gaussians.land_shadows import disc_shadows
    from seasonscapes.gaussians.surfels import surfel_albedo, terrain_surfels
    from seasonscapes.gaussians.training import surface_targets
    from seasonscapes.gaussians.training_views import overview_cameras, relit_frames
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh

    pairs = dated_textures(place, dated, options.dates)
    days, textures = [day for day, _ in pairs], [texture for _, texture in pairs]
    extent_m = float(np.ptp(place.terrain.vertices[:, :2], axis=0).max())
    surfels = terrain_surfels(place.terrain, extent_m / options.discs)
    near = near_cameras(place, options) if near is None else near
    if near and options.disc_px > 0.0:
        first = mi_mesh(place.terrain, textures[0])
        stage = RenderScene(ray_scene(first).mi_scene, first)
        surfels = surfels_for(place.terrain, surfels, stage, list(near.values()), options.disc_px, options.most_discs)
    albedo = np.stack([surfel_albedo(surfels, texture) for texture in textures])
    around = np.stack([neighbourhood_mean(surfels.means, each, surfels.spacing_m) for each in albedo])
    seasons = [number % len(days) for number in range(options.suns)]
    lights, times = draw_lights(place, model, [days[season] for season in seasons], seed=seed, progress=progress)
    received = np.empty((options.suns, len(surfels.means), 3), np.float32)
    transport, shadows, states, frames = None, None, [], []
    around_all = overview_cameras(place.terrain, options.views, size_px=options.view_px, first_deg=30.0)
    cameras: list[Camera] = []
    for season, texture in enumerate(textures):
        own = [number for number in range(options.suns) if seasons[number] == season]
        scene = ray_scene(mi_mesh(place.terrain, texture))
        if transport is None:
            report = task_progress(progress, "transport")
            shadows = disc_shadows(scene, surfels)
            transport = trace_disc_transport(scene, surfels, albedo[season], rays=64, seed=seed, progress=report)
            states = [
                light_state(transport, light, float(at.timetuple().tm_yday))
                for light, at in zip(lights, times, strict=True)
            ]
        if own:
            report = task_progress(progress, f"surface, date {season + 1} of {len(days)}")
            received[own] = surfel_irradiance(
                scene, surfels, [lights[number] for number in own], rays=128, seed=seed, progress=report
            )
        # Images of one date suffice: they determine the splats' shapes, not the season.
        if season == len(days) // 2 and options.views and own:
            wanted = [(number, lights[number], states[number]) for number in own]
            views = [*(near if options.learn_near else {}).items(), *((None, camera) for camera in around_all)]
            for name, camera in each_reported(views, len(views), progress, "pictures"):
                try:
                    frames += relit_frames(scene, surfels, [camera], wanted, seed=seed)
                except NoTerrainInView as error:
                    if name is None:
                        raise
                    log.warning("nothing is learned from %s: %s", name, error)
                else:
                    cameras.append(camera)
    assert transport is not None, "there is at least one date"
    targets = surface_targets(states, seasons, albedo, received, shadows)
    return DistillationData(surfels, albedo, around, days, transport, targets, times, frames, cameras)


def near_cameras(place: Place, options: DistilOptions) -> dict[str, Camera]:
    """The scene's cameras and webcams, in pictures of the training's size, where discs are to follow them."""
    from seasonscapes.workflows.disc_cameras import scene_disc_cameras

    if options.disc_px <= 0.0 or options.views == 0:
        return {}
    return scene_disc_cameras(place, (options.view_px, options.view_px))


def draw_lights(
    place: Place, model: SkyModel, days: Sequence[float], *, seed: int = 0, progress: Progress | None = None
) -> tuple[list[Illumination], list[datetime]]:
    """One illumination for each day of the year, at a random hour with the sun above 2°, or the best of 64 tries."""
    rng, height_m, frame = np.random.default_rng(seed), place.median_height_m, place.frame
    lights, times = [], []
    for day in each_reported(days, len(days), progress, "light"):
        tried = []
        while len(tried) < 64 and not (tried and tried[-1].sun.elevation_deg > 2.0):
            hours = float(rng.uniform(0.0, 24.0))
            at = datetime(_YEAR, 1, 1, tzinfo=UTC) + timedelta(days=day - 1, hours=hours)
            tried.append(sun_moon_position(at, frame.latitude_deg, frame.longitude_deg, height_m))
        candidates = tried[-1:] if tried[-1].sun.elevation_deg > 2.0 else tried
        best = max(candidates, key=lambda position: position.sun.elevation_deg)
        lights.append(illumination_at(model, best, height_m, workspace=place.workspace))
        times.append(best.time)
    log.info("%d instants, %s to %s UTC", len(days), f"{min(times):%d %b %H:%M}", f"{max(times):%d %b %H:%M}")
    return lights, times


def export_training_views(folder: Path, place: Place, data: DistillationData) -> None:
    """Write the training images as PNG, with cameras, times and suns for other trainers (nerfstudio, COLMAP)."""
    from seasonscapes.cameras.exchange import NamedView
    from seasonscapes.gaussians.interchange import IMAGE_FOLDER, BakedSplats, TrainingView, write_training_views
    from seasonscapes.images import srgb_from_linear, write_png

    per_camera, views = len(data.frames) // max(len(data.cameras), 1), []
    for number, frame in enumerate(data.frames):
        name = f"{IMAGE_FOLDER}/{number:04d}.png"
        write_png(folder / name, np.clip(frame.image, 0.0, 1.0))
        view = NamedView(f"{number:04d}", data.cameras[number // per_camera], name, data.times[frame.time])
        views.append(TrainingView(view, _state(data, frame.time)))
    surfels = data.surfels
    rgb = srgb_from_linear(data.albedo[len(data.days) // 2]).astype(np.float32)
    splats = BakedSplats(surfels.means, surfels.quaternions, surfels.log_scales, surfels.opacity_logits, rgb)
    write_training_views(folder, views, splats, place.frame)


def _state(data: DistillationData, time: int) -> LightState:
    return data.targets.states[time]


def distillation_record(place: Place, distilled: Distilled) -> dict[str, Any]:
    """Plain values about a distilled model."""
    from seasonscapes.gaussians.model import bytes_per_gaussian

    surfels, losses = distilled.data.surfels, distilled.losses
    return {
        "scene": place.scene.name,
        "gaussians": len(surfels.means),
        "spacing_m": round(surfels.grid.spacing_m, 2),
        "least_spacing_m": round(float(surfels.spacing_m.min()), 2),
        "bytes_per_gaussian": round(bytes_per_gaussian(distilled.model), 1),
        "suns": len(distilled.data.times),
        "dates": distilled.data.days,
        "refined": bool(distilled.model.changes),
        "loss": losses[-1] if losses else None,
    }
