"""Screened Poisson surface reconstruction from a grid of points, as in the SeasonScapes paper."""

from __future__ import annotations

import numpy as np

from seasonscapes.declaration import InputError

# An octree of this depth has cells of 15 m over 60 km and takes several gigabytes.
MAX_DEPTH = 12


def poisson_surface(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reconstruct a smooth surface near a grid of points.

    Kazhdan & Hoppe 2013, "Screened Poisson surface reconstruction", doi:10.1145/2487228.2487237, in the implementation
    of Open3D, with octree cells of about the grid's spacing. The surface is smoothed without an error bound and extends
    beyond the grid.

    Parameters
    ----------
    points
        ``(H, W, 3)`` [m].

    Returns
    -------
    vertices
        ``(V, 3)`` float32 [m].
    faces
        ``(F, 3)`` uint32.

    Raises
    ------
    InputError
        Open3D or a system library that it needs is not installed.
    """
    try:
        import open3d  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise InputError(
            "mesher poisson",
            f"Open3D cannot be loaded ({error})",
            cure="pip install 'seasonscapes[poisson]', or use the adaptive mesher",
        ) from None
    along_rows, along_columns = np.gradient(points, axis=(0, 1))
    normals = np.cross(along_columns, along_rows).reshape(-1, 3)
    normals *= np.sign(np.median(normals[:, 2])) / np.linalg.norm(normals, axis=1, keepdims=True)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.reshape(-1, 3)))
    cloud.normals = open3d.utility.Vector3dVector(normals)
    scale = 1.1
    spacing = np.linalg.norm(along_columns[..., :2], axis=-1).mean()
    depth = int(np.ceil(np.log2(scale * np.ptp(points.reshape(-1, 3), axis=0).max() / spacing)))
    # A single thread: with several, the summation order and therefore the vertices differ between runs.
    mesh, _ = open3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
        cloud, depth=min(max(depth, 4), MAX_DEPTH), scale=scale, linear_fit=True, n_threads=1
    )
    return _without_degenerate_faces(np.asarray(mesh.vertices).astype(np.float32), np.asarray(mesh.triangles))


def _without_degenerate_faces(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices that coincide in float32 and remove faces of zero area."""
    vertices, merged = np.unique(vertices, axis=0, return_inverse=True)
    faces = merged.reshape(-1)[faces]
    a, b, c = (vertices[faces[:, k]].astype(np.float64) for k in range(3))
    area_m2 = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0
    return vertices, faces[area_m2 > 1e-9].astype(np.uint32)


def largest_piece(faces: np.ndarray, vertex_count: int) -> np.ndarray:
    """Select the faces of the largest connected component of a mesh.

    Parameters
    ----------
    faces
        ``(F, 3)`` vertex indices.
    vertex_count
        Number of vertices.

    Returns
    -------
    numpy.ndarray
        ``(N, 3)`` faces of the component with the most faces.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]]).astype(np.int64)
    graph = coo_array((np.ones(len(edges), bool), edges.T), shape=(vertex_count, vertex_count))
    _, label = connected_components(graph, directed=False)
    component = label[faces[:, 0]]
    return faces[component == np.argmax(np.bincount(component))]
