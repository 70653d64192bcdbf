"""``egvs city run`` and ``egvs city place``: run all junctions on a cluster, and plan sensors for the whole city.

Steps of :func:`run_city`: simulate the traffic once (:mod:`egvs.extensions.city.traffic_split`), while workers check
and scan the scenes of the junctions; run every junction (:mod:`egvs.extensions.city.scheduler`); collect the results
(:mod:`egvs.extensions.city.results`); write the page (:mod:`egvs.extensions.city.page`) and the costs
(:mod:`egvs.extensions.city.costs`).
The folder of each junction is byte for byte what ``egvs run`` of its scenario alone writes.

Steps of :func:`place_city`: run all junctions; compute the best plans of 1, 2, ... sensors for each, on the cluster;
allocate sensors to the junctions (:mod:`egvs.extensions.city.allocation`). Where a junction gets as many sensors as its
largest plan has, its plans are computed for twice as many, and the allocation is repeated. Then put the sensors into
the order of installation, and estimate the standard errors of the curve (:mod:`egvs.extensions.city.city_plan`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from itertools import combinations, pairwise
from pathlib import Path

from egvs.core.errors import Diagnostic, InputError, collect_warnings
from egvs.core.grid import Roi
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.wording import list_first
from egvs.extensions.city import allocation, city_plan, page, results, scheduler, traffic_split
from egvs.extensions.city.allocation import Allocation, JunctionPlans
from egvs.extensions.city.costs import CityCosts, CostMeter
from egvs.extensions.city.model import City
from egvs.extensions.city.replicates import CityBlocks, common_blocks
from egvs.extensions.city.results import CityPlan, JunctionResult, read_junction_results, write_results
from egvs.extensions.city.scheduler import Cluster
from egvs.extensions.city.tasks import Job, JobFailure, JobResult
from egvs.extensions.city.worker_pool import print_to_stderr
from egvs.runs import run_names
from egvs.runs.run import lock_run_folder

_MIN_FIRST_COUNT = 4
"""Plans of each junction are computed for at least this number of sensors."""

_MAX_SENSORS = 10**6
"""Limit of the number of sensors for a budget."""

_MAX_PAIRS = 5
"""Number of pairs that a warning lists."""

_OVERLAP_TOLERANCE_M = 1e-9


@dataclass(frozen=True)
class CityRunOptions:
    """Options of a city run.

    Attributes
    ----------
    cluster
        Where tasks run, see :func:`egvs.extensions.city.scheduler.connect`.
    junctions
        Names of the junctions to run; all if empty.
    overrides
        ``KEY=VALUE`` for the scenarios of all junctions, as in ``egvs run --set``; no keys of the traffic.
    progress, on_done
        Called with the number of finished junctions, and with each of them.
    on_message
        Called with messages about the cluster, e.g. about workers that get no tasks; also from another thread.
    """

    cluster: str = scheduler.LOCAL_CLUSTER
    junctions: Sequence[str] = ()
    overrides: Sequence[str] = ()
    progress: ProgressCallback = no_progress
    on_done: Callable[[JobResult], None] = lambda _: None
    on_message: Callable[[str], None] = print_to_stderr


@dataclass(frozen=True)
class CityRun:
    """The result of a city run: the folder, its junctions, the best first, the files beside their runs, and costs."""

    out: Path
    results: tuple[JunctionResult, ...]
    files: tuple[Path, ...]
    warnings: tuple[Diagnostic, ...] = ()
    costs: CityCosts = field(default_factory=CityCosts)


@dataclass(frozen=True)
class CityPlacement:
    """A city's plan, the city run that it was made from, and the files that were written."""

    city_run: CityRun
    plan: CityPlan
    files: tuple[Path, ...]


