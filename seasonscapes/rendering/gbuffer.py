"""What each pixel sees: distance, place, normal, texture coordinate. And rays for any camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.cameras.panorama import Panorama, view_directions
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.backend import point3, to_numpy, use_backend
from seasonscapes.rendering.mitsuba_scene import RenderScene

# Rays begin this far in front of the camera, so that a mast's own ground does not hide the view.
NEAR_M = 0.5
LANES = 1 << 22


@dataclass(frozen=True)
class GBuffer:
    """First surfaces along rays; arrays have the shape of the rays.

    Parameters
    ----------
    depth
        Distance from the camera along the ray [m]; ``inf`` is sky. (Not the depth along the optical axis.)
    uv
        Texture coordinates ``(..., 2)``, v upwards; NaN in the sky.
    normal
        Unit geometric normals ``(..., 3)`` ENU; NaN in the sky.
    position
        ``(..., 3)`` ENU [m]; NaN in the sky.
    """

    depth: np.ndarray
    uv: np.ndarray
    normal: np.ndarray
    position: np.ndarray


def mi_rays(camera: Camera | Panorama, x: Any, y: Any) -> Any:
    """Mitsuba rays through pixel positions (lanes ``x``, ``y`` in pixels), normalised, with no far limit."""
    import drjit as dr
    import mitsuba as mi

    # Opaque: a literal would be compiled into the kernel, and every camera would wait for LLVM again.
    def opaque(value: float) -> Any:
        return dr.opaque(mi.Float, float(value))

    columns = [mi.Vector3f(*map(opaque, camera.world_from_camera[:3, axis])) for axis in range(3)]
    across, down = (x - opaque(camera.cx)) / opaque(camera.fx), (y - opaque(camera.cy)) / opaque(camera.fy)
    if isinstance(camera, Panorama):
        sine, cosine = dr.sincos(across)
        # On a cylinder rows are linear in the tangent of elevation, on a sphere in elevation itself.
        sink, level = (down, mi.Float(1.0)) if camera.projection == "cylindrical" else dr.sincos(down)
        direction = dr.normalize((columns[0] * sine + columns[2] * cosine) * level + columns[1] * sink)
    else:
        direction = dr.normalize(columns[0] * across + columns[1] * down + columns[2])
    origin = mi.Point3f(*map(opaque, camera.position_m))
    return mi.Ray3f(origin + direction * NEAR_M, direction)


def trace_gbuffer(scene: RenderScene, camera: Camera | Panorama, pixel: np.ndarray | None = None) -> GBuffer:
    """The G-buffer at pixel positions ``(..., 2)`` (x, y); at all pixel centres, ``(H, W)``, when left out."""
    direction = view_directions(camera, pixel)
    origin = np.broadcast_to(camera.position_m, direction.shape)
    return trace_rays(scene, origin, direction)


def trace_rays(scene: RenderScene, origin_m: np.ndarray, direction: np.ndarray) -> GBuffer:
    """The G-buffer of any rays: origins and unit directions ``(..., 3)`` ENU. Works through blocks of bounded memory."""
    backend = use_backend()
    shape = direction.shape[:-1]
    origins, directions = np.reshape(origin_m, (-1, 3)), np.reshape(direction, (-1, 3))
    trace = _trace_scalar if backend.device == "scalar" else _trace_lanes
    parts = [trace(scene, origins[i : i + LANES], directions[i : i + LANES]) for i in range(0, len(directions), LANES)]
    distance, uv, normal, position = (np.concatenate(column) for column in zip(*parts, strict=True))
    sky = ~np.isfinite(distance)
    for values in (uv, normal, position):
        values[sky] = np.nan
    uv[:, 1] = 1.0 - uv[:, 1]
    return GBuffer(
        distance.reshape(shape), uv.reshape(*shape, 2), normal.reshape(*shape, 3), position.reshape(*shape, 3)
    )


def _trace_lanes(scene: RenderScene, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
    import drjit as dr
    import mitsuba as mi

    ray = mi.Ray3f(point3(origins + NEAR_M * directions), mi.Vector3f(point3(directions)))
    interaction = scene.mi_scene.ray_intersect(ray)
    # The far polygons of sun and moon are no surface.
    hit = interaction.is_valid() & (interaction.t < 1e9)
    distance = dr.select(hit, interaction.t + NEAR_M, dr.inf)
    dr.eval(distance, interaction.uv, interaction.n, interaction.p)
    return (to_numpy(distance), *(to_numpy(values) for values in (interaction.uv, interaction.n, interaction.p)))


def _trace_scalar(scene: RenderScene, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
    import mitsuba as mi

    count = len(directions)
    distance, uv = np.full(count, np.inf, np.float32), np.zeros((count, 2), np.float32)
    normal, position = np.zeros((count, 3), np.float32), np.zeros((count, 3), np.float32)
    for i in range(count):
        ray = mi.Ray3f(list(map(float, origins[i] + NEAR_M * directions[i])), list(map(float, directions[i])))
        interaction = scene.mi_scene.ray_intersect(ray)
        if interaction.is_valid() and interaction.t < 1e9:
            distance[i] = interaction.t + NEAR_M
            uv[i], normal[i], position[i] = interaction.uv, interaction.n, interaction.p
    return distance, uv, normal, position


def occluded(scene: RenderScene, origin_m: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Whether rays from origins towards unit directions (both ``(N, 3)`` ENU) meet the terrain, ``(N,)`` bool."""
    use_backend(gradients=False)
    return np.isfinite(trace_rays(scene, origin_m, direction).depth)
