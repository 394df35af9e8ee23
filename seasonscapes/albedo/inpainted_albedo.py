"""Completed textures as evidence about the albedo of texels that no photograph measured.

A painting is completed from what its hour shows elsewhere: relief, the sun of the hour, an image. Its light taken out, that is
another estimate of the albedo there, whose errors differ from those of the albedo's own completion; but in shade, where light
is little and modelled worse, it is far off. It therefore moves the albedo by a small share, and by less the more they differ.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from seasonscapes.albedo.closed_form import HIGHEST, LOWEST
from seasonscapes.albedo.forward_model import TexelTransport
from seasonscapes.albedo.texture_delighting import delight_textures
from seasonscapes.sky.illumination import Illumination

# Share of the completed textures where both estimates agree, and the difference of logarithms at which it is half of that.
SHARE, DIFFERENCE = 0.2, 0.6


def corrected_by_inpainting(
    transport: TexelTransport,
    albedo: np.ndarray,
    unmeasured: np.ndarray,
    completed: Sequence[np.ndarray],
    lights: Sequence[Illumination],
    *,
    share: float = SHARE,
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
        Radiance ``(R, S, 3)`` [cd/m²] of one or more hours, completed without the albedo's help.
    lights
        Illumination of each.
    share
        Weight of the completed textures where both agree, in [0, 1].

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
    >>> place = ss.load_place("alpine_small", ss.MeshOptions(texel_m=120.0))
    >>> transport = trace_texel_transport(place.terrain, place.texture_shape)
    >>> light = ss.illumination(place, "2024-07-20T13:30", sky="hosek")
    >>> albedo = np.full((*place.texture_shape, 3), 0.2, np.float32)
    >>> nowhere = np.zeros(place.texture_shape, bool)
    >>> bool((corrected_by_inpainting(transport, albedo, nowhere, [albedo * 1e4], [light]) == albedo).all())
    True
    """
    found, _ = delight_textures(transport, completed, lights)
    change = np.log(np.where(np.isfinite(found), found, albedo) / np.maximum(albedo, LOWEST))
    furthest = np.abs(change).max(axis=2, keepdims=True)
    weight = np.where(unmeasured[..., None], share / (1.0 + (furthest / DIFFERENCE) ** 2), 0.0)
    moved = np.clip(albedo * np.exp(weight * change), LOWEST, HIGHEST)
    return np.where(weight > 0.0, moved, albedo).astype(np.float32)
