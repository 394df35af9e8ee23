"""The embedded scene: a massif of our own making, the only place whose truth is known to the last digit.

`alpine_massif` raises it, `alpine_albedo` colours it for any day of the year.
"""

from __future__ import annotations

import os
from dataclasses import dataclass

import cv2
import numpy as np

from seasonscapes.images import atomic_path
from seasonscapes.terrain.surface import Raster
from seasonscapes.terrain.synthetic_albedo import SEASONS, alpine_albedo, snow_fraction, snow_line_m
from seasonscapes.terrain.synthetic_cover import Cover, ground_cover, slope_and_northness
from seasonscapes.terrain.synthetic_relief import relief

CENTRE_LATITUDE_DEG, CENTRE_LONGITUDE_DEG = 46.55, 7.98
CRS = "EPSG:32632"
_MAPS = ("cover", "slope_deg", "northness", "concavity_m", "debris", "shore_m")


@dataclass(frozen=True)
class SyntheticMassif:
    """The massif and the maps that its colours follow from; arrays ``(H, W)``, row 0 in the north.

    Parameters
    ----------
    elevation
        Surface heights ``(H, W, 1)`` float32 [m] on the UTM grid; lake and ice surfaces included.
    cover
        `Cover` classes, uint8.
    slope_deg, northness
        Steepness [deg] and northward component of the unit normal, float32.
    concavity_m
        Depth below the surroundings [m], float32: snow gathers there.
    debris
        Share of the glaciers under moraine, float32 in [0, 1].
    shore_m
        Distance to the lake's shore, negative on the water [m], float32: the shore is finer than the cells.
    seed, spacing_m
        What it was made from.
    """

    elevation: Raster
    cover: np.ndarray
    slope_deg: np.ndarray
    northness: np.ndarray
    concavity_m: np.ndarray
    debris: np.ndarray
    shore_m: np.ndarray
    seed: int
    spacing_m: float


def alpine_massif(*, seed: int = 1912, size_m: float = 12000.0, spacing_m: float = 15.0) -> SyntheticMassif:
    """Make the massif at 46.55° N, 7.98° E; the same seed gives the same bytes.

    Parameters
    ----------
    seed
        Shifts crests, valleys, gullies, forests and every texture.
    size_m
        Side of the square between the outermost cell centres [m].
    spacing_m
        Cell size [m]: 15, 30 or 60. Coarser ones are the same mountains with less detail.

    Raises
    ------
    ValueError
        Another spacing, or a size that holds no even number of cells or leaves the sketched ground.
    """
    from affine import Affine
    from pyproj import Transformer

    if spacing_m not in (15.0, 30.0, 60.0):
        raise ValueError(f"spacing_m: got {spacing_m}, expected 15, 30 or 60")
    if not 2000.0 <= size_m <= 12000.0 or size_m % (2.0 * spacing_m):
        raise ValueError(f"size_m: got {size_m}, expected 2000 to 12000 and an even number of cells of {spacing_m} m")
    shape = relief(size_m / 2.0, spacing_m, seed)
    axis = (np.arange(shape.elevation.shape[0]) - (shape.elevation.shape[0] - 1) / 2.0) * spacing_m
    cover = ground_cover(shape, spacing_m, seed, axis, -axis)
    to_map = Transformer.from_crs("EPSG:4326", CRS, always_xy=True, allow_ballpark=False)
    east, north = to_map.transform(CENTRE_LONGITUDE_DEG, CENTRE_LATITUDE_DEG)
    edge = axis[-1] + spacing_m / 2.0
    transform = Affine(spacing_m, 0.0, east - edge, 0.0, -spacing_m, north + edge)
    z = shape.elevation.astype(np.float32)
    smooth = cv2.GaussianBlur(z, (0, 0), 90.0 / spacing_m)
    slope, northness = slope_and_northness(z, spacing_m)
    return SyntheticMassif(
        Raster(z[..., None], transform, CRS),
        cover,
        slope,
        northness,
        smooth - z,
        shape.debris.astype(np.float32),
        shape.floor.shore_m.astype(np.float32),
        seed,
        spacing_m,
    )


def save_massif(place: SyntheticMassif, path: str | os.PathLike) -> None:
    """Write the place as one ``.npz``, atomically."""
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        maps = {name: getattr(place, name) for name in _MAPS}
        np.savez_compressed(
            file,
            elevation=place.elevation.values,
            transform=np.array(place.elevation.transform)[:6],
            crs=place.elevation.crs,
            seed=place.seed,
            spacing_m=place.spacing_m,
            **maps,
        )


def load_massif(path: str | os.PathLike) -> SyntheticMassif:
    """Read what `save_massif` wrote."""
    from affine import Affine

    with np.load(path) as held:
        raster = Raster(held["elevation"], Affine(*held["transform"]), str(held["crs"]))
        maps = {name: held[name] for name in _MAPS}
        return SyntheticMassif(raster, **maps, seed=int(held["seed"]), spacing_m=float(held["spacing_m"]))


__all__ = [
    "CENTRE_LATITUDE_DEG",
    "CENTRE_LONGITUDE_DEG",
    "CRS",
    "SEASONS",
    "Cover",
    "SyntheticMassif",
    "alpine_albedo",
    "alpine_massif",
    "load_massif",
    "save_massif",
    "snow_fraction",
    "snow_line_m",
]
