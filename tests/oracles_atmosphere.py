"""The atmosphere once more, slow and plain: straight rays, quadrature for one scattering, random walks for the rest.

Shares with the package what the air is made of (`seasonscapes.sky.atmosphere`), and nothing of how light goes through it: no
tables, no moments, no interpolation. Spectral, nine bands along each path. The sun is a point; there is no refraction.
All radiances are transfers [1/sr]: over the sun's spectral irradiance above the air.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.sky.atmosphere import (
    TOP_HEIGHT_M,
    Atmosphere,
    aerosol_phase,
    constituent_densities,
    gas_phase,
    optics,
)
from seasonscapes.sky.spectrum import WAVELENGTHS_NM

_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(40)
_NODES, _WEIGHTS = 0.5 * (_NODES + 1.0), 0.5 * _WEIGHTS
_CELLS, _LOBE_G = 64, 0.7


@dataclass(frozen=True)
class Walk:
    """What every function here needs: the air, its optics, and the direction to the sun ``(3,)``."""

    atmosphere: Atmosphere
    sun: np.ndarray

    @property
    def centre(self) -> float:
        return self.atmosphere.ground_radius_m - self.atmosphere.ground_height_m


def observer(atmosphere: Atmosphere, height_m: float) -> np.ndarray:
    """Position ``(3,)`` of an observer, the Earth's centre at the origin and up along z."""
    return np.array([0.0, 0.0, atmosphere.ground_radius_m - atmosphere.ground_height_m + height_m])


def once_scattered(
    walk: Walk, position: np.ndarray, direction: np.ndarray, *, nodes: int = 600, distance_m: float = np.inf
) -> np.ndarray:
    """Sunlight scattered once, and sunlit ground, along one ray ``(3,)`` up to a distance: quadrature, ``(B,)``."""
    edges, on_ground = _edges(walk, position[None], direction[None], cells=nodes, distance_m=distance_m)
    middle, length = 0.5 * (edges[0, 1:] + edges[0, :-1]), np.diff(edges[0])
    points = position + middle[:, None] * direction
    heights = np.linalg.norm(points, axis=1) - walk.centre
    density = constituent_densities(walk.atmosphere, heights)
    depth = (density * length).T @ optics(walk.atmosphere).extinction
    total = np.cumsum(depth, axis=0)
    transmittance = np.exp(-(total - 0.5 * depth))
    source = _source(walk, points, np.broadcast_to(direction, points.shape), density)
    light = (transmittance * source * length[:, None]).sum(axis=0)
    if on_ground[0]:
        end = position + edges[0, -1] * direction
        light += np.exp(-total[-1]) * _ground_radiance(walk, end[None])[0]
    return light


