"""Build the placement problem of a scenario: objective, zones, rules, costs, and the visibility of all candidates.

The empty scans of the candidates are read, or cast, one after another; only a sparse row of each is kept in memory. A
row is computed exactly as the site's own score is, so a plan of one sensor has the score of that site.

Requests that no plan can meet raise an :class:`InputError` that names the nearest request that can be met.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from egvs.artefacts.tpog import Tpog, read_periods, read_tpog
from egvs.core.errors import InputError, choose_one
from egvs.core.grid import FloatArray, Grid, IntArray
from egvs.core.threads import map_ordered
from egvs.core.wording import list_first
from egvs.effects.base import Detect
from egvs.placement import problem
from egvs.placement.problem import CoverageTerm, Demand, PlanRules, Problem, VisibilityMatrix, VisibilityRow
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import COST_COLUMN, DEFAULT_SCORE, ZoneDemand, is_plugin_score
from egvs.scoring.scorer import ever_occupied
from egvs.scoring.target_scores import TARGET_SCORES
from egvs.scoring.targets import VisibleTargets
from egvs.scoring.visibility import Beams, HitCounter
from egvs.scoring.zones import placement_zones, region_bounds_m
from egvs.sensors.sensor import check_sensor_names
from egvs.sensors.sites import Site, candidate_sites, pole_exists
from egvs.stages.base import StageContext
from egvs.stages.site_scans import SiteScan, empty_scans
from egvs.stages.site_scoring import TargetScorer

if TYPE_CHECKING:
    from shapely.geometry.base import BaseGeometry

_MAX_COST = 1e12
"""Maximum cost of one candidate: sums of such costs are accurate to 0.01."""

_MAX_WHOLE_HITS = 2**32 - 1
_MAX_WEIGHTED_HITS = 2**62
"""The largest counts of whole beams, and of beam shares (in a smaller unit), that a hit counter holds."""

_POINT_UNIT = 2.0**32
"""Expected numbers of points are rounded to multiples of 1 / _POINT_UNIT."""

_MAX_PROBABILITY = 1.0 - 2.0**-53


class VoxelView:
    """Turn empty scans into hits of the voxels that matter; may be shared by threads.

    Parameters
    ----------
    context
        The run.
    tpogs
        Occupancy of all traffic, then of each period, on one grid.
    max_beams
        Cap on the beams of a voxel; may be infinite.
    """

    def __init__(self, context: StageContext, tpogs: Sequence[Tpog], max_beams: float) -> None:
        self.voxels: IntArray = ever_occupied(tpogs)
        self._counter = HitCounter(context.scene, tpogs[0], context.folder.trajectories)
        self.unit = self._counter.unit
        cap = max_beams * self.unit
        largest_count = _MAX_WHOLE_HITS if self.unit == 1 else _MAX_WEIGHTED_HITS
        self._max_hits = math.ceil(cap) if cap < largest_count else largest_count

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return len(self.voxels)

    def row(self, beams: Beams) -> VisibilityRow:
        """Return the capped hit counts of a scan in the voxels."""
        hits = self._counter.borrowed_hits(beams, self.voxels)
        return VisibilityRow.of(hits[self.voxels], max(1, self._max_hits))


class TargetView:
    """Turn empty scans into amounts on vehicle-frames, as a score counts them; may be shared by threads.

    Parameters
    ----------
    context
        The run.
    targets
        The vehicles.
    score
        The score.
    detectors
        Detectors whose probabilities are averaged; those of the scenario when None.
    """

    def __init__(
        self, context: StageContext, targets: TargetScorer, score: str, detectors: Sequence[str] | None = None
    ) -> None:
        self.targets = targets
        self.context = context
        self._score = score
        self._detectors = targets.detectors if detectors is None else tuple(detectors)
        scene = context.scene
        self._has_chances = score == DEFAULT_SCORE or is_plugin_score(score)
        if self._has_chances:
            self.unit = problem.CHANCE_UNIT
        elif scene.weights_beams or scene.acting(Detect, "score"):
            self.unit = _POINT_UNIT
        else:
            self.unit = 1.0

    @property
    def n_cells(self) -> int:
        """Number of cells."""
        return len(self.targets.record)

    def without_each_detector(self) -> list[TargetView]:
        """Return one view for each detector of the score, by all the others; empty for a score of one, or of none."""
        if self._score != DEFAULT_SCORE or len(self._detectors) < 2:
            return []
        others = [[other for other in self._detectors if other != left_out] for left_out in self._detectors]
        return [TargetView(self.context, self.targets, self._score, names) for names in others]

    def row(self, beams: Beams) -> VisibilityRow:
        """Return the amounts of a scan on all vehicle-frames."""
        amounts = self._amounts(self.targets.visible(beams))
        return VisibilityRow.of(np.rint(amounts * self.unit).astype(np.int64), _MAX_WEIGHTED_HITS)

    def _amounts(self, visible: VisibleTargets) -> FloatArray:
        if not self._has_chances:
            return visible.points
        probability = np.minimum(TARGET_SCORES[self._score](visible, self._detectors), _MAX_PROBABILITY)
        return -np.log1p(-probability)


View = VoxelView | TargetView


class VoxelObjective:
    """A score over voxels.

    Parameters
    ----------
    context
        The run; its scenario names the score.
    tpogs
        Occupancy by period; "" is all traffic and comes first.
    """

    def __init__(self, context: StageContext, tpogs: Mapping[str, Tpog]) -> None:
        self._score = context.scenario.score.rank_by
        self._gamma = context.scenario.gamma
        self._tpogs = tpogs
        max_beams = self._gamma if self._score == "egvs" else 1.0
        self.view = VoxelView(context, list(tpogs.values()), max_beams)

    def terms(self, visibility: VisibilityMatrix) -> dict[str, CoverageTerm]:
        """Return the term of each period; "" is all traffic and comes first."""
        return {
            name: problem.voxel_term(name, self._score, visibility, tpog, self.view.voxels, self._gamma, self.view.unit)
            for name, tpog in self._tpogs.items()
        }


class DetectionObjective:
    """A score over vehicle-frames.

    Parameters
    ----------
    context
        The run; its scenario names the score.
    grid
        The grid of the TPOG.
    """

    def __init__(self, context: StageContext, grid: Grid) -> None:
        self._score = context.scenario.score.rank_by
        self._targets = TargetScorer(context, grid)
        self.view = TargetView(context, self._targets, self._score)

    def terms(self, visibility: VisibilityMatrix) -> dict[str, CoverageTerm]:
        """Return the term of each period; "" is all traffic and comes first."""
        counts_by_period = {"": self._targets.weight, **self._targets.weights_by_period()}
        return {
            name: problem.target_term(name, self._score, visibility, counts, self.view.unit)
            for name, counts in counts_by_period.items()
        }


def make_objective(context: StageContext, tpogs: Mapping[str, Tpog]) -> VoxelObjective | DetectionObjective:
    """Return the objective for the score that ``score.rank_by`` names."""
    if context.scenario.score.rank_by in problem.VOXEL_SCORES:
        return VoxelObjective(context, tpogs)
    return DetectionObjective(context, tpogs[""].grid)


@dataclass(frozen=True, eq=False)
class PlacementProblem:
    """A placement problem with the candidates and the score that it was built from.

    Attributes
    ----------
    problem
        The problem to solve.
    sites
        The candidates, in the order of the scenario's sites.
    score
        Name of the joint score.
    views
        What turns scans into the rows of each visibility matrix, in the order of :attr:`visibilities`. The last one
        belongs to the joint score.
    visibilities
        Visibility matrices of the candidates.
    joint_of_all
        Joint score of all candidates that are not excluded.
    """

    problem: Problem
    sites: tuple[Site, ...]
    score: str
    views: tuple[View, ...]
    visibilities: tuple[VisibilityMatrix, ...]
    joint_of_all: float

    def row(self, beams: Beams) -> VisibilityRow:
        """Return the visibility of an empty scan in the cells of the joint score."""
        return self.views[-1].row(beams)

    @property
    def names(self) -> list[str]:
        """Candidate names, in file order."""
        return [site.name for site in self.sites]


def build_problem(context: StageContext, on_progress: Callable[[int], None]) -> PlacementProblem:
    """Build the problem of ``[placement]`` from the traffic and the scans in a run's folder.

    Parameters
    ----------
    context
        The run; the stages up to the TPOG and the scans are up to date.
    on_progress
        Called with the number of candidates whose scan has been processed.

    Raises
    ------
    InputError
        For unknown candidates or periods, unknown costs, and demands that no plan can meet.
    """
    scenario = context.scenario
    sites = context.scene.sites
    rules = rules_from_config(scenario, sites)
    tpogs = read_tpogs(context)

    objective = make_objective(context, tpogs)
    views: tuple[View, ...] = (objective.view,)
    zone_view: VoxelView | None = None
    if isinstance(objective, VoxelObjective):
        zone_view = objective.view
    elif scenario.placement.zones:
        zone_view = VoxelView(context, list(tpogs.values()), 1.0)
        views = (zone_view, objective.view)
    visibilities = visibility_matrices(context, views, on_progress)

    demands: list[Demand] = []
    if zone_view is not None:
        areas = placement_zones(scenario)
        for name, zone in scenario.placement.zones.items():
            where = scenario.locate(f"placement.zones.{name}")
            inside = _voxels_in_area(areas[name], tpogs[""].grid, zone_view.voxels)
            term = problem.zone_term(name, visibilities[0], tpogs[""], zone_view.voxels, inside, zone.by)
            demands.append(_zone_demand(term, zone, where))
    terms = objective.terms(visibilities[-1])
    placement_problem = Problem(
        joint=terms[""],
        objective=_objective_terms(scenario, terms, rules),
        demands=tuple(demands),
        rules=rules,
        survives=scenario.placement.survives,
        threads=context.threads,
    )

    all_candidates = placement_problem.coverage_state(placement_problem.candidates.tolist())
    for demand in demands:
        _check_zone_reachable(scenario, demand, all_candidates.value(demand.term))
    joint_of_all = all_candidates.value(placement_problem.joint)
    score = scenario.score.rank_by
    if not joint_of_all > 0.0:
        hint = "Add candidates that see traffic."
        if score == "egvs":
            hint = "Add candidates that see traffic, or set score.gamma above 0."
        raise InputError(f"{scenario.file}: placement", f"the joint score ({score}) of all candidates is 0", hint)
    return PlacementProblem(placement_problem, sites, score, views, visibilities, joint_of_all)


def read_tpogs(context: StageContext) -> dict[str, Tpog]:
    """Return the occupancy of all traffic, as "", then of each named period."""
    path = context.folder.tpog
    names = [period.name for period in read_periods(path) if period.name]
    tpogs = {"": read_tpog(path)}
    for name in names:
        tpogs[name] = read_tpog(path, name)
    return tpogs


def visibility_matrices(
    context: StageContext,
    views: Sequence[View],
    on_progress: Callable[[int], None],
    only: Collection[str] | None = None,
) -> tuple[VisibilityMatrix, ...]:
    """Return one visibility matrix per view, over the candidates of a scenario. Each scan is read once.

    Parameters
    ----------
    context
        The run.
    views
        What turns a scan into rows.
    on_progress
        Called with the number of processed candidates.
    only
        Names of the candidates; all when None.
    """
    builders = [problem.VisibilityMatrixBuilder(view.n_cells) for view in views]

    def rows_of(scan: SiteScan) -> list[VisibilityRow]:
        return [view.row(scan.beams) for view in views]

    all_rows = map_ordered(rows_of, empty_scans(context, only), context.threads)
    for number, rows in enumerate(all_rows, start=1):
        for builder, row in zip(builders, rows, strict=True):
            builder.add(row)
        on_progress(number)
    return tuple(builder.build() for builder in builders)


def _objective_terms(
    scenario: Scenario, terms: Mapping[str, CoverageTerm], rules: PlanRules
) -> tuple[CoverageTerm, ...]:
    """The joint score, or the scores of the periods whose smallest one is maximised."""
    placement = scenario.placement
    if placement.objective != "worst":
        return (terms[""],)
    periods = placement.periods or [name for name in terms if name]
    return tuple(_as_share(scenario, term, rules) for name, term in terms.items() if name in periods)


def _as_share(scenario: Scenario, term: CoverageTerm, rules: PlanRules) -> CoverageTerm:
    """A period's score as a share of the score of all candidates, so that quiet and busy periods compare."""
    allowed = np.flatnonzero(~rules.excluded).tolist()
    total = problem.CoverageState([term], allowed).value(term)
    if not total > 0.0:
        where = f"{scenario.file}: traffic.periods ({term.name})"
        raise InputError(
            where,
            "no candidate sees any of its traffic",
            'Use periods with traffic, or set placement.objective to "mean".',
        )
    return replace(term, weight=term.weight / total, exact=lambda totals: term.exact(totals) / total)


