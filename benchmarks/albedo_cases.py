"""Cases in which the closed form's assumptions are wrong, and the joint recovery beside it, with one set of options for all.

Every case has 8-bit sRGB pictures with noise, JPEG, and unknown exposure and white balance. What else is wrong is told to
neither method; both assume the clear model's air, an sRGB response, the poses as given (with a standard deviation), and no
cloud before the sun.

* haze: the visibility is drawn from 18 to 45 km, where about 70 km is assumed;
* curve: an S-curve of each camera's own strength, 0.25 to 0.6;
* pose: each camera is turned by 0.1 to 0.3° about a random axis;
* bounce: slopes 1.8 times as steep, under fresh snow above saturated red and green slopes: interreflection is strong and coloured;
* clouds: at half of the hours the shadows of clouds cover about half of the land, and the skylight is that of a half-cloudy
  sky. The shadows have soft edges at no grid that the recovery knows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from albedo_scene import Truth, lights_for, low_cameras, path_traced, terrain_and_albedo
from scipy.ndimage import gaussian_filter

from seasonscapes.albedo.closed_form import AlbedoFit, solve_albedo
from seasonscapes.albedo.forward_model import TexelTransport, trace_texel_transport
from seasonscapes.albedo.joint_recovery import JointRecovery, recover_jointly
from seasonscapes.albedo.photographs import EIGHT_BIT, AlbedoPhotograph, prepare_photographs
from seasonscapes.albedo.recovery_pictures import HazeLights
from seasonscapes.cameras.observation import Observation
from seasonscapes.evaluation.webcam_faults import WebcamFaults, degrade
from seasonscapes.images import linear_from_srgb
from seasonscapes.sky.clouds import with_clouds
from seasonscapes.sky.models import SkyModel, visibility_km, with_overrides

CASES = ("haze", "curve", "pose", "bounce", "clouds")
NODES_KM = (12.0, 25.0, 50.0, 100.0)
POSE_SIGMA = {"heading_deg": 0.2, "pitch_deg": 0.2, "roll_deg": 0.2}


@dataclass(frozen=True)
class CaseResult:
    """One case: both fits, over the land of the case."""

    closed: AlbedoFit
    joint: JointRecovery
    gain_db: float
    closed_db: float
    joint_db: float


def wrong_cameras(truth: Truth, rng: np.random.Generator) -> list:
    """The cameras turned by 0.1 to 0.3° about random axes."""
    result = []
    for camera in truth.cameras:
        axis = rng.normal(size=3)
        turn = np.radians(rng.uniform(0.1, 0.3)) * axis / np.linalg.norm(axis)
        pose = camera.world_from_camera.copy()
        pose[:3, :3] = cv2.Rodrigues(turn)[0] @ pose[:3, :3]
        result.append(replace(camera, world_from_camera=pose))
    return result


def photographed(times, pictures, faults, cameras, rng: np.random.Generator) -> list[Observation]:
    """What the webcams deliver, in the order time, camera; ``faults`` of each camera."""
    found = []
    for t, moment in enumerate(times):
        for c, camera in enumerate(cameras):
            levels, _ = degrade(pictures[t][c], faults[c], rng)
            image = linear_from_srgb(levels / 255.0)
            mask = np.ones(image.shape[:2], bool)
            found.append(Observation(image, mask, camera, moment, f"camera{c}", POSE_SIGMA))
    return found


def cloud_shadows(truth: Truth, rng: np.random.Generator, share: float) -> list[np.ndarray]:
    """Where clouds let the sun through, 0 to 1, in the pixels of each camera ``(H, W)``: smoothed noise over the land."""
    from seasonscapes.rendering.gbuffer import trace_gbuffer
    from seasonscapes.rendering.hemisphere_rays import ray_scene
    from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh

    reach = float(np.abs(truth.terrain.vertices[:, :2]).max())
    side = 256
    noise = gaussian_filter(rng.normal(size=(side, side)), side * 700.0 / (2.0 * reach), mode="wrap")
    edge = 0.25 * noise.std()
    field = 1.0 / (1.0 + np.exp(-(noise - np.quantile(noise, share)) / edge))
    bare = ray_scene(mi_mesh(truth.terrain, np.full(3, 0.3)))
    scene, result = RenderScene(bare.mi_scene, bare.mi_terrain), []
    for camera in truth.cameras:
        buffer = trace_gbuffer(scene, camera)
        place = np.nan_to_num(buffer.position[..., :2])
        column, row = ((place / reach + 1.0) * 0.5 * (side - 1)).astype(np.float32).transpose(2, 0, 1)
        result.append(cv2.remap(field, np.ascontiguousarray(column), np.ascontiguousarray(row), cv2.INTER_LINEAR))
    return result


def gorge(truth: Truth, seed: int, cameras: int, texel_m: float) -> Truth:
    """The massif 1.8 times as steep, with fresh snow and saturated colours."""
    place = replace(
        truth.place, elevation=replace(truth.place.elevation, values=_steeper(truth.place.elevation.values))
    )
    terrain, _ = terrain_and_albedo(place, truth.spacing_m, texel_m, 110)
    albedo = _saturated(terrain_and_albedo(truth.place, truth.spacing_m, texel_m, 110)[1])
    size_px = (truth.cameras[0].width_px, truth.cameras[0].height_px)
    return Truth(seed, terrain, albedo, low_cameras(terrain, cameras, size_px, seed), truth.spacing_m, place)


def _steeper(height_m: np.ndarray) -> np.ndarray:
    return (1000.0 + 1.8 * (height_m - height_m.min())).astype(height_m.dtype)


def _saturated(albedo: np.ndarray) -> np.ndarray:
    """Twice the difference of the channels from grey, and half as bright again; snow stays."""
    grey = albedo.mean(axis=2, keepdims=True)
    coloured = np.clip(1.5 * grey * np.exp(2.0 * np.log(np.maximum(albedo, 1e-3) / np.maximum(grey, 1e-3))), 0.01, 0.7)
    return np.where(grey > 0.5, albedo, coloured).astype(np.float32)


@dataclass(frozen=True)
class CaseScene:
    """Land, its pictures under truth, and what both methods are told of them."""

    truth: Truth
    land: TexelTransport
    observations: list[Observation]


def case_scene(
    name: str, truth: Truth, land: TexelTransport, times, clear, model, workspace, size, seed: int
) -> CaseScene:
    """Make the pictures of a case, from those of the clear day where they serve; the draws are the seed's and the case's."""
    rng = np.random.default_rng([seed, CASES.index(name)])
    if name == "bounce":
        truth = gorge(truth, seed, len(truth.cameras), size.texel_m)
        land = trace_texel_transport(truth.terrain, truth.shape)
    if name == "haze":
        model = with_overrides(model, visibility_km=float(np.exp(rng.uniform(np.log(18.0), np.log(45.0)))))
    if name in ("haze", "bounce"):
        lights = lights_for(times, truth.cameras, model, workspace)
        pictures = path_traced(truth, truth.albedo, lights, spp=size.spp // 2, seed=seed + 1)
    elif name == "clouds":
        pictures = clouded(truth, times, clear, model, workspace, size, rng, seed)
    else:
        pictures = clear
    curves = rng.uniform(0.25, 0.6, len(truth.cameras)) if name == "curve" else np.zeros(len(truth.cameras))
    faults = [WebcamFaults(tone_strength=float(strength)) for strength in curves]
    cameras = wrong_cameras(truth, rng) if name == "pose" else truth.cameras
    return CaseScene(truth, land, photographed(times, pictures, faults, cameras, rng))


def clouded(truth: Truth, times, clear, model, workspace, size, rng: np.random.Generator, seed: int) -> list:
    """The pictures of the day with cloud shadows at every second hour."""
    hours = range(1, len(times), 2)
    lights = [_half_cloudy(row) for row in lights_for([times[t] for t in hours], truth.cameras, model, workspace)]
    sunless = [[replace(light, sun=None) for light in row] for row in lights]
    lit = path_traced(truth, truth.albedo, lights, spp=size.spp // 2, seed=seed + 1)
    shaded = path_traced(truth, truth.albedo, sunless, spp=size.spp // 2, seed=seed + 2)
    pictures = [list(row) for row in clear]
    for k, t in enumerate(hours):
        for c, share in enumerate(cloud_shadows(truth, rng, rng.uniform(0.35, 0.65))):
            through = (0.08 + 0.92 * share)[..., None]
            pictures[t][c] = through * lit[k][c] + (1.0 - through) * shaded[k][c]
    return pictures


def _half_cloudy(row: list) -> list:
    """The lights of an hour with the skylight of a half-cloudy sky, the sun as bright as before."""
    return [replace(with_clouds(light, 0.5, light.sun.direction), sun=light.sun) for light in row]


def assumed_haze(times, cameras, model: SkyModel, workspace) -> HazeLights:
    """Lights of the assumed model at the nodes of visibility; what the recovery may choose among."""
    nodes = [with_overrides(model, visibility_km=km) for km in NODES_KM]
    lights = [[light for row in lights_for(times, cameras, node, workspace) for light in row] for node in nodes]
    return HazeLights(NODES_KM, lights, float(visibility_km(model)))


def solve_case(case: CaseScene, lights: list, haze: HazeLights) -> CaseResult:
    """Both methods on one case."""
    photographs: list[AlbedoPhotograph] = prepare_photographs(case.land, case.observations, lights)
    closed = solve_albedo(case.land, photographs, noise_model=EIGHT_BIT)
    joint = recover_jointly(case.land, photographs, closed, haze=haze)
    seen = (closed.pixel_count >= 1.0)[..., None]
    closed_db, joint_db = (_psnr(fit.albedo - case.truth.albedo, seen) for fit in (closed, joint.fit))
    return CaseResult(closed, joint, joint_db - closed_db, closed_db, joint_db)


def _psnr(error: np.ndarray, mask: np.ndarray) -> float:
    return float(-10.0 * np.log10(np.mean(np.square(error, dtype=float)[np.broadcast_to(mask, error.shape)])))
