"""Draws trips for a scenario that names a network but no routes.

Steps: for each kind of vehicle, find the pairs of edges that a trip may join; draw, for each departure, a kind by its
share and one of its pairs by the weights of both ends (their lanes, unless the scenario says otherwise); write trips
and vTypes as SUMO reads them. SUMO finds the way itself.

A trip starts where nobody can come from elsewhere in the network (the fringe) and ends where nobody can go on; a
turnaround is no way on. A network without such ends (a loop, a cut-out whose streets all turn back) gets trips between
any two edges at least a quarter of the network's diagonal apart; the stage's result says so.

Trips are more than the network takes, so that ``--max-num-vehicles`` holds N: the idea is that of SUMO's
randomTrips.py. All randomness comes from the generator that is passed in.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np

from pipeline.core.errors import InputError
from pipeline.scenario.traffic import TrafficModel, VehicleKind
from pipeline.traffic.boxes import Floats, Ints, Size
from pipeline.traffic.network import Network

UPRIGHT = {"maxSpeedLat": "1.0", "lcMaxSpeedLatStanding": "0", "lcMaxSpeedLatFactor": "0.2"}
"""Without these, cars of the sublane model stand 35 to 47 degrees askew at the stop line (measured)."""

_MAX_ORIGINS = 256
_FAR_SHARE = 0.25


@dataclass(frozen=True)
class Pairs:
    """Trips that a kind may make: from ``origin`` to ``target`` (positions in ``Network.edges``), with weights."""

    origin: Ints
    target: Ints
    weight: Floats
    fringe: bool


def pairs(network: Network, kind: VehicleKind, traffic: TrafficModel, rng: np.random.Generator, place: str) -> Pairs:
    """The trips that ``kind`` may make.

    InputError when there is none: the kind may drive nowhere, or no trip is as long as ``min_trip_m``.
    """
    who = f"kind {kind.name!r} (vClass {kind.vclass})"
    lanes = np.array([edge.lanes_for(kind.vclass) for edge in network.edges], dtype=np.float64)
    if not lanes.any():
        raise InputError(f"{place}.kinds", f"{who} may use no lane of the network", "a kind that the network admits")
    min_trip_m, likely = traffic.min_trip_m, weights(network, lanes, traffic, place)
    links = network.links(kind.vclass)
    sources, sinks = fringe(lanes, links)
    if not (trips := _reachable(network, likely, links, sources, sinks, min_trip_m)).origin.size:
        far = max(min_trip_m, _FAR_SHARE * network.diagonal_m)
        anywhere = np.flatnonzero(lanes)
        some = np.sort(rng.choice(anywhere, min(_MAX_ORIGINS, anywhere.size), replace=False))
        trips = _reachable(network, likely, links, some, anywhere, far, fringe=False)
    if not trips.weight.any():
        what = f"{who} can go from no edge to another that is {min_trip_m:g} m away"
        raise InputError(f"{place}.kinds", what, "a connected network, or a smaller min_trip_m")
    return trips


def weights(network: Network, lanes: Floats, traffic: TrafficModel, place: str) -> Floats:
    """How likely a trip starts or ends at each edge: as the scenario says, else by its lanes for this kind."""
    index = {edge.id: i for i, edge in enumerate(network.edges)}
    likely = lanes.copy()
    for edge, weight in traffic.edge_weights.items():
        if edge not in index:
            raise InputError(f"{place}.edge_weights", f"the network has no edge {edge!r}", "the id of an edge")
        likely[index[edge]] = weight if lanes[index[edge]] else 0.0
    return likely


def fringe(lanes: Floats, links: Ints) -> tuple[Ints, Ints]:
    """Edges where nobody can come from elsewhere, and those where nobody can go on, by a class' lanes and links."""
    onward = links[links[:, 2] == 0]
    usable = lanes > 0
    entered, left = (np.isin(np.arange(lanes.size), onward[:, column]) for column in (1, 0))
    return np.flatnonzero(usable & ~entered), np.flatnonzero(usable & ~left)


