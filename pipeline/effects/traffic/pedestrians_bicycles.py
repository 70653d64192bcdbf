r"""Brings people on foot and on bicycles onto the street.

*Pedestrians* are SUMO's persons. Each walks from one end of a sidewalk at the network's fringe to one at another fringe
node (in a network without such ends: between any two sidewalks that hang together), over sidewalks, walking areas and
crossings, and heeds signals. SUMO's person-FCD gives the middle of their front, as it does for vehicles (a pedestrian
of any length waits with that point on the kerb: measured); people stand upright on a slope.

*Bicycles* are vehicles of vClass bicycle, from fringe to fringe on the lanes that admit them. They would count for
SUMO's ``--max-num-vehicles``, which holds the number of motor vehicles: with bicycles coming and going, that number
would waver. So the trips of one bicycle after another are strung on a few vehicles that never leave: at the end of each
trip the vehicle *jumps* (SUMO's stop with ``jump`` and ``jumpUntil``), is nowhere until the next trip's departure, and
goes on there. With S such vehicles the limit is ``traffic.vehicles`` + S, and exactly ``traffic.vehicles`` motor
vehicles are in every frame. Both kinds share the road with the vehicles in one simulation; they give way and are given
way to.

Departures are drawn uniformly over the simulated time: rate times duration of them, from the scenario's seed.

Boxes: 0.8 x 0.6 x 1.73 m a pedestrian, 1.76 x 0.6 x 1.73 m a bicycle with its rider: the anchor boxes with which Lang
et al. 2019, "PointPillars", CVPR (arXiv 1812.05784) look for them in the KITTI 3-D object benchmark, sizes that Yan,
Mao and Li 2018, "SECOND", Sensors 18(10):3337, chose after the means of KITTI's training labels, so arms and strides
are included. SUMO's own are 0.215 x 0.478 x 1.719 m and 1.6 x 0.65 x 1.7 m.

Source: Erdmann and Krajzewicz 2015, "Modelling Pedestrian Dynamics in SUMO", SUMO 2015 Intermodal Simulation for
Intermodal Transport (the striping model).

Calls for it: sites that must see people. Limits: pedestrians' boxes may overlap where SUMO lets people pass closely,
and on crossings that they share with turning traffic; nobody walks in groups; bicycles do not use sidewalks; sizes do
not vary.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from pipeline.core.errors import InputError
from pipeline.effects.base import Traffic
from pipeline.scenario.effects import EffectParameters, PedestriansBicyclesParameters
from pipeline.scenario.models import Scenario
from pipeline.scenario.traffic import TrafficModel, VehicleKind
from pipeline.sensing.scene import Scene
from pipeline.traffic import network, sumo_folder
from pipeline.traffic.boxes import Size
from pipeline.traffic.demand import trips as demand
from pipeline.traffic.extensions import TrafficPlan
from pipeline.traffic.network import Network, Sidewalk

PEDESTRIAN, BICYCLE = "egvs_pedestrian", "egvs_bicycle"
"""SUMO's types of them, and what their vehicles' names begin with."""

TYPES = frozenset((PEDESTRIAN, BICYCLE))

_RIDES_M_S = 4.0
"""A bicycle's least mean speed over a trip, without stops; SUMO's own ride 5.56 m/s on a free road."""

_WAITS_S = 30.0
_BEYOND_S = 3600.0
_STOP_M, _LEAST_STOP_M, _HAIR = 12.0, 0.1, 1e-6
_BEFORE_M, _MOST_ALIKE = 0.25, 32
_WAYPOINT_M_S = 15.0
_MAKES_WALKS = (
    "a network with sidewalks and walking areas, from egvs new --walk or netconvert --sidewalks.guess --crossings.guess"
)
_MAKES_LANES = "a network with lanes for bicycles, for example from netconvert --bikelanes.guess"


class PedestriansBicycles(Traffic[PedestriansBicyclesParameters]):
    """People on foot and on bicycles beside the scenario's vehicles."""

    NAME: ClassVar[str] = "pedestrians_bicycles"
    SOURCE: ClassVar[str] = (
        "Erdmann and Krajzewicz 2015 (SUMO's striping model); box sizes: Lang et al. 2019, arXiv 1812.05784"
    )
    Model: ClassVar[type[EffectParameters]] = PedestriansBicyclesParameters
    TRIAL: ClassVar[dict[str, Any]] = {"pedestrians_per_h": 100.0}
    UNTOLD: ClassVar[str] = "whether people must be seen"
    ADDS_TRAFFIC: ClassVar[bool] = True

    def refuses(self, scenario: Scenario) -> InputError | None:
        """Nobody can be added to a finished file."""
        if scenario.traffic.fcd is None or not self.acts(scenario)[0]:
            return None
        reason = "the scenario names a finished FCD file, so nobody can be added"
        return InputError(self.place(scenario), reason, "network or sumocfg in [traffic]")

    def acts(self, scenario: Scenario) -> tuple[bool, str]:
        """Rates of 0 bring nobody."""
        both = self.parameters.pedestrians_per_h == 0 and self.parameters.bicycles_per_h == 0
        return (False, "both rates are 0") if both else (True, "named")

    def seen(self, scene: Scene) -> str:
        """Where people could walk."""
        path = sumo_folder.network_path(scene.scenario)
        if path is None or network.is_osm(path) or scene.scenario.traffic.fcd is not None:
            return ""
        ways = network.read(path).walkways
        if not ways.sidewalks or not ways.areas:
            return "the network has no sidewalks that hang together (egvs new --walk makes some)"
        return f"the network has {len(ways.sidewalks)} sidewalks and {ways.crossings} crossings"

    def sizes(self) -> dict[str, Size]:
        """Sizes of the types that this effect adds."""
        p = self.parameters
        named = ((PEDESTRIAN, "pedestrian", p.pedestrian_m), (BICYCLE, "bicycle", p.bicycle_m))
        return {name: Size(length, width, height, vclass) for name, vclass, (length, width, height) in named}

    def uncounted_types(self, sizes: Mapping[str, Size]) -> frozenset[str]:
        """What this effect adds, and a user's own persons."""
        return TYPES | {name for name, size in sizes.items() if size.vclass == "pedestrian"}

    def plan(
        self, scenario: Scenario, roads: Network, begin_s: float, end_s: float, rng: np.random.Generator
    ) -> TrafficPlan:
        """Draw everybody's trips between two times; InputError when the network has no place for them."""
        place, hours = self.place(scenario), (end_s - begin_s) / 3600.0
        walkers, riders = rng.spawn(2)
        times = [
            np.sort(begin_s + draw.random(round(rate * hours)) * (end_s - begin_s))
            for draw, rate in ((walkers, self.parameters.pedestrians_per_h), (riders, self.parameters.bicycles_per_h))
        ]
        persons, notes = _walks(roads, times[0], walkers, place) if self.parameters.pedestrians_per_h else ([], [])
        rides = _rides(roads, scenario.traffic, times[1], riders, place) if self.parameters.bicycles_per_h else []
        vehicles = list(_on_few_vehicles(rides, begin_s, end_s))
        lines = ["<routes>", *self._types(), *vehicles, *persons, "</routes>", ""]
        return TrafficPlan("\n".join(lines), len(vehicles), tuple(notes))

    def _types(self) -> Iterator[str]:
        for name, size in self.sizes().items():
            yield demand.vtype_xml(name, size, demand.UPRIGHT if name == BICYCLE else {})


