"""Refine a plan: move its sensors within their freedom, one at a time, by CMA-ES on the exact joint score.

Steps of one turn: all other sensors stay; poses of one sensor are proposed; a pose is rejected if it breaks a rule of
the plan, lies in a lane or a junction, or cannot be scanned (in a solid, below the ground); otherwise the exact value
of the plan is computed from a new empty scan. The best pose is kept, so the value never drops. Turns go round until no
sensor improves the plan by :data:`MIN_IMPROVEMENT`.

What a sensor may do (:class:`Freedom`) is a box with one axis from 0 to 1 per free quantity: the position along a line
of sites, in a circle or in a polygon; the height above the ground, so that a pole that moves on a slope keeps its
length; the angles. An unlimited yaw is periodic. Positions are rounded to millimetres and angles to hundredths of a
degree: nobody mounts a sensor more precisely. World frame.

The optimiser first spreads a quarter of the evaluations at random over the box. The covariance matrix adaptation
evolution strategy (Hansen and Ostermeier 2001; library ``cma``) then starts twice, with half of the remaining
evaluations each: at the current pose and at the best of the random points.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, FloatArray
from egvs.core.threads import map_ordered
from egvs.placement.problem import Plan, PlanRules, PlanValue, Problem, VisibilityMatrix, VisibilityRow
from egvs.placement.problem_builder import PlacementProblem, candidate_costs
from egvs.scenario.model import Scenario, SiteLine
from egvs.scenario.score_config import RefinementConfig
from egvs.scoring.visibility import Beams
from egvs.sensors import site_feasibility
from egvs.sensors.scanner import Scanner
from egvs.sensors.sites import Pose, Site, candidate_sites, wrap_deg
from egvs.stages.base import StageContext
from egvs.traffic import sumo_folder
from egvs.world.carriageway import Carriageway
from egvs.world.mesh import World

if TYPE_CHECKING:
    from shapely import LineString
    from shapely.geometry.base import BaseGeometry

VisibilityRows = tuple[VisibilityRow, ...]
"""Visibility of one sensor, one row per view of the problem."""

GroundHeight = Callable[[float, float], float]
"""From x, y to z of the ground there, world frame, in metres."""

LossFunction = Callable[[FloatArray], FloatArray]
"""From points (n, axes) to their losses (n,), float64 and finite."""

BoxEnds = tuple[list[float | None], list[float | None]]
"""Lower and upper end of each axis of a box; None for a periodic axis."""

MIN_IMPROVEMENT = 1e-3
"""A turn that improves the plan by less than this share is kept, but the other sensors get no further turn for it."""

MIN_POLE_DISTANCE_M = 1.0
"""Poles come no closer to each other than this, or than they were at first."""

_ALONG_AXIS = "along_m"
_ON_LINE_M = 1e-6
"""A pole is on a line if it is no further from it."""
_LENGTH_DIGITS = 3
_ANGLE_DIGITS = 2
_CIRCLE_MARGIN_M = 10.0**-_LENGTH_DIGITS
"""A pole stays this far inside its circle, so that rounding does not move it out."""

_RANDOM_SHARE = 0.25
"""Share of the evaluations that are spread at random over the box."""

_INITIAL_STEP = 0.15
"""Default of the initial standard deviation of CMA-ES, as a share of the sides of the box."""

_JOINT_WEIGHT = 1e-3
"""Weight of the joint score beside the objective in the loss of a pose."""

_INFEASIBLE_LOSS = 1e6
"""Loss of an impossible pose: above the loss of every other."""


@dataclass(frozen=True)
class Axis:
    """A quantity that may change.

    Attributes
    ----------
    name
        A field of :class:`egvs.sensors.sites.Pose`, or the distance along a line. ``z_m`` counts from the ground,
        ``roll_deg`` from upside down for a sensor that is (:attr:`egvs.sensors.sites.Pose.side_tilt_deg`).
    low, high
        Its range, in m or degrees.
    is_periodic
        Whether the range closes on itself.
    """

    name: str
    low: float
    high: float
    is_periodic: bool = False

    def value(self, share: float) -> float:
        """Return the rounded value at a share of the way from ``low`` to ``high``."""
        value = self.low + share * (self.high - self.low)
        if self.is_periodic:
            return round(math.remainder(value, 360.0), _ANGLE_DIGITS) + 0.0
        digits = _ANGLE_DIGITS if self.name.endswith("_deg") else _LENGTH_DIGITS
        return min(max(round(value, digits), self.low), self.high) + 0.0

    def share(self, value: float) -> float:
        """Return the inverse of :meth:`value`, clipped to the range."""
        share = (value - self.low) / (self.high - self.low)
        if self.is_periodic:
            return share % 1.0
        return min(max(share, 0.0), 1.0)


@dataclass(frozen=True, eq=False)
class Freedom:
    """How one sensor may move. Its height above the ground changes with the axis ``z_m`` only.

    Attributes
    ----------
    pose
        Pose of its candidate.
    axes
        What may change; everything else stays as in ``pose``.
    line
        Line along which the pole may move.
    radius_m
        Maximum distance of the pole from its candidate.
    area
        Area in which the pole must be.
    ground_m
        The ground; None where it is z = 0.
    """

    pose: Pose
    axes: tuple[Axis, ...]
    line: LineString | None = None
    radius_m: float = math.inf
    area: BaseGeometry | None = None
    ground_m: GroundHeight | None = None

    @property
    def moves_pole(self) -> bool:
        """Whether the pole may move in plan view."""
        return any(axis.name in (_ALONG_AXIS, "x_m", "y_m") for axis in self.axes)

    @property
    def ends(self) -> BoxEnds:
        """Ends of the box."""
        lower: list[float | None] = []
        upper: list[float | None] = []
        for axis in self.axes:
            lower.append(None if axis.is_periodic else 0.0)
            upper.append(None if axis.is_periodic else 1.0)
        return lower, upper

    def point(self, pose: Pose) -> FloatArray:
        """Return the point of the box that is closest to a pose, (axes,) float64."""
        values = asdict(pose)
        values["roll_deg"] = pose.side_tilt_deg
        values["z_m"] = self._height_m(pose)
        if self.line is not None:
            import shapely

            values[_ALONG_AXIS] = shapely.line_locate_point(self.line, shapely.Point(pose.x_m, pose.y_m))
        return np.array([axis.share(values[axis.name]) for axis in self.axes])

    def pose_at(self, point: FloatArray) -> Pose | None:
        """Return the pose at a point of the box; None if it is outside the area."""
        values = {axis.name: axis.value(float(share)) for axis, share in zip(self.axes, point, strict=True)}
        if self.line is not None:
            position = self.line.interpolate(values.pop(_ALONG_AXIS))
            values["x_m"] = round(position.x, _LENGTH_DIGITS)
            values["y_m"] = round(position.y, _LENGTH_DIGITS)
        if math.isfinite(self.radius_m):
            values["x_m"], values["y_m"] = self._clip_to_circle(values["x_m"], values["y_m"])
        if self.area is not None:
            import shapely

            if not shapely.intersects_xy(self.area, values["x_m"], values["y_m"]):
                return None
        if self.pose.is_inverted and "roll_deg" in values:
            values["roll_deg"] = wrap_deg(values["roll_deg"] + 180.0)
        values = {**asdict(self.pose), "z_m": self._height_m(self.pose), **values}
        if self.ground_m is not None:
            ground_m = self.ground_m(values["x_m"], values["y_m"])
            values["z_m"] = round(values["z_m"] + ground_m, _LENGTH_DIGITS)
        return Pose(**values)

    def _height_m(self, pose: Pose) -> float:
        """Return the height of a sensor above the ground."""
        return pose.z_m if self.ground_m is None else pose.z_m - self.ground_m(pose.x_m, pose.y_m)

    def _clip_to_circle(self, x_m: float, y_m: float) -> tuple[float, float]:
        """Return a position, moved to the rim of the circle if it is outside."""
        offset_x_m = x_m - self.pose.x_m
        offset_y_m = y_m - self.pose.y_m
        max_distance_m = max(self.radius_m - _CIRCLE_MARGIN_M, 0.0)
        distance_m = math.hypot(offset_x_m, offset_y_m)
        if distance_m > max_distance_m:
            x_m = self.pose.x_m + offset_x_m / distance_m * max_distance_m
            y_m = self.pose.y_m + offset_y_m / distance_m * max_distance_m
        return round(x_m, _LENGTH_DIGITS), round(y_m, _LENGTH_DIGITS)


def check_refine_config(scenario: Scenario, config: RefinementConfig) -> None:
    """Raise InputError for a polygon without a candidate."""
    import shapely

    poses = [site.pose for site in candidate_sites(scenario)]
    x_m = [pose.x_m for pose in poses]
    y_m = [pose.y_m for pose in poses]
    for number, corners in enumerate(config.within_m):
        if not shapely.intersects_xy(shapely.Polygon(corners), x_m, y_m).any():
            where = f"{scenario.file}: placement.refine.within_m: polygon {number}"
            hint = "Draw it around a candidate, in the world frame."
            raise InputError(where, "no candidate is inside this polygon", hint)


def sensor_freedoms(
    scenario: Scenario,
    config: RefinementConfig,
    candidates: Sequence[Site],
    plan: Sequence[Site],
    is_fixed: Sequence[bool],
    ground_m: GroundHeight | None = None,
) -> tuple[Freedom | None, ...]:
    """Return the freedom of each sensor of a plan; None for a fixed sensor, or one with a measured scan.

    A pole with several sensors of the plan does not move.

    Parameters
    ----------
    scenario
        The scenario.
    config
        ``[placement.refine]``.
    candidates
        All candidates; the range of their heights above the ground is the default range of heights.
    plan
        The sensors of the plan.
    is_fixed
        Which of them do not move.
    ground_m
        The ground; None where it is z = 0.

    Raises
    ------
    InputError
        If no sensor of the plan can move.
    """
    heights_m = config.heights_m
    if heights_m is None:
        candidate_heights_m = [site.pose.z_m for site in candidates]
        if ground_m is not None:
            grounds_m = [ground_m(site.pose.x_m, site.pose.y_m) for site in candidates]
            candidate_heights_m = [
                round(z_m - under_m, _LENGTH_DIGITS)
                for z_m, under_m in zip(candidate_heights_m, grounds_m, strict=True)
            ]
        heights_m = (min(candidate_heights_m), max(candidate_heights_m))
    sensors_on_pole = Counter(site.pole for site in plan)

    freedoms: list[Freedom | None] = []
    for site, fixed in zip(plan, is_fixed, strict=True):
        freedom = None
        if not fixed and site.points is None:
            freedom = _sensor_freedom(scenario, config, heights_m, site, sensors_on_pole[site.pole] > 1)
            freedom = replace(freedom, ground_m=ground_m)
        freedoms.append(freedom if freedom is not None and freedom.axes else None)
    if not any(freedoms):
        raise InputError(
            scenario.locate("placement.refine"),
            "no sensor of the plan can move",
            "Set a range of heights or angles, or use sensors that are neither forced nor measured.",
        )
    return tuple(freedoms)


def _sensor_freedom(
    scenario: Scenario, config: RefinementConfig, heights_m: tuple[float, float], site: Site, is_pole_shared: bool
) -> Freedom:
    pose = site.pose
    ranges = {
        "z_m": heights_m,
        "yaw_deg": config.yaw_deg or (-180.0, 180.0),
        "pitch_deg": config.pitch_deg,
        "roll_deg": config.roll_deg or (0.0, 0.0),
    }
    mount_axes = []
    for name, (low, high) in ranges.items():
        if low < high:
            is_periodic = name == "yaw_deg" and config.yaw_deg is None
            mount_axes.append(Axis(name, low, high, is_periodic))

    if is_pole_shared:
        return Freedom(pose, tuple(mount_axes))

    area = _containing_area(config, pose)
    if area is not None:
        west_m, south_m, east_m, north_m = area.bounds
        axes = (Axis("x_m", west_m, east_m), Axis("y_m", south_m, north_m), *mount_axes)
        return Freedom(pose, axes, area=area)

    line_position = _position_on_line(scenario.sites.along, pose)
    if line_position is not None:
        line, along_m, spacing_m = line_position
        reach_m = spacing_m / 2.0 if config.radius_m is None else config.radius_m
        low_m = max(along_m - reach_m, 0.0)
        high_m = min(along_m + reach_m, line.length)
        if not low_m < high_m:
            return Freedom(pose, tuple(mount_axes))
        return Freedom(pose, (Axis(_ALONG_AXIS, low_m, high_m), *mount_axes), line=line)

    radius_m = config.radius_m
    if radius_m:
        x_axis = Axis("x_m", pose.x_m - radius_m, pose.x_m + radius_m)
        y_axis = Axis("y_m", pose.y_m - radius_m, pose.y_m + radius_m)
        return Freedom(pose, (x_axis, y_axis, *mount_axes), radius_m=radius_m)
    return Freedom(pose, tuple(mount_axes))


def _containing_area(config: RefinementConfig, pose: Pose) -> BaseGeometry | None:
    """The first polygon that contains a pole."""
    import shapely

    for corners in config.within_m:
        area = shapely.Polygon(corners)
        if shapely.intersects_xy(area, pose.x_m, pose.y_m):
            return area
    return None


def _position_on_line(rules: Sequence[SiteLine], pose: Pose) -> tuple[LineString, float, float] | None:
    """The line of the rule that created a pole, where the pole is on it, and the spacing of its poles, metres."""
    import shapely

    for rule in rules:
        line = shapely.LineString(rule.line_m)
        n_poles = math.floor(line.length / rule.spacing_m + _ON_LINE_M) + 1
        along_m = np.arange(n_poles) * rule.spacing_m
        poles_m = shapely.get_coordinates(shapely.line_interpolate_point(line, along_m))
        distance_m = np.hypot(*(poles_m - (pose.x_m, pose.y_m)).T)
        if distance_m.min() <= _ON_LINE_M:
            return line, float(along_m[np.argmin(distance_m)]), rule.spacing_m
    return None


@dataclass(frozen=True, eq=False)
class PlanPoses:
    """A plan whose sensors may be at other poses than their candidates.

    It is a problem of its own (:attr:`problem`) whose only candidates are the sensors of the plan.

    Attributes
    ----------
    scenario, placement_problem
        Whose costs and rules apply.
    plan
        The candidate of each sensor.
    sites
        Current pose of each sensor.
    rows
        Visibility of each sensor from there.
    """

    scenario: Scenario
    placement_problem: PlacementProblem
    plan: Plan
    sites: tuple[Site, ...]
    rows: tuple[VisibilityRows, ...]

    @classmethod
    def of(cls, scenario: Scenario, placement_problem: PlacementProblem, plan: Sequence[int]) -> PlanPoses:
        """Return a plan with all sensors at the poses of their candidates."""
        sites = tuple(placement_problem.sites[candidate] for candidate in plan)
        matrices = placement_problem.visibilities

        def rows_of(candidate: int) -> VisibilityRows:
            return tuple(matrix.row(candidate) for matrix in matrices)

        rows = tuple(rows_of(candidate) for candidate in plan)
        return cls(scenario, placement_problem, tuple(plan), sites, rows)

    def with_sensor(self, number: int, site: Site, rows: VisibilityRows) -> PlanPoses:
        """Return the plan with one of its sensors moved."""
        sites = list(self.sites)
        sites[number] = site
        all_rows = list(self.rows)
        all_rows[number] = rows
        return replace(self, sites=tuple(sites), rows=tuple(all_rows))

    def keeps_rules(self, sites: Sequence[Site]) -> bool:
        """Whether the sensors may be at some poses: budget and distances; different poles stay apart."""
        return self._rules(sites).allows(range(len(sites))) and not self._has_close_poles(sites)

    @cached_property
    def problem(self) -> Problem:
        """The problem whose candidates are the sensors, in their order."""
        original = self.placement_problem.problem
        new_matrices: dict[int, VisibilityMatrix] = {}
        for number, matrix in enumerate(self.placement_problem.visibilities):
            rows = [sensor_rows[number] for sensor_rows in self.rows]
            new_matrices[id(matrix)] = VisibilityMatrix.of(rows, matrix.n_cells)
        new_terms = {id(term): replace(term, visibility=new_matrices[id(term.visibility)]) for term in original.terms}
        return replace(
            original,
            joint=new_terms[id(original.joint)],
            objective=tuple(new_terms[id(term)] for term in original.objective),
            demands=tuple(replace(demand, term=new_terms[id(demand.term)]) for demand in original.demands),
            rules=self._rules(self.sites),
        )

    @cached_property
    def plan_value(self) -> PlanValue:
        """Value of the plan."""
        return self.problem.plan_value(range(len(self.sites)))

    def _rules(self, sites: Sequence[Site]) -> PlanRules:
        """The rules for the sensors of the plan at some poses."""
        rules = self.placement_problem.problem.rules
        candidates = list(self.plan)
        forced = [number for number, candidate in enumerate(candidates) if candidate in rules.forced]
        cost, pole_cost = candidate_costs(self.scenario, sites)
        cost[forced] = 0.0
        pole_cost[forced] = 0.0
        return replace(
            rules,
            count=len(candidates),
            cost=cost,
            pole_cost=pole_cost,
            pole=rules.pole[candidates],
            forced=tuple(forced),
            excluded=np.zeros(len(candidates), dtype=np.bool_),
            position_m=np.array([site.pose.position_m for site in sites]).reshape(-1, 3),
        )

    def _has_close_poles(self, sites: Sequence[Site]) -> bool:
        """Whether two poles are closer than :data:`MIN_POLE_DISTANCE_M` and than at first."""
        original_sites = [self.placement_problem.sites[candidate] for candidate in self.plan]
        pole = self.placement_problem.problem.rules.pole[list(self.plan)]
        for a in range(len(sites)):
            for b in range(a):
                if pole[a] == pole[b]:
                    continue
                original_distance_m = _distance_m(original_sites[a], original_sites[b])
                if _distance_m(sites[a], sites[b]) < min(MIN_POLE_DISTANCE_M, original_distance_m):
                    return True
        return False


def _distance_m(a: Site, b: Site) -> float:
    """Distance in plan view."""
    return math.hypot(a.pose.x_m - b.pose.x_m, a.pose.y_m - b.pose.y_m)


@dataclass(frozen=True, eq=False)
class RefinedPlan:
    """A plan after refinement.

    Attributes
    ----------
    before, after
        The plan at the poses of its candidates, and at the refined poses.
    tried
        Number of poses that were tried, impossible ones included.
    impossible
        Number of those that break a rule or cannot be scanned.
    turns
        Number of turns of all sensors together.
    """

    before: PlanPoses
    after: PlanPoses
    tried: int
    impossible: int
    turns: int

    def moved_m(self, number: int) -> float:
        """Distance of a sensor from its candidate."""
        after_m = np.array(self.after.sites[number].pose.position_m)
        before_m = np.array(self.before.sites[number].pose.position_m)
        return float(np.sqrt(((after_m - before_m) ** 2).sum()))

    def gain(self, number: int) -> float:
        """Joint score that is lost if this sensor alone returns to its candidate's pose."""
        returned = self.after.with_sensor(number, self.before.sites[number], self.before.rows[number])
        return self.after.plan_value.joint - returned.plan_value.joint


