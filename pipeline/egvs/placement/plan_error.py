r"""Standard errors of joint scores of plans: the block jackknife of one scenario's traffic.

The replicates of a plan are its joint score of all traffic, and that with each group of blocks of frames left out, as
for the score of one site (:mod:`egvs.scoring.standard_errors`). Neighbouring groups are joined where the scores of the
single candidates are correlated, as they are for ``scores.parquet``. So a plan of one sensor has the standard error
that ``egvs run`` gives this site.

Where the score is a mean over detectors, each detector is left out in turn as well: the joint score is computed again
from the probabilities of the others. Only the sensors of the plans are scanned again for that.

Gains are compared on the same groups: what a plan adds to a smaller one is the difference of their replicates, and the
scatter that both plans have in common cancels.

Limits: the plan was chosen with the same traffic, and the choice is not repeated for each replicate. So the error is
that of the score of these sensors, without the error of the choice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from egvs.artefacts.tpog import PeriodBlocks, read_periods, read_tpog
from egvs.core.grid import FloatArray, IntArray
from egvs.core.threads import map_ordered
from egvs.placement import problem
from egvs.placement.problem import CoverageState, CoverageTerm, Plan
from egvs.placement.problem_builder import PlacementProblem, TargetView, VoxelView
from egvs.scoring.standard_errors import (
    BlockGroups,
    BlockJackknife,
    ScoreUncertainty,
    block_groups,
    detector_groups,
    summarise_uncertainty,
)
from egvs.scoring.targets import FrameGroups, recorded_frames, weighted_mean
from egvs.sensors.sites import Site
from egvs.stages.base import StageContext
from egvs.stages.plan_scans import plan_beams
from egvs.statistics.blocks import means_without_each

SHORT_RECORD = "; the recorded traffic is short for its autocorrelation, so they may be too small"
"""What is added to the origin of standard errors from a short record."""


class PlanReplicates:
    """Computes the joint scores of plans: of all traffic, with each group of blocks and with each detector left out.

    Parameters
    ----------
    context
        The run, up to the TPOG.
    placement_problem
        Its candidates.
    periods
        Blocks of each record of the traffic, at least two each.

    Attributes
    ----------
    detector_groups
        The detectors that are left out in turn, after the groups of blocks; empty without several of them.
    """

    def __init__(
        self, context: StageContext, placement_problem: PlacementProblem, periods: Sequence[PeriodBlocks]
    ) -> None:
        view, score = placement_problem.views[-1], placement_problem.score
        self._values: Callable[[IntArray], FloatArray]
        self._other_detectors: Sequence[TargetView] = ()
        if isinstance(view, TargetView):
            self._other_detectors = view.without_each_detector()
            self._values = _target_replicates(context, view, score, periods)
        else:
            self._values = _voxel_replicates(context, view, score, periods)
        self.detector_groups = detector_groups(len(self._other_detectors))
        self._context = context
        self._score = score
        self._amounts: dict[str, list[IntArray]] = {}

    def of_candidate(self, term: CoverageTerm, candidate: int) -> FloatArray:
        """Return the replicates of one candidate, (1 + k,) float64, without those of detectors."""
        return self._values(CoverageState([term], (candidate,)).totals(term))

    def of_plans(
        self, term: CoverageTerm, plans: Sequence[Sequence[int]], sites: Sequence[Site], *, moved: bool = False
    ) -> FloatArray:
        """Return the replicates of m plans, (m, 1 + k + d) float64; NaN where no traffic is left.

        Parameters
        ----------
        term
            The joint score.
        plans
            Candidates of the term.
        sites
            The candidates of the term.
        moved
            Whether they were moved from the candidates of the run.
        """
        rows = np.array([self._values(CoverageState([term], plan).totals(term)) for plan in plans])
        if not self._other_detectors:
            return rows
        used = [sites[candidate] for candidate in sorted(set().union(*plans))]
        amounts = self._amounts_without_detectors(used, moved=moved)
        without = []
        for plan in plans:
            without.append(self._scores_without_detectors([amounts[sites[candidate].name] for candidate in plan]))
        return np.column_stack([rows, without])

    def _amounts_without_detectors(self, sites: Sequence[Site], *, moved: bool) -> Mapping[str, list[IntArray]]:
        """Return site -> its amounts without each detector, (n_cells,) int64 each."""
        amounts = {} if moved else self._amounts
        missing = [site for site in sites if site.name not in amounts]
        for name, beams in plan_beams(self._context, missing, moved=moved):
            amounts[name] = [view.row(beams).dense(view.n_cells) for view in self._other_detectors]
        return amounts

    def _scores_without_detectors(self, sensors: Sequence[Sequence[IntArray]]) -> list[float]:
        """Return the joint score of some sensors without each detector."""
        scores = []
        for number, view in enumerate(self._other_detectors):
            totals = sum((amounts[number] for amounts in sensors), np.zeros(view.n_cells, dtype=np.int64))
            values = problem.target_values(self._score, totals, view.unit)
            scores.append(weighted_mean(values, view.targets.weight))
        return scores


def _target_replicates(
    context: StageContext, view: TargetView, score: str, periods: Sequence[PeriodBlocks]
) -> Callable[[IntArray], FloatArray]:
    """Return the joint score as a function of the totals of all vehicle-frames."""
    groups = _target_groups(context, view, periods)

    def replicates(totals: IntArray) -> FloatArray:
        return groups.means(problem.target_values(score, totals, view.unit))

    return replicates


def _target_groups(context: StageContext, view: TargetView, periods: Sequence[PeriodBlocks]) -> FrameGroups:
    """Return the groups of blocks of all vehicle-frames, with their weights."""
    groups = FrameGroups.of(periods, recorded_frames(context.folder.trajectories), view.targets.record)
    return replace(groups, weight=view.targets.weight)


def _voxel_replicates(
    context: StageContext, view: VoxelView, score: str, periods: Sequence[PeriodBlocks]
) -> Callable[[IntArray], FloatArray]:
    """Return the joint score as a function of the totals of all voxels."""
    tpog = read_tpog(context.folder.tpog)
    groups = tuple(block_groups(period) for period in periods)
    jackknife = BlockJackknife.of(context.folder.tpog, tpog, groups=groups)
    assert jackknife is not None  # every record has two blocks
    gamma = context.scenario.gamma

    def replicates(totals: IntArray) -> FloatArray:
        hits = np.zeros(int(np.prod(tpog.grid.shape)), dtype=np.int64)
        hits[view.voxels] = totals
        if score == "egvs":
            return jackknife.scores(hits, gamma, view.unit)
        return jackknife.voxel_shares(hits, score)

    return replicates


class StepError(NamedTuple):
    """Standard errors of one plan of a sequence of plans; NaN where they are unknown.

    Attributes
    ----------
    score_se
        Of the joint score.
    gain_se
        Of what the plan adds to the plan before it; the first plan adds to no sensor.
    beats_previous
        Probability that it truly scores higher than the plan before it.
    """

    score_se: float
    gain_se: float
    beats_previous: float


UNKNOWN_ERROR = StepError(math.nan, math.nan, math.nan)


class PlanErrors:
    """Estimates standard errors of plans of one scenario.

    Parameters
    ----------
    context
        The run, up to the TPOG.
    placement_problem
        Its candidates.

    Attributes
    ----------
    source
        How the errors are computed; or the reason why there are none.
    are_known
        Whether there are standard errors.
    """

    def __init__(self, context: StageContext, placement_problem: PlacementProblem) -> None:
        self.are_known = False
        self._groups: tuple[BlockGroups, ...] = ()
        self._target_groups: FrameGroups | None = None
        periods = read_periods(context.folder.tpog)
        self.source = _why_unknown(periods, standard_error=context.scenario.score.standard_error)
        if self.source:
            return

        self._replicates = PlanReplicates(context, placement_problem, periods)
        view = placement_problem.views[-1]
        if isinstance(view, TargetView):
            self._target_groups = _target_groups(context, view, periods)
        blocks = tuple(block_groups(period) for period in periods)
        self._groups = blocks + self._replicates.detector_groups
        # They only decide which groups of blocks are joined, so those of single detectors are those of all detectors.
        of_candidate = partial(self._replicates.of_candidate, placement_problem.problem.joint)
        rows = np.array(list(map_ordered(of_candidate, range(len(placement_problem.sites)), context.threads)))
        n_detectors = sum(len(group.frames) for group in self._replicates.detector_groups)
        self._candidates = np.column_stack([rows, np.repeat(rows[:, :1], n_detectors, axis=1)])
        if np.isnan(self._candidates).any():
            self.source = "without one of the blocks of frames there are no vehicles"
            return
        estimate = ScoreUncertainty.of(self._candidates, self._groups)
        self.are_known = True
        names = [period.name for period in periods]
        self.source = str(summarise_uncertainty(estimate, names)["standard_errors_from"])
        if any(stratum.is_short or stratum.still_correlated for stratum in estimate.strata):
            self.source += SHORT_RECORD

    def of_plans(
        self, term: CoverageTerm, plans: Sequence[Plan], sites: Sequence[Site], *, moved: bool = False
    ) -> list[StepError]:
        """Return the errors of a sequence of plans, each compared with the one before it.

        Parameters are those of :meth:`PlanReplicates.of_plans`.
        """
        if not self.are_known:
            return [UNKNOWN_ERROR] * len(plans)
        return self._step_errors(self._replicates.of_plans(term, ((), *plans), sites, moved=moved))

    def of_change(self, term: CoverageTerm, sites: Sequence[Site], changed: FloatArray) -> StepError:
        """Return the errors of a plan of all sites in another run of the same frames, compared with it in this one.

        Parameters
        ----------
        term
            The joint score in this run.
        sites
            The candidates of the term; they are scanned anew.
        changed
            The replicates of the plan in the other run, (1 + k + d,) float64 (:meth:`PlanReplicates.of_plans`).
        """
        if not self.are_known:
            return UNKNOWN_ERROR
        rows = self._replicates.of_plans(term, [range(len(sites))], sites, moved=True)
        return self._step_errors(np.vstack([rows, changed]))[0]

    def of_chances(self, chances: Sequence[FloatArray]) -> list[StepError]:
        """Return the errors of mean probabilities of detection, each but the first compared with the one before it.

        Parameters
        ----------
        chances
            Of each detector and vehicle-frame, by plan, (d, n) float64 each; the first belongs to no sensor, or to
            another plan.

        Raises
        ------
        ValueError
            For a joint score over voxels.
        """
        if not self.are_known:
            return [UNKNOWN_ERROR] * (len(chances) - 1)
        groups = self._target_groups
        if groups is None:
            raise ValueError("expected a joint score over vehicle-frames")
        rows = []
        for by_detector in chances:
            row = groups.means(by_detector.mean(axis=0))
            if self._replicates.detector_groups:
                shares = np.array([weighted_mean(of_detector, groups.weight) for of_detector in by_detector])
                row = np.append(row, means_without_each(shares))
            rows.append(row)
        return self._step_errors(np.array(rows))

    def _step_errors(self, rows: FloatArray) -> list[StepError]:
        """Return the errors of each row of replicates but the first, each compared with the one before it.

        ``rows`` has the shape (1 + m, 1 + k + d).
        """
        n_candidates = len(self._candidates)
        all_rows = np.vstack([self._candidates, rows])
        estimate = ScoreUncertainty.of(all_rows, self._groups, n_joined_by=n_candidates)

        previous = n_candidates + np.arange(len(rows) - 1, dtype=np.int64)
        differences = estimate.differences(previous + 1, previous)
        beats = estimate.beats(previous + 1, previous)
        errors = zip(estimate.se[previous + 1].tolist(), differences.se.tolist(), beats.tolist(), strict=True)
        return [StepError(*error) for error in errors]


def _why_unknown(periods: Sequence[PeriodBlocks], *, standard_error: bool) -> str:
    """Return the reason why there are no standard errors; empty if there are some."""
    if not standard_error:
        return "score.standard_error is false"
    if any(period.blocks < 2 for period in periods):
        return "the traffic has a single block of frames (tpog.blocks)"
    return ""
