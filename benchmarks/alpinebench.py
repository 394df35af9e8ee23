"""From webcams to relit pictures, against the truth: what each stage loses, what all lose together, what each idea earns.

    python benchmarks/alpinebench.py [--quick] [--size tiny|quick|small|medium|large] [--place massif|jungfrau]
                                     [--seed N] [--only distil] [--json FILE] [--figures FOLDER]

A place whose albedo, light and poses are known is photographed by panoramic webcams at full physics, and degraded as
webcams do (auto exposure, white balance, tone curve, noise, JPEG, haze; poses of GPS and compass, calibrated from clicked
points). ``massif`` is synthetic, another one for every seed; ``jungfrau`` is the real 100 m raster of the Bernese Oberland
with its real colours under a made-up snow cover. Views that no webcam saw, and hours that no picture was used of, are
judged: pictures developed with the truth's exposure, land beyond 60 m, mode ``valid``. ``matched`` fits one factor for
each colour first, as one must for a real webcam.

* Panoramas are calibrated, cut into views, and give the albedo, which corrects the satellite's image where no webcam
  looked; relit, it ties the pictures of each hour together, and what they paint corrects it. One table tells what paintings,
  their completions and the joint recovery would add to the albedo (what flags of ``run`` switch
  on); `alpinebench_contributions.py` tells it of many places.
* Painted hours: the painted and completed texture, seen from the judged webcams through the air.
* Held-out hours: the albedo recovered from the painted hours' pictures, relit.
* Distilled: Gaussians that learned from that albedo under suns of other days, seen at the held-out hours.
* Each stage alone is given the truth of the stages before it. Ablations change one thing of the whole.
* The satellite's image shows reflectance on a July forenoon with that hour's shades in it, as such images do, misplaced
  and noisy, on the same texels. Its hour is known: the light is taken out before it is corrected. Satellite only is the image
  as it is on the terrain without air, at the best exposure there is for each picture.

``--figures`` writes truth, ours, satellite only and the difference, and a day as MP4 and as an animated WebP.
"""

from __future__ import annotations

import argparse
import os
import secrets
import sys
import time
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from unittest import mock

import numpy as np

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).parent))

from albedo_scene import hours, lights_for  # noqa: E402
from alpinebench_scene import DATE, SIZES, pose_errors  # noqa: E402
from alpinebench_stages import Bench, Splats  # noqa: E402
from record import write_record  # noqa: E402

from seasonscapes.albedo.closed_form import solve_albedo  # noqa: E402
from seasonscapes.albedo.photographs import EIGHT_BIT  # noqa: E402
from seasonscapes.evaluation.figures import comparison_figure, image_row, steepest_window  # noqa: E402
from seasonscapes.evaluation.lpips import load_lpips, lpips_sources, missing_lpips  # noqa: E402
from seasonscapes.evaluation.surfaces import albedo_error  # noqa: E402
from seasonscapes.evaluation.tables import by_distance, drop, table_lines  # noqa: E402
from seasonscapes.exposure import develop, exposure_ev100  # noqa: E402
from seasonscapes.images import atomic_path, linear_from_srgb, srgb_from_linear, write_png8  # noqa: E402
from seasonscapes.relighting.film import write_video  # noqa: E402
from seasonscapes.rendering.relit_view import relight_view  # noqa: E402
from seasonscapes.sky.illumination import global_horizontal_illuminance  # noqa: E402
from seasonscapes.terrain.surface import Texture  # noqa: E402
from seasonscapes.texturing.painting import PaintOptions  # noqa: E402
from seasonscapes.workspace import default_workspace  # noqa: E402

# ---------------------------------------------------------------------------------------------- the tables


class Rows(dict):
    """Scores by name; each is told as it is measured, so that a run that is interrupted has said what it knew."""

    def __setitem__(self, name: str, row: dict[str, float]) -> None:
        print(
            f"    {name}: {row['psnr_db']:.2f} dB, matched {row['matched_psnr_db']:.2f} dB, SSIM {row['ssim']:.3f}",
            file=sys.stderr,
            flush=True,
        )
        super().__setitem__(name, row)


