"""Screened Poisson reconstruction of the surface through an elevation raster, as in the SeasonScapes paper.

The samples and their normals are oriented points (`terrain.point_cloud`). The indicator χ of the ground (½ below, −½ above) minimises

    ∫ |∇χ − V|² dx  +  α / h ∫ χ² dA,

where V is the field of normals, blurred by quadratic B-splines of the grid's spacing h, and the second integral runs
over the samples (Kazhdan & Hoppe 2013, "Screened Poisson surface reconstruction", doi:10.1145/2487228.2487237). Their
solver is an octree for any points. These points lie on a raster, so the equation is solved on a regular grid whose
columns are the samples, in a band about the surface; outside the band χ is known. Two walls so near make the equation
well conditioned and its solution local: conjugate gradients converge in tens of steps, and tiles that overlap
give what the whole gives.

The surface is χ = 0 seen from above: one height for each sample, so that no face folds and the outline is the raster's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import cg

from seasonscapes.terrain.placement import cell_sides_m
from seasonscapes.terrain.point_cloud import OrientedPoints, oriented_points
from seasonscapes.terrain.surface import Raster

# Weight α of the samples, the one of the authors' program and of Open3D.
SCREENING = 4.0
# Half the thickness of the band [cells]: the B-spline reaches 1.5 cells.
_REACH = 4
# Side of a tile, and how far neighbours reach into it [samples]. The slowest mode between the walls decays by exp(−π/8)
# a sample, to 2e-4 over the overlap.
_TILE, _OVERLAP = 192, 22
_TOLERANCE = 1e-5


def poisson_raster(points: OrientedPoints | Raster, *, screening: float = SCREENING) -> Raster:
    """Reconstruct the screened Poisson surface of a point cloud on a raster.

    Parameters
    ----------
    points
        Samples with normals, at least 2 × 2; of a raster without them, those of `oriented_points`.
    screening
        Weight of the samples against that of their normals; larger values follow the samples more closely.

    Returns
    -------
    Raster
        The same grid; ``values`` float32 [m].

    Raises
    ------
    ValueError
        The screening is not positive.

    Examples
    --------
    >>> import numpy as np
    >>> from affine import Affine
    >>> plane = np.add.outer(3.0 * np.arange(8.0), 5.0 * np.arange(9.0))[..., None].astype(np.float32)
    >>> raster = Raster(plane, Affine(10.0, 0.0, 2.6e6, 0.0, -10.0, 1.1e6), "EPSG:2056")
    >>> bool(np.abs(poisson_raster(raster).values - plane).max() < 0.01)
    True
    """
    if not screening > 0.0:
        raise ValueError(f"screening: got {screening}, expected a positive weight")
    if isinstance(points, Raster):
        points = oriented_points(points)
    raster = points.raster
    heights = raster.values[..., 0].astype(np.float64)
    # The slope continues beyond the border; a raster of few samples is reflected more than once.
    padded = np.pad(heights, _OVERLAP, mode="reflect", reflect_type="odd")
    slopes = _padded_slopes(points.normals)
    sides_m = cell_sides_m(raster)
    result = np.empty_like(heights)
    for rows, columns in _tiles(heights.shape):
        # With its overlap, since the padding shifts by as much.
        around = slice(rows.start, rows.stop + 2 * _OVERLAP), slice(columns.start, columns.stop + 2 * _OVERLAP)
        inner = slice(_OVERLAP, -_OVERLAP)
        result[rows, columns] = _surface(padded[around], slopes[around], sides_m, screening)[inner, inner]
    return replace(raster, values=result[..., None].astype(np.float32))


def _tiles(shape: tuple[int, ...]) -> Iterator[tuple[slice, slice]]:
    for row in range(0, shape[0], _TILE):
        for column in range(0, shape[1], _TILE):
            yield slice(row, min(row + _TILE, shape[0])), slice(column, min(column + _TILE, shape[1]))


@dataclass(frozen=True)
class _Band:
    """Nodes of the columns of a tile from ``base`` on, ``count`` in each ``(H, W)``; ``start`` is where a column begins."""

    base: np.ndarray
    count: np.ndarray
    start: np.ndarray
    column: np.ndarray
    level: np.ndarray

    def neighbours(self, axis: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Nodes that have a next column along an axis, that column's node, whether it is in the band, and χ if not."""
        height, width = self.base.shape
        row, column = np.divmod(self.column, width)
        node = np.flatnonzero((row < height - 1) if axis == 0 else (column < width - 1))
        beside = self.column[node] + (width if axis == 0 else 1)
        offset = self.level[node] - self.base.ravel()[beside]
        inside = (offset >= 0) & (offset < self.count.ravel()[beside])
        return node, self.start[beside] + offset, inside, np.where(offset < 0, 0.5, -0.5)


