"""The score of a site with each group of blocks of traffic left out in turn, for :mod:`pipeline.scoring.uncertainty`.

Blocks are joined to groups that are long beside the traffic's memory (:mod:`pipeline.scoring.memory`): up to 19 blocks
are taken as they are, more are joined to ten groups - with fifty the same intervals cover 83 % - and neighbours are
joined further where groups would be shorter than :data:`LONG` memories, down to :data:`FEWEST` groups: a t quantile
pays for what few groups leave unsure.

Voxels that have equal counts in every group share one class (0.5 million occupied voxels of a real junction make 50,000
classes), so a site costs one pass over the voxels and one over the classes. Nothing is random; the outcome does not
depend on threads or on other sites. Hits are taken as they are: where an effect lets traffic hide voxels, its part in
the error is left out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import tables
from pipeline.artefacts.periods import PeriodBlocks
from pipeline.artefacts.readers import Tpog, block_numbers, read_periods
from pipeline.core.grid import Grid
from pipeline.kernels import march
from pipeline.kernels.crossings import accumulate
from pipeline.scoring.egvs import EntropyField

GROUPS = 10
"""Blocks are joined to so many groups when there are at least twice as many."""

FEWEST = 4
"""Groups are not joined to fewer than this."""

LONG = 20.0
"""A group is to last so many memories of the traffic."""

_KEYS = 0x9E3779B97F4A7C15
"""Entropy of the keys that tell classes apart: a constant, so that equal files give equal bytes."""


@dataclass(frozen=True)
class Groups:
    """Consecutive groups of one record: the ``frames`` in each, (k,) int64, and the traffic's ``memory`` in frames."""

    frames: NDArray[np.int64]
    memory: float

    @property
    def total(self) -> int:
        """Frames of the record."""
        return int(self.frames.sum())