def run_city(city: City, out: str | Path | None = None, options: CityRunOptions | None = None) -> CityRun:
    """Run the junctions of a city.

    Parameters
    ----------
    city
        From :func:`egvs.extensions.city.model.load_city`.
    out
        The folder of the city run; ``runs/<name of the city>`` when None, or, with overrides, that and their label
        (see :mod:`egvs.runs.run_names`).
    options
        Options of the run; the defaults when None.

    Raises
    ------
    InputError
        When the city, a scenario or an option is wrong.
    RunError
        When the traffic or a run fails, or the cluster is lost; finished results are kept.
    """
    options = options or CityRunOptions()
    folder = _run_folder(city, out, options.overrides)
    jobs = make_jobs(city, folder, options)
    for job in jobs[:1]:
        job.scenario()  # rejects an invalid override before anything is written
    meter = CostMeter()
    with lock_run_folder(folder):
        scheduler.check_cluster(options.cluster)
        with _connect(city, folder, jobs, options, meter) as cluster:
            ran = _run_jobs(cluster, city, folder, jobs, options, meter)
        with meter.part("page"):
            plan = results.read_plan(folder, [result.junction.id for result in ran.results])
            page_file = page.write_page(folder, city, ran.results, ran.warnings, plan)
        costs = meter.costs()
        return replace(ran, files=(*ran.files, page_file, costs.write(folder)), costs=costs)


@contextmanager
def _connect(
    city: City, folder: Path, jobs: Sequence[Job], options: CityRunOptions, meter: CostMeter
) -> Iterator[Cluster]:
    """Connect to the cluster, and ask its workers; the folder is locked."""
    with ExitStack() as stack:
        with meter.part("start of the workers"):
            client = stack.enter_context(scheduler.connect(options.cluster))
            folders = [city.folder, folder]
            workers = scheduler.checked_workers(client, folders, len(jobs), options.on_message)
            cluster = stack.enter_context(workers)
        yield cluster


def _run_jobs(
    cluster: Cluster, city: City, folder: Path, jobs: Sequence[Job], options: CityRunOptions, meter: CostMeter
) -> CityRun:
    """Run junctions, and write the tables of their results; the folder is locked.

    Junctions whose traffic is locked, or that have none, are left out.
    """
    with meter.part("traffic"), scheduler.SceneTasks(cluster, jobs) as scenes:
        progress = meter.traffic_progress(options.progress)
        traffic = traffic_split.make_city_traffic(city, progress, options.overrides, scenes.start)
    meter.add_traffic(traffic)
    meter.add_scenes(scenes)
    jobs = [job for job in jobs if job.junction not in traffic.left_out]
    if not jobs:
        problem = "all junctions that were selected are left out: their traffic is locked, or they have none"
        raise InputError("--junction", problem, f"Select others, or use less traffic in {city.file}.")

    def on_done(result: JobResult) -> None:
        meter.add_parts(result)
        options.on_done(result)

    with meter.part("junctions"):
        scheduler.run_jobs(cluster.client, jobs, on_done=on_done, progress=options.progress, cluster=cluster)
    with meter.part("tables"):
        junction_results = read_junction_results(folder, [city.junction(job.junction) for job in jobs])
        written = write_results(folder, city, junction_results)
    meter.add_runs(jobs)
    meter.add_processes(cluster, traffic.summary)
    n_sites = sum(result.sites for result in junction_results)
    meter.add_size(jobs, n_sites, traffic, traffic_split.traffic_paths(city, [job.junction for job in jobs]))
    return CityRun(folder, junction_results, written, tuple(collect_warnings([traffic.summary])))


def make_jobs(city: City, out: Path, options: CityRunOptions) -> list[Job]:
    """Return the jobs of the selected junctions, in the city's order.

    Parameters
    ----------
    city, out, options
        The city, the folder of the city run, and its options.

    Raises
    ------
    InputError
        When a junction is unknown, or an override changes the traffic.
    """
    for override in options.overrides:
        key = override.partition("=")[0].strip()
        if key.split(".")[0] == "traffic":
            problem = "the traffic of a city is simulated once for all junctions"
            raise InputError(f"--set {override}", problem, f"Set {key} in {city.file} instead.")
    selected = {city.junction(name).id for name in options.junctions}
    jobs = []
    for junction in city.junctions:
        if not selected or junction.id in selected:
            run_folder = results.junction_run_folder(out, junction.id).absolute()
            scenario_folder = junction.scenario_folder(city).absolute()
            jobs.append(Job(junction.id, scenario_folder, run_folder, tuple(options.overrides)))
    return jobs


def _run_folder(city: City, out: str | Path | None, overrides: Sequence[str]) -> Path:
    if out is not None:
        return Path(out)
    return run_names.run_folder(city.name, run_names.parse_overrides(overrides))


