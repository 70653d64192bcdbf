"""Hand-made Lanelet2 maps, and SUMO networks written as Lanelet2."""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from egvs.formats.georeference import WorldFrame
from egvs.traffic.network import Edge, Network

Line = NDArray[np.float64]

SAME_POINT_M = 0.05
FRAME = WorldFrame("+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs", (-458000.0, -5428000.0))
"""Near Karlsruhe."""


@dataclass
class MapWriter:
    """Collects the points, lines, lanelets and regulatory elements of a map."""

    points: list[tuple[float, float, float]] = field(default_factory=list)
    lines: dict[int, tuple[list[int], dict[str, str]]] = field(default_factory=dict)
    lanelets: dict[int, tuple[int, int, dict[str, str], list[int]]] = field(default_factory=dict)
    regulations: dict[int, tuple[list[tuple[str, int, str]], dict[str, str]]] = field(default_factory=dict)
    _cells: dict[tuple[int, int, int], list[int]] = field(default_factory=dict)
    _last_id: int = 100_000

    def point(self, at_m: Sequence[float]) -> int:
        """Return the number of the point there, which may exist already."""
        x, y, z = (*map(float, at_m), 0.0)[:3]
        cell = tuple(int(v // SAME_POINT_M) for v in (x, y, z))
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                for dz in (-1, 0, 1):
                    for number in self._cells.get((cell[0] + dx, cell[1] + dy, cell[2] + dz), ()):
                        if np.linalg.norm(np.subtract(self.points[number - 1], (x, y, z))) <= SAME_POINT_M:
                            return number
        self.points.append((x, y, z))
        self._cells.setdefault((cell[0], cell[1], cell[2]), []).append(len(self.points))
        return len(self.points)

    def line(self, line_m: Line | Sequence[Sequence[float]], **tags: str) -> int:
        """Add a line and return its identifier."""
        numbers = [self.point(point) for point in line_m]
        self._last_id += 1
        self.lines[self._last_id] = ([n for i, n in enumerate(numbers) if i == 0 or n != numbers[i - 1]], tags)
        return self._last_id

    def lanelet(self, left: int, right: int, **tags: str) -> int:
        """Add a lanelet and return its identifier."""
        self._last_id += 1
        self.lanelets[self._last_id] = left, right, {"subtype": "road", "location": "urban", **tags}, []
        return self._last_id

    def regulation(self, members: Sequence[tuple[str, int, str]], subtype: str, **tags: str) -> int:
        """Add a regulatory element with members (type, identifier, role) and return its identifier."""
        self._last_id += 1
        self.regulations[self._last_id] = list(members), {"subtype": subtype, **tags}
        return self._last_id

    def refer(self, lanelet: int, regulation: int) -> None:
        """Let a lanelet refer to a regulatory element."""
        self.lanelets[lanelet][3].append(regulation)

    def write(
        self, path: Path, *, local: bool = False, frame: WorldFrame = FRAME, turn_lines: int | None = None
    ) -> Path:
        """Write the map; with local_x, local_y and ele if ``local``; ``turn_lines`` draws lines that run backwards."""
        draw = random.Random(turn_lines)
        degrees = frame.to_degrees(np.array(self.points)[:, :2])
        out = ['<?xml version="1.0"?>', '<osm version="0.6" generator="hand">']
        for number, ((x, y, z), (lon, lat)) in enumerate(zip(self.points, degrees, strict=True), 1):
            tags = {"local_x": f"{x:.4f}", "local_y": f"{y:.4f}", "ele": f"{z:.4f}"} if local else {}
            out.append(f'<node id="{number}" lat="{lat:.11f}" lon="{lon:.11f}">{_tags(tags)}</node>')
        for number, (nodes, tags) in self.lines.items():
            backwards = turn_lines is not None and draw.random() < 0.5
            refs = "".join(f'<nd ref="{n}"/>' for n in (nodes[::-1] if backwards else nodes))
            out.append(f'<way id="{number}">{refs}{_tags(tags)}</way>')
        for number, (left, right, tags, regulations) in self.lanelets.items():
            members = [("way", left, "left"), ("way", right, "right")]
            members += [("relation", regulation, "regulatory_element") for regulation in regulations]
            out.append(_relation(number, members, {"type": "lanelet", **tags}))
        for number, (members, tags) in self.regulations.items():
            out.append(_relation(number, members, {"type": "regulatory_element", **tags}))
        path.write_text("\n".join([*out, "</osm>", ""]), encoding="utf-8")
        return path


def _relation(number: int, members: Sequence[tuple[str, int, str]], tags: Mapping[str, str]) -> str:
    refs = "".join(f'<member type="{kind}" ref="{ref}" role="{role}"/>' for kind, ref, role in members)
    return f'<relation id="{number}">{refs}{_tags(tags)}</relation>'


def _tags(tags: Mapping[str, str]) -> str:
    return "".join(f'<tag k="{key}" v="{value}"/>' for key, value in tags.items())


@dataclass
class Crossing:
    """A crossing of four streets, one lane in each direction, at x = y = 0.

    Attributes
    ----------
    writer
        The map.
    into, out_of
        The lanelets towards and away from the crossing, by arm: 0 east, 1 north, 2 west, 3 south.
    turns
        The lanelets in the crossing by arms.
    """

    writer: MapWriter
    into: dict[int, int]
    out_of: dict[int, int]
    turns: dict[tuple[int, int], int]


NEAR_M, FAR_M, WIDTH_M = 12.0, 72.0, 3.5


def make_crossing(
    *,
    lefthand: bool = False,
    heights_m: Sequence[float] = (0, 0, 0, 0),
    centre_m: float = 0.0,
    tags: Mapping[str, str] = {},
) -> Crossing:
    """Return a crossing; ``heights_m`` are those of the far ends of its arms, ``centre_m`` that of its middle."""
    writer = MapWriter()
    mirror = np.array([-1.0, 1.0, 1.0]) if lefthand else np.ones(3)
    roles = (lambda left, right: (right, left)) if lefthand else (lambda left, right: (left, right))

    def at(arm: int, along_m: float, left_m: float, z_m: float) -> Line:
        u = np.array([np.cos(arm * np.pi / 2), np.sin(arm * np.pi / 2)])
        v = np.array([-u[1], u[0]])
        return np.array([*(along_m * u + left_m * v), z_m]) * mirror

    into, out_of = {}, {}
    for arm in range(4):
        z = heights_m[arm]
        middle = writer.line([at(arm, NEAR_M, 0, centre_m), at(arm, FAR_M, 0, z)], type="line_thin", subtype="solid")
        kerb_in = writer.line([at(arm, FAR_M, WIDTH_M, z), at(arm, NEAR_M, WIDTH_M, centre_m)], type="curbstone")
        kerb_out = writer.line([at(arm, NEAR_M, -WIDTH_M, centre_m), at(arm, FAR_M, -WIDTH_M, z)], type="curbstone")
        into[arm] = writer.lanelet(*roles(middle, kerb_in), **tags)
        out_of[arm] = writer.lanelet(*roles(middle, kerb_out), **tags)
    turns = {}
    for arm in range(4):
        for turned in (1, 2, 3):
            other = (arm + turned) % 4
            bounds = []
            for side_m in (0.0, WIDTH_M):
                start, end = at(arm, NEAR_M, side_m, centre_m), at(other, NEAR_M, -side_m, centre_m)
                corner = _corner(arm, other, side_m, centre_m) * mirror
                shares = np.linspace(0, 1, 2 if turned == 2 else 15)[:, None]
                curve = (1 - shares) ** 2 * start + 2 * shares * (1 - shares) * corner + shares**2 * end
                if turned == 2:
                    curve = (1 - shares) * start + shares * end
                bounds.append(writer.line(curve, type="virtual"))
            turns[arm, other] = writer.lanelet(*roles(bounds[0], bounds[1]), **tags)
    return Crossing(writer, into, out_of, turns)


def _corner(arm: int, other: int, side_m: float, z_m: float) -> Line:
    """Return where the bound of the way in meets that of the way out."""
    u = np.array([np.cos(arm * np.pi / 2), np.sin(arm * np.pi / 2)])
    w = np.array([np.cos(other * np.pi / 2), np.sin(other * np.pi / 2)])
    point = side_m * np.array([-u[1], u[0]]) - side_m * np.array([-w[1], w[0]])
    matrix = np.column_stack([u, -w])
    if abs(np.linalg.det(matrix)) < 1e-9:
        return np.array([0.0, 0.0, z_m])
    along, _ = np.linalg.solve(matrix, -point)
    return np.array([*(side_m * np.array([-u[1], u[0]]) + along * u), z_m])


# ---- networks written as Lanelet2


@dataclass
class WrittenNetwork:
    """A network as a map.

    Attributes
    ----------
    writer
        The map.
    lane_of
        The original lane, ``edge_index``, of each lanelet of a road.
    turns
        The original connections, by lanes.
    """

    writer: MapWriter
    lane_of: dict[int, str]
    turns: set[tuple[str, str]]


def internal_lanes(net_xml: str) -> dict[str, str]:
    """Return the lane after each lane of a junction, from the text of a network."""
    after = {}
    for connection in ElementTree.fromstring(net_xml).iter("connection"):
        if connection.attrib["from"].startswith(":"):
            target = f"{connection.attrib['to']}_{connection.attrib['toLane']}"
            source = f"{connection.attrib['from']}_{connection.attrib['fromLane']}"
            after[source] = connection.get("via", target)
    return after


def write_network(network: Network, net_xml: str, *, refer: bool = True) -> WrittenNetwork:
    """Make a map of a network, given also as text: lanes for cars, their turns, markings, lights and right of way.

    With ``refer``, the lanelets of turns refer to their traffic light; else only its stop line tells what it governs.
    """
    root = ElementTree.fromstring(net_xml)
    writer = MapWriter()
    lane_of: dict[str, int] = {}
    corners: dict[str, tuple[Line, Line]] = {}
    lefthand = _drives_left(network)
    marks = {lane.attrib["id"]: dict(lane.attrib) for lane in root.iter("lane")}
    for edge in network.edges:
        lanes = [index for index, lane in enumerate(edge.lanes) if lane.permission.admits("passenger")]
        bounds_m = _edge_bounds_m(edge, lanes, lefthand=lefthand)
        between = [_marking(marks[f"{edge.id}_{a}"], marks[f"{edge.id}_{b}"], lefthand) for a, b in pairwise(lanes)]
        kinds = ["solid", *between, "solid"]
        lines = [
            writer.line(bound, type="line_thin", subtype=kind) for bound, kind in zip(bounds_m, kinds, strict=True)
        ]
        for position, index in enumerate(lanes):
            sides = (lines[position + 1], lines[position])
            left, right = sides[::-1] if lefthand else sides
            name = f"{edge.id}_{index}"
            lane_of[name] = writer.lanelet(left, right, speed_limit=f"{edge.lanes[index].speed_m_s * 3.6:.2f}")
            ends = bounds_m[position + 1], bounds_m[position]
            corners[name] = ends[::-1] if lefthand else ends
    turns: dict[tuple[str, str], int] = {}
    following = internal_lanes(net_xml)
    shapes = {f"{edge.id}_{i}": lane.shape_m for edge in network.all_edges for i, lane in enumerate(edge.lanes)}
    for connection in network.connections:
        source = f"{network.edges[connection.source].id}_{connection.source_lane}"
        target = f"{network.edges[connection.target].id}_{connection.target_lane}"
        if source not in corners or target not in corners:
            continue
        parts, lane = [], connection.via
        while lane.startswith(":"):
            parts.append(_with_heights(shapes[lane]))
            lane = following[lane]
        path = np.vstack([part[int(i > 0) :] for i, part in enumerate(parts)])
        left, right = _turn_bounds_m(path, corners[source], corners[target])
        bounds = writer.line(left, type="virtual"), writer.line(right, type="virtual")
        speed_m_s = network.edges[connection.source].lanes[connection.source_lane].speed_m_s
        turns[source, target] = writer.lanelet(*bounds, speed_limit=f"{speed_m_s * 3.6:.2f}")
    _write_lights(writer, root, turns, corners, refer=refer)
    _write_right_of_way(writer, root, turns)
    return WrittenNetwork(writer, {number: name for name, number in lane_of.items()}, set(turns))


def _marking(first: Mapping[str, str], second: Mapping[str, str], lefthand: bool) -> str:
    """Return the marking between two lanes, the first at the kerb, by who may change between them."""
    left, right = (first, second) if lefthand else (second, first)
    to_left, to_right = "changeLeft" not in right, "changeRight" not in left
    names = {(True, True): "dashed", (True, False): "solid_dashed", (False, True): "dashed_solid"}
    return names.get((to_left, to_right), "solid")


def signal_sequences(root: ElementTree.Element) -> dict[tuple[str, int], tuple[str, ...]]:
    """Return the states of each link of each program of a network, phase by phase."""
    sequences = {}
    for logic in root.iter("tlLogic"):
        states = [phase.attrib["state"] for phase in logic.iter("phase")]
        for index, sequence in enumerate(zip(*states, strict=True)):
            sequences[logic.attrib["id"], index] = sequence
    return sequences


def lane_names(connection: ElementTree.Element) -> tuple[str, str]:
    """Return the lanes that a ``<connection>`` connects."""
    a = connection.attrib
    return f"{a['from']}_{a['fromLane']}", f"{a['to']}_{a['toLane']}"


def _write_lights(
    writer: MapWriter,
    root: ElementTree.Element,
    turns: Mapping[tuple[str, str], int],
    corners: Mapping[str, tuple[Line, Line]],
    *,
    refer: bool,
) -> None:
    """Write a regulatory element, with a light and a stop line, for the turns of each edge that always switch alike."""
    sequences = signal_sequences(root)
    groups: dict[tuple[str, str, tuple[str, ...]], list[tuple[str, str]]] = {}
    for connection in root.findall("connection"):
        pair = lane_names(connection)
        if "tl" in connection.attrib and pair in turns:
            light, index = connection.attrib["tl"], int(connection.attrib["linkIndex"])
            groups.setdefault((light, connection.attrib["from"], sequences[light, index]), []).append(pair)
    for pairs in groups.values():
        ends = [corners[source] for source in sorted({source for source, _ in pairs})]
        across = [line[-1] for pair in ends for line in pair]
        stop_m = _longest_line(across)
        raised_m = stop_m + np.array([0, 0, 5.0])
        members = [
            ("way", writer.line(stop_m, type="stop_line"), "ref_line"),
            ("way", writer.line(raised_m, type="traffic_light", subtype="red_yellow_green"), "refers"),
        ]
        light_id = writer.regulation(members, "traffic_light")
        for pair in pairs if refer else ():
            writer.refer(turns[pair], light_id)


def _longest_line(points: Sequence[Line]) -> Line:
    """Return the two points farthest from each other."""
    return np.array(max(((a, b) for a in points for b in points), key=lambda pair: np.linalg.norm(pair[0] - pair[1])))


def _write_right_of_way(writer: MapWriter, root: ElementTree.Element, turns: Mapping[tuple[str, str], int]) -> None:
    """Write a regulatory element for each turn that yields to others, at junctions without lights."""
    last_lanes = {}
    following = internal_lanes(ElementTree.tostring(root, encoding="unicode"))
    for connection in root.findall("connection"):
        pair = lane_names(connection)
        if pair in turns:
            lane = connection.get("via", "")
            while following.get(lane, "").startswith(":"):
                lane = following[lane]
            last_lanes[lane] = turns[pair]
    for junction in root.findall("junction"):
        if junction.attrib["type"] not in ("priority", "right_before_left", "unregulated"):
            continue
        links = [last_lanes.get(lane) for lane in junction.attrib["intLanes"].split()]
        for request in junction.findall("request"):
            yielding = links[int(request.attrib["index"])]
            bits = request.attrib["response"][::-1]
            prior = [link for link, bit in zip(links, bits, strict=True) if bit == "1" and link is not None]
            if yielding is not None and prior:
                members = [("relation", link, "right_of_way") for link in prior]
                rule = writer.regulation([("relation", yielding, "yield"), *members], "right_of_way")
                writer.refer(yielding, rule)


def _drives_left(network: Network) -> bool:
    """Whether lane 0 lies left of lane 1."""
    for edge in network.edges:
        if len(edge.lanes) > 1:
            first, second = (lane.shape_m for lane in edge.lanes[:2])
            along, aside = first[1, :2] - first[0, :2], second[0, :2] - first[0, :2]
            return bool(along[0] * aside[1] - along[1] * aside[0] < 0)
    return False


def _edge_bounds_m(edge: Edge, lanes: Sequence[int], *, lefthand: bool) -> list[Line]:
    """Return the bounds of an edge's lanes, from the kerb on: in the middle between centre lines."""
    count = max(len(edge.lanes[i].shape_m) for i in lanes) * 3
    centres = [_resample(_with_heights(edge.lanes[i].shape_m), count) for i in lanes]
    if len(centres) == 1:
        half_m = (edge.lanes[lanes[0]].width_m or 3.2) / 2
        aside = half_m * _left_normals(centres[0]) * (-1 if lefthand else 1)
        return [centres[0] - aside, centres[0] + aside]
    middles = [(a + b) / 2 for a, b in pairwise(centres)]
    return [2 * centres[0] - middles[0], *middles, 2 * centres[-1] - middles[-1]]


def _turn_bounds_m(path: Line, source: tuple[Line, Line], target: tuple[Line, Line]) -> tuple[Line, Line]:
    """Return the left and the right bound of a turn, which begin and end at the corners of the lanes."""
    points = _resample(path, max(2 * len(path), 20))
    first, last = source[0][-1] - source[1][-1], target[0][0] - target[1][0]
    half_m = np.linspace(np.linalg.norm(first), np.linalg.norm(last), len(points))[:, None] / 2
    aside = half_m * _left_normals(points)
    aside[0], aside[-1] = first / 2, last / 2
    left, right = points + aside, points - aside
    left[0], right[0], left[-1], right[-1] = source[0][-1], source[1][-1], target[0][0], target[1][0]
    return left, right


def _with_heights(line: Line) -> Line:
    return line if line.shape[1] == 3 else np.column_stack([line, np.zeros(len(line))])


def _resample(line: Line, count: int) -> Line:
    stations = np.concatenate([[0.0], np.hypot(*np.diff(line[:, :2], axis=0).T).cumsum()])
    shares = np.unique(np.concatenate([np.linspace(0, stations[-1], count)]))
    return np.column_stack([np.interp(shares, stations, axis) for axis in line.T])


def _left_normals(line: Line) -> Line:
    along = np.gradient(line[:, :2], axis=0)
    along /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    return np.column_stack([-along[:, 1], along[:, 0], np.zeros(len(line))])