def stages(bench: Bench) -> tuple[dict[str, dict], dict]:
    """Each stage given the truth of those before it, then all together; and what the whole made."""
    world, judge, rows = bench.world, bench.judge, Rows()
    painted, held = world.painted_hours, world.held_hours
    true = {at: bench.true_texture(world.lights[at][0], world.albedo) for at in painted}
    rows["texels (true texture)"] = judge.scores(lambda c, at: judge.of_texture(true[at], c, at), painted)
    bench.clock.tell("true textures")

    def filled(paintings: dict) -> Callable:
        textures = {at: bench.completed(painting.texture, at) for at, painting in paintings.items()}
        return lambda c, at: judge.of_texture(textures[at], c, at)

    seen = bench.seen_texels()
    holes = {at: bench.completed(Texture(true[at], seen.astype(np.float32)), at) for at in painted}
    rows["inpaint alone"] = judge.scores(lambda c, at: judge.of_texture(holes[at], c, at), painted)
    bench.clock.tell("inpaint alone")
    rows["paint alone, clean + inpaint"] = judge.scores(
        filled({at: bench.painted(at, clean=True, true_pose=True) for at in painted}), painted
    )
    rows["harmonise + paint + inpaint"] = judge.scores(
        filled({at: bench.painted(at, true_pose=True) for at in painted}), painted
    )
    bench.clock.tell("paint, harmonise")
    rows["relight (true albedo)"] = judge.scores(judge.of_albedo(world.albedo), held)
    fit = bench.solved(clean=True, true_pose=True)
    rows["albedo alone, clean + relight"] = judge.scores(judge.of_albedo(bench.completed_albedo(fit)[0]), held)
    bench.clock.tell("albedo alone")
    photographs = bench.photographs()
    albedo_fit = solve_albedo(bench.land, photographs, noise_model=EIGHT_BIT)
    albedo, sigma = bench.completed_albedo(albedo_fit)
    relit = judge.of_albedo(albedo)
    rows["all, held-out hours"] = judge.scores(relit, held)
    rows["all, relit painted hours"] = judge.scores(relit, painted)
    bench.clock.tell("albedo, relit")
    told = {at: bench.true_texture(world.lights[at][0], albedo) for at in painted}
    paintings = {at: bench.painted(at, relit=told[at]) for at in painted}
    textures = {at: bench.fused(paintings[at].texture, at, told[at], sigma / albedo[..., 1]) for at in painted}
    rows["all, painted hours"] = judge.scores(lambda c, at: judge.of_texture(textures[at], c, at), painted)
    bench.clock.tell("calibrated, painted, completed")
    distilled(bench, albedo, rows)
    return rows, {
        "paintings": paintings,
        "told": told,
        "textures": textures,
        "albedo": albedo,
        "photographs": photographs,
        "fit": albedo_fit,
        "seen": seen,
        "relit": relit,
    }


def distilled(bench: Bench, albedo: np.ndarray, rows: dict[str, dict]) -> None:
    """Rows of Gaussians that learned from the true albedo, from the found one, and from pictures too."""
    splats, held = Splats(bench), bench.world.held_hours
    print(f"    {len(splats.surfels.means)} Gaussians", file=sys.stderr)
    rows["distil alone (true albedo)"] = bench.judge.scores(splats.views(bench.world.albedo), held)
    rows["all, distilled, held-out hours"] = bench.judge.scores(splats.views(albedo), held)
    pictured = splats.views(bench.world.albedo, refined=True)
    rows["distil alone, refined from pictures"] = bench.judge.scores(pictured, held)
    bench.clock.tell("distilled three times")


def distilling_alone(bench: Bench) -> dict[str, dict]:
    """What `stages` says of Gaussians, and of the relit albedos that they are compared with."""
    world, judge, rows = bench.world, bench.judge, Rows()
    rows["relight (true albedo)"] = judge.scores(judge.of_albedo(world.albedo), world.held_hours)
    albedo, _ = bench.completed_albedo(bench.solved())
    rows["all, held-out hours"] = judge.scores(judge.of_albedo(albedo), world.held_hours)
    bench.clock.tell("albedo, relit")
    distilled(bench, albedo, rows)
    return rows


