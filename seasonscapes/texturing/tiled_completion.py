"""Completion of a large texture tile by tile: one regression for all, without the predictors of all texels in memory.

The regression is fitted to a sample of painted texels of the whole texture, as `regression_fill` does. Each tile is then
filled with a border of `HALO_PX` texels around it. Residuals of painted texels that lie farther away are left out:
they have decayed to exp(−96 / 12), or 0.03 %.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from seasonscapes.errors import NotEnoughEvidence
from seasonscapes.terrain.surface import Texture
from seasonscapes.texturing.completion_error import spatial_folds
from seasonscapes.texturing.regression_fill import (
    FAST_SAMPLES,
    SAMPLES,
    FittedCompletion,
    completion_of,
    fit_completion,
    rim_of,
    without_images,
)
from seasonscapes.texturing.smooth_fill import push_pull
from seasonscapes.texturing.tiled_predictors import TiledPredictors, Window

Progress = Callable[[float], None]
TILE_PX, HALO_PX = 2048, 96
# Windows begin at multiples of this many texels, so that the cells of a pyramid over them are those over the whole texture
# as far as residuals reach; as many levels as the border is wide.
_PHASE_PX = 32


@dataclass(frozen=True)
class _Scale:
    """Of a texture: the unit of encoded colours, and the brightest one of a painted texel."""

    unit: float
    brightest: float


def complete_tiles(
    texture: Texture,
    painted: np.ndarray,
    predictors: TiledPredictors,
    *,
    fast: bool = False,
    seed: int = 0,
    tile_px: int = TILE_PX,
    progress: Progress | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Fill every unpainted texel of a texture by regression, tile by tile.

    Parameters
    ----------
    texture
        Radiance or albedo.
    painted
        ``(R, S)`` bool, from `completion.painted_texels`.
    predictors
        Of the texture's size.
    fast, seed, progress
        As in `regression_fill.regression_fill`.
    tile_px
        Side of a tile [texels].

    Returns
    -------
    values
        ``(R, S, 3)`` float32, finite everywhere; painted texels equal the given ones bit for bit.
    sigma
        ``(R, S)`` float32 standard error of the filled texels in the unit of ``values``; 0 where painted, and like
        ``values`` in windows without any texel of the surface.

    Raises
    ------
    NotEnoughEvidence
        No texel on the surface is painted.
    ValueError
        A negative painted value.
    """
    report = progress or (lambda fraction: None)
    known = painted & predictors.surface
    if not known.any():
        raise NotEnoughEvidence("complete: no painted texel on the surface: there is nothing to learn from")
    brightest = _brightest(texture, painted, known, tile_px)
    if np.array_equal(known, predictors.surface):
        scale, fitted = _Scale(1.0, 1.0), None  # no hole: only what lies off the surface is extended
    else:
        scale, fitted = _fitted(
            texture, painted, predictors, known, brightest, fast=fast, seed=seed, tile_px=tile_px, progress=report
        )
    values, sigma = np.empty_like(texture.values, np.float32), np.zeros(painted.shape, np.float32)
    tiles = list(_windows(painted.shape, tile_px))
    for done, tile in enumerate(tiles):
        values[tile], sigma[tile] = _filled(texture, painted, predictors, tile, scale, fitted)
        report(0.3 + 0.7 * (done + 1) / len(tiles))
    return values, sigma


def _fitted(
    texture: Texture,
    painted: np.ndarray,
    predictors: TiledPredictors,
    known: np.ndarray,
    brightest: float,
    *,
    fast: bool,
    seed: int,
    tile_px: int,
    progress: Progress,
) -> tuple[_Scale, FittedCompletion]:
    rng = np.random.default_rng(seed)
    count = FAST_SAMPLES if fast else SAMPLES
    texel = _drawn(known, count, rng)
    predictor, colour = _rows_of(predictors, texel, tile_px), texture.values.reshape(-1, 3)[texel]
    unit = max(float(np.median(colour)), 1e-6 * brightest, 1e-12)
    progress(0.1)
    image = np.array([name.startswith("satellite") for name in predictors.names])
    if image.any():
        hidden = _rows_of(predictors, _drawn(predictors.surface & ~painted, count, rng), tile_px)
        missing = np.asarray(~np.isfinite(hidden[:, image]).all(axis=1))
        predictor = without_images(predictor, image, float(missing.mean()) if len(missing) else 0.0, rng)
    row, column = np.divmod(texel, painted.shape[1])
    fold = spatial_folds(np.stack([column, row], -1), painted, predictors.surface & ~painted, seed)
    encoded = np.cbrt(colour / np.float32(unit)).astype(np.float64)
    fitted = fit_completion(
        predictor,
        encoded,
        predictors.names,
        fold,
        fast=fast,
        seed=seed,
        progress=lambda done: progress(0.1 + 0.2 * done),
    )
    return _Scale(unit, float(np.cbrt(brightest / unit))), fitted


