"""Boosted trees of few leaves, evaluated for many rows at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from sklearn.ensemble import HistGradientBoostingRegressor

# Most splits of a tree: its leaves by the answers to all of its splits fill a table of 2^8 values.
_MOST_SPLITS = 8
# Rows evaluated at once: their columns stay in the cache.
_BLOCK = 16_384


@dataclass(frozen=True)
class _Split:
    """A row answers yes where its feature is above the threshold, or missing and ``missing_above``."""

    feature: int
    threshold: np.float32
    missing_above: bool


@dataclass(frozen=True)
class SmallTrees:
    """Sum of trees of few leaves.

    All splits of a tree are answered for all rows, one comparison of a column each, and the answers are the bits of a place
    in a table of the tree's leaves. For trees of six leaves this takes an eighth of the time of following each row through
    each tree, and the sums are the same bit for bit.

    Parameters
    ----------
    start
        Value to which the trees' values are added.
    trees
        Of each tree the splits, and the float64 values of the leaves by the number whose bits are the splits' answers.
    """

    start: float
    trees: tuple[tuple[tuple[_Split, ...], np.ndarray], ...]

    def __call__(self, columns: np.ndarray) -> np.ndarray:
        """Return the sum of the trees ``(n,)`` float64.

        Parameters
        ----------
        columns
            ``(G, n)`` float32 features, each contiguous; NaN where missing.
        """
        total = np.full(columns.shape[1], self.start)
        for first in range(0, len(total), _BLOCK):
            part = slice(first, min(first + _BLOCK, len(total)))
            self._add(columns[:, part], total[part])
        return total

    def _add(self, columns: np.ndarray, total: np.ndarray) -> None:
        answer, place = np.empty(len(total), bool), np.empty(len(total), np.uint8)
        bit, value = answer.view(np.uint8), np.empty(len(total))
        for splits, leaves in self.trees:
            place[:] = 0
            for split in splits:
                column = columns[split.feature]
                if split.missing_above:
                    # No comparison with NaN is true.
                    np.less_equal(column, split.threshold, out=answer)
                    np.logical_not(answer, out=answer)
                else:
                    np.greater(column, split.threshold, out=answer)
                np.add(place, place, out=place)
                np.add(place, bit, out=place)
            np.take(leaves, place, out=value, mode="clip")
            total += value


def small_trees(model: HistGradientBoostingRegressor) -> SmallTrees:
    """Take the trees out of a fitted model without categorical features.

    Parameters
    ----------
    model
        With one output and at most nine leaves a tree.

    Returns
    -------
    SmallTrees
        Their sum is the model's prediction before its link is inverted: for the Poisson loss, the prediction's logarithm.

    Raises
    ------
    ValueError
        A tree of more than nine leaves.
    """
    # scikit-learn has no public access to these trees: pyproject.toml admits the versions that have these names.
    start = float(model._baseline_prediction.item())  # pyright: ignore[reportAttributeAccessIssue]
    return SmallTrees(start, tuple(_taken(tree.nodes) for (tree,) in model._predictors))


def _taken(nodes: np.ndarray) -> tuple[tuple[_Split, ...], np.ndarray]:
    inner = np.flatnonzero(nodes["is_leaf"] == 0)
    if len(inner) > _MOST_SPLITS:
        raise ValueError(f"small_trees: a tree of {len(inner) + 1} leaves, expected at most {_MOST_SPLITS + 1}")
    splits = tuple(
        _Split(int(node["feature_idx"]), _at_most(node["num_threshold"]), not node["missing_go_to_left"])
        for node in nodes[inner]
    )
    # The first split's answer is the highest bit.
    bit_of = {int(node): len(inner) - 1 - number for number, node in enumerate(inner)}
    leaves = np.empty(2 ** len(inner))
    for place in range(len(leaves)):
        node = 0
        while not nodes[node]["is_leaf"]:
            node = int(nodes[node]["right" if place >> bit_of[node] & 1 else "left"])
        leaves[place] = nodes[node]["value"]
    return splits, leaves


def _at_most(threshold: float) -> np.float32:
    """The greatest float32 number up to a threshold, above which the same float32 values lie."""
    with np.errstate(over="ignore"):
        nearest = np.float32(threshold)
    return np.nextafter(nearest, np.float32(-np.inf)) if nearest > threshold else nearest
