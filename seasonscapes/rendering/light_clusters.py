"""Light between the mountains: a few thousand clusters of faces that pass on what sky and sun send them.

The faces that bounced rays meet are gathered into M clusters of about equal importance, the *senders*. Under any light
their radiance is found first (sky through their own daylight coefficients, sun by shadow rays from places inside them,
further bounces by looking at each other); receivers then look up the senders that their own rays met. It is
direct-to-indirect transfer (Hašan, Pellacini & Bala 2006, doi:10.1145/1141911.1141998), and being given the actual sun
rather than a patch of sky around it, shadows at the receiver's side of a valley stay dark.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.rendering.hemisphere_rays import RayScene, SurfacePoints, concatenate_points, follow_one_ray

# Unit normals that scatter more than this inside a cluster are parted before positions are.
_NORMAL_SPREAD = 0.25
# Places within each cluster where light is gathered.
PLACES = 4


@dataclass(frozen=True)
class ReceiverCoefficients:
    """What N receivers receive: from the sky, in a basis of directions, and from senders.

    Parameters
    ----------
    direct
        ``(N, r)`` float16; irradiance / π from the sky = ``direct @ (from_sky.T @ patch radiances)``.
    cluster
        ``(N, K)`` uint16 senders that the receiver's rays met, each with the same share of them.
    share
        ``(N,)`` float16 share of the receiver's cosine-weighted hemisphere that is terrain.
    """

    direct: np.ndarray
    cluster: np.ndarray
    share: np.ndarray


@dataclass(frozen=True)
class LightClusters:
    """M clusters of faces that light others.

    Parameters
    ----------
    points
        ``(M, PLACES, ...)`` places within them.
    receivers
        What they receive.
    from_sky
        ``(P, r)`` float32, the basis of directions of all receptions that use these senders.
    patches
        Name of the subdivision of the sky.
    bounces
        Surfaces between receiver and light.
    """

    points: SurfacePoints
    receivers: ReceiverCoefficients
    from_sky: np.ndarray
    patches: str
    bounces: int


def pilot_hits(
    terrain: RayScene, points: SurfacePoints, depth: int, seed: int
) -> tuple[SurfacePoints, np.ndarray, np.ndarray]:
    """Surfaces that random walks from points meet within ``depth`` bounces, their faces and throughputs ``(K,)``."""
    found, faces, weights = [points[:0]], [np.empty(0, np.uint32)], [np.empty(0, np.float32)]
    weight = np.ones(len(points.origin), np.float32)
    for bounce in range(depth):
        points, face, met = follow_one_ray(terrain, points, seed + bounce)
        if len(face) == 0:
            break
        found.append(points)
        faces.append(face)
        weights.append(weight[met])
        weight = weight[met] * points.albedo.mean(axis=1)
    return concatenate_points(found), np.concatenate(faces), np.concatenate(weights)


def cluster_faces(
    hits: tuple[SurfacePoints, np.ndarray, np.ndarray], faces: tuple[np.ndarray, np.ndarray], count: int, *, seed: int
) -> tuple[SurfacePoints, np.ndarray]:
    """Divide faces by position and normal, by medians of hits, into ``count`` groups, a power of two.

    Parameters
    ----------
    hits
        What `pilot_hits` found: surfaces, faces and throughputs.
    faces
        Centroids and unit normals of all faces, ``(F, 3)`` each.

    Returns
    -------
    points
        ``(M, PLACES, ...)`` of the hits on each group, chosen in proportion to their throughput. Groups that no hit
        fell on repeat a neighbour's.
    label
        ``(F,)`` uint32 group of every face.
    """
    points, face, weight = hits
    face_key = np.concatenate(faces, axis=1)
    # Whole faces are divided, not hits: a ray that meets a face must find its group without asking where it was met.
    key = face_key[face]
    levels = max(0, int(np.log2(max(min(count, len(face) / PLACES), 1))))
    order, bounds = np.arange(len(face)), [0, len(face)]
    label, every = np.zeros(len(face_key), np.uint32), np.arange(len(face_key))
    for _ in range(levels):
        axes, values, cut = [], [], [0]
        for start, end in itertools.pairwise(bounds):
            axis, value, middle = _split(key, weight, order[start:end])
            axes.append(axis)
            values.append(value)
            cut += [start + middle, end]
        side = face_key[every, np.array(axes)[label]] >= np.array(values, np.float32)[label]
        label = label * np.uint32(2) + side.astype(np.uint32)
        bounds = cut
    return points[_places(order, np.array(bounds), weight, seed)], label


def _split(key: np.ndarray, weight: np.ndarray, rows: np.ndarray) -> tuple[int, float, int]:
    """Sort ``rows`` in place along the axis of widest scatter: that axis, a value near the weights' median, and where
    in ``rows`` keys reach it."""
    if len(rows) == 0:
        return 0, np.inf, 0
    values = key[rows]
    spread = values.std(axis=0)
    normal = 3 + int(np.argmax(spread[3:]))
    axis = normal if spread[normal] > _NORMAL_SPREAD else int(np.argmax(spread[:3]))
    rows[:] = rows[np.argsort(values[:, axis], kind="stable")]
    values, total = key[rows, axis], np.cumsum(weight[rows])
    value = values[min(int(np.searchsorted(total, 0.5 * total[-1])), len(rows) - 1)]
    if value == values[0]:
        # Many hits on the first face: cut after it, so that neither side is empty where that can be.
        value = values[min(int(np.searchsorted(values, value, side="right")), len(rows) - 1)]
    return axis, float(value), int(np.searchsorted(values, value, side="left"))


def _places(order: np.ndarray, bounds: np.ndarray, weight: np.ndarray, seed: int) -> np.ndarray:
    """``(M, PLACES)`` of the hits in each group; ``bounds`` ``(M + 1,)`` in ``order``."""
    rng = np.random.default_rng(seed)
    filled = np.flatnonzero(np.diff(bounds) > 0)
    places = np.empty((len(bounds) - 1, PLACES), np.intp)
    for group in filled:
        rows = order[bounds[group] : bounds[group + 1]]
        places[group] = rows[_systematic(weight[rows], PLACES, rng.random())]
    nearest = filled[np.clip(np.searchsorted(filled, np.arange(len(places))), 0, len(filled) - 1)]
    return places[nearest]


def _systematic(weight: np.ndarray, count: int, start: float) -> np.ndarray:
    """``count`` indices with expected number in proportion to weight, evenly spread along the order."""
    total = np.cumsum(weight, dtype=np.float64)
    return np.minimum(
        np.searchsorted(total, (np.arange(count) + start) / count * total[-1], side="right"), len(weight) - 1
    )


def cluster_lists(
    met: np.ndarray, weight: np.ndarray, count: int, *, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """``count`` senders for each receiver out of those that its rays met ``(N, K)``, and the share of rays that met any.

    Systematic resampling along the rays' own (stratified) order: the expected number of times that a sender is listed
    is in proportion to the weight of the rays that met it. ``weight`` ``(N, K)`` has sum 1 over each row; ``start``
    ``(N,)`` is where in [0, 1) each receiver's picks begin.
    """
    total = np.cumsum(np.where(met >= 0, weight, np.float32(0.0)), axis=1, dtype=np.float32)
    share = total[:, -1]
    at = (np.arange(count, dtype=np.float32) + start[:, None]) / count * share[:, None]
    # Rows side by side make one increasing sequence, which one search serves.
    offset = np.arange(len(met), dtype=np.float64)[:, None] * 2.0
    index = np.searchsorted((total + offset).ravel(), (at + offset).ravel(), side="right").reshape(at.shape)
    index = np.clip(index - np.arange(len(met))[:, None] * met.shape[1], 0, met.shape[1] - 1)
    chosen = np.take_along_axis(met, index, axis=1)
    # Rounding may step past the last ray that met a sender; such a pick belongs to that ray.
    last = met.shape[1] - 1 - np.argmax(met[:, ::-1] >= 0, axis=1)
    chosen = np.where(chosen < 0, np.take_along_axis(met, last[:, None], axis=1), chosen)
    return np.maximum(chosen, 0).astype(np.uint16), share


def face_geometry(mi_terrain: Any) -> tuple[np.ndarray, np.ndarray]:
    """Centroids and unit normals ``(F, 3)`` float32 of a mesh's faces."""
    import mitsuba as mi

    parameters = mi.traverse(mi_terrain)
    vertices = np.array(parameters["vertex_positions"]).reshape(-1, 3)
    corners = vertices[np.array(parameters["faces"]).reshape(-1, 3)]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-20)
    return corners.mean(axis=1).astype(np.float32), normal.astype(np.float32)
