"""Coordinate frames: WGS 84, the local east-north-up frame, direction angles and equirectangular maps.

Conventions of the whole package:

* World: east, north, up [m] about the scene's origin, computed **through ECEF**, so that Earth curvature is included.
* Azimuth is clockwise from true north; elevation is above the local horizontal plane.
* Directions point away from the surface: towards the sun, towards the viewer.
* Transforms are named ``b_from_a``. Geodesy is float64 throughout.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from pydantic import AfterValidator, Field

# WGS 84 defining constants (NGA.STND.0036).
SEMI_MAJOR_AXIS_M = 6378137.0
FLATTENING = 1.0 / 298.257223563
ECCENTRICITY_SQUARED = FLATTENING * (2.0 - FLATTENING)
MEAN_RADIUS_M = 6371008.8

# Mean terrestrial refraction of a line of sight as a fraction of Earth curvature (Bomford 1980, Geodesy).
STANDARD_REFRACTION_K = 0.13


@dataclass(frozen=True)
class LocalFrame:
    """Local east-north-up frame whose up axis is the WGS 84 ellipsoid normal at its origin.

    Parameters
    ----------
    latitude_deg, longitude_deg
        Geodetic WGS 84 position of the origin [deg].
    height_m
        Height of the origin in the vertical datum of the scene [m].
    refraction_k
        Terrestrial refraction coefficient. Air bends a line of sight downwards with a curvature of ``k`` times the
        Earth's. Lifting every point by ``k d² / 2R`` (``d`` its horizontal distance from the origin) straightens these
        rays for every camera at once: the effective-Earth-radius construction ``R / (1 - k)``.
        ``0`` is the exact geometric frame.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float = 0.0
    refraction_k: float = 0.0

    def __post_init__(self):
        numbers = (self.latitude_deg, self.longitude_deg, self.height_m, self.refraction_k)
        if not all(np.isfinite(number) for number in numbers) or abs(self.latitude_deg) > 90.0:
            raise ValueError(f"LocalFrame: got origin {numbers}, expected finite numbers and a latitude within ±90°")


def normal_longitude(longitude_deg: float) -> float:
    """A longitude of 0…360°, or past 180°, as its equal within ±180° [deg]."""
    return longitude_deg if -180.0 <= longitude_deg <= 180.0 else (longitude_deg + 180.0) % 360.0 - 180.0


# What declarations state of a place, WGS 84 [deg]: longitudes of 180…360° mean their equals of −180…0°.
Latitude = Annotated[float, Field(ge=-90.0, le=90.0)]
Longitude = Annotated[float, Field(ge=-180.0, le=360.0), AfterValidator(normal_longitude)]


def frame_record(frame: LocalFrame) -> dict[str, Any]:
    """Describe a local frame as plain values for files: its coordinate reference systems and its origin."""
    return {
        "crs": "local east-north-up [m] about the origin, through ECEF (EPSG:4978)",
        "geographic_crs": "EPSG:4979",
        "origin": {
            "latitude_deg": frame.latitude_deg,
            "longitude_deg": frame.longitude_deg,
            "height_m": frame.height_m,
            "refraction_k": frame.refraction_k,
        },
    }


def ecef_from_geodetic(latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: ArrayLike) -> np.ndarray:
    """Convert WGS 84 positions to geocentric Cartesian (ECEF) coordinates.

    Parameters
    ----------
    latitude_deg, longitude_deg
        Geodetic position ``(...)`` [deg].
    height_m
        Ellipsoidal height ``(...)`` [m].

    Returns
    -------
    ndarray
        ECEF coordinates ``(..., 3)`` [m], float64.
    """
    latitude, longitude = np.radians(np.asarray(latitude_deg, float)), np.radians(np.asarray(longitude_deg, float))
    height = np.asarray(height_m, float)
    prime_vertical = SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - ECCENTRICITY_SQUARED * np.sin(latitude) ** 2)
    return np.stack(
        np.broadcast_arrays(
            (prime_vertical + height) * np.cos(latitude) * np.cos(longitude),
            (prime_vertical + height) * np.cos(latitude) * np.sin(longitude),
            (prime_vertical * (1.0 - ECCENTRICITY_SQUARED) + height) * np.sin(latitude),
        ),
        axis=-1,
    )


