"""What a city run costs: the time of its parts and of all stages, and the peak memory of every process.

Times and memory differ from run to run, so they are in a file of their own, ``OUT/costs.json``, not on the page.
"""

from __future__ import annotations

import socket
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from time import perf_counter
from typing import Any

from egvs.artefacts.run_record import RunRecord
from egvs.city.scheduler import Cluster
from egvs.core import files
from egvs.core.resource_usage import process_peak_mb

COSTS_FILE = "costs.json"
"""In the folder of a city run."""


@dataclass(frozen=True)
class PartCost:
    """Wall time of a part of the run, e.g. ``"junctions"``."""

    part: str
    seconds: float


@dataclass(frozen=True)
class StageCost:
    """A stage at all junctions: the sum of the times, and the highest memory, when its artefacts were made."""

    stage: str
    seconds: float
    peak_mb: float


@dataclass(frozen=True)
class ProcessCost:
    """Peak memory of a process since its start, in MB of 2**20 bytes."""

    process: str
    host: str
    peak_mb: float


@dataclass(frozen=True)
class CityCosts:
    """Costs of a city run: its parts in order, the stages of all junctions, and all processes."""

    parts: tuple[PartCost, ...] = ()
    stages: tuple[StageCost, ...] = ()
    processes: tuple[ProcessCost, ...] = ()

    def write(self, out: Path) -> Path:
        """Write :data:`COSTS_FILE` into the folder of a city run; return its path."""
        path = out / COSTS_FILE
        files.write_text(path, files.to_json_text(asdict(self), indent=1) + "\n")
        return path


class CostMeter:
    """Collects the costs of a run while it goes on."""

    def __init__(self) -> None:
        self._parts: list[PartCost] = []
        self._stages: tuple[StageCost, ...] = ()
        self._processes: tuple[ProcessCost, ...] = ()

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Measure the time of a part."""
        start_s = perf_counter()
        yield
        self._parts.append(PartCost(name, round(perf_counter() - start_s, 3)))

    def add_runs(self, runs: Sequence[Path]) -> None:
        """Add the stages of the runs of all junctions."""
        self._stages = tuple(_stage_costs(runs))

    def add_processes(self, cluster: Cluster, traffic: Mapping[str, Any]) -> None:
        """Ask the connected workers and the scheduler for their memory; ``traffic`` is the summary of the traffic."""
        self._processes = tuple(_process_costs(cluster, traffic))

    def costs(self) -> CityCosts:
        """Return what was collected, and the memory of this process."""
        this_process = ProcessCost("egvs", socket.gethostname(), round(process_peak_mb(), 1))
        return CityCosts(tuple(self._parts), self._stages, (this_process, *self._processes))


def _stage_costs(runs: Sequence[Path]) -> Iterator[StageCost]:
    by_stage: dict[str, list[Any]] = {}
    for folder in runs:
        for name, stage in RunRecord.read(folder).stages.items():
            by_stage.setdefault(name, []).append(stage.cost)
    for name, costs in by_stage.items():
        seconds = sum(cost.seconds for cost in costs)
        yield StageCost(name, round(seconds, 3), max(cost.peak_mb for cost in costs))


def _process_costs(cluster: Cluster, traffic: Mapping[str, Any]) -> Iterator[ProcessCost]:
    client, hosts = cluster.client, cluster.workers.accepted()
    sumo_peak_mb = traffic.get("sumo_peak_mb")
    if sumo_peak_mb is not None:
        yield ProcessCost("SUMO, when the traffic was made", "", sumo_peak_mb)
    if client.cluster is None:  # the scheduler of a local cluster is in this process
        yield ProcessCost("scheduler", "", round(client.run_on_scheduler(process_peak_mb), 1))
    peaks_mb = client.run(process_peak_mb, workers=list(hosts), on_error="return")
    for address in sorted(peaks_mb):
        if isinstance(peaks_mb[address], float):  # else the worker was lost just now
            yield ProcessCost(f"worker {address}", hosts[address], round(peaks_mb[address], 1))
