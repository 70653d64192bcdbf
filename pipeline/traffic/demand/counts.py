"""Finds routes that meet counts, with SUMO's own routeSampler.

Steps, for the counts of the whole fleet and then for those of each kind: find plausible routes over each counted place
(:mod:`pipeline.traffic.demand.ways`); routeSampler (https://sumo.dlr.de/docs/Tools/Turns.html#routesamplerpy) takes of
them so many that the counts are met, and spreads their departures evenly at random over the whole simulation; each
vehicle of the fleet gets a kind, by share, among those that may drive its route. Counts of a kind are added to those of
the fleet.

After the run, :func:`met` counts what really drove past in the frames that were recorded, and holds it against the
counts. GEH is what traffic engineers compare hourly flows m and c by, as SUMO's own tools have it
(sumolib.statistics.geh; routeSampler's --geh-ok is 5 too):

    GEH = sqrt(2 (m - c)^2 / (m + c)),      a good match below 5
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element
from xml.sax.saxutils import quoteattr

import numpy as np

from pipeline.core import files
from pipeline.core.errors import InputError
from pipeline.core.findings import Finding
from pipeline.formats import safe_xml
from pipeline.scenario.traffic import CountModel, TrafficModel, VehicleKind
from pipeline.traffic import sumo
from pipeline.traffic.demand.ways import Place, Ways
from pipeline.traffic.network import Network

CANDIDATES, COUNTS, SAMPLED = "candidates.rou.xml", "counts.xml", "sampled.rou.xml"
FLEET = "fleet"
"""What vehicles are called that were counted without their kind."""

_BOUND = 50
"""How far routeSampler's optimisation may move the number of vehicles on a route from what its sampling gave."""

GOOD_GEH = 5.0
_NOISE = 3.0
"""A difference that a Poisson process makes once in 370 times is none."""


@dataclass(frozen=True)
class MetCount:
    """Vehicles an hour over a place: counted, and simulated in the frames that were recorded."""

    place: str
    kind: str
    counted_per_h: float
    simulated_per_h: float
    geh: float


@dataclass(frozen=True)
class _Vehicle:
    depart_s: float
    name: str
    kind: str
    edges: str

    def xml(self) -> str:
        values = {"id": self.name, "type": self.kind, "depart": f"{self.depart_s:.2f}", "departLane": "best"}
        head = " ".join(f"{key}={quoteattr(value)}" for key, value in values.items())
        return f'    <vehicle {head} departSpeed="max"><route edges={quoteattr(self.edges)}/></vehicle>'


def write_routes(
    traffic: TrafficModel, network: Network, times_s: tuple[float, float], seed: np.random.SeedSequence, folder: Path,
    name: str, where: str,
) -> None:  # fmt: skip
    """Write the route file ``name`` into ``folder``, with vehicles between two times that meet the scenario's counts.

    InputError when a count names an edge or a kind that is not there, or a way that nobody can drive.
    """
    ways = ways_of(traffic, network)
    places = [place_of(count, traffic, ways, where) for count in traffic.counts]
    named = [kind.name for kind in traffic.kinds]
    groups = [group for group in ("", *named) if any(count.kind == group for count in traffic.counts)]
    vehicles: list[_Vehicle] = []
    for group, child in zip(groups, seed.spawn(len(groups)), strict=True):
        kinds = _kinds(traffic, group)
        there = [place for place, count in zip(places, traffic.counts, strict=True) if count.kind == group]
        rates = [count.per_hour for count in traffic.counts if count.kind == group]
        rng, sampler = np.random.default_rng(child), int(child.generate_state(1)[0]) & 0x7FFFFFFF
        candidates = ways[_main(kinds).vclass].candidates(there, traffic, rng, where)
        for index, (depart_s, edges) in enumerate(_sampled(there, rates, candidates, times_s, sampler, folder)):
            able = [kind for kind in kinds if ways[kind.vclass].may_drive(edges)]  # the main one may
            shares = np.array([kind.share for kind in able])
            kind = able[int(np.searchsorted(np.cumsum(shares) / shares.sum(), rng.random(), side="right"))]
            vehicles.append(_Vehicle(depart_s, f"{group or FLEET}.{index}", kind.name, " ".join(edges)))
    lines = [vehicle.xml() for vehicle in sorted(vehicles, key=lambda v: (v.depart_s, v.name))]
    files.write_text(folder / name, "\n".join(["<routes>", *lines, "</routes>", ""]))


def ways_of(traffic: TrafficModel, network: Network) -> dict[str, Ways]:
    """The ways of each vClass of the fleet."""
    return {kind.vclass: Ways(network, kind.vclass) for kind in traffic.kinds}


def place_of(count: CountModel, traffic: TrafficModel, ways: Mapping[str, Ways], where: str) -> Place:
    """Where a count was taken; InputError when it names an edge or a kind that is not there, or a way that nobody can
    drive.
    """
    where = where_of(count, where)
    if not (kinds := _kinds(traffic, count.kind)):
        right = f"one of {', '.join(kind.name for kind in traffic.kinds)}"
        raise InputError(where, f"the fleet has no kind {count.kind!r}", right)
    if count.kind == FLEET:
        right = "another name for this kind: so vehicles are called that were counted without theirs"
        raise InputError(where, f"a kind called {FLEET!r}", right)
    return ways[_main(kinds).vclass].place(count.edge or count.from_edge or "", count.to_edge, where)


def where_of(count: CountModel, traffic: str) -> str:
    """What messages about a count of ``[traffic]`` point to."""
    return f"{traffic}.counts ({count.title})"


