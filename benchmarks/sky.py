"""The atmosphere against independent sources: SPECTRL2, a brute-force path tracer, quadrature, the USNO's fits.

    python benchmarks/sky.py [--quick] [--seed N] [--json FILE] [--plots FOLDER]

``--quick`` takes fewer heights, directions and random walks. The seed draws the random walks and nothing else.

Numbers: ``direct_error_max`` and ``diffuse_error_max`` against pvlib's SPECTRL2 weighted by V(λ), elevations 10 to 75°,
aerosol optical depths 0.05 to 0.4, heights 0 to 3500 m; ``altitude_*_error_max`` for the ratio of 3500 m to 500 m;
``oracle_*`` for the luminance of the sky in 30 directions under six suns, with the oracle's own standard error;
``step_max`` for the largest jump of global illuminance between neighbouring 0.1° of the sun's elevation from +20 to
-18°, beyond the smooth course (a step less the mean of the steps before and after it), and ``step_raw_zero`` for the
largest step itself within 1° of the horizon, beside ``step_raw_zero_usno`` of the Explanatory Supplement's fit;
``twilight_factor_max`` from ``benchmarks/sky_night.py``.
"""

from __future__ import annotations

import argparse
import json
import secrets
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

sys.path.append(str(Path(__file__).parents[1] / "tests"))
sys.path.append(str(Path(__file__).parent))
from atmosphere_cases import (
    SPECTRL2_AEROSOL,
    against_oracle,
    chromaticity,
    dense_airlight,
    energy_imbalance,
    global_illuminance_lx,
    homogeneous,
    our_illuminance_lx,
    spectrl2_illuminance_lx,
    steps_beyond_trend,
    tables_of,
)
from record import write_record

from seasonscapes.frames import direction_from_angles
from seasonscapes.sky.atmosphere import Atmosphere
from seasonscapes.sky.clear_sky import atmosphere_tables, illumination_from_atmosphere, sky_radiance_map
from seasonscapes.sky.illumination import luminance

try:
    from sky_night import night_numbers, night_rows, print_rows
except ImportError as missing:  # the night's part stands alone
    if missing.name != "sky_night":
        raise
    night_rows = None

SPECTRL2_ELEVATIONS_DEG = (10.0, 15.0, 20.0, 30.0, 45.0, 60.0, 75.0)
ORACLE_SUNS_DEG = (60.0, 30.0, 10.0, 3.0, 0.0, -4.0)
ORACLE_ELEVATIONS_DEG, ORACLE_AZIMUTHS_DEG = (1.5, 5.0, 12.0, 25.0, 50.0, 80.0), (0.0, 40.0, 90.0, 135.0, 180.0)


def day_numbers(quick: bool, seed: int) -> dict[str, float]:
    """Direct and diffuse illuminance against SPECTRL2."""
    heights, depths = ((0.0, 3500.0), (0.05, 0.4)) if quick else ((0.0, 1000.0, 2000.0, 3500.0), (0.05, 0.1, 0.2, 0.4))
    direct, diffuse = [], []
    print("height  AOD   deviation from SPECTRL2 [%] at sun " + " ".join(f"{e:.0f}°" for e in SPECTRL2_ELEVATIONS_DEG))
    for height in heights:
        for depth in depths:
            tables = atmosphere_tables(Atmosphere(depth, ground_height_m=height, **SPECTRL2_AEROSOL))
            found = np.array([our_illuminance_lx(tables, e, height) for e in SPECTRL2_ELEVATIONS_DEG])
            expected = np.array([spectrl2_illuminance_lx(e, depth, height) for e in SPECTRL2_ELEVATIONS_DEG])
            deviation = found / expected - 1.0
            direct.append(deviation[:, 0]), diffuse.append(deviation[:, 1])
            for name, column in (("direct ", deviation[:, 0]), ("diffuse", deviation[:, 1])):
                print(f"{height:6.0f}  {depth:.2f}  {name} " + " ".join(f"{100 * d:6.1f}" for d in column), flush=True)
    return {
        "direct_error_max": float(np.abs(direct).max()),
        "diffuse_error_max": float(np.abs(diffuse).max()),
        "diffuse_error_mean": float(np.abs(diffuse).mean()),
    }


