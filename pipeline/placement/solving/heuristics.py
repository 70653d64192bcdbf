"""Finds good plans: greedily, from several starts, then by swaps until none helps.

For a count alone the greedy plan is worth at least 1 - 1/e of the best one (Nemhauser, Wolsey and Fisher 1978). With
costs, the better one of greedy by gain and greedy by gain per cost is worth at least (1 - 1/e) / 2 of it (Leskovec et
al. 2007); so starts from every single candidate are tried too where that is cheap. For the worst of several records
sums are cut off at a level that is searched for (Krause et al. 2008).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import astuple

import numpy as np

from pipeline.placement.solving.problem import Problem, Worth
from pipeline.placement.solving.sight import Floats, Ints
from pipeline.placement.solving.together import Together

Each = tuple[Floats, Floats, Floats]
"""See :meth:`Problem.with_each`."""

Guide = Callable[[Together, Ints, Each], tuple[Floats, ...]]
"""Of a plan, some candidates, and what it is worth with each: what they are chosen by, the most important last."""

Plan = tuple[int, ...]

_STARTS = 40
"""Candidates up to which a plan is begun with each of them, where costs differ."""

_SWAPPED = 20
"""Plans that swaps are tried on, the best ones."""

_LEVELS = 12
"""Levels that are tried for the worst of several records."""


def best_found(problem: Problem) -> tuple[Plan, Worth]:
    """The best plan of all heuristics, sorted."""
    plans = {tuple(sorted(plan)) for plan in _starts(problem)}
    promising = sorted(sorted(plans, key=shorter), key=problem.worth, reverse=True)[:_SWAPPED]
    improved = {swapped(problem, plan) for plan in promising}
    return best_of(problem, sorted(improved))


def best_of(problem: Problem, plans: Sequence[Plan]) -> tuple[Plan, Worth]:
    """The best of some plans; of equals the one of fewest sensors, and the first in the order of candidates."""
    worths = [(plan, problem.worth(plan)) for plan in plans]
    most = max(worth for _, worth in worths)
    return min((plan for plan, worth in worths if worth == most), key=shorter), most


def shorter(plan: Plan) -> tuple[int, Plan]:
    """What plans that are worth the same are ordered by."""
    return len(plan), plan


def greedy(problem: Problem, start: Plan = (), guide: Guide | None = None) -> Plan:
    """One candidate after another, each the best by ``guide`` (by default by what the plan is then worth), in the order
    in which they were chosen; until the rules or the gains end it."""
    seen = problem.together(tuple(dict.fromkeys((*problem.rules.forced, *start))))
    if guide is None and problem.is_plain:
        return _lazy(problem, seen)
    while len(candidates := np.flatnonzero(problem.rules.may_join(seen.chosen))):
        each, now = problem.with_each(seen, candidates), problem.worth_of(seen)
        if not any((its > was + _NOTHING * abs(was)).any() for its, was in zip(each, astuple(now), strict=True)):
            break
        order = np.lexsort((-candidates, *(each[::-1] if guide is None else guide(seen, candidates, each))))
        seen.add(int(candidates[order[-1]]))
    return tuple(seen.chosen)


def _lazy(problem: Problem, seen: Together) -> Plan:
    """The greedy plan by Minoux's lazy evaluation (1978): a gain is never larger than it was for a smaller plan, so
    only candidates whose last known gain is large enough are asked again."""
    known = np.full(len(problem.rules.cost), np.inf)
    while len(candidates := np.flatnonzero(problem.rules.may_join(seen.chosen))):
        best, asked = (0.0, -1), 0
        order = candidates[np.argsort(-known[candidates], kind="stable")]
        while asked < len(order) and known[order[asked]] >= best[0]:
            batch = order[asked : asked + (_BATCH if np.isfinite(known[order[0]]) else len(order))]
            known[batch] = seen.gains(problem.joint, batch)
            at = batch[np.lexsort((batch, -known[batch]))[0]]
            best = max(best, (float(known[at]), -int(at)))
            asked += len(batch)
        if not best[0] > seen.value(problem.joint) * _NOTHING:
            break
        seen.add(-best[1])
    return tuple(seen.chosen)


_BATCH = 16
"""Candidates that are asked at once."""

_NOTHING = 1e-12
"""A gain by this share or less is none."""


def _starts(problem: Problem) -> list[Plan]:
    plans = [greedy(problem)]
    rules = problem.rules
    if np.isfinite(rules.budget):
        plans.append(greedy(problem, guide=_by_cost(problem)))
        if len(problem.candidates) <= _STARTS:
            for first in np.flatnonzero(rules.may_join(rules.forced)).tolist():
                plans += [greedy(problem, (first,)), greedy(problem, (first,), _by_cost(problem))]
    if len(problem.objective) > 1:
        plans += _by_levels(problem)
    return plans


def _by_cost(problem: Problem) -> Guide:
    def guide(seen: Together, candidates: Ints, each: Each) -> tuple[Floats, ...]:
        met, value, joint = each
        cost = problem.rules.further_cost(seen.chosen)[candidates]
        worth = problem.worth_of(seen)
        with np.errstate(divide="ignore", invalid="ignore"):
            gain = np.where(cost > 0.0, np.maximum(value - worth.value, 0.0) / cost, np.inf)
            towards = np.where(cost > 0.0, (met - worth.met) / cost, met - worth.met)
        return joint, gain, towards

    return guide


def _by_levels(problem: Problem) -> list[Plan]:
    """Plans for the worst of several records: greedy on the sum of all, each cut off at a level."""
    every, plans = problem.together(problem.candidates.tolist()), []
    low, high = 0.0, min(every.value(term) for term in problem.objective)
    for _ in range(_LEVELS):
        level = 0.5 * (low + high)

        def guide(seen: Together, candidates: Ints, each: Each, level: float = level) -> tuple[Floats, ...]:
            met, _, joint = each
            values = [seen.value(term) + seen.gains(term, candidates) for term in problem.objective]
            return joint, np.sum([np.minimum(value, level) for value in values], axis=0), met

        plan = greedy(problem, guide=guide)
        plans.append(plan)
        seen = problem.together(plan)
        if min(seen.value(term) for term in problem.objective) >= level:
            low = level
        else:
            high = level
    return plans


def swapped(problem: Problem, plan: Plan) -> Plan:
    """A plan after swaps (one out, the best one in; or one in where there is room) until none helps, sorted."""
    rules, best, worth = problem.rules, tuple(sorted(plan)), problem.worth(plan)
    improved = True
    while improved:
        improved = False
        for out in (None, *(one for one in best if one not in rules.forced)):
            rest = tuple(one for one in best if one != out)
            found = _best_addition(problem, rest, out)
            if found is not None and found[1] > worth and rules.keeps(found[0]):
                best, worth, improved = *found, True
                break
    return best


def _best_addition(problem: Problem, rest: Plan, out: int | None) -> tuple[Plan, Worth] | None:
    """A plan with the best candidate added, other than ``out``."""
    candidates = np.flatnonzero(problem.rules.may_join(rest))
    candidates = candidates[candidates != (-1 if out is None else out)]
    if not len(candidates):
        return None
    seen = problem.together(rest)
    met, value, joint = problem.with_each(seen, candidates)
    chosen = int(candidates[np.lexsort((-candidates, joint, value, met))[-1]])
    seen.add(chosen)
    return tuple(sorted((*rest, chosen))), problem.worth_of(seen)
