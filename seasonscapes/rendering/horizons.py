"""Skylight on land that is a height field, from its horizon: above it the sky is seen in every direction, below it nowhere.

From a point on a height field a direction that is free stays free when it is raised. What the point receives of the sky
follows from its horizon at some azimuths, which bisection with few rays finds, and from integrals over elevation that are
tabulated (cf. Dozier & Frew 1990, doi:10.1109/36.58986). Of as many rays distributed over the hemisphere most would tell
nothing: only those near the horizon do.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.rendering.backend import point3
from seasonscapes.rendering.hemisphere_rays import LANES, RayScene, SurfacePoints
from seasonscapes.rendering.sky_patches import SkyPatches
from seasonscapes.rendering.sobol import hash_to_unit, hashed, uniform
from seasonscapes.rendering.terrain_material import device_surface

# Spacings of the table, which a processor's cache holds: its azimuths are means of three, between which all borders of
# patches lie.
_AZIMUTH_DEG, _ELEVATION_DEG = 1.5, 2.0
# Bisections of the range between the surface's own plane and the zenith: cells of some 3°, shifted at random.
_STEPS = 5
# Key of the random number stream, mixed into its hashes.
_HORIZON = 107


@dataclass(frozen=True)
class SkyAbove:
    """Integrals of a directional basis over the sky above an elevation, at tabulated azimuths.

    Parameters
    ----------
    table
        ``(azimuths, elevations, 2, r + 1)`` float32: of cos² and of sin · cos of the elevation, times r functions and 1.
    """

    table: np.ndarray


def is_height_field(terrain: RayScene) -> bool:
    """Whether a terrain is the surface of heights, without walls or overhangs."""
    return device_surface(terrain.mi_terrain.bsdf()) is not None


def sky_above(patches: SkyPatches, functions: np.ndarray) -> SkyAbove:
    """Tabulate the integrals of functions of direction that are constant over patches.

    Parameters
    ----------
    patches
        The P patches.
    functions
        ``(P, r)`` values.

    Returns
    -------
    SkyAbove
        For `sky_coefficients`.
    """
    elevation = np.radians(np.arange(-90.0, 90.0 + 0.5 * _ELEVATION_DEG, _ELEVATION_DEG))
    upper, lower = np.radians(patches.edges_deg[:-1]), np.radians(patches.edges_deg[1:])
    start = np.clip(elevation[:, None], lower, upper)

    def antiderivatives(angle: np.ndarray) -> np.ndarray:
        return np.stack([0.5 * angle + 0.25 * np.sin(2.0 * angle), 0.5 * np.sin(angle) ** 2])

    # Of each row of patches, what lies above each elevation.
    above = antiderivatives(np.broadcast_to(upper, start.shape)) - antiderivatives(start)
    azimuth_deg = (np.arange(3 * round(360.0 / _AZIMUTH_DEG)) + 0.5) * _AZIMUTH_DEG / 3.0
    patch = patches.offsets + (azimuth_deg[:, None] * patches.counts / 360.0).astype(int)
    values = np.concatenate([functions, np.ones((len(functions), 1))], axis=1)[patch]
    values = values.reshape(-1, 3, *values.shape[1:]).mean(axis=1)
    return SkyAbove(np.einsum("ker,arf->aekf", above, values, optimize=True).astype(np.float32))


def sky_coefficients(
    terrain: RayScene,
    above: SkyAbove,
    points: SurfacePoints,
    weight: np.ndarray,
    *,
    azimuths: int,
    turn: np.ndarray,
    key: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Coefficients of the light that receivers on a height field get from the sky.

    Parameters
    ----------
    terrain
        The terrain; see `is_height_field`.
    above
        From `sky_above`, of r functions.
    points
        ``(N, S)`` surface points of N receivers.
    weight
        ``(N, S)`` their weights.
    azimuths
        Number of azimuths at which the horizon is searched, a power of two: evenly spaced, each from a point that is drawn in
        proportion to its weight.
    turn
        ``(N,)`` float32 offset of each receiver's azimuths, in spaces between them.
    key
        ``(N,)`` uint32 keys of the receivers' random numbers.

    Returns
    -------
    coefficients
        ``(N, r)`` float32: integrals over the visible sky of function × cosine of incidence / π.
    sky_share
        ``(N,)`` float32 share of the cosine-weighted hemisphere that is sky.
    """
    count, samples = weight.shape
    table = above.table.reshape(-1, above.table.shape[3])
    result = np.empty((count, table.shape[1]), np.float32)
    step = max(1, LANES // azimuths)
    for start in range(0, count, step):
        part = slice(start, start + step)
        chosen = _drawn(weight[part], azimuths, key[part])
        # All receivers at one azimuth after those at another: neighbouring rays are almost parallel.
        flat = points[part].reshape(-1)[(np.arange(len(chosen)) * samples + chosen.T).ravel()]
        result[part] = _integrals(table, azimuths, *_horizons(terrain, flat, azimuths, turn[part], key[part]))
    result *= weight.sum(axis=1, keepdims=True) * np.float32(2.0 / azimuths)
    return result[:, :-1], result[:, -1]


def _drawn(weight: np.ndarray, azimuths: int, key: np.ndarray) -> np.ndarray:
    """Systematic sample ``(N, azimuths)`` of indices in proportion to weights ``(N, S)``."""
    index = np.zeros((len(weight), azimuths), np.intp)
    if weight.shape[1] == 1:
        return index
    total = np.cumsum(weight, axis=1, dtype=np.float32)
    # Neighbouring azimuths use points that are far apart in the list (van der Corput's order).
    bits = azimuths.bit_length() - 1
    order = [int(f"{number:0{bits}b}"[::-1], 2) for number in range(azimuths)]
    place = (np.array(order, np.float32) + hash_to_unit(key, _HORIZON)[:, None]) / azimuths * total[:, -1:]
    for column in total[:, :-1].T:
        index += place >= column[:, None]
    return index


def _horizons(
    terrain: RayScene, points: SurfacePoints, azimuths: int, turn: np.ndarray, key: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Horizons of receivers at their azimuths, from a point for each.

    Returns the azimuth [rad], the elevation of the horizon or of the point's own plane where that is higher [rad], and the
    components of the normal along the azimuth and upwards, each ``(N · azimuths,)`` float32, of one receiver side by side.
    """
    import drjit as dr
    import mitsuba as mi

    lane = dr.arange(mi.UInt32, len(points.origin))
    receivers = dr.opaque(mi.UInt32, len(turn))
    number = lane // receivers
    receiver = lane - number * receivers
    mi_key = hashed(dr.gather(mi.UInt32, mi.UInt32(key), receiver), _HORIZON)
    place = mi.Float(number) + dr.gather(mi.Float, mi.Float(turn % 1.0), receiver)
    azimuth = place * dr.opaque(mi.Float, 2.0 * np.pi / azimuths)
    east, north = dr.sincos(azimuth)
    normal = point3(points.normal)
    along, upward = normal.x * east + normal.y * north, dr.maximum(normal.z, 1e-3)
    plane = dr.atan2(-along, upward)
    # Cells of equal height from the plane to the zenith, shifted by a random part of a cell: without it, all horizons
    # of a slope would be rounded to the same ones.
    cell = (0.5 * np.pi - plane) / (2**_STEPS - 1)
    shift = uniform(hashed(mi_key, number))
    below, origin = mi.Float(0.0), point3(points.origin)
    for bit in reversed(range(_STEPS)):
        border = below + float(2**bit)
        elevation = plane + (border - shift) * cell
        sine, cosine = dr.sincos(elevation)
        inside = (elevation > plane) & (elevation < 0.5 * np.pi)
        ray = mi.Ray3f(origin, mi.Vector3f(east * cosine, north * cosine, sine))
        hidden = terrain.mi_scene.ray_test(ray, active=inside) | (elevation <= plane)
        below = dr.select(hidden, border, below)
    horizon = dr.clip(plane + (below + 0.5 - shift) * cell, plane, 0.5 * np.pi)
    lanes = (azimuth, horizon, along, upward)
    dr.eval(lanes)
    azimuth_rad, horizon_rad, normal_along, normal_up = (
        np.ascontiguousarray(np.array(values).reshape(azimuths, -1).T).ravel() for values in lanes
    )
    return azimuth_rad, horizon_rad, normal_along, normal_up


def _integrals(
    table: np.ndarray, azimuths: int, azimuth: np.ndarray, horizon: np.ndarray, along: np.ndarray, upward: np.ndarray
) -> np.ndarray:
    """Sums ``(N, r + 1)`` over the azimuths of tabulated integrals above horizons, linear between tabulated elevations."""
    from scipy import sparse

    columns, elevations = round(360.0 / _AZIMUTH_DEG), round(180.0 / _ELEVATION_DEG) + 1
    column = np.minimum((azimuth * np.float32(np.degrees(1.0) / _AZIMUTH_DEG)).astype(np.int32), columns - 1)
    place = (horizon * np.float32(np.degrees(1.0)) + np.float32(90.0)) / np.float32(_ELEVATION_DEG)
    lower = np.clip(place.astype(np.int32), 0, elevations - 2)
    share = place - lower
    index = ((column * elevations + lower) * 2)[:, None] + np.arange(4, dtype=np.int32)
    weight = np.stack([along * (1.0 - share), upward * (1.0 - share), along * share, upward * share], axis=1)
    start = np.arange(0, weight.size + 1, 4 * azimuths, dtype=np.int32)
    return sparse.csr_array((weight.ravel(), index.ravel(), start), shape=(len(start) - 1, len(table))) @ table
