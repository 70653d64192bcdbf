"""From a scenario to the problem that is solved: candidates, their costs, what must be seen.

What cannot be is refused here, with the reason and the nearest that can be had.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.artefacts.readers import Tpog, read_periods, read_tpog
from pipeline.core.errors import InputError
from pipeline.core.grid import Grid
from pipeline.placement import gathering
from pipeline.placement.gathering import TargetView, View, VoxelView
from pipeline.placement.solving import terms
from pipeline.placement.solving.problem import Demand, Problem
from pipeline.placement.solving.rules import Rules
from pipeline.placement.solving.sight import Floats, Ints, Row, Sight
from pipeline.placement.solving.terms import Term
from pipeline.placement.solving.together import Together
from pipeline.scenario.models import Scenario
from pipeline.scenario.placement import ZoneDemand
from pipeline.scoring.visibility import Beams
from pipeline.sensing.sites import Site
from pipeline.sensing.sites import of as sites_of
from pipeline.stages.base import Workspace
from pipeline.stages.shared.scene import scene_of
from pipeline.stages.shared.target_scores import TPOG, Targets

COST = "cost"
"""The column of a sites file that says what a candidate costs."""


_MOST_COST = 1e12
"""Of one candidate: sums of such costs are right to a cent."""


@dataclass(frozen=True, eq=False)
class Asked:
    """A problem, and whose candidates it is about.

    Attributes
    ----------
    sites
        The candidates, in the order of the scenario's sites.
    score
        The name of the joint score.
    views
        What each sight is of, for poses that are no candidates; in the order of :attr:`sights`.
    sights
        What each candidate sees; those of the problem's terms.
    together
        The joint score of all candidates that are not excluded.
    """

    problem: Problem
    sites: tuple[Site, ...]
    score: str
    views: tuple[View, ...]
    sights: tuple[Sight, ...]
    together: float

    def row(self, beams: Beams) -> Row:
        """What an empty scan sees of the cells of the joint score."""
        return self.views[-1].row(beams)

    @property
    def names(self) -> list[str]:
        """Of the candidates."""
        return [site.name for site in self.sites]


def ask(work: Workspace, heard: Callable[[int], None]) -> Asked:
    """What a scenario's ``[placement]`` asks for, on the traffic and the scans of a run's folder.

    Parameters
    ----------
    heard
        Called with how many candidates were looked from.

    Raises
    ------
    InputError
        For names that are no candidates, costs that are not known, and demands that no plan can meet.
    """
    scenario, sites = work.scenario, scene_of(work).sites
    rules = rules_of(scenario, sites)
    names = [period.name for period in read_periods(work.path(TPOG)) if period.name]
    tpogs = [read_tpog(work.path(TPOG)), *(read_tpog(work.path(TPOG), name) for name in names)]
    wanted, zones = scenario.placement, scenario.placement.zones
    score = scenario.score.rank_by
    by_voxel = score in terms.VOXEL_SCORES
    voxels = VoxelView(work, tpogs, scenario.gamma if score == "egvs" else 1.0) if by_voxel or zones else None
    targets = None if by_voxel else Targets(work, tpogs[0].grid)
    seen = None if targets is None else TargetView(work, targets, score)
    views = tuple(view for view in (voxels, seen) if view is not None)
    sights = gathering.gather(work, views, heard)
    if voxels is not None and by_voxel:
        every = [
            terms.voxel_term(name, score, sights[0], tpog, voxels.voxels, scenario.gamma, voxels.unit)
            for name, tpog in zip(["", *names], tpogs, strict=True)
        ]
    else:
        assert targets is not None and seen is not None
        counts = {"": targets.counts, **targets.counts_by_period()}
        every = [terms.target_term(name, score, sights[-1], its, seen.unit) for name, its in counts.items()]
    demands = []
    if voxels is not None:
        demands = [_zone(scenario, name, zone, sights[0], tpogs[0], voxels.voxels) for name, zone in zones.items()]
    objective: tuple[Term, ...] = (every[0],)
    if wanted.objective == "worst":
        chosen = wanted.periods or names
        objective = tuple(_as_share(scenario, term, rules) for term in every if term.name in chosen)
    problem = Problem(every[0], objective, tuple(demands), rules, wanted.survives, work.threads)
    whole = problem.together(problem.candidates.tolist())
    for demand in demands:
        _check_zone(scenario, demand, whole.value(demand.term))
    if not whole.value(problem.joint) > 0.0:
        found = f"all candidates together have a joint score ({score}) of 0, so no plan is better than none"
        right = "candidates that see traffic" + (", or a score.gamma above 0" if score == "egvs" else "")
        raise InputError(f"{scenario.file}: placement", found, right)
    return Asked(problem, sites, score, views, sights, whole.value(problem.joint))


def _as_share(scenario: Scenario, term: Term, rules: Rules) -> Term:
    """A period's score as a share of what all candidates together would have in it, so that quiet periods compare with
    busy ones."""
    together = Together([term], np.flatnonzero(~rules.excluded).tolist()).value(term)
    if not together > 0.0:
        place = f"{scenario.file}: traffic.periods ({term.name})"
        raise InputError(place, "no candidate sees anything of its traffic", 'periods with traffic, or "mean"')
    return replace(term, weight=term.weight / together, exact=lambda totals: term.exact(totals) / together)


def _zone(scenario: Scenario, name: str, zone: ZoneDemand, sight: Sight, tpog: Tpog, voxels: Ints) -> Demand:
    inside = _within(zone.polygon_m, tpog.grid, voxels)
    term = terms.zone_term(name, sight, tpog, voxels, inside, zone.by)
    if not term.weight.any():
        place = f"{scenario.file}: placement.zones.{name}"
        raise InputError(place, "no voxel in it has entropy: no traffic comes and goes there", "a zone with traffic")
    return Demand(term, zone.share)


def _within(polygon_m: Sequence[tuple[float, float]], grid: Grid, voxels: Ints) -> Ints:
    """Those of some voxels whose centre is in a polygon, or on its edge."""
    import shapely

    ix, iy, _ = np.unravel_index(voxels, grid.shape)
    x_m = grid.roi.origin_m[0] + (ix + 0.5) * grid.voxel_m
    y_m = grid.roi.origin_m[1] + (iy + 0.5) * grid.voxel_m
    inside: Ints = voxels[shapely.intersects_xy(shapely.Polygon(polygon_m), x_m, y_m)]
    return inside


def _check_zone(scenario: Scenario, demand: Demand, most: float) -> None:
    """InputError where all candidates together do not see enough of a zone."""
    if demand.unmet(most) > 0.0:
        zone = scenario.placement.zones[demand.term.name]
        by = f" by {zone.by} sensors" if zone.by > 1 else ""
        raise InputError(
            f"{scenario.file}: placement.zones.{demand.term.name}.share",
            f"{zone.share:g}, but all candidates together see {most:.3g} of its entropy{by}",
            f"at most {np.floor(most * 1000) / 1000:g}, or more candidates",
        )


def check(scenario: Scenario) -> None:
    """InputError for what can be refused before anything is simulated."""
    wanted = scenario.placement
    if wanted.count is None and wanted.budget is None and wanted.reach is None:
        right = "--count 3, --budget 120000 or --reach 0.95, or one of them in [placement]"
        raise InputError(f"{scenario.file}: placement", "nothing says how many sensors", right)
    _check_periods(scenario)
    for name, zone in wanted.zones.items():
        _check_where(scenario, name, zone)
    rules_of(scenario, sites_of(scenario))


def _check_periods(scenario: Scenario) -> None:
    """InputError where periods are asked for that the traffic does not have, or that nothing looks at."""
    wanted, names = scenario.placement, [period.name for period in scenario.traffic.periods]
    if wanted.objective == "worst" and not names:
        found = '"worst", but the traffic has no periods'
        raise InputError(f"{scenario.file}: placement.objective", found, '"mean", or [[traffic.periods]]')
    for name in wanted.periods:
        if name not in names:
            right = f"one of {', '.join(names)}" if names else "none, or [[traffic.periods]]"
            raise InputError(f"{scenario.file}: placement.periods", f"no period {name!r}", right)
    if wanted.periods and wanted.objective == "mean":
        found = f'{", ".join(wanted.periods)} with objective = "mean", which is the mix of all'
        raise InputError(f"{scenario.file}: placement.periods", found, 'objective = "worst"')


def _check_where(scenario: Scenario, name: str, zone: ZoneDemand) -> None:
    """InputError for a zone that the region of interest does not reach."""
    import shapely

    (cx, cy, _), (dx, dy, _) = scenario.roi.center_m, scenario.roi.size_m
    ends = cx - dx / 2, cy - dy / 2, cx + dx / 2, cy + dy / 2
    if not shapely.Polygon(zone.polygon_m).intersects(shapely.box(*ends)):
        found = f"all of {name} is outside the region of interest"
        right = f"corners within x {ends[0]:g} to {ends[2]:g} m and y {ends[1]:g} to {ends[3]:g} m"
        raise InputError(f"{scenario.file}: placement.zones.{name}.polygon_m", found, right)


def rules_of(scenario: Scenario, sites: Sequence[Site]) -> Rules:
    """The rules that ``[placement]`` and ``[costs]`` set for some candidates."""
    wanted, place = scenario.placement, f"{scenario.file}: placement"
    names = [site.name for site in sites]
    poles: dict[str, int] = {}
    pole = np.array([poles.setdefault(site.pole or site.name, len(poles)) for site in sites], dtype=np.int64)
    forced = tuple(_index(name, names, f"{place}.forced") for name in wanted.forced)
    excluded = np.zeros(len(sites), dtype=np.bool_)
    for name in wanted.excluded:
        if name in poles and name not in names:
            excluded |= pole == poles[name]
        else:
            excluded[_index(name, names, f"{place}.excluded")] = True
    if both := [names[i] for i in forced if excluded[i]]:
        raise InputError(f"{place}.forced", f"{both[0]}, whose pole is excluded", "one of them")
    free = int(np.count_nonzero(~excluded))
    if not free:
        raise InputError(f"{place}.excluded", "every candidate is excluded", "fewer of them")
    if wanted.count is not None and wanted.count > free:
        what = "candidates" if free == len(sites) else f"candidates that are not excluded (of {len(sites)})"
        raise InputError(f"{place}.count", f"{wanted.count} sensors of {free} {what}", f"at most {free}")
    if wanted.count is not None and wanted.count < len(forced):
        raise InputError(f"{place}.count", f"{wanted.count}, but {len(forced)} are forced", f"at least {len(forced)}")
    cost, pole_cost = costs_of(scenario, sites)
    cost[list(forced)] = pole_cost[list(forced)] = 0.0
    rules = Rules(
        count=wanted.count if wanted.count is not None else free,
        budget=wanted.budget if wanted.budget is not None else np.inf,
        cost=cost,
        pole_cost=pole_cost,
        pole=pole,
        forced=forced,
        excluded=excluded,
        most_per_pole=wanted.most_per_pole or len(sites),
        position_m=np.array([site.pose.position_m for site in sites]).reshape(-1, 3),
        least_distance_m=wanted.least_distance_m,
    )
    _check_forced(rules, names, place)
    return rules


def _index(name: str, names: list[str], place: str) -> int:
    if name not in names:
        raise InputError(
            place, f"no candidate {name!r}", f"one of {', '.join(names[:20])}{', ...' * (len(names) > 20)}"
        )
    return names.index(name)


def costs_of(scenario: Scenario, sites: Sequence[Site]) -> tuple[Floats, Floats]:
    """What each candidate costs, and what of it is for its pole."""
    costs, has_budget = scenario.costs, scenario.placement.budget is not None
    cost, pole_cost = np.zeros(len(sites)), np.zeros(len(sites))
    file = scenario.sites.file or scenario.file
    for i, site in enumerate(sites):
        own = site.own.get(COST)
        if own is not None:
            if isinstance(own, bool) or not isinstance(own, int | float) or not own >= 0:
                right = "a number, 0 or above, in digits: 8000, not 8e3"
                raise InputError(f"{file}: site {site.name}: {COST}", repr(own)[:80], right)
            _check_cost(f"{file}: site {site.name}: {COST}", float(own))
            cost[i] = own
            continue
        if has_budget and not costs.are_given:
            right = f"[costs], or a column {COST} in the sites file"
            raise InputError(f"{scenario.file}: placement.budget", f"nothing says what {site.name} costs", right)
        if costs.sensor and site.sensor not in costs.sensor:
            found = f"nothing says what {site.sensor} of {site.name} costs"
            raise InputError(f"{scenario.file}: costs.sensor", found, f'"{site.sensor}" = its price')
        cost[i] = costs.sensor.get(site.sensor, 0.0) + costs.pole + costs.metre * site.pose.z_m
        pole_cost[i] = costs.pole
        _check_cost(f"{scenario.file}: costs ({site.name})", float(cost[i]))
    return cost, pole_cost


def _check_cost(place: str, cost: float) -> None:
    """InputError for a cost so large that sums of costs lose the small ones, or overflow."""
    if not cost <= _MOST_COST:
        raise InputError(place, f"{cost:g}", f"at most {_MOST_COST:g}, in a larger unit of money")


def _check_forced(rules: Rules, names: list[str], place: str) -> None:
    """InputError where forced candidates break the rules, or nothing else can be had for the budget."""
    if not rules.keeps(rules.forced):
        which = ", ".join(names[i] for i in rules.forced)
        right = "fewer of them, more per pole, or a smaller distance"
        raise InputError(f"{place}.forced", f"{which} break most_per_pole or least_distance_m", right)
    if not rules.forced and np.isfinite(rules.budget) and not rules.may_join(()).any():
        cheapest = int(np.argmin(np.where(rules.excluded, np.inf, rules.cost)))
        right = f"at least {rules.cost[cheapest]:g}, what {names[cheapest]} costs"
        raise InputError(f"{place}.budget", f"{rules.budget:g} is below the cheapest candidate", right)


def reaching(problem: Problem, share: float, together: float) -> Demand:
    """That a share of what all candidates together reach is reached."""
    return Demand(problem.joint, share * together)
