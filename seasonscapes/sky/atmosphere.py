"""Optical model of the atmosphere: profiles, optical depths and phase functions of gas, aerosol and ozone.

Each of the three constituents is a vertical profile, normalised to a unit column from the ground to the top of the
atmosphere, times a vertical optical depth per spectral band. The optical depth along any path therefore follows from
three column integrals that do not depend on wavelength.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import ArrayLike

from seasonscapes.frames import MEAN_RADIUS_M
from seasonscapes.sky.spectrum import WAVELENGTHS_NM, angstrom_ratio, ozone_optical_depth_per_du, rayleigh_optical_depth

TOP_HEIGHT_M = 100e3
STANDARD_PRESSURE_HPA = 1013.25
# Refractivity n - 1 of standard air at 550 nm and sea level (Ciddor 1996).
SEA_LEVEL_REFRACTIVITY = 2.78e-4
# Koschmieder's constant -ln 0.02, for a contrast of 2 % at the meteorological range V.
KOSCHMIEDER = 3.912
# Depolarisation of air (Bates 1984; Bodhaine et al. 1999) as Chandrasekhar's γ = ρ / (2 - ρ), ρ = 0.0279.
_GAMMA = 0.0279 / (2.0 - 0.0279)
_BACKWARD_LOBE_G, _BACKWARD_WEIGHT = -0.35, 0.05


@dataclass(frozen=True)
class Atmosphere:
    """Parameters of a cloudless atmosphere. The defaults describe a clear day in the Alps.

    Parameters
    ----------
    aerosol_optical_depth_500nm
        Vertical optical depth above the ground at 500 nm: 0.05 on a very clean mountain day, 0.1 clear, 0.4 hazy.
    angstrom_exponent
        Ångström exponent: 0 for large particles (fog, coarse dust), 1.3 for continental haze.
    aerosol_scale_height_m
        Scale height of the aerosol density ``exp(-h / scale)`` [m]; infinite for a homogeneous layer up to
        `TOP_HEIGHT_M`.
    single_scattering_albedo, asymmetry
        Single-scattering albedo and mean cosine of the aerosol, equal in all bands.
    ozone_du
        Ozone column [DU].
    ground_albedo
        Lambertian albedo of the ground; one number, or ``(9,)`` bands.
    ground_height_m
        Height of the ground [m].
    pressure_hpa
        Pressure at sea level [hPa]; 0 removes the gas.
    refraction
        Whether rays are refracted; without refraction apparent and true directions are equal.

    Raises
    ------
    ValueError
        If a parameter is out of range.
    """

    aerosol_optical_depth_500nm: float = 0.10
    angstrom_exponent: float = 1.3
    aerosol_scale_height_m: float = 2000.0
    single_scattering_albedo: float = 0.93
    asymmetry: float = 0.68
    ozone_du: float = 320.0
    ground_albedo: float | tuple[float, ...] = 0.2
    ground_height_m: float = 0.0
    pressure_hpa: float = STANDARD_PRESSURE_HPA
    refraction: bool = True

    def __post_init__(self) -> None:
        bounds = {
            "aerosol_optical_depth_500nm": (0.0, 50.0),
            "angstrom_exponent": (-1.0, 4.0),
            "aerosol_scale_height_m": (50.0, np.inf),
            "single_scattering_albedo": (0.0, 1.0),
            "asymmetry": (0.0, 0.85),
            "ozone_du": (0.0, 1000.0),
            "ground_height_m": (-500.0, 6000.0),
            "pressure_hpa": (0.0, 1100.0),
        }
        for name, (low, high) in bounds.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name}: got {getattr(self, name)}, expected {low:g} to {high:g}")
        albedo = np.asarray(self.ground_albedo, float)
        if albedo.shape not in ((), WAVELENGTHS_NM.shape) or not ((albedo >= 0.0) & (albedo <= 1.0)).all():
            raise ValueError(f"ground_albedo: got {self.ground_albedo}, expected one number or 9 within 0 and 1")

    @property
    def ground_radius_m(self) -> float:
        """Radius of the ground about the Earth's centre [m]."""
        return MEAN_RADIUS_M + self.ground_height_m


@dataclass(frozen=True)
class Optics:
    """Vertical optical depths of an atmosphere per constituent (gas, aerosol, ozone) and band, and aerosol moments.

    Parameters
    ----------
    extinction
        Vertical optical depth above the ground ``(3, B)``.
    scattering
        Vertical scattering optical depth ``(3, B)``.
    aerosol_moments
        Legendre moments χ_l ``(L + 1,)`` of the aerosol's phase function (χ_0 = 1).
    """

    extinction: np.ndarray
    scattering: np.ndarray
    aerosol_moments: np.ndarray


