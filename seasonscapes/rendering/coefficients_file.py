"""Storage of daylight coefficients: a folder of memory-mapped numpy arrays and one JSON file."""

from __future__ import annotations

import hashlib
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
from seasonscapes.errors import DamagedFile
from seasonscapes.frames import LocalFrame
from seasonscapes.rendering.coefficients import MirrorCoefficients, PointCoefficients, SamplingOptions, ViewCoefficients
from seasonscapes.rendering.hemisphere_rays import SurfacePoints
from seasonscapes.rendering.light_clusters import LightClusters, ReceiverCoefficients

# Format of the files: increment whenever a stored field is added, removed or renamed.
REVISION = 5
_TYPES: dict[str, type] = {
    stored.__name__: stored
    for stored in (
        Camera,
        LocalFrame,
        Panorama,
        SurfacePoints,
        ReceiverCoefficients,
        LightClusters,
        SamplingOptions,
        MirrorCoefficients,
        PointCoefficients,
        ViewCoefficients,
    )
}
Coefficients = ViewCoefficients | PointCoefficients


@contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Context manager: a temporary folder that replaces ``path`` when the block ends without an exception.

    Parameters
    ----------
    path
        The folder to create or replace; missing parents are created.

    Yields
    ------
    pathlib.Path
        The temporary folder, in the same parent.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}-", suffix=".part", dir=path.parent))
    try:
        yield temporary
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o777 & ~umask)
        if path.exists():
            # Two folders cannot be exchanged atomically: the old one is renamed first, so that it is never incomplete.
            old = Path(tempfile.mkdtemp(prefix=f".{path.name}-", suffix=".old", dir=path.parent))
            os.replace(path, old)
            os.replace(temporary, path)
            shutil.rmtree(old)
        else:
            os.replace(temporary, path)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def save_coefficients(path: str | os.PathLike[str], coefficients: Coefficients, *, key: str = "") -> None:
    """Write coefficients to a folder, atomically.

    Parameters
    ----------
    path
        The folder; replaced if it exists.
    coefficients
        Of a view or of points.
    key
        Identifier of all inputs that the coefficients depend on, stored for `load_coefficients` to compare.
    """
    with atomic_folder(path) as folder:
        record = _write(folder, "", coefficients)
        files = {path.name: _digest(path) for path in sorted(folder.iterdir())}
        text = json.dumps({"revision": REVISION, "key": key, "files": files, "coefficients": record}, indent=1)
        (folder / "coefficients.json").write_text(text)


def load_coefficients(path: str | os.PathLike[str], *, key: str | None = None) -> Coefficients:
    """Read coefficients from a folder of `save_coefficients`.

    Parameters
    ----------
    path
        The folder.
    key
        Expected identifier of the inputs; ``None`` skips the comparison.

    Returns
    -------
    ViewCoefficients or PointCoefficients
        With memory-mapped arrays.

    Raises
    ------
    FileNotFoundError
        If the folder holds no coefficients.
    DamagedFile
        If the folder has another revision, its key differs from ``key``, or a file is not what was written.
    """
    folder = Path(path)
    try:
        record = json.loads((folder / "coefficients.json").read_text(encoding="utf-8"))
        revision, own_key, files = record["revision"], record["key"], dict(record["files"])
    except (ValueError, KeyError, TypeError, RecursionError):
        raise DamagedFile(f"{folder}: its record is damaged, or of an older version") from None
    if revision != REVISION:
        raise DamagedFile(f"{folder}: coefficients of revision {revision}, expected {REVISION}")
    if key is not None and own_key != key:
        raise DamagedFile(f"{folder}: coefficients of {own_key or 'unknown inputs'}, expected {key}")
    for name, digest in files.items():
        if not (folder / name).is_file() or _digest(folder / name) != digest:
            raise DamagedFile(f"{folder}: {name} is not what was written")
    return _read(folder, "", record["coefficients"])


def _digest(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _write(folder: Path, prefix: str, value: Any) -> Any:
    if is_dataclass(value):
        members = {
            field.name: _write(folder, f"{prefix}{field.name}.", getattr(value, field.name)) for field in fields(value)
        }
        return {"type": type(value).__name__, **members}
    if isinstance(value, np.ndarray):
        np.save(folder / f"{prefix}npy", value)
        return "array"
    return value


def _read(folder: Path, prefix: str, record: Any) -> Any:
    if record == "array":
        return np.load(folder / f"{prefix}npy", mmap_mode="r")
    if isinstance(record, dict):
        members = {name: _read(folder, f"{prefix}{name}.", item) for name, item in record.items() if name != "type"}
        return _TYPES[record["type"]](**members)
    return record
