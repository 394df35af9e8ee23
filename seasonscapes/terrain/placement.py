"""Where a raster lies and how large its cells are: refused where it cannot be meant, with the likely cause."""

from __future__ import annotations

import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from affine import Affine

from seasonscapes.errors import InputError
from seasonscapes.frames import MEAN_RADIUS_M, LocalFrame, ecef_from_geodetic, enu_from_geodetic
from seasonscapes.terrain.crs import apply_affine, geodetic_from_map, horizontal_crs, wrapped

if TYPE_CHECKING:
    from rasterio.io import DatasetReader

    from seasonscapes.terrain.surface import Raster

# Cells of micro-relief by photogrammetry, and of global models of the relief.
CELLS_M = (0.01, 10_000.0)
# One sun position and one sky serve the whole scene.
WIDEST_DEG = 3.0
# A grid may be used some way beyond the area that it is made for, but not on the other side of the Earth.
_BEYOND_AREA_DEG = 20.0


def checked_crs(source: DatasetReader, path: str) -> str:
    """CRS of an open raster as text.

    Raises
    ------
    InputError
        No CRS or geotransform, one with NaN or without area, or coordinates that contradict the CRS.
    """
    if source.crs is None:
        raise InputError(path, "the raster has no CRS", cure="assign one with: gdal_edit.py -a_srs EPSG:… FILE")
    if source.transform == Affine.identity():
        raise InputError(
            path, "the raster has a CRS but no geotransform", cure="assign one with: gdal_edit.py -a_ullr … FILE"
        )
    numbers = tuple(source.transform)[:6]
    if not np.isfinite(numbers).all() or source.transform.determinant == 0.0:
        raise InputError(
            path,
            "the geotransform is no map from pixels to places",
            got=", ".join(f"{number:g}" for number in numbers),
            cure="assign one with: gdal_edit.py -a_ullr … FILE",
        )
    text = source.crs.to_string()
    _check_coordinates(text, source.transform, source.width, source.height, path)
    return text


def _check_coordinates(text: str, transform: Affine, width: int, height: int, path: str) -> None:
    corners = np.stack(apply_affine(transform, [0, width, 0, width], [0, 0, height, height]), axis=-1)
    extent = f"x {corners[:, 0].min():g} … {corners[:, 0].max():g}, y {corners[:, 1].min():g} … {corners[:, 1].max():g}"
    pixel = max(abs(transform.a), abs(transform.b), abs(transform.d), abs(transform.e))
    crs = horizontal_crs(text)
    if crs.is_geographic:
        # Longitudes of 0…360° are in use; .hgt grids extend half a pixel beyond the pole.
        low, high = corners.min(0), corners.max(0)
        if low[1] < -90.0 - pixel or high[1] > 90.0 + pixel or low[0] < -360.0 - pixel or high[0] > 360.0 + pixel:
            swapped = low[0] >= -90.0 - pixel and high[0] <= 90.0 + pixel and high[1] <= 360.0 + pixel
            raise InputError(
                path,
                f"coordinates beyond ±180°/±90° in the geographic CRS {text}",
                got=extent,
                expected="degrees",
                cure="latitude and longitude are probably swapped"
                if swapped and low[1] >= -360.0 - pixel
                else "the file's CRS is probably a projected one",
            )
    elif np.abs(corners).max() <= 360.0 and pixel < 1.0:
        raise InputError(
            path,
            f"coordinates in degrees in the projected CRS {text}",
            got=extent,
            cure="the file's CRS is probably EPSG:4326",
        )


def centre_deg(crs: str, transform: Affine, width: int, height: int) -> tuple[float, float]:
    """WGS 84 latitude and longitude of a grid's centre [deg]; infinite outside the domain of the projection."""
    latitude, longitude = geodetic_from_map(crs, *apply_affine(transform, width / 2.0, height / 2.0))
    return float(latitude), float(longitude)


def check_place(crs: str, transform: Affine, width: int, height: int, path: str) -> None:
    """Raise `InputError` where a grid's centre is no place, or lies far outside the area that its CRS is made for."""
    area = horizontal_crs(crs).area_of_use
    here = centre_deg(crs, transform, width, height)
    outside = _degrees_outside(area, here) if area is not None else 0.0
    if np.isfinite(here).all() and outside <= 0.5:
        return
    flipped = _swapped(transform)
    there = centre_deg(crs, flipped, width, height)
    swap = area is not None and np.isfinite(there).all() and _degrees_outside(area, there) <= 0.5
    if not np.isfinite(here).all() or outside > _BEYOND_AREA_DEG or swap:
        x, y = (float(v) for v in apply_affine(transform, width / 2.0, height / 2.0))
        expected = (
            "" if area is None else f"latitude {area.south:g} … {area.north:g}, longitude {area.west:g} … {area.east:g}"
        )
        raise InputError(
            path,
            "lies far outside the area of its CRS",
            got=f"x {x:g}, y {y:g} in {horizontal_crs(crs).name}",
            expected=expected or None,
            cure="easting and northing are probably swapped" if swap else "the CRS is probably another one",
        )


def _degrees_outside(area, place: tuple[float, float]) -> float:
    """How far a place lies outside an area of use [deg]; areas may cross the antimeridian."""
    latitude, longitude = place
    if not np.isfinite(place).all():
        return np.inf
    east = area.east + (360.0 if area.east < area.west else 0.0)
    longitude = float(wrapped(longitude, 0.5 * (area.west + east), 360.0))
    return max(area.south - latitude, latitude - area.north, area.west - longitude, longitude - east, 0.0)


