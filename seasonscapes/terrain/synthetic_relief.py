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
from seasonscapes.terrain.noise import fractal_noise
from seasonscapes.terrain.synthetic_ice import grow_ice
from seasonscapes.terrain.synthetic_plan import (
    LAKE_LEVEL_M,
    ValleyFloor,
    anchored,
    plan_of,
    sketched_heights,
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
    sharpen: float  # gives back to arêtes what the change to a regular grid takes
    margin_m: float


_STAGES = (
    _Stage(120.0, 24, 40.0, 40.0, 800.0, 54.0, 0.9, 960.0),
    _Stage(60.0, 8, 20.0, 14.0, 400.0, 58.0, 0.9, 480.0),
    _Stage(30.0, 5, 8.0, 6.0, 200.0, 62.0, 0.8, 240.0),
    _Stage(15.0, 3, 3.0, 2.5, 100.0, 66.0, 0.6, 120.0),
)


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
    floor
        The main valleys' flat ground and the lake.
    """

    elevation: np.ndarray
    ice_m: np.ndarray
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


def _dissect(z: np.ndarray, lattice: Lattice, seed: int, stage: _Stage) -> np.ndarray:
    """Let rivers cut into a surface while uplift holds its shape at long wavelengths."""
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
        z = incise(z, routes, stage.strength_m * hardness * (area / 1e6) ** 0.45)
        z = slump(z, links, limit, 2)
        z = z + _lowpass(held - z, stage.keep_m, spacing)
    return z


def _settled(z: np.ndarray, floor: ValleyFloor) -> np.ndarray:
    """Trough walls down to the valley floors, and sediment on these."""
    wall = floor.height + np.maximum(floor.beyond_m, 0.0) ** 2 / 300.0
    z = np.where(floor.beyond_m < 1500.0, _soft_minimum(z, wall, 40.0), z)
    fill = floor.height - 6.0 * np.clip(-floor.beyond_m / 300.0, 0.0, 1.0)
    weight = np.clip(-floor.beyond_m / 80.0, 0.0, 1.0)
    return z + weight * (fill - z)


def _sample(z: np.ndarray, spacing_m: float, lattice: Lattice, order: int = 3) -> np.ndarray:
    """Interpolation of a centred regular grid at a lattice's points."""
    half = (z.shape[0] - 1) / 2.0
    at = np.stack([half - lattice.north_m / spacing_m, half + lattice.east_m / spacing_m])
    return ndimage.map_coordinates(z, at, order=order, mode="nearest")


def _regular(half_m: float, spacing_m: float) -> Lattice:
    return jittered_lattice(half_m, spacing_m, 0.0, np.random.default_rng(0))


def _glaciers(bed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Thickness and surface height ``(H, W)`` [m] of the ice on a 60 m bed, computed at 120 m."""
    coarse = cv2.GaussianBlur(bed, (0, 0), 1.0)[::2, ::2]
    down, right = np.gradient(_lowpass(coarse, 240.0, 120.0), 120.0)
    northness = down / np.sqrt(1.0 + down**2 + right**2)
    ice = grow_ice(coarse, 120.0, 3080.0 - 260.0 * northness, rounds=350)
    grid = _regular((bed.shape[0] - 1) // 2 * 60.0, 60.0)
    return tuple(_sample(_lowpass(a, 70.0, 120.0), 120.0, grid) for a in (ice, coarse + ice))


def _glaciated(bed: np.ndarray, ice: tuple[np.ndarray, np.ndarray], lattice: Lattice) -> np.ndarray:
    """Ice thickness ``(H, W)`` [m] on a finer bed: deep ice is level across, thin ice lies on what is below."""
    thickness, surface = (_sample(a, 60.0, lattice) for a in ice)
    deep = np.clip((thickness - 15.0) / 50.0, 0.0, 1.0)
    down, right = np.gradient(bed, lattice.spacing_m)
    clings = np.clip((1.25 - np.hypot(down, right)) / 0.3, 0.0, 1.0)
    filled = deep * (surface - bed) + (1.0 - deep) * 0.5 * thickness * clings
    return np.where((thickness > 6.0) & (filled > 2.5), filled, 0.0)


def _stage_surface(z: np.ndarray, lattice: Lattice, plan, stage: _Stage) -> np.ndarray:
    """One stage of carving from heights on the jittered lattice to heights on the regular grid."""
    spacing = stage.spacing_m
    rng = np.random.default_rng(plan.seed + int(spacing) + 1)
    steep = np.clip(np.hypot(*np.gradient(z, spacing)), 0.1, 1.2)
    z = z + stage.noise_m * steep * _lowpass(rng.normal(0.0, 3.0, z.shape), 1.2 * spacing, spacing)
    z = _dissect(z, lattice, plan.seed, stage)
    if spacing >= 60.0:
        z = anchored(z, lattice, plan)
    if spacing == 60.0:
        routes = route_flow(z, links_of(lattice), lattice.border)
        z = _carve_troughs(z, accumulate(routes, np.full(z.shape, spacing**2)), spacing)
    z = on_grid(z, lattice)
    above = np.maximum(z - _lowpass(z, 1.5 * spacing, spacing), 0.0)
    z = z + stage.sharpen * above * np.clip((z - 1700.0) / 900.0, 0.0, 1.0)
    return _settled(z, valley_floor(plan, _regular((z.shape[0] - 1) // 2 * spacing, spacing)))


def relief(half_m: float, spacing_m: float, seed: int) -> Relief:
    """The massif on the regular grid of ``spacing_m`` (one of the stages') reaching ``half_m`` from its centre."""
    plan = plan_of(seed)
    z = ice = None
    for stage in (stage for stage in _STAGES if stage.spacing_m >= spacing_m):
        rng = np.random.default_rng(seed + int(stage.spacing_m))
        lattice = jittered_lattice(half_m + stage.margin_m, stage.spacing_m, 0.38, rng)
        z = sketched_heights(plan, lattice) if z is None else _sample(z, 2.0 * stage.spacing_m, lattice)
        z = _stage_surface(z, lattice, plan, stage)
        if stage.spacing_m == 60.0:
            ice = _glaciers(z)
    edge = (z.shape[0] - 1) // 2 - round(half_m / spacing_m)
    z = z[edge:-edge, edge:-edge]
    regular = _regular(half_m, spacing_m)
    thickness = _glaciated(z, ice, regular)
    z = z + thickness
    floor = valley_floor(plan, regular)
    bank = LAKE_LEVEL_M + np.clip(0.04 * floor.shore_m, 0.0, 2.0)
    z = np.where(floor.shore_m < 0.0, LAKE_LEVEL_M, np.maximum(z, bank))
    routes = route_flow(z, links_of(regular), regular.border)
    return Relief(z, thickness, accumulate(routes, np.full(z.shape, spacing_m**2)), floor)
