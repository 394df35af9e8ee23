"""Texels at the border of what photographs see."""

import numpy as np

from seasonscapes.albedo.standard_error import rim_of_seen


def test_the_rim_is_one_texel_wide_and_the_atlas_border_has_none():
    seen = np.zeros((12, 14), bool)
    seen[4:, 3:10] = True
    expected = np.zeros_like(seen)
    expected[4, 3:10] = expected[4:, 3] = expected[4:, 9] = True
    assert np.array_equal(rim_of_seen(seen), expected)


def test_gaps_of_one_texel_and_what_is_thinner_than_a_rim_stay_measured():
    seen = np.ones((9, 9), bool)
    seen[::2, 4] = seen[4, 6] = False
    assert not rim_of_seen(seen).any()
    thin = np.zeros((9, 9), bool)
    thin[3:5, :] = True
    assert not rim_of_seen(thin).any()
