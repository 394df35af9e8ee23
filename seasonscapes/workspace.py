"""The workspace: a folder of built artefacts, each named by the hash of its inputs and of the code that made it.

An artefact is one file with a manifest beside it (``NAME.json``), which is written last. An artefact without a manifest
is ignored. The name hashes the input values, the content of input files and the source of the modules that build the
artefact (`seasonscapes.source_hash`), so that other inputs or other code never reuse it. The manifest states the
artefact's own SHA-256, which is compared when it is loaded (about a second for each gigabyte): one that was cut short,
changed or exchanged since is built again, and told.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import date, datetime
from pathlib import Path
from typing import Any, TypeVar

from seasonscapes import __version__
from seasonscapes.errors import InputError
from seasonscapes.images import atomic_path
from seasonscapes.source_hash import source_hash
from seasonscapes.user_cache import user_cache_folder

Value = TypeVar("Value")
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Workspace:
    """A folder for built artefacts; see `default_workspace`.

    Parameters
    ----------
    folder
        Created when the first artefact is written.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import seasonscapes as ss
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     place = ss.load_place("alpine_small", ss.Workspace(Path(folder)))
    ...     sorted(path.name for path in Path(folder).iterdir())
    ['alpine_small']
    """

    folder: Path


def default_workspace() -> Workspace:
    """Return the workspace in ``SEASONSCAPES_WORKSPACE``, or else in the user's cache folder of this platform."""
    given = os.environ.get("SEASONSCAPES_WORKSPACE")
    return Workspace(Path(given) if given else user_cache_folder())


def file_hash(path: str | os.PathLike) -> str:
    """SHA-256 of a file's content; of rasters, which may consist of several files, `raster_files.raster_hash`."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def content_key(inputs: dict) -> str:
    """A short name for plain values: equal inputs give equal names on every machine.

    Parameters
    ----------
    inputs
        Values that JSON can hold, dates, paths, dataclasses and pydantic models.

    Returns
    -------
    str
        16 hexadecimal digits.

    Raises
    ------
    TypeError
        For values of other types.

    Examples
    --------
    >>> from seasonscapes.workspace import content_key
    >>> content_key({"size": 3, "kind": "grid"}) == content_key({"kind": "grid", "size": 3})
    True
    """
    text = json.dumps(inputs, sort_keys=True, default=plain_value)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def plain_value(value: Any) -> Any:
    """Convert what JSON cannot hold (models, dataclasses, dates, paths) to what it can; `TypeError` for other types."""
    if hasattr(value, "model_dump"):
        return value.model_dump(mode="json")
    if hasattr(value, "__dataclass_fields__"):
        return {name: getattr(value, name) for name in value.__dataclass_fields__}
    if isinstance(value, (date, datetime)):
        return value.isoformat()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"content_key: cannot name a {type(value).__name__}")


def artefact_key(inputs: dict, code: tuple[str, ...]) -> str:
    """The key of an artefact: `content_key` of its inputs and of the source of the modules ``code`` that build it."""
    return content_key({"inputs": inputs, "code": source_hash(*code)})


def build_once(
    workspace: Workspace,
    name: str,
    inputs: dict,
    *,
    code: tuple[str, ...],
    suffix: str,
    build: Callable[[], Value],
    save: Callable[[Value, Path], None],
    load: Callable[[Path], Value],
) -> Value:
    """Load the artefact of these inputs and this code, or build it, save it atomically and write its manifest.

    Parameters
    ----------
    workspace
        Where artefacts lie.
    name
        Stage and place, such as ``alpine/terrain``.
    inputs
        Plain values that determine the result, hashes of input files among them.
    code
        Modules below ``seasonscapes`` whose source (with everything that they import) determines the result.
    suffix
        Of the artefact's file.
    build, save, load
        Make the value; write it to a path; read it from a path.

    Raises
    ------
    InputError
        Where a folder stands in the artefact's place.

    Notes
    -----
    Two processes that build the same artefact at once both succeed: each renames a whole file onto the same name.
    """
    key = artefact_key(inputs, code)
    path, manifest = _files(workspace, name, key, suffix)
    for file in (path, manifest):
        if file.is_dir():
            cure = "remove it, or choose another --workspace"
            raise InputError(file, "a folder stands where a built file belongs", cure=cure)
    if manifest.is_file() and path.is_file():
        doubt = _doubt(path, manifest, key)
        if doubt is None:
            return load(path)
        log.info("%s: %s; it is built again", path, doubt)
    start = time.perf_counter()
    value = build()
    with atomic_path(path) as temporary:
        save(value, temporary)
        digest = file_hash(temporary)
    record = {
        "key": key,
        "sha256": digest,
        "inputs": inputs,
        "code": source_hash(*code),
        "modules": code,
        "version": __version__,
        "seconds": round(time.perf_counter() - start, 3),
    }
    with atomic_path(manifest) as temporary:
        temporary.write_text(json.dumps(record, indent=1, sort_keys=True, default=plain_value) + "\n")
    _compared[path] = _state(path, digest)
    return value


def is_built(workspace: Workspace, name: str, inputs: dict, *, code: tuple[str, ...], suffix: str) -> bool:
    """Whether the workspace has the artefact of `build_once`; not whether it is whole, which loading finds out."""
    return all(file.is_file() for file in _files(workspace, name, artefact_key(inputs, code), suffix))


def _files(workspace: Workspace, name: str, key: str, suffix: str) -> tuple[Path, Path]:
    """An artefact and its manifest."""
    path = workspace.folder / f"{name}-{key}{suffix}"
    return path, path.with_name(path.name + ".json")


# Artefacts whose content this process has written, or compared already: size, time of change [ns] and inode then.
_compared: dict[Path, tuple[str, int, int, int]] = {}


def _doubt(path: Path, manifest: Path, key: str) -> str | None:
    """Why an artefact cannot be what its manifest says, or ``None``."""
    try:
        record = json.loads(manifest.read_text(encoding="utf-8"))
        stated = record["key"], record["sha256"]
    except (ValueError, KeyError, TypeError, RecursionError):
        return "its manifest is damaged, or of an older version"
    if stated[0] != key:
        return "its manifest is another artefact's"
    state = _state(path, str(stated[1]))
    if _compared.get(path) == state:
        return None
    if file_hash(path) != stated[1]:
        return "its content is not what was written"
    _compared[path] = state
    return None


def _state(path: Path, digest: str) -> tuple[str, int, int, int]:
    about = path.stat()
    return digest, about.st_size, about.st_mtime_ns, about.st_ino
