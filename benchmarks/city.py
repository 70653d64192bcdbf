"""Cost of a city run on one and two workers, and its results when workers are killed.

Each command runs a synthetic city (junctions of :mod:`benchmarks.scaling`) with its own cache:

- ``python -m benchmarks.city speed``: sites per second with one worker and with two.
- ``python -m benchmarks.city overhead``: time of tasks in addition to their work.
- ``python -m benchmarks.city flat``: milliseconds per site, from 10 to 10,000 sites per junction and from 1 to 50
  junctions, and the workers' memory.

``python -m benchmarks.city overlap --osm FILE`` creates a city of an OpenStreetMap extract and runs it in pairs: its
traffic first and then the junctions, and with scenes that are prepared while SUMO runs.

``python -m benchmarks.city store`` measures the time of adding an entry to a cache of 100 and of 7,000 entries.

``python -m benchmarks.city kills`` ends random workers with SIGKILL at random moments, ten times, and compares every
artefact with those of an undisturbed run.
"""

from __future__ import annotations

import argparse
import collections
import hashlib
import os
import random
import re
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
from egvs.core import files
from egvs.core.resource_usage import ResourceUsage
from egvs.extensions.city import scheduler, tasks, traffic_split
from egvs.extensions.city.city_run import CityRunOptions, run_city
from egvs.extensions.city.commands import print_costs
from egvs.extensions.city.costs import CityCosts
from egvs.extensions.city.creation import NewCityOptions, create_city
from egvs.extensions.city.model import CITY_FILE, TRAFFIC_FOLDER, City, load_city
from egvs.extensions.city.tasks import Job, JobResult
from egvs.runs import run
from egvs.runs.stage_registry import StageResult
from egvs.runs.store import Store

KILLS = 10

_DATA = ("scores.parquet", "tpog.parquet", "trajectories.parquet", "statics.ply")


def build(folder: Path, sizes: dict[str, Size]) -> list[Job]:
    """Write a synthetic city, and return the jobs of its junctions."""
    for name, size in sizes.items():
        if not (folder / name).exists():
            prepare(size, folder / name)
    return [Job(name, folder / name, folder.parent / "out" / name) for name in sizes]


@contextmanager
def fresh(jobs: list[Job]) -> Iterator[None]:
    """Use a new cache, and remove earlier runs."""
    for job in jobs:
        shutil.rmtree(job.out, ignore_errors=True)
    with tempfile.TemporaryDirectory() as store:
        os.environ["EGVS_STORE"] = store
        yield


def timed(client: Any, jobs: list[Job]) -> tuple[float, list[JobResult]]:
    """Return the seconds of a run without cached results, and the results of its tasks."""
    done: list[JobResult] = []
    with fresh(jobs):
        start = time.perf_counter()
        scheduler.run_jobs(client, jobs, on_done=done.append)
        return time.perf_counter() - start, done


def warm(client: Any, folder: Path) -> None:
    """Let every worker compile or load its kernels."""
    (job,) = build(folder / "warm", {"w": Size(sites=2, frames=10)})
    workers = list(client.scheduler_info()["workers"])
    client.gather([client.submit(_warm, job, number, workers=[entry]) for number, entry in enumerate(workers)])


def _warm(job: Job, number: int) -> None:
    os.environ["EGVS_STORE"] = ""
    run.run(job.scenario(), job.out.with_name(f"{job.out.name}{number}"), jobs=1)


# ---- speed


def speed(folder: Path, repeats: int) -> None:
    """Print sites per second with one worker and with two."""
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
    print(f"two workers score {statistics.median(ratio):.2f} times as many (ratios {[round(r, 2) for r in ratio]})")


def overhead(folder: Path) -> None:
    """Print the time of scoring tasks in addition to scoring.

    The workers' time is that from the first task to the last in the scheduler's record; the time of scoring is that of
    the cached parts.

    """
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
    for entry in stream.data:
        if entry["key"].startswith("score-"):
            times[entry["worker"]] += [(s["start"], s["stop"]) for s in entry["startstops"] if s["action"] == "compute"]
    count = sum(map(len, times.values()))
    inside_s = sum(stop - start for entry in times.values() for start, stop in entry)
    all_s = sum(max(stop for _, stop in entry) - min(start for start, _ in entry) for entry in times.values())
    print(f"{count} tasks took {inside_s:.2f} s, including {work_s:.2f} s of scoring; {all_s - inside_s:.2f} s passed")
    print(f"between them: overhead {all_s / work_s - 1:.2%}; the round trip of an empty task takes")
    print(f"{1e3 * statistics.median(empty):.1f} ms, {statistics.median(empty) * count / work_s:.2%} of it")


