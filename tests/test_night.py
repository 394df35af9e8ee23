"""Moonlight and the dark sky against published magnitudes, colours and the USNO's illuminances."""

from itertools import pairwise

import numpy as np
import oracles_usno as usno
import pytest

from seasonscapes.sky import night
from seasonscapes.sky.ephemeris import LunarPosition
from seasonscapes.sky.illumination import diffuse_horizontal_illuminance, luminance
from seasonscapes.sky.night import air_mass, moon_magnitude, moon_to_sun_ratio, night_sky_radiance, van_rhijn

SOLAR_LX = 133_334.0  # Darula, Kittler & Gueymard (2005)


def moon_at(elevation_deg=60.0, phase_deg=2.0, distance_km=384_400.0, sun_distance_au=1.0) -> LunarPosition:
    fraction = 0.5 * (1.0 + np.cos(np.radians(phase_deg)))
    return LunarPosition(180.0, elevation_deg, elevation_deg, distance_km, sun_distance_au, phase_deg, fraction, True)


def test_oracle_polynomials_meet_where_their_pieces_do():
    for pieces in (usno.SUN_PIECES, usno.MOON_PIECES):
        ordered = sorted(pieces)
        for lower, upper in pairwise(ordered):
            below = usno.polynomial_lx({lower: pieces[lower]}, lower[1])
            above = usno.polynomial_lx({upper: pieces[upper]}, upper[0])
            assert below == pytest.approx(above, rel=0.08), (lower, upper)
    # Tabulated in the Explanatory Supplement's text: sunrise, the ends of civil and nautical twilight, full moon.
    assert usno.supplement_sun_lx(0.0) == pytest.approx(759, rel=0.01)
    assert usno.supplement_sun_lx(-6.0) == pytest.approx(3.4, rel=0.01)
    assert usno.supplement_sun_lx(-12.0) == pytest.approx(0.008, rel=0.01)
    assert usno.supplement_moon_lx(90.0) == pytest.approx(0.27, rel=0.01)


def test_oracles_agree_with_each_other_down_to_nautical_twilight():
    for altitude in range(-11, 21):
        ratio = usno.supplement_sun_lx(altitude) / (usno.circular_sun_lx(altitude) + usno.CIRCULAR_NIGHT_SKY_LX)
        assert 0.89 < ratio < 1.27, altitude  # how far the two published fits are apart


def test_moon_magnitude_at_its_phases():
    # Allen § 66: full -12.73 without the surge; quarters 2.6 mag fainter; the surge adds a third at exactly full.
    assert moon_magnitude(moon_at(phase_deg=20.0)) == pytest.approx(-12.73 + 0.52, abs=0.01)
    assert moon_magnitude(moon_at(phase_deg=90.0)) == pytest.approx(-10.13, abs=0.01)
    surge = moon_magnitude(moon_at(phase_deg=1e-9)) - (-12.73)
    assert surge == pytest.approx(-2.5 * np.log10(1.35), abs=1e-6)
    phases = np.arange(0.0, 160.0)
    assert np.all(np.diff([moon_magnitude(moon_at(phase_deg=phase)) for phase in phases]) > 0)


def test_moon_agrees_with_the_rolo_model():
    """Kieffer & Stone (2005), doi:10.1086/430185, eq. 10 without libration, coefficients averaged over CIE ȳ."""
    a, d, p = (
        (-2.10254, -1.6346, 0.344678, -0.191184),
        (0.370312, -0.108609, 0.00794299),
        (4.06054, 12.8802, -30.5858, 16.7498),
    )

    def rolo(phase_deg):
        polynomial = np.polyval(a[::-1], np.radians(phase_deg))
        bumps = d[0] * np.exp(-phase_deg / p[0]) + d[1] * np.exp(-phase_deg / p[1])
        bumps += d[2] * np.cos((phase_deg - p[2]) / p[3])
        return np.exp(polynomial + bumps) * 6.4177e-5 / np.pi  # solid angle of the moon at 384,400 km

    phases = np.array([2.0, 5.0, 10.0, 20.0, 30.0, 45.0, 60.0, 75.0, 90.0])
    ours = np.array([moon_to_sun_ratio(moon_at(phase_deg=phase), 555.0) for phase in phases])
    ratio = ours / rolo(phases)
    assert np.all(np.abs(ratio - 1.0) < 0.10)
    assert np.ptp(2.5 * np.log10(ratio)) < 0.08


def test_moonlight_follows_both_distances():
    near, far = (
        moon_to_sun_ratio(moon_at(distance_km=356_500.0), 550.0),
        moon_to_sun_ratio(moon_at(distance_km=406_700.0), 550.0),
    )
    assert near / far == pytest.approx((406_700.0 / 356_500.0) ** 2)
    closer = moon_to_sun_ratio(moon_at(sun_distance_au=0.9833), 550.0)
    assert closer / moon_to_sun_ratio(moon_at(), 550.0) == pytest.approx(0.9833**-2)


def test_moonlight_above_the_air():
    # A high full moon lights the ground with up to 0.3 lx (Kyba, Mohar & Posch 2017); the air takes a tenth to a fifth.
    illuminance = SOLAR_LX * moon_to_sun_ratio(moon_at(phase_deg=5.0), 555.0)
    assert 0.27 < illuminance < 0.36
    # Geometric albedo 0.12 (Allen 1973): ratio = p (R / d)², before the surge.
    plain = 10.0 ** (-0.4 * (night.FULL_MOON_MAGNITUDE_V - night.SUN_MAGNITUDE_V))
    assert plain / (1737.4 / 384_400.0) ** 2 == pytest.approx(0.12, abs=0.005)