def _band(level: np.ndarray) -> _Band:
    """The nodes within `_REACH` levels of the surface ``(H, W)`` in units of levels, and of the columns beside it."""
    from scipy.ndimage import maximum_filter, minimum_filter

    low = np.floor(minimum_filter(level, 3)).astype(np.int64) - _REACH
    high = np.ceil(maximum_filter(level, 3)).astype(np.int64) + _REACH
    count = high - low + 1
    start = np.concatenate([[0], np.cumsum(count.ravel())[:-1]])
    column = np.repeat(np.arange(count.size), count.ravel())
    return _Band(low, count, start, column, np.arange(len(column)) - start[column] + low.ravel()[column])


def _padded_slopes(normals: np.ndarray) -> np.ndarray:
    """Slopes ``(…, …, 2)`` along columns and rows of normals, continued as the padded heights are."""
    slopes = -normals[..., :2].astype(np.float64) / normals[..., 2:]
    padded = []
    for component, own in enumerate((1, 0)):
        # Heights are reflected oddly: the slope across a border evenly, that along it oddly.
        values = slopes[..., component]
        for axis in (0, 1):
            margin = [(0, 0), (0, 0)]
            margin[axis] = (_OVERLAP, _OVERLAP)
            values = np.pad(values, margin, mode="reflect", reflect_type="even" if axis == own else "odd")
        padded.append(values)
    return np.stack(padded, axis=-1)


def _surface(heights: np.ndarray, slopes: np.ndarray, sides_m: tuple[float, float], screening: float) -> np.ndarray:
    """Heights ``(H, W)`` [m] of the surface χ = 0 through samples ``(H, W)`` [m] with slopes ``(H, W, 2)``.

    Cells have sides ``(dx, dy)`` [m].
    """
    dx, dy = sides_m
    dz = float(np.sqrt(dx * dy))
    # Levels begin at zero height in every tile, so that tiles share one grid.
    level = heights / dz
    band = _band(level)
    size = len(band.column)
    normals = np.concatenate([-slopes, np.ones((*slopes.shape[:2], 1))], axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    # Of a cell's ground along up [levels].
    extent = (np.abs(slopes[..., 0]) * dx + np.abs(slopes[..., 1]) * dy) / dz
    field = _splatted_normals(band, level, normals, extent) / dz

    diagonal, right = np.zeros(size), np.zeros(size)
    rows, columns, values = [], [], []

    def couple(one: np.ndarray, other: np.ndarray, weight: float) -> None:
        diagonal[one] += weight
        diagonal[other] += weight
        rows.extend((one, other))
        columns.extend((other, one))
        values.append(np.full(2 * len(one), -weight))

    for axis, (weight, step, component) in enumerate(
        ((dx * dz / dy, dy, field[:, 1]), (dy * dz / dx, dx, field[:, 0]))
    ):
        node, beside, inside, known = band.neighbours(axis)
        one, other = node[inside], beside[inside]
        couple(one, other, weight)
        flux = weight * step * 0.5 * (component[one] + component[other])
        # Flux out of a node counts against it: ∫ ∇φ · V of the weak form.
        right -= np.bincount(one, flux, size)
        right += np.bincount(other, flux, size)
        _wall(diagonal, right, node[~inside], known[~inside], weight)
        _wall(diagonal, right, *_reversed_walls(band, axis), weight)
    one = np.flatnonzero(band.column[:-1] == band.column[1:])
    weight = dx * dy / dz
    couple(one, one + 1, weight)
    flux = weight * dz * 0.5 * (field[one, 2] + field[one + 1, 2])
    right -= np.bincount(one, flux, size)
    right += np.bincount(one + 1, flux, size)
    bottom = band.start
    top = band.start + band.count.ravel() - 1
    _wall(diagonal, right, bottom, np.full(len(bottom), 0.5), weight)
    _wall(diagonal, right, top, np.full(len(top), -0.5), weight)

    below = band.start + np.floor(level).astype(np.int64).ravel() - band.base.ravel()
    share = (level - np.floor(level)).ravel()
    area = (dx * dy / normals[..., 2]).ravel()
    screen = screening / dz * area
    diagonal += np.bincount(below, screen * (1.0 - share) ** 2, size)
    diagonal += np.bincount(below + 1, screen * share**2, size)
    rows.extend((below, below + 1))
    columns.extend((below + 1, below))
    values.append(np.tile(screen * share * (1.0 - share), 2))

    coupling = coo_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=(size, size))
    matrix = (coupling + diags_array(diagonal)).tocsr()
    guess = np.clip(level.ravel()[band.column] - band.level, -0.5, 0.5)
    chi, failed = cg(matrix, right, guess, rtol=_TOLERANCE, maxiter=2000, M=diags_array(1.0 / diagonal).tocsr())
    if failed:
        raise RuntimeError("screened Poisson: conjugate gradients did not converge")
    return dz * _topmost_root(band, chi)


