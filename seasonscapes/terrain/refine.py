"""Upsampling of rasters by monotone cubic interpolation, to avoid visible facets in meshes of coarse rasters."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from affine import Affine

from seasonscapes.terrain.interpolation import monotone_cubic
from seasonscapes.terrain.surface import Raster


def refine_raster(raster: Raster, factor: int) -> Raster:
    """Upsample a raster by monotone piecewise cubic interpolation along rows and columns (PCHIP).

    Samples are interpolated exactly and without overshoot, so that, unlike with a spline, a lake next to a cliff stays
    flat. Fritsch & Butland 1984, doi:10.1137/0905021.

    Parameters
    ----------
    raster
        ``values`` ``(H, W, C)`` without NaN.
    factor
        Number of intervals per original interval; 1 returns the raster unchanged.

    Returns
    -------
    Raster
        ``((H - 1) factor + 1, (W - 1) factor + 1, C)`` float32. Its pixels are ``factor`` times smaller and centred on
        the samples, so its outer edge lies within the original one.

    Raises
    ------
    ValueError
        ``factor`` is less than 1.
    """
    if factor < 1:
        raise ValueError(f"factor: got {factor}, expected at least 1")
    if factor == 1:
        return raster
    values = raster.values
    for _ in range(2):
        # Along the rows of the transposed raster; twice transposed it is the raster again.
        count = len(values)
        fine = np.arange((count - 1) * factor + 1) / factor
        values = monotone_cubic(np.arange(count), values, fine).astype(np.float32).swapaxes(0, 1)
    # The first sample's centre stays at (0.5, 0.5) of the original grid.
    transform = (
        raster.transform * Affine.translation(0.5, 0.5) * Affine.scale(1.0 / factor) * Affine.translation(-0.5, -0.5)
    )
    return replace(raster, values=np.ascontiguousarray(values), transform=transform)


def refinement_factor(
    samples: int, spacing_m: float, *, most_samples: int = 4_000_000, least_spacing_m: float = 10.0
) -> int:
    """Choose the largest upsampling factor of 1, 2 or 4 within limits on sample count and spacing.

    Parameters
    ----------
    samples
        Number of samples of the original raster.
    spacing_m
        Spacing of the original raster [m].
    most_samples
        Largest number of samples of the upsampled raster.
    least_spacing_m
        Smallest useful spacing [m].

    Returns
    -------
    int
        Factor for `refine_raster`; 1 if no larger one satisfies the limits.
    """
    return max(k for k in (1, 2, 4) if k == 1 or (samples * k * k <= most_samples and spacing_m / k >= least_spacing_m))
