"""What each stage of realbench loses: one after another is exchanged, and pictures are predicted again.

    python benchmarks/realbench_losses.py

It takes the flags of ``realbench.py``. Every fourth picture at half of the width, or every second one at the whole of it, is
left out in turn. Figures are means over them [dB], with one exposure for each colour. ``whole_picture_seen``, ``slopes_of_heights`` and ``pose_of_data_folder`` are to be held against
``program``; the others, which the completion would take over, against ``conditions_alone``.
"""

from __future__ import annotations

import argparse
import secrets
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context

import numpy as np
from realbench import (
    QUICK_WIDTH_PX,
    WIDTH_PX,
    Stack,
    add_arguments,
    crossed,
    data_folder,
    fitted_camera,
    forkable,
    half_conditions,
    one_exposure,
    ours,
    stacked,
)
from realbench_cameras import chamonix
from realbench_rivals import equally_exposed
from record import write_record

from seasonscapes.albedo.fixed_camera import FitOptions, FixedCamera, conditions_of
from seasonscapes.albedo.picture_completion import SeenPart, completed_picture
from seasonscapes.albedo.picture_conditions import CONTRAST, EXTINCTION, OVERCAST, SUN, picture_under
from seasonscapes.rendering.backend import use_backend
from seasonscapes.workspace import default_workspace


def losses(stack: Stack, moved: Stack, options: FitOptions, numbers: Sequence[int], jobs: int) -> dict[str, float]:
    """Mean PSNR [dB] by exchanged stage.

    Parameters
    ----------
    stack, moved
        The pictures, in the fitted pose and in that of the data folder.
    options
        How the ground is solved.
    numbers
        Pictures that are left out in turn.
    jobs
        Processes.
    """
    bare = [forkable(each) for each in (stack, moved)]
    with ProcessPoolExecutor(jobs, mp_context=get_context("fork"), initializer=_remember, initargs=(bare,)) as pool:
        rows = list(pool.map(partial(_row, options), numbers))
    return {f"{name}_db": float(np.mean([row[name] for row in rows])) for name in rows[0]} | {"cases": len(rows)}


_stacks: list[Stack] = []


def _remember(stacks: list[Stack]) -> None:
    _stacks[:] = stacks


def _row(options: FitOptions, k: int) -> dict[str, float]:
    """PSNR [dB] of picture k by exchanged stage."""
    stack, moved = _stacks
    row = {name: _psnr(stack, k, values) for name, values in _exchanged(stack, k, options).items()}
    camera, equal = _from_others(moved, k, options)
    row["pose_of_data_folder"] = _psnr(moved, k, ours(moved, camera, k, equal, half_conditions(moved, camera, k)))
    print(k, {name: round(value, 2) for name, value in row.items()}, flush=True)
    return row


def _exchanged(stack: Stack, k: int, options: FitOptions) -> dict[str, np.ndarray]:
    """Predictions ``(n, 3)`` of picture k by what was exchanged."""
    camera, equal = _from_others(stack, k, options)
    found, light = half_conditions(stack, camera, k), stack.lights[k]
    whole = conditions_of(camera, stack.values[k], stack.usable[k], light)
    usual = np.mean([each.values for each in camera.conditions], axis=0)

    def of_others(which: list[int]) -> np.ndarray:
        halves = []
        for each in found:
            values = each.values.copy()
            values[which] = usual[which]
            halves.append(picture_under(camera.ground, light, values))
        return crossed(stack, *halves)

    flat = _from_others(stack, k, replace(options, shading_sigma=0.0))
    return {
        "program": ours(stack, camera, k, equal, found),
        "conditions_alone": crossed(stack, *[picture_under(camera.ground, light, each.values) for each in found]),
        "slopes_of_heights": ours(stack, flat[0], k, flat[1], half_conditions(stack, flat[0], k)),
        "whole_picture_seen": completed_picture(
            camera, equal, SeenPart(stack.values[k], stack.usable[k], light, whole), stack.layers
        ),
        "conditions_of_whole_picture": picture_under(camera.ground, light, whole.values),
        "weather_of_others": of_others([SUN, OVERCAST]),
        "haze_of_others": of_others([EXTINCTION, *range(6, 9)]),
        "response_of_others": of_others([CONTRAST, *range(9, 12)]),
    }


def _from_others(stack: Stack, k: int, options: FitOptions) -> tuple[FixedCamera, np.ndarray]:
    """The camera fitted to all pictures but k, and those in one exposure."""
    others = [j for j in range(len(stack.values)) if j != k]
    return fitted_camera(stack, others, options), equally_exposed(stack.values[others], stack.usable[others])


def _psnr(stack: Stack, k: int, values: np.ndarray) -> float:
    valid = stack.usable[k]
    truth = stack.values[k][valid]
    return float(-10.0 * np.log10(np.mean((one_exposure(truth, values[valid]) - truth) ** 2)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_arguments(parser)
    arguments = parser.parse_args()
    data = data_folder(arguments.data)
    if data is None:
        return
    seed = secrets.randbelow(1 << 16) if arguments.seed is None else arguments.seed
    use_backend()
    width, every = (QUICK_WIDTH_PX, 4) if arguments.quick else (WIDTH_PX, 2)
    stack = stacked(chamonix(data, default_workspace(), width))
    moved = stacked(chamonix(data, default_workspace(), width, refined_pose=False))
    numbers = range(0, len(stack.values), every)
    figures = losses(stack, moved, FitOptions(seed=seed), numbers, arguments.jobs)
    for name, value in figures.items():
        print(f"{name:34s} {value:.2f}")
    write_record(arguments.json, figures, seed=seed)


if __name__ == "__main__":
    main()
