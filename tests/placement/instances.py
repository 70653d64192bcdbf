"""Small random problems of all kinds, and their solutions by trying all subsets in plain Python."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace

import numpy as np

from egvs.kernels.submodular import CAPPED, LOGARITHM, SATURATING
from egvs.placement.problem import CoverageTerm, Demand, PlanRules, Problem, VisibilityMatrix, VisibilityRow


@dataclass(frozen=True)
class Instance:
    """A problem, and the hits that it was made of."""

    problem: Problem
    hits: np.ndarray
    """(candidates, cells) int64."""


def make_matrix(hits: np.ndarray, max_amount: int = 2**62) -> VisibilityMatrix:
    """Return the visibility matrix of hits (candidates, cells)."""
    return VisibilityMatrix.of((VisibilityRow.of(row, max_amount) for row in hits), hits.shape[1])


def make_term(
    name: str,
    visibility: VisibilityMatrix,
    weight: np.ndarray,
    *,
    curve: int = CAPPED,
    scale: float = 3.0,
    each_once: bool = False,
) -> CoverageTerm:
    """Return a term whose exact value is that of :func:`math.fsum`."""
    max_total = int(np.bincount(visibility.cells, visibility.amounts).max(initial=0))
    values = np.array([curve_value(curve, scale, total) for total in range(max_total + 1)])

    def exact(totals: np.ndarray) -> float:
        return math.fsum((weight * values[totals]).tolist())

    return CoverageTerm(name, visibility, weight, curve, scale, each_once, exact)


def curve_value(curve: int, scale: float, total: int) -> float:
    """Return f(total) by the formula."""
    if curve == CAPPED:
        return min(float(total), scale)
    return math.log(1 + total / scale) if curve == LOGARITHM else 1 - math.exp(-total / scale)


def draw_problem(seed: int) -> Instance:
    """Return a problem with 4 to 7 candidates and up to 15 cells.

    Some have forced or excluded candidates, costs, shared poles, distances, zones, several records, or survive a
    failure; all curves occur.
    """
    rng = np.random.default_rng(seed)
    n, cells = int(rng.integers(4, 8)), int(rng.integers(3, 16))
    hits = rng.integers(0, 6, (n, cells)) * (rng.random((n, cells)) < rng.uniform(0.2, 0.9))
    visibility = make_matrix(hits)
    curve = int(rng.choice([CAPPED, CAPPED, LOGARITHM, SATURATING]))
    scale, once = float(rng.choice([0.5, 1.0, 2.5, 4.0, np.inf if curve == CAPPED else 7.0])), bool(rng.random() < 0.3)
    records = [
        make_term(
            f"r{i}", visibility, rng.random(cells) * (rng.random(cells) < 0.8), curve=curve, scale=scale, each_once=once
        )
        for i in range(2)
    ]
    mix = make_term("", visibility, records[0].weight + records[1].weight, curve=curve, scale=scale, each_once=once)
    objective = tuple(records) if rng.random() < 0.25 else (mix,)
    some = rng.permutation(n)
    forced = tuple(int(i) for i in some[: rng.choice([0, 0, 0, 1])])
    excluded = np.zeros(n, dtype=bool)
    excluded[some[len(forced) :][: rng.choice([0, 0, 1])]] = True
    pole = rng.integers(0, max(2, n - 2), n)
    cost = rng.integers(1, 9, n).astype(float)
    pole_cost = np.minimum(cost, rng.integers(0, 3, n)).astype(float)
    cost[list(forced)] = pole_cost[list(forced)] = 0.0
    budget = float(rng.integers(6, 20)) if rng.random() < 0.4 else np.inf
    near = float(rng.choice([0.0, 0.0, 0.35]))
    at = np.column_stack([rng.random((n, 2)), np.full(n, 3.0)])
    rules = PlanRules(
        count=int(rng.integers(max(1, len(forced)), 5)), budget=budget, cost=cost, pole_cost=pole_cost, pole=pole,
        forced=forced, excluded=excluded, most_per_pole=int(rng.choice([1, 2, n])), position_m=at,
        least_distance_m=near,
    )  # fmt: skip
    demands = ()
    if rng.random() < 0.3:
        zone = rng.random(cells) * (rng.random(cells) < 0.4)
        zone = zone / zone.sum() if zone.any() else zone
        share = make_term("zone", visibility, zone, scale=1.0, each_once=True)
        demands = (Demand(share, float(rng.uniform(0.2, 0.8))),) if zone.any() else ()
    return Instance(Problem(mix, objective, demands, rules, int(rng.random() < 0.15)), hits)


def draw_degenerate_problem(seed: int) -> Instance:
    """Return a problem with 1 to 9 candidates, many of them equal or blind.

    Some have caps of 0 or infinity, records without traffic, only forced candidates, no costs, budgets that are sums of
    decimals, zones that two sensors must see, or counts above the number of candidates.
    """
    rng = np.random.default_rng(10_000 + seed)
    n, cells = int(rng.integers(1, 10)), int(rng.integers(1, 25))
    kinds = rng.integers(0, 4, (max(1, n // int(rng.integers(1, 4))), cells)) * (rng.random((1, cells)) < 0.7)
    hits = kinds[rng.integers(0, len(kinds), n)] * (rng.random(n) < 0.85)[:, None]
    visibility, curve = make_matrix(hits), int(rng.choice([CAPPED, CAPPED, LOGARITHM, SATURATING]))
    scale = float(rng.choice([0.0, 1.0, 2.5, np.inf])) if curve == CAPPED else 3.0
    weight = rng.integers(0, 3, cells) * rng.choice([1.0, 0.1, 0.0])
    records = [
        make_term(f"r{i}", visibility, weight * (rng.random(cells) < 0.6), curve=curve, scale=scale) for i in range(2)
    ]
    mix = make_term("", visibility, records[0].weight + records[1].weight, curve=curve, scale=scale)
    objective = tuple(records) if rng.random() < 0.25 else (mix,)
    forced = tuple(rng.permutation(n)[: int(rng.choice([0, 0, 1, n]))].tolist())
    excluded = rng.random(n) < 0.15
    excluded[list(forced)] = False
    cost = rng.choice([0.0, 0.1, 0.2, 0.3, 0.7], n)
    pole_cost = np.minimum(cost, rng.choice([0.0, 0.1, 0.2], n))
    cost[list(forced)] = pole_cost[list(forced)] = 0.0
    rules = PlanRules(
        count=int(rng.integers(max(1, len(forced)), n + 4)), budget=float(rng.choice([np.inf, 0.1 + 0.2, 0.3, 0.9])),
        cost=cost, pole_cost=pole_cost, pole=rng.integers(0, n, n), forced=forced, excluded=excluded,
        most_per_pole=int(rng.choice([1, 2, n])), position_m=rng.integers(0, 3, (n, 3)).astype(float),
        least_distance_m=float(rng.choice([0.0, 0.0, 1.0])),
    )  # fmt: skip
    zone, demands = rng.integers(0, 2, cells).astype(float), ()
    if rng.random() < 0.3 and zone.any():
        demands = (Demand(_zone_share(visibility, zone, int(rng.choice([1, 2]))), float(rng.choice([0.25, 0.5, 1.0]))),)
    return Instance(Problem(mix, objective, demands, rules, int(rng.random() < 0.2)), hits)


def _zone_share(visibility: VisibilityMatrix, zone: np.ndarray, sensors: int) -> CoverageTerm:
    """Return the share of a zone's cells that so many sensors see, and the weights of a sum that is an upper bound."""
    term = make_term("zone", visibility, zone / (zone.sum() * sensors), scale=float(sensors), each_once=True)
    return replace(term, exact=lambda totals: float(zone[totals >= sensors].sum() / zone.sum()))


