"""Image inpainting with Stable Diffusion 1.5, two ControlNets and an image prompt, as in the SeasonScapes paper.

Depth and inpaint ControlNets (Zhang, Rao & Agrawala 2023), IP-Adapter (Ye et al. 2023) and Euler's ancestral sampler,
as implemented in `diffusers`. Needs the extra ``diffusion``.
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
from seasonscapes.texturing.view_conditions import ViewConditions

# Pixels per side of a latent cell.
_CELL_PX = 8
# Value of masked pixels in the training data of the inpaint ControlNet.
_MASKED = -1.0
# Number of parameters above which a large view takes over an hour on a CPU.
_LARGE = 100_000_000

Progress = Callable[[float], None]


@dataclass(frozen=True)
class DiffusionSettings:
    """Settings of the sampler and its conditions; the defaults are the paper's.

    Parameters
    ----------
    prompt, negative
        Prompt and negative prompt; an empty prompt disables text conditioning.
    depth_scale, inpaint_scale, image_scale
        Weights of the depth ControlNet, the inpaint ControlNet and the image prompt; 0 disables that part, whose weight
        files are then not needed.
    steps
        Steps of the sampler.
    guidance
        Scale of classifier-free guidance; 1 is none.
    strength
        1 starts from pure noise; 0.3 to 0.5 adds detail to the given picture (*hybrid*).

    Raises
    ------
    ValueError
        No step would be run, or ``strength`` or ``guidance`` is out of range.
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
class DeviceSettings:
    """Device and number format of the model.

    Parameters
    ----------
    device
        ``auto``, ``cuda`` or ``cpu``.
    dtype
        ``auto``, ``float16``, ``bfloat16`` or ``float32``.
    offload
        Keep the parts of the model in main memory and move each to the GPU only while it runs.
    """

    device: str = "auto"
    dtype: str = "auto"
    offload: bool = False


@dataclass(frozen=True)
class DiffusionInpainter:
    """A loaded image model, called with `ViewConditions`.

    Parameters
    ----------
    pipe
        Pipeline of `diffusers`.
    settings
        Settings of the sampler.
    image_embeds
        Embeddings of the image prompt, or ``None``.
    device
        Name of the device.
    """

    pipe: Any
    settings: DiffusionSettings
    image_embeds: Any
    device: str

    @property
    def slow(self) -> bool:
        """Whether a large model runs on a CPU."""
        return self.device == "cpu" and sum(p.numel() for p in self.pipe.unet.parameters()) > _LARGE

    def __call__(self, view: ViewConditions, progress: Progress | None = None) -> np.ndarray:
        """Inpaint the hole of a view.

        Parameters
        ----------
        view
            Picture, hole, depth and seed.
        progress
            Called with the finished fraction.

        Returns
        -------
        ndarray
            ``(H, W, 3)`` float32, sRGB-encoded. Pixels outside the hole differ from the given ones too.

        Raises
        ------
        InputError
            The GPU's memory ran out, or the model overflowed.
        """
        import torch

        try:
            return _inpaint(self, view, progress or (lambda fraction: None))
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


def load_inpainter(
    folder: Path | None,
    settings: DiffusionSettings,
    *,
    names: WeightNames | None = None,
    device_settings: DeviceSettings | None = None,
    image: np.ndarray | None = None,
) -> DiffusionInpainter:
    """Load the parts of the image model that the settings need.

    Parameters
    ----------
    folder
        Weights folder, or ``None`` for the hub's cache. See `model_weights.find_weights`.
    settings
        Settings of the sampler.
    names
        Hub names or folders of the parts; defaults to `WeightNames()`.
    device_settings
        Device and number format; defaults to `DeviceSettings()`.
    image
        Image prompt ``(h, w, 3)``, sRGB-encoded in [0, 1], such as a webcam photograph of the same hour; without one
        the IP-Adapter is not used.

    Returns
    -------
    DiffusionInpainter
        The loaded model.

    Raises
    ------
    InputError
        Weights that are missing, wrong, incomplete or incompatible with each other; a missing package; an unknown or
        unavailable device.
    """
    names, device_settings = names or WeightNames(), device_settings or DeviceSettings()
    folders = {
        part: find_weights(folder, part, getattr(names, part)) for part in required_parts(settings, image is not None)
    }
    _require_extra()
    device, dtype = _device_of(device_settings)
    pipe = _assemble(folders, dtype)
    embeds = None
    if image is not None and settings.image_scale > 0.0:
        embeds = _encode_image_prompt(pipe, folders["adapter"], image, settings, device)
    if device_settings.offload and device != "cpu":
        pipe.enable_model_cpu_offload(device=device)
        # Decoding a large picture at once needs more memory than any other step; tiles cause slight colour differences.
        pipe.vae.enable_tiling()
    else:
        pipe.to(device)
    pipe.set_progress_bar_config(disable=True)
    return DiffusionInpainter(pipe, settings, embeds, device)


