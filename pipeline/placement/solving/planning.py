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
        Whether it is proved that there is no better plan; by its bound alone, none that is better by more than the
        bound's rounding.
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
    rules, nodes, is_best = problem.rules, 0, False
    if np.isinf(rules.budget):
        curve, its = _curve(problem, rules.most_sensors, heard)
        last = curve.pop()
    else:  # how many sensors a budget is best spent on, the plan tells
        curve = []
        last, its = _point(problem.with_count(rules.most_sensors), ())
    if search_all:
        found = exact.search(problem, last.plan, its, time_limit_s=time_limit_s)
        assert found.plan is not None
        nodes, is_best = found.nodes, found.is_whole
        last = replace(last, plan=found.plan, worth=found.worth, bound=min(last.bound, found.bound))
    if not np.isinf(rules.budget):
        curve, last = _below(problem, last, heard)
    is_best = is_best or last.certificate >= 1.0
    return Solution(in_order(problem, last.plan), (*curve, last), nodes, is_best)


def fewest(problem: Problem, *, time_limit_s: float, heard: Heard) -> Solution | None:
    """The plan of the fewest sensors that meets all demands; None where none was found within the rules."""
    until = perf_counter() + time_limit_s
    curve: list[CurvePoint] = []
    its: list[Bounds] = []
    for count in range(_least(problem), problem.rules.most_sensors + 1):
        smaller = curve[-1].plan if curve else ()
        point, bound = _point(problem.with_count(count), smaller)
        curve.append(point)
        its.append(bound)
        heard(count)
        if point.worth.met >= 0.0:
            break
        if len(curve) > 1 and point.plan == smaller and len(smaller) < count - 1:
            return None  # no sensor may join, or none helps
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


def _curve(problem: Problem, most: int, heard: Heard) -> tuple[list[CurvePoint], Bounds]:
    """Plans of 1, 2, ..., ``most`` sensors, or up to where no further one adds anything; and what bounds the last."""
    points: list[CurvePoint] = []
    its: Bounds = ()
    greedy = heuristics.greedy(problem) if problem.is_plain and np.isinf(problem.rules.budget) else ()
    for count in range(_least(problem), most + 1):
        point, its = _point(problem.with_count(count), points[-1].plan if points else (), greedy[:count])
        points.append(point)
        heard(count)
        if problem.is_plain and not _gains_any(problem, point.plan):
            break
    return points, its


def _least(problem: Problem) -> int:
    """The smallest number of sensors that plans are told for."""
    return max(1, len(problem.rules.forced))


def _below(problem: Problem, last: CurvePoint, heard: Heard) -> tuple[list[CurvePoint], CurvePoint]:
    """Plans of fewer sensors than one within a budget; and that one, or a better one that was met among them."""
    curve, _ = _curve(problem, len(last.plan) - 1, heard)
    better = [point for point in curve if point.worth > last.worth]
    if better:
        top = max(better, key=lambda point: point.worth)
        last = replace(last, plan=top.plan, worth=top.worth, bound=max(last.bound, top.worth.value))
    count = max(_least(problem), len(last.plan))
    return [point for point in curve if point.count < count], replace(last, count=count)


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
    seen, found = problem.together(chosen), []
    for term in problem.objective:
        its = bounds.bounded(
            term, rules, chosen, candidates, known=least, steps=STEPS, threads=problem.threads, enough=ENOUGH
        )
        most = rules.most(seen.gains(term, candidates), candidates, chosen)[0]  # exact for one sensor more
        top = (seen.value(term) + most) * (1.0 + bounds.ROUNDING)
        found.append(replace(its, value=max(min(its.value, top), least)))
    return tuple(found)


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
