"""Georeferenced rasters: windowed reading with GDAL, extent, bilinear sampling, hole filling.

Only horizontal positions are transformed. Heights stay in the raster's own vertical datum.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, cast

import numpy as np
from affine import Affine
from numpy.typing import ArrayLike

from seasonscapes.declaration import InputError
from seasonscapes.frames import LocalFrame, normal_longitude
from seasonscapes.terrain.crs import apply_affine, geodetic_from_map, grid_position, wrapped
from seasonscapes.terrain.heights import check_height_band, check_heights, declared_unit, to_metres
from seasonscapes.terrain.hole_filling import harmonic_fill, nan_mean
from seasonscapes.terrain.memory import check_memory
from seasonscapes.terrain.placement import cell_sides_m, centre_deg, check_cells, check_place, checked_crs, likely_cause
from seasonscapes.terrain.raster_bands import BandReader, band_reader
from seasonscapes.terrain.raster_files import OWN_FOLDER, Confinement, open_raster
from seasonscapes.terrain.surface import Raster

if TYPE_CHECKING:
    from rasterio.io import DatasetReader
    from rasterio.windows import Window

DEFAULT_MAX_HOLE_SHARE = 0.25


@dataclass(frozen=True)
class FillReport:
    """Number and size of the holes that `fill_nodata` has filled.

    Parameters
    ----------
    filled_cells
        Number of cells without data.
    share
        ``filled_cells`` as a fraction of the raster, in [0, 1].
    holes
        Number of connected holes (8-neighbourhood).
    largest_hole_cells
        Number of cells of the largest hole.
    """

    filled_cells: int
    share: float
    holes: int
    largest_hole_cells: int


# ---------------------------------------------------------------------------------------------- reading


def raster_grid(path: str | os.PathLike[str], confinement: Confinement = OWN_FOLDER) -> Raster:
    """The grid of a raster file without its values.

    Returns
    -------
    Raster
        ``values`` of shape ``(H, W, 0)``.
    """
    with open_raster(path, confinement) as source:
        crs = checked_crs(source, os.fspath(path))
        return _grid(source, crs, _window(source, crs, None, os.fspath(path)))


def _grid(source: DatasetReader, crs: str, window: Window) -> Raster:
    shape = (int(window.height), int(window.width), 0)
    return Raster(np.empty(shape, np.float32), _window_transform(source.transform, window, 1), crs)


def read_elevation(
    path: str | os.PathLike[str],
    *,
    bounds_deg: tuple[float, float, float, float] | None = None,
    band: int | None = None,
    unit: str | None = None,
    nodata: float | None = None,
    finest_m: float | None = None,
    confinement: Confinement = OWN_FOLDER,
) -> Raster:
    """Read an elevation raster of one band as heights in metres, and check that land has such heights.

    A unit that the file declares, by its band or its vertical CRS, is converted to metres, and this is told.

    Parameters
    ----------
    path, bounds_deg, finest_m, confinement
        As in `read_raster`.
    band
        Number of the band that holds the heights, from 1; required if the file has several bands.
    unit
        Unit of the heights, a key of `terrain.heights.UNITS_M`; ``None`` for the one that the file declares, else metres.
    nodata
        Value that means no data, in the file's own unit, besides what the file declares.

    Returns
    -------
    Raster
        ``values`` ``(H, W, 1)`` float32 [m], NaN where there is no data.

    Raises
    ------
    InputError
        As `read_raster`; several bands and ``band`` is ``None``; more samples than fit into memory; an unknown unit; cells
        or heights that no landscape has.
    """
    where = os.fspath(path)
    with open_raster(path, confinement) as source:
        crs = checked_crs(source, where)
        grid = _grid(source, crs, _window(source, crs, bounds_deg, where))
        reader = band_reader(source, None if band is None else (band,), where)
        if len(reader.bands) != 1:
            raise InputError(
                where,
                "more than one band",
                got=len(reader.bands),
                expected="one band of heights",
                cure="name the band that holds the heights",
            )
        check_height_band(source, reader.bands[0], where)
        declared = unit or declared_unit(source, reader.bands[0], where)
    check_cells(grid, where)
    shrink = 1 if finest_m is None else _shrink(grid, finest_m)
    check_memory((grid.values.shape[0] // shrink, grid.values.shape[1] // shrink), where)

    def known(values: np.ndarray) -> np.ndarray:
        return values if nodata is None else np.where(values == nodata, np.float32(np.nan), values)

    raster = read_raster(
        path, bounds_deg=bounds_deg, bands=reader.bands, finest_m=finest_m, decode=known, confinement=confinement
    )
    raster = replace(raster, values=to_metres(raster.values, declared, where))
    check_heights(raster, where, unit=declared, nodata=nodata)
    return raster


def read_raster(
    path: str | os.PathLike[str],
    *,
    bounds_deg: tuple[float, float, float, float] | None = None,
    bands: tuple[int, ...] | None = None,
    finest_m: float | None = None,
    decode: Callable[[np.ndarray], np.ndarray] | None = None,
    confinement: Confinement = OWN_FOLDER,
) -> Raster:
    """Read a raster (GeoTIFF, SRTM ``.hgt``, VRT mosaic …), or a window of it; see `terrain.raster_files`.

    Parameters
    ----------
    path
        File; where ``confinement`` trusts it, also a GDAL ``/vsi…`` path.
    bounds_deg
        West, south, east, north in WGS 84 [deg]. The smallest window of whole pixels that contains them, plus a border
        of one pixel for interpolation, is read in the raster's own grid (without resampling). ``None`` for the whole
        raster.
    bands
        Band numbers from 1; ``None`` for all bands except alpha. Pixels of zero alpha become NaN.
    finest_m
        Smallest useful pixel size [m]: square blocks of pixels that fit into it are averaged while reading, so that the
        full-resolution image is never held in memory.
    decode
        Function applied to values before averaging, such as sRGB decoding.
    confinement
        Where the raster's files may lie; by default in its own folder.

    Returns
    -------
    Raster
        ``values`` ``(H, W, C)`` float32 after the file's own scale and offset; NaN for nodata and masked pixels and
        where alpha is 0.

    Raises
    ------
    InputError
        Missing or unreadable file, no CRS or geotransform, coordinates that contradict the CRS's units, a missing band,
        or a window that does not overlap the raster.
    ValueError
        ``finest_m`` is not positive, or ``bounds_deg`` is not an ordered box.
    """
    if finest_m is not None and not finest_m > 0.0:
        raise ValueError(f"finest_m: got {finest_m}, expected a positive size")
    where = os.fspath(path)
    with open_raster(path, confinement) as source:
        crs = checked_crs(source, where)
        reader = band_reader(source, bands, where)
        window = _window(source, crs, bounds_deg, where)
        shrink = 1 if finest_m is None else _shrink(_grid(source, crs, window), finest_m)
        window = _whole_blocks(window, shrink, source)
        values = _read_blocks(reader, window, shrink, decode)
        transform = _window_transform(source.transform, window, shrink)
    return Raster(values, transform, crs)


def _window(source: DatasetReader, crs: str, bounds_deg: tuple[float, float, float, float] | None, path: str) -> Window:
    from rasterio.windows import Window

    check_place(crs, source.transform, source.width, source.height, path)
    if min(source.width, source.height) < 2:
        raise InputError(path, "too few samples", got=f"{source.width} × {source.height}", expected="at least 2 × 2")
    if bounds_deg is None:
        return Window(0, 0, source.width, source.height)  # pyright: ignore[reportCallIssue]
    longitude, latitude = _boundary(*_checked_bounds(bounds_deg))
    x, y = grid_position(crs, source.transform, (source.width, source.height), latitude, longitude)
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise _no_overlap(source, crs, bounds_deg, path)
    column, row = apply_affine(~source.transform, x, y)
    # Round outwards to whole pixels and add one pixel, so that bilinear interpolation covers the bounds.
    left, right = int(np.floor(column.min())) - 1, int(np.ceil(column.max())) + 1
    top, bottom = int(np.floor(row.min())) - 1, int(np.ceil(row.max())) + 1
    left, top = max(left, 0), max(top, 0)
    right, bottom = min(right, source.width), min(bottom, source.height)
    if right - left < 2 or bottom - top < 2:
        raise _no_overlap(source, crs, bounds_deg, path)
    return Window(left, top, right - left, bottom - top)  # pyright: ignore[reportCallIssue]


def _no_overlap(
    source: DatasetReader, crs: str, bounds_deg: tuple[float, float, float, float], path: str
) -> InputError:
    west, south, east, north = bounds_deg
    grid = Raster(np.empty((source.height, source.width, 0), np.float32), source.transform, crs)
    return InputError(
        path,
        "the raster does not overlap the requested area",
        got=_bounds_text(_bounds_deg(crs, source.transform, source.width, source.height)),
        expected=_bounds_text(bounds_deg),
        cure=likely_cause(grid, 0.5 * (south + north), 0.5 * (west + east)),
    )


def _checked_bounds(bounds_deg: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    west, south, east, north = bounds_deg
    if not (west < east and -90.0 <= south < north <= 90.0):
        raise ValueError(f"bounds_deg: got {bounds_deg}, expected west < east and south < north in degrees")
    return west, south, east, north


def _shrink(grid: Raster, finest_m: float) -> int:
    """Side [px] of the averaging blocks: pixels per ``finest_m`` at the grid's centre, leaving at least 2 × 2 blocks."""
    # The tolerance keeps rounding errors from reducing an exact multiple.
    wanted = np.floor(finest_m / max(cell_sides_m(grid)) + 1e-6)
    return int(np.clip(wanted, 1, max(1, min(grid.values.shape[:2]) // 2)))


def _whole_blocks(window: Window, shrink: int, source: DatasetReader) -> Window:
    """The window widened to whole blocks that are counted from the raster's corner, as far as the raster has them."""
    from rasterio.windows import Window

    left, top = (int(offset) // shrink * shrink for offset in (window.col_off, window.row_off))
    right, bottom = (
        max(start + 2 * shrink, min(-(-int(stop) // shrink), length // shrink) * shrink)
        for start, stop, length in (
            (left, window.col_off + window.width, source.width),
            (top, window.row_off + window.height, source.height),
        )
    )
    if right > source.width or bottom > source.height:
        # A narrow strip at the rim of the raster.
        return window
    return Window(left, top, right - left, bottom - top)  # pyright: ignore[reportCallIssue]


def _window_transform(transform: Affine, window: Window, shrink: int) -> Affine:
    a, b, _, d, e, _ = tuple(transform)[:6]
    x, y = apply_affine(transform, window.col_off, window.row_off)
    return Affine(a * shrink, b * shrink, float(x), d * shrink, e * shrink, float(y))


def _read_blocks(
    reader: BandReader, window: Window, shrink: int, decode: Callable[[np.ndarray], np.ndarray] | None
) -> np.ndarray:
    """Read, decode and average a window in strips, so that only the averaged result is held in memory."""
    from rasterio.windows import Window

    height, width, channels = int(window.height) // shrink, int(window.width) // shrink, reader.channels
    values = np.empty((height, width, channels), np.float32)
    strip = max(1, 2**22 // max(1, width * shrink * channels) // shrink)
    for row in range(0, height, strip):
        rows = min(strip, height - row)
        top = window.row_off + row * shrink
        block = reader.read(Window(window.col_off, top, width * shrink, rows * shrink))  # pyright: ignore[reportCallIssue]
        if decode is not None:
            block = decode(block)
        if shrink > 1:
            block = nan_mean(block.reshape(rows, shrink, width, shrink, channels), axes=(1, 3))
        values[row : row + rows] = block
    return values


# ---------------------------------------------------------------------------------------------- extent


def _boundary(west: float, south: float, east: float, north: float, steps: int = 33) -> tuple[np.ndarray, np.ndarray]:
    """Points along the sides of a box, because straight edges become curves in another projection."""
    t = np.linspace(0.0, 1.0, steps)
    x, y = west + (east - west) * t, south + (north - south) * t
    return (
        np.concatenate([x, x, np.full(steps, west), np.full(steps, east)]),
        np.concatenate([np.full(steps, south), np.full(steps, north), y, y]),
    )


def _bounds_deg(crs: str, transform: Affine, width: int, height: int) -> tuple[float, float, float, float]:
    latitude, longitude = geodetic_from_map(crs, *apply_affine(transform, *_boundary(0.0, 0.0, width, height)))
    if not (np.isfinite(latitude).all() and np.isfinite(longitude).all()):
        raise InputError(crs, "the raster's edge lies outside the area of its CRS", cure="the CRS is probably wrong")
    longitude = wrapped(longitude, normal_longitude(centre_deg(crs, transform, width, height)[1]), 360.0)
    return float(longitude.min()), float(latitude.min()), float(longitude.max()), float(latitude.max())


def bounds_geographic(raster: Raster) -> tuple[float, float, float, float]:
    """Compute the geographic bounding box of a raster's outer edges.

    Parameters
    ----------
    raster
        Supplies size, transform and CRS.

    Returns
    -------
    tuple
        West, south, east, north in WGS 84 [deg]; west < east even across the antimeridian, where one is beyond ±180°.

    Raises
    ------
    InputError
        The raster's edge lies outside the domain of its CRS.
    """
    height, width = raster.values.shape[:2]
    return _bounds_deg(raster.crs, raster.transform, width, height)


def centre_frame(raster: Raster, *, height_m: float = 0.0, refraction_k: float = 0.0) -> LocalFrame:
    """Create a local frame with its origin at the centre of a raster.

    Parameters
    ----------
    raster
        Supplies size, transform and CRS.
    height_m
        Height of the origin in the raster's vertical datum [m].
    refraction_k
        Coefficient of terrestrial refraction; see `LocalFrame`.

    Returns
    -------
    LocalFrame
        The frame.
    """
    height, width = raster.values.shape[:2]
    latitude, longitude = centre_deg(raster.crs, raster.transform, width, height)
    return LocalFrame(latitude, normal_longitude(longitude), height_m, refraction_k)


def _bounds_text(bounds_deg: tuple[float, float, float, float]) -> str:
    return "W {:.4f} S {:.4f} E {:.4f} N {:.4f}".format(*bounds_deg)


def require_overlap(
    raster: Raster, other: Raster, *, where: str | os.PathLike[str], other_name: str = "elevation"
) -> None:
    """Raise `InputError` unless the geographic bounding boxes of two rasters overlap.

    Parameters
    ----------
    raster, other
        The rasters to compare.
    where
        File of ``raster``, for the message.
    other_name
        Name of ``other`` in the message.

    Raises
    ------
    InputError
        The bounding boxes are disjoint.
    """
    a, b = bounds_geographic(raster), bounds_geographic(other)
    shift = float(wrapped(a[0], b[0], 360.0)) - a[0]
    a = (a[0] + shift, a[1], a[2] + shift, a[3])
    if max(a[0], b[0]) >= min(a[2], b[2]) or max(a[1], b[1]) >= min(a[3], b[3]):
        raise InputError(
            os.fspath(where),
            f"does not overlap the {other_name} raster",
            got=_bounds_text(a),
            expected=_bounds_text(b),
            cure=likely_cause(raster, 0.5 * (b[1] + b[3]), 0.5 * (b[0] + b[2])) or "check the CRS of both files",
        )


# ---------------------------------------------------------------------------------------------- values


def sample_raster(raster: Raster, x: ArrayLike, y: ArrayLike) -> np.ndarray:
    """Interpolate a raster bilinearly at map coordinates.

    Values are exact at pixel centres and constant across the half pixel between the outermost centres and the edge.

    Parameters
    ----------
    raster
        ``values`` ``(H, W, C)``.
    x, y
        Map coordinates ``(...)``.

    Returns
    -------
    numpy.ndarray
        ``(..., C)`` float64; NaN outside the raster and where a pixel of non-zero weight is NaN.
    """
    height, width = raster.values.shape[:2]
    column, row = apply_affine(~raster.transform, x, y)
    with np.errstate(invalid="ignore"):
        inside = (column >= 0.0) & (column <= width) & (row >= 0.0) & (row <= height)
    column = np.clip(np.where(inside, column, 0.0) - 0.5, 0.0, width - 1.0)
    row = np.clip(np.where(inside, row, 0.0) - 0.5, 0.0, height - 1.0)
    column0, row0 = np.minimum(column.astype(int), max(width - 2, 0)), np.minimum(row.astype(int), max(height - 2, 0))
    column1, row1 = np.minimum(column0 + 1, width - 1), np.minimum(row0 + 1, height - 1)
    fx, fy = (column - column0)[..., None], (row - row0)[..., None]
    total = np.zeros(np.shape(column) + raster.values.shape[2:])
    for r, wy in ((row0, 1.0 - fy), (row1, fy)):
        for c, wx in ((column0, 1.0 - fx), (column1, fx)):
            weight = wy * wx
            # Zero weights are masked, because 0 · NaN = NaN.
            total += np.where(weight > 0.0, weight * raster.values[r, c], 0.0)
    return np.where(inside[..., None], total, np.nan)


def fill_nodata(
    raster: Raster, *, max_share: float = DEFAULT_MAX_HOLE_SHARE, where: str | os.PathLike[str] = "raster"
) -> tuple[Raster, FillReport]:
    """Fill cells without data by harmonic interpolation (∇²z = 0 with the surrounding cells as boundary values).

    By the maximum principle the filled values stay within the range of the surrounding ones. Where a hole reaches the
    raster's edge, the normal derivative is zero.

    Parameters
    ----------
    raster
        Raster with NaN in cells without data.
    max_share
        Largest acceptable fraction of missing cells.
    where
        Name of the file, for the message.

    Returns
    -------
    raster
        The raster without NaN.
    report
        Number and size of the holes.

    Raises
    ------
    InputError
        All cells are missing, or more than ``max_share`` of them.
    """
    hole = ~np.all(np.isfinite(raster.values), axis=2)
    cells = int(hole.sum())
    if cells == 0:
        return raster, FillReport(0, 0.0, 0, 0)
    from scipy import ndimage

    if cells == hole.size:
        raise InputError(os.fspath(where), "no data at all in the requested area", cure="check area and nodata value")
    share = cells / hole.size
    if share > max_share:
        raise InputError(
            os.fspath(where),
            "too much of the area has no data",
            got=f"{100 * share:.1f} %",
            expected=f"at most {100 * max_share:g} %",
            cure="choose another area or raster",
        )
    labels, holes = cast(tuple[np.ndarray, int], ndimage.label(hole, structure=np.ones((3, 3), int)))
    largest = int(np.bincount(labels.ravel())[1:].max())
    values = np.stack([harmonic_fill(raster.values[..., c], hole) for c in range(raster.values.shape[2])], axis=2)
    return replace(raster, values=values), FillReport(cells, share, holes, largest)
