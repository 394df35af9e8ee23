"""The page of the embedded scene in a browser, ``place/index.html`` of the built site: what ``seasonscapes view`` writes.

It is made by the program at every build and comes from the workspace afterwards; none of it is in git.
"""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

from sphinx.application import Sphinx

FOLDER = "place"
SCENE, CAMERA, TIME = "alpine", "aerial", "2024-09-18T18:40"


def write(app: Sphinx, error: Exception | None) -> None:
    """Write the page's folder into the built site."""
    if error is not None or app.builder.format != "html":
        return
    import seasonscapes as ss
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.workflows.viewer import first_view, require_vectorised, write_folder
    from seasonscapes.workflows.viewer_scene import SMALL, viewer_scene

    # That the page is coarser than the raster is meant here.
    logging.getLogger("seasonscapes.workflows.viewer_scene").setLevel(logging.ERROR)
    use_backend()
    require_vectorised()
    place = ss.load_place(SCENE)
    scene = viewer_scene(place, sky=ss.sky_model("clear"), detail=SMALL)
    folder = Path(app.outdir) / FOLDER
    shutil.rmtree(folder, ignore_errors=True)
    write_folder(scene, folder, first_view(place, CAMERA, TIME))


def setup(app: Sphinx) -> dict[str, bool]:
    app.connect("build-finished", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
