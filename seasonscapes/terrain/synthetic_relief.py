"""The relief of the synthetic massif: a sketch of crests and valleys that water, ice and gravity then carve."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from seasonscapes.terrain.flow import Lattice, accumulate, incise, jittered_lattice, links_of, on_grid, route_flow, slump
from seasonscapes.terrain.synthetic_ice import grow_ice
from seasonscapes.terrain.noise import fractal_noise, warped_noise

# Lines of the sketch: (east km, north km, elevation m) of their knots about the massif's centre.
_CRESTS = [
    # The main crest from the west-south-west, three summits, and the north-east arête.
    [(-3.3, -4.1, 3150), (-2.6, -3.2, 3980), (-1.9, -2.7, 3480), (-0.7, -1.95, 4120), (0.3, -1.55, 3620),
     (1.5, -0.75, 3990), (2.3, -0.2, 3300), (3.2, 0.35, 2600), (3.9, 0.85, 1900)],
    [(-2.6, -3.2, 3980), (-2.5, -4.6, 3700), (-1.6, -5.7, 3560), (-1.1, -7.5, 3400)],
    [(1.5, -0.75, 3990), (2.2, -1.9, 3480), (2.9, -3.3, 3720), (4.3, -4.2, 3980), (5.2, -5.6, 3500), (5.6, -7.5, 3300)],
    [(4.3, -4.2, 3980), (5.6, -3.0, 3560), (6.0, -1.5, 3660), (6.1, -0.1, 2900), (5.7, 0.9, 2000)],
    [(0.3, -1.55, 3620), (0.1, -0.9, 2900), (-0.3, 0.0, 2120), (-1.0, 0.75, 2480), (-1.5, 1.5, 2240), (-1.9, 2.0, 1700)],
    [(-7.5, -4.0, 2900), (-6.3, -2.2, 2780), (-6.0, -0.2, 2500), (-5.9, 1.2, 2300), (-5.6, 2.2, 1500)],
    [(-7.5, 6.2, 1900), (-4.5, 6.3, 2020), (-2.0, 5.7, 2280), (0.4, 5.9, 2450), (2.4, 5.4, 2640), (4.8, 5.6, 2560), (7.5, 5.0, 2700)],
]  # fmt: skip
_VALLEYS = [
    [(7.5, 1.5, 1120), (5.4, 1.75, 1000), (3.6, 2.0, 860), (2.0, 2.45, 690), (1.0, 2.7, 600), (-0.6, 3.1, 566),
     (-2.6, 3.35, 565), (-4.6, 3.5, 562), (-6.0, 3.9, 560), (-7.5, 4.3, 556)],
    [(-3.6, 3.4, 565), (-3.9, 2.0, 640), (-4.25, 0.2, 740), (-4.5, -1.6, 860), (-4.6, -3.4, 1150), (-4.9, -4.9, 1750), (-5.5, -7.5, 2500)],
    [(-1.1, -3.0, 3330), (-0.3, -4.1, 3080), (0.9, -5.1, 2840), (1.9, -7.5, 2320)],
    [(1.5, -2.2, 3250), (1.5, -3.6, 3020), (1.2, -5.0, 2850)],
    [(4.2, -2.9, 3180), (4.1, -1.9, 2700), (4.3, -0.7, 1950), (4.5, 0.5, 1250), (4.6, 1.7, 940)],
    [(0.6, 0.1, 1900), (0.9, 1.2, 1500), (1.4, 2.3, 700)],
    [(-1.6, -0.9, 1900), (-2.6, 0.3, 1600), (-3.6, 0.9, 760)],
]  # fmt: skip


LAKE_LEVEL_M = 566.0


@dataclass(frozen=True)
class _Stage:
    """How rivers and rockfall work at one spacing."""

    spacing_m: float
    rounds: int
    strength_m: float  # incision per round of a 1 km² catchment, as K A^m Δt
    noise_m: float
    keep_m: float  # uplift holds the shape above this wavelength
    cliff_deg: float
    margin_m: float


_STAGES = (
    _Stage(120.0, 24, 40.0, 40.0, 800.0, 46.0, 960.0),
    _Stage(60.0, 8, 20.0, 14.0, 400.0, 50.0, 480.0),
    _Stage(30.0, 5, 8.0, 6.0, 200.0, 55.0, 240.0),
    _Stage(15.0, 3, 3.0, 2.5, 100.0, 60.0, 120.0),
)


def _sampled_lines(lines: list, seed: int) -> np.ndarray:
    """Points every 50 m along the lines, ``(P, 3)`` [m], their knots moved a little by the seed."""
    rng = np.random.default_rng(seed)
    moved: dict[tuple, np.ndarray] = {}
    points = []
    for line in lines:
        for knot in line:
            if knot not in moved:
                shift = rng.uniform(-1.0, 1.0, 3) * (90.0, 90.0, 25.0 if knot[2] > 1300 else 0.0)
                moved[knot] = np.array([knot[0] * 1000.0, knot[1] * 1000.0, knot[2]]) + shift
        knots = np.array([moved[knot] for knot in line])
        along = np.append(0.0, np.cumsum(np.hypot(*np.diff(knots[:, :2], axis=0).T)))
        at = np.arange(0.0, along[-1], 50.0)
        points.append(np.stack([np.interp(at, along, knots[:, k]) for k in range(3)], -1))
    return np.concatenate(points)


@dataclass(frozen=True)
class _Sketch:
    """Crest and valley points ``(P, 3)`` [m] and the warp that makes their lines natural."""

    crests: np.ndarray
    valleys: np.ndarray
    seed: int


def _spread(points: np.ndarray, values: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse-distance mean of values at points, and the distance to the nearest point [m]."""
    distance, index = cKDTree(points[:, :2]).query(position, k=40)
    weight = 1.0 / (distance + 20.0) ** 3
    return (weight * values[index]).sum(-1) / weight.sum(-1), distance[..., 0]


