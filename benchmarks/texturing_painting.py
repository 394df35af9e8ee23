"""How well photographs are painted: what is seen, what leaks, whether cameras agree, what stands before the land.

    python benchmarks/texturing_painting.py [--quick] [--seed N] [--json FILE]

A massif whose albedo, light and poses are known, photographed by webcams with their faults. `measure` is also called by
``benchmarks/texturing.py``.
"""

from __future__ import annotations

import argparse
import secrets
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))
sys.path.append(str(HERE.parent / "tests"))

from albedo_scene import Truth, hours, lights_for, make_truth, terrain_and_albedo  # noqa: E402
from oracles_visibility import BinnedTriangles  # noqa: E402
from record import write_record  # noqa: E402

from seasonscapes.evaluation.synthetic_webcams import SyntheticPicture, WebcamInstant, WebcamOptions, webcam_series  # noqa: E402
from seasonscapes.evaluation.webcam_faults import TYPICAL, PoseSigmas, add_foreground, degrade, perturb_pose  # noqa: E402
from seasonscapes.images import expose, linear_from_srgb, srgb_from_linear  # noqa: E402
from seasonscapes.rendering.coefficients import SamplingOptions  # noqa: E402
from seasonscapes.rendering.gbuffer import trace_gbuffer  # noqa: E402
from seasonscapes.rendering.hemisphere_rays import RayScene, ray_scene  # noqa: E402
from seasonscapes.rendering.irradiance import irradiance_blocks  # noqa: E402
from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh  # noqa: E402
from seasonscapes.sky.models import read_sky_model, with_overrides  # noqa: E402
from seasonscapes.terrain.atlas import measure_atlas  # noqa: E402
from seasonscapes.terrain.surface import Texture, sample_texture  # noqa: E402
from seasonscapes.texturing.atlas_tiles import AtlasTile, tile_surface, tiling  # noqa: E402
from seasonscapes.texturing.foreground import cross_validated_prediction, foreground_mask  # noqa: E402
from seasonscapes.texturing.inputs import PaintingInput, prepare_input  # noqa: E402
from seasonscapes.texturing.painting import PaintOptions, PaintTarget, paint_atlas  # noqa: E402
from seasonscapes.texturing.predictors import predictors_for  # noqa: E402
from seasonscapes.texturing.visibility import project_texels, visible_by_depth, visible_by_faces, visible_by_ray  # noqa: E402
from seasonscapes.workspace import default_workspace  # noqa: E402

EFFORT = SamplingOptions(shadow_samples=4, albedo_samples=16, rays=64, clusters=1024, clusters_per_receiver=32, rank=24)
SKY_KM = 60.0


@dataclass(frozen=True)
class Stage:
    """A massif, its webcams' pictures of one hour, and what the land truly sends."""

    truth: Truth
    atlas: object
    terrain: RayScene
    lights: list
    texel_m: float
    pictures: list[SyntheticPicture]


def make_stage(seed: int, *, quick: bool) -> Stage:
    """The pictures of a seed's massif, hour and faults."""
    texel_m = 6.0 if quick else 5.0
    truth = make_truth(
        seed,
        size_m=6000.0 if quick else 9000.0,
        spacing_m=30.0,
        texel_m=texel_m,
        cameras=6 if quick else 8,
        size_px=(480, 320) if quick else (720, 480),
    )
    rng = np.random.default_rng(seed)
    clock = float(rng.choice([8.5, 10.0, 13.5, 15.0]))
    sky = with_overrides(read_sky_model("clear"), visibility_km=SKY_KM)
    when = hours("2024-09-11", clock)
    lights = lights_for(when, truth.cameras, sky, default_workspace())[0]
    pictures = [
        webcam_series(
            truth.terrain,
            f"webcam-{n}",
            camera,
            [WebcamInstant(when[0], light, truth.albedo)],
            options=WebcamOptions(TYPICAL, sampling=EFFORT),
            seed=seed,
        )[0]
        for n, (camera, light) in enumerate(zip(truth.cameras, lights, strict=True))
    ]
    height, width = truth.shape
    atlas = measure_atlas(truth.terrain, "planar", width, height)
    return Stage(truth, atlas, ray_scene(mi_mesh(truth.terrain, truth.albedo)), lights, texel_m, pictures)


