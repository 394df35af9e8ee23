"""Camera paths through waypoints: arc-length parametrised curves, ground clearance, interpolation of rotations.

A `Curve` gives the position as a function of arc length. Cubic splines with chord-length knots (de Boor 1978) are twice
continuously differentiable, and so is their arc-length parametrisation wherever the derivative does not vanish.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from seasonscapes.cameras.pinhole import Camera
from seasonscapes.errors import InvalidPath

if TYPE_CHECKING:
    from scipy.interpolate import PPoly

CURVES = ("spline", "linear")
TURNS = ("smooth", "slerp")
# Terrain height ``(N,)`` (local up) [m] at positions ``(N, 2)`` east, north [m]; NaN outside the terrain.
Ground = Callable[[np.ndarray], np.ndarray]

_PIECES = 64  # quadrature intervals per segment for arc length
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(5)
# Spacing of the clearance samples along the curve [m], their largest number, and the largest number of lifts.
_SAMPLE_M, _MAX_SAMPLES = 5.0, 40_000
_MAX_LIFTS = 6


@dataclass(frozen=True)
class Curve:
    """A space curve with arc-length parametrisation.

    Parameters
    ----------
    base
        Piecewise polynomial of the curve parameter, ``(..., 3)`` east-north-up [m].
    lift
        Piecewise polynomial that is added to the heights [m], or ``None``.
    knots
        Parameter values ``(K,)`` of the waypoints.
    table
        Parameter values and arc lengths ``(2, M)`` at the ends of the quadrature intervals.
    """

    base: PPoly
    lift: PPoly | None
    knots: np.ndarray
    table: np.ndarray

    @property
    def length_m(self) -> float:
        """Total arc length [m]."""
        return float(self.table[1, -1])

    @property
    def waypoints_at_m(self) -> np.ndarray:
        """Arc lengths ``(K,)`` of the waypoints [m]."""
        return np.interp(self.knots, *self.table)

    def at_parameter(self, u: np.ndarray, order: int = 0) -> np.ndarray:
        """Evaluate the position or a derivative with respect to the curve parameter.

        Parameters
        ----------
        u
            Parameter values ``(N,)``.
        order
            Order of the derivative; 0 for the position.

        Returns
        -------
        numpy.ndarray
            ``(N, 3)`` east-north-up.
        """
        value = np.array(self.base(u, order), float)
        if self.lift is not None:
            value[..., 2] += self.lift(u, order)
        return value

    def parameter(self, s_m: np.ndarray) -> np.ndarray:
        """Compute the curve parameter at given arc lengths by Newton's method.

        Parameters
        ----------
        s_m
            Arc lengths ``(N,)`` [m]; clipped to the curve.

        Returns
        -------
        numpy.ndarray
            Parameter values ``(N,)``.
        """
        u_table, s_table = self.table
        s_m = np.clip(np.asarray(s_m, float), 0.0, s_table[-1])
        piece = np.clip(np.searchsorted(s_table, s_m, side="right") - 1, 0, len(s_table) - 2)
        low, high = u_table[piece], u_table[piece + 1]
        u = low + (s_m - s_table[piece]) / (s_table[piece + 1] - s_table[piece]) * (high - low)
        for _ in range(4):
            speed = np.linalg.norm(self.at_parameter(u, 1), axis=-1)
            residual = s_table[piece] + _arc_lengths(self.at_parameter, low, u) - s_m
            u = np.clip(u - residual / np.maximum(speed, 1e-12), low, high)
        return u

    def position(self, s_m: np.ndarray) -> np.ndarray:
        """Evaluate the position at given arc lengths.

        Parameters
        ----------
        s_m
            Arc lengths ``(N,)`` [m]; clipped to the curve.

        Returns
        -------
        numpy.ndarray
            Positions ``(N, 3)`` east-north-up [m].
        """
        return self.at_parameter(self.parameter(s_m))

    def derivatives(self, s_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Evaluate the first and second derivatives with respect to arc length.

        Parameters
        ----------
        s_m
            Arc lengths ``(N,)`` [m]; clipped to the curve.

        Returns
        -------
        tangent
            Unit tangents ``(N, 3)``.
        curvature
            Curvature vectors ``(N, 3)`` [1/m].
        """
        u = self.parameter(s_m)
        first, second = self.at_parameter(u, 1), self.at_parameter(u, 2)
        square = np.sum(first**2, axis=-1, keepdims=True)
        along = np.sum(first * second, axis=-1, keepdims=True)
        return first / np.sqrt(square), (second - first * along / square) / square