def satellite_view(bench: Bench) -> Callable:
    """The image from above as it is, without air; its exposure is the best there is, and it borrows the truth's sky."""
    judge = bench.judge
    return lambda camera, at: judge.in_sight(bench.from_above.values, judge.truth(camera, at).radiance, camera)


def texture_scores(bench: Bench, textures: dict, *, air: bool = True) -> dict[str, float]:
    """Of textures of the ablated hours, in the ablated views."""
    judge = bench.judge
    return judge.scores(
        lambda c, at: judge.of_texture(textures[at], c, at, air=air),
        ablated_hours(bench),
        most=bench.world.size.ablated,
    )


def contributions(bench: Bench, whole: dict) -> tuple[dict[str, dict], dict[str, float]]:
    """What each adds to the albedo of photographs, as rows of its relit held-out hours, and as gains [dB].

    ``whole`` holds photographs, their fit and albedo, and painted and completed textures.
    """
    judge, rows, numbers = bench.judge, Rows(), {}
    for name, albedo in bench.albedos(whole).items():
        scores = judge.scores(judge.of_albedo(albedo), bench.world.held_hours)
        error = albedo_error(bench.world.albedo, albedo, bench.albedo_guides.surface)
        rows[name] = scores | {"albedo_psnr_db": error.psnr_db}
    alone = rows["photographs alone"]
    for name, row in rows.items():
        if row is not alone:
            numbers[f"{key_of(name)}_gain_db"] = row["psnr_db"] - alone["psnr_db"]
            numbers[f"{key_of(name)}_albedo_gain_db"] = row["albedo_psnr_db"] - alone["albedo_psnr_db"]
    bench.clock.tell("contributions to the albedo")
    return rows, numbers


def painting_ablations(bench: Bench, whole: dict, without: dict[str, dict]) -> dict[str, dict]:
    """The painting and its completion from what the land tells, as the paper's is, one factor at a time.

    ``without`` are the rows of the whole's ablations at the same hours.
    """
    told, painted = whole["told"], ablated_hours(bench)

    def repainted(options: PaintOptions | None = None, **how) -> dict:
        return {at: bench.completed(bench.painted(at, options, relit=told[at], **how).texture, at) for at in painted}

    def refilled(method: str) -> dict:
        return {at: bench.completed(whole["paintings"][at].texture, at, method=method) for at in painted}

    rows = Rows()
    rows["full"] = texture_scores(bench, refilled("guided"))
    everywhere = mock.patch(
        "seasonscapes.texturing.painting.visible_by_ray",
        lambda terrain, camera, surface, sight: np.ones(len(surface.texel), bool),
    )
    with everywhere:
        rows["no occlusion test"] = texture_scores(bench, repainted())
    bench.clock.tell("no occlusion test")
    rows["no gain compensation"] = texture_scores(bench, repainted(PaintOptions(fit_gains=False)))
    rows["first camera wins (as the paper)"] = texture_scores(bench, repainted(PaintOptions(mode="first")))
    rows["no silhouette guard"] = texture_scores(bench, repainted(PaintOptions(guard=False)))
    rows["no albedo to tie pictures"] = without["no albedo (painting, guided completion)"]
    bench.clock.tell("painting's ablations")
    rows["no guidance (membrane)"] = texture_scores(bench, refilled("membrane"))
    rows["no guidance (Telea, as the paper)"] = texture_scores(bench, refilled("telea"))
    plain = {at: one_colour(whole["paintings"][at].texture) for at in painted}
    rows["no inpainting (one mean colour)"] = texture_scores(bench, plain)
    bench.clock.tell("completion's ablations")
    rows["no aerial perspective"] = texture_scores(bench, repainted(air=False), air=False)
    rows["satellite only, best exposure"] = without["satellite only, best exposure"]
    return rows


