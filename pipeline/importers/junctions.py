"""A junction is chosen here, the region of interest laid round it, and places for poles are found along its kerbs.

Steps: a SUMO network's lanes and junctions -> :class:`Streets`; :func:`choose_junction`; :func:`region_round` it;
:func:`kerb_places` along the carriageway's rim.

World frame: the network's own x, y in metres. Longitude and latitude become x, y by the network's ``<location>``, as
netconvert did:

    (x, y) = projection(lon, lat) + netOffset
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
import shapely
from shapely.geometry import LineString, Point, Polygon, box
from shapely.geometry.base import BaseGeometry

from pipeline.formats.crs import WorldFrame
from pipeline.importers.shapes import XY
from pipeline.traffic.network import LANE_WIDTH_M, Edge, Network
from pipeline.traffic.network import Junction as Node
from pipeline.traffic.network import read as read_network
from pipeline.world.world_frame import located

T = TypeVar("T")

ROI_LEAST_M, ROI_MOST_M, ROI_STEP_M, ROI_HEIGHT_M = 60.0, 120.0, 10.0, 5.0
APPROACH_M = 20.0
"""How much of each approach belongs to the region of interest, at least."""

SPACING_M = 10.0
KERB_M = 1.0
KERB_LEAST_M = 0.5
CLEARANCE_M = 1.0
BEYOND_ROI_M = 5.0
HEIGHTS_M = (3.0, 4.5, 6.0)
MOST_PLACES = 12

_HAIR_M = 0.01
_ISLAND_M2 = 100.0
_SLIDES_M = (0.0, 1.0, -1.0, 2.0, -2.0, 3.0, -3.0, 4.0, -4.0)


@dataclass(frozen=True)
class Junction:
    """A junction of the network."""

    id: str
    at_m: XY
    area: BaseGeometry
    lanes_in: int
    arms: int
    signalised: bool
    names: tuple[str, ...]

    @property
    def title(self) -> str:
        """What a person would call it."""
        what = "signalised junction" if self.signalised else "junction without signals"
        if len(self.names) < 2:
            return " in ".join([what, *self.names])
        return f"{what} of {', '.join(self.names[:-1])} and {self.names[-1]}"


@dataclass(frozen=True)
class Streets:
    """A network, its junctions, and where vehicles drive.

    ``areas`` is the carriageway in pieces: the lanes of each edge, also of those inside junctions, at their full width.
    """

    network: Network
    areas: dict[str, BaseGeometry]
    junctions: tuple[Junction, ...]

    @property
    def lane_length_m(self) -> float:
        """All lanes outside junctions, one after another; pavements are none."""
        lanes = (lane for road in self.network.edges for lane in road.lanes if not lane.is_pavement)
        return math.fsum(lane.length_m for lane in lanes)

    def to_xy(self, lons_deg: Sequence[float], lats_deg: Sequence[float]) -> list[XY]:
        """World-frame x, y in metres of positions in degrees."""
        xy_m = self._frame.from_degrees(np.column_stack([lons_deg, lats_deg]))
        return [(x, y) for x, y in xy_m.tolist()]

    def to_degrees(self, points_m: Sequence[XY]) -> list[tuple[float, float]]:
        """Longitude and latitude in degrees of positions in the world frame."""
        return [(lon, lat) for lon, lat in self._frame.to_degrees(np.array(points_m)).tolist()]

    def near(self, window: BaseGeometry) -> Streets:
        """What of them touches a window, in the same order: all that kerbs inside it need, without connections."""
        names, nodes = list(self.areas), {j.id for j in self._those(self._junction_tree, self.junctions, window)}
        areas = {name: self.areas[name] for name in self._those(self._area_tree, names, window)}
        edges = tuple(edge for edge in self.network.all_edges if edge.id in areas)
        junctions = tuple(node for node in self.network.junctions if window.intersects(Point(node.at_m)))
        network = replace(self.network, all_edges=edges, connections=(), junctions=junctions)
        return Streets(network, areas, tuple(j for j in self.junctions if j.id in nodes))

    @staticmethod
    def _those(tree: shapely.STRtree, things: Sequence[T], window: BaseGeometry) -> list[T]:
        return [things[i] for i in sorted(tree.query(window, predicate="intersects"))]

    @cached_property
    def _area_tree(self) -> shapely.STRtree:
        return shapely.STRtree(list(self.areas.values()))

    @cached_property
    def _junction_tree(self) -> shapely.STRtree:
        return shapely.STRtree([junction.area for junction in self.junctions])

    @property
    def _frame(self) -> WorldFrame:
        frame = located(self.network.location)
        assert frame is not None, "netconvert writes it"
        return frame


@dataclass(frozen=True)
class Region:
    """The region of interest from above; it starts at z = 0 and is ``ROI_HEIGHT_M`` high."""

    center_m: XY
    size_m: XY

    @property
    def area(self) -> Polygon:
        """Its rectangle."""
        (x, y), (w, d) = self.center_m, self.size_m
        return box(x - w / 2, y - d / 2, x + w / 2, y + d / 2)


@dataclass(frozen=True)
class KerbPlace:
    """A place for a pole: x, y in metres."""

    x_m: float
    y_m: float


def read(path: Path) -> Streets:
    """Read a network that netconvert wrote from OpenStreetMap; InputError when it has no road."""
    network = read_network(path)
    inside = [edge for edge in network.all_edges if edge.function == "internal"]
    areas = {edge.id: _area(edge) for edge in (*network.edges, *inside)}
    nodes = [n for n in network.junctions if n.type not in ("internal", "dead_end") and n.incoming_lanes]
    driven = {f"{e.id}_{i}" for e in network.edges for i, lane in enumerate(e.lanes) if not lane.is_pavement}
    meeting: dict[str, list[Edge]] = {}
    for road in network.edges:
        for end in dict.fromkeys(_ends(road)):
            meeting.setdefault(end, []).append(road)
    return Streets(network, areas, tuple(_junction(node, meeting.get(node.id, []), driven) for node in nodes))


def _area(edge: Edge) -> BaseGeometry:
    """An edge's lanes at their full width; pavements are none."""
    return shapely.union_all([
        LineString(lane.shape_m[:, :2]).buffer((lane.width_m or LANE_WIDTH_M) / 2, cap_style="flat")
        for lane in edge.lanes
        if not lane.is_pavement and len(np.unique(lane.shape_m, axis=0)) > 1
    ])  # fmt: skip


