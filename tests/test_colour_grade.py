"""Grades that can be undone, and camera responses that are found again."""

import numpy as np
import pytest

from seasonscapes.cameras.colour_grade import (
    GRADES,
    Grade,
    Response,
    apply_grade,
    encoded_from_linear,
    fit_response_curve,
    linear_from_encoded,
    named_grade,
    undo_grade,
)
from seasonscapes.images import linear_from_srgb


def test_the_default_grade_changes_nothing():
    image = np.random.default_rng(0).uniform(0, 5e4, (20, 30, 3)).astype(np.float32)
    assert np.array_equal(apply_grade(image, Grade()), image)
    assert np.array_equal(undo_grade(image, named_grade("identity")), image)


@pytest.mark.parametrize(
    "grade",
    [*GRADES.values(), Grade(1.5, 0.4, -0.8, 0.7, -0.5, 0.4), Grade(-3.0, -0.3)],
    ids=lambda g: f"{g.exposure_ev}/{g.contrast}/{g.highlights_ev}",
)
def test_a_grade_is_undone_over_sixteen_stops_and_is_monotone(grade):
    rng = np.random.default_rng(1)
    image = 0.18 * 2.0 ** rng.uniform(-9, 7, (4000, 1)) * rng.uniform(0.2, 1.0, (4000, 3))
    image[0] = 0.0
    graded = apply_grade(image, grade)
    assert np.allclose(undo_grade(graded, grade), image, rtol=1e-9, atol=1e-15)
    grey = 0.18 * 2.0 ** np.linspace(-14, 12, 3000)[:, None] * np.ones(3)
    assert np.all(np.diff(apply_grade(grey, grade), axis=0) > 0)


def test_each_number_does_what_it_says():
    grey = np.full((1, 3), 0.18)
    four = 2.0**4
    assert apply_grade(grey, Grade(exposure_ev=1.0)) == pytest.approx(np.full((1, 3), 0.36))
    assert apply_grade(grey * four, Grade(highlights_ev=-0.5)) == pytest.approx(grey * four * 2**-0.5)
    assert apply_grade(grey / four, Grade(shadows_ev=0.5)) == pytest.approx(grey / four * 2**0.5)
    assert apply_grade(grey / four, Grade(highlights_ev=-0.5)) == pytest.approx(grey / four)
    warm = apply_grade(grey, Grade(warmth=0.4))[0]
    assert np.log2(warm[0] / warm[2]) == pytest.approx(0.4)
    assert warm @ [0.2126390, 0.7151687, 0.0721923] == pytest.approx(0.18)
    steeper = apply_grade(np.outer([0.17, 0.19], np.ones(3)), Grade(contrast=0.3))[:, 0]
    assert np.log(steeper[1] / steeper[0]) > 1.15 * np.log(0.19 / 0.17)


@pytest.mark.parametrize(
    ("numbers", "message"),
    [
        ({"contrast": 1.5}, "contrast = 1.5"),
        ({"exposure_ev": float("nan")}, "exposure_ev = nan"),
        ({"contrast": -0.5, "highlights_ev": -2.0, "shadows_ev": 2.0}, "fold the tone curve"),
        ({"middle_grey": 0.0}, "middle_grey"),
    ],
)
def test_grades_that_cannot_be_undone_are_refused(numbers, message):
    with pytest.raises(ValueError, match=message):
        Grade(**numbers)


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ValueError, match="identity, paper"):
        named_grade("velvia")


def camera_curve(light):
    """A camera with a gamma of 2 and a shoulder: not sRGB."""
    return np.sqrt(light) * (1.25 - 0.25 * light)


def test_a_response_is_found_from_pairs_some_of_which_are_wrong():
    rng = np.random.default_rng(2)
    light = rng.uniform(0.001, 1.0, (3000, 3)) ** 2
    encoded = camera_curve(light) + rng.normal(0, 0.01, light.shape)
    encoded[:150] = rng.uniform(0, 1, (150, 3))
    found = fit_response_curve(encoded, 700.0 * light)
    test_light = np.linspace(0.03, 0.9, 200)[:, None] * np.ones(3)
    recovered = linear_from_encoded(camera_curve(test_light), found)
    ratio = recovered / test_light
    assert np.std(np.log(ratio)) < 0.02
    wrong = linear_from_srgb(camera_curve(test_light)) / test_light
    assert np.std(np.log(wrong)) > 0.05
    assert np.allclose(linear_from_encoded(encoded_from_linear(recovered, found), found), recovered, atol=2e-3)


def test_srgb_is_the_default_and_useless_pairs_are_refused():
    codes = np.arange(256, dtype=np.uint8)[:, None].repeat(3, 1)
    assert np.allclose(linear_from_encoded(codes), linear_from_srgb(codes / 255.0))
    assert np.allclose(encoded_from_linear(linear_from_encoded(codes)) * 255, codes, atol=1e-3)
    with pytest.raises(ValueError, match=r"fit_response_curve: .*at least 20 are needed"):
        fit_response_curve(np.full((5, 3), 0.5), np.ones((5, 3)))
    with pytest.raises(ValueError, match="do not rise together"):
        fit_response_curve(
            np.linspace(0.1, 0.9, 99)[:, None] * np.ones(3), np.linspace(1, 0.1, 99)[:, None] * np.ones(3)
        )
    with pytest.raises(ValueError, match="strictly increasing"):
        Response(np.zeros((3, 5)))