def _zone_demand(term: CoverageTerm, zone: ZoneDemand, where: str) -> Demand:
    """Return the demand of a zone; InputError when there is nothing to see in it."""
    if not term.weight.any():
        raise InputError(where, "no voxel in this zone has entropy", "Move the zone to where vehicles come and go.")
    return Demand(term, zone.share)


def _voxels_in_area(area: BaseGeometry, grid: Grid, voxels: IntArray) -> IntArray:
    """Voxels whose centre is in an area or on its edge."""
    import shapely

    ix, iy, _ = np.unravel_index(voxels, grid.shape)
    x_m = grid.roi.origin_m[0] + (ix + 0.5) * grid.voxel_m
    y_m = grid.roi.origin_m[1] + (iy + 0.5) * grid.voxel_m
    inside: IntArray = voxels[shapely.intersects_xy(area, x_m, y_m)]
    return inside


def _check_zone_reachable(scenario: Scenario, demand: Demand, reachable: float) -> None:
    """Raise InputError if all candidates together do not see enough of a zone."""
    if not demand.unmet(reachable) > 0.0:
        return
    zone = scenario.placement.zones[demand.term.name]
    sensors = f" by {zone.by} sensors" if zone.by > 1 else ""
    raise InputError(
        scenario.locate(f"placement.zones.{demand.term.name}.share"),
        f"expected a share that the candidates can reach, got {zone.share:g}: with all of them,"
        f" {reachable:.3g} of the zone's entropy is seen{sensors}",
        f"Set it to at most {np.floor(reachable * 1000) / 1000:g}, or add candidates.",
    )


