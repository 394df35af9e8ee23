"""Terrain rendered from a view for manual annotation: distance, normal and position per pixel, and shaded relief."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from seasonscapes.calibration.pose_model import View
from seasonscapes.calibration.terrain_horizon import terrain_profile
from seasonscapes.cameras.panorama import view_directions
from seasonscapes.frames import LocalFrame, geodetic_from_enu, local_axes
from seasonscapes.terrain.surface import Raster

_AZIMUTH_STEP_DEG, _SLOPE_STEP = 0.04, 0.0006


@dataclass(frozen=True)
class TerrainView:
    """First terrain surface along the ray of each pixel.

    Parameters
    ----------
    distance_m
        Distance ``(H, W)`` from the camera [m]; infinite in the sky.
    normal
        Upward unit normal ``(H, W, 3)``; zero in the sky.
    position_m
        Position ``(H, W, 3)``, east-north-up [m]; NaN in the sky.
    """

    distance_m: np.ndarray
    normal: np.ndarray
    position_m: np.ndarray


class _SurfaceHits(Protocol):
    """Result of a ray caster; `rendering.gbuffer.GBuffer` satisfies it."""

    @property
    def depth(self) -> np.ndarray: ...
    @property
    def normal(self) -> np.ndarray: ...
    @property
    def position(self) -> np.ndarray: ...


def scaled_view(view: View, width_px: int) -> View:
    """Return a view resampled to another image width.

    Parameters
    ----------
    view
        Camera or panorama.
    width_px
        New width [px].

    Returns
    -------
    Camera or Panorama
        The same pose and field of view; the height is scaled in proportion and rounded.
    """
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


def trace_terrain_view(view: View, trace: Callable[[np.ndarray, np.ndarray], _SurfaceHits]) -> TerrainView:
    """Compute a terrain view with a ray caster.

    Parameters
    ----------
    view
        Camera or panorama.
    trace
        Function of ray origins and unit directions, each ``(H, W, 3)``, that returns the first surfaces with the
        attributes ``depth``, ``normal`` and ``position`` (`rendering.gbuffer.trace_rays`).

    Returns
    -------
    TerrainView
        Distance, normal and position of each pixel.
    """
    direction = view_directions(view)
    hit = trace(np.broadcast_to(view.position_m, direction.shape), direction)
    normal = np.nan_to_num(np.asarray(hit.normal, float))
    return TerrainView(np.asarray(hit.depth, float), normal, np.asarray(hit.position, float))


def march_terrain_view(
    view: View, rasters: Sequence[Raster], frame: LocalFrame, *, nearest_m: float = 60.0, reach_m: float = 60e3
) -> TerrainView:
    """Compute a terrain view by marching over elevation rasters once per azimuth, without a renderer.

    The running maximum of the slope along an azimuth is sorted, so that the first step visible at the slope of a pixel
    is found by bisection. Azimuths are 0.04° apart; steps grow by 0.45 % of the distance.

    Parameters
    ----------
    view
        Camera or panorama.
    rasters
        Elevation rasters in order of precedence.
    frame
        Local frame of the view.
    nearest_m, reach_m
        Minimum and maximum distance [m].

    Returns
    -------
    TerrainView
        Distance, normal and position of each pixel.
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
    levels = np.arange(slope.min() - 0.002, slope.max() + 0.002, _SLOPE_STEP)
    column = np.clip((azimuth - rays[0]) / _AZIMUTH_STEP_DEG + 0.5, 1, len(rays) - 2).astype(int)
    level = np.clip((slope - levels[0]) / _SLOPE_STEP + 0.5, 0, len(levels) - 1).astype(int)
    distance, normal, surface = (
        np.full(slope.shape, np.inf),
        np.zeros((*slope.shape, 3)),
        np.full((*slope.shape, 3), np.nan),
    )
    # Blocks of azimuths overlap by one ray on each side, for the normals.
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
        upward = np.nan_to_num(np.cross(points[ray + 1, index] - points[ray - 1, index], along))
        upward /= np.maximum(np.linalg.norm(upward, axis=-1, keepdims=True), 1e-9)
        hit = points[ray, index]
        distance[inside] = np.where(sky, np.inf, np.linalg.norm(hit - position, axis=-1))
        surface[inside] = np.where(sky[:, None], np.nan, hit)
        normal[inside] = np.where(sky[:, None], 0.0, upward * np.where(upward[:, 2:] < 0, -1.0, 1.0))
    return TerrainView(np.where(np.isnan(distance), np.inf, distance), normal, surface)


def shaded_relief(terrain_view: TerrainView) -> np.ndarray:
    """Shade a terrain view for display: light from the north-west, distance as bluish haze, pale sky.

    Parameters
    ----------
    terrain_view
        Distance and normal of each pixel.

    Returns
    -------
    ndarray
        Image ``(H, W, 3)`` uint8 sRGB.
    """
    light = np.array([-0.5, 0.5, 0.7071])
    shade = 0.3 + 0.7 * np.clip(terrain_view.normal @ light, 0.0, 1.0)
    sky = ~np.isfinite(terrain_view.distance_m)
    haze = 1.0 - np.exp(-np.where(sky, 0.0, terrain_view.distance_m) / 25e3)
    ground = shade[..., None] * np.array([0.80, 0.78, 0.70])
    image = ground * (1.0 - haze[..., None]) + np.array([0.70, 0.78, 0.90]) * haze[..., None]
    image[sky] = [0.88, 0.93, 0.98]
    # Depth discontinuities are drawn as dark lines.
    edge = np.zeros(sky.shape, bool)
    depth = np.where(sky, 1e7, terrain_view.distance_m)
    edge[1:] = depth[:-1] > 1.2 * depth[1:]
    image[edge] *= 0.35
    return np.clip(np.sqrt(image) * 255.0, 0, 255).astype(np.uint8)
