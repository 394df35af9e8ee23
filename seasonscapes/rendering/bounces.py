"""Light between the mountains: a few thousand clusters of faces that pass on what sky and sun send them.

The faces that a view's bounced rays meet are gathered into M clusters of about equal importance. What each cluster
sends on, per unit of radiance of every sky patch, follows from rays over its own hemisphere: those that leave give the
first bounce, those that meet other clusters the further ones. It is direct-to-indirect transfer (Hašan, Pellacini &
Bala 2006, doi:10.1145/1141911.1141998) in the directional basis of daylight coefficients.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.rendering.gather import Occluder, Points, follow, gather
from seasonscapes.rendering.sky_patches import SkyPatches, sky_covariance

# Unit normals that scatter more than this inside a cluster are parted before positions are.
_NORMAL_SPREAD = 0.25
_POINTS_PER_CLUSTER = 8
_RAYS_PER_POINT = 128


@dataclass(frozen=True)
class Clusters:
    """Faces in clusters, and where within them light is gathered.

    Parameters
    ----------
    of_face
        Cluster of every face ``(F,)`` uint32.
    points
        ``M × _POINTS_PER_CLUSTER`` places, cluster by cluster.
    """

    of_face: np.ndarray
    points: Points

    @property
    def size(self) -> int:
        """M."""
        return len(self.points.face) // _POINTS_PER_CLUSTER


@dataclass(frozen=True)
class DirectionBasis:
    """A few weighted sums over patches that stand for all of them.

    Light arriving per patch ``(N, P)`` times ``into`` gives coefficients; their product with ``sky @ from_sky`` gives
    the sum over patches of arriving light times sky radiance, nearly.

    Parameters
    ----------
    into
        ``(P, r)``.
    from_sky
        ``(P, r)``.
    """

    into: np.ndarray
    from_sky: np.ndarray


def direction_basis(rows: np.ndarray, patches: SkyPatches, rank: int, *, unrest: float = 0.15) -> DirectionBasis:
    """Principal components of light arriving per patch, weighted by how skies vary.

    With C the skies' covariance, the first singular vectors of ``rows C^½`` leave the smallest mean square error of
    ``rows · sky`` over those skies (clustered principal component analysis with one cluster; Sloan, Hall, Hart &
    Snyder 2003, doi:10.1145/882262.882281).

    Parameters
    ----------
    rows
        Examples ``(N, P)``.
    rank
        r; P or more keeps all.
    unrest
        See `sky_covariance`. Larger treats all directions alike, as a sun that may stand anywhere needs.
    """
    values, vectors = np.linalg.eigh(sky_covariance(patches, unrest=unrest))
    root = np.sqrt(np.maximum(values, 1e-9))
    half = (vectors * root) @ vectors.T
    inverse = (vectors / root) @ vectors.T
    weighted = rows @ half
    _, components = np.linalg.eigh(weighted.T @ weighted)
    components = components[:, ::-1][:, :rank]
    return DirectionBasis(half @ components, inverse @ components)


def pilot_hits(terrain: Occluder, points: Points, depth: int, seed: int) -> tuple[Points, np.ndarray]:
    """Surfaces that random walks from points meet within ``depth`` bounces, and each one's share of throughput ``(K,)``."""
    weight = points.albedo.mean(axis=1)
    found, weights = [], []
    for bounce in range(depth):
        points, met = follow(terrain, points, seed + bounce)
        # A walk's first surface counts fully whatever the receiver's colour is; later ones by what is passed on.
        weight = np.ones(len(points.face), np.float32) if bounce == 0 else weight[met]
        lit = points.albedo.max(axis=1) > 0.0
        points, weight = points[lit], weight[lit]
        found.append(points)
        weights.append(weight)
        weight = weight * points.albedo.mean(axis=1)
        if len(points.face) == 0:
            break
    columns = [
        np.concatenate([getattr(part, name) for part in found]) for name in ("origin", "normal", "albedo", "face")
    ]
    return Points(*columns), np.concatenate(weights)


