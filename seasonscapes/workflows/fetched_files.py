"""The files of a fetched place: scene file, rasters as cloud-optimised GeoTIFF, sources; all of them or none."""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.images import atomic_path, srgb_from_linear
from seasonscapes.open_data.imagery import Image
from seasonscapes.terrain.mosaic import MapGrid
from seasonscapes.terrain.viewpoints import View
from seasonscapes.workspace import file_hash

_FULL_SCALE = 10_000.0
_DEM_NODATA = -32768.0


def beside(output: Path, suffix: str) -> Path:
    """The file of a scene with another ending."""
    return output.with_name(output.stem + suffix)


def image_paths(output: Path, images: Sequence[Image]) -> list[Path]:
    """Names of the rasters of images; those of several hold their days."""
    if len(images) == 1:
        return [beside(output, ".ortho.tif")]
    return [beside(output, f".{image.day}.ortho.tif") for image in images]


def check_output(output: Path) -> None:
    """Refuse to replace a scene file that somebody has edited, or written otherwise."""
    if output.suffix != ".toml":
        raise InputError("--output", "not a scene file", got=str(output), expected="a name that ends in .toml")
    if not output.exists():
        return
    try:
        ours = json.loads(beside(output, ".sources.json").read_text())["files"][output.name]["sha256"]
    except (OSError, ValueError, KeyError, TypeError):
        ours = None
    if not output.is_file() or ours != file_hash(output):
        raise InputError(
            output, "exists, and is not as fetch wrote it", cure="choose another -o, or move the file away"
        )


def scene_text(output: Path, record: dict[str, Any], images: Sequence[Image], views: Sequence[View]) -> str:
    """The scene file of a place.

    Parameters
    ----------
    output
        Its name, after which the rasters are called.
    record
        Sources, as in ``.sources.json``.
    images
        The images, in the order of ``record["imagery"]``.
    views
        Its cameras.
    """
    kilometres = " × ".join(f"{side / 1000.0:g}" for side in (round(side, -1) for side in record["size_m"]))
    title = f"{record['latitude_deg']:.4f}, {record['longitude_deg']:.4f}: {kilometres} km"
    lines = [
        f"# Written by seasonscapes fetch; where it comes from: {beside(output, '.sources.json').name}",
        f"name = {_toml(_slug(output.stem))}",
        f"title = {_toml(title)}",
        f"attribution = {_toml('; '.join(attributions(record)))}",
        f"vertical_datum = {_toml(record['elevation']['vertical_datum'])}",
        "",
        "[elevation]",
        f"file = {_toml(beside(output, '.dem.tif').name)}",
    ]
    for image, path, part in zip(images, image_paths(output, images), record["imagery"], strict=True):
        lines += ["", "[imagery]" if len(images) == 1 else "[[imagery]]", f"file = {_toml(path.name)}"]
        if part["encoding"] == "linear":
            lines += ['encoding = "linear"', f"full_scale = {_FULL_SCALE}", "reflectance_scale = 1.0"]
        else:
            lines += ['encoding = "srgb"']
        if image.time is not None:
            lines += [f"time = {_toml(iso(image.time))}"]
        elif len(images) > 1:
            lines += [f"date = {_toml(str(image.day))}"]
    for view in views:
        lines += ["", "[[camera]]"] + [f"{key} = {_toml(value)}" for key, value in asdict(view).items()]
    return "\n".join(lines) + "\n"


def attributions(record: dict[str, Any]) -> list[str]:
    """The credits of a record's sources, each once."""
    parts = [record["elevation"], *record["imagery"]]
    return list(dict.fromkeys(each["attribution"] for part in parts for each in part["licences"]))


def iso(time: datetime) -> str:
    """UTC as text."""
    return time.astimezone(UTC).isoformat().replace("+00:00", "Z")


def _slug(stem: str) -> str:
    slug = re.sub(r"[^a-z0-9_-]+", "_", stem.lower()).strip("_-")
    return slug[:60] or "place"


def _toml(value: str | float) -> str:
    """A TOML basic string or a number."""
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "")


Writer = tuple[Path, Callable[[Path], None]]


