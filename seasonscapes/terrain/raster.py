"""Map grids: windowed reading of any GDAL raster, holes, sampling, and the way from its map to WGS 84.

Only the horizontal position is ever transformed. Heights stay in the raster's own vertical datum.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from affine import Affine

from seasonscapes.declaration import InputError
from seasonscapes.frames import LocalFrame, enu_from_geodetic
from seasonscapes.terrain.crs import apply_affine, geodetic_from_map, horizontal_crs, map_from_geodetic
from seasonscapes.terrain.hole_filling import harmonic_fill, nan_mean
from seasonscapes.terrain.surface import Raster

# From the shore of the Dead Sea (-430 m) to above Mount Everest (8,849 m). Feet, centimetres, unmarked nodata and
# colour bands mistaken for heights all fall outside somewhere.
PLAUSIBLE_ELEVATION_M = (-500.0, 9000.0)
DEFAULT_MAX_HOLE_SHARE = 0.25


@dataclass(frozen=True)
class FillReport:
    """What `fill_nodata` had to make up.

    Parameters
    ----------
    filled_cells
        Number of cells without data.
    share
        Their share of the raster, in [0, 1].
    holes
        Number of connected holes (8 neighbours).
    largest_hole_cells
        Cells of the largest hole.
    """

    filled_cells: int
    share: float
    holes: int
    largest_hole_cells: int


# ---------------------------------------------------------------------------------------------- reading


def read_elevation(
    path: str | os.PathLike, *, bounds_deg: tuple[float, float, float, float] | None = None, band: int | None = None
) -> Raster:
    """Read a raster of heights, one band, and check that they can be heights in metres.

    Parameters
    ----------
    path, bounds_deg
        As in `read_raster`.
    band
        Which band holds the heights, from 1; needed only where the file has several.

    Returns
    -------
    Raster
        ``values`` ``(H, W, 1)`` float32 [m], NaN where there is no data.

    Raises
    ------
    InputError
        As `read_raster`; several bands and none named; heights outside −500 … 9000 m.
    """
    raster = read_raster(path, bounds_deg=bounds_deg, bands=None if band is None else (band,))
    count = raster.values.shape[2]
    if count != 1:
        raise InputError(
            path,
            "more than one band",
            got=count,
            expected="one band of heights",
            cure="name the band that holds the heights",
        )
    if np.isfinite(raster.values).any():
        low, high = float(np.nanmin(raster.values)), float(np.nanmax(raster.values))
        if low < PLAUSIBLE_ELEVATION_M[0] or high > PLAUSIBLE_ELEVATION_M[1]:
            raise InputError(
                path,
                "heights that no place on land has",
                got=f"{low:g} … {high:g}",
                expected=f"{PLAUSIBLE_ELEVATION_M[0]:g} … {PLAUSIBLE_ELEVATION_M[1]:g} m",
                cure="check unit (metres), band, and that the file declares its nodata",
            )
    return raster


def read_raster(
    path: str | os.PathLike,
    *,
    bounds_deg: tuple[float, float, float, float] | None = None,
    bands: tuple[int, ...] | None = None,
    finest_m: float | None = None,
    decode: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Raster:
    """Read a raster that GDAL knows (GeoTIFF, SRTM ``.hgt``, VRT mosaic …), or a window of it.

    Parameters
    ----------
    bounds_deg
        West, south, east, north in WGS 84 [deg]. Only the smallest window of whole pixels around them is read, with
        one pixel to spare for interpolation, in the raster's own grid (nothing is resampled). Left out: all of it.
    bands
        Band numbers from 1; left out: all but an alpha band, which becomes NaN.
    finest_m
        Pixels smaller than this on the ground are averaged in whole square blocks, as large as fit into it, while
        reading: an image far finer than its use [m] then never lies in memory whole.
    decode
        Applied to values before they are averaged (sRGB must be made linear first).

    Returns
    -------
    Raster
        ``values`` ``(H, W, C)`` float32 after the file's own scale and offset; NaN where the file has no data, masks
        it, or alpha is 0.

    Raises
    ------
    InputError
        No such file, unreadable, no CRS or no placement on the map, degrees where metres are meant or the other way
        round, a band that is not there, or a window that does not touch the raster.
    """
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    if not os.fspath(path).startswith("/vsi") and not Path(path).is_file():
        raise InputError(path, "no such file")
    if finest_m is not None and not finest_m > 0.0:
        raise ValueError(f"finest_m: got {finest_m}, expected a positive size")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.open(path) as source:
                crs = _checked_crs(source, path)
                bands = _checked_bands(source, bands, path)
                window = _window(source, crs, bounds_deg, path)
                shrink = 1 if finest_m is None else _shrink(source, crs, window, finest_m)
                values = _read_blocks(source, bands, window, shrink, decode)
                transform = _window_transform(source.transform, window, shrink)
    except RasterioError as error:
        raise InputError(path, f"not readable as a raster: {error}") from None
    return Raster(values, transform, crs)


def _checked_crs(source, path) -> str:
    if source.crs is None:
        raise InputError(path, "the raster has no CRS", cure="say which with: gdal_edit.py -a_srs EPSG:… FILE")
    if source.transform == Affine.identity():
        raise InputError(
            path,
            "the raster has a CRS but no placement on the map (geotransform)",
            cure="write one with: gdal_edit.py -a_ullr … FILE",
        )
    text = source.crs.to_string()
    width, height = source.width, source.height
    corners = np.stack(apply_affine(source.transform, [0, width, 0, width], [0, 0, height, height]), axis=-1)
    extent = f"x {corners[:, 0].min():g} … {corners[:, 0].max():g}, y {corners[:, 1].min():g} … {corners[:, 1].max():g}"
    pixel = max(abs(source.transform.a), abs(source.transform.b), abs(source.transform.d), abs(source.transform.e))
    crs = horizontal_crs(text)
    if crs.is_geographic:
        # 0…360° longitudes are in use; half a pixel past the pole is how .hgt grids lie.
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
            f"degrees where metres are meant, in the projected CRS {text}",
            got=extent,
            cure="the file's CRS is probably EPSG:4326",
        )
    return text


def _checked_bands(source, bands, path) -> tuple[int, ...]:
    if bands is None:
        return tuple(band for band in source.indexes if band != _alpha_band(source))
    for band in bands:
        if band not in source.indexes:
            raise InputError(path, "no such band", got=band, expected=f"1 … {source.count}")
    return tuple(bands)


def _alpha_band(source) -> int | None:
    """The band that says where there is an image: by its colour interpretation, or by its own description."""
    from rasterio.enums import ColorInterp

    for band, kind, text in zip(source.indexes, source.colorinterp, source.descriptions, strict=True):
        if kind == ColorInterp.alpha or (text or "").lower().startswith("alpha"):
            return band
    return None


def _window(source, crs: str, bounds_deg, path):
    from rasterio.windows import Window

    if bounds_deg is None:
        return Window(0, 0, source.width, source.height)
    longitude, latitude = _boundary(*_checked_bounds(bounds_deg))
    x, y = map_from_geodetic(crs, latitude, longitude)
    column, row = apply_affine(~source.transform, x, y)
    # Outward to whole pixels, and one pixel more so that bilinear interpolation reaches the bounds.
    left, right = int(np.floor(column.min())) - 1, int(np.ceil(column.max())) + 1
    top, bottom = int(np.floor(row.min())) - 1, int(np.ceil(row.max())) + 1
    left, top = max(left, 0), max(top, 0)
    right, bottom = min(right, source.width), min(bottom, source.height)
    if right - left < 2 or bottom - top < 2:
        extent = _bounds_deg(crs, source.transform, source.width, source.height)
        raise InputError(
            path,
            "the raster does not reach the area asked for",
            got=_bounds_text(extent),
            expected=_bounds_text(bounds_deg),
        )
    return Window(left, top, right - left, bottom - top)


def _checked_bounds(bounds_deg) -> tuple[float, float, float, float]:
    west, south, east, north = bounds_deg
    if not (west < east and -90.0 <= south < north <= 90.0):
        raise ValueError(f"bounds_deg: got {bounds_deg}, expected west < east and south < north in degrees")
    return west, south, east, north


def _shrink(source, crs: str, window, finest_m: float) -> int:
    """How many pixels fit side by side into ``finest_m`` in the middle of the window; at least 2 blocks must remain."""
    column, row = window.col_off + window.width / 2.0, window.row_off + window.height / 2.0
    x, y = apply_affine(source.transform, column + np.array([0.0, 1.0, 0.0]), row + np.array([0.0, 0.0, 1.0]))
    latitude, longitude = geodetic_from_map(crs, x, y)
    place = enu_from_geodetic(LocalFrame(float(latitude[0]), float(longitude[0])), latitude, longitude, 0.0)
    pixel_m = np.linalg.norm(place[1:], axis=1).max()
    # The slack keeps an exact multiple exact.
    return int(np.clip(np.floor(finest_m / pixel_m + 1e-6), 1, max(1, min(window.width, window.height) // 2)))


def _window_transform(transform: Affine, window, shrink: int) -> Affine:
    a, b, _, d, e, _ = tuple(transform)[:6]
    x, y = apply_affine(transform, window.col_off, window.row_off)
    return Affine(a * shrink, b * shrink, float(x), d * shrink, e * shrink, float(y))


def _read_blocks(source, bands, window, shrink, decode) -> np.ndarray:
    """Read strip by strip, so that only the result is ever whole in memory."""
    from rasterio.windows import Window

    height, width = int(window.height) // shrink, int(window.width) // shrink
    scale = np.array([source.scales[band - 1] for band in bands], np.float64)
    offset = np.array([source.offsets[band - 1] for band in bands], np.float64)
    values = np.empty((height, width, len(bands)), np.float32)
    alpha = _alpha_band(source)
    strip = max(1, 2**22 // max(1, width * shrink * len(bands)) // shrink)
    for row in range(0, height, strip):
        rows = min(strip, height - row)
        part = Window(window.col_off, window.row_off + row * shrink, width * shrink, rows * shrink)
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


def _boundary(west, south, east, north, steps: int = 33) -> tuple[np.ndarray, np.ndarray]:
    """Points along the sides of a box: the edges of a map rarely stay straight in another."""
    t = np.linspace(0.0, 1.0, steps)
    x, y = west + (east - west) * t, south + (north - south) * t
    return (
        np.concatenate([x, x, np.full(steps, west), np.full(steps, east)]),
        np.concatenate([np.full(steps, south), np.full(steps, north), y, y]),
    )


def _bounds_deg(crs, transform, width, height) -> tuple[float, float, float, float]:
    latitude, longitude = geodetic_from_map(crs, *apply_affine(transform, *_boundary(0.0, 0.0, width, height)))
    if not (np.isfinite(latitude).all() and np.isfinite(longitude).all()):
        raise InputError(crs, "the raster's edge lies outside the area of its CRS", cure="the CRS is probably wrong")
    return float(longitude.min()), float(latitude.min()), float(longitude.max()), float(latitude.max())


def bounds_geographic(raster: Raster) -> tuple[float, float, float, float]:
    """West, south, east, north of the raster's outer edges in WGS 84 [deg]."""
    height, width = raster.values.shape[:2]
    return _bounds_deg(raster.crs, raster.transform, width, height)


