"""Stable Diffusion 1.5 with two ControlNets and an image prompt, as the SeasonScapes paper uses it to fill holes.

Depth and inpaint ControlNets (Zhang, Rao & Agrawala 2023), IP-Adapter (Ye et al. 2023), Euler's ancestral sampler: all by
`diffusers`. Needs the extra ``diffusion``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.texturing.model_weights import WeightNames, find_weights, variant_of
from seasonscapes.texturing.prompts import NEGATIVE
from seasonscapes.texturing.view_conditions import Conditions

# Latents are this many times smaller than pictures.
_CELL_PX = 8
# What hides a pixel from the inpaint ControlNet, as it was trained.
_HIDDEN = -1.0
# More parameters than this are real weights: on a CPU a large view then takes over an hour.
_LARGE = 100_000_000


@dataclass(frozen=True)
class DiffusionSettings:
    """How to paint; the defaults are the paper's.

    Parameters
    ----------
    prompt, negative
        Empty switches the text off.
    depth_scale, inpaint_scale, image_scale
        Weights of the depth ControlNet, of the inpaint ControlNet and of the guide image; 0 leaves that part out, and its
        weights are not looked for.
    steps, guidance
        Of the sampler, and of classifier-free guidance (1 is none).
    strength
        1 paints from noise; 0.3 to 0.5 adds detail to what is there (*hybrid*).
    """

    prompt: str = ""
    negative: str = NEGATIVE
    depth_scale: float = 1.5
    inpaint_scale: float = 0.5
    image_scale: float = 1.0
    steps: int = 50
    guidance: float = 2.9
    strength: float = 1.0

    def __post_init__(self):
        if self.steps < 1 or int(self.steps * self.strength) < 1:
            raise ValueError(f"DiffusionSettings: {self.steps} steps at strength {self.strength} leave none to do")
        if not 0.0 < self.strength <= 1.0 or self.guidance < 1.0:
            raise ValueError("DiffusionSettings: strength must be in (0, 1] and guidance at least 1")


@dataclass(frozen=True)
class Machine:
    """Where to run: ``device`` and ``dtype`` by name, and whether parts wait in main memory for their turn."""

    device: str = "auto"
    dtype: str = "auto"
    offload: bool = False


@dataclass(frozen=True)
class Painter:
    """A loaded model; call it with `Conditions`."""

    pipe: Any
    settings: DiffusionSettings
    image_embeds: Any
    device: str

    @property
    def slow(self) -> bool:
        """Real weights without a GPU."""
        return self.device == "cpu" and sum(p.numel() for p in self.pipe.unet.parameters()) > _LARGE

    def __call__(self, view: Conditions, tell: Callable[[float], None] | None = None) -> np.ndarray:
        """Paint the hole of a view: an sRGB-encoded picture ``(H, W, 3)`` float32. All of it is the model's.

        Raises
        ------
        InputError
            The GPU's memory ran out.
        """
        import torch

        try:
            return _painted(self, view, tell or (lambda share: None))
        except torch.OutOfMemoryError as error:
            if torch.cuda.is_available():
                torch.cuda.empty_cache()
            height, width = view.hole.shape
            raise InputError(
                "--device",
                f"the GPU's memory ran out at {width} × {height}",
                got=_first_line(error),
                cure="finished views are kept: run the same command again with --offload, or make a path of "
                "smaller --size",
            ) from None


def _first_line(error: Exception) -> str:
    return (str(error).strip().splitlines() or [""])[0][:160]


def load_painter(
    folder: Path | None,
    settings: DiffusionSettings,
    *,
    names: WeightNames | None = None,
    machine: Machine | None = None,
    image: np.ndarray | None = None,
) -> Painter:
    """Read the weights that the settings ask for.

    Parameters
    ----------
    folder
        Weights folder; left out, the hub's cache. See `model_weights.find_weights`.
    image
        Guide picture ``(h, w, 3)`` sRGB-encoded in [0, 1], such as a webcam's of that hour; without one the IP-Adapter
        is not used.

    Raises
    ------
    InputError
        Missing, wrong or half-downloaded weights, weights that do not fit each other, a missing extra, no such device.
    """
    names, machine = names or WeightNames(), machine or Machine()
    places = {
        part: find_weights(folder, part, getattr(names, part)) for part in needed_parts(settings, image is not None)
    }
    _require_extra()
    device, dtype = _device_of(machine)
    pipe = _assembled(places, settings, dtype)
    embeds = None
    if image is not None and settings.image_scale > 0.0:
        embeds = _adapted(pipe, places["adapter"], image, settings, device)
    if machine.offload and device != "cpu":
        pipe.enable_model_cpu_offload(device=device)
        # Decoding a large picture at once needs more memory than all else; in tiles its colours are a little uneven.
        pipe.vae.enable_tiling()
    else:
        pipe.to(device)
    pipe.set_progress_bar_config(disable=True)
    return Painter(pipe, settings, embeds, device)


def needed_parts(settings: DiffusionSettings, with_image: bool) -> list[str]:
    """Which parts of the weights these settings need: names of fields of `WeightNames`."""
    scales = {
        "depth": settings.depth_scale,
        "inpaint": settings.inpaint_scale,
        "adapter": settings.image_scale if with_image else 0.0,
    }
    parts = ["base", *(part for part, scale in scales.items() if scale > 0.0)]
    # The pipeline wants a ControlNet; with weight 0 it has no say.
    return parts if {"depth", "inpaint"} & set(parts) else [*parts, "inpaint"]


def _require_extra() -> None:
    try:
        import diffusers
        import torch  # noqa: F401
        import transformers
    except ImportError as error:
        raise InputError(
            "--method diffusion",
            f"{error.name} is not installed",
            cure="pip install 'seasonscapes[diffusion]', or take --method guided, which needs none of it",
        ) from None
    diffusers.utils.logging.set_verbosity_error()
    diffusers.utils.logging.disable_progress_bar()
    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()


def _device_of(machine: Machine) -> tuple[str, Any]:
    import torch

    device = machine.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if device not in ("cpu", "cuda"):
        raise InputError("--device", "unknown device", got=device, expected="auto, cuda or cpu")
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "--device", "no CUDA GPU is usable here", got="cuda", cure="leave --device out to run on the CPU"
        )
    dtypes = {"float16": torch.float16, "bfloat16": torch.bfloat16, "float32": torch.float32}
    name = machine.dtype if machine.dtype != "auto" else ("float16" if device == "cuda" else "float32")
    if name not in dtypes:
        raise InputError("--dtype", "unknown number format", got=name, expected="auto, " + ", ".join(dtypes))
    return device, dtypes[name]


def _assembled(places: dict[str, Path], settings: DiffusionSettings, dtype: Any) -> Any:
    """The pipeline of the base's parts and the ControlNets, all of one number format."""
    from diffusers import (
        AutoencoderKL,
        ControlNetModel,
        EulerAncestralDiscreteScheduler,
        StableDiffusionControlNetInpaintPipeline,
        UNet2DConditionModel,
    )
    from transformers import CLIPTextModel, CLIPTokenizer

    base = places["base"]
    unet = _read(UNet2DConditionModel, base / "unet", dtype)
    nets = {part: _read(ControlNetModel, places[part], dtype) for part in ("depth", "inpaint") if part in places}
    text = _read(CLIPTextModel, base / "text_encoder", dtype)
    _check_fit(unet, text, nets, places)
    pipe = StableDiffusionControlNetInpaintPipeline(
        vae=_read(AutoencoderKL, base / "vae", dtype),
        text_encoder=text,
        tokenizer=CLIPTokenizer.from_pretrained(base / "tokenizer"),
        unet=unet,
        controlnet=list(nets.values()),
        safety_checker=None,
        feature_extractor=None,
        scheduler=EulerAncestralDiscreteScheduler.from_pretrained(base / "scheduler"),
        requires_safety_checker=False,
    )
    return pipe


