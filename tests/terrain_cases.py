"""Rasters whose truth is a formula, and slow obvious twins, for the tests of terrain."""

import itertools

import numpy as np
import pyproj
import rasterio
from affine import Affine

from seasonscapes.terrain.surface import Raster


def hill(latitude_deg, longitude_deg):
    """An asymmetric smooth massif about 46.55 N, 7.98 E [m], of about 8 km across."""
    north = (np.asarray(latitude_deg) - 46.55) * 111_200.0
    east = (np.asarray(longitude_deg) - 7.98) * 76_500.0
    main = 1800.0 * np.exp(-((north / 2600.0) ** 2) - (east / 1700.0) ** 2)
    shoulder = 700.0 * np.exp(-(((north - 2500.0) / 900.0) ** 2) - ((east - 2200.0) / 700.0) ** 2)
    return 900.0 + main + shoulder + 30.0 * np.sin(east / 310.0) * np.cos(north / 270.0)


def raster_of(function, crs, transform, height, width):
    """Samples of ``function(latitude, longitude)`` at the pixel centres of a grid, by pyproj alone."""
    row, column = np.mgrid[0:height, 0:width] + 0.5
    x = transform.a * column + transform.b * row + transform.c
    y = transform.d * column + transform.e * row + transform.f
    transformer = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
    longitude, latitude = transformer.transform(x, y)
    return Raster(function(latitude, longitude)[..., None].astype(np.float32), transform, crs)


def hill_lv95(height=120, width=140, spacing_m=60.0):
    """The hill on the Swiss grid."""
    return raster_of(hill, "EPSG:2056", Affine(spacing_m, 0, 2637800, 0, -spacing_m, 1159300), height, width)


def write_tiff(path, values, transform=None, crs=None, **profile):
    """Write ``(H, W)`` or ``(C, H, W)`` as GeoTIFF."""
    values = np.asarray(values)
    values = values[None] if values.ndim == 2 else values
    profile = {
        "driver": "GTiff",
        "count": len(values),
        "height": values.shape[1],
        "width": values.shape[2],
        "dtype": values.dtype,
        **profile,
    }
    if crs is not None:
        profile["crs"] = crs
    if transform is not None:
        profile["transform"] = transform
    with rasterio.open(path, "w", **profile) as file:
        file.write(values)
    return path


def triangles_overlap(a, b, tolerance):
    """Whether two triangles ``(3, 2)`` share more than ``tolerance`` in depth: the separating axis theorem."""
    for one, other in ((a, b), (b, a)):
        orientation = np.sign(_cross(one[1] - one[0], one[2] - one[0])) or 1.0
        for k in range(3):
            edge = one[(k + 1) % 3] - one[k]
            outward = orientation * np.array([edge[1], -edge[0]]) / max(np.hypot(*edge), 1e-300)
            if ((other - one[k]) @ outward).min() > -tolerance:
                return False
    return True


def overlapping_pairs(uv, faces, tolerance=1e-6):
    """All pairs of faces that share an area in UV, by brute force."""
    corners = np.asarray(uv, np.float64)[faces]
    return [
        (i, j)
        for i, j in itertools.combinations(range(len(faces)), 2)
        if triangles_overlap(corners[i], corners[j], tolerance)
    ]


def _cross(a, b):
    return a[0] * b[1] - a[1] * b[0]
