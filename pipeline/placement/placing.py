"""``egvs place``: the poles that are best together, and how sure that is.

Steps: bring traffic, static world and TPOG up to date as ``egvs run`` does; look from every candidate once; solve what
``[placement]`` asks for (:mod:`pipeline.placement.solving.planning`); where it is asked for, let the sensors of the
plan move (:mod:`pipeline.placement.refining.refining`); write ``placement.parquet`` and ``curve.parquet`` beside the
run, and draw its report anew where there is one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np

from pipeline.core.errors import InputError
from pipeline.core.progress import Progress, silent
from pipeline.placement import asking, writing
from pipeline.placement.asking import Asked
from pipeline.placement.joint_score import NEEDED
from pipeline.placement.refining import freedom, refining
from pipeline.placement.solving import planning
from pipeline.placement.solving.heuristics import Plan
from pipeline.placement.solving.planning import Solution
from pipeline.placement.solving.problem import Problem
from pipeline.runs import stages, workflow
from pipeline.runs.locking import alone
from pipeline.runs.workflow import StageListener, unheard
from pipeline.scenario.models import Scenario
from pipeline.scenario.placement import RefineModel
from pipeline.sensing.sites import Site
from pipeline.stages.base import Workspace


@dataclass(frozen=True)
class Pick:
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
class ZoneSeen:
    """A zone that was demanded: the share of its entropy that the plan sees, by so many sensors."""

    name: str
    seen: float
    share: float
    by: int


@dataclass(frozen=True)
class Moves:
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
    picks
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

    picks: tuple[Pick, ...]
    score: str
    joint: float
    together: float
    cost: float
    candidates: int
    zones: tuple[ZoneSeen, ...]
    solution: Solution
    curve_sites: tuple[tuple[str, ...], ...]
    curve_costs: tuple[float, ...]
    moves: Moves | None = None
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
    progress: Progress = silent,
    listener: StageListener = unheard,
) -> Placement:
    """The poles that are best together, as a scenario's ``[placement]`` asks for.

    Parameters
    ----------
    scenario
        From :func:`pipeline.load`.
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
    folder = Path(out) if out is not None else workflow.default_folder(scenario)
    if refine and scenario.placement.refine is None:
        placement = scenario.placement.model_copy(update={"refine": RefineModel()})
        scenario = scenario.model_copy(update={"placement": placement})
    asking.check(scenario)
    writing.check(folder)
    if scenario.placement.refine is not None:
        freedom.check(scenario, scenario.placement.refine)
    record = workflow.run(scenario, folder, only=NEEDED, jobs=jobs, progress=progress, listener=listener)
    with alone(folder):
        work = Workspace(scenario, folder, jobs=jobs, progress=progress, recorded=stages.recorded(record))
        placed = solved(work, exact=exact, time_limit_s=time_limit_s)
        keys = {name: record.stages[name].inputs for name in NEEDED}
        files = writing.write(folder, scenario, placed, keys)
        report = workflow.refresh_report(folder)
        return replace(placed, files=files if report is None else (*files, report))


def solved(work: Workspace, *, exact: bool, time_limit_s: float) -> Placement:
    """The plan that ``[placement]`` asks for, from a run's folder; nothing is written."""
    scenario = work.scenario
    asked = asking.ask(work, lambda done: work.progress("candidates", done, 0))
    problem, wanted = asked.problem, scenario.placement

    def heard(count: int) -> None:
        work.progress("sensors", count, 0)

    if wanted.reach is None:
        solution = planning.best(problem, search_all=exact, time_limit_s=time_limit_s, heard=heard)
    else:
        reaching = asking.reaching(problem, wanted.reach, asked.together)
        problem = replace(problem, demands=(*problem.demands, reaching))
        found = planning.fewest(problem, time_limit_s=time_limit_s, heard=heard)
        if found is None:
            raise _out_of_reach(scenario, problem, asked)
        solution = found
    if solution.point.worth.met < 0.0:
        raise _unmet(scenario, problem, asked, solution)
    asked = replace(asked, problem=problem)
    placed = _told(scenario, asked, asked.sites, problem, solution.order, solution)
    if wanted.refine is None or not placed.picks:
        return placed
    return _refined(work, asked, wanted.refine, placed)


