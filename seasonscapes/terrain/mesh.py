"""From heights on a map to triangles in the local frame, and how far those triangles are from the heights.

Every vertex goes map → WGS 84 → ECEF → east-north-up, so that convergence of the meridians, Earth curvature and (where
the frame asks for it) refraction come by themselves.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from seasonscapes.frames import MEAN_RADIUS_M, LocalFrame, enu_from_geodetic, geodetic_from_enu
from seasonscapes.terrain.atlas import planar_uv
from seasonscapes.terrain.crs import apply_affine, geodetic_from_map, raster_pixels
from seasonscapes.terrain.poisson import largest_piece, poisson_surface
from seasonscapes.terrain.surface import Raster, Terrain
from seasonscapes.terrain.texels import covering_faces

DEFAULT_MAX_ERROR_M = 5.0
# Work in pieces of this many samples: the float64 temporaries of geodesy then stay below 200 MB.
_CHUNK = 500_000
# Samples that the Poisson surface is given past the rim.
_MARGIN = 4


@dataclass(frozen=True)
class MeshReport:
    """How a mesh compares with the raster it was made from.

    Parameters
    ----------
    triangles, vertices
        Counts.
    grid_triangles
        Triangles of the full grid.
    saved_ratio
        Share of the full grid's triangles that were not needed, in [0, 1].
    vertical_rmse_m, vertical_max_m
        Distance of the mesh from the raster's samples along the local vertical [m].
    samples, uncovered_samples
        Samples compared, and those that no triangle covers.
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
    """Triangulate the heights of a raster.

    Parameters
    ----------
    raster
        ``values`` ``(H, W, 1)`` heights [m] without holes (see `fill_nodata`). Samples are pixel centres.
    mesher
        A name in `MESHERS`: ``adaptive`` (as few triangles as the error bound needs), ``grid`` (every sample a
        vertex), ``poisson`` (the surface of the SeasonScapes paper; needs the extra ``poisson``).
    max_error_m
        Bound of ``adaptive`` on the vertical distance between mesh and every sample [m]; others ignore it.

    Returns
    -------
    Terrain
        With the planar UV of its plan; see `unwrap` for the others.

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


def sample_positions(raster: Raster, frame: LocalFrame, row, column, height_m) -> np.ndarray:
    """East, north, up ``(N, 3)`` float64 [m] of points at pixel-centre indices ``(N,)`` with given heights ``(N,)``."""
    x, y = apply_affine(raster.transform, np.asarray(column) + 0.5, np.asarray(row) + 0.5)
    latitude, longitude = geodetic_from_map(raster.crs, x, y)
    return enu_from_geodetic(frame, latitude, longitude, height_m)


def _row_strips(raster: Raster, frame: LocalFrame):
    """Positions of all samples strip by strip: first row, and ``(rows, W, 3)`` float64."""
    height, width = raster.values.shape[:2]
    strip = max(1, _CHUNK // width)
    for first in range(0, height, strip):
        row, column = np.mgrid[first : min(first + strip, height), 0:width]
        heights = raster.values[first : first + strip, :, 0]
        yield first, sample_positions(raster, frame, row, column, heights)


def _is_mirrored(raster: Raster) -> bool:
    """Whether rows run to the left of columns on the ground, as in south-up rasters (north-up ones are not)."""
    return raster.transform.determinant > 0.0


def _adaptive(raster: Raster, frame: LocalFrame, max_error_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Greedy insertion of the worst sample until none is further off than the bound (Garland & Heckbert 1995).

    What is triangulated is the *up* coordinate of each sample, not its height: a triangle is flat in the frame, and
    over a 20 km lake the Earth bulges 8 m out of it.
    """
    from pydelatin import Delatin

    height, width = raster.values.shape[:2]
    up = np.empty((height, width), np.float32)
    for first, position in _row_strips(raster, frame):
        up[first : first + len(position)] = position[..., 2]
    # The mesher's planes are linear in pixels and float32, ours in metres and through the Earth: keep a little in hand.
    mesh = Delatin(up, max_error=0.995 * max_error_m)
    column, row = mesh.vertices[:, 0].astype(np.intp), height - 1 - mesh.vertices[:, 1].astype(np.intp)
    vertices = sample_positions(raster, frame, row, column, raster.values[row, column, 0]).astype(np.float32)
    faces = mesh.triangles
    return vertices, faces[:, ::-1].copy() if _is_mirrored(raster) else faces


