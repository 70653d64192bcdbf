r"""Make the demand of a simulation: trips drawn at random, or routes that match traffic counts.

**Random trips.** Steps: for each kind of vehicle, find the pairs of edges that a trip may connect; draw, for each
departure, a kind by its share and one of its pairs by the weights of both ends (their lanes, unless the scenario sets
weights); write trips and vTypes as SUMO reads them. SUMO finds the routes.

A trip starts at the fringe, on an edge that cannot be entered from elsewhere in the network, and ends on an edge that
cannot be left; turnarounds do not count. A network without such edges (a loop, or streets that all turn back) gets
trips between any two edges at least a quarter of the network's diagonal apart, with a note. More trips are drawn than
fit, so that ``--max-num-vehicles`` maintains N vehicles, as SUMO's randomTrips.py does.

With ``traffic.vehicles_per_h``, trips depart at regular intervals, and duarouter finds all routes at once. A number of
vehicles that is maintained is a closed queue: the slowest junction of a town collects all of them.

**Traffic counts.** Steps, for the counts of the complete fleet and then for those of each kind: find plausible routes
over each counted location; SUMO's routeSampler (https://sumo.dlr.de/docs/Tools/Turns.html#routesamplerpy) selects
routes that meet the counts, with departures uniformly distributed over the simulation; each vehicle of the fleet gets a
kind, by share, among those that may drive its route. Counts of a kind are added to those of the fleet.

A route over a location is the fastest way from the fringe to the location and on to the fringe. It is plausible if it
takes at most :data:`MAX_DETOUR` times as long as the fastest way between its ends and passes no node twice. Without
plausible routes, the shortest detours without a loop are used; where every route has a loop, those with the shortest
detours. Travel times are seconds at the speed limit.

A loop is a node that a route passes twice. In a network that was cut around a junction, the ends of a turn are often
the two sides of a dual carriageway, so the fastest way between them turns back through the signals. Such vehicles
overload left-turn lanes, and one of them meets two counts.

After the run, :func:`count_fits` compares simulated flows m with counts c by the GEH statistic of traffic engineering
(sumolib.statistics.geh; below 5 is a good match, also in routeSampler's --geh-ok):

.. math:: \mathrm{GEH} = \sqrt{2 (m - c)^2 / (m + c)}

All randomness comes from the generator or seed passed in.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple
from xml.sax.saxutils import quoteattr

import numpy as np

from egvs.core import files
from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.formats import xml
from egvs.scenario.traffic_config import CountConfig, TrafficConfig, VehicleKind
from egvs.traffic import sumo
from egvs.traffic.network import Network
from egvs.traffic.vehicle_boxes import VehicleSize

STRAIGHT_STOP_ATTRIBUTES = {"maxSpeedLat": "1.0", "lcMaxSpeedLatStanding": "0", "lcMaxSpeedLatFactor": "0.2"}
"""Without these, cars of the sublane model stop at an angle of 35 to 47 degrees at the stop line (measured)."""

MAX_DETOUR = 1.25

CANDIDATE_ROUTES_FILE, COUNTS_FILE, SAMPLED_ROUTES_FILE = "candidates.rou.xml", "counts.xml", "sampled.rou.xml"
DRAWN_TRIPS_FILE, ROUTED_TRIPS_FILE = "drawn.rou.xml", "routed.rou.xml"
_ALTERNATIVES_FILE = "routed.rou.alt.xml"
"""duarouter writes it beside the routes."""

REROUTE_OPTIONS = {
    "device.rerouting.probability": "1",
    "device.rerouting.period": "0",
    "device.rerouting.pre-period": "30",
    "device.rerouting.adaptation-interval": "10",
    "device.rerouting.adaptation-steps": "18",
    "routing-algorithm": "astar",
}
"""SUMO's options for ``traffic.reroute_at_departure``: speeds are means of three minutes. Threads would make the routes
depend on chance.
"""

FLEET = "fleet"
"""Prefix of the ids of vehicles that were counted without their kind."""


_MAX_ORIGINS = 256
_FAR_SHARE = 0.25
_KIND_KEYS = {"id", "vClass", "length", "width", "height"}

_MAX_DRAWS = 60
_MAX_ROUTES = 24
_MIN_ROUTES = 4

_MAX_ROUTE_CHANGE = 50
"""How far routeSampler's optimisation may change the number of vehicles on a route."""


_MIN_SECONDS = 1e-3

_ONE_PLACE_M = 30.0
"""Roads that end within this distance of each other are one access of a network."""


@dataclass(frozen=True)
class OriginDestinations:
    """Trips that a kind may make.

    Attributes
    ----------
    origin, target
        Positions in ``Network.edges``, shape (n,), int64.
    weight
        Relative frequency of each trip, shape (n,), float64.
    fringe
        Whether trips start and end at the fringe of the network.
    """

    origin: IntArray
    target: IntArray
    weight: FloatArray
    fringe: bool


