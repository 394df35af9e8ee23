"""Cosine-distributed hemisphere rays of many surface points: the sky patch or the cluster of faces that each ray hits.

Points, normals and directions are lanes; one compiled kernel serves all blocks, views and seeds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from seasonscapes.rendering.backend import aligned, point3, to_numpy, use_backend
from seasonscapes.rendering.sky_patches import SkyPatches, mi_patch_of
from seasonscapes.rendering.sobol import hashed, sobol_pair, uniform
from seasonscapes.rendering.terrain_material import diffuse_normal, leaving_points

# Rays in one kernel launch; bounds the memory.
LANES = 1 << 22
# Labels of rays that hit no cluster: the ray reaches the sky, or a surface that reflects no light.
ESCAPED, ABSORBED = -1, -2
# Keys of the random number streams, mixed into their hashes.
_HEMISPHERE, _BOUNCE = 101, 102


@dataclass(frozen=True)
class RayScene:
    """The terrain without lights, for visibility rays.

    Parameters
    ----------
    mi_scene
        Mitsuba scene of the terrain alone.
    mi_terrain
        Mesh and material (albedo), as in `RenderScene`.
    """

    mi_scene: Any
    mi_terrain: Any


@dataclass(frozen=True)
class SurfacePoints:
    """Points on a surface.

    Parameters
    ----------
    origin
        ``(..., 3)`` float32 positions, ENU [m], off the surface; see `terrain_material.leaving_points`.
    normal
        ``(..., 3)`` float32 unit shading normals.
    geometric_normal
        ``(..., 3)`` float32 unit normals of the surface at ``origin``: rays on its other side enter the surface.
    albedo
        ``(..., 3)`` float32; zero where the surface was hit from its back.
    uv
        ``(..., 2)`` float32 texture coordinates, v upwards.
    """

    origin: np.ndarray
    normal: np.ndarray
    geometric_normal: np.ndarray
    albedo: np.ndarray
    uv: np.ndarray

    def __getitem__(self, key: Any) -> SurfacePoints:
        return SurfacePoints(*(getattr(self, name)[key] for name in self.__dataclass_fields__))

    def reshape(self, *shape: int) -> SurfacePoints:
        """Return the points with leading axes ``shape``."""
        columns = (getattr(self, name) for name in self.__dataclass_fields__)
        return SurfacePoints(*(values.reshape(*shape, values.shape[-1]) for values in columns))


def concatenate_points(parts: list[SurfacePoints]) -> SurfacePoints:
    """Concatenate sets of points along their first axis.

    Parameters
    ----------
    parts
        Sets of points with equal trailing axes; at least one.

    Returns
    -------
    SurfacePoints
        All points.
    """
    columns = ([getattr(part, name) for part in parts] for name in SurfacePoints.__dataclass_fields__)
    return SurfacePoints(*(np.concatenate(column) for column in columns))


def ray_scene(mi_terrain: Any) -> RayScene:
    """Create a scene of the terrain without lights; the polygons of sun and moon in a `RenderScene` would occlude rays.

    Parameters
    ----------
    mi_terrain
        Mesh with material, from `mitsuba_scene.mi_mesh`.

    Returns
    -------
    RayScene
        The terrain for visibility rays.

    Raises
    ------
    ValueError
        On the scalar variant.
    """
    if use_backend().device == "scalar":
        raise ValueError("daylight coefficients need a vectorised variant; install a libLLVM or use CUDA")
    import mitsuba as mi

    return RayScene(mi.load_dict({"type": "scene", "terrain": mi_terrain}), mi_terrain)


def front_side(interaction: Any, active: Any) -> Any:
    """Return a mask of the lanes that hit the front of a facet.

    The shading normal does not matter: near silhouettes it may face away from the viewer on facets that are visible.

    Parameters
    ----------
    interaction
        ``mi.SurfaceInteraction3f``.
    active
        ``mi.Bool``: lanes that hit a surface.

    Returns
    -------
    mi.Bool
        Subset of ``active``.
    """
    import drjit as dr

    return active & (dr.dot(interaction.n, interaction.to_world(interaction.wi)) > 0.0)


def surface_points(terrain: RayScene, interaction: Any, active: Any) -> SurfacePoints:
    """Copy the surface points of an intersection from the device.

    The front is the side of the geometric normal (terrain faces are counter-clockwise from above). The back of a
    surface is black, as with Mitsuba's one-sided diffuse material.

    Parameters
    ----------
    terrain
        The terrain.
    interaction
        ``mi.SurfaceInteraction3f`` of N lanes.
    active
        ``mi.Bool``: lanes that hit a surface.

    Returns
    -------
    SurfacePoints
        N points; undefined where not ``active``.
    """
    import drjit as dr
    import mitsuba as mi

    front = front_side(interaction, active)
    material = terrain.mi_terrain.bsdf()
    albedo = dr.select(front, material.eval_diffuse_reflectance(interaction, front), mi.Color3f(0.0))
    origin, outward, normal = leaving_points(material, interaction, active)
    lanes = (origin, normal, outward, albedo, interaction.uv)
    dr.eval(lanes)
    points = SurfacePoints(*map(to_numpy, lanes))
    points.uv[:, 1] = 1.0 - points.uv[:, 1]
    return points


def diffuse_points(terrain: RayScene, points: SurfacePoints) -> SurfacePoints:
    """Points with the normals that diffuse light has in place of those for shading; see `diffuse_normal`."""
    material = terrain.mi_terrain.bsdf()
    return replace(points, normal=diffuse_normal(material, points.geometric_normal, points.normal))


def albedo_at(terrain: RayScene, uv: np.ndarray, position_m: np.ndarray | None = None) -> np.ndarray:
    """Look up the terrain's current reflectance for diffuse light.

    Parameters
    ----------
    terrain
        The terrain.
    uv
        ``(..., 2)`` texture coordinates, v upwards.
    position_m
        ``(..., 3)`` positions [m], which detail of the albedo depends on.

    Returns
    -------
    numpy.ndarray
        ``(..., 3)`` float32.
    """
    import drjit as dr
    import mitsuba as mi

    interaction = dr.zeros(mi.SurfaceInteraction3f)
    u, v = (mi.Float(aligned(uv[..., k].ravel())) for k in range(2))
    interaction.uv = mi.Point2f(u, 1.0 - v)
    if position_m is not None:
        interaction.p = mi.Point3f(point3(np.asarray(position_m).reshape(-1, 3)))
    values = to_numpy(terrain.mi_terrain.bsdf().eval_diffuse_reflectance(interaction, True))
    # A uniform albedo is a single value.
    return np.broadcast_to(values, (u.shape[0], 3)).reshape(*uv.shape[:-1], 3)


def texture_at(texture: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Look up a texture bilinearly, with the filter of the renderer's own textures.

    Parameters
    ----------
    texture
        ``(R, S, 3)``, row 0 at v = 1.
    uv
        ``(N, 2)`` texture coordinates, v upwards.

    Returns
    -------
    numpy.ndarray
        ``(N, 3)`` float32.
    """
    import mitsuba as mi

    use_backend()
    import drjit as dr

    # The stub of Dr.Jit gives the texture types as `object`.
    bitmap: Any = mi.Texture2f(  # pyright: ignore[reportCallIssue]
        mi.TensorXf(aligned(texture)), wrap_mode=dr.WrapMode.Clamp
    )
    return to_numpy(bitmap.eval(mi.Point2f(aligned(uv[:, 0]), aligned(1.0 - uv[:, 1]))))


