"""Path tracing: throughput and noise against a bare Mitsuba script and against Blender Cycles, side by side.

    python benchmarks/render.py [--quick] [--seed N] [--json FILE] [--bpy-python PATH] [--pictures FOLDER]

One scene for all: the synthetic massif as a full grid (1.28 M triangles), its September albedo, a Hosek sky and a sun of
true size; same camera, bounces, box filter, samples and threads. The contestants take turns, round by round, after a
warm-up that compiles kernels and builds trees; what is compared is the call that renders.

* Throughput is camera samples per second: the median over the rounds of the ratio between neighbours.
* Noise is what differs between pictures of different seeds. Efficiency is 1 / (variance × seconds): how much sooner a
  picture of equal noise is there, since samples of different renderers are not worth the same.
* Shadow rays to points of the sun's disc, from sixteen samples in each pixel, are counted as `visible_cosine` casts them (it makes
  them, and multiplies by the cosine of incidence) and as a bare `ray_test` of the same rays, which lie ready on the device.
* Agreement compares mean pictures where terrain covers the pixel: the contest is fair only if they are the same. Blocks
  of 16 × 16 pixels are compared, so that the noise that is left counts little.

Cycles runs in its own environment (``python3.11 -m venv …; pip install bpy==5.0.1``), named by ``--bpy-python`` or
``SEASONSCAPES_BPY_PYTHON``; without one its column is left out.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import secrets
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from record import write_record

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
MAX_DEPTH = 6
Render = Callable[[int, int], tuple[np.ndarray, dict]]


# ---------------------------------------------------------------------------------------------- the scene


def make_scene(seed: int, folder: Path, *, width_px: int, threads: int):
    """Massif, light and camera; written to the folder for the others, and returned as ``(RenderScene, Camera)``."""
    from affine import Affine

    from seasonscapes.cameras.pinhole import camera_at
    from seasonscapes.frames import LocalFrame, direction_from_angles
    from seasonscapes.rendering.hosek import hosek_illumination
    from seasonscapes.rendering.mitsuba_scene import build_scene
    from seasonscapes.terrain.imagery import bake_imagery
    from seasonscapes.terrain.mesh import build_mesh
    from seasonscapes.terrain.surface import Raster
    from seasonscapes.terrain.synthetic import alpine_albedo, alpine_massif
    from seasonscapes.terrain.unwrap import unwrap

    place = alpine_massif(seed=seed)
    terrain, atlas = unwrap(build_mesh(place.elevation, LocalFrame(46.55, 7.98), mesher="grid"), texel_m=7.5)
    image = Raster(
        alpine_albedo(place, 245.0, upsample=2), place.elevation.transform * Affine.scale(0.5), place.elevation.crs
    )
    albedo = bake_imagery(terrain, atlas, image).values
    light = hosek_illumination(direction_from_angles(135.0, 38.0))
    start = time.perf_counter()
    scene = build_scene(terrain, albedo, light)
    camera = camera_at(
        terrain.frame,
        46.60,
        7.95,
        4200.0,
        heading_deg=160.0,
        pitch_deg=-14.0,
        fov_deg=60.0,
        size_px=(width_px, width_px * 2 // 3),
    )
    facts = {
        "triangles": len(terrain.faces),
        "build_seconds": time.perf_counter() - start,
        "threads": threads,
        "max_depth": MAX_DEPTH,
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "fov_deg": 60.0,
        "world_from_camera": camera.world_from_camera.tolist(),
        "sun_direction": light.sun.direction.tolist(),
        "sun_normal_illuminance": light.sun.normal_illuminance_lx.tolist(),
        "sun_angular_radius_deg": light.sun.angular_radius_deg,
    }
    write_files(folder, facts, scene, terrain, albedo)
    return scene, camera, facts


def write_files(folder: Path, facts: dict, scene, terrain, albedo: np.ndarray) -> None:
    """The scene for Mitsuba (PLY, EXR) and for Blender (arrays)."""
    import mitsuba as mi

    from seasonscapes.images import write_exr
    from seasonscapes.rendering.mitsuba_scene import mi_luminary

    scene.mi_terrain.write_ply(str(folder / "terrain.ply"))
    sun = mi_luminary(scene.illumination.sun)
    sun.write_ply(str(folder / "sun.ply"))
    facts["sun_polygon_radiance"] = np.array(mi.traverse(sun)["emitter.radiance.value"]).ravel().tolist()
    # Mitsuba's maps hold both poles and their first column once more; so does the one that it keeps in memory.
    sky = np.array(mi.traverse(scene.mi_scene.environment())["data"])[:, :-1]
    write_exr(folder / "sky.exr", {"": sky})
    write_exr(folder / "albedo.exr", {"": albedo})
    np.savez(
        folder / "scene.npz",
        vertices=terrain.vertices,
        faces=terrain.faces,
        uv=terrain.uv,
        albedo=albedo,
        sky=scene.illumination.sky_radiance,
    )
    (folder / "facts.json").write_text(json.dumps(facts))


# ---------------------------------------------------------------------------------------------- contestants


def timed(render: Callable[[], np.ndarray]) -> tuple[np.ndarray, dict]:
    """What a call returns, with the seconds it took and the processor seconds of this process."""

    def cpu_seconds() -> float:
        usage = resource.getrusage(resource.RUSAGE_SELF)
        return usage.ru_utime + usage.ru_stime

    start, start_cpu = time.perf_counter(), cpu_seconds()
    image = render()
    return image, {"seconds": time.perf_counter() - start, "cpu_seconds": cpu_seconds() - start_cpu}


def ours(scene, camera) -> Render:
    """`path_trace` of seasonscapes."""
    from seasonscapes.rendering.radiance import path_trace

    return lambda spp, seed: timed(lambda: path_trace(scene, camera, spp=spp, seed=seed, max_depth=MAX_DEPTH)[0])


def bare(folder: Path, sun: str) -> Render:
    """The hand-written script."""
    import bare_mitsuba

    scene = bare_mitsuba.load(folder, sun=sun)
    return lambda spp, seed: timed(lambda: bare_mitsuba.render(scene, spp, seed))


class Cycles:
    """Blender in a process of its own that keeps the scene and renders on request; see `cycles_render.py`."""

    def __init__(self, python: str, folder: Path):
        self.folder = folder
        self.process = subprocess.Popen(
            [python, str(HERE / "cycles_render.py"), str(folder)],
            text=True,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        self.about = self.answer("ready")

    def answer(self, word: str) -> dict:
        """The next line that begins with a word, of all that Blender says."""
        for line in self.process.stdout:
            if line.startswith(word + " "):
                return json.loads(line[len(word) :])
        raise RuntimeError(f"Blender ended with status {self.process.wait()} before it said '{word}'")

    def __call__(self, spp: int, seed: int) -> tuple[np.ndarray, dict]:
        path = self.folder / "cycles.npy"
        self.process.stdin.write(f"{spp} {seed} {path}\n")
        self.process.stdin.flush()
        times = self.answer("done")
        return np.load(path)[..., :3], times

    def close(self) -> None:
        self.process.stdin.close()
        self.process.wait()


# ---------------------------------------------------------------------------------------------- the contest


def contest(renders: dict[str, Render], *, spp: int, rounds: int, seed: int) -> dict[str, dict]:
    """Pictures ``(N, H, W, 3)`` and seconds ``(N,)`` of each, taking turns; the warm-up's time apart."""
    results: dict[str, dict] = {name: {"images": [], "seconds": [], "cpu_seconds": []} for name in renders}
    for name, render in renders.items():
        results[name]["first_seconds"] = render(spp, seed)[1]["seconds"]
    for turn in range(rounds):
        for name, render in renders.items():
            image, times = render(spp, (seed + 1 + turn) % 2**31)
            results[name]["images"].append(image)
            for key, value in times.items():
                results[name][key].append(value)
            print(
                f"round {turn + 1}/{rounds}  {name:17s} {times['seconds']:6.2f} s, {times['cpu_seconds']:6.2f} s of CPU",
                flush=True,
            )
    for name, render in renders.items():
        # One sample a pixel shows what a call costs beside its samples.
        calls = [render(1, seed + k)[1] for k in range(3)]
        results[name] |= {
            f"{key}_1spp": float(np.median([call[key] for call in calls])) for key in ("seconds", "cpu_seconds")
        }
    return results


