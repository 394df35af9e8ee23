"""Exposure modes: a camera's program, an adapted eye, a fixed value."""

import numpy as np
import pytest

from seasonscapes.errors import InputError
from seasonscapes.exposure import develop, exposure_ev100, parse_exposure
from seasonscapes.images import auto_exposure_ev100


def card(luminance: float) -> np.ndarray:
    return np.full((4, 4, 3), luminance)


def test_by_day_camera_and_meter_agree():
    assert exposure_ev100(card(5000.0)) == pytest.approx(auto_exposure_ev100(card(5000.0)))
    assert exposure_ev100(card(5000.0), "eye") == pytest.approx(auto_exposure_ev100(card(5000.0)), abs=0.01)


@pytest.mark.parametrize("mode", ["auto", "eye"])
def test_darker_scenes_look_darker_without_a_step(mode):
    """From a sunlit scene to starlight the picture darkens steadily, and never so far that nothing is left."""
    levels = [
        develop(card(value), exposure_ev100(card(value), mode)).mean() for value in np.geomspace(5000.0, 1e-4, 300)
    ]
    assert np.all(np.diff(levels) < 1e-6)
    assert np.abs(np.diff(levels)).max() < 0.01
    assert levels[-1] < 0.4 * levels[0]
    assert levels[-1] > 0.004


def test_rods_drain_colour_and_turn_it_blue():
    red = np.ones((2, 2, 3)) * [1.0, 0.1, 0.05]
    bright, dim = develop(1e4 * red, 14.0, eye=True), develop(1e-3 * red, -6.0, eye=True)
    assert bright[0, 0, 0] > 3 * bright[0, 0, 2]
    assert dim[0, 0, 2] > dim[0, 0, 0]


@pytest.mark.parametrize("how", [{"look": "photo"}, {"eye": True}])
def test_whole_numbers_and_single_pixels_develop_like_images(how):
    for luminance, ev100 in ((4000, 15.0), (1, 3.0)):
        expected = develop(card(float(luminance)), ev100, **how)
        np.testing.assert_array_equal(develop(np.full((4, 4, 3), luminance), ev100, **how), expected)
        np.testing.assert_allclose(develop(np.full(3, float(luminance)), ev100, **how), expected[0, 0], rtol=1e-12)
    dim = np.array([3e-4, 2e-4, 1e-4])
    np.testing.assert_allclose(develop(dim, -6.0, **how), develop(dim[None, None], -6.0, **how)[0, 0], rtol=1e-12)


def test_fixed_values_and_mistakes():
    assert parse_exposure("12.5") == 12.5
    assert exposure_ev100(card(1.0), 12.5) == 12.5
    for text in ("bright", "nan", "99"):
        with pytest.raises(InputError, match="--exposure: not an exposure"):
            parse_exposure(text)
    with pytest.raises(ValueError, match="exposure"):
        exposure_ev100(card(1.0), "cat")
