"""``seasonscapes info``: what a file is, and what it was made from."""

from __future__ import annotations

import json as json_module
import subprocess
from pathlib import Path
from typing import Any

from seasonscapes.commands.talk import finish
from seasonscapes.errors import InputError


def info(artefact: Path, *, json: bool = False) -> None:
    """Print the provenance of a picture, texture, map, model, film or built artefact.

    Parameters
    ----------
    artefact
        A file that a verb wrote, or one of the workspace, or a folder of daylight coefficients.
    json
        Print one machine-readable record.
    """
    if not artefact.exists():
        raise InputError("info", "no such file", got=str(artefact))
    kind = "folder" if artefact.is_dir() else artefact.suffix.lower()
    if kind not in READERS:
        raise InputError(
            "info", "this kind of file carries no provenance", got=artefact.name, expected=", ".join(sorted(READERS))
        )
    try:
        record = {"file": str(artefact), **READERS[kind](artefact)}
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise InputError(artefact, f"cannot be read as {kind}: {error}") from None
    finish(record, list(_lines(record)), as_json=json)


def _lines(record: dict, indent: str = ""):
    for key, value in record.items():
        if isinstance(value, dict):
            yield f"{indent}{key}"
            yield from _lines(value, indent + "  ")
        else:
            yield f"{indent}{key:<24} {value}"


def _loaded(text: Any) -> Any:
    """JSON where it is some, else the text itself."""
    try:
        return json_module.loads(text)
    except (TypeError, ValueError):
        return text if isinstance(text, (str, int, float)) else str(text)


def _exr(path: Path) -> dict:
    import OpenEXR

    with OpenEXR.File(str(path), header_only=True) as file:
        header, channels = dict(file.header()), sorted(channel.name for channel in file.header()["channels"])
    own = {
        key.removeprefix("seasonscapes:"): _loaded(value)
        for key, value in header.items()
        if key.startswith("seasonscapes:")
    }
    low, high = header["dataWindow"]
    return {"channels": ", ".join(channels), "size_px": [int(v) + 1 for v in high - low], **own}


def _png(path: Path) -> dict:
    from PIL import Image

    with Image.open(path) as image:
        text = {key: _loaded(value) for key, value in getattr(image, "text", {}).items()}
        return {"size_px": list(image.size), **text}


def _tif(path: Path) -> dict:
    import rasterio

    with rasterio.open(path) as file:
        return {
            "size_px": [file.width, file.height],
            "crs": str(file.crs),
            "bands": ", ".join(d or "?" for d in file.descriptions),
            "seasonscapes": _loaded(file.tags().get("seasonscapes", "none")),
        }


def _npz(path: Path) -> dict:
    import numpy as np

    with np.load(path, allow_pickle=False) as file:
        arrays = {name: f"{file[name].dtype} {file[name].shape}" for name in file.files}
    return {"arrays": arrays, **_manifest(path)}


def _manifest(path: Path) -> dict:
    """What the workspace wrote beside an artefact."""
    beside = path.with_name(path.name + ".json")
    return {"manifest": json_module.loads(beside.read_text())} if beside.is_file() else {"manifest": "none beside it"}


def _glb(path: Path) -> dict:
    import pygltflib

    document = pygltflib.GLTF2.load(str(path))
    faces = sum(
        document.accessors[p.indices].count // 3
        for mesh in document.meshes
        for p in mesh.primitives
        if p.indices is not None
    )
    return {
        "faces": faces,
        "extensions": ", ".join(document.extensionsUsed or []) or "none",
        "extras": document.asset.extras,
    }


def _mp4(path: Path) -> dict:
    import imageio_ffmpeg

    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-v", "error", "-i", str(path), "-f", "ffmetadata", "-"]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        raise ValueError(done.stderr.strip().splitlines()[-1])
    comment = next((line[8:] for line in done.stdout.splitlines() if line.startswith("comment=")), "none")
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(path))
    # ffmetadata escapes these with a backslash.
    for mark in "=;#\\":
        comment = comment.replace("\\" + mark, mark)
    return {"frames": frames, "seconds": seconds, "seasonscapes": _loaded(comment)}


def _safetensors(path: Path) -> dict:
    with open(path, "rb") as file:
        size = int.from_bytes(file.read(8), "little")
        if size > 100_000_000:
            raise ValueError("not a safetensors header")
        header = json_module.loads(file.read(size))
    about = {key: _loaded(value) for key, value in header.pop("__metadata__", {}).items()}
    return {"tensors": {name: f"{entry['dtype']} {tuple(entry['shape'])}" for name, entry in header.items()}, **about}


def _json(path: Path) -> dict:
    return {"content": json_module.loads(path.read_text())}


def _folder(path: Path) -> dict:
    for name in ("coefficients.json", "run.json"):
        if (path / name).is_file():
            return {"record": json_module.loads((path / name).read_text())}
    raise ValueError("neither daylight coefficients nor a run")


READERS = {
    ".exr": _exr,
    ".png": _png,
    ".tif": _tif,
    ".tiff": _tif,
    ".npz": _npz,
    ".glb": _glb,
    ".mp4": _mp4,
    ".safetensors": _safetensors,
    ".json": _json,
    "folder": _folder,
}
