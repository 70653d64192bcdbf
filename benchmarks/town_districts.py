"""A town's traffic simulated in districts, compared with one simulation of the complete town.

``python -m benchmarks.town_districts`` takes the towns of :mod:`benchmarks.town_traffic`. The complete town is
simulated once more in steps of 1 s, which gives the routes and the times at which vehicles enter each edge. The town is
then cut into square districts with a rim around them (netconvert), the routes are cut to each district, where vehicles
enter at their times of the complete town (SUMO's ``cutRoutes.py``), and each district is simulated with the settings of
``egvs city new``.

It prints two things. *Cost*: processor seconds of the complete town, and of the coarse run, the cuts and all districts
together, for the first seed. *Agreement*: flow and number of vehicles at the junctions of the first district, in the
district and in the complete town. Each seed gives one difference per junction; its standard error is that of the mean
difference over the seeds.
"""

from __future__ import annotations

import argparse
import itertools
import tempfile
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from scipy import stats

from benchmarks.town_traffic import SPACING_M, make_town, processor_s
from egvs.core import files
from egvs.core.grid import FloatArray
from egvs.core.progress import no_progress
from egvs.formats.xml import iter_elements
from egvs.traffic import fcd, network, recording, sumo, sumo_folder
from egvs.traffic.network import Junction, Network
from egvs.traffic.sumo_folder import SimulationFolder

REGION_M = 80.0
"""Side of the square around a junction in which vehicles are counted."""

COARSE_STEP_S = 1.0
NOT_LEFT = "-1"
"""SUMO's time at which a vehicle left an edge that it has not left."""

DRIVEN_FILE, DISTRICT_NETWORK_FILE, EDGES_FILE = "coarse.rou.xml", "district.net.xml", "edges.txt"
DISTRICT_ROUTES_FILE, DISTRICT_FCD_FILE = "district.rou.xml", "district.csv"


class Rectangle(NamedTuple):
    """A part of the plane, in metres."""

    low_x_m: float
    low_y_m: float
    high_x_m: float
    high_y_m: float

    def contains(self, at_m: tuple[float, float], margin_m: float = 0.0) -> bool:
        """Whether a point is inside, or at most ``margin_m`` outside."""
        return (
            self.low_x_m - margin_m <= at_m[0] <= self.high_x_m + margin_m
            and self.low_y_m - margin_m <= at_m[1] <= self.high_y_m + margin_m
        )


class JunctionTraffic(NamedTuple):
    """Vehicles per hour through the region of a junction, and vehicles in it at a time."""

    flow_per_h: float
    vehicles: float


@dataclass(frozen=True)
class Costs:
    """Processor seconds of each part; ``simulated`` is the number of junctions in all districts, rims included."""

    whole_s: float
    coarse_s: float
    cuts_s: float
    districts_s: float
    simulated: int

    @property
    def total_s(self) -> float:
        """Processor seconds of a simulation in districts."""
        return self.coarse_s + self.cuts_s + self.districts_s


@dataclass(frozen=True)
class Settings:
    """Size of the town and of its districts (junctions along a side), width of the rim, and number of frames."""

    side: int
    district_side: int
    rim_m: float
    frames: int

    def districts(self) -> list[Rectangle]:
        """Return the districts; the lines between them are halfway between junctions."""
        lines_m = [SPACING_M * (0.5 + first) for first in range(0, self.side + 1, self.district_side)]
        spans_m = list(itertools.pairwise(lines_m))
        return [Rectangle(x[0], y[0], x[1], y[1]) for x, y in itertools.product(spans_m, spans_m)]


def run_coarse(prepared: SimulationFolder) -> None:
    """Simulate the complete town in longer steps; write the routes, with the times at which edges are left."""
    options = [
        "-c", sumo_folder.CONFIG_FILE, "--step-length", f"{COARSE_STEP_S:g}", "--collision.check-junctions", "false",
        "--vehroute-output", DRIVEN_FILE, "--vehroute-output.exit-times", "--vehroute-output.write-unfinished",
        "--vehroute-output.last-route",
    ]  # fmt: skip
    sumo.run_program("sumo", options, prepared.folder)
    sumo.check_xml_complete(prepared.folder / DRIVEN_FILE, "routes")
    vehicles = []
    for vehicle in iter_elements(prepared.folder / DRIVEN_FILE, "routes"):
        end_at_last_edge(vehicle)
        vehicles.append(ElementTree.tostring(vehicle, encoding="unicode"))
    files.write_text(prepared.folder / DRIVEN_FILE, "\n".join(["<routes>", *vehicles, "</routes>", ""]))


