"""Growth of time and memory with the size of the job.

``python -m benchmarks.scaling`` (``make scaling``) uses a synthetic junction (boxes for buildings, cars on straight
lanes, no SUMO) and enlarges one quantity at a time: sites, frames, vehicles, the region of interest, beams, triangles.
Each size is a complete ``egvs run`` from a finished FCD file with ``scan.keep = false``, in a new process, after a
small run that compiles the kernels. Small sizes run three times, and the median counts. Times are processor times of
all threads. Memory is a stage's peak above what the process held before.

A slope is fitted on log-log axes by least squares over the larger half of the sizes (at least three), where fixed costs
matter less; 1 is linear. Writes ``docs/images/scaling.png`` and the tables of ``docs/scaling.md``.
"""

from __future__ import annotations

import json
import math
import multiprocessing
import os
import re
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
from pyarrow import csv

import egvs
from egvs.artefacts.run_record import StageRecord
from egvs.core.resource_usage import release_memory
from egvs.runs import run

ROOT = Path(__file__).resolve().parent.parent
PAGE, FIGURE = ROOT / "docs" / "scaling.md", ROOT / "docs" / "images" / "scaling.png"
BETWEEN = ("<!-- measured -->", "<!-- end -->")

REPEATS, MAX_S = 3, 1.0
"""Number of runs per size, and the time after which no further run starts."""

_LANE_M, _CAR_M = 3.5, 4.5

LINEAR = 1.1
"""Steeper slopes are printed in bold."""


@dataclass(frozen=True)
class Size:
    """A synthetic junction."""

    sites: int = 10
    frames: int = 500
    vehicles: int = 50
    hectares: float = 0.5
    beams: int = 16 * 360
    triangles: int = 1200


@dataclass(frozen=True)
class Axis:
    """A quantity that grows: a field of :class:`Size`, its values, and the stages that are shown."""

    name: str
    label: str
    sizes: tuple[float, ...]
    stages: tuple[str, ...]
    others: Size = field(default_factory=Size)
    """The quantities that do not grow."""


AXES = (
    Axis("sites", "sites", (10, 50, 200, 1000, 5000), ("score", "report")),
    Axis("frames", "frames", (500, 1500, 5000, 15000, 50000), ("traffic", "tpog", "score")),
    Axis("vehicles", "vehicles per frame", (10, 30, 100, 250, 500), ("traffic", "tpog", "score"), Size(hectares=2)),
    Axis("hectares", "region of interest, ha at 0.25 m", (0.5, 1, 2, 5, 10), ("tpog", "score", "report")),
    Axis("beams", "beams per sensor", (1_000, 10_000, 100_000, 300_000, 1_000_000), ("score", "report")),
    Axis(
        "triangles", "triangles", (1_000, 10_000, 100_000, 300_000, 1_000_000), ("statics", "tpog", "score", "report")
    ),
)

Points = dict[str, dict[float, tuple[float, float]]]
"""Stage -> size -> (seconds, MB)."""