def flat(folder: Path) -> None:
    """Print the time of scoring per site for several sizes, without the fixed time of a junction."""
    with scheduler.connect("processes=2") as client:
        warm(client, folder)

        def costs(junctions: int, sites: int) -> tuple[float, float, float]:
            jobs = spread(folder / f"{junctions}x{sites}", junctions, Size(sites=sites, frames=100))
            with fresh(jobs):
                scheduler.run_jobs(client, jobs)
                made = [entry.made for entry in Store.default().entries() if entry.stage == tasks.PART_KIND]
            stages = [RunRecord.read(job.out).stages for job in jobs]
            scoring = sum(entry["score"].cost.seconds for entry in stages) + sum(entry.cost.seconds for entry in made)
            report = sum(entry["report"].cost.seconds for entry in stages)
            peaks = [stage.cost.peak_mb for entry in stages for stage in entry.values()] + [
                entry.cost.peak_mb for entry in made
            ]
            return scoring / junctions, report / junctions, max(peaks)

        fixed_s, *_ = costs(20, 1)
        print(f"fixed time per junction: {1e3 * fixed_s:.0f} ms", flush=True)
        for junctions, sites in ((20, 10), (5, 100), (2, 1000), (1, 10_000), (1, 100), (20, 100), (50, 100)):
            scoring, report, peak_mb = costs(junctions, sites)
            print(f"{junctions} junctions of {sites} sites: {1e3 * (scoring - fixed_s) / (sites - 1):.2f} ms per site; "
                  f"report {report:.2f} s per junction; peak of a worker {peak_mb:.0f} MB", flush=True)  # fmt: skip


# ---- work beside the simulation


def overlap(folder: Path, osm: Path, frames: int, junctions: int, repeats: int) -> None:
    """Print the time of a city run in which the traffic is made first, and of one that prepares scenes beside it."""
    create_city(folder / "city", osm, NewCityOptions())
    settings = folder / "city" / CITY_FILE
    text = re.sub("(?m)^frames = .*$", f"frames = {frames}", settings.read_text(encoding="utf-8"))
    settings.write_text(text, encoding="utf-8")
    city = load_city(folder / "city")
    names = [junction.id for junction in city.junctions[:junctions]]
    _run_city(city, names, first_traffic=True)  # kernels are compiled
    ratios = []
    for _ in range(repeats):
        before_s, _ = _run_city(city, names, first_traffic=True)
        after_s, costs = _run_city(city, names, first_traffic=False)
        ratios.append(before_s / after_s)
        print(f"traffic first {before_s:.1f} s, scenes beside it {after_s:.1f} s: {ratios[-1]:.2f} times as fast")
        print_costs(costs)
    print(f"median of {repeats} pairs: {statistics.median(ratios):.2f} times as fast")


def _run_city(city: City, names: list[str], *, first_traffic: bool) -> tuple[float, CityCosts]:
    """Run some junctions of a city without cached results; return the seconds and the costs."""
    shutil.rmtree(city.folder / TRAFFIC_FOLDER, ignore_errors=True)
    options = CityRunOptions(junctions=names, on_message=lambda _: None)
    with tempfile.TemporaryDirectory() as temporary:
        os.environ["EGVS_STORE"] = f"{temporary}/store"
        start = time.perf_counter()
        if first_traffic:
            traffic_split.make_city_traffic(city)
        costs = run_city(city, Path(temporary, "out"), options).costs
        return time.perf_counter() - start, costs


def spread(folder: Path, junctions: int, size: Size) -> list[Job]:
    """Return junctions whose sites are spread evenly, at other positions each."""
    jobs = build(folder, {f"j{i}": size for i in range(junctions)})
    positions = qmc.Halton(2, scramble=False).random(junctions * size.sites + 1)[1:] * sides(size.hectares)
    for job, entry in zip(jobs, np.split(positions, junctions), strict=True):
        rows = [f"s{i},{x!r},{y!r},4" for i, (x, y) in enumerate(entry.tolist())]
        (job.folder / "sites.csv").write_text("\n".join(["site,x_m,y_m,z_m", *rows]) + "\n", encoding="utf-8")
    return jobs


