"""Sun and sky against instruments: direct normal, diffuse and global irradiance by the minute on cloudless days.

    python benchmarks/light_series.py [--quick] [--seed N] [--data FOLDER] [--json FILE] [--plot FILE]

One number a day is fitted, the aerosol's optical depth, to direct sunlight at every tenth minute; all other minutes
with the sun above 5° are judged. Precipitable water follows from the measured temperature and humidity (pvlib's
`gueymard94_pw`), the ground's albedo from the measured upward and downward light where a station has both. Beside ours in the same
run, fitted to the same minutes: the clear-sky model of Ineichen & Perez (by its Linke turbidity) and the broadband model
of Bird & Hulstrom (by its optical depth), both as pvlib has them. ``--quick`` judges every fifth of those minutes.
The measurements are SURFRAD (NOAA) and MIDC (NREL) days in ``light-series`` of the data folder; without it this ends
with a reason. ``--seed`` chooses which tenth of the minutes is fitted.
"""

from __future__ import annotations

import argparse
import csv
import os
import secrets
import sys
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pandas as pd
import pvlib
from record import write_record
from scipy.optimize import minimize_scalar

from seasonscapes.sky.atmosphere import optics
from seasonscapes.sky.broadband import clear_efficacies_lm_w
from seasonscapes.sky.clear_sky import true_elevation_deg
from seasonscapes.sky.curved_rays import sun_columns, sun_transfer
from seasonscapes.sky.ephemeris import SolarPosition, at_index, sun_position
from seasonscapes.sky.illuminate import illuminate
from seasonscapes.sky.illumination import diffuse_horizontal_illuminance, luminance
from seasonscapes.sky.models import AtmosphereModel, atmosphere_from_model, read_sky_model
from seasonscapes.sky.spectrum import rgb_from_transfer

LOWEST_SUN_DEG = 5.0
FIT_EVERY = 10
# The sun goes behind a ridge, or a cloud passes, where direct sunlight changes by more in a minute [W/m²].
JUMP_W_M2 = 25.0
JUMP_MINUTES = 4


@dataclass(frozen=True)
class Day:
    """Measurements of one day [W/m²] and what is known of its air and ground."""

    name: str
    latitude_deg: float
    longitude_deg: float
    height_m: float
    times: list[datetime]
    direct: np.ndarray
    diffuse: np.ndarray
    total: np.ndarray
    good: np.ndarray
    water_cm: float
    ground_albedo: float


def surfrad(path: Path) -> Day:
    """A daily file of NOAA's SURFRAD network; see its README for the columns."""
    lines = path.read_text().splitlines()
    place = [float(value) for value in lines[1].split()[:3]]
    rows = np.array([line.split()[:48] for line in lines[2:]], float)
    times = [datetime(*(int(row[k]) for k in (0, 2, 3, 4, 5)), tzinfo=UTC) for row in rows]
    flagged = (rows[:, [9, 11, 13, 15]] != 0).any(axis=1)
    light = rows[:, 8] > 50.0
    temperature, humidity = rows[:, 38], rows[:, 40]
    known = light & (temperature > -100.0) & (humidity >= 0.0)
    water = pvlib.atmosphere.gueymard94_pw(temperature[known], humidity[known])
    albedo = float(np.median(rows[light & ~flagged, 10] / rows[light & ~flagged, 8]))
    longitude = place[1] if place[1] < 0.0 else -place[1]
    return Day(
        "SURFRAD Alamosa", place[0], longitude, place[2], times, rows[:, 12], rows[:, 14], rows[:, 8],
        ~flagged, float(np.median(water)), albedo,
    )  # fmt: skip


