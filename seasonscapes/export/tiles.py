"""A textured terrain as 3D Tiles 1.1: an explicit quadtree of GLB tiles in ECEF, with ellipsoidal heights.

Tiles are cut along the samples of the elevation raster, so that they meet without gaps; vertices of a tile are samples,
chosen within a height error (as the terrain's mesh is). Skirts hide the cracks between tiles of different levels.
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.export.gltf import ALBEDO_COLOURS, LIT_COLOURS, add_mesh, lambertian
from seasonscapes.export.gltf_file import GltfFile
from seasonscapes.frames import LocalFrame, axes_at, ecef_from_geodetic
from seasonscapes.images import atomic_path, linear_from_srgb, srgb8_from_linear
from seasonscapes.terrain.crs import apply_affine, geodetic_from_map
from seasonscapes.terrain.geoid import Geoid
from seasonscapes.terrain.mesh import sample_positions
from seasonscapes.terrain.surface import Raster

TILESET_FILE = "tileset.json"
# Wished side of a tile's picture [px].
_TILE_PX = 512
# A viewer refines a tile when its geometric error covers more than 16 pixels (Cesium's default): then a texel covers two.
_TEXELS_OF_ERROR = 8.0
# Height error of the finest tiles in spacings of the samples, and its bound [m].
_ERROR_SPACINGS, _MOST_ERROR_M = 0.05, 1.0
_JPEG_QUALITY = 92
_MOST_TILES = 100_000


@dataclass(frozen=True)
class TileSource:
    """What tiles are cut from.

    Parameters
    ----------
    elevation
        Heights ``(H, W, 1)`` without holes [m].
    frame
        Local frame of the scene.
    geoid
        Brings heights to the ellipsoid.
    colours_at
        Display levels ``(N, 3)`` uint8 sRGB of the ground at positions ``(N, 3)`` in the local frame.
    spacing_m, texel_m
        Distance of the samples, side of a texel of the whole texture [m].
    lit
        Whether the colours contain the light.
    about
        Plain values for metadata.
    """

    elevation: Raster
    frame: LocalFrame
    geoid: Geoid
    colours_at: Callable[[np.ndarray], np.ndarray]
    spacing_m: float
    texel_m: float
    lit: bool = False
    about: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class _Block:
    """A square of cells of the raster, clipped at its end: ``stride`` samples apart, level 0 is the finest."""

    level: int
    row: int
    column: int


@dataclass
class _Tile:
    table: dict[str, Any]
    picture: np.ndarray
    region: np.ndarray
    error_m: float


def write_tileset(
    folder: Path, source: TileSource, *, progress: Callable[[float], None] | None = None
) -> dict[str, Any]:
    """Write ``tileset.json`` (last) and its tiles ``LEVEL/ROW_COLUMN.glb`` into a folder.

    Parameters
    ----------
    folder
        An empty folder.
    source
        Heights, colours and geoid.
    progress
        Called with the completed fraction.

    Returns
    -------
    dict
        Plain values: tiles, levels, undulation at the origin and its range [m], bytes.

    Raises
    ------
    InputError
        For a raster that needs too many tiles.
    """
    return _Cutter(folder, source, progress or (lambda _: None)).write()


class _Cutter:
    """Cuts a tree depth first; a tile's picture is made from those of its children."""

    def __init__(self, folder: Path, source: TileSource, progress: Callable[[float], None]):
        self.folder, self.source, self.progress = folder, source, progress
        self.rows, self.columns = (size - 1 for size in source.elevation.values.shape[:2])
        self.px_per_cell = source.spacing_m / source.texel_m
        self.cells = int(np.clip(2 ** round(np.log2(_TILE_PX / self.px_per_cell)), 16, 256))
        across = max(self.rows, self.columns) / self.cells
        self.levels = 1 + max(0, int(np.ceil(np.log2(across))))
        leaves = int(np.ceil(self.rows / self.cells) * np.ceil(self.columns / self.cells))
        if leaves > _MOST_TILES:
            raise InputError("--to 3dtiles", "too many tiles", got=leaves, expected=f"at most {_MOST_TILES:,}")
        self.leaves, self.done, self.tiles, self.bytes = leaves, 0, 0, 0
        frame = source.frame
        zero = source.geoid.undulation_m(np.array(frame.latitude_deg), np.array(frame.longitude_deg))
        self.origin_undulation_m = float(zero)
        self.origin = ecef_from_geodetic(frame.latitude_deg, frame.longitude_deg, frame.height_m + float(zero))
        self.axes = axes_at(frame.latitude_deg, frame.longitude_deg)
        self.undulation_m = [float(zero), float(zero)]

    def write(self) -> dict[str, Any]:
        source = self.source
        top = self._tile(_Block(self.levels - 1, 0, 0))
        transform = np.eye(4)
        transform[:3, :3], transform[:3, 3] = self.axes.T, self.origin
        geoid = {
            "geoid": source.geoid.source,
            "origin_undulation_m": round(self.origin_undulation_m, 3),
            "undulation_m": [round(value, 3) for value in self.undulation_m],
        }
        heights = {"heights": "above the WGS 84 ellipsoid: height in the vertical datum + undulation of the geoid"}
        about = {**self._about(), **heights, **geoid}
        table = {
            "asset": {"version": "1.1", "extras": about},
            # Before the root: nothing is shown, and the error is that of a plane.
            "geometricError": max(2.0 * top.error_m, float(top.region[5] - top.region[4])),
            "root": {"transform": transform.T.ravel().tolist(), "refine": "REPLACE", **top.table},
        }
        with atomic_path(self.folder / TILESET_FILE) as temporary:
            temporary.write_text(json.dumps(table, default=float) + "\n")
        return {"tiles": self.tiles, "levels": self.levels, "bytes": self.bytes, **geoid}

    def _about(self) -> dict[str, Any]:
        source = self.source
        colours = LIT_COLOURS if source.lit else ALBEDO_COLOURS
        axes = {"up_axis": "y", "axes": "x east, y up, z south", "unit": "metre"}
        # Tiles lie in the exact frame of the Earth, not in the scene's, which lifts far points against refraction.
        ellipsoidal_m = source.frame.height_m + self.origin_undulation_m
        origin = {**source.about.get("origin", {}), "refraction_k": 0.0, "ellipsoidal_height_m": ellipsoidal_m}
        return {**axes, "colour_space": colours, **source.about, "origin": origin}

    def _tile(self, block: _Block) -> _Tile:
        rows, columns = self._samples(block)
        height_px, width_px = (self._pixels(samples, block) for samples in (rows, columns))
        children = []
        if block.level == 0:
            picture = self._colours(rows, columns, height_px, width_px)
            self.done += 1
            self.progress(self.done / self.leaves)
        else:
            children, picture = self._children(block)
            picture = _shrunk(picture, width_px, height_px)
        uri, region, error_m = self._write(block, rows, columns, picture)
        table: dict[str, Any] = {"boundingVolume": {}, "geometricError": 0.0, "content": {"uri": uri}}
        if children:
            error_m = max(error_m, *(child.error_m for child in children))
            error_m = max(error_m, _TEXELS_OF_ERROR * self.source.texel_m * 2**block.level)
            regions = np.array([region, *(child.region for child in children)])
            region = np.concatenate(
                [regions[:, :2].min(0), regions[:, 2:4].max(0), [regions[:, 4].min()], [regions[:, 5].max()]]
            )
            table |= {"geometricError": error_m, "children": [child.table for child in children]}
        table["boundingVolume"] = {"region": region.tolist()}
        return _Tile(table, picture, region, error_m)

    def _samples(self, block: _Block) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns of the raster that a tile may use, its far edge included."""
        stride, side = 2**block.level, self.cells * 2**block.level
        found = []
        for index, end in ((block.row, self.rows), (block.column, self.columns)):
            first, last = index * side, min((index + 1) * side, end)
            found.append(np.unique(np.append(np.arange(first, last, stride), last)))
        return found[0], found[1]

    def _pixels(self, samples: np.ndarray, block: _Block) -> int:
        return max(1, round((samples[-1] - samples[0]) * self.px_per_cell / 2**block.level))

    def _children(self, block: _Block) -> tuple[list[_Tile], np.ndarray]:
        """The up to four tiles below, and their pictures put together."""
        side, children, picture = self.cells * 2 ** (block.level - 1), [], []
        for row in (2 * block.row, 2 * block.row + 1):
            if row * side >= self.rows:
                continue
            strip = []
            for column in (2 * block.column, 2 * block.column + 1):
                if column * side < self.columns:
                    child = self._tile(_Block(block.level - 1, row, column))
                    children.append(child)
                    strip.append(child.picture)
            picture.append(np.concatenate(strip, axis=1))
        return children, np.concatenate(picture, axis=0)

    def _colours(self, rows: np.ndarray, columns: np.ndarray, height_px: int, width_px: int) -> np.ndarray:
        across = columns[0] + (np.arange(width_px) + 0.5) / width_px * (columns[-1] - columns[0])
        down = rows[0] + (np.arange(height_px) + 0.5) / height_px * (rows[-1] - rows[0])
        column, row = np.meshgrid(across, down)
        heights = _bilinear(self.source.elevation.values[..., 0], down, across)
        position = sample_positions(self.source.elevation, self.source.frame, row, column, heights)
        return self.source.colours_at(position.reshape(-1, 3)).reshape(height_px, width_px, 3)

    def _write(
        self, block: _Block, rows: np.ndarray, columns: np.ndarray, picture: np.ndarray
    ) -> tuple[str, np.ndarray, float]:
        """Write a tile; returns its URI, region (radians, metres) and height error [m]."""
        vertices, verticals, geodetic = self._positions(rows, columns)
        stride = 2**block.level
        bound_m = min(_ERROR_SPACINGS * self.source.spacing_m, _MOST_ERROR_M) * stride
        chosen, faces = _triangulated(vertices[..., 2], bound_m, self.source.elevation.transform.determinant > 0.0)
        row, column = chosen.T
        normals = _normals(vertices)[row, column]
        uv = np.stack([columns[column] - columns[0], rows[-1] - rows[row]], axis=1).astype(float)
        uv /= [columns[-1] - columns[0], rows[-1] - rows[0]]
        skirt_m = 2.0 * stride * self.source.spacing_m
        mesh = _with_skirts((vertices[row, column], normals, uv, faces), -skirt_m * verticals[row, column])
        file = GltfFile(self._about())
        texture = file.add_image("lit" if self.source.lit else "albedo", _jpeg(picture), "image/jpeg")
        if self.source.lit:
            mesh = mesh[0], None, *mesh[2:]
        node = file.add("nodes", {"mesh": add_mesh(file, mesh, lambertian(file, texture, self.source.lit))})
        file.table |= {"scene": 0, "scenes": [{"nodes": [node]}]}
        uri = f"{self.levels - 1 - block.level}/{block.row}_{block.column}.glb"
        file.write_glb(self.folder / uri)
        self.tiles += 1
        self.bytes += (self.folder / uri).stat().st_size
        latitude, longitude, height = (np.asarray(values) for values in geodetic)
        angles = np.radians([longitude.min(), latitude.min(), longitude.max(), latitude.max()])
        region = np.append(angles, [height.min() - skirt_m, height.max()])
        full = self.source.elevation.values[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1, 0]
        kept = self.source.elevation.values[rows[:, None], columns, 0]
        lost = _bilinear(kept, *(_places(samples) for samples in (rows, columns))) - full
        return uri, region, bound_m + float(np.abs(lost).max())

    def _positions(
        self, rows: np.ndarray, columns: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
        """East-north-up ``(R, C, 3)`` about the origin without refraction [m], and the verticals there.

        Third: latitude, longitude [deg] and ellipsoidal height [m].
        """
        raster = self.source.elevation
        column, row = np.meshgrid(columns, rows)
        latitude, longitude = geodetic_from_map(raster.crs, *apply_affine(raster.transform, column + 0.5, row + 0.5))
        undulation = self.source.geoid.undulation_m(latitude, longitude)
        if not np.isfinite(undulation).all():
            raise InputError("--to 3dtiles", "PROJ's geoid grid does not cover the land", cure="give --geoid-m")
        if np.ptp(longitude) > 180.0:
            raise InputError("--to 3dtiles", "the land lies across the 180th meridian, where regions of tiles end")
        low, high = self.undulation_m
        self.undulation_m = [min(low, float(undulation.min())), max(high, float(undulation.max()))]
        height = raster.values[row, column, 0] + undulation
        ground = ecef_from_geodetic(latitude, longitude, height)
        verticals = ecef_from_geodetic(latitude, longitude, height + 1.0) - ground
        return (ground - self.origin) @ self.axes.T, verticals @ self.axes.T, (latitude, longitude, height)


def _places(samples: np.ndarray) -> np.ndarray:
    """Where every row (or column) of the raster lies between a tile's samples, as a fractional index."""
    return np.interp(np.arange(samples[0], samples[-1] + 1), samples, np.arange(len(samples)))


