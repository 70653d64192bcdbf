"""What a city run costs: the time of its parts and of all stages, the peak memory of every process, and its size.

The parts follow one another. The steps of the part "traffic" are measured too; workers prepare scenes beside them.

Times and memory differ from run to run, so they are in a file of their own, ``OUT/costs.json``, not on the page.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from time import perf_counter
from typing import Any

from egvs.artefacts.run_record import RunRecord
from egvs.core import files
from egvs.core.progress import ProgressCallback
from egvs.core.resource_usage import ResourceUsage, process_peak_mb
from egvs.extensions.city.scheduler import Cluster, SceneTasks
from egvs.extensions.city.tasks import SCORED_PARTS, Job, JobResult
from egvs.extensions.city.traffic_split import CityTraffic

COSTS_FILE = "costs.json"
"""In the folder of a city run."""


TRAFFIC_PART, SCENES_STEP = "traffic", "worlds and scans, beside it"
ROUTES_STEP, SUMO_STEP, SPLIT_STEP = "routes", "SUMO", "split"
"""Steps of the traffic: preparing the simulation, SUMO, and writing the files of the junctions."""

_SIMULATED = "frames simulated"
"""What is counted while SUMO runs."""


@dataclass(frozen=True)
class PartCost:
    """Wall time of a part of the run, e.g. ``"junctions"``.

    Attributes
    ----------
    part
        The part.
    seconds
        Its duration; of a step that is repeated for each period, the sum.
    start_s, end_s
        From the start of the run.
    within
        The part that contains this step; empty for a part. Parts do not overlap, steps may.
    """

    part: str
    seconds: float
    start_s: float
    end_s: float
    within: str = ""


@dataclass(frozen=True)
class StageCost:
    """A stage at all junctions: the sum of the times, and the highest memory, when its artefacts were made."""

    stage: str
    seconds: float
    peak_mb: float


@dataclass(frozen=True)
class ProcessCost:
    """What a process has used since its start.

    Attributes
    ----------
    process, host
        The process, and the name of its machine.
    peak_mb
        Peak memory, in MB of 2**20 bytes.
    busy_s
        Processor seconds, which do not depend on what else the machine does; of SUMO together with the programs that
        prepare it. None where they are not known.
    """

    process: str
    host: str
    peak_mb: float
    busy_s: float | None = None


@dataclass(frozen=True)
class RunSize:
    """Size of a city run.

    Attributes
    ----------
    city_junctions
        Junctions that share the traffic.
    junctions, sites
        Junctions that were ranked, and their candidate sites.
    frames
        Frames of each junction.
    rows
        Vehicles near a junction in a frame, summed over all frames and junctions.
    run_bytes, traffic_bytes
        Size of the folders of the runs of all junctions, and of the files of their traffic.
    """

    city_junctions: int = 0
    junctions: int = 0
    sites: int = 0
    frames: int = 0
    rows: int = 0
    run_bytes: int = 0
    traffic_bytes: int = 0


@dataclass(frozen=True)
class CityCosts:
    """Costs of a city run: its parts in order, the stages of all junctions, and all processes; its size."""

    parts: tuple[PartCost, ...] = ()
    stages: tuple[StageCost, ...] = ()
    processes: tuple[ProcessCost, ...] = ()
    size: RunSize = field(default_factory=RunSize)

    def write(self, out: Path) -> Path:
        """Write :data:`COSTS_FILE` into the folder of a city run; return its path."""
        path = out / COSTS_FILE
        files.write_text(path, files.to_json_text(asdict(self), indent=1) + "\n")
        return path


class CostMeter:
    """Collects the costs of a run while it goes on."""

    def __init__(self) -> None:
        self._start_s = perf_counter()
        self._parts: list[PartCost] = []
        self._steps: dict[str, PartCost] = {}
        self._stages: list[StageCost] = []
        self._part_costs: list[ResourceUsage] = []
        self._processes: tuple[ProcessCost, ...] = ()
        self._busy_before_traffic_s = 0.0
        self._sumo_busy_s: float | None = None
        self._size = RunSize()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Measure the time of a part."""
        start_s = self._now_s()
        yield
        end_s = self._now_s()
        self._parts.append(PartCost(name, round(end_s - start_s, 3), round(start_s, 3), round(end_s, 3)))

    def _now_s(self) -> float:
        return perf_counter() - self._start_s

    def traffic_progress(self, progress: ProgressCallback) -> ProgressCallback:
        """Return a callback that measures the steps of the traffic, which starts now, and calls ``progress``."""
        last_s = self._now_s()
        self._busy_before_traffic_s = _busy_of_ended_programs_s()

        def measure_step(what: str, done: int, total: int) -> None:
            nonlocal last_s
            now_s = self._now_s()
            self._add_to_step(SUMO_STEP if what == _SIMULATED else SPLIT_STEP, last_s, now_s)
            last_s = now_s
            progress(what, done, total)

        return measure_step

    def add_traffic(self, traffic: CityTraffic) -> None:
        """Separate the preparation of the simulation from SUMO, which was measured with it."""
        sumo_s = traffic.summary.get("sumo_seconds")
        both = self._steps.pop(SUMO_STEP, None)
        if both is None or sumo_s is None:
            return
        self._sumo_busy_s = round(_busy_of_ended_programs_s() - self._busy_before_traffic_s, 2)
        routes_s = max(0.0, both.seconds - sumo_s)
        self._add_to_step(ROUTES_STEP, both.start_s, both.start_s + routes_s)
        self._add_to_step(SUMO_STEP, both.start_s + routes_s, both.end_s)
        self._steps[SUMO_STEP] = replace(self._steps[SUMO_STEP], seconds=sumo_s)

    def _add_to_step(self, step: str, start_s: float, end_s: float) -> None:
        earlier = self._steps.get(step, PartCost(step, 0.0, round(start_s, 3), 0.0, TRAFFIC_PART))
        seconds = round(earlier.seconds + end_s - start_s, 3)
        self._steps[step] = replace(earlier, seconds=seconds, end_s=round(end_s, 3))

    def add_scenes(self, scenes: SceneTasks) -> None:
        """Add the preparation of the scenes, if any was necessary."""
        results = scenes.results()
        if not results:
            return
        self._add_to_step(SCENES_STEP, scenes.start_s - self._start_s, scenes.end_s - self._start_s)
        by_work: dict[str, list[ResourceUsage]] = {}
        for result in results:
            for work, cost in result.costs.items():
                by_work.setdefault(work, []).append(cost)
        for work, costs in by_work.items():
            self._add_stage(work, costs)

    def add_runs(self, jobs: Sequence[Job]) -> None:
        """Add the stages of the runs of all junctions."""
        by_stage: dict[str, list[ResourceUsage]] = {}
        for job in jobs:
            for name, stage in RunRecord.read(job.out).stages.items():
                by_stage.setdefault(name, []).append(stage.cost)
        for name, costs in by_stage.items():
            self._add_stage(name, costs)
        if self._part_costs:
            self._add_stage(SCORED_PARTS, self._part_costs)

    def add_parts(self, result: JobResult) -> None:
        """Add the scores of a large junction, which were made in several tasks."""
        self._part_costs += result.part_costs

    def _add_stage(self, name: str, costs: Sequence[ResourceUsage]) -> None:
        seconds = round(sum(cost.seconds for cost in costs), 3)
        self._stages.append(StageCost(name, seconds, round(max(cost.peak_mb for cost in costs), 1)))

    def add_size(self, jobs: Sequence[Job], sites: int, traffic: CityTraffic, traffic_files: Iterable[Path]) -> None:
        """Add the size of a run.

        Parameters
        ----------
        jobs
            The junctions that were ranked.
        sites
            Their candidate sites.
        traffic
            The city's traffic.
        traffic_files
            The files of the traffic of these junctions.
        """
        rows = sum(traffic.rows[job.junction] for job in jobs)
        run_bytes = sum(_folder_bytes(job.out) for job in jobs)
        traffic_bytes = sum(path.stat().st_size for path in traffic_files)
        self._size = RunSize(len(traffic.rows), len(jobs), sites, traffic.frames, rows, run_bytes, traffic_bytes)

    def add_processes(self, cluster: Cluster, traffic: Mapping[str, Any]) -> None:
        """Ask the connected workers and the scheduler for their memory; ``traffic`` is the summary of the traffic."""
        self._processes = tuple(_process_costs(cluster, traffic, self._sumo_busy_s))

    def costs(self) -> CityCosts:
        """Return what was collected, and the memory of this process."""
        this_process = ProcessCost("egvs", socket.gethostname(), *_usage_of_this_process())
        processes = this_process, *self._processes
        return CityCosts(tuple(self._parts_and_steps()), tuple(self._stages), processes, self._size)

    def _parts_and_steps(self) -> Iterator[PartCost]:
        """Yield the parts in order, each followed by its steps."""
        for part in self._parts:
            yield part
            if part.part == TRAFFIC_PART:
                yield from sorted(self._steps.values(), key=lambda step: step.start_s)


def _folder_bytes(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def _process_costs(cluster: Cluster, traffic: Mapping[str, Any], sumo_busy_s: float | None) -> Iterator[ProcessCost]:
    client, hosts = cluster.client, cluster.workers.accepted()
    sumo_peak_mb = traffic.get("sumo_peak_mb")
    if sumo_peak_mb is not None:
        yield ProcessCost("SUMO, when the traffic was made", "", sumo_peak_mb, sumo_busy_s)
    if client.cluster is None:  # the scheduler of a local cluster is in this process
        yield ProcessCost("scheduler", "", *client.run_on_scheduler(_usage_of_this_process))
    usages = client.run(_usage_of_this_process, workers=list(hosts), on_error="return")
    for address in sorted(usages):
        if isinstance(usages[address], tuple):  # else the worker was lost just now
            yield ProcessCost(f"worker {address}", hosts[address], *usages[address])


def _usage_of_this_process() -> tuple[float, float]:
    """Return its peak memory in MB, and its processor seconds."""
    return round(process_peak_mb(), 1), round(sum(os.times()[:2]), 2)


def _busy_of_ended_programs_s() -> float:
    """Return the processor seconds of the programs that this process has started and that have ended."""
    return sum(os.times()[2:4])
