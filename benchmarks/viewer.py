"""The page of a place beside path tracing: pictures, shadows, sky, times of the sun, bytes and seconds.

    python benchmarks/viewer.py [--quick] [--seed N] [--scene SCENE] [--json FILE]

The page (``seasonscapes view``) is written as a static folder, served by Python's own server and opened by a headless
Chromium that reaches nothing else; without a WebGL context nothing is measured and the benchmark fails. The truth is
``render`` with 6 edges a path, in rounds of 64 paths a pixel until its own noise is small: three cameras of the scene
at six hours, from a sun 4° below the horizon to noon, with the same albedo date. Both radiances are developed by the
same code, at the exposure and white of the truth, and compared as 8-bit sRGB where terrain covers at least half of a
pixel. ``--quick`` takes 160 x 120 pixels instead of 384 x 288.

Truth and page share the heights, the albedo, the sky model and its tables, and nothing of the light transport between
them but the daylight coefficients that the page's are made of. Shadows are compared by sunlight alone: where a pixel
has less than half of the sunlight that it would have without shadows; that unshadowed sunlight is the page's for both.
Times of the sun are those at which more than half of its disc is seen; the truth traces rays to 64 points of the disc
every minute, over the mesh of all heights. Within a cell of the raster a grazing sun may come and go half an hour apart,
by how the cell is triangulated; an error is therefore what lies beyond the times of five points of the cell: the
clicked one and those half a cell to its east, west, north and south. Errors at the clicked point alone are recorded too
(``sun_times_strict_...``).
"""

from __future__ import annotations

import argparse
import secrets
import tempfile
import time
from dataclasses import dataclass, replace
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
from record import write_record
from viewer_browser import chromium, open_page, prepare, processor_s, radiance, served, shrunk, why_no_browser

import seasonscapes as ss
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.exposure import develop, exposure_ev100
from seasonscapes.images import srgb8_from_linear
from seasonscapes.rendering.backend import use_backend
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.irradiance import surface_at
from seasonscapes.rendering.mitsuba_scene import build_scene, mi_mesh
from seasonscapes.rendering.radiance import render_view
from seasonscapes.rendering.sun_visibility import sum_incidence, sun_rays
from seasonscapes.sky.illumination import Luminary
from seasonscapes.workflows.illumination import illumination_for_camera, position_at
from seasonscapes.workflows.viewer import write_folder
from seasonscapes.workflows.viewer_scene import viewer_scene
from seasonscapes.workflows.views import view_with_terrain

DAY = date(2024, 7, 16)
SUN_DEG = (-4.0, 1.5, 6.0, 15.0, 35.0, 90.0)
CONTROLS = {
    "no_shadows": {"change": {"shadows": 0}},
    "no_bounce": {"change": {"bounce": 0}},
    "no_air": {"change": {"air": 0}},
}
# Paths a pixel of a round, the noise that the mean of rounds may keep, and most rounds.
SPP, NOISE_DB, MOST_ROUNDS = 64, 38.0, 4
# Frames of the page, each of OVERSAMPLED x OVERSAMPLED pixels for one of the truth.
FRAMES, OVERSAMPLED = 6, 2


@dataclass(frozen=True)
class Truth:
    """A path-traced view: radiance, coverage, radiance by sunlight alone without air (``None`` without a sun), look, noise."""

    camera: int
    time: datetime
    radiance: np.ndarray
    coverage: np.ndarray
    sunlight: np.ndarray | None
    ev100: float
    white: tuple[float, float, float]
    noise_db: float

    def shown(self, image: np.ndarray) -> np.ndarray:
        """8-bit sRGB of an image at the exposure and white of this view."""
        return srgb8_from_linear(develop(image, self.ev100, look="photo", white=self.white))

    def psnr_db(self, image: np.ndarray) -> float:
        """PSNR of an image on terrain [dB]."""
        ground = self.coverage >= 0.5
        error = self.shown(image)[ground].astype(float) - self.shown(self.radiance)[ground]
        return float(10.0 * np.log10(255.0**2 / np.mean(error**2)))


def hours_of(place: ss.Place, day: date) -> list[datetime]:
    """Instants of a day's morning at which the sun reaches `SUN_DEG`; the last is its culmination."""
    midnight = _midnight(place, day)
    minutes = [midnight + timedelta(minutes=k) for k in range(0, 24 * 60, 2)]
    elevation = np.array([position_at(place, each).sun.elevation_deg for each in minutes])
    noon = int(np.argmax(elevation))
    found = []
    for wanted in SUN_DEG:
        after = np.flatnonzero(elevation[: noon + 1] >= wanted)
        found.append(minutes[int(after[0]) if len(after) else noon])
    return found


def _midnight(place: ss.Place, day: date) -> datetime:
    noon = datetime(day.year, day.month, day.day, 12, tzinfo=UTC) - timedelta(hours=place.frame.longitude_deg / 15.0)
    return noon - timedelta(hours=12)