def store(sizes: tuple[int, ...] = (100, 7000), repeats: int = 200) -> None:
    """Print the time of adding an entry to caches of several sizes, and of listing their entries."""
    mean_ms = []
    for size in sizes:
        with tempfile.TemporaryDirectory() as temporary:
            cache, out = Store(Path(temporary, "store")), Path(temporary, "out")
            out.mkdir()
            for number in range(size):
                _put(cache, out, number)
            start = time.perf_counter()
            cache.entries()
            list_ms = 1e3 * (time.perf_counter() - start)
            start = time.perf_counter()
            for number in range(size, size + repeats):
                _put(cache, out, number)
            mean_ms.append(1e3 * (time.perf_counter() - start) / repeats)
            print(
                f"{size} entries: {mean_ms[-1]:.2f} ms per new entry; a list of all takes {list_ms:.0f} ms", flush=True
            )
    print(f"ratio {mean_ms[-1] / mean_ms[0]:.2f}")


def _put(cache: Store, out: Path, number: int) -> None:
    (out / tasks.PART_FILE).write_bytes(number.to_bytes(8, "little"))
    key = files.hash_json(number)
    digests = {tasks.PART_FILE: files.hash_file(out / tasks.PART_FILE)}
    with cache.maker(tasks.PART_KIND, key):
        cache.put(tasks.PART_KIND, key, out, StageResult(digests, {}, {}, ResourceUsage()))


# ---- lost workers


def kills(folder: Path, seed: int, count: int = KILLS) -> None:
    """Kill workers, and check that the artefacts are the same."""
    rng, sizes = random.Random(seed), {f"j{i}": Size(sites=10, frames=50) for i in range(3)}
    sizes["big"] = Size(sites=120, frames=50)
    jobs, killed, runs = build(folder / "kills", sizes), 0, 0
    with scheduler.connect("processes=2") as client:
        warm(client, folder)
        seconds, _ = timed(client, jobs)
        expected = digests(jobs)
        print(f"undisturbed run: {seconds:.1f} s", flush=True)
        while killed < count:
            stop = threading.Event()
            moments = sorted(rng.uniform(0.0, seconds) for _ in range(min(3, count - killed)))
            messages: list[str] = []
            killer = threading.Thread(target=_kill, args=(moments, random.Random(rng.random()), stop, messages))
            with fresh(jobs):
                killer.start()
                scheduler.run_jobs(client, jobs)
                stop.set()
                killer.join()
            killed, runs = killed + len(messages), runs + 1
            same = digests(jobs) == expected
            verdict = "same bytes" if same else "OTHER BYTES"
            print(f"run {runs}: {'; '.join(messages) or 'no worker was running'}: {verdict}", flush=True)
            if not same:
                sys.exit(1)
    print(f"{killed} kills in {runs} runs: the same bytes in all")


def _kill(moments: list[float], rng: random.Random, stop: threading.Event, messages: list[str]) -> None:
    start = time.perf_counter()
    for moment in moments:
        if stop.wait(max(0.0, moment - (time.perf_counter() - start))):
            return
        if pids := workers():
            pid = rng.choice(pids)
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
                messages.append(f"worker {pid} killed after {time.perf_counter() - start:.1f} s")


def workers() -> list[int]:
    """Return the processes that Dask has started here, including those that are still starting."""
    pids_found = []
    for entry in psutil.Process().children(recursive=True):
        with suppress(psutil.Error):  # it has ended meanwhile
            if any("spawn_main" in word for word in entry.cmdline()):
                pids_found.append(entry.pid)
    return pids_found


def digests(jobs: list[Job]) -> dict[str, str]:
    """Return the sha256 of every artefact that contains no costs."""
    paths = [job.out / name for job in jobs for name in _DATA]
    return {f"{path.parent.name}/{path.name}": hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}


def main() -> None:
    """Run the requested benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("speed", "flat", "overhead", "overlap", "store", "kills"))
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--most-beams", type=int, help="beams per task, so that small cities are divided too")
    parser.add_argument("--osm", type=Path, help="the extract of overlap")
    parser.add_argument("--frames", type=int, default=300, help="frames of overlap")
    parser.add_argument("--junctions", type=int, default=4, help="junctions of overlap")
    options = parser.parse_args()
    if options.what == "overlap" and options.osm is None:
        parser.error("overlap needs --osm")
    if options.most_beams:
        scheduler.MIN_TASK_BEAMS = scheduler.MAX_TASK_BEAMS = options.most_beams
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        match options.what:
            case "speed":
                speed(folder, options.repeats)
            case "flat":
                flat(folder)
            case "overhead":
                overhead(folder)
            case "overlap":
                overlap(folder, options.osm, options.frames, options.junctions, options.repeats)
            case "store":
                store()
            case "kills":
                kills(folder, options.seed)


if __name__ == "__main__":
    main()
