"""A whole city run: the traffic once, every junction on a cluster, and what came of them brought together.

Each junction's folder holds, byte for byte, what ``egvs run`` of its scenario alone would write: tasks call the same
stages, and share what they make through the store.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pipeline.city import traffic
from pipeline.city.model import City, CityJunction
from pipeline.city.results import junctions, page, plan
from pipeline.city.results.junctions import JunctionResult
from pipeline.city.running import clusters, running
from pipeline.city.running.jobs import Done, Job
from pipeline.core.errors import InputError
from pipeline.core.findings import Finding, warnings_of
from pipeline.core.progress import Progress, silent
from pipeline.runs.locking import alone

if TYPE_CHECKING:
    from distributed import Client


@dataclass(frozen=True)
class CityRun:
    """What came of a city: its junctions, the best first, and the files beside their runs."""

    out: Path
    results: tuple[JunctionResult, ...]
    files: tuple[Path, ...]
    warnings: tuple[Finding, ...] = ()


def run(
    city: City,
    out: str | Path | None = None,
    *,
    where: str = clusters.LOCAL,
    only: Collection[str] = (),
    sets: Sequence[str] = (),
    progress: Progress = silent,
    heard: Callable[[Done], None] = lambda _: None,
) -> CityRun:
    """Run a city's junctions.

    Parameters
    ----------
    out
        Its folder; ``runs/<city's name>`` when None.
    where
        As ``--cluster`` says it, see :func:`pipeline.city.running.clusters.connected`.
    only
        Names of junctions; all when there is none.
    sets
        Laid over every junction's scenario, as ``egvs run --set`` does; no key of the traffic, which is the city's.
    heard
        Called with each junction as it is done.

    Raises
    ------
    InputError
        Where the city, a scenario or ``where`` is wrong.
    RunError
        Where the traffic or a run cannot keep its promise, or the cluster is lost; what is done is kept then.
    """
    chosen, folder = choose(city, only), folder_of(city, out)
    _refuse_traffic(city, sets)
    with alone(folder):
        clusters.check(where)
        with clusters.connected(where) as client:
            ran = run_on(client, city, folder, chosen, sets, progress, heard)
        planned = plan.read(folder, [junction.id for junction in chosen])
        return replace(ran, files=(*ran.files, page.write(folder, city, ran.results, ran.warnings, planned)))


def run_on(
    client: Client,
    city: City,
    folder: Path,
    chosen: Sequence[CityJunction],
    sets: Sequence[str],
    progress: Progress,
    heard: Callable[[Done], None],
) -> CityRun:
    """Run junctions on a cluster that is there, and bring their scores together; for those who hold the folder."""
    order = running.give_order()
    made = traffic.make(city, progress, sets)
    running.run(client, jobs_of(city, folder, chosen, sets), order, heard=heard, progress=progress)
    results = junctions.read_runs(folder, chosen)
    return CityRun(folder, results, junctions.write(folder, city, results), tuple(warnings_of([made.summary])))


def choose(city: City, only: Collection[str]) -> tuple[CityJunction, ...]:
    """The junctions of these names, in the city's order; all where there is none."""
    names = {city.junction(name).id for name in only}
    return tuple(junction for junction in city.junctions if not names or junction.id in names)


def jobs_of(city: City, out: Path, chosen: Sequence[CityJunction], sets: Sequence[str]) -> list[Job]:
    """What workers get of junctions."""
    _refuse_traffic(city, sets)
    return [
        Job(its.id, its.scenario_folder(city).absolute(), junctions.run_folder(out, its.id).absolute(), tuple(sets))
        for its in chosen
    ]


def _refuse_traffic(city: City, sets: Sequence[str]) -> None:
    for override in sets:
        key = override.partition("=")[0].strip()
        if key.split(".")[0] == "traffic":
            found = "the traffic of a city is simulated once, for all of its junctions"
            raise InputError(f"--set {override}", found, f"{key} in {city.file}, then this command without it")


def folder_of(city: City, out: str | Path | None) -> Path:
    """Where a city run goes: ``runs/<city's name>`` where no folder is given."""
    return Path(out) if out is not None else Path("runs") / city.name
