"""How well photographs are painted: what is seen, what leaks, whether cameras agree, what stands before the land.

    python benchmarks/texturing_painting.py [--quick] [--seed N] [--json FILE]

A massif whose albedo, light and poses are known, photographed by webcams with their faults. `measure` is also called by
``benchmarks/texturing.py``.
"""

from __future__ import annotations

import argparse
import json
import secrets
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
sys.path.append(str(HERE.parent / "tests"))

from albedo_scene import Truth, hours, lights_for, make_truth  # noqa: E402
from oracles_visibility import BinnedTriangles  # noqa: E402

from seasonscapes.evaluation.synthetic_webcams import Hour, SyntheticPicture, webcam_series  # noqa: E402
from seasonscapes.evaluation.webcam_faults import CLEAN, TYPICAL, PoseSigmas  # noqa: E402
from seasonscapes.images import expose, srgb_from_linear  # noqa: E402
from seasonscapes.rendering.gather import Occluder, occluder  # noqa: E402
from seasonscapes.rendering.gbuffer import trace_gbuffer  # noqa: E402
from seasonscapes.rendering.irradiance import irradiance_blocks  # noqa: E402
from seasonscapes.rendering.scene import RenderScene, mi_mesh  # noqa: E402
from seasonscapes.rendering.transport import Effort  # noqa: E402
from seasonscapes.sky.models import read_sky_model, with_overrides  # noqa: E402
from seasonscapes.terrain.atlas import measure_atlas  # noqa: E402
from seasonscapes.terrain.surface import Terrain, Texture, sample_texture  # noqa: E402
from seasonscapes.texturing.foreground import foreground_mask, predict_in_folds  # noqa: E402
from seasonscapes.texturing.guides import guides_for  # noqa: E402
from seasonscapes.texturing.paint import Painting, PaintOptions, paint  # noqa: E402
from seasonscapes.texturing.shots import Shot  # noqa: E402
from seasonscapes.texturing.tiles import TexelSurface, Tile, tile_surface, tiling  # noqa: E402
from seasonscapes.texturing.visibility import by_depth, by_faces, by_ray, sight_of  # noqa: E402
from seasonscapes.workspace import default_workspace  # noqa: E402

EFFORT = Effort(subpixels=4, shades=16, rays=64, senders=1024, listed=32, rank=24)
SKY_KM = 60.0


@dataclass(frozen=True)
class Stage:
    """A massif, its webcams' pictures of one hour, and what the land truly sends."""

    truth: Truth
    atlas: object
    terrain: Occluder
    lights: list
    pictures: list[SyntheticPicture]


def make_stage(seed: int, *, quick: bool, foreground: bool = False, poses: PoseSigmas | None = None) -> Stage:
    """The pictures of a seed's massif, hour and faults."""
    size = (
        dict(size_m=6000.0, spacing_m=30.0, texel_m=6.0) if quick else dict(size_m=9000.0, spacing_m=25.0, texel_m=5.0)
    )
    truth = make_truth(seed, **size, cameras=6 if quick else 8, size_px=(480, 320) if quick else (720, 480))
    rng = np.random.default_rng(seed)
    clock = float(rng.choice([8.5, 10.0, 13.5, 15.0]))
    sky = with_overrides(read_sky_model("clear"), visibility_km=SKY_KM)
    when = hours("2024-09-11", clock)
    lights = lights_for(when, truth.cameras, sky, default_workspace())[0]
    pictures = [
        webcam_series(truth.terrain, f"webcam-{n}", camera, [Hour(when[0], light, truth.albedo)], faults=TYPICAL,
                      foreground=foreground, poses=poses, effort=EFFORT, seed=seed)[0]
        for n, (camera, light) in enumerate(zip(truth.cameras, lights, strict=True))
    ]  # fmt: skip
    height, width = truth.shape
    atlas = measure_atlas(truth.terrain, "planar", width, height)
    return Stage(truth, atlas, occluder(mi_mesh(truth.terrain, truth.albedo)), lights, pictures)


def shots_of(stage: Stage, **changes) -> list[Shot]:
    """The stage's pictures as painting takes them."""
    return [Shot(replace(picture.observation, **changes), light.aerial_perspective)
            for picture, light in zip(stage.pictures, stage.lights, strict=True)]  # fmt: skip


def land_truth(stage: Stage, texel: np.ndarray, *, seed: int) -> np.ndarray:
    """Radiance ``(N, 3)`` [cd/m²] that texels truly send (NaN where no surface is found)."""
    surface = tile_surface(tiling(stage.truth.terrain, stage.atlas, tile_px=1 << 14), whole(stage))
    place = np.full((stage.atlas.width_px * stage.atlas.height_px, 3), np.nan)
    place[surface.texel] = surface.position_m
    albedo = stage.truth.albedo.reshape(-1, 3)[texel]
    radiance = np.full((len(texel), 3), np.nan)
    for index, _, (light,) in irradiance_blocks(stage.terrain, place[texel], [stage.lights[0]], replace(EFFORT, rays=256),
                                                seed=seed):  # fmt: skip
        radiance[index] = albedo[index] / np.pi * light.total
    return radiance


