"""Mosaics: many rasters, of any spacing and CRS, brought onto one map grid.

Rasters of the same grid are joined before they are interpolated, so that no seam stands between neighbouring tiles.
Longitudes are counted from the target's own, so that tiles on both sides of the antimeridian are neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from affine import Affine

from seasonscapes.terrain.crs import apply_affine, geodetic_from_map, horizontal_crs, map_from_geodetic
from seasonscapes.terrain.raster import bounds_geographic
from seasonscapes.terrain.surface import Raster

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

# Coordinates are transformed exactly at every 16th cell and interpolated between: an error of millimetres at 30 m.
_STEP = 16
_STRIP_ROWS = 512
# Cells whose interpolation lacks some neighbours keep the mean of the others, if these weigh this much.
_LEAST_WEIGHT = 0.4


@dataclass(frozen=True)
class MapGrid:
    """A north-up grid of square cells in a projected CRS.

    Parameters
    ----------
    crs
        ``EPSG:n``.
    west, north
        Outer corner [m].
    spacing_m
        Side of a cell [m].
    width, height
        Cells.
    """

    crs: str
    west: float
    north: float
    spacing_m: float
    width: int
    height: int

    @property
    def transform(self) -> Affine:
        """From column and row to map coordinates."""
        return Affine(self.spacing_m, 0.0, self.west, 0.0, -self.spacing_m, self.north)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.height, self.width

    def geodetic(self, column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Latitude and longitude [deg] of cell coordinates; (0.5, 0.5) is the centre of the first cell."""
        return geodetic_from_map(self.crs, *apply_affine(self.transform, column, row))

    @property
    def centre_deg(self) -> tuple[float, float]:
        """Latitude and longitude of the centre [deg]."""
        latitude, longitude = self.geodetic(np.array(self.width / 2.0), np.array(self.height / 2.0))
        return float(latitude), float(longitude)

    def boxes_deg(self, margin_deg: float = 0.001) -> list[tuple[float, float, float, float]]:
        """West, south, east and north bounds [deg]; two boxes where the grid crosses the antimeridian."""
        u, v = (
            axis.ravel() for axis in np.meshgrid(np.linspace(0.0, self.width, 17), np.linspace(0.0, self.height, 17))
        )
        latitude, longitude = self.geodetic(u, v)
        middle = self.centre_deg[1]
        longitude = _near(longitude, middle)
        west, east = float(longitude.min()) - margin_deg, float(longitude.max()) + margin_deg
        south, north = max(float(latitude.min()) - margin_deg, -90.0), min(float(latitude.max()) + margin_deg, 90.0)
        if east - west >= 360.0 or abs(latitude).max() > 89.0:
            return [(-180.0, south, 180.0, north)]
        if west < -180.0:
            return [(west + 360.0, south, 180.0, north), (-180.0, south, east, north)]
        if east > 180.0:
            return [(west, south, 180.0, north), (-180.0, south, east - 360.0, north)]
        return [(west, south, east, north)]


