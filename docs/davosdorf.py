"""Davos Dorf and the Weissfluh at four hours, from a 10 m raster of heights and an orthophoto with the shadows of noon in it.

``python docs/davosdorf.py FOLDER -o OUTPUT``, where FOLDER holds ``davosdorf.tif`` (heights) and ``davosdorf_color.tif``, as
in https://github.com/ethz-asl/terrain-navigation (``resources``; heights and image by swisstopo). The hour of the orthophoto
is not recorded; its sun was fitted to its shadows. Neither rasters nor pictures belong to this project.
"""

from __future__ import annotations

import argparse
import shutil
from pathlib import Path

import numpy as np

import seasonscapes as ss

# Sun of the orthophoto: azimuth and elevation [deg].
SUN_DEG = (175.0, 41.0)
TIMES = ("2024-09-20T07:30", "2024-09-20T10:00", "2024-09-20T13:20", "2024-09-20T18:15")
SCENE = f"""name = "davosdorf"
title = "Davos Dorf and Weissfluh"
attribution = "Source: Federal Office of Topography swisstopo"
vertical_datum = "LN02"

[elevation]
file = "davosdorf.tif"

[imagery]
file = "davosdorf_color.tif"
sun_deg = [{SUN_DEG[0]}, {SUN_DEG[1]}]
land_classes = 8

[[camera]]
name = "weissfluh"
latitude_deg = 46.802
longitude_deg = 9.845
height_m = 2900.0
heading_deg = 300.0
pitch_deg = -14.0
fov_deg = 60.0
"""


def main() -> None:
    """Write one picture for each hour, and all in one sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="with davosdorf.tif and davosdorf_color.tif")
    parser.add_argument("-o", "--output", type=Path, default=Path("out/davosdorf"))
    parser.add_argument("--size", type=int, nargs=2, default=(960, 640), metavar=("WIDTH", "HEIGHT"))
    args = parser.parse_args()
    missing = [name for name in ("davosdorf.tif", "davosdorf_color.tif") if not (args.folder / name).is_file()]
    if missing:
        parser.error(f"{args.folder}: no {' and no '.join(missing)}; see the top of this file for where they are")
    args.output.mkdir(parents=True, exist_ok=True)
    for name in ("davosdorf.tif", "davosdorf_color.tif"):
        shutil.copyfile(args.folder / name, args.output / name)
    scene = args.output / "davosdorf.toml"
    scene.write_text(SCENE, encoding="utf-8")
    place = ss.load_place(scene)
    session = ss.relight_session(place, ss.camera(place, "weissfluh", size_px=tuple(args.size)))
    pictures = []
    for time in TIMES:
        pictures.append(ss.develop(ss.relight(session, time)))
        ss.save_png(args.output / f"{time.replace(':', '')}.png", pictures[-1])
    ss.save_png(args.output / "sheet.png", np.vstack([np.hstack(pictures[:2]), np.hstack(pictures[2:])]))
    print(args.output / "sheet.png")


if __name__ == "__main__":
    main()