def altitude_numbers(quick: bool, seed: int) -> dict[str, float]:
    """Ratios of 3500 m to 500 m in one atmosphere against SPECTRL2's."""
    tables, heights, worst, zenith = tables_of(), (500.0, 3500.0), [], {}
    air = tables.atmosphere
    for elevation in (15.0, 30.0, 60.0, 75.0):
        found = np.array([our_illuminance_lx(tables, elevation, height) for height in heights])
        above = [air.aerosol_optical_depth_500nm * np.exp(-h / air.aerosol_scale_height_m) for h in heights]
        expected = np.array(
            [
                spectrl2_illuminance_lx(elevation, depth, height, angstrom_exponent=air.angstrom_exponent)
                for depth, height in zip(above, heights, strict=True)
            ]
        )
        ratio, theirs = found[1] / found[0], expected[1] / expected[0]
        sun = direction_from_angles(0.0, elevation)
        top = [luminance(sky_radiance_map(tables, sun, h, shape=(64, 8))[0].mean(0)) for h in heights]
        zenith[elevation] = float(top[1] / top[0])
        worst.append(np.abs(ratio / theirs - 1.0))
        print(
            f"3500 m over 500 m, sun {elevation:.0f}°: direct {ratio[0]:.3f} (SPECTRL2 {theirs[0]:.3f}), diffuse "
            f"{ratio[1]:.3f} ({theirs[1]:.3f}), zenith {zenith[elevation]:.3f}",
            flush=True,
        )
    return {
        "altitude_direct_error_max": float(np.max(worst, axis=0)[0]),
        "altitude_diffuse_error_max": float(np.max(worst, axis=0)[1]),
        "altitude_zenith_ratio_sun30": zenith[30.0],
    }


def colour_numbers(quick: bool, seed: int) -> dict[str, float]:
    """Chromaticities of zenith, horizon and airlight."""
    with_ozone, without, numbers = tables_of(), tables_of(ozone_du=0.0), {}

    def note(name: str, rgb: np.ndarray) -> None:
        x, y = chromaticity(rgb)
        numbers[f"{name}_x"], numbers[f"{name}_y"] = float(x), float(y)
        print(f"{name:28s} x {x:.4f}  y {y:.4f}", flush=True)

    for elevation, name in ((60.0, "noon"), (-6.0, "dusk")):
        sun = direction_from_angles(0.0, elevation)
        for tables, air in ((with_ozone, ""), (without, "_no_ozone")):
            note(f"zenith_{name}{air}", sky_radiance_map(tables, sun, 500.0, shape=(64, 8))[0].mean(0))
    note("horizon_under_setting_sun", sky_radiance_map(with_ozone, direction_from_angles(0, 0), 500.0)[63, 0])
    air = illumination_from_atmosphere(with_ozone, direction_from_angles(0.0, 45.0), 2000.0).aerial_perspective
    note("airlight_30km", air(np.array(3e4), direction_from_angles(90.0, 0.0))[1])
    return numbers


def air_numbers(quick: bool, seed: int) -> dict[str, float]:
    """Aerial perspective against quadrature and closed forms; energy."""
    tables, errors, gaps = tables_of(), [], []
    for elevation in (60.0, 10.0, 1.0, -4.0):
        sun = direction_from_angles(0.0, elevation)
        for height in (2.0, 500.0, 2500.0):
            light = illumination_from_atmosphere(tables, sun, height, shape=(8, 16)).aerial_perspective
            for e in (-8.0, -3.0, -1.0, 0.0, 0.5, 2.0, 5.0, 15.0):
                for azimuth in (5.0, 60.0, 140.0, 180.0):
                    direction = direction_from_angles(azimuth, e)
                    # Below the horizon only as far as a ray may go before it is well under the ground.
                    reach = np.inf if e > -0.5 else 0.9 * (height + 1000.0) / np.sin(np.radians(-e))
                    for distance in (300.0, 2e3, 1e4, 4e4, 1e5):
                        if distance < reach:
                            exact = luminance(dense_airlight(tables, sun, height, direction, distance))
                            errors.append(luminance(light(np.array(distance), direction)[1]) / exact - 1.0)
            for azimuth in (5.0, 90.0, 180.0):
                level = direction_from_angles(azimuth, 0.0)
                far, endless = (luminance(light(np.array(d), level)[1]) for d in (1.25e6, np.inf))
                gaps.append(far / endless - 1.0)
    grey = tables_of(**vars(homogeneous(50e3)), max_orders=1)
    air = illumination_from_atmosphere(grey, direction_from_angles(0, 40), 300.0, shape=(8, 16)).aerial_perspective
    distance = np.geomspace(100.0, 1e5, 30)
    transmittance = air(distance, np.broadcast_to(direction_from_angles(20.0, 2.0), (30, 3)))[0][:, 1]
    white = tables_of(refraction=False, ozone_du=0.0, single_scattering_albedo=1.0, ground_albedo=1.0)
    numbers = {
        "aerial_error_max": float(np.abs(errors).max()),
        "aerial_error_mean": float(np.abs(errors).mean()),
        "aerial_horizon_gap_max": float(np.abs(gaps).max()),
        "koschmieder_error_max": float(np.abs(transmittance / np.exp(-3.912 * distance / 50e3) - 1.0).max()),
        "energy_error_max": float(np.abs(energy_imbalance(white)).max()),
    }
    print("\n".join(f"{name:28s} {value:.5f}" for name, value in numbers.items()), flush=True)
    return numbers