class Trip(NamedTuple):
    """Name of the kind, and ids of the first and the last edge.

    A trip starts at the begin of its first edge and ends at the end of the last one, unless positions along these edges
    are given, in metres.
    """

    kind: str
    origin: str
    target: str
    depart_m: float | None = None
    arrival_m: float | None = None

    @property
    def positions_xml(self) -> str:
        """The given positions as attributes, each after a space."""
        depart = "" if self.depart_m is None else f' departPos="{self.depart_m:.1f}"'
        return depart if self.arrival_m is None else f'{depart} arrivalPos="{self.arrival_m:.1f}"'


@dataclass(frozen=True)
class CountLocation:
    """Where vehicles are counted: an edge, or the edges from one to another; ids, and positions in the network."""

    edges: tuple[str, ...]
    indices: tuple[int, ...]

    def xml(self, vehicles: int) -> str:
        """Return the count as routeSampler reads it."""
        first, last = quoteattr(self.edges[0]), quoteattr(self.edges[-1])
        if len(self.edges) == 1:
            return f'    <edge id={first} entered="{vehicles}"/>'
        return f'    <edgeRelation from={first} to={last} count="{vehicles}"/>'


def check_kinds(kinds: Sequence[VehicleKind], where: str) -> None:
    """Raise an InputError for an unknown vClass, or attributes that contradict the keys of the kind.

    Parameters
    ----------
    kinds
        The fleet.
    where
        The traffic table, for messages.
    """
    for kind in kinds:
        if not sumo.is_vehicle_class(kind.vclass):
            problem = f"kind {kind.name!r} has the unknown vClass {kind.vclass!r}"
            raise InputError(f"{where}.kinds", problem, f"Use one of {', '.join(sorted(sumo.vehicle_classes()))}.")
        reserved = sorted(_KIND_KEYS & kind.attributes.keys())
        if reserved:
            problem = f"kind {kind.name!r} has {', '.join(reserved)} among its attributes"
            hint = "Set name, vclass, length_m, width_m and height_m of the kind instead."
            raise InputError(f"{where}.kinds", problem, hint)


def target_vehicle_count(traffic: TrafficConfig, network: Network) -> int:
    """Return how many vehicles random trips keep in the network.

    That is ``traffic.vehicles`` or, where it is not set, a number proportional to the length of lanes for the fleet.
    """
    if traffic.vehicles is not None:
        return traffic.vehicles
    vclasses = {kind.vclass for kind in traffic.kinds}
    lanes = (lane for edge in network.edges for lane in edge.lanes)
    length_m = math.fsum(lane.length_m for lane in lanes if any(map(lane.permission.admits, vclasses)))
    return max(1, round(traffic.vehicles_per_lane_km * length_m / 1000.0))


def origin_destination_pairs(
    network: Network, kind: VehicleKind, traffic: TrafficConfig, rng: np.random.Generator, where: str
) -> OriginDestinations:
    """Find the trips that a kind of vehicle may make.

    Parameters
    ----------
    network
        The streets.
    kind
        The kind of vehicle.
    traffic
        Sets ``min_trip_m`` and ``edge_weights``.
    rng
        Draws origins in a network without fringe.
    where
        The traffic table, for messages.

    Returns
    -------
    OriginDestinations
        All pairs of edges, with weights.

    Raises
    ------
    InputError
        When the kind may use no lane, or no trip is as long as ``min_trip_m``.
    """
    lanes = usable_lanes(network, kind, where)
    weights = edge_weights(network, lanes, traffic, where)
    links = network.links(kind.vclass)
    sources, sinks = fringe_edges(lanes, links)
    pairs = _reachable_pairs(network, links, sources, sinks, traffic.min_trip_m)
    at_fringe = bool(pairs.size)
    if not at_fringe:
        min_trip_m = max(traffic.min_trip_m, _FAR_SHARE * network.diagonal_m)
        usable = np.flatnonzero(lanes)
        sources = np.sort(rng.choice(usable, min(_MAX_ORIGINS, usable.size), replace=False))
        pairs = _reachable_pairs(network, links, sources, usable, min_trip_m)

    origin, target = pairs[:, 0], pairs[:, 1]
    weight = weights[origin] * weights[target]
    if not weight.any():
        raise no_trip_error(where, kind, traffic.min_trip_m)
    return OriginDestinations(origin, target, weight, at_fringe)


