r"""Choose a junction of a street network, its region of interest, poles along its kerbs, and flows through it.

Steps: :func:`read_streets` turns a SUMO network into :class:`Streets`; :func:`largest_junctions`, or
:func:`choose_nearby` at a point; :func:`region_around` it; :func:`kerbside_poles` along the edge of the carriageway;
:func:`assumed_flows` through the region.

World frame: the network's own x (east), y (north) in metres. Longitude and latitude become x, y by the network's
``<location>``, as in netconvert:

    (x, y) = projection(lon, lat) + netOffset

Assumed flows: nobody has counted the vehicles at a junction taken from a map. Scores depend on the flow through the
region of interest, so this flow is fixed: the number of vehicles per hour from each street that enters the region to
each street that leaves it. It depends on these streets alone. (With a fixed number of vehicles in the whole network,
the flow through the junction would fall as the simulated area grows.)

The gates are the streets where vehicles enter or leave the region. Each lane of a gate carries
:data:`LANE_FLOW_PER_H` vehicles per hour, by road class. Doubly constrained growth factors (Furness,
https://archive.nptel.ac.in/content/storage2/courses/105101087/08-Ltexhtml/p6/p.html) balance the flows between gates:

.. math:: q_{ij} = a_i \, b_j \, w_{ij}, \qquad \sum_j q_{ij} = q_i, \qquad
          \sum_i q_{ij} \approx q_j \sum_i q_i / \sum_j q_j,

where w is 1 if a route over gates i and j exists, from the fringe of the network to its fringe, that passes no node
twice, and 0 otherwise. (Without this rule, a U-turn from one carriageway of a street to the other would be a turn like
any other.) At a roundabout, w is also 0 between the two carriageways of one street. The inflows are met exactly, the
outflows as well as possible.

A roundabout is one junction if it fits the largest region of interest, see :mod:`egvs.creation.roundabouts`. Its area
contains the central island, so that poles stand around it.
"""

from __future__ import annotations

import html
import itertools
import math
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import zip_longest
from pathlib import Path

import numpy as np
import shapely
from shapely.geometry import LineString, Point, Polygon, box
from shapely.geometry.base import BaseGeometry

from egvs.core.errors import InputError
from egvs.core.grid import XY, FloatArray
from egvs.creation import arms, roundabouts
from egvs.creation.roundabouts import Ring
from egvs.formats.georeference import WorldFrame
from egvs.scenario.traffic_config import CountConfig
from egvs.traffic import network as road_network
from egvs.traffic.demand import RouteFinder
from egvs.traffic.network import CAR, Edge, Network
from egvs.world.geolocation import network_world_frame

_QUAD_SEGS = 16
"""Segments of a quarter of a circle at the bends of a lane."""

MIN_ARMS = 3
"""A junction that a user can choose connects at least this number of streets."""

AT_POINT_M, SIGNALS_WITHIN_M, MAX_FROM_POINT_M = 2.0, 40.0, 100.0
"""Distances from a point: of a junction at the point, of a signalised one that is preferred, and of any."""

ROI_MIN_M, ROI_MAX_M, ROI_STEP_M, ROI_HEIGHT_M = 60.0, 120.0, 10.0, 5.0

APPROACH_M = 20.0
"""Minimum length of each approach inside the region of interest."""

SPACING_M = 10.0
MIN_SPACING_M, MAX_SPACING_M = 2.0, 100.0
"""Limits of a requested spacing of poles."""
KERB_M = 1.0
KERB_MIN_M = 0.5
CLEARANCE_M = 1.0
BEYOND_ROI_M = 5.0
HEIGHTS_M = (3.0, 4.5, 6.0)
MAX_POLES = 12

LANE_FLOW_PER_H = {
    "motorway": 600.0, "trunk": 400.0, "primary": 250.0, "secondary": 200.0, "tertiary": 150.0, "unclassified": 60.0,
    "residential": 40.0, "living_street": 20.0, "service": 10.0,
}  # fmt: skip
"""Vehicles per hour and lane by OpenStreetMap road class, in a busy hour; new scenarios use a share of it.

Round figures of the usual order of magnitude in traffic planning; they are assumptions without a source.
"""

_TOLERANCE_M = 0.01
_SEARCH_M = 50.0
_ISLAND_M2 = 100.0
_SLIDES_M = (0.0, 1.0, -1.0, 2.0, -2.0, 3.0, -3.0, 4.0, -4.0)

