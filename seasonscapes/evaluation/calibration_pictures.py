"""Pictures of a made-up massif from a known pose: haze, clouds, snow, something standing before it, fog at will.

The terrain that a trial hands to the alignment is not the one it was drawn from: it has height errors of its own, as
every elevation model has.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from affine import Affine

from seasonscapes.calibration.pose_model import View, values_of, view_from_values
from seasonscapes.calibration.terrain_horizon import horizon_from, terrain_height
from seasonscapes.calibration.terrain_view import look_at_rasters
from seasonscapes.cameras.panorama import panorama_from_angles
from seasonscapes.cameras.pinhole import camera_at, rotation_from_angles
from seasonscapes.frames import LocalFrame
from seasonscapes.terrain.crs import geodetic_from_map
from seasonscapes.terrain.surface import Raster

_CRS, _EAST_M, _NORTH_M = "EPSG:25832", 420_000.0, 5_160_000.0
_CELL_M, _CELLS = 40.0, 640


@dataclass(frozen=True)
class PictureTrial:
    """A picture ``(H, W, 3)`` uint8 with its true sky and camera, and what is known of it."""

    image: np.ndarray
    mask: np.ndarray
    sky: np.ndarray
    truth: View
    start: View
    rasters: tuple[Raster, ...]
    frame: LocalFrame


def made_up_massif(rng: np.random.Generator) -> Raster:
    """A fractal mountain range of 26 km by 26 km: ridged noise in octaves over a broad valley."""
    height = np.zeros((_CELLS, _CELLS), np.float32)
    amplitude, cells = 900.0, 5
    weight = np.ones_like(height)
    while cells < _CELLS:
        noise = rng.normal(size=(cells + 3, cells + 3)).astype(np.float32)
        octave = cv2.resize(noise, (_CELLS, _CELLS), interpolation=cv2.INTER_CUBIC)
        ridged = 1.0 - np.abs(octave)
        height += amplitude * weight * ridged
        weight = np.clip(0.4 + 0.6 * ridged, 0.1, 1.2)
        amplitude, cells = amplitude * 0.47, cells * 2
    height = 1800.0 + (height - np.median(height))
    transform = Affine(_CELL_M, 0.0, _EAST_M, 0.0, -_CELL_M, _NORTH_M + _CELLS * _CELL_M)
    return Raster(np.maximum(height, 600.0)[..., None], transform, _CRS)


def picture_trial(
    rng: np.random.Generator,
    *,
    visibility_m: float | None = None,
    covered: float | None = None,
    heading_off_deg: float | None = None,
    size_px: tuple[int, int] = (1280, 854),
) -> PictureTrial:
    """One trial.

    Parameters
    ----------
    visibility_m
        Meteorological visibility [m]: 20 to 150 km at random when left out. In fog of some hundred metres there is no
        skyline, whatever an algorithm may believe.
    covered
        Share of the columns in which something masked reaches above the skyline; 0 to 0.35 at random when left out.
    heading_off_deg
        Error of the start's heading; uniform within ±10 when left out.
    """
    raster = made_up_massif(rng)
    frame, place = _viewpoint(raster, rng)
    fov = rng.uniform(50, 75)
    heading, elevation = _outlook(raster, frame, place, fov, rng)
    pitch = elevation - rng.uniform(0.0, 0.25) * fov * size_px[1] / size_px[0]
    truth = camera_at(
        frame, *place, heading_deg=heading, pitch_deg=pitch, roll_deg=rng.normal(0, 0.7), fov_deg=fov, size_px=size_px
    )
    view = look_at_rasters(truth, [raster], frame, nearest_m=120.0, reach_m=40e3)
    distance, normal, seen = view.distance_m, view.normal, view.position_m - truth.position_m
    covered = rng.uniform(0.0, 0.35) if covered is None else covered
    if visibility_m is None:
        visibility_m = float(np.exp(rng.uniform(np.log(20e3), np.log(150e3))))
    image = _paint(distance, normal, seen, rng, visibility_m)
    image, mask = _stand_before(image, covered, rng)
    values = values_of(truth, np.eye(3))
    values[0] += rng.uniform(-10, 10) if heading_off_deg is None else heading_off_deg
    values[1:3] += [rng.normal(0, 1.0), -values[2]]
    values[3:6] += rng.normal(0, 1.0, 3) * [3.0, 3.0, 2.0]
    error = cv2.GaussianBlur(rng.normal(size=(_CELLS, _CELLS)).astype(np.float32), (0, 0), 1.5)
    known = replace(raster, values=raster.values + (5.0 * error / error.std())[..., None])
    return PictureTrial(
        image, mask, np.isinf(distance), truth, view_from_values(truth, np.eye(3), values), (known,), frame
    )


def panorama_trial(rng: np.random.Generator, *, size_px: tuple[int, int] = (3600, 420)) -> PictureTrial:
    """A full turn from one place; the start is off in heading, by some rows of the horizon and by a lean of its axis."""
    raster = made_up_massif(rng)
    frame, place = _viewpoint(raster, rng)
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(rng.uniform(0, 360), *rng.normal(0, 0.4, 2))
    pose[:3, 3] = [0.0, 0.0, place[2]]
    truth = panorama_from_angles(
        "cylindrical",
        size_px,
        horizontal_fov_deg=360.0,
        vertical_fov_deg=41.0,
        pose=pose,
        horizon_row_px=size_px[1] * rng.uniform(0.45, 0.55),
    )
    view = look_at_rasters(truth, [raster], frame, nearest_m=120.0, reach_m=40e3)
    image = _paint(view.distance_m, view.normal, view.position_m - truth.position_m, rng, 60e3)
    values = values_of(truth, np.eye(3))
    values[:3] = values[0] + rng.uniform(-10, 10), 0.0, 0.0
    values[8] = rng.uniform(-1.5, 1.5) * truth.fy * np.pi / 180.0
    mask = np.ones(image.shape[:2], bool)
    return PictureTrial(
        image, mask, np.isinf(view.distance_m), truth, view_from_values(truth, np.eye(3), values), (raster,), frame
    )


def _viewpoint(raster: Raster, rng: np.random.Generator):
    """A place on a shoulder near the middle, 10 m above ground: high enough to see, not a summit."""
    middle = np.array([_EAST_M, _NORTH_M]) + 0.5 * _CELLS * _CELL_M
    spots = middle + rng.uniform(-4000, 4000, (60, 2))
    latitude, longitude = geodetic_from_map(_CRS, spots[:, 0], spots[:, 1])
    height = terrain_height([raster], latitude, longitude)
    chosen = int(np.argsort(height)[int(0.85 * len(height))])
    frame = LocalFrame(float(latitude[chosen]), float(longitude[chosen]), 0.0, 0.13)
    return frame, (float(latitude[chosen]), float(longitude[chosen]), float(height[chosen]) + 10.0)


def _outlook(raster: Raster, frame: LocalFrame, place, fov_deg: float, rng: np.random.Generator) -> tuple[float, float]:
    """A heading with a wide view, as people choose for webcams, and the mean elevation of its skyline [deg]."""
    position = np.array([0.0, 0.0, place[2]])
    horizon = horizon_from([raster], frame, position, azimuth_deg=np.arange(0.0, 360.0, 1.0), nearest_m=120.0)
    elevation = np.nan_to_num(horizon.skyline_elevation_deg, nan=30.0)
    distance = np.linalg.norm(np.nan_to_num(horizon.skyline_m) - position, axis=1)
    half = int(fov_deg / 2)
    window = np.arange(-half, half + 1)
    # Share of the view that ends within 2 km or towers over the camera.
    poor = (distance < 2000.0) | (elevation > 12.0)
    share = np.array([poor[(a + window) % 360].mean() for a in range(360)])
    chosen = int(rng.choice(np.argsort(share)[:60]))
    return float(chosen), float(np.median(elevation[(chosen + window) % 360]))


def _paint(distance, normal, spot, rng, visibility_m: float) -> np.ndarray:
    """Sunlit rock, meadow and snow patches behind air; clouds in the sky; blur, noise, eight bits."""
    height, width = distance.shape
    sun = np.array([np.sin(t := rng.uniform(0, 2 * np.pi)), np.cos(t), rng.uniform(0.3, 1.2)])
    lit = 0.25 + 0.75 * np.clip(normal @ (sun / np.linalg.norm(sun)), 0.0, 1.0)
    snow_line = rng.uniform(-900, 900)
    spot = np.nan_to_num(spot)
    patch = 250.0 * np.sin(spot[..., 0] / 170.0) * np.sin(spot[..., 1] / 210.0)
    snowy = (spot[..., 2] + patch > snow_line)[..., None] & (normal[..., 2:] > 0.6)
    grain = 1.0 + 0.25 * np.sin(spot[..., 0] / 31.0 + np.sin(spot[..., 1] / 23.0))[..., None]
    ground = np.where(snowy, [0.85, 0.88, 0.92], np.array([0.16, 0.17, 0.10]) * grain) * lit[..., None]
    base = np.array([0.55, 0.68, 0.88]) * rng.uniform(0.7, 1.1) + rng.uniform(0, 0.25)
    clouds = (
        sum(
            cv2.resize(rng.normal(size=(n, 2 * n)), (width, height), interpolation=cv2.INTER_CUBIC) / n
            for n in (3, 6, 12)
        )
        * 0.5
    )
    up = np.linspace(0.85, 1.1, height)[::-1, None, None]
    sky = base * up + (rng.uniform(0.0, 0.5) * np.clip(clouds, 0, 1))[..., None]
    seen = np.where(np.isfinite(distance), distance, 1e9)
    # Koschmieder: 2 % of contrast is left at the visibility. In fog the sky itself is grey.
    through = np.exp(-3.912 * seen / visibility_m)[..., None]
    sky = sky.mean(axis=(0, 1)) + (sky - sky.mean(axis=(0, 1))) * min(1.0, visibility_m / 10e3)
    image = ground * through + sky.mean(axis=(0, 1)) * 0.97 * (1.0 - through)
    image = np.where(np.isfinite(distance)[..., None], image, sky)
    image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.7)
    encoded = np.clip(image, 0, 1) ** (1 / 2.2) * 255.0 + rng.normal(0, 1.5, image.shape)
    return np.clip(encoded, 0, 255).astype(np.uint8)


def _stand_before(image: np.ndarray, covered: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A dark roof that covers some columns up to the sky and the lowest rows; masked as its owner would."""
    height, width = image.shape[:2]
    mask = np.ones((height, width), bool)
    if covered <= 0.0:
        return image, mask
    left = int(rng.uniform(0, 1.0 - covered) * width)
    right = left + int(covered * width)
    roof = np.array([[left, height], [left, int(0.1 * height)], [right, int(0.2 * height)], [right, height]], np.int32)
    shape = cv2.fillPoly(np.zeros((height, width), np.uint8), [roof], 1) > 0
    image = image.copy()
    image[shape] = (35 + 12 * np.sin(np.arange(height) / 3.0))[:, None, None].repeat(width, 1).repeat(3, 2)[shape]
    mask &= ~(cv2.dilate(shape.astype(np.uint8), np.ones((9, 9), np.uint8)) > 0)
    return image, mask
