"""Egvs city run, egvs city place.

A whole city run: the traffic once, every junction on a cluster, and what came of them brought together.

Each junction's folder holds, byte for byte, what ``egvs run`` of its scenario alone would write: tasks call the same
stages, and share what they make through the store.

Which poles of a whole city: so many sensors, or so much money, where they see most together.

Steps: bring all junctions up to date, as a city run does; ask each what it would make of 1, 2, ... sensors
(:mod:`egvs.city.allocation`, tasks of the cluster); share them out (:mod:`egvs.city.allocation`).
Where a junction would get as many as it was asked about, it is asked about twice as many.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

from egvs.city import allocation, page, results, scheduler, traffic_split
from egvs.city.allocation import Allocation, JunctionPlan, JunctionPlans
from egvs.city.model import City, CityJunction
from egvs.city.results import CityPlan, JunctionResult, PlannedSensor, read_junction_results, write_results
from egvs.city.tasks import Job, JobFailure, JobResult, RunSettings
from egvs.core.errors import Diagnostic, InputError, collect_warnings
from egvs.core.runtime import ProgressCallback, no_progress
from egvs.runs.run import lock_run_folder

if TYPE_CHECKING:
    from distributed import Client


@dataclass(frozen=True)
class CityRun:
    """What came of a city: its junctions, the best first, and the files beside their runs."""

    out: Path
    results: tuple[JunctionResult, ...]
    files: tuple[Path, ...]
    warnings: tuple[Diagnostic, ...] = ()


def run_city(
    city: City,
    out: str | Path | None = None,
    *,
    where: str = scheduler.LOCAL_CLUSTER,
    only: Collection[str] = (),
    sets: Sequence[str] = (),
    progress: ProgressCallback = no_progress,
    on_done: Callable[[JobResult], None] = lambda _: None,
) -> CityRun:
    """Run a city's junctions.

    Parameters
    ----------
    out
        Its folder; ``runs/<city's name>`` when None.
    where
        As ``--cluster`` says it, see :func:`egvs.city.scheduler.connect`.
    only
        Names of junctions; all when there is none.
    sets
        Laid over every junction's scenario, as ``egvs run --set`` does; no key of the traffic, which is the city's.
    on_done
        Called with each junction as it is done.

    Raises
    ------
    InputError
        Where the city, a scenario or ``where`` is wrong.
    RunError
        Where the traffic or a run cannot keep its promise, or the cluster is lost; what is done is kept then.
    """
    chosen, folder = select_junctions(city, only), city_run_folder(city, out)
    _refuse_traffic_overrides(city, sets)
    with lock_run_folder(folder):
        scheduler.check_cluster(where)
        with scheduler.connect(where) as client:
            ran = run_city_on(client, city, folder, chosen, sets, progress, on_done)
        planned = results.read_plan(folder, [junction.id for junction in chosen])
        return replace(ran, files=(*ran.files, page.write_page(folder, city, ran.results, ran.warnings, planned)))


def run_city_on(
    client: Client,
    city: City,
    folder: Path,
    chosen: Sequence[CityJunction],
    sets: Sequence[str],
    progress: ProgressCallback,
    on_done: Callable[[JobResult], None],
) -> CityRun:
    """Run junctions on a cluster that is there, and bring their scores together; for those who hold the folder."""
    order = scheduler.make_run_settings()
    made = traffic_split.make_city_traffic(city, progress, sets)
    scheduler.run_jobs(client, make_jobs(city, folder, chosen, sets), order, on_done=on_done, progress=progress)
    results = read_junction_results(folder, chosen)
    return CityRun(folder, results, write_results(folder, city, results), tuple(collect_warnings([made.summary])))


def select_junctions(city: City, only: Collection[str]) -> tuple[CityJunction, ...]:
    """The junctions of these names, in the city's order; all where there is none."""
    names = {city.junction(name).id for name in only}
    return tuple(junction for junction in city.junctions if not names or junction.id in names)


def make_jobs(city: City, out: Path, chosen: Sequence[CityJunction], sets: Sequence[str]) -> list[Job]:
    """What workers get of junctions."""
    _refuse_traffic_overrides(city, sets)
    return [
        Job(
            its.id,
            its.scenario_folder(city).absolute(),
            results.junction_run_folder(out, its.id).absolute(),
            tuple(sets),
        )
        for its in chosen
    ]


