"""Find how much traffic a network carries, by a trial of short simulations.

Assumed flows come from the classes of streets, so they may be more than a junction can take. The trial simulates a
share of all flows at a time: all of them, then 0.7 of that until a share is carried, then shares between the largest
that was carried and the smallest that was not. A share is carried if, in a simulation of :data:`DURATION_S`,

- no vehicle stands for more than :data:`MAX_STANDING_S` after the first :data:`WARMUP_S`;
- fewer than :data:`MAX_WAITING` vehicles wait for space to start;
- at least :data:`MIN_ARRIVED` of the vehicles that should have arrived have done so.

The simulation is coarse (steps of 0.5 s, no sublanes) and short, so queues that grow slowly do not show. Of a share
below 1, :data:`RESERVE` is therefore used. Rare locks do not show either.

The same network and flows give the same result.
"""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from egvs.core import files
from egvs.formats import xml
from egvs.scenario.traffic_config import CountConfig, TrafficConfig
from egvs.traffic import demand, sumo, sumo_folder
from egvs.traffic.approach_names import approach_name
from egvs.traffic.directions import TURNS, arrival_side
from egvs.traffic.locks import MOVED_M, SAMPLE_S, StreetNames
from egvs.traffic.movements import MovementNames
from egvs.traffic.network import CAR, Edge, Network, read_net_xml

DURATION_S, WARMUP_S = 900.0, 300.0
STEP_S = 0.5

MAX_STANDING_S = 200.0
MAX_WAITING = 5
MIN_ARRIVED = 0.9

MAX_RUNS = 6
RESERVE = 0.92


_FACTOR = 0.7
_CLOSE_ENOUGH = 1.06
"""The trial ends when the shares that are and are not carried differ by less than this factor."""


_FCD_FILE, _TRIPS_FILE, _STATISTICS_FILE = "trial.csv", "arrivals.xml", "statistics.xml"


@dataclass(frozen=True)
class TrialRun:
    """A simulation of a share of all flows.

    Attributes
    ----------
    share
        The share.
    scheduled, arrived
        Vehicles that should have arrived, and that did.
    longest_standing_s
        Longest time that a vehicle stood.
    waiting
        Vehicles without space to start, at the end.
    longest_standing_at
        Where and from when on the vehicle stood that stood longest; empty if none stood.
    """

    share: float
    scheduled: int
    arrived: int
    longest_standing_s: float
    waiting: int
    longest_standing_at: str = ""

    @property
    def is_carried(self) -> bool:
        """Whether the network carries this share."""
        stands = self.longest_standing_s > MAX_STANDING_S
        return not stands and self.waiting < MAX_WAITING and self.arrived >= MIN_ARRIVED * self.scheduled


@dataclass(frozen=True)
class Capacity:
    """What a network carries of its flows.

    Attributes
    ----------
    share
        Share of all flows that it carries, at most 1.
    runs
        The simulations of the trial, in order.
    """

    share: float
    runs: tuple[TrialRun, ...]

    @property
    def is_everything(self) -> bool:
        """Whether all flows are carried in full."""
        return self.share == 1.0

    @property
    def is_confirmed(self) -> bool:
        """Whether any simulation showed that the share is carried."""
        return any(run.is_carried for run in self.runs)

    @property
    def jam(self) -> str:
        """Where a vehicle stood longest in the last run that was not carried, in words; empty if none stood."""
        jams = [run for run in self.runs if not run.is_carried and run.longest_standing_at]
        if not jams:
            return ""
        return f"a vehicle stood for {jams[-1].longest_standing_s:.0f} s at {jams[-1].longest_standing_at}"


LANE_PER_H = 2000.0
"""Most vehicles an hour that pass a stop line on one lane if it is always green: one every 1.8 s, the saturation flow
of cars in the German manual (HBS 2015); about 1,900 in the American one (HCM 2016)."""


class Excess(NamedTuple):
    """An approach or a movement, its vehicles per hour, and its lanes, which cannot carry them."""

    place: str
    per_hour: float
    lanes: int


