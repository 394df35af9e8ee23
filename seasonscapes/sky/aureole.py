"""Aerosol phase function broadened by multiple forward scattering, for the solar aureole.

Delta-M scaling treats the forward peak as unscattered light. Single scattering with the full phase function on top of
it (the TMS method of Nakajima & Tanaka 1988, doi:10.1016/0022-4073(88)90031-3) therefore gives a too narrow aureole.
In the small-angle limit each Legendre moment of a beam after a scattering depth τ is ``exp(-τ (1 - χ_l))``
(Goudsmit & Saunderson 1940). Up to the order L resolved by the multiple-scattering solution, delta-M replaces ``χ_l``
by ``f`` and the solution contains the difference. Moments beyond L are not part of that solution, so the moments of
the phase function are multiplied here to

    χ_l exp(-τ (f - χ_l))   for l > L,

relative to the scaled beam, with τ the aerosol scattering depth along the path from the sun via the scattering point to
the observer. This correction serves the purpose of the IMS correction of the same paper.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from seasonscapes.sky.atmosphere import Atmosphere, aerosol_phase, optics

_MAX_ORDER, _ANGLES, _DEPTHS, _MAX_DEPTH = 400, 96, 32, 30.0


def spread_aerosol_phase(cosine: np.ndarray, depth: np.ndarray, asymmetry: float, order: int) -> np.ndarray:
    """Evaluate the aerosol phase function broadened by multiple forward scattering.

    Parameters
    ----------
    cosine
        Cosine of the scattering angle ``(...)``.
    depth
        Aerosol scattering depth from the sun via the scattering point to the observer ``(..., 3)``.
    asymmetry
        Mean cosine of the scattering angle.
    order
        Truncation order L of the delta-M scaling.

    Returns
    -------
    ndarray
        Phase function per channel ``(..., 3)`` [1/sr].
    """
    table = _phase_reduction(asymmetry, order).ravel()
    column = np.sqrt(np.arccos(np.clip(cosine, -1.0, 1.0)) / np.pi) * (_ANGLES - 1)
    column0 = np.minimum(column.astype(np.int32), _ANGLES - 2)
    fc = (column - column0).astype(np.float32)
    # Channels first: numpy takes several times as long where the last axis has three elements.
    depth = np.ascontiguousarray(np.moveaxis(depth, -1, 0))
    row = np.sqrt(np.clip(depth / depth.dtype.type(_MAX_DEPTH), 0.0, 1.0)) * depth.dtype.type(_DEPTHS - 1)
    row0 = np.minimum(row.astype(np.int32), _DEPTHS - 2)
    fr, index = (row - row0).astype(np.float32), row0 * _ANGLES + column0
    reduction, next_row = table.take(index), table.take(index + _ANGLES)
    reduction += (table.take(index + 1) - reduction) * fc
    next_row += (table.take(index + (_ANGLES + 1)) - next_row) * fc
    reduction += (next_row - reduction) * fr
    return np.moveaxis(aerosol_phase(cosine, asymmetry) - reduction, 0, -1)


@lru_cache(maxsize=8)
def _phase_reduction(asymmetry: float, order: int) -> np.ndarray:
    """Reduction of the phase function ``(depth, angle)``, on grids uniform in the square roots of depth and angle."""
    moments = optics(Atmosphere(asymmetry=asymmetry), order=_MAX_ORDER).aerosol_moments
    depth = _MAX_DEPTH * np.linspace(0.0, 1.0, _DEPTHS) ** 2
    cosine = np.cos(np.pi * np.linspace(0.0, 1.0, _ANGLES) ** 2)
    degrees = np.arange(_MAX_ORDER + 1)
    reduction = moments * -np.expm1(-depth[:, None] * (moments[order + 1] - moments))
    reduction[:, : order + 1] = 0.0
    series = (2 * degrees + 1) / (4.0 * np.pi) * reduction
    return np.polynomial.legendre.legval(cosine, series.T).astype(np.float32)
