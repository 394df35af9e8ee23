"""Spectral bands, optical depths per band, and conversion of spectra to photometric Rec.709.

The atmosphere model computes *transfers*: spectral radiance (or irradiance) divided by the extraterrestrial solar
spectral irradiance, at nine wavelengths. A transfer is a smooth function of wavelength because the Fraunhofer lines
cancel; the matrix that converts a transfer to photometric linear Rec.709 includes the full solar spectrum.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.images import XYZ_FROM_REC709

# Chosen by Nelder-Mead search so that nine samples of a transfer give the CIE XYZ of daylight, twilight and of the sun
# through any air mass; `rgb_from_transfer` fits their weights and tests/test_atmosphere_air.py bounds the error.
WAVELENGTHS_NM = np.array([421.0, 454.0, 481.0, 516.0, 540.0, 579.0, 612.0, 646.0, 701.0])

RGB_FROM_XYZ = np.linalg.inv(XYZ_FROM_REC709)

BIN_CENTRES_NM = np.arange(365.0, 830.0, 10.0)

# 683 lm/W ∫ E(λ) (x̄ ȳ z̄)(λ) dλ over bins of 10 nm [lx]: the extraterrestrial spectrum of ASTM G173-03 at 1 au
# weighted by the CIE 1931 2° observer. The sum is the extraterrestrial XYZ of the sun: Y = 133.1 klx.
# fmt: off
SOLAR_XYZ_LX = np.array([
    (1.86958, 0.0560168, 8.75148),
    (6.13336, 0.179524, 28.8539),
    (16.5193, 0.470075, 77.9707),
    (64.8859, 1.82222, 307.245),
    (288.197, 7.97883, 1370.25),
    (938.834, 26.6632, 4493.22),
    (2373.93, 82.3111, 11492.4),
    (3609.06, 188.863, 17845.9),
    (4536.29, 390.217, 23243.7),
    (4415.86, 663.254, 24138),
    (3457.39, 1014.38, 20960.9),
    (2010.65, 1555.15, 14589),
    (825.469, 2219.96, 8419.52),
    (222.781, 3443.11, 4854.18),
    (50.7323, 5304.1, 2820.63),
    (368.67, 7489.03, 1462.47),
    (1387.82, 10048.5, 754.766),
    (2880.61, 11751.8, 399.459),
    (4522.44, 12370.8, 177.58),
    (6414.01, 12603.8, 76.8277),
    (8450.62, 12257.8, 36.0961),
    (10494.4, 11478.3, 23.0333),
    (12036.7, 10134.7, 17.3968),
    (12802.5, 8495.74, 11.9676),
    (12475.3, 6821.98, 7.13279),
    (10878.7, 5152.76, 2.9166),
    (8678.14, 3728, 1.28924),
    (6155.01, 2474.6, 0.363137),
    (4017.35, 1543.78, 0.113743),
    (2333.04, 872.311, 0),
    (1327.29, 488.68, 0),
    (679.734, 248.097, 0),
    (344.112, 124.767, 0),
    (163.708, 59.1606, 0),
    (81.0385, 29.2645, 0),
    (39.8941, 14.4065, 0),
    (19.519, 7.04868, 0),
    (9.35517, 3.37832, 0),
    (4.35243, 1.57174, 0),
    (2.11164, 0.762553, 0),
    (1.03153, 0.372504, 0),
    (0.503097, 0.181677, 0),
    (0.247062, 0.0892185, 0),
    (0.118503, 0.0427936, 0),
    (0.0576563, 0.0208207, 0),
    (0.0281369, 0.0101608, 0),
    (0.0134998, 0.00487501, 0),
])

# Ozone absorption cross-section at 233 K, means over the same bins [1e-26 m²]: the Chappuis bands. Gorshelev et al.,
# doi:10.5194/amt-7-609-2014; Serdyuchenko et al., doi:10.5194/amt-7-625-2014; binned as in Bruneton (2017).
_OZONE_CROSS_SECTION = np.array([
    0.118, 0.02182, 0.02818, 0.06636, 0.1527, 0.2763, 0.552, 0.8451, 1.582, 2.316, 3.669, 4.924, 7.752, 9.016, 14.80,
    16.02, 21.39, 27.55, 30.91, 35.00, 42.66, 46.72, 43.98, 47.01, 50.19, 43.05, 37.40, 32.15, 26.62, 22.38, 18.52,
    14.73, 12.09, 9.423, 7.455, 6.566, 5.105, 4.150, 4.228, 3.237, 2.451, 2.801, 2.534, 1.624, 1.465, 2.078, 1.383,
]) * 1e-26
# fmt: on
_MOLECULES_PER_M2_AND_DU = 2.687e20


def rayleigh_optical_depth(wavelength_nm: ArrayLike = WAVELENGTHS_NM) -> np.ndarray:
    """Compute the vertical Rayleigh optical depth at a surface pressure of 1013.25 hPa and 45° latitude.

    Bodhaine et al. (1999), eq. 30, doi:10.1175/1520-0426(1999)016<1854:ORODC>2.0.CO;2, which includes the King factor.

    Parameters
    ----------
    wavelength_nm
        Wavelength ``(...)`` [nm].

    Returns
    -------
    ndarray
        Optical depth ``(...)``.
    """
    square = (np.asarray(wavelength_nm, float) * 1e-3) ** 2
    numerator = 1.0455996 - 341.29061 / square - 0.90230850 * square
    return 0.0021520 * numerator / (1.0 + 0.0027059889 / square - 85.968563 * square)


def ozone_optical_depth_per_du(wavelength_nm: ArrayLike = WAVELENGTHS_NM) -> np.ndarray:
    """Compute the vertical optical depth of one Dobson unit of ozone in the visible range (Chappuis bands).

    Parameters
    ----------
    wavelength_nm
        Wavelength ``(...)`` [nm].

    Returns
    -------
    ndarray
        Optical depth ``(...)`` [1/DU].
    """
    return np.interp(np.asarray(wavelength_nm, float), BIN_CENTRES_NM, _OZONE_CROSS_SECTION) * _MOLECULES_PER_M2_AND_DU


def angstrom_ratio(exponent: float, reference_nm: float, wavelength_nm: ArrayLike = WAVELENGTHS_NM) -> np.ndarray:
    """Compute the ratio of aerosol optical depths at two wavelengths by Ångström's law ``(λ/λ₀)^-α``.

    Parameters
    ----------
    exponent
        Ångström exponent α.
    reference_nm
        Reference wavelength λ₀ [nm].
    wavelength_nm
        Wavelength λ ``(...)`` [nm].

    Returns
    -------
    ndarray
        Optical depth at λ over that at λ₀ ``(...)``.
    """
    return (np.asarray(wavelength_nm, float) / reference_nm) ** -exponent


@cache
def rgb_from_transfer() -> np.ndarray:
    """Return the matrix from transfers to photometric linear Rec.709.

    The weights are a least-squares fit, over many spectra of sun and sky, of the exact integral with the CIE
    colour-matching functions: a Gauss-like quadrature with solar spectrum times colour-matching function as weight.

    Returns
    -------
    ndarray
        ``(3, 9)``. The product with a transfer is in [lx], with a transfer per steradian in [cd/m²].
    """
    transfer, at_bands = _daylight_transfers(BIN_CENTRES_NM), _daylight_transfers(WAVELENGTHS_NM)
    xyz = transfer @ SOLAR_XYZ_LX
    total = xyz.sum(axis=1, keepdims=True)
    return RGB_FROM_XYZ @ np.linalg.lstsq(at_bands / total, xyz / total, rcond=None)[0].T


def _daylight_transfers(wavelength_nm: np.ndarray, count: int = 2000) -> np.ndarray:
    """Random transfers ``(count, len(wavelength_nm))``: attenuation by gas, ozone and aerosol times a power of λ."""
    random = np.random.default_rng(1987)
    rayleigh, ozone, aerosol, exponent = random.uniform(0.0, [[38.0], [12000.0], [6.0], [4.0]], (4, count))
    # The cube favours short paths, as of the sun at noon and of the sky.
    short = random.uniform(0.0, 1.0, (3, count)) ** 3
    rayleigh, ozone, aerosol = rayleigh * short[0], ozone * short[1], aerosol * short[2]
    depth = (
        rayleigh[:, None] * rayleigh_optical_depth(wavelength_nm)
        + ozone[:, None] * ozone_optical_depth_per_du(wavelength_nm)
        + aerosol[:, None] * angstrom_ratio(1.2, 550.0, wavelength_nm)
    )
    return np.exp(-depth) * angstrom_ratio(1.0, 550.0, wavelength_nm) ** exponent[:, None]
