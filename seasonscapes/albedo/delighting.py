"""Light out of pictures that lie on the texture already: orthophotos, satellite scenes, a user's lit texture.

Here the footprint of a texel is itself, so the closed form is a robust mean: albedo = π Σ w E L / Σ w E². Interreflection
is iterated as it is for photographs.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from seasonscapes.albedo.closed_form import HIGHEST, LOWEST
from seasonscapes.albedo.forward_model import TexelTransport, ambient_on_texels, sun_on_texels
from seasonscapes.sky.illumination import Illumination


def delight_textures(
    land: TexelTransport,
    radiance: Sequence[np.ndarray],
    lights: Sequence[Illumination],
    *,
    rounds: int = 4,
    model: float = 0.05,
) -> tuple[np.ndarray, np.ndarray]:
    """Albedo ``(R, S, 3)`` of lit textures, and the mean illuminance it rests on ``(R, S, 3)`` [lx]; NaN where unknown.

    Parameters
    ----------
    radiance
        ``(R, S, 3)`` [cd/m²] each, NaN where a texture knows nothing.
    lights
        Of each texture.
    model
        Relative error of modelled light; residuals beyond a few of these count little.

    Raises
    ------
    ValueError
        No texture, not one light for each, or textures of another size than the land's.
    """
    if not radiance or len(radiance) != len(lights):
        raise ValueError(f"texture_albedo: got {len(radiance)} textures and {len(lights)} lights, one of each expected")
    if any(one.shape[:2] != land.shape for one in radiance):
        raise ValueError(f"texture_albedo: textures must be {land.shape} like the land's")
    values = np.stack([one.reshape(-1, 3) for one in radiance]).astype(np.float32)
    known = np.isfinite(values)
    values = np.where(known, values, 0.0)
    suns = np.stack([sun_on_texels(land, light) for light in lights])
    albedo = np.full((land.shape[0] * land.shape[1], 3), 0.25, np.float32)
    for number in range(rounds):
        reflecting = np.nan_to_num(albedo, nan=0.25).reshape(*land.shape, 3)
        light = suns + np.stack([ambient_on_texels(land, one, reflecting) for one in lights])
        weight = known / np.maximum((model * light) ** 2, 1e-12)
        if number and len(values) > 2:
            apart = np.pi * values / np.maximum(light, 1e-6) / np.maximum(albedo, LOWEST) - 1.0
            weight = weight / (1.0 + (apart / (2.385 * model)) ** 2)
        bottom = (weight * light * light).sum(axis=0)
        with np.errstate(invalid="ignore", divide="ignore"):
            albedo = np.where(bottom > 0.0, np.pi * (weight * light * values).sum(axis=0) / bottom, np.nan)
        albedo = np.clip(albedo, LOWEST, HIGHEST)
    mean = np.where(known, light, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return albedo.reshape(*land.shape, 3).astype(np.float32), mean.reshape(*land.shape, 3)
