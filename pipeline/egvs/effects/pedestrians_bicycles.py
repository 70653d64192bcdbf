"""Pedestrians and bicycles beside the scenario's vehicles.

*Pedestrians* are SUMO's persons. Each walks from one end of a sidewalk at the network's fringe to one at another fringe
node (in a network without such ends: between any two connected sidewalks), over sidewalks, walking areas and crossings,
and obeys signals. SUMO's person-FCD gives the middle of their front, as it does for vehicles (tested: a pedestrian of
any length waits with that point on the kerb); people stay upright on a slope.

*Bicycles* are vehicles of vClass bicycle, from fringe to fringe on the lanes that admit them. They count for SUMO's
``--max-num-vehicles``, which keeps the number of motor vehicles constant; with bicycles coming and going, that number
would vary. Therefore a few vehicles that never leave make the trips of all bicycles, one after another: at the end of
each trip the vehicle *jumps* (SUMO's stop with ``jump`` and ``jumpUntil``), is nowhere until the next trip departs, and
continues there. With S such vehicles the limit is ``traffic.vehicles`` + S, and exactly ``traffic.vehicles`` motor
vehicles are in every frame. Pedestrians, bicycles and vehicles share one simulation and yield to each other.

Departures are drawn uniformly over the simulated time, rate times duration of them, from the scenario's seed.

Boxes: 0.8 x 0.6 x 1.73 m for a pedestrian, 1.76 x 0.6 x 1.73 m for a bicycle with its rider: the anchor boxes of Lang
et al. 2019, "PointPillars", CVPR (arXiv 1812.05784) for the KITTI 3-D object benchmark, which Yan, Mao and Li 2018,
"SECOND", Sensors 18(10):3337, chose after the means of KITTI's training labels, so arms and strides are included.
SUMO's own are 0.215 x 0.478 x 1.719 m and 1.6 x 0.65 x 1.7 m.

Source: Erdmann and Krajzewicz 2015, "Modelling Pedestrian Dynamics in SUMO", SUMO 2015 Intermodal Simulation for
Intermodal Transport (the striping model).

Use it for sites that must detect people. Limits: pedestrians' boxes may overlap where SUMO lets people pass closely,
and on crossings that they share with turning traffic; nobody walks in groups; bicycles do not use sidewalks; sizes do
not vary.
"""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, IntArray
from egvs.effects.base import Traffic
from egvs.scenario.effects_config import EffectParameters, PedestriansBicyclesParameters
from egvs.scenario.model import Scenario
from egvs.scenario.traffic_config import TrafficConfig, VehicleKind
from egvs.sensors.scene import Scene
from egvs.traffic import demand, network, sumo_folder
from egvs.traffic.network import Network, Sidewalk
from egvs.traffic.vehicle_boxes import ExtraTraffic, VehicleSize

PEDESTRIAN = "egvs_pedestrian"
BICYCLE = "egvs_bicycle"
"""SUMO's types of them, and prefixes of their names."""

TYPES = frozenset((PEDESTRIAN, BICYCLE))

_RIDE_M_S = 4.0
"""Lower bound of a bicycle's mean speed over a trip, without stops; SUMO's default is 5.56 m/s on a free road."""

_WAIT_PER_EDGE_S = 30.0
_BEYOND_END_S = 3600.0
_STOP_M = 12.0
_MIN_STOP_M = 0.1
_EPSILON = 1e-6
_STOP_SPACING_M = 0.25
_MAX_SAME_END = 32
_WAYPOINT_M_S = 15.0
_SIDEWALKS_HINT = (
    "Use a network with sidewalks and walking areas, from egvs new --walk or"
    " netconvert --sidewalks.guess --crossings.guess."
)
_BICYCLE_LANES_HINT = "Use a network with lanes for bicycles, for example from netconvert --bikelanes.guess."


