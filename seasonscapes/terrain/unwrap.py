"""UV parametrisation of a terrain surface: top-down, relief or chart atlas."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from seasonscapes.terrain.atlas import Atlas, measure_atlas, require_unfolded, texel_grid
from seasonscapes.terrain.charts import chart_atlas
from seasonscapes.terrain.relief import relief_atlas
from seasonscapes.terrain.surface import Terrain

DEFAULT_MAX_SIDE_PX = 4096


def unwrap(
    terrain: Terrain, *, kind: str = "planar", texel_m: float | None = None, max_side_px: int = DEFAULT_MAX_SIDE_PX
) -> tuple[Terrain, Atlas]:
    """Compute an injective UV parametrisation of a surface.

    Parameters
    ----------
    terrain
        The surface; its UV coordinates are not used.
    kind
        A name in `ATLASES`: ``planar`` (affine in east and north), ``relief`` (onto a rectangle, with texels
        concentrated on steep ground), ``xatlas`` (charts, as in the paper; also for surfaces that are not height
        fields).
    texel_m
        Texel side [m]: in horizontal projection for ``planar`` and ``relief``, on the surface for ``xatlas``. ``None``
        for the smallest side that ``max_side_px`` allows.
    max_side_px
        Largest width or height of the atlas [texels].

    Returns
    -------
    terrain
        The surface with new ``uv``; for ``xatlas`` vertices are duplicated along seams.
    atlas
        Size and resolution of the atlas.

    Raises
    ------
    InputError
        The parametrisation folds over, the surface has too many faces for this kind, or the atlas exceeds
        ``max_side_px``.
    ValueError
        Unknown ``kind``.
    """
    if kind not in ATLASES:
        raise ValueError(f"kind: got {kind!r}, expected one of {', '.join(ATLASES)}")
    return ATLASES[kind](terrain, texel_m, max_side_px)


def planar_atlas(terrain: Terrain, texel_m: float | None, max_side_px: int) -> tuple[Terrain, Atlas]:
    """Parametrise a height field by an affine map of east and north (square texels, v to the north).

    Parameters
    ----------
    terrain
        The surface; its UV coordinates are not used.
    texel_m
        Texel side [m]; ``None`` for the smallest side that ``max_side_px`` allows.
    max_side_px
        Largest width or height of the atlas [texels].

    Returns
    -------
    terrain
        The surface with new ``uv``.
    atlas
        Size and resolution of the atlas.

    Raises
    ------
    InputError
        The surface folds over in horizontal projection, or the atlas exceeds ``max_side_px``.
    """
    low, texel_m, width, height = texel_grid(terrain, texel_m, max_side_px)
    uv = ((terrain.vertices[:, :2] - low) / (texel_m * np.array([width, height]))).astype(np.float32)
    terrain = replace(terrain, uv=uv)
    require_unfolded(terrain, "planar", cure="use the xatlas atlas, or an origin nearer to the terrain")
    return terrain, measure_atlas(terrain, "planar", width, height)


ATLASES: dict[str, Callable[[Terrain, float | None, int], tuple[Terrain, Atlas]]] = {
    "planar": planar_atlas,
    "relief": relief_atlas,
    "xatlas": chart_atlas,
}