def oracle_numbers(quick: bool, seed: int) -> dict[str, float]:
    """Luminance of the sky against random walks. The walks grow where the oracle is noisy."""
    tables, numbers, everything = tables_of(refraction=False), {}, []
    azimuths = ORACLE_AZIMUTHS_DEG[::2] if quick else ORACLE_AZIMUTHS_DEG
    elevations = ORACLE_ELEVATIONS_DEG[::2] if quick else ORACLE_ELEVATIONS_DEG
    suns = ORACLE_SUNS_DEG if quick else (*ORACLE_SUNS_DEG, -6.0)
    for sun in suns:
        rows = []
        for e in elevations:
            for azimuth in azimuths:
                paths, direction = 4096 if quick else 8192, direction_from_angles(azimuth, e)
                deviation, noise = against_oracle(tables, sun, direction, paths=paths, seed=seed + 2 * len(rows))
                while noise > (0.02 if quick else 0.01) and paths < (16384 if quick else 131072):
                    paths *= 4
                    deviation, noise = against_oracle(tables, sun, direction, paths=paths, seed=seed + 2 * len(rows))
                rows.append((deviation, noise))
        rows = np.array(rows)
        print(
            f"sun {sun:5.1f}°: deviation max {100 * np.abs(rows[:, 0]).max():.1f} %, mean "
            f"{100 * np.abs(rows[:, 0]).mean():.1f} %, signed mean {100 * rows[:, 0].mean():+.1f} %; the oracle's own "
            f"standard error up to {100 * rows[:, 1].max():.1f} %",
            flush=True,
        )
        name = f"oracle_error_max_sun{sun:+.0f}"
        numbers[name] = float(np.abs(rows[:, 0]).max())
        if sun in ORACLE_SUNS_DEG:
            everything.append(rows)
    rows = np.concatenate(everything)
    return numbers | {
        "oracle_error_max": float(np.abs(rows[:, 0]).max()),
        "oracle_error_mean": float(np.abs(rows[:, 0]).mean()),
        "oracle_noise_max": float(rows[:, 1].max()),
        "oracle_within_5_percent": float((np.abs(rows[:, 0]) < 0.05).mean()),
    }


def step_numbers(quick: bool, seed: int) -> dict[str, float]:
    """Continuity of global horizontal illuminance through sunset and twilight."""
    import oracles_usno

    elevations = np.round(np.arange(20.0, -18.05, -0.1), 3)
    light = np.array([global_illuminance_lx(tables_of(), e) for e in elevations])
    beyond, raw = steps_beyond_trend(light), np.abs(np.diff(np.log(light)))
    near = (np.abs(elevations[1:]) < 1.05) & (np.abs(elevations[:-1]) < 1.05)
    usno = np.array([oracles_usno.supplement_sun_lx(e) for e in np.arange(1.0, -0.85, -0.1)])
    numbers = {
        "step_max": float(beyond.max()),
        "step_max_near_zero": float(beyond[np.abs(elevations[1:-2]) < 1.05].max()),
        "step_raw_zero": float(raw[near].max()),
        "step_raw_max": float(raw.max()),
        "step_raw_zero_usno": float(np.abs(np.diff(np.log(usno))).max()),
    }
    print("\n".join(f"{name:28s} {value:.4f}" for name, value in numbers.items()), flush=True)
    return numbers