def all_plans(problem: Problem):
    """Yield all subsets that keep the rules, which are written out here."""
    rules, n = problem.rules, len(problem.rules.cost)
    for size in range(rules.count + 1):
        for plan in itertools.combinations(range(n), size):
            if _keeps_rules(rules, plan):
                yield plan


def _keeps_rules(rules: PlanRules, plan: tuple[int, ...]) -> bool:
    if not set(rules.forced) <= set(plan) or any(rules.excluded[i] for i in plan):
        return False
    on_pole: dict[int, list[int]] = {}
    for i in plan:
        on_pole.setdefault(int(rules.pole[i]), []).append(i)
    if any(len(group) > rules.most_per_pole for group in on_pole.values()):
        return False
    for i, j in itertools.combinations(plan, 2):
        if math.dist(rules.position_m[i], rules.position_m[j]) < rules.least_distance_m:
            return False
    total = 0.0
    for group in on_pole.values():
        total += sum(float(rules.cost[i] - rules.pole_cost[i]) for i in group)
        if not set(group) & set(rules.forced):
            total += max(float(rules.pole_cost[i]) for i in group)
    return total <= rules.budget + 1e-9


def value_of(problem: Problem, plan: tuple[int, ...], hits: np.ndarray) -> tuple[bool, float]:
    """Return whether a plan meets the demands, and its value, by the definitions."""

    def term_value(term: CoverageTerm, subset: tuple[int, ...]) -> float:
        rows = hits[list(subset)] > 0 if term.each_once else hits[list(subset)]
        return term.exact(rows.sum(axis=0).astype(int))

    is_met = all(term_value(demand.term, plan) >= demand.least * (1 - 1e-12) for demand in problem.demands)
    subsets = [plan]
    if problem.survives:
        subsets = [tuple(j for j in plan if j != i) for i in plan]
    values = [min(term_value(term, subset) for term in problem.objective) for subset in subsets]
    return is_met, min(values, default=0.0)
