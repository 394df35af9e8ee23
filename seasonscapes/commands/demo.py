"""``seasonscapes demo``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from seasonscapes.commands.arguments import parse_size
from seasonscapes.commands.console import message, print_result, progress_bars
from seasonscapes.commands.outputs import check_output_folder


def demo_command(
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/demo"),
    *,
    camera: str | None = None,
    size: str = "720x480",
    gallery: bool = False,
    device: str = "auto",
    workspace: Path | None = None,
    json: bool = False,
) -> None:
    """Picture the embedded massif above its lake: on a June evening, through a day, four seasons and four airs.

    Pictures that exist already, made with the same arguments, are kept: an interrupted demo continues.

    Parameters
    ----------
    output
        Folder for the pictures.
    camera
        A camera of the scene alpine_lake; the first one when left out.
    size
        Of the panels; those of the gallery's night are half as wide.
    gallery
        Also 24 hours under a full moon, as a contact sheet and a film.
    device
        auto, cuda or llvm.
    workspace
        Folder for built artefacts.
    json
        Print one machine-readable record.
    """
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.workflows.demo import SCENE, day_and_year, night_and_film
    from seasonscapes.workflows.place import load_place
    from seasonscapes.workspace import Workspace

    width, height = parse_size(size)
    check_output_folder(output)
    backend = use_backend(device)
    message(f"demo: rendering on {backend.variant} ({backend.reason})")
    message("demo: building the embedded scene")
    made: list[Path] = []
    with progress_bars() as progress:
        place = load_place(SCENE, None if workspace is None else Workspace(workspace), progress=progress)
        view = place.scene.camera(camera)
        made += day_and_year(place, view, output, size_px=(width, height), progress=progress)
        if gallery:
            half = (width // 4 * 2, height // 4 * 2)
            made += night_and_film(place, view, output, size_px=half, device=device, progress=progress)
    files = [str(path) for path in made]
    print_result({"files": files}, [*files, f"and the panels of the sheets in {output}"], as_json=json)