SidewalkPlace = tuple[Sidewalk, float]


# ---- on foot


def _walks(
    roads: Network, times_s: NDArray[np.float64], rng: np.random.Generator, place: str
) -> tuple[list[str], list[str]]:
    """One ``<person>`` a departure."""
    ways = roads.walkways
    if not ways.sidewalks or not ways.areas:
        raise InputError(f"{place}.pedestrians_per_h", "the network has no sidewalks that hang together", _MAKES_WALKS)
    pairs = _ends(ways.sidewalks) or _anywhere(ways.sidewalks)
    if not pairs:
        raise InputError(f"{place}.pedestrians_per_h", "no sidewalk leads to another", _MAKES_WALKS)
    note = "pedestrians_bicycles: the network has no crossings, so people stay on their side of the road"
    chosen, people = rng.integers(len(pairs), size=times_s.size), []
    for number, (depart, pair) in enumerate(zip(times_s, chosen, strict=True)):
        (start, start_m), (end, end_m) = pairs[pair]
        people.append(
            f'    <person id="{PEDESTRIAN}_{number}" type="{PEDESTRIAN}" depart="{depart:.3f}"'
            f' departPos="{start_m:.2f}"><walk from={quoteattr(start.edge)} to={quoteattr(end.edge)}'
            f' arrivalPos="{end_m:.2f}"/></person>'
        )
    return people, [] if ways.crossings else [note]