def _kinds(traffic: TrafficModel, group: str) -> list[VehicleKind]:
    """Those that a count may be of: the whole fleet, or the one that it names."""
    return [kind for kind in traffic.kinds if group in ("", kind.name)]


def _main(kinds: Sequence[VehicleKind]) -> VehicleKind:
    """The one whose ways all take, where they may."""
    return max(kinds, key=lambda kind: kind.share)


def _sampled(
    places: Sequence[Place], per_hour: Sequence[float], candidates: Sequence[tuple[str, ...]],
    times_s: tuple[float, float], seed: int, folder: Path,
) -> Iterator[tuple[float, list[str]]]:  # fmt: skip
    """Departure and edges of each vehicle that routeSampler takes."""
    begin, end = (f"{time_s:.3f}" for time_s in times_s)
    hours = (times_s[1] - times_s[0]) / 3600.0
    routes = (f'    <route id="{i}" edges={quoteattr(" ".join(edges))}/>' for i, edges in enumerate(candidates))
    files.write_text(folder / CANDIDATES, "\n".join(["<routes>", *routes, "</routes>", ""]))
    relations = (place.xml(round(rate * hours)) for place, rate in zip(places, per_hour, strict=True))
    interval = [f'  <interval id="counts" begin="{begin}" end="{end}">', *relations, "  </interval>"]
    files.write_text(folder / COUNTS, "\n".join(["<data>", *interval, "</data>", ""]))
    gap = max(len(place.edges) - 2 for place in places)
    turns = ["--turn-files", COUNTS] if any(len(place.edges) > 1 for place in places) else []
    edges = ["--edgedata-files", COUNTS] if any(len(place.edges) == 1 for place in places) else []
    arguments = [
        "--route-files", CANDIDATES, *turns, *edges, "--turn-max-gap", str(max(0, gap)), "--begin", begin,
        "--end", end, "--interval", f"{times_s[1] - times_s[0]:.3f}", "--seed", str(seed), "--output-file", SAMPLED,
        "--optimize", str(_BOUND),
    ]  # fmt: skip
    sumo.run_tool("routeSampler.py", arguments, folder)
    for vehicle in safe_xml.children(folder / SAMPLED, "routes"):
        for route in vehicle.iter("route"):
            yield float(vehicle.get("depart", "0")), route.get("edges", "").split()
    for left in (CANDIDATES, COUNTS, SAMPLED):
        (folder / left).unlink()


# --- counted against simulated --------------------------------------------------------------------------------------


def met(traffic: TrafficModel, routes: Path, first_s: float, end_s: float) -> list[MetCount]:
    """What drove past each counted place between two times, from SUMO's ``--vehroute-output`` with exit times."""
    passed = [0] * len(traffic.counts)
    for vehicle in safe_xml.children(routes, "routes"):
        if vehicle.tag != "vehicle":
            continue  # a person
        group = vehicle.get("id", "").rpartition(".")[0]
        left_s = _exits(vehicle)
        for number, count in enumerate(traffic.counts):
            if (count.kind or FLEET) == group and first_s <= _passes_s(count, left_s) < end_s:
                passed[number] += 1
    hours = (end_s - first_s) / 3600.0
    return [
        MetCount(c.title, c.kind, c.per_hour, round(n / hours, 1), round(geh(c.per_hour, n / hours), 2))
        for c, n in zip(traffic.counts, passed, strict=True)
    ]


def _exits(vehicle: Element) -> dict[str, tuple[int, float]]:
    """Of each edge of a vehicle's route: its number on the way, and when it was left; -1 where that was never."""
    route = next(vehicle.iter("route"))
    times_s = (float(text) for text in route.get("exitTimes", "").split())
    return {edge: (n, s) for n, (edge, s) in enumerate(zip(route.get("edges", "").split(), times_s, strict=True))}


def _passes_s(count: CountModel, left_s: Mapping[str, tuple[int, float]]) -> float:
    """When a vehicle passes the counted place: it leaves the edge, or the first one; -1 when it does not."""
    nowhere = (-1, -1.0)
    if count.edge:
        return left_s.get(count.edge, nowhere)[1]
    (first, time_s), (then, _) = (left_s.get(edge or "", nowhere) for edge in (count.from_edge, count.to_edge))
    return time_s if 0 <= first < then else -1.0


def geh(counted_per_h: float, simulated_per_h: float) -> float:
    """How far two hourly flows are apart; 0 where both are."""
    total = counted_per_h + simulated_per_h
    return math.sqrt(2.0 * (simulated_per_h - counted_per_h) ** 2 / total) if total else 0.0


def findings(counts: Sequence[MetCount], hours: float, where: str) -> list[Finding]:
    """Counts that the simulation misses by more than chance does."""
    missed = [
        c
        for c in counts
        if c.geh > GOOD_GEH
        and abs(c.simulated_per_h - c.counted_per_h) * hours > _NOISE * math.sqrt(max(c.counted_per_h * hours, 1.0))
    ]
    if not missed:
        return []
    shown = "; ".join(
        f"{c.place}{f' ({c.kind})' if c.kind else ''}: {c.simulated_per_h:g} for {c.counted_per_h:g}" for c in missed
    )
    found = f"{len(missed)} of {len(counts)} counts are missed (vehicles an hour simulated for counted): {shown}"
    cure = "counts that fit one another and the network's lanes and signals"
    return [Finding("counts", f"{where}.counts", found, cure)]
