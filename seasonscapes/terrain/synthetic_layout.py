"""The plan of the synthetic massif: where its crests and valleys run, before anything has carved them.

The composition is that of the Bernese Alps, drawn by hand: a main crest with three summits and a north wall above
alpine benches, a deep valley with a lake along its foot, a trough from the south-west, névé basins in the south.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from seasonscapes.terrain.flow import Lattice
from seasonscapes.terrain.noise import fractal_noise, spline_noise, warped_noise

LAKE_LEVEL_M = 566.0
LEDGES_M = (190.0, 92.0)  # spacing of the strata's ledges

# Knots (east km, north km, elevation m) about the massif's centre.
_CRESTS = (
    # The main crest from the west-south-west, three summits, and the north-east arête.
    ((-3.5, -4.3, 3050), (-2.6, -3.2, 4180), (-1.8, -2.65, 3420), (-0.7, -1.95, 4290), (0.3, -1.55, 3520),
     (1.5, -0.75, 4200), (2.3, -0.2, 3380), (3.2, 0.35, 2600), (3.9, 0.85, 1900)),
    ((-2.6, -3.2, 4180), (-2.5, -4.6, 3720), (-1.7, -5.7, 3560), (-1.1, -7.5, 3300)),
    ((-2.5, -4.6, 3720), (-1.4, -4.4, 3480), (-0.7, -4.75, 3200)),
    ((-0.7, -1.95, 4290), (-0.4, -2.8, 3700), (0.1, -3.7, 3420)),
    ((1.5, -0.75, 4200), (2.2, -1.9, 3420), (2.9, -3.3, 3840), (4.3, -4.2, 4160), (5.2, -5.6, 3500), (5.6, -7.5, 3200)),
    ((2.9, -3.3, 3840), (2.3, -4.3, 3680), (2.0, -5.3, 3420), (1.9, -6.3, 3000)),
    ((4.3, -4.2, 4160), (5.6, -3.0, 3560), (6.0, -1.5, 3800), (6.1, -0.1, 2900), (5.7, 0.9, 2000)),
    # The spur with the meadow summit north of the wall.
    ((0.3, -1.55, 3520), (0.1, -0.9, 2900), (-0.3, 0.0, 2120), (-1.0, 0.75, 2480), (-1.5, 1.5, 2240),
     (-1.9, 2.0, 1700)),
    # Beyond the trough in the west, and beyond the lake in the north.
    ((-7.5, -4.0, 2900), (-6.3, -2.2, 2780), (-6.0, -0.2, 2500), (-5.9, 1.2, 2300), (-5.6, 2.2, 1500)),
    ((-7.5, 6.2, 1900), (-4.5, 6.3, 2020), (-2.0, 5.7, 2280), (0.4, 5.9, 2450), (2.4, 5.4, 2640), (4.8, 5.6, 2560),
     (7.5, 5.0, 2700)),
)  # fmt: skip
_VALLEYS = (
    # The main valley with the lake, then the trough that joins it.
    ((7.5, 1.5, 1120), (5.4, 1.75, 1000), (3.6, 2.0, 820), (2.0, 2.45, 660), (1.0, 2.7, 590), (-0.6, 3.1, 570),
     (-2.6, 3.35, 570), (-4.6, 3.5, 570), (-6.0, 3.9, 566), (-7.5, 4.3, 562)),
    ((-4.2, 3.4, 572), (-4.1, 2.0, 640), (-4.25, 0.2, 740), (-4.5, -1.6, 860), (-4.6, -3.4, 1150), (-4.9, -4.9, 1750),
     (-5.5, -7.5, 2500)),
    # Névé basins and their glaciers.
    ((-1.5, -3.4, 3160), (-0.7, -4.0, 2850), (0.3, -4.8, 2640), (1.0, -5.9, 2430), (1.4, -7.5, 2200)),
    ((1.1, -2.1, 3050), (1.1, -3.2, 2760), (0.7, -4.6, 2620)),
    ((3.3, -4.5, 2950), (2.9, -5.4, 2600), (2.4, -7.5, 2050)),
    ((4.2, -3.2, 3150), (4.3, -2.2, 2850), (4.2, -1.2, 2350), (4.4, -0.2, 1800), (4.5, 0.8, 1250), (4.6, 1.7, 900)),
    ((6.3, -4.3, 2700), (6.8, -6.0, 2200), (7.5, -7.5, 1900)),
    ((7.2, -1.5, 2100), (7.4, 0.5, 1500), (7.5, 1.5, 1120)),
    # The foot of the north wall, its benches and the ravines below them.
    ((-2.6, -1.9, 2200), (-1.6, -1.1, 2120), (-0.7, -0.6, 2200)),
    ((0.5, 0.0, 2130), (1.4, 0.5, 1920), (2.4, 1.0, 1600), (3.1, 1.4, 1250)),
    ((0.6, 0.1, 2050), (0.9, 1.2, 1550), (1.4, 2.3, 700)),
    ((-1.6, -1.1, 2050), (-2.6, 0.3, 1650), (-3.8, 0.9, 760)),
    ((-3.5, -2.3, 1850), (-3.3, -1.2, 1720)),
)  # fmt: skip


@dataclass(frozen=True)
class MassifLayout:
    """Crest, valley and main valley points ``(P, 3)`` [m] about the centre, and the seed of what bends their lines."""

    crests: np.ndarray
    valleys: np.ndarray
    trunk: np.ndarray
    seed: int


def massif_layout(seed: int) -> MassifLayout:
    """The plan with its knots moved a little by the seed."""
    rng = np.random.default_rng(seed)
    moved: dict[tuple, np.ndarray] = {}

    def points_along(lines, sag: float = 0.0) -> np.ndarray:
        points = []
        for line in lines:
            for knot in line:
                if knot not in moved:
                    # The lowest floors keep their heights: they hold the lake.
                    shift = rng.uniform(-1.0, 1.0, 3) * (90.0, 90.0, 25.0 if knot[2] > 1300 else 0.0)
                    moved[knot] = np.array([knot[0] * 1000.0, knot[1] * 1000.0, knot[2]]) + shift
            knots = np.array([moved[knot] for knot in line])
            along = np.append(0.0, np.cumsum(np.hypot(*np.diff(knots[:, :2], axis=0).T)))
            at = np.arange(0.0, along[-1], 50.0)
            line_points = np.stack([np.interp(at, along, knots[:, k]) for k in range(3)], -1)
            # Crests sag between summits like a rope, a twelfth of the span.
            leg = np.clip(np.searchsorted(along, at, side="right") - 1, 0, len(along) - 2)
            span = np.diff(along)[leg]
            line_points[:, 2] -= sag * np.minimum(span, 1600.0) * np.sin(np.pi * (at - along[leg]) / span)
            points.append(line_points)
        return np.concatenate(points)

    return MassifLayout(points_along(_CRESTS, sag=1.0 / 12.0), points_along(_VALLEYS), points_along(_VALLEYS[:1]), seed)


def warped(lattice: Lattice, seed: int) -> Lattice:
    """The lattice seen through a smooth random displacement."""
    east, north = lattice.east_m, lattice.north_m
    for octave, (wavelength, reach) in enumerate(((2600.0, 170.0), (1300.0, 110.0), (650.0, 60.0), (330.0, 30.0))):
        shift = [warped_noise(seed + 11 + 2 * octave + k, wavelength, lattice.east_m, lattice.north_m) for k in (0, 1)]
        east, north = east + reach * shift[0], north + reach * shift[1]
    return Lattice(east, north, lattice.spacing_m)


def _spread(points: np.ndarray, values: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse-distance mean of values at points, and the distance to the nearest point [m]."""
    distance, index = cKDTree(points[:, :2]).query(position, k=24)
    weight = 1.0 / (distance + 20.0) ** 3
    return (weight * values[index]).sum(-1) / weight.sum(-1), distance[..., 0]


