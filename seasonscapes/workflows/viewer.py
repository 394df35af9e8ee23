"""The page of a place in a browser: served here, as a static folder, as one file, or in a notebook."""

from __future__ import annotations

import html
import threading
import time as time_module
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote, urlsplit

from seasonscapes.albedo.seasons import AlbedoSeries
from seasonscapes.bundled import is_bundled
from seasonscapes.errors import InputError
from seasonscapes.export.viewer_files import ViewerScene, single_file, viewer_files
from seasonscapes.images import atomic_path
from seasonscapes.local_server import LocalHandler, LocalServer, Refused, Reply, serve_locally
from seasonscapes.progress import Progress
from seasonscapes.sky.models import SkyModel
from seasonscapes.workflows.export_scene import new_folder
from seasonscapes.workflows.gaussian_views import require_scene
from seasonscapes.workflows.illumination import sky_model
from seasonscapes.workflows.place import Place, utc_at
from seasonscapes.workflows.viewer_scene import SMALL, viewer_scene

if TYPE_CHECKING:
    from seasonscapes.gaussians.model import GaussianModel

_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".txt": "text/plain; charset=utf-8",
    ".json": "application/json",
    ".bin": "application/octet-stream",
    ".webp": "image/webp",
}
# What a page asks for as long as it is open.
_WATCH = "open"
_POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)


def first_view(place: Place, camera: str | None, time: str | datetime | None) -> dict[str, Any]:
    """What the page shows at first, as plain values.

    Raises
    ------
    InputError
        For a camera that the scene does not name, or a time that is none.
    """
    # A published page names no folder of the machine that made it.
    view: dict[str, Any] = {"scene": place.path.stem if is_bundled("scenes", place.path) else place.path.name}
    if camera is not None:
        view["camera"] = place.scene.camera(camera).name
    if time is not None:
        view["time"] = utc_at(place, time).isoformat().replace("+00:00", "Z")
    return view


def write_folder(scene: ViewerScene, folder: Path, view: dict[str, Any]) -> dict[str, int]:
    """Write the page as a static folder for any web host; the bytes of each file.

    Raises
    ------
    InputError
        Where there is a file, or a folder that is not empty.
    """
    files = viewer_files(scene, view=view)
    with new_folder(folder) as temporary:
        for name, content in files.items():
            (temporary / name).write_bytes(content)
    return {name: len(content) for name, content in files.items()}


def write_single_file(scene: ViewerScene, path: Path, view: dict[str, Any]) -> int:
    """Write the page as one HTML file, atomically; its bytes."""
    content = single_file(scene, view=view)
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)
    return len(content)


def with_gaussians(scene: ViewerScene, model: GaussianModel, place: Place) -> ViewerScene:
    """The page's data with a distilled model, which it lights and draws beside the mesh.

    Raises
    ------
    InputError
        For a model of another scene, of an appearance that the page does not evaluate, or with too many Gaussians.
    """
    from seasonscapes.gaussians.viewer_layer import viewer_layer

    require_scene(model, place)
    facts, arrays = viewer_layer(model)
    if arrays["from_sky"].shape[0] != scene.arrays["from_sky"].shape[0]:
        cure = "distil it again"
        raise InputError("--gaussians", "was distilled for another subdivision of the sky than the page's", cure=cure)
    return replace(scene, gaussians=(facts, arrays))


