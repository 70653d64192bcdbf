"""What a city run costs on one worker and on two, and what is left of it when workers are killed.

Each runs a synthetic city (junctions of :mod:`benchmarks.scaling`) with a store of its own:

- ``python -m benchmarks.city speed``: sites a second of one worker and of two.
- ``python -m benchmarks.city overhead``: what a task takes beside its work.
- ``python -m benchmarks.city flat``: milliseconds a site, from 10 to 10,000 sites of one junction and from 1 to 50
  junctions, and the workers' memory.

``python -m benchmarks.city kills`` ends random workers with SIGKILL at random moments, ten times, and compares every
artefact with those of a run that was left alone.
"""

from __future__ import annotations

import argparse
import collections
import hashlib
import os
import random
import shutil
import signal
import statistics
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from scipy.stats import qmc

from benchmarks.scaling import Size, prepare, sides
from egvs.artefacts.run_record import RunRecord
from egvs.city import scheduler, tasks
from egvs.city.tasks import Job, JobResult
from egvs.runs import run
from egvs.runs.store import Store

KILLS = 10

_DATA = ("scores.parquet", "tpog.parquet", "trajectories.parquet", "statics.ply")


def build(folder: Path, sizes: dict[str, Size]) -> list[Job]:
    """A synthetic city: the jobs of its junctions."""
    for name, size in sizes.items():
        if not (folder / name).exists():
            prepare(size, folder / name)
    return [Job(name, folder / name, folder.parent / "out" / name) for name in sizes]


@contextmanager
def fresh(jobs: list[Job]) -> Iterator[None]:
    """Nothing was made before: a new store, and no runs."""
    for job in jobs:
        shutil.rmtree(job.out, ignore_errors=True)
    with tempfile.TemporaryDirectory() as store:
        os.environ["EGVS_STORE"] = store
        yield


def timed(client: Any, jobs: list[Job]) -> tuple[float, list[JobResult]]:
    """Seconds of a run that finds nothing, and what its tasks say."""
    done: list[JobResult] = []
    with fresh(jobs):
        start = time.perf_counter()
        scheduler.run_jobs(client, jobs, on_done=done.append)
        return time.perf_counter() - start, done


def warm(client: Any, folder: Path) -> None:
    """Have every worker compile, or load, its kernels."""
    (job,) = build(folder / "warm", {"w": Size(sites=2, frames=10)})
    workers = list(client.scheduler_info()["workers"])
    client.gather([client.submit(_warm, job, number, workers=[its]) for number, its in enumerate(workers)])


def _warm(job: Job, number: int) -> None:
    os.environ["EGVS_STORE"] = ""
    run.run(job.scenario(), job.out.with_name(f"{job.out.name}{number}"), jobs=1)


# ---- speed


