"""What the air is made of, and how light is counted in nine bands."""

import colour
import numpy as np
import pvlib
import pytest

from seasonscapes.sky import spectrum
from seasonscapes.sky.atmosphere import (
    TOP_HEIGHT_M,
    Atmosphere,
    aerosol_optical_depth_from_turbidity,
    aerosol_optical_depth_from_visibility,
    aerosol_phase,
    constituent_densities,
    delta_scaled,
    gas_moments,
    gas_phase,
    optics,
    refractivity,
    visibility_from_atmosphere,
)
from seasonscapes.sky.aureole import spread_aerosol_phase
from seasonscapes.sky.spectrum import RGB_FROM_XYZ, WAVELENGTHS_NM, rgb_from_transfer


def _full_resolution():
    """Wavelengths [nm] and ``683 E (x̄ ȳ z̄)`` [lx/nm] from pvlib's ASTM G173 and colour-science's observer."""
    wavelength = np.arange(360.0, 830.0, 0.5)
    table = pvlib.spectrum.get_reference_spectra()
    irradiance = np.interp(wavelength, table.index, table["extraterrestrial"])
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
    functions = np.stack([np.interp(wavelength, observer.wavelengths, column) for column in observer.values.T], 1)
    return wavelength, 683.0 * irradiance[:, None] * functions


