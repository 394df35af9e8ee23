"""Twilight and moonlight against the published USNO fits; a part of ``benchmarks/sky.py``.

Two fits are published: the cubic polynomials of the Explanatory Supplement (Seidelmann 1992, § 9.3) and the program of
USNO Circular 171 (Janiczek & DeYoung 1987). Down to -11° they agree within 25 %; from -13° to -16° they differ by up
to a factor of three, as only the former contains the end of twilight, and for the full moon by 1.5. A row's factor is
that to the nearer of the two; both are printed.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from seasonscapes.sky.clear_sky import AtmosphereTables
from seasonscapes.sky.ephemeris import LunarPosition, SolarPosition, refraction_deg
from seasonscapes.sky.illuminate import SkyEvaluators, illuminate, tables_in_memory
from seasonscapes.sky.illumination import global_horizontal_illuminance, luminance
from seasonscapes.sky.models import SkyModel, read_sky_model

sys.path.append(str(Path(__file__).parents[1] / "tests"))
import oracles_usno as usno
from record import write_record

# Circular 171 gives what its Fortran does: apparent altitude down to the sunset's -5/6°, true altitude below.
_SUN_ALTITUDES_DEG = (*range(20, -1, -1), *range(-1, -19, -1))
_MOON_ALTITUDES_DEG = (10, 20, 30, 40, 50, 60)
FULL_MOON_PHASE_DEG, HALF_MOON_PHASE_DEG = 3.5, 90.0  # the moon passes the Earth's shadow by 3.5° on average


@dataclass(frozen=True)
class NightRow:
    """One comparison: what shines at which altitude [deg], and horizontal illuminance by us and by each fit [lx]."""

    source: str
    altitude_deg: float
    ours_lx: float
    supplement_lx: float
    circular_lx: float

    @property
    def factors(self) -> tuple[float, float]:
        """Ours over the Supplement's, ours over the Circular's."""
        return self.ours_lx / self.supplement_lx, self.ours_lx / self.circular_lx

    @property
    def factor(self) -> float:
        """To the nearer fit, at least 1."""
        return float(min(max(factor, 1.0 / factor) for factor in self.factors))

    @property
    def factor_outside(self) -> float:
        """By how much ours leaves the span between the two fits; 1 within it."""
        low, high = sorted((self.supplement_lx, self.circular_lx))
        return float(max(1.0, self.ours_lx / high, low / self.ours_lx))


def night_rows(tables: AtmosphereTables | None = None, *, model: SkyModel | None = None) -> list[NightRow]:
    """Sun from +20° to -18° without a moon, full and half moon from 10° to 60° at midnight; sea level.

    Parameters
    ----------
    tables
        Of the model's atmosphere, where they are at hand.
    model
        The bundled ``clear`` where left out.
    """
    model = model or read_sky_model("clear")
    evaluators = SkyEvaluators(tables_in_memory if tables is None else lambda _: tables)

    def ours(sun: SolarPosition, moon: LunarPosition | None = None) -> float:
        light = illuminate(model, sun, moon, map_height=64, evaluators=evaluators)
        return float(luminance(global_horizontal_illuminance(light)))

    rows = []
    for altitude in _SUN_ALTITUDES_DEG:
        apparent = altitude if altitude >= -5.0 / 6.0 else altitude + float(refraction_deg(altitude))
        supplement = usno.supplement_sun_lx(altitude)
        circular = usno.circular_sun_lx(altitude) + usno.CIRCULAR_NIGHT_SKY_LX
        rows.append(
            NightRow("sun", altitude, ours(SolarPosition(180.0, apparent, altitude, 1.0)), supplement, circular)
        )
    midnight = SolarPosition(0.0, -40.0, -40.0, 1.0)
    parallax_deg = float(np.degrees(np.arcsin(6378.14 / 384_400.0)))
    for source, phase_deg in (("full moon", FULL_MOON_PHASE_DEG), ("half moon", HALF_MOON_PHASE_DEG)):
        for altitude in _MOON_ALTITUDES_DEG:
            fraction = 0.5 * (1.0 + np.cos(np.radians(phase_deg)))
            moon = LunarPosition(180.0, altitude, altitude, 384_400.0, 1.0, phase_deg, fraction, True)
            supplement = usno.supplement_moon_lx(altitude, phase_deg, parallax_deg) + usno.CIRCULAR_NIGHT_SKY_LX
            circular = usno.circular_moon_lx(altitude, 180.0 - phase_deg) + usno.CIRCULAR_NIGHT_SKY_LX
            rows.append(NightRow(source, altitude, ours(midnight, moon), supplement, circular))
    return rows


def night_numbers(rows: list[NightRow]) -> dict[str, float]:
    """The flat numbers of the benchmark's JSON."""
    sun, moon = [row for row in rows if row.source == "sun"], [row for row in rows if row.source != "sun"]

    def worst(chosen: list[NightRow], which: int) -> float:
        return float(max(max(row.factors[which], 1.0 / row.factors[which]) for row in chosen))

    return {
        "twilight_factor_max": max(row.factor for row in rows),
        "twilight_factor_outside_max": max(row.factor_outside for row in rows),
        "twilight_factor_supplement_max": worst(sun, 0),
        "twilight_factor_circular_max": worst([row for row in sun if row.altitude_deg >= -12], 1),
        "moon_factor_max": max(row.factor for row in moon),
        "moon_factor_supplement_max": worst(moon, 0),
        "moon_factor_circular_max": worst(moon, 1),
    }


def print_rows(rows: list[NightRow]) -> None:
    """The comparison as a table."""
    print(f"{'source':10s} {'altitude':>8s} {'ours lx':>10s} {'Supplement':>11s} {'Circular':>10s}   factors")
    for row in rows:
        print(
            f"{row.source:10s} {row.altitude_deg:7.0f}° {row.ours_lx:10.4g} {row.supplement_lx:11.4g} "
            f"{row.circular_lx:10.4g}   {row.factors[0]:.2f} {row.factors[1]:.2f}"
        )


def main() -> None:
    """Run it alone."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", type=Path, help="write the numbers to a file")
    arguments = parser.parse_args()
    rows = night_rows()
    print_rows(rows)
    numbers = night_numbers(rows)
    print(json.dumps(numbers, indent=2))
    write_record(arguments.json, numbers, seed=None)


if __name__ == "__main__":
    main()
