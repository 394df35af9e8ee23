"""The demonstration: the embedded scene through a day, a night and a year, as contact sheets and a film."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import date, datetime, timedelta
from functools import cached_property
from pathlib import Path

import numpy as np

from seasonscapes.albedo.seasons import AlbedoSeries
from seasonscapes.civil_time import resolve_time
from seasonscapes.images import write_png, write_png8
from seasonscapes.progress import Progress, each_reported
from seasonscapes.scene import NamedCamera
from seasonscapes.sky.models import read_sky_model
from seasonscapes.source_hash import source_hash
from seasonscapes.workflows.albedo_sources import dated_albedos
from seasonscapes.workflows.pictures import develop
from seasonscapes.workflows.place import MeshOptions, Place
from seasonscapes.workflows.relight_session import RelightSession, RenderJob, still_session, view_at
from seasonscapes.workflows.timelapse import cached_session, make_film
from seasonscapes.workflows.view_rendering import still_sampling
from seasonscapes.workflows.views import camera_for
from seasonscapes.workspace import content_key

log = logging.getLogger(__name__)

YEAR = 2024  # the full moon of 18 September stays high through the night
_CODE = ("workflows.demo",)


@dataclass(frozen=True)
class Panel:
    """One picture of a contact sheet: caption, civil time, name of the sky model."""

    caption: str
    time: str
    sky: str = "clear"


# The massif from its sunlit side, above the lake that mirrors it.
SCENE = "alpine_lake"
FIRST = Panel("June evening", f"{YEAR}-06-21T17:30")
DAY_AND_YEAR = [
    Panel("dawn, 18 September 07:00", f"{YEAR}-09-18T07:00"),
    Panel("noon, 13:20", f"{YEAR}-09-18T13:20"),
    Panel("afternoon, 17:00", f"{YEAR}-09-18T17:00"),
    Panel("evening, 19:05", f"{YEAR}-09-18T19:05"),
    Panel("winter afternoon, 20 January", f"{YEAR}-01-20T15:00", "alpine_winter"),
    Panel("spring afternoon, 5 May", f"{YEAR}-05-05T17:00"),
    Panel("summer afternoon, 20 July", f"{YEAR}-07-20T17:00"),
    Panel("autumn afternoon, 20 October", f"{YEAR}-10-20T16:00"),
]
_FIRST_HOUR = datetime(YEAR, 9, 17, 12)
HOURS = [
    Panel(f"{time:%d %b %H:%M}", f"{time:%Y-%m-%dT%H:%M}")
    for time in (_FIRST_HOUR + timedelta(hours=hour) for hour in range(24))
]
AIR = [
    Panel(f"{sky.replace('_', ' ')} afternoon, 20 July", f"{YEAR}-07-20T17:00", sky)
    for sky in ("clear", "hazy", "saharan_dust", "overcast")
]


def day_and_year(
    place: Place,
    view: NamedCamera,
    output: Path,
    *,
    size_px: tuple[int, int] = (720, 480),
    progress: Progress | None = None,
) -> list[Path]:
    """Relight one view on a June evening, and through a day, four seasons and four airs as two contact sheets.

    The ground has detail below the resolution of the data. Panels that exist already, made from the same inputs by the same
    code, are kept.

    Parameters
    ----------
    place, view
        The scene `SCENE` and one of its cameras.
    output
        Folder for panels and sheets.
    size_px
        Of the panels.
    progress
        Called with a task and its finished share.

    Returns
    -------
    list of pathlib.Path
        The picture and the sheets.
    """

    def session() -> RelightSession:
        series = AlbedoSeries(tuple(dated_albedos(place)), "nearest")
        camera = camera_for(place, view, size_px=size_px)
        how = {"base_day": date(YEAR, 6, 21), "sampling": still_sampling(), "amplify": True}
        return still_session(place, camera, albedo=series, **how, progress=progress)

    panels = _Panels(place, view, output, size_px, session)
    return [
        panels.picture(view.name, FIRST),
        panels.sheet("day-and-year", DAY_AND_YEAR, columns=4, progress=progress),
        panels.sheet("air", AIR, columns=2, progress=progress),
    ]


def night_and_film(
    place: Place,
    view: NamedCamera,
    output: Path,
    *,
    size_px: tuple[int, int] = (360, 240),
    device: str = "auto",
    progress: Progress | None = None,
) -> tuple[Path, Path]:
    """Show 24 hours under a full moon, as a contact sheet and as a film with a frame every ten minutes.

    Parameters
    ----------
    place, view, output, progress
        As in `day_and_year`.
    size_px
        Of panels and frames.
    device
        ``"auto"``, ``"cuda"`` or ``"llvm"``.

    Returns
    -------
    sheet, film
        The files. Undeveloped frames stay in the workspace for the next time.
    """
    job = RenderJob(
        place.path.resolve(),
        place.workspace.folder.resolve(),
        MeshOptions(),
        view,
        size_px,
        read_sky_model("clear"),
        season="nearest",
        amplify=True,
        base_day=_FIRST_HOUR.date(),
        device=device,
    )
    panels = _Panels(place, view, output, size_px, lambda: cached_session(job, place=place, progress=progress))
    sheet = panels.sheet("24-hours", HOURS, columns=6, progress=progress)
    start = resolve_time(f"{_FIRST_HOUR:%Y-%m-%dT%H:%M}", view.latitude_deg, view.longitude_deg).utc
    times = [start + index * timedelta(minutes=10) for index in range(145)]
    film = output / "24-hours.mp4"
    make_film(job, times, film, keep_frames=True, place=place, progress=progress)
    log.info("demo: %s", film)
    return sheet, film


class _Panels:
    """Relit panels of one view; its light transport is traced, or loaded, when the first panel is missing."""

    def __init__(
        self,
        place: Place,
        view: NamedCamera,
        folder: Path,
        size_px: tuple[int, int],
        make_session: Callable[[], RelightSession],
    ) -> None:
        self.place, self.view, self.folder, self.size_px = place, view, folder, size_px
        self._make_session = make_session

    @cached_property
    def session(self) -> RelightSession:
        return self._make_session()

    def sheet(self, name: str, panels: list[Panel], *, columns: int, progress: Progress | None) -> Path:
        """Write the panels and their contact sheet."""
        pictures = [
            self.picture(f"{name}-{index:02d}", panel)
            for index, panel in enumerate(each_reported(panels, len(panels), progress, name))
        ]
        path = self.folder / f"{name}.png"
        contact_sheet(path, pictures, [panel.caption for panel in panels], columns=columns)
        log.info("demo: %s", path)
        return path

    def picture(self, name: str, panel: Panel) -> Path:
        """Relight one panel, or keep the file that was made from the same inputs."""
        from PIL import Image

        path = self.folder / f"{name}.png"
        inputs = {"panel": panel, "size": self.size_px, "view": self.view, "place": self.place.key}
        key = content_key(inputs | {"code": source_hash(*_CODE)})
        if path.is_file():
            with Image.open(path) as image:
                if image.info.get("seasonscapes:panel") == key:
                    return path
        session = replace(self.session, sky=read_sky_model(panel.sky))
        time = resolve_time(panel.time, self.view.latitude_deg, self.view.longitude_deg).utc
        relit, light, _ = view_at(session, time)
        relit = replace(relit, provenance={"white_rgb": light.white_rgb})
        write_png(path, develop(relit), metadata={"seasonscapes:panel": key})
        log.info("demo: %s  %s", path.name, panel.caption)
        return path


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