@dataclass(frozen=True)
class LeaveOut:
    """The entropy of a TPOG, of all frames and with each group of blocks left out.

    Attributes
    ----------
    cells, classes
        Flat index of each voxel that is ever occupied, and its class, (n,) int64.
    entropies_bit
        Entropy of each class, (classes, 1 + k) float64: of all frames, then with group 0, 1, ... left out.
    p
        Share of the frames in which voxels of each class are occupied, likewise.
    groups
        Of each record that the TPOG was counted in, in the order of the columns.
    """

    cells: NDArray[np.int64]
    classes: NDArray[np.int64]
    entropies_bit: NDArray[np.float64]
    p: NDArray[np.float64]
    groups: tuple[Groups, ...]

    @classmethod
    def of(cls, path: Path, tpog: Tpog, period: str | None = None) -> LeaveOut | None:
        """From ``tpog.parquet``, which was read as ``tpog``: the mix, or one period; None when a record has one block
        only, which tells nothing."""
        periods = [its for its in read_periods(path) if period in (None, its.name)]
        cells = np.flatnonzero(tpog.counts)
        groups = tuple(groups_of(its) for its in periods)
        if any(len(its.frames) < 2 for its in groups):
            return None
        counts = _grouped(path, cells, tpog.grid, groups, period)
        if len(groups) == 1:
            return cls.from_counts(counts, cells, groups[0], tpog.grid)
        return cls.from_mix(counts, cells, groups, [its.times for its in periods], tpog.grid)

    @classmethod
    def from_counts(cls, counts: NDArray[np.uint32], cells: NDArray[np.int64], groups: Groups, grid: Grid) -> LeaveOut:
        """From the counts of two or more groups, (k, n), in the voxels ``cells``, (n,)."""
        first, classes = _classes(counts)
        by_group = counts[:, first].astype(np.int64)
        without = np.vstack([by_group.sum(axis=0), by_group.sum(axis=0) - by_group])
        p = without / np.append(groups.total, groups.total - groups.frames)[:, None]
        entropies = _entropies(by_group, groups.frames, grid)
        return cls(cells, classes, entropies, np.ascontiguousarray(p.T), (groups,))

    @classmethod
    def from_mix(
        cls,
        counts: NDArray[np.uint32],
        cells: NDArray[np.int64],
        groups: tuple[Groups, ...],
        times: Sequence[int],
        grid: Grid,
    ) -> LeaveOut:
        """From the counts of the groups of several records, (k, n), whose frames count ``times`` in the mix.

        What is left of a record when a group is left out keeps the record's weight. These entropies are taken in
        float64, since the frames that would hold them exactly have no end; that of all frames is exact.
        """
        first, classes = _classes(counts)
        parts = np.split(counts[:, first].astype(np.int64), np.cumsum([len(its.frames) for its in groups])[:-1])
        whole = np.array([part.sum(axis=0) for part in parts])
        total = sum(number * its.total for number, its in zip(times, groups, strict=True))
        shares = [number * its.total / total for number, its in zip(times, groups, strict=True)]
        p = [share * sums / its.total for share, sums, its in zip(shares, whole, groups, strict=True)]
        mixed = np.array(times, dtype=np.int64) @ whole
        shares_left, columns = [mixed / total], [_exact(mixed, total, grid)]
        for number, (part, its) in enumerate(zip(parts, groups, strict=True)):
            others = sum((p[other] for other in range(len(p)) if other != number), np.zeros(len(first)))
            for group, frames in zip(part, its.frames.tolist(), strict=True):
                left = shares[number] * (whole[number] - group) / (its.total - frames)
                shares_left.append(others + left)
                columns.append(_binary_entropies(others + left))
        entropies, left_out = (np.ascontiguousarray(np.array(its).T) for its in (columns, shares_left))
        return cls(cells, classes, entropies, left_out, groups)

    def scores(self, hits: NDArray[np.uint32] | NDArray[np.int64], gamma: float, unit: int = 1) -> NDArray[np.float64]:
        """One site's score of all frames, and with each group left out, (1 + k,) float64; ``hits`` as in
        :meth:`EntropyField.score`."""
        capped, below, seen = (np.zeros(len(self.entropies_bit), dtype=np.int64) for _ in range(3))
        march.tally(hits, self.cells, self.classes, gamma * unit, capped, below, seen)
        return self._sum((0.0 if math.isinf(gamma) else gamma) * capped + below / unit)

    def shares_seen(self, hits: NDArray[np.uint32] | NDArray[np.int64], name: str) -> NDArray[np.float64]:
        """One of :data:`pipeline.scoring.voxel_shares.NAMES` of one site's ``hits``, of all frames, and with each group
        left out, (1 + k,) float64; 0 of nothing."""
        each = self.entropies_bit if name == "entropy_seen" else self.p
        if name == "coverage":
            each = (self.p > 0.0).astype(np.float64)
        capped, below, seen = (np.zeros(len(self.entropies_bit), dtype=np.int64) for _ in range(3))
        march.tally(hits, self.cells, self.classes, 1.0, capped, below, seen)
        of_all = np.bincount(self.classes, minlength=len(each)).astype(np.float64)
        total, crossed = ((count[:, None] * each).sum(axis=0) for count in (of_all, seen.astype(np.float64)))
        shares = np.zeros(len(total))
        np.divide(crossed, total, out=shares, where=total > 0)
        return shares

    def limits(self, gamma: float) -> NDArray[np.float64]:
        """The same sums with gamma in every voxel."""
        if math.isinf(gamma):
            return np.full(self.entropies_bit.shape[1], np.inf)
        return self._sum(gamma * np.bincount(self.classes, minlength=len(self.entropies_bit)).astype(np.float64))

    def _sum(self, weights: NDArray[np.float64]) -> NDArray[np.float64]:
        # Not a matrix product: a BLAS may add in another order on another machine.
        total: NDArray[np.float64] = (weights[:, None] * self.entropies_bit).sum(axis=0)
        return total


