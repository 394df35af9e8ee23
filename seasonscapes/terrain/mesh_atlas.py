"""All textures of a mesh side by side in one image, so that the renderer has one mesh with one texture.

Every texture is a tile of that image, texel for texel; nothing is resampled. A tile of vertex colours holds a block of
2 × 2 texels for each face: bilinear interpolation between the centres of three of them is the linear interpolation of
the three vertices, if the fourth continues it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.terrain.surface import Terrain
from seasonscapes.terrain.texels import barycentric, coverage_count, covering_faces
from seasonscapes.terrain.textured_mesh import TexturedMesh, creased_normals, face_normals, numbered_rows

# Texels about each tile that repeat its edge.
_GUTTER = 2
# Texture coordinates may leave the texture by so many texels: the edge continues there.
_OVERSHOOT = 2.0
# The ground reaches this many times the mesh's radius, in rings and sectors of triangles.
_GROUND_RADII, _RINGS, _SECTORS = 60.0, 40, 48


@dataclass(frozen=True)
class Tile:
    """A texture's place in the image: first row and column, and size."""

    row: int
    column: int
    rows: int
    columns: int

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the tile in the image."""
        return slice(self.row, self.row + self.rows), slice(self.column, self.column + self.columns)


@dataclass(frozen=True)
class MeshGround:
    """Ground that a mesh stands on: G triangles with a texture.

    Parameters
    ----------
    position, normal
        ``(G, 3, 3)`` corners in the mesh's east-north-up frame [m], and unit normals there.
    uv
        ``(G, 3, 2)`` texture coordinates in [0, 1]; v points upwards.
    albedo
        ``(R, S, 3)`` texture.
    name
        What reports call it.
    """

    position: np.ndarray
    normal: np.ndarray
    uv: np.ndarray
    albedo: np.ndarray
    name: str


@dataclass(frozen=True)
class _Corners:
    """Corners of F faces.

    Position ``(F, 3, 3)``, column and row in the image ``(F, 3, 2)``, unit normal ``(F, 3, 3)``, tile of each face
    ``(F,)``, and number ``(F, 3)`` of the vertex in the file.
    """

    position: np.ndarray
    xy: np.ndarray
    normal: np.ndarray
    tile: np.ndarray
    point: np.ndarray

    def __getitem__(self, key: np.ndarray) -> _Corners:
        return _Corners(*(getattr(self, name)[key] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class MeshAtlas:
    """A mesh with one image that holds all its textures.

    Parameters
    ----------
    mesh
        The mesh.
    terrain
        Its triangles with texture coordinates in the image, without degenerate ones; the ground comes last.
    shape
        Rows R and columns S of the image.
    tiles
        Of each texture, then of the uniform colours of parts without texture, then of the ground.
    vertex_blocks
        Of each texture of vertex colours: ``(K, 3)`` vertices of the face of each block, in order; else ``None``.
    face
        ``(R, S)`` int32 face of each texel, −1 off the surface. Of the texels of a vertex one has its face, the others
        have −1.
    weights
        ``(R, S, 3)`` float32 barycentric coordinates of each texel in its face.
    chart
        ``(R, S)`` int32 charts, −1 off the surface: neighbouring texels of one chart adjoin on the surface.
    fixed
        Tiles that are no texture of the mesh: index among ``tiles`` and colour ``(3,)``, or that of each texel.
    notes
        What was found that may not be meant, one line each.
    """

    mesh: TexturedMesh
    terrain: Terrain
    shape: tuple[int, int]
    tiles: tuple[Tile, ...]
    vertex_blocks: tuple[np.ndarray | None, ...]
    face: np.ndarray
    weights: np.ndarray
    chart: np.ndarray
    fixed: tuple[tuple[int, np.ndarray], ...]
    notes: tuple[str, ...] = ()

    def image(self, textures: list[np.ndarray]) -> np.ndarray:
        """The image ``(R, S, 3)`` of values of each texture, in the shape of its own ``values``."""
        result = np.zeros((*self.shape, 3), np.float32)
        for index, values in enumerate(textures):
            blocks = self.vertex_blocks[index]
            tile = self.tiles[index]
            _paste(result, tile, values if blocks is None else _blocks(values, blocks, tile))
        for index, colour in self.fixed:
            tile = self.tiles[index]
            _paste(result, tile, np.broadcast_to(colour, (tile.rows, tile.columns, 3)))
        return result

    def textures(self, image: np.ndarray) -> list[np.ndarray]:
        """Values of each texture from an image ``(R, S, C)``, as a texture has them."""
        result = []
        for index, texture in enumerate(self.mesh.textures):
            inside = image[self.tiles[index].window]
            blocks = self.vertex_blocks[index]
            if blocks is None:
                result.append(np.ascontiguousarray(inside))
                continue
            values = np.zeros((len(texture.values), 1, image.shape[2]), image.dtype)
            row, column = _block_texels(len(blocks), self.tiles[index])
            values[blocks.ravel(), 0] = inside[row.ravel(), column.ravel()]
            result.append(values)
        return result

    def filled(self, image: np.ndarray, known: np.ndarray) -> np.ndarray:
        """The image with the values of the nearest known texel of its tile where ``known`` ``(R, S)`` is false.

        Of vertex colours each block takes the values of its vertices.
        """
        from scipy.ndimage import distance_transform_edt

        result = image.copy()
        for index in range(len(self.mesh.textures)):
            tile, blocks = self.tiles[index], self.vertex_blocks[index]
            inside, here = result[tile.window], known[tile.window]
            if not here.any():
                continue
            if blocks is not None:
                vertices = np.full((int(blocks.max()) + 1, 1, image.shape[2]), np.nan, image.dtype)
                row, column = (part.ravel() for part in _block_texels(len(blocks), tile))
                given = here[row, column]
                vertices[blocks.ravel()[given], 0] = inside[row[given], column[given]]
                filled = _blocks(np.nan_to_num(vertices), blocks, tile)
                _paste(result, tile, filled)
                continue
            nearest = distance_transform_edt(~here, return_distances=False, return_indices=True)
            assert isinstance(nearest, np.ndarray)
            _paste(result, tile, inside[nearest[0], nearest[1]])
        return result


def mesh_atlas(mesh: TexturedMesh, *, ground: float | MeshGround | None) -> MeshAtlas:
    """Place all textures of a mesh in one image, and the mesh on ground.

    Parameters
    ----------
    mesh
        The mesh.
    ground
        Albedo of level ground at the mesh's lowest point; or other ground; ``None`` for none.

    Returns
    -------
    MeshAtlas
        One mesh with one image.

    Raises
    ------
    InputError
        Where a texture repeats over the surface, or all faces are degenerate.
    """
    colours = [np.asarray(part.colour, np.float32) for part in mesh.parts if part.texture < 0]
    uniform = [np.clip(colour, 0.0, 1.0) for colour in colours]
    sizes, blocks = _tile_sizes(mesh)
    plain = [(2, 2)] * len(uniform)
    if isinstance(ground, MeshGround):
        uniform.append(np.asarray(ground.albedo, np.float32))
        plain.append((ground.albedo.shape[0], ground.albedo.shape[1]))
    elif ground is not None:
        uniform.append(np.full(3, ground, np.float32))
        plain.append((2, 2))
    tiles, shape = _shelves(sizes + plain)
    fixed = tuple((len(sizes) + index, colour) for index, colour in enumerate(uniform))
    corners, notes = _corners(mesh, tiles, len(sizes), blocks)
    for index, texture in enumerate(mesh.textures):
        if len({part.colour for part in mesh.parts if part.texture == index}) > 1:
            notes.append(f"texture {texture.name} is tinted differently by several materials; the last tint is used")
    extent = max(float(np.ptp(corners.position.reshape(-1, 3), axis=0).max()), 1e-30)
    degenerate = face_normals(corners.position)[1] <= 1e-14 * extent**2
    if degenerate.all():
        raise InputError(mesh.path, "all faces are degenerate")
    if degenerate.any():
        notes.append(f"{int(degenerate.sum())} of {len(degenerate)} faces are degenerate and cast no shadow")
    corners = corners[~degenerate]
    notes += _topology_notes(corners.position)
    face, weights, chart, shared = _texels(shape, tiles, blocks, corners)
    if shared:
        notes.append(f"{shared} texels are used by several faces; their light is that of one of them")
    vectors = [corners.position, corners.normal, corners.xy]
    if ground is not None:
        level = not isinstance(ground, MeshGround)
        below = _ground(corners.position, tiles[-1]) if level else _given_ground(ground, tiles[-1])
        vectors = [np.concatenate(pair) for pair in zip(vectors, below, strict=True)]
    rows = np.concatenate(vectors, axis=2).reshape(-1, 8).astype(np.float32)
    first, number = numbered_rows(rows)
    size = np.array([shape[1], shape[0]])
    coordinates = rows[first, 6:].astype(np.float64) / size
    coordinates[:, 1] = 1.0 - coordinates[:, 1]
    terrain = Terrain(
        np.ascontiguousarray(rows[first, :3]),
        number.reshape(-1, 3).astype(np.uint32),
        coordinates.astype(np.float32),
        mesh.frame,
        normals=np.ascontiguousarray(rows[first, 3:6]),
    )
    return MeshAtlas(mesh, terrain, shape, tuple(tiles), tuple(blocks), face, weights, chart, fixed, tuple(notes))


def _tile_sizes(mesh: TexturedMesh) -> tuple[list[tuple[int, int]], list[np.ndarray | None]]:
    """Rows and columns of the tile of each texture, and the faces of vertex colours."""
    sizes, blocks = [], []
    for index, texture in enumerate(mesh.textures):
        if not texture.of_vertices:
            sizes.append((texture.values.shape[0], texture.values.shape[1]))
            blocks.append(None)
            continue
        faces = np.concatenate([part.faces for part in mesh.parts if part.texture == index])
        across = int(np.ceil(np.sqrt(len(faces))))
        sizes.append((2 * -(-len(faces) // across), 2 * across))
        blocks.append(faces)
    return sizes, blocks


def _shelves(sizes: list[tuple[int, int]]) -> tuple[list[Tile], tuple[int, int]]:
    """Tiles of the given rows and columns on shelves of an image, the tallest first, and the image's size."""
    margin = 2 * _GUTTER
    area = sum((rows + margin) * (columns + margin) for rows, columns in sizes)
    width = max(max(columns for _, columns in sizes) + margin, int(np.sqrt(area)))
    tiles: dict[int, Tile] = {}
    top = left = height = 0
    for index in sorted(range(len(sizes)), key=lambda k: -sizes[k][0]):
        rows, columns = sizes[index]
        if left + columns + margin > width:
            top, left, height = top + height, 0, 0
        tiles[index] = Tile(top + _GUTTER, left + _GUTTER, rows, columns)
        left, height = left + columns + margin, max(height, rows + margin)
    return [tiles[index] for index in range(len(sizes))], (top + height, width)


