"""Finer heights of a part of an elevation raster, blended into the coarser ones along their border and around holes.

Two surveys of one ground differ by a few metres, and where the fine one ends a wall of that height would stand. Within some
coarse cells of the border, and of holes in the fine data, the heights go over into those of the coarse raster (its cubic
interpolation), so that heights and slopes are continuous. Elsewhere they are the fine raster's own, unchanged.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.errors import InputError
from seasonscapes.terrain.crs import apply_affine, grid_position
from seasonscapes.terrain.mosaic import RasterGrid, mosaic
from seasonscapes.terrain.placement import cell_sides_m
from seasonscapes.terrain.raster import require_overlap
from seasonscapes.terrain.surface import Raster
from seasonscapes.terrain.tile_files import Bounds, in_turn_of

log = logging.getLogger(__name__)

# Within so many coarse cells of the border heights are the coarse raster's; over so many more they become the fine one's.
RIM_CELLS, _BLEND_CELLS = 2.0, 4.0
# Medians of the difference [m] from which on it is doubted, and refused: another vertical datum, unit, or place.
_DOUBTED_M, _REFUSED_M = 5.0, 25.0
# Differences between the quartiles [m] that are doubted: the two do not show the same ground.
_DOUBTED_SPREAD_M = 30.0


@dataclass(frozen=True)
class HeightOffset:
    """How finer heights lie above the coarser ones, where they count alone.

    Parameters
    ----------
    median_m
        Median of the difference [m].
    spread_m
        Difference between its quartiles [m].
    """

    median_m: float
    spread_m: float

    @property
    def text(self) -> str:
        """For messages."""
        return f"{self.median_m:+.1f} m in the median, {self.spread_m:.1f} m between the quartiles"


def nested_heights(
    fine: Raster, under: Sequence[Raster], *, bounds_deg: Bounds | None = None, where: str
) -> tuple[Raster, HeightOffset]:
    """Blend finer heights into coarser ones along their border.

    Parameters
    ----------
    fine
        Heights ``(H, W, 1)`` [m] in any CRS, NaN where there is no data.
    under
        The rasters that it is a part of, the finest first, the last one without holes.
    bounds_deg
        West, south, east and north of what was read of a larger raster [deg]: sides on which ``fine`` reaches them are no
        border. ``None``: all of its sides are.
    where
        What messages call the fine raster.

    Returns
    -------
    heights
        On the grid of ``fine``, without NaN: its own values inside, those of ``under`` along the border and in holes.
    offset
        The difference between the two.

    Raises
    ------
    InputError
        Where the two do not overlap; where so little data is there that all of it is border; where they differ by more
        than 25 m in the median.
    """
    require_overlap(fine, under[-1], where=where)
    blend = _Blend(fine, under, bounds_deg)
    if not (blend.share == 1.0).any():
        raise InputError(
            where,
            "too small for a finer part, or nearly without data",
            got=f"{blend.known.sum()} known cells of {cell_sides_m(fine)[0]:.3g} m, none farther than "
            f"{blend.inside_m:.0f} m from the border",
            expected=f"more than {(RIM_CELLS + _BLEND_CELLS) * blend.cell_m:.0f} m, {RIM_CELLS + _BLEND_CELLS:g} cells of "
            "the raster below",
        )
    alone = blend.share == 1.0
    offset = _offset(fine.values[..., 0][alone] - blend.coarse[alone])
    _require_near(offset, where)
    return blend.heights(fine), offset


def nested_window(fine: Raster, under: Sequence[Raster], *, bounds_deg: Bounds) -> Raster:
    """Blend a window of finer heights that `nested_heights` has accepted as a whole: it may hold no data at all.

    Parameters
    ----------
    fine, under, bounds_deg
        As in `nested_heights`.

    Returns
    -------
    Raster
        As `nested_heights` returns it.
    """
    return _Blend(fine, under, bounds_deg).heights(fine)


class _Blend:
    """Shares of a fine raster, and the heights of the rasters below on its grid."""

    def __init__(self, fine: Raster, under: Sequence[Raster], bounds_deg: Bounds | None) -> None:
        from scipy.ndimage import distance_transform_edt

        grid = RasterGrid(fine)
        self.coarse = mosaic([in_turn_of(each, grid.centre_deg[1]) for each in under], grid)[..., 0]
        self.known = np.isfinite(fine.values[..., 0]) & np.isfinite(self.coarse)
        self.cell_m = _spacing_m(_covering(under, fine))
        border = [(1, 1), (1, 1)] if bounds_deg is None else _closed_sides(fine, bounds_deg)
        padded = np.pad(self.known, border)
        if padded.all():
            distance_m = np.full(padded.shape, np.inf, np.float32)
        else:
            distance_m = np.asarray(distance_transform_edt(padded, sampling=cell_sides_m(fine)[::-1]), np.float32)
        self.inside_m = float(distance_m.max())
        kept = tuple(slice(before, before + count) for (before, _), count in zip(border, self.known.shape, strict=True))
        self.share = np.clip((distance_m[kept] / np.float32(self.cell_m) - RIM_CELLS) / _BLEND_CELLS, 0.0, 1.0)

    def heights(self, fine: Raster) -> Raster:
        """The blended raster."""
        share = self.share * self.share * (3.0 - 2.0 * self.share)
        coarse = _without_gaps(self.coarse)
        own = np.where(self.known, fine.values[..., 0], 0.0)
        blended = np.where(share > 0.0, coarse + share * (own - coarse), coarse)
        return replace(fine, values=blended[..., None].astype(np.float32))


def _offset(difference: np.ndarray) -> HeightOffset:
    low, median, high = np.percentile(difference, [25.0, 50.0, 75.0])
    return HeightOffset(float(median), float(high - low))


def tell_offset(offset: HeightOffset, where: str) -> None:
    """Log how finer heights lie above the coarser ones, as a doubt where they may not be of the same ground and datum."""
    cure = f"if the vertical datum differs, state offset_m = {-offset.median_m:.1f}; else check unit and CRS"
    if abs(offset.median_m) > _DOUBTED_M or offset.spread_m > _DOUBTED_SPREAD_M:
        log.warning("%s: against the raster that it is a part of: %s; %s", where, offset.text, cure)
    else:
        log.info("%s: against the raster that it is a part of: %s", where, offset.text)


def _require_near(offset: HeightOffset, where: str) -> None:
    if abs(offset.median_m) > _REFUSED_M:
        raise InputError(
            where,
            "lies far from the heights of the raster that it is a part of",
            got=offset.text,
            expected=f"within {_REFUSED_M:g} m",
            cure=f"if the vertical datum differs, state offset_m = {-offset.median_m:.1f}; else check unit and CRS",
        )


def reach_of_border_m(fine: Raster, under: Sequence[Raster]) -> float:
    """How far into a fine raster its border is felt [m]."""
    return (RIM_CELLS + _BLEND_CELLS) * _spacing_m(_covering(under, fine))


def rim_m(fine: Raster, under: Sequence[Raster]) -> float:
    """How far from the border of a fine raster its heights do not count yet [m]."""
    return RIM_CELLS * _spacing_m(_covering(under, fine))


def _spacing_m(raster: Raster) -> float:
    return float(np.mean(cell_sides_m(raster)))


def _covering(under: Sequence[Raster], fine: Raster) -> Raster:
    """The finest raster below that reaches the middle of the fine one."""
    latitude, longitude = RasterGrid(fine).centre_deg
    for each in under[:-1]:
        height, width = each.values.shape[:2]
        x, y = grid_position(each.crs, each.transform, (width, height), latitude, longitude)
        column, row = (float(value) for value in apply_affine(~each.transform, x, y))
        if 0.0 <= column <= width and 0.0 <= row <= height:
            return each
    return under[-1]


def _closed_sides(fine: Raster, bounds_deg: Bounds) -> list[tuple[int, int]]:
    """One cell of border on the sides of a raster that end before the bounds that were read; rows, then columns."""
    west, south, east, north = bounds_deg
    height, width = fine.values.shape[:2]
    edge = np.linspace(0.0, 1.0, 9)
    around = [
        (south + (north - south) * edge, np.full(9, west)),
        (south + (north - south) * edge, np.full(9, east)),
        (np.full(9, south), west + (east - west) * edge),
        (np.full(9, north), west + (east - west) * edge),
    ]
    latitude, longitude = (np.concatenate(each) for each in zip(*around, strict=True))
    x, y = grid_position(fine.crs, fine.transform, (width, height), latitude, longitude)
    column, row = apply_affine(~fine.transform, x, y)

    # A window ends within two pixels of the bounds, unless the raster ends before.
    def closed(low: float, high: float, count: int) -> tuple[int, int]:
        return int(low < -2.0), int(high > count + 2.0)

    return [closed(row.min(), row.max(), height), closed(column.min(), column.max(), width)]


def _without_gaps(heights: np.ndarray) -> np.ndarray:
    """Cells beyond the coarse raster take its nearest height: no ground is meshed there."""
    from scipy.ndimage import distance_transform_edt

    missing = ~np.isfinite(heights)
    if not missing.any():
        return heights
    row, column = np.asarray(distance_transform_edt(missing, return_distances=False, return_indices=True))
    return heights[row, column]
