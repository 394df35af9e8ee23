"""What the air is made of: gas, aerosol and ozone by height, and how each band meets them.

Three constituents, each a vertical profile that integrates to one from the ground to the top, times a vertical optical
depth per band. An optical depth along any path is then three column integrals that know nothing of wavelength.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from seasonscapes.frames import MEAN_RADIUS_M
from seasonscapes.sky.spectrum import WAVELENGTHS_NM, angstrom_ratio, ozone_optical_depth_per_du, rayleigh_optical_depth

TOP_HEIGHT_M = 100e3
STANDARD_PRESSURE_HPA = 1013.25
# Refractivity n - 1 of standard air at 550 nm and sea level (Ciddor 1996).
SEA_LEVEL_REFRACTIVITY = 2.78e-4
# Koschmieder's constant -ln 0.02: contrast of 2 % at the meteorological range V.
KOSCHMIEDER = 3.912
# Depolarisation of air (Bates 1984; Bodhaine et al. 1999) as Chandrasekhar's γ = ρ / (2 - ρ), ρ = 0.0279.
_GAMMA = 0.0279 / (2.0 - 0.0279)
_BACKWARD_LOBE_G, _BACKWARD_SHARE = -0.35, 0.05


@dataclass(frozen=True)
class Atmosphere:
    """A clear or hazy atmosphere. The defaults are a clear day in the Alps.

    Parameters
    ----------
    aerosol_optical_depth_500nm
        Vertical, from the ground up. 0.05 is a very clean mountain day, 0.1 clear, 0.4 hazy.
    angstrom_exponent
        0 for large grains (fog, coarse dust), 1.3 for continental haze.
    aerosol_scale_height_m
        Aerosol thins as ``exp(-h / scale)``; infinite is a homogeneous layer up to `TOP_HEIGHT_M`.
    single_scattering_albedo, asymmetry
        Of the aerosol, the same in every band.
    ozone_du
        Ozone column [DU].
    ground_albedo
        Lambertian albedo of the ground beneath the whole sky; ``(9,)`` bands or one number.
    ground_height_m
        Height of that ground [m].
    pressure_hpa
        Pressure at sea level [hPa]; 0 takes the gas away.
    refraction
        Whether light bends. Without it apparent and true directions are the same.
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

    def __post_init__(self):
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
        """Distance of the ground from the Earth's centre [m]."""
        return MEAN_RADIUS_M + self.ground_height_m


@dataclass(frozen=True)
class Optics:
    """Vertical optical depths and phase functions of an atmosphere, per constituent (gas, aerosol, ozone) and band.

    Parameters
    ----------
    extinction
        ``(3, B)`` vertical optical depth from the ground up.
    scattering
        ``(3, B)`` its scattering part.
    aerosol_moments
        Legendre moments χ_l ``(L + 1,)`` of the aerosol's phase function (χ_0 = 1).
    """

    extinction: np.ndarray
    scattering: np.ndarray
    aerosol_moments: np.ndarray


def visibility_extinction_per_m(visibility_m: float) -> float:
    """Extinction at 550 nm of air with a meteorological range [1/m]: Koschmieder's ``3.912 / V``."""
    return KOSCHMIEDER / visibility_m


def aerosol_optical_depth_from_visibility(
    visibility_m: float,
    *,
    height_m: float = 0.0,
    angstrom_exponent: float = 1.3,
    aerosol_scale_height_m: float = 2000.0,
    ground_height_m: float = 0.0,
) -> float:
    """Aerosol optical depth at 500 nm that gives a meteorological range at a height.

    The aerosol makes up what gas leaves of ``3.912 / V`` at 550 nm.

    Raises
    ------
    ValueError
        Where pure air alone is hazier than asked (about 340 km at sea level).
    """
    atmosphere = Atmosphere(1.0, angstrom_exponent, aerosol_scale_height_m, ground_height_m=ground_height_m)
    gas, aerosol, _ = constituent_densities(atmosphere, height_m)
    rest = visibility_extinction_per_m(visibility_m) - gas * rayleigh_optical_depth(550.0)
    if rest < 0.0:
        limit = KOSCHMIEDER / (gas * rayleigh_optical_depth(550.0))
        raise ValueError(f"visibility: got {visibility_m / 1e3:g} km, expected at most {limit / 1e3:.0f} km (pure air)")
    return float(rest / (aerosol * angstrom_ratio(angstrom_exponent, 500.0, 550.0)))