def speed(folder: Path, repeats: int) -> None:
    """Print sites a second of one worker and of two, and how flat the cost is."""
    large = Size(sites=200, frames=100, beams=57_600 // 2)
    jobs = build(folder / "two", {f"j{i}": large for i in range(6)})
    sites = large.sites * len(jobs)
    rates: dict[int, list[float]] = {1: [], 2: []}
    for _ in range(repeats):
        for count in (1, 2):
            with scheduler.connect(f"processes={count}") as client:
                warm(client, folder)
                seconds, _ = timed(client, jobs)
                rates[count].append(sites / seconds)
                print(f"{count} workers: {sites} sites in {seconds:.2f} s, {sites / seconds:.1f} sites/s", flush=True)
    ratio = [two / one for one, two in zip(rates[1], rates[2], strict=True)]
    print(f"two workers do {statistics.median(ratio):.2f} times as many (of {[round(r, 2) for r in ratio]})")


def overhead(folder: Path) -> None:
    """Print what tasks that score take beside scoring: workers' time from the first to the last, by the scheduler's
    record, against what the store says of the parts that they made."""
    from distributed import get_task_stream

    jobs = build(folder / "one", {"big": Size(sites=2400, frames=100, beams=57_600 // 2)})
    with scheduler.connect("processes=2") as client:
        warm(client, folder)
        empty = []
        for _ in range(200):
            start = time.perf_counter()
            client.submit(int, 1, pure=False).result()
            empty.append(time.perf_counter() - start)
        with fresh(jobs), get_task_stream(client) as stream:
            scheduler.run_jobs(client, jobs)
            work_s = sum(
                entry.made.cost.seconds for entry in Store.default().entries() if entry.stage == tasks.PART_KIND
            )
    times: dict[str, list[tuple[float, float]]] = collections.defaultdict(list)
    for its in stream.data:
        if its["key"].startswith("score-"):
            times[its["worker"]] += [(s["start"], s["stop"]) for s in its["startstops"] if s["action"] == "compute"]
    count = sum(map(len, times.values()))
    inside_s = sum(stop - start for its in times.values() for start, stop in its)
    all_s = sum(max(stop for _, stop in its) - min(start for start, _ in its) for its in times.values())
    print(f"{count} tasks took {inside_s:.2f} s, of which they scored for {work_s:.2f} s; {all_s - inside_s:.2f} s lay")
    print(f"between them: {all_s / work_s - 1:.2%} beside the work; an empty task, there and back, takes")
    print(f"{1e3 * statistics.median(empty):.1f} ms, {statistics.median(empty) * count / work_s:.2%} of it")


def flat(folder: Path) -> None:
    """Print what scoring takes a site, from few sites to many and from one junction to many, beside what it takes a
    junction: that of junctions of one site, which is taken off."""
    with scheduler.connect("processes=2") as client:
        warm(client, folder)

        def costs(junctions: int, sites: int) -> tuple[float, float, float]:
            jobs = spread(folder / f"{junctions}x{sites}", junctions, Size(sites=sites, frames=100))
            with fresh(jobs):
                scheduler.run_jobs(client, jobs)
                made = [entry.made for entry in Store.default().entries() if entry.stage == tasks.PART_KIND]
            stages = [RunRecord.read(job.out).stages for job in jobs]
            scoring = sum(its["score"].cost.seconds for its in stages) + sum(its.cost.seconds for its in made)
            report = sum(its["report"].cost.seconds for its in stages)
            peaks = [stage.cost.peak_mb for its in stages for stage in its.values()] + [
                its.cost.peak_mb for its in made
            ]
            return scoring / junctions, report / junctions, max(peaks)

        own, *_ = costs(20, 1)
        print(f"a junction by itself: {1e3 * own:.0f} ms", flush=True)
        for junctions, sites in ((20, 10), (5, 100), (2, 1000), (1, 10_000), (1, 100), (20, 100), (50, 100)):
            scoring, report, most_mb = costs(junctions, sites)
            print(f"{junctions} junctions of {sites} sites: {1e3 * (scoring - own) / (sites - 1):.2f} ms a site; "
                  f"report {report:.2f} s a junction; peak of a worker {most_mb:.0f} MB", flush=True)  # fmt: skip


def spread(folder: Path, junctions: int, size: Size) -> list[Job]:
    """Junctions whose sites lie at other places each, all of them evenly: so that few are what many are."""
    jobs = build(folder, {f"j{i}": size for i in range(junctions)})
    places = qmc.Halton(2, scramble=False).random(junctions * size.sites + 1)[1:] * sides(size.hectares)
    for job, its in zip(jobs, np.split(places, junctions), strict=True):
        rows = [f"s{i},{x!r},{y!r},4" for i, (x, y) in enumerate(its.tolist())]
        (job.folder / "sites.csv").write_text("\n".join(["site,x_m,y_m,z_m", *rows]) + "\n", encoding="utf-8")
    return jobs


# ---- loss


def kills(folder: Path, seed: int, count: int = KILLS) -> None:
    """Kill workers, and see that nothing else comes out."""
    rng, sizes = random.Random(seed), {f"j{i}": Size(sites=10, frames=50) for i in range(3)}
    sizes["big"] = Size(sites=120, frames=50)
    jobs, killed, runs = build(folder / "kills", sizes), 0, 0
    with scheduler.connect("processes=2") as client:
        warm(client, folder)
        seconds, _ = timed(client, jobs)
        wanted = digests(jobs)
        print(f"left alone: {seconds:.1f} s", flush=True)
        while killed < count:
            stop = threading.Event()
            moments = sorted(rng.uniform(0.0, seconds) for _ in range(min(3, count - killed)))
            told: list[str] = []
            killer = threading.Thread(target=_kill, args=(moments, random.Random(rng.random()), stop, told))
            with fresh(jobs):
                killer.start()
                scheduler.run_jobs(client, jobs)
                stop.set()
                killer.join()
            killed, runs = killed + len(told), runs + 1
            same = digests(jobs) == wanted
            verdict = "same bytes" if same else "OTHER BYTES"
            print(f"run {runs}: {'; '.join(told) or 'nobody was there to kill'}: {verdict}", flush=True)
            if not same:
                sys.exit(1)
    print(f"{killed} kills in {runs} runs: the same bytes in all")


def _kill(moments: list[float], rng: random.Random, stop: threading.Event, told: list[str]) -> None:
    start = time.perf_counter()
    for moment in moments:
        if stop.wait(max(0.0, moment - (time.perf_counter() - start))):
            return
        if pids := workers():
            pid = rng.choice(pids)
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
                told.append(f"worker {pid} killed after {time.perf_counter() - start:.1f} s")


def workers() -> list[int]:
    """The processes that Dask has started here, those that only start as well."""
    found = []
    for its in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):  # it has ended meanwhile
            if any("spawn_main" in word for word in its.cmdline()):
                found.append(its.pid)
    return found


def digests(jobs: list[Job]) -> dict[str, str]:
    """Of every artefact that shows no cost."""
    paths = [job.out / name for job in jobs for name in _DATA]
    return {f"{path.parent.name}/{path.name}": hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def main() -> None:
    """Measure what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("speed", "flat", "overhead", "kills"))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--most-beams", type=int, help="of a task, so that small cities are cut too")
    asked = parser.parse_args()
    if asked.most_beams:
        scheduler.MIN_TASK_BEAMS = scheduler.MAX_TASK_BEAMS = asked.most_beams
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        match asked.what:
            case "speed":
                speed(folder, asked.repeats)
            case "flat":
                flat(folder)
            case "overhead":
                overhead(folder)
            case "kills":
                kills(folder, asked.seed)


if __name__ == "__main__":
    main()
