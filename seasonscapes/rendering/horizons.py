"""Light that land receives which is a height field, from its horizon: above it there is sky in every direction, below it land.

From a point on a height field a direction that is free stays free when it is raised (Max 1988, doi:10.1007/BF01905562).
What the point receives of the sky follows from its horizon at some azimuths, which few rays find near that of a neighbour, and from
integrals over elevation that are tabulated (cf. Dozier & Frew 1990, doi:10.1109/36.58986). What land it sees is told by
rays below the horizon. Of as many rays distributed over the hemisphere most would tell nothing: they reach the sky far
above the horizon.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from seasonscapes.rendering.backend import aligned, point3
from seasonscapes.rendering.hemisphere_rays import ABSORBED, ESCAPED, LANES, RayScene, SurfacePoints, diffuse_points
from seasonscapes.rendering.morton import ground_order
from seasonscapes.rendering.sky_patches import SkyPatches, patch_sums
from seasonscapes.rendering.sobol import hash_to_unit, hashed, uniform
from seasonscapes.rendering.terrain_material import device_surface

# Spacings of the table, which a processor's cache holds: its azimuths are means of three, between which all borders of
# patches lie.
_AZIMUTH_DEG, _ELEVATION_DEG = 1.5, 2.0
# Cells of the range between the surface's own plane and the zenith: some 3°, shifted at random.
_CELLS = 32
# Of each eighth receiver the horizons are searched by bisection, those of the others near them.
_STRIDE = 8
_GOLDEN = 0.618034
# Keys of the random number streams, mixed into their hashes.
_HORIZON, _LAND = 107, 109


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
        For `trace_horizons`.
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


@dataclass(frozen=True)
class HorizonTransport:
    """What N receivers on a height field see.

    Parameters
    ----------
    coefficients
        ``(N, r)`` float32: integrals over the visible sky of function × cosine of incidence / π.
    sky_share
        ``(N,)`` float32 share of the cosine-weighted hemisphere that is sky.
    hit
        ``(N, K)`` int32 cluster of faces that each of K rays below the horizon hits, negative for none.
    ray_weight
        ``(N, K)`` float32 share of the cosine-weighted hemisphere that each of these rays stands for.
    """

    coefficients: np.ndarray
    sky_share: np.ndarray
    hit: np.ndarray
    ray_weight: np.ndarray


def trace_horizons(
    terrain: RayScene,
    above: SkyAbove,
    points: SurfacePoints,
    weight: np.ndarray,
    *,
    azimuths: int,
    land_rays: int,
    turn: np.ndarray,
    key: np.ndarray,
    mi_face_cluster: Any,
) -> HorizonTransport:
    """Find the horizons of receivers on a height field, what they get from the sky, and the land that they see.

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
    land_rays
        Rays below the horizon per azimuth in the mean: more of them at azimuths with more land.
    turn
        ``(N,)`` float32 offset of each receiver's azimuths, in spaces between them.
    key
        ``(N,)`` uint32 keys of the receivers' random numbers.
    mi_face_cluster
        ``mi.UInt32`` cluster of each face.

    Returns
    -------
    HorizonTransport
        Light from the sky, and rays to land.
    """
    points = diffuse_points(terrain, points)
    count, samples = weight.shape
    table = above.table.reshape(-1, above.table.shape[3])
    sums = np.empty((count, table.shape[1]), np.float32)
    hit = np.empty((count, azimuths * land_rays), np.int32)
    ray_weight = np.empty(hit.shape, np.float32)
    step = max(1, LANES // azimuths)
    # Neighbours on the ground one after the other: their rays visit the same nodes of the tree, and one's horizon tells the next one's.
    order = ground_order(points.origin[:, 0])
    for start in range(0, count, step):
        part = order[start : start + step]
        chosen = _drawn(weight[part], azimuths, key[part])
        # All receivers at one azimuth after those at another: neighbouring rays are almost parallel.
        index = (part * samples + chosen.T).ravel()
        origin, normal = (np.take(each.reshape(-1, 3), index, axis=0) for each in (points.origin, points.normal))
        lanes = _HorizonLanes(origin, normal, azimuths, turn[part], key[part])
        horizon, bound = lanes.horizon(terrain)
        measure = lanes.land(bound)
        rows = lanes.by_receiver([lanes.azimuth, horizon, lanes.along, lanes.upward, measure])
        sums[part] = _integrals(table, azimuths, *(values.ravel() for values in rows[:4]))
        lane, number = _divided(rows[4], hit.shape[1], hash_to_unit(key[part], _LAND))
        hit[part[lane % len(chosen)], number] = lanes.clusters(terrain, bound, measure, lane, number, mi_face_cluster)
        ray_weight[part] = rows[4].mean(axis=1, keepdims=True)
    ray_weight /= np.float32(land_rays)
    scale = weight.sum(axis=1, keepdims=True) * np.float32(2.0 / azimuths)
    sums *= scale
    ray_weight *= scale
    return HorizonTransport(sums[:, :-1], sums[:, -1], hit, ray_weight)


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


def _divided(measure: np.ndarray, rays: int, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Divide rays of equal weight among azimuths, in proportion to measures ``(N, azimuths)``.

    A systematic sample, shifted by ``place`` ``(N,)`` in [0, 1): the lane of each of the ``N rays`` rays, as in `_HorizonLanes`
    and sorted, since neighbouring rays of one azimuth cost less; and its number among those of its receiver.
    """
    count, azimuths = measure.shape
    total = np.cumsum(measure, axis=1, dtype=np.float32)
    edge = np.zeros((azimuths + 1, count), np.int32)
    edge[1:] = np.ceil(total.T * (rays / np.maximum(total[:, -1], 1e-20)) - place)
    edge[-1] = rays
    np.clip(edge, 0, rays, out=edge)
    of_lane = np.diff(edge, axis=0).ravel()
    lane = np.repeat(np.arange(len(of_lane)), of_lane)
    first = np.repeat(edge[:-1].ravel() - (np.cumsum(of_lane) - of_lane), of_lane)
    return lane, first + np.arange(len(lane))