def _ends(sidewalks: tuple[Sidewalk, ...]) -> list[tuple[SidewalkPlace, SidewalkPlace]]:
    """Pairs of sidewalk ends at two nodes of the fringe (with one neighbour only) that people can walk between."""
    neighbours: dict[str, set[str]] = {}
    for walk in sidewalks:
        neighbours.setdefault(walk.from_node, set()).add(walk.to_node)
        neighbours.setdefault(walk.to_node, set()).add(walk.from_node)
    fringe = {node for node, others in neighbours.items() if len(others) == 1}
    ends = [(walk, 0.0, walk.from_node) for walk in sidewalks if walk.from_node in fringe]
    ends += [(walk, walk.length_m, walk.to_node) for walk in sidewalks if walk.to_node in fringe]
    return [((a, a_m), (b, b_m)) for a, a_m, start in ends for b, b_m, end in ends if start != end and a.part == b.part]


def _anywhere(sidewalks: tuple[Sidewalk, ...]) -> list[tuple[SidewalkPlace, SidewalkPlace]]:
    """From the middle of any sidewalk to that of any other that hangs together with it."""
    pairs = [(a, b) for a in sidewalks for b in sidewalks if a != b and a.part == b.part]
    return [((a, a.length_m / 2), (b, b.length_m / 2)) for a, b in pairs]


# ---- on bicycles


@dataclass(frozen=True)
class _Ride:
    """One trip; ``takes_s`` at most (mostly). ``first`` and ``last`` are its first and last edge's lane and length."""

    depart_s: float
    edges: tuple[str, ...]
    takes_s: float
    first: tuple[str, float]
    last: tuple[str, float]


def _rides(
    roads: Network, traffic: TrafficModel, times_s: NDArray[np.float64], rng: np.random.Generator, place: str
) -> list[_Ride]:
    kind = VehicleKind(name=BICYCLE, vclass="bicycle", length_m=1.76, width_m=0.6, height_m=1.73)
    if not any(edge.lanes_for(kind.vclass) for edge in roads.edges):
        raise InputError(f"{place}.bicycles_per_h", "the network has no lane that bicycles may use", _MAKES_LANES)
    free = traffic.model_copy(update={"edge_weights": {}, "min_trip_m": 0.0})
    pairs = demand.pairs(roads, kind, free, rng, f"{place}.bicycles_per_h")
    chosen = rng.choice(pairs.origin.size, size=times_s.size, p=pairs.weight / pairs.weight.sum())
    router, rides = _Router(roads), []
    for depart, pair in zip(times_s.tolist(), chosen, strict=True):
        way = router.way(int(pairs.origin[pair]), int(pairs.target[pair]))
        length = sum(router.lengths_m[edge] for edge in way)
        takes = length / _RIDES_M_S + _WAITS_S * len(way)
        edges = tuple(roads.edges[i].id for i in way)
        rides.append(_Ride(depart, edges, takes, router.lane(way[0]), router.lane(way[-1])))
    return rides