def _paste(image: np.ndarray, tile: Tile, values: np.ndarray) -> None:
    """Write a tile, and repeat its edge in the gutter."""
    around = (slice(tile.row - _GUTTER, tile.row + tile.rows + _GUTTER),)
    around += (slice(tile.column - _GUTTER, tile.column + tile.columns + _GUTTER),)
    image[around] = np.pad(values, ((_GUTTER, _GUTTER), (_GUTTER, _GUTTER), (0, 0)), mode="edge")


def _block_texels(count: int, tile: Tile) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns ``(K, 3)`` in a tile of the three vertices of each block."""
    down, across = np.divmod(np.arange(count), tile.columns // 2)
    return 2 * down[:, None] + np.array([0, 0, 1]), 2 * across[:, None] + np.array([0, 1, 0])


def _blocks(values: np.ndarray, faces: np.ndarray, tile: Tile) -> np.ndarray:
    """Tile ``(R, S, C)`` of vertex values ``(V, 1, C)``."""
    result = np.zeros((tile.rows, tile.columns, values.shape[2]), values.dtype)
    corner = values[faces, 0]
    row, column = _block_texels(len(faces), tile)
    result[row, column] = corner
    result[row[:, 2], column[:, 1]] = corner[:, 1] + corner[:, 2] - corner[:, 0]
    return result


def _corners(
    mesh: TexturedMesh, tiles: list[Tile], textures: int, blocks: list[np.ndarray | None]
) -> tuple[_Corners, list[str]]:
    """Corners of all faces, and what was found about their normals."""
    positions, coordinates, normals, tile_of, point = [], [], [], [], []
    notes: list[str] = []
    plain, offset, done = textures, 0, dict.fromkeys(range(textures), 0)
    for part, position in zip(mesh.parts, mesh.positions, strict=True):
        count, index = len(part.faces), part.texture
        positions.append(position[part.faces])
        if index < 0:
            tile = tiles[plain]
            tile_of.append(np.full(count, plain))
            plain += 1
            coordinates.append(np.tile(np.array([tile.column + 1.0, tile.row + 1.0]), (count, 3, 1)))
        elif blocks[index] is not None:
            tile = tiles[index]
            row, column = _block_texels(done[index] + count, tile)
            here = slice(done[index], None)
            coordinates.append(np.stack([tile.column + column[here] + 0.5, tile.row + row[here] + 0.5], axis=2))
            done[index] += count
            tile_of.append(np.full(count, index))
        else:
            assert part.uv is not None
            coordinates.append(_in_tile(mesh, part.name, part.uv[part.faces], tiles[index]))
            tile_of.append(np.full(count, index))
        if part.normals is not None:
            turned = (part.normals @ mesh.turn.T)[part.faces]
            facing = (turned * face_normals(positions[-1])[0][:, None]).sum(axis=2)
            if np.median(facing) < 0.0:
                notes.append(f"normals of part {part.name} point inwards and are not used")
                turned = creased_normals(positions[-1])
            normals.append(np.where((facing > 0.05)[..., None], turned, face_normals(positions[-1])[0][:, None]))
        else:
            normals.append(creased_normals(positions[-1]))
        point.append(part.faces + offset)
        offset += len(position)
    stacked = (np.concatenate(arrays) for arrays in (positions, coordinates, normals, tile_of, point))
    return _Corners(*stacked), notes


def _in_tile(mesh: TexturedMesh, name: str, uv: np.ndarray, tile: Tile) -> np.ndarray:
    """Columns and rows ``(F, 3, 2)`` in the image of texture coordinates; whole repeats of a texture are taken back."""
    slack = _OVERSHOOT / np.array([tile.columns, tile.rows])
    uv = uv - np.floor(uv.min(axis=1) + slack)[:, None]
    over = (uv > 1.0 + slack).any(axis=(1, 2))
    if over.any():
        cure = "bake the texture so that every point of the surface has texels of its own"
        where = f"{mesh.path}: part {name}"
        raise InputError(where, f"its texture repeats over {int(over.sum())} of {len(uv)} faces", cure=cure)
    column, row = uv[..., 0] * tile.columns, (1.0 - uv[..., 1]) * tile.rows
    return np.stack([tile.column + column, tile.row + row], axis=2)


def _topology_notes(corners: np.ndarray) -> list[str]:
    """Lines about edges that more than two faces share, and faces that look down."""
    notes = []
    point = numbered_rows(corners.reshape(-1, 3).astype(np.float32))[1].reshape(-1, 3)
    edge = np.sort(np.concatenate([point[:, [0, 1]], point[:, [1, 2]], point[:, [2, 0]]]), axis=1)
    count = np.unique(edge[:, 0].astype(np.int64) * (point.max() + 1) + edge[:, 1], return_counts=True)[1]
    if (count > 2).any():
        notes.append(f"not manifold: {int((count > 2).sum())} edges have more than two faces; shadows do not mind")
    normal, area = face_normals(corners)
    centre = corners.mean(axis=(0, 1))
    volume = ((corners.mean(axis=1) - centre) * normal).sum(axis=1) @ area
    if (count == 2).all() and volume < 0.0:
        notes.append("faces are wound inside out: their backs are black; flip the normals of the mesh")
    elif (count == 1).any() and normal[:, 2] @ area < -0.3 * area.sum():
        notes.append("most faces look down: is another axis up (--up), or are the faces wound inside out?")
    return notes


def _texels(
    shape: tuple[int, int], tiles: list[Tile], blocks: list[np.ndarray | None], corners: _Corners
) -> tuple[np.ndarray, np.ndarray, np.ndarray, int]:
    """Face, barycentric coordinates and chart of the texels of all textures, and how many texels several faces share."""
    face, chart = (np.full(shape, -1, np.int32) for _ in range(2))
    weights = np.zeros((*shape, 3), np.float32)
    charts, shared = _charts(corners), 0
    for index, tile_blocks in enumerate(blocks):
        tile, here = tiles[index], np.flatnonzero(corners.tile == index)
        if not len(here):
            continue
        inside = tile.window
        if tile_blocks is not None:
            # One texel of each vertex; every one is a chart of its own.
            _, first = np.unique(corners.point[here].ravel(), return_index=True)
            column, row = np.floor(corners.xy[here].reshape(-1, 2)[first]).astype(int).T
            face[row, column] = here[first // 3]
            weights[row, column] = np.eye(3, dtype=np.float32)[first % 3]
            chart[row, column] = charts.max(initial=0) + 1 + np.arange(len(first))
            continue
        local = (corners.xy[here] - np.array([tile.column, tile.row])).reshape(-1, 2)
        corner = np.arange(3 * len(here)).reshape(-1, 3)
        shared += int((coverage_count(local, corner, tile.columns, tile.rows) > 1).sum())
        found = covering_faces(local, corner, tile.columns, tile.rows)
        row, column = np.nonzero(found >= 0)
        covering = found[row, column]
        face[inside][row, column] = here[covering]
        chart[inside][row, column] = charts[here[covering]]
        centre = np.stack([column, row], axis=1) + 0.5
        weights[inside][row, column] = barycentric(local[corner[covering]], centre)
    return face, weights, chart, shared


def _charts(corners: _Corners) -> np.ndarray:
    """Chart of each face: faces that share a vertex with equal texture coordinates belong together."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    xy = corners.xy.reshape(-1, 2).astype(np.float32).view(np.uint32)
    rows = np.c_[xy, corners.point.reshape(-1), np.repeat(corners.tile, 3)].astype(np.uint32)
    corner = numbered_rows(rows)[1].reshape(-1, 3)
    one, other = np.r_[corner[:, 0], corner[:, 1]], np.r_[corner[:, 1], corner[:, 2]]
    count = int(corner.max()) + 1
    _, label = connected_components(coo_matrix((np.ones(len(one)), (one, other)), (count, count)), directed=False)
    return label[corner[:, 0]].astype(np.int32)


