"""The ways of light through spherical air: curved rays, and the columns of air between any point and the sun."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.sky.atmosphere import TOP_HEIGHT_M, Atmosphere, Optics, constituent_densities, refractivity

SUN_RADIUS_DEG = 0.26656  # at 1 au
SUN_HEIGHTS, SUN_ELEVATIONS = 56, 160
_LEAST_COLUMN = 1e-12


@dataclass(frozen=True)
class CurvedRays:
    """Rays traced from their starting points until they leave the air or meet the ground.

    Parameters
    ----------
    distance_m, height_m, turn_rad, elevation_rad
        Along each ray ``(K, S + 1)``: arc length, height, angle travelled about the Earth's centre, and elevation of
        the ray above the local horizontal. Constant beyond a ray's end.
    ends_on_ground
        ``(K,)``.
    """

    distance_m: np.ndarray
    height_m: np.ndarray
    turn_rad: np.ndarray
    elevation_rad: np.ndarray
    ends_on_ground: np.ndarray


@dataclass(frozen=True)
class SunColumns:
    """Columns of air towards the sun, for every height and true elevation of the sun above the local horizontal.

    The grid is uniform in the cube root of height, and in the cube root of elevation above the lowest ray that
    clears the ground.

    Parameters
    ----------
    lowest_rad
        True elevation ``(P,)`` of a star whose refracted ray grazes the ground.
    log_columns
        ``(P, Q, 4)``: logarithms of the three constituents' columns in units of their vertical columns, and of the
        brightening by refraction, ``d apparent / d true`` elevation.
    """

    lowest_rad: np.ndarray
    log_columns: np.ndarray


def horizon_elevation_rad(atmosphere: Atmosphere, height_m) -> np.ndarray:
    """Apparent elevation of the ray that grazes the ground, from Bouguer's invariant ``n r cos e``."""
    ground, radius = atmosphere.ground_radius_m, atmosphere.ground_radius_m - atmosphere.ground_height_m
    index_ratio = (1.0 + refractivity(atmosphere, atmosphere.ground_height_m)[0]) / (
        1.0 + refractivity(atmosphere, height_m)[0]
    )
    return -np.arccos(np.minimum(index_ratio * ground / (radius + np.asarray(height_m, float)), 1.0))


def trace_curved_rays(atmosphere: Atmosphere, height_m, elevation_rad, *, floor_m: float | None = None) -> CurvedRays:
    """Trace rays ``(K,)`` from heights [m] at apparent elevations [rad] by the midpoint rule.

    They end at the top of the air, or at a floor: the atmosphere's ground where left out.

    Ray equations in spherical air, ``s`` the arc length and ``n' = dn/dr``:
    ``dr/ds = sin e``, ``dψ/ds = cos e / r``, ``de/ds = cos e (1/r + n'/n)``.
    """
    height, elevation = (np.array(x, float) for x in np.broadcast_arrays(height_m, elevation_rad))
    centre = atmosphere.ground_radius_m - atmosphere.ground_height_m
    ground = atmosphere.ground_height_m if floor_m is None else floor_m
    distance, turn = np.zeros_like(height), np.zeros_like(height)
    states, on_ground = [(distance, height, turn, elevation)], np.zeros(height.shape, bool)
    alive = np.ones(height.shape, bool)

    def slopes(h, e):
        index, gradient = refractivity(atmosphere, h)
        along = np.cos(e) / (centre + h)
        return np.sin(e), along, along + np.cos(e) * gradient / (1.0 + index)

    while alive.any():
        above = np.maximum(height - atmosphere.ground_height_m, 0.0)
        step = np.minimum((40.0 + 0.04 * above) / (np.abs(np.sin(elevation)) + 0.02), 15e3)
        rise, _, bend = slopes(height, elevation)
        rise, along, bend = slopes(height + 0.5 * step * rise, elevation + 0.5 * step * bend)
        leaving = height + step * rise
        hits, exits = leaving < ground, (leaving > TOP_HEIGHT_M) & (rise > 0.0)
        reach = np.where(hits, ground, TOP_HEIGHT_M)
        share = np.where(hits | exits, (reach - height) / np.where(rise == 0.0, 1.0, step * rise), 1.0)
        step = np.where(alive, step * np.clip(share, 0.0, 1.0), 0.0)
        distance, height = distance + step, height + step * rise
        turn, elevation = turn + step * along, elevation + step * bend
        on_ground |= alive & hits
        alive = alive & ~(hits | exits)
        states.append((distance, height, turn, elevation))
    arrays = (np.stack(parts, axis=-1) for parts in zip(*states, strict=True))
    return CurvedRays(*arrays, on_ground)


