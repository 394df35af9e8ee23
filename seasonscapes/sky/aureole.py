"""How aerosol's forward peak spreads: the sun's aureole in air that scatters forwards more than once.

Delta-M scaling counts light in the forward peak as not scattered at all, so that a single scattering with the full
phase function after it (Nakajima & Tanaka's 1988 TMS, doi:10.1016/0022-4073(88)90031-3) keeps the aureole too narrow.
In the small-angle limit each Legendre moment of a beam that has passed a scattering depth τ is ``exp(-τ (1 - χ_l))``
(Goudsmit & Saunderson 1940). Up to the order L that the multiple scattering resolves, delta-M's ``f`` stands for
``χ_l`` and the rest is computed there; beyond it nothing else will do the spreading, so here the phase function's
moments are

    χ_l exp(-τ (f - χ_l))   for l > L,

relative to the scaled beam, with τ the scattering depth of aerosol along the whole way from the sun to the eye. This
plays the part of the IMS correction of the same paper.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from seasonscapes.sky.atmosphere import Atmosphere, aerosol_phase, optics

_ORDERS, _ANGLES, _DEPTHS, _DEEPEST = 400, 96, 32, 30.0


def spread_aerosol_phase(cosine: np.ndarray, depth: np.ndarray, asymmetry: float, order: int) -> np.ndarray:
    """Aerosol phase function [1/sr] after its forward peak has spread.

    Parameters
    ----------
    cosine
        Of the scattering angle ``(...)``.
    depth
        Scattering depth of aerosol from the sun to the eye ``(..., 3)``.
    asymmetry, order
        Mean cosine, and the order L of the delta-M scaling.
    """
    table = _lost(asymmetry, order).ravel()
    column = np.sqrt(np.arccos(np.clip(cosine, -1.0, 1.0)) / np.pi) * (_ANGLES - 1)
    column0 = np.minimum(column.astype(np.int32), _ANGLES - 2)
    fc = (column - column0).astype(np.float32)[..., None]
    row = np.sqrt(np.clip(depth / _DEEPEST, 0.0, 1.0)) * (_DEPTHS - 1)
    row0 = np.minimum(row.astype(np.int32), _DEPTHS - 2)
    fr, place = (row - row0).astype(np.float32), row0 * _ANGLES + column0[..., None]
    near, far = table.take(place), table.take(place + _ANGLES)
    near += (table.take(place + 1) - near) * fc
    far += (table.take(place + (_ANGLES + 1)) - far) * fc
    near += (far - near) * fr
    return aerosol_phase(cosine, asymmetry)[..., None] - near


@lru_cache(maxsize=8)
def _lost(asymmetry: float, order: int) -> np.ndarray:
    """What the phase function loses ``(depth, angle)``, on grids even in the square roots of depth and angle."""
    moments = optics(Atmosphere(asymmetry=asymmetry), order=_ORDERS).aerosol_moments
    depth = _DEEPEST * np.linspace(0.0, 1.0, _DEPTHS) ** 2
    cosine = np.cos(np.pi * np.linspace(0.0, 1.0, _ANGLES) ** 2)
    degrees = np.arange(_ORDERS + 1)
    lost = moments * -np.expm1(-depth[:, None] * (moments[order + 1] - moments))
    lost[:, : order + 1] = 0.0
    series = (2 * degrees + 1) / (4.0 * np.pi) * lost
    return np.polynomial.legendre.legval(cosine, series.T).astype(np.float32)
