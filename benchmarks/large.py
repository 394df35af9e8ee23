"""Large inputs within bounded time and memory: 20-megapixel photographs, 120 million texels, 3,000 km², a day of maps.

    python benchmarks/large.py [--quick] [--seed N] [--only PART ...] [--data FOLDER] [--json FILE]

Every part runs in a process of its own, so that its peak memory is its own; times are processor seconds of all threads.

* ``irradiance``: the command on 12 × 12 km at 30 m, a day of September at 10-minute steps, from 6 to 20 o'clock, on terrain that
  was built before.
* ``view``: daylight coefficients of a view of 768 × 512 pixels over 60 × 50 km of 30 m, on its adaptive mesh.
* ``completion``: a planar atlas of 120 million texels (``--quick``: 30 million), a fifth of them hidden in discs of 40 to 200 texels,
  completed in tiles by the fast variant; without ``--quick`` by the full one as well.
* ``albedo``: the command on two photographs of the time-lapse camera at Bolternosa (5752 × 3592 pixels, May and September) below
  ``--data`` (default: the environment's ``SEASONSCAPES_DATA``, or ``../shared/data``), whose pose follows from matched points and
  whose turn between the pictures is found. Left out where the pictures are not there.
"""

from __future__ import annotations

import argparse
import csv
import json
import multiprocessing
import os
import resource
import secrets
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from record import ROOT, write_record


@dataclass(frozen=True)
class Job:
    """What a part is told: a folder of its own, real data, the seed, and whether small sizes are enough."""

    folder: Path
    data: Path
    seed: int
    quick: bool


def run(arguments: list[str], folder: Path) -> tuple[float, float]:
    """Processor time [s] and peak memory [GB] of a command in the folder's own workspace."""
    environment = os.environ | {"SEASONSCAPES_WORKSPACE": str(folder / "workspace")}
    command = [sys.executable, "-m", "seasonscapes", *arguments]
    process = subprocess.Popen(command, cwd=ROOT, env=environment)
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(arguments)} exited {process.returncode}")
    print(f"{arguments[0]}: {usage.ru_utime + usage.ru_stime:.1f} s, {usage.ru_maxrss * 1024 / 1e9:.2f} GB", flush=True)
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / 1e9


def used_s() -> float:
    """Processor time of all threads of this process [s]."""
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return usage.ru_utime + usage.ru_stime


