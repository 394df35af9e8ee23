"""Gaussians distilled from relit renders, against the conditioning of WildGaussians, on held-out hours.

    python benchmarks/gaussians.py [--quick] [--seed N] [--json FILE] [--picture FILE]

The scene is a massif of our own making (another one for every seed) under a clear sky. Discs learn from suns of a whole
year seen by six cameras around it; they are judged on suns that they have not seen, on three of those cameras and on
another one, halfway between two of them.

* Truth is the view relit from its daylight coefficients with the same bounces as path tracing, of which it has no noise;
  one view is path traced too, and the difference of both is printed.
* PSNR is that of sRGB pictures over pixels that are all terrain, before the air (which would flatter); exposure is
  given by the horizontal illuminance, equal for all.
* All contestants have the same discs, the same two stages, steps and pictures, and all refine their discs; the untrained
  one has the discs as the terrain gives them. ``code`` has a free vector for each
  training time; for a held-out picture it is fitted to the left half and judged on the right one, as WildGaussians does
  (it has then seen half of the answer). ``sun`` is the same network told where the sun stands.
"""

from __future__ import annotations

import argparse
import os
import secrets
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from record import write_record

if TYPE_CHECKING:
    from seasonscapes.cameras.pinhole import Camera
    from seasonscapes.gaussians.rasterise import Splats, ViewWeights

for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

SUMMER_DAY, SPRING_DAYS = 245.0, (115.0, 130.0, 145.0)
# Cameras of `Scene` that are learned from, and judged on.
LEARNED, JUDGED = (0, 1, 2, 4, 5, 6), range(4)


@dataclass(frozen=True)
class Sizes:
    side: int = 320
    picture_px: int = 256
    suns: int = 32
    held_out: int = 8
    surface_steps: int = 2500
    picture_steps: int = 288
    code_fits: int = 8
    speed_px: int = 512


QUICK = Sizes(
    side=160, picture_px=128, suns=16, held_out=4, surface_steps=800, picture_steps=96, code_fits=2, speed_px=256
)


