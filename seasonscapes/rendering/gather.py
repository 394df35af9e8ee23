"""Rays over the hemisphere of many points: which sky patch each one reaches, or which face it meets.

Points, normals and directions are lanes; one compiled kernel serves every block, view and seed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.rendering.backend import point3, use_backend
from seasonscapes.rendering.sky_patches import SkyPatches, mi_patch_of

# Rays in flight in one launch of the kernel.
LANES = 1 << 22
# Mitsuba's math::RayEpsilon in single precision.
RAY_EPSILON = float(np.finfo(np.float32).epsneg) * 1500.0


@dataclass(frozen=True)
class Occluder:
    """The terrain alone, without lights, for rays that ask what is in the way.

    ``mi_terrain`` carries the albedo, as in `RenderScene`.
    """

    mi_scene: Any
    mi_terrain: Any


@dataclass(frozen=True)
class Points:
    """Where rays begin and how surfaces lie there.

    Parameters
    ----------
    origin
        ``(N, 3)`` float32 ENU, lifted off the surface as Mitsuba's own rays are [m].
    normal
        ``(N, 3)`` float32 unit shading normals.
    albedo
        ``(N, 3)`` float32; zero where the surface turns its back.
    face
        ``(N,)`` uint32 index of the face.
    """

    origin: np.ndarray
    normal: np.ndarray
    albedo: np.ndarray
    face: np.ndarray

    def __getitem__(self, key: Any) -> Points:
        return Points(self.origin[key], self.normal[key], self.albedo[key], self.face[key])


def occluder(mi_terrain: Any) -> Occluder:
    """The terrain of a `RenderScene` without its lights (sun and moon are polygons there, and would block)."""
    if use_backend().device == "scalar":
        raise ValueError("daylight coefficients need a vectorised variant; install a libLLVM or use CUDA")
    import mitsuba as mi

    return Occluder(mi.load_dict({"type": "scene", "terrain": mi_terrain}), mi_terrain)


def mi_surface(interaction: Any, active: Any) -> tuple[Any, Any, Any, Any]:
    """Origin of rays that leave the surface's outer side, shading normal, albedo and face of hit lanes.

    The outer side is that of the geometric normal (terrain faces run counter-clockwise seen from above); seen from its
    back a surface is black, as Mitsuba's one-sided diffuse material is.
    """
    import drjit as dr
    import mitsuba as mi

    front = active & (dr.dot(interaction.sh_frame.n, interaction.to_world(interaction.wi)) > 0.0)
    front &= dr.dot(interaction.n, interaction.to_world(interaction.wi)) > 0.0
    albedo = dr.select(front, interaction.bsdf().eval_diffuse_reflectance(interaction, front), mi.Color3f(0.0))
    # Mitsuba's own distance (Interaction::offset_p), so that contact shadows are the path tracer's.
    lift = (1.0 + dr.max(dr.abs(interaction.p))) * RAY_EPSILON
    return interaction.p + interaction.n * lift, interaction.sh_frame.n, albedo, interaction.prim_index


def cosine_points(index: Any, scramble_u: Any, scramble_v: Any) -> Any:
    """Points of the unit square: the first two dimensions of Sobol's sequence, digits scrambled by exclusive or.

    Any aligned run of 2ᵏ of them is stratified in every way that k binary digits can be (Sobol 1967; Kollig & Keller
    2002, "Efficient multidimensional sampling", doi:10.1111/1467-8659.00706).
    """
    import drjit as dr
    import mitsuba as mi

    u = dr.brev(index)
    v = mi.UInt32(0)
    direction = 1 << 31
    for bit in range(16):
        v ^= dr.select((index & (1 << bit)) != 0, mi.UInt32(direction), mi.UInt32(0))
        direction ^= direction >> 1
    return unit_square(u ^ scramble_u, v ^ scramble_v)


def unit_square(u: Any, v: Any) -> Any:
    """``mi.Point2f`` in [0, 1)² from lanes of 32 random bits."""
    import drjit as dr
    import mitsuba as mi

    top = float(np.float32(1.0) - np.finfo(np.float32).epsneg)
    return mi.Point2f(*(dr.minimum(mi.Float(bits) * float(2.0**-32), top) for bits in (u, v)))


def gather(terrain: Occluder, patches: SkyPatches, origin: np.ndarray, normal: np.ndarray, *, rays: int,
           first: np.ndarray, scramble: np.ndarray, face_label: Any) -> np.ndarray:  # fmt: skip
    """Where cosine-distributed rays of N points end.

    Parameters
    ----------
    origin, normal
        ``(N, 3)`` float32.
    rays
        K, rays from each point; a power of two keeps their stratification.
    first
        ``(N,)`` uint32 number of each point's first ray in its sequence, a multiple of ``rays``.
    scramble
        ``(N,)`` uint32; points with the same number share one sequence.
    face_label
        ``mi.UInt32`` label of every face.

    Returns
    -------
    labels
        ``(N, K)`` int32: the patch where the ray leaves, or P + the label of the face that it meets from its front, or
        -1 where it meets a back side (from under the terrain's rim), which is black.
    """
    labels = np.empty((len(origin), rays), np.int32)
    step = max(1, LANES // rays)
    for start in range(0, len(origin), step):
        part = slice(start, start + step)
        labels[part] = _gather_block(terrain, patches, (origin[part], normal[part], first[part], scramble[part]),
                                     rays, face_label).reshape(-1, rays)  # fmt: skip
    return labels


def _gather_block(terrain: Occluder, patches: SkyPatches, block: tuple, rays: int, face_label: Any) -> np.ndarray:
    import drjit as dr
    import mitsuba as mi

    origins, normals, first, scramble = block
    count = len(origins)
    per_point = dr.opaque(mi.UInt32, rays)
    lane = dr.arange(mi.UInt32, count * rays)
    point = lane // per_point
    number = lane - point * per_point + dr.gather(mi.UInt32, mi.UInt32(first), point)
    scramble_u, scramble_v = mi.sample_tea_32(dr.gather(mi.UInt32, mi.UInt32(scramble), point), mi.UInt32(0x9E3779B9))
    frame = mi.Frame3f(dr.gather(mi.Normal3f, mi.Normal3f(point3(normals)), point))
    direction = frame.to_world(mi.warp.square_to_cosine_hemisphere(cosine_points(number, scramble_u, scramble_v)))
    ray = mi.Ray3f(dr.gather(mi.Point3f, point3(origins), point), direction)
    hit = terrain.mi_scene.ray_intersect_preliminary(ray)
    interaction = hit.compute_surface_interaction(ray, mi.RayFlags.Minimal)
    front = dr.dot(interaction.n, direction) < 0.0
    label = mi.Int32(dr.gather(mi.UInt32, face_label, hit.prim_index, hit.is_valid())) + patches.size
    label = dr.select(hit.is_valid(), dr.select(front, label, -1), mi.Int32(mi_patch_of(patches, direction)))
    dr.eval(label)
    return np.array(label)


def follow(terrain: Occluder, points: Points, seed: int) -> tuple[Points, np.ndarray]:
    """One cosine-distributed ray from each of N points: the surfaces met, and which points' rays met one ``(N,)``."""
    import drjit as dr
    import mitsuba as mi

    count = len(points.origin)
    square = unit_square(*mi.sample_tea_32(dr.arange(mi.UInt32, count), dr.opaque(mi.UInt32, seed)))
    frame = mi.Frame3f(mi.Normal3f(point3(points.normal)))
    direction = frame.to_world(mi.warp.square_to_cosine_hemisphere(square))
    interaction = terrain.mi_scene.ray_intersect(mi.Ray3f(point3(points.origin), direction))
    valid = interaction.is_valid()
    surface = mi_surface(interaction, valid)
    met = np.array(valid)
    return surface_points(surface)[met], met


def surface_points(surface: tuple[Any, Any, Any, Any]) -> Points:
    """Lanes of `mi_surface` as numpy."""
    import drjit as dr

    dr.eval(surface)
    origin, normal, albedo, face = (np.array(values) for values in surface)
    return Points(*(np.ascontiguousarray(values.T) for values in (origin, normal, albedo)), face)
