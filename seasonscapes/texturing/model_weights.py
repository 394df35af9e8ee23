"""Where the weights of an image model lie, and whether they are whole, found out before gigabytes are read.

A part has a hub name, ``owner/name``. It is looked for as a folder of that path, below the weights folder as
``owner/name`` or ``name``, and without a weights folder in the hub's own cache on this machine. Nothing is downloaded.
"""

from __future__ import annotations

import hashlib
import json
import struct
from dataclasses import dataclass
from pathlib import Path

from seasonscapes.errors import InputError

_ELSE = "or take --method guided, which needs no weights"
_ENDS = 1 << 20
# As the format's own readers have it.
_LONGEST_HEADER = 100_000_000
_MODEL, _TEXT = "diffusion_pytorch_model", "model"


@dataclass(frozen=True)
class WeightNames:
    """Which weights: hub names or folders. Those that a run switches off are not looked for."""

    base: str = "stable-diffusion-v1-5/stable-diffusion-v1-5"
    depth: str = "lllyasviel/control_v11f1p_sd15_depth"
    inpaint: str = "lllyasviel/control_v11p_sd15_inpaint"
    adapter: str = "h94/IP-Adapter"


# Folder in the part, class that its config.json must name, stem of its weights file.
_LAYOUT = {
    "base": (
        ("unet", "UNet2DConditionModel", _MODEL),
        ("vae", "AutoencoderKL", _MODEL),
        ("text_encoder", "CLIPTextModel", _TEXT),
    ),
    "depth": ((".", "ControlNetModel", _MODEL),),
    "inpaint": ((".", "ControlNetModel", _MODEL),),
    "adapter": (("models/image_encoder", "CLIPVisionModelWithProjection", _TEXT),),
}
_PLAIN = {
    "base": ("model_index.json", "scheduler/scheduler_config.json", "tokenizer/vocab.json", "tokenizer/merges.txt"),
    "depth": (),
    "inpaint": (),
    "adapter": ("models/ip-adapter_sd15.safetensors",),
}


def find_weights(folder: Path | None, part: str, name: str) -> Path:
    """The folder of one part (``base``, ``depth``, ``inpaint`` or ``adapter``), checked to be there and whole.

    Raises
    ------
    InputError
        One line: which part is missing, wrong or half-downloaded, where it was expected, how to get it, and that guided
        completion needs none.
    """
    place = _placed(folder, part, name)
    for file in _PLAIN[part]:
        _check_plain(place, part, name, file)
    for inner, kind, stem in _LAYOUT[part]:
        _check_model(place / inner, part, name, kind, stem)
    return place


def _placed(folder: Path | None, part: str, name: str) -> Path:
    if folder is not None and not folder.is_dir():
        raise InputError("--weights", "no such folder", got=str(folder), cure=_how(folder, name))
    own = Path(name).expanduser()
    places = [own] if own.is_absolute() or name.startswith((".", "~")) else []
    if folder is not None:
        places += [folder / name, folder / own.name]
    for place in places:
        if place.is_dir():
            return place
    if folder is None and not places:
        cached = _in_cache(name)
        if cached is not None:
            return cached
    where = " or ".join(str(place) for place in places) or "the hub's cache on this machine"
    raise InputError("--weights", f"the {part} weights '{name}' are missing", expected=where, cure=_how(folder, name))


def _in_cache(name: str) -> Path | None:
    from huggingface_hub import snapshot_download
    from huggingface_hub.errors import HFValidationError, LocalEntryNotFoundError

    try:
        return Path(snapshot_download(name, local_files_only=True))
    except (LocalEntryNotFoundError, HFValidationError):
        return None


def _how(folder: Path | None, name: str) -> str:
    target = f"{folder or 'DIR'}/{name}"
    also = "" if folder else " and give --weights DIR"
    return f"get them with `hf download {name} --local-dir {target}`{also}, {_ELSE}"


