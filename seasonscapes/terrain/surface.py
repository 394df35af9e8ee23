"""The nouns of terrain: rasters on a map, a triangulated surface in the local frame, textures on it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from affine import Affine

from seasonscapes.frames import LocalFrame


@dataclass(frozen=True)
class Raster:
    """Values on a map grid.

    Parameters
    ----------
    values
        ``(H, W, C)`` float32; row 0 is the first row of the file (north, for north-up rasters). NaN marks no data.
    transform
        Affine map from (column, row) to map coordinates; (0, 0) is the **corner** of the first pixel.
    crs
        Coordinate reference system as WKT or ``EPSG:n``.
    """

    values: np.ndarray
    transform: Affine
    crs: str


@dataclass(frozen=True)
class Terrain:
    """A triangulated surface.

    Parameters
    ----------
    vertices
        ``(V, 3)`` float32 east-north-up [m].
    faces
        ``(F, 3)`` uint32, counter-clockwise seen from above (from outside).
    uv
        ``(V, 2)`` float32 in [0, 1]; v runs upwards: v = 1 is row 0 of a texture.
    frame
        The local frame that the vertices are in.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    frame: LocalFrame


@dataclass(frozen=True)
class Texture:
    """Values over the atlas of a terrain.

    Parameters
    ----------
    values
        ``(R, S, 3)`` float32 with row 0 at v = 1: albedo in [0, 1], or radiance [cd/m²], by the name of the variable.
    weight
        ``(R, S)`` float32, 0 where never seen.
    """

    values: np.ndarray
    weight: np.ndarray = field(default=None)  # type: ignore[assignment]

    def __post_init__(self):
        if self.weight is None:
            object.__setattr__(self, "weight", np.ones(self.values.shape[:2], np.float32))
        if self.values.shape[:2] != self.weight.shape:
            raise ValueError(f"Texture: values {self.values.shape} and weight {self.weight.shape} differ in size")
