"""Quality measures of a UV atlas: texel size and stretch on the surface, signed areas in UV, fold-over test."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.declaration import InputError
from seasonscapes.terrain.surface import Terrain
from seasonscapes.terrain.texels import changes_on_faces, face_corners

_CHUNK_FACES = 500_000


@dataclass(frozen=True)
class Atlas:
    """Size and surface resolution of a UV atlas.

    Parameters
    ----------
    kind
        ``planar``, ``relief`` or ``xatlas``.
    width_px, height_px
        Size in texels.
    texel_p1_m, texel_p50_m, texel_p99_m
        Square root of the area that one texel covers **on the surface** (not in horizontal projection), area-weighted
        percentiles [m].
    stretch_p99_m
        Larger singular value of the map from texels to metres, area-weighted 99th percentile [m].
    utilization
        Fraction of the texture that the charts cover, in [0, 1].
    charts
        Number of charts.
    """

    kind: str
    width_px: int
    height_px: int
    texel_p1_m: float
    texel_p50_m: float
    texel_p99_m: float
    stretch_p99_m: float
    utilization: float
    charts: int = 1


def planar_uv(vertices: np.ndarray) -> np.ndarray:
    """Compute top-down UV coordinates that map the horizontal bounding box onto the unit square.

    Texels are not square unless the box is.

    Parameters
    ----------
    vertices
        ``(V, 3)`` east-north-up [m].

    Returns
    -------
    numpy.ndarray
        ``(V, 2)`` float32 in [0, 1].
    """
    low, high = vertices[:, :2].min(0).astype(np.float64), vertices[:, :2].max(0).astype(np.float64)
    uv = np.empty((len(vertices), 2), np.float32)
    for axis in (0, 1):
        # In place and in float32 after the subtraction: at 9 M vertices a float64 copy would be 144 MB.
        np.subtract(vertices[:, axis], low[axis], out=uv[:, axis], casting="unsafe")
        uv[:, axis] /= np.float32(high[axis] - low[axis])
    return np.clip(uv, 0.0, 1.0, out=uv)


def texel_grid(terrain: Terrain, texel_m: float | None, max_side_px: int) -> tuple[np.ndarray, float, int, int]:
    """Compute origin, texel size and dimensions of a top-down texture grid with square texels.

    Parameters
    ----------
    terrain
        The surface whose horizontal bounding box the grid covers.
    texel_m
        Texel side [m]; ``None`` for the smallest side that ``max_side_px`` allows.
    max_side_px
        Largest width or height [texels].

    Returns
    -------
    low
        South-west corner ``(2,)`` east, north [m].
    texel_m
        Texel side [m].
    width, height
        Size of the grid [texels].

    Raises
    ------
    InputError
        The grid needs more than ``max_side_px`` texels along a side.
    ValueError
        ``texel_m`` is not positive.
    """
    low = terrain.vertices[:, :2].min(0).astype(np.float64)
    extent = terrain.vertices[:, :2].max(0).astype(np.float64) - low
    if texel_m is None:
        texel_m = float(extent.max()) / max_side_px
    if not texel_m > 0.0:
        raise ValueError(f"texel_m: got {texel_m}, expected a positive size")
    # The tolerance keeps rounding errors from adding a row or column.
    width, height = (max(1, int(np.ceil(side / texel_m - 1e-6))) for side in extent)
    require_side(width, height, texel_m, max_side_px)
    return low, texel_m, width, height


def require_side(width: int, height: int, texel_m: float, max_side_px: int) -> None:
    """Raise `InputError` where an atlas is larger than allowed.

    Parameters
    ----------
    width, height
        Size of the atlas [texels].
    texel_m
        Texel side [m], for the message.
    max_side_px
        Largest width or height [texels].

    Raises
    ------
    InputError
        The larger side exceeds ``max_side_px``.
    """
    if max(width, height) > max_side_px:
        coarser = texel_m * max(width, height) / max_side_px
        raise InputError(
            "atlas",
            f"texels of {texel_m:g} m need {width} × {height} of them",
            expected=f"at most {max_side_px} along a side",
            cure=f"use texels of {coarser:.3g} m or a larger limit",
        )


def measure_atlas(terrain: Terrain, kind: str, width_px: int, height_px: int, *, charts: int = 1) -> Atlas:
    """Measure an atlas by the singular values of each face's affine map from texels to metres.

    After Sander et al. 2001, "Texture mapping progressive meshes", doi:10.1145/383259.383307.

    Parameters
    ----------
    terrain
        Surface with the UV coordinates to measure.
    kind
        Name of the parametrisation, copied into the result.
    width_px, height_px
        Size of the texture [texels].
    charts
        Number of charts, copied into the result.

    Returns
    -------
    Atlas
        Size, texel sizes [m] and utilisation.
    """
    longer, shorter, area = singular_values(terrain, width_px, height_px)
    texel = np.sqrt(longer * shorter)
    p1, p50, p99 = _weighted_percentiles(texel, area, (1.0, 50.0, 99.0))
    (stretch,) = _weighted_percentiles(longer, area, (99.0,))
    used = float(np.abs(signed_uv_areas(terrain.uv, terrain.faces)).sum())
    return Atlas(kind, width_px, height_px, p1, p50, p99, stretch, used, charts)


def singular_values(terrain: Terrain, width_px: int, height_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compute the singular values of each face's affine map from texels to metres.

    Parameters
    ----------
    terrain
        Surface with UV coordinates.
    width_px, height_px
        Size of the texture [texels].

    Returns
    -------
    longer, shorter
        Singular values ``(F,)``: major and minor extent of one texel on the surface [m].
    area
        Surface area ``(F,)`` of each face [m²].
    """
    longer, shorter, area = (np.empty(len(terrain.faces)) for _ in range(3))
    scale = np.array([width_px, height_px], np.float64)
    for start in range(0, len(terrain.faces), _CHUNK_FACES):
        part = slice(start, start + _CHUNK_FACES)
        faces = terrain.faces[part]
        corners = face_corners(faces)
        (x1, x2), (y1, y2), (z1, z2) = space = [changes_on_faces(axis, corners)[1:] for axis in terrain.vertices.T]
        (_, u1, u2), (_, v1, v2) = (changes_on_faces(axis, corners) for axis in terrain.uv.T)
        u1, u2, v1, v2 = u1 * scale[0], u2 * scale[0], v1 * scale[1], v2 * scale[1]
        determinant = u1 * v2 - v1 * u2
        area[part] = 0.5 * np.sqrt((y1 * z2 - z1 * y2) ** 2 + (z1 * x2 - x1 * z2) ** 2 + (x1 * y2 - y1 * x2) ** 2)
        with np.errstate(divide="ignore", invalid="ignore"):
            a = b = c = np.zeros(len(faces))
            for e1, e2 in space:
                s, t = (e1 * v2 - e2 * v1) / determinant, (e2 * u1 - e1 * u2) / determinant
                a, b, c = a + s * s, b + s * t, c + t * t
            root = np.sqrt((a - c) ** 2 + 4.0 * b * b)
            longer[part] = np.sqrt((a + c + root) / 2.0)
            shorter[part] = 2.0 * area[part] / np.abs(determinant) / longer[part]
    return longer, shorter, area


