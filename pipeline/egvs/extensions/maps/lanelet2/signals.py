"""Traffic lights of Lanelet2 maps: which turns they govern, and signal plans for them.

A regulatory element governs the turns of the lanelets that refer to it. Where none does, it governs the lanes that end
nearest to its stop line. The turns of one element form a signal group. Plans are assumed: groups that do not conflict
share a phase; a turn across the oncoming traffic yields to it, unless it has a light of its own.

Frame: x, y in metres of the world frame.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from shapely.geometry import LineString, Point

from egvs.core.grid import FloatArray
from egvs.extensions.maps.formats.lanelet2 import LaneletMap, Regulation
from egvs.extensions.maps.lanelet2.plain_network import PlainElement
from egvs.extensions.maps.lanelet2.road_layout import RoadLayout, Turn

STOP_LINE_RANGE_M = 10.0
"""A light without lanelets governs the lanes that end nearer than this to its stop line."""

GREEN_S, SIDE_GREEN_S, YELLOW_S, ALL_RED_S = 30, 15, 3, 2
"""Durations of the assumed plans; the second is for phases of turns across the oncoming traffic only."""

WALK_S, WALK_CLEARANCE_S = 12, 10
"""Green for all crosswalks of a junction, and the time to clear them."""

_TURN_DEG, _OPPOSITE_DEG = 45.0, 135.0
_MAX_CROSSING_COS = 0.8

LaneId = tuple[str, int]
"""Road and index of the lane."""


@dataclass(frozen=True)
class SignalPlan:
    """The traffic lights of a network.

    Attributes
    ----------
    nodes
        The signalised nodes, sorted.
    index_of
        Position in the states of the program, by turn.
    elements
        Programs and controlled connections, as plain XML.
    crosswalk_index
        Position of the first crosswalk of a node in the states of its program.
    by_stop_line, unused
        Regulatory elements that were assigned by their stop line, and those that govern no turn.
    """

    nodes: tuple[str, ...]
    index_of: dict[Turn, int]
    elements: tuple[PlainElement, ...]
    crosswalk_index: dict[str, int]
    by_stop_line: tuple[int, ...]
    unused: tuple[int, ...]


@dataclass(frozen=True)
class _Movement:
    """A turn and what matters to its right of way."""

    turn: Turn
    group: int
    line: LineString
    entry_deg: float
    is_across: bool

    def is_opposite(self, other: _Movement) -> bool:
        """Return whether two movements enter from opposite directions."""
        return abs(_angle_deg(self.entry_deg - other.entry_deg)) > _OPPOSITE_DEG

    def crosses(self, other: _Movement) -> bool:
        """Return whether two movements from different lanes meet."""
        a, b = self.turn, other.turn
        if (a.source, a.source_lane) == (b.source, b.source_lane):
            return False
        return (a.target, a.target_lane) == (b.target, b.target_lane) or bool(self.line.intersects(other.line))

    def yields_to(self, other: _Movement) -> bool:
        """Return whether it crosses oncoming traffic that goes first."""
        return self.is_across and not other.is_across and self.is_opposite(other) and self.crosses(other)


def plan_signals(
    layout: RoadLayout,
    lanelet_map: LaneletMap,
    xyz_m: Mapping[int, FloatArray],
    crosswalks: Mapping[str, int],
    *,
    lefthand: bool,
) -> SignalPlan:
    """Assign the traffic lights of a map to the turns, and make plans for them.

    Parameters
    ----------
    layout
        Roads and turns.
    lanelet_map
        The map.
    xyz_m
        x, y, z of its points, for stop lines.
    crosswalks
        Number of crosswalks by node; they are green together, when no vehicle is.
    lefthand
        Whether traffic drives on the left: then right turns cross the oncoming traffic.
    """
    lights = [light for light in lanelet_map.regulations.values() if light.subtype == "traffic_light"]
    assignment = _Assignment(layout, lanelet_map, xyz_m)
    by_stop_line = []
    for light in lights:
        if not assignment.by_lanelets(light) and assignment.by_stop_line(light):
            by_stop_line.append(light.id)
    group_of = assignment.turn_groups()

    movements: dict[str, list[_Movement]] = defaultdict(list)
    for turn, group in group_of.items():
        movements[layout.roads[turn.source].end].append(_make_movement(turn, group, layout, lefthand))
    index_of: dict[Turn, int] = {}
    crosswalk_index: dict[str, int] = {}
    programs: list[PlainElement] = []
    connections: list[PlainElement] = []
    for node, governed in sorted(movements.items()):
        program = _Program(node, governed, layout, crosswalks.get(node, 0))
        if node in crosswalks:
            crosswalk_index[node] = program.links
        index_of |= program.index_of
        programs.append(program.element())
        connections += program.connections()
    unused = tuple(light.id for light in lights if light.id not in set(group_of.values()))
    elements = (*programs, *connections)
    return SignalPlan(tuple(sorted(movements)), index_of, elements, crosswalk_index, tuple(by_stop_line), unused)


class _Assignment:
    """Finds the light of each lane and of each inner lanelet."""

    def __init__(self, layout: RoadLayout, lanelet_map: LaneletMap, xyz_m: Mapping[int, FloatArray]) -> None:
        self._layout = layout
        self._map = lanelet_map
        self._xyz_m = xyz_m
        self._lights_of: dict[int, list[int]] = defaultdict(list)
        for lanelet in lanelet_map.lanelets.values():
            for number in lanelet.regulations:
                if lanelet_map.regulations[number].subtype == "traffic_light":
                    self._lights_of[lanelet.id].append(number)
        self._light_of_lane: dict[LaneId, int] = {}
        self._distance_m: dict[LaneId, float] = {}

    def by_lanelets(self, light: Regulation) -> bool:
        """Return whether any lanelet refers to a light."""
        return any(light.id in lights for lights in self._lights_of.values())

    def by_stop_line(self, light: Regulation) -> bool:
        """Assign a light to the lanes that end at its stop line; return whether there are any."""
        is_assigned = False
        for line_id in light.ids("way", "ref_line"):
            points_m = np.array([self._xyz_m[node][:2] for node in self._map.lines[line_id].nodes])
            if len(points_m) < 2:
                continue
            line = LineString(points_m)
            across = _unit(points_m[-1] - points_m[0])
            for lane, end_m, heading in self._lane_ends():
                distance_m = float(line.distance(Point(end_m)))
                is_facing = abs(float(across @ heading)) < _MAX_CROSSING_COS
                if is_facing and distance_m < self._distance_m.get(lane, STOP_LINE_RANGE_M):
                    self._distance_m[lane] = distance_m
                    self._light_of_lane[lane] = light.id
                    is_assigned = True
        return is_assigned

    def turn_groups(self) -> dict[Turn, int]:
        """Return the light of each governed turn in a junction."""
        groups: dict[Turn, int] = {}
        for lane, turns in self._layout.turns_from.items():
            for turn in turns:
                if (light := self._light_of_turn(lane, turn)) is not None:
                    groups |= dict.fromkeys(self._layout.turns_in_junction(turn), light)
        return groups

    def _light_of_turn(self, lane: LaneId, turn: Turn) -> int | None:
        source = self._layout.roads[turn.source].lanes[turn.source_lane]
        for key in (source.key, *turn.path):
            if lights := self._lights_of.get(key.id):
                return min(lights)
        return self._light_of_lane.get(lane)

    def _lane_ends(self) -> Iterator[tuple[LaneId, FloatArray, FloatArray]]:
        """Yield the lanes that end in junctions, their end, and their direction there."""
        in_junctions = {turn.source for turn in self._layout.turns if turn.path}
        for road in self._layout.roads.values():
            if road.id in in_junctions:
                for index, lane in enumerate(road.lanes):
                    line_m = lane.center_m[:, :2]
                    yield (road.id, index), line_m[-1], _unit(line_m[-1] - line_m[-2])


class _Program:
    """A signal plan for one node."""

    def __init__(self, node: str, movements: list[_Movement], layout: RoadLayout, crosswalks: int) -> None:
        self._node = node
        self._movements = movements
        self._layout = layout
        self._crosswalks = crosswalks
        self._groups = sorted({movement.group for movement in movements})
        links = sorted({(movement.group, movement.is_across) for movement in movements})
        self.index_of = {movement.turn: links.index((movement.group, movement.is_across)) for movement in movements}
        self.links = len(links)

    def element(self) -> PlainElement:
        """Return the program as plain XML."""
        attributes = {"id": self._node, "type": "static", "programID": "0", "offset": "0"}
        return PlainElement("tlLogic", attributes, tuple(self._phase_elements()))

    def connections(self) -> Iterator[PlainElement]:
        """Yield the controlled connections."""
        for movement in self._movements:
            turn = movement.turn
            attributes = {
                "from": turn.source,
                "to": turn.target,
                "fromLane": str(self._layout.sumo_lane(turn.source, turn.source_lane)),
                "toLane": str(self._layout.sumo_lane(turn.target, turn.target_lane)),
                "tl": self._node,
                "linkIndex": str(self.index_of[turn]),
            }
            yield PlainElement("connection", attributes)

    def _phase_elements(self) -> Iterator[PlainElement]:
        """Yield the phases: greens with yellow and all red between them, and one for all crosswalks at the end."""
        stop, walk = "r" * self._crosswalks, "G" * self._crosswalks
        phases = self.phases
        greens = [self._green_state(phase) for phase in phases]
        afterwards = [*greens[1:], "r" * self.links if self._crosswalks else greens[0]]
        for phase, state, following in zip(phases, greens, afterwards, strict=True):
            is_side = all(movement.is_across for movement in self._of(phase))
            yield _phase(SIDE_GREEN_S if is_side else GREEN_S, state + stop)
            if following == state:
                continue
            pairs = list(zip(state, following, strict=True))
            yield _phase(YELLOW_S, "".join(_during_change(a, b, "y") for a, b in pairs) + stop)
            yield _phase(ALL_RED_S, "".join(_during_change(a, b, "r") for a, b in pairs) + stop)
        if self._crosswalks:
            yield _phase(WALK_S, "r" * self.links + walk)
            yield _phase(WALK_CLEARANCE_S, "r" * self.links + stop)

    @cached_property
    def phases(self) -> list[tuple[int, ...]]:
        """The groups that are green in each phase; each group at least once."""
        phases: list[tuple[int, ...]] = []
        served: set[int] = set()
        for group in self._groups:
            if group in served:
                continue
            phase = [group]
            for other in [*(g for g in self._groups if g not in served), *sorted(served)]:
                if other not in phase and all(self._are_compatible(other, member) for member in phase):
                    phase.append(other)
            served.update(phase)
            phases.append(tuple(sorted(phase)))
        return phases

    def _green_state(self, phase: tuple[int, ...]) -> str:
        """Return the state of a phase: G for green, g for green that yields, r for red."""
        state = ["r"] * self.links
        active = self._of(phase)
        for movement in active:
            yields = any(movement.yields_to(other) for other in active)
            index = self.index_of[movement.turn]
            state[index] = "g" if yields or state[index] == "g" else "G"
        return "".join(state)

    def _of(self, groups: tuple[int, ...]) -> list[_Movement]:
        return [movement for movement in self._movements if movement.group in groups]

    def _are_compatible(self, one: int, other: int) -> bool:
        """Return whether two groups may be green together; a group of across turns alone is never to yield."""
        movements, others = self._of((one,)), self._of((other,))
        for group in (movements, others):
            if all(movement.is_across for movement in group) and any(a.crosses(b) for a in movements for b in others):
                return False
        return not any(a.crosses(b) and not a.yields_to(b) and not b.yields_to(a) for a in movements for b in others)


def _make_movement(turn: Turn, group: int, layout: RoadLayout, lefthand: bool) -> _Movement:
    source = layout.roads[turn.source].lanes[turn.source_lane].center_m[:, :2]
    target = layout.roads[turn.target].lanes[turn.target_lane].center_m[:, :2]
    entry_deg = _heading_deg(source[-1] - source[-2])
    turned_deg = _angle_deg(_heading_deg(target[1] - target[0]) - entry_deg)
    is_across = turned_deg < -_TURN_DEG if lefthand else turned_deg > _TURN_DEG
    return _Movement(turn, group, LineString(turn.shape_m[:, :2]), entry_deg, is_across)


def _phase(duration_s: int, state: str) -> PlainElement:
    return PlainElement("phase", {"duration": str(duration_s), "state": state})


def _during_change(before: str, after: str, ending: str) -> str:
    """Return the state of a link between two greens: it stays green, ends, or waits."""
    if before in "Gg":
        return before if after in "Gg" else ending
    return "r"


def _heading_deg(vector: FloatArray) -> float:
    return math.degrees(math.atan2(vector[1], vector[0]))


def _angle_deg(angle_deg: float) -> float:
    """Return an angle in (-180, 180]."""
    return 180.0 - (180.0 - angle_deg) % 360.0


def _unit(vector: FloatArray) -> FloatArray:
    return np.asarray(vector / max(float(np.hypot(*vector)), 1e-9))