def resampled(paths: CurvedRays, distance_m: np.ndarray) -> CurvedRays:
    """The same rays at other distances ``(K, M)`` [m], held at their ends."""
    fields = (paths.height_m, paths.turn_rad, paths.elevation_rad)
    out = [np.empty(distance_m.shape) for _ in fields]
    for k, wanted in enumerate(distance_m):
        # Beyond the end, distances repeat; interpolate over the living part alone.
        alive = np.r_[True, np.diff(paths.distance_m[k]) > 0.0]
        for target, source in zip(out, fields, strict=True):
            target[k] = np.interp(wanted, paths.distance_m[k][alive], source[k][alive])
    return CurvedRays(np.minimum(distance_m, paths.distance_m[:, -1:]), *out, paths.ends_on_ground)


def equal_cells(atmosphere: Atmosphere, paths: CurvedRays, cells: int) -> np.ndarray:
    """Edges ``(K, cells + 1)`` [m] that share out each ray evenly by where light is made and lost.

    The measure is a sum of air, aerosol, ozone and plain height, so that no part of a ray is passed over.
    """
    centre = 0.5 * (paths.height_m[:, 1:] + paths.height_m[:, :-1])
    length = np.diff(paths.distance_m, axis=1)
    above = np.maximum(centre - atmosphere.ground_height_m, 0.0)
    scale = min(atmosphere.aerosol_scale_height_m, 8e3)
    weight = np.exp(-above / scale) / scale + np.exp(-above / 8e3) / 8e3 + np.exp(-above / 25e3) / 25e3
    # The small terms keep rays of no length, upwards from the top, well defined.
    weight = (weight * length + 1e-9) / np.sum(weight * length + 1e-9, axis=1, keepdims=True)
    # Even in distance for a share: far limbs seen from above, and the last thin stretch.
    weight = 0.8 * weight + 0.2 * (length + 1e-3) / np.sum(length + 1e-3, axis=1, keepdims=True)
    total = np.concatenate([np.zeros((len(weight), 1)), np.cumsum(weight, axis=1)], axis=1)
    targets = np.linspace(0.0, 1.0, cells + 1)
    edges = [np.interp(targets, t, d) for t, d in zip(total, paths.distance_m, strict=True)]
    return np.array(edges)


def sun_columns(atmosphere: Atmosphere) -> SunColumns:
    """Tabulate the columns of air towards the sun along refracted rays."""
    heights = atmosphere.ground_height_m + _thickness_m(atmosphere) * np.linspace(0.0, 1.0, SUN_HEIGHTS) ** 3
    share = np.linspace(0.0, 1.0, SUN_ELEVATIONS)
    horizon = horizon_elevation_rad(atmosphere, heights)
    apparent = horizon[:, None] + (np.pi / 2 - horizon[:, None]) * share**3
    paths = trace_curved_rays(atmosphere, np.repeat(heights, len(share)), apparent.ravel(), floor_m=-np.inf)
    columns = np.zeros((3, paths.distance_m.shape[0]))
    for s in range(paths.distance_m.shape[1] - 1):
        step = paths.distance_m[:, s + 1] - paths.distance_m[:, s]
        columns += constituent_densities(atmosphere, 0.5 * (paths.height_m[:, s] + paths.height_m[:, s + 1])) * step
    columns = columns.reshape(3, *apparent.shape)
    true = (paths.elevation_rad[:, -1] - paths.turn_rad[:, -1]).reshape(apparent.shape)
    true[:, -1] = np.pi / 2
    brightening = np.gradient(apparent, axis=1) / np.gradient(true, axis=1)
    table = np.empty((*apparent.shape, 4))
    for p, (e, low) in enumerate(zip(true, true[:, 0], strict=True)):
        wanted = low + (np.pi / 2 - low) * share**3
        for q, values in enumerate((*columns[:, p], brightening[p])):
            table[p, :, q] = np.interp(wanted, e, np.log(np.maximum(values, _LEAST_COLUMN)))
    return SunColumns(true[:, 0], table)