def path_traced(
    scene, camera: Camera, white: tuple[float, float, float], seed: int
) -> tuple[np.ndarray, np.ndarray, float]:
    """Mean radiance and coverage of rounds of `SPP` paths a pixel, until its noise on terrain is `NOISE_DB`; the noise [dB].

    One round leaves up to 30 dB on snow in skylight, which says nothing about the page.
    """
    images: list[np.ndarray] = []
    noise_db = 0.0
    while len(images) < MOST_ROUNDS and noise_db < NOISE_DB:
        view = render_view(scene, camera, spp=SPP, seed=seed + 1000 * len(images), max_depth=6)
        images.append(view.radiance)
        if len(images) == 2:
            ev100 = exposure_ev100(images[0], look="photo")
            first, second = (srgb8_from_linear(develop(image, ev100, look="photo", white=white)) for image in images)
            # Half the mean square of the difference of two is the variance of one.
            variance = 0.5 * np.mean((first.astype(float) - second)[view.coverage >= 0.5] ** 2)
        if len(images) >= 2:
            noise_db = float(10.0 * np.log10(255.0**2 * len(images) / variance))
    return np.mean(images, axis=0), view.coverage, noise_db


def truth_of(
    place: ss.Place, cameras: dict[int, Camera], times: list[datetime], albedo: np.ndarray, seed: int
) -> list[Truth]:
    """Path-traced views of all cameras and times."""
    found, sky = [], ss.sky_model("clear")
    for number, camera in cameras.items():
        terrain = view_with_terrain(place, camera)[1]
        for instant in times:
            light, _ = illumination_for_camera(place, camera, sky, instant)
            image, coverage, noise = path_traced(build_scene(terrain, albedo, light), camera, light.white_rgb, seed)
            sunlight = None
            if light.sun is not None:
                dark = np.zeros_like(light.sky_radiance)
                alone = replace(light, sky_radiance=dark, visible_sky=dark, moon=None, aerial_perspective=None)
                sunlight = render_view(
                    build_scene(terrain, albedo, alone), camera, spp=32, seed=seed, max_depth=2
                ).surface
            ev100 = exposure_ev100(image, look="photo")
            found.append(Truth(number, instant, image, coverage, sunlight, ev100, light.white_rgb, noise))
    return found


def shadow_agreement(truth: Truth, lit: np.ndarray, unshadowed: np.ndarray) -> tuple[int, int]:
    """Pixels in shadow in both, and in either: of the truth and the page's sunlight, and its sunlight without shadows."""
    assert truth.sunlight is not None
    level = unshadowed[..., 1]
    clear = (truth.coverage > 0.999) & (level > 0.05 * np.percentile(level[truth.coverage > 0.999], 90))
    first, second = (image[..., 1][clear] < 0.5 * level[clear] for image in (truth.sunlight, lit))
    return int((first & second).sum()), int((first | second).sum())


def sun_times_truth(place: ss.Place, points_m: np.ndarray, day: date) -> list[list[tuple[float, bool]]]:
    """Minutes after the local midnight at which the sun appears and disappears at points, by traced rays."""
    scene = ray_scene(mi_mesh(place.terrain, np.full((2, 2, 3), 0.3, np.float32)))
    points, found = surface_at(scene, points_m, search_m=1000.0)
    assert len(found) == len(points_m)
    samples = replace(
        points, **{name: np.repeat(getattr(points, name)[:, None], 64, axis=1) for name in points.__dataclass_fields__}
    )
    shape = samples.origin.shape[:2]
    rays = sun_rays(
        scene, samples.origin, samples.normal, samples.geometric_normal, np.ones(shape), np.zeros(shape[0], int)
    )
    start, receiver = _midnight(place, day), np.arange(shape[0])
    minutes = np.arange(0.0, 24 * 60)
    seen = np.zeros((len(minutes), shape[0]), bool)
    for k, minute in enumerate(minutes):
        sun = position_at(place, start + timedelta(minutes=float(minute))).sun
        if sun.elevation_deg < -1.0:
            continue
        lamp = Luminary(sun.direction, np.ones(3), sun.angular_radius_deg)
        visible, whole = sum_incidence(rays, lamp, receiver)
        seen[k] = (whole > 0.0) & (visible > 0.5 * whole)
    events = []
    for column in seen.T:
        change = np.flatnonzero(column[1:] != column[:-1])
        events.append([(float(minutes[k]) + 0.5, bool(column[k + 1])) for k in change])
    return events


def of_cells(points_m: np.ndarray, half_cell_m: float) -> np.ndarray:
    """Points ``(5 N, 3)``: each point, and those half a cell to its east, west, north and south."""
    off = half_cell_m * np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], float)
    return (points_m[:, None] + off).reshape(-1, 3)