def whole(stage: Stage) -> Tile:
    """The atlas as one tile."""
    return Tile(0, 0, stage.atlas.height_px, stage.atlas.width_px)


def decibels(got: np.ndarray, truth: np.ndarray) -> float:
    """PSNR of radiances ``(N, 3)`` as they show in a picture exposed for the truth."""
    sound = np.isfinite(truth).all(axis=1) & np.isfinite(got).all(axis=1)
    ev100 = float(np.log2(np.exp(np.mean(np.log(np.maximum(truth[sound].mean(axis=1), 1.0)))) / 0.125))
    a, b = (srgb_from_linear(np.clip(1.7 * expose(values[sound], ev100), 0.0, 1.0)) for values in (got, truth))
    return float(-10.0 * np.log10(np.mean((a - b) ** 2)))


def visibility(stage: Stage, *, seed: int, rays: int) -> dict:
    """Precision and recall of what a camera sees, against a scalar double-precision oracle; the others beside it."""
    terrain, rng = stage.truth.terrain, np.random.default_rng(seed)
    surface = tile_surface(tiling(terrain, stage.atlas, tile_px=1 << 14), whole(stage))
    oracle = BinnedTriangles(terrain.vertices, terrain.faces)
    scene = RenderScene(stage.terrain.mi_scene, stage.terrain.mi_terrain, None, 0.0)
    truth, grazing, found, seconds, count = [], [], {}, 0.0, 0
    for camera in stage.truth.cameras:
        sight = sight_of(camera, surface)
        inside = np.flatnonzero(sight.inside)
        # Half of the sample are grazing texels, which are the hard ones.
        flat = inside[sight.cosine[inside] < 0.2]
        some = np.concatenate([rng.permutation(inside)[:rays], rng.permutation(flat)[:rays]])
        places, seen = surface[some], sight[some]
        truth.append(oracle.sees(places.position_m, places.face, camera.position_m))
        grazing.append(seen.cosine < 0.2)
        depth = trace_gbuffer(scene, camera).depth
        modes = {"ray": by_ray(stage.terrain, camera, places, seen),
                 "ray_lifted_2m": by_ray(stage.terrain, camera, places, seen, lift_m=2.0),
                 "depth": by_depth(depth, seen), "depth_2pc": by_depth(depth, seen, tolerance=0.02),
                 "faces": by_faces(stage.terrain, camera, places, seen)}  # fmt: skip
        for name, value in modes.items():
            found.setdefault(name, []).append(value)
        start = time.process_time()
        by_ray(stage.terrain, camera, surface, sight_of(camera, surface))
        seconds, count = seconds + time.process_time() - start, count + len(surface.texel)
    truth, grazing = np.concatenate(truth), np.concatenate(grazing)
    numbers = {"visibility_mtexel_per_cpu_s": count / 1e6 / seconds, "visibility_samples": len(truth)}
    for name, parts in found.items():
        value = np.concatenate(parts)
        for label, part in (("", np.ones(len(truth), bool)), ("_grazing", grazing)):
            hit = np.count_nonzero(value & truth & part)
            prefix = "visibility" if name == "ray" else f"visibility_by_{name}"
            numbers[f"{prefix}{label}_precision"] = hit / max(np.count_nonzero(value & part), 1)
            numbers[f"{prefix}{label}_recall"] = hit / max(np.count_nonzero(truth & part), 1)
    return numbers


def harmony(stage: Stage, *, seed: int, texels: int = 20_000) -> dict:
    """Painted texels against the truth: one gain for all, gains, gains and haze; and the paper's first-come order."""
    shots, terrain, rng = shots_of(stage), stage.truth.terrain, np.random.default_rng(seed)
    numbers, sample, truth = {}, None, None
    kinds = {"plain": PaintOptions(fit_gains=False), "harmonised": PaintOptions(), "no_haze_fit": PaintOptions(fit_haze=False),
             "first": PaintOptions(mode="first")}  # fmt: skip
    for name, options in kinds.items():
        start = time.process_time()
        painting = paint(shots, terrain, stage.atlas, stage.terrain, options=options)
        seconds = time.process_time() - start
        if sample is None:
            painted = np.flatnonzero(painting.texture.weight.ravel() > 0.0)
            sample = np.sort(rng.permutation(painted)[:texels])
            truth = land_truth(stage, sample, seed=seed)
        numbers[f"painted_{name}_db"] = decibels(painting.texture.values.reshape(-1, 3)[sample], truth)
        if name == "harmonised":
            said = painting.harmony
            gains = np.array([p.development.gains for p in stage.pictures])
            error = said.log_gain - np.log(gains)
            numbers |= {"painted_share": len(painted) / painting.best.size, "haze": said.haze,
                        "gain_error": float(np.std(error - error.mean(axis=0))), "gain_bias": float(error.mean()),
                        "scatter_after": said.scatter_after,
                        "painting_mtexel_camera_per_cpu_s": painting.best.size * len(shots) / 1e6 / seconds}  # fmt: skip
    numbers["harmonising_gain_db"] = numbers["painted_harmonised_db"] - numbers["painted_plain_db"]
    return numbers
