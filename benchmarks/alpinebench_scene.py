"""A truth-known place and its webcams for AlpineBench: who paints, who is judged, at which hours."""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from albedo_scene import hours, lights_for, terrain_and_albedo

from seasonscapes.calibration.evidence import Correspondences, Priors
from seasonscapes.calibration.pose_model import values_of
from seasonscapes.calibration.resection import Calibration, calibrate
from seasonscapes.cameras.observation import Observation
from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.evaluation.splits import held_out_hours, refuse_leaks, use_of
from seasonscapes.evaluation.synthetic_webcams import Hour, SyntheticPicture, webcam_series
from seasonscapes.evaluation.webcam_faults import TYPICAL, PoseSigmas, perturb_pose
from seasonscapes.rendering.gather import Occluder, occluder
from seasonscapes.rendering.gbuffer import trace_gbuffer
from seasonscapes.rendering.scene import RenderScene, mi_mesh
from seasonscapes.rendering.transport import Effort
from seasonscapes.sky.illumination import Illumination
from seasonscapes.sky.models import SkyModel, read_sky_model, with_overrides
from seasonscapes.terrain.atlas import Atlas, measure_atlas
from seasonscapes.terrain.surface import Terrain
from seasonscapes.workspace import default_workspace

DATE, DAY_OF_YEAR = "2024-09-11", 254
SATELLITE_DATE, SATELLITE_DAY = "2024-07-23", 205
# GPS, compass and spirit level of an uncalibrated webcam; 12 points clicked to half a pixel, of which two are wrong.
GPS = PoseSigmas(5.0, 5.0, 4.0, 1.0, 1.0, 0.02)
CLICKS, WRONG, CLICK_PX = 12, 2, 0.5
# Painting and judged webcams stand at least this far apart.
_APART_M = 500.0


@dataclass(frozen=True)
class Size:
    """How large a scene is; of its hours every third is held out."""

    size_m: float
    spacing_m: float
    texel_m: float
    painting: int
    judged: int
    size_px: tuple[int, int]
    clock: tuple[float, ...]
    effort: Effort
    disc_m: float


_WEB = Effort(subpixels=4, shades=16, rays=64, senders=1024, listed=32, rank=24)
_FINE = Effort(subpixels=4, shades=16, rays=128, senders=4096, listed=32, rank=24)
SIZES = {
    "quick": Size(5400.0, 30.0, 18.0, 2, 1, (300, 200), (7.0, 8.5, 10.0, 12.0, 14.0, 15.5), _WEB, 36.0),
    "tiny": Size(3000.0, 60.0, 30.0, 2, 1, (144, 96), (8.5, 10.0, 14.0), _WEB, 60.0),
    "small": Size(8010.0, 30.0, 10.0, 2, 1, (768, 512), tuple(np.arange(6.5, 16.1, 0.5625).tolist()), _FINE, 30.0),
    "medium": Size(12000.0, 30.0, 10.0, 14, 41, (768, 512), tuple(np.linspace(6.5, 16.0, 14).tolist()), _FINE, 30.0),
}


@dataclass(frozen=True)
class World:
    """The truth.

    Parameters
    ----------
    terrain, atlas, bare
        The land and its rays.
    albedo, summer
        ``(R, S, 3)`` of the day that is photographed, and of a summer's day.
    painting, judged
        Cameras at their true poses.
    painted_hours, held_hours
        Times that webcams' pictures are used of, and times that they are not.
    lights
        By time, of each camera, painting ones first; under ``sky``.
    """

    seed: int
    size: Size
    terrain: Terrain
    atlas: Atlas
    bare: Occluder
    albedo: np.ndarray
    summer: np.ndarray
    painting: list[Camera]
    judged: list[Camera]
    painted_hours: tuple[datetime, ...]
    held_hours: tuple[datetime, ...]
    lights: dict[datetime, list[Illumination]]
    sky: SkyModel

    @property
    def hours(self) -> list[datetime]:
        return sorted(self.lights)