def usable_lanes(network: Network, kind: VehicleKind, where: str) -> FloatArray:
    """Return how many lanes of each edge a kind of vehicle may use, shape (n_edges,); InputError if there is none."""
    lanes = _lanes_per_edge(network, kind.vclass)
    if not lanes.any():
        problem = f"no lane of the network allows {_kind_title(kind)}"
        raise InputError(f"{where}.kinds", problem, "Use a vClass that the network allows.")
    return lanes


def no_trip_error(where: str, kind: VehicleKind, min_trip_m: float) -> InputError:
    """Return the error for a kind of vehicle without possible trips."""
    problem = f"{_kind_title(kind)} cannot make any trip of at least {min_trip_m:g} m"
    return InputError(f"{where}.kinds", problem, "Use a connected network, or a smaller min_trip_m.")


def _kind_title(kind: VehicleKind) -> str:
    return f"kind {kind.name!r} (vClass {kind.vclass})"


def _lanes_per_edge(network: Network, vclass: str) -> FloatArray:
    return np.array([edge.lanes_for(vclass) for edge in network.edges], dtype=np.float64)


def edge_weights(network: Network, lanes: FloatArray, traffic: TrafficConfig, where: str) -> FloatArray:
    """Return how likely trips start or end at each edge.

    Parameters
    ----------
    network
        The streets.
    lanes
        Usable lanes of each edge, which are the default weights, shape (n_edges,).
    traffic
        Sets ``edge_weights``.
    where
        The traffic table, for messages.

    Returns
    -------
    numpy.ndarray
        Shape (n_edges,), float64; 0 for edges without usable lane.

    Raises
    ------
    InputError
        When the network has no such edge.
    """
    index = {edge.id: i for i, edge in enumerate(network.edges)}
    weights = lanes.copy()
    for edge_id, weight in traffic.edge_weights.items():
        if edge_id not in index:
            raise unknown_edge_error(f"{where}.edge_weights", edge_id)
        if lanes[index[edge_id]]:
            weights[index[edge_id]] = weight
    return weights


def unknown_edge_error(where: str, edge_id: str) -> InputError:
    """Return the error for an edge that the network does not have; the checks list it once by its text."""
    return InputError(where, f"the network has no edge {edge_id!r}", "Use the id of an edge.")


def fringe_edges(lanes: FloatArray, links: IntArray) -> tuple[IntArray, IntArray]:
    """Return the edges that cannot be entered from elsewhere, and those that cannot be left.

    Parameters
    ----------
    lanes
        Usable lanes of each edge, shape (n_edges,).
    links
        Source, target and turnaround flag of each link, shape (n, 3), from :meth:`Network.links`.
    """
    onward = links[links[:, 2] == 0]
    usable = lanes > 0
    indices = np.arange(lanes.size)
    is_entered = np.isin(indices, onward[:, 1])
    is_left = np.isin(indices, onward[:, 0])
    return np.flatnonzero(usable & ~is_entered), np.flatnonzero(usable & ~is_left)


def _reachable_pairs(
    network: Network, links: IntArray, sources: IntArray, sinks: IntArray, min_trip_m: float
) -> IntArray:
    """Return pairs of a source and a reachable sink, (n, 2), that are far apart and not a way back."""
    if not len(sources) or not len(sinks):
        return np.empty((0, 2), dtype=np.int64)
    edges = network.edges
    origins = [edges[i] for i in sources]
    targets = [edges[i] for i in sinks]
    is_reached = _reached_edges(links, sources, len(edges))[:, sinks]
    goes_back = np.array([[target.to_node == origin.from_node for target in targets] for origin in origins])
    start_m = np.array([edge.start_m for edge in origins])
    end_m = np.array([edge.end_m for edge in targets])
    is_far = min_trip_m <= np.hypot(*(end_m - start_m[:, None]).T).T
    is_pair = is_reached & is_far & ~goes_back & (sources[:, None] != sinks)
    source, sink = np.nonzero(is_pair)
    return np.column_stack([sources[source], sinks[sink]]).astype(np.int64)


def _reached_edges(links: IntArray, sources: IntArray, n_edges: int) -> BoolArray:
    """Return which edges can be reached from each source, (n_sources, n_edges).

    Loading a graph library would take longer than this search, and SUMO waits for it.
    """
    next_edges: list[list[int]] = [[] for _ in range(n_edges)]
    for edge, next_edge in links[:, :2].tolist():
        next_edges[edge].append(next_edge)

    reached_from = [0] * n_edges  # bit k is set where the edge is reached from source k
    for k, source in enumerate(sources.tolist()):
        reached_from[source] |= 1 << k
    pending = deque(sources.tolist())
    while pending:
        edge = pending.popleft()
        for next_edge in next_edges[edge]:
            if reached_from[edge] & ~reached_from[next_edge]:
                reached_from[next_edge] |= reached_from[edge]
                pending.append(next_edge)

    n_bytes = (len(sources) + 7) // 8
    packed = b"".join(bits.to_bytes(n_bytes, "little") for bits in reached_from)
    bits = np.unpackbits(np.frombuffer(packed, np.uint8).reshape(n_edges, n_bytes), axis=1, bitorder="little")
    return bits[:, : len(sources)].T.astype(bool)


