"""Triangulation of elevation rasters in the local frame, and the vertical error of the resulting mesh.

Every vertex is transformed map → WGS 84 → ECEF → east-north-up, which includes meridian convergence, Earth curvature
and, if the frame has a refraction coefficient, terrestrial refraction.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.frames import MEAN_RADIUS_M, LocalFrame, enu_from_geodetic, geodetic_from_enu
from seasonscapes.terrain.atlas import planar_uv
from seasonscapes.terrain.crs import apply_affine, geodetic_from_map, raster_pixels
from seasonscapes.terrain.surface import Raster, Terrain
from seasonscapes.terrain.texels import covering_faces

DEFAULT_MAX_ERROR_M = 5.0
# Samples per block: bounds the float64 temporaries of the geodetic transformation to 200 MB.
_CHUNK = 500_000


@dataclass(frozen=True)
class MeshReport:
    """Size of a mesh and its vertical error against the raster it approximates.

    Parameters
    ----------
    triangles, vertices
        Number of triangles and vertices.
    grid_triangles
        Number of triangles of the full grid.
    saved_ratio
        ``1 - triangles / grid_triangles``.
    vertical_rmse_m, vertical_max_m
        Root mean square and largest distance between mesh and raster samples along the local vertical [m].
    samples, uncovered_samples
        Number of samples, and of samples that no triangle covers.
    """

    triangles: int
    vertices: int
    grid_triangles: int
    saved_ratio: float
    vertical_rmse_m: float
    vertical_max_m: float
    samples: int
    uncovered_samples: int


def build_mesh(
    raster: Raster, frame: LocalFrame, *, mesher: str = "adaptive", max_error_m: float = DEFAULT_MAX_ERROR_M
) -> Terrain:
    """Triangulate an elevation raster.

    Parameters
    ----------
    raster
        ``values`` ``(H, W, 1)`` heights [m] without holes (see `fill_nodata`). Samples are pixel centres.
    frame
        Local frame of the mesh.
    mesher
        A name in `MESHERS`: ``adaptive`` (greedy refinement to the error bound), ``grid`` (every sample a vertex),
        ``poisson`` (greedy refinement of the screened Poisson surface, as in the SeasonScapes paper).
    max_error_m
        Bound of ``adaptive`` on the vertical distance between the mesh and every sample, of ``poisson`` on that between
        the mesh and its surface [m]; ``grid`` is exact.

    Returns
    -------
    Terrain
        The mesh with top-down UV coordinates; see `unwrap` for other parametrisations.

    Raises
    ------
    ValueError
        Holes in the raster, fewer than 2 × 2 samples, an unknown mesher or a bound that is not positive.
    """
    if mesher not in MESHERS:
        raise ValueError(f"mesher: got {mesher!r}, expected one of {', '.join(MESHERS)}")
    if raster.values.ndim != 3 or raster.values.shape[2] != 1 or min(raster.values.shape[:2]) < 2:
        raise ValueError(f"build_mesh: got values {raster.values.shape}, expected (H, W, 1), at least 2 × 2 samples")
    if not np.isfinite(raster.values).all():
        raise ValueError("build_mesh: the raster has holes; call fill_nodata first")
    if not max_error_m > 0.0:
        raise ValueError(f"max_error_m: got {max_error_m}, expected a positive bound")
    vertices, faces = MESHERS[mesher](raster, frame, max_error_m)
    return Terrain(vertices, faces, planar_uv(vertices), frame)


def sample_positions(
    raster: Raster, frame: LocalFrame, row: ArrayLike, column: ArrayLike, height_m: ArrayLike
) -> np.ndarray:
    """Compute positions in the local frame of raster samples.

    Parameters
    ----------
    raster
        Supplies transform and CRS.
    frame
        Local frame of the result.
    row, column
        Indices ``(...)``; integers are pixel centres.
    height_m
        Heights ``(...)`` in the raster's vertical datum [m].

    Returns
    -------
    numpy.ndarray
        East, north, up ``(..., 3)`` float64 [m].
    """
    x, y = apply_affine(raster.transform, np.asarray(column) + 0.5, np.asarray(row) + 0.5)
    latitude, longitude = geodetic_from_map(raster.crs, x, y)
    return enu_from_geodetic(frame, latitude, longitude, height_m)


def _row_strips(raster: Raster, frame: LocalFrame) -> Iterator[tuple[int, np.ndarray]]:
    """Yield the positions of all samples in strips of rows: first row, and ``(rows, W, 3)`` float64."""
    height, width = raster.values.shape[:2]
    strip = max(1, _CHUNK // width)
    for first in range(0, height, strip):
        row, column = np.mgrid[first : min(first + strip, height), 0:width]
        heights = raster.values[first : first + strip, :, 0]
        yield first, sample_positions(raster, frame, row, column, heights)


def _is_mirrored(raster: Raster) -> bool:
    """Whether the transform has a positive determinant (south-up raster), which reverses the orientation of faces."""
    return raster.transform.determinant > 0.0


def _adaptive(raster: Raster, frame: LocalFrame, max_error_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Greedy insertion of the sample of largest error until all are within the bound (Garland & Heckbert 1995).

    The error refers to the *up* coordinate of each sample, not to its height: triangles are flat in the local frame,
    and Earth curvature makes an 8 m bulge over a 20 km lake.
    """
    from pydelatin import Delatin

    height, width = raster.values.shape[:2]
    up = np.empty((height, width), np.float32)
    for first, position in _row_strips(raster, frame):
        up[first : first + len(position)] = position[..., 2]
    # Delatin interpolates in pixel coordinates and float32, the mesh in metres: the margin keeps the bound valid.
    mesh = Delatin(up, max_error=0.995 * max_error_m)
    column, row = mesh.vertices[:, 0].astype(np.intp), height - 1 - mesh.vertices[:, 1].astype(np.intp)
    vertices = sample_positions(raster, frame, row, column, raster.values[row, column, 0]).astype(np.float32)
    faces = mesh.triangles
    return vertices, faces[:, ::-1].copy() if _is_mirrored(raster) else faces