def _arc_lengths(evaluate: Callable[[np.ndarray, int], np.ndarray], low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Arc lengths ``(N,)`` between parameters of one quadrature interval (Gauss–Legendre, 5 points)."""
    half, middle = 0.5 * (high - low), 0.5 * (high + low)
    speed = np.linalg.norm(evaluate((middle[:, None] + half[:, None] * _GAUSS_X).ravel(), 1), axis=-1)
    return half * (speed.reshape(-1, len(_GAUSS_X)) @ _GAUSS_W)


def curve_through(positions_m: np.ndarray, *, curve: str = "spline", closed: bool = False) -> Curve:
    """Interpolate waypoints by a curve.

    Parameters
    ----------
    positions_m
        Waypoints ``(K, 3)`` east-north-up [m].
    curve
        ``spline`` (cubic with natural end conditions) or ``linear``.
    closed
        Whether the curve returns to the first waypoint; splines are then periodic.

    Returns
    -------
    Curve
        The curve with its table of arc lengths.

    Raises
    ------
    InvalidPath
        Fewer than two waypoints, or two consecutive waypoints at the same position.
    ValueError
        Unknown ``curve``.

    Examples
    --------
    >>> import numpy as np
    >>> from seasonscapes.cameras.trajectory import curve_through
    >>> round(curve_through(np.array([[0.0, 0.0, 0.0], [3.0, 4.0, 0.0]]), curve="linear").length_m, 6)
    5.0
    """
    from scipy.interpolate import CubicSpline, PPoly

    if curve not in CURVES:
        raise ValueError(f"curve: got {curve!r}, expected one of {', '.join(CURVES)}")
    positions = np.asarray(positions_m, float)
    if closed and not np.allclose(positions[0], positions[-1]):
        positions = np.vstack([positions, positions[:1]])
    chords = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    if len(positions) < 2 or chords.min() < 1e-3:
        raise InvalidPath("a path needs at least two waypoints, and no two in a row at the same place")
    knots = np.concatenate([[0.0], np.cumsum(chords)])
    if curve == "linear":
        base = PPoly(np.stack([np.diff(positions, axis=0) / chords[:, None], positions[:-1]]), knots)
    else:
        positions = np.vstack([positions[:-1], positions[:1]]) if closed else positions
        base = CubicSpline(knots, positions, bc_type="periodic" if closed else "natural")
    return _with_arc_lengths(base, None, knots)


def _with_arc_lengths(base: PPoly, lift: PPoly | None, knots: np.ndarray) -> Curve:
    """Curve with its table of arc lengths."""
    cuts = [knots] if lift is None else [knots, lift.x]
    ends = np.unique(np.concatenate([*cuts, *(np.linspace(a, b, _PIECES + 1) for a, b in pairwise(knots))]))
    curve = Curve(base, lift, knots, np.zeros((2, 2)))
    lengths = _arc_lengths(curve.at_parameter, ends[:-1], ends[1:])
    return Curve(base, lift, knots, np.stack([ends, np.concatenate([[0.0], np.cumsum(lengths)])]))


@dataclass(frozen=True)
class GroundClearance:
    """Least height of a path above the terrain.

    Parameters
    ----------
    ground
        Terrain height as a function of position.
    clearance_m
        Least height above the terrain [m]; see `lift_above_ground`.
    """

    ground: Ground
    clearance_m: float


def lift_above_ground(curve: Curve, ground: Ground, clearance_m: float) -> tuple[Curve, float]:
    """Raise a curve smoothly where its clearance above the terrain is too small.

    Parameters
    ----------
    curve
        The curve.
    ground
        Terrain height as a function of position.
    clearance_m
        Least height above the highest terrain within a horizontal distance of ``clearance_m`` [m].

    Returns
    -------
    curve
        The curve with a cubic spline added to its heights; waypoints may be raised, too.
    lift_m
        Largest added height [m]; 0 if the curve is unchanged.

    Raises
    ------
    InvalidPath
        The clearance was not reached within the largest number of iterations.
    """
    from scipy.interpolate import CubicSpline
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d

    largest_lift_m = 0.0
    count = int(np.clip(curve.length_m / _SAMPLE_M, 200, _MAX_SAMPLES))
    # The width of the filters limits the slope of the added height.
    reach = max(4, int(np.ceil(max(8.0 * clearance_m, 100.0) / curve.length_m * count)))
    for _ in range(_MAX_LIFTS):
        u = curve.parameter(np.linspace(0.0, curve.length_m, count))
        missing = clearance_m - height_above_ground(curve.at_parameter(u), ground, clearance_m)
        missing = np.where(np.isfinite(missing), missing, -np.inf)
        if missing.max() <= 0.0:
            break
        # A margin of half a metre covers the terrain between samples.
        required = np.where(missing > -0.5, missing + 0.5, 0.0)
        widened = maximum_filter1d(np.maximum(required, 0.0), 2 * reach + 1, mode="nearest")
        added = gaussian_filter1d(widened, reach / 3.0, mode="nearest", truncate=3.0)
        total = added if curve.lift is None else added + curve.lift(u)
        largest_lift_m = float(total.max())
        curve = _with_arc_lengths(curve.base, CubicSpline(u, total, bc_type="natural"), curve.knots)
    else:
        raise InvalidPath(f"the path could not be kept {clearance_m:g} m above the ground; move its waypoints upwards")
    return curve, largest_lift_m


def height_above_ground(positions_m: np.ndarray, ground: Ground, around_m: float) -> np.ndarray:
    """Compute the height above the highest terrain within a horizontal radius, sampled at 17 points.

    Parameters
    ----------
    positions_m
        Positions ``(N, 3)`` east-north-up [m].
    ground
        Terrain height as a function of position.
    around_m
        Radius [m].

    Returns
    -------
    numpy.ndarray
        Heights ``(N,)`` [m]; NaN outside the terrain.
    """
    angle = np.arange(8) * (np.pi / 4.0)
    ring = around_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    offsets = np.vstack([np.zeros((1, 2)), 0.5 * ring, ring])
    heights = ground((positions_m[:, None, :2] + offsets).reshape(-1, 2)).reshape(len(positions_m), -1)
    known = np.isfinite(heights)
    highest = np.where(known, heights, -np.inf).max(axis=1)
    return np.where(known.any(axis=1), positions_m[:, 2] - highest, np.nan)


def cameras_along_path(
    waypoints: Sequence[Camera],
    count: int,
    *,
    curve: str = "spline",
    turn: str = "smooth",
    look_at_m: np.ndarray | None = None,
    closed: bool = False,
    clearance: GroundClearance | None = None,
) -> list[Camera]:
    """Interpolate cameras between waypoints, equally spaced in arc length.

    Parameters
    ----------
    waypoints
        Cameras whose poses are interpolated exactly. Intrinsics are interpolated linearly; images have the size of the
        first waypoint's.
    count
        Number of cameras, at least 2; a closed path does not repeat its first camera.
    curve
        Type of curve; see `curve_through`.
    turn
        ``smooth`` (rotation spline with continuous angular velocity and acceleration) or ``slerp`` (constant angular
        velocity between waypoints). Roll is interpolated separately, so that a level horizon remains level.
    look_at_m
        Position ``(3,)`` east-north-up [m] that all cameras are directed to, instead of interpolated rotations.
    closed
        Whether the path returns to the first waypoint.
    clearance
        Terrain and least height above it; ``None`` follows the waypoints alone.

    Returns
    -------
    list of Camera
        ``count`` cameras.

    Raises
    ------
    InvalidPath
        As `curve_through` and `lift_above_ground`; ``look_at_m`` lies on the path or vertically above or below it.
    ValueError
        ``count`` below 2, or unknown ``curve`` or ``turn``.
    """
    if count < 2:
        raise ValueError(f"count: got {count}, a path has at least 2 views")
    if turn not in TURNS:
        raise ValueError(f"turn: got {turn!r}, expected one of {', '.join(TURNS)}")
    waypoints = [*waypoints, waypoints[0]] if closed else list(waypoints)
    path = curve_through(np.array([camera.position_m for camera in waypoints]), curve=curve, closed=closed)
    if clearance is not None:
        path, _ = lift_above_ground(path, clearance.ground, clearance.clearance_m)
    return views_along(path, waypoints, count, turn=turn, look_at_m=look_at_m, closed=closed)


def views_along(
    path: Curve,
    waypoints: Sequence[Camera],
    count: int,
    *,
    turn: str = "smooth",
    look_at_m: np.ndarray | None = None,
    closed: bool = False,
) -> list[Camera]:
    """Interpolate cameras along a given curve; see `cameras_along_path`.

    Parameters
    ----------
    path
        Curve whose knots are the waypoints.
    waypoints, count, turn, look_at_m, closed
        As in `cameras_along_path`; for closed paths the first waypoint is repeated at the end of ``waypoints``.

    Returns
    -------
    list of Camera
        ``count`` cameras.

    Raises
    ------
    InvalidPath
        ``look_at_m`` lies on the path or vertically above or below it.
    """
    s_m = np.linspace(0.0, path.length_m, count, endpoint=not closed)
    positions = path.position(s_m)
    if look_at_m is not None:
        rotations = _look_at_rotations(positions, np.asarray(look_at_m, float))
    else:
        known, at_m = [camera.world_from_camera[:3, :3] for camera in waypoints], path.waypoints_at_m
        if closed:
            # Periodic continuation by one period on both sides keeps the rotation smooth at the joint.
            at_m = np.concatenate([at_m[:-1] - path.length_m, at_m, at_m[1:] + path.length_m])
            known = [*known[:-1], *known, *known[1:]]
        rotations = _interpolated_rotations(at_m, known, s_m, turn)
    known_intrinsics = np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in waypoints], float)
    size = np.array([(camera.width_px, camera.height_px) for camera in waypoints], float)
    # Scale the intrinsics to the image size of the first waypoint.
    scale = size[0] / size
    known_intrinsics *= scale[:, [0, 1, 0, 1]]
    intrinsics = np.stack([np.interp(s_m, path.waypoints_at_m, column) for column in known_intrinsics.T], axis=1)
    views = []
    for position, rotation, (fx, fy, cx, cy) in zip(positions, rotations, intrinsics, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, position
        views.append(
            replace(waypoints[0], fx=float(fx), fy=float(fy), cx=float(cx), cy=float(cy), world_from_camera=pose)
        )
    return views


def _interpolated_rotations(
    at_m: np.ndarray, rotations: Sequence[np.ndarray], s_m: np.ndarray, turn: str
) -> np.ndarray:
    """``world_from_camera`` rotations ``(N, 3, 3)`` interpolated between those of the waypoints."""
    from scipy.spatial.transform import Rotation, RotationSpline, Slerp

    known = Rotation.from_matrix(np.array(rotations))
    if turn == "smooth" and len(rotations) > 2:
        interpolated = RotationSpline(at_m, known)(s_m).as_matrix()
    else:
        interpolated = Slerp(at_m, known)(np.clip(s_m, at_m[0], at_m[-1])).as_matrix()
    roll = np.interp(s_m, at_m, np.unwrap([roll_of(rotation) for rotation in rotations]))
    return np.array(
        [
            _rotation_from_roll(rotation[:, 2], angle, rotation)
            for rotation, angle in zip(interpolated, roll, strict=True)
        ]
    )


def roll_of(rotation: np.ndarray) -> float:
    """Compute the roll of a camera against the horizon.

    Parameters
    ----------
    rotation
        ``world_from_camera`` rotation ``(3, 3)``.

    Returns
    -------
    float
        Roll [rad], positive if the right-hand side is lower; 0 for vertical optical axes.
    """
    across = np.cross(rotation[:, 2], [0.0, 0.0, 1.0])
    if np.linalg.norm(across) < 1e-6:
        return 0.0
    return float(np.arctan2(-rotation[2, 0], -rotation[2, 1]))


def _rotation_from_roll(forward: np.ndarray, roll: float, fallback: np.ndarray) -> np.ndarray:
    """Rotation with a given optical axis and roll [rad]; ``fallback`` for vertical axes."""
    right = np.cross(forward, [0.0, 0.0, 1.0])
    norm = np.linalg.norm(right)
    if norm < 1e-6:
        return fallback
    right /= norm
    down = np.cross(forward, right)
    return np.stack(
        [np.cos(roll) * right + np.sin(roll) * down, -np.sin(roll) * right + np.cos(roll) * down, forward], axis=1
    )


def _look_at_rotations(positions: np.ndarray, target: np.ndarray) -> np.ndarray:
    offset = target - positions
    distance = np.linalg.norm(offset, axis=1)
    flat = np.hypot(offset[:, 0], offset[:, 1])
    if (distance < 1e-3).any() or (flat < 1e-6 * distance).any():
        raise InvalidPath("look_at: the path passes through the target, or vertically above or below it")
    return np.array([_rotation_from_roll(forward, 0.0, np.eye(3)) for forward in offset / distance[:, None]])