_OTHER_FLOW_PER_H = 40.0
_CLASS_BY_SPEED = (
    (19.0, "trunk"),
    (16.0, "primary"),
    (13.0, "secondary"),
    (10.0, "unclassified"),
    (0.0, "residential"),
)
"""Least speed limit in m/s of a road class, for maps without road classes: 70, 60, 50, 40 km/h, with some tolerance."""
_MIN_AREA_M2 = 10.0

_ITERATIONS = 3
"""Further rounds would empty whole turns where the outgoing lanes cannot take all that comes in."""


@dataclass(frozen=True)
class StreetJunction:
    """A junction of the network.

    Attributes
    ----------
    id
        SUMO's id; that of a roundabout contains the ids of its nodes, that of several nodes with one signal is its id.
    at_m
        x, y of the junction's node, or of the middle of a roundabout or of several nodes.
    area
        Outline, seen from above.
    lanes_in
        Number of incoming lanes for vehicles.
    arms
        Number of roads for cars that meet there (:mod:`egvs.creation.arms`).
    signalised
        Whether it has traffic lights.
    names
        Names of the streets that meet there, sorted.
    ring
        The roundabout; None for any other junction.
    members
        SUMO's ids of its nodes where one signal governs several; otherwise empty.
    """

    id: str
    at_m: XY
    area: BaseGeometry
    lanes_in: int
    arms: int
    signalised: bool
    names: tuple[str, ...]
    ring: Ring | None = None
    members: tuple[str, ...] = ()

    @property
    def nodes(self) -> tuple[str, ...]:
        """SUMO's ids of its nodes."""
        if self.ring is not None:
            return self.ring.nodes
        return self.members or (self.id,)

    @property
    def is_crossing(self) -> bool:
        """Whether at least three roads for cars meet there."""
        return self.arms >= MIN_ARMS

    def distance_m(self, point_m: XY) -> float:
        """Return the distance from a point to its area or its node, whichever is nearer."""
        return min(float(self.area.distance(Point(point_m))), math.dist(self.at_m, point_m))

    @property
    def title(self) -> str:
        """A description such as ``"signalised junction of A Street and B Road"``."""
        kind = "signalised junction" if self.signalised else "junction without signals"
        if self.ring is not None:
            kind = "signalised roundabout" if self.signalised else "roundabout"
        if not self.names:
            return kind
        if len(self.names) == 1:
            return f"{kind} in {self.names[0]}"
        return f"{kind} of {', '.join(self.names[:-1])} and {self.names[-1]}"


@dataclass(frozen=True)
class Streets:
    """A network, its junctions, and the carriageway.

    Attributes
    ----------
    network
        The SUMO network.
    areas
        The carriageway by edge id: the lanes of each edge at full width, including edges inside junctions.
    junctions
        Junctions with incoming lanes, without dead ends.
    large_rings
        Roundabouts that do not fit the largest region of interest; each of their nodes is a junction.
    """

    network: Network
    areas: dict[str, BaseGeometry]
    junctions: tuple[StreetJunction, ...]
    large_rings: tuple[Ring, ...] = ()

    @property
    def lane_length_m(self) -> float:
        """Total length of all lanes outside junctions, without pavements."""
        lanes = (lane for road in self.network.edges for lane in road.lanes)
        return math.fsum(lane.length_m for lane in lanes if not lane.is_pavement)

    def to_xy(self, lons_deg: Sequence[float], lats_deg: Sequence[float]) -> list[XY]:
        """World-frame x, y in metres of positions in degrees."""
        xy_m = self._known_frame.from_lon_lat(np.column_stack([lons_deg, lats_deg]))
        return [(x, y) for x, y in xy_m.tolist()]

    def to_degrees(self, points_m: Sequence[XY]) -> list[tuple[float, float]]:
        """Longitude and latitude in degrees of positions in the world frame."""
        degrees = self._known_frame.to_degrees(np.array(points_m))
        return [(lon, lat) for lon, lat in degrees.tolist()]

    def format_position(self, at_m: XY) -> str:
        """Return latitude and longitude of a position, or its x and y if the network does not state its frame."""
        if self.frame is None:
            return f"x = {at_m[0]:.1f} m, y = {at_m[1]:.1f} m"
        ((lon_deg, lat_deg),) = self.to_degrees([at_m])
        return f"{lat_deg:.5f},{lon_deg:.5f}"

    def node_positions(self, nodes: Mapping[int, tuple[float, float]]) -> dict[int, XY]:
        """World-frame x, y in metres of nodes of a map, given as latitude and longitude in degrees by identifier."""
        lats_deg, lons_deg = zip(*nodes.values(), strict=True) if nodes else ((), ())
        return dict(zip(nodes, self.to_xy(lons_deg, lats_deg), strict=True))

    def near(self, window: BaseGeometry) -> Streets:
        """Return the part that touches a window, in the same order and without connections.

        It contains everything that kerbs inside the window depend on.
        """
        area_ids = list(self.areas)
        nearby_areas = sorted(self._areas_tree.query(window, predicate="intersects"))
        areas = {area_ids[index]: self.areas[area_ids[index]] for index in nearby_areas}
        nearby_junctions = sorted(self._junctions_tree.query(window, predicate="intersects"))
        junctions = tuple(self.junctions[index] for index in nearby_junctions)

        edges = tuple(edge for edge in self.network.all_edges if edge.id in areas)
        nodes = tuple(node for node in self.network.junctions if window.intersects(Point(node.at_m)))
        network = replace(self.network, all_edges=edges, connections=(), junctions=nodes)
        return Streets(network, areas, junctions, self.large_rings)

    @cached_property
    def _areas_tree(self) -> shapely.STRtree:
        return shapely.STRtree(list(self.areas.values()))

    @cached_property
    def _junctions_tree(self) -> shapely.STRtree:
        return shapely.STRtree([junction.area for junction in self.junctions])

    @cached_property
    def frame(self) -> WorldFrame | None:
        """Where the world frame is on the Earth; None if the network does not state it."""
        return network_world_frame(self.network.location)

    @property
    def _known_frame(self) -> WorldFrame:
        assert self.frame is not None, "callers check that the frame is known"
        return self.frame


