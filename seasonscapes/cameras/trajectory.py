"""Paths of cameras through waypoints: at constant speed, smooth, clear of the ground.

A `Curve` is a position as a function of arc length. Cubic splines are twice continuously differentiable in their own
parameter (chord lengths, de Boor 1978) and so is their arc-length form, as long as the curve never stops.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from seasonscapes.cameras.pinhole import Camera

CURVES = ("spline", "linear")
TURNS = ("smooth", "slerp")
# Height of the ground ``(N,)`` in local up [m] at places ``(N, 2)`` east, north [m]; NaN where it is not known.
Ground = Callable[[np.ndarray], np.ndarray]

_PIECES = 64  # of each segment, for arc length
_GAUSS_X, _GAUSS_W = np.polynomial.legendre.leggauss(5)
# The ground is looked at this often along the curve, and this far to either side of it.
_PROBE_M, _MOST_PROBES = 5.0, 40_000
_CLEAR_ROUNDS = 6


@dataclass(frozen=True)
class Curve:
    """A path in space by arc length.

    Parameters
    ----------
    base
        Piecewise polynomial of the parameter, ``(..., 3)`` ENU [m].
    lift
        Piecewise polynomial that is added to the heights [m], or ``None``.
    knots
        Parameters ``(K,)`` of the waypoints.
    table
        Parameter and arc length ``(2, M)`` at the ends of small pieces.
    """

    base: Any
    lift: Any
    knots: np.ndarray
    table: np.ndarray

    @property
    def length_m(self) -> float:
        """From end to end [m]."""
        return float(self.table[1, -1])

    @property
    def waypoints_at_m(self) -> np.ndarray:
        """Arc length ``(K,)`` of the waypoints [m]."""
        return np.interp(self.knots, *self.table)

    def at_parameter(self, u: np.ndarray, order: int = 0) -> np.ndarray:
        """Position, or its derivative of an order, ``(N, 3)`` by the parameter."""
        place = np.array(self.base(u, order), float)
        if self.lift is not None:
            place[..., 2] += self.lift(u, order)
        return place

    def parameter(self, s_m: np.ndarray) -> np.ndarray:
        """The parameter ``(N,)`` at arc lengths [m], by bisection's start and Newton's steps."""
        u_table, s_table = self.table
        s_m = np.clip(np.asarray(s_m, float), 0.0, s_table[-1])
        piece = np.clip(np.searchsorted(s_table, s_m, side="right") - 1, 0, len(s_table) - 2)
        low, high = u_table[piece], u_table[piece + 1]
        u = low + (s_m - s_table[piece]) / (s_table[piece + 1] - s_table[piece]) * (high - low)
        for _ in range(4):
            speed = np.linalg.norm(self.at_parameter(u, 1), axis=-1)
            apart = s_table[piece] + _lengths(self.at_parameter, low, u) - s_m
            u = np.clip(u - apart / np.maximum(speed, 1e-12), low, high)
        return u

    def position(self, s_m: np.ndarray) -> np.ndarray:
        """Position ``(N, 3)`` ENU [m] at arc lengths ``(N,)`` [m]."""
        return self.at_parameter(self.parameter(s_m))

    def derivatives(self, s_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Unit tangent and curvature vector [1/m], ``(N, 3)`` each: first and second derivatives by arc length."""
        u = self.parameter(s_m)
        first, second = self.at_parameter(u, 1), self.at_parameter(u, 2)
        square = np.sum(first**2, axis=-1, keepdims=True)
        along = np.sum(first * second, axis=-1, keepdims=True)
        return first / np.sqrt(square), (second - first * along / square) / square


