"""Flags of ``seasonscapes inpaint --method diffusion``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_choice, check_range, parse_names
from seasonscapes.commands.outputs import check_output
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.workflows.path_completion import PathCompletionOptions


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class DiffusionOptions:
    """Of --method diffusion."""

    path: Path | None = None
    """The views to paint, from `seasonscapes path`."""
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
    """Text prompt; default by date, hour and sky."""
    guide_image: Path | None = None
    """A picture of the hour whose looks to adopt, such as a webcam's that is not scored afterwards."""
    hybrid: bool = False
    """Complete by guided first; the model then only adds detail."""
    strength: float | None = None
    """1 paints from noise (default); with --hybrid default 0.4."""
    steps: int = 50
    """Of the sampler."""
    guidance: float = 2.9
    """Classifier-free guidance: how much the prompt counts."""
    without: str | None = None
    """Leave out conditions, with commas between: prompt, depth, mask, image, paint (the painted texels)."""
    mask: str = "coverage"
    """How holes are found: coverage, or hsv (red pixels, as in the reference implementation)."""
    dilate_px: int = 8
    """Repaint so much around holes, for seamless borders; the texture keeps what was there."""
    least_hole: float = 0.001
    """Skip views of which a smaller share of the terrain is a hole."""
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

    def values(self) -> PathCompletionOptions:
        """The flags as one value; `InputError` about flags that cannot work, before anything is built."""
        from seasonscapes.texturing.diffusion import DeviceSettings
        from seasonscapes.texturing.model_weights import WeightNames
        from seasonscapes.texturing.view_conditions import MASKS
        from seasonscapes.workflows.path_completion import CONDITIONS, PathCompletionOptions

        if self.path is None:
            raise InputError("--path", "missing", expected="a .json of `seasonscapes path`")
        if not self.path.is_file():
            raise InputError("--path", "no such file", got=str(self.path), cure="make one with `seasonscapes path`")
        if self.guide_image is not None and not self.guide_image.is_file():
            raise InputError("--guide-image", "no such file", got=str(self.guide_image))
        check_choice("--mask", self.mask, tuple(MASKS))
        without = frozenset(parse_names(self.without))
        for name in sorted(without - set(CONDITIONS)):
            raise InputError("--without", "unknown condition", got=name, expected="of " + ", ".join(CONDITIONS))
        options = PathCompletionOptions(
            self.path,
            self.weights,
            WeightNames(self.base, self.depth_net, self.inpaint_net, self.adapter),
            prompt=self.prompt,
            guide_image=self.guide_image,
            hybrid=self.hybrid,
            strength=self.strength,
            steps=self.steps,
            guidance=self.guidance,
            without=without,
            mask=self.mask,
            dilate_px=self.dilate_px,
            least_hole=self.least_hole,
            paint_sky=self.paint_sky,
            frames=self.frames,
            film=self.film,
            fps=self.fps,
            device_settings=DeviceSettings(self.device, self.dtype, self.offload),
        )
        check_range("--steps", self.steps, 1, 1000)
        check_range("--guidance", self.guidance, 1.0, 100.0)
        check_range("--strength", options.effective_strength, 1.0 / self.steps, 1.0)
        check_range("--dilate-px", self.dilate_px, 0, 512)
        check_range("--least-hole", self.least_hole, 0.0, 1.0)
        check_range("--fps", self.fps, 1.0, 240.0)
        if self.film is not None:
            check_output(self.film, (".mp4",), flag="--film")
        return options