@dataclass(frozen=True)
class JunctionRegion:
    """The region of interest seen from above; it reaches from z = 0 to ``ROI_HEIGHT_M``."""

    center_m: XY
    size_m: XY

    @property
    def area(self) -> Polygon:
        """The rectangle."""
        x, y = self.center_m
        width, depth = self.size_m
        return box(x - width / 2, y - depth / 2, x + width / 2, y + depth / 2)


@dataclass(frozen=True)
class KerbsidePole:
    """A location for a pole: x, y in metres; of a pole that exists also its name, how far it was moved, its source."""

    x_m: float
    y_m: float
    name: str = ""
    moved_m: float = 0.0
    source: str = ""


def read_streets(path: Path) -> Streets:
    """Read a network.

    Parameters
    ----------
    path
        A ``.net.xml``.

    Returns
    -------
    Streets
        The network with its carriageway and junctions.

    Raises
    ------
    InputError
        When the network has no road.
    """
    network = road_network.read_net_xml(path)
    internal_edges = [edge for edge in network.all_edges if edge.function == "internal"]
    areas = _lane_areas([*network.edges, *internal_edges])

    lanes_for_vehicles = set()
    roads_at_node: dict[str, list[Edge]] = {}
    for road in network.edges:
        for index, lane in enumerate(road.lanes):
            if not lane.is_pavement:
                lanes_for_vehicles.add(f"{road.id}_{index}")
        for node_id in dict.fromkeys(_ends(road)):
            roads_at_node.setdefault(node_id, []).append(road)

    nodes = [node for node in network.junctions if node.incoming_lanes and node.type not in ("internal", "dead_end")]
    junctions = [_make_junction([node], roads_at_node.get(node.id, []), lanes_for_vehicles) for node in nodes]

    by_node = {junction.id: junction for junction in junctions}
    large_rings = []
    for ring in roundabouts.find_rings(network, areas):
        if ring.side_m > ROI_MAX_M:
            large_rings.append(ring)
            continue
        on_ring = [by_node[node] for node in ring.nodes if node in by_node]
        junctions = [junction for junction in junctions if junction.id not in ring.nodes]
        junctions.append(_make_roundabout(ring, on_ring, roads_at_node))
    for signal, governed in network.signal_groups.items():
        members = [node for node in nodes if node.id in governed]
        roads = {road.id: road for node in members for road in roads_at_node.get(node.id, [])}
        joined = _make_junction(members, list(roads.values()), lanes_for_vehicles, signal)
        west_m, south_m, east_m, north_m = joined.area.bounds
        others = {junction.id for junction in junctions} - {node for ring in large_rings for node in ring.nodes}
        if governed <= others and max(east_m - west_m, north_m - south_m) <= ROI_MAX_M:
            junctions = [junction for junction in junctions if junction.id not in governed] + [joined]
    return Streets(network, areas, tuple(junctions), tuple(large_rings))


