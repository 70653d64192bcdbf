"""The places of a road network that vehicles are on, in words that a planner uses: "eastbound left-turn lane".

Steps: follow each lane's connections to say which way it leads; name a road that ends in the region of interest an
*approach*, after the way in which traffic travels there, and one that starts in it and leaves it an *exit*; name what
lies inside a junction after the approach that it comes from and the way it turns; name crossings after the side of the
junction that they are on. Where a road is cut in two without a junction, both pieces are one approach.

Lanes for people on foot, bicycles and rails apart from the street are none of these.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pipeline.core.grid import Roi
from pipeline.scoring.blindspots.lanes import Floats, MiddleLine
from pipeline.traffic.network import LANE_WIDTH_M, Connection, Edge, Lane, Network
from pipeline.world.carriageway import is_carriageway

APPROACH, EXIT, ROAD, LANE, TURN, CROSSING = KINDS = ("approach", "exit", "road", "lane", "turn", "crossing")
"""Kinds of places; a road is one that passes through the region."""

_COMPASS = ("east", "north-east", "north", "north-west", "west", "south-west", "south", "south-east")
_TURNS = {"s": "straight", "l": "left", "L": "left", "r": "right", "R": "right", "t": "back", "T": "back"}
_ORDER = ("left", "straight", "right")

_HEADING_OVER_M = 10.0
"""The way in which a road leads is that of its last metres, or of its first ones where it leaves the region."""


@dataclass(frozen=True)
class Place:
    """A lane, a way through a junction, a whole road, or a crossing.

    Attributes
    ----------
    by
        One of :data:`KINDS`.
    name
        SUMO's id of the lane, of the road, or of the crossing; of a turn the road's, a colon and the way it turns.
    words
        What a planner calls it; several may be called the same (:func:`told_apart`).
    at_m
        A point of it, world frame, metres.
    """

    by: str
    name: str
    words: str
    at_m: tuple[float, float]


@dataclass(frozen=True, eq=False)
class RoadPlaces:
    """The places of a network.

    Attributes
    ----------
    places
        All that there are.
    lanes
        Those that vehicles drive on, inside junctions too.
    places_of_lane
        Of each of ``lanes``, its places: a lane and its road, or a turn.
    crossings
        Each crossing as a strip, with its place.
    """

    places: tuple[Place, ...]
    lanes: tuple[MiddleLine, ...]
    places_of_lane: tuple[tuple[int, ...], ...]
    crossings: tuple[tuple[MiddleLine, int], ...]

    @classmethod
    def of(cls, network: Network, roi: Roi) -> RoadPlaces:
        """From a network; a lane without length is left out."""
        return _Builder(network, roi).build()


def compass(along_m: Floats) -> str:
    """The nearest of eight compass points to a direction (2,), x east and y north."""
    return _COMPASS[round(float(np.arctan2(along_m[1], along_m[0])) / (np.pi / 4)) % 8]


def lane_in_words(turns: Iterable[str]) -> str:
    """What a lane is called that leads these ways."""
    ways = [turn for turn in _ORDER if turn in set(turns)]
    if len(ways) == 3:
        return "lane for all directions"
    if not ways:
        return "U-turn lane" if "back" in set(turns) else "lane"
    if len(ways) == 2:
        return f"{ways[0]}-and-{ways[1]} lane"
    return f"{ways[0]} lane" if ways[0] == "straight" else f"{ways[0]}-turn lane"


def turn_in_words(turn: str) -> str:
    """What a way through a junction is called."""
    if turn in ("", "straight"):
        return f"way {turn} through the junction".replace("  ", " ")
    return f"{'U-turn' if turn == 'back' else f'{turn} turn'} in the junction"


class _Builder:
    """Follows the connections of a network once, then names its places."""

    def __init__(self, network: Network, roi: Roi) -> None:
        self.network, self.roi = network, roi
        self.edges = network.edges
        self.leaving: dict[int, list[Connection]] = defaultdict(list)
        for connection in network.connections:
            if self._is_driven(connection):
                self.leaving[connection.source].append(connection)
        self.goes_on = dict(self._continuations())
        self.came_from = {after: before for before, after in self.goes_on.items()}
        self.found: list[Place] = []
        self.index: dict[tuple[str, str], int] = {}

    def build(self) -> RoadPlaces:
        lanes, owners = [], []
        for number, edge in enumerate(self.edges):
            for which, lane in _driven(edge):
                lanes.append(_strip(lane))
                owners.append(self._of_road_lane(number, which))
        inside = self._inside_junctions()
        for edge in self.network.all_edges:
            if edge.function == "internal":
                for which, lane in _driven(edge):
                    lanes.append(_strip(lane))
                    owners.append(inside.get(f"{edge.id}_{which}") or (self._turn(edge.id, edge.name, "", lane),))
        crossings = tuple(self._crossings())
        return RoadPlaces(tuple(self.found), tuple(lanes), tuple(owners), crossings)

    def _is_driven(self, connection: Connection) -> bool:
        source = self.edges[connection.source].lanes[connection.source_lane]
        target = self.edges[connection.target].lanes[connection.target_lane]
        return all(is_carriageway(its) for its in (source.permission, target.permission, connection.permission))

    def _continuations(self) -> Iterator[tuple[int, int]]:
        """Roads that only lead to one other, to which nothing else leads: the same road, cut in two."""
        after: dict[int, set[int]] = defaultdict(set)
        before: dict[int, set[int]] = defaultdict(set)
        for source, connections in self.leaving.items():
            for connection in connections:
                if _TURNS.get(connection.direction) != "back":
                    after[source].add(connection.target)
                    before[connection.target].add(source)
        for source, targets in after.items():
            (target, *others) = targets
            if not others and before[target] == {source}:
                yield source, target

    def _last_piece(self, edge: int) -> int:
        return _followed(edge, self.goes_on)

    def _turns(self, edge: int, lane: int) -> set[str]:
        """Which ways a lane leads, at the end of the last piece of its road."""
        last, lanes = self._last_piece(edge), {lane}
        while edge != last:
            lanes = {c.target_lane for c in self.leaving[edge] if c.source_lane in lanes and c.target != c.source}
            edge = self.goes_on[edge]
        return {_TURNS.get(c.direction, "") for c in self.leaving[edge] if c.source_lane in lanes}

    def _of_road_lane(self, number: int, which: int) -> tuple[int, ...]:
        edge = self.edges[number]
        by, bound, at_m = self._road(number)
        said = {i: "exit lane" if by == EXIT else "lane" for i, _ in _driven(edge)}
        if by == APPROACH:
            said = {i: lane_in_words(self._turns(number, i)) for i in said}
        alike = [i for i, words in said.items() if words == said[which]]
        several = f" {alike.index(which) + 1} of {len(alike)} from the kerb" if len(alike) > 1 else ""
        last = self.edges[self._last_piece(number)]
        piece = " further back" if by == APPROACH and edge != last else ""
        lane = self._place(LANE, f"{edge.id}_{which}", f"{bound}bound {said[which]}{several}{piece}", edge.name, at_m)
        return lane, self._place(by, last.id, f"{bound}bound {by}", last.name, at_m)

    def _road(self, number: int) -> tuple[str, str, tuple[float, float]]:
        """Whether a road is an approach, an exit or neither, the way it leads, and where."""
        last = self.edges[self._last_piece(number)]
        if self._in_region(last.end_m):
            return APPROACH, compass(_heading(last.lanes[0], at_end=True)), last.end_m
        first = self.edges[_followed(number, self.came_from)]
        by = EXIT if self._in_region(first.start_m) else ROAD
        return by, compass(_heading(self.edges[number].lanes[0], at_end=False)), self.edges[number].start_m

    def _in_region(self, at_m: tuple[float, float]) -> bool:
        low, size = self.roi.origin_m[:2], self.roi.size_m[:2]
        return all(a <= x < a + length for x, a, length in zip(at_m, low, size, strict=True))

    def _inside_junctions(self) -> dict[str, tuple[int, ...]]:
        """The places of the lanes inside junctions that a connection names, and of those that go on from them."""
        found = {}
        for source, connections in self.leaving.items():
            edge = self.edges[source]
            for connection in connections:
                if source in self.goes_on and connection.target == self.goes_on[source]:
                    found[connection.via] = self._of_road_lane(source, connection.source_lane)
                else:
                    turn = _TURNS.get(connection.direction, "")
                    found[connection.via] = (self._turn(edge.id, edge.name, turn, edge.lanes[0]),)
        for junction in self.network.junctions:  # an internal one is named after the lane that goes on there
            if junction.type == "internal" and junction.incoming_lanes and junction.incoming_lanes[0] in found:
                found[junction.id] = found[junction.incoming_lanes[0]]
        return found

    def _turn(self, edge: str, street: str, turn: str, approach: Lane) -> int:
        bound, (x, y) = compass(_heading(approach, at_end=True)), approach.shape_m[-1, :2].tolist()
        return self._place(TURN, f"{edge}:{turn}", f"{bound}bound {turn_in_words(turn)}", street, (x, y))

    def _crossings(self) -> Iterator[tuple[MiddleLine, int]]:
        centres = {junction.id: np.array(junction.at_m) for junction in self.network.junctions}
        for edge in self.network.all_edges:
            if edge.function == "crossing":
                for which, lane in enumerate(edge.lanes):
                    if len(lane.shape_m) > 1:
                        middle = lane.shape_m[:, :2].mean(axis=0)
                        centre = centres.get(edge.id.removeprefix(":").rpartition("_c")[0], middle)
                        side = f"pedestrian crossing on the {compass(middle - centre)} side of the junction"
                        x, y = middle.tolist()
                        yield _strip(lane), self._place(CROSSING, f"{edge.id}_{which}", side, "", (x, y))

    def _place(self, by: str, name: str, words: str, street: str, at_m: tuple[float, float]) -> int:
        """The number of a place, named when it is first asked for."""
        if (by, name) not in self.index:
            self.index[by, name] = len(self.found)
            self.found.append(Place(by, name, f"{words}, {street}" if street else words, at_m))
        return self.index[by, name]


def _followed(edge: int, along: Mapping[int, int]) -> int:
    """Where it ends to go from one to the next, once round at most."""
    seen = {edge}
    while (following := along.get(edge)) is not None and following not in seen:
        seen.add(edge := following)
    return edge


def _driven(edge: Edge) -> list[tuple[int, Lane]]:
    """The lanes for vehicles, with their numbers."""
    return [(i, its) for i, its in enumerate(edge.lanes) if is_carriageway(its.permission) and len(its.shape_m) > 1]


def _strip(lane: Lane) -> MiddleLine:
    return MiddleLine(lane.shape_m[:, :2], LANE_WIDTH_M if lane.width_m is None else lane.width_m)


def _heading(lane: Lane, *, at_end: bool) -> Floats:
    """The direction of a lane's last metres, or of its first ones, (2,)."""
    points = lane.shape_m[::-1, :2] if at_end else lane.shape_m[:, :2]
    gone_m = np.append(0.0, np.cumsum(np.hypot(*np.diff(points, axis=0).T)))
    there = [float(np.interp(_HEADING_OVER_M, gone_m, points[:, axis])) for axis in (0, 1)]
    along = points[0] - there if at_end else there - points[0]
    return np.asarray(along, dtype=np.float64)


def told_apart(places: Sequence[Place]) -> list[Place]:
    """Places of the same words get a point added to them, or SUMO's id where that does not tell them apart either."""
    found = list(places)
    for more in ("near x = {0.at_m[0]:.0f} m, y = {0.at_m[1]:.0f} m", "{0.name}"):
        count = Counter(place.words for place in found)
        found = [
            replace(place, words=f"{place.words} ({more.format(place)})") if count[place.words] > 1 else place
            for place in found
        ]
    return found
