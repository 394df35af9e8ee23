"""From a raster's map coordinates to WGS 84 and back, horizontally and without silent shortcuts."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from affine import Affine

from seasonscapes.declaration import InputError
from seasonscapes.terrain.surface import Raster


@lru_cache(maxsize=64)
def horizontal_crs(crs: str):
    """The horizontal part of a CRS: vertical parts must never move a height."""
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
        raise InputError(crs, "a CRS that is not tied to the Earth", expected="a geographic or projected CRS")
    return parsed


@lru_cache(maxsize=64)
def _transformer(crs: str):
    from pyproj import Transformer
    from pyproj.exceptions import ProjError

    try:
        # A ballpark transformation ignores the datum shift (about 100 m in Switzerland), silently.
        return Transformer.from_crs(horizontal_crs(crs), "EPSG:4326", always_xy=True, allow_ballpark=False)
    except ProjError as error:
        raise InputError(crs, f"no accurate transformation to WGS 84: {error}") from None


def geodetic_from_map(crs: str, x, y) -> tuple[np.ndarray, np.ndarray]:
    """WGS 84 latitude and longitude [deg] of map coordinates ``(...)``; infinite where the projection has no answer."""
    longitude, latitude = _transformer(crs).transform(np.asarray(x, float), np.asarray(y, float))
    return np.asarray(latitude), np.asarray(longitude)


def map_from_geodetic(crs: str, latitude_deg, longitude_deg) -> tuple[np.ndarray, np.ndarray]:
    """Map coordinates x and y ``(...)`` of WGS 84 positions; infinite where the projection has no answer."""
    x, y = _transformer(crs).transform(
        np.asarray(longitude_deg, float), np.asarray(latitude_deg, float), direction="INVERSE"
    )
    return np.asarray(x), np.asarray(y)


def apply_affine(transform: Affine, x, y) -> tuple[np.ndarray, np.ndarray]:
    """Both coordinates ``(...)`` after an affine map: pixel to map with a raster's transform, back with its inverse."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    return transform.a * x + transform.b * y + transform.c, transform.d * x + transform.e * y + transform.f


def raster_pixels(raster: Raster, latitude_deg, longitude_deg) -> np.ndarray:
    """Column and row ``(..., 2)`` in a raster, 0.5 at the first pixel's centre, of WGS 84 positions ``(...)``."""
    return np.stack(
        apply_affine(~raster.transform, *map_from_geodetic(raster.crs, latitude_deg, longitude_deg)), axis=-1
    )
