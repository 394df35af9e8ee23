"""Files that travel with the package: scenes and sky models, in a wheel and in a checkout alike."""

from __future__ import annotations

import difflib
from importlib.resources import files
from pathlib import Path
from typing import Literal

from seasonscapes.declaration import InputError

Kind = Literal["scenes", "sun_models"]


def bundled_folder(kind: Kind) -> Path:
    """The folder that holds them: ``seasonscapes/_data`` in a wheel, beside the package in a checkout.

    Raises
    ------
    FileNotFoundError
        Where the installation lacks it.
    """
    package = Path(str(files("seasonscapes")))
    for folder in (package / "_data" / kind, package.parent / kind):
        if folder.is_dir():
            return folder
    raise FileNotFoundError(f"the installation of seasonscapes lacks its folder {kind}/")


def bundled_names(kind: Kind) -> list[str]:
    """Names of the bundled declarations of a kind, sorted."""
    return sorted(path.stem for path in bundled_folder(kind).glob("*.toml"))


def bundled_path(kind: Kind, name: str) -> Path:
    """The file of a bundled declaration by its bare name, such as ``alpine`` or ``clear``.

    Raises
    ------
    InputError
        Where there is none of that name; it says which there are.
    """
    names = bundled_names(kind)
    if name not in names:
        what = {"scenes": "scene", "sun_models": "sky model"}[kind]
        close = difflib.get_close_matches(name, names, n=1)
        raise InputError(
            name,
            f"neither a file nor a bundled {what}",
            expected="one of " + ", ".join(names),
            cure=f"did you mean '{close[0]}'?" if close else None,
        )
    return bundled_folder(kind) / f"{name}.toml"
