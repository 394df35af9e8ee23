"""Whether places on the terrain and an eye see each other, and which faces an eye meets."""

from __future__ import annotations

import numpy as np

from seasonscapes.cameras.panorama import Panorama, view_directions
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.backend import point3
from seasonscapes.rendering.gbuffer import NEAR_M
from seasonscapes.rendering.hemisphere_rays import RayScene

LANES = 1 << 22
# Origins are lifted by this many units in the last place of their largest coordinate: 8 mm at 16 km. Less would meet the
# place's own face, more would look over the rim of a ridge.
_LIFT_ULP = 8.0


def clear_sight(
    terrain: RayScene, position_m: np.ndarray, normal: np.ndarray, eye_m: np.ndarray, *, lift_m: float | None = None
) -> np.ndarray:
    """Whether nothing stands between places on the terrain and an eye, ``(N,)`` bool.

    Parameters
    ----------
    position_m
        ``(N, 3)`` ENU on the surface [m].
    normal
        ``(N, 3)`` unit normals of their faces. Rays begin off the surface along these.
    eye_m
        ``(3,)``; the last half metre before it is not looked at, so that a mast's own ground does not hide the view.
    lift_m
        How far off [m]; left out, just beyond the rounding of float32.
    """
    position_m, normal = np.asarray(position_m, np.float32), np.asarray(normal, np.float32)
    clear = np.empty(len(position_m), bool)
    for start in range(0, len(clear), LANES):
        part = slice(start, start + LANES)
        clear[part] = _clear_block(terrain, position_m[part], normal[part], eye_m, lift_m)
    return clear


def _clear_block(
    terrain: RayScene, position_m: np.ndarray, normal: np.ndarray, eye_m: np.ndarray, lift_m: float | None
) -> np.ndarray:
    import drjit as dr
    import mitsuba as mi

    # Opaque: a literal would be compiled into the kernel, and every camera would wait for LLVM again.
    eye = mi.Point3f(*(dr.opaque(mi.Float, float(value)) for value in eye_m))
    place = mi.Point3f(point3(position_m))
    rounding = dr.max(dr.abs(place)) * dr.opaque(mi.Float, _LIFT_ULP * float(np.finfo(np.float32).eps))
    lift = dr.maximum(rounding, 1e-3) if lift_m is None else dr.opaque(mi.Float, float(lift_m))
    origin = place + mi.Vector3f(point3(normal)) * lift
    direction = eye - origin
    distance = dr.norm(direction)
    ray = mi.Ray3f(origin, direction / distance)
    ray.maxt = dr.maximum(distance - NEAR_M, 0.0)
    return ~np.array(terrain.mi_scene.ray_test(ray))


def faces_met(terrain: RayScene, camera: Camera | Panorama) -> np.ndarray:
    """Index ``(H, W)`` int64 of the face that each pixel centre's ray meets, −1 in the sky."""
    import mitsuba as mi

    direction = view_directions(camera).reshape(-1, 3).astype(np.float32)
    face = np.empty(len(direction), np.int64)
    for start in range(0, len(face), LANES):
        part = direction[start : start + LANES]
        origin = camera.position_m.astype(np.float32) + np.float32(NEAR_M) * part
        hit = terrain.mi_scene.ray_intersect_preliminary(mi.Ray3f(point3(origin), mi.Vector3f(point3(part))))
        face[start : start + LANES] = np.where(np.array(hit.is_valid()), np.array(hit.prim_index).astype(np.int64), -1)
    return face.reshape(camera.height_px, camera.width_px)
