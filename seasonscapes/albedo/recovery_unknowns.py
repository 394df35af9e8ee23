"""Unknowns of a recovery besides the albedo: their layout in one vector, their start and their priors.

For K photographs, C cameras and T instants:

========  ============  ==================================================================================================
name      shape         meaning
========  ============  ==================================================================================================
gain      ``(K, 3)``    logarithm of pixel value over radiance: exposure and white balance of each photograph
curve     ``(C, 2)``    response of each camera: strength s of an S-curve, and logarithm of an exponent γ (`bent`)
turn      ``(C, 3)``    rotation of each camera about its own axes (right, down, forward) [rad]
haze      ``(1,)``      logarithm of the visibility [km]
sky       ``(T, 3)``    logarithm of the scale of skylight
sun       ``(T, G²)``   visible share of the sun over the land, at the G × G nodes of a bilinear grid
========  ============  ==================================================================================================

Priors are normal about the start, with the standard deviations of `RecoveryPriors`; those of the sun are Cauchy's,
because most of the land lies in full sunlight and the rest may lie in none.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

GAIN, CURVE, TURN, HAZE, SKY, SUN = "gain", "curve", "turn", "haze", "sky", "sun"
# A node of the sun's grid exceeds full sunlight where bright clouds stand beside the sun.
_LIMITS = {CURVE: (-0.5, 0.9), TURN: (-0.02, 0.02), SKY: (-2.0, 2.0), SUN: (0.0, 1.2)}


@dataclass(frozen=True)
class RecoveryPriors:
    """Standard deviations of the unknowns about their start.

    Parameters
    ----------
    log_gain
        Gains without sky in the picture; wide, because exposures differ by factors.
    curve_strength, log_exponent
        Response curve.
    log_visibility
        Haze.
    log_sky
        Scale of skylight.
    sun, sun_step
        Scales of Cauchy's distributions of the sun's visible share about 1, and of its step between neighbouring nodes.
    sky_picture
        Relative radiance of the sky in a photograph, one error for the whole sky (Cauchy): it fixes the exposure.
    block
        Number of neighbouring pixels that err together (forward model, JPEG): their evidence counts as that of one.
    """

    log_gain: float = 2.0
    curve_strength: float = 0.3
    log_exponent: float = 0.1
    log_visibility: float = 0.6
    log_sky: float = 0.1
    sun: float = 0.05
    sun_step: float = 0.1
    sky_picture: float = 0.05
    block: int = 64


@dataclass(frozen=True)
class UnknownLayout:
    """Where each unknown lies in the vector of all.

    Parameters
    ----------
    photographs, cameras, instants
        K, C and T.
    grid
        G.
    """

    photographs: int
    cameras: int
    instants: int
    grid: int

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shape of each unknown, in the order of the vector; the sun's grids come last."""
        k, c, t = self.photographs, self.cameras, self.instants
        return {GAIN: (k, 3), CURVE: (c, 2), TURN: (c, 3), HAZE: (1,), SKY: (t, 3), SUN: (t, self.grid**2)}

    def offset(self, name: str) -> int:
        """First entry of an unknown."""
        start = 0
        for each, shape in self.shapes.items():
            if each == name:
                return start
            start += int(np.prod(shape))
        raise KeyError(name)

    @property
    def size(self) -> int:
        """Number of entries."""
        return self.offset(SUN) + self.instants * self.grid**2

    def view(self, values: np.ndarray, name: str) -> np.ndarray:
        """The entries of an unknown in its shape; a view."""
        shape, start = self.shapes[name], self.offset(name)
        return values[start : start + int(np.prod(shape))].reshape(shape)

    def clipped(self, values: np.ndarray) -> np.ndarray:
        """The values within their bounds."""
        values = values.copy()
        for name, (low, high) in _LIMITS.items():
            part = self.view(values, name)
            np.clip(part, low, high, out=part)
        return values


def bent(encoded: np.ndarray, curve: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Apply a response curve to sRGB-encoded values: ``(1 - s) u + s (3 u² - 2 u³)`` with ``u = e^γ``.

    Parameters
    ----------
    encoded
        ``(...)`` values in [0, 1].
    curve
        ``(2,)``: s and the logarithm of γ.

    Returns
    -------
    tuple of numpy.ndarray
        Values ``(...)``, their slope ``(...)``, and their derivatives to both parameters ``(..., 2)``.
    """
    strength, exponent = float(curve[0]), float(np.exp(curve[1]))
    value = np.clip(encoded, 1e-4, 1.0)
    u = value**exponent
    steepness = 1.0 - strength + 6.0 * strength * u * (1.0 - u)
    result = (1.0 - strength) * u + strength * u * u * (3.0 - 2.0 * u)
    by_strength = u * u * (3.0 - 2.0 * u) - u
    by_exponent = steepness * u * exponent * np.log(value)
    return result, steepness * exponent * u / value, np.stack([by_strength, by_exponent], axis=-1)


def straightened(encoded: np.ndarray, curve: np.ndarray) -> np.ndarray:
    """Invert `bent`.

    Parameters
    ----------
    encoded
        ``(...)`` values in [0, 1] of a picture.
    curve
        ``(2,)``: s and the logarithm of γ.

    Returns
    -------
    numpy.ndarray
        sRGB-encoded values ``(...)``, float32.
    """
    knots = np.linspace(0.0, 1.0, 4097)
    return np.interp(encoded, np.maximum.accumulate(bent(knots, curve)[0]), knots).astype(np.float32)
