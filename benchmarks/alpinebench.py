"""From webcams to relit pictures, against the truth: what each stage loses, what all lose together, what each idea earns.

    python benchmarks/alpinebench.py [--quick] [--size quick|small|medium] [--seed N] [--json FILE] [--figures FOLDER]

A massif whose albedo, light and poses are known is photographed by webcams at full physics, and degraded as webcams do
(auto exposure, white balance, tone curve, noise, JPEG, haze; poses of GPS and compass, calibrated from clicked points).
Views that no webcam saw, and hours that no picture was used of, are judged: pictures developed with the truth's exposure,
land beyond 60 m, mode ``valid``. ``matched`` fits one factor for each colour first, as one must for a real webcam.

* Painted hours: the painted and completed texture, seen from the judged webcam through the air.
* Held-out hours: the albedo recovered from the painted hours' pictures, relit.
* Distilled: Gaussians that learned from that albedo under suns of other days, seen at the held-out hours.
* Each stage alone is given the truth of the stages before it. Ablations change one thing of the whole.
* The satellite's image shows reflectance on a July forenoon with that hour's shades in it, as such images do, on the same
  texels. Satellite only is that image on the terrain without air, at the best exposure there is for each picture.
"""

from __future__ import annotations

import argparse
import json
import os
import secrets
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path
from unittest import mock

import numpy as np

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")
sys.path.insert(0, str(Path(__file__).parent))

from albedo_scene import LATITUDE_DEG, LONGITUDE_DEG, hours, lights_for  # noqa: E402
from alpinebench_scene import (  # noqa: E402
    DAY_OF_YEAR,
    SATELLITE_DATE,
    SIZES,
    Pictures,
    World,
    make_world,
    observed,
    pose_errors,
    take_pictures,
)

from seasonscapes.albedo.closed_form import AlbedoFit, solve_albedo  # noqa: E402
from seasonscapes.albedo.forward import Land, ambient_on_texels, sun_on_texels, trace_land  # noqa: E402
from seasonscapes.albedo.response import fit_response, with_response  # noqa: E402
from seasonscapes.albedo.shots import EIGHT_BIT, LINEAR, make_shots  # noqa: E402
from seasonscapes.evaluation.figures import comparison, steepest_window  # noqa: E402
from seasonscapes.evaluation.lpips import load_lpips, missing_lpips  # noqa: E402
from seasonscapes.evaluation.masks import land_mask  # noqa: E402
from seasonscapes.evaluation.metrics import score  # noqa: E402
from seasonscapes.evaluation.surfaces import albedo_error  # noqa: E402
from seasonscapes.evaluation.synthetic_webcams import SyntheticPicture  # noqa: E402
from seasonscapes.evaluation.tables import by_distance, drop, table_lines  # noqa: E402
from seasonscapes.exposure import develop, exposure_ev100  # noqa: E402
from seasonscapes.frames import LocalFrame  # noqa: E402
from seasonscapes.images import srgb_from_linear, write_png8  # noqa: E402
from seasonscapes.rendering.gbuffer import trace_gbuffer  # noqa: E402
from seasonscapes.rendering.radiance import through_air  # noqa: E402
from seasonscapes.rendering.relit_view import ready_view, relight_view, senders_albedo, with_albedo  # noqa: E402
from seasonscapes.rendering.scene import RenderScene, set_albedo  # noqa: E402
from seasonscapes.rendering.transport import Effort, trace_view, view_albedo  # noqa: E402
from seasonscapes.sky.ephemeris import sun_position  # noqa: E402
from seasonscapes.sky.illumination import Illumination, global_horizontal_illuminance  # noqa: E402
from seasonscapes.terrain.surface import Texture, sample_texture  # noqa: E402
from seasonscapes.texturing.complete import complete  # noqa: E402
from seasonscapes.texturing.guides import Guides, guides_for  # noqa: E402
from seasonscapes.texturing.paint import Painting, PaintOptions, paint  # noqa: E402
from seasonscapes.texturing.shots import Shot  # noqa: E402
from seasonscapes.workspace import default_workspace  # noqa: E402