def many_times_scattered(
    walk: Walk,
    position: np.ndarray,
    direction: np.ndarray,
    *,
    paths: int,
    seed: int,
    bounces: int = 14,
    distance_m: float = np.inf,
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard error ``(B,)`` of light scattered twice or more along one ray ``(3,)``, by random walks.

    Its last scattering is nearer than ``distance_m``.
    """
    random = np.random.default_rng(seed)
    batches = [
        _walks(walk, position, direction, min(2048, paths), random, bounces, distance_m)
        for _ in range(max(paths // 2048, 1))
    ]
    samples = np.concatenate(batches)
    return samples.mean(axis=0), samples.std(axis=0) / np.sqrt(len(samples))


def _walks(walk: Walk, position, direction, count: int, random, bounces: int, distance_m: float) -> np.ndarray:
    where, heading = np.tile(position, (count, 1)), np.tile(direction, (count, 1))
    throughput, light = np.ones((count, len(WAVELENGTHS_NM))), np.zeros((count, len(WAVELENGTHS_NM)))
    alive = np.arange(count)
    for bounce in range(bounces):
        where, through, sigma, ground = _next_vertex(
            walk, where, heading, random, distance_m=np.inf if bounce else distance_m
        )
        if bounce:
            light[alive] += throughput * ground["radiance"]
            scattered = through * _source(walk, where, heading, None)
            light[alive] += throughput * np.where(ground["taken"][:, None], 0.0, scattered)
        # On into a new direction, from the air or from the ground.
        new, pdf, phases = _new_direction(walk, where, heading, ground["taken"], random)
        air = sigma[0] * phases[0][:, None] + sigma[1] * phases[1][:, None]
        albedo = np.asarray(walk.atmosphere.ground_albedo) / np.pi
        up = where / np.linalg.norm(where, axis=1, keepdims=True)
        lambert = albedo * np.maximum((new * up).sum(axis=1), 0.0)[:, None]
        factor = through * np.where(ground["taken"][:, None], lambert, air)
        throughput, heading = throughput * factor / pdf[:, None], new
        # Russian roulette on the brightest band once paths grow faint.
        chance = (
            np.minimum(1.0, throughput.max(axis=1) / 0.05)
            if bounce > 1
            else np.minimum(1.0, 1e6 * throughput.max(axis=1))
        )
        keep = random.random(len(chance)) < chance
        throughput = throughput[keep] / chance[keep, None]
        where, heading, alive = where[keep], heading[keep], alive[keep]
        if not len(alive):
            break
    return light


def _edges(
    walk: Walk, where, heading, *, cells: int = _CELLS, distance_m: float = np.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Edges of cells ``(N, cells + 1)`` [m] along rays, denser where the ray is lowest, and whether it meets ground."""
    radius = np.linalg.norm(where, axis=1)
    along = (where * heading).sum(axis=1)
    miss = radius**2 - along**2
    top, ground = walk.centre + TOP_HEIGHT_M, walk.atmosphere.ground_radius_m
    leave = -along + np.sqrt(np.maximum(top**2 - miss, 0.0))
    hits = (along < 0.0) & (miss < ground**2)
    end = np.where(hits, -along - np.sqrt(np.maximum(ground**2 - miss, 0.0)), leave)
    end, hits = np.clip(end, 0.0, distance_m), hits & (end <= distance_m)
    lowest = np.clip(-along, 0.0, end)
    v = np.linspace(0.0, 1.0, cells + 1)
    # Half of the cells before the lowest point where there is a way to go to it.
    part = np.where(lowest < 1.0, 0.0, np.where(end - lowest < 1.0, 1.0, 0.5))[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        before = lowest[:, None] * (1.0 - (1.0 - v / part) ** 2)
        after = lowest[:, None] + (end - lowest)[:, None] * ((v - part) / (1.0 - part)) ** 2
    return np.where(v < part, before, np.where(part == 1.0, end[:, None], after)), hits


def _next_vertex(walk: Walk, where, heading, random, *, distance_m: float):
    """A scattering vertex along each ray, chosen by a guess at what it will bring.

    Returns its position, transmittance over probability ``(N, B)``, the scattering coefficients ``(2, N, B)`` there,
    and for the ground its radiance seen from the start and whether the walk goes on from it.
    """
    count = len(where)
    edges, hits = _edges(walk, where, heading, distance_m=distance_m)
    middle, length = 0.5 * (edges[:, 1:] + edges[:, :-1]), np.diff(edges, axis=1)
    points = where[:, None] + middle[..., None] * heading[:, None]
    radius = np.linalg.norm(points, axis=-1)
    air = optics(walk.atmosphere)
    density = constituent_densities(walk.atmosphere, radius - walk.centre)
    depth = np.einsum("cns,cb->nsb", density * length, air.extinction)
    total = np.concatenate([np.zeros_like(depth[:, :1]), np.cumsum(depth, axis=1)], axis=1)
    scatter = np.einsum("cns,cb->nsb", density[:2], air.scattering[:2])
    guess = (scatter * np.exp(-0.5 * (total[:, 1:] + total[:, :-1]))).mean(axis=-1)
    guess *= (_sunlit_guess(walk, points, radius) + 0.01) * length
    guess += 1e-30
    share = guess / guess.sum(axis=1, keepdims=True)
    share = 0.95 * share + 0.05 / _CELLS
    to_ground = np.where(hits, 0.3, 0.0)
    cell = (np.cumsum(share, axis=1) > random.random((count, 1))).argmax(axis=1)
    rows = np.arange(count)
    fraction = random.random(count)
    distance = edges[rows, cell] + fraction * length[rows, cell]
    taken = random.random(count) < to_ground
    distance = np.where(taken, edges[:, -1], distance)
    transmittance = np.exp(-(total[rows, cell] + fraction[:, None] * depth[rows, cell]))
    at_end = np.exp(-total[:, -1])
    density_of_choice = share[rows, cell] / np.maximum(length[rows, cell], 1e-9) * (1.0 - to_ground)
    through = np.where(
        taken[:, None], at_end / np.maximum(to_ground, 1e-9)[:, None], transmittance / density_of_choice[:, None]
    )
    new = where + distance[:, None] * heading
    local = constituent_densities(walk.atmosphere, np.linalg.norm(new, axis=1) - walk.centre)
    sigma = local[:2, :, None] * air.scattering[:2, None, :]
    ends = where + edges[:, -1:] * heading
    radiance = np.zeros_like(at_end)
    if hits.any():
        radiance[hits] = at_end[hits] * _ground_radiance(walk, ends[hits])
    return new, through, sigma, {"taken": taken, "radiance": radiance}


def _sunlit_guess(walk: Walk, points, radius) -> np.ndarray:
    sine = points @ walk.sun / radius
    tangent = radius * np.sqrt(np.maximum(1.0 - sine**2, 0.0)) - walk.atmosphere.ground_radius_m
    return np.where(sine >= 0.0, 1.0, np.exp(-4.0 * np.exp(-np.clip(tangent, -5e4, 1e5) / 8e3)))


def _new_direction(walk: Walk, where, heading, from_ground, random):
    """A direction, its probability, and both phase functions towards it.

    From the air: isotropic, about the heading, or about the bright sky near the sun, one third each.
    """
    count = len(where)
    choice, u, turn = random.integers(0, 3, count), random.random(count), 2.0 * np.pi * random.random(count)
    up = where / np.linalg.norm(where, axis=1, keepdims=True)
    bright = walk.sun + up * np.maximum(0.15 - up @ walk.sun, 0.0)[:, None]
    bright /= np.linalg.norm(bright, axis=1, keepdims=True)
    axis = np.where((choice == 2)[:, None], bright, heading)
    axis = np.where(from_ground[:, None], up, axis)
    peak = (1.0 + _LOBE_G**2 - ((1.0 - _LOBE_G**2) / (1.0 - _LOBE_G + 2.0 * _LOBE_G * u)) ** 2) / (2.0 * _LOBE_G)
    cosine = np.where(from_ground, np.sqrt(u), np.where(choice == 0, 2.0 * u - 1.0, peak))
    new = _turned(axis, cosine, turn)
    scattering, to_bright = (new * heading).sum(axis=1), (new * bright).sum(axis=1)
    mixture = (1.0 / (4.0 * np.pi) + _lobe(scattering) + _lobe(to_bright)) / 3.0
    pdf = np.where(from_ground, np.maximum(cosine, 1e-9) / np.pi, mixture)
    return new, pdf, (gas_phase(scattering), aerosol_phase(scattering, walk.atmosphere.asymmetry))


def _lobe(cosine):
    return (1.0 - _LOBE_G**2) / (4.0 * np.pi * (1.0 + _LOBE_G**2 - 2.0 * _LOBE_G * cosine) ** 1.5)


def _turned(axis, cosine, turn):
    """Unit vectors at an angle from axes ``(N, 3)``."""
    other = np.where(np.abs(axis[:, 2:]) < 0.9, np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0]))
    side = np.cross(axis, other)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    other = np.cross(axis, side)
    sine = np.sqrt(np.maximum(1.0 - cosine**2, 0.0))
    return axis * cosine[:, None] + (side * np.cos(turn)[:, None] + other * np.sin(turn)[:, None]) * sine[:, None]