def refine_plan(
    context: StageContext, placement_problem: PlacementProblem, plan: Sequence[int], config: RefinementConfig
) -> RefinedPlan:
    """Move the sensors of a plan within ``[placement.refine]``; the value of the plan never drops.

    Parameters
    ----------
    context
        The run.
    placement_problem
        The problem that the plan solves.
    plan
        Candidates of the plan.
    config
        ``[placement.refine]``.

    Raises
    ------
    InputError
        If no sensor of the plan can move.
    """
    before = PlanPoses.of(context.scenario, placement_problem, plan)
    is_fixed = [candidate in placement_problem.problem.rules.forced for candidate in plan]
    evaluator = _PoseEvaluator(context, placement_problem)
    freedoms = sensor_freedoms(
        context.scenario, config, placement_problem.sites, before.sites, is_fixed, evaluator.ground_m
    )
    movable = [(number, freedom) for number, freedom in enumerate(freedoms) if freedom is not None]

    poses = before
    settled: set[int] = set()
    turns = 0
    tried = 0
    impossible = 0
    while len(settled) < len(movable):
        number, freedom = movable[turns % len(movable)]
        search = _SensorSearch(evaluator, poses, number, freedom)
        start = freedom.point(poses.sites[number].pose)
        rng = np.random.default_rng(np.random.SeedSequence((context.scenario.seed, turns)))
        minimise(search.losses, start, freedom.ends, config.evaluations, rng)

        if search.best.plan_value.value > poses.plan_value.value * (1.0 + MIN_IMPROVEMENT):
            settled = {number}
        else:
            settled.add(number)
        poses = search.best
        turns += 1
        tried += search.tried
        impossible += search.impossible
        context.progress("poses", tried, 0)
    return RefinedPlan(before, poses, tried, impossible, turns)