def ablations(bench: Bench, whole: dict) -> tuple[dict[str, dict], dict[str, dict]]:
    """The whole, one factor at a time: at painted hours, and at held-out hours."""
    judge, held, told, most = bench.judge, bench.world.held_hours, whole["told"], bench.world.size.ablated
    painted = ablated_hours(bench)
    paintings = {at: whole["paintings"][at].texture for at in painted}
    rows = Rows()
    rows["full"] = texture_scores(bench, whole["textures"])
    rows["no painting (the relit albedo alone)"] = texture_scores(bench, told)
    kept = {at: np.where(one.weight[..., None] > 0.0, one.values, told[at]) for at, one in paintings.items()}
    rows["painted texels as they are, the relit albedo beyond"] = texture_scores(bench, kept)
    alone = {at: bench.completed(bench.painted(at).texture, at) for at in painted}
    rows["no albedo (painting, guided completion)"] = texture_scores(bench, alone)
    summer, bare_image = judge.of_albedo(bench.satellite.values), judge.of_albedo(bench.from_above.values)
    rows["no webcams (July's image, delit, relit)"] = judge.scores(summer, painted, most=most)
    rows["no webcams (July's image as it is, relit)"] = judge.scores(bare_image, painted, most=most)
    rows["satellite only, best exposure"] = judge.scores(satellite_view(bench), painted, most=most)
    late = Rows()
    late["full"] = judge.scores(whole["relit"], held, most=most)

    def nearest(camera: int, at: datetime) -> np.ndarray:
        source = min(painted, key=lambda other: abs(other - at))
        level = np.mean(
            global_horizontal_illuminance(judge.light(camera, at))
            / global_horizontal_illuminance(judge.light(camera, source))
        )
        return judge.of_texture(whole["textures"][source] * np.float32(level), camera, at)

    late["no relighting (nearest painted hour)"] = judge.scores(nearest, held, most=most)
    untold = bench.completed_albedo(bench.solved(response=False))[0]
    late["no tone curve searched"] = judge.scores(judge.of_albedo(untold), held, most=most)
    guided = bench.guided_albedo(whole["fit"])
    late["satellite a guide, no base to correct"] = judge.scores(judge.of_albedo(guided), held, most=most)
    shaded = bench.completed_albedo(whole["fit"], bench.from_above)[0]
    late["the satellite's light left in"] = judge.scores(judge.of_albedo(shaded), held, most=most)
    late["no webcams (July's image, delit, relit)"] = judge.scores(summer, held, most=most)
    late["no webcams (July's image as it is, relit)"] = judge.scores(bare_image, held, most=most)
    late["no aerial perspective"] = judge.scores(judge.of_albedo(whole["albedo"], air=False), held, most=most)
    late["satellite only, best exposure"] = judge.scores(satellite_view(bench), held, most=most)
    bench.clock.tell("the whole's ablations")
    return rows, late


