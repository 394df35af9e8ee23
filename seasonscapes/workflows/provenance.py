"""Provenance of files: what a picture, texture, map, model, film or artefact is and was made from."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

from seasonscapes.array_files import read_arrays
from seasonscapes.errors import InputError
from seasonscapes.text_files import parse_json, read_json


def provenance(path: Path) -> dict:
    """Read what a file states about itself.

    Parameters
    ----------
    path
        A file that a command wrote, an artefact of the workspace, or a folder of daylight coefficients or of a run.

    Returns
    -------
    dict
        Plain values; ``file`` is the path.

    Raises
    ------
    InputError
        Where it is missing, of an unknown kind or damaged.
    """
    if not path.exists():
        raise InputError("info", "no such file", got=str(path))
    kind = "folder" if path.is_dir() else path.suffix.lower()
    if kind not in READERS:
        expected = ", ".join(sorted(READERS))
        raise InputError("info", "this kind of file carries no provenance", got=path.name, expected=expected)
    try:
        return {"file": str(path), **READERS[kind](path)}
    except (OSError, ValueError, KeyError, RuntimeError) as error:
        raise InputError(path, f"cannot be read as {kind}: {error}") from None


def _loaded(text: Any) -> Any:
    """The value of JSON text, or the text itself."""
    try:
        return json.loads(text)
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
    from seasonscapes.terrain.raster_files import open_raster

    with open_raster(path) as file:
        return {
            "size_px": [file.width, file.height],
            "crs": str(file.crs),
            "bands": ", ".join(d or "?" for d in file.descriptions),
            "seasonscapes": _loaded(file.tags().get("seasonscapes", "none")),
        }


def _npz(path: Path) -> dict:
    stored = read_arrays(path, what="an .npz file of this program")
    arrays = {name: f"{values.dtype} {values.shape}" for name, values in stored.items()}
    return {"arrays": arrays, **_manifest(path)}


def _manifest(path: Path) -> dict:
    """The manifest that the workspace wrote beside an artefact."""
    beside = path.with_name(path.name + ".json")
    return {"manifest": read_json(beside)} if beside.is_file() else {"manifest": "none beside it"}


def _gltf(path: Path) -> dict:
    from seasonscapes.export.gltf_file import read_gltf_table

    table = read_gltf_table(path)
    indexed = (
        table["accessors"][primitive["indices"]]["count"] // 3
        for mesh in table.get("meshes", [])
        for primitive in mesh["primitives"]
        if "indices" in primitive
    )
    return {
        "faces": sum(indexed),
        "extensions": ", ".join(table.get("extensionsUsed", [])) or "none",
        "extras": table["asset"].get("extras", {}),
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
        header = parse_json(file.read(size), where=path)
    about = {key: _loaded(value) for key, value in header.pop("__metadata__", {}).items()}
    return {"tensors": {name: f"{entry['dtype']} {tuple(entry['shape'])}" for name, entry in header.items()}, **about}


def _json(path: Path) -> dict:
    return {"content": read_json(path)}


def _folder(path: Path) -> dict:
    for name in ("coefficients.json", "run.json"):
        if (path / name).is_file():
            return {"record": read_json(path / name)}
    raise ValueError("neither daylight coefficients nor a run")


READERS = {
    ".exr": _exr,
    ".png": _png,
    ".tif": _tif,
    ".tiff": _tif,
    ".npz": _npz,
    ".glb": _gltf,
    ".gltf": _gltf,
    ".mp4": _mp4,
    ".safetensors": _safetensors,
    ".json": _json,
    "folder": _folder,
}
