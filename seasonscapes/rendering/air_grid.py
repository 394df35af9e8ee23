"""Air and sky over a whole picture from a coarse grid: they are smooth, and a model of them is slow to ask.

Aerial perspective is asked at the nodes of a grid of pixels × distances and interpolated (Hillaire 2020, "A scalable and
production ready sky and atmosphere rendering technique", doi:10.1111/cgf.14050, § 5.4); the open sky at every fourth
pixel, and at every pixel around sun and moon.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from seasonscapes.cameras.panorama import Panorama, view_directions
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.mitsuba_scene import background
from seasonscapes.sky.illumination import AerialPerspective, Illumination

# Nodes are this far apart in angle and in pixels at most.
_AIR_STEP_DEG, _AIR_STEP_PX, _SLICES = 1.2, 16, 32
_SKY_STEP_DEG, _SKY_STEP_PX = 0.3, 4
# Around a luminary the sky is as sharp as the aerosol's forward peak.
_AUREOLE_DEG = 4.0


@dataclass(frozen=True)
class AirPlaces:
    """Where a view's n pixels of terrain lie in a grid at whose nodes the air is asked.

    Parameters
    ----------
    direction
        ``(h, w, 3)`` of the nodes' pixels.
    depth_m
        ``(_SLICES,)`` distances of the nodes, a geometric sequence.
    mi_place
        ``mi.Point3f`` of n lanes in the grid's texture.
    several, mi_several, share
        ``(k,)`` pixels that show several distances; ``k S`` lanes of their samples; ``(k, S)`` weights of these.
    """

    direction: np.ndarray
    depth_m: np.ndarray
    mi_place: Any
    several: np.ndarray
    mi_several: Any
    share: np.ndarray


def _step_px(camera: Camera | Panorama, most_deg: float, most_px: int) -> int:
    return int(np.clip(np.radians(most_deg) * max(camera.fx, camera.fy), 1, most_px))


def _nodes(camera: Camera | Panorama, step: int) -> np.ndarray:
    """Directions at the centre of every ``step``-th pixel, the last ones past the rim."""
    x = 0.5 + np.arange(0, camera.width_px + step, step)
    y = 0.5 + np.arange(0, camera.height_px + step, step)
    return view_directions(camera, np.stack(np.meshgrid(x, y), axis=-1))


def air_places(
    camera: Camera | Panorama, pixel: np.ndarray, depth_m: np.ndarray, several: tuple[np.ndarray, np.ndarray]
) -> AirPlaces:
    """For flat indices ``(n,)`` of pixels and their distances ``(n,)`` [m].

    ``several`` are the numbers ``(k,)`` among the n of pixels whose air is averaged over samples, and those samples'
    distances ``(k, S)``, infinite where they show no terrain.
    """
    index, distance_m = several
    shown = np.isfinite(distance_m)
    low, high = max(float(depth_m.min()), 1.0), float(max(depth_m.max(), distance_m[shown].max(initial=0.0)))
    step = _step_px(camera, _AIR_STEP_DEG, _AIR_STEP_PX)
    nodes, depths = _nodes(camera, step), np.geomspace(low, max(high, 1.01 * low), _SLICES)

    def place(flat: np.ndarray, distance: np.ndarray) -> Any:
        import mitsuba as mi

        row, column = np.divmod(flat, camera.width_px)
        share = np.log(np.maximum(distance, low) / low) / np.log(depths[-1] / low)
        columns = (
            (column / step + 0.5) / nodes.shape[1],
            (row / step + 0.5) / nodes.shape[0],
            (share * (_SLICES - 1) + 0.5) / _SLICES,
        )
        return mi.Point3f(*(mi.Float(np.ascontiguousarray(values, np.float32)) for values in columns))

    samples = np.repeat(pixel[index], distance_m.shape[1])
    return AirPlaces(
        nodes,
        depths,
        place(pixel, depth_m),
        index,
        place(samples, np.where(shown, distance_m, low).ravel()),
        shown / np.maximum(shown.sum(axis=1, keepdims=True), 1),
    )


def air_at(places: AirPlaces, air: AerialPerspective) -> tuple[np.ndarray, np.ndarray]:
    """Transmittance and airlight ``(n, 3)`` of the pixels."""
    import drjit as dr
    import mitsuba as mi

    shape = (_SLICES, *places.direction.shape[:2])
    depth = np.broadcast_to(places.depth_m[:, None, None], shape)
    parts = air(depth, np.broadcast_to(places.direction, (*shape, 3)))
    nodes = np.concatenate([np.broadcast_to(part, (*shape, 3)) for part in parts], axis=-1).astype(np.float32)
    texture = mi.Texture3f(mi.TensorXf(np.ascontiguousarray(nodes)), wrap_mode=dr.WrapMode.Clamp)
    values = np.array(texture.eval(places.mi_place)).T.copy()
    if len(places.several):
        samples = np.array(texture.eval(places.mi_several)).T.reshape(*places.share.shape, 6)
        values[places.several] = np.einsum("ks,ksc->kc", places.share, samples)
    return values[:, :3], values[:, 3:]


@dataclass(frozen=True)
class SkyGrid:
    """Where a view's K open pixels lie among the nodes where the sky is asked.

    Parameters
    ----------
    pixel
        ``(K,)`` flat index of each.
    node
        ``(h, w, 3)`` directions of the nodes.
    used
        ``(h w,)`` bool: nodes that open pixels need.
    corner, share
        ``(4, K)`` int32 nodes around each pixel and their weights.
    direction
        ``(K, 3)`` of the pixels themselves.
    """

    pixel: np.ndarray
    node: np.ndarray
    used: np.ndarray
    corner: np.ndarray
    share: np.ndarray
    direction: np.ndarray


def sky_grid(camera: Camera | Panorama, pixel: np.ndarray) -> SkyGrid:
    """For the flat indices ``(K,)`` of pixels that show any open sky."""
    step = _step_px(camera, _SKY_STEP_DEG, _SKY_STEP_PX)
    node = _nodes(camera, step)
    width = node.shape[1]
    row, column = np.divmod(pixel, camera.width_px)
    across, down = column / step, row / step
    left, top = across.astype(np.int32), down.astype(np.int32)
    fx, fy = (across - left).astype(np.float32), (down - top).astype(np.float32)
    first = top * width + left
    corner = np.stack([first, first + 1, first + width, first + width + 1])
    share = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    used = np.zeros(node.shape[0] * width, bool)
    used[corner] = True
    direction = view_directions(camera, np.stack([column + 0.5, row + 0.5], axis=-1))
    return SkyGrid(pixel, node, used, corner, share, direction.astype(np.float32))


def open_sky(grid: SkyGrid, illumination: Illumination, pixel_angle_deg: float) -> np.ndarray:
    """Radiance ``(K, 3)`` [cd/m²] of the open pixels, with the discs of sun and moon; see `mitsuba_scene.background`."""
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