def sun_times_errors(
    truth: list[list[tuple[float, bool]]], page: list[list[tuple[float, bool]]], around: int = 1
) -> np.ndarray:
    """Minutes from each event of the truth to the page's nearest of its kind; a missed one counts as an hour.

    ``truth`` has ``around`` points for each of ``page``, the first of them the clicked one; the error is what lies beyond
    the times of all of them.
    """
    errors = []
    for number, here in enumerate(page):
        points = truth[around * number : around * (number + 1)]
        for minute, rising in points[0]:
            own = [minute]
            for other in points[1:]:
                gaps = [(abs(minute - time), time) for time, kind in other if kind == rising]
                own += [time for gap, time in [min(gaps, default=(np.inf, 0.0))] if gap < 60.0]
            errors.append(
                min([60.0, *(max(min(own) - time, time - max(own), 0.0) for time, kind in here if kind == rising)])
            )
    return np.array(errors)


def page_sun_times(browser, place: ss.Place, points: np.ndarray, day: date) -> list[list[tuple[float, bool]]]:
    """As `sun_times_truth`, by the page."""
    start = _midnight(place, day).timestamp() * 1000.0
    script = """
      const [points, start] = arguments;
      return points.map((p) => seasonscapes.sunTimesBetween(p, start, start + 86400000).map((e) => [(e.time - start) / 60000, e.rising]));
    """
    return [
        [(minute, bool(rising)) for minute, rising in each]
        for each in browser.execute_script(script, points.tolist(), start)
    ]


def some_points(place: ss.Place, count: int, seed: int) -> np.ndarray:
    """Points on the terrain's surface ``(count, 3)``, a tenth of its extent away from its rim."""
    low, high = place.terrain.vertices[:, :2].min(axis=0), place.terrain.vertices[:, :2].max(axis=0)
    at = low + (high - low) * np.random.default_rng(seed).uniform(0.1, 0.9, (count, 2))
    position = np.column_stack([at, np.full(count, place.median_height_m)])
    assert place.terrain.surface is not None
    position[:, 2] = place.terrain.surface.up_at(position)
    return position


def pictures(browser, truths: list[Truth], size: tuple[int, int]) -> dict[str, Any]:
    """Compare the page with the truth: figures, and one line for each view."""
    large = [OVERSAMPLED * side for side in size]
    rows, sky_errors, both, either = [], [], 0, 0
    controls: dict[str, list[float]] = {name: [] for name in (*CONTROLS, "clock_one_hour_off")}
    beside: dict[str, list[float]] = {name: [] for name in controls}
    for truth in truths:
        stamp = truth.time.timestamp() * 1000.0
        where = {"camera": truth.camera, "time": stamp, "frames": FRAMES, "size": large}
        image = shrunk(radiance(browser, **where), OVERSAMPLED)
        psnr = truth.psnr_db(image)
        sky = truth.coverage == 0.0
        if sky.any():
            sky_errors.append(
                np.abs(image[sky] - truth.radiance[sky]).mean(axis=-1) / truth.radiance[sky].mean(axis=-1)
            )
        row = {"camera": truth.camera, "time_utc": truth.time.isoformat(), "psnr_db": psnr}
        if truth.sunlight is not None and float(truth.sunlight.max()) > 0.0:
            few = where | {"frames": 3, "sunOnly": True}
            lit = shrunk(radiance(browser, **few), OVERSAMPLED)
            unshadowed = shrunk(radiance(browser, **few, change={"shadows": 0}), OVERSAMPLED)
            inside, around = shadow_agreement(truth, lit, unshadowed)
            both, either = both + inside, either + around
            row["shadow_iou"] = inside / max(around, 1)
        for name, change in CONTROLS.items():
            controls[name].append(
                truth.psnr_db(shrunk(radiance(browser, **where | {"frames": 2}, **change), OVERSAMPLED))
            )
            beside[name].append(psnr)
        late = where | {"time": stamp + 3600e3, "frames": 2}
        controls["clock_one_hour_off"].append(truth.psnr_db(shrunk(radiance(browser, **late), OVERSAMPLED)))
        beside["clock_one_hour_off"].append(psnr)
        rows.append(row)
        print({key: round(value, 3) if isinstance(value, float) else value for key, value in row.items()}, flush=True)
    psnrs = np.array([row["psnr_db"] for row in rows])
    errors = np.concatenate(sky_errors)
    figures: dict[str, Any] = {
        "mean_psnr_db": psnrs.mean(),
        "worst_psnr_db": psnrs.min(),
        "truth_noise_worst_db": min(truth.noise_db for truth in truths),
        "shadow_iou": both / max(either, 1),
        "sky_error_median": np.median(errors),
        "sky_error_95": np.percentile(errors, 95.0),
    }
    for name, values in controls.items():
        figures[f"{name}_psnr_db"] = np.mean(values)
        figures[f"{name}_loss_db"] = np.mean(np.array(beside[name]) - values)
    return figures


