"""``seasonscapes inpaint --method diffusion``: an image model paints along a path, then the land tells the rest."""

from __future__ import annotations

import time as clock
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cyclopts import Parameter

from seasonscapes.commands.talk import check_range, check_suffix, progress_bar, say
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from seasonscapes.pipeline import Place
    from seasonscapes.terrain.surface import Texture
    from seasonscapes.texturing.completion import Completed
    from seasonscapes.texturing.diffusion import DiffusionSettings, Painter
    from seasonscapes.texturing.path_inpainting import InpaintingState, PathInpaintingInputs
    from seasonscapes.texturing.predictors import Predictors

# Raised when equal inputs give other views.
_REVISION = 1
_PARTS = ("prompt", "depth", "mask", "image")
_HYBRID_STRENGTH = 0.4


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class DiffusionOptions:
    """Of --method diffusion."""

    path: Path | None = None
    """The views to go along, from `seasonscapes path`."""
    weights: Path | None = None
    """Folder with the weights as OWNER/NAME; without, the hub's cache on this machine. Nothing is downloaded."""
    base: str = "stable-diffusion-v1-5/stable-diffusion-v1-5"
    """Stable Diffusion 1.5: a hub name or a folder."""
    depth_net: str = "lllyasviel/control_v11f1p_sd15_depth"
    """ControlNet for depth."""
    inpaint_net: str = "lllyasviel/control_v11p_sd15_inpaint"
    """ControlNet for inpainting."""
    adapter: str = "h94/IP-Adapter"
    """IP-Adapter, for --guide-image."""
    prompt: str | None = None
    """What to ask for; default by date, hour and sky."""
    guide_image: Path | None = None
    """A picture of the hour whose looks to take on, such as a webcam's that is not judged afterwards."""
    hybrid: bool = False
    """Complete by guided first; the model then only adds detail."""
    strength: float | None = None
    """1 paints from noise (default); with --hybrid default 0.4."""
    steps: int = 50
    """Of the sampler."""
    guidance: float = 2.9
    """How much the prompt counts."""
    without: str | None = None
    """Leave out conditions, with commas between: prompt, depth, mask, image."""
    mask: str = "coverage"
    """How holes are known: coverage, or hsv (red pixels, as in the reference implementation)."""
    dilate_px: int = 8
    """Repaint so much around holes, to join; the texture keeps what was there."""
    least_hole: float = 0.001
    """Skip views of which a smaller share of the land is a hole."""
    paint_sky: bool = False
    """Let the model paint the sky of the frames too."""
    frames: Path | None = None
    """Folder for views: partial picture, mask, depth, result; default in the workspace. An interrupted run resumes there."""
    film: Path | None = None
    """An .mp4 along the path with the finished texture."""
    fps: float = 24.0
    """Of --film."""
    device: str = "auto"
    """auto, cuda or cpu."""
    dtype: str = "auto"
    """auto (float16 on a GPU), float16, bfloat16 or float32."""
    offload: bool = False
    """Keep parts in main memory until their turn: slower, for small GPUs."""

    def check(self) -> None:
        """`InputError` about flags that cannot work, before anything is built."""
        from seasonscapes.texturing.view_conditions import MASKS

        if self.path is None:
            raise InputError("--path", "missing", expected="a .json of `seasonscapes path`")
        if not self.path.is_file():
            raise InputError("--path", "no such file", got=str(self.path), cure="make one with `seasonscapes path`")
        if self.guide_image is not None and not self.guide_image.is_file():
            raise InputError("--guide-image", "no such file", got=str(self.guide_image))
        if self.mask not in MASKS:
            raise InputError("--mask", "unknown", got=self.mask, expected=" or ".join(MASKS))
        for name in self.left_out():
            if name not in _PARTS:
                raise InputError("--without", "unknown condition", got=name, expected="of " + ", ".join(_PARTS))
        check_range("--steps", self.steps, 1, 1000)
        check_range("--guidance", self.guidance, 1.0, 100.0)
        check_range("--strength", self.chosen_strength(), 1.0 / self.steps, 1.0)
        check_range("--dilate-px", self.dilate_px, 0, 512)
        check_range("--least-hole", self.least_hole, 0.0, 1.0)
        check_range("--fps", self.fps, 1.0, 240.0)
        if self.film is not None:
            check_suffix(self.film, (".mp4",))

    def left_out(self) -> set[str]:
        """Conditions that are switched off."""
        return {name.strip() for name in (self.without or "").split(",")} - {""}

    def chosen_strength(self) -> float:
        """The flag, or what goes with the mode."""
        return self.strength if self.strength is not None else _HYBRID_STRENGTH if self.hybrid else 1.0

    def settings(self, prompt: str) -> DiffusionSettings:
        """What the model is told, the same for all views."""
        from seasonscapes.texturing.diffusion import DiffusionSettings

        known, out = DiffusionSettings(), self.left_out()
        return DiffusionSettings(
            prompt="" if "prompt" in out else prompt,
            depth_scale=0.0 if "depth" in out else known.depth_scale,
            inpaint_scale=0.0 if "mask" in out else known.inpaint_scale,
            steps=self.steps,
            guidance=self.guidance,
            image_scale=0.0 if "image" in out else known.image_scale,
            strength=self.chosen_strength(),
        )


