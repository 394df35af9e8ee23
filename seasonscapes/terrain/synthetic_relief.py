"""Relief of the synthetic massif: multi-resolution erosion of the layout by rivers, glaciers and mass wasting.

Stages from 120 m to 15 m each apply stream-power incision (exponent m = 0.4) with uplift at long wavelengths and slope
relaxation on a jittered lattice. Glacial troughs and ice follow at 60 m, talus cones and the lake at the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import cv2
import numpy as np
from scipy import ndimage

from seasonscapes.terrain.flow import (
    Lattice,
    accumulate,
    incise,
    jittered_lattice,
    lattice_links,
    relax_slopes,
    resample_to_grid,
    route_flow,
)
from seasonscapes.terrain.noise import fractal_noise, spline_noise, warped_noise
from seasonscapes.terrain.synthetic_ice import grow_ice
from seasonscapes.terrain.synthetic_layout import (
    LAKE_LEVEL_M,
    MassifLayout,
    ValleyFloor,
    height_correction,
    initial_heights,
    massif_layout,
    valley_floor,
)
from seasonscapes.terrain.synthetic_strata import LEDGES_M, strata_level_m


@dataclass(frozen=True)
class _Stage:
    """Erosion parameters at one grid spacing."""

    spacing_m: float
    iterations: int
    incision_m: float  # K A^m Δt per iteration for a catchment of 1 km²
    noise_m: float  # amplitude of the initial roughness
    uplift_scale_m: float  # standard deviation of the low-pass whose shape uplift maintains
    critical_slope_deg: float
    strata_m: float  # vertical period of ledges, 0 for none
    sharpening: float  # compensates the smoothing of crests by resampling to the regular grid
    margin_m: float  # width of the border beyond the final extent


_STAGES = (
    _Stage(120.0, 24, 40.0, 40.0, 800.0, 54.0, 0.0, 0.9, 960.0),
    _Stage(60.0, 8, 24.0, 18.0, 400.0, 58.0, 0.0, 0.9, 480.0),
    _Stage(30.0, 6, 18.0, 12.0, 220.0, 63.0, LEDGES_M[0], 0.9, 240.0),
    _Stage(15.0, 5, 11.0, 5.0, 120.0, 68.0, LEDGES_M[1], 0.8, 120.0),
)


_BED_SCALE_M = 110.0  # standard deviation of the bed smoothing: the ice surface is level across smaller features


@dataclass(frozen=True)
class Relief:
    """Elevation, ice and drainage of the massif; maps are ``(H, W)`` on the regular grid, row 0 in the north.

    Parameters
    ----------
    elevation
        Surface heights, including ice and lake surfaces [m].
    ice_m
        Ice thickness [m], 0 on ice-free ground.
    debris
        Fraction of the ice surface covered by debris, in [0, 1].
    catchment_m2
        Upstream area of each cell [m²].
    floor
        Valley floors and lake.
    """

    elevation: np.ndarray
    ice_m: np.ndarray
    debris: np.ndarray
    catchment_m2: np.ndarray
    floor: ValleyFloor


@dataclass(frozen=True)
class _IceSheet:
    """Ice on the 60 m grid: thickness ``(H, W)`` [m], and its surface above the smoothed bed ``(H, W)`` [m]."""

    thickness_m: np.ndarray
    above_bed_m: np.ndarray


def _lowpass(values: np.ndarray, sigma_m: float, spacing_m: float) -> np.ndarray:
    return cv2.GaussianBlur(values.astype(np.float32), (0, 0), sigma_m / spacing_m, borderType=cv2.BORDER_REPLICATE)


def _soft_minimum(a: np.ndarray, b: np.ndarray, width: float) -> np.ndarray:
    return 0.5 * (a + b - np.sqrt((a - b) ** 2 + width**2))


def _carve_troughs(z: np.ndarray, area: np.ndarray, spacing_m: float) -> np.ndarray:
    """Widen valleys to the parabolic cross-section of glacial troughs.

    Parabolas after Svensson 1959 (Journal of Glaciology 3, 362); the floor's half-width increases with catchment.
    """
    for least, half_width, radius in ((0.35e6, 25.0, 90.0), (2e6, 70.0, 260.0), (10e6, 150.0, 420.0)):
        channel = area > least
        distance, nearest = cast(
            tuple[np.ndarray, np.ndarray],
            ndimage.distance_transform_edt(~channel, sampling=spacing_m, return_indices=True),
        )
        bed = z[tuple(nearest)] + np.maximum(distance - half_width, 0.0) ** 2 / radius
        z = np.where(distance < 6.0 * half_width + 200.0, _soft_minimum(z, bed, 30.0), z)
    return z


def _add_ledges(z: np.ndarray, lattice: Lattice, seed: int, period_m: float) -> np.ndarray:
    """Add ledges along gently dipping strata on steep ground."""
    spacing = lattice.spacing_m
    steep = np.hypot(*np.gradient(z, spacing))
    axis = (np.arange(z.shape[0]) - (z.shape[0] - 1) / 2.0) * spacing
    level = strata_level_m(z, axis, -axis, seed) / period_m
    phase = level - np.floor(level)
    step = phase * phase * (3.0 - 2.0 * phase)
    strength = 0.55 * np.clip((steep - 0.7) / 0.5, 0.0, 1.0) * np.clip((z - 1100.0) / 600.0, 0.3, 1.0)
    strength *= np.clip(0.6 + 0.5 * spline_noise(seed + 53 + int(period_m), 1200.0, axis, -axis), 0.0, 1.0)
    return z + strength * period_m * (step - phase)


def _erode(z: np.ndarray, lattice: Lattice, seed: int, stage: _Stage, erodibility: np.ndarray) -> np.ndarray:
    """Stream-power incision and slope relaxation, with uplift that maintains the shape at long wavelengths.

    ``erodibility`` ``(H, W)`` in [0, 1] scales the incision; see `_erodibility`.
    """
    spacing = stage.spacing_m
    outlets, links = lattice.border, lattice_links(lattice)
    cell_area = np.full(z.shape, spacing**2)
    axis = (np.arange(z.shape[0]) - (z.shape[0] - 1) / 2.0) * spacing
    rock_factor = np.exp(0.30 * fractal_noise(seed + 41, 1400.0, axis, -axis, octaves=6, gain=0.6))
    target = _lowpass(z, stage.uplift_scale_m, spacing)
    limit = np.tan(np.radians(stage.critical_slope_deg)) / np.clip(rock_factor, 0.7, 1.4)
    for _ in range(stage.iterations):
        routes = route_flow(z, links, outlets)
        area = accumulate(routes, cell_area)
        z = incise(z, routes, stage.incision_m * rock_factor * erodibility * (area / 1e6) ** 0.4)
        z = relax_slopes(z, links, limit, 2)
        z = z + _lowpass(target - z, stage.uplift_scale_m, spacing)
    return z


def _add_talus(z: np.ndarray, catchment_m2: np.ndarray, spacing_m: float) -> np.ndarray:
    """Add talus cones at the foot of couloirs, at the angle of repose (about 33°)."""
    smooth = _lowpass(z, 25.0, spacing_m)
    slope = np.hypot(*np.gradient(smooth, spacing_m))
    concave = _lowpass(z, 75.0, spacing_m) - smooth
    walls = cv2.dilate(slope.astype(np.float32), np.ones((2 * round(90.0 / spacing_m) + 1,) * 2, np.uint8))
    open_ground = np.hypot(*np.gradient(_lowpass(z, 75.0, spacing_m), spacing_m)) < 0.8
    foot = (concave > 3.0) & (slope > 0.4) & (slope < 0.85) & (walls > 1.25) & (z > 900.0) & (z < 3000.0) & open_ground
    supply = np.where(foot & (catchment_m2 > 8e3) & (catchment_m2 < 6e5), catchment_m2, 0.0).astype(np.float32)
    local_maximum = cv2.dilate(supply, np.ones((2 * round(75.0 / spacing_m) + 1,) * 2, np.uint8))
    surface, reach = z.copy(), round(255.0 / spacing_m)
    axis = np.arange(-reach, reach + 1) * spacing_m
    distance = np.hypot(axis[:, None], axis[None, :])
    # The profile flattens outwards (run-out of large blocks) and ends in a low front.
    drop = 0.70 * distance - 0.0004 * distance**2 + 0.006 * np.maximum(distance - 130.0, 0.0) ** 2
    for row, column in zip(*np.nonzero((supply > 0.0) & (supply == local_maximum)), strict=True):
        if min(row, column) < reach or row >= z.shape[0] - reach or column >= z.shape[1] - reach:
            continue
        window = np.s_[row - reach : row + reach + 1, column - reach : column + reach + 1]
        apex = z[row, column] + min(5.0 + 0.06 * np.sqrt(supply[row, column]), 28.0)
        np.maximum(surface[window], apex - drop, out=surface[window])
    return surface


def _sample_floor(floor: ValleyFloor, lattice: Lattice) -> ValleyFloor:
    """Interpolate valley floors from the 60 m grid to a lattice's points."""
    return ValleyFloor(*(_sample(a, 60.0, lattice, order=1) for a in (floor.height, floor.beyond_m, floor.shore_m)))