def sketched_heights(plan: MassifLayout, lattice: Lattice) -> np.ndarray:
    """Heights ``(H, W)`` [m] between the lines: valleys rise to crests along a hollow curve."""
    bent = warped(lattice, plan.seed)
    position = np.stack([bent.east_m, bent.north_m], -1)
    low, to_valley = _spread(plan.valleys, plan.valleys[:, 2], position)
    high, to_crest = _spread(plan.crests, plan.crests[:, 2], position)
    share = to_valley / (to_valley + to_crest + 1e-3)
    return low + (high - low) * (0.45 * share + 0.55 * share**2)


def _in_place(points: np.ndarray, seed: int) -> np.ndarray:
    """Where the plan's points ``(P, 3)`` come to lie once the warp has bent their lines, ``(P, 2)`` [m]."""
    at = points[:, :2].copy()
    for _ in range(4):
        bent = warped(Lattice(at[:, 0], at[:, 1], 0.0), seed)
        at += points[:, :2] - np.stack([bent.east_m, bent.north_m], -1)
    return at


def anchoring(z: np.ndarray, lattice: Lattice, plan: MassifLayout) -> np.ndarray:
    """What brings crests back up and valleys back down to the plan's heights.

    A smooth correction ``(h, w)`` [m] on the 120 m grid that covers the lattice's ground.
    """
    spacing = lattice.spacing_m
    half = (z.shape[0] - 1) // 2
    size = 2 * round(150.0 / spacing) + 1
    axis = np.arange(-(n := int(np.ceil(half * spacing / 120.0))), n + 1) * 120.0
    position = np.stack(np.meshgrid(axis, -axis), -1)
    corrections = []
    for points, extreme in ((plan.valleys, ndimage.minimum_filter), (plan.crests, ndimage.maximum_filter)):
        at = _in_place(points, plan.seed)
        row, column = np.rint(half - at[:, 1] / spacing).astype(int), np.rint(half + at[:, 0] / spacing).astype(int)
        inside = (np.abs(at).max(axis=1) < half * spacing - 200.0).nonzero()[0]
        error = points[inside, 2] - extreme(z, size)[row[inside], column[inside]]
        corrections.append(_spread(at[inside], error, position))
    (low, to_valley), (high, to_crest) = corrections
    share = to_valley / (to_valley + to_crest + 1e-3)
    correction = (low + (high - low) * share).astype(np.float32)
    return cv2.GaussianBlur(correction, (0, 0), 1.0, borderType=cv2.BORDER_REPLICATE)


