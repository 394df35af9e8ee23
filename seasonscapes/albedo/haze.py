"""Visibility (meteorological range) from photographs, by one-dimensional minimisation of the albedo fit's robust cost.

Haze acts on sun, sky, airlight and transmittance, never linearly, but it is one number per day. The closed form is
therefore solved for a few visibilities on a fraction of the pixels, and the robust cost is minimised. Airlight is not a
free parameter: it comes from the same sky model as the light, and the sky pixels fix the gain at every visibility that
is tried. (With free airlight, haze and albedo are confounded: dark and hazy resembles bright and shaded.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.albedo.closed_form import SearchOptions, solve_albedo
from seasonscapes.albedo.forward_model import TexelTransport
from seasonscapes.albedo.photographs import LINEAR, AlbedoPhotograph, NoiseModel, thinned_photographs
from seasonscapes.sky.illumination import AerialPerspective, Illumination, Luminary

LightsOf = Callable[[float], Sequence[Illumination]]
# Geometric steps of about 1.65, from thick haze to polar air [km].
VISIBILITIES_KM = (12.0, 20.0, 33.0, 55.0, 90.0, 150.0)


@dataclass(frozen=True)
class HazeFit:
    """Result of the visibility search.

    Parameters
    ----------
    visibility_km
        Visibility of least cost [km].
    costs
        Robust cost of every visibility [km] that was tried.
    """

    visibility_km: float
    costs: dict[float, float]


@dataclass(frozen=True)
class MixedAir:
    """Aerial perspective interpolated between two visibilities, linear in optical depth and in the log of airlight.

    Parameters
    ----------
    first, second
        Aerial perspectives of the two visibilities.
    fraction
        Weight of the second, in [0, 1].
    """

    first: AerialPerspective
    second: AerialPerspective
    fraction: float

    def __call__(self, depth_m: np.ndarray, direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return transmittance and airlight; see `AerialPerspective`."""
        first, second = self.first(depth_m, direction), self.second(depth_m, direction)
        return _mixed(first[0], second[0], self.fraction), _mixed(first[1], second[1], self.fraction)


def _mixed(a: np.ndarray, b: np.ndarray, fraction: float) -> np.ndarray:
    """Geometric interpolation; zero where both values are zero."""
    tiny = 1e-12
    mixed = np.exp((1.0 - fraction) * np.log(np.maximum(a, tiny)) + fraction * np.log(np.maximum(b, tiny)))
    return np.where((np.asarray(a) <= 0.0) & (np.asarray(b) <= 0.0), 0.0, mixed)


def mixed_light(first: Illumination, second: Illumination, fraction: float) -> Illumination:
    """Interpolate geometrically between two lights of one instant under different visibility.

    Parameters
    ----------
    first, second
        The two lights.
    fraction
        Weight of the second, in [0, 1].

    Returns
    -------
    Illumination
        Sun, moon, sky and aerial perspective in between.
    """

    def body(a: Luminary | None, b: Luminary | None) -> Luminary | None:
        if a is None or b is None:
            return a if b is None else b
        return replace(a, normal_illuminance_lx=_mixed(a.normal_illuminance_lx, b.normal_illuminance_lx, fraction))

    air = None
    if first.aerial_perspective is not None and second.aerial_perspective is not None:
        air = MixedAir(first.aerial_perspective, second.aerial_perspective, fraction)
    sky = _mixed(first.sky_radiance, second.sky_radiance, fraction).astype(np.float32)
    visible = None
    if first.visible_sky is not None and second.visible_sky is not None:
        visible = _mixed(first.visible_sky, second.visible_sky, fraction).astype(np.float32)
    return replace(
        first,
        sky_radiance=sky,
        sun=body(first.sun, second.sun),
        moon=body(first.moon, second.moon),
        aerial_perspective=air,
        visible_sky=visible,
    )


