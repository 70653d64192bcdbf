r"""Standard errors of scores: the block jackknife over groups of frames, and over detectors.

The TPOG keeps its counts block by block. Leave one group of blocks out, compute every site's score from the rest, and
do so for each group: the delete-a-group jackknife. With k groups of T_g frames, h_g = T / T_g, the score S of all
frames and S_(g) of all but group g (Busing, Meijer, van der Leeden, Statistics and Computing 9, 1999),

.. math:: \tilde S = k S - \sum_g (1 - T_g / T) S_{(g)}, \qquad P_g = h_g S - (h_g - 1) S_{(g)}, \qquad
          se^2 = \frac{1}{k} \sum_g \frac{(P_g - \tilde S)^2}{h_g - 1}, \qquad bias = S - \tilde S

and an interval is :math:`S - bias \pm t_{k-1} \, se`. The entropy is concave, so scores from few frames are biased low:
the bias is below 0 and shrinks like 1 / T. Of a TPOG that was mixed from several records, the variances and the biases
add up, and t has the degrees of freedom of Satterthwaite (Biometrics Bulletin 2, 1946).

Why not the bootstrap, resampling blocks with replacement? Measured over independent runs of SUMO (docs/accuracy.md),
with 10 blocks its standard errors are too small, its 90 % intervals cover 81 %, it takes hundreds of scores per site
instead of ten, and it needs random numbers. The jackknife's intervals cover 89 %.

Groups must be longer than the traffic's autocorrelation time (:mod:`egvs.statistics.blocks`). Up to 19
blocks are taken as they are, more are joined to ten groups - with fifty the same intervals cover 83 % - and neighbours
are joined further where groups would be shorter than :data:`egvs.statistics.blocks.GROUP_LENGTH_TIMES` of it, down to
:data:`egvs.statistics.blocks.MIN_GROUPS` groups: the t quantile accounts for the uncertainty of few groups. The
correlation that remains between the groups of a short record inflates the error
(:func:`egvs.statistics.blocks.standard_error_inflation`). Where neighbouring groups are correlated all the same,
they are joined in pairs. Groups shorter than the window in which that time was estimated, and groups that stay
correlated, give a warning.

Where the traffic was simulated with several seeds, each simulation is one group: groups are independent, whatever their
length, so none are joined and nothing is widened. For equal frames, the pseudo-values of a mean are the means of the
simulations, and the error is that of independent replications (Law, Simulation Modeling and Analysis, 2015, section
9.5.1), :math:`se^2 = \sum_r (S_r - \bar S)^2 / (R (R - 1))` with R - 1 degrees of freedom. It contains all that varies
between simulations, which blocks of a single one miss (docs/accuracy.md).

A score that is the mean over the models of D detectors (``expected_detections``) is a score for "a detector". How far
the detectors disagree is part of its error: with :math:`S_d` the score by detector d alone,

.. math:: se^2 = se_{traffic}^2 + \frac{1}{D (D - 1)} \sum_d (S_d - S)^2

This is a jackknife as well, with one detector left out at a time: its pseudo-values are the :math:`S_d`. Of the
difference of two sites, :math:`S_d` is the difference by detector d. A detector that finds 10 points less at every site
changes all scores, and no comparison: such common shifts cancel, and only detectors that disagree about the difference
widen its error. The degrees of freedom of each score and of each difference are Satterthwaite's, from those of the
traffic and D - 1. With two detectors, that is one: where their disagreement is most of the error, probabilities are
those of a t distribution with one degree of freedom, and cautious. What changes with the detector and the frames at the
same time is in both terms, so the sum is slightly too large. The detectors stand for others of their kind. Two are too
few to say how far a third one may be off.

A score from measured curves (``noticed``) has the errors of their values as well: with :math:`S_k` the score when the
k-th independent value is larger by its standard error,

.. math:: se^2 = se_{traffic}^2 + \sum_k (S_k - S)^2

and for the difference of two sites the same with the differences. All values come from the same sweeps, so this part
has the degrees of freedom :data:`CURVE_FREEDOM` in Satterthwaite's formula.

Voxels that have equal counts in every group share one class (0.5 million occupied voxels of a real junction make 50,000
classes), so a site costs one pass over the voxels and one over the classes. Nothing is random; the result does not
depend on threads or on other sites. Hits are not resampled: where an effect lets traffic hide voxels, its part of the
error is not included.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.artefacts import tpog as tpog_file
from egvs.core.errors import Diagnostic
from egvs.core.grid import FloatArray, Grid, IntArray
from egvs.core.special import stdtr, stdtrit
from egvs.kernels.occupancy import accumulate
from egvs.scoring.egvs import EntropyField, Hits, sum_hits_by_class
from egvs.statistics.blocks import (
    GROUP_LENGTH_TIMES,
    MIN_GROUPS,
    WINDOW_TIMES,
    critical_autocorrelation,
    group_sizes,
    lag_one_autocorrelation,
    standard_error_inflation,
)
from egvs.statistics.ranks import rank_order

CONFIDENCE_LEVEL = 0.9
"""Confidence of intervals."""

CURVE_FREEDOM = 10.0
"""Degrees of freedom of the errors of curves: 2,110 pairs of sweeps at 10 Hz are 11 blocks of 20 s, less one."""

_CLASS_KEY_SEED = 0x9E3779B97F4A7C15
"""Seed of the keys that distinguish classes: a constant, so that equal files give equal bytes."""


@dataclass(frozen=True)
class BlockGroups:
    """Consecutive groups of one record; or the detectors of a score, or the values of its curves, each of them a group.

    Attributes
    ----------
    frames
        Frames of each group, (k,) int64; 1 for each detector and each value of a curve.
    autocorrelation_frames
        Autocorrelation time of the traffic.
    are_seeds
        Whether each group is a simulation with a seed of its own, so that groups are independent.
    are_detectors
        Whether each group is a detector.
    are_curve_values
        Whether each group is a value of a measured curve: its replicate is not the score without the value, but with
        the value larger by its standard error.
    """

    frames: IntArray
    autocorrelation_frames: float
    are_seeds: bool = False
    are_detectors: bool = False
    are_curve_values: bool = False

    @property
    def are_traffic(self) -> bool:
        """Whether the groups are frames of a record."""
        return not self.are_detectors and not self.are_curve_values

    @property
    def total(self) -> int:
        """Frames of the record."""
        return int(self.frames.sum())


def block_groups(period: tpog_file.PeriodBlocks) -> BlockGroups:
    """Return the groups that the blocks of one record are joined to: one of each seed, if there are several."""
    if period.seeds > 1:
        frames = np.full(period.seeds, period.frames // period.seeds, dtype=np.int64)
        return BlockGroups(frames, period.memory_frames, are_seeds=True)
    sizes = group_sizes(period.blocks, period.block_frames, period.memory_frames)
    return BlockGroups(period.block_frames * np.array(sizes, dtype=np.int64), period.memory_frames)


def detector_groups(detectors: int) -> tuple[BlockGroups, ...]:
    """Return the detectors of a score as groups that are left out in turn; nothing for a single detector."""
    if detectors < 2:
        return ()
    return (BlockGroups(np.ones(detectors, dtype=np.int64), 0.0, are_detectors=True),)


def curve_groups(values: int) -> tuple[BlockGroups, ...]:
    """Return the values of the curves of a score as groups whose errors shift it in turn."""
    return (BlockGroups(np.ones(values, dtype=np.int64), 0.0, are_curve_values=True),)


@dataclass(frozen=True)
class BlockJackknife:
    """The entropy of a TPOG, of all frames and with each group of blocks left out.

    Attributes
    ----------
    cells, classes
        Flat index of each voxel that is ever occupied, and its class, (n,) int64.
    entropies_bit
        Entropy of each class, (classes, 1 + k) float64: of all frames, then with group 0, 1, ... left out.
    p
        Share of the frames in which voxels of each class are occupied, in the same form.
    groups
        Groups of each record of the TPOG, in the order of the columns.
    """

    cells: IntArray
    classes: IntArray
    entropies_bit: FloatArray
    p: FloatArray
    groups: tuple[BlockGroups, ...]

    @classmethod
    def of(
        cls,
        path: Path,
        tpog: tpog_file.Tpog,
        period: str | None = None,
        groups: tuple[BlockGroups, ...] | None = None,
    ) -> BlockJackknife | None:
        """Count the groups of ``tpog.parquet``, which was read as ``tpog``: the mix, or one period.

        None if a record has one block only, because its scatter is unknown.

        Parameters
        ----------
        path, tpog
            The file, and its contents.
        period
            Name of the period; the mix when None.
        groups
            Groups of complete blocks, for each record; those of :func:`block_groups` when None.
        """
        periods = [record for record in tpog_file.read_periods(path) if period in (None, record.name)]
        if groups is None:
            groups = tuple(block_groups(record) for record in periods)
        if any(len(record_groups.frames) < 2 for record_groups in groups):
            return None
        cells = np.flatnonzero(tpog.counts)
        counts = _count_by_group(path, cells, tpog.grid, groups, period)
        if len(groups) == 1:
            return cls.from_counts(counts, cells, groups[0], tpog.grid)
        return cls.from_mix(counts, cells, groups, [record.times for record in periods], tpog.grid)

    @classmethod
    def from_counts(
        cls, counts: NDArray[np.uint32], cells: IntArray, groups: BlockGroups, grid: Grid
    ) -> BlockJackknife:
        """Return the jackknife of one record from the counts of its groups, (k, n), in the voxels ``cells``, (n,)."""
        first, classes = _classify_voxels(counts)
        by_group = counts[:, first].astype(np.int64)
        total = by_group.sum(axis=0)
        remaining = np.vstack([total, total - by_group])
        frames = np.append(groups.total, groups.total - groups.frames)
        p = remaining / frames[:, None]

        entropies = np.zeros(remaining.shape)
        for size in np.unique(frames):
            rows = np.flatnonzero(frames == size)
            entropies[rows] = _exact_entropies(remaining[rows], int(size), grid)
        return cls(cells, classes, np.ascontiguousarray(entropies.T), np.ascontiguousarray(p.T), (groups,))

    @classmethod
    def from_mix(
        cls,
        counts: NDArray[np.uint32],
        cells: IntArray,
        groups: tuple[BlockGroups, ...],
        times: Sequence[int],
        grid: Grid,
    ) -> BlockJackknife:
        """Return the jackknife of a mix of records, each of whose frames counts ``times`` in the mix.

        The rest of a record without a group keeps the record's weight. These entropies are computed in float64, because
        the number of frames that would represent them exactly is unbounded; that of all frames is exact.
        """
        first, classes = _classify_voxels(counts)
        ends = np.cumsum([len(record.frames) for record in groups])
        by_record = np.split(counts[:, first].astype(np.int64), ends[:-1])
        record_counts = np.array([by_group.sum(axis=0) for by_group in by_record])
        total = sum(number * record.total for number, record in zip(times, groups, strict=True))
        weights = [number * record.total / total for number, record in zip(times, groups, strict=True)]
        record_p = [
            weight * sums / record.total for weight, sums, record in zip(weights, record_counts, groups, strict=True)
        ]

        mixed = np.array(times, dtype=np.int64) @ record_counts
        p = [mixed / total]
        entropies = [_exact_entropies(mixed, total, grid)]
        for i, (by_group, record) in enumerate(zip(by_record, groups, strict=True)):
            other_records = sum((record_p[j] for j in range(len(record_p)) if j != i), np.zeros(len(first)))
            for group, frames in zip(by_group, record.frames.tolist(), strict=True):
                remaining = weights[i] * (record_counts[i] - group) / (record.total - frames)
                p.append(other_records + remaining)
                entropies.append(_binary_entropies(other_records + remaining))
        columns = np.ascontiguousarray(np.array(entropies).T)
        return cls(cells, classes, columns, np.ascontiguousarray(np.array(p).T), groups)

    def scores(self, hits: Hits, gamma: float, unit: int = 1) -> FloatArray:
        """Return one site's EGVS of all frames, and with each group left out, (1 + k,) float64.

        Parameters are those of :meth:`egvs.scoring.egvs.EntropyField.score`.
        """
        sums = sum_hits_by_class(hits, self.cells, self.classes, len(self.entropies_bit), gamma * unit)
        if math.isinf(gamma):  # then no voxel is capped
            gamma = 0.0
        return self._sum(gamma * sums.capped + sums.below / unit)

    def voxel_shares(self, hits: Hits, name: str) -> FloatArray:
        """Return one of :data:`egvs.scoring.scorer.VOXEL_SHARES`, in the order of :meth:`scores`.

        0 where no voxel has any weight.
        """
        weights = self.p
        if name == "entropy_seen":
            weights = self.entropies_bit
        elif name == "coverage":
            weights = (self.p > 0.0).astype(np.float64)
        sums = sum_hits_by_class(hits, self.cells, self.classes, len(self.entropies_bit), 1.0)
        total = (self._class_sizes[:, None] * weights).sum(axis=0)
        crossed = (sums.crossed.astype(np.float64)[:, None] * weights).sum(axis=0)
        shares = np.zeros(len(total))
        np.divide(crossed, total, out=shares, where=total > 0)
        return shares

    def limits(self, gamma: float) -> FloatArray:
        """Return the EGVS with gamma beams in every voxel, in the order of :meth:`scores`."""
        if math.isinf(gamma):
            return np.full(self.entropies_bit.shape[1], np.inf)
        return self._sum(gamma * self._class_sizes)

    @property
    def _class_sizes(self) -> FloatArray:
        return np.bincount(self.classes, minlength=len(self.entropies_bit)).astype(np.float64)

    def _sum(self, weights: FloatArray) -> FloatArray:
        # Not a matrix product: a BLAS may add in another order on another machine.
        total: FloatArray = (weights[:, None] * self.entropies_bit).sum(axis=0)
        return total


def _count_by_group(
    path: Path, cells: IntArray, grid: Grid, groups: Sequence[BlockGroups], only_period: str | None
) -> NDArray[np.uint32]:
    """Return the counts of each group of blocks in the voxels ``cells``, (k, n)."""
    group_of_block = []
    n_groups = 0
    next_groups = iter(groups)
    for period in tpog_file.read_periods(path):
        if only_period not in (None, period.name):
            group_of_block.append(np.full(period.blocks, -1))
            continue
        sizes = next(next_groups).frames // period.block_frames
        group_of_block.append(n_groups + np.repeat(np.arange(len(sizes)), sizes))
        n_groups += len(sizes)
    group_by_block = np.concatenate(group_of_block)

    counts = np.zeros((n_groups, len(cells)), dtype=np.uint32)
    with parquet.open_artefact(path, "tpog") as (file, _):
        for row_group in range(file.num_row_groups):  # one block each: memory does not grow with their number
            table = parquet.read_row_group(file, row_group, path)
            group = group_by_block[tpog_file.block_numbers(table, path, len(group_by_block))]
            indices = [table.column(name).to_numpy() for name in ("ix", "iy", "iz")]
            flat = np.ravel_multi_index(indices, grid.shape)
            used = group >= 0
            target = group[used] * len(cells) + np.searchsorted(cells, flat[used])
            accumulate(target, table.column("count").to_numpy()[used], counts.reshape(-1))
    return counts


def _classify_voxels(counts: NDArray[np.uint32]) -> tuple[IntArray, IntArray]:
    """Return one voxel of each class of equal counts, and the class of each voxel, (n,)."""
    keys = np.random.default_rng(_CLASS_KEY_SEED).integers(1, 2**63, size=len(counts), dtype=np.uint64)
    # The chance that two classes share a sum of keys is (classes**2 / 2) / 2**64: 1e-10 for 50,000.
    sums = np.zeros(counts.shape[1], dtype=np.uint64)
    for group, key in zip(counts, keys, strict=True):
        sums += group * key
    _, first, classes = np.unique(sums, return_index=True, return_inverse=True)
    return first.astype(np.int64), classes.astype(np.int64)


def _binary_entropies(p: FloatArray) -> FloatArray:
    """Return H(p) in bits, float64."""
    inside = (p > 0.0) & (p < 1.0)
    q = np.where(inside, p, 0.5)
    return np.where(inside, -(q * np.log(q) + (1.0 - q) * np.log1p(-q)) / math.log(2.0), 0.0)


def _exact_entropies(counts: IntArray, frames: int, grid: Grid) -> FloatArray:
    """Return the entropies of counts of ``frames`` frames, in the shape of the counts."""
    field = EntropyField.of(counts, frames, grid)
    entropies = np.zeros(counts.size)
    entropies[field.cells] = field.per_cell_bit
    return entropies.reshape(counts.shape)


@dataclass(frozen=True)
class Stratum:
    """The jackknife of the scores of n sites over the k groups of one record, or over k detectors or curve values.

    Attributes
    ----------
    pseudo
        Pseudo-values, (k, n) float64: estimates of the score from each group. Of curve values, the shifted scores.
    spread
        h_g - 1 of each group, (k,) float64; 1 / k of curve values, whose variances add up.
    centre
        The score without its bias of this record, (n,) float64.
    widening
        Factor for the standard error that the scatter of the groups gives.
    groups
        Groups of the record before any were joined.
    correlation
        Lag-one autocorrelation of these groups.
    joined
        How many of them were joined into one because neighbours were correlated.
    still_correlated
        Whether neighbours are correlated even so, which makes the errors too small.
    """

    pseudo: FloatArray
    spread: FloatArray
    centre: FloatArray
    widening: float
    groups: BlockGroups
    correlation: float
    joined: int
    still_correlated: bool

    @classmethod
    def of(
        cls, scores: FloatArray, left_out: FloatArray, groups: BlockGroups, n_joined_by: int | None = None
    ) -> Stratum:
        """Compare the scores of all frames, (n,), with those without each group, (k, n).

        Groups are joined where the first ``n_joined_by`` scores are correlated; all scores when None.
        """
        frames = groups.frames
        if groups.are_curve_values:
            spread = np.full(len(frames), 1.0 / len(frames))
            return cls(left_out, spread, scores, 1.0, groups, 0.0, 1, still_correlated=False)
        h = groups.total / frames
        centre = len(h) * scores - ((1.0 - 1.0 / h)[:, None] * left_out).sum(axis=0)
        pseudo = h[:, None] * scores - (h - 1.0)[:, None] * left_out

        first_correlation = correlation = lag_one_autocorrelation(pseudo[:, :n_joined_by])
        joined = 1
        if groups.are_seeds or groups.are_detectors:
            return cls(pseudo, h - 1.0, centre, 1.0, groups, first_correlation, joined, still_correlated=False)
        while correlation > critical_autocorrelation(len(pseudo)) and len(pseudo) // 2 >= MIN_GROUPS:
            pseudo, frames = _join_pairs(pseudo, frames)
            joined *= 2
            correlation = lag_one_autocorrelation(pseudo[:, :n_joined_by])

        widening = 1.0
        if groups.autocorrelation_frames:
            widening = standard_error_inflation(groups.autocorrelation_frames, groups.total, len(frames))
        still_correlated = correlation > critical_autocorrelation(len(pseudo))
        spread = groups.total / frames - 1.0
        return cls(pseudo, spread, centre, widening, groups, first_correlation, joined, still_correlated)

    def variance(self, a: IntArray, b: IntArray | None = None) -> FloatArray:
        """Return the squared standard error of the scores of sites a (m,), or of their lead over sites b (m,)."""
        pseudo, centre = self.pseudo[:, a], self.centre[a]
        if b is not None:
            pseudo = pseudo - self.pseudo[:, b]
            centre = centre - self.centre[b]
        variance: FloatArray = ((pseudo - centre) ** 2 / self.spread[:, None]).sum(axis=0) / len(pseudo)
        return self.widening**2 * variance

    @property
    def is_short(self) -> bool:
        """Whether blocks are shorter than the window in which the autocorrelation time was estimated."""
        if self.groups.are_seeds or not self.groups.are_traffic:
            return False
        return self.groups.total < len(self.pseudo) * WINDOW_TIMES * self.groups.autocorrelation_frames


def _join_pairs(pseudo: FloatArray, frames: IntArray) -> tuple[FloatArray, IntArray]:
    """Join neighbouring groups in pairs; of an odd number, the last three."""
    starts = np.arange(0, len(frames) - 1, 2)
    joined = np.add.reduceat(frames, starts)
    return np.add.reduceat(frames[:, None] * pseudo, starts, axis=0) / joined[:, None], joined


class ScoreDifferences(NamedTuple):
    """Differences of scores, and their standard errors, (m,) float64 each."""

    values: FloatArray
    se: FloatArray


@dataclass(frozen=True)
class ScoreUncertainty:
    """Standard errors, intervals and comparisons of the scores of n sites.

    Attributes
    ----------
    scores
        Scores of all frames, (n,) float64.
    strata
        The jackknife over each record of the TPOG, one unless it is a mix; then that over the detectors, if there are
        several, and the errors of the curves of a score that has some.
    """

    scores: FloatArray
    strata: tuple[Stratum, ...]

    @classmethod
    def of(
        cls, left_out: FloatArray, groups: Sequence[BlockGroups], n_joined_by: int | None = None
    ) -> ScoreUncertainty:
        """Compare the scores of all frames and with each group left out, (n, 1 + k), for k groups in all.

        Neighbouring groups are joined where the first ``n_joined_by`` scores are correlated; all scores when None.
        """
        scores = left_out[:, 0]
        ends = np.cumsum([len(record.frames) for record in groups])
        by_record = np.split(left_out[:, 1:].T, ends[:-1])
        strata = []
        for columns, record in zip(by_record, groups, strict=True):
            strata.append(Stratum.of(scores, columns, record, n_joined_by))
        return cls(scores, tuple(strata))

    @cached_property
    def bias(self) -> FloatArray:
        """Expected error of ``scores`` due to the limited number of frames, (n,) float64."""
        return sum((self.scores - stratum.centre for stratum in self.strata), np.zeros(len(self.scores)))

    @property
    def traffic_strata(self) -> tuple[Stratum, ...]:
        """The jackknife over each record of the TPOG."""
        return tuple(stratum for stratum in self.strata if stratum.groups.are_traffic)

    @property
    def detector_strata(self) -> tuple[Stratum, ...]:
        """The jackknife over detectors; empty for a score of one detector, or of none."""
        return tuple(stratum for stratum in self.strata if stratum.groups.are_detectors)

    @property
    def groups(self) -> int:
        """Number of groups of frames after joining."""
        return sum(len(stratum.pseudo) for stratum in self.traffic_strata)

    @cached_property
    def freedom(self) -> float:
        """Degrees of freedom of the traffic's error: k - 1; of a mix, Satterthwaite's for all sites together."""
        free = [len(stratum.pseudo) - 1.0 for stratum in self.traffic_strata]
        variances = np.array([stratum.variance(self._all_sites) for stratum in self.traffic_strata])
        total = variances.sum(axis=0)
        shares = (variances[:, total > 0] / total[total > 0]).sum(axis=1)
        if len(free) == 1 or not shares.any():
            return math.fsum(free)
        return float(shares.sum() ** 2 / (shares**2 / np.array(free)).sum())

    @property
    def _all_sites(self) -> IntArray:
        return np.arange(len(self.scores))

    @cached_property
    def se(self) -> FloatArray:
        """Standard error of each score, (n,) float64."""
        return self._error(self._all_sites)

    def quantiles(self, level: float = CONFIDENCE_LEVEL) -> FloatArray:
        """Return the critical values of Student's t for two-sided intervals of this confidence level, (n,) float64."""
        critical: FloatArray = stdtrit(self._freedoms(self._all_sites), 0.5 + 0.5 * level)
        return critical

    def intervals(self, level: float = CONFIDENCE_LEVEL) -> FloatArray:
        """Return the bounds of intervals of the scores in the limit of infinitely long traffic, (n, 2) float64."""
        half_width = self.quantiles(level) * self.se
        centre = self.scores - self.bias
        return np.column_stack([centre - half_width, centre + half_width])

    def differences(self, a: IntArray, b: IntArray) -> ScoreDifferences:
        """Return the scores of sites a (m,) minus those of sites b (m,); their common scatter cancels in the errors."""
        return ScoreDifferences(self.scores[a] - self.scores[b], self._error(a, b))

    def detector_error(self, a: IntArray, b: IntArray) -> FloatArray:
        """Return the part of the errors of :meth:`differences` that is due to detectors, (m,) float64."""
        return np.sqrt(_sum_of_variances(self.detector_strata, a, b))

    def beats(self, a: IntArray, b: IntArray) -> FloatArray:
        """Return the probability (m,) that sites a (m,) score higher in infinitely long traffic.

        For a score over several detectors: with a detector of their kind. One half where the scores are equal.
        """
        gap, error = self.differences(a, b)
        with np.errstate(divide="ignore", invalid="ignore"):
            chance = stdtr(self._freedoms(a, b), gap / error)
        # Rounded to 1e-6, because the last bits of a t distribution depend on the machine.
        return np.round(np.where(gap == 0.0, 0.5, chance), 6).astype(np.float64)

    def _error(self, a: IntArray, b: IntArray | None = None) -> FloatArray:
        return np.sqrt(_sum_of_variances(self.strata, a, b))

    def _freedoms(self, a: IntArray, b: IntArray | None = None) -> FloatArray:
        """Degrees of freedom of the scores of sites a (m,), or of their lead over sites b (m,): Satterthwaite's."""
        freedoms = np.full(len(a), self.freedom)
        curves = tuple(stratum for stratum in self.strata if stratum.groups.are_curve_values)
        if not self.detector_strata and not curves:
            return freedoms
        traffic = _sum_of_variances(self.traffic_strata, a, b)
        denominator = traffic**2 / self.freedom
        total = traffic.copy()
        for stratum in self.detector_strata:
            variance = stratum.variance(a, b)
            denominator += variance**2 / (len(stratum.pseudo) - 1.0)
            total += variance
        of_curves = _sum_of_variances(curves, a, b)
        denominator += of_curves**2 / CURVE_FREEDOM
        total += of_curves
        np.divide(total**2, denominator, out=freedoms, where=denominator > 0.0)
        return freedoms


