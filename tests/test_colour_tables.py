"""Colour tables and formulas that are kept here, because colour-science takes seconds to import, equal that package's."""

import colour
import numpy as np
import pytest

from seasonscapes.images import REC709_LUMINANCE, XYZ_FROM_REC709, linear_from_srgb, srgb_from_linear
from seasonscapes.photo_look import DAYLIGHT_RGB, balanced
from seasonscapes.sky.overcast import daylight_rgb
from seasonscapes.sky.spectrum import RGB_FROM_XYZ

REC709 = colour.RGB_COLOURSPACES["ITU-R BT.709"]


def test_rec709_to_xyz_and_back():
    np.testing.assert_allclose(XYZ_FROM_REC709, REC709.matrix_RGB_to_XYZ, atol=1e-12)
    np.testing.assert_allclose(RGB_FROM_XYZ, REC709.matrix_XYZ_to_RGB, atol=1e-10)
    white = colour.xy_to_XYZ(colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"])
    np.testing.assert_allclose(XYZ_FROM_REC709.sum(axis=1), white, atol=1e-12)
    assert REC709_LUMINANCE.sum() == pytest.approx(1.0, abs=1e-12)


def test_srgb_encoding_and_decoding():
    values = np.linspace(0.0, 1.0, 4001)
    np.testing.assert_allclose(srgb_from_linear(values), colour.models.eotf_inverse_sRGB(values), atol=1e-12)
    np.testing.assert_allclose(linear_from_srgb(values), colour.models.eotf_sRGB(values), atol=1e-6)  # float32


@pytest.mark.parametrize("kelvin", [4000.0, 5500.0, 6504.0, 7000.0, 7001.0, 12_000.0, 25_000.0])
def test_daylight(kelvin):
    xyz = colour.xy_to_XYZ(colour.temperature.CCT_to_xy_CIE_D(kelvin))
    np.testing.assert_allclose(daylight_rgb(kelvin), REC709.matrix_XYZ_to_RGB @ xyz, atol=1e-9)


def test_the_balance_of_daylight_film():
    np.testing.assert_allclose(DAYLIGHT_RGB, daylight_rgb(5500.0), atol=1e-6)


@pytest.mark.parametrize("white", [(1.06, 0.99, 0.86), DAYLIGHT_RGB, (0.8, 1.0, 1.3)])
def test_chromatic_adaptation(white):
    image = np.random.default_rng(0).uniform(0.2, 1.0, (50, 3)).astype(np.float32)
    to_neutral = colour.adaptation.matrix_chromatic_adaptation_VonKries(
        XYZ_FROM_REC709 @ np.array(white), XYZ_FROM_REC709 @ np.ones(3), transform="Bradford"
    )
    expected = image @ (REC709.matrix_XYZ_to_RGB @ to_neutral @ REC709.matrix_RGB_to_XYZ).T
    np.testing.assert_allclose(balanced(image, white), expected, atol=1e-6)
