"""Real photographs: leave one picture of a fixed camera out, recover the ground from the others, predict it, compare.

    python benchmarks/realbench.py [--quick] [--seed N] [--data FOLDER] [--json FILE] [--sheets FOLDER]

Of each camera in the data folder every picture is left out once. What is known of it: its time, and the conditions of
`albedo.picture_conditions` (direct light, clouds, haze, exposure, response), which are found on one half of its pixels (a
chequerboard of blocks) and scored on the other half, both ways round. ``ours_blind`` knows nothing of its pixels: its
conditions are those of the pictures with the nearest sun. Rivals see the other pictures, the time, and by eye whether the
sun shone, and what its own sky looks like; those named ``half_`` see the same half as ours, and ``oracle_blend`` all of it.
Scores are of terrain without near ground and clouds before it (polygons in ``realbench_masks.json``), raw and with one
exposure for each colour. ``--sheets`` writes photograph | predicted | best rival | difference; such pictures of
restricted photographs are not to be published.
"""

from __future__ import annotations

import argparse
import os
import secrets
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from realbench_cameras import SKYLINE_PX, FixedCase, chamonix
from realbench_rivals import equally_exposed, rival_pictures, seeing_pictures
from record import write_record

from seasonscapes.albedo.fixed_camera import (
    FitOptions,
    FixedCamera,
    conditions_of,
    fit_fixed_camera,
    picture_at,
    relit_at,
)
from seasonscapes.albedo.picture_conditions import Conditions, Ground, ViewLight, picture_under
from seasonscapes.albedo.residual_kriging import kriged
from seasonscapes.evaluation.metrics import score
from seasonscapes.images import linear_from_srgb, srgb_from_linear, write_png8
from seasonscapes.rendering.backend import use_backend
from seasonscapes.workflows.unseen_hours import FixedView, fixed_view, light_on_view
from seasonscapes.workspace import default_workspace

QUICK_WIDTH_PX, WIDTH_PX = 352, 704
# Side of the blocks [of the full width] of which every other one tells the conditions.
BLOCKS_ACROSS = 20
BEST_RIVALS = ("nearest", "mean", "blend")


@dataclass(frozen=True)
class Stack:
    """The pictures of one camera on its n terrain pixels."""

    case: FixedCase
    view: FixedView
    lights: list[ViewLight]
    values: np.ndarray
    usable: np.ndarray
    half: np.ndarray
    known: np.ndarray
    sun: np.ndarray


