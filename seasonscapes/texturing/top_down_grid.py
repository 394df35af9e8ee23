"""The ground plan under a texture: where texels of several charts lie side by side as they do on the land."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from seasonscapes.terrain.atlas import planar_uv
from seasonscapes.terrain.surface import Terrain
from seasonscapes.terrain.texels import texel_positions


@dataclass(frozen=True)
class TopDownGrid:
    """A top-down grid over the land, row 0 in the north, and the places of a texture's texels on it.

    Parameters
    ----------
    width_px, height_px
        Cells of the grid.
    pixel
        Column and row ``(R, S, 2)`` float32 of each texel (0.5 is the first cell's centre); NaN off the surface.
    """

    width_px: int
    height_px: int
    pixel: np.ndarray


def grid_heights(terrain: Terrain, spacing_m: float) -> tuple[np.ndarray, float]:
    """Heights ``(H, W)`` [m] of a terrain on a top-down grid of about this spacing, NaN beside it, and the spacing."""
    extent = np.ptp(terrain.vertices[:, :2].astype(np.float64), axis=0)
    width, height = (max(2, int(np.ceil(side / spacing_m - 1e-6))) for side in extent)
    flat = Terrain(terrain.vertices, terrain.faces, planar_uv(terrain.vertices), terrain.frame)
    positions, _ = texel_positions(flat, width, height)
    return positions[..., 2], float(extent[0] / width)


def top_down_grid(terrain: Terrain, positions: np.ndarray, width_px: int, height_px: int) -> TopDownGrid:
    """The plan of texels at ``positions`` ``(R, S, 3)`` ENU [m] on a grid over the terrain's bounding box."""
    low = terrain.vertices[:, :2].min(0).astype(np.float64)
    extent = np.ptp(terrain.vertices[:, :2].astype(np.float64), axis=0)
    column = (positions[..., 0] - low[0]) / extent[0] * width_px
    row = (1.0 - (positions[..., 1] - low[1]) / extent[1]) * height_px
    return TopDownGrid(width_px, height_px, np.stack([column, row], -1).astype(np.float32))


def to_grid(plan: TopDownGrid, values: np.ndarray, mask: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean ``(H, W, C)`` of the masked texels of each cell, and how many there are ``(H, W)``."""
    use = mask & np.isfinite(plan.pixel).all(axis=2)
    pixel = plan.pixel[use]
    column = np.clip(pixel[:, 0].astype(int), 0, plan.width_px - 1)
    row = np.clip(pixel[:, 1].astype(int), 0, plan.height_px - 1)
    cell = row * plan.width_px + column
    size = plan.width_px * plan.height_px
    count = np.bincount(cell, minlength=size)
    sums = [np.bincount(cell, weights=column, minlength=size) for column in values[use].T]
    mean = np.stack(sums, -1) / np.maximum(count, 1)[:, None]
    shape = (plan.height_px, plan.width_px)
    return mean.reshape(*shape, -1).astype(np.float32), count.reshape(shape)


def from_grid(plan: TopDownGrid, values: np.ndarray) -> np.ndarray:
    """Bilinear look-up ``(R, S, C)`` of a picture on the plan ``(H, W, C)``; NaN off the surface."""
    x, y = plan.pixel[..., 0] - 0.5, plan.pixel[..., 1] - 0.5
    known = np.isfinite(x) & np.isfinite(y)
    flat_x, flat_y = np.where(known, x, 0.0).astype(np.float32), np.where(known, y, 0.0).astype(np.float32)
    picture = np.ascontiguousarray(values, np.float32)
    taken = cv2.remap(picture, flat_x, flat_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    taken = taken.reshape(*known.shape, -1)
    taken[~known] = np.nan
    return taken