@dataclass(frozen=True)
class RasterGrid:
    """The grid of a raster in any CRS, as a target of `mosaic`.

    Parameters
    ----------
    raster
        Supplies size, transform and CRS.
    """

    raster: Raster

    @property
    def height(self) -> int:
        """Rows."""
        return self.raster.values.shape[0]

    @property
    def width(self) -> int:
        """Columns."""
        return self.raster.values.shape[1]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.height, self.width

    def geodetic(self, column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Latitude and longitude [deg] of cell coordinates; (0.5, 0.5) is the centre of the first cell."""
        return geodetic_from_map(self.raster.crs, *apply_affine(self.raster.transform, column, row))

    @property
    def centre_deg(self) -> tuple[float, float]:
        """Latitude and longitude of the centre [deg]."""
        latitude, longitude = self.geodetic(np.array(self.width / 2.0), np.array(self.height / 2.0))
        return float(latitude), float(longitude)


def grid_about(latitude_deg: float, longitude_deg: float, size_m: tuple[float, float], spacing_m: float) -> MapGrid:
    """The grid of a rectangle about a place, in the UTM zone of the place, polar stereographic beyond ±84°.

    Parameters
    ----------
    latitude_deg, longitude_deg
        Centre [deg].
    size_m
        West-east and south-north extent [m].
    spacing_m
        Side of a cell [m]; corners are whole multiples of it.
    """
    crs = utm_crs(latitude_deg, longitude_deg)
    x, y = map_from_geodetic(crs, latitude_deg, longitude_deg)
    width, height = (max(2, round(side / spacing_m)) for side in size_m)
    west = round((float(x) - width * spacing_m / 2.0) / spacing_m) * spacing_m
    north = round((float(y) + height * spacing_m / 2.0) / spacing_m) * spacing_m
    return MapGrid(crs, west, north, spacing_m, width, height)


def utm_crs(latitude_deg: float, longitude_deg: float) -> str:
    """EPSG code of the UTM zone of a place, of the polar stereographic projection beyond ±84°."""
    if latitude_deg >= 84.0:
        return "EPSG:32661"
    if latitude_deg <= -80.0:
        return "EPSG:32761"
    zone = int((longitude_deg + 180.0) % 360.0 // 6.0) + 1
    return f"EPSG:{(32600 if latitude_deg >= 0.0 else 32700) + zone}"


def read_tile(
    dataset: DatasetReader,
    grid: MapGrid,
    *,
    bands: Sequence[int],
    decode: Callable[[np.ndarray], np.ndarray] | None = None,
    average: bool = True,
) -> Raster | None:
    """Read the part of an open raster that a grid needs, averaged down as far as the grid is coarser.

    Parameters
    ----------
    dataset
        Open raster.
    grid
        Target.
    bands
        Band numbers from 1.
    decode
        Applied to the stored values ``(H, W, C)`` (NaN where there are none) after averaging; by default the file's own
        scale and offset.
    average
        Mean of blocks of pixels; else every n-th pixel, for classes.

    Returns
    -------
    Raster or None
        Values ``(H, W, C)`` float32 with NaN; ``None`` where the raster does not reach the grid.
    """
    from rasterio.enums import Resampling
    from rasterio.windows import Window

    crs = dataset.crs.to_string()
    transform = _unwrapped(dataset.transform, crs, dataset.width, grid)
    u, v = np.meshgrid(np.linspace(0.0, grid.width, 17), np.linspace(0.0, grid.height, 17))
    column, row = _pixels_at(grid, u, v, crs, transform)
    if not (np.isfinite(column).all() and np.isfinite(row).all()):
        return None
    factor = _factor(column, row, grid)
    # Two more pixels on each side, in whole blocks, so that interpolation has its neighbours.
    left, right = (int(edge) for edge in (np.floor(column.min() / factor) - 2, np.ceil(column.max() / factor) + 2))
    top, bottom = (int(edge) for edge in (np.floor(row.min() / factor) - 2, np.ceil(row.max() / factor) + 2))
    left, top = max(left, 0), max(top, 0)
    right, bottom = min(right, dataset.width // factor), min(bottom, dataset.height // factor)
    if right <= left or bottom <= top:
        return None
    size = (right - left) * factor, (bottom - top) * factor
    window = Window(left * factor, top * factor, *size)  # pyright: ignore[reportCallIssue]
    read = dataset.read(
        list(bands),
        window=window,
        out_shape=(len(bands), bottom - top, right - left),
        resampling=Resampling.average if average and factor > 1 else Resampling.nearest,
        masked=True,
    )
    values = np.where(np.ma.getmaskarray(read), np.nan, read.data.astype(np.float64)).transpose(1, 2, 0)
    if decode is None:
        index = [band - 1 for band in bands]
        values = values * np.array(dataset.scales)[index] + np.array(dataset.offsets)[index]
    else:
        values = decode(values)
    a, b, _, d, e, _ = tuple(transform)[:6]
    x, y = apply_affine(transform, left * factor, top * factor)
    blocks = Affine(a * factor, b * factor, float(x), d * factor, e * factor, float(y))
    return Raster(values.astype(np.float32), blocks, crs)


def mosaic(tiles: Sequence[Raster], grid: MapGrid | RasterGrid, *, extend: bool = True) -> np.ndarray:
    """Bring rasters onto a grid by cubic convolution, linear beside gaps; where several have a value, the first counts.

    Parameters
    ----------
    tiles
        Rasters from `read_tile`, of equal numbers of bands.
    grid
        Target.
    extend
        Also give values to cells half a pixel beyond the outermost centres, as the mean of the neighbours that are there.

    Returns
    -------
    numpy.ndarray
        ``(height, width, C)`` float32, NaN where no raster has a value.
    """
    channels = tiles[0].values.shape[2] if tiles else 1
    groups = [joined(group) for group in _grouped(tiles)]
    result = np.full((*grid.shape, channels), np.nan, np.float32)
    for start in range(0, grid.height, _STRIP_ROWS):
        rows = slice(start, min(start + _STRIP_ROWS, grid.height))
        strip = result[rows]
        weak = np.full_like(strip, np.nan)
        for group in groups:
            nodes = _strip_nodes(grid, rows, group.crs, group.transform)
            if not _reaches(group, *nodes):
                continue
            column, row = (_between(each, grid.width, rows.stop - rows.start) - 0.5 for each in nodes)
            values, weight = _interpolated(group.values, column, row)
            sure = np.asarray(np.isnan(strip) & (weight[..., None] > 0.999))
            strip[sure] = values[sure]
            some = np.asarray(np.isnan(weak) & (weight[..., None] > _LEAST_WEIGHT))
            weak[some] = values[some]
        if extend:
            result[rows] = np.where(np.isnan(strip), weak, strip)
    return result


def _near(longitude_deg: np.ndarray, middle_deg: float) -> np.ndarray:
    """Longitudes within 180° of a middle one."""
    return longitude_deg - 360.0 * np.round((longitude_deg - middle_deg) / 360.0)


def _unwrapped(transform: Affine, crs: str, width: int, grid: MapGrid) -> Affine:
    """The transform of a geographic raster with longitudes that continue those of the grid."""
    if not horizontal_crs(crs).is_geographic:
        return transform
    a, b, c, d, e, f = tuple(transform)[:6]
    turns = round((c + a * width / 2.0 - grid.centre_deg[1]) / 360.0)
    return Affine(a, b, c - 360.0 * turns, d, e, f)


def _pixels_at(
    grid: MapGrid | RasterGrid, u: np.ndarray, v: np.ndarray, crs: str, transform: Affine
) -> tuple[np.ndarray, np.ndarray]:
    """Column and row in a raster of cell coordinates of a grid."""
    latitude, longitude = grid.geodetic(u, v)
    x, y = map_from_geodetic(crs, latitude, longitude)
    if horizontal_crs(crs).is_geographic:
        x = _near(x, grid.centre_deg[1])
    return apply_affine(~transform, x, y)


def _factor(column: np.ndarray, row: np.ndarray, grid: MapGrid) -> int:
    """Pixels per cell along the finer axis, down to a power of two."""
    across = np.hypot(np.diff(column, axis=1), np.diff(row, axis=1)).mean() / (grid.width / 16.0)
    down = np.hypot(np.diff(column, axis=0), np.diff(row, axis=0)).mean() / (grid.height / 16.0)
    return 2 ** max(0, int(np.floor(np.log2(max(min(across, down), 1.0)) + 0.01)))


def same_grid(tiles: Sequence[Raster]) -> bool:
    """Whether the pixels of all rasters stand on one grid."""
    return len({_grid_key(tile) for tile in tiles}) == 1


def _grid_key(tile: Raster) -> tuple:
    t = tile.transform
    # A phase just below 1 is one just above 0.
    phases = (round((t.c / t.a) % 1.0, 2) % 1.0, round((t.f / t.e) % 1.0, 2) % 1.0)
    return (tile.crs, f"{t.a:.9e}", f"{t.b:.6e}", f"{t.d:.6e}", f"{t.e:.9e}", *phases)


def _grouped(tiles: Sequence[Raster]) -> list[list[Raster]]:
    """Rasters whose pixels lie on the same grid, in order of their first.

    A raster does not join an earlier group past one that overlaps it: the order of the rasters decides there.
    """
    keys = [_grid_key(tile) for tile in tiles]
    if len(set(keys)) == 1:
        return [list(tiles)]
    groups: list[tuple[tuple, list[int]]] = []
    boxes = [bounds_geographic(tile) for tile in tiles]
    for number, key in enumerate(keys):
        for group_key, members in reversed(groups):
            if group_key == key:
                members.append(number)
                break
            if any(_boxes_overlap(boxes[number], boxes[member]) for member in members):
                groups.append((key, [number]))
                break
        else:
            groups.append((key, [number]))
    return [[tiles[number] for number in members] for _, members in groups]


def _boxes_overlap(a: tuple[float, float, float, float], b: tuple[float, float, float, float]) -> bool:
    turn = 360.0 * round((b[0] - a[0]) / 360.0)
    return a[0] + turn < b[2] and b[0] < a[2] + turn and a[1] < b[3] and b[1] < a[3]


def joined(tiles: Sequence[Raster]) -> Raster:
    """Rasters of one grid side by side; where several have a value, that of the first counts; NaN where none has.

    Parameters
    ----------
    tiles
        Rasters of which `same_grid` is true, of equal numbers of bands.
    """
    if len(tiles) == 1:
        return tiles[0]
    first = tiles[0].transform
    places = []
    for tile in tiles:
        column, row = apply_affine(~first, tile.transform.c, tile.transform.f)
        places.append((round(float(column)), round(float(row)), tile.values))
    left, top = min(place[0] for place in places), min(place[1] for place in places)
    right = max(column + values.shape[1] for column, _, values in places)
    bottom = max(row + values.shape[0] for _, row, values in places)
    canvas = np.full((bottom - top, right - left, tiles[0].values.shape[2]), np.nan, np.float32)
    for column, row, values in places:
        part = canvas[row - top : row - top + values.shape[0], column - left : column - left + values.shape[1]]
        empty = np.isnan(part).any(axis=2)
        part[empty] = values[empty]
    x, y = apply_affine(first, left, top)
    a, b, _, d, e, _ = tuple(first)[:6]
    return Raster(canvas, Affine(a, b, float(x), d, e, float(y)), tiles[0].crs)


def _reaches(raster: Raster, column: np.ndarray, row: np.ndarray) -> bool:
    """Whether a raster lies under any of the places between some of its pixel coordinates; NaN counts as anywhere."""
    height, width = raster.values.shape[:2]
    outside = (column.max() < -1.0) | (column.min() > width + 1.0) | (row.max() < -1.0) | (row.min() > height + 1.0)
    return not bool(outside)


def _strip_nodes(grid: MapGrid | RasterGrid, rows: slice, crs: str, transform: Affine) -> tuple[np.ndarray, np.ndarray]:
    """Column and row in a raster of every `_STEP`-th cell centre of some rows."""
    count = rows.stop - rows.start
    u = np.arange(0, grid.width + _STEP, _STEP) + 0.5
    v = np.arange(0, count + _STEP, _STEP) + rows.start + 0.5
    columns, rows_of = np.meshgrid(u, v)
    return _pixels_at(grid, columns, rows_of, crs, transform)


def _between(nodes: np.ndarray, width: int, height: int) -> np.ndarray:
    """Linear interpolation of values at every `_STEP`-th cell to all cells."""
    row, column = np.arange(height), np.arange(width)
    i, s = row // _STEP, (row % _STEP / _STEP)[:, None]
    along = nodes[i] * (1.0 - s) + nodes[i + 1] * s
    j, t = column // _STEP, column % _STEP / _STEP
    return along[:, j] * (1.0 - t) + along[:, j + 1] * t


def _interpolated(values: np.ndarray, column: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Cubic convolution where all neighbours are known, the mean of the known ones by bilinear weights elsewhere.

    Returns the values ``(H, W, C)`` and the sum of the bilinear weights of known neighbours ``(H, W)``.
    """
    outside = ~(np.isfinite(column) & np.isfinite(row))
    column = np.clip(np.where(outside, -9.0, column), -2.0, values.shape[1] + 1.0)
    row = np.clip(np.where(outside, -9.0, row), -2.0, values.shape[0] + 1.0)
    # Pixels of the same grid are taken as they are.
    column, row = _snapped(column), _snapped(row)
    linear, weight, _ = _convolved(values, column, row, _linear_weights)
    if not (column % 1.0).any() and not (row % 1.0).any():
        return linear / np.maximum(weight, 1e-12)[..., None], weight
    cubic, _, missing = _convolved(values, column, row, _cubic_weights)
    smooth = ~missing
    return np.where(smooth[..., None], cubic, linear / np.maximum(weight, 1e-12)[..., None]), weight


def _snapped(position: np.ndarray) -> np.ndarray:
    """Positions, those within a thousandth of a pixel's centre at it."""
    near = np.rint(position)
    return np.where(np.abs(position - near) < 1e-3, near, position)


def _linear_weights(fraction: np.ndarray) -> list[tuple[int, np.ndarray]]:
    return [(0, 1.0 - fraction), (1, fraction)]


def _cubic_weights(fraction: np.ndarray) -> list[tuple[int, np.ndarray]]:
    """Catmull-Rom: passes through the samples, exact for parabolas."""
    t = fraction
    return [
        (-1, ((-0.5 * t + 1.0) * t - 0.5) * t),
        (0, (1.5 * t - 2.5) * t * t + 1.0),
        (1, ((-1.5 * t + 2.0) * t + 0.5) * t),
        (2, (0.5 * t - 0.5) * t * t),
    ]


def _convolved(
    values: np.ndarray,
    column: np.ndarray,
    row: np.ndarray,
    weights: Callable[[np.ndarray], list[tuple[int, np.ndarray]]],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted sum of the known neighbours, sum of their weights, and whether a neighbour of some weight is missing."""
    height, width = values.shape[:2]
    known = np.asarray(np.isfinite(values).all(axis=2))
    filled = np.where(known[..., None], values, 0.0).astype(np.float32)
    column0, row0 = np.floor(column).astype(int), np.floor(row).astype(int)
    total, sum_, missing = (
        np.zeros((*column.shape, values.shape[2])),
        np.zeros(column.shape),
        np.zeros(column.shape, bool),
    )
    for d_row, wy in weights(row - row0):
        for d_column, wx in weights(column - column0):
            w = wy * wx
            if not w.any():
                continue
            r, c = row0 + d_row, column0 + d_column
            inside = (r >= 0) & (r < height) & (c >= 0) & (c < width)
            r, c = np.clip(r, 0, height - 1), np.clip(c, 0, width - 1)
            here = inside & known[r, c]
            missing |= ~here & (w != 0.0)
            w = np.where(here, w, 0.0)
            total += w[..., None] * filled[r, c]
            sum_ += w
    return total, sum_, missing
