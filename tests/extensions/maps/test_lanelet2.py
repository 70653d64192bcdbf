"""Networks of Lanelet2 maps: lanes where the map has them, the permitted turns and no others, signals, traffic."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import shapely

from egvs.core.errors import InputError
from egvs.creation import junctions
from egvs.creation.map_parts import RoadMap, RoadOptions
from egvs.extensions.maps.formats import lanelet2 as lanelet2_format
from egvs.extensions.maps.formats import lanelet2_projection
from egvs.extensions.maps.formats.lanelet2_graph import LaneletGraph, LaneletKey, build_graph
from egvs.extensions.maps.lanelet2 import reader as lanelet2
from egvs.extensions.maps.lanelet2 import rules
from egvs.extensions.maps.lanelet2.network import read_network_text
from egvs.formats.georeference import WorldFrame
from egvs.traffic import sumo
from egvs.traffic.capacity import find_capacity
from egvs.traffic.network import Network, read_net_xml
from tests.extensions.maps.lanelet2_maps import (
    MapWriter,
    internal_lanes,
    make_crossing,
    signal_sequences,
    write_network,
)

ROOT = Path(__file__).parents[3]
REAL = ROOT.parent / "shared" / "real"
KARLSRUHE, K733 = "lanelet2/mapping_example.osm.gz", "karlsruhe_k733/k733_lanelet2.osm.gz"
CHONGQING, XIAN = "sind/chongqing_lanelet2.osm", "sind/xian_lanelet2.osm"
MAX_ERROR_M = 0.3


@dataclass(frozen=True)
class BuiltMap:
    """A map and the network made of it."""

    path: Path
    roads: RoadMap

    @cached_property
    def network(self) -> Network:
        return read_network_text(self.roads.network)

    @cached_property
    def root(self) -> ElementTree.Element:
        return ElementTree.fromstring(self.roads.network)

    @cached_property
    def lanelet_of(self) -> dict[str, int]:
        """The lanelet of each lane of a road."""
        return {
            lane.attrib["id"]: int(param.attrib["value"])
            for lane in self.root.iter("lane")
            for param in lane.iter("param")
            if param.get("key") == "origId"
        }

    @cached_property
    def shapes_m(self) -> dict[str, np.ndarray]:
        return {f"{e.id}_{i}": lane.shape_m for e in self.network.all_edges for i, lane in enumerate(e.lanes)}

    @cached_property
    def connections(self) -> dict[tuple[str, str], str]:
        """The first internal lane of each connection between lanes of roads."""
        edges = self.network.edges
        return {
            (f"{edges[c.source].id}_{c.source_lane}", f"{edges[c.target].id}_{c.target_lane}"): c.via
            for c in self.network.connections
        }

    @cached_property
    def graph(self) -> LaneletGraph:
        lanelet_map = lanelet2_format.read_lanelet2(self.path)
        points = lanelet2_projection.project_points(lanelet_map, self.path)
        return build_graph(lanelet_map, points.xyz_m, rules.is_for_motor_vehicles)

    def note(self, start: str) -> str:
        return next(note for note in self.roads.notes if note.startswith(start))


def build(path: Path, *, lefthand: bool = False, walk: bool = False) -> BuiltMap:
    return BuiltMap(path, lanelet2.read_roads(path, RoadOptions(lefthand, walk)))


_BUILT: dict[str, BuiltMap] = {}


def real_map(name: str) -> BuiltMap:
    if not (REAL / name).is_file():
        pytest.skip(f"{name} is not beside the checkout (shared/real)")
    if name not in _BUILT:
        _BUILT[name] = build(REAL / name)
    return _BUILT[name]


# ---- what a map must look like as a network


def lane_errors_m(built: BuiltMap) -> dict[str, float]:
    """Distance of each lane of a road from the centre line of its lanelet, or of the piece of it, by lane."""
    errors = {}
    for lane, number in built.lanelet_of.items():
        line = built.graph.lanelets[LaneletKey(number, "_back" in lane)].center_m[:, :2]
        shape = built.shapes_m[lane][:, :2]
        if "_part" in lane:  # only that it lies on the lanelet
            points = shapely.points(np.vstack([shape, (shape[1:] + shape[:-1]) / 2]))
            errors[lane] = float(shapely.distance(points, shapely.LineString(line)).max())
        else:
            errors[lane] = float(
                shapely.hausdorff_distance(shapely.LineString(shape), shapely.LineString(line), densify=0.05)
            )
    return errors


def internal_errors_m(built: BuiltMap) -> list[float]:
    """Distance of the internal lanes of each connection from the centre lines of all lanelets together."""
    following = internal_lanes(built.roads.network)
    lines = shapely.MultiLineString([lanelet.center_m[:, :2] for lanelet in built.graph.lanelets.values()])
    errors = []
    for lane in built.connections.values():
        while lane.startswith(":"):
            points = shapely.points(built.shapes_m[lane][:, :2])
            errors.append(float(shapely.distance(points, lines).max()))
            lane = following[lane]
    return errors


def permitted_pairs(built: BuiltMap) -> tuple[set[tuple[str, str]], set[tuple[str, str]]]:
    """Pairs of lanes that the map connects, found by walking through its graph, and those of the network."""
    lane_of = {}
    for lane, number in built.lanelet_of.items():
        part = int(match[1]) if (match := re.search(r"_part(\d+)", lane)) else 0
        lane_of.setdefault((number, "_back" in lane), []).append((part, lane))
    expected = set()
    for key, lanes in lane_of.items():
        ordered = [lane for _, lane in sorted(lanes)]
        seen: set[LaneletKey] = set()
        queue = list(built.graph.followers[LaneletKey(*key)])
        starts = [ordered[-1]]
        if any("_part" in lane for lane in ordered):
            # a piece at the start of an inner lanelet leads on, one at its end is led to
            first_pieces = [
                lane for lane in ordered if built.shapes_m[lane] is not None and _is_at_start(built, key, lane)
            ]
            starts = first_pieces or []
            last_pieces = [lane for lane in ordered if lane not in first_pieces]
            if starts and last_pieces:
                expected.update((a, b) for a in starts for b in last_pieces)
                continue
        while queue:
            reached = queue.pop()
            if reached in seen:
                continue
            seen.add(reached)
            pieces = [lane for _, lane in sorted(lane_of.get((reached.id, reached.is_reversed), []))]
            entries = [p for p in pieces if "_part" not in p] or [
                p for p in pieces if not _is_at_start(built, reached[:2], p)
            ]
            if entries:
                expected.update((start, entry) for start in starts for entry in entries)
            else:
                queue += built.graph.followers[LaneletKey(reached.id, reached.is_reversed)]
    return expected, set(built.connections)


def _is_at_start(built: BuiltMap, key: tuple[int, bool], lane: str) -> bool:
    line = built.graph.lanelets[LaneletKey(*key[:2])].center_m
    return bool(np.hypot(*(built.shapes_m[lane][0] - line[0])[:2]) < 0.5)


def drive(built: BuiltMap, folder: Path, vehicles: int = 50) -> tuple[int, int, int]:
    """Let vehicles drive random routes through a network; return how many arrive, collide and are teleported."""
    folder.joinpath("net.net.xml").write_text(built.roads.network, encoding="utf-8")
    pairs = gate_pairs(built.network)
    trips = []
    for number in range(vehicles):
        source, sink = pairs[number * 7 % len(pairs)]
        trips.append(f'<trip id="{number}" depart="{3 * number}" departLane="best" from="{source}" to="{sink}"/>')
    folder.joinpath("trips.xml").write_text(f"<routes>{''.join(trips)}</routes>", encoding="utf-8")
    options = ["--collision.check-junctions", "--collision.action", "warn", "--time-to-teleport", "120", "-e", "1500"]
    outputs = ["--statistic-output", "statistics.xml", "--no-step-log", "--no-warnings"]
    sumo.run_program("sumo", ["-n", "net.net.xml", "-r", "trips.xml", *options, *outputs], folder)
    statistics = ElementTree.parse(folder / "statistics.xml").getroot()
    counts = {element.tag: element.attrib for element in statistics}
    arrived = int(counts["vehicles"]["inserted"]) - int(counts["vehicles"]["running"])
    return arrived, int(counts["safety"]["collisions"]), int(counts["teleports"]["total"])


def gate_pairs(network: Network) -> list[tuple[str, str]]:
    """Pairs of roads where the map begins and where it ends, with a way from one to the other."""
    edges = network.edges
    following: dict[int, set[int]] = {}
    for connection in network.connections:
        following.setdefault(connection.source, set()).add(connection.target)
    entered = set().union(*following.values())
    pairs = []
    for start in sorted(set(following) - entered):
        seen: set[int] = set()
        queue = [start]
        while queue:
            for after in following.get(queue.pop(), set()) - seen:
                seen.add(after)
                queue.append(after)
        pairs += [(edges[start].id, edges[end].id) for end in sorted(seen - set(following))]
    return pairs


# ---- a small map


@pytest.mark.slow
def test_crossing_becomes_eight_roads_and_twelve_turns(tmp_path: Path) -> None:
    crossing = make_crossing(tags={"speed_limit": "36"})
    built = build(crossing.writer.write(tmp_path / "map.osm", turn_lines=1))
    assert {(a, b) for a, b in built.connections} == {
        (f"road_{crossing.into[a]}_0", f"road_{crossing.out_of[b]}_0") for a in range(4) for b in range(4) if a != b
    }
    assert len(built.network.junctions) == 5 + sum(j.type == "internal" for j in built.network.junctions)
    assert {lane.speed_m_s for edge in built.network.edges for lane in edge.lanes} == {10.0}
    assert {lane.width_m for edge in built.network.edges for lane in edge.lanes} == {3.5}
    assert max(lane_errors_m(built).values()) < 0.15
    assert max(internal_errors_m(built)) < 0.05
    assert not built.roads.has_heights


@pytest.mark.slow
def test_turns_have_the_directions_of_the_map(tmp_path: Path) -> None:
    crossing = make_crossing()
    built = build(crossing.writer.write(tmp_path / "map.osm"))
    directions = {
        (built.network.edges[c.source].id, built.network.edges[c.target].id): c.direction
        for c in built.network.connections
    }
    for turned, direction in ((1, "r"), (2, "s"), (3, "l")):
        assert directions[f"road_{crossing.into[0]}", f"road_{crossing.out_of[turned]}"] == direction


@pytest.mark.slow
def test_lefthand_traffic_is_recognised(tmp_path: Path) -> None:
    path = make_crossing(lefthand=True).writer.write(tmp_path / "map.osm")
    built = build(path)
    assert built.root.get("lefthand") == "true"
    assert built.note("Traffic drives on the left")
    assert build(path, lefthand=True).roads.network == built.roads.network
    right = make_crossing().writer.write(tmp_path / "right.osm")
    assert build(right).root.get("lefthand") is None
    with pytest.raises(InputError, match=r"right\.osm: .* drives on the right\. Leave out --lefthand"):
        build(right, lefthand=True)


@pytest.mark.slow
def test_kerb_lane_is_lane_0_on_both_sides(tmp_path: Path) -> None:
    for lefthand in (False, True):
        sign = -1.0 if lefthand else 1.0
        writer = MapWriter()
        lines = [writer.line([[0, sign * y], [100, sign * y]], type="virtual") for y in (0, 3, 6, 9, 12)]
        ids = []
        for first in range(4):
            left, right = (first + 1, first) if not lefthand else (first, first + 1)
            if first >= 2:  # opposite direction
                left, right = right, left
            ids.append(writer.lanelet(lines[left], lines[right]))
        built = build(writer.write(tmp_path / f"{lefthand}.osm", local=True))
        kerb = next(lane for lane, number in built.lanelet_of.items() if number == ids[0])
        assert kerb.endswith("_0")
        assert sum(len(edge.lanes) for edge in built.network.edges) == 4
        assert len(built.network.edges) == 2


@pytest.mark.slow
def test_preserves_heights_and_makes_no_junctions_of_bridges(tmp_path: Path) -> None:
    writer = MapWriter()

    def straight(points: list[tuple[float, float, float]], aside: tuple[float, float]) -> int:
        sides = [[(x + s * aside[0], y + s * aside[1], z) for x, y, z in points] for s in (1.75, -1.75)]
        return writer.lanelet(*(writer.line(side) for side in sides))

    below = straight([(-50, 0, 0), (50, 0, 0)], (0, 1))
    above = straight([(0, -50, 2), (0, 0, 6), (0, 50, 2)], (-1, 0))
    built = build(writer.write(tmp_path / "bridge.osm", local=True))
    assert built.roads.has_heights
    assert not built.connections
    assert not [j for j in built.network.junctions if j.id.startswith("junction")]
    shape = built.shapes_m[f"road_{above}_0"]
    assert shape[:, 2].max() == pytest.approx(6.0)
    assert built.shapes_m[f"road_{below}_0"][:, 2].max() == 0.0

    low = writer.write(tmp_path / "level.osm", local=True).read_text(encoding="utf-8")
    path = tmp_path / "level.osm"
    path.write_text(re.sub(r'k="ele" v="[^"]*"', 'k="ele" v="2"', low), encoding="utf-8")
    assert [j for j in build(path).network.junctions if j.id.startswith("junction")]


@pytest.mark.slow
def test_position_on_the_earth_is_stated(tmp_path: Path) -> None:
    crossing = make_crossing()
    built = build(crossing.writer.write(tmp_path / "map.osm"))
    location = built.network.location
    assert location is not None
    frame = WorldFrame.from_projection(location.projection, location.offset_m, "test")
    number, key = crossing.into[0], "lat_deg"
    lanelet_map = lanelet2_format.read_lanelet2(built.path)
    first = lanelet_map.points[lanelet_map.lines[lanelet_map.lanelets[number].left].nodes[-1]]
    lane_start_m = built.shapes_m[f"road_{number}_0"][0]
    ((lon_deg, lat_deg),) = frame.to_degrees(lane_start_m[None, :2])
    assert lat_deg == pytest.approx(getattr(first, key), abs=2e-5)  # half a lane beside it: 1.75 m
    assert lon_deg == pytest.approx(first.lon_deg, abs=1e-6)


@pytest.mark.slow
def test_speed_limits(tmp_path: Path) -> None:
    crossing = make_crossing()
    lanelets = crossing.writer.lanelets
    for arm, tags in enumerate([{"speed_limit": "10 m/s"}, {"maxspeed": "30"}, {"location": "nonurban"}, {}]):
        lanelets[crossing.into[arm]][2].update(tags)
    sign = crossing.writer.line([[80, 5], [80, 6]], type="traffic_sign", subtype="de274-70")
    limit = crossing.writer.regulation([("way", sign, "refers")], "speed_limit")
    crossing.writer.refer(crossing.into[3], limit)
    built = build(crossing.writer.write(tmp_path / "map.osm"))
    speeds = {edge.id: round(edge.lanes[0].speed_m_s * 3.6) for edge in built.network.edges}
    assert [speeds[f"road_{crossing.into[arm]}"] for arm in range(4)] == [36, 30, 80, 70]
    assert built.note("Speed limits").endswith("50 km/h for 4 lanes, 80 km/h for 1 lane.")
    lanelets[crossing.into[0]][2]["speed_limit"] = "fast"
    with pytest.raises(InputError, match=rf"lanelet {crossing.into[0]}: speed_limit: .*'fast'"):
        build(crossing.writer.write(tmp_path / "map.osm"))


@pytest.mark.slow
def test_assumed_classes_are_counted_once(tmp_path: Path) -> None:
    """The roads of a map with a ring are converted twice."""
    path = ROOT / "scenarios" / "roundabout" / "network.net.xml"
    written = write_network(read_net_xml(path), path.read_text(encoding="utf-8"))
    built = build(written.writer.write(tmp_path / "map.osm", local=True))
    counts = re.findall(r" for (\d+) road", built.note("Road classes"))
    assert sum(map(int, counts)) == len(built.network.edges)


@pytest.mark.slow
def test_permissions(tmp_path: Path) -> None:
    crossing = make_crossing()
    crossing.writer.lanelets[crossing.into[0]][2]["subtype"] = "bus_lane"
    crossing.writer.lanelets[crossing.into[1]][2]["subtype"] = "highway"
    built = build(crossing.writer.write(tmp_path / "map.osm"))
    lanes = {edge.id: edge.lanes[0].permission for edge in built.network.edges}
    bus, highway, road = (lanes[f"road_{crossing.into[arm]}"] for arm in range(3))
    kinds = ("passenger", "bus", "bicycle", "pedestrian")
    assert [bus.admits(kind) for kind in kinds] == [False, True, False, False]
    assert [highway.admits(kind) for kind in kinds] == [True, True, False, False]
    assert [road.admits(kind) for kind in kinds] == [True, True, True, False]


@pytest.mark.slow
def test_markings_decide_on_lane_changes(tmp_path: Path) -> None:
    def changes(marking: Mapping[str, str]) -> list[bool]:
        writer = MapWriter()
        lines = [writer.line([[0, y], [100, y]], **(marking if y == 3 else {"type": "curbstone"})) for y in (0, 3, 6)]
        right, left = (writer.lanelet(lines[i + 1], lines[i]) for i in (0, 1))
        built = build(writer.write(tmp_path / "map.osm", local=True))
        lanes = {int(lane.find("param").attrib["value"]): lane for lane in built.root.iter("lane") if len(lane)}  # type: ignore[union-attr]
        return ["changeLeft" not in lanes[right].attrib, "changeRight" not in lanes[left].attrib]

    assert changes({"type": "line_thin", "subtype": "dashed"}) == [True, True]
    assert changes({"type": "line_thin", "subtype": "solid"}) == [False, False]
    assert changes({"type": "line_thin", "subtype": "solid_dashed"}) == [True, False]
    assert changes({"type": "line_thin", "subtype": "dashed_solid"}) == [False, True]
    assert changes({"type": "curbstone", "lane_change": "yes"}) == [True, True]


@pytest.mark.slow
def test_lane_that_nothing_leads_to_can_be_reached(tmp_path: Path) -> None:
    """One lane becomes two behind a solid line: without a change, nobody could turn right."""
    crossing = make_crossing()
    writer = crossing.writer
    into = crossing.into[0]
    before = writer.lanelet(writer.line([[132, 0], [72, 0]]), writer.line([[132, 3.5], [72, 3.5]]))
    kerb = writer.lanelets[into][1]
    outer = writer.line([[72, 7], [12, 7]], type="curbstone")
    pocket = writer.lanelet(kerb, outer)
    corner = writer.lanelet(writer.line([[12, 3.5], [3.5, 12]]), writer.line([[12, 7], [7, 12]]))
    writer.lanelet(writer.line([[3.5, 12], [3.5, 72]]), writer.line([[7, 12], [7, 72]]))
    built = build(writer.write(tmp_path / "map.osm", local=True))
    road = next(lane for lane, number in built.lanelet_of.items() if number == pocket)
    assert road in built.note("Lanes that nothing leads to")
    assert {before, corner}
    lane = next(lane for lane in built.root.iter("lane") if lane.get("id") == f"{road[:-1]}1")
    assert lane.get("changeRight") is None


@pytest.mark.slow
def test_two_way_lanelet_becomes_two_roads(tmp_path: Path) -> None:
    writer = MapWriter()
    number = writer.lanelet(writer.line([[0, 3], [60, 3]]), writer.line([[0, 0], [60, 0]]), one_way="no")
    built = build(writer.write(tmp_path / "map.osm"))
    assert {edge.id for edge in built.network.edges} == {f"road_{number}", f"road_{number}_back"}
    assert built.note("Lanelets open in both directions: 1")


@pytest.mark.slow
def test_reversed_lanelet_is_reported(tmp_path: Path) -> None:
    crossing = make_crossing()
    left, right, tags, regulations = crossing.writer.lanelets[crossing.into[2]]
    crossing.writer.lanelets[crossing.into[2]] = right, left, tags, regulations
    built = build(crossing.writer.write(tmp_path / "map.osm"))
    assert built.note("Lanelets that seem to run the wrong way").endswith(
        f"1 ({crossing.into[2]}). They are taken as the map states."
    )


@pytest.mark.slow
def test_lanelets_cut_at_the_edge_of_the_map_stay_connected(tmp_path: Path) -> None:
    crossing = make_crossing()
    del crossing.writer.lanelets[crossing.out_of[1]]
    del crossing.writer.lanelets[crossing.into[3]]
    built = build(crossing.writer.write(tmp_path / "map.osm"))
    expected, actual = permitted_pairs(built)
    assert actual == expected
    assert len(actual) == 12
    assert built.note("Lanelets that begin or end inside a junction, without a predecessor or a follower: 5")
    assert not [note for note in built.roads.notes if "in no connection" in note]


@pytest.mark.slow
def test_long_loop_road_is_cut(tmp_path: Path) -> None:
    """A road that leaves a crossing in the east and comes back from the south would be a loop at one node."""
    crossing = make_crossing()
    writer = crossing.writer
    del writer.lanelets[crossing.out_of[0]], writer.lanelets[crossing.into[3]]
    angles = np.linspace(0, np.pi, 30)
    bounds = []
    for near in (0.0, 3.5):
        start, end = np.array([12.0, -near]), np.array([near, -12.0])
        middle, half = (start + end) / 2, (start - end) / 2
        away = np.array([1.0, -1.0]) / np.sqrt(2)
        bounds.append([middle + np.cos(a) * half + np.sin(a) * 60 * away for a in angles])
    loop = writer.lanelet(writer.line(bounds[0]), writer.line(bounds[1]))
    built = build(writer.write(tmp_path / "map.osm"))
    pieces = sorted(lane for lane, number in built.lanelet_of.items() if number == loop)
    assert pieces == [f"road_{loop}_part1_0", f"road_{loop}_part2_0"]
    assert (pieces[0], pieces[1]) in built.connections


def signalised_crossing(tmp_path: Path, *, refer: bool) -> tuple[BuiltMap, list[int]]:
    crossing = make_crossing()
    lights = []
    for arm in range(4):
        u = np.array([np.cos(arm * np.pi / 2), np.sin(arm * np.pi / 2)])
        v = np.array([-u[1], u[0]])
        stop = crossing.writer.line([12.5 * u, 12.5 * u + 3.5 * v], type="stop_line")
        bulbs = crossing.writer.line([-12 * u, -12 * u + v], type="traffic_light")
        light = crossing.writer.regulation([("way", stop, "ref_line"), ("way", bulbs, "refers")], "traffic_light")
        lights.append(light)
        if refer:
            crossing.writer.refer(crossing.into[arm], light)
    return build(crossing.writer.write(tmp_path / "map.osm")), lights


@pytest.mark.slow
@pytest.mark.parametrize("refer", [True, False])
def test_lights_form_groups_by_regulatory_element(tmp_path: Path, refer: bool) -> None:
    built, lights = signalised_crossing(tmp_path, refer=refer)
    (logic,) = built.root.iter("tlLogic")
    controlled = [c for c in built.root.findall("connection") if c.get("tl")]
    assert len(controlled) == 12
    groups: dict[str, set[str]] = {}
    for connection in controlled:
        groups.setdefault(connection.attrib["from"], set()).add(connection.attrib["linkIndex"])
    assert [len(indices) for indices in groups.values()] == [2, 2, 2, 2]  # left turns, and the others
    assert len(set.union(*groups.values())) == 8
    greens = [phase.attrib["state"] for phase in logic if "y" not in phase.attrib["state"]]
    assert sorted(state.count("G") for state in greens if "G" in state) == [2, 2]  # two opposite arms at a time
    assert sorted(state.count("g") for state in greens if "G" in state) == [2, 2]  # their left turns yield
    note = "Traffic lights that no lanelet refers to"
    assert any(text.startswith(note) for text in built.roads.notes) != refer
    assert len(lights) == 4


@pytest.mark.slow
def test_signalised_crossing_carries_traffic(tmp_path: Path) -> None:
    built, _ = signalised_crossing(tmp_path, refer=True)
    assert drive(built, tmp_path) == (50, 0, 0)


def responses(built: BuiltMap) -> dict[tuple[str, str], set[tuple[str, str]]]:
    """Which connections each connection of the junction yields to, by roads."""
    junction = next(j for j in built.root.findall("junction") if j.attrib["id"].startswith("junction"))
    first_lanes = junction.attrib["intLanes"].split()
    following = internal_lanes(built.roads.network)
    order = []
    for (source, target), via in built.connections.items():
        lanes = [via]
        while following[lanes[-1]].startswith(":"):
            lanes.append(following[lanes[-1]])
        position = next(i for i, lane in enumerate(first_lanes) if lane in lanes)
        order.append((position, (source[:-2], target[:-2])))
    roads = [pair for _, pair in sorted(order)]
    bits = [request.attrib["response"][::-1] for request in junction.findall("request")]
    return {roads[i]: {roads[j] for j, bit in enumerate(row) if bit == "1"} for i, row in enumerate(bits)}


@pytest.mark.slow
def test_right_of_way_is_that_of_the_map(tmp_path: Path) -> None:
    """Straight on from the north meets straight on from the east: the map decides who yields."""
    ways = {}
    for prior, yielding in ((0, 1), (1, 0)):
        crossing = make_crossing()
        members = [("relation", crossing.into[prior], "right_of_way"), ("relation", crossing.into[yielding], "yield")]
        crossing.writer.regulation(members, "right_of_way")
        built = build(crossing.writer.write(tmp_path / f"{prior}.osm"))
        east = f"road_{crossing.into[0]}", f"road_{crossing.out_of[2]}"
        north = f"road_{crossing.into[1]}", f"road_{crossing.out_of[3]}"
        yields = responses(built)
        ways[prior] = (north in yields[east], east in yields[north])
        assert built.note("Right of way as the map states it")
    assert ways == {0: (False, True), 1: (True, False)}


@pytest.mark.slow
def test_contradictory_and_unused_rules(tmp_path: Path) -> None:
    crossing = make_crossing()
    for prior, yielding in ((0, 1), (1, 0)):
        members = [("relation", crossing.into[prior], "right_of_way"), ("relation", crossing.into[yielding], "yield")]
        crossing.writer.regulation(members, "right_of_way")
    members = [("relation", crossing.out_of[0], "right_of_way"), ("relation", crossing.out_of[1], "yield")]
    unused = crossing.writer.regulation(members, "right_of_way")
    built = build(crossing.writer.write(tmp_path / "map.osm"))
    assert built.note("Rules of right of way between lanelets that do not meet").endswith(f"1 ({unused}).")
    assert not [note for note in built.roads.notes if note.startswith("Right of way as")]


@pytest.mark.slow
def test_all_way_stop(tmp_path: Path) -> None:
    crossing = make_crossing()
    crossing.writer.regulation([("relation", crossing.into[arm], "yield") for arm in range(4)], "all_way_stop")
    built = build(crossing.writer.write(tmp_path / "map.osm"))
    assert [j.type for j in built.network.junctions if j.id.startswith("junction")] == ["allway_stop"]


def crossing_with_zebras(tmp_path: Path, along_m: float, *, lights: bool = False, lefthand: bool = False) -> BuiltMap:
    """A crossing with a crosswalk 4 m wide over each arm, ``along_m`` from the middle."""
    crossing = make_crossing(lefthand=lefthand)
    writer = crossing.writer
    for arm in range(4):
        u = np.array([np.cos(arm * np.pi / 2), np.sin(arm * np.pi / 2)])
        v = np.array([-u[1], u[0]])
        sides = [[along * u + side * v for side in (-4.5, 4.5)] for along in (along_m - 2, along_m + 2)]
        writer.lanelet(writer.line(sides[0]), writer.line(sides[1]), subtype="crosswalk", one_way="no")
        if lights:
            light = writer.regulation([], "traffic_light")
            writer.refer(crossing.into[arm], light)
    return build(writer.write(tmp_path / "map.osm", local=True), walk=True)


def crossings(built: BuiltMap) -> list[ElementTree.Element]:
    return [edge for edge in built.root.findall("edge") if edge.get("function") == "crossing"]


@pytest.mark.slow
@pytest.mark.parametrize(("along_m", "lefthand"), [(15.0, False), (15.0, True), (10.0, False)])
def test_crosswalks_at_a_junction(tmp_path: Path, along_m: float, lefthand: bool) -> None:
    built = crossing_with_zebras(tmp_path, along_m, lefthand=lefthand)
    assert len(crossings(built)) == 4
    for edge in crossings(built):
        assert len(edge.attrib["crossingEdges"].split()) == 2
        (lane,) = edge.iter("lane")
        points = np.array([[float(v) for v in p.split(",")[:2]] for p in lane.attrib["shape"].split()])
        middle_m = np.abs(points.mean(axis=0))
        assert sorted(np.round(middle_m, 1)) == [0.0, along_m]
        assert float(lane.attrib["width"]) == pytest.approx(4.0)
    assert {lane.is_sidewalk for edge in built.network.edges for lane in edge.lanes[:1]} == {True}
    assert all(len(edge.lanes) == 2 for edge in built.network.edges)
    assert len(built.connections) == 12
    assert built.network.walkways.crossings == 4
    # vehicles stop before the crosswalk
    into = [edge for edge in built.network.edges if edge.to_node.startswith("junction")]
    for edge in into:
        assert np.hypot(*edge.lanes[1].shape_m[-1][:2]) >= (17.3 if along_m == 15.0 else 11.8)


@pytest.mark.slow
def test_crosswalk_amid_a_road_cuts_it(tmp_path: Path) -> None:
    built = crossing_with_zebras(tmp_path, 50.0)
    assert len(crossings(built)) == 4
    assert len([j for j in built.network.junctions if j.id.startswith("junction")]) == 5
    assert len(built.connections) == 12 + 8
    lengths_m = sorted(np.hypot(*np.ptp(edge.lanes[-1].shape_m[:, :2], axis=0)) for edge in built.network.edges)
    np.testing.assert_allclose(lengths_m, [19.5] * 8 + [35.5] * 8, atol=0.3)


@pytest.mark.slow
def test_crosswalks_at_lights_get_a_phase(tmp_path: Path) -> None:
    built = crossing_with_zebras(tmp_path, 15.0, lights=True)
    (logic,) = built.root.iter("tlLogic")
    states = [phase.attrib["state"] for phase in logic]
    assert {len(state) for state in states} == {8 + 4}
    assert [state for state in states if "G" in state[8:]] == ["r" * 8 + "G" * 4]
    links = [c.attrib["linkIndex"] for c in built.root.findall("connection") if c.get("tl") and "_c" in c.attrib["to"]]
    assert sorted(map(int, links)) == [8, 9, 10, 11]
    assert drive(built, tmp_path) == (50, 0, 0)


@pytest.mark.slow
def test_pedestrians_walk_over_crosswalks(tmp_path: Path) -> None:
    built = crossing_with_zebras(tmp_path, 15.0)
    tmp_path.joinpath("net.net.xml").write_text(built.roads.network, encoding="utf-8")
    names = [edge.id for edge in built.network.edges]
    persons = "".join(
        f'<person id="{i}" depart="{i}"><walk from="{names[i % 8]}" to="{names[(i * 3 + 1) % 8]}"/></person>'
        for i in range(40)
    )
    tmp_path.joinpath("walks.xml").write_text(f"<routes>{persons}</routes>", encoding="utf-8")
    options = ["-n", "net.net.xml", "-r", "walks.xml", "-e", "1500", "--statistic-output", "statistics.xml"]
    sumo.run_program("sumo", [*options, "--no-step-log", "--no-warnings"], tmp_path)
    counts = ElementTree.parse(tmp_path / "statistics.xml").getroot().find("persons")
    assert counts is not None
    assert (counts.get("loaded"), counts.get("running"), counts.get("jammed")) == ("40", "0", "0")


def test_without_crosswalks_there_are_no_sidewalks(tmp_path: Path) -> None:
    built = build(make_crossing().writer.write(tmp_path / "map.osm"), walk=True)
    assert built.note("The map has no crosswalk of complete streets")
    assert all(len(edge.lanes) == 1 for edge in built.network.edges)


@pytest.mark.slow
def test_carriageways_that_leave_the_map_together_are_one_arm(tmp_path: Path) -> None:
    def nodes(gap_m: float, height_m: float) -> int:
        writer = MapWriter()
        writer.lanelet(writer.line([[0, 3, 0], [100, 3, 0]]), writer.line([[0, 0, 0], [100, 0, 0]]))
        y, z = 3 + gap_m, height_m
        writer.lanelet(writer.line([[100, y, z], [0, y, z]]), writer.line([[100, y + 3, z], [0, y + 3, z]]))
        return len(build(writer.write(tmp_path / "map.osm", local=True)).network.junctions)

    assert nodes(5.0, 0.0) == 2
    assert nodes(30.0, 0.0) == 4
    assert nodes(5.0, 6.0) == 4


def test_map_without_roads_is_rejected(tmp_path: Path) -> None:
    writer = MapWriter()
    writer.lanelet(writer.line([[0, 3], [60, 3]]), writer.line([[0, 0], [60, 0]]), subtype="walkway")
    with pytest.raises(InputError, match="has no lanelets for motor vehicles"):
        build(writer.write(tmp_path / "map.osm"))


def test_recognises_lanelet2_files(tmp_path: Path) -> None:
    path = make_crossing().writer.write(tmp_path / "map.osm")
    head = path.read_bytes()[:4096]
    assert lanelet2.can_open(path, head)
    other = tmp_path / "other.osm"
    other.write_text('<osm version="0.6"><node id="1" lat="1" lon="1"/></osm>', encoding="utf-8")
    assert not lanelet2.can_open(other, other.read_bytes())


@pytest.mark.slow
def test_same_map_gives_the_same_text(tmp_path: Path) -> None:
    path = make_crossing().writer.write(tmp_path / "map.osm")
    first, second = build(path).roads, build(path).roads
    assert first == second
    assert str(tmp_path) not in first.network
    assert "generated on" not in first.network


# ---- real maps


@pytest.mark.parametrize(
    ("name", "lanelets", "turns"),
    [
        pytest.param(KARLSRUHE, 328, 284, marks=pytest.mark.slow),
        (K733, 38, 19),
        (CHONGQING, 48, 27),
        (XIAN, 52, 24),
    ],
)
def test_real_map_keeps_lanes_and_turns(name: str, lanelets: int, turns: int) -> None:
    built = real_map(name)
    assert len({key.id for key in built.graph.lanelets}) == lanelets
    assert max(lane_errors_m(built).values()) < MAX_ERROR_M
    assert max(internal_errors_m(built)) < MAX_ERROR_M
    expected, actual = permitted_pairs(built)
    assert actual == expected
    assert len(actual) == turns


@pytest.mark.slow
@pytest.mark.parametrize("name", [KARLSRUHE, K733, CHONGQING, XIAN])
def test_real_map_carries_traffic(name: str, tmp_path: Path) -> None:
    built = real_map(name)
    arrived, collisions, teleports = drive(built, tmp_path)
    assert (arrived, teleports) == (50, 0)
    assert collisions == 0

    path = tmp_path / "map.net.xml"
    path.write_text(built.roads.network, encoding="utf-8")
    streets = junctions.read_streets(path)
    junction = junctions.largest_junctions(streets)[0]
    assert junction is not None
    flows = junctions.assumed_flows(streets, junctions.region_around(junction), junction.ring)
    assert len(flows) >= 10
    assert find_capacity(built.roads.network, flows, 15.0).is_confirmed


def test_known_numbers_of_real_maps() -> None:
    """Numbers that a person can check in an editor."""
    chongqing = real_map(CHONGQING)
    assert "-100015" in chongqing.note("Lanelets that seem to run the wrong way")  # R2In3
    assert "4 (-99998, -99997, -99996, -99995)" in chongqing.note("Traffic lights that no lanelet refers to")
    # Lanelet -100028, an approach from the east: its left bound from longitude 0.00045847 to 0.00014999
    lane = chongqing.shapes_m["road_-100028_2"]
    assert np.hypot(*(lane[-1] - lane[0])[:2]) == pytest.approx(33.8, abs=0.3)

    k733 = real_map(K733)
    streets = {edge.name for edge in k733.network.edges if edge.name}
    assert streets == {"Ostring", "Durlacher Allee"}
    location = k733.network.location
    assert location is not None
    frame = WorldFrame.from_projection(location.projection, location.offset_m, "test")
    ((east_m, north_m),) = frame.from_lon_lat(np.array([[8.4374089, 49.005306]]))  # the junction, by the data set
    junction = next(j for j in k733.network.junctions if j.id.startswith("junction"))
    assert np.hypot(east_m - junction.at_m[0], north_m - junction.at_m[1]) < 30


# ---- round trips


@pytest.mark.parametrize(
    ("name", "lanes", "turns"),
    [
        ("roundabout", 20, 20),
        ("hill", 12, 12),
        pytest.param("nishishinjuku", 218, 264, marks=pytest.mark.slow),
    ],
)
def test_network_written_as_lanelet2_comes_back(name: str, lanes: int, turns: int, tmp_path: Path) -> None:
    path = ROOT / "scenarios" / name / "network.net.xml"
    original = read_net_xml(path)
    written = write_network(original, path.read_text(encoding="utf-8"))
    built = build(written.writer.write(tmp_path / "map.osm", local=True, turn_lines=1))
    shapes = {f"{edge.id}_{i}": lane.shape_m for edge in original.edges for i, lane in enumerate(edge.lanes)}
    speeds = {f"{edge.id}_{i}": lane.speed_m_s for edge in original.edges for i, lane in enumerate(edge.lanes)}
    built_speeds = {f"{e.id}_{i}": lane.speed_m_s for e in built.network.edges for i, lane in enumerate(e.lanes)}
    origin = {lane: written.lane_of[n] for lane, n in built.lanelet_of.items() if n in written.lane_of}
    assert len(origin) == len(set(origin.values())) == lanes
    for lane, was in origin.items():
        old, new = shapely.LineString(shapes[was][:, :2]), shapely.LineString(built.shapes_m[lane][:, :2])
        assert shapely.hausdorff_distance(old, new, densify=0.1) < MAX_ERROR_M
        np.testing.assert_allclose(built.shapes_m[lane][[0, -1], 2], shapes[was][[0, -1], 2], atol=0.05)
        assert built_speeds[lane] == pytest.approx(speeds[was], abs=0.01)
    assert connected_origins(built, origin) == written.turns
    assert len(written.turns) == turns


@pytest.mark.parametrize("refer", [True, False])
@pytest.mark.parametrize("name", ["roundabout", pytest.param("nishishinjuku", marks=pytest.mark.slow)])
def test_signals_and_right_of_way_come_back(name: str, refer: bool, tmp_path: Path) -> None:
    """Turns that the original switches alike share a signal; roundabouts stay roundabouts; lanes keep their ends."""
    path = ROOT / "scenarios" / name / "network.net.xml"
    text = path.read_text(encoding="utf-8")
    original = read_net_xml(path)
    written = write_network(original, text, refer=refer)
    built = build(written.writer.write(tmp_path / "map.osm", local=True, turn_lines=1))
    lights = [sum(junction.type == "traffic_light" for junction in n.junctions) for n in (original, built.network)]
    assert lights[0] == lights[1]
    groups = {  # turns from one edge that switch alike
        (element.attrib["from"], signal_sequences(ElementTree.fromstring(text))[element.attrib["tl"], index])
        for element in ElementTree.fromstring(text).findall("connection")
        if (index := int(element.get("linkIndex", "-1"))) >= 0
    }
    links = {(c.attrib["tl"], c.attrib["linkIndex"]) for c in built.root.findall("connection") if "tl" in c.attrib}
    assert len(links) == len(groups)
    assert len(built.network.roundabouts) == len(original.roundabouts)
    assert not [note for note in built.roads.notes if "govern no lane" in note or "do not meet" in note]
    shapes = {f"{edge.id}_{i}": lane.shape_m for edge in original.edges for i, lane in enumerate(edge.lanes)}
    for lane, number in built.lanelet_of.items():
        if number in written.lane_of:
            was = shapes[written.lane_of[number]]
            np.testing.assert_allclose(built.shapes_m[lane][[0, -1], :2], was[[0, -1], :2], atol=0.05)


def connected_origins(built: BuiltMap, origin: Mapping[str, str]) -> set[tuple[str, str]]:
    """Pairs of original lanes that the network connects, directly or over lanes that were turns."""
    following: dict[str, list[str]] = {}
    for source, target in built.connections:
        following.setdefault(source, []).append(target)
    pairs = set()
    for lane, was in origin.items():
        queue = list(following.get(lane, ()))
        while queue:
            reached = queue.pop()
            if reached in origin:
                pairs.add((was, origin[reached]))
            else:
                queue += following.get(reached, ())
    return pairs
