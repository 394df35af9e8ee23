"""Glaciers of the synthetic massif: a thin sheet of ice that snow feeds and warmth consumes."""

from __future__ import annotations

import numpy as np

# Glen's law for temperate ice in the shallow-ice form, 2 A (ρ g)³ / 5 with A = 2.4e-24 Pa⁻³ s⁻¹, ρ = 910 kg m⁻³,
# per year (Cuffey & Paterson, The Physics of Glaciers, 4th ed., 2010, tables 3.4 and 8.1); doubled for sliding.
_FLUIDITY = 2.0 * 2.15e-5


def mass_balance_m(surface: np.ndarray, equilibrium_m: np.ndarray | float) -> np.ndarray:
    """Ice won or lost in a year [m]: 0.85 m per 100 m of height, less than 1.6 m of gain, and no ice far down.

    The gradient is that of Alpine glaciers (Huss & Bauder 2009, doi:10.3189/172756409787769645).
    """
    above = surface - equilibrium_m
    return np.minimum(0.0085 * above * (1.0 + np.maximum(-above - 1000.0, 0.0) / 500.0), 1.6)


def grow_ice(bed: np.ndarray, spacing_m: float, equilibrium_m: np.ndarray, *, rounds: int) -> np.ndarray:
    """Ice thickness ``(H, W)`` [m] near its steady state on a bed ``(H, W)`` [m].

    Shallow-ice diffusion with a step of its own for every cell: the way there is no history, the end state is the
    balance of flow and mass balance (Huybrechts et al. 1996, EISMINT, doi:10.3189/S0260305500013197). Faces steeper
    than about 45° shed their snow.
    """
    bed = np.asarray(bed, np.float32)
    thickness = np.zeros_like(bed)
    holds = np.clip((1.1 - np.hypot(*np.gradient(bed, spacing_m))) / 0.45, 0.0, 1.0)
    for _ in range(rounds):
        surface = bed + thickness
        balance = mass_balance_m(surface, equilibrium_m)
        balance = np.where(balance > 0.0, balance * holds, balance)
        down = (surface[1:] - surface[:-1]) / spacing_m
        right = (surface[:, 1:] - surface[:, :-1]) / spacing_m
        # Mahaffy's scheme (1976, doi:10.1029/JC081i006p01059): diffusivity on the corners, flux on the faces.
        ice = 0.25 * (thickness[1:, 1:] + thickness[1:, :-1] + thickness[:-1, 1:] + thickness[:-1, :-1])
        steep = (0.5 * (down[:, 1:] + down[:, :-1])) ** 2 + (0.5 * (right[1:] + right[:-1])) ** 2
        diffusivity = np.pad(np.float32(_FLUIDITY) * ice**5 * np.minimum(steep, 0.3), 1)
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
