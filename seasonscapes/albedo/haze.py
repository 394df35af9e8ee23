"""How hazy the air was: the visibility under which the photographs agree with each other and with their sky, by search.

Haze enters everything (sun, sky, airlight, transmittance), never linearly, but it is one number a day: so the closed form
is solved for a few visibilities, on a share of the pixels, and the robust cost is followed to its least. Airlight is not
free: it comes with the same sky model as the light, and the sky's own pixels fix the gain for every visibility that is
tried. (A free airlight runs away with the albedo: dark and hazy looks like bright and shaded.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.albedo.closed_form import AlbedoFit, SolverOptions, solve_albedo
from seasonscapes.albedo.forward_model import TexelTransport
from seasonscapes.albedo.photographs import LINEAR, AlbedoPhotograph, NoiseModel, thinned_photographs
from seasonscapes.sky.illumination import AerialPerspective, Illumination, Luminary

LightsOf = Callable[[float], Sequence[Illumination]]
# Half again as far from one to the next; from thick haze to polar air.
VISIBILITIES_KM = (12.0, 20.0, 33.0, 55.0, 90.0, 150.0)
_QUICK = SolverOptions(rounds=3, iterations=8)


@dataclass(frozen=True)
class HazeFit:
    """The visibility found [km], and the robust cost of every one that was tried."""

    visibility_km: float
    costs: dict[float, float]


@dataclass(frozen=True)
class MixedAir:
    """Aerial perspective between those of two visibilities: optical depths and the logarithms of airlight are mixed."""

    first: AerialPerspective
    second: AerialPerspective
    share: float

    def __call__(self, depth_m: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `AerialPerspective`."""
        near, far = self.first(depth_m, direction), self.second(depth_m, direction)
        return _mixed(near[0], far[0], self.share), _mixed(near[1], far[1], self.share)


def _mixed(a: np.ndarray, b: np.ndarray, share: float) -> np.ndarray:
    tiny = 1e-12
    mixed = np.exp((1.0 - share) * np.log(np.maximum(a, tiny)) + share * np.log(np.maximum(b, tiny)))
    # What is black in both stays so.
    return np.where((np.asarray(a) <= 0.0) & (np.asarray(b) <= 0.0), 0.0, mixed)


def mixed_light(first: Illumination, second: Illumination, share: float) -> Illumination:
    """A light between two of the same instant and another haze, ``share`` of the way from the first to the second."""

    def body(a: Luminary | None, b: Luminary | None) -> Luminary | None:
        if a is None or b is None:
            return a if b is None else b
        return replace(a, normal_illuminance_lx=_mixed(a.normal_illuminance_lx, b.normal_illuminance_lx, share))

    air = None
    if first.aerial_perspective is not None and second.aerial_perspective is not None:
        air = MixedAir(first.aerial_perspective, second.aerial_perspective, share)
    sky = _mixed(first.sky_radiance, second.sky_radiance, share).astype(np.float32)
    visible = None
    if first.visible_sky is not None and second.visible_sky is not None:
        visible = _mixed(first.visible_sky, second.visible_sky, share).astype(np.float32)
    return replace(
        first,
        sky_radiance=sky,
        sun=body(first.sun, second.sun),
        moon=body(first.moon, second.moon),
        aerial_perspective=air,
        visible_sky=visible,
    )


def fit_visibility(
    land: TexelTransport,
    photographs: Sequence[AlbedoPhotograph],
    lights_of: LightsOf,
    *,
    visibilities_km: Sequence[float] = VISIBILITIES_KM,
    noise_model: NoiseModel = LINEAR,
    share: float = 0.2,
    seed: int = 0,
    start: AlbedoFit | None = None,
    progress: Callable[[float], None] | None = None,
) -> HazeFit:
    """The meteorological range [km] that explains the photographs best.

    Parameters
    ----------
    lights_of
        The lights of all photographs for a visibility [km]. Asked at ``visibilities_km`` alone; between these, lights
        are mixed along the extinction.
    share
        Of the pixels that are used.
    start
        A fit to begin from.

    Raises
    ------
    ValueError
        Fewer than three visibilities.
    """
    tell = progress or (lambda done: None)
    nodes = sorted(map(float, visibilities_km))
    if len(nodes) < 3:
        raise ValueError("fit_visibility: three visibilities at least")
    thin = thinned_photographs(photographs, share, seed)
    lights: dict[float, Sequence[Illumination]] = {}
    costs: dict[float, float] = {}
    albedo = None if start is None else start.albedo

    def cost_at(visibility_km: float) -> float:
        nonlocal albedo
        if visibility_km not in costs:
            chosen = _lights_at(visibility_km, nodes, lights, lights_of)
            tried = [replace(photograph, light=light) for photograph, light in zip(thin, chosen, strict=True)]
            fit = solve_albedo(land, tried, noise_model=noise_model, solver=_QUICK, start=albedo)
            albedo, costs[visibility_km] = fit.albedo, fit.cost
            tell(min(1.0, len(costs) / 8.0))
        return costs[visibility_km]

    at = len(nodes) // 2
    while True:
        around = [i for i in (at - 1, at, at + 1) if 0 <= i < len(nodes)]
        best = min(around, key=lambda i: cost_at(nodes[i]))
        if best == at:
            break
        at = best
    triple = nodes[max(0, min(at - 1, len(nodes) - 3)) :][:3]
    for _ in range(3):
        guess = _parabola_least([1.0 / v for v in triple], [cost_at(v) for v in triple])
        guess_km = float(np.clip(1.0 / guess, nodes[0], nodes[-1])) if guess > 0.0 else nodes[-1]
        if min(abs(guess_km / v - 1.0) for v in triple) < 0.02:
            break
        cost_at(guess_km)
        # The best three that bracket the least, if they do.
        order = sorted([*triple, guess_km], key=cost_at)
        triple = sorted(order[:3])
    tell(1.0)
    return HazeFit(min(costs, key=costs.get), dict(sorted(costs.items())))


def _lights_at(visibility_km: float, nodes: list[float], held: dict, lights_of: LightsOf) -> Sequence[Illumination]:
    def node(value: float) -> Sequence[Illumination]:
        if value not in held:
            held[value] = list(lights_of(value))
        return held[value]

    if visibility_km in nodes:
        return node(visibility_km)
    upper = next(i for i, value in enumerate(nodes) if value > visibility_km)
    low, high = nodes[upper - 1], nodes[upper]
    # Extinction is what light depends on almost linearly, in the exponent.
    share = (1.0 / visibility_km - 1.0 / low) / (1.0 / high - 1.0 / low)
    return [mixed_light(a, b, share) for a, b in zip(node(low), node(high), strict=True)]


def _parabola_least(x: Sequence[float], y: Sequence[float]) -> float:
    """Abscissa of the least of the parabola through three points; the lowest point's where it opens downwards."""
    curve = np.polyfit(np.asarray(x) / x[0], y, 2)
    if curve[0] <= 0.0:
        return x[int(np.argmin(y))]
    return float(-0.5 * curve[1] / curve[0] * x[0])