def peak_gb() -> float:
    """Peak memory of this process [GB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


# ---------------------------------------------------------------------------------------------- maps and views


def irradiance(job: Job) -> dict[str, float]:
    """A day of maps of the bundled massif."""
    run(["terrain", "alpine"], job.folder)
    span = ["--from", "2024-09-18T06:00", "--to", "2024-09-18T20:00", "--every", "10min"]
    arguments = ["irradiance", "alpine", "--spacing-m", "30", *span, "-o", str(job.folder / "day.tif")]
    seconds, memory = run(arguments, job.folder)
    return {"irradiance_day_s": seconds, "irradiance_day_peak_gb": memory, "irradiance_day_instants": 85}


def view(job: Job) -> dict[str, float]:
    """Coefficients of a view over a wide place."""
    from terrain import write_massif

    import seasonscapes as ss
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.workspace import Workspace

    write_massif(job.folder / "massif.tif", 1667, 2001, 30.0, job.seed)
    scene = job.folder / "wide.toml"
    scene.write_text(
        'name = "wide"\nattribution = "made by a benchmark"\nvertical_datum = "local"\n\n[elevation]\nfile = "massif.tif"\n\n'
        '[[camera]]\nname = "aerial"\nlatitude_deg = 46.60\nlongitude_deg = 7.95\nabove_ground_m = 800.0\n'
        "heading_deg = 150.0\npitch_deg = -8.0\nfov_deg = 60.0\n"
    )
    place = ss.load_place(scene, Workspace(job.folder / "workspace"))
    built_s, camera = used_s(), ss.camera(place, "aerial", size_px=(768, 512))
    assert isinstance(camera, Camera)
    before = used_s()
    session = ss.relight_session(place, camera)
    return {
        "view_3000km2_place_s": built_s,
        "view_3000km2_s": used_s() - before,
        "view_3000km2_peak_gb": peak_gb(),
        "view_3000km2_triangles": len(place.terrain.faces),
        "view_3000km2_pixels": len(session.coefficients.pixel),
    }


# ---------------------------------------------------------------------------------------------- completion


def completion(job: Job) -> dict[str, float]:
    """A hidden fifth of a large texture that follows from relief."""
    import cv2
    import numpy as np
    from terrain import write_massif

    from seasonscapes.terrain.mesh import build_mesh
    from seasonscapes.terrain.raster import centre_frame, read_elevation
    from seasonscapes.terrain.surface import Texture
    from seasonscapes.terrain.unwrap import unwrap
    from seasonscapes.texturing.completion import CompletionOptions, complete
    from seasonscapes.texturing.tiled_predictors import tiled_predictors

    side_px, sun = (5480 if job.quick else 10960), np.array([0.5, -0.6, 0.624])
    write_massif(job.folder / "massif.tif", 549, 549, 30.0, job.seed)
    raster = read_elevation(job.folder / "massif.tif")
    terrain, atlas = unwrap(build_mesh(raster, centre_frame(raster)), kind="planar", max_side_px=side_px)
    predictors = tiled_predictors(terrain, atlas, sun_direction=sun)
    shape = predictors.surface.shape
    texture = Texture(np.empty((*shape, 3), np.float32), np.empty(shape, np.float32))
    rng = np.random.default_rng(job.seed)
    seen = np.ones(shape, np.uint8)
    while seen.mean() > 0.8:
        for _ in range(50):
            centre = tuple(int(x) for x in rng.integers(0, shape[::-1]))
            cv2.circle(seen, centre, int(rng.integers(40, 200)), 0, -1)
    texture.weight[:] = seen
    for top in range(0, shape[0], 1024):
        rows = slice(top, min(top + 1024, shape[0]))
        part = predictors.window((rows, slice(0, shape[1])))
        layer = {name: np.nan_to_num(part.values[..., n]) for n, name in enumerate(part.names)}
        snow = 1.0 / (1.0 + np.exp(-(layer["elevation"] - 2300.0) / 60.0))
        light = 4000.0 + 30_000.0 * layer["sun"]
        for band, (ground, white) in enumerate(((0.12, 0.80), (0.14, 0.82), (0.06, 0.84))):
            texture.values[rows, :, band] = (ground + snow * (white - ground)) * light
    texture.values[:] *= rng.normal(1.0, 0.05, shape).astype(np.float32)[..., None]
    truth = texture.values[~seen.astype(bool)][::97].copy()
    texture.values[seen == 0] = np.nan
    hidden = float((predictors.surface & (seen == 0)).sum()) / 1e6
    figures: dict[str, float] = {"completion_mtexel": seen.size / 1e6, "completion_hidden_mtexel": hidden}
    for name, fast in (("fast", True),) if job.quick else (("fast", True), ("full", False)):
        before = used_s()
        done = complete(texture, predictors, options=CompletionOptions(fast=fast, seed=job.seed))
        figures[f"completion_{name}_s_per_hidden_mtexel"] = (used_s() - before) / hidden
        found = done.values[seen == 0][::97]
        # Relative to a constant, the best that knows no relief.
        error = np.mean((np.cbrt(found) - np.cbrt(truth)) ** 2) / np.cbrt(truth).var(axis=0).mean()
        figures[f"completion_{name}_error_share"] = float(error)
        print(figures, flush=True)
        del done, found
    return figures | {"completion_peak_gb": peak_gb()}


# ---------------------------------------------------------------------------------------------- two photographs

_SCENE = """
name = "bolternosa"
attribution = "Norwegian Polar Institute, CC BY 4.0"

[elevation]
file = "dem_20m.tif"

[[elevation.finer]]
file = "dem_2_5m.tif"

