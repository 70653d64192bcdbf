r"""Scores that are shares of the voxels that a site's beams cross: of their number, of occupancy, of entropy.

.. math:: \sum_v w(v) [hits(v) > 0] \Big/ \sum_v w(v)

with w = 1 where traffic ever is (``coverage``: the rest are blind spots; Kim et al. 2023), w = p
(``expected_visibility``), w = H(p) (``entropy_seen``). A share of nothing, of a TPOG without traffic, is 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.readers import Tpog
from pipeline.scoring.thinning import Hits

NAMES = ("entropy_seen", "coverage", "expected_visibility")


def ever_occupied(tpogs: Sequence[Tpog]) -> NDArray[np.int64]:
    """Flat index of every voxel that traffic ever occupies in one of some TPOGs over one grid, ascending."""
    occupied = np.zeros(tpogs[0].counts.shape, dtype=np.bool_)
    for tpog in tpogs:
        occupied |= tpog.counts > 0
    return np.flatnonzero(occupied)


@dataclass(frozen=True, eq=False)
class OccupiedVoxels:
    """The voxels that traffic ever occupies: their flat index, (n,) int64, and the frames in which it does, (n,)."""

    cells: NDArray[np.int64]
    counts: NDArray[np.int64]

    @classmethod
    def of(cls, counts: NDArray[np.int64]) -> OccupiedVoxels:
        """From the counts of all voxels, in any shape."""
        cells = np.flatnonzero(counts)
        return cls(cells, counts.ravel()[cells])

    def coverage(self, hits: Hits) -> float:
        """The share of them that beams cross; ``hits`` are of all voxels, flat."""
        crossed = int(np.count_nonzero(hits[self.cells]))
        return crossed / len(self.cells) if len(self.cells) else 0.0

    def expected_visibility(self, hits: Hits) -> float:
        """The share of occupancy in those that beams cross."""
        crossed = int(self.counts[hits[self.cells] > 0].sum())
        return crossed / int(self.counts.sum()) if len(self.counts) else 0.0