def draw_trips(
    network: Network,
    kinds: Sequence[VehicleKind],
    all_pairs: Sequence[OriginDestinations],
    departs_s: FloatArray,
    rng: np.random.Generator,
) -> list[Trip]:
    """Draw a trip for each departure.

    Parameters
    ----------
    network
        The streets.
    kinds, all_pairs
        The fleet, and the trips of each kind.
    departs_s
        Departure times, shape (n,).
    rng
        Draws kinds, then trips.
    """
    shares = np.array([kind.share for kind in kinds])
    kind_of_trip = rng.choice(len(kinds), size=departs_s.size, p=shares / shares.sum())
    pair_of_trip = np.empty(departs_s.size, dtype=np.int64)
    for index, pairs in enumerate(all_pairs):
        is_kind = kind_of_trip == index
        probability = pairs.weight / pairs.weight.sum()
        pair_of_trip[is_kind] = rng.choice(pairs.origin.size, size=int(is_kind.sum()), p=probability)

    trips = []
    for kind, pair in zip(kind_of_trip, pair_of_trip, strict=True):
        origin, target = all_pairs[kind].origin[pair], all_pairs[kind].target[pair]
        trips.append(Trip(kinds[kind].name, network.edges[origin].id, network.edges[target].id))
    return trips


def trips_xml(trips: Sequence[Trip], departs_s: FloatArray) -> str:
    """Return a SUMO route file with one ``<trip>`` per departure."""
    lines = [
        f'    <trip id="{index}" depart="{depart_s:.3f}" from={quoteattr(trip.origin)} to={quoteattr(trip.target)}'
        f' type={quoteattr(trip.kind)} departLane="best" departSpeed="max"{trip.positions_xml}/>'
        for index, (trip, depart_s) in enumerate(zip(trips, departs_s, strict=True))
    ]
    return _xml_document("routes", lines)


class RoutedTrip(NamedTuple):
    """A trip with its route.

    Attributes
    ----------
    number
        Its number among all that were routed.
    edges
        Ids of the edges of its route, with spaces between them.
    trip
        The trip.
    """

    number: int
    edges: str
    trip: Trip

    def xml(self, depart_s: float) -> str:
        """Return the vehicle as a line of a SUMO route file."""
        attributes = f'depart="{depart_s:.3f}" departLane="best" departSpeed="max"{self.trip.positions_xml}'
        return (
            f'    <vehicle id="{self.number}" type={quoteattr(self.trip.kind)} {attributes}>'
            f"<route edges={quoteattr(self.edges)}/></vehicle>"
        )


def route_trips(trips: Sequence[Trip], folder: Path, network: str, vtypes: str) -> list[RoutedTrip]:
    """Find the fastest routes on empty streets, all in one run of duarouter.

    Parameters
    ----------
    trips
        The trips.
    folder
        Contains the files; also used for temporary files.
    network, vtypes
        Names of the network, and of the file with the kinds of vehicles.

    Returns
    -------
    list of RoutedTrip
        In the order of ``trips``, without those that have no route.
    """
    files.write_text(folder / DRAWN_TRIPS_FILE, trips_xml(trips, np.arange(len(trips), dtype=np.float64)))
    options = [
        "-n", network, "-r", DRAWN_TRIPS_FILE, "-a", vtypes, "-o", ROUTED_TRIPS_FILE,
        "--routing-algorithm", "CHWrapper", "--ignore-errors", "--no-warnings", "--no-step-log",
    ]  # fmt: skip
    sumo.run_program("duarouter", options, folder)
    sumo.check_xml_complete(folder / ROUTED_TRIPS_FILE, "routes")
    routed = []
    for vehicle in xml.iter_elements(folder / ROUTED_TRIPS_FILE, "routes"):
        for route in vehicle.iter("route"):
            number = int(vehicle.get("id", "0"))
            routed.append(RoutedTrip(number, route.get("edges", ""), trips[number]))
    for name in (DRAWN_TRIPS_FILE, ROUTED_TRIPS_FILE, _ALTERNATIVES_FILE):
        (folder / name).unlink()
    return routed


def routes_xml(trips: Sequence[RoutedTrip], departs_s: FloatArray) -> str:
    """Return a SUMO route file.

    Parameters
    ----------
    trips
        The trips.
    departs_s
        Departure of each trip, by ``RoutedTrip.number``, in seconds; ascending.
    """
    return _xml_document("routes", [trip.xml(departs_s[trip.number]) for trip in trips])