def centre_frame(raster: Raster, *, height_m: float = 0.0, refraction_k: float = 0.0) -> LocalFrame:
    """A `LocalFrame` whose origin is the middle of the raster."""
    height, width = raster.values.shape[:2]
    latitude, longitude = geodetic_from_map(raster.crs, *apply_affine(raster.transform, width / 2.0, height / 2.0))
    return LocalFrame(float(latitude), float(longitude), height_m, refraction_k)


def _bounds_text(bounds_deg) -> str:
    return "W {:.4f} S {:.4f} E {:.4f} N {:.4f}".format(*bounds_deg)


def require_overlap(raster: Raster, other: Raster, *, where: str | os.PathLike, other_name: str = "elevation") -> None:
    """Raise `InputError` about ``describe_position`` (the file of ``raster``) unless the two rasters share ground."""
    a, b = bounds_geographic(raster), bounds_geographic(other)
    if max(a[0], b[0]) >= min(a[2], b[2]) or max(a[1], b[1]) >= min(a[3], b[3]):
        raise InputError(
            where,
            f"does not overlap the {other_name} raster",
            got=_bounds_text(a),
            expected=_bounds_text(b),
            cure="check the CRS of both files",
        )


# ---------------------------------------------------------------------------------------------- values


def sample_raster(raster: Raster, x, y) -> np.ndarray:
    """Bilinear values ``(..., C)`` at map coordinates ``(...)``, exact at pixel centres.

    NaN outside the raster and where any of the four pixels that count is NaN. The half pixel between the outermost
    centres and the edge repeats the outermost values.
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
            # 0 · NaN would spread a hole to samples that do not touch it.
            total += np.where(weight > 0.0, weight * raster.values[r, c], 0.0)
    return np.where(inside[..., None], total, np.nan)


def fill_nodata(
    raster: Raster, *, max_share: float = DEFAULT_MAX_HOLE_SHARE, where: str | os.PathLike = "raster"
) -> tuple[Raster, FillReport]:
    """Fill cells without data by the smoothest surface through their rims (discrete harmonic, ∇²z = 0).

    A membrane neither overshoots nor invents peaks. Where a hole reaches the raster's edge the slope across that edge
    is zero.

    Parameters
    ----------
    max_share
        Share of cells that may be made up.
    where
        Name of the file for the message.

    Raises
    ------
    InputError
        The raster is empty, or more than ``max_share`` of it is.
    """
    from scipy import ndimage

    hole = ~np.isfinite(raster.values).all(axis=2)
    cells = int(hole.sum())
    if cells == 0:
        return raster, FillReport(0, 0.0, 0, 0)
    if cells == hole.size:
        raise InputError(where, "no data at all in the area asked for", cure="check area and nodata value")
    share = cells / hole.size
    if share > max_share:
        raise InputError(
            where,
            "too much of the area has no data",
            got=f"{100 * share:.1f} %",
            expected=f"at most {100 * max_share:g} %",
            cure="choose another area or raster",
        )
    labels, holes = ndimage.label(hole, structure=np.ones((3, 3), int))
    largest = int(np.bincount(labels.ravel())[1:].max())
    values = np.stack([harmonic_fill(raster.values[..., c], hole) for c in range(raster.values.shape[2])], axis=2)
    return replace(raster, values=values), FillReport(cells, share, holes, largest)