def _sum_of_variances(strata: Sequence[Stratum], a: IntArray, b: IntArray | None) -> FloatArray:
    return sum((stratum.variance(a, b) for stratum in strata), np.zeros(len(a)))


def beats_next(estimate: ScoreUncertainty) -> FloatArray:
    """Return the probability that each site truly scores above the next in rank, (n,); 1 for the last."""
    ranked = rank_order(estimate.scores)
    chance = np.ones(len(estimate.scores))
    chance[ranked[:-1]] = estimate.beats(ranked[:-1], ranked[1:])
    return chance


class LagBehindBest(NamedTuple):
    """How each site compares with the best one, the first of :func:`rank_order`, (n,) float64 each.

    Attributes
    ----------
    se
        Standard error of the difference to the best site; 0 for that site.
    best_beats
        Probability that the best site truly scores higher; one half where scores are equal.
    detectors_se
        The part of ``se`` that is due to differences between detectors, which more traffic does not reduce.
    """

    se: FloatArray
    best_beats: FloatArray
    detectors_se: FloatArray


def lag_behind_best(estimate: ScoreUncertainty) -> LagBehindBest:
    """Compare each site with the best one; the scatter that the two have in common cancels."""
    sites = np.arange(len(estimate.scores))
    best = np.repeat(rank_order(estimate.scores)[:1], len(sites))
    differences = estimate.differences(best, sites)
    return LagBehindBest(differences.se, estimate.beats(best, sites), estimate.detector_error(best, sites))