def _junction(node: Node, meeting: Sequence[Edge], driven: Set[str]) -> Junction:
    """A node of the network, with the roads that meet there; ``driven`` are all lanes that are no pavements."""
    corners_m = node.shape_m[:, :2]
    area = shapely.make_valid(Polygon(corners_m)) if len(corners_m) >= 3 else Point(node.at_m).buffer(1.0)
    arms = {end for road in meeting for end in _ends(road)} - {node.id}
    names = sorted({html.unescape(road.name) for road in meeting if road.name})  # netconvert escapes names twice
    signalised = node.type.startswith("traffic_light")
    lanes_in = sum(lane in driven for lane in node.incoming_lanes)
    return Junction(node.id, node.at_m, area, lanes_in, len(arms), signalised, tuple(names))


def _ends(road: Edge) -> tuple[str, str]:
    return road.from_node, road.to_node


def choose_junction(streets: Streets, at_m: XY | None) -> Junction | None:
    """The signalised junction nearest to ``at_m``, or the largest; one without signals only where there is no other.

    A junction is where at least three streets meet, so that the signals of a mere crossing for pedestrians do not
    count, unless nothing else is there.
    """
    met = [j for j in streets.junctions if j.arms >= 3]
    signalised = [j for j in streets.junctions if j.signalised]
    among = [j for j in met if j.signalised] or signalised or met or streets.junctions
    if not among:
        return None
    if at_m is None:
        return min(among, key=lambda j: (-j.lanes_in, -j.area.area, j.id))
    return min(among, key=lambda j: (Point(at_m).distance(j.area), math.dist(at_m, j.at_m), j.id))


def region_round(junction: Junction) -> Region:
    """A box round the junction with a piece of each approach; all its corners are whole metres."""
    x0, y0, x1, y1 = junction.area.bounds
    steps = (math.ceil((side + 2 * APPROACH_M) / ROI_STEP_M) for side in (x1 - x0, y1 - y0))
    width, depth = (min(max(n * ROI_STEP_M, ROI_LEAST_M), ROI_MOST_M) for n in steps)
    return Region((float(round((x0 + x1) / 2)), float(round((y0 + y1) / 2))), (width, depth))