class _PoseEvaluator:
    """Compute where sensors can be and what they see from there."""

    def __init__(self, context: StageContext, placement_problem: PlacementProblem) -> None:
        self.threads = context.threads
        self._scene = context.scene
        self._views = placement_problem.views
        self._scanner = Scanner(self._scene)

    def on_roads(self, sites: Sequence[Site]) -> BoolArray:
        """Which sites are in a lane or a junction, (n,) bool; none if candidates are not checked for it either."""
        if self._carriageway is None or not sites:
            return np.zeros(len(sites), dtype=np.bool_)
        positions_m = np.array([site.pose.position_m for site in sites])
        in_lane: BoolArray = np.array([lane is not None for lane in self._carriageway.lanes_at(positions_m)])
        return in_lane | self._carriageway.in_junctions(positions_m[:, :2])

    @cached_property
    def ground_m(self) -> GroundHeight | None:
        """The ground; None where it is z = 0, or where there is none."""
        world = self._scene.world
        if not world.vertices_m[world.faces[_ground_faces(world)], 2].any():
            return None

        def height_m(x_m: float, y_m: float) -> float:
            return site_feasibility.ground_height_m(world, Pose(x_m, y_m, 0.0))

        return height_m

    def rows(self, site: Site) -> VisibilityRows | None:
        """Visibility of a sensor; None if no sensor can be there."""
        sensor = self._scene.sensor(site.sensor)
        try:
            scan = self._scanner.scan(site.pose, sensor)
        except InputError:  # the only reasons: in a solid, below the ground, out of reach
            return None
        beams = Beams.of(scan)
        return tuple(view.row(beams) for view in self._views)

    @cached_property
    def _carriageway(self) -> Carriageway | None:
        scenario = self._scene.scenario
        if not scenario.sites.only_free:
            return None
        network = sumo_folder.read_network(scenario)
        return None if network is None else Carriageway.of(network)


