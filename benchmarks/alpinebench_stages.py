"""AlpineBench's machinery: views of the judged webcams, the stages with what each is given, Gaussians, a clock."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timedelta
from pathlib import Path

import cv2
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from albedo_scene import LATITUDE_DEG, LONGITUDE_DEG, hours, lights_for
from alpinebench_scene import (
    DAY_OF_YEAR,
    SATELLITE_DATE,
    SIZES,
    Pictures,
    World,
    clean_gain,
    make_world,
    observed,
    take_pictures,
)

from seasonscapes.albedo.albedo_completion import complete_albedo
from seasonscapes.albedo.closed_form import AlbedoFit, SearchOptions, solve_albedo
from seasonscapes.albedo.forward_model import TexelTransport, ambient_on_texels, sun_on_texels, trace_texel_transport
from seasonscapes.albedo.inpainted_albedo import FUSED, corrected_by_inpainting
from seasonscapes.albedo.joint_recovery import recover_jointly
from seasonscapes.albedo.painted_textures import REPEATED, painted_photograph
from seasonscapes.albedo.photographs import EIGHT_BIT, LINEAR, AlbedoPhotograph, prepare_photographs
from seasonscapes.albedo.texture_delighting import delight_textures
from seasonscapes.albedo.tone_curve import fit_tone_curve, with_tone_curve
from seasonscapes.cameras.panorama import split_panorama
from seasonscapes.evaluation.masks import terrain_mask
from seasonscapes.evaluation.metrics import score
from seasonscapes.evaluation.synthetic_webcams import SyntheticPicture
from seasonscapes.exposure import develop, exposure_ev100
from seasonscapes.images import srgb_from_linear
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.gbuffer import trace_gbuffer
from seasonscapes.rendering.mitsuba_scene import RenderScene, set_albedo
from seasonscapes.rendering.radiance import apply_aerial_perspective
from seasonscapes.rendering.relit_view import (
    RelightableView,
    cluster_albedo,
    relight_view,
    relightable_view,
    with_albedo,
)
from seasonscapes.rendering.transport import trace_view, view_albedo
from seasonscapes.sky.ephemeris import sun_position
from seasonscapes.sky.illumination import Illumination, global_horizontal_illuminance
from seasonscapes.terrain.surface import Texture, sample_texture
from seasonscapes.texturing.bayesian_fusion import fuse_with_albedo
from seasonscapes.texturing.completion import CompletionOptions, complete
from seasonscapes.texturing.inputs import PaintingInput
from seasonscapes.texturing.painting import Painting, PaintOptions, PaintTarget, paint_atlas
from seasonscapes.texturing.predictors import Predictors, predictors_for
from seasonscapes.texturing.radiometric_fit import RadiometricReference
from seasonscapes.workflows.predicted_radiance import RELATIVE_SIGMA
from seasonscapes.workspace import default_workspace

_TEXEL = SamplingOptions(shadow_samples=1, rays=64, clusters_per_receiver=32, clusters=1024, rank=24)
_SUBPIXELS = 3
# Days and hours that Gaussians learn from; the judged day is not among them.
LESSONS = (
    ("2024-01-15", 11.0),
    ("2024-03-10", 8.5),
    ("2024-04-20", 15.0),
    ("2024-05-12", 6.5),
    ("2024-06-18", 12.0),
    ("2024-07-05", 17.0),
    ("2024-08-14", 9.5),
    ("2024-10-08", 13.5),
)
NEAR_M = 60.0
# Largest side of a disc, in pixels of the judged webcams.
DISC_PX = 2.0


class Judge:
    """Judged webcams: their truth, and pictures of textures and of albedos from where they stand."""

    def __init__(self, world: World, pictures: Pictures, lpips):
        self.world, self.rows, self.lpips = world, pictures.judged, lpips
        self.scene = RenderScene(world.bare.mi_scene, world.bare.mi_terrain)
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
            made = trace_view(world.bare, camera, world.size.sampling, seed=world.seed + 1000 + number)
            self.ready.append(relightable_view(world.bare, made))

    def light(self, camera: int, at: datetime) -> Illumination:
        return self.world.lights[at][len(self.world.painting) + camera]

    def truth(self, camera: int, at: datetime) -> SyntheticPicture:
        return self.rows[camera][self.world.hours.index(at)]

    def of_texture(self, radiance: np.ndarray, camera: int, at: datetime, *, air: bool = True) -> np.ndarray:
        """The view ``(H, W, 3)`` [cd/m²] of a texture of radiance."""
        surface = np.nan_to_num(sample_texture(radiance, self.uv[camera])).mean(axis=2)
        light = self.light(camera, at)
        light = light if air else replace(light, aerial_perspective=None)
        stage = RenderScene(self.world.bare.mi_scene, self.world.bare.mi_terrain, light)
        return apply_aerial_perspective(
            stage, self.world.judged[camera], surface, self.coverage[camera], self.truth(camera, at).gbuffer
        )

    def clothed(self, albedo: np.ndarray, cameras: Sequence[int] | None = None) -> dict[int, RelightableView]:
        """The views' light transport over a texture of albedo, by camera."""
        set_albedo(self.scene, albedo)
        chosen = range(len(self.ready)) if cameras is None else cameras
        return {
            n: with_albedo(
                self.ready[n],
                view_albedo(self.world.bare, self.ready[n].coefficients),
                cluster_albedo(self.world.bare, self.ready[n].coefficients),
            )
            for n in chosen
        }

    def of_albedo(self, albedo: np.ndarray, *, air: bool = True) -> Callable[[int, datetime], np.ndarray]:
        """Views of a texture of albedo under any light."""
        clothed = self.clothed(albedo)

        def relit(camera: int, at: datetime) -> np.ndarray:
            light = self.light(camera, at)
            return relight_view(clothed[camera], light if air else replace(light, aerial_perspective=None)).radiance

        return relit

    def mask(self, camera: int) -> np.ndarray:
        return terrain_mask(self.rows[camera][0].gbuffer.depth, near_m=NEAR_M)

    def developed(self, radiance: np.ndarray, camera: int, at: datetime) -> np.ndarray:
        """With the exposure of the truth, sRGB-encoded."""
        ev100 = exposure_ev100(self.truth(camera, at).radiance)
        return srgb_from_linear(np.clip(develop(np.maximum(radiance, 0.0), ev100), 0.0, 1.0))

    def matched(self, radiance: np.ndarray, true: np.ndarray, camera: int) -> np.ndarray:
        """Radiance times one factor for each colour that brings it nearest to the truth, by the medians of ratios."""
        kept = self.mask(camera) & (radiance > 0.0).all(axis=2) & (true > 0.0).all(axis=2)
        return radiance * np.exp(np.median(np.log(true[kept] / radiance[kept]), axis=0))

    def in_sight(self, texture: np.ndarray, true: np.ndarray, camera: int = 0) -> np.ndarray:
        """A texture as it is, no air before it, before the truth's sky, at the exposure that is nearest to the truth."""
        land = np.nan_to_num(sample_texture(texture, self.uv[camera])).mean(axis=2)
        return np.where(self.coverage[camera][..., None] > 0.5, self.matched(land, true, camera), true)

    def scores(
        self, view: Callable[[int, datetime], np.ndarray], times, *, most: int | None = None, mode: str = "valid"
    ) -> dict[str, float]:
        """Means over the (first) judged webcams and times, of the picture as it is and with its colours matched."""
        found = []
        for camera in range(len(self.rows))[:most]:
            for at in times:
                picture, mask, true = view(camera, at), self.mask(camera), self.truth(camera, at).radiance
                shown = self.developed(true, camera, at)
                one = score(shown, self.developed(picture, camera, at), mask, mode=mode, lpips=self.lpips).record()
                fair = self.developed(self.matched(picture, true, camera), camera, at)
                fair = score(shown, fair, mask, mode=mode).record()
                found.append(one | {"matched_psnr_db": fair["psnr_db"]})
        return {name: float(np.mean([row[name] for row in found])) for name in found[0]}