def visibility_extinction_per_m(visibility_m: float) -> float:
    """Compute the extinction coefficient at 550 nm from the meteorological range, Koschmieder's ``3.912 / V``.

    Parameters
    ----------
    visibility_m
        Meteorological range V [m].

    Returns
    -------
    float
        Extinction coefficient [1/m].
    """
    return KOSCHMIEDER / visibility_m


def aerosol_optical_depth_from_visibility(
    visibility_m: float,
    *,
    height_m: float = 0.0,
    angstrom_exponent: float = 1.3,
    aerosol_scale_height_m: float = 2000.0,
    ground_height_m: float = 0.0,
) -> float:
    """Compute the aerosol optical depth at 500 nm that gives a meteorological range at a height.

    The extinction of the aerosol at 550 nm is ``3.912 / V`` less the extinction of the gas.

    Parameters
    ----------
    visibility_m
        Meteorological range V [m].
    height_m
        Height at which the range holds [m].
    angstrom_exponent, aerosol_scale_height_m, ground_height_m
        As in `Atmosphere`.

    Returns
    -------
    float
        Vertical aerosol optical depth at 500 nm.

    Raises
    ------
    ValueError
        If the range exceeds that of aerosol-free air (about 340 km at sea level).
    """
    atmosphere = Atmosphere(1.0, angstrom_exponent, aerosol_scale_height_m, ground_height_m=ground_height_m)
    gas, aerosol, _ = constituent_densities(atmosphere, height_m)
    aerosol_extinction = visibility_extinction_per_m(visibility_m) - gas * rayleigh_optical_depth(550.0)
    if aerosol_extinction < 0.0:
        limit = KOSCHMIEDER / (gas * rayleigh_optical_depth(550.0))
        raise ValueError(f"visibility: got {visibility_m / 1e3:g} km, expected at most {limit / 1e3:.0f} km (pure air)")
    return float(aerosol_extinction / (aerosol * angstrom_ratio(angstrom_exponent, 500.0, 550.0)))


def visibility_from_atmosphere(atmosphere: Atmosphere, height_m: float = 0.0) -> float:
    """Compute the meteorological range at a height; the inverse of `aerosol_optical_depth_from_visibility`.

    Parameters
    ----------
    atmosphere
        Atmosphere.
    height_m
        Height [m].

    Returns
    -------
    float
        Meteorological range [m].
    """
    gas, aerosol, _ = constituent_densities(atmosphere, height_m)
    pressure = atmosphere.pressure_hpa / STANDARD_PRESSURE_HPA
    depth = atmosphere.aerosol_optical_depth_500nm * angstrom_ratio(atmosphere.angstrom_exponent, 500.0, 550.0)
    return float(KOSCHMIEDER / (gas * pressure * rayleigh_optical_depth(550.0) + aerosol * depth))


def aerosol_optical_depth_from_turbidity(turbidity: float, *, angstrom_exponent: float = 1.3) -> float:
    """Compute the aerosol optical depth at 500 nm from the turbidity ``T = (τ_gas + τ_aerosol) / τ_gas``.

    The definition of Preetham et al. (1999), doi:10.1145/311535.311545, taken at sea level and at 550 nm.

    Parameters
    ----------
    turbidity
        Turbidity T, at least 1.
    angstrom_exponent
        As in `Atmosphere`.

    Returns
    -------
    float
        Vertical aerosol optical depth at 500 nm.

    Raises
    ------
    ValueError
        If the turbidity is below 1.
    """
    if not turbidity >= 1.0:
        raise ValueError(f"turbidity: got {turbidity}, expected at least 1")
    return float((turbidity - 1.0) * rayleigh_optical_depth(550.0) * angstrom_ratio(-angstrom_exponent, 500.0, 550.0))


def optics(atmosphere: Atmosphere, *, order: int = 64) -> Optics:
    """Compute the optical depths and aerosol moments of an atmosphere.

    Parameters
    ----------
    atmosphere
        Atmosphere.
    order
        Highest Legendre order of the aerosol moments.

    Returns
    -------
    Optics
        Optical properties in the bands of `spectrum.WAVELENGTHS_NM`.
    """
    aerosol = atmosphere.aerosol_optical_depth_500nm * angstrom_ratio(atmosphere.angstrom_exponent, 500.0)
    gas = rayleigh_optical_depth() * _relative_pressure(atmosphere)
    extinction = np.stack([gas, aerosol, ozone_optical_depth_per_du() * atmosphere.ozone_du])
    scattering = extinction * np.array([[1.0], [atmosphere.single_scattering_albedo], [0.0]])
    forward_g, powers = _forward_lobe_g(atmosphere.asymmetry), np.arange(order + 1)
    moments = (1.0 - _BACKWARD_WEIGHT) * forward_g**powers + _BACKWARD_WEIGHT * _BACKWARD_LOBE_G**powers
    return Optics(extinction, scattering, moments)