def speed_numbers(quick: bool, seed: int) -> dict[str, float]:
    """Seconds of the clock for the tables, for a new instant, and for one megapixel of aerial perspective."""
    started = time.perf_counter()
    tables = atmosphere_tables(Atmosphere(0.11))
    seconds_tables = time.perf_counter() - started
    started = time.perf_counter()
    light = illumination_from_atmosphere(tables, direction_from_angles(0.0, 20.0), 1234.0)
    first, taken = time.perf_counter() - started, []
    for elevation in np.linspace(70.0, -10.0, 9):
        started, busy = time.perf_counter(), time.process_time()
        illumination_from_atmosphere(tables, direction_from_angles(100.0, elevation), 1234.0)
        taken.append((time.perf_counter() - started, time.process_time() - busy))
    random = np.random.default_rng(seed)
    direction = direction_from_angles(random.uniform(0, 60, 1_000_000), random.uniform(-15, 10, 1_000_000))
    depth, started = random.uniform(10.0, 6e4, 1_000_000), time.perf_counter()
    light.aerial_perspective(depth, direction)
    numbers = {
        "seconds_tables": seconds_tables,
        "seconds_first_illumination": first,
        "seconds_per_illumination": float(np.median(taken, axis=0)[0]),
        "processor_seconds_per_illumination": float(np.median(taken, axis=0)[1]),
        "seconds_per_megapixel_of_aerial_perspective": time.perf_counter() - started,
    }
    print("\n".join(f"{name:44s} {value:.3f}" for name, value in numbers.items()), flush=True)
    return numbers


def night_part(quick: bool, seed: int) -> dict[str, float]:
    """Twilight and moonlight against the USNO's fits, where that part is there."""
    if night_rows is None:
        return {}
    rows = night_rows()
    print_rows(rows)
    return night_numbers(rows)


PARTS: dict[str, Callable[[bool, int], dict[str, float]]] = {
    "speed": speed_numbers,
    "day": day_numbers,
    "altitude": altitude_numbers,
    "colour": colour_numbers,
    "air": air_numbers,
    "steps": step_numbers,
    "oracle": oracle_numbers,
    "night": night_part,
}


def plot_domes(folder: Path) -> None:
    """Fish-eye pictures of the sky from noon to deep twilight, north on top and the sun in the south."""
    from seasonscapes.images import auto_exposure_ev100, expose, tone_curve, write_png
    from seasonscapes.sky.observer_radiance import observed_sky, observer_view, sky_radiance

    across = (np.arange(480) + 0.5) / 240.0 - 1.0
    east, north = np.meshgrid(across, -across)
    radius = np.hypot(east, north)
    direction = direction_from_angles(np.degrees(np.arctan2(east, north)), 90.0 * (1.0 - np.minimum(radius, 1.0)))
    pictures = []
    for elevation in (60.0, 10.0, 0.0, -4.0, -8.0):
        sun = direction_from_angles(180.0, elevation)
        view = observer_view(tables_of(), 500.0)
        sky = sky_radiance(observed_sky(tables_of(), view, sun, np.radians(elevation), np.ones(9)), direction)
        inside = radius < 1.0
        picture = tone_curve(expose(sky.astype(np.float32), auto_exposure_ev100(sky, inside)))
        pictures.append(np.where(inside[..., None], picture, 0.0))
    write_png(folder / "sky_domes.png", np.concatenate(pictures, axis=1))


def main() -> None:
    """Run all parts, or those named."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="fewer cases, within five minutes on two cores")
    parser.add_argument("--seed", type=int, default=None, help="of the random walks; drawn where left out")
    parser.add_argument("--json", type=Path, help="write the numbers to a file")
    parser.add_argument("--plots", type=Path, help="write pictures of the dome into a folder")
    parser.add_argument("--parts", nargs="+", choices=list(PARTS), default=list(PARTS))
    arguments = parser.parse_args()
    seed = secrets.randbelow(2**31) if arguments.seed is None else arguments.seed
    numbers: dict[str, float] = {"seed": seed}
    for name in arguments.parts:
        print(f"\n== {name}", flush=True)
        started = time.perf_counter()
        numbers |= PARTS[name](arguments.quick, seed)
        print(f"   ({time.perf_counter() - started:.0f} s)", flush=True)
    if arguments.plots:
        arguments.plots.mkdir(parents=True, exist_ok=True)
        plot_domes(arguments.plots)
    print(json.dumps(numbers, indent=2))
    write_record(arguments.json, numbers, seed=seed)


if __name__ == "__main__":
    main()
