"""G-buffers: distance, position, normal and texture coordinate of the first surface along rays; rays of any camera."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.cameras.panorama import Panorama, view_directions
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.backend import point3, to_numpy, use_backend
from seasonscapes.rendering.mitsuba_scene import RenderScene

# Rays start this far in front of the camera, so that terrain right at a mast does not block the view.
NEAR_M = 0.5
# Rays in one kernel launch; bounds the memory.
LANES = 1 << 22


@dataclass(frozen=True)
class GBuffer:
    """First surfaces along rays; the arrays have the shape of the rays.

    Parameters
    ----------
    depth
        Distance from the camera along the ray [m], not along the optical axis; ``inf`` in the sky.
    uv
        ``(..., 2)`` texture coordinates, v upwards; NaN in the sky.
    normal
        ``(..., 3)`` unit geometric normals, ENU; NaN in the sky.
    position
        ``(..., 3)`` positions, ENU [m]; NaN in the sky.
    """

    depth: np.ndarray
    uv: np.ndarray
    normal: np.ndarray
    position: np.ndarray


def mi_rays(camera: Camera | Panorama, x: Any, y: Any) -> Any:
    """Create Mitsuba rays of a camera through pixel positions.

    Parameters
    ----------
    camera
        Any pinhole camera or panorama.
    x, y
        ``mi.Float`` lanes: pixel positions from the upper left corner of the image [px].

    Returns
    -------
    mi.Ray3f
        One ray per lane: unit direction, origin `NEAR_M` in front of the camera, no far limit.
    """
    import drjit as dr
    import mitsuba as mi

    # Opaque: literals would be compiled into the kernel, and every camera would need a compilation of its own.
    def opaque(value: float) -> Any:
        return dr.opaque(mi.Float, float(value))

    columns = [mi.Vector3f(*map(opaque, camera.world_from_camera[:3, axis])) for axis in range(3)]
    across, down = (x - opaque(camera.cx)) / opaque(camera.fx), (y - opaque(camera.cy)) / opaque(camera.fy)
    if isinstance(camera, Panorama):
        sine, cosine = dr.sincos(across)
        # Rows are linear in the tangent of elevation for a cylindrical projection, in elevation for a spherical one.
        vertical, horizontal = (down, mi.Float(1.0)) if camera.projection == "cylindrical" else dr.sincos(down)
        direction = dr.normalize((columns[0] * sine + columns[2] * cosine) * horizontal + columns[1] * vertical)
    else:
        direction = dr.normalize(columns[0] * across + columns[1] * down + columns[2])
    origin = mi.Point3f(*map(opaque, camera.position_m))
    return mi.Ray3f(origin + direction * NEAR_M, direction)


def trace_gbuffer(scene: RenderScene, camera: Camera | Panorama, pixel: np.ndarray | None = None) -> GBuffer:
    """Trace the G-buffer of a camera.

    Parameters
    ----------
    scene
        The scene.
    camera
        Any pinhole camera or panorama.
    pixel
        ``(..., 2)`` pixel positions (x, y) [px]; by default all pixel centres, ``(H, W)``.

    Returns
    -------
    GBuffer
        With arrays of the shape of ``pixel``.
    """
    direction = view_directions(camera, pixel)
    origin = np.broadcast_to(camera.position_m, direction.shape)
    return trace_rays(scene, origin, direction)


def trace_rays(scene: RenderScene, origin_m: np.ndarray, direction: np.ndarray) -> GBuffer:
    """Trace the G-buffer of arbitrary rays, in blocks of bounded memory.

    Parameters
    ----------
    scene
        The scene.
    origin_m
        ``(..., 3)`` origins, ENU [m]; rays start `NEAR_M` in front of them.
    direction
        ``(..., 3)`` unit directions, ENU.

    Returns
    -------
    GBuffer
        With arrays of the shape of the rays.
    """
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
    # Excludes the distant polygons that represent sun and moon.
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
        # The stubs describe the vectorised variants only.
        ray = mi.Ray3f(  # pyright: ignore[reportCallIssue]
            list(map(float, origins[i] + NEAR_M * directions[i])),  # pyright: ignore[reportArgumentType]
            list(map(float, directions[i])),  # pyright: ignore[reportArgumentType]
        )
        interaction = scene.mi_scene.ray_intersect(ray)
        if interaction.is_valid() and interaction.t < 1e9:
            distance[i] = interaction.t + NEAR_M
            uv[i], normal[i], position[i] = interaction.uv, interaction.n, interaction.p
    return distance, uv, normal, position


def occluded(scene: RenderScene, origin_m: np.ndarray, direction: np.ndarray) -> np.ndarray:
    """Test whether rays hit the terrain.

    Parameters
    ----------
    scene
        The scene.
    origin_m
        ``(N, 3)`` origins, ENU [m].
    direction
        ``(N, 3)`` unit directions, ENU.

    Returns
    -------
    numpy.ndarray
        ``(N,)`` bool.
    """
    use_backend(gradients=False)
    return np.isfinite(trace_rays(scene, origin_m, direction).depth)
