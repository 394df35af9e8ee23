"""The demonstration: the embedded scene through a day, a night and a year, as contact sheets and a film."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from datetime import date, datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.civil_time import resolve_time
from seasonscapes.exposure import exposure_ev100
from seasonscapes.images import write_png, write_png8
from seasonscapes.progress import Progress, each_reported
from seasonscapes.scene import NamedCamera
from seasonscapes.sky.models import read_sky_model
from seasonscapes.source_hash import source_hash
from seasonscapes.workflows.albedo_sources import scene_albedo
from seasonscapes.workflows.illumination import illumination_for_camera
from seasonscapes.workflows.pictures import develop
from seasonscapes.workflows.place import MeshOptions, Place
from seasonscapes.workflows.relight_session import RenderJob
from seasonscapes.workflows.timelapse import make_film
from seasonscapes.workflows.views import camera_for, terrain_for_view
from seasonscapes.workspace import content_key

if TYPE_CHECKING:
    from seasonscapes.rendering.mitsuba_scene import RenderScene
    from seasonscapes.rendering.radiance import RenderedView
    from seasonscapes.terrain.surface import Terrain

log = logging.getLogger(__name__)

YEAR = 2024  # the full moon of 18 September stays high through the night
_CODE = ("workflows.demo",)


@dataclass(frozen=True)
class Panel:
    """One picture of a contact sheet: caption, civil time, name of the sky model."""

    caption: str
    time: str
    sky: str = "clear"


DAY_AND_YEAR = [
    Panel("dawn, 18 September 07:00", f"{YEAR}-09-18T07:00"),
    Panel("morning, 09:00", f"{YEAR}-09-18T09:00"),
    Panel("noon, 13:20", f"{YEAR}-09-18T13:20"),
    Panel("evening, 19:05", f"{YEAR}-09-18T19:05"),
    Panel("winter noon, 20 January", f"{YEAR}-01-20T12:40", "alpine_winter"),
    Panel("spring noon, 5 May", f"{YEAR}-05-05T13:25"),
    Panel("summer noon, 20 July", f"{YEAR}-07-20T13:35"),
    Panel("autumn noon, 20 October", f"{YEAR}-10-20T13:10"),
]
_FIRST_HOUR = datetime(YEAR, 9, 17, 12)
HOURS = [
    Panel(f"{time:%d %b %H:%M}", f"{time:%Y-%m-%dT%H:%M}")
    for time in (_FIRST_HOUR + timedelta(hours=hour) for hour in range(24))
]
AIR = [
    Panel(f"{sky.replace('_', ' ')} noon, 20 July", f"{YEAR}-07-20T13:35", sky)
    for sky in ("clear", "hazy", "saharan_dust", "overcast")
]


def contact_sheets(
    place: Place,
    view: NamedCamera,
    output: Path,
    *,
    size_px: tuple[int, int] = (720, 480),
    spp: int = 32,
    progress: Progress | None = None,
) -> list[Path]:
    """Path trace the panels of three contact sheets (a day and a year, four airs, 24 hours) and assemble them.

    Panels that exist already, made from the same inputs by the same code, are kept.

    Parameters
    ----------
    place, view
        The embedded scene and one of its cameras.
    output
        Folder for panels and sheets.
    size_px
        Of the large panels; the hourly ones are half as wide.
    spp
        Samples per pixel.
    progress
        Called with a task and its finished share.

    Returns
    -------
    list of pathlib.Path
        The sheets.
    """
    renderer = _PanelRenderer(place, view, output, spp)
    half = (size_px[0] // 2, size_px[1] // 2)
    sheets = []
    for name, panels, columns, size in (
        ("day-and-year", DAY_AND_YEAR, 4, size_px),
        ("air", AIR, 2, size_px),
        ("24-hours", HOURS, 6, half),
    ):
        pictures = [
            renderer.picture(f"{name}-{index:02d}", panel, size)
            for index, panel in enumerate(each_reported(panels, len(panels), progress, name))
        ]
        sheets.append(output / f"{name}.png")
        contact_sheet(sheets[-1], pictures, [panel.caption for panel in panels], columns=columns)
        log.info("demo: %s", sheets[-1])
    return sheets


def day_film(
    place: Place,
    view: NamedCamera,
    path: Path,
    *,
    size_px: tuple[int, int],
    device: str = "auto",
    progress: Progress | None = None,
) -> Path:
    """Film a day and a night, every ten minutes; undeveloped frames stay in the workspace for the next time."""
    job = RenderJob(
        place.path.resolve(),
        place.workspace.folder.resolve(),
        MeshOptions(),
        view,
        size_px,
        read_sky_model("clear"),
        season="nearest",
        base_day=_FIRST_HOUR.date(),
        device=device,
    )
    start = resolve_time(f"{_FIRST_HOUR:%Y-%m-%dT%H:%M}", view.latitude_deg, view.longitude_deg).utc
    times = [start + index * timedelta(minutes=10) for index in range(145)]
    make_film(job, times, path, keep_frames=True, place=place, progress=progress)
    log.info("demo: %s", path)
    return path


class _PanelRenderer:
    """Renders panels of one place; the mesh is kept while the albedo's day stays the same."""

    def __init__(self, place: Place, view: NamedCamera, folder: Path, spp: int) -> None:
        self.place, self.view, self.folder, self.spp = place, view, folder, spp
        self.day: date | None = None
        self.mi_mesh: Any = None

    @cached_property
    def terrain(self) -> Terrain:
        """The terrain as the view needs it; made when the first panel is rendered."""
        return terrain_for_view(self.place, camera_for(self.place, self.view, size_px=(768, 512)))

    def picture(self, name: str, panel: Panel, size_px: tuple[int, int]) -> Path:
        """Render one panel, or keep the file that was made from the same inputs."""
        from PIL import Image

        path = self.folder / f"{name}.png"
        inputs = {"panel": panel, "size": size_px, "spp": self.spp, "view": self.view, "place": self.place.key}
        key = content_key(inputs | {"code": source_hash(*_CODE)})
        if path.is_file():
            with Image.open(path) as image:
                if image.info.get("seasonscapes:panel") == key:
                    return path
        view, ev100 = self._view(panel, size_px)
        log.info("demo: %s  %s; EV %.1f", path.name, panel.caption, ev100)
        write_png(path, develop(view, exposure=ev100), metadata={"seasonscapes:panel": key})
        return path

    def _view(self, panel: Panel, size_px: tuple[int, int]) -> tuple[RenderedView, float]:
        from seasonscapes.rendering.radiance import render_view

        place, view = self.place, self.view
        time = resolve_time(panel.time, view.latitude_deg, view.longitude_deg).utc
        camera = camera_for(place, view, size_px=size_px)
        light, _ = illumination_for_camera(place, camera, read_sky_model(panel.sky), time)
        picture = render_view(self._scene(time.date(), light), camera, spp=self.spp)
        return replace(picture, provenance={"white_rgb": light.white_rgb}), exposure_ev100(
            picture.radiance, look="photo"
        )

    def _scene(self, day: date, light: Any) -> RenderScene:
        from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight

        if self.day != day:
            self.day, self.mi_mesh = day, mi_mesh(self.terrain, scene_albedo(self.place, day).values)
        return relight(self.mi_mesh, light)


def contact_sheet(path: Path, pictures: list[Path], captions: list[str], *, columns: int) -> None:
    """Write pictures of one size side by side in rows, each with its caption beneath.

    Parameters
    ----------
    path
        The ``.png`` to write.
    pictures, captions
        Files and one line of text for each.
    columns
        Pictures in a row.
    """
    import cv2
    from PIL import Image

    tiles = []
    for picture, caption in zip(pictures, captions, strict=True):
        image = np.asarray(Image.open(picture).convert("RGB"))
        strip = np.full((26, image.shape[1], 3), 24, np.uint8)
        cv2.putText(strip, caption, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.45, (225, 225, 225), 1, cv2.LINE_AA)
        tiles.append(np.vstack([image, strip]))
    blank = np.full_like(tiles[0], 24)
    tiles += [blank] * (-len(tiles) % columns)
    rows = [np.hstack(tiles[start : start + columns]) for start in range(0, len(tiles), columns)]
    write_png8(path, np.vstack(rows))