class _Router:
    """Shortest ways over the edges that bicycles may use."""

    def __init__(self, roads: Network) -> None:
        from scipy.sparse import csr_array

        self._roads = roads
        n = len(roads.edges)
        self.lengths_m = np.array([self.lane(i)[1] if roads.edges[i].lanes_for("bicycle") else 0.0 for i in range(n)])
        links = roads.links("bicycle")
        links = links[np.unique(links[:, :2], axis=0, return_index=True)[1]]
        self._graph = csr_array((self.lengths_m[links[:, 1]] + 1.0, (links[:, 0], links[:, 1])), shape=(n, n))
        self._before: dict[int, NDArray[np.int64]] = {}

    def lane(self, edge: int) -> tuple[str, float]:
        """The first lane of an edge that bicycles may use, and its length."""
        road = self._roads.edges[edge]
        index = next(i for i, lane in enumerate(road.lanes) if lane.permission.admits("bicycle"))
        return f"{road.id}_{index}", road.lanes[index].length_m

    def way(self, origin: int, target: int) -> list[int]:
        """The edges from ``origin`` to ``target``, both included."""
        from scipy.sparse.csgraph import dijkstra

        if origin not in self._before:
            self._before[origin] = dijkstra(self._graph, indices=origin, return_predecessors=True)[1]
        way = [target]
        while way[-1] != origin:
            way.append(int(self._before[origin][way[-1]]))
        return way[::-1]


def _on_few_vehicles(rides: list[_Ride], begin_s: float, end_s: float) -> Iterator[str]:
    """One ``<vehicle>`` for trips one after another; each goes to the one that is free for longest, or to a new one.

    A vehicle starts at once, jumps to its first trip, from trip to trip, and at last beyond the simulation's end.
    """
    free: list[tuple[float, int]] = []
    strings: list[list[_Ride]] = []
    for ride in rides:
        if free and free[0][0] <= ride.depart_s and _alike(strings[free[0][1]], ride) < _MOST_ALIKE:
            number = heapq.heappop(free)[1]
        else:
            number = len(strings)
            strings.append([])
        strings[number].append(ride)
        heapq.heappush(free, (ride.depart_s + ride.takes_s, number))
    for number, string in enumerate(strings):
        edges, stops = [string[0].edges[0]], [_stop(string[0].first, 0.0, _STOP_M, string[0].depart_s)]
        for i, (ride, following) in enumerate(zip(string, [*string[1:], None], strict=True)):
            edges += ride.edges
            # SUMO takes a stop as on the same pass of a lane as the last one, unless it lies before it
            end_m = ride.last[1] - _alike(string[:i], ride) * min(_BEFORE_M, ride.last[1] / 2 / _MOST_ALIKE)
            until_s = end_s + _BEYOND_S if following is None else following.depart_s
            stops.append(_stop(ride.last, end_m - _STOP_M, end_m, until_s))
        edges.append(string[0].edges[0])
        yield (
            f'    <vehicle id="{BICYCLE}_{number}" type="{BICYCLE}" depart="{begin_s:.3f}" departPos="base">'
            f"<route edges={quoteattr(' '.join(edges))}/>{''.join(stops)}</vehicle>"
        )


def _alike(string: list[_Ride], ride: _Ride) -> int:
    """How many of the last trips before ``ride`` ended on its last lane, one after another."""
    return next((i for i, before in enumerate(reversed(string)) if before.last != ride.last), len(string))


def _stop(lane: tuple[str, float], start_m: float, end_m: float, until_s: float) -> str:
    """Where a vehicle jumps from: anywhere between two places of a lane, so that it need not brake before."""
    name, length_m = lane
    end_m = min(math.floor(100 * length_m + _HAIR) / 100, end_m)  # SUMO refuses an end beyond the lane's
    start_m = max(0.0, min(start_m, end_m - _LEAST_STOP_M))
    return (
        f'<stop lane={quoteattr(name)} startPos="{start_m:.2f}" endPos="{end_m:.2f}"'
        f' duration="0" speed="{_WAYPOINT_M_S:g}" jump="0" jumpUntil="{until_s:.3f}"/>'
    )
