"""The workspace: a folder of built artefacts, each named by the hash of everything it was made from.

An artefact is one file and a manifest beside it (``NAME.json``) that is written last. What has no manifest does not
exist; what has one is whole and fresh by construction, since another input has another name.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from seasonscapes import __version__
from seasonscapes.images import atomic_path

Value = TypeVar("Value")


@dataclass(frozen=True)
class Workspace:
    """A folder for built artefacts; `default_workspace` says where when the user does not."""

    folder: Path


def default_workspace() -> Workspace:
    """``SEASONSCAPES_WORKSPACE``, else the user's cache folder of this platform."""
    given = os.environ.get("SEASONSCAPES_WORKSPACE")
    if given:
        return Workspace(Path(given))
    if sys.platform == "darwin":
        return Workspace(Path.home() / "Library" / "Caches" / "seasonscapes")
    base = os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or Path.home() / ".cache"
    return Workspace(Path(base) / "seasonscapes")


def file_hash(path: str | os.PathLike) -> str:
    """SHA-256 of a file's content; of the name alone for GDAL's virtual files."""
    if os.fspath(path).startswith("/vsi"):
        return hashlib.sha256(os.fspath(path).encode()).hexdigest()
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def content_key(inputs: dict) -> str:
    """A short name for plain values (as JSON): equal inputs, equal names, on every machine."""
    text = json.dumps(inputs, sort_keys=True, default=_plain)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def _plain(value: Any) -> Any:
    if hasattr(value, "model_dump"):
        return value.model_dump(mode="json")
    if hasattr(value, "__dataclass_fields__"):
        return {name: getattr(value, name) for name in value.__dataclass_fields__}
    raise TypeError(f"content_key: cannot name a {type(value).__name__}")


def build_once(
    workspace: Workspace,
    name: str,
    inputs: dict,
    *,
    suffix: str,
    build: Callable[[], Value],
    save: Callable[[Value, Path], None],
    load: Callable[[Path], Value],
) -> Value:
    """Load the artefact of these inputs, or build it, save it atomically and write its manifest.

    Parameters
    ----------
    name
        Stage and place, as in ``alpine/terrain``.
    inputs
        Plain values that decide the result, hashes of files among them.
    suffix
        Of the artefact's file.

    Notes
    -----
    Two processes that build the same artefact at once both succeed: each renames a whole file onto the same name.
    """
    path = workspace.folder / f"{name}-{content_key(inputs)}{suffix}"
    manifest = path.with_name(path.name + ".json")
    if manifest.is_file() and path.is_file():
        return load(path)
    start = time.perf_counter()
    value = build()
    with atomic_path(path) as temporary:
        save(value, temporary)
    record = {"inputs": inputs, "version": __version__, "seconds": round(time.perf_counter() - start, 3)}
    with atomic_path(manifest) as temporary:
        temporary.write_text(json.dumps(record, indent=1, sort_keys=True, default=_plain) + "\n")
    return value
