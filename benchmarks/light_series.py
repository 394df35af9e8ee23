"""Sun and sky against instruments: direct normal, diffuse and global irradiance by the minute on cloudless days.

    python benchmarks/light_series.py [--quick] [--seed N] [--data FOLDER] [--json FILE] [--plot FILE]

The air of a day is fitted to direct sunlight at every tenth minute: aerosol's optical depth, and the water above the station. All
other minutes with the sun above 5° are judged; diffuse and global light are never fitted. Water that follows from
temperature and humidity at the ground (pvlib's `gueymard94_pw`) is too much where moist air lies under an inversion: what
it gives, with the depth alone fitted, is printed beside (``humidity``). The ground's albedo follows from the measured upward
and downward light where a station has both. Beside ours in the same run, fitted to the same minutes: the clear-sky model of
Ineichen & Perez (by its Linke turbidity) and the broadband model of Bird & Hulstrom (by depth and water), both as pvlib has them. ``--quick`` judges every fifth of those minutes.
The measurements are SURFRAD (NOAA) and MIDC (NREL) days in ``light-series`` of the data folder; without it this ends
with a reason. ``--seed`` chooses which tenth of the minutes is fitted.
"""

from __future__ import annotations

import argparse
import csv
import os
import secrets
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pandas as pd
import pvlib
from record import write_record
from scipy.optimize import least_squares, minimize_scalar

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


def fitted_air(
    direct: Callable[[float, float], np.ndarray], measured: np.ndarray, water_cm: float
) -> tuple[float, float]:
    """Optical depth and water [cm] under which direct light ``direct(depth, water_cm)`` comes nearest to the measured."""

    def error(logs: np.ndarray) -> np.ndarray:
        return direct(*np.exp(logs)) / measured.mean() - measured / measured.mean()

    start = np.log([0.03, water_cm])
    low, high = np.log([0.001, 0.01]), np.log([0.6, 8.0])
    depth, water = np.exp(least_squares(error, start, bounds=(low, high), xtol=1e-4, diff_step=0.01).x)
    return float(depth), float(water)


def rivals(day: Day, sun: SolarPosition, fit: np.ndarray, judged: np.ndarray) -> dict[str, tuple[np.ndarray, ...]]:
    """Direct, diffuse and global of pvlib's clear-sky models at the judged minutes, fitted to the same minutes as ours."""
    zenith = 90.0 - np.asarray(sun.elevation_deg)
    mass = pvlib.atmosphere.get_relative_airmass(zenith)
    pressure = pvlib.atmosphere.alt2pres(day.height_m)
    extra = pvlib.irradiance.get_extra_radiation(day.times[0].timetuple().tm_yday)

    def ineichen(turbidity: float, at: np.ndarray):
        absolute = pvlib.atmosphere.get_absolute_airmass(mass[at], pressure)
        return pvlib.clearsky.ineichen(zenith[at], absolute, turbidity, altitude=day.height_m, dni_extra=extra)

    def bird(depth: float, water_cm: float, at: np.ndarray):
        return pvlib.clearsky.bird(
            zenith[at], mass[at], 1.3 * depth, depth, water_cm, pressure=pressure, dni_extra=extra,
            albedo=day.ground_albedo,
        )  # fmt: skip

    turbidity = fitted(lambda value: rms(np.asarray(ineichen(value, fit)["dni"]), day.direct[fit]), 1.0, 6.0)
    air = fitted_air(lambda *each: np.asarray(bird(*each, fit)["dni"]), day.direct[fit], day.water_cm)
    answers = {"ineichen": ineichen(turbidity, judged), "bird": bird(*air, judged)}
    return {name: tuple(np.asarray(each[key]) for key in ("dni", "dhi", "ghi")) for name, each in answers.items()}


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

    def of_air(depth: float, water_cm: float, at: np.ndarray) -> np.ndarray:
        moist = replace(day, water_cm=water_cm)
        return our_direct(with_depth(station_model(moist), depth), moist, sun, at)

    depth, water = fitted_air(lambda *air: of_air(*air, fit), day.direct[fit], day.water_cm)
    humid_depth = fitted(lambda value: rms(of_air(value, day.water_cm, fit), day.direct[fit]), 0.002, 0.6)
    sine = np.sin(np.radians(elevation[judged]))
    measured = {"direct": day.direct[judged], "diffuse": day.diffuse[judged], "global": day.total[judged]}
    models = {}
    for name, air in (("ours", (depth, water)), ("humidity", (humid_depth, day.water_cm))):
        moist = replace(day, water_cm=air[1])
        direct = of_air(*air, judged)
        diffuse = our_diffuse(with_depth(station_model(moist), air[0]), moist, sun, judged)
        models[name] = (direct, diffuse, direct * sine + diffuse)
    models |= rivals(day, sun, fit, judged)
    moist = replace(day, water_cm=water)
    figures = {
        "optical_depth_500nm": depth,
        "water_cm": water,
        "humidity_optical_depth_500nm": humid_depth,
        "humidity_water_cm": day.water_cm,
        "ground_albedo": day.ground_albedo,
        "minutes_fitted": len(fit),
        "minutes_judged": len(judged),
        "clock_error_min": clock_error_min(moist, with_depth(station_model(moist), depth), fit),
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
    for model in ("ours", "humidity", "ineichen", "bird"):
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