def kerb_places(streets: Streets, junction: Junction, roi: Region, objects: Sequence[BaseGeometry]) -> list[KerbPlace]:
    """Places for poles along the kerbs of the junction and its approaches, in and around the region of interest.

    They stand ``KERB_M`` outside the carriageway (rounded to 0.1 m, never nearer than ``KERB_LEAST_M``),
    ``CLEARANCE_M`` from every object, about ``SPACING_M`` apart along the kerb and never nearer to each other than half
    of it. Islands smaller than 100 m2 count as carriageway. Of more than ``MOST_PLACES`` places, the nearest to the
    junction are taken.
    """
    window = box(*roi.area.buffer(BEYOND_ROI_M, join_style="mitre").bounds)
    near = window.buffer(50.0)
    everything = [*streets.areas.values(), *(j.area for j in streets.junctions)]
    road = shapely.union_all([area for area in everything if area.intersects(near)])
    own = shapely.union_all([junction.area, *_approaches(streets, junction, window)]).buffer(1.5 * KERB_M)
    rim = shapely.intersection(_without_islands(road).buffer(KERB_M).boundary, window.intersection(own))
    blocked = [o.buffer(CLEARANCE_M + _HAIR_M) for o in objects if o.intersects(near)]
    forbidden = shapely.union_all([road.buffer(KERB_LEAST_M + _HAIR_M), *blocked])
    shapely.prepare(forbidden)
    places = [place for line in _lines(rim) for place in _along(line, forbidden, window)]
    center = junction.area.centroid
    taken = _nearest(places, (center.x, center.y))
    yaws = [(math.degrees(math.atan2(center.y - y, center.x - x)), x, y) for x, y in taken]
    return [KerbPlace(x, y) for _, x, y in sorted(yaws)]


def _nearest(places: Sequence[XY], center: XY) -> list[XY]:
    """The places nearest to the center that are not too near to each other."""
    taken: list[XY] = []
    for place in sorted(places, key=lambda p: (math.dist(p, center), p)):
        if all(math.dist(place, other) >= SPACING_M / 2 for other in taken):
            taken.append(place)
    return taken[:MOST_PLACES]


def _approaches(streets: Streets, junction: Junction, window: BaseGeometry) -> list[BaseGeometry]:
    """The streets that one reaches from the junction without leaving the window, in either direction."""
    roads = [(_ends(road), streets.areas[road.id]) for road in streets.network.edges]
    inside = {node.id for node in streets.network.junctions if window.covers(Point(node.at_m))}
    reached, grown = {junction.id}, True
    while grown:
        met = {end for ends, _ in roads if reached & inside & set(ends) for end in ends}
        grown = not met <= reached
        reached |= met
    return [area for ends, area in roads if (reached & inside | {junction.id}) & set(ends)]


def _along(line: LineString, forbidden: BaseGeometry, window: BaseGeometry) -> list[XY]:
    """Free places along a line, evenly spaced; one that is taken moves a little along the kerb."""
    count = round(line.length / SPACING_M)
    places = []
    for index in range(count):
        middle_m = (index + 0.5) * line.length / count
        for slide_m in _SLIDES_M:
            point = line.interpolate(min(max(middle_m + slide_m, 0.0), line.length))
            x, y = round(point.x, 1), round(point.y, 1)
            if window.covers(Point(x, y)) and not forbidden.intersects(Point(x, y)):
                places.append((x, y))
                break
    return places


def _without_islands(area: BaseGeometry) -> BaseGeometry:
    polygons = [p for p in shapely.get_parts(area) if isinstance(p, Polygon)]
    large = [Polygon(p.exterior, [r for r in p.interiors if Polygon(r).area >= _ISLAND_M2]) for p in polygons]
    return shapely.union_all(large)


def _lines(rim: BaseGeometry) -> list[LineString]:
    merged = shapely.line_merge(rim) if rim.geom_type == "MultiLineString" else rim
    return [line for line in shapely.get_parts(shapely.normalize(merged)) if isinstance(line, LineString)]