def group_sizes(blocks: int, block_frames: int = 1, memory: float = 0.0) -> list[int]:
    """How many consecutive blocks each group has."""
    groups = blocks if blocks < 2 * GROUPS else GROUPS
    long_enough = math.ceil(LONG * memory / block_frames)
    if long_enough > blocks // groups:
        groups = min(groups, max(FEWEST, blocks // long_enough))
    return [len(part) for part in np.array_split(np.arange(blocks), groups)]


def groups_of(period: PeriodBlocks) -> Groups:
    """The groups that the blocks of one record are joined to."""
    sizes = group_sizes(period.blocks, period.block_frames, period.memory_frames)
    return Groups(period.block_frames * np.array(sizes, dtype=np.int64), period.memory_frames)


def _grouped(
    path: Path, cells: NDArray[np.int64], grid: Grid, groups: Sequence[Groups], only: str | None
) -> NDArray[np.uint32]:
    """Counts of each group of blocks in the voxels ``cells``, (k, n)."""
    number, group_of = 0, []
    wanted = iter(groups)
    for period in read_periods(path):
        if only not in (None, period.name):
            group_of.append(np.full(period.blocks, -1))
            continue
        sizes = next(wanted).frames // period.block_frames
        group_of.append(number + np.repeat(np.arange(len(sizes)), sizes))
        number += len(sizes)
    of_block = np.concatenate(group_of)
    counts = np.zeros((number, len(cells)), dtype=np.uint32)
    with tables.reader(path, "tpog") as (file, _):
        for row_group in range(file.num_row_groups):  # one block each: memory does not grow with their number
            table = tables.read_group(file, row_group, path)
            group = of_block[block_numbers(table, path, len(of_block))]
            flat = np.ravel_multi_index([table.column(name).to_numpy() for name in ("ix", "iy", "iz")], grid.shape)
            kept = group >= 0
            where = group[kept] * len(cells) + np.searchsorted(cells, flat[kept])
            accumulate(where, table.column("count").to_numpy()[kept], counts.reshape(-1))
    return counts


def _classes(counts: NDArray[np.uint32]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """One voxel of each class, and the class of each voxel, (n,)."""
    keys = np.random.default_rng(_KEYS).integers(1, 2**63, size=len(counts), dtype=np.uint64)
    # Two classes that share a sum of keys: a chance of (classes**2 / 2) / 2**64, 1e-10 for 50,000.
    sums = np.zeros(counts.shape[1], dtype=np.uint64)
    for group, key in zip(counts, keys, strict=True):
        sums += group * key
    _, first, classes = np.unique(sums, return_index=True, return_inverse=True)
    return first.astype(np.int64), classes.astype(np.int64)


def _binary_entropies(p: NDArray[np.float64]) -> NDArray[np.float64]:
    """H(p) in bits, float64."""
    inside = (p > 0.0) & (p < 1.0)
    q = np.where(inside, p, 0.5)
    entropies: NDArray[np.float64] = np.where(inside, -(q * np.log(q) + (1.0 - q) * np.log1p(-q)) / math.log(2.0), 0.0)
    return entropies


def _entropies(counts: NDArray[np.int64], frames: NDArray[np.int64], grid: Grid) -> NDArray[np.float64]:
    """Entropy of each class, (classes, 1 + k), from its counts in each group, (k, classes)."""
    whole, total = counts.sum(axis=0), int(frames.sum())
    left_out = np.concatenate([whole[None], whole - counts])
    left = np.concatenate([[total], total - frames])
    entropies = np.zeros(left_out.shape)
    for size in np.unique(left):
        rows = np.flatnonzero(left == size)
        entropies[rows] = _exact(left_out[rows], int(size), grid)
    return np.ascontiguousarray(entropies.T)


def _exact(counts: NDArray[np.int64], frames: int, grid: Grid) -> NDArray[np.float64]:
    """Entropies of counts of ``frames``, in the counts' shape."""
    field = EntropyField.of(counts, frames, grid)
    found = np.zeros(counts.size)
    found[field.cells] = field.per_cell_bit
    return found.reshape(counts.shape)
