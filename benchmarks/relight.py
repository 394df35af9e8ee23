"""Relighting from daylight coefficients against path tracing every frame anew: error, time, break-even, a year.

    python benchmarks/relight.py [--quick] [--seed N] [--json FILE] [--bpy-python PATH] [--pictures FOLDER] [--only PART]

* Equal error: in blocks of pixels drawn all over a view of the synthetic massif, a converged path tracing of the same
  light and bounces is the reference (4,096 samples a pixel or more). The coefficients' error against it is their relRMSE
  (root of the mean squared difference over the mean); a path tracer's is its noise, which falls with the root of its
  samples. How many samples it would need for the coefficients' error, times what its samples cost, is its time.
  Light, camera, bounces and pixel filter are those of `render.py`; contestants take turns.
* Sun visibility against an own march over the raster (`SunMarch`: geodetic heights sampled along the ray, no mesh and no
  ray tracer in it), away from shadow edges.
* Throughput of sun rays against bare `ray_test` of the same rays.
* A year: frames of the embedded scene at hours spread over a whole year, sky, seasons, files and film included, by the
  verb's own functions; the time of all its hours with light follows from their mean.
* Memory: a view of 1536 × 1024 with Reinhart's 577 patches, traced and lit in a process of its own.
"""

from __future__ import annotations

import argparse
import os
import resource
import secrets
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
import render as arena  # noqa: E402  (the contest's scene and rivals)
from record import write_record  # noqa: E402

BLOCK = 16


# ------------------------------------------------------------------------------------------- equal error