def _grid(raster: Raster, frame: LocalFrame, max_error_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Two triangles for each cell of four samples."""
    height, width = raster.values.shape[:2]
    vertices = np.empty((height, width, 3), np.float32)
    for first, position in _row_strips(raster, frame):
        vertices[first : first + len(position)] = position
    return vertices.reshape(-1, 3), grid_faces(height, width, mirrored=_is_mirrored(raster))


def grid_faces(height: int, width: int, *, mirrored: bool = False) -> np.ndarray:
    """Faces ``(2 (H-1) (W-1), 3)`` uint32 of a grid of samples whose row 0 is north; reversed when ``mirrored``."""
    faces = np.empty((height - 1, width - 1, 2, 3), np.uint32)
    corner = np.arange(height - 1, dtype=np.uint32)[:, None] * np.uint32(width) + np.arange(width - 1, dtype=np.uint32)
    south = np.uint32(width)
    order = (0, 2, 1) if mirrored else (0, 1, 2)
    for triangle, offsets in enumerate(((0, south, 1), (1, south, south + 1))):
        for slot, offset in zip(order, offsets, strict=True):
            np.add(corner, np.uint32(offset), out=faces[:, :, triangle, slot])
    return faces.reshape(-1, 3)


def _poisson(raster: Raster, frame: LocalFrame, max_error_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Screened Poisson surface of all samples, cut at the raster's rim."""
    height, width = raster.values.shape[:2]
    # Reconstruction bends at the rim of its points: give it a margin that continues the slope, then cut it off.
    row, column = np.mgrid[-_MARGIN : height + _MARGIN, -_MARGIN : width + _MARGIN]
    heights = np.pad(raster.values[..., 0].astype(np.float64), _MARGIN, mode="reflect", reflect_type="odd")
    vertices, faces = poisson_surface(sample_positions(raster, frame, row, column, heights))
    pixel = _pixel_coordinates(vertices, frame, raster) - 0.5
    inside = ((pixel >= 0.0) & (pixel <= [width - 1, height - 1])).all(axis=1)
    faces = largest_piece(faces[inside[faces].any(axis=1)], len(vertices))
    if _plan_area(vertices, faces) < 0.0:
        faces = faces[:, ::-1]
    used, faces = np.unique(faces, return_inverse=True)
    return vertices[used], faces.reshape(-1, 3).astype(np.uint32)


def _plan_area(vertices: np.ndarray, faces: np.ndarray) -> float:
    a, b, c = (vertices[faces[:, k], :2].astype(np.float64) for k in range(3))
    return float(np.sum((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])) / 2.0


MESHERS: dict[str, Callable[[Raster, LocalFrame, float], tuple[np.ndarray, np.ndarray]]] = {
    "adaptive": _adaptive,
    "grid": _grid,
    "poisson": _poisson,
}


def mesh_report(terrain: Terrain, raster: Raster) -> MeshReport:
    """Measure a mesh against the raster's samples, knowing nothing of how it was made.

    The vertices are carried back to the map to find the triangle under each sample; the distance is then taken in the
    frame, from the sample along its own vertical (not the origin's, 0.27° off at 30 km) to the plane of that triangle.
    """
    height, width = raster.values.shape[:2]
    pixel = _pixel_coordinates(terrain.vertices, terrain.frame, raster)
    # Samples on the rim lie exactly on the mesh's edge: widen by a thousandth of a pixel, more than float32 loses.
    middle = np.array([width, height]) / 2.0
    pixel = middle + (pixel - middle) * (1.0 + 2e-3 / max(height, width))
    face_id = covering_faces(pixel, terrain.faces, width, height)
    square, worst, covered = 0.0, 0.0, 0
    for first, position in _row_strips(raster, terrain.frame):
        ids = face_id[first : first + len(position)]
        hit = ids >= 0
        distance = _height_above_plane(terrain, ids[hit], position[hit])
        square += float(np.sum(distance**2))
        worst = max(worst, float(np.abs(distance).max(initial=0.0)))
        covered += distance.size
    grid_triangles = 2 * (height - 1) * (width - 1)
    return MeshReport(
        triangles=len(terrain.faces),
        vertices=len(terrain.vertices),
        grid_triangles=grid_triangles,
        saved_ratio=1.0 - len(terrain.faces) / grid_triangles,
        vertical_rmse_m=float(np.sqrt(square / max(covered, 1))),
        vertical_max_m=worst,
        samples=height * width,
        uncovered_samples=height * width - covered,
    )


def _pixel_coordinates(vertices: np.ndarray, frame: LocalFrame, raster: Raster) -> np.ndarray:
    """Column and row ``(V, 2)`` of vertices, 0.5 at the first pixel's centre."""
    pixel = np.empty((len(vertices), 2))
    for first in range(0, len(pixel), _CHUNK):
        part = slice(first, first + _CHUNK)
        latitude, longitude, _ = geodetic_from_enu(frame, vertices[part])
        pixel[part] = raster_pixels(raster, latitude, longitude)
    return pixel


def _height_above_plane(terrain: Terrain, faces: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Signed distance ``(N,)`` [m] of points ``(N, 3)`` above the planes of faces ``(N,)``, along their verticals."""
    a, b, c = (terrain.vertices[terrain.faces[faces, k]].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    # The vertical of a place leans outwards by its distance over the Earth's radius.
    vertical = normal[:, 2] + np.einsum("ij,ij->i", position[:, :2], normal[:, :2]) / MEAN_RADIUS_M
    return np.einsum("ij,ij->i", position - a, normal) / vertical