def with_foreground(stage: Stage, seed: int) -> Stage:
    """The same pictures taken again with houses and a mast before them, and poses that a good calibration leaves."""
    rng, pictures = np.random.default_rng([seed, 1]), []
    sigmas = PoseSigmas(heading_deg=0.05, pitch_deg=0.05, roll_deg=0.05, horizontal_m=1.0, vertical_m=1.0)
    for picture in stage.pictures:
        radiance, front = add_foreground(picture.radiance, rng)
        encoded, done = degrade(radiance, TYPICAL, rng)
        seen = replace(
            picture.observation,
            image=linear_from_srgb(encoded / np.float32(255.0)),
            camera=perturb_pose(picture.camera, sigmas, rng)[0],
        )
        pictures.append(
            replace(picture, observation=seen, encoded=encoded, radiance=radiance, foreground=front, development=done)
        )
    return replace(stage, pictures=pictures)


def shots_of(stage: Stage, **changes) -> list[PaintingInput]:
    """The stage's pictures as painting takes them."""
    return [
        PaintingInput(replace(picture.observation, **changes), light.aerial_perspective)
        for picture, light in zip(stage.pictures, stage.lights, strict=True)
    ]


def target_of(stage: Stage) -> PaintTarget:
    """The stage's terrain and atlas."""
    return PaintTarget(stage.truth.terrain, stage.atlas, stage.terrain)


def land_truth(stage: Stage, texel: np.ndarray, *, seed: int) -> np.ndarray:
    """Radiance ``(N, 3)`` [cd/m²] that texels truly send (NaN where no surface is found)."""
    surface = tile_surface(tiling(stage.truth.terrain, stage.atlas, tile_px=1 << 14), whole(stage))
    place = np.full((stage.atlas.width_px * stage.atlas.height_px, 3), np.nan)
    place[surface.texel] = surface.position_m
    albedo = stage.truth.albedo.reshape(-1, 3)[texel]
    radiance = np.full((len(texel), 3), np.nan)
    for index, _, (light,) in irradiance_blocks(
        stage.terrain, place[texel], [stage.lights[0]], replace(EFFORT, rays=256), seed=seed
    ):
        radiance[index] = albedo[index] / np.pi * light.total
    return radiance


def whole(stage: Stage) -> AtlasTile:
    """The atlas as one tile."""
    return AtlasTile(0, 0, stage.atlas.height_px, stage.atlas.width_px)


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
    scene = RenderScene(stage.terrain.mi_scene, stage.terrain.mi_terrain)
    truth, grazing, found, seconds, count = [], [], {}, 0.0, 0
    for camera in stage.truth.cameras:
        sight = project_texels(camera, surface)
        inside = np.flatnonzero(sight.inside)
        # Half of the sample are grazing texels, which are the hard ones.
        flat = inside[sight.cosine[inside] < 0.2]
        some = np.concatenate([rng.permutation(inside)[:rays], rng.permutation(flat)[:rays]])
        places, seen = surface[some], sight[some]
        truth.append(oracle.sees(places.position_m, places.face, camera.position_m))
        grazing.append(seen.cosine < 0.2)
        depth = trace_gbuffer(scene, camera).depth
        modes = {
            "ray": visible_by_ray(stage.terrain, camera, places, seen),
            "ray_lifted_2m": visible_by_ray(stage.terrain, camera, places, seen, offset_m=2.0),
            "depth": visible_by_depth(depth, seen),
            "depth_2pc": visible_by_depth(depth, seen, tolerance=0.02),
            "faces": visible_by_faces(stage.terrain, camera, places, seen),
        }
        for name, value in modes.items():
            found.setdefault(name, []).append(value)
        start = time.process_time()
        visible_by_ray(stage.terrain, camera, surface, project_texels(camera, surface))
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


