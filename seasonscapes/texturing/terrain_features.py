"""What a heightfield tells of each of its places: form, sky in view, sun of an hour and of a day."""

from __future__ import annotations

import cv2
import numpy as np

# Horizons are searched on at most this many cells; what they decide is smooth.
_HORIZON_CELLS = 1_000_000
_AZIMUTHS = 16
_STRIDE = 1.35
_SHADOW_STRIDE = 1.06
# Half width of the soft edge of cast shadows [deg]: the sun's disc, and heights that are not exact.
_PENUMBRA_DEG = 0.7
# Margins beyond this say no more.
_MARGIN_DEG = 15.0


def terrain_features(
    heights_m: np.ndarray, spacing_m: float, *, sun_direction=None, day_suns=None
) -> dict[str, np.ndarray]:
    """Layers ``(H, W)`` float32 by name, NaN where the heights are.

    Parameters
    ----------
    heights_m
        ``(H, W)`` [m], row 0 in the north; NaN marks holes.
    spacing_m
        Cell size [m].
    sun_direction
        Unit vector ``(3,)`` east-north-up towards the sun of the picture. Gives ``sun``: cosine of incidence times
        visibility; ``sun_cosine`` alone, negative where the slope faces away; ``sun_margin``: the sun's height above
        the land's horizon [deg]; ``sun_around``: the mean ``sun`` of the neighbourhood. A texel close to a shadow's
        edge may lie on its other side; only the last two tell.
    day_suns
        ``(T, 3)`` sun directions of a day or a season, evenly spaced in time; those below the horizon count as dark.
        Gives ``insolation``: mean of cosine times visibility.

    Returns
    -------
    dict
        ``elevation`` [m]; ``slope`` [deg]; ``facing_east`` and ``facing_north``: sine and cosine of the aspect times
        the sine of the slope, so that level ground has none; ``curvature`` and ``hollow`` [m]: depth below the mean
        of the neighbours and of the wider surroundings; ``sky_view``: share of a diffuse sky's light
        (Dozier & Frew 1990, doi:10.1109/36.58986); and those of the suns.
    """
    known = np.isfinite(heights_m)
    if not known.any():
        raise ValueError("land_layers: no finite height")
    z = _filled(heights_m, known)
    # Texels finer than the mesh see facets, and grids that nearly match it see beats of the two.
    fine = cv2.GaussianBlur(z, (0, 0), 1.0, borderType=cv2.BORDER_REPLICATE)
    normal = _normals(fine, spacing_m)
    layers = {
        "elevation": z,
        "slope": np.degrees(np.arccos(np.clip(normal[2], -1.0, 1.0))),
        "facing_east": normal[0],
        "facing_north": normal[1],
        "curvature": _depth(fine, 3.0),
        "hollow": _depth(z, max(8.0, 250.0 / spacing_m)),
    }
    layers |= _open_to(z, spacing_m, day_suns)
    if sun_direction is not None:
        sun = np.asarray(sun_direction, float)
        cosine = sum(axis * float(s) for axis, s in zip(normal, sun, strict=True))
        margin = sun_margin_deg(z, spacing_m, sun)
        seen = np.clip(margin / (2.0 * _PENUMBRA_DEG) + 0.5, 0.0, 1.0) * np.maximum(cosine, 0.0)
        around = cv2.GaussianBlur(seen.astype(np.float32), (0, 0), 2.0, borderType=cv2.BORDER_REPLICATE)
        layers |= {
            "sun_cosine": cosine,
            "sun_margin": np.clip(margin, -_MARGIN_DEG, _MARGIN_DEG),
            "sun": seen,
            "sun_around": around,
        }
    return {name: np.where(known, layer, np.nan).astype(np.float32) for name, layer in layers.items()}


