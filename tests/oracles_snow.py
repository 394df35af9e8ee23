"""An independent model of snow's albedo: spheres of ice and delta-Eddington after Wiscombe & Warren 1980."""

from __future__ import annotations

import numpy as np

REFRACTIVE_INDEX = 1.31


def sphere_optics(radius_m: float, wavelength_m: float, absorption_index: float) -> tuple[float, float]:
    """Single-scattering albedo and asymmetry of a large, weakly absorbing sphere, by geometric optics.

    It extinguishes twice its cross section, and absorbs along the mean path of refracted rays.
    """
    gamma = 4.0 * np.pi * absorption_index / wavelength_m
    square = REFRACTIVE_INDEX**2
    absorbed = 4.0 / 3.0 * gamma * radius_m * square * (1.0 - (1.0 - 1.0 / square) ** 1.5)
    return 1.0 - 0.5 * absorbed, 0.89


def wiscombe_warren_albedo(radius_m: float, wavelength_m: float, absorption_index: float, cosine: float) -> float:
    """Albedo of deep snow for direct light: the delta-Eddington solution for a layer without end (their equation 4)."""
    omega, g = sphere_optics(radius_m, wavelength_m, absorption_index)
    scaled_g, scaled = g / (1.0 + g), (1.0 - g * g) * omega / (1.0 - g * g * omega)
    a = 1.0 - scaled * scaled_g
    xi = np.sqrt(3.0 * a * (1.0 - scaled))
    return float(scaled / (1.0 + 2.0 * xi / (3.0 * a)) * (1.0 - scaled_g / a * xi * cosine) / (1.0 + xi * cosine))