def vtypes_xml(kinds: Sequence[VehicleKind]) -> str:
    """Return a SUMO additional file with one ``<vType>`` per kind, with its real size."""
    lines = []
    for kind in kinds:
        size = VehicleSize(kind.length_m, kind.width_m, kind.height_m, kind.vclass)
        lines.append(vtype_xml(kind.name, size, STRAIGHT_STOP_ATTRIBUTES | kind.attributes))
    return _xml_document("additional", lines)


def vtype_xml(name: str, size: VehicleSize, attributes: Mapping[str, Any]) -> str:
    """Return one ``<vType>`` as a line.

    Parameters
    ----------
    name
        Its id.
    size
        Its vClass, and lengths in metres.
    attributes
        Further attributes, under SUMO's names.
    """
    lengths = {"length": size.length_m, "width": size.width_m, "height": size.height_m}
    values = {"id": name, "vClass": size.vclass, **lengths, **attributes}
    return f"    <vType {' '.join(f'{key}={quoteattr(str(value))}' for key, value in values.items())}/>"


def _xml_document(root: str, lines: Sequence[str]) -> str:
    return "\n".join([f"<{root}>", *lines, f"</{root}>", ""])


class _Route(NamedTuple):
    """A route over a location; routes sort by how plausible they are."""

    has_loop: bool
    detour: float
    indices: tuple[int, ...]

    @property
    def is_plausible(self) -> bool:
        return not self.has_loop and self.detour <= MAX_DETOUR


class _FastestWays(NamedTuple):
    """Seconds (n_starts, n_edges), and the next edge towards each start, (n_starts, n_edges)."""

    seconds: FloatArray
    towards: IntArray


@dataclass(frozen=True)
class _WaysOver:
    """The fastest ways from the ends of trips to a location, and from it to the ends of trips; positions of edges."""

    location: CountLocation
    to_first: _FastestWays
    from_last: _FastestWays
    sources: list[int]
    sinks: list[int]

    def before(self, start: int) -> list[int]:
        """The way from a start to the first edge of the location, both included."""
        return _follow(self.to_first.towards[0], start, self.location.indices[0])

    def after(self, end: int) -> list[int]:
        """The way from the last edge of the location, which is not included, to an end."""
        return _follow(self.from_last.towards[0], end, self.location.indices[-1])[::-1][1:]