def required_parts(settings: DiffusionSettings, with_image: bool) -> list[str]:
    """Return the parts of the model that the settings need.

    Parameters
    ----------
    settings
        Settings of the sampler.
    with_image
        Whether there is an image prompt.

    Returns
    -------
    list of str
        Field names of `WeightNames`.
    """
    scales = {
        "depth": settings.depth_scale,
        "inpaint": settings.inpaint_scale,
        "adapter": settings.image_scale if with_image else 0.0,
    }
    parts = ["base", *(part for part, scale in scales.items() if scale > 0.0)]
    # The pipeline needs at least one ControlNet; its weight may be 0.
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
            cure="pip install 'seasonscapes[diffusion]', or use --method guided, which does not need it",
        ) from None
    diffusers.utils.logging.set_verbosity_error()
    diffusers.utils.logging.disable_progress_bar()
    transformers.utils.logging.set_verbosity_error()
    transformers.utils.logging.disable_progress_bar()


def _device_of(device_settings: DeviceSettings) -> tuple[str, Any]:
    import torch

    device = device_settings.device
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if device not in ("cpu", "cuda"):
        raise InputError("--device", "unknown device", got=device, expected="auto, cuda or cpu")
    if device == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "--device", "no CUDA GPU is usable here", got="cuda", cure="leave --device out to run on the CPU"
        )
    dtypes = {"float16": torch.float16, "bfloat16": torch.bfloat16, "float32": torch.float32}
    name = device_settings.dtype if device_settings.dtype != "auto" else ("float16" if device == "cuda" else "float32")
    if name not in dtypes:
        raise InputError("--dtype", "unknown number format", got=name, expected="auto, " + ", ".join(dtypes))
    return device, dtypes[name]


def _assemble(folders: dict[str, Path], dtype: Any) -> Any:
    """Pipeline of the base model and the ControlNets, all in one number format."""
    import diffusers
    from transformers import CLIPTextModel, CLIPTokenizer

    # The lazily loaded names of diffusers are not visible to type checkers.
    classes: Any = diffusers
    base = folders["base"]
    unet = _load_model(classes.UNet2DConditionModel, base / "unet", dtype)
    nets = {
        part: _load_model(classes.ControlNetModel, folders[part], dtype)
        for part in ("depth", "inpaint")
        if part in folders
    }
    text = _load_model(CLIPTextModel, base / "text_encoder", dtype)
    _check_compatible(unet, text, nets, folders)
    return classes.StableDiffusionControlNetInpaintPipeline(
        vae=_load_model(classes.AutoencoderKL, base / "vae", dtype),
        text_encoder=text,
        tokenizer=CLIPTokenizer.from_pretrained(base / "tokenizer"),
        unet=unet,
        controlnet=list(nets.values()),
        safety_checker=None,
        feature_extractor=None,
        scheduler=classes.EulerAncestralDiscreteScheduler.from_pretrained(base / "scheduler"),
        requires_safety_checker=False,
    )


def _load_model(model_class: Any, folder: Path, dtype: Any) -> Any:
    from safetensors import SafetensorError

    from_diffusers = model_class.__module__.startswith("diffusers")
    stem, key = ("diffusion_pytorch_model", "torch_dtype") if from_diffusers else ("model", "dtype")
    try:
        model, loading_info = model_class.from_pretrained(
            folder,
            variant=variant_of(folder, stem),
            use_safetensors=True,
            local_files_only=True,
            output_loading_info=True,
            **{key: dtype},
        )
    except (SafetensorError, OSError, RuntimeError, ValueError) as error:
        raise InputError("--weights", f"{folder} cannot be read: {_first_line(error)}") from None
    # Tensors missing in the file keep their random initial values, which no later check would notice.
    missing = [name for name in loading_info["missing_keys"] if not name.endswith("position_ids")]
    if missing:
        raise InputError(
            "--weights",
            f"{folder} lacks {len(missing)} tensors of its model, such as {missing[0]}",
            cure="use the weights of this model; these belong to another one",
        )
    return model.eval()