def _fill_valleys(z: np.ndarray, lattice: Lattice, floor: ValleyFloor, seed: int) -> np.ndarray:
    """Lower trough walls to the valley floors and fill the floors with sediment."""
    wall = floor.height + np.maximum(floor.beyond_m, 0.0) ** 2 / 300.0
    z = np.where(floor.beyond_m < 1500.0, _soft_minimum(z, wall, 40.0), z)
    fill = floor.height - 6.0 * np.clip(-floor.beyond_m / 300.0, 0.0, 1.0)
    weight = np.clip(-floor.beyond_m / 80.0, 0.0, 1.0)
    ripple = 1.3 * warped_noise(seed + 61, 330.0, lattice.east_m, lattice.north_m)
    z = z + weight * (fill + ripple - z)
    return np.where(floor.beyond_m < 100.0, np.maximum(z, floor.height - 8.0), z)


def _sample(z: np.ndarray, spacing_m: float, lattice: Lattice, order: int = 3) -> np.ndarray:
    """Interpolate a centred regular grid at a lattice's points by splines."""
    half = (z.shape[0] - 1) / 2.0
    at = np.stack([half - lattice.north_m / spacing_m, half + lattice.east_m / spacing_m])
    return ndimage.map_coordinates(z, at, order=order, mode="nearest")