class RouteFinder:
    """Plausible routes of one vClass through a network.

    Parameters
    ----------
    network
        The streets.
    vclass
        SUMO's vClass.
    """

    def __init__(self, network: Network, vclass: str) -> None:
        self._edges, self._network, self._vclass = network.edges, network, vclass
        self._index = {edge.id: i for i, edge in enumerate(network.edges)}
        self._lanes = _lanes_per_edge(network, vclass)
        links = network.links(vclass)
        self._links = links[links[:, 2] == 0]
        self._sources, self._sinks = self._find_ends()

    def _find_ends(self) -> tuple[IntArray, IntArray]:
        """Return the edges where routes start and end; none where all are at one place, so that no route leads through.

        The carriageways of the only access road end at two nodes beside each other. Without ends, routes start and end
        where vehicles are counted.
        """
        sources, sinks = fringe_edges(self._lanes, self._links)
        ends_m = [self._edges[i].start_m[:2] for i in sources] + [self._edges[i].end_m[:2] for i in sinks]
        if not ends_m or np.ptp(np.array(ends_m), axis=0).max() < _ONE_PLACE_M:
            return sources[:0], sinks[:0]
        return sources, sinks

    @cached_property
    def _pairs(self) -> set[tuple[int, int]]:
        return {(int(a), int(b)) for a, b in self._links[:, :2]}

    @cached_property
    def _graph(self) -> Any:
        """Seconds from the end of an edge to the end of the next."""
        from scipy.sparse import csr_array

        pairs = np.array(sorted(self._pairs), dtype=np.int64).reshape(-1, 2)
        seconds = np.array([max(edge.seconds, _MIN_SECONDS) for edge in self._edges])
        size = self._lanes.size
        return csr_array((seconds[pairs[:, 1]], (pairs[:, 0], pairs[:, 1])), shape=(size, size))

    def may_drive(self, edges: Sequence[str]) -> bool:
        """Return whether the vClass may use all these edges, one after another."""
        indices = [self._index[edge] for edge in edges]
        return all(self._lanes[i] for i in indices) and self._pairs.issuperset(pairwise(indices))

    def locate(self, first: str, last: str | None, where: str) -> CountLocation:
        """Return the location of a count: an edge, or the fastest way from one edge to another.

        Parameters
        ----------
        first, last
            Ids of edges; ``last`` is None for a count on one edge.
        where
            The count, for messages.

        Raises
        ------
        InputError
            When an edge is unknown or closed to the vClass, or there is no way.
        """
        for edge_id in (first, last):
            if not edge_id:
                continue
            if edge_id not in self._index:
                raise unknown_edge_error(where, edge_id)
            if not self._lanes[self._index[edge_id]]:
                problem = f"{self._vclass} may not use the edge {edge_id!r}"
                raise InputError(where, problem, "Use an edge with a lane for it.")

        indices = [self._index[first]]
        if last is not None:
            end = self._index[last]
            ways = self._fastest(indices)
            indices = _follow(ways.towards[0], end, indices[0])[::-1]
        if not indices:
            problem = f"there is no route from {first!r} to {last!r}"
            raise InputError(where, problem, "Use an edge that can be reached from the first.")
        return CountLocation(tuple(self._edges[i].id for i in indices), tuple(indices))

    def _fastest(self, starts: Sequence[int], backward: bool = False) -> _FastestWays:
        """Return the fastest ways from the end of each start to the end of each edge, or backward."""
        from scipy.sparse.csgraph import dijkstra

        graph = self._graph.T.tocsr() if backward else self._graph
        seconds, predecessors = dijkstra(graph, indices=list(starts), return_predecessors=True)
        return _FastestWays(seconds, predecessors.astype(np.int64))

    def candidates(
        self, locations: Sequence[CountLocation], traffic: TrafficConfig, rng: np.random.Generator, where: str
    ) -> list[tuple[str, ...]]:
        """Return plausible routes over each location, without duplicates.

        Parameters
        ----------
        locations
            Where vehicles are counted.
        traffic
            Sets ``edge_weights``: routes start and end where random trips do.
        rng
            Draws starts and ends.
        where
            The traffic table, for messages.

        Returns
        -------
        list of tuple of str
            Ids of the edges of each route.
        """
        weights = edge_weights(self._network, self._lanes, traffic, where)
        routes: dict[tuple[int, ...], None] = {}
        for location in locations:
            routes.update(dict.fromkeys(self._routes_over(location, weights, rng)))
        return [tuple(self._edges[i].id for i in indices) for indices in routes]

    def _routes_over(
        self, location: CountLocation, weights: FloatArray, rng: np.random.Generator
    ) -> list[tuple[int, ...]]:
        ways = self._ways_over(location, weights)
        starts = _draw_ends(ways.sources, weights, rng)
        ends = _draw_ends(ways.sinks, weights, rng)
        ends_of_routes = list(dict.fromkeys(zip(starts.tolist(), ends.tolist(), strict=True)))

        routes = self._rate(ways, ends_of_routes)
        plausible = [route.indices for route in routes if route.is_plausible]
        if plausible:
            return plausible[:_MAX_ROUTES]

        # too few draws may miss the only ends between which there is no loop
        if all(route.has_loop for route in routes):
            routes = self._rate(ways, self._ends_without_loop(ways)) or routes
        return [route.indices for route in sorted(routes)[:_MIN_ROUTES] if route.has_loop == min(routes).has_loop]

    def has_route_without_loop(self, location: CountLocation) -> bool:
        """Return whether a route over a location exists, between any two ends, that passes no node twice."""
        weights = self._lanes
        return bool(self._ends_without_loop(self._ways_over(location, weights)))

    def _ways_over(self, location: CountLocation, weights: FloatArray) -> _WaysOver:
        first, last = location.indices[0], location.indices[-1]
        to_first = self._fastest([first], backward=True)
        from_last = self._fastest([last])
        sources = _likely_ends(self._sources, to_first.seconds[0], weights, first)
        sinks = _likely_ends(self._sinks, from_last.seconds[0], weights, last)
        return _WaysOver(location, to_first, from_last, sources, sinks)

    def _rate(self, ways: _WaysOver, ends_of_routes: Sequence[tuple[int, int]]) -> list[_Route]:
        """Return the fastest routes over a location between pairs of ends."""
        if not ends_of_routes:
            return []
        inner_s = sum(self._edges[i].seconds for i in ways.location.indices[1:])
        routes = []
        for (start, end), fastest_s in zip(ends_of_routes, self._direct_s(ends_of_routes), strict=True):
            indices = (*ways.before(start), *ways.location.indices[1:], *ways.after(end))
            seconds = ways.to_first.seconds[0][start] + inner_s + ways.from_last.seconds[0][end]
            detour = 1.0
            if seconds > fastest_s:
                detour = seconds / max(fastest_s, _MIN_SECONDS)
            routes.append(_Route(self._has_loop(indices), detour, indices))
        return routes

    def _has_loop(self, indices: Sequence[int]) -> bool:
        nodes = [self._edges[i].from_node for i in indices]
        nodes.append(self._edges[indices[-1]].to_node)
        return len(set(nodes)) < len(nodes)

    def _ends_without_loop(self, ways: _WaysOver) -> list[tuple[int, int]]:
        """Return all pairs of ends whose fastest way over a location passes no node twice."""
        inner = ways.location.indices
        if self._has_loop(inner):
            return []
        inner_nodes = {self._edges[i].to_node for i in inner}
        before: dict[int, set[str]] = {}
        for start in ways.sources:
            indices = ways.before(start)
            if not self._has_loop(indices):
                before[start] = {self._edges[i].from_node for i in indices}
        after: dict[int, set[str]] = {}
        for end in ways.sinks:
            indices = [inner[-1], *ways.after(end)]
            if not self._has_loop(indices):
                after[end] = {self._edges[i].to_node for i in indices[1:]}

        pairs = []
        for start, nodes_before in before.items():
            for end, nodes_after in after.items():
                parts = nodes_before, inner_nodes, nodes_after
                if len(set().union(*parts)) == sum(map(len, parts)):
                    pairs.append((start, end))
        return pairs

    def _direct_s(self, pairs: Sequence[tuple[int, int]]) -> list[float]:
        """Return the seconds of the fastest way between each pair of ends."""
        starts = sorted({start for start, _ in pairs})
        seconds = self._fastest(starts).seconds
        row = {start: i for i, start in enumerate(starts)}
        return [float(seconds[row[start], end]) for start, end in pairs]


