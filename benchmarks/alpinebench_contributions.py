"""What paintings, their completions and the joint recovery add to the albedo of photographs, over many places of AlpineBench.

    python benchmarks/alpinebench_contributions.py [--size tiny|quick|small] [--places N] [--seed N] [--json FILE]

Each place is another massif, at the tiny size by default. Scored as `alpinebench.py` does: pictures of hours that nobody
photographed, relit from each albedo, against the photographs alone with the closed form. Mean gain, the least and the greatest.
"""

from __future__ import annotations

import argparse
import secrets
import sys
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from alpinebench import contributions
from alpinebench_scene import SIZES
from alpinebench_stages import Bench
from record import write_record

from seasonscapes.albedo.closed_form import solve_albedo
from seasonscapes.albedo.photographs import EIGHT_BIT


def gains_of(seed: int, size: str) -> dict[str, float]:
    """The gains [dB] at one place."""
    bench = Bench(seed, size, None)
    hours, lights = bench.world.painted_hours, bench.world.lights
    photographs = bench.photographs()
    fit = solve_albedo(bench.land, photographs, noise_model=EIGHT_BIT)
    albedo, sigma = bench.completed_albedo(fit)
    told = {at: bench.true_texture(lights[at][0], albedo) for at in hours}
    paintings = {at: bench.painted(at, relit=told[at]) for at in hours}
    textures = {at: bench.fused(paintings[at].texture, at, told[at], sigma / albedo[..., 1]) for at in hours}
    whole = {"photographs": photographs, "fit": fit, "albedo": albedo, "paintings": paintings, "textures": textures}
    return contributions(bench, whole)[1]


def main() -> None:
    """Run by name; a table, and JSON where asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--size", choices=tuple(SIZES), default="tiny")
    parser.add_argument("--places", type=int, default=8)
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--json", type=Path, default=None)
    arguments = parser.parse_args()
    seed, start = secrets.randbelow(10_000) if arguments.seed is None else arguments.seed, time.perf_counter()
    found = [gains_of(seed + place, arguments.size) for place in range(arguments.places)]
    numbers: dict[str, float] = {"places": len(found)}
    for name in found[0]:
        values = np.array([each[name] for each in found])
        numbers |= {name: values.mean(), f"least_{name}": values.min(), f"greatest_{name}": values.max()}
        print(f"{name:<34} mean {values.mean():+.3f}, from {values.min():+.3f} to {values.max():+.3f}")
    numbers = {name: float(value) for name, value in numbers.items()} | {"seconds": time.perf_counter() - start}
    write_record(arguments.json, numbers, seed=seed)


if __name__ == "__main__":
    main()