def _weighted_percentiles(values: np.ndarray, weights: np.ndarray, percents: tuple[float, ...]) -> tuple[float, ...]:
    order = np.argsort(values)
    rank = np.cumsum(weights[order])
    index = np.searchsorted(rank, np.asarray(percents) / 100.0 * rank[-1])
    return tuple(float(values[order[min(i, len(order) - 1)]]) for i in index)


def signed_uv_areas(uv: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Compute the signed area of each face in UV space.

    Parameters
    ----------
    uv
        ``(V, 2)`` texture coordinates.
    faces
        ``(F, 3)`` vertex indices.

    Returns
    -------
    numpy.ndarray
        ``(F,)`` float64, negative for faces of reversed orientation.
    """
    areas = np.empty(len(faces))
    for start in range(0, len(faces), _CHUNK_FACES):
        corners = uv[faces[start : start + _CHUNK_FACES]].astype(np.float64)
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        areas[start : start + len(corners)] = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return areas


def require_unfolded(terrain: Terrain, kind: str, *, cure: str) -> None:
    """Raise `InputError` where the parametrisation folds over, so that two surface points would share a texel.

    Parameters
    ----------
    terrain
        Surface with the UV coordinates to test.
    kind
        Name of the atlas, for the message.
    cure
        Advice for the message.

    Raises
    ------
    InputError
        A face has zero or negative area in UV.
    """
    folded = int(np.count_nonzero(~(signed_uv_areas(terrain.uv, terrain.faces) > 0.0)))
    if folded:
        raise InputError(f"atlas {kind}", f"{folded} of {len(terrain.faces)} faces fold over in UV space", cure=cure)
