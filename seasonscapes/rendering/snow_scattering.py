"""Reflection by snow after Kokhanovsky & Zege 2004 (doi:10.1364/AO.43.001589): asymptotic radiative transfer.

Light leaves snow after many scatterings. Its reflectance is that of snow which absorbs nothing, R₀, weakened by absorption
along the way: R = R₀ exp(−α K(μ) K(μ₀) / R₀), with the escape function K(μ) = 3/7 (1 + 2 μ) and α = −ln(spherical albedo).
Grains scatter forwards: towards a low sun, snow is brighter than away from it, and under it brighter than at noon.

R₀ is the closed form of Kokhanovsky & Bréon 2012 (doi:10.1109/LGRS.2012.2185775). As it stands it reflects 1.2 times the
light that comes in under grazing angles; here a factor h(μ) h(μ₀), found once for all, makes each direction reflect exactly
what comes in, and keeps reciprocity.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from seasonscapes.terrain.surface_classes import Snow

# Imaginary refractive index of ice at the dominant wavelengths of the Rec.709 primaries and at 900 nm, from the table of
# Warren & Brandt 2008 (doi:10.1029/2007JD009744).
ICE_ABSORPTION = {465e-9: 1.640e-10, 549e-9: 2.241e-9, 612e-9: 7.228e-9, 900e-9: 4.200e-7}
PRIMARIES_M = (612e-9, 549e-9, 465e-9)
# α = 4.3 √(γ d): absorption enhancement 1.6 and asymmetry 0.845 of natural grains in 4/3 √(B γ d / (1 − g)).
_SHAPE = 4.0 / 3.0 * np.sqrt(1.6 / (1.0 - 0.845))
# Below these cosines, directions and surfaces of natural snow are no longer defined; the reflectance stays finite.
_LEAST_COSINE, _MOST_REFLECTANCE = 0.02, 12.0
# Snow is brighter than these luminous albedos, and its colours differ by less than these shares.
_BRIGHT, _COLOURLESS = (0.40, 0.55), (0.16, 0.28)
_NODES = 48


def snow_albedo(grain_mm: float, cosine: np.ndarray | None = None, wavelength_m: tuple[float, ...] = PRIMARIES_M):
    """Albedo of clean snow.

    Parameters
    ----------
    grain_mm
        Optical diameter of the grains: 6 volumes per surface [mm]; 0.1 when it falls, 1 and more when it melts.
    cosine
        ``(...)`` cosine of the sun's angle of incidence; ``None``: for diffuse light.
    wavelength_m
        C wavelengths [m], of those in `ICE_ABSORPTION`.

    Returns
    -------
    numpy.ndarray
        ``(..., C)``.

    Examples
    --------
    >>> [round(float(value), 3) for value in snow_albedo(1.0)]
    [0.949, 0.97, 0.991]
    """
    gamma = np.array([4.0 * np.pi * ICE_ABSORPTION[length] / length for length in wavelength_m])
    alpha = _SHAPE * np.sqrt(gamma * grain_mm * 1e-3)
    escape = 1.0 if cosine is None else escape_function(np.asarray(cosine, float))[..., None]
    return np.exp(-alpha * escape)


def escape_function(cosine: Any) -> Any:
    """K(μ) = 3/7 (1 + 2 μ)."""
    return 3.0 / 7.0 * (1.0 + 2.0 * cosine)


class NumpyMaths:
    """Functions of NumPy under the names that the module ``drjit`` has."""

    exp, sqrt, minimum, maximum, acos = np.exp, np.sqrt, np.minimum, np.maximum, np.arccos


def reflectance(
    cosine_out: Any, cosine_in: Any, between: Any, albedo: Any, maths: Any = NumpyMaths, factor: Any = None
) -> Any:
    """Reflectance of snow for one direction of light, as a multiple of that of a white Lambertian surface.

    Parameters
    ----------
    cosine_out, cosine_in
        Cosines of the angles between the normal and the viewer, and the normal and the light.
    between
        Cosine of the angle between viewer and light.
    albedo
        Spherical albedo, in (0, 1].
    maths
        Functions of the arrays: NumPy's, or the module ``drjit``.
    factor
        h(μ) as a function; by default `_conserving`.

    Returns
    -------
    array
        Of the shape of the arguments.
    """
    conserving = _conserving if factor is None else factor
    out, into = (maths.maximum(cosine, _LEAST_COSINE) for cosine in (cosine_out, cosine_in))
    # The angle of scattering is 0 for light that goes on straight.
    scattering_deg = maths.acos(maths.maximum(maths.minimum(-between, 1.0), -1.0)) * (180.0 / np.pi)
    phase = 11.1 * maths.exp(-0.087 * scattering_deg) + 1.1 * maths.exp(-0.014 * scattering_deg)
    white = (1.247 + 1.186 * (out + into) + 5.157 * out * into + phase) / (4.0 * (out + into))
    white = maths.minimum(white * conserving(out, maths) * conserving(into, maths), _MOST_REFLECTANCE)
    return white * albedo ** (escape_function(out) * escape_function(into) / white)


def _conserving(cosine: Any, maths: Any) -> Any:
    """h(μ), a polynomial in √μ."""
    root, total = maths.sqrt(cosine), 0.0
    for coefficient in conserving_polynomial():
        total = total * root + coefficient
    return total


@cache
def conserving_polynomial() -> tuple[float, ...]:
    """Coefficients of h(μ) in √μ, highest power first: symmetric scaling of R₀ until each direction reflects all light."""
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    cosine = 0.5 * (node + 1.0)
    weight = weight * cosine
    azimuth = (np.arange(512) + 0.5) * np.pi / 512
    sine = np.sqrt(1.0 - cosine**2)
    between = cosine[:, None, None] * cosine[None, :, None]
    between = between + sine[:, None, None] * sine[None, :, None] * np.cos(azimuth)
    table = reflectance(
        cosine[:, None, None], cosine[None, :, None], between, 1.0, factor=lambda values, maths: np.ones_like(values)
    ).mean(axis=2)
    scale = np.ones(_NODES)
    for _ in range(200):
        scale = np.sqrt(scale / (table @ (weight * scale)))
    return tuple(float(value) for value in np.polyfit(np.sqrt(cosine), scale, 7, w=np.sqrt(weight)))


class SnowOptics:
    """Where ground is snow, by its albedo, and how it reflects; in NumPy or on the Dr.Jit device.

    Parameters
    ----------
    snow
        As the terrain states it.
    """

    def __init__(self, snow: Snow) -> None:
        self.clean = None if snow.grain_mm is None else tuple(float(value) for value in snow_albedo(snow.grain_mm))

    @staticmethod
    def share(red: Any, green: Any, blue: Any, maths: Any = NumpyMaths) -> Any:
        """How much of the ground is snow, 0 to 1, by its colour: bright, and nearly white."""
        most = maths.maximum(maths.maximum(red, green), maths.maximum(blue, 1e-4))
        least = maths.minimum(red, maths.minimum(green, blue))
        bright = 0.2126 * red + 0.7152 * green + 0.0722 * blue
        ramp = (bright - _BRIGHT[0]) / (_BRIGHT[1] - _BRIGHT[0])
        pale = (_COLOURLESS[1] - (most - least) / most) / (_COLOURLESS[1] - _COLOURLESS[0])
        return maths.minimum(maths.maximum(maths.minimum(ramp, pale), 0.0), 1.0)

    def relative(self, albedo: Any, cosines: tuple[Any, Any, Any], maths: Any = NumpyMaths) -> list[Any]:
        """Reflectance towards the viewer from one direction, divided by the albedo, in three channels.

        Parameters
        ----------
        albedo
            Three channels of the ground's albedo.
        cosines
            Of the viewer, of the light, and between both; see `reflectance`.
        maths
            See `reflectance`.
        """
        share = self.share(albedo[0], albedo[1], albedo[2], maths)
        out, into, between = cosines
        bounded = [maths.minimum(maths.maximum(channel, 0.05), 0.995) for channel in albedo]
        return [1.0 + share * (reflectance(out, into, between, each, maths) / each - 1.0) for each in bounded]

    def relative_diffuse(self, albedo: Any, cosine_out: Any) -> list[Any]:
        """Reflectance towards the viewer of diffuse light, divided by the albedo: a ^ (K(μ) − 1)."""
        share = self.share(albedo[0], albedo[1], albedo[2])
        power = escape_function(np.maximum(cosine_out, _LEAST_COSINE)) - 1.0
        return [1.0 + share * (np.clip(each, 0.05, 0.995) ** power - 1.0) for each in albedo]