def geodetic_from_ecef(ecef_m: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Convert geocentric Cartesian (ECEF) coordinates to WGS 84 positions.

    Fixed-point iteration of Bowring's latitude; after five iterations the error is below one nanometre for heights up
    to 100 km.

    Parameters
    ----------
    ecef_m
        ECEF coordinates ``(..., 3)`` [m].

    Returns
    -------
    latitude_deg, longitude_deg, height_m
        Geodetic latitude and longitude [deg] and ellipsoidal height [m], each ``(...)``.
    """
    x, y, z = np.moveaxis(np.asarray(ecef_m, float), -1, 0)
    distance = np.hypot(x, y)
    latitude = np.arctan2(z, distance * (1.0 - ECCENTRICITY_SQUARED))
    for _ in range(5):
        sine = np.sin(latitude)
        prime_vertical = SEMI_MAJOR_AXIS_M / np.sqrt(1.0 - ECCENTRICITY_SQUARED * sine**2)
        latitude = np.arctan2(z + ECCENTRICITY_SQUARED * prime_vertical * sine, distance)
    sine, cosine = np.sin(latitude), np.cos(latitude)
    # This form is well conditioned both at the poles and at the equator.
    height = distance * cosine + z * sine - SEMI_MAJOR_AXIS_M * np.sqrt(1.0 - ECCENTRICITY_SQUARED * sine**2)
    return np.degrees(latitude), np.degrees(np.arctan2(y, x)), height


def axes_at(latitude_deg: float, longitude_deg: float) -> np.ndarray:
    """Return the rotation ``enu_from_ecef`` at a geodetic position.

    Parameters
    ----------
    latitude_deg, longitude_deg
        Geodetic WGS 84 position [deg].

    Returns
    -------
    ndarray
        ``(3, 3)``; the rows are the unit east, north and up vectors in ECEF.
    """
    latitude, longitude = np.radians(latitude_deg), np.radians(longitude_deg)
    sin_lat, cos_lat, sin_lon, cos_lon = np.sin(latitude), np.cos(latitude), np.sin(longitude), np.cos(longitude)
    return np.array(
        [
            [-sin_lon, cos_lon, 0.0],
            [-sin_lat * cos_lon, -sin_lat * sin_lon, cos_lat],
            [cos_lat * cos_lon, cos_lat * sin_lon, sin_lat],
        ]
    )


def _refraction_lift(frame: LocalFrame, east_m: np.ndarray, north_m: np.ndarray) -> np.ndarray:
    return frame.refraction_k * (east_m**2 + north_m**2) / (2.0 * MEAN_RADIUS_M)


def enu_from_geodetic(
    frame: LocalFrame, latitude_deg: ArrayLike, longitude_deg: ArrayLike, height_m: ArrayLike
) -> np.ndarray:
    """Convert WGS 84 positions to local east-north-up coordinates, including the frame's refraction lift.

    Parameters
    ----------
    frame
        Local frame.
    latitude_deg, longitude_deg
        Geodetic position ``(...)`` [deg].
    height_m
        Height in the vertical datum of the frame's origin ``(...)`` [m].

    Returns
    -------
    ndarray
        East, north, up ``(..., 3)`` [m], float64.
    """
    origin = ecef_from_geodetic(frame.latitude_deg, frame.longitude_deg, frame.height_m)
    offset = ecef_from_geodetic(latitude_deg, longitude_deg, height_m) - origin
    enu = offset @ axes_at(frame.latitude_deg, frame.longitude_deg).T
    enu[..., 2] += _refraction_lift(frame, enu[..., 0], enu[..., 1])
    return enu


def geodetic_from_enu(frame: LocalFrame, position_m: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Convert local east-north-up coordinates to WGS 84 positions; the inverse of `enu_from_geodetic`.

    Parameters
    ----------
    frame
        Local frame.
    position_m
        East, north, up ``(..., 3)`` [m].

    Returns
    -------
    latitude_deg, longitude_deg, height_m
        Geodetic latitude and longitude [deg] and height in the frame's vertical datum [m], each ``(...)``.
    """
    position = np.array(position_m, float)
    position[..., 2] -= _refraction_lift(frame, position[..., 0], position[..., 1])
    origin = ecef_from_geodetic(frame.latitude_deg, frame.longitude_deg, frame.height_m)
    return geodetic_from_ecef(origin + position @ axes_at(frame.latitude_deg, frame.longitude_deg))


def local_axes(frame: LocalFrame, latitude_deg: float, longitude_deg: float) -> np.ndarray:
    """Return the unit east, north and up vectors **of another place** in the frame's coordinates.

    The up vector of a place tilts away from the frame's by the distance over the Earth's effective radius (0.27° at
    30 km).

    Parameters
    ----------
    frame
        Local frame.
    latitude_deg, longitude_deg
        Geodetic WGS 84 position of the other place [deg].

    Returns
    -------
    ndarray
        ``(3, 3)``; the rows are orthonormal east, north and up vectors.
    """
    axes = axes_at(latitude_deg, longitude_deg) @ axes_at(frame.latitude_deg, frame.longitude_deg).T
    east, north, _ = enu_from_geodetic(
        LocalFrame(frame.latitude_deg, frame.longitude_deg), latitude_deg, longitude_deg, 0.0
    )
    # The refraction lift shears the frame by its gradient; at the other place this is a small rotation of the horizon.
    gradient = frame.refraction_k / MEAN_RADIUS_M * np.array([east, north])
    shear = np.array([[1.0, 0.0, gradient[0]], [0.0, 1.0, gradient[1]], [-gradient[0], -gradient[1], 1.0]])
    q, r = np.linalg.qr((axes @ shear).T)
    return (q * np.sign(np.diag(r))).T


def direction_from_angles(azimuth_deg: ArrayLike, elevation_deg: ArrayLike) -> np.ndarray:
    """Return unit vectors from azimuth and elevation.

    Parameters
    ----------
    azimuth_deg
        Azimuth clockwise from north ``(...)`` [deg].
    elevation_deg
        Elevation above the horizontal plane ``(...)`` [deg].

    Returns
    -------
    ndarray
        Unit east-north-up vectors ``(..., 3)``.

    Examples
    --------
    >>> direction_from_angles(90.0, 0.0).round(6) + 0.0
    array([1., 0., 0.])
    """
    azimuth, elevation = np.radians(np.asarray(azimuth_deg, float)), np.radians(np.asarray(elevation_deg, float))
    return np.stack(
        np.broadcast_arrays(
            np.sin(azimuth) * np.cos(elevation), np.cos(azimuth) * np.cos(elevation), np.sin(elevation)
        ),
        axis=-1,
    )


def angles_from_direction(direction: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuth and elevation of vectors.

    Parameters
    ----------
    direction
        East-north-up vectors of any length ``(..., 3)``.

    Returns
    -------
    azimuth_deg, elevation_deg
        Azimuth in [0, 360) clockwise from north and elevation [deg], each ``(...)``.
    """
    east, north, up = np.moveaxis(np.asarray(direction, float), -1, 0)
    return np.degrees(np.arctan2(east, north)) % 360.0, np.degrees(np.arctan2(up, np.hypot(east, north)))


def equirectangular_directions(height: int, width: int) -> np.ndarray:
    """Return the directions of the pixel centres of a full-sphere equirectangular map.

    Row 0 is the zenith, the last row the nadir. Column 0 begins at north and columns run clockwise through east.

    Parameters
    ----------
    height, width
        Size of the map [px].

    Returns
    -------
    ndarray
        Unit east-north-up vectors ``(height, width, 3)``.
    """
    elevation_deg = 90.0 - (np.arange(height) + 0.5) * (180.0 / height)
    azimuth_deg = (np.arange(width) + 0.5) * (360.0 / width)
    return direction_from_angles(azimuth_deg[None, :], elevation_deg[:, None])


def sample_equirectangular(values: np.ndarray, direction: ArrayLike) -> np.ndarray:
    """Interpolate a full-sphere equirectangular map bilinearly along directions.

    Columns wrap around in azimuth; rows are clamped at the poles.

    Parameters
    ----------
    values
        Map ``(H, W, C)`` with the layout of `equirectangular_directions`.
    direction
        East-north-up vectors ``(..., 3)``.

    Returns
    -------
    ndarray
        Interpolated values ``(..., C)``.
    """
    height, width = values.shape[:2]
    azimuth_deg, elevation_deg = angles_from_direction(direction)
    column, row = azimuth_deg * (width / 360.0) - 0.5, (90.0 - elevation_deg) * (height / 180.0) - 0.5
    column0, row0 = np.floor(column).astype(int), np.floor(row).astype(int)
    fx, fy = (column - column0)[..., None], (row - row0)[..., None]
    rows, columns = np.clip([row0, row0 + 1], 0, height - 1), np.mod([column0, column0 + 1], width)
    top = values[rows[0], columns[0]] * (1.0 - fx) + values[rows[0], columns[1]] * fx
    bottom = values[rows[1], columns[0]] * (1.0 - fx) + values[rows[1], columns[1]] * fx
    return top * (1.0 - fy) + bottom * fy