def test_solar_table_is_the_integral_of_its_sources():
    wavelength, density = _full_resolution()
    bins = ((wavelength - 360.0) // 10).astype(int)
    expected = np.stack([np.bincount(bins, density[:, k]) * 0.5 for k in range(3)], 1)
    np.testing.assert_allclose(spectrum.SOLAR_XYZ_LX, expected, rtol=2e-5, atol=1e-4)
    assert expected[:, 1].sum() == pytest.approx(133_100.0, rel=1e-3)  # the solar illuminance constant


@pytest.mark.parametrize(
    ("rayleigh", "ozone_du", "aerosol", "exponent"),
    [
        (0.0, 0.0, 0.0, 0.0),  # the sun above the air
        (1.0, 300.0, 0.1, 0.0),  # the noon sun
        (20.0, 6000.0, 2.0, 0.0),  # the setting sun, near 2000 K
        (38.0, 3000.0, 0.5, 0.0),
        (0.5, 300.0, 0.1, 4.0),  # a clear zenith
        (2.0, 9000.0, 0.3, 4.0),  # the blue hour
        (5.0, 600.0, 1.0, 1.3),  # haze
    ],
)
def test_nine_bands_give_the_colour_of_daylight(rayleigh, ozone_du, aerosol, exponent):
    wavelength, density = _full_resolution()

    def transfer(at_nm):
        depth = rayleigh * spectrum.rayleigh_optical_depth(at_nm)
        depth = depth + ozone_du * spectrum.ozone_optical_depth_per_du(at_nm) + aerosol * (at_nm / 550.0) ** -1.3
        return np.exp(-depth) * (at_nm / 550.0) ** -exponent

    exact = transfer(wavelength) @ density * 0.5
    ours = np.linalg.solve(RGB_FROM_XYZ, rgb_from_transfer() @ transfer(WAVELENGTHS_NM))
    # The red sun's Z is a fortieth of its Y, and 2 % off; nothing else is off by more than 1 % of itself.
    np.testing.assert_allclose(ours, exact, rtol=0.01, atol=0.002 * exact[1])
    assert ours[1] == pytest.approx(exact[1], rel=0.007)


def test_rayleigh_depth_agrees_with_leckner():
    # The formula that SPECTRL2 uses; Bodhaine's is newer.
    micrometre = WAVELENGTHS_NM * 1e-3
    leckner = 1.0 / (micrometre**4 * (115.6406 - 1.335 / micrometre**2))
    np.testing.assert_allclose(spectrum.rayleigh_optical_depth(), leckner, rtol=0.015)


def test_standard_profiles():
    heights = np.linspace(0.0, TOP_HEIGHT_M, 40001)
    columns = np.trapezoid(constituent_densities(Atmosphere(), heights), heights, axis=1)
    np.testing.assert_allclose(columns, 1.0, rtol=1e-3)
    gas = constituent_densities(Atmosphere(), np.array([0.0, 5e3, 10e3, 20e3, 50e3, 80e3]))[0]
    # U.S. Standard Atmosphere 1976, table 1: density over its sea-level value.
    np.testing.assert_allclose(gas[1:] / gas[0], [0.60117, 0.33756, 0.072580, 8.3827e-4, 1.5065e-5], rtol=2e-3)
    ozone = constituent_densities(Atmosphere(), heights)[2]
    assert 20e3 < heights[ozone.argmax()] < 24e3
    value, slope = refractivity(Atmosphere(), np.array([1000.0, 1250.0]))
    assert slope[0] == pytest.approx((value[1] - value[0]) / 250.0, rel=0.03)


def test_phase_functions_are_normalised_and_have_their_moments():
    node, weight = np.polynomial.legendre.leggauss(400)
    assert 2 * np.pi * weight @ gas_phase(node) == pytest.approx(1.0, abs=1e-12)
    second = 2 * np.pi * weight @ (gas_phase(node) * 0.5 * (3 * node**2 - 1))
    assert second == pytest.approx(gas_moments(4)[2], abs=1e-12)
    phase, atmosphere = aerosol_phase(node, 0.68), Atmosphere(asymmetry=0.68)
    assert 2 * np.pi * weight @ phase == pytest.approx(1.0, abs=1e-9)
    assert 2 * np.pi * weight @ (phase * node) == pytest.approx(0.68, abs=1e-9)
    moments = [2 * np.pi * weight @ (phase * np.polynomial.legendre.Legendre.basis(k)(node)) for k in range(9)]
    np.testing.assert_allclose(optics(atmosphere, order=8).aerosol_moments, moments, atol=1e-9)
    # Spreading moves light from the peak outwards and neither makes nor loses any.
    spread = spread_aerosol_phase(node, np.full((400, 3), 3.0), 0.68, 4)[:, 1]
    assert 2 * np.pi * weight @ spread == pytest.approx(1.0, abs=2e-3)
    assert spread[-1] < 0.9 * phase[-1]
    np.testing.assert_allclose(spread_aerosol_phase(node, np.zeros((400, 3)), 0.68, 10)[:, 1], phase, rtol=1e-6)


def test_delta_scaling_keeps_absorption_and_the_mean_cosine_of_what_is_lost():
    plain = optics(Atmosphere())
    scaled = delta_scaled(plain, 10)
    np.testing.assert_allclose(plain.extinction - plain.scattering, scaled.extinction - scaled.scattering)
    forward = plain.scattering[1] * (1 - plain.aerosol_moments[1])
    np.testing.assert_allclose(scaled.scattering[1] * (1 - scaled.aerosol_moments[1]), forward)


@pytest.mark.parametrize("visibility_m", [5e3, 40e3, 150e3])
def test_visibility_there_and_back(visibility_m):
    depth = aerosol_optical_depth_from_visibility(visibility_m, height_m=800.0, ground_height_m=400.0)
    back = visibility_from_atmosphere(Atmosphere(depth, ground_height_m=400.0), 800.0)
    assert back == pytest.approx(visibility_m, rel=1e-9)


def test_turbidity_is_preethams():
    assert aerosol_optical_depth_from_turbidity(1.0) == 0.0
    depth = aerosol_optical_depth_from_turbidity(3.0, angstrom_exponent=1.3) * (550 / 500) ** -1.3
    gas = float(spectrum.rayleigh_optical_depth(550.0))
    assert (gas + depth) / gas == pytest.approx(3.0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: aerosol_optical_depth_from_visibility(500e3), "visibility: got 500 km, expected at most 3"),
        (lambda: aerosol_optical_depth_from_turbidity(0.5), "turbidity: got 0.5"),
        (lambda: Atmosphere(asymmetry=0.99), "asymmetry: got 0.99, expected 0 to 0.85"),
        (lambda: Atmosphere(ground_albedo=(0.1, 0.2)), "ground_albedo"),
    ],
)
def test_impossible_air_is_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call()
