"""A truth-known place and its webcams for AlpineBench: who paints, who is judged, at which hours."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from albedo_scene import LATITUDE_DEG, LONGITUDE_DEG, hours, lights_for

from seasonscapes.calibration.evidence import Correspondences, Priors
from seasonscapes.calibration.pose_model import parameters_of_view
from seasonscapes.calibration.resection import Calibration, resect
from seasonscapes.cameras.observation import Observation
from seasonscapes.cameras.panorama import Panorama, cut_view, split_panorama
from seasonscapes.cameras.pinhole import Camera, rotation_from_angles
from seasonscapes.evaluation.splits import check_no_leakage, held_out_times, picture_use
from seasonscapes.evaluation.synthetic_webcams import SyntheticPicture, WebcamInstant, WebcamOptions, webcam_series
from seasonscapes.evaluation.webcam_faults import TYPICAL, PoseSigmas, perturb_pose
from seasonscapes.frames import LocalFrame
from seasonscapes.rendering.coefficients import SamplingOptions
from seasonscapes.rendering.gbuffer import trace_gbuffer
from seasonscapes.rendering.hemisphere_rays import RayScene, ray_scene
from seasonscapes.rendering.mitsuba_scene import RenderScene, mi_mesh
from seasonscapes.sky.illumination import Illumination
from seasonscapes.sky.models import SkyModel, read_sky_model, with_overrides
from seasonscapes.terrain.atlas import Atlas, measure_atlas
from seasonscapes.terrain.surface import Raster, Terrain
from seasonscapes.workspace import default_workspace

DATE, DAY_OF_YEAR = "2024-09-11", 254
SATELLITE_DATE, SATELLITE_DAY = "2024-07-23", 205
# GPS, compass and spirit level of an uncalibrated webcam; 12 points clicked to half a pixel, of which two are wrong.
GPS = PoseSigmas(5.0, 5.0, 4.0, 1.0, 1.0, 0.02)
CLICKS, WRONG, CLICK_PX = 12, 2, 0.5
# The middle of the real raster's scenes (EPSG:32632): meadows, walls of 3 km and firn within sight of each other.
_WENGERNALP_UTM_M = (418000.0, 5158000.0)
# Painting and judged webcams stand at least this far apart.
_APART_M = 500.0


@dataclass(frozen=True)
class Size:
    """How large a scene is; of its hours every third is held out.

    Parameters
    ----------
    extent_m
        East-west and north-south.
    webcams, span_deg
        Painting panoramas and how far round each looks; one beyond 85° is cut into several views.
    judged, judged_px
        Perspective views that nobody painted from.
    rows_px
        Of a panorama; 62° of it are half as wide again.
    ablated
        How many judged views ablations are scored on.
    steps
        Of the distillation: on the surface, and with pictures.
    overviews
        Cameras around the land whose pictures Gaussians learn from too.
    day_step_h
        Between the pictures of the day that is filmed.
    """

    extent_m: tuple[float, float]
    spacing_m: float
    texel_m: float
    webcams: int
    span_deg: float
    rows_px: int
    judged: int
    judged_px: tuple[int, int]
    clock: tuple[float, ...]
    sampling: SamplingOptions
    disc_m: float
    ablated: int = 8
    steps: tuple[int, int] = (600, 96)
    overviews: int = 6
    day_step_h: float = 1.0 / 3.0


_WEB = SamplingOptions(shadow_samples=4, albedo_samples=16, rays=64, clusters=1024, clusters_per_receiver=32, rank=24)
_FINE = SamplingOptions(shadow_samples=4, albedo_samples=16, rays=128, clusters=4096, clusters_per_receiver=32, rank=24)
_QUICK_HOURS = (7.0, 8.5, 10.0, 12.0, 14.0, 15.5)
SIZES = {
    "tiny": Size(
        (3000.0, 3000.0),
        60.0,
        30.0,
        2,
        75.0,
        96,
        1,
        (144, 96),
        (8.5, 10.0, 14.0),
        _WEB,
        60.0,
        steps=(50, 8),
        overviews=1,
        day_step_h=2.0,
    ),
    "quick": Size((5400.0, 5400.0), 30.0, 18.0, 2, 75.0, 200, 1, (300, 200), _QUICK_HOURS, _WEB, 36.0),
    "small": Size(
        (8040.0, 8040.0),
        30.0,
        10.0,
        2,
        75.0,
        512,
        1,
        (768, 512),
        tuple(np.linspace(6.5, 16.0, 18).tolist()),
        _FINE,
        40.0,
    ),
    "medium": Size(
        (12000.0, 12000.0),
        30.0,
        16.0,
        7,
        150.0,
        384,
        41,
        (288, 192),
        tuple(np.linspace(6.5, 16.0, 14).tolist()),
        _WEB,
        60.0,
        4,
    ),
    "large": Size((36500.0, 21000.0), 100.0, 30.0, 16, 150.0, 384, 16, (384, 256), (7.5, 9.5, 12.0, 15.0), _WEB, 120.0),
}


@dataclass(frozen=True)
class Ground:
    """Heights, and reflectance by day of the year on a raster of its own."""

    elevation: Raster
    albedo_of: Callable[[int], Raster]
    frame: LocalFrame


def massif_ground(seed: int, size: Size) -> Ground:
    """The embedded massif, with other crests and valleys for every seed."""
    from affine import Affine

    from seasonscapes.terrain.synthetic import alpine_albedo, alpine_massif

    place = alpine_massif(seed=seed, size_m=size.extent_m[0], spacing_m=size.spacing_m)
    finer = place.elevation.transform * Affine.scale(0.5)
    return Ground(
        place.elevation,
        lambda day: Raster(alpine_albedo(place, day, upsample=2), finer, place.elevation.crs),
        LocalFrame(LATITUDE_DEG, LONGITUDE_DEG),
    )


def jungfrau_ground(seed: int, size: Size, data: Path) -> Ground:
    """The real raster of the Bernese Oberland about Wengernalp (as far as it reaches), in the snow that a seed lays."""
    from affine import Affine
    from texturing_places import jungfrau_land

    from seasonscapes.terrain.raster import centre_frame

    whole, _, albedo_of = jungfrau_land(data, np.random.default_rng(seed))
    cell_m = abs(whole.transform.a)
    columns, rows = (
        min(round(extent / cell_m), n) for extent, n in zip(size.extent_m, whole.values.shape[1::-1], strict=True)
    )
    column, row = ~whole.transform * _WENGERNALP_UTM_M
    left = int(np.clip(round(column - columns / 2), 0, whole.values.shape[1] - columns))
    top = int(np.clip(round(row - rows / 2), 0, whole.values.shape[0] - rows))
    transform = whole.transform * Affine.translation(left, top)

    def cropped(values: np.ndarray) -> Raster:
        return Raster(np.ascontiguousarray(values[top : top + rows, left : left + columns]), transform, whole.crs)

    elevation = cropped(whole.values)
    return Ground(elevation, lambda day: cropped(albedo_of(day)), centre_frame(elevation))


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
        Panoramas and perspective cameras at their true poses.
    painted_hours, held_hours
        Times that webcams' pictures are used of, and times that they are not.
    lights
        By time, of each camera, painting ones first; under ``sky``.
    """

    seed: int
    size: Size
    terrain: Terrain
    atlas: Atlas
    bare: RayScene
    albedo: np.ndarray
    summer: np.ndarray
    painting: list[Panorama]
    judged: list[Camera]
    painted_hours: tuple[datetime, ...]
    held_hours: tuple[datetime, ...]
    lights: dict[datetime, list[Illumination]]
    sky: SkyModel
    frame: LocalFrame

    @property
    def hours(self) -> list[datetime]:
        return sorted(self.lights)


