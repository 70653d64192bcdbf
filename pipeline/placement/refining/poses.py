"""A plan whose sensors need not hang as a candidate does: what they see together, and by which rules.

It is a problem of its own whose only candidates are the sensors of the plan, so that its worth, its cost and what it
loses are worked out as those of every plan.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from pipeline.placement.asking import Asked, costs_of
from pipeline.placement.solving.problem import Problem, Worth
from pipeline.placement.solving.rules import Rules
from pipeline.placement.solving.sight import Row, Sight
from pipeline.placement.solving.terms import Term
from pipeline.scenario.models import Scenario
from pipeline.sensing.sites import Site

POLES_APART_M = 1.0
"""A pole moves no nearer than this to another one of the plan, or than it stood to begin with."""

Rows = tuple[Row, ...]
"""What one sensor sees, one row a view."""


@dataclass(frozen=True, eq=False)
class Poses:
    """A plan of poses.

    Attributes
    ----------
    scenario, asked
        Whose costs and rules hold.
    plan
        The candidate that each sensor comes from.
    sites
        Where each is now.
    rows
        What each sees from there.
    """

    scenario: Scenario
    asked: Asked
    plan: tuple[int, ...]
    sites: tuple[Site, ...]
    rows: tuple[Rows, ...]

    @classmethod
    def of(cls, scenario: Scenario, asked: Asked, plan: Sequence[int]) -> Poses:
        """As the candidates hang."""
        rows = tuple(tuple(sight.row(candidate) for sight in asked.sights) for candidate in plan)
        return cls(scenario, asked, tuple(plan), tuple(asked.sites[candidate] for candidate in plan), rows)

    def with_sensor(self, number: int, site: Site, rows: Rows) -> Poses:
        """The same with one of its sensors elsewhere."""
        sites, every = list(self.sites), list(self.rows)
        sites[number], every[number] = site, rows
        return replace(self, sites=tuple(sites), rows=tuple(every))

    def keeps_rules(self, sites: Sequence[Site]) -> bool:
        """Whether its sensors might hang so: budget, distances; poles that did not stand together stay apart."""
        return self._rules(sites).keeps(range(len(sites))) and not self._crowded(sites)

    @cached_property
    def problem(self) -> Problem:
        """Whose candidates are its sensors, in their order."""
        asked, views = self.asked, zip(*self.rows, strict=True)
        numbers = [sight.number for sight in asked.sights]
        sights = [Sight.of(rows, number) for rows, number in zip(views, numbers, strict=True)]
        now = {id(old): new for old, new in zip(asked.sights, sights, strict=True)}
        terms: dict[int, Term] = {id(term): replace(term, sight=now[id(term.sight)]) for term in asked.problem.terms}
        return replace(
            asked.problem,
            joint=terms[id(asked.problem.joint)],
            objective=tuple(terms[id(term)] for term in asked.problem.objective),
            demands=tuple(replace(its, term=terms[id(its.term)]) for its in asked.problem.demands),
            rules=self._rules(self.sites),
        )

    @cached_property
    def worth(self) -> Worth:
        """Of all its sensors."""
        return self.problem.worth(range(len(self.sites)))

    def _rules(self, sites: Sequence[Site]) -> Rules:
        rules, mine = self.asked.problem.rules, list(self.plan)
        forced = [number for number, candidate in enumerate(mine) if candidate in rules.forced]
        cost, pole_cost = costs_of(self.scenario, sites)
        cost[forced] = pole_cost[forced] = 0.0
        return replace(
            rules,
            count=len(mine),
            cost=cost,
            pole_cost=pole_cost,
            pole=rules.pole[mine],
            forced=tuple(forced),
            excluded=np.zeros(len(mine), dtype=np.bool_),
            position_m=np.array([site.pose.position_m for site in sites]).reshape(-1, 3),
        )

    def _crowded(self, sites: Sequence[Site]) -> bool:
        """Whether two poles are nearer than they may be."""
        first = [self.asked.sites[candidate] for candidate in self.plan]
        pole = self.asked.problem.rules.pole[list(self.plan)]
        return any(
            pole[a] != pole[b] and _apart_m(sites[a], sites[b]) < min(POLES_APART_M, _apart_m(first[a], first[b]))
            for a in range(len(sites))
            for b in range(a)
        )


def _apart_m(one: Site, other: Site) -> float:
    """In plan."""
    return math.hypot(one.pose.x_m - other.pose.x_m, one.pose.y_m - other.pose.y_m)
