"""Which texels a camera sees: a ray from each, off its face along the normal, to the camera.

`by_depth` and `by_faces` are what others do, kept to compare with: a depth map leaks at ridges and loses grazing slopes,
and painting whole faces of which one pixel was seen leaks past every one of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.hemisphere_rays import RayScene
from seasonscapes.rendering.sightlines import clear_sight, faces_met
from seasonscapes.texturing.atlas_tiles import TexelSurface

# Half the side of the pixels around a texel's own that `by_depth` may agree with, and its tolerance.
_DEPTH_TOLERANCE = 0.005


@dataclass(frozen=True)
class ProjectedTexels:
    """A camera's picture of N places: where they fall in it, and how.

    Parameters
    ----------
    pixel
        ``(N, 2)`` (x, y); NaN behind the camera.
    distance_m
        ``(N,)`` from the camera [m].
    cosine
        ``(N,)`` between the face's normal and the direction to the camera.
    inside
        ``(N,)`` bool: within the frame, and the face turned towards the camera.
    """

    pixel: np.ndarray
    distance_m: np.ndarray
    cosine: np.ndarray
    inside: np.ndarray

    def __getitem__(self, key) -> ProjectedTexels:
        return ProjectedTexels(*(getattr(self, name)[key] for name in self.__dataclass_fields__))


def project_texels(camera: Camera, surface: TexelSurface) -> ProjectedTexels:
    """Project places into a camera's frame; nothing of what stands between is known yet."""
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


def by_ray(
    terrain: RayScene, camera: Camera, surface: TexelSurface, sight: ProjectedTexels, *, lift_m: float | None = None
) -> np.ndarray:
    """Whether a camera sees places, ``(N,)`` bool, by one shadow ray each; see `sightlines.clear_sight`."""
    seen = sight.inside.copy()
    index = np.flatnonzero(seen)
    if len(index):
        seen[index] = clear_sight(
            terrain, surface.position_m[index], surface.normal[index], camera.position_m, lift_m=lift_m
        )
    return seen


def by_depth(depth_m: np.ndarray, sight: ProjectedTexels, *, tolerance: float = _DEPTH_TOLERANCE) -> np.ndarray:
    """The same by a depth map ``(H, W)`` [m]: within a share ``tolerance`` of what the place's pixel shows."""
    seen = sight.inside.copy()
    index = np.flatnonzero(seen)
    column, row = sight.pixel[index].astype(int).T
    seen[index] = sight.distance_m[index] <= depth_m[row, column] * (1.0 + tolerance)
    return seen


def by_faces(terrain: RayScene, camera: Camera, surface: TexelSurface, sight: ProjectedTexels) -> np.ndarray:
    """The same by faces: all of a face of which any pixel was met."""
    met = np.unique(faces_met(terrain, camera))
    return sight.inside & np.isin(surface.face, met[met >= 0])