def make_world(seed: int, size: Size, data: Path | None = None) -> World:
    """A place of a seed, its webcams and its light: the massif, or the real raster where a folder of data is given."""
    from seasonscapes.terrain.imagery import bake_imagery
    from seasonscapes.terrain.mesh import build_mesh
    from seasonscapes.terrain.unwrap import unwrap

    ground = massif_ground(seed, size) if data is None else jungfrau_ground(seed, size, data)
    terrain, chart = unwrap(build_mesh(ground.elevation, ground.frame, mesher="grid"), texel_m=size.texel_m)
    albedo, summer = (
        bake_imagery(terrain, chart, ground.albedo_of(day)).values for day in (DAY_OF_YEAR, SATELLITE_DAY)
    )
    shape = albedo.shape[:2]
    atlas = measure_atlas(terrain, "planar", shape[1], shape[0])
    bare = ray_scene(mi_mesh(terrain, albedo))
    painting, judged = choose_cameras(terrain, bare, size, seed)
    times = hours(DATE, *size.clock)
    painted_hours, held_hours = held_out_times(times, 3)
    sky = with_overrides(read_sky_model("clear"), visibility_km=60.0)
    lights = lights_for(times, [*painting, *judged], sky, default_workspace())
    return World(
        seed,
        size,
        terrain,
        atlas,
        bare,
        albedo,
        summer,
        painting,
        judged,
        painted_hours,
        held_hours,
        dict(zip(times, lights, strict=True)),
        sky,
        ground.frame,
    )


