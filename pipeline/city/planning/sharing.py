"""Shares one count, or one budget, among junctions, and says what is proved of it.

Junctions are independent of one another, so a city's joint score is the sum of theirs, and all that is to be decided is
which of its plans each junction gets: a knapsack with one choice a junction, solved exactly by dynamic programming. For
a count that takes junctions times count squared steps. Were every junction's gains falling, taking the largest gain
again and again would give the same; plans of more sensors need not hold those of fewer, so it is not taken for granted.

What no plan exceeds is the same knapsack over the junctions' bounds; for a budget its relaxation, in which the last
step may be taken in part (Sinha and Zoltners 1979).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pipeline.city.planning.options import Options

Floats = NDArray[np.float64]

_MOST_STATES = 100_000
"""Costs that are told apart on the way to a budget; of more, those of a hundred-thousandth of it are taken for one,
the best of them."""

_COINS = 1e-9
"""Costs are sums of decimal numbers: a budget is exceeded by more than this share of it."""


@dataclass(frozen=True)
class Shared:
    """Which plan each junction gets.

    Attributes
    ----------
    chosen
        Index into :attr:`Options.plans` of each junction, in their order.
    value
        The sum of joint scores.
    bound
        What no plan of the city exceeds.
    curve
        Of a count: the best sum and the bound for 0, 1, ... sensors, (count + 1, 2) float64; empty for a budget.
    """

    chosen: tuple[int, ...]
    value: float
    bound: float
    curve: Floats


def by_count(junctions: Sequence[Options], count: int) -> Shared:
    """The best choice of at most ``count`` sensors in all, those that are there already among them."""
    best, choice = np.full(count + 1, -math.inf), []
    best[:] = 0.0
    for its in junctions:
        tried = np.full((len(its.plans), count + 1), -math.inf)
        for number, plan in enumerate(its.plans):
            if plan.count <= count:
                tried[number, plan.count :] = best[: count + 1 - plan.count] + plan.value
        choice.append(tried.argmax(axis=0))
        best = tried.max(axis=0)
    chosen, left = [], count
    for its, of in zip(reversed(junctions), reversed(choice), strict=True):
        chosen.append(int(of[left]))
        left -= its.plans[chosen[-1]].count
    bounds = np.maximum(_bounds_by_count(junctions, count), best)
    return Shared(tuple(reversed(chosen)), float(best[-1]), float(bounds[-1]), np.column_stack([best, bounds]))


def _bounds_by_count(junctions: Sequence[Options], count: int) -> Floats:
    best = np.zeros(count + 1)
    for its in junctions:
        bound = np.array([its.bound(number) for number in range(min(count, len(its.least_costs) - 1) + 1)])
        more = np.full(count + 1, -math.inf)
        for number, value in enumerate(bound.tolist()):
            more[number:] = np.maximum(more[number:], best[: count + 1 - number] + value)
        best = more
    return best


def by_budget(junctions: Sequence[Options], budget: float) -> Shared:
    """The best choice that costs no more than ``budget`` in all."""
    limit = budget * (1.0 + _COINS)
    costs, values = np.zeros(1), np.zeros(1)
    steps: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []
    for its in junctions:
        cost = (costs[None, :] + np.array([plan.cost for plan in its.plans])[:, None]).ravel()
        value = (values[None, :] + np.array([plan.value for plan in its.plans])[:, None]).ravel()
        kept = _not_beaten(cost, value, limit)
        steps.append((kept // len(costs), kept % len(costs)))
        costs, values = cost[kept], value[kept]
    at, chosen = len(values) - 1, []
    for plan, before in reversed(steps):
        chosen.append(int(plan[at]))
        at = int(before[at])
    value = float(values[-1])
    return Shared(tuple(reversed(chosen)), value, max(value, relaxed(junctions, limit)), np.empty((0, 2)))


def _not_beaten(cost: Floats, value: Floats, limit: float) -> NDArray[np.int64]:
    """Those within the limit of which none that costs no more is worth as much, by ascending cost."""
    order = np.lexsort((-value, cost))
    order = order[cost[order] <= limit]
    best = np.maximum.accumulate(np.append(-math.inf, value[order]))
    kept = order[value[order] > best[:-1]]
    if len(kept) > _MOST_STATES:
        bucket = np.floor(cost[kept] / limit * _MOST_STATES)
        kept = kept[np.append(bucket[1:] != bucket[:-1], True)]  # the last of each is worth most
    return kept


def relaxed(junctions: Sequence[Options], limit: float) -> float:
    """What no choice within a limit of cost exceeds: each junction's bounds over least costs, made concave, taken step
    by step, the steepest first, the last one in part."""
    total, steps = 0.0, []
    for its in junctions:
        points = _hull([(cost, its.bound(number)) for number, cost in enumerate(its.least_costs) if cost <= limit])
        total += points[0][1]
        steps += [(b[1] - a[1], b[0] - a[0]) for a, b in pairwise(points)]
    left = limit
    for gain, cost in sorted(steps, key=lambda step: -step[0] / step[1]):
        share = min(1.0, left / cost)
        total += share * gain
        left -= share * cost
        if not left > 0.0:
            break
    return total


def _hull(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The upper hull of (cost, value), from the cheapest on, as far as it rises."""
    best: dict[float, float] = {}
    for cost, value in points:
        best[cost] = max(value, best.get(cost, -math.inf))
    hull: list[tuple[float, float]] = []
    for cost, value in sorted(best.items()):
        if hull and value <= hull[-1][1]:
            continue
        while len(hull) > 1 and _turns_up(hull[-2], hull[-1], (cost, value)):
            hull.pop()
        hull.append((cost, value))
    return hull


def _turns_up(a: tuple[float, float], b: tuple[float, float], c: tuple[float, float]) -> bool:
    """Whether b lies on or below the line from a to c."""
    return (b[1] - a[1]) * (c[0] - a[0]) <= (c[1] - a[1]) * (b[0] - a[0])
