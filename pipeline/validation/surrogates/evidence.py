r"""What scores are computed from: one site's empty scan, and the traffic that the TPOG was counted from.

Everything is worked out when it is first asked for, and once: what depends on the traffic alone for all sites
(:class:`Occupancy`), what depends on a site for all scores (:class:`SiteEvidence`). Unseen traffic, with which sites
are judged, is no part of it.

Frame: the grid's own, in metres. Voxels are known by their flat index ``(ix * ny + iy) * nz + iz``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts.readers import Tpog
from pipeline.kernels.crossings import best_free
from pipeline.scoring.egvs import EntropyField
from pipeline.scoring.targets.seen import SeenTargets
from pipeline.scoring.thinning import Hits
from pipeline.scoring.visibility import Beams
from pipeline.sensing import crossings

Floats = NDArray[np.float64]


def everything(range_m: Floats) -> Floats:
    """The chance that a return is noticed where no effect says otherwise: 1 at any range."""
    return np.ones(len(range_m))


@dataclass(frozen=True, eq=False)
class Occupancy:
    """A TPOG, and what scores ask of it.

    Attributes
    ----------
    tpog
        Grid, frames and counts.
    """

    tpog: Tpog

    @cached_property
    def field(self) -> EntropyField:
        """Entropies in bits, as the published score takes them."""
        return EntropyField.of(self.tpog.counts, self.tpog.frames, self.tpog.grid)

    @cached_property
    def cells(self) -> NDArray[np.int64]:
        """Voxels that are ever occupied (p > 0), (n,) int64, ascending."""
        return np.flatnonzero(self.tpog.counts.ravel() > 0)

    @cached_property
    def counts(self) -> NDArray[np.int64]:
        """Frames in which each of ``cells`` is occupied, (n,)."""
        return self.tpog.counts.ravel()[self.cells]

    @cached_property
    def p(self) -> Floats:
        """Share of the frames in which each of ``cells`` is occupied, (n,)."""
        return self.counts / self.tpog.frames

    @cached_property
    def log_free(self) -> Floats:
        """Logarithm of the chance that a voxel is free, of all voxels; minus infinity where p = 1."""
        log_free = np.zeros(self.tpog.counts.size)
        with np.errstate(divide="ignore"):
            log_free[self.cells] = np.log1p(-self.p)
        return log_free

    @cached_property
    def lowest(self) -> NDArray[np.int64]:
        """The lowest layer in which a column of voxels is ever occupied, (nx, ny) int64; -1 where none is."""
        occupied = self.tpog.counts > 0
        return np.where(occupied.any(axis=2), occupied.argmax(axis=2), -1)


@dataclass(frozen=True, eq=False)
class SiteEvidence:
    """What a score may ask of one site.

    Attributes
    ----------
    occupancy
        The TPOG.
    beams
        The empty scan: pose, sensor, ends and weights.
    returned
        Which beams met a static surface, (n,) bool.
    count
        Counts hits of the beams: by voxel, flat, in whole multiples of the reciprocal of the second value.
    look
        Counts points on vehicles.
    noticed
        The chance that a return from each range (n,) is noticed.
    """

    occupancy: Occupancy
    beams: Beams
    returned: NDArray[np.bool_]
    count: Callable[[Beams], tuple[Hits, int]]
    look: Callable[[Beams], SeenTargets]
    noticed: Callable[[Floats], Floats] = everything

    @cached_property
    def counted(self) -> tuple[Hits, int]:
        """Beams that cross each voxel, of all voxels, times the second value."""
        return self.count(self.beams)

    @property
    def hits(self) -> Floats:
        """Beams that cross each of the occupancy's ``cells``, (n,) float64."""
        hits, unit = self.counted
        return hits[self.occupancy.cells] / unit

    @cached_property
    def log_reach(self) -> Floats:
        """Logarithm of the chance that a beam gets as far as each of the occupancy's ``cells`` if voxels are occupied
        independently of each other, (n,): of the beam that has the best chance; minus infinity where none crosses."""
        best = np.full(self.occupancy.tpog.counts.size, -np.inf)
        for piece in crossings.listed(self.beams.pose.position_m, self.beams.ends_m, self.occupancy.tpog.grid):
            best_free(piece.first, piece.cells, self.occupancy.log_free, best)
        return best[self.occupancy.cells]

    @cached_property
    def returns(self) -> tuple[Floats, Floats]:
        """Where the empty scan's returns lie, (k, 3), and what each is worth, (k,)."""
        ends = self.beams.ends_m[self.returned]
        weight = np.ones(len(ends)) if self.beams.weight is None else self.beams.weight[self.returned]
        position = self.occupancy.tpog.grid.to_grid_m(np.asarray(self.beams.pose.position_m))
        return position + ends, weight * self.noticed(np.sqrt((ends**2).sum(axis=1)))

    @cached_property
    def vehicles(self) -> SeenTargets:
        """Points on the vehicles of the traffic that the TPOG was counted from."""
        return self.look(self.beams)
