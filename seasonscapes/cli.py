"""The command line. Commands live in `seasonscapes.commands` and are imported only when they are called."""

from __future__ import annotations

import json
import os
import sys

from cyclopts import App, Parameter

from seasonscapes import __version__
from seasonscapes.commands.console import show_messages
from seasonscapes.commands.interruption import interruptible
from seasonscapes.errors import SeasonscapesError

app = App(
    name="seasonscapes",
    help="Physically-based relighting of mountain landscapes: any place, any date, any hour.",
    version=__version__,
    help_flags=["--help", "-h"],
    help_format="plaintext",
    # An empty list of albedos is never asked for.
    default_parameter=Parameter(negative_iterable=()),
)

# Name, module, and what the command does.
COMMANDS = (
    ("fetch", "fetch", "Make the scene of a place from open data, by its coordinates."),
    ("render", "render", "Render a view of a place at a date and hour."),
    ("timelapse", "timelapse", "Film a view through hours or seasons."),
    ("lit-texture", "lit_texture", "Export a place's texture as lit at an hour."),
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
    ("distill", "distill", "Distil a Gaussian model of a place."),
    ("splat", "splat", "Render distilled Gaussians at any hour, or bake them for other programs."),
    ("run", "run", "From photographs to pictures of any hour: all stages, resumable."),
    ("evaluate", "evaluate", "Score pictures against the truth."),
    ("info", "info", "Print the provenance of a file."),
    ("demo", "demo", "Picture the embedded scene through a day, a night and a year."),
    ("doctor", "doctor", "Report what this machine can do, and what is missing."),
)
for _name, _module, _help in COMMANDS:
    app.command(f"seasonscapes.commands.{_module}:{_module}_command", name=_name, help=_help)


def main(arguments: list[str] | None = None) -> int:
    """Run one command.

    Returns
    -------
    int
        Exit code: 0 for success, 2 for a mistake in the user's input, 130 for an interruption. Any other exception
        is a bug and shows its traceback (exit code 1).
    """
    tokens = sys.argv[1:] if arguments is None else arguments
    show_messages()
    try:
        with interruptible():
            app(tokens, exit_on_error=True, print_error=True, result_action="return_value")
    except SeasonscapesError as error:
        if "--json" in tokens:
            print(json.dumps({"error": str(error)}))
        print(f"seasonscapes: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("seasonscapes: interrupted; finished files are whole, nothing half was left", file=sys.stderr)
        return 130
    except BrokenPipeError:
        # The reader of our output went away (`| head`); that is not an error.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return 0


if __name__ == "__main__":
    sys.exit(main())