def test_moonlight_is_redder_than_sunlight():
    blue, green, red = moon_to_sun_ratio(moon_at(), [440.0, 550.0, 650.0])
    # (B - V) differs by 0.27 mag between moon and sun.
    assert 2.5 * np.log10(green / blue) == pytest.approx(0.27, abs=0.01)
    assert red > green > blue


@pytest.mark.parametrize("phase_deg", [3.5, 10.0, 45.0, 90.0])
@pytest.mark.parametrize("altitude_deg", [10.0, 20.0, 40.0, 60.0])
def test_full_to_half_moon_within_both_published_laws(phase_deg, altitude_deg):
    """Phase and distance law alone: the Circular's own extinction stands for the air.

    Full moon is at 3.5°, its mean phase angle: the moon passes that far above or below the Earth's shadow. Neither law
    knows the opposition surge, which at exactly 0° takes us to 1.6 times the Supplement's.
    """
    above = SOLAR_LX * moon_to_sun_ratio(moon_at(phase_deg=phase_deg), 555.0)
    ours = above * usno.circular_extinction(altitude_deg)
    parallax_deg = np.degrees(np.arcsin(6378.14 / 384_400.0))
    # Ours lies 6 to 27 % above the one law; the other, whose phase law is steeper at full moon, is nearer at other phases.
    assert 1.0 < ours / usno.circular_moon_lx(altitude_deg, 180.0 - phase_deg) < 1.3
    assert (
        0.85
        < ours / usno.supplement_moon_lx(altitude_deg, phase_deg, parallax_deg)
        < (1.5 if phase_deg < 5.0 else 1.35)
    )


def test_night_sky_brightness_and_illuminance():
    sky = night_sky_radiance(128, 256)
    zenith = float(luminance(sky[0, 0]))
    assert 21.5 < -2.5 * np.log10(zenith / night.CANDELA_OF_ZERO_MAGNITUDE) < 21.8  # mag/arcsec², natural dark sites
    on_ground = float(luminance(diffuse_horizontal_illuminance(sky)))
    # Between the Circular's 0.5 mlx and twice that; above the Supplement's fit at -18° by 43 %.
    assert 0.5e-3 < on_ground < 1.0e-3
    assert 1.0 < on_ground / usno.supplement_sun_lx(-18.0) < 1.5


def test_night_sky_brightens_towards_the_horizon_then_fades_into_the_air():
    rows = luminance(night_sky_radiance(180, 4)[:90, 0])
    peak = 89.5 - np.argmax(rows)
    assert 5.0 < peak < 20.0
    assert 1.3 < rows.max() / rows[0] < 2.5  # 0.3 to 1 mag: the longer path through the layer, less extinction
    assert rows[-1] < rows[0]
    high = luminance(night_sky_radiance(180, 4, height_m=4000.0)[:90, 0])
    assert np.all(high > rows)


def test_ground_under_the_night_sky_is_lambertian():
    sky = night_sky_radiance(64, 128, ground_albedo=0.5)
    lit = diffuse_horizontal_illuminance(sky)
    assert np.allclose(sky[40:], 0.5 / np.pi * lit)


def test_closed_forms():
    assert van_rhijn(90.0) == pytest.approx(1.0)
    assert van_rhijn(0.0) == pytest.approx(1.0 / np.sqrt(1.0 - (6371.0 / 6461.0) ** 2))
    assert air_mass(90.0) == pytest.approx(1.0, abs=1e-3)
    assert air_mass(30.0) == pytest.approx(1.994, abs=0.002)  # Kasten & Young (1989), table
    assert air_mass(0.0) == pytest.approx(37.92, abs=0.05)


def test_colours_follow_from_their_spectra():
    """The stored colours, recomputed from lines, continua and Planckians with the CIE 1931 observer."""
    colour = pytest.importorskip("colour")
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(colour.SpectralShape(380, 780, 1))
    wavelength, matching = observer.wavelengths, observer.values
    to_rgb = np.asarray(colour.RGB_COLOURSPACES["ITU-R BT.709"].matrix_XYZ_to_RGB)
    planck, light = 6.62607015e-34, 2.99792458e8
    rayleigh = 1e10 / (4 * np.pi) * planck * light / (wavelength * 1e-9)  # W/m²/sr of 1 R at each wavelength

    glow = 0.3 * 10 * rayleigh  # 0.3 R/Å
    for line_nm, strength in ((557.7, 250.0), (589.3, 60.0), (630.0, 100.0)):
        glow[np.argmin(np.abs(wavelength - line_nm))] += strength * np.interp(line_nm, wavelength, rayleigh)
    xyz = 683.002 * glow @ matching
    assert xyz[1] == pytest.approx(night.AIRGLOW_CD_M2, rel=0.05)
    assert np.allclose(to_rgb @ (xyz / xyz[1]), night.AIRGLOW_RGB, atol=0.02)

    for kelvin, stored in ((5600.0, night.ZODIACAL_RGB), (4900.0, night.STARLIGHT_RGB)):
        spectrum = wavelength**-5.0 / np.expm1(planck * light / (wavelength * 1e-9 * 1.380649e-23 * kelvin))
        xyz = spectrum @ matching
        assert np.allclose(to_rgb @ (xyz / xyz[1]), stored, atol=0.01)
    for stored in (night.AIRGLOW_RGB, night.ZODIACAL_RGB, night.STARLIGHT_RGB):
        assert luminance(stored) == pytest.approx(1.0, abs=2e-3)