def shadow_rays(scene, camera, *, rounds: int, seed: int) -> dict[str, float]:
    """Shadow rays per processor second, over a bare `ray_test` of the same rays; the median of neighbours in time."""
    import drjit as dr
    import mitsuba as mi

    from seasonscapes.rendering.backend import point3
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.sun_visibility import bayer_disc_offset, disc_directions, sun_rays, visible_cosine
    from seasonscapes.rendering.terrain_material import shadow_ray_start
    from seasonscapes.rendering.view_samples import view_samples

    land, sun = ray_scene(scene.mi_terrain), scene.illumination.sun
    points, hit, pixel = view_samples(land, camera, range(camera.height_px), 16, seed)
    offset = bayer_disc_offset(pixel, camera.width_px, 16)
    rays = sun_rays(land, points.origin, points.normal, points.geometric_normal, hit.astype(np.float32), offset)
    disc = (np.arange(16) + offset[:, None] % 256) % 16
    direction = disc_directions(sun, 16).astype(np.float32)[disc].reshape(-1, 3)
    # As float16, which is how the rays hold them.
    half = [
        each.reshape(-1, 3).astype(np.float16).astype(np.float32) for each in (points.normal, points.geometric_normal)
    ]
    cosine, facet = (normal @ np.asarray(sun.direction, np.float32) for normal in half)
    active = mi.Bool((cosine > 0.0) & (facet > 0.0) & hit.ravel())
    towards = mi.Vector3f(point3(direction))
    origin = point3(points.origin.reshape(-1, 3))
    origin += towards * shadow_ray_start(land.mi_terrain.bsdf(), mi.Float(facet), origin)
    dr.eval(origin, towards, active)

    def ours() -> np.ndarray:
        return visible_cosine(rays, sun).ravel() > 0.0

    def bare() -> np.ndarray:
        # In packets, as ours, which is faster for neighbouring rays.
        hidden = land.mi_scene.ray_test(mi.Ray3f(origin, towards), coherent=True, active=active)
        return np.array(active & ~hidden)

    differ = float((ours() != bare()).mean())
    ratios, rates = [], []
    for _ in range(rounds):
        mine, plain = timed(ours)[1]["cpu_seconds"], timed(bare)[1]["cpu_seconds"]
        ratios.append(plain / mine)
        rates.append(len(direction) / mine / 1e6)
    return {
        "shadow_rays_vs_ray_test": float(np.median(ratios)),
        "shadow_mrays_per_cpu_s": float(np.median(rates)),
        "shadow_rays_differ": differ,
    }


