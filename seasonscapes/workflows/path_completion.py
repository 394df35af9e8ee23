"""Completion by an image model along a camera path (Algorithm 1 of the SeasonScapes paper), then by regression."""

from __future__ import annotations

import hashlib
import logging
import time as clock
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.errors import InputError, UnreadableImage
from seasonscapes.progress import Progress, each_reported, task_progress
from seasonscapes.terrain.surface import Texture
from seasonscapes.texturing.diffusion import DeviceSettings, DiffusionSettings
from seasonscapes.texturing.model_weights import WeightNames
from seasonscapes.workflows.place import Place
from seasonscapes.workspace import artefact_key, file_hash

if TYPE_CHECKING:
    from seasonscapes.texturing.completion import CompletedTexture, CompletionOptions
    from seasonscapes.texturing.diffusion import DiffusionInpainter
    from seasonscapes.texturing.path_inpainting import InpaintingState, PathInpaintingInputs, PathInpaintingOptions
    from seasonscapes.texturing.predictors import Predictors

log = logging.getLogger(__name__)

_CODE = ("texturing.path_inpainting", "texturing.diffusion", "texturing.completion")
# What the model is told; `paint`: what it continues from.
CONDITIONS = ("prompt", "depth", "mask", "image", "paint")
_HYBRID_STRENGTH = 0.4


@dataclass(frozen=True)
class PathCompletionOptions:
    """How an image model paints along a path.

    Parameters
    ----------
    path
        The camera path, a ``.json`` file of ``seasonscapes path``.
    weights
        Folder with the weights as ``OWNER/NAME``; ``None`` looks into the hub's cache. Nothing is downloaded.
    names
        Which weights.
    prompt
        Text prompt; ``None`` makes one from date, hour and sky.
    guide_image
        A picture of the hour for the IP-Adapter.
    hybrid
        Complete by regression first; the model then only adds detail.
    strength
        1 paints from noise; ``None`` is 1, or 0.4 with ``hybrid``.
    steps, guidance
        Of the sampler; classifier-free guidance scale.
    without
        Conditions that are switched off, among `CONDITIONS`. Without ``"paint"`` the model paints all that it sees, and
        of the painting only the brightness is used.
    mask
        How holes are found: ``"coverage"`` or ``"hsv"``.
    dilate_px
        Repaint so much around holes, for seamless borders; the texture keeps what was there.
    least_hole
        Skip views of which a smaller share of the terrain is a hole.
    paint_sky
        Let the model paint the sky of the frames too.
    frames
        Folder for views; ``None`` is the workspace. An interrupted run resumes there.
    film, fps
        An ``.mp4`` along the path with the finished texture.
    device_settings
        Device, number format and offloading.
    """

    path: Path
    weights: Path | None = None
    names: WeightNames = field(default_factory=WeightNames)
    prompt: str | None = None
    guide_image: Path | None = None
    hybrid: bool = False
    strength: float | None = None
    steps: int = 50
    guidance: float = 2.9
    without: frozenset[str] = frozenset()
    mask: str = "coverage"
    dilate_px: int = 8
    least_hole: float = 0.001
    paint_sky: bool = False
    frames: Path | None = None
    film: Path | None = None
    fps: float = 24.0
    device_settings: DeviceSettings = field(default_factory=DeviceSettings)

    def __post_init__(self) -> None:
        if self.hybrid and "paint" in self.without:
            raise InputError("--hybrid", "of no use with --without paint: it completes what is painted")

    @property
    def effective_strength(self) -> float:
        """The stated strength, or the default of the mode."""
        return self.strength if self.strength is not None else _HYBRID_STRENGTH if self.hybrid else 1.0

    def settings(self, prompt: str) -> DiffusionSettings:
        """Settings of the model, the same for all views."""
        default, out = DiffusionSettings(), self.without
        return DiffusionSettings(
            prompt="" if "prompt" in out else prompt,
            depth_scale=0.0 if "depth" in out else default.depth_scale,
            inpaint_scale=0.0 if "mask" in out else default.inpaint_scale,
            steps=self.steps,
            guidance=self.guidance,
            image_scale=0.0 if "image" in out else default.image_scale,
            strength=self.effective_strength,
        )