def _check_compatible(unet: Any, text: Any, nets: dict[str, Any], folders: dict[str, Path]) -> None:
    width = unet.config.cross_attention_dim
    if text.config.hidden_size != width or unet.config.in_channels not in (4, 9):
        raise InputError(
            "--weights",
            f"{folders['base']} is not Stable Diffusion 1.5",
            expected=f"a text encoder as wide as the UNet's attention ({width}) and 4 or 9 channels",
        )
    for part, net in nets.items():
        if (net.config.cross_attention_dim, tuple(net.config.block_out_channels)) != (
            width,
            tuple(unet.config.block_out_channels),
        ):
            raise InputError(
                "--weights",
                f"{folders[part]} is a ControlNet for another base model",
                got=f"attention {net.config.cross_attention_dim}",
                expected=f"attention {width}",
            )


def _encode_image_prompt(pipe: Any, folder: Path, image: np.ndarray, settings: DiffusionSettings, device: str) -> Any:
    """Load the IP-Adapter and compute the embeddings of the image prompt."""
    import torch
    from PIL import Image

    try:
        pipe.load_ip_adapter(
            str(folder), subfolder="models", weight_name="ip-adapter_sd15.safetensors", local_files_only=True
        )
    except (RuntimeError, ValueError, KeyError, OSError) as error:
        raise InputError("--weights", f"{folder} does not fit the base model: {_first_line(error)}") from None
    pipe.set_ip_adapter_scale(settings.image_scale)
    prompt_image = Image.fromarray(np.round(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8))
    pipe.image_encoder.to(device)
    with torch.no_grad():
        return pipe.prepare_ip_adapter_image_embeds(prompt_image, None, device, 1, settings.guidance > 1.0)


def _inpaint(inpainter: DiffusionInpainter, view: ViewConditions, report: Progress) -> np.ndarray:
    import torch

    settings, pipe = inpainter.settings, inpainter.pipe
    height, width = view.hole.shape
    padding = ((0, -height % _CELL_PX), (0, -width % _CELL_PX))
    picture = np.pad(view.picture, (*padding, (0, 0)), mode="edge")
    hole, depth = np.pad(view.hole, padding, mode="edge"), np.pad(view.depth, padding, mode="edge")
    controls, scales = [], []
    if settings.depth_scale > 0.0:
        controls.append(_tensor(np.repeat(depth[..., None], 3, axis=2)))
        scales.append(settings.depth_scale)
    if settings.inpaint_scale > 0.0 or not controls:
        controls.append(_tensor(np.where(hole[..., None], _MASKED, picture)))
        scales.append(settings.inpaint_scale)
    step_count = max(1, int(settings.steps * settings.strength))

    def after_step(_pipe: Any, number: int, _time: Any, tensors: dict[str, Any]) -> dict[str, Any]:
        report((number + 1) / step_count)
        return tensors

    with torch.no_grad():
        result = pipe(
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
            # Noise from the CPU generator is the same on every device.
            generator=torch.Generator("cpu").manual_seed(view.seed),
            ip_adapter_image_embeds=inpainter.image_embeds,
            callback_on_step_end=after_step,
        ).images[0]
    if not np.isfinite(result).all():
        raise InputError("--dtype", "the model overflowed", cure="run again with --dtype bfloat16 or float32")
    return result[:height, :width].astype(np.float32)


def _tensor(picture: np.ndarray) -> Any:
    import torch

    return torch.from_numpy(np.ascontiguousarray(picture.transpose(2, 0, 1), np.float32))[None]


def whole_cells(hole: np.ndarray) -> np.ndarray:
    """Dilate a mask to whole latent cells of 8 × 8 pixels.

    The pipeline samples its mask at one pixel per cell and would otherwise miss holes of a few pixels.

    Parameters
    ----------
    hole
        ``(H, W)`` bool, with sides divisible by 8.

    Returns
    -------
    ndarray
        ``(H, W)`` bool.
    """
    rows, columns = hole.shape[0] // _CELL_PX, hole.shape[1] // _CELL_PX
    cells = hole.reshape(rows, _CELL_PX, columns, _CELL_PX).any(axis=(1, 3))
    return np.kron(cells, np.ones((_CELL_PX, _CELL_PX), bool))
