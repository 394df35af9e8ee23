"""Synthetic trials of skyline alignment: images of a fractal massif from a known pose, with haze, clouds and foreground.

The elevation raster of a trial differs from the rendered terrain by random height errors, as elevation models do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from affine import Affine

from seasonscapes.calibration.pose_model import View, parameters_of_view, view_from_parameters
from seasonscapes.calibration.terrain_horizon import HorizonOptions, horizon_from, terrain_height
from seasonscapes.calibration.terrain_view import march_terrain_view
from seasonscapes.cameras.panorama import panorama_from_angles
from seasonscapes.cameras.pinhole import camera_at, rotation_from_angles
from seasonscapes.frames import LocalFrame
from seasonscapes.terrain.crs import geodetic_from_map
from seasonscapes.terrain.surface import Raster

_CRS, _EAST_M, _NORTH_M = "EPSG:25832", 420_000.0, 5_160_000.0
_CELL_M, _CELLS = 40.0, 640


@dataclass(frozen=True)
class PictureTrial:
    """Synthetic photograph with its ground truth, and the inputs of an alignment.

    Parameters
    ----------
    image
        Photograph ``(H, W, 3)`` uint8 sRGB.
    mask
        ``(H, W)`` bool, False on the foreground.
    sky
        ``(H, W)`` bool, True where the rendered terrain shows sky (foreground ignored).
    truth
        True view.
    start
        Approximate view, the start of an alignment.
    rasters
        Elevation rasters for the alignment.
    frame
        Local frame of the views.
    """

    image: np.ndarray
    mask: np.ndarray
    sky: np.ndarray
    truth: View
    start: View
    rasters: tuple[Raster, ...]
    frame: LocalFrame


def fractal_massif(rng: np.random.Generator) -> Raster:
    """Generate a fractal mountain range of 26 km by 26 km from octaves of ridged noise.

    Parameters
    ----------
    rng
        Random generator.

    Returns
    -------
    Raster
        Heights ``(640, 640, 1)`` [m] with cells of 40 m.
    """
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
    heading_error_deg: float | None = None,
    size_px: tuple[int, int] = (1280, 854),
) -> PictureTrial:
    """Generate one trial with a perspective camera.

    Parameters
    ----------
    rng
        Random generator.
    visibility_m
        Meteorological visibility [m]; log-uniform between 20 and 150 km if omitted. Fog with a visibility of some
        hundred metres hides the skyline.
    covered
        Fraction of the columns in which masked foreground rises above the skyline; uniform in [0, 0.35] if omitted.
    heading_error_deg
        Heading error of the start [deg]; uniform within ±10 if omitted.
    size_px
        Width and height of the image [px].

    Returns
    -------
    PictureTrial
        Image, ground truth and start.
    """
    raster = fractal_massif(rng)
    frame, viewpoint = _viewpoint(raster, rng)
    fov = rng.uniform(50, 75)
    heading, elevation = _open_heading(raster, frame, viewpoint[2], fov, rng)
    pitch = elevation - rng.uniform(0.0, 0.25) * fov * size_px[1] / size_px[0]
    truth = camera_at(
        frame,
        *viewpoint,
        heading_deg=heading,
        pitch_deg=pitch,
        roll_deg=rng.normal(0, 0.7),
        fov_deg=fov,
        size_px=size_px,
    )
    view = march_terrain_view(truth, [raster], frame, nearest_m=120.0, reach_m=40e3)
    distance, normal, offset = view.distance_m, view.normal, view.position_m - truth.position_m
    covered = rng.uniform(0.0, 0.35) if covered is None else covered
    if visibility_m is None:
        visibility_m = float(np.exp(rng.uniform(np.log(20e3), np.log(150e3))))
    image = _shade(distance, normal, offset, rng, visibility_m)
    image, mask = _add_roof(image, covered, rng)
    parameters = parameters_of_view(truth, np.eye(3))
    parameters[0] += rng.uniform(-10, 10) if heading_error_deg is None else heading_error_deg
    parameters[1:3] += [rng.normal(0, 1.0), -parameters[2]]
    parameters[3:6] += rng.normal(0, 1.0, 3) * [3.0, 3.0, 2.0]
    error = cv2.GaussianBlur(rng.normal(size=(_CELLS, _CELLS)).astype(np.float32), (0, 0), 1.5)
    measured = replace(raster, values=raster.values + (5.0 * error / error.std())[..., None])
    return PictureTrial(
        image, mask, np.isinf(distance), truth, view_from_parameters(truth, np.eye(3), parameters), (measured,), frame
    )


def panorama_trial(rng: np.random.Generator, *, size_px: tuple[int, int] = (3600, 420)) -> PictureTrial:
    """Generate one trial with a full-circle panorama; the start has errors in heading, axis tilt and horizon row.

    Parameters
    ----------
    rng
        Random generator.
    size_px
        Width and height of the image [px].

    Returns
    -------
    PictureTrial
        Image, ground truth and start; no foreground, and the raster is the rendered terrain.
    """
    raster = fractal_massif(rng)
    frame, viewpoint = _viewpoint(raster, rng)
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_angles(rng.uniform(0, 360), *rng.normal(0, 0.4, 2))
    pose[:3, 3] = [0.0, 0.0, viewpoint[2]]
    truth = panorama_from_angles(
        "cylindrical",
        size_px,
        horizontal_fov_deg=360.0,
        vertical_fov_deg=41.0,
        pose=pose,
        horizon_row_px=size_px[1] * rng.uniform(0.45, 0.55),
    )
    view = march_terrain_view(truth, [raster], frame, nearest_m=120.0, reach_m=40e3)
    image = _shade(view.distance_m, view.normal, view.position_m - truth.position_m, rng, 60e3)
    parameters = parameters_of_view(truth, np.eye(3))
    parameters[:3] = parameters[0] + rng.uniform(-10, 10), 0.0, 0.0
    parameters[8] = rng.uniform(-1.5, 1.5) * truth.fy * np.pi / 180.0
    mask = np.ones(image.shape[:2], bool)
    return PictureTrial(
        image,
        mask,
        np.isinf(view.distance_m),
        truth,
        view_from_parameters(truth, np.eye(3), parameters),
        (raster,),
        frame,
    )


def _viewpoint(raster: Raster, rng: np.random.Generator) -> tuple[LocalFrame, tuple[float, float, float]]:
    """Frame of a viewpoint near the centre and its latitude, longitude [deg] and height [m], 10 m above the ground.

    The ground height is the 85th percentile of random positions: high enough for a wide view, but not a summit.
    """
    middle = np.array([_EAST_M, _NORTH_M]) + 0.5 * _CELLS * _CELL_M
    candidates = middle + rng.uniform(-4000, 4000, (60, 2))
    latitude, longitude = geodetic_from_map(_CRS, candidates[:, 0], candidates[:, 1])
    height = terrain_height([raster], latitude, longitude)
    chosen = int(np.argsort(height)[int(0.85 * len(height))])
    frame = LocalFrame(float(latitude[chosen]), float(longitude[chosen]), 0.0, 0.13)
    return frame, (float(latitude[chosen]), float(longitude[chosen]), float(height[chosen]) + 10.0)


def _open_heading(
    raster: Raster, frame: LocalFrame, height_m: float, fov_deg: float, rng: np.random.Generator
) -> tuple[float, float]:
    """A heading with a wide view, as is typical of webcams, and the median elevation of its skyline [deg]."""
    position = np.array([0.0, 0.0, height_m])
    azimuth_deg, options = np.arange(0.0, 360.0, 1.0), HorizonOptions(nearest_m=120.0)
    horizon = horizon_from([raster], frame, position, azimuth_deg=azimuth_deg, options=options)
    elevation = np.nan_to_num(horizon.skyline_elevation_deg, nan=30.0)
    distance = np.linalg.norm(np.nan_to_num(horizon.skyline_m) - position, axis=1)
    half = int(fov_deg / 2)
    window = np.arange(-half, half + 1)
    # Azimuths whose skyline is nearer than 2 km or higher than 12°.
    obstructed = (distance < 2000.0) | (elevation > 12.0)
    fraction = np.array([obstructed[(a + window) % 360].mean() for a in range(360)])
    chosen = int(rng.choice(np.argsort(fraction)[:60]))
    return float(chosen), float(np.median(elevation[(chosen + window) % 360]))


def _shade(
    distance: np.ndarray, normal: np.ndarray, offset_m: np.ndarray, rng: np.random.Generator, visibility_m: float
) -> np.ndarray:
    """Image ``(H, W, 3)`` uint8 of sunlit rock, meadow and snow behind haze, with clouds, blur and noise.

    ``offset_m`` ``(H, W, 3)`` is the position of the surface relative to the camera.
    """
    height, width = distance.shape
    sun = np.array([np.sin(t := rng.uniform(0, 2 * np.pi)), np.cos(t), rng.uniform(0.3, 1.2)])
    shade = 0.25 + 0.75 * np.clip(normal @ (sun / np.linalg.norm(sun)), 0.0, 1.0)
    snow_line = rng.uniform(-900, 900)
    offset_m = np.nan_to_num(offset_m)
    patch = 250.0 * np.sin(offset_m[..., 0] / 170.0) * np.sin(offset_m[..., 1] / 210.0)
    snowy = (offset_m[..., 2] + patch > snow_line)[..., None] & (normal[..., 2:] > 0.6)
    grain = 1.0 + 0.25 * np.sin(offset_m[..., 0] / 31.0 + np.sin(offset_m[..., 1] / 23.0))[..., None]
    ground = np.where(snowy, [0.85, 0.88, 0.92], np.array([0.16, 0.17, 0.10]) * grain) * shade[..., None]
    base = np.array([0.55, 0.68, 0.88]) * rng.uniform(0.7, 1.1) + rng.uniform(0, 0.25)
    clouds = (
        sum(
            cv2.resize(rng.normal(size=(n, 2 * n)), (width, height), interpolation=cv2.INTER_CUBIC) / n
            for n in (3, 6, 12)
        )
        * 0.5
    )
    gradient = np.linspace(0.85, 1.1, height)[::-1, None, None]
    sky = base * gradient + (rng.uniform(0.0, 0.5) * np.clip(clouds, 0, 1))[..., None]
    path_m = np.where(np.isfinite(distance), distance, 1e9)
    # Koschmieder: the contrast decreases to 2 % at the visibility. In fog the sky itself is uniform.
    transmittance = np.exp(-3.912 * path_m / visibility_m)[..., None]
    sky = sky.mean(axis=(0, 1)) + (sky - sky.mean(axis=(0, 1))) * min(1.0, visibility_m / 10e3)
    image = ground * transmittance + sky.mean(axis=(0, 1)) * 0.97 * (1.0 - transmittance)
    image = np.where(np.isfinite(distance)[..., None], image, sky)
    image = cv2.GaussianBlur(image.astype(np.float32), (0, 0), 0.7)
    encoded = np.clip(image, 0, 1) ** (1 / 2.2) * 255.0 + rng.normal(0, 1.5, image.shape)
    return np.clip(encoded, 0, 255).astype(np.uint8)


def _add_roof(image: np.ndarray, covered: float, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Image with a dark roof that reaches above the skyline in a fraction of the columns, and the mask without it."""
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