def _ground_faces(world: World) -> BoolArray:
    """Return which faces are ground, (n,)."""
    is_ground = np.array([solid == ("ground", "ground") for solid in world.solids], dtype=np.bool_)
    return is_ground[world.solid_of_face]


class _SensorSearch:
    """One turn of a sensor; keeps the best plan so far."""

    def __init__(self, evaluator: _PoseEvaluator, poses: PlanPoses, number: int, freedom: Freedom) -> None:
        self.best = poses
        self.tried = 0
        self.impossible = 0
        self._evaluator = evaluator
        self._start = poses
        self._number = number
        self._freedom = freedom

    def losses(self, points: FloatArray) -> FloatArray:
        """Return the losses of points of the freedom's box, (n, axes); the better the plan, the lower."""
        losses = np.full(len(points), _INFEASIBLE_LOSS)
        plans = map_ordered(self._plan_with, self._sites_at(points), self._evaluator.threads)
        for i, plan in enumerate(plans):
            if plan is None:
                self.impossible += 1
                continue
            losses[i] = self._loss(plan.plan_value)
            if plan.plan_value > self.best.plan_value:
                self.best = plan
        self.tried += len(points)
        return losses

    def _sites_at(self, points: FloatArray) -> list[Site | None]:
        """Sites at the points; None if no pole may be there, or if a rule of the plan is broken."""
        current = self._start.sites[self._number]
        sites: list[Site | None] = []
        for point in points:
            pose = self._freedom.pose_at(point)
            sites.append(None if pose is None else replace(current, pose=pose))
        if self._freedom.moves_pole:
            possible = [i for i, site in enumerate(sites) if site is not None]
            on_roads = self._evaluator.on_roads([site for site in sites if site is not None])
            for i, is_on_road in zip(possible, on_roads.tolist(), strict=True):
                if is_on_road:
                    sites[i] = None
        return [site if site is not None and self._keeps_rules(site) else None for site in sites]

    def _keeps_rules(self, site: Site) -> bool:
        sites = list(self._start.sites)
        sites[self._number] = site
        return self._start.keeps_rules(sites)

    def _plan_with(self, site: Site | None) -> PlanPoses | None:
        """The plan with the sensor at a site, its value computed; None if it cannot be there."""
        if site is None:
            return None
        rows = self._evaluator.rows(site)
        if rows is None:
            return None
        plan = self._start.with_sensor(self._number, site, rows)
        _ = plan.plan_value  # cached here, in the worker thread
        return plan

    def _loss(self, plan_value: PlanValue) -> float:
        """Minus the relative value, plus a little of the joint score in case the value does not depend on this sensor.

        A plan that misses demands ranks behind all plans that meet them.
        """
        if plan_value.met < 0.0:
            return 1.0 - plan_value.met
        before = self._start.plan_value
        tiny = float(np.finfo(np.float64).tiny)
        return -plan_value.value / max(before.value, tiny) - _JOINT_WEIGHT * plan_value.joint / max(before.joint, tiny)


