"""Visibility between points on the terrain and a camera position, and the faces that are visible in a view."""

from __future__ import annotations

from typing import Any

import numpy as np

from seasonscapes.cameras.panorama import Panorama, view_directions
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.backend import point3
from seasonscapes.rendering.gbuffer import NEAR_M
from seasonscapes.rendering.hemisphere_rays import RayScene

# Rays in one kernel launch; bounds the memory.
LANES = 1 << 22
# Offset of ray origins in units in the last place of their largest coordinate: 8 mm at 16 km. With less, rays would hit
# the face they start from; with more, they would pass over the edge of a ridge.
_OFFSET_ULP = 8.0


def line_of_sight(
    terrain: RayScene,
    position_m: np.ndarray,
    normal: np.ndarray,
    camera_m: np.ndarray,
    *,
    offset_m: float | None = None,
) -> np.ndarray:
    """Test whether the line of sight between points on the terrain and a camera position is unobstructed.

    Parameters
    ----------
    terrain
        The occluding terrain.
    position_m
        ``(N, 3)`` points on the surface, ENU [m].
    normal
        ``(N, 3)`` unit normals of their faces, along which the ray origins are offset.
    camera_m
        ``(3,)`` camera position, ENU [m]; the last half metre before it is ignored, so that terrain right at a mast
        does not block the view.
    offset_m
        Offset of the ray origins [m]; by default just above the rounding error of float32.

    Returns
    -------
    numpy.ndarray
        ``(N,)`` bool.
    """
    position_m, normal = np.asarray(position_m, np.float32), np.asarray(normal, np.float32)
    unobstructed = np.empty(len(position_m), bool)
    for start in range(0, len(unobstructed), LANES):
        part = slice(start, start + LANES)
        unobstructed[part] = _unobstructed(terrain, position_m[part], normal[part], camera_m, offset_m)
    return unobstructed


def _unobstructed(
    terrain: RayScene, position_m: np.ndarray, normal: np.ndarray, camera_m: np.ndarray, offset_m: float | None
) -> np.ndarray:
    import drjit as dr
    import mitsuba as mi

    # Opaque: literals would be compiled into the kernel, and every camera would need a compilation of its own.
    camera = mi.Point3f(*(dr.opaque(mi.Float, float(value)) for value in camera_m))
    surface = mi.Point3f(point3(position_m))
    rounding = dr.max(dr.abs(surface)) * dr.opaque(mi.Float, _OFFSET_ULP * float(np.finfo(np.float32).eps))
    offset: Any = dr.maximum(rounding, 1e-3) if offset_m is None else dr.opaque(mi.Float, float(offset_m))
    origin = surface + mi.Vector3f(point3(normal)) * offset
    direction = camera - origin
    distance = dr.norm(direction)
    ray = mi.Ray3f(origin, direction / distance)
    ray.maxt = dr.maximum(distance - NEAR_M, 0.0)
    return ~np.array(terrain.mi_scene.ray_test(ray))


def visible_faces(terrain: RayScene, camera: Camera | Panorama) -> np.ndarray:
    """Find the face that is visible at each pixel centre.

    Parameters
    ----------
    terrain
        The terrain.
    camera
        The view.

    Returns
    -------
    numpy.ndarray
        ``(H, W)`` int64 face indices, −1 in the sky.
    """
    import drjit as dr
    import mitsuba as mi

    direction = view_directions(camera).reshape(-1, 3).astype(np.float32)
    face = np.empty(len(direction), np.int64)
    for start in range(0, len(face), LANES):
        part = direction[start : start + LANES]
        origin = camera.position_m.astype(np.float32) + np.float32(NEAR_M) * part
        hit = terrain.mi_scene.ray_intersect_preliminary(mi.Ray3f(point3(origin), mi.Vector3f(point3(part))))
        # Evaluated together: each by itself would trace all rays again.
        valid = hit.is_valid()
        dr.eval(valid, hit.prim_index)
        face[start : start + LANES] = np.where(np.array(valid), np.array(hit.prim_index).astype(np.int64), -1)
    return face.reshape(camera.height_px, camera.width_px)