def stacked(case: FixedCase) -> Stack:
    view = fixed_view(case.place, case.camera)
    shape = (case.camera.height_px, case.camera.width_px)
    covered = np.zeros(shape, np.uint8)
    covered.reshape(-1)[view.pixel] = 1
    sky = cv2.dilate(1 - covered, np.ones((2 * SKYLINE_PX + 1,) * 2, np.uint8)).reshape(-1)[view.pixel] == 0
    values = np.stack([each.image.reshape(-1, 3)[view.pixel] for each in case.pictures]).astype(np.float64)
    usable = np.stack([each.usable.reshape(-1)[view.pixel] & sky for each in case.pictures])
    row, column = np.divmod(view.pixel, shape[1])
    side = max(shape[1] // BLOCKS_ACROSS, 4)
    lights = [light_on_view(view, each.time) for each in case.pictures]
    sun = np.stack([each.sun_direction for each in lights])
    known = np.stack([_known(case, k, covered, lights[k]) for k in range(len(lights))])
    return Stack(case, view, lights, values, usable, (row // side + column // side) % 2 == 1, known, sun)


def _known(case: FixedCase, k: int, covered: np.ndarray, light: ViewLight) -> np.ndarray:
    """What a rival may know of a picture: sun, season, whether the sun shone, colour and brightness of its own sky."""
    picture = case.pictures[k]
    sky = cv2.dilate(covered, np.ones((5, 5), np.uint8)) == 0
    sky = picture.image[sky].mean(axis=0) if sky.any() else np.zeros(3)
    day = picture.time.timetuple().tm_yday
    shone = 0.5 if picture.sun_visible is None else float(picture.sun_visible)
    return np.array([*light.sun_direction, day / 60.0, shone, 3.0 * (sky[2] - sky[0]), 3.0 * sky.mean()])


def one_exposure(truth: np.ndarray, picture: np.ndarray) -> np.ndarray:
    """The picture ``(n, 3)`` with the one factor for each colour, in linear light, that comes nearest to the truth."""
    linear, out = linear_from_srgb(np.clip(picture, 0.0, 1.0)), np.empty_like(picture)
    for c in range(3):
        tried, step = 0.0, 0.5
        logs = np.linspace(-3.0, 3.0, 13)
        for _ in range(5):
            errors = [
                np.mean((srgb_from_linear(linear[:, c] * np.exp(tried + each)) - truth[:, c]) ** 2) for each in logs
            ]
            tried += logs[int(np.argmin(errors))]
            logs, step = np.linspace(-step, step, 9), step / 4.0
        out[:, c] = srgb_from_linear(linear[:, c] * np.exp(tried))
    return out


def image_of(stack: Stack, values: np.ndarray, behind: np.ndarray | None = None) -> np.ndarray:
    """Values ``(n, 3)`` of the terrain pixels as an image; black elsewhere, or another image."""
    camera = stack.case.camera
    image = np.zeros((camera.height_px, camera.width_px, values.shape[-1])) if behind is None else behind.copy()
    image.reshape(-1, values.shape[-1])[stack.view.pixel] = values
    return image


def scored(stack: Stack, k: int, values: np.ndarray) -> dict[str, float]:
    """Scores of a prediction with one exposure for each colour, and PSNR as it is."""
    valid, truth = stack.usable[k], stack.values[k]
    fitted = np.array(truth)
    fitted[valid] = one_exposure(truth[valid], values[valid])
    mask = image_of(stack, valid[:, None].astype(float))[..., 0] > 0.5
    result = score(image_of(stack, truth), image_of(stack, np.clip(fitted, 0.0, 1.0)), mask).record()
    raw = float(np.mean((np.clip(values, 0.0, 1.0) - truth)[valid] ** 2))
    return result | {"raw_psnr_db": -10.0 * np.log10(raw)}


def fitted_camera(stack: Stack, others: list[int], options: FitOptions) -> FixedCamera:
    return fit_fixed_camera(
        list(stack.values[others]),
        list(stack.usable[others]),
        [stack.lights[j] for j in others],
        stack.view.distance_km,
        stack.view.normal,
        options=options,
    )


def half_conditions(stack: Stack, camera: FixedCamera, k: int) -> list[Conditions]:
    """Conditions of a picture as found on either half of its pixels."""
    return [
        conditions_of(camera, stack.values[k], stack.usable[k] & (stack.half == side), stack.lights[k])
        for side in (False, True)
    ]


def crossed(stack: Stack, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """The prediction of each half by what was found on the other one: ``first`` was found where ``half`` is False."""
    return np.where(stack.half[:, None], first, second)


def predictions(stack: Stack, k: int, options: FitOptions) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Predictions ``(n, 3)`` of picture k by name, from all others; and facts about it."""
    others = [j for j in range(len(stack.values)) if j != k]
    camera = fitted_camera(stack, others, options)
    light, found = stack.lights[k], half_conditions(stack, camera, k)
    model = [picture_under(camera.ground, light, each.values) for each in found]
    whole = [picture_at(camera, light, each) for each in found]
    nearest = int(np.argmax(stack.sun[others] @ stack.sun[k]))
    grey = replace(camera, ground=grey_ground(camera, stack.view))
    results = {
        "ours": crossed(stack, *whole),
        "ours_without_kriging": crossed(stack, *model),
        "ours_known": relit_blend(stack, camera, others, k),
        "ours_blind": picture_at(camera, light, camera.conditions[nearest]),
        "grey": crossed(
            stack, *[picture_under(grey.ground, light, each.values) for each in half_conditions(stack, grey, k)]
        ),
    }
    results |= rival_pictures(
        stack.values[others],
        stack.usable[others],
        stack.sun[others],
        stack.known[others],
        (stack.sun[k], stack.known[k]),
    )
    results |= seeing_pictures(stack.values[others], stack.usable[others], stack.values[k], stack.usable[k], stack.half)
    facts = {
        "sun": float(np.mean([each.sun for each in found])),
        "overcast": float(np.mean([each.overcast for each in found])),
        "visibility_km": float(np.exp(np.mean([np.log(each.visibility_km) for each in found]))),
        "sun_above_horizon": bool(light.sun.any()),
    }
    return results, facts


def relit_blend(stack: Stack, camera: FixedCamera, others: list[int], k: int) -> np.ndarray:
    """The other pictures, each relit to the asked hour under its own conditions, and blended as the rival `blend` is."""
    relit = np.stack([relit_at(camera, stack.lights[k], j) for j in range(len(others))])
    equal = equally_exposed(relit, stack.usable[others])
    mean = equal.mean(axis=0)
    return np.clip(mean + kriged(stack.known[others], stack.known[k], equal - mean), 0.0, 1.0)


def grey_ground(camera: FixedCamera, view: FixedView) -> Ground:
    """Ground of one grey under the slopes of the heights."""
    mean = np.full_like(camera.ground.reflectance, float(camera.ground.reflectance.mean()))
    return Ground(mean, np.column_stack([view.normal, np.zeros(len(view.normal))]), camera.ground.distance_km)


def run_case(case: FixedCase, options: FitOptions, sheets: Path | None) -> list[dict[str, Any]]:
    stack, rows = stacked(case), []
    for k, picture in enumerate(case.pictures):
        start = time.process_time()
        found, facts = predictions(stack, k, options)
        scores = {name: scored(stack, k, values) for name, values in found.items()}
        best = max(BEST_RIVALS, key=lambda name: scores[name]["psnr_db"])
        row = {"camera": case.name, "picture": picture.name, "season": picture.season, "best_rival": best, **facts}
        row |= {"sun_visible_seen": picture.sun_visible, "scores": scores, "seconds": time.process_time() - start}
        rows.append(row)
        print(
            f"{picture.name:32s} "
            + " ".join(f"{name} {values['psnr_db']:.2f}" for name, values in scores.items())
            + f" | ssim {scores['ours']['ssim']:.3f} sun {facts['sun']:.2f}",
            flush=True,
        )
        if sheets is not None:
            write_sheet(sheets / f"{picture.name}.png", stack, k, found["ours"], found[best], best)
    return rows


def write_sheet(path: Path, stack: Stack, k: int, ours: np.ndarray, rival: np.ndarray, name: str) -> None:
    """Photograph | predicted | best rival | difference, with one exposure for each colour."""
    valid, truth = stack.usable[k], stack.values[k]
    behind = np.zeros_like(stack.case.pictures[k].image)

    def shown(values: np.ndarray) -> np.ndarray:
        fitted = np.zeros_like(values)
        fitted[valid] = one_exposure(truth[valid], values[valid])
        return image_of(stack, fitted, behind)

    pictures = [stack.case.pictures[k].image, shown(ours), shown(rival)]
    difference = np.abs(pictures[1] - pictures[0]) * image_of(stack, valid[:, None].astype(float))
    top, bottom = np.hstack(pictures[:2]), np.hstack([pictures[2], np.clip(3.0 * difference, 0.0, 1.0)])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png8(path, np.round(255.0 * np.vstack([top, bottom])).astype(np.uint8))


def figures_of(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of all cases together; names of scores end in the method's name."""
    names = rows[0]["scores"]
    mean = {name: float(np.mean([row["scores"][name]["psnr_db"] for row in rows])) for name in names}
    best = max(mean[name] for name in BEST_RIVALS)
    beaten = [row["scores"]["ours"]["psnr_db"] > row["scores"][row["best_rival"]]["psnr_db"] for row in rows]
    figures: dict[str, Any] = {
        "mean_psnr_db": mean["ours"],
        "margin_over_best_rival_db": mean["ours"] - best,
        "share_better": float(np.mean(beaten)),
        "mean_ssim": float(np.mean([row["scores"]["ours"]["ssim"] for row in rows])),
    }
    for measure in ("psnr_db", "raw_psnr_db", "ssim", "flip", "colour_angle_deg"):
        figures |= {
            f"{measure}_{name}": float(np.mean([row["scores"][name][measure] for row in rows])) for name in names
        }
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="pictures of half the width")
    parser.add_argument("--seed", type=int)
    parser.add_argument("--data", type=Path, default=os.environ.get("SEASONSCAPES_DATA"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--sheets", type=Path)
    arguments = parser.parse_args()
    data = Path(arguments.data) if arguments.data else Path(__file__).parents[2] / "shared" / "data"
    if not (data / "chamonix-2013").is_dir():
        print(f"realbench: skipped: no chamonix-2013 in {data}; give --data or SEASONSCAPES_DATA", file=sys.stderr)
        return
    seed = secrets.randbelow(1 << 16) if arguments.seed is None else arguments.seed
    use_backend()
    width = QUICK_WIDTH_PX if arguments.quick else WIDTH_PX
    options = FitOptions(seed=seed)
    rows = run_case(chamonix(data, default_workspace(), width), options, arguments.sheets)
    figures = figures_of(rows) | {"cases": rows}
    for name, value in figures.items():
        if not isinstance(value, list):
            print(f"{name:40s} {value:.3f}")
    write_record(arguments.json, figures, seed=seed)


if __name__ == "__main__":
    main()