def _lengths(at: Callable, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Arc lengths ``(N,)`` between parameters that lie in one piece."""
    half, middle = 0.5 * (high - low), 0.5 * (high + low)
    speed = np.linalg.norm(at((middle[:, None] + half[:, None] * _GAUSS_X).ravel(), 1), axis=-1)
    return half * (speed.reshape(-1, len(_GAUSS_X)) @ _GAUSS_W)


def curve_through(positions_m: np.ndarray, *, curve: str = "spline", closed: bool = False) -> Curve:
    """A curve through waypoints ``(K, 3)`` ENU [m].

    Parameters
    ----------
    curve
        ``spline`` (cubic, natural ends) or ``linear``.
    closed
        Return to the first waypoint; without a corner there, for a spline.

    Raises
    ------
    ValueError
        Fewer than two waypoints, or two in a row at one place: a path must move on.
    """
    from scipy.interpolate import CubicSpline, PPoly

    if curve not in CURVES:
        raise ValueError(f"curve: got {curve!r}, expected one of {', '.join(CURVES)}")
    places = np.asarray(positions_m, float)
    if closed and not np.allclose(places[0], places[-1]):
        places = np.vstack([places, places[:1]])
    chords = np.linalg.norm(np.diff(places, axis=0), axis=1)
    if len(places) < 2 or chords.min() < 1e-3:
        raise ValueError("a path needs at least two waypoints, and no two in a row at the same place")
    knots = np.concatenate([[0.0], np.cumsum(chords)])
    if curve == "linear":
        base = PPoly(np.stack([np.diff(places, axis=0) / chords[:, None], places[:-1]]), knots)
    else:
        places = np.vstack([places[:-1], places[:1]]) if closed else places
        base = CubicSpline(knots, places, bc_type="periodic" if closed else "natural")
    return _measured(base, None, knots)


def _measured(base: Any, lift: Any, knots: np.ndarray) -> Curve:
    """A curve with its table of arc lengths."""
    cuts = [knots] if lift is None else [knots, lift.x]
    ends = np.unique(np.concatenate([*cuts, *(np.linspace(a, b, _PIECES + 1) for a, b in pairwise(knots))]))
    bare = Curve(base, lift, knots, np.zeros((2, 2)))
    lengths = _lengths(bare.at_parameter, ends[:-1], ends[1:])
    return Curve(base, lift, knots, np.stack([ends, np.concatenate([[0.0], np.cumsum(lengths)])]))


def lift_above_ground(curve: Curve, ground: Ground, clearance_m: float) -> tuple[Curve, float]:
    """The same curve lifted, smoothly, where it comes nearer to the ground than a clearance.

    Parameters
    ----------
    clearance_m
        Least height above the highest ground within so many metres to any side.

    Returns
    -------
    curve
        As smooth as it was: what is added to the heights is a cubic spline.
    lift_m
        The most that was added; 0 leaves the curve as it was. Waypoints near such a place are lifted with it.
    """
    from scipy.interpolate import CubicSpline
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d

    most = 0.0
    count = int(np.clip(curve.length_m / _PROBE_M, 200, _MOST_PROBES))
    # Wide enough that the lift is a gentle climb rather than a jump.
    reach = max(4, int(np.ceil(max(8.0 * clearance_m, 100.0) / curve.length_m * count)))
    for _ in range(_CLEAR_ROUNDS):
        u = curve.parameter(np.linspace(0.0, curve.length_m, count))
        missing = clearance_m - height_above_ground(curve.at_parameter(u), ground, clearance_m)
        missing = np.where(np.isfinite(missing), missing, -np.inf)
        if missing.max() <= 0.0:
            break
        # Half a metre more, for what lies between two probes.
        wanted = np.where(missing > -0.5, missing + 0.5, 0.0)
        wide = maximum_filter1d(np.maximum(wanted, 0.0), 2 * reach + 1, mode="nearest")
        more = gaussian_filter1d(wide, reach / 3.0, mode="nearest", truncate=3.0)
        most += float(more.max())
        total = more if curve.lift is None else more + curve.lift(u)
        curve = _measured(curve.base, CubicSpline(u, total, bc_type="natural"), curve.knots)
    else:
        raise ValueError(f"the path could not be kept {clearance_m:g} m above the ground")
    return curve, most


def height_above_ground(positions_m: np.ndarray, ground: Ground, around_m: float) -> np.ndarray:
    """Height ``(N,)`` [m] of places ``(N, 3)`` above the highest ground within ``around_m`` of them; NaN off the land."""
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
    clear_of: tuple[Ground, float] | None = None,
) -> list[Camera]:
    """Cameras along a path through waypoints, evenly spaced: exactly so many, none of them twice.

    Parameters
    ----------
    waypoints
        Their poses are passed through, their lenses blended; pictures have the size of the first one's.
    count
        Number of views, at least 2; a closed path does not come back to its first view.
    curve
        See `curve_through`.
    turn
        ``smooth`` (rotation spline, angular velocity and acceleration are continuous) or ``slerp`` (constant turns from
        waypoint to waypoint). Roll is blended by itself, so that a level horizon stays level.
    look_at_m
        ``(3,)`` ENU: look at this place all the way instead.
    clear_of
        The ground and a least clearance [m]; see `lift_above_ground`.

    Raises
    ------
    ValueError
        As `curve_through`; a look-at place straight above, below or on the path.
    """
    if count < 2:
        raise ValueError(f"count: got {count}, a path has at least 2 views")
    if turn not in TURNS:
        raise ValueError(f"turn: got {turn!r}, expected one of {', '.join(TURNS)}")
    waypoints = [*waypoints, waypoints[0]] if closed else list(waypoints)
    line = curve_through(np.array([each.position_m for each in waypoints]), curve=curve, closed=closed)
    if clear_of is not None:
        line, _ = lift_above_ground(line, *clear_of)
    return views_along(line, waypoints, count, turn=turn, look_at_m=look_at_m, closed=closed)


def views_along(
    line: Curve,
    waypoints: Sequence[Camera],
    count: int,
    *,
    turn: str = "smooth",
    look_at_m: np.ndarray | None = None,
    closed: bool = False,
) -> list[Camera]:
    """The views of `cameras_along_path`, on a curve that was made before (its knots are the waypoints)."""
    s_m = np.linspace(0.0, line.length_m, count, endpoint=not closed)
    places = line.position(s_m)
    if look_at_m is not None:
        rotations = _looking_at(places, np.asarray(look_at_m, float))
    else:
        known, at_m = [each.world_from_camera[:3, :3] for each in waypoints], line.waypoints_at_m
        if closed:
            # Once more before and after, so that the turning is as smooth where the ends meet.
            at_m = np.concatenate([at_m[:-1] - line.length_m, at_m, at_m[1:] + line.length_m])
            known = [*known[:-1], *known, *known[1:]]
        rotations = _turned(at_m, known, s_m, turn)
    lenses = np.array([(each.fx, each.fy, each.cx, each.cy) for each in waypoints], float)
    size = np.array([(each.width_px, each.height_px) for each in waypoints], float)
    # Lenses in pictures of the first one's size.
    scale = size[0] / size
    lenses *= scale[:, [0, 1, 0, 1]]
    lens = np.stack([np.interp(s_m, line.waypoints_at_m, column) for column in lenses.T], axis=1)
    views = []
    for place, rotation, (fx, fy, cx, cy) in zip(places, rotations, lens, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, place
        views.append(
            replace(waypoints[0], fx=float(fx), fy=float(fy), cx=float(cx), cy=float(cy), world_from_camera=pose)
        )
    return views


def _turned(at_m: np.ndarray, rotations: Sequence[np.ndarray], s_m: np.ndarray, turn: str) -> np.ndarray:
    """World-from-camera rotations ``(N, 3, 3)`` blended between those of the waypoints."""
    from scipy.spatial.transform import Rotation, RotationSpline, Slerp

    known = Rotation.from_matrix(np.array(rotations))
    if turn == "smooth" and len(rotations) > 2:
        blended = RotationSpline(at_m, known)(s_m).as_matrix()
    else:
        blended = Slerp(at_m, known)(np.clip(s_m, at_m[0], at_m[-1])).as_matrix()
    roll = np.interp(s_m, at_m, np.unwrap([roll_of(each) for each in rotations]))
    return np.array([_levelled(each[:, 2], angle, each) for each, angle in zip(blended, roll, strict=True)])


def roll_of(rotation: np.ndarray) -> float:
    """Turn of a camera about its axis against the horizon [rad], positive lowers the right-hand side; 0 straight down."""
    across = np.cross(rotation[:, 2], [0.0, 0.0, 1.0])
    if np.linalg.norm(across) < 1e-6:
        return 0.0
    return float(np.arctan2(-rotation[2, 0], -rotation[2, 1]))


def _levelled(forward: np.ndarray, roll: float, fallback: np.ndarray) -> np.ndarray:
    """Rotation that looks along a direction with a roll [rad]."""
    right = np.cross(forward, [0.0, 0.0, 1.0])
    norm = np.linalg.norm(right)
    if norm < 1e-6:
        return fallback
    right /= norm
    down = np.cross(forward, right)
    return np.stack(
        [np.cos(roll) * right + np.sin(roll) * down, -np.sin(roll) * right + np.cos(roll) * down, forward], axis=1
    )


def _looking_at(places: np.ndarray, target: np.ndarray) -> np.ndarray:
    offset = target - places
    distance = np.linalg.norm(offset, axis=1)
    flat = np.hypot(offset[:, 0], offset[:, 1])
    if (distance < 1e-3).any() or (flat < 1e-6 * distance).any():
        raise ValueError("look_at: the path passes through the place, or straight above or below it")
    return np.array([_levelled(each, 0.0, np.eye(3)) for each in offset / distance[:, None]])