def _grid(raster: Raster, frame: LocalFrame, max_error_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Two triangles per grid cell."""
    height, width = raster.values.shape[:2]
    vertices = np.empty((height, width, 3), np.float32)
    for first, position in _row_strips(raster, frame):
        vertices[first : first + len(position)] = position
    return vertices.reshape(-1, 3), grid_faces(height, width, mirrored=_is_mirrored(raster))


def grid_faces(height: int, width: int, *, mirrored: bool = False) -> np.ndarray:
    """Generate the faces of a regular grid of vertices.

    Parameters
    ----------
    height, width
        Number of rows and columns of vertices; row 0 is in the north.
    mirrored
        Whether to reverse the orientation, for rasters with a south-up transform.

    Returns
    -------
    numpy.ndarray
        ``(2 (H-1) (W-1), 3)`` uint32.
    """
    faces = np.empty((height - 1, width - 1, 2, 3), np.uint32)
    corner = np.arange(height - 1, dtype=np.uint32)[:, None] * np.uint32(width) + np.arange(width - 1, dtype=np.uint32)
    south = np.uint32(width)
    order = (0, 2, 1) if mirrored else (0, 1, 2)
    for triangle, offsets in enumerate(((0, south, 1), (1, south, south + 1))):
        for slot, offset in zip(order, offsets, strict=True):
            np.add(corner, np.uint32(offset), out=faces[:, :, triangle, slot])
    return faces.reshape(-1, 3)


def _poisson(raster: Raster, frame: LocalFrame, max_error_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Greedy insertion on the screened Poisson surface of all samples."""
    # Sparse solvers take long to import, and few places need them.
    from seasonscapes.terrain.poisson import poisson_raster

    return _adaptive(poisson_raster(raster), frame, max_error_m)


MESHERS: dict[str, Callable[[Raster, LocalFrame, float], tuple[np.ndarray, np.ndarray]]] = {
    "adaptive": _adaptive,
    "grid": _grid,
    "poisson": _poisson,
}


def mesh_report(terrain: Terrain, raster: Raster) -> MeshReport:
    """Measure the vertical error of a mesh against the raster's samples, independently of the mesher.

    The vertices are projected to the raster to find the triangle that covers each sample. The error is the distance
    from the sample to the plane of that triangle along the sample's own vertical, which deviates from the origin's by
    0.27° at 30 km.

    Parameters
    ----------
    terrain
        The mesh.
    raster
        The elevation raster, without holes.

    Returns
    -------
    MeshReport
        Size and errors.
    """
    height, width = raster.values.shape[:2]
    pixel = _pixel_coordinates(terrain.vertices, terrain.frame, raster)
    # Outermost samples lie exactly on the mesh's edge: scale by a thousandth of a pixel, more than the float32 error.
    middle = np.array([width, height]) / 2.0
    pixel = middle + (pixel - middle) * (1.0 + 2e-3 / max(height, width))
    face_id = covering_faces(pixel, terrain.faces, width, height)
    squared_sum, largest, covered = 0.0, 0.0, 0
    for first, position in _row_strips(raster, terrain.frame):
        ids = face_id[first : first + len(position)]
        hit = ids >= 0
        distance = _height_above_plane(terrain, ids[hit], position[hit])
        squared_sum += float(np.sum(distance**2))
        largest = max(largest, float(np.abs(distance).max(initial=0.0)))
        covered += distance.size
    grid_triangles = 2 * (height - 1) * (width - 1)
    return MeshReport(
        triangles=len(terrain.faces),
        vertices=len(terrain.vertices),
        grid_triangles=grid_triangles,
        saved_ratio=1.0 - len(terrain.faces) / grid_triangles,
        vertical_rmse_m=float(np.sqrt(squared_sum / max(covered, 1))),
        vertical_max_m=largest,
        samples=height * width,
        uncovered_samples=height * width - covered,
    )


def _pixel_coordinates(vertices: np.ndarray, frame: LocalFrame, raster: Raster) -> np.ndarray:
    """Column and row ``(V, 2)`` of vertices; the first pixel's centre is (0.5, 0.5)."""
    pixel = np.empty((len(vertices), 2))
    for first in range(0, len(pixel), _CHUNK):
        part = slice(first, first + _CHUNK)
        latitude, longitude, _ = geodetic_from_enu(frame, vertices[part])
        pixel[part] = raster_pixels(raster, latitude, longitude)
    return pixel


def _height_above_plane(terrain: Terrain, faces: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Signed distance ``(N,)`` [m] of points ``(N, 3)`` above the planes of faces ``(N,)`` along the local vertical."""
    a, b, c = (terrain.vertices[terrain.faces[faces, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    # The local vertical deviates from the origin's by the distance divided by the Earth's radius.
    vertical = normal[:, 2] + np.einsum("ij,ij->i", position[:, :2], normal[:, :2]) / MEAN_RADIUS_M
    return np.einsum("ij,ij->i", position - a, normal) / vertical
