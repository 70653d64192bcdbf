"""Which poles of a whole city: so many sensors, or so much money, where they see most together.

Steps: bring all junctions up to date, as a city run does; ask each what it would make of 1, 2, ... sensors
(:mod:`pipeline.city.planning.options`, tasks of the cluster); share them out (:mod:`pipeline.city.planning.sharing`).
Where a junction would get as many as it was asked about, it is asked about twice as many.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.city import city_run
from pipeline.city.city_run import CityRun
from pipeline.city.model import City
from pipeline.city.planning import options, sharing
from pipeline.city.planning.options import Options, Plan
from pipeline.city.planning.sharing import Shared
from pipeline.city.results import page, plan
from pipeline.city.results.plan import CityPlan, PlannedSensor
from pipeline.city.running import clusters, running
from pipeline.city.running.jobs import Done, Failed, Job, Order
from pipeline.core.errors import InputError
from pipeline.core.findings import Finding
from pipeline.core.progress import Progress, silent
from pipeline.runs.locking import alone

if TYPE_CHECKING:
    from distributed import Client

_FIRST = 4
"""Sensors that junctions are asked about at first, at least."""


@dataclass(frozen=True)
class CityPlacement:
    """A city's plan, the run that it is made from, and what was written."""

    ran: CityRun
    plan: CityPlan
    files: tuple[Path, ...]


def place(
    city: City,
    out: str | Path | None = None,
    *,
    count: int | None = None,
    budget: float | None = None,
    where: str = clusters.LOCAL,
    only: Collection[str] = (),
    sets: Sequence[str] = (),
    progress: Progress = silent,
    heard: Callable[[Done], None] = lambda _: None,
) -> CityPlacement:
    """The poles of a city that are best together.

    Parameters
    ----------
    count, budget
        One of them: sensors at most, or what they may cost.
    out, where, only, sets, heard
        As :func:`pipeline.city.city_run.run` takes them.

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
    chosen, folder = city_run.choose(city, only), city_run.folder_of(city, out)
    jobs = city_run.jobs_of(city, folder, chosen, sets)
    for job in jobs:
        options.check(job.scenario())
    with alone(folder):
        clusters.check(where)
        with clusters.connected(where) as client:
            ran = city_run.run_on(client, city, folder, chosen, sets, progress, heard)
            seen = [its.junction.id for its in ran.results if its.gain > 0]
            wanted = [job for job in jobs if job.junction in seen]
            if not wanted:
                raise InputError(city.file, "no pole sees anything of the traffic", "a city with traffic")
            shared, of = _share(client, wanted, count, budget, progress)
        rank_by = ran.results[0].best.rank_by
        told = _told(wanted, of, shared, rank_by, {"count": count} if budget is None else {"budget": budget})
        ids = [junction.id for junction in chosen]
        warnings = (*ran.warnings, *overlaps(jobs), *_unseen(city, [i for i in ids if i not in seen]))
        written = plan.write(folder, city, told, ids), page.write(folder, city, ran.results, warnings, told)
    return CityPlacement(CityRun(folder, ran.results, ran.files, warnings), told, written)


def _share(
    client: Client, jobs: Sequence[Job], count: int | None, budget: float | None, progress: Progress
) -> tuple[Shared, dict[str, Options]]:
    """The plan that each junction gets, and what each could get."""
    order, found = running.give_order(), dict[str, Options]()
    limit = count if count is not None else 10**6
    most = dict.fromkeys((job.junction for job in jobs), min(limit, max(_FIRST, 2 * -(-limit // len(jobs)))))
    if budget is not None:
        most = dict.fromkeys(most, _FIRST)
    asked: Sequence[Job] = jobs
    while True:
        failed = []
        for job, its in _answers(client, asked, order, most, budget is not None):
            if isinstance(its, Failed):
                failed.append(its)
            else:
                found[job.junction] = its
            progress("junctions asked", len(found), len(jobs))
        running.tell(failed, len(jobs))
        every = [found[job.junction] for job in jobs]
        shared = _solved(every, count, budget)
        short = [its for its, at in zip(every, shared.chosen, strict=True) if _is_short(its, at, limit)]
        if not short:
            return shared, found
        most |= {its.junction: min(limit, 2 * its.most) for its in short}
        asked = [job for job in jobs if job.junction in {its.junction for its in short}]


def _answers(
    client: Client, jobs: Sequence[Job], order: Order, most: Mapping[str, int], costs_count: bool
) -> Iterator[tuple[Job, Options | Failed]]:
    for number in sorted({most[job.junction] for job in jobs}):
        alike = [job for job in jobs if most[job.junction] == number]
        yield from running.each(client, options.options, alike, order, number, costs_count)


def _solved(every: Sequence[Options], count: int | None, budget: float | None) -> Shared:
    """InputError where what is there already is more than was asked for."""
    if count is None:
        assert budget is not None
        return sharing.by_budget(every, budget)
    there = sum(its.plans[0].count for its in every)
    if there > count:
        raise InputError(
            f"--count {count}", f"{there} sensors are there already (placement.forced)", f"at least {there}"
        )
    return sharing.by_count(every, count)


def _is_short(its: Options, at: int, limit: int) -> bool:
    """Whether a junction gets as many sensors as it was asked about, and more could add something."""
    return not its.is_whole and its.plans[at].count >= its.most and its.most < limit


def _told(
    jobs: Sequence[Job], of: Mapping[str, Options], shared: Shared, rank_by: str, asked: Mapping[str, float | None]
) -> CityPlan:
    """The plan of the city in the order in which its sensors would be put up."""
    plans = {job.junction: of[job.junction].plans[at] for job, at in zip(jobs, shared.chosen, strict=True)}
    sensors, score = [], 0.0
    for number, (junction, pick) in enumerate(_in_order(plans), start=1):
        score += pick.gain
        site = pick.site
        sensors.append(
            PlannedSensor(
                number, junction, site.name, site.pole or site.name, **asdict(site.pose), sensor=site.sensor,
                forced=pick.is_forced, gain=pick.gain, score=score, cost=pick.cost,
            )
        )  # fmt: skip
    every = [of[job.junction] for job in jobs]
    together, candidates = sum(its.together for its in every), sum(len(its.least_costs) - 1 for its in every)
    curve = tuple((float(best), float(bound)) for best, bound in shared.curve)
    numbers = {key: float(value) for key, value in asked.items() if value is not None}
    return CityPlan(
        tuple(sensors), rank_by, numbers, shared.value, shared.bound, together, candidates, len(jobs), curve
    )


def _in_order(plans: Mapping[str, Plan]) -> Iterator[tuple[str, options.Pick]]:
    """What is there already; then, of the junctions' next sensors, each time the one that adds most."""
    left = {name: list(plan.picks) for name, plan in plans.items() if plan.picks}
    while left:
        name = max(left, key=lambda its: (left[its][0].is_forced, left[its][0].gain))
        yield name, left[name].pop(0)
        if not left[name]:
            del left[name]


def overlaps(jobs: Sequence[Job]) -> Iterator[Finding]:
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
        yield Finding("regions overlap", "junctions", found, "smaller regions, or one of the two junctions")


def _unseen(city: City, names: Sequence[str]) -> Iterator[Finding]:
    if names:
        found = f"no pole of {', '.join(names)} sees anything of the traffic: no sensor is planned there"
        yield Finding("junctions unseen", str(city.file), found, "more traffic, or other candidates")
