"""Where vehicles may change lanes, by the markings of a Lanelet2 map."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

from egvs.extensions.maps.formats.lanelet2 import LaneletMap
from egvs.extensions.maps.lane_changes import open_unreachable_lanes
from egvs.extensions.maps.lanelet2.road_layout import Road, RoadLayout
from egvs.extensions.maps.lanelet2.rules import may_cross


@dataclass(frozen=True)
class LaneChanges:
    """Permitted lane changes.

    Attributes
    ----------
    to_lanes
        The neighbouring lanes that vehicles may change to, by road and lane.
    opened
        Lanes, as road and index, that vehicles may change to although no marking allows it.
    """

    to_lanes: dict[tuple[str, int], frozenset[int]]
    opened: tuple[tuple[str, int], ...]


def find_lane_changes(layout: RoadLayout, lanelet_map: LaneletMap, *, lefthand: bool) -> LaneChanges:
    """Find the permitted lane changes of all roads."""
    entered: dict[str, set[int]] = defaultdict(set)
    for turn in layout.turns:
        entered[turn.target].add(turn.target_lane)
    to_lanes: dict[tuple[str, int], frozenset[int]] = {}
    opened: list[tuple[str, int]] = []
    for road in layout.roads.values():
        changes = _marked_changes(road, lanelet_map, lefthand)
        if entered[road.id]:
            opened += [(road.id, lane) for lane in open_unreachable_lanes(changes, entered[road.id])]
        to_lanes |= {(road.id, index): frozenset(others) for index, others in enumerate(changes)}
    return LaneChanges(to_lanes, tuple(opened))


def _marked_changes(road: Road, lanelet_map: LaneletMap, lefthand: bool) -> list[set[int]]:
    """Return which lanes the markings let vehicles change to, by lane."""
    changes: list[set[int]] = [set() for _ in road.lanes]
    for index, lane in enumerate(road.lanes):
        left, right = (index - 1, index + 1) if lefthand else (index + 1, index - 1)
        to_left, _ = may_cross(lanelet_map.lines[lane.left_line], is_along=lane.left_along)
        _, to_right = may_cross(lanelet_map.lines[lane.right_line], is_along=lane.right_along)
        for other, is_allowed in ((left, to_left), (right, to_right)):
            if is_allowed and 0 <= other < len(road.lanes):
                changes[index].add(other)
    return changes
