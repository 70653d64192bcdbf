"""What is asked of a plan: what it should see, what it must see, by which rules; and how two plans compare."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.placement.solving.rules import Rules
from pipeline.placement.solving.sight import Floats, Ints
from pipeline.placement.solving.terms import Term
from pipeline.placement.solving.together import Together


@dataclass(frozen=True, eq=False)
class Demand:
    """``term`` must reach ``least``."""

    term: Term
    least: float

    def unmet(self, reached: Floats | float) -> Floats:
        """What share of it is not reached, 0 to 1."""
        missing = np.maximum(self.least - np.asarray(reached), 0.0)
        share: Floats = (
            np.where(missing > _ROUNDING * self.least, missing / self.least, 0.0) if self.least else 0 * missing
        )
        return share


_ROUNDING = 1e-12


@dataclass(frozen=True, order=True)
class Worth:
    """What a plan is worth; the greater one is better: first that demands are met, then ``value``, then ``joint``.

    Attributes
    ----------
    met
        Minus the sum of what share of each demand is not met; 0 where all are.
    value
        What is asked for: the joint score; the smallest one of several records; what is left when any sensor fails.
    joint
        The joint score of the traffic as a whole.
    """

    met: float
    value: float
    joint: float


@dataclass(frozen=True, eq=False)
class Problem:
    """What is asked of a plan.

    Attributes
    ----------
    joint
        The joint score of the traffic as a whole.
    objective
        The sums of which the smallest one should be as large as can be; most often ``joint`` alone.
    demands
        What must be reached.
    rules
        Count, cost, poles.
    survives
        How many sensors may fail: 1 where the objective is what is left without the one that is missed most.
    threads
        For gains.
    """

    joint: Term
    objective: tuple[Term, ...]
    demands: tuple[Demand, ...]
    rules: Rules
    survives: int = 0
    threads: int = 1

    @property
    def terms(self) -> tuple[Term, ...]:
        """Every sum that plans are asked for, each once."""
        every = {id(term): term for term in (self.joint, *self.objective, *(its.term for its in self.demands))}
        return tuple(every.values())

    @property
    def candidates(self) -> Ints:
        """Those that may be part of a plan."""
        return np.flatnonzero(~self.rules.excluded).astype(np.int64)

    @property
    def is_plain(self) -> bool:
        """Whether one sum is asked for, and nothing else must be reached."""
        return len(self.objective) == 1 and not self.demands and not self.survives

    def with_count(self, count: int) -> Problem:
        """The same with so many sensors at most."""
        return replace(self, rules=replace(self.rules, count=count))

    def only(self, candidates: Iterable[int]) -> Problem:
        """The same with these candidates alone."""
        excluded = np.ones_like(self.rules.excluded)
        excluded[list(candidates)] = False
        return replace(self, rules=replace(self.rules, excluded=excluded | self.rules.excluded))

    def together(self, chosen: Sequence[int] = ()) -> Together:
        """A set of candidates, for all that is asked for."""
        return Together(self.terms, chosen, self.threads)

    def worth(self, chosen: Sequence[int]) -> Worth:
        """Of a plan."""
        return self.worth_of(self.together(chosen))

    def worth_of(self, seen: Together) -> Worth:
        """Of a plan at work."""
        met = -sum(float(demand.unmet(seen.value(demand.term))) for demand in self.demands)
        value = min(seen.value(term) for term in self.objective)
        if self.survives:
            value = min(self._without_each(seen), default=0.0)
        return Worth(met, value, seen.value(self.joint))

    def _without_each(self, seen: Together) -> list[float]:
        """What is left of the objective without each sensor of a plan."""
        left = []
        for candidate in list(seen.chosen):
            seen.remove(candidate)
            left.append(min(seen.value(term) for term in self.objective))
            seen.add(candidate)
        return left

    def with_each(self, seen: Together, candidates: Ints) -> tuple[Floats, Floats, Floats]:
        """Of a plan with each of some candidates added: what is met, what it is worth, the joint score, (n,) each, as
        in :class:`Worth`; off by rounding, and for demands of several sensors never below the truth."""
        met = np.zeros(len(candidates))
        for demand in self.demands:
            reached = self.relaxed(seen, demand.term) + seen.gains(demand.term, candidates)
            met -= demand.unmet(reached)
        joint = seen.value(self.joint) + seen.gains(self.joint, candidates)
        if not self.survives:
            return met, joint if self.objective == (self.joint,) else self._smallest(seen, candidates), joint
        value = np.full(len(candidates), min(seen.value(term) for term in self.objective))
        for candidate in list(seen.chosen):
            seen.remove(candidate)
            value = np.minimum(value, self._smallest(seen, candidates))
            seen.add(candidate)
        return met, value, joint

    def _smallest(self, seen: Together, candidates: Ints) -> Floats:
        values = [seen.value(term) + seen.gains(term, candidates) for term in self.objective]
        smallest: Floats = np.min(values, axis=0)
        return smallest

    @staticmethod
    def relaxed(seen: Together, term: Term) -> float:
        """The sum that is never below a demand's term; the term itself where one sensor is enough."""
        if term.scale <= 1.0 or not term.each_once:
            return seen.value(term)
        return float((term.weight * np.minimum(seen.totals(term), term.scale)).sum())
