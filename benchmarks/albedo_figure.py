"""The picture of the albedo chapter: a webcam's photograph, the albedo found, and another hour beside the truth.

python benchmarks/albedo_figure.py docs/images/albedo.jpg [--seed N]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from albedo import FIT_DATE, flat, observations
from albedo_scene import hours, lights_for, make_truth, path_traced

from seasonscapes.albedo.albedo_completion import completed_estimate
from seasonscapes.albedo.closed_form import solve_albedo
from seasonscapes.albedo.forward_model import trace_texel_transport
from seasonscapes.albedo.photographs import EIGHT_BIT, prepare_photographs
from seasonscapes.albedo.standard_error import albedo_estimate
from seasonscapes.evaluation.webcam_faults import WebcamFaults
from seasonscapes.exposure import develop, exposure_ev100
from seasonscapes.images import atomic_path, srgb_from_linear
from seasonscapes.sky.models import read_sky_model
from seasonscapes.terrain.atlas import measure_atlas
from seasonscapes.texturing.predictors import predictors_for
from seasonscapes.workspace import default_workspace


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--camera", type=int, default=1)
    args = parser.parse_args()
    import cv2

    truth = make_truth(args.seed, size_m=7920.0, spacing_m=30.0, texel_m=20.0, cameras=4, size_px=(432, 288))
    model, workspace = read_sky_model("clear"), default_workspace()
    times = hours(FIT_DATE, 7.0, 9.0, 11.0, 13.0, 15.0)
    lights = lights_for(times, truth.cameras, model, workspace)
    pictures = path_traced(truth, truth.albedo, lights, spp=48, seed=1)
    seen, _ = observations(truth, times, pictures, WebcamFaults(tone_strength=0.0), 2)
    land = trace_texel_transport(truth.terrain, truth.shape)
    photographs = prepare_photographs(land, seen, flat(lights))
    fit = solve_albedo(land, photographs, noise_model=EIGHT_BIT)
    atlas = measure_atlas(truth.terrain, "planar", truth.albedo.shape[1], truth.albedo.shape[0])
    found = completed_estimate(albedo_estimate(land, photographs, fit), fit, None, predictors_for(truth.terrain, atlas))
    view = [args.camera]
    evening = [
        [light] for light in [lights_for(hours(FIT_DATE, 16.3), truth.cameras, model, workspace)[0][args.camera]]
    ]
    evening = [[None] * args.camera + evening[0]]
    relit, true = (
        path_traced(truth, albedo, evening, spp=256, seed=5, cameras=view)[0][0]
        for albedo in (found.albedo, truth.albedo)
    )
    ev = exposure_ev100(true)
    footprints = photographs[args.camera].footprints
    bare = np.zeros((footprints.camera.height_px * footprints.camera.width_px, 3), np.float32) + 0.75
    bare[footprints.pixel] = footprints.matrix(footprints.share) @ found.albedo.reshape(-1, 3)
    photograph = srgb_from_linear(seen[args.camera].image)
    panels = [
        photograph,
        srgb_from_linear(bare.reshape(photograph.shape)),
        srgb_from_linear(develop(relit, ev)),
        srgb_from_linear(develop(true, ev)),
    ]
    titles = ("photograph, 09:00", "albedo found", "relit, 18:18", "truth, 18:18")
    levels = [np.ascontiguousarray((255.0 * np.clip(panel, 0.0, 1.0)).astype(np.uint8)[..., ::-1]) for panel in panels]
    for image, title in zip(levels, titles, strict=True):
        for colour, thick in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(image, title, (8, 20), cv2.FONT_HERSHEY_SIMPLEX, 0.55, colour, thick, cv2.LINE_AA)
    sheet = np.concatenate([np.concatenate(levels[:2], axis=1), np.concatenate(levels[2:], axis=1)], axis=0)
    with atomic_path(args.output) as temporary:
        cv2.imwrite(str(temporary), sheet, [cv2.IMWRITE_JPEG_QUALITY, 90])
    error = (relit - true)[np.isfinite(true)]
    print(f"{args.output}; root mean square difference {np.sqrt(np.mean(error**2)) / true.mean():.3f} of the mean")


if __name__ == "__main__":
    main()