def _refined(work: Workspace, asked: Asked, wanted: RefineModel, placed: Placement) -> Placement:
    """A plan after its sensors have moved."""
    started, solution = perf_counter(), placed.solution
    refined = refining.refine(work, asked, solution.order, wanted)
    problem, sites = refined.after.problem, refined.after.sites
    order = planning.in_order(problem, tuple(range(len(sites))))
    told = _told(work.scenario, asked, sites, problem, order, solution)
    picks = tuple(
        replace(pick, moved_m=refined.moved_m(number), gain_by_refining=refined.gain(number))
        for pick, number in zip(told.picks, order, strict=True)
    )
    seconds = perf_counter() - started
    values = refined.before.worth.value, refined.after.worth.value
    moves = Moves(placed.joint, *values, refined.tried, refined.impossible, refined.turns, seconds)
    return replace(told, picks=picks, moves=moves)


def _told(
    scenario: Scenario, asked: Asked, sites: Sequence[Site], problem: Problem, plan: Plan, solution: Solution
) -> Placement:
    """A plan in the words of the scenario; ``sites`` and ``plan`` are those of ``problem``, which need not be the one
    that was solved."""
    rules, whole, demanded = problem.rules, problem.together(plan), scenario.placement.zones
    joint, before = whole.value(problem.joint), problem.together()
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
        picks.append(Pick(sites[candidate], is_forced, score - so_far, score, cost, loss))
    zones = tuple(
        ZoneSeen(demand.term.name, whole.value(demand.term), demand.least, demanded[demand.term.name].by)
        for demand in problem.demands
        if demand.term.name in demanded
    )
    return Placement(
        picks=tuple(picks),
        score=asked.score,
        joint=joint,
        together=asked.together,
        cost=rules.cost_of(plan),
        candidates=len(asked.problem.candidates),
        zones=zones,
        solution=solution,
        curve_sites=tuple(_names(asked, point.plan) for point in solution.curve),
        curve_costs=tuple(asked.problem.rules.cost_of(point.plan) for point in solution.curve),
    )


def _names(asked: Asked, plan: Sequence[int]) -> tuple[str, ...]:
    return tuple(asked.names[i] for i in plan)


def _out_of_reach(scenario: Scenario, problem: Problem, asked: Asked) -> InputError:
    """That no plan within the rules reaches the share that was asked for."""
    within = replace(problem, demands=problem.demands[:-1])
    nearest = planning.best(within, search_all=False, time_limit_s=0.0, heard=lambda _: None)
    if nearest.point.worth.met < 0.0:
        return _unmet(scenario, within, asked, nearest)
    reached = nearest.point.worth.joint / asked.together if asked.together > 0.0 else 0.0
    found = f"{scenario.placement.reach:g}, and no plan within the count, the budget and the other rules was found"
    right = f"at most {np.floor(reached * 1000) / 1000:g}, as {', '.join(_names(asked, nearest.order))} reach"
    return InputError(f"{scenario.file}: placement.reach", found, right)


def _unmet(scenario: Scenario, problem: Problem, asked: Asked, solution: Solution) -> InputError:
    """That no plan within the rules sees enough of every zone."""
    seen = problem.together(solution.order)
    short = [its for its in problem.demands if its.unmet(seen.value(its.term)) > 0.0]
    parts = [f"{its.term.name} {seen.value(its.term):.3g} of {its.least:g}" for its in short]
    more = planning.fewest(problem.with_count(len(problem.candidates)), time_limit_s=0.0, heard=lambda _: None)
    nearest = (
        f"the nearest that was found, {', '.join(_names(asked, solution.order))}, sees of {' and of '.join(parts)}"
    )
    right = "a smaller share, or a larger budget"
    if more is not None and len(more.order) > problem.rules.count:
        right = f"a count of {len(more.order)}: {', '.join(_names(asked, more.order))} meet it"
    found = f"no plan of {problem.rules.count} sensors that meets it was found; {nearest}"
    return InputError(f"{scenario.file}: placement.zones", found, right)
