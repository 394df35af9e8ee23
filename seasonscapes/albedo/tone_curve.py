"""Tone curve of a camera: strength of an S-curve at which the photographs are most consistent under their lights.

Webcams brighten bright values and darken dark values on top of sRGB. The family here is the cubic that keeps both ends
of the encoded range, ``(1 - s) e + s (3 e² - 2 e³)``; s = 0 is sRGB itself. The strength s is separable from albedo
because each place is observed both bright and dark, at many hours, and because the sky radiance is known.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from seasonscapes.albedo.closed_form import SearchOptions, solve_albedo
from seasonscapes.albedo.forward_model import TexelTransport
from seasonscapes.albedo.photographs import EIGHT_BIT, AlbedoPhotograph, NoiseModel, thinned_photographs
from seasonscapes.images import linear_from_srgb, srgb_from_linear

STRENGTHS = (0.0, 0.2, 0.4, 0.6)


@dataclass(frozen=True)
class ToneCurveFit:
    """Result of the tone-curve search.

    Parameters
    ----------
    strength
        Strength of least cost.
    costs
        Robust cost of every strength that was tried.
    """

    strength: float
    costs: dict[float, float]


def invert_tone_curve(linear: np.ndarray, strength: float) -> np.ndarray:
    """Remove an S-curve from a picture that was decoded as plain sRGB.

    Parameters
    ----------
    linear
        ``(...)`` values in [0, 1].
    strength
        Strength of the S-curve, in [0, 1].

    Returns
    -------
    numpy.ndarray
        ``(...)`` scene-linear values in [0, 1].
    """
    if strength == 0.0:
        return linear
    knots = np.linspace(0.0, 1.0, 4097)
    curve = (1.0 - strength) * knots + strength * knots * knots * (3.0 - 2.0 * knots)
    encoded = np.interp(srgb_from_linear(linear), curve, knots)
    return linear_from_srgb(encoded)


def with_tone_curve(photographs: Sequence[AlbedoPhotograph], strength: float) -> list[AlbedoPhotograph]:
    """Remove an S-curve from photographs.

    Parameters
    ----------
    photographs
        Photographs decoded as plain sRGB.
    strength
        Strength of the S-curve, in [0, 1].

    Returns
    -------
    list of AlbedoPhotograph
        The same photographs with scene-linear values.
    """
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
    transport: TexelTransport,
    photographs: Sequence[AlbedoPhotograph],
    *,
    strengths: Sequence[float] = STRENGTHS,
    noise_model: NoiseModel = EIGHT_BIT,
    search: SearchOptions | None = None,
    progress: Callable[[float], None] | None = None,
) -> ToneCurveFit:
    """Estimate the strength of the S-curve that all photographs share (one type of webcam).

    Parameters
    ----------
    transport
        Daylight coefficients of the texels.
    photographs
        Photographs decoded as plain sRGB.
    strengths
        Strengths to try, rising, at least three; the minimum is refined by a parabola.
    noise_model
        Standard deviations that weight the residuals.
    search
        Pixels, initial albedo and iterations of each trial fit; defaults if omitted.
    progress
        Called with the finished fraction.

    Returns
    -------
    ToneCurveFit
        Best strength, and the cost of all that were tried.

    Raises
    ------
    ValueError
        If there are fewer than three strengths.
    NoUsablePixels, NotEnoughEvidence
        See `closed_form.solve_albedo`.
    """
    report, search = progress or (lambda fraction: None), search or SearchOptions()
    if len(strengths) < 3:
        raise ValueError(f"fit_tone_curve: got {len(strengths)} strengths, expected at least three")
    thinned = thinned_photographs(photographs, search.fraction, search.seed)
    costs: dict[float, float] = {}

    def cost_at(strength: float) -> float:
        fit = solve_albedo(
            transport,
            with_tone_curve(thinned, strength),
            noise_model=noise_model,
            solver=search.solver,
            start=None if search.start is None else search.start.albedo,
        )
        costs[strength] = fit.cost
        report(len(costs) / (len(strengths) + 1))
        return fit.cost

    values = [cost_at(float(s)) for s in strengths]
    best = int(np.clip(np.argmin(values), 1, len(values) - 2))
    x, y = np.array(strengths[best - 1 : best + 2], float), values[best - 1 : best + 2]
    curve = np.polyfit(x, y, 2)
    if curve[0] > 0.0:
        guess = float(np.clip(-0.5 * curve[1] / curve[0], strengths[0], strengths[-1]))
        if min(abs(guess - s) for s in costs) > 0.01:
            cost_at(guess)
    report(1.0)
    return ToneCurveFit(min(costs, key=costs.__getitem__), dict(sorted(costs.items())))
