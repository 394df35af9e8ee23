"""Heights above the ellipsoid from heights in a vertical datum: PROJ's grids where installed, else a coarse EGM96.

The package holds EGM96 (Lemoine et al. 1998; public domain, National Geospatial-Intelligence Agency) at every half degree.
Interpolated, it is within 0.04 m (root mean square over the Earth; 0.3 m for 99.9 %; at most 0.95 m, in the trenches) of the
15-minute grid. EGM2008 and national datums differ from EGM96 by some decimetres, on single coasts by more than a metre.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.errors import InputError

# Vertical datums of scene files as CRS for PROJ.
_VERTICAL_CRS = {
    "EGM96": "EPSG:5773",
    "EGM2008": "EPSG:3855",
    "LN02": "EPSG:5728",
    "IGN69": "EPSG:5720",
    "NN2000": "EPSG:5941",
    "NAVD88": "EPSG:5703",
    "EVRF": "EPSG:5621",
}
_PER_DEG = 2
_MARGIN = 8  # columns repeated beyond the date line, for the cubic interpolation


@dataclass(frozen=True)
class Geoid:
    """How heights of a vertical datum become heights above the WGS 84 ellipsoid.

    Parameters
    ----------
    source
        In words: where the difference comes from.
    undulation_m
        Height of the datum's zero above the ellipsoid ``(...)`` [m] at WGS 84 latitudes and longitudes ``(...)`` [deg].
    """

    source: str
    undulation_m: Callable[[np.ndarray, np.ndarray], np.ndarray]


def geoid_of(vertical_datum: str, latitude_deg: float, longitude_deg: float, *, given_m: float | None = None) -> Geoid:
    """Return the geoid of a vertical datum about a place.

    Parameters
    ----------
    vertical_datum
        As in scene files.
    latitude_deg, longitude_deg
        WGS 84 position, for which PROJ chooses the most accurate of its grids [deg].
    given_m
        A constant height of the datum's zero above the ellipsoid that the user states [m]; it goes first.

    Raises
    ------
    InputError
        For a stated height beyond ±120 m, which no place on Earth has.
    """
    if given_m is not None:
        require_undulation(given_m)
        return Geoid(f"{given_m:g} m everywhere, as given", _constant(given_m))
    if vertical_datum == "ellipsoidal":
        return Geoid("heights are above the ellipsoid already", _constant(0.0))
    crs = _VERTICAL_CRS.get(vertical_datum)
    of_proj = None if crs is None else _proj_undulation(crs, latitude_deg, longitude_deg)
    if of_proj is not None:
        return Geoid(f"{vertical_datum}, a grid of PROJ", of_proj)
    if vertical_datum == "EGM96":
        return Geoid("EGM96 at 30 minutes", egm96_m)
    if crs is not None:
        doubt = f"EGM96 at 30 minutes; PROJ has no grid of {vertical_datum} here, which may differ by a metre"
        return Geoid(doubt, egm96_m)
    doubt = f"EGM96 at 30 minutes; heights (datum: {vertical_datum}) are taken as above sea level, else give --geoid-m"
    return Geoid(doubt, egm96_m)


def require_undulation(given_m: float) -> None:
    """`InputError` for a height of a datum's zero above the ellipsoid beyond ±120 m, which no place on Earth has."""
    if not abs(given_m) <= 120.0:
        raise InputError("--geoid-m", "no place on Earth has this", got=given_m, expected="-107 to 86")


def _constant(height_m: float) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    return lambda latitude, longitude: np.full(np.broadcast_shapes(np.shape(latitude), np.shape(longitude)), height_m)


def _proj_undulation(
    vertical_crs: str, latitude_deg: float, longitude_deg: float
) -> Callable[[np.ndarray, np.ndarray], np.ndarray] | None:
    """PROJ's transformation of a datum's zero to the ellipsoid, or ``None`` where no grid for the place is installed."""
    from pyproj.transformer import TransformerGroup

    horizontal_and_vertical = f"EPSG:4326+{vertical_crs.removeprefix('EPSG:')}"
    with warnings.catch_warnings():
        # It warns of grids that are not installed, which the geoid's source tells in other words.
        warnings.simplefilter("ignore", UserWarning)
        group = TransformerGroup(horizontal_and_vertical, "EPSG:4979", always_xy=True, allow_ballpark=False)
    for transformer in group.transformers:
        if np.isfinite(transformer.transform(longitude_deg, latitude_deg, 0.0)[2]):
            return lambda latitude, longitude: np.asarray(
                transformer.transform(longitude, latitude, np.zeros(np.shape(latitude)))[2]
            )
    return None


@lru_cache(maxsize=1)
def _egm96_coefficients() -> np.ndarray:
    """Cubic B-spline coefficients of the undulations [cm] at every half degree.

    Rows from the north pole, columns from Greenwich, with a margin on both sides.
    """
    from scipy.ndimage import spline_filter

    with np.load(str(files("seasonscapes.terrain") / "egm96_30min.npz"), allow_pickle=False) as stored:
        # Stored as differences along both axes, which deflate to half the size.
        grid = np.cumsum(np.cumsum(stored["differences_cm"], axis=0, dtype=np.int32), axis=1, dtype=np.int32)
    wrapped = np.concatenate([grid[:, -_MARGIN:], grid, grid[:, :_MARGIN]], axis=1)
    return spline_filter(wrapped, order=3, output=np.float64, mode="nearest")


def egm96_m(latitude_deg: ArrayLike, longitude_deg: ArrayLike) -> np.ndarray:
    """Interpolate the undulation of EGM96 (cubic spline) at WGS 84 positions ``(...)`` [m].

    Examples
    --------
    >>> from seasonscapes.terrain.geoid import egm96_m
    >>> round(float(egm96_m(46.55, 7.98)), 1)
    50.4
    """
    from scipy.ndimage import map_coordinates

    latitude, longitude = np.broadcast_arrays(np.asarray(latitude_deg, float), np.asarray(longitude_deg, float))
    row, column = (90.0 - latitude) * _PER_DEG, longitude % 360.0 * _PER_DEG + _MARGIN
    places = [row.ravel(), column.ravel()]
    undulation_cm = map_coordinates(_egm96_coefficients(), places, order=3, mode="nearest", prefilter=False)
    return undulation_cm.reshape(row.shape) / 100.0
