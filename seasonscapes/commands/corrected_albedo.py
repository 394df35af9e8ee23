"""An albedo from photographs and an image from above, each as far as it is known."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from seasonscapes.albedo.closed_form import AlbedoFit
    from seasonscapes.albedo.standard_error import KnownAlbedo
    from seasonscapes.texturing.predictors import Predictors


def corrected_albedo(
    fit: AlbedoFit,
    base: np.ndarray | None,
    predictors: Predictors,
    *,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Albedo ``(R, S, 3)`` of every texel of the surface, and its standard deviation ``(R, S)``.

    Parameters
    ----------
    base
        ``(R, S, 3)`` albedo from elsewhere, of any scale, NaN where unknown; ``None`` where there is none: gaps are then
        learned from relief alone and seen texels stay as they are.
    predictors
        Relief; no hour's sun, for an albedo knows none, and not the base itself.
    """
    import numpy as np

    from seasonscapes.albedo.closed_form import HIGHEST, LOWEST
    from seasonscapes.albedo.standard_error import finite_sigma
    from seasonscapes.terrain.surface import Texture
    from seasonscapes.texturing.completion import complete

    sigma = finite_sigma(fit)
    # Relative precision: what is compared are cube roots, in which equal relative errors are equal enough.
    weight = np.square(fit.albedo[..., 1] / np.maximum(sigma, 1e-4)).astype(np.float32)
    made = complete(Texture(fit.albedo, weight), predictors, base=base, fast=True, seed=seed, progress=progress)
    values = np.clip(made.values, LOWEST, HIGHEST)
    if base is None:
        return values, np.where(weight > 0.0, sigma, made.sigma).astype(np.float32)
    both = 1.0 / np.sqrt(1.0 / np.square(np.maximum(made.sigma, 1e-6)) + 1.0 / np.square(sigma))
    return values, both.astype(np.float32)


def complete_known(
    known: KnownAlbedo,
    fit: AlbedoFit,
    base: np.ndarray | None,
    predictors: Predictors,
    *,
    progress: Callable[[float], None] | None = None,
) -> KnownAlbedo:
    """The same with every texel of the surface known; what is not measured is marked as completed."""
    import numpy as np

    albedo, sigma = corrected_albedo(fit, base, predictors, progress=progress)
    source = np.where(predictors.surface & (known.source != 1), np.uint8(2), known.source)
    return replace(known, albedo=albedo, sigma=np.where(predictors.surface, sigma, np.float32(np.inf)), source=source)