def fit_visibility(
    transport: TexelTransport,
    photographs: Sequence[AlbedoPhotograph],
    lights_of: LightsOf,
    *,
    visibilities_km: Sequence[float] = VISIBILITIES_KM,
    noise_model: NoiseModel = LINEAR,
    search: SearchOptions | None = None,
    progress: Callable[[float], None] | None = None,
) -> HazeFit:
    """Estimate the meteorological range at which the albedo fit has the least robust cost.

    Parameters
    ----------
    transport
        Daylight coefficients of the texels.
    photographs
        Photographs of one day.
    lights_of
        Lights of all photographs as a function of visibility [km]. Evaluated at ``visibilities_km`` only; lights in
        between are interpolated, linearly in extinction.
    visibilities_km
        Nodes of the search [km], at least three.
    noise_model
        Standard deviations that weight the residuals.
    search
        Pixels, initial albedo and iterations of each trial fit; defaults if omitted.
    progress
        Called with the estimated finished fraction.

    Returns
    -------
    HazeFit
        Best visibility, and the cost of all that were tried.

    Raises
    ------
    ValueError
        If there are fewer than three visibilities.
    NoUsablePixels, NotEnoughEvidence
        See `closed_form.solve_albedo`.
    """
    report, search = progress or (lambda fraction: None), search or SearchOptions()
    nodes = sorted(map(float, visibilities_km))
    if len(nodes) < 3:
        raise ValueError(f"fit_visibility: got {len(nodes)} visibilities, expected at least three")
    thinned = thinned_photographs(photographs, search.fraction, search.seed)
    lights: dict[float, Sequence[Illumination]] = {}
    costs: dict[float, float] = {}
    albedo = None if search.start is None else search.start.albedo

    def cost_at(visibility_km: float) -> float:
        nonlocal albedo
        if visibility_km not in costs:
            tried_lights = _lights_at(visibility_km, nodes, lights, lights_of)
            relit = [replace(photograph, light=light) for photograph, light in zip(thinned, tried_lights, strict=True)]
            fit = solve_albedo(transport, relit, noise_model=noise_model, solver=search.solver, start=albedo)
            albedo, costs[visibility_km] = fit.albedo, fit.cost
            report(min(1.0, len(costs) / 8.0))
        return costs[visibility_km]

    at = len(nodes) // 2
    while True:
        around = [i for i in (at - 1, at, at + 1) if 0 <= i < len(nodes)]
        best = min(around, key=lambda i: cost_at(nodes[i]))
        if best == at:
            break
        at = best
    bracket = nodes[max(0, min(at - 1, len(nodes) - 3)) :][:3]
    for _ in range(3):
        extinction = _parabola_minimum([1.0 / v for v in bracket], [cost_at(v) for v in bracket])
        guess_km = float(np.clip(1.0 / extinction, nodes[0], nodes[-1])) if extinction > 0.0 else nodes[-1]
        if min(abs(guess_km / v - 1.0) for v in bracket) < 0.02:
            break
        cost_at(guess_km)
        order = sorted([*bracket, guess_km], key=cost_at)
        bracket = sorted(order[:3])
    report(1.0)
    return HazeFit(min(costs, key=costs.__getitem__), dict(sorted(costs.items())))


def _lights_at(
    visibility_km: float, nodes: list[float], cache: dict[float, Sequence[Illumination]], lights_of: LightsOf
) -> Sequence[Illumination]:
    """Lights of all photographs at a visibility, interpolated between the nodes, whose lights are cached."""

    def node(value: float) -> Sequence[Illumination]:
        if value not in cache:
            cache[value] = list(lights_of(value))
        return cache[value]

    if visibility_km in nodes:
        return node(visibility_km)
    upper = next(i for i, value in enumerate(nodes) if value > visibility_km)
    low, high = nodes[upper - 1], nodes[upper]
    # The logarithm of light is almost linear in extinction, which is proportional to 1 / visibility.
    fraction = (1.0 / visibility_km - 1.0 / low) / (1.0 / high - 1.0 / low)
    return [mixed_light(a, b, fraction) for a, b in zip(node(low), node(high), strict=True)]


def _parabola_minimum(x: Sequence[float], y: Sequence[float]) -> float:
    """Abscissa of the minimum of the parabola through three points; that of the lowest point if it opens downwards."""
    curve = np.polyfit(np.asarray(x) / x[0], y, 2)
    if curve[0] <= 0.0:
        return x[int(np.argmin(y))]
    return float(-0.5 * curve[1] / curve[0] * x[0])
