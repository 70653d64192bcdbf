r"""The published score: entropy of a TPOG, and the Entropy-Guided Visibility Score (EGVS) of a scan.

.. math:: H(p) = -p \log_2 p - (1 - p) \log_2 (1 - p), \qquad
          EGVS = \sum_v H(p(v)) \, \min(\gamma, hits(v))

(arXiv 2504.06772, Eq. 2 and 4), with :math:`p = c / T` from integers. Voxels with equal counts share one entropy, so
hits are first added up for each count (integers, no rounding). The sum over counts is taken in exact integer arithmetic
and rounded once. The score is therefore the same for any order of voxels, beams, threads and sites.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from decimal import Decimal, localcontext
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, Grid, IntArray
from egvs.kernels import traversal

Hits = NDArray[np.uint32] | IntArray
"""Hits of each voxel, flat, (nx * ny * nz,): numbers of beams, or multiples of a fraction of a beam."""

_DIGITS = 40
_SPARE_DIGITS = 15
"""Further digits of the logarithms in the table, which are sums of others."""

_TABLE_SIZE = 50_000
"""Finding a factor of a larger number would take as long as its logarithm."""

_SCALE = 128
"""Entropies are integer multiples of 2**-128: the smallest above 0, for T = 2**32 - 1, is 8e-9 with 53 bits."""


def binary_entropy(count: int, frames: int) -> float:
    """Return H(count / frames) in bits, correctly rounded (40 decimal digits inside, so equal on every machine).

    Raises
    ------
    ValueError
        Unless 0 <= count <= frames and frames >= 1.

    Examples
    --------
    >>> binary_entropy(5, 10)
    1.0
    """
    if not 0 <= count <= frames or frames < 1:
        raise ValueError(f"expected 0 <= count <= frames and frames >= 1, got count = {count} and frames = {frames}")
    return float(_entropies([min(count, frames - count)], frames)[0])


def _entropies(counts: list[int], frames: int) -> FloatArray:
    """Return H of each count, correctly rounded: (T ln T - c ln c - (T - c) ln(T - c)) / (T ln 2) in 40 digits."""
    entropies = np.empty(len(counts))
    with localcontext() as context:
        context.prec = _DIGITS
        t_ln_t = _n_ln_n(frames)
        scale = frames * Decimal(2).ln()
        for i, count in enumerate(counts):
            entropies[i] = float((t_ln_t - _n_ln_n(count) - _n_ln_n(frames - count)) / scale)
    return entropies


def _n_ln_n(n: int) -> Decimal:
    if n == 0:
        return Decimal(0)
    return n * _ln(n)


def _ln(n: int) -> Decimal:
    """Return ln n in 40 digits: from the table, or computed if n is larger than the table."""
    if n > _TABLE_SIZE:
        return Decimal(n).ln()
    with localcontext() as context:
        context.prec = _DIGITS + _SPARE_DIGITS
        logarithm = _tabulated_ln(n)
    return +logarithm  # rounded to the digits of the context


@cache
def _tabulated_ln(n: int) -> Decimal:
    """Return ln n with spare digits: only the logarithms of primes, which are few, are computed as series."""
    for factor in range(2, math.isqrt(n) + 1):
        if n % factor == 0:
            return _tabulated_ln(factor) + _tabulated_ln(n // factor)
    return Decimal(n).ln()


@dataclass(frozen=True)
class Score:
    """``egvs`` in bits; ``entropy_seen``: share of the entropy in voxels crossed at least once."""

    egvs: float
    entropy_seen: float


class ClassHits(NamedTuple):
    """Hits added up by class of voxel, (classes,) int64 each.

    ``capped``: voxels with at least ``cap`` hits; ``below``: sum of the hits in all others; ``crossed``: voxels with
    any hit.
    """

    capped: IntArray
    below: IntArray
    crossed: IntArray


def sum_hits_by_class(hits: Hits, cells: IntArray, classes: IntArray, n_classes: int, cap: float) -> ClassHits:
    """Add up hits by class.

    Parameters
    ----------
    hits
        Of all voxels, flat.
    cells, classes
        Flat index and class of the voxels to sum, (n,) int64.
    n_classes
        Number of classes.
    cap
        In the unit of ``hits``; may be fractional or infinite.
    """
    sums = ClassHits(*(np.zeros(n_classes, dtype=np.int64) for _ in ClassHits._fields))
    traversal.sum_by_class(hits, cells, classes, cap, *sums)
    return sums


@dataclass(frozen=True)
class EntropyField:
    """The entropy of a TPOG.

    Attributes
    ----------
    grid
        The grid of the voxels.
    cells
        Flat index of each voxel with entropy, (n,) int64, ascending.
    classes
        Index into ``entropies_bit`` of each voxel, (n,) int64.
    entropies_bit
        Entropy of each class, float64, above 0.
    sizes
        Number of voxels of each class, int64.
    """

    grid: Grid
    cells: IntArray
    classes: IntArray
    entropies_bit: FloatArray
    sizes: IntArray

    @classmethod
    def of(cls, counts: IntArray, frames: int, grid: Grid) -> EntropyField:
        """Return the entropy of voxels that are occupied in ``counts`` (nx, ny, nz) int64 of ``frames`` frames."""
        flat = counts.ravel()
        largest = int(flat.max(initial=0))
        if largest > frames:
            raise InputError(
                "tpog",
                f"a voxel is occupied in {largest} of {frames} frames",
                "Compute the TPOG again from the trajectories.",
            )

        cells = np.flatnonzero((flat > 0) & (flat < frames))
        folded = np.minimum(flat[cells], frames - flat[cells])
        values, classes, sizes = np.unique(folded, return_inverse=True, return_counts=True)
        entropies = _entropies(values.tolist(), frames)
        return cls(grid, cells, classes.astype(np.int64), entropies, sizes.astype(np.int64))

    @property
    def per_cell_bit(self) -> FloatArray:
        """Entropy of each voxel in ``cells``."""
        return self.entropies_bit[self.classes]

    @cached_property
    def total_bit(self) -> float:
        """Entropy of the TPOG: the sum of H over all voxels."""
        return self.limit(1.0)

    def score(self, hits: Hits, gamma: float, unit: int = 1) -> Score:
        """Return the score of one site.

        Parameters
        ----------
        hits
            Beams that cross each voxel, flat, (nx * ny * nz,) uint32, or int64 in multiples of 1 / ``unit``.
        gamma
            Cap, 0 or above, may be fractional or infinite.
        unit
            Hits that one beam adds to a voxel.

        Examples
        --------
        Two voxels: the first is occupied in 5 of 10 frames and crossed by 3 beams, the second is never occupied.

        >>> grid = Grid(origin_m=(0.0, 0.0, 0.0), voxel_m=0.5, shape=(2, 1, 1))
        >>> field = EntropyField.of(np.array([[[5]], [[0]]]), frames=10, grid=grid)
        >>> field.score(np.array([3, 7], dtype=np.uint32), gamma=2.0)
        Score(egvs=2.0, entropy_seen=1.0)
        """
        sums = sum_hits_by_class(hits, self.cells, self.classes, len(self.sizes), gamma * unit)
        egvs = self._sum(gamma, sums.capped, sums.below, unit)
        share = 0.0
        if len(self.cells):
            share = self._sum(1.0, sums.crossed, np.zeros_like(sums.crossed)) / self.total_bit
        return Score(egvs, share)

    def limit(self, gamma: float) -> float:
        """Return the score with at least ``gamma`` hits in every voxel: no site can reach more."""
        if not np.isinf(gamma):
            return self._sum(gamma, self.sizes, np.zeros_like(self.sizes))
        if len(self.cells):
            return float("inf")
        return 0.0

    @cached_property
    def _scaled(self) -> list[int]:
        """Entropy of each class times 2**_SCALE, an integer."""
        scaled = []
        for entropy in self.entropies_bit.tolist():
            numerator, denominator = entropy.as_integer_ratio()
            scaled.append((numerator << _SCALE) // denominator)
        return scaled

    def _sum(self, gamma: float, capped: IntArray, below: IntArray, unit: int = 1) -> float:
        """Sum over classes of H * (gamma * capped + below / unit), exact, rounded once."""
        numerator, denominator = 0, 1  # with an infinite gamma, no voxel is capped
        if not np.isinf(gamma):
            numerator, denominator = gamma.as_integer_ratio()

        total = 0
        for entropy, n_capped, hits_below in zip(self._scaled, capped.tolist(), below.tolist(), strict=True):
            total += entropy * (numerator * unit * n_capped + denominator * hits_below)

        try:
            return float(total / (denominator * unit << _SCALE))
        except OverflowError:  # a gamma near the largest float64, times the voxels
            return float("inf")
