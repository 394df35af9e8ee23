"""An albedo from photographs and an image from above, each as far as it is known."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from seasonscapes.texturing.guides import Guides


def corrected_albedo(albedo: np.ndarray, sigma: np.ndarray, base: np.ndarray | None, guides: Guides, *, fast: bool = False,
                     seed: int = 0, progress: Callable[[float], None] | None = None) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Albedo ``(R, S, 3)`` of every texel of the surface, and its standard deviation ``(R, S)``.

    Parameters
    ----------
    albedo, sigma
        What photographs say, ``(R, S, 3)`` and ``(R, S)``; σ is infinite where they say nothing.
    base
        ``(R, S, 3)`` albedo from elsewhere, of any scale; ``None`` where there is no image: gaps are then learned from
        relief alone and measured texels stay as they are.
    guides
        Relief; no hour's sun, for an albedo knows none, and not the base itself.
    """
    import numpy as np

    from seasonscapes.albedo.closed_form import HIGHEST, LOWEST
    from seasonscapes.terrain.surface import Texture
    from seasonscapes.texturing.complete import complete

    # Relative precision: what is compared are albedos' cube roots, in which equal relative errors are equal enough.
    weight = np.square(albedo[..., 1] / np.maximum(sigma, 1e-4)).astype(np.float32)
    made = complete(Texture(albedo, weight), guides, base=base, fast=fast, seed=seed, progress=progress)
    values = np.clip(made.values, LOWEST, HIGHEST)
    if base is None:
        return values, np.where(weight > 0.0, sigma, made.sigma).astype(np.float32)
    with np.errstate(divide="ignore"):
        both = 1.0 / np.sqrt(1.0 / np.square(np.maximum(made.sigma, 1e-6)) + 1.0 / np.square(sigma))
    return values, both.astype(np.float32)
