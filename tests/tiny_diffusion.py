"""Diffusion weights of a few hundred kilobytes, made on the spot in the real layout, for the real loading code.

They know nothing of pictures; they have every part that Stable Diffusion 1.5, two ControlNets and an IP-Adapter have, of
the right classes and names, and every part has something to say: zero-convolutions are not left at zero.
"""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path

BASE = "stable-diffusion-v1-5/stable-diffusion-v1-5"
DEPTH, INPAINT = "lllyasviel/control_v11f1p_sd15_depth", "lllyasviel/control_v11p_sd15_inpaint"
ADAPTER = "h94/IP-Adapter"
_TEXT, _IMAGE = 16, 12
_BLOCKS, _DOWN = (16, 32), ("CrossAttnDownBlock2D", "DownBlock2D")


def write_tokenizer(folder: Path) -> None:
    """Bytes and bytes that end a word, and the two marks: 514 symbols, no merges."""
    printable = [*range(33, 127), *range(161, 173), *range(174, 256)]
    letters = [chr(b) for b in printable] + [chr(256 + n) for n in range(256 - len(printable))]
    symbols = [*letters, *(letter + "</w>" for letter in letters), "<|startoftext|>", "<|endoftext|>"]
    folder.mkdir(parents=True)
    (folder / "vocab.json").write_text(json.dumps({symbol: n for n, symbol in enumerate(symbols)}))
    (folder / "merges.txt").write_text("#version: 0.2\n")
    config = {
        "tokenizer_class": "CLIPTokenizer",
        "model_max_length": 77,
        "bos_token": "<|startoftext|>",
        "eos_token": "<|endoftext|>",
        "unk_token": "<|endoftext|>",
        "pad_token": "<|endoftext|>",
    }
    (folder / "tokenizer_config.json").write_text(json.dumps(config))


def awaken(model, seed: int, scale: float = 0.3):
    """Give every parameter that training starts at zero a value, as training would have."""
    import torch

    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in model.parameters():
            if not parameter.any():
                parameter.copy_(scale * torch.randn(parameter.shape, generator=generator) / parameter[0].numel() ** 0.5)
        # Untrained convolutions have damped the picture a thousandfold by here.
        model.controlnet_cond_embedding.conv_out.weight.mul_(3000.0)
    return model


def adapter_state(unet, seed: int) -> dict:
    """An IP-Adapter's tensors for a UNet: the image's projection to four tokens, and keys and values of each layer."""
    import torch

    generator = torch.Generator().manual_seed(seed)

    def random(*shape: int):
        return torch.randn(shape, generator=generator) / shape[-1] ** 0.5

    state = {
        "image_proj.proj.weight": random(4 * _TEXT, _IMAGE),
        "image_proj.proj.bias": random(4 * _TEXT),
        "image_proj.norm.weight": torch.ones(_TEXT),
        "image_proj.norm.bias": torch.zeros(_TEXT),
    }
    for number, name in enumerate(unet.attn_processors):
        if name.endswith("attn2.processor"):
            layer = unet.get_submodule(name.removesuffix(".processor"))
            for part in ("to_k_ip", "to_v_ip"):
                state[f"ip_adapter.{number}.{part}.weight"] = 2.0 * random(layer.to_q.out_features, _TEXT)
    return state


def as_published(base: Path) -> None:
    """Name tensors as the published files of 2022 do: today's libraries must find them under their newer names."""
    import torch
    from safetensors.torch import load_file, save_file

    text = base / "text_encoder/model.safetensors"
    state = {f"text_model.{name.removeprefix('text_model.')}": tensor for name, tensor in load_file(text).items()}
    save_file(state | {"text_model.embeddings.position_ids": torch.arange(77)[None]}, text, metadata={"format": "pt"})
    vae = base / "vae/diffusion_pytorch_model.safetensors"
    old = {".to_q.": ".query.", ".to_k.": ".key.", ".to_v.": ".value.", ".to_out.0.": ".proj_attn."}
    state = {}
    for name, tensor in load_file(vae).items():
        for new, before in old.items():
            name = name.replace(new, before) if ".attentions." in name else name
        state[name] = tensor
    save_file(state, vae, metadata={"format": "pt"})


