"""Luminous efficacy of clear sunlight and skylight from their spectra between 300 and 4000 nm.

The atmosphere model computes visible light alone. How many watts come with a lumen depends on the infrared, which water
vapour absorbs: the spectra of Bird & Riordan's simple spectral model give the ratio. Bird & Riordan 1984, "Simple solar
spectral model for direct and diffuse irradiance on horizontal and tilted planes at the earth's surface for cloudless
atmospheres", SERI/TR-215-2436, doi:10.2172/5986936, with the constants of NREL's program ``spectrl2_2.c``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from seasonscapes.sky.atmosphere import Atmosphere
from seasonscapes.sky.ephemeris import standard_pressure_hpa
from seasonscapes.sky.night import air_mass
from seasonscapes.sky.spectrum import BIN_CENTRES_NM, SOLAR_XYZ_LX

# Wavelength [nm], extraterrestrial irradiance at 1 au [W/m²/nm], absorption by water vapour [1/cm], by ozone [1/atm-cm] and by
# mixed gases: table 1 of Bird & Riordan.
# fmt: off
_SPECTRUM = np.array([
    (300, 0.5359, 0, 10, 0), (305, 0.5583, 0, 4.8, 0), (310, 0.622, 0, 2.7, 0), (315, 0.6927, 0, 1.35, 0),
    (320, 0.7151, 0, 0.8, 0), (325, 0.8329, 0, 0.38, 0), (330, 0.9619, 0, 0.16, 0), (335, 0.9319, 0, 0.075, 0),
    (340, 0.9006, 0, 0.04, 0), (345, 0.9113, 0, 0.019, 0), (350, 0.9755, 0, 0.007, 0), (360, 0.9759, 0, 0, 0),
    (370, 1.1199, 0, 0, 0), (380, 1.1038, 0, 0, 0), (390, 1.0338, 0, 0, 0), (400, 1.4791, 0, 0, 0),
    (410, 1.7013, 0, 0, 0), (420, 1.7404, 0, 0, 0), (430, 1.5872, 0, 0, 0), (440, 1.837, 0, 0, 0),
    (450, 2.005, 0, 0.003, 0), (460, 2.043, 0, 0.006, 0), (470, 1.987, 0, 0.009, 0), (480, 2.027, 0, 0.014, 0),
    (490, 1.896, 0, 0.021, 0), (500, 1.909, 0, 0.03, 0), (510, 1.927, 0, 0.04, 0), (520, 1.831, 0, 0.048, 0),
    (530, 1.891, 0, 0.063, 0), (540, 1.898, 0, 0.075, 0), (550, 1.892, 0, 0.085, 0), (570, 1.84, 0, 0.12, 0),
    (593, 1.768, 0.075, 0.119, 0), (610, 1.728, 0, 0.12, 0), (630, 1.658, 0, 0.09, 0), (656, 1.524, 0, 0.065, 0),
    (667.6, 1.531, 0, 0.051, 0), (690, 1.42, 0.016, 0.028, 0.15), (710, 1.399, 0.0125, 0.018, 0),
    (718, 1.374, 1.8, 0.015, 0), (724.4, 1.373, 2.5, 0.012, 0), (740, 1.298, 0.061, 0.01, 0),
    (752.5, 1.269, 0.0008, 0.008, 0), (757.5, 1.245, 0.0001, 0.007, 0), (762.5, 1.223, 1e-05, 0.006, 4),
    (767.5, 1.205, 1e-05, 0.005, 0.35), (780, 1.183, 0.0006, 0, 0), (800, 1.148, 0.036, 0, 0),
    (816, 1.091, 1.6, 0, 0), (823.7, 1.062, 2.5, 0, 0), (831.5, 1.038, 0.5, 0, 0), (840, 1.022, 0.155, 0, 0),
    (860, 0.9987, 1e-05, 0, 0), (880, 0.9472, 0.0026, 0, 0), (905, 0.8932, 7, 0, 0), (915, 0.8682, 5, 0, 0),
    (925, 0.8297, 5, 0, 0), (930, 0.8303, 27, 0, 0), (937, 0.814, 55, 0, 0), (948, 0.7869, 45, 0, 0),
    (965, 0.7683, 4, 0, 0), (980, 0.767, 1.48, 0, 0), (993.5, 0.7576, 0.1, 0, 0), (1040, 0.6881, 1e-05, 0, 0),
    (1070, 0.6407, 0.001, 0, 0), (1100, 0.6062, 3.2, 0, 0), (1120, 0.5859, 115, 0, 0), (1130, 0.5702, 70, 0, 0),
    (1145, 0.5641, 75, 0, 0), (1161, 0.5442, 10, 0, 0), (1170, 0.5334, 5, 0, 0), (1200, 0.5016, 2, 0, 0),
    (1240, 0.4775, 0.002, 0, 0.05), (1270, 0.4427, 0.002, 0, 0.3), (1290, 0.44, 0.1, 0, 0.02),
    (1320, 0.4168, 4, 0, 0.0002), (1350, 0.3914, 200, 0, 0.00011), (1395, 0.3589, 1000, 0, 1e-05),
    (1442.5, 0.3275, 185, 0, 0.05), (1462.5, 0.3175, 80, 0, 0.011), (1477, 0.3073, 80, 0, 0.005),
    (1497, 0.3004, 12, 0, 0.0006), (1520, 0.2928, 0.16, 0, 0), (1539, 0.2755, 0.002, 0, 0.005),
    (1558, 0.2721, 0.0005, 0, 0.13), (1578, 0.2593, 0.0001, 0, 0.04), (1592, 0.2469, 1e-05, 0, 0.06),
    (1610, 0.244, 0.0001, 0, 0.13), (1630, 0.2435, 0.001, 0, 0.001), (1646, 0.2348, 0.01, 0, 0.0014),
    (1678, 0.2205, 0.036, 0, 0.0001), (1740, 0.1908, 1.1, 0, 1e-05), (1800, 0.1711, 130, 0, 1e-05),
    (1860, 0.1445, 1000, 0, 0.0001), (1920, 0.1357, 500, 0, 0.001), (1960, 0.123, 100, 0, 4.3),
    (1985, 0.1238, 4, 0, 0.2), (2005, 0.113, 2.9, 0, 21), (2035, 0.1085, 1, 0, 0.13), (2065, 0.0975, 0.4, 0, 1),
    (2100, 0.0924, 0.22, 0, 0.08), (2148, 0.0824, 0.25, 0, 0.001), (2198, 0.0746, 0.33, 0, 0.00038),
    (2270, 0.0683, 0.5, 0, 0.001), (2360, 0.0638, 4, 0, 0.0005), (2450, 0.0495, 80, 0, 0.00015),
    (2500, 0.0485, 310, 0, 0.00014), (2600, 0.0386, 15000, 0, 0.00066), (2700, 0.0366, 22000, 0, 100),
    (2800, 0.032, 8000, 0, 150), (2900, 0.0281, 650, 0, 0.13), (3000, 0.0248, 240, 0, 0.0095),
    (3100, 0.0221, 230, 0, 0.001), (3200, 0.0196, 100, 0, 0.8), (3300, 0.0175, 120, 0, 1.9),
    (3400, 0.0157, 19.5, 0, 1.3), (3500, 0.0141, 3.6, 0, 0.075), (3600, 0.0127, 3.1, 0, 0.01),
    (3700, 0.0115, 2.5, 0, 0.00195), (3800, 0.0104, 1.4, 0, 0.004), (3900, 0.0095, 0.17, 0, 0.29),
    (4000, 0.0086, 0.0045, 0, 0.025),
])
# fmt: on
# Scale height of water vapour, about that of the U.S. Standard Atmosphere 1976 [m].
_WATER_SCALE_HEIGHT_M = 2000.0
# Pressure to which the model's Rayleigh depth refers [hPa].
_REFERENCE_HPA = 1013.0
# Air mass of light that the ground reflects and the sky sends back.
_DIFFUSE_AIR_MASS = 1.8
# With a lower sun the values at this elevation are used.
_LOWEST_DEG = 1.0


def clear_efficacies_lm_w(
    atmosphere: Atmosphere, sun_elevation_deg: float, height_m: float, *, water_cm: float
) -> tuple[float, float]:
    """Compute the luminous efficacies of sunlight and skylight in a cloudless atmosphere.

    Parameters
    ----------
    atmosphere
        Aerosol, ozone and ground albedo.
    sun_elevation_deg
        Apparent elevation of the sun [deg]; below 1° the efficacies at 1° are returned.
    height_m
        Height of the observer [m].
    water_cm
        Precipitable water above the atmosphere's ground [cm]; it decreases with height.

    Returns
    -------
    direct, diffuse
        Luminous efficacy of sunlight and of skylight [lm/W].

    Examples
    --------
    >>> from seasonscapes.sky.atmosphere import Atmosphere
    >>> [round(value) for value in clear_efficacies_lm_w(Atmosphere(), 60.0, 500.0, water_cm=1.4)]
    [108, 135]
    """
    elevation_deg = max(sun_elevation_deg, _LOWEST_DEG)
    above_m = max(height_m - atmosphere.ground_height_m, 0.0)
    depth_500 = atmosphere.aerosol_optical_depth_500nm * np.exp(-above_m / atmosphere.aerosol_scale_height_m)
    paths = _Paths(
        depth=depth_500 * (_SPECTRUM[:, 0] / 500.0) ** -atmosphere.angstrom_exponent,
        single_scattering_albedo=atmosphere.single_scattering_albedo,
        water_cm=water_cm * np.exp(-above_m / _WATER_SCALE_HEIGHT_M),
        ozone_atm_cm=atmosphere.ozone_du / 1000.0,
        pressure=float(standard_pressure_hpa(height_m)) / _REFERENCE_HPA,
    )
    direct, diffuse = _spectra(paths, elevation_deg, atmosphere.asymmetry, float(np.mean(atmosphere.ground_albedo)))
    return _efficacy(direct), _efficacy(diffuse)


@dataclass(frozen=True)
class _Paths:
    """What the light of the sun passes, per wavelength of `_SPECTRUM`."""

    depth: np.ndarray
    single_scattering_albedo: float
    water_cm: float
    ozone_atm_cm: float
    pressure: float

    def transmittances(self, mass: float, ozone_mass: float) -> tuple[np.ndarray, ...]:
        """By Rayleigh scattering, aerosol scattering, aerosol absorption, and absorption by gases."""
        wavelength_um = _SPECTRUM[:, 0] / 1000.0
        rayleigh = np.exp(-mass * self.pressure / (wavelength_um**4 * (115.6406 - 1.3366 / wavelength_um**2)))
        scattered = np.exp(-self.single_scattering_albedo * self.depth * mass)
        absorbed = np.exp(-(1.0 - self.single_scattering_albedo) * self.depth * mass)
        water, mixed = _SPECTRUM[:, 2] * self.water_cm * mass, _SPECTRUM[:, 4] * mass * self.pressure
        gases = np.exp(
            -0.2385 * water / (1.0 + 20.07 * water) ** 0.45
            - _SPECTRUM[:, 3] * self.ozone_atm_cm * ozone_mass
            - 1.41 * mixed / (1.0 + 118.3 * mixed) ** 0.45
        )
        return rayleigh, scattered, absorbed, gases


def _spectra(
    paths: _Paths, elevation_deg: float, asymmetry: float, ground_albedo: float
) -> tuple[np.ndarray, np.ndarray]:
    """Transfers of sunlight (normal) and of skylight (horizontal) per wavelength, over the extraterrestrial spectrum."""
    sine = float(np.sin(np.radians(elevation_deg)))
    mass, ozone_mass = float(air_mass(elevation_deg)), 1.003454 / np.sqrt(sine**2 + 0.006908)
    rayleigh, scattered, absorbed, gases = paths.transmittances(mass, ozone_mass)
    direct = rayleigh * scattered * absorbed * gases
    # The share of aerosol scattering that goes forwards, for the sun and for light that the ground sends up.
    log_rest = np.log(1.0 - asymmetry)
    linear = log_rest * (1.459 + log_rest * (0.1595 + log_rest * 0.4129))
    square = log_rest * (0.0783 + log_rest * (-0.3824 - log_rest * 0.5874))
    forward = 1.0 - 0.5 * np.exp((linear + square * sine) * sine)
    forward_up = 1.0 - 0.5 * np.exp((linear + square / _DIFFUSE_AIR_MASS) / _DIFFUSE_AIR_MASS)
    from_air = 0.5 * (1.0 - rayleigh**0.95) + rayleigh**1.5 * (1.0 - scattered) * forward
    sky = sine * gases * absorbed * from_air
    up_rayleigh, up_scattered, up_absorbed, up_gases = paths.transmittances(_DIFFUSE_AIR_MASS, 0.0)
    back = 0.5 * (1.0 - up_rayleigh) + (1.0 - forward_up) * up_rayleigh * (1.0 - up_scattered)
    reflectivity = up_gases * up_absorbed * back
    bounced = (direct * sine + sky) * reflectivity * ground_albedo / (1.0 - reflectivity * ground_albedo)
    # A correction of short wavelengths for what single scattering lacks.
    short = np.where(_SPECTRUM[:, 0] <= 450.0, ((_SPECTRUM[:, 0] + 550.0) / 1000.0) ** 1.8, 1.0)
    return direct, (sky + bounced) * short


def _efficacy(transfer: np.ndarray) -> float:
    """Lumens over watts of a transfer."""
    lumens = SOLAR_XYZ_LX[:, 1] @ np.interp(BIN_CENTRES_NM, _SPECTRUM[:, 0], transfer)
    watts = np.trapezoid(_SPECTRUM[:, 1] * transfer, _SPECTRUM[:, 0])
    return float(lumens / watts)
