"""Relief below the resolution of an elevation raster, invented so that it looks like the relief above it.

Heights are doubled in resolution step by step. Each step interpolates, and adds detail of the wavelengths that the finer
grid can hold and the coarser one cannot. How strong it is follows, place by place, from the detail of the two octaves above
it: their strength, and by how much it falls from one to the next. On slopes it runs down the fall line, as gullies and ribs
do, and is ridged; plains stay smooth.

The means over the cells of the raster stay exactly its values, at every step. So amplified heights agree with the raster,
and those of each step with all finer ones. Detail depends on the seed and on the map coordinates alone: parts of a raster
are amplified as the whole is, but for their rims, whose surroundings are unknown.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
from affine import Affine

from seasonscapes.terrain.lattice_noise import oriented_noise
from seasonscapes.terrain.placement import cell_sides_m
from seasonscapes.terrain.surface import Raster

# Cells over which the strength of detail is averaged.
_REACH = 3.0
# By what factor the amplitude of detail falls from one octave to the next, at least and at most.
_FALL = (0.22, 0.85)
# The finest octave of a raster holds traces of coarser ones; fitted to the spectra of three Alpine rasters of 5 and 10 m.
_STRENGTH = 0.85
# From these slopes on detail follows the fall line, and is ridged.
_ALIGNED = (0.10, 0.35)
# Rounds after which means are kept to a thousandth of the detail; the rest is added cell by cell.
_ROUNDS = 4
# Cells around a part that are kept at each step, for interpolation.
_MARGIN = 16
_ORIENTATIONS = 8
# Rows of a strip of noise, and how many strips are made at a time.
_STRIP, _THREADS = 256, 4


def amplified(elevation: Raster, factor: int, *, seed: int = 0) -> Raster:
    """Add relief below the resolution of a raster.

    Parameters
    ----------
    elevation
        Heights ``(H, W, 1)`` [m] without NaN, means over their cells.
    factor
        How many times finer the result is: a power of two.
    seed
        Another seed gives other detail.

    Returns
    -------
    Raster
        ``(H factor, W factor, 1)`` float32, whose means over ``factor × factor`` cells are the heights of ``elevation`` to
        the accuracy of float32.

    Raises
    ------
    ValueError
        If the factor is no power of two.

    Examples
    --------
    >>> import numpy as np
    >>> import seasonscapes as ss
    >>> place = ss.load_place("alpine_small")
    >>> fine = ss.amplified(place.elevation, 4)
    >>> means = fine.values[..., 0].reshape(201, 4, 201, 4).mean(axis=(1, 3), dtype=float)
    >>> bool(np.abs(means - place.elevation.values[..., 0]).max() < 1e-3)
    True
    """
    height, width = elevation.values.shape[:2]
    return amplified_part(elevation, factor, rows=slice(0, height), columns=slice(0, width), seed=seed)


def amplified_part(elevation: Raster, factor: int, *, rows: slice, columns: slice, seed: int = 0) -> Raster:
    """Add relief to a part of a raster: what `amplified` gives there, without computing the rest.

    Parameters
    ----------
    elevation, factor, seed
        As in `amplified`.
    rows, columns
        Cells of ``elevation``, with start and stop.

    Returns
    -------
    Raster
        ``(rows factor, columns factor, 1)`` float32. Within some cells of the rim of the part, at each step, interpolation
        lacks a trace of what lies beyond.

    Raises
    ------
    ValueError
        If the factor is no power of two.
    """
    if factor < 1 or factor & (factor - 1):
        raise ValueError(f"factor: got {factor}, expected a power of two")
    spacing_m = float(np.mean(cell_sides_m(elevation)))
    heights = elevation.values[..., 0].astype(np.float64)
    amplitude, fall = _measured_detail(heights)
    amplitude = amplitude * _not_level(heights)
    # Cells beyond the part that each step keeps, and the part within the present arrays.
    step = 1
    first = [0, 0]
    part = [rows, columns]
    while True:
        low = [max(each.start * step - _MARGIN, start) for each, start in zip(part, first, strict=True)]
        high = [
            min(each.stop * step + _MARGIN, start + count)
            for each, start, count in zip(part, first, heights.shape, strict=True)
        ]
        if step == factor:
            low, high = [each.start * step for each in part], [each.stop * step for each in part]
        kept = tuple(slice(begin - start, end - start) for begin, end, start in zip(low, high, first, strict=True))
        heights, amplitude, fall, first = heights[kept], amplitude[kept], fall[kept], low
        if step == factor:
            break
        step *= 2
        first = [2 * start for start in first]
        transform = elevation.transform * Affine.scale(1.0 / step) * Affine.translation(first[1], first[0])
        heights = _doubled(heights, amplitude * fall, spacing_m / step, transform, seed)
        amplitude, fall = _spread(amplitude * fall), _spread(fall)
    assert heights.shape == tuple((each.stop - each.start) * factor for each in part)
    transform = elevation.transform * Affine.scale(1.0 / factor) * Affine.translation(first[1], first[0])
    return replace(elevation, values=heights[..., None].astype(np.float32), transform=transform)


def _measured_detail(heights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Amplitude [m] of the finest octave of a raster, place by place, and the factor by which it falls to the next."""
    from scipy.ndimage import gaussian_filter

    def band(values: np.ndarray) -> np.ndarray:
        """Root mean square of what the means over 2 × 2 cells lose."""
        return np.sqrt(gaussian_filter((values - _interpolated(_block_means(values))) ** 2, _REACH) + 1e-12)

    even = _even(heights)
    finest, coarse = band(even), _block_means(even)
    coarser = _spread(band(_even(coarse)))[: even.shape[0], : even.shape[1]]
    # The fall is a property of the kind of ground, and noisy: averaged widely, weighted by the detail itself.
    wide = 6.0 * _REACH
    ratio = gaussian_filter(finest, wide) / np.maximum(gaussian_filter(coarser, wide), 1e-9)
    size = heights.shape
    return finest[: size[0], : size[1]], np.clip(ratio, *_FALL)[: size[0], : size[1]]