def find_excess(network: Network, names: MovementNames, flows: Iterable[CountConfig]) -> list[Excess]:
    """Find the movements, and then the approaches, whose flows exceed :data:`LANE_PER_H` on each of their lanes.

    Parameters
    ----------
    network, names
        The network, and the names of its movements.
    flows
        Vehicles per hour; those of several kinds add up.
    """
    per_h: dict[tuple[str, str], float] = {}
    places: dict[tuple[str, str], tuple[str, Edge]] = {}
    for flow in flows:
        movement = names.movement(flow.edge or flow.from_edge or "", flow.to_edge)
        edge = movement.approach[-1]
        approach = approach_name(arrival_side(movement.heading), movement.street)
        for turn in dict.fromkeys((movement.turn, "")):
            per_h[edge.id, turn] = per_h.get((edge.id, turn), 0.0) + flow.per_hour
            places[edge.id, turn] = f"{approach} {turn}".strip(), edge
    found: dict[tuple[str, str], Excess] = {}
    for (edge_id, turn), (place, edge) in sorted(places.items(), key=lambda item: item[0][1] == ""):
        turning = {
            connection.source_lane
            for connection in network.connections
            if network.edges[connection.source].id == edge_id and TURNS.get(connection.direction) == turn
        }
        lanes = len(turning) or edge.lanes_for(CAR)
        is_named = any(edge_id == other for other, _ in found)
        if per_h[edge_id, turn] > LANE_PER_H * lanes and not is_named:
            found[edge_id, turn] = Excess(place, per_h[edge_id, turn], lanes)
    return list(found.values())


def scale_flows(flows: Sequence[CountConfig], share: float) -> list[CountConfig]:
    """Return a share of all flows, rounded to whole vehicles per hour, and at least 1 each."""
    return [flow.model_copy(update={"per_hour": max(1.0, float(round(flow.per_hour * share)))}) for flow in flows]


def distribute_total(flows: Sequence[CountConfig], total_per_h: int) -> list[CountConfig]:
    """Return flows in the same proportions that add up to a total, in whole vehicles per hour; none is 0.

    Parameters
    ----------
    flows
        At least one flow above 0.
    total_per_h
        Vehicles per hour in all; the largest remainders are rounded up.
    """
    share = total_per_h / math.fsum(flow.per_hour for flow in flows)
    whole = [math.floor(flow.per_hour * share) for flow in flows]
    by_remainder = sorted(range(len(flows)), key=lambda i: whole[i] - flows[i].per_hour * share)
    for i in by_remainder[: total_per_h - sum(whole)]:
        whole[i] += 1

    scaled = []
    for flow, per_hour in zip(flows, whole, strict=True):
        if per_hour > 0:
            scaled.append(flow.model_copy(update={"per_hour": float(per_hour)}))
    return scaled


def find_capacity(network: str, flows: Sequence[CountConfig], junction_blocker_s: float) -> Capacity:
    """Find the share of all flows that a network carries.

    Parameters
    ----------
    network
        The SUMO network, as text.
    flows
        Vehicles per hour at locations of the network.
    junction_blocker_s
        As in ``[traffic]``.
    """
    runs: list[TrialRun] = []
    carried, too_much = 0.0, math.inf
    share = 1.0
    with files.temporary_folder() as folder:
        files.write_text(folder / sumo_folder.NETWORK_FILE, network)
        roads = read_net_xml(folder / sumo_folder.NETWORK_FILE)
        while len(runs) < MAX_RUNS and too_much > _CLOSE_ENOUGH * carried:
            run = _simulate(folder, roads, flows, share, junction_blocker_s)
            runs.append(run)
            if run.is_carried:
                carried = share
            else:
                too_much = share
            if carried == 1.0:
                return Capacity(1.0, tuple(runs))
            share = round((carried + too_much) / 2 if carried else _FACTOR * too_much, 3)
    return Capacity(round(RESERVE * (carried or too_much), 3), tuple(runs))


def _simulate(
    folder: Path, roads: Network, flows: Sequence[CountConfig], share: float, junction_blocker_s: float
) -> TrialRun:
    scaled = [flow.model_copy(update={"per_hour": flow.per_hour * share}) for flow in flows]
    traffic = TrafficConfig(network=sumo_folder.NETWORK_FILE, counts=tuple(scaled))
    seed = np.random.SeedSequence(0)
    routes = folder / sumo_folder.TRIPS_FILE
    demand.write_routes(traffic, roads, (0.0, DURATION_S), seed, routes, "assumed flows")
    files.write_text(folder / sumo_folder.VTYPES_FILE, demand.vtypes_xml(traffic.kinds))
    stand, waiting = run_sumo(folder, DURATION_S, WARMUP_S, {"ignore-junction-blocker": f"{junction_blocker_s:g}"})
    scheduled, arrived = _arrivals(routes, folder / _TRIPS_FILE)
    location = ""
    if stand.at_m is not None:
        x_m, y_m = stand.at_m
        location = f"{StreetNames(roads).at(stand.at_m)} (x {x_m:.0f} m, y {y_m:.0f} m) from {stand.since_s:.0f} s on"
    return TrialRun(share, scheduled, arrived, stand.longest_s, waiting, location)


