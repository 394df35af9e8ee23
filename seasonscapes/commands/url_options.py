"""The flag --at-url: a view by the address of the page that shows it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from seasonscapes.commands.look_options import LookOptions
from seasonscapes.commands.view_options import ViewOptions
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.workflows.view_address import ViewAddress


def given_address(at_url: str | None, time: str | None, view: ViewOptions, look: LookOptions) -> ViewAddress | None:
    """The address asked for, or ``None``; `InputError` where other flags state the same, or nothing states the time."""
    if at_url is None:
        if time is None:
            raise InputError("--time", "missing", expected="ISO 8601, such as 2024-09-01T12:00, or --at-url")
        return None
    from seasonscapes.workflows.view_address import read_address

    stated = {"--time": time, "--camera": view.camera, "--at": view.at, "--heading": view.heading}
    stated["--exposure"] = None if look.exposure == "auto" else look.exposure
    for flag, value in stated.items():
        if value is not None:
            raise InputError(flag, "is stated by --at-url too", got=value, cure="drop one of them")
    return read_address(at_url)


def at_address(address: ViewAddress) -> dict[str, Any]:
    """The view of an address as fields of `ViewOptions`."""
    camera = address.camera
    return {
        "at": f"{camera.latitude_deg!r},{camera.longitude_deg!r},{camera.height_m!r}",
        "heading": camera.heading_deg,
        "pitch": camera.pitch_deg,
        "fov": camera.fov_deg,
    }
