"""What a city run would cost for other numbers of junctions, from the costs of finished runs.

``python -m benchmarks.city_costs OUT/costs.json [OUT/costs.json ...]`` prints, for each part of the work, its cost per
junction, and the cost for 1,000 and 10,000 junctions; in core hours, gigabytes, and dollars of a cloud machine. All
costs grow in proportion to the junctions, with the slope of the largest run. With several runs, it also prints the
exponent with which a part grew between the smallest and the largest one: 1 means in proportion.

Core hours are processor times: those of SUMO and of all workers are divided among their parts in proportion to the
durations of the stages. So they depend little on what else the machine does. The price per core hour is an
assumption, see ``--dollars``.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from egvs.extensions.city.costs import ROUTES_STEP, SPLIT_STEP, SUMO_STEP
from egvs.extensions.city.tasks import EARLY_SCANS, SCENE_CHECK, SCORED_PARTS

JUNCTIONS = (1_000, 10_000)

DOLLARS_PER_CORE_HOUR = 0.05
"""Assumed price of one virtual core, with its share of the memory, for an hour."""

PARTS: Mapping[str, Mapping[str, tuple[str, ...]]] = {
    "SUMO": {"routing": (ROUTES_STEP,), "SUMO": (SUMO_STEP,)},
    "egvs": {"split and tables": (SPLIT_STEP,)},
    "worker": {
        "checks and worlds": (SCENE_CHECK, "check", "statics"),
        "scans": (EARLY_SCANS, "scan"),
        "occupancy": ("traffic", "tpog"),
        "score": (SCORED_PARTS, "score"),
        "reports": ("report",),
    },
}
"""Kind of process -> its parts, each with the steps of the traffic or the stages that belong to it."""


@dataclass(frozen=True)
class RunCosts:
    """Costs of a finished city run, per junction, and peak memory by kind of process.

    Attributes
    ----------
    junctions
        Junctions of the city. If only some of them were run, their costs stand for all.
    seconds
        Core seconds per junction, by part.
    bytes
        Bytes on disk per junction.
    peak_mb
        Peak memory.
    """

    junctions: int
    seconds: Mapping[str, float]
    bytes: Mapping[str, float]
    peak_mb: Mapping[str, float]

    @classmethod
    def read(cls, path: Path) -> RunCosts:
        """Read ``costs.json``."""
        costs = json.loads(path.read_text(encoding="utf-8"))
        seconds_of = {step["part"]: step["seconds"] for step in costs["parts"] if step["within"]}
        seconds_of |= {stage["stage"]: stage["seconds"] for stage in costs["stages"]}
        size = costs["size"]
        seconds: dict[str, float] = {}
        for kind, parts in PARTS.items():
            durations = {part: sum(seconds_of.get(name, 0.0) for name in names) for part, names in parts.items()}
            busy_s = sum(process["busy_s"] or 0.0 for process in costs["processes"] if _kind(process) == kind)
            total_s = sum(durations.values())
            n_junctions = size["junctions"] if kind == "worker" else size["city_junctions"]
            for part, duration in durations.items():
                seconds[part] = busy_s * duration / total_s / n_junctions if total_s else 0.0
        return cls(
            size["city_junctions"],
            seconds,
            {"runs": size["run_bytes"] / size["junctions"], "traffic": size["traffic_bytes"] / size["junctions"]},
            _peaks_by_kind(costs["processes"]),
        )


def _peaks_by_kind(processes: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """Return the highest peak of each kind of process; workers are one kind."""
    peaks: dict[str, float] = {}
    for process in processes:
        kind = _kind(process)
        peaks[kind] = max(peaks.get(kind, 0.0), process["peak_mb"])
    return peaks


def _kind(process: Mapping[str, Any]) -> str:
    name: str = process["process"]
    return name.split(" ")[0].rstrip(",")


def growth(small: float, large: float, ratio: float) -> str:
    """Return the exponent of a cost between two runs, from the costs per junction and the ratio of junctions."""
    if small <= 0 or large <= 0 or ratio <= 1:
        return "-"
    return f"{1 + math.log(large / small) / math.log(ratio):.2f}"


def print_table(runs: Sequence[RunCosts], dollars_per_core_hour: float) -> None:
    """Print the costs per junction of the largest run, and those of more junctions."""
    small, large = runs[0], runs[-1]
    ratio = large.junctions / small.junctions
    print(f"runs of {', '.join(str(run.junctions) for run in runs)} junctions; slopes of the largest")
    head = "".join(f"{f'{count:,}':>12}" for count in JUNCTIONS)
    print(f"{'core hours':<20}{'s/junction':>12}{'exponent':>10}{head}")
    for part, seconds in large.seconds.items():
        exponent = growth(small.seconds[part], seconds, ratio)
        _print_row(part, seconds, exponent, 1 / 3600)
    total_s = sum(large.seconds.values())
    _print_row("all", total_s, growth(sum(small.seconds.values()), total_s, ratio), 1 / 3600)
    dollars = [f"{total_s * count / 3600 * dollars_per_core_hour:12,.2f}" for count in JUNCTIONS]
    print(f"{f'dollars, at {dollars_per_core_hour:g} per core hour':<42}{''.join(dollars)}")

    print(f"{'gigabytes on disk':<20}{'MB/junction':>12}{'exponent':>10}{head}")
    for name, n_bytes in large.bytes.items():
        _print_row(name, n_bytes / 1e6, growth(small.bytes[name], n_bytes, ratio), 1e-3)

    for kind in large.peak_mb:
        peaks = ", ".join(f"{run.peak_mb.get(kind, math.nan):.0f} ({run.junctions} junctions)" for run in runs)
        print(f"{f'peak MB of {kind}':<20}{peaks}")


def _print_row(name: str, per_junction: float, exponent: str, unit: float) -> None:
    values = "".join(f"{per_junction * count * unit:12,.2f}" for count in JUNCTIONS)
    print(f"{name:<20}{per_junction:12.2f}{exponent:>10}{values}")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("costs", nargs="+", type=Path, help="costs.json of city runs that made their traffic")
    parser.add_argument("--dollars", type=float, default=DOLLARS_PER_CORE_HOUR, help="price per core hour")
    options = parser.parse_args()
    runs = sorted((RunCosts.read(path) for path in options.costs), key=lambda run: run.junctions)
    print_table(runs, options.dollars)


if __name__ == "__main__":
    main()
