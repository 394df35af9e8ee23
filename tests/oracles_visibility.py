"""A slow obvious twin of visibility: one ray at a time, in double precision, against every triangle near its path."""

from __future__ import annotations

import numpy as np


class BinnedTriangles:
    """Triangles ``(F, 3)`` of vertices ``(V, 3)`` in square bins of the plan, so that a ray meets some hundreds of them.

    Bins only leave out triangles whose bounding box no piece of the ray's shadow on the plan touches.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, bins: int = 128):
        self.corners = np.asarray(vertices, np.float64)[np.asarray(faces, np.int64)]
        plan = self.corners[..., :2]
        self.low = plan.min(axis=(0, 1))
        self.side = float((plan.max(axis=(0, 1)) - self.low).max()) / bins * (1.0 + 1e-9)
        self.bins = bins
        first = ((plan.min(axis=1) - self.low) / self.side).astype(int)
        last = ((plan.max(axis=1) - self.low) / self.side).astype(int)
        pairs = []
        for di in range(int((last - first)[:, 0].max()) + 1):
            for dj in range(int((last - first)[:, 1].max()) + 1):
                there = (first[:, 0] + di <= last[:, 0]) & (first[:, 1] + dj <= last[:, 1])
                cell = (first[there, 0] + di) * bins + first[there, 1] + dj
                pairs.append(np.stack([cell, np.flatnonzero(there)], axis=1))
        pairs = np.concatenate(pairs)
        pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
        self.members = pairs[:, 1]
        self.start = np.searchsorted(pairs[:, 0], np.arange(bins * bins + 1))

    def sees(self, position: np.ndarray, own_face: np.ndarray, eye: np.ndarray, *, near_m: float = 0.5) -> np.ndarray:
        """Whether the straight lines from places ``(N, 3)`` on faces ``(N,)`` to an eye meet no other face, ``(N,)`` bool."""
        return np.array(
            [self._clear(p, f, np.asarray(eye, float), near_m) for p, f in zip(position, own_face, strict=True)]
        )

    def _clear(self, place: np.ndarray, own: int, eye: np.ndarray, near_m: float) -> bool:
        along = eye - place
        length = float(np.linalg.norm(along))
        steps = int(np.ceil(2.0 * np.linalg.norm(along[:2]) / self.side)) + 1
        points = place[:2] + np.linspace(0.0, 1.0, steps + 1)[:, None] * along[:2]
        cell = np.floor((points - self.low) / self.side).astype(int)
        # A step is half a bin at most: bins that it crosses are the ends' own and their neighbours.
        around = cell[:, None] + np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1]), -1).reshape(1, 9, 2)
        around = around[((around >= 0) & (around < self.bins)).all(axis=2)]
        cells = np.unique(around[:, 0] * self.bins + around[:, 1])
        lists = [self.members[self.start[c] : self.start[c + 1]] for c in cells]
        faces = np.unique(np.concatenate(lists)) if lists else np.zeros(0, int)
        faces = faces[faces != own]
        return not crosses(place, along, self.corners[faces], 1.0 - near_m / length)


def crosses(origin: np.ndarray, along: np.ndarray, corners: np.ndarray, end: float) -> bool:
    """Whether a segment ``origin + t along``, 0 < t < end, meets any triangle ``(F, 3, 3)`` (Möller & Trumbore 1997)."""
    e1, e2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    p = np.cross(along, e2)
    determinant = np.einsum("fc,fc->f", e1, p)
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = 1.0 / determinant
        offset = origin - corners[:, 0]
        u = np.einsum("fc,fc->f", offset, p) * inverse
        q = np.cross(offset, e1)
        v = np.einsum("c,fc->f", along, q) * inverse
        t = np.einsum("fc,fc->f", e2, q) * inverse
        hit = (determinant != 0.0) & (u >= 0.0) & (v >= 0.0) & (u + v <= 1.0) & (t > 1e-9) & (t < end)
    return bool(hit.any())
