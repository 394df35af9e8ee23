"""Heights and slopes at the samples of an elevation raster: the smooth surface that a triangle mesh approximates.

A mesh within a few metres of the heights may have facets whose slope is off by many degrees, and normals interpolated
over its large facets carry the slope of a cliff far into a plain. Shading therefore uses the slopes of the heights
themselves, at the resolution of the elevation raster and independently of the triangulation.
"""

from __future__ import annotations

from collections.abc import Callable

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
# Nodes a side from which positions of a raster's samples are interpolated, and their largest error [m].
_NODES, _MOST_SHIFT_M = 12, 1e-3


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
    positions = grid_positions(raster, frame)
    strip = max(4, _STRIP // columns)
    for first in range(0, rows, strip):
        # One more row on either side for the differences.
        low, high = max(first - 1, 0), min(first + strip + 1, rows)
        position = positions(np.arange(low, high) * stride, np.arange(columns) * stride, heights[low:high])
        kept = slice(first - low, min(first + strip, rows) - low)
        down, across = (np.moveaxis(np.gradient(position, axis=axis)[kept], 2, 0) for axis in (0, 1))
        part = nodes[first : first + strip]
        area = down[0] * across[1] - down[1] * across[0]
        part[..., 0] = (down[2] * across[1] - down[1] * across[2]) / area
        part[..., 1] = (down[0] * across[2] - down[2] * across[0]) / area
        part[..., 2] = position[kept, :, 2]
    levels_m = (float(heights.min()), float(heights.max()))
    to_node, domain = grid_polynomials(raster, frame, levels_m, stride=stride)
    return SurfaceGrid(nodes, to_node, domain, mesh_error_m, rim_nodes=rim_nodes)


def grid_positions(raster: Raster, frame: LocalFrame) -> Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
    """Positions of a raster's samples in a local frame, without the transformation of each.

    A position is linear in the height, but for refraction's micrometres; that of the sea level and the direction of up
    are smooth: they are interpolated between Chebyshev nodes where that is exact to a millimetre, and every sample is transformed
    where it is not.

    Parameters
    ----------
    raster
        Supplies transform, CRS and shape.
    frame
        The frame.

    Returns
    -------
    Callable
        From rows ``(h,)``, columns ``(w,)`` and heights ``(h, w)`` [m] to positions ``(h, w, 3)`` float64, ENU [m].
    """

    def exact(rows: np.ndarray, columns: np.ndarray, height_m: np.ndarray) -> np.ndarray:
        x, y = apply_affine(raster.transform, columns[None, :] + 0.5, rows[:, None] + 0.5)
        return enu_from_geodetic(frame, *geodetic_from_map(raster.crs, x, y), height_m)

    sides = [np.array([0.0, extent - 1.0]) for extent in raster.values.shape[:2]]
    angle = (np.arange(_NODES) + 0.5) * np.pi / _NODES
    places = [side.mean() + 0.5 * np.ptp(side) * np.cos(angle) for side in sides]
    ground, above = (exact(places[0], places[1], np.full((_NODES, _NODES), level_m)) for level_m in (0.0, 4000.0))
    rise = (above - ground) / 4000.0

    def basis(at: np.ndarray, side: np.ndarray) -> np.ndarray:
        # Values at the nodes → values at ``at``, by the discrete cosine transform of the nodes.
        place = np.arccos(np.clip((at - side.mean()) / max(0.5 * np.ptp(side), 0.5), -1.0, 1.0))
        order = np.arange(_NODES)
        analysis = np.cos(order[:, None] * angle) * np.where(order == 0, 1.0, 2.0)[:, None] / _NODES
        return np.cos(place[:, None] * order) @ analysis

    def interpolated(rows: np.ndarray, columns: np.ndarray, height_m: np.ndarray) -> np.ndarray:
        down, across = basis(rows, sides[0]), basis(columns, sides[1])
        position = np.empty((len(rows), len(columns), 3))
        for axis in range(3):
            upwards = down @ rise[..., axis] @ across.T
            upwards *= height_m
            upwards += down @ ground[..., axis] @ across.T
            position[..., axis] = upwards
        return position

    rows, columns = (np.linspace(side[0], side[1], 7) for side in sides)
    heights = np.linspace(-400.0, 8800.0, 49).reshape(7, 7)
    wrong_m = np.abs(interpolated(rows, columns, heights) - exact(rows, columns, heights)).max()
    # Where a corner lies outside the domain of the projection, the numbers are not finite.
    return interpolated if wrong_m <= _MOST_SHIFT_M else exact


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
