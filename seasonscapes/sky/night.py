"""Light sources of the night: irradiance of the moon, and background radiance of airglow, zodiacal light and stars.

Moonlight is computed by the same atmosphere model as sunlight: `moon_to_sun_ratio` is the ratio of the moon's
extraterrestrial spectral irradiance to the sun's, by which results for sunlight from the moon's direction are scaled.
Lunar eclipses are not modelled.

Individual stars are not modelled either, because no dependency includes a star catalogue (skyfield downloads
Hipparcos); their mean radiance is part of the background.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.frames import equirectangular_directions
from seasonscapes.sky.eclipses import moonlight_fraction
from seasonscapes.sky.ephemeris import LunarPosition
from seasonscapes.sky.illumination import diffuse_horizontal_illuminance

# Apparent V magnitudes: the sun at 1 au (Willmer 2018, Vega system), the full moon at its mean distance and 1 au from
# the sun, extrapolated to zero phase without the opposition surge (Allen 1973, Astrophysical Quantities, 3rd
# ed., p. 144).
SUN_MAGNITUDE_V, FULL_MOON_MAGNITUDE_V = -26.76, -12.73
_MEAN_MOON_DISTANCE_KM = 384_400.0

# Opposition surge: 35 % at full moon (Krisciunas & Schaefer 1991), decaying with the wavelength-independent width of
# the ROLO model (Kieffer & Stone 2005: p1 = 4.06°).
_SURGE, _SURGE_WIDTH_DEG = 0.35, 4.06

# Spectral slope of lunar reflectance: (B - V) = 0.92, compared with the sun's 0.65, gives a reflectance at 440 nm of
# 0.78 of that at 550 nm (Allen 1973); highland and mare spectra are linear over the visible range.
_MOON_SLOPE = 1.1

# Luminance of 1 S10, a tenth-magnitude (V) star spread over a square degree: 27.78 mag/arcsec². 10.8e4 cd/m² is the
# luminance of 0 mag/arcsec² (Garstang 1986; Cinzano et al. 2001).
CANDELA_OF_ZERO_MAGNITUDE = 10.8e4
S10_CD_M2 = CANDELA_OF_ZERO_MAGNITUDE * 10.0 ** (-0.4 * 27.78)

# Zenith luminances above the lower atmosphere at a middle phase of the solar cycle, chosen within what Roach & Gordon
# 1973, Benn & Ellison 1998 and Leinert et al. 1998 give: airglow 145 S10, zodiacal light 95 S10, stars and Milky Way
# 105 S10 as the mean over the sky. After extinction this gives the 21.6 mag/arcsec² of a natural sky of Garstang (1989) and Cinzano et al.
# (2001).
AIRGLOW_CD_M2, ZODIACAL_CD_M2, STARLIGHT_CD_M2 = 145.0 * S10_CD_M2, 95.0 * S10_CD_M2, 105.0 * S10_CD_M2

# Linear Rec.709 at luminance 1. Airglow: O I 557.7 nm 250 R, Na 589.3 nm 60 R, O I 630 nm 100 R and a flat continuum
# of 0.3 R/Å (Roach & Gordon 1973), whose sum agrees with the 145 S10 above. Zodiacal light: a Planckian of
# 5600 K, a slightly reddened solar spectrum (Leinert et al. 1998). Starlight: 4900 K, that is B - V = 0.8.
AIRGLOW_RGB = np.array([1.05602, 1.03358, 0.50235])
ZODIACAL_RGB = np.array([1.13231, 0.97270, 0.88077])
STARLIGHT_RGB = np.array([1.22929, 0.95798, 0.74095])

_AIRGLOW_HEIGHT_KM, _EARTH_RADIUS_KM = 90.0, 6371.0
# Extinction of an extended source is less than that of a star, since light is scattered into the line of sight from
# neighbouring directions: 15 % or more of the zodiacal light (Leinert et al. 1998, § 5). The factor of the optical depth
# is chosen.
_EXTENDED_SOURCE_FACTOR = 0.6


def moon_magnitude(moon: LunarPosition) -> float:
    """Compute the apparent V magnitude of the moon above the atmosphere.

    ``V = -12.73 + 0.026 |α| + 4e-9 α⁴`` with the phase angle α [deg] (Allen 1973; Krisciunas & Schaefer 1991, eq. 9),
    corrected for the opposition surge and for the distances moon-observer and moon-sun. Between 2° and 90° the phase
    curve is within 0.08 mag of the ROLO model's (Kieffer & Stone 2005), and the brightness within 10 %.

    Parameters
    ----------
    moon
        Position and phase.

    Returns
    -------
    float
        Apparent V magnitude; an array ``(T,)`` for many instants.
    """
    phase = np.abs(moon.phase_angle_deg)
    surge = 1.0 + _SURGE * np.exp(-phase / _SURGE_WIDTH_DEG)
    distances = (moon.distance_km / _MEAN_MOON_DISTANCE_KM) * moon.sun_distance_au
    return FULL_MOON_MAGNITUDE_V + 0.026 * phase + 4e-9 * phase**4 - 2.5 * np.log10(surge) + 5.0 * np.log10(distances)


def moon_to_sun_ratio(moon: LunarPosition, wavelength_nm: ArrayLike) -> np.ndarray:
    """Compute the extraterrestrial spectral irradiance of the moon over that of the sun at 1 au.

    Reddening with phase angle is neglected (under 5 %); an eclipse by the Earth's shadow is not.

    Parameters
    ----------
    moon
        Position and phase.
    wavelength_nm
        Wavelength ``(B,)`` [nm], 360 to 830.

    Returns
    -------
    ndarray
        Ratio ``(B,)``.
    """
    wavelength = np.asarray(wavelength_nm, float)
    visual = 10.0 ** (-0.4 * (moon_magnitude(moon) - SUN_MAGNITUDE_V))
    return visual * moonlight_spectrum(wavelength) * moonlight_fraction(moon, wavelength)


def moonlight_spectrum(wavelength_nm: np.ndarray) -> np.ndarray:
    """Spectral irradiance of the moon over that of the sun, relative to 550 nm: the same at all phases, ``(B,)``."""
    return 1.0 + _MOON_SLOPE * (wavelength_nm / 550.0 - 1.0)


def van_rhijn(elevation_deg: ArrayLike) -> np.ndarray:
    """Compute the radiance of a thin emitting layer at 90 km relative to the zenith (van Rhijn 1921).

    Parameters
    ----------
    elevation_deg
        Elevation ``(...)`` [deg].

    Returns
    -------
    ndarray
        Relative radiance ``(...)``, 1 at the zenith.
    """
    radius_ratio = _EARTH_RADIUS_KM / (_EARTH_RADIUS_KM + _AIRGLOW_HEIGHT_KM)
    return 1.0 / np.sqrt(1.0 - (radius_ratio * np.cos(np.radians(elevation_deg))) ** 2)


def air_mass(elevation_deg: ArrayLike) -> np.ndarray:
    """Compute the relative air mass (Kasten & Young 1989).

    Parameters
    ----------
    elevation_deg
        Apparent elevation ``(...)`` [deg].

    Returns
    -------
    ndarray
        Relative air mass ``(...)``, 1 at the zenith; below 0° the value of 38 at the horizon.
    """
    elevation = np.maximum(np.asarray(elevation_deg, float), 0.0)
    return 1.0 / (np.sin(np.radians(elevation)) + 0.50572 * (elevation + 6.07995) ** -1.6364)


def night_sky_radiance(
    height: int, width: int, *, height_m: float = 0.0, optical_depth: float = 0.19, ground_albedo: float = 0.2
) -> np.ndarray:
    """Compute the radiance map of the moonless night sky without artificial light.

    About 21.6 mag/arcsec² at the zenith and 0.95 mlx on the ground. The natural variation with season, solar activity
    and the position of the Milky Way is a factor of two; here the radiance does not depend on azimuth.

    Parameters
    ----------
    height, width
        Rows and columns of the equirectangular map.
    height_m
        Height of the observer, which reduces the optical depth of the air above [m].
    optical_depth
        Vertical optical depth at sea level in V, scattering and absorption.
    ground_albedo
        Albedo of the Lambertian ground in the rows below the horizon, which is illuminated by the rows above.

    Returns
    -------
    ndarray
        Radiance ``(height, width, 3)`` [cd/m²], in the layout of `Illumination`.
    """
    up = equirectangular_directions(height, width)[:, 0, 2]
    elevation_deg = np.degrees(np.arcsin(np.clip(up, -1.0, 1.0)))
    depth = _EXTENDED_SOURCE_FACTOR * optical_depth * np.exp(-height_m / 8000.0)
    airglow = van_rhijn(elevation_deg)[:, None] * AIRGLOW_CD_M2 * AIRGLOW_RGB
    extraterrestrial = ZODIACAL_CD_M2 * ZODIACAL_RGB + STARLIGHT_CD_M2 * STARLIGHT_RGB
    rows = (airglow + extraterrestrial) * np.exp(-depth * air_mass(elevation_deg))[:, None]
    rows[up <= 0.0] = 0.0
    sky = np.broadcast_to(rows[:, None, :], (height, width, 3)).copy()
    sky[up <= 0.0] = ground_albedo / np.pi * diffuse_horizontal_illuminance(sky)
    return sky
