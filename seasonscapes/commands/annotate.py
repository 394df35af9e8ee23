"""``seasonscapes annotate``."""

from __future__ import annotations

import time as clock
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from seasonscapes.commands.arguments import check_range
from seasonscapes.commands.calibrate import TerrainSource
from seasonscapes.commands.console import message
from seasonscapes.commands.outputs import check_output_folder


def annotate_command(
    scene: str,
    *,
    webcam: str | None = None,
    picture: Path,
    output: Annotated[Path, Parameter(name=["--output", "-o"])] = Path("out/calibration"),
    port: int = 0,
    terrain: TerrainSource | None = None,
) -> None:
    """Match points of a photograph and the terrain on a local page, solve and save; ends with Ctrl-C.

    Parameters
    ----------
    scene
        A scene file with [[webcam]] tables.
    webcam
        Which of them; may be left out where there is one.
    picture
        A photograph of that webcam, in full size.
    output
        Folder for the points and the calibration.
    port
        Of the page on 127.0.0.1; 0 takes a free one.
    """
    from functools import partial

    from seasonscapes.calibration.annotation import AnnotationSession
    from seasonscapes.calibration.annotation_page import serve_session
    from seasonscapes.calibration.terrain_view import march_terrain_view
    from seasonscapes.workflows.webcam_calibration import station_picture

    check_output_folder(output)
    check_range("--port", port, 0, 65535)
    station = (terrain or TerrainSource()).station(scene, webcam)
    image = station_picture(picture, station, "--picture")
    look = partial(march_terrain_view, rasters=station.rasters, frame=station.frame)
    webcam_facts = station.webcam
    session = AnnotationSession(
        webcam_facts.id, image, station.view, station.frame, look, output, k1=webcam_facts.radial_k1
    )
    server, address = serve_session(session, port=port)
    message(f"annotate: open {address} in a browser; Ctrl-C ends")
    try:
        while True:
            clock.sleep(0.5)
    finally:
        server.shutdown()
