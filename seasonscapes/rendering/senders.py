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

from seasonscapes.rendering.gather import Occluder, Points, follow

# Unit normals that scatter more than this inside a cluster are parted before positions are.
_NORMAL_SPREAD = 0.25
# Places within each cluster where light is gathered.
PLACES = 4


@dataclass(frozen=True)
class Reception:
    """What N receivers receive: from the sky, in a basis of directions, and from senders.

    Parameters
    ----------
    direct
        ``(N, r)`` float16; irradiance / π from the sky = ``direct @ (from_sky.T @ patch radiances)``.
    sender
        ``(N, K)`` uint16 senders that the receiver's rays met, each with the same share of them.
    share
        ``(N,)`` float16 share of the receiver's cosine-weighted hemisphere that is terrain.
    """

    direct: np.ndarray
    sender: np.ndarray
    share: np.ndarray


@dataclass(frozen=True)
class Senders:
    """M clusters of faces that light others.

    Parameters
    ----------
    points
        ``(M, PLACES, ...)`` places within them.
    reception
        What they receive.
    from_sky
        ``(P, r)`` float32, the basis of directions of all receptions that use these senders.
    patches
        Name of the subdivision of the sky.
    bounces
        Surfaces between receiver and light.
    """

    points: Points
    reception: Reception
    from_sky: np.ndarray
    patches: str
    bounces: int


def pilot_hits(terrain: Occluder, points: Points, depth: int, seed: int) -> tuple[Points, np.ndarray]:
    """Surfaces that random walks from points meet within ``depth`` bounces, and each one's throughput ``(K,)``."""
    found, weights = [], []
    weight = np.ones(len(points.origin), np.float32)
    for bounce in range(depth):
        points, met = follow(terrain, points, seed + bounce)
        if len(points.origin) == 0:
            break
        found.append(points)
        weights.append(weight[met])
        weight = weight[met] * points.albedo.mean(axis=1)
    columns = [np.concatenate([getattr(part, name) for part in found]) for name in Points.__dataclass_fields__]
    return Points(*columns), np.concatenate(weights)


def cluster_faces(hits: Points, weight: np.ndarray, faces: tuple[np.ndarray, np.ndarray], count: int, *,
                  seed: int) -> tuple[Points, np.ndarray]:  # fmt: skip
    """Divide space (position and normal) by medians of hits until ``count`` cells, a power of two, are left.

    Parameters
    ----------
    hits, weight
        What `pilot_hits` found.
    faces
        Centroids and unit normals of all faces, ``(F, 3)`` each.

    Returns
    -------
    points
        ``(M, PLACES, ...)`` of the hits, chosen in proportion to their weight.
    label
        ``(F,)`` uint32 cell of every face.
    """
    # Cells need a few hits each, else they could not be represented.
    levels = max(0, int(np.log2(max(min(count, len(weight) / PLACES), 1))))
    key = np.concatenate([hits.origin, hits.outward], axis=1)
    face_key = np.concatenate(faces, axis=1)
    order, bounds = np.arange(len(weight)), [0, len(weight)]
    label = np.zeros(len(face_key), np.uint32)
    every = np.arange(len(face_key))
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
    rng = np.random.default_rng(seed)
    chosen = [_systematic(weight[order[a:b]], PLACES, rng.random()) + a for a, b in itertools.pairwise(bounds)]
    return hits[order[np.concatenate(chosen)]].reshape(len(chosen), PLACES), label


def _split(key: np.ndarray, weight: np.ndarray, rows: np.ndarray) -> tuple[int, float, int]:
    """Sort ``rows`` in place along the axis of widest scatter: that axis, the value and the place of the weights' median."""
    values = key[rows]
    spread = values.std(axis=0)
    normal = 3 + int(np.argmax(spread[3:]))
    axis = normal if spread[normal] > _NORMAL_SPREAD else int(np.argmax(spread[:3]))
    rows[:] = rows[np.argsort(values[:, axis], kind="stable")]
    total = np.cumsum(weight[rows])
    middle = int(np.clip(np.searchsorted(total, 0.5 * total[-1]), 1, len(rows) - 1))
    return axis, float(key[rows[middle], axis]), middle


def _systematic(weight: np.ndarray, count: int, start: float) -> np.ndarray:
    """``count`` indices with expected number in proportion to weight, evenly spread along the order."""
    total = np.cumsum(weight, dtype=np.float64)
    return np.minimum(
        np.searchsorted(total, (np.arange(count) + start) / count * total[-1], side="right"), len(weight) - 1
    )


def sender_lists(met: np.ndarray, weight: np.ndarray, count: int, *, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """``count`` senders for each receiver out of those that its rays met ``(N, K)``, and the share of rays that met any.

    Systematic resampling along the rays' own (stratified) order: the expected number of times that a sender is listed
    is in proportion to the weight of the rays that met it. ``weight`` ``(N, K)`` has sum 1 over each row.
    """
    total = np.cumsum(np.where(met >= 0, weight, np.float32(0.0)), axis=1, dtype=np.float32)
    share = total[:, -1]
    start = np.random.default_rng(seed).random((len(met), 1), np.float32)
    at = (np.arange(count, dtype=np.float32) + start) / count * share[:, None]
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
