"""``seasonscapes view``."""

from __future__ import annotations

import time as clock
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_range, parse_albedo
from seasonscapes.commands.console import message, print_result, progress_bars
from seasonscapes.commands.options import PlaceOptions, SkyOptions
from seasonscapes.commands.outputs import check_output, check_output_folder
from seasonscapes.errors import InputError


def view_command(
    scene: str,
    *,
    camera: str | None = None,
    time: str | None = None,
    albedo: list[str] | None = None,
    gaussians: Path | None = None,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    single_file: Path | None = None,
    port: int = 0,
    open: bool = True,
    sky: SkyOptions | None = None,
    place: PlaceOptions | None = None,
    json: bool = False,
) -> None:
    """Show a place in a browser, where date and hour are dragged; serves on 127.0.0.1 until the page is closed.

    Parameters
    ----------
    scene
        A scene file, or the name of a bundled scene (alpine).
    camera
        The scene's camera that is shown at first; its first one when left out.
    time
        The instant that is shown at first: ISO 8601; without an offset it is civil time at the place.
    albedo
        DATE=FILE, may be repeated: albedos of a date instead of the scene's own (.npz; or .png, .exr, .glb of this atlas).
    gaussians
        A model of `seasonscapes distill`: the page shows it beside the mesh, lit for the hour.
    output
        Write a static folder for any web host instead of serving.
    single_file
        Write one .html file that opens from the file system instead of serving.
    port
        Of the page on 127.0.0.1; 0 takes a free one.
    open
        Open the browser.
    json
        With -o or --single-file: print one machine-readable record.
    """
    start = clock.perf_counter()
    check_range("--port", port, 0, 65535)
    if output is not None:
        check_output_folder(output)
    if single_file is not None:
        check_output(single_file, (".html",))
    if json and output is None and single_file is None:
        raise InputError("--json", "goes with --output or --single-file", cure="drop it, or write files")
    from seasonscapes.albedo.seasons import AlbedoSeries
    from seasonscapes.workflows import viewer
    from seasonscapes.workflows.albedo_sources import dated_albedos
    from seasonscapes.workflows.viewer_scene import viewer_scene

    model, options = (sky or SkyOptions()).model(), place or PlaceOptions()
    files = [parse_albedo(text) for text in albedo or ()]
    viewer.require_vectorised()
    distilled = _read_gaussians(gaussians)
    with progress_bars() as progress:
        loaded = options.load(scene, progress, albedo=[each.path for each in files])
        first = viewer.first_view(loaded, camera, time)
        series = AlbedoSeries(tuple(dated_albedos(loaded, files))) if files else None
        shown = viewer_scene(loaded, albedo=series, sky=model, progress=progress)
        if distilled is not None:
            shown = viewer.with_gaussians(shown, distilled, loaded)
    record: dict[str, Any] = {"scene": loaded.scene.name, "attribution": loaded.scene.attribution, **first}
    lines = []
    if output is not None:
        record["files"] = viewer.write_folder(shown, output, first)
        size = sum(record["files"].values()) / 1e6
        lines.append(f"{output}  ({len(record['files'])} files, {size:.1f} MB; a web host serves them as they are)")
    if single_file is not None:
        record["single_file_bytes"] = viewer.write_single_file(shown, single_file, first)
        lines.append(f"{single_file}  ({record['single_file_bytes'] / 1e6:.1f} MB)")
    if lines:
        record["seconds"] = round(clock.perf_counter() - start, 2)
        print_result(record, lines, as_json=json)
        return
    _serve(shown, first, port, open)


def _read_gaussians(path: Path | None) -> Any:
    """A model of Gaussians; ``None`` without a path."""
    if path is None:
        return None
    from seasonscapes.workflows.distillation import require_torch

    require_torch()
    from seasonscapes.gaussians.model import load_model

    return load_model(path)


def _serve(scene: Any, first: dict[str, Any], port: int, open_browser: bool) -> None:
    """Serve until the page is closed, or Ctrl-C."""
    import webbrowser

    from seasonscapes.workflows.viewer import serve_scene

    server, address, pages = serve_scene(scene, first, port=port)
    message(f"view: open {address} in a browser; closing the page or Ctrl-C ends")
    try:
        if open_browser:
            webbrowser.open(address)
        while not pages.gone():
            clock.sleep(0.5)
    finally:
        server.shutdown()
        server.server_close()