@dataclass(frozen=True)
class SkyState:
    """Time and cloudiness of the photographs, from which the prompt and the sky of the frames are made.

    Parameters
    ----------
    utc
        Time of the photographs, aware.
    cloudiness
        Fraction of the sky covered by clouds, in [0, 1].
    """

    utc: datetime
    cloudiness: float = 0.0


def complete_along_path(
    place: Place,
    painted: Texture,
    predictors: Predictors,
    sky: SkyState,
    options: PathCompletionOptions,
    completion: CompletionOptions,
    *,
    progress: Progress | None = None,
) -> tuple[CompletedTexture, dict[str, Any]]:
    """Paint along the path with an image model, complete the rest by regression, and film the result.

    Parameters
    ----------
    place, painted, predictors
        The place, its painted texture and the predictors of the regression.
    sky
        Time and cloudiness of the photographs.
    options
        Options of the image model and its views.
    completion
        Method and effort of the completion of the remaining texels; its seed is the image model's too.
    progress
        Called with a task and its finished share.

    Returns
    -------
    CompletedTexture, dict
        The completed texture, and plain values about views, coverage, prompt and weights.

    Raises
    ------
    InputError
        For missing or incomplete weights, an unreadable path or guide image.
    """
    from seasonscapes.cameras.path_file import load_path
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.texturing.atlas_tiles import tiling
    from seasonscapes.texturing.completion import complete
    from seasonscapes.texturing.path_inpainting import InpaintingState, PathInpaintingInputs, PathInpaintingOptions
    from seasonscapes.texturing.view_conditions import white_radiance

    cameras = load_path(options.path, place.frame)
    prompt = options.prompt if options.prompt is not None else prompt_of(place, sky.utc, sky.cloudiness)
    inpainter, identity = _load_inpainter(options, prompt)
    if "prompt" not in options.without:
        log.info("prompt: %s", prompt)
    if inpainter.slow:
        log.info("on a CPU these weights take over an hour for each view of 1536 × 1024 with 50 steps; use a GPU")

    method = completion.method

    def regression(texture: Texture, detail: float, task: str) -> CompletedTexture:
        report = task_progress(progress, task)
        return complete(texture, predictors, options=replace(completion, detail=detail), progress=report)

    alone = regression(painted, 0.0, f"completing ({method})") if options.hybrid else None
    given = InpaintingState(painted)
    start = replace(painted, weight=np.zeros_like(painted.weight)) if "paint" in options.without else painted
    inputs = PathInpaintingInputs(
        start,
        cameras,
        tiling(place.terrain, place.atlas),
        ray_scene(mi_mesh(place.terrain, np.full(3, 0.2))),
        None if alone is None else alone.values,
        white_radiance(given.values, given.painted),
    )
    state = InpaintingState(start)
    view_options = PathInpaintingOptions(
        options.mask, options.dilate_px, options.least_hole, options.paint_sky, sky.cloudiness, completion.seed
    )
    folder = _views_folder(place, start, options, completion, {"cloudiness": sky.cloudiness, **identity})
    facts = _painted_views(inputs, state, inpainter, view_options, folder, predictors.surface, progress)
    rest = regression(state.texture(), completion.detail, f"completing the rest ({method})")
    completed = join_completions(
        rest, alone or regression(painted, 0.0, f"error of the generated texels ({method})"), state
    )
    facts |= {
        "prompt": prompt,
        "without": sorted(options.without),
        "views_folder": str(folder),
        "weights": identity["weights"],
        "film": None,
    }
    if options.film is not None:
        facts["film"] = _film(inputs, completed.values, options, sky.cloudiness, progress)
    return completed, facts


def join_completions(rest: CompletedTexture, alone: CompletedTexture, state: InpaintingState) -> CompletedTexture:
    """Join the completion of what the model left open with the texels that it painted; painted texels do not change.

    Generated texels have no standard error of their own. It is set to the error of a completion from the painted texels
    alone, plus the difference between the two.
    """
    from seasonscapes.texturing.completion import CompletedTexture

    difference = np.mean((rest.values - alone.values) ** 2, axis=2)
    sigma = np.where(state.generated, np.sqrt(alone.sigma**2 + difference), rest.sigma).astype(np.float32)
    return CompletedTexture(rest.values, sigma, state.painted)


