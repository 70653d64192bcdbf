"""Evaluation of boosted decision trees for many rows."""

from __future__ import annotations

import numpy as np

from egvs.kernels.jit import njit

_kernel = njit()

_ROWS_AT_A_TIME = 1024
"""Rows that descend a tree together: their features fit in the processor's cache."""


@_kernel
def add_tree_values(features, starts, feature, threshold, below, above, value, total):  # type: ignore[no-untyped-def]
    """Add the value of every decision tree for each row to ``total``.

    Each node is evaluated for all rows at once, whether they reach it or not: a few nodes without a branch are faster
    than one path after another.

    Parameters
    ----------
    features
        Features, (f, n) float64, contiguous along rows, without NaN.
    starts
        Nodes starts[t] to starts[t + 1] are those of tree t, its root first, each node before its children;
        (trees + 1,) int64.
    feature
        Feature of each node, (nodes,) int64; below 0 at a leaf.
    threshold
        A row goes to ``below`` where its feature is at most this, else to ``above``, (nodes,) float64.
    below, above
        Child nodes, counted from the tree's root, (nodes,) int64.
    value
        Value of each leaf, (nodes,) float64.
    total
        Added to, (n,) float64, tree after tree.
    """
    at = np.empty(_ROWS_AT_A_TIME, np.int64)
    for begin in range(0, features.shape[1], _ROWS_AT_A_TIME):
        end = min(begin + _ROWS_AT_A_TIME, features.shape[1])
        for t in range(starts.shape[0] - 1):
            root = starts[t]
            at[: end - begin] = 0
            for node in range(starts[t + 1] - root):
                if feature[root + node] >= 0:
                    _advance_rows(node, features[feature[root + node], begin:end], threshold[root + node],
                             below[root + node], above[root + node], at)  # fmt: skip
            for row in range(begin, end):
                total[row] += value[root + at[row - begin]]


@_kernel
def _advance_rows(node, values, threshold, below, above, at):  # type: ignore[no-untyped-def]
    """Move the rows that are at a node to one of its children, by one feature (n,)."""
    for row in range(values.shape[0]):
        child = below if values[row] <= threshold else above
        at[row] = child if at[row] == node else at[row]
