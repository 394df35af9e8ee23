"""Chart atlas as in the SeasonScapes paper: segmentation, flattening and packing of charts with xatlas."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from seasonscapes.declaration import InputError
from seasonscapes.terrain.atlas import Atlas, measure_atlas, require_side, signed_uv_areas
from seasonscapes.terrain.surface import Terrain

# Chart growing is superlinear in the number of faces: 100,000 faces take minutes as one mesh, seconds in blocks.
_BLOCK_FACES = 1_000
# Empty texels around each chart, so that the gutters of two charts do not overlap.
PADDING_PX = 4
MAX_FACES = 2_500_000


def chart_atlas(terrain: Terrain, texel_m: float | None, max_side_px: int) -> tuple[Terrain, Atlas]:
    """Segment a surface into charts, flatten and pack them; vertices along seams are duplicated.

    The surface is passed to xatlas in square blocks of about a thousand faces, so that the run time is linear in the
    number of faces; block borders become seams.

    Parameters
    ----------
    terrain
        The surface; its UV coordinates are not used.
    texel_m
        Texel side on the surface [m]; ``None`` for the smallest side that ``max_side_px`` allows.
    max_side_px
        Largest width or height of the atlas [texels].

    Returns
    -------
    terrain
        The surface with chart UV coordinates and duplicated seam vertices.
    atlas
        Size and resolution of the atlas.

    Raises
    ------
    InputError
        More faces than `MAX_FACES`, or texels of ``texel_m`` do not fit into ``max_side_px``.
    """
    import xatlas

    if len(terrain.faces) > MAX_FACES:
        raise InputError(
            "atlas xatlas",
            f"too many faces to cut into charts: {len(terrain.faces)}",
            expected=f"at most {MAX_FACES}",
            cure="use the adaptive mesher with a larger error bound, or the planar atlas",
        )
    builder, blocks = xatlas.Atlas(), list(_blocks(terrain))
    for faces in blocks:
        used, local = np.unique(faces, return_inverse=True)
        builder.add_mesh(terrain.vertices[used], local.reshape(-1, 3).astype(np.uint32))
    packing = xatlas.PackOptions()
    packing.padding, packing.bilinear = PADDING_PX, True
    # xatlas rotates charts by swapping u and v, which mirrors half of them.
    packing.rotate_charts = False
    if texel_m is None:
        packing.resolution = max_side_px
    else:
        packing.texels_per_unit = 1.0 / texel_m
    builder.generate(xatlas.ChartOptions(), packing)
    width, height = int(builder.width), int(builder.height)
    if texel_m is None:
        # Packing can exceed the requested resolution; UV is relative, so the texture can be scaled down.
        shrink = min(1.0, max_side_px / max(width, height))
        width, height = int(width * shrink), int(height * shrink)
    else:
        require_side(width, height, texel_m, max_side_px)
    terrain = _merge_blocks(terrain, builder, blocks)
    return terrain, measure_atlas(terrain, "xatlas", width, height, charts=int(builder.chart_count))


def _blocks(terrain: Terrain) -> Iterator[np.ndarray]:
    """Yield the faces ``(n, 3)`` of each square block of the horizontal plane."""
    centre = terrain.vertices[terrain.faces, :2].mean(axis=1)
    low, extent = centre.min(0), np.maximum(np.ptp(centre, axis=0), 1e-6)
    side = np.sqrt(extent.prod() * _BLOCK_FACES / len(terrain.faces))
    columns, rows = np.maximum(np.round(extent / side), 1).astype(int)
    cell = np.minimum((centre - low) / extent * [columns, rows], [columns - 1, rows - 1]).astype(int)
    label = cell[:, 1] * columns + cell[:, 0]
    order = np.argsort(label, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        yield terrain.faces[part]


def _merge_blocks(terrain: Terrain, builder: Any, blocks: Sequence[np.ndarray]) -> Terrain:
    """Merge the blocks that xatlas has split along seams; a few small charts remain mirrored."""
    vertices, faces, uv, first = [], [], [], 0
    for number, block in enumerate(blocks):
        original, local_faces, local_uv = builder[number]
        vertices.append(terrain.vertices[np.unique(block)[original]])
        faces.append(local_faces.astype(np.uint32) + np.uint32(first))
        uv.append(local_uv)
        first += len(original)
    faces, uv = np.concatenate(faces), np.concatenate(uv).astype(np.float32)
    if np.median(signed_uv_areas(uv, faces)) < 0.0:
        # xatlas has v along image rows; here v points upwards.
        uv[:, 1] = 1.0 - uv[:, 1]
    return Terrain(np.concatenate(vertices), faces, uv, terrain.frame, terrain.surface)
