"""UV atlases: how the surface is laid out flat in a texture, and how large a texel is on the ground."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.terrain.surface import Terrain

DEFAULT_MAX_SIDE_PX = 4096


@dataclass(frozen=True)
class Atlas:
    """The size of a texture for a terrain and how finely it resolves the surface.

    Parameters
    ----------
    kind
        A name in `ATLASES`.
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
    return ((vertices[:, :2] - low) / (high - low)).astype(np.float32)


def unwrap(terrain: Terrain, *, kind: str = "planar", texel_m: float | None = None,
           max_side_px: int = DEFAULT_MAX_SIDE_PX) -> tuple[Terrain, Atlas]:  # fmt: skip
    """Lay a surface out flat.

    Parameters
    ----------
    kind
        A name in `ATLASES`.
    texel_m
        Side of a texel in plan [m]; left out: as small as ``max_side_px`` lets it be.
    max_side_px
        Largest width or height of the atlas [texels].

    Returns
    -------
    terrain, atlas
        The terrain with new ``uv`` (for ``xatlas`` also new vertices, split along seams) and the atlas's size.
    """
    if kind not in ATLASES:
        raise ValueError(f"kind: got {kind!r}, expected one of {', '.join(ATLASES)}")
    return ATLASES[kind](terrain, texel_m, max_side_px)


def _plan_size(terrain: Terrain, texel_m: float | None, max_side_px: int) -> tuple[np.ndarray, float, int, int]:
    """South-west corner ``(2,)`` [m], texel side [m], width and height [texels] of a plan with square texels."""
    low = terrain.vertices[:, :2].min(0).astype(np.float64)
    extent = terrain.vertices[:, :2].max(0).astype(np.float64) - low
    if texel_m is None:
        texel_m = float(extent.max()) / max_side_px
    # The last texel may reach past the surface; a hair less would cost a whole row for a rounding error.
    width, height = (max(1, int(np.ceil(side / texel_m - 1e-6))) for side in extent)
    if max(width, height) > max_side_px:
        raise ValueError(f"texel_m: {texel_m} m needs {width} × {height} texels, more than max_side_px {max_side_px}")
    return low, texel_m, width, height


def _planar(terrain: Terrain, texel_m: float | None, max_side_px: int) -> tuple[Terrain, Atlas]:
    """Top-down: an exact affine map of east and north, square texels, north upwards in v."""
    low, texel_m, width, height = _plan_size(terrain, texel_m, max_side_px)
    uv = ((terrain.vertices[:, :2] - low) / (texel_m * np.array([width, height]))).astype(np.float32)
    terrain = replace(terrain, uv=uv)
    return terrain, measure_atlas(terrain, "planar", width, height)


def measure_atlas(terrain: Terrain, kind: str, width_px: int, height_px: int, *, charts: int = 1) -> Atlas:
    """Texel sizes on the surface from the singular values of each face's map from texels to metres.

    After Sander et al. 2001, "Texture mapping progressive meshes", doi:10.1145/383259.383307.
    """
    longer, shorter, area = _singular_values(terrain, width_px, height_px)
    texel = np.sqrt(longer * shorter)
    p1, p50, p99 = _weighted_percentiles(texel, area, (1.0, 50.0, 99.0))
    (stretch,) = _weighted_percentiles(longer, area, (99.0,))
    used = float(np.sum(area / np.maximum(texel, 1e-12) ** 2)) / (width_px * height_px)
    return Atlas(kind, width_px, height_px, p1, p50, p99, stretch, used, charts)


def _singular_values(terrain: Terrain, width_px: int, height_px: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Longer and shorter extent of a texel on each face [m] and the face's area [m²], each ``(F,)``."""
    longer, shorter, area = (np.empty(len(terrain.faces)) for _ in range(3))
    scale = np.array([width_px, height_px], np.float64)
    for start in range(0, len(terrain.faces), 1_000_000):
        part = slice(start, start + 1_000_000)
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


ATLASES: dict[str, Callable[[Terrain, float | None, int], tuple[Terrain, Atlas]]] = {"planar": _planar}
