"""Normals below the heights, found from pictures of several hours: hours that no picture shows, with and without them.

The massif has heights 30 m apart; the recovery gets their means over 120 m, pictures of six hours by three cameras (8 bit, with
noise and JPEG, exposure and white balance unknown), and texels of 30 m. Truth are path-traced pictures of four other hours on
the fine heights. ``control`` is the closed form with as many rounds as the normals have. Truth and estimate share sky, air and
poses. The method was tuned on seed 11.

    python benchmarks/subgrid_normals.py --seed 23 --json benchmarks/results/subgrid_normals.json    # about three minutes
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from affine import Affine
from albedo import flat, observations
from albedo_scene import LATITUDE_DEG, LONGITUDE_DEG, Truth, hours, lights_for, make_truth, path_traced
from record import write_record

from seasonscapes.albedo.closed_form import AlbedoFit, SolverOptions, solve_albedo
from seasonscapes.albedo.equations import equations_of, forward_product
from seasonscapes.albedo.footprints import whole_pixels
from seasonscapes.albedo.forward_model import TexelTransport, ambient_on_texels, trace_texel_transport
from seasonscapes.albedo.photographs import EIGHT_BIT, AlbedoPhotograph, prepare_photographs
from seasonscapes.albedo.subgrid_normals import solve_tilts, tilt_sigma, tilted_photographs
from seasonscapes.evaluation.webcam_faults import WebcamFaults
from seasonscapes.exposure import develop, exposure_ev100
from seasonscapes.frames import LocalFrame
from seasonscapes.images import srgb_from_linear
from seasonscapes.rendering.backend import use_backend
from seasonscapes.sky.models import read_sky_model
from seasonscapes.terrain.mesh import build_mesh
from seasonscapes.terrain.refine import refine_raster
from seasonscapes.terrain.surface_grid import surface_grid
from seasonscapes.terrain.unwrap import unwrap
from seasonscapes.workflows.terrain_building import sample_spacing_m
from seasonscapes.workspace import default_workspace

DATE, SEEN, HELD_OUT = "2024-09-10", (6.5, 8.5, 10.0, 12.0, 13.5, 15.5), (7.5, 9.3, 11.0, 14.4)
SIZE_M, SPACING_M, FACTOR, TEXEL_M = 5760.0, 30.0, 4, 30.0
CAMERAS, PICTURE_PX = 3, (288, 192)
CONTROL_ROUNDS = 9


@dataclass(frozen=True)
class Case:
    """The fine land, the coarse one that the recovery knows, and pictures: those of the seen hours first."""

    truth: Truth
    land: TexelTransport
    sigma: float
    photographs: list[AlbedoPhotograph]
    pictures: list[np.ndarray]

    @property
    def seen(self) -> list[AlbedoPhotograph]:
        """The photographs that the recovery gets."""
        return self.photographs[: len(SEEN) * CAMERAS]


def case_of(seed: int) -> Case:
    """The massif of a seed, its coarse heights, and its pictures."""
    truth = make_truth(seed, size_m=SIZE_M, spacing_m=SPACING_M, texel_m=TEXEL_M, cameras=CAMERAS, size_px=PICTURE_PX)
    fine = surface_grid(truth.place.elevation, truth.terrain.frame)
    truth = replace(truth, terrain=replace(truth.terrain, surface=fine))
    times = hours(DATE, *SEEN) + hours(DATE, *HELD_OUT)
    lights = lights_for(times, truth.cameras, read_sky_model("clear"), default_workspace())
    pictures = path_traced(truth, truth.albedo, lights, spp=32, seed=seed)
    raster = truth.place.elevation
    heights = raster.values[..., 0]
    rows, columns = (side // FACTOR for side in heights.shape)
    means = cv2.resize(
        heights[: rows * FACTOR, : columns * FACTOR], (columns, rows), interpolation=cv2.INTER_AREA
    ).astype(np.float32)
    coarse = replace(raster, values=means[..., None], transform=raster.transform * Affine.scale(FACTOR))
    frame, smooth = LocalFrame(LATITUDE_DEG, LONGITUDE_DEG), refine_raster(coarse, FACTOR)
    terrain, atlas = unwrap(build_mesh(smooth, frame, mesher="grid"), texel_m=TEXEL_M)
    terrain = replace(terrain, surface=surface_grid(smooth, frame))
    land = trace_texel_transport(terrain, (atlas.height_px, atlas.width_px))
    seen, _ = observations(truth, times, pictures, WebcamFaults(tone_strength=0.0), seed + 1)
    photographs = prepare_photographs(land, seen, flat(lights))
    sigma = tilt_sigma(means, sample_spacing_m(coarse), TEXEL_M)
    return Case(truth, land, sigma, photographs, [image for row in pictures for image in row])


def held_out_db(case: Case, fit: AlbedoFit, tilt: np.ndarray | None) -> tuple[float, np.ndarray]:
    """PSNR of the held-out hours in sRGB, over all pixels and of each picture, with the recovery's own forward model."""
    size = case.land.shape[0] * case.land.shape[1]
    normal = np.tile(np.array([0.0, 0.0, 1.0]), (size, 1))
    normal[case.land.texel] = case.land.normal
    held = case.photographs[len(case.seen) :]
    if tilt is not None:
        held = tilted_photographs(held, normal, tilt.reshape(-1, 3))
    errors = []
    for photograph, image in zip(held, case.pictures[len(case.seen) :], strict=True):
        equations = equations_of(photograph, EIGHT_BIT, size)
        equations.ambient = ambient_on_texels(case.land, photograph.light, fit.albedo)
        radiance = forward_product(equations, fit.albedo.reshape(-1, 3))[0] + equations.airlight
        known = (fit.pixel_count.ravel() > 0.5).astype(np.float32)
        footprints = photograph.footprints
        judged = whole_pixels(footprints) & (footprints.matrix(footprints.share) @ known > 0.9)
        ev100 = exposure_ev100(image)
        true = srgb_from_linear(develop(image, ev100)).reshape(-1, 3)[footprints.pixel]
        errors.append(((srgb_from_linear(develop(radiance[None], ev100))[0] - true) ** 2)[judged])
    each = np.array([-10.0 * np.log10(np.mean(error)) for error in errors])
    return float(-10.0 * np.log10(np.mean(np.concatenate(errors)))), each


