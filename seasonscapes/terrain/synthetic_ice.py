"""Glaciers of the synthetic massif: shallow-ice approximation with an elevation-dependent mass balance."""

from __future__ import annotations

import numpy as np

# Glen's flow law for temperate ice in the shallow-ice approximation, 2 A (ρ g)³ / 5 with A = 2.4e-24 Pa⁻³ s⁻¹, ρ = 910 kg m⁻³,
# per year (Cuffey & Paterson, The Physics of Glaciers, 4th ed., 2010, table 3.4); doubled for sliding.
_FLUIDITY = 2.0 * 2.15e-5


def mass_balance_m(surface: np.ndarray, equilibrium_m: np.ndarray | float) -> np.ndarray:
    """Compute the annual surface mass balance as a function of height above the equilibrium line.

    The gradient of 0.85 m per 100 m is chosen so that the glaciers of the massif get the lengths of Alpine ones.
    Accumulation is limited to 1.6 m; ablation increases more steeply 1000 m below the equilibrium line.

    Parameters
    ----------
    surface
        Surface heights ``(H, W)`` [m].
    equilibrium_m
        Height of the equilibrium line, ``(H, W)`` or a scalar [m].

    Returns
    -------
    numpy.ndarray
        ``(H, W)`` ice gained (positive) or lost per year [m].
    """
    above = surface - equilibrium_m
    return np.minimum(0.0085 * above * (1.0 + np.maximum(-above - 1000.0, 0.0) / 500.0), 1.6)


def grow_ice(bed: np.ndarray, spacing_m: float, equilibrium_m: np.ndarray, *, rounds: int) -> np.ndarray:
    """Compute the near-steady-state ice thickness on a bed in the shallow-ice approximation.

    Explicit diffusion with local time steps: intermediate states are not physical, the steady state balances ice flux
    and mass balance (Huybrechts & Payne 1996, EISMINT, doi:10.3189/S0260305500013197). Accumulation vanishes on slopes
    above about 45°.

    Parameters
    ----------
    bed
        Bed heights ``(H, W)`` [m].
    spacing_m
        Cell size [m].
    equilibrium_m
        Height of the equilibrium line ``(H, W)`` [m].
    rounds
        Number of iterations.

    Returns
    -------
    numpy.ndarray
        Ice thickness ``(H, W)`` float32 [m]; zero at the border.
    """
    bed = np.asarray(bed, np.float32)
    thickness = np.zeros_like(bed)
    accumulation_factor = np.clip((1.1 - np.hypot(*np.gradient(bed, spacing_m))) / 0.45, 0.0, 1.0)
    for _ in range(rounds):
        surface = bed + thickness
        balance = mass_balance_m(surface, equilibrium_m)
        balance = np.where(balance > 0.0, balance * accumulation_factor, balance)
        down = (surface[1:] - surface[:-1]) / spacing_m
        right = (surface[:, 1:] - surface[:, :-1]) / spacing_m
        # The scheme of Mahaffy 1976 (doi:10.1029/JC081i006p01059): diffusivity at cell corners, flux at cell faces.
        ice = 0.25 * (thickness[1:, 1:] + thickness[1:, :-1] + thickness[:-1, 1:] + thickness[:-1, :-1])
        squared_slope = (0.5 * (down[:, 1:] + down[:, :-1])) ** 2 + (0.5 * (right[1:] + right[:-1])) ** 2
        diffusivity = np.pad(np.float32(_FLUIDITY) * ice**5 * np.minimum(squared_slope, 0.3), 1)
        across_rows = 0.5 * (diffusivity[1:-1, 1:] + diffusivity[1:-1, :-1])
        across_columns = 0.5 * (diffusivity[1:, 1:-1] + diffusivity[:-1, 1:-1])
        flux_down, flux_right = (
            np.pad(across_rows * down, ((1, 1), (0, 0))),
            np.pad(across_columns * right, ((0, 0), (1, 1))),
        )
        change = (np.diff(flux_down, axis=0) + np.diff(flux_right, axis=1)) / spacing_m
        stiffness = diffusivity[1:, 1:] + diffusivity[1:, :-1] + diffusivity[:-1, 1:] + diffusivity[:-1, :-1]
        step = np.minimum(0.16 * spacing_m**2 / (stiffness + 1.0), 10.0)
        thickness = np.maximum(thickness + step * (change + balance), 0.0)
        thickness[[0, -1]] = thickness[:, [0, -1]] = 0.0
    return thickness
