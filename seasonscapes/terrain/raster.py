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
from seasonscapes.frames import LocalFrame, enu_from_geodetic
from seasonscapes.terrain.crs import apply_affine, geodetic_from_map, horizontal_crs, map_from_geodetic
from seasonscapes.terrain.hole_filling import harmonic_fill, nan_mean
from seasonscapes.terrain.raster_files import OWN_FOLDER, Confinement, open_raster
from seasonscapes.terrain.surface import Raster

if TYPE_CHECKING:
    from rasterio.io import DatasetReader
    from rasterio.windows import Window

# From the shore of the Dead Sea (-430 m) to above Mount Everest (8,849 m). Heights in feet or centimetres and
# undeclared nodata values usually exceed this range somewhere.
PLAUSIBLE_ELEVATION_M = (-500.0, 9000.0)
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


def read_elevation(
    path: str | os.PathLike[str],
    *,
    bounds_deg: tuple[float, float, float, float] | None = None,
    band: int | None = None,
    confinement: Confinement = OWN_FOLDER,
) -> Raster:
    """Read an elevation raster of one band and check that its values are plausible heights in metres.

    Parameters
    ----------
    path, bounds_deg, confinement
        As in `read_raster`.
    band
        Number of the band that holds the heights, from 1; required if the file has several bands.

    Returns
    -------
    Raster
        ``values`` ``(H, W, 1)`` float32 [m], NaN where there is no data.

    Raises
    ------
    InputError
        As `read_raster`; several bands and ``band`` is ``None``; heights outside −500 … 9000 m.
    """
    raster = read_raster(path, bounds_deg=bounds_deg, bands=None if band is None else (band,), confinement=confinement)
    count = raster.values.shape[2]
    if count != 1:
        raise InputError(
            os.fspath(path),
            "more than one band",
            got=count,
            expected="one band of heights",
            cure="name the band that holds the heights",
        )
    if np.isfinite(raster.values).any():
        low, high = float(np.nanmin(raster.values)), float(np.nanmax(raster.values))
        if low < PLAUSIBLE_ELEVATION_M[0] or high > PLAUSIBLE_ELEVATION_M[1]:
            raise InputError(
                os.fspath(path),
                "heights outside the range of land elevations",
                got=f"{low:g} … {high:g}",
                expected=f"{PLAUSIBLE_ELEVATION_M[0]:g} … {PLAUSIBLE_ELEVATION_M[1]:g} m",
                cure="check unit (metres), band, and that the file declares its nodata value",
            )
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
    with open_raster(path, confinement) as source:
        crs = _checked_crs(source, os.fspath(path))
        bands = _checked_bands(source, bands, os.fspath(path))
        window = _window(source, crs, bounds_deg, os.fspath(path))
        shrink = 1 if finest_m is None else _shrink(source, crs, window, finest_m)
        values = _read_blocks(source, bands, window, shrink, decode)
        transform = _window_transform(source.transform, window, shrink)
    return Raster(values, transform, crs)


def _checked_crs(source: DatasetReader, path: str) -> str:
    if source.crs is None:
        raise InputError(path, "the raster has no CRS", cure="assign one with: gdal_edit.py -a_srs EPSG:… FILE")
    if source.transform == Affine.identity():
        raise InputError(
            path, "the raster has a CRS but no geotransform", cure="assign one with: gdal_edit.py -a_ullr … FILE"
        )
    text = source.crs.to_string()
    width, height = source.width, source.height
    corners = np.stack(apply_affine(source.transform, [0, width, 0, width], [0, 0, height, height]), axis=-1)
    extent = f"x {corners[:, 0].min():g} … {corners[:, 0].max():g}, y {corners[:, 1].min():g} … {corners[:, 1].max():g}"
    pixel = max(abs(source.transform.a), abs(source.transform.b), abs(source.transform.d), abs(source.transform.e))
    crs = horizontal_crs(text)
    if crs.is_geographic:
        # Longitudes of 0…360° are in use; .hgt grids extend half a pixel beyond the pole.
        low, high = corners.min(0), corners.max(0)
        if low[1] < -90.0 - pixel or high[1] > 90.0 + pixel or low[0] < -180.0 - pixel or high[0] > 360.0 + pixel:
            raise InputError(
                path,
                f"coordinates beyond ±180°/±90° in the geographic CRS {text}",
                got=extent,
                expected="degrees",
                cure="the file's CRS is probably a projected one",
            )
    elif np.abs(corners).max() <= 360.0 and pixel < 1.0:
        raise InputError(
            path,
            f"coordinates in degrees in the projected CRS {text}",
            got=extent,
            cure="the file's CRS is probably EPSG:4326",
        )
    return text


def _checked_bands(source: DatasetReader, bands: tuple[int, ...] | None, path: str) -> tuple[int, ...]:
    if bands is None:
        return tuple(band for band in source.indexes if band != _alpha_band(source))
    for band in bands:
        if band not in source.indexes:
            raise InputError(path, "no such band", got=band, expected=f"1 … {source.count}")
    return tuple(bands)


def _alpha_band(source: DatasetReader) -> int | None:
    """Number of the alpha band, by its colour interpretation or description."""
    from rasterio.enums import ColorInterp

    for band, kind, text in zip(source.indexes, source.colorinterp, source.descriptions, strict=True):
        if kind == ColorInterp.alpha or (text or "").lower().startswith("alpha"):
            return band
    return None