def _draw(plan: _Sketch, lattice: Lattice) -> tuple[np.ndarray, np.ndarray]:
    """Heights [m] between the lines, and the share of the way from valley to crest, ``(H, W)``."""
    position = np.stack([lattice.east_m, lattice.north_m], -1)
    low, to_valley = _spread(plan.valleys, plan.valleys[:, 2], position)
    high, to_crest = _spread(plan.crests, plan.crests[:, 2], position)
    share = to_valley / (to_valley + to_crest + 1e-3)
    return low + (high - low) * (0.45 * share + 0.55 * share**2), share


def _warped(lattice: Lattice, seed: int) -> Lattice:
    """The lattice seen through a smooth random displacement."""
    east, north = lattice.east_m, lattice.north_m
    for octave, (wavelength, reach) in enumerate(((2600.0, 170.0), (1300.0, 110.0), (650.0, 60.0), (330.0, 30.0))):
        shift = [warped_noise(seed + 11 + 2 * octave + k, wavelength, lattice.east_m, lattice.north_m) for k in (0, 1)]
        east, north = east + reach * shift[0], north + reach * shift[1]
    return Lattice(east, north, lattice.spacing_m)


def _lowpass(values: np.ndarray, sigma_m: float, spacing_m: float) -> np.ndarray:
    return cv2.GaussianBlur(values.astype(np.float32), (0, 0), sigma_m / spacing_m, borderType=cv2.BORDER_REPLICATE)


def _carve_troughs(z: np.ndarray, area: np.ndarray, spacing_m: float) -> np.ndarray:
    """Widen the trunks' valleys to the parabolic cross-section of a glacier's bed.

    Parabolas after Svensson 1959 (doi:10.1080/20014422.1959.11907928); half-width of the floor grows with catchment.
    """
    for least, half_width, radius in ((0.35e6, 25.0, 90.0), (2e6, 70.0, 260.0), (10e6, 150.0, 420.0)):
        trunk = area > least
        distance, nearest = ndimage.distance_transform_edt(~trunk, sampling=spacing_m, return_indices=True)
        bed = z[tuple(nearest)] + np.maximum(distance - half_width, 0.0) ** 2 / radius
        z = np.where(distance < 6.0 * half_width + 200.0, _soft_minimum(z, bed, 30.0), z)
    return z


