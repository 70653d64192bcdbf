"""Choose sensors that are best together: ``egvs place``, the joint score of a set of candidates, ``placement.parquet``.

Steps of :func:`place`: bring traffic, static world, TPOG and scans up to date as ``egvs run`` does; compute the
visibility of every candidate once; solve ``[placement]`` (:mod:`egvs.placement.solver`); on request refine the poses
(:mod:`egvs.placement.refinement`); estimate standard errors (:mod:`egvs.placement.plan_error`); write
``placement.parquet`` (one row per sensor) and ``curve.parquet`` (one row per number of sensors); refresh the report of
the run, if there is one.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from egvs.artefacts import checksums, parquet
from egvs.artefacts.readers import read_plan_zones
from egvs.artefacts.run_folder import RunFolder
from egvs.core import files, plugins
from egvs.core.digests import use_digests
from egvs.core.errors import InputError, choose_one
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.wording import number_of
from egvs.placement import fused_score, problem_builder, refinement, solver
from egvs.placement.fused_score import FusedScore
from egvs.placement.plan_error import PlanErrors
from egvs.placement.plan_zones import PlanZones
from egvs.placement.problem import Demand, Problem
from egvs.placement.problem_builder import PlacementProblem, TargetView
from egvs.placement.refinement import PlanPoses
from egvs.placement.solver import Solution
from egvs.results.plans import (
    ERROR_COLUMNS,
    FusedPlan,
    PlannedSensor,
    PlanStep,
    RefinementSummary,
    SensorPlan,
    ZoneCoverage,
    curve_columns,
    plan_columns,
)
from egvs.runs import run, stage_registry
from egvs.runs.run import StageListener, ignore_stage, lock_run_folder
from egvs.runs.run_context import open_folder
from egvs.scenario.loading import check_is_scenario
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import RefinementConfig
from egvs.scoring import zones as zone_files
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scan
from egvs.sensors.sites import Site
from egvs.stages.base import StageContext
from egvs.stages.plan_scans import plan_beams
from egvs.stages.site_scans import empty_scans

REQUIRED_STAGES = ("check", "statics", "scan", "traffic", "tpog")
"""The stages whose artefacts a placement problem is built from."""

_REFINEMENT_COLUMNS = ("moved_m", "gain_by_refining")
"""Columns of a plan whose poses were refined."""

_SENSOR_ERROR_COLUMNS = ("score_se", "gain_se")
"""Columns of a plan where standard errors are known."""


class JointScore:
    """The joint score of a set of candidates, by the score that ``score.rank_by`` names.

    A gain takes about 2.5 ns for each cell that the candidate hits: well below a millisecond at 0.5 m voxels.

    ::

        joint = egvs.JointScore.of(scenario, "runs/trial")
        joint.add("c03")
        joint.gain("c10")
    """

    def __init__(self, placement_problem: PlacementProblem) -> None:
        self._placement_problem = placement_problem
        self._joint = placement_problem.problem.joint
        self._state = placement_problem.problem.coverage_state()
        self._index_of_name = {name: i for i, name in enumerate(placement_problem.names)}

    @classmethod
    def of(
        cls,
        scenario: Scenario,
        out: str | Path | None = None,
        *,
        jobs: int | None = None,
        progress: ProgressCallback = no_progress,
    ) -> JointScore:
        """Return the joint score of a scenario's candidates, for the empty set.

        Parameters
        ----------
        scenario
            From :func:`egvs.load`.
        out
            The run's folder, where artefacts are brought up to date; ``runs/<scenario name>`` when None.
        jobs
            Number of threads; one per core when None.
        progress
            Called with the progress of stages and scans.
        """
        folder = Path(out) if out is not None else run.default_folder(scenario)
        record = run.run(scenario, folder, only=REQUIRED_STAGES, jobs=jobs, progress=progress)
        context = open_folder(
            scenario, folder, jobs=jobs, progress=progress, recorded=stage_registry.recorded_digests(record)
        )
        with use_digests(context.inputs.digests) as digests:
            problem = problem_builder.build_problem(context, lambda done: progress("candidates", done, 0))
            digests.check_unchanged()
        return cls(problem)

    @property
    def candidates(self) -> tuple[str, ...]:
        """Names of all candidates, in the order of the sites."""
        return tuple(self._index_of_name)

    @property
    def chosen(self) -> tuple[str, ...]:
        """Names of the candidates in the set, in the order in which they were added."""
        return tuple(self._placement_problem.names[i] for i in self._state.chosen)

    @property
    def value(self) -> float:
        """Joint score of the set; it does not depend on the order."""
        return self._state.value(self._joint)

    @property
    def joint_of_all(self) -> float:
        """Joint score of all candidates that are not excluded."""
        return self._placement_problem.joint_of_all

    def add(self, *names: str) -> None:
        """Put candidates into the set."""
        for i in self._indices(names):
            if i not in self._state.chosen:
                self._state.add(i)

    def remove(self, *names: str) -> None:
        """Take candidates out of the set."""
        for i in self._indices(names):
            if i in self._state.chosen:
                self._state.remove(i)

    def gain(self, pose: str | Scan) -> float:
        """Return what one more sensor adds to the joint score of the set.

        Parameters
        ----------
        pose
            Name of a candidate, whose gain is 0 if it is in the set; or the empty scan of any pose, from
            :meth:`egvs.Scanner.scan`.
        """
        if isinstance(pose, Scan):
            row = self._placement_problem.row(Beams.of(pose))
            return self._state.value_with(self._joint, row) - self.value
        (i,) = self._indices([pose])
        if i in self._state.chosen:
            return 0.0
        return float(self._state.gains(self._joint, np.array([i], dtype=np.int64))[0])

    def gains(self) -> dict[str, float]:
        """Return what each candidate adds to the joint score of the set, by name."""
        gains = self._state.gains(self._joint, np.arange(len(self._index_of_name), dtype=np.int64))
        gains[self._state.chosen] = 0.0
        return dict(zip(self.candidates, gains.tolist(), strict=True))

    def _indices(self, names: Iterable[str]) -> list[int]:
        for name in names:
            if name not in self._index_of_name:
                raise InputError(f"candidate {name!r}", "no such candidate", choose_one(name, self.candidates))
        return [self._index_of_name[name] for name in names]


def planned_request(folder: Path) -> dict[str, Any] | None:
    """Return the ``[placement]`` of the plan in a run folder; None if there is no valid plan."""
    path = RunFolder(folder).placement
    if not path.is_file():
        return None
    try:
        plan = parquet.read_metadata(path, "placement")["plan"]
    except InputError:  # of another version, or not complete
        return None
    request: dict[str, Any] = plan["asked"]
    return request


def planned_mounts(folder: Path) -> list[tuple[Any, ...]]:
    """Return the sensors of the plan in a run folder (:func:`mount_of`); empty if there is no valid plan."""
    try:
        planned = SensorPlan.read(RunFolder(folder))
    except InputError:
        return []
    return [] if planned is None else list(map(mount_of, planned.sensors))


def mount_of(sensor: PlannedSensor) -> tuple[Any, ...]:
    """Return what has to be installed: the site, the sensor and its pose."""
    pose = (sensor.x_m, sensor.y_m, sensor.z_m, sensor.yaw_deg, sensor.pitch_deg, sensor.roll_deg)
    return sensor.site, sensor.sensor, *(round(value, 6) for value in pose)


def place(
    scenario: Scenario,
    out: str | Path | None = None,
    *,
    exact: bool = False,
    time_limit_s: float = 60.0,
    refine: bool = False,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
    listener: StageListener = ignore_stage,
) -> SensorPlan:
    """Choose the sensors that a scenario's ``[placement]`` asks for, and write the plan.

    Parameters
    ----------
    scenario
        From :func:`egvs.load`.
    out
        The run's folder; ``runs/<scenario name>`` when None.
    exact
        Search until the best plan is proved or the time limit is reached.
    time_limit_s
        Time limit of that search, and of the proof that fewer sensors are not enough.
    refine
        Refine the poses even without ``[placement.refine]``.
    jobs
        Number of threads; one per core when None. Results do not depend on it.
    progress, listener
        Called with the progress of stages and candidates, and when a stage begins or ends.

    Raises
    ------
    InputError
        When no plan meets ``[placement]``; the message names the nearest request that can be met.
    """
    check_is_scenario(scenario)
    if refine:
        plugins.require_libraries("egvs place --refine", "place", "cma")
    folder = Path(out) if out is not None else run.default_folder(scenario)
    if refine and scenario.placement.refine is None:
        placement = scenario.placement.model_copy(update={"refine": RefinementConfig()})
        scenario = scenario.model_copy(update={"placement": placement})
    problem_builder.check_placement_config(scenario)
    for path in (RunFolder(folder).placement, RunFolder(folder).curve):
        if path.is_dir():
            raise InputError(path, "is a folder", "Remove it: the plan is written to this file.")
    if scenario.placement.refine is not None:
        refinement.check_refine_config(scenario, scenario.placement.refine)

    record = run.run(scenario, folder, only=REQUIRED_STAGES, jobs=jobs, progress=progress, listener=listener)
    with lock_run_folder(folder):
        context = open_folder(
            scenario, folder, jobs=jobs, progress=progress, recorded=stage_registry.recorded_digests(record)
        )
        with use_digests(context.inputs.digests) as digests:
            placed = solve_placement(context, exact=exact, time_limit_s=time_limit_s)
            inputs_by_stage = {name: record.stages[name].inputs for name in REQUIRED_STAGES}
            zones = None
            if scenario.score.zones is not None and placed.sensors:
                zones = PlanZones.of(context, placed.sensors, moved=placed.refinement is not None)
            digests.check_unchanged()
        written = write_placement(folder, scenario, placed, inputs_by_stage, zones)
        if zones is not None:
            placed = replace(placed, zone_results=tuple(read_plan_zones(RunFolder(folder).plan_zones)))
        report = run.refresh_report(folder)
        if report is not None:
            written = (*written, report)
        return replace(placed, files=written)


def solve_placement(context: StageContext, *, exact: bool, time_limit_s: float) -> SensorPlan:
    """Find the plan that ``[placement]`` asks for; nothing is written.

    Parameters
    ----------
    context
        The run, with :data:`REQUIRED_STAGES` up to date.
    exact, time_limit_s
        As in :func:`place`.

    Raises
    ------
    InputError
        When no plan meets ``[placement]``.
    """
    scenario, config = context.scenario, context.scenario.placement
    placement_problem = problem_builder.build_problem(context, lambda done: context.progress("candidates", done, 0))
    problem = placement_problem.problem

    def on_progress(count: int) -> None:
        context.progress("sensors", count, 0)

    if config.reach is None:
        solution = solver.best_plan(problem, search_all=exact, time_limit_s=time_limit_s, on_progress=on_progress)
    else:
        reach = Demand(problem.joint, config.reach * placement_problem.joint_of_all)
        problem = replace(problem, demands=(*problem.demands, reach))
        smallest = solver.smallest_plan(problem, time_limit_s=time_limit_s, on_progress=on_progress)
        if smallest is None:
            raise _unreachable_share_error(scenario, problem, placement_problem)
        solution = smallest
    if solution.point.plan_value.met < 0.0:
        raise _unmet_zone_error(scenario, problem, placement_problem, solution)

    placement_problem = replace(placement_problem, problem=problem)
    sites = [placement_problem.sites[i] for i in solution.order]
    placed = _make_placement(scenario, placement_problem, problem, sites, solution.order, solution)
    errors = PlanErrors(context, placement_problem)
    if config.refine is None or not placed.sensors:
        placed = _with_errors(placed, errors, placement_problem, solution, placement_problem, solution.order)
        return replace(placed, fused=_fused_plan(context, placement_problem, problem, solution.order, errors))
    return _refine_placement(context, placement_problem, solution, config.refine, placed, errors)


def _with_errors(
    placed: SensorPlan,
    errors: PlanErrors,
    placement_problem: PlacementProblem,
    solution: Solution,
    poses: PlacementProblem | PlanPoses,
    order: Sequence[int],
) -> SensorPlan:
    """Return a plan with standard errors; ``order`` as in :func:`_make_placement`, ``poses`` as given or refined."""
    curve_plans = [point.plan for point in solution.curve]
    curve_errors = errors.of_plans(placement_problem.problem.joint, curve_plans, placement_problem.sites)
    curve = [replace(step, **error._asdict()) for step, error in zip(placed.curve, curve_errors, strict=True)]

    prefixes = [tuple(order[: number + 1]) for number in range(len(order))]
    is_moved = isinstance(poses, PlanPoses)
    sensor_errors = errors.of_plans(poses.problem.joint, prefixes, poses.sites, moved=is_moved)
    sensors = []
    for sensor, error in zip(placed.sensors, sensor_errors, strict=True):
        sensors.append(replace(sensor, score_se=error.score_se, gain_se=error.gain_se))
    return replace(placed, sensors=tuple(sensors), curve=tuple(curve), errors_from=errors.source)


def _fused_plan(
    context: StageContext,
    placement_problem: PlacementProblem,
    problem: Problem,
    order: Sequence[int],
    errors: PlanErrors,
    refined_sites: Sequence[Site] | None = None,
) -> FusedPlan | None:
    """Evaluate a plan in fused point clouds; None if the joint score does not take its sensors as independent.

    Parameters
    ----------
    placement_problem
        The candidates at their original poses.
    problem, order
        As in :func:`_make_placement`.
    refined_sites
        The sites of ``problem`` if they were refined: what was moved is scanned anew, and there are no swaps.
    """
    view = placement_problem.views[-1]
    if placement_problem.score != fused_score.FUSED_SCORE or not order:
        return None
    assert isinstance(view, TargetView)
    sites = placement_problem.sites if refined_sites is None else refined_sites
    moved = [site for site in sites if site not in placement_problem.sites]

    def read_scans(names: Collection[str]) -> Iterator[tuple[str, Beams]]:
        yield from plan_beams(context, [site for site in moved if site.name in names], moved=True)
        unmoved = set(names) - {site.name for site in moved}
        yield from ((scan.site.name, scan.beams) for scan in empty_scans(context, unmoved))

    score = FusedScore(view.targets, [site.name for site in sites], read_scans)
    search = len(order) > 1 and refined_sites is None and not problem.survives and problem.objective == (problem.joint,)
    return fused_score.evaluate_fused_plan(score, problem, order, errors, search=search)


def _refine_placement(
    context: StageContext,
    placement_problem: PlacementProblem,
    solution: Solution,
    config: RefinementConfig,
    placed: SensorPlan,
    errors: PlanErrors,
) -> SensorPlan:
    start_s = perf_counter()
    refined = refinement.refine_plan(context, placement_problem, solution.order, config)
    before, after = refined.before.plan_value, refined.after.plan_value
    order = solver.greedy_order(refined.after.problem, tuple(range(len(refined.after.sites))))
    sites = [refined.after.sites[i] for i in order]
    problem = refined.after.problem
    result = _make_placement(context.scenario, placement_problem, problem, sites, order, solution)
    result = _with_errors(result, errors, placement_problem, solution, refined.after, order)
    sensors = []
    for sensor, i in zip(result.sensors, order, strict=True):
        sensors.append(replace(sensor, moved_m=refined.moved_m(i), gain_by_refining=refined.gain(i)))
    seconds = perf_counter() - start_s
    counts = (refined.tried, refined.impossible, refined.turns)
    summary = RefinementSummary(placed.joint, before.value, after.value, *counts, seconds)
    fused = _fused_plan(context, placement_problem, problem, order, errors, refined.after.sites)
    return replace(result, sensors=tuple(sensors), refinement=summary, fused=fused)


def _make_placement(
    scenario: Scenario,
    placement_problem: PlacementProblem,
    problem: Problem,
    sites: Sequence[Site],
    order: Sequence[int],
    solution: Solution,
) -> SensorPlan:
    """Describe a plan.

    Parameters
    ----------
    scenario
        Its ``[placement]`` names the zones.
    placement_problem, solution
        The problem with the candidates as they are given, and its solution.
    problem
        The problem in which the plan is evaluated: the same one, or that of the refined poses.
    sites, order
        The sensors of the plan in the order of installation, and their candidates in ``problem``.
    """
    state = problem.coverage_state(order)
    joint = state.value(problem.joint)
    bounds = {point.count: point.bound for point in solution.curve}
    sensors = []
    for sensor, candidate in zip(planned_sensors(problem, sites, order), order, strict=True):
        state.remove(candidate)
        loss = joint - state.value(problem.joint)
        state.add(candidate)
        bound = bounds.get(sensor.order, bounds[min(bounds)])  # the curve begins at the number of forced sensors
        sensors.append(replace(sensor, loss=loss, bound=bound))

    zones = []
    for demand in problem.demands:
        name = demand.term.name
        if name in scenario.placement.zones:
            required_by = scenario.placement.zones[name].by
            zones.append(ZoneCoverage(name, state.value(demand.term), demand.least, required_by))
    given = placement_problem.problem
    curve = []
    score_before = 0.0
    for point in solution.curve:
        score = point.plan_value.joint
        curve.append(
            PlanStep(
                point.count,
                score,
                score - score_before,
                met=point.plan_value.met >= 0.0,
                sites=_site_names(placement_problem, point.plan),
                cost=given.rules.cost_of(point.plan),
                value=point.plan_value.value,
                bound=point.bound,
            )
        )
        score_before = score
    return SensorPlan(
        sensors=tuple(sensors),
        curve=tuple(curve),
        score=placement_problem.score,
        request=scenario.placement.model_dump(mode="json"),
        joint=joint,
        joint_of_all=placement_problem.joint_of_all,
        cost=problem.rules.cost_of(order),
        candidates=len(given.candidates),
        zones=tuple(zones),
        is_best=solution.is_best,
        fewest_is_proved=solution.fewest_is_proved,
        forbids_more=given.rules.what_forbids_more(solution.order),
    )


def planned_sensors(problem: Problem, sites: Sequence[Site], order: Sequence[int]) -> Iterator[PlannedSensor]:
    """Yield the sensors of a plan with their gains and costs; ``loss`` and ``bound`` are not set.

    Parameters
    ----------
    problem
        Its joint score and its costs are used.
    sites, order
        The sites of the sensors in the order of installation, and their candidates in the problem.
    """
    state, rules = problem.coverage_state(), problem.rules
    score, cost = state.value(problem.joint), rules.cost_of([])
    for number, (site, candidate) in enumerate(zip(sites, order, strict=True), start=1):
        state.add(candidate)
        score_before, score = score, state.value(problem.joint)
        cost_before, cost = cost, rules.cost_of(order[:number])
        yield PlannedSensor(
            order=number,
            site=site.name,
            pole=site.pole or site.name,
            **asdict(site.pose),
            sensor=site.sensor,
            forced=candidate in rules.forced,
            gain=score - score_before,
            score=score,
            cost=cost - cost_before,
        )


def _site_names(placement_problem: PlacementProblem, plan: Sequence[int]) -> tuple[str, ...]:
    return tuple(placement_problem.names[i] for i in plan)


def _unreachable_share_error(scenario: Scenario, problem: Problem, placement_problem: PlacementProblem) -> InputError:
    """Return the error for a share that no plan within the rules reaches."""
    without_share = replace(problem, demands=problem.demands[:-1])
    nearest = solver.best_plan(without_share, search_all=False, time_limit_s=0.0, on_progress=lambda _: None)
    if nearest.point.plan_value.met < 0.0:
        return _unmet_zone_error(scenario, without_share, placement_problem, nearest)
    reached = 0.0
    if placement_problem.joint_of_all > 0.0:
        reached = nearest.point.plan_value.joint / placement_problem.joint_of_all
    names = ", ".join(_site_names(placement_problem, nearest.order))
    return InputError(
        scenario.locate("placement.reach"),
        f"no plan within the count, the budget and the other rules reaches {scenario.placement.reach:g}",
        f"Lower it to at most {np.floor(reached * 1000) / 1000:g}, which {names} reach.",
    )


def _unmet_zone_error(
    scenario: Scenario, problem: Problem, placement_problem: PlacementProblem, solution: Solution
) -> InputError:
    """Return the error for zones of which no plan within the rules sees enough."""
    state = problem.coverage_state(solution.order)
    shares = []
    for demand in problem.demands:
        reached = state.value(demand.term)
        if demand.unmet(reached) > 0.0:
            shares.append(f"{reached:.3g} of {demand.term.name} (expected {demand.least:g})")
    nearest = ", ".join(_site_names(placement_problem, solution.order))

    without_limit = problem.with_count(len(problem.candidates))
    larger = solver.smallest_plan(without_limit, time_limit_s=0.0, on_progress=lambda _: None)
    hint = "Lower the share, or raise the budget."
    if larger is not None and len(larger.order) > problem.rules.count:
        names = ", ".join(_site_names(placement_problem, larger.order))
        hint = f"Set placement.count to {len(larger.order)}: {names} see enough."
    return InputError(
        scenario.locate("placement.zones"),
        f"found no plan of {number_of(problem.rules.count, 'sensor')} that meets the requirements of all zones;"
        f" the closest ({nearest}) sees {' and '.join(shares)}",
        hint,
    )


def write_placement(
    folder: Path,
    scenario: Scenario,
    placed: SensorPlan,
    stage_keys: Mapping[str, str],
    zones: PlanZones | None = None,
) -> tuple[Path, ...]:
    """Write ``placement.parquet``, ``curve.parquet``, with zones ``plan_zones.parquet``, and their checksums.

    Parameters
    ----------
    folder
        The run's folder.
    scenario, placed
        The scenario and its plan.
    stage_keys
        Keys of the stages that the plan was made from, by name.
    zones
        What the plan finds in the zones of ``[score] zones``, if there are any.

    Returns
    -------
    tuple of pathlib.Path
        The tables.
    """
    paths = RunFolder(folder)
    metadata = _placement_metadata(scenario, placed, stage_keys)
    paths.placement_checksums.unlink(missing_ok=True)
    optional_columns: tuple[str, ...] = () if placed.refinement is None else _REFINEMENT_COLUMNS
    if placed.has_errors:
        optional_columns += _SENSOR_ERROR_COLUMNS
    with parquet.artefact_writer(paths.placement, "placement", optional_columns) as out:
        out.write(plan_columns(placed.sensors))
        out.describe(metadata)
    with parquet.artefact_writer(paths.curve, "curve", ERROR_COLUMNS if placed.has_errors else ()) as out:
        out.write(curve_columns(placed.curve))
        out.describe(metadata)
    written: tuple[Path, ...] = (paths.placement, paths.curve)
    if zones is None:
        paths.plan_zones.unlink(missing_ok=True)
    else:
        zones.write(paths.plan_zones, metadata)
        written = (*written, paths.plan_zones)
    checksums.write_checksums(paths.placement_checksums, written)
    return written


def _placement_metadata(scenario: Scenario, placed: SensorPlan, stage_keys: Mapping[str, str]) -> dict[str, Any]:
    settings = {
        "placement": placed.request,
        "costs": scenario.costs.model_dump(mode="json"),
        "score": scenario.score.model_copy(update={"gamma": scenario.gamma}).model_dump(mode="json"),
    }
    settings |= zone_files.file_settings(scenario.placement.zones, zone_files.placement_zones(scenario))
    settings |= zone_files.reported_settings(scenario)
    return {
        "schema": parquet.SCHEMA_VERSION,
        "scenario": {"name": scenario.name, "hash": files.hash_json(settings)},
        "inputs": files.hash_json({**settings, "stages": dict(stage_keys)}),
        "seed": scenario.seed,
        "stages": dict(stage_keys),
        "plan": placed.to_json(),
    }
