"""Painting and completion: who is seen, what the hidden texels look like, and what the rivals make of them.

    python benchmarks/texturing.py [--quick] [--seed N] [--json FILE] [--figures FOLDER]

Settings were tuned on the massif of seed 1912 and on Landsat masks of seed 1; the seed drawn here decides massif,
cameras and masks. Landsat, Jungfrau and Finse need SEASONSCAPES_DATA (or ``../shared/data``); without it they are left
out and said to be. Scores are of hidden texels only.
"""

from __future__ import annotations

import argparse
import os
import secrets
import sys
import time
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import texturing_places as places
import texturing_rivals as rivals
from record import write_record

from seasonscapes.terrain.surface import Texture, sample_texture
from seasonscapes.texturing.completion import CompletedTexture, CompletionOptions, complete
from seasonscapes.texturing.predictors import Predictors, stack_predictors
from seasonscapes.texturing.terrain_features import terrain_features

SEASONS = {"winter": (32, 11.0), "autumn": (288, 14.0), "spring": (135, 8.0)}


def completed(bed: places.Testbed, predictors: Predictors | None = None, **options) -> tuple[CompletedTexture, float]:
    """The product's own completion and its processor time [s]."""
    texture = Texture(np.where(bed.seen[..., None], bed.truth, np.nan).astype(np.float32), bed.seen.astype(np.float32))
    start = time.process_time()
    result = complete(texture, predictors or bed.predictors, options=CompletionOptions(**options))
    seconds = time.process_time() - start
    if not np.array_equal(result.values[bed.seen], bed.truth[bed.seen]):
        raise AssertionError("painted texels have changed")
    return result, seconds


def judge(bed: places.Testbed, figures: Path | None) -> dict[str, float]:
    """Guided completion and every rival on one testbed."""
    truth = bed.shown(bed.truth)
    hole = bed.predictors.surface & ~bed.seen
    result, _ = completed(bed)
    fast, _ = completed(bed, fast=True)
    grainy, _ = completed(bed, detail=0.6)
    image = (
        bed.satellite if bed.name.startswith("landsat") else bed.shown(bed.satellite * np.nanpercentile(bed.truth, 99))
    )
    pictures = rivals.fills(truth, bed.seen, np.nan_to_num(image))
    pictures |= {"guided_fast": bed.shown(fast.values), "guided_grain": bed.shown(grainy.values)}
    pictures["guided"] = bed.shown(result.values)
    # Where no land lies nobody is judged, and nothing bleeds in from there.
    pictures = {name: np.where(bed.predictors.surface[..., None], p, truth) for name, p in pictures.items()}
    score = {name: rivals.psnr(p, truth, hole) for name, p in pictures.items()}
    likeness = {name: rivals.ssim(p, truth, hole) for name, p in pictures.items()}
    quartiles = rivals.sigma_quartiles(result.values, result.sigma, bed.truth, hole)
    print(
        f"\n{bed.name}: {100 * bed.seen.mean():.0f} % painted; σ over error by quartile "
        + " ".join(f"{q:.2f}" for q in quartiles)
    )
    for name, value in sorted(score.items(), key=lambda item: item[1]):
        seam = rivals.seam_excess(pictures[name], truth, bed.seen, bed.predictors.surface)
        print(f"  {name:14s} {value:6.2f} dB   SSIM {likeness[name]:.3f}   seam {seam:+6.2f}")
    numbers = {
        "psnr_db": score["guided"],
        "telea_psnr_db": score["telea"],
        "gain_over_telea_db": score["guided"] - score["telea"],
        "fast_gain_over_telea_db": score["guided_fast"] - score["telea"],
        "gain_over_best_membrane_db": score["guided"] - max(score[n] for n in rivals.MEMBRANES),
        "gain_over_best_transfer_db": score["guided"] - max(score[n] for n in rivals.TRANSFERS),
        "ssim_over_telea": likeness["guided"] / likeness["telea"],
        "seam_excess_levels": rivals.seam_excess(pictures["guided"], truth, bed.seen, bed.predictors.surface),
        "sigma_quartile_low": min(quartiles),
        "sigma_quartile_high": max(quartiles),
        "sigma_quartiles_within_30pc": float(np.mean([1 / 1.3 <= q <= 1.3 for q in quartiles])),
    }
    if figures is not None:
        save_figure(figures / f"completion_{bed.name}.png", truth, bed.seen, pictures, result)
    return numbers


