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
# Side of a piece of ground that becomes one chart [texels]: smaller ones waste texels at their borders, larger ones are
# less like the plane onto which they are laid.
_CHART_PX = 80
# Empty texels between charts; bilinear look-ups read one beyond a chart's border.
PADDING_PX = 2
# So many charts are packed by trying all places; more by a quicker search, which leaves larger gaps.
_BRUTE_CHARTS = 1_000
# Smallest cosine between a face and the plane that it is laid onto: of the mean plane, and of any.
_MIN_COSINE, _LEAST_COSINE = 0.15, 0.05
MAX_FACES = 2_500_000


def chart_atlas(terrain: Terrain, texel_m: float | None, max_side_px: int) -> tuple[Terrain, Atlas]:
    """Segment a surface into charts, flatten and pack them; vertices along seams are duplicated.

    The surface is cut into square blocks, whose borders become seams. A block whose faces all look to the same side of
    its mean plane, or upwards, is one chart, laid onto that plane, or from above. Others (walls, overhangs) are cut into blocks of about a thousand
    faces, where xatlas grows and flattens charts, so that the run time is linear in the number of faces. xatlas packs all.

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
    builder, blocks = xatlas.Atlas(), []
    for faces, flat in _charts_and_blocks(terrain, texel_m, max_side_px):
        used, local = np.unique(faces, return_inverse=True)
        local = local.reshape(-1, 3).astype(np.uint32)
        builder.add_mesh(terrain.vertices[used], local, uvs=None if flat is None else flat)
        blocks.append(faces)
    packing = xatlas.PackOptions()
    packing.padding, packing.bilinear = PADDING_PX, True
    # xatlas rotates charts by swapping u and v, which mirrors half of them.
    packing.rotate_charts = False
    packing.bruteForce = len(blocks) <= _BRUTE_CHARTS
    if texel_m is None:
        packing.resolution = max_side_px
    else:
        packing.texels_per_unit = 1.0 / texel_m
    charts = xatlas.ChartOptions()
    charts.use_input_mesh_uvs = True
    builder.generate(charts, packing)
    width, height = int(builder.width), int(builder.height)
    if texel_m is None:
        # Packing can exceed the requested resolution; UV is relative, so the texture can be scaled down.
        shrink = min(1.0, max_side_px / max(width, height))
        width, height = int(width * shrink), int(height * shrink)
    else:
        require_side(width, height, texel_m, max_side_px)
    terrain = _merge_blocks(terrain, builder, blocks)
    return terrain, measure_atlas(terrain, "xatlas", width, height, charts=int(builder.chart_count))


def _charts_and_blocks(
    terrain: Terrain, texel_m: float | None, max_side_px: int
) -> Iterator[tuple[np.ndarray, np.ndarray | None]]:
    """Yield faces ``(n, 3)`` and the chart ``(V, 2)`` [m] of their vertices in order, or ``None`` where xatlas makes it."""
    extent = np.ptp(terrain.vertices[:, :2].astype(np.float64), axis=0)
    side_m = _CHART_PX * (texel_m or float(extent.max()) / max_side_px)
    for faces in _blocks(terrain, terrain.faces, side_m):
        flat = _laid_flat(terrain.vertices, faces)
        if flat is not None:
            yield faces, flat
            continue
        area_m2 = float(np.prod(np.maximum(np.ptp(terrain.vertices[np.unique(faces), :2], axis=0), 1e-3)))
        for part in _blocks(terrain, faces, float(np.sqrt(area_m2 * _BLOCK_FACES / len(faces)))):
            yield part, None


def _laid_flat(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray | None:
    """A block's vertices in order on its mean plane ``(V, 2)`` float32 [m]; ``None`` where it folds or falls apart."""
    used, local = np.unique(faces, return_inverse=True)
    local, points = local.reshape(-1, 3), vertices[used].astype(np.float64)
    a, b, c = (points[local[:, k]] for k in range(3))
    areas = np.cross(b - a, c - a)
    sizes = np.maximum(np.linalg.norm(areas, axis=1), 1e-300)
    mean = areas.sum(axis=0)
    candidates = (mean / max(float(np.linalg.norm(mean)), 1e-300), np.array([0.0, 0.0, 1.0]))
    # Its mean plane is stretched least, the horizontal one never folds where the surface is a height field.
    cosines = [float(np.min(areas @ up / sizes)) for up in candidates]
    chosen = 0 if cosines[0] >= _MIN_COSINE else int(np.argmax(cosines))
    # A face seen almost from its edge would have no texels, and one seen from behind would fold.
    if cosines[chosen] < _LEAST_COSINE or _pieces(local, len(used)) != 1:
        return None
    up = candidates[chosen]
    east = np.cross([0.0, 1.0, 0.0] if abs(up[1]) < 0.9 else [0.0, 0.0, 1.0], up)
    east /= np.linalg.norm(east)
    flat = (points - points[0]) @ np.stack([east, np.cross(up, east)], axis=1)
    return flat.astype(np.float32)


def _pieces(faces: np.ndarray, vertex_count: int) -> int:
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    # Taken in here: every command that knows a place would import it.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(edges), bool), edges.T), shape=(vertex_count, vertex_count))
    return int(connected_components(graph, directed=False)[0])


def _blocks(terrain: Terrain, faces: np.ndarray, side_m: float) -> Iterator[np.ndarray]:
    """Yield the faces ``(n, 3)`` of each square block of the horizontal plane."""
    centre = terrain.vertices[faces, :2].mean(axis=1)
    low, extent = centre.min(0), np.maximum(np.ptp(centre, axis=0), 1e-6)
    columns, rows = np.maximum(np.round(extent / side_m), 1).astype(int)
    cell = np.minimum((centre - low) / extent * [columns, rows], [columns - 1, rows - 1]).astype(int)
    label = cell[:, 1] * columns + cell[:, 0]
    order = np.argsort(label, kind="stable")
    for part in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
        yield faces[part]


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
