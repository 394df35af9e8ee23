"""Photographs laid onto the texture as they are: what a painted texture holds before its light is taken out."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from seasonscapes.albedo.footprints import whole_pixels
from seasonscapes.albedo.forward_model import aerial_perspective_of
from seasonscapes.albedo.photographs import AlbedoPhotograph


def painted_radiance(photographs: Sequence[AlbedoPhotograph], gains: np.ndarray) -> dict:
    """Radiance textures by time: ``{time: (R·S, 3)}`` [cd/m²], NaN where no photograph of that time looks.

    Gains ``(K, 3)`` and the air are taken out of the photographs (so that what is left is the light on the land and its
    albedo); each texel is the mean of the pixels that show it, by their share in it.
    """
    sums: dict = {}
    for photograph, gain in zip(photographs, gains, strict=True):
        footprints, image = (
            photograph.footprints,
            photograph.observation.image.reshape(-1, 3)[photograph.footprints.pixel],
        )
        usable = photograph.observation.mask.ravel()[footprints.pixel] & whole_pixels(footprints)
        transmittance, airlight = aerial_perspective_of(photograph.seen, photograph.light, len(footprints.pixel))
        radiance = (image / np.asarray(gain) - airlight) / np.maximum(transmittance, 0.05)
        matrix = footprints.matrix(footprints.share)
        top, bottom = sums.setdefault(photograph.observation.time, [0.0, 0.0])
        top = top + matrix.T @ np.where(usable[:, None], radiance, 0.0)
        bottom = bottom + matrix.T @ usable.astype(float)
        sums[photograph.observation.time] = [top, bottom]
    with np.errstate(invalid="ignore", divide="ignore"):
        return {
            time: np.where(bottom[:, None] > 0.0, top / bottom[:, None], np.nan) for time, (top, bottom) in sums.items()
        }