def _refuse_traffic_overrides(city: City, sets: Sequence[str]) -> None:
    for override in sets:
        key = override.partition("=")[0].strip()
        if key.split(".")[0] == "traffic":
            found = "the traffic of a city is simulated once, for all of its junctions"
            raise InputError(f"--set {override}", found, f"{key} in {city.file}, then this command without it")


def city_run_folder(city: City, out: str | Path | None) -> Path:
    """Where a city run goes: ``runs/<city's name>`` where no folder is given."""
    return Path(out) if out is not None else Path("runs") / city.name


_MIN_FIRST_COUNT = 4
"""Sensors that junctions are asked about at first, at least."""


@dataclass(frozen=True)
class CityPlacement:
    """A city's plan, the run that it is made from, and what was written."""

    city_run: CityRun
    plan: CityPlan
    files: tuple[Path, ...]


def place_city(
    city: City,
    out: str | Path | None = None,
    *,
    count: int | None = None,
    budget: float | None = None,
    where: str = scheduler.LOCAL_CLUSTER,
    only: Collection[str] = (),
    sets: Sequence[str] = (),
    progress: ProgressCallback = no_progress,
    on_done: Callable[[JobResult], None] = lambda _: None,
) -> CityPlacement:
    """The poles of a city that are best together.

    Parameters
    ----------
    count, budget
        One of them: sensors at most, or what they may cost.
    out, where, only, sets, heard
        As :func:`egvs.city.city_run.run_city` takes them.

    Raises
    ------
    InputError
        For what cannot be asked, or cannot be added up over junctions.
    """
    if (count is None) == (budget is None):
        found = "neither is given" if count is None else "both are given"
        raise InputError("--count, --budget", found, "one of them: --count 20 or --budget 800000")
    if budget is not None and not 0 < budget < float("inf"):
        raise InputError("--budget", f"{budget:g}", "a cost above 0")
    chosen, folder = select_junctions(city, only), city_run_folder(city, out)
    jobs = make_jobs(city, folder, chosen, sets)
    for job in jobs:
        allocation.check_additive_config(job.scenario())
    with lock_run_folder(folder):
        scheduler.check_cluster(where)
        with scheduler.connect(where) as client:
            ran = run_city_on(client, city, folder, chosen, sets, progress, on_done)
            seen = [its.junction.id for its in ran.results if its.gain > 0]
            wanted = [job for job in jobs if job.junction in seen]
            if not wanted:
                raise InputError(city.file, "no pole sees anything of the traffic", "a city with traffic")
            shared, of = _allocate_sensors(client, wanted, count, budget, progress)
        rank_by = ran.results[0].best.rank_by
        told = _make_city_plan(wanted, of, shared, rank_by, {"count": count} if budget is None else {"budget": budget})
        ids = [junction.id for junction in chosen]
        warnings = (
            *ran.warnings,
            *overlap_warnings(jobs),
            *_no_traffic_visible_warnings(city, [i for i in ids if i not in seen]),
        )
        written = (
            results.write_plan(folder, city, told, ids),
            page.write_page(folder, city, ran.results, warnings, told),
        )
    return CityPlacement(CityRun(folder, ran.results, ran.files, warnings), told, written)


