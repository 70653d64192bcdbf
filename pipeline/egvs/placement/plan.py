"""Choose sensors that are best together: ``egvs place``, the joint score of a set of candidates, ``placement.parquet``.

Steps of :func:`place`: bring traffic, static world, TPOG and scans up to date as ``egvs run`` does; compute the
visibility of every candidate once; solve ``[placement]`` (:mod:`egvs.placement.solver`); on request refine the poses
(:mod:`egvs.placement.refinement`); write ``placement.parquet`` (one row per sensor) and ``curve.parquet`` (one row per
number of sensors); refresh the report of the run, if there is one.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from egvs.artefacts import checksums, parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.placement import problem_builder, refinement, solver
from egvs.placement.problem import Plan, Problem
from egvs.placement.problem_builder import PlacementProblem
from egvs.placement.solver import Solution
from egvs.runs import run, stages
from egvs.runs.run import StageListener, ignore_stage, lock_run_folder
from egvs.scenario.model import Scenario
from egvs.scenario.score_config import RefinementConfig
from egvs.scoring.visibility import Beams
from egvs.sensors.scanner import Scan
from egvs.sensors.sites import Site
from egvs.stages.base import StageContext
from egvs.stages.inputs import open_folder

REQUIRED_STAGES = ("check", "statics", "scan", "traffic", "tpog")
"""The stages that candidates are looked from after."""


class JointScore:
    """What a set of candidates is worth together, by the score that ``score.rank_by`` names.

    A gain takes about 2.5 ns for each cell that the candidate hits: well below a millisecond at 0.5 m voxels.

    ::

        joint = egvs.JointScore.of(scenario, "runs/trial")
        joint.add("c03")
        joint.gain("c10")
    """

    def __init__(self, placement_problem: PlacementProblem) -> None:
        self._placement_problem = placement_problem
        self._coverage_state = placement_problem.problem.coverage_state()
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
        """Of a scenario's candidates; brings what it needs up to date in the run's folder."""
        folder = Path(out) if out is not None else run.default_folder(scenario)
        record = run.run(scenario, folder, only=REQUIRED_STAGES, jobs=jobs, progress=progress)
        work = open_folder(scenario, folder, jobs=jobs, progress=progress, recorded=stages.recorded_digests(record))
        return cls(problem_builder.build_problem(work, lambda done: progress("candidates", done, 0)))

    @property
    def candidates(self) -> tuple[str, ...]:
        """Their names, in the order of the sites."""
        return tuple(self._index_of_name)

    @property
    def chosen(self) -> tuple[str, ...]:
        """Those in the set, in the order in which they came."""
        return tuple(self._placement_problem.names[i] for i in self._coverage_state.chosen)

    @property
    def value(self) -> float:
        """The joint score of the set; the same for any order."""
        return self._coverage_state.value(self._placement_problem.problem.joint)

    @property
    def together(self) -> float:
        """That of all candidates."""
        return self._placement_problem.joint_of_all

    def add(self, *names: str) -> None:
        """Put candidates into the set."""
        for i in self._indices(names):
            if i not in self._coverage_state.chosen:
                self._coverage_state.add(i)

    def remove(self, *names: str) -> None:
        """Take candidates out of the set."""
        for i in self._indices(names):
            if i in self._coverage_state.chosen:
                self._coverage_state.remove(i)

    def gain(self, pose: str | Scan) -> float:
        """What a candidate, or the empty scan of any pose (:meth:`egvs.Scanner.scan`), would add to the set; 0 for
        a candidate that is in it."""
        if isinstance(pose, Scan):
            return (
                self._coverage_state.value_with(
                    self._placement_problem.problem.joint, self._placement_problem.row(Beams.of(pose))
                )
                - self.value
            )
        (i,) = self._indices([pose])
        if i in self._coverage_state.chosen:
            return 0.0
        return float(
            self._coverage_state.gains(self._placement_problem.problem.joint, np.array([i], dtype=np.int64))[0]
        )

    def gains(self) -> dict[str, float]:
        """What each candidate would add."""
        every = np.arange(len(self._index_of_name), dtype=np.int64)
        gained = self._coverage_state.gains(self._placement_problem.problem.joint, every)
        gained[self._coverage_state.chosen] = 0.0
        return dict(zip(self.candidates, gained.tolist(), strict=True))

    def _indices(self, names: Iterable[str]) -> list[int]:
        for name in names:
            if name not in self._index_of_name:
                raise InputError(
                    f"candidate {name!r}", "no such candidate", f"Use one of {', '.join(self.candidates[:20])}."
                )
        return [self._index_of_name[name] for name in names]


def check_output_files(folder: Path) -> None:
    """InputError where a folder stands in the place of a file that is written."""
    for name in (RunFolder.placement.name, RunFolder.curve.name):
        if (folder / name).is_dir():
            raise InputError(folder / name, "is a folder", "Remove it: the plan is written to this file.")


def write_placement(
    folder: Path, scenario: Scenario, placed: Placement, stages: Mapping[str, str]
) -> tuple[Path, Path]:
    """Write both files; their paths.

    Parameters
    ----------
    stages
        Keys of the stages that the plan was made from, by name.
    """
    about = _placement_metadata(scenario, placed, stages)
    RunFolder(folder).placement_checksums.unlink(missing_ok=True)
    picks, points = placed.sensors, placed.solution.curve
    bounds = {point.count: point.bound for point in points}
    columns: dict[str, Any] = {
        "order": np.arange(1, len(picks) + 1, dtype=np.int32),
        "site": [pick.site.name for pick in picks],
        "pole": [pick.site.pole or pick.site.name for pick in picks],
        **{key: [asdict(pick.site.pose)[key] for pick in picks] for key in _POSE_COLUMNS},
        "sensor": [pick.site.sensor for pick in picks],
        "forced": [pick.is_forced for pick in picks],
        **{key: [getattr(pick, key) for pick in picks] for key in ("gain", "score", "cost", "loss")},
        "bound": [bounds.get(number, bounds[min(bounds)]) for number in range(1, len(picks) + 1)],
    }
    moves = _REFINEMENT_COLUMNS if placed.moves is not None else ()
    columns |= {key: [getattr(pick, key) for pick in picks] for key in moves}
    with parquet.artefact_writer(RunFolder(folder).placement, "placement", moves) as out:
        out.write(columns)
        out.describe(about)
    curve = {
        "count": np.array([point.count for point in points], dtype=np.int32),
        "score": [point.plan_value.joint for point in points],
        "value": [point.plan_value.value for point in points],
        "bound": [point.bound for point in points],
        "cost": list(placed.curve_costs),
        "met": [point.plan_value.met >= 0.0 for point in points],
        "sites": [json.dumps(list(names), ensure_ascii=False) for names in placed.curve_sites],
    }
    parquet.write_artefact(RunFolder(folder).curve, "curve", curve, about)
    written = RunFolder(folder).placement, RunFolder(folder).curve
    checksums.write_checksums(RunFolder(folder).placement_checksums, written)
    return written


_POSE_COLUMNS = ("x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")
_REFINEMENT_COLUMNS = ("moved_m", "gain_by_refining")
"""Columns that a plan has whose sensors were to move."""
_REFINEMENT_METADATA = ("before", "value_before", "value", "tried", "impossible", "turns")
"""What is told of its moves; how long they took is no part of a file."""


def _placement_metadata(scenario: Scenario, placed: Placement, stages: Mapping[str, str]) -> dict[str, Any]:
    asked = scenario.placement.model_dump(mode="json")
    settings = {
        "placement": asked,
        "costs": scenario.costs.model_dump(mode="json"),
        "score": scenario.score.model_copy(update={"gamma": scenario.gamma}).model_dump(mode="json"),
    }
    solution, moves = placed.solution, placed.moves
    return {
        "schema": parquet.SCHEMA_VERSION,
        "scenario": {"name": scenario.name, "hash": files.hash_json(settings)},
        "inputs": files.hash_json({**settings, "stages": dict(stages)}),
        "seed": scenario.seed,
        "stages": dict(stages),
        "plan": {
            "score": placed.score,
            "asked": asked,
            "candidates": placed.candidates,
            "joint": placed.joint,
            "value": solution.point.plan_value.value,
            "bound": solution.point.bound,
            "certificate": placed.certificate,
            "together": placed.together,
            "cost": placed.cost,
            "is_best": solution.is_best,
            "fewest_is_proved": solution.fewest_is_proved,
            "zones": [asdict(zone) for zone in placed.zones],
            **({} if moves is None else {"moves": {key: getattr(moves, key) for key in _REFINEMENT_METADATA}}),
        },
    }


@dataclass(frozen=True)
class PlacedSensor:
    """One sensor of a plan.

    Attributes
    ----------
    site
        The candidate.
    is_forced
        Whether it is there already.
    gain, score
        What it adds to the joint score of those before it, and that with it.
    cost
        What it adds to the cost.
    loss
        What the whole plan loses of its joint score when it fails.
    moved_m
        How far it is from where its candidate hangs; 0 where sensors were not to move.
    gain_by_refining
        What the joint score would lose were it alone put back as its candidate hangs.
    """

    site: Site
    is_forced: bool
    gain: float
    score: float
    cost: float
    loss: float
    moved_m: float = 0.0
    gain_by_refining: float = 0.0


@dataclass(frozen=True)
class ZoneCoverage:
    """A zone that was demanded: the share of its entropy that the plan sees, by so many sensors."""

    name: str
    seen: float
    share: float
    by: int


@dataclass(frozen=True)
class RefinementSummary:
    """What it took to move the sensors of a plan.

    Attributes
    ----------
    before
        The joint score of the plan as its candidates hang.
    value_before, value
        What was asked for of the plan, then and now: :attr:`Worth.value`. Never less now; the joint score may be.
    tried, impossible
        Poses, and those of them that cannot be.
    turns
        Of one sensor each.
    seconds
        Spent on it.
    """

    before: float
    value_before: float
    value: float
    tried: int
    impossible: int
    turns: int
    seconds: float


@dataclass(frozen=True)
class Placement:
    """A plan, and what is proved of it.

    Attributes
    ----------
    sensors
        In the order in which they would be put up: forced ones first, then what adds most.
    score
        The name of the joint score.
    joint
        That score of the plan.
    together
        That of all candidates.
    zones
        Those that were demanded.
    solution
        The curve, the bound, what was proved; all of it of candidates as they are given.
    curve_sites, curve_costs
        Names and cost of the plan of each point of the curve.
    moves
        Of a plan whose sensors were to move: then picks, joint, cost and zones are those after it.
    files
        What was written.
    """

    sensors: tuple[PlacedSensor, ...]
    score: str
    joint: float
    together: float
    cost: float
    candidates: int
    zones: tuple[ZoneCoverage, ...]
    solution: Solution
    curve_sites: tuple[tuple[str, ...], ...]
    curve_costs: tuple[float, ...]
    moves: RefinementSummary | None = None
    files: tuple[Path, ...] = ()

    @property
    def certificate(self) -> float:
        """The share of the best possible that is proved."""
        return self.solution.point.certificate


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
) -> Placement:
    """The poles that are best together, as a scenario's ``[placement]`` asks for.

    Parameters
    ----------
    scenario
        From :func:`egvs.load`.
    out
        The run's folder; ``runs/<scenario name>`` when None.
    exact
        Search until the best plan is proved, or the time ends.
    time_limit_s
        Of that search, and of the proof that fewer sensors do not reach what is demanded.
    refine
        Then let the sensors of the plan move, as ``[placement.refine]`` does by itself.

    Raises
    ------
    InputError
        For a demand that cannot be met, with what can.
    """
    folder = Path(out) if out is not None else run.default_folder(scenario)
    if refine and scenario.placement.refine is None:
        placement = scenario.placement.model_copy(update={"refine": RefinementConfig()})
        scenario = scenario.model_copy(update={"placement": placement})
    problem_builder.check_placement_config(scenario)
    check_output_files(folder)
    if scenario.placement.refine is not None:
        refinement.check_refine_config(scenario, scenario.placement.refine)
    record = run.run(scenario, folder, only=REQUIRED_STAGES, jobs=jobs, progress=progress, listener=listener)
    with lock_run_folder(folder):
        work = open_folder(scenario, folder, jobs=jobs, progress=progress, recorded=stages.recorded_digests(record))
        placed = solve_placement(work, exact=exact, time_limit_s=time_limit_s)
        keys = {name: record.stages[name].inputs for name in REQUIRED_STAGES}
        files = write_placement(folder, scenario, placed, keys)
        report = run.refresh_report(folder)
        return replace(placed, files=files if report is None else (*files, report))


def solve_placement(work: StageContext, *, exact: bool, time_limit_s: float) -> Placement:
    """The plan that ``[placement]`` asks for, from a run's folder; nothing is written."""
    scenario = work.scenario
    asked = problem_builder.build_problem(work, lambda done: work.progress("candidates", done, 0))
    problem, wanted = asked.problem, scenario.placement

    def heard(count: int) -> None:
        work.progress("sensors", count, 0)

    if wanted.reach is None:
        solution = solver.best_plan(problem, search_all=exact, time_limit_s=time_limit_s, on_progress=heard)
    else:
        reaching = problem_builder.share_demand(problem, wanted.reach, asked.joint_of_all)
        problem = replace(problem, demands=(*problem.demands, reaching))
        found = solver.smallest_plan(problem, time_limit_s=time_limit_s, on_progress=heard)
        if found is None:
            raise _unreachable_share_error(scenario, problem, asked)
        solution = found
    if solution.point.plan_value.met < 0.0:
        raise _unmet_zone_error(scenario, problem, asked, solution)
    asked = replace(asked, problem=problem)
    placed = _make_placement(scenario, asked, asked.sites, problem, solution.order, solution)
    if wanted.refine is None or not placed.sensors:
        return placed
    return _refine_placement(work, asked, wanted.refine, placed)


