"""Location and integrity checks of the weight files of an image model, before gigabytes are read.

A part of the model has a hub name, ``owner/name``. It is searched as a folder of that path, then in the weights folder
as ``owner/name`` or ``name``, and without a weights folder in the hub's cache on this machine. Nothing is downloaded.
"""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from seasonscapes.errors import InputError

_ALTERNATIVE = "or use --method guided, which needs no weights"
# Bytes at both ends of a file that enter its fingerprint.
_FINGERPRINT_BYTES = 1 << 20
# Limit of the reference implementation of safetensors.
_MAX_HEADER_BYTES = 100_000_000
_MODEL, _TEXT = "diffusion_pytorch_model", "model"


@dataclass(frozen=True)
class WeightNames:
    """Hub names or folders of the parts of the image model. Parts that a run does not use need not exist.

    Parameters
    ----------
    base
        Stable Diffusion 1.5.
    depth, inpaint
        ControlNets.
    adapter
        IP-Adapter.
    """

    base: str = "stable-diffusion-v1-5/stable-diffusion-v1-5"
    depth: str = "lllyasviel/control_v11f1p_sd15_depth"
    inpaint: str = "lllyasviel/control_v11p_sd15_inpaint"
    adapter: str = "h94/IP-Adapter"


# Per part: subfolder, class name expected in its config.json, and stem of its weights file.
_MODEL_FILES = {
    "base": (
        ("unet", "UNet2DConditionModel", _MODEL),
        ("vae", "AutoencoderKL", _MODEL),
        ("text_encoder", "CLIPTextModel", _TEXT),
    ),
    "depth": ((".", "ControlNetModel", _MODEL),),
    "inpaint": ((".", "ControlNetModel", _MODEL),),
    "adapter": (("models/image_encoder", "CLIPVisionModelWithProjection", _TEXT),),
}
# Per part: other required files.
_OTHER_FILES = {
    "base": ("model_index.json", "scheduler/scheduler_config.json", "tokenizer/vocab.json", "tokenizer/merges.txt"),
    "depth": (),
    "inpaint": (),
    "adapter": ("models/ip-adapter_sd15.safetensors",),
}


def find_weights(folder: Path | None, part: str, name: str) -> Path:
    """Find the folder of one part of the model and check that its files are complete.

    Parameters
    ----------
    folder
        Weights folder, or ``None`` for the hub's cache.
    part
        ``base``, ``depth``, ``inpaint`` or ``adapter``.
    name
        Hub name or folder of the part.

    Returns
    -------
    Path
        Its folder.

    Raises
    ------
    InputError
        The part is missing, wrong or incomplete. The message states where it was expected and how to get it.
    """
    part_folder = _locate(folder, part, name)
    for file in _OTHER_FILES[part]:
        _check_file(part_folder / file, name)
    for inner, kind, stem in _MODEL_FILES[part]:
        _check_model(part_folder / inner, part, name, kind, stem)
    return part_folder


def _locate(folder: Path | None, part: str, name: str) -> Path:
    if folder is not None and not folder.is_dir():
        raise InputError("--weights", "no such folder", got=str(folder), cure=_instructions(folder, name))
    path = Path(name).expanduser()
    candidates = [path] if path.is_absolute() or name.startswith((".", "~")) else []
    if folder is not None:
        candidates += [folder / name, folder / path.name]
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    if folder is None and not candidates:
        cached = _find_in_cache(name)
        if cached is not None:
            return cached
    where = " or ".join(str(candidate) for candidate in candidates) or "the hub's cache on this machine"
    raise InputError(
        "--weights", f"the {part} weights '{name}' are missing", expected=where, cure=_instructions(folder, name)
    )


def _find_in_cache(name: str) -> Path | None:
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError, LocalEntryNotFoundError

    try:
        return Path(snapshot_download(name, local_files_only=True))
    except (LocalEntryNotFoundError, HFValidationError):
        return None


def _instructions(folder: Path | None, name: str) -> str:
    target = f"{folder or 'DIR'}/{name}"
    option = "" if folder else " and give --weights DIR"
    return f"get them with `hf download {name} --local-dir {target}`{option}, {_ALTERNATIVE}"


def _check_file(path: Path, name: str) -> None:
    if not path.is_file():
        raise InputError(
            "--weights",
            f"{path} is missing, so this is not a complete folder of '{name}'",
            cure=_instructions(None, name),
        )
    if path.suffix == ".safetensors":
        _check_complete(path, name)
    elif path.suffix == ".json":
        _read_json(path, name)


