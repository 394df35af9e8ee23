"""Light on the texels of a terrain's texture, in the parts that delighting needs."""

from __future__ import annotations

from typing import cast

import numpy as np
from scipy.ndimage import label

from seasonscapes.albedo.delighting import TexelIrradiance
from seasonscapes.albedo.forward_model import TexelTransport, ambient_on_texels
from seasonscapes.rendering.sun_visibility import visible_cosine
from seasonscapes.sky.illumination import Illumination, global_horizontal_illuminance

# Shadow rays per texel, to different points of the sun's disc.
_RAYS = 4


def texel_irradiance(
    transport: TexelTransport, light: Illumination, chart: np.ndarray | None = None
) -> TexelIrradiance:
    """Compute the light on the texels of a terrain's texture, split into its parts.

    Parameters
    ----------
    transport
        Daylight coefficients of the texels.
    light
        Sun and sky; the moon is left out.
    chart
        ``(R, S)`` integers of the texture's charts, −1 for none; by default each connected part of the texture is one.

    Returns
    -------
    TexelIrradiance
        Zero, and chart −1, for texels off the surface.
    """
    rows, columns = transport.shape
    sun = np.zeros((rows * columns, 3), np.float32)
    visibility = np.zeros(rows * columns, np.float32)
    if light.sun is not None:
        cosine = np.maximum(transport.normal @ np.asarray(light.sun.direction, np.float32), 0.0)
        seen = visible_cosine(transport.device_points.rays, light.sun, rays_per_sample=_RAYS)[:, 0]
        sun[transport.texel] = cosine[:, None] * np.asarray(light.sun.normal_illuminance_lx, np.float32)
        visibility[transport.texel] = np.clip(seen / np.maximum(cosine, 1e-6), 0.0, 1.0)
    sky = ambient_on_texels(transport, light, None)

    def bounce(albedo: np.ndarray) -> np.ndarray:
        return np.maximum(ambient_on_texels(transport, light, albedo) - sky, 0.0).reshape(rows, columns, 3)

    if chart is None:
        covered = np.zeros(rows * columns, bool)
        covered[transport.texel] = True
        numbered, _ = cast(tuple[np.ndarray, int], label(covered.reshape(rows, columns)))
        chart = numbered.astype(np.int32) - 1
    surface = np.full(rows * columns, -1, np.int32)
    surface[transport.texel] = chart.ravel()[transport.texel]
    return TexelIrradiance(
        sun.reshape(rows, columns, 3),
        visibility.reshape(rows, columns),
        sky.reshape(rows, columns, 3),
        bounce,
        np.asarray(global_horizontal_illuminance(light)),
        surface.reshape(rows, columns),
    )
