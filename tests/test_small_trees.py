"""Boosted trees of few leaves: the model's own prediction bit for bit, also on thresholds and with missing values."""

import numpy as np
import pytest
from sklearn.ensemble import HistGradientBoostingRegressor
from threadpoolctl import threadpool_limits

from seasonscapes.texturing import small_trees as module
from seasonscapes.texturing.small_trees import small_trees


def fitted(seed: int, leaves: int, *, missing_share: float = 0.1):
    """A model of positive targets, and rows it has not seen: some lie on its thresholds, some lack values."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(6000, 5)).round(1).astype(np.float32)
    rows[rng.random(rows.shape) < missing_share] = np.nan
    target = rng.gamma(1.0, np.exp(np.nan_to_num(rows[:, 0], nan=1.5)) + np.nan_to_num(rows[:, 1]) ** 2)
    model = HistGradientBoostingRegressor(
        loss="poisson",
        max_iter=15,
        max_leaf_nodes=leaves,
        early_stopping=False,  # pyright: ignore[reportArgumentType]
        random_state=seed,
    )
    with threadpool_limits(1, "openmp"):
        model.fit(rows[:3000], target[:3000])
    other = rows[3000:]
    # Midpoints of values with one decimal are where splits lie; half of the rows are between others.
    other[::3] += np.float32(0.05)
    return model, other


@pytest.mark.parametrize("missing_share", [0.0, 0.1])
def test_sums_are_those_of_the_model(monkeypatch, missing_share):
    model, rows = fitted(3, 6, missing_share=missing_share)
    monkeypatch.setattr(module, "_BLOCK", 700)  # several blocks, the last one smaller
    found = np.exp(small_trees(model)(np.ascontiguousarray(rows.T)))
    with threadpool_limits(1, "openmp"):
        expected = model.predict(rows)
    np.testing.assert_array_equal(found, expected)
    assert len(np.unique(found)) > 100


def test_a_missing_value_follows_its_own_branch():
    model, _ = fitted(4, 4)
    trees, empty = small_trees(model), np.full((5, 1), np.nan, np.float32)
    with threadpool_limits(1, "openmp"):
        assert np.exp(trees(empty))[0] == model.predict(empty.T)[0]
    # To lack the first feature, which the targets reward, is not to be at its mean.
    assert trees(empty)[0] != trees(np.zeros((5, 1), np.float32))[0]


def test_trees_too_large_for_a_table_are_refused():
    model, _ = fitted(5, 31)
    with pytest.raises(ValueError, match="leaves, expected at most 9"):
        small_trees(model)
