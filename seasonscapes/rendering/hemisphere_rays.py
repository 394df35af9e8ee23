"""Rays over the hemisphere of many points: which sky patch each one reaches, or which face it meets.

Points, normals and directions are lanes; one compiled kernel serves every block, view and seed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.rendering.backend import point3, use_backend
from seasonscapes.rendering.sky_patches import SkyPatches, mi_patch_of
from seasonscapes.rendering.sobol import hashed, sobol_pair, uniform

# Rays in flight in one launch of the kernel.
LANES = 1 << 22
# Mitsuba's math::RayEpsilon in single precision.
RAY_EPSILON = float(np.finfo(np.float32).epsneg) * 1500.0
# What a ray meets instead of a sender: nothing, or a surface that sends no light.
OPEN, BLACK = -1, -2
# Names of what random numbers are for, as words for their hashes.
_HEMISPHERE, _WALK = 101, 102


@dataclass(frozen=True)
class RayScene:
    """The terrain alone, without lights, for rays that ask what is in the way.

    ``mi_terrain`` carries the albedo, as in `RenderScene`.
    """

    mi_scene: Any
    mi_terrain: Any


@dataclass(frozen=True)
class SurfacePoints:
    """Places on a surface.

    Parameters
    ----------
    origin
        ``(..., 3)`` float32 ENU, lifted off the surface's outer side as Mitsuba lifts its rays [m].
    normal
        ``(..., 3)`` float32 unit shading normals.
    outward
        ``(..., 3)`` float32 unit geometric normals.
    albedo
        ``(..., 3)`` float32; zero where the surface was met from its back.
    uv
        ``(..., 2)`` float32 texture coordinates, v upwards.
    """

    origin: np.ndarray
    normal: np.ndarray
    outward: np.ndarray
    albedo: np.ndarray
    uv: np.ndarray

    def __getitem__(self, key: Any) -> SurfacePoints:
        return SurfacePoints(*(getattr(self, name)[key] for name in self.__dataclass_fields__))

    def reshape(self, *shape: int) -> SurfacePoints:
        """The same points with leading axes ``shape``."""
        columns = (getattr(self, name) for name in self.__dataclass_fields__)
        return SurfacePoints(*(values.reshape(*shape, values.shape[-1]) for values in columns))


def concatenate_points(parts: list[SurfacePoints]) -> SurfacePoints:
    """All points of several sets, one after the other."""
    columns = ([getattr(part, name) for part in parts] for name in SurfacePoints.__dataclass_fields__)
    return SurfacePoints(*(np.concatenate(column) for column in columns))


def ray_scene(mi_terrain: Any) -> RayScene:
    """The terrain of a `RenderScene` without its lights (sun and moon are polygons there, and would block).

    Raises
    ------
    ValueError
        On the scalar variant, which has no lanes.
    """
    if use_backend().device == "scalar":
        raise ValueError("daylight coefficients need a vectorised variant; install a libLLVM or use CUDA")
    import mitsuba as mi

    return RayScene(mi.load_dict({"type": "scene", "terrain": mi_terrain}), mi_terrain)


def front_side(interaction: Any, active: Any) -> Any:
    """Lanes of an intersection that meet a surface from its front, by both its normals."""
    import drjit as dr

    towards = interaction.to_world(interaction.wi)
    return active & (dr.dot(interaction.sh_frame.n, towards) > 0.0) & (dr.dot(interaction.n, towards) > 0.0)


def surface_points(interaction: Any, active: Any) -> SurfacePoints:
    """The surfaces that lanes of an intersection met.

    The outer side is that of the geometric normal (terrain faces run counter-clockwise seen from above); seen from its
    back a surface is black, as Mitsuba's one-sided diffuse material is.
    """
    import drjit as dr
    import mitsuba as mi

    front = front_side(interaction, active)
    albedo = dr.select(front, interaction.bsdf().eval_diffuse_reflectance(interaction, front), mi.Color3f(0.0))
    # Mitsuba's own distance (Interaction::offset_p), so that contact shadows are the path tracer's.
    lift = (1.0 + dr.max(dr.abs(interaction.p))) * RAY_EPSILON
    lanes = (interaction.p + interaction.n * lift, interaction.sh_frame.n, interaction.n, albedo, interaction.uv)
    dr.eval(lanes)
    points = SurfacePoints(*(np.ascontiguousarray(np.array(values).T) for values in lanes))
    points.uv[:, 1] = 1.0 - points.uv[:, 1]
    return points


def texture_at(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Bilinear look-up ``(N, 3)`` of a texture ``(R, S, 3)`` at ``uv (N, 2)``, as the renderer's own texture does it."""
    import mitsuba as mi

    use_backend()
    bitmap = mi.Texture2f(mi.TensorXf(np.ascontiguousarray(texture, np.float32)), wrap_mode=dr_clamp())
    return np.array(bitmap.eval(mi.Point2f(uv[:, 0], 1.0 - uv[:, 1]))).T


