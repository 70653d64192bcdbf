r"""The published score: how uncertain a voxel is, and what a site makes of that.

.. math:: H(p) = -p \log_2 p - (1 - p) \log_2 (1 - p), \qquad
          EGVS = \sum_v H(p(v)) \, \min(\gamma, hits(v))

(arXiv 2504.06772, Eq. 2 and 4), with :math:`p = c / T` from integers. Voxels with equal counts share one entropy, so
hits are first added up for each count - whole numbers, no rounding - and the sum over counts is taken in exact integer
arithmetic and rounded once. The score is therefore the same for any order of voxels, beams, threads and sites.
"""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal, localcontext
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from pipeline.core.errors import InputError
from pipeline.core.grid import Grid
from pipeline.kernels import march

_DIGITS = 40
_SCALE = 128
"""Entropies are whole multiples of 2**-128: the smallest above 0, for T = 2**32 - 1, is 8e-9 with 53 bits."""


def binary_entropy(count: int, frames: int) -> float:
    """H(count / frames) in bits, correctly rounded (40 decimal digits inside; the same bits on every machine).

    Raises
    ------
    ValueError
        Unless 0 <= count <= frames and frames >= 1.
    """
    if not 0 <= count <= frames or frames < 1:
        raise ValueError(f"count = {count} of frames = {frames}; 0 <= count <= frames and frames >= 1 is needed")
    return float(_entropies([min(count, frames - count)], frames)[0])


def _entropies(counts: list[int], frames: int) -> NDArray[np.float64]:
    """H of each count, correctly rounded: T log T - c log c - (T - c) log(T - c), over T log 2, in 40 digits."""
    with localcontext() as context:
        context.prec = _DIGITS
        whole, scale = _n_ln_n(frames), frames * Decimal(2).ln()
        return np.array([float((whole - _n_ln_n(c) - _n_ln_n(frames - c)) / scale) for c in counts], dtype=np.float64)


def _n_ln_n(n: int) -> Decimal:
    return n * Decimal(n).ln() if n else Decimal(0)


@dataclass(frozen=True)
class EntropyField:
    """The entropy of a TPOG, as the score needs it.

    Attributes
    ----------
    grid
        The grid of the voxels.
    cells
        Flat index of each voxel with entropy, (n,) int64, ascending.
    classes
        Which of ``entropies_bit`` each voxel has, (n,) int64.
    entropies_bit
        Entropy of each class, float64, above 0.
    sizes
        Voxels of each class, int64.
    """

    grid: Grid
    cells: NDArray[np.int64]
    classes: NDArray[np.int64]
    entropies_bit: NDArray[np.float64]
    sizes: NDArray[np.int64]

    @classmethod
    def of(cls, counts: NDArray[np.int64], frames: int, grid: Grid) -> EntropyField:
        """From the counts of all blocks added up, (nx, ny, nz) int64."""
        flat = counts.ravel()
        if len(flat) and int(flat.max()) > frames:
            raise InputError(
                "tpog", f"a voxel is occupied in {int(flat.max())} of {frames} frames", "counts up to the frames"
            )
        cells = np.flatnonzero((flat > 0) & (flat < frames))
        folded = np.minimum(flat[cells], frames - flat[cells])
        values, classes, sizes = np.unique(folded, return_inverse=True, return_counts=True)
        entropies = _entropies(values.tolist(), frames)
        return cls(grid, cells, classes.astype(np.int64), entropies, sizes.astype(np.int64))

    @property
    def per_cell_bit(self) -> NDArray[np.float64]:
        """Entropy of each voxel in ``cells``."""
        return self.entropies_bit[self.classes]

    def score(self, hits: NDArray[np.uint32] | NDArray[np.int64], gamma: float, unit: int = 1) -> Score:
        """The score of one site.

        Parameters
        ----------
        hits
            Beams that cross each voxel, flat, (nx * ny * nz,) uint32, or int64 in multiples of 1 / ``unit``.
        gamma
            Cap, 0 or above, may be fractional or infinite.
        """
        capped, below, seen = (np.zeros(len(self.sizes), dtype=np.int64) for _ in range(3))
        march.tally(hits, self.cells, self.classes, gamma * unit, capped, below, seen)
        egvs = self._sum(gamma, capped, below, unit)
        share = self._sum(1.0, seen, np.zeros_like(seen)) / self.total_bit if len(self.cells) else 0.0
        return Score(egvs, share)

    @cached_property
    def total_bit(self) -> float:
        """The TPOG's entropy: the sum of H over all voxels."""
        return self.limit(1.0)

    @cached_property
    def _scaled(self) -> list[int]:
        """Each class' entropy times 2**_SCALE, a whole number."""
        ratios = (entropy.as_integer_ratio() for entropy in self.entropies_bit.tolist())
        return [(top << _SCALE) // bottom for top, bottom in ratios]

    def limit(self, gamma: float) -> float:
        """The same sum with gamma in every voxel."""
        if np.isinf(gamma):
            return float("inf") if len(self.cells) else 0.0
        return self._sum(gamma, self.sizes, np.zeros_like(self.sizes))

    def _sum(self, gamma: float, capped: NDArray[np.int64], below: NDArray[np.int64], unit: int = 1) -> float:
        """Sum over classes of H * (gamma * capped + below / unit), exact, rounded once."""
        cap, share = (0, 1) if np.isinf(gamma) else gamma.as_integer_ratio()
        rows = zip(self._scaled, capped.tolist(), below.tolist(), strict=True)
        total = sum(entropy * (cap * unit * full + share * part) for entropy, full, part in rows if full or part)
        try:
            return float(total / (share * unit << _SCALE))
        except OverflowError:  # a gamma near the largest float64, times the voxels
            return float("inf")


@dataclass(frozen=True)
class Score:
    """``egvs`` in bits; ``entropy_seen``: share of the entropy in voxels crossed at least once."""

    egvs: float
    entropy_seen: float