def _not_level(heights: np.ndarray) -> np.ndarray:
    """0 on lakes, whose cells are equal, 1 from two cells off their shores on."""
    from scipy.ndimage import distance_transform_edt, maximum_filter, minimum_filter

    level = maximum_filter(heights, 3) - minimum_filter(heights, 3) == 0.0
    if not level.any():
        return np.ones_like(heights)
    distance: Any = distance_transform_edt(~level)
    return np.clip((distance - 1.0) / 2.0, 0.0, 1.0)


def _even(values: np.ndarray) -> np.ndarray:
    """Repeat the last row and column where their number is odd."""
    return np.pad(values, ((0, values.shape[0] % 2), (0, values.shape[1] % 2)), mode="edge")


def _block_means(values: np.ndarray) -> np.ndarray:
    return values.reshape(values.shape[0] // 2, 2, values.shape[1] // 2, 2).mean(axis=(1, 3))


def _spread(values: np.ndarray) -> np.ndarray:
    return values.repeat(2, axis=0).repeat(2, axis=1)


def _cubic(values: np.ndarray) -> np.ndarray:
    """Catmull-Rom interpolation ``(2 H, 2 W)`` at the centres of the quarters of all cells."""
    for axis in (0, 1):
        count = values.shape[axis]
        padded = np.pad(values, [(2, 2) if k == axis else (0, 0) for k in (0, 1)], mode="reflect", reflect_type="odd")

        zero, one, two, three, four = (padded[(slice(None),) * axis + (slice(at, at + count),)] for at in range(5))
        # Weights of Catmull-Rom's spline at a quarter before and behind a sample.
        left = -0.0234375 * zero + 0.2265625 * one + 0.8671875 * two - 0.0703125 * three
        right = -0.0703125 * one + 0.8671875 * two + 0.2265625 * three - 0.0234375 * four
        values = np.stack([left, right], axis=axis + 1).reshape(
            [2 * size if k == axis else size for k, size in enumerate(values.shape)]
        )
    return values


def _interpolated(values: np.ndarray) -> np.ndarray:
    """Cubic interpolation whose means over 2 × 2 cells are the values."""
    # What is interpolated again and again is the coarse values' own error, and interpolation is linear: the rounds need the
    # coarse grid alone.
    total = values
    for _ in range(_ROUNDS):
        total = total + (values - _means_of_cubic(total))
    fine = _cubic(total)
    return fine + _spread(values - _block_means(fine))


def _means_of_cubic(values: np.ndarray) -> np.ndarray:
    """Means over 2 × 2 cells of `_cubic`, without it."""
    for axis in (0, 1):
        count = values.shape[axis]
        padded = np.pad(values, [(2, 2) if k == axis else (0, 0) for k in (0, 1)], mode="reflect", reflect_type="odd")
        before, last, own, coming, after = (padded[(slice(None),) * axis + (slice(at, at + count),)] for at in range(5))
        values = -0.01171875 * (before + after) + 0.078125 * (last + coming) + 0.8671875 * own
    return values


def _doubled(heights: np.ndarray, amplitude: np.ndarray, spacing_m: float, transform: Affine, seed: int) -> np.ndarray:
    """Heights at twice the resolution, with one more octave of detail.

    ``amplitude`` [m] at the cells of ``heights``; ``spacing_m`` and ``transform`` of the result.
    """
    from scipy.ndimage import gaussian_filter

    base = _interpolated(heights)
    smooth = gaussian_filter(base, 2.0)
    down, across = np.gradient(smooth, spacing_m)
    slope = np.hypot(across, down)
    aligned = np.clip((slope - _ALIGNED[0]) / (_ALIGNED[1] - _ALIGNED[0]), 0.0, 1.0)
    # Detail is fixed to the grid of the map: its origin is a whole number of cells.
    first_column, first_row = (round(offset) for offset in (transform.c / transform.a, transform.f / transform.e))
    x, y = np.arange(base.shape[1]) + float(first_column), np.arange(base.shape[0])[:, None] + float(first_row)
    angle = np.arctan2(down, across)

    def strip(rows: slice) -> np.ndarray:
        return oriented_noise(
            x, y[rows], angle=angle[rows], aligned=aligned[rows], seed=seed, orientations=_ORIENTATIONS
        )

    with ThreadPoolExecutor(_THREADS) as pool:
        detail = np.concatenate(list(pool.map(strip, (slice(at, at + _STRIP) for at in range(0, len(base), _STRIP)))))
    detail = detail - _interpolated(_block_means(detail))
    fine = base + _STRENGTH * detail * np.maximum(_cubic(amplitude), 0.0)
    return fine + _interpolated(heights - _block_means(fine))