def summarise_uncertainty(estimate: ScoreUncertainty, names: Sequence[str] = ("",)) -> dict[str, object]:
    """Return a stage's summary of how errors were computed; ``names`` of the periods, one per record."""
    descriptions = []
    for name, stratum in zip(names, estimate.traffic_strata, strict=True):
        description = _describe_stratum(stratum)
        if name:
            description = f"{name}: {description}"
        descriptions.append(description)
    text = "; ".join(descriptions)
    for stratum in estimate.detector_strata:
        text += f", and the differences between {len(stratum.pseudo)} detectors"
    if any(stratum.groups.are_curve_values for stratum in estimate.strata):
        text += ", and the errors of measured curves"
    return {"standard_errors_from": text}


def _describe_stratum(stratum: Stratum) -> str:
    blocks = len(stratum.pseudo)
    if stratum.groups.are_seeds:
        return f"{blocks} simulations of {stratum.groups.total // blocks:,} frames, each with its own seed"
    text = f"{blocks} blocks of {stratum.groups.total // blocks:,} frames"
    if stratum.joined > 1:
        text += f", joined because neighbours were correlated ({stratum.correlation:.2f})"
    return text + _describe_widening(stratum)


def _describe_widening(stratum: Stratum) -> str:
    if stratum.widening < 1.005:
        return ""
    return f" (+{100 * (stratum.widening - 1.0):.0f} % for autocorrelation)"


