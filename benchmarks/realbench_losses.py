"""What each stage of realbench loses: one after another is exchanged, and the pictures are predicted again.

Each figure is the mean over all cases [dB]. Slopes, pose and the part that is seen are held against ``mean_psnr_db``; weather,
haze and response, which completion would take over, against ``psnr_db_ours_conditions``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from realbench import Stack, crossed, fitted_camera, half_conditions, one_exposure, ours, stacked
from realbench_cameras import FixedCase
from realbench_rivals import equally_exposed

from seasonscapes.albedo.fixed_camera import FitOptions, FixedCamera, conditions_of
from seasonscapes.albedo.picture_completion import SeenPart, completed_picture
from seasonscapes.albedo.picture_conditions import CONTRAST, EXTINCTION, OVERCAST, SUN, picture_under


def losses(stack: Stack, other_pose: FixedCase, options: FitOptions) -> dict[str, float]:
    """Mean PSNR [dB] with one exposure for each colour, by exchanged stage.

    Parameters
    ----------
    stack
        The pictures.
    other_pose
        The same camera in the pose that the data folder states.
    options
        How the ground is solved.
    """
    found: dict[str, list[float]] = {}
    for k in range(len(stack.values)):
        for name, values in _exchanged(stack, k, options).items():
            found.setdefault(name, []).append(_psnr(stack, k, values))
    moved = stacked(other_pose)
    for k in range(len(moved.values)):
        camera, equal = _from_others(moved, k, options)
        values = ours(moved, camera, k, equal, half_conditions(moved, camera, k))
        found.setdefault("pose_of_data_folder", []).append(_psnr(moved, k, values))
    return {f"exchanged_{name}_psnr_db": float(np.mean(values)) for name, values in found.items()}


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
