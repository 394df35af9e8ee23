"""Layout of the synthetic massif: crest and valley lines, the initial surface between them, valley floors and lake.

The lines are hand-drawn after the Bernese Alps: a main crest with three summits and a north wall above alpine benches,
a deep valley with a lake along its foot, a trough from the south-west, névé basins in the south.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree  # pyright: ignore[reportAttributeAccessIssue]

from seasonscapes.terrain.flow import Lattice
from seasonscapes.terrain.noise import warped_noise

LAKE_LEVEL_M = 566.0

# Polylines of (east [km], north [km], elevation [m]) about the massif's centre.
_Polyline = tuple[tuple[float, float, float], ...]
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
    # West of the trough, and north of the lake.
    ((-7.5, -4.0, 2900), (-6.3, -2.2, 2780), (-6.0, -0.2, 2500), (-5.9, 1.2, 2300), (-5.6, 2.2, 1500)),
    ((-7.5, 6.2, 1900), (-4.5, 6.3, 2020), (-2.0, 5.7, 2280), (0.4, 5.9, 2450), (2.4, 5.4, 2640), (4.8, 5.6, 2560),
     (7.5, 5.0, 2700)),
)  # fmt: skip
_VALLEYS = (
    # The main valley with the lake, then its tributary trough.
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
    """Densely sampled crest and valley lines of the massif.

    Parameters
    ----------
    crests, valleys
        Points ``(P, 3)`` on crest and valley lines: east, north, height [m] about the centre.
    trunk
        Points ``(P, 3)`` of the main valley [m].
    seed
        Seed of the domain warping that curves the lines.
    """

    crests: np.ndarray
    valleys: np.ndarray
    trunk: np.ndarray
    seed: int


def massif_layout(seed: int) -> MassifLayout:
    """Generate the layout: polylines with randomly displaced vertices, sampled every 50 m.

    Parameters
    ----------
    seed
        Seed of the displacements.

    Returns
    -------
    MassifLayout
        Sampled crest and valley lines.
    """
    rng = np.random.default_rng(seed)
    displaced: dict[tuple[float, float, float], np.ndarray] = {}

    def points_along(lines: Sequence[_Polyline], sag: float = 0.0) -> np.ndarray:
        points = []
        for line in lines:
            for knot in line:
                if knot not in displaced:
                    # Valley floors below 1300 m keep their heights, which the lake level depends on.
                    shift = rng.uniform(-1.0, 1.0, 3) * (90.0, 90.0, 25.0 if knot[2] > 1300 else 0.0)
                    displaced[knot] = np.array([knot[0] * 1000.0, knot[1] * 1000.0, knot[2]]) + shift
            knots = np.array([displaced[knot] for knot in line])
            along = np.append(0.0, np.cumsum(np.hypot(*np.diff(knots[:, :2], axis=0).T)))
            at = np.arange(0.0, along[-1], 50.0)
            line_points = np.stack([np.interp(at, along, knots[:, k]) for k in range(3)], -1)
            # Crests sag sinusoidally between summits, by a fraction of the span.
            leg = np.clip(np.searchsorted(along, at, side="right") - 1, 0, len(along) - 2)
            span = np.diff(along)[leg]
            line_points[:, 2] -= sag * np.minimum(span, 1600.0) * np.sin(np.pi * (at - along[leg]) / span)
            points.append(line_points)
        return np.concatenate(points)

    return MassifLayout(points_along(_CRESTS, sag=1.0 / 12.0), points_along(_VALLEYS), points_along(_VALLEYS[:1]), seed)


def warped_lattice(lattice: Lattice, seed: int) -> Lattice:
    """Apply domain warping: displace a lattice by smooth random noise of four octaves.

    Parameters
    ----------
    lattice
        Points to displace.
    seed
        Seed of the noise.

    Returns
    -------
    Lattice
        The displaced points.
    """
    east, north = lattice.east_m, lattice.north_m
    for octave, (wavelength, amplitude) in enumerate(((2600.0, 170.0), (1300.0, 110.0), (650.0, 60.0), (330.0, 30.0))):
        shift = [warped_noise(seed + 11 + 2 * octave + k, wavelength, lattice.east_m, lattice.north_m) for k in (0, 1)]
        east, north = east + amplitude * shift[0], north + amplitude * shift[1]
    return Lattice(east, north, lattice.spacing_m)


def _inverse_distance(points: np.ndarray, values: np.ndarray, position: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse-distance weighted mean of values at points, and the distance to the nearest point [m]."""
    distance, index = cKDTree(points[:, :2]).query(position, k=24)
    weight = 1.0 / (distance + 20.0) ** 3
    return (weight * values[index]).sum(-1) / weight.sum(-1), distance[..., 0]


