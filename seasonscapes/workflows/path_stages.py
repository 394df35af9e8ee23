"""Stages of a run along a camera path: the path, completion by an image model, films, and Gaussians trained on frames."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.errors import InputError, NoTerrainInView
from seasonscapes.images import atomic_path
from seasonscapes.progress import Progress, each_reported, task_progress
from seasonscapes.relighting.frame_file import time_stamp
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.run_methods import PathStages, RunMethod
from seasonscapes.workspace import file_hash

if TYPE_CHECKING:
    from seasonscapes.cameras.exchange import NamedView
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.gaussians.frame_appearance import FrameGaussians, Look
    from seasonscapes.gaussians.surfels import Surfels
    from seasonscapes.workflows.path_completion import PathCompletionOptions

_FILE = "path.json"
# Of `look_of_photograph`: pixels count that Gaussians cover whole, and so many in each half are enough for 32 unknowns.
_COVERED, _FEWEST_PIXELS = 0.99, 100


def point_hashes(along: PathStages) -> dict[str, str]:
    """Contents of the files of points, where there are some."""
    if along.points is None:
        return {}
    if not along.points.is_dir():
        raise InputError("--points", "no such folder", got=str(along.points))
    return {path.name: file_hash(path) for path in sorted(along.points.glob("*.csv"))}


def path_facts(along: PathStages) -> dict:
    return {"path": None if along.path is None else file_hash(along.path), "views": along.views}


def model_facts(along: PathStages, method: RunMethod) -> dict | None:
    """What the image model is told; its weights are identified in its own record."""
    if method.completion != "diffusion" or along.diffusion is None:
        return None
    told = along.diffusion
    guide = None if told.guide_image is None else file_hash(told.guide_image)
    return {
        "weights": None if told.weights is None else str(told.weights.resolve()),
        "names": asdict(told.names),
        "prompt": told.prompt,
        "guide": guide,
        "steps": told.steps,
        "guidance": told.guidance,
        "without": sorted(told.without),
        "mask": told.mask,
    }


def make_path(place: Place, stages: PathStages, own: Path, *, size_px: tuple[int, int]) -> list[Path]:
    """Copy the path that was asked for, or make one through the scene's cameras, or around the terrain.

    Parameters
    ----------
    place
        The place.
    stages
        The path's file, or its number of views.
    own
        Folder to write into.
    size_px
        Of its views, where it is made [px].
    """
    from seasonscapes.cameras.path_file import save_path
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.gaussians.training_views import overview_cameras
    from seasonscapes.workflows.camera_paths import camera_path
    from seasonscapes.workflows.views import scene_cameras

    file = own / _FILE
    if stages.path is not None:
        with atomic_path(file) as temporary:
            shutil.copyfile(stages.path, temporary)
        return [file]
    known = list(scene_cameras(place, size_px=size_px).values()) if place.scene.cameras else []
    if len(known) > 1:
        views = camera_path(place, known, stages.views).cameras
    else:
        width, height = size_px
        views = [
            Camera(width, height, each.fx * width / each.width_px, each.fx * width / each.width_px, width / 2, height / 2,
                   each.world_from_camera, place.frame)
            for each in overview_cameras(place.terrain, stages.views)
        ]  # fmt: skip
    save_path(file, views, place.frame)
    return [file]


def path_completion(stages: PathStages, folder: Path, time: datetime, manifest: Path) -> PathCompletionOptions:
    """How the image model completes the texture of a time: along the run's path, guided by a photograph of that time.

    Raises
    ------
    InputError
        Where no weights were named.
    """
    from seasonscapes.cameras.observation import read_manifest

    if stages.diffusion is None:
        raise InputError("--weights", "missing", expected="a folder with the weights of the image model")
    nearest = min(read_manifest(manifest), key=lambda row: (abs((row.time - time).total_seconds()), row.webcam))
    guide = manifest.parent / nearest.path
    return replace(stages.diffusion, path=folder / "path" / _FILE, guide_image=stages.diffusion.guide_image or guide)


def film_path(
    place: Place,
    folder: Path,
    textures: Sequence[tuple[datetime, np.ndarray, np.ndarray]],
    own: Path,
    *,
    cloudiness: Sequence[float],
    fps: float,
    progress: Progress | None = None,
) -> list[Path]:
    """Film the completed textures along the path, and keep the frames with cameras and times (``transforms.json``).

    Parameters
    ----------
    place, folder
        The place and the run's folder, which holds the path.
    textures
        Of each time: the time, radiance ``(R, S, 3)`` [cd/m²] and which texels are painted ``(R, S)``.
    own
        Folder to write into.
    cloudiness
        Of the plain sky behind at each time, in [0, 1].
    fps
        Of the films.
    progress
        Called with a task and its finished share.
    """
    from seasonscapes.cameras.exchange import NamedView, write_transforms
    from seasonscapes.cameras.path_file import load_path
    from seasonscapes.images import write_png
    from seasonscapes.relighting.film import write_video
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.texturing.path_inpainting import textured_frames
    from seasonscapes.texturing.view_conditions import white_radiance

    cameras = load_path(folder / "path" / _FILE, place.frame)
    terrain = ray_scene(mi_mesh(place.terrain, np.full(3, 0.2)))
    files, views = [], []
    # One exposure for all times: how bright each hour is belongs to its look.
    white = max(white_radiance(values, painted) for _, values, painted in textures)
    for (time, values, _), clouds in zip(textures, cloudiness, strict=True):
        stamp = time_stamp(time)
        frames = []
        drawn = textured_frames(values, cameras, terrain, white, cloudiness=clouds)
        for number, frame in enumerate(each_reported(drawn, len(cameras), progress, f"filming {stamp}")):
            name = f"{stamp}/{number:04d}.png"
            write_png(own / name, frame)
            frames.append(frame)
            views.append(NamedView(f"{stamp}-{number:04d}", cameras[number], name, time))
            files.append(own / name)
        write_video(own / f"{stamp}.mp4", iter(frames), fps=fps)
        files.append(own / f"{stamp}.mp4")
    write_transforms(own / "transforms.json", views, place.frame)
    return [*files, own / "transforms.json"]


def disc_surfels(place: Place, discs: int) -> Surfels:
    """Discs on the terrain of a place, so many along its longer side."""
    from seasonscapes.gaussians.surfels import terrain_surfels

    return terrain_surfels(place.terrain, float(np.ptp(place.terrain.vertices[:, :2], axis=0).max()) / discs)


def timed_views(place: Place, folder: Path) -> list[NamedView]:
    """Views with pictures and times of a folder, in the frame of a place; see `read_timed_views`, whose errors it raises."""
    from seasonscapes.cameras.pinhole import view_in_frame
    from seasonscapes.cameras.timed_views import read_timed_views
    from seasonscapes.civil_time import zone_at

    origin = place.frame
    zone = zone_at(origin.latitude_deg, origin.longitude_deg)
    views = read_timed_views(folder, webcams=place.scene.webcams, time_zone=zone)
    return [replace(view, camera=view_in_frame(view.camera, origin)) for view in views]


def distil_frames(
    place: Place,
    folder: Path,
    *,
    discs: int,
    steps: int,
    directional: bool = True,
    seed: int = 0,
    progress: Progress | None = None,
) -> tuple[FrameGaussians, list[float]]:
    """Train Gaussians with the paper's appearance on the timed frames of a folder.

    Parameters
    ----------
    place
        The place, on whose terrain the Gaussians lie.
    folder
        With ``transforms.json``, as a run's ``film`` or ``distill --export-views`` writes it, or a COLMAP model; see
        `seasonscapes.cameras.timed_views.read_timed_views`.
    discs
        Gaussians along the longer side of the terrain.
    steps
        Training steps.
    directional
        Whether colours depend on the viewing direction, as in the paper.
    seed
        Equal seeds give equal models.
    progress
        Called with a task and its finished share.

    Raises
    ------
    InputError
        Where PyTorch or the frames are missing.
    """
    from seasonscapes.workflows.distillation import require_torch

    require_torch()
    from seasonscapes.gaussians.frame_appearance import TimedFrame, train_on_frames
    from seasonscapes.gaussians.rasterise import set_torch_threads
    from seasonscapes.images import read_image_linear

    set_torch_threads(1)
    surfels = disc_surfels(place, discs)
    shows_terrain = _shows_terrain(place)
    views = timed_views(place, folder)
    times = sorted({view.time for view in views if view.time is not None})
    frames = []
    for view in views:
        assert view.time is not None, "timed_views refuses views without time"
        image = read_image_linear(folder / view.file)
        if image.shape[:2] != (view.camera.height_px, view.camera.width_px):
            got = f"{image.shape[1]} x {image.shape[0]}"
            expected = f"{view.camera.width_px} x {view.camera.height_px}"
            raise InputError(folder / view.file, "another size than its camera", got=got, expected=expected)
        frames.append(TimedFrame(view.camera, times.index(view.time), image, shows_terrain(view.camera)))
    note = {"scene": place.scene.name, "seed": seed, "spacing_m": surfels.grid.spacing_m}
    note |= {"attribution": place.scene.attribution, "frames": len(frames)}
    report = task_progress(progress, "distilling frames")
    return train_on_frames(
        surfels, frames, times, steps=steps, directional=directional, seed=seed, note=note, progress=report
    )


def look_of_photograph(
    place: Place, model: FrameGaussians, camera: Camera, photograph: Path
) -> tuple[Look, dict[str, Any]]:
    """Fit a time embedding to a photograph that a model has not seen: on the left half of its terrain, scored on the right.

    Parameters
    ----------
    place, model
        The place, and a model of it.
    camera
        From where the photograph was taken.
    photograph
        A picture of the camera's shape; a larger one is reduced.

    Returns
    -------
    code, facts
        The embedding for `frame_view`; and, as plain values, the learned time that is nearest in look, and the PSNR [dB, sRGB] of
        the right half with that time's embedding and with the fitted one.

    Raises
    ------
    InputError
        Where the photograph is missing, has another shape, or shows too little terrain.
    """
    import cv2

    from seasonscapes.evaluation.metrics import psnr_db
    from seasonscapes.gaussians.frame_appearance import TimedFrame, fit_frame_code, render_frame
    from seasonscapes.images import read_image_linear, srgb_from_linear

    if not photograph.is_file():
        raise InputError(photograph, "no such file")
    image = read_image_linear(photograph)
    (height, width), size = image.shape[:2], (camera.width_px, camera.height_px)
    if abs(height * size[0] / width - size[1]) > 1.0:
        raise InputError(
            photograph, "another shape than the view", got=f"{width} x {height}", expected="{} x {}".format(*size)
        )
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    try:
        _, coverage = render_frame(model, camera, model.times[0])
        usable = _shows_terrain(place)(camera) & (coverage > _COVERED)
        # Halves of the terrain rather than of the picture: a slope may fill one side alone.
        sums = np.cumsum(usable.sum(axis=0))
        left = usable & (np.arange(size[0]) <= np.searchsorted(sums, sums[-1] / 2.0))
        right = usable & ~left
        if min(left.sum(), right.sum()) < _FEWEST_PIXELS:
            raise NoTerrainInView(f"shows less than {_FEWEST_PIXELS} pixels of terrain in one half")
        code, nearest = fit_frame_code(model, TimedFrame(camera, 0, image, left))
    except NoTerrainInView as error:
        raise InputError(photograph, str(error)) from None
    scores = [
        psnr_db(srgb_from_linear(image), srgb_from_linear(render_frame(model, camera, look)[0]), right)
        for look in (model.appearance.codes[nearest].detach(), code)
    ]
    facts = {"like": photograph.name, "nearest_time_utc": model.times[nearest].isoformat()}
    return code, facts | {"psnr_nearest_db": round(scores[0], 2), "psnr_fitted_db": round(scores[1], 2)}


def _shows_terrain(place: Place) -> Callable[[Camera], np.ndarray]:
    """Gives the mask ``(H, W)`` of a view's pixels that show terrain."""
    from seasonscapes.rendering.gbuffer import trace_gbuffer
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.texturing.inputs import unlit_scene

    scene = unlit_scene(ray_scene(mi_mesh(place.terrain, np.full(3, 0.2))))
    return lambda camera: np.isfinite(trace_gbuffer(scene, camera).depth)