def _bilinear(values: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Interpolate ``(H, W)`` at the crossings of fractional rows and columns."""
    for axis, places in ((0, rows), (1, columns)):
        first = np.clip(np.floor(places).astype(int), 0, max(values.shape[axis] - 2, 0))
        share = (places - first)[:, None] if axis == 0 else places - first
        following = np.minimum(first + 1, values.shape[axis] - 1)
        values = values.take(first, axis) * (1.0 - share) + values.take(following, axis) * share
    return values


def _triangulated(up_m: np.ndarray, error_m: float, mirrored: bool) -> tuple[np.ndarray, np.ndarray]:
    """Rows and columns ``(V, 2)`` of the samples that a tile keeps, and its faces, counter-clockwise from above."""
    from pydelatin import Delatin

    mesh = Delatin(np.ascontiguousarray(up_m, np.float32), max_error=0.995 * error_m)
    column, row = mesh.vertices[:, 0].astype(np.intp), len(up_m) - 1 - mesh.vertices[:, 1].astype(np.intp)
    faces = mesh.triangles
    return np.stack([row, column], axis=1), faces[:, ::-1].copy() if mirrored else faces


def _normals(position_m: np.ndarray) -> np.ndarray:
    """Unit normals ``(R, C, 3)`` of a grid of positions, upwards."""
    down, across = np.gradient(position_m, axis=0), np.gradient(position_m, axis=1)
    normal = np.cross(across, -down)
    normal *= np.sign(normal[..., 2:])
    return (normal / np.linalg.norm(normal, axis=-1, keepdims=True)).astype(np.float32)


def _with_skirts(
    mesh: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray], down_m: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Hang walls from the edges of a tile, seen from outside, with the edge's normals and colours.

    ``down_m`` ``(V, 3)`` is where the wall below each vertex ends, relative to the vertex.
    """
    vertices, normals, uv, faces = mesh
    # Directed edges that no neighbour runs backwards are the rim; the tile lies to their left.
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    count = len(vertices)
    rim = edges[~np.isin(edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0])]
    upper, place = np.unique(rim, return_inverse=True)
    place = place.reshape(-1, 2) + count
    walls = np.concatenate(
        [np.stack([rim[:, 1], rim[:, 0], place[:, 0]], axis=1), np.stack([rim[:, 1], place[:, 0], place[:, 1]], axis=1)]
    )
    lower = vertices[upper] + down_m[upper]
    return (
        np.concatenate([vertices, lower]),
        np.concatenate([normals, normals[upper]]),
        np.concatenate([uv, uv[upper]]),
        np.concatenate([faces, walls.astype(faces.dtype)]),
    )


def _shrunk(picture: np.ndarray, width_px: int, height_px: int) -> np.ndarray:
    """Average sRGB levels over areas in linear light."""
    import cv2

    linear = linear_from_srgb(picture.astype(np.float32) / 255.0)
    return srgb8_from_linear(cv2.resize(linear, (width_px, height_px), interpolation=cv2.INTER_AREA))


def _jpeg(picture: np.ndarray) -> bytes:
    from PIL import Image

    encoded = io.BytesIO()
    Image.fromarray(picture).save(encoded, format="JPEG", quality=_JPEG_QUALITY, subsampling=0)
    return encoded.getvalue()
