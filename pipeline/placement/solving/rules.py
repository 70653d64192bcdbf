"""What a plan may be: how many sensors, at what cost, which poles, how near to one another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipeline.placement.solving.sight import Floats, Ints

Mask = NDArray[np.bool_]

_COINS = 1e-9
"""Costs are sums of decimal numbers: a budget is exceeded by more than this share of it."""


@dataclass(frozen=True, eq=False)
class Rules:
    """What holds for every plan over n candidates.

    Attributes
    ----------
    count
        Sensors at most.
    budget
        Cost at most; infinite where none is given.
    cost
        Of each candidate alone, (n,) float64, 0 or above; 0 for one that is there already.
    pole_cost
        What of it is for the pole, (n,) float64: not paid again where another sensor hangs there.
    pole
        Which pole each hangs at, (n,) int64.
    forced
        Candidates that are part of every plan.
    excluded
        Which are part of none, (n,) bool.
    most_per_pole
        Sensors at one pole.
    position_m
        Where each is, (n, 3) float64.
    least_distance_m
        Between any two.
    """

    count: int
    budget: float
    cost: Floats
    pole_cost: Floats
    pole: Ints
    forced: tuple[int, ...]
    excluded: Mask
    most_per_pole: int
    position_m: Floats
    least_distance_m: float

    def cost_of(self, chosen: Sequence[int]) -> float:
        """Of a plan; a pole is paid for once, and not where a forced candidate stands."""
        mine = list(chosen)
        return float((self.cost - self.pole_cost)[mine].sum() + self._paid(mine).sum())

    def further_cost(self, chosen: Sequence[int]) -> Floats:
        """What each candidate would cost beside a plan, (n,)."""
        paid = self._paid(list(chosen))
        paid[self.pole[list(self.forced)]] = np.inf
        return self.cost - self.pole_cost + np.maximum(self.pole_cost - paid[self.pole], 0.0)

    def _paid(self, chosen: list[int]) -> Floats:
        """What a plan pays for each pole, (poles,)."""
        paid = np.zeros(int(self.pole.max(initial=-1)) + 1)
        np.maximum.at(paid, self.pole[chosen], self.pole_cost[chosen])
        paid[self.pole[list(self.forced)]] = 0.0
        return paid

    @property
    def most_sensors(self) -> int:
        """No plan has more: by the count, the candidates and what the cheapest ones cost."""
        cheapest = np.sort((self.cost - self.pole_cost)[~self.excluded])
        affordable = int(np.searchsorted(np.cumsum(cheapest), self.budget * (1.0 + _COINS), side="right"))
        return max(1, min(self.count, affordable))

    def may_join(self, chosen: Sequence[int]) -> Mask:
        """Which candidates may be added to a plan that keeps the rules, (n,)."""
        may: Mask = ~self.excluded
        mine = list(chosen)
        if len(mine) >= self.count:
            return np.zeros_like(may)
        may[mine] = False
        if mine:
            poles, used = np.unique(self.pole[mine], return_counts=True)
            may &= ~np.isin(self.pole, poles[used >= self.most_per_pole])
            if self.least_distance_m > 0.0:
                away = np.sqrt(((self.position_m[:, None] - self.position_m[mine][None]) ** 2).sum(axis=2))
                may &= (away >= self.least_distance_m).all(axis=1)
        if np.isfinite(self.budget):
            may &= self.cost_of(mine) + self.further_cost(mine) <= self.budget * (1.0 + _COINS)
        return may

    def keeps(self, chosen: Sequence[int]) -> bool:
        """Whether a plan keeps the rules, the forced candidates among them; in any order."""
        if not set(self.forced) <= set(chosen):
            return False
        return all(self.may_join(chosen[:i])[candidate] for i, candidate in enumerate(chosen))

    def most(self, gains: Floats, candidates: Ints, chosen: Sequence[int]) -> tuple[float, Ints, Floats]:
        """No less than the largest sum of gains that candidates may add to ``chosen``: the smaller one of two, each
        with some rules left out. Also which candidates make it up, and what share of each, (m,) both.

        Parameters
        ----------
        gains
            Of ``candidates``, (k,) float64, 0 or above.
        """
        left = self.count - len(chosen)
        order = np.argsort(-gains, kind="stable")
        if self.most_per_pole < len(self.cost):
            order = order[self._first_of_poles(self.pole[candidates[order]], chosen)]
        picked = order[: max(left, 0)]
        by_count = float(gains[picked].sum())
        if not np.isfinite(self.budget) or not len(candidates):
            return by_count, candidates[picked], np.ones(len(picked))
        cost, left_over = self._least_cost(candidates, chosen), self.budget * (1 + _COINS) - self.cost_of(chosen)
        with np.errstate(divide="ignore", invalid="ignore"):
            worth = np.where(cost > 0.0, gains / cost, np.inf)
        order = np.argsort(-worth, kind="stable")
        before = np.cumsum(cost[order]) - cost[order]
        room = np.clip(left_over - before, 0.0, cost[order])
        share = np.divide(room, cost[order], out=np.ones(len(order)), where=cost[order] > 0.0)
        by_cost = float((gains[order] * share).sum())
        if by_count <= by_cost:
            return by_count, candidates[picked], np.ones(len(picked))
        taken = share > 0.0
        return by_cost, candidates[order[taken]], share[taken]

    def _first_of_poles(self, pole: Ints, chosen: Sequence[int]) -> Mask:
        """Which of some candidates, given by their poles, are among the first that have room at theirs."""
        order = np.argsort(pole, kind="stable")
        ordered, number = pole[order], np.empty(len(pole), dtype=np.int64)
        number[order] = np.arange(len(pole)) - np.searchsorted(ordered, ordered)
        if not chosen:
            return number < self.most_per_pole
        poles, used = np.unique(self.pole[list(chosen)], return_counts=True)
        at = np.minimum(np.searchsorted(poles, pole), len(poles) - 1)
        number = number + np.where(poles[at] == pole, used[at], 0)
        return number < self.most_per_pole

    def _least_cost(self, candidates: Ints, chosen: Sequence[int]) -> Floats:
        """No more than each adds to the cost of any plan."""
        if self.most_per_pole > 1:
            return (self.cost - self.pole_cost)[candidates]
        return self.further_cost(chosen)[candidates]