def unusable_network(error: InputError, folder: Path, road_map: Path) -> InputError:
    """Return an error about a network that was made from a map as one about the map, and other errors as they are.

    ``folder`` has the network.
    """
    if not error.where.startswith(str(folder)):
        return error
    element = error.where.removeprefix(str(folder)).partition(": ")[2]
    problem = f"{element}: {error.problem}" if element else error.problem
    return InputError(road_map, f"the network cannot be used: {problem}", "Correct its roads.")


def _lane_areas(edges: Sequence[Edge]) -> dict[str, BaseGeometry]:
    """Return the area of the lanes of each edge at full width, without pavements."""
    lanes = [
        [lane for lane in edge.lanes if not lane.is_pavement and (lane.shape_m != lane.shape_m[:1]).any()]
        for edge in edges
    ]
    flat = [lane for of_edge in lanes for lane in of_edge]
    points_m = [lane.shape_m[:, :2] for lane in flat]
    half_widths_m = np.array([(lane.width_m or road_network.LANE_WIDTH_M) / 2 for lane in flat])
    lines = shapely.linestrings(
        np.concatenate([np.empty((0, 2)), *points_m]), indices=np.repeat(np.arange(len(flat)), [*map(len, points_m)])
    )
    strips = iter(shapely.buffer(lines, half_widths_m, quad_segs=_QUAD_SEGS, cap_style="flat"))
    return {
        edge.id: shapely.union_all([*itertools.islice(strips, len(of_edge))])
        for edge, of_edge in zip(edges, lanes, strict=True)
    }


def _make_junction(
    nodes: Sequence[road_network.Junction], roads: Sequence[Edge], lanes_for_vehicles: Set[str], signal: str = ""
) -> StreetJunction:
    """Make a junction from nodes of the network and the roads that meet there; several nodes have one signal."""
    ids = tuple(node.id for node in nodes)
    middle = np.mean([node.at_m for node in nodes], axis=0).tolist()
    at_m = (middle[0], middle[1])
    area = shapely.union_all([_node_area(node) for node in nodes])
    if signal:
        area = area.convex_hull

    inside = {road.id for road in roads if road.from_node in ids and road.to_node in ids and len(ids) > 1}
    entering = [lane for node in nodes for lane in node.incoming_lanes if lane.rpartition("_")[0] not in inside]
    car_roads = [road for road in roads if road.lanes_for(CAR) and road.id not in inside]
    names = {html.unescape(road.name) for road in car_roads or roads if road.name}  # netconvert escapes names twice
    return StreetJunction(
        signal or ids[0],
        at_m,
        area,
        lanes_in=sum(lane in lanes_for_vehicles for lane in entering),
        arms=len(arms.group_arms(ids, at_m, car_roads)),
        signalised=any(node.type.startswith("traffic_light") for node in nodes),
        names=tuple(sorted(names)),
        members=ids if signal else (),
    )


def _node_area(node: road_network.Junction) -> BaseGeometry:
    corners_m = node.shape_m[:, :2]
    if len(corners_m) >= 3:
        return shapely.make_valid(Polygon(corners_m))
    return Point(node.at_m).buffer(1.0)


def _make_roundabout(
    ring: Ring, on_ring: Sequence[StreetJunction], roads_at_node: Mapping[str, Sequence[Edge]]
) -> StreetJunction:
    """Make one junction of the junctions on a ring."""
    roads = {road.id: road for node in ring.nodes for road in roads_at_node.get(node, [])}
    ring_lanes = sum(not lane.is_pavement for edge_id in ring.edges for lane in roads[edge_id].lanes)
    car_roads = [road for road in roads.values() if road.lanes_for(CAR)]
    ring_arms = roundabouts.ring_arms(ring, car_roads or list(roads.values()))
    names = {html.unescape(edge.name) for arm in ring_arms for edge in arm if edge.name}
    return StreetJunction(
        f"roundabout_{'_'.join(ring.nodes)}",
        ring.middle_m,
        ring.area,
        lanes_in=sum(junction.lanes_in for junction in on_ring) - ring_lanes,
        arms=len(ring_arms),
        signalised=any(junction.signalised for junction in on_ring),
        names=tuple(sorted(names)),
        ring=ring,
    )


