"""Correlated colour temperature: against colour-science, whose Planckian locus the package ships."""

import numpy as np
import pytest

from seasonscapes.sky.colour_temperature import _table, correlated_colour_temperature_k, planckian_locus


def test_the_shipped_locus_is_colour_sciences():
    for shipped, computed in zip(_table(), planckian_locus(), strict=True):
        np.testing.assert_allclose(shipped, computed, rtol=1e-9)


def test_temperatures_are_colour_sciences():
    import colour

    matrix = np.asarray(colour.RGB_COLOURSPACES["ITU-R BT.709"].matrix_RGB_to_XYZ)
    rng = np.random.default_rng(5)
    for rgb in rng.uniform(0.2, 1.0, (60, 3)) * [1.0, 1.0, 1.2]:
        kelvin, duv = colour.temperature.uv_to_CCT_Ohno2013(colour.UCS_to_uv(colour.XYZ_to_UCS(matrix @ rgb)))
        found = correlated_colour_temperature_k(rgb)
        if 1100.0 < kelvin < 50_000.0 and abs(duv) < 0.045:
            assert found == pytest.approx(kelvin, rel=2e-3)
    assert correlated_colour_temperature_k([1.0, 1.0, 1.0]) == pytest.approx(6503.5, abs=3.0)


def test_undefined_colours_have_none():
    for rgb in ([0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [np.nan, 1.0, 1.0], [-1.0, 0.1, 0.1]):
        assert correlated_colour_temperature_k(rgb) is None