def end_at_last_edge(vehicle: ElementTree.Element) -> None:
    """Remove the edges that a vehicle did not reach by the end: cutRoutes.py would invent a time for them."""
    (route,) = vehicle.iter("route")
    edges, exits = route.get("edges", "").split(), route.get("exitTimes", "").split()
    passed = sum(time != NOT_LEFT for time in exits)
    if passed < len(edges):
        route.set("edges", " ".join(edges[: passed + 1]))
        route.set("exitTimes", " ".join(exits[: passed + 1]))
        vehicle.attrib.pop("arrivalPos", None)


def cut_district(prepared: SimulationFolder, district: Rectangle, rim_m: float) -> int:
    """Write the network and the routes of a district; return the number of signalised junctions, rim included."""
    folder = prepared.folder
    edges = []
    for edge in prepared.roads.edges:
        if district.contains(edge.start_m, rim_m) or district.contains(edge.end_m, rim_m):
            edges.append(f"edge:{edge.id}\n")
    (folder / EDGES_FILE).write_text("".join(edges), encoding="utf-8")
    options = ["-s", sumo_folder.NETWORK_FILE, "--keep-edges.input-file", EDGES_FILE]
    sumo.run_netconvert([*options, "--offset.disable-normalization"], folder, DISTRICT_NETWORK_FILE)
    options = [DISTRICT_NETWORK_FILE, DRIVEN_FILE, "-o", DISTRICT_ROUTES_FILE]
    sumo.run_tool("route/cutRoutes.py", [*options, "-d", "keep", "--min-length", "1"], folder)
    roads = network.read_net_xml(folder / DISTRICT_NETWORK_FILE)
    return sum(node.type == "traffic_light" for node in roads.junctions)


def run_district(prepared: SimulationFolder) -> None:
    """Simulate a district on the routes that its vehicles took in the complete town."""
    own = {"net-file": DISTRICT_NETWORK_FILE, "route-files": DISTRICT_ROUTES_FILE}
    options = {key: value for key, value in prepared.options.items() if not key.startswith("device.rerouting")}
    outputs = prepared.outputs | {"fcd-output": DISTRICT_FCD_FILE}
    sumo.run_program("sumo", sumo_folder.as_flags(options | own | outputs), prepared.folder)


def count_vehicles(
    path: Path, junctions: Iterable[Junction], frames: int, frame_period_s: float
) -> dict[str, JunctionTraffic]:
    """Count the vehicles around junctions in an FCD file. Parts of one cut route count as one vehicle."""
    at_m = {node.id: node.at_m for node in junctions}
    names = defaultdict[str, set[str]](set)
    rows = defaultdict[str, int](int)
    for table in fcd.read_fcd(path):
        x_m, y_m = table["x"].to_numpy(), table["y"].to_numpy()
        ids = table["id"].to_numpy(zero_copy_only=False)
        for name, (node_x_m, node_y_m) in at_m.items():
            inside = (np.abs(x_m - node_x_m) <= REGION_M / 2) & (np.abs(y_m - node_y_m) <= REGION_M / 2)
            rows[name] += int(inside.sum())
            names[name].update(str(vehicle).partition("_part")[0] for vehicle in ids[inside])
    hours = frames * frame_period_s / 3600.0
    return {name: JunctionTraffic(len(names[name]) / hours, rows[name] / frames) for name in at_m}


def junctions_in(roads: Network, district: Rectangle) -> list[Junction]:
    """Return the signalised junctions of a district, without its rim."""
    return [node for node in roads.junctions if node.type == "traffic_light" and district.contains(node.at_m)]


class SeedResult(NamedTuple):
    """Counts at the junctions of the first district in both simulations; costs if all districts were simulated."""

    whole: Mapping[str, JunctionTraffic]
    district: Mapping[str, JunctionTraffic]
    costs: Costs | None