def _ends(road: Edge) -> tuple[str, str]:
    return road.from_node, road.to_node


def largest_junctions(streets: Streets) -> list[StreetJunction]:
    """Return the junctions of at least three roads for cars, without any such junction all others; the largest first.

    Those with signals come first. Signals on a single road, such as those of a pedestrian crossing, do not count, since
    they govern no conflicting movements of cars. Then the number of incoming lanes decides, then the area.
    """
    candidates = [j for j in streets.junctions if j.is_crossing] or streets.junctions
    return sorted(candidates, key=lambda j: (not j.signalised, -j.lanes_in, -j.area.area, j.id))


def distinct_crossings(streets: Streets) -> list[StreetJunction]:
    """Return the junctions of at least three roads for cars, the largest first.

    Where carriageways of the same streets meet at several nodes, only the largest of these counts.
    """
    distinct: list[StreetJunction] = []
    for junction in largest_junctions(streets):
        if junction.is_crossing and not any(_have_same_streets(junction, other) for other in distinct):
            distinct.append(junction)
    return distinct


def _have_same_streets(junction: StreetJunction, other: StreetJunction) -> bool:
    is_near = math.dist(junction.at_m, other.at_m) <= SIGNALS_WITHIN_M
    return is_near and len(junction.names) > 1 and junction.title == other.title


@dataclass(frozen=True)
class NearbyJunction:
    """A junction, and the distance of its area or its node from a point, whichever is nearer."""

    junction: StreetJunction
    distance_m: float


def nearest_junctions(streets: Streets, point_m: XY) -> list[NearbyJunction]:
    """Return the junctions of at least three streets, the nearest first.

    Parameters
    ----------
    streets
        The streets.
    point_m
        World-frame x, y.
    """
    nearby = [NearbyJunction(j, j.distance_m(point_m)) for j in streets.junctions if j.is_crossing]
    return sorted(nearby, key=lambda near: (near.distance_m, not near.junction.signalised, near.junction.id))


def choose_nearby(nearby: Sequence[NearbyJunction]) -> NearbyJunction | None:
    """Choose the junction that a point stands for.

    It is the junction at the point (within :data:`AT_POINT_M`). Without one, it is the nearest signalised junction
    within :data:`SIGNALS_WITHIN_M`, otherwise the nearest junction of any kind.

    Parameters
    ----------
    nearby
        From :func:`nearest_junctions`.

    Returns
    -------
    NearbyJunction or None
        None where no junction is within :data:`MAX_FROM_POINT_M`.
    """
    if not nearby or nearby[0].distance_m > MAX_FROM_POINT_M:
        return None
    if nearby[0].distance_m <= AT_POINT_M:
        return nearby[0]
    for near in nearby:
        if near.junction.signalised and near.distance_m <= SIGNALS_WITHIN_M:
            return near
    return nearby[0]


def find_again(streets: Streets, junction: StreetJunction, at_m: XY) -> StreetJunction | None:
    """Return the same junction in streets that were built anew.

    Parameters
    ----------
    streets
        The new streets.
    junction
        The junction in the former streets.
    at_m
        Its position in the frame of the new ones. The nearest junction is returned if its identifier has changed.
    """
    same = [j for j in streets.junctions if j.id == junction.id]
    candidates = same or streets.junctions
    return min(candidates, key=lambda j: (math.dist(at_m, j.at_m), j.id), default=None)


def region_around(junction: StreetJunction) -> JunctionRegion:
    """Return a box around the junction and a piece of each approach, with corners at whole metres."""
    x0, y0, x1, y1 = junction.area.bounds
    center_m = float(round((x0 + x1) / 2)), float(round((y0 + y1) / 2))
    return JunctionRegion(center_m, (_region_side_m(x1 - x0), _region_side_m(y1 - y0)))


def _region_side_m(junction_side_m: float) -> float:
    steps = math.ceil((junction_side_m + 2 * APPROACH_M) / ROI_STEP_M)
    return min(max(steps * ROI_STEP_M, ROI_MIN_M), ROI_MAX_M)