[[webcam]]
id = "bolternosa"
latitude_deg = {latitude_deg}
longitude_deg = {longitude_deg}
height_m = {height_m}
position_sigma_m = 50.0
projection = "perspective"
heading_deg = 8.0
horizontal_fov_deg = 44.5
width_px = 5752
height_px = 3592
time_zone = "Arctic/Longyearbyen"
"""


def _albedo_inputs(data: Path, folder: Path) -> None:
    """Scene, points, pictures and their mask as a user has them; the camera's start values are those of the data set."""
    import cv2
    import numpy as np
    import rasterio.warp

    def degrees(east: float, north: float) -> tuple[float, float]:
        longitude, latitude = rasterio.warp.transform("EPSG:25833", "EPSG:4326", [east], [north])
        return latitude[0], longitude[0]

    start = json.loads((data / "camera_init.json").read_text())["eop"]
    latitude, longitude = degrees(start["X_ini"], start["Y_ini"])
    text = _SCENE.format(latitude_deg=latitude, longitude_deg=longitude, height_m=start["Z_ini"])
    (folder / "scene.toml").write_text(text)
    for heights in ("dem_20m.tif", "dem_2_5m.tif"):
        (folder / heights).write_bytes((data / heights).read_bytes())
    with open(data / "gcps.csv") as file, open(folder / "points.csv", "w") as out:
        out.write("name,x_px,y_px,latitude_deg,longitude_deg,height_m\n")
        for row in csv.DictReader(file, skipinitialspace=True):
            at = degrees(float(row["x_world"]), float(row["y_world"]))
            out.write(f"{row['name']},{row['x_img']},{row['y_img']},{at[0]:.8f},{at[1]:.8f},{row['z_world']}\n")
    pictures = folder / "bolternosa"
    pictures.mkdir()
    for path in data.glob("*.jpg"):
        (pictures / path.name).write_bytes(path.read_bytes())
    # The pictures lie on a larger black canvas, above a clock, and with a logo in their corner.
    mask = np.zeros((3592, 5752), np.uint8)
    mask[356:3137, 381:5425] = 255
    mask[3083:, 4180:] = mask[3000:, 4718:] = 0
    (folder / "masks").mkdir()
    cv2.imwrite(str(folder / "masks" / "bolternosa.png"), mask)


def albedo(job: Job) -> dict[str, float]:
    """``albedo`` on two photographs; calibrating them is not counted."""
    source, folder = job.data / "bolternosa-timelapse", job.folder
    if not source.is_dir():
        print(f"left out: {source} is not there")
        return {}
    _albedo_inputs(source, folder)
    scene, manifest = str(folder / "scene.toml"), str(folder / "pictures.csv")
    first = str(folder / "bolternosa" / "2018-05-12_12-25.jpg")
    run(["webcams", scene, "--pictures", str(folder), "--manifest", manifest], folder)
    calibrate = ["calibrate", scene, "--picture", first, "--points", str(folder / "points.csv"), "--series", manifest]
    masks = ["--mask", str(folder / "masks" / "bolternosa.png")]
    run([*calibrate, "--radial", *masks, "-o", str(folder / "calibration")], folder)
    times = "2018-05-12T12:25,2018-09-08T09:25"
    arguments = [
        "albedo",
        scene,
        "--manifest",
        manifest,
        "--calibrations",
        str(folder / "calibration"),
        "--masks",
        str(folder / "masks"),
        "--sky",
        "overcast",
        "--visibility-km",
        "90",
        "--times",
        times,
    ]
    cost = run([*arguments, "-o", str(folder / "albedo.npz")], folder)
    return {"albedo_s": cost[0], "albedo_peak_gb": cost[1]}


PARTS: dict[str, Callable[[Job], dict[str, float]]] = {
    "irradiance": irradiance,
    "view": view,
    "completion": completion,
    "albedo": albedo,
}


def _part(name: str, job: Job, answer: str) -> None:
    """In a process of its own: a part's figures, written to a file."""
    Path(answer).write_text(json.dumps(PARTS[name](job)))


def main() -> None:
    """Run the parts and print their figures."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="30 million texels, and the fast completion alone")
    parser.add_argument("--seed", type=int, help="of relief and holes; drawn and printed if omitted")
    parser.add_argument("--only", nargs="+", choices=list(PARTS), default=list(PARTS), help="these parts alone")
    data = os.environ.get("SEASONSCAPES_DATA", ROOT.parent / "shared" / "data")
    parser.add_argument("--data", type=Path, default=Path(data), help="folder of real data sets")
    parser.add_argument("--json", type=Path, help="write the figures to a file, after each part")
    arguments = parser.parse_args()
    seed = secrets.randbelow(2**31) if arguments.seed is None else arguments.seed
    figures: dict[str, float] = {}
    for name in arguments.only:
        with tempfile.TemporaryDirectory(prefix="large-") as text:
            job, answer = Job(Path(text), arguments.data, seed, arguments.quick), str(Path(text) / "figures.json")
            process = multiprocessing.get_context("spawn").Process(target=_part, args=(name, job, answer))
            process.start()
            process.join()
            if process.exitcode:
                sys.exit(f"{name} ended with {process.exitcode}")
            figures |= json.loads(Path(answer).read_text())
        print(f"seed {seed}: {json.dumps(figures, indent=1)}", flush=True)
        write_record(arguments.json, figures, seed=seed)


if __name__ == "__main__":
    main()
