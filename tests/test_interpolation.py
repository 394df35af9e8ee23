"""Interpolation is that of scipy."""

import numpy as np
import pytest
from scipy.interpolate import PchipInterpolator
from scipy.ndimage import map_coordinates

from seasonscapes.terrain.interpolation import bilinear, monotone_cubic


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


def test_bilinear_equals_scipys_and_keeps_the_border_outside():
    rng = np.random.default_rng(5)
    nodes = rng.normal(size=(30, 40, 2)).astype(np.float32)
    row = np.concatenate([rng.uniform(-5.0, 35.0, 3000), [0.0, 29.0, 7.0]])
    column = np.concatenate([rng.uniform(-5.0, 45.0, 3000), [0.0, 39.0, 9.0]])
    expected = [
        map_coordinates(nodes[..., k], [row, column], order=1, mode="nearest", output=np.float64) for k in (0, 1)
    ]
    np.testing.assert_allclose(bilinear(nodes, column, row), np.transpose(expected), atol=1e-12)
