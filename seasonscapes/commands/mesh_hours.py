"""The hour of a textured mesh, as flags name it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from seasonscapes.commands.arguments import parse_sun, parse_time
from seasonscapes.errors import InputError

if TYPE_CHECKING:
    from seasonscapes.terrain.textured_mesh import TexturedMesh
    from seasonscapes.workflows.meshes import Time

# The hour of textures whose sun is to be found.
UNKNOWN = "unknown"


def hour_on(
    mesh: TexturedMesh,
    time: str | None,
    sun: str | None,
    *,
    flags: tuple[str, str] = ("--time", "--sun"),
    may_be_unknown: bool = False,
) -> Time:
    """The hour that two flags name: an instant, whose reading is printed, the sun's angles, or "unknown"."""
    if (time is None) == (sun is None):
        got, expected = "neither" if time is None else "both", f"{flags[0]} T, or {flags[1]} AZIMUTH,ELEVATION"
        raise InputError(flags[0], "give an hour or the sun's angles", got=got, expected=expected)
    if sun is not None:
        return parse_sun(sun, flag=flags[1])
    assert time is not None  # one of them was given
    if may_be_unknown and time == UNKNOWN:
        return time
    return parse_time(time, mesh.frame.latitude_deg, mesh.frame.longitude_deg)
