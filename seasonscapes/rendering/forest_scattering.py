"""Reflection by forest: the Ross-Li kernels with a hot spot.

Seen with the sun behind the viewer, a forest shows no shadows and is bright; towards the sun its crowns show their shaded sides.
Reflectance is f_iso + f_vol K_vol + f_geo K_geo, with the reciprocal Ross-Thick and Li-Sparse kernels of the MODIS products
(Lucht, Schaaf & Strahler 2000, doi:10.1109/36.841980) and the hot spot of Maignan, Bréon & Lacaze 2004
(doi:10.1016/j.rse.2003.12.006) in K_vol. Here it only says how light is spread over directions: divided by its mean over all
pairs of directions, it leaves the texture's albedo what it is for diffuse light.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np

from seasonscapes.rendering.snow_scattering import NumpyMaths

# f_vol / f_iso and f_geo / f_iso of red, green and blue: the fixed parameters of Roy et al. 2016
# (doi:10.1016/j.rse.2016.01.023), means of a year of MODIS data.
PARAMETERS = (
    (0.0574 / 0.1690, 0.0227 / 0.1690),
    (0.0580 / 0.1306, 0.0178 / 0.1306),
    (0.0372 / 0.0774, 0.0079 / 0.0774),
)
# Angular radius of the hot spot [rad], after Maignan et al.
_HOT_SPOT = np.radians(1.5)
# Height over width of the crowns' middles, and no elongation of crowns: h/b = 2, b/r = 1 of the MODIS products.
_HEIGHT = 2.0
# Satellites fit the kernels up to angles of some 75°; beyond, they stay as there. They never fall below this share of f_iso.
_LEAST_COSINE, _LEAST_SHARE = 0.25, 0.1
# Canopies are darker than these luminous albedos; green exceeds red and blue by more than these shares.
_DARK, _GREEN = (0.09, 0.13), (0.02, 0.12)
_NODES = 64


def kernels(cosine_out: Any, cosine_in: Any, between: Any, maths: Any = NumpyMaths) -> tuple[Any, Any]:
    """Compute the volume and the geometric kernel, which are 0 for light and viewer at the zenith but for the hot spot.

    Parameters
    ----------
    cosine_out, cosine_in
        Cosines of the angles between the normal and the viewer, and the normal and the light.
    between
        Cosine of the angle between viewer and light.
    maths
        Functions of the arrays: NumPy's, or the module ``drjit``.

    Returns
    -------
    tuple of arrays
        K_vol and K_geo.
    """
    out, into = (maths.maximum(cosine, _LEAST_COSINE) for cosine in (cosine_out, cosine_in))
    cosine = maths.maximum(maths.minimum(between, 1.0), -1.0)
    phase = maths.acos(cosine)
    sine = maths.sqrt(maths.maximum(1.0 - cosine * cosine, 0.0))
    hot_spot = 1.0 + 1.0 / (1.0 + phase / _HOT_SPOT)
    # On the scale of the MODIS kernel; Maignan et al. scale it by 4 / (3 π).
    volume = ((0.5 * np.pi - phase) * cosine + sine) / (out + into) * hot_spot - 0.25 * np.pi
    secant_out, secant_in = 1.0 / out, 1.0 / into
    total, product = secant_out + secant_in, secant_out * secant_in
    # tan θ tan θ₀, and with the cosine of the azimuth between both; the first is that of the bounded angles.
    tangents = maths.sqrt((secant_out * secant_out - 1.0) * (secant_in * secant_in - 1.0))
    across = maths.maximum(maths.minimum((cosine - out * into) * product, tangents), -tangents)
    # (tan θ)² + (tan θ₀)² is that of the secants less 2.
    distance = maths.maximum(secant_out * secant_out + secant_in * secant_in - 2.0 - 2.0 * across, 0.0)
    sideways = maths.maximum(tangents * tangents - across * across, 0.0)
    shared = maths.minimum(_HEIGHT * maths.sqrt(distance + sideways) / total, 1.0)
    overlap = (maths.acos(shared) - maths.sqrt(maths.maximum(1.0 - shared * shared, 0.0)) * shared) * total / np.pi
    geometric = overlap - total + 0.5 * (1.0 + cosine) * product
    return volume, geometric


def relative_reflectance(cosine_out: Any, cosine_in: Any, between: Any, maths: Any = NumpyMaths) -> list[Any]:
    """Reflectance for one direction of light over that for diffuse light, in three channels; see `kernels`.

    Examples
    --------
    >>> towards_light, away = (relative_reflectance(0.7, 0.7, cosine)[0] for cosine in (1.0, -0.02))
    >>> bool(towards_light > 1.5 * away)
    True
    """
    volume, geometric = kernels(cosine_out, cosine_in, between, maths)
    return [
        maths.maximum(1.0 + vol * volume + geo * geometric, _LEAST_SHARE) / mean
        for (vol, geo), mean in zip(PARAMETERS, diffuse_means(), strict=True)
    ]


@cache
def _hemispheres() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nodes of the cosine of the viewer, their weights, and reflectance ``(3, nodes)`` of light from all directions."""
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    cosine = 0.5 * (node + 1.0)
    # Finer near azimuth 0, where the hot spot is narrow.
    turn = (np.arange(720) + 0.5) / 720
    azimuth, width = np.pi * turn**2, 2.0 * turn / 720
    sine = np.sqrt(1.0 - cosine**2)
    between = cosine[:, None, None] * cosine[None, :, None]
    between = between + sine[:, None, None] * sine[None, :, None] * np.cos(azimuth)
    volume, geometric = kernels(cosine[:, None, None], cosine[None, :, None], between)
    channels = [
        (np.maximum(1.0 + vol * volume + geo * geometric, _LEAST_SHARE) * width).sum(axis=2) @ (weight * cosine)
        for vol, geo in PARAMETERS
    ]
    return cosine, weight * cosine, np.array(channels)


