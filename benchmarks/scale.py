"""What work costs per triangle, texel, receiver, frame and worker, and what an arc of mountains would take.

Costs are measured on the embedded massif (144 km²), each stage alone, as processor time of all threads and as bytes on disk.
Terrain, albedo and daylight coefficients grow in proportion to triangles, texels and receivers, and a tile of the arc is as
large as the massif: the arc is their sum over its tiles. That nothing else grows with the number of tiles is what the second
part exercises: 10,000 tiny frames go through Dask's scheduler to 8 local workers, some of which are killed while they work.

    python benchmarks/scale.py            # 10,000 frames, 20 workers killed: some ten minutes
    python benchmarks/scale.py --only scheduling
    python benchmarks/scale.py --quick    # 1,000 frames, 4 workers killed
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from record import write_record

import seasonscapes as ss
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.cluster import connected, run_by
from seasonscapes.relighting.frame_file import load_frame, save_frame
from seasonscapes.workspace import Workspace

WORKERS = 8
ARC_KM2, MAP_SPACING_M = 200_000.0, 30.0
DAYLIGHT_HOURS = 4400.0
_NOON = datetime(2024, 6, 21, 11, tzinfo=UTC)
_VIEW = (768, 512)
# How long workers stand by while their idle cost is measured.
_WAIT_S = 5.0


@dataclass(frozen=True)
class TinyFrame:
    """A frame of 4 × 4 pixels that a worker writes.

    Parameters
    ----------
    number
        Which one; its pixels hold this number.
    folder
        Where the frame belongs.
    deadly
        Whether the first worker that takes it dies.
    """

    number: int
    folder: Path
    deadly: bool


def write_tiny_frame(frame: TinyFrame) -> dict:
    """Write a frame as a film's worker does; a deadly one kills its first worker before anything is written."""
    mark = frame.folder / f"killed-{frame.number:05d}"
    if frame.deadly and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    radiance = np.full((4, 4, 3), frame.number, np.float32)
    save_frame(frame.folder / f"{frame.number:05d}.exr", radiance, metered_ev100=12.0, provenance={})
    return {"number": frame.number}


