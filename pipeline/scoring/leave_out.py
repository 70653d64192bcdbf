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
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from pipeline.artefacts import tables
from pipeline.artefacts.readers import Tpog
from pipeline.core.errors import InputError
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
    groups
        Of each record that the TPOG was counted in, in the order of the columns.
    """

    cells: NDArray[np.int64]
    classes: NDArray[np.int64]
    entropies_bit: NDArray[np.float64]
    groups: tuple[Groups, ...]

    @classmethod
    def of(cls, path: Path, tpog: Tpog) -> LeaveOut | None:
        """From ``tpog.parquet``, which was read as ``tpog``; None when it has one block only, which tells nothing."""
        cells = np.flatnonzero(tpog.counts)
        counts, groups = _grouped(path, cells, tpog.grid)
        return cls.from_counts(counts, cells, groups, tpog.grid) if len(groups.frames) > 1 else None

    @classmethod
    def from_counts(cls, counts: NDArray[np.uint32], cells: NDArray[np.int64], groups: Groups, grid: Grid) -> LeaveOut:
        """From the counts of two or more groups, (k, n), in the voxels ``cells``, (n,)."""
        keys = np.random.default_rng(_KEYS).integers(1, 2**63, size=len(counts), dtype=np.uint64)
        # Two classes that share a sum of keys: a chance of (classes**2 / 2) / 2**64, 1e-10 for 50,000.
        sums = np.zeros(len(cells), dtype=np.uint64)
        for group, key in zip(counts, keys, strict=True):
            sums += group * key
        _, first, classes = np.unique(sums, return_index=True, return_inverse=True)
        entropies = _entropies(counts[:, first].astype(np.int64), groups.frames, grid)
        return cls(cells, classes.astype(np.int64), entropies, (groups,))

    def scores(self, hits: NDArray[np.uint32] | NDArray[np.int64], gamma: float, unit: int = 1) -> NDArray[np.float64]:
        """One site's score of all frames, and with each group left out, (1 + k,) float64; ``hits`` as in
        :meth:`EntropyField.score`."""
        capped, below, seen = (np.zeros(len(self.entropies_bit), dtype=np.int64) for _ in range(3))
        march.tally(hits, self.cells, self.classes, gamma * unit, capped, below, seen)
        return self._sum((0.0 if math.isinf(gamma) else gamma) * capped + below / unit)

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


def _grouped(path: Path, cells: NDArray[np.int64], grid: Grid) -> tuple[NDArray[np.uint32], Groups]:
    """Counts of each group of blocks in the voxels ``cells``, (k, n), and the groups."""
    with tables.reader(path, "tpog") as (file, about):
        frames, block_frames = int(about["frames"]), int(about["block_frames"])
        if frames % block_frames:
            raise InputError(path, f"{frames} frames in blocks of {block_frames}", "whole blocks; make it again")
        memory = float(about["memory_frames"])
        sizes = group_sizes(frames // block_frames, block_frames, memory)
        group_of = np.repeat(np.arange(len(sizes)), sizes)
        counts = np.zeros((len(sizes), len(cells)), dtype=np.uint32)
        for number in range(file.num_row_groups):  # one block each: memory does not grow with their number
            table = tables.read_group(file, number, path)
            flat = np.ravel_multi_index([table.column(name).to_numpy() for name in ("ix", "iy", "iz")], grid.shape)
            where = group_of[_block(table, path, len(group_of))] * len(cells) + np.searchsorted(cells, flat)
            accumulate(where, table.column("count").to_numpy(), counts.reshape(-1))
    return counts, Groups(block_frames * np.array(sizes, dtype=np.int64), memory)


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