def kerbside_poles(
    streets: Streets, junction: StreetJunction, roi: JunctionRegion, objects: Sequence[BaseGeometry],
    spacing_m: float | None = None,
) -> list[KerbsidePole]:  # fmt: skip
    """Find locations for poles along the kerbs of a junction and its approaches.

    Poles are ``KERB_M`` outside the carriageway (rounded to 0.1 m, never nearer than ``KERB_MIN_M``) and at least
    ``CLEARANCE_M`` from every object. Along the kerb they are about the spacing apart, never less than half of it.
    Traffic islands below 100 m2 count as carriageway.

    Parameters
    ----------
    streets, junction
        The carriageway and the junction.
    roi
        The region of interest; poles are inside it or up to ``BEYOND_ROI_M`` outside.
    objects
        Areas of static objects, world frame, metres.
    spacing_m
        Distance between neighbouring poles; None for ``SPACING_M``, and at most ``MAX_POLES`` poles.

    Returns
    -------
    list of KerbsidePole
        Counter-clockwise around the junction: all locations, or ``MAX_POLES``. The arms of the junction then take
        turns: each adds, of the poles that are nearest to its street, the one nearest to the middle of the junction.
    """
    window = box(*roi.area.buffer(BEYOND_ROI_M, join_style="mitre").bounds)
    carriageway = carriageway_near(streets, window)
    junction_area = shapely.union_all([junction.area, *_approaches(streets, junction, window)]).buffer(1.5 * KERB_M)
    kerb = shapely.intersection(kerb_line(carriageway), window.intersection(junction_area))

    surroundings = window.buffer(_SEARCH_M)
    obstacles = [o.buffer(CLEARANCE_M + _TOLERANCE_M) for o in objects if o.intersects(surroundings)]
    forbidden = shapely.union_all([carriageway.buffer(KERB_MIN_M + _TOLERANCE_M), *obstacles])
    shapely.prepare(forbidden)

    free: list[XY] = []
    for line in _lines(kerb):
        free += _free_points_along(line, spacing_m or SPACING_M, forbidden, window)

    center = junction.area.centroid
    poles = _separate_poles(free, (center.x, center.y), spacing_m or SPACING_M)
    if spacing_m is None:
        poles = _take_turns(poles, _arm_areas(streets, junction))[:MAX_POLES]
    poles.sort(key=lambda p: (math.degrees(math.atan2(center.y - p[1], center.x - p[0])), *p))
    return [KerbsidePole(x, y) for x, y in poles]


def carriageway_near(streets: Streets, window: BaseGeometry) -> BaseGeometry:
    """Return the roads and junctions in and around a window."""
    surroundings = window.buffer(_SEARCH_M)
    pieces = [*streets.areas.values(), *(j.area for j in streets.junctions)]
    return shapely.union_all([piece for piece in pieces if piece.intersects(surroundings)])


def kerb_line(carriageway: BaseGeometry) -> BaseGeometry:
    """Return the lines ``KERB_M`` outside a carriageway, on which poles stand; small islands are carriageway."""
    return _without_islands(carriageway).buffer(KERB_M).boundary


def _approaches(streets: Streets, junction: StreetJunction, window: BaseGeometry) -> list[BaseGeometry]:
    """Return the streets that can be reached from the junction, in either direction, without leaving the window."""
    roads = streets.network.edges
    inside = {node.id for node in streets.network.junctions if window.covers(Point(node.at_m))}

    reached = set(junction.nodes)
    while True:
        passable = reached & inside
        neighbours: set[str] = set()
        for road in roads:
            if not passable.isdisjoint(_ends(road)):
                neighbours.update(_ends(road))
        if neighbours <= reached:
            break
        reached |= neighbours

    start_nodes = reached & inside | set(junction.nodes)
    return [streets.areas[road.id] for road in roads if not start_nodes.isdisjoint(_ends(road))]


def _arm_areas(streets: Streets, junction: StreetJunction) -> list[BaseGeometry]:
    """Return the carriageway of each arm of a junction, as far as the next node."""
    nodes = set(junction.nodes)
    roads = [road for road in streets.network.edges if len(nodes.intersection(_ends(road))) == 1]
    if junction.ring is not None:
        grouped = roundabouts.ring_arms(junction.ring, roads)
    else:
        grouped = arms.group_arms(junction.nodes, junction.at_m, roads)
    areas = [shapely.union_all([streets.areas[road.id] for road in arm]) for arm in grouped]
    return [area for area in areas if not area.is_empty]


