"""The relief of the synthetic massif: rivers, ice and gravity carve what the plan has sketched."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage

from seasonscapes.terrain.flow import (
    Lattice,
    accumulate,
    incise,
    jittered_lattice,
    links_of,
    on_grid,
    route_flow,
    slump,
)
from seasonscapes.terrain.noise import fractal_noise, spline_noise, warped_noise
from seasonscapes.terrain.synthetic_ice import grow_ice
from seasonscapes.terrain.synthetic_layout import (
    LAKE_LEVEL_M,
    LEDGES_M,
    MassifLayout,
    ValleyFloor,
    anchoring,
    massif_layout,
    sketched_heights,
    strata_level_m,
    valley_floor,
)


@dataclass(frozen=True)
class _Stage:
    """How rivers and rockfall work at one spacing."""

    spacing_m: float
    rounds: int
    strength_m: float  # incision per round of a 1 km² catchment, as K A^m Δt
    noise_m: float
    keep_m: float  # uplift holds the shape above this wavelength
    cliff_deg: float
    strata_m: float  # spacing of ledges, 0 for none
    sharpen: float  # gives back to arêtes what the change to a regular grid takes
    margin_m: float


_STAGES = (
    _Stage(120.0, 24, 40.0, 40.0, 800.0, 54.0, 0.0, 0.9, 960.0),
    _Stage(60.0, 8, 24.0, 18.0, 400.0, 58.0, 0.0, 0.9, 480.0),
    _Stage(30.0, 6, 18.0, 12.0, 220.0, 63.0, LEDGES_M[0], 0.9, 240.0),
    _Stage(15.0, 5, 11.0, 5.0, 120.0, 68.0, LEDGES_M[1], 0.8, 120.0),
)


_BED_SCALE_M = 110.0  # ice is level across what is smaller


@dataclass(frozen=True)
class Relief:
    """What stands and what moves on the massif; all ``(H, W)`` on the regular grid, row 0 in the north.

    Parameters
    ----------
    elevation
        Visible surface: ice and lake surface included [m].
    ice_m
        Ice thickness [m], 0 where there is none.
    debris
        Share of the ice under moraine, in [0, 1].
    catchment_m2
        Area draining through each cell [m²].
    floor
        The main valleys' flat ground and the lake.
    """

    elevation: np.ndarray
    ice_m: np.ndarray
    debris: np.ndarray
    catchment_m2: np.ndarray
    floor: ValleyFloor


def _lowpass(values: np.ndarray, sigma_m: float, spacing_m: float) -> np.ndarray:
    return cv2.GaussianBlur(values.astype(np.float32), (0, 0), sigma_m / spacing_m, borderType=cv2.BORDER_REPLICATE)


def _soft_minimum(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    return 0.5 * (a + b - np.sqrt((a - b) ** 2 + width**2))


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


def _terraced(z: np.ndarray, lattice: Lattice, seed: int, period_m: float) -> np.ndarray:
    """Ledges and steps of gently dipping strata on steep ground."""
    spacing = lattice.spacing_m
    steep = np.hypot(*np.gradient(z, spacing))
    axis = (np.arange(z.shape[0]) - (z.shape[0] - 1) / 2.0) * spacing
    level = strata_level_m(z, axis, -axis, seed) / period_m
    inside = level - np.floor(level)
    step = inside * inside * (3.0 - 2.0 * inside)
    strength = 0.55 * np.clip((steep - 0.7) / 0.5, 0.0, 1.0) * np.clip((z - 1100.0) / 600.0, 0.3, 1.0)
    strength *= np.clip(0.6 + 0.5 * spline_noise(seed + 53 + int(period_m), 1200.0, axis, -axis), 0.0, 1.0)
    return z + strength * period_m * (step - inside)


def _dissect(z: np.ndarray, lattice: Lattice, seed: int, stage: _Stage, bare: np.ndarray) -> np.ndarray:
    """Let rivers cut into a surface while uplift holds its shape at long wavelengths.

    ``bare (H, W)`` in [0, 1] is how freely water reaches the rock: turf and ice protect it.
    """
    spacing = stage.spacing_m
    outlets, links = lattice.border, links_of(lattice)
    cell_area = np.full(z.shape, spacing**2)
    axis = (np.arange(z.shape[0]) - (z.shape[0] - 1) / 2.0) * spacing
    hardness = np.exp(0.30 * fractal_noise(seed + 41, 1400.0, axis, -axis, octaves=6, gain=0.6))
    held = _lowpass(z, stage.keep_m, spacing)
    limit = np.tan(np.radians(stage.cliff_deg)) / np.clip(hardness, 0.7, 1.4)
    for _ in range(stage.rounds):
        routes = route_flow(z, links, outlets)
        area = accumulate(routes, cell_area)
        z = incise(z, routes, stage.strength_m * hardness * bare * (area / 1e6) ** 0.4)
        z = slump(z, links, limit, 2)
        z = z + _lowpass(held - z, stage.keep_m, spacing)
    return z


def _talus(z: np.ndarray, catchment_m2: np.ndarray, spacing_m: float) -> np.ndarray:
    """Cones of debris at the foot of couloirs, at the angle of repose (about 33°)."""
    smooth = _lowpass(z, 25.0, spacing_m)
    slope = np.hypot(*np.gradient(smooth, spacing_m))
    concave = _lowpass(z, 75.0, spacing_m) - smooth
    walls = cv2.dilate(slope.astype(np.float32), np.ones((2 * round(90.0 / spacing_m) + 1,) * 2, np.uint8))
    open_ground = np.hypot(*np.gradient(_lowpass(z, 75.0, spacing_m), spacing_m)) < 0.8
    foot = (concave > 3.0) & (slope > 0.4) & (slope < 0.85) & (walls > 1.25) & (z > 900.0) & (z < 3000.0) & open_ground
    supply = np.where(foot & (catchment_m2 > 8e3) & (catchment_m2 < 6e5), catchment_m2, 0.0).astype(np.float32)
    chief = cv2.dilate(supply, np.ones((2 * round(75.0 / spacing_m) + 1,) * 2, np.uint8))
    piled, reach = z.copy(), round(255.0 / spacing_m)
    axis = np.arange(-reach, reach + 1) * spacing_m
    distance = np.hypot(axis[:, None], axis[None, :])
    # Cones flatten outwards, where blocks roll far, and end in a low front.
    drop = 0.70 * distance - 0.0004 * distance**2 + 0.006 * np.maximum(distance - 130.0, 0.0) ** 2
    for row, column in zip(*np.nonzero((supply > 0.0) & (supply == chief)), strict=True):
        if min(row, column) < reach or row >= z.shape[0] - reach or column >= z.shape[1] - reach:
            continue
        window = np.s_[row - reach : row + reach + 1, column - reach : column + reach + 1]
        apex = z[row, column] + min(5.0 + 0.06 * np.sqrt(supply[row, column]), 28.0)
        np.maximum(piled[window], apex - drop, out=piled[window])
    return piled


def _floor_on(floor: ValleyFloor, lattice: Lattice) -> ValleyFloor:
    """The floors, known on a 60 m grid, at a lattice's points."""
    return ValleyFloor(*(_sample(a, 60.0, lattice, order=1) for a in (floor.height, floor.beyond_m, floor.shore_m)))


