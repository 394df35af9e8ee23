"""The surface of the SeasonScapes paper: screened Poisson reconstruction from the raster's points."""

from __future__ import annotations

import numpy as np

from seasonscapes.declaration import InputError

# An octree of this depth has cells of 15 m over 60 km and takes gigabytes; deeper ones do not pay.
MAX_DEPTH = 12


def poisson_surface(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices ``(V, 3)`` float32 and faces ``(F, 3)`` uint32 of a smooth surface near a grid of points ``(H, W, 3)``.

    Kazhdan & Hoppe 2013, "Screened Poisson surface reconstruction", doi:10.1145/2487228.2487237, as built into Open3D,
    with octree cells as large as the grid's spacing. The surface smooths the points (it is not bounded in error) and
    reaches past their rim.

    Raises
    ------
    InputError
        Open3D is not installed, or lacks a library of the system.
    """
    try:
        import open3d
    except ImportError as error:
        raise InputError(
            "mesher poisson",
            f"Open3D cannot be loaded ({error})",
            cure="pip install 'seasonscapes[poisson]', or take the adaptive mesher",
        ) from None
    along_rows, along_columns = np.gradient(points, axis=(0, 1))
    normals = np.cross(along_columns, along_rows).reshape(-1, 3)
    normals *= np.sign(np.median(normals[:, 2])) / np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.reshape(-1, 3)))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    scale = 1.1
    spacing = np.linalg.norm(along_columns[..., :2], axis=-1).mean()
    depth = int(np.ceil(np.log2(scale * np.ptp(points.reshape(-1, 3), axis=0).max() / spacing)))
    # One thread: with several, the order of additions and so the vertices differ from run to run.
    mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=min(max(depth, 4), MAX_DEPTH), scale=scale, linear_fit=True, n_threads=1
    )
    return _without_needles(np.asarray(mesh.vertices).astype(np.float32), np.asarray(mesh.triangles))


def _without_needles(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Join vertices that are the same in float32 and drop the faces that this leaves without area."""
    vertices, joined = np.unique(vertices, axis=0, return_inverse=True)
    faces = joined.reshape(-1)[faces]
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    area_m2 = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0
    return vertices, faces[area_m2 > 1e-9].astype(np.uint32)


def largest_piece(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """The faces of the largest connected piece."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]).astype(np.int64)
    graph = coo_array((np.ones(len(edges), bool), edges.T), shape=(vertex_count, vertex_count))
    _, label = connected_components(graph, directed=False)
    piece = label[faces[:, 0]]
    return faces[piece == np.argmax(np.bincount(piece))]
