"""Splats to pixels on the renderer's own device, as fast as it goes: tiles, one lane for each pixel, front to back.

The picture is that of `gaussians.rasterise`, whose gradients it does not have. Tiles after Kerbl et al. 2023,
doi:10.1145/3592433; a pixel's loop ends as soon as nothing more would shine through.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.rendering.backend import point3, use_backend

# Pixels along a tile's side; lanes of one tile run together.
TILE = 4
_CLOSED = 1e-4


class SplatLimits(NamedTuple):
    """Least opacity that is drawn, most that a splat may have, the pixel's own variance [px²] and the near limit [m];
    with ``one_sided``, splats whose third axis points away from the camera are left out."""

    alpha_cut: float
    alpha_most: float
    pixel_variance: float
    near_m: float
    one_sided: bool = False


@dataclass(frozen=True)
class DeviceSplats:
    """N splats on the device: centres, the three axes of each ellipsoid (rotation × scale), and opacity."""

    mi_centre: Any
    mi_axes: list[Any]
    mi_opacity: Any
    count: int


def finer_camera(camera: Camera, times: int) -> Camera:
    """The same view with ``times`` as many pixels along each side."""
    scaled = {name: times * getattr(camera, name) for name in ("width_px", "height_px", "fx", "fy", "cx", "cy")}
    return replace(camera, **scaled)


def upload_splats(means: np.ndarray, axes: np.ndarray, opacity: np.ndarray) -> DeviceSplats:
    """Copy to the device: ``means (N, 3)``, ``axes (N, 3, 3)`` with one axis of the ellipsoid a column, ``opacity (N,)``.

    Raises
    ------
    ValueError
        On the scalar variant, which has no lanes.
    """
    if use_backend().device == "scalar":
        raise ValueError("splatting needs a vectorised variant; install a libLLVM or use CUDA")
    import drjit as dr
    import mitsuba as mi

    columns = [mi.Vector3f(point3(axes[:, :, k])) for k in range(3)]
    ready = DeviceSplats(
        mi.Point3f(point3(means)), columns, mi.Float(np.ascontiguousarray(opacity, np.float32)), len(means)
    )
    dr.eval(ready.mi_centre, ready.mi_axes, ready.mi_opacity)
    return ready


def splat_layers(
    ready: DeviceSplats, layers: np.ndarray, camera: Camera, cuts: SplatLimits
) -> tuple[np.ndarray, np.ndarray]:
    """Blend layers ``(N, C)`` front to back over black: picture ``(H, W, C)`` and coverage ``(H, W)``."""
    import drjit as dr
    import mitsuba as mi

    facts = _project(ready, camera, cuts)
    index, start = _bins(facts, camera)
    if len(index) == 0:
        size = (camera.height_px, camera.width_px)
        return np.zeros((*size, layers.shape[1]), np.float32), np.zeros(size, np.float32)
    across, down = -(-camera.width_px // TILE), -(-camera.height_px // TILE)
    lane = dr.arange(mi.UInt32, across * down * TILE * TILE)
    tile, inner = lane // (TILE * TILE), lane % (TILE * TILE)
    wide = dr.opaque(mi.UInt32, across)
    column, row = (tile % wide) * TILE + inner % TILE, (tile // wide) * TILE + inner // TILE
    x, y = mi.Float(column) + 0.5, mi.Float(row) + 0.5
    mi_start = mi.UInt32(start)
    channels = [mi.Float(np.ascontiguousarray(channel, np.float32)) for channel in layers.T]
    order = mi.UInt32(index)
    most, least = dr.opaque(mi.Float, cuts.alpha_most), dr.opaque(mi.Float, cuts.alpha_cut)

    def unfinished(number: Any, through: Any, *sums: Any) -> Any:
        return (number < end) & (through > _CLOSED)

    def blend(number: Any, through: Any, *sums: Any) -> tuple:
        splat = dr.gather(mi.UInt32, order, number)
        cx, cy, xx, xy, yy, opacity = (dr.gather(mi.Float, values, splat) for values in facts[:6])
        dx, dy = x - cx, y - cy
        alpha = dr.minimum(opacity * dr.exp(-0.5 * (xx * dx * dx + yy * dy * dy) - xy * dx * dy), most)
        alpha = dr.select(alpha >= least, alpha, 0.0)
        weight = through * alpha
        added = (
            dr.fma(weight, dr.gather(mi.Float, channel, splat), held)
            for channel, held in zip(channels, sums, strict=True)
        )
        return (number + 1, through * (1.0 - alpha), *added)

    begin, end = dr.gather(mi.UInt32, mi_start, tile), dr.gather(mi.UInt32, mi_start, tile + 1)
    nothing = tuple(dr.zeros(mi.Float, len(start[:-1]) * TILE * TILE) for _ in channels)
    state = (begin, dr.full(mi.Float, 1.0, dr.width(lane)), *nothing)
    _, through, *sums = dr.while_loop(state, unfinished, blend, label="splats")
    dr.eval(through, sums)

    def picture(values: Any) -> np.ndarray:
        tiles = np.array(values).reshape(down, across, TILE, TILE).swapaxes(1, 2)
        return tiles.reshape(down * TILE, across * TILE)[: camera.height_px, : camera.width_px]

    return np.stack([picture(values) for values in sums], axis=-1), 1.0 - picture(through)


def _project(ready: DeviceSplats, camera: Camera, cuts: SplatLimits) -> tuple:
    """Centre (x, y), conic (xx, xy, yy), opacity, depth and reaches (x, y) in the picture of all splats, as lanes."""
    import drjit as dr
    import mitsuba as mi

    def number(value: float) -> Any:
        return dr.opaque(mi.Float, float(value))

    turn = [mi.Vector3f(*map(number, camera.world_from_camera[:3, axis])) for axis in range(3)]
    local = ready.mi_centre - mi.Point3f(*map(number, camera.position_m))
    x, y, z = (dr.dot(local, axis) for axis in turn)
    fx, fy = number(camera.fx), number(camera.fy)
    # As 3DGS does, the slope of the projection is taken no further out than a third past the picture's rim.
    limits = number(0.65 * camera.width_px / camera.fx), number(0.65 * camera.height_px / camera.fy)
    u, v = (dr.clip(side / z, -limit, limit) for side, limit in zip((x, y), limits, strict=True))
    xx, xy, yy = number(cuts.pixel_variance), mi.Float(0.0), number(cuts.pixel_variance)
    for axis in ready.mi_axes:
        a, b, c = (dr.dot(axis, side) for side in turn)
        across, down = fx / z * (a - u * c), fy / z * (b - v * c)
        xx, xy, yy = dr.fma(across, across, xx), dr.fma(across, down, xy), dr.fma(down, down, yy)
    determinant = xx * yy - xy * xy
    seen = (z > number(cuts.near_m)) & (ready.mi_opacity >= number(cuts.alpha_cut))
    if cuts.one_sided:
        seen &= dr.dot(local, ready.mi_axes[2]) < 0.0
    reach = dr.sqrt(dr.maximum(2.0 * dr.log(ready.mi_opacity / number(max(cuts.alpha_cut, 1e-30))), 0.0))
    facts = (
        fx * x / z + number(camera.cx),
        fy * y / z + number(camera.cy),
        yy / determinant,
        -xy / determinant,
        xx / determinant,
        ready.mi_opacity,
        z,
        dr.select(seen, reach * dr.sqrt(xx), -1.0),
        dr.select(seen, reach * dr.sqrt(yy), -1.0),
    )
    dr.eval(facts)
    return facts


def _bins(facts: tuple, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Splats of each tile, nearest first ``(K,)`` uint32, and where each tile's begin ``(tiles + 1,)`` uint32."""
    from scipy import sparse

    cx, cy, depth, reach_x, reach_y = (np.array(facts[k]) for k in (0, 1, 6, 7, 8))
    across, down = -(-camera.width_px // TILE), -(-camera.height_px // TILE)
    inside = np.flatnonzero(
        (reach_x >= 0.0)
        & (cx + reach_x > 0.0)
        & (cx - reach_x < camera.width_px)
        & (cy + reach_y > 0.0)
        & (cy - reach_y < camera.height_px)
    )
    inside = inside[np.argsort(depth[inside], kind="stable")]

    def tiles(centre: np.ndarray, reach: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
        # Pixel centres lie half a pixel in: a box that only touches a tile's rim has none of them.
        first = np.floor((centre[inside] - reach[inside] - 0.5) / TILE)
        last = np.floor((centre[inside] + reach[inside] - 0.5) / TILE)
        first = np.clip(first, 0, count - 1).astype(np.int32)
        return first, np.clip(last, 0, count - 1).astype(np.int32) - first + 1

    left, wide = tiles(cx, reach_x, across)
    top, high = tiles(cy, reach_y, down)
    each = wide * high
    splat = np.repeat(np.arange(len(inside), dtype=np.int32), each)
    number = np.arange(len(splat), dtype=np.int32) - np.repeat((np.cumsum(each) - each).astype(np.int32), each)
    row = number // wide[splat]
    tile = (top[splat] + row) * np.int32(across) + left[splat] + number - row * wide[splat]
    table = sparse.coo_array(
        (inside[splat].astype(np.int64) + 1, (tile, np.zeros(len(tile), np.int32))), shape=(across * down, 1)
    )
    table.has_canonical_format = True  # else splats of one tile would be added up
    table = table.tocsr()
    return (table.data - 1).astype(np.uint32), table.indptr.astype(np.uint32)
