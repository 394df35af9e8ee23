"""The command line. Verbs live in `seasonscapes.commands` and are imported only when called."""

from __future__ import annotations

import json
import os
import sys

from cyclopts import App, Parameter

from seasonscapes import __version__
from seasonscapes.errors import InputError

app = App(
    name="seasonscapes",
    help="Light a real mountain landscape for any date and hour.",
    version=__version__,
    help_flags=["--help", "-h"],
    help_format="plaintext",
    # Nobody asks for an empty list of albedos.
    default_parameter=Parameter(negative_iterable=()),
)
app.command("seasonscapes.commands.render:render", help="Render a view of a place at a date and hour.")
app.command("seasonscapes.commands.paint:paint", help="Paint calibrated pictures of one time into the place's texture.")
app.command("seasonscapes.commands.inpaint:inpaint", help="Complete a painted texture where no camera saw.")
app.command(
    "seasonscapes.commands.path:path", help="Lay a path of views over a place, clear of the ground, with a map."
)
app.command("seasonscapes.commands.evaluate:evaluate", help="Score pictures against the truth, masked honestly.")
app.command("seasonscapes.commands.albedo:albedo", help="Take the light out of a place's photographs.")
app.command("seasonscapes.commands.run:run", help="From photographs to pictures of any hour, all stages, resumable.")
app.command("seasonscapes.commands.distill:distill", help="Teach Gaussians the light of a place.")
app.command(
    "seasonscapes.commands.splat:splat", help="Render distilled Gaussians at any hour, or bake them for others."
)
app.command("seasonscapes.commands.timelapse:timelapse", help="Film a view through hours or seasons.")
app.command(
    "seasonscapes.commands.lit:lit_texture", name="lit-texture", help="Export a place's texture as lit at an hour."
)
app.command(
    "seasonscapes.commands.lit:irradiance",
    help="Map what the sun and sky give the ground, at an hour or over a period.",
)
app.command("seasonscapes.commands.sky:sky", help="Tell the light of a place at an instant, and picture the dome.")
app.command("seasonscapes.commands.terrain:terrain", help="Build a place's terrain and report how good it is.")
app.command("seasonscapes.commands.webcams:webcams", help="List, check and map a scene's webcams and their pictures.")
app.command("seasonscapes.commands.calibrate:calibrate", help="Calibrate a webcam from matched points or the skyline.")
app.command(
    "seasonscapes.commands.calibrate:annotate", help="Match points of a photograph and the terrain on a local page."
)
app.command("seasonscapes.commands.info:info", help="Print what a file is, and what it was made from.")
app.command("seasonscapes.commands.demo:demo", help="Picture the embedded scene through a day, a night and a year.")
app.command("seasonscapes.commands.doctor:doctor", help="Say what this machine can do, and what is missing.")


def main(arguments: list[str] | None = None) -> int:
    """Run one verb. Exit codes: 0 well, 2 the user's input, 130 interrupted; a bug shows its traceback (1)."""
    tokens = sys.argv[1:] if arguments is None else arguments
    from seasonscapes.commands.talk import interruptible

    try:
        with interruptible():
            app(tokens, exit_on_error=True, print_error=True, result_action="return_value")
    except InputError as error:
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