def minimise(
    losses: LossFunction,
    start: FloatArray,
    ends: BoxEnds,
    evaluations: int,
    rng: np.random.Generator,
    step: float = _INITIAL_STEP,
) -> None:
    """Evaluate losses until the evaluations are used up or the search converges.

    Nothing is returned: ``losses`` is expected to remember the best point.

    Parameters
    ----------
    losses
        Function to minimise.
    start
        A point of the box, (axes,).
    ends
        The box.
    evaluations
        Maximum number of points.
    rng
        The points depend only on it and on the losses.
    step
        Initial standard deviation of CMA-ES, as a share of the sides of the box.
    """
    random_points = rng.random((max(1, int(_RANDOM_SHARE * evaluations)), len(start)))
    random_losses = losses(random_points)
    remaining = evaluations - len(random_points)
    _run_cma_es(losses, start, ends, remaining // 2, rng, step)
    best_random_point = random_points[int(np.argmin(random_losses))]
    _run_cma_es(losses, best_random_point, ends, remaining - remaining // 2, rng, step)


def _run_cma_es(
    losses: LossFunction, start: FloatArray, ends: BoxEnds, evaluations: int, rng: np.random.Generator, step: float
) -> None:
    from cma import CMAEvolutionStrategy

    options = {
        "bounds": list(ends),
        "randn": lambda *shape: rng.standard_normal(shape),
        "seed": math.nan,  # leaves NumPy's global state alone
        "verbose": -9,
        "verb_log": 0,
    }
    strategy = CMAEvolutionStrategy(start, step, options)
    while evaluations >= strategy.popsize and not strategy.stop():
        points = strategy.ask()
        strategy.tell(points, losses(np.array(points)).tolist())
        evaluations -= len(points)