@dataclass(frozen=True)
class Effort:
    """What `inpaint` says about completion and randomness."""

    detail: float = 0.0
    fast: bool = False
    seed: int = 0
    cloudiness: float = 0.0


def complete_along_path(
    land: Place, painted: Texture, predictors: Predictors, time: datetime, flags: DiffusionOptions, effort: Effort
) -> tuple[Completed, dict[str, Any]]:
    """Paint along the path, complete what is left by guided, and film it; what was completed, and plain facts about it."""
    import numpy as np

    from seasonscapes.cameras.path_file import load_path
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.texturing.atlas_tiles import tiling
    from seasonscapes.texturing.completion import complete
    from seasonscapes.texturing.path_inpainting import InpaintingState, PathInpaintingInputs

    cameras = load_path(flags.path, land.frame)  # type: ignore[arg-type]
    prompt = flags.prompt if flags.prompt is not None else prompt_of(land, time, effort.cloudiness)
    painter, identity = _painter(flags, prompt)
    if "prompt" not in flags.left_out():
        say(f"prompt: {prompt}")
    if painter.slow:
        say("on a CPU these weights take over an hour for each view of 1536 × 1024 with 50 steps; use a GPU")

    def guided(texture: Texture, detail: float, title: str) -> Completed:
        with progress_bar(title) as progress:
            return complete(texture, predictors, detail=detail, fast=effort.fast, seed=effort.seed, progress=progress)

    alone = guided(painted, 0.0, "completing (guided)") if flags.hybrid else None
    inputs = PathInpaintingInputs(
        painted,
        cameras,
        tiling(land.terrain, land.atlas),
        ray_scene(mi_mesh(land.terrain, np.full(3, 0.2))),
        None if alone is None else alone.values,
    )
    state = InpaintingState(painted)
    folder = _folder(land, painted, flags, effort, identity)
    told = _walked(inputs, state, painter, flags, effort, folder, predictors.surface)
    rest = guided(state.texture(), effort.detail, "completing the rest (guided)")
    completed = joined(rest, alone or guided(painted, 0.0, "judging what was painted (guided)"), state)
    told |= {"prompt": prompt, "views_folder": str(folder), "weights": identity["weights"], "film": None}
    if flags.film is not None:
        told["film"] = _filmed(inputs, state, completed.values, flags, effort)
    return completed, told


def joined(rest: Completed, alone: Completed, state: InpaintingState) -> Completed:
    """The completion of what the model left open, with what it gave; nothing that was painted has moved.

    What an image model made up has no standard error of its own: it is said to be off by as much as a completion from the
    painted texels alone is, and as far as the two are apart.
    """
    import numpy as np

    from seasonscapes.texturing.completion import Completed

    apart = np.mean((rest.values - alone.values) ** 2, axis=2)
    sigma = np.where(state.imagined, np.sqrt(alone.sigma**2 + apart), rest.sigma).astype(np.float32)
    return Completed(rest.values, sigma, state.painted)


def prompt_of(land: Place, time: datetime, cloudiness: float) -> str:
    """The prompt of a place's hour."""
    from seasonscapes.sky.ephemeris import sun_position
    from seasonscapes.texturing.prompts import prompt_for

    latitude, longitude = land.frame.latitude_deg, land.frame.longitude_deg
    sun = sun_position(time, latitude, longitude)
    return prompt_for(time, latitude, float(sun.elevation_deg), cloudiness=cloudiness)