class OpenPages:
    """How many browsers show a page: each holds a request open for as long as it does."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._count, self._closed_s = 0, float("inf")

    def __enter__(self) -> None:
        with self._lock:
            self._count += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._count -= 1
            self._closed_s = time_module.monotonic()

    def gone(self, seconds: float = 5.0) -> bool:
        """Whether the last page was closed so many seconds ago: a page that is loaded again comes back sooner."""
        with self._lock:
            return self._count == 0 and time_module.monotonic() - self._closed_s > seconds


def serve_scene(scene: ViewerScene, view: dict[str, Any], *, port: int = 0) -> tuple[LocalServer, str, OpenPages]:
    """Serve the page on 127.0.0.1 in a background thread.

    The token of access is the first part of the path, so that the page's relative addresses carry it.

    Parameters
    ----------
    scene, view
        The place, and what is shown at first.
    port
        TCP port; 0 selects a free one.

    Returns
    -------
    server : LocalServer
        Call ``shutdown`` to stop it.
    address : str
        URL of the page with its token.
    pages : OpenPages
        Tells when the last page was closed.

    Raises
    ------
    InputError
        If the port is none, is taken, or may not be used.
    """
    files, pages = viewer_files(scene, view=view | {"watched": True}), OpenPages()

    class Handler(LocalHandler):
        def do_GET(self) -> None:
            self.answer(self._file)
            if self.watching:
                self._stay()

        def do_HEAD(self) -> None:
            self.answer(self._file)

        watching = False

        def _stay(self) -> None:
            """Send a byte a second until the page is closed, which ends the connection."""
            with pages:
                while True:
                    self.wfile.write(b" ")
                    self.wfile.flush()
                    time_module.sleep(1.0)

        def _file(self) -> Reply:
            token, _, name = unquote(urlsplit(self.path).path).lstrip("/").partition("/")
            self.require_access(token)
            name = name or "index.html"
            self.watching = name == _WATCH
            if self.watching:
                return Reply(200, "text/plain", b"", _POLICY, ends=False)
            if name not in files:
                raise Refused(404, "no such file")
            return Reply(200, _KINDS[Path(name).suffix], files[name], _POLICY)

    server, address = serve_locally(Handler, port=port)
    return server, f"{address}/{Handler.token}/", pages


@dataclass(frozen=True)
class PlaceView:
    """A place as a page in a notebook; made by `show`.

    Parameters
    ----------
    page
        The page, one HTML file with all its data.
    height_px
        Height of the frame in the notebook [px].

    Examples
    --------
    >>> import seasonscapes as ss
    >>> ss.PlaceView("<!doctype html>", height_px=400).height_px
    400
    """

    page: str
    height_px: int

    def _repr_html_(self) -> str:
        return (
            f'<iframe srcdoc="{html.escape(self.page, quote=True)}" sandbox="allow-scripts allow-popups" '
            f'style="width:100%;height:{self.height_px}px;border:0" title="A place in three dimensions"></iframe>'
        )

    def save(self, path: str | Path) -> None:
        """Write the page to an HTML file, atomically."""
        with atomic_path(Path(path)) as temporary:
            temporary.write_text(self.page, encoding="utf-8")


def show(
    place: Place,
    time: str | datetime | None = None,
    *,
    camera: str | None = None,
    sky: str | Path | SkyModel = "clear",
    albedo: AlbedoSeries | None = None,
    gaussians: GaussianModel | None = None,
    height_px: int = 640,
    progress: Progress | None = None,
) -> PlaceView:
    """Show a place in a notebook: drag the date and the hour, walk, look at it from its cameras.

    The page is the one that ``seasonscapes view`` serves, with fewer details, in one piece: it needs no running Python,
    no widget extension and no network, and a notebook that was saved still shows it.

    Parameters
    ----------
    place
        The place.
    time
        The instant that is shown at first: an aware datetime, or ISO 8601 text.
    camera
        Name of the scene's camera that is shown at first.
    sky
        A cloudless model of the atmosphere, its name or its file.
    albedo
        Dated albedos; ``None``: the scene's own.
    gaussians
        A model distilled from the place, which the page shows beside the mesh.
    height_px
        Height of the frame in the notebook [px].
    progress
        Called with a task and its finished share.

    Returns
    -------
    PlaceView
        Notebooks display it; ``save`` writes it to a file.

    Raises
    ------
    InputError
        For a camera or time that does not exist, and skies that the page cannot show.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> view = ss.show(place, "2024-07-20T18:30", camera="aerial")
    >>> view.page.startswith("<!doctype html>")
    True
    """
    require_vectorised()
    view = first_view(place, camera, time)
    scene = viewer_scene(place, albedo=albedo, sky=sky_model(sky), detail=SMALL, progress=progress)
    if gaussians is not None:
        scene = with_gaussians(scene, gaussians, place)
    return PlaceView(single_file(scene, view=view).decode(), height_px)


def require_vectorised() -> None:
    """`InputError` where the renderer has no vectorised backend, which light transport needs."""
    from seasonscapes.rendering.backend import use_backend

    if use_backend().device == "scalar":
        raise InputError("view", "needs a vectorised renderer", cure="install a libLLVM; see seasonscapes doctor")
