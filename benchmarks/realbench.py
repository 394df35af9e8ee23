"""Real photographs: leave one picture of a fixed camera out, recover the ground from the others, predict it, compare.

    python benchmarks/realbench.py [--quick] [--seed N] [--data FOLDER] [--json FILE] [--sheets FOLDER] [--jobs N]

Every picture of the webcam of Chamonix (and, scored apart under ``cameras``, of camera KR1 at Kronebreen under clouds) is left out once, and predicted with three amounts of knowledge:

half
    One half of its terrain pixels (a chequerboard of blocks) is seen and the other one scored, both ways round. ``ours``
    (`albedo.picture_completion`), ``ours_conditions`` (light, haze, exposure and response alone), ``grey`` (one albedo under
    our light), ``half_blend`` (best linear blend of the other pictures), ``half_layers`` (a blend whose weights vary over
    the ground as those of ``ours`` do), ``half_embedding`` (four numbers of appearance, as in WildGaussians).
known
    Its time, whether the sun shone, colour and brightness of its own sky: ``ours_known``, ``blend`` (by the same numbers).
time
    ``ours_blind`` (the other pictures relit, weighted by sun and day, as `hours` does), ``nearest`` (the picture of the nearest sun), ``mean`` of the others.

``oracle_blend`` sees what is scored. ``mean_psnr_db``, ``margin_over_best_rival_db`` and ``share_better`` hold ``ours`` against
the best of all rivals but ``half_layers``, which is printed beside. Scores are of terrain without near ground and clouds before
it (polygons in ``realbench_masks.json``), raw and with one exposure for each colour. ``--sheets`` writes photograph | predicted | best rival | difference; such pictures of
restricted photographs are not to be published.
"""

from __future__ import annotations

import argparse
import os
import secrets
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from realbench_cameras import SKYLINE_PX, FixedCase, cameras_not_scored, chamonix, kronebreen
from realbench_kriging import kriged
from realbench_rivals import equally_exposed, rival_pictures, seeing_pictures
from realbench_shadows import shadow_figures
from record import write_record

from seasonscapes.albedo.cloud_cover import closed_clouds, sky_above
from seasonscapes.albedo.fixed_camera import (
    FitOptions,
    FixedCamera,
    conditions_of,
    direct_share,
    fit_fixed_camera,
    relit_at,
    relit_mean,
)
from seasonscapes.albedo.picture_completion import SeenPart, completed_picture, ground_layers
from seasonscapes.albedo.picture_conditions import Conditions, Ground, ViewLight, picture_under
from seasonscapes.albedo.sunlit_patches import sun_shone
from seasonscapes.evaluation.metrics import score
from seasonscapes.images import linear_from_srgb, srgb_from_linear, write_png8
from seasonscapes.rendering.backend import use_backend
from seasonscapes.workflows.unseen_hours import FixedView, fixed_view, light_on_view
from seasonscapes.workspace import default_workspace

