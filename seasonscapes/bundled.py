"""Lookup of the scenes, sky models and data sources that are distributed with the package."""

from __future__ import annotations

import difflib
from importlib.resources import files
from pathlib import Path
from typing import Literal

from seasonscapes.declaration import InputError

Kind = Literal["scenes", "sun_models", "data_sources"]


def bundled_folder(kind: Kind) -> Path:
    """Locate the folder of bundled files: in ``seasonscapes/_data`` of a wheel, beside the package in a checkout.

    Parameters
    ----------
    kind
        ``scenes``, ``sun_models`` or ``data_sources``.

    Returns
    -------
    Path
        Existing folder.

    Raises
    ------
    FileNotFoundError
        If the installation has no such folder.
    """
    package = Path(str(files("seasonscapes")))
    for folder in (package / "_data" / kind, package.parent / kind):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"the installation of seasonscapes lacks its folder {kind}/")


def bundled_names(kind: Kind) -> list[str]:
    """List the bundled files of a kind.

    Parameters
    ----------
    kind
        ``scenes``, ``sun_models`` or ``data_sources``.

    Returns
    -------
    list of str
        File names without suffix, sorted.
    """
    return sorted(path.stem for path in bundled_folder(kind).glob("*.toml"))


def bundled_path(kind: Kind, name: str) -> Path:
    """Locate a bundled file by its name without suffix, such as ``alpine`` or ``clear``.

    Parameters
    ----------
    kind
        ``scenes``, ``sun_models`` or ``data_sources``.
    name
        File name without suffix.

    Returns
    -------
    Path
        TOML file.

    Raises
    ------
    InputError
        If there is no bundled file of that name; the message lists the names.
    """
    names = bundled_names(kind)
    if name not in names:
        noun = {"scenes": "scene", "sun_models": "sky model", "data_sources": "data source"}[kind]
        close = difflib.get_close_matches(name, names, n=1)
        raise InputError(
            name,
            f"neither a file nor a bundled {noun}",
            expected="one of " + ", ".join(names),
            cure=f"did you mean '{close[0]}'?" if close else None,
        )
    return bundled_folder(kind) / f"{name}.toml"


def is_bundled(kind: Kind, path: Path) -> bool:
    """Whether a path is that of a bundled file, which its name alone stands for."""
    return path.stem in bundled_names(kind) and bundled_path(kind, path.stem) == path
