"""Published fits of natural illuminance, an oracle independent of the package.

* Explanatory Supplement to the Astronomical Almanac (Seidelmann, ed., 1992), § 9.3: cubic polynomials in altitude / 90°
  of log10 lux for sun and full moon, with corrections for the moon's phase and parallax. They rest on Brown (1952),
  whose observations contain the night sky, so that the fit for the sun ends at -18° in 6.4e-4 lx.
* USNO Circular 171 (Janiczek & DeYoung 1987), the Fortran program: sun and moon through one extinction formula
  (subroutine ATMOS), and 0.0005 lx for the night sky. Its authors fitted it from the zenith to nautical twilight.

The coefficients were checked against two published transcriptions each (Vallado's and Ofek's of the former; Rohan's
and a Fortran one of the latter), and by the polynomials' continuity where they meet, which a wrong digit would break.
"""

import numpy as np

# (lowest altitude, highest altitude) [deg]: l0, l1, l2, l3
SUN_PIECES = {
    (20.0, 90.0): (3.74, 3.97, -4.07, 1.47),
    (5.0, 20.0): (3.05, 13.28, -45.98, 64.33),
    (-0.8, 5.0): (2.88, 22.26, -207.64, 1034.30),
    (-5.0, -0.8): (2.88, 21.81, -258.11, -858.36),
    (-12.0, -5.0): (2.70, 12.17, -431.69, -1899.83),
    (-18.0, -12.0): (13.84, 262.72, 1447.42, 2797.93),
}
MOON_PIECES = {
    (20.0, 90.0): (-1.95, 4.06, -4.24, 1.56),
    (5.0, 20.0): (-2.58, 12.58, -42.58, 59.06),
    (-0.8, 5.0): (-2.79, 24.27, -252.95, 1321.29),
}
CIRCULAR_NIGHT_SKY_LX = 0.0005


def polynomial_lx(pieces: dict, altitude_deg: float) -> float:
    """The first piece that holds the altitude [lx]."""
    for (low, high), coefficients in pieces.items():
        if low <= altitude_deg <= high:
            return float(10.0 ** np.polyval(coefficients[::-1], altitude_deg / 90.0))
    raise ValueError(f"altitude {altitude_deg} outside the fit")


def supplement_sun_lx(altitude_deg: float) -> float:
    """Horizontal illuminance by the sun and its sky, Explanatory Supplement."""
    return polynomial_lx(SUN_PIECES, altitude_deg)


def supplement_moon_lx(altitude_deg: float, phase_angle_deg: float = 0.0, parallax_deg: float = 0.951) -> float:
    """Horizontal illuminance by the moon and its sky, Explanatory Supplement."""
    phase = -8.68e-3 * phase_angle_deg - 2.2e-9 * phase_angle_deg**4
    return polynomial_lx(MOON_PIECES, altitude_deg) * 10.0**phase * (parallax_deg / 0.951) ** 2


def circular_extinction(altitude_deg: float) -> float:
    """Subroutine ATMOS: illuminance on the ground over that above the air."""
    sine, x = np.sin(np.radians(altitude_deg)), 753.66156
    angle = np.arcsin(x * np.cos(np.radians(altitude_deg)) / (x + 1.0))
    mass = x * (np.cos(angle) - sine) + np.cos(angle)
    scattered = 0.0289 * np.exp(-0.042 * mass) * (1.0 + (altitude_deg + 90.0) * sine / 57.29577951)
    return float(np.exp(-0.21 * mass) * sine + scattered)


def circular_sun_lx(altitude_deg: float) -> float:
    """Horizontal illuminance by the sun and its sky, Circular 171, without the night sky."""
    return 133775.0 * circular_extinction(altitude_deg)


def circular_moon_lx(altitude_deg: float, elongation_deg: float) -> float:
    """Horizontal illuminance by the moon and its sky, Circular 171; elongation 180° is full."""
    e, z = np.radians(min(elongation_deg, 179.99)), np.radians(altitude_deg)
    phase = 0.892 * np.exp(-3.343 / np.tan(e / 2.0) ** 0.632) + 0.0344 * (np.sin(e) - e * np.cos(e))
    return float(0.418 * phase / (1.0 - 0.005 * np.cos(e) - 0.03 * np.sin(z)) * circular_extinction(altitude_deg))