def prepare(size: Size, folder: Path) -> Path:
    """Write a scenario of this size, and return its folder."""
    folder.mkdir(parents=True)
    long, wide = sides(size.hectares)
    channels = min(128, max(4, round(math.sqrt(size.beams / 22.5))))
    spots = max(1, math.ceil(math.sqrt(size.sites)))
    values: dict[str, dict[str, Any]] = {
        "roi": {"center_m": [long / 2, wide / 2, 2.5], "size_m": [long, wide, 5], "voxel_m": 0.25},
        "traffic": {"fcd": "fcd.csv", "frames": size.frames, "frame_period_s": 0.25, "warmup_s": 0},
        "statics": {"footprints": ["city.geojson"]},
        "sites": {"file": "sites.csv", "sensor": "own"},
        "scan": {"keep": False},
    }
    lines = [
        f"[{table}]\n" + "".join(f"{key} = {json.dumps(value)}\n" for key, value in keys.items())
        for table, keys in values.items()
    ]
    lines.append(
        f"[sensors.own]\nelevations_deg = [-25, 5]\nchannels = {channels}\n"
        f"azimuth_step_deg = {360 / max(1, round(size.beams / channels))!r}\nrange_m = 200\n"
    )
    lines.append(f'[[traffic.kinds]]\nname = "car"\nlength_m = {_CAR_M}\nwidth_m = 1.75\nheight_m = 1.5\n')
    (folder / "scenario.toml").write_text("\n".join(lines), encoding="utf-8")
    rows = [
        f"s{i},{long * (i % spots + 0.5) / spots!r},{wide * (i // spots + 0.5) / spots!r},4" for i in range(size.sites)
    ]
    (folder / "sites.csv").write_text("\n".join(["site,x_m,y_m,z_m", *rows]) + "\n", encoding="utf-8")
    (folder / "city.geojson").write_text(_city(max(1, size.triangles // 12), long, wide), encoding="utf-8")
    _traffic(size, long, wide, folder / "fcd.csv")
    return folder


def sides(hectares: float) -> tuple[float, float]:
    """Return length and width of a region about twice as long as wide, in whole voxels."""
    wide = round(math.sqrt(hectares * 1e4 / 2) * 4) / 4
    return round(hectares * 1e4 / wide * 4) / 4, wide


def _city(buildings: int, long: float, wide: float) -> str:
    """Return GeoJSON of square towers with 12 triangles each, 12 m apart, around the region of interest."""
    features: list[Any] = []
    ring = 1
    while len(features) < buildings:
        reach = 12.0 * ring + 4.0
        low, high = (-reach, -reach), (long + reach, wide + reach)
        along = [low[0] + 12.0 * i for i in range(int((high[0] - low[0]) / 12.0) + 1)]
        upward = [low[1] + 12.0 * i for i in range(1, int((high[1] - low[1]) / 12.0) + 1)]
        spots = [(x, y) for y in (low[1], high[1]) for x in along] + [
            (x, y) for x in (low[0], high[0]) for y in upward if y < high[1] - 11
        ]
        for x, y in spots[: buildings - len(features)]:
            corners = [[x - 3, y - 3], [x + 3, y - 3], [x + 3, y + 3], [x - 3, y + 3], [x - 3, y - 3]]
            properties = {"name": f"b{len(features)}", "kind": "building", "height_m": 8 + len(features) % 13}
            features.append(
                {"type": "Feature", "geometry": {"type": "Polygon", "coordinates": [corners]}, "properties": properties}
            )
        ring += 1
    return json.dumps({"type": "FeatureCollection", "crs": None, "features": features})


def _traffic(size: Size, long: float, wide: float, path: Path) -> None:
    """Write cars on lanes along x in SUMO's FCD format as CSV; cars of a lane have equal gaps and speeds."""
    rng = np.random.default_rng(1)
    lanes, round_m = max(1, int(wide / _LANE_M)), long + 10.0
    lane, position = np.arange(size.vehicles) % lanes, np.arange(size.vehicles) // lanes
    cars = np.bincount(lane, minlength=lanes)
    if round_m / cars.max() < _CAR_M + 1.0:
        raise ValueError(f"{size.vehicles} cars overlap on {lanes} lanes of {long:g} m")
    speed = rng.uniform(4.0, 14.0, lanes)[lane]
    y, first = wide * (lane + 0.5) / lanes, rng.uniform(0, round_m, lanes)[lane] + position * round_m / cars[lane]
    names = np.array([f"v{i}" for i in range(size.vehicles)])
    parts = range(0, size.frames, 2000)
    with path.open("wb") as file:
        for part in parts:
            times = np.arange(part, min(part + 2000, size.frames)) * 0.25
            x = (first + speed * times[:, None]) % round_m - 5.0
            n = len(times)
            columns = {
                "timestep_time": np.repeat(times, size.vehicles),
                "vehicle_id": np.tile(names, n),
                "vehicle_x": x.ravel().round(3),
                "vehicle_y": np.tile(y, n),
                "vehicle_angle": np.full(x.size, 90.0),
                "vehicle_type": np.full(x.size, "car"),
                "vehicle_speed": np.tile(speed, n),
            }
            options = csv.WriteOptions(include_header=part == 0, delimiter=";", quoting_style="none")
            csv.write_csv(pa.table(columns), file, options)


def _held_mb() -> float:
    release_memory()
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS:"))


def measure(size: Size, folder: Path, pipe: Any) -> None:
    """Send seconds and MB of each stage, medians of some runs, through a pipe."""
    os.environ["EGVS_STORE"] = ""  # nothing may come from the cache
    run.run(egvs.load(prepare(Size(sites=2, frames=10), folder / "warm")), folder / "warm" / "run")
    scenario, begin, held = egvs.load(prepare(size, folder / "scene")), time.perf_counter(), _held_mb()
    results: list[dict[str, tuple[float, float]]] = []
    for turn in range(REPEATS):
        clock = _Clock(held)
        run.run(scenario, folder / f"run{turn}", listener=clock)
        results.append(clock.costs)
        if time.perf_counter() - begin > MAX_S:
            break
    both = [{name: statistics.median(run[name][i] for run in results) for name in results[0]} for i in (0, 1)]
    pipe.send({name: (both[0][name], both[1][name]) for name in both[0]})


class _Clock:
    """Notes the processor seconds of each stage, and its peak memory above ``held`` MB."""

    def __init__(self, held: float) -> None:
        self._held, self._start = held, 0.0
        self.costs: dict[str, tuple[float, float]] = {}

    def __call__(self, stage: str, state: str, record: StageRecord | None) -> None:
        if state == "done" and record is not None:
            self.costs[stage] = (time.process_time() - self._start, max(record.cost.peak_mb - self._held, 1.0))
        _held_mb()  # frees the memory of the stage
        self._start = time.process_time()


def measure_in_process(size: Size) -> dict[str, tuple[float, float]]:
    """Call :func:`measure` in a new process; return seconds and MB by stage."""
    context = multiprocessing.get_context("spawn")
    with tempfile.TemporaryDirectory() as temporary:
        here, there = context.Pipe(duplex=False)
        process = context.Process(target=measure, args=(size, Path(temporary), there))
        process.start()
        there.close()
        try:
            results: dict[str, tuple[float, float]] = here.recv()
        except EOFError:
            raise RuntimeError(f"the run of {size} failed") from None
        process.join()
    return results


def slope(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Return the exponent of growth over the larger half of the sizes (at least three), by least squares."""
    pairs = sorted(zip(sizes, costs, strict=True))
    pairs = pairs[-max(3, (len(pairs) + 1) // 2) :]
    x, y = np.log([pair[0] for pair in pairs]), np.log([pair[1] for pair in pairs])
    x -= x.mean()
    return float((x * y).sum() / (x * x).sum())


def study() -> dict[str, Points]:
    """Measure every size of every axis."""
    results: dict[str, Points] = {}
    for axis in AXES:
        points: Points = {}
        for value in axis.sizes:
            start = time.perf_counter()
            change: dict[str, Any] = {axis.name: value if axis.name == "hectares" else int(value)}
            size = replace(axis.others, **change)
            costs = measure_in_process(size)
            for stage, cost in costs.items():
                points.setdefault(stage, {})[value] = cost
            texts = ", ".join(f"{stage} {costs[stage][0]:.2f} s {costs[stage][1]:.0f} MB" for stage in axis.stages)
            print(f"{axis.label} {value:g}: {texts}; complete {time.perf_counter() - start:.1f} s", file=sys.stderr)
        results[axis.name] = points
    return results


def table(results: dict[str, Points]) -> str:
    """Return Markdown with the costs of the smallest and largest size, and slopes; those above linear are bold."""
    lines = ["| grows | stage | smallest | largest | slope of seconds | slope of memory |", "|---|---|---|---|---|---|"]
    for axis in AXES:
        low, high = axis.sizes[0], axis.sizes[-1]
        for stage in axis.stages:
            points = results[axis.name][stage]
            ends = [f"{points[n][0]:.3g} s, {points[n][1]:.0f} MB" for n in (low, high)]
            slopes = [slope(list(points), [cost[i] for cost in points.values()]) for i in (0, 1)]
            texts = [f"**{s:.2f}**" if s > LINEAR else f"{s:.2f}" for s in slopes]
            lines.append(
                f"| {axis.label}: {low:g} to {high:,g} | {stage} | {ends[0]} | {ends[1]} | {texts[0]} | {texts[1]} |"
            )
    return "\n".join(lines)


# Okabe and Ito's colours are distinguishable for the colour-blind; markers and dashes distinguish them in print.
LOOKS = {
    "statics": ("#999999", "v", ":"),
    "traffic": ("#E69F00", "s", "--"),
    "tpog": ("#009E73", "^", "-."),
    "score": ("#0072B2", "o", "-"),
    "report": ("#D55E00", "D", (0, (1, 1))),
}


def draw(results: dict[str, Points], path: Path) -> None:
    """Draw seconds and memory, one column per axis."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, panels = pyplot.subplots(2, len(AXES), figsize=(16, 6.2), sharex="col", sharey="row", layout="constrained")
    for column, axis in enumerate(AXES):
        for row in (0, 1):
            panel = panels[row, column]
            for stage in axis.stages:
                colour, marker, dashes = LOOKS[stage]
                points = results[axis.name][stage]
                costs = [cost[row] for cost in points.values()]
                texts = f"{stage} {slope(list(points), costs):.2f}"
                panel.loglog(
                    list(points), costs, color=colour, marker=marker, linestyle=dashes, markersize=5, label=texts
                )
            panel.grid(True, which="major", color="0.88")
            panel.legend(fontsize=8, title="slope", title_fontsize=8, loc="upper left", framealpha=0.85)
        panels[1, column].set_xlabel(axis.label)
    panels[0, 0].set_ylabel("processor seconds")
    panels[1, 0].set_ylabel("memory above the start, MB")
    for row in (0, 1):  # a line of slope 1 to compare with
        for column, axis in enumerate(AXES):
            low, high = panels[row, column].get_ylim()
            x = np.array([axis.sizes[0], axis.sizes[-1]])
            panels[row, column].plot(x, high * x / x[1], color="0.6", linewidth=0.8, zorder=0)
            panels[row, column].set_ylim(low, high * 12 if column == 0 else None)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def main() -> None:
    """Measure, draw, and write the table to the page."""
    results = study()
    draw(results, FIGURE)
    texts = table(results)
    page = PAGE.read_text(encoding="utf-8")
    start, end = (re.escape(mark) for mark in BETWEEN)
    page = re.sub(f"{start}.*{end}", lambda _: f"{BETWEEN[0]}\n{texts}\n{BETWEEN[1]}", page, flags=re.DOTALL)
    PAGE.write_text(page, encoding="utf-8")
    print(texts)


if __name__ == "__main__":
    main()
