"""Interreflected light through clusters of mesh faces (virtual point light clusters).

The faces that bounced rays hit are grouped into M clusters of about equal importance. For a given illumination the
reflected radiance of the clusters is computed first: from the sky through their own daylight coefficients, from the sun
by shadow rays from points inside them, and from further bounces by exchange between clusters. Each receiver then sums
the radiance of the clusters that its own hemisphere rays hit. This is direct-to-indirect transfer (Hašan, Pellacini &
Bala 2006, ACM Transactions on Graphics 25, 1089). The clusters are lit by the actual sun rather than by a sky patch around it, so
that shadows on the opposite side of a valley contribute no light.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.rendering.hemisphere_rays import RayScene, SurfacePoints, concatenate_points, trace_bounce

# Groups are split by normal while a component of their unit normals has a larger standard deviation, else by position.
_NORMAL_SPREAD = 0.25
# Surface points per cluster at which its irradiance is evaluated.
POINTS_PER_CLUSTER = 4


@dataclass(frozen=True)
class ReceiverCoefficients:
    """Light transport coefficients of N receivers (pixels, texels or clusters), from the sky and from clusters.

    Parameters
    ----------
    direct
        ``(N, r)`` float16 daylight coefficients in the directional basis; irradiance / π from the sky is
        ``direct @ (from_sky.T @ patch radiances)``.
    cluster
        ``(N, K)`` uint16 clusters that the receiver's rays hit, all of equal weight ``share / K``.
    share
        ``(N,)`` float16 fraction of the receiver's cosine-weighted hemisphere that terrain covers.
    """

    direct: np.ndarray
    cluster: np.ndarray
    share: np.ndarray


@dataclass(frozen=True)
class LightClusters:
    """M clusters of faces that reflect light to receivers.

    Parameters
    ----------
    points
        ``(M, POINTS_PER_CLUSTER, ...)`` surface points inside the clusters.
    receivers
        Coefficients of the light that the clusters receive.
    from_sky
        ``(P, r)`` float32 directional basis, shared by all receivers that use these clusters; see `DirectionBasis`.
    patches
        Name of the subdivision of the sky.
    bounces
        Number of surfaces on a path between light and receiver.
    """

    points: SurfacePoints
    receivers: ReceiverCoefficients
    from_sky: np.ndarray
    patches: str
    bounces: int


@dataclass(frozen=True)
class PathHits:
    """K points at which random paths hit the terrain, for placing the clusters.

    Parameters
    ----------
    points
        The K surface points.
    face
        ``(K,)`` uint32 faces of the points.
    throughput
        ``(K,)`` float32 path throughput before the reflection at the point.
    """

    points: SurfacePoints
    face: np.ndarray
    throughput: np.ndarray


@dataclass(frozen=True)
class FaceGeometry:
    """Centroids [m] and unit normals ``(F, 3)`` float32 of the F faces of a mesh."""

    centroid: np.ndarray
    normal: np.ndarray


def trace_path_hits(terrain: RayScene, points: SurfacePoints, depth: int, seed: int) -> PathHits:
    """Trace one random path from each surface point and collect the points that the paths hit.

    Parameters
    ----------
    terrain
        The terrain.
    points
        Start of the paths.
    depth
        Largest number of bounces.
    seed
        Of the random directions.

    Returns
    -------
    PathHits
        All hits of all paths; the start points are not among them.
    """
    found, faces, weights = [points[:0]], [np.empty(0, np.uint32)], [np.empty(0, np.float32)]
    weight = np.ones(len(points.origin), np.float32)
    for bounce in range(depth):
        points, face, hit = trace_bounce(terrain, points, seed + bounce)
        if len(face) == 0:
            break
        found.append(points)
        faces.append(face)
        weights.append(weight[hit])
        weight = weight[hit] * points.albedo.mean(axis=1)
    return PathHits(concatenate_points(found), np.concatenate(faces), np.concatenate(weights))


def cluster_faces(hits: PathHits, faces: FaceGeometry, count: int, *, seed: int) -> tuple[SurfacePoints, np.ndarray]:
    """Divide the faces of a mesh into clusters of about equal importance, by a binary tree over position and normal.

    Each node of the tree is split at the weighted median of its hits.

    Parameters
    ----------
    hits
        Hits of random paths, weighted by their throughput.
    faces
        Geometry of all faces.
    count
        Number of clusters, a power of two; fewer are made of few hits.
    seed
        Of the choice of points.

    Returns
    -------
    points
        ``(M, POINTS_PER_CLUSTER, ...)`` hits in each cluster, chosen with probability proportional to throughput.
        Clusters without a hit repeat the points of a neighbouring one.
    face_cluster
        ``(F,)`` uint32 cluster of each face.
    """
    face_key = np.concatenate((faces.centroid, faces.normal), axis=1)
    hit_count = len(hits.face)
    # Faces are divided, not hits, so that the face alone determines the cluster that a ray hits.
    rows = _Rows(np.arange(hit_count), np.ascontiguousarray(face_key[hits.face].T), hits.throughput)
    levels = max(0, int(np.log2(max(min(count, hit_count / POINTS_PER_CLUSTER), 1))))
    bounds = np.array([0, hit_count])
    face_cluster, all_faces = np.zeros(len(face_key), np.uint32), np.arange(len(face_key))
    for _ in range(levels):
        rows, axes, values, middles = _split(rows, bounds)
        side = face_key[all_faces, axes[face_cluster]] >= values[face_cluster]
        face_cluster = face_cluster * np.uint32(2) + side.astype(np.uint32)
        bounds = np.append(0, np.stack([middles, bounds[1:]], axis=1).ravel())
    return hits.points[_choose_points(rows.order, bounds, hits.throughput, seed)], face_cluster


@dataclass(frozen=True)
class _Rows:
    """Hits in groups: their numbers ``(K,)``, centroid and normal of their faces ``(6, K)``, and their throughput ``(K,)``."""

    order: np.ndarray
    key: np.ndarray
    weight: np.ndarray


def _split(rows: _Rows, bounds: np.ndarray) -> tuple[_Rows, np.ndarray, np.ndarray, np.ndarray]:
    """Sort each group of hits, delimited by ``bounds``, along its axis of largest spread, and split it at the median.

    Returns the sorted hits, and of each group the axis, the value of the split (infinite for empty groups) and the place
    where the hits above it begin.
    """
    groups, count = len(bounds) - 1, np.diff(bounds)
    filled = np.flatnonzero(count)
    start, last, number = bounds[filled], bounds[filled + 1] - 1, count[filled]
    group = np.repeat(np.arange(groups), count)
    spread = np.zeros((len(rows.key), groups))
    for column, result in zip(rows.key, spread, strict=True):
        mean = np.add.reduceat(column, start, dtype=np.float64) / number
        centred = column - np.repeat(mean.astype(np.float32), number)
        result[filled] = np.sqrt(np.add.reduceat(centred * centred, start, dtype=np.float64) / number)
    normal = 3 + np.argmax(spread[3:], axis=0)
    axis = np.where(spread[normal, np.arange(groups)] > _NORMAL_SPREAD, normal, np.argmax(spread[:3], axis=0))
    along = rows.key[axis[group], np.arange(len(group))]
    # Groups and the ordered bits of floats in one integer, which sorts several times faster than two keys.
    bits = along.view(np.int32)
    ordered = np.where(bits < 0, ~bits, bits | np.int32(-(2**31))).view(np.uint32)
    sort = np.argsort((group.astype(np.uint64) << np.uint64(32)) | ordered, kind="stable")
    along, rows = along[sort], _Rows(rows.order[sort], np.take(rows.key, sort, axis=1), rows.weight[sort])
    # The weighted median of each group, by one search in the sums over all groups.
    total = np.cumsum(rows.weight, dtype=np.float64)
    before = np.where(start > 0, total[start - 1], 0.0)
    value = np.full(groups, np.inf, np.float32)
    value[filled] = along[np.clip(np.searchsorted(total, 0.5 * (before + total[last])), start, last)]
    # With many hits on the first face the split is moved behind it, so that neither side is empty if possible.
    for each in filled[value[filled] == along[start]]:
        within = along[bounds[each] : bounds[each + 1]]
        value[each] = within[min(int(np.searchsorted(within, within[0], side="right")), len(within) - 1)]
    middle = bounds[:-1].copy()
    middle[filled] += np.add.reduceat((along < value[group]).astype(np.intp), start)
    return rows, axis, value, middle


def _choose_points(order: np.ndarray, bounds: np.ndarray, weight: np.ndarray, seed: int) -> np.ndarray:
    """Indices ``(M, POINTS_PER_CLUSTER)`` of hits; ``bounds`` ``(M + 1,)`` delimit the clusters in ``order``."""
    occupied = np.flatnonzero(np.diff(bounds) > 0)
    start, last = bounds[occupied], bounds[occupied + 1] - 1
    total = np.cumsum(weight[order], dtype=np.float64)
    before = np.where(start > 0, total[start - 1], 0.0)
    # Systematic samples, whose expected frequency is proportional to the weight.
    place = np.arange(POINTS_PER_CLUSTER) + np.random.default_rng(seed).random(len(occupied))[:, None]
    target = before[:, None] + place / POINTS_PER_CLUSTER * (total[last] - before)[:, None]
    chosen = np.empty((len(bounds) - 1, POINTS_PER_CLUSTER), np.intp)
    chosen[occupied] = order[np.clip(np.searchsorted(total, target, side="right"), start[:, None], last[:, None])]
    nearest = occupied[np.clip(np.searchsorted(occupied, np.arange(len(chosen))), 0, len(occupied) - 1)]
    return chosen[nearest]


def cluster_lists(
    hit: np.ndarray, weight: np.ndarray, count: int, *, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Reduce the clusters that a receiver's rays hit to a list of fixed length, by systematic resampling.

    Resampling follows the (stratified) order of the rays. The expected number of entries of a cluster is proportional
    to the weight of the rays that hit it.

    Parameters
    ----------
    hit
        ``(N, K)`` cluster that each ray hits, negative for none.
    weight
        ``(N, K)`` weight of each ray, sum 1 over each row.
    count
        Length of the lists.
    start
        ``(N,)`` offset of each receiver's samples in [0, 1).

    Returns
    -------
    cluster
        ``(N, count)`` uint16 clusters.
    share
        ``(N,)`` total weight of the rays that hit a cluster.
    """
    total = np.cumsum(np.where(hit >= 0, weight, np.float32(0.0)), axis=1, dtype=np.float32)
    share = total[:, -1]
    sample = (np.arange(count, dtype=np.float32) + start[:, None]) / count * share[:, None]
    # Offsets concatenate the rows to one increasing sequence, for a single search.
    offset = np.arange(len(hit), dtype=np.float64)[:, None] * 2.0
    index = np.searchsorted((total + offset).ravel(), (sample + offset).ravel(), side="right").reshape(sample.shape)
    index = np.clip(index - np.arange(len(hit))[:, None] * hit.shape[1], 0, hit.shape[1] - 1)
    chosen = np.take_along_axis(hit, index, axis=1)
    # Rounding may select a ray behind the last one that hit a cluster; that last one is taken instead.
    last = hit.shape[1] - 1 - np.argmax(hit[:, ::-1] >= 0, axis=1)
    chosen = np.where(chosen < 0, np.take_along_axis(hit, last[:, None], axis=1), chosen)
    return np.maximum(chosen, 0).astype(np.uint16), share


def face_geometry(mi_terrain: Any) -> FaceGeometry:
    """Compute the centroids and unit normals of the faces of a mesh.

    Parameters
    ----------
    mi_terrain
        ``mi.Mesh`` of F triangles.

    Returns
    -------
    FaceGeometry
        ``(F, 3)`` float32 arrays.
    """
    import mitsuba as mi

    parameters = mi.traverse(mi_terrain)
    vertices = np.array(parameters["vertex_positions"]).reshape(-1, 3)
    corners = vertices[np.array(parameters["faces"]).reshape(-1, 3)]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    return FaceGeometry(corners.mean(axis=1).astype(np.float32), normal.astype(np.float32))