def midc(path: Path) -> Day:
    """A day of NREL's MIDC station at Tucson, Arizona; mountain standard time."""
    rows = list(csv.DictReader(path.open()))
    start = datetime(int(rows[0]["Year"]), 1, 1, tzinfo=UTC) + timedelta(hours=7, days=int(rows[0]["DOY"]) - 1)
    times = [start + timedelta(hours=int(row["MST"]) // 100, minutes=int(row["MST"]) % 100) for row in rows]

    def column(name: str) -> np.ndarray:
        return np.array([float(row[name]) for row in rows])

    total = column("Global Horiz (tracker) [W/m^2]")
    water = pvlib.atmosphere.gueymard94_pw(column("Air Temperature [deg C]"), column("Rel Humidity [%]"))
    return Day(
        "MIDC Tucson", 32.2297, -110.9553, 786.0, times, column("Direct Normal [W/m^2]"),
        column("Diffuse Horiz [W/m^2]"), total, total > -50.0, float(np.median(water[total > 50.0])), 0.2,
    )  # fmt: skip


def chosen_minutes(day: Day, elevation_deg: np.ndarray) -> np.ndarray:
    """Minutes ``(T,)`` of unflagged measurements with the sun above 5° and no ridge or cloud before it."""
    jump = np.abs(np.diff(day.direct, prepend=day.direct[0])) > JUMP_W_M2
    near = np.convolve(jump, np.ones(2 * JUMP_MINUTES + 1), "same") > 0
    shaded = day.direct < 0.6 * pd.Series(day.direct).rolling(121, center=True, min_periods=1).median().to_numpy()
    return day.good & (elevation_deg > LOWEST_SUN_DEG) & ~near & ~shaded


def station_model(day: Day) -> AtmosphereModel:
    """The clear sky with the station's ground, so that the optical depth is that above it."""
    base = read_sky_model("clear")
    assert isinstance(base, AtmosphereModel)
    ground = base.ground.model_copy(update={"height_m": day.height_m, "albedo": day.ground_albedo})
    return base.model_copy(update={"ground": ground, "water_cm": day.water_cm})


def with_depth(model: AtmosphereModel, depth: float) -> AtmosphereModel:
    return model.model_copy(update={"aerosol": model.aerosol.model_copy(update={"optical_depth_500nm": depth})})


def our_direct(model: AtmosphereModel, day: Day, sun: SolarPosition, minutes: np.ndarray) -> np.ndarray:
    """Direct normal irradiance ``(N,)`` [W/m²] at some minutes."""
    atmosphere = atmosphere_from_model(model)
    elevation_deg = np.asarray(sun.elevation_deg)[minutes]
    true_rad = np.radians(true_elevation_deg(atmosphere, elevation_deg, day.height_m))
    columns, depths = sun_columns(atmosphere), optics(atmosphere)
    transfer = [
        sun_transfer(atmosphere, columns, depths, np.asarray(day.height_m), angle, radius_deg=0.267)
        for angle in true_rad
    ]
    lux = luminance(np.asarray(transfer) @ rgb_from_transfer().T) / np.asarray(sun.distance_au)[minutes] ** 2
    efficacy = [
        clear_efficacies_lm_w(atmosphere, each, day.height_m, water_cm=day.water_cm)[0] for each in elevation_deg
    ]
    return lux / np.asarray(efficacy)


def our_diffuse(model: AtmosphereModel, day: Day, sun: SolarPosition, minutes: np.ndarray) -> np.ndarray:
    """Diffuse horizontal irradiance ``(N,)`` [W/m²] at some minutes."""
    received = []
    for index in minutes:
        light = illuminate(
            model, at_index(sun, int(index)), height_m=day.height_m, map_height=64, with_aerial_perspective=False
        )
        assert light.efficacy_lm_w is not None
        received.append(float(luminance(diffuse_horizontal_illuminance(light.sky_radiance))) / light.efficacy_lm_w[1])
    return np.asarray(received)


def rms(estimate: np.ndarray, measured: np.ndarray) -> float:
    """Root mean square error over the mean."""
    return float(np.sqrt(np.mean((estimate - measured) ** 2)) / measured.mean())


def fitted(error, low: float, high: float) -> float:
    return float(minimize_scalar(error, bounds=(low, high), method="bounded", options={"xatol": 1e-4}).x)


def rivals(day: Day, sun: SolarPosition, fit: np.ndarray, judged: np.ndarray) -> dict[str, tuple[np.ndarray, ...]]:
    """Direct, diffuse and global of pvlib's clear-sky models at the judged minutes, each fitted by one number."""
    zenith = 90.0 - np.asarray(sun.elevation_deg)
    mass = pvlib.atmosphere.get_relative_airmass(zenith)
    pressure = pvlib.atmosphere.alt2pres(day.height_m)
    extra = pvlib.irradiance.get_extra_radiation(day.times[0].timetuple().tm_yday)

    def ineichen(turbidity: float, at: np.ndarray):
        absolute = pvlib.atmosphere.get_absolute_airmass(mass[at], pressure)
        return pvlib.clearsky.ineichen(zenith[at], absolute, turbidity, altitude=day.height_m, dni_extra=extra)

    def bird(depth: float, at: np.ndarray):
        return pvlib.clearsky.bird(
            zenith[at], mass[at], 1.3 * depth, depth, day.water_cm, pressure=pressure, dni_extra=extra,
            albedo=day.ground_albedo,
        )  # fmt: skip

    found = {}
    for name, model, low, high in (("ineichen", ineichen, 1.0, 6.0), ("bird", bird, 0.001, 0.5)):

        def error(value: float, model=model) -> float:
            return rms(np.asarray(model(value, fit)["dni"]), day.direct[fit])

        answer = model(fitted(error, low, high), judged)
        found[name] = tuple(np.asarray(answer[key]) for key in ("dni", "dhi", "ghi"))
    return found


def clock_error_min(day: Day, model: AtmosphereModel, fit: np.ndarray) -> float:
    """Offset of the clock [min] under which direct sunlight fits best: the morning and the evening agree."""

    def error(minutes: float) -> float:
        times = [time + timedelta(minutes=minutes) for time in day.times]
        sun = sun_position(times, day.latitude_deg, day.longitude_deg, day.height_m)
        return rms(our_direct(model, day, sun, fit), day.direct[fit])

    return fitted(error, -15.0, 15.0)


def run(day: Day, *, quick: bool, seed: int) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    sun = sun_position(day.times, day.latitude_deg, day.longitude_deg, day.height_m)
    elevation = np.asarray(sun.elevation_deg)
    chosen = np.flatnonzero(chosen_minutes(day, elevation))
    offset = seed % FIT_EVERY
    fit = chosen[offset::FIT_EVERY]
    judged = np.setdiff1d(chosen, fit)[:: 5 if quick else 1]
    base = station_model(day)
    depth = fitted(lambda value: rms(our_direct(with_depth(base, value), day, sun, fit), day.direct[fit]), 0.002, 0.6)
    model = with_depth(base, depth)
    sine = np.sin(np.radians(elevation[judged]))
    direct, diffuse = our_direct(model, day, sun, judged), our_diffuse(model, day, sun, judged)
    measured = {"direct": day.direct[judged], "diffuse": day.diffuse[judged], "global": day.total[judged]}
    models = {"ours": (direct, diffuse, direct * sine + diffuse), **rivals(day, sun, fit, judged)}
    figures = {
        "optical_depth_500nm": depth,
        "water_cm": day.water_cm,
        "ground_albedo": day.ground_albedo,
        "minutes_fitted": len(fit),
        "minutes_judged": len(judged),
        "clock_error_min": clock_error_min(day, model, fit),
        "instruments_closure_rms": rms(measured["direct"] * sine + measured["diffuse"], measured["global"]),
    }
    for name, values in models.items():
        for kind, value in zip(measured, values, strict=True):
            figures[f"{name}_{kind}_rms"] = rms(value, measured[kind])
            figures[f"{name}_{kind}_bias"] = float(value.mean() / measured[kind].mean() - 1.0)
    series = {
        "elevation_deg": elevation[judged],
        "hour": np.array([day.times[i].hour + day.times[i].minute / 60 for i in judged]),
    }
    series |= {f"measured {kind}": value for kind, value in measured.items()}
    series |= {f"ours {kind}": value for kind, value in zip(measured, models["ours"], strict=True)}
    return figures, series


def print_table(name: str, figures: dict[str, float]) -> None:
    print(f"\n{name}: {figures['minutes_judged']:.0f} minutes judged, {figures['minutes_fitted']:.0f} fitted")
    print(
        f"  optical depth {figures['optical_depth_500nm']:.4f}, water {figures['water_cm']:.2f} cm, albedo "
        f"{figures['ground_albedo']:.2f}, clock {figures['clock_error_min']:+.2f} min, instruments agree within "
        f"{100 * figures['instruments_closure_rms']:.1f} %"
    )
    print(f"  {'':10} {'direct':>16} {'diffuse':>16} {'global':>16}   rms (bias)")
    for model in ("ours", "ineichen", "bird"):
        cells = [
            f"{100 * figures[f'{model}_{kind}_rms']:6.2f} % ({100 * figures[f'{model}_{kind}_bias']:+5.1f})"
            for kind in ("direct", "diffuse", "global")
        ]
        print(f"  {model:10} " + " ".join(f"{cell:>16}" for cell in cells))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--data", type=Path, default=None, help="default: $SEASONSCAPES_DATA or ../shared/data")
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--plot", type=Path, default=None)
    args = parser.parse_args()
    seed = secrets.randbelow(2**31) if args.seed is None else args.seed
    root = args.data or Path(os.environ.get("SEASONSCAPES_DATA", Path(__file__).parents[2] / "shared" / "data"))
    folder = root / "light-series"
    if not folder.is_dir():
        sys.exit(f"light_series: no measurements at {folder}; give --data FOLDER")
    days = [surfrad(folder / "surfrad-slv16001.dat"), midc(folder / "midc_raw_20181018.txt")]
    numbers: dict[str, float] = {"seed": seed}
    plots = {}
    for day in days:
        figures, plots[day.name] = run(day, quick=args.quick, seed=seed)
        print_table(day.name, figures)
        key = day.name.split()[0].lower()
        numbers |= {f"{key}_{name}": value for name, value in figures.items()}
    for kind in ("direct", "diffuse", "global"):
        numbers[f"{kind}_rms"] = max(numbers[f"{day.name.split()[0].lower()}_ours_{kind}_rms"] for day in days)
    print(
        "\nworse of both days: "
        + ", ".join(f"{k} {100 * numbers[f'{k}_rms']:.2f} %" for k in ("direct", "diffuse", "global"))
    )
    write_record(args.json, numbers, seed=seed)
    if args.plot:
        draw(args.plot, plots)


def draw(path: Path, plots: dict[str, dict[str, np.ndarray]]) -> None:
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, len(plots), figsize=(11, 4))
    for axis, (name, series) in zip(np.atleast_1d(axes), plots.items(), strict=True):
        for kind, colour in (("direct", "tab:orange"), ("diffuse", "tab:blue"), ("global", "tab:green")):
            axis.plot(series["hour"], series[f"measured {kind}"], ".", ms=2, color=colour, label=kind)
            axis.plot(series["hour"], series[f"ours {kind}"], color=colour, lw=1)
        axis.set(title=name, xlabel="hour (UTC)", ylabel="W/m²")
        axis.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    main()
