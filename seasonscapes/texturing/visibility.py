"""Visibility of texels from a camera, by one shadow ray per texel from the surface to the camera.

`visible_by_depth` and `visible_by_faces` implement the usual alternatives for comparison: a depth map leaks at ridges
and loses slopes at grazing incidence, and marking every face that any pixel hits as visible leaks behind every ridge.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.rendering.sightlines import line_of_sight, visible_faces
from seasonscapes.texturing.atlas_tiles import TexelSurface

# Relative tolerance of `visible_by_depth`.
_DEPTH_TOLERANCE = 0.005


@dataclass(frozen=True)
class ProjectedTexels:
    """Projection of N surface points into a camera's image.

    Parameters
    ----------
    pixel
        ``(N, 2)`` image coordinates (x, y); NaN behind the camera.
    distance_m
        ``(N,)`` distance from the camera [m].
    cosine
        ``(N,)`` cosine of the angle between the face's normal and the direction to the camera.
    inside
        ``(N,)`` bool: within the image, and the face turned towards the camera.
    """

    pixel: np.ndarray
    distance_m: np.ndarray
    cosine: np.ndarray
    inside: np.ndarray

    def __getitem__(self, key: np.ndarray | slice) -> ProjectedTexels:
        """Return the points selected by an index array, mask or slice."""
        return ProjectedTexels(*(getattr(self, name)[key] for name in self.__dataclass_fields__))


def project_texels(camera: Camera, surface: TexelSurface) -> ProjectedTexels:
    """Project surface points into a camera's image, without a test for occlusion.

    Parameters
    ----------
    camera
        The view.
    surface
        N surface points.

    Returns
    -------
    ProjectedTexels
        Of the N points.
    """
    pose = camera.world_from_camera
    offset = surface.position_m - pose[:3, 3]
    local = offset @ pose[:3, :3]
    distance = np.sqrt(np.einsum("nc,nc->n", offset, offset))
    cosine = -np.einsum("nc,nc->n", offset, surface.normal) / np.maximum(distance, 1e-9)
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = np.where(local[:, 2] > 0.0, 1.0 / local[:, 2], np.nan)
        x, y = camera.fx * local[:, 0] * scale + camera.cx, camera.fy * local[:, 1] * scale + camera.cy
        inside = (x >= 0.0) & (x < camera.width_px) & (y >= 0.0) & (y < camera.height_px) & (cosine > 0.0)
    return ProjectedTexels(np.stack([x, y], axis=-1), distance, cosine, inside)


def visible_by_ray(
    terrain: RayScene,
    camera: Camera,
    surface: TexelSurface,
    projected: ProjectedTexels,
    *,
    offset_m: float | None = None,
) -> np.ndarray:
    """Return which surface points are visible from a camera, by one shadow ray each.

    Parameters
    ----------
    terrain
        Ray-tracing scene of the terrain.
    camera
        The view.
    surface
        N surface points.
    projected
        Their projection, from `project_texels`.
    offset_m
        Offset of the ray origins along the normals [m]; ``None`` for just beyond the rounding of float32. See
        `sightlines.line_of_sight`.

    Returns
    -------
    ndarray
        ``(N,)`` bool.
    """
    visible = projected.inside.copy()
    index = np.flatnonzero(visible)
    if len(index):
        visible[index] = line_of_sight(
            terrain, surface.position_m[index], surface.normal[index], camera.position_m, offset_m=offset_m
        )
    return visible


def visible_by_depth(
    depth_m: np.ndarray, projected: ProjectedTexels, *, tolerance: float = _DEPTH_TOLERANCE
) -> np.ndarray:
    """Return which surface points are visible, by comparison with a depth map.

    Parameters
    ----------
    depth_m
        ``(H, W)`` distance along the rays [m].
    projected
        N projected points.
    tolerance
        Relative excess of a point's distance over the depth map that still counts as visible.

    Returns
    -------
    ndarray
        ``(N,)`` bool.
    """
    visible = projected.inside.copy()
    index = np.flatnonzero(visible)
    column, row = projected.pixel[index].astype(int).T
    visible[index] = projected.distance_m[index] <= depth_m[row, column] * (1.0 + tolerance)
    return visible


def visible_by_faces(
    terrain: RayScene, camera: Camera, surface: TexelSurface, projected: ProjectedTexels
) -> np.ndarray:
    """Return which surface points are visible, taking each face that any pixel's ray hits as visible as a whole.

    Parameters
    ----------
    terrain
        Ray-tracing scene of the terrain.
    camera
        The view.
    surface
        N surface points.
    projected
        Their projection, from `project_texels`.

    Returns
    -------
    ndarray
        ``(N,)`` bool.
    """
    hit = np.unique(visible_faces(terrain, camera))
    return projected.inside & np.isin(surface.face, hit[hit >= 0])