def heights_writer(output: Path, values: np.ndarray, grid: MapGrid) -> Writer:
    """Path and writer of heights ``(H, W)`` [m]."""
    return beside(output, ".dem.tif"), lambda path: _write_heights(path, values, grid)


def image_writers(output: Path, images: Sequence[Image], grid: MapGrid, encoding: str) -> list[Writer]:
    """Paths and writers of images, as 16-bit reflectance (``linear``) or 8-bit colours (``srgb``)."""
    write = _write_reflectance if encoding == "linear" else _write_colours

    def writer(image: Image) -> Callable[[Path], None]:
        return lambda path: write(path, image.values, grid)

    return [(path, writer(image)) for path, image in zip(image_paths(output, images), images, strict=True)]


def write_place(output: Path, text: str, record: dict[str, Any], writers: Sequence[Writer]) -> None:
    """Write all files, and give them their names only when all are whole; the scene file last.

    Parameters
    ----------
    output, text
        Scene file.
    record
        Written as ``.sources.json``, with checksum and size of each file.
    writers
        The rasters.

    Raises
    ------
    InputError
        A file cannot be written; none is.
    """
    try:
        with ExitStack() as stack:
            scene_path = stack.enter_context(atomic_path(output))
            sources_path = stack.enter_context(atomic_path(beside(output, ".sources.json")))
            files = {}
            for path, write_file in writers:
                temporary = stack.enter_context(atomic_path(path))
                write_file(temporary)
                files[path.name] = {"sha256": file_hash(temporary), "bytes": temporary.stat().st_size}
            scene_path.write_text(text, encoding="utf-8")
            files[output.name] = {"sha256": hashlib.sha256(text.encode()).hexdigest(), "bytes": len(text.encode())}
            record["files"] = files
            sources_path.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(output, f"cannot be written: {error.strerror or error}", cure="choose another -o") from None


def _write_heights(path: Path, values: np.ndarray, grid: MapGrid) -> None:
    stored = np.where(np.isfinite(values), np.round(values, 2), _DEM_NODATA).astype(np.float32)
    _write_cog(path, stored[None], grid, nodata=_DEM_NODATA, predictor=3)


def _write_reflectance(path: Path, values: np.ndarray, grid: MapGrid) -> None:
    """Reflectance as 16-bit numbers of 1/10,000; 0 where nothing is known."""
    known = np.isfinite(values).all(axis=2, keepdims=True)
    stored = np.where(known, np.clip(np.nan_to_num(values) * _FULL_SCALE, 1.0, 65535.0), 0.0)
    _write_cog(path, np.rint(stored).astype(np.uint16).transpose(2, 0, 1), grid, nodata=0, predictor=2)


def _write_colours(path: Path, values: np.ndarray, grid: MapGrid) -> None:
    """8-bit sRGB with an alpha band that is 0 where nothing is known."""
    known = np.isfinite(values).all(axis=2)
    stored = np.rint(255.0 * srgb_from_linear(np.nan_to_num(values))).astype(np.uint8)
    bands = np.concatenate([stored.transpose(2, 0, 1), np.where(known, 255, 0).astype(np.uint8)[None]])
    _write_cog(path, bands, grid, nodata=None, predictor=2)


def _write_cog(path: Path, bands: np.ndarray, grid: MapGrid, *, nodata: float | None, predictor: int) -> None:
    import rasterio
    from rasterio.enums import ColorInterp
    from rasterio.errors import RasterioError

    profile = {
        "driver": "GTiff",
        "height": grid.height,
        "width": grid.width,
        "count": len(bands),
        "dtype": bands.dtype.name,
        "crs": grid.crs,
        "transform": grid.transform,
        "nodata": nodata,
    }
    try:
        with rasterio.MemoryFile() as memory:
            with memory.open(**profile) as file:
                file.write(bands)
                if len(bands) >= 3:
                    colour = (ColorInterp.red, ColorInterp.green, ColorInterp.blue, ColorInterp.alpha)
                    file.colorinterp = colour[: len(bands)]
            options = {"compress": "deflate", "predictor": predictor, "blocksize": 512}
            with memory.open() as file:
                from rasterio.shutil import copy

                copy(file, path, driver="COG", **options)
    except RasterioError as error:
        raise OSError(f"{error}") from None
