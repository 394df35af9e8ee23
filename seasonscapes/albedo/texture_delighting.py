"""Albedo from lit textures: orthophotos, satellite scenes and other images that are already in texture space.

Each texel is its own footprint, so the closed form reduces to a robust mean: albedo = π Σ w E L / Σ w E².
Interreflection is iterated as for photographs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from seasonscapes.albedo.closed_form import HIGHEST, LOWEST
from seasonscapes.albedo.forward_model import TexelTransport, ambient_on_texels, sun_on_texels
from seasonscapes.sky.illumination import Illumination


def delight_textures(
    transport: TexelTransport,
    radiance: Sequence[np.ndarray],
    lights: Sequence[Illumination],
    *,
    rounds: int = 4,
    model: float = 0.05,
) -> tuple[np.ndarray, np.ndarray]:
    """Estimate the albedo of lit textures by dividing out their illuminance.

    Parameters
    ----------
    transport
        Daylight coefficients of the texels.
    radiance
        ``(R, S, 3)`` [cd/m²] each, NaN where a texture has no value.
    lights
        Illumination of each texture.
    rounds
        Iterations of interreflection and robust weights.
    model
        Relative error of the modelled light; residuals beyond a few multiples of it are down-weighted.

    Returns
    -------
    tuple of numpy.ndarray
        Albedo ``(R, S, 3)`` and the mean illuminance behind it ``(R, S, 3)`` [lx]; NaN where unknown.

    Raises
    ------
    ValueError
        If there is no texture, not one light for each, or a texture whose size differs from the transport's.
    """
    if not radiance or len(radiance) != len(lights):
        raise ValueError(
            f"delight_textures: got {len(radiance)} textures and {len(lights)} lights, expected one light per texture"
        )
    if any(texture.shape[:2] != transport.shape for texture in radiance):
        raise ValueError(f"delight_textures: textures must have the transport's shape {transport.shape}")
    values = np.stack([texture.reshape(-1, 3) for texture in radiance]).astype(np.float32)
    known = np.isfinite(values)
    values = np.where(known, values, 0.0)
    direct = np.stack([sun_on_texels(transport, light) for light in lights])
    albedo = np.full((transport.shape[0] * transport.shape[1], 3), 0.25, np.float32)
    for number in range(rounds):
        reflecting = np.nan_to_num(albedo, nan=0.25).reshape(*transport.shape, 3)
        illuminance = direct + np.stack([ambient_on_texels(transport, light, reflecting) for light in lights])
        weight = known / np.maximum((model * illuminance) ** 2, 1e-12)
        if number and len(values) > 2:
            residual = np.pi * values / np.maximum(illuminance, 1e-6) / np.maximum(albedo, LOWEST) - 1.0
            weight = weight / (1.0 + (residual / (2.385 * model)) ** 2)
        denominator = (weight * illuminance * illuminance).sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            numerator = (weight * illuminance * values).sum(axis=0)
            albedo = np.where(denominator > 0.0, np.pi * numerator / denominator, np.nan)
        albedo = np.clip(albedo, LOWEST, HIGHEST)
    mean = np.where(known, illuminance, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return albedo.reshape(*transport.shape, 3).astype(np.float32), mean.reshape(*transport.shape, 3)
