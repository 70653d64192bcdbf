"""Searches all plans, and proves that there is no better one: branch and bound.

A node holds what is part of the plan and what may still be. It is bounded by the tangents of its ancestors, which cost
nothing; by the gains at what is part already; at last by tangents of its own. What no tangent leaves room for is
dropped (reduced costs). Else one candidate is decided: part of the plan, or not. Plans are compared by their exact
values, so the one that is found is the best of all to the last bit; where the time ends first, the largest bound of the
open nodes is what is proved.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from pipeline.placement.solving import bounds
from pipeline.placement.solving.heuristics import Plan, shorter
from pipeline.placement.solving.problem import Problem, Worth
from pipeline.placement.solving.rules import Rules
from pipeline.placement.solving.sight import Floats, Ints

_STEPS = 12
"""Of Frank and Wolfe's at a node; the root has had its own."""

_KEPT = 6
"""Tangents of ancestors that a node is tried by, the youngest."""

_TIE = 1e-11
"""Values that differ by this share are compared exactly: sums of gains are off by less."""


@dataclass(frozen=True)
class Searched:
    """What the search found.

    Attributes
    ----------
    plan, worth
        The best plan; as before where none is better; None where there is none.
    bound
        What no plan exceeds: ``worth.value`` where all were searched.
    nodes
        How many were looked at.
    is_whole
        Whether the search came to its end.
    """

    plan: Plan | None
    worth: Worth
    bound: float
    nodes: int
    is_whole: bool


@dataclass(frozen=True, eq=False)
class _Node:
    chosen: tuple[int, ...]
    candidates: Ints
    bound: float
    tangents: tuple[bounds.Tangent, ...]
    """Of any term of the objective: the smallest one is what counts."""


def search(
    problem: Problem,
    plan: Plan | None,
    roots: Sequence[bounds.Bound],
    *,
    time_limit_s: float,
) -> Searched:
    """Look for a plan that is better than ``plan``, depth first.

    Parameters
    ----------
    plan
        The best known; None where only plans that meet all demands are looked for, and none is known.
    roots
        What bounds all plans, of each term of the objective.
    time_limit_s
        When to give up.
    """
    return _Search(problem, plan, perf_counter() + time_limit_s).run(roots)


class _Search:
    def __init__(self, problem: Problem, plan: Plan | None, until: float) -> None:
        self.problem, self.until, self.plan = problem, until, plan
        self.worth = Worth(0.0, -np.inf, -np.inf) if plan is None else problem.worth(plan)
        rules = problem.rules
        #  Without the sensor that is missed most, one less is left, whichever it is.
        self.rules: Rules = problem.with_count(rules.count - problem.survives).rules
        self.nodes = 0

    def run(self, roots: Sequence[bounds.Bound]) -> Searched:
        forced = self.problem.rules.forced
        free = np.setdiff1d(self.problem.candidates, forced).astype(np.int64)
        for root in roots:
            free = np.intersect1d(free, root.candidates)
        tangents = tuple(root.tangent for root in roots if root.tangent is not None)
        stack = [_Node(forced, free, min(root.value for root in roots), tangents)]
        while stack:
            if perf_counter() > self.until:
                bound = max(self.worth.value, *(node.bound for node in stack))
                return Searched(self.plan, self.worth, bound, self.nodes, is_whole=False)
            node = stack.pop()
            self.nodes += 1
            stack += self._children(node)
        return Searched(self.plan, self.worth, self.worth.value, self.nodes, is_whole=True)

    def _children(self, node: _Node) -> list[_Node]:
        """What is left to search below a node, the most promising last."""
        problem, rules = self.problem, self.problem.rules
        candidates = node.candidates[rules.may_join(node.chosen)[node.candidates]]
        seen = problem.together(node.chosen)
        self._try(node.chosen, problem.worth_of(seen))
        left = rules.count - len(node.chosen)
        if not left or not len(candidates):
            return []
        bound, candidates = self._bounded(node, candidates)
        if not self._may_be_better(bound) or not len(candidates):
            return []
        met, value, joint = problem.with_each(seen, candidates)
        order = np.lexsort((-candidates, joint, value, met))[::-1]
        ordered = candidates[order]
        if left == 1:
            self._try_each(node.chosen, ordered, met[order], value[order])
            return []
        gains = [seen.gains(term, candidates) for term in problem.objective]
        tops = [
            (seen.value(term) + self.rules.most(gain, candidates, node.chosen)[0]) * (1 + bounds.ROUNDING)
            for term, gain in zip(problem.objective, gains, strict=True)
        ]
        bound = min(bound, *tops)
        for demand in problem.demands:
            gain = seen.gains(demand.term, candidates)
            most = problem.relaxed(seen, demand.term) + rules.most(gain, candidates, node.chosen)[0]
            if demand.unmet(most * (1 + bounds.ROUNDING)) > -self.worth.met:
                return []
        if not self._may_be_better(bound):
            return []
        own = list(node.tangents)
        for term in problem.objective:
            its = bounds.bounded(
                term, self.rules, node.chosen, candidates, known=self._hopeless, steps=_STEPS, threads=problem.threads
            )
            bound, candidates = min(bound, its.value), np.intersect1d(candidates, its.candidates)
            own += [its.tangent] if its.tangent is not None else []
        if not self._may_be_better(bound) or not len(candidates):
            return []
        first = next(int(one) for one in ordered if one in candidates)
        rest = candidates[candidates != first]
        without = _Node(node.chosen, rest, bound, tuple(own[-_KEPT:]))
        return [without, _Node((*node.chosen, first), rest, bound, tuple(own[-_KEPT:]))]

    @property
    def _hopeless(self) -> float:
        """A bound up to this one leaves no better plan; below everything while demands are not met."""
        needed = [its.least for its in self.problem.demands if [its.term] == [*self.problem.objective]]
        known = self.worth.value if self.worth.met >= 0.0 else -np.inf
        return max(known, *needed, -np.inf) * (1.0 - _TIE)

    def _may_be_better(self, bound: float) -> bool:
        return bound > self._hopeless

    def _bounded(self, node: _Node, candidates: Ints) -> tuple[float, Ints]:
        """The least bound of the node's tangents, and the candidates that they leave room for."""
        bound = node.bound
        for tangent in node.tangents:
            top, room, _, _ = tangent.room(self.rules, node.chosen, candidates)
            bound = min(bound, top)
            candidates = candidates[room > self._hopeless]
        return bound, candidates

    def _try_each(self, chosen: tuple[int, ...], candidates: Ints, met: Floats, value: Floats) -> None:
        """The plans with one more, the best first, as long as they may be better."""
        for candidate, its_met, its_value in zip(candidates.tolist(), met.tolist(), value.tolist(), strict=True):
            is_less_met = its_met < self.worth.met - bounds.ROUNDING
            if is_less_met or (its_met <= self.worth.met and not self._may_be_better(its_value)):
                if not self.problem.demands:
                    break
                continue
            plan = (*chosen, candidate)
            self._try(plan, self.problem.worth(plan))

    def _try(self, plan: tuple[int, ...], worth: Worth) -> None:
        plan = tuple(sorted(plan))
        is_as_good = worth == self.worth and self.plan is not None
        if worth > self.worth or (is_as_good and shorter(plan) < shorter(self.plan or ())):
            self.plan, self.worth = plan, worth
