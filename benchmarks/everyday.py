"""Everyday commands as a user types them: processor time and wall time of whole commands, cold and warm.

Every command runs as a process of its own (``python -m seasonscapes``), in a workspace of this run. *Cold* is the first
command of its kind in an empty workspace, *warm* the next one with another hour. Compiled kernels of Dr.Jit stay in the
user's cache from run to run, hashes of modules too, and compiled modules beside them, as they do for a user. Keys that end
in ``_s`` are processor seconds of all threads, those of ``demo_…`` wall seconds; ``…_wall_s`` stand beside them.

    python benchmarks/everyday.py            # all, an hourly year of one view whole: an hour
    python benchmarks/everyday.py --quick    # the year from the hours of four days: some ten minutes
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path

from record import ROOT, write_record

DAY = "2024-09-18"
VIEW = ("alpine", "--size", "768x512")
_TABLES = """
from seasonscapes.sky.models import atmosphere_from_model, read_sky_model
from seasonscapes.sky.shipped_tables import shipped_tables
assert shipped_tables(atmosphere_from_model(read_sky_model("clear"))) is not None
"""
_OWN_TABLES = """
from seasonscapes.sky.models import atmosphere_from_model, read_sky_model, with_overrides
from seasonscapes.sky.scattering import atmosphere_tables
atmosphere_tables(atmosphere_from_model(with_overrides(read_sky_model("clear"), visibility_km=40.0)))
"""
_NOTHING = """
from seasonscapes.sky.models import atmosphere_from_model, read_sky_model
import seasonscapes.sky.shipped_tables
atmosphere_from_model(read_sky_model("clear"))
"""


_ALBEDO = """
import seasonscapes as ss
from seasonscapes.terrain.surface import save_texture
from seasonscapes.workflows.albedo_sources import scene_albedo
save_texture(scene_albedo(ss.load_place("alpine"), "{day}"), {path!r})
"""
# The sky's tables by elevation that all hours of a year need, as a film makes them before its frames.
_SKY_OF_THE_YEAR = """
from datetime import UTC, datetime, timedelta
import seasonscapes as ss
from seasonscapes.workflows.illumination import tabulate_illumination
place = ss.load_place({place!r})
times = [datetime(2024, 1, 1, tzinfo=UTC) + timedelta(hours=hour) for hour in range(366 * 24)]
tabulate_illumination(place, ss.camera(place), ss.sky_model(), times)
"""
_WORKERS = 2


@dataclass(frozen=True)
class Cost:
    """Time of a process and its children.

    Parameters
    ----------
    processor_s, wall_s
        Processor time of all threads, and time that passed [s].
    first_file_s
        When the first of the expected files stood there [s]; ``None`` if none was expected.
    """

    processor_s: float
    wall_s: float
    first_file_s: float | None = None


class Bench:
    """Commands in one temporary folder."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def seasonscapes(self, *arguments: str, workspace: str, awaited: Path | None = None) -> Cost:
        """Cost of a command with a workspace of that name."""
        environment = os.environ | {"SEASONSCAPES_WORKSPACE": str(self.folder / workspace)}
        return self._cost([sys.executable, "-m", "seasonscapes", *arguments], environment, awaited)

    def python(self, code: str, *, workspace: str = "code") -> Cost:
        """Cost of a piece of code with a workspace of that name."""
        environment = os.environ | {"SEASONSCAPES_WORKSPACE": str(self.folder / workspace)}
        return self._cost([sys.executable, "-c", code], environment, None)

    def _cost(self, command: list[str], environment: dict[str, str], awaited: Path | None) -> Cost:
        # As for a user, whose interpreter keeps compiled modules.
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        first = None
        with open(self.folder / "log.txt", "wb") as log:
            process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=log, stderr=log)
            while process.poll() is None:
                if awaited is not None and first is None and awaited.exists():
                    first = time.perf_counter() - start
                time.sleep(0.02)
        wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        if process.returncode:
            text = (self.folder / "log.txt").read_text(errors="replace")
            raise SystemExit(f"{' '.join(command)} exited {process.returncode}:\n{text}")
        used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        print(f"{used:8.1f} s processor {wall:8.1f} s wall   {' '.join(command[1:])[:110]}", flush=True)
        return Cost(used, wall, first)


def sky(bench: Bench) -> dict[str, float]:
    """``sky`` for one instant, and the atmosphere tables of its first call: shipped, and of a haze of one's own."""
    command = ("sky", "--at", "46.55,7.98,2000", "--time", f"{DAY}T12:00Z")
    cold, warm = (bench.seasonscapes(*command, workspace="sky") for _ in range(2))
    tables, own, imports = (bench.python(code) for code in (_TABLES, _OWN_TABLES, _NOTHING))
    return {
        "sky_cold_s": cold.processor_s,
        "sky_warm_s": warm.processor_s,
        "sky_warm_wall_s": warm.wall_s,
        "tables_cold_s": tables.processor_s - imports.processor_s,
        "own_tables_cold_s": own.processor_s - imports.processor_s,
    }


def render(bench: Bench) -> dict[str, float]:
    """``render`` of one view: first, with another hour, and by path tracing."""
    output = str(bench.folder / "view.png")
    hours = ("19:05", "18:05", "13:20")
    engines: tuple[tuple[str, ...], ...] = ((), (), ("--engine", "path"))
    cold, warm, path = (
        bench.seasonscapes("render", *VIEW, "--time", f"{DAY}T{hour}", *more, "-o", output, workspace="render")
        for hour, more in zip(hours, engines, strict=True)
    )
    return {
        "render_cold_s": cold.processor_s,
        "render_cold_wall_s": cold.wall_s,
        "render_warm_s": warm.processor_s,
        "render_warm_wall_s": warm.wall_s,
        "render_path_warm_s": path.processor_s,
    }


