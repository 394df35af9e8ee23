"""A finer raster through the same heights: coarse samples become a smooth surface instead of large facets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from affine import Affine

from seasonscapes.terrain.surface import Raster


def refine_raster(raster: Raster, factor: int) -> Raster:
    """Interpolate ``factor`` - 1 samples between each two, monotone cubic along rows and columns (PCHIP).

    Every given sample is kept, and no interval overshoots its ends: a lake stays flat beneath its cliffs, where a
    spline would ring. Fritsch & Butland 1984, doi:10.1137/0905021.

    Parameters
    ----------
    raster
        ``(H, W, C)`` without NaN.
    factor
        1 leaves the raster as it is.

    Returns
    -------
    Raster
        ``((H - 1) factor + 1, (W - 1) factor + 1, C)`` float32. Its pixels are ``factor`` times smaller and centred on
        the samples, so its outer edge lies within the old one.
    """
    from scipy.interpolate import PchipInterpolator

    if factor < 1:
        raise ValueError(f"factor: got {factor}, expected at least 1")
    if factor == 1:
        return raster
    values = raster.values
    for axis in (0, 1):
        count = values.shape[axis]
        fine = np.arange((count - 1) * factor + 1) / factor
        values = PchipInterpolator(np.arange(count), values, axis=axis)(fine).astype(np.float32)
    # The first sample's centre stays at (0.5, 0.5) of the old grid.
    transform = (
        raster.transform * Affine.translation(0.5, 0.5) * Affine.scale(1.0 / factor) * Affine.translation(-0.5, -0.5)
    )
    return replace(raster, values=values, transform=transform)


def refinement_factor(
    samples: int, spacing_m: float, *, most_samples: int = 4_000_000, least_spacing_m: float = 10.0
) -> int:
    """1, 2 or 4: the largest that keeps the raster within a number of samples and above a spacing worth having [m]."""
    return max(k for k in (1, 2, 4) if k == 1 or (samples * k * k <= most_samples and spacing_m / k >= least_spacing_m))