def blocks_of(camera, rng: np.random.Generator, count: int) -> list[tuple[int, int]]:
    """Upper left corners of blocks in the lower two thirds of the picture, where terrain is."""
    rows = rng.integers(camera.height_px // 3, camera.height_px - BLOCK, count)
    columns = rng.integers(0, camera.width_px - BLOCK, count)
    return list(zip(rows.tolist(), columns.tolist(), strict=True))


def block_camera(camera, corner: tuple[int, int]):
    """The camera of one block alone."""
    return replace(camera, width_px=BLOCK, height_px=BLOCK, cx=camera.cx - corner[1], cy=camera.cy - corner[0])


def cut(image: np.ndarray, corners: list) -> np.ndarray:
    """The blocks' pixels of a whole picture, one after the other."""
    return np.concatenate(
        [image[y : y + BLOCK, x : x + BLOCK].reshape(BLOCK * BLOCK, *image.shape[2:]) for y, x in corners]
    )


def reference_of(scene, camera, corners: list, spp: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two independent converged pictures of the blocks and the share of each pixel that is terrain."""
    from seasonscapes.rendering.radiance import path_trace

    halves = [[], []]
    cover = []
    for corner in corners:
        for half in range(2):
            image, coverage = path_trace(
                scene, block_camera(camera, corner), spp=spp // 2, seed=seed + half, max_depth=arena.MAX_DEPTH
            )[:2]
            halves[half].append(image.reshape(-1, 3))
        cover.append(coverage.reshape(-1))
    return np.concatenate(halves[0]), np.concatenate(halves[1]), np.concatenate(cover)


def rel_rmse(image: np.ndarray, reference: np.ndarray, mask: np.ndarray) -> float:
    """Root of the mean squared difference over the mean of the reference."""
    difference = (image - reference)[mask].astype(np.float64)
    return float(np.sqrt((difference**2).mean()) / reference[mask].mean())


def coefficients_of(scene, camera, seed: int):
    """Our view, ready, and what making it took."""
    from seasonscapes.rendering.coefficients import SamplingOptions
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.relit_view import relightable_view
    from seasonscapes.rendering.transport import trace_view

    start, start_cpu = time.perf_counter(), time.process_time()
    terrain = ray_scene(scene.mi_terrain)
    ready = relightable_view(terrain, trace_view(terrain, camera, SamplingOptions(), seed=seed))
    return terrain, ready, {"seconds": time.perf_counter() - start, "cpu_seconds": time.process_time() - start_cpu}


def equal_error(folder: Path, arguments: argparse.Namespace, seed: int) -> dict[str, float]:
    """The contest."""
    from seasonscapes.rendering.relit_view import relight_view, sun_cosine

    width_px, spp, rounds, blocks, reference_spp = (384, 16, 3, 16, 4096) if arguments.quick else (768, 16, 4, 32, 8192)
    scene, camera, facts = arena.make_scene(seed, folder, width_px=width_px, threads=arguments.threads)
    terrain, ready, cost = coefficients_of(scene, camera, seed % 2**30)
    print(f"coefficients: {cost['seconds']:.1f} s, {cost['cpu_seconds']:.1f} s of CPU", flush=True)
    light = scene.illumination
    renders = {
        "coefficients": lambda spp, seed: arena.timed(lambda: relight_view(ready, light).radiance),
        "path (ours)": arena.ours(scene, camera),
        "mitsuba": arena.bare(folder, "directional"),
    }
    cycles = arena.Cycles(arguments.bpy_python, folder) if arguments.bpy_python else None
    if cycles is not None:
        renders["cycles"] = cycles
    results = arena.contest(renders, spp=spp, rounds=rounds, seed=seed % 2**30)
    if cycles is not None:
        cycles.close()
    corners = blocks_of(camera, np.random.default_rng(seed), blocks)
    first, second, cover = reference_of(scene, camera, corners, reference_spp, seed % 2**29)
    truth, land = 0.5 * (first + second), cover == 1.0
    # The reference's own noise, from its halves; its median relative error per pixel.
    noise = 0.5 * np.sqrt(((first - second)[land] ** 2).mean()) / truth[land].mean()
    median = 0.5 * np.median(np.abs(first - second)[land].mean(axis=-1) / truth[land].mean(axis=-1))
    seen = np.zeros(camera.width_px * camera.height_px, np.float32)
    facing = np.maximum(ready.coefficients.normal @ light.sun.direction.astype(np.float32), 1e-3)
    seen[ready.coefficients.pixel] = sun_cosine(ready, light.sun) / facing
    seen = cut(seen.reshape(camera.height_px, camera.width_px), corners)
    lit, shadow = land & (seen > 0.9), land & (seen < 0.02)
    mine = cut(results["coefficients"]["images"][0], corners)
    record = {
        "triangles": facts["triangles"],
        "width_px": width_px,
        "reference_spp": reference_spp,
        "reference_noise": float(noise),
        "reference_median_error": float(median),
        "pixels_lit": int(lit.sum()),
        "pixels_shadow": int(shadow.sum()),
        "rel_rmse": rel_rmse(mine, truth, land),
        "rel_rmse_lit": rel_rmse(mine, truth, lit),
        "rel_rmse_shadow": rel_rmse(mine, truth, shadow),
        "mean_difference": float(mine[land].mean() / truth[land].mean() - 1.0),
        "precompute_s": cost["seconds"],
        "precompute_cpu_s": cost["cpu_seconds"],
        "frame_s": float(np.median(results["coefficients"]["seconds"])),
        "frame_cpu_s": float(np.median(results["coefficients"]["cpu_seconds"])),
    }
    # Only what the coefficients add counts: the reference's noise is in the difference too.
    goal = np.sqrt(max(record["rel_rmse"] ** 2 - noise**2, 1e-12))
    for name, key in (("path (ours)", "own_path"), ("mitsuba", "path"), ("cycles", "cycles")):
        if name in results:
            record |= _rival(
                results[name],
                [cut(image, corners) for image in results[name]["images"]],
                land,
                spp,
                {"goal": goal, "key": key, **record},
            )
    record |= sun_ray_throughput(terrain, ready, light)
    if arguments.pictures:
        save_pictures(arguments.pictures, results)
    return record


def _rival(result: dict, images: list[np.ndarray], land: np.ndarray, spp: int, ours: dict) -> dict[str, float]:
    """Samples and seconds that a path tracer needs for an error, by its noise and its cost beyond a call's own."""
    key = ours["key"]
    variance = arena.noise_variance(images, land)
    samples = variance * spp / ours["goal"] ** 2
    record = {f"noise_{key}_{spp}spp": float(np.sqrt(variance)), f"samples_{key}": float(samples)}
    for unit, prefix in (("seconds", ""), ("cpu_seconds", "cpu_")):
        each = (float(np.median(result[unit])) - result[f"{unit}_1spp"]) / (spp - 1)
        needed = result[f"{unit}_1spp"] + each * max(samples - 1.0, 0.0)
        mine = ours["frame_s"] if unit == "seconds" else ours["frame_cpu_s"]
        record[f"{prefix}seconds_{key}"] = needed
        record[f"{prefix}speedup_vs_{key}"] = needed / mine
        if unit == "cpu_seconds":
            record[f"break_even_frames_vs_{key}"] = ours["precompute_cpu_s"] / max(needed - mine, 1e-9)
    return record


def sun_ray_throughput(terrain, ready, light) -> dict[str, float]:
    """Our shadow rays, cosines, penumbra and sums included, over bare `ray_test` of as many rays of the same places."""
    import drjit as dr
    import mitsuba as mi

    from seasonscapes.rendering.sun_visibility import sum_incidence

    every = np.arange(ready.rays.receivers)
    sun = mi.Vector3f(*(dr.opaque(mi.Float, float(x)) for x in light.sun.direction))
    shown = np.array(ready.rays.mi_weight).astype(np.float32) > 0.0
    origin = np.stack([np.array(axis) for axis in ready.rays.mi_origin], axis=-1)[shown]
    normal = np.stack([np.array(column) for column in ready.rays.mi_geometric_normal], axis=-1)[shown].astype(
        np.float32
    )
    facing = origin[normal @ light.sun.direction.astype(np.float32) > 0.0]
    step = 1 << 22
    parts = [mi.Point3f(np.ascontiguousarray(facing[i : i + step].T)) for i in range(0, len(facing), step)]

    def bare() -> None:
        for part in parts:
            dr.eval(terrain.mi_scene.ray_test(mi.Ray3f(part, sun)))
        dr.sync_thread()

    times: dict[str, list] = {"ours": [], "bare": []}
    for turn in range(6):
        for name, call in (("ours", lambda: sum_incidence(ready.rays, light.sun, every)), ("bare", bare)):
            start = time.process_time()
            call()
            if turn:
                times[name].append(time.process_time() - start)
    ratio = float(np.median(np.array(times["bare"]) / np.array(times["ours"])))
    return {"sun_rays": len(facing), "sun_ray_throughput_vs_bare": ratio}


def save_pictures(folder: Path, results: dict) -> None:
    """Coefficients and one picture of each rival side by side."""
    from seasonscapes.exposure import develop, exposure_ev100
    from seasonscapes.images import write_png

    images = [result["images"][0] for result in results.values()]
    ev100 = exposure_ev100(images[0])
    write_png(folder / "relight.png", np.hstack([develop(image, ev100) for image in images]))


# ------------------------------------------------------------------------------------------- sun visibility


class SunMarch:
    """Is the sun behind the land? Heights along the ray, read from the raster by geodetic position."""

    def __init__(self, place):
        self.place = place
        self.top_m = float(place.elevation.values.max())

    def clearance_deg(self, position: np.ndarray, direction: np.ndarray, step_m: float, reach_m: float) -> np.ndarray:
        """Least angle ``(N,)`` between the ray and the land ahead, negative where land is in the way."""
        from seasonscapes.frames import geodetic_from_enu
        from seasonscapes.terrain.crs import map_from_geodetic
        from seasonscapes.terrain.raster import sample_raster

        raster = self.place.elevation
        least = np.full(len(position), 90.0)
        for distance in np.arange(step_m, reach_m, step_m):
            latitude, longitude, height = geodetic_from_enu(self.place.frame, position + distance * direction)
            ground = sample_raster(raster, *map_from_geodetic(raster.crs, latitude, longitude))[..., 0]
            angle = np.degrees(np.arctan2(height - ground, distance))
            least = np.minimum(least, np.where(np.isfinite(ground), angle, 90.0))
            if (height > self.top_m).all():
                break
        return least


def visibility_agreement(seed: int, count: int) -> dict[str, float]:
    """Share of places and suns on which our shadow rays and the march agree, away from shadow edges."""
    from seasonscapes.frames import direction_from_angles, enu_from_geodetic
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.irradiance import surface_at
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.rendering.sun_visibility import hashed_disc_offset, sun_rays, visible_cosine
    from seasonscapes.sky.illumination import Luminary
    from seasonscapes.terrain.raster import geodetic_from_map
    from seasonscapes.workflows.place import MeshOptions, find_scene, load_place
    from seasonscapes.workspace import default_workspace

    place = load_place(find_scene("alpine"), default_workspace(), options=MeshOptions(mesher="grid", refine=1))
    rng = np.random.default_rng(seed)
    height, width = place.elevation.values.shape[:2]
    # At the raster's own samples mesh and raster have the same height.
    row, column = rng.integers(20, height - 20, count), rng.integers(20, width - 20, count)
    x, y = place.elevation.transform * (column + 0.5, row + 0.5)
    latitude, longitude = geodetic_from_map(place.elevation.crs, x, y)
    ground = enu_from_geodetic(place.frame, latitude, longitude, place.elevation.values[row, column, 0])
    terrain = ray_scene(mi_mesh(place.terrain, np.full(3, 0.3)))
    points, found = surface_at(terrain, ground, search_m=5.0)
    march, agree, clear = SunMarch(place), 0, 0
    for _ in range(8):
        direction = direction_from_angles(rng.uniform(0, 360), rng.uniform(2.0, 60.0))
        sun = Luminary(direction, np.full(3, 1e5), 0.001)
        each = points.reshape(-1, 1)
        rays = sun_rays(
            terrain,
            each.origin,
            each.normal,
            each.geometric_normal,
            np.ones((len(found), 1), np.float32),
            hashed_disc_offset(found),
        )
        seen = visible_cosine(rays, sun)[:, 0] > 0.0
        # Only places that face the sun: on the others there is nothing to ask.
        facing = np.minimum(points.geometric_normal @ direction, points.normal @ direction) > 0.1
        margin = march.clearance_deg(points.origin.astype(float), direction, 5.0, 12000.0)
        sure = facing & (np.abs(margin) > 0.5)
        agree += int((seen == (margin > 0.0))[sure].sum())
        clear += int(sure.sum())
    return {"visibility_samples": clear, "visibility_agreement": agree / clear}


# ------------------------------------------------------------------------------------------- a year, and memory


def a_year(frames: int, width_px: int) -> dict[str, float]:
    """Seconds of a year's film of the embedded scene, from frames spread over all its hours."""
    from seasonscapes.relighting.film import write_video
    from seasonscapes.scene import read_scene
    from seasonscapes.sky.models import read_sky_model
    from seasonscapes.terrain.surface import save_texture
    from seasonscapes.workflows.albedo_sources import AlbedoFile, scene_albedo
    from seasonscapes.workflows.illumination import sun_moon_position
    from seasonscapes.workflows.place import MeshOptions, find_scene, load_place
    from seasonscapes.workflows.relight_session import RenderJob
    from seasonscapes.workflows.timelapse import FilmLook, cached_session, developed, frames_folder, render_frame
    from seasonscapes.workspace import Workspace, default_workspace

    path = find_scene("alpine")
    place = load_place(path, default_workspace())
    start = datetime(2024, 1, 1, tzinfo=UTC)
    hours = [start + timedelta(hours=k) for k in range(8784)]
    bright = [
        t
        for t in hours
        if sun_moon_position(t, place.frame.latitude_deg, place.frame.longitude_deg).sun.elevation_deg > -12.0
    ]
    chosen = [bright[k] for k in np.linspace(0, len(bright) - 1, frames).astype(int)]
    with tempfile.TemporaryDirectory() as name:
        folder = Workspace(Path(name))
        # The terrain, its colours and the sky's tables are the place's, not the film's: taken from where they are.
        for each in default_workspace().folder.iterdir():
            (folder.folder / each.name).symlink_to(each) if each.name != "alpine" else None
        (folder.folder / "alpine").mkdir()
        for each in (default_workspace().folder / "alpine").iterdir():
            if not each.name.startswith(("frames-", "coefficients-")):
                (folder.folder / "alpine" / each.name).symlink_to(each)
        # Two dated albedos, as a real place may have: each frame wears a blend of them.
        dated = []
        for day in (datetime(2024, 1, 16, tzinfo=UTC), datetime(2024, 7, 16, tzinfo=UTC)):
            save_texture(scene_albedo(place, day), Path(name) / f"{day:%m%d}.npz")
            dated.append(AlbedoFile(day.date(), Path(name) / f"{day:%m%d}.npz"))
        assignment = RenderJob(
            path,
            Path(name),
            MeshOptions(),
            read_scene(path).camera(None),
            (width_px, width_px * 2 // 3),
            read_sky_model("clear"),
            albedo=tuple(dated),
        )
        clock = {"coefficients": time.perf_counter()}
        session = cached_session(assignment)
        clock["frames"] = time.perf_counter()
        cpu = time.process_time()
        for index, each in enumerate(chosen):
            render_frame(assignment, each)
            if (index + 1) % 50 == 0:
                print(
                    f"year: {index + 1} frames, {(time.perf_counter() - clock['frames']) / (index + 1):.2f} s each",
                    flush=True,
                )
        cpu = time.process_time() - cpu
        clock["film"] = time.perf_counter()
        write_video(Path(name) / "year.mp4", developed(frames_folder(session), chosen, FilmLook()))
        clock["end"] = time.perf_counter()
    share = len(bright) / frames
    return {
        "year_frames": len(bright),
        "year_measured_frames": frames,
        "year_coefficients_s": clock["frames"] - clock["coefficients"],
        "year_frame_s": (clock["film"] - clock["frames"]) / frames,
        "year_frame_cpu_s": cpu / frames,
        "year_film_s_per_frame": (clock["end"] - clock["film"]) / frames,
        "year_minutes": (clock["frames"] - clock["coefficients"] + share * (clock["end"] - clock["frames"])) / 60.0,
    }


_MEMORY = """
import resource, sys
sys.path.insert(0, {here!r})
import numpy as np, tempfile
from pathlib import Path
import render as arena
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.relit_view import relight_view, relightable_view
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.transport import trace_view
scene, camera, facts = arena.make_scene({seed}, Path(tempfile.mkdtemp()), width_px=1536, threads=2)
base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
terrain = ray_scene(scene.mi_terrain)
ready = relightable_view(terrain, trace_view(terrain, camera, SamplingOptions(patches="reinhart"), seed=1))
relight_view(ready, scene.illumination)
print("PEAK", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9, base * 1024 / 1e9)
"""


def memory(seed: int) -> dict[str, float]:
    """Peak memory of a process that builds the scene, traces a view of 1536 × 1024 and lights it [GB]."""
    script = _MEMORY.format(here=str(HERE), seed=seed)
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    line = next(line for line in done.stdout.splitlines() if line.startswith("PEAK"))
    peak, base = (float(part) for part in line.split()[1:])
    return {"memory_peak_gb": peak, "memory_scene_gb": base}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="smaller pictures, fewer frames, no memory test")
    parser.add_argument("--seed", type=int, help="of massif, renders and places; drawn when left out")
    parser.add_argument("--json", type=Path, help="write the flat record here")
    parser.add_argument("--bpy-python", default=os.environ.get("SEASONSCAPES_BPY_PYTHON"), help="Python that has bpy")
    parser.add_argument("--pictures", type=Path, help="write pictures to this folder")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--only", choices=("error", "visibility", "year", "memory"), help="one part alone")
    arguments = parser.parse_args()
    seed = secrets.randbelow(2**31) if arguments.seed is None else arguments.seed

    from seasonscapes.rendering.backend import use_backend

    print(
        f"seed {seed}, {arguments.threads} threads, {use_backend().variant}, load {os.getloadavg()[0]:.1f}", flush=True
    )
    import drjit as dr

    dr.set_thread_count(arguments.threads)
    parts = (
        (arguments.only,)
        if arguments.only
        else ("error", "visibility", *(() if arguments.quick else ("year", "memory")))
    )
    record: dict[str, float] = {"seed": seed, "load_1min": os.getloadavg()[0]}
    with tempfile.TemporaryDirectory() as name:
        if "error" in parts:
            record |= equal_error(Path(name), arguments, seed)
    if "visibility" in parts:
        record |= visibility_agreement(seed, 1000 if arguments.quick else 4000)
    if "year" in parts:
        record |= a_year(60 if arguments.quick else 300, 384 if arguments.quick else 768)
    if "memory" in parts:
        record |= memory(seed % 2**30)
    record["peak_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    for key, value in record.items():
        print(f"{key:36s} {value:12.5g}")
    write_record(arguments.json, record, seed=seed)


if __name__ == "__main__":
    main()