_TEXEL = Effort(subpixels=1, rays=64, listed=32, senders=1024, rank=24)
_SUBPIXELS = 3
# Days and hours that Gaussians learn from; the judged day is not among them.
LESSONS = (("2024-01-15", 11.0), ("2024-03-10", 8.5), ("2024-04-20", 15.0), ("2024-05-12", 6.5), ("2024-06-18", 12.0),
           ("2024-07-05", 17.0), ("2024-08-14", 9.5), ("2024-10-08", 13.5))  # fmt: skip
NEAR_M = 60.0


class Judge:
    """Judged webcams: their truth, and pictures of textures and of albedos from where they stand."""

    def __init__(self, world: World, pictures: Pictures, lpips):
        self.world, self.rows, self.lpips = world, pictures.judged, lpips
        self.scene = RenderScene(world.bare.mi_scene, world.bare.mi_terrain, None, 0.0)
        self.uv, self.coverage, self.ready = [], [], []
        for number, camera in enumerate(world.judged):
            offset = (np.arange(_SUBPIXELS) + 0.5) / _SUBPIXELS
            across, down = np.meshgrid(offset, offset)
            corner = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), axis=-1)
            pixel = corner[..., None, :] + np.stack([across.ravel(), down.ravel()], axis=-1)
            seen = trace_gbuffer(self.scene, camera, pixel)
            self.uv.append(seen.uv)
            self.coverage.append(np.isfinite(seen.depth).mean(axis=-1).astype(np.float32))
            # Other random numbers than the truth's.
            set_albedo(self.scene, world.albedo)
            made = trace_view(world.bare, camera, world.size.effort, seed=world.seed + 1000 + number)
            self.ready.append(ready_view(world.bare, made))

    def light(self, camera: int, at: datetime) -> Illumination:
        return self.world.lights[at][len(self.world.painting) + camera]

    def truth(self, camera: int, at: datetime) -> SyntheticPicture:
        return self.rows[camera][self.world.hours.index(at)]

    def of_texture(self, radiance: np.ndarray, camera: int, at: datetime, *, air: bool = True) -> np.ndarray:
        """The view ``(H, W, 3)`` [cd/m²] of a texture of radiance."""
        surface = np.nan_to_num(sample_texture(radiance, self.uv[camera])).mean(axis=2)
        light = self.light(camera, at)
        light = light if air else replace(light, aerial_perspective=None)
        stage = RenderScene(self.world.bare.mi_scene, self.world.bare.mi_terrain, light, 0.0)
        return through_air(
            stage, self.world.judged[camera], surface, self.coverage[camera], self.truth(camera, at).gbuffer
        )

    def of_albedo(self, albedo: np.ndarray, *, air: bool = True) -> Callable[[int, datetime], np.ndarray]:
        """Views of a texture of albedo under any light."""
        set_albedo(self.scene, albedo)
        clothed = [with_albedo(ready, view_albedo(self.world.bare, ready.coefficients), senders_albedo(ready.coefficients, albedo))
                   for ready in self.ready]  # fmt: skip

        def relit(camera: int, at: datetime) -> np.ndarray:
            light = self.light(camera, at)
            return relight_view(clothed[camera], light if air else replace(light, aerial_perspective=None)).radiance

        return relit

    def mask(self, camera: int) -> np.ndarray:
        return land_mask(self.rows[camera][0].gbuffer.depth, near_m=NEAR_M)

    def developed(self, radiance: np.ndarray, camera: int, at: datetime) -> np.ndarray:
        """With the exposure of the truth, sRGB-encoded."""
        ev100 = exposure_ev100(self.truth(camera, at).radiance)
        return srgb_from_linear(np.clip(develop(np.maximum(radiance, 0.0), ev100), 0.0, 1.0))

    def matched(self, radiance: np.ndarray, camera: int, at: datetime) -> np.ndarray:
        """Radiance times one factor for each colour that brings it nearest to the truth, by the medians of ratios."""
        true, mask = self.truth(camera, at).radiance, self.mask(camera)
        kept = mask & (radiance > 0.0).all(axis=2) & (true > 0.0).all(axis=2)
        return radiance * np.exp(np.median(np.log(true[kept] / radiance[kept]), axis=0))

    def scores(self, view: Callable[[int, datetime], np.ndarray], times, *, mode: str = "valid") -> dict[str, float]:
        """Means over judged webcams and times, of the picture as it is and with its colours matched."""
        found = []
        for camera in range(len(self.rows)):
            for at in times:
                picture, mask = view(camera, at), self.mask(camera)
                true = self.developed(self.truth(camera, at).radiance, camera, at)
                one = score(true, self.developed(picture, camera, at), mask, mode=mode, lpips=self.lpips).record()
                fair = score(
                    true, self.developed(self.matched(picture, camera, at), camera, at), mask, mode=mode
                ).record()
                found.append(one | {"matched_psnr_db": fair["psnr_db"]})
        return {name: float(np.mean([row[name] for row in found])) for name in found[0]}