def write_tiny_weights(folder: Path) -> Path:
    """All weights of the default names under a folder, as ``<owner>/<name>``; returns the folder."""
    import torch
    from diffusers import AutoencoderKL, ControlNetModel, EulerAncestralDiscreteScheduler, UNet2DConditionModel
    from safetensors.torch import save_file
    from transformers import CLIPTextConfig, CLIPTextModel, CLIPVisionConfig, CLIPVisionModelWithProjection

    torch.manual_seed(0)
    unet = UNet2DConditionModel(
        sample_size=8,
        in_channels=4,
        out_channels=4,
        block_out_channels=_BLOCKS,
        layers_per_block=1,
        norm_num_groups=4,
        down_block_types=_DOWN,
        up_block_types=("UpBlock2D", "CrossAttnUpBlock2D"),
        cross_attention_dim=_TEXT,
        attention_head_dim=4,
    )
    vae = AutoencoderKL(
        block_out_channels=(4, 4, 8, 8),
        norm_num_groups=2,
        latent_channels=4,
        sample_size=64,
        down_block_types=("DownEncoderBlock2D",) * 4,
        up_block_types=("UpDecoderBlock2D",) * 4,
    )
    text = CLIPTextModel(
        CLIPTextConfig(
            vocab_size=514,
            hidden_size=_TEXT,
            intermediate_size=32,
            num_hidden_layers=2,
            num_attention_heads=2,
            projection_dim=_TEXT,
            bos_token_id=512,
            eos_token_id=513,
            pad_token_id=513,
        )
    )
    vision = CLIPVisionModelWithProjection(
        CLIPVisionConfig(
            hidden_size=16,
            intermediate_size=32,
            num_hidden_layers=2,
            num_attention_heads=2,
            image_size=32,
            patch_size=8,
            projection_dim=_IMAGE,
        )
    )
    scheduler = EulerAncestralDiscreteScheduler(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear")
    base = folder / BASE
    for name, part in (("unet", unet), ("vae", vae), ("text_encoder", text), ("scheduler", scheduler)):
        part.save_pretrained(base / name)
    as_published(base)
    write_tokenizer(base / "tokenizer")
    index = {
        "_class_name": "StableDiffusionPipeline",
        "_diffusers_version": "0.42.0",
        "safety_checker": [None, None],
        "feature_extractor": [None, None],
        "unet": ["diffusers", "UNet2DConditionModel"],
        "vae": ["diffusers", "AutoencoderKL"],
        "scheduler": ["diffusers", "EulerAncestralDiscreteScheduler"],
        "text_encoder": ["transformers", "CLIPTextModel"],
        "tokenizer": ["transformers", "CLIPTokenizer"],
    }
    (base / "model_index.json").write_text(json.dumps(index))
    for seed, name in ((1, DEPTH), (2, INPAINT)):
        torch.manual_seed(seed)
        net = ControlNetModel(
            block_out_channels=_BLOCKS,
            layers_per_block=1,
            norm_num_groups=4,
            down_block_types=_DOWN,
            cross_attention_dim=_TEXT,
            attention_head_dim=4,
            conditioning_embedding_out_channels=(4, 8, 8, 16),
        )
        awaken(net, seed).save_pretrained(folder / name)
    models = folder / ADAPTER / "models"
    vision.save_pretrained(models / "image_encoder")
    save_file(adapter_state(unet, 3), models / "ip-adapter_sd15.safetensors")
    return folder


def random_lpips(seed: int = 7) -> tuple[dict, dict]:
    """Tensors in the names and shapes of the two published files of LPIPS: AlexNet's convolutions, the linear layers."""
    import torch

    generator = torch.Generator().manual_seed(seed)
    shapes = {0: (64, 3, 11, 11), 3: (192, 64, 5, 5), 6: (384, 192, 3, 3), 8: (256, 384, 3, 3), 10: (256, 256, 3, 3)}
    network = {}
    for n, shape in shapes.items():
        spread = (2.0 / math.prod(shape[1:])) ** 0.5
        network[f"features.{n}.weight"] = torch.randn(shape, generator=generator) * spread
        network[f"features.{n}.bias"] = 0.1 * torch.randn(shape[0], generator=generator)
    linear = {
        f"lin{i}.model.1.weight": torch.rand((1, shape[0], 1, 1), generator=generator)
        for i, shape in enumerate(shapes.values())
    }
    return network, linear


def write_lpips_parts(folder: Path, network: dict, linear: dict) -> tuple[Path, Path, bytes]:
    """The two files as they are published, a state dict of the whole network and a wheel; and what the wheel holds."""
    import torch

    alexnet, wheel = folder / "alexnet-owt-7be5be79.pth", folder / "lpips-0.1.4-py3-none-any.whl"
    # The published network holds more.
    torch.save(network | {"classifier.1.weight": torch.zeros(4, 4)}, alexnet)
    content = io.BytesIO()
    torch.save(linear, content, _use_new_zipfile_serialization=False)
    with zipfile.ZipFile(wheel, "w") as archive:
        archive.writestr("lpips/weights/v0.1/alex.pth", content.getvalue())
        archive.writestr("lpips/weights/v0.0/alex.pth", b"of an older version")
    return alexnet, wheel, content.getvalue()


def write_tiny_lpips(folder: Path) -> Path:
    """Random weights of LPIPS as `seasonscapes lpips` joins them; returns the file."""
    from seasonscapes.evaluation.lpips import join_lpips

    alexnet, wheel, _ = write_lpips_parts(folder, *random_lpips())
    join_lpips(alexnet, wheel, folder / "lpips.safetensors")
    return folder / "lpips.safetensors"