class _HorizonLanes:
    """Lanes on the device, one for each azimuth of each receiver, with a surface point for each: ``origin`` and ``normal``."""

    def __init__(
        self, origin: np.ndarray, normal: np.ndarray, azimuths: int, turn: np.ndarray, key: np.ndarray
    ) -> None:
        import drjit as dr
        import mitsuba as mi

        self._azimuths, self._count = azimuths, len(turn)
        # No literal, for which kernels would be compiled anew.
        self._receivers = dr.opaque(mi.UInt32, self._count)
        lane = dr.arange(mi.UInt32, len(origin))
        number = lane // self._receivers
        receiver = lane - number * self._receivers
        self._turn = mi.Float(aligned(turn % 1.0))
        turned = dr.gather(mi.Float, self._turn, receiver)
        mi_key = hashed(hashed(dr.gather(mi.UInt32, mi.UInt32(aligned(key, np.uint32)), receiver), _HORIZON), number)
        self.azimuth = (mi.Float(number) + turned) * dr.opaque(mi.Float, 2.0 * np.pi / azimuths)
        self._north_east = dr.sincos(self.azimuth)[::-1]
        self._origin, mi_normal = point3(origin), point3(normal)
        north, east = self._north_east
        self.along, self.upward = mi_normal.x * east + mi_normal.y * north, dr.maximum(mi_normal.z, 1e-3)
        self._plane = dr.atan2(-self.along, self.upward)
        self._shift = uniform(mi_key)

    def by_receiver(self, lanes: list[Any]) -> list[np.ndarray]:
        """Values of lanes as arrays ``(N, azimuths)``."""
        import drjit as dr

        dr.eval(lanes)
        return [np.ascontiguousarray(np.array(values).reshape(self._azimuths, -1).T) for values in lanes]

    def horizon(self, terrain: RayScene) -> tuple[Any, Any]:
        """Elevation of the horizon [rad], or of the point's own plane where that is higher, and what no land rises above."""
        import drjit as dr

        # The horizon of the nearest of a few receivers is a guess from which that of the others is found with half of the rays.
        some = self._searched(terrain, _STRIDE, None)
        below = self._searched(terrain, 1, some)
        horizon, bound = (self._elevation(below, place) for place in (0.5, 1.0))
        dr.eval(horizon, bound)
        return horizon, bound

    def _elevation(self, cell: Any, place: float, lane: Any = None) -> Any:
        """Elevation [rad] of a place in cells of equal height from the plane to the zenith, above the plane at least."""
        import drjit as dr
        import mitsuba as mi

        plane, shift = (v if lane is None else dr.gather(mi.Float, v, lane) for v in (self._plane, self._shift))
        return dr.clip(plane + (cell + place - shift) * _cell_height(plane), plane, 0.5 * np.pi)

    def _searched(self, terrain: RayScene, stride: int, known: Any) -> Any:
        """Cells ``mi.Int32`` in which the horizons of each ``stride``-th receiver lie.

        ``known``: those of each `_STRIDE`-th, near which they are searched; ``None``: by bisection.
        """
        import drjit as dr
        import mitsuba as mi

        some = -(-self._count // stride)
        lane = dr.arange(mi.UInt32, self._azimuths * some)
        number = lane // dr.opaque(mi.UInt32, some)
        receiver = (lane - number * dr.opaque(mi.UInt32, some)) * dr.opaque(mi.UInt32, stride)
        lane = number * self._receivers + receiver
        plane, shift, north, east = (
            dr.gather(mi.Float, v, lane) for v in (self._plane, self._shift, *self._north_east)
        )
        origin, height = dr.gather(mi.Point3f, self._origin, lane), _cell_height(plane)
        # Cells are shifted by a random part of one: without it, all horizons of a slope would be rounded to the same ones.
        # The border `low` is hidden, `high` is not. Steps from the first border double until they pass the horizon.
        low, high, border, step = (
            dr.full(mi.Int32, value, dr.width(lane))
            for value in (0, _CELLS, _CELLS // 2, _CELLS if known is None else 1)
        )
        if known is not None:
            guess = (self._guess(known, number, receiver) - plane) / height + shift
            border = dr.clip(mi.Int32(dr.round(guess)), 1, _CELLS - 1)
            found, some = receiver % _STRIDE == 0, dr.opaque(mi.UInt32, -(-self._count // _STRIDE))
            cell = dr.gather(mi.Int32, known, number * some + receiver // _STRIDE, found)
            low, high = dr.select(found, cell, low), dr.select(found, cell + 1, high)

        def searching(low: Any, high: Any, border: Any, step: Any) -> Any:
            return high - low > 1

        def narrowed(low: Any, high: Any, border: Any, step: Any) -> tuple[Any, Any, Any, Any]:
            elevation = plane + (border - shift) * height
            inside = (elevation > plane) & (elevation < 0.5 * np.pi)
            ray = _ray(origin, north, east, elevation)
            hidden = terrain.mi_scene.ray_test(ray, active=inside) | (elevation <= plane)
            low, high = dr.select(hidden, border, low), dr.select(hidden, high, border)
            stepped = border + dr.select(hidden, step, -step)
            return low, high, dr.select((stepped > low) & (stepped < high), stepped, (low + high) // 2), 2 * step

        low, *_ = dr.while_loop((low, high, border, step), searching, narrowed)
        dr.eval(low)
        return low

    def _guess(self, known: Any, number: Any, receiver: Any) -> Any:
        """Elevation [rad] of the horizon of the nearest receiver of the known ones, at azimuth ``number`` of ``receiver``."""
        import drjit as dr
        import mitsuba as mi

        some = -(-self._count // _STRIDE)
        nearest = dr.minimum((receiver + _STRIDE // 2) // _STRIDE, dr.opaque(mi.UInt32, some - 1))
        # Its azimuths are turned against those here; between two of them the elevation is linear.
        turn, turned = (dr.gather(mi.Float, self._turn, index) for index in (receiver, nearest * _STRIDE))
        place = mi.Float(number) + (turn - turned)
        first = dr.floor(place)
        azimuths = dr.opaque(mi.Int32, self._azimuths)

        def elevation(azimuth: Any) -> Any:
            azimuth = mi.UInt32((azimuth + azimuths) % azimuths)
            cell = dr.gather(mi.Int32, known, azimuth * dr.opaque(mi.UInt32, some) + nearest)
            return self._elevation(cell, 0.5, azimuth * self._receivers + nearest * _STRIDE)

        before, after = (elevation(mi.Int32(first) + add) for add in (0, 1))
        return before + (place - first) * (after - before)

    def land(self, bound: Any) -> Any:
        """Integral of the cosine of incidence between plane and bound."""
        import drjit as dr

        below, above = (_cosine_integral(self.along, self.upward, elevation) for elevation in (self._plane, bound))
        return dr.maximum(above - below, 0.0)

    def clusters(
        self, terrain: RayScene, bound: Any, measure: Any, lane: np.ndarray, number: np.ndarray, mi_face_cluster: Any
    ) -> np.ndarray:
        """Clusters that rays between plane and bound hit; `ESCAPED` or `ABSORBED` for none.

        ``lane`` is that of each ray, ``number`` its number among those of its receiver.
        """
        import drjit as dr
        import mitsuba as mi

        mi_lane, mi_number = (mi.UInt32(aligned(values, np.uint32)) for values in (lane, number))
        receiver = mi_lane % self._receivers
        # A lattice of place in the interval by ray (steps of the golden ratio) and by receiver: those whose azimuths are
        # turned against each other have different elevations at them, too.
        place = 5.0 * dr.gather(mi.Float, self._turn, receiver) + mi.Float(mi_number) * _GOLDEN
        place -= dr.floor(place)
        along, upward, low, high, whole, north, east = (
            dr.gather(mi.Float, values, mi_lane)
            for values in (self.along, self.upward, self._plane, bound, measure, *self._north_east)
        )
        # Elevations are distributed by the cosine of incidence.
        wanted = _cosine_integral(along, upward, low) + whole * place
        for _ in range(8):
            middle = 0.5 * (low + high)
            beyond = _cosine_integral(along, upward, middle) > wanted
            low, high = dr.select(beyond, low, middle), dr.select(beyond, middle, high)
        ray, active = _ray(dr.gather(mi.Point3f, self._origin, mi_lane), north, east, 0.5 * (low + high)), whole > 0.0
        found = terrain.mi_scene.ray_intersect_preliminary(ray, active=active)
        interaction = found.compute_surface_interaction(ray, mi.RayFlags.Minimal, active)
        cluster = mi.Int32(dr.gather(mi.UInt32, mi_face_cluster, found.prim_index, found.is_valid()))
        front = dr.dot(interaction.n, ray.d) < 0.0
        return np.array(dr.select(found.is_valid(), dr.select(front, cluster, ABSORBED), ESCAPED))


def _cell_height(plane: Any) -> Any:
    """Height [rad] of the cells between a plane's elevation and the zenith."""
    return (0.5 * np.pi - plane) / (_CELLS - 1)


def _cosine_integral(along: Any, upward: Any, elevation: Any) -> Any:
    """Antiderivative over elevation of cosine of incidence × cosine of elevation."""
    import drjit as dr

    sine, cosine = dr.sincos(elevation)
    return along * 0.5 * (elevation + sine * cosine) + upward * 0.5 * sine * sine


def _ray(origin: Any, north: Any, east: Any, elevation: Any) -> Any:
    import drjit as dr
    import mitsuba as mi

    sine, cosine = dr.sincos(elevation)
    return mi.Ray3f(origin, mi.Vector3f(east * cosine, north * cosine, sine))


def _integrals(
    table: np.ndarray, azimuths: int, azimuth: np.ndarray, horizon: np.ndarray, along: np.ndarray, upward: np.ndarray
) -> np.ndarray:
    """Sums ``(N, r + 1)`` over the azimuths of tabulated integrals above horizons, linear between tabulated elevations."""
    columns, elevations = round(360.0 / _AZIMUTH_DEG), round(180.0 / _ELEVATION_DEG) + 1
    column = np.minimum((azimuth * np.float32(np.degrees(1.0) / _AZIMUTH_DEG)).astype(np.int32), columns - 1)
    place = (horizon * np.float32(np.degrees(1.0)) + np.float32(90.0)) / np.float32(_ELEVATION_DEG)
    lower = np.clip(place.astype(np.int32), 0, elevations - 2)
    share = place - lower
    index = ((column * elevations + lower) * 2)[:, None] + np.arange(4, dtype=np.int32)
    weight = np.stack([along * (1.0 - share), upward * (1.0 - share), along * share, upward * share], axis=1)
    return patch_sums(index.reshape(-1, 4 * azimuths), weight.reshape(-1, 4 * azimuths), table)
