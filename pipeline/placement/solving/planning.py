"""Solves what is asked of a plan, and says what is proved of it.

Steps: plans of 1, 2, ... sensors by heuristics and swaps; a bound on every plan of as many sensors; where it is asked
for, the search of all plans. The plan is told in the order in which it would be built: the sensor that sees most first.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from time import perf_counter

import numpy as np

from pipeline.placement.solving import bounds, exact, heuristics
from pipeline.placement.solving.heuristics import Plan
from pipeline.placement.solving.problem import Problem, Worth

STEPS = 160
"""Of Frank and Wolfe's for the bound of a plan, at most."""

ENOUGH = 5e-4
"""A bound that is above a plan by this share is good enough: 99.95 % are proved then."""

Bounds = tuple[bounds.Bound, ...]
"""Of each term of the objective."""


@dataclass(frozen=True)
class CurvePoint:
    """The best plan that was found of at most so many sensors.

    Attributes
    ----------
    count
        Sensors at most.
    plan
        Candidates, sorted.
    worth
        What it is worth.
    bound
        What no plan of at most so many exceeds in ``worth.value``.
    """

    count: int
    plan: Plan
    worth: Worth
    bound: float

    @property
    def certificate(self) -> float:
        """The share of the best possible that is proved, 0 to 1; 1 up to the rounding of bounds."""
        if self.bound <= self.worth.value * (1.0 + 2.0 * bounds.ROUNDING):
            return 1.0
        return self.worth.value / self.bound


@dataclass(frozen=True)
class Solution:
    """A plan, and what is proved of it.

    Attributes
    ----------
    order
        The plan's candidates, the one that sees most first (forced ones before all others).
    curve
        For 1, 2, ... sensors; the last one is the plan.
    nodes
        Of the exact search; 0 where there was none.
    is_best
        Whether it is proved that there is no better plan.
    fewest_is_proved
        Whether it is proved that one sensor less cannot meet the demands; None where that was not asked for.
    """

    order: Plan
    curve: tuple[CurvePoint, ...]
    nodes: int = 0
    is_best: bool = False
    fewest_is_proved: bool | None = None

    @property
    def point(self) -> CurvePoint:
        """The plan's own point of the curve."""
        return self.curve[-1]


Heard = Callable[[int], None]


def best(problem: Problem, *, search_all: bool, time_limit_s: float, heard: Heard) -> Solution:
    """The best plan within the rules.

    Parameters
    ----------
    search_all
        Search until the best one is proved, or the time ends.
    heard
        Called with the number of sensors that plans were found for.
    """
    curve, its = _curve(problem, heard)
    point, nodes, is_best = curve[-1], 0, False
    if search_all:
        found = exact.search(problem, point.plan, its, time_limit_s=time_limit_s)
        assert found.plan is not None
        point = replace(point, plan=found.plan, worth=found.worth, bound=min(point.bound, found.bound))
        nodes, is_best = found.nodes, found.is_whole
        if is_best:
            point = replace(point, bound=found.worth.value)
        curve[-1] = point
    is_best = is_best or point.certificate >= 1.0
    return Solution(in_order(problem, point.plan), tuple(curve), nodes, is_best)


def fewest(problem: Problem, *, time_limit_s: float, heard: Heard) -> Solution | None:
    """The plan of the fewest sensors that meets all demands; None where none was found within the rules."""
    until = perf_counter() + time_limit_s
    curve: list[CurvePoint] = []
    its: list[Bounds] = []
    for count in range(max(1, len(problem.rules.forced)), problem.rules.count + 1):
        point, bound = _point(problem.with_count(count), curve[-1].plan if curve else ())
        curve.append(point)
        its.append(bound)
        heard(count)
        if point.worth.met >= 0.0:
            break
    else:
        return None
    proved, nodes = True, 0
    while len(curve) > 1:
        before = problem.with_count(curve[-2].count)
        found = exact.search(before, None, its[-2], time_limit_s=max(0.0, until - perf_counter()))
        nodes += found.nodes
        if found.plan is None:
            proved = found.is_whole
            break
        curve, its = curve[:-1], its[:-1]
        curve[-1] = replace(curve[-1], plan=found.plan, worth=found.worth)
    return Solution(in_order(problem, curve[-1].plan), tuple(curve), nodes, fewest_is_proved=proved)


def _curve(problem: Problem, heard: Heard) -> tuple[list[CurvePoint], Bounds]:
    """Plans of 1, 2, ... sensors, and what bounds the last one."""
    points: list[CurvePoint] = []
    its: Bounds = ()
    greedy = heuristics.greedy(problem) if problem.is_plain else ()
    first, most = max(1, len(problem.rules.forced)), problem.rules.most_sensors
    last, last_its = (None, its) if np.isinf(problem.rules.budget) else _point(problem.with_count(most), (), greedy)
    for count in range(first, most + 1 if last is None else len(last.plan)):
        point, its = _point(problem.with_count(count), points[-1].plan if points else (), greedy[:count])
        points.append(point)
        heard(count)
        if last is None and problem.is_plain and not _gains_any(problem, point.plan):
            break
    if last is not None:
        points.append(replace(last, count=max(first, len(last.plan))))
        its = last_its
    return points, its


def _gains_any(problem: Problem, plan: Plan) -> bool:
    """Whether any candidate would add anything to a plan; where none does, no plan is better."""
    seen = problem.together(plan)
    return bool((seen.gains(problem.joint, problem.candidates) > 0.0).any())


def _point(problem: Problem, smaller: Plan, greedy: Plan = ()) -> tuple[CurvePoint, Bounds]:
    """The best plan that is found, among others from one of one sensor less; and what bounds it.

    ``greedy``: the greedy plan, where it is known and nothing else is worth trying first.
    """
    plans = {tuple(sorted(greedy))} if greedy else {heuristics.best_found(problem)[0]}
    if smaller:
        plans.add(tuple(sorted(heuristics.greedy(problem, smaller))))
    plan, worth = heuristics.best_of(problem, sorted(plans))
    its = bounds_of(problem, worth)
    alive = np.union1d(np.array(plan, dtype=np.int64), np.concatenate([bound.candidates for bound in its]))
    if len(alive) > len(plan):
        plan = heuristics.swapped(problem.only(alive) if problem.is_plain else problem, plan)
        worth = problem.worth(plan)
    value = max(min(bound.value for bound in its), worth.value)
    return CurvePoint(problem.rules.count, plan, worth, value), its


def bounds_of(problem: Problem, known: Worth) -> Bounds:
    """What no plan exceeds in each term of the objective; ``known`` is the worth of a plan."""
    rules = problem.with_count(problem.rules.count - problem.survives).rules  # whichever is missed, one less is left
    free = np.setdiff1d(problem.candidates, rules.forced).astype(np.int64)
    least = known.value if known.met >= 0.0 else -np.inf
    chosen, candidates = (rules.forced, free) if not problem.survives else ((), problem.candidates)
    return tuple(
        bounds.bounded(
            term, rules, chosen, candidates, known=least, steps=STEPS, threads=problem.threads, enough=ENOUGH
        )
        for term in problem.objective
    )


def in_order(problem: Problem, plan: Plan) -> Plan:
    """A plan's candidates, forced ones first, then each the one that adds most to the joint score."""
    seen = problem.together()
    left = list(plan)
    while left:
        first = [one for one in left if one in problem.rules.forced] or left
        gains = seen.gains(problem.joint, np.array(first, dtype=np.int64))
        seen.add(first[int(np.argmax(gains))])
        left.remove(seen.chosen[-1])
    return tuple(seen.chosen)