def _swapped(transform: Affine) -> Affine:
    """The grid with x and y of its origin exchanged."""
    a, b, c, d, e, f = tuple(transform)[:6]
    return Affine(a, b, f, d, e, c)


def check_cells(grid: Raster, where: str | os.PathLike[str]) -> None:
    """Raise `InputError` for cells too small or too large for heights of a landscape."""
    sides = cell_sides_m(grid)
    if not all(CELLS_M[0] <= side <= CELLS_M[1] for side in sides):
        raise InputError(
            os.fspath(where),
            "cells of a size that no heights of a landscape have",
            got=f"{sides[0]:.3g} m × {sides[1]:.3g} m",
            expected=f"{CELLS_M[0]:g} m to {CELLS_M[1] / 1000.0:g} km",
            cure="check the geotransform and the unit of the CRS (degrees, metres or kilometres?)",
        )


def cell_sides_m(grid: Raster) -> tuple[float, float]:
    """Width and height of a raster's middle cell on the ground [m]."""
    height, width = grid.values.shape[:2]
    column, row = np.array([0.0, 1.0, 0.0]) + width // 2, np.array([0.0, 0.0, 1.0]) + height // 2
    latitude, longitude = geodetic_from_map(grid.crs, *apply_affine(grid.transform, column, row))
    if not (np.isfinite(latitude).all() and np.isfinite(longitude).all()):
        return float("nan"), float("nan")
    positions = enu_from_geodetic(LocalFrame(float(latitude[0]), float(longitude[0])), latitude, longitude, 0.0)
    across, down = np.linalg.norm(positions[1:], axis=1)
    return float(across), float(down)


def check_area(bounds_deg: tuple[float, float, float, float], where: str | os.PathLike[str]) -> None:
    """Raise `InputError` for an area wider than `WIDEST_DEG` degrees of a great circle."""
    west, south, east, north = bounds_deg
    # Along the parallel nearest the equator; half of it at most, so that a box around a pole is as wide as its diameter.
    nearest = float(np.clip(0.0, south, north))
    turn = np.radians(min(east - west, 180.0))
    across = float(np.degrees(2.0 * np.arcsin(np.cos(np.radians(nearest)) * np.sin(0.5 * turn))))
    if max(across, north - south) > WIDEST_DEG + 0.02:
        raise InputError(
            os.fspath(where),
            f"spans more than {WIDEST_DEG:g}°, too far for a single sun position and sky",
            got=f"{across:.2f}° × {north - south:.2f}°",
            cure="choose a part with a table [area] of west_deg, south_deg, east_deg, north_deg",
        )


def distance_km(latitude_deg: float, longitude_deg: float, bounds_deg: tuple[float, float, float, float]) -> float:
    """Great-circle distance from a place to the nearest point of a box [km]; 0 inside."""
    west, south, east, north = bounds_deg
    longitude_deg = float(wrapped(longitude_deg, 0.5 * (west + east), 360.0))
    nearest = (float(np.clip(latitude_deg, south, north)), float(np.clip(longitude_deg, west, east)))
    chord = float(
        np.linalg.norm(ecef_from_geodetic(latitude_deg, longitude_deg, 0.0) - ecef_from_geodetic(*nearest, 0.0))
    )
    return 2.0 * MEAN_RADIUS_M * float(np.arcsin(min(1.0, chord / (2.0 * MEAN_RADIUS_M)))) / 1000.0


def likely_cause(raster: Raster, latitude_deg: float, longitude_deg: float, *, within_deg: float = 2.0) -> str | None:
    """Name the mistake that would explain why a raster lies far from a place that it should cover.

    Parameters
    ----------
    raster
        Supplies size, transform and CRS.
    latitude_deg, longitude_deg
        A place that should lie in it or near it [deg].
    within_deg
        How near to the place the corrected raster has to lie [deg].

    Returns
    -------
    str or None
        One clause such as "easting and northing are probably swapped", or ``None`` where nothing fits.
    """
    height, width = raster.values.shape[:2]

    def near(place: tuple[float, float]) -> bool:
        across = float(wrapped(place[1], longitude_deg, 360.0)) - longitude_deg if np.isfinite(place[1]) else np.inf
        return abs(place[0] - latitude_deg) < within_deg and abs(across) < within_deg

    here = centre_deg(raster.crs, raster.transform, width, height)
    if near(here):
        return None
    if near((here[1], here[0])):
        return "latitude and longitude are probably swapped"
    if near((-here[0], here[1])):
        return "north and south are probably exchanged"
    if near((here[0], -here[1])):
        return "the longitude probably has the wrong sign"
    if horizontal_crs(raster.crs).is_projected and near(
        centre_deg(raster.crs, _swapped(raster.transform), width, height)
    ):
        return "easting and northing are probably swapped"
    for code, name in _other_utm(raster.crs, longitude_deg):
        if near(centre_deg(code, raster.transform, width, height)):
            other = ", of the other hemisphere" if here[0] * latitude_deg < 0.0 else ""
            return f"the CRS is probably {name} ({code}){other}"
    return None


def _other_utm(crs: str, longitude_deg: float) -> Iterator[tuple[str, str]]:
    """The UTM zones of a longitude on both hemispheres, where a CRS is a UTM zone."""
    if horizontal_crs(crs).utm_zone is None:
        return
    zone = int((longitude_deg + 180.0) // 6.0) % 60 + 1
    yield f"EPSG:{32600 + zone}", f"UTM zone {zone} north"
    yield f"EPSG:{32700 + zone}", f"UTM zone {zone} south"
