"""How well each texel's albedo is known.

A texel's variance comes from the information matrix of the closed form (its diagonal: what the pixels that show it, and the
light upon it, tell), scaled by how well the photographs were explained, plus a share of the albedo for what light cannot
tell. Texels that are completed later (`commands.corrected_albedo`) are marked so, never passed off as measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from seasonscapes.albedo.closed_form import AlbedoFit
from seasonscapes.albedo.forward_model import TexelTransport
from seasonscapes.albedo.photographs import AlbedoPhotograph

# What the gains, the haze and the sky leave unknown of every texel, relative.
_COMMON = 0.01
# A texel is measured where its standard deviation stays below this share of its albedo (plus 0.02), and it was seen by
# so many pixels.
_POOR, _FEWEST_PIXELS = 0.35, 0.5


@dataclass(frozen=True)
class KnownAlbedo:
    """An albedo with how well it is known.

    Parameters
    ----------
    albedo
        ``(R, S, 3)`` float32.
    sigma
        ``(R, S)`` float32 standard deviation (green); of completed texels that of the completion, infinite where nothing is
        known.
    sunlit
        ``(R, S)`` uint8 in how many photographs the texel was seen in direct sunlight.
    source
        ``(R, S)`` uint8, a key of `SOURCES`.
    """

    albedo: np.ndarray
    sigma: np.ndarray
    sunlit: np.ndarray
    source: np.ndarray


SOURCES = {0: "nothing known", 1: "measured", 2: "completed"}


def texel_sigma(fit: AlbedoFit) -> np.ndarray:
    """Standard deviation ``(R, S)`` float32 of the albedo (green); infinite where nothing was seen."""
    with np.errstate(divide="ignore"):
        random = 1.0 / np.sqrt(fit.information.astype(float))
    # Neighbours share pixels, so a texel that no pixel has to itself is known worse than the diagonal says.
    shared = 1.0 + 1.0 / np.maximum(fit.seen, 1e-3)
    scale = max(1.0, float(np.nanmedian(fit.residual)) / 0.0135)
    sigma = np.hypot(scale * random * shared, _COMMON * fit.albedo[..., 1])
    return np.where((fit.seen > 0.0) & (fit.information > 0.0), sigma, np.inf).astype(np.float32)


def finite_sigma(fit: AlbedoFit) -> np.ndarray:
    """σ ``(R, S)`` of all that was seen, poorly known texels included, for those who weigh by it; infinite elsewhere."""
    return np.where(fit.seen >= _FEWEST_PIXELS, texel_sigma(fit), np.inf).astype(np.float32)


def times_sunlit(photographs: Sequence[AlbedoPhotograph]) -> np.ndarray:
    """In how many photographs each texel was seen in direct sunlight ``(R, S)`` uint8."""
    shape = photographs[0].footprints.shape
    count = np.zeros(shape[0] * shape[1], np.int32)
    for photograph in photographs:
        footprints = photograph.footprints
        if not footprints.sunlit[photograph.number]:
            continue
        seen = np.bincount(footprints.texel, footprints.share, len(count))
        lit = np.bincount(footprints.texel, footprints.sunlit[photograph.number][0], len(count))
        count += (lit > 0.05 * seen) & (seen > 0.0)
    return np.minimum(count, 255).astype(np.uint8).reshape(shape)


def known_albedo(land: TexelTransport, photographs: Sequence[AlbedoPhotograph], fit: AlbedoFit) -> KnownAlbedo:
    """The albedo of a fit and its uncertainty; where nothing is measured, the median, of infinite σ.

    Raises
    ------
    ValueError
        Where no texel at all is measured.
    """
    sigma = finite_sigma(fit)
    measured = np.zeros(land.shape[0] * land.shape[1], bool)
    measured[land.texel] = True
    measured = measured.reshape(land.shape) & (sigma < _POOR * fit.albedo[..., 1] + 0.02)
    if not measured.any():
        raise ValueError("known_albedo: no texel is measured")
    albedo = np.where(measured[..., None], fit.albedo, np.median(fit.albedo[measured], axis=0)).astype(np.float32)
    sigma = np.where(measured, sigma, np.inf).astype(np.float32)
    return KnownAlbedo(albedo, sigma, times_sunlit(photographs), measured.astype(np.uint8))