def _filled(heights: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Holes take the height of the nearest known cell: neither walls nor pits stand in the light."""
    z = np.asarray(heights, np.float32)
    if known.all():
        return z
    from scipy.ndimage import distance_transform_edt

    row, column = distance_transform_edt(~known, return_distances=False, return_indices=True)
    return z[row, column]


def _normals(z: np.ndarray, spacing_m: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    down, right = np.gradient(z, np.float32(spacing_m))
    up = 1.0 / np.sqrt(1.0 + down**2 + right**2)
    return -right * up, down * up, up


def _depth(z: np.ndarray, sigma_px: float) -> np.ndarray:
    """How far the surroundings lie above [m]; wide blurs work on a smaller picture."""
    shrink = max(1, int(sigma_px // 4))
    if shrink == 1 or min(z.shape) < 4 * shrink:
        return cv2.GaussianBlur(z, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE) - z
    small = cv2.resize(z, (max(2, z.shape[1] // shrink), max(2, z.shape[0] // shrink)), interpolation=cv2.INTER_AREA)
    small = cv2.GaussianBlur(small, (0, 0), sigma_px / shrink, borderType=cv2.BORDER_REPLICATE)
    return cv2.resize(small, z.shape[::-1], interpolation=cv2.INTER_LINEAR) - z


def _shifted(z: np.ndarray, east_px: float, north_px: float) -> np.ndarray:
    """``z`` at the places that lie so far to the east and north; beyond the edge the land ends in the depth."""
    move = np.float32([[1.0, 0.0, east_px], [0.0, 1.0, -north_px]])
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
    """Tangent of the horizon's elevation towards an azimuth ``(H, W)``, at least 0; steps grow by ``stride``."""
    if reach_m is None:
        reach_m = 0.5 * max(z.shape) * spacing_m
    east, north = float(np.sin(azimuth_rad)), float(np.cos(azimuth_rad))
    tangent, distance = np.zeros(z.shape, np.float32), 1.0
    while distance * spacing_m <= reach_m:
        rise = _shifted(z, east * distance, north * distance)
        rise -= z
        rise /= np.float32(distance * spacing_m)
        np.maximum(tangent, rise, out=tangent)
        distance = max(distance * stride, distance + 0.7)
    return tangent


def sun_margin_deg(z: np.ndarray, spacing_m: float, sun_direction: np.ndarray) -> np.ndarray:
    """How far the sun's centre stands above the land's horizon ``(H, W)`` [deg]; negative in cast shadow."""
    east, north, up = (float(x) for x in sun_direction)
    flat = float(np.hypot(east, north))
    elevation_deg = float(np.degrees(np.arctan2(up, flat)))
    if up <= 0.0:
        return np.full(z.shape, elevation_deg, np.float32)
    reach_m = min(float(np.ptp(z)) * flat / up, float(np.hypot(*z.shape)) * spacing_m) + spacing_m
    # Land just above the sun decides as well how deep a shadow is.
    reach_m *= 1.3
    tangent = horizon_tangent(z, spacing_m, float(np.arctan2(east, north)), stride=_SHADOW_STRIDE, reach_m=reach_m)
    return (elevation_deg - np.degrees(np.arctan(tangent))).astype(np.float32)


def _open_to(z: np.ndarray, spacing_m: float, day_suns) -> dict[str, np.ndarray]:
    """``sky_view`` and, where suns are given, ``insolation``, from horizons in all directions."""
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


def _sky_view(normal, azimuths, horizons) -> np.ndarray:
    """Dozier & Frew 1990, equation 7b, with the horizon's angle H from the zenith."""
    total = np.zeros_like(normal[0])
    for azimuth, horizon in zip(azimuths, horizons, strict=True):
        # A slope's own plane hides sky as the land does.
        tilt = normal[0] * np.sin(azimuth) + normal[1] * np.cos(azimuth)
        zenith = np.minimum(np.pi / 2.0 - horizon, np.pi / 2.0 + np.arctan2(tilt, normal[2]))
        total += normal[2] * np.sin(zenith) ** 2 + tilt * (zenith - np.sin(zenith) * np.cos(zenith))
    return np.clip(total / len(horizons), 0.0, 1.0)


def _insolation(normal, horizons, suns: np.ndarray) -> np.ndarray:
    total = np.zeros_like(normal[0])
    for east, north, up in suns[suns[:, 2] > 0.0]:
        turn = np.arctan2(east, north) / (2.0 * np.pi) * len(horizons)
        low, share = int(np.floor(turn)), float(turn - np.floor(turn))
        horizon = horizons[low % len(horizons)] * (1.0 - share) + horizons[(low + 1) % len(horizons)] * share
        # A horizon between two azimuths is known to a few degrees only.
        seen = np.clip((np.arcsin(up) - horizon) / np.radians(6.0) + 0.5, 0.0, 1.0)
        total += seen * np.maximum(east * normal[0] + north * normal[1] + up * normal[2], 0.0)
    return total / len(suns)
