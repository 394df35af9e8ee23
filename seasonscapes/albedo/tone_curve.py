"""The camera's response curve: one strength of an S-curve, found where the photographs agree best under their light.

Webcams lift bright and darken dark values on top of sRGB. The family here is the cubic that keeps both ends of the encoded
range, ``(1 - s) e + s (3 e² - 2 e³)``; s = 0 is sRGB itself. What tells s apart from albedo is that one place is seen bright
and dark, at many hours, and that the sky is known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.albedo.closed_form import AlbedoFit, SolverOptions, solve_albedo
from seasonscapes.albedo.forward_model import TexelTransport
from seasonscapes.albedo.photographs import EIGHT_BIT, AlbedoPhotograph, NoiseModel, thinned_photographs
from seasonscapes.images import linear_from_srgb, srgb_from_linear

_QUICK = SolverOptions(rounds=3, iterations=8)
STRENGTHS = (0.0, 0.2, 0.4, 0.6)


@dataclass(frozen=True)
class ToneCurveFit:
    """The strength found, and the robust cost of every one that was tried."""

    strength: float
    costs: dict[float, float]


def invert_tone_curve(linear: np.ndarray, strength: float) -> np.ndarray:
    """Linear values ``(...)`` in [0, 1] of a picture that was decoded as plain sRGB but went through an S-curve."""
    if strength == 0.0:
        return linear
    knots = np.linspace(0.0, 1.0, 4097)
    curve = (1.0 - strength) * knots + strength * knots * knots * (3.0 - 2.0 * knots)
    encoded = np.interp(srgb_from_linear(linear), curve, knots)
    return linear_from_srgb(encoded)


def with_tone_curve(photographs: Sequence[AlbedoPhotograph], strength: float) -> list[AlbedoPhotograph]:
    """The same photographs with the S-curve taken out."""
    return [
        replace(
            photograph,
            observation=replace(
                photograph.observation, image=invert_tone_curve(photograph.observation.image, strength)
            ),
        )
        for photograph in photographs
    ]


def fit_tone_curve(
    land: TexelTransport,
    photographs: Sequence[AlbedoPhotograph],
    *,
    strengths: Sequence[float] = STRENGTHS,
    noise_model: NoiseModel = EIGHT_BIT,
    share: float = 0.2,
    start: AlbedoFit | None = None,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> ToneCurveFit:
    """The S-curve that all photographs share (one kind of webcam), by search over its strength.

    Raises
    ------
    ValueError
        Fewer than three strengths to try.
    """
    tell = progress or (lambda done: None)
    if len(strengths) < 3:
        raise ValueError("fit_response: three strengths at least")
    thin = thinned_photographs(photographs, share, seed)
    costs: dict[float, float] = {}

    def cost_at(strength: float) -> float:
        fit = solve_albedo(
            land,
            with_tone_curve(thin, strength),
            noise_model=noise_model,
            solver=_QUICK,
            start=None if start is None else start.albedo,
        )
        costs[strength] = fit.cost
        tell(len(costs) / (len(strengths) + 1))
        return fit.cost

    values = [cost_at(float(s)) for s in strengths]
    best = int(np.clip(np.argmin(values), 1, len(values) - 2))
    x, y = np.array(strengths[best - 1 : best + 2], float), values[best - 1 : best + 2]
    curve = np.polyfit(x, y, 2)
    if curve[0] > 0.0:
        guess = float(np.clip(-0.5 * curve[1] / curve[0], strengths[0], strengths[-1]))
        if min(abs(guess - s) for s in costs) > 0.01:
            cost_at(guess)
    tell(1.0)
    return ToneCurveFit(min(costs, key=costs.get), dict(sorted(costs.items())))