def _settled(z: np.ndarray, lattice: Lattice, floor: ValleyFloor, seed: int) -> np.ndarray:
    """Trough walls down to the valley floors, and sediment on these."""
    wall = floor.height + np.maximum(floor.beyond_m, 0.0) ** 2 / 300.0
    z = np.where(floor.beyond_m < 1500.0, _soft_minimum(z, wall, 40.0), z)
    fill = floor.height - 6.0 * np.clip(-floor.beyond_m / 300.0, 0.0, 1.0)
    weight = np.clip(-floor.beyond_m / 80.0, 0.0, 1.0)
    ripple = 1.3 * warped_noise(seed + 61, 330.0, lattice.east_m, lattice.north_m)
    z = z + weight * (fill + ripple - z)
    return np.where(floor.beyond_m < 100.0, np.maximum(z, floor.height - 8.0), z)


def _sample(z: np.ndarray, spacing_m: float, lattice: Lattice, order: int = 3) -> np.ndarray:
    """Interpolation of a centred regular grid at a lattice's points."""
    half = (z.shape[0] - 1) / 2.0
    at = np.stack([half - lattice.north_m / spacing_m, half + lattice.east_m / spacing_m])
    return ndimage.map_coordinates(z, at, order=order, mode="nearest")


def _regular(half_m: float, spacing_m: float) -> Lattice:
    return jittered_lattice(half_m, spacing_m, 0.0, np.random.default_rng(0))


