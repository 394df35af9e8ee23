"""The clock of a fixed camera: shadows in its pictures against those that the sun throws at nearby times."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from seasonscapes.albedo.picture_conditions import ViewLight
from seasonscapes.cameras.pinhole import Camera, ray_directions
from seasonscapes.errors import InputError
from seasonscapes.progress import Progress, task_progress
from seasonscapes.sky.ephemeris import at_index, sun_position
from seasonscapes.sky.illumination import Luminary
from seasonscapes.workflows.unseen_hours import FixedView, fixed_view, light_on_view, require_same_view, without_hidden

if TYPE_CHECKING:
    from seasonscapes.albedo.shadow_clock import ClockOffset
    from seasonscapes.cameras.observation import Observation
    from seasonscapes.workflows.place import Place

log = logging.getLogger(__name__)

# How far a clock may be taken to be off [min].
WINDOW_MIN = (10.0, 180.0)
# Offsets are tried this far apart [min], in which the sun moves by its diameter.
STEP_MIN = 2.0
# So many pixels of either kind tell weather and shadows; blocks of the picture across its width that err together.
_MOST_PIXELS, _BLOCKS_ACROSS = 3000, 8
# Heights are changed by so much to see how far shadows move [m]; by more, edges that move most would leave the window.
_RAISED_M = 3.0
# A clock is doubted where it is off by so many standard deviations, and by more than the step.
_DOUBTED_SIGMAS = 3.0


@dataclass(frozen=True)
class PictureClock:
    """The clock of one picture; from `picture_clocks`.

    Parameters
    ----------
    time
        As stated, aware UTC.
    offset_min, sigma_min
        Minutes to add to the stated time, and their standard deviation; NaN and infinity where no shadow was compared.
    trusted
        Whether the picture decides.
    reason
        What it was found from, or why it is not to be trusted.
    edge_speed_m_per_min
        Median speed of the shadows' edges over the ground; NaN where it was not measured.
    heights_min_per_m
        By how many minutes an edge comes too early or too late where the heights of its ridge, or of the ground that it
        crosses, err by a metre (mean); NaN where it was not measured.

    Examples
    --------
    >>> from datetime import datetime, timezone
    >>> import seasonscapes as ss
    >>> noon = datetime(2024, 9, 18, 12, tzinfo=timezone.utc)
    >>> ss.PictureClock(noon, 17.2, 1.1, True, "from 900 pixels in 12 parts of the picture", 20.0, 0.1).doubted
    True
    """

    time: datetime
    offset_min: float
    sigma_min: float
    trusted: bool
    reason: str
    edge_speed_m_per_min: float
    heights_min_per_m: float

    @property
    def doubted(self) -> bool:
        """Whether the shadows contradict the stated time."""
        return self.trusted and abs(self.offset_min) > max(_DOUBTED_SIGMAS * self.sigma_min, STEP_MIN)

    def told(self) -> str:
        """One line for people."""
        at = self.time.isoformat()
        if not self.trusted:
            return f"{at}  clock not told: {self.reason}"
        told = f"{at}  clock {self.offset_min:+.1f} ± {self.sigma_min:.1f} min"
        if np.isfinite(self.edge_speed_m_per_min):
            told += f"; shadows run {self.edge_speed_m_per_min:.0f} m/min"
        if np.isfinite(self.heights_min_per_m):
            told += f"; 10 m of error of the heights is {10.0 * self.heights_min_per_m:.1f} min at an edge"
        return told + ("  CHECK THE CLOCK" if self.doubted else "")


def picture_clocks(
    place: Place,
    photographs: Sequence[Observation],
    *,
    window_min: float = 60.0,
    view: FixedView | None = None,
    progress: Progress | None = None,
) -> list[PictureClock]:
    """Compare the cast shadows in a fixed camera's pictures with those of the sun before and after the stated times.

    Nothing is corrected. Each picture's ground is known from the other ones, whose clocks are taken to be right. High suns,
    whose shadows barely move, tell nothing.

    Parameters
    ----------
    place
        The place.
    photographs
        Three or more of one camera that stands still; masks leave out what stands before the terrain.
    window_min
        How far a clock may be off, 10 to 180 [min].
    view
        Of these photographs' camera, where it was traced before (`CameraHours.view`).
    progress
        Called with a task and its finished share.

    Returns
    -------
    list of PictureClock
        Of each picture that shows terrain.

    Raises
    ------
    InputError
        For fewer than three photographs, those of several cameras or of one that turned, and a window out of range.
    NoTerrainInView
        Where the camera sees no terrain.

    Examples
    --------
    >>> import tempfile
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> times = ["2024-07-20T09:00", "2024-07-20T12:00", "2024-07-20T16:00"]
    >>> camera = ss.camera(place, "aerial", size_px=(48, 32))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     sources = ss.synthetic_photographs(place, times, folder, sky="hosek", cameras={"aerial": camera})
    ...     photographs = ss.open_photographs(place, sources.manifest, sources.calibrations, times)
    >>> [each.doubted for each in ss.picture_clocks(place, photographs, window_min=30)]
    [False, False, False]
    """
    from seasonscapes.rendering.backend import use_backend

    if not WINDOW_MIN[0] <= window_min <= WINDOW_MIN[1]:
        expected = f"{WINDOW_MIN[0]:g} to {WINDOW_MIN[1]:g}"
        raise InputError("window_min", "out of range", got=f"{window_min:g}", expected=expected)
    for each in photographs[1:]:
        require_same_view(photographs[0], each)
    camera = checkable_camera(photographs)
    use_backend()
    view = view or fixed_view(place, camera, progress=progress)
    shown = without_hidden(view, photographs)
    report = task_progress(progress, "clocks")
    pictures = [image.reshape(-1, 3)[view.pixel] for _, image, _ in shown]
    usable = [mask for _, _, mask in shown]
    lights = [light_on_view(view, each.time) for each, _, _ in shown]
    clocks = []
    for k, (each, _, _) in enumerate(shown):
        clocks.append(_clock(view, each.time, (pictures, usable, lights), k, window_min))
        if clocks[-1].doubted:
            log.warning(
                "%s UTC: its shadows lie where the sun stood %+.1f ± %.1f min from this time: check the camera's clock",
                each.time.isoformat(),
                clocks[-1].offset_min,
                clocks[-1].sigma_min,
            )
        report((k + 1) / len(shown))
    return clocks


def checkable_camera(photographs: Sequence[Observation]) -> Camera:
    """The camera of photographs whose clocks can be compared; `InputError` for fewer than three, or panoramas."""
    camera = photographs[0].camera if photographs else None
    if len(photographs) < 3 or not isinstance(camera, Camera):
        raise InputError(
            "photographs", f"{len(photographs)} given", expected="three or more views of one camera to check its clock"
        )
    return camera


def save_clocks(clocks: Sequence[PictureClock], path: Path) -> list[dict[str, Any]]:
    """Write the clocks of pictures as JSON; numbers that were not found are null.

    Parameters
    ----------
    clocks
        From `picture_clocks`.
    path
        The file.

    Returns
    -------
    list of dict
        What was written.
    """
    from seasonscapes.images import atomic_path

    rows = []
    for each in clocks:
        row = {"time_utc": each.time.isoformat(), **asdict(each), "doubted": each.doubted}
        del row["time"]
        rows.append({k: None if isinstance(v, float) and not np.isfinite(v) else v for k, v in row.items()})
    with atomic_path(path) as written:
        written.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")
    return rows


def _clock(
    view: FixedView,
    time: datetime,
    stack: tuple[list[np.ndarray], list[np.ndarray], list[ViewLight]],
    k: int,
    window_min: float,
) -> PictureClock:
    """The clock of picture ``k``."""
    from seasonscapes.albedo.fixed_camera import fit_fixed_camera, sampled_pixels
    from seasonscapes.albedo.shadow_clock import clock_offset, swept_and_steady

    pictures, usable, lights = stack
    if not lights[k].sun.any():
        return PictureClock(time, np.nan, np.inf, False, "the sun is below the horizon", np.nan, np.nan)
    steps = int(window_min // STEP_MIN)
    offsets = STEP_MIN * np.arange(-steps, steps + 1)
    suns = _suns(view, time, offsets)
    visible = _visible(view, suns)
    tried = [_with_sun(lights[k], sun, seen) for sun, seen in zip(suns, visible, strict=True)]
    swept, steady = swept_and_steady(tried, view.normal)
    chosen = np.sort(
        np.concatenate(
            [
                np.flatnonzero(kind)[sampled_pixels(view.distance_km[kind], _MOST_PIXELS, 0)]
                for kind in (swept & usable[k], steady & usable[k])
                if kind.any()
            ]
            or [np.arange(0)]
        )
    )
    others = [j for j in range(len(pictures)) if j != k and usable[j][chosen].any()]
    if len(others) < 2:
        reason = "fewer than two other pictures show the ground that shadows sweep over"
        return PictureClock(time, np.nan, np.inf, False, reason, np.nan, np.nan)
    ground = fit_fixed_camera(
        [pictures[j][chosen] for j in others],
        [usable[j][chosen] for j in others],
        [lights[j].at(chosen) for j in others],
        view.distance_km[chosen],
        view.normal[chosen],
    )
    found = clock_offset(
        ground,
        pictures[k][chosen],
        usable[k][chosen],
        [each.at(chosen) for each in tried],
        offsets,
        normal=view.normal[chosen],
        block=_blocks(view)[chosen],
    )
    speed, per_m = _edges(view, suns, visible, offsets, swept) if found.trusted else (np.nan, np.nan)
    return _joined(time, found, speed, per_m)


def _joined(time: datetime, found: ClockOffset, speed: float, per_m: float) -> PictureClock:
    return PictureClock(time, found.offset_min, found.sigma_min, found.trusted, found.reason, speed, per_m)


def _suns(view: FixedView, time: datetime, offsets_min: np.ndarray) -> list[Luminary]:
    frame = view.place.frame
    times = [time + timedelta(minutes=float(each)) for each in offsets_min]
    position = sun_position(times, frame.latitude_deg, frame.longitude_deg, view.place.median_height_m)
    return [
        Luminary(each.direction, np.ones(3), float(each.angular_radius_deg))
        for each in (at_index(position, index) for index in range(len(times)))
    ]


def _visible(view: FixedView, suns: Sequence[Luminary], raised_m: float = 0.0) -> np.ndarray:
    """Share of the ground in each pixel that sees each of the suns ``(M, n)``."""
    from seasonscapes.albedo.view_light import sun_visible, view_raised

    of = view_raised(view.view, raised_m) if raised_m else view.view
    return np.stack([sun_visible(of, sun)[view.chosen] for sun in suns])


def _with_sun(light: ViewLight, sun: Luminary, visible: np.ndarray) -> ViewLight:
    return ViewLight(light.sun, visible, np.asarray(sun.direction, float), light.sky, light.clouds, light.day)


def _blocks(view: FixedView) -> np.ndarray:
    """Number ``(n,)`` of the block of the picture in which each pixel lies."""
    row, column = np.divmod(view.pixel, view.camera.width_px)
    side = max(view.camera.width_px // _BLOCKS_ACROSS, 1)
    return row // side * (_BLOCKS_ACROSS + 1) + column // side


def _edges(
    view: FixedView, suns: Sequence[Luminary], visible: np.ndarray, offsets_min: np.ndarray, swept: np.ndarray
) -> tuple[float, float]:
    """Speed of the edges [m/min], and minutes by which they shift where heights err by a metre."""
    from seasonscapes.albedo.shadow_clock import crossing_min, edge_speed_m_per_min

    camera = view.camera
    time = np.where(swept, crossing_min(visible, offsets_min), np.nan)
    raised = np.where(swept, crossing_min(_visible(view, suns, _RAISED_M), offsets_min), np.nan)
    shift = np.abs(raised - time) / _RAISED_M
    per_m = float(np.mean(shift[np.isfinite(shift)])) if np.isfinite(shift).any() else float("nan")
    times, position = np.full((camera.height_px, camera.width_px), np.nan), ray_directions(camera)
    times.reshape(-1)[view.pixel] = time
    distance = np.full(times.shape, np.nan)
    distance.reshape(-1)[view.pixel] = 1000.0 * view.distance_km
    return edge_speed_m_per_min(times, position * distance[..., None]), per_m
