"""Standard error of each texel's albedo.

The variance of a texel comes from the diagonal of the closed form's information matrix (the pixels that contain the
texel and the light upon it), scaled by the residuals of the photographs, plus a common relative term for gains, haze
and sky. Texels that are completed later (`albedo_completion`) are marked as such, never as measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from seasonscapes.albedo.closed_form import AlbedoFit
from seasonscapes.albedo.forward_model import TexelTransport
from seasonscapes.albedo.photographs import AlbedoPhotograph
from seasonscapes.errors import NotEnoughEvidence

# Relative uncertainty of every texel caused by gains, haze and sky.
_COMMON = 0.01
# A texel counts as measured if its standard deviation is below this fraction of its albedo (plus 0.02) and it covers at
# least this many pixels.
_POOR, _FEWEST_PIXELS = 0.35, 0.5
# At the border of what is seen, a texel that covers less than this share of the pixels of a neighbour is seen in part.
_SEEN_IN_PART = 0.4


@dataclass(frozen=True)
class AlbedoEstimate:
    """An albedo texture with its uncertainty.

    Parameters
    ----------
    albedo
        ``(R, S, 3)`` float32.
    sigma
        ``(R, S)`` float32 standard deviation (green); that of the completion for completed texels, infinite where
        nothing is known.
    sunlit
        ``(R, S)`` uint8 number of photographs in which the texel is visible in direct sunlight.
    source
        ``(R, S)`` uint8, a key of `SOURCES`.
    """

    albedo: np.ndarray
    sigma: np.ndarray
    sunlit: np.ndarray
    source: np.ndarray


SOURCES = {0: "nothing known", 1: "measured", 2: "completed"}


def texel_sigma(fit: AlbedoFit) -> np.ndarray:
    """Standard deviation of each texel's albedo.

    Parameters
    ----------
    fit
        Result of `closed_form.solve_albedo`.

    Returns
    -------
    numpy.ndarray
        ``(R, S)`` float32 (green); infinite where nothing was observed.
    """
    with np.errstate(divide="ignore"):
        random = 1.0 / np.sqrt(fit.information.astype(float))
    # Neighbouring texels share pixels, so the diagonal underestimates the variance of texels smaller than a pixel.
    shared = 1.0 + 1.0 / np.maximum(fit.pixel_count, 1e-3)
    scale = max(1.0, float(np.nanmedian(fit.residual)) / 0.0135)
    sigma = np.hypot(scale * random * shared, _COMMON * fit.albedo[..., 1])
    return np.where((fit.pixel_count > 0.0) & (fit.information > 0.0), sigma, np.inf).astype(np.float32)


def observed_sigma(fit: AlbedoFit) -> np.ndarray:
    """Standard deviation of all observed texels, poorly determined ones included, for use in weights.

    Parameters
    ----------
    fit
        Result of `closed_form.solve_albedo`.

    Returns
    -------
    numpy.ndarray
        ``(R, S)`` float32 (green); infinite for texels that cover less than half a pixel, and for those that the border of a
        picture or a ridge cuts: the little that pixels show of them takes up what their other texels leave unexplained, and comes
        out in any colour.
    """
    count = fit.pixel_count.astype(np.float32)
    around = np.ones((3, 3), np.uint8)
    at_border = cv2.erode(count, around) < _FEWEST_PIXELS
    cut = at_border & (count < _SEEN_IN_PART * cv2.dilate(count, around))
    return np.where((count >= _FEWEST_PIXELS) & ~cut, texel_sigma(fit), np.inf).astype(np.float32)


def times_sunlit(photographs: Sequence[AlbedoPhotograph]) -> np.ndarray:
    """Count the photographs in which each texel is visible in direct sunlight.

    Parameters
    ----------
    photographs
        At least one photograph, all of one texture shape.

    Returns
    -------
    numpy.ndarray
        ``(R, S)`` uint8, at most 255.
    """
    shape = photographs[0].footprints.shape
    count = np.zeros(shape[0] * shape[1], np.int32)
    for photograph in photographs:
        footprints = photograph.footprints
        if not footprints.sunlit[photograph.number]:
            continue
        pixels = np.bincount(footprints.texel, footprints.share, len(count))
        sunlit = np.bincount(footprints.texel, footprints.sunlit[photograph.number][0], len(count))
        count += (sunlit > 0.05 * pixels) & (pixels > 0.0)
    return np.minimum(count, 255).astype(np.uint8).reshape(shape)


def albedo_estimate(
    transport: TexelTransport, photographs: Sequence[AlbedoPhotograph], fit: AlbedoFit
) -> AlbedoEstimate:
    """Combine the albedo of a fit with its uncertainty.

    Parameters
    ----------
    transport
        Daylight coefficients of the texels.
    photographs
        The photographs of the fit.
    fit
        Result of `closed_form.solve_albedo`.

    Returns
    -------
    AlbedoEstimate
        Texels that are not measured hold the median albedo with infinite standard deviation.

    Raises
    ------
    NotEnoughEvidence
        If no texel is measured.
    """
    sigma = observed_sigma(fit)
    measured = np.zeros(transport.shape[0] * transport.shape[1], bool)
    measured[transport.texel] = True
    measured = measured.reshape(transport.shape) & (sigma < _POOR * fit.albedo[..., 1] + 0.02)
    if not measured.any():
        raise NotEnoughEvidence("albedo_estimate: no texel is measured: too few pixels or too large a standard error")
    albedo = np.where(measured[..., None], fit.albedo, np.median(fit.albedo[measured], axis=0)).astype(np.float32)
    sigma = np.where(measured, sigma, np.inf).astype(np.float32)
    return AlbedoEstimate(albedo, sigma, times_sunlit(photographs), measured.astype(np.uint8))