def _glaciers(bed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thickness and surface ``(H, W)`` [m] of the ice on a 60 m bed, computed at 120 m.

    The surface is told from the smoothed bed, so that it follows when finer stages move that.
    """
    coarse = cv2.GaussianBlur(bed, (0, 0), 1.0)[::2, ::2]
    down, right = np.gradient(_lowpass(coarse, 240.0, 120.0), 120.0)
    northness = down / np.sqrt(1.0 + down**2 + right**2)
    ice = grow_ice(coarse, 120.0, 3000.0 - 260.0 * northness, rounds=350)
    grid = _regular((bed.shape[0] - 1) // 2 * 60.0, 60.0)
    thickness, surface = (_sample(_lowpass(a, 70.0, 120.0), 120.0, grid) for a in (ice, coarse + ice))
    return thickness, surface - _lowpass(bed, _BED_SCALE_M, 60.0)


def _glaciated(bed: np.ndarray, ice: tuple[np.ndarray, np.ndarray], lattice: Lattice) -> np.ndarray:
    """Ice thickness ``(H, W)`` [m] on a finer bed: deep ice is level across, thin ice lies on what is below."""
    thickness, above_bed = (_sample(a, 60.0, lattice) for a in ice)
    surface = above_bed + _lowpass(bed, _BED_SCALE_M, lattice.spacing_m)
    # Around a thick glacier even its thin spots are level: no pits over bumps of the coarse bed.
    around = _lowpass(thickness, 150.0, lattice.spacing_m)
    deep = np.clip((np.maximum(thickness, 0.9 * around) - 15.0) / 50.0, 0.0, 1.0)
    steep = _lowpass(np.hypot(*np.gradient(bed, lattice.spacing_m)), 20.0, lattice.spacing_m)
    clings = np.clip((0.85 + thickness / 60.0 - steep) / 0.3, 0.0, 1.0)
    hollow = np.clip(1.0 + (_lowpass(bed, 60.0, lattice.spacing_m) - bed) / 12.0, 0.0, 1.5)
    filled = deep * (surface - bed) + (1.0 - deep) * 0.5 * thickness * clings * hollow
    filled = np.where(((thickness > 10.0) | (around > 35.0)) & (filled > 3.0), filled, 0.0)
    # Scraps that no névé feeds have melted long ago.
    label, count = ndimage.label(filled > 0.0, np.ones((3, 3)))
    if not count:
        return filled
    numbers = np.arange(1, count + 1)
    area = ndimage.sum_labels(np.ones_like(bed), label, numbers) * lattice.spacing_m**2
    top = ndimage.maximum(bed, label, numbers)
    lives = np.append(False, (area > 1.2e5) & (top > 2750.0))
    return np.where(lives[label], filled, 0.0)


def _moraines(ice: tuple[np.ndarray, np.ndarray], surface: np.ndarray) -> np.ndarray:
    """Share of debris on the ice ``(H, W)`` of the 60 m grid, by tracing its way back up.

    What flows down from névé is clean; what passed a rock wall below the snow line carries its fall.
    """
    thickness, surface = ice[0], _lowpass(surface, 150.0, 60.0)
    down, right = np.gradient(surface, 60.0)
    steep = np.hypot(down, right) + 1e-4
    at = np.stack(np.nonzero(thickness > 10.0)).astype(float)
    found, open_ = np.zeros(at.shape[1]), np.ones(at.shape[1], bool)
    for _ in range(90):
        here = at[:, open_]
        state = [
            ndimage.map_coordinates(a, here, order=1, mode="nearest")
            for a in (thickness, surface, down / steep, right / steep)
        ]
        rock, snow = state[0] < 14.0, state[1] > 3020.0
        found[np.flatnonzero(open_)[rock & ~snow]] = 1.0
        at[:, open_] = here + 0.8 * np.stack(state[2:])
        open_[np.flatnonzero(open_)[rock | snow]] = False
    debris = np.zeros(thickness.shape, np.float32)
    debris[thickness > 10.0] = found
    return debris


def _stage_surface(
    z: np.ndarray, lattice: Lattice, plan: MassifLayout, floor: ValleyFloor, stage: _Stage, bare: np.ndarray
) -> np.ndarray:
    """One stage of carving from heights on the jittered lattice to heights on the regular grid."""
    spacing = stage.spacing_m
    rng = np.random.default_rng(plan.seed + int(spacing) + 1)
    if stage.strata_m:
        z = z + bare * (_terraced(z, lattice, plan.seed, stage.strata_m) - z)
    steep = np.clip(np.hypot(*np.gradient(z, spacing)), 0.1, 1.2)
    z = z + stage.noise_m * bare * steep * _lowpass(rng.normal(0.0, 3.0, z.shape), 1.2 * spacing, spacing)
    z = _dissect(z, lattice, plan.seed, stage, bare)
    if spacing >= 30.0:
        z = z + _sample(anchoring(z, lattice, plan), 120.0, lattice)
    if spacing == 60.0:
        routes = route_flow(z, links_of(lattice), lattice.border)
        z = _carve_troughs(z, accumulate(routes, np.full(z.shape, spacing**2)), spacing)
    z = on_grid(z, lattice)
    above = np.maximum(z - _lowpass(z, 1.5 * spacing, spacing), 0.0)
    z = z + stage.sharpen * above * np.clip((z - 1700.0) / 900.0, 0.0, 1.0)
    regular = _regular((z.shape[0] - 1) // 2 * spacing, spacing)
    return _settled(z, regular, _floor_on(floor, regular), plan.seed)


def _bare(z: np.ndarray, spacing_m: float, ice: tuple[np.ndarray, np.ndarray] | None, lattice: Lattice) -> np.ndarray:
    """How freely water reaches the rock, ``(H, W)`` in [0, 1]: little under turf, hardly at all under ice."""
    if ice is None:
        return np.ones_like(z)
    steep = _lowpass(np.hypot(*np.gradient(z, spacing_m)), 60.0, spacing_m)
    bare = np.clip(0.2 + (z - 1500.0) / 1100.0 + 1.4 * (steep - 0.8), 0.12, 1.0)
    return bare * (1.0 - 0.92 * np.clip((_sample(ice[0], 60.0, lattice, order=1) - 30.0) / 50.0, 0.0, 1.0))


def relief(half_m: float, spacing_m: float, seed: int) -> Relief:
    """The massif on the regular grid of ``spacing_m`` (one of the stages') reaching ``half_m`` from its centre."""
    plan = massif_layout(seed)
    floor = valley_floor(plan, _regular(half_m + 1020.0, 60.0))
    z = ice = debris = None
    for stage in (stage for stage in _STAGES if stage.spacing_m >= spacing_m):
        spacing = stage.spacing_m
        rng = np.random.default_rng(seed + int(spacing))
        lattice = jittered_lattice(half_m + stage.margin_m, spacing, 0.38, rng)
        z = sketched_heights(plan, lattice) if z is None else _sample(z, 2.0 * spacing, lattice)
        z = _stage_surface(z, lattice, plan, floor, stage, _bare(z, spacing, ice, lattice))
        if spacing == 60.0:
            ice = _glaciers(z)
            debris = _moraines(ice, _lowpass(z, _BED_SCALE_M, spacing) + ice[1])
            z = z + np.clip((ice[0] - 40.0) / 60.0, 0.0, 0.85) * (_lowpass(z, _BED_SCALE_M, spacing) - z)
    if spacing_m < 60.0:
        lattice = _regular((z.shape[0] - 1) // 2 * spacing_m, spacing_m)
        routes = route_flow(z, links_of(lattice), lattice.border)
        z = _talus(z, accumulate(routes, np.full(z.shape, spacing_m**2)), spacing_m)
    edge = (z.shape[0] - 1) // 2 - round(half_m / spacing_m)
    z = z[edge:-edge, edge:-edge]
    regular = _regular(half_m, spacing_m)
    thickness = _glaciated(z, ice, regular)
    z = z + thickness
    floor = _floor_on(floor, regular)
    # A beach: without it each cell of the shore would be a step.
    rise = LAKE_LEVEL_M + 0.05 * floor.shore_m
    near = np.clip(1.0 - floor.shore_m / 70.0, 0.0, 1.0)
    z = np.maximum(z + near * (rise - z), rise - 0.08 * np.maximum(floor.shore_m - 100.0, 0.0))
    z = np.where(floor.shore_m < 0.0, LAKE_LEVEL_M, z)
    routes = route_flow(z, links_of(regular), regular.border)
    debris = np.clip(_sample(debris, 60.0, regular, order=1), 0.0, 1.0)
    return Relief(z, thickness, debris, accumulate(routes, np.full(z.shape, spacing_m**2)), floor)
