r"""How far a mean over vehicle-frames may be off because the traffic was short: groups of frames left out in turn.

Neighbouring vehicle-frames are much alike, so errors come from the blocks of frames that the TPOG was counted in,
joined to groups as for the EGVS (:mod:`pipeline.scoring.leave_out`). A mean over vehicle-frames is a ratio of two sums:
of what is seen, and of how many vehicles there are. Traffic moves both, so the group is taken from both,

.. math:: S_{(g)} = \frac{\sum_i v_i - \sum_{i \in g} v_i}{N - N_g}

and :class:`pipeline.scoring.uncertainty.Estimate` makes standard errors, intervals and comparisons of them, as of the
EGVS. Where traffic is a mix of records (periods), a vehicle-frame counts as often as the mix takes its frame, over the
share of frames that are replayed; what is left of a record without a group keeps the record's weight.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.artefacts import tables
from pipeline.artefacts.periods import PeriodBlocks
from pipeline.artefacts.readers import read_periods
from pipeline.scoring.leave_out import Groups, groups_of
from pipeline.scoring.targets.record import Floats, Ints, TargetRecord
from pipeline.scoring.targets.scores import mean


def recorded_frames(trajectories: Path) -> list[int]:
    """How many frames ``trajectories.parquet`` has of each record, one where there are no periods."""
    about = tables.read_metadata(trajectories, "trajectories")
    return [int(its["frames"]) for its in about.get("periods", [about])]


def weights_in_mix(periods: Sequence[PeriodBlocks], recorded: Sequence[int], record: TargetRecord) -> Floats:
    """How much each vehicle-frame counts, (n,) float64, where traffic is a mix of records of so many frames each; 1
    where there is one alone."""
    weight, offset = np.ones(len(record.numbers)), 0
    for period, frames in zip(periods, recorded, strict=True):
        here = (record.numbers >= offset) & (record.numbers < offset + frames)
        if len(periods) > 1 and here.any():
            weight[here] = period.times * period.frames / here.sum()
        offset += frames
    return weight[record.frame]


@dataclass(frozen=True, eq=False)
class FrameGroups:
    """Which group of blocks each vehicle-frame of a record belongs to, and how much it counts.

    Attributes
    ----------
    groups
        Of each record that the traffic is a mix of; one where there are no periods.
    ends
        Vehicle-frames ends[g] to ends[g + 1] are those of group g, counted over all records, (k + 1,) int64.
    weight
        How much each vehicle-frame counts, (n,) float64; 1 where there are no periods.
    """

    groups: tuple[Groups, ...]
    ends: Ints
    weight: Floats

    @classmethod
    def read(cls, tpog: Path, trajectories: Path, record: TargetRecord) -> FrameGroups | None:
        """From ``tpog.parquet`` and the ``trajectories.parquet`` that it was counted from; None when a record has one
        block only, which tells nothing."""
        periods = read_periods(tpog)
        if any(its.blocks < 2 for its in periods):
            return None
        return cls.of(periods, recorded_frames(trajectories), record)

    @classmethod
    def of(cls, periods: Sequence[PeriodBlocks], recorded: Sequence[int], record: TargetRecord) -> FrameGroups:
        """From the blocks of each record, two or more, and the frames that were recorded in it: those at its end that
        fill no block belong to its last group. A record of which no frame is replayed has no say."""
        groups = tuple(groups_of(period) for period in periods)
        offsets = np.append(0, np.cumsum(recorded[:-1]))
        starts = [
            offset + np.append(0, np.cumsum(its.frames[:-1])) for offset, its in zip(offsets, groups, strict=True)
        ]
        at = np.searchsorted(record.numbers[record.frame], np.concatenate(starts))
        return cls(groups, np.append(at, len(record)), weights_in_mix(periods, recorded, record))

    def means(self, values: Floats, weight: Floats | None = None) -> Floats:
        """The mean of all vehicle-frames, and with each group left out, (1 + k,) float64, as
        :meth:`pipeline.scoring.uncertainty.Estimate.of` takes them of each site; not a number where nothing is left.

        Parameters
        ----------
        values
            Of vehicle-frames, (n,) float64.
        weight
            How much each counts, beside its weight in the mix, (n,) float64; all alike where it is None.
        """
        counts = self.weight if weight is None else self.weight * weight
        sums = np.array([self._by_group(values * counts), self._by_group(counts)])
        left, first = [], 0
        for its in self.groups:
            mine = slice(first, first + len(its.frames))
            others = np.delete(sums, mine, axis=1).sum(axis=1)
            for group, frames in enumerate(its.frames.tolist()):
                rest = np.delete(sums[:, mine], group, axis=1).sum(axis=1)
                left.append(others + its.total / (its.total - frames) * rest)
            first = mine.stop
        total, count = np.array(left).T
        without = np.divide(total, count, out=np.full(len(total), math.nan), where=count > 0.0)
        return np.append(mean(values, counts), without)

    def _by_group(self, values: Floats) -> Floats:
        return np.array([math.fsum(values[a:b]) for a, b in zip(self.ends[:-1], self.ends[1:], strict=True)])
