"""Air and sky over a whole picture from a coarse grid: they are smooth, and a model of them is slow to ask.

Aerial perspective is asked at the nodes of a grid of pixels × distances and interpolated (Hillaire 2020, "A scalable and
production ready sky and atmosphere rendering technique", doi:10.1111/cgf.14050, § 5.4); the open sky at every fourth
pixel, and at every pixel around sun and moon.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from seasonscapes.cameras.pinhole import Camera, ray_directions
from seasonscapes.rendering.scene import background
from seasonscapes.sky.illumination import AerialPerspective, Illumination

_AIR_STEP_PX, _SLICES = 16, 32
_SKY_STEP_PX = 4
# Around a luminary the sky is as sharp as the aerosol's forward peak.
_AUREOLE_DEG = 4.0


@dataclass(frozen=True)
class AirGrid:
    """Nodes of a camera's view where air is asked.

    Parameters
    ----------
    direction
        ``(h, w, 3)`` of the nodes' pixels.
    depth_m
        ``(_SLICES,)``, a geometric sequence.
    """

    direction: np.ndarray
    depth_m: np.ndarray


def _nodes(camera: Camera, step: int) -> np.ndarray:
    """Directions at every ``step``-th pixel corner, the last ones at or past the rim."""
    x = np.arange(0, camera.width_px + step, step, dtype=float)
    y = np.arange(0, camera.height_px + step, step, dtype=float)
    return ray_directions(camera, np.stack(np.meshgrid(x, y), axis=-1))


def air_grid(camera: Camera, nearest_m: float, farthest_m: float) -> AirGrid:
    """A grid for the distances that a view shows [m]."""
    low = max(nearest_m, 1.0)
    return AirGrid(_nodes(camera, _AIR_STEP_PX), np.geomspace(low, max(farthest_m, 1.01 * low), _SLICES))


def grid_places(grid: AirGrid, pixel_xy: np.ndarray, depth_m: np.ndarray) -> Any:
    """``mi.Point3f`` of N pixel positions ``(N, 2)`` (x, y) and distances ``(N,)`` [m] in the grid's texture."""
    import mitsuba as mi

    height, width = grid.direction.shape[:2]
    share = np.log(np.maximum(depth_m, grid.depth_m[0]) / grid.depth_m[0]) / np.log(grid.depth_m[-1] / grid.depth_m[0])
    across, down = pixel_xy[:, 0] / _AIR_STEP_PX, pixel_xy[:, 1] / _AIR_STEP_PX
    columns = ((across + 0.5) / width, (down + 0.5) / height, (share * (_SLICES - 1) + 0.5) / _SLICES)
    return mi.Point3f(*(mi.Float(np.ascontiguousarray(column, np.float32)) for column in columns))


def mi_air(grid: AirGrid, air: AerialPerspective) -> Any:
    """Transmittance and airlight at the nodes as a texture of six channels."""
    import drjit as dr
    import mitsuba as mi

    shape = (_SLICES, *grid.direction.shape[:2])
    depth = np.broadcast_to(grid.depth_m[:, None, None], shape)
    parts = air(depth, np.broadcast_to(grid.direction, (*shape, 3)))
    values = np.concatenate(np.broadcast_arrays(*parts), axis=-1).astype(np.float32)
    return mi.Texture3f(mi.TensorXf(np.ascontiguousarray(values)), wrap_mode=dr.WrapMode.Clamp)


@dataclass(frozen=True)
class SkyGrid:
    """Where a view's K open pixels lie among the nodes where the sky is asked.

    Parameters
    ----------
    node
        ``(h, w, 3)`` directions of the nodes.
    used
        ``(h w,)`` bool: nodes that open pixels need.
    corner, share
        ``(4, K)`` int32 nodes around each pixel and their weights.
    direction
        ``(K, 3)`` of the pixels themselves.
    """

    node: np.ndarray
    used: np.ndarray
    corner: np.ndarray
    share: np.ndarray
    direction: np.ndarray


def sky_grid(camera: Camera, pixel: np.ndarray) -> SkyGrid:
    """For the flat indices ``(K,)`` of pixels that show any open sky."""
    node = _nodes(camera, _SKY_STEP_PX)
    width = node.shape[1]
    row, column = np.divmod(pixel, camera.width_px)
    across, down = (column + 0.5) / _SKY_STEP_PX, (row + 0.5) / _SKY_STEP_PX
    left, top = across.astype(np.int32), down.astype(np.int32)
    fx, fy = (across - left).astype(np.float32), (down - top).astype(np.float32)
    first = top * width + left
    corner = np.stack([first, first + 1, first + width, first + width + 1])
    share = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    used = np.zeros(node.shape[0] * width, bool)
    used[corner] = True
    direction = ray_directions(camera, np.stack([column + 0.5, row + 0.5], axis=-1))
    return SkyGrid(node, used, corner, share, direction.astype(np.float32))


def open_sky(grid: SkyGrid, illumination: Illumination, pixel_angle_deg: float) -> np.ndarray:
    """Radiance ``(K, 3)`` [cd/m²] of the open pixels, with the discs of sun and moon; see `scene.background`."""
    bare = replace(illumination, sun=None, moon=None)
    at_nodes = np.zeros((len(grid.used), 3), np.float32)
    at_nodes[grid.used] = background(bare, grid.node.reshape(-1, 3)[grid.used], pixel_angle_deg)
    sky = np.zeros((len(grid.direction), 3), np.float32)
    for corner, share in zip(grid.corner, grid.share, strict=True):
        sky += at_nodes[corner] * share[:, None]
    near = np.zeros(len(sky), bool)
    for body in (illumination.sun, illumination.moon):
        if body is not None:
            near |= grid.direction @ np.asarray(body.direction, np.float32) > np.cos(np.radians(_AUREOLE_DEG))
    if near.any():
        sky[near] = background(illumination, grid.direction[near].astype(np.float64), pixel_angle_deg)
    return sky