def noise_variance(images: list[np.ndarray], mask: np.ndarray) -> float:
    """Variance of a pixel between seeds, mean over pixels and channels, relative to the squared mean."""
    stack = np.array([image[mask] for image in images], np.float64)
    return float(np.var(stack, axis=0, ddof=1).mean() / stack.mean() ** 2)


def block_means(image: np.ndarray, mask: np.ndarray, side: int = 16) -> np.ndarray:
    """Means ``(N, 3)`` over the masked pixels of those blocks that have any."""
    height, width = (size // side * side for size in mask.shape)
    blocks = (height // side, side, width // side, side)
    sums = (image * mask[..., None])[:height, :width].reshape(*blocks, 3).sum(axis=(1, 3))
    counts = mask[:height, :width].reshape(blocks).sum(axis=(1, 3))
    return sums[counts > 0] / counts[counts > 0][:, None]


def measure(results: dict[str, dict], spp: int, mask: np.ndarray) -> dict[str, dict]:
    """Throughput, noise and efficiency of each contestant; agreement with ours."""
    mean_ours = np.mean(results["ours"]["images"], axis=0)
    blocks_ours = block_means(mean_ours, mask)
    table = {}
    for name, result in results.items():
        seconds, cpu_seconds = (float(np.median(result[key])) for key in ("seconds", "cpu_seconds"))
        variance, mean = noise_variance(result["images"], mask), np.mean(result["images"], axis=0)
        table[name] = {
            "msamples_per_s": spp * mask.size / seconds / 1e6,
            "msamples_per_cpu_s": spp * mask.size / cpu_seconds / 1e6,
            # Without what a call costs beside its samples.
            "msamples_per_cpu_s_net": (spp - 1) * mask.size / (cpu_seconds - result["cpu_seconds_1spp"]) / 1e6,
            "noise": float(np.sqrt(variance)),
            "efficiency": 1.0 / (variance * seconds),
            "first_s": result["first_seconds"],
            "seconds_1spp": result["seconds_1spp"],
            "mean_difference": float(mean[mask].mean() / mean_ours[mask].mean() - 1.0),
            "block_difference": float(np.abs(block_means(mean, mask) - blocks_ours).mean() / blocks_ours.mean()),
        }
    return table


def paired(results: dict[str, dict], name: str, key: str = "seconds") -> float:
    """How many times as fast ours is: median over the rounds of the ratio within a round."""
    return float(np.median(np.array(results[name][key]) / np.array(results["ours"][key])))


def record_of(table: dict[str, dict], results: dict[str, dict]) -> dict[str, float]:
    """The flat record; the bare script counts with the faster of its two suns."""
    record = {f"{key}_{name}": value for name, row in table.items() for key, value in row.items()}
    bares = [name for name in table if name.startswith("bare_")]
    rivals = {"bare_mitsuba": min(bares, key=lambda name: paired(results, name))}
    if "cycles" in table:
        rivals["cycles"] = "cycles"
    for label, name in rivals.items():
        record[f"throughput_vs_{label}"] = paired(results, name)
        record[f"cpu_throughput_vs_{label}"] = paired(results, name, "cpu_seconds")
        record[f"net_cpu_throughput_vs_{label}"] = (
            table["ours"]["msamples_per_cpu_s_net"] / table[name]["msamples_per_cpu_s_net"]
        )
        record[f"equal_noise_speedup_vs_{label}"] = (
            paired(results, name) * (table[name]["noise"] / table["ours"]["noise"]) ** 2
        )
    record["throughput_vs_bare_same_sun"] = paired(results, "bare_polygon")
    return record


def show(table: dict[str, dict], record: dict[str, float]) -> None:
    """The table as text."""
    print(
        f"\n{'':18s}{'Msamples/s':>11s}{'per CPU s':>11s}{'net':>8s}{'noise':>9s}{'1/(var·s)':>11s}{'first call':>12s}"
        f"{'1 spp':>9s}{'mean diff':>11s}{'block diff':>12s}"
    )
    for name, row in table.items():
        print(
            f"{name:18s}{row['msamples_per_s']:11.3f}{row['msamples_per_cpu_s']:11.3f}{row['msamples_per_cpu_s_net']:8.3f}"
            f"{row['noise']:9.4f}{row['efficiency']:11.2f}{row['first_s']:10.2f} s{row['seconds_1spp']:7.2f} s"
            f"{row['mean_difference']:+11.4f}{row['block_difference']:12.4f}"
        )
    print()
    for key, value in record.items():
        if "_vs_" in key or key.startswith("shadow_"):
            print(f"{key:45s} {value:8.2f}")


def save_pictures(folder: Path, results: dict[str, dict]) -> None:
    """Mean pictures beside each other, and their differences from ours (grey = equal, ±20 % of the mean = full)."""
    from seasonscapes.images import srgb_from_linear, write_png

    folder.mkdir(parents=True, exist_ok=True)
    means = [np.mean(result["images"], axis=0) for result in results.values()]
    scale = float(np.percentile(means[0], 99))
    first = [results[name]["images"][0] for name in results]
    rows = [
        np.hstack([srgb_from_linear(np.clip(image / scale, 0.0, 1.0)) for image in images]) for images in (means, first)
    ]
    rows.append(np.hstack([np.clip(0.5 + (mean - means[0]) / (0.4 * means[0].mean()), 0.0, 1.0) for mean in means]))
    write_png(folder / "side_by_side.png", np.vstack(rows).astype(np.float32))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="smaller pictures, fewer rounds (under 5 minutes)")
    parser.add_argument("--seed", type=int, help="of the massif and of the renders; drawn when left out")
    parser.add_argument("--json", type=Path, help="write the flat record here")
    parser.add_argument("--bpy-python", default=os.environ.get("SEASONSCAPES_BPY_PYTHON"), help="Python that has bpy")
    parser.add_argument("--pictures", type=Path, help="write side_by_side.png to this folder")
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    arguments = parser.parse_args()
    seed = secrets.randbelow(2**31) if arguments.seed is None else arguments.seed
    width_px, spp, rounds = (480, 16, 3) if arguments.quick else (768, 32, 5)

    from seasonscapes.rendering.backend import use_backend

    # An empty cache of kernels, so that the first call shows what compiling costs.
    cache = tempfile.TemporaryDirectory()
    os.environ["DRJIT_CACHE_DIR"] = cache.name
    print(
        f"seed {seed}, {arguments.threads} threads, {use_backend().variant}, load {os.getloadavg()[0]:.1f}", flush=True
    )
    import drjit as dr

    dr.set_thread_count(arguments.threads)
    with cache, tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        scene, camera, facts = make_scene(seed, folder, width_px=width_px, threads=arguments.threads)
        renders: dict[str, Render] = {
            "ours": ours(scene, camera),
            "bare_polygon": bare(folder, "polygon"),
            "bare_directional": bare(folder, "directional"),
        }
        cycles = Cycles(arguments.bpy_python, folder) if arguments.bpy_python else None
        if cycles is None:
            print("no Cycles column: neither --bpy-python nor SEASONSCAPES_BPY_PYTHON names a Python that has bpy")
        else:
            renders["cycles"] = cycles
        print(
            f"{facts['triangles']:,} triangles, {width_px}×{camera.height_px} px, {spp} spp, {MAX_DEPTH - 2} bounces",
            flush=True,
        )
        results = contest(renders, spp=spp, rounds=rounds, seed=seed % 2**30)
        if cycles is not None:
            cycles.close()
    from seasonscapes.rendering.radiance import path_trace

    mask = path_trace(scene, camera, spp=4, max_depth=2)[1] == 1.0
    table = measure(results, spp, mask)
    record = record_of(table, results) | shadow_rays(scene, camera, rounds=4 * rounds, seed=seed % 2**30)
    show(table, record)
    if arguments.pictures:
        save_pictures(arguments.pictures, results)
    if arguments.json:
        record |= {
            "threads": arguments.threads,
            "triangles": facts["triangles"],
            "spp": spp,
            "width_px": width_px,
            "rounds": rounds,
            "load_1min": os.getloadavg()[0],
        }
        write_record(arguments.json, record, seed=seed)


if __name__ == "__main__":
    main()