def visibility_from_atmosphere(atmosphere: Atmosphere, height_m: float = 0.0) -> float:
    """Meteorological range at a height [m], the inverse of `aerosol_optical_depth_from_visibility`."""
    gas, aerosol, _ = constituent_densities(atmosphere, height_m)
    pressure = atmosphere.pressure_hpa / STANDARD_PRESSURE_HPA
    depth = atmosphere.aerosol_optical_depth_500nm * angstrom_ratio(atmosphere.angstrom_exponent, 500.0, 550.0)
    return float(KOSCHMIEDER / (gas * pressure * rayleigh_optical_depth(550.0) + aerosol * depth))


def aerosol_optical_depth_from_turbidity(turbidity: float, *, angstrom_exponent: float = 1.3) -> float:
    """Aerosol optical depth at 500 nm of a turbidity ``T = (τ_gas + τ_aerosol) / τ_gas`` at 550 nm.

    The definition of Preetham et al. (1999), doi:10.1145/311535.311545, taken at sea level and at 550 nm.

    Raises
    ------
    ValueError
        For a turbidity below 1.
    """
    if not turbidity >= 1.0:
        raise ValueError(f"turbidity: got {turbidity}, expected at least 1")
    return float((turbidity - 1.0) * rayleigh_optical_depth(550.0) * angstrom_ratio(-angstrom_exponent, 500.0, 550.0))


def optics(atmosphere: Atmosphere, *, order: int = 64) -> Optics:
    """Optical depths and aerosol moments up to ``order`` of an atmosphere."""
    aerosol = atmosphere.aerosol_optical_depth_500nm * angstrom_ratio(atmosphere.angstrom_exponent, 500.0)
    gas = rayleigh_optical_depth() * _gas_share(atmosphere)
    extinction = np.stack([gas, aerosol, ozone_optical_depth_per_du() * atmosphere.ozone_du])
    scattering = extinction * np.array([[1.0], [atmosphere.single_scattering_albedo], [0.0]])
    forward_g, powers = _forward_lobe_g(atmosphere.asymmetry), np.arange(order + 1)
    moments = (1.0 - _BACKWARD_SHARE) * forward_g**powers + _BACKWARD_SHARE * _BACKWARD_LOBE_G**powers
    return Optics(extinction, scattering, moments)


def delta_scaled(optics_: Optics, order: int) -> Optics:
    """The similar atmosphere whose aerosol phase function ends at a Legendre order: Wiscombe's delta-M method.

    The forward peak, a share ``f = χ_{order+1}`` of what aerosol scatters, counts as not scattered at all
    (Wiscombe 1977, eqs. 15 to 20, doi:10.1175/1520-0469(1977)034<1408:TDMRYA>2.0.CO;2).
    """
    share = optics_.aerosol_moments[order + 1]
    peak = share * optics_.scattering[1]
    taken = np.stack([np.zeros_like(peak), peak, np.zeros_like(peak)])
    moments = (optics_.aerosol_moments[: order + 1] - share) / (1.0 - share)
    return Optics(optics_.extinction - taken, optics_.scattering - taken, moments)


def gas_moments(order: int) -> np.ndarray:
    """Legendre moments χ_l ``(order + 1,)`` of the Rayleigh phase function with depolarisation."""
    moments = np.zeros(order + 1)
    moments[[0, 2]] = 1.0, 0.1 * (1.0 - _GAMMA) / (1.0 + 2.0 * _GAMMA)
    return moments