QUICK_WIDTH_PX, WIDTH_PX = 352, 704
# Side of the blocks [of the full width] of which every other one tells the conditions.
BLOCKS_ACROSS = 20
RIVALS = ("nearest", "mean", "blend", "grey", "half_blend", "half_embedding")
RIVALS_BY_TIME = ("nearest", "mean")
RIVALS_BY_KNOWLEDGE = (*RIVALS_BY_TIME, "blend")


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
    closed: np.ndarray
    sun: np.ndarray
    layers: np.ndarray


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
    # Polygons of land that clouds hide cover the sky above as well, and are no mask of it.
    return Stack(
        case,
        view,
        lights,
        values,
        usable,
        (row // side + column // side) % 2 == 1,
        known,
        np.array([closed_clouds(each.image, sky_above(covered > 0)) for each in case.pictures]),
        sun,
        ground_layers(view.distance_km, view.height_m),
    )


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
    whole = conditions_of(camera, stack.values[k], stack.usable[k], light)
    grey = replace(camera, ground=grey_ground(camera, stack.view))
    pictures, usable = stack.values[others], stack.usable[others]
    equal = equally_exposed(pictures, usable)
    results = {
        "ours": ours(stack, camera, k, equal, found),
        "ours_conditions": crossed(stack, *[picture_under(camera.ground, light, each.values) for each in found]),
        "ours_known": relit_blend(stack, camera, others, k),
        "ours_blind": relit_mean(camera, light, range(len(others))),
        "grey": crossed(
            stack, *[picture_under(grey.ground, light, each.values) for each in half_conditions(stack, grey, k)]
        ),
    }
    asked = (stack.sun[k], stack.known[k])
    results |= rival_pictures(pictures, usable, stack.sun[others], stack.known[others], asked)
    results |= seeing_pictures(equal, stack.values[k], stack.usable[k], stack.half, stack.layers)
    facts = {
        "sun": float(np.mean([each.sun for each in found])),
        "overcast": float(np.mean([each.overcast for each in found])),
        "visibility_km": float(np.exp(np.mean([np.log(each.visibility_km) for each in found]))),
        # Weather is no prediction: it is found in the whole picture, as `camera_hours` does.
        "direct_share": (direct := direct_share(camera.ground, light, whole)),
        "sun_visible_found": sun_shone(
            camera,
            direct,
            stack.values[k],
            stack.usable[k],
            light,
            stack.view.pixel,
            (stack.case.camera.width_px, stack.case.camera.height_px),
            closed=bool(stack.closed[k]),
        ),
    }
    return results, facts


def ours(stack: Stack, camera: FixedCamera, k: int, equal: np.ndarray, found: list[Conditions]) -> np.ndarray:
    """Either half of picture k by `completed_picture`, from what is seen of the other one."""
    halves = []
    for side, conditions in zip((False, True), found, strict=True):
        part = SeenPart(stack.values[k], stack.usable[k] & (stack.half == side), stack.lights[k], conditions)
        halves.append(completed_picture(camera, equal, part, stack.layers))
    return crossed(stack, *halves)


def relit_blend(stack: Stack, camera: FixedCamera, others: list[int], k: int) -> np.ndarray:
    """The other pictures blended as the rival `blend` is, half of each as it is and half relit to the asked hour.

    Relit pictures are wrong where the model is, and those that are not where the light changed: errors of both average out.
    """
    relit = np.stack([relit_at(camera, stack.lights[k], j) for j in range(len(others))])
    blends = []
    for pictures in (relit, stack.values[others]):
        equal = equally_exposed(pictures, stack.usable[others])
        mean = equal.mean(axis=0)
        blends.append(np.clip(mean + kriged(stack.known[others], stack.known[k], equal - mean), 0.0, 1.0))
    return (blends[0] + blends[1]) / 2.0


def grey_ground(camera: FixedCamera, view: FixedView) -> Ground:
    """Ground of one grey under the slopes of the heights."""
    mean = np.full_like(camera.ground.reflectance, float(camera.ground.reflectance.mean()))
    return Ground(mean, np.column_stack([view.normal, np.zeros(len(view.normal))]), camera.ground.distance_km)


def case_row(stack: Stack, options: FitOptions, sheets: Path | None, k: int) -> dict[str, Any]:
    """Scores of all predictions of picture k, and what was found in it."""
    start, picture = time.process_time(), stack.case.pictures[k]
    found, facts = predictions(stack, k, options)
    scores = {name: scored(stack, k, values) for name, values in found.items()}
    best = max(RIVALS, key=lambda name: scores[name]["psnr_db"])
    row = {"camera": stack.case.name, "picture": picture.name, "season": picture.season, "best_rival": best, **facts}
    row |= {"sun_visible_seen": picture.sun_visible, "scores": scores}
    print(
        f"{picture.name:26s} "
        + " ".join(f"{name} {scores[name]['psnr_db']:.2f}" for name in ("ours", "half_layers", "ours_known", "blend"))
        + f" | best rival {best} {scores[best]['psnr_db']:.2f} | ssim {scores['ours']['ssim']:.3f}"
        + f" | sun {'shone' if facts['sun_visible_found'] else 'hidden'}, seen {picture.sun_visible}",
        flush=True,
    )
    if sheets is not None:
        write_sheet(sheets / f"{picture.name}.png", stack, k, found["ours"], found[best], best)
    return row | {"processor_seconds": time.process_time() - start}


def forkable(stack: Stack) -> Stack:
    """The stack without what the renderer holds."""
    return replace(stack, view=replace(stack.view, view=None), case=replace(stack.case, place=None))


def run_cases(stack: Stack, options: FitOptions, sheets: Path | None, jobs: int) -> list[dict[str, Any]]:
    """Rows of all pictures, in their order, by several processes; they need numpy alone and share the stack by forking."""
    start = (_remember, (forkable(stack),))
    with ProcessPoolExecutor(jobs, get_context("fork"), *start) as pool:
        return list(pool.map(partial(_remembered_row, options, sheets), range(len(stack.values))))


_stacks: list[Stack] = []


def _remember(stack: Stack) -> None:
    _stacks[:] = [stack]


def _remembered_row(options: FitOptions, sheets: Path | None, k: int) -> dict[str, Any]:
    return case_row(_stacks[0], options, sheets, k)


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


def margin(rows: list[dict[str, Any]], ours: str, rivals: tuple[str, ...]) -> tuple[float, float]:
    """Mean of ours less the best mean of the rivals [dB], and the share of cases better than the case's best rival."""

    def mean(name: str) -> float:
        return float(np.mean([row["scores"][name]["psnr_db"] for row in rows]))

    better = [row["scores"][ours]["psnr_db"] > max(row["scores"][name]["psnr_db"] for name in rivals) for row in rows]
    return mean(ours) - max(mean(name) for name in rivals), float(np.mean(better))


def figures_of(rows: list[dict[str, Any]]) -> dict[str, float]:
    """The figures of all cases together; names of scores end in the method's name."""
    names = rows[0]["scores"]
    known, better_known = margin(rows, "ours_known", RIVALS_BY_KNOWLEDGE)
    gained, better = margin(rows, "ours", RIVALS)
    blind, better_blind = margin(rows, "ours_blind", RIVALS_BY_TIME)
    figures = {
        "mean_psnr_db": float(np.mean([row["scores"]["ours"]["psnr_db"] for row in rows])),
        "mean_ssim": float(np.mean([row["scores"]["ours"]["ssim"] for row in rows])),
        "margin_over_best_rival_db": gained,
        "share_better": better,
        "margin_over_layered_blend_db": margin(rows, "ours", ("half_layers",))[0],
        "known_margin_over_best_rival_db": known,
        "known_share_better": better_known,
        "time_margin_over_best_rival_db": blind,
        "time_share_better": better_blind,
        "sun_visible_accuracy": float(np.mean([row["sun_visible_seen"] == row["sun_visible_found"] for row in rows])),
    }
    for season in sorted({row["season"] for row in rows}):
        of = [row for row in rows if row["season"] == season]
        figures[f"{season}_cases"] = len(of)
        figures[f"{season}_psnr_db"] = float(np.mean([row["scores"]["ours"]["psnr_db"] for row in of]))
        figures[f"{season}_margin_over_best_rival_db"] = margin(of, "ours", RIVALS)[0]
    for measure in ("psnr_db", "raw_psnr_db", "ssim", "flip", "colour_angle_deg"):
        figures |= {
            f"{measure}_{name}": float(np.mean([row["scores"][name][measure] for row in rows])) for name in names
        }
    return figures


def camera_row(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """The figures of one camera."""
    return {"camera": rows[0]["camera"], "pictures": len(rows), **figures_of(rows)}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--quick", action="store_true", help="pictures of half the width")
    parser.add_argument("--seed", type=int)
    parser.add_argument("--data", type=Path, default=os.environ.get("SEASONSCAPES_DATA"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--jobs", type=int, default=2, help="processes")


def data_folder(given: str | Path | None) -> Path | None:
    """The folder of real data; ``None``, and a line that says so, where the pictures are not there."""
    data = Path(given) if given else Path(__file__).parents[2] / "shared" / "data"
    if (data / "chamonix-2013").is_dir():
        return data
    print(f"realbench: skipped: no chamonix-2013 in {data}; give --data or SEASONSCAPES_DATA", file=sys.stderr)
    return None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    add_arguments(parser)
    parser.add_argument("--sheets", type=Path)
    arguments = parser.parse_args()
    data = data_folder(arguments.data)
    if data is None:
        return
    seed = secrets.randbelow(1 << 16) if arguments.seed is None else arguments.seed
    use_backend()
    width = QUICK_WIDTH_PX if arguments.quick else WIDTH_PX
    options = FitOptions(seed=seed)
    stack = stacked(chamonix(data, default_workspace(), width))
    rows = run_cases(stack, options, arguments.sheets, arguments.jobs)
    figures: dict[str, Any] = figures_of(rows) | shadow_figures(stack.case, stack.view, stack.lights)
    figures["cases"] = rows
    figures["cameras"] = [camera_row(rows)]
    if (data / "kronebreen-kr1").is_dir():
        stack = stacked(kronebreen(data, default_workspace(), width))
        figures["cameras"].append(camera_row(run_cases(stack, options, arguments.sheets, arguments.jobs)))
    figures["cameras"] += cameras_not_scored(data)
    for row in figures["cameras"]:
        told = (
            row.get("reason")
            or f"{row['mean_psnr_db']:.2f} dB, {row['margin_over_best_rival_db']:+.2f} dB over the best rival"
        )
        print(f"{row['camera']:28s} {row['pictures']:3d} pictures: {told}")
    for name, value in figures.items():
        if not isinstance(value, list):
            print(f"{name:40s} {value:.3f}")
    write_record(arguments.json, figures, seed=seed)


if __name__ == "__main__":
    main()