class PedestriansBicycles(Traffic[PedestriansBicyclesParameters]):
    """People on foot and on bicycles, in addition to the scenario's vehicles."""

    NAME: ClassVar[str] = "pedestrians_bicycles"
    SOURCE: ClassVar[str] = (
        "Erdmann and Krajzewicz 2015 (SUMO's striping model); box sizes: Lang et al. 2019, arXiv 1812.05784"
    )
    Model: ClassVar[type[EffectParameters]] = PedestriansBicyclesParameters
    TRIAL: ClassVar[dict[str, Any]] = {"pedestrians_per_h": 100.0}
    USER_KNOWLEDGE: ClassVar[str] = "whether people must be seen"
    ADDS_TRAFFIC: ClassVar[bool] = True

    def scenario_error(self, scenario: Scenario) -> InputError | None:
        """Return the error for recorded traffic, to which nobody can be added."""
        if not scenario.traffic.is_finished or not self.acts(scenario)[0]:
            return None
        problem = "pedestrians and bicycles cannot be added to recorded traffic"
        return InputError(self.config_key(scenario), problem, "Use network or sumocfg in [traffic].")

    def acts(self, scenario: Scenario) -> tuple[bool, str]:
        """Return whether any rate is above 0."""
        if self.parameters.pedestrians_per_h == 0 and self.parameters.bicycles_per_h == 0:
            return False, "both rates are 0"
        return True, "named"

    def summary(self, scene: Scene) -> str:
        """Return where people could walk, as a sentence."""
        path = sumo_folder.network_path(scene.scenario)
        if path is None or scene.scenario.traffic.is_finished:
            return ""
        walkways = network.read_net_xml(path).walkways
        if not walkways.sidewalks or not walkways.areas:
            return "the network has no connected sidewalks (egvs new --walk adds some)"
        return f"the network has {len(walkways.sidewalks)} sidewalks and {walkways.crossings} crossings"

    def sizes(self) -> dict[str, VehicleSize]:
        """Return the sizes of the types that this effect adds."""
        return {
            PEDESTRIAN: VehicleSize(*self.parameters.pedestrian_m, "pedestrian"),
            BICYCLE: VehicleSize(*self.parameters.bicycle_m, "bicycle"),
        }

    def uncounted_types(self, sizes: Mapping[str, VehicleSize]) -> frozenset[str]:
        """Return the types that are no motor vehicles: those of this effect, and a user's persons."""
        return TYPES | {name for name, size in sizes.items() if size.vclass == "pedestrian"}

    def plan(
        self, scenario: Scenario, roads: Network, begin_s: float, end_s: float, rng: np.random.Generator
    ) -> ExtraTraffic:
        """Draw all trips between two times; InputError when the network has no sidewalks or bicycle lanes."""
        where = self.config_key(scenario)
        walkers_rng, riders_rng = rng.spawn(2)
        walk_times_s = _draw_departures(self.parameters.pedestrians_per_h, begin_s, end_s, walkers_rng)
        ride_times_s = _draw_departures(self.parameters.bicycles_per_h, begin_s, end_s, riders_rng)
        persons: list[str] = []
        notes: list[str] = []
        rides: list[_Ride] = []
        if self.parameters.pedestrians_per_h:
            persons = _walks(roads, walk_times_s, walkers_rng, where)
            if not roads.walkways.crossings:
                notes.append(
                    "pedestrians_bicycles: the network has no crossings, so people stay on their side of the road"
                )
        if self.parameters.bicycles_per_h:
            rides = _rides(roads, scenario.traffic, ride_times_s, riders_rng, where)
        vehicles = list(_reuse_vehicles(rides, begin_s, end_s))
        lines = ["<routes>", *self._types(), *vehicles, *persons, "</routes>", ""]
        return ExtraTraffic("\n".join(lines), len(vehicles), tuple(notes))

    def _types(self) -> Iterator[str]:
        sizes = self.sizes()
        yield demand.vtype_xml(PEDESTRIAN, sizes[PEDESTRIAN], {})
        yield demand.vtype_xml(BICYCLE, sizes[BICYCLE], demand.STRAIGHT_STOP_ATTRIBUTES)


def _draw_departures(rate_per_h: float, begin_s: float, end_s: float, rng: np.random.Generator) -> FloatArray:
    hours = (end_s - begin_s) / 3600.0
    return np.sort(begin_s + rng.random(round(rate_per_h * hours)) * (end_s - begin_s))


class _SidewalkPosition(NamedTuple):
    """A position along a sidewalk."""

    sidewalk: Sidewalk
    at_m: float


