"""Draw random trips through a whole town, for ``traffic.vehicles_per_h``.

Each end of a trip is drawn independently: with :data:`FRINGE_SHARE` at the fringe of the network, where roads enter and
leave it and at the end of dead-end streets, in proportion to the lanes there; otherwise halfway along any street of at
least :data:`MIN_STREET_M`, in proportion to its length and lanes. So every street has some traffic, also those that no
fastest route across the town uses. ``edge_weights`` replace the number of lanes.

A trip is drawn again if it is shorter than ``min_trip_m`` as the crow flies, or only goes back. Trips start at edges
from which the largest strongly connected part of the network can be reached, and end at edges that can be reached from
there, so each has a route. The same generator gives the same trips.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from egvs.core.errors import InputError
from egvs.core.grid import BoolArray, FloatArray, IntArray
from egvs.scenario.traffic_config import TrafficConfig, VehicleKind
from egvs.traffic import demand
from egvs.traffic.demand import Trip
from egvs.traffic.network import Network

FRINGE_SHARE = 0.5
"""Share of trip ends at the fringe; an assumption, as towns differ in their through traffic."""

MIN_STREET_M = 50.0
"""Shorter edges are mostly parts of junctions."""

_MAX_REDRAWS = 200


class TripEnds(NamedTuple):
    """Where trips of a kind start and end: probability of each edge of the network, (n_edges,) float64.

    The first two are for ends at the fringe, the others for ends halfway along a street. Each sums to 1, or is all 0
    where there is no such edge.
    """

    fringe_origin: FloatArray
    fringe_target: FloatArray
    street_origin: FloatArray
    street_target: FloatArray


def trip_ends(network: Network, kind: VehicleKind, traffic: TrafficConfig, where: str) -> TripEnds:
    """Return where the trips of a kind of vehicle may start and end.

    Parameters
    ----------
    network
        The streets.
    kind
        The kind of vehicle.
    traffic
        Sets ``edge_weights``.
    where
        The traffic table, for messages.

    Raises
    ------
    InputError
        When the kind may use no lane, or no connected part of the network.
    """
    lanes = demand.usable_lanes(network, kind, where)
    weights = demand.edge_weights(network, lanes, traffic, where)
    links = network.links(kind.vclass)
    sources, sinks = demand.fringe_edges(lanes, links)
    reaches_core, reached_from_core = _connected_edges(links, lanes > 0)

    lengths_m = np.array([edge.lanes[0].length_m for edge in network.edges])
    street_weights = np.where(lengths_m >= MIN_STREET_M, weights * lengths_m, 0.0)
    if not street_weights.any():
        street_weights = weights * lengths_m
    ends = TripEnds(
        _normalised(_only(sources, weights) * reaches_core),
        _normalised(_only(sinks, weights) * reached_from_core),
        _normalised(street_weights * reaches_core),
        _normalised(street_weights * reached_from_core),
    )
    if not ends.street_origin.any() or not ends.street_target.any():
        raise _no_trip_error(where, kind, traffic)
    return ends


def _only(edges: IntArray, weights: FloatArray) -> FloatArray:
    selected = np.zeros_like(weights)
    selected[edges] = weights[edges]
    return selected


def _normalised(weights: FloatArray) -> FloatArray:
    total = weights.sum()
    return weights / total if total > 0 else weights


def _connected_edges(links: IntArray, usable: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Return which edges reach the largest strongly connected part of a network, and which are reached from it."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order, connected_components

    n = usable.size
    graph = csr_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(n, n))
    _, component = connected_components(graph, connection="strong")
    core = np.bincount(component[usable]).argmax()
    member = int(np.flatnonzero(usable & (component == core))[0])
    reached = np.zeros(n, dtype=bool)
    reached[breadth_first_order(graph, member, return_predecessors=False)] = True
    reaches = np.zeros(n, dtype=bool)
    reaches[breadth_first_order(csr_array(graph.T), member, return_predecessors=False)] = True
    return reaches & usable, reached & usable


def draw_town_trips(
    network: Network,
    traffic: TrafficConfig,
    all_ends: Sequence[TripEnds],
    count: int,
    rng: np.random.Generator,
    where: str,
) -> list[Trip]:
    """Draw trips.

    Parameters
    ----------
    network
        The streets.
    traffic
        Sets ``kinds`` and ``min_trip_m``.
    all_ends
        From :func:`trip_ends`, for each kind.
    count
        Number of trips.
    rng
        Draws kinds, then trips.
    where
        The traffic table, for messages.

    Raises
    ------
    InputError
        When the trips of a kind are nearly all too short.
    """
    shares = np.array([kind.share for kind in traffic.kinds])
    kind_of_trip = rng.choice(len(traffic.kinds), size=count, p=shares / shares.sum())
    edges = network.edges
    node_index: dict[str, int] = {}
    from_node = np.array([node_index.setdefault(edge.from_node, len(node_index)) for edge in edges])
    to_node = np.array([node_index.setdefault(edge.to_node, len(node_index)) for edge in edges])
    start_m = np.array([edge.start_m for edge in edges])
    end_m = np.array([edge.end_m for edge in edges])

    drawn = _DrawnEnds.empty(count)
    for index, kind in enumerate(traffic.kinds):
        open_trips = np.flatnonzero(kind_of_trip == index)
        for _ in range(_MAX_REDRAWS):
            if not open_trips.size:
                break
            drawn.draw(open_trips, all_ends[index], rng)
            origin = drawn.origin[open_trips]
            target = drawn.target[open_trips]
            goes_back = (origin == target) | (to_node[target] == from_node[origin])
            distance_m = np.hypot(*(end_m[target] - start_m[origin]).T)
            open_trips = open_trips[goes_back | (distance_m < traffic.min_trip_m)]
        if open_trips.size:
            raise _no_trip_error(where, kind, traffic)

    trips = []
    for trip, kind_index in enumerate(kind_of_trip):
        first = edges[drawn.origin[trip]]
        last = edges[drawn.target[trip]]
        depart_m = None if drawn.starts_at_fringe[trip] else first.lanes[0].length_m / 2
        arrival_m = None if drawn.ends_at_fringe[trip] else last.lanes[0].length_m / 2
        trips.append(Trip(traffic.kinds[kind_index].name, first.id, last.id, depart_m, arrival_m))
    return trips


class _DrawnEnds(NamedTuple):
    """First and last edge of each trip, and whether they are at the fringe, shape (n,) each."""

    origin: IntArray
    target: IntArray
    starts_at_fringe: BoolArray
    ends_at_fringe: BoolArray

    @classmethod
    def empty(cls, count: int) -> _DrawnEnds:
        """Return space for trips."""
        edges = np.zeros(count, dtype=np.int64)
        flags = np.zeros(count, dtype=bool)
        return cls(edges, edges.copy(), flags, flags.copy())

    def draw(self, trips: IntArray, ends: TripEnds, rng: np.random.Generator) -> None:
        """Draw some of the trips."""
        for edges, at_fringe, fringe, street in (
            (self.origin, self.starts_at_fringe, ends.fringe_origin, ends.street_origin),
            (self.target, self.ends_at_fringe, ends.fringe_target, ends.street_target),
        ):
            share = FRINGE_SHARE if fringe.any() else 0.0
            at_fringe[trips] = rng.random(trips.size) < share
            for is_fringe, probability in ((True, fringe), (False, street)):
                chosen = trips[at_fringe[trips] == is_fringe]
                if chosen.size:
                    edges[chosen] = rng.choice(probability.size, size=chosen.size, p=probability)


def _no_trip_error(where: str, kind: VehicleKind, traffic: TrafficConfig) -> InputError:
    return demand.no_trip_error(where, kind, traffic.min_trip_m)
