"""The terrain as a view would see it, for eyes and for picking: shaded relief, and the place behind every pixel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.calibration.pose_model import View
from seasonscapes.calibration.terrain_horizon import terrain_profile
from seasonscapes.cameras.panorama import view_directions
from seasonscapes.frames import LocalFrame, geodetic_from_enu, local_axes
from seasonscapes.terrain.surface import Raster

_AZIMUTH_STEP_DEG, _LEVEL_STEP = 0.04, 0.0006


@dataclass(frozen=True)
class TerrainView:
    """What a view sees of the terrain; arrays ``(H, W, …)``.

    Parameters
    ----------
    distance_m
        From the camera [m]; ``inf`` is sky.
    normal
        Unit, upwards; zero in the sky.
    position_m
        First surface along each pixel's ray, east-north-up [m]; NaN in the sky.
    """

    distance_m: np.ndarray
    normal: np.ndarray
    position_m: np.ndarray


def scaled_view(view: View, width_px: int) -> View:
    """The same view in fewer (or more) pixels."""
    scale = width_px / view.width_px
    return replace(
        view,
        width_px=width_px,
        height_px=max(1, round(view.height_px * scale)),
        fx=view.fx * scale,
        fy=view.fy * scale,
        cx=view.cx * scale,
        cy=view.cy * scale,
    )


def look_with(view: View, trace: Callable) -> TerrainView:
    """A view by any ray caster: ``trace(origins, directions)`` gives ``depth``, ``normal`` and ``position`` (a G-buffer)."""
    direction = view_directions(view)
    hit = trace(np.broadcast_to(view.position_m, direction.shape), direction)
    normal = np.nan_to_num(np.asarray(hit.normal, float))
    return TerrainView(np.asarray(hit.depth, float), normal, np.asarray(hit.position, float))


def look_at_rasters(
    view: View, rasters: Sequence[Raster], frame: LocalFrame, *, nearest_m: float = 60.0, reach_m: float = 60e3
) -> TerrainView:
    """A view by marching over elevation rasters, every azimuth once; no renderer is needed.

    Each azimuth's running horizon is a sorted list: the first step that rises to a pixel's elevation is what it sees.
    Azimuths are 0.04° apart and steps 0.45 % of the distance.
    """
    position = view.position_m
    latitude, longitude, _ = geodetic_from_enu(frame, position)
    axes = local_axes(frame, float(latitude), float(longitude))
    direction = view_directions(view) @ axes.T
    azimuth = np.degrees(np.arctan2(direction[..., 0], direction[..., 1]))
    middle = azimuth[azimuth.shape[0] // 2, azimuth.shape[1] // 2]
    azimuth = (azimuth - middle + 180.0) % 360.0 - 180.0
    with np.errstate(divide="ignore"):
        slope = np.clip(direction[..., 2] / np.hypot(direction[..., 0], direction[..., 1]), -3.0, 3.0)
    rays = np.arange(azimuth.min() - 0.1, azimuth.max() + 0.1, _AZIMUTH_STEP_DEG)
    steps = nearest_m * 1.0045 ** np.arange(int(np.log(reach_m / nearest_m) / np.log(1.0045)))
    levels = np.arange(slope.min() - 0.002, slope.max() + 0.002, _LEVEL_STEP)
    column = np.clip((azimuth - rays[0]) / _AZIMUTH_STEP_DEG + 0.5, 1, len(rays) - 2).astype(int)
    level = np.clip((slope - levels[0]) / _LEVEL_STEP + 0.5, 0, len(levels) - 1).astype(int)
    distance, normal, spot = (
        np.full(slope.shape, np.inf),
        np.zeros((*slope.shape, 3)),
        np.full((*slope.shape, 3), np.nan),
    )
    # In slices of azimuth that overlap by one ray on each side, for the normals.
    for begin in range(1, len(rays) - 1, 600):
        end = min(begin + 600, len(rays) - 1)
        points = terrain_profile(rasters, frame, position, rays[begin - 1 : end + 1] + middle, steps)
        local = (points - position) @ axes.T
        rise = np.nan_to_num(local[..., 2] / np.hypot(local[..., 0], local[..., 1]), nan=-np.inf)
        highest = np.maximum.accumulate(rise, axis=1)
        first = np.stack([np.searchsorted(row, levels) for row in highest])
        inside = (column >= begin) & (column < end)
        ray = column[inside] - begin + 1
        index = first[ray, level[inside]]
        sky = index >= len(steps)
        index = np.minimum(index, len(steps) - 1)
        along = points[ray, np.minimum(index + 1, len(steps) - 1)] - points[ray, np.maximum(index - 1, 0)]
        upright = np.nan_to_num(np.cross(points[ray + 1, index] - points[ray - 1, index], along))
        upright /= np.maximum(np.linalg.norm(upright, axis=-1, keepdims=True), 1e-9)
        found = points[ray, index]
        distance[inside] = np.where(sky, np.inf, np.linalg.norm(found - position, axis=-1))
        spot[inside] = np.where(sky[:, None], np.nan, found)
        normal[inside] = np.where(sky[:, None], 0.0, upright * np.where(upright[:, 2:] < 0, -1.0, 1.0))
    return TerrainView(np.where(np.isnan(distance), np.inf, distance), normal, spot)


def shaded_relief(seen: TerrainView) -> np.ndarray:
    """A picture ``(H, W, 3)`` uint8 for people: light from the upper left of a map, distance as blue air, pale sky."""
    light = np.array([-0.5, 0.5, 0.7071])
    lit = 0.3 + 0.7 * np.clip(seen.normal @ light, 0.0, 1.0)
    sky = ~np.isfinite(seen.distance_m)
    air = 1.0 - np.exp(-np.where(sky, 0.0, seen.distance_m) / 25e3)
    ground = lit[..., None] * np.array([0.80, 0.78, 0.70])
    picture = ground * (1.0 - air[..., None]) + np.array([0.70, 0.78, 0.90]) * air[..., None]
    picture[sky] = [0.88, 0.93, 0.98]
    # A far edge behind a near one is drawn dark, as a cartographer would.
    edge = np.zeros(sky.shape, bool)
    depth = np.where(sky, 1e7, seen.distance_m)
    edge[1:] = depth[:-1] > 1.2 * depth[1:]
    picture[edge] *= 0.35
    return np.clip(np.sqrt(picture) * 255.0, 0, 255).astype(np.uint8)
