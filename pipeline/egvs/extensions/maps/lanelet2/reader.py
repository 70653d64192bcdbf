"""Roads of Lanelet2 maps, Autoware's included.

Steps of :func:`read_roads`: read the file; convert its points to metres; find out which way its lanelets run and how
they are connected; make roads, nodes and turns of them; build the network with netconvert. What the map does not state
and what is wrong in it is reported in the notes, by the identifiers of lanelets.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from egvs.core import polylines
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.core.reading import translate_errors
from egvs.core.wording import number_of
from egvs.creation.driving_side import side_in_frame
from egvs.creation.map_parts import RoadMap, RoadOptions
from egvs.creation.turns import turn_notes
from egvs.extensions.maps.formats.lanelet2 import LaneletMap, is_lanelet2, read_lanelet2
from egvs.extensions.maps.formats.lanelet2_graph import (
    DirectedLanelet,
    LaneletGraph,
    LaneletKey,
    build_graph,
    connect_lanelets,
)
from egvs.extensions.maps.formats.lanelet2_projection import ProjectedPoints, project_points
from egvs.extensions.maps.lanelet2 import rules
from egvs.extensions.maps.lanelet2.crosswalks import Crosswalk, place_crosswalks
from egvs.extensions.maps.lanelet2.network import MAX_LANE_ERROR_M, NetworkBuilder, NetworkQuality, unused_relations
from egvs.extensions.maps.lanelet2.right_of_way import RightOfWay
from egvs.extensions.maps.lanelet2.road_layout import RoadLayout
from egvs.extensions.maps.lanelet2.roads import make_roads
from egvs.extensions.maps.lanelet2.signals import SignalPlan, plan_signals

MIN_SIZE_M = 0.5
"""Shorter or narrower lanelets are mistakes; netconvert makes no lanes of them."""

_NO_ROADS_HINT = "Give a map with lanelets of subtype road or highway."


def can_open(path: Path, head: bytes) -> bool:
    """Return whether an OSM-XML file has lanelets; InputError when its gzip is damaged."""
    del head
    return is_lanelet2(path)


def read_roads(path: Path, options: RoadOptions) -> RoadMap:
    """Read a Lanelet2 map and make a SUMO network of it.

    Parameters
    ----------
    path
        An ``.osm`` file, plain or gzipped; a ``map_projector_info.yaml`` beside it is used.
    options
        ``lefthand`` is needed only where neither opposite lanes nor the position tell the side of traffic. With
        ``walk``, crosswalks become crossings, and the roads at their junctions get sidewalks.

    Raises
    ------
    InputError
        When the file is damaged, states invalid numbers, has no lanelets for motor vehicles, or contradicts the
        requested driving side.
    """
    lanelet_map = read_lanelet2(path)
    points = project_points(lanelet_map, path)
    graph = build_graph(lanelet_map, points.xyz_m, rules.is_for_motor_vehicles)
    graph, tiny = _without_tiny(graph)
    if not graph.lanelets:
        raise InputError(path, "has no lanelets for motor vehicles", _NO_ROADS_HINT)
    with translate_errors(path, "Correct the map in an editor.", "its lanelets cannot be made into roads"):
        middle_m = np.mean(list(points.xyz_m.values()), axis=0)
        side = rules.choose_driving_side(
            graph, options.requested_left, side_in_frame(points.frame, middle_m), str(path)
        )
        crosswalk_lanelets = _crosswalks(lanelet_map, points.xyz_m) if options.walk else []
        layout = make_roads(graph, lefthand=side.lefthand, crosswalks=crosswalk_lanelets)
        if not layout.roads:
            problem = "none of its lanelets can be a road: all overlap others and have neither beginning nor end"
            raise InputError(path, problem, "Correct the map in an editor.")
        crosswalks, unused_crosswalks = place_crosswalks(layout, crosswalk_lanelets)
        builder = _make_builder(layout, lanelet_map, points, crosswalks, str(path), side.lefthand)
        network, quality = builder.build()
        lost_crossings = quality.lost_crossings
        if lost_crossings:
            crosswalks = tuple(crosswalk for crosswalk in crosswalks if crosswalk not in lost_crossings)
            builder = _make_builder(layout, lanelet_map, points, crosswalks, str(path), side.lefthand)
            network, quality = builder.build()
    notes = (
        *points.notes,
        side.note,
        *_content_notes(lanelet_map, graph, layout),
        *(_crosswalk_notes(crosswalks, unused_crosswalks, lost_crossings) if options.walk else ()),
        *_assumption_notes(builder.assumed),
        *_signal_notes(builder.signals),
        *_right_of_way_notes(builder.right_of_way),
        *_problem_notes(lanelet_map, graph, layout, tiny),
        *_quality_notes(quality, builder.lane_changes.opened),
    )
    return RoadMap(network, notes=notes, has_heights=points.has_heights)


def _without_tiny(graph: LaneletGraph) -> tuple[LaneletGraph, list[LaneletKey]]:
    """Return the graph without lanelets below :data:`MIN_SIZE_M`, and these."""
    tiny = []
    for key, lanelet in graph.lanelets.items():
        shortest_bound_m = min(polylines.length_m(lanelet.left_m), polylines.length_m(lanelet.right_m))
        if min(lanelet.length_m, lanelet.width_m) < MIN_SIZE_M or shortest_bound_m <= 0:
            tiny.append(key)
    if tiny:
        left_out = set(tiny)
        graph = connect_lanelets({key: lanelet for key, lanelet in graph.lanelets.items() if key not in left_out})
    return graph, tiny


def _content_notes(lanelet_map: LaneletMap, graph: LaneletGraph, layout: RoadLayout) -> Iterator[str]:
    """Yield what was made of the lanelets, and what was left out."""
    used = {key.id for key in graph.lanelets}
    lanes = sum(len(road.lanes) for road in layout.roads.values())
    yield (
        f"Lanelets for motor vehicles: {len(used)}. They became {number_of(len(layout.roads), 'road')} with"
        f" {number_of(lanes, 'lane')} and "
        f"{number_of(len(layout.turns), 'connection')}."
    )
    others = Counter(
        lanelet.tags.get("subtype", "without subtype")
        for number, lanelet in lanelet_map.lanelets.items()
        if number not in used
    )
    if others:
        kinds = ", ".join(f"{number} {kind}" for kind, number in sorted(others.items()))
        yield f"Lanelets not for motor vehicles, left out: {kinds}."
    both_ways = sorted({key.id for key in graph.lanelets if key.is_reversed})
    if both_ways:
        yield (
            f"Lanelets open in both directions: {_count(both_ways)}. SUMO gets a lane for each direction, on the same "
            "ground, and does not see vehicles that meet there."
        )


def _assumption_notes(assumed: rules.Assumptions) -> Iterator[str]:
    if assumed.speeds_km_h:
        counts = ", ".join(
            f"{speed:g} km/h for {number_of(number, 'lane')}" for speed, number in sorted(assumed.speeds_km_h.items())
        )
        yield f"Speed limits that the map does not state are assumed by subtype and location: {counts}."
    if assumed.classes:
        counts = ", ".join(
            f"{name} for {number_of(number, 'road')}" for name, number in sorted(assumed.classes.items())
        )
        yield f"Road classes are assumed by subtype and number of lanes: {counts}."


def _crosswalks(lanelet_map: LaneletMap, xyz_m: Mapping[int, FloatArray]) -> list[DirectedLanelet]:
    """Return the lanelets of crosswalks, in one of their directions."""
    graph = build_graph(lanelet_map, xyz_m, lambda lanelet: lanelet.tags.get("subtype") == "crosswalk")
    graph, _ = _without_tiny(graph)
    return [lanelet for key, lanelet in graph.lanelets.items() if not key.is_reversed]


def _make_builder(
    layout: RoadLayout,
    lanelet_map: LaneletMap,
    points: ProjectedPoints,
    crosswalks: Sequence[Crosswalk],
    where: str,
    lefthand: bool,
) -> NetworkBuilder:
    """Plan sidewalks and traffic lights of a layout, and return the builder of its network."""
    nodes = Counter(crosswalk.node for crosswalk in crosswalks)
    sidewalks = frozenset(road.id for road in layout.roads.values() if road.start in nodes or road.end in nodes)
    layout = replace(layout, sidewalks=sidewalks)
    signals = plan_signals(layout, lanelet_map, points.xyz_m, nodes, lefthand=lefthand)
    return NetworkBuilder(layout, lanelet_map, points.frame, signals, where, lefthand=lefthand, crosswalks=crosswalks)


def _crosswalk_notes(
    crosswalks: Sequence[Crosswalk], unused: Sequence[int], lost: Sequence[Crosswalk]
) -> Iterator[str]:
    if crosswalks:
        ids = _count([number for crosswalk in crosswalks for number in crosswalk.ids])
        yield f"Crosswalks: {ids}. The roads at their junctions get sidewalks 2 m wide, which are assumed."
    else:
        yield "The map has no crosswalk of complete streets, so there are no sidewalks and no crossings."
    if unused:
        yield f"Crosswalks that cross no road for motor vehicles, left out: {_count(unused)}."
    if lost:
        ids = _count([number for crosswalk in lost for number in crosswalk.ids])
        yield f"Crosswalks that end between the carriageways of a street, left out: {ids}."


def _signal_notes(signals: SignalPlan) -> Iterator[str]:
    if signals.nodes:
        yield f"Junctions with traffic lights: {_count(signals.nodes)}. Their signal plans are assumed."
    else:
        yield "No junction has traffic lights: no regulatory element of a light governs its lanes."
    if signals.by_stop_line:
        yield (
            "Traffic lights that no lanelet refers to govern the lanes that end at their stop lines: "
            f"{_count(signals.by_stop_line)}."
        )
    if signals.unused:
        yield f"Traffic lights that govern no lane in a junction, left out: {_count(signals.unused)}."


def _right_of_way_notes(right_of_way: RightOfWay) -> Iterator[str]:
    if right_of_way.prohibitions or right_of_way.all_way_stops:
        yield (
            f"Right of way as the map states it: {number_of(len(right_of_way.prohibitions), 'pair')} of connections, "
            f"{number_of(len(right_of_way.all_way_stops), 'junction')} where all stop. Elsewhere, smaller roads"
            " give way."
        )
    if right_of_way.unused:
        yield f"Rules of right of way between lanelets that do not meet, left out: {_count(right_of_way.unused)}."


def _problem_notes(
    lanelet_map: LaneletMap, graph: LaneletGraph, layout: RoadLayout, tiny: Sequence[LaneletKey]
) -> Iterator[str]:
    """Yield what is wrong in the map."""
    if tiny:
        yield f"Lanelets shorter or narrower than {MIN_SIZE_M:g} m, left out: {_count(tiny)}."
    if lanelet_map.incomplete:
        yield f"Lanelets without one left and one right bound, left out: {_count(lanelet_map.incomplete)}."
    if lanelet_map.missing_members:
        yield f"Members of regulatory elements that are not in the file, ignored: {lanelet_map.missing_members}."
    if reversed_keys := find_reversed_lanelets(graph):
        yield (
            "Lanelets that seem to run the wrong way, since they would continue others if their bounds were swapped: "
            f"{_count(reversed_keys)}. They are taken as the map states."
        )
    if layout.stubs:
        yield (
            "Lanelets that begin or end inside a junction, without a predecessor or a follower: "
            f"{_count(layout.stubs)}. A piece of each became a road."
        )
    if layout.unused:
        ids = sorted({str(key) for key in layout.unused})
        yield f"Lanelets inside junctions that connect no roads, left out: {_count(ids)}."
    if relations := unused_relations(layout):
        pairs = [f"{a} -> {b}" for a, b in relations]
        yield f"Lanelets that follow each other, but are in no connection: {_count(pairs)}."


def _quality_notes(quality: NetworkQuality, opened: Sequence[tuple[str, int]]) -> Iterator[str]:
    """Yield how the network differs from the map."""
    if quality.bad_lanes:
        yield (
            f"Lanes more than {MAX_LANE_ERROR_M:g} m off the centre lines of their lanelets, up to"
            f" {quality.max_lane_error_m:.2f} m: {_count(quality.bad_lanes)}."
        )
    yield from turn_notes(lost=list(map(str, quality.turns.lost)), added=list(map(str, quality.turns.added)))
    if opened:
        lanes = [f"{road}_{index}" for road, index in opened]
        yield (
            "Lanes that nothing leads to, and that can only be reached across a line that forbids it; vehicles may "
            f"change to them: {_count(lanes)}."
        )


def _count(values: Collection[object], limit: int = 5) -> str:
    """Return the number of values, and at most ``limit`` of them.

    >>> _count(range(7))
    '7 (0, 1, 2, 3, 4, ...)'
    """
    texts = [str(value) for value in values]
    more = ["..."] if len(texts) > limit else []
    return f"{len(texts)} ({', '.join([*texts[:limit], *more])})"


def find_reversed_lanelets(graph: LaneletGraph) -> list[LaneletKey]:
    """Return the lanelets that continue nothing as they are, but would continue others if they ran the other way."""
    starts = {(lanelet.left_ends[0], lanelet.right_ends[0]): key for key, lanelet in graph.lanelets.items()}
    ends = {(lanelet.left_ends[1], lanelet.right_ends[1]): key for key, lanelet in graph.lanelets.items()}
    result: list[LaneletKey] = []
    for key, lanelet in graph.lanelets.items():
        if graph.followers[key] or graph.predecessors[key] or key.is_reversed:
            continue
        turned_start = lanelet.right_ends[1], lanelet.left_ends[1]
        turned_end = lanelet.right_ends[0], lanelet.left_ends[0]
        neighbours = [ends.get(turned_start), starts.get(turned_end)]
        if any(other is not None and other.id != key.id for other in neighbours):
            result.append(key)
    return result
