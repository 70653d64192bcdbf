r"""Replicates of joint scores: with one group of blocks of the city's traffic left out in turn.

The junctions of a city share one traffic simulation, so their scores are not independent: a busy quarter of an hour is
busy at many junctions. Their frames have the same times. So the same groups of blocks are left out at all junctions,
and the replicates of the junctions are added up: the replicate of the city without group g is

.. math:: F_{(g)} = \sum_j n_{j,(g)} \, S_{j,(g)}

with the joint score S of junction j and, for scores that are means, its average number of vehicles n, both without the
frames of group g. The block jackknife (:mod:`egvs.scoring.standard_errors`) of these sums needs no assumption about the
correlation between junctions. Where the score is a mean over detectors, each detector is left out at all junctions in
the same way. Groups are at least 20 autocorrelation times long: those of the junction whose
traffic has the longest one.

Limits: the plan was chosen with the same traffic, and the allocation is not repeated for each replicate. So the error
is that of the score of these sensors, without the error of the choice. Another demand or another network is another
question, which standard errors do not answer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from egvs.artefacts.frame_boxes import read_boxes
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.tpog import PeriodBlocks, read_periods
from egvs.core.grid import FloatArray, Grid
from egvs.extensions.city.tasks import Job
from egvs.placement.plan_error import PlanReplicates
from egvs.placement.problem_builder import PlacementProblem
from egvs.scoring.occupancy import near_grid
from egvs.scoring.standard_errors import BlockGroups, ScoreUncertainty, block_groups, detector_groups
from egvs.scoring.targets import recorded_frames
from egvs.stages.base import StageContext


@dataclass(frozen=True)
class CityBlocks:
    """The blocks of frames that all junctions of a city have in common.

    Attributes
    ----------
    periods
        The blocks of each record, with the longest autocorrelation time of any junction.
    detectors
        Detectors that the score that ranks averages over; empty for a score without detectors.
    """

    periods: tuple[PeriodBlocks, ...]
    detectors: tuple[str, ...] = ()

    @property
    def groups(self) -> tuple[BlockGroups, ...]:
        """Groups of blocks that are left out in turn, of each record."""
        return tuple(block_groups(period) for period in self.periods)

    def uncertainty(self, replicates: FloatArray) -> ScoreUncertainty:
        """Return standard errors of n scores from their replicates, (n, 1 + k + d)."""
        return ScoreUncertainty.of(replicates, self.groups + detector_groups(len(self.detectors)))


class _FrameTimes(NamedTuple):
    """What must be equal at two junctions, so that their blocks have the same times."""

    frame_period_s: float
    blocks: tuple[tuple[str, int, int, int], ...]


def common_blocks(jobs: Sequence[Job]) -> CityBlocks | str:
    """Return the blocks that all junctions have in common, or the reason why there are no standard errors.

    The runs of the junctions are complete.
    """
    times: dict[str, _FrameTimes] = {}
    memory: list[list[float]] = []
    periods: tuple[PeriodBlocks, ...] = ()
    detectors: dict[str, tuple[str, ...]] = {}
    for job in jobs:
        scenario = job.scenario()
        if not scenario.score.standard_error:
            return f"score.standard_error is false at junction {job.junction}"
        detectors[job.junction] = scenario.score.ranking_detectors
        periods = read_periods(job.out / RunFolder.tpog.name)
        blocks = tuple((period.name, period.frames, period.block_frames, period.times) for period in periods)
        times[job.junction] = _FrameTimes(scenario.traffic.frame_period_s, blocks)
        memory.append([period.memory_frames for period in periods])
        if any(period.blocks < 2 for period in periods):
            return f"junction {job.junction} has a single block of frames (tpog.blocks)"
    first = next(iter(times))
    for name, junction_times in times.items():
        if junction_times != times[first]:
            return f"junctions {first} and {name} have different frames or blocks"
        if detectors[name] != detectors[first]:
            return f"junctions {first} and {name} have different detectors"
    longest = np.max(memory, axis=0).tolist()
    common = tuple(replace(period, memory_frames=frames) for period, frames in zip(periods, longest, strict=True))
    return CityBlocks(common, detectors[first])


class JointReplicates:
    """Computes the replicates of plans of one junction.

    Parameters
    ----------
    context
        The run of the junction, up to the TPOG.
    placement_problem
        Its candidates.
    blocks
        The blocks of the city.
    mean_vehicles
        Average number of vehicles in the region of interest.
    """

    def __init__(
        self, context: StageContext, placement_problem: PlacementProblem, blocks: CityBlocks, mean_vehicles: float
    ) -> None:
        self._joint = placement_problem.problem.joint
        self._sites = placement_problem.sites
        self._index = {name: i for i, name in enumerate(placement_problem.names)}
        self._replicates = PlanReplicates(context, placement_problem, blocks.periods)
        self._factor: FloatArray | float = 1.0
        if placement_problem.score != "egvs":
            trajectories = context.folder.trajectories
            without = vehicles_without_groups(trajectories, context.scenario.roi.grid, blocks)
            n_detectors = sum(len(group.frames) for group in self._replicates.detector_groups)
            self._factor = np.concatenate([[mean_vehicles], without, np.full(n_detectors, mean_vehicles)])

    def of_order(self, sites: Sequence[str]) -> FloatArray:
        """Return the replicates of the first 0, 1, ... n of the sites of a plan, (n + 1, 1 + k + d) float64.

        The first column is the score with all frames.
        """
        order = [self._index[name] for name in sites]
        plans = [order[:number] for number in range(len(order) + 1)]
        rows = self._replicates.of_plans(self._joint, plans, self._sites)
        rows[np.isnan(rows)] = 0.0  # without vehicles, none is found
        return rows * self._factor


def vehicles_without_groups(trajectories: Path, grid: Grid, blocks: CityBlocks) -> FloatArray:
    """Return the average number of vehicles near a region of interest without each group of frames, (k,) float64.

    Counted as ``boxes_in_roi`` of the tpog stage; of a mix, the weighted mean over its records.

    Parameters
    ----------
    trajectories
        ``trajectories.parquet`` of a junction.
    grid
        The grid of its region.
    blocks
        The blocks of the city.
    """
    recorded = recorded_frames(trajectories)
    counts = np.zeros(sum(recorded), dtype=np.int64)
    for boxes in read_boxes(trajectories, grid):
        near = near_grid(boxes.values, grid)
        counts += np.bincount(boxes.frame[near], minlength=len(counts))

    starts = (np.cumsum(recorded) - recorded).tolist()
    used = [counts[start : start + period.frames] for start, period in zip(starts, blocks.periods, strict=True)]
    means = np.array([record.mean() for record in used])
    weights = np.array([period.weight for period in blocks.periods])
    without = []
    for i, (record, groups) in enumerate(zip(used, blocks.groups, strict=True)):
        ends = np.cumsum(groups.frames).tolist()
        for end, frames in zip(ends, groups.frames.tolist(), strict=True):
            means_left = means.copy()
            means_left[i] = (record.sum() - record[end - frames : end].sum()) / (len(record) - frames)
            without.append(np.average(means_left, weights=weights))
    return np.array(without)
