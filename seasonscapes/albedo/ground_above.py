"""Ground that is not Lambertian in images from above: snow and forest as factors, and the sky that water mirrors.

An image from straight above sees snow and forest from one direction, towards which they send a factor times what Lambertian ground of
the same albedo sends, as the renderer has it (`rendering.ground_optics`). Water mirrors the zenith, and what is left comes from its body.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.rendering.ground_optics import GroundOptics
from seasonscapes.rendering.water_surface import fresnel_reflectance

# The factor of snow depends on its albedo; each round is ten times nearer.
_ROUNDS = 3
_UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class GroundAbove:
    """How the ground of texels is seen from straight above; textures of R rows and S columns.

    Parameters
    ----------
    optics
        How snow and forest reflect; ``None`` without either.
    normal
        ``(R, S, 3)`` unit normals, east-north-up; NaN off the surface.
    to_sun
        ``(3,)`` unit direction to the sun.
    water
        ``(R, S)`` share of each texel that is water; ``None`` without any.
    zenith
        ``(3,)`` radiance of the sky at the zenith [cd/m²].
    """

    optics: GroundOptics | None
    normal: np.ndarray
    to_sun: np.ndarray
    water: np.ndarray | None
    zenith: np.ndarray

    def lambertian_radiance(self, radiance: np.ndarray) -> np.ndarray:
        """Radiance ``(R, S, 3)`` [cd/m²] as it would be without the surface of the water: that of its body."""
        if self.water is None:
            return radiance
        share = np.clip(self.water, 0.0, 1.0)[..., None].astype(np.float32)
        mirrored = float(fresnel_reflectance(np.ones(1))[0])
        body = np.maximum(radiance - share * np.float32(mirrored) * self.zenith.astype(np.float32), 0.0)
        return body / (1.0 - share * np.float32(mirrored))

    def illuminance(self, radiance: np.ndarray, sunlight: np.ndarray, ambient: np.ndarray) -> np.ndarray:
        """Illuminance of Lambertian ground that would send as much upwards: light ``(R, S, 3)`` [lx] times factors.

        Parameters
        ----------
        radiance
            ``(R, S, 3)`` of the texels [cd/m²].
        sunlight, ambient
            ``(R, S, 3)`` illuminance by the sun, and by sky and other terrain [lx].
        """
        if self.optics is None:
            return sunlight + ambient
        shape, total = radiance.shape[:2], sunlight + ambient
        up, into = np.nan_to_num(self.normal @ _UP, nan=1.0), np.nan_to_num(self.normal @ self.to_sun, nan=1.0)
        cosines = (up.ravel(), into.ravel(), np.full(up.size, float(_UP @ self.to_sun)))
        for _ in range(_ROUNDS):
            albedo = np.clip(np.pi * radiance / np.maximum(total, 1e-3), 1e-3, 1.0).reshape(-1, 3)
            direct = self.optics.relative_rows(albedo, cosines).reshape(*shape, 3)
            diffuse = self.optics.relative_diffuse_rows(albedo, cosines[0]).reshape(*shape, 3)
            total = (sunlight * direct + ambient * diffuse).astype(np.float32)
        return total