def _take_turns(poles: Sequence[XY], arm_areas: Sequence[BaseGeometry]) -> list[XY]:
    """Sort poles: one of each arm, then a second one of each, and so on; the order within an arm stays."""
    if not arm_areas:
        return list(poles)
    queues: list[list[XY]] = [[] for _ in arm_areas]
    for pole in poles:
        point = Point(pole)
        distances_m = [area.distance(point) for area in arm_areas]
        queues[distances_m.index(min(distances_m))].append(pole)
    turns = zip_longest(*queues)
    return [pole for turn in turns for pole in turn if pole is not None]


def _without_islands(area: BaseGeometry) -> BaseGeometry:
    """Fill the small holes of an area."""
    filled = []
    for polygon in shapely.get_parts(area):
        if isinstance(polygon, Polygon):
            large_holes = [hole for hole in polygon.interiors if Polygon(hole).area >= _ISLAND_M2]
            filled.append(Polygon(polygon.exterior, large_holes))
    return shapely.union_all(filled)


def _lines(kerb: BaseGeometry) -> list[LineString]:
    if kerb.geom_type == "MultiLineString":
        kerb = shapely.line_merge(kerb)
    return [line for line in shapely.get_parts(shapely.normalize(kerb)) if isinstance(line, LineString)]


def _free_points_along(line: LineString, spacing_m: float, forbidden: BaseGeometry, window: BaseGeometry) -> list[XY]:
    """Return evenly spaced free points on a line; a point that is not free moves a little along it."""
    count = round(line.length / spacing_m)
    points = []
    for index in range(count):
        middle_m = (index + 0.5) * line.length / count
        for slide_m in _SLIDES_M:
            on_line = line.interpolate(min(max(middle_m + slide_m, 0.0), line.length))
            point = Point(round(on_line.x, 1), round(on_line.y, 1))
            if window.covers(point) and not forbidden.intersects(point):
                points.append((point.x, point.y))
                break
    return points


def _separate_poles(points: Sequence[XY], center: XY, spacing_m: float) -> list[XY]:
    """Return the points that keep their distance from each other, those nearest to the center first."""
    poles: list[XY] = []
    for point in sorted(points, key=lambda p: (math.dist(p, center), p)):
        if all(math.dist(point, pole) >= spacing_m / 2 for pole in poles):
            poles.append(point)
    return poles


def assumed_flows(streets: Streets, roi: JunctionRegion, ring: Ring | None = None) -> list[CountConfig]:
    """Assume the traffic through a region from the classes of its streets.

    Parameters
    ----------
    streets
        The streets in and around the region.
    roi
        The region of interest.
    ring
        The roundabout in it: no vehicle turns back to the street from which it comes.

    Returns
    -------
    list of CountConfig
        Vehicles per hour from each gate to each other gate; empty where no street leads through the region.
    """
    entries, exits, connected = _find_gates(streets, roi, ring)
    inflow_per_h = [edge_flow_h(edge) for edge in entries]
    outflow_per_h = [edge_flow_h(edge) for edge in exits]
    flows_per_h = balance_flows(connected, inflow_per_h, outflow_per_h)

    counts = []
    for row, entry in enumerate(entries):
        for column, exit_edge in enumerate(exits):
            per_hour = float(round(flows_per_h[row, column]))
            if per_hour == 0:
                continue
            if entry is exit_edge:
                counts.append(CountConfig(edge=entry.id, per_hour=per_hour))
            else:
                counts.append(CountConfig(from_edge=entry.id, to_edge=exit_edge.id, per_hour=per_hour))
    return counts


def edge_flow_h(edge: Edge) -> float:
    """Return the assumed vehicles per hour on all lanes of a street, by its road class, or else by its speed limit.

    netconvert writes a street with tram tracks as ``"highway.secondary|railway.tram"``. Types of other maps, such as
    ``"driving"`` in OpenDRIVE, tell no class.
    """
    flows_per_h = []
    if "." not in edge.type:
        flows_per_h.append(LANE_FLOW_PER_H[_class_by_speed(edge)])
    for part in edge.type.split("|"):
        if part.startswith("highway."):
            road_class = part.removeprefix("highway.").removesuffix("_link")
            flows_per_h.append(LANE_FLOW_PER_H.get(road_class, _OTHER_FLOW_PER_H))
    return max(flows_per_h, default=_OTHER_FLOW_PER_H) * edge.lanes_for(CAR)


def _class_by_speed(edge: Edge) -> str:
    """Return the class of roads that usually have the speed limit of a street."""
    speed_m_s = max(lane.speed_m_s for lane in edge.lanes)
    return next(road_class for limit_m_s, road_class in _CLASS_BY_SPEED if speed_m_s >= limit_m_s)