def make_world(seed: int, size: Size) -> World:
    """The massif of a seed, its webcams and its light."""
    from seasonscapes.terrain.synthetic import alpine_massif

    place = alpine_massif(seed=seed, size_m=size.size_m, spacing_m=size.spacing_m)
    terrain, albedo = terrain_and_albedo(place, size.spacing_m, size.texel_m, DAY_OF_YEAR)
    _, summer = terrain_and_albedo(place, size.spacing_m, size.texel_m, SATELLITE_DAY)
    shape = albedo.shape[:2]
    atlas = measure_atlas(terrain, "planar", shape[1], shape[0])
    bare = occluder(mi_mesh(terrain, albedo))
    painting, judged = choose_cameras(terrain, bare, size, seed)
    times = hours(DATE, *size.clock)
    painted_hours, held_hours = held_out_hours(times, 3)
    sky = with_overrides(read_sky_model("clear"), visibility_km=60.0)
    lights = lights_for(times, [*painting, *judged], sky, default_workspace())
    return World(seed, size, terrain, atlas, bare, albedo, summer, painting, judged,
                 painted_hours, held_hours, dict(zip(times, lights, strict=True)), sky)  # fmt: skip


def choose_cameras(terrain: Terrain, bare: Occluder, size: Size, seed: int) -> tuple[list[Camera], list[Camera]]:
    """Webcams to be judged that see much, and painting ones elsewhere that together see most of what these see.

    Chosen by geometry alone, as webcams of one valley do look at the same mountains.
    """
    scene = RenderScene(bare.mi_scene, bare.mi_terrain, None, 0.0)
    rng, reach = np.random.default_rng(seed), float(np.abs(terrain.vertices[:, :2]).max())
    found: list[tuple[Camera, np.ndarray]] = []
    for _ in range(120 + 4 * (size.painting + size.judged)):
        azimuth, radius = rng.uniform(0.0, 360.0), rng.uniform(0.35, 0.9) * reach
        spot = radius * np.array([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))])
        ground = terrain.vertices[np.argmin(((terrain.vertices[:, :2] - spot) ** 2).sum(axis=1)), 2]
        camera = camera_of(np.append(spot, ground + rng.uniform(40.0, 250.0)), azimuth + 180.0 + rng.uniform(-35.0, 35.0),
                           rng.uniform(-10.0, 2.0), (96, 64))  # fmt: skip
        seen = trace_gbuffer(scene, camera)
        land = np.isfinite(seen.depth)
        if 0.5 < land.mean() < 0.93 and np.percentile(seen.depth[land], 5) > 120.0:
            found.append((camera, np.unique((seen.uv[land] * 96).astype(int) @ np.array([1, 96]))))
    judged, covered = _greedy(found, size.judged, np.zeros(0, int), None)
    apart = [entry for entry in found
             if all(np.linalg.norm(entry[0].position_m - other.position_m) > _APART_M for other in judged)]  # fmt: skip
    painting, _ = _greedy(apart, size.painting, np.zeros(0, int), covered)
    return [resized(camera, size.size_px) for camera in painting], [resized(camera, size.size_px) for camera in judged]


def _greedy(found, count: int, covered: np.ndarray, wanted: np.ndarray | None) -> tuple[list[Camera], np.ndarray]:
    """One after the other, the camera that adds most cells (of the wanted ones)."""
    chosen, left = [], list(found)
    for _ in range(count):
        gains = [
            len(np.setdiff1d(cells if wanted is None else np.intersect1d(cells, wanted), covered)) for _, cells in left
        ]
        camera, cells = left.pop(int(np.argmax(gains)))
        chosen.append(camera)
        covered = np.union1d(covered, cells)
    return chosen, covered


