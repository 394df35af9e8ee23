"""Water on a lattice: steepest descent, catchments and erosion, without a loop over cells.

The lattice has the neighbours of a grid, but its points may be moved off their places: on an exact grid rivers and
crests settle into eight directions, and the eye sees it at once. Half a cell of jitter takes that away.

Everything along a flow path (sums, recurrences) is found by path doubling: after step ``k`` each cell knows the
result over its next ``2**k`` cells, and joins it with what the cell at the end of that stretch knows. A path of
2,000 cells takes 11 gathers. One implicit step of the stream-power law (Braun & Willett 2013,
doi:10.1016/j.geomorph.2012.10.008) then costs as much as a few filters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

_HALF_NEIGHBOURS = ((0, 1), (1, -1), (1, 0), (1, 1))


@dataclass(frozen=True)
class Lattice:
    """Points ``(H, W)`` [m] about a centre; ``east_m`` rises with the column, ``north_m`` falls with the row."""

    east_m: np.ndarray
    north_m: np.ndarray
    spacing_m: float

    @property
    def border(self) -> np.ndarray:
        """True on the outermost cells, ``(H, W)``."""
        border = np.zeros(self.east_m.shape, bool)
        border[[0, -1], :] = border[:, [0, -1]] = True
        return border


def jittered_lattice(half_m: float, spacing_m: float, jitter: float, rng: np.random.Generator) -> Lattice:
    """Square lattice about (0, 0) reaching at least ``half_m``; points move up to ``jitter`` cells along each axis."""
    half = int(np.ceil(half_m / spacing_m))
    axis = np.arange(-half, half + 1) * spacing_m
    shift = rng.uniform(-jitter * spacing_m, jitter * spacing_m, (2, len(axis), len(axis)))
    return Lattice(axis[None, :] + shift[0], -axis[:, None] + shift[1], spacing_m)


@dataclass(frozen=True)
class Links:
    """Lengths [m] of the steps between neighbours: an ``(h, w)`` array for each of four directions, with its slices."""

    first: tuple
    second: tuple
    length_m: tuple


def links_of(lattice: Lattice) -> Links:
    """The steps east, south-west, south and south-east of every cell."""
    height, width = lattice.east_m.shape
    first, second, length = [], [], []
    for dy, dx in _HALF_NEIGHBOURS:
        a = np.s_[0 : height - dy, max(-dx, 0) : width - max(dx, 0)]
        b = np.s_[dy:height, max(dx, 0) : width + min(dx, 0)]
        first.append(a)
        second.append(b)
        length.append(np.hypot(lattice.east_m[b] - lattice.east_m[a], lattice.north_m[b] - lattice.north_m[a]))
    return Links(tuple(first), tuple(second), tuple(length))


@dataclass(frozen=True)
class FlowRoutes:
    """Where each cell drains to.

    Parameters
    ----------
    receiver
        ``(N + 1,)`` flat index of the next cell; ``N`` (drained away) for outlets and for the sentinel ``N`` itself.
    distance_m
        ``(H, W)`` length of that step [m], 0 for outlets. The step out of a pit leads across its lowest pass.
    pits
        Number of interior cells without a lower neighbour.
    """

    receiver: np.ndarray
    distance_m: np.ndarray
    pits: int


def route_flow(elevation: np.ndarray, links: Links, outlets: np.ndarray) -> FlowRoutes:
    """Steepest-descent routes of a surface ``(H, W)`` [m] to ``outlets`` ``(H, W)`` bool; pits spill at their pass.

    Depressions are joined by the minimum spanning tree of their passes (Cordonnier et al. 2019,
    doi:10.5194/esurf-7-549-2019).
    """
    count, width = elevation.size, elevation.shape[1]
    steepest, offset = np.zeros_like(elevation), np.zeros(elevation.shape, np.int64)
    step = np.zeros_like(elevation)
    for (dy, dx), a, b, length in zip(_HALF_NEIGHBOURS, links.first, links.second, links.length_m, strict=True):
        slope = (elevation[a] - elevation[b]) / length
        for part, fall, way in ((a, slope, 1), (b, -slope, -1)):
            steeper = fall > steepest[part]
            steepest[part] = np.where(steeper, fall, steepest[part])
            offset[part] = np.where(steeper, way * (dy * width + dx), offset[part])
            step[part] = np.where(steeper, length, step[part])
    receiver = np.append(np.arange(count) + offset.ravel(), count)
    pit = np.flatnonzero((offset == 0) & ~outlets)
    receiver[pit] = receiver[np.flatnonzero(outlets)] = count
    step[outlets] = 0.0
    if len(pit):
        _spill(receiver, step, elevation, pit, float(np.median(links.length_m[0])))
    return FlowRoutes(receiver, step, len(pit))


def _spill(receiver, distance, elevation, pits, spacing_m) -> None:
    """Give each pit the cell beyond its lowest pass as receiver, in place."""
    count, width = elevation.size, elevation.shape[1]
    basin = _basins(receiver, pits).reshape(elevation.shape)
    index = np.arange(count).reshape(elevation.shape)
    height = elevation.shape[0]
    cells, passes = [], []
    for dy, dx in _HALF_NEIGHBOURS:
        a = np.s_[0 : height - dy, max(-dx, 0) : width - max(dx, 0)]
        b = np.s_[dy:height, max(dx, 0) : width + min(dx, 0)]
        border = basin[a] != basin[b]
        cells.append(np.stack([index[a][border], index[b][border]], -1))
        passes.append(np.maximum(elevation[a][border], elevation[b][border]))
    cells, passes = np.concatenate(cells), np.concatenate(passes)
    labels = basin.ravel()[cells]
    size = len(pits) + 1
    order = np.argsort(passes, kind="stable")
    key, first = np.unique((labels.min(axis=1) * size + labels.max(axis=1))[order], return_index=True)
    chosen = order[first]
    weight = passes[chosen] - passes.min() + 1.0
    graph = sparse.csr_array((weight, (labels[chosen].min(axis=1), labels[chosen].max(axis=1))), shape=(size, size))
    _, before = csgraph.breadth_first_order(csgraph.minimum_spanning_tree(graph), 0, directed=False)
    here, there = np.arange(1, size), before[1:]
    edge = chosen[np.searchsorted(key, np.minimum(here, there) * size + np.maximum(here, there))]
    beyond = np.where(labels[edge, 0] == there, cells[edge, 0], cells[edge, 1])
    receiver[pits] = beyond
    distance.ravel()[pits] = spacing_m * np.hypot(pits // width - beyond // width, pits % width - beyond % width)


def _basins(receiver: np.ndarray, pits: np.ndarray) -> np.ndarray:
    """Number of the pit ``(N,)`` that each cell drains to, counted from 1; 0 where it reaches an outlet."""
    ends = np.where(receiver == len(receiver) - 1, np.arange(len(receiver)), receiver)
    while not np.array_equal(further := ends[ends], ends):
        ends = further
    basin_of = np.zeros(len(receiver), np.int64)
    basin_of[pits] = np.arange(1, len(pits) + 1)
    return basin_of[ends[:-1]]


def accumulate(routes: FlowRoutes, amount: np.ndarray) -> np.ndarray:
    """What passes through each cell when every cell adds ``amount`` ``(H, W)``: catchment areas from cell areas."""
    total, ahead = np.append(amount.ravel().astype(float), 0.0), routes.receiver
    while (ahead[:-1] != len(ahead) - 1).any():
        total += np.bincount(ahead, weights=total, minlength=len(ahead))
        total[-1] = 0.0
        ahead = ahead[ahead]
    return total[:-1].reshape(amount.shape)


def recur(routes: FlowRoutes, constant: np.ndarray, factor: np.ndarray) -> np.ndarray:
    """Solve ``z = constant + factor * z[receiver]`` for all cells ``(H, W)``; beyond an outlet ``z`` is 0."""
    c, d = np.append(constant.ravel().astype(float), 0.0), np.append(factor.ravel().astype(float), 0.0)
    ahead = routes.receiver
    while (ahead[:-1] != len(ahead) - 1).any():
        c += d * c[ahead]
        d *= d[ahead]
        ahead = ahead[ahead]
    return c[:-1].reshape(constant.shape)


def incise(elevation: np.ndarray, routes: FlowRoutes, rate_m: np.ndarray) -> np.ndarray:
    """One implicit step of linear stream-power incision, ``rate_m = K A^m Δt`` ``(H, W)`` [m]; stable for any rate."""
    inside = routes.distance_m > 0.0
    courant = np.where(inside, rate_m / np.where(inside, routes.distance_m, 1.0), 0.0)
    return recur(routes, elevation / (1.0 + courant), courant / (1.0 + courant))


def slump(elevation: np.ndarray, links: Links, limit: np.ndarray, rounds: int) -> np.ndarray:
    """Let material slide where the step to a neighbour exceeds ``limit`` ``(H, W)``, the tangent it can stand."""
    z = elevation.copy()
    for _ in range(rounds):
        change = np.zeros_like(z)
        for a, b, length in zip(links.first, links.second, links.length_m, strict=True):
            fall = z[a] - z[b]
            stands = 0.5 * (limit[a] + limit[b]) * length
            moved = 0.12 * (fall - np.clip(fall, -stands, stands))
            change[a] -= moved
            change[b] += moved
        z += change
    return z


def on_grid(values: np.ndarray, lattice: Lattice) -> np.ndarray:
    """Values of a jittered lattice at its unmoved places, ``(H, W)``: a plane fitted to the neighbours of each.

    Moving least squares with a Gaussian weight of half a cell: planes come out exact, noise of one cell is softened.
    """
    height, width = values.shape
    half_row, half_column = (height - 1) // 2, (width - 1) // 2
    dx = lattice.east_m / lattice.spacing_m - (np.arange(width) - half_column)[None, :]
    dy = -lattice.north_m / lattice.spacing_m - (np.arange(height) - half_row)[:, None]
    padded = [np.pad(a, 1, mode="edge") for a in (values, dx, dy)]
    sums = np.zeros((9, height, width))
    for row in (-1, 0, 1):
        for column in (-1, 0, 1):
            part = np.s_[1 + row : 1 + row + height, 1 + column : 1 + column + width]
            v, x, y = padded[0][part] - values, padded[1][part] + column, padded[2][part] + row
            w = np.exp(-2.5 * (x * x + y * y))
            wx, wy = w * x, w * y
            for k, term in enumerate((w, wx, wy, wx * x, wx * y, wy * y, w * v, wx * v, wy * v)):
                sums[k] += term
    s, sx, sy, sxx, sxy, syy, sv, sxv, syv = sums
    minor = sxx * syy - sxy * sxy
    determinant = s * minor - sx * (sx * syy - sxy * sy) + sy * (sx * sxy - sxx * sy)
    top = sv * minor - sx * (sxv * syy - sxy * syv) + sy * (sxv * sxy - sxx * syv)
    return values + top / determinant