def delta_scaled(optics_: Optics, order: int) -> Optics:
    """Apply delta-M scaling: truncate the aerosol phase function at a Legendre order.

    The forward peak, a fraction ``f = χ_{order+1}`` of the light scattered by aerosol, is treated as unscattered
    (Wiscombe 1977, doi:10.1175/1520-0469(1977)034<1408:TDMRYA>2.0.CO;2).

    Parameters
    ----------
    optics_
        Unscaled optical properties with moments beyond ``order``.
    order
        Truncation order L.

    Returns
    -------
    Optics
        Scaled optical properties with moments ``(L + 1,)``.
    """
    peak_fraction = optics_.aerosol_moments[order + 1]
    peak = peak_fraction * optics_.scattering[1]
    removed = np.stack([np.zeros_like(peak), peak, np.zeros_like(peak)])
    moments = (optics_.aerosol_moments[: order + 1] - peak_fraction) / (1.0 - peak_fraction)
    return Optics(optics_.extinction - removed, optics_.scattering - removed, moments)


def gas_moments(order: int) -> np.ndarray:
    """Return the Legendre moments of the Rayleigh phase function with depolarisation.

    Parameters
    ----------
    order
        Highest Legendre order, at least 2.

    Returns
    -------
    ndarray
        Moments χ_l ``(order + 1,)`` with χ_0 = 1.
    """
    moments = np.zeros(order + 1)
    moments[[0, 2]] = 1.0, 0.1 * (1.0 - _GAMMA) / (1.0 + 2.0 * _GAMMA)
    return moments


def gas_phase(cosine: ArrayLike) -> np.ndarray:
    """Evaluate the Rayleigh phase function with depolarisation (Chandrasekhar 1950; Bucholtz 1995).

    Parameters
    ----------
    cosine
        Cosine of the scattering angle ``(...)``.

    Returns
    -------
    ndarray
        Phase function ``(...)`` [1/sr].
    """
    square = np.asarray(cosine) ** 2
    return 3.0 / (16.0 * np.pi * (1.0 + 2.0 * _GAMMA)) * ((1.0 + 3.0 * _GAMMA) + (1.0 - _GAMMA) * square)


def aerosol_phase(cosine: ArrayLike, asymmetry: float) -> np.ndarray:
    """Evaluate the aerosol phase function, a sum of two Henyey-Greenstein lobes with a given mean cosine.

    The form is that of Kattawar 1975 (JQSRT 15, 839). The backward lobe (g = -0.35, weight 5 %) is chosen; g of the
    forward lobe follows from the mean cosine.

    Parameters
    ----------
    cosine
        Cosine of the scattering angle ``(...)``.
    asymmetry
        Mean cosine of the scattering angle.

    Returns
    -------
    ndarray
        Phase function ``(...)`` [1/sr].
    """
    forward = _henyey_greenstein(cosine, _forward_lobe_g(asymmetry))
    return (1.0 - _BACKWARD_WEIGHT) * forward + _BACKWARD_WEIGHT * _henyey_greenstein(cosine, _BACKWARD_LOBE_G)


def _henyey_greenstein(cosine: ArrayLike, g: float) -> np.ndarray:
    square = 1.0 + g**2 - 2.0 * g * np.asarray(cosine)
    return (1.0 - g**2) / (4.0 * np.pi) / (square * np.sqrt(square))


def _forward_lobe_g(asymmetry: float) -> float:
    return (asymmetry - _BACKWARD_WEIGHT * _BACKWARD_LOBE_G) / (1.0 - _BACKWARD_WEIGHT)