def check_placement_config(scenario: Scenario) -> None:
    """Raise InputError for all that can be rejected before anything is simulated."""
    placement = scenario.placement
    if placement.count is None and placement.budget is None and placement.reach is None:
        hint = "Give --count 3, --budget 120000 or --reach 0.95, or one of these keys in [placement]."
        raise InputError(f"{scenario.file}: placement", "the number of sensors is not limited", hint)
    _check_periods(scenario)
    for name, area in placement_zones(scenario).items():
        _check_zone_in_roi(scenario, name, area)
    rules_from_config(scenario, candidate_sites(scenario))


def _check_periods(scenario: Scenario) -> None:
    """Raise InputError for periods that the traffic does not have, or that would have no effect."""
    placement = scenario.placement
    names = [period.name for period in scenario.traffic.periods]
    if placement.objective == "worst" and not names:
        raise InputError(
            scenario.locate("placement.objective"),
            'expected "mean", since the traffic has no periods, got "worst"',
            'Set it to "mean", or add [[traffic.periods]].',
        )
    where = scenario.locate("placement.periods")
    for name in placement.periods:
        if name not in names:
            hint = "Remove the key, or add [[traffic.periods]]."
            if names:
                hint = f"Use one of {', '.join(names)}."
            raise InputError(where, f"no period {name!r}", hint)
    if placement.periods and placement.objective == "mean":
        periods = ", ".join(placement.periods)
        problem_text = f'the key has no effect with objective = "mean", which mixes all periods (got {periods})'
        raise InputError(where, problem_text, 'Set placement.objective to "worst", or remove the key.')


