"""Horizontal transformations between map coordinates and WGS 84 (PROJ, without ballpark operations)."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from affine import Affine
from numpy.typing import ArrayLike

from seasonscapes.declaration import InputError
from seasonscapes.terrain.surface import Raster

if TYPE_CHECKING:
    from pyproj import CRS, Transformer


@lru_cache(maxsize=64)
def horizontal_crs(crs: str) -> CRS:
    """Return the horizontal part of a CRS; the vertical part is dropped so that heights are never transformed.

    Parameters
    ----------
    crs
        Coordinate reference system as WKT or ``EPSG:n``.

    Returns
    -------
    pyproj.CRS
        A two-dimensional geographic or projected CRS.

    Raises
    ------
    InputError
        ``crs`` cannot be parsed, or is neither geographic nor projected.
    """
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    try:
        parsed = CRS.from_user_input(crs)
    except CRSError:
        raise InputError(crs, "not a coordinate reference system", expected="EPSG:n or WKT") from None
    if parsed.is_compound:
        parsed = parsed.sub_crs_list[0]
    parsed = parsed.to_2d()
    if not (parsed.is_geographic or parsed.is_projected):
        raise InputError(
            crs, "a CRS that is neither geographic nor projected", expected="a geographic or projected CRS"
        )
    return parsed


def crs_name(crs: str) -> str:
    """The short name of a CRS: ``EPSG:n`` where it is registered, else the name that it states."""
    parsed = horizontal_crs(crs)
    authority = parsed.to_authority(min_confidence=70)
    return parsed.name if authority is None else ":".join(authority)


@lru_cache(maxsize=64)
def _transformer(crs: str) -> Transformer:
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    try:
        # A ballpark transformation silently omits the datum shift (about 100 m in Switzerland).
        return Transformer.from_crs(horizontal_crs(crs), "EPSG:4326", always_xy=True, allow_ballpark=False)
    except ProjError as error:
        raise InputError(crs, f"no accurate transformation to WGS 84: {error}") from None


def geodetic_from_map(crs: str, x: ArrayLike, y: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Transform map coordinates to WGS 84.

    Parameters
    ----------
    crs
        CRS of the map as WKT or ``EPSG:n``.
    x, y
        Map coordinates ``(...)`` in the CRS's units.

    Returns
    -------
    latitude_deg, longitude_deg
        ``(...)`` float64 [deg]; infinite outside the domain of the projection.

    Raises
    ------
    InputError
        The CRS is invalid, or PROJ has no accurate transformation to WGS 84.
    """
    longitude, latitude = _transformer(crs).transform(np.asarray(x, float), np.asarray(y, float))
    return np.asarray(latitude), np.asarray(longitude)


def map_from_geodetic(crs: str, latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Transform WGS 84 positions to map coordinates.

    Parameters
    ----------
    crs
        CRS of the map as WKT or ``EPSG:n``.
    latitude_deg, longitude_deg
        Positions ``(...)`` [deg].

    Returns
    -------
    x, y
        ``(...)`` float64 in the CRS's units; infinite outside the domain of the projection.

    Raises
    ------
    InputError
        The CRS is invalid, or PROJ has no accurate transformation from WGS 84.
    """
    x, y = _transformer(crs).transform(
        np.asarray(longitude_deg, float), np.asarray(latitude_deg, float), direction="INVERSE"
    )
    return np.asarray(x), np.asarray(y)


def turn(crs: str) -> float | None:
    """The full circle in a geographic CRS's own unit (360 for degrees); ``None`` for a projected CRS."""
    horizontal = horizontal_crs(crs)
    if not horizontal.is_geographic:
        return None
    return 2.0 * np.pi / horizontal.axis_info[0].unit_conversion_factor


def wrapped(value: ArrayLike, centre: float, period: float) -> np.ndarray:
    """Values shifted by whole periods to within half a period of a centre: longitudes are equal modulo 360°."""
    value = np.asarray(value, float)
    return value - period * np.round((value - centre) / period)


def map_position(raster: Raster, latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Map coordinates of WGS 84 positions as a raster writes them: its longitudes may be 0…360° or run past 180°.

    Parameters
    ----------
    raster
        Supplies transform, size and CRS.
    latitude_deg, longitude_deg
        Positions ``(...)`` [deg].

    Returns
    -------
    x, y
        ``(...)`` float64 in the CRS's units; infinite outside the domain of the projection.
    """
    height, width = raster.values.shape[:2]
    return grid_position(raster.crs, raster.transform, (width, height), latitude_deg, longitude_deg)


def grid_position(
    crs: str, transform: Affine, size: tuple[int, int], latitude_deg: ArrayLike, longitude_deg: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """`map_position` of a grid of ``size`` columns and rows."""
    x, y = map_from_geodetic(crs, latitude_deg, longitude_deg)
    full_turn = turn(crs)
    if full_turn is not None:
        centre = float(apply_affine(transform, size[0] / 2.0, size[1] / 2.0)[0])
        x = np.where(np.isfinite(x), wrapped(np.nan_to_num(x), centre, full_turn), x)
    return x, y


def apply_affine(transform: Affine, x: ArrayLike, y: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Apply an affine map to coordinates.

    Parameters
    ----------
    transform
        A raster's transform for (column, row) → map coordinates, its inverse for the other direction.
    x, y
        Coordinates ``(...)``.

    Returns
    -------
    x, y
        Mapped coordinates ``(...)`` float64.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    return transform.a * x + transform.b * y + transform.c, transform.d * x + transform.e * y + transform.f


def raster_pixels(raster: Raster, latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> np.ndarray:
    """Compute the pixel coordinates of WGS 84 positions in a raster.

    Parameters
    ----------
    raster
        Supplies transform and CRS.
    latitude_deg, longitude_deg
        Positions ``(...)`` [deg].

    Returns
    -------
    numpy.ndarray
        Column and row ``(..., 2)``; the first pixel's centre is (0.5, 0.5).
    """
    return np.stack(apply_affine(~raster.transform, *map_position(raster, latitude_deg, longitude_deg)), axis=-1)