def radiometry(stage: Stage, *, seed: int, texels: int = 20_000) -> dict:
    """Painted texels against the truth: one gain for all, gains, gains and haze; and the paper's first-come order."""
    inputs, rng = shots_of(stage), np.random.default_rng(seed)
    numbers, sample, truth = {}, None, None
    raw = [replace(item, air=None) for item in inputs]
    kinds = {
        "plain": PaintOptions(fit_gains=False),
        "harmonised": PaintOptions(),
        "no_haze_fit": PaintOptions(fit_haze=False),
        "first": PaintOptions(mode="first"),
    }
    for name, options in kinds.items():
        start = time.process_time()
        painting = paint_atlas(raw if name == "plain" else inputs, target_of(stage), options=options)
        seconds = time.process_time() - start
        if sample is None:
            painted = np.flatnonzero(painting.texture.weight.ravel() > 0.0)
            sample = np.sort(rng.permutation(painted)[:texels])
            truth = land_truth(stage, sample, seed=seed)
        got = painting.texture.values.reshape(-1, 3)[sample]
        numbers[f"painted_{name}_absolute_db"] = decibels(got, truth)
        # A picture's own exposure and tint are no fault of painting: the best gain for all texels together is taken out.
        there = (got > 0.0).all(axis=1) & (truth > 0.0).all(axis=1)
        level = np.exp(np.median(np.log(got[there] / truth[there]), axis=0))
        numbers[f"painted_{name}_db"] = decibels(got[there] / level, truth[there])
        if name == "harmonised":
            said = painting.radiometry
            gains = np.array([p.development.gains for p in stage.pictures])
            error = said.log_gain - np.log(gains)
            numbers |= {
                "painted_share": len(painted) / painting.best.size,
                "haze": said.haze,
                "gain_error": float(np.std(error - error.mean(axis=0))),
                "gain_bias": float(error.mean()),
                "scatter_after": said.scatter_after,
                "painting_mtexel_camera_per_cpu_s": painting.best.size * len(inputs) / 1e6 / seconds,
            }
    numbers["harmonising_gain_db"] = numbers["painted_harmonised_db"] - numbers["painted_plain_db"]
    return numbers


def reprojection(stage: Stage) -> dict:
    """A clean picture painted, and looked at again by its own camera."""
    decibel = []
    for picture in stage.pictures[:3]:
        gain = 0.25 / float(np.percentile(picture.surface, 99.0))
        image = np.clip(picture.surface * gain, 0.0, 1.0).astype(np.float32)
        item = PaintingInput(replace(picture.observation, image=image, camera=picture.camera))
        painting = paint_atlas([item], target_of(stage), options=PaintOptions(fit_gains=False))
        covered = (
            sample_texture((painting.texture.weight > 0)[..., None].astype(np.float32), picture.gbuffer.uv)[..., 0]
            > 0.999
        )
        back = (
            np.exp(painting.radiometry.log_gain[0])
            * sample_texture(painting.texture.values, picture.gbuffer.uv)[covered]
        )
        decibel.append(-10.0 * np.log10(np.mean((srgb_from_linear(back) - srgb_from_linear(image[covered])) ** 2)))
    return {"reprojection_db": float(np.mean(decibel)), "reprojection_worst_db": float(np.min(decibel))}


def two_ridges() -> dict:
    """Texels that are painted behind a knife-edge ridge, by closed form; painting is given no guard."""
    from test_painting import Land, camera_towards, texel_positions

    ridges = Land(
        lambda e, n: np.maximum(0.0, 100.0 - 0.5 * np.abs(n + 100.0)) + np.maximum(0.0, 160.0 - 0.5 * np.abs(n - 400.0))
    )
    eye = np.array([0.0, -550.0, 120.0])
    item = ridges.item(camera_towards(eye, (0.0, 400.0, 80.0), fov_deg=80.0), "south")
    painted = ridges.paint([item], guard=False, fit_gains=False).texture.weight > 0.0
    place, _ = texel_positions(ridges.terrain, ridges.atlas.width_px, ridges.atlas.height_px)
    n, z = place[..., 1].astype(float), place[..., 2].astype(float)
    hidden = np.zeros(n.shape, bool)
    for crest_n, crest_z in ((-100.0, 100.0), (400.0, 160.0)):
        beyond = n > crest_n + 1e-3
        hidden |= beyond & (
            eye[2] + (crest_n - eye[1]) / np.where(beyond, n - eye[1], 1.0) * (z - eye[2]) < crest_z - 0.05
        )
    return {
        "two_ridge_leaks": int(np.count_nonzero(painted & hidden)),
        "two_ridge_hidden": int(np.count_nonzero(hidden)),
    }


def guard(stage: Stage, *, seed: int, texels: int = 12_000) -> dict:
    """Poses that are 0.2° off: painted texels with and without keeping away from silhouettes."""
    rng = np.random.default_rng(seed)
    sigmas = PoseSigmas(heading_deg=0.2, pitch_deg=0.1)
    inputs = [
        replace(
            item,
            observation=replace(
                item.observation,
                camera=perturb_pose(item.observation.camera, sigmas, rng)[0],
                pose_sigma={"heading_deg": 0.2, "tilt_deg": 0.1},
            ),
        )
        for item in shots_of(stage)
    ]
    numbers, sample = {}, None
    for name, kept in (("unguarded", False), ("guarded", True)):
        painting = paint_atlas(inputs, target_of(stage), options=PaintOptions(guard=kept))
        painted = painting.texture.weight.ravel() > 0.0
        if sample is None:
            sample = np.sort(rng.permutation(np.flatnonzero(painted))[:texels])
            truth = land_truth(stage, sample, seed=seed)
        there = painted[sample]
        numbers[f"pose_{name}_db"] = decibels(painting.texture.values.reshape(-1, 3)[sample][there], truth[there])
        numbers[f"pose_{name}_share"] = float(there.mean())
    return numbers


