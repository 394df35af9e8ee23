"""Terrain attributes of a height field: shape, sky view factor, direct sun at one instant, and insolation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

# Horizons are computed on at most this many cells; the layers that depend on them are smooth.
_HORIZON_CELLS = 1_000_000
_AZIMUTHS = 16
# Ratio of successive distances in the horizon search, for the sky view factor and for cast shadows.
_STRIDE = 1.35
_SHADOW_STRIDE = 1.06
# Half width of the soft edge of cast shadows [deg]: the sun's disc and the errors of the heights.
_PENUMBRA_DEG = 0.7
# Half width of the soft edge where horizons are interpolated between azimuths [deg].
_HORIZON_UNCERTAINTY_DEG = 6.0
# Limit of the layer ``sun_margin`` [deg].
_MARGIN_DEG = 15.0

# Components (east, north, up) of unit normals, ``(H, W)`` each.
_Normals = tuple[np.ndarray, np.ndarray, np.ndarray]


def terrain_features(
    heights_m: np.ndarray,
    spacing_m: float,
    *,
    sun_direction: ArrayLike | None = None,
    day_suns: ArrayLike | None = None,
) -> dict[str, np.ndarray]:
    """Compute terrain attributes of a height field.

    Parameters
    ----------
    heights_m
        ``(H, W)`` [m], row 0 in the north; NaN marks holes.
    spacing_m
        Cell size [m].
    sun_direction
        Unit vector ``(3,)`` east-north-up towards the sun at the time of the photographs. Adds ``sun``: cosine of the
        angle of incidence times visibility; ``sun_cosine``: the cosine alone, negative where the slope faces away;
        ``sun_margin``: solar elevation above the terrain's horizon [deg]; ``sun_around``: mean ``sun`` of the
        neighbourhood. The last two quantify the distance from a shadow's edge, on whose other side a texel may lie.
    day_suns
        ``(T, 3)`` solar directions of a day or a season, evenly spaced in time; those below the horizon count as dark.
        Adds ``insolation``: mean of cosine times visibility.

    Returns
    -------
    dict
        Layers ``(H, W)`` float32 by name, NaN where the heights are: ``elevation`` [m]; ``slope`` [deg];
        ``facing_east`` and ``facing_north``: sine and cosine of the aspect times the sine of the slope, 0 on level
        ground; ``curvature`` and ``hollow``: depth below the mean height of the neighbourhood and of the wider
        surroundings [m]; ``sky_view``: sky view factor (Dozier & Frew 1990, doi:10.1109/36.58986); and the layers of
        the sun directions.

    Raises
    ------
    ValueError
        No height is finite.
    """
    known = np.isfinite(heights_m)
    if not known.any():
        raise ValueError("terrain_features: no finite height")
    z = _fill_nearest(heights_m, known)
    # Smoothing suppresses mesh facets on finer grids, and aliasing on grids of nearly the same spacing as the mesh.
    smooth = cv2.GaussianBlur(z, (0, 0), 1.0, borderType=cv2.BORDER_REPLICATE)
    normal = _normals(smooth, spacing_m)
    layers = {
        "elevation": z,
        "slope": np.degrees(np.arccos(np.clip(normal[2], -1.0, 1.0))),
        "facing_east": normal[0],
        "facing_north": normal[1],
        "curvature": _depth(smooth, 3.0),
        "hollow": _depth(z, max(8.0, 250.0 / spacing_m)),
    }
    layers |= _horizon_layers(z, spacing_m, day_suns)
    if sun_direction is not None:
        sun = np.asarray(sun_direction, float)
        cosine = sum(axis * float(s) for axis, s in zip(normal, sun, strict=True))
        margin = sun_margin_deg(z, spacing_m, sun)
        direct = np.clip(margin / (2.0 * _PENUMBRA_DEG) + 0.5, 0.0, 1.0) * np.maximum(cosine, 0.0)
        around = cv2.GaussianBlur(direct.astype(np.float32), (0, 0), 2.0, borderType=cv2.BORDER_REPLICATE)
        layers |= {
            "sun_cosine": cosine,
            "sun_margin": np.clip(margin, -_MARGIN_DEG, _MARGIN_DEG),
            "sun": direct,
            "sun_around": around,
        }
    return {name: np.where(known, layer, np.nan).astype(np.float32) for name, layer in layers.items()}


def _fill_nearest(heights: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Fill holes with the height of the nearest known cell, so that they neither cast shadows nor form pits."""
    z = np.asarray(heights, np.float32)
    if known.all():
        return z
    from scipy.ndimage import distance_transform_edt

    nearest: Any = distance_transform_edt(~known, return_distances=False, return_indices=True)
    row, column = nearest
    return z[row, column]


def _normals(z: np.ndarray, spacing_m: float) -> _Normals:
    down, right = np.gradient(z, np.float32(spacing_m))
    up = 1.0 / np.sqrt(1.0 + down**2 + right**2)
    return -right * up, down * up, up


