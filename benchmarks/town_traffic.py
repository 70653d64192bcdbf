"""Cost of simulating a town's traffic, per junction, from 25 to 400 junctions.

``python -m benchmarks.town_traffic`` simulates square grids of signalised junctions (netgenerate, 200 m apart) with the
settings of ``egvs city new``, and prints processor milliseconds per junction for each part: drawing and routing trips,
and SUMO. The flow grows with the length of the rim, and trips lead across the town, so that the number of vehicles at
each junction stays the same. SUMO's time is also given per vehicle-second (a vehicle that is simulated for a second,
warm-up included), which separates the number of vehicles from the cost of each. All costs are processor times of one
core, the least of ``--repeats`` runs; the ratios compare each town with the smallest.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from egvs.core import files
from egvs.core.progress import no_progress
from egvs.extensions.city.creation import CITY_LATERAL_RESOLUTION_M, CITY_STEP_S
from egvs.formats import xml
from egvs.scenario.loading import scenario_from_dict
from egvs.scenario.model import Scenario
from egvs.traffic import recording, sumo, sumo_folder

SPACING_M = 200.0
"""Distance between neighbouring junctions."""

PER_ENTRY_PER_H = 150.0
SIDES = (5, 10, 20)
WARMUP_S = 1200.0
"""Long enough to fill the largest town; the same for all."""

SUMMARY_FILE = "summary.xml"


class Cost(NamedTuple):
    """Processor seconds of a town of ``junctions``, simulated vehicle-seconds, and vehicles at a time when recorded."""

    junctions: int
    routing_s: float
    sumo_s: float
    vehicle_s: float
    vehicles: float

    @property
    def per_junction_ms(self) -> float:
        return 1e3 * (self.routing_s + self.sumo_s) / self.junctions

    @property
    def per_vehicle_second_us(self) -> float:
        return 1e6 * self.sumo_s / self.vehicle_s


def processor_s() -> float:
    """Return the processor time of this process and the programs that it has started, in seconds."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def make_town(side: int, frames: int, folder: Path, seed: int = 1) -> Scenario:
    """Write the network of a town of ``side`` times ``side`` junctions; return its traffic as a scenario."""
    size_m = SPACING_M * (side + 1)
    spacing = f"{SPACING_M:g}"
    options = [
        "--grid", "--grid.number", str(side), "--grid.length", spacing, "--grid.attach-length", spacing,
        "--default-junction-type", "traffic_light", "--tls.default-type", "actuated", "--no-turnarounds",
    ]  # fmt: skip
    sumo.run_program("netgenerate", [*options, "-o", "town.net.xml"], folder)
    values = {
        "name": "town",
        "seed": seed,
        "roi": {"center_m": [size_m / 2, size_m / 2, 2.5], "size_m": [size_m, size_m, 5.0], "voxel_m": 5.0},
        "traffic": {
            "network": "town.net.xml", "vehicles_per_h": PER_ENTRY_PER_H * 4 * side, "reroute_at_departure": True,
            "frames": frames, "warmup_s": WARMUP_S, "step_s": CITY_STEP_S, "junction_blocker_s": 10.0,
            "lateral_resolution_m": CITY_LATERAL_RESOLUTION_M, "min_trip_m": SPACING_M * side,
        },
        "sites": {"file": "sites.csv"},
    }  # fmt: skip
    files.write_text(folder / "sites.csv", "site,x_m,y_m,z_m\na,0,0,4\n")
    return scenario_from_dict(values, folder, "town")


def measure(side: int, frames: int, folder: Path) -> Cost:
    """Simulate a town of ``side`` times ``side`` junctions."""
    scenario = make_town(side, frames, folder)
    start_s = processor_s()
    prepared = sumo_folder.prepare_simulation(scenario, folder / "sumo")
    prepared_s = processor_s()
    config = (folder / "sumo" / sumo_folder.CONFIG_FILE).read_text(encoding="utf-8")
    summary = f'<configuration>\n    <summary-output value="{SUMMARY_FILE}"/>'
    files.write_text(folder / "sumo" / sumo_folder.CONFIG_FILE, config.replace("<configuration>", summary))
    recording.simulate(prepared, no_progress)
    end_s = processor_s()

    steps = xml.iter_elements(folder / "sumo" / SUMMARY_FILE, "summary")
    vehicle_s = CITY_STEP_S * sum(int(step.get("running", "0")) for step in steps)
    with (folder / "sumo" / sumo_folder.FCD_FILE).open("rb") as file:
        rows = sum(block.count(b"\n") for block in iter(lambda: file.read(2**20), b"")) - 1
    return Cost(side * side, prepared_s - start_s, end_s - prepared_s, vehicle_s, rows / frames)


def least_cost(side: int, frames: int, repeats: int) -> Cost:
    """Simulate a town several times; return the least processor time of each part."""
    costs = []
    for _ in range(repeats):
        with tempfile.TemporaryDirectory() as folder:
            costs.append(measure(side, frames, Path(folder)))
    routing_s, sumo_s = min(cost.routing_s for cost in costs), min(cost.sumo_s for cost in costs)
    return costs[0]._replace(routing_s=routing_s, sumo_s=sumo_s)


def main(sides: Sequence[int] = SIDES) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--repeats", type=int, default=1)
    options = parser.parse_args()
    smallest: Cost | None = None
    for side in sides:
        cost = least_cost(side, options.frames, options.repeats)
        smallest = smallest or cost
        n = cost.junctions
        print(
            f"{n} junctions: {cost.per_junction_ms:.0f} ms per junction ({1e3 * cost.routing_s / n:.0f} routing,"
            f" {1e3 * cost.sumo_s / n:.0f} SUMO), ratio {cost.per_junction_ms / smallest.per_junction_ms:.2f};"
            f" {cost.vehicles / n:.1f} vehicles and {cost.vehicle_s / n:.0f} vehicle-seconds per junction;"
            f" {cost.per_vehicle_second_us:.1f} us per vehicle-second, ratio"
            f" {cost.per_vehicle_second_us / smallest.per_vehicle_second_us:.2f}",
            flush=True,
        )


if __name__ == "__main__":
    main()
