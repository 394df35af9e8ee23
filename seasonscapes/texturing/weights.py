"""How much a picture has to say about a texel."""

from __future__ import annotations

import numpy as np

# More pixels than this on a texel's side do not make it better.
_ENOUGH_PX = 1.5
# Blending weights are sharpened, so that the best picture decides and others only soften its rim.
SHARPNESS = 4.0
# Trust in pixels near either end of the range: they speak only where nothing else does. Clipped ones never: snow would
# turn yellow where only its blue is clipped.
_EXTREME_TRUST = 0.02
BRIGHTEST, DARKEST, _CLIPPED = 0.9, 0.002, 0.985


def texel_weight(cosine: np.ndarray, px_per_texel: np.ndarray) -> np.ndarray:
    """``cos θ · min(pixels per texel, 1.5)²``, scaled to at most 1.

    Parameters
    ----------
    cosine
        Of the angle between the face's normal and the direction to the camera; negative counts as 0.
    px_per_texel
        Pixels along a texel's side, were it seen straight on.
    """
    return (np.maximum(cosine, 0.0) * (np.minimum(px_per_texel, _ENOUGH_PX) / _ENOUGH_PX) ** 2).astype(np.float32)


def exposure_confidence(image: np.ndarray) -> np.ndarray:
    """Trust ``(H, W)`` float32 in the tones of a picture ``(H, W, 3)`` in [0, 1]: low near either end, 0 where clipped."""
    brightest = image.max(axis=2)
    confidence = np.where((brightest < BRIGHTEST) & (brightest > DARKEST), 1.0, _EXTREME_TRUST)
    return np.where(brightest < _CLIPPED, confidence, 0.0).astype(np.float32)


def sharpened(weight: np.ndarray) -> np.ndarray:
    """Weights for blending."""
    return np.asarray(weight, np.float64) ** SHARPNESS