def prompt_of(place: Place, utc: datetime, cloudiness: float) -> str:
    """The prompt for a place at an hour; see `texturing.prompts`."""
    from seasonscapes.sky.ephemeris import sun_position
    from seasonscapes.texturing.prompts import prompt_for

    latitude, longitude = place.frame.latitude_deg, place.frame.longitude_deg
    sun = sun_position(utc, latitude, longitude)
    return prompt_for(utc, latitude, float(sun.elevation_deg), cloudiness=cloudiness)


def _load_inpainter(options: PathCompletionOptions, prompt: str) -> tuple[DiffusionInpainter, dict[str, Any]]:
    """The loaded model, and plain values that identify it."""
    from seasonscapes.texturing.diffusion import load_inpainter, required_parts
    from seasonscapes.texturing.model_weights import find_weights, weights_fingerprint

    names = options.names
    image = None if options.guide_image is None else _guide_picture(options.guide_image)
    settings = options.settings(prompt)
    inpainter = load_inpainter(
        options.weights, settings, names=names, device_settings=options.device_settings, image=image
    )
    prints = {}
    for part in required_parts(settings, image is not None):
        name = getattr(names, part)
        prints[part] = weights_fingerprint(find_weights(options.weights, part, name), part, name)
    return inpainter, {
        "weights": prints,
        "settings": settings,
        "guide": None if options.guide_image is None else file_hash(options.guide_image),
        "device": inpainter.device,
        "dtype": options.device_settings.dtype,
    }


def _guide_picture(path: Path) -> np.ndarray:
    from seasonscapes.images import read_image_linear, srgb_from_linear

    try:
        return srgb_from_linear(read_image_linear(path))
    except UnreadableImage as error:
        raise InputError("--guide-image", str(error)) from None


def _views_folder(
    place: Place,
    painted: Texture,
    options: PathCompletionOptions,
    completion: CompletionOptions,
    identity: dict[str, Any],
) -> Path:
    """The folder of the views of exactly this run."""
    texture = hashlib.sha256(painted.values.tobytes() + painted.weight.tobytes()).hexdigest()
    inputs = {
        "place": place.key,
        "texture": texture,
        "path": file_hash(options.path),
        "hybrid": options.hybrid,
        "regression": [completion.method, completion.fast] if options.hybrid else None,
        "seed": completion.seed,
        "mask": options.mask,
        "dilate": options.dilate_px,
        "least": options.least_hole,
        "sky": options.paint_sky,
        **identity,
    }
    above = options.frames if options.frames is not None else place.workspace.folder / place.scene.name
    return above / f"diffusion-{artefact_key(inputs, _CODE)}"


def _painted_views(
    inputs: PathInpaintingInputs,
    state: InpaintingState,
    inpainter: DiffusionInpainter,
    options: PathInpaintingOptions,
    folder: Path,
    surface: np.ndarray,
    progress: Progress | None,
) -> dict[str, Any]:
    """Paint all views; coverage of the surface before and after each one, and the time of each."""
    from seasonscapes.texturing.path_inpainting import inpaint_along_path

    size = max(int(surface.sum()), 1)
    coverage, seconds, skipped, before = [float((state.covered & surface).sum() / size)], [], 0, clock.perf_counter()
    report = task_progress(progress, f"painting {len(inputs.cameras)} views")
    for step in inpaint_along_path(inputs, state, inpainter, options, folder=folder, progress=report):
        now = clock.perf_counter()
        seconds, before = seconds + ([] if step.skipped else [now - before]), now
        skipped += step.skipped
        coverage.append(float((state.covered & surface).sum() / size))
    median_s = float(np.median(seconds)) if seconds else None
    return {"coverage": coverage, "views": len(inputs.cameras), "views_skipped": skipped, "seconds_per_view": median_s}


def _film(
    inputs: PathInpaintingInputs,
    values: np.ndarray,
    options: PathCompletionOptions,
    cloudiness: float,
    progress: Progress | None,
) -> str:
    from seasonscapes.relighting.film import write_video
    from seasonscapes.texturing.path_inpainting import textured_frames

    assert options.film is not None
    assert inputs.white is not None
    frames: Iterator[np.ndarray] = textured_frames(
        values, inputs.cameras, inputs.terrain, inputs.white, cloudiness=cloudiness
    )
    write_video(options.film, each_reported(frames, len(inputs.cameras), progress, "filming"), fps=options.fps)
    return str(options.film)