def build_clusters(hits: Points, weight: np.ndarray, faces: tuple[np.ndarray, np.ndarray], count: int, *,
                   seed: int) -> Clusters:  # fmt: skip
    """Divide space (position and normal) by medians of hits until ``count`` cells, a power of two, are left.

    Parameters
    ----------
    hits, weight
        What `pilot_hits` found.
    faces
        Centroids and unit normals of all faces, ``(F, 3)`` each.
    """
    levels = int(np.log2(max(count, 1)))
    # Cells need a few hits each, else they could not be represented.
    levels = max(0, min(levels, int(np.log2(max(len(weight) / _POINTS_PER_CLUSTER, 1)))))
    key = np.concatenate([hits.origin, hits.normal], axis=1)
    face_key = np.concatenate(faces, axis=1)
    order, bounds = np.arange(len(weight)), [0, len(weight)]
    of_face = np.zeros(len(face_key), np.uint32)
    for _ in range(levels):
        axes, values, cut = [], [], [0]
        for start, end in zip(bounds[:-1], bounds[1:], strict=True):
            rows = order[start:end]
            axis = _split_axis(key[rows])
            rows = rows[np.argsort(key[rows, axis], kind="stable")]
            total = np.cumsum(weight[rows])
            middle = int(np.clip(np.searchsorted(total, 0.5 * total[-1]), 1, len(rows) - 1)) if len(rows) > 1 else 0
            order[start:end] = rows
            axes.append(axis)
            values.append(key[rows[middle], axis] if len(rows) else 0.0)
            cut += [start + middle, end]
        side = face_key[np.arange(len(face_key)), np.array(axes)[of_face]] >= np.array(values, np.float32)[of_face]
        of_face = of_face * np.uint32(2) + side.astype(np.uint32)
        bounds = cut
    rng = np.random.default_rng(seed)
    chosen = [_stratified(order[a:b], weight, rng) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]
    return Clusters(of_face, hits[np.concatenate(chosen)])


def _split_axis(key: np.ndarray) -> int:
    if len(key) < 2:
        return 0
    spread = key.std(axis=0)
    normal = 3 + int(np.argmax(spread[3:]))
    return normal if spread[normal] > _NORMAL_SPREAD else int(np.argmax(spread[:3]))


def _stratified(rows: np.ndarray, weight: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """``_POINTS_PER_CLUSTER`` of the rows, with probability in proportion to weight, spread along their order."""
    total = np.cumsum(weight[rows])
    at = (np.arange(_POINTS_PER_CLUSTER) + rng.random(_POINTS_PER_CLUSTER)) / _POINTS_PER_CLUSTER * total[-1]
    return rows[np.minimum(np.searchsorted(total, at), len(rows) - 1)]


def label_rows(labels: np.ndarray, weight: np.ndarray, columns: int, *, first: int = 0) -> Any:
    """Sparse ``(N, columns)`` weighted counts of the labels in ``[first, first + columns)`` in each row of ``(N, K)``.

    ``weight`` ``(N, K)`` or broadcastable to it. Repeated columns are left as they are; products add them.
    """
    from scipy import sparse

    keep = (labels >= first) & (labels < first + columns)
    start = np.concatenate([[0], np.cumsum(keep.sum(axis=1))]).astype(np.int64)
    data = np.broadcast_to(np.asarray(weight, np.float32), labels.shape)[keep]
    return sparse.csr_array((data, (labels[keep] - first).astype(np.int32), start.astype(np.int32)),
                            shape=(len(labels), columns))  # fmt: skip


def cluster_radiance(terrain: Occluder, patches: SkyPatches, clusters: Clusters, face_label: Any, *, bounces: int,
                     rank: int, seed: int) -> tuple[np.ndarray, DirectionBasis]:  # fmt: skip
    """What clusters send on, ``(3, M, r)`` per channel in a basis of directions, and that basis.

    Parameters
    ----------
    bounces
        Surfaces that light may meet before it reaches the receiver, at least 1. Infinitely many would be a matrix
        inverse; each further one is a product here.
    """
    points, size = clusters.points, clusters.size
    cluster = np.repeat(np.arange(size), _POINTS_PER_CLUSTER)
    number = np.tile(np.arange(_POINTS_PER_CLUSTER) * _RAYS_PER_POINT, size).astype(np.uint32)
    scramble = (cluster + np.uint32(seed)).astype(np.uint32)
    labels = gather(terrain, patches, points.origin, points.normal, rays=_RAYS_PER_POINT, first=number,
                    scramble=scramble, face_label=face_label)  # fmt: skip
    # One row per cluster; each ray carries the albedo of its point.
    labels = labels.reshape(size, -1)
    albedo = np.repeat(points.albedo.reshape(size, _POINTS_PER_CLUSTER, 3), _RAYS_PER_POINT, axis=1) / labels.shape[1]
    direct = [label_rows(labels, albedo[..., c], patches.size) for c in range(3)]
    between = [label_rows(labels, albedo[..., c], size, first=patches.size) for c in range(3)]
    for matrix in between:
        matrix.sum_duplicates()
    grey = sum(matrix.toarray() for matrix in direct)
    basis = direction_basis(grey, patches, rank, unrest=1.0)
    sent = np.stack([matrix @ basis.into.astype(np.float32) for matrix in direct])
    total = sent.copy()
    for _ in range(bounces - 1):
        total = sent + np.stack([between[c] @ total[c] for c in range(3)])
    return total, basis