def _source(walk: Walk, points, heading, density) -> np.ndarray:
    """Sunlight scattered once into the walk's heading ``(N, B)`` [1/(m sr)]."""
    if density is None:
        density = constituent_densities(walk.atmosphere, np.linalg.norm(points, axis=1) - walk.centre)
    scattering = optics(walk.atmosphere).scattering
    cosine = heading @ walk.sun
    gas = (density[0] * gas_phase(cosine))[:, None] * scattering[0]
    aerosol = (density[1] * aerosol_phase(cosine, walk.atmosphere.asymmetry))[:, None] * scattering[1]
    return (gas + aerosol) * sun_transmittance(walk, points)


def _ground_radiance(walk: Walk, points) -> np.ndarray:
    sine = np.maximum(points @ walk.sun / np.linalg.norm(points, axis=1), 0.0)
    albedo = np.broadcast_to(np.asarray(walk.atmosphere.ground_albedo, float), WAVELENGTHS_NM.shape)
    return sun_transmittance(walk, points) * sine[:, None] * albedo / np.pi


def sun_transmittance(walk: Walk, points) -> np.ndarray:
    """Share of sunlight that reaches points ``(N, 3)`` along straight rays, ``(N, B)``; zero in the Earth's shadow."""
    radius = np.linalg.norm(points, axis=1)
    along = points @ walk.sun
    miss = radius**2 - along**2
    top, ground = walk.centre + TOP_HEIGHT_M, walk.atmosphere.ground_radius_m
    dark = (along < 0.0) & (miss < ground**2)
    lowest, end = np.maximum(-along, 0.0), -along + np.sqrt(np.maximum(top**2 - miss, 0.0))
    columns = 0.0
    for start, stop in ((lowest, 0.0 * lowest), (lowest, end)):
        reach = np.abs(stop - start)
        s = start[:, None] + np.sign(stop - start)[:, None] * reach[:, None] * _NODES**2
        height = np.sqrt(radius[:, None] ** 2 + 2.0 * s * along[:, None] + s**2) - walk.centre
        columns = columns + constituent_densities(walk.atmosphere, height) @ (2.0 * _NODES * _WEIGHTS) * reach
    return np.where(dark[:, None], 0.0, np.exp(-(columns.T @ optics(walk.atmosphere).extinction)))