def constituent_densities(atmosphere: Atmosphere, height_m: ArrayLike) -> np.ndarray:
    """Evaluate the normalised density profiles of gas, aerosol and ozone.

    The unit column of gas and of ozone begins at sea level, that of aerosol at the ground.

    Parameters
    ----------
    atmosphere
        Atmosphere.
    height_m
        Height ``(...)`` [m].

    Returns
    -------
    ndarray
        Densities in units of the vertical columns ``(3, ...)`` [1/m].
    """
    height = np.asarray(height_m, float)
    knots, gas, ozone, _ = _standard_profiles()
    above_ground = np.maximum(height - atmosphere.ground_height_m, 0.0)
    scale, thickness = atmosphere.aerosol_scale_height_m, TOP_HEIGHT_M - atmosphere.ground_height_m
    if np.isinf(scale):
        aerosol = np.full_like(height, 1.0 / thickness)
    else:
        aerosol = np.exp(-above_ground / scale) / (scale * -np.expm1(-thickness / scale))
    return np.stack([np.exp(np.interp(height, knots, gas)), aerosol, np.interp(height, knots, ozone)])


def refractivity(atmosphere: Atmosphere, height_m: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Evaluate the refractivity and its vertical gradient; both are zero for an atmosphere without refraction.

    Parameters
    ----------
    atmosphere
        Atmosphere.
    height_m
        Height ``(...)`` [m].

    Returns
    -------
    refractivity
        n - 1 ``(...)``.
    gradient
        Derivative by height ``(...)`` [1/m].
    """
    height = np.asarray(height_m, float)
    if not atmosphere.refraction:
        return np.zeros_like(height), np.zeros_like(height)
    knots, gas, _, slope = _standard_profiles()
    sea_level = SEA_LEVEL_REFRACTIVITY * _relative_pressure(atmosphere)
    value = sea_level * np.exp(np.interp(height, knots, gas) - np.interp(0.0, knots, gas))
    return value, value * np.interp(height, knots, slope)


def _relative_pressure(atmosphere: Atmosphere) -> float:
    return atmosphere.pressure_hpa / STANDARD_PRESSURE_HPA


@cache
def _standard_profiles() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Standard profiles: heights [m], log gas density and ozone density for unit columns [1/m], log gas gradient [1/m].

    Gas: density of the U.S. Standard Atmosphere 1976 (layers of constant lapse rate, table 4) continued above 84.852 km
    with a scale height of 5.7 km. Ozone: the mid-latitude number density of the same, table 17 (Krueger & Minzner).
    """
    knots = np.arange(-500.0, TOP_HEIGHT_M + 1.0, 250.0)
    geopotential = 6356766.0 * knots / (6356766.0 + knots)
    bases = np.array([0.0, 11e3, 20e3, 32e3, 47e3, 51e3, 71e3])
    lapse = [-6.5e-3, 0.0, 1e-3, 2.8e-3, 0.0, -2.8e-3, -2e-3]
    temperature, log_pressure = [288.15], [0.0]
    gravity = 9.80665 * 0.0289644 / 8.31432

    def layer(t0: float, p0: float, rate: float, rise: float) -> tuple[float, float]:
        """Temperature [K] and log pressure at a height above the base of a layer."""
        t1 = t0 + rate * rise
        return t1, p0 - gravity * (np.log(t1 / t0) / rate if rate else rise / t0)

    for base, following, rate in zip(bases[:-1], bases[1:], lapse[:-1], strict=True):
        t, p = layer(temperature[-1], log_pressure[-1], rate, following - base)
        temperature.append(t)
        log_pressure.append(p)
    index = np.clip(np.searchsorted(bases, geopotential, side="right") - 1, 0, 6)
    states = [
        layer(temperature[i], log_pressure[i], lapse[i], min(h, 84852.0) - bases[i])
        for i, h in zip(index, geopotential, strict=True)
    ]
    log_density = np.array([p - np.log(t) for t, p in states]) - np.maximum(geopotential - 84852.0, 0.0) / 5700.0
    above_sea = knots >= 0.0
    log_gas = log_density - np.log(np.trapezoid(np.exp(log_density[above_sea]), knots[above_sea]))
    # fmt: off
    ozone_e11_per_cm3 = [
        7.2, 6.8, 5.8, 5.7, 6.5, 11.3, 20.2, 23.5, 29.5, 40.4, 47.7, 48.6, 45.4, 40.3, 32.4, 25.2, 20.3, 15.8, 12.2,
        8.73, 6.07, 3.98, 2.74, 1.69, 1.03, 0.664, 0.384, 0.255, 0.161, 0.112, 0.0733, 0.0481, 0.0317, 0.0172, 0.0075,
        0.0054, 0.0022, 0.0,
    ]
    # fmt: on
    ozone = np.interp(knots, np.arange(len(ozone_e11_per_cm3)) * 2e3, ozone_e11_per_cm3)
    ozone /= np.trapezoid(ozone[above_sea], knots[above_sea])
    return knots, log_gas, ozone, np.gradient(log_gas, knots)
