"""Rasterisation of Gaussian splats on the Dr.Jit device: tiles, one lane per pixel, blended front to back.

The image equals that of `gaussians.rasterise`, without gradients. Tiles after Kerbl et al. 2023, doi:10.1145/3592433.
The loop of a pixel ends when its remaining transmittance is negligible.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.backend import aligned, point3, use_backend

# Side of a tile [px]; the lanes of a tile run together.
TILE = 4
# Low and high 16 bits of a float32.
_HALVES = (0, 1) if sys.byteorder == "little" else (1, 0)
# Transmittance at which blending ends.
_LEAST_TRANSMITTANCE = 1e-4


class SplatLimits(NamedTuple):
    """Limits of rasterisation.

    Parameters
    ----------
    min_alpha
        Least opacity that is drawn.
    max_alpha
        Largest opacity of a splat in a pixel.
    pixel_variance
        Variance of the pixel filter [px²].
    near_m
        Least distance along the optical axis [m].
    one_sided
        Omit splats whose third axis points away from the camera.
    """

    min_alpha: float
    max_alpha: float
    pixel_variance: float
    near_m: float
    one_sided: bool = False


@dataclass(frozen=True)
class DeviceSplats:
    """N Gaussian splats on the Dr.Jit device.

    Parameters
    ----------
    mi_centre
        ``mi.Point3f`` centres, ENU [m].
    mi_axes
        Three ``mi.Vector3f``: axes of the ellipsoids (rotation × scale) [m].
    mi_opacity
        ``mi.Float`` opacities.
    count
        Number N of splats.
    """

    mi_centre: Any
    mi_axes: list[Any]
    mi_opacity: Any
    count: int


def finer_camera(camera: Camera, times: int) -> Camera:
    """Return the same view with a multiple of its pixels.

    Parameters
    ----------
    camera
        The view.
    times
        Factor of the number of pixels along each side.

    Returns
    -------
    Camera
        The view with scaled size, focal lengths and principal point.
    """
    scaled = {name: times * getattr(camera, name) for name in ("width_px", "height_px", "fx", "fy", "cx", "cy")}
    return replace(camera, **scaled)


def upload_splats(means: np.ndarray, axes: np.ndarray, opacity: np.ndarray) -> DeviceSplats:
    """Copy splats to the device.

    Parameters
    ----------
    means
        ``(N, 3)`` centres, ENU [m].
    axes
        ``(N, 3, 3)`` axes of the ellipsoids, one per column [m].
    opacity
        ``(N,)`` opacities.

    Returns
    -------
    DeviceSplats
        The device copy.

    Raises
    ------
    ValueError
        On the scalar variant.
    """
    if use_backend().device == "scalar":
        raise ValueError("splatting needs a vectorised variant; install a libLLVM or use CUDA")
    import drjit as dr
    import mitsuba as mi

    columns = [mi.Vector3f(point3(axes[:, :, k])) for k in range(3)]
    splats = DeviceSplats(mi.Point3f(point3(means)), columns, mi.Float(aligned(opacity)), len(means))
    dr.eval(splats.mi_centre, splats.mi_axes, splats.mi_opacity)
    return splats


def splat_layers(
    splats: DeviceSplats, layers: np.ndarray, camera: Camera, limits: SplatLimits
) -> tuple[np.ndarray, np.ndarray]:
    """Rasterise splats: blend their values front to back over black.

    Parameters
    ----------
    splats
        N splats.
    layers
        ``(N, C)`` values of the splats, such as colours and distance.
    camera
        The view.
    limits
        Limits of rasterisation.

    Returns
    -------
    image
        ``(H, W, C)`` float32 blended values.
    coverage
        ``(H, W)`` float32 opacity of each pixel.
    """
    import drjit as dr
    import mitsuba as mi

    projected = _project(splats, camera, limits)
    index, start = _tile_lists(projected, camera)
    if len(index) == 0:
        shape = (camera.height_px, camera.width_px)
        return np.zeros((*shape, layers.shape[1]), np.float32), np.zeros(shape, np.float32)
    across, down = -(-camera.width_px // TILE), -(-camera.height_px // TILE)
    lane = dr.arange(mi.UInt32, across * down * TILE * TILE)
    tile, inner = lane // (TILE * TILE), lane % (TILE * TILE)
    tile_columns = dr.opaque(mi.UInt32, across)
    column, row = (tile % tile_columns) * TILE + inner % TILE, (tile // tile_columns) * TILE + inner // TILE
    x, y = mi.Float(column) + 0.5, mi.Float(row) + 0.5
    mi_start = mi.UInt32(aligned(start, np.uint32))
    channels = [mi.Float(aligned(channel)) for channel in layers.T]
    order = mi.UInt32(aligned(index, np.uint32))
    most, least = dr.opaque(mi.Float, limits.max_alpha), dr.opaque(mi.Float, limits.min_alpha)

    parameters = (
        projected.mi_x,
        projected.mi_y,
        projected.mi_conic_xx,
        projected.mi_conic_xy,
        projected.mi_conic_yy,
        projected.mi_opacity,
    )

    def unfinished(number: Any, transmittance: Any, *sums: Any) -> Any:
        return (number < end) & (transmittance > _LEAST_TRANSMITTANCE)

    def blend(number: Any, transmittance: Any, *sums: Any) -> tuple[Any, ...]:
        splat = dr.gather(mi.UInt32, order, number)
        cx, cy, xx, xy, yy, opacity = (dr.gather(mi.Float, values, splat) for values in parameters)
        dx, dy = x - cx, y - cy
        alpha = dr.minimum(opacity * dr.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy), most)
        alpha = dr.select(alpha >= least, alpha, 0.0)
        weight = transmittance * alpha
        blended = (
            dr.fma(weight, dr.gather(mi.Float, channel, splat), partial_sum)
            for channel, partial_sum in zip(channels, sums, strict=True)
        )
        return (number + 1, transmittance * (1.0 - alpha), *blended)

    begin, end = dr.gather(mi.UInt32, mi_start, tile), dr.gather(mi.UInt32, mi_start, tile + 1)
    black = tuple(dr.zeros(mi.Float, len(start[:-1]) * TILE * TILE) for _ in channels)
    state = (begin, dr.full(mi.Float, 1.0, dr.width(lane)), *black)
    _, transmittance, *sums = dr.while_loop(state, unfinished, blend, label="splats")
    dr.eval(transmittance, sums)

    def to_image(values: Any) -> np.ndarray:
        tiles = np.array(values).reshape(down, across, TILE, TILE).swapaxes(1, 2)
        return tiles.reshape(down * TILE, across * TILE)[: camera.height_px, : camera.width_px]

    return np.stack([to_image(values) for values in sums], axis=-1), 1.0 - to_image(transmittance)


@dataclass(frozen=True)
class _ProjectedSplats:
    """Splats in the image as ``mi.Float`` lanes: centre [px], conic [px⁻²], opacity, depth [m] and half extent [px].

    The half extent is negative for splats that are not drawn.
    """

    mi_x: Any
    mi_y: Any
    mi_conic_xx: Any
    mi_conic_xy: Any
    mi_conic_yy: Any
    mi_opacity: Any
    mi_depth: Any
    mi_extent_x: Any
    mi_extent_y: Any


def _project(splats: DeviceSplats, camera: Camera, limits: SplatLimits) -> _ProjectedSplats:
    import drjit as dr
    import mitsuba as mi

    def number(value: float) -> Any:
        return dr.opaque(mi.Float, float(value))

    camera_axes = [mi.Vector3f(*map(number, camera.world_from_camera[:3, axis])) for axis in range(3)]
    local = splats.mi_centre - mi.Point3f(*map(number, camera.position_m))
    x, y, z = (dr.dot(local, axis) for axis in camera_axes)
    fx, fy = number(camera.fx), number(camera.fy)
    # As in 3DGS, the derivative of the projection is evaluated at most 30 % outside of the image.
    slope_limits = number(0.65 * camera.width_px / camera.fx), number(0.65 * camera.height_px / camera.fy)
    u, v = (dr.clip(side / z, -limit, limit) for side, limit in zip((x, y), slope_limits, strict=True))
    xx, xy, yy = number(limits.pixel_variance), mi.Float(0.0), number(limits.pixel_variance)
    for axis in splats.mi_axes:
        a, b, c = (dr.dot(axis, camera_axis) for camera_axis in camera_axes)
        across, down = fx / z * (a - u * c), fy / z * (b - v * c)
        xx, xy, yy = dr.fma(across, across, xx), dr.fma(across, down, xy), dr.fma(down, down, yy)
    determinant = xx * yy - xy * xy
    visible = (z > number(limits.near_m)) & (splats.mi_opacity >= number(limits.min_alpha))
    if limits.one_sided:
        visible &= dr.dot(local, splats.mi_axes[2]) < 0.0
    # Distance from the centre, in standard deviations, at which the opacity falls to the least one.
    extent = dr.sqrt(dr.maximum(2.0 * dr.log(splats.mi_opacity / number(max(limits.min_alpha, 1e-30))), 0.0))
    columns = (
        fx * x / z + number(camera.cx),
        fy * y / z + number(camera.cy),
        yy / determinant,
        -xy / determinant,
        xx / determinant,
        splats.mi_opacity,
        z,
        dr.select(visible, extent * dr.sqrt(xx), -1.0),
        dr.select(visible, extent * dr.sqrt(yy), -1.0),
    )
    dr.eval(columns)
    return _ProjectedSplats(*columns)


def _ascending(values: np.ndarray) -> np.ndarray:
    """Stable order of positive float32 numbers; by halves of their bits, for which NumPy has a radix sort."""
    low, high = (np.ascontiguousarray(values.view(np.uint16)[half::2]) for half in _HALVES)
    order = np.argsort(low, kind="stable")
    return order[np.argsort(high[order], kind="stable")]


def _tile_lists(projected: _ProjectedSplats, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Splats of all tiles, nearest first ``(K,)``, and the start of each tile's list ``(tiles + 1,)``, both uint32."""
    from scipy import sparse

    cx, cy, depth, extent_x, extent_y = (
        np.array(values)
        for values in (projected.mi_x, projected.mi_y, projected.mi_depth, projected.mi_extent_x, projected.mi_extent_y)
    )
    across, down = -(-camera.width_px // TILE), -(-camera.height_px // TILE)
    inside = np.flatnonzero(
        (extent_x >= 0.0)
        & (cx + extent_x > 0.0)
        & (cx - extent_x < camera.width_px)
        & (cy + extent_y > 0.0)
        & (cy - extent_y < camera.height_px)
    )
    inside = inside[_ascending(depth[inside])]

    def tiles(centre: np.ndarray, extent: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        # Pixel centres lie half a pixel inside: a box that only touches the edge of a tile contains none of them.
        first = np.floor((centre[inside] - extent[inside] - 0.5) / TILE)
        last = np.floor((centre[inside] + extent[inside] - 0.5) / TILE)
        first = np.clip(first, 0, count - 1).astype(np.int32)
        return first, np.clip(last, 0, count - 1).astype(np.int32) - first + 1

    left, width = tiles(cx, extent_x, across)
    top, height = tiles(cy, extent_y, down)
    count = width * height
    splat = np.repeat(np.arange(len(inside), dtype=np.int32), count)
    number = np.arange(len(splat), dtype=np.int32) - np.repeat((np.cumsum(count) - count).astype(np.int32), count)
    row = number // width[splat]
    tile = (top[splat] + row) * np.int32(across) + left[splat] + number - row * width[splat]
    table = sparse.coo_array(
        (inside[splat].astype(np.int64) + 1, (tile, np.zeros(len(tile), np.int32))), shape=(across * down, 1)
    )
    table.has_canonical_format = True  # otherwise the entries of a tile would be summed
    table = table.tocsr()
    return (table.data - 1).astype(np.uint32), table.indptr.astype(np.uint32)
