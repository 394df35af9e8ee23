"""Terrain: seconds, memory, triangles and texels, on a seeded fractal massif and, where present, on real rasters.

    python benchmarks/terrain.py [--quick] [--seed N] [--json FILE]

Each part runs in a process of its own, so that its peak memory is its own. ``--quick`` leaves out the render of the
full grid at 20 m and the atlases of the large mesh.
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
from pathlib import Path

from record import write_record

LV95_ORIGIN_M = (2_610_000.0, 1_180_000.0)


# ---------------------------------------------------------------------------------------------- the massif


def fractal_heights(rows: int, columns: int, spacing_m: float, seed: int):
    """Seeded heights ``(rows, columns)`` float32 from 500 to 4,000 m: a power law of 2.2 above 10 km, level below.

    At 30 m its slopes (median 26°, 95th percentile 46°) are those of the Bernese Alps.
    """
    import numpy as np

    noise = np.fft.rfft2(np.random.default_rng(seed).standard_normal((rows, columns), np.float32))
    down, across = np.fft.fftfreq(rows, spacing_m)[:, None], np.fft.rfftfreq(columns, spacing_m)[None]
    noise *= (down**2 + across**2 + 10_000.0**-2) ** -1.1
    heights = np.fft.irfft2(noise, s=(rows, columns))
    return (500.0 + 3500.0 * (heights - heights.min()) / np.ptp(heights)).astype(np.float32)


def write_massif(path: Path, rows: int, columns: int, spacing_m: float, seed: int) -> None:
    """The massif as a GeoTIFF in the Swiss grid."""
    import rasterio
    from affine import Affine

    transform = Affine(spacing_m, 0, LV95_ORIGIN_M[0], 0, -spacing_m, LV95_ORIGIN_M[1])
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        count=1,
        height=rows,
        width=columns,
        dtype="float32",
        crs="EPSG:2056",
        transform=transform,
        tiled=True,
    ) as file:
        file.write(fractal_heights(rows, columns, spacing_m, seed), 1)


# ---------------------------------------------------------------------------------------------- parts


def massif_30m(seed: int, folder: str) -> dict:
    """Write the 60 × 50 km raster at 30 m (in a process that nobody measures)."""
    import numpy as np

    write_massif(Path(folder) / "massif.tif", 1667, 2001, 30.0, seed)
    down, across = np.gradient(fractal_heights(1667, 2001, 30.0, seed), 30.0)
    median, steep = np.percentile(np.degrees(np.arctan(np.hypot(down, across))), (50, 95))
    return {"slope_p50_deg": float(median), "slope_p95_deg": float(steep)}


def adaptive_3000km2(seed: int, folder: str) -> dict:
    """From the file to the adaptive mesh with a bound of 5 m."""
    from seasonscapes.terrain.mesh import build_mesh, mesh_report
    from seasonscapes.terrain.raster import centre_frame, fill_nodata, read_elevation

    start = time.perf_counter()
    raster, _ = fill_nodata(read_elevation(Path(folder) / "massif.tif"))
    terrain = build_mesh(raster, centre_frame(raster), max_error_m=5.0)
    seconds, peak_gb = time.perf_counter() - start, peak_memory_gb()
    report = mesh_report(terrain, raster)
    return {
        "seconds_3000km2": seconds,
        "peak_gb": peak_gb,
        "samples_3000km2": report.samples,
        "triangles_3000km2": report.triangles,
        "triangles_saved_ratio": report.saved_ratio,
        "vertical_rmse_m": report.vertical_rmse_m,
        "vertical_max_m": report.vertical_max_m,
        "uncovered_samples": report.uncovered_samples,
    }


def grid_3000km2(seed: int, folder: str) -> dict:
    """The same as a full grid."""
    from seasonscapes.terrain.mesh import build_mesh
    from seasonscapes.terrain.raster import centre_frame, read_elevation

    start = time.perf_counter()
    raster = read_elevation(Path(folder) / "massif.tif")
    terrain = build_mesh(raster, centre_frame(raster), mesher="grid")
    return {
        "grid_seconds_3000km2": time.perf_counter() - start,
        "grid_peak_gb": peak_memory_gb(),
        "grid_triangles_3000km2": len(terrain.faces),
    }


def atlases_3000km2(seed: int, folder: str) -> dict:
    """All atlases of the adaptive mesh with a bound of 5 m, 4,096 texels along the longer side."""
    from seasonscapes.terrain.mesh import build_mesh
    from seasonscapes.terrain.raster import centre_frame, read_elevation

    raster = read_elevation(Path(folder) / "massif.tif")
    return _atlas_record(build_mesh(raster, centre_frame(raster)), "massif", 4096)


def jungfrau(seed: int, folder: str) -> dict:
    """Real mountains at 100 m: every mesher and every atlas; empty where the data set is absent."""
    from seasonscapes.terrain.mesh import build_mesh, mesh_report
    from seasonscapes.terrain.raster import centre_frame, fill_nodata, read_elevation

    data = Path(os.environ.get("SEASONSCAPES_DATA", Path(__file__).parents[2] / "shared" / "data"))
    path = data / "jungfrau" / "dem_surface_100m.tif"
    if not path.is_file():
        return {}
    raster, _ = fill_nodata(read_elevation(path))
    frame = centre_frame(raster)
    meshers = [("adaptive", 5.0), ("adaptive", 20.0), ("grid", 5.0), ("poisson", 5.0)]
    record = {}
    for mesher, bound_m in meshers:
        start = time.perf_counter()
        terrain = build_mesh(raster, frame, mesher=mesher, max_error_m=bound_m)
        seconds, report = time.perf_counter() - start, mesh_report(terrain, raster)
        name = f"jungfrau_{mesher}" + (f"_{bound_m:g}m" if mesher == "adaptive" else "")
        record |= {
            f"{name}_seconds": seconds,
            f"{name}_triangles": report.triangles,
            f"{name}_rmse_m": report.vertical_rmse_m,
            f"{name}_max_m": report.vertical_max_m,
        }
    return record | _atlas_record(build_mesh(raster, frame, max_error_m=20.0), "jungfrau", 2048)


def _atlas_record(terrain, name: str, side_px: int) -> dict:
    from seasonscapes.terrain.unwrap import ATLASES, unwrap

    record = {}
    for kind in ATLASES:
        start = time.perf_counter()
        _, atlas = unwrap(terrain, kind=kind, max_side_px=side_px)
        key = f"{name}_{kind}"
        record |= {
            f"{key}_seconds": time.perf_counter() - start,
            f"{key}_texel_p50_m": atlas.texel_p50_m,
            f"{key}_texel_p99_m": atlas.texel_p99_m,
            f"{key}_stretch_p99_m": atlas.stretch_p99_m,
            f"{key}_utilization": atlas.utilization,
        }
    return record


def full_grid_20m(seed: int, folder: str) -> dict:
    """60 × 60 km at 20 m: 9 M samples, 18 M triangles, built and rendered."""
    from seasonscapes.terrain.mesh import build_mesh
    from seasonscapes.terrain.raster import centre_frame, read_elevation

    path = Path(folder) / "massif20.tif"
    raster = read_elevation(path)
    frame = centre_frame(raster)
    start = time.perf_counter()
    terrain = build_mesh(raster, frame, mesher="grid")
    record = {
        "full_grid_triangles": len(terrain.faces),
        "full_grid_build_seconds": time.perf_counter() - start,
        "full_grid_build_peak_gb": peak_memory_gb(),
    }
    del raster
    return record | _render_record(terrain, frame)


def _render_record(terrain, frame) -> dict:
    """Path-trace one view over the whole massif: clear sky of one radiance, sun at 35°."""
    import numpy as np

    from seasonscapes.cameras.pinhole import camera_at
    from seasonscapes.frames import direction_from_angles
    from seasonscapes.rendering.backend import use_backend
    from seasonscapes.rendering.mitsuba_scene import build_scene
    from seasonscapes.rendering.radiance import path_trace
    from seasonscapes.sky.illumination import Illumination, Luminary

    device = use_backend().device
    sun = Luminary(direction_from_angles(220.0, 35.0), np.full(3, 90_000.0), 0.2666)
    light = Illumination(np.full((32, 64, 3), 4_000.0, np.float32), sun=sun)
    start = time.perf_counter()
    scene = build_scene(terrain, np.full(3, 0.3), light)
    built = time.perf_counter()
    camera = camera_at(
        frame,
        frame.latitude_deg - 0.25,
        frame.longitude_deg,
        6_000.0,
        heading_deg=0.0,
        pitch_deg=-12.0,
        size_px=(1536, 1024),
    )
    image, coverage = path_trace(scene, camera, spp=16)
    if not (np.isfinite(image).all() and coverage.mean() > 0.3):
        raise SystemExit("full_grid_20m: the render is empty or not finite")
    print(f"full_grid_20m: rendered on {device}, {100 * coverage.mean():.0f} % of the picture is land", file=sys.stderr)
    return {
        "full_grid_scene_seconds": built - start,
        "full_grid_render_seconds": time.perf_counter() - built,
        "full_grid_peak_gb": peak_memory_gb(),
    }


def massif_20m(seed: int, folder: str) -> dict:
    """Write the 60 × 60 km raster at 20 m (in a process that nobody measures)."""
    write_massif(Path(folder) / "massif20.tif", 3001, 3001, 20.0, seed)
    return {}


PARTS = {
    part.__name__: part
    for part in (massif_30m, adaptive_3000km2, grid_3000km2, jungfrau, atlases_3000km2, massif_20m, full_grid_20m)
}
NOT_QUICK = ("atlases_3000km2", "massif_20m", "full_grid_20m")


# ---------------------------------------------------------------------------------------------- running them


def peak_memory_gb() -> float:
    """Largest resident set of this process so far [GB]; Linux counts in KiB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def run_part(name: str, seed: int, folder: str) -> dict:
    """One part in a fresh interpreter; its record is the last line that it prints."""
    command = [sys.executable, __file__, "--part", name, "--folder", folder, "--seed", str(seed)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.strip().splitlines()[-1])


def print_table(record: dict) -> None:
    width = max(map(len, record))
    for key, value in record.items():
        print(f"{key:{width}}  {value:,.3f}" if isinstance(value, float) else f"{key:{width}}  {value:,}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="within five minutes on two cores")
    parser.add_argument("--seed", type=int, help="of the massif; drawn when left out")
    parser.add_argument("--json", type=Path, help="file for the record")
    parser.add_argument("--part", choices=PARTS, help=argparse.SUPPRESS)
    parser.add_argument("--folder", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.part:
        print(json.dumps(PARTS[options.part](options.seed, options.folder)))
        return
    seed = secrets.randbelow(2**31) if options.seed is None else options.seed
    record: dict = {"seed": seed}
    with tempfile.TemporaryDirectory() as folder:
        for name in PARTS:
            if options.quick and name in NOT_QUICK:
                continue
            record |= run_part(name, seed, folder)
    print_table(record)
    write_record(options.json, record, seed=seed)


if __name__ == "__main__":
    main()