def _allocate_sensors(
    client: Client, jobs: Sequence[Job], count: int | None, budget: float | None, progress: ProgressCallback
) -> tuple[Allocation, dict[str, JunctionPlans]]:
    """The plan that each junction gets, and what each could get."""
    order, found = scheduler.make_run_settings(), dict[str, JunctionPlans]()
    limit = count if count is not None else 10**6
    most = dict.fromkeys((job.junction for job in jobs), min(limit, max(_MIN_FIRST_COUNT, 2 * -(-limit // len(jobs)))))
    if budget is not None:
        most = dict.fromkeys(most, _MIN_FIRST_COUNT)
    asked: Sequence[Job] = jobs
    while True:
        failed = []
        for job, its in _iter_junction_plans(client, asked, order, most, budget is not None):
            if isinstance(its, JobFailure):
                failed.append(its)
            else:
                found[job.junction] = its
            progress("junctions asked", len(found), len(jobs))
        scheduler.raise_failures(failed, len(jobs))
        every = [found[job.junction] for job in jobs]
        shared = _solve_allocation(every, count, budget)
        short = [its for its, at in zip(every, shared.chosen, strict=True) if _needs_more_plans(its, at, limit)]
        if not short:
            return shared, found
        most |= {its.junction: min(limit, 2 * its.max_count) for its in short}
        asked = [job for job in jobs if job.junction in {its.junction for its in short}]


def _iter_junction_plans(
    client: Client, jobs: Sequence[Job], settings: RunSettings, most: Mapping[str, int], costs_count: bool
) -> Iterator[tuple[Job, JunctionPlans | JobFailure]]:
    for number in sorted({most[job.junction] for job in jobs}):
        alike = [job for job in jobs if most[job.junction] == number]
        yield from scheduler.map_junctions(client, allocation.junction_plans, alike, settings, number, costs_count)


def _solve_allocation(every: Sequence[JunctionPlans], count: int | None, budget: float | None) -> Allocation:
    """InputError where what is there already is more than was asked for."""
    if count is None:
        assert budget is not None
        return allocation.allocate_budget(every, budget)
    there = sum(its.plans[0].count for its in every)
    if there > count:
        raise InputError(
            f"--count {count}", f"{there} sensors are there already (placement.forced)", f"at least {there}"
        )
    return allocation.allocate_count(every, count)


def _needs_more_plans(plans: JunctionPlans, at: int, limit: int) -> bool:
    """Whether a junction gets as many sensors as it was asked about, and more could add something."""
    return not plans.is_complete and plans.plans[at].count >= plans.max_count and plans.max_count < limit


def _make_city_plan(
    jobs: Sequence[Job],
    of: Mapping[str, JunctionPlans],
    shared: Allocation,
    rank_by: str,
    requested: Mapping[str, float | None],
) -> CityPlan:
    """The plan of the city in the order in which its sensors would be put up."""
    plans = {job.junction: of[job.junction].plans[at] for job, at in zip(jobs, shared.chosen, strict=True)}
    sensors, score = [], 0.0
    for number, (junction, pick) in enumerate(_merge_by_gain(plans), start=1):
        score += pick.gain
        site = pick.site
        sensors.append(
            PlannedSensor(
                number, junction, site.name, site.pole or site.name, **asdict(site.pose), sensor=site.sensor,
                forced=pick.is_forced, gain=pick.gain, score=score, cost=pick.cost,
            )
        )  # fmt: skip
    every = [of[job.junction] for job in jobs]
    together, candidates = sum(its.together for its in every), sum(len(its.min_costs) - 1 for its in every)
    curve = tuple((float(best), float(bound)) for best, bound in shared.curve)
    numbers = {key: float(value) for key, value in requested.items() if value is not None}
    return CityPlan(
        tuple(sensors), rank_by, numbers, shared.value, shared.bound, together, candidates, len(jobs), curve
    )


def _merge_by_gain(plans: Mapping[str, JunctionPlan]) -> Iterator[tuple[str, allocation.JunctionSensor]]:
    """What is there already; then, of the junctions' next sensors, each time the one that adds most."""
    left = {name: list(plan.sensors) for name, plan in plans.items() if plan.sensors}
    while left:
        name = max(left, key=lambda its: (left[its][0].is_forced, left[its][0].gain))
        yield name, left[name].pop(0)
        if not left[name]:
            del left[name]


def overlap_warnings(jobs: Sequence[Job]) -> Iterator[Diagnostic]:
    """A warning where regions of junctions overlap: what lies in two is counted twice."""
    boxes = [(job.junction, job.scenario().roi.box) for job in jobs]
    pairs = [
        f"{a} and {b}" for (a, one), (b, other) in combinations(boxes, 2)
        if all(one.origin_m[i] < other.origin_m[i] + other.size_m[i] - 1e-9 for i in (0, 1))
        and all(other.origin_m[i] < one.origin_m[i] + one.size_m[i] - 1e-9 for i in (0, 1))
    ]  # fmt: skip
    if pairs:
        few = ", ".join(pairs[:5]) + (f" and {len(pairs) - 5} more pairs" if len(pairs) > 5 else "")
        found = f"the regions of {few} overlap: what lies in both is counted twice in the city's sum"
        yield Diagnostic("regions overlap", "junctions", found, "smaller regions, or one of the two junctions")


def _no_traffic_visible_warnings(city: City, names: Sequence[str]) -> Iterator[Diagnostic]:
    if names:
        found = f"no pole of {', '.join(names)} sees anything of the traffic: no sensor is planned there"
        yield Diagnostic("junctions unseen", str(city.file), found, "more traffic, or other candidates")
