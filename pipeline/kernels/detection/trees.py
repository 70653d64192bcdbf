"""Adds up decision trees: boosted models that foretell a chance, as logits."""

from __future__ import annotations

import numba

_kernel = numba.njit(cache=True, nogil=True, error_model="numpy")


@_kernel
def add_trees(features, starts, feature, threshold, left, right, value, total):  # type: ignore[no-untyped-def]
    """Add what every tree says of each row to ``total``.

    Parameters
    ----------
    features
        (n, f) float64, without any that is not a number.
    starts
        Nodes starts[t] to starts[t + 1] are those of tree t, its root first, (trees + 1,) int64.
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
    for t in range(starts.shape[0] - 1):
        root = starts[t]
        for row in range(features.shape[0]):
            node = root
            while feature[node] >= 0:
                goes_left = features[row, feature[node]] <= threshold[node]
                node = root + (left[node] if goes_left else right[node])
            total[row] += value[node]
