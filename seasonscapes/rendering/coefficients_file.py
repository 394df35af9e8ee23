"""Daylight coefficients on disk: a folder of plain arrays that are mapped, not read, and one JSON file about them."""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.cameras.panorama import Panorama
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.frames import LocalFrame
from seasonscapes.rendering.hemisphere_rays import SurfacePoints
from seasonscapes.rendering.light_clusters import LightClusters, ReceiverCoefficients
from seasonscapes.rendering.transport import PointCoefficients, SamplingOptions, ViewCoefficients

# A new number wherever the same inputs give other coefficients, or the files other names.
REVISION = 2
_KINDS = {
    kind.__name__: kind
    for kind in (
        Camera,
        LocalFrame,
        Panorama,
        SurfacePoints,
        ReceiverCoefficients,
        LightClusters,
        SamplingOptions,
        PointCoefficients,
        ViewCoefficients,
    )
}
Coefficients = ViewCoefficients | PointCoefficients


@contextmanager
def atomic_folder(path: str | os.PathLike) -> Iterator[Path]:
    """A temporary folder beside ``path`` that takes its name only when the block ends well, replacing what was there."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}-", suffix=".part", dir=path.parent))
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o777 & ~umask)
        if path.exists():
            # Folders cannot be exchanged in one step: the old one steps aside first, and is never half there.
            aside = Path(tempfile.mkdtemp(prefix=f".{path.name}-", suffix=".old", dir=path.parent))
            os.replace(path, aside)
            os.replace(temporary, path)
            shutil.rmtree(aside)
        else:
            os.replace(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def save_coefficients(path: str | os.PathLike, coefficients: Coefficients, *, key: str = "") -> None:
    """Write to a folder, atomically; ``key``, a name of all that they depend on, is kept for `load_coefficients` to check."""
    with atomic_folder(path) as folder:
        record = _write(folder, "", coefficients)
        text = json.dumps({"revision": REVISION, "key": key, "coefficients": record}, indent=1)
        (folder / "coefficients.json").write_text(text)


def load_coefficients(path: str | os.PathLike, *, key: str | None = None) -> Coefficients:
    """Read a folder of `save_coefficients`. Arrays stay on disk until they are used.

    Raises
    ------
    FileNotFoundError
        Where there is none.
    ValueError
        Where it was written by another revision, or for other inputs than ``key`` says.
    """
    folder = Path(path)
    record = json.loads((folder / "coefficients.json").read_text())
    if record["revision"] != REVISION:
        raise ValueError(f"{folder}: coefficients of revision {record['revision']}, expected {REVISION}")
    if key is not None and record["key"] != key:
        raise ValueError(f"{folder}: coefficients of {record['key'] or 'unknown inputs'}, expected {key}")
    return _read(folder, "", record["coefficients"])


def _write(folder: Path, prefix: str, value: Any) -> Any:
    if is_dataclass(value):
        parts = {
            field.name: _write(folder, f"{prefix}{field.name}.", getattr(value, field.name)) for field in fields(value)
        }
        return {"type": type(value).__name__, **parts}
    if isinstance(value, np.ndarray):
        np.save(folder / f"{prefix}npy", value)
        return "array"
    return value


def _read(folder: Path, prefix: str, record: Any) -> Any:
    if record == "array":
        return np.load(folder / f"{prefix}npy", mmap_mode="r")
    if isinstance(record, dict):
        parts = {name: _read(folder, f"{prefix}{name}.", part) for name, part in record.items() if name != "type"}
        return _KINDS[record["type"]](**parts)
    return record