def _window(source: DatasetReader, crs: str, bounds_deg: tuple[float, float, float, float] | None, path: str) -> Window:
    from rasterio.windows import Window

    if bounds_deg is None:
        return Window(0, 0, source.width, source.height)  # pyright: ignore[reportCallIssue]
    longitude, latitude = _boundary(*_checked_bounds(bounds_deg))
    x, y = map_from_geodetic(crs, latitude, longitude)
    column, row = apply_affine(~source.transform, x, y)
    # Round outwards to whole pixels and add one pixel, so that bilinear interpolation covers the bounds.
    left, right = int(np.floor(column.min())) - 1, int(np.ceil(column.max())) + 1
    top, bottom = int(np.floor(row.min())) - 1, int(np.ceil(row.max())) + 1
    left, top = max(left, 0), max(top, 0)
    right, bottom = min(right, source.width), min(bottom, source.height)
    if right - left < 2 or bottom - top < 2:
        extent = _bounds_deg(crs, source.transform, source.width, source.height)
        raise InputError(
            path,
            "the raster does not overlap the requested area",
            got=_bounds_text(extent),
            expected=_bounds_text(bounds_deg),
        )
    return Window(left, top, right - left, bottom - top)  # pyright: ignore[reportCallIssue]


def _checked_bounds(bounds_deg: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    west, south, east, north = bounds_deg
    if not (west < east and -90.0 <= south < north <= 90.0):
        raise ValueError(f"bounds_deg: got {bounds_deg}, expected west < east and south < north in degrees")
    return west, south, east, north


def _shrink(source: DatasetReader, crs: str, window: Window, finest_m: float) -> int:
    """Side [px] of the averaging blocks: pixels per ``finest_m`` at the window's centre, leaving at least 2 × 2 blocks."""
    column, row = window.col_off + window.width / 2.0, window.row_off + window.height / 2.0
    x, y = apply_affine(source.transform, column + np.array([0.0, 1.0, 0.0]), row + np.array([0.0, 0.0, 1.0]))
    latitude, longitude = geodetic_from_map(crs, x, y)
    position = enu_from_geodetic(LocalFrame(float(latitude[0]), float(longitude[0])), latitude, longitude, 0.0)
    pixel_m = np.linalg.norm(position[1:], axis=1).max()
    # The tolerance keeps rounding errors from reducing an exact multiple.
    return int(np.clip(np.floor(finest_m / pixel_m + 1e-6), 1, max(1, min(window.width, window.height) // 2)))


def _window_transform(transform: Affine, window: Window, shrink: int) -> Affine:
    a, b, _, d, e, _ = tuple(transform)[:6]
    x, y = apply_affine(transform, window.col_off, window.row_off)
    return Affine(a * shrink, b * shrink, float(x), d * shrink, e * shrink, float(y))


def _read_blocks(
    source: DatasetReader,
    bands: tuple[int, ...],
    window: Window,
    shrink: int,
    decode: Callable[[np.ndarray], np.ndarray] | None,
) -> np.ndarray:
    """Read, decode and average a window in strips, so that only the averaged result is held in memory."""
    from rasterio.windows import Window

    height, width = int(window.height) // shrink, int(window.width) // shrink
    scale = np.array([source.scales[band - 1] for band in bands], np.float64)
    offset = np.array([source.offsets[band - 1] for band in bands], np.float64)
    values = np.empty((height, width, len(bands)), np.float32)
    alpha = _alpha_band(source)
    strip = max(1, 2**22 // max(1, width * shrink * len(bands)) // shrink)
    for row in range(0, height, strip):
        rows = min(strip, height - row)
        top = window.row_off + row * shrink
        part = Window(window.col_off, top, width * shrink, rows * shrink)  # pyright: ignore[reportCallIssue]
        read = source.read(bands, window=part, masked=True)
        block = np.where(np.ma.getmaskarray(read), np.nan, read.data.astype(np.float64))
        if alpha is not None:
            block[:, source.read(alpha, window=part) == 0] = np.nan
        block = block.transpose(1, 2, 0) * scale + offset
        if decode is not None:
            block = decode(block)
        if shrink > 1:
            block = nan_mean(block.reshape(rows, shrink, width, shrink, len(bands)), axes=(1, 3))
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
        West, south, east, north in WGS 84 [deg].

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
    latitude, longitude = geodetic_from_map(raster.crs, *apply_affine(raster.transform, width / 2.0, height / 2.0))
    return LocalFrame(float(latitude), float(longitude), height_m, refraction_k)


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
    if max(a[0], b[0]) >= min(a[2], b[2]) or max(a[1], b[1]) >= min(a[3], b[3]):
        raise InputError(
            os.fspath(where),
            f"does not overlap the {other_name} raster",
            got=_bounds_text(a),
            expected=_bounds_text(b),
            cure="check the CRS of both files",
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
    from scipy import ndimage

    hole = ~np.all(np.isfinite(raster.values), axis=2)
    cells = int(hole.sum())
    if cells == 0:
        return raster, FillReport(0, 0.0, 0, 0)
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