class Scene:
    """The massif, its light and its cameras."""

    def __init__(self, seed: int, sizes: Sizes):
        from seasonscapes.frames import LocalFrame
        from seasonscapes.rendering.hemisphere_rays import ray_scene
        from seasonscapes.rendering.mitsuba_scene import mi_mesh
        from seasonscapes.terrain.mesh import build_mesh
        from seasonscapes.terrain.synthetic import alpine_massif
        from seasonscapes.terrain.unwrap import unwrap

        self.sizes, self.rng = sizes, np.random.default_rng(seed)
        self.place = alpine_massif(seed=seed, size_m=6000.0, spacing_m=15.0)
        self.frame = LocalFrame(46.55, 7.98)
        self.terrain, self.atlas = unwrap(build_mesh(self.place.elevation, self.frame, mesher="grid"), texel_m=7.5)
        self.spacing_m = float(np.ptp(self.terrain.vertices[:, 0])) / sizes.side
        self.mesh = mi_mesh(self.terrain, self.albedo(SUMMER_DAY))
        self.ray_scene = ray_scene(self.mesh)
        first = float(self.rng.uniform(0.0, 360.0))
        # The first three are judged on, and with the last three learned from; the fourth is never learned from.
        self.cameras = [self.camera(first + turn) for turn in (0.0, 120.0, 240.0, 30.0, 60.0, 180.0, 300.0)]

    def albedo(self, day: float) -> np.ndarray:
        from affine import Affine

        from seasonscapes.terrain.imagery import bake_imagery
        from seasonscapes.terrain.surface import Raster
        from seasonscapes.terrain.synthetic import alpine_albedo

        elevation = self.place.elevation
        image = Raster(
            alpine_albedo(self.place, day, upsample=2), elevation.transform * Affine.scale(0.5), elevation.crs
        )
        return bake_imagery(self.terrain, self.atlas, image).values

    def camera(self, azimuth_deg: float):
        """Looks at the middle from 7.5 km, from where it sees least of the cut massif's underside."""
        from seasonscapes.cameras.pinhole import Camera, rotation_from_angles

        size = self.sizes.picture_px
        azimuth, focal = np.radians(azimuth_deg), 0.5 * size / np.tan(np.radians(23.0))
        found = []
        for height in np.arange(4200.0, 6700.0, 400.0):
            position = np.array([7500.0 * np.sin(azimuth), 7500.0 * np.cos(azimuth), height])
            forward = np.array([0.0, 0.0, 1700.0]) - position
            pitch = np.degrees(np.arctan2(forward[2], np.hypot(forward[0], forward[1])))
            pose = np.eye(4)
            pose[:3, :3] = rotation_from_angles(azimuth_deg + 180.0, pitch)
            pose[:3, 3] = position
            camera = Camera(size, size, focal, focal, size / 2.0, size / 2.0, pose)
            found.append((self.underside(camera).mean(), height, camera))
            if found[-1][0] < 1e-4:
                break
        return min(found, key=lambda entry: entry[:2])[2]

    def underside(self, camera) -> np.ndarray:
        """Pixels ``(H, W)`` that see a face from below, past the rim of the massif: there is no such place on Earth."""
        from seasonscapes.cameras.pinhole import ray_directions
        from seasonscapes.rendering.gbuffer import trace_gbuffer
        from seasonscapes.rendering.mitsuba_scene import RenderScene

        seen = trace_gbuffer(RenderScene(self.ray_scene.mi_scene, self.mesh), camera)
        return np.nansum(seen.normal * ray_directions(camera), axis=-1) > 0.0

    def lights(self, count: int, *, day: float | None = None):
        """Random instants with the sun above 4°: lights, days of the year."""
        from seasonscapes.sky.models import read_sky_model
        from seasonscapes.workflows.illumination import illumination_at, sun_moon_position
        from seasonscapes.workspace import default_workspace

        model, found, days = read_sky_model("clear"), [], []
        while len(found) < count:
            at = float(self.rng.integers(1, 366)) if day is None else day
            moment = sun_moon_position(
                datetime(2024, 1, 1, tzinfo=UTC) + timedelta(days=at - 1, hours=float(self.rng.uniform(4, 20))),
                self.frame.latitude_deg,
                self.frame.longitude_deg,
                2000.0,
            )
            if moment.sun.elevation_deg > 4.0:
                found.append(illumination_at(model, moment, 2000.0, workspace=default_workspace()))
                days.append(at)
        return found, days


@dataclass(frozen=True)
class Truth:
    """What a camera sees at T times: ``pictures (T, H, W, 3)`` in `SurfaceTargets`' unit, ``solid (H, W)`` all-terrain pixels."""

    pictures: np.ndarray
    solid: np.ndarray


