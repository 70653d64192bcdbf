r"""Estimates how far a score may be off because the traffic was short.

The TPOG keeps its counts block by block. Leave one group of blocks out, compute every site's score from the rest, and
do so for each group: the delete-a-group jackknife. With k groups of T_g frames, h_g = T / T_g, the score S of all
frames and S_(g) of all but group g (Busing, Meijer, van der Leeden, Statistics and Computing 9, 1999),

.. math:: \tilde S = k S - \sum_g (1 - T_g / T) S_{(g)}, \qquad P_g = h_g S - (h_g - 1) S_{(g)}, \qquad
          se^2 = \frac{1}{k} \sum_g \frac{(P_g - \tilde S)^2}{h_g - 1}, \qquad bias = S - \tilde S

and an interval is :math:`S - bias \pm t_{k-1} \, se`. The entropy is concave, so that few frames score too low: the
bias is below 0 and shrinks like 1 / T.

Why not the bootstrap, resampling blocks with replacement? Measured over independent runs of SUMO (docs/accuracy.md),
with 10 blocks its standard errors are too short, its intervals cover 81 % where 90 % was asked for, it takes hundreds
of scores a site instead of ten, and it needs random numbers. The jackknife's intervals cover 89 %.

Groups must be long beside the traffic's memory (a signal cycle): up to 19 blocks are taken as they are, more are joined
to ten groups - with fifty the same intervals cover 83 %, and a t quantile pays for what ten leave unsure. When
neighbouring groups are alike all the same, they are joined in pairs; when that leaves too few to tell, or they are
still alike, a note says so.

Voxels that have equal counts in every group share one class (0.5 million occupied voxels of a real junction make 50,000
classes), so a site costs one pass over the voxels and one over the classes. Nothing is random; the outcome does not
depend on threads or on other sites. Hits are taken as they are: where an effect lets traffic hide voxels, its part in
the error is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from scipy.special import stdtr, stdtrit

from pipeline.artefacts import tables
from pipeline.artefacts.readers import SEPARABLE, Tpog
from pipeline.core.errors import InputError
from pipeline.core.grid import Grid
from pipeline.kernels import march
from pipeline.kernels.crossings import accumulate
from pipeline.scoring.egvs import EntropyField

GROUPS = 10
"""Blocks are joined to so many groups when there are at least twice as many."""

FEWEST = 4
"""Groups are not joined to fewer than this."""

LEVEL = 0.9
"""Confidence of intervals."""

_ALIKE = 1.645
"""One-sided 5 % point of the normal distribution, for the test of neighbouring groups."""

_KEYS = 0x9E3779B97F4A7C15
"""Entropy of the keys that tell classes apart: a constant, so that equal files give equal bytes."""


@dataclass(frozen=True)
class LeaveOut:
    """The entropy of a TPOG, of all frames and with each group of blocks left out.

    Attributes
    ----------
    cells, classes
        Flat index of each voxel that is ever occupied, and its class, (n,) int64.
    entropies_bit
        Entropy of each class, (classes, 1 + k) float64: of all frames, then with group 0, 1, ... left out.
    frames
        Frames in each group, (k,) int64.
    """

    cells: NDArray[np.int64]
    classes: NDArray[np.int64]
    entropies_bit: NDArray[np.float64]
    frames: NDArray[np.int64]

    @classmethod
    def of(cls, path: Path, tpog: Tpog) -> LeaveOut | None:
        """From ``tpog.parquet``, which was read as ``tpog``; None when it has one block only, which tells nothing."""
        cells = np.flatnonzero(tpog.counts)
        counts, frames = _grouped(path, cells, tpog.grid)
        return cls.from_counts(counts, cells, frames, tpog.grid) if len(frames) > 1 else None

    @classmethod
    def from_counts(
        cls, counts: NDArray[np.uint32], cells: NDArray[np.int64], frames: NDArray[np.int64], grid: Grid
    ) -> LeaveOut:
        """From the counts of two or more groups, (k, n), in the voxels ``cells``, (n,), and the frames in each group,
        (k,)."""
        keys = np.random.default_rng(_KEYS).integers(1, 2**63, size=len(frames), dtype=np.uint64)
        # Two classes that share a sum of keys: a chance of (classes**2 / 2) / 2**64, 1e-10 for 50,000.
        sums = np.zeros(len(cells), dtype=np.uint64)
        for group, key in zip(counts, keys, strict=True):
            sums += group * key
        _, first, classes = np.unique(sums, return_index=True, return_inverse=True)
        entropies = _entropies(counts[:, first].astype(np.int64), frames, grid)
        return cls(cells, classes.astype(np.int64), entropies, frames)

    def scores(self, hits: NDArray[np.uint32] | NDArray[np.int64], gamma: float, unit: int = 1) -> NDArray[np.float64]:
        """One site's score of all frames, and with each group left out, (1 + k,) float64; ``hits`` as in
        :meth:`EntropyField.score`."""
        capped, below, seen = (np.zeros(len(self.entropies_bit), dtype=np.int64) for _ in range(3))
        march.tally(hits, self.cells, self.classes, gamma * unit, capped, below, seen)
        return self._sum((0.0 if math.isinf(gamma) else gamma) * capped + below / unit)

    def limits(self, gamma: float) -> NDArray[np.float64]:
        """The same sums with gamma in every voxel."""
        if math.isinf(gamma):
            return np.full(1 + len(self.frames), np.inf)
        return self._sum(gamma * np.bincount(self.classes, minlength=len(self.entropies_bit)).astype(np.float64))

    def _sum(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        # Not a matrix product: a BLAS may add in another order on another machine.
        total: NDArray[np.float64] = (weights[:, None] * self.entropies_bit).sum(axis=0)
        return total


def group_sizes(blocks: int) -> list[int]:
    """How many consecutive blocks each group has."""
    groups = blocks if blocks < 2 * GROUPS else GROUPS
    return [len(part) for part in np.array_split(np.arange(blocks), groups)]


def _grouped(path: Path, cells: NDArray[np.int64], grid: Grid) -> tuple[NDArray[np.uint32], NDArray[np.int64]]:
    """Counts of each group of blocks in the voxels ``cells``, (k, n), and the frames in each group, (k,)."""
    with tables.reader(path, "tpog") as (file, about):
        frames, block_frames = int(about["frames"]), int(about["block_frames"])
        if frames % block_frames:
            raise InputError(path, f"{frames} frames in blocks of {block_frames}", "whole blocks; make it again")
        sizes = group_sizes(frames // block_frames)
        group_of = np.repeat(np.arange(len(sizes)), sizes)
        counts = np.zeros((len(sizes), len(cells)), dtype=np.uint32)
        for number in range(file.num_row_groups):  # one block each: memory does not grow with their number
            table = tables.read_group(file, number, path)
            flat = np.ravel_multi_index([table.column(name).to_numpy() for name in ("ix", "iy", "iz")], grid.shape)
            where = group_of[_block(table, path, len(group_of))] * len(cells) + np.searchsorted(cells, flat)
            accumulate(where, table.column("count").to_numpy(), counts.reshape(-1))
    return counts, block_frames * np.array(sizes, dtype=np.int64)


def _block(table: pa.Table, path: Path, blocks: int) -> NDArray[np.uint16]:
    block: NDArray[np.uint16] = table.column("block").to_numpy()
    if block.max(initial=0) >= blocks:
        raise InputError(path, f"block {block.max()} of {blocks}", f"0 to {blocks - 1}")
    return block


def _entropies(counts: NDArray[np.int64], frames: NDArray[np.int64], grid: Grid) -> NDArray[np.float64]:
    """Entropy of each class, (classes, 1 + k), from its counts in each group, (k, classes)."""
    whole, total = counts.sum(axis=0), int(frames.sum())
    left_out = np.concatenate([whole[None], whole - counts])
    left = np.concatenate([[total], total - frames])
    entropies = np.zeros(left_out.shape)
    for size in np.unique(left):
        rows = np.flatnonzero(left == size)
        field = EntropyField.of(left_out[rows], int(size), grid)
        found = np.zeros(left_out[rows].size)
        found[field.cells] = field.per_cell_bit
        entropies[rows] = found.reshape(len(rows), -1)
    return np.ascontiguousarray(entropies.T)


@dataclass(frozen=True)
class Estimate:
    """What leaving groups out says of the scores of n sites.

    Attributes
    ----------
    scores
        Of all frames, (n,) float64.
    pseudo
        Pseudo-values, (k, n) float64: what each group by itself says of the score.
    spread
        h_g - 1 of each group, (k,) float64.
    bias
        What is expected to be wrong with ``scores`` because frames are few, (n,) float64.
    alike
        Lag-one autocorrelation of the groups, before any were joined.
    joined
        How many groups were joined to one, because neighbours were alike.
    still_alike
        Whether neighbours are alike all the same, so that the errors are too small.
    """

    scores: NDArray[np.float64]
    pseudo: NDArray[np.float64]
    spread: NDArray[np.float64]
    bias: NDArray[np.float64]
    alike: float
    joined: int
    still_alike: bool

    @classmethod
    def of(cls, left_out: NDArray[np.float64], frames: NDArray[np.int64]) -> Estimate:
        """From the scores with each group left out, (n, 1 + k), and the frames in each group, (k,)."""
        scores, without = left_out[:, 0], left_out[:, 1:].T
        h = frames.sum() / frames
        corrected = len(h) * scores - ((1.0 - 1.0 / h)[:, None] * without).sum(axis=0)
        pseudo = h[:, None] * scores - (h - 1.0)[:, None] * without
        alike = autocorrelation(pseudo)
        joined, low = 1, alike
        while low > _limit(len(pseudo)) and len(pseudo) // 2 >= FEWEST:
            pseudo, frames = _in_pairs(pseudo, frames)
            joined, low = 2 * joined, autocorrelation(pseudo)
        spread = frames.sum() / frames - 1.0
        return cls(scores, pseudo, spread, scores - corrected, alike, joined, low > _limit(len(pseudo)))

    @property
    def groups(self) -> int:
        """k, after joining."""
        return len(self.pseudo)

    @cached_property
    def se(self) -> NDArray[np.float64]:
        """Standard error of each score, (n,) float64."""
        return self._error(self.pseudo, self.scores - self.bias)

    def quantile(self, level: float = LEVEL) -> float:
        """How many standard errors an interval of this confidence reaches to each side."""
        return float(stdtrit(self.groups - 1, 0.5 + 0.5 * level))

    def intervals(self, level: float = LEVEL) -> NDArray[np.float64]:
        """Lower and upper end for the score that endless traffic would give, (n, 2) float64."""
        reach, middle = self.quantile(level) * self.se, self.scores - self.bias
        return np.column_stack([middle - reach, middle + reach])

    def differences(
        self, a: NDArray[np.int64], b: NDArray[np.int64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Scores of sites a (m,) less those of sites b (m,), and their standard errors, with what two have in common
        taken out."""
        centre = (self.scores - self.bias)[a] - (self.scores - self.bias)[b]
        return self.scores[a] - self.scores[b], self._error(self.pseudo[:, a] - self.pseudo[:, b], centre)

    def beats(self, a: NDArray[np.int64], b: NDArray[np.int64]) -> NDArray[np.float64]:
        """Chance (m,) that endless traffic would give sites a (m,) the higher score; one half when nothing tells two
        apart."""
        gap, error = self.differences(a, b)
        with np.errstate(divide="ignore", invalid="ignore"):
            chance = stdtr(self.groups - 1, gap / error)
        # A rounding to 1e-6: the last bits of a t distribution are the machine's own.
        rounded: NDArray[np.float64] = np.round(np.where(gap == 0.0, 0.5, chance), 6).astype(np.float64)
        return rounded

    def times_needed(self, a: int, b: int, level: float = SEPARABLE) -> float:
        """How many times the traffic at hand would tell sites a and b apart; infinite for equal scores."""
        gap, error = self.differences(np.array([a]), np.array([b]))
        with np.errstate(divide="ignore", invalid="ignore"):
            times = float((stdtrit(self.groups - 1, level) * error[0] / gap[0]) ** 2)
        return math.inf if math.isnan(times) else times

    def _error(self, pseudo: NDArray[np.float64], centre: NDArray[np.float64]) -> NDArray[np.float64]:
        error: NDArray[np.float64] = np.sqrt(((pseudo - centre) ** 2 / self.spread[:, None]).sum(axis=0) / len(pseudo))
        return error