def frame_view(place: Place, model: FrameGaussians, camera: Camera, time: Look, *, cloudiness: float) -> np.ndarray:
    """Picture ``(H, W, 3)``, display-linear, of a model of `distil_frames` at an hour, before a plain sky.

    Parameters
    ----------
    place, model
        The place, and a model of it.
    camera
        The view.
    time
        Aware; or the embedding of `look_of_photograph`.
    cloudiness
        Of the sky, in [0, 1].
    """
    from seasonscapes.cameras.pinhole import ray_directions
    from seasonscapes.gaussians.frame_appearance import render_frame
    from seasonscapes.images import linear_from_srgb
    from seasonscapes.texturing.view_conditions import plain_sky

    sky = linear_from_srgb(plain_sky(ray_directions(camera), cloudiness=cloudiness))
    picture, coverage = render_frame(model, camera, time)
    return np.clip(picture + (1.0 - coverage[..., None]) * sky, 0.0, 1.0)


def load_frame_model(place: Place, file: Path) -> FrameGaussians:
    """Read a model of `distil_frames`; `InputError` where it is damaged or of another place."""
    from seasonscapes.gaussians.frame_appearance import load_frame_gaussians
    from seasonscapes.gaussians.surfels import terrain_surfels
    from seasonscapes.workflows.gaussian_views import require_scene

    model = load_frame_gaussians(file, lambda spacing_m: terrain_surfels(place.terrain, spacing_m))
    require_scene(model, place)
    return model
