"""Completed textures as evidence about the albedo of texels that no photograph measured.

With the light of their hour taken out, completed textures tell an albedo of every texel. Those that were fused with a relit
albedo hold that albedo and, about the painted texels, what paintings show beyond it: they may replace it. Those that were
completed by other means are another estimate; in shade, where light is little and modelled worse, it is far off, and it
moves the albedo by a small share, and by less the more they differ.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from seasonscapes.albedo.closed_form import HIGHEST, LOWEST
from seasonscapes.albedo.forward_model import TexelTransport
from seasonscapes.albedo.texture_delighting import delight_textures
from seasonscapes.sky.illumination import Illumination

# Share of completed textures that were fused with the albedo, and of those that were completed without it.
FUSED, ALONE = 1.0, 0.1
# Difference of logarithms at which the share is half.
DIFFERENCE = 0.6


def corrected_by_inpainting(
    transport: TexelTransport,
    albedo: np.ndarray,
    unmeasured: np.ndarray,
    completed: Sequence[np.ndarray],
    lights: Sequence[Illumination],
    *,
    share: float,
) -> np.ndarray:
    """Move the albedo of texels that no photograph measured towards that of completed textures.

    Parameters
    ----------
    transport
        Daylight coefficients of the texels.
    albedo
        ``(R, S, 3)``, completed.
    unmeasured
        ``(R, S)`` bool: texels that may change.
    completed
        Radiance ``(R, S, 3)`` [cd/m²] of one or more hours.
    lights
        Illumination of each.
    share
        Weight of the completed textures where both agree, in [0, 1]: `FUSED` or `ALONE`.

    Returns
    -------
    numpy.ndarray
        ``(R, S, 3)`` float32.

    Raises
    ------
    ValueError
        See `delight_textures`.

    Notes
    -----
    ln a + w (ln b − ln a), w = share / (1 + (d / 0.6)²), d the greatest of the channels' differences |ln b − ln a|: one step
    of a robust (Cauchy) mean of both.

    Examples
    --------
    >>> import seasonscapes as ss
    >>> from seasonscapes.albedo.forward_model import trace_texel_transport
    >>> place = ss.load_place("alpine_small", options=ss.MeshOptions(texel_m=120.0))
    >>> transport = trace_texel_transport(place.terrain, place.texture_shape)
    >>> light = ss.illumination(place, "2024-07-20T13:30", sky="hosek")
    >>> albedo = np.full((*place.texture_shape, 3), 0.2, np.float32)
    >>> nowhere = np.zeros(place.texture_shape, bool)
    >>> bool((corrected_by_inpainting(transport, albedo, nowhere, [albedo * 1e4], [light], share=1.0) == albedo).all())
    True
    """
    found, _ = delight_textures(transport, completed, lights)
    change = np.log(np.where(np.isfinite(found), found, albedo) / np.maximum(albedo, LOWEST))
    furthest = np.abs(change).max(axis=2, keepdims=True)
    weight = np.where(unmeasured[..., None], share / (1.0 + (furthest / DIFFERENCE) ** 2), 0.0)
    moved = np.clip(albedo * np.exp(weight * change), LOWEST, HIGHEST)
    return np.where(weight > 0.0, moved, albedo).astype(np.float32)