def _likely_ends(ends: IntArray, seconds: FloatArray, weights: FloatArray, location: int) -> list[int]:
    """Return the fringe edges that are connected to a location and have a weight; without any, the location."""
    return [int(i) for i in ends if np.isfinite(seconds[i]) and weights[i] > 0] or [location]


def _draw_ends(ends: Sequence[int], weights: FloatArray, rng: np.random.Generator) -> IntArray:
    """Draw ends by their weights; the counted location is drawn even if its weight is 0."""
    share = weights[ends]
    if not share.any():
        share = np.ones(len(ends))
    return np.asarray(ends)[np.searchsorted(np.cumsum(share) / share.sum(), rng.random(_MAX_DRAWS))]


def _follow(towards: IntArray, start: int, end: int) -> list[int]:
    """Return the way from ``start`` to ``end``; empty if there is no way."""
    way = [start]
    while way[-1] != end:
        following = int(towards[way[-1]])
        if following < 0:
            return []
        way.append(following)
    return way


@dataclass(frozen=True)
class _SampledVehicle:
    """A vehicle of the counted traffic."""

    depart_s: float
    name: str
    kind: str
    edges: str

    def xml(self) -> str:
        values = {"id": self.name, "type": self.kind, "depart": f"{self.depart_s:.2f}", "departLane": "best"}
        attributes = " ".join(f"{key}={quoteattr(value)}" for key, value in values.items())
        return f'    <vehicle {attributes} departSpeed="max"><route edges={quoteattr(self.edges)}/></vehicle>'


def write_routes(
    traffic: TrafficConfig, network: Network, times_s: tuple[float, float], seed: np.random.SeedSequence, path: Path,
    where: str,
) -> None:  # fmt: skip
    """Write a route file with vehicles that meet the counts of a scenario.

    Parameters
    ----------
    traffic
        The fleet and the counts.
    network
        The streets.
    times_s
        Begin and end of the departures.
    seed
        Each group of counts gets a child of it.
    path
        The file to write; its folder is also used for temporary files.
    where
        The traffic table, for messages.

    Raises
    ------
    InputError
        When a count names an unknown edge or kind, or a way that nobody can drive.
    """
    finders = candidate_routes(traffic, network)
    locations = [count_location(count, traffic, finders, where) for count in traffic.counts]
    counted_kinds = {count.kind for count in traffic.counts}
    groups = [group for group in ("", *(kind.name for kind in traffic.kinds)) if group in counted_kinds]

    vehicles: list[_SampledVehicle] = []
    for group, child in zip(groups, seed.spawn(len(groups)), strict=True):
        kinds = _counted_kinds(traffic, group)
        counts = [
            (location, count.per_hour)
            for location, count in zip(locations, traffic.counts, strict=True)
            if count.kind == group
        ]
        rng = np.random.default_rng(child)
        sampler_seed = int(child.generate_state(1)[0]) & 0x7FFFFFFF
        finder = finders[_main_kind(kinds).vclass]
        candidates = finder.candidates([location for location, _ in counts], traffic, rng, where)
        routes = _sample_routes(counts, candidates, times_s, sampler_seed, path.parent)
        for index, (depart_s, edges) in enumerate(routes):
            able = [kind for kind in kinds if finders[kind.vclass].may_drive(edges)]  # the main kind always is
            shares = np.array([kind.share for kind in able])
            kind = able[int(np.searchsorted(np.cumsum(shares) / shares.sum(), rng.random(), side="right"))]
            name = f"{group or FLEET}.{index}"
            vehicles.append(_SampledVehicle(depart_s, name, kind.name, " ".join(edges)))

    vehicles.sort(key=lambda vehicle: (vehicle.depart_s, vehicle.name))
    files.write_text(path, _xml_document("routes", [vehicle.xml() for vehicle in vehicles]))


