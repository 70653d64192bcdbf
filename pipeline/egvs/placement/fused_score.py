r"""Expected detections of a plan in the fused point clouds of its sensors, and swaps that raise them.

The joint score that plans are optimised by takes sensors as independent (:mod:`egvs.placement.problem`). Here the
points of all sensors of a plan S are added on each vehicle-frame i before the model of detection p sees them
(:mod:`egvs.scoring.fused_targets`):

.. math:: E_f(S) = \frac{\sum_i w_i \, p\big(\mathrm{fuse}_{s \in S}\, x_{i,s}\big)}{\sum_i w_i}

p is the mean over detectors. People, for whom there is no model, are found from 20 points of all sensors on. What
people would notice in the fused clouds has the same form, with the curves of :mod:`egvs.scoring.noticed`; these were
measured with single sensors. It is computed for the plan, and chooses nothing.

E_f is neither monotone nor submodular: a further sensor may open a hole between points, or be the one with most
points although it sees the vehicle less well. So the tangents that bound the joint score of independent sensors do not
bound E_f, and nothing is proved about plans by E_f.

The search is local (:func:`improve_by_fused_swaps`). It begins at the best plan of independent sensors and replaces one
sensor at a time, by one of the :data:`SWAP_CANDIDATES` candidates that add most to the others as independent sensors,
as long as E_f rises. Only the candidates that are tried are scanned. A value takes about
8 ms for 2,000 vehicle-frames.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

import numpy as np

from egvs.core.grid import FloatArray
from egvs.placement.plan_error import PlanErrors
from egvs.placement.problem import Plan, Problem
from egvs.results.levels import NoticedShare
from egvs.results.plans import FusedPlan, PlanStep
from egvs.scoring.fused_targets import fuse_targets
from egvs.scoring.noticed import noticed_bounds, noticed_chances, noticed_errors
from egvs.scoring.target_scores import expected_by_detector
from egvs.scoring.targets import TargetVisibility, VisibleTargets, weighted_mean
from egvs.scoring.visibility import Beams
from egvs.stages.site_scoring import TargetScorer

FUSED_SCORE = "expected_detections"
"""The joint score that assumes independent sensors; all others add points or beams of all sensors anyway."""

SWAP_CANDIDATES = 12
"""Candidates that are tried in place of each sensor of a plan."""

_MIN_GAIN = 1e-9
"""A swap has to gain more than this share of vehicles."""

ScanReader = Callable[[Collection[str]], Iterator[tuple[str, Beams]]]
"""Yields the name and the empty scan of each of some candidates, in any order."""


class FusedScore:
    """The expected detections of plans in fused point clouds. What each candidate sees is computed when first needed.

    Parameters
    ----------
    targets
        The vehicles.
    names
        Names of all candidates.
    read_scans
        Reads their scans.
    """

    def __init__(self, targets: TargetScorer, names: Sequence[str], read_scans: ScanReader) -> None:
        self.targets = targets
        self.names = tuple(names)
        self._read_scans = read_scans
        self._visible: dict[str, VisibleTargets] = {}

    def chances(self, plan: Sequence[int]) -> FloatArray:
        """Return the probability that each detector finds each vehicle-frame, (d, n) float64; 0 without a sensor.

        Parameters
        ----------
        plan
            Candidates, in any order.
        """
        detectors = self.targets.detectors
        if not plan:
            return np.zeros((len(detectors), len(self.targets.record)))
        return expected_by_detector(self.fused(plan), detectors)

    def fused(self, plan: Sequence[int]) -> TargetVisibility:
        """Return what the sensors of a plan, at least one, see together."""
        self.prepare(plan)
        return fuse_targets([self._visible[self.names[i]] for i in plan])

    def value(self, plan: Sequence[int]) -> float:
        """Return the share of vehicles that a plan is expected to find, 0 to 1."""
        return self.mean_share(self.chances(plan))

    def mean_share(self, chances: FloatArray) -> float:
        """Return the mean over detectors and vehicles of :meth:`chances`."""
        return weighted_mean(chances.mean(axis=0), self.targets.weight)

    def prepare(self, candidates: Iterable[int]) -> None:
        """Compute what some candidates see; their scans are read together."""
        missing = {self.names[i] for i in candidates} - self._visible.keys()
        if missing:
            for name, beams in self._read_scans(missing):
                self._visible[name] = self.targets.visible(beams)


def evaluate_fused_plan(
    score: FusedScore, problem: Problem, order: Sequence[int], errors: PlanErrors, *, search: bool
) -> FusedPlan:
    """Return what a plan is expected to find in fused point clouds, with standard errors.

    Parameters
    ----------
    score
        Values of plans.
    problem
        Its rules and demands are kept by swaps.
    order
        Candidates of the plan in the order of installation, at least one.
    errors
        Estimates standard errors.
    search
        Whether to try swaps.
    """
    plans = [tuple(order[:count]) for count in range(1, len(order) + 1)]
    steps = _steps(score, [(), *plans], errors)
    noticed = _noticed_share(score, plans[-1], errors)
    if not search:
        return FusedPlan(steps, noticed=noticed)

    better = improve_by_fused_swaps(problem, score, plans[-1])
    if set(better) == set(order):
        return FusedPlan(steps, searched=True, noticed=noticed)
    (step,) = _steps(score, [plans[-1], better], errors)
    return FusedPlan(steps, tuple(score.names[i] for i in better), step, searched=True, noticed=noticed)


def _noticed_share(score: FusedScore, plan: Plan, errors: PlanErrors) -> NoticedShare:
    """Return what people would notice in the fused clouds of a plan."""
    fused, weight = score.fused(plan), score.targets.weight
    chances = noticed_chances(fused)
    low, high = (weighted_mean(bound, weight) for bound in noticed_bounds(fused))
    by_detector = np.tile(chances, (len(score.targets.detectors), 1))  # the same for each: they add no error
    (traffic,) = errors.of_chances([np.zeros_like(by_detector), by_detector])
    se = None
    if not math.isnan(traffic.score_se):
        of_curves = [weighted_mean(change, weight) for change in noticed_errors(fused)]
        se = math.hypot(traffic.score_se, *of_curves)
    return NoticedShare(weighted_mean(chances, weight), se, low, high)


def _steps(score: FusedScore, plans: Sequence[Plan], errors: PlanErrors) -> tuple[PlanStep, ...]:
    """Return the value of each plan but the first, and what it adds to the one before it."""
    chances = [score.chances(plan) for plan in plans]
    values = [score.mean_share(of_plan) for of_plan in chances]
    steps = []
    for number, error in enumerate(errors.of_chances(chances), start=1):
        gain = values[number] - values[number - 1]
        steps.append(PlanStep(len(plans[number]), values[number], gain, met=True, **error._asdict()))
    return tuple(steps)


def improve_by_fused_swaps(problem: Problem, score: FusedScore, plan: Plan) -> Plan:
    """Return a plan with other sensors, as many as before, if it is expected to find more vehicles in fused clouds.

    Parameters
    ----------
    problem
        Its rules and demands are kept; forced candidates stay.
    score
        Values of plans.
    plan
        A plan that keeps the rules.
    """
    value = score.value(plan)
    while True:
        best = max(_swapped_plans(problem, score, plan), key=score.value, default=plan)
        best_value = score.value(best)
        if not best_value > value + _MIN_GAIN:
            return plan
        plan, value = best, best_value


def _swapped_plans(problem: Problem, score: FusedScore, plan: Plan) -> list[Plan]:
    """Return plans with one other sensor, which keep the rules and meet the demands."""
    plans = []
    for sensor in plan:
        if sensor in problem.rules.forced:
            continue
        others = tuple(candidate for candidate in plan if candidate != sensor)
        allowed = problem.rules.allowed_additions(others)
        allowed[sensor] = False
        additions = np.flatnonzero(allowed).astype(np.int64)
        gains = problem.coverage_state(others).gains(problem.joint, additions)
        likely = additions[np.argsort(-gains, kind="stable")[:SWAP_CANDIDATES]].tolist()
        score.prepare(likely)
        swapped = [(*others, candidate) for candidate in likely]
        plans += [other for other in swapped if not problem.demands or problem.plan_value(other).met >= 0.0]
    return plans