class Bench:
    """The stages, each with what it is given."""

    def __init__(self, seed: int, size: str, lpips):
        self.clock = Clock()
        self.world = make_world(seed, SIZES[size])
        self.clock.tell("world")
        self.pictures = take_pictures(self.world)
        self.clock.tell("webcams' pictures, calibrated")
        self.judge = Judge(self.world, self.pictures, lpips)
        self.clock.tell("judged views")
        self.land: Land = trace_land(self.world.terrain, self.world.albedo.shape[:2], effort=_TEXEL, seed=seed)
        self.clock.tell("daylight coefficients of texels")
        self.satellite = Texture(self._from_above(), np.ones(self.world.albedo.shape[:2], np.float32))
        self.guides = {at: self._guides(at) for at in self.world.painted_hours}
        self.clock.tell("satellite and guides")

    def _from_above(self) -> np.ndarray:
        """Reflectance ``(R, S, 3)`` as a satellite's image holds it: the land's radiance over that of even white ground."""
        (light,) = lights_for(
            hours(SATELLITE_DATE, 10.5), self.world.painting[:1], self.world.sky, default_workspace()
        )[0]
        radiance = self.true_texture(light, self.world.summer)
        return (np.pi * radiance / np.asarray(global_horizontal_illuminance(light), np.float32)).astype(np.float32)

    def _guides(self, at: datetime, *, satellite: bool = True) -> Guides:
        day = [at.replace(hour=0, minute=0) + timedelta(hours=h) for h in range(24)]
        suns = np.asarray(sun_position(day, LATITUDE_DEG, LONGITUDE_DEG).direction, float)
        return guides_for(self.world.terrain, self.world.atlas, satellite=self.satellite if satellite else None,
                          sun_direction=sun_position(at, LATITUDE_DEG, LONGITUDE_DEG).direction, day_suns=suns)  # fmt: skip

    def true_texture(self, light: Illumination, albedo: np.ndarray) -> np.ndarray:
        """Radiance ``(R, S, 3)`` [cd/m²] that an albedo sends under a light."""
        received = sun_on_texels(self.land, light) + ambient_on_texels(self.land, light, albedo)
        return (albedo * received.reshape(albedo.shape) / np.pi).astype(np.float32)

    def painted(self, at: datetime, options: PaintOptions | None = None, *, clean: bool = False, true_pose: bool = False,
                air: bool = True) -> Painting:  # fmt: skip
        lights = self.world.lights[at]
        shots = [Shot(seen, lights[n].aerial_perspective if air else None, sigma)
                 for n, (seen, sigma) in enumerate(observed(self.pictures, self.world, at, clean=clean, true_pose=true_pose))]  # fmt: skip
        return paint(shots, self.world.terrain, self.world.atlas, self.world.bare, options=options)

    def completed(
        self, texture: Texture, at: datetime, *, method: str = "guided", guides: Guides | None = None
    ) -> np.ndarray:
        return complete(texture, guides or self.guides[at], method=method, fast=True, seed=self.world.seed).values

    def solved(self, *, clean: bool = False, true_pose: bool = False, response: bool = True) -> AlbedoFit:
        """Albedo from all painted hours' pictures; unless these are clean, their tone curve is searched for."""
        seen, lights, gains = [], [], []
        for at in self.world.painted_hours:
            for number, (one, _) in enumerate(
                observed(self.pictures, self.world, at, clean=clean, true_pose=true_pose)
            ):
                if clean:
                    one = replace(one, image=self.pictures.painting[number][self.world.hours.index(at)].radiance)
                seen.append(one)
                lights.append(self.world.lights[at][number])
                gains.append(np.ones(3) if clean else None)
        shots = make_shots(self.land, seen, lights, gains=gains, seed=self.world.seed)
        if response and not clean:
            shots = with_response(shots, fit_response(self.land, shots, seed=self.world.seed).strength)
        return solve_albedo(self.land, shots, trust=LINEAR if clean else EIGHT_BIT)

    def completed_albedo(self, fit: AlbedoFit) -> np.ndarray:
        """Seen texels' albedo, and what the land tells about the others."""
        at = self.world.painted_hours[0]
        texture = Texture(fit.albedo, (fit.seen >= 0.5).astype(np.float32))
        return np.clip(self.completed(texture, at), 0.004, 0.98)

    def seen_texels(self) -> np.ndarray:
        """Texels ``(R, S)`` that painting at true poses reaches, at the first painted hour."""
        return self.painted(self.world.painted_hours[0], true_pose=True).texture.weight > 0.0