STEPS = """
  const s = seasonscapes, r = s.renderer, start = s.state.time;
  s.state.paused = true;
  const began = performance.now();
  for (let k = 1; k <= arguments[0]; k++) { s.setTime(start + k * 300000, s.fine); r.luminances(); }
  return [(performance.now() - began) / 1000 / arguments[0], r.state.seenSide];
"""
TURNS = """
  const s = seasonscapes, r = s.renderer, passes = r.state.passes;
  const began = performance.now();
  for (let k = 0; k < arguments[0]; k++) { s.controls.look(2, 0); r.draw(s.controls.camera.height); r.readRadiance(); }
  return [(performance.now() - began) / 1000 / arguments[0], r.state.passes - passes];
"""


def timings(browser, address: str) -> dict[str, float]:
    """Seconds to the first picture of 512 x 512, of a step of the hour at 1,024 x 1,024 texels, and of an orbit.

    Processor seconds of all the browser's processes are measured too: what another program takes does not count there.
    """
    spent = [processor_s(browser)]
    first = open_page(browser, address + "?still&size=512x512", until="first")
    spent.append(processor_s(browser))
    open_page(browser, address + "?still&size=512x512")
    spent.append(processor_s(browser))
    hour, side = browser.execute_script(STEPS, 4)
    spent.append(processor_s(browser))
    orbit, passes = browser.execute_script(TURNS, 4)
    return {
        "first_picture_s": first,
        "first_picture_processor_s": spent[1] - spent[0],
        "hour_step_s": hour,
        "hour_step_processor_s": (spent[3] - spent[2]) / 4.0,
        "orbit_frame_s": orbit,
        "orbit_visibility_passes": passes,
        "visibility_texels": side,
    }


def faults_of(browser) -> list[str]:
    """Errors of the console and requests that failed, since the browser started."""
    return [entry["message"] for entry in browser.get_log("browser") if entry["level"] in ("SEVERE", "WARNING")]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--scene", default="alpine")
    parser.add_argument("--json", type=Path, default=None)
    options = parser.parse_args()
    reason = why_no_browser()
    if reason is not None:
        raise SystemExit(f"benchmarks/viewer.py: {reason}; nothing was measured")
    seed = secrets.randbelow(1 << 31) if options.seed is None else options.seed
    size = (160, 120) if options.quick else (384, 288)
    use_backend()
    start = time.perf_counter()
    place = ss.load_place(options.scene)
    scene = viewer_scene(place, sky=ss.sky_model("clear"))
    print(f"scene after {time.perf_counter() - start:.0f} s", flush=True)
    shown = min((picture.day for picture in scene.albedo), key=lambda day: abs((day - DAY).days))
    albedo = ss.scene_albedo(place, shown).values
    numbers = range(min(3, len(scene.about["cameras"])))
    views = [
        ss.Viewpoint(**{key: value for key, value in scene.about["cameras"][k].items() if key != "name"})
        for k in numbers
    ]
    cameras = {k: ss.camera(place, view, size_px=size) for k, view in zip(numbers, views, strict=True)}
    truths = truth_of(place, cameras, hours_of(place, shown), albedo, seed)
    print(f"truth after {time.perf_counter() - start:.0f} s", flush=True)
    points = some_points(place, 20, seed)
    whole = ss.load_place(options.scene, options=ss.MeshOptions(mesher="grid"))
    assert whole.terrain.surface is not None
    cells = of_cells(points, 0.5 * whole.terrain.surface.spacing_m)
    events = sun_times_truth(whole, cells, shown)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "page"
        files = write_folder(scene, folder, {"time": f"{shown.isoformat()}T14:00Z"})
        figures: dict[str, Any] = {"scene_mb": sum(files.values()) / 1e6}
        with served(folder) as address, chromium() as browser:
            figures |= timings(browser, address)
            prepare(browser)
            figures |= pictures(browser, truths, size)
            told = page_sun_times(browser, place, points, shown)
            strict, errors = sun_times_errors(events[::5], told), sun_times_errors(events, told, 5)
            figures["sun_times_error_min"] = float(errors.max())
            figures["sun_times_strict_median_min"] = float(np.median(strict))
            figures["sun_times_strict_share_within_2_min"] = float(np.mean(strict <= 2.0))
            figures["sun_times_strict_max_min"] = float(strict.max())
            figures["sun_times_events"] = len(errors)
            faults = faults_of(browser)
            figures["console_faults"] = len(faults)
    for line in faults:
        print(line)
    for name, value in figures.items():
        print(f"{name}: {value:.4g}")
    write_record(options.json, figures, seed=seed)


if __name__ == "__main__":
    main()