def film(bench: Bench, *, whole: bool) -> dict[str, float]:
    """A first film of two frames in an empty workspace, and all hours of a year with two dated albedos, on two workers."""
    albedos = _dated_albedos(bench)

    def frames(times: list[datetime], name: str, *more: str) -> Cost:
        listed = bench.folder / f"{name}.txt"
        listed.write_text("\n".join(f"{time:%Y-%m-%dT%H:%MZ}" for time in times) + "\n")
        output = str(bench.folder / f"{name}.mp4")
        return bench.seasonscapes("timelapse", *VIEW, "--times", str(listed), *more, "-o", output, workspace="film")

    ready = frames([datetime(2024, 9, 18, 8), datetime(2024, 9, 18, 9)], "first")
    year = [datetime(2024, 1, 1) + timedelta(hours=hour) for hour in range(366 * 24)]
    workers = ("--cluster", f"local:{_WORKERS}")
    # A day is a day of every season: nights, and elevations of the sun that the sky has no tables for yet.
    days = [time for time in year if time.timetuple().tm_yday % 92 == 20]
    first = frames([year[0], year[-1]], "prepared", *albedos)
    # Apart, since they are made once: their cost does not grow with the frames.
    sky = bench.python(_SKY_OF_THE_YEAR.format(place=VIEW[0]), workspace="film")
    counted = year if whole else days
    film = frames(counted, "year", *albedos, *workers)
    # What an hour costs beside what a film of two does.
    again = frames([year[2], year[-3]], "again", *albedos, *workers)
    by_two_workers_s = (film.wall_s - again.wall_s) / (len(counted) - 2)
    minutes = (first.wall_s + sky.wall_s + film.wall_s + by_two_workers_s * (len(year) - len(counted))) / 60.0
    some = frames([time + timedelta(minutes=30) for time in days], "some", *albedos)
    pair = frames([year[1], year[-2]], "pair", *albedos)
    return {
        "film_ready_s": ready.processor_s,
        "film_ready_wall_s": ready.wall_s,
        "year_ready_s": first.processor_s,
        "frame_s": (some.processor_s - pair.processor_s) / (len(days) - 2),
        "frame_wall_s": (some.wall_s - pair.wall_s) / (len(days) - 2),
        "frame_two_workers_wall_s": by_two_workers_s,
        "frame_two_workers_s": (film.processor_s - again.processor_s) / (len(counted) - 2),
        "year_sky_wall_s": sky.wall_s,
        "year_minutes": minutes,
        "year_frames_measured": len(counted),
        "year_frames": len(year),
    }


def _dated_albedos(bench: Bench) -> tuple[str, ...]:
    """Flags that name albedos of a winter and of a summer day, written to files."""
    flags = []
    for day in ("2024-02-01", "2024-08-01"):
        path = bench.folder / f"{day}.npz"
        bench.python(_ALBEDO.format(day=day, path=str(path)), workspace="albedos")
        flags += ["--albedo", f"{day}={path}"]
    return tuple(flags)


def demo(bench: Bench) -> dict[str, float]:
    """``demo`` in an empty workspace."""
    folder = bench.folder / "demo"
    cost = bench.seasonscapes("demo", "-o", str(folder), workspace="demo", awaited=folder / "lake.png")
    assert cost.first_file_s is not None
    return {
        "demo_first_picture_s": cost.first_file_s,
        "demo_total_s": cost.wall_s,
        "demo_processor_s": cost.processor_s,
    }


def irradiance(bench: Bench) -> dict[str, float]:
    """The irradiance of 12 × 12 km at 30 m for one instant, with the terrain built before."""
    bench.seasonscapes("terrain", "alpine", workspace="map")
    output = str(bench.folder / "map.tif")
    command = ("irradiance", "alpine", "--spacing-m", "30", "-o", output)
    cold = bench.seasonscapes(*command, "--time", f"{DAY}T10:00", workspace="map")
    warm = bench.seasonscapes(*command, "--time", f"{DAY}T11:00", workspace="map")
    return {"irradiance_cold_s": cold.processor_s, "irradiance_s": warm.processor_s, "irradiance_wall_s": warm.wall_s}


PARTS: dict[str, Callable[[Bench, bool], dict[str, float]]] = {
    "sky": lambda bench, quick: sky(bench),
    "render": lambda bench, quick: render(bench),
    "film": lambda bench, quick: film(bench, whole=not quick),
    "demo": lambda bench, quick: demo(bench),
    "irradiance": lambda bench, quick: irradiance(bench),
}


def main() -> None:
    """Run the parts and print their figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="estimate the year from the hours of four days")
    parser.add_argument("--only", choices=PARTS, action="append", help="a part alone; may be repeated")
    parser.add_argument("--json", type=Path, help="write the numbers to a file")
    arguments = parser.parse_args()
    figures: dict[str, float] = {"load": os.getloadavg()[0]}
    with tempfile.TemporaryDirectory(prefix="everyday-") as folder:
        for name in arguments.only or PARTS:
            figures |= PARTS[name](Bench(Path(folder)), arguments.quick)
    print(json.dumps(figures, indent=2))
    write_record(arguments.json, figures, seed=None)


if __name__ == "__main__":
    main()
