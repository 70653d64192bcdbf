"""Cost of simulating a town's traffic, per junction, from 25 to 400 junctions.

``python -m benchmarks.town_traffic`` simulates square grids of signalised junctions (netgenerate, 200 m apart) with the
settings of ``egvs city new``, and prints processor seconds per junction for each part: drawing and routing trips, and
SUMO. The flow grows with the length of the rim, and trips lead across the town, so that the number of vehicles at each
junction stays the same. All costs are processor times of one core; the last line compares the largest town with the
smallest.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from egvs.city.creation import CITY_LATERAL_RESOLUTION_M, CITY_STEP_S
from egvs.core import files
from egvs.core.progress import no_progress
from egvs.scenario.loading import scenario_from_dict
from egvs.traffic import recording, sumo, sumo_folder

PER_ENTRY_PER_H = 150.0
SIDES = (5, 10, 20)
WARMUP_S = 1200.0
"""Long enough to fill the largest town; the same for all."""


class Cost(NamedTuple):
    """Processor seconds of a town of ``junctions``, and the vehicles on its roads, on average over the frames."""

    junctions: int
    routing_s: float
    sumo_s: float
    vehicles: float

    @property
    def per_junction_ms(self) -> float:
        return 1e3 * (self.routing_s + self.sumo_s) / self.junctions


def _processor_s() -> float:
    """Return the processor time of this process and the programs that it has started, in seconds."""
    usages = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(usage.ru_utime + usage.ru_stime for usage in usages)


def measure(side: int, frames: int, folder: Path) -> Cost:
    """Simulate a town of ``side`` times ``side`` junctions."""
    size_m = 200.0 * (side + 1)
    options = [
        "--grid", "--grid.number", str(side), "--grid.length", "200", "--grid.attach-length", "200",
        "--default-junction-type", "traffic_light", "--tls.default-type", "actuated", "--no-turnarounds",
    ]  # fmt: skip
    sumo.run_program("netgenerate", [*options, "-o", "town.net.xml"], folder)
    values = {
        "name": "town",
        "seed": 1,
        "roi": {"center_m": [size_m / 2, size_m / 2, 2.5], "size_m": [size_m, size_m, 5.0], "voxel_m": 5.0},
        "traffic": {
            "network": "town.net.xml", "vehicles_per_h": PER_ENTRY_PER_H * 4 * side, "reroute_at_departure": True,
            "frames": frames, "warmup_s": WARMUP_S, "step_s": CITY_STEP_S, "junction_blocker_s": 10.0,
            "lateral_resolution_m": CITY_LATERAL_RESOLUTION_M, "min_trip_m": 200.0 * side,
        },
        "sites": {"file": "sites.csv"},
    }  # fmt: skip
    files.write_text(folder / "sites.csv", "site,x_m,y_m,z_m\na,0,0,4\n")
    scenario = scenario_from_dict(values, folder, "town")
    start_s = _processor_s()
    prepared = sumo_folder.prepare_simulation(scenario, folder / "sumo")
    prepared_s = _processor_s()
    recording.simulate(prepared, no_progress)
    end_s = _processor_s()
    with (folder / "sumo" / sumo_folder.FCD_FILE).open("rb") as file:
        rows = sum(block.count(b"\n") for block in iter(lambda: file.read(2**20), b"")) - 1
    return Cost(side * side, prepared_s - start_s, end_s - prepared_s, rows / frames)


def main(sides: Sequence[int] = SIDES) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=600)
    options = parser.parse_args()
    costs = []
    for side in sides:
        with tempfile.TemporaryDirectory() as folder:
            cost = measure(side, options.frames, Path(folder))
        costs.append(cost)
        n = cost.junctions
        print(
            f"{n} junctions: {cost.per_junction_ms:.0f} ms per junction ({1e3 * cost.routing_s / n:.0f} routing,"
            f" {1e3 * cost.sumo_s / n:.0f} SUMO), {cost.vehicles / n:.1f} vehicles per junction, ratio"
            f" {cost.per_junction_ms / costs[0].per_junction_ms:.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