def camera_of(position: np.ndarray, heading_deg: float, pitch_deg: float, size_px: tuple[int, int]) -> Camera:
    """A webcam of 62° field of view."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_angles(heading_deg, pitch_deg), position
    focal = 0.5 * size_px[0] / np.tan(np.radians(31.0))
    return Camera(*size_px, focal, focal, size_px[0] / 2.0, size_px[1] / 2.0, pose)


def resized(camera: Camera, size_px: tuple[int, int]) -> Camera:
    """The same view with other pixels."""
    focal = camera.fx * size_px[0] / camera.width_px
    return Camera(*size_px, focal, focal, size_px[0] / 2.0, size_px[1] / 2.0, camera.world_from_camera)


@dataclass(frozen=True)
class Pictures:
    """What webcams deliver: ``painting[c][t]`` and ``judged[c][t]`` over all hours, and calibrated poses of the former."""

    painting: list[list[SyntheticPicture]]
    judged: list[list[SyntheticPicture]]
    calibrated: list[Calibration]


def take_pictures(world: World) -> Pictures:
    """Photograph at all hours, calibrate the painting webcams, and see that what is judged is held out."""
    painting = [series(world, c, f"webcam-{c}") for c in range(len(world.painting))]
    judged = [series(world, len(world.painting) + c, f"judge-{c}") for c in range(len(world.judged))]
    calibrated = [calibrated_by_clicks(world, c, pictures[0]) for c, pictures in enumerate(painting)]
    made = Pictures(painting, judged, calibrated)
    used = [use_of(picture.observation, "painting") for row in painting for picture in row
            if picture.observation.time in world.painted_hours]  # fmt: skip
    seen = [use_of(picture.observation, "evaluation") for row in judged for picture in row]
    refuse_leaks(seen, used, kind="view")
    refuse_leaks([use for use in seen if use.time in world.held_hours], used, kind="hour")
    return made


def series(world: World, number: int, name: str) -> list[SyntheticPicture]:
    """Pictures of one webcam at all hours, at full physics and with a webcam's faults."""
    camera = [*world.painting, *world.judged][number]
    made = [Hour(time, world.lights[time][number], world.albedo) for time in world.hours]
    return webcam_series(world.terrain, name, camera, made, faults=TYPICAL, effort=world.size.effort, seed=world.seed)


def calibrated_by_clicks(world: World, number: int, picture: SyntheticPicture) -> Calibration:
    """A pose from GPS, compass and clicked points, as a person would find it."""
    rng = np.random.default_rng([world.seed, 77, number])
    start, _ = perturb_pose(picture.camera, GPS, rng)
    far = np.argwhere(np.isfinite(picture.gbuffer.depth) & (picture.gbuffer.depth > 250.0))
    chosen = far[rng.choice(len(far), CLICKS, replace=False)]
    pixel = chosen[:, ::-1] + 0.5 + rng.normal(0.0, CLICK_PX, (CLICKS, 2))
    pixel[:WRONG] += rng.choice([-1.0, 1.0], (WRONG, 2)) * rng.uniform(8.0, 40.0, (WRONG, 2))
    points = Correspondences(pixel, picture.gbuffer.position[chosen[:, 0], chosen[:, 1]])
    return calibrate(start, points, priors=Priors(horizontal_m=GPS.horizontal_m, vertical_m=GPS.vertical_m, focal=0.02))


def pose_errors(calibrated: Calibration, truth: Camera) -> tuple[float, float]:
    """Heading error [deg] and distance of the place [m]."""
    off = calibrated.values - values_of(truth, np.eye(3))
    return abs((off[0] + 180.0) % 360.0 - 180.0), float(np.linalg.norm(off[3:6]))


def observed(pictures: Pictures, world: World, time: datetime, *, clean: bool = False,
             true_pose: bool = False) -> list[tuple[Observation, dict]]:  # fmt: skip
    """Pictures of the painting webcams at a time, with their poses' deviations.

    Parameters
    ----------
    clean
        Linear and noiseless, all webcams exposed alike.
    true_pose
        Rather than the calibrated one.
    """
    index, found = world.hours.index(time), []
    whites = [np.quantile(row[index].radiance, 0.999) for row in pictures.painting]
    for row, calibrated in zip(pictures.painting, pictures.calibrated, strict=True):
        seen, sigma = row[index].observation, {}
        if clean:
            seen = replace(seen, image=np.clip(row[index].radiance / max(whites), 0.0, 1.0).astype(np.float32))
        if true_pose:
            seen = replace(seen, camera=row[index].camera)
        else:
            seen, sigma = replace(seen, camera=calibrated.view), calibrated.sigma
        found.append((seen, sigma))
    return found
