"""Find how many random trips per hour a whole town carries.

A flow is carried if no vehicle stands for long, all find space to start, and less than :data:`MAX_QUEUING` of them
stand beyond those that also stand in light traffic. Vehicles per kilometre of lane would be the wrong measure: most
streets are residential, and all trips use a few main roads.

The same network gives the same result. The result of each simulation is cached (:mod:`egvs.runs.store`), so a search
that was interrupted continues after the last complete simulation.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from egvs.core import files, reading
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.resource_usage import measure_usage
from egvs.runs.stage_keys import source_digest
from egvs.runs.stage_registry import StageResult
from egvs.runs.store import Store
from egvs.scenario.traffic_config import TrafficConfig
from egvs.traffic import capacity, demand, sumo, sumo_folder, town_trips
from egvs.traffic.capacity import MAX_STANDING_S, MAX_WAITING
from egvs.traffic.network import Edge, read_net_xml

FLOW_DURATION_S, FLOW_WARMUP_S, FLOW_STEP_S = 1500.0, 600.0, 1.0
"""Simulations of whole towns."""

LANE_PER_H, FIRST_LOAD = 1800, 0.6
"""Vehicles that a lane passes per hour, and the load of the busiest junction in the first simulation of a town."""

FLOW_FACTOR = 1.25
"""From one simulation of a town to the next, its flow is raised or lowered by this factor."""

MAX_FLOW_RUNS = 6
"""Maximum number of simulations of a town, without that of light traffic."""

MAX_QUEUING = 0.15
"""Maximum share of the vehicles that stand, beyond the share that stands in light traffic."""

LIGHT_SHARE = 0.1
"""Light traffic is this share of the first flow."""

_LOAD_TRIPS, _MIN_LIGHT_PER_H = 3000, 100

TRIAL_KIND = "trial"
"""Kind of the entries of the store with the results of simulations."""

_TRIAL_FILE = "trial.json"

_TRIAL_WHERE = "random trips"
"""In messages, instead of the traffic table of a scenario."""


@dataclass(frozen=True)
class FlowTrial:
    """A simulation of a whole town.

    Attributes
    ----------
    vehicles_per_h
        Vehicles that start per hour.
    reroute
        As ``traffic.reroute_at_departure``.
    longest_standing_s
        Longest time that a vehicle stood.
    waiting
        Vehicles without space to start, at the end.
    share_queuing
        Share of the vehicles that stand, in the mean over time, beyond the share in light traffic, which stands at
        red signals.
    """

    vehicles_per_h: int
    reroute: bool
    longest_standing_s: float
    waiting: int
    share_queuing: float

    @property
    def is_carried(self) -> bool:
        """Whether the town carries this flow."""
        stands = self.longest_standing_s > MAX_STANDING_S
        return not stands and self.waiting < MAX_WAITING and self.share_queuing < MAX_QUEUING


@dataclass(frozen=True)
class _TrialResult:
    """What a simulation gave: as :class:`FlowTrial`, with the share of the vehicles that stand."""

    longest_standing_s: float
    share_at_rest: float
    waiting: int


@dataclass(frozen=True)
class FlowCapacity:
    """The flow that a town carries, whether it needs ``traffic.reroute_at_departure``, and the trial's simulations."""

    vehicles_per_h: int
    reroute: bool
    runs: tuple[FlowTrial, ...]

    @property
    def is_confirmed(self) -> bool:
        """Whether any simulation showed that the flow is carried."""
        return any(run.is_carried for run in self.runs)


def find_flow(network: str, junction_blocker_s: float, progress: ProgressCallback = no_progress) -> FlowCapacity:
    """Find how many random trips per hour a town carries.

    Routes on empty streets give a first flow, at which the busiest junction has :data:`FIRST_LOAD` of
    :data:`LANE_PER_H` on each lane that leads to it. Flows are raised by :data:`FLOW_FACTOR` as long as they are
    carried, or lowered until one is, with vehicles that choose their routes at departure. If the first flow that is not
    carried is carried with routes on empty streets, these are used from there on.

    Parameters
    ----------
    network
        The SUMO network, as text.
    junction_blocker_s
        As in ``[traffic]``.
    progress
        Called before each simulation.

    Raises
    ------
    InputError
        When no trip is possible.
    """
    with files.temporary_folder() as folder:
        files.write_text(folder / sumo_folder.NETWORK_FILE, network)
        progress("draws trips", 0, 0)
        trial = _TownTrial(folder, junction_blocker_s)
        per_h, reroute = trial.first_flow(), True
        progress("simulates light traffic", 0, 0)
        trial.run_light_traffic(per_h)
        carried: FlowTrial | None = None
        too_much = math.inf
        while len(trial.runs) < MAX_FLOW_RUNS:
            progress(f"simulates {per_h:,} vehicles an hour: trial", len(trial.runs) + 1, MAX_FLOW_RUNS)
            run = trial.run(per_h, reroute)
            if run.is_carried:
                carried = run
                per_h = round(per_h * FLOW_FACTOR)
                if per_h > 0.99 * too_much:
                    reroute = False
            elif carried is None:
                too_much = per_h
                per_h = max(1, round(per_h / FLOW_FACTOR))
            elif reroute:
                reroute = False
            else:
                break
        if carried is None:
            return FlowCapacity(per_h, True, tuple(trial.runs))
        return FlowCapacity(carried.vehicles_per_h, carried.reroute, tuple(trial.runs))