def _painter(flags: DiffusionOptions, prompt: str) -> tuple[Painter, dict[str, Any]]:
    """The model, and plain values that tell it from any other."""
    from seasonscapes.texturing.diffusion import Machine, load_painter, needed_parts
    from seasonscapes.texturing.model_weights import WeightNames, find_weights, weights_fingerprint
    from seasonscapes.workspace import file_hash

    names = WeightNames(flags.base, flags.depth_net, flags.inpaint_net, flags.adapter)
    image = None if flags.guide_image is None else _guide_picture(flags.guide_image)
    settings, machine = flags.settings(prompt), Machine(flags.device, flags.dtype, flags.offload)
    painter = load_painter(flags.weights, settings, names=names, machine=machine, image=image)
    prints = {
        part: weights_fingerprint(find_weights(flags.weights, part, getattr(names, part)), part, getattr(names, part))
        for part in needed_parts(settings, image is not None)
    }
    guide = None if flags.guide_image is None else file_hash(flags.guide_image)
    return painter, {
        "weights": prints,
        "settings": settings,
        "guide": guide,
        "device": painter.device,
        "dtype": flags.dtype,
    }


def _guide_picture(path: Path) -> np.ndarray:
    from seasonscapes.images import read_image_linear, srgb_from_linear

    try:
        return srgb_from_linear(read_image_linear(path))
    except ValueError as error:
        raise InputError("--guide-image", str(error)) from None


def _folder(land: Place, painted: Texture, flags: DiffusionOptions, effort: Effort, identity: dict[str, Any]) -> Path:
    """Where the views of exactly this run lie."""
    import hashlib

    from seasonscapes.workspace import content_key, file_hash

    texture = hashlib.sha256(painted.values.tobytes() + painted.weight.tobytes()).hexdigest()
    key = content_key(
        {
            "revision": _REVISION,
            "place": land.key,
            "texture": texture,
            "path": file_hash(flags.path),
            "hybrid": flags.hybrid,
            "fast": effort.fast and flags.hybrid,
            "seed": effort.seed,
            "cloudiness": effort.cloudiness,
            "mask": flags.mask,
            "dilate": flags.dilate_px,
            "least": flags.least_hole,
            "sky": flags.paint_sky,
            **identity,
        }
    )
    above = flags.frames if flags.frames is not None else land.workspace.folder / land.scene.name
    return above / f"diffusion-{key}"


def _walked(
    inputs: PathInpaintingInputs,
    state: InpaintingState,
    painter: Painter,
    flags: DiffusionOptions,
    effort: Effort,
    folder: Path,
    surface: np.ndarray,
) -> dict[str, Any]:
    """Go along the path; coverage of the surface before and after each view, and how long views took."""
    import numpy as np

    from seasonscapes.texturing.path_inpainting import PathInpaintingOptions, inpaint_along_path

    options = PathInpaintingOptions(
        flags.mask, flags.dilate_px, flags.least_hole, flags.paint_sky, effort.cloudiness, effort.seed
    )
    size = max(int(surface.sum()), 1)
    coverage, seconds, skipped, before = [float((state.covered & surface).sum() / size)], [], 0, clock.perf_counter()
    with progress_bar(f"painting {len(inputs.cameras)} views") as progress:
        for step in inpaint_along_path(inputs, state, painter, options, folder=folder, progress=progress):
            now = clock.perf_counter()
            seconds, before = seconds + ([] if step.skipped else [now - before]), now
            skipped += step.skipped
            coverage.append(float((state.covered & surface).sum() / size))
    return {
        "coverage": coverage,
        "views": len(inputs.cameras),
        "views_skipped": skipped,
        "seconds_per_view": float(np.median(seconds)) if seconds else None,
    }


def _filmed(
    inputs: PathInpaintingInputs, state: InpaintingState, values: np.ndarray, flags: DiffusionOptions, effort: Effort
) -> str:
    from seasonscapes.relighting.film import write_film
    from seasonscapes.texturing.path_inpainting import frames_of
    from seasonscapes.texturing.view_conditions import white_radiance

    white = white_radiance(state.values, state.painted)
    frames = frames_of(values, inputs.cameras, inputs.terrain, white, cloudiness=effort.cloudiness)
    with progress_bar("filming") as progress:
        write_film(flags.film, _counted(frames, len(inputs.cameras), progress), fps=flags.fps)  # type: ignore[arg-type]
    return str(flags.film)


def _counted(frames: Any, count: int, progress: Any) -> Any:
    for number, frame in enumerate(frames):
        progress(number / count)
        yield frame