def initial_heights(layout: MassifLayout, lattice: Lattice) -> np.ndarray:
    """Compute the initial surface by interpolation between valley and crest lines with a concave-up profile.

    Parameters
    ----------
    layout
        Layout of the massif.
    lattice
        Points at which heights are computed.

    Returns
    -------
    numpy.ndarray
        Heights ``(H, W)`` [m].
    """
    warped_points = warped_lattice(lattice, layout.seed)
    position = np.stack([warped_points.east_m, warped_points.north_m], -1)
    low, to_valley = _inverse_distance(layout.valleys, layout.valleys[:, 2], position)
    high, to_crest = _inverse_distance(layout.crests, layout.crests[:, 2], position)
    fraction = to_valley / (to_valley + to_crest + 1e-3)
    return low + (high - low) * (0.45 * fraction + 0.55 * fraction**2)


def _unwarped_positions(points: np.ndarray, seed: int) -> np.ndarray:
    """Positions ``(P, 2)`` [m] that the domain warping maps to the layout's points ``(P, 3)`` (fixed-point iteration)."""
    at = points[:, :2].copy()
    for _ in range(4):
        warped_points = warped_lattice(Lattice(at[:, 0], at[:, 1], 0.0), seed)
        at += points[:, :2] - np.stack([warped_points.east_m, warped_points.north_m], -1)
    return at


def height_correction(z: np.ndarray, lattice: Lattice, layout: MassifLayout) -> np.ndarray:
    """Compute a smooth correction that restores the layout's heights along crests and valleys after erosion.

    Parameters
    ----------
    z
        Eroded heights ``(H, W)`` [m].
    lattice
        Points of ``z``.
    layout
        Layout of the massif.

    Returns
    -------
    numpy.ndarray
        Correction ``(h, w)`` float32 [m] on a centred 120 m grid that covers the lattice.
    """
    spacing = lattice.spacing_m
    half = (z.shape[0] - 1) // 2
    size = 2 * round(150.0 / spacing) + 1
    axis = np.arange(-(n := int(np.ceil(half * spacing / 120.0))), n + 1) * 120.0
    position = np.stack(np.meshgrid(axis, -axis), -1)
    corrections = []
    for points, extreme in ((layout.valleys, ndimage.minimum_filter), (layout.crests, ndimage.maximum_filter)):
        at = _unwarped_positions(points, layout.seed)
        row, column = np.rint(half - at[:, 1] / spacing).astype(int), np.rint(half + at[:, 0] / spacing).astype(int)
        inside = (np.abs(at).max(axis=1) < half * spacing - 200.0).nonzero()[0]
        error = points[inside, 2] - extreme(z, size)[row[inside], column[inside]]
        corrections.append(_inverse_distance(at[inside], error, position))
    (low, to_valley), (high, to_crest) = corrections
    fraction = to_valley / (to_valley + to_crest + 1e-3)
    correction = (low + (high - low) * fraction).astype(np.float32)
    return cv2.GaussianBlur(correction, (0, 0), 1.0, borderType=cv2.BORDER_REPLICATE)


@dataclass(frozen=True)
class ValleyFloor:
    """Flat floors of the main valleys, and the lake; maps are ``(H, W)``.

    Parameters
    ----------
    height
        Height of the nearest part of the valley floor [m].
    beyond_m
        Signed horizontal distance to the floor's edge, negative on the floor [m].
    shore_m
        Signed horizontal distance to the lake's shore, negative on the lake [m]; approximate beyond a few hundred metres.
    """

    height: np.ndarray
    beyond_m: np.ndarray
    shore_m: np.ndarray


def valley_floor(layout: MassifLayout, lattice: Lattice) -> ValleyFloor:
    """Compute valley floors and lake from the layout alone, so that the shore is the same at every spacing.

    Parameters
    ----------
    layout
        Layout of the massif.
    lattice
        Points at which the maps are computed.

    Returns
    -------
    ValleyFloor
        Floor height, and signed distances to floor edge and shore.
    """
    warped_points = warped_lattice(lattice, layout.seed)
    points = layout.valleys[layout.valleys[:, 2] < 1010.0]
    distance, index = cKDTree(points[:, :2]).query(np.stack([warped_points.east_m, warped_points.north_m], -1), k=12)
    weight = 1.0 / (distance + 60.0) ** 3
    height = (weight * points[index, 2]).sum(-1) / weight.sum(-1)
    half_width = np.interp(height, [560.0, 585.0, 700.0, 1010.0], [450.0, 420.0, 230.0, 40.0])
    bays = sum(
        amplitude * warped_noise(layout.seed + 71 + k, wavelength, lattice.east_m, lattice.north_m)
        for k, (wavelength, amplitude) in enumerate(((900.0, 60.0), (350.0, 30.0), (140.0, 12.0)))
    )
    beyond = distance[..., 0] - half_width
    # The lake fills the main valley's floor between two deltas; its ends are rounded.
    position = np.stack([warped_points.east_m, warped_points.north_m], -1)
    to_trunk = cKDTree(layout.trunk[:, :2]).query(position)[0]
    shore = to_trunk - 370.0 + 0.6 * bays + 330.0 * ((warped_points.east_m + 1700.0) / 2500.0) ** 6
    return ValleyFloor(height, beyond + 0.5 * bays, np.clip(shore, -500.0, 3000.0))