def _splatted_normals(band: _Band, level: np.ndarray, normals: np.ndarray, extent: np.ndarray) -> np.ndarray:
    """∇χ of the samples ``(N, 3)`` [1/level]: minus their normals, each over the ground of its cell."""
    # Along up: a box as high as the cell's ground, blurred by the B-spline. At least half a level, so that it is smooth.
    half = np.maximum(extent, 0.5).ravel()[band.column] / 2.0
    above = band.level - level.ravel()[band.column]
    density = (_spline_integral(above + half) - _spline_integral(above - half)) / (2.0 * half)
    steep = normals / normals[..., 2:]
    field = -density[:, None] * steep.reshape(-1, 3)[band.column]
    for axis in (0, 1):
        node, beside, inside, _ = band.neighbours(axis)
        one, other = node[inside], beside[inside]
        blurred = 0.75 * field
        blurred[one] += 0.125 * field[other]
        blurred[other] += 0.125 * field[one]
        field = blurred
    return field


def _spline_integral(x: np.ndarray) -> np.ndarray:
    """Integral of the quadratic B-spline from −∞ to ``x`` [cells]."""
    x = np.clip(x, -1.5, 1.5)
    side = np.abs(x)
    middle = 0.75 * side - side**3 / 3.0
    outer = 0.5 - (1.5 - side) ** 3 / 6.0
    return 0.5 + np.sign(x) * np.where(side < 0.5, middle, outer)


def _reversed_walls(band: _Band, axis: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes whose previous column along an axis has no node beside them, and the χ known there."""
    width = band.base.shape[1]
    row, column = np.divmod(band.column, width)
    node = np.flatnonzero((row > 0) if axis == 0 else (column > 0))
    beside = band.column[node] - (width if axis == 0 else 1)
    offset = band.level[node] - band.base.ravel()[beside]
    outside = (offset < 0) | (offset >= band.count.ravel()[beside])
    return node[outside], np.where(offset[outside] < 0, 0.5, -0.5)


def _wall(diagonal: np.ndarray, right: np.ndarray, node: np.ndarray, known: np.ndarray, weight: float) -> None:
    """Couple nodes to a χ that is known, where no normals reach."""
    size = len(right)
    diagonal += weight * np.bincount(node, minlength=size)
    right += weight * np.bincount(node, known, size)


def _topmost_root(band: _Band, chi: np.ndarray) -> np.ndarray:
    """Level ``(H, W)`` at which χ, followed from above, turns positive."""
    index = np.arange(len(chi))
    last = np.maximum.reduceat(np.where(chi >= 0.0, index, -1), band.start)
    # The walls are at half: a column's lowest node may itself be above the surface only where the band missed it.
    if np.any(last < band.start):
        raise RuntimeError("screened Poisson: the surface left the band")
    top = band.start + band.count.ravel() - 1
    above = np.where(last < top, chi[np.minimum(last + 1, len(chi) - 1)], -0.5)
    root = band.level[last] + chi[last] / (chi[last] - above)
    return root.reshape(band.base.shape)