def compare(settings: Settings, seed: int, folder: Path, all_districts: bool) -> SeedResult:
    """Simulate a town as a whole and in districts: the first one, or all."""
    scenario = make_town(settings.side, settings.frames, folder, seed)
    period_s = scenario.traffic.frame_period_s
    prepared = sumo_folder.prepare_simulation(scenario, folder / "sumo")
    districts = settings.districts()
    counted = junctions_in(prepared.roads, districts[0])

    times_s = [processor_s()]
    recording.simulate(prepared, no_progress)
    times_s.append(processor_s())
    run_coarse(prepared)
    times_s.append(processor_s())
    whole = count_vehicles(prepared.folder / sumo_folder.FCD_FILE, counted, settings.frames, period_s)

    in_district: dict[str, JunctionTraffic] = {}
    cuts_s, districts_s, simulated = 0.0, 0.0, 0
    for district in districts if all_districts else districts[:1]:
        start_s = processor_s()
        simulated += cut_district(prepared, district, settings.rim_m)
        cut_s = processor_s()
        run_district(prepared)
        cuts_s, districts_s = cuts_s + cut_s - start_s, districts_s + processor_s() - cut_s
        if not in_district:
            path = prepared.folder / DISTRICT_FCD_FILE
            in_district = count_vehicles(path, counted, settings.frames, period_s)
    costs = None
    if all_districts:
        costs = Costs(times_s[1] - times_s[0], times_s[2] - times_s[1], cuts_s, districts_s, simulated)
    return SeedResult(whole, in_district, costs)


def print_agreement(label: str, whole: FloatArray, district: FloatArray) -> None:
    """Print how well a quantity agrees; arrays of shape (n_seeds, n_junctions)."""
    difference = district - whole
    n_seeds, n_junctions = whole.shape
    standard_error = difference.std(axis=0, ddof=1) / np.sqrt(n_seeds)
    t = difference.mean(axis=0) / standard_error
    shares = []
    for limit in (1, 2, 3):
        expected = n_junctions * (1 - 2 * stats.t.sf(limit, n_seeds - 1))
        shares.append(f"{int((np.abs(t) <= limit).sum())} within {limit} (by chance {expected:.1f})")
    change = district.mean() / whole.mean() - 1
    print(
        f"{label}: whole {whole.mean():.2f}, district {district.mean():.2f} ({change:+.1%}); standard errors of the"
        f" difference at {n_junctions} junctions, {n_seeds} seeds: {', '.join(shares)}; mean t {t.mean():+.2f}",
        flush=True,
    )


def print_costs(costs: Costs, side: int) -> None:
    """Print the cost of both simulations."""
    n = side * side
    print(
        f"{n} junctions: {1e3 * costs.whole_s / n:.0f} ms per junction as a whole,"
        f" {1e3 * costs.total_s / n:.0f} ms in districts, ratio {costs.total_s / costs.whole_s:.2f}"
        f" ({costs.coarse_s:.1f} s coarse run, {costs.cuts_s:.1f} s cuts, {costs.districts_s:.1f} s districts of"
        f" {costs.simulated} junctions with rims; {costs.whole_s:.1f} s as a whole)",
        flush=True,
    )


def main() -> None:
    """Print cost and agreement."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--side", type=int, default=10, help="junctions along a side of the town")
    parser.add_argument("--district-side", type=int, default=5, help="junctions along a side of a district")
    parser.add_argument("--rim", type=float, default=300.0, help="metres")
    parser.add_argument("--frames", type=int, default=600)
    parser.add_argument("--seeds", type=int, default=5)
    options = parser.parse_args()
    if options.side % options.district_side:
        parser.error("--side must be a multiple of --district-side")
    if options.seeds < 2:
        parser.error("--seeds must be at least 2")

    settings = Settings(options.side, options.district_side, options.rim, options.frames)
    results = []
    for seed in range(1, options.seeds + 1):
        with tempfile.TemporaryDirectory() as folder:
            result = compare(settings, seed, Path(folder), all_districts=seed == 1)
        if result.costs is not None:
            print_costs(result.costs, settings.side)
        results.append(result)
    for field, label in enumerate(("flow per hour", "vehicles at a time")):
        whole = np.array([[traffic[field] for traffic in result.whole.values()] for result in results])
        district = np.array([[traffic[field] for traffic in result.district.values()] for result in results])
        print_agreement(label, whole, district)


if __name__ == "__main__":
    main()