def _read(kind: Any, place: Path, dtype: Any) -> Any:
    from safetensors import SafetensorError

    diffusers_made = kind.__module__.startswith("diffusers")
    stem, key = ("diffusion_pytorch_model", "torch_dtype") if diffusers_made else ("model", "dtype")
    try:
        model, report = kind.from_pretrained(
            place,
            variant=variant_of(place, stem),
            use_safetensors=True,
            local_files_only=True,
            output_loading_info=True,
            **{key: dtype},
        )
    except (SafetensorError, OSError, RuntimeError, ValueError) as error:
        raise InputError("--weights", f"{place} cannot be read: {_first_line(error)}") from None
    # Tensors that a file lacks are left as they were made, at random: no picture would tell why.
    lacking = [name for name in report["missing_keys"] if not name.endswith("position_ids")]
    if lacking:
        raise InputError(
            "--weights",
            f"{place} lacks {len(lacking)} tensors of its model, such as {lacking[0]}",
            cure="these are the weights of something else",
        )
    return model.eval()


def _check_fit(unet: Any, text: Any, nets: dict[str, Any], places: dict[str, Path]) -> None:
    width = unet.config.cross_attention_dim
    if text.config.hidden_size != width or unet.config.in_channels not in (4, 9):
        raise InputError(
            "--weights",
            f"{places['base']} is no Stable Diffusion 1.5",
            expected=f"a text encoder as wide as the UNet's attention ({width}) and 4 or 9 channels",
        )
    for part, net in nets.items():
        if (net.config.cross_attention_dim, tuple(net.config.block_out_channels)) != (
            width,
            tuple(unet.config.block_out_channels),
        ):
            raise InputError(
                "--weights",
                f"{places[part]} is a ControlNet for another base model",
                got=f"attention {net.config.cross_attention_dim}",
                expected=f"attention {width}",
            )


