"""Every verb with arguments that would do, a small land for them to work on, and the flags that their help names."""

from __future__ import annotations

import re
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import places
from fault_harness import TIME, call

BASE: dict[str, list[str]] = {
    "render": ["s.toml", "--time", TIME, "--size", "16x12", "--spp", "1", "--output", "out/a.png"],
    "view": ["s.toml", "--output", "out/page"],
    "timelapse": ["s.toml", "--times", TIME, "--size", "16x12", "--output", "out/film"],
    "fetch": ["--at", "46.5,8.0", "--elevation", "dem.tif", "--imagery", "image.tif", "--output", "got/g.toml"],
    "export": ["s.toml", "--to", "glb", "--output", "out/e.glb"],
    "delight": ["s.toml", "--sun", "170,40", "--output", "out/d.npz"],
    "relight": ["box.ply", "--at", "46.5,8,1500", "--time", TIME, "--output", "out/r.png"],
    "lit-texture": ["s.toml", "--time", TIME, "--output", "out/l.png"],
    "irradiance": ["s.toml", "--time", TIME, "--output", "out/i.tif"],
    "sky": ["--at", "46.5,8,1500", "--time", TIME, "--output", "out/d.png"],
    "terrain": ["s.toml"],
    "webcams": ["w.toml", "--output", "out/w.png"],
    "calibrate": ["w.toml", "--picture", "p.png", "--skyline", "--output", "out/cal"],
    "annotate": ["w.toml", "--picture", "p.png", "--output", "out/cal"],
    "paint": ["s.toml", "--time", TIME, "--manifest", "m.csv", "--calibrations", "cal", "--output", "out/paint"],
    "inpaint": ["s.toml", "--time", TIME, "--texture", "painted.npz", "--output", "out/c.npz"],
    "path": [
        *("s.toml", "--via", "46.5405,7.98,+300", "--via", "46.552,7.982,+300", "--views", "3"),
        *("--output", "out/p.json"),
    ],
    "albedo": ["s.toml", "--times", TIME, "--manifest", "m.csv", "--output", "out/a.npz"],
    "hours": ["s.toml", "--at-hours", TIME, "--manifest", "m.csv", "--output", "out/hours"],
    "distill": ["s.toml", "--output", "out/m.safetensors"],
    "splat": ["s.toml", "--time", TIME, "--model", "m.safetensors", "--size", "16x12", "--output", "out/s.png"],
    "run": ["s.toml", "--times", TIME, "--at-hours", TIME, "--manifest", "m.csv", "--output", "out/run"],
    "evaluate": ["--truth", "p.png", "--pictures", "p.png"],
    "lpips": ["p.png", "p.png", "--output", "out/l.safetensors"],
    "info": ["p.png"],
    "demo": ["out/demo", "--size", "48x32"],
    "doctor": [],
}
SCENE_VERBS = [verb for verb, tokens in BASE.items() if tokens[:1] in (["s.toml"], ["w.toml"])]
# What a verb must have; `annotate` has no --json: it serves until Ctrl-C.
JSON_VERBS = [verb for verb in BASE if verb != "annotate"]


@cache
def flags_of(verb: str) -> dict[str, str]:
    """The flags of a verb and the kind of their values: INT, FLOAT, STR, PATH, or nothing for a switch."""
    text = call([verb, "--help"]).out
    found = re.findall(r"(--[a-z][a-z0-9-]*)(?: -[a-z])?(?: (INT|FLOAT|STR|PATH))?", text)
    return {flag: kind for flag, kind in found if kind}


def write_land(folder: Path) -> Path:
    """Scene files, rasters, a photograph and a manifest in ``folder/inside``; a treasure beside it."""
    inside = folder / "inside"
    inside.mkdir(parents=True)
    (folder / "outside").mkdir()
    (folder / "outside" / "secret.txt").write_text("secret\n")
    places.write_place(inside).rename(inside / "s.toml")
    (inside / "w.toml").write_text((inside / "s.toml").read_text() + WEBCAM)
    y, x = np.mgrid[0:120, 0:160]
    picture = np.stack([x, y, 255 - x], axis=-1).astype(np.uint8)
    cv2.imwrite(str(inside / "p.png"), picture)
    (inside / "t.png").write_bytes((inside / "p.png").read_bytes())
    (inside / "m.csv").write_text(f"webcam,time_utc,path\nhut,{TIME.replace('Z', ':00Z')},p.png\n")
    return folder


WEBCAM = """
[[webcam]]
id = "hut"
name = "Hut"
latitude_deg = 46.5405
longitude_deg = 7.98
above_ground_m = 5.0
projection = "perspective"
heading_deg = 0.0
horizontal_fov_deg = 60.0
width_px = 160
height_px = 120
time_zone = "Europe/Zurich"
"""