def _check_plain(place: Path, part: str, name: str, file: str) -> None:
    path = place / file
    if not path.is_file():
        raise InputError(
            "--weights", f"{path} is missing, so this is no folder of '{name}' or not all of it", cure=_how(None, name)
        )
    if path.suffix == ".safetensors":
        _check_whole(path, name)
    elif path.suffix == ".json":
        _read_json(path, name)


def _check_model(place: Path, part: str, name: str, kind: str, stem: str) -> None:
    config = place / "config.json"
    if not config.is_file():
        raise InputError(
            "--weights",
            f"{config} is missing, so this is no folder of '{name}' or not all of it",
            cure=_how(None, name),
        )
    found = _read_json(config, name)
    named = found.get("_class_name") or next(iter(found.get("architectures") or ["nothing"]))
    if named != kind:
        raise InputError(
            "--weights", f"{place} holds another kind of model, not the {part} part", got=named, expected=kind
        )
    for file in weight_shards(place, stem, name):
        _check_whole(file, name)


def weights_fingerprint(place: Path, part: str, name: str) -> str:
    """A short name of a part's content: sizes, and both ends of its files (all of gigabytes would take minutes)."""
    files = [place / file for file in _PLAIN[part]]
    for inner, _, stem in _LAYOUT[part]:
        files += [place / inner / "config.json", *weight_shards(place / inner, stem, name)]
    digest = hashlib.sha256()
    for path in files:
        size = path.stat().st_size
        digest.update(f"{path.name}:{size};".encode())
        with open(path, "rb") as file:
            digest.update(file.read(_ENDS))
            file.seek(max(size - _ENDS, 0))
            digest.update(file.read(_ENDS))
    return digest.hexdigest()[:16]


def variant_of(place: Path, stem: str) -> str | None:
    """``fp16`` where a model comes in half precision alone."""
    full = (place / f"{stem}.safetensors", place / f"{stem}.safetensors.index.json")
    return None if any(path.is_file() for path in full) else "fp16"


def weight_shards(place: Path, stem: str, name: str) -> list[Path]:
    """The files of one model's weights: one, or those that an index lists."""
    for index in (place / f"{stem}.safetensors.index.json", place / f"{stem}.safetensors.index.fp16.json"):
        if index.is_file():
            shards = set(_read_json(index, name).get("weight_map", {}).values())
            return sorted(place / shard for shard in shards)
    for file in (place / f"{stem}.safetensors", place / f"{stem}.fp16.safetensors"):
        if file.is_file():
            return [file]
    left = sorted(path.name for path in place.glob("*.bin"))
    raise InputError(
        "--weights", f"{place / stem}.safetensors is missing", got=", ".join(left) or None, cure=_how(None, name)
    )


def _read_json(path: Path, name: str) -> dict:
    try:
        found = json.loads(path.read_text())
    except (json.JSONDecodeError, UnicodeDecodeError):
        found = None
    if not isinstance(found, dict):
        raise InputError("--weights", f"{path} is cut off or no JSON", cure=_how(None, name))
    return found


def _check_whole(path: Path, name: str) -> None:
    """A safetensors file says in its head how long it is: 8 bytes, a JSON header of that length, the tensors."""
    if not path.is_file():
        raise InputError("--weights", f"{path} is missing", cure=_how(None, name))
    size, wanted = path.stat().st_size, 9
    try:
        with open(path, "rb") as file:
            (length,) = struct.unpack("<Q", file.read(8))
            if length > _LONGEST_HEADER:
                raise ValueError(length)
            header = json.loads(file.read(length)) if length < size else {}
            ends = [tensor["data_offsets"][1] for key, tensor in header.items() if key != "__metadata__"]
            wanted = 8 + length + max(ends, default=0)
    except (struct.error, ValueError, TypeError, KeyError):
        # A pointer of a version-control system that keeps large files elsewhere, or a page of an error.
        raise InputError(
            "--weights", f"{path} is no weights file", got=f"{size:,} bytes", cure=_how(None, name)
        ) from None
    if size != wanted:
        raise InputError(
            "--weights",
            f"{path} is half-downloaded",
            got=f"{size:,} bytes",
            expected=f"{wanted:,}",
            cure=_how(None, name),
        )
