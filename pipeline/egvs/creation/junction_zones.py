"""Zones of a junction with names that a planner uses: crosswalks, stop lines, approaches, conflict area, sidewalks.

They come from the network, and are cut at the region of interest:

- *conflict area*: all lanes for vehicles inside the junction; of a roundabout, the ring as well;
- *crosswalks*, named after the approach that they cross;
- *stop lines*: the last :data:`STOP_LINE_M` metres of the lanes of each approach;
- *approaches*: its last :data:`APPROACH_M` metres, followed back across nodes with a single road;
- *sidewalks* and the corners between them, joined by their side of the junction.

Crosswalks and sidewalks need a network that has them (``egvs new --walk``). World frame, metres.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from shapely.geometry.base import BaseGeometry

from egvs.creation.junctions import JunctionRegion, StreetJunction, Streets
from egvs.creation.plain_network import NETWORK_FILE
from egvs.traffic.approach_names import ApproachNames
from egvs.traffic.directions import compass
from egvs.traffic.network import Edge, Lane, Network

STOP_LINE_M = 10.0
"""Length of the zone before a stop line."""

APPROACH_M = 50.0
"""Length of the zone of an approach."""

_MIN_AREA_M2 = 1.0
"""What the region of interest leaves of a zone is dropped below this area."""

_STEP_M = 0.01
"""Coordinates are rounded to this."""


@dataclass(frozen=True)
class Zone:
    """An area with a name and a kind ("crosswalk")."""

    name: str
    kind: str
    area: BaseGeometry


def junction_zones(streets: Streets, junction: StreetJunction, roi: JunctionRegion) -> tuple[Zone, ...]:
    """Return the zones of a junction in its region of interest; their names are distinct.

    Parameters
    ----------
    streets
        The network and its areas.
    junction
        The junction.
    roi
        Its region of interest.
    """
    network = streets.network
    names = ApproachNames(network)
    zones = [
        Zone("conflict area", "conflict area", _conflict_area(streets, junction)),
        *_crosswalks(network, junction, names),
        *_approach_zones(network, junction, names),
        *_sidewalks(network, junction, roi.area),
    ]
    clipped = []
    for zone in zones:
        area = _only_areas(shapely.set_precision(shapely.intersection(zone.area, roi.area), _STEP_M))
        if area.area >= _MIN_AREA_M2:
            clipped.append(Zone(zone.name, zone.kind, area))
    return tuple(_with_distinct_names(clipped))


def zones_geojson(zones: Sequence[Zone]) -> str:
    """Return GeoJSON in world-frame metres, one feature per line."""
    head = {
        "type": "FeatureCollection",
        "frame": f"metres, x and y of {NETWORK_FILE}; not longitude and latitude",
        "crs": None,
    }
    opening = json.dumps(head, indent=1, ensure_ascii=False).removesuffix("\n}")
    lines = ",\n".join(json.dumps(_feature(zone), ensure_ascii=False) for zone in zones)
    return f'{opening},\n "features": [\n{lines}\n]}}\n'


def _feature(zone: Zone) -> dict[str, Any]:
    geometry = json.loads(shapely.to_geojson(shapely.normalize(zone.area)))
    rounded = _rounded(geometry["coordinates"])
    properties = {"name": zone.name, "kind": zone.kind}
    return {"type": "Feature", "properties": properties, "geometry": {"type": geometry["type"], "coordinates": rounded}}


def _rounded(coordinates: Any) -> Any:
    if isinstance(coordinates, list):
        return [_rounded(value) for value in coordinates]
    return round(coordinates, 2)


def _conflict_area(streets: Streets, junction: StreetJunction) -> BaseGeometry:
    parts = []
    for edge in streets.network.all_edges:
        ends = [_node_of(edge)] if edge.function == "internal" else [edge.from_node, edge.to_node]
        if set(junction.nodes).issuperset(ends) and edge.id in streets.areas:
            parts.append(streets.areas[edge.id])
    return shapely.union_all(parts)


def _node_of(edge: Edge) -> str:
    """The node of an edge inside a junction, whose id is a colon, the node's id, and a number."""
    return edge.id.removeprefix(":").rpartition("_")[0]


