"""``seasonscapes demo``: the embedded scene through a day, a night and a year, as contact sheets."""

from __future__ import annotations

import json as json_module
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from seasonscapes.commands.talk import finish, progress_bar, say

YEAR = 2024  # its full moon of 18 September stands high through the night


@dataclass(frozen=True)
class Panel:
    """One picture of a sheet: caption, civil time, sky model."""

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
HOURS = [
    Panel(
        f"{(datetime(YEAR, 9, 17, 12) + timedelta(hours=h)):%d %b %H:%M}",
        f"{datetime(YEAR, 9, 17, 12) + timedelta(hours=h):%Y-%m-%dT%H:%M}",
    )
    for h in range(24)
]
FILM_START = f"{YEAR}-09-17T12:00"
AIR = [
    Panel(f"{sky.replace('_', ' ')} noon, 20 July", f"{YEAR}-07-20T13:35", sky)
    for sky in ("clear", "hazy", "saharan_dust", "overcast")
]


def demo(
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

    Pictures that are already there, made with the same arguments, are kept: an interrupted demo goes on where it was.

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
    from seasonscapes.commands.talk import parse_size
    from seasonscapes.pipeline import find_scene, load_place
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.workspace import Workspace, default_workspace

    width, height = parse_size(size)
    backend = use_backend(device)
    say(f"demo: rendering on {backend.variant} ({backend.reason})")
    say("demo: building the embedded scene (the first time takes a minute)")
    place = load_place(find_scene("alpine"), Workspace(workspace) if workspace else default_workspace())
    view = place.scene.camera(camera)
    studio = _Studio(place, view, Path(output))
    sheets = []
    for name, panels, columns, shape in (
        ("day-and-year", DAY_AND_YEAR, 4, (width, height)),
        ("air", AIR, 2, (width, height)),
        ("24-hours", HOURS, 6, (width // 2, height // 2)),
    ):
        pictures = []
        with progress_bar(name) as progress:
            for index, panel in enumerate(panels):
                pictures.append(studio.picture(f"{name}-{index:02d}", panel, shape, spp))
                progress((index + 1) / len(panels))
        sheet = Path(output) / f"{name}.png"
        contact_sheet(sheet, pictures, [panel.caption for panel in panels], columns=columns)
        say(f"demo: {sheet}")
        sheets.append(str(sheet))
    film = _film(place, view, Path(output) / "24-hours.mp4", (width // 4 * 2, height // 4 * 2), device)
    finish(
        {"sheets": sheets, "film": str(film)}, [f"{len(sheets)} contact sheets and a film in {output}"], as_json=json
    )


def _film(place, view, path: Path, size_px: tuple[int, int], device: str) -> Path:
    """A day and a night, every ten minutes; its undeveloped frames stay in the workspace for the next time."""
    from seasonscapes.civil_time import resolve_time
    from seasonscapes.commands.timelapse import WorkOptions, develop_film, render_frames
    from seasonscapes.pipeline import MeshOptions
    from seasonscapes.sky.models import read_sky_model
    from seasonscapes.studio import Assignment

    assignment = Assignment(
        str(place.path.resolve()),
        str(place.workspace.folder.resolve()),
        MeshOptions(),
        view,
        size_px,
        read_sky_model("clear"),
        season="nearest",
        base_day=FILM_START[:10],
        device=device,
    )
    start = resolve_time(FILM_START, view.latitude_deg, view.longitude_deg).utc
    times = [start + index * timedelta(minutes=10) for index in range(145)]
    render_frames(assignment, times, WorkOptions(), None)
    develop_film(assignment, times, path, ("auto", 900.0, 24.0))
    say(f"demo: {path}")
    return path


class _Studio:
    """Keeps the built terrain between panels: only light, and with the date the albedo, change."""

    def __init__(self, place, view, folder: Path):
        self.place, self.view, self.folder = place, view, folder
        self.day, self.mi_terrain = None, None

    def picture(self, name: str, panel: Panel, size_px: tuple[int, int], spp: int) -> Path:
        """Render one panel, or keep the one that is there."""
        from PIL import Image

        from seasonscapes import __version__

        path = self.folder / f"{name}.png"
        record = json_module.dumps(
            {
                "panel": panel.__dict__,
                "size": size_px,
                "spp": spp,
                "version": __version__,
                "view": self.view.model_dump(),
                "terrain": str(self.place.key),
            },
            sort_keys=True,
        )
        if path.is_file() and Image.open(path).text.get("seasonscapes:panel") == record:
            return path
        self._render(path, panel, size_px, spp, record)
        return path

    def _render(self, path: Path, panel: Panel, size_px: tuple[int, int], spp: int, record: str) -> None:
        from seasonscapes.civil_time import resolve_time
        from seasonscapes.daylight import light_for
        from seasonscapes.exposure import develop, exposure_ev100
        from seasonscapes.images import write_png
        from seasonscapes.pipeline import albedo_for, camera_for
        from seasonscapes.rendering.mitsuba_scene import mi_mesh, relight
        from seasonscapes.rendering.radiance import render_view
        from seasonscapes.sky.models import read_sky_model

        place, view = self.place, self.view
        time = resolve_time(panel.time, view.latitude_deg, view.longitude_deg).utc
        camera = camera_for(place, view, size_px=size_px)
        light, moment = light_for(place, camera, read_sky_model(panel.sky), time)
        if self.day != time.timetuple().tm_yday:
            self.day = time.timetuple().tm_yday
            self.mi_terrain = mi_mesh(place.terrain, albedo_for(place, time).values)
        scene = relight(self.mi_terrain, light, max_height_m=float(place.terrain.vertices[:, 2].max()))
        picture = render_view(scene, camera, spp=spp)
        ev100 = exposure_ev100(picture.radiance)
        say(f"demo: {path.name}  {panel.caption}; sun {moment.sun.elevation_deg:+.1f}°, EV {ev100:.1f}")
        write_png(path, develop(picture.radiance, ev100), metadata={"seasonscapes:panel": record})


def contact_sheet(path: Path, pictures: list[Path], captions: list[str], *, columns: int) -> None:
    """Pictures of one size side by side in rows, each with its caption beneath."""
    import cv2
    import numpy as np
    from PIL import Image

    from seasonscapes.images import write_png8

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
