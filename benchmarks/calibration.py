"""How well webcams are calibrated: matched points, the skyline alone, and two real photographs.

    python benchmarks/calibration.py [--quick] [--seed N] [--json FILE] [--figures FOLDER]

Synthetic trials come first, since only there the truth is known. The real photographs need SEASONSCAPES_DATA (or
``../shared/data``); without it they are left out and said to be.
"""

from __future__ import annotations

import argparse
import csv
import os
import secrets
import sys
import time
from pathlib import Path

import numpy as np
from record import write_record

from seasonscapes.calibration.evidence import Correspondences, Priors
from seasonscapes.calibration.overlay import save_overlay
from seasonscapes.calibration.pose_model import parameters_of_view
from seasonscapes.calibration.resection import ResectionOptions, leave_one_out, resect
from seasonscapes.calibration.skyline import SearchRange, align_to_skyline
from seasonscapes.cameras.pinhole import camera_at
from seasonscapes.evaluation.calibration_pictures import picture_trial
from seasonscapes.evaluation.calibration_trials import point_trial, score_points
from seasonscapes.frames import LocalFrame, enu_from_geodetic
from seasonscapes.images import read_image_srgb8
from seasonscapes.terrain.crs import geodetic_from_map
from seasonscapes.terrain.raster import read_elevation

TRIAL_SEARCH = SearchRange(priors=Priors(tilt_deg=2.0, roll_deg=1.0, horizontal_m=3.0, vertical_m=2.0, focal=0.0))
SQUARES = ResectionOptions(loss="squares")


def apart(a: float, b: float) -> float:
    """Angle between two headings [deg]."""
    return abs((a - b + 180.0) % 360.0 - 180.0)


def by_points(trials: int, seed: int) -> dict:
    """12 points, 1 px of noise, a fifth wrong, a start 5° and 30 m off."""
    numbers = {}
    for name, panoramic in (("panorama", True), ("photo", False)):
        rng = np.random.default_rng(seed)
        scores = [score_points(point_trial(rng, panoramic=panoramic), noise_px=1.0) for _ in range(trials)]
        heading = np.array([s.heading_error_deg for s in scores])
        numbers |= {
            f"points_{name}_heading_median_deg": np.median(heading),
            f"points_{name}_heading_p95_deg": np.quantile(heading, 0.95),
            f"points_{name}_heading_under_0.02_share": np.mean(heading < 0.02),
            f"points_{name}_focal_under_0.2pc_share": np.mean([s.focal_error < 0.002 for s in scores]),
            f"points_{name}_two_sigma_coverage": np.mean([s.within_two_sigma for s in scores]),
            f"points_{name}_wrong_all_found_share": np.mean([s.outliers_found for s in scores]),
        }
    numbers["heading_error_deg"] = numbers["points_panorama_heading_median_deg"]
    return numbers