def choose_cameras(terrain: Terrain, bare: RayScene, size: Size, seed: int) -> tuple[list[Panorama], list[Camera]]:
    """Webcams to be judged that see much, and painting ones elsewhere that together see most of what these see.

    Chosen by geometry alone, as webcams of one valley do look at the same mountains.
    """
    scene = RenderScene(bare.mi_scene, bare.mi_terrain)
    rng, reach = np.random.default_rng(seed), np.abs(terrain.vertices[:, :2]).max(axis=0)
    found: list[tuple[Camera, np.ndarray]] = []
    for _ in range(120 + 4 * (size.webcams + size.judged)):
        azimuth, radius = rng.uniform(0.0, 360.0), rng.uniform(0.35, 0.9) * reach
        spot = radius * np.array([np.sin(np.radians(azimuth)), np.cos(np.radians(azimuth))])
        ground = terrain.vertices[np.argmin(((terrain.vertices[:, :2] - spot) ** 2).sum(axis=1)), 2]
        camera = camera_of(
            np.append(spot, ground + rng.uniform(40.0, 250.0)),
            azimuth + 180.0 + rng.uniform(-35.0, 35.0),
            rng.uniform(-10.0, 2.0),
            (96, 64),
        )
        seen = trace_gbuffer(scene, camera)
        land = np.isfinite(seen.depth)
        if 0.5 < land.mean() < 0.93 and np.percentile(seen.depth[land], 5) > 120.0:
            found.append((camera, np.unique((seen.uv[land] * 96).astype(int) @ np.array([1, 96]))))
    judged, covered = _greedy(found, size.judged, np.zeros(0, int), None)
    apart = [
        entry
        for entry in found
        if all(np.linalg.norm(entry[0].position_m - other.position_m) > _APART_M for other in judged)
    ]
    painting, _ = _greedy(apart, size.webcams, np.zeros(0, int), covered)
    return [panorama_of(camera, size) for camera in painting], [resized(camera, size.judged_px) for camera in judged]


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
    """A view of 62°."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation_from_angles(heading_deg, pitch_deg), position
    focal = _focal_px(size_px[0])
    return Camera(*size_px, focal, focal, size_px[0] / 2.0, size_px[1] / 2.0, pose)


def _focal_px(width_px: float) -> float:
    return 0.5 * width_px / np.tan(np.radians(31.0))


def resized(camera: Camera, size_px: tuple[int, int]) -> Camera:
    """The same view with other pixels."""
    focal = camera.fx * size_px[0] / camera.width_px
    return Camera(*size_px, focal, focal, size_px[0] / 2.0, size_px[1] / 2.0, camera.world_from_camera)


def panorama_of(camera: Camera, size: Size) -> Panorama:
    """A level cylindrical panorama about a camera's heading; its lens is shifted by as much as the camera is pitched."""
    forward = camera.world_from_camera[:3, 2]
    pose = camera.world_from_camera.copy()
    pose[:3, :3] = rotation_from_angles(float(np.degrees(np.arctan2(forward[0], forward[1]))), 0.0)
    focal = _focal_px(1.5 * size.rows_px)
    width = round(np.radians(size.span_deg) * focal)
    rise = forward[2] / np.hypot(forward[0], forward[1])
    return Panorama(
        "cylindrical", width, size.rows_px, focal, focal, width / 2.0, size.rows_px / 2.0 + focal * rise, pose
    )


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
    used = [
        picture_use(picture.observation, "painting")
        for row in painting
        for picture in row
        if picture.observation.time in world.painted_hours
    ]
    seen = [picture_use(picture.observation, "evaluation") for row in judged for picture in row]
    check_no_leakage(seen, used, kind="view")
    check_no_leakage([use for use in seen if use.time in world.held_hours], used, kind="hour")
    return made


