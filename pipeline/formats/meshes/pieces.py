"""Takes a triangle mesh apart into its pieces, and tells which of them are closed.

Triangles belong to one piece where they share an edge that no third one has. A piece is closed where each of its edges
is in exactly two of its triangles, which run along it in opposite directions.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]


def pieces_of(adjacent: Ints, triangles: int) -> Ints:
    """The number of each triangle's piece, (m,), in the order of the pieces' first triangles.

    ``adjacent`` (n, 2) are pairs of triangles that share an edge alone.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    graph = coo_array((np.ones(len(adjacent), dtype=bool), adjacent.T), shape=(triangles, triangles))
    labels = connected_components(graph, directed=False)[1]
    _, first, which = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[which]


def are_closed(faces: Ints, piece: Ints) -> NDArray[np.bool_]:
    """Which pieces are closed, (pieces,); ``faces`` (m, 3), ``piece`` (m,) as :func:`pieces_of` gives it."""
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    owner, low, high = np.repeat(piece, 3), edges.min(axis=1), edges.max(axis=1)
    order = np.lexsort((high, low, owner))
    keys = np.column_stack([owner, low, high])[order]
    starts = np.flatnonzero(np.insert((np.diff(keys, axis=0) != 0).any(axis=1), 0, True))
    turn = np.where(edges[:, 0] < edges[:, 1], 1, -1)[order]
    sound = (np.diff(starts, append=len(keys)) == 2) & (np.add.reduceat(turn, starts) == 0)
    closed = np.ones(int(piece.max()) + 1, dtype=bool)
    closed[keys[starts[~sound], 0]] = False
    return closed