def _adapted(pipe: Any, place: Path, image: np.ndarray, settings: DiffusionSettings, device: str) -> list:
    """Load the IP-Adapter; the guide picture as the image encoder sees it."""
    import torch
    from PIL import Image

    try:
        pipe.load_ip_adapter(
            str(place), subfolder="models", weight_name="ip-adapter_sd15.safetensors", local_files_only=True
        )
    except (RuntimeError, ValueError, KeyError, OSError) as error:
        raise InputError("--weights", f"{place} does not fit the base model: {_first_line(error)}") from None
    pipe.set_ip_adapter_scale(settings.image_scale)
    predictor = Image.fromarray(np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8))
    pipe.image_encoder.to(device)
    with torch.no_grad():
        return pipe.prepare_ip_adapter_image_embeds(predictor, None, device, 1, settings.guidance > 1.0)


def _painted(painter: Painter, view: Conditions, tell: Callable[[float], None]) -> np.ndarray:
    import torch

    settings, pipe = painter.settings, painter.pipe
    height, width = view.hole.shape
    rim = ((0, -height % _CELL_PX), (0, -width % _CELL_PX))
    picture = np.pad(view.picture, (*rim, (0, 0)), mode="edge")
    hole, depth = np.pad(view.hole, rim, mode="edge"), np.pad(view.depth, rim, mode="edge")
    controls, scales = [], []
    if settings.depth_scale > 0.0:
        controls.append(_tensor(np.repeat(depth[..., None], 3, axis=2)))
        scales.append(settings.depth_scale)
    if settings.inpaint_scale > 0.0 or not controls:
        controls.append(_tensor(np.where(hole[..., None], _HIDDEN, picture)))
        scales.append(settings.inpaint_scale)
    todo = max(1, int(settings.steps * settings.strength))

    def after_step(_pipe: Any, number: int, _time: Any, held: dict) -> dict:
        tell((number + 1) / todo)
        return held

    with torch.no_grad():
        found = pipe(
            prompt=settings.prompt,
            negative_prompt=settings.negative if settings.prompt else "",
            image=_tensor(picture),
            mask_image=_tensor(whole_cells(hole)[..., None]),
            control_image=controls,
            height=hole.shape[0],
            width=hole.shape[1],
            num_inference_steps=settings.steps,
            guidance_scale=settings.guidance,
            strength=settings.strength,
            controlnet_conditioning_scale=scales,
            output_type="np",
            # Drawn on the CPU: a seed then means the same noise on every device.
            generator=torch.Generator("cpu").manual_seed(view.seed),
            ip_adapter_image_embeds=painter.image_embeds,
            callback_on_step_end=after_step,
        ).images[0]
    if not np.isfinite(found).all():
        raise InputError("--dtype", "the model overflowed", cure="run again with --dtype bfloat16 or float32")
    return found[:height, :width].astype(np.float32)


def _tensor(picture: np.ndarray) -> Any:
    import torch

    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1), np.float32))[None]


def whole_cells(hole: np.ndarray) -> np.ndarray:
    """A mask ``(H, W)`` grown to whole latent cells of 8 × 8 pixels.

    The pipeline takes one pixel of each cell for all of them, and would not see a hole of a few pixels.
    """
    rows, columns = hole.shape[0] // _CELL_PX, hole.shape[1] // _CELL_PX
    cells = hole.reshape(rows, _CELL_PX, columns, _CELL_PX).any(axis=(1, 3))
    return np.kron(cells, np.ones((_CELL_PX, _CELL_PX), bool))