def strata_level_m(z: np.ndarray, east_m: np.ndarray, north_m: np.ndarray, seed: int) -> np.ndarray:
    """Height within the folded, gently dipping strata ``(H, W)`` [m]: ledges and bands of rock follow it.

    ``east_m (W,)`` and ``north_m (H,)`` are the grid's axes, ``z (H, W)`` its heights [m].
    """
    fold = 70.0 * spline_noise(seed + 51, 4000.0, east_m, north_m)
    fold += 26.0 * fractal_noise(seed + 52, 900.0, east_m, north_m, octaves=3)
    return z + fold + 0.13 * east_m[None, :] - 0.09 * north_m[:, None]


@dataclass(frozen=True)
class ValleyFloor:
    """The flat ground of the main valleys.

    Parameters
    ----------
    height
        Of the nearest stretch of floor ``(H, W)`` [m].
    beyond_m
        Horizontal distance to the floor's edge, negative on the floor [m].
    shore_m
        Horizontal distance to the lake's shore, negative on the water [m]; rough beyond a few hundred metres.
    """

    height: np.ndarray
    beyond_m: np.ndarray
    shore_m: np.ndarray


def valley_floor(plan: MassifLayout, lattice: Lattice) -> ValleyFloor:
    """Floors and lake on a lattice; they hang on the plan alone, so every spacing sees the same shore."""
    bent = warped(lattice, plan.seed)
    points = plan.valleys[plan.valleys[:, 2] < 1010.0]
    distance, index = cKDTree(points[:, :2]).query(np.stack([bent.east_m, bent.north_m], -1), k=12)
    weight = 1.0 / (distance + 60.0) ** 3
    height = (weight * points[index, 2]).sum(-1) / weight.sum(-1)
    half_width = np.interp(height, [560.0, 585.0, 700.0, 1010.0], [450.0, 420.0, 230.0, 40.0])
    bays = sum(
        a * warped_noise(plan.seed + 71 + k, w, lattice.east_m, lattice.north_m)
        for k, (w, a) in enumerate(((900.0, 60.0), (350.0, 30.0), (140.0, 12.0)))
    )
    beyond = distance[..., 0] - half_width
    # The lake fills the main valley's floor between two deltas; its ends are round.
    position = np.stack([bent.east_m, bent.north_m], -1)
    to_trunk = cKDTree(plan.trunk[:, :2]).query(position)[0]
    shore = to_trunk - 370.0 + 0.6 * bays + 330.0 * ((bent.east_m + 1700.0) / 2500.0) ** 6
    return ValleyFloor(height, beyond + 0.5 * bays, np.clip(shore, -500.0, 3000.0))
