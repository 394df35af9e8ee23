"""Aerial perspective and sky radiance of an image, interpolated from a coarse grid of pixels.

Both vary smoothly over an image, and the sky model is expensive to evaluate. Aerial perspective is evaluated at the
nodes of a grid of pixels × distances and interpolated trilinearly (Hillaire 2020, "A scalable and production ready sky
and atmosphere rendering technique", doi:10.1111/cgf.14050, § 5.4). Sky radiance is evaluated at every fourth pixel and
interpolated bilinearly, but at every pixel around sun and moon.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from seasonscapes.cameras.panorama import Panorama, view_directions
from seasonscapes.cameras.pinhole import Camera
from seasonscapes.images import scaled_pixels
from seasonscapes.rendering.backend import aligned, to_numpy
from seasonscapes.rendering.mitsuba_scene import sky_radiance_towards
from seasonscapes.sky.illumination import AerialPerspective, Illumination

# Largest spacing of the nodes, in angle and in pixels.
_AIR_STEP_DEG, _AIR_STEP_PX, _SLICES = 1.2, 16, 32
_SKY_STEP_DEG, _SKY_STEP_PX = 0.3, 4
# Around sun and moon the sky varies as fast as the aerosol's forward-scattering peak.
_AUREOLE_DEG = 4.0


@dataclass(frozen=True)
class AirGrid:
    """Grid at which aerial perspective is evaluated, and the positions of a view's n terrain pixels in it.

    Parameters
    ----------
    direction
        ``(h, w, 3)`` unit view directions of the nodes, ENU.
    depth_m
        ``(_SLICES,)`` distances of the nodes, a geometric sequence [m].
    mi_coordinate
        ``mi.Point3f`` of n lanes: coordinates of the pixels in the grid's 3D texture.
    mixed
        ``(k,)`` numbers among the n of pixels whose samples lie at several distances.
    mi_sample_coordinate
        ``mi.Point3f`` of ``k S`` lanes: coordinates of the S samples of these pixels.
    sample_weight
        ``(k, S)`` weight of each of these samples, sum 1 over the terrain samples of a pixel.
    """

    direction: np.ndarray
    depth_m: np.ndarray
    mi_coordinate: Any
    mixed: np.ndarray
    mi_sample_coordinate: Any
    sample_weight: np.ndarray


def _step_px(camera: Camera | Panorama, most_deg: float, most_px: int) -> int:
    return int(np.clip(np.radians(most_deg) * max(camera.fx, camera.fy), 1, most_px))


def _node_directions(camera: Camera | Panorama, step: int) -> np.ndarray:
    """View directions ``(h, w, 3)`` at the centre of every ``step``-th pixel; the last nodes lie beyond the image."""
    x = 0.5 + np.arange(0, camera.width_px + step, step)
    y = 0.5 + np.arange(0, camera.height_px + step, step)
    return view_directions(camera, np.stack(np.meshgrid(x, y), axis=-1))


def air_grid(
    camera: Camera | Panorama, pixel: np.ndarray, depth_m: np.ndarray, mixed: np.ndarray, mixed_distance_m: np.ndarray
) -> AirGrid:
    """Build the grid of aerial perspective for the terrain pixels of a view.

    Parameters
    ----------
    camera
        The view.
    pixel
        ``(n,)`` flat indices of the terrain pixels.
    depth_m
        ``(n,)`` distances of their terrain along the ray [m].
    mixed
        ``(k,)`` numbers among the n of pixels whose air is averaged over samples at several distances.
    mixed_distance_m
        ``(k, S)`` distances of the samples of these pixels [m], infinite for samples of the sky.

    Returns
    -------
    AirGrid
        Grid nodes and the positions of the pixels between them, for `interpolate_air`.
    """
    on_terrain = np.isfinite(mixed_distance_m)
    low, high = (
        max(float(depth_m.min()), 1.0),
        float(max(depth_m.max(), mixed_distance_m[on_terrain].max(initial=0.0))),
    )
    step = _step_px(camera, _AIR_STEP_DEG, _AIR_STEP_PX)
    nodes, depths = _node_directions(camera, step), np.geomspace(low, max(high, 1.01 * low), _SLICES)

    def coordinates(flat: np.ndarray, distance: np.ndarray) -> Any:
        import mitsuba as mi

        row, column = np.divmod(flat, camera.width_px)
        relative = np.log(np.maximum(distance, low) / low) / np.log(depths[-1] / low)
        columns = (
            (column / step + 0.5) / nodes.shape[1],
            (row / step + 0.5) / nodes.shape[0],
            (relative * (_SLICES - 1) + 0.5) / _SLICES,
        )
        return mi.Point3f(*(mi.Float(aligned(values)) for values in columns))

    samples = np.repeat(pixel[mixed], mixed_distance_m.shape[1])
    return AirGrid(
        nodes,
        depths,
        coordinates(pixel, depth_m),
        mixed,
        coordinates(samples, np.where(on_terrain, mixed_distance_m, low).ravel()),
        on_terrain / np.maximum(on_terrain.sum(axis=1, keepdims=True), 1),
    )


def interpolate_air(grid: AirGrid, air: AerialPerspective) -> tuple[np.ndarray, np.ndarray]:
    """Interpolate aerial perspective at the terrain pixels of a view.

    Parameters
    ----------
    grid
        From `air_grid`.
    air
        Aerial perspective of the illumination; evaluated at the grid nodes.

    Returns
    -------
    transmittance
        ``(n, 3)`` between terrain and camera.
    airlight
        ``(n, 3)`` radiance scattered into the view ray [cd/m²].
    """
    return start_air(grid, air)()


def start_air(grid: AirGrid, air: AerialPerspective) -> Callable[[], tuple[np.ndarray, np.ndarray]]:
    """Start `interpolate_air`, and return the function that gives its result: other threads interpolate meanwhile."""
    import drjit as dr
    import mitsuba as mi

    shape = (_SLICES, *grid.direction.shape[:2])
    parts = air(grid.depth_m[:, None, None], grid.direction)
    nodes = np.concatenate([np.broadcast_to(part, (*shape, 3)) for part in parts], axis=-1).astype(np.float32)
    # The stub of Dr.Jit gives the texture types as `object`.
    texture: Any = mi.Texture3f(  # pyright: ignore[reportCallIssue]
        mi.TensorXf(aligned(nodes)), wrap_mode=dr.WrapMode.Clamp
    )
    channels = texture.eval(grid.mi_coordinate)
    of_samples = texture.eval(grid.mi_sample_coordinate) if len(grid.mixed) else []
    # Together: all are read at once.
    dr.eval(channels)
    dr.eval(of_samples)

    def read() -> tuple[np.ndarray, np.ndarray]:
        # Apart, since what is computed with either takes several times as long with both side by side.
        transmittance, airlight = (to_numpy(mi.Vector3f(*channels[k : k + 3])) for k in (0, 3))
        if len(grid.mixed):
            samples = np.stack([np.array(channel) for channel in of_samples], axis=-1)
            mean = np.einsum("ks,ksc->kc", grid.sample_weight, samples.reshape(*grid.sample_weight.shape, 6))
            transmittance[grid.mixed], airlight[grid.mixed] = mean[:, :3], mean[:, 3:]
        return transmittance, airlight

    return read


@dataclass(frozen=True)
class SkyGrid:
    """Positions of a view's K sky pixels among the nodes at which sky radiance is evaluated.

    Parameters
    ----------
    pixel
        ``(K,)`` flat indices of the pixels.
    node_direction
        ``(h, w, 3)`` unit view directions of the nodes, ENU.
    used
        ``(h w,)`` bool: nodes that the interpolation needs.
    corner, weight
        ``(4, K)`` int32 nodes around each pixel and their bilinear weights.
    direction
        ``(K, 3)`` float32 unit view directions of the pixels, ENU.
    """

    pixel: np.ndarray
    node_direction: np.ndarray
    used: np.ndarray
    corner: np.ndarray
    weight: np.ndarray
    direction: np.ndarray


def sky_grid(camera: Camera | Panorama, pixel: np.ndarray) -> SkyGrid:
    """Build the grid of sky radiance for the sky pixels of a view.

    Parameters
    ----------
    camera
        The view.
    pixel
        ``(K,)`` flat indices of the pixels that are not fully covered by terrain.

    Returns
    -------
    SkyGrid
        Grid nodes and bilinear weights, for `sky_pixel_radiance`.
    """
    step = _step_px(camera, _SKY_STEP_DEG, _SKY_STEP_PX)
    node_direction = _node_directions(camera, step)
    width = node_direction.shape[1]
    row, column = np.divmod(pixel, camera.width_px)
    across, down = column / step, row / step
    left, top = across.astype(np.int32), down.astype(np.int32)
    fx, fy = (across - left).astype(np.float32), (down - top).astype(np.float32)
    first = top * width + left
    corner = np.stack([first, first + 1, first + width, first + width + 1])
    weight = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy])
    used = np.zeros(node_direction.shape[0] * width, bool)
    used[corner] = True
    direction = view_directions(camera, np.stack([column + 0.5, row + 0.5], axis=-1))
    return SkyGrid(pixel, node_direction, used, corner, weight, direction.astype(np.float32))


def sky_pixel_radiance(grid: SkyGrid, illumination: Illumination, pixel_angle_deg: float) -> np.ndarray:
    """Radiance of the sky pixels of a view, with the discs of sun and moon.

    Parameters
    ----------
    grid
        From `sky_grid`.
    illumination
        Sky, sun, moon and aerial perspective.
    pixel_angle_deg
        Angular size of a pixel [deg], over which the edges of the discs are spread; see
        `mitsuba_scene.sky_radiance_towards`.

    Returns
    -------
    numpy.ndarray
        ``(K, 3)`` float32 [cd/m²].
    """
    without_discs = replace(illumination, sun=None, moon=None)
    at_nodes = np.zeros((len(grid.used), 3), np.float32)
    at_nodes[grid.used] = sky_radiance_towards(
        without_discs, grid.node_direction.reshape(-1, 3)[grid.used], pixel_angle_deg
    )
    sky = np.zeros((len(grid.direction), 3), np.float32)
    for corner, weight in zip(grid.corner, grid.weight, strict=True):
        sky += scaled_pixels(at_nodes.take(corner, axis=0), weight)
    in_aureole = np.zeros(len(sky), bool)
    for body in (illumination.sun, illumination.moon):
        if body is not None:
            in_aureole |= grid.direction @ np.asarray(body.direction, np.float32) > np.cos(np.radians(_AUREOLE_DEG))
    if in_aureole.any():
        sky[in_aureole] = sky_radiance_towards(
            illumination, grid.direction[in_aureole].astype(np.float64), pixel_angle_deg
        )
    return sky