def autocorrelation(series: NDArray[np.float64]) -> float:
    """Lag-one autocorrelation of groups, (k, n), all sites pooled; 0 where nothing varies."""
    centred = series - series.mean(axis=0)
    scale = np.sqrt((centred**2).sum(axis=0))
    centred = centred[:, scale > 0] / scale[scale > 0]
    return float((centred[1:] * centred[:-1]).sum(axis=0).mean()) if centred.size else 0.0


def _limit(groups: int) -> float:
    """Independent groups have an autocorrelation above this once in 20 (Kendall and Ord, Time Series, 1990: mean and
    variance)."""
    return -1.0 / groups + _ALIKE * math.sqrt((groups - 2) / (groups**2 - 1.0)) if groups > 2 else 1.0


def _in_pairs(pseudo: NDArray[np.float64], frames: NDArray[np.int64]) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Join neighbouring groups in pairs; of an odd number, the last three."""
    starts = np.arange(0, len(frames) - 1, 2)
    joined = np.add.reduceat(frames, starts)
    return np.add.reduceat(frames[:, None] * pseudo, starts, axis=0) / joined[:, None], joined


def order(scores: NDArray[np.float64]) -> NDArray[np.int64]:
    """Sites by score, best first; equal scores in the order of the sites."""
    return np.argsort(-scores, kind="stable")


def beats_next(estimate: Estimate) -> NDArray[np.float64]:
    """Chance that each site truly scores above the one next in rank, (n,); 1 for the last."""
    ranked, chance = order(estimate.scores), np.ones(len(estimate.scores))
    chance[ranked[:-1]] = estimate.beats(ranked[:-1], ranked[1:])
    return chance


def in_words(estimate: Estimate, frames: int) -> dict[str, object]:
    """For a stage's summary: how the errors came about, and a warning where they cannot be trusted."""
    said: dict[str, object] = {
        "standard_errors_from": f"{estimate.groups} groups of {frames // estimate.groups} frames"
    }
    if estimate.joined > 1:
        said["neighbouring_groups_joined"] = f"autocorrelation {estimate.alike:.2f}"
    if estimate.still_alike:
        said["warning"] = (
            "groups of frames are too short beside the traffic's memory: standard errors are too small; more frames"
        )
    return said