def _soft_minimum(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    return 0.5 * (a + b - np.sqrt((a - b) ** 2 + width**2))


def _dissect(z: np.ndarray, lattice: Lattice, seed: int, stage: _Stage) -> np.ndarray:
    """Let rivers cut into a surface while uplift holds its shape at long wavelengths."""
    spacing = stage.spacing_m
    outlets, links = lattice.border, links_of(lattice)
    cell_area = np.full(z.shape, spacing**2)
    axis = lattice.east_m[lattice.east_m.shape[0] // 2]
    hardness = np.exp(0.30 * fractal_noise(seed + 41, 1400.0, axis, -axis, octaves=6, gain=0.6))
    held = _lowpass(z, stage.keep_m, spacing)
    limit = np.tan(np.radians(stage.cliff_deg)) / np.clip(hardness, 0.65, 1.4)
    for _ in range(stage.rounds):
        routes = route_flow(z, links, outlets)
        area = accumulate(routes, cell_area)
        z = incise(z, routes, stage.strength_m * hardness * (area / 1e6) ** 0.45)
        z = slump(z, links, limit, 2)
        z = z + _lowpass(held - z, stage.keep_m, spacing)
    return z


def _anchor(z: np.ndarray, lattice: Lattice, plan: _Sketch) -> np.ndarray:
    """Bring crests back up and valleys back down to the sketch's heights by a smooth correction."""
    spacing = lattice.spacing_m
    half = (z.shape[0] - 1) // 2
    warped = _warped(lattice, plan.seed)
    position = np.stack([warped.east_m, warped.north_m], -1)
    tree = cKDTree(position.reshape(-1, 2))
    size = 2 * round(150.0 / spacing) + 1
    corrections, reach = [], half * spacing
    for points, extreme in ((plan.valleys, ndimage.minimum_filter), (plan.crests, ndimage.maximum_filter)):
        inside = np.abs(points[:, :2]).max(axis=1) < reach - 200.0
        at = tree.query(points[inside, :2])[1]
        error = points[inside, 2] - extreme(z, size).ravel()[at]
        corrections.append(_spread(points[inside], error, position))
    (low, to_valley), (high, to_crest) = corrections
    share = to_valley / (to_valley + to_crest + 1e-3)
    return z + _lowpass(low + (high - low) * share, 120.0, spacing)


def _sample(z: np.ndarray, spacing_m: float, lattice: Lattice) -> np.ndarray:
    """Cubic interpolation of a centred regular grid at a lattice's points."""
    half = (z.shape[0] - 1) / 2.0
    at = np.stack([half - lattice.north_m / spacing_m, half + lattice.east_m / spacing_m])
    return ndimage.map_coordinates(z, at, order=3, mode="nearest")


@dataclass(frozen=True)
class Relief:
    """What stands and what moves on the massif; all ``(H, W)`` on the regular grid, row 0 in the north.

    Parameters
    ----------
    elevation
        Visible surface: ice and lake surface included [m].
    ice_m
        Ice thickness [m], 0 where there is none.
    catchment_m2
        Area draining through each cell [m²].
    shore_m
        Horizontal distance from the lake's shore, negative on the water [m].
    """

    elevation: np.ndarray
    ice_m: np.ndarray
    catchment_m2: np.ndarray
    shore_m: np.ndarray


def _valley_floor(plan: _Sketch, lattice: Lattice) -> tuple[np.ndarray, np.ndarray]:
    """Height of the nearest point of the main valleys' floors [m] and distance beyond the floor's edge [m]."""
    warped = _warped(lattice, plan.seed)
    points = plan.valleys[plan.valleys[:, 2] < 1000.0]
    position = np.stack([warped.east_m, warped.north_m], -1)
    distance, index = cKDTree(points[:, :2]).query(position, k=12)
    weight = 1.0 / (distance + 60.0) ** 3
    height = (weight * points[index, 2]).sum(-1) / weight.sum(-1)
    half_width = np.interp(height, [560.0, 580.0, 700.0, 1000.0], [430.0, 400.0, 230.0, 60.0])
    return height, distance[..., 0] - half_width


def _grow_glaciers(bed: np.ndarray) -> np.ndarray:
    """Ice thickness on the 60 m grid, computed at 120 m."""
    coarse = cv2.GaussianBlur(bed, (0, 0), 1.0)[::2, ::2]
    down, right = np.gradient(_lowpass(coarse, 240.0, 120.0), 120.0)
    northness = down / np.sqrt(1.0 + down**2 + right**2)
    ice = grow_ice(coarse, 120.0, 3050.0 - 250.0 * northness, rounds=350)
    fine = jittered_lattice((bed.shape[0] - 1) // 2 * 60.0, 60.0, 0.0, np.random.default_rng(0))
    return _sample(ice, 120.0, fine)


def relief(half_m: float, spacing_m: float, seed: int) -> Relief:
    """The massif on the regular grid of ``spacing_m`` (one of the stages') reaching ``half_m`` from its centre."""
    plan = _Sketch(_sampled_lines(_CRESTS, seed), _sampled_lines(_VALLEYS, seed + 1), seed)
    z, ice, previous = None, None, None
    for stage in _STAGES:
        if stage.spacing_m < spacing_m:
            break
        spacing = stage.spacing_m
        rng = np.random.default_rng(seed + int(spacing))
        lattice = jittered_lattice(half_m + stage.margin_m, spacing, 0.38, rng)
        z = _draw(plan, _warped(lattice, seed))[0] if z is None else _sample(z, previous, lattice)
        steep = np.clip(np.hypot(*np.gradient(z, spacing)), 0.1, 1.2)
        z = z + stage.noise_m * steep * _lowpass(rng.normal(0.0, 3.0, z.shape), 1.2 * spacing, spacing)
        z = _dissect(z, lattice, seed, stage)
        if spacing == 120.0:
            z = _anchor(z, lattice, plan)
        if spacing == 60.0:
            routes = route_flow(z, links_of(lattice), lattice.border)
            z = _carve_troughs(z, accumulate(routes, np.full(z.shape, 3600.0)), 60.0)
            floor, beyond = _valley_floor(plan, lattice)
            z = np.where(beyond < 1500.0, _soft_minimum(z, floor + np.maximum(beyond, 0.0) ** 2 / 350.0, 40.0), z)
        z = on_grid(z, lattice)
        if spacing == 60.0:
            ice, ice_half = _grow_glaciers(z), (z.shape[0] - 1) // 2
        previous = spacing
    edge = (z.shape[0] - 1) // 2 - round(half_m / spacing_m)
    z = z[edge:-edge, edge:-edge]
    regular = jittered_lattice(half_m, spacing_m, 0.0, rng)
    thickness = _sample_linear(ice, 60.0, regular)
    surface = _sample_linear(ice, 60.0, regular)
    base = _lowpass(z, 60.0, spacing_m)
    covered = np.clip((thickness - 6.0) / 25.0, 0.0, 1.0)
    z = np.maximum(z, z + covered * (base + thickness - z))
    thickness = np.where(covered > 0.0, thickness, 0.0)
    del surface, ice_half
    floor, beyond = _valley_floor(plan, regular)
    east = regular.east_m
    shore = np.maximum(beyond + 60.0, np.maximum(east - 700.0, -4300.0 - east))
    z = np.where(beyond < 0.0, np.maximum(_soft_minimum(z, floor + 6.0, 6.0), LAKE_LEVEL_M + 1.0), z)
    z = np.where(shore < 0.0, LAKE_LEVEL_M, np.maximum(z, LAKE_LEVEL_M + np.minimum(0.03 * shore, 3.0)))
    routes = route_flow(z, links_of(regular), regular.border)
    return Relief(z, thickness, accumulate(routes, np.full(z.shape, spacing_m**2)), shore)


def _sample_linear(values: np.ndarray, spacing_m: float, lattice: Lattice) -> np.ndarray:
    half = (values.shape[0] - 1) / 2.0
    at = np.stack([half - lattice.north_m / spacing_m, half + lattice.east_m / spacing_m])
    return ndimage.map_coordinates(values, at, order=1, mode="nearest")
