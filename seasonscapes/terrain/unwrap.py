"""UV atlases: the ways to lay a surface out flat in a texture."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from seasonscapes.terrain.atlas import Atlas, measure_atlas, plan_size, require_unfolded
from seasonscapes.terrain.charts import chart_atlas
from seasonscapes.terrain.relief import relief_atlas
from seasonscapes.terrain.surface import Terrain

DEFAULT_MAX_SIDE_PX = 4096


def unwrap(
    terrain: Terrain, *, kind: str = "planar", texel_m: float | None = None, max_side_px: int = DEFAULT_MAX_SIDE_PX
) -> tuple[Terrain, Atlas]:
    """Lay a surface out flat, so that no two of its places share a texel.

    Parameters
    ----------
    kind
        A name in `ATLASES`: ``planar`` (top-down, exact and free of charge), ``relief`` (top-down, but cliffs get
        their texels), ``xatlas`` (charts, as in the paper; also for surfaces that are not heights over a plan).
    texel_m
        Side of a texel [m]: in plan for ``planar`` and ``relief``, on the surface for ``xatlas``. Left out: as small
        as ``max_side_px`` lets it be.
    max_side_px
        Largest width or height of the atlas [texels].

    Returns
    -------
    terrain, atlas
        The terrain with new ``uv`` (for ``xatlas`` also new vertices, split along seams) and the atlas's size.

    Raises
    ------
    InputError
        The surface folds over in plan, has too many faces for this kind, or the texels do not fit.
    """
    if kind not in ATLASES:
        raise ValueError(f"kind: got {kind!r}, expected one of {', '.join(ATLASES)}")
    return ATLASES[kind](terrain, texel_m, max_side_px)


def planar_atlas(terrain: Terrain, texel_m: float | None, max_side_px: int) -> tuple[Terrain, Atlas]:
    """Top-down: an exact affine map of east and north, square texels, north upwards in v."""
    low, texel_m, width, height = plan_size(terrain, texel_m, max_side_px)
    uv = ((terrain.vertices[:, :2] - low) / (texel_m * np.array([width, height]))).astype(np.float32)
    terrain = replace(terrain, uv=uv)
    require_unfolded(terrain, "planar", cure="take the xatlas atlas; or an origin nearer to the terrain")
    return terrain, measure_atlas(terrain, "planar", width, height)


ATLASES: dict[str, Callable[[Terrain, float | None, int], tuple[Terrain, Atlas]]] = {
    "planar": planar_atlas,
    "relief": relief_atlas,
    "xatlas": chart_atlas,
}