def ablated_hours(bench: Bench) -> tuple[datetime, ...]:
    """The first painted hour and the middle one: a shaded one and a sunny one tell."""
    painted = bench.world.painted_hours
    return (painted[0], painted[len(painted) // 2])


def one_colour(texture: Texture) -> np.ndarray:
    """A painted texture with the mean of what is painted elsewhere."""
    seen = texture.weight > 0.0
    return np.where(seen[..., None], texture.values, texture.values[seen].mean(axis=0)).astype(np.float32)


_SHOWN = ("psnr_db", "matched_psnr_db", "ssim", "flip", "lpips", "colour_angle_deg", "albedo_psnr_db")


def print_stages(rows: dict[str, dict]) -> None:
    print(
        "\n".join(
            table_lines(
                [{"stage": name} | {key: row[key] for key in _SHOWN if key in row} for name, row in rows.items()]
            )
        )
    )


def print_ablations(rows: dict[str, dict]) -> None:
    """With the paper's Drop: of LPIPS where its weights are at hand, else of FLIP."""
    full = rows["full"]
    error = "lpips" if "lpips" in full else "flip"
    table = [
        {"ablation": name}
        | {key: row[key] for key in _SHOWN if key in row}
        | {f"drop_{error}_percent": 100.0 * drop(full[error], row[error])}
        for name, row in rows.items()
    ]
    print("\n".join(table_lines(table)))


def key_of(name: str) -> str:
    """``no guidance (membrane)`` → ``no_guidance_membrane``."""
    return "_".join("".join(c if c.isalnum() else " " for c in name.lower()).split())


def numbers_of(bench: Bench, rows: dict, ablated: dict[str, dict], whole: dict) -> dict[str, float]:
    """All of it, flat; ``ablated`` has a table for each of its names."""
    numbers: dict[str, float] = {"seed": bench.world.seed}
    for prefix, table in {"stage": rows, **ablated}.items():
        for name, row in table.items():
            numbers |= {f"{prefix}_{key_of(name)}_{key}": value for key, value in row.items()}
    full, held = rows["all, painted hours"], rows["all, held-out hours"]
    numbers["distilled_psnr_db"] = rows["all, distilled, held-out hours"]["psnr_db"]
    numbers |= {
        "painted_view_psnr_db": full["psnr_db"],
        "painted_view_ssim": full["ssim"],
        "painted_view_matched_psnr_db": full["matched_psnr_db"],
        "held_out_hour_psnr_db": held["psnr_db"],
        "held_out_hour_ssim": held["ssim"],
        "held_out_hour_matched_psnr_db": held["matched_psnr_db"],
        "mask_share": full["mask_share"],
        "painted_texel_share": float(whole["seen"].mean()),
    }
    # As the paper scores: multiplied by the mask, over the whole frame.
    flattered = bench.judge.scores(
        lambda c, at: bench.judge.of_texture(whole["textures"][at], c, at), bench.world.painted_hours, mode="paper"
    )
    numbers |= {f"painted_view_paper_mode_{key}": flattered[key] for key in ("psnr_db", "ssim")}
    error = albedo_error(bench.world.albedo, whole["albedo"], whole["fit"].pixel_count >= 0.5)
    numbers |= {"albedo_psnr_db": error.psnr_db, "albedo_scale_invariant_mae": error.scale_invariant_mae}
    errors = np.array(
        [
            pose_errors(solved, camera)
            for solved, camera in zip(bench.pictures.calibrated, bench.world.painting, strict=True)
        ]
    )
    return numbers | {
        "heading_error_deg_max": float(errors[:, 0].max()),
        "position_error_m_max": float(errors[:, 1].max()),
    }


def save_figures(bench: Bench, whole: dict, folder: Path) -> None:
    """Truth, ours, satellite only and the difference, at a painted and at a held-out hour; cliffs magnified."""
    judge, satellite = bench.judge, satellite_view(bench)
    for name, at in (
        ("painted", bench.world.painted_hours[len(bench.world.painted_hours) // 2]),
        ("held_out", bench.world.held_hours[0]),
    ):
        ours = judge.of_texture(whole["textures"][at], 0, at) if name == "painted" else whole["relit"](0, at)
        true = judge.truth(0, at)
        shown = {"truth": true.radiance, "ours": ours, "satellite only": satellite(0, at)}
        sheet = comparison_figure(
            {key: judge.developed(value, 0, at) for key, value in shown.items()},
            mask=judge.mask(0),
            window=steepest_window(true.gbuffer.normal, true.gbuffer.depth),
        )
        write_png8(folder / f"alpinebench_{name}.png", np.round(255.0 * sheet).astype(np.uint8))


def save_day(bench: Bench, whole: dict, folder: Path) -> None:
    """The judged day (every 20 minutes, but at the tiny size): truth, ours and satellite only, as MP4 and animated WebP."""
    from PIL import Image

    judge, camera = bench.judge, bench.world.judged[0]
    times = hours(DATE, *np.arange(4.5, 18.6, bench.world.size.day_step_h).tolist())
    lights = [row[0] for row in lights_for(times, [camera], bench.world.sky, default_workspace())]
    views = {"truth": judge.clothed(bench.world.albedo, [0])[0], "ours": judge.clothed(whole["albedo"], [0])[0]}
    sheets = []
    for light in lights:
        shown = {name: np.maximum(relight_view(view, light).radiance, 0.0) for name, view in views.items()}
        shown["satellite only"] = judge.in_sight(bench.from_above.values, shown["truth"])
        ev100 = exposure_ev100(shown["truth"])
        sheets.append(image_row({name: srgb_from_linear(develop(value, ev100)) for name, value in shown.items()}))
    write_video(folder / "alpinebench_day.mp4", (linear_from_srgb(sheet) for sheet in sheets), fps=8.0)
    frames = [Image.fromarray(np.round(255.0 * sheet).astype(np.uint8)) for sheet in sheets]
    with atomic_path(folder / "alpinebench_day.webp") as temporary:
        frames[0].save(temporary, "WEBP", save_all=True, append_images=frames[1:], duration=125, loop=0, quality=70)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the quick size, within ten minutes on two cores")
    parser.add_argument("--size", choices=tuple(SIZES), default="small")
    parser.add_argument("--place", choices=("massif", "jungfrau"), default="massif")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--only", choices=("distil",), help="this stage alone, with the albedo that it needs")
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--figures", type=Path, default=None)
    arguments = parser.parse_args()
    seed = secrets.randbelow(10_000) if arguments.seed is None else arguments.seed
    data = None
    if arguments.place == "jungfrau":
        data = Path(os.environ.get("SEASONSCAPES_DATA", Path(__file__).parents[2] / "shared" / "data"))
        if not (data / "jungfrau").is_dir():
            raise SystemExit(f"alpinebench: no folder {data / 'jungfrau'}; name its parent in SEASONSCAPES_DATA")
    why = missing_lpips()
    print(f"seed {seed}" + (f"; LPIPS is left out: {why}" if why else ""), file=sys.stderr)
    if why is None and not lpips_sources()["published"]:
        print("LPIPS is by other weights than the published ones: not comparable", file=sys.stderr)
    bench = Bench(seed, "quick" if arguments.quick else arguments.size, None if why else load_lpips(), data)
    if arguments.only:
        rows = distilling_alone(bench)
        print_stages(rows)
        numbers = {f"stage_{key_of(name)}_{key}": value for name, row in rows.items() for key, value in row.items()}
        write_record(arguments.json, numbers, seed=seed)
        return
    rows, whole = stages(bench)
    print_stages(rows)
    painted_rows, held_rows = ablations(bench, whole)
    albedo_rows, gains = contributions(bench, whole)
    painting_rows = painting_ablations(bench, whole, painted_rows)
    most = min(bench.world.size.ablated, len(bench.world.judged))
    print(f"\nthe whole, two painted hours, {most} views that no webcam saw")
    print_ablations(painted_rows)
    print("\nthe whole, held-out hours, the same views")
    print_ablations(held_rows)
    print("\nwhat each adds to the albedo, held-out hours, all judged views")
    print_stages(albedo_rows)
    print("\npainting and its completion alone, as the paper's, two painted hours, the same views")
    print_ablations(painting_rows)
    at = bench.world.painted_hours[0]
    true, ours = (
        bench.judge.developed(value, 0, at)
        for value in (bench.judge.truth(0, at).radiance, bench.judge.of_texture(whole["textures"][at], 0, at))
    )
    print("\nby distance, first painted hour, first view")
    print("\n".join(table_lines(by_distance(true, ours, bench.judge.truth(0, at).gbuffer.depth, bench.judge.mask(0)))))
    if arguments.figures is not None:
        save_figures(bench, whole, arguments.figures)
        save_day(bench, whole, arguments.figures)
    ablated = {"ablation_painted": painted_rows, "ablation_held_out": held_rows, "ablation_painting": painting_rows}
    ablated["albedo"] = albedo_rows
    numbers = numbers_of(bench, rows, ablated, whole) | gains | {"seconds": time.perf_counter() - bench.clock.start}
    write_record(arguments.json, numbers, seed=seed)


if __name__ == "__main__":
    main()