def series(world: World, number: int, name: str) -> list[SyntheticPicture]:
    """Pictures of one webcam at all hours, at full physics and with a webcam's faults."""
    camera = [*world.painting, *world.judged][number]
    made = [WebcamInstant(time, world.lights[time][number], world.albedo) for time in world.hours]
    options = WebcamOptions(TYPICAL, sampling=world.size.sampling)
    return webcam_series(world.terrain, name, camera, made, options=options, seed=world.seed)


def calibrated_by_clicks(world: World, number: int, picture: SyntheticPicture) -> Calibration:
    """A pose from GPS, compass and clicked points, as a person would find it."""
    rng = np.random.default_rng([world.seed, 77, number])
    start, _ = perturb_pose(picture.camera, GPS, rng)
    far = np.argwhere(np.isfinite(picture.gbuffer.depth) & (picture.gbuffer.depth > 250.0))
    chosen = far[rng.choice(len(far), CLICKS, replace=False)]
    pixel = chosen[:, ::-1] + 0.5 + rng.normal(0.0, CLICK_PX, (CLICKS, 2))
    pixel[:WRONG] += rng.choice([-1.0, 1.0], (WRONG, 2)) * rng.uniform(8.0, 40.0, (WRONG, 2))
    points = Correspondences(pixel, picture.gbuffer.position[chosen[:, 0], chosen[:, 1]])
    return resect(start, points, priors=Priors(horizontal_m=GPS.horizontal_m, vertical_m=GPS.vertical_m, focal=0.02))


def pose_errors(calibrated: Calibration, truth: Panorama) -> tuple[float, float]:
    """Heading error [deg] and distance of the place [m]."""
    off = calibrated.parameters - parameters_of_view(truth, np.eye(3))
    return abs((off[0] + 180.0) % 360.0 - 180.0), float(np.linalg.norm(off[3:6]))


def observed(
    pictures: Pictures, world: World, time: datetime, *, gain: float | None = None, true_pose: bool = False
) -> list[tuple[Observation, dict, int]]:
    """Views cut out of the panoramas of a time, their poses' deviations, and the numbers of their webcams.

    Parameters
    ----------
    gain
        Instead of the webcams' pictures, linear and noiseless ones of so much per cd/m².
    true_pose
        Rather than the calibrated one.
    """
    index, found = world.hours.index(time), []
    for number, (row, calibrated) in enumerate(zip(pictures.painting, pictures.calibrated, strict=True)):
        picture = row[index]
        image = picture.observation.image if gain is None else picture.radiance * np.float32(gain)
        panorama, sigma = (picture.camera, {}) if true_pose else (calibrated.view, calibrated.sigma)
        for part, camera in enumerate(split_panorama(panorama)):
            view, inside = cut_view(image, panorama, camera)
            found.append((Observation(view, inside, camera, time, f"webcam-{number}/{part}"), sigma, number))
    return found


def clean_gain(pictures: Pictures, world: World, time: datetime) -> float:
    """An exposure for all webcams alike under which hardly anything is clipped."""
    index = world.hours.index(time)
    return 1.0 / max(float(np.quantile(row[index].radiance, 0.999)) for row in pictures.painting)