def towards_sun(
    atmosphere: Atmosphere, columns: SunColumns, height_m, elevation_rad, *, radius_deg: float = SUN_RADIUS_DEG
) -> tuple[np.ndarray, np.ndarray]:
    """Columns of air between points and the sun, and how much of the sun's disc is there to be seen.

    Parameters
    ----------
    height_m, elevation_rad
        Of the points, and of the sun's centre as it would stand without refraction ``(...)``.

    Returns
    -------
    columns
        ``(..., 3)`` along the refracted ray, in units of the vertical columns.
    share
        ``(...)`` the part of the disc above the ground's horizon, times the brightening by refraction. The columns are
        those towards the middle of that part: the disc sets gradually.
    """
    heights, elevations = columns.log_columns.shape[:2]
    above = np.clip((np.asarray(height_m) - atmosphere.ground_height_m) / _thickness_m(atmosphere), 0.0, 1.0)
    row = np.cbrt(above) * (heights - 1)
    row0 = np.minimum(row.astype(np.int32), heights - 2)
    fr = row - row0
    lowest = columns.lowest_rad[row0] * (1.0 - fr) + columns.lowest_rad[row0 + 1] * fr
    visible, centre = _disc_above(np.asarray(elevation_rad) - lowest, np.radians(radius_deg))
    column = np.cbrt(np.clip(centre / (np.pi / 2 - lowest), 0.0, 1.0)) * (elevations - 1)
    column0 = np.minimum(column.astype(np.int32), elevations - 2)
    fc = (column - column0)[..., None]
    table, index = columns.log_columns.reshape(-1, 4), row0 * elevations + column0
    near = table[index] * (1.0 - fc) + table[index + 1] * fc
    far = table[index + elevations] * (1.0 - fc) + table[index + elevations + 1] * fc
    mixed = np.exp(near * (1.0 - fr)[..., None] + far * fr[..., None])
    return mixed[..., :3], mixed[..., 3] * visible


def sun_transfer(
    atmosphere: Atmosphere,
    columns: SunColumns,
    optics: Optics,
    height_m,
    elevation_rad,
    *,
    radius_deg: float = SUN_RADIUS_DEG,
) -> np.ndarray:
    """Share of the sun's normal irradiance that arrives at points, per band ``(..., B)``: Beer's law.

    Parameters as in `towards_sun`.
    """
    column, share = towards_sun(atmosphere, columns, height_m, elevation_rad, radius_deg=radius_deg)
    return np.exp(-(column @ optics.extinction)) * share[..., None]


def _thickness_m(atmosphere: Atmosphere) -> float:
    return TOP_HEIGHT_M - atmosphere.ground_height_m


def _disc_above(elevation_rad: np.ndarray, radius_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Share of a disc above a straight horizon, and the elevation of that share's centroid above it [rad]."""
    x = np.clip(elevation_rad / radius_rad, -1.0, 1.0)
    chord = np.sqrt(1.0 - x**2)
    share = (np.arccos(-x) + x * chord) / np.pi
    lift = 2.0 / (3.0 * np.pi) * chord**3 / np.maximum(share, 1e-9)
    return share, np.maximum(elevation_rad + radius_rad * lift, 0.0)