class Splats:
    """Gaussians distilled from an albedo under suns of other days; discs and their light transport are made once."""

    def __init__(self, bench: Bench):
        from seasonscapes.gaussians.rasterise import choose_threads
        from seasonscapes.gaussians.surfels import surfel_albedo, terrain_surfels
        from seasonscapes.gaussians.transport import light_state, trace_transport

        choose_threads(1)
        self.bench, world = bench, bench.world
        self.surfels = terrain_surfels(world.terrain, world.size.disc_m)
        set_albedo(bench.judge.scene, world.albedo)
        self.transport = trace_transport(world.bare, self.surfels, surfel_albedo(self.surfels, world.albedo), rays=64,
                                         seed=world.seed)  # fmt: skip
        times = [hours(day, hour)[0] for day, hour in LESSONS]
        self.lights = [row[0] for row in lights_for(times, world.painting[:1], world.sky, default_workspace())]
        self.states = [light_state(self.transport, light, DAY_OF_YEAR) for light in self.lights]

    def views(self, albedo: np.ndarray) -> Callable[[int, datetime], np.ndarray]:
        """Views of the Gaussians that an albedo was distilled into."""
        from seasonscapes.gaussians.appearance import Appearance, fourier_embedding
        from seasonscapes.gaussians.distil import Schedule, distil, lessons_from
        from seasonscapes.gaussians.model import model_from
        from seasonscapes.gaussians.render import learned_numbers, model_weights, render_model
        from seasonscapes.gaussians.surfels import surfel_albedo
        from seasonscapes.gaussians.transport import neighbourhood_mean, surfel_irradiance

        world, seed = self.bench.world, self.bench.world.seed
        set_albedo(self.bench.judge.scene, albedo)
        own = surfel_albedo(self.surfels, albedo)
        around = neighbourhood_mean(self.surfels.means, own, self.surfels.plan.spacing_m)
        received = surfel_irradiance(world.bare, self.surfels, self.lights, rays=64, seed=seed)
        lessons = lessons_from(self.states, [0] * len(self.states), own[None], received)
        appearance = Appearance("full", own[None], around[None], self.transport, fourier_embedding(self.surfels.means, seed=seed),
                                times=len(self.states), seed=seed)  # fmt: skip
        distil(appearance, lessons, schedule=Schedule(surface_steps=600), seed=seed)
        model = model_from(self.surfels, own[None], [DAY_OF_YEAR], self.transport, kind="full",
                           frame=LocalFrame(LATITUDE_DEG, LONGITUDE_DEG), appearance=learned_numbers(appearance))  # fmt: skip
        weights = [model_weights(model, camera) for camera in world.judged]

        def view(camera: int, at: datetime) -> np.ndarray:
            light = self.bench.judge.light(camera, at)
            return render_model(model, world.judged[camera], light, DAY_OF_YEAR, weights=weights[camera]).radiance

        return view