class StandingVehicles(NamedTuple):
    """Vehicles that stand.

    The longest time that one stood, the share of vehicles that stand in a sample, where the first one stood (None if
    none did), and since when.
    """

    longest_s: float
    share_at_rest: float
    at_m: tuple[float, float] | None = None
    since_s: float = 0.0


def run_sumo(
    folder: Path, duration_s: float, warmup_s: float, options: Mapping[str, str]
) -> tuple[StandingVehicles, int]:
    """Simulate the routes in a folder; return the vehicles that stand, and how many have no space to start."""
    all_options = {
        "net-file": sumo_folder.NETWORK_FILE,
        "additional-files": sumo_folder.VTYPES_FILE,
        "route-files": sumo_folder.TRIPS_FILE,
        "seed": "1",
        "end": f"{duration_s:g}",
        "step-length": f"{STEP_S:g}",
        "threads": "1",
        "time-to-teleport": "-1",
        "collision.action": "none",
        "fcd-output": _FCD_FILE,
        "fcd-output.attributes": "id,x,y",
        "device.fcd.begin": f"{warmup_s:g}",
        "device.fcd.period": f"{SAMPLE_S:g}",
        "tripinfo-output": _TRIPS_FILE,
        "statistic-output": _STATISTICS_FILE,
        "no-step-log": "true",
        "no-warnings": "true",
        "duration-log.disable": "true",
        **options,
    }
    sumo.run_program("sumo", sumo_folder.as_flags(all_options), folder, time_steps=round(duration_s / STEP_S))
    (vehicles,) = (e for e in xml.iter_elements(folder / _STATISTICS_FILE, "statistics") if e.tag == "vehicles")
    return _standing(folder / _FCD_FILE), int(vehicles.get("waiting", 0))


def _arrivals(routes: Path, trips: Path) -> tuple[int, int]:
    """Return how many vehicles should have arrived, and how many did.

    Vehicles arrive, on average, one mean trip after they depart. The whole time counts, also the warm-up: with small
    flows, the number that departs in a part of the time varies by more than the tenth that may be missing.
    """
    durations_s = [float(trip.get("duration", "0")) for trip in xml.iter_elements(trips, "tripinfos")]
    mean_trip_s = min(WARMUP_S, statistics.fmean(durations_s)) if durations_s else 0.0
    departs_s = [float(vehicle.get("depart", "0")) for vehicle in xml.iter_elements(routes, "routes")]
    scheduled = sum(depart_s + mean_trip_s < DURATION_S for depart_s in departs_s)
    return scheduled, len(durations_s)


def _standing(fcd: Path) -> StandingVehicles:
    """Return for how long and where a vehicle stood at most, and the share of vehicles that stand in a sample."""
    lines = fcd.read_text(encoding="utf-8").splitlines()
    header = lines[0].split(";") if lines else []
    if len(lines) < 2:
        return StandingVehicles(0.0, 0.0)
    column = {name: header.index(name) for name in ("timestep_time", "vehicle_id", "vehicle_x", "vehicle_y")}
    last: dict[str, tuple[float, float, float]] = {}
    """Time since when each vehicle stands, and where."""
    longest = StandingVehicles(0.0, 0.0)
    rows, standing = 0, 0
    for line in lines[1:]:
        values = line.split(";")
        name = values[column["vehicle_id"]]
        if not name:
            continue
        time_s, x_m, y_m = (float(values[column[key]]) for key in ("timestep_time", "vehicle_x", "vehicle_y"))
        since_s, old_x_m, old_y_m = last.get(name, (time_s, math.inf, math.inf))
        if math.hypot(x_m - old_x_m, y_m - old_y_m) >= MOVED_M:
            since_s, old_x_m, old_y_m = time_s, x_m, y_m
        last[name] = since_s, old_x_m, old_y_m
        if time_s - since_s > longest.longest_s:
            longest = StandingVehicles(time_s - since_s, 0.0, (old_x_m, old_y_m), since_s)
        rows += 1
        standing += time_s > since_s
    return longest._replace(share_at_rest=standing / max(rows, 1))