class _TownTrial:
    """Simulates flows through a town; the same trips depart at different rates."""

    def __init__(self, folder: Path, junction_blocker_s: float) -> None:
        self.runs: list[FlowTrial] = []
        self._folder = folder
        self._options = {
            "ignore-junction-blocker": f"{junction_blocker_s:g}",
            "step-length": f"{FLOW_STEP_S:g}",
        }
        self._traffic = TrafficConfig(network=sumo_folder.NETWORK_FILE)
        self._roads = read_net_xml(folder / sumo_folder.NETWORK_FILE)
        self._rng = np.random.default_rng(0)
        files.write_text(folder / sumo_folder.VTYPES_FILE, demand.vtypes_xml(self._traffic.kinds))
        self._ends = [
            town_trips.trip_ends(self._roads, kind, self._traffic, _TRIAL_WHERE) for kind in self._traffic.kinds
        ]
        self._routed: list[demand.RoutedTrip] = []
        self._n_trips = 0
        self._share_in_light_traffic = 0.0

    def first_flow(self) -> int:
        """Return the flow, in vehicles per hour, at which the busiest junction has the load :data:`FIRST_LOAD`."""
        self._draw(_LOAD_TRIPS)
        incoming: dict[str, list[Edge]] = {}
        for edge in self._roads.edges:
            incoming.setdefault(edge.to_node, []).append(edge)
        passes = Counter(edge for trip in self._routed for edge in trip.edges.split())
        loads = []
        for edges in incoming.values():
            if len(edges) > 1:
                loads.append(math.fsum(passes[edge.id] / (LANE_PER_H * len(edge.lanes)) for edge in edges))
        per_trip = max(loads, default=0.0) / self._n_trips
        if not per_trip:  # no junction
            return LANE_PER_H
        return max(1, round(FIRST_LOAD / per_trip))

    def run_light_traffic(self, first_per_h: int) -> None:
        """Measure which share of the vehicles stands in light traffic."""
        per_h = max(_MIN_LIGHT_PER_H, round(LIGHT_SHARE * first_per_h))
        self._share_in_light_traffic = self._simulate(per_h, True).share_at_rest

    def run(self, per_h: int, reroute: bool) -> FlowTrial:
        """Simulate a flow."""
        result = self._simulate(per_h, reroute)
        share_queuing = round(max(0.0, result.share_at_rest - self._share_in_light_traffic), 4)
        run = FlowTrial(per_h, reroute, result.longest_standing_s, result.waiting, share_queuing)
        self.runs.append(run)
        return run

    def _simulate(self, per_h: int, reroute: bool) -> _TrialResult:
        count = math.ceil(FLOW_DURATION_S * per_h / 3600.0)
        if count > self._n_trips:
            self._draw(count)
        departs_s = np.arange(self._n_trips, dtype=np.float64) * (3600.0 / per_h)
        departing = [trip for trip in self._routed if trip.number < count]
        files.write_text(self._folder / sumo_folder.TRIPS_FILE, demand.routes_xml(departing, departs_s))
        options = self._options | (demand.REROUTE_OPTIONS if reroute else {})
        return self._run_or_take(options)

    def _run_or_take(self, options: dict[str, str]) -> _TrialResult:
        """Simulate the routes in the folder, unless the store has the result."""
        names = (sumo_folder.NETWORK_FILE, sumo_folder.VTYPES_FILE, sumo_folder.TRIPS_FILE)
        key = files.hash_json({
            "files": {name: files.hash_file(self._folder / name) for name in names}, "options": options,
            "times_s": [FLOW_DURATION_S, FLOW_WARMUP_S], "sumo": sumo.sumo_version(),
            "source": source_digest(capacity.__name__).digest,
        })  # fmt: skip
        store = Store.default()
        with store.maker(TRIAL_KIND, key):
            if store.take(TRIAL_KIND, key, self._folder) is not None:
                return _TrialResult(**reading.read_json(self._folder / _TRIAL_FILE))
            with measure_usage() as cost:
                standing, waiting = capacity.run_sumo(self._folder, FLOW_DURATION_S, FLOW_WARMUP_S, options)
            result = _TrialResult(standing.longest_s, standing.share_at_rest, waiting)
            files.write_text(self._folder / _TRIAL_FILE, files.to_json_text(asdict(result)))
            digest = files.hash_file(self._folder / _TRIAL_FILE)
            store.put(TRIAL_KIND, key, self._folder, StageResult({_TRIAL_FILE: digest}, {}, {}, cost))
        return result

    def _draw(self, count: int) -> None:
        """Draw and route trips, at least as many as a number."""
        trips = town_trips.draw_town_trips(self._roads, self._traffic, self._ends, count, self._rng, _TRIAL_WHERE)
        self._n_trips = count
        self._routed = demand.route_trips(trips, self._folder, sumo_folder.NETWORK_FILE, sumo_folder.VTYPES_FILE)
