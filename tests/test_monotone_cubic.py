"""Monotone cubic interpolation is that of scipy."""

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator

from seasonscapes.terrain.monotone_cubic import monotone_cubic


@pytest.mark.parametrize("count", [2, 3, 4, 40])
def test_equals_scipys(count):
    rng = np.random.default_rng(count)
    knots = np.cumsum(rng.uniform(0.1, 2.0, count))
    # Flat pieces, extrema and steep ends.
    values = np.round(rng.normal(size=(count, 50, 3)) * 2.0)
    at = np.sort(np.concatenate([knots, rng.uniform(knots[0], knots[-1], 200)]))
    expected = PchipInterpolator(knots, values)(at)
    np.testing.assert_allclose(monotone_cubic(knots, values, at), expected, atol=1e-12)


@pytest.mark.parametrize(("knots", "count"), [([0.0], 1), ([0.0, 1.0], 3), ([0.0, 0.0], 2)])
def test_refuses_what_is_no_table(knots, count):
    with pytest.raises(ValueError, match="increasing knots"):
        monotone_cubic(np.array(knots), np.zeros(count), np.zeros(1))