def balance_flows(connected: FloatArray, inflow_per_h: Sequence[float], outflow_per_h: Sequence[float]) -> FloatArray:
    """Distribute the inflows over the exits by doubly constrained growth factors.

    Parameters
    ----------
    connected
        Shape (n_entries, n_exits), float64; 0 where no vehicle can go.
    inflow_per_h, outflow_per_h
        Vehicles per hour at each entry and each exit.

    Returns
    -------
    numpy.ndarray
        Vehicles per hour, shape (n_entries, n_exits). Rows add up to the inflows; columns, where possible, to shares
        proportional to the outflows.
    """
    flows = connected.copy()
    inflow = np.array(inflow_per_h, dtype=np.float64)
    outflow = np.array(outflow_per_h, dtype=np.float64)
    for _ in range(_ITERATIONS):
        flows = flows * _growth_factors(outflow, flows.sum(axis=0))[None, :]
        flows = flows * _growth_factors(inflow, flows.sum(axis=1))[:, None]
    return flows


def _growth_factors(target: FloatArray, current: FloatArray) -> FloatArray:
    """Return target / current, and 0 where nothing flows."""
    return np.divide(target, current, out=np.zeros_like(target), where=current > 0)


def _find_gates(streets: Streets, roi: JunctionRegion, ring: Ring | None) -> tuple[list[Edge], list[Edge], FloatArray]:
    """Return the edges by which vehicles enter and leave a region, and which of them a route without loop connects.

    The last is 1 or 0, shape (n_entries, n_exits).
    """
    edges = streets.network.edges
    links = [(source, target) for source, target, turnaround in streets.network.links(CAR).tolist() if not turnaround]
    successors: dict[int, list[int]] = {index: [] for index in _with_merging(_roads_inside(streets, roi), links)}
    entered = set()
    for source, target in links:
        if source in successors and target in successors:
            successors[source].append(target)
            entered.add(target)

    two_way = {_ends(edge) for edge in edges}
    one_way = {edge.id for edge in edges if (edge.to_node, edge.from_node) not in two_way}
    entries = [index for index in successors if index not in entered]
    exits = [index for index, following in successors.items() if not following]
    routes = RouteFinder(streets.network, CAR)
    connected = np.zeros((len(entries), len(exits)))
    for row, entry in enumerate(entries):
        reachable = _reachable(entry, successors)
        for column, exit_index in enumerate(exits):
            if exit_index not in reachable or edges[exit_index].to_node == edges[entry].from_node:
                continue
            are_carriageways = edges[entry].id in one_way and edges[exit_index].id in one_way
            if (
                ring is not None
                and are_carriageways
                and arms.is_same_street(ring.middle_m, edges[entry], edges[exit_index])
            ):
                continue
            to_edge = None if exit_index == entry else edges[exit_index].id
            location = routes.locate(edges[entry].id, to_edge, "assumed flows")
            connected[row, column] = routes.has_route_without_loop(location)
    return [edges[i] for i in entries], [edges[i] for i in exits], connected


def _roads_inside(streets: Streets, roi: JunctionRegion) -> list[int]:
    """Return the positions of the roads for cars that cover part of the region, or start and end in it."""
    region = roi.area
    indices = []
    for index, edge in enumerate(streets.network.edges):
        if not edge.lanes_for(CAR):
            continue
        is_within = region.covers(Point(edge.start_m)) and region.covers(Point(edge.end_m))
        if is_within or streets.areas[edge.id].intersection(region).area >= _MIN_AREA_M2:
            indices.append(index)
    return indices


def _with_merging(roads: Sequence[int], links: Sequence[tuple[int, int]]) -> list[int]:
    """Add the roads from outside that merge with roads of the region before they enter it, or diverge after it.

    Otherwise the road after the merge would be no gate, because it is entered from the region too.
    """
    inside = set(roads)
    inner_links = [(source, target) for source, target in links if source in inside and target in inside]
    merged = {target for _, target in inner_links}
    diverging = {source for source, _ in inner_links}
    inside |= {source for source, target in links if target in merged}
    inside |= {target for source, target in links if source in diverging}
    return sorted(inside)


def _reachable(start: int, successors: dict[int, list[int]]) -> set[int]:
    reached = {start}
    queue = [start]
    while queue:
        for index in successors[queue.pop()]:
            if index not in reached:
                reached.add(index)
                queue.append(index)
    return reached
