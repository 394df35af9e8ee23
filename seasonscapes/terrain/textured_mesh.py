"""A user's textured mesh: parts with their own textures or vertex colours, placed in a local east-north-up frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from seasonscapes.frames import LocalFrame

# Faces whose normals differ by more than this do not share a smooth normal.
_CREASE_DEG = 40.0
# Pairs of corners in one step; bounds the memory.
_CHUNK_PAIRS = 4_000_000


@dataclass(frozen=True)
class MeshTexture:
    """Colours of a mesh: an image, or the colours of vertices.

    Parameters
    ----------
    name
        Of the image file or material; unique within a mesh.
    values
        ``(R, S, 3)`` float32 linear Rec.709 in [0, 1], row 0 at v = 1; of vertex colours ``(V, 1, 3)``.
    bits
        Bits per channel in the file, 8 or 16.
    alpha
        ``(R, S)`` float32 opacity; ``None`` where the file has none.
    of_vertices
        Whether these are the colours of vertices.
    """

    name: str
    values: np.ndarray
    bits: int = 8
    alpha: np.ndarray | None = None
    of_vertices: bool = False


@dataclass(frozen=True)
class MeshPart:
    """Faces that share a texture, as the file has them.

    Parameters
    ----------
    name
        Of the part.
    vertices
        ``(V, 3)`` float64 in the file's own axes and units.
    faces
        ``(F, 3)`` int64 vertex indices.
    texture
        Index of the texture; −1 for a uniform ``colour``.
    uv
        ``(V, 2)`` float64 texture coordinates, v upwards; ``None`` for vertex colours and uniform colours.
    normals
        ``(V, 3)`` float64 unit normals of the file, ``None`` where it has none.
    colour
        ``(3,)`` linear factor on the texture.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    texture: int
    uv: np.ndarray | None = None
    normals: np.ndarray | None = None
    colour: tuple[float, float, float] = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class TexturedMesh:
    """A textured mesh with its place on Earth; made by `load_mesh`.

    Parameters
    ----------
    path
        The file.
    parts
        Faces in the file's own axes.
    textures
        Textures that the parts refer to.
    positions
        For each part ``(V, 3)`` float64 east-north-up [m] about ``frame``.
    turn
        ``(3, 3)`` rotation of directions from the file's axes to east-north-up.
    frame
        Local frame, whose origin is in the middle of the mesh.
    up
        ``"y"`` or ``"z"``: the file's axis that points upwards.
    """

    path: Path
    parts: tuple[MeshPart, ...]
    textures: tuple[MeshTexture, ...]
    positions: tuple[np.ndarray, ...]
    turn: np.ndarray
    frame: LocalFrame
    up: str

    @property
    def bounds_m(self) -> tuple[np.ndarray, np.ndarray]:
        """Lowest and highest east, north and up ``(3,)`` [m]."""
        used = [position[np.unique(part.faces)] for part, position in zip(self.parts, self.positions, strict=True)]
        return np.min([p.min(axis=0) for p in used], axis=0), np.max([p.max(axis=0) for p in used], axis=0)


def turn_from_axes(up: str, north_deg: float) -> np.ndarray:
    """Rotation ``(3, 3)`` from a file's axes to east-north-up.

    Parameters
    ----------
    up
        ``"z"``: x east, y north; ``"y"``: x east, −z north, as in glTF.
    north_deg
        Azimuth of the file's own north, clockwise from true north [deg].
    """
    axes = np.eye(3) if up == "z" else np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
    sine, cosine = np.sin(np.radians(north_deg)), np.cos(np.radians(north_deg))
    return np.array([[cosine, sine, 0.0], [-sine, cosine, 0.0], [0.0, 0.0, 1.0]]) @ axes


def face_normals(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit normals ``(F, 3)`` and areas ``(F,)`` of triangles ``(F, 3, 3)``; zero normals for degenerate ones."""
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    return normal / np.maximum(length, 1e-300)[:, None], 0.5 * length


def creased_normals(corners: np.ndarray) -> np.ndarray:
    """Smooth normals of the corners of triangles, which keep edges sharp between faces that differ by over 40°.

    Parameters
    ----------
    corners
        ``(F, 3, 3)`` positions; faces adjoin where corners coincide.

    Returns
    -------
    numpy.ndarray
        ``(F, 3, 3)`` float32 unit normals: area-weighted means of the faces about a point that face alike.
    """
    normal, area = face_normals(corners)
    point = numbered_rows(np.ascontiguousarray(corners.reshape(-1, 3), np.float32))[1]
    order = np.argsort(point, kind="stable")
    start = np.flatnonzero(np.r_[True, np.diff(point[order]) > 0])
    count = np.diff(np.r_[start, len(order)])
    total = np.empty((len(point), 3))
    pairs = np.cumsum(count.astype(np.int64) ** 2)
    cuts = np.searchsorted(pairs, np.arange(_CHUNK_PAIRS, pairs[-1], _CHUNK_PAIRS))
    for group in np.split(np.arange(len(start)), np.unique(cuts)):
        if not len(group):
            continue
        # All pairs of corners at one point.
        corner = order[start[group[0]] : start[group[-1]] + count[group[-1]]]
        size = np.repeat(count[group], count[group])
        first = np.repeat(np.arange(len(corner)), size)
        offset = np.arange(size.sum()) - np.repeat(np.cumsum(size) - size, size)
        second = np.repeat(np.repeat(start[group] - start[group[0]], count[group]), size) + offset
        own = normal[corner // 3]
        alike = (own[first] * own[second]).sum(axis=1) > np.cos(np.radians(_CREASE_DEG))
        first, second = first[alike], second[alike]
        weighted = own * area[corner // 3, None]
        total[corner] = np.stack(
            [np.bincount(first, weighted[second, k], minlength=len(corner)) for k in range(3)], axis=1
        )
    length = np.linalg.norm(total, axis=1, keepdims=True)
    smooth = np.where(length > 0.0, total / np.maximum(length, 1e-300), np.repeat(normal, 3, axis=0))
    return smooth.reshape(corners.shape).astype(np.float32)


def numbered_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Number the distinct rows of an array ``(N, K)`` of 4-byte values.

    Returns
    -------
    first
        Index of the first occurrence of each distinct row.
    number
        ``(N,)`` number of each row among the distinct ones.
    """
    # Positive and negative zero are one value.
    words = np.ascontiguousarray(rows + np.zeros((), rows.dtype)).view(np.uint32).astype(np.uint64)
    # A random odd multiplier for each column: rows of equal hash are equal but for a chance of about N² / 2⁶⁴.
    factors = np.random.default_rng(0).integers(1, 2**63, size=(2, words.shape[1]), dtype=np.uint64) * np.uint64(2)
    key = (words * (factors[0] + np.uint64(1))).sum(axis=1, dtype=np.uint64)
    key ^= ((words ^ (words >> np.uint64(13))) * (factors[1] + np.uint64(1))).sum(axis=1, dtype=np.uint64) >> np.uint64(
        7
    )
    _, first, number = np.unique(key, return_index=True, return_inverse=True)
    return first, number.reshape(-1)
