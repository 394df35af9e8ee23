"""Heights and slopes at the samples of an elevation raster: the smooth surface that a triangle mesh approximates.

A mesh within a few metres of the heights may have facets whose slope is off by many degrees, and normals interpolated
over its large facets carry the slope of a cliff far into a plain. Shading therefore uses the slopes of the heights
themselves, at the resolution of the elevation raster and independently of the triangulation.
"""

from __future__ import annotations

import numpy as np

from seasonscapes.frames import LocalFrame, enu_from_geodetic
from seasonscapes.terrain.crs import apply_affine, geodetic_from_map
from seasonscapes.terrain.surface import Raster, SurfaceGrid, monomials

# 12 bytes each on the device; larger rasters are thinned.
MOST_NODES = 24_000_000
# Largest error of the polynomial from the local frame to the raster: in samples, or in metres where that is more.
_MOST_ERROR, _MOST_ERROR_M = 0.02, 0.05
_DEGREES = (3, 5, 7)
_STRIP = 500_000


def surface_grid(
    raster: Raster, frame: LocalFrame, *, mesh_error_m: float = 0.0, rim_nodes: float = 1.0
) -> SurfaceGrid:
    """Compute slopes and up coordinates of a raster's samples in the local frame.

    Parameters
    ----------
    raster
        ``values`` ``(H, W, 1)`` heights [m] without holes.
    frame
        Local frame of the result.
    mesh_error_m
        Vertical error bound of the mesh that approximates the surface [m].
    rim_nodes
        Of a part of another surface: width of the rim along which the two are blended, in samples.

    Returns
    -------
    SurfaceGrid
        Nodes at the samples; at every second, third … one of a raster of more than `MOST_NODES`.

    Raises
    ------
    ValueError
        Where the raster's coordinates are too distorted for a polynomial of degree 7 (more than some hundred km).
    """
    stride = int(np.ceil(np.sqrt(raster.values.size / MOST_NODES)))
    heights = raster.values[::stride, ::stride, 0]
    rows, columns = heights.shape
    nodes = np.empty((rows, columns, 3), np.float32)
    strip = max(4, _STRIP // columns)
    for first in range(0, rows, strip):
        # One more row on either side for the differences.
        low, high = max(first - 1, 0), min(first + strip + 1, rows)
        row, column = np.mgrid[low:high, 0:columns] * stride
        x, y = apply_affine(raster.transform, column + 0.5, row + 0.5)
        position = enu_from_geodetic(frame, *geodetic_from_map(raster.crs, x, y), heights[low:high])
        normal = np.cross(np.gradient(position, axis=0), np.gradient(position, axis=1))
        normal *= np.where(normal[..., 2:] < 0.0, -1.0, 1.0)
        kept = slice(first - low, min(first + strip, rows) - low)
        nodes[first : first + strip, :, :2] = (-normal[..., :2] / np.maximum(normal[..., 2:], 1e-6))[kept]
        nodes[first : first + strip, :, 2] = position[kept, :, 2]
    levels_m = (float(heights.min()), float(heights.max()))
    to_node, domain = grid_polynomials(raster, frame, levels_m, stride=stride)
    return SurfaceGrid(nodes, to_node, domain, mesh_error_m, rim_nodes=rim_nodes)


def grid_polynomials(
    raster: Raster, frame: LocalFrame, levels_m: tuple[float, float], *, stride: int = 1
) -> tuple[np.ndarray, tuple[float, float, float]]:
    """Polynomials from the local frame to column and row of a raster's samples, and centre and radius of their domain.

    ``levels_m`` are the lowest and highest heights of the ground there; ``stride`` counts every so many samples as one.
    """
    height, width = raster.values.shape[:2]
    row, column = np.meshgrid(np.linspace(0, height - 1, 24), np.linspace(0, width - 1, 24), indexing="ij")
    x, y = apply_affine(raster.transform, column + 0.5, row + 0.5)
    latitude, longitude = geodetic_from_map(raster.crs, x, y)
    levels = np.linspace(levels_m[0], levels_m[1] + 1.0, 3)
    position = np.concatenate([enu_from_geodetic(frame, latitude, longitude, level).reshape(-1, 3) for level in levels])
    low, high = position[:, :2].min(axis=0), position[:, :2].max(axis=0)
    centre, radius = 0.5 * (low + high), 0.5 * float((high - low).max())
    domain = (float(centre[0]), float(centre[1]), radius)
    target = np.tile(np.stack([column.ravel(), row.ravel()], axis=1) / stride, (len(levels), 1))
    spacing_m = 2.0 * radius * stride / max(height, width)
    tolerance, errors = max(_MOST_ERROR, _MOST_ERROR_M / spacing_m), []
    for degree in _DEGREES:
        terms = monomials(position, domain, degree)
        coefficients = np.linalg.lstsq(terms, target, rcond=None)[0].T
        errors.append(float(np.abs(terms @ coefficients.T - target).max()))
        if errors[-1] < tolerance:
            return coefficients, domain
    raise ValueError(
        f"surface_grid: the local frame maps to the raster with errors of {min(errors):.2f} samples; expected less than "
        f"{tolerance:.2f}; choose a smaller [area]"
    )