def gather_hemisphere(
    terrain: RayScene,
    patches: SkyPatches,
    points: SurfacePoints,
    *,
    rays: int,
    first: np.ndarray,
    scramble: np.ndarray,
    mi_face_cluster: Any,
) -> tuple[np.ndarray, np.ndarray]:
    """Trace cosine-distributed rays of surface points and return the direction and the hit of each ray.

    Parameters
    ----------
    terrain
        The terrain.
    patches
        Subdivision of the sphere of directions.
    points
        N surface points.
    rays
        Number K of rays per point, a power of two: aligned runs of 2ᵏ points of a Sobol sequence are stratified over
        all elementary intervals of their size.
    first
        ``(N,)`` uint32 index of each point's first ray in its Sobol sequence, a multiple of ``rays``.
    scramble
        ``(N,)`` uint32 key of each point's sequence; points with equal keys share one sequence.
    mi_face_cluster
        ``mi.UInt32`` cluster of each face.

    Returns
    -------
    patch
        ``(N, K)`` int32 sky patch in the direction of each ray, whether the ray is occluded or not.
    hit
        ``(N, K)`` int32 cluster that each ray hits; `ESCAPED` if it reaches the sky; `ABSORBED` if it enters its own
        surface or hits the back of a face (from below the terrain's border).
    """
    points = diffuse_points(terrain, points)
    patch, hit = (np.empty((len(points.origin), rays), np.int32) for _ in range(2))
    step = max(1, LANES // rays)
    for start in range(0, len(patch), step):
        part = slice(start, start + step)
        patch[part], hit[part] = _gather_block(
            terrain, patches, points[part], rays, first[part], scramble[part], mi_face_cluster
        )
    return patch, hit


def _gather_block(
    terrain: RayScene,
    patches: SkyPatches,
    points: SurfacePoints,
    rays: int,
    first: np.ndarray,
    scramble: np.ndarray,
    mi_face_cluster: Any,
) -> tuple[np.ndarray, np.ndarray]:
    import drjit as dr
    import mitsuba as mi

    count = len(points.origin)
    per_point = dr.opaque(mi.UInt32, rays)
    lane = dr.arange(mi.UInt32, count * rays)
    point = lane // per_point
    index = lane - point * per_point + dr.gather(mi.UInt32, mi.UInt32(aligned(first, np.uint32)), point)
    key = hashed(dr.gather(mi.UInt32, mi.UInt32(aligned(scramble, np.uint32)), point), _HEMISPHERE)
    mi_normal, mi_geometric_normal = (
        cast(Any, dr.gather(mi.Normal3f, mi.Normal3f(point3(normals)), point))  # the stubs reject normals as vectors
        for normals in (points.normal, points.geometric_normal)
    )
    direction = mi.Frame3f(mi_normal).to_world(mi.warp.square_to_cosine_hemisphere(sobol_pair(key, index)))
    # With interpolated normals some rays enter the facet; they are black, as in a path tracer.
    outside = dr.dot(direction, mi_geometric_normal) > 0.0
    ray = mi.Ray3f(dr.gather(mi.Point3f, point3(points.origin), point), direction)
    preliminary = terrain.mi_scene.ray_intersect_preliminary(ray, active=outside)
    interaction = preliminary.compute_surface_interaction(ray, mi.RayFlags.Minimal, outside)
    front = dr.dot(interaction.n, direction) < 0.0
    cluster = mi.Int32(dr.gather(mi.UInt32, mi_face_cluster, preliminary.prim_index, preliminary.is_valid()))
    hit = dr.select(preliminary.is_valid(), dr.select(front, cluster, ABSORBED), ESCAPED)
    hit = dr.select(outside, hit, ABSORBED)
    patch = mi.Int32(mi_patch_of(patches, direction))
    dr.eval(patch, hit)
    return np.array(patch).reshape(count, rays), np.array(hit).reshape(count, rays)


def trace_bounce(terrain: RayScene, points: SurfacePoints, seed: int) -> tuple[SurfacePoints, np.ndarray, np.ndarray]:
    """Trace one cosine-distributed ray from each surface point.

    Parameters
    ----------
    terrain
        The terrain.
    points
        N surface points.
    seed
        Of the random directions.

    Returns
    -------
    points
        The K surface points that rays hit from the front.
    face
        ``(K,)`` uint32 faces of these points.
    hit
        ``(N,)`` bool: rays that hit a surface from the front.
    """
    import drjit as dr
    import mitsuba as mi

    points = diffuse_points(terrain, points)
    key = hashed(hashed(dr.arange(mi.UInt32, len(points.origin)), dr.opaque(mi.UInt32, seed)), _BOUNCE)
    square = mi.Point2f(uniform(hashed(key, 0)), uniform(hashed(key, 1)))
    # The stubs reject normals as vectors.
    mi_normal, mi_geometric_normal = (
        cast(Any, mi.Normal3f(point3(normals))) for normals in (points.normal, points.geometric_normal)
    )
    direction = mi.Frame3f(mi_normal).to_world(mi.warp.square_to_cosine_hemisphere(square))
    outside = dr.dot(direction, mi_geometric_normal) > 0.0
    interaction = terrain.mi_scene.ray_intersect(mi.Ray3f(point3(points.origin), direction), active=outside)
    valid = interaction.is_valid() & (dr.dot(interaction.n, direction) < 0.0)
    # Evaluated with the points: each by itself would trace all rays again.
    dr.schedule(valid, interaction.prim_index)
    found, hit = surface_points(terrain, interaction, valid), np.array(valid)
    return found[hit], np.array(interaction.prim_index)[hit], hit