def save_figure(path: Path, truth, seen, pictures, result) -> None:
    """Painted, Telea, guided, truth; σ on the right."""
    from seasonscapes.images import write_png8

    sigma = np.repeat((result.sigma / max(np.percentile(result.sigma, 99.0), 1e-9))[..., None], 3, 2)
    panels = [np.where(seen[..., None], truth, 0.1), pictures["telea"], pictures["guided"], truth, sigma]
    gap = np.ones((truth.shape[0], 4, 3))
    row = np.concatenate([part for panel in panels for part in (panel, gap)][:-1], axis=1)
    write_png8(path, (np.clip(np.nan_to_num(row), 0.0, 1.0) * 255.0).astype(np.uint8))


def controls(bed: places.Testbed) -> dict[str, float]:
    """By how much the score falls when a guide lies [dB]: permuted texels, and the sun of another season's hour."""
    truth, hole = bed.shown(bed.truth), bed.predictors.surface & ~bed.seen

    def score(predictors):
        return rivals.psnr(bed.shown(completed(bed, predictors)[0].values), truth, hole)

    honest = score(bed.predictors)
    order = np.random.default_rng(0).permutation(bed.seen.size)
    flat = bed.predictors.values.reshape(-1, len(bed.predictors.names))
    permuted = replace(bed.predictors, values=flat[order].reshape(bed.predictors.values.shape))
    # A summer morning's sun: high, and on the other side.
    wrong = np.array([-bed.sun[0], bed.sun[1], 0.0])
    wrong = np.append(wrong[:2] / np.linalg.norm(wrong[:2]) * np.cos(np.radians(60.0)), np.sin(np.radians(60.0)))
    day = [wrong]
    layers = terrain_features(bed.heights, bed.spacing_m, sun_direction=wrong, day_suns=day)
    values = {name: bed.predictors.values[..., i] for i, name in enumerate(bed.predictors.names)}
    # What is left may not tell the aspect, or trees find the true sun for themselves.
    values |= {name: layers[name] for name in layers if name in values and ("sun" in name or name == "insolation")}
    values = {name: layer for name, layer in values.items() if not name.startswith("facing")}
    right = {name: bed.predictors.values[..., i] for i, name in enumerate(bed.predictors.names) if name in values}
    return {
        "control_permuted_drop_db": honest - score(permuted),
        "control_wrong_sun_drop_db": score(stack_predictors(right, surface=bed.predictors.surface))
        - score(stack_predictors(values, surface=bed.predictors.surface)),
    }


def held_out_view(bed: places.Testbed, figures: Path | None) -> dict[str, float]:
    """Pixels of a camera that painted nothing, where no other camera saw the land either."""
    from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
    from seasonscapes.rendering.gbuffer import trace_gbuffer
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh

    (column, row, height), heading = bed.held_out
    low = bed.terrain.vertices[:, :2].min(axis=0)
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(heading, -8.0)
    pose[:3, 3] = [
        low[0] + (column + 0.5) * bed.spacing_m,
        low[1] + (bed.seen.shape[0] - row - 0.5) * bed.spacing_m,
        height,
    ]
    camera = Camera(768, 512, 500.0, 500.0, 384.0, 256.0, pose)
    land = ray_scene(mi_mesh(bed.terrain, np.full(3, 0.2)))
    gbuffer = trace_gbuffer(RenderScene(land.mi_scene, land.mi_terrain), camera)
    seen = np.nan_to_num(sample_texture(bed.seen[..., None].astype(np.float32), gbuffer.uv)[..., 0], nan=1.0)
    unseen = seen < 0.5
    shown = bed.shown(bed.truth)
    telea = np.where(bed.seen[..., None], shown, rivals.fills(shown, bed.seen, shown)["telea"])
    textures = {"truth": shown, "telea": telea, "guided": bed.shown(completed(bed)[0].values)}
    views = {name: np.nan_to_num(sample_texture(texture, gbuffer.uv)) for name, texture in textures.items()}
    score = {name: rivals.psnr(views[name], views["truth"], unseen) for name in ("telea", "guided")}
    if figures is not None:
        from seasonscapes.images import write_png8

        before = np.where(unseen[..., None], 0.1, views["truth"])
        row_of = np.concatenate([before, views["telea"], views["guided"], views["truth"]], axis=1)
        write_png8(figures / f"view_{bed.name}.png", (np.clip(row_of, 0.0, 1.0) * 255.0).astype(np.uint8))
    return {
        "held_out_view_psnr_db": score["guided"],
        "held_out_view_gain_over_telea_db": score["guided"] - score["telea"],
        "held_out_view_unseen_share": float(unseen.mean()),
    }