class Clock:
    """Processor and wall seconds between stages, on stderr."""

    def __init__(self):
        self.cpu, self.wall, self.start = time.process_time(), time.perf_counter(), time.perf_counter()

    def tell(self, what: str) -> None:
        cpu, wall = time.process_time(), time.perf_counter()
        print(f"  {what}: {cpu - self.cpu:.1f} CPU-s, {wall - self.wall:.1f} s", file=sys.stderr, flush=True)
        self.cpu, self.wall = cpu, wall


# ---------------------------------------------------------------------------------------------- the tables


class Rows(dict):
    """Scores by name; each is told as it is measured, so that a run that is interrupted has said what it knew."""

    def __setitem__(self, name: str, row: dict[str, float]) -> None:
        print(f"    {name}: {row['psnr_db']:.2f} dB, matched {row['matched_psnr_db']:.2f} dB, SSIM {row['ssim']:.3f}",
              file=sys.stderr, flush=True)  # fmt: skip
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
    rows["paint alone, clean + inpaint"] = judge.scores(filled({at: bench.painted(at, clean=True, true_pose=True)
                                                                 for at in painted}), painted)  # fmt: skip
    rows["harmonise + paint + inpaint"] = judge.scores(filled({at: bench.painted(at, true_pose=True) for at in painted}),
                                                       painted)  # fmt: skip
    bench.clock.tell("paint, harmonise")
    paintings = {at: bench.painted(at) for at in painted}
    textures = {at: bench.completed(painting.texture, at) for at, painting in paintings.items()}
    rows["all, painted hours"] = judge.scores(lambda c, at: judge.of_texture(textures[at], c, at), painted)
    bench.clock.tell("calibrated, painted, completed")
    rows["relight (true albedo)"] = judge.scores(judge.of_albedo(world.albedo), held)
    fit = bench.solved(clean=True, true_pose=True)
    rows["albedo alone, clean + relight"] = judge.scores(judge.of_albedo(bench.completed_albedo(fit)), held)
    bench.clock.tell("albedo alone")
    albedo_fit = bench.solved()
    albedo = bench.completed_albedo(albedo_fit)
    relit = judge.of_albedo(albedo)
    rows["all, held-out hours"] = judge.scores(relit, held)
    rows["all, relit painted hours"] = judge.scores(relit, painted)
    bench.clock.tell("albedo, relit")
    splats = Splats(bench)
    rows["distil alone (true albedo)"] = judge.scores(splats.views(world.albedo), held)
    rows["all, distilled, held-out hours"] = judge.scores(splats.views(albedo), held)
    bench.clock.tell("distilled twice")
    return rows, {
        "paintings": paintings,
        "textures": textures,
        "albedo": albedo,
        "fit": albedo_fit,
        "seen": seen,
        "relit": relit,
    }


def satellite_view(bench: Bench) -> Callable:
    """The image from above, evenly lit, without air; its exposure is the best there is."""
    judge = bench.judge

    def view(camera: int, at: datetime) -> np.ndarray:
        even = float(np.mean(global_horizontal_illuminance(judge.light(camera, at)))) / np.pi
        return judge.matched(
            judge.of_texture(bench.satellite.values * np.float32(even), camera, at, air=False), camera, at
        )

    return view