def _reachable(
    network: Network, weights: Floats, links: Ints, sources: Ints, sinks: Ints, min_trip_m: float, fringe: bool = True
) -> Pairs:
    """The pairs of a source and a sink that can be reached from it, is no way back, and is far enough."""
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import breadth_first_order

    edges, n = network.edges, weights.size
    graph = csr_array((np.ones(len(links)), (links[:, 0], links[:, 1])), shape=(n, n))
    start, end = (np.array([getattr(e, key) for e in edges]) for key in ("start_m", "end_m"))
    is_sink = np.zeros(n, dtype=bool)
    is_sink[sinks] = True
    origins, targets = [np.empty(0, np.int64)], [np.empty(0, np.int64)]
    for source in sources:
        reached = np.sort(breadth_first_order(graph, source, return_predecessors=False)).astype(np.int64)
        back = np.array([edges[t].to_node == edges[source].from_node for t in reached])
        far = np.hypot(*(end[reached] - start[source]).T) >= min_trip_m
        good = reached[is_sink[reached] & (reached != source) & ~back & far]
        origins.append(np.full(good.size, source))
        targets.append(good)
    origin, target = np.concatenate(origins), np.concatenate(targets)
    return Pairs(origin, target, weights[origin] * weights[target], fringe)


def vehicles_to_hold(traffic: TrafficModel, network: Network) -> int:
    """How many vehicles drawn trips keep in the network: ``vehicles``, or by the length of lanes for the fleet."""
    if traffic.vehicles is not None:
        return traffic.vehicles
    vclasses = {kind.vclass for kind in traffic.kinds}
    lanes = (lane for edge in network.edges for lane in edge.lanes)
    length_m = math.fsum(lane.length_m for lane in lanes if any(map(lane.permission.admits, vclasses)))
    return max(1, round(traffic.vehicles_per_lane_km * length_m / 1000.0))


def draw(
    network: Network, kinds: Sequence[VehicleKind], all_pairs: Sequence[Pairs], departs_s: Floats,
    rng: np.random.Generator,
) -> list[tuple[str, str, str]]:  # fmt: skip
    """For each departure: the name of the kind, the edge where the trip starts, the edge where it ends."""
    shares = np.array([kind.share for kind in kinds])
    chosen = rng.choice(len(kinds), size=departs_s.size, p=shares / shares.sum())
    pick = np.empty(departs_s.size, dtype=np.int64)
    for index, trips in enumerate(all_pairs):
        of_kind = chosen == index
        pick[of_kind] = rng.choice(trips.origin.size, size=int(of_kind.sum()), p=trips.weight / trips.weight.sum())
    return [
        (kinds[k].name, network.edges[all_pairs[k].origin[i]].id, network.edges[all_pairs[k].target[i]].id)
        for k, i in zip(chosen, pick, strict=True)
    ]


def trips_xml(trips: Sequence[tuple[str, str, str]], departs_s: Floats) -> str:
    """A SUMO route file with one ``<trip>`` a departure."""
    lines = [
        f'    <trip id="{index}" depart="{depart:.3f}" from={quoteattr(origin)} to={quoteattr(target)}'
        f' type={quoteattr(kind)} departLane="best" departSpeed="max"/>'
        for index, ((kind, origin, target), depart) in enumerate(zip(trips, departs_s, strict=True))
    ]
    return "\n".join(["<routes>", *lines, "</routes>", ""])


def vtypes_xml(kinds: Sequence[VehicleKind]) -> str:
    """A SUMO additional file with one ``<vType>`` a kind, with its real size."""
    lines = [
        vtype_xml(kind.name, Size(kind.length_m, kind.width_m, kind.height_m, kind.vclass), UPRIGHT | kind.attributes)
        for kind in kinds
    ]
    return "\n".join(["<additional>", *lines, "</additional>", ""])


def vtype_xml(name: str, size: Size, attributes: Mapping[str, Any]) -> str:
    """One ``<vType>``, on a line of its own."""
    box = {"length": size.length_m, "width": size.width_m, "height": size.height_m}
    values = {"id": name, "vClass": size.vclass, **box, **attributes}
    return f"    <vType {' '.join(f'{key}={quoteattr(str(value))}' for key, value in values.items())}/>"


def check_kinds(kinds: Sequence[VehicleKind], vehicle_classes: frozenset[str], place: str) -> None:
    """Refuse an unknown vClass, and attributes that would contradict the kind's own keys."""
    for kind in kinds:
        if kind.vclass not in vehicle_classes:
            what, right = f"kind {kind.name!r} has the vClass {kind.vclass!r}", ", ".join(sorted(vehicle_classes))
            raise InputError(f"{place}.kinds", what, f"one of {right}")
        own = sorted({"id", "vClass", "length", "width", "height"} & kind.attributes.keys())
        if own:
            what = f"kind {kind.name!r} has {', '.join(own)} among its attributes"
            raise InputError(f"{place}.kinds", what, "name, vclass, length_m, width_m and height_m of the kind")