def candidate_routes(traffic: TrafficConfig, network: Network) -> dict[str, RouteFinder]:
    """Return a route finder for each vClass of the fleet."""
    return {kind.vclass: RouteFinder(network, kind.vclass) for kind in traffic.kinds}


def count_location(
    count: CountConfig, traffic: TrafficConfig, routes: Mapping[str, RouteFinder], where: str
) -> CountLocation:
    """Return where a count was taken.

    Parameters
    ----------
    count
        The count.
    traffic
        The fleet.
    routes
        Route finders by vClass.
    where
        The traffic table, for messages.

    Raises
    ------
    InputError
        When the count names an unknown edge or kind, or a way that nobody can drive.
    """
    where = count_key(count, where)
    kinds = _counted_kinds(traffic, count.kind)
    if not kinds:
        names = ", ".join(kind.name for kind in traffic.kinds)
        raise InputError(where, f"the fleet has no vehicle kind {count.kind!r}", f"Use one of {names}.")
    if count.kind == FLEET:
        problem = f"a kind is called {FLEET!r}, which is reserved for vehicles counted without a kind"
        raise InputError(where, problem, "Give this kind another name.")
    finder = routes[_main_kind(kinds).vclass]
    return finder.locate(count.edge or count.from_edge or "", count.to_edge, where)


def count_key(count: CountConfig, traffic: str) -> str:
    """Return what messages about a count of ``[traffic]`` refer to."""
    return f"{traffic}.counts ({count.title})"


def _counted_kinds(traffic: TrafficConfig, group: str) -> list[VehicleKind]:
    """Return the kinds that a count includes: the named one, or the fleet."""
    return [kind for kind in traffic.kinds if group in ("", kind.name)]


def _main_kind(kinds: Sequence[VehicleKind]) -> VehicleKind:
    """Return the kind whose routes all kinds follow where they may."""
    return max(kinds, key=lambda kind: kind.share)


def _sample_routes(
    counts: Sequence[tuple[CountLocation, float]], candidates: Sequence[tuple[str, ...]],
    times_s: tuple[float, float], seed: int, folder: Path,
) -> Iterator[tuple[float, list[str]]]:  # fmt: skip
    """Run routeSampler on counts (location, vehicles per hour); yield departure (s) and edges of each vehicle."""
    begin, end = (f"{time_s:.3f}" for time_s in times_s)
    duration_s = times_s[1] - times_s[0]
    routes = [f'    <route id="{index}" edges={quoteattr(" ".join(edges))}/>' for index, edges in enumerate(candidates)]
    files.write_text(folder / CANDIDATE_ROUTES_FILE, _xml_document("routes", routes))
    relations = [location.xml(round(per_hour * (duration_s / 3600.0))) for location, per_hour in counts]
    interval = [f'  <interval id="counts" begin="{begin}" end="{end}">', *relations, "  </interval>"]
    files.write_text(folder / COUNTS_FILE, _xml_document("data", interval))

    lengths = [len(location.edges) for location, _ in counts]
    arguments = ["--route-files", CANDIDATE_ROUTES_FILE]
    if max(lengths) > 1:
        arguments += ["--turn-files", COUNTS_FILE]
    if min(lengths) == 1:
        arguments += ["--edgedata-files", COUNTS_FILE]
    arguments += [
        "--turn-max-gap", str(max(0, max(lengths) - 2)), "--begin", begin, "--end", end,
        "--interval", f"{duration_s:.3f}", "--seed", str(seed), "--output-file", SAMPLED_ROUTES_FILE,
        "--optimize", str(_MAX_ROUTE_CHANGE),
    ]  # fmt: skip
    sumo.run_tool("routeSampler.py", arguments, folder)

    for vehicle in xml.iter_elements(folder / SAMPLED_ROUTES_FILE, "routes"):
        for route in vehicle.iter("route"):
            yield float(vehicle.get("depart", "0")), route.get("edges", "").split()
    for name in (CANDIDATE_ROUTES_FILE, COUNTS_FILE, SAMPLED_ROUTES_FILE):
        (folder / name).unlink()
