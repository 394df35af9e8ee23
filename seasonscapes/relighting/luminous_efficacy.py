"""Luminous efficacy of sunlight and skylight under clouds, for converting illuminance to irradiance.

Perez, Ineichen, Seals, Michalsky & Stewart 1990, "Modeling daylight availability and irradiance components from direct
and global irradiance", doi:10.1016/0038-092X(90)90055-H, table 4 and eqs 6–8, solved for the irradiance that gives an
illuminance. For cloudless atmospheres `sky.broadband` is closer. For the sun below 1°
elevation, and in twilight, the values at 1° are used.
"""

from __future__ import annotations

import numpy as np

from seasonscapes.sky.night import air_mass

# Lower bounds of the sky clearness ε of each class.
_CLEARNESS = np.array([1.0, 1.065, 1.23, 1.5, 1.95, 2.8, 4.5, 6.2])
# fmt: off
_DIFFUSE = np.array([
    (97.24, -0.46, 12.00, -8.91), (107.22, 1.15, 0.59, -3.95), (104.97, 2.96, -5.53, -8.77), (102.39, 5.59, -13.95, -13.90),
    (100.71, 5.94, -22.75, -23.74), (106.42, 3.83, -36.15, -28.83), (141.88, 1.90, -53.24, -14.03), (152.23, 0.35, -45.27, -7.98),
])
_DIRECT = np.array([
    (57.20, -4.55, -2.98, 117.12), (98.99, -3.46, -1.21, 12.38), (109.83, -4.90, -1.71, -8.81), (110.34, -5.84, -1.99, -4.56),
    (106.36, -3.97, -1.75, -6.16), (107.19, -1.25, -1.51, -26.73), (105.75, 0.77, -1.26, -34.44), (101.18, 1.58, -1.10, -8.29),
])
# fmt: on
_SOLAR_CONSTANT_W_M2 = 1361.0
# Precipitable water of a temperate summer in the mountains [cm]; it has little influence on the efficacies.
_WATER_CM = 1.4
# Fixed-point iterations for irradiance from illuminance.
_ITERATIONS = 6


def efficacies_lm_w(direct_normal_lx: float, diffuse_lx: float, sun_elevation_deg: float) -> tuple[float, float]:
    """Compute the luminous efficacies of sunlight and skylight from the illuminances at an instant.

    Parameters
    ----------
    direct_normal_lx
        Illuminance by the sun on a plane normal to its direction [lx].
    diffuse_lx
        Illuminance by the sky on the horizontal plane [lx].
    sun_elevation_deg
        Apparent elevation of the sun [deg].

    Returns
    -------
    direct, diffuse
        Luminous efficacy of sunlight and of skylight [lm/W].

    Examples
    --------
    >>> [round(value) for value in efficacies_lm_w(100_000.0, 12_000.0, 60.0)]
    [103, 134]
    """
    elevation_deg = float(np.clip(sun_elevation_deg, 1.0, 90.0))
    zenith = np.radians(90.0 - elevation_deg)
    cosine, mass = np.cos(zenith), float(air_mass(elevation_deg))
    direct, diffuse = 100.0, 125.0
    for _ in range(_ITERATIONS):
        beam, sky = direct_normal_lx / direct, max(diffuse_lx / diffuse, 1e-6)
        cubed = 1.041 * zenith**3
        clearness = ((sky + beam) / sky + cubed) / (1.0 + cubed)
        brightness = np.clip(sky * mass / _SOLAR_CONSTANT_W_M2, 0.01, 0.6)
        row = int(np.searchsorted(_CLEARNESS, clearness, side="right")) - 1
        a, b, c, d = _DIRECT[row]
        direct = max(a + b * _WATER_CM + c * np.exp(5.73 * zenith - 5.0) + d * brightness, 20.0)
        a, b, c, d = _DIFFUSE[row]
        diffuse = max(a + b * _WATER_CM + c * cosine + d * np.log(brightness), 60.0)
    return float(direct), float(diffuse)