def _walks(roads: Network, times_s: FloatArray, rng: np.random.Generator, where: str) -> list[str]:
    """One ``<person>`` per departure."""
    key = f"{where}.pedestrians_per_h"
    walkways = roads.walkways
    if not walkways.sidewalks or not walkways.areas:
        raise InputError(key, "the network has no connected sidewalks", _SIDEWALKS_HINT)
    trips = _fringe_trips(walkways.sidewalks) or _trips_anywhere(walkways.sidewalks)
    if not trips:
        raise InputError(key, "no two sidewalks are connected", _SIDEWALKS_HINT)
    drawn = rng.integers(len(trips), size=times_s.size)
    persons = []
    for number, (depart_s, trip) in enumerate(zip(times_s, drawn, strict=True)):
        start, end = trips[trip]
        persons.append(
            f'    <person id="{PEDESTRIAN}_{number}" type="{PEDESTRIAN}" depart="{depart_s:.3f}"'
            f' departPos="{start.at_m:.2f}">'
            f"<walk from={quoteattr(start.sidewalk.edge)} to={quoteattr(end.sidewalk.edge)}"
            f' arrivalPos="{end.at_m:.2f}"/></person>'
        )
    return persons


def _fringe_trips(sidewalks: tuple[Sidewalk, ...]) -> list[tuple[_SidewalkPosition, _SidewalkPosition]]:
    """Trips between connected sidewalk ends at two nodes of the fringe, i.e. with one neighbour only."""
    neighbours: dict[str, set[str]] = {}
    for walk in sidewalks:
        neighbours.setdefault(walk.from_node, set()).add(walk.to_node)
        neighbours.setdefault(walk.to_node, set()).add(walk.from_node)
    fringe = {node for node, nearby in neighbours.items() if len(nearby) == 1}
    ends = [(walk.from_node, _SidewalkPosition(walk, 0.0)) for walk in sidewalks if walk.from_node in fringe]
    ends += [(walk.to_node, _SidewalkPosition(walk, walk.length_m)) for walk in sidewalks if walk.to_node in fringe]
    trips = []
    for start_node, start in ends:
        for end_node, end in ends:
            if start_node != end_node and start.sidewalk.part == end.sidewalk.part:
                trips.append((start, end))
    return trips


def _trips_anywhere(sidewalks: tuple[Sidewalk, ...]) -> list[tuple[_SidewalkPosition, _SidewalkPosition]]:
    """Trips from the middle of any sidewalk to that of any other that is connected to it."""
    middles = [_SidewalkPosition(walk, walk.length_m / 2) for walk in sidewalks]
    trips = itertools.product(middles, middles)
    return [(start, end) for start, end in trips if start != end and start.sidewalk.part == end.sidewalk.part]


class _BicycleLane(NamedTuple):
    """The first lane of an edge that bicycles may use."""

    id: str
    length_m: float


@dataclass(frozen=True)
class _Ride:
    """A trip by bicycle; ``duration_s`` is usually an upper bound."""

    depart_s: float
    edges: tuple[str, ...]
    duration_s: float
    first_lane: _BicycleLane
    last_lane: _BicycleLane


def _rides(
    roads: Network, traffic: TrafficConfig, times_s: FloatArray, rng: np.random.Generator, where: str
) -> list[_Ride]:
    """One ride per departure."""
    key = f"{where}.bicycles_per_h"
    kind = VehicleKind(name=BICYCLE, vclass="bicycle", length_m=1.76, width_m=0.6, height_m=1.73)
    if not any(edge.lanes_for(kind.vclass) for edge in roads.edges):
        raise InputError(key, "the network has no lane that bicycles may use", _BICYCLE_LANES_HINT)
    unweighted = traffic.model_copy(update={"edge_weights": {}, "min_trip_m": 0.0})
    pairs = demand.origin_destination_pairs(roads, kind, unweighted, rng, key)
    drawn = rng.choice(pairs.origin.size, size=times_s.size, p=pairs.weight / pairs.weight.sum())
    router = _Router(roads)
    rides = []
    for depart_s, pair in zip(times_s.tolist(), drawn, strict=True):
        route = router.route(int(pairs.origin[pair]), int(pairs.target[pair]))
        length_m = sum(router.lengths_m[edge] for edge in route)
        duration_s = length_m / _RIDE_M_S + _WAIT_PER_EDGE_S * len(route)
        edges = tuple(roads.edges[i].id for i in route)
        rides.append(_Ride(depart_s, edges, duration_s, router.lane(route[0]), router.lane(route[-1])))
    return rides