def scheduling(count: int, killed: int, seed: int) -> dict[str, float]:
    """Frames that arrive and their cost, first on workers that live and then on workers that are killed.

    Overhead is what a frame costs beside its writing: processor time of scheduler, client and workers together, less that
    of writing frames in a loop in one of the workers. What workers cost while they stand by is in it, and told apart too, as is
    their start.
    """
    chosen = set(np.random.default_rng(seed).choice(count, killed, replace=False).tolist())
    lost, walls, used, idle_share, alone_s = 0, {}, {}, 0.0, 0.0
    for name, deadly in (("calm", set()), ("killed", chosen)):
        with tempfile.TemporaryDirectory(prefix="scale-") as text, connected(f"local:{WORKERS}") as client:
            folder = Path(text)
            # Libraries are imported, and each worker's first frame written, before anything is measured.
            client.run(write_tiny_frame, TinyFrame(count, folder, deadly=False))
            worker_start_s = sum(client.run(time.process_time).values()) / WORKERS
            before, start = _processor_of_all(client), time.perf_counter()
            time.sleep(_WAIT_S)
            waited, idle_s = time.perf_counter() - start, sum(_processor_of_all(client).values()) - sum(before.values())
            before, start = _processor_of_all(client), time.perf_counter()
            frames = (TinyFrame(number, folder, number in deadly) for number in range(count))
            told = [record["number"] for record in run_by(client, write_tiny_frame, frames)]
            walls[name] = time.perf_counter() - start
            if not deadly:  # workers that are killed take their times with them
                used = {key: value - before[key] for key, value in _processor_of_all(client).items()}
                idle_share = idle_s / waited
            whole = sum(_is_whole(folder / f"{number:05d}.exr", number) for number in range(count))
            lost = max(lost, count - min(whole, len(set(told))))
            if not deadly:
                alone_s = client.submit(_alone_s, folder, count // 10).result()
            marks = len(list(folder.glob("killed-*")))
            print(f"{name}: {count} frames, {whole} whole, {marks} workers killed, {walls[name]:.1f} s", flush=True)
    return {
        "frames": count,
        "frames_lost": lost,
        "workers_killed": killed,
        "worker_start_processor_s": worker_start_s,
        "tiny_frame_ms": 1e3 * alone_s,
        "scheduler_ms_per_frame": 1e3 * used["scheduler"] / count,
        "overhead_ms_per_frame": 1e3 * (sum(used.values()) / count - alone_s),
        "idle_share_of_core_per_worker": idle_share / WORKERS,
        "wall_ms_per_frame": 1e3 * walls["calm"] / count,
        "s_per_killed_worker": max(walls["killed"] - walls["calm"], 0.0) / killed,
    }


def _alone_s(folder: Path, count: int) -> float:
    """Processor time per frame [s] of writing frames one after another, in a process that has written some before."""
    started = time.process_time()
    for number in range(count):
        write_tiny_frame(TinyFrame(number, folder, deadly=False))
    return (time.process_time() - started) / count


def _processor_of_all(client: Any) -> dict[str, float]:
    """Processor time of this process, which holds scheduler and client, and of all workers [s]."""
    return {"scheduler": time.process_time(), "workers": sum(client.run(time.process_time).values())}


def _is_whole(path: Path, number: int) -> bool:
    return path.is_file() and abs(float(load_frame(path)[0].mean()) - number) <= 1e-3 * max(number, 1)


def processor_s(work: Callable[[], object]) -> float:
    """Processor time of all threads of a piece of work [s]."""
    before = resource.getrusage(resource.RUSAGE_SELF)
    work()
    after = resource.getrusage(resource.RUSAGE_SELF)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def _bytes(folder: Path, pattern: str) -> int:
    return sum(path.stat().st_size for path in folder.rglob(pattern) if path.is_file())


def costs(scene: str) -> dict[str, float]:
    """Processor time and bytes per triangle, texel, receiver, pixel and frame."""
    from seasonscapes.workflows.relight_session import relight, relight_session

    with tempfile.TemporaryDirectory(prefix="scale-") as text:
        workspace = Workspace(Path(text))
        # Kernels are compiled and libraries imported before anything is measured.
        small = ss.load_place("alpine_small", workspace)
        ss.irradiance_map(small, _NOON, sky="hosek", spacing_m=200.0, rays=16)
        ss.relight_session(small, _camera(small, (24, 16)), sky="hosek")
        place, figures = None, {}

        def load() -> None:
            nonlocal place
            place = ss.load_place(scene, workspace)

        heights_and_terrain = processor_s(load)
        assert place is not None
        triangles, texels = len(place.terrain.faces), place.atlas.width_px * place.atlas.height_px
        albedo_s = processor_s(partial(ss.scene_albedo, place, _NOON.date()))
        figures |= {
            "terrain_us_per_triangle": 1e6 * heights_and_terrain / triangles,
            "albedo_us_per_texel": 1e6 * albedo_s / texels,
            "terrain_bytes_per_triangle": _bytes(Path(text) / scene, "terrain*") / triangles,
            "albedo_bytes_per_texel": _bytes(Path(text) / scene, "albedo*") / texels,
        }
        hours = [_NOON + timedelta(minutes=20 * k) for k in range(7)]
        # The first map traces coefficients and keeps them; further ones load them.
        first, one = (
            processor_s(partial(ss.irradiance_map, place, hours[0], spacing_m=MAP_SPACING_M)) for _ in range(2)
        )
        seven = processor_s(partial(ss.irradiance_map, place, hours, spacing_m=MAP_SPACING_M))
        receivers = (144e6 if scene == "alpine" else 9e6) / MAP_SPACING_M**2
        each = max(seven - one, 0.0) / (len(hours) - 1)
        figures |= {
            "map_us_per_receiver": 1e6 * max(first - one, 0.0) / receivers,
            "map_bytes_per_receiver": _bytes(Path(text) / scene, "coefficients*/*") / receivers,
            "map_us_per_receiver_and_hour": 1e6 * each / receivers,
        }
        camera = _camera(place, _VIEW)
        session = None

        def trace() -> None:
            nonlocal session
            session = relight_session(place, camera)

        maps = _bytes(Path(text) / scene, "coefficients*/*")
        traced = processor_s(trace)
        assert session is not None
        shown = len(session.coefficients.pixel)
        relight(session, hours[0])
        frame = processor_s(lambda: [relight(session, hour) for hour in hours[1:]]) / (len(hours) - 1)
        figures |= {
            "view_us_per_pixel": 1e6 * traced / shown,
            "view_bytes_per_pixel": (_bytes(Path(text) / scene, "coefficients*/*") - maps) / shown,
            "frame_us_per_pixel": 1e6 * frame / (_VIEW[0] * _VIEW[1]),
        }
    peak_gb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    return figures | {"peak_gb": peak_gb, "triangles": triangles, "texels": texels, "receivers": receivers}


def _camera(place: ss.Place, size_px: tuple[int, int]) -> Camera:
    camera = ss.camera(place, "aerial", size_px=size_px)
    assert isinstance(camera, Camera)
    return camera


def arc(figures: dict[str, float], tile_km2: float) -> dict[str, float]:
    """An alpine arc by the measured costs: maps of irradiance for each hour of daylight of a year."""
    tiles = ARC_KM2 / tile_km2
    receivers = ARC_KM2 * 1e6 / MAP_SPACING_M**2
    once_s = tiles * (
        figures["terrain_us_per_triangle"] * figures["triangles"] + figures["albedo_us_per_texel"] * figures["texels"]
    )
    once_s += figures["map_us_per_receiver"] * receivers
    hours_s = figures["map_us_per_receiver_and_hour"] * receivers * DAYLIGHT_HOURS
    return {
        "arc_once_core_hours": once_s / 1e6 / 3600.0,
        "arc_year_core_hours": hours_s / 1e6 / 3600.0,
        "arc_days_on_100_workers": (once_s + hours_s) / 1e6 / 86400.0 / 100.0,
        # float32, the five bands of a map of one hour
        "arc_year_tb": receivers * DAYLIGHT_HOURS * 5 * 4 / 1e12,
    }


def main() -> None:
    """Measure the costs, extrapolate to the arc, exercise the scheduler."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="1,000 frames in place of 10,000")
    parser.add_argument("--seed", type=int, default=11, help="which frames kill their workers")
    parser.add_argument("--only", choices=("costs", "scheduling"), help="one part alone")
    parser.add_argument("--json", type=Path, help="write the figures to a file")
    arguments = parser.parse_args()
    count, killed = (1_000, 4) if arguments.quick else (10_000, 20)
    figures: dict[str, float] = {}
    if arguments.only != "scheduling":
        figures |= costs("alpine")
        print(json.dumps(figures, indent=1), flush=True)
        figures |= arc(figures, 144.0)
    if arguments.only != "costs":
        figures |= scheduling(count, killed, arguments.seed)
    print(json.dumps(figures, indent=1))
    write_record(arguments.json, figures, seed=arguments.seed)
    if figures.get("frames_lost"):
        sys.exit("frames were lost")


if __name__ == "__main__":
    main()
