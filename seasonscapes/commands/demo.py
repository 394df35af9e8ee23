"""``seasonscapes demo``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_range, parse_size
from seasonscapes.commands.console import message, print_result, progress_bars
from seasonscapes.commands.outputs import check_output_folder


def demo_command(
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/demo"),
    *,
    camera: str | None = None,
    size: str = "720x480",
    spp: int = 32,
    device: str = "auto",
    workspace: Path | None = None,
    json: bool = False,
) -> None:
    """Render the embedded scene into contact sheets and a film: a day, four seasons, 24 hours under a full moon, four airs.

    Pictures that exist already, made with the same arguments, are kept: an interrupted demo continues.

    Parameters
    ----------
    output
        Folder for the pictures.
    camera
        A camera of the scene alpine; the first one when left out.
    size
        Of the large panels; the hourly ones are half as wide.
    spp
        Samples per pixel of the large panels.
    device
        auto, cuda or llvm.
    workspace
        Folder for built artefacts.
    json
        Print one machine-readable record.
    """
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.workflows.demo import contact_sheets, day_film
    from seasonscapes.workflows.place import load_place
    from seasonscapes.workspace import Workspace

    width, height = parse_size(size)
    check_range("--spp", spp, 1, 1 << 20)
    check_output_folder(output)
    backend = use_backend(device)
    message(f"demo: rendering on {backend.variant} ({backend.reason})")
    message("demo: building the embedded scene (the first time takes a minute)")
    with progress_bars() as progress:
        place = load_place("alpine", None if workspace is None else Workspace(workspace), progress=progress)
        view = place.scene.camera(camera)
        sheets = contact_sheets(place, view, output, size_px=(width, height), spp=spp, progress=progress)
        film_size = (width // 4 * 2, height // 4 * 2)
        film = day_film(place, view, output / "24-hours.mp4", size_px=film_size, device=device, progress=progress)
    record = {"sheets": [str(sheet) for sheet in sheets], "film": str(film)}
    print_result(record, [f"{len(sheets)} contact sheets and a film in {output}"], as_json=json)
