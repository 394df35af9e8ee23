"""Detail of the albedo below its texels: noise by the kind of ground, as fine as the pixels in which it is seen.

The albedo is multiplied by 1 + c n, where the noise n has mean 0: so its mean over a texel stays. The contrast c follows from
the colour of the texel: strong where canopies shade themselves, less on grass, scree and rock, hardly any on snow and none on
water. Octaves run from the size of a texel down to that of a pixel at the distance of the camera, where they fade out: nothing
finer can be seen, and nothing pops up as a camera comes nearer. The noise is a function of the place and of the seed.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from seasonscapes.terrain.surface_classes import AlbedoDetail

# Wavelengths of the octaves [m]: whole powers of two, from the coarsest that may be needed on.
_COARSEST, _FINEST = 5, -8
# Octaves fade out between these wavelengths in pixels.
_FADE_PX = (0.5, 1.5)


class DeviceDetail:
    """An `AlbedoDetail` on the Dr.Jit device.

    Parameters
    ----------
    detail
        As the terrain states it.
    """

    def __init__(self, detail: AlbedoDetail) -> None:
        import drjit as dr
        import mitsuba as mi

        self._mi_eye = mi.Point3f(*(dr.opaque(mi.Float, float(value)) for value in detail.eye_m))
        self.texel_m = detail.texel_m
        self._mi_pixel = dr.opaque(mi.Float, detail.pixel_angle_rad)
        self._octaves = [
            2.0**power for power in range(_COARSEST, _FINEST - 1, -1) if 2.0**power <= 2.0 * detail.texel_m
        ]
        self._mi_seed = dr.opaque(mi.UInt32, detail.seed % 2**32)

    def applied(self, albedo: Any, position: Any, texel_m: Any = None) -> Any:
        """Albedo ``mi.Color3f`` with its detail at positions ``mi.Point3f``.

        ``texel_m`` ``mi.Float`` [m] is the side of the texels there, where an image finer than the atlas lies over it:
        octaves that the image holds itself are left out.
        """
        import drjit as dr
        import mitsuba as mi

        pixel_m = dr.maximum(dr.norm(position - self._mi_eye), 0.5) * self._mi_pixel
        total, energy = mi.Float(0.0), 0.0
        for number, length in enumerate(self._octaves):
            seen = dr.clip((length / pixel_m - _FADE_PX[0]) / (_FADE_PX[1] - _FADE_PX[0]), 0.0, 1.0)
            if texel_m is not None:
                seen *= dr.clip(4.0 * texel_m / length - 1.0, 0.0, 1.0)
            # Turned from octave to octave, so that their lattices do not coincide.
            angle = 0.7 * number
            cosine, sine = float(np.cos(angle) / length), float(np.sin(angle) / length)
            x, y = position.x * cosine - position.y * sine, position.x * sine + position.y * cosine
            # Walls are seen from the side, where east and north hardly change.
            total += seen * self._noise(x, y + position.z * (0.6 / length), number)
            energy += 1.0
        noise = total * (3.0 / np.sqrt(max(energy, 1.0)))
        noise = dr.clip(noise, -1.0, 1.0)
        return albedo * (1.0 + self._contrast(albedo) * noise)

    @staticmethod
    def _contrast(albedo: Any) -> Any:
        """Contrast of the ground by its colour."""
        import drjit as dr

        red, green, blue = albedo
        most = dr.maximum(dr.maximum(red, green), dr.maximum(blue, 1e-4))
        least = dr.minimum(red, dr.minimum(green, blue))
        bright = 0.2126 * red + 0.7152 * green + 0.0722 * blue
        green_share = dr.clip((green - dr.maximum(red, blue)) / most * 4.0, 0.0, 1.0)
        dark = dr.clip((0.10 - bright) / 0.06, 0.0, 1.0)
        vegetation = 0.45 + 0.30 * dark
        snow = dr.clip((bright - 0.35) / 0.15, 0.0, 1.0) * dr.clip((0.3 - (most - least) / most) / 0.1, 0.0, 1.0)
        water = dr.clip((blue - green) / most * 20.0 + 1.0, 0.0, 1.0) * dark
        ground = 0.40 + green_share * (vegetation - 0.40)
        return ground * (1.0 - 0.92 * snow) * (1.0 - water)

    def _noise(self, x: Any, y: Any, number: int) -> Any:
        """Gradient noise as in `terrain.lattice_noise`, of standard deviation 0.25."""
        import drjit as dr
        import mitsuba as mi

        column, row = dr.floor(x), dr.floor(y)
        fx, fy = x - column, y - row
        u, v = (f * f * f * (f * (6.0 * f - 15.0) + 10.0) for f in (fx, fy))
        first, above = mi.UInt32(mi.Int32(column)), mi.UInt32(mi.Int32(row))
        corners = []
        for dy in (0, 1):
            for dx in (0, 1):
                bits = (first + dx) * 0x9E3779B9 ^ (above + dy) * 0x85EBCA6B
                bits ^= (self._mi_seed + number * 7919) * 0xC2B2AE35 + 0x27D4EB2F
                bits = (bits ^ (bits >> 16)) * 0x7FEB352D
                bits = (bits ^ (bits >> 15)) * 0x846CA68B
                bits ^= bits >> 16
                sine, cosine = dr.sincos(mi.Float(bits >> 8) * (2.0 * np.pi / 2.0**24))
                corners.append(cosine * (fx - dx) + sine * (fy - dy))
        return dr.lerp(dr.lerp(corners[0], corners[1], u), dr.lerp(corners[2], corners[3], u), v)


def finest_detail_m(detail: AlbedoDetail | None, texel_m: float, distance_m: np.ndarray) -> np.ndarray:
    """Side of the smallest element of the albedo at distances from the camera: half the finest wavelength, or the texel.

    Parameters
    ----------
    detail
        Of the terrain; ``None``: its texels are the smallest elements.
    texel_m
        Side of a texel [m].
    distance_m
        ``(...)`` distances [m].

    Returns
    -------
    numpy.ndarray
        ``(...)`` [m].
    """
    distance_m = np.asarray(distance_m, float)
    if detail is None:
        return np.full(distance_m.shape, texel_m)
    pixel_m = np.maximum(distance_m, 0.5) * detail.pixel_angle_rad
    # The finest octave that counts at least half.
    power = np.ceil(np.log2(0.5 * sum(_FADE_PX) * pixel_m))
    return np.minimum(0.5 * 2.0 ** np.maximum(power, _FINEST), texel_m)