def rejection(stage: Stage, *, seed: int, texels: int = 12_000) -> dict:
    """Houses and a mast before every webcam: how much of them is found, and what painting gains by it."""
    from seasonscapes.texturing.colour_regression import fit_regression, predict

    terrain, inputs = stage.truth.terrain, shots_of(stage)
    first = paint_atlas(inputs, target_of(stage))
    sun = stage.lights[0].sun
    # The land in another season serves as the satellite's image.
    summer = terrain_and_albedo(stage.truth.place, stage.truth.spacing_m, stage.texel_m, 190)[1]
    predictors = predictors_for(
        terrain, stage.atlas, satellite=Texture(summer), sun_direction=None if sun is None else sun.direction
    )

    def fit(predictor, target):
        regression = fit_regression(predictor, target, fast=True, seed=seed)
        return lambda other: predict(regression, other)[0]

    pictures = {picture.observation.webcam: picture for picture in stage.pictures}
    cut, scene = tiling(terrain, stage.atlas), RenderScene(stage.terrain.mi_scene, stage.terrain.mi_terrain)
    ready = [prepare_input(item, stage.terrain, cut) for item in inputs]
    uvs = [trace_gbuffer(scene, item.observation.camera).uv for item in inputs]
    rejects, painting = [None] * len(inputs), first
    # What was found at first no longer teaches the regression.
    for _ in range(2):
        expected = cross_validated_prediction(painting.texture, predictors.values, fit, seed=seed)
        number = {name: k for k, name in enumerate(first.webcams)}
        rejects = [
            foreground_mask(r, number[r.painting_input.observation.webcam], painting.radiometry, expected, uv)
            for r, uv in zip(ready, uvs, strict=True)
        ]
        painting = paint_atlas(inputs, target_of(stage), rejects=rejects)
    found, false = [], []
    for item, mask, uv in zip(inputs, rejects, uvs, strict=True):
        land, front = np.isfinite(uv).all(axis=2), pictures[item.observation.webcam].foreground
        found.append((np.count_nonzero(mask & front & land), np.count_nonzero(front & land)))
        false.append((np.count_nonzero(mask & ~front & land), np.count_nonzero(~front & land)))
    oracle = paint_atlas(inputs, target_of(stage), rejects=[pictures[s.observation.webcam].foreground for s in inputs])
    painted = np.flatnonzero(first.texture.weight.ravel() > 0.0)
    sample = np.sort(np.random.default_rng(seed).permutation(painted)[:texels])
    truth = land_truth(stage, sample, seed=seed)
    ratio = lambda pairs: sum(a for a, _ in pairs) / max(sum(b for _, b in pairs), 1)  # noqa: E731
    numbers = {"foreground_recall": ratio(found), "foreground_false_rejects": ratio(false)}
    for name, result in (("contaminated", first), ("rejected", painting), ("known", oracle)):
        there = result.texture.weight.ravel()[sample] > 0.0
        numbers[f"foreground_{name}_db"] = decibels(result.texture.values.reshape(-1, 3)[sample][there], truth[there])
    return numbers


def measure(quick: bool, seed: int) -> dict:
    """All numbers of painting, flat."""
    stage = make_stage(seed, quick=quick)
    numbers = visibility(stage, seed=seed, rays=400 if quick else 2000)
    numbers |= two_ridges() | reprojection(stage) | radiometry(stage, seed=seed) | guard(stage, seed=seed)
    numbers |= rejection(with_foreground(stage, seed), seed=seed)
    return {name: float(value) for name, value in numbers.items()}


def main() -> None:
    """Run by name; a table, and JSON where asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--json", type=Path, default=None)
    arguments = parser.parse_args()
    seed = secrets.randbelow(2**31) if arguments.seed is None else arguments.seed
    start = time.perf_counter()
    numbers = measure(arguments.quick, seed) | {"seed": seed, "seconds": time.perf_counter() - start}
    for name, value in numbers.items():
        print(f"{name:<48} {value:12.4f}")
    write_record(arguments.json, numbers, seed=seed)


if __name__ == "__main__":
    main()
