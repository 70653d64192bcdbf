r"""Prove upper bounds on the value of every plan, and search all plans by branch and bound.

Upper bounds. The function f of a coverage term is concave, so it lies below its tangent at any :math:`t_0`. With
:math:`t_c = \sum_s a_s(c)`,

.. math:: F(S) \le \sum_c w_c \big(f(t_{0c}) - f'(t_{0c})\, t_{0c}\big) + \sum_{s \in S} \sum_c w_c f'(t_{0c})\, a_s(c)

that is, a constant plus one number per candidate. The largest such sum that the rules allow bounds every plan. This
holds for every :math:`t_0` (for :math:`\min(t, s)` also for every slope from 0 to 1 at the corner). Good :math:`t_0`
come from the relaxation with fractional sensors, solved by the algorithm of Frank and Wolfe (1956). With :math:`t_0`
the totals of a set S, the bound is at least that of Nemhauser, Wolsey and Fisher (1978): F(S) plus the largest gains.

Branch and bound. A node is a partial plan and the candidates that may still join it. It is bounded by the tangents of
its ancestors, then by the gains from the partial plan, then by new tangents. Candidates for which a tangent leaves no
room are dropped (reduced costs). The node then branches on one candidate: in the plan, or not. Plans are compared by
exact values, so the result is optimal to the last bit. If the time limit ends the search, the largest bound of the open
nodes is proved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import NamedTuple

import numpy as np

from egvs.core.grid import FloatArray, IntArray
from egvs.kernels import submodular
from egvs.placement.problem import (
    AdditionValues,
    CoverageState,
    CoverageTerm,
    Plan,
    PlanRules,
    PlanValue,
    Problem,
    map_in_threads,
    tie_break_key,
)

BOUND_ROUNDING = 1e-9
"""Bounds are raised by this share; the rounding error of their sums is below 1e-11."""

_MIN_IMPROVEMENT = 2e-4
_MAX_STALLED_STEPS = 10
"""Frank-Wolfe ends after this many steps in a row that each lower the bound by less than ``_MIN_IMPROVEMENT``."""

_STEPS_PER_NODE = 12
"""Maximum number of Frank-Wolfe steps at a node other than the root."""

_MAX_INHERITED_TANGENTS = 6
"""A node is tested with so many tangents of its ancestors, the most recent ones."""

_TIE_TOLERANCE = 1e-11
"""Values that differ by at most this share are compared exactly: sums of gains are more accurate than that."""


class AdditionBounds(NamedTuple):
    """Upper bounds on the plans that extend a partial plan.

    Attributes
    ----------
    overall
        Bound on all of these plans.
    with_each
        Bound on those that contain each candidate, (k,).
    selected, shares
        The relaxed selection that attains ``overall``, see :class:`egvs.placement.problem.GainBound`.
    """

    overall: float
    with_each: FloatArray
    selected: IntArray
    shares: FloatArray


@dataclass(frozen=True, eq=False)
class Tangent:
    """A linear upper bound: F(S) is at most ``constant`` plus the sum of ``slope`` over S.

    Attributes
    ----------
    constant
        Value for the empty set.
    slope
        One number per candidate, (n,) float64; 0 for candidates that the bound does not cover.
    """

    constant: float
    slope: FloatArray

    def bound_additions(self, rules: PlanRules, plan: Sequence[int], candidates: IntArray) -> AdditionBounds:
        """Bound the plans that contain ``plan`` and otherwise some of ``candidates``."""
        slope = self.slope[candidates]
        largest, selected, shares = rules.max_gain_sum(slope, candidates, plan)
        overall = self.constant + float(self.slope[list(plan)].sum()) + largest
        with_each = np.full(len(candidates), overall)
        if not np.isfinite(rules.budget) and len(selected):
            # A candidate that is not selected replaces at best the selected one with the smallest slope.
            smallest_selected = float(self.slope[selected].min())
            with_each = np.minimum(overall, overall - smallest_selected + slope)
        raised = 1.0 + BOUND_ROUNDING
        return AdditionBounds(overall * raised, with_each * raised, selected, shares)


@dataclass(frozen=True, eq=False)
class Bound:
    """An upper bound on the value of every plan.

    Attributes
    ----------
    value
        The bound; not below the value of the known plan.
    tangent
        The tangent that proves it; None if no plan can exceed the known one.
    candidates
        The candidates that a better plan may contain, ascending.
    """

    value: float
    tangent: Tangent | None
    candidates: IntArray


@dataclass(frozen=True)
class BoundSettings:
    """How much effort :func:`upper_bound` makes.

    Attributes
    ----------
    steps
        Maximum number of Frank-Wolfe steps; each reads the visibility of all candidates once.
    threads
        Number of threads.
    sufficient_gap
        The search ends when the bound is above the known value by this share or less.
    """

    steps: int
    threads: int
    sufficient_gap: float = 0.0


def upper_bound(
    term: CoverageTerm,
    rules: PlanRules,
    plan: Sequence[int],
    candidates: IntArray,
    known: float,
    settings: BoundSettings,
) -> Bound:
    """Return the best bound found on plans that contain ``plan`` and otherwise some of ``candidates``.

    Candidates for which a tangent leaves no room (no plan with them can exceed ``known``) are dropped on the way, so
    later steps are faster.

    Parameters
    ----------
    term
        The term to bound.
    rules
        Rules that the plans keep.
    plan
        Candidates that are part of all of these plans.
    candidates
        Candidates that may be added, (k,).
    known
        Value of a known plan; minus infinity if there is none. No plan below it is of interest.
    settings
        Steps and threads.
    """
    matrix = term.visibility
    plan_totals = np.zeros(matrix.n_cells)
    for candidate in plan:
        _add_share(term, candidate, 1.0, plan_totals)
    plan_candidates = np.array(plan, dtype=np.int64)

    best_value = np.inf
    best_tangent: Tangent | None = None
    totals = plan_totals.copy()
    stalled_steps = 0
    remaining = candidates
    for step in range(settings.steps):
        cell_slope, constant = _slope(term, totals, 0.5 / (1.0 + step / 4.0))

        def slopes_of(rows: IntArray, cell_slope: FloatArray = cell_slope) -> FloatArray:
            slopes = np.empty(len(rows))
            submodular.tangent_slopes(
                rows, matrix.starts, matrix.cells, matrix.amounts, term.each_once, cell_slope, slopes
            )
            return slopes

        slope = np.zeros(len(matrix))
        slope[remaining] = map_in_threads(slopes_of, remaining, settings.threads)
        slope[plan_candidates] = slopes_of(plan_candidates)
        tangent = Tangent(constant, slope)
        bounds = tangent.bound_additions(rules, plan, remaining)
        remaining = remaining[bounds.with_each > known]

        if best_tangent is None or bounds.overall < best_value * (1.0 - _MIN_IMPROVEMENT):
            stalled_steps = 0
        else:
            stalled_steps += 1
        if bounds.overall < best_value:
            best_value = bounds.overall
            best_tangent = tangent
        is_sufficient = best_value <= known + settings.sufficient_gap * abs(known)
        if is_sufficient or not len(remaining) or stalled_steps > _MAX_STALLED_STEPS:
            break

        vertex = plan_totals.copy()
        for candidate, share in zip(bounds.selected.tolist(), bounds.shares.tolist(), strict=True):
            _add_share(term, candidate, share, vertex)
        totals += (vertex - totals) / (step + 1.0)

    value = best_value if len(remaining) else known
    return Bound(max(value, known), best_tangent, remaining)


def _add_share(term: CoverageTerm, candidate: int, share: float, totals: FloatArray) -> None:
    matrix = term.visibility
    first = int(matrix.starts[candidate])
    last = int(matrix.starts[candidate + 1])
    submodular.add_sensor(first, last, matrix.cells, matrix.amounts, term.each_once, share, totals)


def _slope(term: CoverageTerm, totals: FloatArray, width: float) -> tuple[FloatArray, float]:
    """Slopes of w f at ``totals``, (n_cells,), and the value of all tangents together at t = 0.

    The corner of a capped term is rounded over the share ``width`` of the cap.
    """
    scale = term.scale
    weight = term.weight
    if term.curve == submodular.CAPPED:
        if not np.isfinite(scale):
            return weight, 0.0
        if scale > 0.0:
            below_cap = np.clip((scale - totals) / (width * scale) + 0.5, 0.0, 1.0)
        else:
            below_cap = np.zeros(len(weight))
        return weight * below_cap, float((weight * (1.0 - below_cap)).sum() * scale)

    if term.curve == submodular.LOGARITHM:
        slope = weight / (scale + totals)
        return slope, float((weight * np.log1p(totals / scale) - slope * totals).sum())

    missed = np.exp(-totals / scale)
    slope = weight * missed / scale
    return slope, float((weight * (1.0 - missed) - slope * totals).sum())


@dataclass(frozen=True)
class SearchResult:
    """Result of :func:`search_all_plans`.

    Attributes
    ----------
    plan, plan_value
        The best plan; the given one if none is better; None if there is none.
    bound
        Upper bound on every plan: ``plan_value.value`` if the search is complete.
    nodes
        Number of nodes that were examined.
    is_complete
        Whether the search ended before the time limit.
    """

    plan: Plan | None
    plan_value: PlanValue
    bound: float
    nodes: int
    is_complete: bool


@dataclass(frozen=True, eq=False)
class _Node:
    """A partial plan, the candidates that may join it, and what bounds it."""

    plan: Plan
    candidates: IntArray
    bound: float
    tangents: tuple[Tangent, ...]
    """Tangents of any terms of the objective; the smallest bound counts."""


def search_all_plans(
    problem: Problem, plan: Plan | None, roots: Sequence[Bound], *, time_limit_s: float
) -> SearchResult:
    """Search depth first for a plan that is better than ``plan``.

    Parameters
    ----------
    problem
        The problem.
    plan
        The best known plan; None to look only for plans that meet all demands, where none is known.
    roots
        Bounds on all plans, one per term of the objective.
    time_limit_s
        When to give up.
    """
    return _Search(problem, plan, perf_counter() + time_limit_s).run(roots)


class _Search:
    """State of a search: the best plan so far and the number of nodes."""

    def __init__(self, problem: Problem, plan: Plan | None, end_time: float) -> None:
        self.problem = problem
        self.end_time = end_time
        self.plan = plan
        self.plan_value = PlanValue(0.0, -np.inf, -np.inf)
        if plan is not None:
            self.plan_value = problem.plan_value(plan)
        #  A plan that must survive one failure is worth no more than the best plan of one sensor fewer.
        self.rules: PlanRules = problem.with_count(problem.rules.count - problem.survives).rules
        self.settings = BoundSettings(steps=_STEPS_PER_NODE, threads=problem.threads)
        self.nodes = 0

    def run(self, roots: Sequence[Bound]) -> SearchResult:
        forced = self.problem.rules.forced
        candidates = np.setdiff1d(self.problem.candidates, forced).astype(np.int64)
        for root in roots:
            candidates = np.intersect1d(candidates, root.candidates)
        tangents = tuple(root.tangent for root in roots if root.tangent is not None)
        root_bound = min(root.value for root in roots)

        stack = [_Node(forced, candidates, root_bound, tangents)]
        while stack:
            if perf_counter() > self.end_time:
                bound = max(self.plan_value.value, *(node.bound for node in stack))
                return SearchResult(self.plan, self.plan_value, bound, self.nodes, is_complete=False)
            node = stack.pop()
            self.nodes += 1
            stack += self._children(node)
        return SearchResult(self.plan, self.plan_value, self.plan_value.value, self.nodes, is_complete=True)

    def _children(self, node: _Node) -> list[_Node]:
        """Nodes that remain to be searched below a node, the most promising one last."""
        rules = self.problem.rules
        candidates = node.candidates[rules.allowed_additions(node.plan)[node.candidates]]
        state = self.problem.coverage_state(node.plan)
        self._try(node.plan, self.problem.plan_value_of(state))
        n_missing = rules.count - len(node.plan)
        if not n_missing or not len(candidates):
            return []

        bound, candidates = self._bound_by_inherited_tangents(node, candidates)
        if not self._may_be_better(bound) or not len(candidates):
            return []

        values = self.problem.values_with_each(state, candidates)
        order = np.lexsort((-candidates, values.joint, values.value, values.met))[::-1]
        best_first = candidates[order]
        if n_missing == 1:
            self._try_each(node.plan, best_first, AdditionValues(*(column[order] for column in values)))
            return []

        bound = min(bound, self._bound_by_gains(state, candidates))
        if not self._can_meet_demands(state, candidates) or not self._may_be_better(bound):
            return []

        tangents = list(node.tangents)
        for term in self.problem.objective:
            term_bound = upper_bound(term, self.rules, node.plan, candidates, self._cutoff, self.settings)
            bound = min(bound, term_bound.value)
            candidates = np.intersect1d(candidates, term_bound.candidates)
            if term_bound.tangent is not None:
                tangents.append(term_bound.tangent)
        if not self._may_be_better(bound) or not len(candidates):
            return []

        branching = next(int(candidate) for candidate in best_first if candidate in candidates)
        others = candidates[candidates != branching]
        inherited = tuple(tangents[-_MAX_INHERITED_TANGENTS:])
        without_it = _Node(node.plan, others, bound, inherited)
        with_it = _Node((*node.plan, branching), others, bound, inherited)
        return [without_it, with_it]

    def _bound_by_inherited_tangents(self, node: _Node, candidates: IntArray) -> tuple[float, IntArray]:
        """The smallest bound of the node's tangents, and the candidates for which they leave room."""
        bound = node.bound
        for tangent in node.tangents:
            bounds = tangent.bound_additions(self.rules, node.plan, candidates)
            bound = min(bound, bounds.overall)
            candidates = candidates[bounds.with_each > self._cutoff]
        return bound, candidates

    def _bound_by_gains(self, state: CoverageState, candidates: IntArray) -> float:
        """The smallest sum, over the objective, of the value of a partial plan and the largest gains."""
        bounds = []
        for term in self.problem.objective:
            gains = state.gains(term, candidates)
            largest_gains = self.rules.max_gain_sum(gains, candidates, state.chosen).total
            bounds.append((state.value(term) + largest_gains) * (1 + BOUND_ROUNDING))
        return min(bounds)

    def _can_meet_demands(self, state: CoverageState, candidates: IntArray) -> bool:
        """Whether some plan below a node may meet the demands at least as well as the best plan."""
        for demand in self.problem.demands:
            gains = state.gains(demand.term, candidates)
            largest_gains = self.problem.rules.max_gain_sum(gains, candidates, state.chosen).total
            reachable = self.problem.relaxed_value(state, demand.term) + largest_gains
            if demand.unmet(reachable * (1 + BOUND_ROUNDING)) > -self.plan_value.met:
                return False
        return True

    @property
    def _cutoff(self) -> float:
        """A bound up to this value rules out a better plan; minus infinity while the demands are not met."""
        cutoff = -np.inf
        if self.plan_value.met >= 0.0:
            cutoff = max(cutoff, self.plan_value.value)
        for demand in self.problem.demands:
            if [demand.term] == [*self.problem.objective]:
                cutoff = max(cutoff, demand.least)
        return cutoff * (1.0 - _TIE_TOLERANCE)

    def _may_be_better(self, bound: float) -> bool:
        return bound > self._cutoff

    def _try_each(self, plan: Plan, candidates: IntArray, values: AdditionValues) -> None:
        """Try the plans with one more sensor, best first, as long as they may be better."""
        for candidate, met, value in zip(candidates.tolist(), values.met.tolist(), values.value.tolist(), strict=True):
            is_less_met = met < self.plan_value.met - BOUND_ROUNDING
            if is_less_met or (met <= self.plan_value.met and not self._may_be_better(value)):
                if not self.problem.demands:
                    break
                continue
            larger_plan = (*plan, candidate)
            self._try(larger_plan, self.problem.plan_value(larger_plan))

    def _try(self, plan: Plan, plan_value: PlanValue) -> None:
        """Keep a plan if it is better than the best one; of equal plans the first by :func:`tie_break_key`."""
        plan = tuple(sorted(plan))
        is_better = plan_value > self.plan_value
        if plan_value == self.plan_value and self.plan is not None:
            is_better = tie_break_key(plan) < tie_break_key(self.plan)
        if is_better:
            self.plan = plan
            self.plan_value = plan_value
