"""Large inputs within bounded time and memory: two 20-megapixel photographs, 120 million texels, 3,000 km².

    python benchmarks/large.py [--quick] [--seed N] [--only PART] [--data FOLDER] [--json FILE]

Every part runs in a process of its own, so that its peak memory is its own; times are processor seconds of all threads.

* ``albedo``: the command on two photographs of the time-lapse camera at Bolternosa (5752 × 3592 pixels, May and September) below
  ``--data`` (default: the environment's ``SEASONSCAPES_DATA``, or ``../shared/data``), whose pose follows from matched points and
  whose turn between the pictures is found. Left out where the pictures are not there.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import resource
import secrets
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from record import ROOT, write_record

# ---------------------------------------------------------------------------------------------- two photographs

_SCENE = """
name = "bolternosa"
attribution = "Norwegian Polar Institute, CC BY 4.0"

[elevation]
file = "dem.tif"

[[webcam]]
id = "bolternosa"
latitude_deg = {latitude_deg}
longitude_deg = {longitude_deg}
height_m = {height_m}
position_sigma_m = 30.0
projection = "perspective"
heading_deg = 8.0
horizontal_fov_deg = 44.5
width_px = 5752
height_px = 3592
time_zone = "UTC"
"""


def _albedo_inputs(data: Path, folder: Path) -> None:
    """Scene, points and pictures as a user has them; the camera's start values are those of the data set."""
    import rasterio.warp

    def degrees(east: float, north: float) -> tuple[float, float]:
        longitude, latitude = rasterio.warp.transform("EPSG:25833", "EPSG:4326", [east], [north])
        return latitude[0], longitude[0]

    start = json.loads((data / "camera_init.json").read_text())["eop"]
    latitude, longitude = degrees(start["X_ini"], start["Y_ini"])
    text = _SCENE.format(latitude_deg=latitude, longitude_deg=longitude, height_m=start["Z_ini"])
    (folder / "scene.toml").write_text(text)
    (folder / "dem.tif").write_bytes((data / "dem_20m.tif").read_bytes())
    with open(data / "gcps.csv") as file, open(folder / "points.csv", "w") as out:
        out.write("name,x_px,y_px,latitude_deg,longitude_deg,height_m\n")
        for row in csv.DictReader(file, skipinitialspace=True):
            at = degrees(float(row["x_world"]), float(row["y_world"]))
            out.write(f"{row['name']},{row['x_img']},{row['y_img']},{at[0]:.8f},{at[1]:.8f},{row['z_world']}\n")
    pictures = folder / "bolternosa"
    pictures.mkdir()
    for path in data.glob("*.jpg"):
        (pictures / path.name).write_bytes(path.read_bytes())


def albedo(folder: Path, data: Path) -> dict[str, float]:
    """``albedo`` on two photographs; calibrating them is not counted."""
    source = data / "bolternosa-timelapse"
    if not source.is_dir():
        print(f"left out: {source} is not there")
        return {}
    _albedo_inputs(source, folder)
    scene, manifest = str(folder / "scene.toml"), str(folder / "pictures.csv")
    first = str(folder / "bolternosa" / "2018-05-12_12-25.jpg")
    run(["webcams", scene, "--pictures", str(folder), "--manifest", manifest], folder)
    calibrate = ["calibrate", scene, "--picture", first, "--points", str(folder / "points.csv"), "--series", manifest]
    run([*calibrate, "-o", str(folder / "calibration")], folder)
    times = "2018-05-12T12:25Z,2018-09-08T09:25Z"
    arguments = [
        "albedo",
        scene,
        "--manifest",
        manifest,
        "--calibrations",
        str(folder / "calibration"),
        "--times",
        times,
    ]
    cost = run([*arguments, "--doubtful-poses", "-o", str(folder / "albedo.npz")], folder)
    return {"albedo_s": cost[0], "albedo_peak_gb": cost[1]}


def run(arguments: list[str], folder: Path) -> tuple[float, float]:
    """Processor time [s] and peak memory [GB] of a command in the folder's own workspace."""
    environment = os.environ | {"SEASONSCAPES_WORKSPACE": str(folder / "workspace")}
    command = [sys.executable, "-m", "seasonscapes", *arguments]
    process = subprocess.Popen(command, cwd=ROOT, env=environment)
    _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"{' '.join(arguments)} exited {os.waitstatus_to_exitcode(status)}")
    print(f"{arguments[0]}: {usage.ru_utime + usage.ru_stime:.1f} s, {usage.ru_maxrss * 1024 / 1e9:.2f} GB", flush=True)
    return usage.ru_utime + usage.ru_stime, usage.ru_maxrss * 1024 / 1e9