def ablations(bench: Bench, whole: dict) -> tuple[dict[str, dict], dict[str, dict]]:
    """One factor at a time: at painted hours, and at held-out hours."""
    judge, held = bench.judge, bench.world.held_hours
    # Two hours tell: a shaded one and a sunny one.
    painted = ablated_hours(bench)

    def texture_scores(textures: dict, *, air: bool = True) -> dict:
        return judge.scores(lambda c, at: judge.of_texture(textures[at], c, at, air=air), painted)

    def repainted(options: PaintOptions | None = None, **how) -> dict:
        return {at: bench.completed(bench.painted(at, options, **how).texture, at) for at in painted}

    def refilled(method: str) -> dict:
        return {at: bench.completed(whole["paintings"][at].texture, at, method=method) for at in painted}

    rows = Rows()
    rows["full"] = texture_scores(whole["textures"])
    summer = judge.of_albedo(bench.satellite.values)
    rows["no painting (summer's image, relit)"] = judge.scores(summer, painted)
    with mock.patch(
        "seasonscapes.texturing.paint.by_ray", lambda terrain, camera, surface, sight: np.ones(len(surface.texel), bool)
    ):
        rows["no occlusion test"] = texture_scores(repainted())
    bench.clock.tell("no occlusion test")
    rows["no gain compensation"] = texture_scores(repainted(PaintOptions(fit_gains=False)))
    rows["first camera wins (as the paper)"] = texture_scores(repainted(PaintOptions(mode="first")))
    rows["no silhouette guard"] = texture_scores(repainted(PaintOptions(guard=False)))
    bench.clock.tell("painting's ablations")
    rows["no guidance (membrane)"] = texture_scores(refilled("membrane"))
    rows["no guidance (Telea, as the paper)"] = texture_scores(refilled("telea"))
    rows["no satellite among the guides"] = texture_scores({
        at: bench.completed(whole["paintings"][at].texture, at, guides=bench._guides(at, satellite=False)) for at in painted})  # fmt: skip
    rows["no inpainting (one mean colour)"] = texture_scores(
        {at: one_colour(whole["paintings"][at].texture) for at in painted}
    )
    bench.clock.tell("completion's ablations")
    bare = repainted(air=False)
    # Without the model's sky nothing tells the scale: matched, which flatters.
    rows["no aerial perspective (matched)"] = judge.scores(
        lambda c, at: judge.matched(judge.of_texture(bare[at], c, at, air=False), c, at), painted
    )
    rows["satellite only, best exposure"] = judge.scores(satellite_view(bench), painted)
    late = Rows()
    late["full"] = judge.scores(whole["relit"], held)

    def nearest(camera: int, at: datetime) -> np.ndarray:
        source = min(painted, key=lambda other: abs(other - at))
        level = np.mean(
            global_horizontal_illuminance(judge.light(camera, at))
            / global_horizontal_illuminance(judge.light(camera, source))
        )
        return judge.of_texture(whole["textures"][source] * np.float32(level), camera, at)

    late["no albedo (nearest painted hour)"] = judge.scores(nearest, held)
    untold = bench.completed_albedo(bench.solved(response=False))
    late["no tone curve searched"] = judge.scores(judge.of_albedo(untold), held)
    late["no painting (summer's image, relit)"] = judge.scores(summer, held)
    late["no aerial perspective"] = judge.scores(judge.of_albedo(whole["albedo"], air=False), held)
    late["satellite only, best exposure"] = judge.scores(satellite_view(bench), held)
    bench.clock.tell("the other ablations")
    return rows, late