def dr_clamp() -> Any:
    """Dr.Jit's name for extending a texture by its rim."""
    import drjit as dr

    return dr.WrapMode.Clamp


def gather_hemisphere(
    terrain: RayScene,
    patches: SkyPatches,
    points: SurfacePoints,
    *,
    rays: int,
    first: np.ndarray,
    scramble: np.ndarray,
    mi_label: Any,
) -> tuple[np.ndarray, np.ndarray]:
    """Where cosine-distributed rays of N points go.

    Parameters
    ----------
    points
        N of them.
    rays
        K, rays from each point. An aligned run of 2ᵏ points of a Sobol sequence is stratified in every way that k
        binary digits can be.
    first
        ``(N,)`` uint32 number of each point's first ray in its sequence, a multiple of ``rays``.
    scramble
        ``(N,)`` uint32; points with the same number share one sequence.
    mi_label
        ``mi.UInt32`` sender of every face.

    Returns
    -------
    patch
        ``(N, K)`` int32 patch of sky in whose direction the ray goes, whether it gets there or not.
    met
        ``(N, K)`` int32 sender that it meets; `OPEN` where it gets to the sky; `BLACK` where it goes into
        its own surface or meets a back side (from under the terrain's rim).
    """
    patch, met = (np.empty((len(points.origin), rays), np.int32) for _ in range(2))
    step = max(1, LANES // rays)
    for start in range(0, len(patch), step):
        part = slice(start, start + step)
        keys = (first[part], scramble[part], mi_label)
        patch[part], met[part] = _gather_block(terrain, patches, points[part], rays, keys)
    return patch, met


def _gather_block(
    terrain: RayScene, patches: SkyPatches, points: SurfacePoints, rays: int, keys: tuple
) -> tuple[np.ndarray, np.ndarray]:
    import drjit as dr
    import mitsuba as mi

    first, scramble, mi_label = keys
    count = len(points.origin)
    per_point = dr.opaque(mi.UInt32, rays)
    lane = dr.arange(mi.UInt32, count * rays)
    point = lane // per_point
    number = lane - point * per_point + dr.gather(mi.UInt32, mi.UInt32(first), point)
    key = hashed(dr.gather(mi.UInt32, mi.UInt32(scramble), point), _HEMISPHERE)
    frame = mi.Frame3f(dr.gather(mi.Normal3f, mi.Normal3f(point3(points.normal)), point))
    direction = frame.to_world(mi.warp.square_to_cosine_hemisphere(sobol_pair(key, number)))
    # Interpolated normals let some rays point into the facet; a path tracer finds those black.
    outside = dr.dot(direction, dr.gather(mi.Normal3f, mi.Normal3f(point3(points.outward)), point)) > 0.0
    ray = mi.Ray3f(dr.gather(mi.Point3f, point3(points.origin), point), direction)
    hit = terrain.mi_scene.ray_intersect_preliminary(ray, active=outside)
    interaction = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal, outside)
    front = dr.dot(interaction.n, direction) < 0.0
    label = mi.Int32(dr.gather(mi.UInt32, mi_label, hit.prim_index, hit.is_valid()))
    met = dr.select(hit.is_valid(), dr.select(front, label, BLACK), OPEN)
    met = dr.select(outside, met, BLACK)
    patch = mi.Int32(mi_patch_of(patches, direction))
    dr.eval(patch, met)
    return np.array(patch).reshape(count, rays), np.array(met).reshape(count, rays)


def follow_one_ray(terrain: RayScene, points: SurfacePoints, seed: int) -> tuple[SurfacePoints, np.ndarray, np.ndarray]:
    """One cosine-distributed ray from each of N points.

    Returns
    -------
    points, face
        The K surfaces met, and their faces ``(K,)`` uint32.
    met
        ``(N,)`` bool: which rays met one.
    """
    import drjit as dr
    import mitsuba as mi

    key = hashed(hashed(dr.arange(mi.UInt32, len(points.origin)), dr.opaque(mi.UInt32, seed)), _WALK)
    square = mi.Point2f(uniform(hashed(key, 0)), uniform(hashed(key, 1)))
    direction = mi.Frame3f(mi.Normal3f(point3(points.normal))).to_world(mi.warp.square_to_cosine_hemisphere(square))
    outside = dr.dot(direction, mi.Normal3f(point3(points.outward))) > 0.0
    interaction = terrain.mi_scene.ray_intersect(mi.Ray3f(point3(points.origin), direction), active=outside)
    valid = interaction.is_valid() & (dr.dot(interaction.n, direction) < 0.0)
    met = np.array(valid)
    return surface_points(interaction, valid)[met], np.array(interaction.prim_index)[met], met