class Bench:
    """The stages, each with what it is given."""

    def __init__(self, seed: int, size: str, lpips, data: Path | None = None):
        self.clock = Clock()
        self.world = make_world(seed, SIZES[size], data)
        self.clock.tell("world")
        self.pictures = take_pictures(self.world)
        self.clock.tell("webcams' pictures, calibrated")
        self.judge = Judge(self.world, self.pictures, lpips)
        self.clock.tell("judged views")
        self.land: TexelTransport = trace_texel_transport(
            self.world.terrain, self.world.albedo.shape[:2], sampling=_TEXEL, seed=seed
        )
        self.clock.tell("daylight coefficients of texels")
        self.from_above, self.satellite = self._from_above()
        # No hour's sun among the guides of an albedo: it knows none.
        self.albedo_guides = predictors_for(self.world.terrain, self.world.atlas)
        self.predictors = {at: self.guides_at(at, self.satellite) for at in self.world.painted_hours}
        self.clock.tell("satellite and guides")

    def _from_above(self) -> tuple[Texture, Texture]:
        """A satellite's image ``(R, S, 3)``, and the same with the light of its hour taken out.

        It holds the land's radiance over that of even white ground: shaded, misplaced by three quarters of a texel, noisy.
        """
        shape, seed = self.world.albedo.shape[:2], self.world.seed
        (light,) = lights_for(
            hours(SATELLITE_DATE, 10.5), self.world.painting[:1], self.world.sky, default_workspace()
        )[0]
        # Other rays than those that take the light out again.
        land = trace_texel_transport(self.world.terrain, shape, sampling=_TEXEL, seed=seed + 500)
        even = np.asarray(global_horizontal_illuminance(light), np.float32)
        image = np.pi * self.true_texture(light, self.world.summer, land) / even
        noise = np.exp(0.03 * np.random.default_rng([seed, 500]).standard_normal(image.shape))
        image = cv2.warpAffine(
            image, np.float32([[1, 0, 0.6], [0, 1, -0.4]]), shape[::-1], borderMode=cv2.BORDER_REPLICATE
        )
        image = (image * noise).astype(np.float32)
        albedo, _ = delight_textures(self.land, [image * even / np.float32(np.pi)], [light])
        whole = np.ones(shape, np.float32)
        return Texture(image, whole), Texture(np.where(np.isfinite(albedo), albedo, image), whole)

    def guides_at(self, at: datetime, satellite: Texture | None = None) -> Predictors:
        """Relief, sun and the satellite's image."""
        day = [at.replace(hour=0, minute=0) + timedelta(hours=h) for h in range(24)]
        suns = np.asarray(sun_position(day, LATITUDE_DEG, LONGITUDE_DEG).direction, float)
        return predictors_for(
            self.world.terrain,
            self.world.atlas,
            satellite=satellite,
            sun_direction=sun_position(at, LATITUDE_DEG, LONGITUDE_DEG).direction,
            day_suns=suns,
        )

    def true_texture(self, light: Illumination, albedo: np.ndarray, land: TexelTransport | None = None) -> np.ndarray:
        """Radiance ``(R, S, 3)`` [cd/m²] that an albedo sends under a light."""
        land = land or self.land
        received = sun_on_texels(land, light) + ambient_on_texels(land, light, albedo)
        return (albedo * received.reshape(albedo.shape) / np.pi).astype(np.float32)

    def painted(
        self,
        at: datetime,
        options: PaintOptions | None = None,
        *,
        relit: np.ndarray | None = None,
        clean: bool = False,
        true_pose: bool = False,
        air: bool = True,
    ) -> Painting:
        """The webcams' pictures of an hour, in the texture; ``relit`` is what an albedo says that they show."""
        lights = self.world.lights[at]
        gain = clean_gain(self.pictures, self.world, at) if clean else None
        inputs = []
        for seen, sigma, number in observed(self.pictures, self.world, at, gain=gain, true_pose=true_pose):
            seen = replace(seen, image=np.clip(seen.image, 0.0, 1.0), pose_sigma=sigma)
            inputs.append(PaintingInput(seen, lights[number].aerial_perspective if air else None))
        reference = None if relit is None else RadiometricReference(relit, RELATIVE_SIGMA)
        target = PaintTarget(self.world.terrain, self.world.atlas, self.world.bare)
        return paint_atlas(inputs, target, options=options, reference=reference)

    def completed(self, texture: Texture, at: datetime, *, method: str = "guided") -> np.ndarray:
        return complete(
            texture, self.predictors[at], options=CompletionOptions(method, fast=True, seed=self.world.seed)
        ).values

    def fused(self, texture: Texture, at: datetime, told: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """A painting and what an albedo of relative error ``sigma``, relit, says of the hour."""
        return fuse_with_albedo(texture, told, sigma, self.predictors[at]).values

    def photographs(
        self, *, clean: bool = False, true_pose: bool = False, response: bool = True
    ) -> list[AlbedoPhotograph]:
        """All painted hours' pictures with their light; unless these are clean, their tone curve is searched for."""
        seen, lights, gains = [], [], []
        for at in self.world.painted_hours:
            views = observed(self.pictures, self.world, at, gain=1.0 if clean else None, true_pose=true_pose)
            for one, deviations, number in views:
                seen.append(replace(one, pose_sigma=deviations))
                lights.append(self.world.lights[at][number])
                gains.append(np.ones(3) if clean else None)
        inputs = prepare_photographs(self.land, seen, lights, gains=gains, seed=self.world.seed)
        if response and not clean:
            curve = fit_tone_curve(self.land, inputs, search=SearchOptions(seed=self.world.seed))
            inputs = with_tone_curve(inputs, curve.strength)
        return inputs

    def solved(self, *, clean: bool = False, **how: bool) -> AlbedoFit:
        """Albedo from `photographs`, by the closed form."""
        inputs = self.photographs(clean=clean, **how)
        return solve_albedo(self.land, inputs, noise_model=LINEAR if clean else EIGHT_BIT)

    def solved_again(self, photographs: list[AlbedoPhotograph], paintings: dict[datetime, Painting]) -> AlbedoFit:
        """Albedo from photographs and, with the confidence that a run gives them, what was painted from them."""
        repeated = []
        for at, painting in paintings.items():
            made = painted_photograph(self.land, painting.texture, self.world.lights[at][0], at)
            repeated.append(replace(made, confidence=made.confidence * np.float32(REPEATED)))
        return solve_albedo(self.land, [*photographs, *repeated], noise_model=EIGHT_BIT)

    def inpainted(self, albedo: np.ndarray, fit: AlbedoFit, textures: dict[datetime, np.ndarray]) -> np.ndarray:
        """An albedo that completed textures correct where no photograph measured it."""
        lights = [self.world.lights[at][0] for at in textures]
        unmeasured = fit.pixel_count < 0.5
        return corrected_by_inpainting(self.land, albedo, unmeasured, list(textures.values()), lights, share=FUSED)

    def found_jointly(self, photographs: list[AlbedoPhotograph], fit: AlbedoFit) -> AlbedoFit:
        """Albedo together with response, exposures, clouds and poses; haze stays the truth's, as for the closed form."""
        return recover_jointly(self.land, photographs, fit).fit

    def albedos(self, whole: dict) -> dict[str, np.ndarray]:
        """Albedos from photographs alone, with what else a run can use, and by the joint recovery.

        ``whole`` holds ``photographs``, their closed ``fit`` and ``albedo``, and of each hour ``paintings`` and ``textures``.
        """
        photographs, fit, albedo = whole["photographs"], whole["fit"], whole["albedo"]
        return {
            "photographs alone": albedo,
            "with painted": self.completed_albedo(self.solved_again(photographs, whole["paintings"]))[0],
            "with inpainted": self.inpainted(albedo, fit, whole["textures"]),
            "differentiable": self.completed_albedo(self.found_jointly(photographs, fit))[0],
        }

    def completed_albedo(self, fit: AlbedoFit, base: Texture | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Another picture of the land (left out, the satellite's, its light taken out) corrected by the seen texels; and σ."""
        base = base or self.satellite
        return complete_albedo(fit, base.values, self.albedo_guides, seed=self.world.seed)

    def guided_albedo(self, fit: AlbedoFit) -> np.ndarray:
        """Seen texels' albedo as it is; the others' learned, the satellite's image one guide among others."""
        predictors = predictors_for(self.world.terrain, self.world.atlas, satellite=self.satellite)
        texture = Texture(fit.albedo, (fit.pixel_count >= 0.5).astype(np.float32))
        return np.clip(
            complete(texture, predictors, options=CompletionOptions(fast=True, seed=self.world.seed)).values,
            0.004,
            0.98,
        )

    def seen_texels(self) -> np.ndarray:
        """Texels ``(R, S)`` that painting at true poses reaches, at the first painted hour."""
        return self.painted(self.world.painted_hours[0], true_pose=True).texture.weight > 0.0


class Splats:
    """Gaussians distilled from an albedo under suns of other days; discs and their light transport are made once.

    Discs are as fine as the judged webcams' pixels are on the ground. ``refined`` ones learn from pictures too, those of the
    painting webcams' views and of cameras around the land. No picture of a judged webcam or of the judged day is used.
    """

    def __init__(self, bench: Bench):
        from seasonscapes.gaussians.disc_density import footprints, refined_surfels
        from seasonscapes.gaussians.disc_transport import light_state, trace_disc_transport
        from seasonscapes.gaussians.land_shadows import disc_shadows
        from seasonscapes.gaussians.rasterise import set_torch_threads
        from seasonscapes.gaussians.surfels import surfel_albedo, terrain_surfels
        from seasonscapes.gaussians.training_views import overview_cameras

        set_torch_threads(1)
        self.bench, world = bench, bench.world
        stage = RenderScene(world.bare.mi_scene, world.bare.mi_terrain)
        place_m, side_m = footprints(stage, world.judged)
        coarse = terrain_surfels(world.terrain, world.size.disc_m)
        self.surfels = refined_surfels(world.terrain, coarse, place_m, DISC_PX * side_m)
        set_albedo(bench.judge.scene, world.albedo)
        self.transport = trace_disc_transport(
            world.bare, self.surfels, surfel_albedo(self.surfels, world.albedo), rays=64, seed=world.seed
        )
        self.shadows = disc_shadows(world.bare, self.surfels)
        times = [hours(day, hour)[0] for day, hour in LESSONS]
        self.lights = [row[0] for row in lights_for(times, world.painting[:1], world.sky, default_workspace())]
        self.states = [light_state(self.transport, light, DAY_OF_YEAR) for light in self.lights]
        seen = [camera for panorama in world.painting for camera in split_panorama(panorama)]
        self.cameras = seen + overview_cameras(world.terrain, world.size.overviews, size_px=world.size.judged_px[1])

    def views(self, albedo: np.ndarray, *, refined: bool = False) -> Callable[[int, datetime], np.ndarray]:
        """Views of the Gaussians that an albedo was distilled into."""
        from seasonscapes.gaussians.appearance import Appearance, fourier_embedding
        from seasonscapes.gaussians.disc_geometry import DiscGeometry
        from seasonscapes.gaussians.disc_transport import neighbourhood_mean, surfel_irradiance
        from seasonscapes.gaussians.model import model_from
        from seasonscapes.gaussians.splat_view import learned_parameters, model_colours, model_weights, render_model
        from seasonscapes.gaussians.surfels import surfel_albedo
        from seasonscapes.gaussians.training import Schedule, surface_targets, train
        from seasonscapes.gaussians.training_views import relit_frames

        world, seed = self.bench.world, self.bench.world.seed
        set_albedo(self.bench.judge.scene, albedo)
        own = surfel_albedo(self.surfels, albedo)
        around = neighbourhood_mean(self.surfels.means, own, self.surfels.spacing_m)
        received = surfel_irradiance(world.bare, self.surfels, self.lights, rays=64, seed=seed)
        targets = surface_targets(self.states, [0] * len(self.states), own[None], received, self.shadows)
        appearance = Appearance(
            "full",
            own[None],
            around[None],
            self.transport,
            fourier_embedding(self.surfels.means, seed=seed),
            times=len(self.states),
            seed=seed,
        )
        frames = []
        if refined:
            instants = [(n, *pair) for n, pair in enumerate(zip(self.lights, self.states, strict=True))]
            frames = relit_frames(world.bare, self.surfels, self.cameras, instants, seed=seed)
            appearance.refine(DiscGeometry(self.surfels))
        train(appearance, targets, frames, Schedule(*world.size.steps), seed=seed)
        model = model_from(
            self.surfels, own[None], [DAY_OF_YEAR], self.transport, learned_parameters(appearance), frame=world.frame
        )
        weights = [model_weights(model, camera) for camera in world.judged]

        def view(camera: int, at: datetime) -> np.ndarray:
            light = self.bench.judge.light(camera, at)
            colours = model_colours(model, light, DAY_OF_YEAR, shadows=self.shadows)
            judged = world.judged[camera]
            return render_model(model, judged, light, DAY_OF_YEAR, weights=weights[camera], colours=colours).radiance

        return view


class Clock:
    """Processor and wall seconds between stages, on stderr."""

    def __init__(self):
        self.cpu, self.wall, self.start = time.process_time(), time.perf_counter(), time.perf_counter()

    def tell(self, what: str) -> None:
        cpu, wall = time.process_time(), time.perf_counter()
        print(f"  {what}: {cpu - self.cpu:.1f} CPU-s, {wall - self.wall:.1f} s", file=sys.stderr, flush=True)
        self.cpu, self.wall = cpu, wall
