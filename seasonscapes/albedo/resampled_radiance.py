"""Radiance textures resampled from photographs, before any delighting; input of the topographic corrections."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime

import numpy as np

from seasonscapes.albedo.footprints import whole_pixels
from seasonscapes.albedo.forward_model import aerial_perspective_of
from seasonscapes.albedo.photographs import AlbedoPhotograph


def resampled_radiance(photographs: Sequence[AlbedoPhotograph], gains: np.ndarray) -> dict[datetime, np.ndarray]:
    """Resample photographs onto the texture, one radiance texture per time.

    Gains and aerial perspective are removed, so that the texture is the product of illuminance and albedo. Each texel
    is the mean of the pixels that contain it, weighted by its share in them.

    Parameters
    ----------
    photographs
        K photographs.
    gains
        ``(K, 3)`` pixel value over radiance.

    Returns
    -------
    dict
        ``{time: (R·S, 3)}`` radiance at the surface [cd/m²], NaN where no photograph of that time contains the texel.
    """
    sums: dict = {}
    for photograph, gain in zip(photographs, gains, strict=True):
        footprints, image = (
            photograph.footprints,
            photograph.observation.image.reshape(-1, 3)[photograph.footprints.pixel],
        )
        usable = photograph.observation.mask.ravel()[footprints.pixel] & whole_pixels(footprints)
        transmittance, airlight = aerial_perspective_of(photograph.atmosphere, photograph.light, len(footprints.pixel))
        radiance = (image / np.asarray(gain) - airlight) / np.maximum(transmittance, 0.05)
        matrix = footprints.matrix(footprints.share)
        numerator, denominator = sums.setdefault(photograph.observation.time, [0.0, 0.0])
        numerator = numerator + matrix.T @ np.where(usable[:, None], radiance, 0.0)
        denominator = denominator + matrix.T @ usable.astype(float)
        sums[photograph.observation.time] = [numerator, denominator]
    with np.errstate(invalid="ignore", divide="ignore"):
        return {
            time: np.where(denominator[:, None] > 0.0, numerator / denominator[:, None], np.nan)
            for time, (numerator, denominator) in sums.items()
        }