class _Router:
    """Shortest routes over the edges that bicycles may use."""

    def __init__(self, roads: Network) -> None:
        from scipy.sparse import csr_array

        self._roads = roads
        n = len(roads.edges)
        self.lengths_m = np.zeros(n)
        for i, edge in enumerate(roads.edges):
            if edge.lanes_for("bicycle"):
                self.lengths_m[i] = self.lane(i).length_m
        links = roads.links("bicycle")
        links = links[np.unique(links[:, :2], axis=0, return_index=True)[1]]
        self._graph = csr_array((self.lengths_m[links[:, 1]] + 1.0, (links[:, 0], links[:, 1])), shape=(n, n))
        self._predecessors: dict[int, IntArray] = {}

    def lane(self, edge: int) -> _BicycleLane:
        """Return the first lane of an edge that bicycles may use."""
        road = self._roads.edges[edge]
        index = next(i for i, lane in enumerate(road.lanes) if lane.permission.admits("bicycle"))
        return _BicycleLane(f"{road.id}_{index}", road.lanes[index].length_m)

    def route(self, origin: int, target: int) -> list[int]:
        """Return the edges from ``origin`` to ``target``, including both."""
        from scipy.sparse.csgraph import dijkstra

        if origin not in self._predecessors:
            self._predecessors[origin] = dijkstra(self._graph, indices=origin, return_predecessors=True)[1]
        route = [target]
        while route[-1] != origin:
            route.append(int(self._predecessors[origin][route[-1]]))
        return route[::-1]


def _reuse_vehicles(rides: list[_Ride], begin_s: float, end_s: float) -> Iterator[str]:
    """One ``<vehicle>`` for several rides; a ride goes to the vehicle that has been free for longest, or to a new one.

    A vehicle starts at once, jumps to its first ride, from ride to ride, and finally beyond the simulation's end.
    """
    free: list[tuple[float, int]] = []
    rides_of_vehicle: list[list[_Ride]] = []
    for ride in rides:
        number = len(rides_of_vehicle)
        if free and free[0][0] <= ride.depart_s:
            longest_free = free[0][1]
            if _same_end_count(rides_of_vehicle[longest_free], ride) < _MAX_SAME_END:
                number = heapq.heappop(free)[1]
        if number == len(rides_of_vehicle):
            rides_of_vehicle.append([])
        rides_of_vehicle[number].append(ride)
        heapq.heappush(free, (ride.depart_s + ride.duration_s, number))
    for number, vehicle_rides in enumerate(rides_of_vehicle):
        first = vehicle_rides[0]
        edges = [first.edges[0]]
        stops = [_stop(first.first_lane, 0.0, _STOP_M, first.depart_s)]
        departures_s = [ride.depart_s for ride in vehicle_rides[1:]] + [end_s + _BEYOND_END_S]
        for i, (ride, until_s) in enumerate(zip(vehicle_rides, departures_s, strict=True)):
            edges += ride.edges
            # SUMO takes a stop as on the same pass of a lane as the previous one, unless it lies before it
            spacing_m = min(_STOP_SPACING_M, ride.last_lane.length_m / 2 / _MAX_SAME_END)
            end_m = ride.last_lane.length_m - _same_end_count(vehicle_rides[:i], ride) * spacing_m
            stops.append(_stop(ride.last_lane, end_m - _STOP_M, end_m, until_s))
        edges.append(first.edges[0])
        yield (
            f'    <vehicle id="{BICYCLE}_{number}" type="{BICYCLE}" depart="{begin_s:.3f}" departPos="base">'
            f"<route edges={quoteattr(' '.join(edges))}/>{''.join(stops)}</vehicle>"
        )


def _same_end_count(previous: list[_Ride], ride: _Ride) -> int:
    """Count the consecutive rides just before ``ride`` that end on the same lane."""
    count = 0
    for before in reversed(previous):
        if before.last_lane != ride.last_lane:
            break
        count += 1
    return count


def _stop(lane: _BicycleLane, start_m: float, end_m: float, until_s: float) -> str:
    """A stop from which a vehicle jumps; it spans a stretch of the lane, so that the vehicle need not brake before."""
    end_m = min(math.floor(100 * lane.length_m + _EPSILON) / 100, end_m)  # SUMO rejects an end beyond the lane's
    start_m = max(0.0, min(start_m, end_m - _MIN_STOP_M))
    return (
        f'<stop lane={quoteattr(lane.id)} startPos="{start_m:.2f}" endPos="{end_m:.2f}"'
        f' duration="0" speed="{_WAYPOINT_M_S:g}" jump="0" jumpUntil="{until_s:.3f}"/>'
    )