def ablated_hours(bench: Bench) -> tuple[datetime, ...]:
    """The first painted hour and the middle one."""
    painted = bench.world.painted_hours
    return (painted[0], painted[len(painted) // 2])


def one_colour(texture: Texture) -> np.ndarray:
    """A painted texture with the mean of what is painted elsewhere."""
    seen = texture.weight > 0.0
    return np.where(seen[..., None], texture.values, texture.values[seen].mean(axis=0)).astype(np.float32)


_SHOWN = ("psnr_db", "matched_psnr_db", "ssim", "flip", "lpips", "colour_angle_deg")


def print_stages(rows: dict[str, dict]) -> None:
    print("\n".join(table_lines([{"stage": name} | {key: row[key] for key in _SHOWN if key in row}
                                 for name, row in rows.items()])))  # fmt: skip


def print_ablations(rows: dict[str, dict]) -> None:
    """With the paper's Drop: of LPIPS where its weights are at hand, else of FLIP."""
    full = rows["full"]
    error = "lpips" if "lpips" in full else "flip"
    table = [{"ablation": name} | {key: row[key] for key in _SHOWN if key in row}
             | {f"drop_{error}_percent": 100.0 * drop(full[error], row[error])} for name, row in rows.items()]  # fmt: skip
    print("\n".join(table_lines(table)))


def key_of(name: str) -> str:
    """``no guidance (membrane)`` → ``no_guidance_membrane``."""
    return "_".join("".join(c if c.isalnum() else " " for c in name.lower()).split())


def numbers_of(bench: Bench, rows: dict, painted_rows: dict, held_rows: dict, whole: dict) -> dict[str, float]:
    """All of it, flat."""
    numbers: dict[str, float] = {"seed": bench.world.seed}
    for prefix, table in (("stage", rows), ("ablation_painted", painted_rows), ("ablation_held_out", held_rows)):
        for name, row in table.items():
            numbers |= {f"{prefix}_{key_of(name)}_{key}": value for key, value in row.items()}
    full, held = rows["all, painted hours"], rows["all, held-out hours"]
    numbers["distilled_psnr_db"] = rows["all, distilled, held-out hours"]["psnr_db"]
    numbers |= {"painted_view_psnr_db": full["psnr_db"], "painted_view_ssim": full["ssim"],
                "painted_view_matched_psnr_db": full["matched_psnr_db"], "held_out_hour_psnr_db": held["psnr_db"],
                "held_out_hour_ssim": held["ssim"], "held_out_hour_matched_psnr_db": held["matched_psnr_db"],
                "mask_share": full["mask_share"], "painted_texel_share": float(whole["seen"].mean())}  # fmt: skip
    error = albedo_error(bench.world.albedo, whole["albedo"], whole["fit"].seen >= 0.5)
    numbers |= {"albedo_psnr_db": error.psnr_db, "albedo_scale_invariant_mae": error.scale_invariant_mae}
    errors = np.array([pose_errors(solved, camera) for solved, camera in
                       zip(bench.pictures.calibrated, bench.world.painting, strict=True)])  # fmt: skip
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
        sheet = comparison({key: judge.developed(value, 0, at) for key, value in shown.items()}, mask=judge.mask(0),
                           window=steepest_window(true.gbuffer.normal, true.gbuffer.depth))  # fmt: skip
        write_png8(folder / f"alpinebench_{name}.png", np.round(255.0 * sheet).astype(np.uint8))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="the quick size, within ten minutes on two cores")
    parser.add_argument("--size", choices=tuple(SIZES), default="small")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument("--figures", type=Path, default=None)
    arguments = parser.parse_args()
    seed = secrets.randbelow(10_000) if arguments.seed is None else arguments.seed
    why = missing_lpips()
    print(f"seed {seed}" + (f"; LPIPS is left out: {why}" if why else ""), file=sys.stderr)
    bench = Bench(seed, "quick" if arguments.quick else arguments.size, None if why else load_lpips())
    rows, whole = stages(bench)
    painted_rows, held_rows = ablations(bench, whole)
    print_stages(rows)
    print("\ntwo painted hours, a view that no webcam saw")
    print_ablations(painted_rows)
    print("\nheld-out hours, the same view")
    print_ablations(held_rows)
    at = bench.world.painted_hours[0]
    true, ours = (bench.judge.developed(value, 0, at) for value in
                  (bench.judge.truth(0, at).radiance, bench.judge.of_texture(whole["textures"][at], 0, at)))  # fmt: skip
    print("\nby distance, first painted hour")
    print("\n".join(table_lines(by_distance(true, ours, bench.judge.truth(0, at).gbuffer.depth, bench.judge.mask(0)))))
    if arguments.figures is not None:
        save_figures(bench, whole, arguments.figures)
    numbers = numbers_of(bench, rows, painted_rows, held_rows, whole) | {
        "seconds": time.perf_counter() - bench.clock.start
    }
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({key: float(value) for key, value in numbers.items()}, indent=1) + "\n")


if __name__ == "__main__":
    main()
