"""Where the water of a place lies: from polygons, a raster, or its relief and image; and its level."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from affine import Affine

from seasonscapes.errors import InputError
from seasonscapes.images import REC709_LUMINANCE
from seasonscapes.terrain.crs import apply_affine, geodetic_from_map, map_position
from seasonscapes.terrain.placement import cell_sides_m
from seasonscapes.terrain.raster import bounds_geographic, read_raster, sample_raster
from seasonscapes.terrain.raster_files import Confinement
from seasonscapes.terrain.surface import Raster
from seasonscapes.text_files import read_json

# Polygons are drawn on a grid this many times finer than the heights, and averaged.
_FINER = 4
# A lake's samples differ by less than this from their neighbours and from its level [m]; heights of one lake come from one
# flight, or were levelled by those who made the raster.
_FLAT_M, _LEVEL_M = 0.4, 1.5
# The brightest water, milky with silt, reflects less; meadows reflect more green than blue.
_BRIGHTEST, _LEAST_BLUE_OF_GREEN, _LEAST_BLUE_OF_RED = 0.25, 0.8, 0.9
_STRIP = 500_000


def polygon_water(path: str | Path, elevation: Raster) -> Raster:
    """Draw the polygons of a GeoJSON file.

    Parameters
    ----------
    path
        Features with polygons in WGS 84 (RFC 7946); other geometries are refused.
    elevation
        Heights whose grid the result has.

    Returns
    -------
    Raster
        ``(H, W, 1)`` float32 share of each cell that is water.

    Raises
    ------
    InputError
        Where the file is no GeoJSON of polygons, or none lies on the raster.
    """
    from rasterio.features import rasterize

    polygons = _polygons(read_json(path), path)
    height, width = elevation.values.shape[:2]
    shapes = []
    for rings in polygons:
        try:
            corners = [np.asarray(ring, float)[:, :2] for ring in rings]
        except (ValueError, IndexError, TypeError):
            raise InputError(path, "a polygon whose corners are no pairs of longitude and latitude") from None
        if any(len(ring) < 4 or (np.abs(ring) > [540.0, 90.0]).any() for ring in corners):
            raise InputError(path, "a ring of fewer than four corners, or beyond the Earth", expected="WGS 84 degrees")
        rings_xy = [np.stack(map_position(elevation, ring[:, 1], ring[:, 0]), axis=1) for ring in corners]
        if all(np.isfinite(ring).all() for ring in rings_xy):
            shapes.append({"type": "Polygon", "coordinates": [ring.tolist() for ring in rings_xy]})
    drawn = np.zeros((height, width), np.float32)
    if shapes:
        transform = elevation.transform * Affine.scale(1.0 / _FINER)
        fine: Any = rasterize(shapes, (height * _FINER, width * _FINER), transform=transform, dtype="uint8")
        drawn = fine.reshape(height, _FINER, width, _FINER).mean(axis=(1, 3), dtype=np.float32)
    if not drawn.any():
        west, south, east, north = bounds_geographic(elevation)
        raise InputError(
            path,
            "no polygon of water lies on the elevation raster",
            expected=f"latitude {south:.3f} … {north:.3f}, longitude {west:.3f} … {east:.3f}",
        )
    return replace(elevation, values=drawn[..., None])


def _polygons(document: Any, path: str | Path) -> list[list]:
    """Rings of all polygons of a GeoJSON document."""

    def collect(node: Any) -> list[list]:
        kind = node.get("type") if isinstance(node, dict) else None
        if kind == "FeatureCollection" and isinstance(node["features"], list):
            return [rings for feature in node["features"] for rings in collect(feature)]
        if kind == "Feature":
            return collect(node["geometry"])
        if kind == "Polygon":
            return [node["coordinates"]]
        if kind == "MultiPolygon":
            return list(node["coordinates"])
        raise InputError(path, "not GeoJSON of polygons", got=str(kind), expected="Polygon or MultiPolygon features")

    try:
        return collect(document)
    except (KeyError, TypeError, RecursionError):
        raise InputError(path, "not GeoJSON of polygons", expected="a FeatureCollection") from None


def raster_water(path: str | Path, elevation: Raster, confinement: Confinement) -> Raster:
    """Read the first band of a raster of water, resampled to the grid of the heights.

    Parameters
    ----------
    path
        Raster whose values above 0.5 are water; no data is none.
    elevation
        Heights whose grid the result has.
    confinement
        Where the raster's files may lie.

    Returns
    -------
    Raster
        ``(H, W, 1)`` float32 share of water.
    """
    own = read_raster(path, bounds_deg=bounds_geographic(elevation), bands=(1,), confinement=confinement)
    own = replace(own, values=(own.values > 0.5).astype(np.float32))
    shares = np.nan_to_num(sampled_on(own, elevation))
    if not (shares > 0.5).any():
        raise InputError(
            path, "shows no water on the elevation raster", expected="values above 0.5 where there is water"
        )
    return replace(elevation, values=shares)


def sampled_on(raster: Raster, elevation: Raster) -> np.ndarray:
    """Values ``(H, W, C)`` float32 of a raster in any CRS at the cells of another; NaN outside."""
    height, width = elevation.values.shape[:2]
    result = np.empty((height, width, raster.values.shape[2]), np.float32)
    strip = max(1, _STRIP // width)
    for first in range(0, height, strip):
        row, column = np.mgrid[first : min(first + strip, height), 0:width] + 0.5
        latitude, longitude = geodetic_from_map(elevation.crs, *apply_affine(elevation.transform, column, row))
        result[first : first + len(row)] = sample_raster(raster, *map_position(raster, latitude, longitude))
    return result


def find_water(elevation: Raster, image: Raster | None, *, least_area_m2: float) -> Raster:
    """Find lakes: flat, level ground which, where there is an image, is dark and not green.

    Rivers slope, and are not found.

    Parameters
    ----------
    elevation
        Heights ``(H, W, 1)`` [m].
    image
        Linear reflectance ``(h, w, 3)`` in any CRS; ``None`` decides by the relief alone.
    least_area_m2
        Smallest lake [m²].

    Returns
    -------
    Raster
        ``(H, W, 1)`` float32, 1 on water.
    """
    from scipy import ndimage

    heights = elevation.values[..., 0]
    cell_m2 = float(np.prod(cell_sides_m(elevation)))
    flat = ndimage.maximum_filter(heights, 3) - ndimage.minimum_filter(heights, 3) < _FLAT_M
    looks = np.ones(heights.shape, bool)
    if image is not None:
        red, green, blue = np.moveaxis(sampled_on(image, elevation), -1, 0)
        bright = np.stack([red, green, blue], axis=-1) @ REC709_LUMINANCE.astype(np.float32)
        # Unknown colours (clouds, borders of the image) decide nothing.
        looks = ~(bright > _BRIGHTEST) & ~(blue < _LEAST_BLUE_OF_GREEN * green) & ~(blue < _LEAST_BLUE_OF_RED * red)
    found = np.zeros(heights.shape, np.float32)
    number, count = cast(tuple[np.ndarray, int], ndimage.label(flat & looks))
    for index, part in enumerate(ndimage.find_objects(number, count), 1):
        inside = number[part] == index
        if inside.sum() * cell_m2 < least_area_m2:
            continue
        level = np.median(heights[part][inside])
        # Cells at the shore are not flat: those that touch the lake at its level belong to it.
        grown = tuple(slice(max(axis.start - 1, 0), axis.stop + 1) for axis in part)
        inside = ndimage.binary_dilation(number[grown] == index, np.ones((3, 3))) & looks[grown]
        inside &= np.abs(heights[grown] - level) < _LEVEL_M
        if (np.abs(heights[part][number[part] == index] - level) < _LEVEL_M).mean() > 0.95:
            found[grown][inside] = 1.0
    return replace(elevation, values=found[..., None])


def levelled(elevation: Raster, water: Raster) -> Raster:
    """Flatten the heights of each lake to its level, and raise its banks to it.

    Parameters
    ----------
    elevation
        Heights ``(H, W, 1)`` [m] without holes.
    water
        ``(H, W, 1)`` share of water, in any grid of the same CRS.

    Returns
    -------
    Raster
        The level is the median over the lake. Water whose heights differ by more than 1.5 m is a river and stays.
    """
    from scipy import ndimage

    same = water.values.shape == elevation.values.shape and water.transform == elevation.transform
    shares = water.values if same else np.nan_to_num(sampled_on(water, elevation))
    heights = elevation.values[..., 0].copy()
    number, count = cast(tuple[np.ndarray, int], ndimage.label(shares[..., 0] > 0.5, np.ones((3, 3))))
    for index, part in enumerate(ndimage.find_objects(number, count), 1):
        inside = number[part] == index
        # Interpolated shores belong to the bank.
        inner = ndimage.binary_erosion(inside, np.ones((3, 3)))
        values = heights[part][inner if inner.any() else inside]
        level = float(np.median(values))
        low, high = np.percentile(values, [5.0, 95.0])
        if high - low > _LEVEL_M:
            continue
        heights[part][inside] = level
        grown: Any = tuple(slice(max(axis.start - 1, 0), axis.stop + 1) for axis in part)
        rim = ndimage.binary_dilation(number[grown] == index, np.ones((3, 3))) & (number[grown] == 0)
        heights[grown][rim] = np.maximum(heights[grown][rim], level)
    return replace(elevation, values=heights[..., None])