def _brightest(texture: Texture, painted: np.ndarray, known: np.ndarray, tile_px: int) -> float:
    """The greatest value of a known texel; refuses negative painted ones."""
    brightest = 0.0
    for tile in _windows(painted.shape, tile_px):
        masks = [np.ascontiguousarray(mask[tile]).view(np.uint8) for mask in (painted, known)]
        for plane in cv2.split(np.ascontiguousarray(texture.values[tile], np.float32)):
            # Both are 0 where a mask is empty.
            if cv2.minMaxLoc(plane, masks[0])[0] < 0.0:
                raise ValueError("complete: negative values among the painted texels")
            brightest = max(brightest, cv2.minMaxLoc(plane, masks[1])[1])
    return brightest


def _drawn(mask: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Flat indices ``(n,)`` of some elements of a mask, in order; without a list of all of them."""
    ends = np.cumsum(np.count_nonzero(mask, axis=1))
    total = int(ends[-1])
    drawn = np.sort(rng.choice(total, min(count, total), replace=False))
    row = np.searchsorted(ends, drawn, side="right")
    column = np.empty_like(row)
    for number in np.unique(row):
        here = row == number
        places = np.flatnonzero(mask[number])
        column[here] = places[drawn[here] - (ends[number] - len(places))]
    return row * mask.shape[1] + column


def _rows_of(predictors: TiledPredictors, texel: np.ndarray, tile_px: int) -> np.ndarray:
    """Predictors ``(n, G)`` of flat texels."""
    row, column = np.divmod(texel, predictors.surface.shape[1])
    rows = np.empty((len(texel), len(predictors.names)), np.float32)
    for tile in _windows(predictors.surface.shape, tile_px):
        here = (row >= tile[0].start) & (row < tile[0].stop) & (column >= tile[1].start) & (column < tile[1].stop)
        if here.any():
            rows[here] = predictors.at(row[here], column[here])
    return rows


def _filled(
    texture: Texture,
    painted: np.ndarray,
    predictors: TiledPredictors,
    tile: Window,
    scale: _Scale,
    fitted: FittedCompletion | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Values and σ of a tile."""
    height, width = painted.shape
    outer = (
        slice(_aligned_start(tile[0].start), min(height, tile[0].stop + HALO_PX)),
        slice(_aligned_start(tile[1].start), min(width, tile[1].stop + HALO_PX)),
    )
    core = tuple(slice(t.start - o.start, t.stop - o.start) for t, o in zip(tile, outer, strict=True))
    surface, known = predictors.surface[outer], painted[outer]
    values, sigma = np.array(texture.values[outer], np.float32), np.zeros(known.shape, np.float32)
    values[~known] = 0.0
    inside = np.zeros(known.shape, bool)
    inside[core] = True
    off_surface = ~surface & ~known
    if (off_surface & inside).any():
        # What lies between charts is filled from the surface about it, which has to be complete first.
        inside[:] = True
    every_hole = surface & ~known
    hole = every_hole & inside
    if fitted is not None and hole.any():
        window = predictors.window(outer)
        rim = rim_of(every_hole, known & surface, window)
        encoded = np.zeros_like(values)
        encoded[rim] = np.cbrt(values[rim] / np.float32(scale.unit))
        filled, error = completion_of(fitted, encoded, hole, rim, window)
        # Cubing amplifies small errors of bright texels; no filled texel may be brighter than all known ones.
        root = np.clip(filled[hole], 0.0, np.float32(scale.brightest))
        values[hole] = np.float32(scale.unit) * root * root * root
        sigma[hole] = np.float32(scale.unit) * error[hole]
    if (off_surface & inside).any():
        extended = push_pull(np.concatenate([values, sigma[..., None]], -1), (~off_surface).astype(np.float32))
        values[off_surface], sigma[off_surface] = extended[off_surface][:, :3], extended[off_surface][:, 3]
    return values[core], sigma[core]


def _aligned_start(start: int) -> int:
    return max(0, start - HALO_PX) // _PHASE_PX * _PHASE_PX


def _windows(shape: tuple[int, int], tile_px: int) -> Iterator[Window]:
    for row in range(0, shape[0], tile_px):
        for column in range(0, shape[1], tile_px):
            yield slice(row, min(row + tile_px, shape[0])), slice(column, min(column + tile_px, shape[1]))