def _given_ground(ground: MeshGround, tile: Tile) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners, normals and coordinates of ground with a texture."""
    xy = np.stack(
        [tile.column + ground.uv[..., 0] * tile.columns, tile.row + (1.0 - ground.uv[..., 1]) * tile.rows], axis=2
    )
    return ground.position, ground.normal, xy


def _ground(corners: np.ndarray, tile: Tile) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners, normals and coordinates of level ground just below a mesh, fine near it and coarse far away."""
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    radius = 0.5 * float(np.linalg.norm(high - low))
    centre, level = 0.5 * (low + high), low[2] - 1e-3 * radius
    rings = radius * np.geomspace(0.03, _GROUND_RADII, _RINGS)
    angle = np.arange(_SECTORS) * (2.0 * np.pi / _SECTORS)
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(_SECTORS)], axis=1)
    points = np.concatenate([np.zeros((1, 3)), (rings[:, None, None] * rim).reshape(-1, 3)])
    points += np.array([centre[0], centre[1], level])
    sector = np.arange(_SECTORS)
    following = (sector + 1) % _SECTORS
    faces = [np.stack([np.zeros_like(sector), 1 + sector, 1 + following], axis=1)]
    for ring in range(_RINGS - 1):
        inner, outer = 1 + ring * _SECTORS, 1 + (ring + 1) * _SECTORS
        faces.append(np.stack([inner + sector, outer + sector, outer + following], axis=1))
        faces.append(np.stack([inner + sector, outer + following, inner + following], axis=1))
    triangles = points[np.concatenate(faces)]
    coordinates = np.tile(np.array([tile.column + 1.0, tile.row + 1.0]), (len(triangles), 3, 1))
    return triangles, np.tile(np.array([0.0, 0.0, 1.0]), (len(triangles), 3, 1)), coordinates
