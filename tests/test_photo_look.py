"""The look of a photograph: neutral whites, kept highlights, contrast, and nights that are neither green nor black."""

import numpy as np
import pytest

import seasonscapes as ss
from seasonscapes.exposure import develop, exposure_ev100, photo_ev100
from seasonscapes.images import EXPOSURE_GAIN, REC709_LUMINANCE, expose, image_luminance, srgb_from_linear
from seasonscapes.photo_look import DAYLIGHT_RGB, balanced, highlight_stops, photo_curve, white_point
from seasonscapes.relighting.film import _levels as levels_of


def test_white_becomes_neutral_and_keeps_its_luminance():
    white = white_point(np.array([126_000.0, 108_000.0, 95_000.0]))
    assert white @ REC709_LUMINANCE == pytest.approx(1.0)
    neutral = balanced(np.array([white]), white)[0]
    np.testing.assert_allclose(neutral, neutral.mean(), rtol=1e-3)
    assert neutral.mean() == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize("kind", [np.float16, np.float64, np.uint8])
def test_pictures_of_other_types_are_balanced_alike(kind):
    picture = np.array([[[2.0, 3.0, 5.0], [7.0, 1.0, 0.0]]])
    expected = balanced(picture.astype(np.float32), DAYLIGHT_RGB)
    np.testing.assert_allclose(balanced(picture.astype(kind), DAYLIGHT_RGB), expected, rtol=1e-5)
    assert balanced(np.zeros((0, 3), kind), DAYLIGHT_RGB).shape == (0, 3)


def test_a_low_sun_stays_warm_and_no_sun_is_neutral():
    noon, low = white_point(np.array([1.16, 1.0, 0.87])), white_point(np.array([1.8, 1.0, 0.3]))
    sunset = balanced(np.array([[1.8, 1.0, 0.3]]), low)[0]
    assert sunset[0] > 1.3 * sunset[2]
    assert low[0] / low[2] < 1.5
    assert white_point(None) == (1.0, 1.0, 1.0)
    assert noon != (1.0, 1.0, 1.0)


def test_the_curve_keeps_grey_adds_contrast_and_never_clips():
    ramp = np.geomspace(1e-4, 50.0, 200)[:, None] * np.ones(3)
    shown = photo_curve(ramp)
    assert photo_curve(np.full((1, 3), 0.18))[0, 0] == pytest.approx(0.18, abs=1e-4)
    assert np.all(np.diff(shown[:, 1]) > 0.0)
    assert shown.max() < 1.0
    middle = np.log(photo_curve(np.full((1, 3), 0.2))) - np.log(photo_curve(np.full((1, 3), 0.16)))
    assert middle[0, 0] / np.log(0.2 / 0.16) > 1.2


def test_saturated_colours_keep_their_order():
    shown = photo_curve(np.array([[3.0, 1.0, 0.2]]))[0]
    assert shown[0] > shown[1] > shown[2] >= 0.0


def test_snow_is_brightened_and_a_bright_sky_is_not():
    snow = np.full((20, 20, 3), 0.2)
    assert highlight_stops(snow, 15.0) == pytest.approx(0.9)
    assert highlight_stops(np.full((20, 20, 3), 5.0), 15.0) == pytest.approx(-0.3)


def test_a_moonless_night_is_neither_green_nor_black():
    rng = np.random.default_rng(2)
    # Airglow: greenish, some 1e-4 cd/m2, over a darker slope.
    night = np.concatenate([np.full((30, 60, 3), 2e-4), np.full((30, 60, 3), 4e-5)]) * [1.0, 1.02, 0.55]
    night = night * rng.uniform(0.9, 1.1, (60, 60, 1))
    levels = 255.0 * ss.srgb_from_linear(ss.develop(night))
    assert levels[:30].mean(axis=(0, 1))[2] > levels[:30].mean(axis=(0, 1))[1] * 0.98, "not olive"
    assert levels[30:].mean() > 8.0, "not black"
    assert levels.mean() < 110.0, "but a night"


def test_looks_and_balances_are_checked():
    picture = np.full((4, 6, 3), 3000.0)
    with pytest.raises(ss.InputError, match="unknown look"):
        ss.develop(picture, look="vivid")
    with pytest.raises(ss.InputError, match="unknown white balance"):
        ss.develop(picture, white_balance="tungsten")
    warm = ss.develop(picture, white_balance="daylight")
    assert warm[0, 0, 2] > warm[0, 0, 0], "5,500 K daylight is balanced, so that neutral radiance looks cool"
    assert DAYLIGHT_RGB[0] > DAYLIGHT_RGB[2]


def test_a_fixed_exposure_is_left_alone():
    picture = np.full((4, 6, 3), 3000.0)
    assert exposure_ev100(picture, 12.5, look="photo") == 12.5
    np.testing.assert_array_equal(develop(picture, 12.5), develop(picture, 12.5, look="neutral"))


def test_pictures_in_single_precision_are_those_of_the_formulas():
    """The quick powers of the curve within 1e-5; a film's levels within half a step of their table where noise decides."""
    rng = np.random.default_rng(5)
    exposed = rng.random((40, 30, 3)).astype(np.float32) ** 6 * 30.0
    exposed[0, 0] = 0.0
    power = exposed.astype(np.float64) ** 1.6
    half = 0.18**1.6 * (1.0 / 0.18 - 1.0)
    peak = exposed.max(axis=-1, keepdims=True).astype(np.float64)
    kept_hue = exposed * (peak**1.6 / (peak**1.6 + half)) / np.maximum(peak, 1e-12)
    shown = photo_curve(exposed)
    np.testing.assert_allclose(shown, 0.6 * power / (power + half) + 0.4 * kept_hue, rtol=1e-5, atol=1e-7)
    noise = rng.random((40, 30, 1)).astype(np.float32)
    shown[1, 1] = [1.2, -0.1, 0.001]
    levels = levels_of(shown, noise).astype(int)
    exact = srgb_from_linear(shown.astype(np.float64)) * 255.0 + noise
    assert ((levels <= exact + 0.026) & (levels > np.minimum(exact, 255.0) - 1.026)).all()
    assert levels.max() == 255


def test_the_stops_of_a_picture_follow_its_luminance():
    image = np.random.default_rng(6).random((30, 40, 3)).astype(np.float32) * [900.0, 700.0, 400.0]
    exposed = expose(image, 12.0) * EXPOSURE_GAIN
    assert highlight_stops(exposed, 12.0) == pytest.approx(highlight_stops(image_luminance(exposed), 12.0), abs=1e-6)
    assert photo_ev100(image, 12.0) == pytest.approx(12.0 - highlight_stops(exposed, 12.0), abs=1e-6)
