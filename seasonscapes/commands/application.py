"""The application: all verbs, and how their arguments become values. A verb's module is imported when it is called."""

from __future__ import annotations

import math
import re
import stat
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

from cyclopts import App, Parameter, Token, convert
from cyclopts.exceptions import CycloptsError

from seasonscapes import __version__
from seasonscapes.commands.flag_conditions import check_flags
from seasonscapes.errors import InputError, SeasonscapesError

# A value that would be taken for a flag unless it were joined to its own: a place south of the equator, a negative number.
_SIGNED_VALUE = re.compile(r"-(\.?[0-9]|inf|nan)", re.IGNORECASE)
_WHOLE_NUMBER = re.compile(r"[+-]?[0-9]{1,18}")
# Flags for which "without limit", and for which "nothing" is an answer.
_MAY_BE_INFINITE = ("--far-m",)
_MAY_BE_EMPTY = ("--leave-out", "--prompt", "--without")
_MOST_CHARACTERS = 100_000


def _value(type_: Any, tokens: Sequence[Token]) -> Any:
    """Convert a flag's text to its type; whole numbers are written as such, numbers are finite, paths hold no NUL."""
    types = set(get_args(type_) or (type_,))
    for token in tokens:
        name, text = token.keyword or "argument", token.value
        if "\0" in text:
            raise InputError(name, "holds a NUL character", got=text)
        if len(text) > _MOST_CHARACTERS:
            raise InputError(name, "too long", got=f"{len(text)} characters", expected=f"at most {_MOST_CHARACTERS:,}")
        if int in types and not _WHOLE_NUMBER.fullmatch(text):
            raise InputError(name, "not a whole number", got=text, expected="digits, such as 12")
        if float in types and _not_finite(text) and name not in _MAY_BE_INFINITE:
            raise InputError(name, "not a finite number", got=text)
        if not text and name not in _MAY_BE_EMPTY:
            raise InputError(name, "nothing behind it", expected="a value")
        if Path in types:
            check_no_device(Path(text), name)
    return convert(type_, tokens)


def check_no_device(path: Path, flag: str) -> None:
    """`InputError` about a pipe or a device: one would be waited for, the other never ends."""
    try:
        mode = path.stat().st_mode
    except (OSError, ValueError):
        return  # whoever opens it tells what is wrong
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise InputError(flag, "this is a pipe or a device", got=str(path), expected="a file or folder")


def _not_finite(text: str) -> bool:
    try:
        return not math.isfinite(float(text))
    except ValueError:
        return False  # no number at all, which the conversion tells


app = App(
    name="seasonscapes",
    help="Physically-based relighting of mountain landscapes: any place, any date, any hour.",
    version=__version__,
    help_flags=["--help", "-h"],
    help_format="plaintext",
    # An empty list of albedos is never asked for.
    default_parameter=Parameter(negative_iterable=(), converter=_value),
    suppress_keyboard_interrupt=False,
)

# Name, module, and what the command does.
COMMANDS = (
    ("fetch", "fetch", "Make the scene of a place from open data, by its coordinates."),
    ("render", "render", "Render a view of a place at a date and hour."),
    ("view", "view", "Show a place in a browser: drag the date and the hour."),
    ("timelapse", "timelapse", "Film a view through hours or seasons."),
    ("lit-texture", "lit_texture", "Export a place's texture as lit at an hour."),
    ("export", "export", "Write a place for other programs: glTF, USD, 3D Tiles, Blender."),
    ("irradiance", "irradiance", "Map the irradiance of the ground at an hour or over a period."),
    ("sky", "sky", "Report the light of a place at an instant, and picture the sky dome."),
    ("terrain", "terrain", "Build a place's terrain and report its quality."),
    ("webcams", "webcams", "List, check and map a scene's webcams and their pictures."),
    ("calibrate", "calibrate", "Calibrate a webcam from matched points or the skyline."),
    ("annotate", "annotate", "Match points of a photograph and the terrain on a local page."),
    ("paint", "paint", "Paint calibrated pictures of one time into the place's texture."),
    ("inpaint", "inpaint", "Complete a painted texture where no camera saw the surface."),
    ("path", "path", "Make a camera path over a place, clear of the ground, with a map."),
    ("albedo", "albedo", "Recover the albedo of a place from its photographs."),
    ("hours", "hours", "Picture a fixed camera's view at hours that it never took."),
    ("delight", "delight", "Take the light of its hour out of an image or a textured mesh."),
    ("relight", "relight", "Light a textured mesh anew: pictures, lit textures or a film."),
    ("distill", "distill", "Distil a Gaussian model of a place."),
    ("splat", "splat", "Render distilled Gaussians at any hour, or bake them for other programs."),
    ("run", "run", "From photographs to pictures of any hour: all stages, resumable."),
    ("evaluate", "evaluate", "Score pictures against the truth."),
    ("lpips", "lpips", "Join the published weights of LPIPS to one file for evaluate."),
    ("info", "info", "Print the provenance of a file."),
    ("demo", "demo", "Picture the embedded scene through a day, a night and a year."),
    ("doctor", "doctor", "Report what this machine can do, and what is missing."),
)
for _name, _module, _help in COMMANDS:
    app.command(f"seasonscapes.commands.{_module}:{_module}_command", name=_name, help=_help)


class UsageError(SeasonscapesError):
    """The command line names no verb, an unknown flag, or a flag without its value."""


def run_verb(tokens: Sequence[str]) -> None:
    """Run the verb that the tokens name.

    Raises
    ------
    UsageError
        If the tokens do not fit a verb and its flags.
    """
    joined = join_signed_values(tokens)
    check_flags(joined)
    try:
        app(joined, exit_on_error=False, print_error=False, result_action="return_value")
    except CycloptsError as error:
        error.verbose = False
        verb = next((name for name, _, _ in COMMANDS if joined[:1] == [name]), "")
        raise UsageError(f"{error}; see: seasonscapes {verb} --help".replace("  ", " ")) from None


def join_signed_values(tokens: Sequence[str]) -> list[str]:
    """Join a long flag and a value that begins with a minus: ``--at -43.6,170`` is ``--at=-43.6,170``.

    Examples
    --------
    >>> from seasonscapes.commands.application import join_signed_values
    >>> join_signed_values(["sky", "--at", "-43.6,170.1", "--json"])
    ['sky', '--at=-43.6,170.1', '--json']
    """
    joined: list[str] = []
    for index, token in enumerate(tokens):
        if token == "--":
            return [*joined, *tokens[index:]]
        before = joined[-1] if joined else ""
        if _SIGNED_VALUE.match(token) and before.startswith("--") and "=" not in before:
            joined[-1] = f"{before}={token}"
        else:
            joined.append(token)
    return joined