def gas_phase(cosine) -> np.ndarray:
    """Rayleigh phase function with depolarisation [1/sr] (Chandrasekhar 1950, § 18; Bucholtz 1995, eq. 12)."""
    square = np.asarray(cosine) ** 2
    return 3.0 / (16.0 * np.pi * (1.0 + 2.0 * _GAMMA)) * ((1.0 + 3.0 * _GAMMA) + (1.0 - _GAMMA) * square)


def aerosol_phase(cosine, asymmetry: float) -> np.ndarray:
    """Phase function of aerosol [1/sr]: two Henyey-Greenstein lobes with a given mean cosine.

    A share of 5 % goes into a backward lobe of g = -0.35, as natural aerosols do (Kattawar 1975,
    doi:10.1016/0022-4073(75)90035-3); the forward lobe takes the rest of the asymmetry.
    """
    forward = _henyey_greenstein(cosine, _forward_lobe_g(asymmetry))
    return (1.0 - _BACKWARD_SHARE) * forward + _BACKWARD_SHARE * _henyey_greenstein(cosine, _BACKWARD_LOBE_G)


def _henyey_greenstein(cosine, g: float) -> np.ndarray:
    square = 1.0 + g**2 - 2.0 * g * np.asarray(cosine)
    return (1.0 - g**2) / (4.0 * np.pi) / (square * np.sqrt(square))


def _forward_lobe_g(asymmetry: float) -> float:
    return (asymmetry - _BACKWARD_SHARE * _BACKWARD_LOBE_G) / (1.0 - _BACKWARD_SHARE)


def constituent_densities(atmosphere: Atmosphere, height_m) -> np.ndarray:
    """Share of each vertical column per metre ``(3, ...)`` [1/m]: gas, aerosol, ozone.

    Gas counts from sea level up (pressure says how much there is); aerosol and ozone from the ground up.
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


def refractivity(atmosphere: Atmosphere, height_m) -> tuple[np.ndarray, np.ndarray]:
    """Refractivity n - 1 and its gradient [1/m] at heights; zeros where the atmosphere does not refract."""
    height = np.asarray(height_m, float)
    if not atmosphere.refraction:
        return np.zeros_like(height), np.zeros_like(height)
    knots, gas, _, slope = _standard_profiles()
    sea_level = SEA_LEVEL_REFRACTIVITY * _gas_share(atmosphere)
    value = sea_level * np.exp(np.interp(height, knots, gas) - np.interp(0.0, knots, gas))
    return value, value * np.interp(height, knots, slope)


def _gas_share(atmosphere: Atmosphere) -> float:
    return atmosphere.pressure_hpa / STANDARD_PRESSURE_HPA


@cache
def _standard_profiles() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Knots [m], log of the gas profile, the ozone profile, both of unit columns [1/m], and the gas's log slope [1/m].

    Gas: density of the U.S. Standard Atmosphere 1976 (layers of constant lapse rate, table 4) continued above 84.852 km
    with a scale height of 5.7 km. Ozone: the mid-latitude number density of the same, table 17 (Krueger & Minzner).
    """
    knots = np.arange(-500.0, TOP_HEIGHT_M + 1.0, 250.0)
    geopotential = 6356766.0 * knots / (6356766.0 + knots)
    bases = np.array([0.0, 11e3, 20e3, 32e3, 47e3, 51e3, 71e3])
    lapse = np.array([-6.5e-3, 0.0, 1e-3, 2.8e-3, 0.0, -2.8e-3, -2e-3])
    temperature, log_pressure = [288.15], [0.0]
    gravity = 9.80665 * 0.0289644 / 8.31432

    def layer(t0, p0, rate, rise):
        t1 = t0 + rate * rise
        return t1, p0 - gravity * (np.log(t1 / t0) / rate if rate else rise / t0)

    for base, following, rate in zip(bases[:-1], bases[1:], lapse[:-1], strict=True):
        t, p = layer(temperature[-1], log_pressure[-1], rate, following - base)
        temperature.append(t), log_pressure.append(p)
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