def _crosswalks(network: Network, junction: StreetJunction, names: ApproachNames) -> Iterator[Zone]:
    for edge in network.all_edges:
        if edge.function == "crossing" and _node_of(edge) in junction.nodes:
            for lane in edge.lanes:
                if len(lane.shape_m) > 1:
                    yield Zone(names.crosswalk(edge.id), "crosswalk", lane.area())


def _approach_zones(network: Network, junction: StreetJunction, names: ApproachNames) -> Iterator[Zone]:
    """Stop lines, then approaches."""
    approaches = []
    for number, edge in enumerate(network.edges):
        enters = edge.to_node in junction.nodes and edge.from_node not in junction.nodes
        if enters and _lanes_for_vehicles(edge):
            approaches.append((number, edge))
    for kind, length_m in (("stop line", STOP_LINE_M), ("approach", APPROACH_M)):
        for number, edge in approaches:
            yield Zone(
                f"{names.approach(edge.id)} {kind}",
                kind,
                shapely.union_all(list(_last_metres(network, number, length_m))),
            )


def _lanes_for_vehicles(edge: Edge) -> list[Lane]:
    return [lane for lane in edge.lanes if not lane.is_pavement and len(lane.shape_m) > 1]


def _last_metres(network: Network, number: int, length_m: float) -> Iterator[BaseGeometry]:
    """Yield the areas of the last metres before the end of a road, followed back while a single road leads to it."""
    inside = {f"{edge.id}_{i}": lane for edge in network.all_edges for i, lane in enumerate(edge.lanes)}
    visited: set[int] = set()
    while length_m > 0.0 and number not in visited:
        visited.add(number)
        lanes = _lanes_for_vehicles(network.edges[number])
        yield from (lane.area(length_m) for lane in lanes)
        length_m -= max(shapely.LineString(lane.shape_m[:, :2]).length for lane in lanes)
        entering = [link for link in network.connections if link.target == number and link.direction not in ("t", "T")]
        sources = {link.source for link in entering}
        if len(sources) != 1 or not _lanes_for_vehicles(network.edges[min(sources)]):
            return
        (number,) = sources
        vias = [inside[link.via] for link in entering if link.via in inside and len(inside[link.via].shape_m) > 1]
        if vias and length_m > 0.0:
            yield from (lane.area(length_m) for lane in vias)
            length_m -= max(shapely.LineString(lane.shape_m[:, :2]).length for lane in vias)


def _sidewalks(network: Network, junction: StreetJunction, region: BaseGeometry) -> Iterator[Zone]:
    """Yield the sidewalks in the region, joined by their side of the junction, in the order of the sides' names."""
    by_side: dict[str, list[BaseGeometry]] = {}
    for area in _walking_areas(network):
        part = shapely.intersection(area, region)
        if part.area > 0.0:
            side = compass(shapely.get_coordinates(part.centroid)[0] - np.asarray(junction.at_m))
            by_side.setdefault(side, []).append(part)
    for side, parts in sorted(by_side.items()):
        yield Zone(f"{side} sidewalk", "sidewalk", shapely.union_all(parts))


def _walking_areas(network: Network) -> Iterator[BaseGeometry]:
    for edge in network.all_edges:
        for lane in edge.lanes:
            if edge.function == "walkingarea" and len(lane.shape_m) > 2:
                yield shapely.make_valid(shapely.Polygon(lane.shape_m[:, :2]))
            elif not edge.function and lane.is_pavement and len(lane.shape_m) > 1:
                yield lane.area()


def _only_areas(shape: BaseGeometry) -> BaseGeometry:
    """A shape without its points and lines."""
    return shapely.union_all([part for part in shapely.get_parts(shape) if part.geom_type == "Polygon"])


def _with_distinct_names(zones: Iterable[Zone]) -> Iterator[Zone]:
    """Number zones of equal names: "north sidewalk", "north sidewalk 2"."""
    counts: Counter[str] = Counter()
    for zone in zones:
        counts[zone.name] += 1
        name = zone.name if counts[zone.name] == 1 else f"{zone.name} {counts[zone.name]}"
        yield Zone(name, zone.kind, zone.area)
