"""What a junction could get: the best plan of 1, 2, ... sensors that is found there, and what none exceeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.city.results.junctions import per_score, vehicles_in
from pipeline.city.running.jobs import Job, Order, told
from pipeline.city.running.keeping import KEPT
from pipeline.core.errors import InputError
from pipeline.placement import asking
from pipeline.placement.asking import Asked
from pipeline.placement.solving import planning
from pipeline.placement.solving.bounds import ROUNDING
from pipeline.placement.solving.problem import Problem
from pipeline.placement.solving.rules import Rules
from pipeline.scenario.models import Scenario
from pipeline.sensing.sites import Site
from pipeline.stages.base import Workspace


@dataclass(frozen=True)
class Pick:
    """One sensor of a plan: what it adds to the joint score of those before it, and to the cost."""

    site: Site
    is_forced: bool
    gain: float
    cost: float


@dataclass(frozen=True)
class Plan:
    """Sensors at one junction, in the order in which they would be put up; their joint score, and what they cost."""

    picks: tuple[Pick, ...]
    value: float
    cost: float

    @property
    def count(self) -> int:
        """How many sensors."""
        return len(self.picks)


@dataclass(frozen=True)
class Options:
    """What one junction could get.

    Attributes
    ----------
    junction
        Its name.
    plans
        Those that were found, of fewest sensors first; the first one holds what is there already, or nothing.
    bounds
        What no plan of at most 0, 1, ... sensors exceeds, as far as plans were looked for.
    least_costs
        What no plan of so many sensors costs less than.
    together
        The joint score of all candidates; no plan exceeds it.
    is_whole
        Whether further sensors would add nothing, or are none.
    """

    junction: str
    plans: tuple[Plan, ...]
    bounds: tuple[float, ...]
    least_costs: tuple[float, ...]
    together: float
    is_whole: bool

    @property
    def most(self) -> int:
        """The number of sensors up to which plans were looked for."""
        return len(self.bounds) - 1

    def bound(self, count: int) -> float:
        """What no plan of at most so many sensors exceeds. Beyond :attr:`most`: m of n sensors of a plan, well chosen,
        are worth at least m/n of it, since gains fall."""
        if count <= self.most:
            return self.bounds[count]
        if self.is_whole:
            return self.bounds[-1]
        return min(self.together, self.bounds[-1] * count / max(1, self.most)) if self.most else self.together

    def times(self, factor: float) -> Options:
        """The same where all that is added up counts so much more."""
        if factor == 1.0:
            return self
        plans = (
            replace(plan, value=plan.value * factor, picks=tuple(replace(p, gain=p.gain * factor) for p in plan.picks))
            for plan in self.plans
        )
        bounds = tuple(bound * factor for bound in self.bounds)
        return replace(self, plans=tuple(plans), bounds=bounds, together=self.together * factor)


def check(scenario: Scenario) -> None:
    """InputError where a scenario asks for what cannot be added up over junctions."""
    wanted = scenario.placement
    idle = {
        "zones": bool(wanted.zones), "survives": bool(wanted.survives), "objective": wanted.objective != "mean",
        "reach": wanted.reach is not None, "refine": wanted.refine is not None, "budget": wanted.budget is not None,
        "count": wanted.count is not None,
    }  # fmt: skip
    if named := [key for key, is_there in idle.items() if is_there]:
        found = "a plan of the whole city adds up joint scores, and shares one count or budget"
        raise InputError(f"{scenario.file}: placement.{named[0]}", found, f"no such key; egvs place {scenario.folder}")


@told
def options(job: Job, order: Order, most: int, costs_count: bool) -> Options:
    """What a junction could get, up to ``most`` sensors; ``costs_count`` asks for what they cost, and for single
    sensors that are cheaper than the best one."""
    with order.obeyed(), KEPT.lent(order.token, job) as built:
        built.bring()
        scenario = built.work.scenario
        check(scenario)
        if costs_count:  # with a budget, somebody has to say what a candidate costs
            placement = scenario.placement.model_copy(update={"budget": _ENDLESS})
            scenario = scenario.model_copy(update={"placement": placement})
        work = Workspace(scenario, built.work.folder, jobs=1)
        factor = per_score(scenario.score.rank_by, vehicles_in(job.out))
        return solved(asking.ask(work, lambda _: None), job.junction, most, singles=costs_count).times(factor)


_ENDLESS = 1e15


def solved(asked: Asked, junction: str, most: int, *, singles: bool = False) -> Options:
    """Plans of up to ``most`` sensors of a problem, whatever they cost; with ``singles`` also those of one sensor of
    which none that is cheaper is worth more."""
    rules = asked.problem.rules
    free = int(np.count_nonzero(~rules.excluded))
    count = min(max(most, len(rules.forced), 1), free)
    problem = replace(asked.problem, rules=replace(rules, budget=np.inf, count=count))
    curve = planning.best(problem, search_all=False, time_limit_s=0.0, heard=lambda _: None).curve
    there = plan_of(problem, asked.sites, rules.forced)
    plans = [there, *(plan_of(problem, asked.sites, planning.in_order(problem, point.plan)) for point in curve)]
    if singles and len(rules.forced) < count:
        plans += [plan_of(problem, asked.sites, (*rules.forced, one)) for one in _cheap(problem)]
    return Options(
        junction,
        tuple(plans),
        (*[there.value] * curve[0].count, *(point.bound for point in curve)),
        least_costs(rules),
        asked.together * (1.0 + ROUNDING),
        count == free or curve[-1].count < count,
    )


def plan_of(problem: Problem, sites: Sequence[Site], chosen: Sequence[int]) -> Plan:
    """Some candidates in an order, with what each adds."""
    seen, rules, picks = problem.together(), problem.rules, []
    value = seen.value(problem.joint)
    for number, one in enumerate(chosen):
        seen.add(one)
        before, value = value, seen.value(problem.joint)
        cost = rules.cost_of(chosen[: number + 1]) - rules.cost_of(chosen[:number])
        picks.append(Pick(sites[one], one in rules.forced, value - before, cost))
    return Plan(tuple(picks), value, rules.cost_of(chosen))


def _cheap(problem: Problem) -> list[int]:
    """Candidates of which none that costs less, or the same, adds more to what is there already."""
    rules = problem.rules
    candidates = np.flatnonzero(rules.may_join(rules.forced))
    gains = problem.together(rules.forced).gains(problem.joint, candidates)
    cost, best, found = rules.further_cost(rules.forced)[candidates], 0.0, []
    for at in np.lexsort((-gains, cost)).tolist():
        if gains[at] > best:
            best = float(gains[at])
            found.append(int(candidates[at]))
    return found


def least_costs(rules: Rules) -> tuple[float, ...]:
    """What no plan of 0, 1, ... sensors costs less than: each is as cheap as any, at poles as cheap as any."""
    others = np.setdiff1d(np.flatnonzero(~rules.excluded), rules.forced)
    alone = np.sort(rules.cost[others]) if rules.most_per_pole == 1 and not rules.forced else None
    sensors = np.sort((rules.cost - rules.pole_cost)[others]) if alone is None else alone
    pole = 0.0 if rules.forced or alone is not None or not len(others) else float(rules.pole_cost[others].min())
    new = np.arange(len(sensors) + 1)
    cost = np.append(0.0, np.cumsum(sensors)) + pole * -(-new // rules.most_per_pole)
    return (*[0.0] * len(rules.forced), *cost.tolist())