def _check_model(folder: Path, part: str, name: str, kind: str, stem: str) -> None:
    config = folder / "config.json"
    if not config.is_file():
        raise InputError(
            "--weights",
            f"{config} is missing, so this is not a complete folder of '{name}'",
            cure=_instructions(None, name),
        )
    content = _read_json(config, name)
    class_name = content.get("_class_name") or next(iter(content.get("architectures") or ["no class"]))
    if class_name != kind:
        raise InputError(
            "--weights", f"{folder} holds another kind of model, not the {part} part", got=class_name, expected=kind
        )
    for file in weight_shards(folder, stem, name):
        _check_complete(file, name)


def weights_fingerprint(folder: Path, part: str, name: str) -> str:
    """Return a fingerprint of a part's content, from the sizes and both ends of its files.

    Hashing the complete files would take minutes.

    Parameters
    ----------
    folder
        Folder of the part.
    part, name
        As in `find_weights`.

    Returns
    -------
    str
        16 hexadecimal digits.
    """
    files = [folder / file for file in _OTHER_FILES[part]]
    for inner, _, stem in _MODEL_FILES[part]:
        files += [folder / inner / "config.json", *weight_shards(folder / inner, stem, name)]
    digest = hashlib.sha256()
    for path in files:
        size = path.stat().st_size
        digest.update(f"{path.name}:{size};".encode())
        with open(path, "rb") as file:
            digest.update(file.read(_FINGERPRINT_BYTES))
            file.seek(max(size - _FINGERPRINT_BYTES, 0))
            digest.update(file.read(_FINGERPRINT_BYTES))
    return digest.hexdigest()[:16]


def variant_of(folder: Path, stem: str) -> str | None:
    """Return the variant of a model's weights to load.

    Parameters
    ----------
    folder
        Folder of the model.
    stem
        Stem of its weights file.

    Returns
    -------
    str or None
        ``"fp16"`` where the model is stored in half precision only.
    """
    full = (folder / f"{stem}.safetensors", folder / f"{stem}.safetensors.index.json")
    return None if any(path.is_file() for path in full) else "fp16"


def weight_shards(folder: Path, stem: str, name: str) -> list[Path]:
    """Return the weights files of one model: a single file, or those listed in an index.

    Parameters
    ----------
    folder
        Folder of the model.
    stem
        Stem of its weights file.
    name
        Hub name, for the message.

    Returns
    -------
    list of Path
        Files, which need not exist where an index lists them.

    Raises
    ------
    InputError
        There is neither an index nor a safetensors file.
    """
    for index in (folder / f"{stem}.safetensors.index.json", folder / f"{stem}.safetensors.index.fp16.json"):
        if index.is_file():
            shards = set(_read_json(index, name).get("weight_map", {}).values())
            return sorted(folder / shard for shard in shards)
    for file in (folder / f"{stem}.safetensors", folder / f"{stem}.fp16.safetensors"):
        if file.is_file():
            return [file]
    others = sorted(path.name for path in folder.glob("*.bin"))
    raise InputError(
        "--weights",
        f"{folder / stem}.safetensors is missing",
        got=", ".join(others) or None,
        cure=_instructions(None, name),
    )


def _read_json(path: Path, name: str) -> dict[str, Any]:
    try:
        content = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError):
        content = None
    if not isinstance(content, dict):
        raise InputError("--weights", f"{path} is cut off or not JSON", cure=_instructions(None, name))
    return content


def _check_complete(path: Path, name: str) -> None:
    """Compare a safetensors file's size with its header: 8 bytes of header length, a JSON header, then the tensors."""
    if not path.is_file():
        raise InputError("--weights", f"{path} is missing", cure=_instructions(None, name))
    size, expected_size = path.stat().st_size, 9
    try:
        with open(path, "rb") as file:
            (length,) = struct.unpack("<Q", file.read(8))
            if length > _MAX_HEADER_BYTES:
                raise ValueError(length)
            header = json.loads(file.read(length)) if length < size else {}
            ends = [tensor["data_offsets"][1] for key, tensor in header.items() if key != "__metadata__"]
            expected_size = 8 + length + max(ends, default=0)
    except (struct.error, ValueError, TypeError, KeyError):
        # Such as a pointer file of Git LFS, or a downloaded error page.
        raise InputError(
            "--weights", f"{path} is not a weights file", got=f"{size:,} bytes", cure=_instructions(None, name)
        ) from None
    if size != expected_size:
        raise InputError(
            "--weights",
            f"{path} is half-downloaded",
            got=f"{size:,} bytes",
            expected=f"{expected_size:,}",
            cure=_instructions(None, name),
        )
