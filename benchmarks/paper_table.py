"""The SeasonScapes paper's ablation table: prompt, depth, mask, IP-Adapter and painting taken away one at a time.

    python benchmarks/paper_table.py [--weights FOLDER|hub] [--base NAME] [--depth-net NAME] [--inpaint-net NAME]
        [--adapter NAME] [--lpips FILE] [--scene SCENE] [--views N] [--steps N] [--size WxH] [--held-out N] [--times LIST]
        [--quick] [--seed N] [--json FILE] [--figures FOLDER]

Photographs of every second camera of a synthetic place are painted as the paper does (the first that sees a texel wins), an
image model completes the texture along a path, and the finished texture is pictured from the other cameras and from some
along the path, whose photographs nothing was made of; ``unpainted`` is the share of the scored pixels that no photograph
painted. Scores are the paper's: PSNR, SSIM and LPIPS in the mode ``paper`` with the reference's mask; ``valid_psnr_db`` counts masked pixels
out. Exposure and white balance of each picture are fitted to the photograph first, for all rows alike. ``drop`` is the
relative rise of LPIPS over the whole method.

Real weights are not part of this repository and are not downloaded: ``--weights`` names a folder with them as OWNER/NAME, or
``hub`` the hub's cache on this machine, ``--lpips`` the file that ``seasonscapes lpips`` makes. Without them weights of a few
hundred kilobytes are drawn at random in the same layout. They know nothing of pictures: the table then shows that every
part runs and acts, and nothing about the method, which each row says.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from record import write_record

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from tiny_diffusion import write_tiny_lpips, write_tiny_weights

import seasonscapes as ss
from seasonscapes.cameras.observation import read_manifest
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.evaluation.lpips import Lpips, load_lpips, lpips_sources
from seasonscapes.evaluation.masks import reference_mask
from seasonscapes.evaluation.metrics import score
from seasonscapes.evaluation.picture_pairs import check_files_held_out, matching_gain
from seasonscapes.evaluation.tables import drop, table_lines
from seasonscapes.images import read_image_linear, srgb_from_linear, write_png
from seasonscapes.rendering.gbuffer import trace_gbuffer
from seasonscapes.rendering.hemisphere_rays import ray_scene
from seasonscapes.rendering.mitsuba_scene import mi_mesh
from seasonscapes.sky.models import SkyModel
from seasonscapes.texturing.inputs import unlit_scene
from seasonscapes.texturing.model_weights import WeightNames
from seasonscapes.texturing.path_inpainting import textured_frames
from seasonscapes.texturing.view_conditions import sample_covered, white_radiance
from seasonscapes.workflows.camera_paths import camera_path
from seasonscapes.workflows.full_run import AS_THE_PAPER
from seasonscapes.workflows.illumination import sky_model
from seasonscapes.workflows.inpainting import InpaintOptions, cloudiness_of, inpaint
from seasonscapes.workflows.painting import painting_of
from seasonscapes.workflows.path_completion import PathCompletionOptions
from seasonscapes.workflows.path_stages import make_path
from seasonscapes.workflows.photograph_files import PhotographSources
from seasonscapes.workflows.place import Place
from seasonscapes.workflows.run_methods import PathStages
from seasonscapes.workflows.synthetic_photographs import photograph_series
from seasonscapes.workflows.views import scene_cameras

ROWS = {
    "full": (),
    "without prompt": ("prompt",),
    "without depth": ("depth",),
    "without mask": ("mask",),
    "without IP-Adapter": ("image",),
    "without paint": ("paint",),
}


@dataclass(frozen=True)
class Study:
    """What all rows share: the place, its painted photographs and those held out."""

    place: Place
    sky: SkyModel
    times: tuple[datetime, ...]
    painted: PhotographSources
    held_out: PhotographSources
    cameras: dict[str, Camera]
    diffusion: PathCompletionOptions
    measure: Lpips
    seed: int


def prepared(arguments: argparse.Namespace, folder: Path) -> Study:
    """Photograph the place from its own cameras and between them; every second own one is painted, the others are held out."""
    quick = arguments.quick
    options = ss.MeshOptions(texel_m=120.0, max_error_m=6.0, refine=1) if quick else None
    place = ss.load_place(arguments.scene, ss.Workspace(folder / "work"), options=options)
    sky = sky_model("hosek" if quick else "clear")
    times = tuple(datetime.fromisoformat(each).replace(tzinfo=UTC) for each in arguments.times.split(","))
    size_px = arguments.size
    own = scene_cameras(place, size_px=size_px)
    # Between the place's own cameras: the path passes by, as the paper's does.
    between = camera_path(place, list(own.values()), arguments.held_out + 2).cameras[1:-1]
    others = {name: own[name] for name in list(own)[1::2]}
    others |= {f"between-{number}": camera for number, camera in enumerate(between)}
    chosen = {name: own[name] for name in list(own)[::2]}
    painted, held_out = (
        photograph_series(place, times, sky, folder / name, cameras=cameras, seed=arguments.seed)
        for name, cameras in (("painted", chosen), ("held-out", others))
    )
    path = make_path(place, PathStages(views=arguments.views), folder, size_px=size_px)[0]
    names = WeightNames(arguments.base, arguments.depth_net, arguments.inpaint_net, arguments.adapter)
    weights = None if arguments.weights == "hub" else Path(arguments.weights)
    diffusion = PathCompletionOptions(path, weights, names, steps=arguments.steps, frames=folder / "views")
    measure = load_lpips(arguments.lpips)
    return Study(place, sky, times, painted, held_out, others, diffusion, measure, arguments.seed)


def rows_of(study: Study, said: dict[str, str], figures: Path | None) -> Iterator[dict]:
    """One row for each ablation: means over the held-out photographs of all times."""
    terrain = ray_scene(mi_mesh(study.place.terrain, np.full(3, 0.2)))
    views = {name: trace_gbuffer(unlit_scene(terrain), camera) for name, camera in study.cameras.items()}
    paintings = {
        time: painting_of(study.place, study.painted, time, study.sky, AS_THE_PAPER).texture for time in study.times
    }
    whole = None
    for row, without in ROWS.items():
        scores, covered = [], []
        for time, painting in paintings.items():
            guide = photographs(study.painted, time)
            truths = photographs(study.held_out, time)
            check_files_held_out(list(truths.values()), tuple(guide.values()))
            told = replace(study.diffusion, without=frozenset(without), guide_image=next(iter(guide.values())))
            options = InpaintOptions("diffusion", seed=study.seed, diffusion=told, rest="telea")
            done = inpaint(study.place, painting, time, study.sky, options)
            covered.append(done.record["coverage"][-1])
            white = white_radiance(painting.values, painting.weight > 0.0)
            frames = textured_frames(
                done.completed.values, list(study.cameras.values()), terrain, white, cloudiness=cloudiness_of(study.sky)
            )
            for (name, view), frame in zip(views.items(), frames, strict=True):
                truth = np.clip(srgb_from_linear(read_image_linear(truths[name])), 0.0, 1.0)
                mask = reference_mask(view.depth)
                gain = matching_gain(truth[mask], frame[mask])
                picture = np.clip(srgb_from_linear(np.clip(frame * gain, 0.0, 1.0)), 0.0, 1.0)
                paper = score(truth, picture, mask, mode="paper", lpips=study.measure)
                seen = sample_covered(done.completed.values, done.completed.painted, view.uv)[1]
                valid_db = score(truth, picture, mask).psnr_db
                scores.append([paper.psnr_db, paper.ssim, paper.lpips, valid_db, (mask & ~seen).sum() / mask.sum()])
                if figures is not None:
                    write_png(figures / f"{row.replace(' ', '_')}_{name}_{time:%Y%m%dT%H%M}.png", frame * gain)
        psnr_db, ssim, lpips, valid_psnr_db, unpainted = np.mean(scores, axis=0)
        whole = lpips if whole is None else whole
        yield {
            "row": row,
            "psnr_db": psnr_db,
            "ssim": ssim,
            "lpips": lpips,
            "drop": drop(whole, lpips),
            "valid_psnr_db": valid_psnr_db,
            "unpainted": unpainted,
            "covered": float(np.mean(covered)),
            "pictures": len(scores),
            **said,
        }


def photographs(sources: PhotographSources, time: datetime) -> dict[str, Path]:
    """Paths of the photographs of a time, by webcam."""
    rows = read_manifest(sources.manifest)
    return {row.webcam: sources.manifest.parent / row.path for row in rows if row.time == time}


def about_weights(arguments: argparse.Namespace, folder: Path) -> dict[str, str]:
    """What the weights of this table are, for each row; random ones are made where none were named."""
    if arguments.weights is None:
        arguments.weights = str(write_tiny_weights(folder / "weights"))
        said = "tiny, random"
    else:
        said = "the hub's cache" if arguments.weights == "hub" else arguments.weights
    if arguments.lpips is None:
        arguments.lpips = write_tiny_lpips(folder)
        return {"weights": said, "lpips_weights": "random"}
    return {"weights": said, "lpips_weights": "published" if lpips_sources(arguments.lpips)["published"] else "others"}


def size_of(text: str) -> tuple[int, int]:
    width, height = (int(part) for part in text.lower().split("x"))
    return width, height


def parsed(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = WeightNames()
    parser.add_argument("--weights", help="folder with OWNER/NAME, or hub; tiny random ones are made without")
    parser.add_argument("--base", default=names.base)
    parser.add_argument("--depth-net", default=names.depth)
    parser.add_argument("--inpaint-net", default=names.inpaint)
    parser.add_argument("--adapter", default=names.adapter)
    parser.add_argument("--lpips", type=Path, help="file of `seasonscapes lpips`; random weights are drawn without")
    parser.add_argument("--scene", default="alpine_small", help="a synthetic scene")
    parser.add_argument("--views", type=int, help="of the path")
    parser.add_argument("--steps", type=int, help="of the sampler")
    parser.add_argument("--size", type=size_of, help="of photographs and views [px]")
    parser.add_argument(
        "--held-out", type=int, help="cameras between the place's own, scored beside every second own one"
    )
    parser.add_argument("--times", help="UTC, with commas between")
    parser.add_argument("--quick", action="store_true", help="3 views of 96 × 64 px, 2 steps, one time")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--figures", type=Path)
    chosen = parser.parse_args(arguments)
    default = {"views": 12, "steps": 50, "size": (1536, 1024), "held_out": 6}
    default |= {"times": "2024-07-20T08:00,2024-07-20T13:00"}
    if chosen.weights is None:
        # No more than random weights are worth.
        default |= {"views": 6, "steps": 4, "size": (192, 128), "held_out": 3}
    if chosen.quick:
        default = {"views": 3, "steps": 2, "size": (96, 64), "held_out": 2, "times": "2024-07-20T08:00"}
    for name, value in default.items():
        if getattr(chosen, name) is None:
            setattr(chosen, name, value)
    return chosen


def main(arguments: Sequence[str] | None = None) -> list[dict]:
    """Make the table; returns its rows."""
    chosen = parsed(arguments)
    rows = []
    with tempfile.TemporaryDirectory(prefix="paper-table-") as folder:
        said = about_weights(chosen, Path(folder))
        study = prepared(chosen, Path(folder))
        for row in rows_of(study, said, chosen.figures):
            rows.append(row)
            print(f"{row['row']}: done", file=sys.stderr, flush=True)
    print("\n".join(table_lines(rows)))
    write_record(chosen.json, {"rows": rows}, seed=chosen.seed)
    return rows


if __name__ == "__main__":
    main()