def _depth(z: np.ndarray, sigma_px: float) -> np.ndarray:
    """Gaussian mean of the surroundings minus the height [m]; wide blurs are computed at reduced resolution."""
    shrink = max(1, int(sigma_px // 4))
    if shrink == 1 or min(z.shape) < 4 * shrink:
        return cv2.GaussianBlur(z, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE) - z
    small = cv2.resize(z, (max(2, z.shape[1] // shrink), max(2, z.shape[0] // shrink)), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sigma_px / shrink, borderType=cv2.BORDER_REPLICATE)
    return cv2.resize(small, z.shape[::-1], interpolation=cv2.INTER_LINEAR) - z


def _shifted(z: np.ndarray, east_px: float, north_px: float) -> np.ndarray:
    """``z`` at positions shifted to the east and north; far below every height outside the grid."""
    move = np.array([[1.0, 0.0, east_px], [0.0, 1.0, -north_px]], np.float32)
    return cv2.warpAffine(
        z,
        move,
        z.shape[::-1],
        flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=-1e6,
    )


def horizon_tangent(
    z: np.ndarray, spacing_m: float, azimuth_rad: float, *, stride: float = _STRIDE, reach_m: float | None = None
) -> np.ndarray:
    """Compute the tangent of the horizon's elevation towards an azimuth.

    Parameters
    ----------
    z
        ``(H, W)`` heights [m], row 0 in the north.
    spacing_m
        Cell size [m].
    azimuth_rad
        Azimuth clockwise from north [rad].
    stride
        Ratio of successive distances.
    reach_m
        Greatest distance [m]; ``None`` for half the longer side of the grid.

    Returns
    -------
    ndarray
        ``(H, W)`` float32, at least 0.
    """
    limit_m = 0.5 * max(z.shape) * spacing_m if reach_m is None else reach_m
    east, north = float(np.sin(azimuth_rad)), float(np.cos(azimuth_rad))
    tangent, distance = np.zeros(z.shape, np.float32), 1.0
    while distance * spacing_m <= limit_m:
        rise = _shifted(z, east * distance, north * distance)
        rise -= z
        rise /= np.float32(distance * spacing_m)
        np.maximum(tangent, rise, out=tangent)
        distance = max(distance * stride, distance + 0.7)
    return tangent


def sun_margin_deg(z: np.ndarray, spacing_m: float, sun_direction: np.ndarray) -> np.ndarray:
    """Compute the elevation of the sun's centre above the terrain's horizon.

    Parameters
    ----------
    z
        ``(H, W)`` heights [m], row 0 in the north.
    spacing_m
        Cell size [m].
    sun_direction
        Unit vector ``(3,)`` east-north-up.

    Returns
    -------
    ndarray
        ``(H, W)`` float32 [deg]; negative in cast shadow.
    """
    east, north, up = (float(x) for x in sun_direction)
    horizontal = float(np.hypot(east, north))
    elevation_deg = float(np.degrees(np.arctan2(up, horizontal)))
    if up <= 0.0:
        return np.full(z.shape, elevation_deg, np.float32)
    reach_m = min(float(np.ptp(z)) * horizontal / up, float(np.hypot(*z.shape)) * spacing_m) + spacing_m
    # Terrain a little beyond the reach of its shadow stands just below the sun and determines small positive margins.
    reach_m *= 1.3
    tangent = horizon_tangent(z, spacing_m, float(np.arctan2(east, north)), stride=_SHADOW_STRIDE, reach_m=reach_m)
    return (elevation_deg - np.degrees(np.arctan(tangent))).astype(np.float32)


def _horizon_layers(z: np.ndarray, spacing_m: float, day_suns: ArrayLike | None) -> dict[str, np.ndarray]:
    """Layers ``sky_view`` and, where solar directions are given, ``insolation``, from horizons in all directions."""
    shrink = max(1, int(np.ceil(np.sqrt(z.size / _HORIZON_CELLS))))
    size = (max(2, -(-z.shape[1] // shrink)), max(2, -(-z.shape[0] // shrink)))
    small = z if shrink == 1 else cv2.resize(z, size, interpolation=cv2.INTER_AREA)
    cell_m = spacing_m * z.shape[1] / small.shape[1]
    normal = _normals(small, cell_m)
    azimuths = np.arange(_AZIMUTHS) * (2.0 * np.pi / _AZIMUTHS)
    horizons = [np.arctan(horizon_tangent(small, cell_m, a)) for a in azimuths]
    layers = {"sky_view": _sky_view(normal, azimuths, horizons)}
    if day_suns is not None:
        layers["insolation"] = _insolation(normal, horizons, np.atleast_2d(np.asarray(day_suns, float)))
    return {
        name: cv2.resize(layer.astype(np.float32), z.shape[::-1], interpolation=cv2.INTER_LINEAR)
        for name, layer in layers.items()
    }


def _sky_view(normal: _Normals, azimuths: np.ndarray, horizons: Sequence[np.ndarray]) -> np.ndarray:
    """Sky view factor by Dozier & Frew 1990, equation 7b, with the horizon's angle H from the zenith."""
    total = np.zeros_like(normal[0])
    for azimuth, horizon in zip(azimuths, horizons, strict=True):
        # The plane of the slope itself hides sky too.
        tilt = normal[0] * np.sin(azimuth) + normal[1] * np.cos(azimuth)
        zenith = np.minimum(np.pi / 2.0 - horizon, np.pi / 2.0 + np.arctan2(tilt, normal[2]))
        total += normal[2] * np.sin(zenith) ** 2 + tilt * (zenith - np.sin(zenith) * np.cos(zenith))
    return np.clip(total / len(horizons), 0.0, 1.0)


def _insolation(normal: _Normals, horizons: Sequence[np.ndarray], suns: np.ndarray) -> np.ndarray:
    """Mean over solar directions ``(T, 3)`` of the cosine of incidence times visibility."""
    total = np.zeros_like(normal[0])
    for east, north, up in suns[suns[:, 2] > 0.0]:
        position = np.arctan2(east, north) / (2.0 * np.pi) * len(horizons)
        low, fraction = int(np.floor(position)), float(position - np.floor(position))
        horizon = horizons[low % len(horizons)] * (1.0 - fraction) + horizons[(low + 1) % len(horizons)] * fraction
        visible = np.clip((np.arcsin(up) - horizon) / np.radians(_HORIZON_UNCERTAINTY_DEG) + 0.5, 0.0, 1.0)
        total += visible * np.maximum(east * normal[0] + north * normal[1] + up * normal[2], 0.0)
    return total / len(suns)
