"""What every UV atlas is measured by: texel sizes on the surface, and that no two places share a texel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.declaration import InputError
from seasonscapes.terrain.surface import Terrain

_CHUNK_FACES = 500_000


@dataclass(frozen=True)
class Atlas:
    """The size of a texture for a terrain and how finely it resolves the surface.

    Parameters
    ----------
    kind
        ``planar``, ``relief`` or ``xatlas``.
    width_px, height_px
        Size in texels.
    texel_p1_m, texel_p50_m, texel_p99_m
        Side of a square with the area that one texel covers **on the surface** (not in plan), percentiles over the
        surface's area [m].
    stretch_p99_m
        The longer extent of a texel on the surface, 99th percentile [m].
    utilization
        Share of the texels that the surface uses.
    charts
        Number of connected pieces.
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
    """Top-down UV ``(V, 2)`` float32 that fills [0, 1] with the bounding box of the plan (not square texels)."""
    low, high = vertices[:, :2].min(0).astype(np.float64), vertices[:, :2].max(0).astype(np.float64)
    uv = np.empty((len(vertices), 2), np.float32)
    for axis in (0, 1):
        # In place and in float32 after the subtraction: at 9 M vertices a float64 copy would be 144 MB.
        np.subtract(vertices[:, axis], low[axis], out=uv[:, axis], casting="unsafe")
        uv[:, axis] /= np.float32(high[axis] - low[axis])
    return np.clip(uv, 0.0, 1.0, out=uv)


def plan_size(terrain: Terrain, texel_m: float | None, max_side_px: int) -> tuple[np.ndarray, float, int, int]:
    """South-west corner ``(2,)`` [m], texel side [m], width and height [texels] of a plan with square texels.

    Raises
    ------
    InputError
        ``texel_m`` asks for more than ``max_side_px``.
    """
    low = terrain.vertices[:, :2].min(0).astype(np.float64)
    extent = terrain.vertices[:, :2].max(0).astype(np.float64) - low
    if texel_m is None:
        texel_m = float(extent.max()) / max_side_px
    if not texel_m > 0.0:
        raise ValueError(f"texel_m: got {texel_m}, expected a positive size")
    # A hair less than a whole texel past the edge is a rounding error, not a reason for one more row.
    width, height = (max(1, int(np.ceil(side / texel_m - 1e-6))) for side in extent)
    require_side(width, height, texel_m, max_side_px)
    return low, texel_m, width, height


def require_side(width: int, height: int, texel_m: float, max_side_px: int) -> None:
    """`InputError` where an atlas would be larger than allowed."""
    if max(width, height) > max_side_px:
        coarser = texel_m * max(width, height) / max_side_px
        raise InputError(
            "atlas",
            f"texels of {texel_m:g} m need {width} × {height} of them",
            expected=f"at most {max_side_px} along a side",
            cure=f"take texels of {coarser:.3g} m or a larger limit",
        )


def measure_atlas(terrain: Terrain, kind: str, width_px: int, height_px: int, *, charts: int = 1) -> Atlas:
    """Texel sizes on the surface from the singular values of each face's map from texels to metres.

    After Sander et al. 2001, "Texture mapping progressive meshes", doi:10.1145/383259.383307.
    """
    longer, shorter, area = singular_values(terrain, width_px, height_px)
    texel = np.sqrt(longer * shorter)
    p1, p50, p99 = _weighted_percentiles(texel, area, (1.0, 50.0, 99.0))
    (stretch,) = _weighted_percentiles(longer, area, (99.0,))
    used = float(np.abs(signed_uv_areas(terrain.uv, terrain.faces)).sum())
    return Atlas(kind, width_px, height_px, p1, p50, p99, stretch, used, charts)


def singular_values(terrain: Terrain, width_px: int, height_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Longer and shorter extent of a texel on each face [m] and the face's area [m²], each ``(F,)``."""
    longer, shorter, area = (np.empty(len(terrain.faces)) for _ in range(3))
    scale = np.array([width_px, height_px], np.float64)
    for start in range(0, len(terrain.faces), _CHUNK_FACES):
        part = slice(start, start + _CHUNK_FACES)
        faces = terrain.faces[part]
        p = terrain.vertices[faces].astype(np.float64)
        t = terrain.uv[faces].astype(np.float64) * scale
        e1, e2, t1, t2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0], t[:, 1] - t[:, 0], t[:, 2] - t[:, 0]
        determinant = t1[:, 0] * t2[:, 1] - t1[:, 1] * t2[:, 0]
        area[part] = 0.5 * np.linalg.norm(np.cross(e1, e2), axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = (e1 * t2[:, 1:] - e2 * t1[:, 1:]) / determinant[:, None]
            t = (e2 * t1[:, :1] - e1 * t2[:, :1]) / determinant[:, None]
            a, b, c = (s * s).sum(1), (s * t).sum(1), (t * t).sum(1)
            root = np.sqrt((a - c) ** 2 + 4.0 * b * b)
            longer[part] = np.sqrt((a + c + root) / 2.0)
            shorter[part] = 2.0 * area[part] / np.abs(determinant) / longer[part]
    return longer, shorter, area


def _weighted_percentiles(values: np.ndarray, weights: np.ndarray, percents) -> tuple[float, ...]:
    order = np.argsort(values)
    rank = np.cumsum(weights[order])
    index = np.searchsorted(rank, np.asarray(percents) / 100.0 * rank[-1])
    return tuple(float(values[order[min(i, len(order) - 1)]]) for i in index)


def signed_uv_areas(uv: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Areas ``(F,)`` of the faces in UV, negative where a face is turned over."""
    areas = np.empty(len(faces))
    for start in range(0, len(faces), _CHUNK_FACES):
        corners = uv[faces[start : start + _CHUNK_FACES]].astype(np.float64)
        a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
        areas[start : start + len(corners)] = 0.5 * (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])
    return areas


def require_unfolded(terrain: Terrain, kind: str, *, cure: str) -> None:
    """`InputError` where a face is turned over or has no area in UV: two places would then share texels."""
    folded = int(np.count_nonzero(~(signed_uv_areas(terrain.uv, terrain.faces) > 0.0)))
    if folded:
        raise InputError(f"atlas {kind}", f"{folded} of {len(terrain.faces)} faces fold over in the plan", cure=cure)