def place_city(
    city: City,
    out: str | Path | None = None,
    options: CityRunOptions | None = None,
    *,
    count: int | None = None,
    budget: float | None = None,
    phases: Sequence[int] = (),
) -> CityPlacement:
    """Find the sensors of a city that are best together.

    Parameters
    ----------
    city, out, options
        As in :func:`run_city`.
    count, budget
        Maximum number of sensors, or maximum cost: exactly one of them.
    phases
        For a count: number of sensors after each phase of the installation, ascending. The count itself is added where
        it is missing.

    Raises
    ------
    InputError
        When the request is invalid, or cannot be summed over junctions.
    """
    options = options or CityRunOptions()
    requested = _check_request(count, budget)
    phases = _check_phases(phases, count)
    folder = _run_folder(city, out, options.overrides)
    jobs = make_jobs(city, folder, options)
    for job in jobs:
        allocation.check_additive_config(job.scenario())

    meter = CostMeter()
    with lock_run_folder(folder):
        scheduler.check_cluster(options.cluster)
        with _connect(city, folder, jobs, options, meter) as cluster:
            ran = _run_jobs(cluster, city, folder, jobs, options, meter)
            ranked = {result.junction.id for result in ran.results}
            jobs = [job for job in jobs if job.junction in ranked]
            with_gain = {result.junction.id for result in ran.results if result.gain > 0}
            useful_jobs = [job for job in jobs if job.junction in with_gain]
            if not useful_jobs:
                raise InputError(city.file, "no site sees any traffic", "Use a city with traffic.")
            blocks = common_blocks(useful_jobs)
            plans, shares = _allocate_sensors(cluster, useful_jobs, count, budget, blocks, options.progress)
        n_forced = sum(junction.plans[0].count for junction in plans)
        if phases and phases[0] < n_forced:
            problem = f"{n_forced} sensors are already installed (placement.forced)"
            raise InputError(f"--phases {phases[0]}", problem, f"Let the first phase end at {n_forced} or more.")

        plan = city_plan.make_city_plan(plans, shares, ran.results[0].best.rank_by, requested, phases, blocks)
        without_gain = [job.junction for job in jobs if job.junction not in with_gain]
        warnings = (*ran.warnings, *overlap_warnings(jobs), *_unseen_junction_warnings(city, without_gain))
        plan_files = results.write_plan(folder, city, plan, [job.junction for job in jobs])
        page_file = page.write_page(folder, city, ran.results, warnings, plan)
    return CityPlacement(replace(ran, warnings=warnings), plan, (*plan_files, page_file))


def _check_request(count: int | None, budget: float | None) -> dict[str, float]:
    """Return the request by the name of its option; raise an InputError if it is invalid."""
    requested = {key: float(value) for key, value in (("count", count), ("budget", budget)) if value is not None}
    if len(requested) != 1:
        problem = f"expected exactly one of the two, got {' and '.join(requested) or 'neither'}"
        raise InputError("--count, --budget", problem, "Use, for example, --count 20 or --budget 800000.")
    if budget is not None and not 0 < budget < float("inf"):
        raise InputError("--budget", f"expected a cost above 0, got {budget:g}", "Use, for example, --budget 800000.")
    return requested


def _check_phases(phases: Sequence[int], count: int | None) -> tuple[int, ...]:
    """Return the number of sensors after each phase; raise an InputError if they are invalid."""
    if not phases:
        return ()
    given = ",".join(map(str, phases))
    if count is None:
        hint = "Use, for example, --count 10 --phases 5,10."
        raise InputError(f"--phases {given}", "phases are numbers of sensors, so they need --count", hint)
    ascending = all(a < b for a, b in pairwise(phases))
    if not ascending or not phases[0] >= 1 or not phases[-1] <= count:
        problem = f"expected ascending numbers of sensors from 1 to the count of {count}"
        raise InputError(f"--phases {given}", problem, "Use, for example, --count 10 --phases 5,10.")
    if phases[-1] < count:
        return (*phases, count)
    return tuple(phases)