def _check_zone_in_roi(scenario: Scenario, name: str, area: BaseGeometry) -> None:
    """Raise InputError for a zone outside the region of interest."""
    import shapely

    (west_m, south_m), (east_m, north_m) = region_bounds_m(scenario)
    if area.intersects(shapely.box(west_m, south_m, east_m, north_m)):
        return
    key = "polygon_m" if scenario.placement.zones[name].file is None else "file"
    raise InputError(
        scenario.locate(f"placement.zones.{name}.{key}"),
        f"zone {name} is outside the region of interest",
        f"Use corners within x {west_m:g} to {east_m:g} m and y {south_m:g} to {north_m:g} m.",
    )


def rules_from_config(scenario: Scenario, sites: Sequence[Site]) -> PlanRules:
    """Return the rules that ``[placement]`` and ``[costs]`` set for candidates.

    Raises
    ------
    InputError
        For names that are no candidates, unknown costs, and rules that contradict each other.
    """
    placement = scenario.placement
    table = f"{scenario.file}: placement"
    names = [site.name for site in sites]
    pole_index: dict[str, int] = {}
    for site in sites:
        pole_index.setdefault(site.pole or site.name, len(pole_index))
    pole = np.array([pole_index[site.pole or site.name] for site in sites], dtype=np.int64)

    forced = tuple(_candidate_index(name, sites, f"{table}.forced") for name in placement.forced)
    excluded = np.zeros(len(sites), dtype=np.bool_)
    for name in placement.excluded:
        if name in pole_index and name not in names:
            excluded |= pole == pole_index[name]
        else:
            excluded[_candidate_index(name, sites, f"{table}.excluded")] = True
    for candidate in forced:
        if excluded[candidate]:
            problem_text = f"{names[candidate]} is forced, but it or its pole is excluded"
            raise InputError(
                f"{table}.forced",
                problem_text,
                "Remove it from placement.forced, or remove it or its pole from placement.excluded.",
            )

    n_allowed = int(np.count_nonzero(~excluded))
    if not n_allowed:
        raise InputError(f"{table}.excluded", "every candidate is excluded", "Exclude fewer of them.")
    _check_count(scenario, n_allowed, len(sites), len(forced))

    cost, pole_cost = candidate_costs(scenario, sites)
    cost[list(forced)] = 0.0
    pole_cost[list(forced)] = 0.0
    rules = PlanRules(
        count=n_allowed if placement.count is None else placement.count,
        budget=np.inf if placement.budget is None else placement.budget,
        cost=cost,
        pole_cost=pole_cost,
        pole=pole,
        forced=forced,
        excluded=excluded,
        most_per_pole=placement.most_per_pole or len(sites),
        position_m=np.array([site.pose.position_m for site in sites]).reshape(-1, 3),
        least_distance_m=placement.least_distance_m,
    )
    _check_rules(rules, names, table)
    return rules


