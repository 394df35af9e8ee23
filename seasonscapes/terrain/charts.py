"""The chart atlas of the SeasonScapes paper: the surface cut into pieces, each laid flat, all packed by xatlas."""

from __future__ import annotations

import numpy as np

from seasonscapes.declaration import InputError
from seasonscapes.terrain.atlas import Atlas, measure_atlas, require_side, signed_uv_areas
from seasonscapes.terrain.surface import Terrain

# Growing charts costs more than linearly in faces: 100,000 in one piece take minutes, in blocks of this many seconds.
_BLOCK_FACES = 1_000
# Empty texels around each chart, so that its gutter meets no other chart's.
PADDING_PX = 4
MAX_FACES = 2_500_000


def chart_atlas(terrain: Terrain, texel_m: float | None, max_side_px: int) -> tuple[Terrain, Atlas]:
    """Cut into charts, flatten and pack them; vertices along seams are doubled.

    The surface is handed over in square blocks of about a thousand faces, so that the time grows in proportion to
    its size; blocks are seams.

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
            cure="take the adaptive mesher with a larger error bound, or the planar atlas",
        )
    builder, blocks = xatlas.Atlas(), list(_blocks(terrain))
    for faces in blocks:
        used, local = np.unique(faces, return_inverse=True)
        builder.add_mesh(terrain.vertices[used], local.reshape(-1, 3).astype(np.uint32))
    packing = xatlas.PackOptions()
    packing.padding, packing.bilinear = PADDING_PX, True
    # Turning charts by swapping u and v would mirror half of them.
    packing.rotate_charts = False
    if texel_m is None:
        packing.resolution = max_side_px
    else:
        packing.texels_per_unit = 1.0 / texel_m
    builder.generate(xatlas.ChartOptions(), packing)
    width, height = int(builder.width), int(builder.height)
    if texel_m is None:
        # The resolution is an estimate that packing can overshoot; UV scales, so a smaller texture holds it as well.
        shrink = min(1.0, max_side_px / max(width, height))
        width, height = int(width * shrink), int(height * shrink)
    else:
        require_side(width, height, texel_m, max_side_px)
    terrain = _assembled(terrain, builder, blocks)
    return terrain, measure_atlas(terrain, "xatlas", width, height, charts=int(builder.chart_count))


def _blocks(terrain: Terrain):
    """Faces ``(n, 3)`` of each square of the plan."""
    centre = terrain.vertices[terrain.faces, :2].mean(axis=1)
    low, extent = centre.min(0), np.maximum(np.ptp(centre, axis=0), 1e-6)
    side = np.sqrt(extent.prod() * _BLOCK_FACES / len(terrain.faces))
    columns, rows = np.maximum(np.round(extent / side), 1).astype(int)
    cell = np.minimum((centre - low) / extent * [columns, rows], [columns - 1, rows - 1]).astype(int)
    label = cell[:, 1] * columns + cell[:, 0]
    order = np.argsort(label, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        yield terrain.faces[part]


def _assembled(terrain: Terrain, builder, blocks) -> Terrain:
    """One terrain from the blocks that xatlas split along its seams; a few small charts lie mirrored."""
    vertices, faces, uv, first = [], [], [], 0
    for number, block in enumerate(blocks):
        original, local_faces, local_uv = builder[number]
        vertices.append(terrain.vertices[np.unique(block)[original]])
        faces.append(local_faces.astype(np.uint32) + np.uint32(first))
        uv.append(local_uv)
        first += len(original)
    faces, uv = np.concatenate(faces), np.concatenate(uv).astype(np.float32)
    if np.median(signed_uv_areas(uv, faces)) < 0.0:
        # Image rows run down, v runs up.
        uv[:, 1] = 1.0 - uv[:, 1]
    return Terrain(np.concatenate(vertices), faces, uv, terrain.frame)