def cost(bed: places.Testbed, side: int = 1440) -> dict[str, float]:
    """Processor seconds for each million hidden texels, fitting included, on a texture of about two million."""
    size = (side, side)

    def larger(values):
        return cv2.resize(np.nan_to_num(values).astype(np.float32), size, interpolation=cv2.INTER_LINEAR)

    table = np.stack([larger(layer) for layer in np.moveaxis(bed.predictors.values, -1, 0)], -1)
    seen = cv2.resize(bed.seen.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    big = replace(
        bed,
        truth=np.maximum(larger(bed.truth), 0.0),
        seen=seen,
        predictors=Predictors(table, bed.predictors.names, np.ones(seen.shape, bool)),
    )
    hidden = float((~seen).sum()) / 1e6
    return {
        "cost_cpu_s_per_mtexel": completed(big)[1] / hidden,
        "cost_fast_cpu_s_per_mtexel": completed(big, fast=True)[1] / hidden,
    }


def finse(data: Path, seed: int, figures: Path | None, quick: bool) -> dict[str, float]:
    """Blocks of a real photograph's own texels, hidden and completed; with the other season's picture and without."""
    numbers = {}
    for bed in places.finse(data, seed, (160.0,) if quick else (64.0, 160.0, 360.0)):
        found = judge(bed, figures)
        alone = places.without_image(bed)
        relief = rivals.psnr(
            bed.shown(completed(alone)[0].values), bed.shown(bed.truth), bed.predictors.surface & ~bed.seen
        )
        print(f"  {'relief alone':14s} {relief:6.2f} dB")
        numbers |= {
            f"{bed.name}_{key}": found[key]
            for key in ("psnr_db", "gain_over_telea_db", "sigma_quartile_low", "sigma_quartile_high")
        }
        numbers[f"{bed.name}_relief_alone_gain_over_telea_db"] = relief - found["telea_psnr_db"]
    return numbers


def averaged(found: list[dict[str, float]], prefix: str) -> dict[str, float]:
    return {f"{prefix}_{key}": float(np.mean([one[key] for one in found])) for key in found[0]}


def measure(quick: bool, seed: int, data: Path, figures: Path | None) -> dict[str, float]:
    """All numbers."""
    numbers: dict[str, float] = {}
    chosen = ("winter", "autumn") if quick else tuple(SEASONS)
    seasons = {name: SEASONS[name] for name in chosen}
    hidden = []
    for number in range(1 if quick else 2):
        for bed in places.massif(seed + number, seasons):
            hidden.append(judge(bed, figures))
            if number == 0 and bed.name.endswith("autumn"):
                numbers |= held_out_view(bed, figures) | controls(bed)
                numbers |= cost(bed)
    numbers |= averaged(hidden, "massif")
    if data.is_dir():
        real = [judge(bed, figures) for bed in places.jungfrau(data, seed, {k: seasons[k] for k in chosen[-2:]})]
        numbers |= averaged(real, "jungfrau")
        hidden += real
        beds = list(places.landsat(data, seed))
        found = [judge(bed, figures) for bed in beds]
        numbers |= averaged(found, "landsat")
        numbers |= {f"landsat_{key}": value for key, value in controls(beds[0]).items()}
        numbers |= finse(data, seed, figures, quick)
    else:
        print(f"Jungfrau, Landsat and Finse: not found at {data}, left out")
    numbers["hidden_gain_over_telea_db"] = float(np.mean([one["gain_over_telea_db"] for one in hidden]))
    numbers["hidden_ssim_over_telea"] = float(np.mean([one["ssim_over_telea"] for one in hidden]))
    return numbers


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--quick", action="store_true", help="one massif, two seasons: within five minutes on two cores"
    )
    parser.add_argument("--seed", type=int, default=None, help="drawn at run time when left out")
    parser.add_argument("--json", type=Path, default=None, help="write the numbers to this file")
    parser.add_argument("--figures", type=Path, default=None, help="write pictures into this folder")
    parser.add_argument("--only-completion", action="store_true", help="leave out the painting's own numbers")
    arguments = parser.parse_args()
    seed = secrets.randbelow(2**31 - 10) if arguments.seed is None else arguments.seed
    print(f"seed {seed}")
    data = Path(os.environ.get("SEASONSCAPES_DATA") or Path(__file__).parents[2] / "shared" / "data")
    numbers = measure(arguments.quick, seed, data, arguments.figures)
    if not arguments.only_completion:
        import texturing_painting

        numbers |= texturing_painting.measure(arguments.quick, seed)
    numbers = {key: float(value) for key, value in numbers.items()}
    print()
    for key, value in numbers.items():
        print(f"{key:52s} {value:10.4f}")
    write_record(arguments.json, numbers, seed=seed)
    return 0


if __name__ == "__main__":
    sys.exit(main())