def _refine_placement(
    work: StageContext, placement_problem: PlacementProblem, config: RefinementConfig, placed: Placement
) -> Placement:
    """A plan after its sensors have moved."""
    started, solution = perf_counter(), placed.solution
    refined = refinement.refine_plan(work, placement_problem, solution.order, config)
    problem, sites = refined.after.problem, refined.after.sites
    order = solver.greedy_order(problem, tuple(range(len(sites))))
    told = _make_placement(work.scenario, placement_problem, sites, problem, order, solution)
    picks = tuple(
        replace(pick, moved_m=refined.moved_m(number), gain_by_refining=refined.gain(number))
        for pick, number in zip(told.sensors, order, strict=True)
    )
    seconds = perf_counter() - started
    values = refined.before.plan_value.value, refined.after.plan_value.value
    moves = RefinementSummary(placed.joint, *values, refined.tried, refined.impossible, refined.turns, seconds)
    return replace(told, sensors=picks, moves=moves)


def _make_placement(
    scenario: Scenario,
    placement_problem: PlacementProblem,
    sites: Sequence[Site],
    problem: Problem,
    plan: Plan,
    solution: Solution,
) -> Placement:
    """A plan in the words of the scenario; ``sites`` and ``plan`` are those of ``problem``, which need not be the one
    that was solved."""
    rules, whole, demanded = problem.rules, problem.coverage_state(plan), scenario.placement.zones
    joint, before = whole.value(problem.joint), problem.coverage_state()
    picks = []
    for number, candidate in enumerate(plan):
        so_far = before.value(problem.joint)
        before.add(candidate)
        score = before.value(problem.joint)
        whole.remove(candidate)
        loss = joint - whole.value(problem.joint)
        whole.add(candidate)
        cost = rules.cost_of(plan[: number + 1]) - rules.cost_of(plan[:number])
        is_forced = candidate in rules.forced
        picks.append(PlacedSensor(sites[candidate], is_forced, score - so_far, score, cost, loss))
    zones = tuple(
        ZoneCoverage(demand.term.name, whole.value(demand.term), demand.least, demanded[demand.term.name].by)
        for demand in problem.demands
        if demand.term.name in demanded
    )
    return Placement(
        sensors=tuple(picks),
        score=placement_problem.score,
        joint=joint,
        together=placement_problem.joint_of_all,
        cost=rules.cost_of(plan),
        candidates=len(placement_problem.problem.candidates),
        zones=zones,
        solution=solution,
        curve_sites=tuple(_site_names(placement_problem, point.plan) for point in solution.curve),
        curve_costs=tuple(placement_problem.problem.rules.cost_of(point.plan) for point in solution.curve),
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
        f"{scenario.file}: placement.reach",
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
        f"{scenario.file}: placement.zones",
        f"no plan of {problem.rules.count} sensors that meets them was found; the nearest, {nearest}, sees "
        + " and ".join(shares),
        hint,
    )