def _allocate_sensors(
    cluster: Cluster,
    jobs: Sequence[Job],
    count: int | None,
    budget: float | None,
    blocks: CityBlocks | str,
    progress: ProgressCallback,
) -> tuple[list[JunctionPlans], Allocation]:
    """Return the plans of each junction, and the allocation of the count or budget to them."""
    limit, first_count = _MAX_SENSORS, _MIN_FIRST_COUNT
    if count is not None:
        twice_the_average = 2 * -(-count // len(jobs))
        limit, first_count = count, min(count, max(_MIN_FIRST_COUNT, twice_the_average))

    max_counts = {job.junction: first_count for job in jobs}
    plans: dict[str, JunctionPlans] = {}
    common = blocks if isinstance(blocks, CityBlocks) else None
    while True:
        for result in _compute_plans(cluster, jobs, max_counts, common, with_costs=budget is not None):
            plans[result.junction] = result
            progress("junctions planned", len(plans), len(jobs))

        all_plans = [plans[job.junction] for job in jobs]
        shares = _solve_allocation(all_plans, count, budget)
        max_counts = {}
        for junction, chosen in zip(all_plans, shares.chosen, strict=True):
            uses_largest_plan = junction.plans[chosen].count >= junction.max_count
            if uses_largest_plan and not junction.is_complete and junction.max_count < limit:
                max_counts[junction.junction] = min(limit, 2 * junction.max_count)
        if not max_counts:
            return all_plans, shares


def _compute_plans(
    cluster: Cluster,
    jobs: Sequence[Job],
    max_counts: Mapping[str, int],
    blocks: CityBlocks | None,
    *,
    with_costs: bool,
) -> Iterator[JunctionPlans]:
    """Yield the plans of the junctions in ``max_counts``; finally raise an EgvsError if any of them failed."""
    failures = []
    for count in sorted(set(max_counts.values())):
        count_jobs = [job for job in jobs if max_counts.get(job.junction) == count]
        task = allocation.junction_plans
        for _, result in scheduler.map_junctions(cluster, task, count_jobs, count, with_costs, blocks):
            if isinstance(result, JobFailure):
                failures.append(result)
            else:
                yield result
    scheduler.raise_failures(failures, len(jobs))


def _solve_allocation(plans: Sequence[JunctionPlans], count: int | None, budget: float | None) -> Allocation:
    """Allocate a count or a budget; raise an InputError if there are more forced sensors than the count."""
    if budget is not None:
        return allocation.allocate_budget(plans, budget)
    assert count is not None
    n_forced = sum(junction.plans[0].count for junction in plans)
    if n_forced > count:
        problem = f"{n_forced} sensors are already installed (placement.forced)"
        raise InputError(f"--count {count}", problem, f"Use a count of at least {n_forced}.")
    return allocation.allocate_sensors(plans, count)


def overlap_warnings(jobs: Sequence[Job]) -> Iterator[Diagnostic]:
    """Warn about junctions whose regions of interest overlap: the common part counts twice."""
    boxes = [(job.junction, job.scenario().roi.box) for job in jobs]
    pairs = [f"{a} and {b}" for (a, box), (b, other) in combinations(boxes, 2) if _overlap(box, other)]
    if not pairs:
        return
    problem = f"the regions of {list_first(pairs, _MAX_PAIRS)} overlap, so the overlap counts twice in the city's score"
    yield Diagnostic("regions overlap", "junctions", problem, "Use smaller regions, or drop one of the two junctions.")


def _overlap(box: Roi, other: Roi) -> bool:
    """Return whether two boxes overlap, seen from above."""
    for axis in (0, 1):
        end_m = box.origin_m[axis] + box.size_m[axis]
        other_end_m = other.origin_m[axis] + other.size_m[axis]
        if box.origin_m[axis] >= other_end_m - _OVERLAP_TOLERANCE_M:
            return False
        if other.origin_m[axis] >= end_m - _OVERLAP_TOLERANCE_M:
            return False
    return True


def _unseen_junction_warnings(city: City, names: Sequence[str]) -> Iterator[Diagnostic]:
    if names:
        problem = f"no site at {', '.join(names)} sees any traffic, so no sensor is planned there"
        yield Diagnostic("junctions unseen", str(city.file), problem, "Use more traffic, or other candidates.")
