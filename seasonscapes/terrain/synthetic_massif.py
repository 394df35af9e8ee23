"""Data type of the synthetic massif: elevation, ground cover and the terrain attributes that its albedo depends on."""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass

import cv2
import numpy as np

from seasonscapes.images import atomic_path
from seasonscapes.terrain.surface import Raster

CENTRE_LATITUDE_DEG, CENTRE_LONGITUDE_DEG = 46.55, 7.98
CRS = "EPSG:32632"
_MAPS = ("cover", "slope_deg", "northness", "concavity_m", "debris", "shore_m")


@dataclass(frozen=True)
class SyntheticMassif:
    """A procedurally generated massif; maps are ``(H, W)`` with row 0 in the north.

    Parameters
    ----------
    elevation
        Surface heights ``(H, W, 1)`` float32 [m] on the UTM grid; lake and ice surfaces included.
    cover
        `Cover` classes, uint8.
    slope_deg, northness
        Slope [deg] and northward component of the unit normal, float32.
    concavity_m
        Gaussian-weighted mean height of the surroundings minus the cell's height [m], float32; positive in hollows.
    debris
        Fraction of glacier surface covered by debris, float32 in [0, 1].
    shore_m
        Signed distance to the lake's shore, negative on the lake [m], float32; resolves the shore below the cell size.
    seed, spacing_m
        Seed and cell size [m] of the generator.
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

    @property
    def content(self) -> str:
        """Hash of the maps that terrain, water and albedo are made of."""
        digest = hashlib.sha256()
        for values in (self.elevation.values, self.cover, self.debris, self.shore_m):
            digest.update(np.ascontiguousarray(values).tobytes())
        return digest.hexdigest()


def massif_of(
    z: np.ndarray, cover: np.ndarray, debris: np.ndarray, shore_m: np.ndarray, *, seed: int, spacing_m: float
) -> SyntheticMassif:
    """Place maps of a massif on the Earth and derive the attributes of its surface.

    Parameters
    ----------
    z
        Heights ``(H, W)`` float32 [m].
    cover, debris, shore_m
        Maps ``(H, W)`` as in `SyntheticMassif`.
    seed, spacing_m
        Of the generator.

    Returns
    -------
    SyntheticMassif
        Centred at 46.55° N, 7.98° E.
    """
    from affine import Affine
    from pyproj import Transformer

    to_map = Transformer.from_crs("EPSG:4326", CRS, always_xy=True, allow_ballpark=False)
    east, north = to_map.transform(CENTRE_LONGITUDE_DEG, CENTRE_LATITUDE_DEG)
    edge = 0.5 * z.shape[0] * spacing_m
    transform = Affine(spacing_m, 0.0, east - edge, 0.0, -spacing_m, north + edge)
    mean_height = cv2.GaussianBlur(z, (0, 0), 90.0 / spacing_m)
    slope, northness = slope_and_northness(z, spacing_m)
    elevation = Raster(z[..., None], transform, CRS)
    return SyntheticMassif(
        elevation, cover, slope, northness, mean_height - z, debris, shore_m, seed=seed, spacing_m=spacing_m
    )


def slope_and_northness(elevation: np.ndarray, spacing_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute slope and aspect of an elevation grid.

    Parameters
    ----------
    elevation
        Heights ``(H, W)`` [m], row 0 in the north.
    spacing_m
        Cell size [m].

    Returns
    -------
    slope_deg
        ``(H, W)`` float32 [deg].
    northness
        ``(H, W)`` float32 northward component of the unit normal.
    """
    down, right = np.gradient(elevation.astype(np.float64), spacing_m)
    up = 1.0 / np.sqrt(1.0 + down**2 + right**2)
    return np.degrees(np.arccos(up)).astype(np.float32), (down * up).astype(np.float32)


def save_massif(massif: SyntheticMassif, path: str | os.PathLike[str]) -> None:
    """Write a massif to one ``.npz`` file, atomically.

    Parameters
    ----------
    massif
        The massif.
    path
        File to write.
    """
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        maps = {name: getattr(massif, name) for name in _MAPS}
        np.savez_compressed(
            file,
            elevation=massif.elevation.values,
            transform=np.array(massif.elevation.transform)[:6],
            crs=massif.elevation.crs,
            seed=massif.seed,
            spacing_m=massif.spacing_m,
            **maps,
        )


def load_massif(path: str | os.PathLike[str]) -> SyntheticMassif:
    """Read a massif from a file of `save_massif`.

    Parameters
    ----------
    path
        File to read.

    Returns
    -------
    SyntheticMassif
        The massif, equal to the one that was saved.
    """
    from affine import Affine

    with np.load(path) as stored:
        raster = Raster(stored["elevation"], Affine(*stored["transform"]), str(stored["crs"]))
        maps = {name: stored[name] for name in _MAPS}
        return SyntheticMassif(raster, **maps, seed=int(stored["seed"]), spacing_m=float(stored["spacing_m"]))