def _candidate_index(name: str, sites: Sequence[Site], where: str) -> int:
    """Return the index of a candidate by its name, or by that of its pole if it is the only one there."""
    names = [site.name for site in sites]
    if name in names:
        return names.index(name)
    on_pole = [number for number, site in enumerate(sites) if site.pole == name]
    if len(on_pole) == 1:
        return on_pole[0]
    if on_pole:
        listed = list_first([names[number] for number in on_pole], 8)
        raise InputError(where, f"pole {name!r} has {len(on_pole)} candidates", f"Choose one of {listed}.")
    poles = dict.fromkeys(site.pole or site.name for site in sites)
    raise InputError(where, f"no candidate or pole {name!r}", choose_one(name, list(poles)))


def _check_count(scenario: Scenario, n_allowed: int, n_sites: int, n_forced: int) -> None:
    """Raise InputError for a count above the candidates or below the forced sensors."""
    where = scenario.locate("placement.count")
    count = scenario.placement.count
    if count is None:
        return
    if count > n_allowed:
        excluded = f" ({n_sites - n_allowed} excluded)" if n_allowed < n_sites else ""
        problem_text = f"expected at most {n_allowed}, the number of candidates{excluded}, got {count}"
        raise InputError(where, problem_text, "Lower the count, or add candidates.")
    if count < n_forced:
        problem_text = f"expected at least {n_forced}, the number of forced sensors, got {count}"
        raise InputError(where, problem_text, "Raise the count, or force fewer sensors.")