def normals_error_deg(case: Case, tilt: np.ndarray, *, tilted: bool) -> float:
    """Root mean square angle of the normals from the fine surface's, of texels that were tilted [deg]."""
    surface, land = case.truth.terrain.surface, case.land
    assert surface is not None
    own = tilt.reshape(-1, 3)[land.texel]
    normal = land.normal + (own if tilted else 0.0)
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((normal * surface.sample(land.position_m)[1]).sum(axis=1), -1.0, 1.0)))
    return float(np.sqrt(np.mean(angle[np.linalg.norm(own, axis=1) > 0.0] ** 2)))


def main() -> None:
    """Recover with and without normals, and compare both at hours that no picture shows."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=23)
    parser.add_argument("--json", type=Path, default=None)
    arguments = parser.parse_args()
    use_backend()
    case = case_of(arguments.seed)
    start = time.process_time()
    closed = solve_albedo(case.land, case.seen, noise_model=EIGHT_BIT)
    closed_s, start = time.process_time() - start, time.process_time()
    tilt, fit = solve_tilts(case.land, case.seen, closed, case.sigma, noise_model=EIGHT_BIT)
    tilts_s = time.process_time() - start
    control = solve_albedo(case.land, case.seen, noise_model=EIGHT_BIT, solver=SolverOptions(rounds=CONTROL_ROUNDS))
    (without, each_without), (with_normals, each_with) = held_out_db(case, control, None), held_out_db(case, fit, tilt)
    result = {
        "held_out_psnr_db": with_normals,
        "without_normals_psnr_db": without,
        "closed_form_psnr_db": held_out_db(case, closed, None)[0],
        "better_pictures": float((each_with > each_without).sum()),
        "pictures": float(len(each_with)),
        "residual": float(np.median(fit.residual)),
        "without_normals_residual": float(np.median(control.residual)),
        "normals_error_deg": normals_error_deg(case, tilt, tilted=True),
        "heights_normals_error_deg": normals_error_deg(case, tilt, tilted=False),
        "tilt_sigma": float(case.sigma),
        "closed_form_s": closed_s,
        "tilts_s": tilts_s,
    }
    for name, value in result.items():
        print(f"{name:28s} {value:8.3f}")
    write_record(arguments.json, result, seed=arguments.seed)


if __name__ == "__main__":
    main()