def by_skyline(trials: int, seed: int) -> dict:
    """Hazy pictures with something standing before them, starts within ±10°; then fog, which has to be noticed."""
    errors, trusted, seconds = [], [], []
    for index in range(trials):
        trial = picture_trial(np.random.default_rng([seed, index]))
        began = time.perf_counter()
        fit = align_to_skyline(
            trial.image, trial.start, trial.rasters, trial.frame, mask=trial.mask, search=TRIAL_SEARCH
        )
        seconds.append(time.perf_counter() - began)
        errors.append(_error(fit, trial))
        trusted.append(fit.reliable)
        if errors[-1] >= 0.1 or not fit.reliable:
            print(f"  trial {index}: {errors[-1]:.3f}°, {'trusted' if fit.reliable else '; '.join(fit.doubts)}")
    errors, trusted = np.array(errors), np.array(trusted)
    fooled = 0
    fogs = max(5, trials // 4)
    for index in range(fogs):
        rng = np.random.default_rng([seed, 1_000_000 + index])
        trial = picture_trial(rng, visibility_m=float(np.exp(rng.uniform(np.log(200.0), np.log(5000.0)))))
        fit = align_to_skyline(
            trial.image, trial.start, trial.rasters, trial.frame, mask=trial.mask, search=TRIAL_SEARCH
        )
        fooled += bool(fit.reliable and _error(fit, trial) >= 0.1)
    return {
        "skyline_success_rate": np.mean(errors < 0.1),
        "skyline_heading_median_deg": np.median(errors),
        "skyline_failures_not_flagged": int(np.sum((errors >= 0.1) & trusted)),
        "skyline_trusted_share": np.mean(trusted),
        "skyline_seconds_median": np.median(seconds),
        "fog_trials": fogs,
        "fog_failures_not_flagged": fooled,
    }


def _error(fit, trial) -> float:
    if fit.calibration is None:
        return 180.0
    return apart(fit.calibration.parameters[0], parameters_of_view(trial.truth, fit.horizon.axes)[0])


def finse(folder: Path, figures: Path | None) -> dict:
    """Webcam of Finse: 45 points with one radial term, then its skyline alone from a start 5° off."""
    rows = list(csv.DictReader((folder / "gcps.csv").read_text().splitlines()))
    at = geodetic_from_map("EPSG:25832", _column(rows, "x_world"), _column(rows, "y_world"))
    latitude, longitude = (float(v) for v in geodetic_from_map("EPSG:25832", 419169.2, 6718421.3))
    frame = LocalFrame(latitude, longitude, 0.0, 0.13)
    points = Correspondences(
        np.stack([_column(rows, "x_img"), _column(rows, "y_img")], -1),
        enu_from_geodetic(frame, *at, _column(rows, "z_world")),
        tuple(r["name"] for r in rows),
    )
    start = camera_at(frame, latitude, longitude, 1212.0, heading_deg=66.0, fov_deg=65.8, size_px=(1920, 1080))
    priors = Priors(k1=np.inf)
    everyone = resect(start, points, priors=priors, options=SQUARES)
    robust = resect(start, points, priors=priors)
    left_out = leave_one_out(start, points, priors=priors, options=SQUARES)
    rasters = [read_elevation(folder / "dsm_4m.tif"), read_elevation(folder / "dem_context_aster_100m.tif")]
    search = SearchRange(
        tilt_deg=10.0,
        focal=0.06,
        priors=Priors(tilt_deg=10.0, roll_deg=3.0, horizontal_m=3.0, vertical_m=3.0, focal=0.05, k1=0.1),
        k1=-0.2,
    )
    image = read_image_srgb8(folder / "2019-05-24_12-00-01.jpg")
    mask = np.ones(image.shape[:2], bool)
    mask[:60] = False
    fit = align_to_skyline(image, start, rasters, frame, mask=mask, search=search)
    if figures:
        save_overlay(
            figures / "finse_points.png", image, robust, points=points, horizon=fit.horizon, title="Finse, points"
        )
        save_overlay(
            figures / "finse_skyline.png", image, fit.calibration, horizon=fit.horizon, title="Finse, skyline alone"
        )
    return {
        "finse_rms_px": everyone.rms_px,
        "finse_inlier_rms_px": robust.inlier_rms_px,
        "finse_leave_one_out_px": float(np.sqrt(np.mean(np.sum(left_out**2, axis=1)))),
        "finse_skyline_minus_points_deg": apart(fit.calibration.parameters[0], robust.parameters[0]),
        "finse_skyline_sigma_deg": fit.heading_sigma_deg,
        "finse_skyline_trusted": int(fit.reliable),
    }


def aletsch(folder: Path, figures: Path | None) -> dict:
    """The 1890s photograph of the Aletsch glacier from its KML start, both ways with the same trust in its position."""
    rows = list(csv.DictReader((folder / "gcps.csv").read_text().splitlines()))
    frame = LocalFrame(46.4314217, 8.0932999, 0.0, 0.13)
    points = Correspondences(
        np.stack([_column(rows, "col_px"), _column(rows, "row_px")], -1),
        enu_from_geodetic(frame, *(_column(rows, n) for n in ("lat_deg", "lon_deg", "z_m"))),
    )
    start = camera_at(
        frame, 46.4314217, 8.0932999, 2929.0, heading_deg=-63.37, pitch_deg=-11.28, fov_deg=63.08, size_px=(1024, 763)
    )
    rasters, numbers = [read_elevation(folder / "dem_aster_25m.tif")], {}
    image = read_image_srgb8(folder / "photo_07861v.jpg")
    for sigma_m in (5.0, 10.0):
        priors = Priors(horizontal_m=sigma_m, vertical_m=sigma_m)
        solved = resect(start, points, priors=priors, options=SQUARES)
        search = SearchRange(
            heading_deg=10.0,
            tilt_deg=5.0,
            focal=0.18,
            terrain_sigma_m=15.0,
            priors=Priors(tilt_deg=5.0, roll_deg=2.0, horizontal_m=sigma_m, vertical_m=sigma_m, focal=0.1),
        )
        fit = align_to_skyline(image, start, rasters, frame, search=search)
        numbers[f"aletsch_skyline_minus_points_deg_gps{sigma_m:.0f}m"] = apart(
            fit.calibration.parameters[0], solved.parameters[0]
        )
        numbers[f"aletsch_points_sigma_deg_gps{sigma_m:.0f}m"] = solved.sigma["heading_deg"]
    free = resect(start, points, priors=Priors(horizontal_m=np.inf, vertical_m=np.inf), options=SQUARES)
    numbers["aletsch_rms_px"] = free.rms_px
    if figures:
        save_overlay(figures / "aletsch_points.png", image, free, points=points, title="Aletsch, points")
        save_overlay(
            figures / "aletsch_skyline.png", image, fit.calibration, horizon=fit.horizon, title="Aletsch, skyline alone"
        )
    return numbers


def _column(rows: list[dict], name: str) -> np.ndarray:
    return np.array([float(row[name]) for row in rows])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer trials: within five minutes on two cores")
    parser.add_argument("--seed", type=int, default=None, help="drawn at run time when left out")
    parser.add_argument("--json", type=Path, default=None, help="write the numbers to this file")
    parser.add_argument("--figures", type=Path, default=None, help="write overlays into this folder")
    arguments = parser.parse_args()
    seed = secrets.randbelow(2**31) if arguments.seed is None else arguments.seed
    print(f"seed {seed}")
    numbers = by_points(60 if arguments.quick else 200, seed) | by_skyline(12 if arguments.quick else 100, seed)
    data = Path(os.environ.get("SEASONSCAPES_DATA") or Path(__file__).parents[2] / "shared" / "data")
    for name, benchmark in (("finse-webcam", finse), ("aletsch-photo", aletsch)):
        if (data / name).is_dir():
            numbers |= benchmark(data / name, arguments.figures)
        else:
            print(f"{name}: not found below {data}, left out")
    numbers = {key: float(value) for key, value in numbers.items()}
    for key, value in numbers.items():
        print(f"{key:44s} {value:10.4f}")
    write_record(arguments.json, numbers, seed=seed)
    return 0


if __name__ == "__main__":
    sys.exit(main())
