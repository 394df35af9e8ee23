"""Ground that is not Lambertian towards the viewer: snow and forest, each where the albedo has its colour."""

from __future__ import annotations

from typing import Any

import numpy as np

from seasonscapes.rendering.forest_scattering import ForestOptics
from seasonscapes.rendering.snow_scattering import NumpyMaths, SnowOptics
from seasonscapes.terrain.surface import Terrain

# Functions of arrays, for `GroundOptics.relative` in place of the module ``drjit``.
NUMPY = NumpyMaths


class GroundOptics:
    """How the ground of a terrain reflects, relative to Lambertian ground; in NumPy or on the Dr.Jit device.

    Parameters
    ----------
    parts
        Kinds of ground, no two of which share a colour.
    """

    def __init__(self, parts: list[SnowOptics | ForestOptics]) -> None:
        self._parts = parts

    def relative(self, albedo: Any, cosines: tuple[Any, Any, Any], maths: Any) -> list[Any]:
        """Reflectance towards the viewer from one direction, divided by the albedo; see `SnowOptics.relative`."""
        return self._total([part.relative(albedo, cosines, maths) for part in self._parts])

    def relative_diffuse(self, albedo: Any, cosine_out: Any) -> list[Any]:
        """Reflectance towards the viewer of diffuse light, divided by the albedo."""
        return self._total([part.relative_diffuse(albedo, cosine_out) for part in self._parts])

    def relative_rows(self, albedo: np.ndarray, cosines: tuple[Any, Any, Any]) -> np.ndarray:
        """`relative` of albedos ``(n, 3)`` in NumPy, ``(n, 3)`` float32."""
        return np.stack(self.relative(list(albedo.T), cosines, NUMPY), axis=1).astype(np.float32)

    def relative_diffuse_rows(self, albedo: np.ndarray, cosine_out: np.ndarray) -> np.ndarray:
        """`relative_diffuse` of albedos ``(n, 3)`` in NumPy, ``(n, 3)`` float32."""
        return np.stack(self.relative_diffuse(list(albedo.T), cosine_out), axis=1).astype(np.float32)

    @staticmethod
    def _total(parts: list[list[Any]]) -> list[Any]:
        """Each differs from 1 on its own ground alone."""
        return [sum(channel[1:], start=channel[0]) - (len(channel) - 1.0) for channel in zip(*parts, strict=True)]


def optics_of(terrain: Terrain) -> GroundOptics | None:
    """How the ground of a terrain reflects; ``None`` where all of it is Lambertian."""
    parts: list[SnowOptics | ForestOptics] = []
    if terrain.snow is not None:
        parts.append(SnowOptics(terrain.snow))
    if terrain.forest:
        parts.append(ForestOptics())
    return GroundOptics(parts) if parts else None