def truth_of(scene: Scene, terrain, camera, lights, states, *, seed: int = 3) -> Truth:
    from seasonscapes.rendering.coefficients import SamplingOptions
    from seasonscapes.rendering.relit_view import relight_view, relightable_view
    from seasonscapes.rendering.transport import trace_view

    view = trace_view(terrain, camera, SamplingOptions(rays=256), seed=seed)
    ready = relightable_view(terrain, view)
    import cv2

    below = cv2.dilate(scene.underside(camera).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    solid = (ready.coverage > 0.999) & ~below
    pictures = [
        relight_view(ready, light).surface * np.float32(np.pi / state.global_lx)
        for light, state in zip(lights, states, strict=True)
    ]
    return Truth(np.stack(pictures), solid)


def shadow_truth(scene: Scene, terrain, gbuffer, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which pixel centres see the sun, and which face it ``(H, W)``."""
    from seasonscapes.rendering.gbuffer import occluded
    from seasonscapes.rendering.mitsuba_scene import RenderScene

    facing = np.nan_to_num(gbuffer.normal @ direction, nan=-1.0) > 0.0
    bare = RenderScene(terrain.mi_scene, scene.mesh)
    shown = np.zeros(facing.shape, bool)
    start = gbuffer.position[facing] + 0.5 * gbuffer.normal[facing]
    shown[facing] = ~occluded(bare, start, np.broadcast_to(direction, start.shape))
    return shown, facing


def psnr(picture: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> float:
    from seasonscapes.images import srgb_from_linear

    return float(-10.0 * np.log10(np.mean((srgb_from_linear(picture) - srgb_from_linear(truth))[mask] ** 2)))


def picture(weights: ViewWeights, colours: np.ndarray) -> np.ndarray:
    from seasonscapes.gaussians.rasterise import splat_colours

    return splat_colours(weights, colours) / np.maximum(weights.coverage, 1e-3)[..., None]


class Contest:
    """Discs, lessons, frames and truth, and what each contestant makes of them."""

    def __init__(self, scene: Scene, seed: int, *, learn: bool = True):
        from seasonscapes.gaussians.disc_transport import (
            light_state,
            neighbourhood_mean,
            surfel_irradiance,
            trace_disc_transport,
        )
        from seasonscapes.gaussians.land_shadows import disc_shadows
        from seasonscapes.gaussians.surfels import surfel_albedo, terrain_surfels
        from seasonscapes.gaussians.training import TrainingFrame, surface_targets
        from seasonscapes.gaussians.training_views import front_facing_splats

        sizes, self.scene, self.seed = scene.sizes, scene, seed
        self.seconds: dict[str, float] = {}
        start = time.perf_counter()
        self.surfels = terrain_surfels(scene.terrain, scene.spacing_m)
        self.albedo = surfel_albedo(self.surfels, scene.albedo(SUMMER_DAY))
        self.around = neighbourhood_mean(self.surfels.means, self.albedo, self.surfels.spacing_m)
        self.transport = trace_disc_transport(scene.ray_scene, self.surfels, self.albedo, rays=64, seed=seed)
        self.seconds["transport"] = time.perf_counter() - start
        self.lights, days = scene.lights(sizes.suns + sizes.held_out)
        self.states = [light_state(self.transport, light, day) for light, day in zip(self.lights, days, strict=True)]
        self.shadows = disc_shadows(scene.ray_scene, self.surfels)
        self.suns, self.held_out = sizes.suns, range(sizes.suns, sizes.suns + sizes.held_out)
        self.weights = self.views(lambda camera: front_facing_splats(self.surfels, camera), range(len(scene.cameras)))
        if not learn:
            return
        start = time.perf_counter()
        received = surfel_irradiance(scene.ray_scene, self.surfels, self.lights[: self.suns], rays=128, seed=seed)
        self.targets = surface_targets(
            self.states[: self.suns], [0] * self.suns, self.albedo[None], received, self.shadows
        )
        self.seconds["lessons"] = time.perf_counter() - start
        start = time.perf_counter()
        self.truth = [truth_of(scene, scene.ray_scene, camera, self.lights, self.states) for camera in scene.cameras]
        self.seconds["views"] = time.perf_counter() - start
        self.frames = [
            TrainingFrame(self.weights[v], t, self.truth[v].pictures[t], self.truth[v].solid, scene.cameras[v])
            for v in LEARNED
            for t in range(self.suns)
        ]

    def appearance(self, kind: str):
        from seasonscapes.gaussians.appearance import EMBEDDING, Appearance, fourier_embedding

        size = 24 if kind in ("code", "sun") else EMBEDDING
        return Appearance(
            kind,
            self.albedo[None],
            self.around[None],
            self.transport,
            fourier_embedding(self.surfels.means, size, seed=self.seed),
            times=self.suns,
            seed=self.seed,
        )

    def views(self, splats: Callable[[Camera], Splats], cameras: Iterable[int]) -> dict[int, ViewWeights]:
        """Weights of discs in some of the cameras."""
        from seasonscapes.gaussians.rasterise import view_weights

        seen = {v: self.scene.cameras[v] for v in cameras}
        return {v: view_weights(splats(camera), camera, subpixels=2) for v, camera in seen.items()}

    def weights_of(self, appearance) -> dict[int, ViewWeights]:
        """Weights of an appearance's discs in the cameras that are judged."""
        import torch

        if appearance.geometry is None:
            return self.weights
        with torch.no_grad():
            return self.views(appearance.geometry.splats, JUDGED)

    def trained(self, kind: str):
        from seasonscapes.gaussians.disc_geometry import DiscGeometry
        from seasonscapes.gaussians.training import Schedule, train

        sizes, appearance = self.scene.sizes, self.appearance(kind)
        appearance.refine(DiscGeometry(self.surfels))
        start = time.perf_counter()
        train(appearance, self.targets, self.frames, Schedule(sizes.surface_steps, sizes.picture_steps), seed=self.seed)
        self.seconds[kind] = time.perf_counter() - start
        return appearance

    def colours(self, appearance, state) -> np.ndarray:
        """Colours of the discs under a light, in the land's shadows."""
        from seasonscapes.gaussians.appearance import colours_at

        return colours_at(appearance, state, visible=self.shadows.visible_share(state))

    def score(self, appearance, times=None, weights=None) -> tuple[float, float]:
        """Mean PSNR of held-out times on the training cameras and on the unseen one."""
        table, weights = [], weights or self.weights_of(appearance)
        for t in self.held_out if times is None else times:
            colours = self.colours(appearance, self.states[t])
            table.append(
                [psnr(picture(weights[v], colours), self.truth[v].pictures[t], self.truth[v].solid) for v in JUDGED]
            )
        mean = np.mean(table, axis=0)
        return float(mean[:3].mean()), float(mean[3])

    def score_code(self, appearance) -> tuple[float, float]:
        """Free codes fitted to the left half, judged on the right; as many pictures as `Sizes.code_fits` says."""
        from seasonscapes.gaussians.appearance import light_tensors
        from seasonscapes.gaussians.training import TrainingFrame, fit_code

        lights, table, weights = light_tensors(self.states), [], self.weights_of(appearance)
        import torch

        for t in list(self.held_out)[: self.scene.sizes.code_fits]:
            row = []
            for v in (0, 3):
                truth = self.truth[v]
                left = np.arange(truth.solid.shape[1])[None, :] < truth.solid.shape[1] // 2
                frame = TrainingFrame(weights[v], t, truth.pictures[t], truth.solid & left)
                code = fit_code(appearance, lights, frame, seed=self.seed)
                with torch.no_grad():
                    colours = appearance(torch.arange(len(self.albedo)), torch.tensor(t), lights, code).numpy()
                row.append(psnr(picture(weights[v], colours), truth.pictures[t], truth.solid & ~left))
            table.append(row)
        return tuple(np.mean(table, axis=0).tolist())

    def score_pictures(self, share) -> float:
        """Mean PSNR on the training cameras of pictures mixed from training ones by weights ``share(t) (suns,)``."""
        values = [
            psnr(np.einsum("t,thwc->hwc", share(t), truth.pictures[: self.suns]), truth.pictures[t], truth.solid)
            for truth in self.truth[:3]
            for t in self.held_out
        ]
        return float(np.mean(values))

    def sun_weights(self, power: float):
        """Weights of training suns by their nearness to a held-out one; ``inf`` takes the nearest alone."""
        directions = np.stack([state.bodies[0][0] for state in self.states])

        def share(t: int) -> np.ndarray:
            angle = np.arccos(np.clip(directions[: self.suns] @ directions[t], -1.0, 1.0))
            if np.isinf(power):
                return (np.arange(self.suns) == np.argmin(angle)).astype(np.float32)
            nearest = np.argsort(angle)[:3]
            weight = np.zeros(self.suns, np.float32)
            weight[nearest] = 1.0 / np.maximum(angle[nearest], 1e-3) ** power
            return weight / weight.sum()

        return share

    def shadow_iou(self, appearance) -> float:
        """Intersection over union of cast shadows, of pixels that face the sun, over held-out times and all cameras.

        Those that a browser shows, by the horizons of the discs; elsewhere shadows are traced.
        """
        import torch

        from seasonscapes.rendering.gbuffer import trace_gbuffer
        from seasonscapes.rendering.mitsuba_scene import RenderScene

        scene, both, either, weights = self.scene, 0, 0, self.weights_of(appearance)
        bare = RenderScene(scene.ray_scene.mi_scene, scene.mesh)
        seen_by = [(trace_gbuffer(bare, camera), ~scene.underside(camera)) for camera in scene.cameras[:4]]
        for t in self.held_out:
            direction = torch.as_tensor(self.states[t].bodies[0][0])
            with torch.no_grad():
                seen = appearance.visibility(torch.arange(len(self.albedo)), direction).numpy()
            for v, (gbuffer, above) in enumerate(seen_by):
                sunny, facing = shadow_truth(scene, scene.ray_scene, gbuffer, self.states[t].bodies[0][0])
                asked = facing & above & (weights[v].coverage > 0.5)
                dark, true = (picture(weights[v], seen[:, None])[..., 0] < 0.5)[asked], ~sunny[asked]
                both, either = both + int(np.sum(dark & true)), either + int(np.sum(dark | true))
        return both / max(either, 1)


def seasons(contest: Contest, appearance) -> dict[str, float]:
    """A date between two dated albedos against these two, on the first camera at three hours each."""
    import torch

    from seasonscapes.albedo.seasons import albedo_at
    from seasonscapes.gaussians.disc_transport import light_state, neighbourhood_mean
    from seasonscapes.gaussians.surfels import surfel_albedo
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import mi_mesh
    from seasonscapes.terrain.attributes import attributes_at

    scene, surfels = contest.scene, contest.surfels
    true = {day: scene.albedo(day) for day in SPRING_DAYS}
    dated = np.stack([surfel_albedo(surfels, true[day]) for day in (SPRING_DAYS[0], SPRING_DAYS[2])])
    ground = attributes_at(surfels.means, surfels.normals, surfels.spacing_m)
    weights = contest.weights_of(appearance)
    result, held = {}, (appearance.albedo, appearance.neighbourhood_albedo)
    for number, day in enumerate(SPRING_DAYS):
        lights, _ = scene.lights(3, day=day)
        states = [light_state(contest.transport, light, day) for light in lights]
        truth = truth_of(scene, ray_scene(mi_mesh(scene.terrain, true[day])), scene.cameras[0], lights, states)
        guesses = {"": albedo_at(dated, (SPRING_DAYS[0], SPRING_DAYS[2]), day, ground)}
        if number == 1:
            guesses["_mean"] = dated.mean(axis=0)
        for name, albedo in guesses.items():
            around = neighbourhood_mean(surfels.means, albedo, surfels.spacing_m)
            appearance.albedo, appearance.neighbourhood_albedo = (
                torch.as_tensor(albedo)[None],
                torch.as_tensor(around)[None],
            )
            values = [
                psnr(picture(weights[0], contest.colours(appearance, state)), seen, truth.solid)
                for state, seen in zip(states, truth.pictures, strict=True)
            ]
            result[f"season_{('seen', 'unseen', 'seen2')[number]}{name}_psnr_db"] = float(np.mean(values))
    appearance.albedo, appearance.neighbourhood_albedo = held
    return result


def speed(contest: Contest, appearance) -> dict[str, float]:
    """Milliseconds a frame at 512², and path tracing to the same error there, on the first camera and one sun.

    The error of path tracing falls with the square root of its samples, so the time to the splats' own error follows
    from one measurement.
    """
    from dataclasses import replace

    import torch

    from seasonscapes.gaussians.rasterise import rotations, splat_colours, view_weights
    from seasonscapes.gaussians.splat_view import SPLAT_LIMITS
    from seasonscapes.gaussians.training_views import front_facing_splats
    from seasonscapes.rendering.mitsuba_scene import relight
    from seasonscapes.rendering.radiance import path_trace
    from seasonscapes.rendering.splatting import finer_camera, splat_layers, upload_splats

    scene, surfels, t = contest.scene, contest.surfels, contest.held_out[0]
    camera = finer_camera(scene.cameras[0], scene.sizes.speed_px // scene.cameras[0].width_px)
    splats = front_facing_splats(surfels, camera)
    if appearance.geometry is not None:
        with torch.no_grad():
            splats = appearance.geometry.splats(camera)
    axes = rotations(splats.quaternions) * splats.log_scales.exp()[:, None, :]
    ready = upload_splats(splats.means.numpy(), axes.numpy(), torch.sigmoid(splats.opacity_logits).numpy())
    colours = contest.colours(appearance, contest.states[t])
    moving = best(lambda: splat_layers(ready, colours, camera, SPLAT_LIMITS))
    in_torch = best(lambda: splat_colours(view_weights(splats, camera), colours))
    relit = best(lambda: contest.colours(appearance, contest.states[t]))
    weights = view_weights(splats, camera)
    still = best(lambda: splat_colours(weights, colours))
    drawn, covered = splat_layers(ready, colours, camera, SPLAT_LIMITS)
    lit = relight(scene.mesh, contest.lights[t])
    # Errors are compared in the middle of the picture, 3/8 of its side; times are those of all of it.
    side = camera.width_px * 3 // 8
    edge = (camera.width_px - side) // 2
    middle = replace(camera, width_px=side, height_px=side, cx=camera.cx - edge, cy=camera.cy - edge)
    truth = truth_of(scene, scene.ray_scene, middle, [contest.lights[t]], [contest.states[t]])
    part = slice(edge, edge + side)
    scale, spp = np.pi / contest.states[t].global_lx, 8
    path_trace(lit, camera, spp=spp)
    start = time.perf_counter()
    noisy, _ = path_trace(lit, camera, spp=spp, seed=5)
    seconds = (time.perf_counter() - start) / spp
    shown = (drawn / np.maximum(covered, 1e-3)[..., None])[part, part]
    splats_db = psnr(shown, truth.pictures[0], truth.solid)
    noisy_db = psnr(noisy[part, part] * scale, truth.pictures[0], truth.solid)
    equal = spp * 10.0 ** ((splats_db - noisy_db) / 10.0)
    check, _ = path_trace(lit, middle, spp=256, seed=6)
    return {
        "frame_ms": 1e3 * moving,
        "frames_per_second": 1.0 / moving,
        "torch_frame_ms": 1e3 * in_torch,
        "still_camera_ms": 1e3 * still,
        "colours_ms": 1e3 * relit,
        "frame_psnr_db": splats_db,
        "path_8spp_psnr_db": noisy_db,
        "path_spp_of_equal_error": equal,
        "path_seconds_of_equal_error": equal * seconds,
        "speedup_vs_path": equal * seconds / moving,
        "speedup_vs_path_still_camera": equal * seconds / still,
        "truth_vs_path_psnr_db": psnr(check * scale, truth.pictures[0], truth.solid),
    }


def best(call, rounds: int = 5) -> float:
    call()
    seconds = []
    for _ in range(rounds):
        start = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def contact_sheet(contest: Contest, appearance, path: str) -> None:
    """Held-out hours in columns; path traced, splats, difference × 4 in rows; the unseen camera in the lower half."""
    from PIL import Image

    from seasonscapes.images import srgb_from_linear

    rows, weights = [], contest.weights_of(appearance)
    order = sorted(contest.held_out, key=lambda t: contest.states[t].global_lx)[:: max(1, len(contest.held_out) // 4)][
        :4
    ]
    for v in (0, 3):
        columns = []
        for t in order:
            truth = srgb_from_linear(contest.truth[v].pictures[t])
            splats = srgb_from_linear(picture(weights[v], contest.colours(appearance, contest.states[t])))
            splats = splats * (weights[v].coverage > 0.5)[..., None]
            difference = np.clip(4.0 * np.abs(truth - splats), 0.0, 1.0)
            columns.append(np.concatenate([truth, splats, difference], axis=0))
        rows.append(np.concatenate(columns, axis=1))
    sheet = np.concatenate(rows, axis=1)
    Image.fromarray(np.rint(255.0 * np.clip(sheet, 0, 1)).astype(np.uint8)).save(path, quality=88)


def packed_scores(contest: Contest, appearance) -> dict[str, float]:
    """Bytes for each Gaussian on disk, and what packing costs in PSNR."""
    from seasonscapes.gaussians.model import bytes_per_gaussian, model_from, pack_model, unpack_model
    from seasonscapes.gaussians.splat_view import appearance_of, learned_parameters, splats_of

    model = model_from(
        contest.surfels,
        contest.albedo[None],
        [SUMMER_DAY],
        contest.transport,
        learned_parameters(appearance),
        frame=contest.scene.frame,
    )
    read = unpack_model(*pack_model(model))
    weights = contest.views(lambda camera: splats_of(read, viewpoint_m=camera.position_m), JUDGED)
    again = contest.score(appearance_of(read), weights=weights)
    return {"bytes_per_gaussian": bytes_per_gaussian(model), "packed_held_out_hour_psnr_db": again[0]}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a small scene, within five minutes on two cores")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--json", type=Path, default=None)
    parser.add_argument(
        "--only", default="", help="some alone, of full, sun, code, physical, and of speed and shadow (both untrained)"
    )
    parser.add_argument("--picture", default=None, help="write the contact sheet here")
    arguments = parser.parse_args()
    seed = secrets.randbelow(10_000) if arguments.seed is None else arguments.seed
    from seasonscapes.gaussians.rasterise import set_torch_threads

    set_torch_threads(1)
    start = time.perf_counter()
    only = [name for name in arguments.only.split(",") if name]
    contest = Contest(
        Scene(seed, QUICK if arguments.quick else Sizes()), seed, learn=not only or bool({*only} - {"speed", "shadow"})
    )
    result: dict[str, float] = {"seed": seed, "gaussians": len(contest.albedo), "suns": contest.suns}

    def tell(name: str, scores: tuple[float, float]) -> None:
        result[f"{name}_psnr_db"], result[f"{name}_unseen_camera_psnr_db"] = scores
        print(f"{name:20s} {scores[0]:6.2f} {scores[1]:6.2f}  [{time.perf_counter() - start:.0f} s]", flush=True)

    print("prepared", {name: round(value, 1) for name, value in contest.seconds.items()}, flush=True)
    if only:
        untrained = contest.appearance("physical")
        for kind in only:
            if kind == "speed":
                result |= speed(contest, untrained)
            elif kind == "shadow":
                result["shadow_iou"] = contest.shadow_iou(untrained)
            else:
                trained = contest.trained(kind)
                tell(kind, contest.score_code(trained) if kind == "code" else contest.score(trained))
        return write_result(result, arguments.json)
    result["nearest_sun_psnr_db"] = contest.score_pictures(contest.sun_weights(np.inf))
    result["blend_psnr_db"] = contest.score_pictures(contest.sun_weights(1.0))
    print(f"nearest sun {result['nearest_sun_psnr_db']:.2f}, blend of three {result['blend_psnr_db']:.2f}", flush=True)
    tell("physical_untrained", contest.score(contest.appearance("physical")))
    full = contest.trained("full")
    tell("full", contest.score(full))
    if arguments.picture:
        contact_sheet(contest, full, arguments.picture)
    result["shadow_iou"] = contest.shadow_iou(full)
    result |= packed_scores(contest, full)
    tell("sun", contest.score(contest.trained("sun")))
    code = contest.trained("code")
    tell("code", contest.score_code(code))
    tell("physical", contest.score(contest.trained("physical")))
    result |= seasons(contest, full)
    result |= speed(contest, full)
    result["held_out_hour_psnr_db"] = result["full_psnr_db"]
    result["unseen_camera_psnr_db"] = result["full_unseen_camera_psnr_db"]
    result["margin_over_wildgaussians_db"] = result["full_psnr_db"] - max(result["code_psnr_db"], result["sun_psnr_db"])
    # What training brings on hours that it has not seen; a date between two dated albedos against the worse of these.
    result["training_gain_db"] = result["full_psnr_db"] - result["physical_untrained_psnr_db"]
    seen = min(result["season_seen_psnr_db"], result["season_seen2_psnr_db"])
    result["between_dates_gap_db"] = seen - result["season_unseen_psnr_db"]
    result["moving_camera_speedup"] = result["speedup_vs_path"]
    result["train_seconds"] = contest.seconds["full"]
    result["prepare_seconds"] = contest.seconds["transport"] + contest.seconds["lessons"] + contest.seconds["views"]
    result["total_seconds"] = time.perf_counter() - start
    write_result(result, arguments.json)


def write_result(result: dict[str, float], path: Path | None) -> None:
    """A table, and the same numbers as JSON."""
    for name, value in result.items():
        print(f"{name:36s} {value:10.3f}")
    write_record(path, result, seed=int(result["seed"]))


if __name__ == "__main__":
    main()