def _check_rules(rules: PlanRules, names: list[str], table: str) -> None:
    """Raise InputError if forced candidates break the rules, or if the budget buys nothing."""
    if not rules.allows(rules.forced):
        forced_names = ", ".join(names[i] for i in rules.forced)
        raise InputError(
            f"{table}.forced",
            f"{forced_names} break most_per_pole or least_distance_m",
            "Force fewer of them, allow more sensors per pole, or lower the distance.",
        )
    if not rules.forced and np.isfinite(rules.budget) and not rules.allowed_additions(()).any():
        cheapest = int(np.argmin(np.where(rules.excluded, np.inf, rules.cost)))
        raise InputError(
            f"{table}.budget",
            f"expected at least {rules.cost[cheapest]:g}, the cost of {names[cheapest]}, got {rules.budget:g}",
            "Raise the budget.",
        )


def candidate_costs(scenario: Scenario, sites: Sequence[Site]) -> tuple[FloatArray, FloatArray]:
    """Return the cost of each candidate, and the part of it that pays for the pole, both (n,).

    Raises
    ------
    InputError
        For a cost that is unknown although there is a budget, of an unknown sensor, that is not a number, or that is
        too large.
    """
    costs = scenario.costs
    known = dict.fromkeys([*(site.sensor for site in sites), *scenario.sensors])
    check_sensor_names(costs.sensor, known, scenario.locate("costs.sensor"))
    has_budget = scenario.placement.budget is not None
    sites_file = scenario.sites.file or scenario.file
    cost = np.zeros(len(sites))
    pole_cost = np.zeros(len(sites))
    for i, site in enumerate(sites):
        column_value = site.user_columns.get(COST_COLUMN)
        if column_value is not None:
            where = f"{sites_file}: site {site.name}: {COST_COLUMN}"
            if isinstance(column_value, bool) or not isinstance(column_value, int | float) or not column_value >= 0:
                problem_text = f"expected a number, 0 or above, got {repr(column_value)[:80]}"
                raise InputError(where, problem_text, "Write it in digits: 8000, not 8e3.")
            _check_cost(where, float(column_value))
            cost[i] = column_value
            continue

        if has_budget and not costs.are_given:
            column = f', or a column "{COST_COLUMN}" to {scenario.sites.file}' if scenario.sites.file else ""
            hint = f"Add a [costs] table{column}."
            raise InputError(scenario.locate("placement.budget"), f"the cost of site {site.name} is unknown", hint)
        if costs.sensor and site.sensor not in costs.sensor:
            problem_text = f"the cost of sensor {site.sensor} (site {site.name}) is unknown"
            raise InputError(scenario.locate("costs.sensor"), problem_text, f'Add "{site.sensor}" = COST.')
        exists = pole_exists(site.pole, scenario.sites.existing_poles)
        cost[i] = costs.of_mount(site.sensor, site.pose.z_m, pole_exists=exists)
        pole_cost[i] = 0.0 if exists else costs.pole
        _check_cost(f"{scenario.file}: costs ({site.name})", float(cost[i]))
    return cost, pole_cost


def _check_cost(where: str, cost: float) -> None:
    """Raise InputError for a cost so large that sums of costs lose the small ones, or overflow."""
    if not cost <= _MAX_COST:
        raise InputError(where, f"expected at most {_MAX_COST:g}, got {cost:g}", "Use a larger currency unit.")