@cache
def diffuse_means() -> tuple[float, float, float]:
    """Mean of the unscaled reflectance over all directions of light and viewer, in three channels."""
    _, weight, channels = _hemispheres()
    red, green, blue = (float(weight @ channel) for channel in channels)
    return red, green, blue


class ForestOptics:
    """Where ground is forest, by its albedo, and how it reflects; in NumPy or on the Dr.Jit device."""

    @staticmethod
    def share(red: Any, green: Any, blue: Any, maths: Any = NumpyMaths) -> Any:
        """How much of the ground is forest, 0 to 1, by its colour: dark and green."""
        bright = 0.2126 * red + 0.7152 * green + 0.0722 * blue
        other = maths.maximum(red, blue)
        dark = (_DARK[1] - bright) / (_DARK[1] - _DARK[0])
        lead = (green - other) / maths.maximum(green, 1e-4)
        leafy = (lead - _GREEN[0]) / (_GREEN[1] - _GREEN[0])
        return maths.minimum(maths.maximum(maths.minimum(dark, leafy), 0.0), 1.0)

    def relative(self, albedo: Any, cosines: tuple[Any, Any, Any], maths: Any = NumpyMaths) -> list[Any]:
        """Reflectance towards the viewer from one direction, divided by the albedo, in three channels.

        Parameters
        ----------
        albedo
            Three channels of the ground's albedo.
        cosines
            Of the viewer, of the light, and between both; see `kernels`.
        maths
            See `kernels`.
        """
        share = self.share(albedo[0], albedo[1], albedo[2], maths)
        return [1.0 + share * (each - 1.0) for each in relative_reflectance(*cosines, maths)]

    def relative_diffuse(self, albedo: Any, cosine_out: Any) -> list[Any]:
        """Reflectance towards the viewer of diffuse light, divided by the albedo."""
        share = self.share(albedo[0], albedo[1], albedo[2])
        node, _, channels = _hemispheres()
        towards = [
            np.interp(cosine_out, node, channel / mean) for channel, mean in zip(channels, diffuse_means(), strict=True)
        ]
        return [1.0 + share * (each - 1.0) for each in towards]