def uncertainty_warnings(
    estimate: ScoreUncertainty,
    where: str,
    frame_period_s: float,
    names: Sequence[str] = ("",),
    period_lengths: Mapping[str, str] | None = None,
) -> list[Diagnostic]:
    """Warn about each record that is too short, compared with its autocorrelation time, for reliable standard errors.

    Parameters
    ----------
    estimate
        Standard errors of all sites.
    where
        The key that sets the number of frames.
    frame_period_s
        Time between frames.
    names
        Names of the periods, one per record.
    period_lengths
        Period -> the key that sets its length in seconds, for those that have one.
    """
    warnings = []
    for stratum, name in zip(estimate.traffic_strata, names, strict=True):
        if not (stratum.is_short or stratum.still_correlated):
            continue
        length_key = (period_lengths or {}).get(name)
        if length_key is not None:
            key = length_key
        elif name:
            key = f"{where} ({name})"
        else:
            key = where
        hint = _longer_record_hint(stratum, frame_period_s, in_seconds=length_key is not None)
        warnings.append(
            Diagnostic("traffic autocorrelation", key, _describe_unreliable_error(stratum, frame_period_s), hint)
        )
    return warnings


def _describe_unreliable_error(stratum: Stratum, frame_period_s: float) -> str:
    frames = stratum.groups.total
    if not stratum.is_short:
        blocks = len(stratum.pseudo)
        return f"neighbouring blocks of {frames // blocks} frames are correlated: standard errors may be too small"
    correlation_time_s = stratum.groups.autocorrelation_frames * frame_period_s
    widening = _describe_widening(stratum)
    return (
        f"{frames} frames ({frames * frame_period_s:g} s) are few for traffic with an autocorrelation time of"
        f" {correlation_time_s:.3g} s: standard errors{widening} may be too small"
    )


def _longer_record_hint(stratum: Stratum, frame_period_s: float, *, in_seconds: bool) -> str:
    enough = math.ceil(MIN_GROUPS * WINDOW_TIMES * stratum.groups.autocorrelation_frames)
    if stratum.still_correlated:
        enough = max(2 * stratum.groups.total, enough)
    better = round(GROUP_LENGTH_TIMES / WINDOW_TIMES) * enough
    if in_seconds:
        return f"Set length_s to at least {enough * frame_period_s:g}, preferably {better * frame_period_s:g}."
    return f"Record at least {enough:,} frames, preferably {better:,}."
