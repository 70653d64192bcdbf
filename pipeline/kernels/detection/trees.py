"""Adds up decision trees: boosted models that foretell a chance, as logits."""

from __future__ import annotations

import numpy as np

from pipeline.kernels.compile_cache import compiled

_kernel = compiled()

_ROWS = 1024
"""Rows that go down a tree together: what is known of them stays near the processor."""


@_kernel
def add_trees(features, starts, feature, threshold, left, right, value, total):  # type: ignore[no-untyped-def]
    """Add what every tree says of each row to ``total``.

    Every node is asked of all rows at once, whether they come by it or not: a few nodes without a branch take less time
    than one path after another.

    Parameters
    ----------
    features
        Each feature of all rows in one piece, (f, n) float64, without any that is not a number.
    starts
        Nodes starts[t] to starts[t + 1] are those of tree t, its root first, a node before those that it leads to;
        (trees + 1,) int64.
    feature
        Which feature each node asks for, (nodes,) int64; below 0 at a leaf.
    threshold
        A row goes left where its feature is not above this, (nodes,) float64.
    left, right
        Where it goes, counted from the tree's root, (nodes,) int64.
    value
        What a leaf says, (nodes,) float64.
    total
        Added to, (n,) float64, tree after tree.
    """
    at = np.empty(_ROWS, np.int64)
    for begin in range(0, features.shape[1], _ROWS):
        end = min(begin + _ROWS, features.shape[1])
        for t in range(starts.shape[0] - 1):
            root = starts[t]
            at[: end - begin] = 0
            for node in range(starts[t + 1] - root):
                if feature[root + node] >= 0:
                    _pass_on(node, features[feature[root + node], begin:end], threshold[root + node],
                             left[root + node], right[root + node], at)  # fmt: skip
            for row in range(begin, end):
                total[row] += value[root + at[row - begin]]


@_kernel
def _pass_on(node, its, threshold, left, right, at):  # type: ignore[no-untyped-def]
    """Let the rows that are at a node go on, by one feature (n,) of theirs."""
    for row in range(its.shape[0]):
        on = left if its[row] <= threshold else right
        at[row] = on if at[row] == node else at[row]