def _regular_lattice(half_m: float, spacing_m: float) -> Lattice:
    return jittered_lattice(half_m, spacing_m, 0.0, np.random.default_rng(0))


def _ice_sheet(bed: np.ndarray) -> _IceSheet:
    """Ice on a 60 m bed ``(H, W)`` [m], computed at 120 m.

    The surface is stored relative to the smoothed bed, so that it follows changes of the bed in finer stages.
    """
    coarse = cv2.GaussianBlur(bed, (0, 0), 1.0)[::2, ::2]
    down, right = np.gradient(_lowpass(coarse, 240.0, 120.0), 120.0)
    northness = down / np.sqrt(1.0 + down**2 + right**2)
    ice = grow_ice(coarse, 120.0, 3000.0 - 260.0 * northness, rounds=350)
    grid = _regular_lattice((bed.shape[0] - 1) // 2 * 60.0, 60.0)
    thickness, surface = (_sample(_lowpass(a, 70.0, 120.0), 120.0, grid) for a in (ice, coarse + ice))
    return _IceSheet(thickness, surface - _lowpass(bed, _BED_SCALE_M, 60.0))


def _ice_thickness(bed: np.ndarray, ice: _IceSheet, lattice: Lattice) -> np.ndarray:
    """Ice thickness ``(H, W)`` [m] on a finer bed: thick ice has a smooth surface, thin ice follows the bed."""
    thickness, above_bed = (_sample(a, 60.0, lattice) for a in (ice.thickness_m, ice.above_bed_m))
    surface = above_bed + _lowpass(bed, _BED_SCALE_M, lattice.spacing_m)
    # Thin ice within a thick glacier also gets a smooth surface, to avoid pits over bumps of the coarse bed.
    mean_thickness = _lowpass(thickness, 150.0, lattice.spacing_m)
    deep = np.clip((np.maximum(thickness, 0.9 * mean_thickness) - 15.0) / 50.0, 0.0, 1.0)
    steep = _lowpass(np.hypot(*np.gradient(bed, lattice.spacing_m)), 20.0, lattice.spacing_m)
    adhesion = np.clip((0.85 + thickness / 60.0 - steep) / 0.3, 0.0, 1.0)
    concavity_factor = np.clip(1.0 + (_lowpass(bed, 60.0, lattice.spacing_m) - bed) / 12.0, 0.0, 1.5)
    filled = deep * (surface - bed) + (1.0 - deep) * 0.5 * thickness * adhesion * concavity_factor
    filled = np.where(((thickness > 10.0) | (mean_thickness > 35.0)) & (filled > 3.0), filled, 0.0)
    # Remove small components and components without an accumulation area.
    label, count = cast(tuple[np.ndarray, int], ndimage.label(filled > 0.0, np.ones((3, 3))))
    if not count:
        return filled
    numbers = np.arange(1, count + 1)
    area = ndimage.sum_labels(np.ones_like(bed), label, numbers) * lattice.spacing_m**2
    top = ndimage.maximum(bed, label, numbers)
    kept = np.append(False, (area > 1.2e5) & (top > 2750.0))
    return np.where(kept[label], filled, 0.0)


def _debris_cover(ice: _IceSheet, surface: np.ndarray) -> np.ndarray:
    """Debris cover of the ice ``(H, W)`` on the 60 m grid, by tracing flow lines upstream.

    Flow lines that originate in the accumulation area are free of debris; flow lines that originate at ice-free ground
    below it carry debris.
    """
    thickness, surface = ice.thickness_m, _lowpass(surface, 150.0, 60.0)
    down, right = np.gradient(surface, 60.0)
    steep = np.hypot(down, right) + 1e-4
    at = np.stack(np.nonzero(thickness > 10.0)).astype(float)
    debris_cover, active = np.zeros(at.shape[1]), np.ones(at.shape[1], bool)
    for _ in range(90):
        position = at[:, active]
        state = [
            ndimage.map_coordinates(a, position, order=1, mode="nearest")
            for a in (thickness, surface, down / steep, right / steep)
        ]
        rock, snow = state[0] < 14.0, state[1] > 3020.0
        debris_cover[np.flatnonzero(active)[rock & ~snow]] = 1.0
        at[:, active] = position + 0.8 * np.stack(state[2:])
        active[np.flatnonzero(active)[rock | snow]] = False
    debris = np.zeros(thickness.shape, np.float32)
    debris[thickness > 10.0] = debris_cover
    return debris


def _stage_surface(
    z: np.ndarray, lattice: Lattice, layout: MassifLayout, floor: ValleyFloor, stage: _Stage, erodibility: np.ndarray
) -> np.ndarray:
    """One stage of erosion, from heights on the jittered lattice to heights on the regular grid."""
    spacing = stage.spacing_m
    rng = np.random.default_rng(layout.seed + int(spacing) + 1)
    if stage.strata_m:
        z = z + erodibility * (_add_ledges(z, lattice, layout.seed, stage.strata_m) - z)
    steep = np.clip(np.hypot(*np.gradient(z, spacing)), 0.1, 1.2)
    z = z + stage.noise_m * erodibility * steep * _lowpass(rng.normal(0.0, 3.0, z.shape), 1.2 * spacing, spacing)
    z = _erode(z, lattice, layout.seed, stage, erodibility)
    if spacing >= 30.0:
        z = z + _sample(height_correction(z, lattice, layout), 120.0, lattice)
    if spacing == 60.0:
        routes = route_flow(z, lattice_links(lattice), lattice.border)
        z = _carve_troughs(z, accumulate(routes, np.full(z.shape, spacing**2)), spacing)
    z = resample_to_grid(z, lattice)
    above = np.maximum(z - _lowpass(z, 1.5 * spacing, spacing), 0.0)
    z = z + stage.sharpening * above * np.clip((z - 1700.0) / 900.0, 0.0, 1.0)
    regular = _regular_lattice((z.shape[0] - 1) // 2 * spacing, spacing)
    return _fill_valleys(z, regular, _sample_floor(floor, regular), layout.seed)


def _erodibility(z: np.ndarray, spacing_m: float, ice: _IceSheet | None, lattice: Lattice) -> np.ndarray:
    """Erodibility ``(H, W)`` in [0, 1]: 1 on bare rock, low under vegetation, lowest under ice."""
    if ice is None:
        return np.ones_like(z)
    steep = _lowpass(np.hypot(*np.gradient(z, spacing_m)), 60.0, spacing_m)
    bare = np.clip(0.2 + (z - 1500.0) / 1100.0 + 1.4 * (steep - 0.8), 0.12, 1.0)
    return bare * (1.0 - 0.92 * np.clip((_sample(ice.thickness_m, 60.0, lattice, order=1) - 30.0) / 50.0, 0.0, 1.0))


def relief(half_m: float, spacing_m: float, seed: int) -> Relief:
    """Generate the relief of the massif on a regular grid.

    Parameters
    ----------
    half_m
        Distance from the centre to the outermost cell centres [m].
    spacing_m
        Cell size [m], one of the stages' spacings up to 60.
    seed
        Seed of layout, lattices and noise.

    Returns
    -------
    Relief
        Elevation, ice, debris cover, catchments and valley floors.
    """
    layout = massif_layout(seed)
    floor = valley_floor(layout, _regular_lattice(half_m + 1020.0, 60.0))
    z: np.ndarray | None = None
    ice: _IceSheet | None = None
    debris: np.ndarray | None = None
    for stage in (stage for stage in _STAGES if stage.spacing_m >= spacing_m):
        spacing = stage.spacing_m
        rng = np.random.default_rng(seed + int(spacing))
        lattice = jittered_lattice(half_m + stage.margin_m, spacing, 0.38, rng)
        z = initial_heights(layout, lattice) if z is None else _sample(z, 2.0 * spacing, lattice)
        z = _stage_surface(z, lattice, layout, floor, stage, _erodibility(z, spacing, ice, lattice))
        if spacing == 60.0:
            ice = _ice_sheet(z)
            debris = _debris_cover(ice, _lowpass(z, _BED_SCALE_M, spacing) + ice.above_bed_m)
            z = z + np.clip((ice.thickness_m - 40.0) / 60.0, 0.0, 0.85) * (_lowpass(z, _BED_SCALE_M, spacing) - z)
    assert z is not None
    assert ice is not None
    assert debris is not None
    if spacing_m < 60.0:
        lattice = _regular_lattice((z.shape[0] - 1) // 2 * spacing_m, spacing_m)
        routes = route_flow(z, lattice_links(lattice), lattice.border)
        z = _add_talus(z, accumulate(routes, np.full(z.shape, spacing_m**2)), spacing_m)
    edge = (z.shape[0] - 1) // 2 - round(half_m / spacing_m)
    z = z[edge:-edge, edge:-edge]
    regular = _regular_lattice(half_m, spacing_m)
    thickness = _ice_thickness(z, ice, regular)
    z = z + thickness
    floor = _sample_floor(floor, regular)
    # A gently sloping beach avoids a step of one cell along the shore.
    beach = LAKE_LEVEL_M + 0.05 * floor.shore_m
    beach_weight = np.clip(1.0 - floor.shore_m / 70.0, 0.0, 1.0)
    z = np.maximum(z + beach_weight * (beach - z), beach - 0.08 * np.maximum(floor.shore_m - 100.0, 0.0))
    z = np.where(floor.shore_m < 0.0, LAKE_LEVEL_M, z)
    routes = route_flow(z, lattice_links(regular), regular.border)
    debris = np.clip(_sample(debris, 60.0, regular, order=1), 0.0, 1.0)
    return Relief(z, thickness, debris, accumulate(routes, np.full(z.shape, spacing_m**2)), floor)
