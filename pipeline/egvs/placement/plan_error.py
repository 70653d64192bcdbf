r"""Standard errors of joint scores of plans: the block jackknife of one scenario's traffic.

The replicates of a plan are its joint score of all traffic, and that with each group of blocks of frames left out, as
for the score of one site (:mod:`egvs.scoring.standard_errors`). Neighbouring groups are joined where the scores of the
single candidates are correlated, as they are for ``scores.parquet``. So a plan of one sensor has the standard error
that ``egvs run`` gives this site.

Gains are compared on the same groups: what a plan adds to a smaller one is the difference of their replicates, and the
scatter that both plans have in common cancels.

Limits: the plan was chosen with the same traffic, and the choice is not repeated for each replicate. So the error is
that of the score of these sensors, without the error of the choice.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
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
    summarise_uncertainty,
)
from egvs.scoring.targets import FrameGroups, recorded_frames
from egvs.stages.base import StageContext

SHORT_RECORD = "; the recorded traffic is short for its autocorrelation, so they may be too small"
"""What is added to the origin of standard errors from a short record."""


class PlanReplicates:
    """Computes the joint scores of plans: of all traffic, and with each group of blocks left out.

    Parameters
    ----------
    context
        The run, up to the TPOG.
    placement_problem
        Its candidates.
    periods
        Blocks of each record of the traffic, at least two each.
    """

    def __init__(
        self, context: StageContext, placement_problem: PlacementProblem, periods: Sequence[PeriodBlocks]
    ) -> None:
        view, score = placement_problem.views[-1], placement_problem.score
        self._values: Callable[[IntArray], FloatArray]
        if isinstance(view, TargetView):
            self._values = _target_replicates(context, view, score, periods)
        else:
            self._values = _voxel_replicates(context, view, score, periods)

    def of_plan(self, term: CoverageTerm, plan: Sequence[int]) -> FloatArray:
        """Return the replicates of a plan, (1 + k,) float64; NaN where no traffic is left.

        Parameters
        ----------
        term
            The joint score.
        plan
            Candidates of the term.
        """
        return self._values(CoverageState([term], plan).totals(term))

    def of_order(self, term: CoverageTerm, order: Sequence[int]) -> FloatArray:
        """Return the replicates of the first 0, 1, ... n sensors of a plan, (n + 1, 1 + k) float64."""
        state = CoverageState([term])
        rows = [self._values(state.totals(term))]
        for candidate in order:
            state.add(candidate)
            rows.append(self._values(state.totals(term)))
        return np.array(rows)


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
        self._groups = tuple(block_groups(period) for period in periods)
        self._candidates = _replicates_of_candidates(context, placement_problem, self._replicates)
        if np.isnan(self._candidates).any():
            self.source = "without one of the blocks of frames there are no vehicles"
            return
        estimate = ScoreUncertainty.of(self._candidates, self._groups)
        self.are_known = True
        names = [period.name for period in periods]
        self.source = str(summarise_uncertainty(estimate, names)["standard_errors_from"])
        if any(stratum.is_short or stratum.still_correlated for stratum in estimate.strata):
            self.source += SHORT_RECORD

    def of_plans(self, term: CoverageTerm, plans: Sequence[Plan]) -> list[StepError]:
        """Return the errors of a sequence of plans, each compared with the one before it.

        Parameters
        ----------
        term
            The joint score.
        plans
            Candidates of the term.
        """
        if not self.are_known:
            return [UNKNOWN_ERROR] * len(plans)
        return self._step_errors([self._replicates.of_plan(term, plan) for plan in ((), *plans)])

    def of_target_values(self, values: Sequence[FloatArray]) -> list[StepError]:
        """Return the errors of mean values over vehicle-frames, each but the first compared with the one before it.

        Parameters
        ----------
        values
            Of each vehicle-frame, by plan, (n,) float64 each; the first belongs to no sensor, or to another plan.

        Raises
        ------
        ValueError
            For a joint score over voxels.
        """
        if not self.are_known:
            return [UNKNOWN_ERROR] * (len(values) - 1)
        if self._target_groups is None:
            raise ValueError("expected a joint score over vehicle-frames")
        return self._step_errors([self._target_groups.means(of_plan) for of_plan in values])

    def _step_errors(self, rows: Sequence[FloatArray]) -> list[StepError]:
        """Return the errors of each row of replicates but the first, (1 + k,) each, compared with the one before it."""
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


def _replicates_of_candidates(
    context: StageContext, placement_problem: PlacementProblem, replicates: PlanReplicates
) -> FloatArray:
    """Return the replicates of each candidate alone, (n, 1 + k) float64."""
    joint = placement_problem.problem.joint

    def of_candidate(candidate: int) -> FloatArray:
        return replicates.of_plan(joint, (candidate,))

    return np.array(list(map_ordered(of_candidate, range(len(placement_problem.sites)), context.threads)))
